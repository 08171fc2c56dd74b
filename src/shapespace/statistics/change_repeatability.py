"""Repeatability from rescans: within-subject standard deviation, smallest detectable change and ICC."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from shapespace.geometry.normals import vertex_areas
from shapespace.geometry.similarity import fit_similarity
from shapespace.reprs import short_repr
from shapespace.statistics.change_maps import AlignedVisits, swept_mm3
from shapespace.types import FloatArray, IntArray, Mesh, SurfaceLandmarks

SMALLEST = 1.96 * float(np.sqrt(2.0))
"""Factor from the within-subject standard deviation to the smallest detectable change between two scans."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Repeatability:
    """Noise of one scan, estimated from rescans after the alignment used for the changes.

    Args:
        scans: number of scans of visits with rescans.
        visits: number of visits with rescans.
        freedom: degrees of freedom, scans less visits.
        within_mm: (V,) within-subject standard deviation along the normals.
        volumes_within_mm3: (P,) standard deviation of the volume that each part sweeps, the complete surface first.
        landmarks_within_mm: (L,) standard deviation of each landmark: root of the summed variances along the axes.
        icc: (V,) intraclass correlation of each vertex between people, all three axes; NaN without two people.
        shape_icc: intraclass correlation of all vertices together.
        volume_icc: intraclass correlation of the volume between the surface and the mean.
    """

    scans: int
    visits: int
    freedom: int
    within_mm: FloatArray
    volumes_within_mm3: FloatArray
    landmarks_within_mm: FloatArray
    icc: FloatArray
    shape_icc: float
    volume_icc: float

    __repr__ = short_repr

    @property
    def smallest_mm(self) -> FloatArray:
        """(V,) smallest detectable change, 1.96 sqrt(2) times the standard deviation."""
        return SMALLEST * self.within_mm  # S22

    @property
    def volumes_smallest_mm3(self) -> FloatArray:
        """(P,) smallest detectable change of the volumes."""
        return SMALLEST * self.volumes_within_mm3

    @property
    def landmarks_smallest_mm(self) -> FloatArray:
        """(L,) smallest detectable change of each landmark."""
        return SMALLEST * self.landmarks_within_mm


@dataclass(eq=False)
class RepeatabilityEstimator:
    """Estimator of repeatability that takes one subject at a time.

    Args:
        reference: (V, 3) surface in whose frame people are compared.
        faces: (F, 3) triangles.
        landmarks: landmarks on the surfaces.
        parts: (P, V) parts with volumes, the complete surface first; 1 for their vertices and 0 for the others.
    """

    reference: FloatArray
    faces: IntArray
    landmarks: SurfaceLandmarks
    parts: FloatArray
    scans: int = 0
    visits: int = 0
    n_scans_of_subject: list[int] = field(default_factory=list[int])

    def __post_init__(self) -> None:
        V = len(self.reference)
        self._area = vertex_areas(Mesh(self.reference, self.faces))
        self._along, self._volume = np.zeros(V), np.zeros(len(self.parts))
        self._landmarks = np.zeros(len(self.landmarks))
        self._within, self._means, self._squares = np.zeros(V), np.zeros((V, 3)), np.zeros(V)
        self._volumes: list[FloatArray] = []

    def add(self, subject: AlignedVisits) -> None:
        """Add the visits of a subject that have rescans."""
        chosen = [scans for scans in subject.scans if len(scans) > 1]
        for scans in chosen:
            off = scans - scans.mean(axis=0)
            self._along += (np.einsum("nvd,vd->nv", off, subject.normals) ** 2).sum(axis=0)
            self._landmarks += (self.landmarks.interpolate(np.moveaxis(off, 1, 0)) ** 2).sum(axis=(1, 2))
            self._volume += _squares(self._swept(subject.means[0], scans) @ self.parts.T)
            self.scans += len(scans)
            self.visits += 1
        if chosen:
            self._add_subject(chosen[0])

    def _add_subject(self, scans: FloatArray) -> None:
        """Add one visit of a subject to the variation between subjects."""
        mean = scans.mean(axis=0)
        T = fit_similarity(mean, self.reference, self._area, with_scale=False)
        off = T.apply(mean) - self.reference
        self._within += ((scans - mean) ** 2).sum(axis=(0, 2))
        self._means += len(scans) * off
        self._squares += len(scans) * (off**2).sum(axis=1)
        posed = np.stack([T.apply(scan) for scan in scans])
        self._volumes.append(self._swept(self.reference, posed).sum(axis=1, keepdims=True))
        self.n_scans_of_subject.append(len(scans))

    def _swept(self, before: FloatArray, scans: FloatArray) -> FloatArray:
        return np.stack([swept_mm3(before, scan, self.faces) for scan in scans])

    def repeatability(self) -> Repeatability | None:
        """Return the repeatability; None without rescans."""
        freedom = self.scans - self.visits
        if not freedom:
            return None
        between = self._squares - (self._means**2).sum(axis=1) / sum(self.n_scans_of_subject)
        volumes = np.concatenate(self._volumes)
        within_volume = np.sum([_squares(own) for own in self._volumes], axis=0)
        sizes = self.n_scans_of_subject
        return Repeatability(
            scans=self.scans,
            visits=self.visits,
            freedom=freedom,
            within_mm=np.sqrt(self._along / freedom),  # S21
            volumes_within_mm3=np.sqrt(self._volume / freedom),
            landmarks_within_mm=np.sqrt(self._landmarks / freedom),
            icc=_icc(between, self._within, sizes),
            shape_icc=float(_icc(between.sum(keepdims=True), self._within.sum(keepdims=True), sizes)[0]),
            volume_icc=float(_icc(_squares(volumes) - within_volume, within_volume, sizes)[0]),
        )


def _icc(between: FloatArray, within: FloatArray, sizes: list[int]) -> FloatArray:
    """Return ICC(1,1) from sums of squares between and within groups of `sizes` (Shrout and Fleiss 1979)."""
    groups, n = len(sizes), sum(sizes)
    if groups < 2:
        return np.full(len(between), np.nan)
    k = (n - sum(size**2 for size in sizes) / n) / (groups - 1)
    b, w = between / (groups - 1), within / (n - groups)
    total = b + (k - 1) * w
    return np.divide(b - w, total, out=np.full(len(b), np.nan), where=total > 0)  # S23


def _squares(values: FloatArray) -> FloatArray:
    return np.asarray(((values - values.mean(axis=0)) ** 2).sum(axis=0), dtype=np.float64)
