"""Scans in a minute by `shapespace fit` on a folder, with one job and with several, each in turn.

    python benchmarks/throughput.py [--scans 20] [--jobs 2] [--method robust] [--rounds 3]

The whole command is timed, start of Python, reading and writing included, and once more without what a run of one
scan takes, which is what a long list of scans sees. Target: two jobs on two cores give at least 1.8 times as many.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from accuracy import machine_facts
from cases import Bench, run
from tqdm import tqdm

from shapespace.fit.method_choices import METHODS
from shapespace.io.meshes.mesh_io import write_mesh

LEAST = 1.9
ENV = {**os.environ, **dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")}
"""One job is one core: threads of BLAS would spread it over all, and spin when others need them."""


def seconds(model: Path, scans: list[Path], out: Path, method: str, jobs: int) -> float:
    """Return wall seconds of one run of the command."""
    command = [sys.executable, "-m", "shapespace", "fit", "--quiet", "--again", "--method", method]
    command += ["--jobs", str(jobs)]
    began = time.perf_counter()
    subprocess.run([*command, "-o", str(out), str(model), *map(str, scans)], check=True, capture_output=True, env=ENV)
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--method", choices=list(METHODS), default="robust" if "robust" in METHODS else "paper")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--cache", type=Path)
    args = parser.parse_args()
    bench = Bench("test", args.cache)
    taken: dict[tuple[int, int], list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bench.model("ict200").save(folder / "model.h5")
        scans = [folder / f"scan_{index:03d}.ply" for index in range(args.scans)]
        for index, path in enumerate(scans):
            write_mesh(path, bench.scan("complete", index).mesh)
        seconds(folder / "model.h5", scans[:1], folder / "out", args.method, 1)  # compiled code is made here
        runs = [(jobs, count) for jobs in (1, args.jobs) for count in (1, len(scans))]
        with tqdm(total=args.rounds * len(runs), unit="run", dynamic_ncols=True) as bar:
            for _ in range(args.rounds):
                for jobs, count in runs:
                    # As many scans as jobs, so that every worker has started and read the model.
                    some = scans[: jobs if count == 1 else count]
                    took = seconds(folder / "model.h5", some, folder / "out", args.method, jobs)
                    taken.setdefault((jobs, count), []).append(took)
                    bar.update()
    middle = {key: float(np.median(values)) for key, values in taken.items()}
    n, jobs = args.scans, args.jobs
    whole = {k: 60 * n / middle[k, n] for k in (1, jobs)}
    running = {k: 60 * (n - k) / (middle[k, n] - middle[k, 1]) for k in (1, jobs)}
    facts = machine_facts()
    lines = [
        f"# Throughput, {facts['date']}",
        "",
        f"{facts['machine']}; {n} scans of 40,000 triangles, method {args.method}, {args.rounds} rounds in turn, "
        f"medians, one BLAS thread a process; load average at the end: {os.getloadavg()[0]:.1f}.",
        "",
        f"| | 1 job, scans a minute | {jobs} jobs | ratio | at least | |",
        "|---|---|---|---|---|---|",
    ]
    for what, rate in (("whole command", whole), ("without starting up", running)):
        ratio = rate[jobs] / rate[1]
        lines.append(
            f"| {what} | {rate[1]:.0f} | {rate[jobs]:.0f} | {ratio:.2f} | {LEAST} | "
            f"{'met' if ratio >= LEAST else '**not met**'} |"
        )
    text = "\n".join(lines) + "\n"
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "throughput.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run(main)
