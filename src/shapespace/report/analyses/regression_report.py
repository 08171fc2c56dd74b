"""Reports of a regression on shape, of predictions, and of mean shapes along a number: sentences, tables, pictures."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort, subjects_of
from shapespace.report.analyses.analysis_report import (
    AnalysisReport,
    Column,
    LengthFormat,
    ResultTable,
    cohort_report,
    floats,
    shape_change_parts,
)
from shapespace.schemas import CurvePart, MorphPart, Part, Series, SurfaceMapPart, TablePart, TextPart
from shapespace.statistics.methods import methods_of
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
from shapespace.statistics.shape_prediction import ShapePrediction
from shapespace.types import FloatArray, Mesh

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
    """Return the report of a regression on shape, with predictions of new shapes."""
    pictures, arrays, meshes = shape_prediction_parts(result.shapes)
    return cohort_report(
        "regress",
        f"{result.target} from shape",
        [
            _measures_part(result), _calibration_part(result), *_new_tables(result.predictor, new), *pictures,
            *_file_tables(result),
        ],
        result.cohort,
        summary=tuple(_summary(result, new)),
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
    """Return the report of predictions by a saved predictor."""
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


def _summary(result: RegressionResult, new: tuple[Cohort, Predictions] | None) -> Iterator[str]:
    m, level = result.measures, f"{100 * result.confidence:.0f} %"
    yield (
        f"Shape predicts {result.target} of held-out subjects with an RMSE of {m['rmse'].value:.3g} "
        f"({level} interval {_interval_text(m['rmse'])}), compared with {result.baseline_rmse:.3g} by the mean alone: "
        f"R² = {m['r2'].value:.2f} ({_interval_text(m['r2'])})"
        + ("." if result.p is None else f", p = {result.p:.2g}.")
    )
    if result.small:
        yield (
            f"{result.n_subjects} subjects are a small sample (fewer than {SMALL}): another would give other figures, "
            "within the intervals stated."
        )
    yield (
        f"{level} intervals are {m['width'].value:.3g} wide on average, and contain {100 * m['coverage'].value:.0f} % "
        f"of the held-out subjects; the observed value rises by {m['slope'].value:.2f} "
        f"({_interval_text(m['slope'])}) per unit of the predicted value."
    )
    yield (
        f"The predictor uses {result.choice.words()}, {result.effective:.1f} degrees of freedom for "
        f"{result.n_subjects} subjects."
    )
    if len(result.cohort) > result.n_subjects:
        yield (
            f"{len(result.cohort)} scans of {result.n_subjects} subjects: in means, fit, figures and intervals each "
            "scan has the weight 1 / number of scans of its subject."
        )
    if result.p is not None:
        yield permutation_scheme(result.subjects, result.observed)
    if new is not None:
        cohort, predictions = new
        yield f"{len(predictions.names)} new shapes are predicted. {_outside_sentence(result.predictor, predictions)}"
        observed = _observed_target(cohort, result.target)
        if observed is not None and len(observed) > 1:
            column = result.subject if result.subject in cohort.table.columns else None
            r2, rmse, coverage = compare_with(predictions, observed, share_of(subjects_of(cohort, column)))
            yield (
                f"Their {result.target} is known: RMSE {rmse:.3g}, R² {r2:.2f}, and {100 * coverage:.0f} % lie in the "
                f"{level} intervals."
            )


def _outside_sentence(predictor: Predictor, predictions: Predictions) -> str:
    outside = [name for name, reason in zip(predictions.names, predictions.outside, strict=True) if reason]
    if not outside:
        return "All lie within the training data."
    return f"{len(outside)} of {len(predictions.names)} lie outside the training data ({outside[0]}: " + (
        f"{next(reason for reason in predictions.outside if reason)}), and their predictions are guesses."
    )


def _interval_text(measure: AccuracyMeasure) -> str:
    return f"{measure.low:.3g} to {measure.high:.3g}"


def _observed_target(cohort: Cohort, target: str) -> Any:
    """Return the target of new shapes if all of them have it, else None."""
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
        "On held-out subjects", ("measure", "value", "low", "high"), rows,
        note=f"Nested cross-validation in {result.folds} folds of subjects, each of whom counts once; {level} "
        "intervals by bootstrap of subjects.",
    )  # fmt: skip


def _calibration_part(result: RegressionResult) -> CurvePart:
    order = np.argsort(result.predicted, kind="stable")
    x = result.predicted[order]
    slope, intercept = result.measures["slope"].value, result.measures["intercept"].value
    ends = np.array([x[0], x[-1]])
    rows = Series(x=tuple(x.tolist()), y=tuple(result.observed[order].tolist()), label="held-out subjects", points=True)
    line = Series(x=tuple(ends.tolist()), y=tuple((intercept + slope * ends).tolist()), label="observed on predicted")
    return CurvePart(
        title="Calibration", series=(rows, line) if np.isfinite(slope) else (rows,), x=f"{result.target} predicted",
        y=f"{result.target} observed", diagonal=True,
    )  # fmt: skip


def _file_tables(result: RegressionResult) -> tuple[ResultTable, ResultTable]:
    """Return the tables of predictions and of measures, which are files alone."""
    columns = (result.observed, result.predicted, result.low, result.high, result.baseline)
    fields = ("scan", "subject", "observed", "predicted", "low", "high", "baseline")
    every = zip(result.cohort.names, result.subjects, *columns, strict=True)
    measures = [(name, m.value, m.low, m.high) for name, m in result.measures.items()]
    return (
        ResultTable.of_fields("predictions.csv", fields, list(every)),
        ResultTable.of_fields("measures.csv", ("measure", "value", "low", "high"), measures),
    )


def _new_tables(predictor: Predictor, new: tuple[Cohort, Predictions] | None) -> tuple[Part | ResultTable, ...]:
    """Return the predictions of new shapes."""
    if new is None:
        return ()
    predictions = new[1]
    table = ResultTable(
        title=f"{predictor.target} of new shapes" if predictions.names else "",
        columns=(
            Column("scan", field="scan"),
            *(Column(name, "number", name) for name in ("predicted", "low", "high")),
            Column("outside", field="outside"),
        ),
        rows=list(
            zip(new[0].names, predictions.value, predictions.low, predictions.high, predictions.outside, strict=True)
        ),
        note=f"With {100 * predictor.confidence:.0f} % intervals; all predictions are in new.csv.",
        file="new.csv",
        shown=range(_MOST_ROWS),
    )
    return (table,) if predictions.names else (TextPart(title="New shapes", text="There are none."), table)


SHAPES_FILE = "shapes.npz"
"""Mean shapes, half widths of their intervals, and maps."""
_SHAPE_CITATIONS = (
    "Bell R. M., McCaffrey D. F. (2002) Bias reduction in standard errors for linear regression with multi-stage "
    "samples. Survey Methodology 28, 169-181.",
    "Imbens G. W., Kolesár M. (2016) Robust standard errors in small samples: some practical advice. Review of "
    "Economics and Statistics 98, 701-712.",
)


def shape_prediction_report(result: ShapePrediction) -> AnalysisReport:
    """Return the report of mean shapes along a number."""
    parts, arrays, meshes = shape_prediction_parts(result)
    return cohort_report(
        "regress",
        f"Shape along {result.along}",
        [_value_table(result), *_measure_parts(result), *parts, *_landmark_tables(result)],
        result.cohort,
        summary=tuple(_shape_summary(result)),
        arrays={SHAPES_FILE: arrays},
        meshes=meshes,
        settings={
            "along": result.along, "formula": result.formula, "held": dict(result.held) or None,
            "gauge": result.cohort.gauge, "shapes": len(result.cohort), "subjects": result.n_subjects,
            "permutations": result.permutations, "level": result.confidence, "seed": result.seed,
            "subject": result.subject,
        },
        methods=result.methods,
        citations=_SHAPE_CITATIONS,
    )  # fmt: skip


def shape_prediction_parts(result: ShapePrediction) -> tuple[list[Part], dict[str, Any], dict[str, Mesh]]:
    """Return the morph and the maps of mean shapes along a number, their arrays, and the meshes."""
    cohort, unit = result.cohort, LengthFormat(result.cohort.unit).of_map
    blank = weights_of(cohort.observed_share) == 0
    low, high = cohort.vertices(result.path[0]), cohort.vertices(result.path[-1])
    widths = [result.half_width_mm(k) for k in range(len(result.df))]
    arrays: dict[str, Any] = {
        "low": low, "high": high, "vertices": cohort.vertices(result.path[len(result.path) // 2]),
        "values": result.values, "shapes": np.stack([cohort.vertices(own) for own in result.coefficients]),
        "half_width_mm": np.stack(widths[:-1]), "per_unit_mm": blank_where(result.per_unit_mm, blank),
        "per_unit_half_width_mm": widths[-1] / (result.ends[1] - result.ends[0]),
    }  # fmt: skip
    ends = [f"{result.along} {value:.3g}" for value in result.ends]
    morph: dict[str, Any] = {
        "title": f"Mean shape along {result.along}", "arrays": SHAPES_FILE, "low_label": ends[0], "high_label": ends[1]
    }  # fmt: skip
    if cohort.faces is None:
        return list(shape_change_parts(cohort, **morph)), arrays, {}
    weights, modes = _modes(result)
    widest = int(np.argmax([np.nan_to_num(np.linalg.norm(width), nan=-1.0) for width in widths[:-1]]))
    arrays |= {"faces": cohort.faces, "weights": weights, "modes": modes}
    parts: list[Part] = [
        MorphPart(**morph, modes="modes", weights="weights", variable=result.along, range=result.ends,
                  note="The slider moves through the mean shapes."),
        SurfaceMapPart(
            title=f"Change of shape for one unit of {result.along}", arrays=SHAPES_FILE, unit=unit,
            values="per_unit_mm",
            note="Along the normals, mean of the change between both ends; shapespace compare tests where this is more "
            "than chance.",
        ),
    ]  # fmt: skip
    if result.is_known[widest]:
        arrays["widest_mm"] = blank_where(widths[widest], blank)
        parts.append(
            SurfaceMapPart(
                title=f"Half width of the interval at {result.along} {result.values[widest]:.4g}, the widest",
                arrays=SHAPES_FILE, values="widest_mm", unit=unit, signed=False,
                note=f"Pointwise {100 * result.confidence:g} % interval of the mean shape along the normals.",
            )
        )  # fmt: skip
    name = re.sub(r"[^\w.-]+", "_", result.along)
    meshes = {
        f"{name}_{value:.6g}.ply": cohort.mesh(own, f"{result.along} {value:.6g}")
        for value, own in zip(result.values.tolist(), result.coefficients, strict=True)
    }
    return parts, arrays, meshes


def _modes(result: ShapePrediction) -> tuple[FloatArray, FloatArray]:
    """Return weights (B, q) up to 1 and modes (q, V, 3), mm, of the path less its first shape."""
    u, s, axes = np.linalg.svd(result.path - result.path[0], full_matrices=False)
    count = max(int((s > 1e-9 * s[0]).sum()), 1)  # the rest is rounding
    weights = u[:, :count] * s[:count]
    largest = np.maximum(np.abs(weights).max(axis=0), 1e-300)
    modes = (largest[:, None] * axes[:count]) @ result.cohort.basis
    return weights / largest, modes.reshape(count, -1, 3)


def _shape_summary(result: ShapePrediction) -> Iterator[str]:
    lengths, along = LengthFormat(result.cohort.unit), result.along
    change, error = map(lengths.text, result.change_mm)
    ends = f"from {along} {result.ends[0]:.3g} to {result.ends[1]:.3g}"
    p = "" if result.p is None else f" (p {result.p:.3g})"
    owners = subjects_of(result.cohort, result.subject)
    varies = len(set(zip(owners, result.observed.tolist(), strict=True))) > result.n_subjects
    subjects = f"{'between and within' if varies else 'between'} {result.n_subjects} subjects"
    limits = f"{subjects}{'' if varies else ', which were not followed'}"
    known = "" if result.is_known.all() else "; some intervals are not known"
    found = result.p is None or result.p <= result.methods.level
    yield (
        f"{f'Shape changes with {along}' if found else f'No change of shape with {along} is found'}{p}: {change} (RMS "
        f"over vertices, standard error {error}) {ends}, {limits}{known}."
    )
    held = ", ".join(f"{name} {value}" for name, value in result.held.items())
    yield (
        f"Mean shapes are predicted at {along} {', '.join(f'{value:.4g}' for value in result.values)} by ~ "
        f"{result.formula}{f', with {held}' if held else ''}; other numbers are at their mean, and classes count alike."
    )
    yield (
        f"Intervals are pointwise {100 * result.confidence:g} % intervals of the mean shape; single subjects vary more."
    )
    if not result.is_known.all():
        values = [f"{v:.4g}" for v, known in zip(result.values, result.is_known[:-1], strict=True) if not known]
        yield (
            f"Too few subjects determine the variance at {along} {', '.join(values) or 'of both ends'}, so the "
            "interval there is not known."
        )


def _value_table(result: ShapePrediction) -> ResultTable:
    lengths = LengthFormat(result.cohort.unit)
    names = ["distance_from_first", "standard_error", "half_width"]
    widths = [np.linalg.norm(result.half_width_mm(k)) for k in range(len(result.values))]
    columns = [result.distance_mm, result.distance_std_mm, np.array(widths) / result.cohort.n_vertices**0.5]
    for measure in result.measures:
        name = re.sub(r"\W+", "_", measure.name)
        names += [name, f"{name}_low", f"{name}_high"]
        columns += [measure.value, measure.low, measure.high]
    return ResultTable(
        title=f"Mean shapes along {result.along}", level=2, file="shapes.csv",
        columns=(Column(result.along, "number", result.along),
                 *(lengths.column(name.replace("_", " "), name) for name in names), Column(field="df")),
        rows=list(zip(result.values, *columns, result.df[: len(result.values)], strict=True)),
        note="RMS over vertices: distance from the first shape with its standard error, and half the width of the "
        f"pointwise {100 * result.confidence:g} % interval. Empty where an interval is not known.",
    )  # fmt: skip


def _measure_parts(result: ShapePrediction) -> Iterator[Part]:
    for measure in result.measures:
        low, high = ([None if np.isnan(v) else float(v) for v in end] for end in (measure.low, measure.high))
        yield CurvePart(
            title=f"{measure.name.capitalize()} along {result.along}", x=result.along,
            y=LengthFormat(result.cohort.unit).label(measure.name),
            series=(Series(x=floats(result.observed), y=floats(measure.observed), label="shapes", points=True),
                    Series(x=floats(result.values), y=floats(measure.value), label="mean", low=tuple(low),
                           high=tuple(high))),
        )  # fmt: skip


def _landmark_tables(result: ShapePrediction) -> Iterator[ResultTable]:
    if result.cohort.source.kind == "landmarks" and result.cohort.landmarks is not None:
        axes = "xyz"[: result.cohort.dimensions]
        header = (result.along, "landmark", *axes, *(f"{axis}_{end}" for end in ("low", "high") for axis in axes))
        points: list[tuple[object, ...]] = []
        for k, value in enumerate(result.values):
            shape, width = result.cohort.vertices(result.coefficients[k]), result.half_width_mm(k)
            for name, *ends in zip(result.cohort.landmarks.names, shape, shape - width, shape + width, strict=True):
                points.append((value, name, *(float(v) for end in ends for v in end[: len(axes)])))
        yield ResultTable.of_fields("landmarks.csv", header, points)
