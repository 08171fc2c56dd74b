"""Report and files of the result of any analysis."""

from __future__ import annotations

from functools import singledispatch
from pathlib import Path

from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.analyses.asymmetry_report import asymmetry_report
from shapespace.report.analyses.change_report import change_report
from shapespace.report.analyses.compare_report import compare_report
from shapespace.report.analyses.identity_report import identify_report, verify_report
from shapespace.report.analyses.regression_report import regression_report
from shapespace.report.analyses.score_report import score_report
from shapespace.report.analyses.shape_prediction_report import shape_prediction_report
from shapespace.report.analyses.shape_test_report import shape_test_report
from shapespace.statistics.methods import AnalysisResult


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
