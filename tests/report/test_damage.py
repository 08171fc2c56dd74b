"""Whatever a result file holds, there is a page, or one sentence; nothing but our own errors is ever raised."""

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_page import Page
from test_recognition_report import contents

from shapespace.errors import ShapespaceError
from shapespace.report import figures
from shapespace.report.pages.write_html import write_report

VALUES: list[Any] = [
    None, True, 0, 3, -1, 1e308, -2.5, "", "text", "\0", "../..", [], {}, [None], [[]], [1, [2]], [1.5, 2.5],
    ["a", "b"], {"a": 1}, {"a": {"b": [1]}}, [[1, 2], [3]], [{"b": [1], "z": [1]}],
]  # fmt: skip


def damaged(content: Any, rng: np.random.Generator) -> Any:
    """Return JSON content with another value, or none, in one place."""
    content = copy.deepcopy(content)
    at = content
    while True:
        keys = list(at) if isinstance(at, dict) else list(range(len(at)))
        key = keys[rng.integers(len(keys))]
        if isinstance(at[key], (dict, list)) and len(at[key]) and rng.random() < 0.8:
            at = at[key]
            continue
        if rng.random() < 0.2:
            del at[key]
        else:
            at[key] = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
        return content


def test_records_damaged_anywhere_leave_a_page_that_names_every_fit(fits: Path, sketched: None) -> None:
    rng = np.random.default_rng(0)
    record = json.loads((fits / "able.fit.json").read_text())
    names = [f"damaged_{k:03}" for k in range(150)]
    for name in names:
        (fits / f"{name}.fit.json").write_text(json.dumps(damaged(record, rng)))
        shutil.copy(fits / "able.stages.npz", fits / f"{name}.stages.npz")
    words = Page(write_report(fits).read_text(encoding="utf-8")).words
    assert all(name in words for name in names)
    assert "is damaged: expected" in words


def test_parts_of_a_study_damaged_anywhere_cost_only_themselves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "encode_webp", lambda *_, **__: (b"webp", (10, 10)))
    rng = np.random.default_rng(1)
    whole = contents()
    whole["parts"] = [damaged(part, rng) for _ in range(16) for part in whole["parts"]]
    (tmp_path / "recognition.json").write_text(json.dumps(whole))
    page = Page(write_report(tmp_path).read_text(encoding="utf-8"))
    assert len(page.headings) >= len(whole["parts"])


@pytest.mark.parametrize("seed", range(12))
def test_a_demo_or_a_study_damaged_anywhere_ends_in_a_page_or_one_sentence(
    demo_template: Path, tmp_path: Path, sketched: None, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    demo = json.loads((demo_template / "demo.json").read_text())
    for key in ("experiment1", "experiment2"):
        shutil.copytree(demo_template / key, tmp_path / key, ignore=shutil.ignore_patterns("*.npz", "*.h5", "*.ply"))
    (tmp_path / "demo.json").write_text(json.dumps(damaged(damaged(demo, rng), rng)))
    try:
        assert "Experiment 1" in Page(write_report(tmp_path).read_text(encoding="utf-8")).headings
    except ShapespaceError as error:
        assert "demo.json" in str(error)
    study = tmp_path / "study"
    study.mkdir()
    content = {key: value for key, value in contents().items() if key != "parts"}
    (study / "recognition.json").write_text(json.dumps(damaged(content, rng)))
    try:
        write_report(study)
    except ShapespaceError as error:
        assert "recognition" in str(error) or "contains no fits" in str(error)


def test_distances_over_what_the_scan_shows_stand_first(fits: Path, sketched: None) -> None:
    for path in fits.glob("*.fit.json"):
        record = json.loads(path.read_text())
        if "distances_mm" in record:
            both = {key: {**record["distances_mm"]["final"][key], "mean": value} for key, value in (
                ("model_to_scan", 0.125), ("scan_to_model", 0.375))}  # fmt: skip
            record["shown"] = {**both, "model_seen_share": 0.625, "scan_covered_share": 0.875}
            path.write_text(json.dumps(record))
    new = Page(write_report(fits).read_text(encoding="utf-8")).words
    assert "over the parts that the scan shows: model to scan 0.12 mm (62 % of the model)" in new
    assert "scan to model 0.38 mm (88 % of the scan)" in new and "Scan to model 0.38 mm on average" in new
    assert "Model to scan where shown, mean" in new and "Model shown, %" in new and "Whole model" not in new
    assert "where the scan shows the surface, median of the converged fits" in new and "whole model" not in new
