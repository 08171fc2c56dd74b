"""The leading eigenvectors of a large symmetric matrix that is known by its products alone: block Krylov.

Block Lanczos with full reorthogonalisation and Rayleigh-Ritz over all blocks: Golub and Underwood, Mathematical
Software III, 1977; Musco and Musco, NeurIPS 2015, for how few products it takes. Each step is one product, so where the
matrix is that of shapes on a disk, one pass over them.
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
"""New directions shorter than this share of the first eigenvalue are rounding."""


class Leading(NamedTuple):
    """Eigenvalues and eigenvectors.

    Args:
        values: (K,), falling.
        vectors: (D, K), orthonormal.
        residuals: (K,) |C v - lambda v| of each, as found by a product with them.
    """

    values: FloatArray
    vectors: FloatArray
    residuals: FloatArray


@dataclass(frozen=True)
class Stop:
    """When the eigenvectors are good enough: |C v - lambda v| bounds how far each is turned, by its gap.

    Args:
        radians: that a mode may be turned by.
        least_gap: eigenvalues nearer than this share of the first are not separated.
        enough: residual, as a share of the first eigenvalue, that will do where the basis may not grow any more.
    """

    radians: float = 1e-6
    least_gap: float = 1e-6
    enough: float = 1e-6

    def reached(self, values: FloatArray, residuals: FloatArray) -> bool:
        """Return whether all modes are: `values` (K + 1,) with the next one, `residuals` (K,)."""
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
) -> Leading | None:
    """Return the leading eigenvectors of C (D, D); None where a basis of `most_columns` does not hold them.

    Args:
        apply: Q (D, b) -> C Q; C is symmetric and positive.
        size: D.
        modes: how many; a float for as many as hold that share of `total`.
        total: trace of C.
        block: columns of a product.
        most_columns: of the basis.
        stop: when to.
        seed: of the first block.
        passes: the folder of this matrix, these modes and this seed alone where each pass is kept, so that a run that
            is killed goes on with the pass it was in; None keeps nothing.
        on_pass: called with the number of a pass and the largest residual after it as a share of the first eigenvalue.
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
            products = _taken_off(W, basis)
            products += _taken_off(W, basis)
            least = _DEPENDENT * float(np.abs(T).max(initial=np.abs(products).max()))
            Q, beyond = _orthonormal(W, basis, least)
            if file is not None:
                write_arrays(file, {"block": Q, "products": products, "beyond": beyond})
        else:
            Q, products, beyond = kept["block"], kept["products"], kept["beyond"]
        m = len(T)
        own = (products[m:] + products[m:].T) / 2
        T = np.block([[T, products[:m]], [products[:m].T, own]])
        full, exhausted = len(T) + Q.shape[1] > most_columns, not Q.shape[1]
        values, S = largest_eigenpairs(T)
        count = _wanted(values, modes, total)
        if count is not None or exhausted:
            count = count or len(T)
            residuals = np.linalg.norm(beyond @ S[len(S) - beyond.shape[1] :, :count], axis=0)
            if on_pass is not None:
                on_pass(step, float(residuals.max() / values[0]))
            reached = stop.reached(np.append(values, 0.0)[: count + 1], residuals)
            if exhausted or reached or (full and residuals.max() <= stop.enough * values[0]):
                ritz = _refined(apply, basis, S[:, :count])
                if exhausted or ritz.residuals.max() <= stop.enough * ritz.values[0]:
                    return ritz
        if full:
            return None


def largest_eigenpairs(
    matrix: FloatArray, count: int | None = None, *, overwrite: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Return the `count` largest eigenvalues of a symmetric matrix, falling, and their vectors as columns.

    Args:
        matrix: (N, N), of which the lower triangle is read.
        count: K; None, or more than N, for all.
        overwrite: whether the matrix may be destroyed, which saves its memory.
    """
    from scipy.linalg import eigh  # takes a moment, which whoever only reads models need not wait for

    n = len(matrix)
    wanted = (max(n - (count or n), 0), n - 1)
    values, vectors = eigh(matrix, subset_by_index=wanted, check_finite=False, overwrite_a=overwrite)
    return np.asarray(values[::-1], dtype=np.float64), np.asarray(vectors[:, ::-1], dtype=np.float64)


def _wanted(values: FloatArray, modes: int | float, total: float) -> int | None:
    """Return how many modes to look for, or None where the basis is yet too small for them and one more."""
    if isinstance(modes, int):
        return modes if len(values) > modes else None
    held = np.cumsum(values) >= modes * total
    return int(held.argmax()) + 1 if held[:-1].any() else None


def _taken_off(W: FloatArray, basis: list[FloatArray]) -> FloatArray:
    """Take the part of `W` (D, b) along the basis off it, and return its products with it (m, b)."""
    products = [Q.T @ W for Q in basis]
    for Q, product in zip(basis, products, strict=True):
        W -= Q @ product
    return np.vstack(products)


def _orthonormal(W: FloatArray, basis: list[FloatArray], least: float) -> tuple[FloatArray, FloatArray]:
    """Return Q (D, b') and B (b', b) so that W is Q B but for what is shorter than `least`, Q orthogonal to `basis`."""
    Q, R = np.linalg.qr(W)
    U, lengths, Vt = np.linalg.svd(R)
    there = lengths > least
    Q = Q @ U[:, there]
    # Short directions were blown up together with the rounding along the basis.
    _taken_off(Q, basis)
    Q, R = np.linalg.qr(Q)
    return Q, R @ (lengths[there, None] * Vt[there])


def _refined(apply: Callable[[FloatArray], FloatArray], basis: list[FloatArray], S: FloatArray) -> Leading:
    """Return the eigenvectors within the span of the sums `S` (m, K) of the basis, and what a product says of them."""
    V, column = np.zeros((len(basis[0]), S.shape[1])), 0
    for Q in basis:
        V += Q @ S[column : column + Q.shape[1]]
        column += Q.shape[1]
    CV = apply(V)
    small = V.T @ CV
    values, R = largest_eigenpairs((small + small.T) / 2)
    V, CV = V @ R, CV @ R
    return Leading(values, V, np.linalg.norm(CV - V * values, axis=0))
