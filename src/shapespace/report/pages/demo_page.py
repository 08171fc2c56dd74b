"""The report of the demo: both experiments of the paper, compared with the values in the paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.model.shape_model import ShapeModel
from shapespace.report import figures
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import Block, Facts, Figure, Folded, Notice, Table, Text, Tiles, text_table
from shapespace.report.blocks.wording import DASH, STATUS_WORDS, isfinite, mm, moment, plain, setting, words
from shapespace.report.inputs.saved_fits import Folder, SavedFit, StagedFit, read_fit, staged_fit
from shapespace.report.pages.page import Chapter, Make, Page
from shapespace.schemas import DEMO_AGAIN, Case, Demo, DemoModel, ExpressionsOfOne, FitEntry, read
from shapespace.types import FloatArray

_RESERVE_BYTES = 1_200_000  # bytes that stay free for the parts after the fits
_PICTURES = 30  # planned pictures, for the progress bar alone
_MODES_OF_A_CASE = 4  # leading modes that are drawn for each case, one row of pictures
_NOTHING = Text("No fit kept its surfaces.", "broken")


class DemoPage:
    """Builder of the report of the demo.

    Args:
        folder: folder of the demo.
        page: page that it fills.

    Raises:
        FileError: demo.json cannot be read.
        FileFormatError: demo.json is damaged.
    """

    def __init__(self, folder: Folder, page: Page) -> None:
        self.page = page
        page.planned = _PICTURES
        self.folder = folder
        self.demo = read(Demo, folder.json("demo.json"), "demo.json", DEMO_AGAIN)
        self.provenance = f"shapespace {self.demo.version}, {moment(self.demo.created)}"
        self.cases = self.demo.experiment2.cases
        self.entries = [*self.demo.experiment1.fits, *(case.fit for case in self.cases)]

    def html(self) -> str:
        """Return the page."""
        lead = [
            Text(
                "Raw surfaces are fitted by a statistical shape model with the modified ICP of Quan, Matuszewski, "
                "Shark and Ait-Boudaoud. All distances are in millimetres."
            ),
            Text(
                f"{self.provenance}."
                + (" This was the quick demo: coarser scans and an earlier stop." if self.demo.quick else ""),
                "soft",
            ),
        ]
        for fit, label, population_z in self.in_full():
            with suppress(ShapespaceError):  # the section of the fit states the reason
                sections.order_pictures(self.page, self.staged(fit, label), _coefficients(population_z))
        with suppress(ShapespaceError):
            sections.order_model(self.page, self.model(self.demo.experiment1))
        return self.page.html(
            "Low-dimensional surface parameterisation: the paper, run again",
            lead,
            f"Made by {self.provenance} from the files in its own folder.",
            [
                Chapter("Summary", self.summary),
                Chapter("Experiment 1", self.experiment_1),
                Chapter("Experiment 2", self.experiment_2),
                Chapter("Settings, versions and hashes", self.settings, "Settings"),
            ],
        )

    def with_headings(self, parts: Mapping[str, Make], level: int = 3) -> list[Block]:
        """Return sections with their headings."""
        return [self.page.section(heading, make, level) for heading, make in parts.items()]

    # Cached files

    def fit(self, entry: FitEntry) -> SavedFit:
        """Return the fit of an entry of demo.json."""
        return self.page.once(("fit", str(entry.json)), lambda: read_fit(self.folder, entry))

    def staged(self, fit: SavedFit, label: str = "") -> StagedFit:
        """Return the surfaces of `fit` for its pictures, with the name `label`."""
        staged = self.page.once(("stages", str(fit.entry.stages)), lambda: staged_fit(self.folder, fit))
        label = label or fit.label
        return self.page.once(("labelled", staged, label), lambda: replace(staged, label=label))

    def in_full(self) -> list[tuple[SavedFit, str, Sequence[Sequence[float]]]]:
        """Return the fits with all pictures: their labels, and the coefficients of the population of their models."""
        experiment = self.demo.experiment1
        farthest = sorted(
            (fit for fit in _tests(self.readable(experiment.fits)[0]) if fit.pictured),
            key=lambda fit: -np.nan_to_num(fit.summary_mm("before", "model_to_scan", "max")),
        )
        cases = [(fit, _short(case)) for case in self.cases for fit in self.readable([case.fit])[0] if fit.pictured]
        return [
            *((fit, fit.label, experiment.population_z) for fit in farthest[: 1 if self.demo.quick else 2]),
            *((fit, label, ()) for fit, label in cases),
        ]

    def model(self, owner: DemoModel) -> ShapeModel:
        """Return the model of an experiment or a case."""
        return self.page.once(("model", owner.model), lambda: ShapeModel.load(self.folder.path(owner.model)))

    def readable(self, entries: Sequence[FitEntry]) -> tuple[list[SavedFit], list[str]]:
        """Return the fits whose records can be read, and one sentence for each that cannot."""
        return sections.usable(entries, self.fit)

    def pictured(self, fits: Sequence[SavedFit]) -> tuple[list[tuple[SavedFit, StagedFit]], Notice]:
        """Return the fits with surfaces, and a notice with the names of the others."""

        def both(fit: SavedFit) -> tuple[SavedFit, StagedFit]:
            if not fit.pictured:
                raise FileFormatError(f"{fit.name}: {fit.reason or 'no surface was kept'}")
            return fit, self.staged(fit)

        pictured, absent = sections.usable(fits, both)
        return pictured, Notice("Not in the pictures", absent)

    # Summary

    def summary(self) -> list[Block]:
        """Return the key numbers, the main figure, and the comparison with the paper."""
        return [
            *self.tiles(),
            *self.with_headings({"Main figure": self.main_figure, "Comparison with the paper": self.paper_table}),
        ]

    def tiles(self) -> list[Block]:
        """Return the number of fits by status, and their mean errors."""
        fits, problems = self.readable(self.entries)
        total, first = len(self.entries), len(self.entries) - len(self.cases)
        counts = Counter(fit.status for fit in fits)
        tests = [fit.entry for fit in fits if fit.entry.intensity and fit.status != "failed"]
        distances = [fit.distance_mm("model_to_scan") for fit in fits if fit.entry in tests]
        errors = _mean([entry.vertex_error_mm.mean for entry in tests if entry.vertex_error_mm])
        floors = _mean([entry.floor_mm.mean for entry in tests if entry.floor_mm])
        blind = "fits converged with no problems detected; the plain method misses some errors"
        tiles = [
            (str(counts["converged"]), f"of {total}", blind),
            (
                plain(self.demo.experiment1.modes_for_98_5),
                "",
                "modes contain 98.5 % of the variance of one person's expressions",
            ),
            (*_number_and_unit(_mean(distances)), "mean closest distance, test faces to scans, where observed"),
            (*_number_and_unit(errors), f"their true vertex error; the model's best possible is {mm(floors)}"),
        ]
        rest = ", ".join(
            f"{counts[key]} {word}" for key, word in STATUS_WORDS.items() if counts[key] and key != "converged"
        )
        text = (
            f"{total} fits are reported: {first} to simulated scans of one person's expressions, {total - first} to "
            f"scans of other people.{f' Besides those that converged: {rest}.' if rest else ''}"
        )
        return [
            Text(text),
            Tiles(tiles),
            Notice(
                "Needs review",
                [f"{fit.name}: {STATUS_WORDS[fit.status]}. {fit.reason}" for fit in fits if fit.status != "converged"],
            ),
            Notice("Cannot be read", problems),
        ]

    def main_figure(self) -> list[Block]:
        """Return the middle test face and the scans of experiment 2 with their fits."""
        fits, _ = self.readable(self.demo.experiment1.fits)
        usable = [fit for fit in _tests(fits) if fit.pictured]
        usable.sort(key=lambda fit: fit.summary_mm("final", "model_to_scan", "mean"))
        wanted = [(fit.entry, f"{fit.label} (simulated)") for fit in usable[len(usable) // 2 :][:1]]
        for case in self.cases:
            wanted += [
                (fit, f"{_short(case)}, {method}")
                for fit, method in ((case.fit, "paper"), (case.robust, "robust"))
                if fit and fit.stages
            ]
        staged_fits, unread = sections.usable(wanted, lambda pair: self.staged(self.fit(pair[0]), pair[1]))
        if not staged_fits:
            raise FileFormatError("No fit kept a surface to show; run the demo again.")
        labels = [fit.label for fit in staged_fits]
        return [
            self.page.figure(
                figures.portrait_figure(staged_fits, labels, title="Raw scans and the models fitted to them"),
                "Rows: the test expression with the median distance, then each scan of experiment 2, fitted by the "
                "method of the paper and by the robust method. The last column maps the distance of each model vertex "
                f"to the scan, all rows on one scale.{self.true_errors()}",
                alt="Scan, fitted model, both overlaid, and a distance map, for " + "; ".join(labels),
            ),
            Notice("Not in the picture", unread),
        ]

    def true_errors(self) -> str:
        """Return the mean true vertex errors of both methods in experiment 2, where the truth is known."""
        sentences: list[str] = []
        for case in self.cases:
            paper, robust = case.fit.vertex_error_mm, case.robust and case.robust.vertex_error_mm
            if paper and robust and case.fit.floor_mm:
                sentences.append(
                    f" {_short(case).capitalize()}: mean true vertex error {mm(paper.mean)} by the method of the "
                    f"paper, {mm(robust.mean)} by the robust method; the best possible with this model is "
                    f"{mm(case.fit.floor_mm.mean)}."
                )
        return "".join(sentences)

    def paper_table(self) -> Table:
        """Return the values of the paper and the values that this run measured."""
        claims = self.demo.paper_table
        if not claims:
            raise FileFormatError("demo.json contains no comparison with the paper; run the demo again.")
        return text_table(
            ("Quantity", "Paper", "This run", "True error", "Why it differs"),
            [[row.quantity, row.paper, row.measured, row.truth or DASH, row.why or "It does not."] for row in claims],
            "Distances are to the closest point of the scan; the true error is between vertices that correspond, "
            "compared with the floor that a perfect fit of the same model would reach.",
        )

    # Experiment 1

    def experiment_1(self) -> list[Block]:
        """Return one person's expressions: model, fits, recognition."""
        experiment = self.demo.experiment1
        if not experiment.model:
            raise FileFormatError("demo.json contains no experiment 1; run the demo again.")
        fits, problems = self.readable(experiment.fits)
        tests = _tests(fits)
        farthest = [item for item in self.in_full() if item[0] in tests]
        intro = (
            f"{experiment.title or 'Expressions of one person'}: {_count(experiment.n_training)} faces of one "
            f"simulated person make the model, {_count(experiment.modes_for_98_5)} modes contain 98.5 % of their "
            "variance, and unseen expressions are fitted as raw surfaces: with other triangles, moved, turned, "
            "scaled, with 0.2 mm noise."
        )
        parts: dict[str, Make] = {
            "The training faces": lambda: self.training(experiment),
            "Mean and first modes": lambda: self.modes(experiment, "Paper, figures 2 and 3. "),
            "The test faces": lambda: self.test_faces(tests),
            "From far away, step by step": lambda: (
                [block for fit, label, population_z in farthest for block in self.one_fit(fit, label, population_z)]
                or [_NOTHING]
            ),
            "Test faces, fitted": lambda: self.all_fitted(tests),
            "Distance maps": lambda: self.maps(tests),
            "Every fit in numbers": lambda: self.numbers(fits),
            "Expressions as directions": lambda: self.directions(experiment, fits),
        }
        return [Text(intro), Notice("Cannot be read", problems), *self.with_headings(parts)]

    def numbers(self, fits: Sequence[SavedFit]) -> Table:
        """Return the table of fits."""
        return sections.fits_table(fits, {}, caption="Distances at the end, in mm. A dash: not known.")

    def training(self, experiment: ExpressionsOfOne) -> Figure:
        """Return some of the training faces."""
        examples = experiment.training_examples[: 8 if self.demo.quick else 12]
        meshes = [self.folder.mesh(example.file) for example in examples]
        return self.page.figure(
            figures.faces_grid(
                meshes, [example.label for example in examples], title="Training faces: one person, mixed expressions"
            ),
            f"Paper, figure 1. {len(meshes)} of the {_count(experiment.n_training)} faces that the model is made of.",
            alt=f"{len(meshes)} faces of one person with different expressions, in a grid",
        )

    def modes(self, owner: DemoModel, paper: str, to_move: int = sections.MODES_IN_WIDGET) -> list[Block]:
        """Return the mean and the modes of a model."""
        return sections.model_part(self.page, self.model(owner), figure_of=paper, to_move=to_move)

    def test_faces(self, tests: Sequence[SavedFit]) -> list[Block]:
        """Return the scans of the test faces."""
        pictured, absent = self.pictured(tests)
        if not pictured:
            return [absent if absent.items else Text("No test face was fitted.", "broken")]
        labels = [staged.label for _, staged in pictured]
        return [
            self.page.figure(
                figures.faces_grid(
                    [staged.scan for _, staged in pictured],
                    labels,
                    title="Test faces: raw surfaces, none of them in the training set",
                ),
                "Paper, figure 8. The scans, turned back to the front by the fitted pose; simulated.",
                alt="Grid of test faces: " + ", ".join(labels),
            ),
            absent,
        ]

    def one_fit(self, fit: SavedFit, label: str, population_z: Sequence[Sequence[float]] = ()) -> list[Block]:
        """Return one fit with all its pictures, and its coefficients compared with those of the population (N, K)."""
        return sections.fit_in_full(
            self.page,
            self.staged(fit, label),
            _coefficients(population_z),
            reserve=_RESERVE_BYTES,
            of_paper=True,
        )

    def all_fitted(self, tests: Sequence[SavedFit]) -> list[Block]:
        """Return every test face with its fitted model."""
        pictured, absent = self.pictured(tests)
        if not pictured:
            return [absent]
        chosen = _strongest(pictured) if self.demo.quick else [staged for _, staged in pictured]
        return [
            self.page.figure(
                figures.aligned_grid(chosen, title="Scan and fitted model over each other"),
                "Where the surfaces coincide, noise decides which one is seen: a fine mixture of both colours is a "
                "close fit, a large patch of one is not. Above each: mean distance, model to scan.",
                alt="Overlays of scan and fitted model for " + ", ".join(staged.label for staged in chosen),
            ),
            absent,
        ]

    def directions(self, experiment: ExpressionsOfOne, fits: Sequence[SavedFit]) -> list[Block]:
        """Return the coefficients of the test faces, and the scores of recognition."""
        left_out = plain(experiment.scores.get("left_out")).split(", ")
        usable = [fit for fit in fits if fit.status != "failed" and fit.name not in left_out]
        scans = [sections.coefficients_of(fit) for fit in _tests(usable)]
        neutral = next((sections.coefficients_of(fit) for fit in usable if not fit.entry.intensity), None)
        out: list[Block] = []
        if scans and all(len(scan.b) >= 2 for scan in scans):
            out.append(
                sections.lines_through_neutral(
                    self.page, scans, neutral, figures_of=("Paper, figure 9. ", "Paper, figure 10. ")
                )
            )
            if all(len(scan.b) >= 3 for scan in scans):
                out += self.page.tried(lambda: sections.scatter_to_turn(self.page, scans))
        return out + sections.score_tables(
            experiment.scores, many="Is each expression a line through neutral?", single="Are the expressions disjoint?"
        )

    def maps(self, tests: Sequence[SavedFit]) -> list[Block]:
        """Return threshold maps and distance maps of the test faces."""
        pictured, absent = self.pictured(tests)
        if not pictured:
            return [absent]
        chosen = _strongest(pictured)
        every = chosen if self.demo.quick else [staged for _, staged in pictured]
        return [
            sections.in_columns(
                self.page.figure(
                    figures.threshold_figure(chosen),
                    "Paper, figure 11, for the strongest level of each expression. Above each panel: share of the "
                    "vertices within the limit.",
                    alt="Maps of the face with the part within 2, 4, 6, 8 and 10 mm of the scan for "
                    + ", ".join(staged.label for staged in chosen),
                ),
                self.page.figure(
                    figures.distance_maps(every, title="The same distances on a finer scale"),
                    "Distance from each model vertex to the scan, all on one scale.",
                    alt="Distance maps on one scale for " + ", ".join(staged.label for staged in every),
                ),
            ),
            absent,
        ]

    # Experiment 2

    def experiment_2(self) -> list[Block]:
        """Return models of many people, fitted to scans of another person."""
        if not self.cases:
            raise FileFormatError("demo.json contains no case of experiment 2; run the demo again.")
        scans = "a scan" if len(self.cases) == 1 else "scans"
        models = [case.model for case in self.cases]
        return [
            Text(f"Models of many people's neutral faces, fitted to {scans} of another person."),
            *(
                self.page.section(
                    case.title or "Case",
                    lambda case=case, k=k: self.case(case, with_model=case.model not in models[:k]),
                )
                for k, case in enumerate(self.cases)
            ),
        ]

    def case(self, case: Case, *, with_model: bool) -> list[Block]:
        """Return one scan of experiment 2."""
        fit = self.fit(case.fit)
        kind = "Simulated scan. " if case.simulated else "Real scan. "
        kind = "" if case.note.lower().startswith(("simulated", "real", "a real")) else kind
        used = f", and {case.n_modes} are used" if case.n_modes else ""
        modes = f"its {_count(case.n_modes)} modes contain less than 98.5 % of the variance."
        if case.modes_for_98_5:
            modes = f"{case.modes_for_98_5} modes contain 98.5 % of the variance{used}."
        out: list[Block] = [
            Text(kind + case.note, "notice" if case.simulated else ""),
            Text(f"The model is made of {_count(case.n_training)} people; {modes}"),
            self.numbers([fit]),
        ]
        if not fit.pictured:
            return out
        parts: dict[str, Make] = {"Step by step": lambda: self.one_fit(fit, _short(case))}
        if with_model and not self.demo.quick:
            parts["The model"] = lambda: self.modes(case, "", _MODES_OF_A_CASE)
        return out + self.with_headings(parts, 4)

    # The rest

    def settings(self) -> list[Block]:
        """Return settings, times, versions and hashes."""
        demo = self.demo
        rows = [("Machine", demo.machine or "not recorded"), ("Seed", plain(demo.seed))]
        rows += [(f"Time, {words(key)}", f"{value:.1f} s") for key, value in demo.seconds.items()]
        rows += [(f"Setting, {words(key)}", plain(value)) for key, value in demo.settings.items()]
        rows += [(f"Version, {key}", value) for key, value in demo.versions.items()]
        fits, unread = self.readable(self.entries)
        if fits:
            rows += [(f"Fit, {words(key)}", setting(value)) for key, value in fits[0].record.config.items()]
        return [
            Facts(rows, "Settings and versions"),
            Folded(
                "Content hashes (SHA-256)",
                [
                    text_table(
                        ("Fit", "Scan", "Model"),
                        [
                            [
                                fit.name,
                                *(
                                    f"{file.name} {file.hash or 'not recorded'}"
                                    for file in (fit.record.scan, fit.record.model)
                                ),
                            ]
                            for fit in fits
                        ],
                        "Content hashes of the files that took part",
                    )
                ],
            ),
            Notice("Cannot be read", unread),
        ]


def _tests(fits: Sequence[SavedFit]) -> list[SavedFit]:
    return [fit for fit in fits if fit.entry.intensity]


def _coefficients(population_z: Sequence[Sequence[float]]) -> FloatArray | None:
    if len({len(z) for z in population_z}) > 1:
        raise FileFormatError("population_z in demo.json has rows of different lengths; run the demo again.")
    return np.array(population_z, dtype=np.float64) if population_z else None


def _strongest(pictured: Sequence[tuple[SavedFit, StagedFit]]) -> list[StagedFit]:
    """Return the fit of the highest intensity of each expression."""
    return list(
        {
            fit.entry.expression: staged
            for fit, staged in sorted(pictured, key=lambda pair: pair[0].entry.intensity or 0)
        }.values()
    )


def _short(case: Case) -> str:
    """Return a short name of a case, for the heading of a row of pictures."""
    return case.short or case.fit.name


def _count(count: int | None) -> str:
    return "?" if count is None else str(count)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if isfinite(value)]
    return sum(known) / len(known) if known else np.nan


def _number_and_unit(value: float) -> tuple[str, str]:
    number, _, unit = mm(value).partition(" ")
    return number, unit
