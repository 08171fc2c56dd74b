"""Do figures whose limbs move far come into correspondence, and are wrong ones found?

    python benchmarks/articulated.py                            5 bodies in 10 poses each, about an hour
    python benchmarks/articulated.py --bodies 1 --vertices 2000

Simple figures (capsules with feet, thumbs and a nose) by linear blend skinning: bodies differ in the lengths and widths
of their bones, poses in the rotations of their joints. Each figure has its own triangles and any pose in space. Points
of a scan are carried to every other scan by the surfaces in correspondence. The error is the distance from the true
place, 100 x share of the square root of the area. A scan is wrong if its mean error from the others is above `WRONG`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.parallel_rounds import RoundRunner
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.groupwise import correspond, run_here
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.simulated_scan import random_similarity, simulate_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import face_areas, faces_of
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

VOXEL_MM = 15.0
WRONG = 5.0
"""Mean error of a scan over its pairs, 100 x share of the square root of the area, above which it is wrong."""
POINTS = 1000  # vertices that errors are measured at
APART_MM = 60.0
"""Limbs of a pose lie at least this far from each other and from the trunk, as if the scans had no contact."""
LIMBS = {
    "trunk": (None, (0, 1000, 0), (0, 1350, 0), 130, 145),
    "pelvis": ("trunk", (0, 1000, 0), (0, 930, -15), 130, 125),
    "head": ("trunk", (0, 1400, 0), (0, 1640, 15), 50, 95),
}
"""Of each bone: its parent, its ends in mm (y up, z forwards), and the radii there."""
for side, x in (("left", 1), ("right", -1)):
    LIMBS |= {
        f"{side} arm": ("trunk", (160 * x, 1400, 0), (390 * x, 1250, -10), 62, 48),
        f"{side} forearm": (f"{side} arm", (390 * x, 1250, -10), (590 * x, 1110, 10), 46, 34),
        f"{side} hand": (f"{side} forearm", (590 * x, 1110, 10), (710 * x, 1030, 20), 36, 28),
        f"{side} thigh": ("pelvis", (85 * x, 900, 0), (120 * x, 490, 5), 88, 58),
        f"{side} shin": (f"{side} thigh", (120 * x, 490, 5), (140 * x, 80, -15), 56, 42),
        f"{side} foot": (f"{side} shin", (140 * x, 50, -25), (165 * x, 35, 170), 45, 32),
    }
BUMPS = (
    ("head", (0, 1640, 15), (0, 1610, 125), 30, 18),
    ("left hand", (620, 1090, 12), (660, 1100, 75), 20, 15),
    ("right hand", (-620, 1090, 12), (-660, 1100, 75), 20, 15),
    ("pelvis", (60, 960, -60), (60, 930, -90), 90, 85),
    ("pelvis", (-60, 960, -60), (-60, 930, -90), 90, 85),
)
"""Nose, thumbs and seat, each a part of a bone."""
TURNS_DEG = {"arm": (55, 45, 60), "forearm": (10, 75, 10), "hand": (20, 20, 20), "thigh": (50, 15, 22),
             "shin": (40, 5, 0), "foot": (15, 10, 5), "head": (15, 30, 12), "pelvis": (12, 15, 8),
             "trunk": (0, 0, 0)}  # fmt: skip
"""Largest rotation of each bone against its parent about x, y and z, either way."""
BLEND_MM = 28.0  # width of the transition of skinning weights


def _distance(points: FloatArray, a: FloatArray, b: FloatArray, radius_a: float, radius_b: float) -> FloatArray:
    """Return (M,) the distance of points from a segment whose radius changes along it; negative inside."""
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    gap = np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)
    return gap - radius_a - along * (radius_b - radius_a)


def _distances(points: FloatArray) -> dict[str, FloatArray]:
    """Return the distances of points from each bone, with its bumps."""
    ends = {
        name: _distance(points, np.array(a, float), np.array(b, float), r, s) for name, (_, a, b, r, s) in LIMBS.items()
    }
    for name, a, b, r, s in BUMPS:
        ends[name] = np.minimum(ends[name], _distance(points, np.array(a, float), np.array(b, float), r, s))
    return ends


def _field(points: FloatArray) -> FloatArray:
    """Return (M,) a smooth minimum of the distances from all bones."""
    sharpness = 12.0
    stacked = np.stack(list(_distances(points).values()))
    least = stacked.min(axis=0)
    return least - sharpness * np.log(np.exp(-(stacked - least) / sharpness).sum(axis=0))


def rest_figure() -> Mesh:
    """Return the figure at rest: a net of the cells that the level 0 of the field passes, its vertices put onto it."""
    axes = [np.arange(low, high, VOXEL_MM) for low, high in ((-850, 850), (-80, 1850), (-280, 300))]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = _field(grid.reshape(-1, 3)).reshape(grid.shape[:3])
    inside = values < 0
    cells = np.stack([inside[i : len(axes[0]) - 1 + i, j : len(axes[1]) - 1 + j, k : len(axes[2]) - 1 + k]
                      for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip
    passed = cells.any(axis=0) & ~cells.all(axis=0)
    number = np.full(passed.shape, -1)
    number[passed] = np.arange(passed.sum())
    x = grid[:-1, :-1, :-1][passed] + 0.5 * VOXEL_MM
    faces: list[FloatArray] = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        first = np.moveaxis(inside, (axis, u, v), (0, 1, 2))
        numbers = np.moveaxis(number, (axis, u, v), (0, 1, 2))
        crossed = first[:-1, 1:-1, 1:-1] != first[1:, 1:-1, 1:-1]
        i, j, k = np.nonzero(crossed)
        quad = np.stack(
            [numbers[i, j, k], numbers[i, j + 1, k], numbers[i, j + 1, k + 1], numbers[i, j, k + 1]], axis=1
        )
        quad = np.where(first[i, j + 1, k + 1][:, None], quad, quad[:, ::-1])
        faces += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    for _ in range(8):
        step = 0.5
        slope = np.stack([(_field(x + step * e) - _field(x - step * e)) / (2 * step) for e in np.eye(3)], axis=1)
        x = x - 0.7 * (_field(x) / (slope**2).sum(axis=1))[:, None] * slope
    return Mesh(x, np.concatenate(faces).astype(np.int32), name="figure")


def skinning_weights(points: FloatArray) -> FloatArray:
    """Return (M, B) the weights of the bones, in the order of `LIMBS`, that sum to 1."""
    stacked = np.stack(list(_distances(points).values()), axis=1)
    near = np.exp(-(((stacked - stacked.min(axis=1, keepdims=True)) / BLEND_MM) ** 2))
    near[near < 0.02] = 0
    return near / near.sum(axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class Body:
    """Lengths and widths of the bones of a body, ratios to those of the figure at rest, in the order of `LIMBS`."""

    length: FloatArray
    width: FloatArray

    @staticmethod
    def draw(rng: np.random.Generator) -> Body:
        """Return a random body, alike on both sides."""
        names = [name.split()[-1] for name in LIMBS]
        tall, wide = 1 + 0.07 * rng.standard_normal(), 1 + 0.1 * rng.standard_normal()
        own = {
            name: (tall + 0.06 * rng.standard_normal(), wide + 0.08 * rng.standard_normal())
            for name in dict.fromkeys(names)
        }
        return Body(*(np.clip([own[name][k] for name in names], 0.75, 1.3) for k in (0, 1)))


def draw_pose(rng: np.random.Generator, extent: float) -> dict[str, Rotation]:
    """Return random rotations of the bones against their parents; `extent` 0 is the pose at rest."""
    pose: dict[str, Rotation] = {}
    for name in LIMBS:
        largest = np.array(TURNS_DEG[name.split()[-1]], float)
        drawn = extent * largest * rng.uniform(-1, 1, 3)
        if name.endswith("shin"):
            drawn[0] = extent * 2 * largest[0] * rng.uniform(0, 1)
        if name.endswith("forearm"):
            drawn[1] = extent * (-1 if name.startswith("left") else 1) * 1.3 * largest[1] * rng.uniform(0, 1)
        if name.endswith("thigh"):
            drawn[0] = -abs(drawn[0]) if rng.random() < 0.7 else 0.4 * drawn[0]
        pose[name] = Rotation.from_euler("xyz", drawn, degrees=True)
    return pose


def skinned(rest: FloatArray, weights: FloatArray, body: Body, pose: dict[str, Rotation]) -> FloatArray:
    """Return the vertices (V, 3) of a body in a pose."""
    names = list(LIMBS)
    turned: dict[str, FloatArray] = {}
    joints: dict[str, FloatArray] = {}
    out = np.zeros_like(rest)
    for k, name in enumerate(names):
        parent, a, b, _, _ = LIMBS[name]
        a, b = np.array(a, float), np.array(b, float)
        axis = (b - a) / np.linalg.norm(b - a)
        stretch = body.width[k] * (np.eye(3) - np.outer(axis, axis)) + body.length[k] * np.outer(axis, axis)
        above = np.eye(3) if parent is None else turned[parent]
        turned[name] = above @ pose[name].as_matrix()
        joints[name] = a if parent is None else _place(names, joints, turned, body, parent, a)
        out += weights[:, k : k + 1] * (joints[name] + (rest - a) @ (turned[name] @ stretch).T)
    return out


def _place(
    names: list[str],
    joints: dict[str, FloatArray],
    turned: dict[str, FloatArray],
    body: Body,
    bone: str,
    point: FloatArray,
) -> FloatArray:
    """Return where a point of a bone at rest is."""
    _, a, b, _, _ = LIMBS[bone]
    a, b, k = np.array(a, float), np.array(b, float), names.index(bone)
    axis = (b - a) / np.linalg.norm(b - a)
    stretch = body.width[k] * (np.eye(3) - np.outer(axis, axis)) + body.length[k] * np.outer(axis, axis)
    return joints[bone] + turned[bone] @ stretch @ (point - a)


def _is_free(x: FloatArray, weights: FloatArray) -> bool:
    """Return whether no limb touches another one or the trunk."""
    from scipy.spatial import cKDTree

    names = list(LIMBS)
    part = np.array([_chain(name) for name in names])[weights.argmax(axis=1)]
    own = np.array([name.split()[-1] for name in names])[weights.argmax(axis=1)]
    far = np.isin(own, ["forearm", "hand", "shin", "foot"])
    for limb in np.unique(part[far]):
        tips, others = x[(part == limb) & far], x[part != limb]
        if np.min(cKDTree(others).query(tips)[0]) < APART_MM:
            return False
    return True


def _chain(name: str) -> str:
    words = name.split()
    return "trunk" if len(words) == 1 else f"{words[0]} {'arm' if words[1] in ('arm', 'forearm', 'hand') else 'leg'}"


@dataclass(frozen=True, eq=False)
class Figure:
    """A raw scan and its truth.

    Args:
        scan: as the method gets it.
        truth: (V, 3) in its frame.
        name: of body and pose.
    """

    scan: Mesh
    truth: FloatArray
    name: str


def figures(bodies: int, poses: int, seed: int, triangles: int = 12_000) -> list[Figure]:
    """Return `bodies` in `poses` each; the first pose of each is nearly that at rest."""
    rest = rest_figure()
    weights = skinning_weights(rest.vertices)
    drawn: list[Figure] = []
    for b in range(bodies):
        rng = np.random.default_rng([seed, b])
        body = Body.draw(rng)
        for p in range(poses):
            x = skinned(rest.vertices, weights, body, draw_pose(rng, 0.15))
            while p and not _is_free(x := skinned(rest.vertices, weights, body, draw_pose(rng, 1.0)), weights):
                pass
            T: Similarity = random_similarity(rng, 180.0, (0.9, 1.1))
            mesh = Mesh(x, rest.faces, name=f"body{b}_pose{p}")
            made = simulate_scan(mesh, rng, triangles=triangles, noise_mm=1.0, T_scan_model=T, name=mesh.name)
            drawn.append(Figure(made.scan, made.truth_vertices, mesh.name))
    return drawn


def pair_errors(made: Correspondence, known: list[Figure], faces: IntArray) -> FloatArray:
    """Return (N, N, P) the errors of points carried from each scan to each other, 100 x share of sqrt(area).

    Not-a-number for excluded scans and a scan itself.
    """
    points = np.random.default_rng(0).permutation(len(known[0].truth))[:POINTS]
    errors = np.full((len(known), len(known), len(points)), np.nan)
    for i, (one, truth) in enumerate(zip(made.scans, known, strict=True)):
        if one.vertices is None:
            continue
        near = build_engine(Mesh(one.vertices, made.template.faces)).query(np.ascontiguousarray(truth.truth[points]))
        corners = faces_of(made.template)[near.triangle]
        for j, (other, goal) in enumerate(zip(made.scans, known, strict=True)):
            if other.vertices is not None and i != j:
                place = np.einsum("pc,pcd->pd", np.asarray(near.barycentric), other.vertices[corners])
                root = np.sqrt(face_areas(Mesh(goal.truth, faces)).sum())
                errors[i, j] = 100 * np.linalg.norm(place - goal.truth[points], axis=1) / root
    return errors


def report_of(made: Correspondence, known: list[Figure], faces: IntArray) -> dict[str, object]:
    """Return the figures of a correspondence."""
    errors = pair_errors(made, known, faces)
    pairs = errors.mean(axis=2)
    with warnings.catch_warnings():  # excluded scans have no pairs
        warnings.simplefilter("ignore", RuntimeWarning)
        scan = np.nanmedian(np.hstack([pairs, pairs.T]), axis=1)
    return {
        "mean": float(np.nanmean(errors)), "median": float(np.nanmedian(errors)),
        "p95": float(np.nanquantile(errors, 0.95)),
        "worst_pair": float(np.nanmax(pairs)), "pairs_above_5": float((pairs[np.isfinite(pairs)] > WRONG).mean()),
        "wrong": [one.name for one, error in zip(known, scan, strict=True) if error > WRONG],
        "wrong_converged": [
            one.name for one, error in zip(made.scans, scan, strict=True) if error > WRONG and one.status == "converged"
        ],
        "right_doubtful": [
            one.name for one, error in zip(made.scans, scan, strict=True) if error <= WRONG and one.status == "doubtful"
        ],
        "excluded": {one.name: one.reason for one in made.scans if one.vertices is None},
        "scan_errors": {one.name: round(float(error), 2) for one, error in zip(known, scan, strict=True)},
    }  # fmt: skip


def main() -> None:
    """Print the figures of a correspondence of all figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--bodies", type=int, default=5)
    parser.add_argument("--poses", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--vertices", type=int, default=4000)
    parser.add_argument("--rounds", type=int, default=CorrespondConfig.rounds)
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    known = figures(arguments.bodies, arguments.poses, arguments.seed)
    config = CorrespondConfig(vertices=arguments.vertices, rounds=arguments.rounds)
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        kept = RoundRunner(Path(folder), ExecutionConfig(jobs=arguments.jobs), quiet=True, on_done=lambda: None)
        made = correspond([one.scan for one in known], config, run=run_here if arguments.jobs < 2 else kept)
    faces = rest_figure().faces
    assert faces is not None
    print(
        json.dumps({**vars(arguments), **report_of(made, known, faces), "cpu_s": time.process_time() - begun}, indent=1)
    )


if __name__ == "__main__":
    main()
