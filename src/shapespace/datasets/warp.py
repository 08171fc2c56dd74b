"""Smooth random deformations at several scales, for variation beyond a fixed set of shapes.

The shape is stretched along its axes, and displaced by Gaussian processes with squared-exponential covariance. Each is
a sum of many cosine waves in space (random Fourier features: Rahimi and Recht, NIPS 2007), so what lies close together
moves together: lips stay closed, and no triangle turns over as long as a field is far weaker than it is long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.geometry.mirror_plane import FLIP
from shapespace.types import FloatArray, IntArray

_WAVES = 96  # random Fourier features of the field


@dataclass(frozen=True)
class Warp:
    """Amplitude and length scales of a random deformation, mm for a head.

    Args:
        stretch: standard deviation of the logarithm of the stretch along each axis; the volume stays.
        fields: (length over which a field is smooth, its standard deviation along each axis), from coarse to fine.
        lopsided: of the part that differs from side to side, beside that of the part both sides share.
    """

    stretch: float = 0.04
    fields: tuple[tuple[float, float], ...] = ((60.0, 2.6), (25.0, 1.4), (12.0, 0.6))
    lopsided: float = 0.3

    def draw(self, x: FloatArray, mirror: IntArray, rng: np.random.Generator) -> FloatArray:
        """Draw displacements (V, 3) of the vertices `x` (V, 3), mm.

        Args:
            x: x to the left, so that a change of sign mirrors it.
            mirror: (V,) the vertex on the other side.
            rng: the only source of chance.
        """
        stretch = np.exp(self.stretch * rng.standard_normal(3))
        out = x * (stretch / stretch.prod() ** (1 / 3) - 1.0)
        for length_mm, stddev_mm in self.fields:
            component = _field(x, length_mm, rng)
            other = component[mirror] * FLIP
            out += stddev_mm / np.sqrt(2.0) * (component + other + self.lopsided * (component - other))
        return out


def _field(x: FloatArray, length_mm: float, rng: np.random.Generator) -> FloatArray:
    """Return (V, 3) of variance 1 along each axis, smooth over `length_mm`."""
    waves, phases = rng.standard_normal((_WAVES, 3)) / length_mm, rng.uniform(0.0, 2.0 * np.pi, _WAVES)
    heights = rng.standard_normal((_WAVES, 3))
    return np.asarray(np.sqrt(2.0 / _WAVES) * np.cos(x @ waves.T + phases) @ heights, dtype=np.float64)
