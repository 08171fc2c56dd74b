"""Figures of analyses, correspondences and recognition: maps, pairs of shapes, histograms, curves, matrices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from shapespace.cohort.orientation import current_orientation, view_rotation
from shapespace.errors import InputError
from shapespace.geometry.normals import face_vectors, faces_of
from shapespace.report.figures.draw import (
    BARS,
    DPI,
    FORWARD,
    GREY,
    INK,
    LAYOUT,
    MOST_PANELS,
    SMALL,
    Row,
    Scale,
    axis_label,
    chart,
    charts,
    counted,
    equal_views,
    escaped,
    finish,
    grid,
    in_rows,
    legend,
    measured,
    number_axis,
    percent,
    plain,
    plain_decades,
    short,
    type_size,
    view,
)
from shapespace.report.inputs.correspondence_folder import upright
from shapespace.report.inputs.saved_fits import nice_ceiling
from shapespace.report.render.palette import CATEGORIES, DIVERGING, SEQUENTIAL, oklab
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
    """Return the views of a mesh: name, rotation (3, 3), and yaw (degrees) after the rotation.

    These are the views of the current orientation, or of `upright_views` if it has none.

    Raises:
        InputError: see `upright_views`.
    """
    turn, sides = upright_views(mesh)
    return [(named_view.name, view_rotation(named_view), 0.0) for named_view in current_orientation().views] or [
        (name, turn, yaw) for name, yaw in sides
    ]


def upright_views(mesh: Mesh) -> tuple[FloatArray, Sequence[tuple[str, float]]]:
    """Return the rotation (3, 3) that brings `mesh` upright, and names of views with their yaw, degrees.

    The first view of the orientation is upright. Without an orientation, the mesh is not turned if it is upright with
    its front along +z, as faces are; otherwise its principal axes turn it. A surface that is open to one side is seen
    only from the opposite side.

    Raises:
        InputError: the mesh has no extent, or extends beyond 10 km.
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
        mesh: mesh in mm; vertices of a mesh without faces are drawn as balls.
        values: (V,) numbers; NaN is drawn in grey.
        unit: unit of the numbers.
        signed: whether the colour scale diverges at zero.
        limit: end of the colour scale; None for the 98 % quantile of the magnitudes, rounded up.
        mask: (V,) vertices in full colour, the others are pale; None for no mask.
        title: text above the figure; None for no title, as in a page that has a heading.

    Raises:
        InputError: values or mask of another length, no finite value, a limit that is not positive, or no extent.
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
            image = np.rint(
                pale + (image.astype(float) - pale) * _mask_share(turned_mesh, mask, camera, size)[:, :, None]
            ).astype(np.uint8)
        panels.append(image)
    extend = {(True, True): "both", (True, False): "low", (False, True): "high"}.get(
        (bool(values[known].min() < low), bool(values[known].max() > end)), "neither"
    )
    pale_note = "Pale: outside the marked part." if mask is not None and not mask.all() else ""
    return grid(
        in_rows(panels, [name for name, _, _ in sides], _MOST_COLUMNS),
        title=None if title is None else title or f"{plain(unit)} on the surface",
        scale=Scale(short(unit, 70), colours, low, end, extend),
        note=f"{'' if known.all() else 'Grey: no value.'} {pale_note}".strip(),
    )


def _mask_share(mesh: Mesh, mask: BoolArray, camera: Camera, size: tuple[int, int]) -> FloatArray:
    """Return the share (H, W) of each pixel that shows triangles, or points, whose vertices are mostly in the mask."""
    width, height = size
    if mesh.faces is None:
        image = render(
            Layer(mesh, scalars=mask.astype(float), colormap=np.eye(3)[[0, 1]], categories=True),
            camera=camera,
            size=size,
        ).astype(float)
        return image[:, :, 1] / np.maximum(image[:, :, 0] + image[:, :, 1], 1.0)
    triangle, _ = visible_triangles(mesh, camera=camera, size=(2 * width, 2 * height))
    return np.append(mask[mesh.faces].sum(axis=1) >= 2, [True])[triangle].reshape(height, 2, width, 2).mean(axis=(1, 3))


