"""Figures of cohort analyses: maps on a surface, pairs of shapes, histograms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from shapespace.errors import InputError
from shapespace.geometry.normals import face_vectors, faces_of
from shapespace.report.figures.draw import (
    INK,
    MOST_PANELS,
    Row,
    Scale,
    axis_label,
    chart,
    equal_views,
    escaped,
    finish,
    grid,
    in_rows,
    legend,
    number_axis,
    plain,
    plain_decades,
    short,
    view,
)
from shapespace.report.inputs.correspondence_folder import upright
from shapespace.report.inputs.orientation import current_orientation, view_rotation
from shapespace.report.inputs.staged_fit import nice_ceiling
from shapespace.report.render.palette import CATEGORIES, DIVERGING, SEQUENTIAL
from shapespace.report.render.renderer import Camera, Image, Layer, render, visible_triangles
from shapespace.report.render.thumbnails import checker_layer, checker_places
from shapespace.types import BoolArray, FloatArray, Mesh

_CLOSED = (("front", 0.0), ("one side", 90.0), ("back", 180.0), ("other side", 270.0))
_OPEN = (("one side", -55.0), ("front", 0.0), ("other side", 55.0))
# share of the area that faces one way in an open surface, and cosine to the viewer that needs no rotation
_OPEN_SHARE, _AS_IT_STANDS = 0.15, 0.7
_PALE = 0.72  # share of white outside the mask
_FARTHEST_MM = 1e7  # mm (10 km); single precision cannot draw beyond it
_MOST_SERIES = 12  # colours that can be distinguished
_MOST_COLUMNS = 4  # views in a row: legible in print
_MOST_BINS = 2000  # above the pixels of a figure nothing is gained


def views_of(mesh: Mesh) -> list[tuple[str, FloatArray, float]]:
    """Return the views of a mesh, those of the orientation first of all: name, rotation (3, 3), and yaw after it.

    Raises:
        InputError: as of `upright_views`.
    """
    turn, sides = upright_views(mesh)
    named = [(one.name, view_rotation(one), 0.0) for one in current_orientation().views]
    return named or [(name, turn, yaw) for name, yaw in sides]


def upright_views(mesh: Mesh) -> tuple[FloatArray, Sequence[tuple[str, float]]]:
    """Return the rotation (3, 3) that brings `mesh` upright, and names of views with their yaw, degrees.

    The first view of the orientation is upright. Without one, the mesh stays as it stands where that is upright with
    its front along +z, as faces are; otherwise its principal axes turn it. A surface that is open to one side is seen
    from the other alone.

    Raises:
        InputError: it has no extent, or one beyond all measure.
    """
    vertices = mesh.vertices
    if not np.abs(vertices).max(initial=0.0) < _FARTHEST_MM or not np.ptp(vertices, axis=0).max(initial=0.0) > 0:
        raise InputError("There is no surface to draw in vertices without extent, or beyond 10 km.")
    if views := current_orientation().views:
        return view_rotation(views[0]), _CLOSED
    if mesh.faces is None:
        return np.eye(3), _CLOSED
    vectors = face_vectors(vertices, faces_of(mesh))
    facing, area = vectors.sum(axis=0), float(np.linalg.norm(vectors, axis=1).sum())
    is_open = float(np.linalg.norm(facing)) > _OPEN_SHARE * area
    longest = np.linalg.eigh(np.cov(vertices.T))[1][:, 2]
    is_standing = facing[2] > _AS_IT_STANDS * np.linalg.norm(facing) if is_open else abs(longest[1]) > _AS_IT_STANDS
    return np.eye(3) if is_standing else upright(mesh), _OPEN if is_open else _CLOSED


def surface_map_figure(
    mesh: Mesh,
    values: FloatArray,
    *,
    unit: str,
    signed: bool = True,
    limit: float | None = None,
    mask: BoolArray | None = None,
    title: str | None = "",
) -> Figure:
    """Draw a number for each vertex on a surface, seen from several sides.

    Args:
        mesh: in mm; without faces its vertices are drawn as balls.
        values: (V,); not-a-number is drawn in grey.
        unit: of the numbers.
        signed: whether two colours part at zero.
        limit: where the colours end; None for what 98 % of the numbers stay below.
        mask: (V,) outside which the colour is pale; None for none.
        title: above the figure; None for none, as in a page that has a heading.

    Raises:
        InputError: another number of values or of the mask's, no finite value, a limit that is none, or no extent.
    """
    count = len(mesh.vertices)
    if values.shape != (count,) or (mask is not None and mask.shape != (count,)):
        raise InputError(f"A surface of {count} vertices needs one number each, not {values.shape}.")
    known = np.isfinite(values)
    magnitudes = np.abs(values[known & mask] if mask is not None and (known & mask).any() else values[known])
    if not len(magnitudes):
        raise InputError("There is nothing to draw on a surface without numbers.")
    if limit is not None and not 0 < limit < np.inf:
        raise InputError(f"The colours of a map cannot end at {limit}.")
    end = nice_ceiling(float(np.quantile(magnitudes, 0.98)) or float(magnitudes.max())) if limit is None else limit
    sides = views_of(mesh)
    scalars = np.clip(values, -4 * end, 4 * end)
    low, colours = (-end, DIVERGING) if signed else (0.0, SEQUENTIAL)
    cameras, size = equal_views(
        [(mesh.vertices @ turn.T, yaw) for _, turn, yaw in sides], min(len(sides), _MOST_COLUMNS)
    )
    panels: list[Image] = []
    for camera, (_, turn, _) in zip(cameras, sides, strict=True):
        turned_mesh = mesh.with_vertices(mesh.vertices @ turn.T)
        full = Layer(turned_mesh, scalars=scalars, colormap=colours, vmin=low, vmax=end)
        image = render(full, camera=camera, size=size)
        if mask is not None and not mask.all():
            pale = render(replace(full, colormap=_PALE + (1 - _PALE) * colours), camera=camera, size=size)
            inside = _inside(turned_mesh, mask, camera, size)[:, :, None]
            image = np.rint(pale + (image.astype(float) - pale) * inside).astype(np.uint8)
        panels.append(image)
    extend_words = {(True, True): "both", (True, False): "low", (False, True): "high"}
    extend = extend_words.get((bool(values[known].min() < low), bool(values[known].max() > end)), "neither")
    pale_note = "Pale: outside of what is marked." if mask is not None and not mask.all() else ""
    return grid(
        in_rows(panels, [name for name, _, _ in sides], _MOST_COLUMNS),
        title=None if title is None else title or f"{plain(unit)} on the surface",
        scale=Scale(short(unit, 70), colours, low, end, extend),
        note=f"{'' if known.all() else 'Grey: no value.'} {pale_note}".strip(),
    )


def _inside(mesh: Mesh, mask: BoolArray, camera: Camera, size: tuple[int, int]) -> FloatArray:
    """Return the share (H, W) of each pixel that shows triangles, or points, whose vertices are mostly in the mask."""
    width, height = size
    if mesh.faces is None:
        lit = Layer(mesh, scalars=mask.astype(float), colormap=np.eye(3)[[0, 1]], categories=True)
        image = render(lit, camera=camera, size=size).astype(float)
        return image[:, :, 1] / np.maximum(image[:, :, 0] + image[:, :, 1], 1.0)
    triangle, _ = visible_triangles(mesh, camera=camera, size=(2 * width, 2 * height))
    inside = np.append(mask[mesh.faces].sum(axis=1) >= 2, [True])[triangle]
    return inside.reshape(height, 2, width, 2).mean(axis=(1, 3))


def morph_figure(low: Mesh, high: Mesh, labels: tuple[str, str], *, title: str | None = "") -> Figure:
    """Draw two shapes in correspondence side by side, from one camera.

    Args:
        low: one shape.
        high: the other.
        labels: what they are.
        title: above the figure; None for none, as in a page that has a heading.

    Raises:
        InputError: no extent, or one beyond all measure.
    """
    turn, yaws = upright_views(low)
    # Half from the side, where a change of depth is seen too.
    sides = views_of(low)[:2] if current_orientation().views else [
        ("", turn, 0.0), ("", turn, 40.0 if yaws is _OPEN else 90.0)
    ]  # fmt: skip
    points = np.concatenate([low.vertices, high.vertices])
    cameras, size = equal_views([(points @ side.T, yaw) for _, side, yaw in sides], 2 * len(sides))
    panels = [
        render(Layer(mesh.with_vertices(mesh.vertices @ side[1].T)), camera=camera, size=size)
        for mesh in (low, high)
        for camera, side in zip(cameras, sides, strict=True)
    ]
    names = [f"{short(label, 30)} {name}".strip() for label in labels for name, _, _ in sides]
    both_named = f"{plain(labels[0])}, and {plain(labels[1])}"
    return grid([Row(panels, names)], title=None if title is None else title or both_named)


def histogram_figure(
    edges: npt.ArrayLike,
    series: Sequence[tuple[str, npt.ArrayLike]],
    *,
    x: str,
    y: str = "count",
    observed: float | None = None,
    observed_label: str = "",
    title: str = "",
) -> Figure:
    """Draw a histogram, with a line at one value.

    Args:
        edges: (n + 1,) rising.
        series: for each its name, empty for none, and its (n,) counts.
        x: what the values are, with their unit.
        y: what the counts are, such as `share` where they are divided by their sum.
        observed: where a line stands, such as a statistic among its permutations.
        observed_label: what it is.
        title: above the figure.

    Raises:
        InputError: edges that do not rise, counts of another length or below 0, or nothing to draw.
    """
    bin_edges = np.asarray(edges, dtype=np.float64)
    if not 2 <= len(bin_edges) <= _MOST_BINS or not np.isfinite(bin_edges).all() or not (np.diff(bin_edges) > 0).all():
        raise InputError(f"A histogram needs 2 to {_MOST_BINS} edges that rise.")
    if not 1 <= len(series) <= _MOST_SERIES:
        raise InputError(f"A histogram has 1 to {_MOST_SERIES} series, not {len(series)}.")
    figure, axes = chart(title or f"Distribution of {plain(x)}", height=3.0)
    for k, (name, counts) in enumerate(series):
        heights = np.asarray(counts, dtype=np.float64)
        if heights.shape != (len(bin_edges) - 1,) or not np.isfinite(heights).all() or (heights < 0).any():
            raise InputError(f"The histogram {short(name)!r} needs {len(bin_edges) - 1} counts that are not negative.")
        colour, filled = CATEGORIES[k % len(CATEGORIES)], 0.55 if len(series) == 1 else 0.3
        axes.stairs(heights, bin_edges, fill=True, color=colour, alpha=filled, label=escaped(short(name, 40)) or None)
        axes.stairs(heights, bin_edges, color=colour, lw=1.6)
    low, high = float(bin_edges[0]), float(bin_edges[-1])
    if observed is not None:
        if not np.isfinite(observed):
            raise InputError("What was observed among the values of a histogram must be a finite number.")
        axes.axvline(observed, color=INK, lw=2.0, ls=(0, (4, 2)), label=escaped(short(observed_label, 40)) or None)
        low, high = min(low, observed), max(high, observed)
    room = 0.02 * (high - low)
    axes.set(xlim=(low - room, high + room), xlabel=axis_label(x), ylabel=axis_label(y))
    # Room for the legend above the bars, on the side where the observed value is not.
    axes.set_ylim(0, axes.get_ylim()[1] * 1.3)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=y == "count"))
    if any(name for name, _ in series) or (observed is not None and observed_label):
        on_left = observed is not None and 2 * observed > low + high
        legend(axes, loc="upper left" if on_left else "upper right", handlelength=2.4)
    return finish(figure)


SIDE_DEG = 65.0  # degrees, between three quarters and profile
_LONGEST = 16  # layout: characters above a panel
_LINES = ("#9cc3e0", "#0072B2", "#D55E00", "#6b140f")


def checkerboard_figure(
    mean: Mesh, surfaces: Sequence[FloatArray], labels: Sequence[str], *, yaw_deg: float = 0.0, title: str = ""
) -> Figure:
    """Draw one checkerboard on the mean shape and on each scan: the same square has the same vertices.

    Args:
        mean: the mean shape, upright.
        surfaces: (V, 3) each, moved onto the mean shape; not-a-number where missing.
        labels: one a surface.
        yaw_deg: from where.
        title: above the figure.

    Raises:
        InputError: no surfaces, too many for one figure, or another number of labels.
    """
    if not 0 < len(surfaces) < MOST_PANELS or len(surfaces) != len(labels):
        raise InputError(f"{len(surfaces)} surfaces with {len(labels)} labels cannot be drawn in one figure.")
    places = checker_places(mean, yaw_deg)
    columns = 4
    shapes = (mean.vertices, *surfaces)
    drawn = np.concatenate([shape[np.isfinite(shape).all(axis=1)] for shape in shapes])
    panel = view(drawn, columns, yaw_deg=yaw_deg)
    return grid(
        in_rows(
            [
                render(checker_layer(mean.with_vertices(shape), places), camera=panel.camera, size=panel.size)
                for shape in shapes
            ],
            ["mean shape", *_distinct_labels(labels)],
            columns,
        ),
        title=title or "The same squares on every scan",
    )


def _distinct_labels(labels: Sequence[str]) -> list[str]:
    """Return labels that fit above a panel; if two become equal when cut, their common beginning is removed."""
    cut = [short(label, _LONGEST) for label in labels]
    if len(set(cut)) == len(cut):
        return cut
    alike = next((k for k, letters in enumerate(zip(*labels, strict=False)) if len(set(letters)) > 1), 0)
    return [short(f"…{label[alike:]}", _LONGEST) for label in labels]


def missing_figure(mean: Mesh, missing_share: FloatArray, *, title: str = "") -> Figure:
    """Draw the share of scans with each vertex missing, on the mean shape from four sides.

    Args:
        mean: the mean shape, upright.
        missing_share: (V,) 0 to 1.
        title: above the figure.
    """
    largest_share = float(missing_share.max(initial=0.0))
    top = next(limit for limit in (0.05, 0.1, 0.25, 0.5, 1.0) if largest_share <= limit)
    return _from_four_sides(
        mean,
        100 * missing_share,
        Scale("scans that do not show the vertex (%)", SEQUENTIAL, 0.0, 100 * top),
        title or "Where vertices are missing",
    )


def position_std_figure(mean: Mesh, position_std: FloatArray, limit: float, *, title: str = "") -> Figure:
    """Draw the standard deviation of the position of each vertex along the surface, on the mean shape from four sides.

    Args:
        mean: the mean shape, upright.
        position_std: (V,) shares of the size.
        limit: end of the scale, percent.
        title: above the figure.
    """
    return _from_four_sides(
        mean,
        100 * position_std,
        Scale("standard deviation along the surface (% of the size)", SEQUENTIAL, 0.0, limit, "high"),
        title or "How sure the position of each vertex is",
    )


def _from_four_sides(mean: Mesh, values: FloatArray, scale: Scale, title: str) -> Figure:
    """Draw `values` (V,) on the mean shape from four sides."""
    layer = Layer(mean, scalars=values, colormap=SEQUENTIAL, vmax=scale.high)
    cameras, size = equal_views([(mean.vertices, yaw) for _, yaw in _CLOSED], len(_CLOSED))
    return grid(
        [Row([render(layer, camera=camera, size=size) for camera in cameras], [name for name, _ in _CLOSED])],
        title=title,
        scale=scale,
    )


def nearness_figure(distances: FloatArray, *, title: str = "") -> Figure:
    """Draw how many scans have distances up to each length.

    Args:
        distances: (N, 4) mean, 95 %, 99 % and largest distance of each scan, as shares of its size.
        title: above the figure.

    Raises:
        InputError: there are none.
    """
    known = 100 * distances[np.isfinite(distances).all(axis=1)]
    if not len(known):
        raise InputError("No scan has distances to draw.")
    figure, axes = chart(title or "How near the surfaces lie to their scans", height=3.0)
    known = np.maximum(known, 1e-4)
    low, high = 0.7 * float(known.min()), 1.4 * float(known.max())
    for column, (name, colour) in enumerate(
        zip(("mean", "95 % of the points", "99 %", "farthest point"), _LINES, strict=True)
    ):
        sorted_values = np.sort(known[:, column])
        share = 100 * np.arange(len(sorted_values) + 1) / len(sorted_values)
        axes.plot(
            [low, *sorted_values, high], [*share, 100.0], drawstyle="steps-post", color=colour, lw=2.0, label=name
        )
    axes.set(xlabel="distance, % of the object's size", ylabel="scans up to there (%)")
    axes.set(xscale="log", xlim=(low, high), ylim=(0, 102))
    plain_decades(axes.xaxis)
    legend(axes, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncol=4)
    return finish(figure)


def movement_figure(
    rounds: Sequence[float], scans: Sequence[Sequence[float]], settled_mm: float, *, title: str = ""
) -> Figure:
    """Draw by how much vertices moved in each round: all together, and each scan.

    Args:
        rounds: RMS of each round, shares of the size.
        scans: the same of each scan; those that missed a round are left out.
        settled_mm: below which the rounds end.
        title: above the figure.

    Raises:
        InputError: there are no rounds.
    """
    if not rounds:
        raise InputError("There are no rounds to draw.")
    figure, axes = chart(title or "How far vertices moved in each round", height=3.0)
    round_numbers = np.arange(1, len(rounds) + 1)
    for k, series in enumerate([series for series in scans if len(series) == len(rounds)]):
        axes.plot(
            round_numbers,
            np.maximum(100 * np.array(series), 1e-3),
            color=_LINES[0],
            lw=1.0,
            alpha=float(np.clip(20 / len(scans), 0.15, 0.8)),
            marker="o",
            ms=2.5,
            label="a scan" if k == 0 else None,
        )
    axes.plot(
        round_numbers, np.maximum(100 * np.array(rounds), 1e-3), color=INK, lw=2.6, marker="o", label="all together"
    )
    axes.axhline(100 * settled_mm, color=_LINES[2], lw=1.2, ls="--", label="settled below")
    axes.set(xlabel="round", ylabel="moved (RMS), % of the size", yscale="log")
    plain_decades(axes.yaxis)
    number_axis(axes, len(rounds), room=0.3)
    legend(axes, loc="upper right")
    return finish(figure)
