"""Parts that the pages share: the model, one fit in detail, a gallery and a table of fits, fits together, scores."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from shapespace.errors import ShapespaceError
from shapespace.report.markup import (
    Cell,
    Column,
    as_list,
    as_mapping,
    counted,
    esc,
    facts,
    folded,
    length,
    listed,
    mm,
    number,
    paragraph,
    percent,
    plain,
    status,
    table,
    words,
)
from shapespace.report.page import Page
from shapespace.report.saved import SavedFit
from shapespace.types import FloatArray

if TYPE_CHECKING:
    from shapespace.model.shape_model import ShapeModel
    from shapespace.report.figures import Coefficients
    from shapespace.report.staged import StagedFit
    from shapespace.report.stills import Still

ORDER_OF_CONCERN = ("failed", "unreadable", "doubtful", "max_iterations", "converged")
"""Statuses, those first that somebody must look at."""

MODEL_PICTURES, FIT_PICTURES = 4, 9
"""How many pictures `model_part`, and `fit_to_turn` with `fit_pictures`, make."""

MODES_IN_WIDGET = 8
SCAN_TRIANGLES = 8_000
"""How many triangles of a scan turn in the page; the file of the scan has them all."""

_VARIANCE_SHARES = (0.90, 0.95, 0.98, 0.99)


def concern(fit: SavedFit) -> tuple[int, float]:
    """Return a key that sorts fits by how much they need a look: by status, then by the error expected or seen."""
    rank = ORDER_OF_CONCERN.index(fit.status) if fit.status in ORDER_OF_CONCERN else 0
    error = expected_error_mm(fit)
    if not math.isfinite(error):
        error = fit.summary_mm("final", "scan_to_model", "mean")
    return rank, -error if math.isfinite(error) else 0.0


def expected_error_mm(fit: SavedFit) -> float:
    """Return the vertex error that the fit expects of itself, mm; not-a-number where it does not say."""
    value = as_mapping(fit.record.get("evidence")).get("expected_error_mm")
    return float(value) if isinstance(value, int | float) else float("nan")


def in_columns(pictures: str) -> str:
    """Return pictures in two columns where the window has room for them."""
    return f'<div class="columns">{pictures}</div>\n'


# The model


def model_part(page: Page, model: ShapeModel, *, figure_of: str = "", to_move: int = MODES_IN_WIDGET) -> str:
    """Return what the model is and does: facts, modes to move by hand, modes as stills, spectrum.

    Args:
        page: that it goes to.
        model: the shape space.
        figure_of: said before the caption of the modes.
        to_move: how many modes can be moved by hand.
    """
    from shapespace.report import figures

    needed = [
        f"{100 * share:g} % in {counted(count, 'mode')}"
        for share in _VARIANCE_SHARES
        if (count := model.modes_for_variance(share)) is not None
    ]
    rows = [
        ("Made of", counted(model.n_training, "shape")),
        ("Surface", f"{model.n_vertices:,} vertices, {0 if model.faces is None else len(model.faces):,} triangles"),
        ("Modes kept", f"{model.n_modes}, with {100 * float(model.cumulative_variance[-1]):.1f} % of the variance"),
        ("Variance", listed(needed) or "below 90 % in the modes kept"),
        ("Size", "divided out (gauge shape)" if model.gauge == "shape" else "kept in the modes (gauge form)"),
        ("Provenance", model.provenance),
        ("Licence", model.licence or "not stated"),
    ]
    shown = min(5, model.n_modes)
    out = facts(rows, caption="The shape model") + modes_to_move(page, model, to_move)
    pictures = page.figure(
        figures.modes_figure(model, modes=shown),
        f"{figure_of}Each row: the mean with one mode at −3, 0 and +3 standard deviations, and how far each point "
        "moves at 3. One scale for all rows.",
        alt=f"Mean shape and the first {counted(shown, 'mode')} at minus and plus three standard deviations, with maps "
        "of the displacement",
    )
    pictures += page.figure(
        figures.spectrum_figure(model),
        "Share of the training set's variance that the first modes hold.",
        alt=f"Spectrum: {listed(needed) or 'the modes kept hold less than 90 % of the variance'}",
        chart=True,
    )
    sides = page.figure(
        figures.mean_figure(model),
        "The mean shape from three sides" + (", with the model's landmarks." if model.landmarks else "."),
        alt="The mean shape from three sides",
    )
    return out + in_columns(pictures + sides)


def quality_part(page: Page, quality: Mapping[str, Any]) -> str:
    """Return how good the shape space is by its number of modes, from the measures of it that are there."""
    from shapespace.report import figures

    return page.figure(
        figures.quality_figure(quality),
        "Compactness: share of the variance. Generalisation: error on shapes left out. Specificity: distance of random "
        "shapes from the nearest training shape.",
        alt="Compactness, generalisation and specificity by the number of modes, those of them that were measured",
        chart=True,
    )


def modes_to_move(page: Page, model: ShapeModel, most: int) -> str:
    """Return the model's modes with sliders, as stills of the mean where nothing turns."""
    from shapespace.report import stills
    from shapespace.report.scene import pack_model
    from shapespace.types import Mesh

    count = min(most, model.n_modes)
    still = stills.mesh_still(Mesh(model.mean_vertices, model.faces, name="mean"), (420, 420))
    return page.turning(
        "modes",
        pack_model(model, count, small=True),
        page.image(still.data, still.size, alt="The mean shape"),
        f"The first {counted(count, 'mode')} of {model.n_modes}, to be moved by hand."
        if count < model.n_modes
        else f"{'Its' if count == 1 else 'All'} {counted(count, 'mode')}, to be moved by hand.",
        label="Modes of the model, one slider each",
        still="The still shows the mean.",
    )


