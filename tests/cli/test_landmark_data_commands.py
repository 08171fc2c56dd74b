"""`landmarks convert`, `check` and `plot`, and `export --to`, on files of many specimens."""

import csv
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from conftest import Run
from shapespace.cohort.read import read_cohort
from shapespace.io.landmarks.configuration_io import read_configurations, write_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.types import FloatArray
from synthetic_shapes import training_meshes

R = shutil.which("Rscript")
FORMULA = "~ sex * C(site) + log_size"


def shapes(dimensions: int = 2, count: int = 24) -> FloatArray:
    rng = np.random.default_rng(dimensions)
    mean = rng.normal(size=(9, dimensions)) * [4, 2, 1][:dimensions]
    points = (mean + 0.1 * rng.normal(size=(count, 9, dimensions))) * rng.uniform(0.8, 1.2, (count, 1, 1))
    points[::2, 0] += 0.2
    return points + 20 * rng.normal(size=(count, 1, dimensions))


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """A wide table of planar landmarks with covariates of unequal numbers."""
    points = shapes()
    path = tmp_path / "newts.csv"
    columns = {"sex": tuple("fmfmfffm"[k % 8] for k in range(24)), "site": tuple("112"[k % 3] for k in range(24))}
    names = tuple(f"n{k}" for k in range(24))
    write_configurations(path, LandmarkConfigurations(names=names, points=points, columns=columns))
    return path


def damaged(tmp_path: Path) -> Path:
    """Landmarks in 3-D with a specimen mirrored, one with swapped landmarks, one in another unit, and two the same."""
    points = shapes(3)
    points[3, :, 0] *= -1
    points[5, [0, 1]] = points[5, [1, 0]]
    points[7] *= 10
    points[9] = points[8]
    points[1, 2] = points[2, 4] = points[1, 4] = np.nan
    points[0, 8] = points[0, 6]
    path = tmp_path / "damaged.tps"
    write_configurations(path, LandmarkConfigurations(names=tuple(f"n{k}" for k in range(24)), points=points))
    return path


def test_landmarks_are_converted_with_their_sliders_and_what_is_left_out_is_printed(
    run: Run, table: Path, tmp_path: Path
) -> None:
    sliders = tmp_path / "curves.csv"
    sliders.write_text("before,slide,after\n1,2,3\n")
    outcome = run("landmarks", "convert", table, "-o", tmp_path / "newts.tps", "--sliders", sliders)
    assert outcome.code == 0 and "24 specimens with 9 landmarks" in outcome.out
    assert outcome.err.splitlines() == [
        "Columns of the table (sex, site) are omitted, since the format tps has no columns.",
        "The sliders are in newts.curveslide.csv.",
    ]
    assert (tmp_path / "newts.curveslide.csv").read_text() == "before,slide,after\n1,2,3\n"
    back = read_configurations(tmp_path / "newts.tps")
    np.testing.assert_array_equal(back.points, read_configurations(table).points)
    arguments = (tmp_path / "newts.tps", "-o", tmp_path / "newts.txt", "--to", "morphoj", "--json")
    facts = run("landmarks", "convert", *arguments).facts
    assert facts["specimens"] == 24 and facts["dimensions"] == 2


def test_data_without_faults_are_counted_and_found_clean(run: Run, table: Path) -> None:
    outcome = run("landmarks", "check", table)
    assert outcome.code == 0 and outcome.err == ""
    assert outcome.out.splitlines() == [
        "specimens: 24", "landmarks: 9", "semilandmarks: 0", "dimensions: 2", "columns: [sex, site]", "missing: 0",
        "no problems found",
    ]  # fmt: skip


