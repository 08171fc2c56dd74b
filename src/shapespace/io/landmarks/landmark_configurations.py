"""Landmark configurations of many specimens: the same landmarks in the same order, in 2-D or 3-D."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.parsing import is_number
from shapespace.io.tables.table_io import read_rows
from shapespace.reprs import first_names, short_repr
from shapespace.types import BoolArray, FloatArray, IntArray

NO_SLIDERS = np.zeros((0, 3), dtype=np.int32)
_NO_POINTS = np.zeros(0, dtype=np.int32)
Curve: TypeAlias = tuple[tuple[int, ...], bool]
"""Indices of the points along a curve, from 0, and whether it is closed (the first point follows the last)."""
MOST_CURVE_POINTS = 100
"""Default number of points of a resampled curve; the RMS distance of its lines from the original is at most 0.4 % of
the size, measured on 99 sections of femora and spleens."""
_MOST_DIGITS = 9  # digits of the number of a landmark, which fits 32 bits
_MISSING_CODES, _MISSING_BELOW_ZERO = (-999.0, -9999.0), (-1.0, -9.0, -99.0)
"""Value of all coordinates of a missing landmark; the latter only if no other coordinate is negative, as in pictures.
tpsDig writes -1, and older programs -999."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkConfigurations:
    """Landmarks of N specimens as read, each in its own pose and size.

    Args:
        names: N names of specimens, all different.
        points: (N, L, D) coordinates with D 2 or 3; missing landmarks are not-a-number.
        landmarks: L names of landmarks; their numbers from 1 if the file has no names.
        columns: name -> N cells of covariates in the file; missing values are empty.
        curve_sliders: (M, 3) indices, from 0, of the landmarks before, sliding and after; those of `curves` by default.
        surface_sliders: (S,) indices, from 0, of the landmarks that slide on the surface.
        curves: curves of the file. The start of closed curves, and the direction of all, may differ between specimens.
        unit: unit of the coordinates, `mm`, or empty if unknown.
        where: name of the data in messages, such as the file.
        notes: sentences about changed or omitted data.

    Example:
        >>> points = np.stack([mesh.vertices[:4] for mesh in meshes])
        >>> len(ss.io.LandmarkConfigurations(names=list("abcdef"), points=points))
        6
    """

    names: tuple[str, ...]
    points: FloatArray
    landmarks: tuple[str, ...] = ()
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    curve_sliders: IntArray = field(default_factory=lambda: NO_SLIDERS)
    surface_sliders: IntArray = field(default_factory=lambda: _NO_POINTS)
    curves: tuple[Curve, ...] = ()
    unit: str = ""
    where: str = "The landmarks"
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) != 3 or shape[2] not in (2, 3) or shape[0] != len(self.names):
            raise InputError(f"{self.where}: landmarks need the shape (specimens, landmarks, 2 or 3), not {shape}.")
        if not len(self.curve_sliders):
            object.__setattr__(self, "curve_sliders", _sliders_of_curves(self.curves))
        if not self.landmarks:
            object.__setattr__(self, "landmarks", tuple(str(k) for k in range(1, shape[1] + 1)))
        if len(self.landmarks) != shape[1]:
            raise InputError(f"{self.where}: there are {len(self.landmarks)} names for {shape[1]} landmarks.")
        repeated = next((name for name, count in Counter(self.names).items() if count > 1), None)
        if repeated is not None:
            raise InputError(f"{self.where}: two specimens are called {repeated[:60]!r}; rename one.")
        if not all(name.strip() for name in self.names):
            raise InputError(f"{self.where}: a specimen has no name; name all specimens.")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def dimensions(self) -> int:
        """Dimension of the space, 2 or 3."""
        return int(self.points.shape[2])

    @property
    def curve_links(self) -> tuple[tuple[int, int], ...]:
        """Pairs of neighbouring landmarks along the curves, numbered from 1."""
        return tuple((a + 1, b + 1) for points, closed in self.curves for a, b in pairwise(_ring(points, closed)))

    @property
    def observed(self) -> BoolArray:
        """(N, L) mask of landmarks that are not missing."""
        return np.logical_not(np.logical_or.reduce(np.isnan(self.points), axis=2))


def _ring(points: tuple[int, ...], closed: bool) -> tuple[int, ...]:
    return (*points, *points[:1]) if closed else points


def _sliders_of_curves(curves: Sequence[Curve]) -> IntArray:
    """Return indices (M, 3) of points before, sliding, after; ends of open and starts of closed curves do not slide."""
    rings = [_ring(points, closed) for points, closed in curves]
    triples = [triple for ring in rings for triple in zip(ring, ring[1:], ring[2:], strict=False)]
    return np.reshape(triples, (-1, 3)).astype(np.int32)


def consecutive_curves(
    start: int, curves: Sequence[Sequence[object] | FloatArray], are_closed: Sequence[bool]
) -> tuple[Curve, ...]:
    """Return the curves whose points follow each other after the first `start` landmarks."""
    ends = np.cumsum([start, *map(len, curves)]).tolist()
    spans = (tuple(range(*span)) for span in pairwise(ends))
    return tuple(zip(spans, are_closed, strict=True))


