"""The methods of an analysis in English: paragraphs and tables that end its report."""

from __future__ import annotations

from collections.abc import Iterator

from shapespace.schemas import Dispersion, Methods, Part, TableColumn, TablePart, TestScheme, TextPart
from shapespace.statistics.dispersion import FEWEST_OF_GROUP
from shapespace.statistics.methods import SCAN_OF_SUBJECT

_SOURCES = {
    "coefficients": "coefficients of the model of the fits",
    "fitted": "fitted model surfaces",
    "dense": "dense surfaces of the fits",
    "corresponding": "surfaces in correspondence",
    "surfaces": "surfaces or landmarks in correspondence",
}


def methods_parts(methods: Methods) -> tuple[Part, ...]:
    """Return the parts of a report that state the methods of an analysis."""
    return tuple(_parts(methods))


def _parts(methods: Methods) -> Iterator[Part]:
    yield TextPart(title="Methods", level=2, text=tuple(_sentences(methods)))
    if methods.sizes:
        yield TablePart(
            title="Sample sizes",
            columns=(
                TableColumn(name="variable"), TableColumn(name="class"), TableColumn(name="subjects", kind="count"),
                TableColumn(name="shapes", kind="count"),
            ),
            rows=tuple(
                (" × ".join(one.variables), " × ".join(one.classes), one.subjects, one.shapes) for one in methods.sizes
            ),
        )  # fmt: skip
    if methods.tests:
        yield TablePart(
            title="Tests",
            columns=(
                TableColumn(name="tested"), TableColumn(name="stratum"), TableColumn(name="statistic"),
                TableColumn(name="p by"), TableColumn(name="arrangements", kind="count"),
            ),
            rows=tuple(
                (", ".join(one.tested), one.stratum or "all", one.statistic, scheme_text(one), one.arrangements or None)
                for one in methods.tests
            ),
            note="The observed data are one of the arrangements of a permutation or of sign flips.",
        )  # fmt: skip
    if methods.dispersions:
        unit = f", {methods.unit}" if methods.unit else ""
        yield TablePart(
            title="Equal dispersion of groups",
            columns=(
                TableColumn(name="variable"), TableColumn(name="stratum"), TableColumn(name="class"),
                TableColumn(name="n", kind="count"), TableColumn(name=f"standard deviation{unit}", kind="number"),
                TableColumn(name="F", kind="number"), TableColumn(name="p", kind="p"),
            ),
            rows=tuple(
                (one.variable, one.stratum or "all", group, count, stddev, *((one.f, one.p) if not k else (None, None)))
                for one in methods.dispersions
                for k, (group, count, stddev) in enumerate(zip(one.groups, one.counts, one.stddev, strict=True))
            ),
            note="Standard deviations of shapes about the mean of their class, root mean square over vertices; p by "
            "permutation of the distances to the class mean, corrected for the size of the class.",
        )  # fmt: skip


def _sentences(methods: Methods) -> Iterator[str]:
    shapes = f"{methods.shapes} shapes of {methods.subjects} subjects"
    size = "size is divided out" if methods.gauge == "shape" else "size is kept"
    modes = (
        f" ({methods.modes} modes, {100 * methods.explained_variance_ratio:.0f} % of the variance of its training set)"
        if methods.modes is not None and methods.explained_variance_ratio is not None
        else ""
    )
    space = (
        f" The analysis uses {methods.dimensions} dimensions, which contain "
        f"{100 * methods.analysed_variance_ratio:.3g} % of the variance of the shapes."
        if methods.dimensions is not None
        else " The analysis uses displacements of vertices along their normals."
    )
    yield (
        f"Data: {shapes}, {methods.vertices} vertices each: {_SOURCES.get(methods.source, methods.source)}{modes}; "
        f"{size} (gauge {methods.gauge}).{space} "
        + ("Lengths are in mm." if methods.unit == "mm" else "The coordinates have no unit, so lengths have none.")
    )
    if any(test.resampling in ("permutation", "sign flips") for test in methods.tests):
        yield f"Exchangeability: {_exchangeability(methods)}"
    yield from (dispersion_sentence(one, methods.unequal_variances, methods.unit) for one in methods.dispersions)
    if methods.r2_strata is not None:
        strata = [one for one in methods.r2_strata if one]
        yield (
            f"R² is the share of the total sum of squares of the stratum of the term ({', '.join(strata)}), not of all "
            "shapes."
            if strata
            else "R² is the share of the total sum of squares of all shapes."
        )
    if methods.effect_size:
        yield effect_size_sentence(methods.effect_size)
    if methods.tests:
        yield multiplicity_sentence(methods)
    yield from methods.assumptions


