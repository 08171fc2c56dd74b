"""Regression on shape: what is told of subjects left out is true of new ones; a predictor is numbers alone."""

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sklearn.decomposition import PCA
from sklearn.linear_model import LinearRegression, Ridge

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table, numbers_as_text
from shapespace.errors import CorrespondenceError, FileFormatError, InputError
from shapespace.model.shape_model import ShapeModel
from shapespace.report.analyses.methods_section import scheme_text
from shapespace.report.analyses.regression_report import prediction_report, regression_report
from shapespace.schemas import read_part
from shapespace.statistics.linear_regressors import Regularisation, TrainingDecomposition, folds_of
from shapespace.statistics.predictor import Predictor, cv_plus, refuse_known
from shapespace.statistics.regression import RegressionResult, compare_with, permutation_scheme, regress, share_of
from shapespace.types import Mesh, read_only
from symmetric_object import cohort_of, posed, symmetric_object

V, K = 30, 20
BASIS = np.linalg.qr(np.random.default_rng(0).standard_normal((3 * V, K)))[0].T
REFERENCE = read_only(50 * np.random.default_rng(1).standard_normal((V, 3)))
STDDEV = 10 * 0.85 ** np.arange(K)
SLOPES = np.zeros(K)
SLOPES[[0, 3, 7]] = 5.0, 5.0, 3.0


def drawn(n: int, seed: int, *, repeats: int = 1, noise: float = 5.0, told: bool = True) -> Cohort:
    """Subjects whose age is told by three coefficients, and by chance."""
    rng = np.random.default_rng([seed, n])
    c = rng.standard_normal((n, K)) * STDDEV
    age = 50 + (c / STDDEV) @ SLOPES + noise * rng.standard_normal(n)
    if not told:
        age = rng.permutation(age)
    c = np.repeat(c, repeats, axis=0) + (0.3 * rng.standard_normal((n * repeats, K)) if repeats > 1 else 0.0)
    names = tuple(f"shape {k}" for k in range(n * repeats))
    subjects = tuple(f"{seed}-{k // repeats}" for k in range(n * repeats))
    table = Table({"age": numbers_as_text(np.repeat(age, repeats)), "subject": subjects}, names)
    sizes = read_only(np.full(n * repeats, np.nan))
    return Cohort(names, REFERENCE, BASIS, read_only(c), sizes, table, "form")


@pytest.fixture(scope="module")
def learned() -> RegressionResult:
    return regress(drawn(60, 1), "age", permutations=19)


def test_raw_coefficients_are_those_of_ridge_regression() -> None:
    cohort = drawn(30, 2)
    X, y = cohort.coefficients, cohort.table.numbers("age")
    penalty = 0.01 * np.linalg.svd(X - X.mean(axis=0))[1][0] ** 2
    other = Ridge(alpha=float(penalty), solver="svd").fit(X, y)
    beta, intercept = TrainingDecomposition.of(X, np.ones(len(X))).weights(y, Regularisation("raw", 0.01))
    assert np.allclose(beta, other.coef_, rtol=1e-8) and intercept == pytest.approx(other.intercept_, rel=1e-8)


def test_whitened_coefficients_are_those_of_principal_component_regression() -> None:
    cohort = drawn(30, 2)
    X, y = cohort.coefficients, cohort.table.numbers("age")
    pca = PCA(5, whiten=True, svd_solver="full").fit(X)
    expected = LinearRegression().fit(pca.transform(X), y).predict(pca.transform(X[:7]))
    found = TrainingDecomposition.of(X, np.ones(len(X))).predict(X[:7], y[:, None], [Regularisation("whitened", 5)])[
        0, :, 0
    ]
    assert np.allclose(found, expected, rtol=1e-8)


