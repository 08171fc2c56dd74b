"""Figures of one fit: stages, signed distances, convergence, and coefficients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from shapespace.errors import InputError
from shapespace.fit.iteration_state import REGIONS
from shapespace.report.figures.draw import (
    BACKWARD,
    FORWARD,
    GREY,
    INK,
    NOT_SHOWN,
    SMALL,
    STAGE_WORDS,
    TEXT,
    Row,
    Scale,
    chart,
    charts,
    counted,
    distance_scale,
    empty_chart,
    equal_views,
    finish,
    grid,
    in_rows,
    legend,
    mean_words,
    mm,
    number_axis,
    percent,
    plain,
    plain_decades,
    scan_over,
    short,
    surroundings,
    type_size,
    unknown,
    view,
)
from shapespace.report.inputs.saved_fits import StagedFit, mean_mm, measured_mm, nice_ceiling, scale_end
from shapespace.report.render.palette import (
    BEYOND_COLOUR,
    CLAY,
    DENSE_COLOUR,
    MODEL_COLOUR,
    REGION_COLOURS,
    SCAN_COLOUR,
    SEQUENTIAL,
    UNKNOWN_COLOUR,
    WITHIN_COLOUR,
    Colour,
    as_hex,
)
from shapespace.report.render.renderer import Camera, Layer, distance_layer, render, render_series
from shapespace.types import FloatArray, Mesh

THRESHOLDS_MM = (2.0, 4.0, 6.0, 8.0, 10.0)
"""The limits of the paper's figure 11."""

_SHORT_STAGES = {"before": "before", "initial": "phase 1", "final": "phase 2", "dense": "dense"}
_SIDES = (("from the right", -38.0), ("from the front", 0.0), ("from the left", 38.0))
_FRONT_AND_SIDE = (0.0, 48.0)  # degrees of yaw
_REGION_WORDS = {
    "followed": "followed",
    "rejected": "rejected: the scan shows something else",
    "border": "at the scan's border",
    "unseen": NOT_SHOWN,
}
_MOST_MODES = 30  # layout: bars
_NEAR_START = 0.35  # share of the extent within which the start fits into the picture of the result
_TOWERS = 2.0
"""Times its neighbour, and percent, beyond which the first bar of a histogram needs a word."""
_NEAREST_MM, _FARTHEST_MM = 0.01, 300.0  # mm, limits of a logarithmic axis
_TEXT_ROOM = 1.42
"""Height of half a histogram relative to its tallest bar, with room for the line of text above it."""


def stages_figure(fit: StagedFit, *, title: str = "") -> Figure:
    """Draw the scan, then the model before the fit, after phase 1, after phase 2, and after the dense stage if present.

    A notebook makes the fit out of a result:

        result = ss.fit_scan(model, scan)
        figures.stages_figure(StagedFit.of(model, result))
    """
    layers = [
        [Layer(fit.scan, SCAN_COLOUR)],
        *([layer] for layer in [Layer(mesh, _colour(stage)) for stage, mesh in fit.surfaces.items()]),
    ]
    dense = ", and taken the rest of the way" if "dense" in fit.surfaces else ""
    return grid(
        _from_two_sides(fit, layers, ["scan", *_stage_captions(fit)]),
        title=title
        or f"{short(fit.label)}: the scan, and the model before, after finding pose and after finding shape{dense}",
        note=mean_words([fit]),
    )


def overlay_figure(fit: StagedFit, *, title: str = "") -> Figure:
    """Draw scan and model superimposed at each stage, from two sides (the paper's figures 4 to 7)."""
    scan = scan_over(fit.scan)
    layers = [[scan, Layer(mesh, _colour(stage))] for stage, mesh in fit.surfaces.items()]
    keys: list[tuple[str, Colour]] = [("scan", SCAN_COLOUR), ("model", MODEL_COLOUR)]
    if "dense" in fit.surfaces:
        keys.append(("dense surface", DENSE_COLOUR))
    return grid(
        _from_two_sides(fit, layers, _stage_captions(fit)),
        title=title or f"{short(fit.label)}: scan and model over each other, the nearer one is seen",
        keys=keys,
        note=f"{mean_words([fit])} Where both mix finely, the fit is close.",
    )


