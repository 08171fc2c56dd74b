"""Every command does, prints and writes what docs/cli.md and docs/fit-results.md promise."""

import argparse
import csv
import json
import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from conftest import Outcome, Run, World, leftovers
from shapespace import __version__
from shapespace.cli import parser
from shapespace.datasets.bones import Bone
from shapespace.datasets.faces import EXPRESSIONS
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.geometry.mirror_plane import pairs_of_triangles
from shapespace.io.files import sha256_of_file
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, Mesh

COMMANDS = (["demo"], ["data", "list"], ["data", "get"], ["data", "faces"], ["check"], ["build"], ["info"], ["fit"])
STATISTICS = {"mean", "median", "rms", "p95", "max", "count"}


def record_of(folder: Path, name: str = "scan_0") -> dict[str, Any]:
    return json.loads((folder / f"{name}.fit.json").read_text())


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "coefficients.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_shows_an_example_that_parses(command: list[str], run: Run) -> None:
    outcome = run(*command, "--help")
    assert outcome.code == 0
    line = next(line for line in outcome.out.splitlines() if line.startswith("example: "))
    words = line.removeprefix("example: ").split()
    assert words[: 1 + len(command)] == ["shapespace", *command]
    parsed: argparse.Namespace = parser().parse_args(words[1:])
    assert callable(parsed.run)
    assert "--quiet" in outcome.out and "--json" in outcome.out


def test_help_names_every_command_and_version_is_told(run: Run) -> None:
    outcome = run("--help")
    assert outcome.code == 0
    assert all(command[0] in outcome.out for command in COMMANDS)
    assert run("--version").out.strip() == f"shapespace {__version__}"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nonsense"],
        ["data"],
        ["fit", "model.h5"],
        ["fit", "model.h5", "scan.ply"],
        ["fit", "model.h5", "scan.ply", "-o", "out", "--unit", "furlong"],
        ["fit", "model.h5", "scan.ply", "-o", "out", "--jobs", "-1"],
        ["fit", "model.h5", "scan.ply", "-o", "out", "--set", "max_iterations=0"],
        ["build", "a.ply", "-o", "m.h5", "--variance", "0"],
        ["build", "a.ply", "-o", "m.h5", "--variance", "nan"],
        ["build", "a.ply", "-o", "m.h5", "--modes", "0"],
        ["build", "a.ply", "-o", "m.h5", "--modes", "3", "--variance", "0.9"],
        ["build", "a.ply", "-o", "m.h5", "--gauge", "size"],
        ["data", "faces", "-o", "x", "--subjects", "none"],
    ],
)
def test_wrong_arguments_exit_with_2_and_say_which(arguments: list[str], run: Run) -> None:
    outcome = run(*arguments)
    assert outcome.code == 2
    assert "error: " in outcome.err and outcome.out == ""


def test_data_list_tells_licence_size_and_hash(run: Run) -> None:
    text = run("data", "list")
    assert text.code == 0
    for word in ("james", "ict-facekit", "licence: BSD", "licence: MIT", "download_bytes: ", "commit: "):
        assert word in text.out
    rows = cast(list[dict[str, Any]], run("data", "list", "--json", "--quiet").facts)
    assert {"james", "ict-facekit"} <= {row["name"] for row in rows}
    assert all(row["licence"] for row in rows)


