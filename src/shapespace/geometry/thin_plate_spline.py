"""Thin-plate splines through landmarks in 2-D and 3-D, and their bending energy.

Bookstein, PAMI 11(6), 1989. The kernel is r^2 log r in 2-D and -r in 3-D, so that no bending energy is negative.
Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.distance import cdist, pdist

from shapespace.errors import InputError
from shapespace.types import FloatArray, read_only

if TYPE_CHECKING:
    from scipy.interpolate import RBFInterpolator

_RANK = 1e-9  # ratio of singular values; landmarks nearer to a line or a plane than rounding determine no affine map
_SAME = 1e-12  # of the size; landmarks nearer to each other coincide up to float64 rounding
_PSEUDO = 1.5e-8  # of the largest singular value; smaller ones of a singular system are 0: the root of float64 rounding


@dataclass(frozen=True, eq=False)
class ThinPlateSpline:
    """The map of least bending energy from L source landmarks (L, D) to their targets (L, E), with D 2 or 3.

    Args:
        centre: (D,) centroid of the source landmarks.
        size: centroid size of the source landmarks, which are centred and scaled to unit size for accuracy.
        interpolator: interpolator of scipy from the centred and scaled source landmarks to the targets.
    """

    centre: FloatArray
    size: float
    interpolator: RBFInterpolator

    @staticmethod
    def fit(source: FloatArray, target: FloatArray) -> ThinPlateSpline:
        """Return the spline that maps `source` (L, D) exactly to `target` (L, E).

        Raises:
            InputError: the source landmarks lie on a line (2-D) or a plane (3-D), or two of them coincide.
        """
        centre, D = source.mean(axis=0), source.shape[1]
        size = max(float(np.linalg.norm(source - centre)), 1e-300)
        x = (source - centre) / size
        flat = len(x) <= D or float(np.linalg.svd(x, compute_uv=False)[-1]) < _RANK
        if flat or pdist(x).min() < _SAME:
            place = "a line" if D == 2 else "a plane"
            raise InputError(
                f"A thin-plate spline needs {D + 1} or more different landmarks that do not lie on {place}."
            )
        from scipy.interpolate import RBFInterpolator  # slow to import, and most commands need no spline

        kernel = "linear" if D == 3 else "thin_plate_spline"
        return ThinPlateSpline(read_only(centre), size, RBFInterpolator(x, target, kernel=kernel, degree=1))  # M8

    def apply(self, points: FloatArray) -> FloatArray:
        """Return the images (M, E) of points (M, D) under the spline."""
        return np.asarray(self.interpolator((points - self.centre) / self.size), dtype=np.float64)


def bending_energy_matrix(reference: FloatArray) -> FloatArray:
    """Return B (L, L), so that trace(y^T B y) is the bending energy of the spline from `reference` (L, D) to y (L, E).

    It is zero for affine maps. Landmarks that coincide have the same position in all maps.
    """
    size = max(float(np.linalg.norm(reference - reference.mean(axis=0))), 1e-300)
    L, D = reference.shape
    r = cdist(reference, reference)
    system = np.zeros((L + D + 1, L + D + 1))
    system[:L, :L] = -r if D == 3 else r**2 * np.log(np.where(r > 0, r, 1.0))
    system[:L, L], system[:L, L + 1 :] = 1.0, reference
    system[L:, :L] = system[:L, L:].T
    if pdist(reference).min(initial=np.inf) < _SAME * size:
        return np.asarray(np.linalg.pinv(system, rcond=_PSEUDO, hermitian=True)[:L, :L], dtype=np.float64)
    return np.asarray(np.linalg.inv(system)[:L, :L], dtype=np.float64)  # M5
