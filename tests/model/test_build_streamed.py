"""`shapespace build` of meshes that are streamed: the command, and what is left of it when its process is killed."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shapespace import cli
from shapespace.batch import progress
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model import streamed
from shapespace.model.missing import MIN_SEEN
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import similarity, training_meshes

COUNT, OLD = 40, 30
SLOW = """
import sys, time
from shapespace import cli
from shapespace.io.containers.row_spill import Spill
from shapespace.model import pca
pca.EXACT, pca._LEAST_BLOCK = 10, 5
for owner, name, wait in ((pca.Covariance, "__call__", 0.1), (Spill, "to_disk", 0.3)):
    def slow(*given, plain=getattr(owner, name), wait=wait):
        time.sleep(wait)
        return plain(*given)
    setattr(owner, name, slow)
sys.exit(cli.main(sys.argv[1:]))
"""
"""The command, slow enough to be killed between two passes, and taking so few shapes for too many for a Gram matrix."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Meshes in two folders, old and new."""
    folder = tmp_path_factory.mktemp("meshes")
    for i, mesh in enumerate(training_meshes(COUNT, 200)):
        into = folder / ("old" if i < OLD else "new")
        into.mkdir(exist_ok=True)
        write_mesh(into / f"m{i:02d}.ply", mesh.with_vertices(similarity(i).apply(mesh.vertices)))
    return folder


@pytest.fixture(autouse=True)
def without_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "FIRST_LOG_LINE_S", 3600.0)


def build(*arguments: object) -> int:
    return cli.main(["build", *map(str, arguments)])


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """Return the one sentence that a command ends in."""
    capsys.readouterr()
    assert build(*arguments) == 2
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1 and said[0].startswith("shapespace: ") and said[0].endswith(".")
    return said[0]


def near(a: Path, b: Path) -> bool:
    first, second = ShapeModel.load(a), ShapeModel.load(b)
    return bool(np.abs(first.basis - second.basis).max() < 1e-6 and np.abs(first.mean - second.mean).max() < 1e-5)


def test_the_streamed_command_makes_the_same_model_and_leaves_it_alone(folder: Path, tmp_path: Path) -> None:
    assert build(folder / "old", "-o", tmp_path / "plain.h5", "--modes", 4) == 0
    assert build(folder / "old", "-o", tmp_path / "streamed.h5", "--modes", 4, "--out-of-core") == 0
    assert near(tmp_path / "plain.h5", tmp_path / "streamed.h5")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plain.h5", "streamed.h5"]


