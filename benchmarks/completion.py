"""How near to the truth are completed parts, and how often does the truth lie in their intervals?

    python benchmarks/completion.py                                 all kinds and shares, three seeds: two hours
    python benchmarks/completion.py femora:0.3 faces-30:0.4 --cases 12
    python benchmarks/completion.py --cost                          time and memory of 100 samples of 10,000 vertices

Errors are mean distances of missing vertices from their true places, mm: of the mean shape in the best pose of what is
observed, of the coefficients of the fit, of the completion, of the analytic posterior that knows the true pose and the
true positions of all observed vertices (scalismo), and of the one that knows them along the normals alone, but not the
pose: scans show no more. Coverage is of the regions of 50, 90 and 95 % of missing vertices (chi-squared with three
degrees of freedom) and of the intervals of volume and length; ranks of the true volume among samples are compared with
the uniform distribution (Kolmogorov). Femora are samples of the open femur model, of which the model itself or models
of 60 or 20 samples know; faces and organs are simulated, and neither models nor cases share shapes.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from missing import femora, femur_file
from scipy.spatial import ConvexHull
from scipy.stats import chi2, kstest

from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ
from shapespace.datasets.simulated_scan import Cut, random_similarity, simulate_scan
from shapespace.errors import ShapespaceError
from shapespace.fit.completion.complete import Completion, CompletionConfig, complete
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.geometry.normals import vertex_normals
from shapespace.geometry.similarity import fit_similarity, small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity

NOISE_MM, TRIANGLES = 0.3, 8_000
LEVELS = (0.5, 0.9, 0.95)
DEFAULT = (
    *(f"{kind}:{share}" for kind in ("femora", "femora-60", "femora-20") for share in (0.1, 0.3, 0.6)),
    *(f"{kind}:{share}" for kind in ("faces-100", "faces-30") for share in (0.2, 0.4, 0.6)),
    *(f"organs-40:{share}" for share in (0.3, 0.5)),
)
ERRORS = ("mean", "fit", "completed", "predicted", "scalismo", "along normals", "mirror combined", "mirror alone")
COLUMNS = (
    "cases", "number", "refused", "mean shape", "fit", "completed", "predicted", "positions and pose known",
    "known along normals", "mirror combined", "mirror alone", "in 50 / 90 / 95 %", "energy score / error", "volume",
    "length", "s",
)  # fmt: skip
Draw = Callable[[np.random.Generator], Mesh]


def faces() -> Draw:
    generator = load_faces()
    return lambda rng: generator.cut_to_face(generator.face(generator.draw_person(rng)))


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
    """A scan without a part, and the truth in its frame."""

    scan: Mesh
    truth: FloatArray
    missing: BoolArray
    T_scan_model: Similarity


def case(draw: Draw, kind: str, share: float, seed: int, number: int) -> Case:
    """Return a shape cut by a plane: across the long axis of a femur, from any side of others."""
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
    return Case(made.scan, made.truth_vertices, x @ direction > height, made.T_scan_model)


def references(model: ShapeModel, one: Case) -> tuple[float, float, float]:
    """Return the errors of the mean shape, of scalismo's posterior, and of that along normals without a pose."""
    observed, mean = ~one.missing, model.mean_vertices
    T = fit_similarity(mean[observed], one.truth[observed], with_scale=False)
    of_mean = float(np.linalg.norm(T.apply(mean) - one.truth, axis=1)[one.missing].mean())
    # Samples of the femur model are in its pose; shapes of other models are aligned.
    T = fit_similarity(mean, one.truth, with_scale=False) if model.is_n_training_known else one.T_scan_model
    y = T.inverse().apply(one.truth)
    modes = model.vertex_basis.reshape(model.n_vertices, 3, -1)
    precision = 1.0 / (model.stddev**2 if not model.is_n_training_known else variance_of_new_shapes(model))

    def error(rows: FloatArray, seen: FloatArray, prior: FloatArray, moves: FloatArray) -> float:
        theta = np.linalg.solve(rows.T @ rows / NOISE_MM**2 + np.diag(prior), rows.T @ seen / NOISE_MM**2)
        return float(np.linalg.norm(mean + moves @ theta - y, axis=1)[one.missing].mean())

    full = error(modes[observed].reshape(-1, model.n_modes), (y - mean)[observed].ravel(), precision, modes)
    normals, pose = vertex_normals(Mesh(y, model.faces)), small_poses(y).reshape(-1, 3, 7)[:, :, :6]
    both = np.concatenate([pose, modes], axis=2)
    along = np.einsum("vd,vdk->vk", normals, both)[observed]
    seen = np.einsum("vd,vd->v", normals, y - mean)[observed]
    return of_mean, full, error(along, seen, np.concatenate([np.full(6, 1e-9), precision]), both)


def measure(kind: str, share: float, seed: int, number: int) -> dict[str, float]:
    """Return the figures of one case; only `refused` where there is no completion."""
    draw, model = population(kind, seed)
    one = case(draw, kind, share, seed, number)
    of_mean, full, along = references(model, one)
    figures = {"mean": of_mean, "scalismo": full, "along normals": along, "refused": 0.0}
    fit = FitConfig(unit="mm")
    start = time.process_time()
    try:
        made = complete(model, one.scan, CompletionConfig(samples=200, fit=fit))
    except ShapespaceError:
        return {"refused": 1.0}
    figures["seconds"] = time.process_time() - start

    def error(vertices: FloatArray) -> float:
        return float(np.linalg.norm(vertices - one.truth, axis=1)[one.missing].mean())

    figures |= {"fit": error(made.fit.surface().vertices), "completed": error(made.vertices)}
    if kind.startswith("faces"):
        for mirror in ("combined", "alone"):
            config = CompletionConfig(mirror=mirror, fit=fit)
            figures[f"mirror {mirror}"] = error(complete(model, one.scan, config).vertices)
    return figures | calibration(made, one)


