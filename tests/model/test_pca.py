import subprocess
import sys

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.model.pca import modes_for_variance, principal_components
from shapespace.types import FloatArray


def low_rank(n: int, d: int, rank: int, seed: int = 0, offset: float = 0.0, noise: float = 0.0) -> FloatArray:
    rng = np.random.default_rng(seed)
    modes = np.linalg.qr(rng.standard_normal((d, rank)))[0] * np.geomspace(30, 1, rank) * np.sqrt(d)
    return rng.standard_normal((n, rank)) @ modes.T + noise * rng.standard_normal((n, d)) + offset


def svd_modes(data: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the variances and the modes (D, R) by the SVD of the centred shapes."""
    _, s, Vt = np.linalg.svd(data - data.mean(axis=0), full_matrices=False)
    return s**2 / (len(data) - 1), Vt.T


CASES = {
    "more coordinates than shapes": low_rank(20, 300, 8, noise=0.1),
    "more shapes than coordinates": low_rank(60, 9, 5, noise=0.5),
    "square": low_rank(30, 30, 30),
    "two shapes": low_rank(2, 30, 3),
    "three coordinates": low_rank(7, 3, 3),
    "off the origin": low_rank(20, 300, 8, noise=0.1, offset=1e3),
    "just near enough to be centred in the Gram matrix": low_rank(20, 300, 8, noise=0.1, offset=2.5e3),
    "just too far for that": low_rank(20, 300, 8, noise=0.1, offset=2e4),
    "far from the origin": low_rank(20, 300, 8, noise=0.1, offset=1e6),
    "more than one block, far away": low_rank(12, 3000, 5, noise=0.1, offset=-1e6),
    "repeated shapes": np.repeat(low_rank(6, 90, 5), 3, axis=0),
    "rank deficient": low_rank(25, 120, 4),
    "rank deficient off the origin": low_rank(25, 120, 4, offset=3e4),
    "rank deficient, far from the origin": low_rank(25, 120, 4, offset=1e6),
    "in metres": 1e-3 * low_rank(20, 300, 8, noise=0.1),
    "one shape unlike the others": np.vstack([np.zeros((9, 30)), np.ones((1, 30))]),
}


@pytest.mark.parametrize("case", CASES)
def test_modes_are_those_of_the_svd(case: str) -> None:
    data = CASES[case]
    pc = principal_components(data)
    variance, modes = svd_modes(data)
    rounding = (np.finfo(float).eps * np.abs(data).max()) ** 2 * data.size
    rank = int((variance > max(1e-10 * variance[0], 100 * rounding)).sum())
    assert pc.basis.shape == (data.shape[1], rank)
    assert np.allclose(pc.variance, variance[:rank], rtol=1e-6, atol=1e-9 * variance[0])
    assert np.allclose(pc.mean, data.mean(axis=0), rtol=1e-13)
    assert pc.total_variance == pytest.approx(variance.sum(), rel=1e-9)
    assert pc.n_samples == len(data)
    # The whole subspace, and each mode where its variance stands alone.
    scale = 1e-7 if np.abs(data).max() < 1e5 else 1e-5
    assert np.abs(pc.basis @ (pc.basis.T @ modes[:, :rank]) - modes[:, :rank]).max() < scale
    for k in range(rank):
        gaps = np.abs(np.delete(variance[:rank], k) - variance[k])
        if k and gaps.size and gaps.min() > 0.1 * variance[k]:
            assert abs(abs(pc.basis[:, k] @ modes[:, k]) - 1) < 1e-9


@pytest.mark.parametrize("case", CASES)
def test_the_basis_is_orthonormal_to_rounding(case: str) -> None:
    basis = principal_components(CASES[case]).basis
    assert np.abs(basis.T @ basis - np.eye(basis.shape[1])).max() < 1e-12


def test_faint_modes_are_orthonormal_too() -> None:
    rng = np.random.default_rng(3)
    modes = np.linalg.qr(rng.standard_normal((600, 12)))[0]
    data = rng.standard_normal((40, 12)) * np.geomspace(100, 2e-3, 12) @ modes.T
    pc = principal_components(data)
    assert pc.basis.shape[1] == 12
    assert np.abs(pc.basis.T @ pc.basis - np.eye(12)).max() < 1e-12
    assert np.allclose(pc.variance, svd_modes(data)[0][:12], rtol=1e-4)


@pytest.mark.parametrize("modes", [1, 3, 0.9, None])
def test_scores_of_the_training_shapes_are_uncorrelated_with_the_variance_stated(modes: float | None) -> None:
    data = low_rank(30, 200, 9, noise=0.2)
    pc = principal_components(data, modes)
    b = (data - pc.mean) @ pc.basis
    assert np.allclose(np.atleast_2d(np.cov(b.T, ddof=1)), np.diag(pc.variance), atol=1e-8 * pc.variance[0])
    assert np.allclose(b.mean(axis=0), 0, atol=1e-9 * np.sqrt(pc.variance[0]))


def test_the_divisor_is_n_minus_1() -> None:
    data = low_rank(12, 60, 5, noise=1.0)
    pc = principal_components(data)
    covariance = np.cov(data.T, ddof=1)
    assert np.allclose(covariance @ pc.basis, pc.basis * pc.variance, atol=1e-9 * pc.variance[0])
    assert pc.total_variance == pytest.approx(np.trace(covariance))
    # As printed, P4 has no divisor and P2 has N: neither is the spread of the shapes.
    assert abs(pc.total_variance - np.trace(np.cov(data.T, ddof=0))) > 0.05 * pc.total_variance
    assert abs(pc.variance[0] / ((data - pc.mean) @ pc.basis[:, 0]).var(ddof=1) - 1) < 1e-9


def test_modes_without_variance_are_dropped() -> None:
    assert principal_components(low_rank(25, 120, 4)).basis.shape[1] == 4
    assert principal_components(low_rank(25, 120, 4), 20).basis.shape[1] == 4
    # Centring takes one: of N - 1 = 5 directions, no more.
    assert principal_components(low_rank(6, 120, 50)).basis.shape[1] == 5


def test_a_mode_is_the_image_of_a_gram_vector_divided_by_its_length() -> None:
    data = low_rank(10, 80, 6, noise=0.3)
    pc = principal_components(data)
    X = (data - data.mean(axis=0)).T
    values, vectors = np.linalg.eigh(X.T @ X)
    for k in range(len(pc.variance)):
        image = X @ vectors[:, -1 - k]
        assert np.linalg.norm(image) == pytest.approx(np.sqrt(values[-1 - k]))
        assert abs(image @ pc.basis[:, k]) / np.linalg.norm(image) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(5))
def test_signs_do_not_depend_on_the_order_of_the_shapes(seed: int) -> None:
    data = low_rank(20, 150, 8, noise=0.1)
    mixed = data[np.random.default_rng(seed).permutation(20)]
    assert np.allclose(principal_components(data).basis, principal_components(mixed).basis, atol=1e-8)


@pytest.mark.parametrize("seed", range(5))
def test_signs_hold_for_modes_that_are_exactly_left_right_symmetric(seed: int) -> None:
    # A wider head moves left and right by the same amount: two largest entries of opposite sign.
    rng = np.random.default_rng(1)
    half = np.linalg.qr(rng.standard_normal((90, 6)))[0] * [9, 7, 5, 4, 3, 2]
    data = rng.standard_normal((20, 6)) @ np.vstack([half, -half]).T
    mixed = data[np.random.default_rng(seed).permutation(20)]
    assert np.allclose(principal_components(data).basis, principal_components(mixed).basis, atol=1e-8)


@pytest.mark.parametrize("case", ["more coordinates than shapes", "far from the origin"])
def test_the_largest_entry_of_a_mode_is_positive(case: str) -> None:
    basis = principal_components(CASES[case]).basis
    assert (basis[np.abs(basis).argmax(axis=0), np.arange(basis.shape[1])] > 0).all()


def test_the_data_are_not_changed() -> None:
    data = low_rank(10, 60, 4, offset=1e6)
    before = data.copy()
    principal_components(data)
    assert np.array_equal(data, before)


@pytest.mark.parametrize("modes", [1, 5, 19])
def test_the_number_of_modes_asked_for_is_the_number_given(modes: int) -> None:
    data = CASES["more coordinates than shapes"]
    some, every = principal_components(data, modes), principal_components(data)
    assert some.basis.shape[1] == modes
    assert np.allclose(some.basis, every.basis[:, :modes], atol=1e-8)
    assert some.total_variance == pytest.approx(every.total_variance)
    assert principal_components(data, np.int64(modes)).basis.shape[1] == modes


@pytest.mark.parametrize(("share", "modes"), [(0.5, 1), (0.79, 2), (0.8, 2), (0.81, 3), (0.9999, 4), (1.0, 4)])
def test_a_share_of_the_variance_takes_the_fewest_modes_that_hold_it(share: float, modes: int) -> None:
    assert modes_for_variance(np.array([5.0, 3.0, 1.5, 0.5]), share) == modes


def test_a_share_of_the_variance_gives_that_share() -> None:
    data = low_rank(30, 200, 9, noise=0.2)
    for share in (0.5, 0.9, 0.985):
        pc = principal_components(data, share)
        assert pc.variance.sum() >= share * pc.total_variance
        assert pc.variance[:-1].sum() < share * pc.total_variance


@pytest.mark.parametrize("share", [0.0, -0.1, 1.01, 98.0, float("nan")])
def test_shares_that_are_none_are_refused(share: float) -> None:
    with pytest.raises(InputError, match="share"):
        principal_components(low_rank(5, 30, 3), share)


@pytest.mark.parametrize("modes", [20, 1000, np.int64(20), True])
def test_as_many_modes_are_kept_as_the_samples_determine(modes: int) -> None:
    data = CASES["more coordinates than shapes"]
    assert principal_components(data, modes).basis.shape[1] == min(modes, 19)


@pytest.mark.parametrize("modes", [0, -1])
def test_fewer_modes_than_one_are_refused(modes: int) -> None:
    with pytest.raises(InputError, match="one mode or more, not"):
        principal_components(CASES["more coordinates than shapes"], modes)


@pytest.mark.parametrize("modes", ["Auto", "5", [3], "auto"])
def test_modes_that_are_no_number_are_refused(modes: object) -> None:
    with pytest.raises(InputError, match="must be an integer"):
        principal_components(low_rank(6, 60, 3), modes)


def test_two_shapes_give_one_mode_along_their_difference() -> None:
    a, b = np.arange(30.0), np.arange(30.0)[::-1].copy()
    pc = principal_components(np.stack([a, b]))
    assert pc.basis.shape == (30, 1)
    assert abs(pc.basis[:, 0] @ (a - b)) == pytest.approx(np.linalg.norm(a - b))
    assert pc.variance[0] == pytest.approx(((a - b) ** 2).sum() / 2)


@pytest.mark.parametrize("n", [0, 1])
def test_fewer_than_two_shapes_are_refused(n: int) -> None:
    with pytest.raises(InputError, match="at least two"):
        principal_components(np.zeros((n, 30)))


@pytest.mark.parametrize("level", [0.0, 1.0, 1e6, 0.1])
def test_equal_shapes_are_refused(level: float) -> None:
    with pytest.raises(InputError, match="all equal"):
        principal_components(np.full((7, 90), level) + np.linspace(0, level, 90))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_without_noise(bad: float) -> None:
    data = low_rank(6, 60, 3)
    data[2, 17] = bad
    with pytest.raises(InputError, match="not finite"):
        principal_components(data)


def test_memory_stays_far_below_the_data() -> None:
    # ru_maxrss is a high-water mark, so a process of its own.
    code = """
import resource, numpy as np
from shapespace.model.pca import principal_components
rng = np.random.default_rng(0)
data = np.empty((200, 60000))
for row in data: row[:] = rng.standard_normal(60000) + OFFSET
principal_components(data[:12, :300], 3)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
principal_components(data, 10)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / data.nbytes)
"""
    for offset in ("0", "1e6"):
        out = subprocess.run(
            [sys.executable, "-c", code.replace("OFFSET", offset)], capture_output=True, text=True, check=True
        )
        assert float(out.stdout) < 0.25