# One fit


def fit_to_turn(page: Page, fit: StagedFit) -> str:
    """Return scan and model of one fit, as a strip of stills where nothing turns."""
    from shapespace.report import stills
    from shapespace.report.scene import pack_fit

    limit_mm = fit.scale_mm
    scale = (
        f"the signed distance to the scan, −{limit_mm:g} (blue) to +{limit_mm:g} mm (red)."
        if fit.scan.faces is not None
        else f"the distance to the points of the scan, 0 to {limit_mm:g} mm."
    )
    still = stills.fit_strip(fit, limit_mm, (300, 372))
    return page.turning(
        "fit",
        pack_fit(fit, largest_scan=SCAN_TRIANGLES),
        page.image(still.data, still.size, alt=strip_alt(fit, limit_mm)),
        f"{fit.label}: the scan, and the model at each stage.",
        label=f"Scan and model of {fit.label}, to be turned",
        still=f"The still shows the scan, both over each other, and {scale}",
    )


def strip_alt(fit: StagedFit, limit_mm: float) -> str:
    """Return what is seen in `stills.fit_strip`, in words."""
    return (
        f"{fit.label}: the scan, scan and model over each other, and a map of the distances; "
        f"{share_within(fit, limit_mm)} of what the scan shows lies within {limit_mm:g} mm"
    )


def share_within(fit: StagedFit, limit_mm: float) -> str:
    """Return the share of the vertices that the scan shows which lie within `limit_mm` of it."""
    known = _known(fit, "final")
    return percent(float((known <= limit_mm).mean())) if len(known) else "none"


def _known(fit: StagedFit, stage: str) -> FloatArray:
    distances = np.abs(fit.model_to_scan_mm[stage])
    return distances[np.isfinite(distances)]


