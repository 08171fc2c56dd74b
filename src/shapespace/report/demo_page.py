"""The report of the demo: both experiments of the paper, beside what the paper states."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.model.shape_model import ShapeModel
from shapespace.report import sections
from shapespace.report.markup import (
    STATUS_WORDS,
    Cell,
    Column,
    as_list,
    as_mapping,
    facts,
    folded,
    listed,
    mm,
    moment,
    notice,
    paragraph,
    plain,
    table,
    tiles,
    words,
)
from shapespace.report.page import Page, Section, Step
from shapespace.report.saved import Folder, SavedFit, read_fit, staged_fit

if TYPE_CHECKING:
    from shapespace.report.staged import StagedFit

_NEEDED_BYTES = 1_500_000
_PICTURES = 30
_MODES_OF_A_CASE = 4


class DemoPage:
    """The report of the demo in the making.

    Args:
        folder: of the demo.
        demo: content of its demo.json.
        on_step: told of each picture.
    """

    def __init__(self, folder: Folder, demo: Mapping[str, Any], on_step: Step | None = None) -> None:
        self.page = Page("run the demo again", _PICTURES, on_step)
        self.folder = folder
        self.demo = demo
        self.quick = bool(demo.get("quick"))
        self._fits: dict[str, SavedFit] = {}
        self._staged: dict[str, StagedFit] = {}
        self._models: dict[str, ShapeModel] = {}

    def html(self) -> str:
        """Return the page."""
        title = "Low-dimensional surface parameterisation: the paper, run again"
        made = f"shapespace {self.demo.get('version', '')}, {moment(self.demo.get('created'))}"
        quick = " This was the quick demo: coarser scans and an earlier stop." if self.quick else ""
        lead = paragraph(
            "Raw surfaces are fitted by a statistical shape model with the modified ICP of Quan, Matuszewski, Shark "
            "and Ait-Boudaoud. All distances are in millimetres."
        ) + paragraph(f"{made}.{quick}", "soft")
        parts = [
            Section("Summary", "Summary", self.summary),
            Section("Experiment 1", "Experiment 1", self.experiment_1),
            Section("Experiment 2", "Experiment 2", self.experiment_2),
            Section("Settings, versions and hashes", "Settings", self.settings),
        ]
        return self.page.html(title, lead, f"Made by {made} from the files in its own folder.", parts)

    # What is read, once

    def fit(self, entry: Mapping[str, Any]) -> SavedFit:
        """Return the fit of an entry of demo.json."""
        key = str(entry.get("json"))
        if key not in self._fits:
            self._fits[key] = read_fit(self.folder, entry)
        return self._fits[key]

    def staged(self, fit: SavedFit, label: str) -> StagedFit:
        """Return what pictures of `fit` need, called `label`."""
        key = str(fit.entry.get("stages"))
        if key not in self._staged:
            self._staged[key] = staged_fit(self.folder, fit)
        return replace(self._staged[key], label=label)

    def model(self, owner: Mapping[str, Any]) -> ShapeModel:
        """Return the model of an experiment or a case."""
        name = str(owner.get("model"))
        if name not in self._models:
            self._models[name] = ShapeModel.load(self.folder.path(owner.get("model")))
        return self._models[name]

    def readable(self, entries: Sequence[Mapping[str, Any]]) -> tuple[list[SavedFit], list[str]]:
        """Return the fits whose records can be read, and one sentence for each that cannot."""
        found: list[SavedFit] = []
        problems: list[str] = []
        for entry in entries:
            try:
                found.append(self.fit(entry))
            except ShapespaceError as error:
                problems.append(str(error))
        return found, problems

    def pictured(self, fits: Sequence[SavedFit]) -> tuple[list[tuple[SavedFit, StagedFit]], str]:
        """Return the fits whose surfaces can be shown, and HTML that names the others."""
        shown: list[tuple[SavedFit, StagedFit]] = []
        absent: list[str] = []
        for fit in fits:
            if not fit.pictured:
                absent.append(f"{fit.name}: {fit.reason or 'no surface was kept'}")
                continue
            try:
                shown.append((fit, self.staged(fit, fit.label)))
            except ShapespaceError as error:
                absent.append(f"{fit.name}: {error}")
        return shown, notice("Not in the pictures", absent)

    def entries(self) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
        """Return the entries of the fits of both experiments."""
        first = as_list(as_mapping(self.demo.get("experiment1")).get("fits"))
        return first, [case["fit"] for case in self.cases() if case.get("fit")]

    def cases(self) -> list[Mapping[str, Any]]:
        """Return the cases of experiment 2."""
        return as_list(as_mapping(self.demo.get("experiment2")).get("cases"))

    # Summary

    def summary(self) -> str:
        """Return the figures of the whole run, the main picture, and the paper beside it."""
        return "\n".join(
            [
                self.tiles(),
                self.page.guarded("Main figure", self.main_figure),
                self.page.guarded("The paper beside this run", self.paper_table),
            ]
        )

    def tiles(self) -> str:
        """Return what was fitted and how much of it is to be trusted."""
        first, second = self.entries()
        fits, problems = self.readable([*first, *second])
        total = len(first) + len(second)
        counts = Counter(fit.status for fit in fits)
        tests = [fit for fit in fits[: len(first)] if fit.entry.get("intensity") and fit.status != "failed"]
        errors = [_inner(fit.entry, "vertex_error_mm", "mean") for fit in tests]
        floors = [_inner(fit.entry, "floor_mm", "mean") for fit in tests]
        distances = [fit.summary_mm("final", "model_to_scan", "mean") for fit in tests]
        modes = str(as_mapping(self.demo.get("experiment1")).get("modes_for_98_5", "–"))
        rows = [
            (
                str(counts["converged"]),
                f"of {total}",
                "fits converged with nothing found against them; the plain method is blind to some errors",
            ),
            (modes, "", "modes hold 98.5 % of the variance of one person's expressions"),
            (*_parted(_mean(distances)), "mean closest distance of the test faces, model to scan"),
            (*_parted(_mean(errors)), f"their true vertex error; the model's best possible is {mm(_mean(floors))}"),
        ]
        told = (
            f"{total} fits are reported: {len(first)} to simulated scans of one person's expressions, {len(second)} to "
            "scans of other people."
        )
        rest = ", ".join(
            f"{counts[key]} {word}" for key, word in STATUS_WORDS.items() if counts[key] and key != "converged"
        )
        told += f" Besides those that converged: {rest}." if rest else ""
        doubts = [
            f"{fit.name}: {STATUS_WORDS.get(fit.status, fit.status)}. {fit.reason}"
            for fit in fits
            if fit.status != "converged"
        ]
        return (
            paragraph(told)
            + tiles(rows)
            + notice("Not to be trusted without a look", doubts)
            + notice("Cannot be read", problems)
        )

    def main_figure(self) -> str:
        """Return the middle test face and the scans of experiment 2 with their fits."""
        from shapespace.report import figures

        first, _ = self.entries()
        fits, _ = self.readable(first)
        chosen: list[StagedFit] = []
        usable = [fit for fit in fits if fit.pictured and fit.entry.get("intensity")]
        usable.sort(key=lambda fit: fit.summary_mm("final", "model_to_scan", "mean"))
        unread: list[str] = []
        if usable:
            middle = usable[len(usable) // 2]
            chosen += self.kept(middle, f"{middle.label} (simulated)", unread)
        for case in self.cases():
            try:
                fit = self.fit(case["fit"])
            except ShapespaceError as error:
                unread.append(str(error))
                continue
            chosen += self.kept(fit, _short(case), unread) if fit.pictured else []
        if not chosen:
            raise FileFormatError("No fit kept a surface to show; run the demo again.")
        labels = [fit.label for fit in chosen]
        figure = figures.portrait_figure(chosen, labels, title="Raw scans and the models fitted to them")
        return self.page.figure(
            figure,
            "Rows: the test expression with the median distance, then each scan of experiment 2. The last column maps "
            "the distance of each model vertex to the scan, all rows on one scale.",
            alt="Scan, fitted model, both overlaid, and a distance map, for " + "; ".join(labels),
        ) + notice("Not in the picture", unread)

    def kept(self, fit: SavedFit, label: str, problems: list[str]) -> list[StagedFit]:
        """Return the one fit, or none and a sentence more in `problems`."""
        try:
            return [self.staged(fit, label)]
        except ShapespaceError as error:
            problems.append(str(error))
            return []

    def paper_table(self) -> str:
        """Return what the paper states beside what this run measured."""
        stored = as_list(self.demo.get("paper_table"))
        if not stored:
            raise FileFormatError("demo.json holds no comparison with the paper; run the demo again.")
        rows = [
            [
                Cell(str(row.get("quantity") or "")),
                Cell(str(row.get("paper") or "")),
                Cell(str(row.get("measured") or "")),
                Cell(str(row.get("truth") or "–")),
                Cell(str(row.get("why") or "It does not.")),
            ]
            for row in stored
        ]
        heads = ("Quantity", "Paper", "This run", "True error", "Why it differs")
        return table(
            [Column(head) for head in heads],
            rows,
            caption="Distances are to the closest point of the scan; the true error is between vertices that "
            "correspond, beside the floor that a perfect fit of the same model would reach.",
            stack=True,
        )

    # Experiment 1

    def experiment_1(self) -> str:
        """Return one person's expressions: model, fits, recognition."""
        experiment = as_mapping(self.demo["experiment1"])
        intro = (
            f"{experiment.get('title', 'Expressions of one person')}: {experiment.get('n_training', '?')} faces of one "
            f"simulated person make the model, {experiment.get('modes_for_98_5', '?')} modes hold 98.5 % of their "
            "variance, and unseen expressions are fitted as raw surfaces: triangulated anew, moved, turned, scaled, "
            "with 0.2 mm noise."
        )
        fits, problems = self.readable(as_list(experiment.get("fits")))
        parts = [
            ("The training faces", lambda: self.training(experiment)),
            ("Mean and first modes", lambda: self.modes(experiment, "Paper, figures 2 and 3. ")),
            ("The test faces", lambda: self.test_faces(fits)),
            ("Alignment, before and after", lambda: self.alignment(self.farthest(fits))),
            ("Test faces, fitted", lambda: self.all_fitted(fits)),
            ("Distance maps", lambda: self.maps(fits)),
            ("Convergence and coefficients", lambda: self.convergence(self.farthest(fits)[:1], experiment)),
            ("Every fit in numbers", lambda: self.numbers(fits)),
            ("Expressions as directions", lambda: self.b_plots(experiment, fits)),
        ]
        return (
            paragraph(intro)
            + notice("Cannot be read", problems)
            + "\n".join(self.page.guarded(heading, make) for heading, make in parts)
        )

    def numbers(self, fits: Sequence[SavedFit]) -> str:
        """Return the table of fits."""
        return sections.fits_table(fits, {}, caption="Distances at the end, in mm. A dash: not known.")

    def training(self, experiment: Mapping[str, Any]) -> str:
        """Return some of the faces that the model is made of."""
        from shapespace.report import figures

        examples = as_list(experiment.get("training_examples"))[: 8 if self.quick else 12]
        meshes = [self.folder.mesh(example.get("file")) for example in examples]
        figure = figures.faces_grid(
            meshes,
            [str(example.get("label", "")) for example in examples],
            title="Training faces: one person, mixed expressions",
        )
        count = experiment.get("n_training", "?")
        return self.page.figure(
            figure,
            f"Paper, figure 1. {len(meshes)} of the {count} faces that the model is made of.",
            alt=f"{len(meshes)} faces of one person with different expressions, in a grid",
        )

    def modes(self, owner: Mapping[str, Any], paper: str, to_move: int = sections.MODES_IN_WIDGET) -> str:
        """Return what the model is and does."""
        return sections.model_part(self.page, self.model(owner), figure_of=paper, to_move=to_move)

    def test_faces(self, fits: Sequence[SavedFit]) -> str:
        """Return the scans of the test faces."""
        from shapespace.report import figures

        shown, absent = self.pictured(_tests(fits))
        if not shown:
            return absent or '<p class="broken">No test face was fitted.</p>'
        figure = figures.faces_grid(
            [staged.scan for _, staged in shown],
            [staged.label for _, staged in shown],
            title="Test faces: raw surfaces, none of them in the training set",
        )
        return (
            self.page.figure(
                figure,
                "Paper, figure 8. The scans, turned back to the front by the fitted pose; simulated.",
                alt="Grid of test faces: " + ", ".join(staged.label for _, staged in shown),
            )
            + absent
        )

    def farthest(self, fits: Sequence[SavedFit]) -> list[SavedFit]:
        """Return the two test faces that start farthest from the model."""
        usable = [fit for fit in _tests(fits) if fit.pictured]
        usable.sort(key=lambda fit: -np.nan_to_num(fit.summary_mm("before", "model_to_scan", "max")))
        return usable[:2]

    def alignment(self, fits: Sequence[SavedFit]) -> str:
        """Return scan and model before and after, for the fits given."""
        if not fits:
            return '<p class="broken">No fit kept its surfaces.</p>'
        return "\n".join(
            self.one_alignment(fit, fit.label, "Paper, figures 4 to 7. ") for fit in fits[: 1 if self.quick else 2]
        )

    def one_alignment(self, fit: SavedFit, label: str, paper: str = "") -> str:
        """Return one fit to turn, its overlays by stage and its histograms."""
        from shapespace.report import figures

        staged = self.staged(fit, label)
        both = [f"{mm(fit.summary_mm(stage, 'model_to_scan', 'max'))} {said}" for stage, said in _STAGES.items()]
        out = ""
        if self.page.left > _NEEDED_BYTES:
            out = self.page.tried(lambda: sections.fit_to_turn(self.page, staged))
        return out + sections.in_columns(
            self.page.figure(
                figures.overlay_figure(staged),
                f"{paper}Where scan and model alternate finely, they coincide. Seen in the final pose's frame.",
                alt=f"Scan and model of {label} over each other, before and after each phase; largest distance "
                + listed(both),
            )
            + self.page.figure(
                figures.distance_histograms(staged),
                f"{paper}Scan points beyond the model's rim are not counted.",
                alt=f"Histograms of closest distances of {label}; largest from model to scan {listed(both)}",
            )
        )

    def all_fitted(self, fits: Sequence[SavedFit]) -> str:
        """Return every test face with its fitted model."""
        from shapespace.report import figures

        shown, absent = self.pictured(_tests(fits))
        if not shown:
            return absent
        shown = _strongest(shown) if self.quick else shown
        figure = figures.aligned_grid([staged for _, staged in shown], title="Scan and fitted model over each other")
        return (
            self.page.figure(
                figure,
                "Where the surfaces coincide, noise decides which one is seen: a fine mixture of both colours is a "
                "close fit, a large patch of one is not. Above each: mean distance, model to scan.",
                alt="Overlays of scan and fitted model for " + ", ".join(staged.label for _, staged in shown),
            )
            + absent
        )

    def b_plots(self, experiment: Mapping[str, Any], fits: Sequence[SavedFit]) -> str:
        """Return the coefficients of the test faces, and the scores of recognition."""
        scores = as_mapping(experiment.get("scores"))
        left_out = {str(name) for name in as_list(scores.get("left_out"))}
        kept = [fit for fit in fits if fit.status != "failed" and fit.name not in left_out]
        scans = [sections.coefficients_of(fit) for fit in _tests(kept)]
        neutral = next((sections.coefficients_of(fit) for fit in kept if not fit.entry.get("intensity")), None)
        out = ""
        if scans and all(len(scan.b) >= 2 for scan in scans):
            out = sections.lines_through_neutral(
                self.page, scans, neutral, figures_of=("Paper, figure 9. ", "Paper, figure 10. ")
            )
            if all(len(scan.b) >= 3 for scan in scans):
                out += self.page.tried(lambda: sections.scatter_to_turn(self.page, scans))
        return out + sections.score_tables(
            scores, many="Is each expression a line through neutral?", single="Are the expressions disjoint?"
        )

    def maps(self, fits: Sequence[SavedFit]) -> str:
        """Return threshold maps and distance maps of the test faces."""
        from shapespace.report import figures

        shown, absent = self.pictured(_tests(fits))
        if not shown:
            return absent
        chosen = [staged for _, staged in _strongest(shown)]
        pictures = self.page.figure(
            figures.threshold_figure(chosen),
            "Paper, figure 11, for the strongest level of each expression. Above each panel: share of the vertices "
            "within the limit.",
            alt="Maps of the face with the part within 2, 4, 6, 8 and 10 mm of the scan for "
            + ", ".join(staged.label for staged in chosen),
        )
        every = chosen if self.quick else [staged for _, staged in shown]
        pictures += self.page.figure(
            figures.distance_maps(every, title="The same distances on a finer scale"),
            "Distance from each model vertex to the scan, all on one scale.",
            alt="Distance maps on one scale for " + ", ".join(staged.label for staged in every),
        )
        return sections.in_columns(pictures) + absent

    def convergence(self, fits: Sequence[SavedFit], owner: Mapping[str, Any], label: str | None = None) -> str:
        """Return RMS by iteration, and the coefficients against the population."""
        from shapespace.report import figures

        out = ""
        for fit in fits:
            staged = self.staged(fit, label or fit.label)
            if staged.history:
                first, last = staged.history[0].rms_mm, staged.history[-1].rms_mm
                out += self.page.figure(
                    figures.history_figure(staged),
                    f"RMS of the closest distances that the fit itself sees. {fit.reason}",
                    alt=f"RMS falls from {mm(first)} to {mm(last)} in {len(staged.history)} steps",
                    chart=True,
                )
            population = owner.get("population_z")
            spread = None if not population else np.asarray(population, dtype=np.float64)
            out += self.page.figure(
                figures.coefficients_figure(staged, population=spread),
                "Coefficients in standard deviations of the training set. Beyond about 3 they are rare in it.",
                alt="Bar chart of z: " + ", ".join(f"{value:.1f}" for value in staged.z[:10]),
                chart=True,
            )
        return sections.in_columns(out)

    # Experiment 2

    def experiment_2(self) -> str:
        """Return models of many people, fitted to scans of somebody else."""
        cases = self.cases()
        if not cases:
            raise FileFormatError("demo.json holds no case of experiment 2; run the demo again.")
        scans = "a scan" if len(cases) == 1 else "scans"
        seen: set[str] = set()
        out: list[str] = []
        for case in cases:
            model = str(case.get("model"))
            first = model not in seen
            seen.add(model)

            def make(case: Mapping[str, Any] = case, first: bool = first) -> str:
                return self.case(case, with_model=first)

            out.append(self.page.guarded(str(case.get("title", "Case")), make))
        return paragraph(f"Models of many people's neutral faces, fitted to {scans} of somebody else.") + "\n".join(out)

    def case(self, case: Mapping[str, Any], *, with_model: bool) -> str:
        """Return one scan of experiment 2."""
        fit = self.fit(case["fit"])
        kind, note = "Simulated scan. " if case.get("simulated") else "Real scan. ", str(case.get("note") or "")
        if note.lower().startswith(("simulated", "real", "a real")):
            kind = ""
        told = f"The model is made of {case.get('n_training', '?')} people"
        if case.get("modes_for_98_5"):
            told += f"; {case['modes_for_98_5']} modes hold 98.5 % of the variance"
            told += f", and {case['n_modes']} are used." if case.get("n_modes") else "."
        else:
            told += f"; its {case.get('n_modes', '?')} modes hold less than 98.5 % of the variance."
        out = paragraph(kind + note, "notice" if case.get("simulated") else "") + paragraph(told) + self.numbers([fit])
        if not fit.pictured:
            return out
        label = _short(case)
        parts: list[tuple[str, Callable[[], str]]] = [
            ("Alignment", lambda: self.one_alignment(fit, label)),
            ("Distance maps", lambda: self.case_maps(fit, label)),
            ("Convergence and coefficients", lambda: self.convergence([fit], case, label)),
        ]
        if with_model and not self.quick:
            parts.append(("The model", lambda: self.modes(case, "", _MODES_OF_A_CASE)))
        return out + "\n".join(self.page.guarded(heading, make, 4) for heading, make in parts)

    def case_maps(self, fit: SavedFit, label: str) -> str:
        """Return threshold maps, signed maps and regions of one scan."""
        from shapespace.report import figures

        staged = self.staged(fit, label)
        distances = np.abs(staged.model_to_scan_mm["final"])
        shares = [f"{100 * float((distances <= limit).mean()):.0f} % within {limit:g} mm" for limit in (2, 4, 6, 8, 10)]
        return sections.in_columns(
            self.page.figure(
                figures.threshold_figure([staged]),
                "Paper, figure 11. Above each panel: share of the model's vertices within the limit.",
                alt="Maps of the face: " + ", ".join(shares),
            )
            + self.page.figure(
                figures.signed_maps(staged),
                "Signed distances both ways: positive where the scan lies outside of the model.",
                alt=f"Signed distance maps of {label}, model to scan and scan to model",
            )
        )

    # The rest

    def settings(self) -> str:
        """Return settings, times, versions and hashes."""
        demo = self.demo
        rows: list[tuple[str, str]] = [
            ("Machine", str(demo.get("machine", "not recorded"))),
            ("Seed", str(demo.get("seed", "not recorded"))),
        ]
        rows += [
            (f"Time, {words(key)}", f"{float(value):.1f} s") for key, value in as_mapping(demo.get("seconds")).items()
        ]
        rows += [(f"Setting, {words(key)}", plain(value)) for key, value in as_mapping(demo.get("settings")).items()]
        rows += [(f"Version, {key}", str(value)) for key, value in as_mapping(demo.get("versions")).items()]
        first, second = self.entries()
        fits, problems = self.readable([*first, *second])
        if fits:
            config = as_mapping(fits[0].record.get("config"))
            rows += [(f"Fit, {words(key)}", sections.setting(value)) for key, value in config.items()]
        hashes = [[Cell(fit.name), Cell(_hash(fit, "scan")), Cell(_hash(fit, "model"))] for fit in fits]
        return (
            facts(rows, caption="Settings and versions")
            + folded(
                "Content hashes (SHA-256)",
                table(
                    [Column("Fit"), Column("Scan"), Column("Model")],
                    hashes,
                    caption="Content hashes of the files that took part",
                    stack=True,
                ),
            )
            + notice("Cannot be read", problems)
        )


