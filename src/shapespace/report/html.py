"""One self-contained HTML report from the saved results of a demo; it runs no algorithm of its own."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Callable, Mapping, Sequence
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.io.files import read_bytes, write_text
from shapespace.io.meshes import read_mesh
from shapespace.types import Mesh, Similarity

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from shapespace.report.figures import Coefficients, StagedFit

_STAGES = ("before", "initial", "final")
_TRUSTED = ("converged", "max_iterations")


def write_report(folder: Path) -> Path:
    """Write `folder/report.html` from the results that `shapespace demo` saved in `folder`, and return its path.

    Raises:
        FileError: results are missing, or the report cannot be written.
        FileFormatError: `demo.json` is damaged.
        ShapespaceError: the extra `report` is not installed.
    """
    if find_spec("matplotlib") is None:
        raise ShapespaceError("The report needs matplotlib; install it with: pip install 'shapespace[report]'.")
    try:
        demo = cast(dict[str, Any], json.loads(read_bytes(folder / "demo.json")))
    except ValueError as error:
        raise FileFormatError(f"{folder / 'demo.json'} is damaged; run shapespace demo again.") from error
    page = _Page(folder)
    page.section("Summary", lambda: _summary(page, demo))
    page.section("Experiment 1: expressions of one person", lambda: _experiment_1(page, demo["experiment1"]))
    page.section("Experiment 2: many people, and a scan of somebody else", lambda: _experiment_2(page, demo))
    page.section("Settings, versions and hashes", lambda: _settings(page, demo))
    path = folder / "report.html"
    write_text(path, page.html(f"shapespace {demo.get('version', '')}: the paper, measured"))
    return path


class _Page:
    """Collects sections; one that fails says why and leaves the others alone."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._parts: list[str] = []
        self._titles: list[str] = []
        self._cache: dict[str, StagedFit] = {}

    def section(self, title: str, fill: Callable[[], None]) -> None:
        self._titles.append(title)
        self._parts.append(f'<section id="s{len(self._titles)}"><h2>{_text(title)}</h2>')
        self.attempt("This section", fill)
        self._parts.append("</section>")

    def attempt(self, what: str, fill: Callable[[], None]) -> None:
        mark = len(self._parts)
        try:
            fill()
        except (ShapespaceError, OSError, KeyError, IndexError, ValueError, TypeError, AttributeError) as error:
            del self._parts[mark:]
            reason = f"{type(error).__name__}: {error}" if isinstance(error, (KeyError, TypeError)) else str(error)
            self._parts.append(f'<p class="failed">{_text(what)} could not be drawn: {_text(reason)}</p>')

    def heading(self, title: str) -> None:
        self._parts.append(f"<h3>{_text(title)}</h3>")

    def paragraph(self, text: str, kind: str = "") -> None:
        self._parts.append(f'<p class="{kind}">{_text(text)}</p>' if kind else f"<p>{_text(text)}</p>")

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[object]], caption: str) -> None:
        head = "".join(f'<th scope="col">{_text(column)}</th>' for column in columns)
        body = "".join(
            "<tr>"
            + "".join(
                f'<td data-label="{_text(column)}">{_text(cell)}</td>'
                for column, cell in zip(columns, row, strict=True)
            )
            + "</tr>"
            for row in rows
        )
        self._parts.append(
            f'<div class="wide"><table><caption>{_text(caption)}</caption><thead><tr>{head}</tr></thead>'
            f"<tbody>{body}</tbody></table></div>"
        )

    def figure(self, what: str, draw: Callable[[], Figure], *, chart: bool = False) -> None:
        """Draw one figure; `what` is its alternative text and its caption."""
        from shapespace.report.figures import encode_webp

        def fill() -> None:
            data, (width, height) = encode_webp(draw(), lossless=chart)
            image = base64.b64encode(data).decode()
            self._parts.append(
                f'<figure class="{"chart" if chart else "stills"}"><img loading="lazy" width="{width}" '
                f'height="{height}" alt="{_text(what)}" src="data:image/webp;base64,{image}">'
                f"<figcaption>{_text(what)}</figcaption></figure>"
            )

        self.attempt(what, fill)

    def html(self, title: str) -> str:
        style = resources.files("shapespace.report").joinpath("assets/report.css").read_text(encoding="utf-8")
        links = "".join(f'<li><a href="#s{i}">{_text(section)}</a></li>' for i, section in enumerate(self._titles, 1))
        return (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            '<meta name="color-scheme" content="light dark">'
            f"<title>{_text(title)}</title><style>{style}</style></head><body>"
            f"<header><h1>{_text(title)}</h1><nav><ol>{links}</ol></nav></header>"
            f"<main>{''.join(self._parts)}</main></body></html>\n"
        )

    def fit(self, entry: Mapping[str, Any]) -> StagedFit:
        """Return a saved fit with scan and model in the model's frame, mm."""
        from shapespace.report.figures import StagedFit

        name = str(entry["name"])
        if name not in self._cache:
            record = _read_json(self.folder / entry["json"])
            mm = float(record["mm_per_scan_unit"])
            T = record["T_scan_model"]
            T_scan_model = Similarity(mm * T["scale"], np.array(T["rotation"]), mm * np.array(T["translation"]))
            T_model_scan = T_scan_model.inverse()
            scan = read_mesh(self.folder / entry["scan"])
            with np.load(self.folder / entry["stages"], allow_pickle=False) as stages:
                arrays = {key: stages[key] for key in stages.files}
            self._cache[name] = StagedFit(
                name=name,
                scan=Mesh(T_model_scan.apply(mm * scan.vertices), scan.faces, name=name),
                surfaces={
                    stage: Mesh(T_model_scan.apply(arrays[stage]), arrays.get("faces"), name=stage) for stage in _STAGES
                },
                model_to_scan_mm={s: arrays[f"model_to_scan_{s}"].astype(np.float64) for s in _STAGES},
                scan_to_model_mm={s: arrays[f"scan_to_model_{s}"].astype(np.float64) for s in _STAGES},
            )
        return self._cache[name]


