"""Linear models of shape: sums of squares by a plain oracle, permutation, blocks, maps, and what is refused."""

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table
from shapespace.errors import InputError
from shapespace.geometry.normals import vertex_normals
from shapespace.model.shape_model import ShapeModel
from shapespace.report.analyses.compare_report import compare_warnings
from shapespace.report.analyses.result_report import analysis_report
from shapespace.schemas import PARTS, Analysis, TablePart, TextPart, json_text
from shapespace.statistics import compare_maps
from shapespace.statistics.compare_formula import FUNCTIONS, design_of, random_effects_of
from shapespace.statistics.compare_shapes import CompareConfig, CompareResult, SquaresType, compare
from shapespace.statistics.compare_within import strata_of
from shapespace.statistics.effect_size import EFFECT_SIZES, effect_size
from shapespace.types import FloatArray, IntArray, Mesh

pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")

QUICK = CompareConfig(permutations=20, maps=False, variances="equal")
SIDE = 6


def surface() -> tuple[FloatArray, IntArray]:
    """A small curved surface of 36 vertices."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    points: FloatArray = np.stack([x, y, 0.1 * (x - 2.5) ** 2], axis=-1).reshape(-1, 3).astype(np.float64) * 10.0
    at = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = (at[i : SIDE - 1 + i, j : SIDE - 1 + j].ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]).astype(np.int32)


def cohort(columns: dict[str, Any], effect: FloatArray | None = None, seed: int = 0, stddev: float = 1.0) -> Cohort:
    """Shapes that are noise about a surface, with an `effect` (N, V, 3) beside it."""
    points, faces = surface()
    n = len(next(iter(columns.values())))
    noise = np.random.default_rng(seed).normal(size=(n, len(points), 3)) * stddev
    shapes = points + noise + (0.0 if effect is None else effect)
    return Cohort.of_shapes(shapes, columns, faces=faces, align=False)


def people(n: int = 37, seed: int = 1) -> dict[str, Any]:
    """An unbalanced table."""
    rng = np.random.default_rng(seed)
    return {
        "sex": rng.choice(["female", "male"], n, p=[0.6, 0.4]).tolist(),
        "site": rng.choice(["a", "b", "c"], n).tolist(),
        "age": rng.uniform(20, 60, n).tolist(),
    }


# A plain oracle: designs by hand, residual sums of squares by least squares.


def coded(values: list[str]) -> FloatArray:
    levels = sorted(set(values))
    out = np.zeros((len(values), len(levels) - 1))
    for row, value in enumerate(values):
        out[row] = -1.0 if value == levels[-1] else np.eye(len(levels) - 1)[levels.index(value)]
    return out


def pieces(table: dict[str, Any], formula: list[tuple[str, ...]]) -> dict[tuple[str, ...], FloatArray]:
    single = {
        name: np.array(v, dtype=float)[:, None] if isinstance(v[0], float) else coded(v) for name, v in table.items()
    }
    out: dict[tuple[str, ...], FloatArray] = {}
    for term in formula:
        columns = np.ones((len(table["sex"]), 1))
        for name in term:
            columns = np.stack([a * b for a in columns.T for b in single[name].T], axis=1)
        out[term] = columns
    return out


def left(shapes: FloatArray, columns: list[FloatArray]) -> tuple[float, int]:
    x = np.hstack([np.ones((len(shapes), 1)), *columns])
    beta = np.linalg.lstsq(x, shapes, rcond=None)[0]
    return float(((shapes - x @ beta) ** 2).sum()), len(shapes) - int(np.linalg.matrix_rank(x))


def beside(term: tuple[str, ...], terms: list[tuple[str, ...]], squares: str) -> list[tuple[str, ...]]:
    if squares == "I":
        return terms[: terms.index(term)]
    others = [other for other in terms if other != term]
    return others if squares == "III" else [other for other in others if not set(term) < set(other)]


FORMULAS = {
    "~ sex + age": [("sex",), ("age",)],
    "~ age + site": [("age",), ("site",)],
    "~ sex * site + age": [("sex",), ("site",), ("age",), ("sex", "site")],
    "~ sex * age * site": [("sex",), ("age",), ("site",), ("sex", "age"), ("sex", "site"), ("age", "site"),
                           ("sex", "age", "site")],
}  # fmt: skip


@pytest.mark.parametrize(("formula", "squares"), list(itertools.product(FORMULAS, ("I", "II", "III"))))
def test_sums_of_squares_r2_and_f_are_those_of_plain_least_squares(formula: str, squares: SquaresType) -> None:
    table, terms = people(), FORMULAS[formula]
    shapes = cohort(table)
    found = compare(shapes, formula, replace(QUICK, anova_type=squares))
    columns = pieces(table, terms)
    flat = np.stack([shapes.vertices(k).ravel() for k in range(len(shapes))])
    total = left(flat, [])[0]
    error, df_error = left(flat, list(columns.values()))
    for term in terms:
        reduced = [columns[other] for other in beside(term, terms, squares)]
        (without, df_without), (with_it, df_with) = left(flat, reduced), left(flat, [*reduced, columns[term]])
        test = found.test(":".join(term))
        df = df_without - df_with
        expected = (without - with_it, (without - with_it) / total, (without - with_it) / df / (error / df_error))
        assert test.df == df
        np.testing.assert_allclose((test.squares, test.r2, test.f), expected, rtol=1e-8)
    assert found.strata[0].df == df_error
    np.testing.assert_allclose(found.strata[0].squares, error, rtol=1e-8)
    np.testing.assert_allclose(found.strata[0].squares_total, total, rtol=1e-8)


@pytest.mark.parametrize("squares", ["I", "II", "III"])
def test_one_number_a_shape_gives_the_tables_of_statsmodels(squares: SquaresType) -> None:
    smf = pytest.importorskip("statsmodels.formula.api")
    anova = pytest.importorskip("statsmodels.stats.anova")
    pandas = pytest.importorskip("pandas")
    table = people(50)
    rng = np.random.default_rng(4)
    y = rng.normal(size=50) + 0.5 * (np.array(table["sex"]) == "male") + 0.02 * np.array(table["age"])
    points, _ = surface()
    shapes = points + y[:, None, None] * np.eye(3)[2] * (np.arange(len(points)) == 7)[:, None]
    found = compare(
        Cohort.of_shapes(shapes, table, align=False), "~ sex * age + site",
        CompareConfig(anova_type=squares, permutations=20, maps=False),
    )  # fmt: skip
    fitted = smf.ols("y ~ C(sex, Sum) * age + C(site, Sum)", pandas.DataFrame({**table, "y": y})).fit()
    expected = anova.anova_lm(fitted, typ=("I", "II", "III").index(squares) + 1)
    rows = {"sex": "C(sex, Sum)", "age": "age", "site": "C(site, Sum)", "sex:age": "C(sex, Sum):age"}
    if squares == "I":
        # Its terms stand in another order.
        rows = {"sex:age": rows["sex:age"]}
    for name, row in rows.items():
        test = found.test(name)
        np.testing.assert_allclose((test.squares, test.f), expected.loc[row, ["sum_sq", "F"]], rtol=1e-7)


def test_p_and_z_are_those_of_a_plain_loop_over_permuted_residuals() -> None:
    table = people(30)
    shift = 0.35 * (np.array(table["sex"]) == "male")[:, None, None] * np.ones((1, SIDE * SIDE, 1)) * [0, 0, 1]
    shapes = cohort(table, shift)
    test = compare(shapes, "~ age + sex", CompareConfig(permutations=2000, maps=False)).test("sex")
    flat = np.stack([shapes.vertices(k).ravel() for k in range(len(shapes))])
    columns = pieces(table, [("age",), ("sex",)])
    x0 = np.hstack([np.ones((30, 1)), columns["age",]])
    fit = x0 @ np.linalg.lstsq(x0, flat, rcond=None)[0]
    rng, drawn = np.random.default_rng(8), list[float]()
    for k in range(2000):
        y = fit + (flat - fit)[rng.permutation(30) if k else np.arange(30)]
        (without, _), (with_it, df) = left(y, [columns["age",]]), left(y, list(columns.values()))
        drawn.append((without - with_it) / (with_it / df))
    logs = np.log(drawn)
    p = np.mean(np.array(drawn) >= drawn[0])
    assert 0.001 < p < 0.2, "the case tests nothing"
    assert abs(test.p - p) < 4 * np.sqrt(2 * p * (1 - p) / 2000)
    assert abs(test.z - (logs[0] - logs.mean()) / logs.std()) < 0.15


def test_a_seed_gives_the_same_numbers_and_another_one_others() -> None:
    shapes = cohort(people())
    one, same, other = (
        compare(shapes, "~ sex + age", CompareConfig(permutations=100, seed=seed)) for seed in (3, 3, 4)
    )
    assert json_text(analysis_report(one).analysis().parts) == json_text(analysis_report(same).analysis().parts)
    for a, b in zip(one.effects, same.effects, strict=True):
        assert a.map is not None and b.map is not None
        np.testing.assert_array_equal(a.map.test.p_family, b.map.test.p_family)
    assert (one.tests[0].arrangements[1:] != other.tests[0].arrangements[1:]).any()
    assert one.tests[0].arrangements[0] == other.tests[0].arrangements[0]


def test_the_observed_arrangement_counts_so_no_p_is_zero() -> None:
    table = people()
    shift = 30.0 * (np.array(table["sex"]) == "male")[:, None, None] * np.ones((1, SIDE * SIDE, 3))
    found = compare(cohort(table, shift), "~ sex", CompareConfig(permutations=50))
    assert found.test("sex").p == 1 / 50
    assert found.effects[0].map is not None
    assert found.effects[0].map.any_way.p_family.min() == 1 / 50


# Blocks.


def repeated(subjects: int, scans: int, seed: int, between: float = 1.0, within: float = 0.3) -> tuple[Any, FloatArray]:
    """A table of repeated scans with a sex of each subject, and the shapes' differences by subject and by scan."""
    rng = np.random.default_rng([9, seed])
    who = np.repeat(np.arange(subjects), scans)
    sex = rng.permutation(["female", "male"] * subjects)[:subjects]
    own = rng.normal(size=(subjects, SIDE * SIDE, 3)) * between
    table = {
        "subject": [f"s{k}" for k in who],
        "sex": sex[who].tolist(),
        "smile": (["no", "yes"] * len(who))[: len(who)],
    }
    return table, own[who] + rng.normal(size=(len(who), SIDE * SIDE, 3)) * within