def signed_maps(fit: StagedFit, stage: str = "final", *, limit_mm: float | None = None, title: str = "") -> Figure:
    """Draw the distances from the model to the scan and from the scan to the model; signed if the scan has faces.

        result = ss.fit_scan(model, scan)
        figures.signed_maps(StagedFit.of(model, result))

    Args:
        fit: fit with the stage.
        stage: `before`, `initial`, `final` or `dense`.
        limit_mm: end of the colour scale, mm; None for a limit that contains nearly all distances.
        title: text above the figure.

    Raises:
        InputError: the fit has no such stage, or the limit is not positive.
    """
    surface = _surface(fit, stage)
    forward, backward = fit.model_to_scan_mm[stage], fit.scan_to_model_mm[stage]
    if limit_mm is None:
        limit_mm = fit.scale_mm if stage == "final" else scale_end(np.concatenate([forward, backward]))
    if not limit_mm > 0:
        raise InputError(f"The limit of a scale must be positive, not {limit_mm!r} mm.")
    signed = fit.scan.faces is not None
    on_model, on_scan = (
        distance_layer(mesh, values, limit_mm, signed=signed)
        for mesh, values in ((surface, forward), (fit.scan, backward))
    )
    cameras, size = equal_views([(surroundings(fit), yaw) for _, yaw in _SIDES], len(_SIDES))
    panels = [[render(layer, camera=camera, size=size) for camera in cameras] for layer in (on_model, on_scan)]
    unseen, uncovered = unknown(forward), unknown(backward)
    keys: list[tuple[str, Colour]] = []
    if unseen:
        keys.append((f"on the model: {NOT_SHOWN} ({percent(unseen)})", UNKNOWN_COLOUR))
    if uncovered:
        keys.append((f"on the scan: beyond the model's rim, not counted ({percent(uncovered)})", UNKNOWN_COLOUR))
    rows = [
        Row(panels[0], [side for side, _ in _SIDES], f"From the model to the scan: {_summary(forward)}"),
        Row(panels[1], [], f"From the scan to the model: {_summary(backward)}"),
    ]
    surface_name = "the dense surface" if stage == "dense" else f"the model {STAGE_WORDS.get(stage, stage)}"
    if stage == "final":
        surface_name = "the fitted model"
    return grid(
        rows,
        title=title
        or f"{short(fit.label)}: how far scan and {surface_name.removeprefix('the ')} lie from each other, both ways",
        scale=distance_scale(limit_mm, signed=signed),
        keys=keys,
    )


def threshold_figure(fits: StagedFit | Sequence[StagedFit], *, title: str = "") -> Figure:
    """Draw where the model lies within 2, 4, 6, 8 and 10 mm of the scan (the paper's figure 11), one row per fit.

    Raises:
        InputError: no fit is given.
    """
    all_fits = [fits] if isinstance(fits, StagedFit) else list(fits)
    table = np.array([WITHIN_COLOUR, BEYOND_COLOUR])
    rows: list[Row] = []
    for fit in all_fits:
        distances = np.abs(fit.model_to_scan_mm["final"])
        camera_view = view(fit.surfaces["final"].vertices, len(THRESHOLDS_MM))
        panels = render_series(
            [
                [Layer(fit.surfaces["final"], scalars=distances, colormap=table, vmin=limit - 1e-3, vmax=limit + 1e-3)]
                for limit in THRESHOLDS_MM
            ],
            camera=camera_view.camera,
            size=camera_view.size,
        )
        known = measured_mm(distances)
        within = [percent(float((known <= limit).mean())) if len(known) else "–" for limit in THRESHOLDS_MM]
        rows.append(
            Row(
                panels,
                [f"{limit:g} mm\n{share}" for limit, share in zip(THRESHOLDS_MM, within, strict=True)],
                short(fit.label, 60) if len(all_fits) > 1 else "",
            )
        )
    unseen = [(NOT_SHOWN, UNKNOWN_COLOUR)] if any(unknown(fit.model_to_scan_mm["final"]) for fit in all_fits) else []
    whose = f"{short(all_fits[0].label)}: where" if len(all_fits) == 1 else "Where"
    return grid(
        rows,
        title=title or f"{whose} the model lies within 2 to 10 mm of the scan",
        keys=[("within the limit", WITHIN_COLOUR), ("farther away", BEYOND_COLOUR), *unseen],
        note="In %: share of the vertices that the scan shows that lie within the limit.",
    )


