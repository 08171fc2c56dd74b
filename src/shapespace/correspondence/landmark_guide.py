"""Landmarks in a correspondence: the position of each named point on the template, and its pull on a registration.

A landmark is a soft constraint. After each step of `register`, the offset between the landmarks of a scan and their
positions on the surface is spread over the surface as a Gaussian process predicts it (C8 of docs/correspondence.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapespace.correspondence.harmonics import Harmonics
from shapespace.errors import InputError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.landmark_placement import STRAY, landmarks_in_frame_of, place_landmarks
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, Mesh, Similarity, SurfaceLandmarks

FEWEST = 3
"""Number of landmarks: fewer do not determine a pose."""
_OFF_SHARE = 0.5  # share of the range of deformations that a landmark of the stated uncertainty may move freely
_AGREE = 0.2
"""RMS distance of posed landmarks from those of the template, as a share of their spread, that contradicts them."""
# ratio of landmark distances below which the mirror image is the better match, so that noise does not decide
_MIRROR_SHARE = 0.5
_FIRMEST = 1e-3
"""Smallest s / a: with 0, two landmarks in one position leave (C8) without a solution."""
_SURE = 3.0
"""Distance from a line, in units of the uncertainty, below which landmarks do not determine the rotation about it."""
_LISTED = 3  # landmarks in a sentence


class MirroredLandmarksError(InputError):
    """The landmarks of a scan are those of a mirror image."""


@dataclass(frozen=True, eq=False)
class ScanLandmarks:
    """Landmarks that scan and template share.

    Args:
        places: positions of the L landmarks on the template.
        points: (L, 3) positions in the scan's frame.
        uncertainty: standard deviation, as a share of the template's size.
    """

    places: SurfaceLandmarks
    points: FloatArray
    uncertainty: float

    @staticmethod
    def shared(places: SurfaceLandmarks, scan: Mesh, uncertainty: float) -> ScanLandmarks | None:
        """Return those of `places` that `scan` has too; None without shared landmarks."""
        names = [name for name in places.names if name in scan.landmarks]
        if not names:
            return None
        return ScanLandmarks(places.select(names), np.stack([scan.landmarks[name] for name in names]), uncertainty)

    def transformed(self, T: Similarity) -> ScanLandmarks:
        """Return the same landmarks with their points transformed by `T`."""
        return ScanLandmarks(self.places, T.apply(self.points), self.uncertainty)

    def reflected(self) -> ScanLandmarks:
        """Return the landmarks of the mirror image of the scan."""
        return ScanLandmarks(self.places, self.points * FLIP, self.uncertainty)

    def pose(self, vertices: FloatArray) -> Similarity | None:
        """Return T_scan_template from the landmarks; None if they are too few, or nearly on a line.

        Raises:
            MirroredLandmarksError: the landmarks are those of a mirror image.
            InputError: the landmarks contradict the template.
        """
        if len(self.points) < FEWEST:
            return None
        own = self.places.interpolate(vertices)
        across = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(own))
        if across < _SURE * self.uncertainty * rms_size(vertices):
            return None
        try:
            T = fit_similarity(own, self.points)
            mirrored = fit_similarity(own * FLIP, self.points)
        except InputError:
            return None
        spread = float(np.sqrt(((self.points - self.points.mean(axis=0)) ** 2).sum(axis=1).mean()))
        off = _rms(T.apply(own) - self.points) / spread
        other = _rms(mirrored.apply(own * FLIP) - self.points) / spread
        if len(self.points) > FEWEST and off > _AGREE:
            if other < _MIRROR_SHARE * off:
                raise MirroredLandmarksError(
                    "mirrored: its landmarks are those of a mirror image of the other scans; reflect it, or check "
                    "their names"
                )
            raise InputError(
                f"its landmarks lie {100 * off:.0f} % of their spread from those of the others; check their names"
            )
        return T

    def correction(self, x: FloatArray, harmonics: Harmonics, range_mm: float, size_mm: float) -> FloatArray:
        """Return the (V, 3) movement (C8) of the surface `x` (V, 3), in whose frame the points must be."""
        functions = self.places.interpolate(harmonics.functions)
        attenuated = functions * harmonics.attenuation(range_mm)
        kernel = attenuated @ functions.T
        ratio = max(self.uncertainty * size_mm / (_OFF_SHARE * range_mm), _FIRMEST)
        covariance = kernel + ratio**2 * np.diag(kernel).mean() * np.eye(len(kernel))
        offsets = self.points - self.places.interpolate(x)
        weights: FloatArray = np.asarray(np.linalg.solve(covariance, offsets), dtype=np.float64)
        return harmonics.functions @ (attenuated.T @ weights)  # C8

    def rms_distance(self, vertices: FloatArray) -> float:
        """Return the RMS distance between the points and their positions on `vertices` (V, 3), in one frame."""
        return _rms(self.places.interpolate(vertices) - self.points)


def stray_landmarks(scan: Mesh) -> dict[str, float]:
    """Return the landmarks far off the surface of `scan`: name -> distance off its surface, as a share of its size."""
    if not scan.landmarks:
        return {}
    distance = build_engine(scan).query(np.stack(list(scan.landmarks.values()))).distance / rms_size(scan.vertices)
    return {name: float(share) for name, share in zip(scan.landmarks, distance, strict=True) if share > STRAY}


def with_own_landmarks(scan: Mesh) -> tuple[Mesh, list[str]]:
    """Return `scan` with the landmarks near its surface, in its frame, and sentences on rotated and excluded ones."""
    points, notes = landmarks_in_frame_of(scan, scan.landmarks)
    scan = replace(scan, landmarks=points)
    off = stray_landmarks(scan)
    if not off:
        return scan, [*notes]
    named = ", ".join(f"{name} ({share:.2g} times its size)" for name, share in list(off.items())[:_LISTED])
    sentence = f"Landmarks that lie far off its surface are excluded: {named}."
    if len(off) == len(points):
        sentence = (
            f"Its landmarks are excluded: they lie {min(off.values()):.2g} times its size off its surface, or more; "
            "check their unit and frame."
        )
    own = {name: point for name, point in points.items() if name not in off}
    return replace(scan, landmarks=own), [*notes, sentence]


def contradicts_most(template: Mesh, scans: Iterable[Mesh], uncertainty: float) -> bool:
    """Return whether most of the `scans` whose landmarks can be compared with those of `template` contradict them."""
    places = place_landmarks(template, template.landmarks)
    shared = [ScanLandmarks.shared(places, scan, uncertainty) for scan in scans]
    refused, agreeing = 0, 0
    for landmarks in shared:
        try:
            agreeing += landmarks is not None and landmarks.pose(template.vertices) is not None
        except InputError:
            refused += 1
    return refused > agreeing


def _rms(difference: FloatArray) -> float:
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def consensus_landmarks(mean: Mesh, shapes: Sequence[tuple[FloatArray, Mapping[str, FloatArray]]]) -> SurfaceLandmarks:
    """Return the landmarks of shapes on `mean`: the median of their positions on shapes that agree with most others.

    Args:
        mean: mesh with triangles.
        shapes: (V, 3) vertices of each shape, and its landmarks in the same frame.
    """
    placed = [(place_landmarks(mean.with_vertices(vertices), points), points) for vertices, points in shapes if points]
    names = list(dict.fromkeys(name for _, points in placed for name in points))
    if not names:
        return SurfaceLandmarks()
    positions = np.full((len(placed), len(names), 3), np.nan)
    for own, (places, points) in zip(positions, placed, strict=True):
        own[[names.index(name) for name in points]] = places.interpolate(mean.vertices)
    distance = np.sqrt(np.array([np.nansum((positions - own) ** 2, axis=(1, 2)) for own in positions]))
    shared = np.array([np.isfinite(positions + own).all(axis=2).sum(axis=1) for own in positions])
    contrary = distance > _AGREE * rms_size(mean.vertices) * np.sqrt(shared)
    consistent = ~contrary[((shared > 0) & ~contrary).sum(axis=1).argmax()]
    medians: dict[str, FloatArray] = {}
    for name, points in zip(names, positions[consistent].swapaxes(0, 1), strict=True):
        if np.isfinite(points).any():
            medians[name] = np.asarray(np.nanmedian(points, axis=0), dtype=np.float64)
    return place_landmarks(mean, medians)
