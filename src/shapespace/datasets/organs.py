"""Simulated organs without landmarks, such as spleens: smooth, closed, as raw surfaces or as label volumes.

An organ is a star about the middle of a straight body, which is then tapered and bent: a point of the body is inside
where it is nearer to the middle than the radius in its direction. So both surfaces and voxels follow from one formula.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.datasets.simulated_scan import random_similarity
from shapespace.errors import InputError
from shapespace.io.files import make_folder, write_bytes
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.volume_io import require_volumes_extra
from shapespace.types import FloatArray, LabelVolume, Mesh

_HALF_MM = np.array([55.0, 34.0, 19.0])
"""Of the axes of the mean."""
# random bumps: their number, width (radians), and standard deviation of log radius
_CENTRES, _WIDTH, _ROUGHNESS = 40, 0.35, 0.05
_NOTCH, _RIDGE = np.array([0.35, -0.9, 0.25]), np.array([-0.2, 0.3, 0.95])
_NOISE_MM, _POINTS = 0.15, 3000  # mm and vertices of a raw surface
# mm; a usual abdominal CT, with slices thicker than pixels, and its margin around the organ
_VOXEL_MM, _MARGIN_MM = (1.5, 1.5, 2.5), 8.0
_MOST = 10_000  # limit on files written to the folder of a demonstration


@dataclass(frozen=True, eq=False)
class Organ:
    """One organ in its own frame, mm.

    Args:
        half_mm: (3,) half lengths of its axes, mm.
        taper: relative change of the width along x; a positive value widens the end at positive x.
        bend: offset of the ends by bending, as a share of its half length.
        notch: (3,) direction of the notch in its border.
        depth: (2,) depth of the notch and height of the ridge, as shares of the radius.
        waves: (N,) logarithms of the relative radius of its surface at evenly spread directions.
    """

    half_mm: FloatArray
    taper: float
    bend: float
    notch: FloatArray
    depth: FloatArray
    waves: FloatArray

    @staticmethod
    def draw(rng: np.random.Generator) -> Organ:
        """Return a random organ."""
        half = _HALF_MM * np.exp(0.12 * rng.standard_normal(3)) * np.exp(0.1 * rng.standard_normal())
        notch = _NOTCH + 0.12 * rng.standard_normal(3)
        return Organ(
            half,
            0.25 + 0.08 * rng.standard_normal(),
            0.35 + 0.1 * rng.standard_normal(),
            notch / np.linalg.norm(notch),
            np.array([0.25, 0.2]) * np.exp(0.25 * rng.standard_normal(2)),
            _ROUGHNESS * rng.standard_normal(_CENTRES),
        )

    def radius_mm(self, directions: FloatArray) -> FloatArray:
        """Return how far (M,) the straight body reaches in `directions` (M, 3) of unit length."""
        waves = np.exp((directions @ _spread(_CENTRES).T - 1) / _WIDTH**2) @ self.waves
        notch = self.depth[0] * np.exp((directions @ self.notch - 1) / 0.02)
        ridge = self.depth[1] * np.exp((directions @ (_RIDGE / np.linalg.norm(_RIDGE)) - 1) / 0.08)
        ellipsoid = 1 / np.linalg.norm(directions / self.half_mm, axis=1)
        return np.asarray(ellipsoid * np.exp(waves - notch + ridge), dtype=np.float64)

    def surface(self, directions: FloatArray) -> FloatArray:
        """Return the points (M, 3) of the surface in `directions` (M, 3) of the straight body."""
        x, y, z = (directions * self.radius_mm(directions)[:, None]).T
        wide = self._wide(x)
        return np.column_stack([x, wide * y + self._bent(x), wide * z])

    def inside(self, points: FloatArray) -> np.ndarray:
        """Return (M,) for each of `points` (M, 3) whether it lies inside the organ."""
        x = points[:, 0]
        wide = self._wide(x)
        body = np.column_stack([x, (points[:, 1] - self._bent(x)) / wide, points[:, 2] / wide])
        distance = np.maximum(np.linalg.norm(body, axis=1), 1e-9)
        return np.asarray(distance < self.radius_mm(body / distance[:, None]))

    def _wide(self, x: FloatArray) -> FloatArray:
        # Bounded, as points of a volume may lie far beyond the ends.
        return np.asarray(1 + self.taper * np.tanh(x / self.half_mm[0]), dtype=np.float64)

    def _bent(self, x: FloatArray) -> FloatArray:
        return np.asarray(self.bend * x**2 / self.half_mm[0], dtype=np.float64)


class Star(Protocol):
    """A star-shaped object: each ray from its centre meets the surface once."""

    def surface(self, directions: FloatArray) -> FloatArray:
        """Return the points (M, 3), mm, of the surface in `directions` (M, 3) of unit length."""
        ...


def raw_surface(organ: Star, rng: np.random.Generator, points: int = _POINTS) -> Mesh:
    """Return `organ` as a scan: triangles and pose of its own, and noise; mm."""
    mesh = raw_surface_in_its_frame(organ, rng, points)
    return mesh.with_vertices(random_similarity(rng, 180.0, (1.0, 1.0)).apply(mesh.vertices))


def raw_surface_in_its_frame(organ: Star, rng: np.random.Generator, points: int = _POINTS) -> Mesh:
    """Return `organ` with triangles of its own and noise, in the frame of the organ, mm."""
    directions = _spread(points) @ Rotation.random(random_state=rng).as_matrix().T
    faces = ConvexHull(directions).simplices.astype(np.int32)
    a, b, c = (directions[faces[:, k]] for k in range(3))
    inward = np.einsum("fd,fd->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    x = organ.surface(directions) + _NOISE_MM * rng.standard_normal((points, 3))
    return Mesh(x, faces, name="organ")


def label_volume(organ: Organ, rng: np.random.Generator) -> LabelVolume:
    """Return `organ` as voxels with the label 1, nearly along the axes of the patient, as a scanner gives them."""
    turn = Rotation.from_rotvec(0.15 * rng.standard_normal(3)).as_matrix()
    surface_points = organ.surface(_spread(400)) @ turn.T
    low, high = surface_points.min(axis=0) - _MARGIN_MM, surface_points.max(axis=0) + _MARGIN_MM
    counts = np.ceil((high - low) / _VOXEL_MM).astype(int)
    places = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3) * _VOXEL_MM + low
    labels = organ.inside(places @ turn).reshape(counts).astype(np.uint8)
    affine = np.diag([*_VOXEL_MM, 1.0])
    affine[:3, 3] = low + 100.0 * rng.uniform(-1, 1, 3)
    return LabelVolume(labels, affine, "organ", ())


def write_organs(
    folder: Path, *, count: int, seed: int = 0, volumes: bool = False, progress: Callable[[], object] | None = None
) -> Path:
    """Write organ_000.ply and so on as raw surfaces, or organ_000.nii.gz as label volumes; those are of one organ.

    Args:
        folder: output folder; created if it does not exist.
        count: number of organs, 1 to 10,000.
        seed: seed, 0 or more.
        volumes: whether to write label volumes.
        progress: function called after each organ.

    Raises:
        InputError: a number out of range.
        ShapespaceError: volumes, without the extra `volumes`.
        FileError: the folder cannot be written.
    """
    if not 1 <= count <= _MOST:
        raise InputError(f"The number of organs must lie between 1 and {_MOST}, not at {count}.")
    if volumes:
        require_volumes_extra()
    make_folder(folder)
    for k in range(count):
        organ, rng = Organ.draw(np.random.default_rng([seed, k])), np.random.default_rng([seed, k, 1])
        if volumes:
            _write_volume(folder / f"organ_{k:03d}.nii.gz", label_volume(organ, rng))
        else:
            write_mesh(folder / f"organ_{k:03d}.ply", raw_surface(organ, rng))
        if progress is not None:
            progress()
    return folder


def _write_volume(path: Path, volume: LabelVolume) -> None:
    import nibabel

    image = nibabel.Nifti1Image(np.asarray(volume.labels), np.asarray(volume.affine))
    write_bytes(path, gzip.compress(image.to_bytes(), mtime=0))


def _spread(count: int) -> FloatArray:
    """Return directions (count, 3) spread evenly: a spiral."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * i
    flat = np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(angle), flat * np.sin(angle), z])