def distance_histograms(fit: StagedFit, *, title: str = "", bins: int = 60) -> Figure:
    """Draw histograms of the distances of both directions, stage by stage on one scale.

    Distances from the model to the scan are drawn above each line, those from the scan to the model below it. Only
    vertices that the scan shows count, and scan points within the model's rim.
    """
    distances_by_stage = {
        stage: (measured_mm(fit.model_to_scan_mm[stage]), measured_mm(fit.scan_to_model_mm[stage]))
        for stage in fit.surfaces
    }
    all_distances = np.concatenate([values for pair in distances_by_stage.values() for values in pair])
    low, high = _decades(all_distances)
    edges = np.geomspace(low, high, bins + 1)
    heights = {
        stage: [100 * _histogram(values, edges) for values in pair] for stage, pair in distances_by_stage.items()
    }
    tallest = max(float(height.max()) for pair in heights.values() for height in pair) or 1.0
    axis_top = _TEXT_ROOM * tallest
    note = "Counted: the vertices that the scan shows, and scan points within the model's rim."
    if any(height[0] > max(_TOWERS * height[1], _TOWERS) for pair in heights.values() for height in pair):
        note += f" The first bar contains all distances below {mm(float(edges[1]))}, including 0."
    figure, plots = charts(
        title or f"{short(fit.label)}: closest distances both ways, stage by stage",
        [1.6] * len(distances_by_stage),
        note=note,
    )
    for k, (axes, (stage, pair)) in enumerate(zip(plots, heights.items(), strict=True)):
        for height, values, sign, colour, name in zip(
            pair,
            distances_by_stage[stage],
            (1, -1),
            (FORWARD, BACKWARD),
            ("model to scan", "scan to model"),
            strict=True,
        ):
            axes.stairs(sign * height, edges, fill=True, color=colour, alpha=0.45, lw=0)
            axes.stairs(sign * height, edges, color=colour, lw=1.2, baseline=None)
            summary = "no point counted"
            if len(values):
                mean = float(values.mean())
                summary = f"mean {mm(mean)}, largest {mm(float(values.max()))}"
                axes.plot([min(max(mean, low), high)] * 2, [0, sign * tallest], color=colour, lw=1.6, ls=(0, (3, 1.5)))
            axes.text(
                0.012, 0.5 + 0.47 * sign, f"{name}: {summary}", transform=axes.transAxes, color=colour,
                fontsize=type_size(SMALL - 1), va="top" if sign > 0 else "bottom",
                bbox={"facecolor": "white", "lw": 0, "pad": 1.5},
            )  # fmt: skip
        axes.axhline(0, color=GREY, lw=0.8)
        axes.set_title(STAGE_WORDS.get(stage, stage), fontsize=type_size(TEXT), color=INK, loc="left", pad=4, y=1.0)
        axes.set(xscale="log", xlim=(low, high), ylim=(-axis_top, axis_top))
        axes.yaxis.set_major_locator(MaxNLocator(3, symmetric=True))
        axes.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
        axes.xaxis.set_major_formatter("{x:g}")
        if k < len(distances_by_stage) - 1:
            axes.tick_params(labelbottom=False)
    to_points = " to the points" if fit.scan.faces is None else ""
    plots[-1].set_xlabel(f"closest distance{to_points} (mm, log scale); dashed: mean")
    # In the middle of all: of an even number, that is between two.
    plots[len(plots) // 2].set_ylabel("share of the points (%)", y=0.5 if len(plots) % 2 else 1.1)
    return finish(figure, h_pad=0.3)


def history_figure(fit: StagedFit, *, title: str = "") -> Figure:
    """Draw the RMS distance by iteration and phase."""
    title = title or f"{short(fit.label)}: the RMS distance from iteration to iteration"
    rms = np.array([moment.rms_mm for moment in fit.history], dtype=np.float64)
    phase = np.array([moment.phase for moment in fit.history], dtype=np.int64)
    usable = np.isfinite(rms)
    if not usable.any():
        return empty_chart(title, "No iteration was saved.")
    figure, axes = chart(title, height=3.0)
    for number, colour, name in ((1, BACKWARD, "phase 1: pose"), (2, FORWARD, "phase 2: pose and shape")):
        iterations = np.flatnonzero((phase == number) & usable)
        if len(iterations):
            axes.plot(
                iterations,
                rms[iterations],
                color=colour,
                lw=2,
                marker="o",
                ms=4 if len(rms) < 80 else 2,
                label=f"{name}, ends at {mm(float(rms[iterations[-1]]))}",
            )
    change = np.flatnonzero(np.diff(phase) > 0)
    if len(change):
        axes.axvline(float(change[0]) + 0.5, color="#c4c7cc", lw=1, ls=(0, (4, 3)))
    log = bool(rms[usable].min() > 0 and rms[usable].max() > 4 * rms[usable].min())
    if log:
        axes.set_yscale("log")
        plain_decades(axes.yaxis)
    else:
        axes.set_ylim(0, 1.1 * float(rms[usable].max()) or 1.0)
    axes.set(xlabel="iteration", ylabel=f"RMS distance (mm, {'log' if log else 'linear'} scale)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    # Above the plot, where it hides nothing.
    legend(axes, loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, borderpad=0.2)
    finish(figure)
    axes.tick_params(axis="y", which="minor", labelsize=type_size(SMALL - 1))
    return figure


def coefficients_figure(fit: StagedFit, population: FloatArray | None = None, *, title: str = "") -> Figure:
    """Draw the coefficients of a fit in standard deviations, with uncertainty, over those of the population.

    Args:
        fit: fit with z, b_stddev and shrinkage.
        population: (N, K) z of the training set; None draws the 95 % range of a normal population.
        title: text above the figure.

    Raises:
        InputError: the population has another number of coefficients.
    """
    count = len(fit.z)
    n_shown = min(count, _MOST_MODES)
    numbers = np.arange(1, n_shown + 1)
    z = fit.z[:n_shown]
    figure, axes = chart(
        title or f"{short(fit.label)}: its coefficient{'s' if count > 1 else ''}, with uncertainty and the usual range",
        height=3.2,
    )
    if population is None:
        axes.axhspan(-1.96, 1.96, color="#ebecee", lw=0, label="95 % of a normal population")
    else:
        if population.ndim != 2 or population.shape[1] != count:
            raise InputError(
                f"The population must have {count} coefficients per shape, as the fit does, not {population.shape}."
            )
        low, high = np.percentile(population[:, :n_shown], [2.5, 97.5], axis=0)
        axes.bar(numbers, high - low, bottom=low, width=0.9, color="#e3e5e8", label="95 % of the training set")
    deviation = z_stddev(fit)[:n_shown]
    is_determined = fit.shrinkage[:n_shown] >= 0.5
    for mask, colour, name in (
        (is_determined, FORWARD, "determined by the scan"),
        (~is_determined, "#9cc3df", "mostly the prior"),
    ):
        if mask.any():
            axes.bar(numbers[mask], z[mask], width=0.55, color=colour, label=name, zorder=2)
    known = np.isfinite(deviation)
    if known.any():
        axes.errorbar(
            numbers[known], z[known], yerr=1.96 * deviation[known], fmt="none", ecolor=INK, elinewidth=1.4, capsize=2.5,
            zorder=3, label="95 % interval",
        )  # fmt: skip
    axes.axhline(0, color=INK, lw=0.8)
    limit = max(3.0, 1.1 * float((np.abs(z) + np.where(known, 1.96 * np.nan_to_num(deviation), 0)).max()))
    axes.set(ylim=(-limit, 1.45 * limit), ylabel="z = b / sd")
    axes.set_xlabel("mode" if n_shown == count else f"mode (first {n_shown} of {count})")
    number_axis(axes, n_shown)
    legend(axes, loc="upper center", ncols=2)
    return finish(figure)


def z_stddev(fit: StagedFit) -> FloatArray:
    """Return the standard deviation of z, (K,); NaN where z is 0, since its scale is then unknown."""
    known = (np.abs(fit.z) > 1e-12) & (np.abs(fit.b) > 0)
    ratio = np.full(len(fit.z), np.nan)
    ratio[known] = fit.z[known] / fit.b[known]
    return ratio * fit.b_stddev


def regions_figure(fit: StagedFit, *, title: str = "") -> Figure:
    """Draw the scan next to the model, whose regions are coloured: matched, rejected, at the border, unobserved.

    Raises:
        InputError: the regions were not saved.
    """
    if fit.regions is None:
        raise InputError(f"{short(fit.label)} has no saved regions; fit the scan again with --stages.")
    layer = Layer(
        fit.surfaces["final"],
        scalars=fit.regions.astype(np.float64),
        colormap=np.array([REGION_COLOURS[name] for name in REGIONS]),
        vmin=-0.5,
        vmax=len(REGIONS) - 0.5,
        categories=True,
    )
    scan = Layer(fit.scan, SCAN_COLOUR)
    cameras, size = equal_views([(surroundings(fit), yaw) for _, yaw in (_SIDES[0], _SIDES[2])], 4)
    panels = [panel for camera in cameras for panel in render_series([[scan], [layer]], camera=camera, size=size)]
    return grid(
        [Row(panels, ["scan", "model"] * 2)],
        title=title or f"{short(fit.label)}: which parts of the model the scan decided",
        keys=[
            (f"{_REGION_WORDS[name]} ({percent(share)})", REGION_COLOURS[name])
            for name, share in fit.region_shares.items()
            if share > 0
        ],
        note="In %: share of the model's vertices. Parts that are not blue follow only the model and their neighbours.",
    )


def _stage_captions(fit: StagedFit) -> list[str]:
    means = {stage: mm(mean_mm(fit.model_to_scan_mm[stage])) for stage in fit.surfaces}
    return [f"{_SHORT_STAGES.get(stage, stage)}\n{mean}" for stage, mean in means.items()]


def _from_two_sides(fit: StagedFit, layers: Sequence[Sequence[Layer]], captions: list[str]) -> list[Row]:
    """Return a row of pictures from the front and one from the side; a single picture of each side is in one row."""
    points = surroundings(fit)
    final = fit.surfaces["final"].vertices
    before = fit.surfaces["before"].vertices if "before" in fit.surfaces else final
    # A start that was near is shown completely; a start far away would make the rest small.
    if np.abs(before.mean(axis=0) - final.mean(axis=0)).max() < _NEAR_START * np.ptp(final, axis=0).max():
        points = np.concatenate([points, before])
    cameras, size = equal_views([(points, yaw) for yaw in _FRONT_AND_SIDE], max(len(layers), len(_FRONT_AND_SIDE)))
    rows = [render_series(layers, camera=camera, size=size) for camera in cameras]
    if len(layers) == 1:  # panels of the width of the page would be higher than a screen
        return [Row([panel for row in rows for panel in row], captions * len(rows))]
    return [Row(rows[0], captions), Row(rows[1])]


def _colour(stage: str) -> Colour:
    return DENSE_COLOUR if stage == "dense" else MODEL_COLOUR


def _surface(fit: StagedFit, stage: str) -> Mesh:
    if stage not in fit.surfaces:
        raise InputError(f"{short(fit.label)} has no stage {stage!r}; choose one of {', '.join(fit.surfaces)}.")
    return fit.surfaces[stage]


def _summary(values: FloatArray) -> str:
    distances = measured_mm(values)
    if not len(distances):
        return "no point counted"
    return f"mean {mm(float(distances.mean()))}, 95 % within {mm(float(np.percentile(distances, 95)))}"


def _decades(values: FloatArray) -> tuple[float, float]:
    """Return the ends of a logarithmic axis for distances in mm."""
    inner = values[values > 0]
    if not len(inner):
        return 0.1, 10.0
    low, high = np.percentile(inner, 0.5), float(inner.max())
    low = float(np.clip(low, _NEAREST_MM, 1.0))
    return low, float(max(1.1 * min(high, 10 * _FARTHEST_MM), 10 * low))


def _histogram(values: FloatArray, edges: FloatArray) -> FloatArray:
    """Return the share of `values` in each bin; values outside the range count in the end bins."""
    if not len(values):
        return np.zeros(len(edges) - 1)
    return np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0] / len(values)


_DOUBTFUL = as_hex((0.90, 0.55, 0.05))


def error_curves(fits: Sequence[StagedFit], *, stage: str = "final", title: str = "") -> Figure:
    """Draw cumulative curves of the share of points within each distance.

    Args:
        fits: fits, each drawn as a thin curve over the vertices that its scan shows; a thick curve is that of all fits.
        stage: stage of the fits.
        title: text above the figure.

    Raises:
        InputError: there is nothing to draw, or a fit lacks the stage.
    """
    if not fits:
        raise InputError("There is nothing to draw of cumulative errors without fits.")
    if any(stage not in fit.surfaces for fit in fits):
        raise InputError(f"Not every fit has the stage {stage!r}, so their errors cannot be compared there.")
    sorted_distances = [np.sort(measured_mm(fit.model_to_scan_mm[stage])) for fit in fits]
    fits = [fit for fit, values in zip(fits, sorted_distances, strict=True) if len(values)]
    sorted_distances = [values for values in sorted_distances if len(values)]
    if not sorted_distances:
        return empty_chart(
            title or "How close the model comes to the scan", "No vertex of a model is shown by its scan."
        )
    pooled = np.sort(np.concatenate(sorted_distances))
    figure, axes = chart(
        title or f"How close the model comes to the scan, over {counted(len(fits), 'fit')}", height=3.5
    )
    thin = {"lw": 1.1, "alpha": float(np.clip(12 / len(fits), 0.12, 0.8))}
    labelled_stages: set[str] = set()
    for fit, values in sorted(zip(fits, sorted_distances, strict=True), key=lambda pair: pair[0].status != "converged"):
        doubtful = fit.status in ("doubtful", "failed")
        name = "a doubtful fit" if doubtful else "a fit"
        colour = _DOUBTFUL if doubtful else "#7fa8c9"
        _curve(axes, values, color=colour, label=None if name in labelled_stages else name, **thin)
        labelled_stages.add(name)
    if len(fits) > 1:
        _curve(axes, pooled, color=INK, lw=2.6, label="all together")
    for share in (0.5, 0.95):
        distance = float(np.quantile(pooled, share))
        axes.plot([distance], [100 * share], "o", color=INK, ms=6, zorder=5)
        axes.annotate(
            f"{100 * share:.0f} % within {mm(distance)}", (distance, 100 * share), xytext=(10, -5),
            textcoords="offset points", fontsize=type_size(SMALL), color=INK, va="top",
        )  # fmt: skip
    axes.set(xlabel="distance from the model to the scan (mm)", ylabel="vertices that the scan shows (%)")
    axes.set(xlim=(0, nice_ceiling(1.15 * float(np.quantile(pooled, 0.985)))), ylim=(0, 102))
    legend(axes, loc="lower right")
    return finish(figure)


def _curve(axes: Any, values: FloatArray, **style: Any) -> None:
    """Draw the cumulative share of sorted `values`, in at most 400 steps."""
    share = np.linspace(0, 1, min(len(values), 400) + 1)
    sample = np.quantile(values, share, method="inverted_cdf") if len(values) > 400 else np.concatenate([[0.0], values])
    axes.plot(
        np.concatenate([sample, [10 * values[-1] + 1]]),
        100 * np.concatenate([share, [1.0]]),
        drawstyle="steps-post",
        **style,
    )


def faces_grid(
    meshes: Sequence[Mesh], labels: Sequence[str], *, title: str, columns: int = 4, colour: Colour = CLAY
) -> Figure:
    """Draw `meshes` with one light and one scale, each under its label (figures 1 and 8).

    Raises:
        InputError: no meshes, or another number of labels.
    """
    if not meshes or len(meshes) != len(labels):
        raise InputError(f"{title}: {len(meshes)} meshes do not go with {len(labels)} labels.")
    columns = min(columns, max(len(meshes), 3))
    camera_view = view(np.concatenate([m.vertices for m in meshes]), columns)
    return grid(
        in_rows(
            [render(Layer(mesh, colour), camera=camera_view.camera, size=camera_view.size) for mesh in meshes],
            list(labels),
            columns,
        ),
        title=title,
    )


def portrait_figure(
    fits: Sequence[StagedFit], labels: Sequence[str] = (), *, title: str = "Raw scans and the models fitted to them",
    yaw_deg: float = 25.0,
) -> Figure:  # fmt: skip
    """Draw for each fit the scan, the fitted model, both superimposed, and the distances from model to scan.

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
        camera_view = view(surroundings(fit), 4, yaw_deg=yaw_deg)
        final, distances = fit.surfaces["final"], fit.model_to_scan_mm["final"]
        scan, over, model = Layer(fit.scan, SCAN_COLOUR), scan_over(fit.scan), Layer(final, MODEL_COLOUR)
        panels = render_series(
            [[scan], [model], [over, model], [distance_layer(final, distances, top, signed=signed)]],
            camera=camera_view.camera,
            size=camera_view.size,
        )
        captions = ["scan", "model, fitted", "both", "distance"] if k == 0 else []
        name = short(labels[k] if labels else fit.label, 60)
        rows.append(Row(panels, captions, f"{name}: mean {mm(mean_mm(distances))}"))
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
    """Draw scan and fitted model superimposed for many fits, in the order given."""
    return grid(
        _equal_views(fits, columns, lambda fit: [scan_over(fit.scan), Layer(fit.surfaces["final"], MODEL_COLOUR)]),
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
    known = np.concatenate([measured_mm(f.model_to_scan_mm["final"]) for f in fits])
    top = nice_ceiling(float(np.percentile(known, 99)) if len(known) else 1.0)
    return grid(
        _equal_views(
            fits,
            columns,
            lambda fit: [distance_layer(fit.surfaces["final"], fit.model_to_scan_mm["final"], top, signed=False)],
        ),
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
    """Return the legend text for grey areas in the maps."""
    return [(NOT_SHOWN, UNKNOWN_COLOUR)] if any(unknown(fit.model_to_scan_mm["final"]) for fit in fits) else []


def _equal_views(fits: Sequence[StagedFit], columns: int, layers: Callable[[StagedFit], list[Layer]]) -> list[Row]:
    """Return rows with one view per fit, each from its own front, all of one size, under its mean distance."""
    if not fits:
        raise InputError("There is nothing to draw without fits.")
    columns = min(columns, max(len(fits), 3))
    views = [view(fit.surfaces["final"].vertices, columns, margin=0.07) for fit in fits]
    size = (views[0].size[0], int(np.median([item.size[1] for item in views])))
    images = [
        render(
            *layers(fit),
            camera=Camera.framing(fit.surfaces["final"].vertices, aspect=size[0] / size[1], margin=0.07),
            size=size,
        )
        for fit in fits
    ]
    return in_rows(images, [f"{short(f.label, 30)}\n{mm(mean_mm(f.model_to_scan_mm['final']))}" for f in fits], columns)
