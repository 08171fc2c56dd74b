"""Rigid alignment of the surfaces of one subject at two times by the unchanged part, which is given or estimated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import gammaincinv

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.landmarks.landmark_io import read_region
from shapespace.model.shape_model import region_vertices
from shapespace.types import FloatArray, IntArray, Similarity, SurfaceLandmarks

SEARCHED = 1500
"""Number of vertices among which the stable part is searched."""
KEPT_SHARE = 0.4
"""Share of the surface that must be unchanged, so that it can be found."""
NEAR_MM = 10.0
"""Largest distance of vertices from a landmark, by default."""
_PATCHES, _PATCH_SHARE = 24, 0.15  # patches that alignments start from, and their share of the points
_FIRST_STEPS, _GO_ON, _STEPS = 3, 4, 20
"""Steps of all starts, number of the best starts that continue, and their steps."""
_FEWEST = 3  # vertices that determine a rigid transformation
_CUTOFF = 5.5
"""Number of standard deviations beyond which residuals have no weight: Tukey's biweight, 95 % efficient in 3-D."""
_ROUNDS = 10  # reweighting iterations
_SMALLEST = 1e-9  # share of the size; keeps the spread of identical surfaces above zero


def stable_vertices(cohort: Cohort, stable: str | Path | Sequence[int]) -> IntArray | None:
    """Return the vertices that carry the alignment, each once; None if they are to be found.

    Args:
        cohort: cohort of the surfaces.
        stable: `auto` finds them, `all` takes all; the name of a region of the model; a file of vertices;
            `landmarks:NAME,NAME,...`, which may end in a radius in mm, for the vertices near these; or the vertices.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is no list of vertices.
        InputError: there is no such region, landmark, file or vertex, or fewer than three vertices.
    """
    if not isinstance(stable, (str, Path)):
        return _check_enough_vertices(region_vertices(stable, cohort.n_vertices, "stable"), "those given")
    text = str(stable)
    if text == "auto":
        return None
    if text == "all":
        return np.arange(cohort.n_vertices, dtype=np.int32)
    if text.startswith("landmarks:"):
        return _check_enough_vertices(_near_landmarks(cohort, text), text)
    regions: Mapping[str, IntArray] = {} if cohort.fitted is None else cohort.fitted.model.regions
    if text in regions:
        return _check_enough_vertices(regions[text], text)
    if not Path(text).is_file():
        known = f"the model's regions are {', '.join(regions)}" if regions else "there is no model with regions"
        raise InputError(
            f"There is no stable region {text!r} ({known}), and no such file; give auto, all, a file of vertices, or "
            "landmarks:NAME,NAME."
        )
    return _check_enough_vertices(region_vertices(read_region(text), cohort.n_vertices, text), text)


def _near_landmarks(cohort: Cohort, text: str) -> IntArray:
    words = [word.strip() for word in text.removeprefix("landmarks:").split(",")]
    radius_mm = NEAR_MM
    if len(words) > 1 and words[-1].replace(".", "", 1).isdecimal():
        radius_mm = float(words.pop())
    known = cohort.landmarks or SurfaceLandmarks()
    lacking = next((word for word in words if word not in known), None)
    if lacking is not None:
        there = ", ".join(sorted(known)) or "none"
        raise InputError(f"There is no landmark {lacking[:40]!r} to align by; the surfaces have {there}.")
    places = known.select(words).interpolate(cohort.reference)
    away = np.linalg.norm(cohort.reference[:, None] - places, axis=2).min(axis=1)
    return np.flatnonzero(away <= radius_mm).astype(np.int32)


def _check_enough_vertices(vertices: IntArray, name: str) -> IntArray:
    if len(vertices) < _FEWEST:
        raise InputError(f"The stable region {name} has {len(vertices)} vertices, and three are the least.")
    return vertices


def align_by(moving: FloatArray, fixed: FloatArray, area: FloatArray, stable: IntArray | None) -> tuple[
    Similarity, FloatArray
]:  # fmt: skip
    """Return the rigid motion of `moving` onto `fixed` by the stable part, and the weights (V,) of the vertices in it.

    Args:
        moving: (V, 3) vertices, mm.
        fixed: (V, 3) corresponding vertices, mm.
        area: (V,) area of each vertex.
        stable: stable vertices; None finds them (`align_robustly`).

    Raises:
        InputError: the stable vertices lie on a line.
    """
    if stable is None:
        return align_robustly(moving, fixed, area)
    weights = np.zeros(len(fixed))
    weights[stable] = area[stable]
    return fit_similarity(moving, fixed, weights, with_scale=False), weights


