"""Closed surfaces of two parts with a hinge: an upper and a lower ellipsoid, in random shapes and flexions."""

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.types import Mesh

VERTICES = 162
"""Vertices of each part."""


def sphere(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (count, 3) on the unit sphere, at even distances, and triangles that face outwards."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle, radius = np.pi * (1 + np.sqrt(5)) * np.arange(count), np.sqrt(1 - z**2)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), z])
    faces = ConvexHull(points).simplices
    outwards = np.linalg.det(points[faces]) > 0
    return points, np.where(outwards[:, None], faces, faces[:, [0, 2, 1]]).astype(np.int32)


def two_part_surfaces(count: int, seed: int, degrees: float = 60.0) -> list[Mesh]:
    """Return surfaces whose second part turns about the near end of the first by 0 to `degrees`, mm."""
    points, triangles = sphere(VERTICES)
    faces = np.concatenate([triangles, triangles + VERTICES])
    rng, surfaces = np.random.default_rng(seed), []
    for i in range(count):
        a, b, angle = rng.normal(), rng.normal(), np.deg2rad(rng.uniform(0, degrees))
        upper = points * [10.0, 50.0 + 2 * b, 12.0 + a] + [0, 52.0, 0]
        lower = points * [9.0, 45.0 + 2 * b, 10.0 - a] + [0, -47.0, 0]
        turned = lower @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix().T
        surfaces.append(Mesh(np.concatenate([upper, turned]), faces, name=f"s{i}"))
    return surfaces
