"""What is told of a regression on shape: the sentences, tables and pictures of its report."""

from __future__ import annotations

from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort, subjects_of
from shapespace.report.analyses.analysis_report import AnalysisReport, LengthFormat, Rows
from shapespace.report.analyses.methods import methods_parts
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes
from shapespace.schemas import CurvePart, MorphPart, Part, Series, SurfaceMapPart, TableColumn, TablePart, TextPart
from shapespace.statistics.observation_weights import blank_where, weights_of
from shapespace.statistics.predictor import Predictions, Predictor
from shapespace.statistics.regression import (
    SMALL,
    AccuracyMeasure,
    RegressionResult,
    compare_with,
    permutation_scheme,
    share_of,
)
from shapespace.types import Mesh

_FILE = "regression.npz"
_LISTED = 20
_CALLED = {
    "r2": "R²", "rmse": "RMSE", "mae": "mean absolute error", "slope": "calibration slope",
    "intercept": "calibration intercept", "coverage": "coverage of intervals", "width": "width of intervals",
}  # fmt: skip


def regression_report(found: RegressionResult, new: tuple[Cohort, Predictions] | None = None) -> AnalysisReport:
    """Return the answer to what number goes with a shape, with what is predicted of new shapes."""
    parts: list[Part] = [_measures(found), _calibration(found)]
    if new is not None:
        parts.append(_new_part(found.predictor, new[1]))
    arrays, pictures = _pictures(found)
    tables = {"predictions.csv": _rows(found), "measures.csv": _measure_rows(found)}
    if new is not None:
        tables["new.csv"] = _new_rows(*new)
    faces = found.cohort.faces
    meshes = {
        f"{name}.ply": Mesh(found.shape_at(at), faces, name=f"{found.target} {at:g}")
        for name, at in (("low", found.low_at), ("high", found.high_at))
    }
    report = AnalysisReport(
        question="regress",
        title=f"{found.target} from shape",
        summary=_summary(found, new),
        parts=(*parts, *pictures, *methods_parts(found.methods)),
        tables=tables,
        arrays={_FILE: arrays},
        meshes=meshes,
        notes=(*found.cohort.notes, *(() if new is None else new[0].notes)),
        settings={
            "target": found.target, "gauge": found.cohort.gauge, "shapes": len(found.cohort),
            "subjects": found.n_subjects, "folds": found.folds, "permutations": found.permutations,
            "level": found.confidence, "choice": found.choice.words(), "seed": found.seed,
        },
        model_hashes=model_hashes(found.cohort),
        methods=found.methods,
    )  # fmt: skip
    return add_shape_data(report, found.cohort)


def prediction_report(learned: Predictor, cohort: Cohort, told: Predictions) -> AnalysisReport:
    """Return the answer of a predictor that was learned earlier."""
    report = AnalysisReport(
        question="regress",
        title=f"{learned.target} from shape",
        summary=(
            f"{learned.target} of {len(told.names)} shapes, by {learned.method} of {learned.subjects} subjects.",
            _outside(learned, told),
        ),
        parts=(_new_part(learned, told),),
        tables={"new.csv": _new_rows(cohort, told)},
        notes=cohort.notes,
        settings={"target": learned.target, "gauge": learned.gauge, "level": learned.confidence},
        model_hashes=(learned.model_hash,) if learned.model_hash else (),
    )
    return add_shape_data(report, cohort)


def _summary(found: RegressionResult, new: tuple[Cohort, Predictions] | None) -> tuple[str, ...]:
    m, level = found.measures, f"{100 * found.confidence:.0f} %"
    sentences = [
        f"Shape predicts {found.target} of subjects left out with an RMSE of {m['rmse'].value:.3g} "
        f"({level} interval {_span(m['rmse'])}), beside {found.baseline_rmse:.3g} by the mean alone: "
        f"R² = {m['r2'].value:.2f} ({_span(m['r2'])})" + ("." if found.p is None else f", p = {found.p:.2g}."),
        f"{level} intervals are {m['width'].value:.3g} wide on average, and hold {100 * m['coverage'].value:.0f} % of "
        f"the subjects left out; the observed rises by {m['slope'].value:.2f} ({_span(m['slope'])}) for one predicted.",
        f"The predictor uses {found.choice.words()}, {found.effective:.1f} degrees of freedom for {found.n_subjects} "
        "subjects.",
    ]
    if len(found.cohort) > found.n_subjects:
        sentences.append(
            f"{len(found.cohort)} scans of {found.n_subjects} subjects: in means, fit, figures and intervals each scan "
            "has the weight 1 / number of scans of its subject."
        )
    if found.p is not None:
        sentences.append(permutation_scheme(found.subjects, found.observed))
    if found.small:
        sentences.insert(1, f"{found.n_subjects} subjects are a small sample (fewer than {SMALL}): another would "
                            "give other figures, within the intervals stated.")  # fmt: skip
    if new is not None:
        cohort, told = new
        sentences.append(f"{len(told.names)} new shapes are predicted. {_outside(found.predictor, told)}")
        known = _observed(cohort, found.target)
        if known is not None and len(known) > 1:
            column = found.subject if found.subject in cohort.table.columns else None
            r2, rmse, coverage = compare_with(told, known, share_of(subjects_of(cohort, column)))
            sentences.append(
                f"Their {found.target} is known: RMSE {rmse:.3g}, R² {r2:.2f}, and {100 * coverage:.0f} % lie in the "
                f"{level} intervals."
            )
    return tuple(sentences)


