"""How near to the truth are completed parts, and how often does the truth lie in their intervals?

    python benchmarks/completion.py --jobs 2                        all kinds and shares, three seeds: two hours
    python benchmarks/completion.py femora:0.3 faces-30:0.4 --cases 12
    python benchmarks/completion.py molars:0.5 --molars molars.npz  the file keeps their correspondence
    python benchmarks/completion.py --cost                          time and memory with 10,000 vertices

Errors are mean distances of missing vertices from their true places, mm: of the mean shape in the best pose of what is
observed, of the coefficients of the fit, of the completion, of the analytic posterior that knows the true pose and the
true positions of all observed vertices (scalismo), and of the one that knows them along the normals alone, but not the
pose: scans show no more. The last one has the off-model variation of completions. Distances between surfaces are means
over missing vertices in both directions. Coverage is of the regions of 50, 90 and 95 % of missing vertices (chi-squared
with three degrees of freedom), of their coordinates, and of the intervals of volume and length; ranks of the true
volume and length among samples are compared with the uniform distribution (Kolmogorov). The expected energy score over
the RMS error is about 0.7.

Femora are samples of the open femur model (SHAPESPACE_DATA), of which the model itself or models of 60 or 20 samples
know; faces and organs are simulated, and neither models nor cases share shapes. Molars are real, in correspondence
at 1,000 vertices and scaled to an RMS size of 100, so that their mm are per cent; models know the other genera alone.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from mirrored import MIRRORED_MOLARS, molars
from missing import faces, femora, femur_file
from scipy.spatial import ConvexHull
from scipy.stats import chi2, kstest, norm

from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ
from shapespace.datasets.simulated_scan import Cut, random_similarity, simulate_scan
from shapespace.errors import FitError
from shapespace.fit.completion.complete import Completion, CompletionConfig, add_mirror_image, complete
from shapespace.fit.dense.residual_modes import residual_modes
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.robust.posterior import lack_of_new_shapes, variance_of_new_shapes
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import part_of, rms_size, vertex_normals
from shapespace.geometry.similarity import POSE, fit_similarity, small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity

NOISE_MM, TRIANGLES, SAMPLES, SIZE = 0.3, 8_000, 200, 100.0
LEVELS = (0.5, 0.9, 0.95)
WRONG = 3.0  # RMS errors over so many predicted ones are wrong poses
DEFAULT = (
    *(f"{kind}:{share}" for kind in ("femora", "femora-60", "femora-20") for share in (0.1, 0.3, 0.6)),
    *(f"{kind}:{share}" for kind in ("faces-100", "faces-30") for share in (0.2, 0.4, 0.6)),
    *(f"organs-40:{share}" for share in (0.3, 0.5)),
    "molars:0.5",
)
ERRORS = {
    "mean": "mean shape", "fit": "fit", "completed": "completed", "predicted": "predicted RMS",
    "along normals": "known along normals", "scalismo": "positions and pose known", "mirror alone": "mirror alone",
    "mirror combined": "mirror combined", "fit surface": "surface: fit", "completed surface": "surface: completed",
    "along normals surface": "surface: known along normals",
}  # fmt: skip
Draw = Callable[[np.random.Generator], Mesh]


def organs() -> Draw:
    i = np.arange(1000)
    z, angle = 1 - (2 * i + 1) / len(i), np.pi * (3 - np.sqrt(5)) * i
    d = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    triangles = ConvexHull(d).simplices.astype(np.int32)
    a, b, c = (d[triangles[:, k]] for k in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return lambda rng: Mesh(Organ.draw(rng).surface(d), triangles, name="organ")


KINDS: dict[str, Callable[[], Draw]] = {"femora": femora, "faces": faces, "organs": organs}


@cache
def population(kind: str, seed: int) -> tuple[Draw, ShapeModel]:
    """Return what draws shapes, and a model: of as many others as the name says, or the femur model itself."""
    name, _, count = kind.partition("-")
    draw = KINDS[name]()
    rng = np.random.default_rng([seed, 7])
    if count:
        return draw, ShapeModel.fit([draw(rng) for _ in range(int(count))], gauge="form")
    return draw, ShapeModel.load(femur_file())


@dataclass(frozen=True, eq=False)
class Case:
    """A scan without a part, and the truth in its frame: vertices and surface."""

    model: ShapeModel
    scan: Mesh
    truth: FloatArray
    missing: BoolArray
    T_scan_model: Similarity
    surface: Mesh


def case(kind: str, share: float, seed: int, number: int, file: Path) -> Case:
    """Return a shape cut by a plane: across the long axis of a femur, from any side of others."""
    if kind == "molars":
        return molar_case(share, seed, number, file)
    draw, model = population(kind, seed)
    rng = np.random.default_rng([seed, 1, number])
    mesh = draw(rng)
    x = mesh.vertices
    if kind.startswith("femora"):
        direction = np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2][0] * rng.choice([-1, 1])
        direction = direction + 0.15 * rng.standard_normal(3)
    else:
        direction = rng.standard_normal(3) * (1, 1, 0.3)
    direction = direction / np.linalg.norm(direction)
    height = float(np.quantile(x @ direction, 1 - share))
    made = simulate_scan(
        mesh, rng, triangles=TRIANGLES, noise_mm=NOISE_MM, T_scan_model=random_similarity(rng, 180.0, (1.0, 1.0)),
        crop=[Cut(height * direction, direction)],
    )  # fmt: skip
    truth = made.truth_vertices
    return Case(model, made.scan, truth, x @ direction > height, made.T_scan_model, Mesh(truth, mesh.faces))


def molar_case(share: float, seed: int, number: int, file: Path) -> Case:
    """Return a molar broken across its crown, as it was scanned, and a model of the other genera."""
    scans, surfaces, genera = molars_in_correspondence(file)
    rng = np.random.default_rng([seed, 1, number])
    k = int(rng.integers(len(scans)))
    others = [s for s, genus in zip(surfaces, genera, strict=True) if genus == "NA" or genus != genera[k]]
    model = ShapeModel.fit([s for s in others if s is not surfaces[k]], gauge="shape")
    scan, x = scans[k], surfaces[k].vertices
    angle, axes = rng.uniform(0, 2 * np.pi), np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2]
    direction = np.cos(angle) * axes[0] + np.sin(angle) * axes[1]
    height = float(np.quantile(x @ direction, 1 - share))
    T = random_similarity(rng, 180.0, (1.0, 1.0))
    broken = part_of(scan, scan.vertices @ direction < height)
    surface = scan.with_vertices(T.apply(scan.vertices))
    return Case(
        model, broken.with_vertices(T.apply(broken.vertices)), T.apply(x), x @ direction > height, T, surface
    )  # fmt: skip


@cache
def molars_in_correspondence(file: Path) -> tuple[list[Mesh], list[Mesh], list[str]]:
    """Return scans of one side, their surfaces in correspondence (kept in `file`), and their genera; RMS size 100."""
    scans = {s.name: mirror_image(s) if s.name in MIRRORED_MOLARS else s for s in molars(0)[0]}
    if not file.is_file():
        made = correspond(list(scans.values()), CorrespondConfig(vertices=1000, rounds=2))
        kept = {s.name: s.vertices for s in made.scans if s.vertices is not None and not s.mirrored}
        assert made.template.faces is not None
        np.savez(file, names=list(kept), vertices=np.stack(list(kept.values())), faces=made.template.faces)
    stored = np.load(file)
    table = (Path(os.environ["SHAPESPACE_DATA"]) / "molars" / "table.csv").read_text().splitlines()[1:]
    genus = {line.split(",")[0]: line.split(",")[3] for line in table}
    names = [str(name) for name in stored["names"]]
    sizes = [SIZE / rms_size(scans[name].vertices) for name in names]
    return (
        [scans[name].with_vertices(scans[name].vertices * s) for name, s in zip(names, sizes, strict=True)],
        [Mesh(x * s, stored["faces"], name=n) for n, x, s in zip(names, stored["vertices"], sizes, strict=True)],
        [genus[name] for name in names],
    )


def distance(one: Case, vertices: FloatArray) -> float:
    """Return the mean distance between the missing part and a surface, in both directions."""
    there = build_engine(one.surface).query(np.ascontiguousarray(vertices[one.missing])).distance.mean()
    back = build_engine(Mesh(vertices, one.model.faces)).query(np.ascontiguousarray(one.truth[one.missing]))
    return float(there + back.distance.mean()) / 2


def references(one: Case) -> dict[str, float]:
    """Return the errors of the mean shape, of scalismo's posterior, and of that along normals without a pose."""
    model, observed, mean = one.model, ~one.missing, one.model.mean_vertices
    with_scale = model.gauge == "shape"
    T = fit_similarity(mean[observed], one.truth[observed], with_scale=with_scale)
    of_mean = float(np.linalg.norm(T.apply(mean) - one.truth, axis=1)[one.missing].mean())
    # Samples of the femur model are in its pose; shapes of other models are aligned.
    T = fit_similarity(mean, one.truth, with_scale=with_scale) if model.is_n_training_known else one.T_scan_model
    y = T.inverse().apply(one.truth)
    modes = model.vertex_basis.reshape(model.n_vertices, 3, -1)
    precision = 1.0 / (model.stddev**2 if not model.is_n_training_known else variance_of_new_shapes(model))

    def estimate(rows: FloatArray, seen: FloatArray, prior: FloatArray, moves: FloatArray) -> FloatArray:
        theta = np.linalg.solve(rows.T @ rows / NOISE_MM**2 + np.diag(prior), rows.T @ seen / NOISE_MM**2)
        return np.asarray(T.apply(mean + moves @ theta))

    full = estimate(modes[observed].reshape(-1, model.n_modes), (y - mean)[observed].ravel(), precision, modes)
    free = POSE if with_scale else POSE - 1
    normals, pose = vertex_normals(Mesh(y, model.faces)), small_poses(y).reshape(-1, 3, POSE)[:, :, :free]
    extra = residual_modes(model, RobustSettings().residual)
    lack = lack_of_new_shapes(model) if model.is_n_training_known else 0.0  # femora are in the span of their model
    off_model = (extra.stddev**2).sum() / (lack**2 * model.n_vertices + 1e-9) / extra.stddev**2
    both = np.concatenate([pose, extra.modes.astype(np.float64)], axis=2)  # the model's modes, then others
    along = np.einsum("vd,vdk->vk", normals, both)[observed]
    seen = np.einsum("vd,vd->v", normals, y - mean)[observed]
    of_normals = estimate(along, seen, np.concatenate([np.full(free, 1e-9), precision, off_model]), both)
    figures = {
        name: float(np.linalg.norm(x - one.truth, axis=1)[one.missing].mean())
        for name, x in (("scalismo", full), ("along normals", of_normals))
    }
    return figures | {"mean": of_mean, "along normals surface": distance(one, of_normals)}


