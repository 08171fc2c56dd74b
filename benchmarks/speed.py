"""The speed of the methods beside the paper's in plain NumPy, beside every installed peer, and beside the bound.

    python benchmarks/speed.py                          the complete scan, 100 modes, 40,000 triangles
    python benchmarks/speed.py --case holes_clean --rounds 3
    python benchmarks/speed.py --peers none             ours only, in seconds rather than minutes
    python benchmarks/speed.py --peers none --scan 4    the person for whom the paper's method takes least

Everything runs in one process, in rounds that take turns, with one BLAS thread: CPU seconds are the work done,
whatever else the machine is doing. Search structures are built anew in every call. First calls run in processes of
their own, once with an empty and once with a filled cache of compiled code.
"""

from __future__ import annotations

import argparse
import cProfile
import json
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import peers
from accuracy import FIT_FIELDS, choose, machine_facts
from cases import CASES, Bench, Scan, run
from peers import paper_numpy
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.method_choices import METHODS
from shapespace.fit.paper.paper_method import Paper, shape_icp, similarity_icp
from shapespace.fit.result import FitResult
from shapespace.geometry.closest import ENGINES, build_engine
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh

NUMPY = "paper, NumPy + cKDTree"
NUMPY_PRINTED = "paper, NumPy + cKDTree, stop as printed"
PAPER, ROBUST, ANY_POSE, DENSE = "paper", "robust", "robust, any pose", "robust, dense"
LOOP = "paper, without checks and distances"
# The paper's stopping rule looks at the RMS only and so ends sooner: the harder yardstick for other methods.
# CPU seconds asked for, on a machine where the NumPy version takes this long; only the ratios carry over.
NUMPY_S = 0.8
ASKED_S = {ROBUST: 0.12, ANY_POSE: 0.6, DENSE: 1.0}
PEER_RATIOS = {"meshmonk_pyramid": 30, "biocpd_atlas": 70, "trimesh_amberg": 150, "trimesh_sumner": 150}
LOOP_RATIO = 3.0
Fit = Callable[[], object]


def contenders(model: ShapeModel, scan: Scan, turned: Scan) -> dict[str, Fit]:
    """Return what is timed, by name; methods that this version lacks are left out."""
    start = scan.start
    assert start is not None

    def numpy_version(**stop: float) -> Fit:
        at = (start.scale, start.rotation, start.translation)
        return lambda: paper_numpy.fit(model.mean_vertices, model.vertex_basis, scan.mesh.vertices, *at, **stop)

    def loop() -> object:
        engine, T = build_engine(scan.mesh, "vertices"), start
        for state in similarity_icp(model, engine, T, Paper().stop_rule(500)):
            T = state.T_scan_model
        return list(shape_icp(model, engine, T, Paper().stop_rule(500)))

    def ours(method: str, on: Scan = scan, **more: Any) -> Fit:
        return lambda: fit_scan(model, on.mesh, FitConfig(method=method, **more), T_scan_model=on.start)

    found: dict[str, Fit] = {
        NUMPY: numpy_version(),
        NUMPY_PRINTED: numpy_version(motion_mm=np.inf),
        LOOP: loop,
        PAPER: ours("paper"),
    }
    if "robust" in METHODS:
        found |= {ROBUST: ours("robust"), ANY_POSE: ours("robust", turned)}
        if "dense" in FIT_FIELDS:
            found[DENSE] = ours("robust", dense=True)
    return found


def time_all(fits: Mapping[str, Fit], heavy: Mapping[str, Callable[[], float]], rounds: int, heavy_rounds: int):
    """Return CPU and wall seconds of every call, by name; peers tell their own CPU seconds."""
    cpu: dict[str, list[float]] = {name: [] for name in (*fits, *heavy)}
    wall: dict[str, list[float]] = {name: [] for name in cpu}
    for fit in fits.values():
        fit()  # compiled code is loaded here; `first_calls` counts it
    with tqdm(total=rounds * len(fits) + heavy_rounds * len(heavy), unit="fit", dynamic_ncols=True) as bar:
        for turn in range(rounds):
            for name, fit in fits.items():
                bar.set_postfix_str(name)
                began, ticks = time.perf_counter(), time.process_time()
                fit()
                cpu[name].append(time.process_time() - ticks)
                wall[name].append(time.perf_counter() - began)
                bar.update()
            for name, peer in heavy.items() if turn < heavy_rounds else ():
                bar.set_postfix_str(name)
                began = time.perf_counter()
                cpu[name].append(peer())
                wall[name].append(time.perf_counter() - began)
                bar.update()
    return cpu, wall


