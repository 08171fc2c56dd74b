"""Models of shapes with missing vertices, which are not-a-number.

Poses need whole shapes: what is aligned by the parts that happen to be there leans towards them. So shapes are
completed by probabilistic PCA, aligned as whole shapes are, and completed anew, the last time with all modes that so
many shapes determine. The modes are then those of the completed shapes, with the conditional covariance of the missing
vertices added to their covariance, so that holes neither narrow nor bend them. Equations Cn are those of
docs/missing.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import pairs_of_triangles
from shapespace.geometry.normals import part_of
from shapespace.geometry.procrustes import Gauge, align_shapes, centroid_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.choose_modes import number_of_modes
from shapespace.model.krylov import largest_eigenpairs
from shapespace.model.pca import (
    Modes,
    PrincipalComponents,
    checked_modes,
    fix_signs,
    modes_for_variance,
    principal_components,
)
from shapespace.model.ppca import Ppca, ppca
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity, SurfaceLandmarks

MIN_SEEN = 0.5
"""Share of the shapes that must observe a vertex for it to be in a model, by default."""
_FEWEST = 2  # shapes that must observe a vertex: fewer have no variance
_POSES_BY = (8, 60)
"""Modes of the completions that poses are taken from, one after the other: with few only, variation that they lack
becomes pose, and alignment then removes real modes."""
_MODES_A_SHAPE, _MOST_MODES = 0.7, 60
"""Modes that probabilistic PCA begins with; those without evidence lose their width."""
# limit of the iterations of the mean, and the change as a share of the size that ends them
_MEAN_ROUNDS, _STILL = 50, 1e-8


def _observed(shapes: FloatArray) -> BoolArray:
    return ~np.logical_or.reduce(np.isnan(shapes), axis=2)


@dataclass(frozen=True, eq=False)
class ObservedMeshes:
    """Corresponding meshes without the vertices that few of them observe.

    Args:
        meshes: N, with the observed vertices and the triangles between them.
        vertices: (V,) True for each vertex that is used.
    """

    meshes: Sequence[Mesh]
    vertices: BoolArray

    @staticmethod
    def of(meshes: Sequence[Mesh], min_seen: float) -> ObservedMeshes:
        """Return the meshes with the vertices that at least the share `min_seen` of them, and two, observe.

        Raises:
            InputError: a share outside (0, 1], a mesh with no observed vertex, or no vertex that enough meshes observe.
        """
        if not 0 < min_seen <= 1:
            raise InputError(f"The share of meshes that show a vertex lies above 0 and at most at 1, not {min_seen:g}.")
        observed = _observed(np.stack([mesh.vertices for mesh in meshes]))
        if observed.all():
            return ObservedMeshes(meshes, observed[0])
        for mesh, own in zip(meshes, observed, strict=True):
            if not own.any():
                raise InputError(f"{mesh.name}: all of its vertices are missing; leave it out.")
        used = observed.sum(axis=0) >= max(min_seen * len(meshes) * (1 - 1e-12), _FEWEST)
        pairs = None if meshes[0].faces is None else pairs_of_triangles(meshes[0].faces, len(used))
        if pairs is not None:
            used &= used[pairs]  # a symmetric template stays one
        if not used.any():
            raise InputError(
                f"No vertex is observed by {100 * min_seen:g} % of the meshes and two of them, so nothing varies that "
                "could be learnt; give a smaller --min-seen (min_seen) or meshes with fewer missing vertices."
            )
        if used.all():
            return ObservedMeshes(meshes, used)
        return ObservedMeshes([part_of(mesh, used) for mesh in meshes], used)

    def regions(self, regions: Mapping[str, IntArray]) -> dict[str, IntArray]:
        """Return the observed vertices of each region, in new numbers; regions without any are left out."""
        number = np.cumsum(self.vertices, dtype=np.int32) - 1
        return {name: number[own[self.vertices[own]]] for name, own in regions.items() if self.vertices[own].any()}

    def landmarks(self, landmarks: Mapping[str, int]) -> SurfaceLandmarks:
        """Return the landmarks whose vertices are all used, in their new numbers.

        Raises:
            InputError: a landmark on a vertex that the meshes do not have.
        """
        given = SurfaceLandmarks.of(landmarks)
        given.check(len(self.vertices))
        return given.renumbered(self.vertices)

    def notes(self, min_seen: float, landmarks: Mapping[str, int]) -> list[str]:
        """Return which vertices, and which of the `landmarks` of the meshes, are not used since few observe them."""
        out, lost = int((~self.vertices).sum()), sorted(set(landmarks) - set(self.landmarks(landmarks)))
        number = "1 vertex is" if out == 1 else f"{out} vertices are"
        notes = [
            f"{number} taken out of the model, since fewer than {100 * min_seen:g} % of the meshes show them; "
            "--min-seen says how many must."
        ]
        of_landmarks = (
            f"The model has no {', '.join(lost)}, since these landmarks lie in triangles with vertices that are taken "
            "out."
        )
        return [*(notes if out else []), *([of_landmarks] if lost else [])]

    def indices(self, vertices: IntArray | None) -> IntArray | None:
        """Return those of `vertices` that are used, in their new numbers; None stays None."""
        if vertices is None or self.vertices.all():
            return vertices
        chosen = np.asarray(vertices)
        number = (np.cumsum(self.vertices) - 1).astype(np.int32)
        return number[chosen[self.vertices[chosen]]]


def missing_notes(meshes: Sequence[Mesh]) -> list[str]:
    """Return how many vertices of corresponding meshes are missing, in a sentence, if there are any."""
    holed = [int(np.isnan(mesh.vertices).any(axis=1).sum()) for mesh in meshes]
    if not any(holed):
        return []
    missing, every, where = sum(holed), len(meshes) * len(meshes[0].vertices), sum(count > 0 for count in holed)
    share = 100 * missing / every
    return [f"{missing} of {every} vertices are missing ({share:.1f} %), in {where} of {len(meshes)} meshes."]


@dataclass(frozen=True, eq=False)
class CompletedShapes:
    """Aligned shapes with their missing vertices at the conditional means, and the uncertainty of these.

    Args:
        shapes: (N, V, 3) mm.
        observed: (N, V).
        fitted: the probabilistic PCA that completed them.
    """

    shapes: FloatArray
    observed: BoolArray
    fitted: Ppca

    def components(self, modes: Modes, seed: int) -> PrincipalComponents:
        """Return mean and modes, as `principal_components` does of whole shapes.

        Raises:
            InputError: no variation.
        """
        n = len(self.shapes)
        data = self.shapes.reshape(n, -1)
        modes = checked_modes(number_of_modes(modes, data, seed, self.observed), n)
        components = principal_components(data)
        conditional, total = self._conditional_covariance(components.basis)
        variance, vectors = largest_eigenpairs(np.diag(components.variance) + conditional / (n - 1))  # C29
        count = len(variance)
        if modes is not None:
            count = min(modes, count) if isinstance(modes, int) else modes_for_variance(variance, modes)
        rows = vectors[:, :count].T @ components.basis.T
        fix_signs(rows)
        return PrincipalComponents(
            components.mean, rows.T, variance[:count], components.total_variance + total / (n - 1), n
        )

    def _conditional_covariance(self, basis: FloatArray) -> tuple[FloatArray, float]:
        """Return the covariance (R, R) of missing vertices along `basis` (3V, R), summed over shapes, and its trace.

        The trace is that over all coordinates.
        """
        r, k = basis.shape[1], len(self.fitted.width)
        modes = basis.reshape(-1, 3, r)
        out, trace = np.zeros((r, r)), 0.0
        for i, hidden in enumerate(self.fitted.patterns.hidden):
            Q, W = modes[hidden].reshape(-1, r), self.fitted.W[hidden, :, :k].reshape(-1, k)
            C, residual = self.fitted.y_covariance[i, :k, :k], np.repeat(self.fitted.residual_variance(i), 3)
            along = Q.T @ W
            out += along @ C @ along.T + (Q.T * residual) @ Q
            trace += float(np.einsum("dk,kl,dl->", W, C, W)) + float(residual.sum())
        return out, trace


def complete(
    shapes: FloatArray,
    names: Sequence[str],
    gauge: Gauge,
    *,
    align: bool = True,
    alignment_vertices: IntArray | None = None,
) -> CompletedShapes:
    """Align shapes by their observed vertices, and estimate the missing ones.

    Args:
        shapes: (N, V, 3) mm, each vertex in at least one; not-a-number where missing.
        names: of the shapes, for messages.
        gauge: as of `align_in_place`.
        align: False takes the shapes as they stand.
        alignment_vertices: as of `align_in_place`.

    Raises:
        InputError: too little of a shape is observed to align it.
    """
    observed = _observed(shapes)
    n = len(shapes)
    most = max(1, min(round(_MODES_A_SHAPE * n), _MOST_MODES, n - 2))
    guess = (
        _mean_filled(shapes, observed, names, gauge) if align else _filled(shapes, observed, _mean_of(shapes, observed))
    )
    if align:
        for modes in _POSES_BY:
            posed = align_shapes(guess.copy(), gauge, alignment_vertices)
            fitted = ppca(posed, observed, min(most, modes))
            guess = _in_own_pose(shapes, observed, posed, fitted)
        guess = align_shapes(guess.copy(), gauge, alignment_vertices)
    fitted = ppca(guess, observed, most)
    for i, hidden in enumerate(fitted.patterns.hidden):
        guess[i, hidden] = fitted.estimate(i)
    return CompletedShapes(guess, observed, fitted)


def with_estimates(shapes: FloatArray, names: Sequence[str], gauge: Gauge = "shape") -> FloatArray:
    """Return shapes in their own poses and sizes with missing vertices at their conditional means (see `complete`).

    Args:
        shapes: (N, V, 3) in any poses, each vertex in at least one shape; not-a-number where missing.
        names: of the shapes, for messages.
        gauge: as of `align_in_place`.

    Returns:
        (N, V, 3), with the vertices that are not missing unchanged.

    Raises:
        InputError: too little of a shape is observed to align it.
    """
    completed = complete(shapes, names, gauge)
    return _in_own_pose(shapes, completed.observed, completed.shapes, completed.fitted)


def _mean_filled(shapes: FloatArray, observed: BoolArray, names: Sequence[str], gauge: Gauge) -> FloatArray:
    """Return the shapes, each in its own pose, with the mean at missing vertices.

    The mean is that of generalised Procrustes over shared vertices, as large as the most complete shape.
    """
    first = int(observed.sum(axis=1).argmax())
    mean, shared, size = shapes[first], observed & observed[first], 0.0
    poses: list[Similarity] = []
    for _ in range(_MEAN_ROUNDS):
        poses = [pose_on_shared(x, mean, own, name, gauge) for x, own, name in zip(shapes, shared, names, strict=True)]
        previous, mean = mean, _mean_of(np.stack([T.apply(x) for T, x in zip(poses, shapes, strict=True)]), observed)
        size = size or centroid_size(mean)
        mean = mean * (size / centroid_size(mean))
        if shared is observed and float(np.abs(mean - previous).max()) <= _STILL * size:
            break
        shared = observed
    return _filled(shapes, observed, np.stack([T.inverse().apply(mean) for T in poses]))


def _mean_of(shapes: FloatArray, observed: BoolArray) -> FloatArray:
    weights = observed[:, :, None]
    return np.asarray(np.where(weights, shapes, 0.0).sum(axis=0) / weights.sum(axis=0), dtype=np.float64)


def _filled(shapes: FloatArray, observed: BoolArray, by: FloatArray) -> FloatArray:
    return np.where(observed[:, :, None], shapes, by)


def _in_own_pose(shapes: FloatArray, observed: BoolArray, posed: FloatArray, fitted: Ppca) -> FloatArray:
    """Return the shapes in the poses and sizes that they came in, completed by the estimates in the common one."""
    out = shapes.copy()
    for i, hidden in enumerate(fitted.patterns.hidden):
        if len(hidden):
            T_shape_posed = fit_similarity(posed[i, observed[i]], shapes[i, observed[i]])
            out[i, hidden] = T_shape_posed.apply(fitted.estimate(i))
    return out


def pose_on_shared(
    shape: FloatArray, mean: FloatArray, shared: BoolArray, name: str, gauge: Gauge = "shape"
) -> Similarity:
    """Return the pose of a shape (V, 3) on a mean by their `shared` vertices (V,), with scale unless the gauge is form.

    Raises:
        InputError: they are too few.
    """
    try:
        return fit_similarity(shape[shared], mean[shared], with_scale=gauge == "shape")
    except InputError as error:
        raise InputError(
            f"{name}: too little of it is there to be aligned with the other meshes; leave it out."
        ) from error