def measure(task: tuple[str, float, int, int, Path]) -> dict[str, float]:
    """Return the figures of one case; those of the completion only where it is not refused."""
    one = case(*task)
    figures = references(one)
    start = time.process_time()
    try:
        made = complete(one.model, one.scan, CompletionConfig(samples=SAMPLES, fit=FitConfig(unit="mm")))
    except FitError:
        return figures | {"refused": 1.0}
    figures |= {"refused": 0.0, "seconds": time.process_time() - start}

    def error(vertices: FloatArray) -> float:
        return float(np.linalg.norm(vertices - one.truth, axis=1)[one.missing].mean())

    of_fit = made.fit.surface().vertices
    figures |= {"fit": error(of_fit), "completed": error(made.vertices)}
    figures |= {"fit surface": distance(one, of_fit), "completed surface": distance(one, made.vertices)}
    if task[0].startswith("faces"):
        T, variance = made.T_scan_model, made.posterior.vertex_covariance().trace(axis1=1, axis2=2)
        for mirror, weighed_by in (("combined", variance), ("alone", None)):
            moved = add_mirror_image(one.model, T.inverse().apply(made.vertices), made.observed, weighed_by)[0]
            figures[f"mirror {mirror}"] = error(T.apply(moved))
    return figures | calibration(made, one)


