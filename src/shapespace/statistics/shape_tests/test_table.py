"""Table of the tests of shape: for each its statistics, permuted unit, source, and the options of its command.

The command line imports this module for its help, so it imports nothing that takes time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class ShapeTest:
    """A test of shape.

    Args:
        name: word after `shapespace test`.
        summary: description of the test, without a capital and a full stop.
        function: name of the function in `statistics.shape_tests`, with its module; it takes a cohort and the options
            by name.
        statistics: computed statistics, in words.
        permuted: permuted unit, as `TestScheme.unit`.
        resampling: method by which p values are computed.
        references: citations of the method.
        example: a command line.
        options: field of the function -> name of its value in the help; empty for a flag or a choice.
        required: fields without which there is no test.
    """

    name: str
    summary: str
    function: str
    statistics: str
    permuted: str = "shape"
    resampling: Literal["permutation", "sign flips", "bootstrap", "none"] = "permutation"
    references: tuple[str, ...] = ()
    example: str = ""
    options: Mapping[str, str] = field(default_factory=dict[str, str])
    required: tuple[str, ...] = ()


_MODEL = {"formula": "FORMULA", "null": "FORMULA", "residuals": ""}
"""Options of a full and a reduced linear model."""

SHAPE_TESTS: tuple[ShapeTest, ...] = (
    ShapeTest(
        name="disparity",
        summary="compare the disparity (Procrustes variance) of groups, in total or about a model",
        function="groups.compare_disparity",
        statistics="Procrustes variance or partial disparity of each group, and the absolute difference of each pair",
        references=(
            "Zelditch, Swiderski and Sheets (2012) Geometric Morphometrics for Biologists, 2nd edition, Academic.",
            "Foote (1993) Paleobiology 19, 403-419.",
        ),
        example="shapespace test disparity people.csv --group species -o disparity",
        options={"group": "COLUMN", "formula": "FORMULA", "partial": "", "residuals": ""},
        required=("group",),
    ),
    ShapeTest(
        name="equality",
        summary="test equal means and equal covariance matrices of groups",
        function="groups.compare_means_and_covariances",
        statistics="F and distances of means; Riemannian distances of covariances, with and without their scale",
        references=("Mitteroecker and Bookstein (2009) Evolution 63, 727-737.",),
        example="shapespace test equality people.csv --group species -o equality",
        options={"group": "COLUMN", "components": "N"},
        required=("group",),
    ),
    ShapeTest(
        name="equivalence",
        summary="test whether means of groups differ by less than a margin",
        function="groups.assess_equivalence",
        statistics="squared distance of means less that of the margin by its standard error, upper bounds of distances",
        resampling="bootstrap",
        references=(
            "Wellek (2010) Testing Statistical Hypotheses of Equivalence and Noninferiority, 2nd edition, CRC.",
        ),
        example="shapespace test equivalence people.csv --group observer --margin-sd 0.5 -o equivalence",
        options={"group": "COLUMN", "margin": "DISTANCE", "margin_sd": "SD"},
        required=("group",),
    ),
    ShapeTest(
        name="power",
        summary="plan sample sizes of a comparison of groups by simulation from pilot data",
        function="planning.plan_sample_size",
        statistics="share of simulated studies whose test of group means is significant",
        resampling="bootstrap",
        references=("Silverman and Young (1987) Biometrika 74, 469-479.",),
        example="shapespace test power pilot.csv --group species --sizes 10,20,40 -o power",
        options={"group": "COLUMN", "effect": "EFFECT", "sizes": "LIST", "simulations": "N"},
        required=("group",),
    ),
    ShapeTest(
        name="discriminant",
        summary="classify shapes by linear discriminants, and test distances of group means",
        function="groups.discriminate",
        statistics="share of correct leave-one-out classifications, Mahalanobis and Procrustes distances of means",
        references=(
            "Venables and Ripley (2002) Modern Applied Statistics with S, 4th edition, Springer.",
            "Klingenberg and Monteiro (2005) Systematic Biology 54, 678-688.",
        ),
        example="shapespace test discriminant people.csv --group species -o discriminant",
        options={"group": "COLUMN", "components": "N", "priors": ""},
        required=("group",),
    ),
    ShapeTest(
        name="pairwise",
        summary="compare pairs of groups by least-squares means, or by vectors of slopes",
        function="linear.compare_pairs",
        statistics="distance of least-squares means, or distance, length difference and angle of vectors of slopes",
        references=("Collyer, Sekora and Adams (2015) Heredity 115, 357-365.",),
        example="shapespace test pairwise people.csv --formula '~ species * site' --group species,site -o pairs",
        options={"formula": "FORMULA", "group": "COLUMN", "covariate": "COLUMN", "null": "FORMULA", "residuals": ""},
        required=("formula", "group"),
    ),
    ShapeTest(
        name="trajectory",
        summary="compare trajectories of shape change of groups: size, angle and shape",
        function="linear.compare_trajectories",
        statistics="difference of path length, angle between principal axes, and difference of trajectory shape",
        references=("Collyer and Adams (2013) Hystrix 24, 75-83.",),
        example="shapespace test trajectory people.csv --group species --points stage -o trajectories",
        options={"group": "COLUMN", "points": "COLUMN", "order": "LIST", **_MODEL},
        required=("group", "points"),
    ),
    ShapeTest(
        name="allometry",
        summary="regress shape on size, test common slopes of groups, and correct shapes for size",
        function="linear.analyse_allometry",
        statistics="F of type II (that of the interaction with the covariate tests common slopes)",
        references=(
            "Drake and Klingenberg (2008) Proceedings of the Royal Society B 275, 71-76.",
            "Mitteroecker, Gunz, Bernhard, Schaefer and Bookstein (2004) Journal of Human Evolution 46, 679-698.",
        ),
        example="shapespace test allometry people.csv --covariate log_size --group species -o allometry",
        options={"covariate": "COLUMN", "group": "COLUMN", "separate": ""},
    ),
    ShapeTest(
        name="repeatability",
        summary="measure repeatability and measurement error from replicates",
        function="linear.measure_repeatability",
        statistics="intraclass correlations with jackknife intervals, and F of subjects and of sessions",
        references=(
            "Fruciano (2016) Development Genes and Evolution 226, 139-158.",
            "Liljequist, Elfving and Skavberg Roaldsen (2019) PLoS ONE 14, e0219854.",
        ),
        example="shapespace test repeatability digitised.csv -o repeatability",
        options={"session": "COLUMN"},
    ),
    ShapeTest(
        name="pls",
        summary="fit two-block partial least squares of shape and columns of the table",
        function="covariation.fit_pls",
        statistics="r-PLS, the correlation of the scores of both blocks on the first pair of axes",
        references=("Rohlf and Corti (2000) Syst. Biol. 49, 740-753.",),
        example="shapespace test pls people.csv --columns length,width -o pls",
        options={"columns": "LIST"},
        required=("columns",),
    ),
    ShapeTest(
        name="integration",
        summary="estimate the integration of modules by partial least squares",
        function="covariation.fit_pls",
        statistics="r-PLS of each pair of modules, and their mean",
        references=(
            "Bookstein et al. (2003) J. Hum. Evol. 44, 167-187.",
            "Adams and Collyer (2016) Evolution 70, 2623-2631.",
        ),
        example="shapespace test integration people.csv --modules modules.csv -o integration",
        options={"modules": "FILE"},
    ),
    ShapeTest(
        name="modularity",
        summary="estimate modularity by the covariance ratio CR",
        function="covariation.estimate_modularity",
        statistics="CR of each pair of modules, and their mean (small values are modular)",
        permuted="landmark",
        references=(
            "Adams (2016) Methods Ecol. Evol. 7, 565-572.",
            "Adams and Collyer (2019) Evolution 73, 2352-2367.",
        ),
        example="shapespace test modularity people.csv --modules modules.csv -o modularity",
        options={"modules": "FILE"},
    ),
    ShapeTest(
        name="signal",
        summary="estimate phylogenetic signal K of shape and of principal components",
        function="phylogenetic.estimate_phylogenetic_signal",
        statistics="K of shape, and of principal components",
        references=(
            "Adams (2014) Syst. Biol. 63, 685-697.",
            "Collyer, Baken and Adams (2022) Methods Ecol. Evol. 13, 367-382.",
        ),
        example="shapespace test signal species.csv --tree species.nwk -o signal",
        options={"tree": "FILE"},
        required=("tree",),
    ),
    ShapeTest(
        name="pgls",
        summary="fit a linear model of shape by phylogenetic generalised least squares",
        function="phylogenetic.fit_pgls",
        statistics="F of each term",
        permuted="phylogenetically transformed shape",
        references=("Adams (2014) Evolution 68, 2675-2688.", "Adams and Collyer (2018) Evolution 72, 1204-1215."),
        example="shapespace test pgls species.csv --tree species.nwk --formula '~ log_size' -o pgls",
        options={"formula": "FORMULA", "tree": "FILE", "anova_type": ""},
        required=("formula", "tree"),
    ),
)
"""All tests, in the order of the commands and the page."""


def shape_test(name: str) -> ShapeTest:
    """Return the test of a name, which exists."""
    return next(test for test in SHAPE_TESTS if test.name == name)
