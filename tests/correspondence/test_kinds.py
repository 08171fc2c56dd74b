"""Several kinds of object in one collection are found as groups, whatever the share of the second kind."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shapespace as ss
from raw_blobs import ANY_POSE, raw_blob
from shapespace.cli import main
from shapespace.commands import correspond as commands
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.kinds import find_kinds
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.simulated_scan import random_similarity
from shapespace.io.containers.json_files import read_json
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, sphere

QUICK = ElasticSettings(harmonics=60, points=500, iterations=10)
CONFIG = CorrespondConfig(vertices=300, rounds=2, mirror="never", first=QUICK, next=QUICK)


def shapes_of_kinds(counts: list[int], seed: int) -> FloatArray:
    """Return random shapes (N, V, 3) of several kinds, each with a mean and ten modes of its own."""
    rng = np.random.default_rng(seed)
    mean = 50.0 * rng.standard_normal((80, 3))
    kinds: list[FloatArray] = []
    for count in counts:
        own, modes = mean + 6.0 * rng.standard_normal((80, 3)), 1.6 * rng.standard_normal((10, 80, 3))
        kinds.append(own + np.tensordot(rng.standard_normal((count, 10)), modes, axes=1))
    shapes = np.concatenate(kinds)
    return shapes + 0.5 * rng.standard_normal(shapes.shape)


def groups_of(shapes: FloatArray) -> list[list[int]]:
    found = find_kinds(shapes, np.ones(shapes.shape[:2]), shapes.mean(axis=0))
    return [group.tolist() for group in found.groups]


@pytest.mark.parametrize("counts", [[12, 8], [10, 10], [14, 6]])
def test_no_group_mixes_kinds_and_each_kind_is_a_group(counts: list[int]) -> None:
    kind = np.repeat(np.arange(len(counts)), counts)
    for seed in range(3):
        groups = groups_of(shapes_of_kinds(counts, seed))
        assert all(len(set(kind[group])) == 1 for group in groups)
        assert {int(kind[group[0]]) for group in groups} == set(range(len(counts)))
        assert len(groups[0]) >= 0.7 * max(counts)


def test_one_kind_is_not_split() -> None:
    for count in (8, 20):
        assert all(len(groups_of(shapes_of_kinds([count], seed))) == 1 for seed in range(5))


def test_few_shapes_of_another_kind_are_far_from_the_group() -> None:
    shapes = shapes_of_kinds([17, 3], 0)
    found = find_kinds(shapes, np.ones(shapes.shape[:2]), shapes.mean(axis=0))
    assert len(found.groups) == 1 and found.groups[0].max() < 17
    assert np.median(found.distance[:17]) < 1.2 and found.distance[17:].min() > 2.5


def other_blob(k: int, points: int) -> Mesh:
    """Return a blob of another kind: without nose, with two bumps, in any pose."""
    rng = np.random.default_rng([33, k])
    directions, faces = sphere(points, 0.37 * (k + 1))

    def bump(at: tuple[float, float, float], width: float) -> FloatArray:
        return np.exp((directions @ (np.array(at) / np.linalg.norm(at)) - 1) / width)[:, None] * directions

    vertices = blob(directions, rng.standard_normal(5)) * [1.15, 0.85, 1.0]
    vertices += 40 * bump((1, 0.2, -0.4), 0.08) - 25 * bump((-0.3, 1, -0.2), 0.1) - 30 * bump((0, -0.1, 1), 0.05)
    return Mesh(random_similarity(rng, ANY_POSE).apply(vertices), faces, name=f"other{k}")


@pytest.fixture(scope="module")
def mixed() -> list[Mesh]:
    return [
        *(raw_blob(k, degrees=ANY_POSE, points=700).scan for k in range(9)),
        *(other_blob(k, 700) for k in range(6)),
    ]


@pytest.mark.long
def test_another_kind_is_excluded_as_a_group(mixed: list[Mesh]) -> None:
    made = ss.correspond(mixed, CONFIG)
    assert made.groups == (tuple(f"blob{k}" for k in range(9)), tuple(f"other{k}" for k in range(6)))
    reason = "another kind of object: one of 6 scans that are alike and differ from the largest group of 9"
    assert [scan.reason for scan in made.scans] == [""] * 9 + [reason] * 6


@pytest.mark.long
def test_each_group_gets_its_own_folder(
    mixed: list[Mesh], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scans").mkdir()
    for mesh in mixed:
        write_mesh(tmp_path / "scans" / f"{mesh.name}.ply", mesh)
    options = ["--vertices", "300", "--rounds", "1", "--mirror", "never", "--jobs", "1", "--groups"]
    real = commands.correspond

    def quick(scans: list[Mesh], config: CorrespondConfig, **options: Any) -> Correspondence:
        return real(scans, replace(config, first=QUICK, next=QUICK), **options)

    monkeypatch.setattr(commands, "correspond", quick)
    assert main(["correspond", str(tmp_path / "scans"), "-o", str(tmp_path / "same"), *options]) == 1
    assert "9 scans are alike; 6 are alike and differ from them." in capsys.readouterr().err
    own = [read_json(tmp_path / "same" / f"group_{k}" / "correspondence.json", "")["corresponding"] for k in (1, 2)]
    assert own == [[f"blob{k}" for k in range(9)], [f"other{k}" for k in range(6)]]
    assert main(["report", str(tmp_path / "same" / "group_1"), "--quiet"]) == 0
    page = (tmp_path / "same/group_1/report.html").read_text("utf-8")
    assert "9 scans are alike; 6 are alike and differ from them." in page
    assert main(["correspond", "x.ply", "-o", str(tmp_path / "same"), "--groups", "--add"]) == 2
    assert "--groups cannot be combined with --add" in capsys.readouterr().err
