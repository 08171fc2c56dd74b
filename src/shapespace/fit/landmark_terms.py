"""Landmarks that somebody placed on the scan, as a soft constraint on every step of the robust fit.

Each pulls its point of the model's surface with its standard deviation; that point is a weighted mean of the corners of
its triangle, and so are its rows of the Jacobian. Matches count far more often than they know something
new, which the posterior mends by a temperature; so that a landmark weighs what it is worth beside them, they are taken
for as many observations as there are patches, and landmarks are weighed up by the same factor. While the matches still
lie far apart landmarks lead the fit, and in the end, where matches are known to a fraction of a millimetre, they yield.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from shapespace.fit.robust.prepared_model import ModelSurface
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import POSE, small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Similarity, SurfaceLandmarks

SHARE = 0.03
"""Standard deviation of a landmark as a share of the model's size (RMS distance from its centre), if none is given."""
_PATCHES = 300.0  # independent patches that the matches of a surface count as, since neighbours share their errors
# width and outlier limit of landmark residuals in SD (R16b), and the factor from MAD to SD of a normal distribution
_WIDTH, _MAD, _FAR = 3.0, 1.48, 4.0


@dataclass(frozen=True, eq=False)
class LandmarkConstraint:
    """Landmarks of a scan that the model has too.

    Args:
        landmarks: L of them, on the model's surface.
        points_mm: (L, 3) in the scan's mm frame.
        stddev_mm: of each coordinate, mm of the scan.
        far_mm: beyond three times this, mm of the model's frame, a landmark has no say, however far off all are.
    """

    landmarks: SurfaceLandmarks
    points_mm: FloatArray
    stddev_mm: float
    far_mm: float

    @staticmethod
    def of(model: ShapeModel, landmarks_mm: Mapping[str, FloatArray], stddev_mm: float) -> LandmarkConstraint | None:
        """Return those of `landmarks_mm` (name -> (3,)) that `model` has too; None where there are none."""
        names = [name for name in model.landmarks if name in landmarks_mm]
        if not names or not np.isfinite(stddev_mm):
            return None
        return LandmarkConstraint(
            model.landmarks.select(names),
            np.stack([landmarks_mm[name] for name in names]),
            stddev_mm,
            SHARE * rms_size(model.mean_vertices),
        )

    def off_mm(self, surface: ModelSurface, T_scan_model: Similarity) -> FloatArray:
        """Return (L,) the distance of each landmark of the surface from that of the scan, mm of the scan."""
        positions = self.landmarks.interpolate(surface.vertices)
        return np.linalg.norm(T_scan_model.apply(positions) - self.points_mm, axis=1)

    def equations(self, surface: ModelSurface, T_scan_model: Similarity, modes: int) -> tuple[FloatArray, FloatArray]:
        """Return Hessian (7 + k, 7 + k) and gradient (7 + k,) of half the squares over the variance, robustly weighed.

        Args:
            surface: as it is now.
            T_scan_model: where it is now, in the scan's mm frame.
            modes: k, how many are free.
        """
        x = self.landmarks.interpolate(surface.vertices)
        off = x - T_scan_model.inverse().apply(self.points_mm)
        distance = np.linalg.norm(off, axis=1)
        stddev = self.stddev_mm / T_scan_model.scale
        # A wrong landmark lies far off beside the others, however far these are off on the way.
        width = _WIDTH * max(stddev, min(_MAD * float(np.median(distance)), self.far_mm))  # R16b
        weight = np.exp(-0.5 * (distance / width) ** 2) / stddev**2  # R16a
        pose = small_poses(x).reshape(len(x), 3, POSE)
        rows = np.concatenate([pose, self.landmarks.interpolate(surface.modes[:, :, :modes])], axis=2)
        every = rows.reshape(3 * len(x), -1)
        heavy = np.repeat(weight, 3)[:, None] * every
        hessian: FloatArray = np.asarray(heavy.T @ every, dtype=np.float64)  # R16c
        return hessian, np.asarray(heavy.T @ off.ravel(), dtype=np.float64)

    def notes(self, surface: ModelSurface, T_scan_model: Similarity) -> list[str]:
        """Return a sentence on each landmark that lies where the fit does not have it."""
        off_mm = self.off_mm(surface, T_scan_model)
        far = off_mm > _FAR * max(self.stddev_mm, _MAD * float(np.median(off_mm)))
        return [
            f"Landmark {name!r} lies {off:.1f} mm from where the fit has it; check its place and its name."
            for name, off, is_far in zip(self.landmarks.names, off_mm, far, strict=True)
            if is_far
        ]


def worth(matches: float) -> float:
    """Return how many matches stand for one observation, by which landmarks are weighed up; `matches` is their sum."""
    return max(1.0, matches / _PATCHES)
