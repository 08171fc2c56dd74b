"""The report of a folder that `shapespace fit` wrote."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shapespace import __version__
from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.io.files import sha256_of_file
from shapespace.io.labels import Label
from shapespace.io.meshes import read_mesh
from shapespace.report import recognition, sections
from shapespace.report.labels import find_labels, labelled
from shapespace.report.markup import (
    Cell,
    Column,
    as_mapping,
    counted,
    esc,
    facts,
    folded,
    listed,
    mm,
    notice,
    paragraph,
    table,
    tiles,
    words,
)
from shapespace.report.page import Page, Section, Step
from shapespace.report.saved import Folder, SavedFit, model_of, staged_fit
from shapespace.types import FloatArray, Mesh

if TYPE_CHECKING:
    from shapespace.model.shape_model import ShapeModel
    from shapespace.report.sections import Card
    from shapespace.report.staged import StagedFit

MOST_CARDS = 24
MOST_EMPTY_CARDS = 6
MOST_DETAILS = 3
MOST_ROWS = 2000
MOST_CURVES = 100
_MOST_NAMED = 12
_WITHOUT_RESULT = ("failed", "unreadable")
_FEWEST_POINTS = 20
_FEWEST_LEVELS = 2
_ADVICE = "fit the scans again"
_RESERVE_BYTES = 400_000
_DETAIL_BYTES = 1_300_000


class FolderPage:
    """The report of a folder of fits in the making.

    Args:
        folder: that the fits lie in.
        fits: found there, one or more.
        model: the model's file, or None to go by the records.
        labels: a table of labels, or None to look for one.
        on_step: told of each picture.
    """

    def __init__(
        self,
        folder: Folder,
        fits: Sequence[SavedFit],
        *,
        model: Path | None = None,
        labels: Path | None = None,
        on_step: Step | None = None,
    ) -> None:
        self.folder = folder
        self.recognised = (folder.root / recognition.FILE).is_file()
        self.label_note = ""
        found: Mapping[str, Label] = {}
        try:
            found, self.label_note = find_labels(folder, fits, labels)
        except ShapespaceError as error:
            if labels is not None:
                raise
            self.label_note = f"There are no labels: {error}"
        self.fits = sorted((labelled(fit, found) for fit in fits), key=sections.concern)
        planned = (
            sections.MODEL_PICTURES + min(len(fits), MOST_CARDS) + 4 + len(self.main_fits()) * sections.FIT_PICTURES
        )
        self.page = Page(_ADVICE, planned, on_step)
        self.model_path = model
        self._model: ShapeModel | None = None
        if model is not None:
            self.model()
        self._staged: dict[str, StagedFit] = {}
        self._details: dict[str, str] = {}
        self._cards: dict[str, str] = {}

    # What is read, once

    def model(self) -> ShapeModel:
        """Return the model of the fits."""
        if self._model is None:
            self._model = model_of(self.folder, self.fits, self.model_path)
        return self._model

    def staged(self, fit: SavedFit) -> StagedFit:
        """Return what pictures of `fit` need, called by its name."""
        if fit.name not in self._staged:
            self._staged[fit.name] = replace(staged_fit(self.folder, fit), label=fit.name)
        return self._staged[fit.name]

    # The page

    def html(self) -> str:
        """Return the page."""
        count = len(self.fits)
        name = self.folder.root.resolve().name
        self._details = {fit.name: self.page.place(f"pictures-of-{fit.name}") for fit in self.main_fits()}
        if count > 1 or not self._details:
            self._cards = {fit.name: self.page.place(f"fit-{fit.name}") for fit in self.carded()}
        parts = [
            Section("Summary", "Summary", self.summary),
            Section("The model", "Model", self.model_part),
            Section("The fits", "Fits", self.fits_part),
        ]
        if self.recognised:
            parts.append(Section("Recognition", "Recognition", self.recognition))
        parts.append(Section("Settings, versions and hashes", "Settings", self.settings))
        lead = paragraph(
            "What a statistical shape model made of raw surfaces. Distances are in millimetres of the model's frame."
        )
        return self.page.html(
            f"{counted(count, 'fit')} in {name}",
            lead,
            f"Made by shapespace {__version__} from the files in {name}.",
            parts,
        )

    def model_part(self) -> str:
        """Return the model, with what quality.json says of it where there is such a file."""
        out = sections.model_part(self.page, self.model())
        if (self.folder.root / "quality.json").is_file():
            out += self.page.tried(lambda: sections.quality_part(self.page, self.folder.json("quality.json")))
        return out

    def main_fits(self) -> list[SavedFit]:
        """Return the fits shown with every picture: the worst doubtful one, the worst and the median of the others."""
        pictured = [fit for fit in self.fits if fit.pictured]
        if len(pictured) <= MOST_DETAILS:
            return pictured
        doubtful = [fit for fit in pictured if fit.status == "doubtful"]
        others = [fit for fit in pictured if fit.status != "doubtful"]
        chosen = doubtful[: 1 if others else MOST_DETAILS]
        if others:
            chosen += [others[k] for k in sorted({0, len(others) // 2})]
        return chosen

    def carded(self) -> list[SavedFit]:
        """Return the fits of the gallery; where not all have room, those without a result leave some to the others."""
        if len(self.fits) <= MOST_CARDS:
            return self.fits
        empty = [fit for fit in self.fits if fit.status in _WITHOUT_RESULT]
        rest = [fit for fit in self.fits if fit.status not in _WITHOUT_RESULT]
        first = empty[: max(MOST_EMPTY_CARDS, MOST_CARDS - len(rest))]
        return [*first, *rest[: MOST_CARDS - len(first)]]

    def summary(self) -> str:
        """Return what was fitted and how much of it is to be trusted."""
        counts = Counter(fit.status for fit in self.fits)
        total, trusted = len(self.fits), [fit for fit in self.fits if fit.status == "converged"]
        models = sorted(
            {str(as_mapping(fit.record.get("model")).get("name") or "an unknown model") for fit in self.fits}
        )
        methods = sorted({str(fit.record["method"]) for fit in self.fits if fit.record.get("method")})
        told = f"{counted(total, 'scan was', 'scans were')} fitted with {listed(models)}"
        told += f" by the {listed(methods)} method{'s' if len(methods) > 1 else ''}. " if methods else ". "
        told += counted(len(trusted), "fit") if trusted else "None"
        told += (
            " converged with nothing found against them" if len(trusted) != 1 else " converged with nothing against it"
        )
        rest = [
            f"{counts[key]} {word}"
            for key, word in (
                ("max_iterations", "stopped at the limit of steps"),
                ("doubtful", "doubtful"),
                ("failed", "could not be fitted"),
                ("unreadable", "cannot be read"),
            )
            if counts[key]
        ]
        told += f"; {listed(rest)}." if rest else "."
        expected = _median([sections.expected_error_mm(fit) for fit in trusted])
        to_model = _median([fit.summary_mm("final", "scan_to_model", "mean") for fit in trusted])
        to_scan = _median([fit.summary_mm("final", "model_to_scan", "mean") for fit in trusted])
        rows = [
            (str(len(trusted)), f"of {total}", "with nothing found against them"),
            (str(counts["doubtful"] + counts["max_iterations"]), "", "to be looked at before use"),
            (str(counts["failed"] + counts["unreadable"]), "", "without a result"),
        ]
        for value, what in (
            (expected, "vertex error that such a fit expects of itself, median"),
            (to_model, "mean distance from scan to model, median of those"),
            (to_scan, "mean distance from model to scan, median of those"),
        ):
            if np.isfinite(value):
                rows.append((mm(value).removesuffix(" mm"), "mm", what))
        return (
            paragraph(told)
            + tiles(rows)
            + self.other_models()
            + self.doubts()
            + self.page.guarded("Main figures", self.main_figures)
        )

    def other_models(self) -> str:
        """Return which fits are by another model than the one shown, where one was given."""
        if self.model_path is None:
            return ""
        shown = self.model_hash()
        others = [
            fit.name
            for fit in self.fits
            if fit.status not in _WITHOUT_RESULT and _source(fit, "model", "hash") != shown
        ]
        return notice(f"Fitted with another model than {self.model_path.name}", others)

    def doubts(self) -> str:
        """Return the fits that need a look, by name and reason."""
        bad = [fit for fit in self.fits if fit.status != "converged"]
        if not bad:
            return ""
        items = ""
        for fit in bad[:_MOST_NAMED]:
            place = self._cards.get(fit.name) or self._details.get(fit.name)
            name = f'<a href="#{esc(place)}">{esc(fit.name)}</a>' if place else esc(fit.name)
            items += f"<li>{name}: {esc(_words_of(fit))}. {esc(fit.reason)}</li>"
        more = len(bad) - _MOST_NAMED
        if more > 0:
            items += f"<li>{counted(more, 'other')}, in the table of all fits.</li>"
        return f'<div class="notice"><strong>Not to be trusted without a look</strong><ul>{items}</ul></div>\n'

    def main_figures(self) -> str:
        """Return the main fits side by side, and how near all of them come."""
        from shapespace.report import figures

        shown, problems = sections.usable(self.main_fits(), self.staged)
        if not shown:
            return self.without_stages(problems)
        status = {fit.name: _words_of(fit) for fit in self.fits}
        figure = figures.portrait_figure(
            shown,
            [f"{fit.name} ({status[fit.name]})" for fit in shown],
            title="Raw scans and the model fitted to them",
        )
        which = (
            "All fits. "
            if len(shown) == len(self.fits)
            else "The doubtful fit that needs a look most, and of the others the worst and the median. "
            if any(fit.status == "doubtful" for fit in shown)
            else "The worst and the median fit. "
        )
        pictures = self.page.figure(
            figure,
            f"{which}The last column maps the distance from the model to the scan, all rows on one scale.",
            alt="Scan, fitted model, both over each other, and a distance map, for "
            + listed([f"{fit.name} ({status[fit.name]})" for fit in shown]),
        )
        if len(self.fits) > 1:
            pictures += self.page.tried(self.curves)
        return sections.in_columns(pictures) + notice("Not in the pictures", problems)

    def curves(self) -> str:
        """Return which share of the surface lies within each distance."""
        from shapespace.report import figures

        pictured = [fit for fit in self.fits if fit.pictured]
        shown, _ = sections.usable(pictured[:MOST_CURVES], self.staged)
        some = f" The first {MOST_CURVES} fits of the table." if len(pictured) > MOST_CURVES else ""
        return self.page.figure(
            figures.error_curves(shown),
            "Share of the model's vertices that lie within each distance of the scan, one curve a fit. Vertices at "
            f"which the scan shows nothing are not counted.{some}",
            alt=f"Cumulative distances of {counted(len(shown), 'fit')}",
            chart=True,
        )

    def without_stages(self, problems: Sequence[str]) -> str:
        """Return why there are no pictures of the fit itself, what adds them, and stills of what there is."""
        fitted = [fit for fit in self.fits if fit.status not in _WITHOUT_RESULT]
        if not fitted:
            return paragraph("There is no fit to show.", "broken")
        model = _source(fitted[0], "model", "path") or "MODEL.h5"
        scan = _source(fitted[0], "scan", "path") or "SCAN"
        scans = str(Path(str(scan)).parent) if len(fitted) > 1 else str(scan)
        out = ""
        if not any(fit.pictured for fit in fitted):
            out += (
                "<p>The stages of these fits were not saved, so there are no distance maps, overlays and surfaces to "
                "turn; this adds them, run in the folder of the results:</p>\n"
                f"<pre><code>{esc(f'shapespace fit {model} {scans} -o . --stages --resume')}</code></pre>\n"
            )
        return out + notice("Not in the pictures", problems)

    # Fits

    def fits_part(self) -> str:
        """Return the gallery, the table, the fits together, and the main ones in detail."""
        page = self.page
        parts: list[str] = []
        if self._cards:
            heading = "All fits" if len(self.fits) <= MOST_CARDS else f"The {MOST_CARDS} fits to look at first"
            parts.append(page.guarded(heading, self.gallery))
        parts.append(page.guarded("Every fit in numbers", self.numbers))
        if sum(fit.status not in _WITHOUT_RESULT for fit in self.fits) > 1:
            parts.append(page.guarded("The fits together", self.together))
        for fit in self.main_fits():
            parts.append(
                page.guarded(f"{fit.name} in detail", lambda fit=fit: self.detail(fit), place=self._details[fit.name])
            )
        return "\n".join(parts)

    def gallery(self) -> str:
        """Return a card for each of the first fits: failed and doubtful first, then by their error."""
        from shapespace.report import stills

        chosen = self.carded()
        sample, _ = sections.usable([fit for fit in chosen if fit.pictured], self.staged)
        good = [fit for fit in sample if fit.status == "converged"]
        limit = sections.common_limit_mm(good or sample)
        cards: list[Card] = []
        for fit in chosen:
            still, alt, why = None, "", ""
            try:
                if fit.pictured:
                    staged = self.staged(fit)
                    still, alt = stills.fit_strip(staged, limit), sections.strip_alt(staged, limit)
                elif fit.entry.get("fitted") and fit.status not in _WITHOUT_RESULT:
                    still, alt = stills.mesh_still(self.posed(fit)), f"The fitted surface of {fit.name}"
                else:
                    still, alt = stills.mesh_still(self.raw_scan(fit)), f"The raw scan {fit.name}, as its axes stand"
            except ShapespaceError as error:
                why = f"No picture: {error}"
            cards.append(sections.Card(fit, self._cards[fit.name], still, alt, why, self._details.get(fit.name)))
            self.page.step(fit.name)
        out = paragraph("Failed and doubtful ones first, then by the error expected of them.")
        if len(self.fits) > len(chosen):
            out += paragraph(
                f"{counted(len(self.fits) - len(chosen), 'other fit')} have no picture here, so that this file stays "
                "below 8 MB; the table has them all."
            )
        if sample:
            out += sections.scale_key(self.page, limit)
        return out + sections.gallery(self.page, cards)

    def posed(self, fit: SavedFit) -> Mesh:
        """Return NAME.fitted.ply in the model's frame, so that it looks at the camera."""
        mesh = self.folder.mesh(fit.entry["fitted"])
        T = as_mapping(fit.record.get("T_scan_model"))
        try:
            turned = (mesh.vertices - np.array(T["translation"], dtype=float)) @ np.array(T["rotation"], dtype=float)
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"The record of {fit.name} holds no pose T_scan_model; {_ADVICE}.") from error
        return mesh.with_vertices(turned / float(T["scale"]))

    def raw_scan(self, fit: SavedFit) -> Mesh:
        """Return the scan that could not be fitted, if it is still where it was, with the content it had."""
        source = as_mapping(fit.record.get("scan"))
        path = source.get("path")
        if not isinstance(path, str) or not path or "\0" in path:
            raise FileFormatError("the record does not say where the scan is.")
        file = self.folder.root / path
        if not file.is_file() or sha256_of_file(file) != source.get("hash"):
            raise FileFormatError("the scan is no longer where it was, or has changed.")
        try:
            mesh = read_mesh(file)
        except ShapespaceError as error:
            raise FileFormatError("the scan cannot be read.") from error
        if len(mesh.vertices) < _FEWEST_POINTS:
            raise FileFormatError(f"the scan has {counted(len(mesh.vertices), 'point')}.")
        return mesh

    def numbers(self) -> str:
        """Return the table of all fits."""
        places = self._cards | self._details
        shown = self.fits[:MOST_ROWS]
        out = sections.fits_table(
            shown, places, caption="Every fit: distances and errors at the end in mm. A dash: not known."
        )
        if len(self.fits) > len(shown):
            out += paragraph(
                f"{counted(len(self.fits) - len(shown), 'other fit')} are left out here; coefficients.csv has all."
            )
        if self.label_note:
            out += paragraph(self.label_note, "soft")
        return out

    def of_one_model(self, model_hash: str) -> list[SavedFit]:
        """Return the fits by one model that have coefficients: only these can be compared."""
        return [
            fit
            for fit in self.fits
            if fit.status not in _WITHOUT_RESULT and fit.record.get("b") and _source(fit, "model", "hash") == model_hash
        ]

    def model_hash(self) -> str:
        """Return the content hash of the model whose fits are compared.

        Raises:
            InputError: there are several, and none was given.
        """
        if self.model_path is not None:
            return self.model().content_hash
        hashes = {str(_source(fit, "model", "hash")) for fit in self.fits if fit.status not in _WITHOUT_RESULT}
        if len(hashes) > 1:
            raise InputError(
                f"The fits are by {len(hashes)} different models, so their coefficients cannot be compared; "
                "give one of the models with --model."
            )
        return hashes.pop() if hashes else ""

    def together(self) -> str:
        """Return the coefficients of all fits by one model against each other, and the lines of one subject's."""
        compared = self.of_one_model(self.model_hash())
        out = sections.scatter(self.page, [sections.coefficients_of(fit) for fit in compared])
        expressive = [fit for fit in compared if fit.entry.get("intensity")]
        subjects = {str(fit.entry.get("subject") or "") for fit in expressive}
        levels = Counter(str(fit.entry.get("expression")) for fit in expressive)
        if len(subjects) != 1 or "" in subjects or max(levels.values(), default=0) < _FEWEST_LEVELS:
            return out
        points = [sections.coefficients_of(fit) for fit in expressive]
        if any(len(point.b) < 2 for point in points):
            return out
        neutral = next(
            (
                sections.coefficients_of(fit)
                for fit in compared
                if fit.entry.get("intensity") == 0 and str(fit.entry.get("subject") or "") in subjects
            ),
            None,
        )
        return out + self.page.tried(lambda: sections.lines_through_neutral(self.page, points, neutral))

    def detail(self, fit: SavedFit) -> str:
        """Return one fit with every picture, as far as the file's size allows."""
        staged = self.staged(fit)
        out = sections.fit_facts(fit)
        reserve = _RESERVE_BYTES + (recognition.SECTION_BYTES if self.recognised else 0)
        if self.page.left < _DETAIL_BYTES + reserve:
            return out + paragraph("Its pictures would make this file larger than 8 MB, so they are left out.", "soft")
        same = self.of_one_model(str(_source(fit, "model", "hash")))
        others = [other.numbers("z") for other in same if other.name != fit.name]
        population: FloatArray | None = None
        if len(others) > 2 and len({len(z) for z in others}) == 1:
            population = np.stack(others)
        return out + sections.fit_to_turn(self.page, staged) + sections.fit_pictures(self.page, staged, population)

    # The rest

    def recognition(self) -> str:
        """Return what recognition.json holds."""
        return recognition.recognition_section(self.page, self.folder)

    def settings(self) -> str:
        """Return settings that the fits share, versions and hashes."""
        known = [fit for fit in self.fits if fit.status not in _WITHOUT_RESULT] or self.fits
        configs = [as_mapping(fit.record.get("config")) for fit in known if fit.record.get("config")]
        rows: list[tuple[str, str]] = [("Report", f"shapespace {__version__}")]
        versions = sorted({str(fit.record["version"]) for fit in self.fits if fit.record.get("version")})
        if versions:
            rows.append(("Fits", f"shapespace {listed(versions)}"))
        dense = any(config.get("dense") for config in configs)
        keys = dict.fromkeys(key for config in configs for key in config if dense or key != "dense_settings")
        for key in keys:
            values = list(dict.fromkeys(sections.setting(config.get(key)) for config in configs))
            rows.append((words(key), values[0] if len(values) == 1 else f"differs: {'; '.join(values[:4])}"))
        files = [
            [
                Cell(fit.name),
                *(
                    Cell(str(as_mapping(fit.record.get(of)).get(what) or "–"))
                    for of, what in (("scan", "name"), ("scan", "hash"))
                ),
                Cell(str(as_mapping(fit.record.get("model")).get("hash") or "–")),
            ]
            for fit in self.fits[:MOST_ROWS]
        ]
        return facts(rows, caption="Settings and versions") + folded(
            "Content hashes (SHA-256)",
            table(
                [Column("Fit"), Column("Scan"), Column("Hash of the scan"), Column("Hash of the model")],
                files,
                caption="Content hashes of the files that took part",
                stack=True,
            ),
        )


def _source(fit: SavedFit, of: str, what: str) -> object:
    return as_mapping(fit.record.get(of)).get(what)


def _words_of(fit: SavedFit) -> str:
    from shapespace.report.markup import STATUS_WORDS

    return STATUS_WORDS.get(fit.status, fit.status)


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")
