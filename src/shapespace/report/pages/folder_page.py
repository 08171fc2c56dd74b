"""The report of a folder that `shapespace fit` wrote."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from shapespace.cohort.table import LABELS_FILE, Label, names_of_file, read_labels
from shapespace.errors import InputError, ShapespaceError
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import (
    Block,
    Card,
    Cell,
    Command,
    Facts,
    Figure,
    Folded,
    Gallery,
    Head,
    Image,
    Notice,
    StripKey,
    Table,
    Text,
    Tiles,
    first_items,
    no_picture,
    number,
    status,
    text_table,
)
from shapespace.report.blocks.sections import settings_blocks
from shapespace.report.blocks.wording import (
    DASH,
    ORDER_OF_CONCERN,
    STATUS_WORDS,
    counted,
    isfinite,
    listed,
    median,
    mm,
    percent,
    printable,
    sentence,
    without_folders,
)
from shapespace.report.inputs.fit_population import FEWEST, MEASURES, ListedColumn, Population
from shapespace.report.inputs.saved_fits import (
    Coefficients,
    Folder,
    SavedFit,
    ScanNotFoundError,
    StagedFit,
    command_with_stages,
    model_of,
    nice_ceiling,
    raw_scan,
    saved_fit,
    saved_surfaces,
    staged_fit,
)
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.pages import study_page
from shapespace.report.pages.page import Chapter, Page
from shapespace.report.render import thumbnails
from shapespace.schemas import Quality
from shapespace.store.results import Results
from shapespace.types import FloatArray
from shapespace.version import __version__

# Items on a page: what can be looked through without paging, and a page that stays within its bytes.
MOST_CARDS = 24
MOST_EMPTY_CARDS = 6  # cards of fits without a surface
MOST_OPEN_CARDS = 6  # cards that are not folded away
MOST_DETAILS = 3  # fits with all pictures, about 1.3 MB each
MOST_ROWS = 2000  # rows of the table of all fits
MOST_CURVES = 100  # curves of iterations; more cover each other
_MOST_NAMED = 12  # items of a list; the table has all
_MOST_WORST = 3  # fits named in one sentence
_FEWEST_LEVELS = 2  # scans of a subject; one shows no progression
# bytes that stay free for tables, and sections of analyses that room is reserved for
_RESERVE_BYTES, _MOST_RESERVED = 400_000, 2


class FolderPage:
    """Builder of the report of a folder of fits.

    Args:
        folder: folder of the fits.
        fits: fits of the folder, one or more.
        page: page that it fills.
        model: file of the model; None for the path in the records.
        labels: table of labels; None to look for one.
    """

    def __init__(
        self,
        folder: Folder,
        fits: Sequence[SavedFit],
        *,
        page: Page,
        model: Path | None = None,
        labels: Path | None = None,
    ) -> None:
        self.folder = folder
        self.recognised = (folder.root / study_page.STUDY.file).is_file()
        self.analyses = study_page.find_analyses(folder.root)
        self.label_note = ""
        found_labels: Sequence[Label | None] = [None] * len(fits)
        try:
            found_labels, self.label_note = find_labels(folder, fits, labels)
        except ShapespaceError as error:
            if labels is not None:
                raise
            self.label_note = f"There are no labels: {error}"
        self.fits = sorted(map(with_label, fits, found_labels), key=sections.concern)
        self.main = _main_fits(self.fits)
        self.page = page
        page.planned = sections.MODEL_PICTURES + min(len(fits), MOST_CARDS) + 4 + len(self.main) * sections.FIT_PICTURES
        self.model_path = model
        if model is not None:
            self.model()
        self._details = {fit.name: self.page.anchor(f"pictures-of-{fit.name}") for fit in self.main}
        carded = _select_cards(self.fits) if len(fits) > 1 or not self.main else []
        self._cards = {fit.name: self.page.anchor(f"fit-{fit.name}") for fit in carded}
        self.carded = carded

    # Cached input

    def model(self) -> ShapeModel:
        """Return the model of the fits."""
        return self.page.once("model", lambda: model_of(self.folder, self.fits, self.model_path))

    def staged(self, fit: SavedFit) -> StagedFit:
        """Return the data for pictures of `fit`, labelled with its name."""
        return self.page.once(fit, lambda: replace(staged_fit(self.folder, fit), label=fit.name, parts=self.parts(fit)))

    def parts(self, fit: SavedFit) -> Parts | None:
        """Return the parts of the model of `fit`; None if it has one structure, or cannot be read."""
        with suppress(ShapespaceError):
            model = self.model()
            return Parts.of(model) if model.content_hash == fit.record.model.hash else None
        return None

    # The page

    def html(self) -> str:
        """Return the page."""
        lead = "Fits of a statistical shape model to raw surfaces. Lengths are in millimetres of the scan."
        name = self.folder.root.resolve().name
        for fit in self.main:
            with suppress(ShapespaceError):  # the section of the fit states the reason
                sections.order_pictures(self.page, self.staged(fit), self.others(fit))
        with suppress(ShapespaceError):
            sections.order_model(self.page, self.model())
        return self.page.html(
            f"{counted(self.total, 'fit')} in {name}",
            [Text(lead)],
            f"Made by shapespace {__version__} from the files in {name}.",
            self.chapters(),
        )

    @property
    def total(self) -> int:
        """Number of fits in the folder."""
        return len(self.fits)

    def chapters(self) -> list[Chapter]:
        """Return the parts of the page."""
        chapters = [
            Chapter("Summary", self.summary),
            Chapter("The fits", self.fits_part, "Fits"),
            Chapter("The fits together", self.together_part, "Together"),
            Chapter("The model", self.model_part, "Model"),
            Chapter("Settings, versions and hashes", self.settings, "Settings"),
        ]
        if sum(fit.fitted for fit in self.fits) < 2:
            del chapters[2]
        else:
            with suppress(ShapespaceError):  # the part states the reason
                sections.order_scatter(self.page, self.compared())
            self.page.order("error_curves", self.with_distances()[0], chart=True)
        if self.recognised:
            chapters.insert(-2, Chapter("Recognition", lambda: study_page.study_section(self.page, self.folder)))
        chapters[-2:-2] = study_page.analysis_chapters(self.page, self.folder.root, self.analyses)
        return chapters

    @property
    def places(self) -> Mapping[str, str]:
        """Places in the page by the names of the fits: of a fit in full, or else of its card."""
        return self._cards | self._details

    def place_of(self, name: str) -> str | None:
        """Return the place of the fit `name` in the page; None if the page does not show it."""
        return (self._details | self._cards).get(printable(name))

    def model_part(self) -> list[Block]:
        """Return the blocks of the model, with the figure of quality.json if there is such a file."""
        out = sections.model_part(self.page, self.model())
        if (self.folder.root / Quality.FILE).is_file():
            out += self.page.tried(lambda: sections.quality_part(self.page, self.folder))
        return out

    def summary(self) -> list[Block]:
        """Return the numbers of fits by status, medians of the trusted fits, and the fits that need review."""
        counts = Counter(fit.status for fit in self.fits)
        trusted = [fit for fit in self.fits if fit.status == "converged"]
        medians = {
            "expected vertex error": median([fit.expected_error_mm for fit in trusted]),
            "mean distance from model to scan, where the scan shows the surface": median(
                [fit.distance_mm("model_to_scan") for fit in trusted]
            ),
            "mean distance from scan to model": median([fit.distance_mm("scan_to_model") for fit in trusted]),
        }
        return [
            Text(self.overview(counts)),
            self.tiles(counts, medians),
            *self.other_models(),
            self.doubts(),
            *self.worst(),
            *self.without_stages(),
        ]

    def tiles(self, counts: Mapping[str, int], medians_mm: Mapping[str, float]) -> Tiles:
        """Return the number of fits by status, and the named medians of the trusted fits."""
        number_and_unit = {
            label: mm(value).removesuffix(" mm") for label, value in medians_mm.items() if isfinite(value)
        }
        return Tiles(
            [
                (f"{counts['converged']:,}", f"of {self.total:,}", "with no problems detected"),
                (f"{counts['doubtful'] + counts['max_iterations']:,}", "", "need review"),
                (f"{counts['failed'] + counts['unreadable']:,}", "", "without a result"),
                *((value, "mm", f"{label}, median of the converged fits") for label, value in number_and_unit.items()),
            ]
        )

    def overview(self, counts: Mapping[str, int]) -> str:
        """Return one or two sentences on the scans, the model, and the number of fits by status."""
        models = sorted({fit.record.model.name or "an unknown model" for fit in self.fits})
        methods = sorted({fit.record.method for fit in self.fits} - {""})
        by = f" by the {listed(methods)} method{'s' if len(methods) > 1 else ''}" if methods else ""
        trusted = counts["converged"]
        text = (
            f"{counted(len(self.fits), 'scan was', 'scans were')} fitted with {listed(models)}{by}. "
            f"{counted(trusted, 'fit') if trusted else 'None'} converged with no problems detected"
        )
        others = listed(
            [
                f"{counts[key]} {word}"
                for key, word in {
                    "max_iterations": "stopped at the limit of steps",
                    "doubtful": "doubtful",
                    "failed": "could not be fitted",
                    "unreadable": "cannot be read",
                }.items()
                if counts[key]
            ]
        )
        return f"{text}; {others}." if others else f"{text}."

    def other_models(self) -> list[Block]:
        """Return the fits by another model than the model that was given, if any was given."""
        if self.model_path is None:
            return []
        return [
            Notice(
                f"Fitted with another model than {self.model_path.name}",
                [fit.name for fit in self.fits if fit.fitted and fit.record.model.hash != self.model_hash()],
            )
        ]

    def doubts(self) -> Notice:
        """Return the fits that need review, by name and reason."""
        return Notice(
            "Needs review",
            first_items(
                [
                    Text(
                        f"{STATUS_WORDS[fit.status]}. {_all_reasons(fit)}",
                        name=Cell(fit.name, anchor=self.place_of(fit.name)),
                    )
                    for fit in self.fits
                    if fit.status != "converged"
                ],
                _MOST_NAMED,
                "in the table of all fits",
            ),
        )

    def worst(self) -> list[Block]:
        """Return a sentence on the converged fits that lie farthest from their scans."""
        good = [fit for fit in self.fits if fit.status == "converged" and isfinite(fit.distance_mm("model_to_scan"))]
        far = sorted(good, key=lambda fit: -fit.distance_mm("model_to_scan"))[:_MOST_WORST]
        if len(good) < 2:
            return []
        farthest = listed([f"{fit.name} ({mm(fit.distance_mm('model_to_scan'))})" for fit in far])
        which = "These" if len(good) == len(self.fits) else "Of the converged fits, these"
        return [Text(f"{which} lie farthest from their scans on average: {farthest}.")]

    def with_distances(self) -> tuple[Sequence[StagedFit], Sequence[str]]:
        """Return the fits of `curves`, of which only the distances are valid, and a sentence for each without them."""

        def load() -> tuple[Sequence[StagedFit], Sequence[str]]:
            # Without stages, each curve needs the scan to be read and the distances to be measured.
            pictured = [fit for fit in self.fits if fit.pictured and (fit.entry.stages or fit.name in self.places)]
            fits, problems = sections.usable(pictured[:MOST_CURVES], self.staged)
            # The process that draws the curves receives one scan only.
            return [replace(fit, scan=fits[0].scan, surfaces=fits[0].surfaces) for fit in fits], problems

        return self.page.once("curves", load)

    def curves(self) -> Figure:
        """Return the figure of the share of the surface within each distance."""
        fits, problems = self.with_distances()
        if not fits:
            raise InputError(f"There are no distances to draw: {problems[0]}" if problems else "No surface was saved.")
        some = f" The first {len(fits)} fits of the table." if sum(f.pictured for f in self.fits) > len(fits) else ""
        return self.page.figure(
            self.page.order("error_curves", fits, chart=True),
            "Share of the model's vertices that lie within each distance of the scan, one curve per fit. Vertices "
            f"that the scan does not show are not counted.{some}",
            alt=f"Cumulative distances of {counted(len(fits), 'fit')}",
            chart=True,
        )

    def without_stages(self) -> list[Block]:
        """Return notices on fits without pictures, and on the command that adds the stages if none were saved."""
        fitted = [fit for fit in self.fits if fit.fitted]
        if not fitted:
            return [Text("There is no fit to show.", "broken")]
        absent = Notice("Not in the pictures", self.not_drawn())
        if any(fit.entry.stages for fit in fitted):
            return [absent]
        return [
            absent,
            Text(
                "These fits were saved without their stages: the pictures show the fitted surfaces and the scans, with "
                "distances that this report measured. This command, run in the folder of the results, adds the surface "
                "before the fit and after phase 1, the regions and the iterations:",
                "soft",
            ),
            Command(command_with_stages(self.folder.root, {fit.name: fit.record for fit in self.fits})),
        ]

    def not_drawn(self) -> list[str]:
        """Return one sentence for each of the main fits that cannot be drawn, or not with its scan."""
        out: list[str] = []
        for fit in self.main:
            try:
                self.staged(fit)
            except ScanNotFoundError as error:
                out.append(f"{fit.name}: {str(error).removesuffix('.')}; the fitted surface is shown alone.")
            except ShapespaceError as error:
                out.append(str(error))
        return out

    # Fits

    def fits_part(self) -> list[Block]:
        """Return the gallery, the table, and the main fits in detail, folded if there are several."""
        page = self.page
        parts: list[Block] = []
        if self._cards:
            parts.append(
                page.section(
                    ("All fits" if len(self.fits) <= MOST_CARDS else f"The {MOST_CARDS} fits to look at first"),
                    self.gallery,
                )
            )
        parts.append(page.section("Every fit in numbers", self.numbers))
        several = len(self.fits) > 1
        for fit in self.main:
            made = page.section(
                f"{fit.name} in detail", lambda fit=fit: self.detail(fit), anchor=self._details[fit.name],
                folded=several, status=status(fit.status) if several else None,
            )  # fmt: skip
            # Of a single fit, its pictures matter more than its numbers.
            parts.insert(len(parts) if several else 0, made)
        return parts

    def together_part(self) -> list[Block]:
        """Return the distances of all fits, and their coefficients against each other."""
        curves: Sequence[Block] = self.page.tried(self.curves) if any(fit.pictured for fit in self.fits) else ()
        coefficients = self.page.tried(self.together)
        drawn = [block for block in coefficients if isinstance(block, Figure)]
        return [sections.in_columns(*curves, *drawn), *(block for block in coefficients if block not in drawn)]

    def gallery(self) -> list[Block]:
        """Return a card for each of the first fits: failed and doubtful first, then by their error."""
        sample, _ = sections.usable([fit for fit in self.carded if fit.pictured], self.staged)
        usual = [fit.scale_mm for fit in sample if fit.status == "converged"] or [fit.scale_mm for fit in sample]
        limit = nice_ceiling(median(usual))  # of strips that share it
        out: list[Block] = [Text("Sorted by status (failed, doubtful, converged), then by expected error.")]
        out.append(no_picture(len(self.fits) - len(self.carded), "fit"))
        if sample:
            out.append(
                StripKey(
                    "Each strip, from the left: the scan; scan (orange) and model (blue) over each other, the nearer "
                    "one shown; the distance from the model to the scan, one scale for all:",
                    [
                        (
                            self.page.image(thumbnails.colour_bar(), "from blue over pale to red"),
                            f"−{limit:g} mm, scan inside",
                            f"+{limit:g} mm, scan outside",
                        )
                    ],
                    "Grey parts are not shown by the scan. Distances to a scan of points only have no sign: their map "
                    f"runs from 0 to {limit:g} mm.",
                )
            )
        cards = [self.card(fit, limit) for fit in self.carded]
        return [
            *out,
            Gallery(cards[:MOST_OPEN_CARDS]),
            Folded(
                f"{len(cards) - MOST_OPEN_CARDS} more",
                ([Gallery(cards[MOST_OPEN_CARDS:])] if len(cards) > MOST_OPEN_CARDS else []),
            ),
        ]

    def card(self, fit: SavedFit, limit_mm: float) -> Card:
        """Return one fit of the gallery, its map on a scale that ends at `limit_mm`."""
        image, why = None, ""
        try:
            image = self.still(fit, limit_mm)
        except ShapespaceError as error:
            why = f"No picture: {error}"
        self.page.step(fit.name)
        seen = fit.distance_mm("scan_to_model")
        text = f"Scan to model {mm(seen)} on average. " if isfinite(seen) else ""
        # The summary has the complete reason for these fits.
        named = [bad.name for bad in self.fits if bad.status != "converged"][:_MOST_NAMED]
        return Card(
            anchor=self._cards[fit.name],
            name=fit.name,
            status=status(fit.status),
            label=fit.label if fit.label != fit.name else "",
            text=text + (_first_reason(fit) if fit.name in named else fit.reason),
            image=image,
            why_none=why,
            detail=self._details.get(fit.name),
        )

    def still(self, fit: SavedFit, limit_mm: float) -> Image:
        """Return the best picture of a fit that there is: with its stages, its fitted surface, or its scan."""
        if not fit.pictured:
            return self.page.image(
                thumbnails.mesh_still(raw_scan(self.folder, fit)), f"The raw scan {fit.name}, in its own axes"
            )
        try:
            staged = self.staged(fit)
        except ScanNotFoundError:
            return self.page.image(
                thumbnails.mesh_still(saved_surfaces(self.folder, fit)["final"]), f"The fitted surface of {fit.name}"
            )
        return self.page.image(thumbnails.fit_strip(staged, limit_mm), sections.strip_alt(staged, limit_mm))

    def numbers(self) -> list[Block]:
        """Return the table of all fits."""
        out: list[Block] = [
            sections.fits_table(
                self.fits[:MOST_ROWS],
                self.places,
                caption="Every fit: distances and errors at the end in mm. A dash: not known.",
            )
        ]
        if len(self.fits) > MOST_ROWS:
            left = counted(len(self.fits) - MOST_ROWS, "other fit")
            out.append(Text(f"{left} are omitted here; coefficients.csv has all."))
        return [*out, Text(self.label_note, "soft")]

    def of_one_model(self, model_hash: str) -> list[SavedFit]:
        """Return the fits by one model that have coefficients: only these can be compared."""
        return [fit for fit in self.fits if fit.fitted and fit.record.b and fit.record.model.hash == model_hash]

    def model_hash(self) -> str:
        """Return the content hash of the model whose fits are compared.

        Raises:
            InputError: there are several, and none was given.
        """
        if self.model_path is not None:
            return self.model().content_hash
        hashes = {fit.record.model.hash for fit in self.fits if fit.fitted}
        if len(hashes) > 1:
            raise InputError(
                f"The fits are by {len(hashes)} different models, so their coefficients cannot be compared; "
                "give one of the models with --model."
            )
        return hashes.pop() if hashes else ""

    def compared(self) -> Sequence[Coefficients]:
        """Return the coefficients of all fits by one model.

        Raises:
            InputError: there are several models, and none was given.
        """
        return self.page.once(
            "compared", lambda: [sections.coefficients_of(fit) for fit in self.of_one_model(self.model_hash())]
        )

    def together(self) -> list[Block]:
        """Return the coefficients of all fits by one model against each other, and the lines of one subject's."""
        compared = self.of_one_model(self.model_hash())
        out = sections.scatter(self.page, self.compared())
        expressive = [fit for fit in compared if fit.entry.intensity]
        subjects = {fit.entry.subject for fit in expressive}
        if (
            len(subjects) != 1
            or "" in subjects
            or max(Counter(fit.entry.expression for fit in expressive).values(), default=0) < _FEWEST_LEVELS
        ):
            return out
        points = [sections.coefficients_of(fit) for fit in expressive]
        if any(len(point.b) < 2 for point in points):
            return out
        neutral = next(
            map(
                sections.coefficients_of,
                (fit for fit in compared if fit.entry.intensity == 0 and fit.entry.subject in subjects),
            ),
            None,
        )
        return [*out, *self.page.tried(lambda: sections.lines_through_neutral(self.page, points, neutral))]

    def detail(self, fit: SavedFit) -> list[Block]:
        """Return one fit with every picture, as far as the file's size allows; without its scan, its surface alone."""
        try:
            staged = self.staged(fit)
        except ScanNotFoundError as error:
            why, surfaces = str(error), saved_surfaces(self.folder, fit)
            return [
                *sections.fit_facts(fit),
                *self.page.tried(lambda: sections.surface_to_turn(self.page, fit, surfaces, why, self.parts(fit))),
            ]
        reserve = _RESERVE_BYTES + study_page.SECTION_BYTES * min(self.recognised + len(self.analyses), _MOST_RESERVED)
        return [
            *sections.fit_facts(fit),
            *sections.fit_in_full(self.page, staged, self.others(fit), reserve=reserve, folded=len(self.fits) == 1),
        ]

    def others(self, fit: SavedFit) -> FloatArray | None:
        """Return coefficients (N, K) of the other fits by the model of `fit`; None if there are too few."""
        others = [o.numbers("z") for o in self.of_one_model(fit.record.model.hash) if o.name != fit.name]
        return np.stack(others) if len(others) > 2 and len({len(z) for z in others}) == 1 else None

    # The rest

    def settings(self) -> list[Block]:
        """Return settings that the fits share, versions and hashes."""
        configs = [
            fit.record.config for fit in ([fit for fit in self.fits if fit.fitted] or self.fits) if fit.record.config
        ]
        rows = [("Report", f"shapespace {__version__}")]
        versions = sorted({fit.record.version for fit in self.fits} - {""})
        if versions:
            rows.append(("Fits", f"shapespace {listed(versions)}"))
        hashes = text_table(
            ("Fit", "Scan", "Hash of the scan", "Hash of the model"),
            [
                [
                    fit.name,
                    *(part or DASH for part in (fit.record.scan.name, fit.record.scan.hash, fit.record.model.hash)),
                ]
                for fit in self.fits[:MOST_ROWS]
            ],
            "Content hashes of the files that took part",
        )
        return [*settings_blocks(configs, rows), Folded("Content hashes (SHA-256)", [hashes])]


