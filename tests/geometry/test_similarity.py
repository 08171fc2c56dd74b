import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from shapespace.errors import InputError
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, Similarity
from synthetic_shapes import angle_deg, similarity

MIRROR = np.diag([1.0, 1.0, -1.0])


def cloud(n: int = 60, seed: int = 0, spread: tuple[float, float, float] = (80.0, 100.0, 40.0)) -> FloatArray:
    return np.random.default_rng(seed).standard_normal((n, 3)) * spread + (30.0, -200.0, 70.0)


def cost(T: Similarity, p: FloatArray, q: FloatArray, w: FloatArray) -> float:
    return float((w * ((q - T.apply(p)) ** 2).sum(axis=1)).sum())


def assert_same(a: Similarity, b: Similarity, atol: float = 1e-9) -> None:
    assert a.scale == pytest.approx(b.scale, rel=1e-11)
    assert np.allclose(a.rotation, b.rotation, atol=1e-11)
    assert np.allclose(a.translation, b.translation, atol=atol * (1 + np.abs(b.translation).max()))


@pytest.mark.parametrize("degrees", [0.0, 1e-3, 20.0, 90.0, 179.9, 180.0])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 25.4])
def test_a_known_similarity_is_recovered_exactly(degrees: float, scale: float) -> None:
    p, T = cloud(), similarity(3, degrees, scale)
    assert_same(fit_similarity(p, T.apply(p)), T)


@pytest.mark.parametrize("flatten", [(1.0, 1.0, 0.0), (1.0, 0.0, 1.0)])
def test_points_on_a_plane_give_the_right_proper_rotation(flatten: tuple[float, float, float]) -> None:
    turn = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix()
    p = (np.random.default_rng(1).standard_normal((30, 3)) * 50 * flatten) @ turn.T
    for seed in range(10):
        T = similarity(seed, 40.0 * seed % 180, 1.3)
        assert_same(fit_similarity(p, T.apply(p)), T)


def test_three_points_are_enough() -> None:
    T = similarity(5, 70.0, 0.8)
    assert_same(fit_similarity(cloud(3), T.apply(cloud(3))), T)


@pytest.mark.parametrize("seed", range(5))
def test_a_mirrored_target_still_gives_a_proper_rotation_and_the_best_one(seed: int) -> None:
    p = cloud(seed=seed)
    q = similarity(seed, 50.0).apply(p @ MIRROR)
    T = fit_similarity(p, q)
    assert np.linalg.det(T.rotation) == pytest.approx(1.0)
    assert T.scale > 0
    w = np.ones(len(p))
    rng = np.random.default_rng(seed)
    best = cost(T, p, q, w)
    for R in [*Rotation.random(200, random_state=rng).as_matrix(), *Rotation.create_group("O").as_matrix()]:
        other = Similarity(T.scale, R, q.mean(0) - T.scale * R @ p.mean(0))
        assert cost(other, p, q, w) >= best * (1 - 1e-12)


@pytest.mark.parametrize("with_scale", [True, False])
def test_no_other_similarity_is_better(with_scale: bool) -> None:
    rng = np.random.default_rng(2)
    p, w = cloud(), rng.random(60)
    q = similarity(1, 35.0).apply(p) + 5 * rng.standard_normal(p.shape)
    T = fit_similarity(p, q, w, with_scale=with_scale)

    def at(x: FloatArray) -> float:
        R = Rotation.from_rotvec(x[:3]).as_matrix() @ T.rotation
        return cost(Similarity(T.scale * np.exp(x[6] if with_scale else 0.0), R, T.translation + x[3:6]), p, q, w)

    best = at(np.zeros(7))
    start = np.array([0.1, -0.2, 0.15, 4.0, -3.0, 2.0, 0.1])
    found = minimize(at, start, method="BFGS", options={"gtol": 1e-6})
    assert found.fun >= best * (1 - 1e-10)
    assert found.fun == pytest.approx(best, rel=1e-5)
    for step in rng.standard_normal((100, 7)) * 1e-3:
        assert at(step) >= best * (1 - 1e-12)
    assert (T.scale == 1.0) is (not with_scale)


def test_whole_number_weights_mean_repeated_points() -> None:
    rng = np.random.default_rng(3)
    p, times = cloud(20), rng.integers(0, 4, 20)
    q = p @ Rotation.from_rotvec([0.1, 0.9, 0.2]).as_matrix().T + 8 * rng.standard_normal(p.shape)
    again = fit_similarity(np.repeat(p, times, axis=0), np.repeat(q, times, axis=0))
    assert_same(fit_similarity(p, q, times.astype(float)), again)
    assert_same(fit_similarity(p, q, 1e-6 * times), again)
    assert not np.allclose(fit_similarity(p, q).translation, again.translation)


def test_points_without_weight_have_no_say() -> None:
    T, p = similarity(4, 30.0), cloud()
    q = T.apply(p)
    q[::3] += 500.0
    assert_same(fit_similarity(p, q, (np.arange(60) % 3 > 0).astype(float)), T)


def test_far_from_the_origin_nothing_is_lost() -> None:
    T = similarity(6, 25.0, 1.1)
    far = fit_similarity(cloud() + 1e6, T.apply(cloud()) - 1e6)
    assert far.scale == pytest.approx(T.scale, rel=1e-9)
    assert np.allclose(far.rotation, T.rotation, atol=1e-9)


