"""Principal components of shapes on a disk, which are read by blocks: equations 1 to 5 of the paper, divisor N - 1.

Up to `EXACT` shapes by their Gram matrix, accumulated over blocks of columns; above, by block Krylov over blocks of
rows, without the Gram or the covariance matrix. Shapes stand in the file as differences from a template near their
mean, in single precision; all sums are in double precision, in one order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np

from shapespace.errors import InputError
from shapespace.io.containers.row_spill import Spill
from shapespace.io.memory_cache import available_bytes
from shapespace.model.krylov import KeptPasses, Leading, Stop, leading
from shapespace.model.pca import (
    ALL_EQUAL,
    Modes,
    PrincipalComponents,
    check_share,
    checked_modes,
    fix_signs,
    modes_for_variance,
    orthonormal_rows,
    syrk,
    varying,
)
from shapespace.types import FloatArray

EXACT = 15_000
"""Shapes of which the Gram matrix is made: 1.8 GB."""
_WHOLE = 1000
"""Shapes of which all eigenvectors are found at once, which is then as quick as to find the first."""
_BASIS_BYTES = 768 << 20  # bytes of the Krylov basis in memory
# vectors in a block: products of a few columns are slow, many cost memory
_LEAST_BLOCK, _MOST_BLOCK = 32, 128
_TO_ROUNDING = Stop(radians=1e-8, least_gap=1e-5, enough=1e-12)
# 1/8 of the shapes: more modes are computed by the full decomposition; and a relative variance that is rounding
_FEW, _NO_VARIATION = 8, 1e-12


def large_components(
    shapes: Spill,
    modes: Modes,
    *,
    seed: int = 0,
    passes: KeptPasses | None = None,
    on_pass: Callable[[int, float], None] | None = None,
) -> PrincipalComponents:
    """Return the principal components of the rows of `shapes`, each with its residual.

    Args:
        shapes: N rows of D numbers, mm, about a template; the mean is returned about it too.
        modes: as of `principal_components`.
        seed: of the first block of directions.
        passes: where the passes over many shapes are kept; None keeps nothing.
        on_pass: called with the number of a pass and the largest residual after it as a share of the first variance.

    Raises:
        InputError: values that are not finite, no variation, or more modes than memory holds.
        FileError: the file cannot be read, or a pass not kept.
    """
    n, d = shapes.rows, shapes.columns
    modes = checked_large_modes(modes, n, d)
    mean, total = _mean_and_total(shapes)
    covariance = _Covariance(shapes, mean)
    if n <= EXACT:
        variance, rows = _by_gram(shapes, mean, modes, total, seed)
        CV = covariance(rows.T)
        residuals = np.linalg.norm(CV - rows.T * variance, axis=0)
    else:
        # All modes of so many shapes were refused.
        leading_modes = _leading(
            covariance, d, cast(int | float, modes), total, Stop(), seed, passes=passes, on_pass=on_pass
        )
        if leading_modes is None:
            raise InputError(
                f"The modes asked for cannot be separated from the next ones in {_columns(d)} directions, the number "
                "that memory is reserved for; ask for fewer modes."
            )
        variance = varying(leading_modes.values)
        rows = np.ascontiguousarray(leading_modes.vectors.T[: len(variance)])
        fix_signs(rows)
        residuals = leading_modes.residuals[: len(variance)]
    return PrincipalComponents(mean, rows.T, variance, total, n, residuals)


def checked_large_modes(modes: Modes, n: int, d: int) -> int | float | None:
    """Return `modes` as asked for of n shapes of d numbers on a disk, before they are looked at.

    Raises:
        InputError: more modes than memory holds.
    """
    modes = checked_modes(modes, n)
    if isinstance(modes, float):
        check_share(modes)
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


def _mean_and_total(shapes: Spill) -> tuple[FloatArray, float]:
    """Return the mean (D,) of the rows and the trace of their covariance."""
    n, d = shapes.rows, shapes.columns
    mean, squares = np.zeros(d), 0.0
    for _, block in shapes.row_blocks():
        mean += block.sum(axis=0)
        squares += float(np.vdot(block, block))
    mean /= n
    if not (np.isfinite(squares) and np.isfinite(mean).all()):
        raise InputError("The training shapes hold values that are not finite.")
    total = (squares - n * float(mean @ mean)) / (n - 1)
    if total * (n - 1) <= _NO_VARIATION * squares:
        raise InputError(ALL_EQUAL)
    return mean, total


class _Covariance:
    """C Q by one pass over the rows, centred by the rank-one term."""

    def __init__(self, shapes: Spill, mean: FloatArray) -> None:
        self.shapes, self.mean = shapes, mean

    def __call__(self, Q: FloatArray) -> FloatArray:
        from scipy.linalg import blas

        n = self.shapes.rows
        onto = np.zeros(Q.shape, order="F")
        dgemm = cast(Any, blas).dgemm
        for _, block in self.shapes.row_blocks():
            onto = dgemm(1.0, block.T, block @ Q, beta=1.0, c=onto, overwrite_c=1)
        onto -= np.outer(self.mean, n * (self.mean @ Q))
        onto /= n - 1
        return onto


def _columns(d: int) -> int:
    return _BASIS_BYTES // (8 * d)


def _leading(
    apply: Callable[[FloatArray], FloatArray],
    size: int,
    modes: int | float,
    total: float,
    stop: Stop,
    seed: int,
    passes: KeptPasses | None = None,
    on_pass: Callable[[int, float], None] | None = None,
) -> Leading | None:
    half = -(-modes // 2) if isinstance(modes, int) else 0
    block = min(max(half, _LEAST_BLOCK), _MOST_BLOCK)
    most = max(_columns(size), modes + 4 * block if isinstance(modes, int) else 0)
    return leading(
        apply, size, modes, total, block=block, most_columns=most, stop=stop, seed=seed, passes=passes, on_pass=on_pass
    )


def _by_gram(
    shapes: Spill, mean: FloatArray, modes: int | float | None, total: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return variances (K,) and modes (K, D), by the eigenvectors of the Gram matrix."""
    n = shapes.rows
    gram = _gram(shapes, mean)
    values, vectors = _eigenvectors(gram, modes, total * (n - 1), seed)
    variance = varying(values / (n - 1))
    if isinstance(modes, float):
        variance = variance[: modes_for_variance(variance, modes, total)]
    weights = vectors[:, : len(variance)] / np.sqrt(variance * (n - 1))
    rows = np.zeros((len(variance), shapes.columns))
    for start, block in shapes.row_blocks():
        rows += weights[start : start + len(block)].T @ block
    rows -= np.outer(weights.sum(axis=0), mean)
    orthonormal_rows(rows)
    return variance, rows


