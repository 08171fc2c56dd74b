"""Phylogenetic tests: against results of geomorph, squared-change parsimony, plain least squares and simulations."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.geometry.landmark_alignment import align_landmarks
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.trees import Tree
from shapespace.report.analyses.morphospace_report import morphospace_report
from shapespace.report.analyses.result_report import shape_test_report
from shapespace.statistics.shape_tests.ordination import OrdinationMethod, ordinate
from shapespace.statistics.shape_tests.permutations import orders
from shapespace.statistics.shape_tests.phylogenetic import (
    ancestral_states,
    estimate_phylogenetic_signal,
    fit_pgls,
)

EXACT = 1e-6
"""Relative tolerance of statistics of geomorph."""


@pytest.fixture(scope="module")
def reference(geomorph_reference: dict[str, Any]) -> dict[str, Any]:
    """Reference results, where trees can be read."""
    pytest.importorskip("dendropy", reason="the extra `phylogeny` is not installed")
    return geomorph_reference


@pytest.fixture(scope="module")
def species(reference: dict[str, Any]) -> Cohort:
    """Nine species of Plethodon."""
    names = tuple(reference["phylo_raw"]["names"])
    points = np.array(reference["phylo_raw"]["raw"]).reshape(len(names), -1, 2)
    return Cohort.of_landmarks(align_landmarks(LandmarkConfigurations(names=names, points=points)))


@pytest.fixture
def tree_file(reference: dict[str, Any], tmp_path: Path) -> Path:
    """Their phylogeny."""
    path = tmp_path / "species.nwk"
    path.write_text(reference["phylo_tree"][0])
    return path


def random_tree(rng: np.random.Generator, n: int, extra: float = 0.0) -> Tree:
    """Return a coalescent tree of n tips; `extra` lengthens each tip by up to that much."""
    parents, lengths = np.full(2 * n - 1, -1, dtype=np.int32), np.zeros(2 * n - 1)
    lineages, age, time = list(range(n)), np.zeros(2 * n - 1), 0.0
    for node in range(2 * n - 2, n - 1, -1):
        time += rng.exponential(2 / (len(lineages) * (len(lineages) - 1)))
        pair = rng.choice(lineages, 2, replace=False)
        parents[pair], lengths[pair], age[node] = node, time - age[pair], time
        lineages = [*(one for one in lineages if one not in pair), node]
    lengths[:n] += extra * rng.random(n)
    return Tree(tips=tuple(f"t{k}" for k in range(n)), parents=parents, lengths=lengths)


def evolved(rng: np.random.Generator, tree: Tree, size: int) -> np.ndarray[Any, Any]:
    """Return traits (N, size) that covary, after Brownian motion."""
    tips = tree.paths[: len(tree.tips)]
    mixed = rng.normal(size=(tips.shape[1], 4)) @ rng.normal(size=(4, size))
    return tips @ (mixed + 0.3 * rng.normal(size=(tips.shape[1], size)))


def cohort_of(tree: Tree, flat: np.ndarray[Any, Any], columns: dict[str, Any] | None = None) -> Cohort:
    shapes = flat.reshape(len(flat), -1, 3)
    return Cohort.of_shapes(shapes, columns or {}, names=tree.tips, align=False, unit="mm")


def plain_k(values: np.ndarray[Any, Any], covariance: np.ndarray[Any, Any]) -> float:
    """Return K of Adams (2014) from distances to the root, before and after phylogenetic transformation."""
    n, inverse, ones = len(values), np.linalg.inv(covariance), np.ones(len(values))
    root = ones @ inverse @ values / (ones @ inverse @ ones)
    transformed = np.linalg.inv(np.linalg.cholesky(covariance)) @ (values - root)
    observed = ((values - root) ** 2).sum() / (transformed**2).sum()
    return float(observed / ((np.trace(covariance) - n / inverse.sum()) / (n - 1)))


def test_published_signal_of_plethodon_is_reproduced(
    reference: dict[str, Any], species: Cohort, tree_file: Path
) -> None:
    test = estimate_phylogenetic_signal(species, tree=tree_file, permutations=2000).statistic("K")
    expected = reference["phylo_signal"]
    assert test.value == pytest.approx(expected["K"][0], rel=EXACT)
    assert test.p == pytest.approx(expected["p"][0], abs=0.008)  # 3 standard errors of 2,000 permutations


def test_published_least_squares_of_plethodon_are_reproduced(
    reference: dict[str, Any], species: Cohort, tree_file: Path
) -> None:
    found, expected = fit_pgls(species, formula="~ size", tree=tree_file, permutations=2000), reference["phylo_pgls"]
    rows = found.table("Phylogenetic analysis of variance").rows
    assert [row[2] for row in rows] == pytest.approx(expected["SS"], rel=EXACT)
    assert [row[3] for row in rows[:2]] == pytest.approx(expected["R2"][:2], rel=EXACT)
    assert rows[0][4] == pytest.approx(expected["F"][0], rel=EXACT)
    assert rows[0][6] == pytest.approx(expected["p"][0], abs=0.03)  # 3 standard errors of 2,000 permutations


def test_published_axes_of_plethodon_are_reproduced(
    reference: dict[str, Any], species: Cohort, tree_file: Path
) -> None:
    expected = reference["phylo_pca"]
    plain = ordinate(species, tree=tree_file)
    np.testing.assert_allclose(np.sqrt(plain.eigenvalues), expected["sdev"], rtol=EXACT)
    ancestors = np.array(expected["ancestors"])
    assert plain.ancestors is not None
    signs = np.sign((plain.ancestors[:, :3] * ancestors).sum(axis=0))
    np.testing.assert_allclose(plain.ancestors[:, :3] * signs, ancestors, atol=EXACT * np.abs(ancestors).max())
    aligned = ordinate(species, tree=tree_file, method="paca")
    np.testing.assert_allclose(np.sqrt(aligned.eigenvalues), reference["phylo_paca"]["sdev"], rtol=EXACT)


@pytest.mark.parametrize("extra", [0.0, 0.7], ids=["ultrametric", "not ultrametric"])
def test_k_of_each_permutation_is_that_of_distances_to_the_root(extra: float) -> None:
    rng = np.random.default_rng(1)
    tree = random_tree(rng, 12, extra)
    values = evolved(rng, tree, 15)
    found = estimate_phylogenetic_signal(cohort_of(tree, values), tree=tree, permutations=6, seed=2)
    rows = next(orders(12, 6, 2))[1]
    expected = [plain_k(values[order], tree.covariance) for order in rows]
    np.testing.assert_allclose(found.statistic("K").arrangements, expected, rtol=1e-9)
    u, s, _ = np.linalg.svd(values - values.mean(axis=0), full_matrices=False)
    table = found.table("Phylogenetic signal of principal components").rows
    assert len(table) == 10
    for k, row in enumerate(table):
        assert row[2] == pytest.approx(plain_k((u * s)[:, [k]], tree.covariance), rel=1e-6)


def test_k_of_brownian_motion_is_1_on_average_and_smaller_without_phylogeny() -> None:
    rng = np.random.default_rng(3)
    tree = random_tree(rng, 20)
    signal = [estimate_phylogenetic_signal(cohort_of(tree, evolved(rng, tree, 60)), tree=tree, permutations=1)
              for _ in range(40)]  # fmt: skip
    assert np.mean([one.statistics[0].value for one in signal]) == pytest.approx(1, abs=0.15)
    without = estimate_phylogenetic_signal(cohort_of(tree, rng.normal(size=(20, 60))), tree=tree, permutations=100)
    assert without.statistics[0].value < 0.6


def test_ancestors_are_those_of_squared_change_parsimony_also_at_multifurcations() -> None:
    rng = np.random.default_rng(4)
    tree = random_tree(rng, 9, 0.4)
    lengths = tree.lengths.copy()
    lengths[np.flatnonzero(tree.parents == 9)[-1]] *= 1e-3
    tree = replace(tree, lengths=lengths)
    values = rng.normal(size=(9, 2))
    # Sums of squared changes divided by branch lengths are least where this system of equations holds.
    laplacian = np.zeros((17, 17))
    for parent, child in tree.edges:
        ends = np.ix_([parent, child], [parent, child])
        laplacian[ends] += np.array([[1, -1], [-1, 1]]) / tree.lengths[child]
    expected = np.linalg.solve(laplacian[9:, 9:], -laplacian[9:, :9] @ values)
    np.testing.assert_allclose(ancestral_states(tree, values), expected, atol=1e-9)


def test_phylogenetic_components_are_eigenvectors_of_evolutionary_rates() -> None:
    rng = np.random.default_rng(5)
    tree = random_tree(rng, 15)
    values = evolved(rng, tree, 9)
    cohort = cohort_of(tree, values)
    axes = ordinate(cohort, tree=tree, method="phylogenetic-pca")
    inverse, ones = np.linalg.inv(tree.covariance), np.ones(15)
    centred = values - ones @ inverse @ values / inverse.sum()
    eigenvalues, vectors = np.linalg.eigh(centred.T @ inverse @ centred / 14)
    np.testing.assert_allclose(axes.eigenvalues, eigenvalues[::-1], rtol=1e-9)
    np.testing.assert_allclose(np.abs(axes.scores), np.abs(centred @ vectors[:, ::-1]), atol=1e-9)
    np.testing.assert_allclose(cohort.vertices(axes.centre).ravel(), (values - centred)[0], atol=1e-9)
    methods: tuple[OrdinationMethod, ...] = ("pca", "phylogenetic-pca", "paca")
    for method in methods:
        axes = ordinate(cohort, tree=tree, method=method)
        first = cohort.vertices(axes.centre + axes.scores[3] @ axes.shape_axes)
        np.testing.assert_allclose(first.ravel(), values[3], atol=1e-9)
        np.testing.assert_allclose(axes.axes @ axes.axes.T, np.eye(9), atol=1e-9)
        assert axes.ancestors is not None and axes.ancestors.shape == (14, 9)
        assert "Brownian motion" in " ".join(getattr(morphospace_report(axes).methods, "assumptions", ()))


@pytest.mark.parametrize("anova_type", ["I", "II", "III"])
def test_sums_of_squares_are_those_of_generalised_least_squares(anova_type: Any) -> None:
    pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")
    rng = np.random.default_rng(6)
    tree = random_tree(rng, 14, 0.3)
    values = evolved(rng, tree, 12)
    sex, age = np.array([1.0, -1.0])[np.arange(14) % 2], rng.normal(size=14)
    columns = {"sex": ["f" if one > 0 else "m" for one in sex], "age": list(age)}
    found = fit_pgls(
        cohort_of(tree, values, columns), formula="~ sex * age", tree=tree, anova_type=anova_type, permutations=20
    )
    inverse = np.linalg.inv(tree.covariance)

    def left(*own: np.ndarray[Any, Any]) -> float:
        x = np.column_stack([np.ones(14), *own])
        rest = values - x @ np.linalg.solve(x.T @ inverse @ x, x.T @ inverse @ values)
        return float(np.trace(rest.T @ inverse @ rest))

    both, full = sex * age, left(sex, age, sex * age)
    reduced = {
        "I": [(left(), left(sex)), (left(sex), left(sex, age)), (left(sex, age), full)],
        "II": [(left(age), left(sex, age)), (left(sex), left(sex, age)), (left(sex, age), full)],
        "III": [(left(age, both), full), (left(sex, both), full), (left(sex, age), full)],
    }[anova_type]
    rows = found.table("Phylogenetic analysis of variance").rows
    assert [row[2] for row in rows] == pytest.approx([*(a - b for a, b in reduced), full, left()], rel=1e-8)
    assert [row[1] for row in rows] == [1, 1, 1, 10, 13]
    assert [one.value for one in found.statistics] == pytest.approx([(a - b) / (full / 10) for a, b in reduced])


def test_a_star_with_equal_branches_gives_ordinary_least_squares() -> None:
    pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")
    from shapespace.statistics.compare_shapes import CompareConfig, compare

    rng = np.random.default_rng(7)
    star = Tree(
        tips=tuple(f"t{k}" for k in range(10)), parents=np.array([*[10] * 10, -1], dtype=np.int32),
        lengths=np.array([*[2.0] * 10, 0.0]),
    )  # fmt: skip
    cohort = cohort_of(star, rng.normal(size=(10, 12)), {"age": list(rng.normal(size=10))})
    found = fit_pgls(cohort, formula="~ age", tree=star, permutations=100).statistics[0]
    plain = compare(cohort, "~ age", CompareConfig(permutations=100, maps=False)).tests[0]
    np.testing.assert_allclose(found.arrangements, plain.arrangements, rtol=1e-9)
    k = estimate_phylogenetic_signal(cohort, tree=star, permutations=10).statistics[0]
    np.testing.assert_allclose(k.arrangements, 1.0, rtol=1e-9)


def test_reports_are_written_and_pruned_tips_are_in_the_notes(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    tree = random_tree(rng, 8)
    part = replace(cohort_of(tree, evolved(rng, tree, 12)).take(range(6)))
    found = estimate_phylogenetic_signal(part, tree=tree, permutations=20)
    assert any("2 of 8 tips have no shape and are pruned" in note for note in found.cohort.notes)
    expected = plain_k(part.coefficients, tree.covariance[:6, :6])
    assert found.statistics[0].value == pytest.approx(expected)
    shape_test_report(found).save(tmp_path / "signal")
    assert (tmp_path / "signal" / "phylogenetic_signal_of_principal_components.csv").is_file()


def test_designs_that_cannot_be_tested_are_refused() -> None:
    pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")
    rng = np.random.default_rng(9)
    tree = random_tree(rng, 8)
    columns = {"age": list(rng.normal(size=8)), "same": [1.0] * 8, "id": [f"i{k}" for k in range(8)],
               "few": [None, *range(7)]}  # fmt: skip
    cohort = cohort_of(tree, evolved(rng, tree, 12), columns)
    other = replace(tree, tips=("x", *tree.tips[1:]))
    with pytest.raises(InputError, match=r"no tip for 1 of 8 shapes \(t0\)"):
        estimate_phylogenetic_signal(cohort, tree=other)
    with pytest.raises(InputError, match=r"no tip for 1 of 8 shapes \(t0\)"):
        ordinate(cohort, tree=other)
    flat = tree.lengths.copy()
    flat[np.flatnonzero(tree.parents == tree.parents[0])] = 0.0
    with pytest.raises(InputError, match="is 0, so the covariance of the species is singular"):
        fit_pgls(cohort, formula="~ age", tree=replace(tree, lengths=flat))
    with pytest.raises(InputError, match="remove it"):
        fit_pgls(cohort, formula="~ same", tree=tree)
    with pytest.raises(InputError, match="columns for 8 shapes, so that no degrees of freedom are left"):
        fit_pgls(cohort, formula="~ id", tree=tree)
    with pytest.raises(InputError, match="follows from the other terms"):
        fit_pgls(cohort, formula="~ age + center(age)", tree=tree)
    with pytest.raises(InputError, match="missing=drop"):
        fit_pgls(cohort, formula="~ few", tree=tree)
    assert len(fit_pgls(cohort, formula="~ few", tree=tree, permutations=20, drop_missing=True).cohort) == 7


@pytest.mark.parametrize("method", ["signal", "pgls"])
def test_species_without_signal_or_effect_are_significant_in_about_5_percent(method: str) -> None:
    """2,000 simulations and more of 200 permutations are in docs/morphometrics.md."""
    rng = np.random.default_rng(10)
    significant = 0
    for seed in range(60):
        tree = random_tree(rng, 12)
        if method == "signal":
            values = rng.normal(size=(12, 3)) @ rng.normal(size=(3, 12)) + 0.3 * rng.normal(size=(12, 12))
            found = estimate_phylogenetic_signal(cohort_of(tree, values), tree=tree, permutations=20, seed=seed)
        else:
            columns = {"age": list(evolved(rng, tree, 1)[:, 0])}
            cohort = cohort_of(tree, evolved(rng, tree, 12), columns)
            found = fit_pgls(cohort, formula="~ age", tree=tree, permutations=20, seed=seed)
        significant += found.statistics[0].p is not None and found.statistics[0].p <= 0.05
    assert significant <= 9  # 99.9 % of a binomial distribution
