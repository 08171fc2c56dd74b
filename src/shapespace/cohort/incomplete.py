"""Shapes with missing vertices in a cohort: estimates by PCA with missing data, with the mask of observed vertices.

The estimates depend on the shapes alone, never on the table, so that permutations of its rows stay exchangeable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import spsolve

from shapespace.cohort.table import list_names
from shapespace.errors import InputError
from shapespace.geometry.procrustes import Gauge, centroid_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.missing import MIN_SEEN, complete
from shapespace.model.ppca import ppca
from shapespace.types import BoolArray, FloatArray, IntArray, Similarity

_FEWEST_SHAPES = 2
"""Fewest shapes that must observe a vertex; a single one shows no variation."""
_FEWEST_VERTICES = 3
"""Fewest observed vertices of a shape, which determine its pose."""
_MODES_A_SHAPE, _MOST_MODES = 0.7, 60
"""As in `complete`: the prior removes modes without evidence."""
# iterations of pose and completion, and the movement that ends them, as a share of the centroid size
_POSES, _SETTLED = 50, 1e-9
_ANCHOR = 1e-9
"""Weight of the centroid where vertices without any position are filled: it makes isolated parts determinate."""


@dataclass(frozen=True, eq=False)
class ImputedShapes:
    """Aligned shapes with estimates at missing vertices.

    Args:
        shapes: (N, V, 3) mm; vertices that are not analysed have one position in all shapes.
        sizes_mm: (N,) centroid sizes of the analysed vertices, before alignment.
        observed: (N, V).
        analysed: (V,) False for vertices that too few shapes observe.
    """

    shapes: FloatArray
    sizes_mm: FloatArray
    observed: BoolArray
    analysed: BoolArray


def completed_shapes(
    shapes: FloatArray,
    observed: BoolArray,
    names: Sequence[str],
    gauge: Gauge,
    faces: IntArray | None,
    *,
    align: bool,
) -> ImputedShapes:
    """Align shapes by generalised Procrustes with missing vertices at their conditional means (see `complete`).

    Vertices that fewer than `MIN_SEEN` of the shapes, or fewer than two, observe carry no variation.

    Args:
        shapes: (N, V, 3) vertices, mm; any value if not observed, NaN included.
        observed: (N, V) whether each vertex is observed.
        names: names of the N shapes.
        gauge: size handling, see `align_in_place`.
        faces: (F, 3) triangles; None for points.
        align: whether to align the shapes; otherwise they are used unchanged.

    Raises:
        InputError: too little of a shape is observed to align it, or no vertex is observed often enough.
    """
    analysed = observed.sum(axis=0) >= max(MIN_SEEN * len(shapes) * (1 - 1e-12), _FEWEST_SHAPES)
    known = observed & analysed
    _check_observed(known, names)
    masked = np.where(known[:, :, None], shapes, np.nan)[:, analysed]
    completion = complete(masked, names, gauge, align=align)
    # Poses of the original shapes, which determine size and other vertices, do not depend on estimates.
    poses = [
        fit_similarity(masked_shape[is_observed], aligned[is_observed], with_scale=align and gauge == "shape")
        if align
        else None
        for masked_shape, aligned, is_observed in zip(masked, completion.shapes, completion.observed, strict=True)
    ]
    scales = np.array([1.0 if T is None else T.scale for T in poses])
    sizes = np.array([centroid_size(shape) for shape in completion.shapes]) / scales
    out = np.empty_like(shapes)
    out[:, analysed] = completion.shapes
    if not analysed.all():
        # Positions that are not observed may be anything: other programs write zeros there.
        masked_shapes = np.where(observed[:, :, None], shapes, np.nan)
        posed = np.stack([x if T is None else T.apply(x) for T, x in zip(poses, masked_shapes, strict=True)])
        out[:, ~analysed] = _one_position(posed, completion.shapes.mean(axis=0), analysed, faces)
    return ImputedShapes(out, sizes, known, analysed)


def completed_parts(
    shapes: FloatArray, observed: BoolArray, names: Sequence[str], parts: Mapping[str, int]
) -> ImputedShapes:
    """Complete shapes of several parts in their own poses: each part in its own frame, then parts that are missing.

    A shape lacks a part of which it shows less than `MIN_SEEN`; such parts are estimated from the others.

    Args:
        shapes: (N, V, 3) vertices, mm; any value if not observed.
        observed: (N, V) whether each vertex is observed.
        names: names of the N shapes.
        parts: name -> number of vertices of each part.

    Raises:
        InputError: most shapes lack a part, or too little of a shape is observed.
    """
    out, known, analysed = shapes.copy(), observed.copy(), np.ones(shapes.shape[1], dtype=np.bool_)
    present, start = np.zeros_like(observed), 0
    for part, count in parts.items():
        own = slice(start, start + count)
        rows: list[int] = np.flatnonzero(observed[:, own].mean(axis=1) >= MIN_SEEN).tolist()
        if len(rows) < max(MIN_SEEN * len(shapes), _FEWEST_SHAPES):
            raise InputError(
                f"The part {part} is missing in {len(shapes) - len(rows)} of {len(shapes)} shapes, which is more than "
                "half; exclude the part, or give more shapes that have it."
            )
        present[rows, own] = True
        start += count
        if observed[rows, own].all():
            continue
        part_names = [names[row] for row in rows]
        completed = completed_shapes(out[rows, own], observed[rows, own], part_names, "form", None, align=True)
        known[rows, own], analysed[own] = completed.observed, completed.analysed
        for row, shape, seen in zip(rows, completed.shapes, completed.observed, strict=True):
            there = np.arange(own.start, own.stop)[seen]
            out[row, own] = fit_similarity(shape[seen], out[row, there], with_scale=False).apply(shape)
    known &= present
    if not present.all():
        out = completed_shapes(out, present, names, "form", None, align=True).shapes
    return ImputedShapes(out, np.array([centroid_size(shape) for shape in out]), known & analysed, analysed)


def _check_observed(known: BoolArray, names: Sequence[str]) -> None:
    if not known.any():
        raise InputError(
            f"No vertex is observed by {100 * MIN_SEEN:g} % of the shapes and two shapes, so nothing can be compared; "
            "give shapes with fewer missing vertices."
        )
    too_sparse = [name for name, row in zip(names, known, strict=True) if row.sum() < _FEWEST_VERTICES]
    if too_sparse:
        raise InputError(f"{list_names(too_sparse)}: too few vertices are observed; exclude it.")


def _one_position(shapes: FloatArray, mean: FloatArray, analysed: BoolArray, faces: IntArray | None) -> FloatArray:
    """Return one position (M, 3) per excluded vertex: the mean of the observed positions, or a harmonic interpolation.

    Args:
        shapes: (N, V, 3) shapes as given, aligned; NaN if not observed.
        mean: (A, 3) mean of the analysed vertices.
        analysed: (V,) whether each vertex is analysed.
        faces: (F, 3) triangles; None for points.
    """
    is_complete: BoolArray = np.logical_and.reduce(np.isfinite(shapes), axis=2)
    count = is_complete.sum(axis=0)
    position = np.where(is_complete[:, :, None], shapes, 0.0).sum(axis=0) / np.maximum(count, 1)[:, None]
    position[analysed] = mean
    empty = (count == 0) & ~analysed
    if empty.any():
        position[empty] = _harmonic(position, empty, faces, mean.mean(axis=0))
    return position[~analysed]


def _harmonic(position: FloatArray, empty: BoolArray, faces: IntArray | None, centre: FloatArray) -> FloatArray:
    """Return the positions (E, 3) of `empty` vertices at the mean of their neighbours."""
    n = len(position)
    edges = np.zeros((0, 2), dtype=np.int32) if faces is None else np.vstack([faces[:, [0, 1]], faces[:, [1, 2]],
                                                                            faces[:, [2, 0]]])  # fmt: skip
    directed_edges = np.vstack([edges, edges[:, ::-1]])
    links = coo_matrix(
        (np.ones(len(directed_edges)), (directed_edges[:, 0], directed_edges[:, 1])), shape=(n, n)
    ).tocsr()
    laplacian = (diags(np.asarray(links.sum(axis=1)).ravel() + _ANCHOR) - links).tocsr()
    right = -(laplacian[empty][:, ~empty] @ position[~empty]) + _ANCHOR * centre
    return np.asarray(spsolve(laplacian[empty][:, empty].tocsc(), right), dtype=np.float64).reshape(-1, 3)


def complete_by_population(
    population: FloatArray,
    mean: FloatArray,
    shapes: FloatArray,
    observed: BoolArray,
    names: Sequence[str],
    gauge: Gauge,
) -> FloatArray:
    """Return shapes in their own poses with missing vertices at conditional means given a population.

    Args:
        population: (N, V, 3) complete aligned shapes, mm.
        mean: (V, 3) mean of the population.
        shapes: (M, V, 3) vertices of the shapes in any poses.
        observed: (M, V) whether each vertex is observed.
        names: names of the M shapes.
        gauge: size handling; `shape` aligns with scale.

    Raises:
        InputError: too few vertices of a shape are observed.
    """
    _check_observed(observed, names)
    all_observed = np.ones(population.shape[:2], dtype=np.bool_)
    modes = max(1, min(round(_MODES_A_SHAPE * len(population)), _MOST_MODES, len(population) - 2))
    model = ppca(population.copy(), all_observed, modes)
    out = shapes.copy()
    for row, (shape, is_observed) in enumerate(zip(shapes, observed, strict=True)):
        if is_observed.all():
            continue
        W = model.W[is_observed][:, :, :modes].reshape(-1, modes)
        precision = W.T @ W + model.noise * np.eye(modes)
        T = fit_similarity(shape[is_observed], mean[is_observed], with_scale=gauge == "shape")
        y = np.zeros(modes)
        for _ in range(_POSES):
            placed = T.apply(shape[is_observed])
            y = np.linalg.solve(precision, W.T @ (placed - model.W[is_observed][:, :, modes]).reshape(-1))
            completed = model.W @ np.append(y, 1.0)
            completed[is_observed] = placed
            previous, T = T, _pose(completed, mean, gauge) @ T
            points = shape[is_observed]
            if np.abs(previous.apply(points) - T.apply(points)).max() <= _SETTLED * centroid_size(mean):
                break
        out[row, ~is_observed] = T.inverse().apply(model.W[~is_observed] @ np.append(y, 1.0))
    return out


def _pose(shape: FloatArray, mean: FloatArray, gauge: Gauge) -> Similarity:
    return fit_similarity(shape, mean, with_scale=gauge == "shape")
