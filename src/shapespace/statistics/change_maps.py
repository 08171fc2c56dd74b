"""Changes of a surface from visit to visit: displacement along its normals, volume swept, and their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.geometry.normals import face_vectors, vertex_areas, vertex_normals
from shapespace.geometry.similarity import fit_similarity, small_poses
from shapespace.statistics.change_align import align_by
from shapespace.statistics.change_visits import Visit
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, SurfaceLandmarks

_RIGID = 6
"""Number of rigid poses: rotations and translations."""


@dataclass(frozen=True, eq=False)
class AlignedVisits:
    """The scans of one subject, aligned by the stable part.

    Args:
        visits: visits of the subject.
        scans: (n, V, 3) surfaces of the scans of each visit, mm.
        means: (T, V, 3) mean surface of each visit, mm.
        normals: (V, 3) normals of the first mean surface.
        weights: (V,) weights of the vertices in the alignment of the last scan.
        observed: (V,) bool, whether all scans observe a vertex; None if they observe all.
    """

    visits: tuple[Visit, ...]
    scans: tuple[FloatArray, ...]
    means: FloatArray
    normals: FloatArray
    weights: FloatArray
    observed: BoolArray | None = None

    @property
    def along_mm(self) -> FloatArray:
        """(T, V) displacements from the first visit, along its normals."""
        return np.einsum("tvd,vd->tv", self.means - self.means[0], self.normals)


def align_visits(cohort: Cohort, visits: Sequence[Visit], stable: IntArray | None) -> AlignedVisits:
    """Align all scans of one subject to the first by the stable part.

    Raises:
        InputError: the stable vertices lie on a line.
    """
    faces = faces_in(cohort)
    fixed = cohort.vertices(visits[0].rows[0])
    area = vertex_areas(Mesh(fixed, faces))
    weights = area
    scans: list[FloatArray] = []
    for visit in visits:
        own: list[FloatArray] = []
        for row in visit.rows:
            x = fixed
            if row != visits[0].rows[0]:
                # Estimated vertices are not used in the alignment.
                both = cohort.observed_in([visits[0].rows[0], row])
                T, weights = align_by(cohort.vertices(row), fixed, area if both is None else area * both, stable)
                x = T.apply(cohort.vertices(row))
            own.append(x)
        scans.append(np.stack(own))
    means = np.stack([own.mean(axis=0) for own in scans])
    observed = cohort.observed_in([row for visit in visits for row in visit.rows])
    return AlignedVisits(tuple(visits), tuple(scans), means, vertex_normals(Mesh(means[0], faces)), weights, observed)


def faces_in(cohort: Cohort) -> IntArray:
    """Return the triangles of a cohort that must have some."""
    assert cohort.faces is not None
    return cohort.faces


def swept_mm3(before: FloatArray, after: FloatArray, faces: IntArray) -> FloatArray:
    """Return the volume (V,) that each vertex sweeps from `before` (V, 3) to `after` along straight lines, outwards +.

    The volume of a triangle counts a third for each of its corners. The sum is exact, and for closed surfaces it is the
    difference of the volumes: at each moment a triangle sweeps its area vector times its mean velocity, which is
    quadratic in time, so that Simpson's rule has no error.
    """
    moved = after - before
    corners: FloatArray = moved[faces].sum(axis=1) / 3.0
    half = 0.5 * (before + after)
    area = (face_vectors(before, faces) + 4.0 * face_vectors(half, faces) + face_vectors(after, faces)) / 12.0
    shares = np.repeat((corners * area).sum(axis=1) / 3.0, 3)
    return np.asarray(np.bincount(faces.ravel(), shares, len(before)), dtype=np.float64)


def contrast(visits: Sequence[Visit], *, rate: bool) -> FloatArray:
    """Return weights (T,) with which visits sum to last minus first, or to the slope of a line by time."""
    if rate:
        times = np.array([visit.time for visit in visits])
        away = times - times.mean()
        return away / float(away @ away)
    out = np.zeros(len(visits))
    out[0], out[-1] = -1.0, 1.0
    return out


def noise_factor(visits: Sequence[Visit], weights: FloatArray) -> float:
    """Return the noise SD of a sum of visits with `weights` (T,), each a mean of scans, relative to one scan."""
    return float(np.sqrt(sum(w**2 / len(visit.rows) for w, visit in zip(weights, visits, strict=True))))


@dataclass(frozen=True, eq=False)
class ChangeUncertainty:
    """Standard deviations of a sum over visits of one subject.

    Args:
        along_mm: (V,) standard deviation along the normals.
        landmarks_mm: (L,) standard deviation of each landmark: root of the summed variances along the axes.
        volumes_mm3: (P,) standard deviation of the volume swept by each part; NaN if not known.
    """

    along_mm: FloatArray
    landmarks_mm: FloatArray
    volumes_mm3: FloatArray


def uncertainty_from_stable_part(
    subject: AlignedVisits, landmarks: SurfaceLandmarks, parts: FloatArray
) -> ChangeUncertainty:
    """Return standard deviations by the spread over the stable part, which did not change; equal at all vertices."""
    moved = subject.means[-1] - subject.means[0]
    along = np.einsum("vd,vd->v", moved, subject.normals)
    spread_mm = _spread(along, subject.weights)
    marks = np.full(len(landmarks), _spread(np.linalg.norm(moved, axis=1), subject.weights))
    return ChangeUncertainty(np.full(len(along), spread_mm), marks, np.full(len(parts), np.nan))


def uncertainty_from_fits(
    cohort: Cohort, subject: AlignedVisits, weights: FloatArray, landmarks: SurfaceLandmarks, parts: FloatArray
) -> ChangeUncertainty:
    """Return standard deviations from those stated by the fits, through modes and alignment.

    Coefficients vary by `b_stddev`, modes move the vertices, and the alignment removes the rigid motion of the stable
    part from their displacements. If the observed displacements of the stable part exceed these standard deviations,
    all standard deviations are multiplied by the same factor.

    Args:
        cohort: cohort of fits.
        subject: aligned visits of the subject.
        weights: (T,) weights of the sum over visits.
        landmarks: landmarks on the surfaces.
        parts: (P, V) parts with volumes, 1 for their vertices and 0 for the others.
    """
    fitted, faces = cohort.fitted, faces_in(cohort)
    assert fitted is not None
    first = subject.visits[0].rows[0]
    modes = fitted.b.shape[1]
    T = fit_similarity(fitted.model.reconstruct(fitted.b[first]), subject.scans[0][0])
    turned = fitted.model.vertex_basis[:, :modes].reshape(-1, 3, modes).transpose(0, 2, 1) @ (T.scale * T.rotation.T)
    flat = turned.transpose(0, 2, 1).reshape(-1, modes)
    centre = subject.means[0] - subject.means[0].mean(axis=0)
    rigid = small_poses(centre)[:, :_RIGID]
    weighed = np.repeat(subject.weights, 3)[:, None] * rigid
    flat = flat - rigid @ np.linalg.solve(rigid.T @ weighed, weighed.T @ flat)
    moves = flat.reshape(-1, 3, modes)
    variance = np.zeros(modes)
    for w, visit in zip(weights, subject.visits, strict=True):
        variance += (w / len(visit.rows)) ** 2 * (fitted.b_stddev[list(visit.rows)] ** 2).sum(axis=0)
    along = np.einsum("vdk,vd->vk", moves, subject.normals) ** 2 @ variance
    marks = (landmarks.interpolate(moves) ** 2).sum(axis=1) @ variance
    vectors = np.repeat(face_vectors(subject.means.mean(axis=0), faces) / 6.0, 3, axis=0)
    outward = np.stack([np.bincount(faces.ravel(), vectors[:, d], len(centre)) for d in range(3)], axis=1)
    volumes = (parts @ np.einsum("vdk,vd->vk", moves, outward)) ** 2 @ variance
    summed = weights @ subject.along_mm
    wider = max(1.0, _spread(summed / np.sqrt(np.maximum(along, 1e-18)), subject.weights))
    return ChangeUncertainty(wider * np.sqrt(along), wider * np.sqrt(marks), wider * np.sqrt(volumes))


def _spread(values: FloatArray, weights: FloatArray) -> float:
    return float(np.sqrt(weights @ values**2 / weights.sum()))