def test_a_difference_of_subjects_is_tested_on_their_means() -> None:
    table, noise = repeated(14, 3, 0)
    found = compare(cohort(table, noise, stddev=0.0), "~ sex", CompareConfig(blocks="subject", permutations=20))
    means = noise.reshape(14, 3, -1).mean(axis=1)
    sex = coded(table["sex"][::3])
    (without, df), (with_it, df_error) = left(means, []), left(means, [sex])
    test = found.test("sex")
    assert test.stratum == "between subject"
    assert (found.strata[0].df, found.strata[0].df_total) == (df_error, df) == (12, 13)
    np.testing.assert_allclose(
        (test.squares, test.f), (without - with_it, (without - with_it) / (with_it / df_error)), rtol=1e-8
    )


def test_a_difference_of_scans_is_tested_within_subjects() -> None:
    table, noise = repeated(9, 4, 1)
    found = compare(cohort(table, noise, stddev=0.0), "~ sex * smile", CompareConfig(blocks="subject", permutations=20))
    # Two scans of each smile are one observation of it.
    flat = noise.reshape(9, 2, 2, -1).mean(axis=1).reshape(18, -1)
    cells = {name: np.array(table[name]).reshape(9, 2, 2)[:, 0].ravel().tolist() for name in ("sex", "smile")}
    subject, smile = np.eye(9)[np.repeat(np.arange(9), 2)][:, 1:], coded(cells["smile"])
    both = smile * coded(cells["sex"])
    (without, _), (with_it, df) = left(flat, [subject, both]), left(flat, [subject, both, smile])
    test = found.test("smile")
    # Type II: without the interaction, of which smile is a part; the error is that of the whole model.
    error = with_it / df
    (without, _), (with_it, _) = left(flat, [subject]), left(flat, [subject, smile])
    assert [one.stratum for one in found.tests] == ["between subject", *["within subject: smile"] * 2]
    np.testing.assert_allclose(test.squares, without - with_it, rtol=1e-8)
    np.testing.assert_allclose(test.f, (without - with_it) / error, rtol=1e-8)
    assert found.strata[1].df == df == 7


