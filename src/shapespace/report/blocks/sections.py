"""Parts that the pages share: the model, one fit in detail, a table of fits, fits together, scores."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import nan
from types import MappingProxyType
from typing import Any, TypeVar, cast

import numpy as np

from shapespace.errors import ShapespaceError
from shapespace.fit.paper.paper_method import Paper
from shapespace.fit.robust.robust_settings import DenseSettings, ResidualSettings, RobustSettings
from shapespace.model.region import JointSpread, relative_pose
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.blocks.blocks import (
    Block,
    Cell,
    Facts,
    Figure,
    Folded,
    Group,
    Head,
    Notes,
    Table,
    Text,
    Turning,
    length,
    number,
    status,
    text_table,
)
from shapespace.report.blocks.wording import (
    DASH,
    ORDER_OF_CONCERN,
    counted,
    isfinite,
    known,
    listed,
    mm,
    percent,
    plain,
    setting,
    training_text,
    words,
)
from shapespace.report.inputs.saved_fits import (
    Coefficients,
    Direction,
    Folder,
    Measure,
    SavedFit,
    StagedFit,
    measured_mm,
)
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.pages.page import OrderedPicture, Page
from shapespace.report.render import thumbnails
from shapespace.report.render.scene import pack_fit, pack_model, pack_scatter, pack_surfaces
from shapespace.schemas import Quality, VertexErrors, read
from shapespace.types import FloatArray, Mesh

MODEL_PICTURES, FIT_PICTURES = 4, 9
"""Number of pictures that `model_part` and `fit_in_full` make."""

MODES_IN_WIDGET = 8  # sliders that fit next to the picture; their displacements are most of the payload
SCAN_TRIANGLES = 8_000
"""Triangles of a scan in the page; the file of the scan has all."""

_From = TypeVar("_From")
_To = TypeVar("_To")
_MODES_DRAWN = 5  # rows of the picture of the modes
_CAPTION_HEIGHT = 0.14
"""Height of the caption of a figure, as a share of the figure's width."""
_DETAIL_BYTES = 1_300_000  # bytes of the page that all pictures of one fit take
_VARIANCE_SHARES = (0.90, 0.95, 0.98, 0.99)  # shares of the variance that are usual in publications


def concern(fit: SavedFit) -> tuple[int, float]:
    """Return a key that sorts fits by their need for review: by status, then by the expected or measured error."""
    error = fit.expected_error_mm
    if not isfinite(error):
        error = fit.distance_mm("scan_to_model")
    return ORDER_OF_CONCERN.index(fit.status), -error if isfinite(error) else 0.0


def in_columns(*pictures: Block) -> Block:
    """Return pictures in two columns of about equal height, each in the order given; a single one as it is."""
    if len(pictures) < 2:
        return pictures[0] if pictures else Group("columns", ())
    tall = np.array([_height(picture) for picture in pictures])
    right = np.array([(0, *rest) for rest in product((0, 1), repeat=len(pictures) - 1)], dtype=bool)
    best = right[np.abs(right @ tall - (~right) @ tall).argmin()]
    sides = [[picture for picture, is_right in zip(pictures, best, strict=True) if is_right == k] for k in (0, 1)]
    return Group("columns", [Group("column", side) for side in sides])


def _height(block: Block) -> float:
    """Return the approximate height of a block as a share of its width."""
    return block.image.size[1] / block.image.size[0] + _CAPTION_HEIGHT if isinstance(block, Figure) else _CAPTION_HEIGHT


# The model


