"""Landmark configurations of many specimens: the same landmarks in the same order, in 2-D or 3-D."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.io.parsing import damage_error
from shapespace.reprs import first_names, short_repr
from shapespace.types import BoolArray, FloatArray, IntArray

_NO_SLIDERS = np.zeros((0, 3), dtype=np.int32)
_NO_POINTS = np.zeros(0, dtype=np.int32)
_NAMED = 3  # specimens in a sentence
_MISSING_CODES, _MISSING_BELOW_ZERO = (-999.0, -9999.0), (-1.0, -9.0, -99.0)
"""All coordinates of a missing landmark; the latter only where no other coordinate is negative, as in pictures. tpsDig
writes -1, and older programs -999."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LandmarkConfigurations:
    """Landmarks of N specimens as read, each in its own pose and size.

    Args:
        names: N specimens, all different.
        points: (N, L, D) coordinates with D 2 or 3; missing landmarks are not-a-number.
        landmarks: L names; their numbers from 1 where a file has none.
        columns: name -> N cells of covariates in the file; a missing one is empty.
        curve_sliders: (M, 3) landmarks before, sliding and after, from 0.
        surface_sliders: (S,) landmarks that slide on the surface, from 0.
        unit: of the coordinates, `mm` or empty for none.
        where: what the data are called in messages, such as the file.
        notes: what was changed or left out while reading, a sentence each.
    """

    names: tuple[str, ...]
    points: FloatArray
    landmarks: tuple[str, ...] = ()
    columns: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    curve_sliders: IntArray = field(default_factory=lambda: _NO_SLIDERS)
    surface_sliders: IntArray = field(default_factory=lambda: _NO_POINTS)
    unit: str = ""
    where: str = "The landmarks"
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __post_init__(self) -> None:
        shape = self.points.shape
        if len(shape) != 3 or shape[2] not in (2, 3) or shape[0] != len(self.names):
            raise InputError(f"{self.where}: landmarks need the shape (specimens, landmarks, 2 or 3), not {shape}.")
        if not self.landmarks:
            object.__setattr__(self, "landmarks", tuple(str(k) for k in range(1, shape[1] + 1)))
        if len(self.landmarks) != shape[1]:
            raise InputError(f"{self.where}: there are {len(self.landmarks)} names for {shape[1]} landmarks.")
        repeated = next((name for name, count in Counter(self.names).items() if count > 1), None)
        if repeated is not None:
            raise InputError(f"{self.where}: two specimens are called {repeated[:60]!r}; rename one of them.")
        if not all(name.strip() for name in self.names):
            raise InputError(f"{self.where}: a specimen has no name; name all of them.")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def dimensions(self) -> int:
        """2 or 3."""
        return int(self.points.shape[2])

    @property
    def observed(self) -> BoolArray:
        """(N, L) whether a landmark is there."""
        return np.logical_not(np.logical_or.reduce(np.isnan(self.points), axis=2))


def marked_missing(points: FloatArray, names: Sequence[str]) -> tuple[FloatArray, tuple[str, ...]]:
    """Return points (N, L, D) with not-a-number for all coordinates of missing landmarks, and sentences on them.

    A landmark is missing if one of its coordinates is not-a-number, or all are one of the codes of digitising programs.
    """
    points, notes = points.copy(), list[str]()
    lacking = np.isnan(points)
    partly = lacking.any(axis=2) & ~lacking.all(axis=2)
    points[partly] = np.nan
    same = (points == points[:, :, :1]).all(axis=2)
    codes = [code for code in _MISSING_CODES if (same & (points[:, :, 0] == code)).any()]
    negative = (points < 0) & ~(same & np.isin(points[:, :, 0], (*_MISSING_CODES, *_MISSING_BELOW_ZERO)))[:, :, None]
    codes += [code for code in _MISSING_BELOW_ZERO if not negative.any() and (same & (points[:, :, 0] == code)).any()]
    coded = same & np.isin(points[:, :, 0], codes)
    points[coded] = np.nan
    for mask, reason in (
        (partly, "lack one of their coordinates and are taken as missing"),
        (coded, f"with the coordinates {' or '.join(f'{code:g}' for code in codes)} are taken as missing"),
    ):
        if mask.any():
            affected = [names[int(row)] for row in np.unique(np.nonzero(mask)[0])]
            notes.append(f"{int(mask.sum())} landmarks of {first_names(affected, _NAMED)} {reason}.")
    return points, tuple(notes)


def slider_numbers(numbers: npt.NDArray[Any], landmarks: int, where: Path) -> IntArray:
    """Return the numbers of semilandmarks, (M, 3) or (S,) from 1, counted from 0.

    Raises:
        FileFormatError: a number that is no landmark, or a row with a landmark twice.
    """
    whole = np.asarray(numbers, dtype=np.float64)
    bad = whole[~((whole >= 1) & (whole <= landmarks) & (whole == np.floor(whole)))]
    if bad.size:
        raise damage_error(where, f"{bad.flat[0]:g} is no number of a landmark, which go from 1 to {landmarks}")
    if whole.ndim == 2 and any(len(set(row)) < len(row) for row in whole.tolist()):
        raise damage_error(where, "a row of before, slide, after has one landmark twice")
    return (whole - 1).astype(np.int32)
