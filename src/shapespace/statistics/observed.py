"""Estimated vertices in results: weights of vertices by their observations, and the share of estimates in reports.

An estimate is computed from the observed vertices of its shape and from the other shapes, so it is not an additional
observation. Maps weight each vertex by the information in its observations, and are blank where that is below a half.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.schemas import TableColumn, TablePart
from shapespace.statistics.answer import Answer, Rows
from shapespace.types import BoolArray, FloatArray

LEAST_INFORMATION = 0.5
"""Share of the information below which a map is blank; the share of shapes that a model needs (`MIN_SEEN`)."""
FILE = "observed.csv"
_ESTIMABLE = 1e-6
_BLOCK = 4096
_LISTED = 10


def information(cohort: Cohort, matrix: FloatArray, contrasts: FloatArray) -> FloatArray | None:
    """Return the share of the information on each contrast in the shapes that observe a vertex.

    It is the variance of the least-squares estimate of the contrast by all shapes, divided by that by the shapes that
    observe the vertex; 0 where these do not determine it, and at vertices that are not analysed.

    Args:
        cohort: N shapes.
        matrix: (N, p) design without intercept.
        contrasts: (E, p) linear combinations of its coefficients.

    Returns:
        (E, V), or None if all vertices are observed.
    """
    if cohort.observed is None and cohort.analysed is None:
        return None
    observed = np.ones((len(cohort), cohort.n_vertices), np.bool_) if cohort.observed is None else cohort.observed
    if cohort.analysed is not None:
        observed = np.logical_and(observed, cohort.analysed)
    X = np.column_stack([np.ones(len(matrix)), matrix])
    C = np.column_stack([np.zeros(len(contrasts)), contrasts])
    whole = _variance(X.T @ X, C)
    patterns, of_vertex = np.unique(np.packbits(observed, axis=0).T, axis=0, return_inverse=True)
    rows = np.unpackbits(patterns, axis=1, count=len(X)).astype(np.float64)
    products = (X[:, :, None] * X[:, None, :]).reshape(len(X), -1)
    out = np.empty((len(C), len(rows)))
    for start in range(0, len(rows), _BLOCK):
        part = slice(start, start + _BLOCK)
        systems = (rows[part] @ products).reshape(-1, X.shape[1], X.shape[1])
        out[:, part] = whole[:, None] / _variance(systems, C)
    return np.minimum(out, 1.0)[:, of_vertex.reshape(-1)]


def _variance(systems: FloatArray, C: FloatArray) -> FloatArray:
    """Return c' S^+ c of each contrast (E, p) in each system (..., p, p), (E, ...); infinite if not estimable."""
    inverse = np.linalg.pinv(systems, rcond=1e-10, hermitian=True)
    solved = np.einsum("...ij,ej->e...i", inverse, C)
    back = np.einsum("...ij,e...j->e...i", systems, solved)
    shape = (len(C), *(1,) * (systems.ndim - 2), C.shape[1])
    off = np.abs(back - C.reshape(shape)).max(axis=-1)
    variance = np.einsum("e...i,ei->e...", solved, C)
    known = off <= _ESTIMABLE * np.abs(C).max(axis=1).reshape(shape[:-1])
    return np.where(known & (variance > 0), variance, np.inf)


def weights_of(share: FloatArray) -> FloatArray:
    """Return weights (..., V) of vertices by their share of information or observations, 0 where maps are blank."""
    return np.where(share < LEAST_INFORMATION, 0.0, share)


def blank_where(values: FloatArray, blank: BoolArray | None) -> FloatArray:
    """Return values (..., V) with not-a-number, which maps draw in grey, where `blank` (..., V)."""
    return values if blank is None else np.where(blank, np.nan, values)


def blank_sentence(count: int, total: int) -> str:
    """Return a sentence on how many vertices of a map are blank; empty for none."""
    if not count:
        return ""
    return (
        f"{count} of {total} vertices are grey: the shapes that observe them carry less than "
        f"{100 * LEAST_INFORMATION:.0f} % of the information."
    )


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


def with_shape_data(answer: Answer, cohort: Cohort) -> Answer:
    """Return an answer with the source of its shapes and the share of estimated vertices of each shape."""
    share = cohort.estimated_share
    stated = replace(
        answer,
        notes=(*answer.notes, *shape_notes(cohort)),
        settings={**answer.settings, **shape_settings(cohort)},
    )
    if not share.any():
        return stated
    order = sorted(range(len(share)), key=lambda k: (-share[k], k))
    rows: list[tuple[str, float]] = [(cohort.names[k], float(share[k])) for k in order if share[k] > 0]
    table: Mapping[str, Rows] = {FILE: (("shape", "estimated_share"), rows)}
    part = TablePart(
        title="Estimated vertices",
        note="Share of the vertices of a shape that its scan does not show, largest first; they are estimated by the "
        f"conditional mean of a PCA model with missing data, without the table. All of them are in {FILE}.",
        columns=(TableColumn(name="shape"), TableColumn(name="estimated", kind="percent")),
        rows=tuple(rows[:_LISTED]),
    )
    return replace(stated, tables={**stated.tables, **table}, parts=(*stated.parts, part))