def model_part(page: Page, model: ShapeModel, *, figure_of: str = "", to_move: int = MODES_IN_WIDGET) -> list[Block]:
    """Return the blocks of a model: modes with sliders, facts, modes as stills, spectrum.

    Args:
        page: page that receives the blocks and their data.
        model: the shape space.
        figure_of: text before the caption of the modes.
        to_move: number of modes with a slider.
    """
    needed = [
        f"{100 * share:g} % in {counted(count, 'mode')}"
        for share in _VARIANCE_SHARES
        if (count := model.modes_for_variance(share)) is not None
    ]
    rows = [
        ("Made of", training_text(model)),
        ("Surface", f"{model.n_vertices:,} vertices, {0 if model.faces is None else len(model.faces):,} triangles"),
        ("Modes kept", f"{model.n_modes}, with {100 * float(model.cumulative_variance[-1]):.1f} % of the variance"),
        ("Variance", listed(needed) or "below 90 % in the modes kept"),
        ("Size", "divided out (gauge shape)" if model.gauge == "shape" else "kept in the modes (gauge form)"),
        ("Provenance", model.provenance),
        ("Licence", model.licence or "not stated"),
    ]
    n_shown, ordered = min(_MODES_DRAWN, model.n_modes), order_model(page, model)
    return [
        modes_to_move(page, model, to_move),
        Facts(rows, "The shape model"),
        *_parts_of_model(model),
        Folded(
            "Its modes as stills, their variance, the mean from three sides",
            [
                in_columns(
                    page.figure(
                        ordered["modes_figure"],
                        f"{figure_of}Each row: the mean with one mode at −3, 0 and +3 standard deviations, and how far "
                        "each point moves at 3. One scale for all rows.",
                        alt=f"Mean shape and the first {counted(n_shown, 'mode')} at minus and plus three standard "
                        "deviations, with maps of the displacement",
                    ),
                    page.figure(
                        ordered["spectrum_figure"],
                        "Share of the training set's variance in the first modes.",
                        alt=f"Spectrum: {listed(needed) or 'the modes kept contain less than 90 % of the variance'}",
                        chart=True,
                    ),
                    page.figure(
                        ordered["mean_figure"],
                        "The mean shape from three sides"
                        + (", with the model's landmarks." if model.landmarks else "."),
                        alt="The mean shape from three sides",
                    ),
                )
            ],
        ),
    ]


_RELATIVE_POSE = {
    "modelled": "modes move shapes and relative poses, with exact rotations",
    "kept": "modes move the vertices of all parts in one frame, linearly",
    "removed": "modes move the shapes of the parts; their relative pose is that of the mean",
}


def _parts_of_model(model: ShapeModel) -> list[Block]:
    """Return the parts of a model, and the spread of their relative poses; nothing if it has one structure."""
    if (pose := relative_pose(model)) is None:
        return []
    of_joints = {joint.part: joint for joint in pose.joints}
    rows = [
        [Cell(name), Cell(f"{count:,}", count), *_cells_of_joint(of_joints.get(name))]
        for name, count in model.part_counts.items()
    ]
    columns = [
        Head("Part"), Head("Vertices", "number"), Head("Joint with"), Head("Rotation, SD in degrees", "number"),
        Head("Translation, SD in mm", "number"),
    ]  # fmt: skip
    order = ", to first order" if pose.choice == "kept" else ""
    text = f"Relative pose {pose.choice}: {_RELATIVE_POSE[pose.choice]}."
    return [Table(columns, rows, f"The parts. {text} Standard deviations (SD) are those of the modes{order}.")]


def _cells_of_joint(joint: JointSpread | None) -> list[Cell]:
    if joint is None:
        return [Cell(DASH), Cell(DASH), Cell(DASH)]
    return [Cell(joint.parent), number(joint.rotation_deg, 1), number(joint.translation_mm, 1)]


def order_model(page: Page, model: ShapeModel) -> Mapping[str, OrderedPicture]:
    """Order all pictures of a model, as early as possible, and return them by the names of their functions."""
    drawn = page.once(("drawn", model), lambda: replace(model, training=None))  # which may be large, and is not drawn
    return {
        "modes_figure": page.order("modes_figure", drawn, modes=min(_MODES_DRAWN, model.n_modes)),
        "spectrum_figure": page.order("spectrum_figure", drawn, chart=True),
        "mean_figure": page.order("mean_figure", drawn),
    }


def quality_part(page: Page, folder: Folder) -> Figure:
    """Return the quality of a shape space by its number of modes, from the measures that quality.json contains.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged.
    """
    quality = read(Quality, folder.json(Quality.FILE), Quality.FILE, "measure it again")
    return page.figure(
        figures.quality_figure(quality),
        "Compactness: share of the variance. Generalisation: error on held-out shapes. Specificity: distance of random "
        "shapes from the nearest training shape. Bands: 95 % intervals where they were measured. "
        + " ".join(quality.sentences),
        alt="Compactness, generalisation and specificity by the number of modes, those of them that were measured",
        chart=True,
    )


def modes_to_move(page: Page, model: ShapeModel, most: int) -> Turning | Figure:
    """Return the model's modes with sliders, and a still of the mean as the fallback."""
    count = min(most, model.n_modes)
    still = thumbnails.mesh_still(model.mesh(), (420, 420), Parts.of(model))
    which = f"The first {counted(count, 'mode')} of {model.n_modes}"
    if count == model.n_modes:
        which = f"{'Its' if count == 1 else 'All'} {counted(count, 'mode')}"
    return page.turning(
        "modes",
        pack_model(model, count, small=True),
        page.image(still, "The mean shape"),
        f"{which}, to be moved by hand.",
        label="Modes of the model, one slider each",
        still="The still shows the mean.",
    )


# One fit