def _gram(shapes: Spill, mean: FloatArray) -> FloatArray:
    """Return the lower triangle of the products (N, N) of the centred rows."""
    gram, start = np.zeros((shapes.rows, shapes.rows), order="F"), 0
    for block in shapes.column_blocks():
        block -= mean[start : start + block.shape[1]]
        start += block.shape[1]
        gram = syrk(block, onto=gram)
    return gram


def _eigenvectors(
    gram: FloatArray, modes: int | float | None, trace: float, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Return eigenvalues, falling, and vectors (N, K) of the lower triangle `gram`: as many as `modes`, or more."""
    from scipy.linalg import blas, eigh

    n = len(gram)
    dsymm = cast(Any, blas).dsymm
    if modes is not None and n > _WHOLE and (isinstance(modes, float) or modes <= n // _FEW):
        leading_modes = _leading(lambda Y: dsymm(1.0, gram, Y, lower=1), n, modes, trace, _TO_ROUNDING, seed)
        if leading_modes is not None:
            return leading_modes.values, leading_modes.vectors
    wanted = modes if isinstance(modes, int) else n - 1
    values, vectors = eigh(gram, lower=True, subset_by_index=(n - wanted, n - 1), check_finite=False, overwrite_a=True)
    return values[::-1], vectors[:, ::-1]
