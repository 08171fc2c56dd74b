"""`info` and `report` take a folder that `correspond` wrote, and say what is in it."""

import json
from pathlib import Path

import pytest

from conftest import Run
from same_blobs import ASIDE, FAR, FOLDED, HIDDEN, NAMES, VERTICES, write_same


@pytest.fixture(scope="module")
def same(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_same(tmp_path_factory.mktemp("blobs"))


def test_info_says_what_is_in_a_folder_in_correspondence(run: Run, same: Path) -> None:
    facts = run("info", same, "--json").facts
    assert (facts["kind"], facts["scans"], facts["in_correspondence"]) == ("correspondence", 7, len(NAMES))
    assert facts["vertices"] == VERTICES and facts["triangles"] == 2 * VERTICES - 4
    assert list(facts["set_aside"]) == [ASIDE] and set(facts["needs_review"]) == {FAR, FOLDED, HIDDEN}
    assert facts["moved_share_by_round"] == [0.05, 0.012] and facts["settled"] is False
    assert 0.001 < facts["distance_share_median"]["mean"] < facts["distance_share_median"]["p99"] < 0.02
    assert facts["scans_with_folds"] == 1 and 0.2 < facts["vertices_missing_somewhere"] / VERTICES < 0.3
    assert facts["cpu_s"] == sum(3.0 + k for k in range(len(NAMES)))
    assert run("info", same / "correspondence.json", "--json").facts == facts


def test_info_names_scans_and_their_reasons_line_by_line(run: Run, same: Path) -> None:
    lines = run("info", same).out.splitlines()
    assert "in_correspondence: 6" in lines
    at = lines.index("set_aside: 1")
    assert lines[at + 1].startswith(f"  {ASIDE}: another object")
    at = lines.index("needs_review: 3")
    assert any(line.startswith(f"  {HIDDEN}: It shows only 76 %") for line in lines[at + 1 : at + 4])


def test_info_knows_the_record_of_one_scan(run: Run, same: Path, tmp_path: Path) -> None:
    facts = run("info", same / f"{FAR}.correspond.json", "--json").facts
    assert facts["kind"] == "scan in correspondence" and facts["distance_mean"] == 2.0
    (tmp_path / "x.correspond.json").write_text("{")
    assert "is not JSON" in run("info", tmp_path / "x.correspond.json").sentence()
    (tmp_path / "x.correspond.json").write_text(json.dumps({"name": "x"}))
    assert "x.correspond.json is damaged" in run("info", tmp_path / "x.correspond.json").sentence()


def test_info_of_another_folder_is_one_sentence(run: Run, tmp_path: Path) -> None:
    outcome = run("info", tmp_path)
    assert outcome.code == 2 and "is a folder without correspondence.json" in outcome.sentence()


def test_report_writes_one_file_on_it(run: Run, same: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="the extra `report` is not installed")
    outcome = run("report", same, "-o", tmp_path / "r.html", "--no-open", "--quiet")
    assert outcome.code == 0 and outcome.out == f"The report is {tmp_path / 'r.html'}\n"
    assert "Correspondence of 7 scans in same" in (tmp_path / "r.html").read_text(encoding="utf-8")
    outcome = run("report", same, "--labels", tmp_path / "l.csv", "--no-open")
    assert outcome.code == 2 and "omit --model and --labels" in outcome.sentence()
