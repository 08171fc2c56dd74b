"""Figures of large sets of fits: distributions, coefficients, and trends over time and site."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from shapespace.errors import InputError
from shapespace.report.figures.draw import (
    BACKWARD,
    DPI,
    FEWEST_BINNED,
    FORWARD,
    GREY,
    INK,
    LAYOUT,
    MARKERS,
    SMALL,
    WIDTH,
    chart,
    charts,
    counted,
    escaped,
    finish,
    legend,
    legend_above,
    legend_columns,
    line_height,
    measured,
    short,
    type_size,
)
from shapespace.report.inputs.saved_fits import Coefficients
from shapespace.report.render.palette import CATEGORIES, MODEL_COLOUR, SEQUENTIAL
from shapespace.types import FloatArray

_BINS, _TIMES = 60, 5  # layout: bins of a histogram, ticks of a time axis
_FEWEST = 20  # fits below which no quantiles are drawn
# percentiles of each band and its opacity, from the outside to the middle half
_BANDS = ((1, 99, 0.16), (5, 95, 0.3), (25, 75, 0.5))


def distributions_figure(values: Mapping[str, FloatArray], trusted: Any, *, title: str) -> Figure:
    """Draw histograms of measures, stacked by trusted and other fits.

    Args:
        values: (n,) values of each measure, by its name in words; values that are not finite are omitted.
        trusted: (n,) whether each fit is trusted.
        title: text above the figure.

    Raises:
        InputError: there is nothing to draw.
    """
    finite = {name: distances for name, distances in values.items() if np.isfinite(distances).any()}
    if not finite:
        raise InputError("There are no distances to draw.")
    figure, plots = charts(title, [2.1] * -(-len(finite) // 2), columns=2)
    for axes in plots[len(finite) :]:
        axes.set_axis_off()
    for axes, (name, distances) in zip(plots, finite.items(), strict=False):
        known = np.isfinite(distances)
        low, high = (
            float(distances[known].min()),
            float(
                min(
                    1.3
                    * np.quantile((distances[known & trusted] if (known & trusted).any() else distances[known]), 0.99),
                    distances[known].max(),
                )
            ),
        )
        low = 0.0 if low < 0.5 * high else low
        edges = np.linspace(low if high > low else high - 1.0, high, _BINS + 1)
        parts = [np.clip(distances[known & is_group], edges[0], edges[-1]) for is_group in (trusted, ~trusted)]
        if known.sum() < FEWEST_BINNED:
            for part, colour, label in zip(parts, (FORWARD, BACKWARD), ("converged", "others"), strict=True):
                axes.plot(part, np.full(len(part), 0.5), "o", color=colour, ms=8, alpha=0.8, clip_on=False, label=label)
            axes.set(ylim=(0, 1), yticks=[])
        else:
            axes.hist(parts, edges.tolist(), stacked=True, color=[FORWARD, BACKWARD], label=["converged", "others"])
            axes.set_ylabel("fits")
        axes.set(xlabel=_wrap_label(name), xlim=(edges[0], edges[-1]))
        middle = float(np.median(distances[known & trusted])) if (known & trusted).any() else np.nan
        if np.isfinite(middle):
            axes.axvline(middle, color=INK, lw=1.2, ls="--")
            axes.annotate(
                f"median {middle:.3g}", (middle, 0.97), xycoords=("data", "axes fraction"),
                xytext=(4 if middle < (low + high) / 2 else -4, 0), textcoords="offset points",
                fontsize=type_size(SMALL), va="top", ha="left" if middle < (low + high) / 2 else "right", color=INK,
            )  # fmt: skip
    legend(plots[0], loc="center right")
    return finish(figure)


def _wrap_label(name: str, max_length: int = 28) -> str:
    return escaped("\n".join(textwrap.wrap(name, max_length)))


def coefficients_spread(z: npt.NDArray[np.floating[Any]], *, title: str) -> Figure:
    """Draw the percentiles of each coefficient (n, K) over all fits, in standard deviations of the model.

    Raises:
        InputError: there are no coefficients.
    """
    z = z[np.isfinite(z).all(axis=1)] if z.size else z
    if not z.size:
        raise InputError("There are no coefficients to draw.")
    figure, axes = chart(title, height=3.4)
    numbers = np.arange(1, z.shape[1] + 1, dtype=np.float64)
    for low, high, strength in _BANDS:
        percentiles = np.array([np.percentile(values, [low, high]) for values in z.T]).T
        axes.fill_between(
            numbers,
            percentiles[0],
            percentiles[1],
            step="mid",
            color=FORWARD,
            alpha=strength,
            lw=0,
            label=f"{low} to {high} %",
        )
    axes.step(numbers, np.array([np.median(values) for values in z.T]), where="mid", color=INK, lw=1.4, label="median")
    for value in (-1.645, 1.645):
        axes.axhline(value, color=GREY, lw=1, ls="--", label="5 and 95 % of the model" if value > 0 else None)
    axes.set(xlabel="coefficient", ylabel="z", xlim=(0.5, z.shape[1] + 0.5))
    legend_above(axes, 0.4, loc="upper right", ncols=3)
    return finish(figure)


def density_figure(z: npt.NDArray[np.floating[Any]], distances: FloatArray, *, title: str) -> Figure:
    """Draw the density of fits in the first coefficients, and of their distance from the mean.

    Args:
        z: (n, K) coefficients of the fits, in standard deviations.
        distances: (n,) root mean square of the coefficients of each fit.
        title: title of the figure.

    Raises:
        InputError: fewer than two coefficients.
    """
    known = np.isfinite(z).all(axis=1) if z.size else np.zeros(0, dtype=bool)
    if z.shape[1] < 2 or not known.any():
        raise InputError("There are fewer than two coefficients to draw.")
    z, distances = z[known], distances[known]
    pairs = [(0, 1), (0, 2) if z.shape[1] > 2 else None]
    figure, plots = charts(title, [2.6], columns=3)
    for axes, pair in zip(plots, pairs, strict=False):
        if pair is None:
            axes.set_axis_off()
            continue
        first, second = (z[:, k] for k in pair)
        limits = [max(3.2, 1.1 * float(np.quantile(np.abs(values), 0.9995))) for values in (first, second)]
        counts, x, y = np.histogram2d(first, second, 90, [[-limits[0], limits[0]], [-limits[1], limits[1]]])
        axes.pcolormesh(
            x,
            y,
            np.ma.masked_equal(counts.T, 0),
            cmap=ListedColormap(SEQUENTIAL),
            norm=LogNorm(1, max(2.0, float(counts.max()))),
            rasterized=True,
        )
        turn = np.linspace(0, 2 * np.pi, 200)
        axes.plot(3 * np.cos(turn), 3 * np.sin(turn), color=GREY, lw=1, ls="--")
        axes.set(xlabel=f"z{pair[0] + 1}", ylabel=f"z{pair[1] + 1}")
    axes = plots[2]
    axes.hist(distances, np.linspace(0, float(distances.max()) * 1.02 + 1e-9, _BINS + 1).tolist(), color=FORWARD)
    axes.set(yscale="log", xlabel="RMS of all z", ylabel="fits")
    return finish(figure, w_pad=1.0)


def over_time_figure(
    times: FloatArray, edges: FloatArray, measures: Mapping[str, FloatArray], untrusted: Any, *, is_time: bool,
    name: str, title: str, lines: Sequence[tuple[str, Any]] = (),
) -> Figure:  # fmt: skip
    """Draw medians and the middle 90 % of measures along a time or a number, and the share of fits not trusted.

    Args:
        times: (n,) numbers, or seconds since 1970.
        edges: edges of the intervals of `times`, each drawn as one point.
        measures: (n,) values of each measure, by its name in words.
        untrusted: (n,) whether a fit is not trusted.
        is_time: whether `times` are times.
        name: name of the time or number.
        title: text above the figure.
        lines: name and (n,) membership of each group of fits with a line of its own in the first plot.

    Raises:
        InputError: there is nothing to draw.
    """
    finite = {key: values for key, values in measures.items() if np.isfinite(values).any()}
    known = np.isfinite(times)
    if not finite or not known.any():
        raise InputError(f"{name}: there is nothing to draw.")
    places = np.where(known, np.clip(np.searchsorted(edges, times, side="right") - 1, 0, len(edges) - 2), -1)
    middles = (edges[1:] + edges[:-1]) / 2
    figure, plots = charts(title, [1.75] * (len(finite) + 1), columns=1)
    for number, (axes, (words, values)) in enumerate(zip(plots, finite.items(), strict=False)):
        quantiles = _quantiles(places, values, len(middles))
        axes.fill_between(middles, quantiles[0], quantiles[2], color=FORWARD, alpha=0.22, lw=0, label="middle 90 %")
        axes.plot(middles, quantiles[1], color=INK, lw=1.8, label="median of all")
        if number == 0:
            for k, (line_name, inside) in enumerate(lines):
                axes.plot(
                    middles,
                    _quantiles(np.where(inside, places, -1), values, len(middles))[1],
                    color=CATEGORIES[k % len(CATEGORIES)],
                    lw=1.3,
                    label=escaped(short(line_name, 18)),
                )
            legend_above(axes, 0.3, loc="upper left", ncols=4)
        axes.set_ylabel(_wrap_label(words, 16))
    axes = plots[len(finite)]
    axes.bar(
        middles,
        [100 * float(untrusted[places == k].mean()) if (places == k).any() else np.nan for k in range(len(middles))],
        width=0.9 * (edges[1] - edges[0]),
        color=BACKWARD,
    )
    axes.set(xlabel=escaped(short(name, 60)), ylabel="not trusted (%)")
    for axes in plots:
        axes.set_xlim(edges[0], edges[-1])
        if is_time:
            _name_times(axes, edges[0], edges[-1])
    return finish(figure)


def _quantiles(places: Any, values: FloatArray, count: int) -> FloatArray:
    """Return (3, count) the 5 %, 50 % and 95 % quantiles of the values at each place; NaN for too few values."""
    out = np.full((3, count), np.nan)
    known = (places >= 0) & np.isfinite(values)
    order = np.argsort(places[known], kind="stable")
    sorted_values = values[known][order]
    bounds = np.searchsorted(places[known][order], np.arange(count + 1))
    for k in range(count):
        inside = sorted_values[bounds[k] : bounds[k + 1]]
        if len(inside) >= _FEWEST:
            out[:, k] = np.quantile(inside, (0.05, 0.5, 0.95))
    return out


def _name_times(axes: Axes, first: float, last: float) -> None:
    ticks = np.linspace(first, last, _TIMES)
    is_long = last - first > 5 * 365 * 86400
    axes.set_xticks(
        ticks, [datetime.fromtimestamp(tick, UTC).strftime("%Y-%m" if is_long else "%Y-%m-%d") for tick in ticks]
    )
    for label, side in zip(axes.get_xticklabels(), ("left", *["center"] * (_TIMES - 2), "right"), strict=True):
        label.set_horizontalalignment(cast(Any, side))


def levels_figure(groups: Sequence[tuple[str, Any]], values: FloatArray, *, words: str, title: str) -> Figure:
    """Draw the median and the middle 50 and 90 % of a measure for each of some groups of fits.

    Args:
        groups: name and (n,) membership of each group.
        values: (n,) values of the measure.
        words: name and unit of the measure.
        title: text above the figure.

    Raises:
        InputError: there is nothing to draw.
    """
    known = np.isfinite(values)
    parts = [(name, values[inside & known]) for name, inside in groups]
    parts = [(name, level_values) for name, level_values in parts if len(level_values)]
    if not parts:
        raise InputError(f"{title}: there is nothing to draw.")
    figure, axes = chart(title, height=0.9 + 0.27 * len(parts))
    for k, (_, level_values) in enumerate(parts):
        low, quarter, middle, upper_quarter, high = np.quantile(level_values, (0.05, 0.25, 0.5, 0.75, 0.95))
        axes.plot([low, high], [k, k], color=FORWARD, lw=1.5, alpha=0.5)
        axes.plot([quarter, upper_quarter], [k, k], color=FORWARD, lw=6, alpha=0.6, solid_capstyle="butt")
        axes.plot([middle], [k], "o", color=INK, ms=5)
    axes.axvline(float(np.median(values[known])), color=GREY, lw=1, ls="--")
    axes.set_yticks(range(len(parts)), [f"{escaped(short(name, 24))} ({counted(len(m), 'fit')})" for name, m in parts])
    axes.set(xlabel=words, ylim=(len(parts) - 0.5, -0.5))
    return finish(figure)


_MOST_IN_LEGEND = 16  # layout: entries
_MOST_DOTS_BIG = 60  # layout: dots drawn at full size
_LEGEND_LINE = 1.1
_SPACE_INCHES = 2.5  # layout: inches per panel


def scatter_matrix(points: Sequence[Coefficients], modes: int = 4, *, title: str = "") -> Figure:
    """Draw the first coefficients against each other, one colour per label, with distributions on the diagonal.

    Args:
        points: the scans.
        modes: how many coefficients at most.
        title: text above the figure.

    Raises:
        InputError: no scans, or scans with different numbers of coefficients.
    """
    b = _stack_coefficients(points)
    n_shown = min(modes, b.shape[1])
    which = f"first {n_shown} coefficients" if n_shown > 1 else "one coefficient"
    heading = title or f"The {which} of {counted(len(points), 'scan')}, in mm"
    groups = _groups(points)
    handles = _handles(groups)
    if n_shown == 1:
        figure, axes = chart(heading, height=2.8)
        _draw_distribution(axes, b[:, 0], groups)
        axes.set(xlabel="b1 (mm)", ylabel="scans")
        if handles:
            legend(axes, handles=handles, loc="upper right", handlelength=1.0)
        return finish(figure)
    figure, plots = charts(heading, [(5.6 / n_shown)] * n_shown, columns=n_shown)
    dots = _dot_size(len(points)) * (0.8 if n_shown > 3 else 1.0)
    limits = [_limits(b[:, k]) for k in range(n_shown)]
    for r in range(n_shown):
        for c in range(n_shown):
            axes = plots[r * n_shown + c]
            if c > r:
                axes.set_axis_off()
                continue
            if c == r:
                _draw_distribution(axes, b[:, c], groups)
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
            handles=handles, loc="upper right", fontsize=type_size(SMALL), frameon=False, labelcolor=INK,
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
        scans: scans of expressions.
        title: text above the figure.
        neutral: the neutral face, through which a line is drawn for each expression; None draws no lines.

    Raises:
        InputError: no scans, or fewer than two coefficients.
    """
    b = _stack_coefficients(scans)
    if b.shape[1] < 2:
        raise InputError("b1 against b2 needs two coefficients per scan, but there is only one.")
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
    """Draw b1, b2 and b3 (figure 10) from two sides, with the arguments and markers of `b_plane`.

    Raises:
        InputError: no scans, or fewer than three coefficients.
    """
    b = _stack_coefficients(scans)
    if b.shape[1] < 3:
        raise InputError(f"b1, b2 and b3 need three coefficients per scan, but there are only {b.shape[1]}.")
    coefficients = np.stack([scan.b[:3] for scan in (*scans, *([neutral] if neutral else []))])
    low, high = coefficients.min(axis=0), coefficients.max(axis=0)
    room = 0.06 * np.maximum(high - low, 1e-9 + 0.01 * float((high - low).max()))
    groups = _groups(scans)
    handles = _handles(groups, neutral)
    columns = legend_columns([str(handle.get_label()) for handle in handles])
    # Panels are placed by hand, since matplotlib leaves half of a 3-D plot empty.
    foot_px = int(np.ceil(len(handles) / columns)) * _LEGEND_LINE * line_height(type_size(SMALL))
    layout = LAYOUT.get()
    inches = _SPACE_INCHES * layout.row_width / WIDTH + foot_px / DPI
    of = f"of {counted(len(scans), 'scan')}" if neutral is None else "and the lines of the expressions"
    figure, plots = charts(
        title or f"The first three coefficients {of}, from two sides", [inches / layout.scale], columns=2
    )
    for plot in plots:
        figure.delaxes(plot)
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
            axes.scatter(
                *b[scores, :3].T,
                s=(_sizes(group_scans) if neutral is not None or any(scan.intensity for scan in group_scans) else size),
                **marker_style,
                edgecolors="white",
                linewidths=0.5,
                depthshade=False,
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
        aside = _style_space(axes, low - room, high + room) / 72 * DPI / layout.row_width
        axes.set_position((axes_box[0] + k * aside, axes_box[1], axes_box[2] - aside, axes_box[3]))
        axes.view_init(elev=20, azim=azimuth)
        axes.set_box_aspect((1, 1, 0.85), zoom=0.92)
    if handles:
        figure.legend(
            handles=handles, loc="lower center", ncols=columns, fontsize=type_size(SMALL), frameon=False,
            labelcolor=INK, handletextpad=0.2, columnspacing=1.2, bbox_to_anchor=(0.5, plot_box[1]), borderpad=0.1,
        )  # fmt: skip
    return figure


def _style_space(axes: Any, low: FloatArray, high: FloatArray) -> float:
    """Set names, end points (3,) and pale panes of a 3-D plot; return the extra width in points."""
    for axis, dimension in zip("xyz", range(3), strict=True):
        getattr(axes, f"set_{axis}label")(f"b{dimension + 1} (mm)", fontsize=type_size(SMALL), color=INK, labelpad=2)
        getattr(axes, f"set_{axis}lim")(low[dimension], high[dimension])
        getattr(axes, f"{axis}axis").set_pane_color((0.965, 0.967, 0.972, 1.0))
        axes.locator_params(axis=axis, nbins=4)
    axes.zaxis.set_rotate_label(False)
    axes.zaxis.label.set_rotation(90)
    axes.tick_params(labelsize=type_size(SMALL - 2), colors=GREY, pad=-1)
    # Of the three, only the numbers of an upright axis reach towards it, its label and the other panel.
    wider = _wider_than_three(axes.zaxis)
    axes.tick_params(axis="z", pad=wider / 2 - 1)
    axes.zaxis.labelpad = 2 + 0.6 * wider
    return wider


def _wider_than_three(axis: Any) -> float:
    """Return by how many points the widest number of an axis is wider than three digits."""
    formatter = axis.get_major_formatter()
    low, high = axis.get_view_interval()
    tick_labels = formatter.format_ticks([location for location in axis.get_majorticklocs() if low <= location <= high])
    return (
        max(
            0.0,
            max((measured(text, type_size(SMALL - 2)) for text in tick_labels), default=0.0)
            - measured("000", type_size(SMALL - 2)),
        )
        * 72
        / DPI
    )


def _stack_coefficients(scans: Sequence[Coefficients]) -> FloatArray:
    """Return the coefficients of all scans, (n, K) mm."""
    if not scans:
        raise InputError("There are no scans, so there are no coefficients to draw.")
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
                "marker": MARKERS[(k + k // len(CATEGORIES)) % len(MARKERS)],
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
    """Return the entries of a legend: the labels, if there are any, and the neutral face."""
    plus = [] if neutral is None else [_handle({"marker": "+", "color": INK}, "neutral", mew=2.6)]
    if not any(name for name, _, _ in groups):
        return plus
    labelled_groups = [(name or "no label", marker_style) for name, marker_style, _ in groups]
    out = [_handle(marker_style, name) for name, marker_style in labelled_groups[:_MOST_IN_LEGEND]]
    if len(labelled_groups) > _MOST_IN_LEGEND:
        out.append(Line2D([], [], ls="", label=f"and {len(labelled_groups) - _MOST_IN_LEGEND} more"))
    return out + plus


def _draw_distribution(axes: Axes, values: FloatArray, groups: Sequence[tuple[str, dict[str, Any], list[int]]]) -> None:
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
    return neutral.b + np.array([min(0.0, along.min()), 1.08 * max(0.0, along.max())])[:, None] * (
        direction * np.divide(size_b, size_z, out=np.zeros_like(size_b), where=size_z > 0)
    )
