"""Smooth functions on a surface: the eigenfunctions of its Laplacian, and diffusion of heat in them (C1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import eigsh

from shapespace.geometry.normals import cotangent_laplacian
from shapespace.types import FloatArray, Mesh

_SHIFT = 1e-7
"""Of the spectrum, in units of the last frequency that is wanted, so that what is factored is not singular."""


@dataclass(frozen=True, eq=False)
class Harmonics:
    """The smoothest functions phi_k on a surface: -Laplacian phi_k = frequency_k^2 phi_k (Vallet and Levy 2008).

    Args:
        functions: (V, K) float64, orthonormal by area: functions^T diag(area) functions = I.
        squared_frequency: (K,) mm^-2, growing; the first is 0.
        area: (V,) mm^2 of each vertex.
    """

    functions: FloatArray
    squared_frequency: FloatArray
    area: FloatArray

    @staticmethod
    def of(mesh: Mesh, count: int) -> Harmonics:
        """Return the `count` functions of lowest frequency on `mesh`, which must have triangles; at most V - 2.

        The sign of each function is such that its largest value is positive, so that the same mesh gives the same ones.
        """
        laplacian, area = cotangent_laplacian(mesh)
        count = min(count, len(area) - 2)
        mass = sparse.diags_array(area).tocsc()
        shift = _SHIFT * 4 * np.pi * count / float(area.sum())
        # Without a start of its own ARPACK draws one at random.
        start = np.ones(len(area)) + 0.1 * np.cos(np.arange(len(area)))
        squared, functions = cast(Any, eigsh)(laplacian.tocsc(), k=count, M=mass, sigma=-shift, v0=start)
        squared, functions = np.asarray(squared, dtype=np.float64), np.asarray(functions, dtype=np.float64)
        largest = functions[np.abs(functions).argmax(axis=0), np.arange(functions.shape[1])]
        functions = np.ascontiguousarray(functions * np.sign(largest))
        return Harmonics(functions, np.maximum(squared, 0.0), area)

    def slowest(self, count: int) -> Harmonics:
        """Return the first `count` of them."""
        return Harmonics(self.functions[:, :count], self.squared_frequency[:count], self.area)

    def coefficients(self, field: FloatArray) -> FloatArray:
        """Return (K, C) of the functions in `field` (V, C)."""
        return self.functions.T @ (self.area[:, None] * field)

    def attenuation(self, range_mm: float) -> FloatArray:
        """Return (K,) the factor of each function after heat has diffused by `range_mm`."""
        return np.exp(-0.5 * self.squared_frequency * range_mm**2)  # C1

    def diffused(self, field: FloatArray, range_mm: float) -> FloatArray:
        """Return `field` (V, C) after heat has diffused by `range_mm`, the standard deviation of a peak."""
        return self.functions @ (self.attenuation(range_mm)[:, None] * self.coefficients(field))  # C1