def first_calls(method: str, case: str, cache: Path | None) -> tuple[float, float]:
    """Return CPU seconds of the first fit in a new process: without, and with, a cache of compiled code."""
    seconds: list[float] = []
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--first-call", method, "--case", case]
        command += ["--cache", str(cache)] if cache else []
        for _ in range(2):
            done = subprocess.run(
                command, env={**os.environ, "NUMBA_CACHE_DIR": folder}, capture_output=True, text=True, check=True
            )
            seconds.append(float(json.loads(done.stdout.splitlines()[-1])))
    return seconds[0], seconds[1]


def where_time_goes(fit: Callable[[], FitResult]) -> list[str]:
    """Return the parts that the fit itself tells, and the functions that take most of their own time."""
    result = fit()
    parts: Mapping[str, float] = getattr(result, "profile", None) or result.seconds
    whole = sum(parts.values())
    lines = [f"| {part} | {1e3 * s:.1f} | {100 * s / whole:.0f} % |" for part, s in parts.items()]
    profile = cProfile.Profile()
    profile.runcall(fit)
    entries = sorted(pstats.Stats(profile).stats.items(), key=lambda item: -item[1][2])[:8]  # type: ignore[attr-defined]
    top = [
        f"| {Path(file).name}:{name} | {calls} | {1e3 * own:.1f} |"
        for (file, _, name), (_, calls, own, _, _) in entries
    ]
    return [
        "| part | wall ms | share |",
        "|---|---|---|",
        *lines,
        "",
        "| function (under cProfile, which slows Python down) | calls | own ms |",
        "|---|---|---|",
        *top,
    ]


def bound(model: ShapeModel, scan: Mesh, result: FitResult, repeats: int = 5) -> list[str]:
    """Return what the closest-point queries alone would take: each engine built once, asked once an iteration."""
    asked = result.surface(model).vertices
    iterations = max(sum(result.iterations.values()), 1)
    lines = [
        f"{len(asked):,} queries at the fitted surface, {iterations} iterations.",
        "",
        "| engine | build, CPU ms | one query of all, CPU ms | build + one an iteration, CPU ms |",
        "|---|---|---|---|",
    ]
    for name in ENGINES if scan.faces is not None else ["vertices"]:
        build: list[float] = []
        query: list[float] = []
        for _ in range(repeats):
            ticks = time.process_time()
            engine = build_engine(scan, name)
            build.append(time.process_time() - ticks)
            ticks = time.process_time()
            engine.query(asked)
            query.append(time.process_time() - ticks)
        all_of_it = min(build) + iterations * min(query)
        lines.append(f"| {name} | {1e3 * min(build):.1f} | {1e3 * min(query):.1f} | {1e3 * all_of_it:.1f} |")
    return lines


def same_results(model: ShapeModel, scan: Scan) -> float:
    """Return the largest difference, mm, of the paper's method's coefficients from its NumPy version's."""
    start = scan.start
    assert start is not None
    b = paper_numpy.fit(
        model.mean_vertices, model.vertex_basis, scan.mesh.vertices, start.scale, start.rotation, start.translation
    )[3]
    ours = fit_scan(model, scan.mesh, FitConfig(method="paper", unit="mm"), T_scan_model=start).b
    return float(np.abs(b - ours).max())


