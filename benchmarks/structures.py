"""Are several structures of one subject brought into correspondence as well as one, and is their relative pose kept?

    python benchmarks/structures.py                       20 simulated limbs with femur, tibia and fibula
    python benchmarks/structures.py --limbs 60 --vertices 3000
    python benchmarks/structures.py fits --limbs 12       fits with given parts and with parts that are found


Limbs are samples of a published model of the pelvis and the lower limb (../shared/data/lower_limb, for tests only),
with a knee that is flexed by 0 to 40 degrees. The bones of a limb are raw scans in one frame: each has triangles of its
own, 0.2 mm of noise, and the limb has any pose and size. `correspond --parts` is compared with each bone alone. The
error of the relative pose is that of each bone against the femur, by the true places of the vertices.

`fits` builds a model of 60 limbs with true correspondences and fits it to new limbs of which 20 % of the points are
missing, and whose bones are at most 2 mm apart: to one scan of all bones in any pose, and to one scan per bone.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from correspondence import Known, Set, dispersion
from shapespace.cli import main as shapespace
from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
from shapespace.correspondence.template import clean_scan
from shapespace.datasets.simulated_scan import random_similarity, simulate_scan
from shapespace.fit.fit_scan import fit_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import faces_of, part_of
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.build_model import BuildConfig, build_model
from shapespace.model.shape_model import ShapeModel
from shapespace.types import IntArray, Mesh, Similarity

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "lower_limb"
BONES = {"femur": "Fem_R", "tibia": "Tib_R", "fibula": "Fib_R"}
FLEXION_DEG = 40.0
TRIANGLES, NOISE_MM = 6000, 0.2
TRAINING, MISSING, HOLE_MM, GAP_MM = 60, 0.2, 25.0, 1.5


class Limbs:
    """Samples of the model with a flexed knee, as bones in one frame."""

    def __init__(self) -> None:
        self._model = ShapeModel.load(DATA / "shape_model_right_side.pc.npz")
        rows = [
            line.split() for line in (DATA / "Coupled_SSM_node_nrs_per_bone_mesh_right.txt").read_text().splitlines()
        ]
        ranges = {row[0]: slice(int(row[1]), int(row[2])) for row in rows if len(row) == 3}
        faces, mean = faces_of(self._model.mesh()), self._model.mean_vertices
        self.means: dict[str, Mesh] = {}
        self._vertices_of: dict[str, IntArray] = {}
        for bone, label in BONES.items():
            own = ranges[label]
            inside = ((faces >= own.start) & (faces < own.stop)).all(axis=1)
            # The tibia has four edges with more than two triangles, which are parted.
            self.means[bone] = clean_scan(Mesh(mean[own], (faces[inside] - own.start).astype(np.int32), name=bone))
            self._vertices_of[bone] = cKDTree(mean[own]).query(self.means[bone].vertices)[1] + own.start
        self._knee = ranges["Fem_R"].start + np.loadtxt(DATA / "knee_node_nrs_femur_right.txt", dtype=int)

    def draw(self, rng: np.random.Generator) -> dict[str, Mesh]:
        """Return the bones of a random limb, mm."""
        b = np.clip(rng.standard_normal(self._model.n_modes), -2.5, 2.5) * self._model.stddev
        vertices = self._model.mesh(b).vertices
        bones = {bone: vertices[own] for bone, own in self._vertices_of.items()}
        knee = vertices[self._knee].mean(axis=0)
        flexed = Rotation.from_rotvec([np.deg2rad(rng.uniform(0.0, FLEXION_DEG)), 0, 0]).as_matrix()
        for bone in ("tibia", "fibula"):
            bones[bone] = (bones[bone] - knee) @ flexed.T + knee
        return {bone: self.means[bone].with_vertices(own) for bone, own in bones.items()}


def write_scans(limbs: Limbs, count: int, seed: int, folder: Path) -> dict[str, list[Known]]:
    """Write the scans NAME_BONE.ply of `count` limbs, and return them with their truth, by bone."""
    known: dict[str, list[Known]] = {bone: [] for bone in BONES}
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        T = random_similarity(rng, 180.0, (1.0, 1.0))
        for bone, mesh in limbs.draw(rng).items():
            made = simulate_scan(
                mesh, rng, triangles=TRIANGLES, noise_mm=NOISE_MM, T_scan_model=T, name=f"limb{k:02d}_{bone}"
            )
            write_mesh(folder / f"{made.scan.name}.ply", made.scan)
            known[bone].append(Known(made.scan, made.truth_vertices, T))
    return known


def surfaces(folder: Path, names: Sequence[str], template: Mesh) -> Correspondence:
    """Return the surfaces in a folder of a correspondence, as far as `dispersion` needs them."""
    scans: list[Corresponding] = []
    for name in names:
        file = folder / f"{name}.corresponding.ply"
        mesh = read_mesh(file) if file.is_file() else None
        scans.append(
            Corresponding(name, "excluded") if mesh is None
            else Corresponding(name, "", np.array(mesh.vertices), observed=mesh.observed)
        )  # fmt: skip
    return Correspondence(template, tuple(scans), "", ())


def relative_pose_errors(limbs: Limbs, known: dict[str, list[Known]], same: Path) -> dict[str, dict[str, float]]:
    """Return the median errors of the pose of each bone relative to the femur, degrees and mm at its centre.

    The pose of a bone is the rigid fit of its mean surface, on the vertices of the correspondence, to the surface; the
    true pose is the fit of the same points of the true mean to the true bone.
    """
    errors: dict[str, list[tuple[float, float]]] = {bone: [] for bone in BONES if bone != "femur"}
    poses: dict[str, list[tuple[Similarity, Similarity] | None]] = {}
    for bone, scans in known.items():
        mean = limbs.means[bone]
        names = [f"limb{k:02d}" for k in range(len(scans))]
        made = surfaces(same / bone, names, mean)
        there = [(scan.vertices, own) for scan, own in zip(made.scans, scans, strict=True) if scan.vertices is not None]
        # Median place of each vertex of the correspondence on the true mean.
        places = []
        for vertices, own in there:
            near = build_engine(Mesh(own.truth, mean.faces)).query(np.ascontiguousarray(vertices))
            places.append(np.einsum("mc,mcd->md", near.barycentric, mean.vertices[faces_of(mean)[near.triangle]]))
        middle = np.median(places, axis=0)
        near = build_engine(mean).query(np.ascontiguousarray(middle))
        corners = faces_of(mean)[near.triangle]
        poses[bone] = []
        for scan, own in zip(made.scans, scans, strict=True):
            if scan.vertices is None:
                poses[bone].append(None)
                continue
            truth = np.einsum("mc,mcd->md", near.barycentric, own.truth[corners])
            poses[bone].append((fit_similarity(middle, scan.vertices), fit_similarity(middle, truth)))
    for bone, found in errors.items():
        centre = limbs.means[bone].vertices.mean(axis=0)
        for own, femur in zip(poses[bone], poses["femur"], strict=True):
            if own is None or femur is None:
                continue
            # Relative pose in the frame of the femur: estimated and true.
            a, b = (femur[i].inverse() @ own[i] for i in (0, 1))
            angle = Rotation.from_matrix(a.rotation @ b.rotation.T).magnitude()
            found.append((float(np.rad2deg(angle)), float(np.linalg.norm(a.apply(centre) - b.apply(centre)))))
    return {
        bone: dict(zip(("degrees", "mm"), np.median(found, axis=0).tolist(), strict=True))
        for bone, found in errors.items()
    }


def thinned(mesh: Mesh, count: int) -> tuple[IntArray, IntArray]:
    """Return vertices of a mesh that are far from each other, and the triangles between them."""
    chosen = [0]
    distance = np.linalg.norm(mesh.vertices - mesh.vertices[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(mesh.vertices - mesh.vertices[chosen[-1]], axis=1))
    faces = cKDTree(mesh.vertices[chosen]).query(mesh.vertices)[1][faces_of(mesh)]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    faces = faces[np.sort(np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1])]
    used = np.unique(faces)
    return np.array(chosen)[used], np.searchsorted(used, faces).astype(np.int32)


def joined(bones: dict[str, Mesh]) -> Mesh:
    """Return all bones as one mesh."""
    starts = np.cumsum([0, *(len(bone.vertices) for bone in bones.values())])
    faces = [faces_of(bone) + start for bone, start in zip(bones.values(), starts, strict=False)]
    return Mesh(np.concatenate([bone.vertices for bone in bones.values()]), np.concatenate(faces).astype(np.int32))


def fits_with_given_and_found_parts(limbs: Limbs, count: int, seed: int, vertices: int) -> dict[str, object]:
    """Return the share of points that are given to their bone, and the errors of both fits, mm."""
    thin = {bone: thinned(mesh, vertices) for bone, mesh in limbs.means.items()}

    def coarse(bones: dict[str, Mesh]) -> Mesh:
        return joined({bone: Mesh(mesh.vertices[thin[bone][0]], thin[bone][1]) for bone, mesh in bones.items()})

    training = [coarse(limbs.draw(np.random.default_rng([seed, 1, k]))) for k in range(TRAINING)]
    counts = {bone: len(own[0]) for bone, own in thin.items()}
    model = build_model(training, BuildConfig(parts=counts, gauge="form"))
    rows: list[dict[str, object]] = []
    for k in range(count):
        rng = np.random.default_rng([seed, 2, k])
        bones = limbs.draw(rng)
        femur, tibia = (bones[bone].vertices for bone in ("femur", "tibia"))
        distance, nearest = cKDTree(femur).query(tibia)
        closest = int(distance.argmin())
        step = femur[nearest[closest]] - tibia[closest]
        step = step * max(0.0, 1.0 - GAP_MM / max(float(distance.min()), GAP_MM))
        for bone in ("tibia", "fibula"):
            bones[bone] = bones[bone].with_vertices(bones[bone].vertices + step)
        T = random_similarity(rng, 180.0, (1.0, 1.0))
        truth = T.apply(coarse(bones).vertices)
        every = joined(bones).vertices
        keep = np.ones(len(every), np.bool_)
        while keep.mean() > 1.0 - MISSING:
            keep &= np.linalg.norm(every - every[rng.integers(len(every))], axis=1) > HOLE_MM
        starts = np.cumsum([0, *(len(bone.vertices) for bone in bones.values())])
        scans: dict[str, Mesh] = {}
        for (bone, mesh), start in zip(bones.items(), starts, strict=False):
            noisy = mesh.vertices + NOISE_MM * rng.standard_normal(mesh.vertices.shape)
            scans[bone] = part_of(
                Mesh(T.apply(noisy), mesh.faces, name=f"limb{k:02d}_{bone}"), keep[start : start + len(mesh.vertices)]
            )
        label = np.repeat(np.arange(len(scans)), [len(scan.vertices) for scan in scans.values()])
        found, given = fit_scan(model, replace(joined(scans), name=f"limb{k:02d}")), fit_scan(model, scans)
        near = build_engine(found.surface()).query(joined(scans).vertices).vertex
        assert model.part_of_vertex is not None
        error_mm = [
            float(np.linalg.norm(fit.surface().vertices - truth, axis=1).mean()) for fit in (found, given)
        ]  # fmt: skip
        rows.append({
            "gap_mm": float(min(distance.min(), GAP_MM)), "status": [found.status, given.status],
            "own_bone": float((model.part_of_vertex[near] == label).mean()),
            "found_mm": error_mm[0], "given_mm": error_mm[1],
        })  # fmt: skip
        print(json.dumps(rows[-1]), flush=True)
    return {
        "own_bone": float(np.mean([row["own_bone"] for row in rows])),
        **{f"{how}_{name}": float(measure([row[how] for row in rows]))
           for how in ("found_mm", "given_mm") for name, measure in (("mean", np.mean), ("median", np.median))},
        "ratio_median": float(np.median([row["found_mm"] / row["given_mm"] for row in rows])),  # type: ignore[operator]
    }  # fmt: skip


def main() -> None:
    """Run the benchmark and print its figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("correspondence", "fits"), default="correspondence")
    parser.add_argument("--limbs", type=int, default=20)
    parser.add_argument("--vertices", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="folder of scans and results (default: a temporary one)")
    asked = parser.parse_args()
    limbs, start = Limbs(), time.perf_counter()
    if asked.what == "fits":
        print(
            json.dumps(fits_with_given_and_found_parts(limbs, asked.limbs, asked.seed, asked.vertices // 3), indent=2)
        )
        return
    with tempfile.TemporaryDirectory() as temporary:
        folder: Path = asked.folder or Path(temporary)
        scans, same, alone = folder / "scans", folder / "same", folder / "alone"
        scans.mkdir(parents=True, exist_ok=True)
        known = write_scans(limbs, asked.limbs, asked.seed, scans)
        options = ("--vertices", str(asked.vertices), "--quiet")
        code = shapespace(["correspond", str(scans), "--parts", *BONES, "-o", str(same), *options])
        names = [f"limb{k:02d}" for k in range(asked.limbs)]
        record = json.loads((same / "correspondence.json").read_text("utf-8"))
        result: dict[str, object] = {
            "limbs": asked.limbs, "code": code, "excluded": record["set_aside"], "doubtful": record["doubtful"],
        }  # fmt: skip
        for bone, mean in limbs.means.items():
            own = Set(
                known[bone], mean, np.ones(len(mean.vertices), np.bool_), float(np.ptp(mean.vertices, axis=0).max())
            )
            shapespace(["correspond", f"{scans}/*_{bone}.ply", "-o", str(alone / bone), *options])
            together = dispersion(surfaces(same / bone, names, mean), own)
            single = dispersion(surfaces(alone / bone, [f"{name}_{bone}" for name in names], mean), own)
            result[bone] = {"together_mm": together["mean_mm"], "alone_mm": single["mean_mm"]}
        result["relative_pose"] = relative_pose_errors(limbs, known, same)
        result["seconds"] = time.perf_counter() - start
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
