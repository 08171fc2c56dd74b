"""Landmarks that are given hold a fit as firmly as they are known, to its end; wrong ones hardly do."""

from dataclasses import replace

import numpy as np
import pytest

from shapespace.datasets.organs import Organ
from shapespace.datasets.simulated_scan import SimulatedScan, random_similarity, simulate_scan
from shapespace.errors import InputError
from shapespace.fit.fit_scan import FitConfig, FitResult, fit_scan
from shapespace.fit.robust.prepared_model import LandmarkConstraint, LinearShape, prepare
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks
from synthetic_shapes import blob_model, raw_scan, similarity, sphere

MM = FitConfig(unit="mm")
CLICKED_MM = 0.5


def organ(rng: np.random.Generator) -> Mesh:
    directions, faces = sphere(1000)
    return Mesh(Organ.draw(rng).surface(directions), faces, name="organ")


@pytest.fixture(scope="module")
def organs() -> ShapeModel:
    """Smooth and nearly round: a surface that matches says little of what corresponds to what."""
    rng = np.random.default_rng(0)
    x = [organ(rng) for _ in range(40)]
    ends = {f"{end}_{axis}": int(getattr(x[0].vertices[:, k], f"arg{end}")())
            for k, axis in enumerate("xyz") for end in ("min", "max")}  # fmt: skip
    return ShapeModel.fit(x, gauge="form", landmarks=ends)


def clicked(model: ShapeModel, scan: SimulatedScan, rng: np.random.Generator) -> dict[str, FloatArray]:
    return {name: scan.truth_vertices[vertex] + CLICKED_MM / np.sqrt(3) * rng.standard_normal(3)
            for name, vertex in model.landmarks.items()}  # fmt: skip


def rms_mm(result: FitResult, truth: FloatArray) -> float:
    return float(np.sqrt(((result.surface().vertices - truth) ** 2).sum(axis=1).mean()))


def test_they_rescue_correspondence_where_their_start_alone_does_not(organs: ShapeModel) -> None:
    start_mm, held_mm = [], []
    for seed in range(2):
        rng = np.random.default_rng(300 + seed)
        pose = random_similarity(rng, 30.0, (1.0, 1.0))
        scan = simulate_scan(organ(rng), rng, triangles=3000, noise_mm=0.3, T_scan_model=pose)
        marks = clicked(organs, scan, rng)
        for config, off_mm in ((replace(MM, landmark_stddev_mm=float("inf")), start_mm), (MM, held_mm)):
            off_mm.append(rms_mm(fit_scan(organs, scan.scan, config, landmarks=marks), scan.truth_vertices))
    assert max(held_mm) < 1.5 and np.mean(held_mm) < 0.75 * np.mean(start_mm)


def test_clean_fits_are_as_good_with_them_as_without() -> None:
    model = blob_model(1500)
    without_mm, with_mm = [], []
    for k, z in enumerate(np.random.default_rng(3).uniform(-1.2, 1.2, (4, 5))):
        raw = raw_scan(z, similarity(k, 20.0, 1.0), vertices=4000, model_vertices=1500, noise_mm=0.2)
        rng = np.random.default_rng(k)
        marks = {name: raw.truth[v] + rng.normal(0, 1.0, 3) for name, v in model.landmarks.items()}
        without_mm.append(rms_mm(fit_scan(model, raw.scan, MM), raw.truth))
        with_mm.append(rms_mm(fit_scan(model, raw.scan, MM, landmarks=marks), raw.truth))
    assert np.mean(with_mm) < 1.05 * np.mean(without_mm) and max(with_mm) < 1.5


def test_for_the_start_alone_they_leave_the_rest_of_the_fit_as_it_is_to_the_bit() -> None:
    model, pose = blob_model(700), similarity(2, 20.0, 1.0)
    raw = raw_scan(np.array([1.0, -0.5, 0.5, 0.8, -0.3]), pose, noise_mm=0.2)
    marks = {name: raw.truth[v] for name, v in model.landmarks.items()}
    config = replace(MM, landmark_stddev_mm=float("inf"))
    started = fit_scan(model, raw.scan, config, landmarks=marks, T_scan_model=pose)
    plain = fit_scan(model, raw.scan, MM, T_scan_model=pose)
    np.testing.assert_array_equal(started.b, plain.b)
    np.testing.assert_array_equal(started.b_stddev, plain.b_stddev)
    assert started.evidence.to_dict() == pytest.approx(plain.evidence.to_dict(), abs=0, nan_ok=True)
    held = fit_scan(model, raw.scan, MM, landmarks=marks, T_scan_model=pose)
    assert not np.array_equal(held.b, plain.b)


def test_a_wrong_landmark_is_named_and_hardly_moves_the_fit(organs: ShapeModel) -> None:
    rng = np.random.default_rng(7)
    scan = simulate_scan(organ(rng), rng, triangles=3000, noise_mm=0.3)
    marks = clicked(organs, scan, rng)
    right = fit_scan(organs, scan.scan, MM, landmarks=marks, T_scan_model=scan.T_scan_model)
    marks["max_x"] = marks["max_x"] + np.array([0.0, 25.0, 0.0])
    wrong = fit_scan(organs, scan.scan, MM, landmarks=marks, T_scan_model=scan.T_scan_model)
    said = [note for note in wrong.notes if note.startswith("Landmark")]
    assert len(said) == 1 and "'max_x' lies 2" in said[0]
    assert not [note for note in right.notes if note.startswith("Landmark")]
    assert rms_mm(wrong, scan.truth_vertices) < 1.2 * rms_mm(right, scan.truth_vertices) + 0.1


