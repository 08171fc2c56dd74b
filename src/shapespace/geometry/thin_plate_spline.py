"""Thin-plate splines through landmarks in 2-D and 3-D, and their bending energy.

Bookstein, PAMI 11(6), 1989. The kernel is r^2 log r in 2-D and -r in 3-D, so that no bending energy is negative.
Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist, pdist

from shapespace.errors import InputError
from shapespace.types import FloatArray, read_only

_RANK = 1e-9  # ratio of singular values; landmarks nearer to a line or a plane than rounding determine no affine map
_SAME = 1e-12  # of the size; landmarks nearer to each other coincide up to float64 rounding
_PSEUDO = 1.5e-8  # of the largest singular value; smaller ones of a singular system are 0: the root of float64 rounding
_ROWS = 2**22  # kernel values in memory at once, 32 MiB


@dataclass(frozen=True, eq=False)
class ThinPlateSpline:
    """The map of least bending energy that takes L source landmarks to their targets.

    Args:
        source: (L, D) with D 2 or 3, centred and of unit centroid size, for accuracy.
        centre: (D,) that was subtracted.
        size: centroid size that was divided out.
        weights: (L, E) of the kernel at each landmark.
        affine: (D + 1, E) a constant, and a row for each axis of `source`.
    """

    source: FloatArray
    centre: FloatArray
    size: float
    weights: FloatArray
    affine: FloatArray

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
        solution = np.linalg.solve(_system(x), np.vstack([target, np.zeros((D + 1, target.shape[1]))]))  # M8
        return ThinPlateSpline(
            read_only(x), read_only(centre), size, read_only(solution[: len(x)]), read_only(solution[len(x) :])
        )

    def apply(self, points: FloatArray) -> FloatArray:
        """Return the (M, E) places to which the spline maps points (M, D)."""
        x = (points - self.centre) / self.size
        out = self.affine[0] + x @ self.affine[1:]
        step = max(1, _ROWS // len(self.source))
        for start in range(0, len(x), step):
            out[start : start + step] += _kernel(x[start : start + step], self.source) @ self.weights
        return out


def bending_energy_matrix(reference: FloatArray) -> FloatArray:
    """Return B (L, L), so that trace(y^T B y) is the bending energy of the spline from `reference` (L, D) to y (L, E).

    It is zero for affine maps. Landmarks that coincide have the same place in all maps.
    """
    size = max(float(np.linalg.norm(reference - reference.mean(axis=0))), 1e-300)
    system = _system(reference)
    L = len(reference)
    if pdist(reference).min(initial=np.inf) < _SAME * size:
        return np.asarray(np.linalg.pinv(system, rcond=_PSEUDO, hermitian=True)[:L, :L], dtype=np.float64)
    return np.asarray(np.linalg.inv(system)[:L, :L], dtype=np.float64)  # M5


def _kernel(points: FloatArray, source: FloatArray) -> FloatArray:
    r = cdist(points, source)
    return -r if source.shape[1] == 3 else r**2 * np.log(np.where(r > 0, r, 1.0))


def _system(x: FloatArray) -> FloatArray:
    L, D = x.shape
    system = np.zeros((L + D + 1, L + D + 1))
    system[:L, :L] = _kernel(x, x)
    system[:L, L], system[:L, L + 1 :] = 1.0, x
    system[L:, :L] = system[:L, L:].T
    return system
