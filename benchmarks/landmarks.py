"""Displacement of landmarks that a model stores in triangles, and at the nearest vertices (version 1).

Landmarks are random points of the surface of bundled faces (`--ict`: of ICT-FaceKit). Rows: on the first mesh after
`build`, and in fits of raw scans of people who are not in the model. `--meshes` and `--landmarks` measure files of your
own: meshes, and landmark files named as these, each placed on its own mesh.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapespace.datasets.faces import load_faces
from shapespace.datasets.ict import load_ict
from shapespace.datasets.simulated_scan import random_similarity, simulate_scan
from shapespace.errors import ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.normals import rms_size
from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS, read_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks

MARKS = 50


def people(count: int, rng: np.random.Generator, *, ict: bool) -> list[Mesh]:
    if ict:
        data = load_ict()
        return [data.mesh(one) for one in data.draw_people(count, int(rng.integers(2**31)))]
    faces = load_faces()
    return [faces.cut_to_face(faces.face(faces.draw_person(rng))) for _ in range(count)]


def random_points(mesh: Mesh, rng: np.random.Generator) -> dict[str, FloatArray]:
    faces = np.asarray(mesh.faces)[rng.choice(len(np.asarray(mesh.faces)), MARKS, replace=False)]
    points = np.einsum("lc,lcd->ld", rng.dirichlet(np.ones(3), MARKS), mesh.vertices[faces])
    return {f"mark {k}": point for k, point in enumerate(points)}


def row(name: str, exact: FloatArray, snapped: FloatArray, unit: str) -> None:
    cells = [f"{off.mean():.2g} / {off.max():.2g}" for off in (exact, snapped)]
    print(f"| {name} | {unit} | {cells[0]} | {cells[1]} |", flush=True)


def off(landmarks: SurfaceLandmarks, vertices: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (L,) distances from `truth` of the landmarks on a surface, and of their nearest vertices."""
    nearest = vertices[list(landmarks.values())]
    return (
        np.linalg.norm(landmarks.interpolate(vertices) - truth, axis=1),
        np.linalg.norm(nearest - truth, axis=1),
    )


def simulated(count: int, scans: int, seed: int, *, ict: bool) -> None:
    rng = np.random.default_rng(seed)
    trained = people(count, rng, ict=ict)
    points = random_points(trained[0], rng)
    given = np.stack(list(points.values()))
    model = ShapeModel.fit(trained, landmarks=place_landmarks(trained[0], points))
    kind = "ICT" if ict else "bundled"
    row(f"{kind} faces: first mesh after `build`", *off(model.landmarks, trained[0].vertices, given), "mm")
    found = [np.empty(0), np.empty(0)]
    ratios = np.empty((0, 3))
    at_vertices = replace(model, landmarks=SurfaceLandmarks.of(dict(model.landmarks)))
    for person in people(scans, rng, ict=ict):
        scan = simulate_scan(person, rng, triangles=20_000, noise_mm=0.2, T_scan_model=random_similarity(rng, 20.0))
        truth = model.landmarks.interpolate(scan.truth_vertices)
        for k, one in enumerate((model, at_vertices)):
            result = fit_scan(one, scan.scan, FitConfig(dense=True))
            positions = np.stack(list(result.landmarks.values()))
            found[k] = np.concatenate([found[k], np.linalg.norm(positions - truth, axis=1)])
            if k == 0 and result.landmark_stddev_mm is not None:
                ratios = np.concatenate(
                    [ratios, (positions - truth) / np.stack(list(result.landmark_stddev_mm.values()))]
                )
    row(f"{kind} faces: {scans} new people, dense fits of raw scans", found[0], found[1], "mm")
    share = ", ".join(f"{100 * (np.abs(ratios) < s).mean():.0f} % within {s:g}" for s in (1.0, 1.96))
    print(f"\nCoordinates of landmarks in triangles within their standard deviations: {share}.")


def own(meshes: Path, folder: Path) -> None:
    shares: list[FloatArray] = []
    snapped: list[FloatArray] = []
    distance: list[FloatArray] = []
    for path in sorted(meshes.iterdir()):
        file = next((at for ending in LANDMARK_FORMATS if (at := folder / f"{path.stem}{ending}").is_file()), None)
        if file is None:
            continue
        try:
            mesh, points = read_mesh(path), read_landmarks(file)
        except ShapespaceError as error:
            print(error)
            continue
        landmarks, size = place_landmarks(mesh, points), rms_size(mesh.vertices)
        exact, nearest = off(landmarks, mesh.vertices, np.stack(list(points.values())))
        shares.append(100 * exact / size)
        snapped.append(100 * nearest / size)
        distance.append(100 * landmarks.distance_mm / size)
    row(
        f"{len(shares)} meshes: given points after placing",
        np.concatenate(shares),
        np.concatenate(snapped),
        "% of size",
    )
    print(f"\nReported distance to the surface: {np.concatenate(distance).mean():.2g} % of the size on average.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=30)
    parser.add_argument("--scans", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ict", action="store_true", help="faces of ICT-FaceKit, not the bundled ones")
    parser.add_argument("--meshes", type=Path, help="a folder of meshes of your own")
    parser.add_argument("--landmarks", type=Path, help="a folder with their landmarks, in files named as the meshes")
    asked = parser.parse_args()
    print("| landmarks | unit | in triangles: mean / max | at the nearest vertex: mean / max |\n|---|---|---|---|")
    if asked.meshes is not None and asked.landmarks is not None:
        own(asked.meshes, asked.landmarks)
    else:
        simulated(asked.people, asked.scans, asked.seed, ict=asked.ict)


if __name__ == "__main__":
    main()
