"""Measure the verdict as a detector: how many wrong fits pass as converged, how many good ones are doubted.

Simulated fits over the hard range: people of many shapes, up to 60 % cut or torn away, hair, collar, outliers, noise,
few triangles or none, any pose and unit, bad starts, expressions that the model lacks, and things that are no face.
A fit is wrong if the mean true vertex error, over all the model's vertices, exceeds 3 mm, or if the scan shows
something else. Bounds are tuned on the split "dev" and judged on "test".
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import signal
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from cases import FAILED_MM, Bench, Scan, Split, error_mm, run
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

import shapespace
from shapespace import FitConfig, fit_scan
from shapespace.datasets.ict import EXPRESSIONS
from shapespace.datasets.simulated_scan import Collar, Hair, retriangulate, simulate_scan
from shapespace.errors import ShapespaceError
from shapespace.fit.diagnostics.failure_model import SCORE_TERMS, FitEvidence
from shapespace.geometry.normals import face_areas
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh, Similarity

FITS = 500
MOST_PASSED, MOST_DOUBTED = 0.01, 0.05
KINDS = {"face": 0.55, "bad start": 0.1, "expression": 0.1, "head": 0.07, "no face": 0.18}
THINGS = ("ball", "back of a head", "box", "waves", "cylinder", "lump", "half a ball", "ear")
POSES = {"upright": 0.5, "any": 0.5}
_TRIANGLES = (2_000, 40_000)
_NOISE_MM = (0.1, 2.0)
_MOST_MISSING, _MOST_OUTLIERS = 0.6, 0.3


@dataclass(frozen=True, eq=False)
class Drawn:
    """One fit to be judged.

    Args:
        kind: a name of `KINDS`.
        what: in words.
        model: a name of `cases.MODELS`.
        modes: the model is cut to its first so many; None for all.
        scan: with its truth, or without where it shows something else.
    """

    kind: str
    what: str
    model: str
    modes: int | None
    scan: Scan


def draw(bench: Bench, index: int) -> Drawn:
    """Return the index-th fit of the split of `bench`."""
    rng = bench.rng("trust", index)
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    model, modes = (("ict200", None), ("ict200", 50), ("ict60", None))[rng.choice(3, p=(0.4, 0.2, 0.4))]
    triangles = round(float(np.exp(rng.uniform(*np.log(_TRIANGLES)))))
    noise = float(np.exp(rng.uniform(*np.log(_NOISE_MM))))
    person = int(rng.integers(40))
    labels = [f"{triangles} triangles", f"noise {noise:.2f} mm"]
    if kind == "no face":
        kind_name = THINGS[rng.integers(len(THINGS))]
        mesh, truth = _object(bench, kind_name, person, triangles, noise, rng), None
        labels.insert(0, kind_name)
    else:
        expression = None
        if kind == "expression":
            name = str(rng.choice([*EXPRESSIONS, "jawOpen"]))
            share = float(rng.uniform(0.2, 1.0))
            whole = EXPRESSIONS.get(name, {"jawOpen": 1.0})
            expression = {key: share * value for key, value in whole.items()}
            labels.append(f"{name} by {share:.2f}")
        face = bench.faces.mesh(bench.person(person), expression)
        outliers = float(rng.uniform(0, _MOST_OUTLIERS)) if rng.random() < 0.5 else 0.0
        hairy = rng.random() < 0.3
        whole = face
        if kind == "head":
            whole, hairy = bench.faces.mesh(bench.person(person), expression, area="face_and_head"), False
        simulated = simulate_scan(
            whole,
            rng,
            triangles=triangles,
            noise_mm=noise,
            outlier_fraction=outliers,
            hair=Hair() if hairy else None,
            collar=Collar() if hairy else None,
        )
        missing = float(rng.uniform(0, _MOST_MISSING)) if rng.random() < 0.7 else 0.0
        mesh = _torn(simulated.scan, missing, rng)
        labels += [f"{100 * missing:.0f} % missing", f"{100 * outliers:.0f} % outliers"] + ["hair, collar"] * hairy
        truth = face.vertices
        if rng.random() < 0.15:
            points = rng.choice(len(mesh.vertices), min(len(mesh.vertices), 20_000), replace=False)
            mesh = Mesh(mesh.vertices[points])
            labels.append("points")
    pose = str(rng.choice(list(POSES), p=list(POSES.values())))
    turn = _turn(rng, 20.0) if pose == "upright" else np.asarray(Rotation.from_quat(rng.standard_normal(4)).as_matrix())
    mm = 1.0 if pose == "upright" else float(rng.choice(sorted(MM_PER_UNIT.values())))
    T = Similarity(1.0 / mm, turn, rng.uniform(-500, 500, 3) / mm)
    faces = mesh.faces
    if faces is not None and rng.random() < 0.1:
        faces = faces[:, ::-1]
    start = None
    if kind == "bad start":
        off = np.asarray(Rotation.from_rotvec(np.radians(rng.uniform(30, 180)) * _direction(rng)).as_matrix())
        start = T @ Similarity(float(np.exp(0.15 * rng.standard_normal())), off, rng.uniform(0, 40) * _direction(rng))
        labels.append("start far off")
    labels.append(f"{pose} in units of {mm:g} mm")
    name = f"trust {index}"
    placed = Scan(Mesh(T.apply(mesh.vertices), faces, name=name), None if truth is None else T.apply(truth), T, start)
    return Drawn(kind, ", ".join(labels), model, modes, placed)


def _direction(rng: np.random.Generator) -> FloatArray:
    axis = rng.standard_normal(3)
    return axis / np.linalg.norm(axis)


def _turn(rng: np.random.Generator, most_deg: float) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(np.radians(rng.uniform(0, most_deg)) * _direction(rng)).as_matrix())


def _torn(mesh: Mesh, missing: float, rng: np.random.Generator) -> Mesh:
    """Return `mesh` without a share of its area: cut off by planes, or torn out in large holes."""
    area, middle = face_areas(mesh), mesh.vertices[mesh.faces].mean(axis=1)
    there = np.ones(len(middle), dtype=np.bool_)
    kinds = ("p", "pp", "hh", "hhh", "ph", "hhhhhhhh")[rng.integers(6)]
    for kind, part in zip(kinds, rng.dirichlet(np.full(len(kinds), 4.0)), strict=True):
        if kind == "p":
            turn = rng.uniform(0, 2 * np.pi)
            last = middle @ np.array([np.cos(turn), np.sin(turn), 0.3 * rng.standard_normal()])
        else:
            last = -np.linalg.norm(middle - middle[rng.choice(np.flatnonzero(there))], axis=1)
        order = np.argsort(-np.where(there, last, -np.inf))
        there[order[: np.searchsorted(np.cumsum(area[order]), missing * part * area.sum())]] = False
    return _only(mesh, there)


def _only(mesh: Mesh, kept: FloatArray) -> Mesh:
    used, faces = np.unique(mesh.faces[kept], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), name=mesh.name)


def _object(bench: Bench, kind_name: str, person: int, triangles: int, noise: float, rng: np.random.Generator) -> Mesh:
    """Return a surface of about a face's size that is no face."""
    if kind_name in ("back of a head", "ear"):
        head = bench.faces.mesh(bench.person(person), area="face_and_head")
        middle = head.vertices[head.faces].mean(axis=1)
        if kind_name == "ear":
            tip = head.vertices[np.abs(head.vertices[:, 0]).argmax()]
            there = np.linalg.norm(middle - tip, axis=1) < rng.uniform(35, 60)
        else:
            there = middle[:, 2] < np.quantile(middle[:, 2], rng.uniform(0.15, 0.35))
        part = _only(head, there)
        return _noisy(Mesh(*_resampled(part, rng, triangles)), noise, rng)
    size = rng.uniform(60.0, 120.0)
    n = max(12, round(np.sqrt(triangles / 2)))
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij")
    if kind_name in ("ball", "half a ball", "lump"):
        most = np.pi if kind_name != "half a ball" else np.pi / 2
        polar, azimuth = most * (0.01 + 0.98 * u), 2 * np.pi * v
        points = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
        if kind_name == "lump":
            points = points * (1 + 0.1 * _waves(points.reshape(-1, 3), rng, 1.5).reshape(n, n, 1))
    elif kind_name == "cylinder":
        points = np.stack([np.cos(2 * np.pi * v), 3 * (u - 0.5), np.sin(2 * np.pi * v)], axis=-1)
    elif kind_name == "waves":
        flat = np.stack([2 * u - 1, 2 * v - 1, 0 * u], axis=-1)
        points = flat + np.array([0, 0, 0.15]) * _waves(flat.reshape(-1, 3), rng, 1.0).reshape(n, n, 1)
    else:
        points = np.stack([2 * u - 1, 2 * v - 1, 0 * u], axis=-1)
        points = np.concatenate([points, points[..., [2, 0, 1]] + [-1, 0, -1], points[..., [1, 2, 0]] + [0, -1, -1]])
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    grid = np.concatenate(
        [np.stack([corner, corner + n, corner + 1], 1), np.stack([corner + 1, corner + n, corner + n + 1], 1)]
    )
    grid = np.concatenate([grid + k * n * n for k in range(points.size // (3 * n * n))])
    stretch = size * np.exp(0.2 * rng.standard_normal(3))
    return _noisy(Mesh(points.reshape(-1, 3) * stretch, grid.astype(np.int32)), noise, rng)


def _resampled(mesh: Mesh, rng: np.random.Generator, triangles: int) -> tuple[FloatArray, Any]:
    vertices, faces = retriangulate(mesh, rng, triangles)
    return vertices, faces.astype(np.int32)


def _noisy(mesh: Mesh, noise: float, rng: np.random.Generator) -> Mesh:
    return Mesh(mesh.vertices + noise / np.sqrt(3.0) * rng.standard_normal(mesh.vertices.shape), mesh.faces)


def _waves(points: FloatArray, rng: np.random.Generator, length: float) -> FloatArray:
    waves = rng.standard_normal((12, 3)) * (2 * np.pi / length / np.sqrt(3))
    return np.sin(points @ waves.T + rng.uniform(0, 2 * np.pi, 12)).sum(axis=1) / np.sqrt(6.0)


@dataclass(frozen=True)
class Outcome:
    """What became of one fit.

    Args:
        error_mm: mean true vertex error, mm of the model's frame; None where the scan shows something else.
    """

    index: int
    kind: str
    what: str
    model: str
    modes: int | None
    status: str
    reason: str
    error_mm: float | None
    evidence: Mapping[str, float]
    seconds: float

    @property
    def wrong(self) -> bool:
        return self.error_mm is None or self.error_mm > FAILED_MM

    @property
    def trusted(self) -> bool:
        return self.status in ("converged", "max_iterations")


_bench: Bench | None = None


def prepare(split: Split, cache: Path | None) -> None:
    """Set up a process that judges fits."""
    global _bench
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(1)
    _bench = Bench(split, cache)


def judge(index: int) -> Outcome:
    """Fit the index-th scan and compare with the truth."""
    assert _bench is not None
    drawn = draw(_bench, index)
    model, scan = _bench.model(drawn.model, drawn.modes), drawn.scan
    fields = (index, drawn.kind, drawn.what, drawn.model, drawn.modes)
    begun = time.process_time()
    try:
        result = fit_scan(model, scan.mesh, FitConfig(), T_scan_model=scan.start)
    except ShapespaceError as error:
        return Outcome(*fields, "failed", str(error), None, {}, time.process_time() - begun)
    seconds = time.process_time() - begun
    off = None if scan.truth is None else float(error_mm(result.surface(model).vertices, scan).mean())
    return Outcome(*fields, result.status, result.reason, off, result.evidence.to_dict(), seconds)


def table(outcomes: Sequence[Outcome]) -> str:
    """Return a markdown table of wrong and good fits, by kind."""
    lines = [
        "| scans | fits | wrong | of them passed | good | of them doubted |",
        "|---|---|---|---|---|---|",
    ]
    for kind in ("all", *KINDS):
        of = [o for o in outcomes if kind in ("all", o.kind)]
        wrong, good = [o for o in of if o.wrong], [o for o in of if not o.wrong]
        passed, doubted = sum(o.trusted for o in wrong), sum(not o.trusted for o in good)
        lines.append(
            f"| {kind} | {len(of)} | {len(wrong)} | {_share(passed, len(wrong))} | {len(good)} | "
            f"{_share(doubted, len(good))} |"
        )
    return "\n".join(lines)


def tune(records: Sequence[Mapping[str, Any]]) -> str:
    """Return offset, usual values and weights of the score in `fit.failure_model` that judge `records` best.

    A logistic regression with a small ridge on standardised inputs and no negative weights; the bound is where 5 % of
    the good fits are doubted, each judged by the four fifths it is not in.
    """
    judged = [r for r in records if r["evidence"]]
    raw = np.array([[term.value(FitEvidence(**r["evidence"])) for term in SCORE_TERMS] for r in judged])
    wrong = np.array([r["wrong"] for r in judged])
    usual, spread = np.median(raw[~wrong], axis=0), raw.std(axis=0)
    inputs = np.column_stack([(raw - usual) / spread, np.ones(len(raw))])

    def weights(rows: np.ndarray) -> np.ndarray:
        x, sign = inputs[rows], np.where(wrong[rows], -1.0, 1.0)

        def loss(t: np.ndarray) -> tuple[float, np.ndarray]:
            margin = sign * (x @ t)
            slope = x.T @ (sign / (1 + np.exp(-margin))) + np.append(t[:-1], 0.0)
            return float(np.logaddexp(0, margin).sum() + 0.5 * (t[:-1] ** 2).sum()), slope

        bounds = [(0, None)] * len(SCORE_TERMS) + [(None, None)]
        return minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x

    fold = np.arange(len(raw)) % 5
    unseen = np.zeros(len(raw))
    for k in range(5):
        unseen[fold == k] = inputs[fold == k] @ weights(fold != k)
    bound = float(np.quantile(unseen[~wrong], 0.95))
    t = weights(np.full(len(raw), True))
    passed = float((unseen[wrong] <= bound).mean())
    lines = [
        f"offset {t[-1] - bound:.2f}; cross-validated: 5 % of good fits doubted, {100 * passed:.1f} % of wrong pass"
    ]
    lines += [f"usual={u:.3f}, weight={w / s:.3f}" for u, w, s in zip(usual, t, spread, strict=False)]
    return "\n".join(lines)


def _share(part: int, whole: int) -> str:
    return f"{part} ({100 * part / whole:.1f} %)" if whole else "0"


def machine() -> dict[str, str]:
    """Return where and when this was measured."""
    return {
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "shapespace": shapespace.__version__,
    }


def write(folder: Path, name: str, text: str, record: Mapping[str, Any]) -> None:
    """Write NAME.md and NAME.json into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text + "\n", "utf-8")
    (folder / f"{name}.json").write_text(json.dumps(record, indent=1, default=float) + "\n", "utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=("test", "dev"), default="test")
    parser.add_argument("--fits", type=int, default=FITS)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--tune", type=Path, metavar="TRUST_DEV.json", help="print weights that judge these fits best")
    options = parser.parse_args()
    if options.tune:
        print(tune(json.loads(options.tune.read_text("utf-8"))["fits"]))
        return
    begun = (options.split, options.cache)
    with ProcessPoolExecutor(options.jobs, get_context("spawn"), prepare, begun) as pool:
        outcomes = list(pool.map(judge, range(options.fits), chunksize=5))
    text = table(outcomes)
    print(text)
    for outcome in outcomes:
        if outcome.wrong == outcome.trusted and outcome.status != "failed":
            off = "no face" if outcome.error_mm is None else f"{outcome.error_mm:.2f} mm"
            print(f"{outcome.index} {outcome.kind}, {outcome.what}, {outcome.model}: {off}, {outcome.reason}")
    records = [asdict(outcome) | {"wrong": outcome.wrong} for outcome in outcomes]
    write(options.out, f"trust_{options.split}", text, {"split": options.split, **machine(), "fits": records})


if __name__ == "__main__":
    run(main)
