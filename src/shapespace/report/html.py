"""One self-contained HTML file from the results that the demo saved.

Every section is made on its own: one that cannot be made says why, and the others stand.
"""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.io.files import write_text
from shapespace.report.saved import Folder, SavedFit, read_fit, surfaces_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from shapespace.report.figures import Coefficients, StagedFit

LARGEST_REPORT_BYTES = 8_000_000
"""A report stays below this size, so that it can be mailed."""

_STATUS_WORDS = {
    "converged": "converged",
    "max_iterations": "stopped at the limit",
    "doubtful": "doubtful",
    "failed": "failed",
}
_SCORE_WORDS = {
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


def require_report_extra() -> None:
    """Raise unless the packages that draw are installed.

    Raises:
        ShapespaceError: they are not; the sentence says how to install them.
    """
    missing = [name for name in ("matplotlib", "PIL") if find_spec(name) is None]
    if missing:
        raise ShapespaceError(
            f"The report needs {' and '.join(missing)}, which is not installed; run pip install 'shapespace[report]'."
        )


def write_report(folder: Path) -> Path:
    """Write `folder`/report.html from the results saved in `folder`, and return its path.

    It reads demo.json and the files that it names, and runs no fit. The page needs no network and no script.

    Raises:
        FileError: demo.json cannot be read, or the report cannot be written.
        FileFormatError: demo.json is damaged.
        ShapespaceError: the extra `report` is not installed.
    """
    require_report_extra()
    results = Folder(Path(folder))
    page = _Page(results, results.json("demo.json")).html()
    path = Path(folder) / "report.html"
    write_text(path, page)
    return path


class _Page:
    """The page in the making: what was read once and is shown in several sections."""

    def __init__(self, folder: Folder, demo: Mapping[str, Any]) -> None:
        self.folder = folder
        self.demo = demo
        self.quick = bool(demo.get("quick"))
        self._fits: dict[str, SavedFit] = {}
        self._staged: dict[str, StagedFit] = {}

    def html(self) -> str:
        title = "Low-dimensional surface parameterisation: the paper, run again"
        css = files("shapespace.report").joinpath("assets/report.css").read_text(encoding="utf-8")
        made = f"shapespace {self.demo.get('version', '')}, {_moment(self.demo.get('created'))}"
        quick = " This was the quick demo: coarser scans and an earlier stop." if self.quick else ""
        sections = [
            self.guarded("Summary", self.summary),
            self.guarded("Experiment 1", self.experiment_1),
            self.guarded("Experiment 2", self.experiment_2),
            self.guarded("Settings, versions and hashes", self.settings),
        ]
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<link rel="icon" href="data:,">\n'
            f"<title>{_esc(title)}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<header>\n<h1>{_esc(title)}</h1>\n"
            "<p>Raw surfaces are fitted by a statistical shape model with the modified ICP of Quan, Matuszewski, Shark "
            "and Ait-Boudaoud. All distances are in millimetres.</p>\n"
            f'<p class="soft">{_esc(made)}.{_esc(quick)}</p>\n'
            '<nav aria-label="Sections"><a href="#summary">Summary</a><a href="#experiment-1">Experiment 1</a>'
            '<a href="#experiment-2">Experiment 2</a><a href="#settings-versions-and-hashes">Settings</a></nav>\n'
            "</header>\n<main>\n" + "\n".join(sections) + "\n</main>\n"
            f"<footer>Made by {_esc(made)} from the files in its own folder.</footer>\n</body>\n</html>\n"
        )

    def guarded(self, heading: str, make: Callable[[], str], level: int = 2) -> str:
        """Return a section, or its heading and why it could not be made."""
        anchor = heading.lower().replace(",", "").replace(" ", "-")
        mark = f' id="{_esc(anchor)}"' if level == 2 else ""
        top = f"<h{level}{mark}>{_esc(heading)}</h{level}>\n"
        try:
            body = make()
        except ShapespaceError as error:
            body = f'<p class="broken">This part could not be made. {_esc(str(error))}</p>'
        except Exception as error:
            # Result files can be wrong in more ways than can be listed, and one of them must not cost the rest.
            what = f"{type(error).__name__}: {error}"
            body = (
                '<p class="broken">This part could not be made, because a result file does not have the expected form '
                f"({_esc(what)}); run the demo again.</p>"
            )
        return f"<section>\n{top}{body}\n</section>"

    def fit(self, entry: Mapping[str, Any]) -> SavedFit:
        key = str(entry.get("json"))
        if key not in self._fits:
            self._fits[key] = read_fit(self.folder, entry)
        return self._fits[key]

    def staged(self, fit: SavedFit, label: str) -> StagedFit:
        from shapespace.report.figures import STAGE_TITLES, StagedFit

        key = str(fit.entry.get("stages"))
        if key not in self._staged:
            self._staged[key] = StagedFit(label, *surfaces_of(self.folder, fit, list(STAGE_TITLES)))
        return self._staged[key]

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
                absent.append(f"{fit.name}: {fit.record.get('reason', 'no surface was kept')}")
                continue
            try:
                shown.append((fit, self.staged(fit, fit.label)))
            except ShapespaceError as error:
                absent.append(f"{fit.name}: {error}")
        return shown, _problems("Not in the pictures", absent)

    def entries(self) -> tuple[list[Mapping[str, Any]], list[Mapping[str, Any]]]:
        """Return the entries of the fits of both experiments."""
        first = _list(_mapping(self.demo.get("experiment1")).get("fits"))
        return first, [case["fit"] for case in self.cases() if case.get("fit")]

    def cases(self) -> list[Mapping[str, Any]]:
        """Return the cases of experiment 2."""
        return _list(_mapping(self.demo.get("experiment2")).get("cases"))

    def summary(self) -> str:
        return "\n".join(
            [self.tiles(), self.guarded("Main figure", self.main_figure, 3), self.guarded(
                "The paper beside this run", self.paper_table, 3
            )]
        )  # fmt: skip

    def tiles(self) -> str:
        first, second = self.entries()
        fits, problems = self.readable([*first, *second])
        counts = Counter(fit.status for fit in fits)
        trusted = counts["converged"]
        first_fits = fits[: len(first)]
        tests = [fit for fit in first_fits if fit.entry.get("intensity") and fit.status != "failed"]
        errors = [_inner(fit.entry, "vertex_error_mm", "mean") for fit in tests]
        floors = [_inner(fit.entry, "floor_mm", "mean") for fit in tests]
        distances = [fit.summary_mm("final", "model_to_scan", "mean") for fit in tests]
        rest = ", ".join(
            f"{counts[key]} {word}" for key, word in _STATUS_WORDS.items() if counts[key] and key != "converged"
        )
        modes = str(_mapping(self.demo.get("experiment1")).get("modes_for_98_5", "–"))
        tiles = [
            (
                f"{trusted} <small>of {len(first) + len(second)}</small>",
                "fits converged with nothing found against them; the plain method is blind to some errors",
            ),
            (_esc(modes), "modes hold 98.5 % of the variance of one person's expressions"),
            (_mm_html(_mean(distances)), "mean closest distance of the test faces, model to scan"),
            (_mm_html(_mean(errors)), f"their true vertex error; the model's best possible is {_mm(_mean(floors))}"),
        ]
        blocks = "".join(f"<div><dd>{value}</dd><dt>{_esc(text)}</dt></div>" for value, text in tiles)
        told = (
            f"{len(first) + len(second)} fits are reported: {len(first)} to simulated scans of one person's "
            f"expressions, {len(second)} to scans of other people."
        )
        told += f" Besides those that converged: {rest}." if rest else ""
        doubts = [
            f"{fit.name}: {_STATUS_WORDS.get(fit.status, fit.status)}. {fit.record.get('reason', '')}"
            for fit in fits
            if fit.status != "converged"
        ]
        return (
            f'<p>{_esc(told)}</p>\n<dl class="tiles">{blocks}</dl>\n'
            + _problems("Not to be trusted without a look", doubts)
            + _problems("Cannot be read", problems)
        )

    def main_figure(self) -> str:
        from shapespace.report import figures

        first, _ = self.entries()
        fits, _ = self.readable(first)
        chosen: list[tuple[StagedFit, str]] = []
        usable = [fit for fit in fits if fit.pictured and fit.entry.get("intensity")]
        usable.sort(key=lambda fit: fit.summary_mm("final", "model_to_scan", "mean"))
        if usable:
            middle = usable[len(usable) // 2]
            chosen.append((self.staged(middle, middle.label), f"{middle.label} (simulated)"))
        unread: list[str] = []
        for case in self.cases():
            try:
                fit = self.fit(case["fit"])
                if fit.pictured:
                    chosen.append((self.staged(fit, _short(case)), _short(case)))
            except ShapespaceError as error:
                unread.append(str(error))
        if not chosen:
            raise FileFormatError("No fit kept a surface to show; run the demo again.")
        figure = figures.portrait_figure(
            [fit for fit, _ in chosen], [label for _, label in chosen], title="Raw scans and the models fitted to them"
        )
        return _figure(
            figure,
            "Rows: the test expression with the median distance, then each scan of experiment 2. The last column maps "
            "the distance of each model vertex to the scan, all rows on one scale.",
            alt="Scan, fitted model, both overlaid, and a distance map, for " + "; ".join(label for _, label in chosen),
        ) + _problems("Not in the picture", unread)

    def paper_table(self) -> str:
        rows = _list(self.demo.get("paper_table"))
        if not rows:
            raise FileFormatError("demo.json holds no comparison with the paper; run the demo again.")
        heads = ("Quantity", "Paper", "This run", "True error", "Why it differs")
        body = ""
        for row in rows:
            cells = [
                row.get("paper"),
                row.get("measured"),
                row.get("truth") or "–",
                row.get("why") or "It does not.",
            ]
            body += f'<tr><th scope="row">{_esc(row.get("quantity"))}</th>' + "".join(
                f'<td data-label="{_esc(head)}">{_esc(cell)}</td>' for head, cell in zip(heads[1:], cells, strict=True)
            ) + "</tr>\n"  # fmt: skip
        head = "".join(f'<th scope="col">{_esc(text)}</th>' for text in heads)
        return (
            '<div class="table"><table class="stack"><caption>Distances are to the closest point of the scan; the true '
            "error is between vertices that correspond, beside the floor that a perfect fit of the same model would "
            f"reach.</caption><thead><tr>{head}</tr></thead><tbody>\n{body}</tbody></table></div>"
        )

    def experiment_1(self) -> str:
        experiment = _mapping(self.demo["experiment1"])
        intro = (
            f"{experiment.get('title', 'Expressions of one person')}: {experiment.get('n_training', '?')} faces of one "
            f"simulated person make the model, {experiment.get('modes_for_98_5', '?')} modes hold 98.5 % of their "
            "variance, and unseen expressions are fitted as raw surfaces: triangulated anew, moved, turned, scaled, "
            "with 0.2 mm noise."
        )
        fits, problems = self.readable(_list(experiment.get("fits")))
        parts = [
            ("The training faces", lambda: self.training(experiment)),
            ("Mean and first modes", lambda: self.modes(experiment)),
            ("The test faces", lambda: self.test_faces(fits)),
            ("Alignment, before and after", lambda: self.alignment(self.farthest(fits))),
            ("Test faces, fitted", lambda: self.all_fitted(fits)),
            ("Expressions as directions", lambda: self.b_plots(experiment, fits)),
            ("Distance maps", lambda: self.maps(fits)),
            ("Convergence and coefficients", lambda: self.convergence(self.farthest(fits)[:1], experiment)),
            ("Every fit in numbers", lambda: _fit_table(fits)),
        ]
        return (
            f"<p>{_esc(intro)}</p>\n"
            + _problems("Cannot be read", problems)
            + "\n".join(self.guarded(heading, make, 3) for heading, make in parts)
        )

    def training(self, experiment: Mapping[str, Any]) -> str:
        from shapespace.report import figures

        examples = _list(experiment.get("training_examples"))[: 8 if self.quick else 12]
        meshes = [self.folder.mesh(example.get("file")) for example in examples]
        figure = figures.faces_grid(
            meshes,
            [str(example.get("label", "")) for example in examples],
            title="Training faces: one person, mixed expressions",
        )
        count = experiment.get("n_training", "?")
        return _figure(
            figure,
            f"Paper, figure 1. {len(meshes)} of the {count} faces that the model is made of.",
            alt=f"{len(meshes)} faces of one person with different expressions, in a grid",
        )

    def modes(self, experiment: Mapping[str, Any], paper: str = "Paper, figures 2 and 3. ") -> str:
        from shapespace.report import figures

        arrays = self.folder.arrays(experiment.get("mode_shapes"))
        modes = arrays["basis5"].astype(np.float64)
        shown = modes[:5]
        picture = figures.modes_figure(
            arrays["mean"].astype(np.float64), arrays["faces"], shown, title="The mean face and what each mode moves"
        )
        out = _figure(
            picture,
            f"{paper}Each row: the mean with the mode at −3, 0 and +3 standard deviations, and how far each point "
            "moves at 3. One scale for all rows.",
            alt=f"Mean face and the first {len(shown)} modes at minus and plus three standard deviations, with maps",
        )
        cumulative = np.asarray(experiment.get("cumulative_variance") or [], dtype=np.float64)
        if len(cumulative):
            out += _figure(
                figures.spectrum_figure(cumulative, title="How many modes the variance needs"),
                "Share of the training set's variance that the first modes hold.",
                alt=f"Spectrum: {_modes_needed(cumulative)}",
                chart=True,
            )
        return out

    def test_faces(self, fits: Sequence[SavedFit]) -> str:
        from shapespace.report import figures

        shown, absent = self.pictured(_tests(fits))
        if not shown:
            return absent or '<p class="broken">No test face was fitted.</p>'
        figure = figures.faces_grid(
            [staged.scan for _, staged in shown],
            [staged.name for _, staged in shown],
            title="Test faces: raw surfaces, none of them in the training set",
        )
        return (
            _figure(
                figure,
                "Paper, figure 8. The scans, turned back to the front by the fitted pose; simulated.",
                alt="Grid of test faces: " + ", ".join(staged.name for _, staged in shown),
            )
            + absent
        )

    def farthest(self, fits: Sequence[SavedFit]) -> list[SavedFit]:
        """Return the two test faces that start farthest from the model."""
        usable = [fit for fit in _tests(fits) if fit.pictured]
        usable.sort(key=lambda fit: -np.nan_to_num(fit.summary_mm("before", "model_to_scan", "max")))
        return usable[:2]

    def alignment(self, fits: Sequence[SavedFit]) -> str:
        if not fits:
            return '<p class="broken">No fit kept its surfaces.</p>'
        return "\n".join(
            self.one_alignment(fit, fit.label, "Paper, figures 4 to 7. ") for fit in fits[: 1 if self.quick else 2]
        )

    def one_alignment(self, fit: SavedFit, label: str, paper: str = "") -> str:
        from shapespace.report import figures

        staged = self.staged(fit, label)
        both = [
            f"{_mm(fit.summary_mm(stage, 'model_to_scan', 'max'))} {words}"
            for stage, words in figures.STAGE_TITLES.items()
        ]
        return _figure(
            figures.overlay_figure(staged, title=f"{label}: scan and model, the nearer one shown"),
            f"{paper}Where scan and model alternate finely, they lie on each other. Seen in the final pose's frame.",
            alt=f"Scan and model of {label} over each other, before, after phase 1, after phase 2; largest distance "
            + ", ".join(both),
        ) + _figure(
            figures.distance_histograms(staged, title=f"{label}: closest distances, both ways"),
            f"{paper}Each panel has its own axis. Scan points beyond the model's rim are not counted.",
            alt=f"Histograms of closest distances of {label}; largest from model to scan: " + ", ".join(both),
        )

    def all_fitted(self, fits: Sequence[SavedFit]) -> str:
        from shapespace.report import figures

        shown, absent = self.pictured(_tests(fits))
        if not shown:
            return absent
        shown = _strongest(shown) if self.quick else shown
        figure = figures.aligned_grid([s for _, s in shown], title="Scan and fitted model over each other")
        return (
            _figure(
                figure,
                "Where the surfaces coincide, noise decides which one is seen: a fine mixture of both colours is a "
                "close fit, a large patch of one is not. Above each: mean distance, model to scan.",
                alt="Overlays of scan and fitted model for " + ", ".join(s.name for _, s in shown),
            )
            + absent
        )

    def b_plots(self, experiment: Mapping[str, Any], fits: Sequence[SavedFit]) -> str:
        from shapespace.report import figures

        scores = _mapping(experiment.get("scores"))
        left_out = {str(name) for name in _list(scores.get("left_out"))}
        kept = [fit for fit in fits if fit.status != "failed" and fit.name not in left_out]
        scans = [_coefficients(fit) for fit in _tests(kept)]
        neutral = next((fit for fit in kept if not fit.entry.get("intensity")), None)
        neutral_b = None if neutral is None else neutral.numbers("b")
        neutral_z = None if neutral is None else neutral.numbers("z")
        out = ""
        if scans and all(len(scan.b) >= 2 for scan in scans):
            about = (
                "Larger marks are stronger expressions. Lines pass through the fitted neutral face and fit best in all "
                "coefficients, each in its standard deviations."
            )
            if neutral is None:
                about = "Larger marks are stronger expressions. No neutral face was fitted, so no lines are drawn."
            lines = {"neutral_b": neutral_b, "neutral_z": neutral_z}
            out += _figure(
                figures.b_plane(scans, title="Test expressions in the first two coefficients", **lines),
                f"Paper, figure 9. {about}",
                alt=f"Scatter plot of b1 and b2 for {len(scans)} faces: each expression runs along its own line",
                chart=True,
            )
            if all(len(scan.b) >= 3 for scan in scans):
                out += _figure(
                    figures.b_space(scans, title="The first three coefficients, from two sides", **lines),
                    "Paper, figure 10. Grey lines drop to the floor of the box.",
                    alt=f"Two views of b1, b2 and b3 for {len(scans)} faces with a line for each expression",
                )
        return out + _score_tables(scores)

    def maps(self, fits: Sequence[SavedFit]) -> str:
        from shapespace.report import figures

        shown, absent = self.pictured(_tests(fits))
        if not shown:
            return absent
        chosen = [staged for _, staged in _strongest(shown)]
        out = _figure(
            figures.threshold_figure(chosen, title="Where the model lies within 2 to 10 mm of the scan"),
            "Paper, figure 11, for the strongest level of each expression. Above each panel: share of the model's "
            "vertices within the limit.",
            alt="Maps of the face with the part within 2, 4, 6, 8 and 10 mm of the scan for "
            + ", ".join(staged.name for staged in chosen),
        )
        every = chosen if self.quick else [staged for _, staged in shown]
        out += _figure(
            figures.distance_maps(every, title="The same distances on a finer scale"),
            "Distance from each model vertex to the scan; one scale, which ends at the 99th percentile.",
            alt="Distance maps on one scale for " + ", ".join(staged.name for staged in every),
        )
        return out + absent

    def convergence(self, fits: Sequence[SavedFit], owner: Mapping[str, Any], label: str | None = None) -> str:
        from shapespace.report import figures

        out = ""
        for fit in fits:
            name = label or fit.label
            history = fit.history()
            if history:
                out += _figure(
                    figures.history_figure(history, title=f"{name}: RMS distance while fitting"),
                    f"RMS of the closest distances that the fit itself sees. {fit.record.get('reason', '')}",
                    alt=f"RMS falls from {_mm(history[0][2])} to {_mm(history[-1][2])} in {len(history)} steps",
                    chart=True,
                )
            population = owner.get("population_z")
            spread = None if not population else np.asarray(population, dtype=np.float64)
            z = fit.numbers("z")
            out += _figure(
                figures.coefficients_figure(z, title=f"{name}: coefficients", population=spread),
                "Coefficients in standard deviations of the training set. Beyond about 3 they are rare in it.",
                alt="Bar chart of z: " + ", ".join(f"{value:.1f}" for value in z[:10]),
                chart=True,
            )
        return out

    def experiment_2(self) -> str:
        cases = self.cases()
        if not cases:
            raise FileFormatError("demo.json holds no case of experiment 2; run the demo again.")
        scans = "a scan" if len(cases) == 1 else "scans"
        intro = f"<p>Models of many people's neutral faces, fitted to {scans} of somebody else.</p>\n"
        seen: set[str] = set()
        out: list[str] = []
        for case in cases:
            model = str(case.get("mode_shapes"))
            first = model not in seen
            seen.add(model)

            def make(case: Mapping[str, Any] = case, first: bool = first) -> str:
                return self.case(case, with_model=first)

            out.append(self.guarded(str(case.get("title", "Case")), make, 3))
        return intro + "\n".join(out)

    def case(self, case: Mapping[str, Any], *, with_model: bool) -> str:
        fit = self.fit(case["fit"])
        kind, note = "Simulated scan. " if case.get("simulated") else "Real scan. ", str(case.get("note") or "")
        if note.lower().startswith(("simulated", "real", "a real")):
            kind = ""
        facts = f"The model is made of {case.get('n_training', '?')} people"
        if case.get("modes_for_98_5"):
            facts += f"; {case['modes_for_98_5']} modes hold 98.5 % of the variance"
            facts += f", and {case['n_modes']} are used." if case.get("n_modes") else "."
        else:
            facts += f"; its {case.get('n_modes', '?')} modes hold less than 98.5 % of the variance."
        mark = ' class="notice"' if case.get("simulated") else ""
        out = f"<p{mark}>{_esc(kind + note)}</p>\n<p>{_esc(facts)}</p>\n" + _fit_table([fit])
        if not fit.pictured:
            return out
        label = _short(case)
        parts: list[Callable[[], str]] = [
            lambda: self.one_alignment(fit, label),
            lambda: self.case_thresholds(fit, label),
            lambda: self.convergence([fit], case, label),
        ]
        if with_model and not self.quick:
            parts.append(lambda: self.modes(case, "The same for this model of many people (paper, figures 2 and 3). "))
        headings = ["Alignment", "Distance maps", "Convergence and coefficients", "The model"]
        return out + "\n".join(self.guarded(h, make, 4) for h, make in zip(headings, parts, strict=False))

    def case_thresholds(self, fit: SavedFit, label: str) -> str:
        from shapespace.report import figures

        staged = self.staged(fit, label)
        shares = [
            f"{100 * (staged.model_to_scan_mm['final'] <= limit).mean():.0f} % within {limit:g} mm"
            for limit in figures.THRESHOLDS_MM
        ]
        return _figure(
            figures.threshold_figure([staged], title=f"{label}: where the model lies within 2 to 10 mm of the scan"),
            "Paper, figure 11. Above each panel: share of the model's vertices within the limit.",
            alt="Maps of the face: " + ", ".join(shares),
        )

    def settings(self) -> str:
        demo = self.demo
        rows: list[tuple[str, str]] = [
            ("Machine", str(demo.get("machine", "not recorded"))),
            ("Seed", str(demo.get("seed", "not recorded"))),
        ]
        rows += [
            (f"Time, {_words(key)}", f"{float(value):.1f} s") for key, value in _mapping(demo.get("seconds")).items()
        ]
        rows += [
            (f"Setting, {_words(key)}", _plain_value(value)) for key, value in _mapping(demo.get("settings")).items()
        ]
        rows += [(f"Version, {key}", str(value)) for key, value in _mapping(demo.get("versions")).items()]
        first, second = self.entries()
        fits, problems = self.readable([*first, *second])
        if fits:
            rows += [
                (f"Fit, {_words(key)}", _plain_value(value))
                for key, value in _mapping(fits[0].record.get("config")).items()
            ]
        hashes = "".join(
            f'<tr><th scope="row">{_esc(fit.name)}</th><td><code>{_esc(_hash(fit, "scan"))}</code></td>'
            f"<td><code>{_esc(_hash(fit, 'model'))}</code></td></tr>\n"
            for fit in fits
        )
        body = "".join(f'<tr><th scope="row">{_esc(key)}</th><td>{_esc(value)}</td></tr>\n' for key, value in rows)
        return (
            f'<div class="table"><table><tbody>\n{body}</tbody></table></div>\n'
            "<details><summary>Content hashes (SHA-256)</summary>\n"
            '<div class="table"><table><thead><tr><th scope="col">Fit</th><th scope="col">Scan</th>'
            f'<th scope="col">Model</th></tr></thead><tbody>\n{hashes}</tbody></table></div></details>'
            + _problems("Cannot be read", problems)
        )


def _figure(figure: Figure, caption: str, *, alt: str, chart: bool = False) -> str:
    from shapespace.report.figures import encode_webp

    data, (width, height) = encode_webp(figure, lossless=chart)
    source = base64.b64encode(data).decode("ascii")
    kind = "chart" if chart else "wide"
    scroll = "" if chart else ' tabindex="0"'
    return (
        f'<figure class="{kind}"><div class="plate"{scroll}><img alt="{_esc(alt)}" width="{width}" height="{height}" '
        f'src="data:image/webp;base64,{source}"></div>\n<figcaption>{_esc(caption)}</figcaption></figure>\n'
    )


def _fit_table(fits: Sequence[SavedFit]) -> str:
    heads = (
        "Scan",
        "Status",
        "Model to scan, mean",
        "Model to scan, max",
        "Scan to model, mean",
        "True vertex error, mean",
        "True vertex error, max",
        "Floor of that, mean",
        "Steps",
    )
    body = ""
    for fit in fits:
        lengths = [
            fit.summary_mm("final", "model_to_scan", "mean"),
            fit.summary_mm("final", "model_to_scan", "max"),
            fit.summary_mm("final", "scan_to_model", "mean"),
            _inner(fit.entry, "vertex_error_mm", "mean"),
            _inner(fit.entry, "vertex_error_mm", "max"),
            _inner(fit.entry, "floor_mm", "mean"),
        ]
        cells = [_mm(length).removesuffix(" mm") for length in lengths]
        cells.append(" + ".join(str(value) for value in _mapping(fit.record.get("iterations")).values()) or "–")
        kind = fit.status if fit.status in _STATUS_WORDS else "failed"
        body += (
            f'<tr><th scope="row">{_esc(fit.name)}</th>'
            f'<td><span class="status {kind}">{_esc(_STATUS_WORDS.get(fit.status, fit.status))}</span></td>'
            + "".join(f'<td class="number">{_esc(cell)}</td>' for cell in cells)
            + "</tr>\n"
        )
    head = "".join(
        f'<th scope="col"{" class=number" if k > 1 else ""}>{_esc(text)}</th>' for k, text in enumerate(heads)
    )
    return (
        '<div class="table" tabindex="0"><table class="figures"><caption>Distances at the end, in mm; steps of phase 1 '
        f"and phase 2. A dash: not known.</caption><thead><tr>{head}</tr></thead>"
        f"<tbody>\n{body}</tbody></table></div>\n"
    )


def _score_tables(scores: Mapping[str, Any]) -> str:
    """Show nested scores: those by expression as one table, single numbers as another."""
    by_class = {key: _mapping(value) for key, value in scores.items() if key.startswith("line_")}
    out = ""
    if by_class:
        names = list(dict.fromkeys(str(name) for value in by_class.values() for name in value))
        head = "".join(f'<th scope="col" class="number">{_esc(name)}</th>' for name in names)
        body = "".join(
            f'<tr><th scope="row">{_esc(_SCORE_WORDS.get(key, _words(key)))}</th>'
            + "".join(f'<td class="number">{_esc(_score(value.get(name)))}</td>' for name in names)
            + "</tr>\n"
            for key, value in by_class.items()
        )
        out += (
            '<div class="table" tabindex="0"><table class="figures"><caption>Is each expression a line through '
            f'neutral?</caption><thead><tr><th scope="col">Score</th>{head}</tr></thead>'
            f"<tbody>\n{body}</tbody></table></div>\n"
        )
    rows: list[tuple[str, str]] = []
    for key, value in scores.items():
        if key in by_class:
            continue
        if isinstance(value, Mapping):
            inner = _mapping(cast(object, value))
            rows += [(_SCORE_WORDS.get(name, _words(name)), _score(item)) for name, item in inner.items()]
        else:
            rows.append((_SCORE_WORDS.get(key, _words(key)), _score(value)))
    if rows:
        body = "".join(
            f'<tr><th scope="row">{_esc(key)}</th><td class="number">{_esc(value)}</td></tr>\n' for key, value in rows
        )
        out += (
            '<div class="table"><table class="figures"><caption>Are the expressions disjoint?</caption><tbody>\n'
            f"{body}</tbody></table></div>\n"
        )
    return out


def _problems(heading: str, sentences: Sequence[str]) -> str:
    if not sentences:
        return ""
    items = "".join(f"<li>{_esc(text)}</li>" for text in sentences)
    return f'<div class="notice"><strong>{_esc(heading)}</strong><ul>{items}</ul></div>\n'


def _coefficients(fit: SavedFit) -> Coefficients:
    from shapespace.report.figures import Coefficients

    return Coefficients(
        fit.name,
        str(fit.entry.get("expression")),
        float(fit.entry.get("intensity") or 0),
        fit.numbers("b"),
        fit.numbers("z"),
    )


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
    if case.get("simulated"):
        return "simulated stranger"
    scan = str(case["fit"].get("name", "scan"))
    return f"{scan.replace('_', ', ')} model"


def _modes_needed(cumulative: np.ndarray[Any, np.dtype[np.float64]]) -> str:
    parts = [
        f"{100 * share:g} % in {int(np.searchsorted(cumulative, share)) + 1} modes"
        for share in (0.90, 0.95, 0.98, 0.985, 0.99)
        if cumulative[-1] >= share
    ]
    return ", ".join(parts) or f"{len(cumulative)} modes"


def _hash(fit: SavedFit, what: str) -> str:
    source = _mapping(fit.record.get(what))
    return f"{source.get('name', '')} {source.get('hash', 'not recorded')}"


def _inner(entry: Mapping[str, Any], key: str, measure: str) -> float:
    value = _mapping(entry.get(key)).get(measure)
    return float("nan") if value is None else float(value)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else float("nan")


def _mm(value: float) -> str:
    """Return a length with three or so digits and its unit."""
    if not math.isfinite(value):
        return "–"
    return f"{value:.0f} mm" if abs(value) >= 100 else f"{value:.1f} mm" if abs(value) >= 10 else f"{value:.2f} mm"


def _mm_html(value: float) -> str:
    number, _, unit = _mm(value).partition(" ")
    return f"{_esc(number)} <small>{_esc(unit)}</small>"


def _plain_value(value: object) -> str:
    """Return a setting or a score as text, numbers with three digits or so."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return "–" if not math.isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, list):
        return ", ".join(_plain_value(item) for item in _list(cast(object, value))) or "none"
    return str(value)


def _moment(value: object) -> str:
    """Return an ISO time stamp as people write it, or the text as it is."""
    try:
        return datetime.fromisoformat(str(value)).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    except (ValueError, OverflowError):
        return str(value)


def _score(value: object) -> str:
    """Return a score with three decimals, as they are compared with each other."""
    return f"{value:.3f}" if isinstance(value, float) and abs(value) < 10 else _plain_value(value)


def _mapping(value: object) -> Mapping[str, Any]:
    """Return a JSON object, or an empty one where there is none."""
    return cast(Mapping[str, Any], value) if isinstance(value, Mapping) else {}


def _list(value: object) -> list[Any]:
    """Return a JSON list, or an empty one where there is none."""
    return cast(list[Any], value) if isinstance(value, list) else []


def _words(key: str) -> str:
    return key.replace("_", " ")


def _esc(text: object) -> str:
    return escape("" if text is None else str(text), quote=True)
