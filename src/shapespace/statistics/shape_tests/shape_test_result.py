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
from shapespace.statistics.shape_tests.test_table import ShapeTest, shape_test
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