def fit_pictures(page: Page, fit: StagedFit, population: FloatArray | None = None) -> str:
    """Return every picture of one fit.

    Args:
        page: that they go to.
        fit: with its stages.
        population: (N, K) coefficients of others in standard deviations, or None.
    """
    from shapespace.report import figures

    shares = [f"{share_within(fit, limit)} within {limit} mm" for limit in (2, 4, 6, 8, 10)]
    stages = {"before": "before", "initial": "after phase 1", "final": "after phase 2", "dense": "dense"}
    largest = [
        f"{mm(float(_known(fit, stage).max(initial=0.0)))} {said}"
        for stage, said in stages.items()
        if stage in fit.surfaces
    ]
    z = fit.z
    parts: list[Callable[[], str]] = [
        lambda: page.figure(
            figures.stages_figure(fit),
            "The scan, and the model at each stage of the fit, in the frame of the final pose.",
            alt=f"Scan and model of {fit.label} by stage; largest distance from model to scan {listed(largest)}",
        ),
        lambda: page.figure(
            figures.overlay_figure(fit),
            "Scan and model over each other, the nearer one shown: where they alternate finely, they coincide.",
            alt=f"Scan and model of {fit.label} over each other at each stage",
        ),
        lambda: page.figure(
            figures.signed_maps(fit),
            "Signed distances both ways, positive where the scan lies outside of the model; those of a scan of points "
            "only have no sign. Scan points beyond the model's rim are not counted.",
            alt=f"Signed distance maps of {fit.label}, model to scan and scan to model",
        ),
        lambda: page.figure(
            figures.regions_figure(fit),
            "What the fit made of each part of the model: it followed the scan, rejected what the scan shows there, "
            "lay at the scan's border, or was not seen.",
            alt=f"Regions of {fit.label}: {region_shares(fit)}",
        ),
        lambda: page.figure(
            figures.threshold_figure([fit]),
            "Where the model lies within 2 to 10 mm of the scan. Above each panel: share of the vertices that the scan "
            "shows.",
            alt=f"Maps of {fit.label}: {listed(shares)}",
        ),
        lambda: page.figure(
            figures.distance_histograms(fit),
            "Closest distances both ways, by stage.",
            alt=f"Histograms of closest distances of {fit.label}; largest from model to scan {listed(largest)}",
        ),
        lambda: page.figure(
            figures.history_figure(fit),
            "RMS of the closest distances that the fit itself sees, by phase.",
            alt=f"RMS of {fit.label} falls from {mm(fit.history[0].rms_mm)} to {mm(fit.history[-1].rms_mm)} in "
            f"{counted(len(fit.history), 'step')}"
            if fit.history
            else f"RMS of {fit.label}: no iteration was saved",
            chart=True,
        ),
        lambda: page.figure(
            figures.coefficients_figure(fit, population=population),
            "Coefficients in standard deviations of the training set, with their own uncertainty. Beyond about 3 they "
            "are rare in it.",
            alt=f"Coefficients of {fit.label}: " + ", ".join(f"{value:.1f}" for value in z[:10]),
            chart=True,
        ),
    ]
    return in_columns("".join(page.tried(part) for part in parts))


def region_shares(fit: StagedFit) -> str:
    """Return the share of each region in words."""
    from shapespace.report.staged import REGIONS

    counts = np.bincount(fit.regions, minlength=len(REGIONS)) / max(len(fit.regions), 1)
    return listed([f"{name} {percent(float(share))}" for name, share in zip(REGIONS, counts, strict=True)])


def fit_facts(fit: SavedFit) -> str:
    """Return status, reason and notes of one fit, and its evidence folded away."""
    notes = [str(note) for note in as_list(fit.record.get("notes"))]
    out = f"<p>{status(fit.status).html}: {esc(fit.reason)}</p>\n"
    if notes:
        out += '<ul class="soft">' + "".join(f"<li>{esc(note)}</li>" for note in notes) + "</ul>\n"
    evidence = as_mapping(fit.record.get("evidence"))
    if evidence:
        rows = [(words(key), plain(value)) for key, value in evidence.items()]
        out += folded("What the verdict goes by", facts(rows, caption=f"Evidence of {fit.name}"))
    return out


# Many fits


