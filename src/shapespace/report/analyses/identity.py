"""Sentences, cells and curves shared by the reports of verification and identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from shapespace.cohort.proportions import zero_bound
from shapespace.report.analyses.analysis_report import AnalysisReport, Rows
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes
from shapespace.schemas import CurvePart, Part, Series, TablePart, TextPart
from shapespace.statistics.identity.identify import IdentificationRates, IdentificationResult
from shapespace.statistics.identity.rates import RateEstimate
from shapespace.statistics.identity.trial import IdentityConfig, Trial
from shapespace.statistics.methods import methods_of
from shapespace.types import FloatArray

_POINTS = 300  # points of a drawn curve, more than its pixels show
_PLDA = "Ioffe S. (2006) Probabilistic linear discriminant analysis. European Conference on Computer Vision, 531-542."
SCORE_NAMES = {
    "plda": "PLDA score",
    "cosine": "cosine",
    "mahalanobis": "whitened distance",
    "distance": "plain distance",
}
"""What scores are called in words."""
INTERVALS = (
    "95 % intervals are percentiles over draws of subjects with replacement; near 0 and 1 they are at least as wide as "
    "the exact interval of Clopper and Pearson for no error among the same number of subjects."
)
"""Description of the intervals of error rates, for reports."""


def score_label(name: str) -> str:
    """Return what a score is called in words."""
    return SCORE_NAMES.get(name, name)


def percent_text(one: RateEstimate) -> str:
    """Return a share with its interval in words."""
    if one.value is None:
        return "not known"
    ends = interval(one)
    return f"{100 * one.value:.2f} %" + (f" (95 %: {100 * ends[0]:.2f} to {100 * ends[1]:.2f} %)" if ends else "")


def interval(one: RateEstimate) -> tuple[float, float] | None:
    """Return the ends of an interval, or None if there is none."""
    return None if one.low is None or one.high is None else (one.low, one.high)


def csv_cells(one: RateEstimate) -> list[object]:
    """Return value, low and high of a figure as cells of a CSV table."""
    return ["" if value is None else value for value in (one.value, one.low, one.high)]


def thin_curve(x: FloatArray, y: FloatArray, label: str) -> Series:
    """Return a line through the ends and a few hundred points of a curve, those where it turns first."""
    corners = np.ones(len(x), dtype=np.bool_)
    corners[1:-1] = ~(((x[1:-1] == x[:-2]) & (x[1:-1] == x[2:])) | ((y[1:-1] == y[:-2]) & (y[1:-1] == y[2:])))
    kept_points = np.flatnonzero(corners)
    if len(kept_points) > _POINTS:
        kept_points = kept_points[np.unique(np.linspace(0, len(kept_points) - 1, _POINTS).round().astype(np.intp))]
    return Series(x=tuple(x[kept_points].tolist()), y=tuple(y[kept_points].tolist()), label=label)


def subjects_sentence(trial: Trial, trained_on: int) -> str:
    """Return in words who was compared, and who was learned from."""
    tested = int(trial.tested.sum())
    training = f"on {trained_on} other subjects" if trained_on else "on no subjects"
    if len(trial.rounds) == 1:
        return f"{tested} subjects were tested; scores and calibration were trained {training}."
    return (
        f"{tested} subjects were tested in {len(trial.rounds)} folds, each compared within itself; scores and "
        f"calibration were trained on the other folds, of at least {trained_on} subjects."
    )


def identity_methods(trial: Trial, config: IdentityConfig, trained_on: int) -> dict[str, Any]:
    """Return `methods` and `citations` of an `AnalysisReport`: scores, training and intervals."""
    scores = f"Two scans are compared by {', '.join(map(score_label, config.scores))}."
    sentences = (scores, subjects_sentence(trial, trained_on), INTERVALS)
    methods = methods_of(trial.cohort, len(set(trial.subjects)), assumptions=sentences)
    return {"methods": methods, "citations": (_PLDA,) if "plda" in config.scores else ()}


def config_settings(config: IdentityConfig) -> dict[str, Any]:
    """Return all that the result depends on."""
    return asdict(config)


def scan_rows(trial: Trial) -> Rows:
    """Return each scan with its subject, and what it was in the round in which its person was tested."""
    role = dict.fromkeys(range(len(trial.cohort)), "train")
    for one in trial.rounds:
        role |= dict.fromkeys(one.gallery, "both" if trial.all_pairs else "gallery")
        if not trial.all_pairs:
            role |= dict.fromkeys(one.probes, "probe")
    used = {row for one in trial.rounds for row in (*one.training, *one.gallery, *one.probes)}
    rows = zip(trial.cohort.names, trial.subjects, role.items(), strict=True)
    return ("scan", "subject", "role"), [
        (name, subject, role_of_scan if row in used else "") for name, subject, (row, role_of_scan) in rows
    ]


def no_error_sentence(errors: bool, people: int) -> str:
    """Return a sentence on the exact upper bound where no error was found among some people."""
    return (
        ""
        if errors
        else f"No error among {people} subjects does not mean an error rate of zero: up to "
        f"{100 * zero_bound(people):.1f} % of subjects may be affected by errors (95 %, Clopper-Pearson, "
        "with subjects as the units)."
    )


def without_empty(values: Sequence[str]) -> tuple[str, ...]:
    """Return the sentences that say something."""
    return tuple(value for value in values if value)


def identify_report(result: IdentificationResult) -> AnalysisReport:
    """Return what `shapespace recognise identify` writes."""
    trial, first = result.trial, result.scores[0]
    n_not_enrolled = int((~first.searches.enrolled).sum())
    summary = without_empty(
        [
            f"By {score_label(first.name)} the right subject is the first of {result.enrolled} in "
            f"{percent_text(first.rank_1)} of {result.probes - n_not_enrolled} searches.",
            *(
                f"Where {100 * rate:g} % of searches for strangers may return a person, "
                f"{percent_text(one)} of those enrolled are missed."
                for rate, one in first.fnir.items()
                if one.value is not None
            ),
            *(
                f"By {score_label(one.name)} the right subject is the first in {percent_text(one.rank_1)}."
                for one in result.scores[1:]
            ),
            subjects_sentence(trial, result.trained_on),
        ]
    )
    unmeasured = [rate for rate, one in first.fnir.items() if one.value is None]
    notes = without_empty(
        [
            *trial.notes,
            no_error_sentence((first.rank_1.value or 0.0) < 1, first.searches.people),
            "There are too few searches for a false positive identification rate of "
            f"{', '.join(f'{rate:g}' for rate in unmeasured)}."
            if unmeasured
            else "",
            ""
            if n_not_enrolled
            else "All probes are of enrolled subjects, so each is also searched for in a gallery without its subject.",
        ]
    )
    header = ("score", "figure", "value", "low", "high")
    report = AnalysisReport(
        question="recognise identify",
        title="Who is it? Identification",
        summary=summary,
        parts=_parts(result),
        tables={
            "figures.csv": (header, [row for one in result.scores for row in _rows(one)]),
            "scans.csv": scan_rows(trial),
        },
        arrays={
            "searches.npz": {
                f"{field}_{one.name}": getattr(one.searches, field)
                for one in result.scores
                for field in ("rank", "own", "best_other")
            }
        },
        notes=notes,
        settings=config_settings(result.config),
        model_hashes=model_hashes(trial.cohort),
        **identity_methods(trial, result.config, result.trained_on),
    )
    return add_shape_data(report, trial.cohort)


def _rows(one: IdentificationRates) -> list[Sequence[object]]:
    rows: list[Sequence[object]] = [[one.name, "rank 1", *csv_cells(one.rank_1)]]
    rows += [[one.name, f"within {k}", share, *ends] for k, (share, *ends) in enumerate(
        zip(one.cmc.tolist(), *one.band.tolist(), strict=True), 1)]  # fmt: skip
    rows += [[one.name, f"fnir at fpir {rate:g}", *csv_cells(estimate)] for rate, estimate in one.fnir.items()]
    return rows


def _parts(result: IdentificationResult) -> tuple[Part, ...]:
    rates = ["first", *(f"FNIR at FPIR {rate:g}" for rate in result.scores[0].fnir)]
    columns = ["score", *(name for rate in rates for name in (rate, "95 %"))]
    rows = tuple(
        (score_label(one.name), one.rank_1.value, interval(one.rank_1),
         *(cell for estimate in one.fnir.values() for cell in (estimate.value, interval(estimate))))
        for one in result.scores
    )  # fmt: skip
    ranks = tuple(float(k) for k in range(1, result.enrolled + 1))
    return (
        TablePart.of(
            "Identification rates", columns, rows, percent=rates,
            note="FPIR: searches for people who are not enrolled that return a person. FNIR: searches for "
            "enrolled people that do not return them first and above the threshold.",
        ),
        CurvePart(
            title="CMC curve",
            note="Share of probes whose subject is within the first ranks.",
            series=tuple(
                Series(x=ranks, y=tuple(one.cmc.tolist()), label=score_label(one.name),
                       low=tuple(one.band[0].tolist()), high=tuple(one.band[1].tolist()))
                for one in result.scores
            ),
            x="rank",
            y="share of searches",
        ),
        TextPart(
            title="How it was measured",
            text=(
                subjects_sentence(result.trial, result.trained_on),
                f"{result.enrolled} subjects are enrolled"
                + (" in each part at least." if len(result.trial.rounds) > 1 else ".")
                + " A subject's score is that of its most similar scan; ties count against the"
                f" right one. {INTERVALS}",
            ),
        ),
    )  # fmt: skip
