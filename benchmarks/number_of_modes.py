"""Compare models of all modes with those of an automatic number of modes, by fits to shapes that are not in them.

Six meshes are left out. Each is projected, fitted with 0.2 mm of noise, and fitted with the 65 % of it that lie lowest
along its longest axis. Errors are mean distances between vertices, mm; those of parts are medians over the six.

    python benchmarks/number_of_modes.py faces                 # of 12 and of 40 faces
    python benchmarks/number_of_modes.py same                  # meshes that correspond wrote to the folder `same`
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import shapespace as ss
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray

LEFT_OUT, NOISE_MM, SHARE = 6, 0.2, 0.65


def mean_distance(a: FloatArray, b: FloatArray) -> float:
    """Return the mean distance between the same vertices (V, 3) of two shapes."""
    return float(np.linalg.norm(a - b, axis=1).mean())


def part_of(mesh: ss.Mesh) -> ss.Mesh:
    """Return the lowest part of a mesh along its longest axis."""
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    along = centred @ np.linalg.svd(centred, full_matrices=False)[2][0]
    is_kept = along < np.quantile(along, SHARE)
    assert mesh.faces is not None
    faces = (np.cumsum(is_kept) - 1)[mesh.faces[is_kept[mesh.faces].all(axis=1)]]
    return ss.Mesh(mesh.vertices[is_kept], faces.astype(np.int32), name=mesh.name)


def compare(title: str, meshes: Sequence[ss.Mesh]) -> None:
    """Print the errors of both models of all meshes but the first ones."""
    for modes in ("auto", "all"):
        model = ss.build_model(meshes[LEFT_OUT:], ss.BuildConfig(modes=modes))
        errors: list[list[float]] = []
        for k, mesh in enumerate(meshes[:LEFT_OUT]):
            nearest = model.reconstruct(model.project(mesh))
            noise = np.random.default_rng(k).normal(0, NOISE_MM, mesh.vertices.shape)
            scan = ss.Mesh(mesh.vertices + noise, mesh.faces, name=mesh.name)
            placed = fit_similarity(nearest, mesh.vertices, with_scale=True).apply(nearest)
            fits = (ss.fit_scan(model, each).surface().vertices for each in (scan, part_of(scan)))
            errors.append([mean_distance(x, mesh.vertices) for x in (placed, *fits)])
        projection, fit, _ = np.mean(errors, axis=0)
        part = np.median(errors, axis=0)[2]
        print(
            f"{title}, {modes}: {model.n_modes} modes; projection {projection:.2f}, fit {fit:.2f}, part {part:.2f} mm"
        )


def main() -> None:
    """Compare the models of the meshes in the folder that is named, or of bundled faces."""
    if sys.argv[1] == "faces":
        faces = ss.load_faces()
        people = [faces.face(faces.draw_person(np.random.default_rng(100 + i)), name=f"{i}") for i in range(46)]
        for count in (12, 40):
            compare(f"{count} faces", people[: LEFT_OUT + count])
        return
    meshes = [ss.read_mesh(file) for file in sorted(Path(sys.argv[1]).glob("*.corresponding.ply"))]
    order = np.random.default_rng(0).permutation(len(meshes))
    compare(f"{len(meshes) - LEFT_OUT} meshes", [meshes[i] for i in order])


if __name__ == "__main__":
    main()
