"""Covariation: against geomorph, plain singular value decompositions and resampling, and null simulations."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.landmark_alignment import align_landmarks
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.report.analyses.result_report import shape_test_report
from shapespace.statistics.shape_tests.covariation import compare_effect_sizes, estimate_modularity, fit_pls
from shapespace.statistics.shape_tests.permutations import orders
from shapespace.statistics.shape_tests.shape_test_result import Statistic
from shapespace.types import SurfaceLandmarks

EXACT = 1e-6
"""Relative tolerance of statistics of geomorph."""
MONTE_CARLO = 0.35
"""Of Z at 999 and 9,999 permutations, as in test_effect_size."""


def aligned(flat: list[list[float]], columns: dict[str, list[float]] | None = None) -> Cohort:
    points = np.array(flat, dtype=np.float64).reshape(len(flat), -1, 2)
    texts = {name: tuple(map(repr, values)) for name, values in (columns or {}).items()}
    names = tuple(f"s{k}" for k in range(len(flat)))
    return Cohort.of_landmarks(align_landmarks(LandmarkConfigurations(names=names, points=points, columns=texts)))


def cohort_of(shapes: np.ndarray[Any, Any], columns: dict[str, Any] | None = None) -> Cohort:
    full = np.zeros((*shapes.shape[:2], 3))
    full[..., : shapes.shape[2]] = shapes
    return Cohort.of_shapes(full, columns or {}, align=False, unit="mm")


def correlated(seed: int, n: int = 20, points: int = 9, dimensions: int = 3) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(seed)
    size = points * dimensions
    values = rng.normal(size=(n, 3)) @ rng.normal(size=(3, size)) + rng.normal(size=(n, size))
    return values.reshape(n, points, dimensions)


def written(folder: Path, modules: str, head: str = "landmark") -> Path:
    """Return a table of modules, a letter for each point in order; a dash for none."""
    path = folder / "modules.csv"
    first = int(head == "landmark")
    rows = [f"{k + first},{name}" for k, name in enumerate(modules) if name != "-"]
    path.write_text("\n".join([f"{head},module", *rows]) + "\n")
    return path


def plain_r(x: np.ndarray[Any, Any], y: np.ndarray[Any, Any]) -> float:
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    u, _, vt = np.linalg.svd(x.T @ y)
    return float(np.corrcoef(x @ u[:, 0], y @ vt[0])[0, 1])


def plain_cr(shapes: np.ndarray[Any, Any], modules: str, degrees: float) -> list[float]:
    """Return CR of each pair, from covariance matrices of rotated coordinates with zeros on their diagonals."""
    turn = np.eye(shapes.shape[2])
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    turn[:2, :2] = [[c, -s], [s, c]]
    flat = (shapes @ turn).reshape(len(shapes), -1)
    owner = np.repeat(list(modules), shapes.shape[2])
    cov = np.cov(flat.T)
    without = cov - np.diag(np.diagonal(cov))
    out = []
    for a, b in itertools.combinations(sorted(set(modules)), 2):
        between = (cov[np.ix_(owner == a, owner == b)] ** 2).sum()
        within = [(without[np.ix_(owner == k, owner == k)] ** 2).sum() for k in (a, b)]
        out.append(math.sqrt(between / math.sqrt(within[0] * within[1])))
    return out


def test_published_partial_least_squares_of_food_are_reproduced(geomorph_reference: dict[str, Any]) -> None:
    table, expected = geomorph_reference["food_table"], geomorph_reference["food_pls"]
    found = fit_pls(aligned(geomorph_reference["food_raw"], table), columns=tuple(table), permutations=2000)
    test = found.statistic("r-PLS")
    assert test.value == pytest.approx(expected["r"][0], rel=EXACT)
    np.testing.assert_allclose(found.arrays["pls.npz"]["singular_values"], expected["svd"], rtol=EXACT)
    assert test.p == 1 / 2000 and test.z == pytest.approx(expected["z"][0], abs=MONTE_CARLO)


def test_published_integration_and_modularity_of_plethodon_are_reproduced(
    geomorph_reference: dict[str, Any], tmp_path: Path
) -> None:
    # Modules of the examples of geomorph.
    cohort, modules = aligned(geomorph_reference["plethodon_raw"]), written(tmp_path, "AAAAABBBBBBB")
    expected = geomorph_reference["plethodon_integration"]
    test = fit_pls(cohort, modules=modules, permutations=2000).statistic("r-PLS")
    assert test.value == pytest.approx(expected["r"][0], rel=EXACT) and test.p == 1 / 2000
    assert test.z == pytest.approx(expected["z"][0], abs=MONTE_CARLO)
    expected = geomorph_reference["plethodon_modularity"]
    test = estimate_modularity(cohort, modules=modules, permutations=2000).statistic("CR")
    assert test.value == pytest.approx(expected["CR"][0], rel=EXACT)
    assert test.p == pytest.approx(expected["p"][0], abs=0.06)  # 3 standard errors of 999 and 2,000 permutations


@pytest.mark.parametrize("widths", [2, 40], ids=["few columns", "more columns than shapes"])
def test_r_of_each_permutation_is_that_of_a_singular_value_decomposition(widths: int) -> None:
    shapes = correlated(1)
    rng = np.random.default_rng(2)
    columns = {f"c{k}": list(rng.normal(size=20) * (1 + k)) for k in range(widths)}
    found = fit_pls(cohort_of(shapes, columns), columns=tuple(columns), permutations=12, seed=3)
    block, flat = np.column_stack(list(columns.values())), shapes.reshape(20, -1)
    rows = next(orders(20, 12, 3))[1]
    expected = [plain_r(block[order], flat) for order in rows]
    np.testing.assert_allclose(found.statistic("r-PLS").arrangements, expected, rtol=1e-7)


def test_scores_are_projections_on_the_loadings_and_covary_by_the_singular_values(tmp_path: Path) -> None:
    shapes = correlated(4)
    columns = {"a": list(shapes[:, 0, 0] * 3), "b": list(shapes[:, 5, 1]), "c": list(range(20))}
    found = fit_pls(cohort_of(shapes, columns), columns=tuple(columns), permutations=5)
    arrays = found.arrays["pls.npz"]
    block = np.column_stack(list(columns.values()))
    flat = shapes.reshape(20, -1)
    np.testing.assert_allclose(arrays["scores_1"], (block - block.mean(axis=0)) @ arrays["loadings_1"], atol=1e-9)
    np.testing.assert_allclose(arrays["scores_2"], (flat - flat.mean(axis=0)) @ arrays["loadings_2"], atol=1e-9)
    covariance = arrays["scores_1"].T @ arrays["scores_2"] / 19
    np.testing.assert_allclose(covariance, np.diag(arrays["singular_values"]), atol=1e-9)
    assert len(found.table("Scores").rows) == 20 and found.table("Pairs of axes").rows[0][3] == pytest.approx(
        found.statistic("r-PLS").value
    )
    shape_test_report(found).save(tmp_path / "pls")
    assert {"statistics.csv", "scores.csv", "pairs_of_axes.csv"} <= {path.name for path in (tmp_path / "pls").iterdir()}


def test_integration_of_three_modules_is_the_mean_of_pairs_of_which_the_first_is_permuted(tmp_path: Path) -> None:
    shapes = correlated(5)
    found = fit_pls(cohort_of(shapes), modules=written(tmp_path, "AABBBCCCC"), permutations=7, seed=2)
    blocks = [shapes[:, own].reshape(20, -1) for own in (slice(0, 2), slice(2, 5), slice(5, 9))]
    rows = next(orders(20, 7, 2))[1]
    expected = [[plain_r(a[order], b) for a, b in itertools.combinations(blocks, 2)] for order in rows]
    mean, *pairs = found.statistics
    np.testing.assert_allclose(mean.arrangements, np.mean(expected, axis=1), rtol=1e-7)
    np.testing.assert_allclose(np.column_stack([one.arrangements for one in pairs]), expected, rtol=1e-7)
    assert [one.tested for one in pairs] == ["A – B", "A – C", "B – C"]


@pytest.mark.parametrize("dimensions", [2, 3])
def test_cr_of_each_permutation_is_that_of_rotated_covariance_matrices(dimensions: int, tmp_path: Path) -> None:
    shapes, modules = correlated(6, dimensions=dimensions), "AABBBCCCC"
    found = estimate_modularity(cohort_of(shapes), modules=written(tmp_path, modules), permutations=6, seed=1)
    angle = found.settings["rotation_degrees"]
    rows = next(orders(9, 6, 1))[1]
    expected = [plain_cr(shapes, "".join(modules[k] for k in order), angle) for order in rows]
    np.testing.assert_allclose(np.column_stack([s.arrangements for s in found.statistics[1:]]), expected, rtol=1e-9)
    assert found.statistics[0].value == pytest.approx(np.mean(expected[0]))
    turned = [np.mean(plain_cr(shapes, modules, degrees)) for degrees in np.arange(0, 90, 2.5)]
    assert found.settings["mean_over_rotations"] == pytest.approx(np.mean(turned), rel=1e-9)
    assert found.statistics[0].value == pytest.approx(np.mean(turned), rel=1e-3)


def test_the_interval_of_cr_is_that_of_resampled_coordinates(tmp_path: Path) -> None:
    shapes, modules = correlated(7, points=6), "AAABBB"
    found = estimate_modularity(cohort_of(shapes), modules=written(tmp_path, modules), permutations=40, seed=5)
    counts = np.random.default_rng([5, 40]).multinomial(20, np.full(20, 1 / 20), size=40)
    samples = [np.repeat(shapes, own, axis=0) for own in counts]
    plain = [np.mean([plain_cr(own, modules, t) for t in np.arange(-44, 45, 6)]) for own in samples]
    assert "nearest to its mean over all rotations" in found.methods.assumptions[0]
    assert (found.statistics[0].low, found.statistics[0].high) == pytest.approx(
        tuple(np.percentile(plain, [2.5, 97.5])), rel=1e-6
    )


def test_separate_modules_have_a_small_cr_and_integrated_ones_a_large_r(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    own = [rng.normal(size=(40, 1)) @ rng.normal(size=(1, 15)) + 0.3 * rng.normal(size=(40, 15)) for _ in range(2)]
    path = written(tmp_path, "AAAAABBBBB")
    separate = cohort_of(np.hstack(own).reshape(40, 10, 3))
    together = cohort_of(np.hstack([own[0], own[0][:, ::-1] + 0.3 * own[1]]).reshape(40, 10, 3))
    cr = [estimate_modularity(cohort, modules=path, permutations=200).statistics[0] for cohort in (separate, together)]
    r = [fit_pls(cohort, modules=path, permutations=200).statistics[0] for cohort in (separate, together)]
    assert cr[0].value < 0.6 < cr[1].value and cr[0].p is not None and cr[0].p <= 0.02 and cr[0].z < -2
    assert r[1].p == 1 / 200 and r[1].value > r[0].value
    difference = compare_effect_sizes(r[1], r[0])
    assert difference.z == pytest.approx((r[1].z - r[0].z) / math.sqrt(2 * (1 - 1 / 199)))
    assert difference.p == pytest.approx(math.erfc(abs(difference.z) / math.sqrt(2)))


def test_points_are_named_by_landmark_or_counted_and_others_are_left_out(tmp_path: Path) -> None:
    cohort = cohort_of(correlated(9))
    by_number = fit_pls(cohort, modules=written(tmp_path, "AAA-BBB--"), permutations=3)
    assert "3 of 9 vertices belong to no module" in by_number.cohort.notes[-1]
    by_vertex = fit_pls(cohort, modules=written(tmp_path, "AAA-BBB--", "vertex"), permutations=3)
    path = tmp_path / "named.csv"
    path.write_text("landmark,module\n" + "".join(f"p{k},{'A' if k < 3 else 'B'}\n" for k in (0, 1, 2, 4, 5, 6)))
    object.__setattr__(cohort, "landmarks", SurfaceLandmarks.of({f"p{k}": k for k in range(9)}))
    by_name = fit_pls(cohort, modules=path, permutations=3)
    assert by_number.statistics[0].value == by_vertex.statistics[0].value == by_name.statistics[0].value


@pytest.mark.parametrize(
    ("text", "error", "sentence"),
    [
        ("point,module\n1,A\n", FileFormatError, "is no table of modules"),
        ("landmark,module\n1\n", InputError, "has no module"),
        ("landmark,module\n1,A\n2,A\n3,A\n", InputError, "two modules of two vertices"),
        ("landmark,module\n1,A\n2,A\n3,B\n", InputError, "two modules of two vertices"),
        ("landmark,module\n1,A\n2,A\n3,B\n99,B\n", InputError, "'99' is not in the shapes"),
        ("landmark,module\n1,A\n2,A\n3,B\n4,\n", InputError, "has no module"),
        ("landmark,module\n1,A\n2,A\n3,B\n2,B\n", InputError, "is listed twice"),
        ("landmark,module\n", InputError, "two modules of two vertices"),
    ],
)
def test_tables_that_are_no_modules_of_the_shapes_are_refused(
    tmp_path: Path, text: str, error: type[Exception], sentence: str
) -> None:
    path = tmp_path / "modules.csv"
    path.write_text(text)
    with pytest.raises(error, match=sentence) as caught:
        estimate_modularity(cohort_of(correlated(10)), modules=path)
    assert "modules.csv" in str(caught.value)


def test_blocks_that_cannot_covary_are_refused(tmp_path: Path) -> None:
    shapes = correlated(11)
    cohort = cohort_of(shapes, {"a": [1.0] * 20, "sex": ["f", "m"] * 10, "b": [None, *range(19)]})
    with pytest.raises(InputError, match="The block of columns is the same for all shapes"):
        fit_pls(cohort, columns=("a",))
    with pytest.raises(InputError, match="which is no number"):
        fit_pls(cohort, columns=("sex",))
    with pytest.raises(InputError, match="missing=drop"):
        fit_pls(cohort, columns=("b",))
    assert len(fit_pls(cohort, columns=("b",), permutations=2, drop_missing=True).cohort) == 19
    with pytest.raises(InputError, match="no column 'c'"):
        fit_pls(cohort, columns=("c",))
    with pytest.raises(InputError, match="needs either --columns"):
        fit_pls(cohort)
    shapes[:, :3] = 0.0
    with pytest.raises(InputError, match="The block of A is the same for all shapes"):
        fit_pls(cohort_of(shapes), modules=written(tmp_path, "AAABBBBBB"))
    with pytest.raises(InputError, match="CR is not defined"):
        estimate_modularity(cohort_of(shapes), modules=written(tmp_path, "AAABBBBBB"))
    with pytest.raises(InputError, match="compared by Z"):
        compare_effect_sizes(Statistic(name="CR", value=1.0), Statistic(name="CR", value=1.0))


@pytest.mark.parametrize("method", ["pls", "integration", "modularity"])
def test_unrelated_blocks_are_significant_in_about_5_percent(method: str, tmp_path: Path) -> None:
    """2,000 simulations and more of 200 permutations are in docs/morphometrics.md."""
    rng = np.random.default_rng(12)
    path, significant = written(tmp_path, "AAAABBBB"), 0
    for seed in range(80):
        values = rng.normal(size=(12, 2)) @ rng.normal(size=(2, 24)) + rng.normal(size=(12, 24))
        if method == "integration":
            values[:, 12:] = rng.normal(size=(12, 2)) @ rng.normal(size=(2, 12)) + rng.normal(size=(12, 12))
        cohort = cohort_of(values.reshape(12, 8, 3), {"a": list(rng.normal(size=12))})
        if method == "modularity":
            test = estimate_modularity(cohort, modules=path, permutations=20, seed=seed).statistics[0]
        else:
            options: dict[str, Any] = {"columns": ("a",)} if method == "pls" else {"modules": path}
            test = fit_pls(cohort, permutations=20, seed=seed, **options).statistics[0]
        significant += test.p is not None and test.p <= 0.05
    assert 1 <= significant <= 11  # 98 % of a binomial distribution, and 99.9 % below the end
