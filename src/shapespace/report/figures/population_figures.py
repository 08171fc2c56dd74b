"""Figures of large sets of fits: distributions, coefficients, and trends over time and site."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure

from shapespace.errors import InputError
from shapespace.report.figures.draw import (
    BACKWARD,
    FEWEST_BINNED,
    FORWARD,
    GREY,
    INK,
    SMALL,
    chart,
    charts,
    counted,
    escaped,
    finish,
    legend,
    short,
)
from shapespace.report.render.palette import CATEGORIES, SEQUENTIAL
from shapespace.types import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BINS, _TIMES = 60, 5  # layout: bins of a histogram, ticks of a time axis
_FEWEST = 20  # fits below which no quantiles are drawn
# percentiles of each band and its opacity, from the outside to the middle half
_BANDS = ((1, 99, 0.16), (5, 95, 0.3), (25, 75, 0.5))


def distributions_figure(values: Mapping[str, FloatArray], trusted: Any, *, title: str) -> Figure:
    """Draw histograms of measures, stacked by trusted and other fits.

    Args:
        values: in words -> (n,); those that are not finite are left out.
        trusted: (n,) whether a fit is.
        title: above the figure.

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
        usual = distances[known & trusted] if (known & trusted).any() else distances[known]
        low, high = float(distances[known].min()), float(min(1.3 * np.quantile(usual, 0.99), distances[known].max()))
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
        axes.set_xlabel(_wrapped(name))
        axes.set_xlim(edges[0], edges[-1])
        middle = float(np.median(distances[known & trusted])) if (known & trusted).any() else np.nan
        if np.isfinite(middle):
            axes.axvline(middle, color=INK, lw=1.2, ls="--")
            axes.annotate(
                f"median {middle:.3g}", (middle, 0.97), xycoords=("data", "axes fraction"),
                xytext=(4 if middle < (low + high) / 2 else -4, 0), textcoords="offset points", fontsize=SMALL,
                va="top", ha="left" if middle < (low + high) / 2 else "right", color=INK,
            )  # fmt: skip
    legend(plots[0], loc="center right")
    return finish(figure)


def _wrapped(name: str, max_length: int = 28) -> str:
    import textwrap

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
    legend(axes, loc="upper right", ncols=3)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.4 * (high - low))
    return finish(figure)


def density_figure(z: npt.NDArray[np.floating[Any]], distances: FloatArray, *, title: str) -> Figure:
    """Draw the density of fits in the first coefficients, and of their distance from the mean.

    Args:
        z: (n, K) in standard deviations.
        distances: (n,) their root mean square.
        title: above the figure.

    Raises:
        InputError: fewer than two coefficients.
    """
    known = np.isfinite(z).all(axis=1) if z.size else np.zeros(0, dtype=bool)
    if z.shape[1] < 2 or not known.any():
        raise InputError("There are fewer than two coefficients to draw.")
    z, distances = z[known], distances[known]
    pairs = [(0, 1), (0, 2) if z.shape[1] > 2 else None]
    figure, plots = charts(title, [2.6], columns=3)
    colours = ListedColormap(SEQUENTIAL)
    for axes, pair in zip(plots, pairs, strict=False):
        if pair is None:
            axes.set_axis_off()
            continue
        first, second = (z[:, k] for k in pair)
        limits = [max(3.2, 1.1 * float(np.quantile(np.abs(values), 0.9995))) for values in (first, second)]
        counts, x, y = np.histogram2d(first, second, 90, [[-limits[0], limits[0]], [-limits[1], limits[1]]])
        masked_counts = np.ma.masked_equal(counts.T, 0)
        axes.pcolormesh(
            x, y, masked_counts, cmap=colours, norm=LogNorm(1, max(2.0, float(counts.max()))), rasterized=True
        )
        turn = np.linspace(0, 2 * np.pi, 200)
        axes.plot(3 * np.cos(turn), 3 * np.sin(turn), color=GREY, lw=1, ls="--")
        axes.set(xlabel=f"z{pair[0] + 1}", ylabel=f"z{pair[1] + 1}")
    axes = plots[2]
    axes.hist(distances, np.linspace(0, float(distances.max()) * 1.02 + 1e-9, _BINS + 1).tolist(), color=FORWARD)
    axes.set_yscale("log")
    axes.set(xlabel="RMS of all z", ylabel="fits")
    return finish(figure, w_pad=1.0)


def over_time_figure(
    times: FloatArray, edges: FloatArray, measures: Mapping[str, FloatArray], untrusted: Any, *, is_time: bool,
    name: str, title: str, lines: Sequence[tuple[str, Any]] = (),
) -> Figure:  # fmt: skip
    """Draw medians and the middle 90 % of measures along a time or a number, and the share of fits not trusted.

    Args:
        times: (n,) numbers, or seconds since 1970.
        edges: of the stretches that they are drawn by.
        measures: in words -> (n,).
        untrusted: (n,) whether a fit is not trusted.
        is_time: whether `times` are times.
        name: of what they are.
        title: above the figure.
        lines: groups of fits, each with its name and which they are, drawn as a line each on the first measure.

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
                group_quantiles = _quantiles(np.where(inside, places, -1), values, len(middles))[1]
                colour = CATEGORIES[k % len(CATEGORIES)]
                axes.plot(middles, group_quantiles, color=colour, lw=1.3, label=escaped(short(line_name, 18)))
            legend(axes, loc="upper left", ncols=4)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.3 * (high - low))
        axes.set_ylabel(_wrapped(words, 16))
    axes = plots[len(finite)]
    share = [100 * float(untrusted[places == k].mean()) if (places == k).any() else np.nan for k in range(len(middles))]
    axes.bar(middles, share, width=0.9 * (edges[1] - edges[0]), color=BACKWARD)
    axes.set_ylabel("not trusted (%)")
    axes.set_xlabel(escaped(short(name, 60)))
    for axes in plots:
        axes.set_xlim(edges[0], edges[-1])
        if is_time:
            _name_times(axes, edges[0], edges[-1])
    return finish(figure)


def _quantiles(places: Any, values: FloatArray, count: int) -> FloatArray:
    """Return (3, count) the 5 %, 50 % and 95 % quantiles of the values at each place; not-a-number of too few."""
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
    tick_names = [datetime.fromtimestamp(tick, UTC).strftime("%Y-%m" if is_long else "%Y-%m-%d") for tick in ticks]
    axes.set_xticks(ticks, tick_names)
    for label, side in zip(axes.get_xticklabels(), ("left", *["center"] * (_TIMES - 2), "right"), strict=True):
        label.set_horizontalalignment(cast(Any, side))


def levels_figure(groups: Sequence[tuple[str, Any]], values: FloatArray, *, words: str, title: str) -> Figure:
    """Draw the median and the middle 50 and 90 % of a measure for each of some groups of fits.

    Args:
        groups: name and which fits (n,) are in it.
        values: (n,).
        words: what they are.
        title: above the figure.

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
    axes.set_ylim(len(parts) - 0.5, -0.5)
    axes.set_xlabel(words)
    return finish(figure)
