"""Rigid steps of the pose search: symmetric ICP from many poses at once, on grids of near points.

A grid holds a near point for each cell, so that a match is one look-up. Weights are Geman and McClure's, with a reach
that falls from step to step (graduated, as in Zhang, Yao and Deng, PAMI 44(7), 2022).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt

from shapespace.types import FloatArray, IntArray

# grid of near points: margin and cell as shares of the size, and memory limit (cells)
_MARGIN, _CELL, _MAX_CELLS = 0.5, 0.08, 400_000


class NearGrid(NamedTuple):
    """Grid with a near point for each cell.

    Args:
        near: (X, Y, Z) int32, for each cell, of the points that stand for a cell, that of the nearest such cell.
        points: (3, N) mm.
        origin: (3, 1) lowest corner, mm.
        cell: length of the edges of a cell, mm.
    """

    near: IntArray
    points: FloatArray
    origin: FloatArray
    cell: float

    @staticmethod
    def of(points: FloatArray, size: float) -> NearGrid:
        """Return the grid of `points` (N, 3) with cells that suit a model of `size` mm."""
        low, high = points.min(axis=0) - _MARGIN * size, points.max(axis=0) + _MARGIN * size
        cell = max(_CELL * size, edge_of(high - low, _MAX_CELLS))
        inside = (points - low) / cell
        # The point nearest to the middle of its cell stands for it, so it is written last.
        order = np.argsort(-((inside % 1.0 - 0.5) ** 2).sum(axis=1))
        holder = np.full(np.ceil((high - low) / cell).astype(int) + 1, -1, dtype=np.int32)
        holder[tuple(inside[order].astype(int).T)] = order
        nearest = distance_transform_edt(holder < 0, return_distances=False, return_indices=True)
        return NearGrid(holder[tuple(nearest)], np.ascontiguousarray(points.T), low[:, None], cell)

    def look_up(self, places: FloatArray) -> FloatArray:
        """Return a point near to each of `places` (S, 3, N), in the same order; outside the box that of its border."""
        _, ny, nz = self.near.shape
        cells = np.clip((places - self.origin) / self.cell, 0.0, np.array(self.near.shape)[:, None] - 1.0).astype(
            np.int32
        )
        nearest: IntArray = self.near.reshape(-1)[(cells[:, 0] * ny + cells[:, 1]) * nz + cells[:, 2]]
        return self.points.take(nearest, axis=1).transpose(1, 0, 2)


def edge_of(sides: FloatArray, cells: int) -> float:
    """Return the edge of `cells` cubes that fill a box of `sides` (3,)."""
    return float(sides.prod() / cells) ** (1 / 3)


def rigid_search(
    R: FloatArray,
    t: FloatArray,
    model: FloatArray,
    scan: FloatArray,
    model_grid: NearGrid,
    scan_grid: NearGrid,
    radii: FloatArray,
    cap: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rotations, translations and scores (S,), mm, of two-way rigid ICP from each of S poses.

    Args:
        R: (S, 3, 3) from the model's frame to the scan's.
        t: (S, 3).
        model: (M, 3) points of the model that look for the scan.
        scan: (N, 3) points of the scan that look for the model.
        model_grid: near points of the model, in its own frame.
        scan_grid: near points of the scan.
        radii: (I,) distance at which a match loses three quarters of its weight, for each iteration, mm.
        cap: distance beyond which a match counts no more in the score, mm.
    """
    for radius in radii:
        y, x, forward, backward = _matches(R, t, model, scan, model_grid, scan_grid)
        w, v = ((radius**2 / (radius**2 + squared)) ** 2 for squared in (forward, backward))
        total = (w.sum(axis=1) + v.sum(axis=1))[:, None]
        y, x = y * w[:, None], x * v[:, None]
        model_mean = (w @ model + x.sum(axis=2)) / total
        scan_mean = (y.sum(axis=2) + v @ scan) / total
        H = y @ model + (x @ scan).transpose(0, 2, 1)
        R = _best_rotations(H - (total * scan_mean)[:, :, None] * model_mean[:, None])
        t = scan_mean - (R @ model_mean[:, :, None])[:, :, 0]
    _, _, forward, backward = _matches(R, t, model, scan, model_grid, scan_grid)
    score = sum(np.minimum(np.sqrt(squared), cap).mean(axis=1) for squared in (forward, backward))
    return R, t, 0.5 * np.asarray(score)


def _matches(
    R: FloatArray, t: FloatArray, model: FloatArray, scan: FloatArray, model_grid: NearGrid, scan_grid: NearGrid
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return scan points near to `model`, (S, 3, M), model points near to `scan`, (S, 3, N), squared distances."""
    in_scan = R @ model.T + t[:, :, None]
    in_model = R.transpose(0, 2, 1) @ (scan.T - t[:, :, None])
    y, x = scan_grid.look_up(in_scan), model_grid.look_up(in_model)
    return y, x, ((in_scan - y) ** 2).sum(axis=1), ((in_model - x) ** 2).sum(axis=1)


def _best_rotations(H: FloatArray) -> FloatArray:
    """Return the rotations (S, 3, 3) that maximise trace(R^T H), H = sum target source^T.

    Source: Umeyama, PAMI 13(4), 1991.
    """
    U, _, Vt = np.linalg.svd(H)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt
