"""`shapespace align`: from a landmark file to a folder that other commands take, or one sentence."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.io.landmarks.configuration_io import write_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.types import FloatArray

Run = Callable[..., Any]
N, L = 16, 9


def points() -> FloatArray:
    rng = np.random.default_rng(0)
    return rng.uniform(1, 3, (N, 1, 1)) * (rng.normal(size=(L, 2)) + 0.05 * rng.normal(size=(N, L, 2)))


def write(path: Path, given: FloatArray) -> None:
    names = tuple(f"s{k}" for k in range(len(given)))
    write_configurations(path, LandmarkConfigurations(names=names, points=given))


def write_csv(path: Path, *rows: tuple[Any, ...]) -> None:
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows(rows)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Planar landmarks of 16 specimens, with a table."""
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "skulls.tps", points())
    rows = [(f"s{k}", "fm"[k % 2], k // 2, "LR"[k % 2], 20 + k) for k in range(N)]
    write_csv(tmp_path / "skulls.csv", ("specimen", "sex", "animal", "side", "age"), *rows)
    return tmp_path


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_folder_has_coordinates_mean_settings_and_findings(run: Run, folder: Path) -> None:
    given = points()
    given[3, 2] = np.nan
    given[5] *= [-1, 1]
    write(folder / "skulls.tps", given)
    write_csv(folder / "sliders.csv", ("before", "slide", "after"), (1, 2, 3), (4, 5, 6))
    options = ("--table", "skulls.csv", "--sliders", "sliders.csv", "--slide-by", "procrustes")
    outcome = run("align", "skulls.tps", *options, "-o", "out", "--json")
    assert outcome.code == 0, outcome.err
    facts = outcome.facts
    assert (facts["specimens"], facts["landmarks"], facts["dimensions"], facts["estimated"]) == (N, L, 2, 1)
    assert facts["settings"]["slide_by"] == "procrustes" and facts["settings"]["curve_semilandmarks"] == 2
    assert [(one["specimen"], one["reason"]) for one in facts["findings"]] == [("s5", "mirrored")]
    assert "s5 is mirrored: reflection reduces" in outcome.err
    aligned = rows_of(folder / "out" / "aligned.csv")
    assert [row["sex"] for row in aligned] == [row["sex"] for row in rows_of(folder / "skulls.csv")]
    assert float(aligned[0]["centroid_size"]) == pytest.approx(np.linalg.norm(given[0] - given[0].mean(axis=0)))
    assert rows_of(folder / "out" / "estimated.csv") == [{"specimen": "s3", "landmark": "3"}]
    assert [row["landmark"] for row in rows_of(folder / "out" / "mean.csv")] == [str(k + 1) for k in range(L)]


@pytest.mark.parametrize(
    "command",
    [
        ("compare", "aligned", "~ sex + log_size", "--permutations", "20"),
        ("compare", "skulls.csv", "--shapes", "skulls.tps", "~ age", "--permutations", "20"),
        ("regress", "aligned", "--target", "age", "--permutations", "5"),
        ("score", "skulls.csv", "--shapes", "new.tps", "--reference", "aligned", "--modes", "3"),
        ("asymmetry", "aligned", "--set", "subject=animal", "--side", "side", "--permutations", "20"),
        ("test", "disparity", "aligned", "--group", "sex", "--permutations", "20"),
    ],
)
def test_other_commands_take_landmarks_and_write_no_millimetres(
    run: Run, folder: Path, command: tuple[str, ...]
) -> None:
    names = tuple(f"new{k}" for k in range(2))
    new = points()[:2] + 0.02 * np.random.default_rng(1).normal(size=(2, L, 2))
    write_configurations(folder / "new.tps", LandmarkConfigurations(names=names, points=new))
    if "new.tps" in command:
        write_csv(folder / "skulls.csv", ("specimen", "sex"), ("new0", "f"), ("new1", "m"))
    else:
        assert run("align", "skulls.tps", "--table", "skulls.csv", "-o", "aligned").code == 0
    if "aligned" in command and not (folder / "aligned").exists():
        assert run("align", "skulls.tps", "-o", "aligned").code == 0
    outcome = run(*command, "-o", "out", "--json")
    assert outcome.code == 0, outcome.err
    analysis = json.loads((folder / "out" / "analysis.json").read_text())
    texts = [*analysis["summary"], *analysis["notes"], json.dumps(analysis["parts"])]
    assert not [text for text in texts if " mm" in text or '"mm"' in text]
    heads = [name for file in (folder / "out").glob("*.csv") for name in file.read_text().splitlines()[0].split(",")]
    assert heads and not [name for name in heads if "mm" in name.split("_")]


@pytest.mark.parametrize("left", [True, False])
def test_sides_that_are_mirror_images_are_reflected_on_request(run: Run, folder: Path, left: bool) -> None:
    given = points()
    given[1::2] *= [-1, 1]
    write(folder / "skulls.tps", given)
    given[0::2] *= [-1, 1]
    side = "L" if left else "R"
    outcome = run("align", "skulls.tps", "--table", "skulls.csv", "--reflect", f"side={side}", "-o", "one")
    assert outcome.code == 0 and f"8 of 16 specimens are reflected, those with side {side}" in outcome.err
    assert (
        run("asymmetry", "one", "--set", "subject=animal", "--side", "side", "--permutations", "20", "-o", "out").code
        == 0
    )
    assert run("align", "skulls.tps", "--table", "skulls.csv", "-o", "raw").code == 0
    assert (
        "mirror images" in run("asymmetry", "raw", "--set", "subject=animal", "--side", "side", "-o", "out").sentence()
    )


@pytest.mark.parametrize(
    ("content", "arguments", "words"),
    [
        ("name,1.X,1.Y,2.X,2.Y,3.X,3.Y\na,0,0,1,0,0,1\n", (), "one specimen cannot be aligned"),
        ("name,1.X,1.Y,2.X,2.Y\na,0,0,1,0\nb,0,0,1,2\n", (), "2 landmarks have no shape"),
        ("name,1.X,1.Y,2.X,2.Y,3.X,3.Y\na,0,0,1,1,2,2\nb,0,0,1,0,0,1\n", (), "all landmarks of a lie on a line"),
        (
            "name,1.X,1.Y,2.X,2.Y,3.X,3.Y\na,0,0,1,1,NA,NA\nb,0,0,1,0,0,1\nc,0,0,2,0,0,1\n",
            (),
            "2 landmarks are observed",
        ),
        (None, ("--reflect", "side"), "write COLUMN=VALUE"),
        (None, ("--reflect", "side=left"), "has no column 'side'"),
        (None, ("--table", "other.csv"), "contains no specimen of other.csv (rows such as x; specimens "),
        (None, ("--sliders", "bad.csv"), "the row '1, 10, 3'"),
        (None, ("--separate", "structures.csv"), "landmark '2' has no structure"),
        (None, ("--separate", "other.csv"), "has no columns landmark and structure"),
    ],
)
def test_bad_input_ends_in_one_sentence(
    run: Run, folder: Path, content: str | None, arguments: tuple[str, ...], words: str
) -> None:
    if content is not None:
        (folder / "bad_input.csv").write_text(content)
    write_csv(folder / "other.csv", ("specimen", "sex"), ("x", "f"))
    write_csv(folder / "bad.csv", ("before", "slide", "after"), (1, 10, 3))
    write_csv(folder / "structures.csv", ("landmark", "structure"), ("1", "head"))
    outcome = run("align", "skulls.tps" if content is None else "bad_input.csv", *arguments, "-o", "out")
    assert outcome.code == 2 and words in outcome.sentence()


def test_links_and_views_beside_the_data_are_in_the_output_with_numbers(run: Run, folder: Path) -> None:
    write_csv(folder / "links.csv", ("from", "to"), (1, 2), ("3", "9"))
    (folder / "orientation.json").write_text(
        '{"views": [{"name": "dorsal", "toward_viewer": [0, 0, 1], "up": [0, 1, 0]}]}'
    )
    assert run("align", "skulls.tps", "-o", "out").code == 0
    orientation = json.loads((folder / "out" / "orientation.json").read_text())
    assert orientation["links"] == [[1, 2], [3, 9]] and orientation["views"][0]["name"] == "dorsal"
    write_csv(folder / "links.csv", ("from", "to"), (1, 77))
    refused = run("align", "skulls.tps", "-o", "other")
    assert refused.code == 2 and "links.csv has the row '1, 77'" in refused.err and not (folder / "other").exists()


def test_commands_that_read_aligned_landmarks_have_one_note_on_specimens_to_check(run: Run, folder: Path) -> None:
    given = points()
    given[5] *= [-1, 1]
    given[3, 2] = np.nan
    write(folder / "skulls.tps", given)
    assert "1 specimen to check" in run("align", "skulls.tps", "--table", "skulls.csv", "-o", "aligned").out
    outcome = run("test", "disparity", "aligned", "--group", "sex", "--permutations", "20", "-o", "out")
    assert outcome.err.count("aligned: 1 specimen to check, 1 estimated landmark (see align.json).") == 1
    assert "mirrored" not in outcome.err + outcome.out


def test_a_folder_that_align_wrote_is_no_landmark_file(run: Run, folder: Path) -> None:
    assert run("align", "skulls.tps", "-o", "aligned").code == 0
    landmarks = ("check",), ("plot", "-o", "again.png"), ("convert", "-o", "again.tps")
    for command, *rest in (("align", "-o", "again"), *(("landmarks", *one) for one in landmarks)):
        name = rest.pop(0) if command == "landmarks" else ""
        refused = run(*filter(None, (command, name)), "aligned", *rest)
        assert (
            refused.code == 2 and "aligned is a folder that align wrote; give the original landmark file" in refused.err
        )


def test_columns_of_files_call_landmarks_by_their_name(run: Run, folder: Path) -> None:
    assert run("align", "skulls.tps", "--table", "skulls.csv", "-o", "aligned").code == 0
    given = points() + 0.1 * np.random.default_rng(1).normal(size=(N, L, 2))
    names = tuple(f"n{k}" for k in range(len(given)))
    write_configurations(folder / "new.tps", LandmarkConfigurations(names=names, points=given))
    assert run("score", "new.tps", "--reference", "aligned", "--modes", "3", "-o", "out").code == 0
    header = (folder / "out" / "scores.csv").read_text().splitlines()[0]
    assert "landmarks_beyond_2sd" in header and "vertices" not in header and "_mm" not in header
    assert "The reference has 16 shapes" in (folder / "out" / "methods.txt").read_text()
