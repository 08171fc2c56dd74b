"""B-spline surfaces beside vertices at equal numbers of modes, and what a height field over a cylinder cannot hold.

    python benchmarks/bspline.py                          10 people, 50 modes of 200
    python benchmarks/bspline.py --quick                  2 people, 20 modes of 40, 16x16 only

People are ICT-FaceKit's, 100 of whose modes vary; those who are scanned are not those of the model. Errors are mean
distances of all vertices to their true places in mm of the model's frame; the floor knows the true correspondences.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from cases import _floor_mm, run
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from shapespace.datasets.faces import load_faces
from shapespace.datasets.ict import IctFaces, load_ict
from shapespace.datasets.simulated_scan import SimulatedScan, random_similarity, simulate_scan
from shapespace.datasets.study_people import holes_of
from shapespace.errors import InputError
from shapespace.fit.fit import FitConfig, fit_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.distance import surface_distances
from shapespace.geometry.flatten import cylinder_map, disc_map, folded_triangles
from shapespace.geometry.surface import face_areas, vertex_normals
from shapespace.model.representation import BSplineSurface
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

CONDITIONS: Mapping[str, Mapping[str, float]] = {
    "0.2 mm noise": {"noise_mm": 0.2, "missing": 0.0},
    "0.5 mm noise": {"noise_mm": 0.5, "missing": 0.0},
    "1 mm noise": {"noise_mm": 1.0, "missing": 0.0},
    "10 % missing": {"noise_mm": 0.2, "missing": 0.1},
    "30 % missing": {"noise_mm": 0.2, "missing": 0.3},
}
"""Of the scans that are fitted."""
TRAINING: Mapping[str, Mapping[str, float]] = {
    "0.5 mm noise": {"noise_mm": 0.5, "missing": 0.0},
    "1 mm noise": {"noise_mm": 1.0, "missing": 0.0},
    "10 % missing": {"noise_mm": 0.0, "missing": 0.1},
    "30 % missing": {"noise_mm": 0.0, "missing": 0.3},
}
"""Of the meshes that the model is made of."""
Record = dict[str, Any]
Kind = tuple[str, tuple[int, int] | None]


def kinds(counts: Sequence[int]) -> dict[str, Kind]:
    """Return (representation, control points) by the name that the tables show."""
    found: dict[str, Kind] = {"vertices": ("vertices", None)}
    for name in ("bspline", "bspline-detail"):
        found |= {f"{name} {n}x{n}": (name, (n, n)) for n in counts}
    return found


def model_of(meshes: Sequence[Mesh], kind: Kind, modes: int) -> ShapeModel:
    """Return the model of meshes as they stand: the recognition study takes the same two arguments."""
    return ShapeModel.fit(meshes, modes=modes, align=False, representation=kind[0], control_points=kind[1])


def surface_error(vertices: FloatArray, truth: Mesh) -> float:
    """Return the mean distance of two surfaces both ways, mm."""
    distances = surface_distances(Mesh(vertices, truth.faces), truth)
    return 0.5 * (distances.model_to_scan.mean + distances.scan_to_model.mean)


def compare(ict: IctFaces, people: int, training: int, modes: int, counts: Sequence[int]) -> list[Record]:
    """Return what each representation does at equal modes: size, time, floors, and fits in each condition."""
    drawn = ict.draw_people(training + people, seed=500)
    meshes = [ict.mesh(row, name=f"person {i}") for i, row in enumerate(drawn)]
    scans = {name: [scan_of(meshes[training + i], i, **how) for i in range(people)] for name, how in CONDITIONS.items()}
    rows: list[Record] = []
    for title, kind in kinds(counts).items():
        cpu = time.process_time()
        model = model_of(meshes[:training], kind, modes)
        row: Record = {"representation": title, "modes": model.n_modes, "build_cpu_s": time.process_time() - cpu}
        with tempfile.TemporaryDirectory() as folder:
            model.save(Path(folder) / "model.h5")
            row["file_mb"] = (Path(folder) / "model.h5").stat().st_size / 1e6
        held_out = meshes[training:]
        row["floor_mm"] = float(np.mean([_floor_mm(model, mesh.vertices) for mesh in held_out]))
        row["floor_surface_mm"] = float(
            np.mean([surface_error(model.reconstruct(model.project(m.vertices, align=False)), m) for m in held_out])
        )
        fit_scan(model, scans["0.2 mm noise"][0].scan, FitConfig(unit="mm"))  # what every fit with the model shares
        for name in CONDITIONS:
            row[name] = fits(model, scans[name], held_out)
        row["trained on"] = {name: trained_on(meshes, training, kind, modes, **how) for name, how in TRAINING.items()}
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def scan_of(mesh: Mesh, index: int, *, noise_mm: float, missing: float) -> SimulatedScan:
    rng = np.random.default_rng([7, index])
    T = random_similarity(rng)
    holes = holes_of(mesh, missing, rng) if missing else ()
    return simulate_scan(mesh, rng, triangles=20_000, noise_mm=noise_mm, T_scan_model=T, holes=holes)


def fits(model: ShapeModel, scans: Sequence[SimulatedScan], truths: Sequence[Mesh]) -> Record:
    """Return mean errors and CPU seconds of the robust fits of `scans`."""
    error, surface, seconds, doubted = [], [], [], 0
    for scan, truth in zip(scans, truths, strict=True):
        cpu = time.process_time()
        result = fit_scan(model, scan.scan, FitConfig(unit="mm"))
        seconds.append(time.process_time() - cpu)
        found = scan.T_scan_model.inverse().apply(result.T_scan_model.apply(model.reconstruct(result.b)))
        error.append(np.linalg.norm(found - truth.vertices, axis=1).mean())
        surface.append(surface_error(found, truth))
        doubted += result.status == "doubtful"
    return {
        "vertex_mm": float(np.mean(error)),
        "worst_mm": float(np.max(error)),
        "surface_mm": float(np.mean(surface)),
        "cpu_s": float(np.median(seconds)),
        "doubted": doubted,
    }


def trained_on(
    meshes: Sequence[Mesh], training: int, kind: Kind, modes: int, *, noise_mm: float, missing: float
) -> float | None:
    """Return the floor of held-out people, mm, for a model of damaged meshes; None where it cannot be made."""
    rng = np.random.default_rng(11)
    damaged: list[Mesh] = []
    for mesh in meshes[:training]:
        x = mesh.vertices + noise_mm * rng.standard_normal(mesh.vertices.shape)
        for hole in holes_of(mesh, missing, rng) if missing else ():
            x[np.linalg.norm(mesh.vertices - np.asarray(hole.center), axis=1) <= hole.radius_mm] = np.nan
        damaged.append(mesh.with_vertices(x))
    try:
        model = model_of(damaged, kind, modes)
    except InputError:
        return None
    return float(np.mean([_floor_mm(model, mesh.vertices) for mesh in meshes[training:]]))


def shared_area(uv: FloatArray, mesh: Mesh) -> tuple[float, float, BoolArray]:
    """Return the shares of the area folded over and lying where other parts lie too, and (F,) which lie so."""
    faces = mesh.faces
    assert faces is not None
    areas, corners = face_areas(mesh), uv[faces]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    twice = np.zeros(len(faces), dtype=np.bool_)
    tree = cKDTree(middles)
    for f, near in enumerate(tree.query_ball_point(middles, reach)):
        others = np.array([n for n in near if n != f], dtype=np.int64)
        a, b, c = (corners[f, k] - middles[others] for k in range(3))
        turns = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))])
        inside = (turns.min(axis=0) > 0) | (turns.max(axis=0) < 0)
        twice[others[inside]] = True
        twice[f] |= bool(inside.any())
    folded = folded_triangles(uv, faces)
    return float(areas[folded].sum() / areas.sum()), float(areas[twice].sum() / areas.sum()), twice


def regions_of_faces() -> tuple[Mesh, dict[str, IntArray]]:
    """Return the bundled template and its regions; nostrils are the pockets of the nose narrower than 5 mm."""
    faces = load_faces()
    template = faces.template
    ahead = template.vertices + 5.0 * vertex_normals(template)
    narrow = build_engine(template).query(ahead).distance < 4.0
    named = {name: faces.regions[name] for name in ("nose", "mouth", "eyes", "ears")}
    nose = named["nose"]
    named["nostrils"] = nose[narrow[nose]]
    named["inner lips"] = faces.regions["mouth_interior"]
    inside = np.zeros(len(template.vertices), dtype=np.bool_)
    inside[np.concatenate(list(named.values()))] = True
    named["elsewhere"] = np.flatnonzero(~inside).astype(np.int32)
    return template, named


def maps(ict: IctFaces, counts: Sequence[int]) -> Record:
    """Return overlap of both maps on both templates, and how far B-splines over them are off, by region."""
    template, regions = regions_of_faces()
    faces, rng = load_faces(), np.random.default_rng(3)
    people = np.stack([faces.face(faces.draw_person(rng)).vertices for _ in range(20)])
    changes = people - people.mean(axis=0)
    found: Record = {"overlap": {}, "regions": {}}
    for name, mesh in (("ict face", ict.mesh()), ("bundled face", template)):
        for title, uv in (("cylinder", cylinder_map(mesh)), ("disc", disc_map(mesh))):
            folded, twice, _ = shared_area(uv, mesh)
            found["overlap"][f"{name}, {title}"] = {"folded_area": folded, "shared_area": twice}
    for title, uv in (("cylinder", cylinder_map(template)), ("disc", disc_map(template))):
        _, _, twice = shared_area(uv, template)
        shared = np.zeros(len(template.vertices), dtype=np.bool_)
        shared[template.faces[twice].ravel()] = True
        for n in counts:
            surface = BSplineSurface(uv, (n, n))
            shape = np.linalg.norm(surface.decode(surface.encode(people)) - people, axis=2).mean(axis=0)
            change = np.linalg.norm(surface.decode(surface.encode(changes)) - changes, axis=2).mean(axis=0)
            found["regions"][f"{title} {n}x{n}"] = {
                region: {
                    "vertices": len(index),
                    "shared": float(shared[index].mean()),
                    "surface_mm": float(shape[index].mean()),
                    "change_mm": float(change[index].mean()),
                }
                for region, index in regions.items()
            }
    return found


def told(rows: Sequence[Record], found: Record) -> str:
    """Return the tables in Markdown."""
    lines = ["| representation | file, MB | build, CPU s | floor, mm | surface floor, mm | " + " | ".join(CONDITIONS)]
    lines[0] += " | CPU s a fit | doubted |"
    lines.append("|" + "---|" * (7 + len(CONDITIONS)))
    for row in rows:
        cells = [row["representation"], f"{row['file_mb']:.2f}", f"{row['build_cpu_s']:.1f}"]
        cells += [f"{row['floor_mm']:.3f}", f"{row['floor_surface_mm']:.3f}"]
        cells += [f"{row[name]['vertex_mm']:.3f} / {row[name]['surface_mm']:.3f}" for name in CONDITIONS]
        cells += [f"{row['0.2 mm noise']['cpu_s']:.2f}", str(sum(row[name]["doubted"] for name in CONDITIONS))]
        lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "| representation | " + " | ".join(f"trained on {name}" for name in TRAINING) + " |"]
    lines.append("|" + "---|" * (1 + len(TRAINING)))
    for row in rows:
        values = [row["trained on"][name] for name in TRAINING]
        lines.append(
            f"| {row['representation']} | " + " | ".join("refused" if v is None else f"{v:.3f}" for v in values) + " |"
        )
    lines += ["", "| surface, map | folded over | shares its place |", "|---|---|---|"]
    for name, shares in found["overlap"].items():
        lines.append(f"| {name} | {100 * shares['folded_area']:.1f} % | {100 * shares['shared_area']:.1f} % |")
    names = list(next(iter(found["regions"].values())))
    lines += ["", "| map, control points | " + " | ".join(names) + " |", "|" + "---|" * (1 + len(names))]
    for title, by_region in found["regions"].items():
        cells = [f"{by_region[name]['surface_mm']:.2f} / {by_region[name]['change_mm']:.2f}" for name in names]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
        if title.endswith(next(iter(found["regions"])).split()[-1]):
            lines.append("| vertices that share their place | " + " | ".join(
                f"{100 * by_region[name]['shared']:.0f} %" for name in names) + " |")  # fmt: skip
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=10, help="held out and scanned")
    parser.add_argument("--training", type=int, default=200)
    parser.add_argument("--modes", type=int, default=50)
    parser.add_argument("--counts", default="16,24,32", help="control points along each side")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    args = parser.parse_args()
    if args.quick:
        args.people, args.training, args.modes, args.counts = 2, 40, 20, "16"
    counts = [int(n) for n in args.counts.split(",")]
    threadpool_limits(1)
    ict = load_ict()
    found = maps(ict, counts)
    rows = compare(ict, args.people, args.training, args.modes, counts)
    args.out.mkdir(parents=True, exist_ok=True)
    settings = {k: v for k, v in vars(args).items() if k != "out"}
    (args.out / "bspline.json").write_text(json.dumps({"settings": settings, "rows": rows, "maps": found}, indent=1))
    text = told(rows, found)
    (args.out / "bspline.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    run(main)