def test_the_firmer_they_are_the_nearer_the_fit_lies_to_them(organs: ShapeModel) -> None:
    rng = np.random.default_rng(9)
    scan = simulate_scan(organ(rng), rng, triangles=3000, noise_mm=0.3)
    marks = clicked(organs, scan, rng)
    off_mm = [
        fit_scan(organs, scan.scan, replace(MM, landmark_stddev_mm=sd), landmarks=marks).evidence.marks_rms_mm
        for sd in (0.3, 1.0, 5.0)
    ]
    assert off_mm == sorted(off_mm) and off_mm[0] < 0.7 * off_mm[-1]


def test_a_standard_deviation_that_cannot_be_is_refused() -> None:
    for bad in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="positive standard deviation"):
            FitConfig(landmark_stddev_mm=bad)


def off_vertex(model: ShapeModel, count: int = 6) -> SurfaceLandmarks:
    """Return landmarks well inside triangles of `model`."""
    rng = np.random.default_rng(4)
    faces = np.asarray(model.faces)[rng.choice(len(np.asarray(model.faces)), count, replace=False)]
    return SurfaceLandmarks(tuple(f"p{k}" for k in range(count)), faces, 0.2 + 0.4 * rng.dirichlet(np.ones(3), count))


def test_the_term_of_landmarks_between_vertices_has_the_jacobian_of_their_places() -> None:
    model = replace(blob_model(300), landmarks=off_vertex(blob_model(300)))
    prepared, b = prepare(model), 0.3 * model.stddev
    surface = LinearShape(prepared.topology, model.mean_vertices, prepared.modes).surface(b)
    T, rng = similarity(3, 15.0, 1.3), np.random.default_rng(0)

    def points_at(b: FloatArray) -> FloatArray:
        return T.apply(model.landmarks.interpolate(model.reconstruct(b)))

    aim = points_at(b) + rng.normal(0, 2.0, (6, 3))
    marks = LandmarkConstraint.of(model, dict(zip(model.landmarks, aim, strict=True)), 2.0)
    assert marks is not None
    np.testing.assert_allclose(marks.off_mm(surface, T), np.linalg.norm(points_at(b) - aim, axis=1), atol=1e-3)
    hessian, gradient = marks.equations(surface, T, model.n_modes)
    # The weights are held in a step, so differences of the weighted squares are those of the linear residual.
    off = (points_at(b) - aim) / T.scale
    distance = np.linalg.norm(off, axis=1)
    stddev = 2.0 / T.scale
    width = 3.0 * max(stddev, min(1.48 * float(np.median(distance)), marks.far_mm))
    weight = np.exp(-0.5 * (distance / width) ** 2) / stddev**2
    steps = 1e-3 * np.eye(model.n_modes)
    moved = np.stack([(points_at(b + step) - points_at(b - step)) / (2e-3 * T.scale) for step in steps])
    turned = off @ T.rotation
    np.testing.assert_allclose(gradient[7:], np.einsum("kld,ld,l->k", moved, off, weight), rtol=1e-4)
    np.testing.assert_allclose(hessian[7:, 7:], np.einsum("kld,mld,l->km", moved, moved, weight), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(gradient[3:6], weight @ turned, rtol=1e-4)


def test_landmarks_between_vertices_are_recovered_between_vertices() -> None:
    model = replace(blob_model(700), landmarks=off_vertex(blob_model(700)))
    off_mm, snapped_mm, share = [], [], []
    for k, z in enumerate(np.random.default_rng(8).uniform(-1.0, 1.0, (3, 5))):
        pose = similarity(k, 20.0, 1.0)
        raw = raw_scan(z, pose, vertices=4000, model_vertices=700, noise_mm=1.5)
        truth = model.landmarks.positions(raw.truth)
        result = fit_scan(model, raw.scan, MM, landmarks=truth)
        assert result.start == "landmarks" and result.landmark_stddev_mm is not None
        at = np.stack([result.landmarks[name] for name in model.landmarks])
        true = np.stack([truth[name] for name in model.landmarks])
        off_mm += np.linalg.norm(at - true, axis=1).tolist()
        nearest = result.surface().vertices[list(model.landmarks.values())]
        snapped_mm += np.linalg.norm(nearest - true, axis=1).tolist()
        share.append((at - true) / np.stack([result.landmark_stddev_mm[name] for name in model.landmarks]))
    assert np.mean(off_mm) < 0.8 and np.mean(snapped_mm) > 4.0
    assert 0.5 < np.sqrt(np.mean(np.square(share))) < 1.6


def test_landmarks_at_vertices_fit_to_the_bit_as_vertices_did() -> None:
    model = blob_model(700)
    face = np.asarray(model.faces)
    rows = [int(np.flatnonzero((face == v).any(axis=1))[0]) for v in model.landmarks.values()]
    weights = np.stack([(face[row] == v).astype(float) for row, v in zip(rows, model.landmarks.values(), strict=True)])
    in_triangles = replace(model, landmarks=SurfaceLandmarks(tuple(model.landmarks), face[rows], weights))
    assert in_triangles.landmarks == model.landmarks and in_triangles.content_hash == model.content_hash
