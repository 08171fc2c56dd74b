"""Simulated bones: raw scans of small skulls in two groups, with a known group difference and asymmetry.

A skull is a star-shaped surface about its centre: an ellipsoid with bumps for snout, crest, cheek arches and condyles,
and pits for the orbits. The second group has a longer snout; in all skulls the left arch protrudes further than the
right one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapespace.datasets.organs import raw_surface
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import without_vertices
from shapespace.io.files import make_folder
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.types import FloatArray, Mesh

TABLE = "bones.csv"
GROUPS = ("coast", "island")
"""The second group has the longer snout."""
EFFECT_MM = 4.0  # mm, difference of the snout's length between the groups
LEFT_ARCH_MM = 1.5
"""Mean difference of the protrusion of the left and the right arch."""

_HALF_MM = np.array([17.0, 15.0, 26.0])
"""Half axes of the ellipsoid: to the left (x), up (y) and to the snout (z)."""
_SNOUT, _LEFT, _RIGHT = 0, 2, 3  # rows of `_BUMPS`
_BUMPS = np.array(
    [
        # x, y, z of the direction; width; mean height and its standard deviation, as logarithms of the radius.
        [0.0, -0.1, 1.0, 0.05, 0.35, 0.03],
        [0.0, 1.0, -0.45, 0.08, 0.18, 0.04],
        [0.9, -0.15, 0.2, 0.04, 0.28, 0.03],
        [-0.9, -0.15, 0.2, 0.04, 0.28, 0.03],
        [0.55, 0.55, 0.6, 0.03, -0.2, 0.02],
        [-0.55, 0.55, 0.6, 0.03, -0.2, 0.02],
        [0.35, -0.5, -0.85, 0.03, 0.18, 0.03],
        [-0.35, -0.5, -0.85, 0.03, 0.18, 0.03],
    ]
)
_TWIN = np.array([0, 1, 3, 2, 5, 4, 7, 6])
_FLUCTUATING = 0.015
"""Standard deviation of the height of a bump on one side alone."""
# random bumps: their number, width (radians), and standard deviation of log radius, paired and on one side
_WAVES, _WAVE_WIDTH, _WAVE, _WAVE_ONE_SIDE = 24, 0.3, 0.02, 0.004
_SIZE = 0.08  # standard deviation of log size
_POINTS = 2500  # vertices of a raw surface
_CUT_EVERY, _CUT_MM = 3, 9.0
"""Every n-th bone has a hole; n, and the mean radius of the hole."""
_MOST = 10_000  # limit on files written to the folder of a demonstration


@dataclass(frozen=True, eq=False)
class Bone:
    """One skull in a frame of its own, mm: x to its left, y up, z to the snout.

    Args:
        half_mm: (3,) of the axes of the ellipsoid.
        heights: (8,) of the bumps, logarithms of the radius.
        waves: (W,) logarithms of the radius at W directions.
        directions: (W, 3) unit vectors of these directions.
    """

    half_mm: FloatArray
    heights: FloatArray
    waves: FloatArray
    directions: FloatArray

    @staticmethod
    def draw(rng: np.random.Generator, longer_mm: float = 0.0) -> Bone:
        """Return a random skull, with a snout that is longer than usual by `longer_mm`."""
        half = _HALF_MM * np.exp(0.03 * rng.standard_normal(3)) * np.exp(_SIZE * rng.standard_normal())
        bump_weights = rng.standard_normal(len(_BUMPS))
        paired = np.where(np.arange(len(_BUMPS)) <= _TWIN, bump_weights, bump_weights[_TWIN])
        heights = _BUMPS[:, 4] + _BUMPS[:, 5] * paired
        heights[_LEFT:] += _FLUCTUATING * rng.standard_normal(len(_BUMPS) - _LEFT)
        heights[_SNOUT] += np.log1p(longer_mm / (_HALF_MM[2] * np.exp(_BUMPS[_SNOUT, 4])))
        arch_mm = _HALF_MM[0] * np.exp(_BUMPS[_LEFT, 4])
        heights[_LEFT] += np.log1p(LEFT_ARCH_MM / arch_mm)
        directions = np.random.default_rng(0).standard_normal((_WAVES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        waves = _WAVE * rng.standard_normal(_WAVES)
        one_side = _WAVE_ONE_SIDE * rng.standard_normal((2, _WAVES))
        return Bone(
            half, heights, np.concatenate([waves + one_side[0], waves + one_side[1]]),
            np.concatenate([directions, directions * FLIP]),
        )  # fmt: skip

    def surface(self, directions: FloatArray) -> FloatArray:
        """Return the points (M, 3) of the surface in `directions` (M, 3) of unit length."""
        centres = _BUMPS[:, :3] / np.linalg.norm(_BUMPS[:, :3], axis=1, keepdims=True)
        bumps = np.exp((directions @ centres.T - 1) / _BUMPS[:, 3]) @ self.heights
        waves = np.exp((directions @ self.directions.T - 1) / _WAVE_WIDTH**2) @ self.waves
        ellipsoid = 1 / np.linalg.norm(directions / self.half_mm, axis=1)
        return np.asarray(directions * (ellipsoid * np.exp(bumps + waves))[:, None], dtype=np.float64)


def write_bones(
    folder: Path,
    *,
    count: int,
    seed: int = 0,
    effect_mm: float = EFFECT_MM,
    progress: Callable[[], object] | None = None,
) -> Path:
    """Write raw scans of skulls, bone_000.ply and so on, and the table bones.csv.

    The skulls belong to two groups alternately. Each scan has noise and its own triangles and pose; every third scan
    has a hole.

    Args:
        folder: output folder; created if it does not exist.
        count: number of skulls, 2 to 10,000.
        seed: seed, 0 or more.
        effect_mm: difference of the snout's length between the second and the first group, mm.
        progress: function called after each skull.

    Raises:
        InputError: a count or an effect out of range.
        FileError: the folder cannot be written.
    """
    if not -10.0 <= effect_mm <= 10.0:
        raise InputError(f"The effect must be between -10 and 10 mm, not {effect_mm:g}.")

    def write(k: int, group: int) -> str:
        rng = np.random.default_rng([seed, k, 1])
        scan = raw_surface(Bone.draw(np.random.default_rng([seed, k]), effect_mm * group), rng, _POINTS)
        scan = _with_hole(scan, rng) if k % _CUT_EVERY == _CUT_EVERY - 1 else scan
        write_mesh(folder / f"bone_{k:03d}.ply", scan)
        return f"bone_{k:03d}.ply"

    return write_two_groups(folder / TABLE, ("file", "group"), GROUPS, write, count=count, progress=progress)


def write_two_groups(
    table: Path,
    columns: tuple[str, str],
    groups: tuple[str, str],
    write: Callable[[int, int], str],
    *,
    count: int,
    progress: Callable[[], object] | None,
) -> Path:
    """Write simulated specimens of two groups alternately, and their table; return its folder.

    Args:
        table: the table; its folder is created if it does not exist.
        columns: names of its two columns, for specimens and groups.
        groups: names of the groups.
        write: function of the number of a specimen and of its group that writes the specimen and returns its name.
        count: number of specimens, 2 to 10,000.
        progress: function called after each specimen.

    Raises:
        InputError: a count out of range.
        FileError: a file cannot be written.
    """
    if not 2 <= count <= _MOST:
        raise InputError(f"The number of specimens must be between 2 and {_MOST}, not {count}.")
    make_folder(table.parent)
    rows: list[tuple[str, str]] = []
    for k in range(count):
        rows.append((write(k, k % 2), groups[k % 2]))
        if progress is not None:
            progress()
    write_rows(table, columns, rows)
    return table.parent


def _with_hole(scan: Mesh, rng: np.random.Generator) -> Mesh:
    centre = scan.vertices[rng.integers(len(scan.vertices))]
    radius = _CUT_MM * rng.uniform(0.7, 1.3)
    assert scan.faces is not None
    is_kept = np.linalg.norm(scan.vertices - centre, axis=1) > radius
    vertices, faces = without_vertices(scan.vertices, scan.faces, is_kept)
    return replace(scan, vertices=vertices, faces=faces)
