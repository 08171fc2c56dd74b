"""Tensor-product cubic B-splines on the unit square, fitted to scattered values by regularised least squares.

A function of (u, v) is sum_ij N_i(u) N_j(v) c_ij with m x n coefficients (control points where values are points) on
uniform clamped knots (de Boor, A Practical Guide to Splines, 2001).
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from shapespace.errors import InputError
from shapespace.types import FloatArray

_SINGULAR = 1e-7
"""Share of the largest pivot below which a matrix is singular up to rounding."""

DEGREE = 3  # cubic: continuous curvature
FEWEST, MOST = 4, 64
"""Limits of control points along each side: a cubic needs 4, and more than 64 need too much memory."""
LEAST_SMOOTHNESS = 1e-9
"""Default weight of the energy: it determines the spline in gaps of the data, with little effect elsewhere."""


def check_counts(counts: tuple[int, int]) -> None:
    """Check the numbers of control points.

    Raises:
        InputError: the numbers are not two, or are outside `FEWEST` to `MOST`.
    """
    if len(counts) != 2 or not all(FEWEST <= count <= MOST for count in counts):
        raise InputError(
            f"A B-spline surface needs {FEWEST} to {MOST} control points along each of two sides, such as 24x24, not "
            f"{'x'.join(str(count) for count in counts)}."
        )


class SplineSquare:
    """Splines with fixed numbers of control points and fixed parameters of the data on the square.

    Args:
        uv: (V, 2) parameters of the data, in [0, 1].
        counts: numbers of control points along u and along v, `FEWEST` to `MOST`.
        smoothness: weight of the thin-plate energy (`thin_plate_energy`) relative to the mean squared distance.

    Raises:
        InputError: parameters outside the square, or invalid counts.
    """

    def __init__(self, uv: FloatArray, counts: tuple[int, int], smoothness: float = LEAST_SMOOTHNESS) -> None:
        if uv.ndim != 2 or uv.shape[1] != 2 or not len(uv) or not ((uv >= 0) & (uv <= 1)).all():
            raise InputError("A B-spline surface needs parameters (V, 2) of the vertices on the unit square.")
        check_counts(counts)
        self.uv = uv
        self.counts = counts
        self.matrix: Any = _design_matrix(uv, counts)
        self._penalty = smoothness * len(uv) * thin_plate_energy(counts)
        self._factor = self._factorise(None)

    def values(self, control: FloatArray) -> FloatArray:
        """Return the values (V, c) of the spline with coefficients `control` (mn, c) at the parameters of the data."""
        return np.asarray(self.matrix @ control)

    def fit(self, values: FloatArray, weights: FloatArray | None = None) -> FloatArray:
        """Return the coefficients (mn, c) that fit `values` (V, c) with `weights` (V,), smooth in gaps of the data.

        Raises:
            InputError: fewer than three values with positive weight, or all on a line.
        """
        from scipy.linalg import cho_solve

        if weights is None:
            return np.asarray(cast(Any, cho_solve)(self._factor, self.matrix.T @ values))
        return np.asarray(cast(Any, cho_solve)(self._factorise(weights), self.matrix.T @ (weights[:, None] * values)))

    def _factorise(self, weights: FloatArray | None) -> Any:
        from scipy.linalg import cho_factor

        B = self.matrix if weights is None else self.matrix.multiply(weights[:, None]).tocsr()
        normal = np.asarray((B.T @ self.matrix).todense()) + self._penalty
        try:
            factors = cast(Any, cho_factor)(normal, lower=True)
            pivots = np.diag(factors[0])
            # Some versions of LAPACK factorise a matrix that is singular up to rounding, and others do not.
            if pivots.min() > _SINGULAR * pivots.max():
                return factors
        except np.linalg.LinAlgError:
            pass
        raise InputError("There are too few vertices to fit a B-spline surface to them.")


def _knots(count: int) -> FloatArray:
    inner = np.linspace(0.0, 1.0, count - DEGREE + 1)
    return np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])


def _design_matrix(uv: FloatArray, counts: tuple[int, int]) -> Any:
    """Return the sparse (V, mn) weights of each control point at each parameter; rows sum to one."""
    from scipy.interpolate import BSpline  # slow import (0.2 s), not needed for models of vertices
    from scipy.sparse import csr_matrix

    along = [BSpline.design_matrix(uv[:, k], _knots(counts[k]), DEGREE).toarray() for k in range(2)]
    first, second = ((side != 0).argmax(axis=1) for side in along)
    # A parameter at a knot has one weight of zero: the window of four is moved inside the row.
    width = np.arange(DEGREE + 1)
    i = np.minimum(first, counts[0] - DEGREE - 1)[:, None] + width
    j = np.minimum(second, counts[1] - DEGREE - 1)[:, None] + width
    row = np.arange(len(uv))[:, None]
    values = along[0][row, i][:, :, None] * along[1][row, j][:, None, :]
    columns = i[:, :, None] * counts[1] + j[:, None, :]
    pointers = np.arange(len(uv) + 1) * (DEGREE + 1) ** 2
    return csr_matrix((values.ravel(), columns.ravel(), pointers), (len(uv), counts[0] * counts[1]))


def thin_plate_energy(counts: tuple[int, int]) -> FloatArray:
    """Return E (mn, mn) with c^T E c the integral of f_uu^2 + 2 f_uv^2 + f_vv^2 over the square, exact."""
    gram = [[_gram(count, order) for order in range(3)] for count in counts]
    u, v = gram
    return np.kron(u[2], v[0]) + 2 * np.kron(u[1], v[1]) + np.kron(u[0], v[2])


def _gram(count: int, order: int) -> FloatArray:
    """Return (count, count) integrals of products of the derivatives of that order of the basis splines."""
    from scipy.interpolate import BSpline

    knots = _knots(count)
    nodes, weights = np.polynomial.legendre.leggauss(DEGREE + 1)
    edges = np.unique(knots)
    half = 0.5 * np.diff(edges)
    x = (edges[:-1, None] + half[:, None] * (nodes + 1)).ravel()
    values = np.asarray(cast(Any, BSpline(knots, np.eye(count), DEGREE))(x, order), dtype=np.float64)
    return values.T @ ((half[:, None] * weights).ravel()[:, None] * values)
