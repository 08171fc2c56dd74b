"""Generalised Procrustes analysis: alignment of corresponding shapes to a common pose, with or without scale.

Gower, Psychometrika 40(1), 1975; Goodall, JRSS B 53(2), 1991. Equations Cn are those of docs/correspondence.md and
docs/missing.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.similarity import fit_rotations, fit_similarity
from shapespace.types import FloatArray, IntArray, Similarity

# limit of iterations to the tangent space, and relative change that ends these, near float64 rounding
_TANGENT_ROUNDS, _IN_TANGENT = 20, 1e-13
# relative change of the mean that ends the alignment, and limit of its iterations
_TOLERANCE, _MOST_ROUNDS = 1e-10, 100
_WEIGHTED_ROUNDS = 6  # iterations of a weighted alignment, which starts from the unweighted one
_LEAST_WEIGHT = 1e-3
"""Smallest weight, so that vertices that no shape observes have a mean."""

Gauge: TypeAlias = Literal["form", "shape"]
"""`form`: rigid alignment, size stays in the modes. `shape`: alignment with scale, size is divided out."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Result of generalised Procrustes analysis.

    Args:
        mean: (V, 3) mean shape, mm.
        iterations: number of iterations.
        converged: whether the mean converged; False if the limit of iterations was reached before.
    """

    mean: FloatArray
    iterations: int
    converged: bool


def centroid_size(shape: FloatArray) -> float:
    """Return the root of the summed squared distances of (V, 3) points from their centroid, mm."""
    return float(np.linalg.norm(shape - shape.mean(axis=0)))


def align_in_place(
    shapes: FloatArray,
    gauge: Gauge,
    *,
    alignment_vertices: IntArray | None = None,
    tolerance: float = _TOLERANCE,
    max_iterations: int = _MOST_ROUNDS,
    on_iteration: Callable[[int, float], None] | None = None,
) -> Alignment:
    """Align `shapes` (N, V, 3) to their common mean, overwriting them, and return that mean.

    The axes are those of the first shape, the origin is the centroid of the mean, and with the gauge `shape` every
    shape is scaled to the mean centroid size of the input shapes, so that the modes are in mm.

    Args:
        shapes: (N, V, 3) float64, writable, mm.
        gauge: size handling, `form` (rigid) or `shape` (with scale).
        alignment_vertices: indices of the vertices used for the alignment (the semi-rigid vertices for models of
            expressions); None for all.
        tolerance: movement of the mean that ends the iterations, as a share of its size (RMS).
        max_iterations: limit of the iterations.
        on_iteration: function that is called with the iteration and the movement of the mean, mm.

    Raises:
        InputError: the gauge is unknown, or the vertices for the alignment are fewer than three or do not exist.
    """
    chosen = check_alignment(gauge, alignment_vertices, shapes.shape[1])
    with_scale = gauge == "shape"
    sizes = [centroid_size(shape[chosen]) for shape in shapes]
    size = float(np.mean(sizes))
    if min(sizes) <= 0:
        raise InputError("All vertices of a training shape coincide, so it cannot be aligned; exclude it.")

    reference = mean = _start(shapes[0], chosen, size, with_scale)
    for iteration in range(1, max_iterations + 1):
        previous, mean = mean, np.zeros_like(mean)
        for index in range(len(shapes)):
            T_mean_shape = fit_similarity(shapes[index][chosen], previous[chosen], with_scale=with_scale)
            if with_scale:
                scale = size / centroid_size(shapes[index][chosen])
                centre = shapes[index][chosen].mean(axis=0)
                rotation = T_mean_shape.rotation
                T_mean_shape = Similarity(scale, rotation, -scale * rotation @ centre)  # C18
            shapes[index] = T_mean_shape.apply(shapes[index])
            mean += shapes[index]
        mean = _move_to_frame(mean / len(shapes), reference, chosen, size, with_scale)  # C19
        moved = float(np.sqrt(((mean - previous) ** 2).sum(axis=1).mean()))
        if on_iteration is not None:
            on_iteration(iteration, moved)
        if moved <= tolerance * size / np.sqrt(mean.shape[0]):
            break
    else:
        return Alignment(mean, max_iterations, converged=False)
    return Alignment(shapes.mean(axis=0), iteration, converged=True)


def align_shapes(shapes: FloatArray, gauge: Gauge, alignment_vertices: IntArray | None = None) -> FloatArray:
    """Align training `shapes` (N, V, 3) in place, as `align_in_place` and `scale_to_tangent` do, and return them."""
    align_in_place(shapes, gauge, alignment_vertices=alignment_vertices)
    # If only some vertices are used for the alignment, the size of the others belongs to the shape.
    if gauge == "shape" and alignment_vertices is None:
        scale_to_tangent(shapes)
    return shapes


def align_to_weighted_mean(shapes: FloatArray, weights: FloatArray, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `shapes` (N, V, 3) aligned to their weighted mean, and this mean (V, 3), aligned to `frame`.

    Unlike in `align_in_place`, each size is fitted, and vertices may be missing.

    Args:
        shapes: (N, V, 3) shapes in any poses and sizes.
        weights: (N, V) weights of the vertices, 0 to 1; poses are fitted to vertices with positive weight.
        frame: (V, 3) shape that determines the pose and size of the mean.
    """
    mean, aligned = frame, shapes
    floored = np.maximum(weights, _LEAST_WEIGHT)[:, :, None]
    for _ in range(_WEIGHTED_ROUNDS):
        poses = [fit_similarity(x[w > 0], mean[w > 0]) for x, w in zip(shapes, weights, strict=True)]  # C11
        aligned = np.stack([pose.apply(x) for pose, x in zip(poses, shapes, strict=True)])
        mean = (floored * aligned).sum(axis=0) / floored.sum(axis=0)  # C12
        mean = fit_similarity(mean, frame).apply(mean)
    return aligned, mean