def calibration(made: Completion, one: Case) -> dict[str, float]:
    """Return predicted errors, coverage, ranks and the energy score of a completion."""
    T, missing, truth = made.T_scan_model, one.missing, one.truth
    off = ((made.vertices - truth) @ T.rotation / T.scale)[missing]
    covariance = made.posterior.vertex_covariance()[missing] + 1e-6 * np.eye(3)
    m2 = np.einsum("vi,vij,vj->v", off, np.linalg.inv(covariance), off)
    z = np.abs(off) / np.sqrt(np.einsum("vii->vi", covariance))
    predicted, rms = (float(np.sqrt(x.mean())) for x in (np.einsum("vii->v", covariance), (off**2).sum(axis=1)))
    figures = {"predicted": T.scale * predicted, "wrong": float(rms > WRONG * predicted)}
    for level in LEVELS:
        figures[f"region {level}"] = float((m2 <= chi2.ppf(level, 3)).mean())
        figures[f"coordinate {level}"] = float((z <= norm.ppf((1 + level) / 2)).mean())
    whole = made.draw_samples(SAMPLES).astype(np.float64)
    samples = whole[:, missing]
    to_truth = np.sqrt(((samples - truth[missing]) ** 2).sum(axis=2).mean(axis=1)).mean()
    apart = np.sqrt(((samples[::2] - samples[1::2]) ** 2).sum(axis=2).mean(axis=1)).mean()
    figures["energy"] = float(to_truth - 0.5 * apart) / (T.scale * rms)
    centre, corners = truth.mean(axis=0), np.asarray(one.model.faces).T
    axis = np.linalg.svd(truth - centre, full_matrices=False)[2][0]
    measures: dict[str, Callable[[FloatArray], float]] = {
        "volume": lambda x: float(np.einsum("fi,fi->", x[corners[0]], np.cross(x[corners[1]], x[corners[2]]))) / 6,
        "length": lambda x: float(np.ptp(x @ axis)),
    }
    for name, function in measures.items():
        values = np.array([function(x - centre) for x in whole])
        figures[f"{name} rank"] = float((values < function(truth - centre)).mean())
    return figures


