"""Error terms of nested and mixed designs: sums of squares by hand, scipy's F, permutation of units, and refusals."""

import argparse
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from shapespace.cli.values import error_term
from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table
from shapespace.errors import InputError
from shapespace.report.analyses.compare_report import compare_report
from shapespace.statistics.compare_formula import design_of
from shapespace.statistics.compare_shapes import CompareConfig, CompareResult, compare, term_tests
from shapespace.statistics.compare_strata import independent_stratum
from shapespace.types import FloatArray

pytest.importorskip("formulaic")
ERRORS = {"genus": "genus:species"}


def simulate(seed: int, *, unequal: bool = False, genera: int = 3, vertices: int = 4, units: float = 1.0) -> Cohort:
    """Shapes of 4 species in each genus, which vary between species and within them."""
    rng = np.random.default_rng(seed)
    base = rng.normal(size=(vertices, 3)) * 50
    shapes, genus, species = list[FloatArray](), list[str](), list[str]()
    for g in range(genera):
        for s in range(4):
            mean = base + units * rng.normal(size=(vertices, 3))
            for _ in range(int(rng.integers(2, 7)) if unequal else 4):
                shapes.append(mean + rng.normal(size=(vertices, 3)))
                genus.append(f"g{g}")
                species.append(f"s{g}{s}")
    sex = [("f", "m")[k] for k in rng.integers(0, 2, len(shapes))]
    table = {"genus": genus, "species": species, "sex": sex, "age": rng.normal(size=len(shapes)).tolist()}
    return Cohort.of_shapes(np.stack(shapes), table, align=False)


def nested(cohort: Cohort, formula: str = "~ genus / species", **options: object) -> CompareResult:
    config = {"errors": ERRORS, "permutations": 100, "maps": False, "anova_type": "I", **options}
    return compare(cohort, formula, CompareConfig(**config))  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("unequal", [False, True])
def test_sums_of_squares_are_those_by_hand_and_f_is_over_the_error_term(unequal: bool) -> None:
    cohort = simulate(1, unequal=unequal)
    y = cohort.coefficients - cohort.coefficients.mean(axis=0)
    genus, species = np.array(cohort.table.texts("genus")), np.array(cohort.table.texts("species"))

    def between(classes: np.ndarray) -> float:  # type: ignore[type-arg]
        return sum(
            (classes == one).sum() * float((y[classes == one].mean(axis=0) ** 2).sum()) for one in np.unique(classes)
        )

    a, b, total = between(genus), between(species) - between(genus), float((y**2).sum())
    result = nested(cohort)
    first, second = result.tests
    assert (first.df, second.df, result.strata[0].df) == (2, 9, len(cohort) - 12)
    assert (first.error, second.error) == ("genus:species", "residuals")
    assert first.squares == pytest.approx(a)
    assert second.squares == pytest.approx(b)
    assert first.r2 == pytest.approx(a / total)
    assert first.f == pytest.approx((a / 2) / (b / 9))
    assert second.f == pytest.approx((b / 9) / ((total - a - b) / (len(cohort) - 12)))


@pytest.mark.parametrize("unequal", [False, True])
def test_type_iii_with_treatment_coding_compares_genera_in_their_first_species_as_in_r(unequal: bool) -> None:
    cohort = simulate(4, unequal=unequal)
    # The same names of species in all genera, so that R has full rank.
    species = tuple("abcd"[int(name[-1])] for name in cohort.table.texts("species"))
    table = replace(cohort.table, columns={**cohort.table.columns, "species": species})
    y, genus = cohort.coefficients, np.array(cohort.table.texts("genus"))
    own = np.array(
        [[g == a and s == b for a in np.unique(genus) for b in "bcd"] for g, s in zip(genus, species, strict=True)]
    )
    other = np.array([[g == a for a in np.unique(genus)[1:]] for g in genus])

    def left(*columns: np.ndarray) -> float:  # type: ignore[type-arg]
        x = np.column_stack([np.ones(len(y)), *columns]).astype(np.float64)
        return float(((y - x @ np.linalg.lstsq(x, y)[0]) ** 2).sum())

    result = nested(replace(cohort, table=table), anova_type="III", coding="treatment")
    squares = left(own) - left(own, other), left(other) - left(own, other)
    assert [test.squares for test in result.tests] == pytest.approx(squares)
    assert result.test("genus").f == pytest.approx((squares[0] / 2) / (squares[1] / 9))


@pytest.mark.parametrize("permutation", ["units", "residuals"])
def test_f_does_not_depend_on_the_permutation_and_the_first_arrangement_is_observed(permutation: str) -> None:
    test = nested(simulate(2, unequal=True), "~ genus / species + sex", error_permutation=permutation).test("genus")
    reference = nested(simulate(2, unequal=True), "~ genus / species + sex").test("genus")
    assert test.f == pytest.approx(reference.f, rel=1e-9)
    assert test.arrangements[0] == test.f


