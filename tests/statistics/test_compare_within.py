"""Repeated scans: F against classical analyses of variance, arrangements of whole subjects, confounding, refusals."""

import itertools
from typing import Any

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table
from shapespace.errors import InputError
from shapespace.report.analyses.result_report import analysis_report
from shapespace.statistics.compare_formula import design_of
from shapespace.statistics.compare_shapes import CompareConfig, CompareResult, compare, term_tests
from shapespace.statistics.compare_within import strata_of
from shapespace.types import FloatArray

pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")

V = 12
BLOCKS = CompareConfig(blocks="subject", permutations=100, maps=False)


def table(subjects: int, conditions: dict[str, int], scans: int = 1, numbers: tuple[str, ...] = ()) -> dict[str, Any]:
    """Subjects of two sexes, each with some scans in all conditions."""
    at = np.indices((subjects, *conditions.values(), scans)).reshape(len(conditions) + 2, -1)
    out: dict[str, Any] = {"subject": [f"s{k}" for k in at[0]], "sex": ["fm"[k % 2] for k in at[0]]}
    for place, name in enumerate(conditions, 1):
        out[name] = [float(k) if name in numbers else f"c{k}" for k in at[place]]
    return out


def of_numbers(y: FloatArray) -> FloatArray:
    """Shapes (N, V, 3) that differ in one coordinate of one point alone."""
    shapes = np.tile(np.random.default_rng(0).normal(size=(V, 3)) * 30.0, (len(y), 1, 1))
    shapes[:, 4, 2] += y
    return shapes


