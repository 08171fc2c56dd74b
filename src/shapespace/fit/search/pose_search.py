"""Global pose search: many rotations on a coarse level, the best of them with scale and leading modes.

The mean shape alone cannot distinguish a face from the back of a bald head; the distance in both directions can, once
the leading modes of the model have adapted. So the number of poses is reduced in four steps, each slower and more
selective than the one before, by this distance. Lengths in the settings are shares of the model's size, so the search
works for any object.

Rigid steps are symmetric ICP from many poses at once, on grids of near points: a grid contains a near point for each
cell, so that a match is one look-up. Weights are those of Geman and McClure, with a reach that decreases from step to
step (graduated, as in Zhang, Yao and Deng, PAMI 44(7), 2022).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from shapespace.compiled import compiled
from shapespace.fit.search.shape_search import ShapePoints, shape_search
from shapespace.geometry.kdtree import KdTree
from shapespace.geometry.normals import rms_size, vertex_normals
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

# grid of near points: margin and cell as shares of the size, and memory limit (cells)
_MARGIN, _CELL, _MAX_CELLS = 0.5, 0.08, 400_000


class NearGrid(NamedTuple):
    """Grid with a near point for each cell.

    Args:
        near: (X, Y, Z) int32 index of a point for each cell: the representative of the nearest cell that contains
            points.
        points: (3, N) points of the grid, mm.
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
        # The point nearest to the middle of its cell represents it, so it is written last.
        order = np.argsort(-((inside % 1.0 - 0.5) ** 2).sum(axis=1))
        holder = np.full(np.ceil((high - low) / cell).astype(int) + 1, -1, dtype=np.int32)
        holder[tuple(inside[order].astype(int).T)] = order
        near = holder[tuple(distance_transform_edt(holder < 0, return_distances=False, return_indices=True))]
        return NearGrid(near, np.ascontiguousarray(points.T), low[:, None], cell)

    def look_up(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a point near to each of `places` (S, 3, N), and their squared distances (S, N).

        A place outside the grid has a point near the border.
        """
        near, squared = np.empty(places.shape), np.empty((places.shape[0], places.shape[2]))
        _look_up_into(self, places, near, squared)
        return near, squared


@compiled
def _look_up_into(grid: NearGrid, places: FloatArray, near_out: FloatArray, squared_out: FloatArray) -> None:
    """Write the results of `NearGrid.look_up`."""
    for s in range(len(places)):
        for i in range(places.shape[2]):
            x, y, z = places[s, 0, i], places[s, 1, i], places[s, 2, i]
            nearest = grid.near[
                int(min(max(0.0, (x - grid.origin[0, 0]) / grid.cell), grid.near.shape[0] - 1.0)),
                int(min(max(0.0, (y - grid.origin[1, 0]) / grid.cell), grid.near.shape[1] - 1.0)),
                int(min(max(0.0, (z - grid.origin[2, 0]) / grid.cell), grid.near.shape[2] - 1.0)),
            ]
            u, v, w = grid.points[0, nearest], grid.points[1, nearest], grid.points[2, nearest]
            near_out[s, 0, i], near_out[s, 1, i], near_out[s, 2, i] = u, v, w
            squared_out[s, i] = (x - u) * (x - u) + (y - v) * (y - v) + (z - w) * (z - w)


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
        R: (S, 3, 3) rotations from the model's frame to the scan's.
        t: (S, 3) translations.
        model: (M, 3) points of the model that are matched to the scan.
        scan: (N, 3) points of the scan that are matched to the model.
        model_grid: near points of the model, in its own frame.
        scan_grid: near points of the scan.
        radii: (I,) distance at which a match loses three quarters of its weight, for each iteration, mm.
        cap: distance at which matches are capped in the score, mm.
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
    y, forward = scan_grid.look_up(R @ model.T + t[:, :, None])
    x, backward = model_grid.look_up(R.transpose(0, 2, 1) @ (scan.T - t[:, :, None]))
    return y, x, forward, backward


def _best_rotations(H: FloatArray) -> FloatArray:
    """Return the rotations (S, 3, 3) that maximise trace(R^T H), H = sum target source^T.

    Source: Umeyama, PAMI 13(4), 1991.
    """
    U, _, Vt = np.linalg.svd(H)
    U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt


class SearchStep(NamedTuple):
    """Settings of one step of the search.

    Args:
        points: number of points of the model that are matched to the scan, and of the scan to the model.
        widest: reach of the weights in the first iteration, as a share of the model's size.
        narrowest: reach of the weights in the last iteration, as a share of the model's size.
        iterations: number of iterations; the reach decreases geometrically.
        modes: number of free modes.
        n_poses: number of distinct poses that are passed to the next step.
    """

    points: int
    widest: float
    narrowest: float
    iterations: int
    modes: int
    n_poses: int

    def reaches(self, size: float) -> FloatArray:
        """Return the reach in each iteration, mm."""
        return np.geomspace(self.widest * size, self.narrowest * size, self.iterations)


# Chosen on simulated scans of people who are not in the tests.
GLANCE = SearchStep(points=250, widest=0.3, narrowest=0.04, iterations=14, modes=10, n_poses=1)
FLIPS = SearchStep(points=90, widest=0.3, narrowest=0.06, iterations=6, modes=3, n_poses=1)
COARSE = SearchStep(points=250, widest=0.5, narrowest=0.1, iterations=10, modes=0, n_poses=30)
RIGID = SearchStep(points=500, widest=0.2, narrowest=0.06, iterations=14, modes=0, n_poses=24)
MIDDLE = SearchStep(points=200, widest=0.3, narrowest=0.06, iterations=12, modes=3, n_poses=5)
FINE = SearchStep(points=400, widest=0.1, narrowest=0.03, iterations=10, modes=10, n_poses=2)
LONG = SearchStep(points=400, widest=0.15, narrowest=0.03, iterations=30, modes=10, n_poses=4)
ROTATIONS = 96  # spread evenly over SO(3), about 55 degrees apart

_MODEL_CELL, _SCAN_CELL = 0.07, 0.04  # grid cells for thinning, as shares of the model's size
_MAX_THINNING_CELLS = 4_000_000  # memory limit
# largest distance that counts in the score, as shares of the model's size: rigid, and with shape
_RIGID_CAP, _CAP = 0.1, 0.06
_PRIOR = 10.0  # weight of the prior on the coefficients
_SCALE_STDDEV = 0.15  # standard deviation of the prior on the relative scale
# poses within 20 degrees and this share of the model's size count as the same
_SAME_TURN, _SAME_PLACE = math.cos(math.radians(20.0)), 0.3
_OTHER_TURN = math.cos(math.radians(40.0))  # alternatives to report differ by 40 degrees
# scores that end the search early: as a share of the cap, and of the best flipped pose
_CLEARLY_CLOSE, _CLEARLY_BETTER = 0.45, 0.75
_SURE = 0.85  # score relative to the runner-up below which no more iterations are run
_CLEARLY_WORSE, _WORTH = 0.93, 0.05  # how much worse an upright pose may score: ratio to the best, or share of the cap
_PARTIAL, _PARTS = 0.7, 6
"""Share of the model's area below which a scan is also placed at parts of the model, and the number of these parts."""
_MORE_ROUNDS = 3  # repetitions of the last step for ambiguous poses


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """A pose with adapted coefficients, and its score.

    Args:
        T_scan_model: similarity from the model's frame to the scan's, mm.
        b: (K,) coefficients of the leading modes, mm.
        score_mm: two-way distance, mm of the model, each match capped; infinite if no pose fits.
        covered: share of the model's points for which the scan has a point there.
    """

    T_scan_model: Similarity
    b: FloatArray
    score_mm: float
    covered: float


def search(
    model: ShapeModel, scan_vertices_mm: FloatArray, *, with_scale: bool, seed: int, quick: bool = False
) -> tuple[PoseCandidate, list[PoseCandidate]]:
    """Return the pose found without a rotation, and distinct poses of the complete search, best first.

    If the pose without a rotation is clearly right, only its likeliest confusions are tested; if no other pose is
    clearly better, it comes first.

    Args:
        model: the shape model.
        scan_vertices_mm: (S, 3) vertices of the scan, mm.
        with_scale: whether the pose has a free scale.
        seed: seed of the subsample that is searched.
        quick: whether ambiguous poses are refined once only, which is enough for a score.
    """
    sides = _Sides.of(model, scan_vertices_mm, with_scale, seed)
    upright = sides.upright()
    if sides.is_close(upright):
        flipped = sides.flips(upright)
        if upright.score_mm <= _CLEARLY_BETTER * min(pose.score_mm for pose in flipped):
            return upright, _best_distinct([upright, *flipped])
    return upright, sides.upright_unless_clearly_worse(upright, sides.everywhere(upright, quick=quick))


def refine(
    model: ShapeModel,
    scan_vertices_mm: FloatArray,
    starts: Sequence[Similarity],
    *,
    with_scale: bool,
    step: SearchStep = LONG,
    seed: int = 0,
) -> list[PoseCandidate]:
    """Return the poses after one step of the search from each of `starts`, in their order.

    Args:
        model: the shape model.
        scan_vertices_mm: (S, 3) vertices of the scan, mm.
        starts: poses to start from, from the model's frame to the scan's, mm.
        with_scale: whether the pose has a free scale.
        step: step of the search.
        seed: seed of the subsample that is searched.
    """
    sides = _Sides.of(model, scan_vertices_mm, with_scale, seed)
    return [sides.refined(step, T.rotation, T.translation, T.scale) for T in starts]


def _score(pose: PoseCandidate) -> float:
    return pose.score_mm


@dataclass(frozen=True, eq=False)
class _ModelSide:
    """Precomputed data of a model for the search."""

    size: float
    spacing: float
    shapes: dict[int, ShapePoints]
    grid: NearGrid
    outward: FloatArray
    front: float
    axes: FloatArray

    @staticmethod
    @cached_with_owner()
    def of(model: ShapeModel) -> _ModelSide:
        mean = np.array(model.mean_vertices)
        size = rms_size(mean)
        chosen = np.random.default_rng(0).permutation(_thin_evenly(mean, _MODEL_CELL * size, size))
        points = np.ascontiguousarray(mean[chosen])
        normals = _normals(points) if model.faces is None else vertex_normals(Mesh(mean, model.faces))[chosen]
        tree, shapes = KdTree(points).arrays, dict[int, ShapePoints]()
        rows = (3 * chosen[:, None] + np.arange(3)).ravel()
        for modes in {min(step.modes, model.n_modes) for step in (GLANCE, FLIPS, MIDDLE, FINE, LONG)}:
            basis = np.ascontiguousarray(model.vertex_basis[rows, :modes]).reshape(-1, 3, modes)
            precision = 1.0 / model.stddev[:modes] ** 2
            shapes[modes] = ShapePoints(points, np.ascontiguousarray(normals), basis, precision, tree)
        centre = points.mean(axis=0)
        # An open shell bulges away from the centre of the sphere that fits it best.
        columns = np.column_stack([2 * points, np.ones(len(points))])
        ball = np.asarray(np.linalg.lstsq(columns, (points**2).sum(axis=1), rcond=None)[0], dtype=np.float64)
        outward = centre - ball[:3]
        outward = outward / max(float(np.linalg.norm(outward)), 1e-12)
        return _ModelSide(
            size=size,
            spacing=1.2 * _MODEL_CELL * size,
            shapes=shapes,
            grid=NearGrid.of(points, size),
            outward=outward,
            front=float(np.quantile((points - centre) @ outward, 0.95)),
            axes=np.linalg.eigh((points - centre).T @ (points - centre))[1].T,
        )

    @property
    def points(self) -> FloatArray:
        return next(iter(self.shapes.values())).points


@dataclass(frozen=True, eq=False)
class _Sides:
    """A model and a scan with the data of their registration."""

    model: _ModelSide
    scan: FloatArray
    tree: KdTree
    slack: FloatArray
    with_scale: bool

    @staticmethod
    def of(model: ShapeModel, scan_mm: FloatArray, with_scale: bool, seed: int) -> _Sides:
        side = _ModelSide.of(model)
        scan_mm = np.array(scan_mm)
        cell = _SCAN_CELL * side.size
        scan = np.array(scan_mm[np.random.default_rng(seed).permutation(_thin_evenly(scan_mm, cell, side.size))])
        # A surface crosses about 1.5 cells per squared edge, so the coarser count determines the area.
        spacing = 2 * cell * math.sqrt(len(_thin_evenly(scan, 2 * cell, side.size)) / 1.5 / len(scan))
        slack = np.array([1.5 * max(spacing, 0.5 * side.spacing), 1.2 * side.spacing])
        return _Sides(side, scan, KdTree(scan), slack, with_scale)

    def upright(self) -> PoseCandidate:
        """Return the better of two poses without rotation: aligned centroids, or aligned outermost parts."""
        R, t = self._place_rotations(np.eye(3)[None])
        pose = self.refined(GLANCE, R[0], t[0])
        return pose if self.is_close(pose) else min(pose, self.refined(GLANCE, R[1], t[1]), key=_score)

    def is_close(self, pose: PoseCandidate) -> bool:
        """Return whether the score is so good that only flipped poses remain to be tested."""
        return pose.score_mm <= _CLEARLY_CLOSE * _CAP * self.model.size

    def flips(self, pose: PoseCandidate) -> list[PoseCandidate]:
        """Return the poses rotated by 180 degrees about each axis of the model, its likeliest confusions."""
        out: list[PoseCandidate] = []
        T, centre = pose.T_scan_model, self.model.points.mean(axis=0)
        for axis in self.model.axes:
            R = T.rotation @ (2 * np.outer(axis, axis) - np.eye(3))
            out.append(self.refined(FLIPS, R, T.apply(centre) - T.scale * R @ centre, T.scale))
        return out

    def everywhere(self, upright: PoseCandidate, *, quick: bool) -> list[PoseCandidate]:
        """Return distinct poses, best first, of a search over all rotations; `quick` as for `search`."""
        grid, size = NearGrid.of(self.scan, self.model.size), self.model.size
        R, t = self._place_rotations(_even_rotations(ROTATIONS))
        T = upright.T_scan_model
        R, t = np.concatenate([T.rotation[None], R]), np.concatenate([T.translation[None], t])
        for step in (COARSE, RIGID):
            R, t, score = rigid_search(
                R=R,
                t=t,
                model=self.model.points[: step.points],
                scan=self.scan[: step.points],
                model_grid=self.model.grid,
                scan_grid=grid,
                radii=step.reaches(size),
                cap=_RIGID_CAP * size,
            )
            order = np.argsort(score)
            kept_rows = order[_distinct_rows(R[order], t[order], step.n_poses, _SAME_TURN, _SAME_PLACE * size)]
            R, t = R[kept_rows], t[kept_rows]
        coarse = sorted((self.refined(MIDDLE, *start) for start in zip(R, t, strict=True)), key=_score)
        coarse = _select_distinct(coarse, len(coarse), _SAME_TURN)
        poses = [self._refine_again(FINE, pose) for pose in coarse[: MIDDLE.n_poses]]
        poses = sorted([upright, *poses], key=_score)
        poses = [self._refine_again(LONG, pose) for pose in poses[: FINE.n_poses]] + poses[FINE.n_poses :]
        distinct_poses = _best_distinct(poses)
        if quick:
            return distinct_poses
        if not _is_sure(distinct_poses):
            second_batch = coarse[MIDDLE.n_poses : 2 * MIDDLE.n_poses]
            poses = poses[: FINE.n_poses] + [
                self._refine_again(LONG, pose) for pose in [*poses[FINE.n_poses :], *second_batch]
            ]
            distinct_poses = _best_distinct(poses)
        # If a large part is missing, the model slides for many iterations before it converges.
        for _ in range(_MORE_ROUNDS):
            if _is_sure(distinct_poses):
                break
            distinct_poses = _best_distinct(
                [self._refine_again(LONG, pose) for pose in distinct_poses[: FINE.n_poses]]
                + distinct_poses[FINE.n_poses :]
            )
        return distinct_poses

    def upright_unless_clearly_worse(self, upright: PoseCandidate, ranked: list[PoseCandidate]) -> list[PoseCandidate]:
        """Return `ranked` with the pose nearest to `upright` first, unless the best is clearly better."""
        limit = max(ranked[0].score_mm / _CLEARLY_WORSE, ranked[0].score_mm + _WORTH * _CAP * self.model.size)
        similar = [pose for pose in ranked if len(_select_distinct([upright, pose], 2, _SAME_TURN)) == 1]
        first = min([upright, *similar], key=_score)
        if first.score_mm > limit:
            return ranked
        return _select_distinct([first, *ranked], LONG.n_poses, _OTHER_TURN)

    def _place_rotations(self, rotations: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return poses for each of `rotations` (N, 3, 3): with aligned centroids, and with aligned fronts.

        The centroid of a scan that shows a part of the model is also placed at those of parts all over the model.
        """
        centre, towards, points = self.scan.mean(axis=0), rotations @ self.model.outward, self.model.points
        translation = centre - rotations @ points.mean(axis=0)
        front_offset = np.quantile((self.scan[:1000] - centre) @ towards.T, 0.95, axis=0) - self.model.front
        translations = [translation, translation + front_offset[:, None] * towards]
        # Points fill nearly all cells of four spacings, even for a sparse scan: their number determines the area.
        cell, size = 4 / 1.5 * float(self.slack[0]), self.model.size
        share = len(_thin_evenly(self.scan, cell, size)) / len(_thin_evenly(points, cell, size))
        if share < _PARTIAL:
            translations += [centre - rotations @ part for part in _parts(points, round(share * len(points)))]
        return np.concatenate([rotations] * len(translations)), np.concatenate(translations)

    def _refine_again(self, step: SearchStep, pose: PoseCandidate) -> PoseCandidate:
        T = pose.T_scan_model
        return self.refined(step, T.rotation, T.translation, T.scale, pose.b)

    def refined(
        self, step: SearchStep, R: FloatArray, t: FloatArray, scale: float = 1.0, b: FloatArray | None = None
    ) -> PoseCandidate:
        """Return the pose after `step`, from a pose and the coefficients `b` of the leading modes."""
        start_pose = Similarity(scale, R, t)
        shape = self.model.shapes[min(step.modes, max(self.model.shapes))]
        R, t, out = np.array(R), np.array(t), np.empty(3)
        free = np.zeros(len(shape.precision))
        if b is not None:
            free[: len(b)] = b[: len(free)]
        counts = np.array([min(step.points, len(shape.points)), min(step.points, len(self.scan))], dtype=np.int32)
        scale = shape_search(
            R, t, scale, free, shape, self.scan, self.tree.arrays, counts, step.reaches(self.model.size), _PRIOR,
            1.0 / _SCALE_STDDEV**2 if self.with_scale else math.inf, self.slack, _CAP * self.model.size, out,
        )  # fmt: skip
        if not np.isfinite(out).all():
            return PoseCandidate(start_pose, np.zeros(len(free)), math.inf, 0.0)
        return PoseCandidate(Similarity(scale, R, t), free, 0.5 * float(out[0] + out[1]), float(out[2]))


def _parts(points: FloatArray, count: int) -> FloatArray:
    """Return (P, 3) centroids of parts of `count` points each, about points that lie far from each other."""
    seeds = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    while len(seeds) < _PARTS:
        seeds.append(int(np.linalg.norm(points[:, None] - points[seeds], axis=2).min(axis=1).argmax()))
    distance = np.linalg.norm(points[:, None] - points[seeds], axis=2)
    return np.stack([points[order[: max(count, 1)]].mean(axis=0) for order in distance.argsort(axis=0).T])


def _best_distinct(poses: Sequence[PoseCandidate]) -> list[PoseCandidate]:
    return _select_distinct(sorted(poses, key=_score), LONG.n_poses, _OTHER_TURN)


def _is_sure(poses: Sequence[PoseCandidate]) -> bool:
    return len(poses) < 2 or poses[0].score_mm <= _SURE * poses[1].score_mm


def _select_distinct(poses: Sequence[PoseCandidate], limit: int, same_turn: float) -> list[PoseCandidate]:
    """Return up to `limit` of `poses`, without rotations close to an earlier one."""
    R = np.stack([pose.T_scan_model.rotation for pose in poses])
    return [poses[i] for i in _distinct_rows(R, np.zeros((len(R), 3)), limit, same_turn, math.inf)]


def _distinct_rows(R: FloatArray, t: FloatArray, limit: int, same_turn: float, same_place: float) -> list[int]:
    cosine = 0.5 * (R.reshape(-1, 9) @ R.reshape(-1, 9).T - 1.0)
    distinct: list[int] = []
    for i in range(len(R)):
        is_near = np.linalg.norm(t[distinct] - t[i], axis=1) <= same_place
        if not (is_near & (cosine[i, distinct] >= same_turn)).any():
            distinct.append(i)
            if len(distinct) == limit:
                break
    return distinct


def _thin_evenly(points: FloatArray, cell: float, size: float) -> IntArray:
    """Return the indices of one point for each cell of edge `cell`; isolated points far outside are excluded."""
    columns = np.ascontiguousarray(points.T)
    low, high = np.quantile(columns[:, :: max(1, len(points) // 4000)], [0.005, 0.995], axis=1)
    low, high = np.maximum(columns.min(axis=1), low - size), np.minimum(columns.max(axis=1), high + size)
    cell = max(cell, edge_of(high - low + cell, _MAX_THINNING_CELLS))
    cells, dims = np.rint((columns - low[:, None]) / cell), np.rint((high - low) / cell) + 1
    inside = np.flatnonzero(((cells >= 0) & (cells < dims[:, None])).all(axis=0))
    cell_index = (cells[0] * dims[1] + cells[1])[inside] * dims[2] + cells[2, inside]
    cell_index = cell_index.astype(np.int64)
    holder = np.empty(int(dims.prod()), dtype=np.int64)
    holder[cell_index] = inside
    return inside[holder[cell_index] == inside].astype(np.int32)


def _normals(points: FloatArray) -> FloatArray:
    """Return the normals (N, 3) of `points`: the direction of least variance in each neighbourhood."""
    _, neighbours = cKDTree(points).query(points, k=min(9, len(points)))
    around = points[np.asarray(neighbours).reshape(len(points), -1)]
    around = around - around.mean(axis=1, keepdims=True)
    return np.linalg.eigh(around.transpose(0, 2, 1) @ around)[1][:, :, 0]


def _even_rotations(count: int) -> FloatArray:
    """Return (count, 3, 3) rotations spread evenly over SO(3): super-Fibonacci spirals (Alexa, CVPR 2022)."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / math.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    x, y, z, w = inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