def align_robustly(moving: FloatArray, fixed: FloatArray, area: FloatArray) -> tuple[Similarity, FloatArray]:
    """Return the rigid motion of `moving` onto `fixed` by the part that keeps its shape, and the vertex weights (V,).

    Least trimmed squares (Rousseeuw and Van Driessen, Data Mining and Knowledge Discovery 12, 2006): starting from all
    points and from patches, fits alternate with the selection of the `KEPT_SHARE` of the surface that is nearest; the
    start with the smallest final distance wins. Tukey's biweight with the spread of this fit then includes all
    unchanged vertices.

    Args:
        moving: (V, 3) vertices, mm.
        fixed: (V, 3) corresponding vertices, mm.
        area: (V,) area of each vertex, its weight.

    Raises:
        InputError: the vertices lie on a line.
    """
    if np.count_nonzero(area) > SEARCHED:
        some = np.random.default_rng(0).choice(len(fixed), SEARCHED, replace=False, p=area / area.sum())
        p, q, a = moving[some], fixed[some], np.ones(SEARCHED)
    else:
        p, q, a = moving, fixed, area
    a = a / a.sum()
    ends = sorted((_fit_trimmed(p, q, a, start, _FIRST_STEPS) for start in _starts(q)), key=lambda end: end.squares)
    T = min((_fit_trimmed(p, q, a, end.chosen, _STEPS) for end in ends[:_GO_ON]), key=lambda end: end.squares).T
    residual = np.linalg.norm(T.apply(p) - q, axis=1)
    size_mm = float(np.linalg.norm(np.ptp(fixed, axis=0)))
    order = np.argsort(residual, kind="stable")
    quantile = float(residual[order][np.searchsorted(np.cumsum(a[order]), KEPT_SHARE)])
    spread_mm = max(quantile / float(np.sqrt(2 * gammaincinv(1.5, KEPT_SHARE))), _SMALLEST * size_mm)
    weights = area
    for _ in range(_ROUNDS):
        residual = np.linalg.norm(T.apply(moving) - fixed, axis=1)
        weights = area * np.clip(1 - (residual / (_CUTOFF * spread_mm)) ** 2, 0.0, None) ** 2
        T = fit_similarity(moving, fixed, weights, with_scale=False)
    return T, weights


def _starts(points: FloatArray) -> list[IntArray]:
    """Return all indices of `points` (n, 3), and those of patches about points that lie far apart."""
    count = max(round(_PATCH_SHARE * len(points)), _FEWEST + 1)
    seed = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())
    away = np.full(len(points), np.inf)
    starts = [np.arange(len(points), dtype=np.int32)]
    for _ in range(_PATCHES):
        distance = np.linalg.norm(points - points[seed], axis=1)
        starts.append(np.argsort(distance, kind="stable")[:count].astype(np.int32))
        away = np.minimum(away, distance)
        seed = int(away.argmax())
    return starts


class _TrimmedFit(NamedTuple):
    """A rigid motion, the points that it brings nearest, and their mean squared distance."""

    T: Similarity
    chosen: IntArray
    squares: float


def _fit_trimmed(p: FloatArray, q: FloatArray, area: FloatArray, chosen: IntArray, steps: int) -> _TrimmedFit:
    """Alternate fits and selections of the nearest `KEPT_SHARE` of the points, from those `chosen`, until both stop."""
    T, squares = Similarity.identity(), np.inf
    for _ in range(steps):
        try:
            T = fit_similarity(p[chosen], q[chosen], area[chosen], with_scale=False)
        except InputError:  # a patch on a line determines no rotation
            break
        residual = ((T.apply(p) - q) ** 2).sum(axis=1)
        order = np.argsort(residual, kind="stable")
        nearest = order[: int(np.searchsorted(np.cumsum(area[order]), KEPT_SHARE)) + 1].astype(np.int32)
        now = float(area[nearest] @ residual[nearest] / area[nearest].sum())
        if now >= squares:
            break
        squares, chosen = now, nearest
    return _TrimmedFit(T, chosen, squares)