def _outside(learned: Predictor, told: Predictions) -> str:
    outside = [name for name, why in zip(told.names, told.outside, strict=True) if why]
    if not outside:
        return "All lie within what was learned from."
    return f"{len(outside)} of {len(told.names)} lie outside what was learned from ({outside[0]}: " + (
        f"{next(why for why in told.outside if why)}), and what is predicted of them is a guess."
    )


def _span(measure: AccuracyMeasure) -> str:
    return f"{measure.low:.3g} to {measure.high:.3g}"


def _observed(cohort: Cohort, target: str) -> Any:
    """Return the target of new shapes where all of them have it, else None."""
    if target not in cohort.table.columns:
        return None
    values = cohort.table.numbers(target)
    return None if np.isnan(values).any() else values


def _measures(found: RegressionResult) -> TablePart:
    level = f"{100 * found.confidence:.0f} %"
    numbers = (TableColumn(name=name, kind="number") for name in ("value", "low", "high"))
    columns = (TableColumn(name="measure"), *numbers)
    rows: list[tuple[object, ...]] = []
    for name, measure in found.measures.items():
        rows.append((_CALLED[name], *(_known(v) for v in (measure.value, measure.low, measure.high))))
        if name in ("rmse", "mae"):
            rows.append((f"{_CALLED[name]} of the mean alone", getattr(found, f"baseline_{name}"), None, None))
    if found.p is not None:
        rows.append(("p of R², by permutation", found.p, None, None))
    return TablePart(
        title="On subjects left out", columns=columns, rows=tuple(rows),
        note=f"Nested cross-validation in {found.folds} folds of subjects, each of whom counts once; {level} "
        "intervals by bootstrap of subjects.",
    )  # fmt: skip


def _measure_rows(found: RegressionResult) -> Rows:
    return ("measure", "value", "low", "high"), [(n, m.value, m.low, m.high) for n, m in found.measures.items()]


def _calibration(found: RegressionResult) -> CurvePart:
    order = np.argsort(found.predicted, kind="stable")
    x = found.predicted[order]
    slope, intercept = found.measures["slope"].value, found.measures["intercept"].value
    ends = np.array([x[0], x[-1]])
    rows = Series(x=tuple(x.tolist()), y=tuple(found.observed[order].tolist()), label="subjects left out", points=True)
    line = Series(x=tuple(ends.tolist()), y=tuple((intercept + slope * ends).tolist()), label="observed on predicted")
    return CurvePart(
        title="Calibration", series=(rows, line) if np.isfinite(slope) else (rows,), x=f"{found.target} predicted",
        y=f"{found.target} observed", diagonal=True,
    )  # fmt: skip


def _pictures(found: RegressionResult) -> tuple[dict[str, Any], list[Part]]:
    low, high = found.shape_at(found.low_at), found.shape_at(found.high_at)
    blank = weights_of(found.cohort.observed_share) == 0
    arrays: dict[str, Any] = {"low": low, "high": high, "vertices": (low + high) / 2.0}
    arrays["per_unit_mm"] = blank_where(found.map, blank)
    if found.cohort.faces is None:
        return arrays, []
    arrays["faces"] = found.cohort.faces
    return arrays, [
        MorphPart(
            title=f"The shape that goes with {found.target}", arrays=_FILE,
            low_label=f"{found.target} {found.low_at:.3g}", high_label=f"{found.target} {found.high_at:.3g}",
            note="The mean shape at the 5th and the 95th percentile, by regression of shape on the number.",
        ),
        SurfaceMapPart(
            title=f"Change of shape for one unit of {found.target}", arrays=_FILE, values="per_unit_mm",
            unit=LengthFormat(found.cohort.unit).of_map,
            note="Along the normals of the mean; shapespace compare tests where this is more than chance.",
        ),
    ]  # fmt: skip


def _rows(found: RegressionResult) -> Rows:
    header = ("scan", "subject", "observed", "predicted", "low", "high", "baseline")
    columns = (found.observed, found.predicted, found.low, found.high, found.baseline)
    return header, [
        (name, found.subjects[k], *(float(column[k]) for column in columns))
        for k, name in enumerate(found.cohort.names)
    ]


def _new_rows(cohort: Cohort, told: Predictions) -> Rows:
    return ("scan", "predicted", "low", "high", "outside"), [
        (name, float(told.value[k]), float(told.low[k]), float(told.high[k]), told.outside[k])
        for k, name in enumerate(cohort.names)
    ]


def _new_part(learned: Predictor, told: Predictions) -> Part:
    level = f"{100 * learned.confidence:.0f} %"
    columns = (
        TableColumn(name="scan"), TableColumn(name="predicted", kind="number"), TableColumn(name="low", kind="number"),
        TableColumn(name="high", kind="number"), TableColumn(name="outside"),
    )  # fmt: skip
    rows = tuple(
        (told.names[k], float(told.value[k]), float(told.low[k]), float(told.high[k]), told.outside[k])
        for k in range(min(_LISTED, len(told.names)))
    )
    if not rows:
        return TextPart(title="New shapes", text="There are none.")
    return TablePart(
        title=f"{learned.target} of new shapes", columns=columns, rows=rows,
        note=f"With {level} intervals; all of them stand in new.csv.",
    )  # fmt: skip


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