@dataclass(frozen=True)
class Card:
    """One fit in the gallery.

    Args:
        fit: what is known of it.
        place: name of the card in the page.
        still: its picture, or None.
        alt: the picture in words.
        why_none: why there is no picture.
        detail: name of the place with all its pictures, or None.
    """

    fit: SavedFit
    place: str
    still: Still | None
    alt: str = ""
    why_none: str = ""
    detail: str | None = None


def gallery(page: Page, cards: Sequence[Card]) -> str:
    """Return cards in the order given, each with picture, verdict and the reason for it."""

    def card(one: Card) -> str:
        fit = one.fit
        picture = (
            f'<div class="plate">{page.image(one.still.data, one.still.size, alt=one.alt)}</div>'
            if one.still
            else f'<p class="plate none">{esc(one.why_none)}</p>'
        )
        seen = fit.summary_mm("final", "scan_to_model", "mean")
        told = f"Scan to model {mm(seen)} on average. " if math.isfinite(seen) else ""
        more = f'<p><a href="#{esc(one.detail)}">All pictures of {esc(fit.name)}</a></p>' if one.detail else ""
        label = fit.label if fit.label != fit.name else ""
        return (
            f'<li class="card" id="{esc(one.place)}">{picture}<h4>{esc(fit.name)}</h4>'
            f"<p>{status(fit.status).html}{f' · {esc(label)}' if label else ''}</p>"
            f'<p class="soft">{esc(told + fit.reason)}</p>{more}</li>\n'
        )

    return '<ul class="gallery">\n' + "".join(card(one) for one in cards) + "</ul>\n"


def scale_key(page: Page, limit_mm: float) -> str:
    """Return the key of the strips in a gallery: their colours and the scale of their maps."""
    from shapespace.report import stills

    bar = stills.colour_bar()
    colours = page.image(bar.data, bar.size, alt="from blue over pale to red")
    return (
        '<div class="key"><p>Each strip, from the left: the scan; scan (orange) and model (blue) over each other, the '
        "nearer one shown; the distance from the model to the scan, one scale for all:</p>"
        f'<p class="bar"><span>−{limit_mm:g} mm, scan inside</span>{colours}'
        f"<span>+{limit_mm:g} mm, scan outside</span></p><p>Grey is what the scan does not show. Distances to a "
        f"scan of points only have no sign: their map runs from 0 to {limit_mm:g} mm.</p></div>\n"
    )


def common_limit_mm(fits: Sequence[StagedFit]) -> float:
    """Return the end of the scale that strips of these fits share: that of the usual fit."""
    from shapespace.report.staged import nice_ceiling

    return nice_ceiling(float(np.median([fit.scale_mm for fit in fits]))) if fits else 1.0


