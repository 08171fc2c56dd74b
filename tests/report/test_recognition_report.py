"""The report of a study of recognition: every kind of part drawn, each damaged in turn, alone and beside fits."""

import copy
import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from report_page import Page

from shapespace.errors import FileFormatError, InputError
from shapespace.report import figures
from shapespace.report.pages.write_html import LARGEST_REPORT_BYTES, write_report

EVIL = "</script><script>alert(1)</script>"
CLASSES = ["anger", "smile", EVIL]
TITLES = {
    "table": "Approaches",
    "confusion": "Who is taken for whom",
    "calibration": "How sure",
    "learning_curve": "More people",
    "curve": "Identity",
    "text": "What was done",
}


def contents() -> dict[str, Any]:
    parts: dict[str, dict[str, Any]] = {
        "text": {"level": 2, "text": ["Nothing of the people tested was learned from."]},
        "table": {
            "note": f"By fold {EVIL}",
            "columns": [
                {"name": "Approach", "kind": "text"},
                {"name": "Accuracy", "kind": "percent"},
                {"name": "95 %", "kind": "interval"},
                {"name": "p", "kind": "p"},
                {"name": "Error", "kind": "mm"},
                {"name": "Scans", "kind": "count"},
                {"name": "Score", "kind": "number"},
            ],
            "rows": [
                ["one PCA", 0.71, [0.68, 0.75], 0.0004, 1.234, 2400, 12.345],
                [EVIL, None, None, None, None, None, None],
            ],
        },
        "confusion": {"classes": CLASSES, "counts": [[8, 2, 0], [1, 9, 0], [0, 0, 0]]},
        "calibration": {
            "bins": [
                {"low": 0.4, "high": 0.6, "confidence": None, "accuracy": None, "count": 0},
                {"low": 0.6, "high": 0.8, "confidence": 0.7, "accuracy": 0.6, "count": 20},
                {"low": 0.8, "high": 1.0, "confidence": 0.9, "accuracy": 0.95, "count": 80},
            ],
            "ece": 0.03,
            "brier": 0.1,
        },
        "learning_curve": {
            "subjects": [10, 20], "mean": [0.6, 0.8], "low": [0.5, 0.7], "high": [0.7, 0.9], "ceiling": 0.94
        },
        "curve": {"x": "coefficients", "y": "rate", "series": [{"label": EVIL, "x": [1, 2], "y": [0.5, 0.75]}]},
    }  # fmt: skip
    return {
        "format": "shapespace recognition",
        "format_version": 1,
        "version": "0.1.0",
        "created": "2026-01-02T03:04:05+00:00",
        "title": f"Six expressions {EVIL}",
        "summary": ["87.2 % of the answers are right."],
        "targets": [
            {"what": "Another generator", "target": "at least 85 %", "reached": "87.2 %", "met": True, "note": ""},
            {"what": "Additive", "target": "5 points", "reached": "3 points", "met": False, "note": "Tried twice."},
        ],
        "parts": [{"kind": kind, "title": TITLES[kind], **part} for kind, part in parts.items()],
        "settings": {"people": 100, "fit": {"method": "robust"}},
        "versions": {"numpy": "2.1"},
        "model_hashes": ["ab" * 32],
    }


def part_of(content: dict[str, Any], kind: str) -> dict[str, Any]:
    return next(part for part in content["parts"] if part["kind"] == kind)


def write(folder: Path, content: object) -> Path:
    (folder / "recognition.json").write_text(json.dumps(content))
    return folder


def report(folder: Path, **options: Any) -> str:
    return write_report(folder, folder.parent / "study.html", **options).read_text(encoding="utf-8")


@pytest.fixture
def study(tmp_path: Path) -> Path:
    (tmp_path / "study").mkdir()
    return write(tmp_path / "study", contents())


