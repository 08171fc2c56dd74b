"""Which version this is, for every file that is written."""

__version__ = "0.1.0"
