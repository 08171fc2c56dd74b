"""Tables of fits and of scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import isfinite, nan
from typing import Any, cast

import numpy as np

from shapespace.report.blocks.blocks import Block, Cell, Column, Table, Text, length, number, status
from shapespace.report.blocks.wording import plain, words
from shapespace.report.inputs.saved_fits import Direction, Measure, SavedFit
from shapespace.schemas import VertexErrors

_Make = Callable[[SavedFit], Cell]


def fits_table(fits: Sequence[SavedFit], places: Mapping[str, str], *, caption: str) -> Table:
    """Return a table of all fits that sorts, without the columns that would be empty.

    Args:
        fits: in the order wanted.
        places: where in the page a fit is shown, by its name.
        caption: of the table.
    """
    texts: list[tuple[str, _Make]] = [
        ("Scan", lambda fit: Cell(fit.name, anchor=places.get(fit.name))),
        ("Label", lambda fit: Cell(fit.label if fit.label != fit.name else "")),
        ("Status", lambda fit: status(fit.status)),
    ]
    columns = [(Column(head), make) for head, make in texts]
    columns += [(Column(head, "number"), make) for head, make in _NUMBERS]
    made = [(column, [make(fit) for fit in fits]) for column, make in columns]
    nonempty = [
        (column, cells)
        for column, cells in made
        if any(cell.text if cell.value is None else isfinite(cell.value) for cell in cells)
    ]
    rows = [[cells[k] for _, cells in nonempty] for k in range(len(fits))]
    return Table([column for column, _ in nonempty], rows, caption, sortable=len(fits) > 1)


def _error(of: Callable[[SavedFit], VertexErrors | None], measure: str) -> _Make:
    return lambda fit: length(getattr(of(fit), measure, nan))


def _distance(direction: Direction, measure: Measure) -> _Make:
    return lambda fit: length(fit.distance_mm(direction, measure))


def _share(key: str) -> _Make:
    def cell(fit: SavedFit) -> Cell:
        share = getattr(fit.record.shown, key, None)
        return number(nan if share is None else 100 * share, 0)

    return cell


def _total(values: Mapping[str, float], digits: int) -> Cell:
    return number(sum(values.values()) if values else nan, digits)


_NUMBERS: list[tuple[str, _Make]] = [
    ("True vertex error, mean", _error(lambda fit: fit.entry.vertex_error_mm, "mean")),
    ("True vertex error, max", _error(lambda fit: fit.entry.vertex_error_mm, "max")),
    ("Floor of that, mean", _error(lambda fit: fit.entry.floor_mm, "mean")),
    ("Expected vertex error", lambda fit: length(fit.expected_error_mm)),
    ("Model to scan where shown, mean", _distance("model_to_scan", "mean")),
    ("Model to scan where shown, 95 %", _distance("model_to_scan", "p95")),
    ("Scan to model where covered, mean", _distance("scan_to_model", "mean")),
    ("Scan to model where covered, 95 %", _distance("scan_to_model", "p95")),
    ("Model shown, %", _share("model_seen_share")),
    ("Scan covered, %", _share("scan_covered_share")),
    ("RMS of z", lambda fit: number(float(np.sqrt(np.mean(np.square(fit.record.z)))) if fit.record.z else nan, 1)),
    ("Steps", lambda fit: _total(fit.record.iterations, 0)),
    ("Seconds", lambda fit: _total(fit.record.seconds, 1)),
]


SCORE_WORDS: Mapping[str, str] = {
    "line_r2_through_neutral": "Share of the deviation on the line through neutral (R²)",
    "line_r2_free": "R² of the best line anywhere, of the scatter about the mean (a smaller whole, so it may be lower)",
    "line_sign_consistency": "Share of faces on the same side of neutral",
    "line_spearman": "Rank correlation of position on the line with intensity",
    "line_permutation_p": "Its permutation p-value",
    "disjointness": "All expressions",
    "leave_one_out_accuracy": "Leave-one-out accuracy of the nearest mean direction",
    "chance": "Accuracy of guessing",
    "cosine_silhouette": "Silhouette of the directions (−1 to 1)",
    "separability": "Between-class over within-class scatter",
    "accuracy_p": "Permutation p-value of the accuracy",
    "silhouette_p": "Permutation p-value of the silhouette",
    "left_out": "Faces left out because their fit is not trusted",
}


def score_tables(scores: Mapping[str, Any], *, many: str, single: str) -> list[Block]:
    """Return scores as tables: those given for each of several things as one, single values as another.

    Args:
        scores: name -> value, or name -> {thing: value}.
        many: caption of the first.
        single: caption of the second.
    """

    def row(key: str, values: Sequence[object]) -> list[Cell]:
        texts = [f"{value:.3f}" if isinstance(value, float) and abs(value) < 10 else plain(value) for value in values]
        return [Cell(SCORE_WORDS.get(key, words(key))), *map(Cell, texts)]

    by_thing = {key: _object(value) for key, value in scores.items() if key.startswith("line_")}
    out: list[Block] = []
    if by_thing:
        names = list(dict.fromkeys(name for value in by_thing.values() for name in value))
        rows = [row(key, [value.get(name) for name in names]) for key, value in by_thing.items()]
        out.append(Table([Column("Score"), *(Column(name, "number") for name in names)], rows, many))
    singles = {key: _object(value) or {key: value} for key, value in scores.items() if key not in by_thing}
    rest = [row(key, [value]) for values in singles.values() for key, value in values.items()]
    if rest:
        out.append(Table([Column("Score"), Column("Value", "number")], rest, single))
    return out or [Text("There are no scores.")]


def _object(value: object) -> Mapping[str, object]:
    return cast(Mapping[str, object], value) if isinstance(value, Mapping) else {}