@pytest.fixture
def undrawn(worded: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the drawing where a test is of what stands around it; the figures still check what they are given."""
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"webp", (10, 10)))


def words_under(page: str, heading: str) -> str:
    """Return what stands between a heading and the next one."""
    parsed = re.search(rf"<h\d[^>]*>{re.escape(heading)}</h\d>(.*?)(?=<h\d|<footer)", page, re.DOTALL)
    assert parsed is not None, heading
    return Page(re.sub(r"</?(section|main|div)[^>]*>", " ", parsed[1])).words


def test_every_kind_of_part_is_drawn_and_none_is_broken(study: Path) -> None:
    steps: list[tuple[str, int]] = []
    page = report(study, on_step=lambda *step: steps.append(step))
    parsed = Page(page)
    assert 'class="broken"' not in page and len(page.encode()) < LARGEST_REPORT_BYTES
    wanted = ["Summary", TITLES["text"], *(TITLES[part["kind"]] for part in contents()["parts"] if "level" not in part)]
    assert parsed.headings == [f"Six expressions {EVIL}", *wanted, "Settings, versions and hashes"]
    assert len(parsed.images()) == 4 == len(steps)
    assert all(len(image["alt"] or "") > 20 for image in parsed.images())
    levels = [int(tag[1]) for tag, _ in parsed.tags if re.fullmatch("h[1-6]", tag)]
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_names_that_are_scripts_stay_text(study: Path) -> None:
    page = report(study)
    assert EVIL not in page and "<script>alert" not in page
    assert Page(page).words.count(EVIL) >= 4
    assert sum(EVIL in str(image["alt"]) for image in Page(page).images()) == 1
    assert "default-src 'none'" in page


def test_cells_are_shown_by_the_kind_of_their_column(study: Path, undrawn: None) -> None:
    page = report(study)
    told = words_under(page, TITLES["table"])
    assert "71.0 % 68.0 to 75.0 % < 0.001 1.23 2,400 12.3" in told and "Error (mm)" in told
    assert told.endswith(f"{EVIL} – – – – – –")
    assert 'data-value="0.71"' in page and 'class="sortable"' in page


def test_targets_say_whether_they_were_met(study: Path, undrawn: None) -> None:
    told = words_under(report(study), "Summary")
    assert "1 of 2 targets met." in told and "87.2 % met" in told and "3 points missed Tried twice." in told


def test_confusions_stand_side_by_side_and_can_be_read_without_seeing_them(study: Path, undrawn: None) -> None:
    content = contents()
    content["parts"].insert(3, {**part_of(content, "confusion"), "title": "The other one"})
    page = report(write(study, content))
    beside = page[page.index('class="beside"') : page.index(TITLES["curve"] + "</h3>")]
    assert TITLES["confusion"] in beside and "The other one" in beside
    told = words_under(page, "The other one")
    assert "anger 8 (80 %) 2 (20 %) 0 (0 %) smile 1 (10 %) 9 (90 %) 0 (0 %)" in told and told.endswith("– – –")


def test_every_key_but_the_format_may_be_absent(study: Path, undrawn: None) -> None:
    for key in contents():
        if key.startswith("format"):
            continue
        content = contents()
        del content[key]
        assert 'class="broken"' not in report(write(study, content)), key
    page = report(write(study, {"format": "shapespace recognition", "format_version": 1}))
    assert Page(page).headings == ["Recognition study in study", "Settings, versions and hashes"]


DAMAGES: list[tuple[str, str, object]] = [
    ("table", "columns", "x"),
    ("table", "rows", [["one PCA", 0.7]]),
    ("table", "rows", [["one PCA", "much", None, None, None, None, None]]),
    ("table", "rows", [["one PCA", None, [0.5], None, None, None, None]]),
    ("table", "columns", [{"name": "a", "kind": "colour"}]),
    ("confusion", "counts", [[1, 2], [3, 4]]),
    ("confusion", "counts", [["a", "b", "c"]] * 3),
    ("confusion", "counts", [[0, 0, 0]] * 3),
    ("confusion", "counts", [[-1, 2, 3]] * 3),
    ("confusion", "classes", None),
    ("calibration", "bins", []),
    ("calibration", "bins", [{"low": 0, "high": 1, "confidence": 7, "accuracy": 0.5, "count": 3}]),
    ("calibration", "ece", "small"),
    ("learning_curve", "mean", [0.5]),
    ("learning_curve", "low", [0.5]),
    ("learning_curve", "subjects", None),
    ("curve", "series", []),
    ("curve", "series", [{"label": "x", "x": [1, 2], "y": [1]}]),
    ("text", "text", [3]),
]


@pytest.mark.parametrize(("kind", "key", "value"), DAMAGES)
def test_a_damaged_part_says_so_in_its_place_and_costs_no_other(
    study: Path, monkeypatch: pytest.MonkeyPatch, kind: str, key: str, value: object
) -> None:
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"webp", (10, 10)))
    content = contents()
    # Only what is damaged is drawn, so that all of these are quick.
    other = "table" if kind != "table" else "text"
    content["parts"] = [part_of(content, kind), {**part_of(content, other), "level": 3}]
    content["parts"][0][key] = value
    page = report(write(study, content))
    assert page.count('class="broken"') == 1
    assert TITLES[other] in Page(page).headings
    told = words_under(page, TITLES[kind])
    assert "could not be made" in told
    assert str(study.parent) not in told


@pytest.mark.parametrize("value", [None, "text", 3, [None], [[]], [{"kind": "dream"}], [{"kind": [1]}], {"a": 1}])
@pytest.mark.parametrize("key", ["summary", "targets", "parts", "settings", "versions", "model_hashes", "title"])
def test_a_key_of_another_kind_never_stops_the_report(study: Path, undrawn: None, key: str, value: object) -> None:
    page = report(write(study, {**contents(), key: value}))
    assert "Settings, versions and hashes" in Page(page).headings


@pytest.mark.parametrize(
    ("content", "told"),
    [({"format": "other"}, "not the result of a study"), ({"format_version": 2}, "update shapespace")],
)
def test_a_study_of_another_format_is_refused(study: Path, content: dict[str, Any], told: str) -> None:
    with pytest.raises(FileFormatError, match=told):
        report(write(study, {**contents(), **content}))
    (study / "recognition.json").write_text('{"format": ')
    with pytest.raises(FileFormatError, match="run shapespace recognise study again"):
        report(study)


def test_scores_without_fits_and_without_a_format_are_no_study(study: Path) -> None:
    with pytest.raises(InputError, match="contains no fits"):
        report(write(study, {"accuracy": 0.5}))
    with pytest.raises(InputError, match="omit --model"):
        report(write(study, contents()), model=study / "m.h5")


def test_a_report_of_fits_gains_the_section(fits: Path, study: Path, undrawn: None) -> None:
    (fits / "recognition.json").write_bytes((study / "recognition.json").read_bytes())
    page = report(fits)
    headings = Page(page).headings
    at = [headings.index(text) for text in ("The fits", "Recognition", TITLES["text"], TITLES["confusion"])]
    assert at == sorted(at) and "6 fits in out" in headings
    levels = [int(tag[1]) for tag, _ in Page(page).tags if re.fullmatch("h[1-6]", tag)]
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))
    assert "Settings and versions of this study" in Page(page).words
    (fits / "recognition.json").write_text('{"format": ')
    assert "recognition.json is not JSON" in words_under(report(fits), "Recognition")


def test_a_large_study_stays_below_the_limit_and_says_what_is_left_out(
    study: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blank = Figure(figsize=(1, 1), dpi=20)
    monkeypatch.setattr(figures, "curve_figure", lambda *_, **__: blank)
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"w" * 150_000, (10, 10)))
    content = contents()
    curve = part_of(content, "curve")
    wide = {"kind": "table", "columns": [{"name": "x"}] * 30, "rows": [["<" * 900] * 30] * 150}
    content["parts"] = [{**copy.copy(curve), "title": f"curve {k}"} for k in range(30)] + [wide] + [curve] * 102
    page = report(write(study, content))
    assert len(page.encode()) <= LARGEST_REPORT_BYTES
    words = Page(page).words
    assert "would make this file larger than 8 MB" in words and "13 parts are omitted" in words
    assert len(Page(page).images()) > 20 and "&lt;" * 300 not in page


HALF = np.full((7, 7), 1.0) + np.diag(np.full(7, 20.0))


@pytest.mark.parametrize(
    "draw",
    [
        lambda: figures.confusion_figure(HALF, [f"a rather long name {k}" for k in range(7)]),
        lambda: figures.confusion_figure([[3]], ["only $x$"]),
        lambda: figures.confusion_figure(np.eye(40), [str(k) for k in range(40)]),
        lambda: figures.calibration_figure([[0, 1, 0.5, 0.5, 1]]),
        lambda: figures.learning_curve_figure([5], [0.5]),
        lambda: figures.curve_figure([("", [1], [0])], x="", y="y"),
    ],
)
def test_figures_of_few_and_of_many_are_cut_nowhere(draw: Callable[[], Figure]) -> None:
    figure = draw()
    figure.canvas.draw()
    width, height = figure.get_size_inches() * figure.dpi
    for axes in figure.axes:
        box = axes.get_tightbbox()
        assert box is not None
        assert box.x0 > -2 and box.y0 > -2 and box.x1 < width + 2 and box.y1 < height + 2


def test_a_confusion_matrix_frames_right_answers_and_tells_percent_and_counts() -> None:
    figure = figures.confusion_figure([[8, 2], [0, 10]], ["a", "b"])
    (axes,) = figure.axes
    assert {text.get_text() for text in axes.texts} == {"80 %", "8", "20 %", "2", "100 %", "10"}
    assert axes.get_ylabel() == "true class (count)"
    assert sum(patch.get_edgecolor()[:3] != (1, 1, 1) for patch in axes.patches) == 2
    assert "90 % of 20 answers are right; most often a is taken for b" in " ".join(t.get_text() for t in figure.texts)
