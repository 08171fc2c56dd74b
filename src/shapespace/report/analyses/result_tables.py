"""Report and files of the result of any analysis."""

from __future__ import annotations

from pathlib import Path

from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.analyses.asymmetry_report import asymmetry_report
from shapespace.report.analyses.change_report import change_report
from shapespace.report.analyses.compare_report import compare_report
from shapespace.report.analyses.identity import identify_report
from shapespace.report.analyses.regression_report import regression_report
from shapespace.report.analyses.score_report import score_report
from shapespace.report.analyses.shape_prediction_report import shape_prediction_report
from shapespace.report.analyses.shape_test_report import shape_test_report
from shapespace.report.analyses.verify_report import verify_report
from shapespace.statistics.asymmetry import AsymmetryResult
from shapespace.statistics.change_result import ChangeResult
from shapespace.statistics.compare_shapes import CompareResult
from shapespace.statistics.identity.identify import IdentificationResult
from shapespace.statistics.identity.verify import VerificationResult
from shapespace.statistics.methods import AnalysisResult
from shapespace.statistics.regression import RegressionResult
from shapespace.statistics.score_subjects import ScoreResult
from shapespace.statistics.shape_prediction import ShapePrediction
from shapespace.statistics.shape_tests.shape_test_result import ShapeTestResult


def analysis_report(result: AnalysisResult) -> AnalysisReport:
    """Return the report of the result of an analysis.

    Raises:
        TypeError: a result without a report.
    """
    match result:
        case AsymmetryResult():
            return asymmetry_report(result)
        case ChangeResult():
            return change_report(result)
        case CompareResult():
            return compare_report(result)
        case IdentificationResult():
            return identify_report(result)
        case RegressionResult():
            return regression_report(result)
        case ScoreResult():
            return score_report(result)
        case ShapePrediction():
            return shape_prediction_report(result)
        case ShapeTestResult():
            return shape_test_report(result)
        case VerificationResult():
            return verify_report(result)
        case _:
            raise TypeError(f"{type(result).__name__} is not the result of an analysis with a report.")


def save_analysis(result: AnalysisResult, folder: Path | str) -> Path:
    """Write the report, tables, arrays and meshes of a result to a folder, and return the path of analysis.json.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    return analysis_report(result).save(folder)
