"""Source of the shapes of an analysis and share of estimated vertices: notes, settings and a table of its report."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from shapespace.cohort.cohort import Cohort
from shapespace.report.analyses.analysis_report import AnalysisReport, Rows
from shapespace.schemas import TableColumn, TablePart
from shapespace.statistics.observation_weights import LEAST_INFORMATION

_FILE = "observed.csv"
_MOST_ROWS = 10  # rows that fit one screen; files have all


def blank_sentence(count: int, total: int) -> str:
    """Return a sentence on how many vertices of a map are blank; empty for none."""
    if not count:
        return ""
    return (
        f"{count} of {total} vertices are grey: the shapes that observe them carry less than "
        f"{100 * LEAST_INFORMATION:.0f} % of the information."
    )


def model_hashes(cohort: Cohort) -> tuple[str, ...]:
    """Return the content hash of the model of the fits; nothing for other surfaces."""
    return () if cohort.fitted is None else (cohort.fitted.model.content_hash,)


def shape_notes(cohort: Cohort) -> tuple[str, ...]:
    """Return sentences on truncated and estimated shapes."""
    notes: list[str] = []
    if cohort.source.modes is not None:
        notes.append(f"The shapes are {cohort.source}; variation outside these modes is not analysed.")
    share = cohort.estimated_share
    if share.any():
        worst = int(share.argmax())
        notes.append(
            f"{_percent(float(share.mean()))} of the analysed vertices are estimates, not observations (conditional "
            f"mean by PCA with missing data): in {int((share > 0).sum())} of {len(cohort)} shapes, most in "
            f"{cohort.names[worst]} ({_percent(float(share[worst]))})."
        )
    if cohort.analysed is not None:
        count = int((~cohort.analysed).sum())
        notes.append(
            f"{count} of {cohort.n_vertices} vertices, which fewer than half of the shapes observe, are not analysed."
        )
    return tuple(notes)


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.2g} %"


def shape_settings(cohort: Cohort) -> dict[str, Any]:
    """Return the entries of analysis.json on the source of the shapes and on estimated vertices."""
    source, share = cohort.source, cohort.estimated_share
    out: dict[str, Any] = {"shape_source": source.kind}
    if source.modes is not None:
        out |= {"shape_modes": source.modes, "shape_explained_variance_ratio": source.explained_variance_ratio}
    if share.any() or cohort.analysed is not None:
        worst = int(share.argmax())
        out |= {
            "estimated_share": float(share.mean()),
            "estimated_share_largest": float(share[worst]),
            "estimated_share_largest_shape": cohort.names[worst],
            "vertices_not_analysed": 0 if cohort.analysed is None else int((~cohort.analysed).sum()),
        }
    return out


def add_shape_data(report: AnalysisReport, cohort: Cohort) -> AnalysisReport:
    """Return a report with the source of its shapes and the share of estimated vertices of each shape."""
    share = cohort.estimated_share
    notes, settings = (*report.notes, *shape_notes(cohort)), {**report.settings, **shape_settings(cohort)}
    report = replace(report, notes=notes, settings=settings)
    if not share.any():
        return report
    order = sorted(range(len(share)), key=lambda k: (-share[k], k))
    rows: list[tuple[str, float]] = [(cohort.names[k], float(share[k])) for k in order if share[k] > 0]
    table: Rows = (("shape", "estimated_share"), rows)
    part = TablePart(
        title="Estimated vertices",
        note="Share of the vertices of a shape that its scan does not show, largest first; they are estimated by the "
        f"conditional mean of a PCA model with missing data, without the table. All of them are in {_FILE}.",
        columns=(TableColumn(name="shape"), TableColumn(name="estimated", kind="percent")),
        rows=tuple(rows[:_MOST_ROWS]),
    )
    return replace(report, tables={**report.tables, _FILE: table}, parts=(*report.parts, part))