def noise(count: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng([4, seed]).normal(size=(count, V, 3))


def compared(
    shapes: FloatArray, columns: dict[str, Any], formula: str, options: CompareConfig = BLOCKS
) -> CompareResult:
    return compare(Cohort.of_shapes(shapes, columns, align=False), formula, options)


# F against classical analyses.


def test_f_of_two_visits_is_the_squared_paired_t() -> None:
    y = np.random.default_rng(1).normal(size=(9, 2)) + np.array([0.0, 0.5])
    found = compared(of_numbers(y.ravel()), table(9, {"visit": 2}), "~ visit")
    d = y[:, 1] - y[:, 0]
    t = d.mean() / (d.std(ddof=1) / 3.0)
    np.testing.assert_allclose(found.test("visit").f, t**2, rtol=1e-9)
    np.testing.assert_allclose(found.effects[0].f, t**2, rtol=1e-9)
    np.testing.assert_allclose(found.effects[0].distance_mm, abs(d.mean()), rtol=1e-9)


def test_p_of_two_visits_is_the_share_of_all_sign_flips() -> None:
    d = noise(8, 1) + 0.2
    visits = np.stack([noise(8, 2), np.zeros_like(d)], axis=1)
    visits[:, 1] = visits[:, 0] + d
    options = CompareConfig(blocks="subject", permutations=4000, maps=False)
    found = compared(visits.reshape(16, V, 3) + 30 * noise(1, 3), table(8, {"visit": 2}), "~ visit", options)
    flat = d.reshape(8, -1)
    drawn = np.array([np.sum((np.array(s) @ flat) ** 2) for s in itertools.product((1.0, -1.0), repeat=8)])
    f = drawn / 8 / ((np.sum(flat**2) - drawn / 8) / 7)
    p = float((f >= f[0] - 1e-9).mean())
    assert 0.01 < p < 0.5, "the case tests nothing"
    np.testing.assert_allclose(found.test("visit").f, f[0], rtol=1e-9)
    assert abs(found.test("visit").p - p) < 4 * np.sqrt(p * (1 - p) / 4000)


def test_groups_by_conditions_give_the_classical_mixed_analysis_of_variance() -> None:
    S, k = 10, 4
    y = np.random.default_rng(2).normal(size=(S, k)) + np.arange(k) * 0.3
    male = np.arange(S) % 2 == 1
    found = compared(of_numbers(y.ravel()), table(S, {"visit": k}), "~ sex * visit")
    inside = y - y.mean(axis=1, keepdims=True)
    mean = inside.mean(axis=0)
    each = np.stack([inside[~male].mean(axis=0), inside[male].mean(axis=0)])
    condition, interaction = S * np.sum(mean**2), S / 2 * np.sum((each - mean) ** 2)
    error = (np.sum(inside**2) - condition - interaction) / ((S - 2) * (k - 1))
    groups = y.mean(axis=1)
    outer = k * S / 2 * np.sum((np.array([groups[~male].mean(), groups[male].mean()]) - groups.mean()) ** 2)
    left = k * sum(np.sum((groups[who] - groups[who].mean()) ** 2) for who in (male, ~male)) / (S - 2)
    np.testing.assert_allclose(found.test("visit").f, condition / (k - 1) / error, rtol=1e-9)
    np.testing.assert_allclose(found.test("visit").squares, condition, rtol=1e-9)
    np.testing.assert_allclose(found.test("sex:visit").f, interaction / (k - 1) / error, rtol=1e-9)
    np.testing.assert_allclose(found.test("sex").f, outer / left, rtol=1e-9)


def test_two_factors_have_errors_of_their_own() -> None:
    S, a, b = 7, 3, 2
    y = np.random.default_rng(3).normal(size=(S, a, b))
    found = compared(of_numbers(y.ravel()), table(S, {"one": a, "other": b}), "~ one * other")

    def f(values: FloatArray, df: int) -> float:
        """Of contrasts (S, ...) of subjects, against their own variation."""
        mean = values.mean(axis=0)
        return float(S * np.sum(mean**2) / df / (np.sum((values - mean) ** 2) / (df * (S - 1))))

    centred = y - y.mean(axis=(1, 2), keepdims=True)
    one, other = centred.mean(axis=2, keepdims=True), centred.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(found.test("one").f, f(one, a - 1), rtol=1e-9)
    np.testing.assert_allclose(found.test("other").f, f(other, b - 1), rtol=1e-9)
    np.testing.assert_allclose(found.test("one:other").f, f(centred - one - other, (a - 1) * (b - 1)), rtol=1e-9)


def test_growth_is_tested_on_the_slopes_of_subjects() -> None:
    y = np.random.default_rng(4).normal(size=(10, 5)) + 0.3 * np.arange(5)
    found = compared(of_numbers(y.ravel()), table(10, {"time": 5}, numbers=("time",)), "~ sex * time")
    slopes = (y @ (np.arange(5) - 2.0)) / 10.0
    f, m = slopes[::2], slopes[1::2]
    pooled = (np.sum((f - f.mean()) ** 2) + np.sum((m - m.mean()) ** 2)) / 8
    np.testing.assert_allclose(found.test("sex:time").f, (m.mean() - f.mean()) ** 2 / (pooled * 2 / 5), rtol=1e-9)
    np.testing.assert_allclose(found.test("time").f, slopes.mean() ** 2 / (pooled / 10), rtol=1e-9)


def test_an_interaction_with_groups_is_the_one_way_test_of_difference_shapes() -> None:
    shapes, columns = noise(20), table(10, {"visit": 2})
    found = compared(shapes, columns, "~ sex * visit", CompareConfig(blocks="subject", permutations=2000, maps=False))
    change = shapes[1::2] - shapes[::2] + 30 * noise(1, 3)
    alone = compared(change, {"sex": columns["sex"][::2]}, "~ sex", CompareConfig(permutations=2000, maps=False)).test(
        "sex"
    )
    np.testing.assert_allclose(found.test("sex:visit").f, alone.f, rtol=1e-9)
    assert abs(found.test("sex:visit").p - alone.p) < 0.06


# What the tests do not depend on.


def test_repeated_scans_of_a_condition_are_one_observation_of_it() -> None:
    cells, columns = noise(24), table(12, {"visit": 2})
    apart = np.stack([noise(24, 5), np.zeros((24, V, 3))], axis=1)
    apart[:, 1] = -apart[:, 0]
    twice = (cells[:, None] + apart).reshape(48, V, 3)
    one = compared(cells, columns, "~ sex * visit")
    two = compared(twice, table(12, {"visit": 2}, scans=2), "~ sex * visit")
    for a, b in zip(one.tests, two.tests, strict=True):
        np.testing.assert_allclose((a.f, a.p, a.squares), (b.f, b.p, b.squares), rtol=1e-9)
    for a, b in zip(one.effects, two.effects, strict=True):
        np.testing.assert_allclose((a.f, a.p, a.distance_mm), (b.f, b.p, b.distance_mm), rtol=1e-9)
    assert any("48 shapes are averaged to 24 cells" in note for note in analysis_report(two).notes)


def test_tests_within_subjects_do_not_depend_on_what_subjects_are_like() -> None:
    shapes, columns = noise(30), table(10, {"visit": 3})
    own = 50.0 * np.repeat(noise(10, 7), 3, axis=0)
    one, other = (compared(made, columns, "~ sex * visit", CompareConfig(blocks="subject", permutations=50))
                  for made in (shapes, shapes + own))  # fmt: skip
    for term in ("visit", "sex:visit"):
        np.testing.assert_allclose(one.test(term).arrangements, other.test(term).arrangements, rtol=1e-6)
    within = [(a, b) for a, b in zip(one.effects, other.effects, strict=True) if a.name == "visit"]
    assert len(within) == 3
    for a, b in within:
        assert a.map is not None and b.map is not None
        np.testing.assert_allclose(a.map.any_way.f, b.map.any_way.f, rtol=1e-6)
        np.testing.assert_array_equal(a.map.any_way.p_family, b.map.any_way.p_family)


def test_subjects_that_respond_differently_are_no_mean_effect() -> None:
    columns = table(14, {"visit": 2}, scans=3)
    cells = {name: tuple(values) for name, values in columns.items()}
    design = design_of("~ sex * visit", Table(cells, tuple(f"scan {k}" for k in range(84))))
    found = {"visit": 0, "sex:visit": 0}
    for seed in range(40):
        rng = np.random.default_rng([6, seed])
        own = rng.normal(size=(14, 2, 1, V * 3)) * 2.0 + rng.normal(size=(14, 2, 3, V * 3))
        strata = strata_of(own.reshape(84, -1), design, columns["subject"], "subject")
        for test in (test for stratum in strata.every for test in term_tests(stratum, BLOCKS)):
            if test.term in found:
                found[test.term] += test.p <= 0.05
    # 40 studies with a probability of 5 % find more than 6 in 1 of 70 cases.
    assert max(found.values()) <= 6, found


def test_pairs_of_conditions_have_the_error_of_their_own_difference() -> None:
    y = np.random.default_rng(8).normal(size=(9, 3)) * [1.0, 1.0, 9.0]
    found = compared(of_numbers(y.ravel()), table(9, {"visit": 3}), "~ visit").effects
    for effect, (low, high) in zip(found, ((0, 1), (0, 2), (1, 2)), strict=True):
        d = y[:, high] - y[:, low]
        np.testing.assert_allclose(effect.f, d.mean() ** 2 / (d.var(ddof=1) / 9), rtol=1e-9)
        assert effect.p_family >= effect.p


def test_changes_of_two_conditions_are_parallel_or_not() -> None:
    columns = table(14, {"visit": 2, "pose": 2})
    visit, pose = (np.array([cell == "c1" for cell in columns[name]])[:, None, None] for name in ("visit", "pose"))
    way, other = noise(1, 11), noise(1, 12)
    shapes = noise(56, 13) * 0.3 + 30 * noise(1, 14)
    same = compared(shapes + visit * way, columns, "~ visit * pose")
    turned = compared(shapes + visit * np.where(pose, way, other), columns, "~ visit * pose")
    first = [next(one for one in found.angles if one.p is not None) for found in (same, turned)]
    assert first[0].p is not None and first[1].p is not None
    assert first[0].degrees < 30 < 60 < first[1].degrees
    assert first[0].p > 0.05 > first[1].p


# Random terms.


def test_all_effects_within_subjects_are_random_unless_others_are_given() -> None:
    shapes, columns = noise(50), table(10, {"time": 5}, numbers=("time",))
    blocks = compared(shapes, columns, "~ sex * time")
    random = compared(
        shapes, columns, "~ sex * time", CompareConfig(random="1 + time | subject", permutations=100, maps=False)
    )
    for one, other in zip(blocks.tests, random.tests, strict=True):
        np.testing.assert_array_equal(one.arrangements, other.arrangements)
    assert analysis_report(random).settings["random"] == "1 + time | subject"


def test_effects_that_are_assumed_alike_are_tested_on_the_cells_and_the_answer_says_so() -> None:
    y = np.random.default_rng(9).normal(size=(8, 4))
    options = CompareConfig(random="1 | subject", permutations=60, maps=False)
    found = compared(of_numbers(y.ravel()), table(8, {"visit": 4}), "~ sex * visit", options)
    inside = y - y.mean(axis=1, keepdims=True)
    each = np.stack([inside[::2].mean(axis=0), inside[1::2].mean(axis=0)])
    mean = inside.mean(axis=0)
    interaction = 4 * np.sum((each - mean) ** 2)
    error = (np.sum(inside**2) - 8 * np.sum(mean**2) - interaction) / (24 - 6)
    np.testing.assert_allclose(found.test("visit").f, 8 * np.sum(mean**2) / 3 / error, rtol=1e-9)
    assert any("assumed to respond alike to visit" in one for one in analysis_report(found).summary)


def test_an_effect_is_alike_beside_slopes_that_are_not() -> None:
    columns = table(12, {"time": 3, "pose": 2}, numbers=("time",))
    slopes = np.repeat(noise(12, 20), 6, axis=0) * np.array(columns["time"])[:, None, None]
    pose = np.array([cell == "c1" for cell in columns["pose"]])[:, None, None]
    options = CompareConfig(random="1 + time | subject", permutations=100, maps=False)
    found = compared(noise(72) + slopes + pose * 0.6 * noise(1, 21), columns, "~ time + pose", options)
    assert found.test("pose").stratum == "within subject"
    assert found.test("time").stratum == "within subject: time"
    assert found.strata[1].df == 12 * 4 - 1
    assert found.test("pose").p == 0.01


@pytest.mark.parametrize(
    ("random", "words"),
    [
        ("1 + time", ("'1 + time | subject'",)),
        ("0 + time | subject", ("mean shape",)),
        ("1 + time | nobody", ("'nobody'", "no column")),
        ("1 + sex | subject", ("sex is no effect within subjects",)),
        ("1 + visit | subject", ("'visit'", "no column")),
        ("1 + __import__('os') | subject", ("formula",)),
        ("1 + time | subject | subject", ("no column",)),
    ],
)
def test_random_terms_that_cannot_be_are_refused(random: str, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as caught:
        compared(noise(18), table(6, {"time": 3}, numbers=("time",)), "~ sex * time", CompareConfig(random=random))
    assert all(word in str(caught.value) for word in words), caught.value


# Subjects without all conditions.


def without(columns: dict[str, Any], lost: list[int]) -> tuple[dict[str, Any], list[int]]:
    kept = [row for row in range(len(columns["subject"])) if row not in lost]
    return {name: [values[row] for row in kept] for name, values in columns.items()}, kept


def test_subjects_without_all_conditions_are_left_out_of_their_test_and_counted() -> None:
    shapes, (columns, kept) = noise(20), without(table(10, {"visit": 2}), [1, 4])
    found = compared(shapes[kept], columns, "~ visit")
    complete = [row for row in range(20) if row not in (0, 1, 4, 5)]
    alone = compared(shapes[complete], without(table(10, {"visit": 2}), [0, 1, 4, 5])[0], "~ visit")
    np.testing.assert_allclose(found.test("visit").f, alone.test("visit").f, rtol=1e-9)
    assert any("2 of 10 subjects lack conditions" in one for one in analysis_report(found).summary)


def test_a_pair_of_conditions_uses_all_subjects_that_have_both() -> None:
    shapes, (columns, kept) = noise(30), without(table(10, {"visit": 3}), [2, 5, 8])
    found = compared(shapes[kept], columns, "~ visit").effects
    d = (shapes[1::3] - shapes[::3]).reshape(10, -1)
    f = 10 * np.sum(d.mean(axis=0) ** 2) / (np.sum((d - d.mean(axis=0)) ** 2) / 9)
    np.testing.assert_allclose(found[0].f, f, rtol=1e-9)


def confounded(both: int, subjects: int = 20) -> dict[str, Any]:
    """Two sexes, one neutral and the other smiling, of which some subjects show both."""
    who = [k for k in range(subjects) for _ in range(2 if k < both else 1)]
    smile = [c for k in range(subjects) for c in ((0, 1) if k < both else (k % 2,))]
    return {"subject": [f"s{k}" for k in who], "sex": ["fm"[k % 2] for k in who], "smile": ["ny"[c] for c in smile]}


@pytest.mark.parametrize("both", [2, 6])
def test_sexes_that_differ_in_expression_do_not_seem_to_differ_in_shape(both: int) -> None:
    columns = confounded(both)
    cells = {name: tuple(values) for name, values in columns.items()}
    design = design_of("~ sex + smile", Table(cells, tuple(f"scan {k}" for k in range(20 + both))))
    at = np.array([int(name[1:]) for name in columns["subject"]])
    smile = np.array(columns["smile"]) == "y"
    false = 0
    for seed in range(30):
        rng = np.random.default_rng([7, seed])
        shapes = rng.normal(size=(20, V * 3))[at] * 2 + rng.normal(size=(len(at), V * 3))
        shapes += smile[:, None] * (4.0 + rng.normal(size=(20, V * 3))[at])
        strata = strata_of(shapes, design, columns["subject"], "subject")
        assert strata.every[0].df_error == 17
        false += next(term_tests(strata.every[0], BLOCKS)).p <= 0.05
    assert false <= 5


def test_adjusting_for_conditions_of_subjects_finds_a_difference_and_is_said() -> None:
    columns = confounded(12)
    male = np.array([sex == "m" for sex in columns["sex"]])[:, None, None]
    smile = np.array([cell == "y" for cell in columns["smile"]])[:, None, None]
    shapes = noise(32) * 0.3 + male * 2.0 * noise(1, 30) + smile * 9.0 * noise(1, 31)
    found = compared(shapes, columns, "~ sex + smile")
    sex = next(effect for effect in found.effects if effect.name == "sex")
    assert sex.p == 0.01
    np.testing.assert_allclose(
        found.cohort.vertices(sex.at_high) - found.cohort.vertices(sex.at_low), 2.0 * noise(1, 30)[0], atol=0.5
    )
    assert any("means of smile per subject are covariates" in note for note in analysis_report(found).notes)


@pytest.mark.parametrize(
    ("columns", "formula", "words"),
    [
        (confounded(0), "~ sex + smile", ("smile follows from",)),
        (confounded(1), "~ sex + smile", ("only 1 of 20", "smile")),
        (without(table(4, {"visit": 3}), [0, 4, 8, 9])[0], "~ visit", ("no subject has shapes in all", "visit")),
        (table(6, {"visit": 2}), "~ visit + sex:visit", ("sex:visit contains sex", "add it")),
    ],
)
def test_designs_without_a_valid_test_are_refused(
    columns: dict[str, Any], formula: str, words: tuple[str, ...]
) -> None:
    with pytest.raises(InputError) as caught:
        compared(noise(len(columns["subject"])), columns, formula)
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert text.endswith(".") and len(text) < 300, text


# Formulas that are too large.


@pytest.mark.parametrize(
    "formula",
    [
        "~ " + "/".join("abcdefghij"),
        "~ " + ":".join(["(a + b + c + d)"] * 8),
        "~ (a*b*c):(d*e*f):(g/h/i/j)",
        "~ (a:b:c + d:e:f)^3",
        "~ " + "(" * 300 + "a" + ")" * 300,
    ],
)
def test_a_formula_of_too_many_columns_is_refused_before_it_is_expanded(
    formula: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import formulaic

    monkeypatch.setattr(formulaic, "Formula", lambda *_, **__: pytest.fail("it was expanded"))
    rng = np.random.default_rng(0)
    cells = {name: tuple(rng.choice(list("xyz"), 40)) for name in "abcdefghij"}
    with pytest.raises(InputError, match=r"columns, and 5000 are the limit|cannot be read"):
        design_of(formula, Table(cells, tuple(f"scan {k}" for k in range(40))))
