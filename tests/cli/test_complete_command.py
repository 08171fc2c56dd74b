"""`complete` writes completed surfaces with samples, intervals and a report, and refuses in one sentence."""

from pathlib import Path

import numpy as np
import pytest

from conftest import Run, World
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import raw_scan, similarity, sphere


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scans without a fifth of a blob, and a needle."""
    folder = tmp_path_factory.mktemp("broken")
    for k, z in enumerate(np.random.default_rng(2).standard_normal((2, 5))):
        write_mesh(folder / f"blob{k}.ply", raw_scan(z, similarity(k, 20.0, 1.0), noise_mm=0.1, keep=-0.6, seed=k).scan)
    d, faces = sphere(300)
    write_mesh(folder / "needle.ply", Mesh(d * (4, 4, 200), faces))
    return folder


def test_surfaces_samples_intervals_and_a_report(run: Run, world: World, broken: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    answer = run("complete", world.model, broken, "-o", out, "--unit", "mm", "--samples", "20", "--stl", "--json")
    assert answer.code == 1 and "needle" in answer.err
    model = ShapeModel.load(world.model)
    for name in ("blob0", "blob1"):
        mesh = read_mesh(out / f"{name}.ply")
        with np.load(out / f"{name}.samples.npz") as arrays:
            assert arrays["vertices"].shape == (20, model.n_vertices, 3) and arrays["vertices"].dtype == np.float32
            assert mesh.observed is not None and np.array_equal(mesh.observed, arrays["knowledge"] == 0)
        assert 0.5 < mesh.observed.mean() < 0.95
        assert len(read_mesh(out / f"{name}.stl").faces) == 4 * len(model.faces)
    assert not (out / "needle.ply").exists()
    assert answer.facts["question"] == "complete" and "1 scan has no completion." in answer.facts["notes"]
    rows = (out / "estimates.csv").read_text().splitlines()
    assert rows[0] == "scan,quantity,unit,value,mean,stddev,low_95,high_95,calibrated_on"
    assert any(row.startswith("blob1,volume,mm3,") for row in rows)
    assert "Albrecht" in (out / "methods.txt").read_text()
    assert (out / "report.html").stat().st_size > 10_000


def test_what_cannot_be_completed_has_one_sentence(run: Run, world: World, broken: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert run("complete", world.model, broken / "needle.ply", "-o", out).code == 2
    for more, words in (
        (("--part", "tail"), "no region 'tail'"),
        (("--samples", "1"), "at least two samples"),
        (("--mirror", "combined"), "omit --mirror"),
    ):
        answer = run("complete", world.model, broken / "blob0.ply", "-o", out, *more)
        assert answer.code == 2 and words in answer.sentence()
    answer = run("complete", world.model, broken / "blob0.ply", "-o", broken)
    assert answer.code == 2 and "would be overwritten" in answer.sentence()
    assert run("complete", tmp_path / "no.h5", broken, "-o", out).code == 2