def _summary(page: _Page, demo: Mapping[str, Any]) -> None:
    fits = [*demo["experiment1"]["fits"], *(case["fit"] for case in demo["experiment2"]["cases"])]
    counts = {status: sum(fit["status"] == status for fit in fits) for status in {fit["status"] for fit in fits}}
    trusted = sum(counts.get(status, 0) for status in _TRUSTED)
    page.paragraph(
        f"{len(fits)} raw surfaces were fitted by the paper's modified ICP: {trusted} can be trusted, "
        f"{counts.get('doubtful', 0)} are doubtful and {counts.get('failed', 0)} failed. "
        f"{'Quick run. ' if demo.get('quick') else ''}The whole took {demo['seconds']['total']:.0f} s "
        f"({demo['machine']}).",
        "lead",
    )
    for fit in fits:
        if fit["status"] not in _TRUSTED:
            page.paragraph(f"{_nice(fit['name'])}: {fit['reason']}", "doubt")
    shown = [case["fit"] for case in demo["experiment2"]["cases"] if case["fit"]["stages"]]
    labels = [case["title"] for case in demo["experiment2"]["cases"] if case["fit"]["stages"]]
    from shapespace.report.figures import portrait_figure

    page.figure(
        "Scan, fitted model, both together, and how far the model lies from the scan: experiment 2",
        lambda: portrait_figure([page.fit(fit) for fit in shown], labels, title="A scan becomes a few numbers"),
    )
    page.table(
        ("quantity", "the paper states", "this run measured", "against the truth", "why it differs"),
        [
            (row["quantity"], row["paper"], row["measured"], row["truth"] or "not known", row["why"] or "it does not")
            for row in demo["paper_table"]
        ],
        "What the paper states beside what this run measured. The floor is the best the model could do with true "
        "correspondences.",
    )


