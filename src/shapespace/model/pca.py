"""Principal components by the Gram trick: equations 1 to 5 of the paper, divisor N - 1.

The (3V, 3V) covariance is never formed. The (N, N) Gram matrix of the centred shapes has the same non-zero
eigenvalues, and costs one symmetric rank-k product. The shapes are centred in the Gram matrix rather than one by
one, so that nothing as large as the data is ever copied. Alignment is not done here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, cast

import numpy as np

from shapespace.errors import InputError
from shapespace.types import FloatArray

Modes: TypeAlias = int | float | Literal["auto", "all"] | None
"""Modes to keep: a number, a share of the variance below 1, `auto` (`choose_modes`), or `all`, which None is too."""
_BLOCK = 1024  # coordinates at a time, so that no centred copy of all data is in memory
_CANCELLATION = 1e4
"""Beyond this ratio of raw to centred sum of squares, centring the Gram matrix would cost too many digits."""
_NO_VARIANCE = 1e-10
"""Modes with less than this share of the first mode's variance are rounding, not shape (erratum to P4)."""
ALL_EQUAL = "The training shapes are all equal, so there is no variation to model; give different ones."
_TIED = 1.0 - 1e-6
"""Entries this close to a mode's largest tie with it, as left and right do in symmetric shapes."""


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """The outcome of a PCA of N shapes with D coordinates.

    Args:
        mean: (D,) mm.
        basis: (D, K) orthonormal columns, in order of falling variance, signs fixed.
        variance: (K,) of the coefficients, mm^2, divisor N - 1.
        total_variance: of all modes together, kept or not, mm^2.
        n_samples: N.
        residuals: (K,) mm^2, |C v - lambda v| of each mode by a product with the covariance; None where none was taken.
    """

    mean: FloatArray
    basis: FloatArray
    variance: FloatArray
    total_variance: float
    n_samples: int
    residuals: FloatArray | None = None


def check_share(share: float) -> None:
    """Refuse a share of the variance that is none.

    Raises:
        InputError: it is outside (0, 1].
    """
    if not 0 < share <= 1:
        raise InputError(f"A share of the variance lies above 0 and at most at 1, not at {share:g}.")


def modes_for_variance(variance: FloatArray, share: float, total: float | None = None) -> int:
    """Return the smallest number of modes that hold `share` (0 < share <= 1) of `total`, or of the sum of `variance`.

    Args:
        variance: (R,) falling.
        share: of the variance.
        total: of all modes, where `variance` is not of all.

    Raises:
        InputError: a share outside (0, 1].
    """
    check_share(share)
    cumulative = np.cumsum(variance) / (variance.sum() if total is None else total)
    return int(min(np.searchsorted(cumulative, share * (1 - 1e-12)) + 1, len(variance)))


def principal_components(data: FloatArray, modes: Modes = "all") -> PrincipalComponents:
    """Return the exact principal components of `data`.

    Args:
        data: (N, D) float64, one shape a row; C order avoids a copy.
        modes: how many, fewer if the samples determine fewer; a float below 1 for a share of the variance; `all`.

    Raises:
        InputError: fewer than two samples, values that are not finite, or no variation at all.
    """
    n, d = data.shape
    from scipy.linalg import eigh  # takes a moment, which whoever only reads models need not wait for

    modes = checked_modes(modes, n)
    data = np.ascontiguousarray(data)
    gram = _centred_gram(data)
    total = float(gram.trace())
    if total <= n * d * (64 * np.finfo(float).eps * float(np.abs(data[0]).max())) ** 2:
        raise InputError(ALL_EQUAL)

    wanted = modes if isinstance(modes, int) else n - 1
    values, vectors = eigh(gram, lower=True, subset_by_index=(n - wanted, n - 1), check_finite=False, overwrite_a=True)
    variance = values[::-1] / (n - 1)  # P4
    variance = varying(variance)
    if isinstance(modes, float):
        variance = variance[: modes_for_variance(variance, modes)]
    weights = vectors[:, ::-1][:, : len(variance)] / np.sqrt(variance * (n - 1))
    mean, basis = _mean_and_basis(data, weights)
    return PrincipalComponents(mean, basis, variance.copy(), total / (n - 1), n)


