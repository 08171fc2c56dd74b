"""A checkerboard for all surfaces in correspondence: projected onto the mean shape, carried over by vertices."""

from __future__ import annotations

import math

import numpy as np

from shapespace.errors import InputError
from shapespace.report.inputs.correspondence_folder import drawable
from shapespace.report.render.palette import CATEGORIES
from shapespace.report.render.renderer import SQUARE_COLOURS, Layer
from shapespace.types import FloatArray, Mesh

_SQUARES, _MOST_SQUARES = 10, 40  # squares across the mean side, and at most along the longer one
_PAPER = np.array([0.93, 0.90, 0.86])
# Pale enough that eyes and edges are seen through the squares.
SQUARES = np.stack([_PAPER, *(0.62 * np.array(colour) + 0.38 * _PAPER for colour in CATEGORIES[:SQUARE_COLOURS])])
"""(N, 3) colours of the checkerboard: that of every other square, then those which the others take in turn."""


def checker_places(mean: Mesh, yaw_deg: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return where on a checkerboard each vertex of `mean` lies, two of (V,), so that a square is 1 by 1.

    The board stands before the mean shape and is thrown onto it; its middle is that of the shape.

    Args:
        mean: the surface, upright.
        yaw_deg: from where it is thrown: 0 from the front, 90 from the side that a camera of that angle sees.

    Raises:
        InputError: the shape has no extent.
    """
    yaw = np.radians(yaw_deg)
    across = mean.vertices @ np.array([np.cos(yaw), 0.0, np.sin(yaw)])
    plane = np.stack([across, mean.vertices[:, 1]])
    low, high = plane.min(axis=1), plane.max(axis=1)
    wide, high_up = (float(extent) for extent in high - low)
    # Of a long thin object, the squares must be small enough that there are some across.
    side = max(math.sqrt(wide * high_up) / _SQUARES, max(wide, high_up) / _MOST_SQUARES)
    if not side > 0:
        raise InputError("The mean shape has no extent; run shapespace correspond again.")
    plane = (plane - ((low + high) / 2)[:, None]) / side
    return plane[0], plane[1]


def checker_layer(surface: Mesh, places: tuple[FloatArray, FloatArray]) -> Layer:
    """Return `surface` under the checkerboard that lies at `places`, two of (V,); missing vertices are left out."""
    drawn_surface, along = drawable(surface, places[0])
    _, across = drawable(surface, places[1])
    return Layer(drawn_surface, scalars=along, across=across, colormap=SQUARES, vmin=-0.5, vmax=len(SQUARES) - 0.5)
