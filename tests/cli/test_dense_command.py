"""`--dense` writes surfaces in correspondence that lie on the scans, and models are built from them."""

import json
from pathlib import Path

import numpy as np
import pytest

from conftest import Run, World
from shapespace.cli import main
from shapespace.geometry.closest import build_engine
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import blob, raw_scan, similarity, sphere

STRANGERS = 6


@pytest.fixture(scope="module")
def strangers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Raw scans of blobs that the model of four modes cannot make, each on its own triangles and in its own pose."""
    folder = tmp_path_factory.mktemp("strangers")
    for k, z in enumerate(np.random.default_rng(5).standard_normal((STRANGERS, 5))):
        T = similarity(k, degrees=10.0, scale=1.0)
        raw = raw_scan(z, T, vertices=1500 + 100 * k, noise_mm=0.1, seed=k)
        write_mesh(folder / f"raw_{k}.ply", raw.scan)
        write_mesh(folder / f"true_{k}.obj", Mesh(T.apply(blob(sphere(400)[0], z)), sphere(400)[1]))
    return folder


@pytest.fixture(scope="module")
def dense(world: World, strangers: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dense")
    scans = sorted(strangers.glob("raw_*.ply"))
    assert main(["fit", str(world.model), *map(str, scans), "-o", str(out), "--dense", "--stages", "--quiet"]) == 0
    return out


def test_raw_scans_become_a_training_set(run: Run, world: World, strangers: Path, dense: Path) -> None:
    surfaces = sorted(dense.glob("*.dense.ply"))
    assert len(surfaces) == STRANGERS
    model = ShapeModel.load(world.model)
    plain, better = [], []
    for k, path in enumerate(surfaces):
        mesh, truth = read_mesh(path), read_mesh(strangers / f"true_{k}.obj").vertices
        assert np.array_equal(mesh.faces, model.faces)
        plain.append(np.linalg.norm(read_mesh(dense / f"raw_{k}.fitted.ply").vertices - truth, axis=1).mean())
        better.append(np.linalg.norm(mesh.vertices - truth, axis=1).mean())
        scan = build_engine(read_mesh(strangers / f"raw_{k}.ply"))
        assert scan.query(mesh.vertices).distance.mean() < 0.25
    assert np.mean(better) < np.mean(plain)
    built = run("build", *surfaces, "-o", dense / "new.h5", "--modes", "all", "--with-doubtful")
    assert built.code == 0, built.err
    new = ShapeModel.load(dense / "new.h5")
    assert new.n_vertices == model.n_vertices and new.n_training == STRANGERS


def test_record_and_stages_hold_it(dense: Path) -> None:
    record = json.loads((dense / "raw_0.fit.json").read_text())
    assert list(record["distances_mm"]) == ["before", "initial", "final", "dense"]
    of = record["distances_mm"]
    assert of["dense"]["model_to_scan"]["mean"] < of["final"]["model_to_scan"]["mean"]
    assert record["config"]["dense"] is True and record["seconds"]["dense"] > 0
    with np.load(dense / "raw_0.stages.npz") as arrays:
        assert arrays["dense"].shape == arrays["final"].shape
        assert arrays["seen_dense"].dtype == np.bool_ and arrays["seen_dense"].mean() > 0.9
        T = record["T_scan_model"]
        # Geometry in this file has the axes of the model's frame and the size of the scan.
        in_scan = arrays["dense"] @ np.array(T["rotation"]).T + np.array(T["translation"])
        assert np.allclose(in_scan, read_mesh(dense / "raw_0.dense.ply").vertices, atol=1e-2)


def test_resume_knows_whether_it_was_asked_for(run: Run, world: World, tmp_path: Path) -> None:
    command = ("fit", world.model, world.scan, "-o", tmp_path, "--quiet")
    surface = tmp_path / "scan_0.dense.ply"
    assert run(*command).code == 0 and not surface.exists()
    asked = run(*command, "--dense")
    assert asked.code == 0 and surface.is_file() and "dense surface: median distance model" in asked.out
    written = surface.stat().st_mtime_ns
    assert run(*command, "--dense").code == 0 and surface.stat().st_mtime_ns == written
    surface.unlink()
    assert run(*command, "--dense").code == 0 and surface.is_file()
    assert run(*command).code == 0 and surface.is_file(), "what still holds is kept"
    assert run(*command, "--stages").code == 0 and surface.is_file() and (tmp_path / "scan_0.stages.npz").is_file()
    assert json.loads((tmp_path / "scan_0.fit.json").read_text())["config"]["dense"] is True
    anew = ("fit", world.model, world.scan, "-o", tmp_path, "--again", "--quiet")
    assert run(*anew).code == 0 and not surface.exists(), "it would contradict the record"


def test_a_scan_that_only_has_such_a_name_stays(run: Run, world: World, tmp_path: Path) -> None:
    mine = tmp_path / "scan_0.dense.ply"
    mine.write_bytes(world.scan.read_bytes())
    assert run("fit", world.model, world.scan, "-o", tmp_path, "--quiet").code == 0
    assert mine.read_bytes() == world.scan.read_bytes()


def test_dense_surfaces_of_an_earlier_run_are_no_scans(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "scan_0.ply").write_bytes(world.scan.read_bytes())
    for _ in range(2):
        assert run("fit", world.model, tmp_path, "-o", tmp_path, "--dense", "--quiet").code == 0
    assert [path.name for path in tmp_path.glob("*.fit.json")] == ["scan_0.fit.json"]


def test_the_papers_method_has_none(run: Run, world: World, tmp_path: Path) -> None:
    outcome = run("fit", world.model, world.scan, "-o", tmp_path, "--dense", "--method", "paper")
    assert outcome.code == 2
    assert "robust method" in outcome.err and "Traceback" not in outcome.err
