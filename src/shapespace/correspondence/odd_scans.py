"""Scans that differ from the others in size, unit, side or kind, found before a correspondence by cheap measures."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from shapespace.correspondence.correspondence_result import ENOUGH_TO_COMPARE, LEAST_RATIO, OTHER_SIZE, unit_ratios
from shapespace.geometry.mirror_plane import ASYMMETRIC, FLIP
from shapespace.geometry.normals import face_areas, face_vectors, faces_of, rms_size
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh

_UNSEEN = 6.0
"""Share of the range of N sizes by which the sizes of more scans may be beyond it on each side, times N; the share is a
half at least. With it, a wrong unit was named in 2 of 10,500 simulated collections (benchmarks/odd_scans.py)."""
_POINTS = 2000  # of a surface; the distances of 1000 x 1000 pairs
_QUANTILES = (np.arange(16) + 0.5) / 16
_ODD_SHAPE, _GAP = 6.0, 2.0
"""Distance of a profile from that of the others, in medians of all distances, from which a shape is odd, and ratio by
which it is farther than those of the usual shapes. Of 24 femora, molars, spleens or hippocampi the largest distance was
2.6, and that of other objects at least 6.8, except between molars and spleens, whose profiles are alike. In collections
of 4 to 24, one of another kind was found in 79 to 100 %, and 1 % of pure ones had a false finding; of simulated bones,
organs and faces 5 %, 3 % and none."""

_SAMPLED, _COARSE, _MATCHED = 500, 60, 100  # points of a sample, those that rank starts, and those that are matched
_STARTS, _ITERATIONS = 2, 5  # poses that are refined, and steps of each
_LEAST_SIDES = 10
"""Number of scans from which their sides are judged: two anchors agree by chance on the sides of all with a probability
of 0.4 %. In collections of 10 to 24 femora or hippocampi, all mirrored scans were named; a scan was named wrongly in at
most 0.8 % of collections of molars, and in fewer of spleens and of simulated bones, organs and faces."""
_AXES = np.array(
    [np.diag(signs)[list(order)] for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
)
_TURNS = _AXES[np.linalg.det(_AXES) > 0]


@dataclass(frozen=True, eq=False)
class ScanMeasures:
    """Size and coarse shape of a scan, independent of its pose and of its triangles.

    Args:
        size: RMS distance of the surface from its centroid, in the unit of the scan.
        profile: (16,) quantiles of the distances between points of the surface, as shares of the size.
    """

    size: float
    profile: FloatArray

    @staticmethod
    def of(mesh: Mesh) -> ScanMeasures:
        """Measure a repaired scan at random points of its surface (D2 of Osada et al., Shape Distributions, 2002)."""
        rng = np.random.default_rng(0)
        if mesh.faces is None:
            points = rng.choice(mesh.vertices, _POINTS)
        else:
            areas = face_areas(mesh)
            corners = mesh.vertices[mesh.faces[rng.choice(len(areas), _POINTS, p=areas / areas.sum())]]
            points = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), _POINTS), corners)
        size = rms_size(points)
        return ScanMeasures(size, np.quantile(cdist(points[: _POINTS // 2], points[_POINTS // 2 :]), _QUANTILES) / size)


@dataclass(frozen=True)
class OddScan:
    """A scan that differs from the others.

    Args:
        factor: size relative to the median of the others; 1 if the size is usual.
        unit: the only unit in which it would have the size of the others; empty if there is none.
        shape_ratio: difference of its coarse shape from the others, relative to the usual difference; 1 if it is usual.
    """

    factor: float = 1.0
    unit: str = ""
    shape_ratio: float = 1.0

    @property
    def text(self) -> str:
        """The finding as a sentence."""
        parts: list[str] = []
        if self.factor != 1.0:
            size = f"{max(self.factor, 1.0 / self.factor):.4g} times {'larger' if self.factor > 1 else 'smaller'}"
            parts.append(f"{size} than the median of the others")
        if self.unit:
            parts.append(f"in {self.unit} it would have their size")
        if self.shape_ratio != 1.0:
            parts.append(
                f"its shape differs from the others {self.shape_ratio:.2g} times as much as usual: look whether it is "
                "another kind of object, or incomplete"
            )
        text = "; ".join(parts)
        return f"{text[:1].upper()}{text[1:]}."


def find_odd_scans(measures: Sequence[ScanMeasures], units: Sequence[str]) -> dict[int, OddScan]:
    """Return the scans that differ from the others, by their index; none of fewer than four scans.

    A size is odd if it is more than twice or less than half the median of the others, and farther from their sizes than
    these are from each other. A unit is named if this unit alone would bring the size among those of the
    others, and if the difference cannot be natural: the shape is usual, and the gap to the others is wider than
    their range, also that of more scans like them.

    Args:
        measures: measures of the scans.
        units: unit of each scan, a name of `MM_PER_UNIT`.
    """
    if len(measures) < ENOUGH_TO_COMPARE:
        return {}
    mm = np.array([MM_PER_UNIT[unit] for unit in units])
    relative, ratios = unit_ratios((mm * [measure.size for measure in measures]).tolist())
    sizes, shape_ratios = np.log(relative * ratios), _shape_ratios(np.stack([measure.profile for measure in measures]))
    usual = np.flatnonzero(ratios == 1.0)
    if not len(usual):
        return {}
    lows, highs, middles = (np.full(len(sizes), of(sizes[usual])) for of in (np.min, np.max, np.median))
    if len(usual) > 1:
        order = usual[sizes[usual].argsort()]
        lows[order[0]], highs[order[-1]] = sizes[order[1]], sizes[order[-2]]
        middles[usual] = _medians_of_others(sizes[usual, None])[:, 0]
    gaps, widths = np.maximum(lows - sizes, sizes - highs), highs - lows
    odd_sizes = (gaps > widths) & (np.abs(sizes - middles) > np.log(OTHER_SIZE))
    found: dict[int, OddScan] = {}
    for k in np.flatnonzero(odd_sizes | (shape_ratios != 1.0)).tolist():
        low, high, gap, width, shape_ratio = (float(values[k]) for values in (lows, highs, gaps, widths, shape_ratios))
        margin = width * max(0.5, _UNSEEN / max(len(usual) - (ratios[k] == 1.0), 1))
        changes = {unit: float(np.log(length / mm[k])) for unit, length in MM_PER_UNIT.items()}
        fitting = [
            unit
            for unit, change in changes.items()
            if low - margin <= sizes[k] + change <= high + margin and abs(change) > np.log(LEAST_RATIO)
        ]
        is_clear = gap > width + 2.0 * margin and shape_ratio == 1.0 and len(fitting) == 1
        unit = fitting[0] if odd_sizes[k] and is_clear else ""
        found[k] = OddScan(float(np.exp(sizes[k] - middles[k])) if odd_sizes[k] else 1.0, unit, shape_ratio)
    return found


def _shape_ratios(profiles: FloatArray) -> FloatArray:
    """Return (N,) distances of profiles (N, 16) from the others' median, in medians of all; 1 for usual ones."""
    distances = np.sqrt(((profiles - _medians_of_others(profiles)) ** 2).mean(axis=1))
    distances /= max(float(np.median(distances)), 1e-12)
    ordered = np.asarray(np.sort(distances), dtype=np.float64)
    beyond = ordered[1:][(ordered[1:] > _GAP * ordered[:-1]) & (ordered[1:] > _ODD_SHAPE)]
    return np.where(distances >= (beyond[0] if len(beyond) else np.inf), distances, 1.0)


