"""Simulated organs: one formula gives surfaces and voxels, and each is the same whenever it is drawn."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.cli import main
from shapespace.datasets.organs import Organ, label_volume, raw_surface, write_organs
from shapespace.errors import InputError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.doctor import examine
from shapespace.geometry.normals import faces_of
from shapespace.geometry.similarity import fit_similarity
from shapespace.geometry.volume_surface import surface_of_volume
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import Mesh


def draw(k: int) -> tuple[Organ, np.random.Generator]:
    return Organ.draw(np.random.default_rng([0, k])), np.random.default_rng([0, k, 1])


@pytest.mark.parametrize("k", range(4))
def test_a_raw_surface_is_closed_and_looks_outward(k: int) -> None:
    report = examine(raw_surface(*draw(k)))
    assert report.components == 1 and report.boundary_edges == report.non_manifold_edges == 0
    assert report.findings == () and 70 < report.extent.max() < 180


@pytest.mark.parametrize("k", range(3))
def test_the_surface_parts_what_is_inside_from_what_is_not(k: int) -> None:
    organ, rng = draw(k)
    directions = rng.standard_normal((500, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    smaller, larger = (replace(organ, half_mm=share * organ.half_mm) for share in (0.99, 1.01))
    # The bend and the taper are told in half lengths, so that they scale too.
    assert organ.inside(smaller.surface(directions)).all()
    assert not organ.inside(larger.surface(directions)).any()


def enclosed(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[faces_of(mesh)[:, k]] for k in range(3))
    return float(np.einsum("fd,fd->", a, np.cross(b, c)) / 6)


def test_voxels_are_those_of_the_surface() -> None:
    pytest.importorskip("skimage", reason="the extra `volumes` is not installed")
    organ, rng = draw(1)
    volume = label_volume(organ, rng)
    made = surface_of_volume(volume, 1)
    assert made.at_border == 0 and made.pieces == 1
    surface = raw_surface(organ, np.random.default_rng(3), points=2000)
    assert made.volume_mm3 == pytest.approx(enclosed(surface), rel=0.02)


def test_number_k_is_the_same_however_many_are_drawn_and_others_differ(tmp_path: Path) -> None:
    two, three = write_organs(tmp_path / "two", count=2), write_organs(tmp_path / "three", count=3)
    for name in ("organ_000.ply", "organ_001.ply"):
        assert (two / name).read_bytes() == (three / name).read_bytes()
    a, b = (read_mesh(three / f"organ_00{k}.ply") for k in (0, 1))
    moved = fit_similarity(a.vertices, b.vertices).apply(a.vertices)
    assert build_engine(b).query(moved).distance.mean() > 1.0
    assert main(["data", "organs", "-o", str(tmp_path / "cli"), "--count", "2", "--quiet"]) == 0
    assert (tmp_path / "cli" / "organ_001.ply").read_bytes() == (two / "organ_001.ply").read_bytes()


def test_a_number_that_cannot_be_is_refused(tmp_path: Path) -> None:
    for count in (0, 20_000):
        with pytest.raises(InputError, match="between 1 and 10000"):
            write_organs(tmp_path, count=count)