_STAGES: Mapping[str, str] = {"before": "before", "initial": "after phase 1", "final": "after phase 2"}


def _tests(fits: Sequence[SavedFit]) -> list[SavedFit]:
    return [fit for fit in fits if fit.entry.get("intensity")]


def _strongest(shown: Sequence[tuple[SavedFit, StagedFit]]) -> list[tuple[SavedFit, StagedFit]]:
    """Return the fit of the highest intensity of each expression."""
    best: dict[str, tuple[SavedFit, StagedFit]] = {}
    for fit, staged in sorted(shown, key=lambda pair: float(pair[0].entry.get("intensity") or 0)):
        best[str(fit.entry.get("expression"))] = (fit, staged)
    return list(best.values())


def _short(case: Mapping[str, Any]) -> str:
    """Return the name of a case that fits beside a row of pictures."""
    return str(case.get("short") or as_mapping(case.get("fit")).get("name") or "scan")


def _hash(fit: SavedFit, what: str) -> str:
    source = as_mapping(fit.record.get(what))
    return f"{source.get('name', '')} {source.get('hash', 'not recorded')}"


def _inner(entry: Mapping[str, Any], key: str, measure: str) -> float:
    value = as_mapping(entry.get(key)).get(measure)
    return float("nan") if value is None else float(value)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else float("nan")


def _parted(value: float) -> tuple[str, str]:
    number, _, unit = mm(value).partition(" ")
    return number, unit