def test_scale_is_least_squares_and_noise_does_not_inflate_it() -> None:
    rng = np.random.default_rng(7)
    p = rng.standard_normal((2000, 3))  # 1 mm structures under 1 mm of noise
    fits, ratios = [], []
    for seed in range(5):
        q = similarity(seed, 20.0, 1.3).apply(p) + rng.standard_normal(p.shape)
        fits.append(fit_similarity(p, q).scale)
        ratios.append(float(np.linalg.norm(q - q.mean(0)) / np.linalg.norm(p - p.mean(0))))
    assert np.mean(fits) == pytest.approx(1.3, abs=0.02)
    assert np.mean(ratios) > 1.5


def test_eq_15_as_printed_turns_the_wrong_way() -> None:
    p, T = cloud(), similarity(8, 40.0, 1.0)
    q, q_prime = p - p.mean(0), T.apply(p) - T.apply(p).mean(0)
    U, _, Vt = np.linalg.svd(q.T @ q_prime)  # P12-P13
    printed = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    assert np.allclose(printed, T.rotation.T)
    assert angle_deg(printed @ T.rotation.T) == pytest.approx(80.0)
    assert angle_deg(fit_similarity(p, T.apply(p)).rotation @ T.rotation.T) < 1e-6


@pytest.mark.parametrize("mirrored", [False, True])
def test_eq_16_needs_the_smallest_singular_value_last(mirrored: bool) -> None:
    p = cloud()
    q = (p - p.mean(0)) @ (MIRROR if mirrored else np.eye(3))
    U, _, Vt = np.linalg.svd((p - p.mean(0)).T @ q)
    X = Vt.T @ U.T
    assert np.sign(np.linalg.det(X)) == (-1 if mirrored else 1)
    best = cost(fit_similarity(p, q), p, q, np.ones(60))
    s = fit_similarity(p, q).scale
    for flipped in range(3) if mirrored else ():
        Z = np.ones(3)
        Z[flipped] = -1
        R = (Vt.T * Z) @ U.T
        assert cost(Similarity(s, R, -s * R @ p.mean(0)), p, q, np.ones(60)) >= best * (1 - 1e-12)


def test_eq_17_as_printed_forgets_the_scale() -> None:
    p, T = cloud(), similarity(9, 10.0, 1.3)
    printed = T.apply(p).mean(0) - T.rotation @ p.mean(0)
    assert np.linalg.norm(printed - T.translation) == pytest.approx(0.3 * np.linalg.norm(p.mean(0)))
    assert np.allclose(fit_similarity(p, T.apply(p)).translation, T.translation)


def test_eq_18_as_printed_depends_on_the_origin() -> None:
    p, T = cloud(), similarity(10, 60.0, 1.3)

    def printed(offset: float) -> float:
        P, R = (p + offset).T, T.rotation
        return float(np.trace(P @ P.T @ R) / np.trace(P @ P.T))  # one prime lost: the target does not even occur

    assert abs(printed(0.0) - 1.3) > 0.1
    assert abs(printed(0.0) - printed(1000.0)) > 0.01
    for offset in (0.0, 1000.0):
        assert fit_similarity(p + offset, T.apply(p)).scale == pytest.approx(1.3)


@pytest.mark.parametrize(
    "points",
    [np.outer(np.arange(9.0), [1.0, 2.0, -1.0]) + 1e3, np.full((9, 3), 4.0), cloud(2), cloud(1), np.zeros((0, 3))],
    ids=["line", "one place", "two points", "one point", "no points"],
)
def test_points_that_determine_no_rotation_are_refused(points: FloatArray) -> None:
    with pytest.raises(InputError, match=r"line|three points"):
        fit_similarity(points, points + 1.0)
    if len(points) > 2:
        with pytest.raises(InputError, match="line"):
            fit_similarity(cloud(9), points)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad: float) -> None:
    p = cloud()
    p[3, 1] = bad
    for pair in ((p, cloud()), (cloud(), p)):
        with np.errstate(invalid="ignore"), pytest.raises(InputError, match="finite"):
            fit_similarity(*pair)


def test_shapes_and_weights_that_do_not_fit_are_refused() -> None:
    with pytest.raises(InputError, match="same shape"):
        fit_similarity(cloud(5), cloud(6))
    for weights in (np.ones(59), -np.ones(60), np.full(60, np.nan)):
        with pytest.raises(InputError, match="weights"):
            fit_similarity(cloud(), cloud(), weights)
    with pytest.raises(InputError, match="positive weight"):
        fit_similarity(cloud(), cloud(), np.zeros(60))


def test_composition_and_inverse_do_what_applying_does() -> None:
    p, A, B = cloud(), similarity(11, 100.0, 0.3), similarity(12, 50.0, 7.0)
    assert np.allclose((A @ B).apply(p), A.apply(B.apply(p)))
    assert np.allclose(A.inverse().apply(A.apply(p)), p)
    assert_same(A @ A.inverse(), Similarity.identity(), 1e-12)
    assert np.allclose(A.apply(p[0]), A.apply(p)[0])


@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf])
def test_a_similarity_has_a_positive_scale_and_a_rotation(scale: float) -> None:
    with pytest.raises(InputError, match="scale"):
        Similarity(scale, np.eye(3), np.zeros(3))
    for matrix in (MIRROR, 2 * np.eye(3), np.zeros((3, 3))):
        with pytest.raises(InputError, match="rotation"):
            Similarity(1.0, matrix, np.zeros(3))
