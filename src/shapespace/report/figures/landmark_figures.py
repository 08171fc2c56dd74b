"""Figures of landmarks: deformation grids, vectors and maps, and specimens superimposed around their mean."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.spatial import ConvexHull, QhullError
from scipy.special import fdtri

from shapespace.cohort.orientation import current_orientation, view_rotation
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_alignment import AlignedLandmarks
from shapespace.geometry.thin_plate_spline import ThinPlateSpline
from shapespace.report.analyses.analysis_report import MOST_LANDMARKS
from shapespace.report.figures.analysis_figures import upright_views
from shapespace.report.figures.draw import (
    BACKWARD,
    DPI,
    FORWARD,
    GREY,
    INK,
    LAYOUT,
    MARKERS,
    RULE,
    SMALL,
    TEXT,
    Scale,
    axis_label,
    bar_height,
    charts,
    colour_bar,
    escaped,
    finish,
    legend,
    short,
    type_size,
    view,
)
from shapespace.report.inputs.saved_fits import nice_ceiling
from shapespace.report.render.palette import CATEGORIES, DIVERGING, SEQUENTIAL, UNKNOWN_COLOUR
from shapespace.report.render.renderer import Layer, render
from shapespace.schemas import MorphospacePart
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

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
        labels: names of the configurations.

    Raises:
        InputError: landmarks that are not planar, or that lie on a line.
    """
    ends = np.stack([low, high])
    if np.ptp(ends[:, :, 2]) > 0:
        raise InputError("A deformation grid needs planar landmarks; draw vectors for landmarks in 3-D instead.")
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
        low: (L, 3) landmarks at the start of the lines.
        high: (L, 3) landmarks at the end of the lines.
        labels: names of the configurations.
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
        points: (L, 3) positions of the landmarks.
        values: (L,) numbers; NaN is drawn in grey.
        unit: unit of the numbers.
        signed: whether the colour scale diverges at zero.
        limit: end of the colour scale; None for the largest magnitude, rounded up.
        mask: (L,) landmarks in full colour, the others are small and pale; None for no mask.

    Raises:
        InputError: the number of values or of mask entries is not that of the landmarks, or no value is finite.
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
    shades[known] = colours[
        (np.clip((values[known] - start) / (end - start), 0, 1) * (len(colours) - 1)).round().astype(int)
    ]
    shades[~inside] = _PALE + (1 - _PALE) * shades[~inside]
    for axes, (place,) in zip(plots, placed, strict=True):
        draw_links(axes, place, _GRID)
        axes.scatter(
            *place.T, s=np.where(inside, 70.0, 22.0), facecolors=shades, edgecolors=INK, linewidths=0.8, zorder=3
        )
    finish(figure, w_pad=0.6)
    height = float(figure.get_figheight()) * DPI
    colour_bar(figure, Scale(short(unit, 60), colours, start, end), height - bar_height(), height)
    return figure


def superimposed_landmarks(aligned: AlignedLandmarks) -> Figure:
    """Draw all specimens around their mean with numbered landmarks, in the views of `landmark_vectors_figure`."""
    shapes = np.pad(np.concatenate([aligned.mean[None], aligned.coords]), ((0, 0), (0, 0), (0, 3 - aligned.dimensions)))
    estimated = aligned.estimated
    figure, plots, placed = _in_views(
        shapes,
        "",
        note=("blue: specimens; black: their mean" + "; orange: missing landmarks, estimated" * int(estimated.any())),
    )
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
    views = (
        [(label, _first_rotation())]
        if (np.ptp(shapes[:, :, 2]) == 0)
        else [(named_view.name, view_rotation(named_view)) for named_view in current_orientation().views][:4]
        or list(_THREE_SIDES)
    )
    placed = [(shapes @ turn.T)[:, :, :2] for _, turn in views]
    placed = [landmarks - (landmarks.max(axis=(0, 1)) + landmarks.min(axis=(0, 1))) / 2 for landmarks in placed]
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
    figure, plots = charts(
        "",
        [((min(width * aspect, _MOST_INCHES * layout.scale) + room_of_titles) + below) / layout.scale],
        note=note,
        columns=columns,
    )
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


_FEWEST_OF_ELLIPSE = 5  # shapes; the radius of fewer is larger than the plot
_ELLIPSE = 0.95  # probability
_SPARSE = 5  # every fifth point of a grid line is kept, so that the page is small
_MOST_GRID = 400
"""Landmarks above which no deformation grid is drawn: they hide it."""
_MOST_IN_LEGEND, _MOST_DOTS_BIG = 24, 200  # entries of the legend; dots drawn at full size