def test_cells_are_permuted_only_within_their_subject_where_all_respond_alike() -> None:
    table, noise = repeated(6, 3, 2)
    table["visit"] = ["a", "b", "c"] * 6
    shapes = cohort(table, noise, stddev=0.0)
    design = design_of("~ sex + visit", shapes.table)
    between, within = strata_of(shapes.coefficients, design, table["subject"], "subject", "II", ()).every
    assert len(between.shapes) == 6
    who = np.repeat(np.arange(6), 3)
    moved: list[IntArray] = []
    for start, rows, signs in within.arrangements(120, 0):
        assert signs is None
        assert (np.sort(rows, axis=1) == np.arange(18)).all()
        assert (who[rows] == who).all()
        if start == 0:
            assert (rows[0] == np.arange(18)).all()
        moved.append(rows)
    assert {tuple(np.argsort(row[:3])) for row in np.concatenate(moved)} == set(itertools.permutations(range(3)))


def test_repeated_scans_taken_for_independent_find_what_is_not_there_and_blocks_do_not() -> None:
    found = {"subject": 0, None: 0}
    for seed in range(40):
        table, noise = repeated(12, 4, seed)
        for blocks in found:
            options = CompareConfig(blocks=blocks, permutations=60, maps=False)
            found[blocks] += compare(cohort(table, noise, stddev=0.0), "~ sex", options).test("sex").p <= 0.05
    assert found["subject"] <= 6
    assert found[None] >= 20


def test_that_repeated_scans_are_taken_for_independent_is_said() -> None:
    table, noise = repeated(8, 2, 0)
    assert any("--blocks subject" in one for one in compare_warnings(compare(cohort(table, noise), "~ sex", QUICK)))


def test_that_few_arrangements_differ_is_said() -> None:
    table = {"sex": ["female", "female", "male", "male"], "subject": list("abcd")}
    assert any("only 6 arrangements" in one for one in compare_warnings(compare(cohort(table), "~ sex", QUICK)))
    assert not compare_warnings(compare(cohort(people()), "~ sex", QUICK))


def test_type_iii_with_an_interaction_says_where_it_tests() -> None:
    options = CompareConfig(anova_type="III", permutations=20, maps=False)
    assert any("center(age)" in one for one in compare_warnings(compare(cohort(people()), "~ sex * age", options)))
    assert not compare_warnings(compare(cohort(people()), "~ sex * center(age)", options))


def test_subjects_who_lack_a_smile_do_not_seem_to_differ_by_it() -> None:
    table, noise = repeated(12, 4, 5, within=0.01)
    smile = np.array(table["smile"]) == "yes"
    shown = noise + 20.0 * smile[:, None, None] * [0, 0, 1]
    # All men but one lack half of their smiles.
    kept = [k for k in range(48) if not (table["sex"][k] == "male" and smile[k] and k % 4 == 1)]
    kept_table = {name: [cells[k] for k in kept] for name, cells in table.items()}
    options = CompareConfig(blocks="subject", permutations=20, maps=False)
    whole = compare(cohort(table, shown, stddev=0.0), "~ sex + smile", options).test("sex")
    found = compare(cohort(kept_table, shown[kept], stddev=0.0), "~ sex + smile", options)
    np.testing.assert_allclose(found.test("sex").squares, whole.squares, rtol=0.05)
    assert any("2 to 4" in one or "3 to 4" in one for one in compare_warnings(found))


# Maps and effects.


def test_maps_are_those_of_a_plain_test_at_each_vertex(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare_maps, "_VERTICES", 7)
    monkeypatch.setattr(compare_maps, "_BYTES", 7 * 3 * 8 * 2 * 11)
    table = people(25)
    shapes = cohort(table)
    found = compare(shapes, "~ age + sex", CompareConfig(permutations=60, variances="equal")).effects[1]
    stratum = strata_of(shapes.coefficients, design_of("~ age + sex", shapes.table), None, "").every[0]
    every = np.stack([shapes.vertices(k) for k in range(25)])
    normals = vertex_normals(Mesh(every.mean(axis=0), shapes.faces))
    columns = pieces(table, [("age",), ("sex",)])
    x0 = np.hstack([np.ones((25, 1)), columns["age",]])
    x1 = np.hstack([x0, columns["sex",]])

    def f(y: FloatArray) -> FloatArray:
        rss = [((y - x @ np.linalg.lstsq(x, y, rcond=None)[0]) ** 2) for x in (x0, x1)]
        a, b = (part.reshape(25, SIDE * SIDE, -1).sum(axis=(0, 2)) for part in rss)
        return (a - b) / (b / 22)

    for test, y in (
        (found.map.along, np.einsum("nvc,vc->nv", every, normals)),  # pyright: ignore[reportOptionalMemberAccess]
        (found.map.any_way, every.reshape(25, -1)),  # pyright: ignore[reportOptionalMemberAccess]
    ):
        fit = x0 @ np.linalg.lstsq(x0, y, rcond=None)[0]
        # Rows of the design are permuted, which is the inverse permutation of the residuals.
        orders = [np.argsort(row) for _, rows, _ in stratum.arrangements(60, 0) for row in rows]
        drawn = np.stack([f(fit + (y - fit)[order]) for order in orders])
        assert test is not None
        np.testing.assert_allclose(test.f, drawn[0], rtol=1e-8)
        np.testing.assert_allclose(test.p, (drawn >= drawn[0] * (1 - 1e-9)).mean(axis=0))
        largest = drawn.max(axis=1)
        np.testing.assert_allclose(test.p_family, (largest[:, None] >= drawn[0] * (1 - 1e-9)).mean(axis=0))
    beta = np.linalg.lstsq(x1, every.reshape(25, -1), rcond=None)[0]
    assert found.map is not None
    np.testing.assert_allclose(found.map.change_mm.ravel(), -2 * beta[2], atol=1e-9)


def test_a_change_that_was_put_in_comes_back_where_and_as_large_as_it_is() -> None:
    table = people(60)
    where = np.arange(SIDE * SIDE) < SIDE
    male = (np.array(table["sex"]) == "male")[:, None, None]
    older = (np.array(table["age"]) - 40.0)[:, None, None] / 10
    effect = male * where[:, None] * [0, 0, 3.0] + older * ~where[:, None] * [2.0, 0, 0]
    found = compare(cohort(table, effect, stddev=0.5), "~ sex + age", CompareConfig(permutations=200))
    sex, age = found.effects
    assert sex.map is not None and age.map is not None
    assert sex.label == "sex female to male"
    np.testing.assert_array_equal(sex.map.any_way.p_family <= 0.05, where)
    np.testing.assert_allclose(sex.map.change_mm, where[:, None] * [0, 0, 3.0], atol=0.6)
    np.testing.assert_allclose(
        found.cohort.vertices(sex.at_high) - found.cohort.vertices(sex.at_low), sex.map.change_mm, atol=1e-9
    )
    span = (found.design.variables[1].high - found.design.variables[1].low) / 10
    np.testing.assert_allclose(age.map.change_mm, ~where[:, None] * [2.0 * span, 0, 0], atol=0.6)
    assert [abs(one.degrees - 90) < 5 for one in found.angles] == [True]


