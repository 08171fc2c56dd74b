"""Report of any test of shape, and report and files of the result of any analysis."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import singledispatch
from pathlib import Path

import numpy as np

from shapespace.report.analyses.analysis_report import (
    AnalysisReport,
    Column,
    ResultTable,
    cohort_report,
    histogram_part,
)
from shapespace.report.analyses.asymmetry_report import asymmetry_report
from shapespace.report.analyses.change_report import change_report
from shapespace.report.analyses.compare_report import compare_report
from shapespace.report.analyses.identity_report import identify_report, verify_report
from shapespace.report.analyses.methods_section import points_word
from shapespace.report.analyses.regression_report import regression_report, shape_prediction_report
from shapespace.report.analyses.score_report import score_report
from shapespace.schemas import HistogramPart
from shapespace.statistics.effect_size import permutation_p
from shapespace.statistics.methods import AnalysisResult
from shapespace.statistics.shape_tests.shape_test_result import ShapeTestResult, Statistic
from shapespace.statistics.tolerances import TIE
from shapespace.types import FloatArray

_BINS = 40  # bins of a histogram of thousands of permutations
_MOST_SENTENCES = 10
"""Statistics with a sentence; the table has all."""
_MOST_HISTOGRAMS = 3
"""Histograms of the first statistics; more of them fill the page."""

_HAS_UNIT = re.compile("Procrustes|^distance|length|difference of disparity")
"""Names of statistics that have the unit of the cohort, or its square."""


def shape_test_report(result: ShapeTestResult) -> AnalysisReport:
    """Return the report of a test of shape."""
    summary = result.test.summary
    files = [
        ResultTable.of_fields(
            f"{re.sub(r'[^a-z0-9]+', '_', (table.title or 'table').lower()).strip('_')}.csv",
            [own.name for own in table.columns],
            table.rows,
        )
        for table in result.tables
    ]
    return cohort_report(
        f"test {result.test.name}",
        f"{summary[:1].upper()}{summary[1:]}",
        [_statistics_table(result), *result.tables, *result.figures, *_histograms(result), *files],
        result.cohort,
        summary=tuple(_sentences(result)),
        arrays=result.arrays,
        settings={**result.settings, "shapes": len(result.cohort)},
        methods=result.methods,
        citations=result.test.references,
    )


def _sentences(result: ShapeTestResult) -> Iterator[str]:
    for statistic in result.statistics[:_MOST_SENTENCES]:
        yield f"{_sentence(statistic, result.level)}."
    if len(result.statistics) > _MOST_SENTENCES:
        yield f"{len(result.statistics) - _MOST_SENTENCES} further statistics are in the table."
    unit = result.cohort.unit
    if unit and any(_HAS_UNIT.search(statistic.name) for statistic in result.statistics):
        points = points_word(result.methods)
        yield f"Distances and lengths are in {unit}, variances in {unit}², summed over all {points} of a shape."
    counts = [len(statistic.arrangements) for statistic in result.statistics if len(statistic.arrangements)]
    if counts:
        yield f"{len(result.cohort)} shapes, {max(counts)} permutations, the observed data among them."


def _sentence(statistic: Statistic, level: float) -> str:
    figures = [f"{statistic.name} {statistic.value:.4g}"]
    if statistic.low is not None and statistic.high is not None:
        figures.append(f"interval {statistic.low:.4g} to {statistic.high:.4g}")
    if statistic.z is not None:
        figures.append(f"Z {statistic.z:.2f}")
    if statistic.p is not None:
        figures.append(f"p {statistic.p:.3g}")
        figures.append("significant" if statistic.p <= level else "not significant")
        if len(statistic.arrangements) and (least := _least_p(statistic.arrangements)) > level:
            figures.append(f"no p below {least:.2g} is possible with so few arrangements that differ")
    if statistic.unknown_p == "short vectors":
        figures.append("p not known: neither vector is longer than its noise, so that no direction is determined")
    if statistic.unknown_p == "raw residuals":
        figures.append(
            f"p not known: {permutation_p(statistic.arrangements):.3g} by raw residuals, as in RRPP, is too small if "
            "the common change is short; omit --residuals raw"
        )
    text = ", ".join(figures)
    return f"{statistic.tested}: {text}" if statistic.tested else f"{text[:1].upper()}{text[1:]}"


def _least_p(arrangements: FloatArray) -> float:
    """Return the share of the arrangements that have the most extreme value of all, at the end where it is smaller."""
    ends = arrangements.min(), arrangements.max()
    return min(float((np.abs(arrangements - end) <= TIE * abs(end)).mean()) for end in ends)


def _statistics_table(result: ShapeTestResult) -> ResultTable:
    note = f"{result.test.statistics[:1].upper()}{result.test.statistics[1:]}."
    unknown = dict.fromkeys(statistic.name for statistic in result.statistics if statistic.unknown_p)
    note += f" p of {', '.join(unknown)} is not known where it is blank." if unknown else ""
    return ResultTable(
        title="Statistics",
        columns=(
            Column("statistic", field="statistic"), Column("tested", field="tested"),
            Column("value", "number", "value"), Column("Z", "number", "z"), Column("p", "p", "p"),
            *(Column(field=name) for name in ("low", "high", "p_not_known")),
        ),
        rows=[
            (s.name, s.tested, s.value, s.z, s.p, s.low, s.high, s.unknown_p or "") for s in result.statistics
        ],
        note=note,
        level=2,
        file="statistics.csv",
    )  # fmt: skip


def _histograms(result: ShapeTestResult) -> Iterator[HistogramPart]:
    for statistic in [each for each in result.statistics if len(each.arrangements) > 1][:_MOST_HISTOGRAMS]:
        yield histogram_part(
            f"{statistic.label} among its permutations",
            {"permutations": statistic.arrangements[np.isfinite(statistic.arrangements)]},
            _BINS, x=statistic.name, observed=statistic.value, observed_label="observed",
        )  # fmt: skip


@singledispatch
def analysis_report(result: AnalysisResult) -> AnalysisReport:
    """Return the report of the result of an analysis.

    Raises:
        TypeError: a result without a report.
    """
    raise TypeError(f"{type(result).__name__} is not the result of an analysis with a report.")


for _report in (
    asymmetry_report, change_report, compare_report, identify_report, regression_report, score_report,
    shape_prediction_report, shape_test_report, verify_report,
):  # fmt: skip
    analysis_report.register(_report)  # by the type of its first argument


def save_analysis(result: AnalysisResult, folder: Path | str) -> Path:
    """Write the report, tables, arrays and meshes of a result to a folder, and return the path of analysis.json.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    return analysis_report(result).save(folder)
