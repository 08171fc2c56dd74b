"""Figures of many fits: which of them to look at first, how close they are, and how their coefficients lie."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from shapespace.errors import InputError
from shapespace.report.colours import (
    CATEGORIES,
    CLAY,
    MODEL_COLOUR,
    SCAN_COLOUR,
    SEQUENTIAL,
    UNKNOWN_COLOUR,
    Colour,
    as_hex,
)
from shapespace.report.figures.draw import (
    DPI,
    GREY,
    INK,
    NOT_SHOWN,
    SMALL,
    TEXT,
    WIDTH,
    Row,
    Scale,
    absolute,
    chart,
    charts,
    counted,
    distance_scale,
    escaped,
    finish,
    grid,
    in_rows,
    legend,
    line_height,
    mean_mm,
    mean_words,
    measured,
    mm,
    plain,
    scan_over,
    short,
    surroundings,
    unknown,
    view,
)
from shapespace.report.render import Camera, Image, Layer, distance_layer, render, render_series
from shapespace.report.staged import StagedFit, nice_ceiling, scale_end
from shapespace.types import FloatArray, Mesh

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STATUS_COLOURS: Mapping[str, Colour] = {
    "failed": (0.72, 0.11, 0.11),
    "unreadable": (0.72, 0.11, 0.11),
    "doubtful": (0.90, 0.55, 0.05),
    "max_iterations": (0.45, 0.45, 0.75),
}
_STATUS_WORDS = {
    "failed": "failed",
    "unreadable": "cannot be read",
    "doubtful": "doubtful",
    "max_iterations": "stopped at the limit",
}
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
_MOST_IN_LEGEND = 16
_MOST_DOTS_BIG = 60
_NO_PICTURE = 0.945
_LEGEND_MARK, _LEGEND_LINE = 3.6 * SMALL * DPI / 72, 1.1
_SPACE_INCHES = 2.5


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


@dataclass(frozen=True, eq=False)
class Entry:
    """A fit in the gallery, of which a picture may be missing.

    Args:
        label: what to call it.
        status: `converged`, `max_iterations`, `doubtful`, `failed` or `unreadable`.
        reason: one sentence on why.
        mean_mm: mean distance from the model to the scan; not-a-number where it is not known.
        fit: with its surfaces, where they were saved.
        scan: the scan, where only that is there.
    """

    label: str
    status: str
    reason: str = ""
    mean_mm: float = float("nan")
    fit: StagedFit | None = None
    scan: Mesh | None = None

    @staticmethod
    def of(fit: StagedFit) -> Entry:
        """Return the entry of a fit with its surfaces."""
        return Entry(fit.label, fit.status, fit.reason, mean_mm(fit), fit)


def worst_first(entries: Sequence[Entry]) -> list[Entry]:
    """Return `entries` with those that failed first, then the doubtful, then the others by falling distance."""
    order = {"failed": 0, "unreadable": 0, "doubtful": 1}
    return sorted(
        entries, key=lambda e: (order.get(e.status, 2), -e.mean_mm if np.isfinite(e.mean_mm) else float("inf"))
    )


def gallery(fits: Sequence[StagedFit | Entry], *, columns: int = 3, most: int = 24, title: str = "") -> Figure:
    """Draw scan and model over each other for many fits: failed ones first, then doubtful ones, then the worst.

    Args:
        fits: the fits; an `Entry` where a fit failed or kept no surface.
        columns: pictures in a row.
        most: pictures in all.
        title: above the figure.

    Raises:
        InputError: no fit is given.
    """
    entries = worst_first([fit if isinstance(fit, Entry) else Entry.of(fit) for fit in fits])
    shown = entries[: max(most, 1)]
    if not shown:
        raise InputError("There is nothing to draw in a gallery without fits.")
    framed = [_points(entry) for entry in shown]
    wide = [view(points, columns).size for points in framed if points is not None]
    width = (WIDTH - (columns - 1) * 8) // columns
    size = (width, int(np.median([height for _, height in wide]))) if wide else (width, width)
    panels = [_gallery_panel(entry, points, size, columns) for entry, points in zip(shown, framed, strict=True)]
    rows = [
        Row(
            [panels[k] for k in at],
            [short(shown[k].label, 40) for k in at],
            notes=[_verdict(shown[k]) for k in at],
            frames=[STATUS_COLOURS.get(shown[k].status) for k in at],
        )
        for at in in_rows(range(len(shown)), columns)
    ]
    counts = {word: sum(entry.status == key for entry in entries) for key, word in _STATUS_WORDS.items()}
    told = ", ".join(f"{number} {word}" for word, number in counts.items() if number)
    left = len(entries) - len(shown)
    return grid(
        rows,
        title=title or f"{counted(len(entries), 'fit')}, the worst first: {told or 'none is in doubt'}",
        keys=[("scan", SCAN_COLOUR), ("model", MODEL_COLOUR)],
        note=mean_words([entry.fit for entry in shown if entry.fit is not None])
        + (f" {counted(left, 'more fit')} with smaller distances not shown." if left else ""),
    )


def _points(entry: Entry) -> FloatArray | None:
    if entry.fit is not None:
        return surroundings(entry.fit)
    return entry.scan.vertices if entry.scan is not None and len(entry.scan.vertices) else None


def _gallery_panel(entry: Entry, points: FloatArray | None, size: tuple[int, int], columns: int) -> Image:
    if points is None:
        return _empty_panel(size)
    camera = Camera.framing(points, yaw_deg=15.0, aspect=size[0] / size[1], margin=0.04)
    if entry.fit is None:
        return render(cast(Mesh, entry.scan), camera=camera, size=size, colour=SCAN_COLOUR)
    layers = [scan_over(entry.fit.scan), Layer(entry.fit.surfaces["final"], MODEL_COLOUR)]
    return render_series([layers], camera=camera, size=size)[0]


def _empty_panel(size: tuple[int, int]) -> Image:
    """Return a grey field with a cross of thin lines, where there is nothing to show."""
    image = np.full((size[1], size[0], 3), round(255 * _NO_PICTURE), dtype=np.uint8)
    x, y = np.meshgrid(np.linspace(0, 1, size[0]), np.linspace(0, 1, size[1]))
    image[(np.abs(x - y) < 0.004) | (np.abs(x + y - 1) < 0.004)] = 214
    return image


def _verdict(entry: Entry) -> str:
    word = _STATUS_WORDS.get(entry.status)
    far = f"mean {mm(entry.mean_mm)}" if np.isfinite(entry.mean_mm) else ""
    if word is None:
        return far or entry.status
    return plain(f"{word}{': ' + entry.reason if entry.reason else ''}")


def error_curves(
    fits: Sequence[StagedFit] | Mapping[str, FloatArray], *, stage: str = "final", title: str = "", unit: str = "mm"
) -> Figure:
    """Draw cumulative curves: which share of the points lies within each distance.

    Args:
        fits: fits, for a thin curve each and a thick one of all together, over the vertices that their scans show; or
            errors (n,) by name, for one named curve each.
        stage: of the fits.
        title: above the figure.
        unit: of errors given by name.

    Raises:
        InputError: there is nothing to draw, or a fit lacks the stage.
    """
    if isinstance(fits, Mapping):
        return _named_curves(fits, title, unit)
    if not fits:
        raise InputError("There is nothing to draw of cumulative errors without fits.")
    if any(stage not in fit.surfaces for fit in fits):
        raise InputError(f"Not every fit has the stage {stage!r}, so their errors cannot be compared there.")
    far = [np.sort(absolute(fit.model_to_scan_mm[stage])) for fit in fits]
    fits = [fit for fit, values in zip(fits, far, strict=True) if len(values)]
    far = [values for values in far if len(values)]
    if not far:
        return _nothing_shown(title)
    pooled = np.sort(np.concatenate(far))
    figure, axes = chart(
        title or f"How close the model comes to the scan, over {counted(len(fits), 'fit')}", height=3.5
    )
    thin = {"lw": 1.1, "alpha": float(np.clip(12 / len(fits), 0.12, 0.8))}
    seen: set[str] = set()
    for fit, values in sorted(zip(fits, far, strict=True), key=lambda pair: pair[0].status != "converged"):
        doubtful = fit.status in ("doubtful", "failed")
        name = "a doubtful fit" if doubtful else "a fit"
        colour = as_hex(STATUS_COLOURS["doubtful"]) if doubtful else "#7fa8c9"
        _curve(axes, values, color=colour, label=None if name in seen else name, **thin)
        seen.add(name)
    if len(fits) > 1:
        _curve(axes, pooled, color=INK, lw=2.6, label="all together")
    for share in (0.5, 0.95):
        at = float(np.quantile(pooled, share))
        axes.plot([at], [100 * share], "o", color=INK, ms=6, zorder=5)
        axes.annotate(
            f"{100 * share:.0f} % within {mm(at)}", (at, 100 * share), xytext=(10, -5), textcoords="offset points",
            fontsize=SMALL, color=INK, va="top",
        )  # fmt: skip
    axes.set(xlabel="distance from the model to the scan (mm)", ylabel="vertices that the scan shows (%)")
    axes.set(xlim=(0, nice_ceiling(1.15 * float(np.quantile(pooled, 0.985)))), ylim=(0, 102))
    legend(axes, loc="lower right")
    return finish(figure)


def _nothing_shown(title: str) -> Figure:
    figure, axes = chart(title or "How close the model comes to the scan", height=1.2)
    axes.text(
        0.5, 0.5, "No vertex of a model is shown by its scan.", transform=axes.transAxes, ha="center", va="center",
        fontsize=TEXT, color=GREY,
    )  # fmt: skip
    axes.set_axis_off()
    return finish(figure)


def _named_curves(tables: Mapping[str, FloatArray], title: str, unit: str) -> Figure:
    usable = {name: np.sort(absolute(np.asarray(values, dtype=np.float64))) for name, values in tables.items()}
    usable = {name: values for name, values in usable.items() if len(values)}
    if not usable:
        raise InputError("There is nothing to draw of cumulative errors without numbers.")
    figure, axes = chart(title or "Which share lies within each distance", height=3.5)
    for k, (name, values) in enumerate(usable.items()):
        dashes = "-" if k < len(CATEGORIES) else (0, (4, 2))
        label = f"{short(name, 30)}: median {mm(float(np.median(values)))}" if unit == "mm" else short(name, 30)
        _curve(axes, values, color=CATEGORIES[k % len(CATEGORIES)], ls=dashes, lw=2, label=escaped(label))
    far = max(float(np.quantile(values, 0.98)) for values in usable.values())
    axes.set(xlabel=f"distance ({unit})", ylabel="share (%)", xlim=(0, nice_ceiling(1.05 * far)), ylim=(0, 102))
    legend(axes, loc="lower right")
    return finish(figure)


def _curve(axes: Any, values: FloatArray, **style: Any) -> None:
    """Draw the share of sorted `values` up to each of them, in at most 400 steps."""
    share = np.linspace(0, 1, min(len(values), 400) + 1)
    at = np.quantile(values, share, method="inverted_cdf") if len(values) > 400 else np.concatenate([[0.0], values])
    axes.plot(
        np.concatenate([at, [10 * values[-1] + 1]]),
        100 * np.concatenate([share, [1.0]]),
        drawstyle="steps-post",
        **style,
    )


def scatter_matrix(points: Sequence[Coefficients], modes: int = 4, *, title: str = "") -> Figure:
    """Draw the first coefficients against each other, one colour a label, with their spread on the diagonal.

    Args:
        points: the scans.
        modes: how many coefficients at most.
        title: above the figure.

    Raises:
        InputError: no scans, or scans with different numbers of coefficients.
    """
    b = _stacked(points)
    shown = min(modes, b.shape[1])
    heading = title or f"The first {counted(shown, 'coefficient')} of {counted(len(points), 'scan')}, in mm"
    if shown == 1:
        heading = title or f"The one coefficient of {counted(len(points), 'scan')}, in mm"
    groups = _groups(points)
    if shown == 1:
        figure, axes = chart(heading, height=2.8)
        _spread(axes, b[:, 0], groups)
        axes.set(xlabel="b1 (mm)", ylabel="scans")
        if any(name for name, _, _ in groups):
            legend(axes, handles=_handles(groups), loc="upper right", handlelength=1.0)
        return finish(figure)
    side = 5.6 / shown
    figure, plots = charts(heading, [side] * shown, columns=shown)
    dots = _dot_size(len(points)) * (0.8 if shown > 3 else 1.0)
    limits = [_limits(b[:, k]) for k in range(shown)]
    for r in range(shown):
        for c in range(shown):
            axes = plots[r * shown + c]
            if c > r:
                axes.set_axis_off()
                continue
            if c == r:
                _spread(axes, b[:, c], groups)
                axes.set_yticks([])
            else:
                for _, look, at in groups:
                    axes.scatter(b[at, c], b[at, r], s=dots, **look, edgecolors="white", linewidths=0.5)
                axes.set_ylim(*limits[r])
                axes.locator_params(axis="y", nbins=3)
            axes.set_xlim(*limits[c])
            axes.locator_params(axis="x", nbins=3)
            axes.tick_params(labelbottom=r == shown - 1, labelleft=c == 0 and r > 0)
            if r == shown - 1:
                axes.set_xlabel(f"b{c + 1}")
            if c == 0 and r > 0:
                axes.set_ylabel(f"b{r + 1}")
    finish(figure, w_pad=0.3, h_pad=0.3)
    if any(name for name, _, _ in groups):
        figure.legend(
            handles=_handles(groups), loc="upper right", fontsize=SMALL, frameon=False, labelcolor=INK,
            handletextpad=0.2, ncols=1 if len(groups) < 9 else 2,
            bbox_to_anchor=(0.995, cast(Any, figure).plots_within[3]),
        )  # fmt: skip
    return figure


def scatter_3d(points: Sequence[Coefficients], *, title: str = "") -> Figure:
    """Draw b1, b2 and b3 from two sides, one colour a label.

    Raises:
        InputError: no scans, or fewer than three coefficients.
    """
    return _space(
        points, title or f"The first three coefficients of {counted(len(points), 'scan')}, from two sides", None, None
    )


def b_plane(
    scans: Sequence[Coefficients],
    *,
    title: str = "",
    neutral_b: FloatArray | None = None,
    neutral_z: FloatArray | None = None,
) -> Figure:
    """Draw b1 against b2 (figure 9), one colour an expression, larger for stronger, with lines through neutral.

    Raises:
        InputError: no scans, or fewer than two coefficients.
    """
    b = _stacked(scans)
    if b.shape[1] < 2:
        raise InputError("b1 against b2 needs two coefficients a scan, but there is only one.")
    figure, axes = chart(title or "Each expression runs along its own line: b1 and b2", height=4.4)
    groups = _groups(scans)
    for _, look, at in groups:
        own = [scans[k] for k in at]
        axes.scatter(b[at, 0], b[at, 1], s=_sizes(own), **look, edgecolors="white", linewidths=0.7, zorder=3)
        line = _line(own, neutral_b, neutral_z)
        if line is not None:
            axes.plot(line[:, 0], line[:, 1], color=look["color"], lw=1.8, alpha=0.8, zorder=2)
    if neutral_b is not None:
        axes.plot(neutral_b[0], neutral_b[1], marker="+", ms=16, mew=2.6, color=INK, ls="", zorder=4)
    axes.set(xlabel="b1 (mm)", ylabel="b2 (mm)")
    axes.margins(0.1)
    handles = _handles(groups) if any(name for name, _, _ in groups) else []
    if neutral_b is not None:
        handles.append(_handle({"marker": "+", "color": INK}, "neutral", mew=2.6))
    if handles:
        legend(axes, handles=handles, loc="best", handlelength=1.0, ncols=1 if len(handles) < 9 else 2)
    return finish(figure)


def b_space(
    scans: Sequence[Coefficients],
    *,
    title: str = "",
    neutral_b: FloatArray | None = None,
    neutral_z: FloatArray | None = None,
) -> Figure:
    """Draw b1, b2 and b3 (figure 10) from two sides, as `b_plane` does.

    Raises:
        InputError: no scans, or fewer than three coefficients.
    """
    return _space(scans, title or "The lines of the expressions in b1, b2 and b3, from two sides", neutral_b, neutral_z)


def _space(
    scans: Sequence[Coefficients], title: str, neutral_b: FloatArray | None, neutral_z: FloatArray | None
) -> Figure:
    b = _stacked(scans)
    if b.shape[1] < 3:
        raise InputError(f"b1, b2 and b3 need three coefficients a scan, but there are only {b.shape[1]}.")
    every = b[:, :3] if neutral_b is None else np.concatenate([b[:, :3], neutral_b[None, :3]])
    low, high = every.min(axis=0), every.max(axis=0)
    room = 0.06 * np.maximum(high - low, 1e-9 + 0.01 * float((high - low).max()))
    groups = _groups(scans)
    handles = _handles(groups) if any(name for name, _, _ in groups) else []
    if neutral_b is not None:
        handles.append(_handle({"marker": "+", "color": INK}, "neutral", mew=2.4))
    columns = _legend_columns([str(handle.get_label()) for handle in handles])
    lines = int(np.ceil(len(handles) / columns))
    # Panels are placed by hand, since matplotlib leaves half of a 3-D plot empty.
    foot_px = lines * _LEGEND_LINE * line_height(SMALL)
    figure, plots = charts(title, [_SPACE_INCHES + foot_px / DPI])
    figure.delaxes(plots[0])
    within = cast(tuple[float, float, float, float], cast(Any, figure).plots_within)
    total = figure.get_figheight()
    foot = within[1] + foot_px / DPI / total
    size = _dot_size(len(scans))
    for k, azimuth in enumerate((-62, 24)):
        # matplotlib's 3-D axes have no usable types.
        place = (0.54 * k, foot + 0.06 / total, 0.44, within[3] - foot + 0.5 / total)
        axes = cast(Any, figure.add_axes(place, projection="3d"))
        for _, look, at in groups:
            own = [scans[i] for i in at]
            sizes = _sizes(own) if neutral_b is not None or any(scan.intensity for scan in own) else size
            axes.scatter(*b[at, :3].T, s=sizes, **look, edgecolors="white", linewidths=0.5, depthshade=False)
            line = _line(own, neutral_b, neutral_z)
            if line is not None:
                axes.plot(*line[:, :3].T, color=look["color"], lw=1.5, alpha=0.85)
            if len(scans) <= 2 * _MOST_DOTS_BIG:
                # Drop lines to the floor, without which a cloud of points has no depth.
                for point in b[at, :3]:
                    axes.plot([point[0]] * 2, [point[1]] * 2, [low[2] - room[2], point[2]], color="#cfd1d5", lw=0.6)
        if neutral_b is not None:
            axes.plot(*neutral_b[:3, None], marker="+", ms=14, mew=2.4, color=INK, ls="")
        for axis, at in zip("xyz", range(3), strict=True):
            getattr(axes, f"set_{axis}label")(f"b{at + 1} (mm)", fontsize=SMALL, color=INK, labelpad=2)
            getattr(axes, f"set_{axis}lim")(low[at] - room[at], high[at] + room[at])
            getattr(axes, f"{axis}axis").set_pane_color((0.965, 0.967, 0.972, 1.0))
            axes.locator_params(axis=axis, nbins=4)
        axes.zaxis.set_rotate_label(False)
        axes.zaxis.label.set_rotation(90)
        axes.tick_params(labelsize=SMALL - 2, colors=GREY, pad=-1)
        # Of the three, only numbers beside an upright axis reach towards it, its label and the other panel.
        wider = _wider_than_three(axes.zaxis)
        axes.tick_params(axis="z", pad=wider / 2 - 1)
        axes.zaxis.labelpad = 2 + 0.6 * wider
        aside = wider / 72 * DPI / WIDTH
        axes.set_position((place[0] + k * aside, place[1], place[2] - aside, place[3]))
        axes.view_init(elev=20, azim=azimuth)
        axes.set_box_aspect((1, 1, 0.85), zoom=0.92)
    if handles:
        figure.legend(
            handles=handles, loc="lower center", ncols=columns, fontsize=SMALL, frameon=False,
            labelcolor=INK, handletextpad=0.2, columnspacing=1.2, bbox_to_anchor=(0.5, within[1]), borderpad=0.1,
        )  # fmt: skip
    return figure


def _wider_than_three(axis: Any) -> float:
    """Return by how many points the widest number of an axis is wider than three digits."""
    formatter = axis.get_major_formatter()
    low, high = axis.get_view_interval()
    told = formatter.format_ticks([at for at in axis.get_majorticklocs() if low <= at <= high])
    widest = max((measured(text, SMALL - 2) for text in told), default=0.0)
    return max(0.0, widest - measured("000", SMALL - 2)) * 72 / DPI


def _legend_columns(names: Sequence[str]) -> int:
    """Return into how many columns the entries of a legend below a figure go, so that none is cut."""
    for columns in range(min(len(names), 5), 1, -1):
        parts = np.array_split(np.array([measured(name, SMALL) for name in names]), columns)
        if sum(float(part.max()) + _LEGEND_MARK for part in parts) < WIDTH:
            return columns
    return 1


def faces_grid(
    meshes: Sequence[Mesh], labels: Sequence[str], *, title: str, columns: int = 4, colour: Colour = CLAY
) -> Figure:
    """Draw `meshes` in one light and at one scale, each under its label (figures 1 and 8).

    Raises:
        InputError: no meshes, or another number of labels.
    """
    if not meshes or len(meshes) != len(labels):
        raise InputError(f"{title}: {len(meshes)} meshes do not go with {len(labels)} labels.")
    columns = min(columns, max(len(meshes), 3))
    seen = view(np.concatenate([m.vertices for m in meshes]), columns)
    images = [render(mesh, camera=seen.camera, size=seen.size, colour=colour) for mesh in meshes]
    return grid(
        [Row(i, t) for i, t in zip(in_rows(images, columns), in_rows(list(labels), columns), strict=True)], title=title
    )


def portrait_figure(
    fits: Sequence[StagedFit], labels: Sequence[str] = (), *, title: str = "Raw scans and the models fitted to them",
    yaw_deg: float = 25.0,
) -> Figure:  # fmt: skip
    """Draw for each fit: the scan, the model fitted to it, both together, and how far the model lies from the scan.

    Raises:
        InputError: no fit is given.
    """
    if not fits:
        raise InputError(f"{plain(title)}: there is no fit to draw.")
    top = scale_end(np.concatenate([f.model_to_scan_mm["final"] for f in fits]))
    # One scale for all rows: where one has no sign, none is shown.
    signed = all(fit.scan.faces is not None for fit in fits)
    rows: list[Row] = []
    for k, fit in enumerate(fits):
        seen = view(surroundings(fit), 4, yaw_deg=yaw_deg)
        final, far = fit.surfaces["final"], fit.model_to_scan_mm["final"]
        scan, over, model = Layer(fit.scan, SCAN_COLOUR), scan_over(fit.scan), Layer(final, MODEL_COLOUR)
        mapped = distance_layer(final, far, top, signed=signed)
        panels = render_series([[scan], [model], [over, model], [mapped]], camera=seen.camera, size=seen.size)
        captions = ["scan", "model, fitted", "both", "distance"] if k == 0 else []
        name = short(labels[k] if labels else fit.label, 60)
        rows.append(Row(panels, captions, f"{name}: mean {mm(mean_mm(fit))}"))
    return grid(
        rows,
        title=title,
        scale=distance_scale(top, signed=signed) if signed else _unsigned(fits, top),
        keys=_grey(fits),
        note=mean_words(fits),
    )


def aligned_grid(
    fits: Sequence[StagedFit], *, title: str = "Scan and fitted model over each other", columns: int = 4
) -> Figure:
    """Draw scan and fitted model over each other for many fits, in the order given."""
    images, _ = _equal_views(
        fits, columns, lambda fit: [scan_over(fit.scan), Layer(fit.surfaces["final"], MODEL_COLOUR)]
    )
    return grid(
        _captioned(images, fits, columns),
        title=title,
        keys=[("scan", SCAN_COLOUR), ("model", MODEL_COLOUR)],
        note=mean_words(fits),
    )


def distance_maps(
    fits: Sequence[StagedFit], *, title: str = "Distance from each fitted model to its scan", columns: int = 4
) -> Figure:
    """Draw the distance from each fitted model to its scan, on one scale up to the 99th percentile of all."""
    if not fits:
        raise InputError(f"{plain(title)}: there is no fit to draw.")
    known = np.concatenate([absolute(f.model_to_scan_mm["final"]) for f in fits])
    top = nice_ceiling(float(np.percentile(known, 99)) if len(known) else 1.0)
    images, _ = _equal_views(
        fits,
        columns,
        lambda fit: [
            Layer(fit.surfaces["final"], scalars=np.abs(fit.model_to_scan_mm["final"]), colormap=SEQUENTIAL, vmax=top)
        ],
    )
    return grid(
        _captioned(images, fits, columns),
        title=title,
        scale=_unsigned(fits, top),
        keys=_grey(fits),
        note=mean_words(fits),
    )


def _unsigned(fits: Sequence[StagedFit], top: float) -> Scale:
    if all(fit.scan.faces is None for fit in fits):
        return distance_scale(top, signed=False)
    return Scale("distance from the model to the scan (mm)", SEQUENTIAL, 0.0, top, "high")


def _grey(fits: Sequence[StagedFit]) -> list[tuple[str, Colour]]:
    """Return the key of what the maps of some of these fits leave grey."""
    return [(NOT_SHOWN, UNKNOWN_COLOUR)] if any(unknown(fit.model_to_scan_mm["final"]) for fit in fits) else []


def _equal_views(
    fits: Sequence[StagedFit], columns: int, layers: Callable[[StagedFit], list[Layer]]
) -> tuple[list[Image], tuple[int, int]]:
    """Return one picture a fit, each from its own front, all of one size."""
    if not fits:
        raise InputError("There is nothing to draw without fits.")
    columns = min(columns, max(len(fits), 3))
    views = [view(fit.surfaces["final"].vertices, columns, margin=0.07) for fit in fits]
    size = (views[0].size[0], int(np.median([seen.size[1] for seen in views])))
    images = [
        render_series(
            [layers(fit)],
            camera=Camera.framing(fit.surfaces["final"].vertices, aspect=size[0] / size[1], margin=0.07),
            size=size,
        )[0]
        for fit in fits
    ]
    return images, size


def _captioned(images: Sequence[Image], fits: Sequence[StagedFit], columns: int) -> list[Row]:
    columns = min(columns, max(len(fits), 3))
    names = [f"{short(f.label, 30)}\n{mm(mean_mm(f))}" for f in fits]
    return [Row(i, t) for i, t in zip(in_rows(images, columns), in_rows(names, columns), strict=True)]


def _stacked(scans: Sequence[Coefficients]) -> FloatArray:
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


def _handle(look: Mapping[str, Any], name: str, **style: Any) -> Line2D:
    return Line2D([], [], ls="", ms=8, label=escaped(short(name, 22)), **{**look, **style})


def _handles(groups: Sequence[tuple[str, dict[str, Any], list[int]]]) -> list[Line2D]:
    named = [(name or "no label", look) for name, look, _ in groups]
    out = [_handle(look, name) for name, look in named[:_MOST_IN_LEGEND]]
    if len(named) > _MOST_IN_LEGEND:
        out.append(Line2D([], [], ls="", label=f"and {len(named) - _MOST_IN_LEGEND} more"))
    return out


def _spread(axes: Axes, values: FloatArray, groups: Sequence[tuple[str, dict[str, Any], list[int]]]) -> None:
    """Draw how `values` (n,) are spread, the labels on top of each other."""
    edges = np.linspace(*_limits(values), min(max(8, round(len(values) ** 0.5) + 4), 24))
    parts, colours = [values[at] for _, _, at in groups], [look["color"] for _, look, _ in groups]
    axes.hist(parts, edges.tolist(), stacked=True, color=colours)


def _limits(values: FloatArray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    room = 0.08 * (high - low) if high > low else max(0.1 * abs(high), 1.0)
    return low - room, high + room


def _dot_size(count: int) -> float:
    return float(np.clip(64 * (_MOST_DOTS_BIG / max(count, 1)) ** 0.5, 12, 64))


def _sizes(scans: Sequence[Coefficients]) -> FloatArray:
    return np.array([28.0 + 110.0 * float(np.clip(scan.intensity, 0, 1)) for scan in scans])


def _line(
    scans: Sequence[Coefficients], neutral_b: FloatArray | None, neutral_z: FloatArray | None
) -> FloatArray | None:
    """Return two points (2, K), in mm, of the line through neutral that fits the scans best in units of sd."""
    if neutral_b is None or neutral_z is None or len(scans) < 2:
        return None
    v = np.stack([scan.z - neutral_z for scan in scans])
    direction = np.linalg.svd(v, full_matrices=False)[2][0]
    along = v @ direction
    if along.sum() < 0:
        direction, along = -direction, -along
    # Every scan of a model has b = z * sd, so their sizes give the sd of each mode.
    size_b, size_z = (np.abs(np.stack(rows)).sum(axis=0) for rows in ([s.b for s in scans], [s.z for s in scans]))
    stddev = np.divide(size_b, size_z, out=np.zeros_like(size_b), where=size_z > 0)
    ends = np.array([min(0.0, along.min()), 1.08 * max(0.0, along.max())])
    return neutral_b + ends[:, None] * (direction * stddev)