def test_pairs_of_three_groups_are_compared_and_the_family_of_them_held() -> None:
    table = people(60)
    c = (np.array(table["site"]) == "c")[:, None, None] * np.ones((1, SIDE * SIDE, 1)) * [0, 0, 2.0]
    found = compare(cohort(table, c), "~ site", CompareConfig(permutations=200, maps=False)).effects
    assert [one.label for one in found] == ["site a to b", "site a to c", "site b to c"]
    assert found[0].p > 0.05 > max(found[1].p_family, found[2].p_family)
    assert all(one.p_family >= one.p for one in found)
    np.testing.assert_allclose([one.rms_mm for one in found[1:]], 2.0, atol=0.4)


def test_slopes_that_are_parallel_are_told_from_those_that_are_not() -> None:
    table = people(80)
    age = (np.array(table["age"]) - 40.0)[:, None, None] / 10 * np.ones((1, SIDE * SIDE, 1))
    male = (np.array(table["sex"]) == "male")[:, None, None]
    options = CompareConfig(permutations=200, maps=False)
    same = compare(cohort(table, age * [1.0, 0, 0]), "~ sex * age", options)
    other = compare(cohort(table, age * np.where(male, [1.0, 0, 0], [0, 1.0, 0])), "~ sex * age", options)
    angles = [next(one for one in found.angles if one.p is not None) for found in (same, other)]
    assert angles[0].p is not None and angles[1].p is not None
    assert angles[0].p > 0.05 > angles[1].p
    assert abs(angles[1].degrees - 90) < 20
    assert "sex:age" in {one.name for one in other.effects}


def test_allometry_finds_that_larger_shapes_are_of_another_shape() -> None:
    points, faces = surface()
    rng = np.random.default_rng(3)
    size = rng.uniform(0.8, 1.2, 40)
    shapes = size[:, None, None] * points + rng.normal(size=(40, len(points), 3)) * 0.3
    shapes[..., 2] += 10 * (size - 1)[:, None] * np.sin(points[:, 0] / 10)
    found = compare(
        Cohort.of_shapes(shapes, {"age": range(40)}, faces=faces), "~ log_size", CompareConfig(permutations=100)
    )
    assert found.test("log_size").p == 0.01
    assert found.effects[0].map is not None


def test_points_without_triangles_are_tested_by_the_length_of_their_change() -> None:
    points, _ = surface()
    table = people(30)
    shapes = points + np.random.default_rng(0).normal(size=(30, len(points), 3))
    found = compare(Cohort.of_shapes(shapes, table, align=False), "~ sex", CompareConfig(permutations=50))
    assert found.effects[0].map is not None and found.effects[0].map.along is None
    assert {type(part).__struct_config__.tag for part in analysis_report(found).parts} <= set(PARTS)


def test_an_answer_is_written_with_all_that_its_parts_name(tmp_path: Path) -> None:
    found = compare(cohort(people()), "~ sex * age", CompareConfig(permutations=50))
    answer = analysis_report(found)
    assert answer.save(tmp_path).name == Analysis.FILE
    for part in answer.parts:
        file = getattr(part, "arrays", "")
        if file:
            with np.load(tmp_path / file) as arrays:
                named = {getattr(part, name, "") for name in ("vertices", "faces", "values", "mask", "low", "high")}
                assert named - {""} <= set(arrays.files)
    rows = (tmp_path / "terms.csv").read_text("utf-8").splitlines()
    assert [row.partition(",")[0] for row in rows] == ["term", "sex", "age", "sex:age", "residual", "total"]


# What is refused.


HOSTILE = [
    "~ __import__('os').system('touch HURT')",
    "~ log(__import__('os').system('touch HURT'))",
    "~ {__import__('os').system('touch HURT')}",
    "~ C(open('HURT', 'w'))",
    "~ poly(age, open('HURT', 'w'))",
    "~ log(age, base=open('HURT', 'w'))",
    "~ eval('1')",
    "~ np.save('HURT', age)",
    "~ age.__class__.__mro__",
    "~ [open(x, 'w') for x in ['HURT']]",
    "~ (lambda: open('HURT', 'w'))()",
    "~ I(open('HURT', 'w'))",
    "~ Q('age')",
    "~ poly(age, 999999999)",
    "~ (sex + age + site)**999",
    "~ ((sex + age)**3)**3",
    "~ sex*age*site*sex*age*site*sex",
    "~ " + "+".join(["age"] * 500),
    "~ `age`; open('HURT', 'w')",
    "~ age | sex",
    "~ @age",
]