def _medians_of_others(values: FloatArray) -> FloatArray:
    """Return the median of the other rows for each row of `values` (N, K), column by column."""
    order = values.argsort(axis=0)
    rank, ordered = order.argsort(axis=0), np.take_along_axis(values, order, axis=0)
    middles = ((len(values) - 2) // 2, (len(values) - 1) // 2)
    low, high = (np.take_along_axis(ordered, middle + (rank <= middle), axis=0) for middle in middles)
    return 0.5 * (low + high)


def side_sample(mesh: Mesh) -> FloatArray:
    """Return points of a surface and their normals, (500, 6), centred and scaled to an RMS size of 1, for
    `find_mirrored_scans`. They are random in each scan: on equal triangles they would be at the same places.
    """
    rng = np.random.default_rng(zlib.crc32(mesh.vertices.tobytes()))
    vectors = face_vectors(mesh.vertices, faces_of(mesh))
    areas = np.linalg.norm(vectors, axis=1)
    chosen = rng.choice(len(areas), _SAMPLED, p=areas / areas.sum())
    points = np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), _SAMPLED), mesh.vertices[faces_of(mesh)[chosen]])
    points = points - points.mean(axis=0)
    return np.hstack([points / rms_size(points), vectors[chosen] / areas[chosen, None]])


