"""Principal components of shapes on a disk are those of the same shapes in memory."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import FileFormatError, InputError
from shapespace.io.containers import row_spill as spill
from shapespace.io.containers.row_spill import Spill
from shapespace.model import krylov, pca
from shapespace.model.krylov import Stop, leading
from shapespace.model.pca import PrincipalComponents, principal_components
from shapespace.types import FloatArray

RADIANS = 1e-6


def shapes(n: int = 700, d: int = 900, power: float = 1.5, noise: float = 0.05, offset: float = 0.3) -> FloatArray:
    """Return (n, d) in single precision: modes whose variance falls as a power, noise, and a mean that is not 0."""
    rng = np.random.default_rng(0)
    modes = np.linalg.qr(rng.standard_normal((d, min(d, 120))))[0].T
    stddev = 50.0 * np.arange(1, len(modes) + 1) ** (-power / 2)
    data = (rng.standard_normal((n, len(modes))) * stddev) @ modes + noise * rng.standard_normal((n, d)) + offset
    return data.astype(np.float32).astype(np.float64)


def on_disk(path: Path, data: FloatArray) -> Spill:
    table = Spill(path / "shapes.f32", *data.shape, new=True)
    for start in range(0, len(data), 97):
        table.write_rows(start, data[start : start + 97])
    return table


def angles(a: PrincipalComponents, b: PrincipalComponents) -> FloatArray:
    """Return the angle (K,) between the modes of a and b, signs included."""
    return np.asarray(2 * np.arcsin(np.linalg.norm(a.basis - b.basis, axis=0) / 2), dtype=np.float64)


@pytest.fixture(params=["gram", "krylov"])
def method(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    if request.param == "krylov":
        monkeypatch.setattr(pca, "EXACT", 10)
    return str(request.param)


@pytest.mark.parametrize(("power", "noise"), [(1.0, 0.2), (1.5, 0.05), (2.0, 0.02)])
def test_modes_are_those_of_the_exact_method(method: str, power: float, noise: float, tmp_path: Path) -> None:
    data = shapes(power=power, noise=noise)
    there = principal_components(data, 40)
    with on_disk(tmp_path, data) as table:
        found = principal_components(table, 40)
    assert angles(found, there).max() < RADIANS
    assert np.allclose(found.variance, there.variance, rtol=1e-9)
    assert np.allclose(found.mean, there.mean, atol=1e-12)
    assert found.total_variance == pytest.approx(there.total_variance, rel=1e-10)
    assert found.n_samples == len(data)
    assert np.abs(found.basis.T @ found.basis - np.eye(40)).max() < 1e-12


def test_the_residuals_are_those_of_the_covariance(method: str, tmp_path: Path) -> None:
    data = shapes(300, 200)
    with on_disk(tmp_path, data) as table:
        found = principal_components(table, 12)
    C = np.cov(data.T)
    true = np.linalg.norm(C @ found.basis - found.basis * found.variance, axis=0)
    assert found.residuals is not None
    assert np.allclose(found.residuals, true, atol=1e-13 * found.variance[0])
    assert found.residuals.max() <= 1e-6 * found.variance[0]


def test_a_mode_that_is_off_has_a_residual_that_says_so() -> None:
    # One product with a block of the size asked for cannot be enough.
    C = np.diag(np.arange(1.0, 101.0)[::-1])
    loose = Stop(radians=1.0, least_gap=1.0, enough=1.0)
    found = leading(lambda Q: C @ Q, 100, 3, float(C.trace()), block=4, most_columns=100, stop=loose)
    assert found is not None
    true = np.linalg.norm(C @ found.vectors - found.vectors * found.values, axis=0)
    assert np.allclose(found.residuals, true) and found.residuals.max() > 1e-6 * 100


@pytest.mark.parametrize("share", [0.5, 0.9, 0.97])
def test_a_share_of_the_variance_takes_as_many_modes_as_in_memory(method: str, share: float, tmp_path: Path) -> None:
    data = shapes(300, 400)
    with on_disk(tmp_path, data) as table:
        found = principal_components(table, share)
    there = principal_components(data, share)
    assert found.basis.shape == there.basis.shape
    assert angles(found, there).max() < RADIANS


def test_the_first_modes_of_a_large_gram_matrix_are_those_of_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = shapes(400, 300)
    monkeypatch.setattr(pca, "_WHOLE", 100)
    with on_disk(tmp_path, data) as table:
        found = principal_components(table, 20)
    assert angles(found, principal_components(data, 20)).max() < RADIANS


def test_shapes_of_few_directions_give_no_more_modes(method: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    data = rng.standard_normal((200, 5)) @ rng.standard_normal((5, 90))
    with on_disk(tmp_path, data) as table:
        found = principal_components(table, 20)
    assert found.basis.shape == (90, 5)
    assert angles(found, principal_components(data.astype(np.float32).astype(float), 5)).max() < RADIANS


def test_all_modes_of_few_shapes_are_found(tmp_path: Path) -> None:
    data = shapes(30, 90)
    with on_disk(tmp_path, data) as table:
        assert angles(principal_components(table, None), principal_components(data)).max() < 1e-5


def test_all_modes_of_many_shapes_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "EXACT", 10)
    with on_disk(tmp_path, shapes(30, 90)) as table, pytest.raises(InputError, match="All modes of 30 shapes"):
        principal_components(table, None)


def test_modes_that_memory_does_not_hold_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "available_bytes", lambda: 10_000)
    with on_disk(tmp_path, shapes(30, 90)) as table, pytest.raises(InputError, match="20 modes of 30 vertices take"):
        principal_components(table, 20)


def test_a_basis_that_may_not_grow_enough_ends_in_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "EXACT", 10)
    monkeypatch.setattr(pca, "_BASIS_BYTES", 8 * 900 * 40)
    with on_disk(tmp_path, shapes()) as table, pytest.raises(InputError, match="in 40 directions"):
        principal_components(table, 0.9999)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(bad: float, tmp_path: Path) -> None:
    data = shapes(20, 60)
    data[3, 5] = bad
    with on_disk(tmp_path, data) as table, pytest.raises(InputError, match="not finite"):
        principal_components(table, 3)


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_equal_shapes_are_refused(level: float, tmp_path: Path) -> None:
    with on_disk(tmp_path, np.full((9, 60), level)) as table, pytest.raises(InputError, match="all equal"):
        principal_components(table, 3)


@pytest.mark.parametrize("share", [0.0, 1.5])
def test_shares_that_are_none_are_refused(share: float, tmp_path: Path) -> None:
    with on_disk(tmp_path, shapes(20, 60)) as table, pytest.raises(InputError, match="A share of the variance"):
        principal_components(table, share)


def test_two_runs_are_the_same_to_the_bit(method: str, tmp_path: Path) -> None:
    with on_disk(tmp_path, shapes(300, 300)) as table:
        first, second = (principal_components(table, 15, seed=3) for _ in range(2))
    assert np.array_equal(first.basis, second.basis) and np.array_equal(first.variance, second.variance)


def test_a_run_that_was_stopped_goes_on_with_its_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "EXACT", 10)
    data, kept = shapes(), tmp_path
    with on_disk(tmp_path, data) as table:
        undisturbed = principal_components(table, 30)

        def stop(number: int, share: float) -> None:
            if number == 3:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            principal_components(table, 30, passes=kept, on_pass=stop)
        assert len(list(tmp_path.glob("pass-*.npz"))) == 3
        # A pass that is cut short is made again.
        third = tmp_path / "pass-003.npz"
        third.write_bytes(third.read_bytes()[:-100])
        products: list[int] = []
        covariance = pca.Covariance.__call__

        def counted(self: pca.Covariance, Q: FloatArray) -> FloatArray:
            products.append(Q.shape[1])
            return covariance(self, Q)

        monkeypatch.setattr(pca.Covariance, "__call__", counted)
        passes: list[int] = []
        again = principal_components(table, 30, passes=kept, on_pass=lambda number, share: passes.append(number))
    assert np.array_equal(again.basis, undisturbed.basis)
    # Two of the passes were kept, and the last product is that of the residuals.
    assert len(products) == passes[-1] - 2 + 1


def traced_peak(function: Callable[[], object]) -> int:
    """Return the largest number of bytes that Python had allocated during a call."""
    tracemalloc.start()
    function()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak


def test_memory_does_not_grow_with_the_shapes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "EXACT", 10)
    monkeypatch.setattr(spill, "_BLOCK_BYTES", 1 << 20)
    peaks: list[int] = []
    for n in (2000, 8000):
        data = np.random.default_rng(0).standard_normal((n, 300)) * np.geomspace(30, 0.1, 300)
        with on_disk(tmp_path, data) as table:
            principal_components(table, 3)  # what scipy loads
            # Other threads of the tests may allocate during one of the runs.
            peaks.append(min(traced_peak(lambda table=table: principal_components(table, 3)) for _ in range(3)))
    assert peaks[1] < 1.1 * peaks[0]
    assert peaks[1] < 0.5 * data.nbytes


@pytest.mark.parametrize("panel", [7, 64, 1024])
def test_what_is_written_is_read_back_by_rows_and_by_columns(
    panel: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spill, "_PANEL", panel)
    data = shapes(150, 100)
    with on_disk(tmp_path, data) as table:
        assert np.array_equal(np.hstack(list(table.column_blocks())), data)
        assert np.array_equal(np.vstack([block for _, block in table.row_blocks()]), data)
        assert np.array_equal(table.rows_from(31, 32), data[31:32])
        assert table.path.stat().st_size == 4 * data.size


def test_a_file_of_another_size_is_refused(tmp_path: Path) -> None:
    on_disk(tmp_path, shapes(10, 30)).close()
    with pytest.raises(FileFormatError, match="1200 bytes long, not 1320"):
        Spill(tmp_path / "shapes.f32", 11, 30, new=False)


def test_directions_that_are_rounding_are_not_blown_up() -> None:
    rng = np.random.default_rng(0)
    basis = [np.linalg.qr(rng.standard_normal((50, 5)))[0]]
    W = rng.standard_normal((50, 2)) @ np.array([[1.0, 1.0, 0.0], [0.0, 1e-16, 1.0]])
    W -= basis[0] @ (basis[0].T @ W)
    Q, beyond = krylov._orthonormalise(W, basis, 1e-13)
    assert Q.shape == (50, 2) and np.allclose(Q @ beyond, W)
    assert np.abs(basis[0].T @ Q).max() < 1e-14