def test_data_get_copies_from_the_local_mirror(
    run: Run, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", str(shared_data))
    outcome = run("data", "get", "james", "--to", tmp_path / "here", "--json", "--quiet")
    assert outcome.code == 0, outcome.err
    assert (Path(outcome.facts["folder"]) / "james.obj").is_file()


def test_data_get_of_an_unknown_name_lists_the_known_ones(run: Run) -> None:
    outcome = run("data", "get", "mona-lisa")
    assert outcome.code == 2
    assert "mona-lisa" in outcome.sentence() and "james" in outcome.err


def test_data_faces_writes_corresponding_faces_with_labels(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "faces"
    names = "neutral,smile"
    assert set(names.split(",")) <= set(EXPRESSIONS)
    outcome = run("data", "faces", "-o", folder, "--subjects", 2, "--expressions", names, "--seed", 3, "--json")
    assert outcome.code == 0
    assert outcome.facts == {"folder": str(folder), "faces": 4}
    with (folder / "labels.csv").open(newline="") as stream:
        labels = list(csv.DictReader(stream))
    assert [row["expression"] for row in labels] == ["neutral", "smile"] * 2
    meshes = [read_mesh(folder / row["file"]) for row in labels]
    assert all(np.array_equal(mesh.faces, meshes[0].faces) for mesh in meshes)
    assert not np.array_equal(meshes[0].vertices, meshes[1].vertices)
    text = run("data", "faces", "-o", tmp_path / "again", "--subjects", 1, "--seed", 3)
    assert text.out.strip() == f"1 face in {tmp_path / 'again'}"
    again = tmp_path / "again" / labels[0]["file"]
    assert again.read_bytes() == (folder / labels[0]["file"]).read_bytes()


def test_data_faces_writes_wide_people_and_faces_alone_and_says_so(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "wide"
    assert run("data", "faces", "-o", folder, "--subjects", 1, "--wide", "--area", "face").code == 0
    assert "vary widely" in (folder / "about.json").read_text(encoding="utf-8")
    assert len(read_mesh(folder / "subject_000_neutral.ply").vertices) < 10_000
    refused = run("data", "faces", "-o", tmp_path / "ict", "--source", "ict-facekit", "--wide")
    assert refused.code == 2
    assert "omit --wide" in refused.err
    assert not (tmp_path / "ict").exists()


@pytest.mark.parametrize("names", ["", "neutral,neutral", "schadenfreude"])
def test_data_faces_refuses_odd_lists_of_expressions(names: str, run: Run, tmp_path: Path) -> None:
    outcome = run("data", "faces", "-o", tmp_path / "faces", "--expressions", names)
    assert outcome.code == 2
    outcome.sentence()
    assert not list((tmp_path).rglob("*.ply"))


def test_check_tells_what_is_there(run: Run, world: World) -> None:
    text = run("check", world.scan)
    assert text.code == 0
    assert "vertices: 1000" in text.out and text.out.rstrip().endswith("usable")
    (report,) = run("check", world.scan, "--json").facts
    assert report["file"] == str(world.scan) and report["usable"] is True
    assert report["vertices"] == 1000 and report["components"] == 1


def test_check_writes_repaired_meshes_in_mm_and_their_mirror_images(run: Run, world: World, tmp_path: Path) -> None:
    bad = tmp_path / "bad.ply"
    bad.write_text("nonsense")
    (tmp_path / "out").mkdir()
    stale = tmp_path / "out" / "bad.ply"
    stale.write_text("of an earlier run")
    reports = run("check", world.scan, bad, "-o", tmp_path / "out", "--unit", "cm", "--mirror", "--json").facts
    wanted, written = read_mesh(world.scan), read_mesh(Path(reports[0]["written"]))
    assert "written" not in reports[1] and not stale.exists()
    assert np.array_equal(written.vertices, wanted.vertices * [-10.0, 10.0, 10.0])
    assert wanted.faces is not None and np.array_equal(written.faces, wanted.faces[:, ::-1])


def test_check_writes_symmetric_meshes_and_names_files_without_symmetry(run: Run, tmp_path: Path) -> None:
    skull, organ = tmp_path / "skull.ply", tmp_path / "organ.ply"
    write_mesh(skull, raw_surface(Bone.draw(np.random.default_rng(3)), np.random.default_rng(3), 500))
    write_mesh(organ, raw_surface(Organ.draw(np.random.default_rng(0)), np.random.default_rng(0), 500))
    outcome = run("check", skull, organ, "-o", tmp_path / "out", "--symmetric", "--unit", "cm", "--json")
    assert outcome.code == 1
    report, refused = outcome.facts
    written = read_mesh(Path(report["written"]))
    assert written.faces is not None
    pairs = pairs_of_triangles(written.faces, len(written.vertices))
    assert pairs is not None
    assert (pairs == np.arange(len(pairs))).sum() == report["midline_vertices"]
    assert len(pairs) == report["midline_vertices"] + 2 * report["vertex_pairs"]
    normal, point = np.array(report["plane_normal"]), np.array(report["plane_point_mm"])
    assert np.abs((written.vertices[pairs] - written.vertices) @ normal / 2
                  + (written.vertices - point) @ normal).max() < 1e-9  # fmt: skip
    assert 0.0 < report["asymmetry_share"] < 0.02
    assert "organ.ply has no mirror symmetry" in refused["error"]
    assert not (tmp_path / "out" / "organ.ply").exists()
    assert "--symmetric" in run("check", skull, "--symmetric").sentence()


def test_check_writes_groomed_meshes_in_the_frame_and_unit_of_the_file(run: Run, world: World, tmp_path: Path) -> None:
    scan = read_mesh(world.scan)
    assert scan.faces is not None
    far = scan.vertices.max(axis=0) + 500.0
    bits = Mesh(far + np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32))
    faces = np.concatenate([scan.faces, bits.faces + len(scan.vertices)]).astype(np.int32)
    write_mesh(tmp_path / "dirty.ply", Mesh(np.concatenate([scan.vertices, bits.vertices]), faces))
    (report,) = run("check", tmp_path / "dirty.ply", "-o", tmp_path / "out", "--largest", "--json").facts
    assert report["findings"][-1]["what"] == "It has 2 separate pieces."
    written = read_mesh(Path(report["written"]))
    assert written.faces is not None
    assert np.array_equal(written.vertices, scan.vertices) and np.array_equal(written.faces, scan.faces)
    crop = f"sphere:{','.join(map(str, far))},3"
    again = ("check", world.scan, tmp_path / "dirty.ply", "-o", tmp_path / "out", f"--crop={crop}", "--unit", "cm")
    outcome = run(*again, "--json")
    assert outcome.code == 1 and "leaves 0 of its 1000 vertices" in outcome.sentence()
    assert np.array_equal(read_mesh(tmp_path / "out" / "dirty.ply").vertices, 10.0 * bits.vertices)
    assert not (tmp_path / "out" / world.scan.name).exists()
    assert "apply to the meshes that are written" in run("check", world.scan, "--fill-holes", "30").sentence()
    assert (
        "There is no crop 'ball:1'" in run("check", world.scan, "-o", tmp_path / "out", "--crop", "ball:1").sentence()
    )


def test_check_overwrites_no_mesh_that_it_reads(run: Run, world: World, tmp_path: Path) -> None:
    scan = tmp_path / "scan.ply"
    scan.write_bytes(world.scan.read_bytes())
    assert "would be overwritten" in run("check", scan, "-o", tmp_path).sentence()
    assert "give their folder with -o" in run("check", scan, "--mirror").sentence()
    assert scan.read_bytes() == world.scan.read_bytes()


def test_check_of_several_files_exits_with_1_when_some_are_bad_and_2_when_all_are(
    run: Run, world: World, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.ply"
    bad.write_text("no mesh")
    mixed = run("check", world.scan, bad, "--json")
    assert mixed.code == 1
    assert [report["usable"] for report in mixed.facts] == [True, False]
    assert str(bad) in mixed.sentence()
    assert run("check", bad, "--quiet").code == 2


def test_build_keeps_landmarks_that_lie_beside_and_says_so(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", 2)
    assert outcome.code == 0
    assert outcome.err == f"Landmarks are taken from {world.meshes / 'landmarks.csv'}.\n{RECONSTRUCTED}\n"
    assert "2 modes of 400 vertices from 12 meshes" in outcome.out
    model = ShapeModel.load(tmp_path / "m.h5")
    assert set(model.landmarks) == {"tip", "top", "left", "back"}
    assert leftovers(tmp_path) == []


def test_build_prints_the_facts_that_info_prints(run: Run, world: World, tmp_path: Path) -> None:
    built = run("build", world.meshes, "-o", tmp_path / "m.h5", "--json", "--quiet", "--licence", "CC0").facts
    told = run("info", tmp_path / "m.h5", "--json").facts
    assert built.pop("model") == str(tmp_path / "m.h5")
    assert told.pop("kind") == "model"
    assert built == told
    assert told["licence"] == "CC0" and told["units"] == "mm" and told["training_shapes"] == 12
    text = run("info", tmp_path / "m.h5")
    assert text.code == 0 and "gauge: shape" in text.out


RECONSTRUCTED = (
    "The model contains 12 training shapes, from which their surfaces can be reconstructed; if they show people, share "
    "it without them (build --without-training-shapes, or convert)."
)
NOT_CALIBRATED = "its results are not calibrated: statuses, intervals and expected errors come from the model alone."


def test_build_and_info_state_that_training_shapes_can_be_reconstructed(run: Run, world: World, tmp_path: Path) -> None:
    with_shapes = run("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", "3")
    assert RECONSTRUCTED in with_shapes.err and NOT_CALIBRATED not in with_shapes.err
    facts = run("info", tmp_path / "m.h5", "--json").facts
    assert facts["training_shapes_in_file"] == 12 and facts["training_shapes_note"] == RECONSTRUCTED
    assert f"training_shapes_note: {RECONSTRUCTED}" in run("info", tmp_path / "m.h5").out


@pytest.mark.parametrize("more", [[], ["--out-of-core"], ["--representation", "vertices"]])
def test_build_omits_training_shapes_on_request_and_states_what_is_lost(
    run: Run, world: World, tmp_path: Path, more: list[str]
) -> None:
    options = [world.meshes, "--modes", "3", *more]
    without = run("build", *options, "-o", tmp_path / "n.h5", "--without-training-shapes")
    assert without.code == 0
    assert f"The model contains no training shapes, so {NOT_CALIBRATED}" in without.err
    assert "reconstructed" not in without.err
    facts = run("info", tmp_path / "n.h5", "--json").facts
    assert facts["training_shapes_in_file"] == 0 and facts["training_shapes"] == 12
    assert facts["training_shapes_note"].endswith(NOT_CALIBRATED)
    model = ShapeModel.load(tmp_path / "n.h5")
    run("build", *options, "-o", tmp_path / "m.h5")
    whole = ShapeModel.load(tmp_path / "m.h5")
    assert model.training is None and whole.training is not None and whole.content_hash == model.content_hash


@pytest.mark.parametrize("output", ["shared.h5", "shared.bin"])
def test_convert_never_writes_training_shapes(run: Run, world: World, tmp_path: Path, output: str) -> None:
    run("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", "3")
    converted = run("convert", tmp_path / "m.h5", tmp_path / output)
    assert f"Omitted: 12 training shapes, so {NOT_CALIBRATED}" in converted.out
    assert ShapeModel.load(tmp_path / output).training is None
    assert ShapeModel.load(tmp_path / "m.h5").training is not None
    again = run("convert", tmp_path / output, tmp_path / "again.h5")
    assert "training shapes, so" not in again.out
    coefficients = ShapeModel.load(tmp_path / "m.h5").training.coefficients  # type: ignore[union-attr]
    for number_type in (np.float64, np.float32):
        assert coefficients[0].astype(number_type).tobytes() not in (tmp_path / output).read_bytes()


@pytest.mark.parametrize(
    ("options", "least", "most"),
    [
        (["--modes", "3"], 3, 3),
        (["--modes", "all"], 8, 11),
        (["--modes", "auto"], 4, 9),
        (["--variance", "1"], 8, 11),
        (["--variance", "0.5"], 1, 3),
    ],
)
def test_build_keeps_as_many_modes_as_asked(
    options: list[str], least: int, most: int, run: Run, world: World, tmp_path: Path
) -> None:
    outcome = run("build", world.meshes, "-o", tmp_path / "m.h5", "--json", *options)
    facts = outcome.facts
    assert least <= facts["modes"] <= most
    if options[1] in ("all", "1"):
        # Those that alignment or rounding made are left out, and counted.
        said = re.search(r"^(\d+) modes? (?:is|are) omitted, because alignment", outcome.err, re.MULTILINE)
        assert facts["modes"] + (int(said[1]) if said else 0) == 11
    if "--variance" in options:
        assert facts["variance_held"] >= min(float(options[1]), 0.9999) - 1e-12
    if options[1] in ("all", "1"):
        assert facts["variance_held"] == pytest.approx(1.0, abs=1e-4)


def test_build_in_gauge_form_keeps_the_size_that_gauge_shape_divides_out(run: Run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    base = read_vertices(rng)
    for k, scale in enumerate((0.8, 0.9, 1.0, 1.1, 1.25)):
        bent = base + 0.5 * np.sin(base[:, ::-1] / 9 + k)
        write_mesh(tmp_path / f"m{k}.ply", Mesh(scale * bent, None))
    files = sorted(tmp_path.glob("m?.ply"))
    stddev = {
        gauge: run("build", *files, "-o", tmp_path / f"{gauge}.h5", "--gauge", gauge, "--modes", "all", "--json").facts[
            "stddev_mm"
        ][0]
        for gauge in ("form", "shape")
    }
    assert stddev["form"] > 5 * stddev["shape"]
    assert ShapeModel.load(tmp_path / "form.h5").gauge == "form"


def read_vertices(rng: np.random.Generator) -> np.ndarray:
    return 40 * rng.standard_normal((60, 3))


def test_no_align_takes_the_meshes_as_they_stand(run: Run, world: World, tmp_path: Path) -> None:
    first = read_mesh(world.meshes / "blob_00.ply")
    for k in range(4):
        write_mesh(tmp_path / f"m{k}.ply", first.with_vertices(first.vertices + np.array([k * 3.0, 0, 0])))
    meshes = sorted(tmp_path.glob("m*.ply"))
    facts = run("build", *meshes, "-o", tmp_path / "m.h5", "--no-align", "--modes", "all", "--json").facts
    # Only a shift varies: one mode, of 3 mm steps at each of 400 vertices.
    assert facts["modes"] == 1
    assert facts["stddev_mm"][0] == pytest.approx(3.0 * np.std(range(4), ddof=1) * np.sqrt(400))


def test_build_turns_the_unit_of_the_meshes_into_mm(run: Run, world: World, tmp_path: Path) -> None:
    meshes = sorted(world.meshes.glob("*.ply"))
    for path in meshes:
        mesh = read_mesh(path)
        write_mesh(tmp_path / path.name, mesh.with_vertices(mesh.vertices / 1000))
    options = ("--modes", 3, "--gauge", "form", "--json")
    metres = run("build", tmp_path, "-o", tmp_path / "m.h5", "--unit", "m", *options).facts
    mm = run("build", world.meshes, "-o", tmp_path / "mm.h5", *options).facts
    assert metres["stddev_mm"] == pytest.approx(mm["stddev_mm"], rel=1e-9)


def test_build_takes_landmarks_as_points_on_the_first_mesh(run: Run, world: World, tmp_path: Path) -> None:
    first = read_mesh(world.meshes / "blob_00.ply")
    write_landmarks(tmp_path / "points.csv", {"nose": first.vertices[17] + 0.01, "chin": first.vertices[200]})
    outcome = run("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", 2, "--landmarks", tmp_path / "points.csv")
    assert outcome.code == 0
    assert dict(ShapeModel.load(tmp_path / "m.h5").landmarks) == {"nose": 17, "chin": 200}


def test_build_keeps_points_between_vertices_and_says_how_far_they_were(run: Run, world: World, tmp_path: Path) -> None:
    first = read_mesh(world.meshes / "blob_00.ply")
    face = np.asarray(first.faces)[5]
    a, b, c = first.vertices[face]
    normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    middle = (a + b + c) / 3
    write_landmarks(tmp_path / "points.csv", {"on": middle, "off": 0.5 * (a + b) + 0.2 * c - 0.2 * a + 3.0 * normal})
    asked = ("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", 2, "--landmarks")
    outcome = run(*asked, tmp_path / "points.csv")
    assert outcome.code == 0
    assert "Landmarks were placed on the surface of blob_00.ply; the given points are 1.5 mm from it" in outcome.err
    assert "at most 3 mm (off)" in outcome.err and "Warning" not in outcome.err
    model = ShapeModel.load(tmp_path / "m.h5")
    np.testing.assert_allclose(model.landmarks.positions(first.vertices)["on"], middle, rtol=0, atol=1e-10)
    np.testing.assert_allclose(model.landmarks.distance_mm, [0.0, 3.0], atol=1e-9)
    facts = run("info", tmp_path / "m.h5", "--json").facts
    assert facts["landmark_distances_mm"]["off"] == pytest.approx(3.0)
    write_landmarks(tmp_path / "metres.csv", {"on": middle / 1000, "off": middle + 900 * normal})
    far = run(*asked, tmp_path / "metres.csv").err
    assert "Warning: 2 landmarks are farther from that surface than 1 % of its size" in far and "the unit" in far


def test_info_knows_meshes_and_fits(run: Run, world: World, fitted: Path) -> None:
    mesh = run("info", world.scan, "--json").facts
    assert mesh["kind"] == "mesh" and mesh["vertices"] == 1000
    fit = run("info", fitted / "scan_0.fit.json", "--json").facts
    assert fit["kind"] == "fit" and fit["status"] == "converged" and "history" not in fit
    assert "status: converged" in run("info", fitted / "scan_0.fit.json").out


@pytest.fixture(scope="session")
def fitted(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from shapespace.cli import main

    folder = tmp_path_factory.mktemp("fitted") / "deep" / "out"
    assert main(["fit", str(world.model), *map(str, world.scans), "-o", str(folder), "--quiet"]) == 0
    return folder


def test_fit_writes_the_files_of_the_contract_and_no_others(fitted: Path, world: World) -> None:
    names = {path.stem for path in world.scans}
    assert {path.name for path in fitted.iterdir()} == {
        "coefficients.csv",
        "scans.csv",
        *(f"{name}.fit.json" for name in names),
        *(f"{name}.fitted.ply" for name in names),
        *(f"{name}.landmarks.{kind}" for name in names for kind in ("csv", "mrk.json", "fcsv")),
    }


def test_the_record_holds_the_keys_of_the_contract(fitted: Path, world: World) -> None:
    record = record_of(fitted)
    model = ShapeModel.load(world.model)
    known = {"hash", "name", "path"}
    for key, name, content_hash, keys in (
        ("scan", "scan_0.ply", sha256_of_file(world.scan), known | {"size_bytes", "modified_ns"}),
        ("model", "model.h5", model.content_hash, known),
    ):
        source = record[key]
        assert (source["name"], source["hash"]) == (name, content_hash)
        assert source.keys() == keys
    assert record["status"] == "converged" and record["reason"].endswith(".")
    assert record["method"] == "robust"
    assert record["config"]["version"] == __version__ and "seed" in record["config"]
    assert record["mm_per_scan_unit"] == 1.0
    T = record["T_scan_model"]
    assert np.shape(T["rotation"]) == (3, 3) and np.shape(T["translation"]) == (3,)
    for key in ("b", "z", "b_stddev"):
        assert len(record[key]) == model.n_modes
    np.testing.assert_allclose(record["z"], record["b"] / model.stddev)
    assert set(record["distances_mm"]) == {"before", "initial", "final"}
    for stage in record["distances_mm"].values():
        for direction in ("model_to_scan", "scan_to_model"):
            assert set(stage[direction]) >= STATISTICS
    assert set(record["history"][0]) >= {"phase", "iteration", "rms_mm"}
    assert set(record["iterations"]) == {"phase_1", "phase_2"}
    assert all(seconds >= 0 for seconds in record["seconds"].values())
    # The pose maps the model's shape onto the fitted surface: x_scan = scale rotation x + translation.
    placed = T["scale"] * model.reconstruct(record["b"]) @ np.transpose(T["rotation"]) + T["translation"]
    surface = read_mesh(fitted / "scan_0.fitted.ply")
    np.testing.assert_allclose(surface.vertices, placed, atol=1e-6)
    assert np.array_equal(surface.faces, model.faces)


def test_the_table_has_one_row_a_scan_in_the_order_given(fitted: Path) -> None:
    rows = rows_of(fitted)
    assert [row["scan"] for row in rows] == ["scan_0", "scan_1", "scan_2"]
    columns = list(rows[0])
    assert columns[:3] == ["scan", "status", "reason"]
    letters = [f"b{k}" for k in range(1, 5)] + [f"z{k}" for k in range(1, 5)]
    assert columns[3:13] == [*letters, "model_to_scan_mean_mm", "scan_to_model_mean_mm"]
    for row in rows:
        record = record_of(fitted, row["scan"])
        assert [float(row[f"b{k}"]) for k in range(1, 5)] == record["b"]
        mean = record["distances_mm"]["final"]["model_to_scan"]["mean"]
        assert float(row["model_to_scan_mean_mm"]) == mean


def test_fit_prints_facts_as_json_or_a_line_a_scan(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("fit", world.model, world.scan, "-o", tmp_path / "o", "--json", "--quiet")
    assert outcome.code == 0 and outcome.err == ""
    facts = outcome.facts
    (record,) = facts.pop("records")
    assert facts == {
        "folder": str(tmp_path / "o"), "scans": 1, "converged": 1, "max_iterations": 0, "doubtful": 0, "failed": 0,
    }  # fmt: skip
    written = record_of(tmp_path / "o")
    assert record.pop("name") == "scan_0"
    assert record == {key: value for key, value in written.items() if key != "history"}
    text = run("fit", world.model, world.scan, "-o", tmp_path / "o")
    lines = text.out.splitlines()
    assert lines[0].replace("->", "→").startswith("scan_0.ply: converged: mean distance model→scan ")
    assert lines[1] == f"1 scan: 1 converged; results in {tmp_path / 'o'}"


def test_the_same_command_gives_the_same_numbers(run: Run, world: World, fitted: Path, tmp_path: Path) -> None:
    run("fit", world.model, world.scan, "-o", tmp_path)
    assert record_of(tmp_path)["b"] == record_of(fitted)["b"]
    assert (tmp_path / "scan_0.fitted.ply").read_bytes() == (fitted / "scan_0.fitted.ply").read_bytes()


@pytest.mark.parametrize("unit", ["m", "cm", "um", "inch"])
@pytest.mark.parametrize("told", [True, False], ids=["told", "found"])
def test_a_scan_in_any_unit_gives_the_same_fit_in_its_own_unit(
    unit: str, told: bool, run: Run, world: World, fitted: Path, scan_mesh: Mesh, tmp_path: Path
) -> None:
    write_mesh(tmp_path / "scan_0.ply", scan_mesh.with_vertices(scan_mesh.vertices / MM_PER_UNIT[unit]))
    options = ["--unit", unit] if told else []
    assert run("fit", world.model, tmp_path / "scan_0.ply", "-o", tmp_path / "o", *options).code == 0
    record, mm = record_of(tmp_path / "o"), record_of(fitted)
    assert record["mm_per_scan_unit"] == MM_PER_UNIT[unit]
    np.testing.assert_allclose(record["b"], mm["b"], atol=1e-6 * np.abs(mm["b"]).max())
    assert record["T_scan_model"]["scale"] * MM_PER_UNIT[unit] == pytest.approx(mm["T_scan_model"]["scale"])
    np.testing.assert_allclose(
        np.array(record["T_scan_model"]["translation"]) * MM_PER_UNIT[unit],
        mm["T_scan_model"]["translation"],
        atol=1e-5,
    )
    np.testing.assert_allclose(
        read_mesh(tmp_path / "o" / "scan_0.fitted.ply").vertices * MM_PER_UNIT[unit],
        read_mesh(fitted / "scan_0.fitted.ply").vertices,
        atol=1e-5,
    )
    final, mm_final = (r["distances_mm"]["final"]["model_to_scan"]["mean"] for r in (record, mm))
    assert final == pytest.approx(mm_final, rel=1e-6)


@pytest.mark.parametrize("unit", ["m", "um"])
def test_a_wrong_unit_never_passes_for_a_good_fit(unit: str, run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("fit", world.model, world.scan, "-o", tmp_path, "--unit", unit, "--strict")
    assert outcome.code in (1, 2)
    assert "scan_0.ply" in outcome.err
    assert record_of(tmp_path)["status"] in ("doubtful", "failed")


def test_landmarks_start_a_fit_that_lies_upside_down(run: Run, world: World, scan_mesh: Mesh, tmp_path: Path) -> None:
    model = ShapeModel.load(world.model)
    turn = np.diag([-1.0, -1.0, 1.0])
    write_mesh(tmp_path / "scan_0.ply", scan_mesh.with_vertices(scan_mesh.vertices @ turn.T))
    points = {name: scan_mesh.vertices[nearest(scan_mesh, model, index)] @ turn.T for name, index in
              model.landmarks.items()}  # fmt: skip
    write_landmarks(tmp_path / "marks.csv", points)
    outcome = run(
        "fit", world.model, tmp_path / "scan_0.ply", "-o", tmp_path / "o", "--landmarks", tmp_path / "marks.csv"
    )
    assert outcome.code == 0, outcome.err
    record = record_of(tmp_path / "o")
    assert record["start"] == "landmarks"
    assert record["landmarks"] == {"name": "marks.csv", "hash": sha256_of_file(tmp_path / "marks.csv")}


def nearest(scan: Mesh, model: ShapeModel, index: int) -> int:
    centred = scan.vertices - scan.vertices.mean(axis=0)
    return int(np.linalg.norm(centred - model.mean_vertices[index], axis=1).argmin())


def test_resume_does_not_take_a_fit_from_other_landmarks(run: Run, world: World, tmp_path: Path) -> None:
    model = ShapeModel.load(world.model)
    command = ("fit", world.model, world.scan, "-o", tmp_path)
    run(*command)
    write_landmarks(tmp_path / "marks.csv", {name: model.mean_vertices[i] for name, i in model.landmarks.items()})
    run(*command, "--landmarks", tmp_path / "marks.csv")
    assert record_of(tmp_path)["start"] == "landmarks"
    run(*command)
    assert record_of(tmp_path)["start"] != "landmarks"


def test_two_jobs_give_what_one_gives(run: Run, world: World, fitted: Path, tmp_path: Path) -> None:
    outcome = run("fit", world.model, *world.scans, "-o", tmp_path, "--jobs", 2, "--quiet")
    assert outcome.code == 0, outcome.err
    two, one = ([{**row, "path": "", "checksum": ""} for row in rows_of(folder)] for folder in (tmp_path, fitted))
    assert two == one
    for scan in world.scans:
        name = f"{scan.stem}.fitted.ply"
        assert (tmp_path / name).read_bytes() == (fitted / name).read_bytes()


def test_resume_fits_only_what_is_missing_or_changed(run: Run, world: World, tmp_path: Path) -> None:
    command = ("fit", world.model, *world.scans[:2], "-o", tmp_path)
    assert run(*command).code == 0
    times = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.fit.json")}
    (tmp_path / "scan_1.fitted.ply").unlink()
    (tmp_path / "coefficients.csv").unlink()
    assert run(*command).code == 0
    again = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.fit.json")}
    assert again["scan_0.fit.json"] == times["scan_0.fit.json"]
    assert again["scan_1.fit.json"] > times["scan_1.fit.json"]
    assert [row["status"] for row in rows_of(tmp_path)] == ["converged", "converged"]
    run(*command, "--stages")
    assert (tmp_path / "scan_0.stages.npz").is_file()


def test_a_damaged_record_is_fitted_again(run: Run, world: World, tmp_path: Path) -> None:
    command = ("fit", world.model, world.scan, "-o", tmp_path)
    run(*command)
    good = record_of(tmp_path)
    for damage in ({"distances_mm": None}, {"b": [1.0]}, {"status": "splendid"}, {"scan": 3}):
        (tmp_path / "scan_0.fit.json").write_text(json.dumps({**good, **damage}))
        assert run(*command).code == 0
        assert record_of(tmp_path)["b"] == good["b"]


def test_a_folder_of_scans_is_read_in_order_of_names(run: Run, world: World, tmp_path: Path) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for name in ("b.ply", "a.ply"):
        (scans / name).write_bytes(world.scan.read_bytes())
    (scans / "notes.txt").write_text("not a scan")
    (scans / ".hidden.ply").write_text("not a scan either")
    assert run("fit", world.model, scans, "-o", tmp_path / "o", "--set", "max_iterations=2").code == 0
    assert [row["scan"] for row in rows_of(tmp_path / "o")] == ["a", "b"]


def test_results_among_the_scans_are_not_taken_for_scans(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(world.scan.read_bytes())
    for _ in range(2):
        outcome = run("fit", world.model, tmp_path, "-o", tmp_path, "--set", "max_iterations=2", "--json")
        assert outcome.facts["scans"] == 1
    (tmp_path / "a.ply").unlink()
    outcome = run("fit", world.model, tmp_path, "-o", tmp_path)
    assert outcome.code == 2 and "results" in outcome.sentence()


def test_scans_of_one_name_keep_results_apart(run: Run, world: World, tmp_path: Path) -> None:
    paths: list[Path] = []
    for folder, source in zip(("one", "two"), world.scans, strict=False):
        (tmp_path / folder).mkdir()
        paths.append(tmp_path / folder / "face.ply")
        paths[-1].write_bytes(source.read_bytes())
    assert run("fit", world.model, *paths, "-o", tmp_path / "o", "--set", "max_iterations=3").code == 0
    records = [record_of(tmp_path / "o", name) for name in ("one_face", "two_face")]
    assert records[0]["scan"]["hash"] == sha256_of_file(paths[0])
    assert records[1]["scan"]["hash"] == sha256_of_file(paths[1])
    assert records[0]["b"] != records[1]["b"]


def test_strict_turns_a_doubtful_fit_into_exit_code_1(run: Run, world: World, tmp_path: Path) -> None:
    sphere = read_mesh(world.scan)
    flat = sphere.vertices * [1.0, 0.1, 0.3]
    write_mesh(tmp_path / "flat.ply", sphere.with_vertices(flat))
    lenient = run("fit", world.model, tmp_path / "flat.ply", "-o", tmp_path / "o")
    assert record_of(tmp_path / "o", "flat")["status"] == "doubtful"
    assert lenient.code == 0 and "flat.ply: doubtful: " in lenient.err
    assert run("fit", world.model, tmp_path / "flat.ply", "-o", tmp_path / "o", "--strict").code == 1


def test_a_cap_on_iterations_is_a_status_of_its_own(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("fit", world.model, world.scan, "-o", tmp_path, "--set", "max_iterations=1", "--json")
    assert outcome.code == 0 and outcome.facts["max_iterations"] == 1
    assert "max_iterations" in outcome.err


def test_the_surface_search_and_a_held_scale_are_in_the_record(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run(
        "fit",
        world.model,
        world.scan,
        "-o",
        tmp_path,
        "--method",
        "paper",
        "--set",
        "search=surface",
        "--scale",
        "fixed",
    )
    assert outcome.code == 0, outcome.err
    record = record_of(tmp_path)
    assert record["config"]["paper"]["search"] == "surface" and record["config"]["scale_in_effect"] == "fixed"
    assert record["T_scan_model"]["scale"] == pytest.approx(1.0)


def test_an_unknown_method_lists_the_known_ones(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("fit", world.model, world.scan, "-o", tmp_path, "--method", "magic")
    assert outcome.code == 2
    assert "'magic'" in outcome.sentence() and "paper" in outcome.err


def test_quiet_never_shows_a_bar(run: Run, world: World, tmp_path: Path) -> None:
    outcome: Outcome = run("fit", world.model, *world.scans, "-o", tmp_path, "--quiet", "--set", "max_iterations=1")
    assert "%|" not in outcome.err and "\r" not in outcome.err


def test_models_of_simulated_faces_carry_their_licence_and_provenance(run, tmp_path):
    assert run("data", "faces", "-o", tmp_path / "faces", "--subjects", 3, "--seed", 3).code == 0
    outcome = run("build", tmp_path / "faces", "-o", tmp_path / "model.h5", "--json")
    assert outcome.facts["licence"] == "CC0-1.0"
    assert "3 simulated people" in outcome.facts["provenance"]
    own = run("build", tmp_path / "faces", "-o", tmp_path / "own.h5", "--licence", "mine", "--json")
    assert own.facts["licence"] == "mine"


def test_a_landmark_file_beside_the_meshes_that_is_something_else_is_said_and_left(run, tmp_path):
    assert run("data", "faces", "-o", tmp_path / "faces", "--subjects", 3).code == 0
    (tmp_path / "faces" / "landmarks.csv").write_text("breakfast,lunch\neggs,soup\n")
    outcome = run("build", tmp_path / "faces", "-o", tmp_path / "model.h5")
    assert outcome.code == 0
    assert "cannot be used" in outcome.err


def test_meshes_of_several_folders_do_not_take_the_licence_of_the_first(run, tmp_path):
    for folder, seed in (("simulated", 3), ("own", 4)):
        assert run("data", "faces", "-o", tmp_path / folder, "--subjects", 1, "--seed", seed).code == 0
    (tmp_path / "own" / "about.json").unlink()
    outcome = run("build", tmp_path / "simulated", tmp_path / "own", "-o", tmp_path / "m.h5", "--json")
    assert outcome.code == 0, outcome.err
    assert outcome.facts["licence"] == "" and "simulated people" not in outcome.facts["provenance"]
    assert "--licence" in outcome.err