def equal_curves(
    curves: Sequence[Sequence[FloatArray]], are_closed: Sequence[bool], names: Sequence[str], path: Path,
    count: int | None = None,
) -> tuple[list[list[FloatArray]], tuple[str, ...]]:  # fmt: skip
    """Return the curves of N specimens with equal numbers of points, and notes on those that are resampled.

    Curves with equal numbers stay as they are, unless closed ones have more than the default.

    Args:
        curves: N specimens with C polylines (K, D) each; not-a-number for missing points.
        are_closed: C values, whether the first point of a curve follows its last point.
        names: N names of specimens, used in messages.
        path: path of the file, used in messages.
        count: number of points of each curve; None for the smallest number among the specimens, at most 100.

    Raises:
        FileFormatError: a curve that has to be resampled has fewer than two points.
    """
    notes, out = list[str](), [list[FloatArray]() for _ in curves]
    for place, (closed, own) in enumerate(zip(are_closed, zip(*curves, strict=True), strict=True), 1):
        # The last point of a contour is often equal to its first point.
        own = [curve[:-1] if closed and len(curve) > 1 and (curve[0] == curve[-1]).all() else curve for curve in own]
        numbers = sorted(set(map(len, own)))
        points = count or min(numbers[0], MOST_CURVE_POINTS)
        if count or len(numbers) > 1 or (closed and points < numbers[0]):
            known = [curve[~np.isnan(curve).any(axis=1)] for curve in own]
            for name, curve, seen in zip(names, own, known, strict=True):
                if len(curve) < 2 or len(seen) == 1:
                    raise FileFormatError(
                        f"Cannot read {path}: curve {place} of specimen {name[:60]!r} has one point or none, and "
                        f"{numbers[-1]} in another; digitise the same curves for all."
                    )
            own = [resample_polyline(seen, points, closed) if len(seen) else curve[:1].repeat(points, 0)
                   for curve, seen in zip(own, known, strict=True)]  # fmt: skip
            had = " to ".join(map(str, dict.fromkeys((numbers[0], numbers[-1]))))
            kind = "Closed curve" if closed else "Curve"
            notes.append(f"{kind} {place}, of {had} points, is resampled to {points} points at equal distances.")
        for specimen, curve in zip(out, own, strict=True):
            specimen.append(curve)
    return out, tuple(notes)


def resample_polyline(path: FloatArray, count: int, closed: bool) -> FloatArray:
    """Return `count` points of a polyline at equal distances from its first point, including the end of an open one."""
    return spaced_points(np.concatenate([path, path[:1]]), count + 1)[:-1] if closed else spaced_points(path, count)


def spaced_points(path: FloatArray, count: int) -> FloatArray:
    """Return `count` points of a polyline (M, D) at equal distances along it, including both ends."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at: FloatArray = np.linspace(0.0, float(along[-1]), count)
    return np.stack([np.interp(at, along, path[:, axis]) for axis in range(path.shape[1])], axis=1)


def mark_missing(raw: LandmarkConfigurations) -> LandmarkConfigurations:
    """Return the configurations with not-a-number for all coordinates of missing landmarks, and notes on these.

    A landmark is missing if a coordinate is not-a-number, or if all are equal to a code of digitising programs.
    """
    points, notes = raw.points.copy(), list(raw.notes)
    lacking = np.isnan(points)
    partly = lacking.any(axis=2) & ~lacking.all(axis=2)
    points[partly] = np.nan
    first = np.where((points == points[:, :, :1]).all(axis=2), points[:, :, 0], np.nan)
    codes = [code for code in _MISSING_CODES if (first == code).any()]
    negative = (points < 0) & ~np.isin(first, (*_MISSING_CODES, *_MISSING_BELOW_ZERO))[:, :, None]
    codes += [code for code in _MISSING_BELOW_ZERO if not negative.any() and (first == code).any()]
    coded = np.isin(first, codes)
    points[coded] = np.nan
    for mask, reason in (
        (partly, "with some coordinates only"),
        (coded, f"with the coordinates {' or '.join(f'{code:g}' for code in codes)}"),
    ):
        if mask.any():
            affected = [raw.names[int(row)] for row in np.unique(np.nonzero(mask)[0])]
            count = int(mask.sum())
            noun, verb = ("landmark", "is") if count == 1 else ("landmarks", "are")
            notes.append(f"{count} {noun} of {first_names(affected)} {reason} {verb} interpreted as missing.")
    return replace(raw, points=points, notes=tuple(notes))


def read_landmark_numbers(path: Path, landmarks: Sequence[str] | None, widths: Sequence[int], form: str) -> IntArray:
    """Return the numbers, from 1, of the landmarks in each row of a table with or without a header.

    Args:
        path: path of the table, which contains numbers from 1, or names.
        landmarks: L names of landmarks; None if they are unknown.
        widths: allowed numbers of columns; row names of R are ignored.
        form: description of its rows, used in messages.

    Returns:
        Numbers (M, width), all different within a row.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it has no rows, or a row has another form.
    """
    number = {name: k for k, name in enumerate(landmarks or (), 1)}

    def number_of(cell: str) -> int:
        count = int(cell) if cell.isdecimal() and len(cell) < _MOST_DIGITS else 0
        return number.get(cell, 0 if landmarks is not None and count > len(landmarks) else count)

    rows = read_rows(path)
    if rows and not any(is_number(cell) or cell in number for cell in rows[0]):
        rows = [row[1:] if rows[0][0] == "" else row for row in rows][1:]
    numbers = [list(map(number_of, row)) for row in rows]
    bad = next((k for k, row in enumerate(numbers) if len(row) not in widths or len({*row} - {0}) < len(row)), None)
    if bad is not None or not rows:
        given = "no row" if bad is None else f"the row {', '.join(rows[bad])[:60]!r}"
        last = "" if landmarks is None else f" to {len(landmarks)}, or by name"
        raise FileFormatError(f"{path} has {given}; write {form} in each row, by number from 1{last}.")
    return np.array(numbers, dtype=np.int32)
