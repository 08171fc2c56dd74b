"""Two in one scan are told: side by side in a note, on top of each other in a doubt; nothing else is taken for it."""

import numpy as np
import pytest

from shapespace.datasets.simulated_scan import simulate_scan
from shapespace.fit.diagnostics.trust import doubts_of_layers
from shapespace.fit.fit_scan import fit_scan
from shapespace.fit.result import FitResult
from shapespace.types import Mesh
from synthetic_shapes import blob_model, sphere

FIRST, SECOND = np.array([0.5, -0.5, 1.0, 0.0, 0.3]), np.array([-0.8, 0.6, -0.5, 1.0, -1.2])


def scanned(z: np.ndarray, *, noise_mm: float = 0.2, outliers: float = 0.0) -> Mesh:
    model = blob_model()
    rng = np.random.default_rng(0)
    shape = model.mesh(z * model.stddev)
    return simulate_scan(shape, rng, triangles=6_000, noise_mm=noise_mm, outlier_fraction=outliers).scan


def both(first: Mesh, second: Mesh, *, points: bool = False) -> Mesh:
    vertices = np.concatenate([first.vertices, second.vertices])
    if points:
        return Mesh(vertices)
    return Mesh(vertices, np.concatenate([first.faces, second.faces + len(first.vertices)]).astype(np.int32))


def beside(second: Mesh) -> FitResult:
    moved = second.with_vertices(second.vertices + np.array([260.0, 20.0, 10.0]))
    return fit_scan(blob_model(), both(scanned(FIRST), moved))


def said(result: FitResult) -> list[str]:
    return [note for note in result.notes if "second instance" in note]


def test_a_second_one_beside_the_first_is_noted_with_its_distance() -> None:
    (note,) = said(beside(scanned(SECOND)))
    assert "26" in note.split(" mm away")[0]


def test_a_ball_of_its_size_beside_it_is_no_second_one() -> None:
    d, faces = sphere(2_000)
    assert said(beside(Mesh(85.0 * d, faces))) == []


@pytest.mark.parametrize("points", [False, True])
def test_two_on_top_of_each_other_are_doubted(points: bool) -> None:
    result = fit_scan(blob_model(), both(scanned(FIRST), scanned(SECOND), points=points))
    assert result.status == "doubtful" and "two surfaces on top of each other" in result.reason


@pytest.mark.parametrize("how", [{"noise_mm": 3.0}, {"outliers": 0.4}, {}])
def test_noise_and_outliers_are_no_second_surface(how: dict[str, float]) -> None:
    result = fit_scan(blob_model(), scanned(FIRST, **how))
    assert doubts_of_layers(result.evidence) == [] and said(result) == []