def fits_table(fits: Sequence[SavedFit], places: Mapping[str, str], *, caption: str) -> str:
    """Return a table of all fits that sorts, without the columns that would be empty.

    Args:
        fits: in the order wanted.
        places: where in the page a fit is shown, by its name.
        caption: of the table.
    """

    def name(fit: SavedFit) -> Cell:
        place = places.get(fit.name)
        return Cell(fit.name, None, f'<a href="#{esc(place)}">{esc(fit.name)}</a>' if place else None)

    def steps(fit: SavedFit) -> Cell:
        values = [int(value) for value in as_mapping(fit.record.get("iterations")).values()]
        return number(float(sum(values)) if values else float("nan"), 0)

    def seconds(fit: SavedFit) -> Cell:
        values = [float(value) for value in as_mapping(fit.record.get("seconds")).values()]
        return number(sum(values) if values else float("nan"), 1)

    def spread(fit: SavedFit) -> Cell:
        z = fit.record.get("z")
        return number(float(np.sqrt(np.mean(np.square(fit.numbers("z"))))) if z else float("nan"), 1)

    def counted_share(fit: SavedFit) -> Cell:
        return number(100 * fit.summary_mm("final", "scan_to_model", "fraction"), 0)

    def label(fit: SavedFit) -> Cell:
        return Cell(fit.label if fit.label != fit.name else "")

    def inner(key: str, measure: str) -> Callable[[SavedFit], Cell]:
        def value(fit: SavedFit) -> Cell:
            found = as_mapping(fit.entry.get(key)).get(measure)
            return length(float("nan") if found is None else float(found))

        return value

    def distance(direction: str, measure: str) -> Callable[[SavedFit], Cell]:
        return lambda fit: length(fit.summary_mm("final", direction, measure))

    columns: list[tuple[Column, Callable[[SavedFit], Cell]]] = [
        (Column("Scan"), name),
        (Column("Label"), label),
        (Column("Status"), lambda fit: status(fit.status)),
        (Column("True vertex error, mean", "number"), inner("vertex_error_mm", "mean")),
        (Column("True vertex error, max", "number"), inner("vertex_error_mm", "max")),
        (Column("Floor of that, mean", "number"), inner("floor_mm", "mean")),
        (Column("Expected vertex error", "number"), lambda fit: length(expected_error_mm(fit))),
        (Column("Scan to model, mean", "number"), distance("scan_to_model", "mean")),
        (Column("Scan to model, 95 %", "number"), distance("scan_to_model", "p95")),
        (Column("Model to scan, mean", "number"), distance("model_to_scan", "mean")),
        (Column("Model to scan, max", "number"), distance("model_to_scan", "max")),
        (Column("Scan counted, %", "number"), counted_share),
        (Column("RMS of z", "number"), spread),
        (Column("Steps", "number"), steps),
        (Column("Seconds", "number"), seconds),
    ]
    cells = [(column, [make(fit) for fit in fits]) for column, make in columns]
    kept = [
        (column, made)
        for column, made in cells
        if any(cell.text if cell.value is None else math.isfinite(cell.value) for cell in made)
    ]
    rows = [[made[k] for _, made in kept] for k in range(len(fits))]
    return table([column for column, _ in kept], rows, caption=caption, sortable=len(fits) > 1)


def usable(fits: Sequence[SavedFit], load: Callable[[SavedFit], StagedFit]) -> tuple[list[StagedFit], list[str]]:
    """Return the fits whose stages can be read, and one sentence for each that cannot."""
    found: list[StagedFit] = []
    problems: list[str] = []
    for fit in fits:
        try:
            found.append(load(fit))
        except ShapespaceError as error:
            problems.append(str(error))
    return found, problems


# Coefficients


def coefficients_of(fit: SavedFit) -> Coefficients:
    """Return the coefficients of one fit with its label."""
    from shapespace.report.figures import Coefficients

    return Coefficients(
        fit.name,
        str(fit.entry.get("expression") or ""),
        float(fit.entry.get("intensity") or 0),
        fit.numbers("b"),
        fit.numbers("z"),
    )


def scatter(page: Page, points: Sequence[Coefficients]) -> str:
    """Return the first coefficients of many fits against each other, coloured by label."""
    from shapespace.report import figures

    labels = list(dict.fromkeys(point.expression for point in points if point.expression))
    coloured = f", coloured by label: {listed(labels)}" if len(labels) > 1 else ""
    out = page.figure(
        figures.scatter_matrix(points),
        f"The first coefficients of {counted(len(points), 'fit')} against each other{coloured}.",
        alt=f"Scatter matrix of the first coefficients of {counted(len(points), 'fit')}{coloured}",
    )
    if all(len(point.b) >= 3 for point in points):
        out += page.tried(lambda: scatter_to_turn(page, points))
    return out