def morph_figure(low: Mesh, high: Mesh, labels: tuple[str, str], *, title: str | None = "") -> Figure:
    """Draw two shapes in correspondence side by side, from one camera.

    Args:
        low: first shape.
        high: second shape.
        labels: names of the two shapes.
        title: text above the figure; None for no title, as in a page that has a heading.

    Raises:
        InputError: no extent, or one beyond 10 km.
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
    return grid(
        [Row(panels, names)], title=None if title is None else title or f"{plain(labels[0])}, and {plain(labels[1])}"
    )


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
        edges: (n + 1,) ascending edges of the bins.
        series: name (empty for none) and (n,) counts of each histogram.
        x: name and unit of the values.
        y: name of the counts, such as `share` if they are divided by their sum.
        observed: position of a line, such as a statistic among its permutations; None for no line.
        observed_label: label of the line.
        title: text above the figure.

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
            raise InputError("The observed value of a histogram must be a finite number.")
        axes.axvline(observed, color=INK, lw=2.0, ls=(0, (4, 2)), label=escaped(short(observed_label, 40)) or None)
        low, high = min(low, observed), max(high, observed)
    room = 0.02 * (high - low)
    axes.set(xlim=(low - room, high + room), xlabel=axis_label(x), ylabel=axis_label(y))
    # Room for the legend above the bars, on the side where the observed value is not.
    axes.set_ylim(0, axes.get_ylim()[1] * 1.3)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, integer=y == "count"))
    if any(name for name, _ in series) or (observed is not None and observed_label):
        legend(
            axes,
            loc="upper left" if (observed is not None and 2 * observed > low + high) else "upper right",
            handlelength=2.4,
        )
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
        surfaces: (V, 3) each, moved onto the mean shape; NaN where missing.
        labels: one label per surface.
        yaw_deg: angle of the camera from the front, degrees.
        title: text above the figure.

    Raises:
        InputError: no surfaces, too many for one figure, or another number of labels.
    """
    if not 0 < len(surfaces) < MOST_PANELS or len(surfaces) != len(labels):
        raise InputError(f"{len(surfaces)} surfaces with {len(labels)} labels cannot be drawn in one figure.")
    places = checker_places(mean, yaw_deg)
    columns = 4
    shapes = (mean.vertices, *surfaces)
    panel = view(np.concatenate([shape[np.isfinite(shape).all(axis=1)] for shape in shapes]), columns, yaw_deg=yaw_deg)
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
        title: text above the figure.
    """
    largest_share = float(missing_share.max(initial=0.0))
    return _from_four_sides(
        mean,
        100 * missing_share,
        Scale(
            "scans that do not show the vertex (%)",
            SEQUENTIAL,
            0.0,
            100 * next(limit for limit in (0.05, 0.1, 0.25, 0.5, 1.0) if largest_share <= limit),
        ),
        title or "Where vertices are missing",
    )


def position_std_figure(mean: Mesh, position_std: FloatArray, limit: float, *, title: str = "") -> Figure:
    """Draw the standard deviation of the position of each vertex along the surface, on the mean shape from four sides.

    Args:
        mean: the mean shape, upright.
        position_std: (V,) shares of the size.
        limit: end of the scale, percent.
        title: text above the figure.
    """
    return _from_four_sides(
        mean,
        100 * position_std,
        Scale("standard deviation along the surface (% of the size)", SEQUENTIAL, 0.0, limit, "high"),
        title or "Uncertainty of the position of each vertex",
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
        title: text above the figure.

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
        axes.plot(
            [low, *sorted_values, high],
            [*(100 * np.arange(len(sorted_values) + 1) / len(sorted_values)), 100.0],
            drawstyle="steps-post",
            color=colour,
            lw=2.0,
            label=name,
        )
    axes.set(xlabel="distance, % of the object's size", ylabel="scans up to there (%)")
    axes.set(xscale="log", xlim=(low, high), ylim=(0, 102))
    plain_decades(axes.xaxis)
    legend(axes, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4)
    return finish(figure)


def movement_figure(
    rounds: Sequence[float], scans: Sequence[Sequence[float]], settled_share: float, *, title: str = ""
) -> Figure:
    """Draw by how much vertices moved in each round: all together, and each scan.

    Args:
        rounds: RMS of each round, shares of the size.
        scans: RMS of each round of each scan; scans that missed a round are omitted.
        settled_share: movement below which the rounds end, share of the size.
        title: text above the figure.

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
    axes.axhline(100 * settled_share, color=_LINES[2], lw=1.2, ls="--", label="settled below")
    axes.set(xlabel="round", ylabel="moved (RMS), % of the size", yscale="log")
    plain_decades(axes.yaxis)
    number_axis(axes, len(rounds), room=0.3)
    legend(axes, loc="upper right")
    return finish(figure)


