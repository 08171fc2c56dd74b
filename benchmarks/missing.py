"""What a model loses when a fifth of each training shape is missing, beside what is done about it elsewhere.

    python benchmarks/missing.py                     everything: about half an hour on one core
    python benchmarks/missing.py --kinds femora      minutes

Connected patches are missing at random places, or always the same side in some of the shapes. The shapes are then
given to `build` as they are (probabilistic PCA), with the mean filled in, or filled by a smooth surface
(`build_model`: sheets alone). Ratios are to the model of the whole shapes: of the variance in all, of the first
five modes and of the next five. Errors are on whole shapes that no model saw, all modes, each shape in its best pose;
the last measure is the distance of random shapes of the model from the nearest whole training shape. All in mm, vertex
to vertex; the last column is CPU seconds.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from shapespace.datasets.faces import load_faces
from shapespace.errors import ShapespaceError
from shapespace.geometry.normals import faces_of
from shapespace.geometry.procrustes import align_in_place
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.build_model import fill_holes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Mesh

SHARE, SIDE_IN = 0.2, 0.3
UNSEEN, SAMPLES = 30, 200
TEST_SEED = 90_000
Draw = Callable[[np.random.Generator], Mesh]


def faces() -> Draw:
    generator = load_faces()
    return lambda rng: generator.cut_to_face(generator.face(generator.draw_person(rng)))


def femur_file() -> Path:
    """Return the file of the open femur model."""
    path = Path(os.environ.get("SHAPESPACE_DATA", ".")) / "models" / "femur_gp_model_50-components.h5"
    if not path.is_file():
        raise SystemExit(f"{path} is not here; it comes from unibas-gravis/icp-proposal, data/femur.")
    return path


def femora() -> Draw:
    with h5py.File(femur_file()) as stored:
        modes = np.asarray(stored["model/pcaBasis"][:] * np.sqrt(stored["model/pcaVariance"][:]), dtype=np.float64)
        mean = np.asarray(stored["model/mean"][:], dtype=np.float64)
        cells = np.ascontiguousarray(stored["representer/cells"][:].T, dtype=np.int32)
    return lambda rng: Mesh((mean + modes @ rng.standard_normal(modes.shape[1])).reshape(-1, 3), cells, name="femur")


KINDS: Mapping[str, Callable[[], Draw]] = {"faces": faces, "femora": femora}


def patches(meshes: Sequence[Mesh], rng: np.random.Generator, *, same_side: bool) -> BoolArray:
    """Return (N, V) what is shown: a patch of `SHARE` of the vertices lacks, around one of them along the surface."""
    x, triangles = meshes[0].vertices, faces_of(meshes[0])
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    length = np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)
    surface = coo_matrix((length, (edges[:, 0], edges[:, 1])), shape=(len(x), len(x))).tocsr()
    shown = np.ones((len(meshes), len(x)), dtype=np.bool_)
    side = int(x[:, 0].argmax())
    for there in shown:
        if same_side and rng.random() >= SIDE_IN:
            continue
        middle = side if same_side else int(rng.integers(len(x)))
        far = dijkstra(surface, directed=False, indices=middle)
        there[np.argsort(far, kind="stable")[: round(SHARE * len(x))]] = False
    return shown


def filled_by_mean(shapes: FloatArray, shown: BoolArray) -> FloatArray:
    """Return shapes (N, V, 3), aligned by what they show, with the mean of what is shown where they show nothing."""
    posed = shapes.copy()
    mean = shapes[int(shown.sum(axis=1).argmax())]
    for _ in range(10):
        for i, there in enumerate(shown):
            posed[i] = fit_similarity(posed[i, there], mean[there]).apply(posed[i])
        mean = np.nanmean(np.where(shown[:, :, None], posed, np.nan), axis=0)
    return np.where(shown[:, :, None], posed, mean)


def models(meshes: Sequence[Mesh], shown: BoolArray) -> Mapping[str, Callable[[], ShapeModel]]:
    """Return what makes a model of the meshes with holes, by name."""
    shapes, triangles = np.stack([mesh.vertices for mesh in meshes]), meshes[0].faces
    names = [f"mesh {i}" for i in range(len(meshes))]
    holed = np.where(shown[:, :, None], shapes, np.nan)

    def of(vertices: FloatArray) -> ShapeModel:
        return ShapeModel.fit([Mesh(v, triangles, name=n) for v, n in zip(vertices, names, strict=True)], min_seen=0.1)

    def splined() -> ShapeModel:
        filled = holed.copy()
        fill_holes(filled, triangles, names)
        return of(filled)

    return {
        "whole shapes": lambda: of(shapes),
        "probabilistic PCA": lambda: of(holed),
        "mean filled in": lambda: of(filled_by_mean(shapes, shown)),
        "smooth surface filled in": splined,
    }


def error_mm(model: ShapeModel, unseen: Sequence[Mesh]) -> float:
    found = []
    for mesh in unseen:
        shape = model.reconstruct(model.project(mesh))
        found.append(np.linalg.norm(fit_similarity(shape, mesh.vertices).apply(shape) - mesh.vertices, axis=1).mean())
    return float(np.mean(found))


def specificity_mm(model: ShapeModel, meshes: Sequence[Mesh]) -> float:
    aligned = np.stack([mesh.vertices for mesh in meshes])
    mean = align_in_place(aligned, "shape").mean
    T = fit_similarity(model.mean_vertices, mean)
    found = []
    for b in model.sample(SAMPLES, np.random.default_rng(0)):
        shape = T.apply(model.reconstruct(b))
        found.append(min(np.linalg.norm(shape - other, axis=1).mean() for other in aligned))
    return float(np.mean(found))


def ratios(model: ShapeModel, whole: ShapeModel) -> tuple[float, float, float]:
    """Return the variance of a model in all, of modes 1 to 5 and 6 to 10, over that of the whole shapes at one size."""
    size, own = (np.linalg.norm(m.mean_vertices - m.mean_vertices.mean(axis=0)) for m in (whole, model))
    grown = float(size / own) ** 2
    first, next_ = (
        float((model.stddev[part] ** 2).sum() / (whole.stddev[part] ** 2).sum()) for part in (slice(5), slice(5, 10))
    )
    return grown * model.total_variance / whole.total_variance, grown * first, grown * next_


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--shapes", type=int, nargs="+", default=[12, 24, 50, 100])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    options = parser.parse_args(arguments)
    print(
        "| shapes | N | seed | missing | model | total | modes 1-5 | 6-10 | mean, mm | unseen, mm | specific, mm | s |"
    )
    print("|---" * 12 + "|")
    for kind in options.kinds:
        draw = KINDS[kind]()
        rng = np.random.default_rng(TEST_SEED)
        unseen = [draw(rng) for _ in range(UNSEEN)]
        for n in options.shapes:
            for seed in options.seeds:
                for same_side in (False, True):
                    rows(kind, draw, n, seed, unseen, same_side=same_side)


def rows(kind: str, draw: Draw, n: int, seed: int, unseen: Sequence[Mesh], *, same_side: bool) -> None:
    rng = np.random.default_rng((n, seed))
    meshes = [draw(rng) for _ in range(n)]
    shown = patches(meshes, rng, same_side=same_side)
    whole: ShapeModel | None = None
    for name, make in models(meshes, shown).items():
        began = time.process_time()
        try:
            model = make()
        except ShapespaceError as error:
            print(f"{name}: {error}", file=sys.stderr)
            continue
        seconds = time.process_time() - began
        whole = whole or model
        T = fit_similarity(model.mean_vertices, whole.mean_vertices)
        off = np.linalg.norm(T.apply(model.mean_vertices) - whole.mean_vertices, axis=1).mean()
        numbers = (*ratios(model, whole), off, error_mm(model, unseen), specificity_mm(model, meshes))
        cells = [f"{value:.3f}" for value in numbers]
        where = "side" if same_side else "patches"
        print(f"| {kind} | {n} | {seed} | {where} | {name} | {' | '.join(cells)} | {seconds:.1f} |", flush=True)


if __name__ == "__main__":
    main()
