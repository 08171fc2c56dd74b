"""Figures of coefficients: scatter plots, and lines of expressions through the neutral face."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from shapespace.errors import InputError
from shapespace.report.figures.draw import (
    DPI,
    FEWEST_BINNED,
    GREY,
    INK,
    SMALL,
    WIDTH,
    chart,
    charts,
    counted,
    escaped,
    finish,
    legend,
    line_height,
    measured,
    short,
)
from shapespace.report.render.palette import CATEGORIES, MODEL_COLOUR
from shapespace.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
_MOST_IN_LEGEND = 16  # layout: entries
_MOST_DOTS_BIG = 60  # layout: dots drawn at full size
_LEGEND_MARK, _LEGEND_LINE = 3.6 * SMALL * DPI / 72, 1.1
_SPACE_INCHES = 2.5  # layout: inches per panel


@dataclass(frozen=True, eq=False)
class Coefficients:
    """The coefficients of one scan.

    Args:
        name: of the scan.
        expression: its label, which gives its colour; empty for none.
        intensity: 0 for neutral to 1, which gives its size.
        b: (K,) mm.
        z: (K,) in standard deviations of the model.
    """

    name: str
    expression: str
    intensity: float
    b: FloatArray
    z: FloatArray


def scatter_matrix(points: Sequence[Coefficients], modes: int = 4, *, title: str = "") -> Figure:
    """Draw the first coefficients against each other, one colour per label, with distributions on the diagonal.

    Args:
        points: the scans.
        modes: how many coefficients at most.
        title: above the figure.

    Raises:
        InputError: no scans, or scans with different numbers of coefficients.
    """
    b = _stack_coefficients(points)
    n_shown = min(modes, b.shape[1])
    heading = title or f"The first {counted(n_shown, 'coefficient')} of {counted(len(points), 'scan')}, in mm"
    if n_shown == 1:
        heading = title or f"The one coefficient of {counted(len(points), 'scan')}, in mm"
    groups = _groups(points)
    handles = _handles(groups)
    if n_shown == 1:
        figure, axes = chart(heading, height=2.8)
        _spread(axes, b[:, 0], groups)
        axes.set(xlabel="b1 (mm)", ylabel="scans")
        if handles:
            legend(axes, handles=handles, loc="upper right", handlelength=1.0)
        return finish(figure)
    side = 5.6 / n_shown
    figure, plots = charts(heading, [side] * n_shown, columns=n_shown)
    dots = _dot_size(len(points)) * (0.8 if n_shown > 3 else 1.0)
    limits = [_limits(b[:, k]) for k in range(n_shown)]
    for r in range(n_shown):
        for c in range(n_shown):
            axes = plots[r * n_shown + c]
            if c > r:
                axes.set_axis_off()
                continue
            if c == r:
                _spread(axes, b[:, c], groups)
                axes.set_yticks([])
            else:
                for _, marker_style, scores in groups:
                    axes.scatter(b[scores, c], b[scores, r], s=dots, **marker_style, edgecolors="white", linewidths=0.5)
                axes.set_ylim(*limits[r])
                axes.locator_params(axis="y", nbins=3)
            axes.set_xlim(*limits[c])
            axes.locator_params(axis="x", nbins=3)
            axes.tick_params(labelbottom=r == n_shown - 1, labelleft=c == 0 and r > 0)
            if r == n_shown - 1:
                axes.set_xlabel(f"b{c + 1}")
            if c == 0 and r > 0:
                axes.set_ylabel(f"b{r + 1}")
    finish(figure, w_pad=0.3, h_pad=0.3)
    if handles:
        figure.legend(
            handles=handles, loc="upper right", fontsize=SMALL, frameon=False, labelcolor=INK,
            handletextpad=0.2, ncols=1 if len(groups) < 9 else 2,
            bbox_to_anchor=(0.995, cast(Any, figure).plots_within[3]),
        )  # fmt: skip
    return figure


def b_plane(
    scans: Sequence[Coefficients],
    *,
    title: str = "",
    neutral: Coefficients | None = None,
) -> Figure:
    """Draw b1 against b2 (figure 9), one colour per expression, with larger markers for stronger expressions.

    Args:
        scans: expressive ones.
        title: above the figure.
        neutral: the neutral face, through which a line is drawn for each expression; None draws no lines.

    Raises:
        InputError: no scans, or fewer than two coefficients.
    """
    b = _stack_coefficients(scans)
    if b.shape[1] < 2:
        raise InputError("b1 against b2 needs two coefficients a scan, but there is only one.")
    figure, axes = chart(title or "Each expression runs along its own line: b1 and b2", height=4.4)
    groups = _groups(scans)
    for _, marker_style, scores in groups:
        group_scans = [scans[k] for k in scores]
        axes.scatter(
            b[scores, 0],
            b[scores, 1],
            s=_sizes(group_scans),
            **marker_style,
            edgecolors="white",
            linewidths=0.7,
            zorder=3,
        )
        line = _line(group_scans, neutral)
        if line is not None:
            axes.plot(line[:, 0], line[:, 1], color=marker_style["color"], lw=1.8, alpha=0.8, zorder=2)
    if neutral is not None:
        axes.plot(*neutral.b[:2], marker="+", ms=16, mew=2.6, color=INK, ls="", zorder=4)
    axes.set(xlabel="b1 (mm)", ylabel="b2 (mm)")
    axes.margins(0.1)
    handles = _handles(groups, neutral)
    if handles:
        legend(axes, handles=handles, loc="best", handlelength=1.0, ncols=1 if len(handles) < 9 else 2)
    return finish(figure)


def b_space(
    scans: Sequence[Coefficients],
    *,
    title: str = "",
    neutral: Coefficients | None = None,
) -> Figure:
    """Draw b1, b2 and b3 (figure 10) from two sides, as `b_plane` does.

    Raises:
        InputError: no scans, or fewer than three coefficients.
    """
    b = _stack_coefficients(scans)
    if b.shape[1] < 3:
        raise InputError(f"b1, b2 and b3 need three coefficients a scan, but there are only {b.shape[1]}.")
    coefficients = np.stack([scan.b[:3] for scan in (*scans, *([neutral] if neutral else []))])
    low, high = coefficients.min(axis=0), coefficients.max(axis=0)
    room = 0.06 * np.maximum(high - low, 1e-9 + 0.01 * float((high - low).max()))
    groups = _groups(scans)
    handles = _handles(groups, neutral)
    columns = _legend_columns([str(handle.get_label()) for handle in handles])
    lines = int(np.ceil(len(handles) / columns))
    # Panels are placed by hand, since matplotlib leaves half of a 3-D plot empty.
    foot_px = lines * _LEGEND_LINE * line_height(SMALL)
    of = f"of {counted(len(scans), 'scan')}" if neutral is None else "and the lines of the expressions"
    figure, plots = charts(
        title or f"The first three coefficients {of}, from two sides", [_SPACE_INCHES + foot_px / DPI]
    )
    figure.delaxes(plots[0])
    plot_box = cast(tuple[float, float, float, float], cast(Any, figure).plots_within)
    total = figure.get_figheight()
    foot = plot_box[1] + foot_px / DPI / total
    size = _dot_size(len(scans))
    for k, azimuth in enumerate((-62, 24)):
        # matplotlib's 3-D axes have no usable types.
        axes_box = (0.54 * k, foot + 0.06 / total, 0.44, plot_box[3] - foot + 0.5 / total)
        axes = cast(Any, figure.add_axes(axes_box, projection="3d"))
        for _, marker_style, scores in groups:
            group_scans = [scans[i] for i in scores]
            sizes = _sizes(group_scans) if neutral is not None or any(scan.intensity for scan in group_scans) else size
            axes.scatter(
                *b[scores, :3].T, s=sizes, **marker_style, edgecolors="white", linewidths=0.5, depthshade=False
            )
            line = _line(group_scans, neutral)
            if line is not None:
                axes.plot(*line[:, :3].T, color=marker_style["color"], lw=1.5, alpha=0.85)
            if len(scans) <= 2 * _MOST_DOTS_BIG:
                # Drop lines to the floor, without which a cloud of points has no depth.
                for point in b[scores, :3]:
                    axes.plot([point[0]] * 2, [point[1]] * 2, [low[2] - room[2], point[2]], color="#cfd1d5", lw=0.6)
        if neutral is not None:
            axes.plot(*neutral.b[:3, None], marker="+", ms=14, mew=2.4, color=INK, ls="")
        aside = _style_space(axes, low - room, high + room) / 72 * DPI / WIDTH
        axes.set_position((axes_box[0] + k * aside, axes_box[1], axes_box[2] - aside, axes_box[3]))
        axes.view_init(elev=20, azim=azimuth)
        axes.set_box_aspect((1, 1, 0.85), zoom=0.92)
    if handles:
        figure.legend(
            handles=handles, loc="lower center", ncols=columns, fontsize=SMALL, frameon=False,
            labelcolor=INK, handletextpad=0.2, columnspacing=1.2, bbox_to_anchor=(0.5, plot_box[1]), borderpad=0.1,
        )  # fmt: skip
    return figure


def _style_space(axes: Any, low: FloatArray, high: FloatArray) -> float:
    """Set names, end points (3,) and pale panes of a 3-D plot; return the extra width in points."""
    for axis, dimension in zip("xyz", range(3), strict=True):
        getattr(axes, f"set_{axis}label")(f"b{dimension + 1} (mm)", fontsize=SMALL, color=INK, labelpad=2)
        getattr(axes, f"set_{axis}lim")(low[dimension], high[dimension])
        getattr(axes, f"{axis}axis").set_pane_color((0.965, 0.967, 0.972, 1.0))
        axes.locator_params(axis=axis, nbins=4)
    axes.zaxis.set_rotate_label(False)
    axes.zaxis.label.set_rotation(90)
    axes.tick_params(labelsize=SMALL - 2, colors=GREY, pad=-1)
    # Of the three, only numbers beside an upright axis reach towards it, its label and the other panel.
    wider = _wider_than_three(axes.zaxis)
    axes.tick_params(axis="z", pad=wider / 2 - 1)
    axes.zaxis.labelpad = 2 + 0.6 * wider
    return wider


def _wider_than_three(axis: Any) -> float:
    """Return by how many points the widest number of an axis is wider than three digits."""
    formatter = axis.get_major_formatter()
    low, high = axis.get_view_interval()
    tick_labels = formatter.format_ticks([location for location in axis.get_majorticklocs() if low <= location <= high])
    widest = max((measured(text, SMALL - 2) for text in tick_labels), default=0.0)
    return max(0.0, widest - measured("000", SMALL - 2)) * 72 / DPI


def _legend_columns(names: Sequence[str]) -> int:
    """Return the number of columns that a legend below a figure needs so that no entry is cut."""
    for columns in range(min(len(names), 5), 1, -1):
        parts = np.array_split(np.array([measured(name, SMALL) for name in names]), columns)
        if sum(float(part.max()) + _LEGEND_MARK for part in parts) < WIDTH:
            return columns
    return 1


def _stack_coefficients(scans: Sequence[Coefficients]) -> FloatArray:
    """Return the coefficients of all scans, (n, K) mm."""
    if not scans:
        raise InputError("There is nothing to draw of coefficients without scans.")
    if len({scan.b.shape for scan in scans}) > 1:
        raise InputError("The scans have different numbers of coefficients, so they were fitted by different models.")
    return np.stack([scan.b for scan in scans])


def _groups(scans: Sequence[Coefficients]) -> list[tuple[str, dict[str, Any], list[int]]]:
    """Group scans by label, in the order of their first appearance, each with its own colour and mark."""
    names = list(dict.fromkeys(scan.expression for scan in scans))
    return [
        (
            name,
            {
                "color": CATEGORIES[k % len(CATEGORIES)] if name or len(names) > 1 else MODEL_COLOUR,
                "marker": _MARKERS[(k + k // len(CATEGORIES)) % len(_MARKERS)],
            },
            [i for i, scan in enumerate(scans) if scan.expression == name],
        )
        for k, name in enumerate(names)
    ]


def _handle(marker_style: Mapping[str, Any], name: str, **style: Any) -> Line2D:
    return Line2D([], [], ls="", ms=8, label=escaped(short(name, 22)), **{**marker_style, **style})


def _handles(
    groups: Sequence[tuple[str, dict[str, Any], list[int]]], neutral: Coefficients | None = None
) -> list[Line2D]:
    """Return the entries of a legend: the labels, where there are any, and the neutral face."""
    plus = [] if neutral is None else [_handle({"marker": "+", "color": INK}, "neutral", mew=2.6)]
    if not any(name for name, _, _ in groups):
        return plus
    labelled_groups = [(name or "no label", marker_style) for name, marker_style, _ in groups]
    out = [_handle(marker_style, name) for name, marker_style in labelled_groups[:_MOST_IN_LEGEND]]
    if len(labelled_groups) > _MOST_IN_LEGEND:
        out.append(Line2D([], [], ls="", label=f"and {len(labelled_groups) - _MOST_IN_LEGEND} more"))
    return out + plus


def _spread(axes: Axes, values: FloatArray, groups: Sequence[tuple[str, dict[str, Any], list[int]]]) -> None:
    """Draw the distribution of `values` (n,) per label; as dots if there are few."""
    if len(values) < FEWEST_BINNED:
        for _, marker_style, scores in groups:
            axes.plot(values[scores], np.full(len(scores), 0.5), ls="", ms=8, alpha=0.8, clip_on=False, **marker_style)
        axes.set_ylim(0, 1)
        return
    edges = np.linspace(*_limits(values), min(max(8, round(len(values) ** 0.5) + 4), 24))
    parts, colours = (
        [values[scores] for _, _, scores in groups],
        [marker_style["color"] for _, marker_style, _ in groups],
    )
    axes.hist(parts, edges.tolist(), stacked=True, color=colours)


def _limits(values: FloatArray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    room = 0.08 * (high - low) if high > low else max(0.1 * abs(high), 1.0)
    return low - room, high + room


def _dot_size(count: int) -> float:
    return float(np.clip(64 * (_MOST_DOTS_BIG / max(count, 1)) ** 0.5, 12, 64))


def _sizes(scans: Sequence[Coefficients]) -> FloatArray:
    return np.array([28.0 + 110.0 * float(np.clip(scan.intensity, 0, 1)) for scan in scans])


def _line(scans: Sequence[Coefficients], neutral: Coefficients | None) -> FloatArray | None:
    """Return two points (2, K), in mm, of the line through neutral that fits the scans best in units of sd."""
    if neutral is None or len(scans) < 2:
        return None
    v = np.stack([scan.z - neutral.z for scan in scans])
    direction = np.linalg.svd(v, full_matrices=False)[2][0]
    along = v @ direction
    if along.sum() < 0:
        direction, along = -direction, -along
    # Every scan of a model has b = z * sd, so their sizes give the sd of each mode.
    size_b, size_z = (np.abs(np.stack(rows)).sum(axis=0) for rows in ([s.b for s in scans], [s.z for s in scans]))
    stddev = np.divide(size_b, size_z, out=np.zeros_like(size_b), where=size_z > 0)
    end_positions = np.array([min(0.0, along.min()), 1.08 * max(0.0, along.max())])
    return neutral.b + end_positions[:, None] * (direction * stddev)