CurveScale: TypeAlias = Literal["linear", "log", "probit"]
"""Scale of an axis of a curve."""

_MOST_CLASSES_IN_FULL, _MOST_CLASSES = 12, 40  # classes with numbers, and without: legible at the figure's size
_MARKERS = "os^Dvp"  # of groups, so that print without colour can be read
_MOST_CURVES, _MOST_TICKS = 60, 9  # curves and tick labels: legible at the figure's size
_LEAST_SHARE, _PROBIT_ROOM = 1e-6, 0.12  # ends of a probit axis, which cannot show 0, and its margin in probits
_SHARES = (
    1e-6, 1e-5, 1e-4, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995,
    0.998, 0.999, 1 - 1e-4,
)  # fmt: skip


def confusion_figure(counts: npt.ArrayLike, classes: Sequence[str], *, title: str = "") -> Figure:
    """Draw a confusion matrix: one row per true class, in percent of its samples, with their number.

    Right answers lie in the framed cells of the diagonal; a cell without samples stays empty.

    Args:
        counts: (C, C) number of samples of the row's class that were predicted to be of the column's class.
        classes: names of the C classes.
        title: text above the figure; by default the accuracy.

    Raises:
        InputError: counts of another shape or below 0, no sample at all, or more than 40 classes.
    """
    table = _numbers(counts, "the counts of a confusion matrix", ndim=2)
    n = len(classes)
    if not 1 <= n <= _MOST_CLASSES:
        raise InputError(f"A confusion matrix of 1 to {_MOST_CLASSES} classes can be drawn, not of {n}.")
    if table.shape != (n, n):
        raise InputError(f"A confusion matrix of {n} classes must have the shape ({n}, {n}), not {table.shape}.")
    if (table < 0).any() or not table.sum() > 0:
        raise InputError("A confusion matrix needs counts that are not negative, and at least one sample.")
    per_class = table.sum(axis=1)
    shares = np.divide(table, per_class[:, None], out=np.zeros_like(table), where=per_class[:, None] > 0)
    rows = [f"{short(name, 18)} ({count:g})" for name, count in zip(classes, per_class, strict=True)]
    columns = [short(name, 14) for name in classes]
    longest = max(measured(text, type_size(SMALL)) for text in columns)
    wide = (LAYOUT.get().chart_width - max(measured(text, type_size(SMALL)) for text in rows) - 60) / n
    high = max(min(wide, 78.0), 280 / n)
    upright = longest > 0.94 * wide
    figure, axes = chart(
        title or _accuracy_sentence(table, shares, classes), height=(n * high + (longest if upright else 20) + 60) / DPI
    )
    axes.imshow(shares, cmap=ListedColormap(SEQUENTIAL), vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    for k in range(1, n):
        axes.axhline(k - 0.5, color="white", lw=1.5)
        axes.axvline(k - 0.5, color="white", lw=1.5)
    for r in range(n):
        across, up = 1 - 5 / wide, 1 - 5 / high
        axes.add_patch(Rectangle((r - across / 2, r - up / 2), across, up, fill=False, ec=INK, lw=1.8, zorder=4))
        if per_class[r] == 0:
            axes.text((n - 1) / 2, r, "none", ha="center", va="center", fontsize=type_size(SMALL), color=GREY)
        for c in range(n):
            if table[r, c] > 0 and n <= 2 * _MOST_CLASSES_IN_FULL:
                _cell(axes, r, c, shares[r, c], table[r, c], n)
    axes.set_xticks(range(n), [escaped(text) for text in columns], rotation=90 if upright else 0)
    axes.set_yticks(range(n), [escaped(text) for text in rows])
    axes.set(xlabel="predicted class", ylabel="true class (count)")
    finish(figure)
    axes.grid(False)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    return figure


def _accuracy_sentence(table: FloatArray, shares: FloatArray, classes: Sequence[str]) -> str:
    """Return the accuracy and the most frequent confusion as a sentence."""
    total = float(table.sum())
    headline = f"{percent(float(np.trace(table)) / total)} of {counted(round(total), 'answer')} are right"
    wrong = shares * (1 - np.eye(len(classes)))
    true, taken = divmod(int(wrong.argmax()), len(classes))
    if wrong[true, taken] == 0:
        return headline
    return f"{headline}; most often {short(classes[true], 24)} is taken for {short(classes[taken], 24)}"


def _cell(axes: Axes, row: int, column: int, share: float, count: float, n: int) -> None:
    ink = "white" if oklab(SEQUENTIAL[round(255 * share)])[0] < 0.64 else INK
    weight = "bold" if row == column else "normal"
    if n <= _MOST_CLASSES_IN_FULL:
        axes.text(
            column,
            row - 0.14,
            percent(share),
            ha="center",
            va="center",
            fontsize=type_size(SMALL),
            color=ink,
            weight=weight,
        )
        axes.text(column, row + 0.25, f"{count:g}", ha="center", va="center", fontsize=type_size(SMALL - 2), color=ink)
    else:
        axes.text(column, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=type_size(SMALL - 3), color=ink)


def calibration_figure(
    bins: npt.ArrayLike, *, ece: float | None = None, brier: float | None = None, title: str = ""
) -> Figure:
    """Draw a reliability diagram: the share of right answers against the stated probability, and the number of answers.

    Args:
        bins: (n, 5), for each bin of probabilities: its two ends, the mean stated probability, the share of right
            answers (all 0 to 1), and the number of answers. Bins without answers are omitted.
        ece: expected calibration error, 0 to 1, None if it is unknown.
        brier: Brier score, 0 to 1; None if it is unknown.
        title: text above the figure; by default the calibration error.

    Raises:
        InputError: bins of another shape, no answer in any bin, or shares that are not within 0 to 1.
    """
    table = _numbers(bins, "the bins of a calibration", ndim=2, finite=False)
    if table.shape[1] != 5:
        raise InputError(f"Each bin of a calibration is five numbers, not {table.shape[1]}.")
    table = table[np.nan_to_num(table[:, 4]) > 0]
    if not len(table):
        raise InputError("There is nothing to draw of a calibration without answers.")
    start, end = 100 * np.clip(table[:, :2].T, 0, 1)
    stated, right, counts = *(100 * table[:, 2:4].T), table[:, 4]
    if not ((table[:, 2:4] >= 0) & (table[:, 2:4] <= 1)).all():
        raise InputError("Stated probabilities and shares of right answers in a calibration must lie within 0 to 1.")
    error = None if ece is None else f"Stated probabilities are off by {100 * ece:.1f} points on average"
    headline = error or "How often answers are right, against the probability stated for them"
    figure, (curve_axes, count_axes) = charts(
        title or headline, [2.9, 1.25], note=("" if brier is None else f"Brier score {brier:.3f} (0 is best).")
    )
    floor = min(float(start.min()), 100 - 1e-3)
    curve_axes.plot([0, 100], [0, 100], color=GREY, ls=(0, (4, 3)), lw=1.4, label="right as often as stated")
    size = 26 + 190 * counts / counts.max()
    curve_axes.plot(stated, right, color=FORWARD, lw=1.6, zorder=2)
    curve_axes.scatter(
        stated,
        right,
        s=size,
        color=FORWARD,
        edgecolors="white",
        linewidths=0.8,
        zorder=3,
        label="answers, more in larger dots",
    )
    curve_axes.set(
        xlim=(floor, 101.5), ylim=(min(floor, float(right.min()) - 5, 100.0), 104), ylabel="right answers (%)"
    )
    legend(curve_axes, loc="lower right" if right[-1] > 60 else "upper left")
    count_axes.bar(start, counts, width=end - start, align="edge", color=BARS, edgecolor="white")
    count_axes.set(xlim=(floor, 101.5), xlabel="probability stated (%)", ylabel="answers")
    count_axes.locator_params(axis="y", nbins=3, integer=True)
    return finish(figure, h_pad=0.8)


def learning_curve_figure(
    subjects: npt.ArrayLike,
    mean: npt.ArrayLike,
    *,
    low: npt.ArrayLike | None = None,
    high: npt.ArrayLike | None = None,
    band: str = "interval",
    ceiling: float | None = None,
    title: str = "",
) -> Figure:
    """Draw the accuracy on unseen people against the number of training people.

    Args:
        subjects: (n,) numbers of training people, ascending.
        mean: (n,) accuracy, 0 to 1.
        low: (n,) lower end of the interval, 0 to 1; None if it is unknown.
        high: (n,) upper end of the interval, 0 to 1; None if it is unknown.
        band: name of the interval.
        ceiling: upper bound of the accuracy, 0 to 1; None if it is unknown.
        title: text above the figure; by default the first and last accuracy.

    Raises:
        InputError: lists that are empty or of different lengths.
    """
    x = _numbers(subjects, "the numbers of subjects of a learning curve")
    y = 100 * _numbers(mean, "the accuracies of a learning curve")
    if not len(x) or x.shape != y.shape:
        raise InputError(f"A learning curve of {len(x)} numbers of subjects cannot have {len(y)} accuracies.")
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    single = f"{y[0]:.1f} % right with {counted(round(x[0]), 'subject')} to learn from"
    gain = (
        f"Learning from {x[-1]:g} subjects instead of {x[0]:g} takes the share of right answers from {y[0]:.1f} % to "
        f"{y[-1]:.1f} %"
    )
    figure, axes = chart(title or (gain if len(x) > 1 else single), height=3.3)
    bottom = float(y.min())
    if low is not None and high is not None:
        if not np.shape(low) == np.shape(high) == x.shape:
            raise InputError(f"The interval of a learning curve must have {len(x)} lower and {len(x)} upper ends.")
        interval = [100 * _numbers(values, "the interval of a learning curve")[order] for values in (low, high)]
        axes.fill_between(x, interval[0], interval[1], color=BARS, alpha=0.5, lw=0, label=escaped(short(band, 40)))
        bottom = min(bottom, float(interval[0].min()))
    axes.plot(x, y, color=FORWARD, lw=2, marker="o", ms=5, label="right answers")
    if ceiling is not None:
        axes.axhline(100 * ceiling, color=INK, ls=(0, (4, 3)), lw=1.4, label=f"ceiling: {100 * ceiling:.1f} %")
        bottom = min(bottom, 100 * ceiling)
    axes.set(xlabel="subjects learned from", ylabel="right answers, unseen subjects (%)", xlim=(0, 1.04 * float(x[-1])))
    axes.set_ylim(max(0.0, 10 * np.floor((bottom - 4) / 10)), 101)
    axes.locator_params(axis="x", integer=True)
    legend(axes, loc="lower right")
    return finish(figure)


def curve_figure(
    series: Sequence[tuple[str, npt.ArrayLike, npt.ArrayLike]],
    *,
    x: str,
    y: str,
    title: str = "",
    bands: Sequence[tuple[npt.ArrayLike, npt.ArrayLike] | None] = (),
    dots: Sequence[bool] = (),
    scales: tuple[CurveScale, CurveScale] = ("linear", "linear"),
    diagonal: bool = False,
    groups: Sequence[int | None] = (),
) -> Figure:
    """Draw one measure against another, one line per series.

    Args:
        series: name (empty for none), (n,) x values and (n,) y values of each line.
        x: name and unit of the x values.
        y: name and unit of the y values.
        title: text above the figure; by default y against x.
        bands: lower and upper ends (n,) of a band around each series, NaN where unknown; None for a series without a
            band.
        dots: whether each series is drawn as dots without a line.
        scales: scales of the x and y axes; `probit` draws shares at their normal deviates, and 0 and 1 at the edge;
            `log` omits numbers that are not positive.
        diagonal: whether to draw the line of equal values.
        groups: group number of each series, which selects colour and marker; None for the index of the series.

    Raises:
        InputError: no series or too many, a series with empty lists or lists of unequal length, or numbers that have no
            place on their scale.
    """
    if not 1 <= len(series) <= _MOST_CURVES:
        raise InputError(f"A figure has 1 to {_MOST_CURVES} curves, not {len(series)}.")
    curves: list[_Curve] = []
    for k, (name, places, values) in enumerate(series):
        x_values = _numbers(places, f"the places of the curve {short(name)}")
        y_values = _numbers(values, f"the values of the curve {short(name)}")
        if not len(x_values) or x_values.shape != y_values.shape:
            raise InputError(f"The curve {short(name)!r} has {len(x_values)} places but {len(y_values)} values.")
        ends = [
            _numbers(end, f"the band of the curve {short(name)}", finite=False)
            for end in (bands[k] if k < len(bands) else None) or ()
        ]
        if any(end.shape != x_values.shape for end in ends):
            raise InputError(
                f"The band of the curve {short(name)!r} needs {len(x_values)} lower and {len(x_values)} upper ends."
            )
        group = groups[k] if k < len(groups) else None
        curves.append(_Curve(name, x_values, y_values, ends, k < len(dots) and dots[k], k if group is None else group))
    limits = (
        _scale_ends(scales[0], [curve.x for curve in curves]),
        _scale_ends(scales[1], [values for curve in curves for values in (curve.y, *curve.ends)]),
    )
    figure, axes = chart(
        title or f"{plain(y)[:1].upper()}{plain(y)[1:]} against {plain(x)}",
        height=4.6 if (diagonal and scales[0] == scales[1]) else 3.3,
    )
    has_groups = any(group is not None for group in groups)
    for curve in curves:
        k, marker = curve.group, _MARKERS[curve.group % len(_MARKERS)] if has_groups else "o"
        x_values, y_values, *ends = (
            _to_scale(values, scales[axis], limits[axis])
            for axis, values in ((0, curve.x), (1, curve.y), *((1, end) for end in curve.ends))
        )
        colour, label = CATEGORIES[k % len(CATEGORIES)], escaped(short(curve.name, 34)) or None
        if ends:
            axes.fill_between(x_values, ends[0], ends[1], color=colour, alpha=0.2, lw=0)
        if curve.dots:
            axes.scatter(
                x_values, y_values, s=22 if has_groups else 16, marker=marker, color=colour, alpha=0.6, linewidths=0,
                label=label,
            )  # fmt: skip
            continue
        axes.plot(
            x_values,
            y_values,
            color=colour,
            ls=("-" if k < len(CATEGORIES) else (0, (4, 2))),
            lw=2,
            ms=4,
            marker="o" if 2 < len(x_values) < 40 else "",
            label=label,
        )
    axes.margins(y=0.12)
    axes.set(xscale="log" if scales[0] == "log" else "linear", yscale="log" if scales[1] == "log" else "linear")
    for axis, kind, band_limits in zip((axes.xaxis, axes.yaxis), scales, limits, strict=True):
        _set_scale(axis, kind, band_limits)
    if diagonal:
        low = max(axes.get_xlim()[0], axes.get_ylim()[0])
        high = min(axes.get_xlim()[1], axes.get_ylim()[1])
        if low < high:
            axes.plot([low, high], [low, high], color=GREY, ls=(0, (4, 3)), lw=1.3, scalex=False, scaley=False)
    if scales[0] == "linear" and all(np.array_equal(curve.x, curve.x.round()) for curve in curves):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set(xlabel=axis_label(x), ylabel=axis_label(y, 0.4))
    if any(curve.name for curve in curves):
        legend(axes, loc="best")
    return finish(figure)


@dataclass(frozen=True, eq=False)
class _Curve:
    name: str
    x: FloatArray
    y: FloatArray
    ends: Sequence[FloatArray]
    dots: bool
    group: int


def _scale_ends(kind: CurveScale, values: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the least and the greatest number that has a place on a scale.

    Raises:
        InputError: there is none, or shares beyond 0 to 1 on `probit`.
    """
    known = np.concatenate(values)
    known = known[np.isfinite(known)]
    if kind == "probit" and ((known < 0) | (known > 1)).any():
        raise InputError("A probit scale needs shares from 0 to 1.")
    if kind != "linear":
        known = known[(known > 0) & ((known < 1) | (kind == "log"))]
    if not len(known):
        if kind == "log":
            raise InputError("A logarithmic scale needs numbers above 0, and there are none.")
        return 0.01, 0.99
    low, high = float(known.min()), float(known.max())
    return (max(low, _LEAST_SHARE), min(max(high, low), 1 - _LEAST_SHARE)) if kind == "probit" else (low, high)


def _to_scale(values: FloatArray, kind: CurveScale, limits: tuple[float, float]) -> FloatArray:
    """Transform numbers to the axis scale: normal deviates on `probit`, NaN for non-positive numbers on `log`."""
    if kind == "probit":
        from scipy.special import ndtri

        low, high = ndtri(limits[0]) - _PROBIT_ROOM, ndtri(limits[1]) + _PROBIT_ROOM
        return np.clip(ndtri(np.clip(values, 0, 1)), low, high)
    return np.where(values > 0, values, np.nan) if kind == "log" else values


def _set_scale(axis: Axis, kind: CurveScale, limits: tuple[float, float]) -> None:
    """Give an axis its scale and ticks that people read."""
    if kind == "log":
        plain_decades(axis)
        if limits[1] >= 30 * limits[0]:
            axis.set_minor_formatter(lambda value, _: "")
    if kind == "probit":
        from scipy.special import ndtri

        low, high = float(ndtri(limits[0])) - _PROBIT_ROOM, float(ndtri(limits[1])) + _PROBIT_ROOM
        ticks = [share for share in _SHARES if low <= ndtri(share) <= high]
        # Their labels would overlap if the full range is shown.
        while len(ticks) > _MOST_TICKS:
            ticks = ticks[::2]
        axis.set_ticks(ndtri(ticks).tolist(), [f"{100 * share:.4g} %" for share in ticks])
        axis.set_view_interval(low - 0.02, high + 0.02, ignore=True)


def _numbers(values: npt.ArrayLike, name: str, *, ndim: int = 1, finite: bool = True) -> FloatArray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name[:1].upper()}{name[1:]} must be numbers.") from error
    if array.ndim != ndim or (finite and not np.isfinite(array).all()):
        raise InputError(
            f"{name[:1].upper()}{name[1:]} must be {'a list' if ndim == 1 else 'a table'} of finite numbers."
        )
    return array
