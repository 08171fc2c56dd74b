"""`shapespace landmarks`: from a few marked specimens of a correspondence to all, checked, and what to mark next."""

import csv
from pathlib import Path

import numpy as np
import pytest

from conftest import Run
from same_blobs import ASIDE, write_same
from shapespace.geometry.closest import build_engine
from shapespace.io.landmarks.landmark_io import FIDUCIAL_ENDINGS, read_landmarks, write_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import FloatArray

NAMES = ("able", "baker", "cable", "item")
TRIANGLES = {"a": 3, "b": 200, "c": 700}


@pytest.fixture
def same(tmp_path: Path) -> Path:
    return write_same(tmp_path, NAMES)


def places(same: Path, name: str) -> dict[str, FloatArray]:
    mesh = read_mesh(same / f"{name}.corresponding.ply")
    return {mark: mesh.vertices[np.asarray(mesh.faces)[t]].mean(axis=0) for mark, t in TRIANGLES.items()}


def mark(same: Path, name: str, ending: str = ".csv", **others: FloatArray) -> Path:
    folder = same.parent / "marked"
    folder.mkdir(exist_ok=True)
    write_landmarks(folder / f"{name}{ending}", places(same, name) | others)
    return folder


def test_each_scan_gets_the_landmarks_in_all_formats_with_triangle_region_and_status(run: Run, same: Path) -> None:
    out = same.parent / "out"
    marked = mark(same, "able")
    mark(same, "cable", ".mrk.json")
    assert run("landmarks", "transfer", marked, same, "-o", out, "--quiet").code == 0
    for name in NAMES:
        for ending in FIDUCIAL_ENDINGS:
            found = read_landmarks(out / f"{name}{ending}")
            for key, at in places(same, name).items():
                np.testing.assert_allclose(found[key], at, atol=1e-3)
        scan = read_mesh(same.parent / "scans" / f"{name}.ply")
        with (out / f"{name}.landmarks.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        for row in rows:
            corners = [int(row[k]) for k in ("vertex", "vertex_2", "vertex_3")]
            weights = np.array([float(row[k]) for k in ("weight", "weight_2", "weight_3")])
            np.testing.assert_allclose(weights @ scan.vertices[corners], places(same, name)[row["name"]], atol=1e-3)
            given = name in ("able", "cable")
            assert row["status"] == ("marked" if given else "converged")
            assert row["radius_90"] == "" if given else 0 < float(row["radius_90"]) < 20
    lines = (out / "landmarks.tps").read_text().splitlines()
    assert [line for line in lines if "=" in line] == [x for name in NAMES for x in ("LM3=3", f"ID={name}")]
    np.testing.assert_allclose(np.array(lines[6].split(), dtype=float), places(same, "baker")["a"], atol=1e-3)
    facts = run("landmarks", "transfer", marked, same, "-o", out, "--quiet", "--json").facts
    assert [(one["name"], one["status"]) for one in facts["records"]][:2] == [
        ("able", "marked"),
        ("baker", "converged"),
    ]


def test_one_marked_specimen_is_enough_and_a_scan_that_is_gone_is_named(run: Run, same: Path) -> None:
    (same.parent / "scans" / "item.ply").unlink()
    outcome = run("landmarks", "transfer", mark(same, "able"), same, "-o", same.parent / "out", "--quiet")
    assert outcome.code == 0 and "item: landmarks are on the corresponding surface" in outcome.err


def test_names_that_only_some_have_are_transferred_and_named(run: Run, same: Path) -> None:
    marked = mark(same, "able")
    mark(same, "cable", A=places(same, "cable")["a"])
    outcome = run("landmarks", "transfer", marked, same, "-o", same.parent / "out", "--quiet")
    assert "'a' and 'A' differ in spelling only" in outcome.err and "have A (1); each comes from" in outcome.err
    assert set(read_landmarks(same.parent / "out" / "able.landmarks.csv")) == {"a", "b", "c", "A"}


def test_a_check_prints_and_writes_errors_and_ends_with_one_where_it_finds_an_outlier(run: Run, same: Path) -> None:
    marked, *_ = (mark(same, name) for name in NAMES)
    table = same.parent / "check.csv"
    outcome = run("landmarks", "check", marked, same, "-o", table)
    assert outcome.code == 0 and "12 landmarks compared, 0 with a finding" in outcome.out
    wrong = places(same, "item")
    mark(same, "item", a=wrong["b"], b=wrong["a"])
    outcome = run("landmarks", "check", marked, same, "-o", table)
    assert outcome.code == 1 and "item: landmark 'a' is" in outcome.err and "swapped with b" in outcome.err
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 12 and [row["finding"] for row in rows if row["specimen"] == "item"][2] == ""


def test_suggestions_leave_out_marked_specimens(run: Run, same: Path) -> None:
    facts = run("landmarks", "suggest", same, "--marked", mark(same, "able"), "--count", "9", "--json").facts
    assert sorted(one["name"] for one in facts) == ["baker", "cable", "item"]
    assert "1. " in run("landmarks", "suggest", same).out


def test_bad_input_ends_with_one_sentence_that_names_it(run: Run, same: Path) -> None:
    out = same.parent / "out"
    marked = mark(same, "able")

    def refusal(*arguments: object) -> str:
        outcome = run("landmarks", "transfer", *arguments, "-o", out, "--quiet")
        assert outcome.code == 2 and not out.exists()
        return outcome.err

    assert "run 'shapespace correspond" in refusal(marked, same.parent / "scans")
    mark(same, "able", ".fcsv", b=places(same, "able")["c"])
    assert "able.csv and able.fcsv give different positions for landmark 'b' of able" in refusal(marked, same)
    (marked / "able.fcsv").unlink()
    write_landmarks(marked / "able.csv", {"a": np.full(3, 9e3)})
    assert "another specimen or in another frame" in refusal(marked, same)
    (marked / "able.csv").write_text("name,x,y,z\na,1,nan,2\n")
    assert "not finite" in refusal(marked, same)
    (marked / "able.csv").rename(marked / f"{ASIDE}.csv")
    (marked / f"{ASIDE}.csv").write_text("name,x,y,z\na,1,3,2\n")
    assert "all marked specimens are excluded" in refusal(marked, same)
    (marked / f"{ASIDE}.csv").rename(marked / "unknown.csv")
    assert "is named as one of the scans" in refusal(marked, same)


def semilandmarks(same: Path, *rows: str) -> Path:
    file = same.parent / "sets.csv"
    file.write_text("\n".join(("name,kind,along,points", *rows)) + "\n")
    return file


def test_semilandmarks_are_evenly_spaced_on_the_scan_and_named_as_sliders(run: Run, same: Path) -> None:
    out, marked = same.parent / "out", mark(same, "able")
    sets = semilandmarks(same, "ridge,curve,a > b,7", "cap,patch,a > b > c > a,12")
    assert run("landmarks", "transfer", marked, same, "-o", out, "--semilandmarks", sets, "--quiet").code == 0
    for name in NAMES:
        found = read_landmarks(out / f"{name}.landmarks.csv")
        scan = read_mesh(same.parent / "scans" / f"{name}.ply")
        chain = np.array([found[key] for key in ("a", *(f"ridge_{k + 1}" for k in range(7)), "b")])
        gaps = np.linalg.norm(np.diff(chain, axis=0), axis=1)
        assert gaps.std() < 0.05 * gaps.mean()
        patch = np.array([found[f"cap_{k + 1}"] for k in range(12)])
        assert build_engine(scan).query(np.concatenate([chain[1:-1], patch])).distance.max() < 1e-6 * np.ptp(patch)
        nearest = np.sort(np.linalg.norm(patch[:, None] - patch, axis=2), axis=1)[:, 1]
        assert nearest.min() > 0.4 * nearest.max()
    with (out / "curveslide.csv").open(newline="") as stream:
        rows = [tuple(row.values()) for row in csv.DictReader(stream)]
    assert len(rows) == 7 and rows[0] == ("1", "4", "5") and rows[-1][2] == "2"
    assert (out / "surfslide.csv").read_text().split()[1:] == [str(k) for k in range(11, 23)]


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("ridge,curve,a > nose,5", "no marked specimen has a landmark named 'nose'"),
        ("ridge,curve,a,5", "needs two or more landmarks"),
        ("ridge,curve,a > b,0", "has 0 points; give 1 or more"),
        ("cap,patch,a > b > c,9", "patch cap"),
        ("a,curve,a > b,5", "is the name of another point"),
        ("ridge,line,a > b,5", "the kind curve or patch"),
    ],
)
def test_unusable_semilandmarks_are_refused_with_a_sentence(run: Run, same: Path, row: str, words: str) -> None:
    sets = semilandmarks(same, row)
    outcome = run(
        "landmarks", "transfer", mark(same, "able"), same, "-o", same.parent / "out", "--semilandmarks", sets, "--quiet"
    )
    assert outcome.code == 2 and words in outcome.err and "Traceback" not in outcome.err
