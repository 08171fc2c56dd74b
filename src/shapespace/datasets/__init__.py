"""Faces to build models from and scans to fit: the bundled simulated faces, and loaders of open data sets."""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.datasets.faces import FaceGenerator, load_faces
    from shapespace.datasets.simulated_scan import Cut, Hole, SimulatedScan, simulate_scan

__all__ = [
    "Cut",
    "FaceGenerator",
    "Hole",
    "SimulatedScan",
    "load_faces",
    "simulate_scan",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "datasets.faces": ("FaceGenerator", "load_faces"),
        "datasets.simulated_scan": ("Cut", "Hole", "SimulatedScan", "simulate_scan"),
    },
)
