"""Generalised Procrustes: bring corresponding shapes into one pose, in a stated gauge.

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

# limit of iterations to the tangent space, and the relative change that ends them, near float64 rounding
_TANGENT_ROUNDS, _IN_TANGENT = 20, 1e-13
# relative change of the mean that ends the alignment, and the limit of its iterations
_TOLERANCE, _MOST_ROUNDS = 1e-10, 100
_WEIGHTED_ROUNDS = 6  # iterations of a weighted alignment, which starts from the unweighted one
_LEAST_WEIGHT = 1e-3
"""So that a vertex that no shape observes has a mean."""

Gauge: TypeAlias = Literal["form", "shape"]
"""`form`: rigid alignment, size stays in the modes. `shape`: alignment with scale, size is divided out."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The outcome of generalised Procrustes.

    Args:
        mean: (V, 3) mean shape, mm.
        iterations: rounds until the mean stood still.
        converged: False when the cap came first.
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

    The frame is the first shape's orientation, the origin is the mean's centroid, and in the `shape` gauge every
    shape is scaled to the mean centroid size of the shapes as given, so that the modes stay in mm.

    Args:
        shapes: (N, V, 3) float64, writable, mm.
        gauge: `form` or `shape`.
        alignment_vertices: indices of the vertices that carry the alignment (the semi-rigid ones for models of
            expressions); None for all.
        tolerance: stop when the mean moves less than this share of its size (RMS).
        max_iterations: cap.
        on_iteration: called with the round and the movement of the mean in mm.

    Raises:
        InputError: unknown gauge, fewer than three vertices to align by, or some that do not exist.
    """
    chosen = check_alignment(gauge, alignment_vertices, shapes.shape[1])
    with_scale = gauge == "shape"
    sizes = [centroid_size(shape[chosen]) for shape in shapes]
    size = float(np.mean(sizes))
    if min(sizes) <= 0:
        raise InputError("All vertices of a training shape coincide, so it cannot be aligned; leave it out.")

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
        mean = _in_frame(mean / len(shapes), reference, chosen, size, with_scale)  # C19
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
    # Where only some vertices carried the alignment, the size of the others is shape.
    if gauge == "shape" and alignment_vertices is None:
        scale_to_tangent(shapes)
    return shapes


def align_to_weighted_mean(shapes: FloatArray, weights: FloatArray, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `shapes` (N, V, 3) in the pose and size of their weighted mean, and the mean (V, 3) in those of `frame`.

    Unlike in `align_in_place`, each size is fitted, and vertices may be missing.

    Args:
        shapes: in any poses and sizes.
        weights: (N, V) of the vertices, 0 to 1; poses are fitted to those above 0.
        frame: (V, 3) the shape whose pose and size the mean has.
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
    """Return the index of the vertices that carry the alignment, of `n_vertices`.

    Raises:
        InputError: unknown gauge, fewer than three vertices to align by, or some that do not exist.
    """
    if gauge not in ("form", "shape"):
        raise InputError(f"There is no gauge {gauge!r}; choose form (rigid) or shape (with scale).")
    if alignment_vertices is None:
        return slice(None)
    if len(alignment_vertices) < 3:
        raise InputError("Alignment needs at least three vertices; give more of them, or none to use all.")
    if not 0 <= np.min(alignment_vertices) <= np.max(alignment_vertices) < n_vertices:
        raise InputError(
            f"The vertices that carry the alignment are counted from 0 to {n_vertices - 1}, but one of those "
            "given lies outside; check them."
        )
    return alignment_vertices


def _start(first: FloatArray, chosen: IntArray | slice, size: float, with_scale: bool) -> FloatArray:
    mean = first - first[chosen].mean(axis=0)
    return mean * (size / centroid_size(mean[chosen])) if with_scale else mean


def _in_frame(
    mean: FloatArray, reference: FloatArray, chosen: IntArray | slice, size: float, with_scale: bool
) -> FloatArray:
    if with_scale:
        mean = (mean - mean[chosen].mean(axis=0)) * (size / centroid_size(mean[chosen]))
    return fit_similarity(mean[chosen], reference[chosen], with_scale=False).apply(mean)


def scale_to_tangent(shapes: FloatArray) -> None:
    """Scale each of the aligned `shapes` (N, V, 3) in place so that none varies along the mean.

    Shapes of one size lie on a sphere, so to second order they vary along its radius, which is what a scaling does to
    the mean. In the tangent plane at the mean they are the same shapes, and no mode can be separated from the scale of
    a pose (Dryden and Mardia, Statistical Shape Analysis, 2016, section 4.4).
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
    """What brings each shape to the common mean: its vertices x (row vectors) go to x @ linear.T + offset.

    Args:
        linear: (N, 3, 3) rotations times scales.
        offset: (N, 3) mm.
    """

    linear: FloatArray
    offset: FloatArray

    def apply(self, start: int, shapes: FloatArray) -> FloatArray:
        """Return `shapes` (n, V, 3), which are those from `start` on, in their poses."""
        part = slice(start, start + len(shapes))
        return shapes @ self.linear[part].transpose(0, 2, 1) + self.offset[part, None]


