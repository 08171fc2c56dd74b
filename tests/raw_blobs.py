"""Raw scans of blobs with known correspondence: each has triangles, pose, size and noise of its own."""

from dataclasses import dataclass, replace

import numpy as np

from shapespace.datasets.simulated_scan import random_similarity
from shapespace.geometry.closest import build_engine
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import blob, sphere

LANDMARKS = {"nose": (0, -0.1, 1), "left": (1, 1, 0.3), "top": (0, 1, 0), "back": (0.2, 0, -1), "low": (-0.3, -1, 0.4)}
"""Name -> direction."""


@dataclass(frozen=True, eq=False)
class RawBlob:
    """A scan, and the directions on the sphere from which its surface is made."""

    scan: Mesh
    truth: Mesh
    directions: FloatArray

    def directions_at(self, points: FloatArray) -> FloatArray:
        """Return the directions (M, 3) of the points of the true surface nearest to `points` (M, 3)."""
        near = build_engine(self.truth).query(np.ascontiguousarray(points))
        found = np.einsum("mc,mcd->md", near.barycentric, self.directions[self.truth.faces[near.triangle]])
        return found / np.linalg.norm(found, axis=1, keepdims=True)


ANY_POSE = 180.0
"""Largest rotation of scans in any pose, degrees; the search for their poses takes most of the time of a test."""


def raw_blob(
    k: int, *, T: Similarity | None = None, degrees: float = 20.0, points: int = 2500, noise_mm: float = 0.2
) -> RawBlob:
    """Return blob number `k`, rotated by up to `degrees`, as scans of one device are."""
    rng = np.random.default_rng([3, k])
    directions, faces = sphere(points, 0.37 * (k + 1))
    vertices = blob(directions, rng.standard_normal(5))
    T = T or random_similarity(rng, degrees)
    truth = Mesh(T.apply(vertices), faces)
    noisy = T.apply(vertices + noise_mm * rng.standard_normal(vertices.shape))
    return RawBlob(Mesh(noisy, faces, name=f"blob{k}"), truth, directions)


def marked(one: RawBlob) -> Mesh:
    """Return the scan of a blob with the landmarks `LANDMARKS`."""
    points = {
        name: one.truth.vertices[(one.directions @ (np.array(at) / np.linalg.norm(at))).argmax()]
        for name, at in LANDMARKS.items()
    }
    return replace(one.scan, landmarks=points)


def without_ball(mesh: Mesh, centre: FloatArray, radius: float) -> Mesh:
    """Return `mesh` without the triangles within `radius` of `centre`."""
    kept = np.linalg.norm(mesh.vertices - centre, axis=1) > radius
    faces = mesh.faces[kept[mesh.faces].all(axis=1)]
    used = np.unique(faces)
    number = np.cumsum(np.isin(np.arange(len(mesh.vertices)), used)) - 1
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32), name=mesh.name)


def dispersion_mm(blobs: list[RawBlob], surfaces: list[FloatArray]) -> float:
    """Return how far apart on the mean blob the same vertex lies for all, mm; not-a-number is left out."""
    mean = blob(np.array([[0.0, 0.0, 1.0]]), np.zeros(5))
    size = float(np.linalg.norm(mean))
    at = []
    for one, surface in zip(blobs, surfaces, strict=True):
        directions = np.full(surface.shape, np.nan)
        there = np.isfinite(surface).all(axis=1)
        directions[there] = one.directions_at(surface[there])
        at.append(directions)
    middle = np.nanmedian(at, axis=0)
    return float(np.nanmean(np.linalg.norm(np.array(at) - middle, axis=2))) * 0.85 * size