def unequal_scans(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coefficients, target and 1 / number of scans of 30 subjects with 1 to 9 scans."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(1, 10, 30)
    X = np.repeat(rng.standard_normal((30, 12)) * 3, counts, axis=0) + rng.standard_normal((counts.sum(), 12))
    return X, X[:, 0] + rng.standard_normal(len(X)), np.repeat(1.0 / counts, counts)


def test_weighted_ridge_regression_is_that_of_scikit_learn() -> None:
    X, y, weight = unequal_scans(0)
    found = TrainingDecomposition.of(X, weight)
    penalty = 0.01 * found.singular[0] ** 2
    other = Ridge(alpha=float(penalty), solver="cholesky").fit(X, y, sample_weight=weight)
    beta, intercept = found.weights(y, Regularisation("raw", 0.01))
    assert np.allclose(beta, other.coef_, rtol=1e-9) and intercept == pytest.approx(other.intercept_, rel=1e-9)
    predicted = found.predict(X[:5], y[:, None], [Regularisation("raw", 0.01)])[0, :, 0]
    assert np.allclose(predicted, other.predict(X[:5]), rtol=1e-9)


def test_weighted_principal_component_regression_is_weighted_least_squares_on_weighted_components() -> None:
    X, y, weight = unequal_scans(1)
    mean = np.average(X, axis=0, weights=weight)
    components = np.linalg.eigh(np.cov(X.T, aweights=weight))[1][:, ::-1][:, :4]
    expected = LinearRegression().fit((X - mean) @ components, y, sample_weight=weight).predict((X - mean) @ components)
    found = TrainingDecomposition.of(X, weight).predict(X, y[:, None], [Regularisation("whitened", 4)])[0, :, 0]
    assert np.allclose(found, expected, rtol=1e-9)


def each_scan_repeated(cohort: Cohort, times: int) -> Cohort:
    """All scans of each subject `times` times."""
    rows = [row for row in range(len(cohort)) for _ in range(times)]
    names = tuple(f"{cohort.names[row]} {k}" for k, row in enumerate(rows))
    return replace(cohort.take(rows), names=names)


def with_scans(cohort: Cohort, counts: list[int]) -> Cohort:
    """The first so many scans of each subject."""
    seen: dict[str, int] = {}
    kept = []
    for row, subject in enumerate(cohort.table.texts("subject")):
        seen[subject] = seen.get(subject, 0) + 1
        if seen[subject] <= counts[list(seen).index(subject)]:
            kept.append(row)
    return cohort.take(kept)


@pytest.mark.parametrize("varies", [False, True])
def test_scans_that_all_stand_there_three_times_change_nothing(varies: bool) -> None:
    cohort = with_scans(drawn(20, 6, repeats=4), [1, 2, 3, 4] * 5)
    if varies:
        age = cohort.table.numbers("age") + np.random.default_rng(0).standard_normal(len(cohort))
        cohort = replace(cohort, table=replace(cohort.table, columns={**cohort.table.columns,
                                                                      "age": numbers_as_text(age)}))  # fmt: skip
    # Within a subject three equal scans have more orders than one, so p of a target that varies there is left out.
    one, three = (
        regress(each_scan_repeated(cohort, times), "age", folds=5, permutations=0 if varies else 19, draws=50)
        for times in (1, 3)
    )
    for name, measure in one.measures.items():
        other = three.measures[name]
        assert [other.value, other.low, other.high] == pytest.approx([measure.value, measure.low, measure.high])
    for name in ("predicted", "low", "high", "baseline"):
        assert np.allclose(getattr(three, name)[::3], getattr(one, name), rtol=1e-9), name
    assert np.allclose(three.shapes.slope, one.shapes.slope)
    assert np.allclose(three.shapes.per_unit_mm, one.shapes.per_unit_mm)
    assert three.p == one.p and three.choice == one.choice and three.effective == pytest.approx(one.effective)
    assert three.shapes.ends == pytest.approx(one.shapes.ends)
    assert [three.baseline_rmse, three.baseline_mae] == pytest.approx([one.baseline_rmse, one.baseline_mae])
    told, again = (found.predictor.predict(drawn(5, 7)) for found in (one, three))
    for name in ("value", "low", "high"):
        assert np.allclose(getattr(told, name), getattr(again, name), rtol=1e-9), name
    assert told.outside == again.outside


def test_the_shapes_shown_are_at_the_percentiles_of_one_value_for_each_subject() -> None:
    cohort = drawn(40, 8)
    found = regress(cohort, "age", folds=5, permutations=0, draws=1)
    low, high = np.percentile(cohort.table.numbers("age"), [5, 95])
    assert found.shapes.ends == pytest.approx((low, high), rel=1e-12)


def test_one_subject_with_forty_scans_does_not_make_a_relation() -> None:
    r2, p = [], []
    for seed in range(12):
        cohort = with_scans(drawn(30, seed, repeats=40, told=False), [40] + [1] * 29)
        found = regress(cohort, "age", permutations=19, draws=1, seed=seed)
        r2.append(found.measures["r2"].value)
        p.append(found.p)
    assert np.mean(r2) < 0.0
    assert np.mean(p) == pytest.approx(0.5, abs=0.25)


def test_targets_of_subjects_are_exchanged_whatever_their_number_of_scans() -> None:
    cohort = with_scans(drawn(20, 9, repeats=20), list(range(1, 21)))
    found = regress(cohort, "age", folds=5, permutations=99, draws=1)
    assert found.p is not None and found.p < 0.2, "no two subjects have as many scans"
    assert permutation_scheme(found.subjects, found.observed).endswith("the targets of all 20 subjects.")
    assert scheme_text(found.methods.tests[0]) == "permutation of subjects"


def test_methods_state_the_scheme_of_targets_that_vary_within_subjects() -> None:
    cohort = drawn(20, 9, repeats=2)
    ages = numbers_as_text(cohort.table.numbers("age") + 0.1 * np.arange(40))
    cohort = replace(cohort, table=Table({**cohort.table.columns, "age": ages}, cohort.names))
    found = regress(cohort, "age", folds=5, permutations=9, draws=1)
    text = scheme_text(found.methods.tests[0])
    assert text == "values permuted within subjects, and between subjects with the same number of scans"


def test_new_subjects_count_once_in_the_figures_of_new_shapes(learned: RegressionResult) -> None:
    new = drawn(30, 50)
    many = new.take([*range(30), *[0] * 20])
    share = share_of(many.table.texts("subject"))
    once = compare_with(learned.predictor.predict(new), new.table.numbers("age"))
    assert compare_with(learned.predictor.predict(many), many.table.numbers("age"), share) == pytest.approx(once)


def test_no_subject_stands_in_two_folds() -> None:
    codes = np.random.default_rng(0).integers(0, 23, 90)
    folds = folds_of(codes, 5, np.random.default_rng(1))
    assert all(len(np.unique(folds[codes == k])) == 1 for k in np.unique(codes))
    assert set(np.bincount(folds[np.unique(codes, return_index=True)[1]])) <= {4, 5}


def test_scans_of_a_subject_do_not_tell_its_other_scans() -> None:
    cohort = drawn(25, 3, repeats=4, told=False)
    assert regress(cohort, "age", permutations=0).measures["r2"].value < 0.1
    alone = replace(cohort, table=Table({"age": cohort.table.texts("age")}, cohort.names))
    told = regress(alone, "age", permutations=0).measures["r2"].value
    assert told > 0.2 + regress(cohort, "age", permutations=0).measures["r2"].value, "or this test could not fail"


@pytest.mark.parametrize("repeats", [1, 3])
def test_figures_on_subjects_left_out_are_those_of_new_subjects(repeats: int) -> None:
    told, new, coverage, slopes = [], [], [], []
    for seed in range(8):
        found = regress(drawn(60, seed, repeats=repeats), "age", permutations=0, draws=200, seed=seed)
        other = drawn(300, 100 + seed)
        r2, _, inside = compare_with(found.predictor.predict(other), other.table.numbers("age"))
        told.append(found.measures["r2"].value)
        new.append(r2)
        coverage += [inside, found.measures["coverage"].value]
        slopes.append(found.measures["slope"].value)
    assert np.mean(told) == pytest.approx(np.mean(new), abs=0.08)
    assert np.mean(new) > 0.5
    assert 0.86 <= np.mean(coverage) <= 0.96
    assert 0.85 <= np.mean(slopes) <= 1.1


def test_a_number_that_shape_does_not_tell_is_rarely_claimed_to_be() -> None:
    claimed = 0
    for seed in range(40):
        found = regress(drawn(15, seed, told=False), "age", folds=5, permutations=19, draws=1, seed=seed)
        assert found.p is not None
        claimed += found.p <= 0.05
    assert claimed <= 6


def test_a_number_that_shape_tells_is_claimed_to_be(learned: RegressionResult) -> None:
    assert learned.p == 1 / 20 and learned.measures["r2"].low > 0


def test_the_shape_that_goes_with_the_number_is_what_was_put_in() -> None:
    found = regress(drawn(400, 5), "age", permutations=0, folds=3)
    expected = SLOPES * STDDEV / ((SLOPES**2).sum() + 25.0)
    assert np.allclose(found.shapes.slope, expected, atol=0.12)
    low, high = found.shapes.ends
    moved = found.cohort.vertices(found.shapes.path[-1]) - found.cohort.vertices(found.shapes.path[0])
    assert np.allclose(moved.ravel(), (high - low) * (expected @ BASIS), atol=0.12 * (high - low))


def test_the_same_seed_gives_the_same_numbers(learned: RegressionResult) -> None:
    again, other = (regress(drawn(60, 1), "age", permutations=19, seed=seed) for seed in (0, 1))
    assert again.measures == learned.measures and again.p == learned.p
    assert np.array_equal(again.low, learned.low) and not np.array_equal(other.predicted, learned.predicted)


def test_intervals_count_each_subject_once() -> None:
    ways, fold = np.zeros((1, 2)), np.array([0, 0, 0, 0, 1, 1])
    residuals, share = np.array([9.0, 9.0, 9.0, 9.0, 1.0, 2.0]), np.array([0.25] * 4 + [1.0, 1.0])
    low, high = cv_plus(ways, residuals, fold, share, 0.5)
    assert (low[0], high[0]) == (-2.0, 2.0)  # 4/3 of 3 subjects at 0.5 are 2


def test_a_saved_predictor_predicts_the_same(learned: RegressionResult, tmp_path: Path) -> None:
    learned.predictor.save(tmp_path / "age.npz")
    new = drawn(5, 77)
    first, again = learned.predictor.predict(new), Predictor.load(tmp_path / "age.npz").predict(new)
    assert np.array_equal(first.value, again.value) and np.array_equal(first.low, again.low)
    assert (first.low < first.value).all() and (first.value < first.high).all()


@pytest.mark.parametrize("harm", ["short", "empty", "not finite", "other folds", "object", "other facts", "shapes"])
def test_a_damaged_predictor_is_refused(learned: RegressionResult, tmp_path: Path, harm: str) -> None:
    path = tmp_path / "age.npz"
    learned.predictor.save(path)
    with np.load(path) as stored:
        arrays = dict(stored)
    if harm == "short":
        path.write_bytes(path.read_bytes()[:-300])
    elif harm == "empty":
        path.write_bytes(b"")
    elif harm == "object":
        np.savez(path, **{**arrays, "residuals": np.array([{}], dtype=object)})
    else:
        changed = {
            "not finite": {"weights": arrays["weights"] * np.nan},
            "other folds": {"fold": arrays["fold"] + 10},
            "other facts": {"facts": np.array(str(arrays["facts"]).replace("form", "from"))},
            "shapes": {"mean": arrays["mean"][:-1]},
        }[harm]
        np.savez(path, **{**arrays, **changed})
    with pytest.raises(FileFormatError, match=r"age\.npz .*make it again with shapespace regress"):
        Predictor.load(path)


def test_a_predictor_with_pickles_is_never_run(learned: RegressionResult, tmp_path: Path) -> None:
    path = tmp_path / "age.npz"
    learned.predictor.save(path)
    with zipfile.ZipFile(path) as archive:
        assert all(b"pickle" not in archive.read(name)[:200] for name in archive.namelist())
        assert {name for name in archive.namelist() if "facts" in name} == {"facts.npy"}


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_new_surfaces_are_predicted_alike_in_any_pose(gauge: str) -> None:
    thing, rng = symmetric_object(20, 8), np.random.default_rng(4)
    amount = rng.standard_normal(25)
    shapes = thing.x + amount[:, None, None] * thing.smooth(rng, 1)[0] + 0.1 * thing.smooth(rng, 25)
    cohort = replace(cohort_of(thing, shapes, amount=amount.tolist()))
    cohort = Cohort.of_shapes(shapes, {"amount": amount.tolist()}, faces=thing.faces, gauge=gauge)  # type: ignore[arg-type]
    found = regress(cohort, "amount", folds=5, permutations=0, draws=10)
    one, turned = shapes[3:4], posed(shapes[3:4], rng) * (1.0 if gauge == "form" else 2.0)
    first, other = (
        found.predictor.predict(Cohort.of_shapes(s, {}, faces=thing.faces, gauge=gauge, least=1))  # type: ignore[arg-type]
        for s in (one, turned)
    )
    assert first.value[0] == pytest.approx(other.value[0], abs=1e-6)
    assert first.value[0] == pytest.approx(amount[3], abs=0.3)


def test_what_lies_outside_is_said(learned: RegressionResult) -> None:
    far, near = 20 * np.ones(K), np.zeros(K)
    steep = 20 * SLOPES / STDDEV / np.linalg.norm(SLOPES / STDDEV)
    new = replace(drawn(3, 0), coefficients=read_only(np.stack([far * 5, near, steep])))
    told = replace(learned.predictor, highest=60.0).predict(new)
    assert "mm RMS from the mean, beyond all training shapes" in told.outside[0]
    assert told.outside[1] == "" and "was learned between" in told.outside[2]


def fits(rng: np.random.Generator, model: ShapeModel, n: int) -> Cohort:
    b = rng.standard_normal((n, model.n_modes)) * model.stddev
    names = [f"fit {k}" for k in range(n)]
    fitted = FitDiagnostics(model, read_only(b), read_only(0.1 * np.ones_like(b)), ("converged",) * n, "fits")
    table = Table({"age": numbers_as_text(b[:, 0])}, tuple(names))
    return Cohort.of_fits(fitted, names, table, read_only(np.full(n, np.nan)))


def test_fits_are_predicted_by_their_own_model_alone() -> None:
    thing, rng = symmetric_object(20, 8), np.random.default_rng(0)
    shapes = thing.x + thing.smooth(rng, 8)
    model, other = (ShapeModel.fit([Mesh(x, thing.faces) for x in some]) for some in (shapes, shapes[:7]))
    found = regress(fits(rng, model, 20), "age", folds=5, permutations=0, draws=10)
    new = fits(rng, model, 1)
    assert found.predictor.predict(new).value[0] == pytest.approx(new.table.numbers("age")[0], abs=0.5)
    with pytest.raises(CorrespondenceError, match="fits by another model"):
        found.predictor.predict(fits(rng, other, 2))
    with pytest.raises(CorrespondenceError, match="new shapes are surfaces"):
        found.predictor.predict(Cohort.of_shapes(shapes, {}, faces=thing.faces))


def test_new_shapes_of_another_kind_are_refused(learned: RegressionResult) -> None:
    with pytest.raises(CorrespondenceError, match="have 4 vertices"):
        learned.predictor.predict(Cohort.of_shapes(np.random.default_rng(0).standard_normal((2, 4, 3)), {}))
    with pytest.raises(InputError, match="learned in the gauge form, not shape"):
        learned.predictor.predict(replace(drawn(3, 0), gauge="shape"))
    with pytest.raises(InputError, match="b was learned from too"):
        refuse_known(("a", "b"), ("b", "c"), "new.csv")


def changed(cohort: Cohort, **columns: tuple[str, ...]) -> Cohort:
    return replace(cohort, table=replace(cohort.table, columns={**cohort.table.columns, **columns}))


def test_tables_that_teach_nothing_are_refused() -> None:
    cohort = drawn(12, 1)
    with pytest.raises(InputError, match="has no column 'bmi'"):
        regress(cohort, "bmi")
    with pytest.raises(InputError, match="age is 3 for all shapes"):
        regress(changed(cohort, age=("3",) * 12), "age")
    with pytest.raises(InputError, match="'age' is 'old' at shape 1, which is no number"):
        regress(changed(cohort, age=("3", "old", *("4",) * 10)), "age")
    with pytest.raises(InputError, match=r"age of 1 of 12 shapes is missing \(shape 2\)"):
        regress(changed(cohort, age=("3", "4", "", *("5",) * 9)), "age")
    with pytest.raises(InputError, match="9 subjects are too few to learn age from"):
        regress(cohort.take(range(9)), "age", folds=3)
    with pytest.raises(InputError, match="12 subjects are too few to learn age from in 13 folds"):
        regress(cohort, "age", folds=13)
    with pytest.raises(InputError, match=r"subject of 1 of 12 shapes is missing \(shape 0\)"):
        regress(changed(cohort, subject=("", *("a",) * 11)), "age")


@pytest.mark.parametrize(
    "options", [{"folds": 2}, {"permutations": -1}, {"confidence": 1.0}, {"seed": -1}, {"draws": 0}]
)
def test_options_that_cannot_be_are_refused(options: dict[str, int]) -> None:
    with pytest.raises(InputError, match=r"must|needs"):
        regress(drawn(12, 1), "age", **options)  # type: ignore[arg-type]


def test_the_answer_says_that_a_sample_is_small_and_can_be_read(learned: RegressionResult, tmp_path: Path) -> None:
    new = drawn(4, 9)
    answer = regression_report(learned, (new, learned.predictor.predict(new)))
    said = " ".join(answer.summary)
    assert "60 subjects are a small sample (fewer than 100)" in said and "4 new shapes are predicted" in said
    assert "Their age is known: RMSE" in said
    told = json.loads(answer.save(tmp_path).read_text())
    assert [read_part(part, "part").title for part in told["parts"]][:2] == ["On held-out subjects", "Calibration"]
    assert told["methods"]["subjects"] == 60
    assert {test["resampling"] for test in told["methods"]["tests"]} <= {"permutation", "bootstrap"}
    rows = (tmp_path / "predictions.csv").read_text().splitlines()
    assert rows[0] == "scan,subject,observed,predicted,low,high,baseline" and len(rows) == 61
    alone = prediction_report(learned.predictor, new, learned.predictor.predict(new))
    assert "of 4 shapes" in alone.summary[0] and list(alone.tables) == ["new.csv"]


def test_a_target_that_all_subjects_go_through_is_dealt_out_within_them_too() -> None:
    base = drawn(15, 4, repeats=2)
    visit = np.tile([0.0, 1.0], 15)
    moved = base.coefficients + 12.0 * visit[:, None] * np.eye(K)[1]
    for shapes, finds in ((moved, True), (base.coefficients, False)):
        table = replace(base.table, columns={**base.table.columns, "visit": numbers_as_text(visit)})
        found = regress(replace(base, coefficients=read_only(shapes), table=table), "visit", permutations=39)
        assert found.p is not None and (found.p <= 0.05) == finds
