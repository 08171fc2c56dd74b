"""Measure what docs/compare.md promises of `shapespace compare`: false positives, power, speed.

Noise is that of real fits: raw scans of simulated people, fitted by models that know none of them. False positives are
measured on the fits of studies (`studies/`) of 100 people with 25 scans each, named by `--fits`; power on people of its
own, whose fits are kept in `--pool`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace import ShapeModel, fit_scan, load_faces, simulate_scan
from shapespace.datasets.simulated_scan import Cut
from shapespace.errors import FitError
from shapespace.fit.fit import FitConfig
from shapespace.geometry.surface import vertex_normals
from shapespace.types import BoolArray, FloatArray, Mesh

GROUP = 40
"""People in each of two groups."""
CHANGE_MM = 0.5
WHOLE_MM, NONE_MM = 16.0, 24.0
"""From the tip of the nose: as far as it is changed by all of it, and where the change ends."""
MISSING = (0.1, 0.35)
TRAINED, MODES, POOL = 150, 100, 100
TRIANGLES = 12_000


@dataclass(frozen=True, eq=False)
class Pool:
    """Fits of people without and with a changed nose, in the model's frame.

    Args:
        model: that knows none of them.
        b: (2, P, K) mm.
        b_stddev: (2, P, K).
        dense: (2, P, V, 3) mm, surfaces after the dense stage.
        used: (2, P) fits that are not doubtful or failed.
        change_mm: (V,) put in, along the normals, of the model's vertices.
    """

    model: ShapeModel
    b: FloatArray
    b_stddev: FloatArray
    dense: npt.NDArray[np.float32]
    used: BoolArray
    change_mm: FloatArray


def nose_change(vertices: FloatArray, tip: int) -> FloatArray:
    """Return how far each vertex of a face is moved along its normal: the tip of the nose, with a smooth edge."""
    far = np.linalg.norm(vertices - vertices[tip], axis=1)
    edge = np.clip((NONE_MM - far) / (NONE_MM - WHOLE_MM), 0.0, 1.0)
    return CHANGE_MM * edge * edge * (3.0 - 2.0 * edge)


def make_pool(folder: Path, missing: float, people: int = POOL) -> Pool:
    """Return the pool of one share of missing surface, fitted if its files are not there yet."""
    faces = load_faces()
    tip = faces.face_landmarks["pronasale"]

    def face(seed: int, k: int) -> Mesh:
        return faces.cut_to_face(faces.face(faces.draw_person(np.random.default_rng([seed, k]), f"{seed}_{k}")))

    trained = [face(0, k) for k in range(TRAINED)]
    model = ShapeModel.fit(trained, modes=MODES, gauge="shape", landmarks=faces.face_landmarks)
    groups: list[Mapping[str, npt.NDArray[Any]]] = []
    for changed in range(2):
        file = folder / f"pool_{round(100 * missing)}_{people}_{changed}.npz"
        if not file.is_file():
            shape = (people, MODES)
            b, stddev, used = np.zeros(shape), np.zeros(shape), np.zeros(people, dtype=bool)
            dense = np.zeros((people, *model.mean_vertices.shape), dtype=np.float32)
            for k in range(people):
                # Others in the second group: two groups of a study are different people.
                own = face(1 + changed, k)
                if changed:
                    moved = nose_change(own.vertices, tip)[:, None] * vertex_normals(own)
                    own = own.with_vertices(own.vertices + moved)
                rng = np.random.default_rng([3, changed, k, round(100 * missing)])
                scan = simulate_scan(own, rng, triangles=TRIANGLES, crop=[_cut(own, missing, rng)]).scan
                try:
                    found = fit_scan(model, scan, FitConfig(dense=True))
                except FitError:
                    continue
                b[k, : len(found.b)], stddev[k, : len(found.b_stddev)] = found.b, found.b_stddev
                dense[k] = found.T_scan_model.inverse().apply(found.surface(model, "dense").vertices)
                used[k] = found.status in ("converged", "max_iterations")
            folder.mkdir(parents=True, exist_ok=True)
            np.savez(file, b=b, b_stddev=stddev, dense=dense, used=used)
        groups.append(np.load(file))
    b, stddev, dense, used = (np.stack([group[name] for group in groups]) for name in ("b", "b_stddev", "dense", "used"))
    return Pool(model, b, stddev, dense, used, nose_change(model.mean_vertices, tip))


def _cut(face: Mesh, missing: float, rng: np.random.Generator) -> Cut:
    """Return a plane from a random side that takes away a share of the vertices."""
    turn = rng.uniform(0.0, 2.0 * np.pi)
    normal = np.array([np.cos(turn), np.sin(turn), 0.0])
    return Cut(normal * np.quantile(face.vertices @ normal, 1.0 - missing), normal)