def plain_modes(modes: object) -> int | float | None:
    """Return a number of modes or a share of the variance as a plain number, or None for all.

    Raises:
        InputError: it is something else, below one, or no share.
    """
    if isinstance(modes, np.integer | np.floating):
        modes = modes.item()
    if modes is None or modes == "all":
        return None
    if not isinstance(modes, int | float):
        raise InputError(f"The modes must be a whole number, a share of the variance, or all, not {modes!r}.")
    if isinstance(modes, float):
        check_share(modes)
    elif modes < 1:
        raise InputError(f"A shape model has one mode or more, not {modes}; give a number from 1.")
    return modes


def checked_modes(modes: Modes, n: int) -> int | float | None:
    """Return the modes to be computed of n shapes: a number of at most n - 1, a share of the variance, or None for all.

    Raises:
        InputError: it is something else, or there are fewer than two shapes.
    """
    if n < 2:
        raise InputError(f"A shape model needs at least two training shapes, not {n}.")
    modes = plain_modes(modes)
    return min(modes, n - 1) if isinstance(modes, int) else modes


def varying(variance: FloatArray) -> FloatArray:
    """Return those of the falling variances (K,) that are shape and not rounding."""
    return variance[variance > _NO_VARIANCE * variance[0]]


def fix_signs(rows: FloatArray) -> None:
    """Give each mode (K, D), in place, the sign that makes the first of its largest entries positive."""
    for row in rows:
        size = np.abs(row)
        if row[np.argmax(size >= _TIED * size.max())] < 0:
            row *= -1.0


def syrk(block: FloatArray, onto: FloatArray | None = None) -> FloatArray:
    """Return the lower triangle of block @ block.T, (N, N) Fortran-ordered, added to `onto` where given."""
    from scipy.linalg import blas

    dsyrk = cast(Any, blas).dsyrk
    # block.T is Fortran-ordered, so BLAS reads it in place.
    if onto is None:
        return dsyrk(1.0, block.T, trans=1, lower=1)
    return dsyrk(1.0, block.T, beta=1.0, c=onto, trans=1, lower=1, overwrite_c=1)


def _centred_gram(data: FloatArray) -> FloatArray:
    """Return the lower triangle of X^T X (N, N), X the centred shapes (P1, P2, P3)."""
    n = len(data)
    raw = syrk(data)
    if not np.isfinite(raw.diagonal()).all():
        raise InputError("The training shapes hold values that are not finite.")
    raw_trace = raw.trace()
    lower = np.tril(raw, -1)
    row_mean = (raw.diagonal() + lower.sum(axis=0) + lower.sum(axis=1)) / n
    raw -= row_mean[:, None]
    raw -= row_mean[None, :]
    raw += row_mean.mean()
    if raw.trace() * _CANCELLATION < raw_trace:
        return _centred_gram_by_blocks(data)
    return raw


def _centred_gram_by_blocks(data: FloatArray) -> FloatArray:
    """Do the same to full precision for shapes far from the origin, centring a block of coordinates at a time."""
    n, d = data.shape
    gram = np.zeros((n, n), order="F")
    for start in range(0, d, _BLOCK):
        block = data[:, start : start + _BLOCK] - data[0, start : start + _BLOCK]
        block -= block.mean(axis=0)
        gram = syrk(block, onto=gram)
    return gram


def _mean_and_basis(data: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mean (D,) and P = X weights (D, K) (P5), orthonormal to rounding, with deterministic signs."""
    n, k = weights.shape
    combined = np.vstack([weights.T, np.full((1, n), 1.0 / n)]) @ data  # one pass over the data for both
    mean, rows = combined[k].copy(), combined[:k]
    column_sums = weights.sum(axis=0)
    for row, column_sum in zip(rows, column_sums, strict=True):
        row -= column_sum * mean
    orthonormal_rows(rows)
    return mean, rows.T


def orthonormal_rows(rows: FloatArray) -> None:
    """Give modes (K, D), orthonormal but for rounding, their signs, and take the rounding out, in place."""
    fix_signs(rows)
    # Faint modes lose orthogonality by the square of the spread of the spectrum; one Cholesky step restores it.
    overlap = rows @ rows.T
    if np.abs(overlap - np.eye(len(rows))).max() > 1e-12:
        from scipy.linalg import solve_triangular

        factor = np.linalg.cholesky(overlap)
        for start in range(0, rows.shape[1], _BLOCK):
            part = slice(start, start + _BLOCK)
            rows[:, part] = np.asarray(solve_triangular(factor, rows[:, part], lower=True))
