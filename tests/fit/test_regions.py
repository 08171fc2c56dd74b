"""Which vertices followed the scan: a hole, a border and a lump are told apart."""

import numpy as np
import pytest

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import BORDER, FOLLOWED, REGIONS, REJECTED, UNSEEN
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, blob_model, sphere

Z = np.array([0.5, -0.5, 0.3, 0.0, 0.2])
HOLE, LUMP = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
HALF_ANGLE = 0.45


def scan_with_a_hole_and_a_lump() -> Mesh:
    d, faces = sphere(6000, 0.7)
    vertices = blob(d, Z)
    lump = np.arccos(d @ LUMP) < HALF_ANGLE
    vertices[lump] *= 1.12
    outside = np.arccos(d @ HOLE) > HALF_ANGLE
    return Mesh(vertices, faces[outside[faces].all(axis=1)], name="lumpy")


def angle_to(vertices: FloatArray, direction: FloatArray) -> FloatArray:
    return np.arccos(vertices @ direction / np.linalg.norm(vertices, axis=1))


@pytest.mark.parametrize("cloud", [False, True])
def test_a_hole_is_unseen_and_a_lump_is_rejected(cloud: bool) -> None:
    scan, model = scan_with_a_hole_and_a_lump(), blob_model(vertices=3000)
    if cloud:
        scan = Mesh(scan.vertices[np.unique(scan.faces)], name="cloud")
    result = fit_scan(model, scan)
    regions = result.regions
    assert regions.shape == (len(model.mean_vertices),)
    d = sphere(len(model.mean_vertices))[0]
    inside_hole, inside_lump = angle_to(d, HOLE) < 0.5 * HALF_ANGLE, angle_to(d, LUMP) < 0.55 * HALF_ANGLE
    elsewhere = (angle_to(d, HOLE) > 1.4 * HALF_ANGLE) & (angle_to(d, LUMP) > 1.4 * HALF_ANGLE)
    assert (regions[inside_hole] == UNSEEN).mean() > 0.9
    assert (regions[inside_lump] == REJECTED).mean() > 0.9
    assert (regions[elsewhere] == FOLLOWED).mean() > 0.97
    if not cloud:
        at_border = np.abs(angle_to(d, HOLE) - HALF_ANGLE) < 0.12
        assert (regions[at_border] == BORDER).any()


def test_the_papers_method_follows_everything_and_says_so() -> None:
    result = fit_scan(
        blob_model(vertices=3000), scan_with_a_hole_and_a_lump(), FitConfig(method="paper", max_iterations=5)
    )
    assert (result.regions == FOLLOWED).all()
    assert REGIONS[FOLLOWED] == "followed"