def targets(cpu: Mapping[str, list[float]]) -> list[str]:
    """Return the table of asked and reached ratios of the median CPU seconds."""
    middle = {name: float(np.median(seconds)) for name, seconds in cpu.items() if seconds}
    lines = ["| ratio of CPU seconds | at least | reached | |", "|---|---|---|---|"]

    def add(slow: str, fast: str, least: float) -> None:
        if slow in middle and fast in middle:
            reached = middle[slow] / middle[fast]
            verdict = "met" if reached >= least else "**not met**"
            lines.append(f"| {slow} / {fast} | {least:.3g} | {reached:.2f} | {verdict} |")

    add(NUMPY, LOOP, LOOP_RATIO)
    add(NUMPY, PAPER, LOOP_RATIO)
    for name, seconds in ASKED_S.items():
        add(NUMPY_PRINTED, name, 6.0 if name == ROBUST else NUMPY_S / seconds)
    for name, least in PEER_RATIOS.items():
        add(name, ROBUST, least)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--case", choices=[n for n, c in CASES.items() if c.with_start], default="complete")
    parser.add_argument("--scan", type=int, default=0, help="number of the person")
    parser.add_argument("--modes", type=int, help="of the model; all by default")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--peer-rounds", type=int, default=1)
    parser.add_argument("--peers", help=f"none, or some of {', '.join(peers.PEERS)}; all by default")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--first-call", help=argparse.SUPPRESS)
    args = parser.parse_args()
    threadpool_limits(1)
    bench = Bench("test", args.cache)
    case = CASES[args.case]
    model, scan = bench.model(case.model, args.modes), bench.scan(case, args.scan)
    if args.first_call:
        ticks = time.process_time()
        fit_scan(model, scan.mesh, FitConfig(method=args.first_call), T_scan_model=scan.start)
        print(json.dumps(time.process_time() - ticks))
        return

    fits = contenders(model, scan, bench.scan("any_pose", args.scan))
    heavy: dict[str, Callable[[], float]] = {}
    assert scan.start is not None
    mean = Mesh(scan.start.apply(model.mean_vertices), model.faces, name="mean")
    for name in [] if args.peers == "none" else choose(args.peers, list(peers.PEERS), "peer"):
        peer = peers.load(name)
        if isinstance(peer, str):
            print(f"not run: {name} ({peer})")
        else:
            heavy[name] = lambda peer=peer: peer.fit(mean, model, scan.mesh, scan.start)[1]
    for name in (ROBUST, ANY_POSE, DENSE):
        if name not in fits:
            print(f"not run: {name} (not in this version of shapespace)")
    cpu, wall = time_all(fits, heavy, args.rounds, min(args.peer_rounds, args.rounds))

    facts = machine_facts()
    count = 0 if scan.mesh.faces is None else len(scan.mesh.faces)
    versions = ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
    base = float(np.median(cpu[NUMPY]))
    lines = [
        f"# Speed, {facts['date']}",
        "",
        f"{facts['machine']}; Python {facts['python']}; {versions}.",
        "",
        f"{model.n_vertices:,} vertices, {model.n_modes} modes; scan `{args.case}` {args.scan} of {count:,} triangles; "
        f"{args.rounds} rounds, one BLAS thread.",
        "",
        "| method | CPU s, min | CPU s, median | wall s, min | wall s, median | NumPy version's CPU over its |",
        "|---|---|---|---|---|---|",
        *(
            f"| {name} | {min(c):.3f} | {np.median(c):.3f} | {min(wall[name]):.3f} | {np.median(wall[name]):.3f} | "
            f"{base / np.median(c):.2f} |"
            for name, c in cpu.items()
        ),
        "",
        f"Largest difference of coefficients, `paper` from NumPy: {same_results(model, scan):.1e} mm.",
        "",
        "## Targets",
        "",
        *targets(cpu),
        "",
        "## First call in a new process, CPU s",
        "",
        "| method | nothing compiled yet | compiled before | from then on (median) |",
        "|---|---|---|---|",
    ]
    for name in (PAPER, ROBUST):
        if name in fits:
            empty, filled = first_calls(name, args.case, args.cache)
            lines.append(f"| {name} | {empty:.2f} | {filled:.2f} | {np.median(cpu[name]):.3f} |")
    for name in (PAPER, ROBUST, ANY_POSE, DENSE):
        if name in fits:
            lines += ["", f"## Where the time goes: {name}", "", *where_time_goes(fits[name])]  # type: ignore[arg-type]
    main_fit = fits.get(ROBUST, fits[PAPER])
    lines += ["", "## The bound: closest-point queries alone", "", *bound(model, scan.mesh, main_fit())]  # type: ignore[arg-type]
    text = "\n".join(lines) + "\n"
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "speed.md").write_text(text)
    (args.out / "speed.json").write_text(
        json.dumps(facts | {"case": args.case, "cpu_s": cpu, "wall_s": wall}, indent=1)
    )
    print(text)


if __name__ == "__main__":
    run(main)
