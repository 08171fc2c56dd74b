"""Simulated hair and collars on a scan, which no face model represents."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.geometry.normals import face_vectors
from shapespace.types import FloatArray, Mesh

LongArray: TypeAlias = npt.NDArray[np.int64]

_UP, _FRONT = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Hair:
    """Hair as a 3dMD scanner sees it: a bumpy sheet over the scalp, tufts over the forehead, floating shreds.

    Args:
        fringe_mm: how far down over the upper border of the surface the sheet comes.
        thickness_mm: least and greatest distance of the sheet from the head.
        sideburns_mm: how much lower the sheet comes at the temples.
        tufts: number of locks that hang from the sheet.
        shreds: number of small patches that float free.
        spacing_mm: length of the edges of the sheet.
    """

    fringe_mm: float = 18.0
    thickness_mm: tuple[float, float] = (2.0, 15.0)
    sideburns_mm: float = 45.0
    tufts: int = 24
    shreds: int = 30
    spacing_mm: float = 2.0


@dataclass(frozen=True)
class Collar:
    """A collar: a bumpy band around the neck, below the surface and overlapping its lower border.

    Args:
        height_mm: of the band.
        overlap_mm: how far it comes up over the lower border of the surface.
        spacing_mm: length of its edges.
    """

    height_mm: float = 45.0
    overlap_mm: float = 12.0
    spacing_mm: float = 2.5


def _bumps(points: FloatArray, rng: np.random.Generator, wavelength_mm: float) -> FloatArray:
    """Return smooth random values (M,) of about unit size at `points` (M, 3): a sum of sixteen random waves."""
    waves = rng.standard_normal((16, 3)) * (2 * np.pi / wavelength_mm / np.sqrt(3))
    return np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, 16)).sum(axis=1) / np.sqrt(8.0)


def _grid(rows: int, columns: int) -> LongArray:
    """Return the triangles of a grid of `rows` x `columns` vertices, numbered row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + columns], axis=1)
    upper = np.stack([corner + 1, corner + columns + 1, corner + columns], axis=1)
    return np.concatenate([lower, upper]).astype(np.int64)


@dataclass(frozen=True, eq=False)
class _Head:
    """A sphere fitted to the upper part of a face, bulged to follow it where the face is."""

    center: FloatArray
    radius: float
    directions: cKDTree
    excess: FloatArray
    top_mm: float

    @staticmethod
    def of(mesh: Mesh) -> _Head:
        vertices = np.asarray(mesh.vertices)
        height = vertices @ _UP
        low, top = np.quantile(height, [0.0, 1.0])
        upper = vertices[height > low + 0.6 * (top - low)]
        A = np.column_stack([2 * upper, np.ones(len(upper))])
        solution = np.asarray(np.linalg.lstsq(A, (upper**2).sum(axis=1), rcond=None)[0], dtype=np.float64)
        center = solution[:3]
        radius = float(np.sqrt(solution[3] + center @ center))
        ray = vertices - center
        distance = np.linalg.norm(ray, axis=1)
        outer = distance > 0.5 * radius
        tree = cKDTree(ray[outer] / distance[outer, None])
        return _Head(center, radius, tree, distance[outer] - radius, float(top))

    def surface(self, directions: FloatArray) -> FloatArray:
        """Return the distance (M,) from the centre to the head along unit `directions` (M, 3)."""
        query_result = cast("tuple[FloatArray, LongArray]", self.directions.query(directions, k=6))
        distance, nearest = query_result
        weights = np.exp(-((distance * self.radius / 12.0) ** 2))
        # Fading to the sphere away from the face keeps the scalp round where there is no surface at all.
        return self.radius + (weights * self.excess[nearest]).sum(axis=1) / np.maximum(weights.sum(axis=1), 1.0)


def hair_parts(mesh: Mesh, hair: Hair, rng: np.random.Generator) -> list[tuple[FloatArray, LongArray]]:
    """Return vertices and triangles of the sheet, the tufts and the shreds over the head of `mesh`, mm."""
    head = _Head.of(mesh)
    parts = [_hair_sheet(head, hair, rng)]
    parts += [_tuft(head, hair, rng) for _ in range(hair.tufts)]
    parts += [_shred(head, hair, rng) for _ in range(hair.shreds)]
    return parts


def _hairline(directions: FloatArray, head: _Head, hair: Hair) -> FloatArray:
    """Return the height (M,) above which there is hair: lower at the temples, low at the back."""
    azimuth = np.abs(np.arctan2(directions[:, 0], directions[:, 2]))
    side = np.clip((azimuth - math.radians(35)) / math.radians(40), 0.0, 1.0)
    return head.top_mm - hair.fringe_mm - hair.sideburns_mm * side * side * (3 - 2 * side)


