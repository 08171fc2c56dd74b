"""Smooth local versions of a model's modes: a prior for the part of a new shape outside the span of a few shapes.

The part outside varies as the modes do, only locally, so their covariance damped with distance predicts it (Wilms,
Handels and Ehrhardt, Medical Image Analysis 38, 2017). Its total variance is measured on held-out shapes.
"""

from __future__ import annotations

import numpy as np

from shapespace.geometry.normals import rms_size
from shapespace.model.krylov import largest_eigenpairs
from shapespace.types import FloatArray, IntArray

_CENTRES = 40  # centres of the smooth fields, spread evenly over the mean
_FIELD_SHARE = 0.999  # share of the variance of the smooth fields that their leading ones must have
MOST_PRODUCTS = 600  # products of modes and fields, the columns of the decomposition; time grows with the square
_BLOCK = 250
"""Number of vertices of a block: the products of all at once are many times as large as the model."""
_RANGE_SHARE = 0.6  # share of the model's size; range of the smooth fields
_FAINT = 1e-7
"""Share of the variance of the modes below which local modes are omitted, to save time."""
_ROOM = 4
"""Smallest ratio of the number of coordinates to local modes, so that these cannot represent every shape."""


def local_modes(
    mean: FloatArray, modes: FloatArray, variance: FloatArray, left_mm2: float, most: int
) -> tuple[FloatArray, FloatArray]:
    """Return local modes (3V, R), orthonormal and orthogonal to `modes`, and their variances (R,), mm^2.

    Args:
        mean: (V, 3) vertices of the mean, mm.
        modes: (3V, K) orthonormal modes.
        variance: (K,) variance of each mode, mm^2.
        left_mm2: variance of new shapes outside `modes`, mm^2, which is the sum over all local modes.
        most: maximum number of local modes.
    """
    fields = smooth_fields(mean, _RANGE_SHARE * rms_size(mean))
    stddev = np.sqrt(variance)
    mode, damping = strongest_products(stddev, np.linalg.norm(fields, axis=0), MOST_PRODUCTS)
    vertex_modes = modes.reshape(*mean.shape, -1)

    def products(rows: slice) -> FloatArray:
        field = fields[rows][:, damping] * stddev[mode]
        return (vertex_modes[rows][:, :, mode] * field[:, None]).reshape(-1, len(mode))

    blocks = vertex_blocks(len(mean))
    inside, gram = np.zeros((len(variance), len(mode))), np.zeros((len(mode), len(mode)))
    for rows in blocks:
        part = products(rows)
        inside += vertex_modes[rows].reshape(len(part), -1).T @ part
        gram += part.T @ part
    gram -= inside.T @ inside
    total, count = float(np.trace(gram)), min(most, len(gram), mean.size // _ROOM)
    if count < 1 or total <= 0 or left_mm2 <= 0:
        return np.zeros((mean.size, 0)), np.zeros(0)
    value, vector = largest_eigenpairs(gram, count)
    significant = value * left_mm2 / total > _FAINT * variance.sum()
    mix = vector[:, significant] / np.sqrt(value[significant])
    local = np.concatenate([products(rows) @ mix for rows in blocks]) - modes @ (inside @ mix)
    # Faint local modes lose precision if most of them lies inside the span of the modes.
    return np.linalg.qr(local)[0], value[significant] * left_mm2 / total


def vertex_blocks(count: int) -> list[slice]:
    """Return slices that cover `count` vertices, block by block."""
    return [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]


def strongest_products(stddev: FloatArray, size: FloatArray, count: int) -> tuple[IntArray, IntArray]:
    """Return mode and field of the `count` products with the most variance, of modes (K,) and fields (m,) of a size."""
    strength = np.outer(stddev, size)
    order = np.argsort(strength, axis=None)[::-1][:count]
    mode, field = np.unravel_index(order, strength.shape)
    return mode.astype(np.int32), field.astype(np.int32)


def smooth_fields(x: FloatArray, range_mm: float) -> FloatArray:
    """Return fields f (V, m) with sum_m f_m(x) f_m(y) near exp(-|x - y|^2 / range^2), without their mean.

    A constant field times a mode is that mode.
    """
    centres = x[_spread_out(x, _CENTRES)]
    bumps = np.exp(-((x[:, None] - centres) ** 2).sum(axis=2) / (0.5 * range_mm**2))
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
    bumps -= bumps.mean(axis=0)
    left, value, _ = np.linalg.svd(bumps, full_matrices=False)
    m = int(np.searchsorted(np.cumsum(value**2) / (value**2).sum(), _FIELD_SHARE)) + 1
    return left[:, :m] * value[:m]


def _spread_out(x: FloatArray, count: int) -> IntArray:
    """Return indices of `count` points far from each other (farthest-point sampling)."""
    chosen = np.zeros(min(count, len(x)), dtype=np.int32)
    distance = np.full(len(x), np.inf)
    for i in range(1, len(chosen)):
        distance = np.minimum(distance, ((x - x[chosen[i - 1]]) ** 2).sum(axis=1))
        chosen[i] = int(distance.argmax())
    return chosen
