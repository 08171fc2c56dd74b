"""Warm-up: loads the code of a fit, or compiles it on a machine without compiled code.

It runs small fits, since code is compiled for the types of arrays that it processes. The server of `workers` runs them
when it imports this module.
"""

from __future__ import annotations

import contextlib
import os
import sys

import numpy as np

from shapespace.batch.workers import WARM_UP, is_first
from shapespace.compiled import notify_compilation
from shapespace.errors import ShapespaceError
from shapespace.fit.dense.residual_modes import residual_modes
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.robust_settings import ResidualSettings
from shapespace.geometry.normals import part_of
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh

COMPILING = "shapespace: compiling, once on this machine; this takes a while ..."


def notify_compiling() -> None:
    """Print on standard error that code is being compiled, unless another process of the command has done so."""
    if is_first():
        print(COMPILING, file=sys.stderr, flush=True)


def warm_up(*, notify: bool) -> None:
    """Fit a small model to small surfaces and points without a start pose; with `notify`, report compilation."""
    with notify_compilation(notify_compiling if notify else lambda: None):
        _small_fits()


def _small_fits() -> None:
    model = ShapeModel.fit([_hill(20, seed) for seed in range(8)], gauge="shape", align=False)
    few = _hill(10, 9)
    upside_down = Mesh(few.vertices @ np.diag([1.0, -1.0, -1.0]), few.faces)
    hill = _hill(45, 9)
    half = part_of(hill, hill.vertices[:, 0] < 0)
    for raw in (upside_down, hill, Mesh(hill.vertices), half):
        # Such a small scan may be rejected, which does not matter here.
        with contextlib.suppress(ShapespaceError):
            _ = fit_scan(model, raw, FitConfig(max_iterations=20)).distances
    residual_modes(model, ResidualSettings(count=5))


def _hill(side: int, seed: int) -> Mesh:
    """Return a lopsided hill over a square of 100 mm; `seed` draws its shape."""
    u, v = np.meshgrid(*2 * [np.linspace(-1, 1, side)], indexing="ij")
    a, b, c = np.random.default_rng(seed).normal(1, 0.2, 3)
    z = 50 * a * np.exp(-4 * ((u - 0.3) ** 2 + v**2)) + 20 * b * np.exp(-9 * (u**2 + (v - 0.5) ** 2)) + 5 * c * u * v
    index = np.arange(side * side).reshape(side, side)
    p, q, r, s = (corner.ravel() for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, s], axis=1)]).astype(np.int32)
    return Mesh(np.stack([50 * u, 50 * v, z], axis=2).reshape(-1, 3), faces)


if how := os.environ.get(WARM_UP):
    # Only in the server of `workers`, so that its copies are warm. Later fits report errors.
    with contextlib.suppress(Exception):
        warm_up(notify=how == "notify")
