"""What a shape may do that its model cannot: mirrored, and smooth local, versions of the model's own modes.

A model of N shapes spans N - 1 directions, and a new shape always leaves them. What it leaves varies as the modes do,
only locally: so the covariance of the model damped with distance is a prior for it (Wilms, Handels and Ehrhardt,
Medical Image Analysis 38, 2017). Where the mean is its own mirror image, the mirrored modes belong there too, as in
models built with mirrored shapes. Only the part outside the model's span is kept, as further modes beside the model's
own, so that b keeps its meaning.
"""

from __future__ import annotations

import hashlib
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.prepared_model import prepare
from shapespace.fit.robust.robust_settings import ResidualSettings
from shapespace.geometry import mirror_plane as mirror_search
from shapespace.geometry.mirror_plane import find_mirror
from shapespace.geometry.normals import rms_size
from shapespace.io.disk_cache import keep, recall
from shapespace.model import local_modes
from shapespace.model.local_modes import smooth_fields, strongest_products
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray
from shapespace.version import __version__

_MOST_PRODUCTS = 600
_BLOCK = 250
_LEAST_VALUE = 1e-8
_SYMMETRIC_SHARE = 0.01
"""A mean whose mirror image lies within this share of its size is taken for symmetric."""


@dataclass(frozen=True, eq=False)
class ResidualModes:
    """Modes that the model lacks.

    Args:
        modes: (V, 3, K + R) float32, the model's modes and then R more, orthogonal to them.
        stddev: (R,) mm.
    """

    modes: Float32Array
    stddev: FloatArray


_MADE: weakref.WeakKeyDictionary[ShapeModel, dict[ResidualSettings, ResidualModes]] = weakref.WeakKeyDictionary()


def residual_modes(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    """Return the strongest modes outside the span of `model`, made once and kept as long as the model lives.

    Those of a model that stands in a file are kept between runs too.
    """
    made = _MADE.setdefault(model, {})
    if settings not in made:
        made[settings] = _kept(model, settings) if model.in_file else _make(model, settings)
    return made[settings]


def _kept(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    # Whatever could change the modes is in the name, and so is the recipe itself.
    recipe = b"".join(Path(file).read_bytes() for file in (__file__, local_modes.__file__, mirror_search.__file__))
    made_of = f"{model.content_hash} {settings} {__version__} ".encode() + recipe
    name = f"residual-{hashlib.sha256(made_of).hexdigest()}"
    arrays = recall(name)
    if arrays is not None and {"modes", "stddev_mm"} <= arrays.keys():
        return ResidualModes(arrays["modes"], arrays["stddev_mm"])
    made = _make(model, settings)
    keep(name, {"modes": made.modes, "stddev_mm": made.stddev})
    return made


def _make(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    from scipy.linalg import eigh  # takes a moment, which whoever finds the modes kept need not wait for

    x, stddev = model.mean_vertices, model.stddev.astype(np.float32)
    modes = np.asarray(prepare(model).modes)
    mirror = _mirror(model)
    sources = [modes] if mirror is None else [modes, mirror(modes)]
    fields = smooth_fields(x, settings.range_share * rms_size(x))
    mode, at = strongest_products(model.stddev, np.linalg.norm(fields, axis=0), _MOST_PRODUCTS // len(sources))
    field = (np.sqrt(settings.local_share) * fields).astype(np.float32)[:, at] * stddev[mode]
    mirrored = np.float32(np.sqrt(settings.mirror_share)) * stddev

    def products(rows: slice) -> Float32Array:
        """Return (3M, C) the local modes, and the mirrored ones, at some vertices."""
        parts = [np.take(source[rows], mode, axis=2) for source in sources]
        for part in parts:
            part *= field[rows, None]
        parts += [mirrored * source[rows] for source in sources[1:]]
        return np.concatenate(parts, axis=2).reshape(3 * len(parts[0]), -1)

    # All at once they are ten times as large as the model; block by block they are nothing.
    blocks = _blocks(len(x))
    own = [modes[rows].reshape(-1, len(stddev)) for rows in blocks]
    inside = np.asarray(sum(P.T @ products(rows) for P, rows in zip(own, blocks, strict=True)))
    gram = np.zeros((inside.shape[1], inside.shape[1]))
    for P, rows in zip(own, blocks, strict=True):
        outside = products(rows) - P @ inside
        gram += outside.T @ outside
    value, vector = eigh(gram, overwrite_a=True, subset_by_index=(max(0, len(gram) - settings.count), len(gram) - 1))
    value, vector = value[::-1], vector[:, ::-1]
    kept = value > _LEAST_VALUE * value[0]
    stddev_mm = np.sqrt(value[kept])
    mix = (vector[:, kept] / stddev_mm).astype(np.float32)
    inside = inside @ mix
    together = np.empty((*modes.shape[:2], modes.shape[2] + len(stddev_mm)), dtype=np.float32)
    together[:, :, : modes.shape[2]] = modes
    for P, rows in zip(own, blocks, strict=True):
        together[rows, :, modes.shape[2] :] = (products(rows) @ mix - P @ inside).reshape(-1, 3, len(stddev_mm))
    return ResidualModes(together, stddev_mm)


def _mirror(model: ShapeModel) -> Callable[[Float32Array], Float32Array] | None:
    """Return what turns fields (V, 3, k) on the mean into their mirror images; None if the mean is not symmetric."""
    mean = model.mesh()
    found = find_mirror(mean)
    if found.off_share > _SYMMETRIC_SHARE:
        return None
    corners, weights, turn = found.corners, found.weights.astype(np.float32), found.turn.astype(np.float32)

    def mirrored(field: Float32Array) -> Float32Array:
        out = np.empty_like(field)
        for rows in _blocks(len(corners)):
            there = sum(weights[rows, c, None, None] * field[corners[rows, c]] for c in range(3))
            np.matmul(turn.T, there, out=out[rows])
        return out

    return mirrored


def _blocks(count: int) -> list[slice]:
    return [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]
