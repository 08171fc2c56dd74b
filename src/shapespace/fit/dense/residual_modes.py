"""What a shape may do that its model cannot: mirrored, and smooth local, versions of the model's own modes.

A model of N shapes spans N - 1 directions, and a new shape always leaves them. What it leaves varies as the modes do,
only locally: so the covariance of the model damped with distance is a prior for it (Wilms, Handels and Ehrhardt,
Medical Image Analysis 38, 2017). Where the mean is its own mirror image, the mirrored modes belong there too, as in
models built with mirrored shapes. Only the part outside the model's span is kept, as further modes beside the model's
own, so that b keeps its meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.prepared_model import prepare
from shapespace.fit.robust.robust_settings import ResidualSettings
from shapespace.geometry.mirror_plane import find_mirror
from shapespace.geometry.normals import rms_size
from shapespace.io import disk_cache
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.local_modes import (
    MOST_PRODUCTS,
    largest_eigenpairs,
    smooth_fields,
    strongest_products,
    vertex_blocks,
)
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray

_ALGORITHM_VERSION = 2
"""Part of the key of the disk cache: raise it whenever `_make`, `local_modes` or `mirror` compute other modes."""
_LEAST_VALUE = 1e-8  # share of the largest eigenvalue; below are float32 rounding and linear dependence
_SYMMETRIC_SHARE = 0.01
"""A mean whose mirror image lies within this share of its size is taken for symmetric."""


@dataclass(frozen=True, eq=False)
class ResidualModes:
    """Modes that the model lacks.

    Args:
        modes: (V, 3, K + R) float32, the model's modes and then R more, orthogonal to them.
        stddev: (R,) mm.
        inside: (K, K + R) mm^2, covariance of the undamped... of the local and mirrored modes along the model's modes, with themselves and with the
            R modes: what is projected out of the span of the model.
    """

    modes: Float32Array
    stddev: FloatArray
    inside: FloatArray


@cached_with_owner()
def residual_modes(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    """Return the strongest modes outside the span of `model`, computed once for each model and settings.

    Those of a model that was read from a file, or saved to one, are cached on disk too.
    """
    if not model.in_file:
        return _make(model, settings)
    key = disk_cache.key("residual", _ALGORITHM_VERSION, model.content_hash, settings)
    arrays = disk_cache.recall(key)
    if arrays is not None and {"modes", "stddev_mm", "inside_mm2"} <= arrays.keys():
        return ResidualModes(arrays["modes"], arrays["stddev_mm"], arrays["inside_mm2"])
    made = _make(model, settings)
    disk_cache.keep(key, {"modes": made.modes, "stddev_mm": made.stddev, "inside_mm2": made.inside})
    return made


def _make(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    x, stddev = model.mean_vertices, model.stddev.astype(np.float32)
    modes = np.asarray(prepare(model).modes)
    mirror = _mirror(model)
    sources = [modes] if mirror is None else [modes, mirror(modes)]
    fields = smooth_fields(x, settings.range_share * rms_size(x))  # R17b
    mode, field_of_product = strongest_products(
        model.stddev, np.linalg.norm(fields, axis=0), MOST_PRODUCTS // len(sources)
    )
    field = (np.sqrt(settings.local_share) * fields).astype(np.float32)[:, field_of_product] * stddev[mode]
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
    among = inside @ inside.T
    inside = inside @ mix
    together = np.empty((*modes.shape[:2], modes.shape[2] + len(stddev_mm)), dtype=np.float32)
    together[:, :, : modes.shape[2]] = modes
    for P, rows in zip(own, blocks, strict=True):
        together[rows, :, modes.shape[2] :] = (products(rows) @ mix - P @ inside).reshape(-1, 3, len(stddev_mm))
    return ResidualModes(together, stddev_mm, np.concatenate([among, inside * stddev_mm**2], axis=1, dtype=np.float64))


def _mirror(model: ShapeModel) -> Callable[[Float32Array], Float32Array] | None:
    """Return what turns fields (V, 3, k) on the mean into their mirror images; None if the mean is not symmetric."""
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
