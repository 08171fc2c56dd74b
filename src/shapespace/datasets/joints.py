"""Simulated joints: raw scans of two bones per subject, in the frame of the subject, with a random flexion.

Each bone is an ellipsoid with bumps for condyles, tubercles and ends. The lengths and the widths of both bones of a
subject are correlated; the flexion depends on the group alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.datasets.bones import write_two_groups
from shapespace.datasets.organs import raw_surface_in_its_frame
from shapespace.errors import InputError
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.types import FloatArray, Mesh

TABLE = "joints.csv"
GROUPS = ("rest", "training")
"""The second group has the larger flexion."""
EFFECT_DEGREES = 12.0  # difference of the mean flexion between the groups
_FLEXION_DEGREES = 30.0  # range of the flexion within a group
_POINTS = 1500  # of a bone
_GAP_MM = 2.0  # between the bones at the joint

# Of the upper and of the lower bone: half axes, mm, and bumps: x, y, z of the direction, width, height in mm.
_HALF_MM = {"femur": np.array([60.0, 11.0, 10.0]), "tibia": np.array([54.0, 10.0, 9.0])}
_BUMPS = {
    "femur": np.array(
        [
            [0.93, 0.2, 0.3, 0.05, 8.0], [0.93, 0.2, -0.3, 0.05, 7.0], [-0.9, 0.1, 0.45, 0.06, 13.0],
            [-0.85, -0.4, -0.3, 0.05, 8.0],
        ]
    ),
    "tibia": np.array(
        [
            [-0.9, 0.1, 0.4, 0.06, 7.0], [-0.9, 0.1, -0.4, 0.06, 6.0], [-0.75, -0.66, 0.0, 0.04, 7.0],
            [0.95, 0.1, 0.3, 0.04, 6.0],
        ]
    ),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class JointBone:
    """One bone in a frame of its own, mm, with its long axis along x.

    Args:
        half_mm: (3,) half axes of the ellipsoid.
        bumps: (B, 5) direction, width and height of each bump.
    """

    half_mm: FloatArray
    bumps: FloatArray

    def surface(self, directions: FloatArray) -> FloatArray:
        """Return the points (M, 3) of the surface in `directions` (M, 3) of unit length."""
        centres = self.bumps[:, :3] / np.linalg.norm(self.bumps[:, :3], axis=1, keepdims=True)
        heights = np.exp((directions @ centres.T - 1) / self.bumps[:, 3]) @ self.bumps[:, 4]
        x = directions * self.half_mm
        return np.asarray(x + heights[:, None] * x / np.linalg.norm(x, axis=1, keepdims=True), dtype=np.float64)


def draw_joint(rng: np.random.Generator, flexion_degrees: float) -> dict[str, Mesh]:
    """Return the raw scans of the bones of a random subject, in one frame, mm."""
    size, width = np.exp(0.04 * rng.standard_normal()), 0.08 * rng.standard_normal()
    parts = dict[str, Mesh]()
    for name, half in _HALF_MM.items():
        own = np.exp([0.02, 0.03, 0.03] * rng.standard_normal(3) + [0.0, width, width])
        bumps = _BUMPS[name].copy()
        bumps[:, 4] *= np.exp(0.15 * rng.standard_normal(len(bumps)))
        bone = JointBone(size * half * own, bumps)
        mesh = raw_surface_in_its_frame(bone, rng, _POINTS)
        away = bone.half_mm[0] + size * _GAP_MM / 2
        is_lower = name == "tibia"
        vertices = mesh.vertices + np.array([away if is_lower else -away, 0.0, 0.0])
        flexed = Rotation.from_euler("z", -flexion_degrees if is_lower else 0.0, degrees=True).as_matrix()
        parts[name] = mesh.with_vertices(vertices @ flexed.T)
    R, shift = Rotation.random(random_state=rng).as_matrix(), 100 * rng.standard_normal(3)
    return {name: mesh.with_vertices(mesh.vertices @ R.T + shift) for name, mesh in parts.items()}


def write_joints(
    folder: Path,
    *,
    count: int,
    seed: int = 0,
    effect_degrees: float = EFFECT_DEGREES,
    progress: Callable[[], object] | None = None,
) -> Path:
    """Write knee_000_femur.ply, knee_000_tibia.ply and so on, and the table joints.csv.

    Args:
        folder: output folder; created if it does not exist.
        count: number of subjects, 2 to 10,000; the groups alternate.
        seed: seed, 0 or more.
        effect_degrees: difference of the mean flexion between the second and the first group.
        progress: function called after each subject.

    Raises:
        InputError: a count or an effect out of range.
        FileError: the folder cannot be written.
    """
    if not -60.0 <= effect_degrees <= 60.0:
        raise InputError(f"The effect must be between -60 and 60 degrees, not {effect_degrees:g}.")

    def write(k: int, group: int) -> str:
        rng = np.random.default_rng([seed, k])
        for part, mesh in draw_joint(rng, rng.uniform(0.0, _FLEXION_DEGREES) + effect_degrees * group).items():
            write_mesh(folder / f"knee_{k:03d}_{part}.ply", mesh)
        return f"knee_{k:03d}"

    return write_two_groups(folder / TABLE, ("specimen", "group"), GROUPS, write, count=count, progress=progress)
