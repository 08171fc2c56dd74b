"""Bad input ends in one clear sentence that names the file, and nothing half-written is left behind."""

import csv
import errno
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Outcome, Run, World, leftovers
from shapespace.batch.fit_work import FitTask, FitWork
from shapespace.commands import fit
from shapespace.errors import FileError, FileFormatError
from shapespace.io.meshes.mesh_io import probe_mesh, read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh

HEADER = b"ply\nformat ascii 1.0\nelement vertex %d\nproperty float x\nproperty float y\nproperty float z\n"


def ascii_ply(points: list[list[float]], faces: list[list[int]]) -> bytes:
    lines = [
        HEADER % len(points),
        b"element face %d\nproperty list uchar int vertex_indices\nend_header\n" % len(faces),
    ]
    lines += [" ".join(map(str, point)).encode() + b"\n" for point in points]
    lines += [b"3 " + " ".join(map(str, face)).encode() + b"\n" for face in faces]
    return b"".join(lines)


def _grid(height: Callable[[float, float], list[float]]) -> bytes:
    points = [height(x, y) for x in range(9) for y in range(9)]
    faces = [
        f for i in range(8) for j in range(8) for a in [9 * i + j] for f in ([a, a + 9, a + 1], [a + 1, a + 9, a + 10])
    ]
    return ascii_ply(points, faces)


def _with_bad_vertex(mesh: Mesh, value: float) -> Mesh:
    vertices = mesh.vertices.copy()
    vertices[5, 1] = value
    return mesh.with_vertices(vertices)


def _binary(mesh: Mesh) -> bytes:
    faces = np.zeros(len(mesh.faces), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, mesh.faces
    head = HEADER.replace(b"ascii", b"binary_little_endian") % len(mesh.vertices)
    head += b"element face %d\nproperty list uchar int vertex_indices\nend_header\n" % len(faces)
    return head + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


BAD: dict[str, Callable[[Mesh], bytes | None]] = {
    "missing": lambda mesh: None,
    "empty": lambda mesh: b"",
    "only white space": lambda mesh: b" \n\n",
    "text": lambda mesh: b"Dear reader, this is not a mesh.\n",
    "cut short": lambda mesh: _binary(mesh)[:-4000],
    "cut in the header": lambda mesh: _binary(mesh)[:70],
    "no vertices": lambda mesh: ascii_ply([], []),
    "faces past the end": lambda mesh: ascii_ply([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2], [1, 2, 4]]),
    "negative face": lambda mesh: ascii_ply([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2], [1, 2, -1]]),
    "one triangle": lambda mesh: ascii_ply([[0, 0, 0], [90, 0, 0], [0, 90, 9]], [[0, 1, 2]]),
    "one point": lambda mesh: ascii_ply([[1, 2, 3]], []),
    "all points equal": lambda mesh: ascii_ply([[7.1, 2, 3]] * 50, [[0, 1, 2]]),
    "on a line": lambda mesh: _grid(lambda x, y: [x + y, 2.0 * (x + y), 0.3 * (x + y)]),
    "on a plane": lambda mesh: _grid(lambda x, y: [10.0 * x, 10.0 * y, 3.0 * x + 4.0 * y]),
    "on a plane, without faces": lambda mesh: ascii_ply([[x, y, 5] for x in range(30) for y in range(30)], []),
    "absurd coordinates": lambda mesh: ascii_ply(
        [[1e300, 0, 0], [0, 1e300, 0], [0, 0, 1e300], [1, 1, 1]], [[0, 1, 2], [1, 2, 3]]
    ),
    "absurd header": lambda mesh: HEADER % 10**15 + b"end_header\n0 0 0\n",
    "nothing but bytes": lambda mesh: bytes(range(256)) * 9,
}  # fmt: skip
"""What no fit can be made of, by what is wrong with it."""


def write_bad(kind: str, mesh: Mesh, path: Path) -> Path:
    content = BAD[kind](mesh)
    if content is not None:
        path.write_bytes(content)
    return path