@pytest.mark.parametrize("formula", HOSTILE, ids=range(len(HOSTILE)))
def test_a_formula_runs_nothing_and_ends_in_a_sentence(
    formula: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(people(), formula, "formula")
    assert not list(tmp_path.iterdir())


def refused(table: dict[str, Any], formula: str, *words: str, options: CompareConfig = QUICK) -> None:
    with pytest.raises(InputError) as caught:
        compare(cohort(table), formula, options)
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert text.endswith(".") and "\n" not in text and "\x1b" not in text, text
    assert len(text) < 300, text


@pytest.mark.parametrize(
    ("formula", "words"),
    [
        ("~ weight", ("'weight'", "no column", "sex")),
        ("~ sex +", ("cannot be read",)),
        ("~ (sex", ("cannot be read",)),
        ("", ("names no column",)),
        ("~ 1", ("names no column",)),
        ("~ sex - 1", ("mean shape",)),
        ("shape ~ sex", ("before ~",)),
        ("~ log(sex)", ("needs numbers", "'sex'")),
        ("~ C(age, 3)", ("one column",)),
        ("~ log(low)", ("not finite",)),
        ("~ one", ("'one' is 'x' for all",)),
        ("~ same", ("'same' is 3 for all",)),
        ("~ age + older", ("older follows from",)),
        ("~ sex + both", ("follows from",)),
        ("~ sex * nested", ("follows from", "empty group")),
        ("~ each", ("columns for 37 shapes, so that no degrees of freedom are left",)),
        ("~ mixed", ("'mixed' contains numbers but 'old'",)),
        ("~ holes", ("holes of 2 of 37", "missing=drop")),
    ],
)
def test_tables_and_formulas_that_cannot_be_are_refused(formula: str, words: tuple[str, ...]) -> None:
    table = people()
    age = table["age"]
    table |= {
        "low": [0.0, *age[1:]],
        "one": ["x"] * 37,
        "same": [3.0] * 37,
        "older": [2 * value + 1 for value in age],
        "both": [f"is {sex}" for sex in table["sex"]],
        "nested": ["f" if sex == "female" else site for sex, site in zip(table["sex"], table["site"], strict=True)],
        "each": [f"id{k}" for k in range(37)],
        "mixed": ["old", *age[1:]],
        "holes": [None, None, *age[2:]],
    }
    refused(table, formula, *words)


ODD_NAMES = ("Group #", "body mass (g)", "a:b", "a-b", "x|y", "*~^", "2nd", "50 %", "größe,", "it's", "C(x)", "[1] {y}")


@pytest.mark.parametrize("name", ODD_NAMES)
@pytest.mark.parametrize(
    "form", ["{0}", "C({0})", "log({0}) + age", "poly({0}, 2) * sex", "sex:{0} + sex", "({0} + age)^2"]
)
def test_any_column_can_be_named_in_backticks(name: str, form: str) -> None:
    values = np.tile([1.0, 2.0, 4.0], 7)
    columns = {**people(21), "plain": values.tolist()}
    plain = design_of(f"~ {form.format('plain')}", cohort(columns).table)
    odd = design_of(f"~ {form.format(f'`{name}`')}", cohort({**columns, name: values.tolist()}).table)
    np.testing.assert_array_equal(odd.matrix, plain.matrix)
    assert [term.label for term in odd.terms] == [term.label.replace("plain", name) for term in plain.terms]
    assert name in {one.name.removeprefix("C(").removesuffix(")") for one in odd.variables} | {
        one.name for one in odd.variables
    }


@pytest.mark.parametrize("formula", ["~ Group #", "~ sex + Group #", "~ C(Group #)", "~ `Group #` + Group #"])
def test_a_name_that_needs_backticks_is_shown_with_them(formula: str) -> None:
    refused(
        {**people(), "Group #": ["a", "b"] * 18 + ["a"], "#": [1] * 37}, formula, "write `Group #` with its backticks"
    )


def test_few_whole_numbers_that_are_used_as_a_number_are_named_first() -> None:
    table = {**people(24), "family": [13, 14, 15, 16] * 6, "Day #": [1, 2, 5] * 8, "two": [0, 1] * 12,
             "half": [0.5, 1, 2] * 7 + [0.5] * 3, "years": list(range(24))}  # fmt: skip
    result = compare(cohort(table), "~ family + `Day #` + two + half + years", QUICK)
    told = result.cohort.cautions
    assert result.tests[0].df == 1 and len(told) == 2
    assert told[0] == (
        "family has 4 different integers (13, 14, 15, 16) and is used as a number, with 1 degree of freedom; if "
        "they are codes of classes, write C(family), with 3."
    )
    assert "write C(`Day #`), with 2." in told[1]
    assert analysis_report(result).summary[1:3] == told
    classes = compare(cohort(table), "~ C(family) + log(`Day #`)", QUICK)
    assert classes.cohort.cautions == () and [test.df for test in classes.tests] == [3, 1]


def test_codes_that_are_used_as_classes_are_counted_and_single_ones_named() -> None:
    table = {**people(24), "family": [13, 14, "15.0", 15] * 5 + [14, 15, 16, 15]}
    notes = compare(cohort(table), "~ C(family)", QUICK).cohort.notes
    assert "Shapes in each class of family: 15 12, 14 6, 13 5, 16 1." in notes
    assert any(note.startswith("family has 1 class with one shape ('16')") for note in notes)
    assert not any("family" in note for note in compare(cohort(table), "~ family", QUICK).cohort.notes)


def test_missing_rows_are_left_out_when_asked_and_said() -> None:
    table = people() | {"holes": [None, None, *people()["age"][2:]]}
    found = compare(cohort(table), "~ holes", CompareConfig(permutations=20, maps=False, drop_missing=True))
    assert len(found.cohort) == 35
    assert any("2 of 37" in note for note in analysis_report(found).notes)


def test_sizes_that_are_not_known_are_asked_for() -> None:
    shapes, _ = fits_with_a_bump(0.0)
    with pytest.raises(InputError, match=r"60 of 60 shapes is not known in mm.*--unit"):
        compare(shapes, "~ log_size", QUICK)


def test_blocks_that_cannot_be_are_refused() -> None:
    table = people() | {"who": ["anna"] * 37, "pair": [f"p{k // 19}" for k in range(37)]}
    of = {name: CompareConfig(blocks=name, permutations=20, maps=False) for name in ("who", "pair", "nobody")}
    refused(table, "~ sex", "one who", options=of["who"])
    refused(table, "~ pair", "1 column between pair", "no degrees of freedom", options=of["pair"])
    refused(table, "~ sex", "'nobody'", options=of["nobody"])


def test_settings_that_cannot_be_are_refused() -> None:
    for wrong in ({"permutations": 5}, {"seed": -1}, {"alpha": 0.0}, {"anova_type": "IV"}):
        with pytest.raises(InputError):
            CompareConfig(**wrong)  # pyright: ignore[reportArgumentType]


def test_what_a_formula_may_call_is_called() -> None:
    table = people()
    columns = {"C": "C(group)", "poly": "poly(age, 2)", "bs": "bs(age, df=4)", "cr": "cr(age, df=2)"}
    table["group"] = (np.arange(37) % 10).astype(float).tolist()
    for name in FUNCTIONS:
        found = compare(cohort(table), "~ " + columns.get(name, f"{name}(age)"), QUICK)
        assert len(found.tests) == 1 and found.effects, name
    found = compare(cohort(table), "~ C(group)", QUICK)
    assert found.tests[0].df == 9
    assert len(found.effects) == 15
    assert any("pairs of the first 6" in one for one in compare_warnings(found))


# Bumps.


def fits_with_a_bump(mm: float, seed: int = 0) -> tuple[Cohort, FloatArray]:
    """Fits of two groups, whose shapes vary much by few modes; one has a bump that these do not make."""
    points, faces = surface()
    rng = np.random.default_rng(seed)
    smooth = np.stack([np.ones(36), points[:, 0] / 25 - 1, points[:, 1] / 25 - 1], axis=1)
    training: FloatArray = points + np.einsum("nk,vk->nv", rng.normal(size=(60, 3)) * 4, smooth)[..., None] * [0, 0, 1]
    training += rng.normal(size=training.shape) * 0.3
    model = ShapeModel.fit([Mesh(one, faces) for one in training], modes=30, align=False)
    group = np.repeat([0, 1], 30)
    near = np.exp(-0.5 * (np.linalg.norm(points - points[14], axis=1) / 8.0) ** 2)
    shapes: FloatArray = points + np.einsum("nk,vk->nv", rng.normal(size=(60, 3)) * 4, smooth)[..., None] * [0, 0, 1]
    shapes += rng.normal(size=shapes.shape) * 0.3 + mm * (group[:, None] * near)[..., None] * [0, 0, 1]
    b = (shapes - model.mean_vertices).reshape(60, -1) @ model.vertex_basis
    fitted = FitDiagnostics(model, b, np.full_like(b, 0.1), ("converged",) * 60, "")
    names = tuple(f"p{k}" for k in range(60))
    table = Table({"group": tuple("ab"[k] for k in group)}, names)
    return Cohort.of_fits(fitted, names, table, np.full(60, np.nan)), near


def test_a_bump_is_found_where_it_is_though_shapes_vary_more_than_it() -> None:
    shapes, near = fits_with_a_bump(1.0)
    made = compare(shapes, "~ group", CompareConfig(permutations=200, bump_width_mm=8.0)).effects[0].map
    assert made is not None and made.bump is not None and made.bump_mm is not None and made.along is not None
    assert not (made.along.p_family <= 0.05).any()
    found = made.bump.p_family <= 0.05
    assert found[14] and near[found].min() > 0.1
    assert near[int(made.bump.f.argmax())] > 0.5
    assert abs(made.bump_mm[14]) > 0.3


def test_no_bump_is_found_where_there_is_none() -> None:
    found = 0
    for seed in range(20):
        shapes, _ = fits_with_a_bump(0.0, seed)
        made = compare(shapes, "~ group", CompareConfig(permutations=20, bump_width_mm=8.0)).effects[0].map
        assert made is not None and made.bump is not None
        found += bool((made.bump.p_family <= 0.05).any())
    assert found <= 4


# Unequal variances, dispersion, methods and the summary.


def unequal_groups(spread: float = 2.0, seed: int = 0, effect: float = 0.0) -> Cohort:
    """6 female and 18 male shapes, of which the female ones vary `spread` times as much."""
    sex = ["female"] * 6 + ["male"] * 18
    points, faces = surface()
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(24, *points.shape)) * np.where(np.array(sex) == "female", spread, 1.0)[:, None, None]
    noise[:6, :, 2] += effect
    table = {"sex": sex, "age": rng.uniform(20, 60, 24).tolist()}
    return Cohort.of_shapes(points + noise, table, faces=faces, align=False)


