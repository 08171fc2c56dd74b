"""Simulated bones: raw scans with what was put in, the same for every count."""

import csv
from pathlib import Path

import numpy as np
import pytest

from shapespace.cli import main
from shapespace.datasets.bones import EFFECT_MM, LEFT_ARCH_MM, Bone, write_bones
from shapespace.errors import InputError
from shapespace.geometry.doctor import examine
from shapespace.geometry.mirror_plane import FLIP
from shapespace.io.meshes.mesh_io import read_mesh

TIP, ARCH = np.array([[0.0, -0.1, 1.0]]), np.array([[0.9, -0.15, 0.2]])


def reach(bone: Bone, direction: np.ndarray) -> float:
    return float(np.linalg.norm(bone.surface(direction / np.linalg.norm(direction))))


def test_snouts_of_the_second_group_are_longer_and_left_arches_stand_out() -> None:
    drawn = [(Bone.draw(np.random.default_rng(k)), Bone.draw(np.random.default_rng(k), EFFECT_MM)) for k in range(200)]
    longer = [reach(two, TIP) - reach(one, TIP) for one, two in drawn]
    apart = [reach(one, ARCH) - reach(one, ARCH * FLIP) for one, _ in drawn]
    assert abs(np.mean(longer) / EFFECT_MM - 1) < 0.1
    assert abs(np.mean(apart) - LEFT_ARCH_MM) < 3 * np.std(apart) / np.sqrt(200) + 0.1


def test_scans_are_raw_and_the_table_names_their_groups(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["data", "bones", "-o", str(tmp_path / "six"), "--count", "6", "--quiet"]) == 0
    assert capsys.readouterr().out == f"6 bones in {tmp_path / 'six'}\n"
    rows = list(csv.DictReader((tmp_path / "six" / "bones.csv").read_text().splitlines()))
    assert [row["group"] for row in rows] == ["coast", "island"] * 3
    for k, row in enumerate(rows):
        found = examine(read_mesh(tmp_path / "six" / row["file"]))
        assert found.components == 1 and 40 < found.extent.max() < 90
        assert (found.boundary_edges > 0) is (k % 3 == 2)
    write_bones(tmp_path / "two", count=2)
    for k in range(2):
        one, other = (read_mesh(tmp_path / name / f"bone_00{k}.ply") for name in ("six", "two"))
        np.testing.assert_array_equal(one.vertices, other.vertices)


@pytest.mark.parametrize(("count", "effect"), [(1, 4.0), (4, 11.0), (4, float("nan"))])
def test_numbers_out_of_range_are_refused(tmp_path: Path, count: int, effect: float) -> None:
    with pytest.raises(InputError, match="must be between"):
        write_bones(tmp_path, count=count, effect_mm=effect)
