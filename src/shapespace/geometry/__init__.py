"""Geometry of triangle meshes: closest points, alignment, topology, remeshing; no models.

Entry points: `closest`, `procrustes`, `doctor`. Imported by every layer above, never by `io`.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.geometry.closest import SurfaceDistances, surface_distances
    from shapespace.geometry.landmark_alignment import (
        AlignConfig,
        AlignedLandmarks,
        LandmarkFinding,
        align_landmarks,
        find_outliers,
    )
    from shapespace.geometry.landmark_placement import place_landmarks
    from shapespace.geometry.volume_surface import VolumeSurface, surface_of_volume
    from shapespace.types import Similarity, SurfaceLandmarks

__all__ = [
    "AlignConfig",
    "AlignedLandmarks",
    "LandmarkFinding",
    "Similarity",
    "SurfaceDistances",
    "SurfaceLandmarks",
    "VolumeSurface",
    "align_landmarks",
    "find_outliers",
    "place_landmarks",
    "surface_distances",
    "surface_of_volume",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "geometry.closest": ("SurfaceDistances", "surface_distances"),
        "geometry.landmark_placement": ("place_landmarks",),
        "geometry.volume_surface": ("VolumeSurface", "surface_of_volume"),
        "types": ("Similarity", "SurfaceLandmarks"),
        "geometry.landmark_alignment": (
            "AlignConfig",
            "AlignedLandmarks",
            "LandmarkFinding",
            "align_landmarks",
            "find_outliers",
        ),
    },
)