@dataclass(frozen=True, eq=False, kw_only=True)
class Morphospace:
    """The plot of a `MorphospacePart` with its arrays, upright, and planar landmarks with a deformation grid.

    Args:
        part: names, axes and groups.
        arrays: arrays of the part as float64; `groups` is 0 and `nodes` and `edges` are empty if the part lacks them.
        faces: (F, 3); None for landmarks.
        grid: number of lines of the grid, and of points of each, after the landmarks in `mean` and `shape_axes`.
        is_planar: whether landmarks lie in the plane z = 0.
    """

    part: MorphospacePart
    arrays: Mapping[str, FloatArray]
    faces: IntArray | None
    grid: tuple[int, int] = (0, 0)
    is_planar: bool = False

    @staticmethod
    def of(
        part: MorphospacePart, arrays: Mapping[str, npt.NDArray[Any]], damaged: Callable[[str], ShapespaceError]
    ) -> Morphospace:
        """Return the plot of a part and the arrays of its file; `damaged` makes the error for arrays that do not fit.

        Raises:
            ShapespaceError: an array is absent, has another shape, or is not finite.
        """
        n, a, v = len(part.names), len(part.axes), len(arrays.get("mean", ()))
        shapes = {"scores": (n, a), "mean": (v, 3), "shape_axes": (a, v, 3), "faces": (-1, 3), "groups": (n,),
                  "nodes": (-1, a), "edges": (-1, 2), "cross_validated": (n, a)}  # fmt: skip
        absent = {"groups": np.zeros(n), "nodes": np.zeros((0, a)), "edges": np.zeros((0, 2))}
        known = {name: values for name, values in {**absent, **arrays}.items() if name in shapes}
        ends = {"groups": max(len(part.groups), 1), "edges": n + known["nodes"].size // max(a, 1), "faces": v}
        for name, shape in shapes.items():
            values = known.get(name, np.zeros(shape) if name == "cross_validated" else np.zeros(0))
            fits = values.ndim == len(shape) and all(a in (-1, b) for a, b in zip(shape, values.shape, strict=True))
            if not fits or values.dtype.kind not in "iuf" or not np.isfinite(values).all() or (
                name in ends and values.size and not 0 <= values.min() <= values.max() < ends[name]
            ):  # fmt: skip
                raise damaged(f"the array {name!r} of a morphospace does not fit its names and axes")
        if len(part.shares) != a or not all(0 <= axis < a for axis in part.first):
            raise damaged("a morphospace has axes that do not exist")
        faces = known["faces"].astype(np.int32) if known["faces"].size else None
        turn, _ = upright_views(Mesh(known["mean"], faces))
        known |= {"mean": known["mean"] @ turn.T, "shape_axes": known["shape_axes"] @ turn.T}
        flat = np.ptp(known["mean"][:, 2]) + np.abs(known["shape_axes"][:, :, 2]).max(initial=0.0)
        space = Morphospace(
            part=part, arrays={name: values.astype(np.float64) for name, values in known.items()}, faces=faces,
            is_planar=faces is None and bool(flat <= 1e-9 * np.ptp(known["mean"])),
        )  # fmt: skip
        return _with_grid(space) if space.is_planar and 3 < v <= _MOST_GRID else space

    @property
    def n_landmarks(self) -> int:
        """Number of vertices without those of the grid."""
        return len(self.arrays["mean"]) - self.grid[0] * self.grid[1]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the axes with their share of the variance."""
        unit, shares = f", {self.part.unit}" if self.part.unit else "", self.part.shares
        return tuple(f"{name}{unit} ({100 * share:.1f} %)" for name, share in zip(self.part.axes, shares, strict=True))

    @property
    def radii(self) -> FloatArray:
        """(G,) Mahalanobis radius of the 95 % ellipse of each group; NaN with fewer than five shapes."""
        # M18
        codes = self.arrays["groups"].astype(np.intp)
        counts = np.bincount(codes, minlength=max(len(self.part.groups), 1)).astype(np.float64)
        return np.where(
            counts >= _FEWEST_OF_ELLIPSE, np.sqrt(2 * fdtri(2, np.maximum(counts - 1, 1), _ELLIPSE)), np.nan
        )


def _with_grid(space: Morphospace) -> Morphospace:
    """Return the plot with the lines of a deformation grid after the landmarks.

    A thin-plate spline is linear in the landmarks that it warps the mean to, so its grid moves along axes as they do.
    """
    mean, axes = space.arrays["mean"], space.arrays["shape_axes"]
    lines = grid_lines(mean[:, :2])[:, ::_SPARSE]
    points = np.pad(lines.reshape(-1, 2), ((0, 0), (0, 1)))
    with_lines = {
        "mean": np.vstack([mean, points]),
        "shape_axes": np.concatenate(
            [axes, np.stack([ThinPlateSpline.fit(mean[:, :2], axis).apply(points[:, :2]) for axis in axes])], axis=1
        ),
    }
    return replace(space, arrays={**space.arrays, **with_lines}, grid=lines.shape[:2])


def hull(points: FloatArray) -> FloatArray:
    """Return the corners of the convex hull of points (n, 2), or the points themselves if they have no area."""
    try:
        return points[ConvexHull(points).vertices]
    except (QhullError, ValueError):
        return points


def ellipse(points: FloatArray, radius: float) -> FloatArray:
    """Return points (m, 2) of the ellipse of this Mahalanobis radius about the mean of points (n, 2)."""
    turns = np.linspace(0, 2 * np.pi, 73)
    values, vectors = np.linalg.eigh(np.cov(points.T))
    return (
        points.mean(axis=0)
        + radius * np.stack([np.cos(turns), np.sin(turns)], axis=1) @ (vectors * np.sqrt(np.maximum(values, 0))).T
    )


def morphospace_figure(space: Morphospace) -> Figure:
    """Draw the plane of the first two axes of a plot, and below it the shapes at the ends of both axes."""
    across, up = space.part.first
    figure, (axes, row) = charts("", [4.3, 1.3])
    plane, nodes = (space.arrays[name][:, [across, up]] for name in ("scores", "nodes"))
    axes.add_collection(
        LineCollection(
            list(np.vstack([plane, nodes])[space.arrays["edges"].astype(np.intp)]),
            colors=GREY,
            linewidths=0.8,
            zorder=1.5,
        )
    )
    axes.axhline(0, color=RULE, lw=1.6, zorder=1.0)
    axes.axvline(0, color=RULE, lw=1.6, zorder=1.0)
    for g, radius in enumerate(space.radii):
        points, colour = plane[space.arrays["groups"] == g], CATEGORIES[g % len(CATEGORIES)]
        label = escaped(short(space.part.groups[g], 30)) if space.part.groups else None
        if len(points) > 2 and space.part.groups:
            axes.fill(*hull(points).T, facecolor=(*colour, 0.10), edgecolor=(*colour, 0.7), lw=0.9, zorder=1.2)
            if np.isfinite(radius):
                axes.plot(*ellipse(points, float(radius)).T, color=colour, lw=1.0, ls=(0, (4, 2)), zorder=1.3)
        axes.scatter(
            *points.T, s=22 if len(plane) <= _MOST_DOTS_BIG else 8, color=colour, label=label, edgecolors="white",
            marker=MARKERS[(g + g // len(CATEGORIES)) % len(MARKERS)], linewidths=0.4, zorder=2,
        )  # fmt: skip
    axes.set(aspect="equal", adjustable="datalim")
    axes.margins(0.06)
    axes.set(xlabel=axis_label(space.labels[across]), ylabel=axis_label(space.labels[up], 0.6))
    if 1 < len(space.part.groups) <= _MOST_IN_LEGEND:
        legend(axes, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=min(len(space.part.groups), 4))
    _draw_shapes(row, space)
    # The limits of equal scales depend on the layout, and their ticks on the limits.
    figure.tight_layout()
    axes.apply_aspect()
    return finish(figure)


def _draw_shapes(row: Axes, space: Morphospace) -> None:
    """Draw the mean between the shapes at the ends of the two axes, side by side in one scale."""
    row.set_axis_off()
    mean, named = space.arrays["mean"], [("mean", space.arrays["mean"])]
    for axis in space.part.first:
        scores, name = space.arrays["scores"][:, axis], space.part.axes[axis]
        low, high = (
            (f"{name}\n{end:.3g}".replace("-", "−"), mean + end * space.arrays["shape_axes"][axis])
            for end in (scores.min(), scores.max())
        )
        named = [low, *named, high]
    points = np.concatenate([vertices for _, vertices in named])
    seen, (low, high) = view(points, len(named)), (points.min(axis=0), points.max(axis=0))
    room = 0.04 * float((high - low).max())
    for k, (name, vertices) in enumerate(named):
        panel = row.inset_axes(((k + 0.02) / len(named), 0.0, 0.96 / len(named), 0.76))
        panel.set_axis_off()
        panel.set_title(escaped(name), fontsize=type_size(SMALL), color=INK, pad=2)
        if space.faces is not None or space.n_landmarks > MOST_LANDMARKS:
            panel.imshow(render(Layer(Mesh(vertices, space.faces)), camera=seen.camera, size=seen.size))
            continue
        landmarks = vertices[: space.n_landmarks, :2]
        panel.add_collection(
            LineCollection(
                list(vertices[space.n_landmarks :, :2].reshape(*space.grid, 2)),
                colors=GREY,
                alpha=0.5,
                linewidths=type_size(0.5),
            )
        )
        draw_links(panel, landmarks, INK, type_size(0.9))
        panel.scatter(*landmarks.T, s=type_size(6), color=INK, linewidths=0, zorder=3)
        panel.set(xlim=(low[0] - room, high[0] + room), ylim=(low[1] - room, high[1] + room), aspect="equal")
