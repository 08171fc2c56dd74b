"""Small stills for cards: one strip of equal panels for each fit, all on one scale, as WebP."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from PIL import Image as PillowImage

from shapespace.report.colours import DIVERGING, MODEL_COLOUR, SCAN_COLOUR
from shapespace.report.render import Camera, Image, Layer, distance_layer, render, render_series
from shapespace.types import Mesh

if TYPE_CHECKING:
    from shapespace.report.staged import StagedFit

PANEL = (176, 232)
"""Width and height of a panel in pixels."""


Still: TypeAlias = tuple[bytes, tuple[int, int]]
"""WebP, and its width and height in pixels."""


def fit_strip(fit: StagedFit, limit_mm: float, panel: tuple[int, int] = PANEL) -> Still:
    """Return three panels: the scan, scan and model over each other, distances from model to scan.

    The distances are signed, on `colours.DIVERGING` from -limit_mm; those to a point cloud, which has no inside, are on
    `colours.SEQUENTIAL` from 0. Vertices that the scan does not show are grey.

    Args:
        fit: with its stages.
        limit_mm: where the scale of the distances ends.
        panel: width and height of each panel in pixels.
    """
    surface = fit.surfaces["final"]
    camera = Camera.framing(surface.vertices, aspect=panel[0] / panel[1], margin=0.02)
    scan, model = Layer(fit.scan, SCAN_COLOUR), Layer(surface, MODEL_COLOUR)
    plain, both = render_series([[scan], [scan, model]], camera=camera, size=panel)
    distances = distance_layer(surface, fit.model_to_scan_mm["final"], limit_mm, signed=fit.scan.faces is not None)
    seen = render(distances, camera=camera, size=panel)
    return encoded(np.concatenate([plain, both, seen], axis=1))


def mesh_still(mesh: Mesh, panel: tuple[int, int] = PANEL) -> Still:
    """Return one mesh from the front, as its axes stand."""
    camera = Camera.framing(mesh.vertices, aspect=panel[0] / panel[1], margin=0.06)
    # Points are drawn as balls, of a size that joins them whatever the unit of the file.
    radius = 0.004 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    return encoded(render(Layer(mesh, point_radius_mm=max(radius, 1e-9)), camera=camera, size=panel))


def colour_bar(colours: Sequence[Sequence[float]] | np.ndarray = DIVERGING) -> Still:
    """Return a map as a bar of 256 by 10 pixels."""
    row = np.rint(255 * np.asarray(colours)).astype(np.uint8)
    return encoded(np.repeat(row[None], 10, axis=0), lossless=True)


def encoded(image: Image, *, lossless: bool = False, quality: int = 84, effort: int = 3) -> Still:
    """Return pixels (H, W, 3) uint8 as WebP."""
    stream = io.BytesIO()
    PillowImage.fromarray(np.ascontiguousarray(image)).save(
        stream, format="WEBP", lossless=lossless, quality=quality, method=effort
    )
    return stream.getvalue(), (image.shape[1], image.shape[0])
