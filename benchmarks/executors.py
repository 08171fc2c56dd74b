"""What an executor costs: many tasks that do nothing, and scans in a minute on a Dask cluster against processes.

    python benchmarks/executors.py overhead [--tasks 100000] [--workers 2]
    python benchmarks/executors.py throughput [--scans 100] [--workers 2] [--rounds 2]

Overhead is the CPU time of this process, where client and scheduler of the cluster are, for each task, and how much its
memory grows. Throughput is that of `fit_many` on scans of the accuracy benchmark, with workers that are there already,
each executor in turn; what compiles is compiled before.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from cases import Bench
from distributed import Client, LocalCluster
from trivial import Nothing

from shapespace.batch.executors import Executor, Local
from shapespace.batch.on_dask import OnDask
from shapespace.batch.run import BatchConfig, FolderSink, fit_many, make_jobs
from shapespace.io.meshes.mesh_io import write_mesh


def resident_mb() -> float:
    """Return how much memory this process holds, in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def overhead(client: Client, tasks: int) -> dict[str, float]:
    """Return what tasks cost client and scheduler."""
    with OnDask(client).run(Nothing(), range(2000)) as results:
        list(results)
    before, began, wall, most = resident_mb(), time.process_time(), time.perf_counter(), 0.0
    with OnDask(client).run(Nothing(), range(tasks)) as results:
        for number, _ in enumerate(results):
            if number % 1000 == 0:
                most = max(most, resident_mb())
    return {
        "tasks": tasks,
        "client_and_scheduler_ms_a_task": 1e3 * (time.process_time() - began) / tasks,
        "wall_ms_a_task": 1e3 * (time.perf_counter() - wall) / tasks,
        "memory_mb_above_start": most - before,
    }


def throughput(client: Client, scans: int, workers: int, rounds: int, cache: Path | None) -> dict[str, object]:
    """Return scans in a minute by executor."""
    bench = Bench("test", cache)
    model = bench.model("ict200")
    executors: dict[str, Executor] = {"local": Local(workers), "dask": OnDask(client)}
    taken: dict[str, list[float]] = {name: [] for name in executors}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model.save(folder / "model.h5")
        config = BatchConfig(model, folder / "model.h5")
        paths = [folder / f"scan_{index:04d}.ply" for index in range(scans)]
        for index, path in enumerate(paths):
            write_mesh(path, bench.scan("complete", index % 20).mesh)
        for number in range(rounds + 1):
            for kind, executor in executors.items():
                some = paths if number else paths[: 2 * workers]
                began = time.perf_counter()
                fit_many(make_jobs(some), config, executor, FolderSink(folder / f"{kind}{number}"))
                if number:
                    taken[kind].append(60 * scans / (time.perf_counter() - began))
    ratios = np.array(taken["dask"]) / taken["local"]
    return {"scans": scans, "scans_a_minute": taken, "dask_to_local": ratios.tolist()}


def main() -> None:
    """Measure, and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["overhead", "throughput"])
    parser.add_argument("--tasks", type=int, default=100_000)
    parser.add_argument("--scans", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--cache", type=Path)
    args = parser.parse_args()
    with (
        LocalCluster(n_workers=args.workers, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster,
        Client(cluster) as client,
    ):
        found: object = (
            overhead(client, args.tasks)
            if args.what == "overhead"
            else throughput(client, args.scans, args.workers, args.rounds, args.cache)
        )
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
