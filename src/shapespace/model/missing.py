"""Shapes of which vertices are missing: a vertex that no scan showed is marked, not-a-number, and never invented.

Poses need whole shapes: what is aligned by the parts that happen to be there leans towards them. So shapes are
completed by probabilistic PCA, aligned as whole shapes are, and completed anew, the last time with all modes that so
many shapes can tell. The modes are then those of the completed shapes, with what stays unknown of the missing vertices
added to their covariance, so that holes neither narrow nor bend them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import eigh

from shapespace.errors import InputError
from shapespace.geometry.normals import part_of
from shapespace.geometry.procrustes import Gauge, align_in_place, centroid_size, scale_to_tangent
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.choose_modes import choose_modes
from shapespace.model.pca import PrincipalComponents, checked_modes, fix_signs, modes_for_variance, principal_components
from shapespace.model.ppca import Ppca, ppca
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity, SurfaceLandmarks

MIN_SEEN = 0.5
"""Share of the shapes that must show a vertex for it to be in a model, where nobody says how many."""
_FEWEST = 2
_POSES_BY = (8, 60)
"""Modes of the completions that poses are taken from, one after the other: with few only, what they cannot tell turns
into poses, and alignment then takes real modes out."""
_MODES_A_SHAPE, _MOST_MODES = 0.7, 60
"""Modes that probabilistic PCA begins with; it takes the width of those that nothing speaks for."""
_MEAN_ROUNDS, _STILL = 50, 1e-8


def shown_vertices(meshes: Sequence[Mesh]) -> BoolArray:
    """Return (N, V) which vertices of corresponding meshes are there: no coordinate of theirs is not-a-number."""
    return _there(np.stack([mesh.vertices for mesh in meshes]))


def _there(shapes: FloatArray) -> BoolArray:
    return ~np.logical_or.reduce(np.isnan(shapes), axis=2)


@dataclass(frozen=True, eq=False)
class Kept:
    """What is left of corresponding meshes when vertices that few of them show are taken out.

    Args:
        meshes: N, with the vertices kept and the triangles that have no other.
        vertices: (V,) True for each vertex that is kept.
    """

    meshes: Sequence[Mesh]
    vertices: BoolArray

    @staticmethod
    def of(meshes: Sequence[Mesh], min_seen: float) -> Kept:
        """Return what at least the share `min_seen` of the meshes show, and two of them: one shows no variation.

        Raises:
            InputError: a share that is none, a mesh that shows nothing, or no vertex that enough of them show.
        """
        if not 0 < min_seen <= 1:
            raise InputError(f"The share of meshes that show a vertex lies above 0 and at most at 1, not {min_seen:g}.")
        shown = shown_vertices(meshes)
        if shown.all():
            return Kept(meshes, shown[0])
        for mesh, there in zip(meshes, shown, strict=True):
            if not there.any():
                raise InputError(f"{mesh.name}: all of its vertices are missing; leave it out.")
        kept = shown.sum(axis=0) >= max(min_seen * len(meshes) * (1 - 1e-12), _FEWEST)
        if not kept.any():
            raise InputError(
                f"No vertex is shown by {100 * min_seen:g} % of the meshes and two of them, so nothing varies that "
                "could be learnt; give a smaller --min-seen (min_seen) or meshes with fewer missing vertices."
            )
        if kept.all():
            return Kept(meshes, kept)
        cut = [part_of(mesh, kept) for mesh in meshes]
        return Kept(cut, kept)

    def regions(self, regions: Mapping[str, IntArray]) -> dict[str, IntArray]:
        """Return what is left of each region, in new numbers; regions of which nothing is left are left out."""
        number = np.cumsum(self.vertices, dtype=np.int32) - 1
        return {name: number[at[self.vertices[at]]] for name, at in regions.items() if self.vertices[at].any()}

    def landmarks(self, landmarks: Mapping[str, int]) -> SurfaceLandmarks:
        """Return the landmarks whose vertices are all kept, in their new numbers.

        Raises:
            InputError: a landmark on a vertex that the meshes do not have.
        """
        given = SurfaceLandmarks.of(landmarks)
        given.check(len(self.vertices))
        return given.renumbered(self.vertices)

    def indices(self, vertices: IntArray | None) -> IntArray | None:
        """Return those of `vertices` that are kept, in their new numbers; None stays None."""
        if vertices is None or self.vertices.all():
            return vertices
        chosen = np.asarray(vertices)
        number = (np.cumsum(self.vertices) - 1).astype(np.int32)
        return number[chosen[self.vertices[chosen]]]


@dataclass(frozen=True, eq=False)
class Completed:
    """Aligned shapes with the places where their missing vertices are expected, and how well that is known.

    Args:
        shapes: (N, V, 3) mm.
        shown: (N, V).
        found: what they were completed by.
    """

    shapes: FloatArray
    shown: BoolArray
    found: Ppca

    def components(self, modes: int | float | Literal["auto"] | None, seed: int) -> PrincipalComponents:
        """Return mean and modes, as `principal_components` does of whole shapes.

        Raises:
            InputError: more modes than the shapes can give, no variation, or too few shapes to choose their number.
        """
        n = len(self.shapes)
        data = self.shapes.reshape(n, -1)
        if modes == "auto":
            modes = choose_modes(data, seed=seed, counted=self.shown).modes
        modes = checked_modes(modes, n)
        whole = principal_components(data)
        unknown, total = self._unknown(whole.basis)
        values, vectors = eigh(np.diag(whole.variance) + unknown / (n - 1))
        variance, vectors = values[::-1].copy(), vectors[:, ::-1]
        count = len(variance)
        if modes is not None:
            count = min(modes, count) if isinstance(modes, int) else modes_for_variance(variance, modes)
        rows = vectors[:, :count].T @ whole.basis.T
        fix_signs(rows)
        return PrincipalComponents(whole.mean, rows.T, variance[:count], whole.total_variance + total / (n - 1), n)

    def _unknown(self, basis: FloatArray) -> tuple[FloatArray, float]:
        """Return what is unknown of all shapes along `basis` (3V, R): its covariance (R, R), and its trace in all."""
        r, k = basis.shape[1], len(self.found.width)
        modes = basis.reshape(-1, 3, r)
        out, trace = np.zeros((r, r)), 0.0
        for i, hidden in enumerate(self.found.patterns.hidden):
            Q, W = modes[hidden].reshape(-1, r), self.found.W[hidden, :, :k].reshape(-1, k)
            C, apart = self.found.y_covariance[i, :k, :k], np.repeat(self.found.apart(i), 3)
            along = Q.T @ W
            out += along @ C @ along.T + (Q.T * apart) @ Q
            trace += float(np.einsum("dk,kl,dl->", W, C, W)) + float(apart.sum())
        return out, trace


def complete(
    shapes: FloatArray,
    names: Sequence[str],
    gauge: Gauge,
    *,
    align: bool = True,
    alignment_vertices: IntArray | None = None,
) -> Completed:
    """Align shapes by what they show, and find where their missing vertices are expected.

    Args:
        shapes: (N, V, 3) mm, each vertex in at least one; not-a-number where missing.
        names: of the shapes, for messages.
        gauge: as of `align_in_place`.
        align: False takes the shapes as they stand.
        alignment_vertices: as of `align_in_place`.

    Raises:
        InputError: a shape of which too little is there to be aligned.
    """
    shown = _there(shapes)
    n = len(shapes)
    most = max(1, min(round(_MODES_A_SHAPE * n), _MOST_MODES, n - 2))
    guess = _mean_filled(shapes, shown, names, gauge) if align else _filled(shapes, shown, _mean_of(shapes, shown))
    if align:
        for modes in _POSES_BY:
            posed = _aligned(guess, gauge, alignment_vertices)
            found = ppca(posed, shown, min(most, modes))
            guess = _in_own_pose(shapes, shown, posed, found)
        guess = _aligned(guess, gauge, alignment_vertices)
    found = ppca(guess, shown, most)
    for i, hidden in enumerate(found.patterns.hidden):
        guess[i, hidden] = found.place(i)
    return Completed(guess, shown, found)


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
    found = complete(shapes, names, gauge)
    return _in_own_pose(shapes, found.shown, found.shapes, found.found)


def _mean_filled(shapes: FloatArray, shown: BoolArray, names: Sequence[str], gauge: Gauge) -> FloatArray:
    """Return the shapes, each in its own pose, with the mean where they show nothing.

    The mean is that of generalised Procrustes over shared vertices, as large as the shape that shows most.
    """
    first = int(shown.sum(axis=1).argmax())
    mean, shared, size = shapes[first], shown & shown[first], 0.0
    poses: list[Similarity] = []
    for _ in range(_MEAN_ROUNDS):
        poses = [_pose(x, mean, there, name, gauge) for x, there, name in zip(shapes, shared, names, strict=True)]
        previous, mean = mean, _mean_of(np.stack([T.apply(x) for T, x in zip(poses, shapes, strict=True)]), shown)
        size = size or centroid_size(mean)
        mean = mean * (size / centroid_size(mean))
        if shared is shown and float(np.abs(mean - previous).max()) <= _STILL * size:
            break
        shared = shown
    return _filled(shapes, shown, np.stack([T.inverse().apply(mean) for T in poses]))


def _mean_of(shapes: FloatArray, shown: BoolArray) -> FloatArray:
    there = shown[:, :, None]
    return np.asarray(np.where(there, shapes, 0.0).sum(axis=0) / there.sum(axis=0), dtype=np.float64)


def _filled(shapes: FloatArray, shown: BoolArray, by: FloatArray) -> FloatArray:
    return np.where(shown[:, :, None], shapes, by)


def _aligned(whole: FloatArray, gauge: Gauge, alignment_vertices: IntArray | None) -> FloatArray:
    posed = whole.copy()
    align_in_place(posed, gauge, alignment_vertices=alignment_vertices)
    if gauge == "shape" and alignment_vertices is None:
        scale_to_tangent(posed)
    return posed


def _in_own_pose(shapes: FloatArray, shown: BoolArray, posed: FloatArray, found: Ppca) -> FloatArray:
    """Return the shapes in the poses and sizes that they came in, completed by what was found in the common one."""
    out = shapes.copy()
    for i, hidden in enumerate(found.patterns.hidden):
        if len(hidden):
            T_shape_posed = fit_similarity(posed[i, shown[i]], shapes[i, shown[i]])
            out[i, hidden] = T_shape_posed.apply(found.place(i))
    return out


def _pose(shape: FloatArray, mean: FloatArray, shared: BoolArray, name: str, gauge: Gauge) -> Similarity:
    try:
        return fit_similarity(shape[shared], mean[shared], with_scale=gauge == "shape")
    except InputError as error:
        raise InputError(
            f"{name}: too little of it is there to be aligned with the other meshes; leave it out."
        ) from error
