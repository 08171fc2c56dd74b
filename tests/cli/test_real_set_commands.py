"""Scans in the formats of the licensed sets go through the same commands as any other."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from conftest import Run, World
from shapespace.io.meshes.mesh_io import read_mesh

FAST = ("--set", "max_iterations=2")


def vrml(points: list[list[float]], faces: list[list[int]]) -> str:
    rows = ",\n".join("{!r} {!r} {!r}".format(*point) for point in points)
    ends = ",\n".join("{}, {}, {}, -1".format(*face) for face in faces)
    return (
        "#VRML V2.0 utf8\nShape { geometry IndexedFaceSet {\ncoord Coordinate {\npoint [\n"
        f"{rows}\n]\n}}\ncoordIndex [\n{ends}\n]\n}} }}\n"
    )


def test_a_vrml_scan_gives_the_fit_of_the_same_scan_in_ply(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    mesh = read_mesh(world.scan)
    text = vrml(mesh.vertices.tolist(), mesh.faces.tolist())
    (tmp_path / "set" / "F0001_AN01WH_F3D.wrl").write_text(text)
    assert run("fit", world.model, tmp_path / "set", world.scan, "-o", tmp_path / "out", *FAST).code == 0
    one, other = (json.loads(p.read_text()) for p in sorted((tmp_path / "out").glob("*.fit.json")))
    assert "F0001_AN01WH_F3D" in one["scan"]["path"] + other["scan"]["path"]
    assert one["b"] == other["b"] and one["status"] == other["status"]


@pytest.mark.parametrize("name", ["a.bnt", "a.wrl"])
def test_check_and_info_read_them(run: Run, tmp_path: Path, name: str) -> None:
    y, x = np.mgrid[0:6, 0:7].astype(float)
    grid = np.stack([x, y, 0.1 * x * y]).reshape(3, -1)
    cell = [[r * 7 + c, r * 7 + c + 1, r * 7 + c + 7] for r in range(5) for c in range(6)]
    head = struct.pack("<HHdH", 6, 7, -1e9, 0) + struct.pack("<I", 5 * 42)
    points = grid.T.tolist()
    content = {
        "a.bnt": head + grid.astype("<f8").tobytes() + bytes(8 * 84),
        "a.wrl": vrml(points, cell).encode(),
    }[name]
    (tmp_path / name).write_bytes(content)
    for command in ("check", "info"):
        outcome = run(command, tmp_path / name, "--json")
        assert outcome.code == 0, outcome.err
        assert json.dumps(outcome.facts)


def test_a_damaged_scan_is_refused_in_one_sentence(run: Run, world: World, tmp_path: Path) -> None:
    scan = tmp_path / "bs000_N_N_0.bnt"
    scan.write_bytes(struct.pack("<HH", 400, 400) + bytes(30))
    outcome = run("info", scan)
    assert outcome.code == 2
    assert "bs000_N_N_0.bnt" in outcome.sentence()
