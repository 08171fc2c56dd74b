"""How well are landmarks transferred from 1, 3 and 5 marked specimens, and do their 90 % regions hold?

    python benchmarks/landmark_transfer.py                          molars, femora, faces
    python benchmarks/landmark_transfer.py molars --vertices 3000
    python benchmarks/landmark_transfer.py molars --folder same     an existing result of correspond

Molars (SHAPESPACE_DATA) have 16 landmarks of observers, femora and ICT faces 30 random points with known truth. Errors
are distances in percent of the RMS size, coverage is that of the 90 % regions; the constants of the regions were chosen
on the landmarks with even numbers, and `coverage` is of the others. Marked specimens are drawn at random, 10 times, or
suggested. Rigid: similarity by the corresponding vertices, then the closest point. TPS: thin-plate spline through 100
corresponding vertices.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from mirrored import molars
from scipy.interpolate import RBFInterpolator

from correspondence import faces, femora
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.landmark_transfer import MarkedSpecimens
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.store.corresponding import surface_files, surface_stem
from shapespace.store.results import mesh_at
from shapespace.types import BoolArray, FloatArray, Mesh

POINTS, DRAWS, SPLINE_POINTS = 30, 10, 100
SCATTERED = (0, 5)
"""Landmarks of the molars on which observers agree least."""


def molar_landmarks() -> dict[str, FloatArray]:
    """Return name -> (16, 3)."""
    stored = np.load(Path(os.environ["SHAPESPACE_DATA"]) / "molars" / "landmarks.npz")
    kept = np.delete(stored["landmarks"], SCATTERED, axis=1)
    return {Path(str(name)).stem: points for name, points in zip(stored["names"], kept, strict=True)}


def known(arguments: argparse.Namespace, kind: str) -> tuple[list[Mesh], set[str], list[Mesh], dict[str, FloatArray]]:
    """Return corresponding surfaces, the names of mirrored ones, scans, and the true landmarks."""
    if kind == "molars":
        scans, truth = molars(0)[0], molar_landmarks()
    else:
        made = {"femora": femora, "faces": faces}[kind](arguments.scans, arguments.seed)
        rows = np.random.default_rng(1).choice(np.flatnonzero(made.counted), POINTS, replace=False)
        scans, truth = [one.scan for one in made.known], {one.scan.name: one.truth[rows] for one in made.known}
    if kind == "molars" and arguments.folder:
        files = surface_files([arguments.folder])
        surfaces = [replace(mesh_at(file), name=surface_stem(file)) for file in files.files]
        return surfaces, {surface_stem(file) for file in files.mirrored}, scans, truth
    same = correspond(scans, CorrespondConfig(vertices=arguments.vertices, rounds=2, seed=arguments.seed))
    surfaces = [
        Mesh(one.vertices, same.template.faces, name=one.name, observed=one.observed)
        for one in same.scans
        if one.vertices is not None
    ]
    return surfaces, {one.name for one in same.scans if one.mirrored}, scans, truth


def baselines(source: Mesh, target: Mesh, scan: Mesh, points: FloatArray, flip: bool) -> tuple[FloatArray, FloatArray]:
    """Return `points` of one specimen on another by a similarity, and by a thin-plate spline."""
    sign = FLIP if flip else np.ones(3)
    pose = fit_similarity(source.vertices * sign, target.vertices)
    centres = np.linspace(0, len(source.vertices) - 1, SPLINE_POINTS).astype(int)
    posed, here = pose.apply(source.vertices[centres] * sign), pose.apply(points * sign)
    bent = RBFInterpolator(posed, target.vertices[centres], kernel="thin_plate_spline")(here)
    engine = build_engine(scan)
    return engine.query(np.ascontiguousarray(here)).points, engine.query(np.ascontiguousarray(bent)).points


def main() -> None:
    """Print a row for each set and choice of marked specimens."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "sets", nargs="*", choices=["molars", "femora", "faces", []], default=["molars", "femora", "faces"]
    )
    parser.add_argument("--vertices", type=int, default=1500)
    parser.add_argument("--scans", type=int, default=14)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    print("| set | marked | chosen | error, % | median, % | coverage, % | rigid, % | TPS, % |")
    print("|---|---|---|---|---|---|---|---|")
    for kind in arguments.sets:
        surfaces, mirrored, scans, truth = known(arguments, kind)
        by_name, raw = {mesh.name: mesh for mesh in surfaces}, {scan.name: scan for scan in scans}
        bare, rng = MarkedSpecimens.of(surfaces, {}, mirrored), np.random.default_rng(0)
        for count in (1, 3, 5):
            draws = [[str(n) for n in rng.choice(list(by_name), count, replace=False)] for _ in range(DRAWS)]
            for chosen, sets in (("random", draws), ("suggested", [[name for name, _ in bare.suggest(count)]])):
                errors: list[FloatArray] = []
                inside: list[BoolArray] = []
                others: list[list[float]] = []
                for names in sets:
                    marks = {name: {f"{k}": p for k, p in enumerate(truth[name])} for name in names}
                    marked = MarkedSpecimens.of(surfaces, marks, mirrored)
                    for name in by_name.keys() - marks.keys():
                        found, size = marked.transfer(name, raw[name]), rms_size(by_name[name].vertices)
                        off = np.linalg.norm(found.positions - truth[name], axis=1)
                        errors.append(off / size)
                        inside.append((off <= found.radius_90)[1::2])
                        if count == 1:
                            flip = (name in mirrored) != (names[0] in mirrored)
                            pair = baselines(by_name[names[0]], by_name[name], raw[name], truth[names[0]], flip)
                            others.append([float(np.linalg.norm(p - truth[name], axis=1).mean()) / size for p in pair])
                row = [100 * float(one) for one in (np.mean(errors), np.median(errors), np.mean(inside))]
                row += (100 * np.mean(others, axis=0)).tolist() if others else []
                cells = [f"{value:.1f}" for value in row] + [""] * (5 - len(row))
                print(f"| {kind} | {count} | {chosen} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