def _main_fits(fits: Sequence[SavedFit]) -> list[SavedFit]:
    """Return the fits shown with every picture: the worst doubtful one, the worst and the median of the others."""
    pictured = [fit for fit in fits if fit.pictured]
    if len(pictured) <= MOST_DETAILS:
        return pictured
    doubtful = [fit for fit in pictured if fit.status == "doubtful"]
    others = [fit for fit in pictured if fit.status != "doubtful"]
    if not others:
        return doubtful[:MOST_DETAILS]
    return doubtful[:1] + [others[k] for k in sorted({0, len(others) // 2})]


def _select_cards(fits: Sequence[SavedFit]) -> list[SavedFit]:
    """Return the fits of the gallery; if not all have room, those without a result leave some room for the others."""
    if len(fits) <= MOST_CARDS:
        return list(fits)
    empty, rest = [fit for fit in fits if not fit.fitted], [fit for fit in fits if fit.fitted]
    first = empty[: max(MOST_EMPTY_CARDS, MOST_CARDS - len(rest))]
    return [*first, *rest[: MOST_CARDS - len(first)]]


def _all_reasons(fit: SavedFit) -> str:
    """Return the reasons of a fit without its status; the complete reason if the record has no codes."""
    return sentence("; ".join(fit.reason_texts)) if fit.reason_texts else fit.reason


def _first_reason(fit: SavedFit) -> str:
    """Return the first of the reasons of a fit, and the number of the others."""
    if not fit.reason_texts:
        return fit.reason
    first, *others = fit.reason_texts
    return sentence(f"{first}, and {counted(len(others), 'more reason')}" if others else first)


# Labels of the fits in a folder, and the location of their table


def find_labels(folder: Folder, fits: Sequence[SavedFit], labels_path: Path | None) -> tuple[list[Label | None], str]:
    """Return the label of each fit, and sentences on the source of the labels and on fits without a label.

    Labels are read from `labels_path`, or from labels.csv in `folder`, or next to the scans. They are matched by the
    name of the fit or of the scan's file. Without labels, the sentences state the reason.

    Raises:
        FileError: `labels_path` cannot be read.
        FileFormatError: the table is damaged, or two rows are of one scan.
        InputError: no row is of a scan.
    """
    places = [folder.root / LABELS_FILE] if labels_path is None else [labels_path]
    source = f"{LABELS_FILE} in the folder" if labels_path is None else labels_path.name
    if labels_path is None and not places[0].is_file():
        beside = dict.fromkeys(
            (folder.root / path).parent / LABELS_FILE
            for path in (fit.record.scan.path for fit in fits)
            if path and "\0" not in path
        )
        places = [file for file in beside if file.is_file()]
        source = f"{listed([f'{file.parent.name}/{LABELS_FILE}' for file in places])}, next to the scans"
    names = [(fit.name, *names_of_file(fit.record.scan.name or fit.name)) for fit in fits]
    labels: list[Label | None] = [None] * len(fits)
    sentences = [f"Labels are from {source}."] if places else []
    for file in places:
        table = read_labels(file, of_any=labels_path is not None)
        # Pages name no folder of the machine.
        own, notes = replace(table, table=replace(table.table, where=file.name)).match(names, "the fits")
        labels = [new or old for new, old in zip(own, labels, strict=True)]
        sentences += notes
    return labels, " ".join(sentences)


def with_label(fit: SavedFit, label: Label | None) -> SavedFit:
    """Return `fit` with its label; unchanged without one."""
    if label is None or not label.text:
        return fit
    return fit.with_entry(expression=label.text, subject=label.subject, intensity=label.intensity)


WORST = {"failed": 12, "doubtful": 60, "max_iterations": 20, "converged": 60}
"""Number of fits of each status on the page, the worst first."""

MOST_SINGLE, MOST_STORED = 10_000, 2_000
"""Largest number of fits of a folder of single files, and of a store, that are reported with one row for each fit."""

# Items on a page, and points in a picture: what can be looked through without paging.
_FARTHEST, _MOST_REASONS, _MOST_NOTED, _MOST_LINES, _IN_PICTURE = 20, 20, 24, 6, 400
_MOST_COLUMNS = 12  # columns of metadata; each has a figure


def is_many(results: Results) -> bool:
    """Return whether a folder has too many fits to report each one."""
    return len(results) > (MOST_SINGLE if results.store is None else MOST_STORED)


class ManyPage(FolderPage):
    """Builder of the report of very many fits: a `FolderPage` of the fits to review, with distributions of all fits.

    Args:
        folder: folder of the fits.
        results: results of the folder.
        page: page that it fills.
        model: file of the model; None for the path in the records.
        labels: table of labels; None to look for one.

    Raises:
        InputError: none of the fits can be read.
    """

    def __init__(
        self,
        folder: Folder,
        results: Results,
        *,
        page: Page,
        model: Path | None = None,
        labels: Path | None = None,
    ) -> None:
        self.population = Population(results)
        self.problems = results.problems
        self._far = self.population.far()
        self.farthest = [
            int(k)
            for k in np.argsort(np.where(np.isfinite(self._far), -self._far, np.inf), kind="stable")[:_FARTHEST]
            if isfinite(self._far[k])
        ]
        names = [name for kind, most in WORST.items() for name in self.population.worst(kind, most)]
        names += [self.population.names[k] for k in self.farthest]
        super().__init__(
            folder,
            [saved_fit(folder, results, name) for name in sorted(set(names))],
            model=model,
            labels=labels,
            page=page,
        )

    @property
    def total(self) -> int:
        """Number of fits in the folder."""
        return len(self.population)

    def chapters(self) -> list[Chapter]:
        """Return the parts of the page."""
        return [
            Chapter("Summary", self.summary),
            Chapter("Fits to look at", self.fits_part, "Fits"),
            Chapter("Distributions", self.distributions),
            Chapter("Time and site", self.drift),
            *study_page.analysis_chapters(self.page, self.folder.root, self.analyses),
            Chapter("The model", self.model_part, "Model"),
            Chapter("Settings and versions", self.settings, "Settings"),
        ]

    def summary(self) -> list[Block]:
        """Return the number of fits by status, the reasons, the groups that differ, and the unreadable files."""
        return [
            self.tiles(
                self.population.counts,
                {words.removesuffix(" (mm)"): self.population.median(key) for key, words in [*MEASURES.items()][:3]},
            ),
            *self.other_models(),
            Notice(
                "Cannot be read",
                [without_folders(printable(text)) for text in self.problems[:_MOST_NOTED]],
                "broken",
            ),
            *([] if len(self.population.models) < 2 else [Text(self._of_models())]),
            *self.page.tried(self.stands_out),
            *self.page.tried(self.reasons),
        ]

    def _of_models(self) -> str:
        return (
            f"The fits are by {len(self.population.models)} models; coefficients are compared of the "
            f"{self.population.models.most_common(1)[0][1]:,} fits by the one with most."
        )

    def stands_out(self) -> Notice:
        """Return the times and sites that differ from the rest by more than chance."""
        return Notice(
            "Differ from all the others",
            first_items(
                [
                    Text(sentence("; ".join(group.stands_out)), name=Cell(f"{column.name} {printable(group.name)}"))
                    for column in self.population.listed
                    for group in self.population.compared(column)
                    if group.stands_out
                ],
                _MOST_NOTED,
                "in the tables of Time and site",
                "more",
                "more",
            ),
        )

    def reasons(self) -> list[Block]:
        """Return the reasons why fits are not trusted, with their frequencies."""
        most = self.population.n_reasons.most_common(_MOST_REASONS)
        if not most:
            return []
        out: list[Block] = [
            Table(
                [
                    Head("Status"),
                    Head("Reason, without its names and numbers"),
                    Head("Fits", "number"),
                ],
                [[status(kind), Cell(printable(reason)), number(count, 0)] for (kind, reason), count in most],
                "Why fits are not trusted, the most frequent reasons first",
            )
        ]
        rest = sum(self.population.n_reasons.values()) - sum(count for _, count in most)
        return [*out, Text(f"{counted(rest, 'other')} with rarer reasons.", "soft")] if rest else out

    # Distributions

    def distributions(self) -> list[Block]:
        """Return histograms of distances and coefficients, and the fits that lie farthest from the mean."""
        page = self.page
        return [
            sections.in_columns(
                *page.tried(self._histograms), *page.tried(self._coefficients), *page.tried(self._density)
            ),
            page.section("Farthest from the mean", self.outliers),
            Folded("The fits to look at in space, to be turned", self.page.tried(self.together)),
        ]

    def _histograms(self) -> Block:
        every = counted(len(self.population), "fit")
        measures = {words: self.population.measures[key] for key, words in MEASURES.items()}
        return self.page.figure(
            figures.distributions_figure(measures, self.population.trusted, title=f"How near {every} come"),
            "Distances where the scan shows the surface, and the expected vertex error. The last bar contains all "
            "larger values.",
            alt=f"Histograms of {listed(list(measures))} of {every}",
            chart=True,
        )

    def _trusted_z(self) -> npt.NDArray[np.float32]:
        return self.population.z[self.population.trusted]

    def _coefficients(self) -> Block:
        return self.page.figure(
            figures.coefficients_spread(self._trusted_z(), title="How widely each coefficient spreads"),
            "Percentiles of each coefficient over the trusted fits, in standard deviations of the model. Where the "
            "scans vary as the training shapes did, the band of 5 to 95 % ends at the dashed lines.",
            alt="Bands of the percentiles of each coefficient",
            chart=True,
        )

    def _density(self) -> Block:
        return self.page.figure(
            figures.density_figure(
                self._trusted_z(), self._far[self.population.trusted], title="Where in the shape space"
            ),
            "Density of the trusted fits, on a logarithmic scale; the farthest fits are omitted. Dashed: "
            "three standard deviations. Right: how far each fit is from the mean in all coefficients.",
            alt="Density of z1 against z2 and z3, and a histogram of the root mean square of all coefficients",
            chart=True,
        )

    def outliers(self) -> list[Block]:
        """Return a table of the fits whose coefficients are the largest."""
        rows: list[list[Cell]] = []
        listed_in = [column for column in self.population.listed if column.kind == "level"][:2]
        for k in self.farthest:
            z = self.population.z[k]
            most = int(np.nanargmax(np.abs(z)))
            levels: list[Cell] = [
                Cell(printable(column.levels[int(column.codes[k])])) if column.codes[k] >= 0 else Cell(DASH)
                for column in listed_in
            ]
            name = self.population.names[k]
            rows.append([
                Cell(printable(name), anchor=self.place_of(name)),
                status(ORDER_OF_CONCERN[int(self.population.status[k])]),
                number(float(self._far[k]), 2),
                Cell(f"z{most + 1} = {float(z[most]):+.1f}".replace("-", "−"), float(np.abs(z[most]))),
                number(float(self.population.measures["expected_error_mm"][k]), 2),
                *levels,
            ])  # fmt: skip
        if not rows:
            return [Text("No fit has coefficients.", "soft")]
        heads = [
            Head("Scan"), Head("Status"), Head("RMS of z", "number"), Head("Largest", "number"),
            Head("Expected vertex error", "number"), *(Head(column.name) for column in listed_in),
        ]  # fmt: skip
        return [
            Table(
                heads,
                rows,
                "The fits whose coefficients are largest: rare shapes, or fits that went astray",
                sortable=True,
            )
        ]

    # Time and site

    def drift(self) -> list[Block]:
        """Return the relation of errors and coefficients to the metadata of the scans."""
        columns = self.population.listed[:_MOST_COLUMNS]
        if not columns:
            return [
                Text(
                    "The scans were listed without columns such as a date or a site; give them in the list of scans to "
                    "see how the fits depend on them.",
                    "soft",
                )
            ]
        parts: list[Block] = [
            self.page.section(column.name, lambda column=column: self.by(column)) for column in columns
        ]
        left = [*self.population.left_out, *(column.name for column in self.population.listed[_MOST_COLUMNS:])]
        return [*parts, Text(f"Not shown: {listed(left)}." if left else "", "soft")]

    def by(self, column: ListedColumn) -> list[Block]:
        """Return the relation of the fits to one column."""
        people, trusted = self.population, self.population.trusted
        # Errors are those of trusted fits; the number of the other fits is in the same table.
        measures = {words: np.where(trusted, people.measures[key], np.nan) for key, words in MEASURES.items()}
        error = next(iter(MEASURES.values()))
        if column.kind == "level":
            drawing = figures.levels_figure(
                [(name, inside) for name, inside, _ in column.groups()],
                measures[error],
                words=error,
                title=f"By {column.name}",
            )
            caption = (
                "Of each group: the median of the trusted fits, the middle half and the middle 90 %. Dashed: of all."
            )
        else:
            levels = next((other for other in people.listed if 1 < len(other.levels) <= _MOST_LINES), None)
            lines = [] if levels is None else [(name, inside) for name, inside, _ in levels.groups()]
            drawing = figures.over_time_figure(
                column.values, column.edges(), dict(list(measures.items())[:2]), ~trusted,
                is_time=column.kind == "time", name=column.name, title=f"Along {column.name}", lines=lines,
            )  # fmt: skip
            caption = (
                f"Medians of the trusted fits, of at least {FEWEST} each, and the share of all that is not trusted."
            )
            caption += f" Thin lines: by {levels.name}." if levels is not None and lines else ""
        picture = self.page.figure(drawing, caption, alt=f"Errors by {column.name}", chart=True)
        table = self._compared(column)
        return [picture, table if column.kind == "level" else Folded(f"By {column.name}, in numbers", [table])]

    def _compared(self, column: ListedColumn) -> Table:
        heads = [
            Head(column.name), Head("Fits", "number"), Head("Not trusted, %", "number"),
            Head("Expected error, median", "number"), Head("Compared with all", "number"),
            Head("Coefficient that differs most", "number"), Head("Stands out"),
        ]  # fmt: skip
        rows = [
            [
                Cell(printable(group.name)),
                number(group.count, 0),
                number(100 * group.untrusted, 1),
                number(group.error_mm, 2),
                number(group.error_off_mm, 2),
                Cell(f"z{group.mode} {group.shift:+.2f}".replace("-", "−") if group.mode else DASH, abs(group.shift)),
                Cell("yes" if group.stands_out else ""),
            ]
            for group in self.population.compared(column)
        ]
        return Table(
            heads,
            rows,
            f"Fits by {column.name}; errors of the trusted ones in mm, coefficients in standard deviations",
            sortable=len(rows) > 1,
        )

    # Fits to look at

    def numbers(self) -> list[Block]:
        """Return the table of the fits on the page."""
        wanted = listed([f"{most} {STATUS_WORDS[kind]}" for kind, most in WORST.items()])
        text = (
            f"Of {counted(len(self.population), 'fit')} these {len(self.fits)}: the worst of each status ({wanted}), "
            f"and the {_FARTHEST} farthest from the mean. shapespace export gives the table of all, and fits as files."
        )
        return [
            Text(text),
            sections.fits_table(self.fits, self.places, caption="Fits to look at: distances and errors in mm"),
            Text(self.label_note, "soft"),
        ]

    def together(self) -> list[Block]:
        """Return the first coefficients of the fits on the page, to be turned."""
        points = [*map(sections.coefficients_of, self.of_one_model(self.model_hash()))]
        return [*self.page.tried(lambda: sections.scatter_to_turn(self.page, points))]

    def others(self, fit: SavedFit) -> FloatArray | None:
        """Return coefficients of other fits, evenly from all."""
        z = self._trusted_z()
        z = z[np.isfinite(z).all(axis=1)]
        return (
            z[:: max(1, len(z) // _IN_PICTURE)].astype(np.float64)
            if z.shape[1] == len(fit.record.z) and len(z) > 2
            else None
        )

    def settings(self) -> list[Block]:
        """Return methods, versions and models, each with its number of fits."""
        rows = [("Report", f"shapespace {__version__}")]
        for key, heading in {"method": "Methods", "version": "Versions of shapespace", "model_name": "Models"}.items():
            rows += [
                (
                    heading,
                    listed(
                        [
                            f"{printable(value)} ({count:,})"
                            for value, count in self.population.origins[key].most_common(_MOST_NOTED)
                        ]
                    )
                    or DASH,
                )
            ]
        rows += [
            (
                "Hashes of the models",
                listed([f"{value} ({count:,})" for value, count in self.population.models.most_common(_MOST_NOTED)])
                or DASH,
            )
        ]
        rows += [("Not trusted", percent(1 - float(self.population.trusted.mean())))]
        return [Facts(rows, "Settings and versions")]