def rows(setting: str, found: Sequence[dict[str, float]]) -> tuple[list[str], list[str]]:
    """Return the cells of the table of errors and of that of calibration; refused scans count in references alone."""
    kind, _, share = setting.partition(":")
    done = [figures for figures in found if not figures["refused"]]
    cases = f"{kind}, {100 * float(share):.0f} %"

    def mean(name: str) -> float:
        return float(np.mean([figures[name] for figures in done])) if name in done[0] else float("nan")

    refused = f"{100 * (1 - len(done) / len(found)):.0f} %"
    if not done:
        return [cases], [cases, f"{len(found)}", refused]
    errors = [f"{mean(name):.2f}" if np.isfinite(mean(name)) else "" for name in ERRORS]
    covered = [
        " / ".join(f"{100 * mean(f'{name} {level}'):.0f}" for level in LEVELS) for name in ("region", "coordinate")
    ]
    for name in ("volume", "length"):
        ranks = np.array([figures[f"{name} rank"] for figures in done])
        inside = [100 * np.mean(np.abs(ranks - 0.5) <= level / 2) for level in LEVELS]
        covered.append(" / ".join(f"{x:.0f}" for x in inside) + f" (p {kstest(ranks, 'uniform').pvalue:.2g})")
    return (
        [cases, *errors],
        [
            cases,
            f"{len(found)}",
            refused,
            f"{100 * mean('wrong'):.0f} %",
            *covered[:2],
            f"{mean('energy'):.2f}",
            *covered[2:],
            f"{mean('seconds'):.1f}",
        ],
    )


