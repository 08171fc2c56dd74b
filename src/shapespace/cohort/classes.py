"""Classes of a table: counts, and likely misspellings (classes with one shape, and classes with similar names)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from itertools import combinations

from shapespace.cohort.table import Table, is_number

_LISTED = 12
"""Largest number of classes whose counts are listed."""
_FEWEST_CODES = 3
"""Fewest classes that differ from a number; two classes have one degree of freedom too."""
_COMPARED = 60
"""Largest number of classes that are compared letter by letter; columns with more contain names."""
_LONG = 5
"""Shortest words that count as similar if one letter differs; shorter ones, such as left and lent, do not."""


def class_notes(table: Table, columns: Iterable[str], numbers: Collection[str] = ()) -> tuple[str, ...]:
    """Return sentences on the classes in some columns of a table.

    Args:
        table: with the columns.
        columns: that are used as classes, whatever they contain, or as numbers.
        numbers: those that are used as numbers.

    Raises:
        InputError: there is no such column.
    """
    return tuple(
        note
        for column in dict.fromkeys(columns)
        for note in notes_on_classes(column, table.texts(column), codes=column not in numbers)
    )


def notes_on_classes(column: str, cells: Sequence[str], *, codes: bool = False) -> list[str]:
    """Return the number of shapes in each class, and sentences on classes that may be misspelt.

    If more than half of all shapes are the only ones of their class, the column contains names and no counts are given.

    Args:
        column: its name.
        cells: of all shapes; missing ones are empty.
        codes: whether numbers are codes of classes.
    """
    counts = Counter(cell for cell in cells if cell)
    if codes and all(map(is_number, counts)):
        counts = Counter(f"{float(cell):g}" for cell in cells if cell)
    total = counts.total()
    is_numeric = 2 * sum(n for cell, n in counts.items() if is_number(cell)) > total
    if not total or (len(counts) != 2 and is_numeric and not codes):
        # Two numbers are often codes of two groups.
        return []
    has_names = 2 * len(counts) > total
    notes: list[str] = []
    if not has_names:
        fewest, most = min(counts.values()), max(counts.values())
        listed = ", ".join(f"{name} {n}" for name, n in counts.most_common())
        if len(counts) > _LISTED:
            listed = f"{fewest}{f' to {most}' if most > fewest else ''} in {len(counts)} classes"
        notes.append(f"Shapes in each class of {column}: {listed}.")
        alone = [name for name, count in counts.items() if count == 1]
        if alone:
            quoted_names = ", ".join(repr(name[:40]) for name in alone[:3]) + (" ..." if len(alone) > 3 else "")
            notes.append(
                f"{column} has {len(alone)} {'class' if len(alone) == 1 else 'classes'} with one shape "
                f"({quoted_names}); check the spelling, or leave these shapes out."
            )
    for first, other, difference in _similar(list(counts), letters=not has_names):
        notes.append(
            f"{column} has the classes {first[:40]!r} ({counts[first]}) and {other[:40]!r} ({counts[other]}), which "
            f"differ only in {difference}; correct the table if they are the same."
        )
    return notes


def number_caution(table: Table, column: str, classes: str) -> str:
    """Return a sentence on a column of few different whole numbers that is used as a number; empty on other columns.

    Args:
        table: with the column.
        column: of numbers.
        classes: what to write for classes.
    """
    values = {float(value) for value in table.numbers(column)}
    if not _FEWEST_CODES <= len(values) <= _LISTED or len(table) < 2 * len(values):
        return ""
    if not all(value.is_integer() for value in values):
        return ""
    listed = ", ".join(f"{value:g}" for value in sorted(values))
    return (
        f"{column} has {len(values)} different whole numbers ({listed}) and is used as a number, with 1 degree of "
        f"freedom; if they are codes of classes, write {classes}, with {len(values) - 1}."
    )


def _similar(names: Sequence[str], *, letters: bool) -> list[tuple[str, str, str]]:
    """Return pairs of similar names, and their difference."""
    plain: dict[str, list[str]] = {}
    for name in names:
        plain.setdefault("".join(name.casefold().split()), []).append(name)
    pairs = [(group[0], second, "case or white space") for group in plain.values() for second in group[1:]]
    if letters and len(plain) <= _COMPARED:
        pairs += [
            (plain[first][0], plain[second][0], "one letter")
            for first, second in combinations(plain, 2)
            if max(len(first), len(second)) >= _LONG and (first + second).isalpha() and _one_edit(first, second)
        ]
    return pairs


def _one_edit(first: str, second: str) -> bool:
    """Return whether words differ by one inserted, removed or replaced letter, or by two adjacent letters swapped."""
    start = next(
        (k for k, (a, b) in enumerate(zip(first, second, strict=False)) if a != b), min(len(first), len(second))
    )
    first_rest, second_rest = first[start:], second[start:]
    replaced = first_rest[1:] == second_rest[1:]
    exchanged = first_rest[:2] == second_rest[:2][::-1] and first_rest[2:] == second_rest[2:]
    return replaced or exchanged or first_rest[1:] == second_rest or first_rest == second_rest[1:]
