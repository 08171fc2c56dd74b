"""How good is the correspondence of real organs beside that of meshmonk and rustcpd?

    python benchmarks/correspondence_peers.py spleens                      40 spleens, 10,000 vertices
    python benchmarks/correspondence_peers.py hippocampi --vertices 2500   262 label volumes, made surfaces first
    python benchmarks/correspondence_peers.py spleens --scans 8 --vertices 1500 --rounds 2 --methods shapespace,meshmonk

Both sets are real and lie aligned as they come (`spleens/` and `hippocampus/` of the folder that SHAPESPACE_DATA
names). The peers choose no template and find no pose: they get the template that shapespace chose, evenly meshed, and
the scans aligned as they are. shapespace gets the scans turned and moved at random. What it sets aside counts for
nobody.

No truth is known, so three things are told of each: how near its surfaces come to the scans; how well models of some
scans tell those left out, as distances to the raw scans and not to the method's own surfaces, in the same folds; and
how far random shapes of its model lie from the nearest raw scan. All are two-sided, of surfaces.
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import peers

from shapespace.batch.executors import ExecutionConfig
from shapespace.commands.correspond import CorrespondFiles, correspond_files
from shapespace.commands.surface import write_surfaces
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.template import choose_template, clean_scan, resample
from shapespace.datasets.simulated_scan import random_similarity
from shapespace.geometry.closest import build_engine
from shapespace.geometry.doctor import repair
from shapespace.geometry.normals import Distortion
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.model_quality import Curve, ModelQuality, QualityConfig, measure_quality
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

OURS = "shapespace"
PEERS = {
    "meshmonk": ("meshmonk_pyramid", "fit"),
    "rustcpd": ("rustcpd_deformable", "fit"),
    "rustcpd as documented": ("rustcpd_deformable", "fit_as_documented"),
}
"""Name in the table -> module of peers and its function."""
FOLDERS = {"spleens": "spleens", "hippocampi": "hippocampus"}
MODES, SAMPLES, NEAREST, POINTS = 10, 200, 3, 1000
FAILED = 0.01
"""Of a scan's diagonal: a surface whose mean distance is more has failed."""


@dataclass(frozen=True, eq=False)
class Way:
    """Surfaces in correspondence as one method makes them.

    Args:
        surfaces: by the name of the scan, in the pose of the scan as it was given.
        seconds: CPU time of each.
        aside: why others were excluded, by name.
    """

    surfaces: dict[str, Mesh]
    seconds: dict[str, float]
    aside: dict[str, str]


def scans_of(case: str, count: int | None, seed: int, folder: Path) -> dict[str, Mesh]:
    """Return the scans of a case by name; surfaces are made of volumes first."""
    root = Path(os.environ.get("SHAPESPACE_DATA", ".")) / FOLDERS[case]
    if case == "hippocampi" and not folder.exists():
        write_surfaces([root], folder, labels="all", quiet=True, say=print)
    files = sorted((folder if case == "hippocampi" else root).glob("*.ply"))
    if not files:
        raise SystemExit(f"{root} has no scans; set SHAPESPACE_DATA to the folder that holds {FOLDERS[case]}/.")
    chosen = np.sort(np.random.default_rng(seed).permutation(len(files))[:count])
    return {files[k].stem: read_mesh(files[k]) for k in chosen}


def by_shapespace(
    scans: dict[str, Mesh], turns: dict[str, Similarity], folder: Path, config: CorrespondConfig, jobs: int
) -> Way:
    """Return what the command makes of turned scans, turned back."""
    turned = folder / "turned"
    turned.mkdir(parents=True, exist_ok=True)
    for name, scan in scans.items():
        write_mesh(turned / f"{name}.ply", scan.with_vertices(turns[name].apply(scan.vertices)))
    _, records = correspond_files(
        CorrespondFiles([turned], execution=ExecutionConfig(jobs=jobs)),
        folder / "same",
        config,
        quiet=False,
        say=print,
    )
    surfaces: dict[str, Mesh] = {}
    for record in records:
        if not record.reason:
            mesh = read_mesh(folder / "same" / f"{record.name}{record.SURFACE}")
            surfaces[record.name] = mesh.with_vertices(turns[record.name].inverse().apply(mesh.vertices))
    seconds = {record.name: float(np.sum(record.cpu_s)) for record in records}
    return Way(surfaces, seconds, {record.name: record.reason for record in records if record.reason})


def by_peer(name: str, template: Mesh, scans: dict[str, Mesh]) -> Way | str:
    """Return what a peer makes of the scans, the template's middle put on theirs; or why it cannot run."""
    module, function = PEERS[name]
    peer = peers.load(module)
    if isinstance(peer, str):
        return peer
    way = Way({}, {}, {})
    for called, scan in scans.items():
        start = template.with_vertices(template.vertices + scan.vertices.mean(axis=0) - template.vertices.mean(axis=0))
        vertices, way.seconds[called] = getattr(peer, function)(start, None, scan, None)
        way.surfaces[called] = Mesh(vertices, template.faces, name=called)
    return way


