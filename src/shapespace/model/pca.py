"""Principal components of shapes in memory or on a disk: equations 1 to 5 of the paper, divisor N - 1.

The (3V, 3V) covariance is never formed. The (N, N) Gram matrix of the centred shapes has the same non-zero eigenvalues;
it is accumulated over blocks of coordinates, each of which is centred separately, so that no copy of
all data is made. For more than `EXACT` shapes on a disk, a block Krylov method computes the modes from blocks of rows.
The file on the disk contains the differences of the shapes from a template near their mean, in single precision. All
sums are in double precision and in a fixed order. The shapes must be aligned already.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias, cast

import numpy as np

from shapespace.errors import InputError
from shapespace.io.memory_cache import available_bytes
from shapespace.model.krylov import LeadingEigenpairs, Stop, largest_eigenpairs, leading
from shapespace.types import FloatArray

Modes: TypeAlias = int | float | Literal["auto", "all"] | None
"""Modes to keep: a number, a share of the variance below 1, `auto` (`choose_modes`), or `all`, the same as None."""
EXACT = 15_000
"""Largest number of shapes on a disk for which the Gram matrix is formed: 1.8 GB."""
_WHOLE, _FEW = 1000, 8
"""Largest number of shapes, and for more shapes the largest ratio of their number to that of the modes, for which all
eigenvectors are computed at once, which is then as fast as to compute the first ones."""
_BASIS_BYTES = 768 << 20  # bytes of the Krylov basis in memory
# vectors in a block: products of a few columns are slow, many cost memory
_LEAST_BLOCK, _MOST_BLOCK = 32, 128
_TO_ROUNDING = Stop(radians=1e-8, least_gap=1e-5, enough=1e-12)
_BLOCK = 1024  # coordinates at a time, so that no centred copy of all data is in memory
_NO_VARIANCE = 1e-10
"""Modes with less than this share of the first mode's variance are rounding errors (erratum to P4)."""
_ROUNDING, _NO_VARIATION = 64 * float(np.finfo(float).eps), 1e-12
"""Largest difference of coordinates of equal shapes as a share of their size, and for shapes on a disk the share of the
sum of squares that is rounding error."""
ALL_EQUAL = "The training shapes are all equal, so there is no variation to model; give different shapes."
_TIED = 1.0 - 1e-6
"""Entries this close to a mode's largest tie with it, as left and right do in symmetric shapes."""


class RowTable(Protocol):
    """N rows of D numbers, one shape per row, in memory or in a file (`Spill`)."""

    rows: int
    columns: int

    def row_blocks(self) -> Iterator[tuple[int, FloatArray]]:
        """Yield blocks of rows of the complete table in order, each with the number of its first row."""
        ...

    def column_blocks(self) -> Iterator[FloatArray]:
        """Yield copies of blocks of columns of the complete table in order."""
        ...


class _InMemory:
    """An array (N, D) as a table."""

    def __init__(self, data: FloatArray) -> None:
        self.data = np.ascontiguousarray(data)
        self.rows, self.columns = data.shape

    def row_blocks(self) -> Iterator[tuple[int, FloatArray]]:
        yield 0, self.data

    def column_blocks(self) -> Iterator[FloatArray]:
        for start in range(0, self.columns, _BLOCK):
            yield self.data[:, start : start + _BLOCK].copy()


@dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """The outcome of a PCA of N shapes with D coordinates.

    Args:
        mean: (D,) mean, mm.
        basis: (D, K) orthonormal columns, in order of falling variance, signs fixed.
        variance: (K,) variances of the coefficients, mm^2, divisor N - 1.
        total_variance: variance of all modes together, kept or not, mm^2.
        n_samples: N.
        residuals: (K,) mm^2, |C v - lambda v| of each mode from a product with the covariance; None for shapes in
            memory, whose modes are exact to rounding.
    """

    mean: FloatArray
    basis: FloatArray
    variance: FloatArray
    total_variance: float
    n_samples: int
    residuals: FloatArray | None = None


def check_share(share: float) -> None:
    """Check a share of the variance.

    Raises:
        InputError: the share is outside (0, 1].
    """
    if not 0 < share <= 1:
        raise InputError(f"A share of the variance lies above 0 and at most at 1, not at {share:g}.")


def modes_for_variance(variance: FloatArray, share: float, total: float | None = None) -> int:
    """Return the smallest number of modes with the share `share` (0 < share <= 1) of the variance.

    Args:
        variance: (R,) variances, falling.
        share: share of `total`.
        total: total variance of all modes; None for the sum of `variance`.

    Raises:
        InputError: a share outside (0, 1].
    """
    check_share(share)
    cumulative = np.cumsum(variance) / (variance.sum() if total is None else total)
    return int(min(np.searchsorted(cumulative, share * (1 - 1e-12)) + 1, len(variance)))


