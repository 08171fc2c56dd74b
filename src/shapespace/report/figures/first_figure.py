"""Loads the code of pictures by drawing one: the server of `batch.workers` imports it, so that its copies are warm."""

from __future__ import annotations

import contextlib

import numpy as np

from shapespace.report.figures.draw import Row, encode_webp, grid
from shapespace.report.render.renderer import Camera, Layer, render
from shapespace.types import Mesh

with contextlib.suppress(Exception):  # later pictures report errors
    _TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]], dtype=np.int32), name="triangle")
    _PICTURE = render(Layer(_TRIANGLE), camera=Camera.framing(_TRIANGLE.vertices), size=(8, 8))
    encode_webp(grid([Row([_PICTURE])], title="Triangle"))
