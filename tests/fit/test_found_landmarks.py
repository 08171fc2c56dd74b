"""Landmarks that a fit finds: on the surface it writes, in the scan's frame, as far off as it says."""

from dataclasses import replace

import numpy as np
import pytest

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.types import Mesh
from synthetic_shapes import Raw, blob_model, raw_scan, similarity

MODEL = blob_model(3000)
Z = np.random.default_rng(5).uniform(-1.2, 1.2, (6, 5))


def scanned(k: int, noise_mm: float = 1.5) -> Raw:
    return raw_scan(Z[k], similarity(k, 20.0, 1.0), vertices=3500, model_vertices=3000, noise_mm=noise_mm)


@pytest.fixture(scope="module")
def fits() -> list[tuple[Raw, FitResult]]:
    raws = [scanned(k) for k in range(len(Z))]
    return [(raw, fit_scan(MODEL, raw.scan, FitConfig(unit="mm"))) for raw in raws]


def test_landmarks_lie_near_their_true_places_and_as_far_off_as_is_said(
    fits: list[tuple[Raw, FitResult]],
) -> None:
    off_mm, share = [], []
    for raw, result in fits:
        assert result.landmark_stddev_mm is not None
        for name, vertex in MODEL.landmarks.items():
            error = result.landmarks[name] - raw.truth[vertex]
            off_mm.append(np.linalg.norm(error))
            share.append(error / result.landmark_stddev_mm[name])
    assert np.median(off_mm) < 1.0 and max(off_mm) < 3.0
    # Of 72 numbers; a standard deviation half or twice as large as it should be fails.
    assert 0.5 < np.sqrt(np.mean(np.square(share))) < 1.6


def test_a_landmark_that_the_scan_does_not_show_is_less_certain(fits: list[tuple[Raw, FitResult]]) -> None:
    raw, whole = fits[0]
    tip = raw.truth[MODEL.landmarks["tip"]]
    kept = np.linalg.norm(raw.scan.vertices - tip, axis=1) > 60.0
    number = np.cumsum(kept) - 1
    faces = np.asarray(raw.scan.faces)
    part = Mesh(raw.scan.vertices[kept], number[faces[kept[faces].all(axis=1)]], name="part")
    cut = fit_scan(MODEL, part, FitConfig(unit="mm"), T_scan_model=whole.T_scan_model)
    assert whole.landmark_stddev_mm is not None and cut.landmark_stddev_mm is not None
    size = {name: np.linalg.norm(cut.landmark_stddev_mm[name]) / np.linalg.norm(whole.landmark_stddev_mm[name])
            for name in MODEL.landmarks}  # fmt: skip
    assert size["tip"] > 1.3
    assert size["tip"] > size["back"]


def test_a_turned_and_rescaled_scan_turns_and_keeps_the_standard_deviations(
    fits: list[tuple[Raw, FitResult]],
) -> None:
    raw, result = fits[1]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    in_metres = raw.scan.with_vertices(0.001 * raw.scan.vertices @ turn.T)
    other = fit_scan(MODEL, in_metres, FitConfig(unit="m"))
    assert result.landmark_stddev_mm is not None and other.landmark_stddev_mm is not None
    for name, at in result.landmarks.items():
        # The search for a start draws other points, so the fit ends a hair elsewhere.
        np.testing.assert_allclose(other.landmarks[name], 0.001 * turn @ at, atol=0.0005)
        expected = np.abs(turn) @ result.landmark_stddev_mm[name]
        np.testing.assert_allclose(other.landmark_stddev_mm[name], expected, rtol=0.1)


def test_landmarks_lie_on_the_dense_surface_where_there_is_one() -> None:
    raw = scanned(2)
    result = fit_scan(MODEL, raw.scan, FitConfig(unit="mm", dense=True))
    for name, vertex in MODEL.landmarks.items():
        np.testing.assert_array_equal(result.landmarks[name], result.surface(stage="dense").vertices[vertex])


def test_the_papers_method_gives_landmarks_without_standard_deviations() -> None:
    result = fit_scan(MODEL, scanned(3).scan, FitConfig("paper", unit="mm", max_iterations=20))
    assert set(result.landmarks) == set(MODEL.landmarks)
    assert result.landmark_stddev_mm is None


def test_a_model_without_landmarks_gives_none() -> None:
    bare = replace(MODEL, landmarks={})
    assert fit_scan(bare, scanned(4).scan, FitConfig(unit="mm")).landmarks == {}