def principal_components(
    shapes: FloatArray | RowTable,
    modes: Modes = "all",
    *,
    seed: int = 0,
    passes: Path | None = None,
    on_pass: Callable[[int, float], None] | None = None,
) -> PrincipalComponents:
    """Return the principal components of `shapes`, exact in memory, and on a disk for at most `EXACT` shapes.

    Args:
        shapes: (N, D) float64, one shape per row; C order avoids a copy. Or a table on a disk, mm, about a template;
            the mean is returned about it too.
        modes: number of modes, fewer if the samples determine fewer; a float below 1 for a share of the variance;
            `all`.
        seed: seed of the first block of directions if there are many shapes.
        passes: folder where the passes over many shapes are kept; None keeps nothing.
        on_pass: function called with the number of a pass and the largest residual after it as a share of the first
            variance.

    Raises:
        InputError: fewer than two samples, values that are not finite, no variation at all, or more modes than fit
            into memory.
        FileError: the file cannot be read, or a pass cannot be kept.
    """
    table = _InMemory(shapes) if isinstance(shapes, np.ndarray) else shapes
    n, d, in_memory = table.rows, table.columns, isinstance(table, _InMemory)
    modes = checked_modes(modes, n) if in_memory else checked_large_modes(modes, n, d)
    covariance = Covariance.of(table)
    if in_memory or n <= EXACT:
        variance, rows, total = _components_by_gram(covariance, modes, seed, exact=in_memory)
        residuals = None
        if not in_memory:
            residuals = np.linalg.norm(covariance(rows.T) - rows.T * variance, axis=0)
    else:
        # All modes of so many shapes were rejected.
        total = covariance.total()
        found = _find_leading(
            covariance, d, cast(int | float, modes), total, Stop(), seed, passes=passes, on_pass=on_pass
        )
        if found is None:
            raise InputError(
                f"The requested modes cannot be separated from the next modes in {_max_columns(d)} directions, the "
                "number that memory is reserved for; ask for fewer modes."
            )
        variance = varying(found.values)
        rows = np.ascontiguousarray(found.vectors.T[: len(variance)])
        fix_signs(rows)
        residuals = found.residuals[: len(variance)]
    return PrincipalComponents(covariance.mean, rows.T, variance.copy(), total, n, residuals)


def plain_modes(modes: object) -> int | float | None:
    """Return a number of modes or a share of the variance as a plain number, or None for all.

    Raises:
        InputError: it is another object, below one, or not a share.
    """
    if isinstance(modes, np.integer | np.floating):
        modes = modes.item()
    if modes is None or modes == "all":
        return None
    if not isinstance(modes, int | float):
        raise InputError(f"The modes must be an integer, a share of the variance, or all, not {modes!r}.")
    if isinstance(modes, float):
        check_share(modes)
    elif modes < 1:
        raise InputError(f"A shape model has one mode or more, not {modes}; give a number from 1.")
    return modes


def checked_modes(modes: Modes, n: int) -> int | float | None:
    """Return the modes to compute of n shapes: a number of at most n - 1, a share of the variance, or None for all.

    Raises:
        InputError: the number is invalid, or there are fewer than two shapes.
    """
    if n < 2:
        raise InputError(f"A shape model needs at least two training shapes, not {n}.")
    modes = plain_modes(modes)
    return min(modes, n - 1) if isinstance(modes, int) else modes


def checked_large_modes(modes: Modes, n: int, d: int) -> int | float | None:
    """Return the checked number of modes of n shapes of d numbers on a disk, before the shapes are read.

    Raises:
        InputError: more modes than fit into memory.
    """
    modes = checked_modes(modes, n)
    count = n - 1 if modes is None else modes if isinstance(modes, int) else 1
    if modes is None and n > EXACT:
        raise InputError(
            f"All modes of {n} shapes cannot be found; ask for a number of them or auto (--modes), or a share of the "
            "variance (--variance)."
        )
    free = available_bytes()
    if free is not None and 3 * 8 * count * d > free:
        raise InputError(
            f"{count} modes of {d // 3} vertices take {3 * 8 * count * d / 1e9:.1f} GB while they are found, of which "
            f"{free / 1e9:.1f} are free; ask for fewer modes."
        )
    return modes


def varying(variance: FloatArray) -> FloatArray:
    """Return those of the falling variances (K,) that are not rounding errors."""
    return variance[variance > _NO_VARIANCE * variance[0]]


def fix_signs(rows: FloatArray) -> None:
    """Give each mode (K, D), in place, the sign that makes the first of its largest entries positive."""
    for row in rows:
        size = np.abs(row)
        if row[np.argmax(size >= _TIED * size.max())] < 0:
            row *= -1.0


def syrk(block: FloatArray, onto: FloatArray | None = None) -> FloatArray:
    """Return the lower triangle of block @ block.T, (N, N) Fortran-ordered, added to `onto` if given."""
    from scipy.linalg import blas

    dsyrk = cast(Any, blas).dsyrk
    # block.T is Fortran-ordered, so BLAS reads it in place.
    if onto is None:
        return dsyrk(1.0, block.T, trans=1, lower=1)
    return dsyrk(1.0, block.T, beta=1.0, c=onto, trans=1, lower=1, overwrite_c=1)


