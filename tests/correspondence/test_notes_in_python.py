"""Users of Python get the same notes on scans and meshes as those of the terminal."""

from pathlib import Path

import numpy as np
import pytest

import shapespace as ss
from raw_blobs import raw_blob
from shapespace.cli import main
from shapespace.correspondence import template
from shapespace.types import Mesh
from synthetic_shapes import training_meshes


def test_notes_on_scans_are_those_of_the_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(template, "MODES", 15)
    first, second = (raw_blob(k, points=600).scan for k in range(2))
    copy = Mesh(first.vertices + 9.0, first.faces, name="copy")
    in_metres = Mesh(0.001 * raw_blob(2, points=600).scan.vertices, raw_blob(2, points=600).scan.faces, name="metres")
    scans = [first, second, copy, in_metres]
    (tmp_path / "scans").mkdir()
    for scan in scans:
        ss.write_mesh(tmp_path / "scans" / f"{scan.name}.ply", scan)
    made = ss.correspond(scans, ss.CorrespondConfig(vertices=300, rounds=1, mirror="never"))
    options = ["--vertices", "300", "--rounds", "1", "--mirror", "never", "--jobs", "1", "--quiet"]
    assert main(["correspond", str(tmp_path / "scans"), "-o", str(tmp_path / "same"), *options]) == 0
    said = capsys.readouterr().err
    for sentence in (
        "copy: It is blob0 again; exclude one of the two.",
        "1 of 4 scans is in another unit than the majority, judging by size (metres); so are the surfaces, and build "
        "converts them to the unit of the majority.",
    ):
        assert sentence in made.notes and sentence in said
    assert made.scans[3].unit_ratio == pytest.approx(0.001)


def test_notes_on_meshes_are_those_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = np.ones((6, 200), dtype=bool)
    shown[:4, 3], shown[1, 50:70] = False, False
    meshes = [
        Mesh(1e-4 * np.where(there[:, None], mesh.vertices, np.nan), mesh.faces, name=f"m{k}.ply")
        for k, (mesh, there) in enumerate(zip(training_meshes(count=6, vertices=200), shown, strict=True))
    ]
    (tmp_path / "meshes").mkdir()
    for mesh in meshes:
        ss.write_mesh(tmp_path / "meshes" / mesh.name, mesh)
    notes = ss.build_model(meshes).notes
    assert main(["build", str(tmp_path / "meshes"), "-o", str(tmp_path / "m.h5"), "--modes", "all", "--quiet"]) == 0
    said = capsys.readouterr().err
    for beginning in (
        "24 of 1200 vertices are missing (2.0 %), in 4 of 6 meshes.",
        "1 vertex is removed from the model, since fewer than 50 % of the meshes show them",
        "The mean is ",
    ):
        [sentence] = [note for note in notes if note.startswith(beginning)]
        assert sentence in said
