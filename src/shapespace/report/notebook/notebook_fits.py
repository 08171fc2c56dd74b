"""Notebook views of models, fits and model quality: a picture, key numbers, status; and their plots."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, TypeAlias

from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.result import FitResult
from shapespace.model.model_quality import Curve, ModelQuality
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.blocks.blocks import Block
from shapespace.report.blocks.wording import listed, mm, percent, training_text
from shapespace.report.inputs.staged_fit import StagedFit
from shapespace.report.pages.page import template
from shapespace.report.pages.write_html import require_report_extra
from shapespace.report.render.thumbnails import Still, fit_strip

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Drawn: TypeAlias = tuple[Still, str]
"""A picture, and what stands below it."""
_SHARES = (0.9, 0.95, 0.98)  # of the variance; usual choices for the number of modes
_MODES_SHOWN = 2  # layout: rows
_PANEL = (220, 290)  # layout: pixels
_MOST_COEFFICIENTS = 5  # layout: entries
_FIT_FIGURES = {
    "distances": "signed_maps",
    "stages": "stages_figure",
    "overlay": "overlay_figure",
    "histograms": "distance_histograms",
    "coefficients": "coefficients_figure",
    "history": "history_figure",
    "regions": "regions_figure",
}
_CURVES = (
    "compactness",
    "generalisation",
    "generalisation_vertices",
    "specificity",
    "specificity_vertices",
    "reconstruction",
    "reconstruction_vertices",
)


def plot_model(model: ShapeModel, kind: str, **options: Any) -> Figure:
    """Draw a figure for `ShapeModel.plot`."""
    return _draw({"modes": "modes_figure", "mean": "mean_figure", "spectrum": "spectrum_figure"}, kind, model, options)


def plot_fit(result: FitResult, kind: str, **options: Any) -> Figure:
    """Draw a figure for `FitResult.plot`."""
    return _draw(_FIT_FIGURES, kind, StagedFit.of(result.model, result), options)


def plot_quality(quality: ModelQuality, **options: Any) -> Figure:
    """Draw a figure for `ModelQuality.plot`."""
    require_report_extra()
    curves = {name: _numbers(curve) for name in _CURVES if (curve := getattr(quality, name)) is not None}
    if quality.by_shapes is not None:
        sizes = _numbers(quality.by_shapes)
        curves["generalisation_by_shapes"] = {"shapes": sizes.pop("modes"), **sizes}
    return figures.quality_figure(curves, **options)


def _numbers(curve: Curve) -> dict[str, list[float]]:
    return {
        name: values.tolist()
        for name, values in {"modes": curve.counts, "mean": curve.mean, "low": curve.low, "high": curve.high}.items()
    }


def _draw(names: Mapping[str, str], kind: str, shown: object, options: Mapping[str, Any]) -> Figure:
    """Return the figure of a kind, by its name in `shapespace.report.figures`."""
    require_report_extra()
    if kind not in names:
        raise InputError(f"There is no plot {kind!r}; choose one of {', '.join(names)}.")
    return getattr(figures, names[kind])(shown, **options)


def html_of_model(model: ShapeModel) -> str:
    """Return a model for a notebook: its first modes, training data, and licence."""
    rows = [
        ("Made of", training_text(model)),
        ("Surface", f"{model.n_vertices:,} vertices, {0 if model.faces is None else len(model.faces):,} triangles"),
        ("Modes", f"{model.n_modes}, with {100 * float(model.cumulative_variance[-1]):.1f} % of the variance"),
        (
            "Variance",
            listed(
                [f"{percent(share)} in {n}" for share in _SHARES if (n := model.modes_for_variance(share)) is not None]
            )
            or "below 90 % in the modes kept",
        ),
        ("Size", "divided out (gauge shape)" if model.gauge == "shape" else "kept in the modes (gauge form)"),
        ("Landmarks", listed(list(model.landmarks)) or "none"),
        ("Provenance", model.provenance or "not stated"),
        ("Licence", model.licence or "not stated"),
    ]

    def draw() -> Drawn:
        return figures.encode_webp(
            plot_model(model, "modes", modes=_MODES_SHOWN)
        ), "The first modes; model.plot() draws more."

    return notebook_html(model, "Shape model", [], rows, draw)


def html_of_fit(result: FitResult) -> str:
    """Return a fit for a notebook: where it is how far from the scan, the verdict, and the largest coefficients."""
    overlap = result.overlap_distances
    largest = sorted(range(len(result.z)), key=lambda k: -abs(result.z[k]))[:_MOST_COEFFICIENTS]
    seen, covered = percent(overlap.model_seen_share), percent(overlap.scan_covered_share)
    rows = [
        ("Model to scan", f"{mm(overlap.model_to_scan.mean)} mean, over the {seen} that the scan shows"),
        ("Scan to model", f"{mm(overlap.scan_to_model.mean)} mean, over the {covered} that the model covers"),
        ("Coefficients", f"{len(result.z)}; " + ", ".join(f"z{k + 1} {result.z[k]:+.1f}" for k in largest)),
        ("Scale", f"{result.T_scan_model.scale:.4g} ({result.mm_per_scan_unit:g} mm in the scan's unit)"),
        ("Method", f"{result.method}, started from {result.start}, {sum(result.seconds.values()):.2f} s"),
    ]
    if result.evidence is not None:
        rows.insert(2, ("Expected error", f"{mm(result.evidence.expected_error_mm)} of its vertices"))
    rows += [("Note", note) for note in result.notes]

    def draw() -> Drawn:
        fit = StagedFit.of(result.model, result)
        colours = "blue inside, red outside" if fit.scan.faces is not None else "dark is far"
        return fit_strip(
            fit, fit.scale_mm, _PANEL
        ), f"The scan; scan and fitted model; distances up to {mm(fit.scale_mm)}: {colours}, grey not shown."

    return notebook_html(result, result.scan_name, [f"{result.status}: {result.reason}"], rows, draw)


def html_of_quality(quality: ModelQuality) -> str:
    """Return a quality for a notebook: its curves, and each measure with all modes."""
    rows = [("Shapes", f"{quality.shapes}, left out in {quality.folds} folds")] if quality.shapes else []
    for name in _CURVES:
        curve = getattr(quality, name)
        if curve is not None:
            value, low, high = curve.mean[-1], curve.low[-1], curve.high[-1]
            value_text = percent(value) if name == "compactness" else f"{mm(value)} ({low:.3g} to {high:.3g})"
            rows.append(
                (name.replace("_vertices", " (vertices)").capitalize(), f"{value_text} with {curve.counts[-1]} modes")
            )

    def draw() -> Drawn:
        return figures.encode_webp(plot_quality(quality)), "Bands are 95 % intervals."

    return notebook_html(quality, "Quality of a shape space", quality.sentences(), rows, draw)


def notebook_html(
    of: object,
    title: str,
    sentences: Sequence[str],
    rows: Sequence[tuple[str, str]],
    draw: Callable[[], Drawn] | None = None,
    *,
    blocks: Sequence[Block] = (),
) -> str:
    """Return the notebook view of an object; its repr if the extra `report` is not installed.

    Args:
        of: the object.
        title: above the rest.
        sentences: what matters first.
        rows: names and values.
        draw: makes a picture with its caption; None for none.
        blocks: of a report, below the rest.
    """
    try:
        require_report_extra()
    except ShapespaceError as error:
        return f"<pre>{escape(repr(of))}\n{escape(str(error))}</pre>"
    picture, size, caption = "", (0, 0), ""
    try:
        if draw is not None:
            (content, size), caption = draw()
            picture = base64.b64encode(content).decode()
    except ShapespaceError as error:
        sentences = [*sentences, f"No picture: {error}"]
    return template("notebook.html").render(
        title=title, sentences=sentences, rows=rows, picture=picture, size=size, caption=caption,
        body=blocks,
    )  # fmt: skip
