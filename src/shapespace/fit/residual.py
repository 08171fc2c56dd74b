"""What a shape may do that its model cannot: mirrored, and smooth local, versions of the model's own modes.

A model of N shapes spans N - 1 directions, and a new shape always leaves them. What it leaves varies as the modes do,
only locally: so the covariance of the model damped with distance is a prior for it (Wilms, Handels and Ehrhardt,
Medical Image Analysis 38, 2017). Where the mean is its own mirror image, the mirrored modes belong there too, as in
models built with mirrored shapes. Only the part outside the model's span is kept, as further modes beside the model's
own, so that b keeps its meaning.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from shapespace.fit.kernels import Float32Array
from shapespace.fit.moving_model import prepare
from shapespace.fit.settings import ResidualSettings
from shapespace.geometry.closest import ClosestPoints, build_engine
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Similarity

_CENTRES = 40
_FIELD_SHARE = 0.999
_VARIANCE_SHARE = 0.995
_MOST_PRODUCTS = 1_300
_LEAST_VALUE = 1e-8
_MIRROR_ITERATIONS = 30
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
    """Return the strongest modes outside the span of `model`, made once and kept as long as the model lives."""
    made = _MADE.setdefault(model, {})
    if settings not in made:
        made[settings] = _make(model, settings)
    return made[settings]


def _make(model: ShapeModel, settings: ResidualSettings) -> ResidualModes:
    x = model.mean_vertices
    fields = _smooth_fields(x, settings.range_share * _size_mm(x)).astype(np.float32)
    own = np.asarray(prepare(model).modes).reshape(3 * len(x), -1)
    scaled = own * model.stddev.astype(np.float32)
    mirror = _mirror(model)
    sources = [scaled] if mirror is None else [scaled, mirror(scaled)]
    strong = int(np.searchsorted(model.cumulative_variance / model.cumulative_variance[-1], _VARIANCE_SHARE)) + 1
    strong = min(strong, max(1, _MOST_PRODUCTS // (len(sources) * fields.shape[1])))
    local = np.float32(np.sqrt(settings.local_share))
    parts = [_products(source[:, :strong], local * fields) for source in sources]
    if mirror is not None:
        parts.append(np.float32(np.sqrt(settings.mirror_share)) * sources[1])
    outside = np.concatenate(parts, axis=1)
    outside -= own @ (own.T @ outside)
    value, vector = np.linalg.eigh(np.asarray(outside.T @ outside, dtype=np.float64))
    order = np.argsort(value)[::-1][: settings.count]
    order = order[value[order] > _LEAST_VALUE * value[order[0]]]
    extra = outside @ (vector[:, order] / np.sqrt(value[order])).astype(np.float32)
    together = np.concatenate([own, extra], axis=1).reshape(len(x), 3, -1)
    return ResidualModes(np.ascontiguousarray(together), np.sqrt(value[order]))


def _products(modes: Float32Array, fields: Float32Array) -> Float32Array:
    """Return each of `modes` (3V, k) times each of `fields` (V, m) as (3V, k m)."""
    k, (v, m) = modes.shape[1], fields.shape
    return (modes.reshape(v, 3, k)[:, :, :, None] * fields[:, None, None, :]).reshape(3 * v, k * m)


def _mirror(model: ShapeModel) -> Callable[[Float32Array], Float32Array] | None:
    """Return what turns fields (3V, k) on the mean into their mirror images; None if the mean is not symmetric."""
    x = model.mean_vertices
    centre = x.mean(axis=0)
    mean = model.mesh()
    engine = build_engine(mean)
    best: tuple[float, FloatArray, ClosestPoints] | None = None
    for axis in np.linalg.svd(x - centre, full_matrices=False)[2]:
        flip = np.eye(3) - 2.0 * np.outer(axis, axis)
        flipped = (x - centre) @ flip.T + centre
        T, near = Similarity.identity(), None
        for _ in range(_MIRROR_ITERATIONS):
            near = engine.query(T.apply(flipped), near)
            T = fit_similarity(flipped, near.points, with_scale=False)
        near = engine.query(T.apply(flipped), near)
        if best is None or near.rms < best[0]:
            best = (near.rms, T.rotation @ flip, near)
    assert best is not None and mean.faces is not None
    rms, turn, at = best
    if rms > _SYMMETRIC_SHARE * _size_mm(x) or at.triangle is None or at.barycentric is None:
        return None
    corners, weights, turn = mean.faces[at.triangle], at.barycentric.astype(np.float32), turn.astype(np.float32)

    def mirrored(field: Float32Array) -> Float32Array:
        at_vertices = field.reshape(len(x), 3, -1)
        there = sum(weights[:, c, None, None] * at_vertices[corners[:, c]] for c in range(3))
        return np.einsum("de,vek->vdk", turn.T, there).reshape(3 * len(x), -1)

    return mirrored


def _size_mm(x: FloatArray) -> float:
    return float(np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _smooth_fields(x: FloatArray, range_mm: float) -> FloatArray:
    """Return (V, m) fields f with sum_m f_m(x) f_m(y) near exp(-|x - y|^2 / range^2): 1 at no distance, 0 far off."""
    centres = x[_spread_out(x, _CENTRES)]
    bumps = np.exp(-((x[:, None] - centres) ** 2).sum(axis=2) / (0.5 * range_mm**2))
    bumps /= np.linalg.norm(bumps, axis=1, keepdims=True)
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
