"""Probabilistic principal components of shapes with missing vertices, by expectation and maximisation.

A shape is mean + W y + e (C21), y normal of unit variance and e normal of variance `noise` in every coordinate. Each
round computes the distribution of y given the observed vertices of a shape, mean and covariance (E), and then the
distributions of the mean and W and the likeliest noise (M): each vertex from the shapes that observe it. As the
covariances count, missing vertices do not narrow the variances. Roweis, NIPS 10, 1998; Tipping and Bishop, JRSS B
61(3), 1999. Equations Cn are those of docs/missing.md.

There are far more coordinates than shapes, so the likeliest W alone overfits vertices that few shapes observe, and
predicts missing vertices worse than the mean does. So W has a normal prior, one width per mode, and its covariance
counts too (variational Bayes: Bishop, ICANN 1999; Ilin and Raiko, JMLR 11, 2010); the width of modes without evidence
decreases to zero. No array of 3V x 3V is formed: a round costs one K x K system per shape, and one per pattern of
missing vertices.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from shapespace.types import BoolArray, FloatArray, IntArray

_LEAST_NOISE = 1e-9
"""Smallest noise as a share of the variance of a coordinate: shapes without noise do not determine it."""
_FIRST_NOISE = 1e-3
"""Smallest initial noise as a share of the variance: without noise the iteration would not move."""
_CONVERGED = 1e-5
"""Increase of the bound, in nats per observed coordinate, at which the iteration ends."""
_MOST_ROUNDS = 60  # limit of EM iterations
_BLOCK = 512  # vertices at a time; bounds the memory of their (k + 1)^2 moments


@dataclass(frozen=True, eq=False)
class Ppca:
    """Probabilistic PCA of N shapes with V vertices, K modes and P patterns of missing vertices.

    Args:
        W: (V, 3, K + 1) mm, displacement of each vertex by each of y, and last the mean.
        W_covariance: (P, K + 1, K + 1) covariance of W for each coordinate of the vertices of a pattern.
        noise: residual variance of a coordinate, mm^2.
        y: (N, K + 1) means of the latent coefficients of each shape, in standard deviations, and last a one.
        y_covariance: (N, K + 1, K + 1) covariances of the latent coefficients of each shape.
        width: (K,) variance of a coordinate of each mode, mm^2.
        patterns: patterns of the missing vertices.
        bounds: (rounds,) bound of the log probability of the observed vertices after each round, nats, up to a
            constant; it never falls.
    """

    W: FloatArray
    W_covariance: FloatArray
    noise: float
    y: FloatArray
    y_covariance: FloatArray
    width: FloatArray
    patterns: Patterns
    bounds: FloatArray

    def estimate(self, shape: int) -> FloatArray:
        """Return the conditional means of the missing vertices of a shape, (M, 3) mm."""
        return np.asarray(self.W[self.patterns.hidden[shape]] @ self.y[shape], dtype=np.float64)  # C27

    def residual_variance(self, shape: int) -> FloatArray:
        """Return the variance (M,), mm^2, of each coordinate of a missing vertex in addition to that of y (C28)."""
        second = np.outer(self.y[shape], self.y[shape]) + self.y_covariance[shape]
        known: FloatArray = np.asarray(np.einsum("pab,ab->p", self.W_covariance, second), dtype=np.float64)
        return known[self.patterns.of_vertex[self.patterns.hidden[shape]]] + self.noise  # C28


@dataclass(frozen=True, eq=False)
class Patterns:
    """Patterns of missing vertices: vertices that are missing in the same shapes have one pattern.

    Args:
        missing: (P, N) True where the vertices of a pattern are missing in a shape.
        of_vertex: (V,) pattern of each vertex.
        count: (P,) number of vertices of each pattern.
        hidden: missing vertices of each of the N shapes.
    """

    missing: BoolArray
    of_vertex: IntArray
    count: IntArray
    hidden: tuple[IntArray, ...]

    @staticmethod
    def of(observed: BoolArray) -> Patterns:
        """Return the patterns of missing vertices from `observed` (N, V), True at observed vertices."""
        packed, of_vertex, count = np.unique(
            np.packbits(~observed, axis=0).T, axis=0, return_inverse=True, return_counts=True
        )
        missing = np.unpackbits(packed, axis=1, count=len(observed)).astype(np.bool_)
        hidden = tuple(np.flatnonzero(~own).astype(np.int32) for own in observed)
        return Patterns(missing, of_vertex.reshape(-1).astype(np.int32), count.astype(np.int32), hidden)

    @cached_property
    def weight(self) -> FloatArray:
        """(P,) number of coordinates of each pattern."""
        return 3.0 * self.count.astype(np.float64)


def ppca(
    shapes: FloatArray,
    observed: BoolArray,
    modes: int,
) -> Ppca:
    """Return the probabilistic principal components of aligned `shapes`.

    Args:
        shapes: (N, V, 3) mm; missing vertices have an initial guess, such as the mean.
        observed: (N, V) True for observed vertices; each vertex is observed in at least one shape.
        modes: K, below N; modes without evidence vanish.
    """
    patterns, n_observed = Patterns.of(observed), 3 * int(observed.sum())
    about = shapes.mean(axis=0)
    centred = np.where(observed[:, :, None], shapes - about, 0.0)
    size = float((centred**2).sum())
    W, noise = _from_complete(shapes, modes)
    width = np.maximum((W[:, :, :modes] ** 2).mean(axis=(0, 1)), _LEAST_NOISE * size / n_observed)
    W_covariance = np.zeros((len(patterns.count), modes + 1, modes + 1))
    bounds: list[float] = []
    while True:
        y, y_covariance, of_y = _expect(centred, patterns, W, W_covariance, noise)
        ridge = np.append(noise / width, 0.0)
        W, W_covariance, explained, of_W = _maximise(centred, patterns, y, y_covariance, ridge, noise)
        noise = max((size - explained) / n_observed, _LEAST_NOISE * size / n_observed)  # C24
        spread = np.einsum("pkk,p->k", W_covariance[:, :modes, :modes], patterns.weight)
        width = ((W[:, :, :modes] ** 2).sum(axis=(0, 1)) + spread) / (3 * len(about))  # C25
        bounds.append(of_y + of_W - 0.5 * (n_observed * np.log(noise) + 3 * len(about) * float(np.log(width).sum())))
        converged = len(bounds) > 1 and bounds[-1] - bounds[-2] <= _CONVERGED * n_observed  # C26
        if converged or len(bounds) == _MOST_ROUNDS:
            W[:, :, modes] += about
            return Ppca(
                W=W,
                W_covariance=W_covariance,
                noise=noise,
                y=y,
                y_covariance=y_covariance,
                width=width,
                patterns=patterns,
                bounds=np.array(bounds),
            )


def _from_complete(shapes: FloatArray, modes: int) -> tuple[FloatArray, float]:
    """Return the likeliest W (V, 3, K + 1) and noise for complete shapes; the last column of W, the mean, is 0."""
    n, vertices = shapes.shape[:2]
    flat = (shapes - shapes.mean(axis=0)).reshape(n, -1)
    values, vectors = np.linalg.eigh(flat @ flat.T)
    values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
    noise = max(float(values[modes:].sum()), _FIRST_NOISE * float(values.sum())) / (n * (flat.shape[1] - modes))
    floored = np.maximum(values[:modes], 2 * n * noise)
    W = (flat.T @ vectors[:, :modes]) * np.sqrt((floored / n - noise) / floored)
    return np.column_stack([W, np.zeros(len(W))]).reshape(vertices, 3, modes + 1), noise


def _expect(
    centred: FloatArray,
    patterns: Patterns,
    W: FloatArray,
    W_covariance: FloatArray,
    noise: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Return mean (N, K + 1) and covariance of y given the observed vertices (C22), and its part of the bound."""
    n, k = len(centred), W.shape[-1] - 1
    flat = W.reshape(-1, k + 1)
    weighted = W_covariance.reshape(len(patterns.count), -1) * patterns.weight[:, None]
    summed = flat.T @ flat + weighted.sum(axis=0).reshape(k + 1, k + 1)
    unseen = (patterns.missing.T.astype(np.float64) @ weighted).reshape(n, k + 1, k + 1)
    y, covariance, bound = np.ones((n, k + 1)), np.zeros((n, k + 1, k + 1)), 0.0
    of_whole: tuple[FloatArray, FloatArray, float] | None = None
    for i in range(n):
        # Shapes without missing vertices share one system.
        solved = None if len(patterns.hidden[i]) else of_whole
        if solved is None:
            hidden = W[patterns.hidden[i]].reshape(-1, k + 1)
            square = summed - hidden.T @ hidden - unseen[i]
            root: FloatArray = np.asarray(np.linalg.cholesky(square[:k, :k] + noise * np.eye(k)), dtype=np.float64)
            half = np.asarray(solve_triangular(root, np.eye(k), lower=True), dtype=np.float64)
            solved = square, half.T @ half, float(np.log(root.diagonal()).sum())
            of_whole = of_whole if len(patterns.hidden[i]) else solved
        square, inverse, log_root = solved
        y[i, :k] = inverse @ (flat[:, :k].T @ centred[i].reshape(-1) - square[:k, k])  # C22
        covariance[i, :k, :k] = noise * inverse
        bound += 0.5 * k * np.log(noise) - log_root
        bound -= 0.5 * float(y[i, :k] @ y[i, :k] + covariance[i].trace())
    return y, covariance, bound


