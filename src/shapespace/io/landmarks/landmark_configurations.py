"""Landmark configurations of many specimens: the same landmarks in the same order, in 2-D or 3-D."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, IntArray

_NO_SLIDERS = np.zeros((0, 3), dtype=np.int32)
_NO_POINTS = np.zeros(0, dtype=np.int32)


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
        repeated = [name for name in self.names if self.names.count(name) > 1]
        if repeated:
            raise InputError(f"{self.where}: two specimens are called {repeated[0][:60]!r}; rename one of them.")

    def __len__(self) -> int:
        return len(self.names)

    @property
    def dimensions(self) -> int:
        """2 or 3."""
        return int(self.points.shape[2])

    @property
    def observed(self) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """(N, L) whether a landmark is there."""
        return ~np.isnan(self.points).any(axis=2)
