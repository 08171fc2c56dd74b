"""`build --region`, `fit --region` and `fit --crop`."""

import csv
import json
from pathlib import Path

import numpy as np

from conftest import VERTICES, Run, World
from shapespace.model.shape_model import ShapeModel

FAST = ("--set", "max_iterations=3", "--quiet")


def front(world: World) -> list[int]:
    return np.flatnonzero(ShapeModel.load(world.model).mean_vertices[:, 2] > 0).tolist()


def test_a_region_is_kept_by_name_and_fits_are_held_to_it_or_to_the_same_file(
    run: Run, world: World, tmp_path: Path
) -> None:
    vertices = front(world)
    (tmp_path / "front.csv").write_text("vertex\n" + "".join(f"{vertex}\n" for vertex in vertices))
    model = tmp_path / "m.h5"
    built = run("build", world.meshes, "-o", model, "--modes", 4, "--region", f"front={tmp_path / 'front.csv'}")
    assert built.code == 0
    assert run("info", model, "--json").facts["regions"] == {"front": len(vertices)}
    rows = []
    for k, region in enumerate(("front", tmp_path / "front.csv")):
        out = tmp_path / f"o{k}"
        command = ("fit", model, world.scan, "-o", out, "--region", region, *FAST)
        assert run(*command).code == 0
        record = json.loads((out / "scan_0.fit.json").read_text())
        assert record["distances_mm"]["final"]["model_to_scan"]["count"] == len(vertices)
        assert "which is reused" in run(*command).err
        with (out / "coefficients.csv").open(newline="") as stream:
            rows += [{key: cell for key, cell in row.items() if key[0] in "bz"} for row in csv.DictReader(stream)]
    assert rows[0] == rows[1]
    whole = run("fit", model, world.scan, "-o", tmp_path / "o0", *FAST)
    assert "fitted again" in whole.err, "another region is another fit"


def test_regions_follow_vertices_that_are_taken_out(run: Run, world: World, tmp_path: Path) -> None:
    from shapespace.io.meshes.mesh_io import read_mesh, write_mesh

    vertices = front(world)
    lost = vertices[:5]
    (tmp_path / "holed").mkdir()
    for file in sorted(world.meshes.glob("*.ply")):
        mesh = read_mesh(file)
        points = mesh.vertices.copy()
        points[lost] = np.nan
        write_mesh(tmp_path / "holed" / file.name, mesh.with_vertices(points))
    (tmp_path / "front.csv").write_text("".join(f"{vertex}\n" for vertex in vertices))
    model = tmp_path / "m.h5"
    region = f"front={tmp_path / 'front.csv'}"
    assert run("build", tmp_path / "holed", "-o", model, "--modes", 2, "--region", region).code == 0
    built = ShapeModel.load(model)
    assert built.n_vertices == VERTICES - 5 and len(built.regions["front"]) == len(vertices) - 5
    left = np.setdiff1d(np.arange(VERTICES), lost)
    np.testing.assert_array_equal(left[built.regions["front"]], vertices[5:])


def test_what_cannot_be_a_region_or_a_crop_is_one_sentence(run: Run, world: World, tmp_path: Path) -> None:
    fit = ("fit", world.model, world.scan, "-o", tmp_path / "o")
    outcome = run(*fit, "--region", "nose")
    assert outcome.code == 2 and "no region 'nose'" in outcome.err and "--region NAME=FILE" in outcome.err
    assert "There is no crop" in run(*fit, "--crop", "ball:1").sentence()
    assert run(*fit, "--crop", "sphere:9999,0,0,1").code == 2
    assert "omit dense" in run(*fit, "--region", "nose", "--dense").sentence()
    assert run("build", world.meshes, "-o", tmp_path / "m.h5", "--region", "front").code == 2
    assert run("build", world.meshes, "-o", tmp_path / "m.h5", "--region", "front=gone.csv").code == 2
    (tmp_path / "far.csv").write_text("99999\n")
    far = run("build", world.meshes, "-o", tmp_path / "m.h5", "--region", f"far={tmp_path / 'far.csv'}")
    assert "region 'far' needs vertices from 0 to 399" in far.err


def test_a_crop_is_told_in_the_record(run: Run, world: World, tmp_path: Path) -> None:
    from shapespace.io.meshes.mesh_io import read_mesh

    x = read_mesh(world.scan).vertices
    crop = "box:" + ",".join(str(v) for v in (*(x.min(axis=0) - 1), *(x.max(axis=0) + 1)))
    assert run("fit", world.model, world.scan, "-o", tmp_path, "--crop", crop, *FAST).code == 0
    record = json.loads((tmp_path / "scan_0.fit.json").read_text())
    assert record["config"]["crop"].startswith("box:") and record["notes"][0].startswith("Cropped to 1,000 of 1,000")
