"""Figures of landmarks: deformation grids, vectors and maps, and specimens superimposed around their mean."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from shapespace.cohort.orientation import view_rotation
from shapespace.errors import InputError
from shapespace.geometry.landmark_alignment import AlignedLandmarks
from shapespace.geometry.thin_plate_spline import ThinPlateSpline
from shapespace.report.figures.analysis_figures import current_orientation
from shapespace.report.figures.draw import (
    BACKWARD,
    DPI,
    FORWARD,
    INK,
    LAYOUT,
    SMALL,
    TEXT,
    Scale,
    bar_height,
    charts,
    colour_bar,
    escaped,
    finish,
    short,
    type_size,
)
from shapespace.report.inputs.staged_fit import nice_ceiling
from shapespace.report.render.palette import CATEGORIES, DIVERGING, SEQUENTIAL, UNKNOWN_COLOUR
from shapespace.types import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_CELLS = 20  # cells of a grid along its longer side: deformations of a tenth of the shape are seen
_POINTS_OF_CELL = 5  # points of a grid line in each cell, so that bent lines look smooth
_MARGIN = 0.12  # of the longer side, around the landmarks
_GRID = "#8d96a3"  # lines of a grid and links, paler than landmarks
_PALE = 0.55  # share of white outside the mask
_MOST_INCHES = 4.0  # of the height of a panel
_MOST_NUMBERS = 150  # landmarks with a number; more of them overlap
_THREE_SIDES = (
    ("front", np.eye(3)),
    ("side", np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])),
    ("top", np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])),
)


def deformation_grid_figure(low: FloatArray, high: FloatArray, labels: tuple[str, str]) -> Figure:
    """Draw two planar configurations as thin-plate splines of a square grid on their mean.

    Args:
        low: (L, 3) one configuration; z is the same everywhere.
        high: (L, 3) the other.
        labels: what they are.

    Raises:
        InputError: landmarks that are not planar, or that lie on a line.
    """
    ends = np.stack([low, high])
    if np.ptp(ends[:, :, 2]) > 0:
        raise InputError("A deformation grid needs planar landmarks; draw vectors of three-dimensional ones.")
    ends = (ends @ _first_rotation().T)[:, :, :2]
    splines = [ThinPlateSpline.fit(ends.mean(axis=0), end) for end in ends]
    lines = grid_lines(ends.mean(axis=0))
    warped = [spline.apply(lines.reshape(-1, 2)).reshape(lines.shape) for spline in splines]
    figure, plots = _panels([short(label, 30) for label in labels], np.concatenate(warped).reshape(-1, 2))
    for axes, grid, end in zip(plots, warped, ends, strict=True):
        axes.add_collection(LineCollection(list(grid), colors=_GRID, linewidths=0.9, zorder=1))
        draw_links(axes, end, INK)
        axes.scatter(*end.T, s=30, color=INK, linewidths=0, zorder=3)
    return finish(figure, w_pad=0.6)


def landmark_vectors_figure(low: FloatArray, high: FloatArray, labels: tuple[str, str]) -> Figure:
    """Draw each landmark of one configuration as a dot with a line to its place in the other.

    Three-dimensional landmarks are drawn in the named views of the orientation, or from the front, the side and the
    top.

    Args:
        low: (L, 3) where the lines start.
        high: (L, 3) where they end.
        labels: what the configurations are.
    """
    figure, plots, placed = _in_views(np.stack([low, high]), " → ".join(map(short, labels)))
    for axes, (start, end) in zip(plots, placed, strict=True):
        draw_links(axes, start, _GRID)
        vectors: FloatArray = np.stack([start, end], axis=1)
        axes.add_collection(LineCollection(list(vectors), colors=[CATEGORIES[1]], linewidths=2.4, zorder=3))
        axes.scatter(*start.T, s=26, color=CATEGORIES[0], linewidths=0, zorder=2)
    return finish(figure, w_pad=0.6)


def landmark_map_figure(
    points: FloatArray,
    values: FloatArray,
    *,
    unit: str,
    signed: bool = True,
    limit: float | None = None,
    mask: BoolArray | None = None,
) -> Figure:
    """Draw a number for each landmark as its colour.

    Args:
        points: (L, 3) places.
        values: (L,); not-a-number is drawn in grey.
        unit: of the numbers.
        signed: whether two colours part at zero.
        limit: where the colours end; None for the largest number.
        mask: (L,) outside which landmarks are small and pale; None for none.

    Raises:
        InputError: another number of values or flags than of landmarks, or no finite value.
    """
    if values.shape != (len(points),) or (mask is not None and mask.shape != values.shape):
        raise InputError(f"{len(points)} landmarks need one number each, not {values.shape}.")
    known = np.isfinite(values)
    if not known.any():
        raise InputError("There is nothing to draw on landmarks without numbers.")
    end = limit or nice_ceiling(float(np.abs(values[known]).max()))
    start, colours = (-end, DIVERGING) if signed else (0.0, SEQUENTIAL)
    figure, plots, placed = _in_views(points[None], "", bar_height() / DPI)
    inside: BoolArray = np.ones(len(points), np.bool_) if mask is None else mask
    shades = np.tile(np.array(UNKNOWN_COLOUR), (len(points), 1))
    place_in_scale = np.clip((values[known] - start) / (end - start), 0, 1) * (len(colours) - 1)
    shades[known] = colours[place_in_scale.round().astype(int)]
    shades[~inside] = _PALE + (1 - _PALE) * shades[~inside]
    for axes, (place,) in zip(plots, placed, strict=True):
        draw_links(axes, place, _GRID)
        sizes = np.where(inside, 70.0, 22.0)
        axes.scatter(*place.T, s=sizes, facecolors=shades, edgecolors=INK, linewidths=0.8, zorder=3)
    finish(figure, w_pad=0.6)
    height = float(figure.get_figheight()) * DPI
    colour_bar(figure, Scale(short(unit, 60), colours, start, end), height - bar_height(), height)
    return figure


def superimposed_landmarks(aligned: AlignedLandmarks) -> Figure:
    """Draw all specimens around their mean with numbered landmarks, in the views of `landmark_vectors_figure`."""
    shapes = np.pad(np.concatenate([aligned.mean[None], aligned.coords]), ((0, 0), (0, 0), (0, 3 - aligned.dimensions)))
    estimated = aligned.estimated
    note = "blue: specimens; black: their mean" + "; orange: missing landmarks, estimated" * int(estimated.any())
    figure, plots, placed = _in_views(shapes, "", note=note)
    for axes, place in zip(plots, placed, strict=True):
        mean, specimens = place[0], place[1:]
        draw_links(axes, mean, INK, 1.0)
        axes.scatter(*specimens[~estimated].T, s=5, color=FORWARD, alpha=0.5, linewidths=0, zorder=1)
        axes.scatter(*specimens[estimated].T, s=14, facecolors="none", edgecolors=BACKWARD, linewidths=0.8, zorder=5)
        axes.scatter(*mean.T, s=12, color=INK, linewidths=0, zorder=4)
        for number, point in enumerate(mean if len(mean) <= _MOST_NUMBERS else (), 1):
            axes.annotate(
                str(number), point, xytext=(2, 2), textcoords="offset points", fontsize=type_size(SMALL), color=INK
            )
    return finish(figure, w_pad=0.6)


def _in_views(
    shapes: FloatArray, label: str, below: float = 0.0, note: str = ""
) -> tuple[Figure, list[Axes], list[FloatArray]]:
    """Return a figure with the views of landmarks (n, L, 3), its panels, and the landmarks (n, L, 2) in each.

    Planar landmarks have one view, with a label. There are `below` free inches under the panels.
    """
    named = [(one.name, view_rotation(one)) for one in current_orientation().views]
    is_planar = np.ptp(shapes[:, :, 2]) == 0
    views = [(label, _first_rotation())] if is_planar else named[:4] or list(_THREE_SIDES)
    placed = [(shapes @ turn.T)[:, :, :2] for _, turn in views]
    placed = [one - (one.max(axis=(0, 1)) + one.min(axis=(0, 1))) / 2 for one in placed]
    figure, plots = _panels([name for name, _ in views], np.concatenate(placed).reshape(-1, 2), below, note)
    return figure, plots, placed


def _first_rotation() -> FloatArray:
    views = current_orientation().views
    return view_rotation(views[0]) if views else np.eye(3)


def grid_lines(points: FloatArray) -> FloatArray:
    """Return the lines (n, m, 2) of a square grid around points (L, 2), each a row of m points."""
    low, high = points.min(axis=0), points.max(axis=0)
    room = 2 * _MARGIN * float((high - low).max())
    step = (float((high - low).max()) + room) / _CELLS
    counts = np.maximum(np.rint((high - low + room) / step), 1).astype(int)
    half, lines = counts * step / 2, list[FloatArray]()
    for axis in (0, 1):
        family = np.empty((counts[axis] + 1, _CELLS * _POINTS_OF_CELL + 1, 2))
        family[:, :, axis] = np.linspace(-half[axis], half[axis], counts[axis] + 1)[:, None]
        family[:, :, 1 - axis] = np.linspace(-half[1 - axis], half[1 - axis], family.shape[1])
        lines.append((low + high) / 2 + family)
    return np.concatenate(lines)


def _panels(names: list[str], points: FloatArray, below: float = 0.0, note: str = "") -> tuple[Figure, list[Axes]]:
    """Return a figure with a panel for each name, in one scale, in which points (n, 2) fit, and the panels."""
    layout, columns = LAYOUT.get(), len(names)
    low, high = points.min(axis=0), points.max(axis=0)
    room = 0.04 * float((high - low).max())
    width = (layout.chart_width if columns == 1 else layout.row_width) / columns / DPI
    aspect = float(high[1] - low[1] + 2 * room) / float(high[0] - low[0] + 2 * room)
    room_of_titles = 1.6 * type_size(TEXT) / 72 * any(names)
    height = min(width * aspect, _MOST_INCHES * layout.scale) + room_of_titles
    figure, plots = charts("", [(height + below) / layout.scale], note=note, columns=columns)
    left, bottom, right, top = cast(Any, figure).plots_within
    # Titles have their own room: `tight_layout` counts them only where equal scales leave none above a panel.
    inches = figure.get_figheight()
    cast(Any, figure).plots_within = (left, bottom + below / inches, right, top - room_of_titles / inches)
    for axes, name in zip(plots, names, strict=True):
        axes.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room), aspect="equal")
        axes.set_axis_off()
        if name:
            axes.set_title(escaped(name), fontsize=type_size(TEXT), color=INK, pad=3).set_in_layout(False)
    return figure, plots


def draw_links(axes: Axes, points: FloatArray, colour: str, width: float = 1.6) -> None:
    """Draw the links of the orientation between landmarks (L, 2).

    Raises:
        InputError: a link of a landmark that does not exist.
    """
    links = np.array(current_orientation().links, dtype=int).reshape(-1, 2) - 1
    if links.max(initial=-1) >= len(points):
        raise InputError(f"A link of the orientation has landmark {links.max() + 1}, but there are {len(points)}.")
    axes.add_collection(LineCollection(list(points[links]), colors=colour, linewidths=width, zorder=2))
