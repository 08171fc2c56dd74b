"""Report of a regression on shape, and of predictions: sentences, tables and pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort, subjects_of
from shapespace.report.analyses.analysis_report import AnalysisReport, Column, Table
from shapespace.report.analyses.shape_data import cohort_report
from shapespace.report.analyses.shape_prediction_report import SHAPES_FILE, shape_prediction_parts
from shapespace.schemas import CurvePart, Part, Series, TablePart, TextPart
from shapespace.statistics.methods import methods_of
from shapespace.statistics.predictor import Predictions, Predictor
from shapespace.statistics.regression import (
    SMALL,
    AccuracyMeasure,
    RegressionResult,
    compare_with,
    permutation_scheme,
    share_of,
)

_CITATIONS = (
    "Barber R. F., Candès E. J., Ramdas A., Tibshirani R. J. (2021) Predictive inference with the jackknife+. Annals "
    "of Statistics 49, 486-507.",
)
_MOST_ROWS = 20  # rows that fit one screen; files have all
_MEASURE_NAMES = {
    "r2": "R²", "rmse": "RMSE", "mae": "mean absolute error", "slope": "calibration slope",
    "intercept": "calibration intercept", "coverage": "coverage of intervals", "width": "width of intervals",
}  # fmt: skip


def regression_report(result: RegressionResult, new: tuple[Cohort, Predictions] | None = None) -> AnalysisReport:
    """Return the answer to what number goes with a shape, with what is predicted of new shapes."""
    pictures, arrays, meshes = shape_prediction_parts(result.shapes)
    return cohort_report(
        "regress",
        f"{result.target} from shape",
        [
            _measures_part(result), _calibration_part(result), *_new_tables(result.predictor, new), *pictures,
            *_file_tables(result),
        ],
        result.cohort,
        summary=_summary(result, new),
        arrays={SHAPES_FILE: arrays},
        meshes=meshes,
        notes=(*result.cohort.notes, *(() if new is None else new[0].notes)),
        settings={
            "target": result.target, "gauge": result.cohort.gauge, "shapes": len(result.cohort),
            "subjects": result.n_subjects, "folds": result.folds, "permutations": result.permutations,
            "level": result.confidence, "choice": result.choice.words(), "seed": result.seed,
        },
        methods=result.methods,
        citations=_CITATIONS,
        imputations=result.imputations,
    )  # fmt: skip


def prediction_report(predictor: Predictor, cohort: Cohort, predictions: Predictions) -> AnalysisReport:
    """Return the answer of a predictor that was learned earlier."""
    assumption = (
        f"{predictor.target} is predicted by {predictor.method}, learned from {predictor.subjects} other "
        f"subjects, with prediction intervals of {100 * predictor.confidence:.0f} % by cross-validation (CV+)."
    )
    return cohort_report(
        "regress",
        f"{predictor.target} from shape",
        _new_tables(predictor, (cohort, predictions)),
        cohort,
        summary=(
            f"{predictor.target} of {len(predictions.names)} shapes, by {predictor.method} of {predictor.subjects} "
            "subjects.",
            _outside_sentence(predictor, predictions),
        ),
        settings={"target": predictor.target, "gauge": predictor.gauge, "level": predictor.confidence},
        methods=methods_of(cohort, len(cohort), assumptions=(assumption,)),
        state_methods=False,
        model_hashes=(predictor.model_hash,) if predictor.model_hash else (),
        citations=_CITATIONS,
        imputations=predictions.imputations,
    )


def _summary(result: RegressionResult, new: tuple[Cohort, Predictions] | None) -> tuple[str, ...]:
    m, level = result.measures, f"{100 * result.confidence:.0f} %"
    sentences = [
        f"Shape predicts {result.target} of subjects left out with an RMSE of {m['rmse'].value:.3g} "
        f"({level} interval {_interval_text(m['rmse'])}), beside {result.baseline_rmse:.3g} by the mean alone: "
        f"R² = {m['r2'].value:.2f} ({_interval_text(m['r2'])})"
        + ("." if result.p is None else f", p = {result.p:.2g}."),
        f"{level} intervals are {m['width'].value:.3g} wide on average, and hold {100 * m['coverage'].value:.0f} % of "
        f"the subjects left out; the observed rises by {m['slope'].value:.2f} ({_interval_text(m['slope'])}) for "
        "one predicted.",
        f"The predictor uses {result.choice.words()}, {result.effective:.1f} degrees of freedom for "
        f"{result.n_subjects} "
        "subjects.",
    ]
    if len(result.cohort) > result.n_subjects:
        sentences.append(
            f"{len(result.cohort)} scans of {result.n_subjects} subjects: in means, fit, figures and intervals each "
            "scan "
            "has the weight 1 / number of scans of its subject."
        )
    if result.p is not None:
        sentences.append(permutation_scheme(result.subjects, result.observed))
    if result.small:
        sentences.insert(1, f"{result.n_subjects} subjects are a small sample (fewer than {SMALL}): another would "
                            "give other figures, within the intervals stated.")  # fmt: skip
    if new is not None:
        cohort, predictions = new
        sentences.append(
            f"{len(predictions.names)} new shapes are predicted. {_outside_sentence(result.predictor, predictions)}"
        )
        observed = _observed_target(cohort, result.target)
        if observed is not None and len(observed) > 1:
            column = result.subject if result.subject in cohort.table.columns else None
            r2, rmse, coverage = compare_with(predictions, observed, share_of(subjects_of(cohort, column)))
            sentences.append(
                f"Their {result.target} is known: RMSE {rmse:.3g}, R² {r2:.2f}, and {100 * coverage:.0f} % lie in the "
                f"{level} intervals."
            )
    return tuple(sentences)


def _outside_sentence(predictor: Predictor, predictions: Predictions) -> str:
    outside = [name for name, reason in zip(predictions.names, predictions.outside, strict=True) if reason]
    if not outside:
        return "All lie within what was learned from."
    return f"{len(outside)} of {len(predictions.names)} lie outside what was learned from ({outside[0]}: " + (
        f"{next(reason for reason in predictions.outside if reason)}), and what is predicted of them is a guess."
    )


def _interval_text(measure: AccuracyMeasure) -> str:
    return f"{measure.low:.3g} to {measure.high:.3g}"


def _observed_target(cohort: Cohort, target: str) -> Any:
    """Return the target of new shapes where all of them have it, else None."""
    if target not in cohort.table.columns:
        return None
    values = cohort.table.numbers(target)
    return None if np.isnan(values).any() else values


def _measures_part(result: RegressionResult) -> TablePart:
    level = f"{100 * result.confidence:.0f} %"
    rows: list[tuple[object, ...]] = []
    for name, measure in result.measures.items():
        rows.append((_MEASURE_NAMES[name], measure.value, measure.low, measure.high))
        if name in ("rmse", "mae"):
            rows.append((f"{_MEASURE_NAMES[name]} of the mean alone", getattr(result, f"baseline_{name}"), None, None))
    if result.p is not None:
        rows.append(("p of R², by permutation", result.p, None, None))
    return TablePart.of(
        "On subjects left out", ("measure", "value", "low", "high"), rows,
        note=f"Nested cross-validation in {result.folds} folds of subjects, each of whom counts once; {level} "
        "intervals by bootstrap of subjects.",
    )  # fmt: skip


def _calibration_part(result: RegressionResult) -> CurvePart:
    order = np.argsort(result.predicted, kind="stable")
    x = result.predicted[order]
    slope, intercept = result.measures["slope"].value, result.measures["intercept"].value
    ends = np.array([x[0], x[-1]])
    rows = Series(x=tuple(x.tolist()), y=tuple(result.observed[order].tolist()), label="subjects left out", points=True)
    line = Series(x=tuple(ends.tolist()), y=tuple((intercept + slope * ends).tolist()), label="observed on predicted")
    return CurvePart(
        title="Calibration", series=(rows, line) if np.isfinite(slope) else (rows,), x=f"{result.target} predicted",
        y=f"{result.target} observed", diagonal=True,
    )  # fmt: skip


def _file_tables(result: RegressionResult) -> tuple[Table, Table]:
    """Return the tables of predictions and of measures, which are files alone."""
    columns = (result.observed, result.predicted, result.low, result.high, result.baseline)
    fields = ("scan", "subject", "observed", "predicted", "low", "high", "baseline")
    every = zip(result.cohort.names, result.subjects, *columns, strict=True)
    measures = [(name, m.value, m.low, m.high) for name, m in result.measures.items()]
    return (
        Table.of_fields("predictions.csv", fields, list(every)),
        Table.of_fields("measures.csv", ("measure", "value", "low", "high"), measures),
    )


def _new_tables(predictor: Predictor, new: tuple[Cohort, Predictions] | None) -> tuple[Part | Table, ...]:
    """Return the predictions of new shapes."""
    if new is None:
        return ()
    predictions = new[1]
    table = Table(
        title=f"{predictor.target} of new shapes" if predictions.names else "",
        columns=(
            Column("scan", field="scan"),
            *(Column(name, "number", name) for name in ("predicted", "low", "high")),
            Column("outside", field="outside"),
        ),
        rows=list(
            zip(new[0].names, predictions.value, predictions.low, predictions.high, predictions.outside, strict=True)
        ),
        note=f"With {100 * predictor.confidence:.0f} % intervals; all of them stand in new.csv.",
        file="new.csv",
        shown=range(_MOST_ROWS),
    )
    return (table,) if predictions.names else (TextPart(title="New shapes", text="There are none."), table)
