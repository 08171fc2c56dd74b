"""Colours of report and viewer, distinguishable with every common kind of colour blindness.

Both maps change evenly to the eye: they are drawn through a few colours in the space OKLab (Ottosson 2020) and stepped
at equal lengths. The sequential one is pale where nothing is wrong, so that a surface looks like a surface there, and
darkens all the way; the diverging one has a pale middle and arms of equal lightness.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.types import FloatArray, read_only

Colour: TypeAlias = tuple[float, float, float]
"""Red, green, blue in [0, 1], sRGB."""

CLAY: Colour = (0.80, 0.755, 0.715)
"""Colour of a surface without a map."""
# orange; colours of this group are sRGB from 0 to 1, and differ in lightness too
SCAN_COLOUR: Colour = (0.93, 0.66, 0.36)
MODEL_COLOUR: Colour = (0.36, 0.58, 0.80)  # blue
DENSE_COLOUR: Colour = (0.33, 0.66, 0.56)  # green
UNKNOWN_COLOUR: Colour = (0.66, 0.66, 0.66)
"""Colour of vertices without a value."""
WITHIN_COLOUR: Colour = (0.22, 0.53, 0.74)  # blue
BEYOND_COLOUR: Colour = (0.95, 0.58, 0.20)
"""The two sides of a threshold."""

REGION_COLOURS: Mapping[str, Colour] = MappingProxyType(
    {
        "followed": (0.36, 0.60, 0.80),
        "rejected": (0.80, 0.27, 0.16),
        "border": (0.96, 0.78, 0.28),
        "unseen": (0.80, 0.80, 0.80),
    }
)
"""Colours of the regions of the model in a fit, by the names of `shapespace.report.inputs.saved_fits.REGIONS`."""

# Okabe and Ito's colours, with a dark red in place of the yellow that white paper swallows.
CATEGORIES: tuple[Colour, ...] = (
    (0.000, 0.447, 0.698),
    (0.835, 0.369, 0.000),
    (0.000, 0.620, 0.451),
    (0.800, 0.475, 0.655),
    (0.902, 0.624, 0.000),
    (0.337, 0.706, 0.914),
    (0.000, 0.000, 0.000),
    (0.420, 0.080, 0.060),
)

PARTS: tuple[Colour, ...] = tuple(
    (int(name[:2], 16) / 255, int(name[2:4], 16) / 255, int(name[4:], 16) / 255)
    for name in ("77aadd", "eedd88", "ee6677", "228833", "aa3377", "bbbbbb", "99ddff", "cc79a7")
)
"""Colours of the parts of one subject, of Tol and of Okabe and Ito, in an order that keeps the first ones far apart."""

_TO_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_TO_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def oklab(srgb: npt.ArrayLike) -> FloatArray:
    """Return colours (..., 3) of sRGB in [0, 1] as lightness, green-red and blue-yellow of OKLab, (..., 3)."""
    srgb = np.asarray(srgb, dtype=np.float64)
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ _TO_CONES.T) @ _TO_LAB.T


def _srgb(lab: FloatArray) -> FloatArray:
    linear = np.clip((lab @ np.linalg.inv(_TO_LAB).T) ** 3 @ np.linalg.inv(_TO_CONES).T, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def _even_steps(anchors: npt.ArrayLike, count: int) -> FloatArray:
    """Return `count` colours (count, 3) of sRGB along `anchors` (n, 3) of OKLab, at equal steps to the eye."""
    anchors = np.asarray(anchors, dtype=np.float64)
    curve = _interpolate(np.linspace(0, len(anchors) - 1, 2001), np.arange(len(anchors)), anchors)
    # Corners in a map are seen as edges that the data do not have.
    n_steps = 150
    padded = np.concatenate([2 * curve[0] - curve[n_steps:0:-1], curve, 2 * curve[-1] - curve[-2 : -n_steps - 2 : -1]])
    window = np.hanning(2 * n_steps + 1) / np.hanning(2 * n_steps + 1).sum()
    for k in range(3):
        curve[:, k] = np.convolve(padded[:, k], window, mode="valid")
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    return _srgb(_interpolate(np.linspace(0, float(along[-1]), count), along, curve))


def _interpolate(positions: npt.NDArray[Any], known: npt.NDArray[Any], colours: FloatArray) -> FloatArray:
    return np.stack([np.interp(positions, known, colours[:, k]) for k in range(3)], axis=1)


def _diverging() -> FloatArray:
    middle, cold, warm = (
        oklab([_hex(name) for name in names])
        for names in (("f3f1ec",), ("a9cde6", "4f93c8", "235a9c", "14305f"), ("f3bb9a", "d9704c", "a5322f", "5c1220"))
    )
    # Equal distances from zero must look equally far, so both arms get the mean lightness of the two.
    cold[:, 0] = warm[:, 0] = (cold[:, 0] + warm[:, 0]) / 2
    arms = [_even_steps(np.concatenate([middle, arm]), 128) for arm in (cold, warm)]
    return read_only(np.concatenate([arms[0][::-1], arms[1]]))


def _hex(text: str) -> list[float]:
    return [int(text[k : k + 2], 16) / 255 for k in (0, 2, 4)]


_PALE_TO_DARK = ("f6f1e4", "f3cf8e", "e98f53", "c24a5c", "7a2669", "2b1250")
SEQUENTIAL = read_only(_even_steps(oklab([_hex(name) for name in _PALE_TO_DARK]), 256))
"""(256, 3) float64, sRGB in [0, 1]: pale for small, dark for large."""
DIVERGING = _diverging()
"""(256, 3) float64, sRGB in [0, 1]: blue for negative, pale for zero, red for positive."""


def as_list(colours: FloatArray, n: int = 64) -> list[list[float]]:
    """Return `n` colours of a map (N, 3), from its first to its last, as plain numbers for JavaScript.

    Raises:
        InputError: fewer than two are asked for, or the map does not have the shape (N, 3).
    """
    colours = np.asarray(colours, dtype=np.float64)
    if n < 2 or colours.ndim != 2 or colours.shape[1] != 3:
        raise InputError(f"A colour map must have the shape (N, 3), not {colours.shape}, and n be 2 or more, not {n}.")
    return np.round(_interpolate(np.linspace(0, len(colours) - 1, n), np.arange(len(colours)), colours), 4).tolist()


def as_hex(colour: Colour) -> str:
    """Return a colour as `#rrggbb`."""
    return "#" + "".join(f"{round(255 * min(max(part, 0.0), 1.0)):02x}" for part in colour)