def test_arrangements_of_units_follow_f_of_scipy_for_one_coordinate() -> None:
    rng = np.random.default_rng(3)
    genus, species = np.repeat(["a", "b", "c"], 40), np.repeat([f"s{k}" for k in range(30)], 4)
    y = (np.repeat(rng.normal(size=30), 4) + rng.normal(size=120))[:, None]
    table = Table({"genus": tuple(genus), "species": tuple(species)}, tuple(map(str, range(120))))
    design = design_of("~ genus / species", table)
    stratum = independent_stratum(y, design)
    term, error = design.terms
    config = CompareConfig(permutations=2000)
    test = next(term_tests(stratum, config, errors={term.label: error}))
    assert test.p == pytest.approx(stats.f.sf(test.f, 2, 27), abs=0.035)


def test_effects_of_a_term_with_an_error_term_are_tested_between_its_units() -> None:
    result = nested(simulate(4), "~ genus / species + sex")
    strata = {effect.name: effect.stratum for effect in result.effects}
    assert strata == {"genus": "between genus:species", "sex": ""}  # no pairs of species, whose means are not crossed
    schemes = {scheme.tested: scheme for scheme in result.methods.tests}
    assert schemes["genus",].statistic == "F over genus:species"
    assert schemes["genus",].unit == "genus:species unit"
    report = compare_report(result)
    assert report.settings["errors"] == ERRORS
    header, rows = report.tables["terms.csv"]
    assert header[-1] == "error"
    assert rows[0][-1] == "genus:species"


def test_an_error_term_of_a_crossed_design_is_that_of_the_mixed_model() -> None:
    rng = np.random.default_rng(5)
    table = {"diet": ["x", "y"] * 20, "tank": list("aaaaaaaabbbbbbbbccccccccddddddddeeeeeeee")}
    cohort = Cohort.of_shapes(rng.normal(size=(4, 3)) * 30 + rng.normal(size=(40, 4, 3)), table, align=False)
    result = nested(cohort, "~ diet * tank", errors={"diet": "diet:tank"})
    diet, mixed = result.test("diet"), result.test("diet:tank")
    assert diet.f == pytest.approx((diet.squares / 1) / (mixed.squares / 4))


def test_random_terms_and_error_terms_work_together_between_subjects() -> None:
    rng = np.random.default_rng(6)
    genus, species = np.repeat(["a", "b"], 24), np.repeat([f"s{k}" for k in range(6)], 8)
    table = {"genus": genus, "species": species, "who": np.repeat([f"w{k}" for k in range(24)], 2),
             "side": ["left", "right"] * 24}  # fmt: skip
    cohort = Cohort.of_shapes(rng.normal(size=(4, 3)) * 30 + rng.normal(size=(48, 4, 3)), table, align=False)
    result = nested(cohort, "~ genus / species + side", random="1 + side | who")
    test = result.test("genus")
    assert (test.stratum, test.error, test.df) == ("between who", "genus:species", 1)
    error = result.test("genus:species")
    assert test.f == pytest.approx(test.squares / (error.squares / error.df))


def test_the_level_is_kept_with_random_nested_effects() -> None:
    rejected, naive = 0, 0
    for seed in range(80):
        cohort = simulate(seed + 100, unequal=True, vertices=2)
        design = design_of("~ genus / species", cohort.table)
        stratum = independent_stratum(cohort.coefficients, design)
        config = CompareConfig(permutations=100, seed=seed)
        rejected += next(term_tests(stratum, config, errors={"genus": design.terms[1]})).p <= 0.05
        naive += next(term_tests(stratum, config)).p <= 0.05
    assert rejected <= 11  # of 80; 99.9 % of a binomial of 5 %
    assert naive > 40


@pytest.mark.parametrize(
    ("formula", "errors", "words"),
    [
        ("~ genus / species", {"genus": "species"}, "no term 'species'"),
        ("~ genus / species", {"family": "genus:species"}, "no term 'family'"),
        ("~ genus + sex", {"genus": "sex"}, "must contain 'genus'"),
        ("~ genus * age", {"genus": "genus:age"}, "column of numbers"),
        ("~ sex + genus / sex", {"genus": "genus:genus"}, "no term"),
    ],
)
def test_error_terms_that_cannot_be_are_refused(formula: str, errors: dict[str, str], words: str) -> None:
    with pytest.raises(InputError, match=words):
        nested(simulate(7), formula, errors=errors)


def test_designs_without_degrees_of_freedom_of_the_error_are_refused() -> None:
    rng = np.random.default_rng(8)
    shapes = rng.normal(size=(4, 3)) * 30 + rng.normal(size=(12, 4, 3))
    table = {"genus": np.repeat(["a", "b", "c"], 4), "species": np.repeat(["s", "t", "u"], 4)}
    with pytest.raises(InputError, match="genus:species"):  # one species in each genus
        nested(Cohort.of_shapes(shapes, table, align=False))
    with pytest.raises(InputError, match="equal variances"):
        CompareConfig(errors=ERRORS, variances="unequal")
    with pytest.raises(InputError, match="deviation coding"):
        CompareConfig(random="1 | who", coding="treatment")


def test_the_command_takes_error_terms() -> None:
    assert error_term("genus=genus:species") == ("genus", "genus:species")
    assert error_term("bs(age, df=4) = a:b") == ("bs(age, df=4)", "a:b")
    for text in ("genus", "=x", "genus="):
        with pytest.raises(argparse.ArgumentTypeError, match="TERM=ERROR"):
            error_term(text)
