"""How well do raw scans come into correspondence, with no model, template or landmarks?

    python benchmarks/correspondence.py                        24 faces, 24 femora, 12 spleens
    python benchmarks/correspondence.py faces --scans 48 --seed 7
    python benchmarks/correspondence.py femora --vertices 5000

Faces (ICT-FaceKit) and femora (samples of the open femur model) are known, so dispersion can be told: each vertex is
carried to the true surface of every scan, from there to the mean, and its distance from the median over scans is what
counts; 0 is perfect. Spleens are real, and only distances to their surfaces can be told, as shares of the diagonal.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from reliability import Femora

from shapespace.correspondence.rounds import Correspondence, CorrespondSettings, correspond
from shapespace.datasets.ict import LANDMARK_VERTICES, load_ict
from shapespace.datasets.simulated_scan import random_similarity, simulate_scan
from shapespace.geometry.closest import build_engine
from shapespace.io.meshes import read_mesh
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity

FACE_MM = 95.0
"""Of faces, what lies this near to the tip of the nose counts."""


@dataclass(frozen=True, eq=False)
class Known:
    """A raw scan and the true surface below it.

    Args:
        scan: as the method gets it.
        truth: (V, 3) in its frame.
        T_scan_model: from mm to its frame.
    """

    scan: Mesh
    truth: FloatArray
    T_scan_model: Similarity


def raw(mesh: Mesh, rng: np.random.Generator, triangles: int, name: str) -> Known:
    """Return `mesh` as a scanner would give it, in any pose."""
    T = random_similarity(rng, 180.0)
    made = simulate_scan(mesh, rng, triangles=triangles, noise_mm=0.2, T_scan_model=T, name=name)
    return Known(made.scan, made.truth_vertices, T)


def dispersion(made: Correspondence, known: list[Known], mean: Mesh, counted: BoolArray) -> dict[str, float]:
    """Return dispersion in mm on `mean`, over the vertices that lie near those `counted`, and to the true surface."""
    places, gaps = [], []
    for one, truth in zip(made.scans, known, strict=True):
        if one.vertices is None:
            continue
        there = np.isfinite(one.vertices).all(axis=1)
        near = build_engine(Mesh(truth.truth, mean.faces)).query(np.ascontiguousarray(one.vertices[there]))
        place, gap = np.full(one.vertices.shape, np.nan), np.full(len(there), np.nan)
        place[there] = np.einsum("mc,mcd->md", near.barycentric, mean.vertices[mean.faces[near.triangle]])
        gap[there] = near.distance / truth.T_scan_model.scale
        places.append(place)
        gaps.append(gap)
    place, gap = np.array(places), np.array(gaps)
    shown = np.isfinite(place[:, :, 0]).any(axis=0)
    place, gap = place[:, shown], gap[:, shown]
    middle = np.nanmedian(place, axis=0)
    inside = counted[build_engine(mean).query(middle).vertex]
    apart = np.linalg.norm(place - middle, axis=2)[:, inside]
    return {
        "mean_mm": float(np.nanmean(apart)),
        "median_mm": float(np.nanmedian(apart)),
        "p95_mm": float(np.nanquantile(apart, 0.95)),
        "worst_scan_mm": float(np.nanmean(apart, axis=1).max()),
        "to_true_surface_mm": float(np.nanmean(gap[:, inside])),
        "seen": float(np.isfinite(place[:, :, 0]).mean()),
    }


def faces(scans: int, seed: int, settings: CorrespondSettings) -> tuple[Correspondence, dict[str, float]]:
    """Simulated people, heads and necks, 30,000 triangles."""
    ict, rng = load_ict(), np.random.default_rng(seed)
    people = enumerate(ict.draw_people(scans, 77 + seed))
    known = [raw(ict.mesh(weights), rng, 30_000, f"person{k}") for k, weights in people]
    mean = ict.mesh()
    counted = np.linalg.norm(mean.vertices - mean.vertices[LANDMARK_VERTICES["nose_3"]], axis=1) < FACE_MM
    made = correspond([one.scan for one in known], settings)
    return made, dispersion(made, known, mean, counted)


def femora(scans: int, seed: int, settings: CorrespondSettings) -> tuple[Correspondence, dict[str, float]]:
    """Samples of the femur model, 12,000 triangles."""
    femur, rng = Femora(), np.random.default_rng(seed)
    drawn = [femur.draw(rng) for _ in range(scans)]
    known = [raw(mesh, rng, 12_000, f"femur{k}") for k, mesh in enumerate(drawn)]
    mean = Mesh(femur._model[0], drawn[0].faces)
    made = correspond([one.scan for one in known], settings)
    told = dispersion(made, known, mean, np.ones(len(mean.vertices), dtype=np.bool_))
    return made, told | {"mean_share_of_length": told["mean_mm"] / float(np.ptp(mean.vertices, axis=0).max())}


def spleens(scans: int, seed: int, settings: CorrespondSettings) -> tuple[Correspondence, dict[str, float]]:
    """Real spleens, from `spleens/` of the folder that SHAPESPACE_DATA names."""
    files = sorted((Path(os.environ.get("SHAPESPACE_DATA", ".")) / "spleens").glob("*.ply"))
    if not files:
        raise SystemExit("The spleens are not here; set SHAPESPACE_DATA to the folder that holds spleens/.")
    chosen = np.sort(np.random.default_rng(seed).permutation(len(files))[:scans])
    meshes = [read_mesh(files[k]) for k in chosen]
    made = correspond(meshes, settings)
    diagonal = [float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for mesh in meshes]
    shares = [
        np.array(one.distance) / length
        for one, length in zip(made.scans, diagonal, strict=True)
        if one.vertices is not None
    ]
    mean, p95, p99, largest = np.mean(shares, axis=0)
    return made, {"mean_share": mean, "p95_share": p95, "p99_share": p99, "largest_share": largest}


CASES: dict[str, tuple[Callable[..., tuple[Correspondence, dict[str, float]]], int]] = {
    "faces": (faces, 24),
    "femora": (femora, 24),
    "spleens": (spleens, 12),
}


def main() -> None:
    """Run the cases that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[*CASES, []], default=[])
    parser.add_argument("--scans", type=int)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--vertices", type=int, default=CorrespondSettings.vertices)
    parser.add_argument("--rounds", type=int, default=CorrespondSettings.rounds)
    arguments = parser.parse_args()
    for name in arguments.cases or CASES:
        case, usual = CASES[name]
        settings = CorrespondSettings(vertices=arguments.vertices, rounds=arguments.rounds)
        begun = time.process_time()
        made, told = case(arguments.scans or usual, arguments.seed, settings)
        seconds = [second for one in made.scans for second in one.seconds]
        aside = {one.name: one.reason for one in made.scans if one.reason}
        told |= {"cpu_s": time.process_time() - begun, "cpu_s_a_scan_and_round": float(np.mean(seconds))}
        moved = [round(share, 4) for share in made.moved]
        print(
            json.dumps({"case": name, "scans": len(made.scans), **told, "moved": moved, "set_aside": aside}, indent=1)
        )


if __name__ == "__main__":
    main()
