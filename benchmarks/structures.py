"""Are several structures of one subject brought into correspondence as well as one, and is their relative pose kept?

    python benchmarks/structures.py                       20 simulated limbs with femur, tibia, fibula and pelvis
    python benchmarks/structures.py --limbs 60 --vertices 3000
    python benchmarks/structures.py fits --limbs 12       fits with given parts and with parts that are found
    python benchmarks/structures.py models                a model of shape and pose, and one of stacked vertices
    python benchmarks/structures.py unusual --limbs 300   false and true findings of unusual relative poses

Limbs are samples of a published model of the pelvis and the lower limb (../shared/data/lower_limb, for tests only),
whose bones are moved to the gaps of the mean, and whose knee is flexed by 0 to 40 degrees. The bones of a limb are raw
scans in one frame: each has triangles of its own, 0.2 mm of noise, and the limb has any pose and size. `correspond
--parts` is compared with each bone alone. The error of the relative pose is that of each bone against the femur, by the
true places of the vertices. The same error is stated for the exact surfaces without noise, to which the true mean is
fitted rigidly: less is not to be expected, since vertices of the published model slide about the axis of slender bones,
which their surfaces do not show.

`fits` builds a model of 60 limbs with true correspondences and fits it to new limbs of which 20 % of the points are
missing, and whose bones are at most 2 mm apart: to one scan of all bones in any pose, and to one scan per bone.
`models` compares the errors of 15 new limbs, with the same number of modes, over five collections of 60 limbs.
`unusual` looks for relative poses in collections of 6, 12, 20 and 40 clean limbs, and in the same ones with a tibia
that is rotated at random and moved by 100 mm in each direction (standard deviation); --limbs is then the number of
collections.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from correspondence import Known, Set, dispersion
from shapespace.cli import main as shapespace
from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
from shapespace.correspondence.joined_parts import join_parts
from shapespace.correspondence.scan_status import SurfaceMeasures
from shapespace.correspondence.template import clean_scan
from shapespace.datasets.simulated_scan import random_similarity, simulate_scan
from shapespace.fit.fit_scan import fit_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import faces_of, part_of
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.build_model import BuildConfig, RelativePose, build_model
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "lower_limb"
BONES = {"femur": "Fem_R", "tibia": "Tib_R", "fibula": "Fib_R", "pelvis": "Pel_R"}
FLEXION_DEG = 40.0
TRIANGLES, NOISE_MM = 6000, 0.2
TRAINING, HELD, MISSING, HOLE_MM, GAP_MM = 60, 15, 0.2, 25.0, 1.5
POINTS, STEPS = 1500, 60  # of the rigid fits of exact surfaces
DRAWN, SPARSE = 1000, 60  # limbs from which collections are drawn, and vertices of each of their bones


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
        self._near = {
            bone: (self._nearest(bone, "femur"), self._nearest("femur", bone)) for bone in ("tibia", "pelvis")
        }
        means = {bone: mean.vertices for bone, mean in self.means.items()}
        self._gap = {bone: self._gap_of(means, bone) for bone in self._near}

    def _nearest(self, bone: str, other: str) -> IntArray:
        """Return the twentieth of a bone's vertices that is nearest to another bone."""
        distance = cKDTree(self.means[other].vertices).query(self.means[bone].vertices)[0]
        return np.argsort(distance)[: len(distance) // 20]

    def _gap_of(self, bones: dict[str, FloatArray], bone: str) -> FloatArray:
        own, femur = self._near[bone]
        return bones[bone][own].mean(axis=0) - bones["femur"][femur].mean(axis=0)

    def draw(self, rng: np.random.Generator) -> dict[str, Mesh]:
        """Return the bones of a random limb, mm."""
        b = np.clip(rng.standard_normal(self._model.n_modes), -2.5, 2.5) * self._model.stddev
        vertices = self._model.mesh(b).vertices
        bones = {bone: vertices[own] for bone, own in self._vertices_of.items()}
        # Bones of large samples of the model are 60 mm apart or inside each other (standard deviation).
        for bone, moving in (("tibia", ("tibia", "fibula")), ("pelvis", ("pelvis",))):
            off = self._gap_of(bones, bone) - self._gap[bone]
            bones |= {own: bones[own] - off for own in moving}
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


def rigid_fit(points: FloatArray, surface: Mesh, T: Similarity) -> Similarity:
    """Return the similarity of `points` (N, 3) to a surface by ICP from `T`."""
    engine = build_engine(surface)
    for _ in range(STEPS):
        T = fit_similarity(points, engine.query(np.ascontiguousarray(T.apply(points))).points)
    return T


Poses = list[tuple[Similarity, Similarity] | None]


def error_of(own: Poses, femur: Poses, mean: Mesh) -> dict[str, float]:
    """Return the median errors of the pose of a bone relative to the femur: degrees, degrees of its long axis, and mm
    at its centre; from its estimated and true poses and those of the femur."""
    centre, errors = mean.vertices.mean(axis=0), list[tuple[float, float, float]]()
    axis = np.linalg.svd(mean.vertices - centre, full_matrices=False)[2][0]
    for bone, reference in zip(own, femur, strict=True):
        if bone is None or reference is None:
            continue
        a, b = (reference[i].inverse() @ bone[i] for i in (0, 1))
        change = Rotation.from_matrix(a.rotation.T @ b.rotation)
        of_axis = np.arccos(np.clip(axis @ change.apply(axis), -1, 1))
        off = float(np.linalg.norm(a.apply(centre) - b.apply(centre)))
        errors.append((float(np.rad2deg(change.magnitude())), float(np.rad2deg(of_axis)), off))
    return dict(zip(("degrees", "degrees_of_axis", "mm"), np.median(errors, axis=0).tolist(), strict=True))


def relative_pose_errors(limbs: Limbs, known: dict[str, list[Known]], same: Path) -> dict[str, dict[str, float]]:
    """Return the median errors of the pose of each bone relative to the femur, and those of exact surfaces.

    The pose of a bone is the rigid fit of its mean surface, on the vertices of the correspondence, to the surface; the
    true pose is the fit of the same points of the true mean to the true bone.
    """
    poses: dict[str, Poses] = {}
    exact: dict[str, Poses] = {}
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
        points = mean.vertices[:: max(1, len(mean.vertices) // POINTS)]
        poses[bone], exact[bone] = [], []
        for scan, own in zip(made.scans, scans, strict=True):
            T = fit_similarity(mean.vertices, own.truth)
            exact[bone].append((rigid_fit(points, Mesh(own.truth, mean.faces), T), T))
            if scan.vertices is None:
                poses[bone].append(None)
                continue
            truth = np.einsum("mc,mcd->md", near.barycentric, own.truth[corners])
            poses[bone].append((fit_similarity(middle, scan.vertices), fit_similarity(middle, truth)))
    found: dict[str, dict[str, float]] = {}
    for bone, mean in limbs.means.items():
        if bone != "femur":
            found[bone] = error_of(poses[bone], poses["femur"], mean)
            found[f"{bone}, exact surfaces"] = error_of(exact[bone], exact["femur"], mean)
    return found


def unusual_poses(limbs: Limbs, collections: int, seed: int) -> dict[str, dict[str, float]]:
    """Return the share of clean collections with a finding, and that of found errors, by the number of limbs."""
    drawn = [limbs.draw(np.random.default_rng([seed, k])) for k in range(DRAWN)]
    bones = ("femur", "tibia", "fibula")
    rows = {bone: np.linspace(0, len(limbs.means[bone].vertices) - 1, SPARSE).astype(int) for bone in bones}
    good = SurfaceMeasures(distance=0.01, folded=0, missing=0, unreached=0, area_change=1.1, not_settled=0.001)
    face, found = np.array([[0, 1, 2]], np.int32), dict[str, dict[str, float]]()
    for count in (6, 12, 20, 40):
        rng, false, true = np.random.default_rng(seed), 0, 0
        for _ in range(collections):
            own = [drawn[k] for k in rng.choice(DRAWN, count, replace=False)]
            vertices = {bone: [np.array(limb[bone].vertices[rows[bone]]) for limb in own] for bone in bones}
            wrong = Similarity(1.0, Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 100, 3))
            for is_wrong in (False, True):
                if is_wrong:
                    vertices["tibia"][0] = wrong.apply(vertices["tibia"][0])
                parts = {
                    bone: Correspondence(
                        Mesh(every[0], face),
                        tuple(
                            Corresponding(
                                f"limb{k}", "", x, Similarity.identity(), 1.0, 1.0, (0.0, 0.0, 0.0, 0.0), (0.01,),
                                (1.0,), status="converged", measures=good,
                            )
                            for k, x in enumerate(every)
                        ), "", (0.01,),
                    )
                    for bone, every in vertices.items()
                }  # fmt: skip
                doubtful = [scan.name for scan in join_parts(parts).scans if scan.doubt]
                true += is_wrong and "limb0" in doubtful
                false += not is_wrong and bool(doubtful)
        found[str(count)] = {"false": false / collections, "true": true / collections}
    return found


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


def coarse_limbs(limbs: Limbs, vertices: int) -> tuple[dict[str, int], Callable[[dict[str, Mesh]], Mesh]]:
    """Return the numbers of vertices of coarse bones, and the function that makes them of the bones of a limb."""
    thin = {bone: thinned(mesh, vertices) for bone, mesh in limbs.means.items()}

    def coarse(bones: dict[str, Mesh]) -> Mesh:
        return joined({bone: Mesh(mesh.vertices[thin[bone][0]], thin[bone][1]) for bone, mesh in bones.items()})

    return {bone: len(own[0]) for bone, own in thin.items()}, coarse


def fits_with_given_and_found_parts(limbs: Limbs, count: int, seed: int, vertices: int) -> dict[str, object]:
    """Return the share of points that are given to their bone, and the errors of both fits, mm."""
    counts, coarse = coarse_limbs(limbs, vertices)
    training = [coarse(limbs.draw(np.random.default_rng([seed, 1, k]))) for k in range(TRAINING)]
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


def stacked_and_jointed(limbs: Limbs, vertices: int, seeds: int, numbers: Sequence[int]) -> list[dict[str, float]]:
    """Return the errors of limbs that are not in a model of shape and pose, and in one of stacked vertices.

    Args:
        limbs: limbs, `TRAINING` for each model and `HELD` for its error.
        vertices: number of vertices of each bone.
        seeds: number of collections.
        numbers: numbers of modes.

    Returns:
        For each number of modes the mean RMS distance of vertices, mm, of both models, and their ratio.
    """
    errors: dict[str, list[list[float]]] = {"kept": [], "modelled": []}
    parts, coarse = coarse_limbs(limbs, vertices)
    for seed in range(seeds):
        rng = np.random.default_rng([seed, 3])
        meshes = [replace(coarse(limbs.draw(rng)), name=f"limb{k:02d}") for k in range(TRAINING + HELD)]
        for pose, found in errors.items():
            model = build_model(
                meshes[:TRAINING], BuildConfig(parts=parts, relative_pose=cast(RelativePose, pose), gauge="form")
            )
            found.append([])
            for number in numbers:
                own = model.truncate(number)
                made = [own.reconstruct(own.project(mesh)).reshape(-1, 3) for mesh in meshes[TRAINING:]]
                found[-1].append(float(np.mean([_rms(*pair) for pair in zip(made, meshes[TRAINING:], strict=True)])))
    means = {pose: np.mean(found, axis=0) for pose, found in errors.items()}
    return [
        {"modes": number, "stacked_mm": a, "jointed_mm": b, "ratio": b / a}
        for number, a, b in zip(numbers, means["kept"].tolist(), means["modelled"].tolist(), strict=True)
    ]


def _rms(vertices: FloatArray, truth: Mesh) -> float:
    off = fit_similarity(vertices, truth.vertices, with_scale=False).apply(vertices) - truth.vertices
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def main() -> None:
    """Run the benchmark and print its figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "what", nargs="?", choices=("correspondence", "fits", "models", "unusual"), default="correspondence"
    )
    parser.add_argument("--limbs", type=int, default=20)
    parser.add_argument("--vertices", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, help="folder of scans and results (default: a temporary one)")
    asked = parser.parse_args()
    limbs, start = Limbs(), time.perf_counter()
    others: dict[str, Callable[[], object]] = {
        "fits": lambda: fits_with_given_and_found_parts(limbs, asked.limbs, asked.seed, asked.vertices // 3),
        "models": lambda: stacked_and_jointed(limbs, asked.vertices // 5, 5, (3, 5, 8, 11, 15)),
        "unusual": lambda: unusual_poses(limbs, asked.limbs, asked.seed),
    }
    if asked.what in others:
        print(json.dumps(others[asked.what](), indent=2))
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
