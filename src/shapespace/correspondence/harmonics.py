"""Smooth functions on a surface: the eigenfunctions of its Laplacian, and diffusion of heat in them (C1).

The height above the smoothed surface is its relief: bumps, edges and hollows. The registration brings surfaces near
each other, and a smooth surface can be near in a wrong pose too. Its relief then does not agree, which makes it a test
that is independent of the registration. Equations Cn are those of docs/correspondence.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import eigsh

from shapespace.geometry.normals import cotangent_laplacian, vertex_normals
from shapespace.types import BoolArray, FloatArray, Mesh

_SHIFT = 1e-7
"""Shift of the spectrum, in units of the last wanted frequency, so that the factored matrix is not singular."""


@dataclass(frozen=True, eq=False)
class Harmonics:
    """The smoothest functions phi_k on a surface: -Laplacian phi_k = frequency_k^2 phi_k (Vallet and Levy 2008).

    Args:
        functions: (V, K) float64, orthonormal by area: functions^T diag(area) functions = I.
        squared_frequency: (K,) mm^-2, growing; the first is 0.
        area: (V,) area of each vertex, mm^2.
    """

    functions: FloatArray
    squared_frequency: FloatArray
    area: FloatArray

    @staticmethod
    def of(mesh: Mesh, count: int) -> Harmonics:
        """Return the `count` functions of lowest frequency on `mesh`, which must have triangles; at most V - 2.

        The largest value of each function is positive, so that the functions of a mesh have fixed signs.
        """
        laplacian, area = cotangent_laplacian(mesh)
        count = min(count, len(area) - 2)
        mass = sparse.diags_array(area).tocsc()
        shift = _SHIFT * 4 * np.pi * count / float(area.sum())
        # Without a given start ARPACK draws a random one.
        start = np.ones(len(area)) + 0.1 * np.cos(np.arange(len(area)))
        squared, functions = cast(Any, eigsh)(laplacian.tocsc(), k=count, M=mass, sigma=-shift, v0=start)
        squared, functions = np.asarray(squared, dtype=np.float64), np.asarray(functions, dtype=np.float64)
        largest = functions[np.abs(functions).argmax(axis=0), np.arange(functions.shape[1])]
        functions = np.ascontiguousarray(functions * np.sign(largest))
        return Harmonics(functions, np.maximum(squared, 0.0), area)

    def slowest(self, count: int) -> Harmonics:
        """Return the first `count` harmonics."""
        return Harmonics(self.functions[:, :count], self.squared_frequency[:count], self.area)

    def coefficients(self, field: FloatArray) -> FloatArray:
        """Return the (K, C) coefficients of the functions in `field` (V, C)."""
        return self.functions.T @ (self.area[:, None] * field)

    def attenuation(self, range_mm: float) -> FloatArray:
        """Return (K,) the factor of each function after heat has diffused by `range_mm`."""
        return np.exp(-0.5 * self.squared_frequency * range_mm**2)  # C1

    def diffused(self, field: FloatArray, range_mm: float) -> FloatArray:
        """Return `field` (V, C) after heat has diffused by `range_mm`, the standard deviation of a peak."""
        return self.functions @ (self.attenuation(range_mm)[:, None] * self.coefficients(field))  # C1


_RANGE = 0.05
"""Range of the smoothing, share of the square root of the area: of 0.03, 0.05, 0.1 and 0.2 it separated right and wrong
surfaces of 15 simulated kinds best."""
_ENOUGH = 40  # largest number of surfaces whose median is used
_LARGEST = 0.9999  # correlation of copies, so that their agreement is finite


def relief(vertices: FloatArray, template: Mesh, harmonics: Harmonics) -> FloatArray:
    """Return the (V,) height of a surface above its smoothed version, along its normals (C34).

    Args:
        vertices: (V, 3) in correspondence with `template`.
        template: mesh with the triangles of the surface.
        harmonics: harmonics of the template.
    """
    smooth = harmonics.diffused(vertices, _RANGE * float(np.sqrt(harmonics.area.sum())))
    normals = vertex_normals(template.with_vertices(vertices))
    return np.asarray(np.einsum("vd,vd->v", normals, vertices - smooth))  # C34


def agreement(a: FloatArray, b: FloatArray, weights: FloatArray) -> float:
    """Return the correlation of two reliefs (V,), transformed to the real line (C35); 0 if one is flat."""
    weights = weights / max(float(weights.sum()), 1e-12)
    a, b = a - weights @ a, b - weights @ b
    spread = float(np.sqrt((weights @ a**2) * (weights @ b**2)))
    return float(np.arctanh(np.clip((weights * a) @ b / max(spread, 1e-12), -_LARGEST, _LARGEST)))  # C35


@dataclass(frozen=True, eq=False)
class Reliefs:
    """The reliefs of surfaces in correspondence.

    Args:
        heights: (N, V) relief of each surface.
        observed: (N, V) bool, True at observed vertices.
        area: (V,) area of each vertex.
    """

    heights: FloatArray
    observed: BoolArray
    area: FloatArray

    @staticmethod
    def of(shapes: FloatArray, observed: FloatArray, template: Mesh, harmonics: Harmonics) -> Reliefs:
        """Return the reliefs of `shapes` (N, V, 3), of which some vertices are `observed` (N, V)."""
        heights = np.stack([relief(shape, template, harmonics) for shape in shapes])
        return Reliefs(heights, observed > 0, harmonics.area)

    def median(self, core: npt.NDArray[np.integer] | None = None) -> FloatArray:
        """Return (V,) the median of all reliefs or of `core`, of at most `_ENOUGH`, where they are observed."""
        core = np.arange(len(self.heights)) if core is None else core
        some = core[:: -(-len(core) // _ENOUGH)]
        seen = self.observed[some]
        seen = seen | ~seen.any(axis=0)
        return np.nanmedian(np.where(seen, self.heights[some], np.nan), axis=0)

    def agreements(self, core: npt.NDArray[np.integer] | None = None) -> FloatArray:
        """Return (N,) the agreement of each relief with the median of all or of `core` (C35)."""
        middle = self.median(core)
        return np.array(
            [agreement(own, middle, self.area * seen) for own, seen in zip(self.heights, self.observed, strict=True)]
        )