def refused(outcome: Outcome, path: Path) -> str:
    """Check that `outcome` is exit code 2 with one sentence that names `path` and gives advice."""
    assert outcome.code == 2
    sentence = outcome.sentence()
    assert str(path) in sentence, sentence
    assert len(sentence.removeprefix("shapespace: ").replace(str(path), "")) > 20, sentence
    assert any(mark in sentence for mark in (";", ", so ")), f"no advice: {sentence}"
    return sentence


@pytest.mark.parametrize("kind", BAD)
def test_a_scan_that_cannot_be_used_is_refused_by_name(
    kind: str, run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    bad = write_bad(kind, scan_mesh, tmp_path / "bad.ply")
    out = tmp_path / "out"
    outcome = run("fit", world.model, bad, "-o", out)
    refused(outcome, bad)
    assert outcome.out == ""
    assert {path.name for path in out.iterdir()} == {"coefficients.csv", "bad.fit.json"}
    record = json.loads((out / "bad.fit.json").read_text())
    assert record["status"] == "failed" and f"shapespace: {record['reason']}\n" == outcome.err


@pytest.mark.parametrize("kind", BAD)
def test_check_says_what_is_wrong_without_failing_itself(kind: str, run: Run, scan_mesh: Mesh, tmp_path: Path) -> None:
    bad = write_bad(kind, scan_mesh, tmp_path / "bad.ply")
    outcome = run("check", bad, "--json")
    assert outcome.code == 2
    (report,) = outcome.facts
    assert report["usable"] is False
    if "error" in report:
        assert str(bad) in outcome.sentence()
    else:
        assert any(finding["level"] == "refused" for finding in report["findings"])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("ending", [".ply", ".obj"])
def test_vertices_that_are_not_finite_are_removed_and_named_or_refused(
    value: float, ending: str, run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    bad = tmp_path / f"bad{ending}"
    write_mesh(bad, _with_bad_vertex(scan_mesh, value))
    refused(run("fit", world.model, bad, "-o", tmp_path / "strict", "--strict"), bad)
    outcome = run("fit", world.model, bad, "-o", tmp_path / "out", "--set", "max_iterations=3")
    assert outcome.code == 0 and "1 vertex with coordinates that are NaN or infinite, used by" in outcome.out
    assert np.isfinite(read_mesh(tmp_path / "out" / "bad.fitted.ply").vertices).all()
    (facts,) = run("check", bad, "--json").facts
    assert facts["non_finite_vertices"] == 1 and facts["usable"]
    assert not run("check", bad, "--json", "--strict").facts[0]["usable"]


def test_all_bad_scans_in_one_batch_are_rows_and_the_good_ones_go_on(
    run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    scans = [write_bad(kind, scan_mesh, tmp_path / f"{kind.replace(' ', '_')}.ply") for kind in BAD]
    scans.insert(3, world.scan)
    outcome = run("fit", world.model, *scans, "-o", tmp_path / "out", "--json")
    assert outcome.code == 1
    assert outcome.facts["failed"] == len(BAD) and outcome.facts["converged"] == 1
    lines = outcome.err.splitlines()
    assert len(lines) == len(BAD)
    with (tmp_path / "out" / "coefficients.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["scan"] for row in rows] == [scan.stem for scan in scans]
    assert [row["status"] for row in rows] == ["converged" if s == world.scan else "failed" for s in scans]
    assert all(row["reason"] for row in rows)
    assert all((row["b1"] == "") == (row["status"] == "failed") for row in rows)
    assert [p.name for p in (tmp_path / "out").glob("*.ply")] == ["scan_0.fitted.ply"]
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("whole", [True, False], ids=["read whole", "by head and size"])
def test_scans_that_cannot_be_read_are_reported_before_the_first_fit(
    whole: bool, run: Run, world: World, scan_mesh: Mesh, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not whole:
        monkeypatch.setattr(fit, "FULL_CHECK_BYTES", 0)
    cut = tmp_path / "z_cut.ply"
    cut.write_bytes(world.scan.read_bytes()[:-500])
    empty = tmp_path / "y_empty.obj"
    empty.write_bytes(b"")
    order: list[str] = []

    do = FitWork.do

    def noted(work: FitWork, task: FitTask) -> dict[str, Any]:
        order.append(task.job.name)
        return do(work, task)

    monkeypatch.setattr(FitWork, "do", noted)
    outcome = run(
        "fit",
        world.model,
        *world.scans[:2],
        empty,
        cut,
        "-o",
        tmp_path / "out",
        "--set",
        "max_iterations=2",
        "--jobs",
        1,
    )
    assert outcome.code == 1
    assert order == ["y_empty", "z_cut", "scan_0", "scan_1"]
    assert [str(path) in line for path, line in zip((empty, cut), outcome.err.splitlines(), strict=False)] == [True] * 2
    with (tmp_path / "out" / "coefficients.csv").open(newline="") as stream:
        rows = {row["scan"]: row["status"] for row in csv.DictReader(stream)}
    assert list(rows) == ["scan_0", "scan_1", "y_empty", "z_cut"]
    assert [rows[name] for name in ("y_empty", "z_cut")] == ["failed", "failed"]


def test_several_scans_with_vertices_that_are_not_finite_are_named_at_the_end(
    run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.ply"
    write_mesh(bad, _with_bad_vertex(scan_mesh, np.nan))
    outcome = run("fit", world.model, world.scan, bad, "-o", tmp_path / "out", "--set", "max_iterations=2", "--jobs", 1)
    assert "1 scan has vertices with coordinates that are NaN or infinite" in outcome.err.splitlines()[-1]
    assert "(bad)" in outcome.err and outcome.code == 0
    outcome = run(
        "fit",
        world.model,
        world.scan,
        bad,
        "-o",
        tmp_path / "out",
        "--set",
        "max_iterations=2",
        "--jobs",
        1,
        "--strict",
    )
    assert outcome.code == 1 and "--strict" in outcome.err and str(bad) in outcome.err


@pytest.mark.parametrize("ending", [".ply", ".stl", ".obj"])
def test_a_probe_passes_whole_files_and_refuses_cut_ones(ending: str, scan_mesh: Mesh, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    write_mesh(path, scan_mesh)
    content = path.read_bytes()
    probe_mesh(path)
    path.write_bytes(content[: len(content) // 2] if ending != ".obj" else b" \n")
    with pytest.raises(FileFormatError, match=r"cut short|it is empty"):
        probe_mesh(path)
    with pytest.raises(FileFormatError, match="not a mesh format"):
        probe_mesh(tmp_path / "a.xcf")
    with pytest.raises(FileError, match="no such file"):
        probe_mesh(tmp_path / f"none{ending}")


def test_the_surface_search_refuses_a_point_cloud(run: Run, world: World, scan_mesh: Mesh, tmp_path: Path) -> None:
    cloud = tmp_path / "cloud.ply"
    write_mesh(cloud, Mesh(scan_mesh.vertices))
    outcome = run("fit", world.model, cloud, "-o", tmp_path / "out", "--method", "paper", "--set", "search=surface")
    assert str(cloud) in outcome.sentence() and outcome.code == 2
    assert "triangles" in outcome.err
    assert run("fit", world.model, cloud, "-o", tmp_path / "out").code == 0


def fit_record(run: Run, world: World, mesh: Mesh, folder: Path) -> dict[str, Any]:
    folder.mkdir(exist_ok=True)
    write_mesh(folder / "scan.ply", mesh)
    outcome = run("fit", world.model, folder / "scan.ply", "-o", folder)
    assert outcome.code == 0, outcome.err
    return json.loads((folder / "scan.fit.json").read_text())


def test_duplicate_vertices_are_merged_and_said(run: Run, world: World, scan_mesh: Mesh, tmp_path: Path) -> None:
    soup = Mesh(scan_mesh.vertices[scan_mesh.faces].reshape(-1, 3), np.arange(3 * len(scan_mesh.faces)).reshape(-1, 3))
    plain, doubled = (fit_record(run, world, m, tmp_path / n) for m, n in ((scan_mesh, "a"), (soup, "b")))
    assert not any("merged" in note for note in plain["notes"])
    assert any("merged" in note for note in doubled["notes"])
    np.testing.assert_allclose(doubled["b"], plain["b"], atol=1e-3)


def test_reversed_winding_is_turned_and_said(run: Run, world: World, scan_mesh: Mesh, tmp_path: Path) -> None:
    inside_out = Mesh(scan_mesh.vertices, scan_mesh.faces[:, ::-1])
    record = fit_record(run, world, inside_out, tmp_path)
    assert any("reversed" in note for note in record["notes"])
    partly = scan_mesh.faces.copy()
    partly[:40] = partly[:40, ::-1]
    record = fit_record(run, world, Mesh(scan_mesh.vertices, partly), tmp_path)
    assert any("40 triangles have a winding opposite" in note for note in record["notes"])


def test_non_manifold_edges_and_several_pieces_are_kept_and_said(
    run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    a, b, _ = scan_mesh.faces[0]
    fin = 1.02 * scan_mesh.vertices[[a]]
    island = scan_mesh.vertices[scan_mesh.faces[50]] * 1.05
    n = len(scan_mesh.vertices)
    mesh = Mesh(
        np.concatenate([scan_mesh.vertices, fin, island]),
        np.concatenate([scan_mesh.faces, [[a, b, n], [n + 1, n + 2, n + 3]]]),
    )
    record = fit_record(run, world, mesh, tmp_path)
    assert any("more than two triangles" in note for note in record["notes"])
    assert any("2 separate pieces" in note for note in record["notes"])


def test_a_scan_far_from_the_origin_gives_the_same_coefficients(
    run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    far = scan_mesh.with_vertices(scan_mesh.vertices + np.array([1e6, -1e6, 1e6]))
    near_record, far_record = (fit_record(run, world, m, tmp_path / n) for m, n in ((scan_mesh, "near"), (far, "far")))
    np.testing.assert_allclose(far_record["b"], near_record["b"], rtol=1e-6, atol=1e-6)
    assert any("from the origin" in note for note in far_record["notes"])
    shift = (
        read_mesh(tmp_path / "far" / "scan.fitted.ply").vertices
        - read_mesh(tmp_path / "near" / "scan.fitted.ply").vertices
    )
    np.testing.assert_allclose(shift, np.broadcast_to([1e6, -1e6, 1e6], shift.shape), atol=1e-6)


def build(run: Run, meshes: list[Path], output: Path, *options: object) -> Outcome:
    outcome = run("build", *meshes, "-o", output, *options)
    if outcome.code:
        assert not output.exists() and leftovers(output.parent) == [] and outcome.out == ""
    return outcome


@pytest.mark.parametrize("kind", [k for k in BAD if k not in (
    "one triangle", "one point", "all points equal", "on a line", "on a plane", "on a plane, without faces",
    "absurd coordinates", "no vertices",
)])  # fmt: skip
def test_a_training_mesh_that_cannot_be_read_is_refused_by_name(
    kind: str, run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    good = sorted(world.meshes.glob("*.ply"))[:3]
    bad = write_bad(kind, scan_mesh, tmp_path / "bad.ply")
    refused(build(run, [*good, bad], tmp_path / "m.h5", "--quiet"), bad)


@pytest.mark.parametrize(
    "kind", ["one point", "all points equal", "on a line", "on a plane", "absurd coordinates", "no vertices"]
)
def test_training_meshes_without_shape_end_in_one_sentence_or_a_sound_model(
    kind: str, run: Run, scan_mesh: Mesh, tmp_path: Path
) -> None:
    content = BAD[kind](scan_mesh)
    assert content is not None
    for k in range(3):
        (tmp_path / f"{k}.ply").write_bytes(content)
    outcome = build(run, sorted(tmp_path.glob("*.ply")), tmp_path / "m.h5")
    assert outcome.code == 2
    outcome.err.splitlines()[-1].startswith("shapespace: ")
    assert sum(line.startswith("shapespace: ") for line in outcome.err.splitlines()) == 1


@pytest.mark.parametrize("value", [-np.inf, np.inf])
def test_a_training_mesh_that_is_not_finite_is_named(value: float, run: Run, world: World, tmp_path: Path) -> None:
    good = sorted(world.meshes.glob("*.ply"))[:3]
    write_mesh(tmp_path / "bad.ply", _with_bad_vertex(read_mesh(good[0]), value))
    outcome = build(run, [tmp_path / "bad.ply", *good[1:]], tmp_path / "m.h5", "--modes", 1)
    assert outcome.code == 2 and "bad.ply" in outcome.sentence()


def test_training_meshes_with_other_vertices_or_triangles_are_named(
    run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    good = sorted(world.meshes.glob("*.ply"))[:3]
    first = read_mesh(good[0])
    other = first.faces.copy()
    other[7] = [0, 1, 300]
    for name, mesh in {
        "fewer.ply": scan_mesh,
        "other_triangles.ply": Mesh(first.vertices, other),
        "points.ply": Mesh(first.vertices),
    }.items():
        write_mesh(tmp_path / name, mesh)
        outcome = build(run, [*good, tmp_path / name], tmp_path / "m.h5", "--modes", 1)
        assert outcome.code == 2
        assert name in outcome.err and "correspondence" in outcome.err


def test_one_mesh_is_too_few_and_two_make_one_mode(run: Run, world: World, tmp_path: Path) -> None:
    meshes = sorted(world.meshes.glob("*.ply"))
    alone = build(run, meshes[:1], tmp_path / "m.h5", "--modes", "all")
    assert alone.code == 2 and "at least two" in alone.err
    pair = build(run, meshes[:2], tmp_path / "m.h5", "--json", "--modes", "auto")
    assert pair.code == 0 and pair.facts["modes"] == 1
    assert "cannot be cross-validated, so all modes are kept" in pair.err


def test_a_model_has_at_most_the_modes_that_the_meshes_determine(run: Run, world: World, tmp_path: Path) -> None:
    meshes = sorted(world.meshes.glob("*.ply"))
    for modes in (12, 10**9):
        outcome = build(run, meshes, tmp_path / "m.h5", "--modes", modes)
        assert outcome.code == 0 and "11 modes of" in outcome.out
        assert f"determine 11 modes, so the model has 11 and not the requested {modes}." in outcome.err


def test_equal_training_meshes_are_refused(run: Run, world: World, tmp_path: Path) -> None:
    first = sorted(world.meshes.glob("*.ply"))[0]
    for options in ([], ["--modes", "all"], ["--no-align"], ["--gauge", "form"]):
        outcome = build(run, [first] * 5, tmp_path / "m.h5", *options)
        assert outcome.code == 2 and "all equal" in outcome.err


def test_a_model_name_that_is_not_hdf5_is_refused_before_any_work(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("build", world.meshes, "-o", tmp_path / "model.ply")
    assert outcome.code == 2 and str(tmp_path / "model.ply") in outcome.sentence()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("content", ["name,vertex\nnose,400\n", "name,vertex\nnose,minus one\n", "", "nose\n", "{"])
def test_landmarks_that_the_meshes_do_not_have_are_refused(
    content: str, run: Run, world: World, tmp_path: Path
) -> None:
    (tmp_path / "marks.csv").write_text(content)
    outcome = run("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", 2, "--landmarks", tmp_path / "marks.csv")
    assert outcome.code == 2
    assert not (tmp_path / "m.h5").exists()
    assert "nose" in outcome.sentence() or "marks.csv" in outcome.err


def test_a_mesh_of_other_vertices_cannot_be_projected(world: World, scan_mesh: Mesh) -> None:
    with pytest.raises(Exception, match="1000 vertices but the model has 400") as caught:
        ShapeModel.load(world.model).project(scan_mesh)
    assert type(caught.value).__name__ == "CorrespondenceError"


@pytest.mark.parametrize("command", ["info", "fit"])
@pytest.mark.parametrize("damage", ["cut", "byte", "empty", "text", "missing", "folder", "mesh"])
def test_a_damaged_model_is_refused_by_name(damage: str, command: str, run: Run, world: World, tmp_path: Path) -> None:
    model = tmp_path / "bad.h5"
    content = world.model.read_bytes()
    changed = bytearray(content)
    changed[len(content) // 2] ^= 1
    contents = {"cut": content[:-100], "byte": bytes(changed), "empty": b"", "text": b"no model",
                "mesh": world.scan.read_bytes()}  # fmt: skip
    if damage == "folder":
        model.mkdir()
    elif damage != "missing":
        model.write_bytes(contents[damage])
    arguments = ["info", model] if command == "info" else ["fit", model, world.scan, "-o", tmp_path / "out"]
    outcome = run(*arguments)
    refused(outcome, model)
    assert not (tmp_path / "out").exists()


def test_scan_and_model_in_each_other_place_are_told_apart(run: Run, world: World, tmp_path: Path) -> None:
    refused(run("fit", world.scan, world.scan, "-o", tmp_path / "out"), world.scan)
    refused(run("fit", world.model, world.model, "-o", tmp_path / "out"), world.model)
    refused(run("check", world.model), world.model)


@pytest.mark.parametrize("content", ["", "{", "[]", "3", "null", '{"format": "other"}', "\udcff", "[" * 100_000, "NaN"])
def test_what_is_not_the_record_of_a_fit_is_refused_by_name(content: str, run: Run, tmp_path: Path) -> None:
    path = tmp_path / "x.fit.json"
    path.write_bytes(content.encode("utf-8", "surrogateescape"))
    refused(run("info", path), path)


def places(tmp_path: Path) -> list[Path]:
    (tmp_path / "file").write_text("in the way")
    return [tmp_path / "file", tmp_path / "file" / "below", tmp_path / ("x" * 300), Path("/proc/no/such")]


def test_a_folder_that_cannot_be_written_ends_every_writing_command(run: Run, world: World, tmp_path: Path) -> None:
    for place in places(tmp_path):
        if place.parts[1] == "proc" and not Path("/proc").is_dir():
            continue
        for arguments in (
            ["fit", world.model, world.scan, "-o", place],
            ["data", "faces", "-o", place, "--subjects", 1],
            ["build", world.meshes, "-o", place / "m.h5", "--modes", 2],
        ):
            outcome = run(*arguments)
            assert outcome.code == 2, arguments
            lines = [line for line in outcome.err.splitlines() if line.startswith("shapespace: ")]
            assert len(lines) == 1 and lines[0].startswith(f"shapespace: Cannot write {place}"), lines
    assert (tmp_path / "file").read_text() == "in the way"


def test_a_model_cannot_replace_a_folder(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "m.h5").mkdir()
    outcome = run("build", world.meshes, "-o", tmp_path / "m.h5", "--modes", 2)
    assert outcome.code == 2 and f"Cannot write {tmp_path / 'm.h5'}: it is a folder" in outcome.err
    assert leftovers(tmp_path) == []


class FullDisk:
    """`Path.write_bytes` that meets a full disk from the n-th file of some name on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, names: str, after: int = 0) -> None:
        real, self.seen = Path.write_bytes, 0

        def write(path: Path, data: bytes) -> int:
            if names in path.name:
                self.seen += 1
                if self.seen > after:
                    real(path, data[: len(data) // 2])
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            return real(path, data)

        monkeypatch.setattr(Path, "write_bytes", write)


@pytest.mark.parametrize("names", ["scan_1.fitted", "scan_1.fit", "coefficients"])
def test_a_disk_that_fills_up_in_a_batch_keeps_what_was_written(
    names: str, run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    FullDisk(monkeypatch, names)
    outcome = run("fit", world.model, *world.scans, "-o", tmp_path, "--set", "max_iterations=3", "--jobs", 1)
    assert outcome.code == 2
    errors = [line for line in outcome.err.splitlines() if "max_iterations" not in line]
    assert len(errors) == 1
    assert names.split(".")[0] in errors[0]
    assert errors[0].endswith("the disk is full; free some space and run again.")
    assert leftovers(tmp_path) == []
    assert json.loads((tmp_path / "scan_0.fit.json").read_text())["status"] == "max_iterations"
    assert len(read_mesh(tmp_path / "scan_0.fitted.ply").vertices) == 400
    if names != "coefficients":
        with (tmp_path / "coefficients.csv").open(newline="") as stream:
            assert [row["scan"] for row in csv.DictReader(stream)] == ["scan_0"]
        assert not (tmp_path / "scan_1.fit.json").exists()
    # With space again, the same command does the rest.
    monkeypatch.undo()
    outcome = run("fit", world.model, *world.scans, "-o", tmp_path, "--set", "max_iterations=3", "--json")
    assert outcome.code == 0 and outcome.facts["max_iterations"] == 3


def test_a_full_disk_leaves_the_old_model(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tmp_path / "m.h5"
    model.write_bytes(world.model.read_bytes())
    FullDisk(monkeypatch, ".h5")
    outcome = run("build", world.meshes, "-o", model, "--modes", 2)
    assert outcome.code == 2 and f"Cannot write {model}: the disk is full" in outcome.err
    assert model.read_bytes() == world.model.read_bytes() and leftovers(tmp_path) == []


def test_a_failed_fit_takes_the_surface_of_an_earlier_one_away(run: Run, world: World, tmp_path: Path) -> None:
    scan = tmp_path / "scan.ply"
    scan.write_bytes(world.scan.read_bytes())
    run("fit", world.model, scan, "-o", tmp_path / "o", "--stages")
    assert (tmp_path / "o" / "scan.fitted.ply").is_file() and (tmp_path / "o" / "scan.stages.npz").is_file()
    scan.write_text("no longer a mesh")
    assert run("fit", world.model, scan, "-o", tmp_path / "o").code == 2
    assert {path.name for path in (tmp_path / "o").iterdir()} == {"coefficients.csv", "scan.fit.json"}


@pytest.mark.parametrize(
    "content", [None, "", "name,x,y,z\n", "name,x,y,z\ntip,1,2,nan\n", "name,x,y,z\nother,1,2,3\n"]
)
def test_landmarks_that_cannot_start_a_fit_are_refused(
    content: str | None, run: Run, world: World, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / "marks.csv").write_text(content)
    outcome = run("fit", world.model, world.scan, "-o", tmp_path / "o", "--landmarks", tmp_path / "marks.csv")
    assert outcome.code == 2
    assert str(world.scan) in outcome.sentence()
    assert "marks.csv" in outcome.err or "landmarks share a name" in outcome.err


def test_landmarks_for_several_scans_are_refused(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "marks.csv").write_text("name,x,y,z\ntip,1,2,3\n")
    outcome = run("fit", world.model, *world.scans, "-o", tmp_path / "o", "--landmarks", tmp_path / "marks.csv")
    assert outcome.code == 2 and "--landmarks belongs to one scan" in outcome.sentence()


def test_a_folder_without_meshes_is_named(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for arguments in (["check"], ["fit", world.model, "-o", tmp_path / "o"], ["build", "-o", tmp_path / "m.h5"]):
        outcome = run(*arguments, tmp_path / "empty")
        assert outcome.code == 2 and str(tmp_path / "empty") in outcome.sentence()


def test_a_crafted_model_file_is_checked_as_a_whole(run: Run, world: World, tmp_path: Path) -> None:
    from shapespace.io.containers.hdf5 import read_hdf5, write_hdf5

    arrays, attributes = read_hdf5(world.model)
    for name, changed_arrays, changed_attributes in (
        ("landmark", {}, {"landmarks": '{"tip": 400}'}),
        ("json", {}, {"landmarks": "["}),
        ("list", {}, {"landmarks": "[1, 2]"}),
        ("version", {}, {"format_version": 99}),
        ("gauge", {}, {"gauge": "size"}),
        ("nan", {"mean": np.full_like(arrays["mean"], np.nan)}, {}),
        ("shape", {"stddev": arrays["stddev"][:-1]}, {}),
        ("zero", {"stddev": 0 * arrays["stddev"]}, {}),
        ("faces", {"faces": arrays["faces"] + 400}, {}),
        ("scalar", {"mean": np.array(1.0)}, {}),
        ("total", {}, {"total_variance": float("nan")}),
        ("none", {}, {"total_variance": 0.0}),
    ):
        path = tmp_path / f"{name}.h5"
        attributes.pop("content_hash", None)
        write_hdf5(path, {**arrays, **changed_arrays}, {**attributes, **changed_attributes})
        outcome = run("info", path, "--json")
        assert outcome.code == 2, name
        assert str(path) in outcome.err and len(outcome.err.splitlines()) == 1, name


def test_huge_headers_do_not_take_memory(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "huge.stl"
    path.write_bytes(b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 100)
    assert run("check", path).code == 2