@dataclass(frozen=True, eq=False)
class Covariance:
    """The covariance C of the rows of a table, as an operator.

    Args:
        table: N rows of D numbers.
        mean: (D,) mean of the rows.
        squares: sum of all squares.
    """

    table: RowTable
    mean: FloatArray
    squares: float

    @staticmethod
    def of(table: RowTable) -> Covariance:
        """Compute mean and squares in one pass over the rows.

        Raises:
            InputError: values that are not finite.
        """
        mean, squares = np.zeros(table.columns), 0.0
        for _, block in table.row_blocks():
            mean += block.sum(axis=0)
            squares += float(np.vdot(block, block))
        mean /= table.rows
        if not (np.isfinite(squares) and np.isfinite(mean).all()):
            raise InputError("The training shapes have values that are not finite.")
        return Covariance(table, mean, squares)

    def total(self) -> float:
        """Return the total variance, the trace of the covariance.

        Raises:
            InputError: all rows are equal up to rounding.
        """
        n = self.table.rows
        centred = self.squares - n * float(self.mean @ self.mean)
        if centred <= _NO_VARIATION * self.squares:
            raise InputError(ALL_EQUAL)
        return centred / (n - 1)

    def gram(self) -> FloatArray:
        """Return the lower triangle of the products (N, N) of the centred rows (P1, P2, P3).

        Raises:
            InputError: all rows are equal.
        """
        n, start = self.table.rows, 0
        gram = np.zeros((n, n), order="F")
        for block in self.table.column_blocks():
            block -= self.mean[start : start + block.shape[1]]
            start += block.shape[1]
            gram = syrk(block, onto=gram)
        if float(gram.trace()) <= _ROUNDING**2 * self.squares:
            raise InputError(ALL_EQUAL)
        return gram

    def __call__(self, Q: FloatArray) -> FloatArray:
        """Return C Q by one pass over the rows, centred by the rank-one term."""
        from scipy.linalg import blas

        n = self.table.rows
        onto = np.zeros(Q.shape, order="F")
        dgemm = cast(Any, blas).dgemm
        for _, block in self.table.row_blocks():
            onto = dgemm(1.0, block.T, block @ Q, beta=1.0, c=onto, overwrite_c=1)
        onto -= np.outer(self.mean, n * (self.mean @ Q))
        onto /= n - 1
        return onto


def _max_columns(d: int) -> int:
    return _BASIS_BYTES // (8 * d)


def _find_leading(
    apply: Callable[[FloatArray], FloatArray],
    size: int,
    modes: int | float,
    total: float,
    stop: Stop,
    seed: int,
    passes: Path | None = None,
    on_pass: Callable[[int, float], None] | None = None,
) -> LeadingEigenpairs | None:
    half = -(-modes // 2) if isinstance(modes, int) else 0
    block = min(max(half, _LEAST_BLOCK), _MOST_BLOCK)
    most = max(_max_columns(size), modes + 4 * block if isinstance(modes, int) else 0)
    return leading(
        apply, size, modes, total, block=block, most_columns=most, stop=stop, seed=seed, passes=passes, on_pass=on_pass
    )


def _components_by_gram(
    covariance: Covariance, modes: int | float | None, seed: int, *, exact: bool
) -> tuple[FloatArray, FloatArray, float]:
    """Return variances (K,), modes (K, D) and the total variance, by the eigenvectors of the Gram matrix (P4, P5).

    Unless `exact`, the first eigenvectors of a large one are found by block Krylov.
    """
    table, gram = covariance.table, covariance.gram()
    n, trace = table.rows, float(gram.trace())
    pairs = None
    if not exact and modes is not None and n > _WHOLE and (isinstance(modes, float) or modes <= n // _FEW):
        from scipy.linalg import blas

        dsymm = cast(Any, blas).dsymm
        pairs = _find_leading(lambda Y: dsymm(1.0, gram, Y, lower=1), n, modes, trace, _TO_ROUNDING, seed)
    if pairs is None:
        pairs = largest_eigenpairs(gram, modes if isinstance(modes, int) else n - 1, overwrite=True)
    values, vectors = pairs[:2]
    variance = varying(values / (n - 1))
    if isinstance(modes, float):
        variance = variance[: modes_for_variance(variance, modes, trace / (n - 1))]
    weights = vectors[:, : len(variance)] / np.sqrt(variance * (n - 1))
    rows = np.zeros((len(variance), table.columns))
    for start, block in table.row_blocks():
        rows += weights[start : start + len(block)].T @ block
    rows -= np.outer(weights.sum(axis=0), covariance.mean)
    orthonormal_rows(rows)
    return variance, rows, trace / (n - 1)


def orthonormal_rows(rows: FloatArray) -> None:
    """Orthonormalise modes (K, D), which are orthonormal except for rounding, and fix their signs, in place."""
    fix_signs(rows)
    # Faint modes lose orthogonality by the square of the spread of the spectrum; one Cholesky step restores it.
    overlap = rows @ rows.T
    if np.abs(overlap - np.eye(len(rows))).max() > 1e-12:
        from scipy.linalg import solve_triangular

        factor = np.linalg.cholesky(overlap)
        for start in range(0, rows.shape[1], _BLOCK):
            part = slice(start, start + _BLOCK)
            rows[:, part] = np.asarray(solve_triangular(factor, rows[:, part], lower=True))