def test_a_check_names_what_is_missing_duplicate_mirrored_swapped_and_in_another_unit(run: Run, tmp_path: Path) -> None:
    path = damaged(tmp_path)
    outcome = run("landmarks", "check", path, "--json")
    assert outcome.code == 1
    facts = outcome.facts
    assert facts["missing_by_specimen"] == {"n1": 2, "n2": 1} and facts["missing_by_landmark"] == {"3": 1, "5": 2}
    for words in (
        "n9 has the same coordinates as n8", "Landmarks 7 and 9 are at the same place in 1 of 24 specimens",
        "n7 is 10", "n3 is mirrored", "n5: exchange of the landmarks 1 and 2",
    ):  # fmt: skip
        assert sum(words in finding for finding in facts["findings"]) == 1, words
    assert "n0 is an outlier" in facts["findings"][3] and len(facts["findings"]) == 6
    plain = run("landmarks", "check", path)
    assert plain.code == 1 and "missing by specimen: n1 2, n2 1" in plain.out and "n3 is mirrored" in plain.err
    assert "n7 is 10" in run("align", path, "-o", tmp_path / "aligned").err


@pytest.mark.parametrize("dimensions", [2, 3])
def test_a_plot_has_a_number_for_each_landmark(run: Run, dimensions: int, tmp_path: Path) -> None:
    points = shapes(dimensions)
    points[0, 0] = np.nan
    path = tmp_path / "a.tps"
    write_configurations(path, LandmarkConfigurations(names=tuple(f"n{k}" for k in range(24)), points=points))
    (tmp_path / "links.csv").write_text("from,to\n1,2\n2,9\n")
    outcome = run("landmarks", "plot", path, "-o", tmp_path / "a.svg", "--links", tmp_path / "links.csv")
    assert outcome.code == 0 and "n0" in outcome.err
    text = (tmp_path / "a.svg").read_text()
    assert run("landmarks", "plot", path, "-o", tmp_path / "b.svg").code == 0
    assert (tmp_path / "b.svg").read_text() == text, "links next to the data"
    panels = 1 if dimensions == 2 else 3
    for number in range(1, 10):
        assert text.count(f">{number}</text>") >= panels
    assert text.count("missing landmarks, estimated") == 1


