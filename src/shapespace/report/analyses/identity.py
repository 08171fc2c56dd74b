"""Sentences, cells and curves shared by the reports of verification and identification."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from shapespace.cohort.proportions import zero_bound
from shapespace.report.analyses.analysis_report import Rows
from shapespace.schemas import Series
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
