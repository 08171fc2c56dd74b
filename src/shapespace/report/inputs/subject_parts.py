"""Parts of one subject in a model or a correspondence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from shapespace.model.shape_model import ShapeModel


@dataclass(frozen=True, eq=False)
class Parts:
    """Names of parts, and the part of each vertex.

    Args:
        names: names, in the order of the vertices.
        labels: (V,) uint8 index of the part of each vertex.
    """

    names: tuple[str, ...]
    labels: npt.NDArray[np.uint8]

    @staticmethod
    def of_counts(counts: Mapping[str, int]) -> Parts | None:
        """Return the parts with these numbers of vertices; None if there are none."""
        labels = np.repeat(np.arange(len(counts), dtype=np.uint8), list(counts.values()))
        return Parts(tuple(counts), labels) if counts else None

    @staticmethod
    def of(model: ShapeModel) -> Parts | None:
        """Return the parts of a model; None if it has one structure."""
        return Parts.of_counts(model.part_counts)
