"""Knees of two parts with a hinge, of two groups, and a folder of them as `shapespace correspond` writes it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.io.files import make_folder, write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, json_text
from shapespace.types import Mesh
from synthetic_shapes import sphere

PARTS = {"femur": 80, "tibia": 60}
FLEXION = [0.0, 0.0, 1.0]
"""Axis of the hinge."""


def knees(
    count: int,
    seed: int,
    *,
    bend: float = 0.0,
    widen: float = 0.0,
    degrees: float = 40.0,
    parts: dict[str, int] = PARTS,
) -> list[Mesh]:
    """Return knees whose shapes, sizes, and flexion vary; those of odd numbers differ by `bend` and `widen`.

    Vertices have noise of 0.05 mm.

    Args:
        count: number of subjects.
        seed: of the subjects.
        bend: flexion that is added, degrees.
        widen: share by which tibiae are wider.
        degrees: range of the flexion.
        parts: number of vertices of both parts.
    """
    (x, x_faces), (y, y_faces) = (sphere(n) for n in parts.values())
    x, y = x * [50.0, 12.0, 10.0], y * [45.0, 12.0, 10.0]
    faces = np.concatenate([x_faces, y_faces + len(x)]).astype(np.int32)
    rng, subjects = np.random.default_rng(seed), []
    for number in range(count):
        odd, a, b, c = number % 2, *(0.1 * rng.normal(size=3))
        femur = x * [1.0, 1.0 + a, 1.0] + [0.0, 0.0, 1.0] * (2e-3 * b * x[:, :1] ** 2)
        tibia = y * [1.0, 1.0 + c, 1.0 + odd * widen] + [47.0, 0.0, 0.0]
        femur, tibia = (part + 0.05 * rng.normal(size=part.shape) for part in (femur, tibia))
        angle = np.deg2rad(rng.uniform(0.0, degrees) + odd * bend)
        tibia = tibia @ Rotation.from_rotvec(angle * np.array(FLEXION)).as_matrix().T + rng.normal(size=3)
        whole = (1.0 + 0.03 * rng.normal()) * np.concatenate([femur - [50.0, 0.0, 0.0], tibia])
        pose = Rotation.random(random_state=rng).as_matrix()
        subjects.append(Mesh(whole @ pose.T + 50.0 * rng.normal(size=3), faces, name=f"s{number:02}"))
    return subjects


def sexes(count: int) -> list[str]:
    return ["fm"[number % 2] for number in range(count)]


def write_knees(folder: Path, subjects: Sequence[Mesh], parts: dict[str, int] = PARTS) -> Path:
    """Write surfaces and records, and `people.csv` with the sex, next to the folder; return the table."""
    make_folder(folder)
    for mesh in subjects:
        write_mesh(folder / f"{mesh.name}{CorrespondRecord.SURFACE}", mesh)
        seen = float(np.isfinite(mesh.vertices).all(axis=1).mean())
        record = CorrespondRecord(
            name=mesh.name, path=f"{mesh.name}.ply", hash="0" * 64, status="converged", seen_share=seen,
            covered_share=1.0, area_share=1.0, distance_mean=0.1, distance_p95=0.2, distance_p99=0.3, distance_max=0.4,
            scale=1.0, folded_share=0.0, area_factor=1.0, moved_share=[0.0], cpu_s=[1.0],
        )  # fmt: skip
        write_text(folder / f"{mesh.name}{CorrespondRecord.ENDING}", json_text(record))
    names = [mesh.name for mesh in subjects]
    summary = CorrespondenceRecord(
        template="s00 is the first template.", vertices=len(subjects[0].vertices), rounds=[0.0], corresponding=names,
        set_aside={}, settings={"rounds": 1, "settled": 0.002}, version="0.1.0", parts=parts,
    )  # fmt: skip
    write_text(folder / CorrespondenceRecord.FILE, json_text(summary))
    rows = [f"{name},{sex}" for name, sex in zip(names, sexes(len(names)), strict=True)]
    table = folder.parent / "people.csv"
    table.write_text("\n".join(["name,sex", *rows, ""]), encoding="utf-8")
    return table
