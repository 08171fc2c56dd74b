"""Mirrored scans are found by comparing all scans of a collection, and reflected, excluded or trusted."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import shapespace as ss
from raw_blobs import ANY_POSE, dispersion_mm, marked, raw_blob
from shapespace.cli import main
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import FLIP, mirror_image, solve_sides
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.schemas import CorrespondenceRecord
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, sphere

QUICK = ElasticSettings(harmonics=60, points=500, iterations=10)
CONFIG = CorrespondConfig(vertices=300, rounds=1, first=QUICK, next=QUICK)
MIRRORED = (1, 4)
BLOBS = [raw_blob(k, degrees=ANY_POSE, points=700) for k in range(6)]


def mixed(mirrored: tuple[int, ...] = MIRRORED) -> list[Mesh]:
    return [mirror_image(one.scan) if k in mirrored else one.scan for k, one in enumerate(BLOBS)]


def simulated_scores(rng: np.random.Generator, sides: FloatArray, anchors: list[int], signal: float) -> FloatArray:
    """Return scores whose evidence is `signal` on the true side, with noise of 0.05."""
    evidence = signal * sides[anchors][:, None] * sides + 0.05 * rng.standard_normal((len(anchors), len(sides)))
    return np.stack([np.ones_like(evidence), np.exp(evidence)], axis=2)


def test_sides_are_those_of_the_truth_although_single_comparisons_are_wrong() -> None:
    rng = np.random.default_rng(0)
    wrong, single = 0, 0
    for _ in range(50):
        sides = rng.choice([-1.0, 1.0], 30)
        scores = simulated_scores(rng, sides, [0, 5, 9, 12], 0.1)
        found = solve_sides(scores, [0, 5, 9, 12], 0)
        assert found.decided
        wrong += int((found.mirrored != (sides != sides[0])).sum())
        single += int(((np.log(scores[0, :, 1]) < 0) != (sides != sides[0])).sum())
    assert wrong <= 5 < 20 < single


def test_scores_without_a_side_decide_nothing() -> None:
    rng = np.random.default_rng(0)
    found = [solve_sides(simulated_scores(rng, np.ones(20), [0, 1, 2], 0.0), [0, 1, 2], 0) for _ in range(100)]
    assert sum(one.decided for one in found) <= 4  # 1 % of 100 are expected
    assert not any(one.mirrored.any() for one in found if not one.decided)


def test_what_was_not_compared_is_on_no_side() -> None:
    scores = simulated_scores(np.random.default_rng(0), np.repeat([1.0, -1.0], 10), [0, 1, 2], 0.2)
    scores[:, 15] = np.nan
    found = solve_sides(scores, [0, 1, 2], 0)
    assert found.decided and not found.mirrored[15] and found.margin[15] == 0
    assert found.mirrored.sum() == 9


@pytest.mark.parametrize(
    "mirrored", [MIRRORED, pytest.param((0, 2, 3, 5), marks=[pytest.mark.long, pytest.mark.pairs])]
)
def test_mirrored_scans_are_reflected_and_the_majority_keeps_its_side(mirrored: tuple[int, ...]) -> None:
    scans = mixed(mirrored)
    made = correspond(scans, replace(CONFIG, rounds=2))
    minority = set(MIRRORED)
    assert made.sides_decided
    assert {k for k, scan in enumerate(made.scans) if scan.mirrored} == minority
    for scan, one in zip(scans, made.scans, strict=True):
        assert build_engine(scan).query(one.vertices).distance.mean() < 0.5  # mm, in the frame of the scan
    sides = [mesh.vertices * (1.0 if mirrored == MIRRORED else FLIP) for mesh in made.meshes()]
    assert dispersion_mm(BLOBS, sides) < 7.0  # mm; scans of the wrong side are 40 mm off or more


@pytest.mark.long
def test_mirrored_scans_are_excluded_on_request_and_files_are_trusted_on_request() -> None:
    made = correspond(mixed(), replace(CONFIG, mirror="ask"))
    assert [scan.reason.startswith("mirrored: its mirror image") for scan in made.scans] == [
        k in MIRRORED for k in range(6)
    ]
    made = correspond(mixed((2,))[:5], replace(CONFIG, mirror="never"))
    assert not any(scan.mirrored for scan in made.scans) and not made.sides_decided


def test_of_symmetric_objects_no_scan_is_reflected() -> None:
    rng = np.random.default_rng(0)

    def even(k: int) -> Mesh:
        directions, faces = sphere(600, 0.37 * k)
        z = rng.standard_normal(5)
        vertices = 0.5 * (blob(directions, z) + blob(directions * [-1, 1, 1], z) * FLIP)
        return Mesh(vertices + 0.2 * rng.standard_normal(vertices.shape), faces, name=str(k))

    scans = [even(k) for k in range(6)]
    made = correspond([mirror_image(scan) if k % 2 else scan for k, scan in enumerate(scans)], CONFIG)
    assert not made.sides_decided and not any(scan.mirrored for scan in made.scans)


@pytest.mark.long
def test_landmarks_of_mirrored_scans_are_reflected_with_them() -> None:
    scans = [mirror_image(marked(one)) if k in MIRRORED else marked(one) for k, one in enumerate(BLOBS)]
    made = correspond(scans, CONFIG)
    assert {k for k, scan in enumerate(made.scans) if scan.mirrored} == set(MIRRORED)
    size = np.mean([scan.T_scan_template.scale for scan in made.scans]) * 100
    assert all(scan.landmarks < 0.05 * size for scan in made.scans)


@pytest.mark.long
def test_surfaces_of_mirrored_scans_are_in_their_frames_and_build_reflects_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for folder, scans in (("mixed", mixed()), ("plain", mixed(()))):
        (tmp_path / folder).mkdir()
        for scan in scans:
            write_mesh(tmp_path / folder / f"{scan.name}.ply", scan)
        out = ["--vertices", "300", "--rounds", "1", "--jobs", "1", "--quiet"]
        assert main(["correspond", str(tmp_path / folder), "-o", str(tmp_path / f"{folder}-same"), *out]) == 0
        printed = capsys.readouterr().err
        assert ("2 scans are mirror images of the others (blob1, blob4)" in printed) == (folder == "mixed")
        assert main(["build", str(tmp_path / f"{folder}-same"), "-o", str(tmp_path / f"{folder}.h5"), "--quiet"]) == 0
        printed = capsys.readouterr()
        assert ("2 of 6 meshes are mirror images" in printed.out + printed.err) == (folder == "mixed")
    run = CorrespondenceRecord.from_json(json.loads((tmp_path / "mixed-same/correspondence.json").read_text()))
    assert run.mirrored == ["blob1", "blob4"] and run.sides_decided
    own, image = (read_mesh(tmp_path / f"mixed-same/blob{k}.corresponding.ply") for k in (0, 1))
    np.testing.assert_array_equal(own.faces, image.faces[:, ::-1])
    assert build_engine(mixed()[1]).query(image.vertices).distance.mean() < 0.5
    before = image.vertices
    write_mesh(tmp_path / "new.ply", mirror_image(raw_blob(6, degrees=ANY_POSE, points=700).scan))
    added = ["correspond", str(tmp_path / "new.ply"), "--add", "-o", str(tmp_path / "mixed-same")]
    assert main([*added, "--jobs", "1", "--quiet"]) == 0
    run = CorrespondenceRecord.from_json(json.loads((tmp_path / "mixed-same/correspondence.json").read_text()))
    assert run.mirrored == ["blob1", "blob4", "new"] and run.sides_decided
    np.testing.assert_array_equal(read_mesh(tmp_path / "mixed-same/blob1.corresponding.ply").vertices, before)
    assert main(["report", str(tmp_path / "mixed-same"), "--quiet"]) == 0
    page = (tmp_path / "mixed-same/report.html").read_text("utf-8")
    assert "3 scans are mirror images of the others and shown reflected (blob1, blob4, new)" in page
    models = [ss.ShapeModel.load(tmp_path / f"{folder}.h5") for folder in ("mixed", "plain")]
    np.testing.assert_allclose(models[0].total_variance, models[1].total_variance, rtol=0.1)