def fit_in_full(
    page: Page,
    fit: StagedFit,
    population: FloatArray | None = None,
    *,
    reserve: int = 0,
    of_paper: bool = False,
    folded: bool = False,
) -> list[Block]:
    """Return the widget and all pictures of one fit, as far as the size of the file allows.

    Args:
        page: page that receives the blocks and their data.
        fit: fit with its stages.
        population: (N, K) coefficients of other fits in standard deviations, or None.
        reserve: bytes of the page that are kept free.
        of_paper: whether captions name the figures of the paper.
        folded: whether all blocks but the widget are folded.
    """
    if page.left < _DETAIL_BYTES + reserve:
        return [Text("Its pictures would make this file larger than 8 MB, so they are omitted.", "soft")]
    order_pictures(page, fit, population)
    turning = page.tried(lambda: fit_to_turn(page, fit))
    pictures = fit_pictures(page, fit, population, of_paper=of_paper)
    stages, iterations = ("", "") if fit.regions is None else ("stages, ", "iterations, ")
    heading = (
        f"More pictures: {stages}both ways of distance, {stages and 'regions, '}thresholds, {iterations}coefficients"
    )
    return [*turning, Folded(heading, [pictures]) if folded else pictures]


def fit_to_turn(page: Page, fit: StagedFit) -> Turning | Figure:
    """Return the widget of scan and model of one fit, with a strip of stills as the fallback."""
    limit_mm = fit.scale_mm
    scale = (
        f"the signed distance to the scan, −{limit_mm:g} (blue) to +{limit_mm:g} mm (red)."
        if fit.scan.faces is not None
        else f"the distance to the points of the scan, 0 to {limit_mm:g} mm."
    )
    return page.turning(
        "fit",
        pack_fit(fit, largest_scan=SCAN_TRIANGLES),
        page.image(thumbnails.fit_strip(fit, limit_mm, (300, 372)), strip_alt(fit, limit_mm)),
        f"{fit.label}: the scan, and the {'fitted model' if fit.regions is None else 'model at each stage'}.",
        label=f"Scan and model of {fit.label}, to be turned",
        still=f"The still shows the scan, both over each other, and {scale}",
    )


def surface_to_turn(
    page: Page, fit: SavedFit, surfaces: Mapping[str, Mesh], why: str, parts: Parts | None = None
) -> Turning | Figure:
    """Return the fitted surface of a fit whose scan cannot be shown, with a still image as the fallback.

    Args:
        page: page that receives the surface.
        fit: fit of the surface.
        surfaces: `final`, and if the fit has one, `dense`, in the picture frame.
        why: reason why the scan is not shown, as the end of a sentence.
        parts: parts of the model; None if it has one structure, or is not known.
    """
    return page.turning(
        "fit",
        pack_surfaces(
            surfaces, fit.record, name=fit.name, label=fit.label, reason=why, largest=SCAN_TRIANGLES, parts=parts
        ),
        page.image(thumbnails.mesh_still(surfaces["final"], (420, 420), parts), f"The fitted surface of {fit.name}"),
        f"{fit.label}: the fitted surface; {why.removesuffix('.')}.",
        label=f"Fitted surface of {fit.label}, to be turned",
        still="The still shows the fitted surface.",
    )


def strip_alt(fit: StagedFit, limit_mm: float) -> str:
    """Return the alternative text of `thumbnails.fit_strip`."""
    return (
        f"{fit.label}: the scan, scan and model over each other, and a map of the distances; "
        f"{share_within(fit, limit_mm)} of the vertices that the scan shows lie within {limit_mm:g} mm"
    )


def share_within(fit: StagedFit, limit_mm: float) -> str:
    """Return the share of the observed vertices that lie within `limit_mm` of the scan."""
    known = measured_mm(fit.model_to_scan_mm["final"])
    return percent(float((known <= limit_mm).mean())) if len(known) else "none"


def order_pictures(page: Page, fit: StagedFit, population: FloatArray | None) -> Mapping[str, OrderedPicture]:
    """Order all pictures of one fit, as early as possible, and return them by the names of their functions.

    Args:
        page: page of the pictures.
        fit: fit with its stages.
        population: (N, K) coefficients of other fits in standard deviations, or None.
    """
    names = [name for name in _CAPTIONS if fit.regions is not None or name not in _OF_STAGES]
    options: Mapping[str, Any] = {"coefficients_figure": {"population": population}}
    return {name: page.order(name, fit, chart=name in _CHARTS, **options.get(name, {})) for name in names}


