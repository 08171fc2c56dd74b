import numpy as np
import pytest
from scipy.interpolate import BSpline

from shapespace.errors import InputError
from shapespace.geometry.bspline import DEGREE, SplineSquare, thin_plate_energy


def knots(count: int) -> np.ndarray:
    return np.concatenate([np.zeros(DEGREE), np.linspace(0, 1, count - DEGREE + 1), np.ones(DEGREE)])


def places(count: int = 400, seed: int = 0) -> np.ndarray:
    uv = np.random.default_rng(seed).random((count, 2))
    uv[:4] = [[0, 0], [1, 1], [0.5, 1], [1, 0.25]]  # corners and knots
    return uv


@pytest.mark.parametrize("counts", [(4, 4), (7, 5), (12, 24)])
def test_values_are_the_tensor_product_of_one_dimensional_splines(counts: tuple[int, int]) -> None:
    uv = places()
    control = np.random.default_rng(1).standard_normal((counts[0] * counts[1], 3))
    grid = control.reshape(*counts, 3)
    along_v = np.stack([BSpline(knots(counts[1]), grid[i], DEGREE)(uv[:, 1]) for i in range(counts[0])])
    expected = np.stack([BSpline(knots(counts[0]), along_v[:, p], DEGREE)(uv[p, 0]) for p in range(len(uv))])
    np.testing.assert_allclose(SplineSquare(uv, counts).values(control), expected, atol=1e-12)


def test_a_spline_is_found_again_from_its_values() -> None:
    spline = SplineSquare(places(2000), (8, 6))
    control = np.random.default_rng(2).standard_normal((48, 3))
    np.testing.assert_allclose(spline.fit(spline.values(control)), control, atol=5e-3)


def test_planes_are_held_whatever_the_smoothness_and_wherever_vertices_are_missing() -> None:
    uv = places()
    plane = np.column_stack([3 * uv[:, 0] - uv[:, 1] + 2, uv[:, 1], 0 * uv[:, 0] + 7])
    there = (uv[:, 0] < 0.4).astype(float)
    spline = SplineSquare(uv, (10, 10), smoothness=1e-3)
    np.testing.assert_allclose(spline.values(spline.fit(plane)), plane, atol=1e-7)
    np.testing.assert_allclose(
        spline.values(spline.fit(np.where(there[:, None] > 0, plane, 0), there)), plane, atol=1e-5
    )


def test_the_energy_is_the_integral_of_the_squared_second_derivatives() -> None:
    counts = (6, 9)
    control = np.random.default_rng(3).standard_normal(54)
    energy = control @ thin_plate_energy(counts) @ control
    n = 800
    middle = (np.arange(n) + 0.5) / n

    def along(count: int, order: int) -> np.ndarray:
        return BSpline(knots(count), np.eye(count), DEGREE)(middle, order)

    grid = control.reshape(counts)
    second = [
        weight * (along(6, du) @ grid @ along(9, dv).T) ** 2 for weight, du, dv in ((1, 2, 0), (2, 1, 1), (1, 0, 2))
    ]
    assert energy == pytest.approx(np.sum(second) / n**2, rel=1e-4)


def test_the_fit_is_where_the_stated_cost_is_least() -> None:
    uv, rng = places(300), np.random.default_rng(4)
    values, weights, smoothness = rng.standard_normal((300, 2)), rng.random(300), 1e-4
    spline = SplineSquare(uv, (7, 7), smoothness)
    E = thin_plate_energy((7, 7))

    def cost(c: np.ndarray) -> float:
        misfit = (weights[:, None] * (spline.values(c) - values) ** 2).sum()
        return float(misfit + smoothness * len(uv) * np.trace(c.T @ E @ c))

    best = spline.fit(values, weights)
    for _ in range(20):
        assert cost(best + 1e-3 * rng.standard_normal(best.shape)) > cost(best)


@pytest.mark.parametrize("counts", [(3, 8), (8, 65), (0, 0), (8,), (8, 8, 8)])
def test_numbers_of_control_points_that_cannot_be_are_refused(counts: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="4 to 64 control points along each"):
        SplineSquare(places(), counts)


@pytest.mark.parametrize("uv", [places() * 1.5, np.full((5, 2), np.nan), np.zeros((5, 3)), np.zeros((0, 2))])
def test_places_off_the_square_are_refused(uv: np.ndarray) -> None:
    with pytest.raises(InputError, match="unit square"):
        SplineSquare(uv, (8, 8))


def test_too_few_values_are_refused() -> None:
    weights = np.zeros(400)
    weights[:2] = 1.0
    with pytest.raises(InputError, match="too few"):
        SplineSquare(places(), (5, 5)).fit(np.zeros((400, 3)), weights)