class _Side:
    """A sample of a scan with its principal axes and nearest points."""

    def __init__(self, sample: FloatArray) -> None:
        self.points, self.normals = np.hsplit(np.asarray(sample, dtype=np.float64), 2)
        self.near = KDTree(self.points)
        self.axes = np.linalg.eigh(self.points.T @ self.points)[1]
        self.axes[:, 2] *= np.linalg.det(self.axes)

    def nearest(self, places: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the distances (S, N) of places (S, N, 3), and the points and normals (S, N, 3) that are nearest."""
        distances, k = self.near.query(places)
        return np.asarray(distances), self.points[k], self.normals[k]

    def distance(self, other: _Side) -> float:
        """Return the mean distance between two surfaces in their best pose: rigid ICP from some of the 24 poses that
        align their principal axes."""
        R = self.axes @ _TURNS @ other.axes.T
        distances = self.nearest(other.points[:_COARSE] @ R.transpose(0, 2, 1))[0].mean(axis=1)
        R, t = R[distances.argsort()[:_STARTS]], np.zeros((_STARTS, 3))
        own, theirs = self.points[:_MATCHED], other.points[:_MATCHED]
        for _ in range(_ITERATIONS):
            theirs_mapped, own_mapped = theirs @ R.transpose(0, 2, 1) + t[:, None], (own - t[:, None]) @ R
            (forward, y, _), (backward, x, _) = self.nearest(theirs_mapped), other.nearest(own_mapped)
            a, b = (np.concatenate(np.broadcast_arrays(*points), axis=1) for points in ((y, own), (theirs, x)))
            distances = np.concatenate([forward, backward], axis=1)
            w = (1.0 + (distances / (2.0 * np.median(distances, axis=1, keepdims=True))) ** 2)[..., None] ** -2
            mean_a, mean_b = ((w * c).sum(axis=1, keepdims=True) / w.sum(axis=1, keepdims=True) for c in (a, b))
            u, _, vt = np.linalg.svd((w * (a - mean_a)).transpose(0, 2, 1) @ (b - mean_b))
            u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
            R, t = u @ vt, (mean_a - mean_b @ (u @ vt).transpose(0, 2, 1))[:, 0]
        theirs_mapped, own_mapped = theirs @ R.transpose(0, 2, 1) + t[:, None], (own - t[:, None]) @ R
        matches = ((theirs_mapped, self.nearest(theirs_mapped)), (own_mapped, other.nearest(own_mapped)))
        to_planes = [np.abs(((places - p) * n).sum(axis=-1)).mean(axis=1) for places, (_, p, n) in matches]
        return float(np.sum(to_planes, axis=0).min())


def find_mirrored_scans(samples: Sequence[FloatArray]) -> list[int]:
    """Return the scans that are mirror images of most, by their index; none if the scans do not show it clearly.

    Each scan and its mirror image are compared with two scans. A scan is named only if both comparisons agree on the
    sides of all scans, each by more than the differences of symmetric objects.

    Args:
        samples: sample of each scan, see `side_sample`.
    """
    count = len(samples)
    if count < _LEAST_SIDES:
        return []
    sides, images = ([_Side(sample * factors) for sample in samples] for factors in (1.0, np.tile(FLIP, 2)))
    anchors = (0, count // 2)
    evidence = np.array(
        [
            [
                np.inf
                if side is sides[anchor]
                else np.log(sides[anchor].distance(image) / sides[anchor].distance(side))
                for side, image in zip(sides, images, strict=True)
            ]
            for anchor in anchors
        ]
    )
    first: FloatArray = np.sign(evidence[0])
    second: FloatArray = np.sign(evidence[1]) * first[anchors[1]]
    second[anchors[1]] = first[anchors[1]]
    if np.abs(evidence).min() <= ASYMMETRIC or (first != second).any():
        return []
    return np.flatnonzero(first == (1.0 if 2 * (first < 0).sum() > count else -1.0)).tolist()