def _hair_sheet(head: _Head, hair: Hair, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    max_angle = math.radians(115.0)
    count = int(2 * max_angle * head.radius / hair.spacing_mm)
    steps = np.linspace(-max_angle, max_angle, count)
    u, v = np.tile(steps, count), np.repeat(steps, count)
    u = u + rng.uniform(-0.3, 0.3, len(u)) * 2 * max_angle / count
    v = v + rng.uniform(-0.3, 0.3, len(v)) * 2 * max_angle / count
    angle = np.hypot(u, v)
    ring = np.where(angle > 0, np.sin(angle) / np.maximum(angle, 1e-9), 1.0)
    # An azimuthal map about the crown has no seam and no pole within the hair.
    pole = (_UP - 0.4 * _FRONT) / np.linalg.norm(_UP - 0.4 * _FRONT)
    right = np.cross(_UP, _FRONT)
    directions = (
        np.cos(angle)[:, None] * pole + (ring * u)[:, None] * right + (ring * v)[:, None] * np.cross(right, pole)
    )
    positions = head.center + directions * head.surface(directions)[:, None]
    edge = positions @ _UP - _hairline(directions, head, hair) - 5.0 * _bumps(positions, rng, 18.0)
    low, high = hair.thickness_mm
    swell = np.clip(edge / 30.0, 0.0, 1.0)
    thickness = low + (high - low) * swell * (0.65 + 0.35 * _bumps(positions, rng, 35.0))
    thickness = (
        np.clip(thickness, low, high) + 1.2 * _bumps(positions, rng, 9.0) + 0.8 * rng.standard_normal(len(positions))
    )
    vertices = positions + directions * np.maximum(thickness, 0.5 * low)[:, None]
    holes = _bumps(positions, rng, 22.0) > 1.9
    keep = (edge > 0) & (angle < max_angle) & ~holes
    faces = _grid(count, count)
    return vertices, faces[keep[faces].all(axis=1)]


def _tuft(head: _Head, hair: Hair, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    """A lock: a narrow wavy ribbon from the hairline down over the skin, a few millimetres above it."""
    azimuth = rng.uniform(-1.2, 1.2)
    length, width = rng.uniform(10.0, 32.0), rng.uniform(2.0, 6.0)
    rows, columns = max(3, int(length / hair.spacing_mm)), max(3, int(width / 1.5))
    along = np.linspace(0.0, 1.0, rows)
    start = _hairline(np.array([[np.sin(azimuth), 0.0, np.cos(azimuth)]]), head, hair)[0] + 4.0
    height = np.clip((start - head.center @ _UP - along * length) / head.radius, -0.95, 0.95)
    sway = azimuth + rng.uniform(-0.2, 0.2) * along + 0.03 * np.sin(rng.uniform(2, 6) * along + rng.uniform(0, 6))
    across = np.linspace(-0.5, 0.5, columns) * width / head.radius
    bearing = sway[:, None] + across * (1.0 - 0.7 * along[:, None])
    level = np.sqrt(1 - height**2)[:, None]
    directions = np.stack(
        [level * np.sin(bearing), np.broadcast_to(height[:, None], bearing.shape), level * np.cos(bearing)], axis=2
    ).reshape(-1, 3)
    lift = np.repeat(rng.uniform(2.0, 7.0) * (1.0 - 0.6 * along), columns) + 0.4 * rng.standard_normal(rows * columns)
    return head.center + directions * (head.surface(directions) + lift)[:, None], _grid(rows, columns)


def _shred(head: _Head, hair: Hair, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    """A small crumpled patch that floats above the hair or beside the head."""
    direction = rng.standard_normal(3)
    direction[1] = abs(direction[1]) * 1.2 - 0.2
    direction /= np.linalg.norm(direction)
    center = head.center + direction * (head.radius + hair.thickness_mm[1] + rng.uniform(2.0, 25.0))
    rows, columns = int(rng.integers(3, 6)), int(rng.integers(3, 6))
    axis = rng.standard_normal(3)
    frame = Rotation.from_rotvec(rng.uniform(0.0, np.pi) * axis / np.linalg.norm(axis)).as_matrix()
    u, v = np.tile(np.arange(columns), rows), np.repeat(np.arange(rows), columns)
    flat = 1.8 * np.stack([u - u.mean(), v - v.mean(), np.zeros(len(u))], axis=1)
    crumpled = flat + 0.6 * rng.standard_normal(flat.shape)
    return center + crumpled @ frame.T, _grid(rows, columns)


def collar_part(mesh: Mesh, collar: Collar, rng: np.random.Generator) -> tuple[FloatArray, LongArray]:
    """Return vertices and triangles of a collar below `mesh`, mm."""
    vertices = np.asarray(mesh.vertices)
    height = vertices @ _UP
    low, top = height.min(), height.max()
    wide = np.ptp(vertices[:, 0])
    middle = 0.5 * (vertices[:, 0].max() + vertices[:, 0].min())
    chin = vertices[height < low + 0.25 * (top - low)]
    radius_x, radius_z = 0.55 * wide, 0.5 * wide
    center_z = np.quantile(chin[:, 2], 0.9) - 1.1 * radius_z
    rows = max(3, int(collar.height_mm / collar.spacing_mm))
    columns = max(8, int(np.pi * (radius_x + radius_z) * 0.8 / collar.spacing_mm))
    around = np.tile(np.linspace(-0.8 * np.pi, 0.8 * np.pi, columns), rows)
    down = np.repeat(np.linspace(0.0, 1.0, rows), columns)
    flare = 1.0 + 0.25 * down
    vertices = np.stack(
        [
            middle + radius_x * flare * np.sin(around),
            low + collar.overlap_mm - collar.height_mm * down,
            center_z + radius_z * flare * np.cos(around),
        ],
        axis=1,
    )
    vertices = vertices + 0.3 * rng.standard_normal(vertices.shape)
    vertices[:, 2] += 1.5 * _bumps(vertices, rng, 30.0)
    faces = _grid(rows, columns)
    facing = face_vectors(vertices, faces.astype(np.int32))
    outward = vertices[faces].mean(axis=1) - [middle, 0.0, center_z]
    # The grid is wound so that its normals point outward, as on the face.
    return vertices, faces if (facing * outward)[:, [0, 2]].sum() > 0 else faces[:, ::-1]
