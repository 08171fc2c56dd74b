"""Figures of many fits: distances, and grids of pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from shapespace.errors import InputError
from shapespace.report.figures.draw import (
    GREY,
    INK,
    NOT_SHOWN,
    SMALL,
    TEXT,
    Row,
    Scale,
    chart,
    counted,
    distance_scale,
    finish,
    grid,
    in_rows,
    legend,
    mean_mm,
    mean_words,
    mm,
    plain,
    scan_over,
    short,
    surroundings,
    unknown,
    view,
)
from shapespace.report.inputs.staged_fit import StagedFit, measured_mm, nice_ceiling, scale_end
from shapespace.report.render.palette import (
    CLAY,
    MODEL_COLOUR,
    SCAN_COLOUR,
    SEQUENTIAL,
    UNKNOWN_COLOUR,
    Colour,
    as_hex,
)
from shapespace.report.render.renderer import Camera, Image, Layer, distance_layer, render, render_series
from shapespace.types import FloatArray, Mesh

_DOUBTFUL = as_hex((0.90, 0.55, 0.05))


def error_curves(fits: Sequence[StagedFit], *, stage: str = "final", title: str = "") -> Figure:
    """Draw cumulative curves of the share of points within each distance.

    Args:
        fits: for a thin curve each and a thick one of all together, over the vertices that their scans show.
        stage: of the fits.
        title: above the figure.

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
        return _empty_figure(title)
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
            textcoords="offset points", fontsize=SMALL, color=INK, va="top",
        )  # fmt: skip
    axes.set(xlabel="distance from the model to the scan (mm)", ylabel="vertices that the scan shows (%)")
    axes.set(xlim=(0, nice_ceiling(1.15 * float(np.quantile(pooled, 0.985)))), ylim=(0, 102))
    legend(axes, loc="lower right")
    return finish(figure)


def _empty_figure(title: str) -> Figure:
    figure, axes = chart(title or "How close the model comes to the scan", height=1.2)
    axes.text(
        0.5, 0.5, "No vertex of a model is shown by its scan.", transform=axes.transAxes, ha="center", va="center",
        fontsize=TEXT, color=GREY,
    )  # fmt: skip
    axes.set_axis_off()
    return finish(figure)


def _curve(axes: Any, values: FloatArray, **style: Any) -> None:
    """Draw the share of sorted `values` up to each of them, in at most 400 steps."""
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
    images = [render(Layer(mesh, colour), camera=camera_view.camera, size=camera_view.size) for mesh in meshes]
    return grid(
        [Row(i, t) for i, t in zip(in_rows(images, columns), in_rows(list(labels), columns), strict=True)], title=title
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
        mapped = distance_layer(final, distances, top, signed=signed)
        panels = render_series(
            [[scan], [model], [over, model], [mapped]], camera=camera_view.camera, size=camera_view.size
        )
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
    """Draw scan and fitted model superimposed for many fits, in the order given."""
    images = _equal_views(fits, columns, lambda fit: [scan_over(fit.scan), Layer(fit.surfaces["final"], MODEL_COLOUR)])
    return grid(
        _caption_rows(images, fits, columns),
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
    images = _equal_views(
        fits,
        columns,
        lambda fit: [
            Layer(fit.surfaces["final"], scalars=np.abs(fit.model_to_scan_mm["final"]), colormap=SEQUENTIAL, vmax=top)
        ],
    )
    return grid(
        _caption_rows(images, fits, columns),
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


def _equal_views(fits: Sequence[StagedFit], columns: int, layers: Callable[[StagedFit], list[Layer]]) -> list[Image]:
    """Return one view per fit, each from its own front, all of one size."""
    if not fits:
        raise InputError("There is nothing to draw without fits.")
    columns = min(columns, max(len(fits), 3))
    views = [view(fit.surfaces["final"].vertices, columns, margin=0.07) for fit in fits]
    size = (views[0].size[0], int(np.median([item.size[1] for item in views])))
    return [
        render(
            *layers(fit),
            camera=Camera.framing(fit.surfaces["final"].vertices, aspect=size[0] / size[1], margin=0.07),
            size=size,
        )
        for fit in fits
    ]


def _caption_rows(images: Sequence[Image], fits: Sequence[StagedFit], columns: int) -> list[Row]:
    columns = min(columns, max(len(fits), 3))
    names = [f"{short(f.label, 30)}\n{mm(mean_mm(f))}" for f in fits]
    return [Row(i, t) for i, t in zip(in_rows(images, columns), in_rows(names, columns), strict=True)]
