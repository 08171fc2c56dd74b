"""The answer of identification as it is kept and reported."""

from __future__ import annotations

from collections.abc import Sequence

from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.analyses.identity import (
    INTERVALS,
    called,
    cells,
    in_percent,
    interval,
    none_missed,
    scans_told,
    seen,
    settings,
    who_was_tested,
)
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes
from shapespace.schemas import CurvePart, Part, Series, TableColumn, TablePart, TextPart
from shapespace.statistics.identity.identify import IdentificationRates, IdentificationResult


def identify_report(found: IdentificationResult) -> AnalysisReport:
    """Return what `shapespace recognise identify` writes."""
    trial, first = found.trial, found.scores[0]
    strangers = int((~first.searches.enrolled).sum())
    summary = seen(
        [
            f"By {called(first.name)} the right subject is the first of {found.enrolled} in "
            f"{in_percent(first.rank_1)} of {found.probes - strangers} searches.",
            *(
                f"Where {100 * rate:g} % of searches for strangers may return a person, "
                f"{in_percent(one)} of those enrolled are missed."
                for rate, one in first.fnir.items()
                if one.value is not None
            ),
            *(
                f"By {called(one.name)} the right subject is the first in {in_percent(one.rank_1)}."
                for one in found.scores[1:]
            ),
            who_was_tested(trial, found.trained_on),
        ]
    )
    lost = [rate for rate, one in first.fnir.items() if one.value is None]
    notes = seen(
        [
            *trial.notes,
            none_missed((first.rank_1.value or 0.0) < 1, first.searches.people),
            "There are too few searches for a false positive identification rate of "
            f"{', '.join(f'{rate:g}' for rate in lost)}."
            if lost
            else "",
            ""
            if strangers
            else "All probes are of enrolled subjects, so each is also searched for in a gallery without its subject.",
        ]
    )
    told = ("score", "figure", "value", "low", "high")
    report = AnalysisReport(
        question="recognise identify",
        title="Who is it? Identification",
        summary=summary,
        parts=_parts(found),
        tables={
            "figures.csv": (told, [row for one in found.scores for row in _rows(one)]),
            "scans.csv": scans_told(trial),
        },
        arrays={
            "searches.npz": {
                f"{field}_{one.name}": getattr(one.searches, field)
                for one in found.scores
                for field in ("rank", "own", "best_other")
            }
        },
        notes=notes,
        settings=settings(found.config),
        model_hashes=model_hashes(trial.cohort),
    )
    return add_shape_data(report, trial.cohort)


def _rows(one: IdentificationRates) -> list[Sequence[object]]:
    rows: list[Sequence[object]] = [[one.name, "rank 1", *cells(one.rank_1)]]
    rows += [[one.name, f"within {k}", share, *ends] for k, (share, *ends) in enumerate(
        zip(one.cmc.tolist(), *one.band.tolist(), strict=True), 1)]  # fmt: skip
    rows += [[one.name, f"fnir at fpir {rate:g}", *cells(told)] for rate, told in one.fnir.items()]
    return rows


def _parts(found: IdentificationResult) -> tuple[Part, ...]:
    columns = [TableColumn(name="score"), TableColumn(name="first", kind="percent"),
               TableColumn(name="95 %", kind="interval")]  # fmt: skip
    for rate in found.scores[0].fnir:
        columns += [TableColumn(name=f"FNIR at FPIR {rate:g}", kind="percent"),
                    TableColumn(name="95 %", kind="interval")]  # fmt: skip
    rows = tuple(
        (called(one.name), one.rank_1.value, interval(one.rank_1),
         *(cell for told in one.fnir.values() for cell in (told.value, interval(told))))
        for one in found.scores
    )  # fmt: skip
    ranks = tuple(float(k) for k in range(1, found.enrolled + 1))
    return (
        TablePart(
            title="Identification rates",
            note="FPIR: searches for people who are not enrolled that return a person. FNIR: searches for "
            "enrolled people that do not return them first and above the threshold.",
            columns=tuple(columns),
            rows=rows,
        ),
        CurvePart(
            title="CMC curve",
            note="Share of probes whose subject is within the first ranks.",
            series=tuple(
                Series(x=ranks, y=tuple(one.cmc.tolist()), label=called(one.name),
                       low=tuple(one.band[0].tolist()), high=tuple(one.band[1].tolist()))
                for one in found.scores
            ),
            x="rank",
            y="share of searches",
        ),
        TextPart(
            title="How it was measured",
            text=(
                who_was_tested(found.trial, found.trained_on),
                f"{found.enrolled} subjects are enrolled"
                + (" in each part at least." if len(found.trial.rounds) > 1 else ".")
                + " A subject's score is that of its most similar scan; ties count against the"
                f" right one. {INTERVALS}",
            ),
        ),
    )  # fmt: skip