def kept(way: Way, folder: Path) -> Way:
    """Return `way`, written to `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, mesh in way.surfaces.items():
        write_mesh(folder / f"{name}.ply", mesh)
    (folder / "told.json").write_text(json.dumps({"seconds": way.seconds, "aside": way.aside}))
    return way


def read_again(folder: Path) -> Way | None:
    """Return what `kept` wrote; None where there is nothing."""
    if not (folder / "told.json").exists():
        return None
    stored = json.loads((folder / "told.json").read_text())
    surfaces = {file.stem: read_mesh(file) for file in sorted(folder.glob("*.ply"))}
    return Way(surfaces, stored["seconds"], stored["aside"])


def both_ways(surface: Mesh, scan: Mesh, points: int | None = None) -> tuple[FloatArray, FloatArray]:
    """Return distances from the vertices of a surface to a scan, and from those of the scan to it; all or as many."""
    there = np.isfinite(surface.vertices).all(axis=1)
    faces = surface.faces[there[surface.faces].all(axis=1)] if surface.faces is not None else None
    own, others = surface.vertices[there], scan.vertices
    if points is not None:
        own, others = (x[np.unique(np.linspace(0, len(x) - 1, points).round().astype(int))] for x in (own, others))
    filled = Mesh(np.nan_to_num(surface.vertices), faces)
    return build_engine(scan).query(own).distance, build_engine(filled).query(others).distance


def nearness(way: Way, scans: dict[str, Mesh], names: Sequence[str]) -> dict[str, float]:
    """Return mean, 99 % and largest distances as shares of the diagonals, over all, and triangles that fold."""
    rows = []
    middle = Mesh(np.nanmean([way.surfaces[name].vertices for name in names], axis=0), way.surfaces[names[0]].faces)
    for name in names:
        there, back = both_ways(way.surfaces[name], scans[name])
        whole = np.concatenate([there, back])
        lengths = np.array([(there.mean() + back.mean()) / 2, np.quantile(whole, 0.99), whole.max()])
        folded = Distortion.of(way.surfaces[name], middle).folded_share
        seen = np.isfinite(way.surfaces[name].vertices).all(axis=1).mean()
        rows.append([*lengths / np.linalg.norm(np.ptp(scans[name].vertices, axis=0)), folded, seen])
    mean, p99, largest, folded, seen = np.mean(rows, axis=0)
    return {
        "mean_share": mean, "p99_share": p99, "largest_share": largest, "folded_share": folded, "seen_share": seen,
        "failed": int((np.array(rows)[:, 0] > FAILED).sum()),
    }  # fmt: skip


def specificity(meshes: Sequence[Mesh], scans: Sequence[Mesh], counts: Sequence[int], seed: int) -> Curve:
    """Return how far random shapes of a model lie from the nearest raw scan, mm, both ways, by number of modes."""
    model = ShapeModel.fit(meshes, modes=None, min_seen=1e-9)
    if model.n_vertices != len(meshes[0].vertices):
        raise SystemExit("Vertices that nobody shows are left out of the model, which this benchmark does not foresee.")
    posed, raws, sizes = [], [], []
    for mesh, scan in zip(meshes, scans, strict=True):
        seen = np.isfinite(mesh.vertices).all(axis=1)
        T = fit_similarity(mesh.vertices[seen], model.mean_vertices[seen], with_scale=True)
        posed.append(T.apply(mesh.vertices))
        raws.append(scan.with_vertices(T.apply(scan.vertices)))
        sizes.append(T.scale)
    stacked, modes = np.stack(posed), model.vertex_basis.T
    each = np.zeros((SAMPLES, len(counts)))
    for row, b in enumerate(model.sample(SAMPLES, np.random.default_rng(seed))):
        for column, k in enumerate(counts):
            shape = meshes[0].with_vertices(model.mean_vertices + (b[:k] @ modes[:k]).reshape(-1, 3))
            near = np.argsort(np.nanmean(np.linalg.norm(stacked - shape.vertices, axis=2), axis=1))[:NEAREST]
            off = [np.mean([d.mean() for d in both_ways(shape, raws[i], POINTS)]) for i in near]
            each[row, column] = min(off) / np.mean(sizes)
    return Curve.over(each, counts, seed)


def at_modes(curve: Curve | None, modes: int) -> tuple[float, float, float]:
    """Return a measure with its 95 % interval at so many modes, or at the most there are."""
    assert curve is not None
    k = int(np.searchsorted(curve.counts, min(modes, curve.counts[-1])))
    return float(curve.mean[k]), float(curve.low[k]), float(curve.high[k])


def interval(value: tuple[float, float, float], sign: str = "") -> str:
    return f"{value[0]:{sign}.3f} ({value[1]:{sign}.3f} to {value[2]:{sign}.3f})"


def table(
    ways: dict[str, Way], found: dict[str, tuple[dict[str, float], ModelQuality, Curve]], names: Sequence[str]
) -> str:
    """Return the table of a case; differences are beside the first method."""
    titles = (
        "method", "excluded", "failed", "CPU s a scan", "to the scan: mean, % of diagonal", "99 %", "largest",
        "folded, %", "generalisation, mm", "less the first one's", "specificity, mm", "to its own surfaces, mm",
        "10 modes hold, %",
    )  # fmt: skip
    lines = [f"| {' | '.join(titles)} |", "|" + "---|" * len(titles)]
    first = next(iter(found.values()))[1]
    for name, (near, quality, specific) in found.items():
        apart = first.differences(quality)["generalisation"]
        cells = [
            name, str(len(ways[name].aside)), str(near["failed"]),
            f"{np.mean([ways[name].seconds[one] for one in names]):.1f}",
            *(f"{100 * near[key]:.3f}" for key in ("mean_share", "p99_share", "largest_share")),
            f"{100 * near['folded_share']:.2f}",
            interval(at_modes(quality.generalisation, MODES)),
            "" if quality is first else interval(at_modes(apart, MODES), "+"),
            interval(at_modes(specific, MODES)),
            interval(at_modes(quality.specificity, MODES)),
            f"{100 * at_modes(quality.compactness, MODES)[0]:.0f}",
        ]  # fmt: skip
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Run one case with the methods asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", choices=list(FOLDERS))
    parser.add_argument("--scans", type=int, help="as many, drawn (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="of the scans drawn, how they are turned, folds, samples")
    parser.add_argument("--vertices", type=int, default=CorrespondConfig.vertices)
    parser.add_argument("--rounds", type=int, default=CorrespondConfig.rounds)
    parser.add_argument("--jobs", type=int, default=1, help="of shapespace")
    parser.add_argument("--folds", type=int, default=10, help="of the generalisation")
    parser.add_argument("--methods", default=",".join([OURS, *PEERS]))
    parser.add_argument("--out", type=Path, default=Path("bench-out"), help="what is done there is not done again")
    arguments = parser.parse_args()
    out = arguments.out / f"correspondence-{arguments.case}-{arguments.vertices}"
    scans = scans_of(arguments.case, arguments.scans, arguments.seed, arguments.out / "hippocampi")
    rng = np.random.default_rng(arguments.seed)
    turns = {name: random_similarity(rng, 180.0, (1.0, 1.0)) for name in scans}
    config = CorrespondConfig(vertices=arguments.vertices, rounds=arguments.rounds)

    def template() -> Mesh:
        # The one that shapespace chooses, of the same turned scans by the same seed, in the pose it was given in.
        turned = [repair(scan.with_vertices(turns[name].apply(scan.vertices)))[0] for name, scan in scans.items()]
        chosen = list(scans.values())[choose_template(turned, config.seed).index]
        return resample(clean_scan(chosen), arguments.vertices)

    ways: dict[str, Way] = {}
    even: Mesh | None = None
    for name in arguments.methods.split(","):
        way: Way | str | None = read_again(out / name.replace(" ", "-"))
        if way is None and name == OURS:
            way = by_shapespace(scans, turns, out, config, arguments.jobs)
        elif way is None:
            even = even or template()
            way = by_peer(name, even, scans)
        if isinstance(way, str):
            print(f"{name} is left out: {way}")
            continue
        assert way is not None
        ways[name] = kept(way, out / name.replace(" ", "-"))
        print(f"{name}: {np.mean(list(way.seconds.values())):.1f} CPU s a scan", flush=True)
    names = [name for name in scans if all(name in way.surfaces for way in ways.values())]
    for name, way in ways.items():
        for aside, reason in way.aside.items():
            print(f"{name} set {aside} aside: {reason}")
    found: dict[str, tuple[dict[str, float], ModelQuality, Curve]] = {}
    common = [scans[name] for name in names]
    for name, way in ways.items():
        meshes = [way.surfaces[one] for one in names]
        measure = QualityConfig(folds=arguments.folds, modes=MODES, samples=SAMPLES, seed=arguments.seed)
        quality = measure_quality(meshes, measure, scans=common)
        specific = specificity(meshes, common, [1, 3, MODES], arguments.seed)
        found[name] = (nearness(way, scans, names), quality, specific)
        print(f"{name}: measured, {quality.supported_modes} modes supported", flush=True)
    rows = table(ways, found, names)
    title = (
        f"{arguments.case}: {len(names)} of {len(scans)} scans, {arguments.vertices} vertices, seed {arguments.seed}"
    )
    (out / "table.md").write_text(f"{title}\n\n{rows}\n")
    print(f"\n{title}\n\n{rows}")


if __name__ == "__main__":
    main()
