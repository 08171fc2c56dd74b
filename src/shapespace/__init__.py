"""Turn any raw 3-D surface into a short vector that means something."""

__version__ = "0.1.0"
