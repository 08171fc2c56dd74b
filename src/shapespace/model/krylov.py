"""Leading eigenvectors of a large symmetric matrix from its products alone: block Krylov.

Block Lanczos with full reorthogonalisation and Rayleigh-Ritz over all blocks: Golub and Underwood, Mathematical
Software III, 1977; Musco and Musco, NeurIPS 2015, for the small number of products. Each step is one product, so if the
matrix is that of shapes on a disk, one pass over the shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapespace.io.containers.archives import kept_arrays, write_arrays
from shapespace.types import FloatArray

_DEPENDENT = 1e-13
"""New directions shorter than this share of the first eigenvalue are rounding errors."""


class LeadingEigenpairs(NamedTuple):
    """Eigenvalues and eigenvectors.

    Args:
        values: (K,) eigenvalues, falling.
        vectors: (D, K) orthonormal eigenvectors.
        residuals: (K,) |C v - lambda v| of each eigenvector, from a product with it.
    """

    values: FloatArray
    vectors: FloatArray
    residuals: FloatArray


@dataclass(frozen=True)
class Stop:
    """Stopping rule for the eigenvectors: |C v - lambda v| bounds the rotation of each, by its gap.

    Args:
        radians: largest angle of a mode to the exact one, radians.
        least_gap: smallest gap, as a share of the first eigenvalue, of eigenvalues that are separated.
        enough: residual, as a share of the first eigenvalue, that is sufficient if the basis cannot grow any more.
    """

    radians: float = 1e-6
    least_gap: float = 1e-6
    enough: float = 1e-6

    def reached(self, values: FloatArray, residuals: FloatArray) -> bool:
        """Return whether all modes are converged: `values` (K + 1,) with the next eigenvalue, `residuals` (K,)."""
        steps = -np.diff(values)
        gaps = np.minimum(steps, np.concatenate([steps[:1], steps[:-1]]))
        return bool((residuals <= self.radians * np.maximum(gaps, self.least_gap * values[0])).all())


def leading(
    apply: Callable[[FloatArray], FloatArray],
    size: int,
    modes: int | float,
    total: float,
    *,
    block: int,
    most_columns: int,
    stop: Stop,
    seed: int = 0,
    passes: Path | None = None,
    on_pass: Callable[[int, float], None] | None = None,
) -> LeadingEigenpairs | None:
    """Return the leading eigenvectors of C (D, D); None if a basis of `most_columns` is too small for them.

    Args:
        apply: function Q (D, b) -> C Q; C is symmetric and positive.
        size: D.
        modes: number of eigenvectors; a float for the number with that share of `total`.
        total: trace of C.
        block: number of columns of a product.
        most_columns: maximum number of columns of the basis.
        stop: stopping rule.
        seed: seed of the first block.
        passes: folder, used for this matrix, these modes and this seed only, where each pass is kept, so that a run
            that was killed continues with its last pass; None keeps nothing.
        on_pass: function called with the number of a pass and the largest residual after it as a share of the first
            eigenvalue.
    """
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal((size, min(block, size))))[0]
    basis: list[FloatArray] = []
    T = np.empty((0, 0))
    while True:
        basis.append(Q)
        step = len(basis)
        file = None if passes is None else passes / f"pass-{step:03d}.npz"
        kept = None if file is None else kept_arrays(file)
        if kept is None:
            W = apply(Q)
            products = _remove_basis(W, basis)
            products += _remove_basis(W, basis)
            least = _DEPENDENT * float(np.abs(T).max(initial=np.abs(products).max()))
            Q, beyond = _orthonormalise(W, basis, least)
            if file is not None:
                write_arrays(file, {"block": Q, "products": products, "beyond": beyond})
        else:
            Q, products, beyond = kept["block"], kept["products"], kept["beyond"]
        m = len(T)
        own = (products[m:] + products[m:].T) / 2
        T = np.block([[T, products[:m]], [products[:m].T, own]])
        full, exhausted = len(T) + Q.shape[1] > most_columns, not Q.shape[1]
        values, S = largest_eigenpairs(T)
        count = _count_wanted(values, modes, total)
        if count is not None or exhausted:
            count = count or len(T)
            residuals = np.linalg.norm(beyond @ S[len(S) - beyond.shape[1] :, :count], axis=0)
            if on_pass is not None:
                on_pass(step, float(residuals.max() / values[0]))
            reached = stop.reached(np.append(values, 0.0)[: count + 1], residuals)
            if exhausted or reached or (full and residuals.max() <= stop.enough * values[0]):
                ritz = _solve_in_span(apply, basis, S[:, :count])
                if exhausted or ritz.residuals.max() <= stop.enough * ritz.values[0]:
                    return ritz
        if full:
            return None


def largest_eigenpairs(
    matrix: FloatArray, count: int | None = None, *, overwrite: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return the `count` largest eigenvalues of a symmetric matrix, falling, and their vectors as columns.

    Args:
        matrix: (N, N) symmetric matrix; only the lower triangle is read.
        count: K; None, or more than N, for all.
        overwrite: whether the matrix may be overwritten, which saves its memory.
    """
    from scipy.linalg import eigh  # slow to import, and readers of models do not need it

    n = len(matrix)
    wanted = (max(n - (count or n), 0), n - 1)
    values, vectors = eigh(matrix, subset_by_index=wanted, check_finite=False, overwrite_a=overwrite)
    return np.asarray(values[::-1], dtype=np.float64), np.asarray(vectors[:, ::-1], dtype=np.float64)


def _count_wanted(values: FloatArray, modes: int | float, total: float) -> int | None:
    """Return the number of modes to compute, or None if the basis is too small for them and one more."""
    if isinstance(modes, int):
        return modes if len(values) > modes else None
    held = np.cumsum(values) >= modes * total
    return int(held.argmax()) + 1 if held[:-1].any() else None


def _remove_basis(W: FloatArray, basis: list[FloatArray]) -> FloatArray:
    """Subtract from `W` (D, b) its part along the basis, in place, and return its products with the basis (m, b)."""
    products = [Q.T @ W for Q in basis]
    for Q, product in zip(basis, products, strict=True):
        W -= Q @ product
    return np.vstack(products)


def _orthonormalise(W: FloatArray, basis: list[FloatArray], least: float) -> tuple[FloatArray, FloatArray]:
    """Return Q (D, b'), orthogonal to `basis`, and B (b', b), so that W is Q B up to directions below `least`."""
    Q, R = np.linalg.qr(W)
    U, lengths, Vt = np.linalg.svd(R)
    there = lengths > least
    Q = Q @ U[:, there]
    # Normalising short directions amplified the rounding along the basis.
    _remove_basis(Q, basis)
    Q, R = np.linalg.qr(Q)
    return Q, R @ (lengths[there, None] * Vt[there])


def _solve_in_span(
    apply: Callable[[FloatArray], FloatArray], basis: list[FloatArray], S: FloatArray
) -> LeadingEigenpairs:
    """Return the eigenvectors within the span of the sums `S` (m, K) of the basis, with residuals from a product."""
    V, column = np.zeros((len(basis[0]), S.shape[1])), 0
    for Q in basis:
        V += Q @ S[column : column + Q.shape[1]]
        column += Q.shape[1]
    CV = apply(V)
    small = V.T @ CV
    values, R = largest_eigenpairs((small + small.T) / 2)
    V, CV = V @ R, CV @ R
    return LeadingEigenpairs(values, V, np.linalg.norm(CV - V * values, axis=0))
