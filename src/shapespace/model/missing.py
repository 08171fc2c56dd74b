"""Models of shapes with missing vertices, which are not-a-number.

Alignment needs complete shapes: an alignment by the observed parts is biased towards them. So shapes are
completed by probabilistic PCA, aligned as complete shapes are, and completed again, the last time with as many
modes as the number of shapes determines. The modes of the model are then those of the completed shapes, with the
conditional covariance of the missing vertices added to their covariance, so that holes neither narrow nor distort them.
Equations Cn are those of docs/missing.md.
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
"""Numbers of modes of the completions, in turn, on which the poses are based: with few modes only, the other variation
becomes pose, and alignment then removes real modes."""
_MODES_A_SHAPE, _MOST_MODES = 0.7, 60
"""Initial number of modes of probabilistic PCA, per shape and at most; modes without evidence lose their width."""
# limit of the iterations of the mean, and the change as a share of the size that ends them
_MEAN_ROUNDS, _STILL = 50, 1e-8


def _observed_mask(shapes: FloatArray) -> BoolArray:
    return ~np.logical_or.reduce(np.isnan(shapes), axis=2)


@dataclass(frozen=True, eq=False)
class ObservedMeshes:
    """Corresponding meshes without the vertices that few of them observe.

    Args:
        meshes: N meshes, with the observed vertices and the triangles between them.
        vertices: (V,) True for each vertex that is used.
    """

    meshes: Sequence[Mesh]
    vertices: BoolArray

    @staticmethod
    def of(meshes: Sequence[Mesh], min_seen: float) -> ObservedMeshes:
        """Return the meshes with the vertices that at least the share `min_seen` of the meshes, and two, observe.

        Raises:
            InputError: a share outside (0, 1], a mesh with no observed vertex, or no vertex that enough meshes observe.
        """
        if not 0 < min_seen <= 1:
            raise InputError(f"The share of meshes that show a vertex lies above 0 and at most at 1, not {min_seen:g}.")
        observed = _observed_mask(np.stack([mesh.vertices for mesh in meshes]))
        if observed.all():
            return ObservedMeshes(meshes, observed[0])
        for mesh, own in zip(meshes, observed, strict=True):
            if not own.any():
                raise InputError(f"{mesh.name}: all of its vertices are missing; exclude this mesh.")
        used = observed.sum(axis=0) >= max(min_seen * len(meshes) * (1 - 1e-12), _FEWEST)
        pairs = None if meshes[0].faces is None else pairs_of_triangles(meshes[0].faces, len(used))
        if pairs is not None:
            used &= used[pairs]  # keeps a symmetric template symmetric
        if not used.any():
            raise InputError(
                f"No vertex is observed by {100 * min_seen:g} % of the meshes and by at least two, so there is no "
                "variation to model; give a smaller --min-seen (min_seen) or meshes with fewer missing vertices."
            )
        if used.all():
            return ObservedMeshes(meshes, used)
        return ObservedMeshes([part_of(mesh, used) for mesh in meshes], used)

    def regions(self, regions: Mapping[str, IntArray]) -> dict[str, IntArray]:
        """Return the observed vertices of each region, with new indices; regions without any are omitted."""
        number = np.cumsum(self.vertices, dtype=np.int32) - 1
        return {name: number[own[self.vertices[own]]] for name, own in regions.items() if self.vertices[own].any()}

    def landmarks(self, landmarks: Mapping[str, int]) -> SurfaceLandmarks:
        """Return the landmarks whose vertices are all used, with their new indices.

        Raises:
            InputError: a landmark on a vertex that the meshes do not have.
        """
        given = SurfaceLandmarks.of(landmarks)
        given.check(len(self.vertices))
        return given.renumbered(self.vertices)

    def notes(self, min_seen: float, landmarks: Mapping[str, int]) -> list[str]:
        """Return notes on the vertices and `landmarks` that are not used, since too few meshes observe them."""
        out, lost = int((~self.vertices).sum()), sorted(set(landmarks) - set(self.landmarks(landmarks)))
        number = "1 vertex is" if out == 1 else f"{out} vertices are"
        notes = [
            f"{number} removed from the model, since fewer than {100 * min_seen:g} % of the meshes show them; "
            "--min-seen sets the required share."
        ]
        of_landmarks = (
            f"The model has no {', '.join(lost)}, since these landmarks lie in triangles with vertices that are taken "
            "out."
        )
        return [*(notes if out else []), *([of_landmarks] if lost else [])]

    def indices(self, vertices: IntArray | None) -> IntArray | None:
        """Return those of `vertices` that are used, with their new indices; None stays None."""
        if vertices is None or self.vertices.all():
            return vertices
        chosen = np.asarray(vertices)
        number = (np.cumsum(self.vertices) - 1).astype(np.int32)
        return number[chosen[self.vertices[chosen]]]


def missing_notes(meshes: Sequence[Mesh]) -> list[str]:
    """Return the number of missing vertices of corresponding meshes, in a sentence, if any."""
    holed = [int(np.isnan(mesh.vertices).any(axis=1).sum()) for mesh in meshes]
    if not any(holed):
        return []
    missing, every, where = sum(holed), len(meshes) * len(meshes[0].vertices), sum(count > 0 for count in holed)
    share = 100 * missing / every
    return [f"{missing} of {every} vertices are missing ({share:.1f} %), in {where} of {len(meshes)} meshes."]


@dataclass(frozen=True, eq=False)
class CompletedShapes:
    """Aligned shapes with their missing vertices at the conditional means, and the uncertainty of these vertices.

    Args:
        shapes: (N, V, 3) aligned and completed shapes, mm.
        observed: (N, V) True for observed vertices.
        fitted: the probabilistic PCA that completed the shapes.
    """

    shapes: FloatArray
    observed: BoolArray
    fitted: Ppca

    def components(self, modes: Modes, seed: int) -> PrincipalComponents:
        """Return mean and modes, as `principal_components` does of complete shapes.

        Raises:
            InputError: the shapes have no variation.
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

        The trace is over all coordinates.
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
        names: names of the shapes, for messages.
        gauge: whether size is kept or removed, see `align_in_place`.
        align: whether to align the shapes; False uses their given poses.
        alignment_vertices: vertices that determine the alignment, see `align_in_place`.

    Raises:
        InputError: too little of a shape is observed to align it.
    """
    observed = _observed_mask(shapes)
    n = len(shapes)
    most = max(1, min(round(_MODES_A_SHAPE * n), _MOST_MODES, n - 2))
    guess = (
        _fill_with_mean(shapes, observed, names, gauge)
        if align
        else _fill_missing(shapes, observed, _mean_of(shapes, observed))
    )
    if align:
        for modes in _POSES_BY:
            posed = align_shapes(guess.copy(), gauge, alignment_vertices)
            fitted = ppca(posed, observed, min(most, modes))
            guess = _restore_poses(shapes, observed, posed, fitted)
        guess = align_shapes(guess.copy(), gauge, alignment_vertices)
    fitted = ppca(guess, observed, most)
    for i, hidden in enumerate(fitted.patterns.hidden):
        guess[i, hidden] = fitted.estimate(i)
    return CompletedShapes(guess, observed, fitted)


def with_estimates(shapes: FloatArray, names: Sequence[str], gauge: Gauge = "shape") -> FloatArray:
    """Return shapes in their own poses and sizes with missing vertices at their conditional means (see `complete`).

    Args:
        shapes: (N, V, 3) in any poses, each vertex in at least one shape; not-a-number where missing.
        names: names of the shapes, for messages.
        gauge: whether size is kept or removed, see `align_in_place`.

    Returns:
        (N, V, 3), with the vertices that are not missing unchanged.

    Raises:
        InputError: too little of a shape is observed to align it.
    """
    completed = complete(shapes, names, gauge)
    return _restore_poses(shapes, completed.observed, completed.shapes, completed.fitted)


def _fill_with_mean(shapes: FloatArray, observed: BoolArray, names: Sequence[str], gauge: Gauge) -> FloatArray:
    """Return the shapes, each in its own pose, with the mean at missing vertices.

    The mean is that of generalised Procrustes over shared vertices, in the size of the most complete shape.
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
    return _fill_missing(shapes, observed, np.stack([T.inverse().apply(mean) for T in poses]))


def _mean_of(shapes: FloatArray, observed: BoolArray) -> FloatArray:
    weights = observed[:, :, None]
    return np.asarray(np.where(weights, shapes, 0.0).sum(axis=0) / weights.sum(axis=0), dtype=np.float64)


def _fill_missing(shapes: FloatArray, observed: BoolArray, by: FloatArray) -> FloatArray:
    return np.where(observed[:, :, None], shapes, by)


def _restore_poses(shapes: FloatArray, observed: BoolArray, posed: FloatArray, fitted: Ppca) -> FloatArray:
    """Return the shapes in their given poses and sizes, completed by the estimates in the common pose."""
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
        InputError: too few vertices are shared.
    """
    try:
        return fit_similarity(shape[shared], mean[shared], with_scale=gauge == "shape")
    except InputError as error:
        raise InputError(
            f"{name}: too few of its vertices are observed to align it with the other meshes; exclude this mesh."
        ) from error