def test_with_unequal_variances_f_of_two_classes_is_the_squared_welch_t_of_the_whole_and_of_each_vertex() -> None:
    shapes = unequal_groups()
    found = compare(shapes, "~ sex", CompareConfig(permutations=20, variances="unequal"))
    flat = np.stack([shapes.vertices(k) for k in range(24)])
    one, other = flat[:6], flat[6:]
    variance = one.var(axis=0, ddof=1) / 6 + other.var(axis=0, ddof=1) / 18
    squared = (one.mean(axis=0) - other.mean(axis=0)) ** 2
    assert found.test("sex").f == pytest.approx(squared.sum() / variance.sum(), rel=1e-8)
    (effect,) = found.effects
    assert effect.f == pytest.approx(found.test("sex").f, rel=1e-8) and effect.p == found.test("sex").p
    assert effect.map is not None
    np.testing.assert_allclose(effect.map.any_way.f, squared.sum(axis=1) / variance.sum(axis=1), rtol=1e-8)


def test_a_covariate_and_three_classes_keep_their_estimates_with_unequal_variances() -> None:
    table = people()
    plain = compare(cohort(table), "~ site * age", QUICK)
    allowed = compare(cohort(table), "~ site * age", replace(QUICK, variances="unequal"))
    for one, other in zip(plain.effects, allowed.effects, strict=True):
        np.testing.assert_allclose(one.change, other.change, atol=1e-12)
    for one, other in zip(plain.tests, allowed.tests, strict=True):
        assert (one.term, one.df, one.squares, one.r2) == (other.term, other.df, other.squares, other.r2)
        # Of equal variances the two statistics estimate the same ratio.
        assert 0.4 < one.f / other.f < 2.5


def test_unequal_dispersion_warns_unless_the_test_allows_it_and_stands_in_the_analysis() -> None:
    assumed = CompareConfig(permutations=200, maps=False, variances="equal")
    found = compare(unequal_groups(), "~ sex + age", assumed)
    (test,) = found.dispersions
    assert test.variable == "sex" and test.p <= 0.01 and test.ratio == pytest.approx(2.0, abs=0.3)
    assert compare_warnings(found)[0].startswith("Warning: dispersion is unequal")
    assert "differences are found that do not exist" in compare_warnings(found)[0]
    analysis = json.loads(json_text(analysis_report(found).analysis()))
    assert analysis["methods"]["dispersions"][0]["equal"] is False and compare_warnings(found)[0] in analysis["summary"]
    allowed = CompareConfig(permutations=200, maps=False, variances="unequal")
    assert not [one for one in compare_warnings(compare(unequal_groups(), "~ sex", allowed)) if "ispersion" in one]
    equal = compare(unequal_groups(1.0), "~ sex", assumed)
    assert equal.methods.dispersions[0].equal and not [one for one in compare_warnings(equal) if "ispersion" in one]


