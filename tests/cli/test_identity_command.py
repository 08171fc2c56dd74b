"""The commands `recognise verify` and `recognise identify`: files in and out, and one sentence for bad input."""

import csv
from pathlib import Path

import numpy as np
import pytest

from conftest import Run
from stored_fits import MODES, model, write_fit

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")

PEOPLE, SHOWN = 9, ("neutral", "smile", "fear")
FEW = ("--set", "draws=20", "--quiet")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fits of nine people with three scans each, of which one is doubtful, and a table of them."""
    folder = tmp_path_factory.mktemp("identity")
    model().save(folder / "model.h5")
    rng = np.random.default_rng(0)
    rows = [("file", "subject", "expression", "part")]
    for person in range(PEOPLE):
        who = rng.standard_normal(MODES)
        for number, shown in enumerate(SHOWN):
            k = 3 * person + number
            z = who + 0.1 * rng.standard_normal(MODES) + (0.0, 1.0, 2.0)[number] * np.eye(MODES)[0]
            status = "doubtful" if k == 26 else "converged"
            write_fit(folder / "fits", f"p{k:02d}", k, status=status, z=z.tolist(), b=(z * model().stddev).tolist())
            rows.append((f"p{k:02d}.ply", f"person {person}", shown, "train" if person < 4 else "probe"))
    with (folder / "people.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return folder


@pytest.mark.parametrize("command", ["verify", "identify"])
def test_a_table_and_fits_end_in_an_answer_and_a_report(command: str, folder: Path, tmp_path: Path, run: Run) -> None:
    asked = ("recognise", command, folder / "people.csv", "--shapes", folder / "fits", "-o", tmp_path, *FEW)
    outcome = run(*asked, "--gallery", "expression=neutral", "--json")
    assert outcome.code == 0
    assert outcome.facts["question"] == f"recognise {command}"
    assert outcome.facts["settings"]["gallery"] == "expression=neutral"
    assert "1 of 27 fits are excluded, which are doubtful (p26)." in outcome.err
    methods = (tmp_path / "methods.txt").read_text("utf-8")
    assert "compared by PLDA score, cosine" in methods and "Ioffe S. (2006)" in methods
    assert (tmp_path / "analysis.json").is_file() and (tmp_path / "figures.csv").is_file()
    assert (tmp_path / "report.html").is_file() == (outcome.facts["report"] is not None)
    assert run(*asked, "--set", "doubtful=yes", "--gallery", "expression=neutral").out.startswith("By PLDA score")


def test_the_first_score_is_told_of_first(folder: Path, tmp_path: Path, run: Run) -> None:
    outcome = run("recognise", "verify", folder / "people.csv", "--shapes", folder / "fits", "-o", tmp_path, *FEW,
                  "--scores", "cosine,distance", "--curve", "1,2", "--by", "expression",
                  "--set", "uncertainty=no")  # fmt: skip
    assert outcome.code == 0 and outcome.out.startswith("By cosine the equal error rate is")
    figures = (tmp_path / "figures.csv").read_text()
    assert "eer with 2 modes" in figures and "eer of smile" in figures and "likelihood" not in figures


def test_surfaces_of_fits_are_compared_where_they_are_asked_for(folder: Path, tmp_path: Path, run: Run) -> None:
    outcome = run("recognise", "verify", folder / "people.csv", "--shapes", folder / "fits", "-o", tmp_path, *FEW,
                  "--set", "surfaces=fitted", "--scores", "distance")  # fmt: skip
    assert outcome.code == 0 and outcome.out.startswith("By plain distance")


BAD = {
    "in both": (("--train", "expression=fear"), "both tested and learned from"),
    "no expression": (("--gallery", "neutral"), "names no scans"),
    "no column": (("--set", "subject=who"), "no column 'who'"),
    "no score": (("--scores", "best"), "not best"),
    "no role": (("--set", "role=expression"), "it may be gallery, probe or train"),
}


@pytest.mark.parametrize("case", BAD)
@pytest.mark.parametrize("command", ["verify", "identify"])
def test_bad_input_is_one_sentence(case: str, command: str, folder: Path, tmp_path: Path, run: Run) -> None:
    more, expected = BAD[case]
    outcome = run("recognise", command, folder / "people.csv", "--shapes", folder / "fits", "-o", tmp_path, *FEW, *more)
    assert outcome.code == 2
    assert expected in outcome.sentence()
    assert not list(tmp_path.iterdir())


def test_a_list_of_modes_that_is_none_is_refused(folder: Path, tmp_path: Path, run: Run) -> None:
    outcome = run("recognise", "verify", folder / "people.csv", "-o", tmp_path, "--curve", "many")
    assert outcome.code == 2 and "numbers of modes such as 2,5,10" in outcome.err