def fit_pictures(page: Page, fit: StagedFit, population: FloatArray | None, *, of_paper: bool) -> Block:
    """Return all pictures of one fit for `fit_in_full`."""
    stages = {"before": "before", "initial": "after phase 1", "final": "after phase 2", "dense": "dense"}
    largest = "largest distance from model to scan " + listed(
        [
            f"{mm(float(measured_mm(far).max(initial=0.0)))} {stages[stage]}"
            for stage, far in fit.model_to_scan_mm.items()
        ]
    )
    within = listed([f"{share_within(fit, limit)} within {limit} mm" for limit in (2, 4, 6, 8, 10)])
    rms = [moment.rms_mm for moment in fit.history]
    fall = f"falls from {mm(rms[0])} to {mm(rms[-1])} in {counted(len(rms), 'step')}" if rms else "was not saved"
    alts = {
        "stages_figure": f"Scan and model of {fit.label} by stage; {largest}",
        "overlay_figure": f"Scan and model of {fit.label} over each other at each stage; {largest}",
        "signed_maps": f"Signed distance maps of {fit.label}, model to scan and scan to model",
        "regions_figure": f"Regions of {fit.label}: {region_shares(fit)}",
        "threshold_figure": f"Maps of {fit.label}: {within}",
        "distance_histograms": f"Histograms of closest distances of {fit.label}; {largest}",
        "history_figure": f"RMS of {fit.label} {fall}",
        "coefficients_figure": f"Coefficients of {fit.label}: " + ", ".join(f"{value:.1f}" for value in fit.z[:10]),
    }

    def picture(name: str, ordered: OrderedPicture) -> Figure:
        caption = (_OF_PAPER.get(name, "") if of_paper else "") + _CAPTIONS[name]
        return page.figure(ordered, caption, alt=alts[name], chart=name in _CHARTS)

    return in_columns(
        *(
            block
            for name, ordered in order_pictures(page, fit, population).items()
            for block in page.tried(lambda name=name, ordered=ordered: picture(name, ordered))
        )
    )


_OF_STAGES = ("stages_figure", "regions_figure", "history_figure")
"""Figures that need the output of --stages."""
_CHARTS = ("history_figure", "coefficients_figure")
"""Figures of few colours, which are smaller without loss."""
_CAPTIONS = {
    "stages_figure": "The scan, and the model at each stage of the fit, in the frame of the final pose.",
    "overlay_figure": "Scan and model over each other, the nearer one shown: where they alternate finely, they "
    "coincide.",
    "signed_maps": "Signed distances both ways, positive where the scan lies outside of the model; those of a scan of "
    "points only have no sign. Scan points beyond the model's rim are not counted.",
    "regions_figure": "Parts of the model that followed the scan, that were rejected because the scan shows something "
    "else there, that lay at the scan's border, or that the scan does not show.",
    "threshold_figure": "Where the model lies within 2 to 10 mm of the scan. Above each panel: share of the vertices "
    "that the scan shows.",
    "distance_histograms": "Closest distances both ways, by stage. Scan points beyond the model's rim are not counted.",
    "history_figure": "RMS of the closest distances in the fit, by phase.",
    "coefficients_figure": "Coefficients in standard deviations of the training set, with their own uncertainty. "
    "Beyond about 3 they are rare in it.",
}
_OF_PAPER = {
    "overlay_figure": "Paper, figures 4 to 7. ",
    "distance_histograms": "Paper, figures 4 to 7. ",
    "threshold_figure": "Paper, figure 11. ",
}


def region_shares(fit: StagedFit) -> str:
    """Return the share of each region in words, or that they are unknown if the stages were not saved."""
    return listed([f"{name} {percent(share)}" for name, share in fit.region_shares.items()]) or "not saved"


def fit_facts(fit: SavedFit) -> list[Block]:
    """Return status, reason, distances and notes of one fit, and its evidence folded away."""
    evidence = fit.record.evidence
    return [
        Text(fit.reason, name=status(fit.status)),
        Text(distances_text(fit)),
        Notes(fit.record.notes),
        Folded("Evidence for the verdict", [evidence_facts(evidence, f"Evidence of {fit.name}")] if evidence else []),
    ]


def distances_text(fit: SavedFit) -> str:
    """Return the mean distances of one fit both ways, and the observed shares that they are averaged over."""
    to_scan, to_model = mm(fit.distance_mm("model_to_scan")), mm(fit.distance_mm("scan_to_model"))
    overlap = fit.record.shown
    seen, covered = (overlap.model_seen_share, overlap.scan_covered_share) if overlap else (None, None)
    return (
        f"On average, over the parts that the scan shows: model to scan {to_scan}{_over(seen, 'model')}, scan to model "
        f"{to_model}{_over(covered, 'scan')}."
    )


def _over(share: float | None, of: str) -> str:
    return "" if share is None else f" ({percent(share)} of the {of})"


