"""Do statuses, intervals and expected errors hold on real bones that took no part in anything?

    python benchmarks/self_calibration.py --seeds 3 --surfaces bones.npz   the file keeps the correspondence
    python benchmarks/self_calibration.py wrong                            other objects alone

24 real femora (SHAPESPACE_DATA) in correspondence at 1,000 vertices. Each is cut at 10, 30 or 50 % of its length from
one end, placed in a random pose, and completed and fitted by models of 12 or all 23 others, or of 5 and 8. Coverage is
of the regions of 50, 90 and 95 % of missing vertices (chi-squared with three degrees of freedom) by distance from the
cut, and of the 95 % intervals of length and volume; their width is compared with the narrowest constant one that
contains 95 % of the errors. Other objects are balls, rods, molars, heads, spleens, and halves of them, scaled to the
RMS size of the bones.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from completion import organs
from mirrored import molars
from missing import femur_file
from scipy.stats import chi2

from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.faces import load_faces
from shapespace.datasets.simulated_scan import random_similarity
from shapespace.errors import FitError
from shapespace.fit.completion.complete import CompletionConfig, complete
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.normals import enclosed_volume, part_of, rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh

SHARES, SIZES, FEW = (0.1, 0.3, 0.5), (12, 23), (5, 8)
BANDS = ((0, 5), (5, 15), (15, 30), (30, np.inf))
LEVELS = (0.5, 0.9, 0.95)
CONFIG = CompletionConfig(with_doubtful=True, fit=FitConfig(unit="mm"))


def bones(file: Path) -> tuple[list[Mesh], list[Mesh]]:
    """Return the scans, and their surfaces in correspondence."""
    scans = [read_mesh(path) for path in sorted((Path(os.environ["SHAPESPACE_DATA"]) / "femora").glob("*.ply"))]
    if not file.is_file():
        made = correspond(scans, CorrespondConfig(vertices=1000, rounds=2))
        np.savez(file, vertices=np.stack([x.vertices for x in made.meshes()]), faces=made.template.faces)
    stored = np.load(file)
    return scans, [Mesh(x, stored["faces"], name=scan.name) for x, scan in zip(stored["vertices"], scans, strict=True)]


@dataclass
class Row:
    """Figures of one model size and share."""

    covered: dict[int, list[list[float]]] = field(default_factory=dict)
    quantities: dict[str, list[tuple[bool, float, float]]] = field(default_factory=dict)
    errors: list[tuple[float, float, float, float]] = field(default_factory=list)
    worse: list[tuple[bool, bool]] = field(default_factory=list)


def measure(row: Row, model: ShapeModel, scan: Mesh, truth: FloatArray, height: FloatArray) -> None:
    """Complete and fit a scan that lacks what is above height 0, and add the figures."""
    missing = height > 0
    made = complete(model, scan, CONFIG)
    T, faces = made.T_scan_model, np.asarray(model.faces)
    off = (made.vertices - truth) @ T.rotation / T.scale
    covariance = made.posterior.vertex_covariance() + 1e-6 * np.eye(3)
    m2 = np.einsum("vi,vij,vj->v", off, np.linalg.inv(covariance), off)
    for k, (low, high) in enumerate(BANDS):
        band = missing & (height >= low) & (height < high)
        row.covered.setdefault(k, []).extend([[float(x <= chi2.ppf(p, 3)) for p in LEVELS] for x in m2[band]])
    axis = np.linalg.svd(made.vertices - made.vertices.mean(axis=0), full_matrices=False)[2][0]
    true = {"length": float(np.ptp(truth @ axis)), "volume": enclosed_volume(truth, faces)}
    for e in made.estimates():
        if e.name in true:
            inside = e.low <= true[e.name] <= e.high
            row.quantities.setdefault(e.name, []).append((inside, e.high - e.low, abs(e.value - true[e.name])))
    pose = fit_similarity(model.mean_vertices[~missing], truth[~missing], with_scale=False)
    error, of_mean = (
        float(np.linalg.norm(x - truth, axis=1)[missing].mean()) if missing.any() else 0.0
        for x in (made.vertices, pose.apply(model.mean_vertices))
    )
    fit = fit_scan(model, scan, CONFIG.fit)
    assert fit.evidence is not None
    of_fit = float(np.linalg.norm(fit.surface().vertices - truth, axis=1).mean())
    row.errors.append((error, of_mean, of_fit, fit.evidence.expected_error_mm))
    row.worse.append((error > of_mean, made.status == "converged"))


def run(surfaces: list[Mesh], scans: list[Mesh], size: int, share: float, seeds: int) -> Row:
    """Return the figures of one model size and share over all bones."""
    row = Row()
    for seed in range(seeds):
        for i, (surface, scan) in enumerate(zip(surfaces, scans, strict=True)):
            rng = np.random.default_rng([seed, i, size, round(100 * share)])
            others = rng.permutation([k for k in range(len(surfaces)) if k != i])[:size]
            model = ShapeModel.fit([surfaces[k] for k in sorted(others)], gauge="form")
            x = surface.vertices
            axis = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][0] * rng.choice([-1, 1])
            height = x @ axis
            cut = float(height.max() - share * np.ptp(height))
            T = random_similarity(rng, 180.0, (1.0, 1.0))
            part = part_of(scan, scan.vertices @ axis < cut)
            measure(row, model, part.with_vertices(T.apply(part.vertices)), T.apply(x), height - cut)
    return row


def print_row(size: int, share: float, row: Row) -> None:
    """Print a line of the table."""
    covered = [" / ".join(f"{100 * x:.0f}" for x in np.mean(row.covered[k], axis=0)) if row.covered.get(k) else ""
               for k in range(len(BANDS))]  # fmt: skip
    quantities: list[str] = []
    for name in ("length", "volume"):
        inside, width, off = np.array(row.quantities[name], dtype=float).T
        quantities.append(f"{100 * inside.mean():.0f} ({width.mean() / (2 * np.quantile(off, 0.95)):.2f})")
    errors = np.array(row.errors)
    ratio = errors[:, 2] / errors[:, 3]
    worse, converged = np.array(row.worse).T
    cells = [
        f"{size}", f"{100 * share:.0f} %", f"{errors[:, 1].mean():.1f}", f"{errors[:, 0].mean():.1f}", *covered,
        *quantities, f"{np.median(ratio):.2f} / {np.quantile(ratio, 0.95):.2f}",
        f"{converged.sum()} of {len(converged)}", f"{(worse & converged).sum()}",
    ]  # fmt: skip
    print(f"| {' | '.join(cells)} |", flush=True)


def wrong_objects(size: float, seed: int, others: list[Mesh]) -> Iterator[Mesh]:
    """Yield other objects, `others` among them, and halves of them, of the RMS size `size`, in random poses."""
    rng = np.random.default_rng(seed)
    ball, teeth = organs()(rng), molars(seed)[0]
    stretched = [
        ball.with_vertices(ball.vertices * np.array(k)) for k in ((1, 1, 1), (1, 1.5, 4), (1, 1, 8), (1, 0.9, 12))
    ]
    spleens = sorted((Path(os.environ["SHAPESPACE_DATA"]) / "spleens").glob("*.ply"))
    for mesh in (*stretched, *teeth[:8], *others, *map(read_mesh, rng.permutation(spleens)[:6])):
        x = (mesh.vertices - mesh.vertices.mean(axis=0)) * (size / rms_size(mesh.vertices))
        whole = mesh.with_vertices(x)
        halves = [part_of(whole, x @ axis < 0) for axis in np.linalg.svd(x, full_matrices=False)[2][:2]]
        for part in (whole, *halves):
            yield part.with_vertices(random_similarity(rng, 180.0, (1.0, 1.0)).apply(part.vertices))


def print_wrong(surfaces: list[Mesh], scans: list[Mesh], seed: int) -> None:
    """Print how many other objects are converged with models of 18 bones, of 18 faces, and with the open femur model.

    The open femur model does not contain its training shapes.
    """
    faces, rng = load_faces(), np.random.default_rng(seed)
    chosen = rng.permutation(len(surfaces))
    heads = [faces.face(faces.draw_person(rng)) for _ in range(22)]
    bones_model = ShapeModel.fit([surfaces[k] for k in sorted(chosen[:18])], gauge="form")
    faces_model = ShapeModel.fit([faces.cut_to_face(head) for head in heads[:18]], gauge="form")
    count_converged(
        bones_model, f"bones, seed {seed}", wrong_objects(rms_size(bones_model.mean_vertices), seed, heads[18:])
    )
    femur_model = ShapeModel.load(femur_file())
    of_size = wrong_objects(rms_size(femur_model.mean_vertices), seed, heads[18:])
    count_converged(femur_model, f"open femur model, seed {seed}", of_size)
    others = [scans[k] for k in chosen[18:22]]
    count_converged(
        faces_model, f"faces, seed {seed}", wrong_objects(rms_size(faces_model.mean_vertices), seed, others)
    )


def count_converged(model: ShapeModel, name: str, objects: Iterable[Mesh]) -> None:
    """Print how many completions and fits of other objects are converged."""
    converged: dict[str, list[str]] = {"completions": [], "fits": []}
    objects = list(objects)
    for mesh in objects:
        for kind, function in (("completions", lambda m: complete(model, m, CONFIG)),
                               ("fits", lambda m: fit_scan(model, m, CONFIG.fit))):  # fmt: skip
            try:
                if function(mesh).status == "converged":
                    converged[kind].append(mesh.name)
            except FitError:
                continue
    counts = " and ".join(f"{len(names)} {kind} {names or ''}" for kind, names in converged.items())
    print(f"Other objects converged, {name}: {counts} of {len(objects)}.", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", default=["sizes", "few", "wrong"], help="sizes, few, wrong")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--surfaces", type=Path, default=Path("bench-out") / "bones.npz")
    arguments = parser.parse_args()
    arguments.surfaces.parent.mkdir(parents=True, exist_ok=True)
    scans, surfaces = bones(arguments.surfaces)
    header = ["shapes", "missing", "mean shape, mm", "completed, mm", *(f"{low}-{high} mm" for low, high in BANDS),
              "length", "volume", "true / expected error", "converged", "worse"]  # fmt: skip
    sizes = [*(SIZES if "sizes" in arguments.what else ()), *(FEW if "few" in arguments.what else ())]
    if sizes:
        print(f"| {' | '.join(header)} |\n|{' --- |' * len(header)}")
    for size in sizes:
        for share in SHARES if size in SIZES else SHARES[1:]:
            print_row(size, share, run(surfaces, scans, size, share, arguments.seeds))
    if "wrong" in arguments.what:
        for seed in range(arguments.seeds):
            print_wrong(surfaces, scans, seed)


if __name__ == "__main__":
    main()
