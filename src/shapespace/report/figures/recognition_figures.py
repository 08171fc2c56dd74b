"""Figures of classification: confusion matrix, calibration, learning curve, and curves of any two measures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from shapespace.errors import InputError
from shapespace.report.figures.draw import (
    BARS,
    DPI,
    FORWARD,
    GREY,
    INK,
    SMALL,
    WIDTH,
    axis_label,
    chart,
    charts,
    counted,
    escaped,
    finish,
    legend,
    measured,
    percent,
    plain,
    plain_decades,
    short,
)
from shapespace.report.render.palette import CATEGORIES, SEQUENTIAL, oklab
from shapespace.types import FloatArray

CurveScale: TypeAlias = Literal["linear", "log", "probit"]
"""How the numbers of a curve stand along an axis."""

_MOST_CLASSES_IN_FULL, _MOST_CLASSES = 12, 40  # classes with numbers, and without: legible at the figure's size
_MARKERS = "os^Dvp"  # of groups, so that print without colour can be read
_MOST_SERIES, _MOST_TICKS = 60, 9  # curves and tick labels: legible at the figure's size
_LEAST_SHARE, _PROBIT_ROOM = 1e-6, 0.12  # ends of a probit axis, which cannot show 0, and its margin in probits
_SHARES = (
    1e-6, 1e-5, 1e-4, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995,
    0.998, 0.999, 1 - 1e-4,
)  # fmt: skip


def confusion_figure(counts: npt.ArrayLike, classes: Sequence[str], *, title: str = "") -> Figure:
    """Draw a confusion matrix: a row a true class, in percent of its samples, with their number.

    Right answers lie in the framed cells of the diagonal; a cell without samples stays empty.

    Args:
        counts: (C, C) how many samples of the row's class were predicted to be of the column's class.
        classes: C names.
        title: above the figure; by default the accuracy.

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
    longest = max(measured(text, SMALL) for text in columns)
    wide = (WIDTH - max(measured(text, SMALL) for text in rows) - 60) / n
    high = max(min(wide, 78.0), 280 / n)
    upright = longest > 0.94 * wide
    figure, axes = chart(
        title or _confused(table, shares, classes), height=(n * high + (longest if upright else 20) + 60) / DPI
    )
    axes.imshow(shares, cmap=ListedColormap(SEQUENTIAL), vmin=0, vmax=1, aspect="auto", interpolation="nearest")
    for k in range(1, n):
        axes.axhline(k - 0.5, color="white", lw=1.5)
        axes.axvline(k - 0.5, color="white", lw=1.5)
    for r in range(n):
        across, up = 1 - 5 / wide, 1 - 5 / high
        axes.add_patch(Rectangle((r - across / 2, r - up / 2), across, up, fill=False, ec=INK, lw=1.8, zorder=4))
        if per_class[r] == 0:
            axes.text((n - 1) / 2, r, "none", ha="center", va="center", fontsize=SMALL, color=GREY)
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


def _confused(table: FloatArray, shares: FloatArray, classes: Sequence[str]) -> str:
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
            column, row - 0.14, percent(share), ha="center", va="center", fontsize=SMALL, color=ink, weight=weight
        )
        axes.text(column, row + 0.25, f"{count:g}", ha="center", va="center", fontsize=SMALL - 2, color=ink)
    else:
        axes.text(column, row, f"{100 * share:.0f}", ha="center", va="center", fontsize=SMALL - 3, color=ink)


