"""The accuracy of every method on every case of the protocol, as one table and one JSON file.

    python benchmarks/accuracy.py                                   everything
    python benchmarks/accuracy.py --cases complete,holes --people 2 --jobs 2
    python benchmarks/accuracy.py --split dev                       for choosing settings, never for reporting

The error of a scan is the mean distance of all vertices to their true places, in mm of the model's frame. The floor is
the best that the model could do with the true correspondences known. A scan fails when its error is over 3 mm or there
is no result, and fails silently when the method still says that it converged. Ctrl-C keeps what is done.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import importlib.metadata
import json
import os
import platform
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from statistics import fmean, median
from typing import Any

import peers
from cases import CASES, FAILED_MM, PEOPLE, Bench, Case, Scan, Split, Target, error_mm, run, surface_figures
from threadpoolctl import threadpool_limits
from tqdm import tqdm

import shapespace
from shapespace.errors import ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.method_choices import METHODS
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh

PEER_CASES = ("complete", "holes_clean")
FIT_FIELDS = {field.name for field in dataclasses.fields(FitConfig)}
Record = dict[str, Any]


@dataclass(frozen=True)
class Task:
    """One fit: a method, on a scan of a case, reporting so many coefficients (None for all)."""

    case: str
    modes: int | None
    method: str
    index: int


_bench: Bench | None = None


def prepare(split: Split, cache: Path | None) -> None:
    """Set up the process that runs tasks: one thread, so that CPU seconds mean work."""
    global _bench
    threadpool_limits(1)
    _bench = Bench(split, cache)


def prepare_worker(split: Split, cache: Path | None) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    prepare(split, cache)


def run_task(task: Task) -> Record:
    """Return the record of one fit, floor and errors included."""
    assert _bench is not None
    case = CASES[task.case]
    scan = _bench.scan(case, task.index)
    model = _bench.model(case.model, task.modes)
    record: Record = {**dataclasses.asdict(task), "model": case.model, "coefficients": model.n_modes}
    floor = _bench.floor_mm(case, task.index, task.modes)
    if floor is not None:
        record["floor_mm"] = floor
    cpu, wall = time.process_time(), time.perf_counter()
    try:
        if task.method in peers.PEERS:
            vertices, outcome = _run_peer(task.method, _bench.model(case.model), scan)
        else:
            vertices, outcome = _run_ours(task, _bench, scan)
    except ShapespaceError as error:
        vertices, outcome = None, {"status": "failed", "reason": str(error)}
    except Exception as error:
        # A crash is a result too: it is counted as a failure and shown with its message.
        vertices, outcome = None, {"status": "crashed", "reason": f"{type(error).__name__}: {error}"}
    record |= {"cpu_s": time.process_time() - cpu, "wall_s": time.perf_counter() - wall} | outcome
    if vertices is None:
        return record
    mm_per_length = outcome.get("mm_per_length") or 1.0 / scan.T_scan_model.scale
    if scan.truth is not None:
        errors = error_mm(vertices, scan)
        record |= {"error_mm": float(errors.mean()), "error_max_mm": float(errors.max())}
        mm_per_length = 1.0 / scan.T_scan_model.scale
    if case.dense or scan.truth is None or task.method in peers.PEERS:
        record |= surface_figures(vertices, model, scan, mm_per_length)
    return record


def _run_ours(task: Task, bench: Bench, scan: Scan) -> tuple[FloatArray, Record]:
    case = CASES[task.case]
    if task.method == "paper":
        model, config = bench.model(case.model, task.modes), FitConfig(method="paper")
    else:
        # All modes are fitted and the first are reported.
        model = bench.model(case.model)
        options: dict[str, Any] = {} if task.modes is None else {"modes": task.modes}
        config = FitConfig(method=task.method, **options, **({"dense": True} if case.dense else {}))
    result = fit_scan(model, scan.mesh, config, T_scan_model=scan.start)
    stage = "dense" if case.dense and task.method != "paper" else "final"
    outcome = {
        "status": result.status,
        "reason": result.reason,
        "start": result.start,
        "seconds": dict(result.seconds),
        "iterations": dict(result.iterations),
        "scale": result.T_scan_model.scale,
        "mm_per_length": 1.0 / result.T_scan_model.scale,
    }
    return result.surface(model, stage).vertices, outcome


def _run_peer(name: str, model: ShapeModel, scan: Scan) -> tuple[FloatArray, Record]:
    assert scan.start is not None
    placed = Mesh(scan.start.apply(model.mean_vertices), model.faces, name="mean")
    vertices, cpu_s = peers.load(name).fit(placed, model, scan.mesh, scan.start)
    return vertices, {"cpu_s": cpu_s, "status": "ended", "reason": ""}


def tasks_of(cases: Sequence[str], methods: Sequence[str], people: int, peer_scans: int) -> list[Task]:
    """Return every fit to run: all methods on a scan together, so that a cut-off run compares like with like."""

    def runs(method: str, case: Case, modes: int | None, index: int) -> bool:
        # Peers know nothing of K, take a minute each, and need the start.
        once = case.name in PEER_CASES and index < peer_scans and modes == case.modes[0]
        return once or method not in peers.PEERS

    return [
        Task(case.name, modes, method, index)
        for case in (CASES[name] for name in cases)
        for index in range(case.count(people))
        for modes in case.modes
        for method in methods
        if runs(method, case, modes, index)
    ]


def run_all(tasks: Sequence[Task], split: Split, cache: Path | None, jobs: int) -> Iterator[Record]:
    if jobs == 1:
        prepare(split, cache)
        yield from map(run_task, tasks)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn"), prepare_worker, (split, cache)) as pool:
        futures = [pool.submit(run_task, task) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


@dataclass(frozen=True)
class Row:
    """What is said of one method on one case: figures are over the scans that gave a result."""

    case: str
    modes: int | None
    method: str
    coefficients: int
    scans: int
    results: int
    figures: Mapping[str, float]

    @staticmethod
    def of(records: Sequence[Record]) -> Row:
        first = records[0]
        done = [r for r in records if "m2s_mean_mm" in r or "error_mm" in r]
        figures: dict[str, float] = {"cpu_s": median(r["cpu_s"] for r in records)}
        for key in ("error_mm", "floor_mm", *SURFACE):
            values = [r[key] for r in done if key in r]
            if values:
                figures[key] = fmean(values)
        if "error_mm" in figures:
            figures["worst_mm"] = max(r["error_mm"] for r in done)
            if figures["floor_mm"] > 1e-3:
                figures["ratio"] = figures["error_mm"] / figures["floor_mm"]
        judged = [r for r in records if "floor_mm" in r]
        wrong = [r for r in judged if r.get("error_mm", float("inf")) > FAILED_MM]
        figures["failures"] = len(wrong) if judged else len(records) - len(done)
        figures["silent"] = sum(r["status"] not in ("doubtful", "failed", "crashed") for r in wrong)
        figures["doubted"] = sum(r["status"] == "doubtful" for r in records)
        return Row(
            first["case"],
            first["modes"],
            first["method"],
            first["coefficients"],
            len(records),
            len(done),
            figures,
        )

    def meets(self, target: Target) -> bool:
        return self.results == self.scans and self.figures.get(target.of, float("inf")) <= target.most


SURFACE = {
    "surface_mm": "seen to scan",
    "true_surface_mm": "to true surface",
    "folded": "folded",
    "m2s_mean_mm": "model to scan, mean",
    "m2s_median_mm": "median",
    "s2m_mean_mm": "scan to model, mean",
    "s2m_median_mm": "median ",
}
NAMES = {"ratio": "x floor", "error_mm": "error, mm", "failures": "failures"} | SURFACE


def rows_of(records: Sequence[Record]) -> list[Row]:
    groups: dict[tuple[str, int | None, str], list[Record]] = {}
    for record in records:
        groups.setdefault((record["case"], record["modes"], record["method"]), []).append(record)
    order = list(CASES)
    methods = [*METHODS, *peers.PEERS]
    return sorted(
        map(Row.of, groups.values()),
        key=lambda row: (order.index(row.case), row.coefficients, methods.index(row.method)),
    )


def _cell(value: float | None, digits: int = 3) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def _markdown(header: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return lines + ["| " + " | ".join(cells) + " |" for cells in body]


def report(facts: Mapping[str, Any], records: Sequence[Record]) -> str:
    """Return the tables as markdown."""
    rows = rows_of(records)
    lines = [
        f"# Accuracy, split {facts['split']}, {facts['date']}",
        "",
        f"{facts['machine']}; Python {facts['python']}; "
        + ", ".join(f"{name} {version}" for name, version in facts["versions"].items())
        + ".",
    ]
    if not facts["complete"]:
        lines += ["", f"**Cut off: {len(records)} of {facts['tasks']} fits.**"]
    if facts["skipped"]:
        lines += ["", "Not run: " + "; ".join(f"{name} ({why})" for name, why in facts["skipped"].items()) + "."]
    lines += [
        "",
        f"Error: mean distance of all vertices to their true places, mm. Failed: over {FAILED_MM:g} mm, or no result; "
        "silent: failed but not doubted, as peers never are. CPU: median of a fit, one BLAS thread, first compilation "
        "included where it falls in.",
        "",
    ]
    main = [
        (
            row.case,
            str(row.coefficients),
            row.method,
            f"{row.results}/{row.scans}",
            _cell(row.figures.get("floor_mm")),
            _cell(row.figures.get("error_mm")),
            _cell(row.figures.get("worst_mm")),
            _cell(row.figures.get("ratio")),
            f"{row.figures['failures']:.0f}",
            f"{row.figures['silent']:.0f}",
            f"{row.figures['doubted']:.0f}",
            _cell(row.figures["cpu_s"], 2),
        )
        for row in rows
    ]
    header = "case|K|method|results|floor|error|worst scan|x floor|failed|silent|doubted|CPU s"
    lines += _markdown(header.split("|"), main)
    surface = [
        (row.case, str(row.coefficients), row.method, *(_cell(row.figures.get(key)) for key in SURFACE))
        for row in rows
        if "m2s_mean_mm" in row.figures
    ]
    if surface:
        lines += ["", "## Surfaces, mm", "", *_markdown(["case", "K", "method", *SURFACE.values()], surface)]
    lines += ["", "## Targets", "", *_targets(rows), "", "## Cases", ""]
    shown = dict.fromkeys(row.case for row in rows)
    lines += _markdown(["case", "is"], [(name, CASES[name].what) for name in shown])
    broken = dict.fromkeys(
        f"- {r['case']} {r['index']}, K={r['coefficients']}, {r['method']}: {r['reason']}"
        for r in records
        if r["status"] in ("failed", "crashed")
    )
    if broken:
        lines += ["", "## Without a result", "", *broken]
    return "\n".join(lines) + "\n"


def _targets(rows: Sequence[Row]) -> list[str]:
    body: list[Sequence[str]] = []
    for row in rows:
        if row.method in peers.PEERS:
            continue
        for target in (CASES[row.case].targets or {}).get(row.modes, ()):
            reached = row.figures.get(target.of)
            digits = 0 if target.of == "failures" else 3
            body.append(
                (
                    row.case,
                    str(row.coefficients),
                    row.method,
                    NAMES[target.of].strip() if target.of in ("ratio", "error_mm", "failures") else target.of,
                    f"{target.most:g}",
                    _cell(reached, digits) or "no result",
                    "met" if row.meets(target) else "**not met**",
                )
            )
    return _markdown(["case", "K", "method", "figure", "at most", "reached", ""], body)


def machine_facts() -> dict[str, Any]:
    """Return the machine, the versions and the date."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line]
        cpu = names[0] if names else cpu
    packages = ("numpy", "scipy", "numba", "libigl", "open3d", "trimesh", "biocpd", "meshmonk", "pycpd", "small_gicp")
    versions = {"shapespace": shapespace.__version__}
    for package in packages:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return {
        "machine": f"{cpu}, {os.cpu_count()} cores, {platform.system()}",
        "python": platform.python_version(),
        "versions": versions,
        "date": datetime.date.today().isoformat(),
    }