def _exchangeability(methods: Methods) -> str:
    kinds = {test.resampling for test in methods.tests if not test.unequal_variances}
    sentences: list[str] = []
    if "permutation" in kinds:
        sentences.append(
            "permutation assumes that the residuals have the same distribution in all groups, with equal dispersion"
        )
    if "sign flips" in kinds:
        sentences.append("sign flips assume independent subjects whose residuals are symmetric about their mean")
    if any(test.unequal_variances for test in methods.tests):
        sentences.append(
            "tests with unequal variances flip the signs of residuals of independent subjects, whose covariances may "
            f"differ between groups; their level was measured for classes of {FEWEST_OF_GROUP} subjects or more"
        )
    return "; ".join(sentences) + "."


def scheme_text(test: TestScheme) -> str:
    """Return how the p value of a test was computed."""
    if test.resampling == "none":
        return "distribution"
    if test.resampling == "bootstrap":
        return f"bootstrap of {test.unit}s"
    if test.resampling == "leave-one-out":
        return f"leaving out each {test.unit} of the reference"
    every = ", all of them" if test.exhaustive else ""
    units = (
        "values"
        if test.reduced_model is None
        else f"residuals of shape ~ {' + '.join(test.reduced_model)}"
        if test.reduced_model
        else "residuals of the mean"
    )
    if test.resampling == "sign flips":
        return f"{units} with signs flipped by {test.unit}{every}"
    difference, _, block = test.unit.partition(" within a ")
    scope = f"of {difference}s permuted within {block}s" if block else f"permuted between {test.unit}s"
    if test.unit == SCAN_OF_SUBJECT:
        scope = "permuted within subjects, and between subjects with the same number of scans"
    return f"{units} {scope}{every}"


def dispersion_sentence(one: Dispersion, unequal_variances: bool | None, unit: str) -> str:
    """Return whether the classes of a variable are equally variable, and what follows if they are not.

    Args:
        one: the test.
        unequal_variances: whether the tests of means allow unequal dispersion.
        unit: of lengths.
    """
    named = ", ".join(
        f"{group} {stddev:.3g}{f' {unit}' if unit else ''} (n = {count})"
        for group, count, stddev in zip(one.groups, one.counts, one.stddev, strict=True)
    )
    where = f" {one.stratum}" if one.stratum else ""
    details = f"standard deviations by {one.variable}{where}: {named}; p = {one.p:.3g}"
    if unequal_variances and min(one.counts) < FEWEST_OF_GROUP:
        return (
            f"Warning: {one.variable}{where} has a class of {min(one.counts)} subjects; below "
            f"{FEWEST_OF_GROUP} the test with unequal variances has too many false positives, 8 % instead of 5 % for 4 "
            f"({details})."
        )
    if one.equal:
        return f"No significant difference of dispersion ({details})."
    if unequal_variances:
        return f"Dispersion is unequal ({details}); the tests of means allow for it."
    effect = {
        True: "smaller classes are more variable, so p values of means are too small and differences are found that do "
        "not exist",
        False: "smaller classes are less variable, so p values of means are too large and differences are missed",
        None: "p values of means also respond to differences of dispersion",
    }[one.smaller_is_more_variable]
    return f"Warning: dispersion is unequal ({details}): {effect}. Use --unequal-variances (unequal_variances=True)."


def is_dispersion_warning(one: Dispersion, *, unequal_variances: bool) -> bool:
    """Return whether the dispersion or the size of classes makes the p values of means doubtful."""
    return min(one.counts) < FEWEST_OF_GROUP if unequal_variances else not one.equal


def effect_size_sentence(kind: str) -> str:
    """Return what Z is."""
    if kind == "log":
        return "Z is log F in standard deviations above the mean of its arrangements (RRPP before version 0.6)."
    return (
        "Z is F, made normal by a Box-Cox transformation, in standard deviations above the mean of its arrangements "
        "(as in RRPP from version 0.6)."
    )


def multiplicity_sentence(methods: Methods) -> str:
    """Return a sentence on the correction of p values for multiple testing."""
    if not methods.corrected_over:
        return "Multiple testing: no p value is corrected for the number of tests, maps or analyses."
    return (
        f"Multiple testing: p values are corrected only over {'; over '.join(methods.corrected_over)}, not over the "
        "number of terms, maps or analyses."
    )
