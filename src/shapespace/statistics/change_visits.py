"""Visits of subjects from a table: the scans of each subject in order of time, and which scans repeat another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date

from shapespace.cohort.table import Table, list_names
from shapespace.errors import InputError
from shapespace.reprs import short_repr

TIMES = ("time", "visit", "date")
"""Columns that may contain the time; the first that exists is used."""
RESCAN = "rescan"
_NOT_MARKED = frozenset({"", "0", "0.0", "no", "false"})
_DAYS_IN_A_YEAR = 365.25  # days; mean of the Julian calendar


@dataclass(frozen=True)
class Visit:
    """A visit: all scans of one subject at one time.

    Args:
        time: time in the unit of `Visits.time_unit`, or the position in the order of words.
        label: time as written in the table.
        rows: rows of its scans; more than one are rescans.
    """

    time: float
    label: str
    rows: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Visits:
    """The visits of all subjects in a table.

    Args:
        by_subject: subject -> visits, in order.
        time_unit: unit of time for rates, such as "year"; empty if times are words.
        column: column of the times.
    """

    by_subject: Mapping[str, tuple[Visit, ...]]
    time_unit: str
    column: str

    __repr__ = short_repr

    @property
    def rescans(self) -> int:
        """Number of scans in addition to the first of their visit."""
        return sum(len(visit.rows) - 1 for visits in self.by_subject.values() for visit in visits)


def visits_of(table: Table, subject: str, time: str | None, order: Sequence[str] | None) -> Visits:
    """Return the visits in a table without missing subjects and times.

    Args:
        table: table with a row for each scan.
        subject: column of the subjects.
        time: column of the times; None for the first column of `TIMES` that exists.
        order: order of times that are words, the earliest first; None for numbers and dates.

    Raises:
        InputError: no such column, times that are neither numbers nor dates without an order, a time that is not in
            the order, or two scans of one visit that the column `rescan` does not mark.
    """
    column = time_column(table, time)
    places, unit = _places(table, column, order)
    subjects, labels = table.texts(subject), table.texts(column)
    marks = table.columns.get(RESCAN)
    rows: dict[str, dict[float, list[int]]] = {}
    for row, (name, when) in enumerate(zip(subjects, places, strict=True)):
        rows.setdefault(name, {}).setdefault(when, []).append(row)
    if marks is not None:
        for name, times in rows.items():
            for scans in times.values():
                plain = [row for row in scans if marks[row].lower() in _NOT_MARKED]
                if len(plain) > 1:
                    raise InputError(
                        f"{table.where}: {name} has {len(plain)} scans at {labels[plain[0]]} "
                        f"({list_names([table.rows[row] for row in plain])}) that the column {RESCAN} does not mark as "
                        "rescans; mark all but one, or correct their times."
                    )
    visits = {
        name: tuple(Visit(when, labels[scans[0]], tuple(scans)) for when, scans in sorted(times.items()))
        for name, times in rows.items()
    }
    return Visits(visits, unit, column)


def time_column(table: Table, time: str | None) -> str:
    """Return the column of the times.

    Raises:
        InputError: the table has no column of `TIMES`, and none was named.
    """
    if time is not None:
        return time
    there = next((name for name in TIMES if name in table.columns), None)
    if there is None:
        raise InputError(
            f"{table.where} has no column {', '.join(TIMES[:-1])} or {TIMES[-1]}; name the column with "
            "the time of each scan with --time."
        )
    return there


def _places(table: Table, column: str, order: Sequence[str] | None) -> tuple[list[float], str]:
    cells = table.texts(column)
    if order is not None:
        known = {word: float(time) for time, word in enumerate(order)}
        if len(known) < max(len(order), 2):
            raise InputError(f"The order {','.join(order)} needs two or more words, each once.")
        odd = next((row for row, cell in enumerate(cells) if cell not in known), None)
        if odd is not None:
            raise InputError(
                f"{table.where}: {column!r} is {cells[odd][:40]!r} at {table.rows[odd]}, which is not in the order "
                f"{','.join(order)}; add it, or exclude the row."
            )
        return [known[cell] for cell in cells], ""
    days = [_day(cell) for cell in cells]
    if any(day is not None for day in days):
        odd = next((row for row, day in enumerate(days) if day is None), None)
        if odd is not None:
            raise InputError(
                f"{table.where}: {column!r} contains dates but {cells[odd][:40]!r} at {table.rows[odd]}; write it as "
                "2026-05-31."
            )
        return [day / _DAYS_IN_A_YEAR for day in days if day is not None], "year"
    if table.kind(column) == "text":
        words = list(dict.fromkeys(cells))
        raise InputError(
            f"{table.where}: {column!r} contains words ({list_names(words)}), which have no order of their own; "
            "specify it, the earliest first, as with --order before,after."
        )
    return [float(value) for value in table.numbers(column)], f"unit of {column}"


def _day(cell: str) -> int | None:
    # Plain years and numbers such as 20260531 are numbers.
    if "-" not in cell[1:]:
        return None
    try:
        return date.fromisoformat(cell[:10]).toordinal()
    except ValueError:
        return None