def test_residuals_are_shown_of_streamed_models_alone(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, more in (("plain.h5", []), ("streamed.h5", ["--out-of-core"])):
        assert build(folder / "old", "-o", tmp_path / name, "--modes", 4, *more) == 0
    capsys.readouterr()
    assert cli.main(["info", str(tmp_path / "streamed.h5"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert len(facts["residuals_mm2"]) == 4 and 0 <= facts["largest_residual_share"] < 1e-6
    assert cli.main(["info", str(tmp_path / "plain.h5"), "--json"]) == 0
    assert "residual" not in capsys.readouterr().out


def test_meshes_that_do_not_fit_are_streamed_and_it_is_said(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(streamed, "available_bytes", lambda: 100_000)
    assert build(folder / "old", "-o", tmp_path / "m.h5", "--modes", 4) == 0
    assert "30 meshes would take 0.0 GB of memory" in capsys.readouterr().err
    assert ShapeModel.load(tmp_path / "m.h5").residuals is not None


def test_added_meshes_make_the_model_of_all(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new = tmp_path / "old.h5", tmp_path / "new.h5"
    assert build(folder / "old", "-o", old, "--modes", 4, "--keep-shapes", "--provenance", "thirty") == 0
    assert f"kept in {old}.shapes" in capsys.readouterr().err
    assert build("--add", old, folder / "new", "-o", new, "--modes", 4) == 0
    assert build(folder / "old", folder / "new", "-o", tmp_path / "all.h5", "--modes", 4) == 0
    assert near(new, tmp_path / "all.h5")
    model = ShapeModel.load(new)
    assert model.n_training == COUNT
    assert model.provenance == "thirty; 10 meshes, m30.ply to m39.ply"


def test_the_modes_of_one_mesh_and_a_model_are_chosen_by_all(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    old, one = tmp_path / "old.h5", folder / "new" / f"m{OLD}.ply"
    assert build(folder / "old", "-o", old, "--modes", 4, "--keep-shapes") == 0
    assert build("--add", old, one, "-o", tmp_path / "new.h5") == 0
    assert "cross-validated" not in capsys.readouterr().err
    assert build(folder / "old", one, "-o", tmp_path / "all.h5") == 0
    new, everyone = ShapeModel.load(tmp_path / "new.h5"), ShapeModel.load(tmp_path / "all.h5")
    assert new.n_training == OLD + 1 and new.n_modes == everyone.n_modes < OLD


def test_what_cannot_be_added_to_ends_in_a_sentence(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, kept, out = (tmp_path / f"{name}.h5" for name in ("plain", "kept", "out"))
    assert build(folder / "old", "-o", plain, "--modes", 4) == 0
    assert build(folder / "old", "-o", kept, "--modes", 4, "--keep-shapes") == 0
    assert "no shapes in" in refused(capsys, "--add", plain, folder / "new", "-o", out)
    assert "another name" in refused(capsys, "--add", kept, folder / "new", "-o", kept)
    assert "none.h5" in refused(capsys, "--add", tmp_path / "none.h5", folder / "new", "-o", out)
    for option in (["--gauge", "form"], ["--no-align"], ["--landmarks", "x.csv"]):
        assert "--add takes gauge" in refused(capsys, "--add", kept, folder / "new", "-o", out, *option)
    for option in (["--representation", "bspline"], ["--additive", "x.csv"]):
        for streams in (["--add", kept], ["--out-of-core"], ["--keep-shapes"]):
            assert "models of vertices" in refused(capsys, *streams, folder / "new", "-o", out, *option)
    assert "--min-seen" in refused(capsys, folder / "new", "-o", out, "--out-of-core", "--min-seen", MIN_SEEN)
    hole = tmp_path / "hole.ply"
    mesh = training_meshes(1, 200)[0]
    write_mesh(hole, mesh.with_vertices(np.where(np.arange(200)[:, None] == 3, np.nan, mesh.vertices)))
    assert "vertices are missing" in refused(capsys, "--add", kept, hole, "-o", out)
    write_mesh(hole, training_meshes(1, 150)[0])
    assert "150 vertices but the model has 200" in refused(capsys, "--add", kept, hole, "-o", out)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "hole.ply",
        "kept.h5",
        "kept.h5.shapes",
        "plain.h5",
    ]


def killed_when(command: list[str], there: Callable[[], bool]) -> None:
    """Run a command and kill its process when something is there."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    limit = time.monotonic() + 120
    while not there() and time.monotonic() < limit:
        assert process.poll() is None, "it was over before it could be killed"
        time.sleep(0.005)
    process.send_signal(signal.SIGKILL)
    assert process.wait(60) == -signal.SIGKILL


@pytest.mark.long
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_a_killed_build_started_again_goes_on_and_comes_to_the_same(folder: Path, tmp_path: Path) -> None:
    plan = ["build", str(folder / "old"), "--modes", "4", "--out-of-core", "--provenance", "killed"]
    command = [sys.executable, "-c", SLOW, *plan, "-o", str(tmp_path / "m.h5")]
    work = tmp_path / "m.h5.build"
    # While the meshes stand in the file as read; while it is neither; after the second pass.
    killed_when(command, lambda: (work / "shapes.f32").exists())
    killed_when(command, lambda: (work / "poses.npz").exists())
    assert not (work / "aligned").exists()
    killed_when(command, lambda: (work / "pass-002.npz").exists())
    kept = {path.name: path.stat().st_mtime_ns for path in work.glob("p*.npz")}
    assert {"poses.npz", "pass-001.npz", "pass-002.npz"} <= set(kept)
    killed_when(command, lambda: (work / "pass-003.npz").exists())
    assert {name: (work / name).stat().st_mtime_ns for name in kept} == kept
    assert subprocess.run(command, capture_output=True).returncode == 0
    assert [path.name for path in tmp_path.iterdir()] == ["m.h5"]
    undisturbed = [sys.executable, "-c", SLOW.replace("0.1", "0").replace("0.3", "0"), *plan]
    assert subprocess.run([*undisturbed, "-o", str(tmp_path / "u.h5")], capture_output=True).returncode == 0
    assert (tmp_path / "u.h5").read_bytes() == (tmp_path / "m.h5").read_bytes()