def _experiment_1(page: _Page, first: Mapping[str, Any]) -> None:
    from shapespace.report import figures

    fits = [fit for fit in first["fits"] if fit["stages"]]
    tests = [fit for fit in fits if fit["expression"] != "neutral"]
    page.paragraph(
        f"{first['n_training']} simulated faces of one person with mixed expressions make the model; "
        f"{first['modes_for_98_5']} modes hold 98.5 % of their variance. {len(tests)} unseen faces of four "
        "expressions at four levels are fitted as raw surfaces: other triangles, moved, turned, scaled, with noise."
    )
    page.heading("The shape space")
    page.figure(
        "Figure 1: some of the training faces",
        lambda: figures.faces_grid(
            [read_mesh(page.folder / example["file"]) for example in first["training_examples"]],
            [example["label"] for example in first["training_examples"]],
            title="Training faces",
            columns=6,
        ),
    )
    _model_figures(page, first, "Figures 2 and 3: the mean face and the first modes")
    page.heading("Fits")
    page.figure(
        "Figure 8: the test faces as the fit sees them, raw surfaces on other triangles",
        lambda: figures.faces_grid(
            [page.fit(fit).scan for fit in tests], [_nice(fit["name"]) for fit in tests], title="Test faces"
        ),
    )
    strongest = max(tests, key=lambda fit: fit["intensity"])
    _one_fit(page, strongest, first.get("population_z"))
    page.figure(
        "Fitted model over scan, all test faces",
        lambda: figures.aligned_grid([page.fit(fit) for fit in tests], title="Model over scan"),
    )
    page.figure(
        "How far the fitted models lie from the scans, all test faces at one scale",
        lambda: figures.detail_maps([page.fit(fit) for fit in tests], title="Distance from model to scan"),
    )
    page.table(
        (
            "scan",
            "status",
            "model to scan, mean",
            "model to scan, largest",
            "scan to model, mean",
            "true vertex error, mean",
            "floor",
        ),
        [_fit_row(page, fit) for fit in first["fits"]],
        "All fits, in mm of the model's frame.",
    )
    page.heading("Expressions as lines")
    page.paragraph(
        "Samples of one expression at rising intensity should lie on a line through neutral, and different "
        "expressions on different lines (figures 9 and 10)."
    )
    points = [_coefficients(page, fit) for fit in fits]
    neutral = next((point for point in points if point.expression == "neutral"), None)
    for caption, draw in (
        ("Figure 9: b1 against b2, larger marks for stronger expressions", figures.b_plane),
        ("Figure 10: b1, b2 and b3 from two sides", figures.b_space),
    ):
        page.figure(
            caption,
            lambda draw=draw, caption=caption: draw(
                points,
                title=caption.partition(": ")[2],
                neutral_b=neutral.b if neutral else None,
                neutral_z=neutral.z if neutral else None,
            ),
            chart=True,
        )
    _score_tables(page, first["scores"])
    _coefficient_table(page, first["fits"])


def _experiment_2(page: _Page, demo: Mapping[str, Any]) -> None:
    drawn: set[str] = set()
    for case in demo["experiment2"]["cases"]:
        page.heading(case["title"])
        page.paragraph(case["note"], "simulated" if case["simulated"] else "")
        page.paragraph(
            f"The model is made of {case['n_training']} people and keeps {case['n_modes']} modes; "
            f"{case['modes_for_98_5']} hold 98.5 % of the variance."
        )
        if case["model"] not in drawn:
            drawn.add(case["model"])
            _model_figures(page, case, f"Mean and first modes, {case['title']}")
        fit = case["fit"]
        page.paragraph(f"Status: {fit['status']}. {fit['reason']}", "" if fit["status"] in _TRUSTED else "doubt")
        if fit["stages"]:
            _one_fit(page, fit, None)


def _model_figures(page: _Page, about: Mapping[str, Any], caption: str) -> None:
    from shapespace.report import figures

    def modes() -> Figure:
        with np.load(page.folder / about["mode_shapes"], allow_pickle=False) as arrays:
            return figures.modes_figure(
                arrays["mean"].astype(np.float64),
                arrays["faces"],
                arrays["basis5"].astype(np.float64),
                title="The mean and what the first modes do",
            )

    page.figure(caption, modes)
    page.figure(
        "Share of the variance that the first modes hold",
        lambda: figures.spectrum_figure(np.array(about["cumulative_variance"]), title="Spectrum"),
        chart=True,
    )


def _one_fit(page: _Page, entry: Mapping[str, Any], population: object) -> None:
    """Draw the course of one fit: figures 4 to 7 and 11."""
    from shapespace.report import figures

    name = _nice(entry["name"])
    record = _read_json(page.folder / entry["json"])
    page.figure(
        f"Figures 4 and 7: model over scan before, after phase 1 and after phase 2, {name}",
        lambda: figures.overlay_figure(page.fit(entry), title=f"{name}: model over scan"),
    )
    page.figure(
        f"Figures 5 and 6: histograms of the closest distance, both ways, {name}",
        lambda: figures.distance_histograms(page.fit(entry), title=f"{name}: closest distances"),
        chart=True,
    )
    page.figure(
        f"Figure 11: where the model lies within 2, 4, 6, 8 and 10 mm of the scan, {name}",
        lambda: figures.threshold_figure([page.fit(entry)], title=f"{name}: distance maps"),
    )
    page.figure(
        f"RMS closest distance by iteration, {name}",
        lambda: figures.history_figure(
            [(state["phase"], state["iteration"], state["rms_mm"]) for state in record["history"]],
            title=f"{name}: the loop",
        ),
        chart=True,
    )
    page.figure(
        f"Coefficients in standard deviations of the model, {name}",
        lambda: figures.coefficients_figure(
            np.array(record["z"]),
            title=f"{name}: coefficients",
            population=None if population is None else np.array(population),
        ),
        chart=True,
    )


