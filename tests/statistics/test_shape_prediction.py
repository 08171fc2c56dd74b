"""Mean shapes along a number: known growth is found in mm, with intervals that contain it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import sqrtm
from scipy.stats import t

from shapespace import errors
from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table, numbers_as_text
from shapespace.report.analyses.regression_report import shape_prediction_report
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.shape_prediction import ShapePrediction, predict_shapes
from shapespace.statistics.subject_regression import SubjectRegression

V = 12
POINTS = np.random.default_rng(0).standard_normal((V, 3)) * 20.0
FACES = np.array([[k, (k + 1) % V, (k + 2) % V] for k in range(V)], dtype=np.int32)
GROWTH = np.random.default_rng(1).standard_normal((V, 3)) * 0.1
"""Millimetres per year."""
BEND = np.random.default_rng(2).standard_normal((V, 3)) * 0.002
SEX = np.random.default_rng(3).standard_normal((V, 3))


def truth(age: float, bend: float = 0.0) -> NDArray[np.float64]:
    return POINTS + (age - 40.0) * GROWTH + bend * (age - 40.0) ** 2 * BEND


def study(
    n: int = 30, seed: int = 0, scans: int = 1, noise: float = 1.0, unequal: bool = False, sex: float = 0.0,
    bend: float = 0.0, faces: NDArray[np.int32] | None = None,
) -> Cohort:  # fmt: skip
    """Shapes of subjects of 20 to 60 years, with noise that may triple with age; scans of a subject are alike."""
    rng = np.random.default_rng(seed)
    ages = np.repeat(rng.uniform(20.0, 60.0, n), scans)
    women = np.repeat(np.arange(n) % 2, scans)
    spread = noise * (1.0 + (ages - 20.0) / 20.0 if unequal else np.ones(n * scans))
    off = np.repeat(rng.standard_normal((n, V, 3)), scans, axis=0) + 0.5 * rng.standard_normal((n * scans, V, 3))
    shapes = np.stack([truth(age, bend) for age in ages]) + spread[:, None, None] * off
    shapes += sex * women[:, None, None] * SEX
    columns = {
        "age": ages, "sex": ["male" if woman == 0 else "female" for woman in women],
        "subject": [f"s{k // scans:03d}" for k in range(n * scans)],
    }  # fmt: skip
    return Cohort.of_shapes(shapes, columns, faces=faces, gauge="form", align=False,
                            landmarks={"first": 0, "second": 1})  # fmt: skip


def shapes_of(found: ShapePrediction) -> NDArray[np.float64]:
    return np.stack([found.cohort.vertices(own) for own in found.coefficients])


def with_column(cohort: Cohort, name: str, cells: tuple[str, ...]) -> Cohort:
    return replace(cohort, table=replace(cohort.table, columns={**cohort.table.columns, name: cells}))


@pytest.mark.parametrize(("curve", "bend"), [("linear", 0.0), ("spline", 0.0)])
def test_linear_growth_without_noise_is_found_exactly(curve: str, bend: float) -> None:
    found = predict_shapes(study(noise=0.0), "age", at=(30, 40, 55), curve=curve, permutations=0)  # type: ignore[arg-type]
    for age, shape in zip((30, 40, 55), shapes_of(found), strict=True):
        np.testing.assert_allclose(shape, truth(age), atol=1e-9)
    rms = np.sqrt((GROWTH**2).sum() / V)
    np.testing.assert_allclose(found.distance_mm, rms * np.array([0, 10, 25]), atol=1e-9)
    low, high = found.ends
    assert found.change_mm == pytest.approx((rms * (high - low), 0.0), abs=1e-9)
    np.testing.assert_allclose(found.slope @ found.cohort.basis, GROWTH.ravel(), atol=1e-10)


def test_a_spline_follows_growth_that_slows_down_and_a_line_does_not() -> None:
    made = study(n=200, noise=0.1, bend=1.0)
    ages = (25, 40, 55)
    off = {
        curve: max(np.abs(shape - truth(age, 1.0)).max() for age, shape in zip(ages, shapes_of(found), strict=True))
        for curve in ("linear", "spline")
        for found in [predict_shapes(made, "age", at=ages, curve=curve, permutations=0)]  # type: ignore[arg-type]
    }
    assert off["spline"] < 0.2 < 0.6 < off["linear"]


def test_the_order_of_the_rows_does_not_matter() -> None:
    made = study(scans=2)
    one, other = (
        predict_shapes(cohort, "age", curve="spline", permutations=100)
        for cohort in (made, made.take(np.random.default_rng(0).permutation(len(made)).tolist()))
    )
    assert one.p == other.p
    np.testing.assert_allclose(shapes_of(one), shapes_of(other), atol=1e-9)
    np.testing.assert_allclose(one.half_width_mm(0), other.half_width_mm(0), atol=1e-9)


def test_landmarks_and_surfaces_of_the_same_points_have_the_same_mean_shapes() -> None:
    points, surfaces = (predict_shapes(study(faces=faces), "age", permutations=100) for faces in (None, FACES))
    assert points.p == surfaces.p and points.change_mm == pytest.approx(surfaces.change_mm)
    np.testing.assert_allclose(shapes_of(points), shapes_of(surfaces), atol=1e-9)
    assert points.half_width_mm(0).shape == (V, 3) and surfaces.half_width_mm(0).shape == (V,)
    # A normal is a direction, along which the mean has no more error than along all axes together.
    assert (surfaces.half_width_mm(0) <= np.linalg.norm(points.half_width_mm(0), axis=1) + 1e-12).all()


def test_copies_of_scans_change_nothing() -> None:
    """Every scan of a subject is there once, twice or three times."""
    made = study(scans=2)
    rows = [row for row in range(len(made)) for _ in range(1 + row // 2 % 3)]
    copied = made.take(rows)
    copied = replace(copied, names=tuple(f"{name} {k}" for k, name in enumerate(copied.names)))
    one, more = (predict_shapes(cohort, "age", permutations=100) for cohort in (made, copied))
    assert one.p == more.p
    np.testing.assert_allclose(one.df, more.df)
    np.testing.assert_allclose(shapes_of(one), shapes_of(more), atol=1e-9)
    for k in range(len(one.df)):
        np.testing.assert_allclose(one.half_width_mm(k), more.half_width_mm(k), atol=1e-9)


@pytest.mark.parametrize("scans", [1, 2])
def test_intervals_are_those_of_the_equations(scans: int) -> None:
    """S44 to S47, with complete matrices; ages of the two scans of a subject differ."""
    made = study(14, scans=scans, unequal=True)
    ages = made.table.numbers("age") + np.arange(len(made)) % scans
    found = predict_shapes(with_column(made, "age", numbers_as_text(ages)), "age", at=(30, 50), permutations=0)
    subjects, shapes = np.arange(len(made)) // scans, made.coefficients @ made.basis
    root = np.full(len(made), scans**-0.5)
    Z = root[:, None] * np.column_stack([np.ones(len(made)), ages])
    rest = np.eye(len(made)) - Z @ np.linalg.inv(Z.T @ Z) @ Z.T
    E = rest @ (root[:, None] * shapes)
    for k, age in enumerate((30, 50)):
        h = Z @ np.linalg.inv(Z.T @ Z) @ [1, age]
        corrected = np.zeros((len(made), 14))
        for g in range(14):
            own = np.flatnonzero(subjects == g)
            corrected[own, g] = np.linalg.inv(np.real(sqrtm(rest[np.ix_(own, own)]))) @ h[own]
        G = rest @ corrected
        df = np.trace(G.T @ G) ** 2 / np.trace(G.T @ G @ G.T @ G)
        width = t.ppf(0.975, df) * np.linalg.norm(corrected.T @ E, axis=0)
        assert found.df[k] == pytest.approx(df)
        np.testing.assert_allclose(found.half_width_mm(k).ravel(), width, rtol=1e-6)
        np.testing.assert_allclose(found.cohort.vertices(found.coefficients[k]).ravel(),
                                   made.reference.ravel() + h @ (root[:, None] * shapes), atol=1e-9)  # fmt: skip


@pytest.mark.parametrize(("n", "scans", "curve"), [(12, 1, "linear"), (30, 2, "linear"), (30, 1, "spline")])
def test_intervals_contain_the_true_mean_shape_where_variances_are_unequal(n: int, scans: int, curve: str) -> None:
    ages = (22.0, 40.0, 58.0)
    inside: list[NDArray[np.bool_]] = []
    for seed in range(40):
        made = study(n, seed, scans, unequal=True)
        observed = made.table.numbers("age")
        at = np.clip(ages, observed.min(), observed.max())
        found = predict_shapes(made, "age", at=tuple(at), curve=curve, permutations=0)  # type: ignore[arg-type]
        inside += [
            np.abs(shape - truth(age)) <= found.half_width_mm(k)
            for k, (age, shape) in enumerate(zip(at, shapes_of(found), strict=True))
            if found.is_known[k]
        ]
    assert len(inside) > 40
    # 36 coordinates of 40 studies are not independent; the exact coverage is in docs/regress.md.
    assert 0.91 < float(np.mean(inside)) < 0.99


def test_the_statistic_of_single_scans_is_that_of_compare_with_unequal_variances() -> None:
    made = study(n=20, sex=0.5, noise=4.0)
    women = np.array([1.0 if sex == "female" else -1.0 for sex in made.table.texts("sex")])
    columns = np.column_stack([np.ones(20), made.table.numbers("age"), women])
    f = SubjectRegression(columns, np.arange(20)).statistics([1], made.coefficients, 200, 0, None)
    test = compare(made, "~ age + sex", CompareConfig(variances="unequal", permutations=200, maps=False)).test("age")
    assert f[0] == pytest.approx(test.f) and abs(np.mean(f >= f[0]) - test.p) < 0.1
    assert predict_shapes(made, "age", covariates="sex", permutations=200).p == np.mean(f >= f[0])


def test_p_is_small_for_growth_and_seldom_without() -> None:
    assert predict_shapes(study(noise=0.2), "age", permutations=100).p == 0.01
    p: list[float] = []
    for seed in range(40):
        made = study(16, seed, 2, unequal=True)
        ages = np.random.default_rng(seed + 100).permutation(np.unique(made.table.numbers("age"))).repeat(2)
        found = predict_shapes(with_column(made, "other", numbers_as_text(ages)), "other", permutations=40)
        assert found.p is not None
        p.append(found.p)
    assert 0.3 < np.mean(p) < 0.7 and np.mean(np.array(p) <= 0.05) <= 0.15


def test_other_terms_are_held_at_their_average_or_at_a_stated_value() -> None:
    made = study(n=60, noise=0.05, sex=1.0)
    held = {
        name: shapes_of(predict_shapes(made, "age", at=(40,), covariates="sex", hold=hold, permutations=0))[0]
        for name, hold in {"all": {}, "female": {"sex": "female"}, "male": {"sex": "male"}}.items()
    }
    np.testing.assert_allclose(held["female"] - held["male"], SEX, atol=0.08)
    np.testing.assert_allclose(held["all"], (held["female"] + held["male"]) / 2, atol=1e-9)


def test_size_and_lengths_are_predicted_with_intervals_that_contain_them() -> None:
    inside = []
    for seed in range(30):
        found = predict_shapes(study(30, seed, noise=0.3), "age", at=(30, 50), lengths=[("first", "second")],
                               permutations=0)  # fmt: skip
        size, length = found.measures
        assert (size.name, length.name) == ("centroid size", "first to second")
        for k, age in enumerate((30, 50)):
            first, second = truth(age)[:2]
            inside.append(length.low[k] <= np.linalg.norm(first - second) <= length.high[k])
            center = truth(age) - truth(age).mean(axis=0)
            assert size.value[k] == pytest.approx(float(np.linalg.norm(center)), rel=0.02)
    assert np.mean(inside) > 0.85


def test_an_interval_from_too_few_subjects_is_not_known() -> None:
    made = study(10)
    ages = [20.0] * 4 + [21.0] * 5 + [60.0]
    found = predict_shapes(with_column(made, "age", numbers_as_text(np.array(ages))), "age", at=(20.5, 60))
    assert found.is_known.tolist() == [True, False, False]
    assert np.isnan(found.half_width_mm(1)).all() and np.isnan(found.measures[0].low[1])
    report = shape_prediction_report(found)
    assert "some intervals are not known" in report.summary[0]
    assert any("at age 60, so the interval there is not known" in one for one in report.summary)


def test_the_slider_of_the_report_passes_through_the_mean_shapes() -> None:
    found = predict_shapes(study(bend=1.0, faces=FACES), "age", curve="spline", permutations=0)
    report = shape_prediction_report(found)
    arrays = report.arrays["shapes.npz"]
    assert arrays["modes"].shape == (2, V, 3)
    for weights, own in zip(arrays["weights"], found.path, strict=True):
        shape = arrays["low"] + np.tensordot(weights, arrays["modes"], axes=1)
        np.testing.assert_allclose(shape, found.cohort.vertices(own), atol=1e-9)
    assert sorted(report.meshes) == sorted(f"age_{value:.6g}.ply" for value in found.values)
    np.testing.assert_allclose(arrays["shapes"], shapes_of(found))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"along": "sex"}, "contains classes, and shapes are predicted along a number"),
        ({"along": "same"}, "is 3 for all 30 shapes, so nothing changes along it"),
        ({"along": "weight"}, "no column"),
        ({"along": "gaps"}, "gaps of 1 of 30 shapes is missing"),
        ({"at": (10, 40)}, "shapes are not predicted beyond, at 10"),
        ({"at": (40, 90)}, "shapes are not predicted beyond, at 90"),
        ({"curve": "wave"}, "choose one of linear, spline"),
        ({"covariates": "poly(age, 2)"}, "follows from"),
        ({"covariates": "sex", "hold": {"sex": "other"}}, "cannot be held at 'other'"),
        ({"covariates": "sex", "hold": {"site": "1"}}, "the other columns of the model are: sex"),
        ({"covariates": "height", "hold": {"height": "500"}}, "cannot be held at 500"),
        ({"lengths": [("first", "third")]}, "needs two landmarks of the shapes: first, second"),
        ({"confidence": 1.0}, "the level between 0.5 and 1"),
    ],
)  # fmt: skip
def test_what_cannot_be_predicted_is_refused(options: dict[str, object], words: str) -> None:
    made = study()
    made = with_column(made, "same", ("3",) * 30)
    made = with_column(made, "gaps", ("", *("1", "2", "3") * 9, "4", "5"))
    made = with_column(made, "height", numbers_as_text(np.random.default_rng(7).uniform(150, 200, 30)))
    with pytest.raises(errors.InputError, match=words):
        predict_shapes(made, **{"along": "age", "permutations": 0, **options})  # type: ignore[arg-type]


def test_missing_numbers_are_left_out_on_demand() -> None:
    made = study()
    ages = ("", *made.table.texts("age")[1:])
    found = predict_shapes(with_column(made, "age", ages), "age", permutations=0, drop_missing=True)
    assert found.n_subjects == 29 and any("1 of 30 shapes are excluded" in note for note in found.cohort.notes)


@pytest.mark.parametrize(("n", "curve", "least"), [(9, "linear", 10), (19, "spline", 20)])
def test_too_few_subjects_are_refused_with_the_least_number(n: int, curve: str, least: int) -> None:
    with pytest.raises(errors.InputError, match=f"{n} subjects are too few .* {least} are the least"):
        predict_shapes(study(n, scans=2), "age", curve=curve, permutations=0)  # type: ignore[arg-type]
    assert predict_shapes(study(least, scans=2), "age", curve=curve, permutations=0).n_subjects == least  # type: ignore[arg-type]


def test_a_class_of_one_subject_is_refused() -> None:
    made = study()
    with pytest.raises(errors.InputError, match="fits a subject exactly"):
        predict_shapes(with_column(made, "site", ("a", *["b"] * 29)), "age", covariates="site", permutations=0)


def test_a_column_needs_no_plain_name() -> None:
    made = study()
    columns = {"age (years)": made.table.texts("age")}
    made = replace(made, table=Table(columns, made.table.rows, made.table.where))
    found = predict_shapes(made, "age (years)", curve="spline", permutations=0)
    assert "age_years_" in next(iter(shape_prediction_report(replace(found, cohort=replace(
        found.cohort, faces=FACES))).meshes))  # fmt: skip
