"""Report of identification."""

from __future__ import annotations

from collections.abc import Sequence

from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.analyses.identity import (
    INTERVALS,
    config_settings,
    csv_cells,
    identity_methods,
    interval,
    no_error_sentence,
    percent_text,
    scan_rows,
    score_label,
    subjects_sentence,
    without_empty,
)
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes
from shapespace.schemas import CurvePart, Part, Series, TablePart, TextPart
from shapespace.statistics.identity.identify import IdentificationRates, IdentificationResult


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