@dataclass(frozen=True, eq=False)
class Streamed:
    """Shapes that are read again for each pass, as differences from one template, so that they need not be held.

    Args:
        blocks: gives (start, differences (n, 3V)) of all N shapes, in order, whenever it is called.
        count: N.
        template: (V, 3) mm.
        sizes: (N,) centroid size, mm, of each shape's vertices that carry the alignment.
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
    """Do what `align_in_place` does, one pass over `shapes` a round, and return the poses instead of the shapes.

    Args:
        shapes: N of them, in poses near to one another.
        gauge: `form` or `shape`.
        size: the mean centroid size of the shapes as given, mm.
        reference: (V, 3) whose orientation is the frame: the first shape as given.
        alignment_vertices: as of `align_in_place`.
        tolerance: as of `align_in_place`.
        max_iterations: cap.
        on_iteration: called with the round and the movement of the mean in mm.

    Raises:
        InputError: as `align_in_place`, or a shape that determines no rotation.
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
            linear = fit_rotations(products, refuse_lines=True)
            if with_scale:
                linear *= (size / shapes.sizes[start : start + len(linear)])[:, None, None]
            moved = np.einsum("nab,nb->na", linear, centres)
            return linear, -moved if with_scale else centre - moved  # C18

        unframed = _pass(shapes, target, chosen, poses, turned)
        mean = _in_frame(unframed, reference, chosen, size, with_scale)  # C19
        moved = float(np.sqrt(((mean - previous) ** 2).sum(axis=1).mean()))
        if on_iteration is not None:
            on_iteration(iteration, moved)
        if moved <= tolerance * size / np.sqrt(len(mean)):
            return Alignment(unframed, iteration, converged=True), poses
    return Alignment(mean, max_iterations, converged=False), poses


def scale_to_tangent_streamed(shapes: Streamed, mean: FloatArray, poses: Poses) -> FloatArray:
    """Do what `scale_to_tangent` does to shapes in `poses`, which are changed, and return their mean (V, 3).

    Args:
        shapes: N of them.
        mean: (V, 3) of them in their poses.
        poses: as `align_streamed` returned them.
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

        mean = _pass(shapes, target, slice(None), poses, scaled)
        if furthest < _IN_TANGENT:
            break
    return mean


def _pass(
    shapes: Streamed,
    target: FloatArray,
    chosen: IntArray | slice,
    poses: Poses,
    pose: Callable[[int, FloatArray, FloatArray], tuple[FloatArray, FloatArray]],
) -> FloatArray:
    """Pose all shapes by their products with `target` (V, 3), and return the mean (V, 3) in these poses.

    All is linear in the shapes, so that a block takes two products of matrices.

    Args:
        shapes: N of them.
        target: (V, 3).
        chosen: vertices of which centroids are taken.
        poses: written to.
        pose: (start, products x^T target (n, 3, 3), centroids (n, 3)) -> linear (n, 3, 3), offset (n, 3).
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