@pytest.mark.skipif(R is None, reason="R is not installed: apt-get install r-base-core")
@pytest.mark.parametrize("anova_type", ["I", "II", "III"])
def test_base_r_computes_our_sums_of_squares_from_the_export(run: Run, anova_type: str, table: Path) -> None:
    folder = table.parent / "r"
    assert run("export", table, "--to", "geomorph", "--formula", FORMULA, "-o", folder).code == 0
    script = folder / "shapespace.R"
    script.write_text(script.read_text().replace('ss_type <- "II"', f'ss_type <- "{anova_type}"'))
    assert R is not None
    done = subprocess.run([R, "--vanilla", script.name], cwd=folder, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    with (folder / "anova.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    config = CompareConfig(anova_type=anova_type, permutations=20, maps=False, variances="equal")
    effect = compare(read_cohort(table), FORMULA, config)
    ours = {one.term.replace(" ", ""): one for one in effect.tests}
    assert len(rows) == len(ours) + 2
    for row in rows[:-2]:
        one = ours[row["term"].replace(" ", "")]
        measured = [float(row[name]) for name in ("Df", "SS", "R2", "F")]
        np.testing.assert_allclose(measured, [one.df, one.squares, one.r2, one.f], rtol=1e-9)


@pytest.mark.skipif(R is None, reason="R is not installed: apt-get install r-base-core")
def test_geomorph_computes_our_sums_of_squares_from_the_export(run: Run, table: Path) -> None:
    assert R is not None
    asked = [R, "--vanilla", "-e", 'cat(requireNamespace("geomorph", quietly = TRUE))']
    if "TRUE" not in subprocess.run(asked, capture_output=True, text=True, timeout=60).stdout:
        pytest.skip("geomorph is not installed in R: install.packages('geomorph')")
    folder = table.parent / "r"
    run("export", table, "--to", "geomorph", "--formula", "~ sex", "-o", folder)
    check = "stopifnot(all.equal(fit$aov.table$SS[1], anova$SS[1]))\n"
    (folder / "check.R").write_text((folder / "shapespace.R").read_text() + check)
    done = subprocess.run([R, "--vanilla", "check.R"], cwd=folder, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("to", "ending"), [("tps", ".tps"), ("csv", ".csv"), ("morphoj", ".txt")])
def test_a_cohort_is_exported_as_aligned_coordinates(run: Run, to: str, ending: str, table: Path) -> None:
    out = table.parent / f"aligned{ending}"
    assert run("export", table, "--to", to, "-o", out).code == 0
    back, cohort = read_configurations(out), read_cohort(table)
    row = [cohort.names.index(name) for name in back.names]
    np.testing.assert_array_equal(back.points, np.stack([cohort.vertices(k) for k in row])[:, :, :2])
    if to == "csv":
        assert set(back.columns) == {"size", "sex", "site"}
    assert run("export", table, "--to", to, "-o", table.parent / "folder").code == 0
    assert (table.parent / "folder" / f"landmarks{ending}").is_file()


def test_surfaces_are_exported_with_their_vertices(run: Run, tmp_path: Path) -> None:
    meshes = training_meshes(6, 40)
    for k, mesh in enumerate(meshes):
        write_mesh(tmp_path / f"blob{k}.ply", mesh)
    (tmp_path / "t.csv").write_text("name,group\n" + "".join(f"blob{k},g{k % 2}\n" for k in range(6)))
    outcome = run("export", tmp_path / "t.csv", "--to", "geomorph", "-o", tmp_path / "r", "--json")
    assert outcome.code == 0 and outcome.facts["shapes"] == 6
    found = read_configurations(tmp_path / "r" / "coordinates.csv")
    assert found.points.shape == (6, len(meshes[0].vertices), 3)
    assert "coords ~ 1\n" in (tmp_path / "r" / "shapespace.R").read_text()


def test_bad_input_ends_with_one_sentence(run: Run, table: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("1,2\n2,99\n")
    (tmp_path / "one.tps").write_text("LM=3\n1 2\n3 4\n5 7\nID=a\nSCALE=1\n")
    none = tmp_path / "none.tps"
    for arguments, words in (
        (("landmarks", "check", none), "no such file"),
        (("landmarks", "check", table, "-o", none), "-o goes with SAME, the folder that correspond wrote; omit -o"),
        (("landmarks", "convert", table, "-o", table), "is the file to convert"),
        (("landmarks", "convert", table, "-o", tmp_path / "a.doc"), "has no format"),
        (("landmarks", "convert", table, "-o", tmp_path / "a.csv", "--to", "word"), "there is no format 'word'"),
        (("landmarks", "convert", table, "-o", tmp_path / "a.tps", "--object", "land"), "omit --object"),
        (
            ("landmarks", "convert", table, "-o", tmp_path / "a.tps", "--sliders", tmp_path / "bad.csv"),
            "before, slide, after",
        ),
        (("landmarks", "plot", table, "-o", tmp_path / "a.jpg"), "cannot be written as 'jpg'"),
        (("landmarks", "plot", table, "-o", tmp_path / "a.svg", "--links", tmp_path / "bad.csv"), "the row '2, 99'"),
        (("landmarks", "plot", tmp_path / "one.tps", "-o", tmp_path / "a.svg"), "two or more"),
        (("export", table, "n1", "--to", "tps"), "omit names"),
        (("export", table, "--formula", "~ sex"), "give --to geomorph too"),
        (("export", table, "--to", "tps", "--formula", "~ sex"), "give --to geomorph too"),
        (("export", table, "--to", "geomorph", "--formula", "~ age", "-o", tmp_path / "r"), "age"),
    ):
        outcome = run(*arguments)
        assert outcome.code == 2, arguments
        assert words in outcome.err.splitlines()[-1], (words, outcome.err)
        assert "Traceback" not in outcome.err


def test_numbers_that_json_cannot_hold_are_refused_before_any_work(run: Run, table: Path) -> None:
    outcome = run("test", "disparity", table, "--group", "sex", "--set", f"seed={10**20}", "-o", table.parent / "out")
    assert outcome.code == 2 and "argument --set: seed must be below" in outcome.err