def calibration(made: Completion, one: Case) -> dict[str, float]:
    """Return predicted errors, coverage, ranks and the energy score of a completion."""
    R = made.T_scan_model.rotation
    off = ((made.vertices - one.truth) @ R)[one.missing]
    covariance = made.posterior.vertex_covariance()[one.missing] + 1e-6 * np.eye(3)
    m2 = np.einsum("vi,vij,vj->v", off, np.linalg.inv(covariance), off)
    figures = {"predicted": float(np.sqrt(np.einsum("vii->v", covariance)).mean())}
    figures |= {f"in {level}": float((m2 <= chi2.ppf(level, 3)).mean()) for level in LEVELS}
    samples = made.draw_samples(200).astype(np.float64)[:, one.missing]
    to_truth = np.sqrt(((samples - one.truth[one.missing]) ** 2).sum(axis=2).mean(axis=1)).mean()
    apart = np.sqrt(((samples[:100] - samples[100:]) ** 2).sum(axis=2).mean(axis=1)).mean()
    rms = float(np.sqrt((off**2).sum(axis=1).mean()))
    figures["energy score / error"] = float(to_truth - 0.5 * apart) / rms
    axis = np.linalg.svd(one.truth - one.truth.mean(axis=0), full_matrices=False)[2][0]
    faces = np.asarray(made.model.faces)
    measures: dict[str, Callable[[FloatArray], float]] = {
        "volume": lambda x: float(np.einsum("fi,fi->", x[faces[:, 0]], np.cross(x[faces[:, 1]], x[faces[:, 2]]))) / 6,
        "length": lambda x: float(np.ptp(x @ axis)),
    }
    whole = made.draw_samples(200).astype(np.float64)
    centre = one.truth.mean(axis=0)
    for name, function in measures.items():
        values = np.array([function(x - centre) for x in whole])
        figures[f"{name} rank"] = float((values < function(one.truth - centre)).mean())
    return figures


def row(kind: str, share: float, cases: int, seeds: Sequence[int]) -> str:
    """Return a row of the table."""
    found = [measure(kind, share, seed, k) for seed in seeds for k in range(cases)]
    done = [figures for figures in found if not figures["refused"]]

    def mean(name: str) -> float:
        return float(np.mean([figures[name] for figures in done])) if name in done[0] else float("nan")

    cells = [f"{kind}, {100 * share:.0f} % missing", f"{len(found)}", f"{100 * (1 - len(done) / len(found)):.0f} %"]
    cells += [
        f"{mean(name):.2f}"
        for name in (
            "mean",
            "fit",
            "completed",
            "predicted",
            "scalismo",
            "along normals",
            "mirror combined",
            "mirror alone",
        )
    ]
    cells.append(" / ".join(f"{100 * mean(f'in {level}'):.0f}" for level in LEVELS))
    cells.append(f"{mean('energy score / error'):.2f}")
    for name in ("volume", "length"):
        ranks = np.array([figures[f"{name} rank"] for figures in done])
        inside = [100 * np.mean(np.abs(ranks - 0.5) <= level / 2) for level in LEVELS]
        cells.append(" / ".join(f"{share:.0f}" for share in inside) + f" (p {kstest(ranks, 'uniform').pvalue:.2g})")
    cells.append(f"{mean('seconds'):.1f}")
    return f"| {' | '.join(cells)} |"


def print_cost() -> None:
    """Print time and memory of 100 samples of a model of 10,000 vertices and 99 modes."""
    draw, model = population("faces-100", 0)
    one = case(draw, "faces-100", 0.4, 0, 0)
    made = complete(model, one.scan, CompletionConfig(fit=FitConfig(unit="mm")))
    rows = np.random.default_rng(0).integers(model.n_vertices, size=10_000)
    surface = replace(
        made.posterior.surface, vertices=made.posterior.surface.vertices[rows], modes=made.posterior.surface.modes[rows]
    )
    larger = replace(made, posterior=replace(made.posterior, surface=surface), vertices=made.vertices[rows])
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    samples = larger.draw_samples(100)
    seconds = time.perf_counter() - start
    more_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"{samples.shape[0]} samples of {samples.shape[1]} vertices: {seconds:.2f} s, at most {more_mb:.0f} MB more")


def main() -> None:
    """Print a row for each kind and share."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("settings", nargs="*", metavar="KIND:SHARE", default=list(DEFAULT))
    parser.add_argument("--cases", type=int, default=34, help="of each seed")
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--cost", action="store_true")
    arguments = parser.parse_args()
    if arguments.cost:
        print_cost()
        return
    print(f"| {' | '.join(COLUMNS)} |")
    print("|" + "---|" * len(COLUMNS))
    for setting in arguments.settings:
        kind, _, share = setting.partition(":")
        print(row(kind, float(share), arguments.cases, arguments.seeds), flush=True)


if __name__ == "__main__":
    main()