def print_table(header: Sequence[str], body: Sequence[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    for cells in (header, ["---"] * len(header), *body):
        print(f"| {' | '.join(cells)} |")
    print(flush=True)


def print_cost() -> None:
    """Print time and memory of 100 samples, and of the completion, with a model of 100 heads."""
    generator, rng = load_faces(), np.random.default_rng(0)
    model = ShapeModel.fit([generator.face(generator.draw_person(rng)) for _ in range(100)], gauge="form")
    mesh = generator.face(generator.draw_person(rng))
    plane = Cut(np.quantile(mesh.vertices, 0.6, axis=0), (1.0, 0.0, 0.0))
    scan = simulate_scan(mesh, rng, triangles=TRIANGLES, noise_mm=NOISE_MM, crop=[plane]).scan
    config = CompletionConfig(fit=FitConfig(unit="mm"))
    complete(model, scan, config)  # compiles, and prepares the model

    def cost(function: Callable[[], object]) -> str:
        start = time.perf_counter()
        function()
        seconds = time.perf_counter() - start
        tracemalloc.start()
        function()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return f"{seconds:.2f} s, {peak / 2**20:.0f} MiB at most"

    made = complete(model, scan, config)
    rows = np.arange(model.n_vertices)[np.linspace(0, model.n_vertices - 1, 10_000).astype(int)]
    surface = made.posterior.surface
    surface = replace(surface, vertices=surface.vertices[rows], modes=surface.modes[rows])
    fewer = replace(made, posterior=replace(made.posterior, surface=surface), vertices=made.vertices[rows])
    modes = surface.modes.shape[2]
    print(f"100 samples of 10,000 vertices, {modes} modes: {cost(lambda: fewer.draw_samples(100))}")
    print(f"completion with {model.n_vertices} vertices: {cost(lambda: complete(model, scan, config))}")


def main() -> None:
    """Print a table of errors and one of calibration."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", nargs="*", metavar="KIND:SHARE", default=list(DEFAULT))
    parser.add_argument("--cases", type=int, default=34, help="of each seed")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--molars", type=Path, default=Path("molars.npz"), help="keeps the correspondence of molars")
    parser.add_argument("--json", type=Path, help="also write the figures of all cases")
    parser.add_argument("--cost", action="store_true")
    arguments = parser.parse_args()
    if arguments.cost:
        print_cost()
        return
    if any(setting.startswith("molars") for setting in arguments.settings):
        molars_in_correspondence(arguments.molars)
    every: dict[str, list[dict[str, float]]] = {}
    with ProcessPoolExecutor(arguments.jobs) as executor:
        for setting in arguments.settings:
            kind, _, share = setting.partition(":")
            tasks = [
                (kind, float(share), s, k, arguments.molars) for s in arguments.seeds for k in range(arguments.cases)
            ]
            every[setting] = list(executor.map(measure, tasks))
            print(*rows(setting, every[setting]), sep="\n", file=sys.stderr, flush=True)
            if arguments.json:
                arguments.json.write_text(json.dumps(every))
    tables = list(zip(*(rows(setting, found) for setting, found in every.items()), strict=True))
    print_table(["cases, missing", *ERRORS.values()], tables[0])
    calibrated = ("number", "refused", "wrong pose", "regions 50 / 90 / 95 %", "coordinates", "energy / error")
    print_table(["cases, missing", *calibrated, "volume", "length", "s"], tables[1])


if __name__ == "__main__":
    main()
