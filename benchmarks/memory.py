"""The peak memory of a fit above its imports, each in a process of its own since peaks never fall.

    python benchmarks/memory.py             40,000 and 5 million triangles
    python benchmarks/memory.py --quick     40,000 only

Everything but the imports counts: model, scan, search structures, and the compiled code.
Targets: at most 300 MB for 40,000 triangles and 100 modes; at most 4 GB for 5 million triangles.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from accuracy import FIT_FIELDS, machine_facts
from cases import Bench, run

from shapespace.fit.method_choices import METHODS
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh

MB = 2**20
LARGE = 5_000_000
LIMIT_MB = {"40 thousand": 300, "5 million": 4096}


def peak_mb() -> float:
    """Return the peak resident memory of this process, MB."""
    status = Path("/proc/self/status")
    if status.is_file():  # ru_maxrss of a new process may still be its parent's
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / MB
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / MB if sys.platform == "darwin" else peak * 1024 / MB


def measure(method: str, dense: bool, model_path: Path, scan_path: Path, given: bool) -> None:
    """Fit in this process and print what it took."""
    import igl  # noqa: F401  # imported where used, and an import all the same

    import shapespace.compiled  # noqa: F401
    from shapespace.fit.fit_scan import FitConfig, fit_scan
    from shapespace.types import Similarity

    imports = peak_mb()
    with np.load(scan_path) as stored:
        scan = Mesh(stored["vertices"], stored["faces"], name="scan")
    model = ShapeModel.load(model_path)
    loaded = peak_mb()
    config = FitConfig(method=method, **({"dense": True} if dense else {}))
    ticks = time.process_time()
    result = fit_scan(model, scan, config, T_scan_model=Similarity.identity() if given else None)
    facts = {"imports": imports, "loaded": loaded - imports, "fit": peak_mb() - imports}
    print(json.dumps(facts | {"peak": peak_mb(), "cpu_s": time.process_time() - ticks, "status": result.status}))


def large_scan(scan: Mesh, triangles: int) -> Mesh:
    """Return the scan with its triangles split until there are `triangles` of them."""
    import igl

    vertices, faces = np.array(scan.vertices), np.array(scan.faces, dtype=np.int64)
    while len(faces) < triangles:
        vertices, faces = igl.upsample(vertices, faces, 1)
    return Mesh(vertices, faces[:triangles].astype(np.int32), name="large scan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--methods", help=f"some of {', '.join(METHODS)} and dense")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--measure", nargs=5, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.measure:
        method, dense, model, scan, given = args.measure
        measure(method, dense == "dense", Path(model), Path(scan), given == "start")
        return
    known = [*METHODS, *(["dense"] if "dense" in FIT_FIELDS else [])]
    methods = args.methods.split(",") if args.methods else known
    bench = Bench("test", args.cache)
    scan = bench.scan("complete", 0)
    facts = machine_facts()
    lines = [
        f"# Memory, {facts['date']}",
        "",
        f"{facts['machine']}; {bench.model('ict200').n_modes} modes, {bench.model('ict200').n_vertices:,} vertices.",
        "",
        "| method | triangles | start | imports, MB | model and scan | all above imports | peak | CPU s | status "
        "| at most, MB | |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    with tempfile.TemporaryDirectory() as folder:
        model_path = Path(folder) / "model.h5"
        bench.model("ict200").save(model_path)
        sizes = {"40 thousand": scan.mesh}
        if not args.quick:
            sizes["5 million"] = large_scan(scan.mesh, LARGE)
        for size, mesh in sizes.items():
            path = Path(folder) / "scan.npz"
            np.savez(path, vertices=mesh.vertices, faces=mesh.faces)
            for method in methods:
                for given in ("start", "none"):
                    command = [sys.executable, __file__, "--measure"]
                    command += ["robust", "dense"] if method == "dense" else [method, "plain"]
                    command += [str(model_path), str(path), given]
                    done = subprocess.run(command, capture_output=True, text=True)
                    if done.returncode:
                        reason = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "killed"
                        lines.append(
                            f"| {method} | {size} | {given} | | | | | | {reason} | {LIMIT_MB[size]} | **not met** |"
                        )
                        continue
                    m = json.loads(done.stdout.splitlines()[-1])
                    # For the large scan the limit is on the whole process.
                    judged = m["fit"] if size == "40 thousand" else m["peak"]
                    lines.append(
                        f"| {method} | {size} | {given} | {m['imports']:.0f} | {m['loaded']:.0f} | {m['fit']:.0f} | "
                        f"{m['peak']:.0f} | {m['cpu_s']:.2f} | {m['status']} | {LIMIT_MB[size]} | "
                        f"{'met' if judged <= LIMIT_MB[size] else '**not met**'} |"
                    )
    text = "\n".join(lines) + "\n"
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "memory.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run(main)
