"""The methods of an analysis in English: paragraphs and tables that end its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import cast

from shapespace.report.blocks.wording import counted
from shapespace.schemas import (
    AlignRecord,
    Analysis,
    Dispersion,
    Methods,
    Part,
    TablePart,
    TestScheme,
    TextPart,
)
from shapespace.statistics.dispersion import FEWEST_OF_GROUP, FEWEST_PATTERNS
from shapespace.statistics.methods import REDUCED_OF_EACH_TERM, SCAN_OF_SUBJECT
from shapespace.store.corresponding import review_summary

_SOURCES = {
    "coefficients": "coefficients of the model of the fits",
    "fitted": "fitted model surfaces",
    "dense": "dense surfaces of the fits",
    "corresponding": "surfaces in correspondence",
    "surfaces": "surfaces or landmarks in correspondence",
    "landmarks": "landmarks",
}
_FITS = ("coefficients", "fitted", "dense")
_STATED = frozenset((
    "gauge", "shapes", "subjects", "vertices", "level", "effect_size", "unequal_variances", "permutations",
    "uncertainty", "modes", "variance_share", "imputations", "missing_information",
))  # fmt: skip
"""Settings that the record of the methods states, or that are results."""
_SETTING_NAMES = {
    "squares": "type of sums of squares", "folds": "folds of cross-validation", "draws": "bootstrap draws",
    "bump_width_mm": "width of bumps, mm", "formula": "model",
}  # fmt: skip
_ALIGNMENT = (
    "Gower J. C. (1975) Generalized Procrustes analysis. Psychometrika 40, 33-51.",
    "Rohlf F. J., Slice D. (1990) Extensions of the Procrustes method for the optimal superimposition of landmarks. "
    "Systematic Zoology 39, 40-59.",
)
_SLIDING = (
    "Gunz P., Mitteroecker P. (2013) Semilandmarks: a method for quantifying curves and surfaces. Hystrix 24, 103-109.",
)
_OF_FITS = (
    "Quan W., Matuszewski B. J., Shark L.-K., Ait-Boudaoud D. Low Dimensional Surface Parameterisation with "
    "Applications in Biometrics.",
)
_RESIDUALS = (
    "Freedman D., Lane D. (1983) A nonstochastic interpretation of reported significance levels. Journal of Business & "
    "Economic Statistics 1, 292-298.",
    "Collyer M. L., Adams D. C. (2018) RRPP: an R package for fitting linear models to high-dimensional data using "
    "residual randomization. Methods in Ecology and Evolution 9, 1772-1779.",
)
_SIGN_FLIPS = (
    "Winkler A. M. et al. (2014) Permutation inference for the general linear model. NeuroImage 92, 381-397.",
)
_EFFECT_SIZE = (
    "Collyer M. L., Sekora D. J., Adams D. C. (2015) A method for analysis of phenotypic change for phenotypes "
    "described by high-dimensional data. Heredity 115, 357-365.",
)
_OF_QUESTION = {
    "compare": ("Goodall C. (1991) Procrustes methods in the statistical analysis of shape. Journal of the Royal "
                "Statistical Society B 53, 285-339.",),
    "asymmetry": ("Klingenberg C. P., Barluenga M., Meyer A. (2002) Shape analysis of symmetric structures: "
                  "quantifying variation among individuals and asymmetry. Evolution 56, 1909-1920.",),
    "change": ("Bland J. M., Altman D. G. (1986) Statistical methods for assessing agreement between two methods of "
               "clinical measurement. Lancet 327, 307-310.",),
    "recognise verify": ("Brümmer N., du Preez J. (2006) Application-independent evaluation of speaker detection. "
                         "Computer Speech & Language 20, 230-275.",),
}  # fmt: skip
"""Citations of each analysis, by its command."""


def points_word(methods: Methods) -> str:
    """Return the word for the points of a shape."""
    return "landmarks" if methods.source == "landmarks" else "vertices"


def methods_text(analysis: Analysis) -> str:
    """Return methods.txt: a paragraph for a methods section, and its references.

    Args:
        analysis: analysis with the record of its methods.
    """
    methods = analysis.methods
    if methods is None:
        return ""
    versions = ", ".join(f"{name} {version}" for name, version in analysis.versions.items())
    sentences = [f"Shapes were analysed with the command {analysis.question} of shapespace ({versions})."]
    data, *others = _sentences(methods, in_paper=True)
    sentences += [data, *_test_sentences(methods.tests), *others]
    if methods.tests:
        sentences.append(f"The level of significance is {methods.level:g}.")
    chosen = [
        f"{_SETTING_NAMES.get(key, key.replace('_', ' '))} {_value_text(value)}"
        for key, value in analysis.settings.items()
        if key not in _STATED
        and not key.startswith(("shape_", "estimated_"))
        and value is not None
        and value is not False
        and value not in ("", [], {}, ())
    ]
    sentences += [f"Settings: {'; '.join(chosen)}."] if chosen else []
    return _paragraph(sentences, citations_of(analysis))


def citations_of(analysis: Analysis) -> tuple[str, ...]:
    """Return the citations of an analysis: those of its methods, and its own."""
    methods = analysis.methods
    if methods is None:
        return analysis.citations
    flips = any(test.resampling == "sign flips" for test in methods.tests)
    residuals = any(test.resampling == "permutation" and test.reduced_model is not None for test in methods.tests)
    groups = (
        _OF_FITS if methods.source in _FITS else (),
        _ALIGNMENT if methods.source != "coefficients" else (),
        _OF_QUESTION.get(analysis.question, ()),
        _RESIDUALS if residuals else (),
        _SIGN_FLIPS if flips else (),
        _EFFECT_SIZE if methods.effect_size else (),
        analysis.citations,
    )
    return tuple(dict.fromkeys(citation for group in groups for citation in group))


def alignment_text(record: AlignRecord) -> str:
    """Return methods.txt of an alignment of landmarks.

    Args:
        record: record of the alignment.
    """
    settings = record.settings
    curves, surface = (int(settings.get(f"{kind}_semilandmarks") or 0) for kind in ("curve", "surface"))
    tangent = record.gauge == "shape" and bool(settings.get("tangent", True))
    sentences = [
        f"Landmarks were aligned with the command align of shapespace {record.version}. The data are "
        f"{record.specimens} specimens with {record.landmarks} landmarks in {record.dimensions} dimensions each.",
        "They were aligned by generalised Procrustes analysis "
        + ("with scaling to unit centroid size" if record.gauge == "shape" else "without scaling")
        + (", and projected orthogonally to the tangent space at their mean." if tangent else "."),
    ]
    if settings.get("curves") and settings.get("match_curves"):
        sentences.append("Starts of closed curves and directions of curves were chosen by the Procrustes distance.")
    if curves or surface:
        by = str(settings.get("slide_by", "bending-energy")).replace("-", " ")
        sentences.append(
            f"{curves} semilandmarks on curves and {surface} on surfaces were slid to minimise the "
            f"{'Procrustes distance' if by == 'procrustes' else by} to the mean."
        )
    if reflect := settings.get("reflect"):
        sentences.append(f"Specimens with {reflect[0]} {reflect[1]} were reflected before the alignment.")
    if record.estimated:
        method = "a thin-plate spline" if settings.get("missing", "tps") == "tps" else "regression"
        estimated = counted(record.estimated, "missing landmark was", "missing landmarks were")
        sentences.append(f"{estimated} estimated by {method}.")
    if settings.get("structures"):
        sentences.append("Structures were aligned separately.")
    end = "converged" if record.converged else "stopped before convergence"
    sentences.append(f"The alignment {end} in {counted(record.iterations, 'iteration')}.")
    references = (*_ALIGNMENT, *(_SLIDING if curves or surface else ()))
    return _paragraph(sentences, references)


def _paragraph(sentences: Sequence[str], references: Sequence[str]) -> str:
    return "\n".join([" ".join(sentences), *(["", "References", "", *references] if references else []), ""])


def _value_text(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {entry}" for key, entry in cast(Mapping[object, object], value).items())
    if isinstance(value, list | tuple):
        return ", ".join(map(str, cast(Sequence[object], value)))
    return "yes" if value is True else f"{value:g}" if isinstance(value, float) else str(value)


def _test_sentences(tests: Sequence[TestScheme]) -> Iterator[str]:
    kinds = [(test.arrangements, test.resampling == "bootstrap") for test in tests]
    for count, draws in dict.fromkeys(kinds):
        details = [
            f"of {_tested_text(test)} by {scheme_text(test)}"
            for test, kind in zip(tests, kinds, strict=True)
            if kind == (count, draws)
        ]
        source = f"come from {count:,} arrangements, the observed data among them: " if count else "are "
        subject = f"Intervals come from {count:,} draws: " if draws else f"p values {source}"
        yield f"{subject}{'; '.join(details)}."


def _tested_text(test: TestScheme) -> str:
    tested = ", ".join(test.tested)
    if test.statistic.startswith(tested):
        # Names such as K, which a description of the statistics repeats.
        return test.statistic
    stratum = f" in the stratum {test.stratum}" if test.stratum else ""
    return f"{tested}{stratum}{f' ({test.statistic})' if test.statistic else ''}"


def methods_parts(methods: Methods) -> Iterator[Part]:
    """Yield the parts of a report that state the methods of an analysis."""
    yield TextPart(title="Methods", level=2, text=tuple(_sentences(methods)))
    if methods.sizes:
        sizes = [
            (" × ".join(size.variables), " × ".join(size.classes), size.subjects, size.shapes) for size in methods.sizes
        ]
        yield TablePart.of("Sample sizes", ("variable", "class", "subjects", "shapes"), sizes)
    if methods.tests:
        yield TablePart.of(
            "Tests", ("tested", "stratum", "statistic", "p by", "arrangements"),
            [(", ".join(test.tested), test.stratum or "all", test.statistic, scheme_text(test),
              test.arrangements or None)
             for test in methods.tests],
            note="The observed data are one of the arrangements of a permutation or of sign flips.",
        )  # fmt: skip
    if methods.dispersions:
        unit = f", {methods.unit}" if methods.unit else ""
        yield TablePart.of(
            "Equal dispersion of groups",
            ("variable", "stratum", "class", "n", f"standard deviation{unit}", "F", "p"),
            [(dispersion.variable, dispersion.stratum or "all", group, count, stddev,
              *((dispersion.f, dispersion.p) if not k else (None, None)))
             for dispersion in methods.dispersions
             for k, (group, count, stddev) in enumerate(
                 zip(dispersion.groups, dispersion.counts, dispersion.stddev, strict=True))],
            note="Standard deviations of shapes about the mean of their class, root mean square over vertices; p by "
            "permutation of the distances to the class mean, corrected for the size of the class.",
        )  # fmt: skip


def _sentences(methods: Methods, *, in_paper: bool = False) -> Iterator[str]:
    """Yield the sentences on data and tests; those in a paper have no advice."""
    shapes = f"{methods.shapes} shapes of {methods.subjects} subjects"
    points = points_word(methods)
    modes = (
        f" ({methods.modes} modes, {100 * methods.explained_variance_ratio:.0f} % of the variance of its training set)"
        if methods.modes is not None and methods.explained_variance_ratio is not None
        else ""
    )
    space = (
        f" The analysis uses {methods.dimensions} dimensions, which contain "
        f"{100 * methods.analysed_variance_ratio:.3g} % of the variance of the shapes."
        if methods.dimensions is not None
        else f" The analysis uses displacements of {points} along their normals."
    )
    source = "" if methods.source == "landmarks" else f" ({_SOURCES.get(methods.source, methods.source)}{modes})"
    yield (
        f"The data are {shapes}, with {methods.vertices} {points} in {methods.coordinates} dimensions each{source}. "
        f"{_alignment_sentence(methods)}{space} "
        + ("Lengths are in mm." if methods.unit == "mm" else "The coordinates have no unit, so lengths have none.")
    )
    if review := review_summary(methods.review):
        yield f"{review}."
    if any(test.resampling in ("permutation", "sign flips") for test in methods.tests):
        yield f"Exchangeability: {_exchangeability(methods)}"
    if in_paper and methods.dispersions:
        tests = [
            f"{dispersion.variable}{f' {dispersion.stratum}' if dispersion.stratum else ''} (p = {dispersion.p:.3g})"
            for dispersion in methods.dispersions
        ]
        yield f"Equal dispersion was tested by permutation of distances to class means: {', '.join(tests)}."
    elif methods.dispersions:
        yield from (
            dispersion_sentence(dispersion, methods.unequal_variances, methods.unit)
            for dispersion in methods.dispersions
        )
    if methods.r2_strata is not None:
        strata = [stratum for stratum in methods.r2_strata if stratum]
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


def _alignment_sentence(methods: Methods) -> str:
    size = (
        "with scaling, so that size is divided out"
        if methods.gauge == "shape"
        else "without scaling, so that size is kept"
    )
    tangent = ", and lie in the tangent space at their mean" if methods.tangent else ""
    if methods.source == "coefficients":
        size = "size is divided out" if methods.gauge == "shape" else "size is kept"
        return (
            f"They are in the frame of the shape model, in which pose is divided out; {size} (gauge {methods.gauge})."
        )
    return f"They were aligned by generalised Procrustes analysis {size} (gauge {methods.gauge}){tangent}."


def _exchangeability(methods: Methods) -> str:
    equal = [test for test in methods.tests if not test.unequal_variances]
    kinds = {test.resampling for test in equal}
    permuted = [test for test in equal if test.resampling == "permutation"]
    sentences: list[str] = []
    if permuted and not methods.sizes and all(test.reduced_model is None for test in permuted):
        sentences.append("permutation assumes that the permuted units are exchangeable under the null hypothesis")
    elif permuted:
        sentences.append(
            "permutation assumes that the residuals have the same distribution in all groups, with equal dispersion"
        )
    if "sign flips" in kinds:
        sentences.append("sign flips assume independent subjects whose residuals are symmetric about their mean")
    if any(test.unequal_variances for test in methods.tests):
        sentences.append(
            "tests with unequal variances flip the signs of residuals of independent subjects, whose covariances may "
            f"differ between groups; residuals of classes with fewer than {FEWEST_PATTERNS} different flips are "
            "rotated, which assumes that they are normal; the level was measured for classes of "
            f"{FEWEST_OF_GROUP} subjects or more"
        )
    return "; ".join(sentences) + "."


def scheme_text(test: TestScheme) -> str:
    """Return the method of the p value of a test, in words."""
    if test.resampling == "none":
        return "its distribution"
    if test.resampling == "bootstrap":
        return f"bootstrap of {test.unit}s"
    if test.resampling == "leave-one-out":
        return f"leave-one-out over the {_plural(test.unit)} of the reference"
    every = ", all of them" if test.exhaustive else ""
    difference, _, block = test.unit.partition(" within a ")
    within = f" within {_plural(block)}" if block else ""
    if test.resampling == "permutation" and test.reduced_model is None and test.unit != SCAN_OF_SUBJECT:
        return f"permutation of {_plural(difference)}{within}{every}"
    if test.resampling == "sign flips" and test.reduced_model is None:
        return f"sign flips of {_plural(test.unit)}{every}"
    units = (
        "values"
        if test.reduced_model is None
        else f"residuals of {REDUCED_OF_EACH_TERM[0]}"
        if test.reduced_model == REDUCED_OF_EACH_TERM
        else f"residuals of shape ~ {' + '.join(test.reduced_model)}"
        if test.reduced_model
        else "residuals of the mean"
    )
    if test.resampling == "sign flips":
        return f"{units} with signs flipped by {test.unit}{every}"
    scope = f"of {_plural(difference)} permuted{within}" if block else f"permuted between {_plural(test.unit)}"
    if test.unit == SCAN_OF_SUBJECT:
        scope = "permuted within subjects, and between subjects with the same number of scans"
    return f"{units} {scope}{every}"


def _plural(unit: str) -> str:
    """Return the plural of a unit such as `subject` or `mean of a side`."""
    noun, of, rest = unit.partition(" of ")
    return f"{noun}s{of}{rest}"


def dispersion_sentence(dispersion: Dispersion, unequal_variances: bool | None, unit: str) -> str:
    """Return whether the classes of a variable are equally variable, and the consequence if they are not.

    Args:
        dispersion: test of equal dispersion.
        unequal_variances: whether the tests of means allow unequal dispersion.
        unit: unit of lengths; empty if the coordinates have no unit.
    """
    named = ", ".join(
        f"{group} {stddev:.3g}{f' {unit}' if unit else ''} (n = {count})"
        for group, count, stddev in zip(dispersion.groups, dispersion.counts, dispersion.stddev, strict=True)
    )
    where = f" {dispersion.stratum}" if dispersion.stratum else ""
    details = f"standard deviations by {dispersion.variable}{where}: {named}; p = {dispersion.p:.3g}"
    if unequal_variances and min(dispersion.counts) < FEWEST_OF_GROUP:
        return (
            f"Warning: {dispersion.variable}{where} has a class of {min(dispersion.counts)} subjects; with fewer than "
            f"{FEWEST_OF_GROUP} the test with unequal variances is cautious and finds few differences ({details})."
        )
    if dispersion.equal:
        return f"No significant difference of dispersion ({details})."
    if unequal_variances:
        return f"Dispersion is unequal ({details}); the tests of means allow for it."
    effect = {
        True: "differences are found that do not exist",
        False: "differences are missed",
        None: "they also respond to differences of dispersion",
    }[dispersion.smaller_is_more_variable]
    return (
        f"Warning: dispersion is unequal ({details}): p values of means are {bias_of_p(dispersion)}, and {effect}. Use "
        "--variances unequal."
    )


def bias_of_p(dispersion: Dispersion) -> str:
    """Return how unequal dispersion changes p values of means that assume equal variances."""
    return {True: "too small", False: "too large", None: "approximate"}[dispersion.smaller_is_more_variable]


def is_dispersion_warning(dispersion: Dispersion, *, unequal_variances: bool) -> bool:
    """Return whether the dispersion or the size of classes makes the p values of means doubtful."""
    return min(dispersion.counts) < FEWEST_OF_GROUP if unequal_variances else not dispersion.equal


def effect_size_sentence(kind: str) -> str:
    """Return the definition of the effect size Z, in words."""
    if kind == "log":
        return "Z is log F in standard deviations above the mean of its arrangements (RRPP before version 0.6)."
    return (
        "Z is the statistic, made normal by a Box-Cox transformation, in standard deviations above the mean of its "
        "arrangements (as in RRPP from version 0.6)."
    )


def multiplicity_sentence(methods: Methods) -> str:
    """Return a sentence on the correction of p values for multiple testing."""
    if not methods.corrected_over:
        return "Multiple testing: no p value is corrected for the number of tests, maps or analyses."
    return (
        f"Multiple testing: p values are corrected only over {'; over '.join(methods.corrected_over)}, not over the "
        "number of terms, maps or analyses."
    )
