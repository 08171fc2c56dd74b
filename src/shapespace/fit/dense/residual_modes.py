"""Residual modes: mirrored, and smooth local, versions of the model's own modes, for shapes outside its span.

A model of N shapes spans N - 1 directions, and a new shape is never in their span. The part outside varies as the modes
do, only locally: so the covariance of the model damped with distance is a prior for it (Wilms, Handels and Ehrhardt,
Medical Image Analysis 38, 2017). If the mean is symmetric, the mirrored modes are added too, as in
models built with mirrored shapes. Only the part outside the model's span is kept, as further modes in addition to the
model's own, so that b keeps its meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import csr_array

from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.prepared_model import prepare
from shapespace.fit.robust.robust_settings import ResidualSettings
from shapespace.geometry.mirror_plane import find_mirror
from shapespace.geometry.normals import rms_size
from shapespace.io import disk_cache
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.krylov import largest_eigenpairs
from shapespace.model.local_modes import (
    MOST_PRODUCTS,
    smooth_fields,
    strongest_products,
    vertex_blocks,
)
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray

_ALGORITHM_VERSION = 2
"""Part of the key of the disk cache: raise it if `_compute_modes`, `local_modes` or `mirror` compute other modes."""
_LEAST_VALUE = 1e-8  # share of the largest eigenvalue; below are float32 rounding and linear dependence
_SYMMETRIC_SHARE = 0.01
"""Distance of a mean from its mirror image, as a share of its size, up to which it counts as symmetric."""


@dataclass(frozen=True, eq=False)
class ResidualModes:
    """Modes outside the span of the model.

    Args:
        modes: (V, 3, K + R) float32, the model's modes and then R more, orthogonal to them.
        stddev: (R,) standard deviations of the residual modes, mm.
        products: (K + R, C) mm of the C local and mirrored modes along all of these modes.
        mode: (C,) index of the model's mode from which each local or mirrored mode was made.
        field: (C,) index of the smooth field, or mirror image, by which it was made.
    """

    modes: Float32Array
    stddev: FloatArray
    products: Float32Array
    mode: IntArray
    field: IntArray

    def covariance_outside(self, outside: FloatArray, z: FloatArray, count: int) -> FloatArray:
        """Return the covariance (K, K + R), mm^2, of shapes outside the span of all training shapes but one.

        Args:
            outside: (K, r) orthonormal basis of the complement of that span.
            z: (K,) coefficients of the held-out shape, in standard deviations; no local mode is made from it.
            count: number of shapes.
        """
        K = len(outside)
        of_field = np.arange(int(self.field.max()) + 1)[:, None] == self.field
        own = np.asarray(csr_array(of_field * z[self.mode]) @ self.products.T)
        along = (outside.T @ self.products[:K]) @ self.products.T
        return outside @ (along - (own[:, :K] @ outside).T @ own / (count - 1))


@cached_with_owner()
def residual_modes(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    """Return the strongest modes outside the span of `model`, computed once for each model and settings.

    The modes of a model that was read from a file, or saved to one, are cached on disk too.
    """
    if not model.in_file:
        return _compute_modes(model, settings)
    key = disk_cache.key("residual", _ALGORITHM_VERSION, model.content_hash, settings)
    arrays = disk_cache.recall(key)
    names = [item.name for item in fields(ResidualModes)]
    if arrays is not None and set(names) <= arrays.keys():
        return ResidualModes(*(arrays[name] for name in names))
    made = _compute_modes(model, settings)
    disk_cache.keep(key, {name: getattr(made, name) for name in names})
    return made


def _compute_modes(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    x, stddev = model.mean_vertices, model.stddev.astype(np.float32)
    modes = np.asarray(prepare(model).modes)
    mirror = _mirror(model)
    sources = [modes] if mirror is None else [modes, mirror(modes)]
    smooth = smooth_fields(x, settings.range_share * rms_size(x))  # R17b
    mode, field_of_product = strongest_products(
        model.stddev, np.linalg.norm(smooth, axis=0), MOST_PRODUCTS // len(sources)
    )
    field = (np.sqrt(settings.local_share) * smooth).astype(np.float32)[:, field_of_product] * stddev[mode]
    mirrored = np.float32(np.sqrt(settings.mirror_share)) * stddev

    def products(rows: slice) -> Float32Array:
        """Return (3M, C) the local modes, and the mirrored ones, at some vertices."""
        parts = [np.take(source[rows], mode, axis=2) for source in sources]
        for part in parts:
            part *= field[rows, None]
        parts += [mirrored * source[rows] for source in sources[1:]]
        return np.concatenate(parts, axis=2).reshape(3 * len(parts[0]), -1)

    blocks = vertex_blocks(len(x))
    own = [modes[rows].reshape(-1, len(stddev)) for rows in blocks]
    inside = np.asarray(sum(P.T @ products(rows) for P, rows in zip(own, blocks, strict=True)))
    gram = np.zeros((inside.shape[1], inside.shape[1]))
    for P, rows in zip(own, blocks, strict=True):
        outside = products(rows) - P @ inside
        gram += outside.T @ outside
    value, vector = largest_eigenpairs(gram, settings.count)
    significant = value > _LEAST_VALUE * value[0]
    stddev_mm = np.sqrt(value[significant])
    mix = (vector[:, significant] / stddev_mm).astype(np.float32)
    # The eigenvectors of the Gram matrix contain the products along the residual modes.
    along = np.concatenate([inside, stddev_mm[:, None] * vector[:, significant].T])
    inside = inside @ mix
    together = np.empty((*modes.shape[:2], modes.shape[2] + len(stddev_mm)), dtype=np.float32)
    together[:, :, : modes.shape[2]] = modes
    for P, rows in zip(own, blocks, strict=True):
        together[rows, :, modes.shape[2] :] = (products(rows) @ mix - P @ inside).reshape(-1, 3, len(stddev_mm))
    local, count = len(mode), len(sources)
    of_mode = np.concatenate([np.tile(mode, count), np.tile(np.arange(len(stddev)), count - 1)])
    first = int(field_of_product.max()) + 1
    of_field = np.concatenate(
        [field_of_product + first * k for k in range(count)] + [np.full(len(stddev), first * count)] * (count - 1)
    )
    assert len(of_mode) == along.shape[1] == local * count + len(stddev) * (count - 1)
    return ResidualModes(
        together, stddev_mm, along.astype(np.float32), of_mode.astype(np.int32), of_field.astype(np.int32)
    )


def _mirror(model: ShapeModel) -> Callable[[Float32Array], Float32Array] | None:
    """Return a function that mirrors fields (V, 3, k) on the mean; None if the mean is not symmetric."""
    mean = model.mesh()
    symmetry = find_mirror(mean)
    if symmetry.off_share > _SYMMETRIC_SHARE:
        return None
    corners, weights, turn = symmetry.corners, symmetry.weights.astype(np.float32), symmetry.turn.astype(np.float32)

    def mirrored(field: Float32Array) -> Float32Array:
        out = np.empty_like(field)
        for rows in vertex_blocks(len(corners)):
            there = sum(weights[rows, c, None, None] * field[corners[rows, c]] for c in range(3))
            np.matmul(turn.T, there, out=out[rows])
        return out

    return mirrored
