"""Strips of a fit: signs show where they mean something, and grey is what the scan does not show."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.report.inputs.saved_fits import StagedFit
from shapespace.report.render import thumbnails
from shapespace.types import Mesh
from synthetic_shapes import blob_model, raw_scan


@pytest.fixture(scope="module")
def fit() -> StagedFit:
    model = blob_model(300, 3)
    result = fit_scan(model, raw_scan(np.full(5, 0.3), vertices=500).scan, FitConfig(method="paper", max_iterations=2))
    return StagedFit.of(model, result)


def map_of(fit: StagedFit, distance_mm: float) -> np.ndarray:
    """Return the panel of the distances, where all of them are the same."""
    far = {stage: np.full(len(fit.regions), distance_mm) for stage in fit.surfaces}
    data, size = thumbnails.fit_strip(replace(fit, model_to_scan_mm=far), 2.5)
    picture = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
    assert picture.shape == (size[1], size[0], 3)
    return picture[:, 2 * size[0] // 3 :]


def cloud(fit: StagedFit) -> StagedFit:
    return replace(fit, scan=Mesh(fit.scan.vertices))


def centre(picture: np.ndarray) -> np.ndarray:
    return picture[picture.shape[0] // 2, picture.shape[1] // 2]


def test_distances_to_a_surface_are_red_outside_and_blue_inside(fit: StagedFit) -> None:
    out, within = centre(map_of(fit, 2.0)), centre(map_of(fit, -2.0))
    assert out[0] > out[2] + 40 and within[2] > within[0] + 40


def test_distances_to_points_have_no_sign(fit: StagedFit) -> None:
    assert (map_of(cloud(fit), 2.0) == map_of(cloud(fit), -2.0)).all()
    near, far = centre(map_of(cloud(fit), 0.1)), centre(map_of(cloud(fit), 2.4))
    assert near.sum() > far.sum() + 150


@pytest.mark.parametrize("points", [False, True])
def test_what_the_scan_does_not_show_is_grey(fit: StagedFit, points: bool) -> None:
    middle = centre(map_of(cloud(fit) if points else fit, np.nan))
    assert np.ptp(middle) < 14 and middle.mean() < 220