# Many fits


def usable(items: Sequence[_From], load: Callable[[_From], _To]) -> tuple[list[_To], list[str]]:
    """Return the results of `load`, and a sentence for each item that it rejects."""
    usable_fits: list[_To] = []
    problems: list[str] = []
    for item in items:
        try:
            usable_fits.append(load(item))
        except ShapespaceError as error:
            problems.append(str(error))
    return usable_fits, problems


# Coefficients


def coefficients_of(fit: SavedFit) -> Coefficients:
    """Return the coefficients of one fit with its label."""
    entry = fit.entry
    return Coefficients(fit.name, entry.expression, entry.intensity or 0.0, fit.numbers("b"), fit.numbers("z"))


def order_scatter(page: Page, points: Sequence[Coefficients]) -> Sequence[OrderedPicture]:
    """Order the pictures of `scatter`, as early as possible: the matrix, and with three coefficients the space."""
    in_space = all(len(point.b) >= 3 for point in points)
    return [
        page.order("scatter_matrix", points),
        *([page.order("b_space", points, chart=True)] if in_space else []),
    ]


def scatter(page: Page, points: Sequence[Coefficients]) -> list[Block]:
    """Return the first coefficients of many fits against each other, coloured by label."""
    ordered, *in_space = order_scatter(page, points)
    labels = list(dict.fromkeys(point.expression for point in points if point.expression))
    coloured = f", coloured by label: {listed(labels)}" if len(labels) > 1 else ""
    matrix = page.figure(
        ordered,
        f"The first coefficients of {counted(len(points), 'fit')} against each other{coloured}.",
        alt=f"Scatter matrix of the first coefficients of {counted(len(points), 'fit')}{coloured}",
    )
    if not in_space:
        return [matrix]
    return [matrix, Folded("The same in space, to be turned", page.tried(lambda: scatter_to_turn(page, points)))]


def lines_through_neutral(
    page: Page,
    points: Sequence[Coefficients],
    neutral: Coefficients | None,
    *,
    figures_of: Sequence[str] = ("", ""),
) -> Block:
    """Return the line structure of one subject's expressions in two and in three coefficients (figures 9 and 10).

    Args:
        page: page that receives the figures.
        points: the expressive fits, with at least two coefficients.
        neutral: the fit of the neutral face, through which the lines pass; None draws none.
        figures_of: texts before the two captions.
    """
    about = (
        "Larger marks are stronger expressions. Lines pass through the fitted neutral face and fit best in all "
        "coefficients, each in its standard deviations."
        if neutral
        else "Larger marks are stronger expressions. No neutral face was fitted, so no lines are drawn."
    )
    faces = counted(len(points), "face")
    pictures: list[Block] = [
        page.figure(
            figures.b_plane(points, title="Expressions in the first two coefficients", neutral=neutral),
            f"{figures_of[0]}{about}",
            alt=f"Scatter plot of b1 and b2 for {faces}: each expression runs along its own line",
            chart=True,
        )
    ]
    if all(len(point.b) >= 3 for point in points):
        pictures.append(
            page.figure(
                figures.b_space(points, title="The first three coefficients, from two sides", neutral=neutral),
                f"{figures_of[1]}Grey lines drop to the floor of the box.",
                alt=f"Two views of b1, b2 and b3 for {faces} with a line for each expression",
            )
        )
    return in_columns(*pictures)


def scatter_to_turn(page: Page, points: Sequence[Coefficients]) -> Turning | Figure:
    """Return the widget of b1, b2 and b3 in space, with a still as the fallback."""
    still = page.order("b_space", points, chart=True)
    first = np.stack([point.b[:MODES_IN_WIDGET] for point in points])
    return page.turning(
        "scatter",
        pack_scatter(
            first,
            [point.expression or "no label" for point in points],
            [point.name for point in points],
            axes=[f"b{k + 1}" for k in range(first.shape[1])],
        ),
        page.still(still, f"b1, b2 and b3 of {counted(len(points), 'fit')} in space"),
        "Coefficients of all fits in space, in mm.",
        label="Scatter of three coefficients, to be turned",
        still="The still shows the first three from two sides.",
    )


# The diagnostics of a fit in English: a label and a format for each key of `evidence` in a record

_Entry = tuple[str, Callable[[float], str]]


def _size(log_scale: float) -> str:
    return f"{math.exp(log_scale):.3f} times" if abs(log_scale) < math.log(1000) else f"log {log_scale:.3g}"


def _plain(value: float) -> str:
    return f"{value:.3g}"


