"""Generalised Procrustes: bring corresponding shapes into one pose, in a stated gauge.

Gower, Psychometrika 40(1), 1975; Goodall, JRSS B 53(2), 1991.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, IntArray, Similarity

_TANGENT_ROUNDS, _IN_TANGENT = 20, 1e-13

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
    tolerance: float = 1e-10,
    max_iterations: int = 100,
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
    if gauge not in ("form", "shape"):
        raise InputError(f"There is no gauge {gauge!r}; choose form (rigid) or shape (with scale).")
    chosen: IntArray | slice = slice(None) if alignment_vertices is None else alignment_vertices
    if alignment_vertices is not None and len(alignment_vertices) < 3:
        raise InputError("Alignment needs at least three vertices; give more of them, or none to use all.")
    if alignment_vertices is not None and not (
        0 <= np.min(alignment_vertices) <= np.max(alignment_vertices) < shapes.shape[1]
    ):
        raise InputError(
            f"The vertices that carry the alignment are counted from 0 to {shapes.shape[1] - 1}, but one of those "
            "given lies outside; check them."
        )
    with_scale = gauge == "shape"
    sizes = [centroid_size(shape[chosen]) for shape in shapes]
    size = float(np.mean(sizes))
    if min(sizes) <= 0:
        raise InputError("All vertices of a training shape coincide, so it cannot be aligned; leave it out.")

    mean = shapes[0] - shapes[0][chosen].mean(axis=0)
    if with_scale:
        mean = mean * (size / centroid_size(mean[chosen]))
    reference = mean
    for iteration in range(1, max_iterations + 1):
        previous, mean = mean, np.zeros_like(mean)
        for index in range(len(shapes)):
            T_mean_shape = fit_similarity(shapes[index][chosen], previous[chosen], with_scale=with_scale)
            if with_scale:
                scale = size / centroid_size(shapes[index][chosen])
                centre = shapes[index][chosen].mean(axis=0)
                rotation = T_mean_shape.rotation
                T_mean_shape = Similarity(scale, rotation, -scale * rotation @ centre)
            shapes[index] = T_mean_shape.apply(shapes[index])
            mean += shapes[index]
        mean /= len(shapes)
        if with_scale:
            mean = (mean - mean[chosen].mean(axis=0)) * (size / centroid_size(mean[chosen]))
        T_reference_mean = fit_similarity(mean[chosen], reference[chosen], with_scale=False)
        mean = T_reference_mean.apply(mean)
        moved = float(np.sqrt(((mean - previous) ** 2).sum(axis=1).mean()))
        if on_iteration is not None:
            on_iteration(iteration, moved)
        if moved <= tolerance * size / np.sqrt(mean.shape[0]):
            break
    else:
        return Alignment(mean, max_iterations, converged=False)
    return Alignment(shapes.mean(axis=0), iteration, converged=True)


def scale_to_tangent(shapes: FloatArray) -> None:
    """Scale each of the aligned `shapes` (N, V, 3) in place so that none varies along the mean.

    Shapes of one size lie on a sphere, so to second order they vary along its radius, which is what a scaling does to
    the mean. In the tangent plane at the mean they are the same shapes, and no mode can be told from the scale of a
    pose (Dryden and Mardia, Statistical Shape Analysis, 2016, section 4.4).
    """
    flat = shapes.reshape(len(shapes), -1)
    mean = flat.mean(axis=0)
    for _ in range(_TANGENT_ROUNDS):
        along = flat @ mean / (mean @ mean)
        flat /= along[:, None]
        mean = flat.mean(axis=0)
        if np.abs(along - 1.0).max() < _IN_TANGENT:
            break
