"""Result of a test of shape: statistics with their permutation distributions, tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.reprs import list_briefly, short_repr
from shapespace.schemas import Methods, Part, TablePart, TestScheme
from shapespace.statistics.effect_size import EffectSize, UnknownP, effect_size, permutation_p
from shapespace.statistics.methods import AnalysisResult, methods_of, sample_sizes
from shapespace.types import FloatArray, read_only

LEVEL = 0.05  # of significance; intervals have a confidence of 1 - LEVEL


@dataclass(frozen=True, eq=False, kw_only=True)
class Statistic:
    """A statistic with its permutation distribution.

    Args:
        name: such as `CR`, or `difference of disparity`.
        tested: what it compares, such as `female – male`; empty where the name says it.
        value: as observed.
        p: share of the arrangements that are as extreme; None without a test, or where it is not known.
        z: effect size, the value in standard deviations of its arrangements; None without.
        low, high: confidence interval; None without.
        arrangements: (P,) the statistic of each arrangement, the observed one first; empty without a test.
        unknown_p: why p is not known; None where it is, or without a test.

    Example:
        >>> statistic = ss.statistics.compare_disparity(cohort, group=["group"], permutations=99).statistics[0]
        >>> 0 < statistic.p <= 1
        True
    """

    name: str
    value: float
    tested: str = ""
    p: float | None = None
    z: float | None = None
    low: float | None = None
    high: float | None = None
    arrangements: FloatArray = field(default_factory=lambda: np.zeros(0))
    unknown_p: UnknownP | None = None

    __repr__ = short_repr

    @property
    def label(self) -> str:
        """Name and what is compared."""
        return f"{self.name}, {self.tested}" if self.tested else self.name

    @staticmethod
    def of(
        name: str,
        arrangements: FloatArray,
        tested: str = "",
        *,
        tail: Literal["upper", "lower"] = "upper",
        z: EffectSize | Literal["standard", "none"] = "box-cox",
    ) -> Statistic:
        """Return a statistic with p and Z of its arrangements.

        Args:
            name: of the statistic.
            arrangements: (P,) the observed one first.
            tested: what it compares.
            tail: whether large or small values are extreme.
            z: transformation before Z is standardised; `standard` for none, `none` for no Z.
        """
        values = np.asarray(arrangements, dtype=np.float64)
        if z == "standard":
            spread = float(values.std())
            score = float((values[0] - values.mean()) / spread) if spread > 0 else 0.0
        else:
            score = None if z == "none" else effect_size(values, z)
        return Statistic(
            name=name, tested=tested, value=float(values[0]), p=permutation_p(values, tail), z=score,
            arrangements=read_only(values),
        )  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class ShapeTestResult(AnalysisResult):
    """Result of one of `SHAPE_TESTS`.

    Args:
        name: of the test in the table of tests.
        cohort: the shapes that were used.
        statistics: the most important ones first.
        tables: further tables of the report; each is also written as CSV, under its title.
        figures: further parts of the report, after the tables.
        arrays: file name (.npz) -> arrays by name, which figures refer to.
        settings: all that the result depends on, the seed among it.
        classes: columns whose classes are counted in the sample sizes.
        reduced_model: terms of the model whose residuals are permuted; None where shapes or labels themselves are.
        assumptions: sentences on assumptions of the test, for the methods.
        level: of significance.
        subject: column of the independent units; None where all shapes are independent.

    Example:
        >>> result = ss.statistics.compare_disparity(cohort, group=["group"], permutations=99)
        >>> result.name
        'disparity'
    """

    __test__ = False  # no test class of pytest

    name: str
    cohort: Cohort
    statistics: Sequence[Statistic]
    tables: tuple[TablePart, ...] = ()
    figures: tuple[Part, ...] = ()
    arrays: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])
    classes: Sequence[str] = ()
    reduced_model: tuple[str, ...] | None = None
    assumptions: tuple[str, ...] = ()
    level: float = LEVEL
    subject: str | None = None

    @property
    def test(self) -> ShapeTest:
        """Row of the table of tests."""
        return shape_test(self.name)

    def statistic(self, name: str, tested: str = "") -> Statistic:
        """Return a statistic by its name and what it compares.

        Raises:
            KeyError: there is none.
        """
        for one in self.statistics:
            if one.name == name and (not tested or one.tested == tested):
                return one
        raise KeyError(f"{name} {tested}".strip())

    def table(self, title: str) -> TablePart:
        """Return a table by its title.

        Raises:
            KeyError: there is none.
        """
        for one in self.tables:
            if one.title == title:
                return one
        raise KeyError(title)

    @property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        tested = tuple(dict.fromkeys(one.name for one in self.statistics if one.p is not None or one.unknown_p))
        counts = [len(one.arrangements) for one in self.statistics if len(one.arrangements)]
        scheme = TestScheme(
            tested=tested, statistic=self.test.statistics, resampling=self.test.resampling, unit=self.test.permuted,
            reduced_model=self.reduced_model, arrangements=max(counts, default=0),
        )  # fmt: skip
        subjects = self.cohort.table.texts(self.subject) if self.subject else self.cohort.names
        sizes = sample_sizes(subjects, [(column, self.cohort.table.texts(column)) for column in self.classes])
        return methods_of(
            self.cohort, len(set(subjects)), level=self.level, sizes=sizes,
            tests=(scheme,) if tested else (), assumptions=self.assumptions,
            effect_size="box-cox" if any(one.z is not None for one in self.statistics) else "",
        )  # fmt: skip

    def __repr__(self) -> str:
        rows = [f"{one.label} {one.value:.4g}" + (f", p {one.p:.3g}" if one.p is not None else
                ", p not known" if one.unknown_p else "") for one in self.statistics]  # fmt: skip
        return f"<ShapeTestResult {self.name} of {len(self.cohort)} shapes; {list_briefly(rows)}>"


def pair_statistics(
    name: str, values: FloatArray, pairs: Sequence[str], tail: Literal["upper", "lower"] = "upper"
) -> list[Statistic]:
    """Return the statistics of pairs from their arrangements (pairs, P)."""
    return [Statistic.of(name, one, pair, tail=tail) for one, pair in zip(values, pairs, strict=True)]


@dataclass(frozen=True, kw_only=True)
class ShapeTest:
    """A test of shape.

    Args:
        name: word after `shapespace test`.
        summary: what it does, without a capital and a full stop.
        function: in `statistics.shape_tests`, with its module; it takes a cohort and the options by name.
        statistics: what is computed, in words.
        permuted: what is permuted, as `TestScheme.unit`.
        resampling: how p values are computed.
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
        example="shapespace test repeatability digitised.csv --subject specimen -o repeatability",
        options={"subject": "COLUMN", "session": "COLUMN"},
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
        required=("modules",),
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
        required=("modules",),
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
