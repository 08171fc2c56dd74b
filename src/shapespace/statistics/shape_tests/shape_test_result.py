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
        name: name of the statistic, such as `CR`, or `difference of disparity`.
        tested: compared groups or variables, such as `female – male`; empty if the name states them.
        value: observed value.
        p: share of the arrangements that are as extreme; None without a test, or if it is not known.
        z: effect size, the value in standard deviations of its arrangements; None if it is not computed.
        low, high: confidence interval; None if none is computed.
        arrangements: (P,) the statistic of each arrangement, the observed one first; empty without a test.
        unknown_p: reason why p is not known; None if it is known, or without a test.

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
        """Name of the statistic and the compared groups."""
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
            name: name of the statistic.
            arrangements: (P,) statistic of each arrangement, the observed one first.
            tested: compared groups or variables.
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
        name: name of the test in the table of tests.
        cohort: cohort of the shapes that were used.
        statistics: statistics, the most important ones first.
        tables: further tables of the report; each is also written as CSV, under its title.
        figures: further parts of the report, after the tables.
        arrays: file name (.npz) -> arrays by name, which figures refer to.
        settings: settings that determine the result, the seed among them.
        classes: columns whose classes are counted in the sample sizes.
        reduced_model: terms of the model whose residuals are permuted; None if shapes or labels themselves are
            permuted.
        assumptions: sentences on assumptions of the test, for the methods.
        level: level of significance.
        subject: column of the independent units; None if all shapes are independent.

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
        """Return a statistic by its name and the compared groups.

        Raises:
            KeyError: there is no such statistic.
        """
        for statistic in self.statistics:
            if statistic.name == name and (not tested or statistic.tested == tested):
                return statistic
        raise KeyError(f"{name} {tested}".strip())

    def table(self, title: str) -> TablePart:
        """Return a table by its title.

        Raises:
            KeyError: there is no such table.
        """
        for table in self.tables:
            if table.title == title:
                return table
        raise KeyError(title)

    @property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        tested = tuple(
            dict.fromkeys(
                statistic.name for statistic in self.statistics if statistic.p is not None or statistic.unknown_p
            )
        )
        counts = [len(statistic.arrangements) for statistic in self.statistics if len(statistic.arrangements)]
        scheme = TestScheme(
            tested=tested, statistic=self.test.statistics, resampling=self.test.resampling, unit=self.test.permuted,
            reduced_model=self.reduced_model, arrangements=max(counts, default=0),
        )  # fmt: skip
        subjects = self.cohort.table.texts(self.subject) if self.subject else self.cohort.names
        sizes = sample_sizes(subjects, [(column, self.cohort.table.texts(column)) for column in self.classes])
        return methods_of(
            self.cohort, len(set(subjects)), level=self.level, sizes=sizes,
            tests=(scheme,) if tested else (), assumptions=self.assumptions,
            effect_size="box-cox" if any(statistic.z is not None for statistic in self.statistics) else "",
        )  # fmt: skip

    def __repr__(self) -> str:
        rows = [f"{statistic.label} {statistic.value:.4g}" + (f", p {statistic.p:.3g}" if statistic.p is not None else
                ", p not known" if statistic.unknown_p else "") for statistic in self.statistics]  # fmt: skip
        return f"<ShapeTestResult {self.name} of {len(self.cohort)} shapes; {list_briefly(rows)}>"


def pair_statistics(
    name: str, values: FloatArray, pairs: Sequence[str], tail: Literal["upper", "lower"] = "upper"
) -> list[Statistic]:
    """Return the statistics of pairs from their arrangements (pairs, P)."""
    return [Statistic.of(name, own, pair, tail=tail) for own, pair in zip(values, pairs, strict=True)]