EVIDENCE: Mapping[str, _Entry] = MappingProxyType(
    {
        "expected_error_mm": ("Expected distance of a vertex from its true place", mm),
        "error_low_mm": ("... 90 % interval from", mm),
        "error_high_mm": ("... to", mm),
        "failure_probability": ("Probability that the fit failed", percent),
        "seen_share": ("Share of the model that the scan shows", percent),
        "model_matched_share": ("Share of the model's vertices with a match", percent),
        "model_allowed_share": ("Share of the model's vertices whose matches may count", percent),
        "scan_allowed_share": ("Share of the scan's points whose matches may count", percent),
        "model_near_share": ("Share of the model near the scan", percent),
        "scan_near_share": ("Share of the scan near the model", percent),
        "spread_mm": ("Robust residual SD", mm),
        "model_spread_mm": ("RMS distance of a vertex from the mean, over the training shapes", mm),
        "model_lack_mm": ("Off-model variation of new shapes (RMS)", mm),
        "beyond_model_mm": ("Off-model variation of this scan (RMS)", mm),
        "left_out_mm": ("Distance of the fitted surface from the span of the modes (RMS)", mm),
        "posterior_error_mm": ("Vertex error by the posterior (RMS)", mm),
        "z2": ("Mean squared coefficient, in variances of new shapes (about 1 is usual)", _plain),
        "z2_leading": ("... of the leading modes", _plain),
        "log_scale": ("Scale of the fit relative to the model", _size),
        "size_mm": ("Size of the mean at the scale of the fit: RMS distance from its centroid", mm),
        "start_score_mm": ("Score of the start (lower is better)", mm),
        "start_runner_up_score_mm": ("... of the best other start", mm),
        "layered_share": ("Share of the scan with two layers", percent),
        "layers_apart_mm": ("... distance of these layers", mm),
        "displaced_share": ("Share of the scan that runs along the surface at a distance from it", percent),
        "displaced_inward_share": ("... inside the surface", percent),
        "displaced_bound": ("... largest of held-out training shapes", percent),
        "displaced_moved_mm": ("... robust residual SD after a similarity moved it onto the surface", mm),
        "displaced_purity": ("... of the unexplained parts of the scan", percent),
        "scattered_share": ("Share of the scan that scatters widely around the surface", percent),
        "second_instance_mm": ("Distance of a second instance in the scan", mm),
        "second_instance_gap_mm": ("... gap between the two (negative: they overlap)", mm),
        "mirrored_log_odds": ("Log odds that the scan is mirrored (nats; above 5: mirrored, below -5: not)", _plain),
        "mirrored_bound": ("... largest of held-out training shapes (mirrored only above it)", _plain),
        "mirrored_apart_mm": ("... vertex error if it is mirrored (mean)", mm),
        "training_shapes": ("Number of training shapes of the model", _plain),
        "marks_stddev_mm": ("Standard deviation of the landmarks given", mm),
        "marks_rms_mm": ("RMS distance from the landmarks given", mm),
    }
)
"""Key -> its label, and the function that formats its value."""


def evidence_facts(values: Mapping[str, object], caption: str) -> Facts:
    """Return the evidence of a fit with labels, in the order of `EVIDENCE`; keys of other versions unchanged."""
    known = {key: value for key, value in values.items() if key in EVIDENCE and isinstance(value, int | float)}
    rows = [(EVIDENCE[key][0], EVIDENCE[key][1](float(known[key]))) for key in EVIDENCE if key in known]
    rows += [(words(key), setting(value)) for key, value in values.items() if key not in known]
    return Facts(rows, caption)


_Make = Callable[[SavedFit], Cell]


def fits_table(fits: Sequence[SavedFit], places: Mapping[str, str], *, caption: str) -> Table:
    """Return a table of all fits that sorts, without the columns that would be empty.

    Args:
        fits: fits in the order of the rows.
        places: anchors in the page by the names of the fits.
        caption: caption of the table.
    """
    columns: list[tuple[Head, _Make]] = [
        (Head("Scan"), lambda fit: Cell(fit.name, anchor=places.get(fit.name))),
        (Head("Label"), lambda fit: Cell(fit.label if fit.label != fit.name else "")),
        (Head("Status"), lambda fit: status(fit.status)),
        *((Head(head, "number"), make) for head, make in _NUMBERS),
    ]
    nonempty = [
        (column, cells)
        for column, cells in [(column, [make(fit) for fit in fits]) for column, make in columns]
        if any(cell.text if cell.value is None else isfinite(cell.value) for cell in cells)
    ]
    return Table(
        [column for column, _ in nonempty],
        [[cells[k] for _, cells in nonempty] for k in range(len(fits))],
        caption,
        sortable=len(fits) > 1,
    )