def test_auto_reports_the_test_that_holds_first_and_p_with_equal_variances_in_the_same_sentence() -> None:
    run = CompareConfig(permutations=200, maps=False)
    given = unequal_groups()
    found, equal, unequal = (
        compare(given, "~ sex + age", replace(run, variances=one)) for one in ("auto", "equal", "unequal")
    )
    for term in ("sex", "age"):
        first, assumed, allowing = (result.test(term) for result in (found, equal, unequal))
        assert (first.f, first.p) == (allowing.f, allowing.p) == (assumed.f_other, assumed.p_other)
        assert (first.f_other, first.p_other) == (assumed.f, assumed.p)
        assert first.unequal_variances and not assumed.unequal_variances
    assert found.methods.unequal_variances and {one.resampling for one in found.methods.tests} == {"sign flips"}
    assert [one.f for one in found.effects] == [one.f for one in unequal.effects]
    report = analysis_report(found)
    p = found.test("sex").p_other
    assert f"without the assumption of equal variances; p {p:.3g} with it)" in report.summary[0]
    (sex, _) = analysis_report(equal).summary[:2]
    assert re.search(r"p 0\.005, which is too small: it assumes equal variances; p 0\.\d+ without this assumption", sex)
    (table,) = [part for part in report.parts if isinstance(part, TablePart) and part.title == "Analysis of variance"]
    assert [column.name for column in table.columns[-2:]] == ["F, equal variances", "p, equal variances"]
    assert table.rows[0][-1] == p and table.rows[-1][-1] is None


def test_auto_assumes_equal_variances_of_alike_classes_and_of_terms_that_cannot_allow_others() -> None:
    run = CompareConfig(permutations=200, maps=False)
    points, _ = surface()

    def chosen(seed: int, counts: tuple[int, int], spread: float) -> CompareResult:
        sex = np.repeat(["female", "male"], counts)
        noise = np.random.default_rng(seed).normal(size=(sum(counts), *points.shape))
        noise[: counts[0]] *= spread
        return compare(Cohort.of_shapes(points + noise, {"sex": sex.tolist()}, align=False), "~ sex", run)

    (alike,) = chosen(3, (20, 20), 1.0).dispersions
    assert alike.p > 0.05 and alike.is_equality_plausible
    assert not chosen(3, (20, 20), 1.0).unequal_variances and chosen(3, (20, 20), 1.5).unequal_variances
    single = chosen(0, (1, 12), 5.0)  # a class of one has no variance
    assert not single.unequal_variances and single.test("sex").p_other is None
    plausible = [replace(alike, counts=counts, p=0.2) for counts in ((20, 20), (10, 30))]
    assert [one.is_equality_plausible for one in plausible] == [True, False]
    with pytest.raises(InputError, match="no variances 'both'"):
        CompareConfig(variances="both")  # type: ignore[arg-type]


def test_unequal_variances_have_the_weights_of_the_vertices_in_f() -> None:
    given = unequal_groups()
    stddev = np.linspace(0.0, 5.0, SIDE * SIDE)
    weighted = replace(given, position_std=stddev)
    found = compare(weighted, "~ sex", replace(QUICK, variances="unequal"))
    flat = np.stack([given.vertices(k) for k in range(24)])
    variance = (flat - flat.mean(axis=0)).var() * 1.0
    weight = (variance / (variance + stddev**2))[:, None]
    one, other = flat[:6], flat[6:]
    welch = one.var(axis=0, ddof=1) / 6 + other.var(axis=0, ddof=1) / 18
    expected = ((one.mean(axis=0) - other.mean(axis=0)) ** 2 * weight).sum() / (welch * weight).sum()
    assert found.test("sex").f == pytest.approx(expected, rel=1e-6)
    assert found.effects[0].f == pytest.approx(expected, rel=1e-6)


def test_groups_coded_as_two_numbers_are_groups() -> None:
    words = unequal_groups()
    codes = tuple("2" if sex == "male" else "1" for sex in words.table.texts("sex"))
    numbers = replace(words, table=Table({"sex": codes}, words.names))
    for options in (QUICK, replace(QUICK, variances="unequal")):
        by_words, by_numbers = compare(words, "~ sex", options), compare(numbers, "~ sex", options)
        (one,), (other,) = by_words.dispersions, by_numbers.dispersions
        assert (other.counts, other.p) == (one.counts, one.p) and other.groups == ("1", "2")
        np.testing.assert_allclose(other.stddev_mm, one.stddev_mm, rtol=1e-9)
        assert len(compare_warnings(by_numbers)) == len(compare_warnings(by_words))
        np.testing.assert_allclose(by_numbers.tests[0].arrangements, by_words.tests[0].arrangements, rtol=1e-6)
        assert [size.subjects for size in by_numbers.methods.sizes] == [
            size.subjects for size in by_words.methods.sizes
        ]


def test_a_rare_one_of_two_numbers_is_compared_with_the_other() -> None:
    table = {"group": ["0"] * 2 + ["1"] * 60}
    (effect,) = compare(cohort(table), "~ group", QUICK).effects
    assert (effect.low, effect.high) == ("group 0", "group 1")


def test_the_number_of_arrangements_is_that_of_sign_flips_with_unequal_variances() -> None:
    table = {"group": ["a"] * 2 + ["b"] * 2}
    assert any("only 6 arrangements" in one for one in compare_warnings(compare(cohort(table), "~ group", QUICK)))
    flipped = compare_warnings(compare(cohort(table), "~ group", replace(QUICK, variances="unequal")))
    assert any("only 8 arrangements" in one for one in flipped)


def test_a_formula_and_options_of_another_type_are_refused() -> None:
    shapes = cohort({"sex": ["f", "m"] * 4})
    for formula, options in ((None, QUICK), ("~ sex", "quick")):
        with pytest.raises(InputError, match="compare takes a"):
            compare(shapes, formula, options)  # type: ignore[arg-type]


def test_random_terms_may_stand_in_brackets() -> None:
    table = Table({"subject": ("a", "b"), "time": ("0", "1")}, ("x", "y"))
    assert random_effects_of("(1 + time | subject)", table) == random_effects_of("1 + time | subject", table)


def test_unequal_variances_warn_about_a_class_of_fewer_than_three() -> None:
    shapes = unequal_groups().take(range(4, 24))
    found = compare(shapes, "~ sex", CompareConfig(permutations=40, maps=False, variances="unequal"))
    assert compare_warnings(found)[0].startswith("Warning: sex has a class of 2 subjects")


