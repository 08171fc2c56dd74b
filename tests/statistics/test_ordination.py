"""Ordinations: against R's prcomp, scikit-learn, brute force, and what is known of chance."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.statistics.shape_tests.ordination import (
    ordinate,
    principal_components,
)
from shapespace.statistics.shape_tests.permutations import Groups


def cohort_of(n: int = 36, groups: int = 3, landmarks: int = 5, effect: float = 0.6, seed: int = 1) -> Cohort:
    """Return shapes of groups with unequal sizes whose means differ by `effect` standard deviations."""
    rng = np.random.default_rng(seed)
    codes = np.sort(np.r_[np.tile(np.arange(groups), 2), rng.integers(0, groups, n - 2 * groups)])
    means = rng.normal(size=(groups, landmarks, 3))
    shapes = rng.normal(size=(n, landmarks, 3)) * np.linspace(2.0, 0.3, landmarks)[:, None] + effect * means[codes]
    return Cohort.of_shapes(100 * shapes, {"kind": [f"g{code}" for code in codes]}, align=False)


def groups_of(cohort: Cohort) -> Groups:
    return Groups.of(cohort, ("kind",))


def aligned(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Return `found` with the signs of `expected`."""
    return found * np.sign((found * expected).sum(axis=0))


def test_principal_components_of_plethodon_are_those_of_geomorph(geomorph_reference: dict[str, Any]) -> None:
    data = geomorph_reference
    flat = np.array(data["plethodon_gpa"]["coords"])
    shapes = np.zeros((len(flat), flat.shape[1] // 2, 3))
    shapes[:, :, :2] = flat.reshape(len(flat), -1, 2)
    result = ordinate(Cohort.of_shapes(shapes, {}, align=False))
    assert np.sqrt(result.eigenvalues) == pytest.approx(data["plethodon_pca"]["sdev"], rel=1e-6)
    expected = np.array(data["plethodon_pca"]["scores"])
    assert aligned(result.scores[:, :4], expected) == pytest.approx(expected, abs=1e-9)


def test_principal_components_are_those_of_scikit_learn() -> None:
    decomposition = pytest.importorskip("sklearn.decomposition")
    cohort = cohort_of()
    result, other = ordinate(cohort), decomposition.PCA().fit(cohort.coefficients)
    k = len(result.axes)
    assert result.eigenvalues == pytest.approx(other.explained_variance_[:k])
    assert result.explained_variance_ratio == pytest.approx(other.explained_variance_ratio_[:k])
    expected = other.transform(cohort.coefficients)[:, :k]
    assert aligned(result.scores, expected) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("method", ["pca", "between-groups", "cva"])
def test_a_shape_drawn_at_scores_has_these_scores(method: Any) -> None:
    result = ordinate(cohort_of(), method=method, group=("kind",))
    assert result.shape_axes @ result.axes.T == pytest.approx(np.eye(len(result.axes)), abs=1e-9)
    scores = (result.cohort.coefficients - result.centre) @ result.axes.T
    assert result.scores == pytest.approx(scores, abs=1e-9)
    largest = np.abs(result.scores).argmax(axis=0)
    assert (result.scores[largest, np.arange(len(largest))] > 0).all()


def test_canonical_variates_are_those_of_scikit_learn_and_white_within_groups() -> None:
    discriminants = pytest.importorskip("sklearn.discriminant_analysis")
    cohort = cohort_of()
    result = ordinate(cohort, method="cva", group=("kind",))
    codes, n, n_groups = groups_of(cohort).codes, len(cohort), 3
    residual = result.scores - np.stack([result.scores[codes == code].mean(axis=0) for code in codes])
    assert residual.T @ residual / (n - n_groups) == pytest.approx(np.eye(2), abs=1e-9)
    values = (cohort.coefficients - cohort.coefficients.mean(axis=0)) @ principal_components(cohort.coefficients)[1].T
    other = discriminants.LinearDiscriminantAnalysis(solver="svd").fit(values, codes)
    # Its covariance within groups has the divisor n, that of MASS n - g.
    expected = other.transform(values) * np.sqrt((n - n_groups) / n)
    assert aligned(result.scores, expected) == pytest.approx(expected, abs=1e-9)
    assert result.explained_variance_ratio == pytest.approx(other.explained_variance_ratio_)


def test_leave_one_out_classes_and_scores_are_those_of_brute_force() -> None:
    discriminants = pytest.importorskip("sklearn.discriminant_analysis")
    cohort = cohort_of(effect=0.4)
    groups, n = groups_of(cohort), len(cohort)
    values = cohort.coefficients @ principal_components(cohort.coefficients)[1].T
    predicted = []
    for k in range(n):
        rest = np.arange(n) != k
        # Its covariance within groups has the divisor n, that of MASS n - g.
        other = discriminants.LinearDiscriminantAnalysis(solver="lsqr").fit(values[rest], groups.codes[rest])
        covariance = other.covariance_ * (n - 1) / (n - 1 - len(groups.names))
        away = values[k] - other.means_
        squares = np.einsum("gi,gi->g", away, np.linalg.solve(covariance, away.T).T)
        predicted.append((np.log(groups.counts / n) - squares / 2).argmax())
    result = ordinate(cohort, method="cva", group=("kind",))
    assert result.predicted is not None and result.predicted.tolist() == predicted
    assert result.cross_validated is not None
    k = 7
    rest = [row for row in range(n) if row != k]
    own = ordinate(cohort.take(rest), method="cva", group=("kind",))
    alone = (cohort.coefficients[k] - own.centre) @ own.axes.T
    # The axes are those of the other shapes, turned to those of all of them.
    assert np.linalg.norm(result.cross_validated[k]) == pytest.approx(np.linalg.norm(alone), rel=1e-6)


def test_between_group_axes_are_those_of_weighted_group_means() -> None:
    cohort = cohort_of()
    groups = groups_of(cohort)
    result = ordinate(cohort, method="between-groups", group=("kind",))
    means = np.stack([cohort.coefficients[groups.codes == g].mean(axis=0) for g in range(3)])
    spread = (means - cohort.coefficients.mean(axis=0)).T
    values = np.linalg.eigvalsh((spread * groups.counts) @ spread.T)[::-1][:2] / (len(cohort) - 1)
    assert result.eigenvalues == pytest.approx(values)
    assert result.axes @ result.axes.T == pytest.approx(np.eye(2), abs=1e-12)
    # Leave-one-out scores by brute force: their axes are turned, so lengths are compared.
    assert result.cross_validated is not None
    for k in (0, 20):
        rest = [row for row in range(len(cohort)) if row != k]
        alone = ordinate(cohort.take(rest), method="between-groups", group=("kind",))
        expected = np.linalg.norm((cohort.coefficients[k] - alone.centre) @ alone.axes.T)
        assert np.linalg.norm(result.cross_validated[k]) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("method", ["between-groups", "cva"])
def test_leave_one_out_scores_of_groups_that_do_not_differ_are_not_separated(method: Any) -> None:
    """Of random groups in many dimensions the plot shows clusters (Cardini et al. 2019), leave-one-out does not."""
    plotted, validated, right = [], [], []
    for seed in range(8):
        cohort = cohort_of(n=45, landmarks=40, effect=0.0, seed=seed)
        result = ordinate(cohort, method=method, group=("kind",))
        assert result.cross_validated is not None and result.groups is not None
        plotted.append(result.group_share(result.scores))
        validated.append(result.group_share(result.cross_validated))
        right.append((result.predicted == result.groups.codes).mean())
    assert np.mean(plotted) > 0.4
    assert np.mean(validated) < 0.2 and np.mean(validated) < np.mean(plotted) / 2
    assert 0.2 < np.mean(right) < 0.5


def test_canonical_variates_of_few_shapes_use_fewer_components_or_say_so() -> None:
    cohort = cohort_of(n=20, landmarks=30)
    result = ordinate(cohort, method="cva", group=("kind",))
    assert (
        result.components is not None
        and result.components <= (20 - 3) // 2
        and "principal components" in result.notes[0]
    )
    assert ordinate(cohort, method="cva", group=("kind",), components=4).components == 4
    with pytest.raises(InputError, match="singular with 17 principal components; take 1 to 16"):
        ordinate(cohort, method="cva", group=("kind",), components=17)


def test_designs_without_an_ordination_are_refused() -> None:
    cohort = cohort_of()
    table = {"kind": ["a"] * 5 + ["b"], "same": ["a"] * 6}
    few = Cohort.of_shapes(np.random.default_rng(0).normal(size=(6, 4, 3)), table, align=False)
    for arguments, words in (
        ({"method": "cva"}, "needs groups"),
        ({"method": "between-groups"}, "needs groups"),
        ({"method": "paca"}, "needs a phylogeny"),
        ({"group": ("none",)}, "no column 'none'"),
        ({"components": 3}, "cva alone"),
        ({"method": "cva", "group": ("kind",), "tree": Path("tree.nwk")}, "remove --tree"),
    ):
        with pytest.raises(InputError, match=words):
            ordinate(cohort, **arguments)  # type: ignore[arg-type]
    for method, column, words in (("cva", "kind", "'b' of kind has 1"), ("between-groups", "same", "two")):
        with pytest.raises(InputError, match=words):
            ordinate(few, method=method, group=(column,))  # type: ignore[arg-type]
    shapes = cohort_of().coefficients @ cohort.basis
    shapes = shapes.reshape(len(cohort), -1, 3)
    shapes[:, 0, 0] = groups_of(cohort).codes
    with pytest.raises(InputError, match="the shapes of each group are equal"):
        ordinate(Cohort.of_shapes(shapes, cohort.table.columns, align=False), method="cva", group=("kind",))
    with pytest.raises(InputError, match="three or more"):
        ordinate(cohort.take([0, 1]))
    with pytest.raises(InputError, match="components"):
        principal_components(np.ones((4, 3)))