def _error(of: Callable[[SavedFit], VertexErrors | None], measure: str) -> _Make:
    return lambda fit: length(getattr(of(fit), measure, nan))


def _distance(direction: Direction, measure: Measure) -> _Make:
    return lambda fit: length(fit.distance_mm(direction, measure))


def _share(key: str) -> _Make:
    return lambda fit: number(100 * known(getattr(fit.record.shown, key, None)), 0)


def _total(values: Mapping[str, float], digits: int) -> Cell:
    return number(sum(values.values()) if values else nan, digits)


_NUMBERS: list[tuple[str, _Make]] = [
    ("True vertex error, mean", _error(lambda fit: fit.entry.vertex_error_mm, "mean")),
    ("True vertex error, max", _error(lambda fit: fit.entry.vertex_error_mm, "max")),
    ("Floor of that, mean", _error(lambda fit: fit.entry.floor_mm, "mean")),
    ("Expected vertex error", lambda fit: length(fit.expected_error_mm)),
    ("Model to scan where shown, mean", _distance("model_to_scan", "mean")),
    ("Model to scan where shown, 95 %", _distance("model_to_scan", "p95")),
    ("Scan to model where covered, mean", _distance("scan_to_model", "mean")),
    ("Scan to model where covered, 95 %", _distance("scan_to_model", "p95")),
    ("Model shown, %", _share("model_seen_share")),
    ("Scan covered, %", _share("scan_covered_share")),
    ("RMS of z", lambda fit: number(float(np.sqrt(np.mean(np.square(fit.record.z)))) if fit.record.z else nan, 1)),
    ("Steps", lambda fit: _total(fit.record.iterations, 0)),
    ("Seconds", lambda fit: _total(fit.record.seconds, 1)),
]


SCORE_WORDS: Mapping[str, str] = {
    "line_r2_through_neutral": "Share of the deviation on the line through neutral (R²)",
    "line_r2_free": "R² of the best line anywhere, relative to the scatter about the mean (so it may be lower)",
    "line_sign_consistency": "Share of faces on the same side of neutral",
    "line_spearman": "Rank correlation of position on the line with intensity",
    "line_permutation_p": "Its permutation p-value",
    "disjointness": "All expressions",
    "leave_one_out_accuracy": "Leave-one-out accuracy of the nearest mean direction",
    "chance": "Accuracy of guessing",
    "cosine_silhouette": "Silhouette of the directions (−1 to 1)",
    "separability": "Between-class over within-class scatter",
    "accuracy_p": "Permutation p-value of the accuracy",
    "silhouette_p": "Permutation p-value of the silhouette",
    "left_out": "Faces excluded because their fit is not trusted",
}


def score_tables(scores: Mapping[str, Any], *, many: str, single: str) -> list[Block]:
    """Return scores as tables: one of the scores of several classes, one of single values.

    Args:
        scores: name -> value, or name -> {class: value}.
        many: caption of the first table.
        single: caption of the second table.
    """

    def row(key: str, values: Sequence[object]) -> list[Cell]:
        return [
            Cell(SCORE_WORDS.get(key, words(key))),
            *map(
                Cell,
                [f"{value:.3f}" if isinstance(value, float) and abs(value) < 10 else plain(value) for value in values],
            ),
        ]

    by_thing = {key: _mapping(value) for key, value in scores.items() if key.startswith("line_")}
    out: list[Block] = []
    if by_thing:
        names = list(dict.fromkeys(name for value in by_thing.values() for name in value))
        out.append(
            Table(
                [Head("Score"), *(Head(name, "number") for name in names)],
                [row(key, [value.get(name) for name in names]) for key, value in by_thing.items()],
                many,
            )
        )
    rest = [
        row(name, [single_value])
        for key, value in scores.items()
        if key not in by_thing
        for name, single_value in (_mapping(value) or {key: value}).items()
    ]
    if rest:
        out.append(Table([Head("Score"), Head("Value", "number")], rest, single))
    return out or [Text("There are no scores.")]


_NOTHING: Mapping[str, Any] = {}
_CAPTION = "Settings and versions"
_OF: Mapping[str, type] = {
    "robust": RobustSettings, "paper": Paper, "dense_settings": DenseSettings, "residual": ResidualSettings,
}  # fmt: skip
_LEVEL = ("modes", "scan_points", "vertices", "triangles", "iterations", "stop_motion_mm")
_LEVEL_HEADS = (
    "Modes", "Points of the scan", "Vertices of the model", "Matched to", "Steps at most", "Stops below, mm",
)  # fmt: skip