def lines_through_neutral(
    page: Page, points: Sequence[Coefficients], neutral: Coefficients | None, *, figures_of: Sequence[str] = ("", "")
) -> str:
    """Return the line structure of one subject's expressions in two and in three coefficients (figures 9 and 10).

    Args:
        page: that it goes to.
        points: the expressive fits, with at least two coefficients.
        neutral: the fit of the neutral face, through which the lines pass; None draws none.
        figures_of: said before the two captions.
    """
    from shapespace.report import figures

    about = (
        "Larger marks are stronger expressions. Lines pass through the fitted neutral face and fit best in all "
        "coefficients, each in its standard deviations."
    )
    if neutral is None:
        about = "Larger marks are stronger expressions. No neutral face was fitted, so no lines are drawn."
    lines: dict[str, FloatArray | None] = {
        "neutral_b": None if neutral is None else neutral.b,
        "neutral_z": None if neutral is None else neutral.z,
    }
    pictures = page.figure(
        figures.b_plane(points, title="Expressions in the first two coefficients", **lines),
        f"{figures_of[0]}{about}",
        alt=f"Scatter plot of b1 and b2 for {counted(len(points), 'face')}: each expression runs along its own line",
        chart=True,
    )
    if all(len(point.b) >= 3 for point in points):
        pictures += page.figure(
            figures.b_space(points, title="The first three coefficients, from two sides", **lines),
            f"{figures_of[1]}Grey lines drop to the floor of the box.",
            alt=f"Two views of b1, b2 and b3 for {counted(len(points), 'face')} with a line for each expression",
        )
    return in_columns(pictures)


def scatter_to_turn(page: Page, points: Sequence[Coefficients]) -> str:
    """Return b1, b2 and b3 in space, as a still where nothing turns."""
    from shapespace.report import figures
    from shapespace.report.scene import pack_scatter

    data, size = figures.encode_webp(figures.scatter_3d(points), lossless=True)
    first = np.stack([point.b[:MODES_IN_WIDGET] for point in points])
    return page.turning(
        "scatter",
        pack_scatter(
            first,
            [point.expression or "no label" for point in points],
            [point.name for point in points],
            axes=[f"b{k + 1}" for k in range(first.shape[1])],
        ),
        page.image(data, size, alt=f"b1, b2 and b3 of {counted(len(points), 'fit')} in space"),
        "Coefficients of all fits in space, in mm.",
        label="Scatter of three coefficients, to be turned",
        still="The still shows the first three from two sides.",
    )


def setting(value: object) -> str:
    """Return a setting as text; one with parts is told by those that are plain."""
    inner = as_mapping(value)
    if inner:
        return plain({key: item for key, item in inner.items() if not isinstance(item, dict | list)})
    return plain(value)


# Scores


SCORE_WORDS: Mapping[str, str] = {
    "line_r2_through_neutral": "Share of the deviation on the line through neutral (R²)",
    "line_r2_free": "R² of the best line anywhere, of the scatter about the mean (a smaller whole, so it may be lower)",
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
    "left_out": "Faces left out because their fit is not trusted",
}


def score_tables(scores: Mapping[str, Any], *, many: str, single: str) -> str:
    """Return scores as tables: those given for each of several things as one, single values as another.

    Args:
        scores: name -> value, or name -> {thing: value}.
        many: caption of the first.
        single: caption of the second.
    """

    def said(key: str) -> str:
        return SCORE_WORDS.get(key, words(key))

    by_thing = {key: as_mapping(value) for key, value in scores.items() if key.startswith("line_")}
    out = ""
    if by_thing:
        names = list(dict.fromkeys(str(name) for value in by_thing.values() for name in value))
        rows = [[Cell(said(key)), *(Cell(score(value.get(name))) for name in names)] for key, value in by_thing.items()]
        out += table([Column("Score"), *(Column(name, "number") for name in names)], rows, caption=many)
    rest: list[list[Cell]] = []
    for key, value in scores.items():
        if key in by_thing:
            continue
        inner = as_mapping(value)
        pairs = inner.items() if inner else [(key, value)]
        rest += [[Cell(said(str(name))), Cell(score(item))] for name, item in pairs]
    if rest:
        out += table([Column("Score"), Column("Value", "number")], rest, caption=single)
    return out or paragraph("There are no scores.")


def score(value: object) -> str:
    """Return a score with three decimals, as they are compared with each other."""
    return f"{value:.3f}" if isinstance(value, float) and abs(value) < 10 else plain(value)