def choose(names: str | None, known: Sequence[str], what: str) -> list[str]:
    chosen = list(known) if names is None else [name.strip() for name in names.split(",") if name.strip()]
    for name in chosen:
        if name not in known:
            raise SystemExit(f"There is no {what} {name!r}; choose from {', '.join(known)}.")
    return chosen


def usable(methods: Sequence[str], cases: Sequence[str]) -> tuple[list[str], list[str], dict[str, str]]:
    """Return the cases and methods that can run here, and why the others cannot."""
    skipped: dict[str, str] = {}
    for name in methods:
        if name in peers.PEERS:
            found = peers.load(name)
            if isinstance(found, str):
                skipped[name] = found
        elif name not in METHODS:
            skipped[name] = "this version of shapespace has no such method"
    for case in (CASES[name] for name in cases):
        if case.dense and "dense" not in FIT_FIELDS:
            skipped[case.name] = "this version of shapespace has no residual stage"
    return [m for m in methods if m not in skipped], [c for c in cases if c not in skipped], skipped


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = list(dict.fromkeys(["paper", "robust", *METHODS, *peers.PEERS]))
    parser.add_argument("--cases", help=f"some of {', '.join(CASES)}")
    parser.add_argument("--methods", help=f"some of {', '.join(known)}")
    parser.add_argument(
        "--people", type=int, default=PEOPLE, help="unseen people; larger cases take several scans of each"
    )
    parser.add_argument("--peer-scans", type=int, default=1, help="scans of a case that peers are run on")
    parser.add_argument("--split", choices=("test", "dev"), default="test")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--cache", type=Path, help="folder for models and scans; default is the user's cache")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    if args.people < 1 or args.jobs < 1:
        raise SystemExit("--people and --jobs must be at least 1.")
    methods, cases, skipped = usable(choose(args.methods, known, "method"), choose(args.cases, list(CASES), "case"))
    for name, why in skipped.items():
        print(f"not run: {name} ({why})")
    tasks = tasks_of(cases, methods, args.people, args.peer_scans)
    args.out.mkdir(parents=True, exist_ok=True)
    records: list[Record] = []
    try:
        with tqdm(total=len(tasks), unit="fit", dynamic_ncols=True) as bar:
            for record in run_all(tasks, args.split, args.cache, args.jobs):
                records.append(record)
                bar.set_postfix_str(f"{record['case']}, {record['method']}")
                bar.update()
    except KeyboardInterrupt:
        print(f"Stopped after {len(records)} of {len(tasks)} fits; writing those.")
    facts = machine_facts() | {
        "split": args.split,
        "people": args.people,
        "tasks": len(tasks),
        "complete": len(records) == len(tasks),
        "skipped": skipped,
    }
    text = report(facts, records)
    (args.out / "accuracy.md").write_text(text)
    (args.out / "accuracy.json").write_text(json.dumps(facts | {"fits": records}, indent=1) + "\n")
    print(text)
    print(f"Written to {args.out / 'accuracy.md'} and accuracy.json.")


if __name__ == "__main__":
    run(main)