def settings_blocks(configs: Sequence[Mapping[str, Any]], first: Sequence[tuple[str, str]]) -> list[Block]:
    """Return the settings of fits: choices as sentences, and the numbers of the method, folded.

    Args:
        configs: settings of each fit, from its record; they may be damaged.
        first: names and values of the first rows.
    """
    rows = list(first)
    for name, format_choice in _CHOICES:
        texts = list(dict.fromkeys(format_choice(config) for config in configs))
        if any(texts):
            rows.append((name, "; of others: ".join(texts[:4])))
    out: list[Block] = [Facts(rows, _CAPTION)]
    wanted = [
        *dict.fromkeys(str(config.get("method")) for config in configs),
        *(["dense_settings"] if any(config.get("dense") is True for config in configs) else []),
    ]
    for key in wanted:
        mappings = [_mapping(config.get(key)) for config in configs]
        values = next((value for value in mappings if value), _NOTHING)
        if not values:
            continue
        part_name = "the dense stage" if key == "dense_settings" else f"the {key} method"
        differs = " of the first fit; others differ" if any(value and value != values for value in mappings) else ""
        out.append(Folded(f"All numbers of {part_name}{differs}", _numbers(key, values, part_name)))
    return out


def described(cls: type) -> dict[str, str]:
    """Return the description of each argument of a class, from its docstring."""
    arguments = (inspect.getdoc(cls) or "").partition("Args:\n")[2].partition("\n\n")[0]
    return {
        name: " ".join(text.split()).strip(" ,;")
        for name, text in re.findall(r"^    (\w+): (.*(?:\n        .*)*)", arguments, re.MULTILINE)
    }


def _numbers(key: str, values: Mapping[str, Any], part_name: str) -> list[Block]:
    """Return tables of the settings of one part of the fit, with their meaning."""
    out: list[Block] = []
    rows: list[list[str]] = [
        ["all" if step.get(name) is None else _level(name, step[name]) for name in _LEVEL]
        for step in map(_mapping, _list(values.get("levels")))
    ]
    if rows:
        out.append(text_table(_LEVEL_HEADS, rows, "The steps from coarse to fine"))
    cells: list[list[str]] = []
    for name, value in _flat(key, values):
        owner, _, own = name.rpartition(".")
        cells.append([words(own), plain(value), (described(_OF[owner]).get(own, "") if owner in _OF else "") or DASH])
    return [*out, text_table(("Setting", "Value", "Meaning"), cells, f"Settings of {part_name}")]


def _level(name: str, value: object) -> str:
    kind = "triangles" if value else "vertices"
    return kind if name == "triangles" else f"{value:,}" if isinstance(value, int) else plain(value)


def _flat(key: str, values: Mapping[str, Any]) -> list[tuple[str, object]]:
    """Return (`owner.name`, value) of settings, nested ones too; without the steps, which have their own table."""
    out: list[tuple[str, object]] = []
    for name, value in values.items():
        if name == "levels":
            continue
        inner = _mapping(value)
        out += _flat(name, inner) if inner else [(f"{key}.{name}", value)]
    return out


def _mapping(value: object) -> Mapping[str, Any]:
    return cast(Mapping[str, Any], value) if isinstance(value, Mapping) else _NOTHING


def _list(value: object) -> list[object]:
    return cast(list[object], value) if isinstance(value, list) else []


def _modes(config: Mapping[str, Any]) -> str:
    return "all of the model" if (modes := config.get("modes")) is None else f"the first {plain(modes)}"


def _unit(config: Mapping[str, Any]) -> str:
    return "found from the size of each scan" if (unit := plain(config.get("unit"))) == "auto" else f"{unit}, as given"


def _scale(config: Mapping[str, Any]) -> str:
    effect = str(config.get("scale_in_effect", config.get("scale")))
    text = {"free": "free: each fit finds its own", "fixed": "fixed: scans and model have the same size"}.get(
        effect, plain(effect)
    )
    return f"{text}, as the model is made" if config.get("scale") == "auto" else text


_METHODS = {"robust": "robust: parts of the scan that do not match the model are excluded", "paper": "the paper's"}
_DENSE = {True: "made: the surface was moved onto the scan"}
_CHOICES: tuple[tuple[str, Callable[[Mapping[str, Any]], str]], ...] = (
    ("Method", lambda config: _METHODS.get(str(config.get("method")), plain(config.get("method")))),
    ("Modes", _modes),
    ("Unit of the scans", _unit),
    ("Size", _scale),
    ("Dense stage", lambda config: _DENSE.get(config.get("dense") is True, "not made")),
    ("Iterations", lambda config: f"at most {plain(config.get('max_iterations'))} in each phase"),
    ("Random numbers", lambda config: f"from seed {plain(config.get('seed'))}"),
)