def check_alignment(gauge: Gauge, alignment_vertices: IntArray | None, n_vertices: int) -> IntArray | slice:
    """Return an index of the vertices for the alignment among `n_vertices` vertices; of all if none are given.

    Raises:
        InputError: the gauge is unknown, or the vertices for the alignment are fewer than three or do not exist.
    """
    if gauge not in ("form", "shape"):
        raise InputError(f"There is no gauge {gauge!r}; choose form (rigid) or shape (with scale).")
    if alignment_vertices is None:
        return slice(None)
    if len(alignment_vertices) < 3:
        raise InputError("Alignment needs at least three vertices; give more vertices, or none to use all.")
    if not 0 <= np.min(alignment_vertices) <= np.max(alignment_vertices) < n_vertices:
        raise InputError(
            f"The vertices for the alignment are counted from 0 to {n_vertices - 1}, but a given index is "
            "outside this range; correct it."
        )
    return alignment_vertices


def _start(first: FloatArray, chosen: IntArray | slice, size: float, with_scale: bool) -> FloatArray:
    mean = first - first[chosen].mean(axis=0)
    return mean * (size / centroid_size(mean[chosen])) if with_scale else mean


def _move_to_frame(
    mean: FloatArray, reference: FloatArray, chosen: IntArray | slice, size: float, with_scale: bool
) -> FloatArray:
    if with_scale:
        mean = (mean - mean[chosen].mean(axis=0)) * (size / centroid_size(mean[chosen]))
    return fit_similarity(mean[chosen], reference[chosen], with_scale=False).apply(mean)