def _fit_row(page: _Page, fit: Mapping[str, Any]) -> tuple[object, ...]:
    if not fit["stages"]:
        return (_nice(fit["name"]), fit["status"], "", "", "", "", "")
    final = _read_json(page.folder / fit["json"])["distances_mm"]["final"]
    error, floor = fit["vertex_error_mm"], fit["floor_mm"]
    return (
        _nice(fit["name"]),
        fit["status"],
        _mm(final["model_to_scan"]["mean"]),
        _mm(final["model_to_scan"]["max"]),
        _mm(final["scan_to_model"]["mean"]),
        _mm(error["mean"]) if error else "",
        _mm(floor["mean"]) if floor else "",
    )


def _coefficients(page: _Page, fit: Mapping[str, Any]) -> Coefficients:
    from shapespace.report.figures import Coefficients

    record = _read_json(page.folder / fit["json"])
    return Coefficients(
        name=str(fit["name"]),
        expression=str(fit["expression"]),
        intensity=float(fit["intensity"]),
        b=np.array(record["b"], dtype=np.float64),
        z=np.array(record["z"], dtype=np.float64),
    )


def _score_tables(page: _Page, scores: Mapping[str, Any]) -> None:
    columns = {
        "line_r2_through_neutral": "R² of the line through neutral",
        "line_r2_free": "R² of the best line anywhere",
        "line_sign_consistency": "on the positive side",
        "line_spearman": "rank correlation with intensity",
        "line_permutation_p": "permutation p",
    }
    first = scores.get("line_r2_through_neutral", {})
    page.table(
        ("expression", *columns.values()),
        [(name, *(f"{scores[key][name]:.3f}" for key in columns)) for name in first],
        "Line structure. With four levels no permutation p can fall below 1/24 = 0.042 but by chance of the draw.",
    )
    if "disjointness" in scores:
        d = scores["disjointness"]
        page.table(
            ("score", "value", "permutation p"),
            [
                (
                    f"leave-one-out accuracy of the nearest mean direction (chance {d['chance']:.2f})",
                    f"{d['leave_one_out_accuracy']:.3f}",
                    f"{d['accuracy_p']:.3f}",
                ),
                ("cosine silhouette", f"{d['cosine_silhouette']:.3f}", f"{d['silhouette_p']:.3f}"),
                ("separability, tr(S_w⁻¹ S_b)", f"{d['separability']:.1f}", ""),
            ],
            "Disjointness of the four expressions.",
        )
    if scores.get("left_out"):
        page.paragraph(f"Left out because their fits are not trusted: {', '.join(scores['left_out'])}.", "doubt")


def _coefficient_table(page: _Page, fits: Sequence[Mapping[str, Any]]) -> None:
    rows = [(fit, _read_json(page.folder / fit["json"]).get("b")) for fit in fits]
    k = max((min(len(b), 5) for _, b in rows if b), default=0)
    page.table(
        ("scan", *(f"b{i}" for i in range(1, k + 1))),
        [(_nice(fit["name"]), *(f"{value:.1f}" for value in b[:k])) for fit, b in rows if b],
        "The vector b of each face, mm.",
    )


def _settings(page: _Page, demo: Mapping[str, Any]) -> None:
    rows: list[tuple[object, object]] = [
        ("shapespace", demo["version"]),
        ("made", demo["created"]),
        ("machine", demo["machine"]),
        ("seed", demo.get("seed", "")),
        *((f"setting: {key}", value) for key, value in demo.get("settings", {}).items()),
        *((f"version of {key}", value) for key, value in demo.get("versions", {}).items()),
        *((f"seconds, {key}", f"{value:.1f}") for key, value in demo["seconds"].items()),
    ]
    models = {demo["experiment1"]["model"]: demo["experiment1"].get("model_hash", "")}
    models |= {case["model"]: case.get("model_hash", "") for case in demo["experiment2"]["cases"]}
    rows += [(f"hash of {file}", digest) for file, digest in models.items()]
    page.table(("what", "value"), rows, "Everything needed to run this again.")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        return cast(dict[str, Any], json.loads(read_bytes(path)))
    except ValueError as error:
        raise FileFormatError(f"{path} is not JSON, or it is cut short.") from error


def _text(value: object) -> str:
    return html.escape(str(value), quote=True)


def _nice(name: object) -> str:
    return str(name).replace("_", " ")


def _mm(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"
