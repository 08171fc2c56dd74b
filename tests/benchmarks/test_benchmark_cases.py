"""The protocol that figures are measured by must hold what it says, on settings small enough for a test."""

import sys
from pathlib import Path

import numpy as np
import pytest

from shapespace.datasets.ict import load_ict
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import face_areas
from shapespace.geometry.similarity import fit_similarity

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import cases


@pytest.fixture(scope="module")
def ict(shared_data):
    return load_ict(shared_data / "ict-facekit")


@pytest.fixture(scope="module")
def bench(ict, tmp_path_factory):
    return cases.Bench("test", tmp_path_factory.mktemp("cache"), ict)


def mm_from(scan, points):
    return build_engine(scan.mesh).query(points).distance / scan.T_scan_model.scale


@pytest.mark.parametrize("name", ["coarse", "cloud", "any_pose"])
def test_a_scan_is_the_same_from_any_cache_and_in_any_order(bench, ict, tmp_path, name):
    kept = bench.scan(name, 3)
    bench.scan(name, 1)
    again = cases.Bench("test", tmp_path, ict).scan(name, 3)
    for scan in (again, bench.scan(name, 3)):
        np.testing.assert_array_equal(scan.mesh.vertices, kept.mesh.vertices)
        np.testing.assert_array_equal(scan.truth, kept.truth)
        assert (scan.mesh.faces is None) == (kept.mesh.faces is None)


def test_the_splits_share_no_scan(ict, tmp_path):
    test, dev = (cases.Bench(split, tmp_path, ict).scan("cloud", 0) for split in ("test", "dev"))
    assert np.linalg.norm(test.truth - dev.truth, axis=1).min() > 0
    assert not np.allclose(test.T_scan_model.rotation, dev.T_scan_model.rotation)


def test_no_training_person_is_a_test_person_in_either_split(ict, tmp_path):
    benches = {split: cases.Bench(split, tmp_path, ict) for split in ("test", "dev")}
    groups = [bench.training_people(200) for bench in benches.values()]
    groups += [ict.draw_people(100, cases.PEOPLE_SEED[split]) for split in benches]
    np.testing.assert_array_equal(groups[2][7], benches["test"].person(7))
    everyone = np.concatenate(groups)
    assert len(np.unique(everyone[:, 0])) == len(everyone)


@pytest.mark.parametrize("name", ["complete", "noise1"])
def test_the_truth_lies_on_the_scan(bench, name):
    scan = bench.scan(name, 0)
    noise = 1.0 if name == "noise1" else cases.NOISE_MM
    assert np.median(mm_from(scan, scan.truth)) < noise
    assert np.quantile(mm_from(scan, scan.truth), 0.95) < 3 * noise


def test_a_scan_without_forty_percent_lacks_forty_percent(bench, ict):
    for index in range(2):
        raw, face = cases.CASES["missing40"].make(bench, index)
        # Noise folds the surface and so adds a little area.
        assert face_areas(raw).sum() / face_areas(face).sum() == pytest.approx(0.6, abs=0.02)


def test_the_case_with_holes_lacks_skin_and_shows_a_neck(bench):
    scan = bench.scan("holes_clean", 0)
    truth = scan.T_scan_model.inverse().apply(scan.truth)
    shown = scan.T_scan_model.inverse().apply(scan.mesh.vertices)
    lost = mm_from(scan, scan.truth) > 1.0
    assert 0.05 < lost.mean() < 0.3
    assert shown[:, 1].min() < truth[:, 1].min() - 20.0


def test_poses_are_off_by_what_the_protocol_says(bench):
    T = bench.scan("coarse", 0).T_scan_model
    angle = np.degrees(np.arccos((np.trace(T.rotation) - 1) / 2))
    assert (angle, T.scale) == pytest.approx((cases.OFF_DEG, cases.OFF_SCALE))
    assert np.linalg.norm(T.translation) == pytest.approx(cases.OFF_MM)


def test_the_floor_is_zero_in_the_span_and_below_plain_projection_outside_it(bench, ict):
    model = bench.model("ict60")
    scan = bench.scan("coarse", 0)
    inside = ict.mesh(bench.training_people(60)[5]).vertices
    T = scan.T_scan_model
    assert cases.floor_mm(model, cases.Scan(scan.mesh, T.apply(inside), T, None)) < 1e-6

    truth = T.inverse().apply(scan.truth)
    in_place = model.reconstruct(model.project(truth, align=False))
    aligned = model.reconstruct(model.project(truth))
    aligned = fit_similarity(aligned, truth).apply(aligned)
    floor = cases.floor_mm(model, scan)
    assert bench.floor_mm("outside", 0, None) == pytest.approx(floor)
    mean_errors = [np.linalg.norm(shape - truth, axis=1).mean() for shape in (in_place, aligned)]
    assert 0.8 * min(mean_errors) < floor <= min(mean_errors) * (1 + 1e-3)


def test_the_error_is_in_millimetres_of_the_model_whatever_the_unit_of_the_scan(bench):
    for index in range(4):
        scan = bench.scan("any_pose", index)
        moved = scan.T_scan_model.apply(scan.T_scan_model.inverse().apply(scan.truth) + np.array([3.0, 0.0, 4.0]))
        assert cases.error_mm(moved, scan) == pytest.approx(5.0)


def test_a_surface_that_is_the_truth_has_neither_folds_nor_distance_from_it(bench):
    scan = bench.scan("complete", 0)
    figures = cases.surface_figures(scan.truth, bench.model("ict60"), scan, 1.0 / scan.T_scan_model.scale)
    assert figures["folded"] == 0
    assert figures["true_surface_mm"] < 1e-6
    assert 0.05 < figures["surface_mm"] < 2 * cases.NOISE_MM