def scale_to_tangent(shapes: FloatArray) -> None:
    """Scale each of the aligned `shapes` (N, V, 3) in place to the tangent plane at their mean.

    Shapes of equal size are on a sphere. Because it is curved, they also vary along its radius, as if the mean were
    scaled. Scaled to the tangent plane at the mean they keep their shape, and no mode contains a scale (Dryden and
    Mardia, Statistical Shape Analysis, 2016, section 4.4).
    """
    flat = shapes.reshape(len(shapes), -1)
    mean = flat.mean(axis=0)
    for _ in range(_TANGENT_ROUNDS):
        along = flat @ mean / (mean @ mean)
        flat /= along[:, None]  # C20
        mean = flat.mean(axis=0)
        if np.abs(along - 1.0).max() < _IN_TANGENT:
            break


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses of shapes relative to the common mean: vertices x (row vectors) are mapped to x @ linear.T + offset.

    Args:
        linear: (N, 3, 3) rotations times scales.
        offset: (N, 3) translations, mm.
    """

    linear: FloatArray
    offset: FloatArray

    def apply(self, start: int, shapes: FloatArray) -> FloatArray:
        """Return `shapes` (n, V, 3), those with the indices from `start` on, in their poses."""
        part = slice(start, start + len(shapes))
        return shapes @ self.linear[part].transpose(0, 2, 1) + self.offset[part, None]


@dataclass(frozen=True, eq=False)
class Streamed:
    """Shapes that are read again in each pass, as differences from a template, so that they are not kept in memory.

    Args:
        blocks: function that yields (start, differences (n, 3V)) of all N shapes, in order, at each call.
        count: number of shapes, N.
        template: (V, 3) vertices of the template, mm.
        sizes: (N,) centroid size of the vertices of each shape that are used for the alignment, mm.
    """

    blocks: Callable[[], Iterable[tuple[int, FloatArray]]]
    count: int
    template: FloatArray
    sizes: FloatArray


def align_streamed(
    shapes: Streamed,
    gauge: Gauge,
    *,
    size: float,
    reference: FloatArray,
    alignment_vertices: IntArray | None = None,
    tolerance: float = _TOLERANCE,
    max_iterations: int = _MOST_ROUNDS,
    on_iteration: Callable[[int, float], None] | None = None,
) -> tuple[Alignment, Poses]:
    """Align shapes as `align_in_place` in one pass over `shapes` per iteration, and return poses instead of shapes.

    Args:
        shapes: N shapes in similar poses.
        gauge: size handling, `form` (rigid) or `shape` (with scale).
        size: mean centroid size of the input shapes, mm.
        reference: (V, 3) shape whose axes are used, the first input shape, mm.
        alignment_vertices: indices of the vertices used for the alignment; None for all.
        tolerance: movement of the mean that ends the iterations, as a share of its size (RMS).
        max_iterations: limit of the iterations.
        on_iteration: function that is called with the iteration and the movement of the mean, mm.

    Raises:
        InputError: a shape determines no rotation, or see `align_in_place`.
    """
    chosen = check_alignment(gauge, alignment_vertices, len(shapes.template))
    with_scale = gauge == "shape"
    reference = mean = _start(reference, chosen, size, with_scale)
    poses = Poses(np.empty((shapes.count, 3, 3)), np.empty((shapes.count, 3)))
    for iteration in range(1, max_iterations + 1):
        previous = mean
        centre = previous[chosen].mean(axis=0)
        target = np.zeros_like(previous)
        target[chosen] = previous[chosen] - centre

        def turned(
            start: int, products: FloatArray, centres: FloatArray, centre: FloatArray = centre
        ) -> tuple[FloatArray, FloatArray]:
            linear = fit_rotations(products, reject_lines=True)
            if with_scale:
                linear *= (size / shapes.sizes[start : start + len(linear)])[:, None, None]
            moved = np.einsum("nab,nb->na", linear, centres)
            return linear, -moved if with_scale else centre - moved  # C18

        unframed = _run_pass(shapes, target, chosen, poses, turned)
        mean = _move_to_frame(unframed, reference, chosen, size, with_scale)  # C19
        moved = float(np.sqrt(((mean - previous) ** 2).sum(axis=1).mean()))
        if on_iteration is not None:
            on_iteration(iteration, moved)
        if moved <= tolerance * size / np.sqrt(len(mean)):
            return Alignment(unframed, iteration, converged=True), poses
    return Alignment(mean, max_iterations, converged=False), poses


def scale_to_tangent_streamed(shapes: Streamed, mean: FloatArray, poses: Poses) -> FloatArray:
    """Scale shapes to the tangent plane as `scale_to_tangent`, by changing `poses`, and return their mean (V, 3).

    Args:
        shapes: N shapes.
        mean: (V, 3) mean of the shapes in `poses`, mm.
        poses: poses from `align_streamed`; they are changed.
    """
    for _ in range(_TANGENT_ROUNDS):
        furthest = 0.0
        target, total, square = mean, mean.sum(axis=0), float(np.vdot(mean, mean))

        def scaled(
            start: int,
            products: FloatArray,
            centres: FloatArray,
            total: FloatArray = total,
            square: float = square,
        ) -> tuple[FloatArray, FloatArray]:
            nonlocal furthest
            part = slice(start, start + len(products))
            linear, offset = poses.linear[part], poses.offset[part]
            along = (np.einsum("nba,nab->n", linear, products) + offset @ total) / square
            furthest = max(furthest, float(np.abs(along - 1.0).max()))
            return linear / along[:, None, None], offset / along[:, None]  # C20

        mean = _run_pass(shapes, target, slice(None), poses, scaled)
        if furthest < _IN_TANGENT:
            break
    return mean


def _run_pass(
    shapes: Streamed,
    target: FloatArray,
    chosen: IntArray | slice,
    poses: Poses,
    pose: Callable[[int, FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
) -> FloatArray:
    """Compute the poses of all shapes from their products with `target` (V, 3), and return their mean (V, 3).

    All operations are linear in the shapes, so a block takes two matrix products.

    Args:
        shapes: N shapes.
        target: (V, 3) factor of the products.
        chosen: indices of the vertices of the centroids.
        poses: output for the poses.
        pose: function (start, products x^T target (n, 3, 3), centroids (n, 3)) -> linear (n, 3, 3), offset (n, 3).
    """
    template, V = shapes.template, len(shapes.template)
    axes = np.eye(3)
    shares = np.zeros(V)
    shares[chosen] = 1.0 / len(template[chosen])
    columns = np.einsum("vb,ac->vcab", target, axes).reshape(3 * V, 9)
    columns = np.hstack([columns, np.einsum("v,ac->vca", shares, axes).reshape(3 * V, 3)])
    of_template = template.reshape(-1) @ columns
    summed = np.zeros((9, 3 * V))
    for start, block in shapes.blocks():
        moments = block @ columns + of_template
        part = slice(start, start + len(block))
        linear, offset = pose(start, moments[:, :9].reshape(-1, 3, 3), moments[:, 9:])
        poses.linear[part], poses.offset[part] = linear, offset
        summed += linear.reshape(-1, 9).T @ block
    out = np.einsum("bava->vb", summed.reshape(3, 3, V, 3))
    return np.asarray(
        (out + template @ poses.linear.sum(axis=0).T + poses.offset.sum(axis=0)) / shapes.count, dtype=np.float64
    )
