"""Small stills for cards: one strip of equal panels for each fit, all on one scale, as WebP."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.normals import Distortion, drawable, faces_of, observed_mask
from shapespace.report.inputs.saved_fits import StagedFit
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.render.palette import CATEGORIES, DIVERGING, MODEL_COLOUR, SCAN_COLOUR, SEQUENTIAL, Colour
from shapespace.report.render.renderer import (
    SQUARE_COLOURS,
    Camera,
    Image,
    Layer,
    distance_layer,
    part_layer,
    render,
    render_series,
)
from shapespace.types import FloatArray, IntArray, Mesh

PANEL = (176, 232)
"""Width and height of a panel in pixels."""

AREA_LIMIT = 2.0
"""End of the maps of area change, as a factor of growth."""
FOLD_COLOUR: Colour = (0.05, 0.05, 0.05)  # near black, sRGB from 0 to 1

Still: TypeAlias = tuple[bytes, tuple[int, int]]
"""WebP, and its width and height in pixels."""


def fit_strip(fit: StagedFit, limit_mm: float, panel: tuple[int, int] = PANEL) -> Still:
    """Return three panels: the scan, scan and model superimposed, distances from model to scan.

    The distances are signed, on `colours.DIVERGING` from -limit_mm; those to a point cloud, which has no inside, are on
    `colours.SEQUENTIAL` from 0. Vertices that the scan does not show are grey.

    Args:
        fit: fit with its stages.
        limit_mm: end of the scale of the distances, mm.
        panel: width and height of each panel in pixels.
    """
    surface = fit.surfaces["final"]
    camera = Camera.framing(surface.vertices, aspect=panel[0] / panel[1], margin=0.02)
    scan, model = Layer(fit.scan, SCAN_COLOUR), Layer(surface, MODEL_COLOUR)
    plain, overlay = render_series([[scan], [scan, model]], camera=camera, size=panel)
    distance_image = render(
        distance_layer(surface, fit.model_to_scan_mm["final"], limit_mm, signed=fit.scan.faces is not None),
        camera=camera,
        size=panel,
    )
    return encoded(np.concatenate([plain, overlay, distance_image], axis=1))


def correspondence_strip(
    mean: Mesh, vertices: FloatArray, scan: Mesh | None, distance: FloatArray, limit: float,
    panel: tuple[int, int] = PANEL,
) -> Still:  # fmt: skip
    """Return panels: the scan, the checkerboard on it, its distance, and the change of area with folded triangles.

    Distances are on `colours.SEQUENTIAL` from 0; areas on `colours.DIVERGING`, from blue for `1 / AREA_LIMIT` to red
    for `AREA_LIMIT`. Triangles that fold over are black, with those around them, so that they are seen.

    Args:
        mean: the mean shape, upright.
        vertices: (V, 3) vertices of the surface, moved onto the mean shape; NaN where missing.
        scan: raw scan, moved likewise; None omits its panel and that of the distances.
        distance: (V,) distances of the vertices from the scan, NaN where unknown; not used without a scan.
        limit: end of the scale of the distances, in the unit of `distance`.
        panel: width and height of each panel in pixels.
    """
    surface = mean.with_vertices(vertices)
    drawn_surface, drawn_distance = drawable(surface, distance)
    faces, distortion = faces_of(surface), Distortion.of(surface, mean)
    _, growth = drawable(surface, mean_at_vertices(distortion.growth, faces, len(vertices)))
    layers = [[checker_layer(surface, checker_places(mean))]]
    if scan is not None:
        layers = [
            [Layer(drawable(scan)[0], SCAN_COLOUR)], *layers,
            [Layer(drawn_surface, scalars=drawn_distance, colormap=SEQUENTIAL, vmax=limit)],
        ]  # fmt: skip
    end = float(np.log(AREA_LIMIT))
    area = [Layer(drawn_surface, scalars=growth, colormap=DIVERGING, vmin=-end, vmax=end)]
    if distortion.folded.any():
        around = np.isin(faces, faces[distortion.folded]).any(axis=1) & observed_mask(vertices)[faces].all(axis=1)
        # Of equally near surfaces the first stays.
        area.insert(0, Layer(Mesh(np.nan_to_num(vertices), faces[around]), FOLD_COLOUR))
    camera = Camera.framing(
        np.concatenate([mean.vertices, drawn_surface.vertices]), aspect=panel[0] / panel[1], margin=0.02
    )
    return encoded(
        np.concatenate([render(*layer_group, camera=camera, size=panel) for layer_group in (*layers, area)], axis=1)
    )


def mean_at_vertices(values: FloatArray, faces: IntArray, vertices: int) -> FloatArray:
    """Return the mean (V,) of the known values of the triangles around each vertex."""
    known = np.isfinite(values)
    flat = faces[known].ravel()
    count = np.bincount(flat, minlength=vertices)
    return np.divide(
        np.bincount(flat, np.repeat(values[known], 3), vertices), count, out=np.full(vertices, np.nan), where=count > 0
    )


def mesh_still(mesh: Mesh, panel: tuple[int, int] = PANEL, parts: Parts | None = None) -> Still:
    """Render one mesh from the front, without rotation, in the colours of its parts if it has several."""
    camera = Camera.framing(mesh.vertices, aspect=panel[0] / panel[1], margin=0.06)
    # Points are drawn as balls, of a size that joins them whatever the unit of the file.
    radius = 0.004 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    layer = replace(part_layer(mesh, parts and parts.labels), point_radius_mm=max(radius, 1e-9))
    return encoded(render(layer, camera=camera, size=panel))


def colour_bar(colours: Sequence[Sequence[float]] | np.ndarray = DIVERGING) -> Still:
    """Return a map as a bar of 256 by 10 pixels."""
    return encoded(np.repeat(np.rint(255 * np.asarray(colours)).astype(np.uint8)[None], 10, axis=0), lossless=True)


def encoded(image: Image, *, lossless: bool = False, quality: int = 84, effort: int = 2) -> Still:
    """Return pixels (H, W, 3) uint8 as WebP."""
    from PIL import Image as PillowImage  # of the extra `report`

    stream = io.BytesIO()
    PillowImage.fromarray(np.ascontiguousarray(image)).save(
        stream, format="WEBP", lossless=lossless, quality=quality, method=effort
    )
    return stream.getvalue(), (image.shape[1], image.shape[0])


_SQUARES, _MOST_SQUARES = 10, 40  # squares across the mean side, and at most along the longer one
_PAPER = np.array([0.93, 0.90, 0.86])
# Pale enough that eyes and edges are seen through the squares.
SQUARES = np.stack([_PAPER, *(0.62 * np.array(colour) + 0.38 * _PAPER for colour in CATEGORIES[:SQUARE_COLOURS])])
"""(N, 3) colours of the checkerboard: that of every other square, then those which the others take in turn."""


def checker_places(mean: Mesh, yaw_deg: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Return the position (V,), (V,) of each vertex of `mean` on a checkerboard whose squares are 1 by 1.

    The board lies in front of the mean shape and is projected onto it; its middle is that of the shape.

    Args:
        mean: mean shape, upright.
        yaw_deg: direction, degrees: 0 from the front, 90 from the side that a camera of that angle sees.

    Raises:
        InputError: the shape has no extent.
    """
    yaw = np.radians(yaw_deg)
    plane = np.stack([(mean.vertices @ np.array([np.cos(yaw), 0.0, np.sin(yaw)])), mean.vertices[:, 1]])
    low, high = plane.min(axis=1), plane.max(axis=1)
    wide, high_up = (float(extent) for extent in high - low)
    # Of a long thin object, the squares must be small enough that there are some across.
    side = max(math.sqrt(wide * high_up) / _SQUARES, max(wide, high_up) / _MOST_SQUARES)
    if not side > 0:
        raise InputError("The mean shape has no extent; run shapespace correspond again.")
    plane = (plane - ((low + high) / 2)[:, None]) / side
    return plane[0], plane[1]


def checker_layer(surface: Mesh, places: tuple[FloatArray, FloatArray]) -> Layer:
    """Return `surface` under the checkerboard that lies at `places`, two arrays (V,); missing vertices are omitted."""
    drawn_surface, along = drawable(surface, places[0])
    _, across = drawable(surface, places[1])
    return Layer(drawn_surface, scalars=along, across=across, colormap=SQUARES, vmin=-0.5, vmax=len(SQUARES) - 0.5)