def calibration_figure(
    bins: npt.ArrayLike, *, ece: float | None = None, brier: float | None = None, title: str = ""
) -> Figure:
    """Draw a reliability diagram: the share of right answers against the stated probability, and the number of answers.

    Args:
        bins: (n, 5), for each bin of probabilities: its two ends, the mean stated probability, the share of right
            answers (all 0 to 1), and the number of answers. Bins without answers are left out.
        ece: expected calibration error, 0 to 1, where it was measured.
        brier: Brier score, where it was measured.
        title: above the figure; by default the calibration error.

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
        raise InputError("What is stated and what is right in a calibration must lie within 0 to 1.")
    headline = "How often answers are right, against the probability stated for them"
    if ece is not None:
        headline = f"Stated probabilities are off by {100 * ece:.1f} points on average"
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
        low: (n,) lower end of its interval, where it is known,
        high: (n,) and upper end.
        band: what the interval is.
        ceiling: upper bound of the accuracy, where it is known.
        title: above the figure; by default the first and last accuracy.

    Raises:
        InputError: lists that are empty or of different lengths.
    """
    x = _numbers(subjects, "the numbers of subjects of a learning curve")
    y = 100 * _numbers(mean, "the accuracies of a learning curve")
    if not len(x) or x.shape != y.shape:
        raise InputError(f"A learning curve of {len(x)} numbers of subjects cannot have {len(y)} accuracies.")
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    headline = f"{y[0]:.1f} % right with {counted(round(x[0]), 'subject')} to learn from"
    if len(x) > 1:
        headline = (
            f"Learning from {x[-1]:g} subjects instead of {x[0]:g} takes the share of right answers from "
            f"{y[0]:.1f} % "
            f"to {y[-1]:.1f} %"
        )
    figure, axes = chart(title or headline, height=3.3)
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
        series: for each line its name, empty for none, its (n,) places and its (n,) values.
        x: what the places are, with their unit,
        y: and the values.
        title: above the figure; by default y against x.
        bands: for each series the lower and the upper ends (n,) of a band around it, not-a-number where there is none;
            None for none.
        dots: for each series whether it is dots without a line.
        scales: of places and values; on `probit` shares stand at their normal deviates, and those of 0 and 1 at the
            edge. What is not positive has no place on `log`.
        diagonal: draw where both are the same.
        groups: for each series the number of its group, which chooses colour and marker; None for its own number.

    Raises:
        InputError: no series or too many, one whose lists are empty or of different lengths, or numbers that have no
            place on their scale.
    """
    if not 1 <= len(series) <= _MOST_SERIES:
        raise InputError(f"A figure has 1 to {_MOST_SERIES} curves, not {len(series)}.")
    curves: list[_Curve] = []
    for k, (name, places, values) in enumerate(series):
        x_values = _numbers(places, f"the places of the curve {short(name)}")
        y_values = _numbers(values, f"the values of the curve {short(name)}")
        if not len(x_values) or x_values.shape != y_values.shape:
            raise InputError(f"The curve {short(name)!r} has {len(x_values)} places but {len(y_values)} values.")
        band = bands[k] if k < len(bands) else None
        ends = [_numbers(end, f"the band of the curve {short(name)}", finite=False) for end in band or ()]
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
    square = diagonal and scales[0] == scales[1]
    figure, axes = chart(
        title or f"{plain(y)[:1].upper()}{plain(y)[1:]} against {plain(x)}", height=4.6 if square else 3.3
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
        dashes = "-" if k < len(CATEGORIES) else (0, (4, 2))
        axes.plot(
            x_values,
            y_values,
            color=colour,
            ls=dashes,
            lw=2,
            ms=4,
            marker="o" if 2 < len(x_values) < 40 else "",
            label=label,
        )
    axes.margins(y=0.12)
    axes.set(xscale="log" if scales[0] == "log" else "linear", yscale="log" if scales[1] == "log" else "linear")
    for axis, kind, band_limits in zip((axes.xaxis, axes.yaxis), scales, limits, strict=True):
        _scaled(axis, kind, band_limits)
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
        raise InputError("On a probit scale stand shares from 0 to 1.")
    if kind != "linear":
        known = known[(known > 0) & ((known < 1) | (kind == "log"))]
    if not len(known):
        if kind == "log":
            raise InputError("On a logarithmic scale stand numbers above 0, and there are none.")
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


def _scaled(axis: Axis, kind: CurveScale, limits: tuple[float, float]) -> None:
    """Give an axis its scale and ticks that people read."""
    if kind == "log":
        plain_decades(axis)
        if limits[1] >= 30 * limits[0]:
            axis.set_minor_formatter(lambda value, _: "")
    if kind == "probit":
        from scipy.special import ndtri

        low, high = float(ndtri(limits[0])) - _PROBIT_ROOM, float(ndtri(limits[1])) + _PROBIT_ROOM
        ticks = [share for share in _SHARES if low <= ndtri(share) <= high]
        # Their words would touch where the whole range is shown.
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
