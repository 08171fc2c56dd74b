"""How a surface becomes the vector that PCA sees: the one place where shapes are flattened and restored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from shapespace.types import FloatArray


class Representation(Protocol):
    """Turns vertices into a vector and back; distances are always measured on decoded vertices."""

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return (..., D) from vertices (..., V, 3)."""
        ...

    def decode(self, vector: FloatArray) -> FloatArray:
        """Return vertices (..., V, 3) from (..., D)."""
        ...


class Vertices:
    """The paper's representation (eq 1): all coordinates, one vertex after the other, D = 3V."""

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return (..., 3V) from vertices (..., V, 3)."""
        return vertices.reshape(*vertices.shape[:-2], -1)

    def decode(self, vector: FloatArray) -> FloatArray:
        """Return vertices (..., V, 3) from (..., 3V)."""
        return vector.reshape(*vector.shape[:-1], -1, 3)


REPRESENTATIONS: Mapping[str, Callable[[], Representation]] = {"vertices": Vertices}
"""Representations by the name that a model file carries; B-spline control points will join here."""