def test_means_of_subjects_and_their_contrasts_between_groups_allow_unequal_variances() -> None:
    rng = np.random.default_rng(0)
    subjects = [f"s{k}" for k in range(14) for _ in range(4)]
    table = {
        "subject": subjects,
        "sex": ["f" if int(name[1:]) < 5 else "m" for name in subjects],
        "visit": ["before", "before", "after", "after"] * 14,
    }
    points, _ = surface()
    own = rng.normal(size=(14, 2, *points.shape)) * np.where(np.arange(14) < 5, 3.0, 1.0)[:, None, None, None]
    noise = 0.3 * rng.normal(size=(56, *points.shape))
    shapes = points + noise + own[np.arange(56) // 4, (np.arange(56) // 2) % 2]
    given = Cohort.of_shapes(shapes, table, align=False)
    options = CompareConfig(blocks="subject", permutations=40, maps=False, variances="unequal")
    found = compare(given, "~ sex * visit", options)
    assert [(one.variable, one.stratum) for one in found.dispersions] == [
        ("sex", "between subject"), ("sex", "within subject: visit")
    ]  # fmt: skip
    assert all(one.counts == (5, 9) and one.p <= 0.05 for one in found.dispersions)
    cells = shapes.reshape(14, 2, 2, -1).mean(axis=2)
    for values, term in ((cells.mean(axis=1), "sex"), (cells[:, 1] - cells[:, 0], "sex:visit")):
        one, other = values[:5], values[5:]
        variance = one.var(axis=0, ddof=1) / 5 + other.var(axis=0, ddof=1) / 9
        expected = ((one.mean(axis=0) - other.mean(axis=0)) ** 2).sum() / variance.sum()
        assert found.test(term).f == pytest.approx(expected, rel=1e-6)
    with pytest.raises(InputError, match=r"Unequal variances are not available for .*visit"):
        compare(given, "~ sex * visit", replace(options, random="1 | subject"))


def test_the_methods_name_the_sample_the_residuals_and_the_unit() -> None:
    table = people()
    found = compare(cohort(table), "~ sex * site + age", QUICK)
    methods = found.methods
    sizes = {one.classes: one.subjects for one in methods.sizes}
    assert sizes["female",] + sizes["male",] == 37 and sizes["female", "a"] == sum(
        one == ("female", "a") for one in zip(table["sex"], table["site"], strict=True)
    )
    reduced = {one.tested: one.reduced_model for one in methods.tests}
    assert reduced["sex",] == ("site", "age") and reduced["sex:site",] == ("sex", "site", "age")
    assert {one.resampling for one in methods.tests} == {"permutation"} and methods.r2_strata == ("",)
    (stated,) = [
        part for part in analysis_report(found).parts if isinstance(part, TextPart) and part.title == "Methods"
    ]
    text = " ".join(stated.text)
    for words in ("37 shapes of 37 subjects", "Exchangeability", "R² is the share", "Box-Cox", "Lengths are in mm"):
        assert words in text
    assert "not corrected" not in text and "not over the number of terms, maps or analyses" in text


def test_lengths_of_landmarks_without_a_unit_are_never_mm() -> None:
    shapes = unequal_groups()
    scaled = np.stack([shapes.vertices(k) for k in range(24)])
    scaled = scaled - scaled.mean(axis=1, keepdims=True)
    scaled /= np.linalg.norm(scaled, axis=(1, 2), keepdims=True)
    table = {name: list(values) for name, values in shapes.table.columns.items() if name in ("sex", "age")}
    found = compare(Cohort.of_shapes(scaled, table, faces=shapes.faces), "~ sex + age", CompareConfig(permutations=40))
    answer = analysis_report(found)
    assert found.cohort.unit == "" and not any(re.search(r"\bmm", one) for one in answer.summary)
    parts = json_text([replace_arrays(part) for part in answer.parts])
    assert not re.search(r"\bmm\b|mm²", parts) and "no unit" in parts
    assert all("mm" not in head for header, _ in answer.tables.values() for head in header)


def replace_arrays(part: Any) -> Any:
    """Return a part without the names of its arrays, which belong to the format."""
    import msgspec

    given = msgspec.structs.asdict(part)
    return {key: value for key, value in given.items() if key not in ("arrays", "values", "mask")}


def test_a_map_is_exploratory_unless_its_term_is_significant_and_has_an_interval() -> None:
    def sentences(effect: float, seed: int) -> list[str]:
        found = compare(unequal_groups(1.0, seed, effect), "~ sex", CompareConfig(permutations=200, alpha=0.05))
        return [one for one in analysis_report(found).summary if "vertices differ" in one]

    (shown,) = sentences(2.0, 0)
    assert "exploratory" not in shown and re.search(r"simultaneous 95 % interval [+-]\d.* to [+-]\d", shown)
    found = compare(unequal_groups(1.0), "~ sex", CompareConfig(permutations=200))
    (effect,) = found.effects
    assert effect.exploratory == (found.test("sex").p > 0.05)
    assert effect.map is not None
    for vertex in range(SIDE * SIDE):
        low, high = effect.map.interval_mm(vertex)
        assert (low > 0 or high < 0) == (effect.map.test.p_family[vertex] <= 0.05)


def test_z_by_logarithms_is_an_option() -> None:
    table = people(30)
    found = {
        kind: compare(cohort(table), "~ sex", replace(QUICK, effect_size=kind)).test("sex") for kind in EFFECT_SIZES
    }
    for kind, test in found.items():
        assert test.z == effect_size(test.arrangements, kind)
    with pytest.raises(InputError, match="no effect size 'cube'"):
        CompareConfig(effect_size="cube")  # type: ignore[arg-type]


def test_whether_changes_have_one_direction_is_not_known_where_neither_is_longer_than_its_noise() -> None:
    unknown = {0.0: 0, 6.0: 0}
    for seed in range(8):
        for length in unknown:
            shapes = np.random.default_rng(seed).normal(size=(24, 12, 3))
            shapes[[k // 2 % 2 == 1 for k in range(24)], 0, 0] += length
            table = {"group": ["a", "b"] * 12, "time": [f"t{k // 2 % 2}" for k in range(24)]}
            cohort = Cohort.of_shapes(shapes, table, align=False)
            found = compare(cohort, "~ group * time", CompareConfig(permutations=20, maps=False))
            [angle] = [one for one in found.angles if one.first.startswith("time t0 to t1, group")]
            assert (angle.p is None) == (angle.unknown_p is not None)
            unknown[length] += angle.p is None
            warned = [
                one
                for one in compare_warnings(found)
                if one.startswith("It is not known whether the changes time t0 to t1")
            ]
            assert len(warned) == (angle.p is None)
    assert unknown[6.0] == 0 and 0 < unknown[0.0] < 8