def _maximise(
    centred: FloatArray,
    patterns: Patterns,
    y: FloatArray,
    y_covariance: FloatArray,
    ridge: FloatArray,
    noise: float,
) -> tuple[FloatArray, FloatArray, float, float]:
    """Return W (V, 3, K + 1) and its covariance by pattern (C23), the explained squares, and its part of the bound.

    Each vertex has normal equations over the shapes that observe it; the equations differ by pattern.

    Args:
        centred: (N, V, 3) centred shapes, zero at missing vertices.
        patterns: patterns of the missing vertices.
        y: (N, K + 1) means of the latent coefficients.
        y_covariance: (N, K + 1, K + 1) covariances of the latent coefficients.
        ridge: (K + 1,) noise over the width of the prior.
        noise: residual variance of a coordinate, mm^2.
    """
    n, k1 = y.shape
    products = (y[:, :, None] * y[:, None, :] + y_covariance).reshape(n, -1)
    total = products.sum(axis=0) + np.diag(ridge).reshape(-1)
    right = (y.T @ centred.reshape(n, -1)).T.reshape(-1, 3, k1)
    W, covariance = np.empty_like(right), np.empty((len(patterns.count), k1, k1))
    explained, bound = 0.0, 0.0
    for start in range(0, len(patterns.count), _BLOCK):
        part = slice(start, start + _BLOCK)
        systems = (total - patterns.missing[part].astype(np.float64) @ products).reshape(-1, k1, k1)
        inverse: FloatArray = np.asarray(np.linalg.inv(systems), dtype=np.float64)
        covariance[part] = noise * inverse
        weight = patterns.weight[part]
        # Trace of the covariance of W times the products of y, over these coordinates.
        explained -= noise * float(weight @ (k1 - np.einsum("pkk,k->p", inverse, ridge)))
        bound += 0.5 * float(weight @ (k1 * np.log(noise) - np.linalg.slogdet(systems)[1]))
    for start in range(0, len(W), _BLOCK):
        part = slice(start, start + _BLOCK)
        W[part] = right[part] @ (covariance[patterns.of_vertex[part]] / noise)  # C23
    # The explained squares of the likeliest plane, without the pull of the prior.
    explained += float((W * right).sum() + (W**2 @ ridge).sum())
    return W, covariance, explained, bound
