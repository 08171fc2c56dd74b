"""PCA of more shapes than memory holds: time, memory and residuals, from a file of single precision on the disk.

    python benchmarks/pca_scale.py --folder DISK              100,000 shapes of 9,409 vertices: 11.3 GB there
    python benchmarks/pca_scale.py --folder DISK --exact      10,000 shapes, by their Gram matrix: 1.1 GB
    python benchmarks/pca_scale.py --folder DISK --align      the passes of Procrustes too
    python benchmarks/pca_scale.py --folder DISK --quick      2,000 shapes of 1,000 vertices

The shapes are 300 modes whose variance falls as k^-1.5, 2 mm a coordinate, and noise of 0.1 mm.
Targets, two cores: 100,000 in 15 minutes and 2 GiB with residuals of at most 1e-6 of the first eigenvalue; 10,000 exact
in at most 1.5 times the one matrix product that it cannot do without.
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

from shapespace.geometry.procrustes import Streamed, align_streamed, scale_to_tangent_streamed
from shapespace.io.containers.row_spill import Spill
from shapespace.model import pca
from shapespace.model.pca import principal_components, syrk

TRUE_MODES, SPREAD_MM, NOISE_MM, SIZE_MM = 300, 2.0, 0.1, 80.0


def write_shapes(path: Path, n: int, vertices: int) -> None:
    """Write n shapes as differences from their template, as a streamed build does."""
    rng = np.random.default_rng(0)
    d = 3 * vertices
    modes = np.linalg.qr(rng.standard_normal((d, min(TRUE_MODES, d))))[0].T.astype(np.float32)
    variance = np.arange(1, len(modes) + 1) ** -1.5
    stddev = (SPREAD_MM * np.sqrt(d * variance / variance.sum())).astype(np.float32)
    with Spill(path, n, d, new=True) as shapes:
        for start in range(0, n, shapes.block_rows):
            count = min(shapes.block_rows, n - start)
            block = rng.standard_normal((count, d), dtype=np.float32)
            block *= np.float32(NOISE_MM)
            block += (rng.standard_normal((count, len(modes)), dtype=np.float32) * stddev) @ modes
            shapes.write_rows(start, block)
        shapes.to_disk()


def align(path: Path, n: int, vertices: int) -> dict[str, float]:
    """Return what the passes of Procrustes take, the rewriting of the file apart."""
    template = SIZE_MM * np.random.default_rng(1).standard_normal((vertices, 3))
    with Spill(path, n, 3 * vertices, new=False) as shapes:
        began, ticks = time.perf_counter(), time.process_time()
        sizes = np.empty(n)
        for start, block in shapes.row_blocks():
            whole = block.reshape(len(block), -1, 3) + template
            whole -= whole.mean(axis=1, keepdims=True)
            sizes[start : start + len(block)] = np.sqrt((whole**2).sum(axis=(1, 2)))
        source = Streamed(shapes.row_blocks, n, template, sizes)
        found, poses = align_streamed(source, "shape", size=float(sizes.mean()), reference=template)
        scale_to_tangent_streamed(source, found.mean, poses)
        return {
            "rounds": found.iterations,
            "align wall s": time.perf_counter() - began,
            "align CPU s": time.process_time() - ticks,
        }


def measure(path: Path, n: int, vertices: int, modes: int) -> dict[str, float]:
    """Return time, peak memory and residuals of the PCA of the file, in this process."""
    passes = 0

    def on_pass(number: int, share: float) -> None:
        nonlocal passes
        passes = number + 1  # the last one finds the residuals
        print(f"pass {number}: largest residual {share:.1e} of the first eigenvalue", file=sys.stderr, flush=True)

    in_product = 0.0

    def timed(block: np.ndarray, onto: np.ndarray | None = None) -> np.ndarray:
        nonlocal in_product
        ticks = time.process_time()
        out = syrk(block, onto)
        in_product += time.process_time() - ticks
        return out

    # In one run with all the rest, so that a busy machine slows both.
    pca.syrk = timed
    with Spill(path, n, 3 * vertices, new=False) as shapes:
        began, ticks = time.perf_counter(), time.process_time()
        pc = principal_components(shapes, modes, on_pass=on_pass)
        found = {"wall s": time.perf_counter() - began, "CPU s": time.process_time() - ticks}
    assert pc.residuals is not None
    if in_product:
        found |= {"Gram product, CPU s": in_product, "x Gram product": found["CPU s"] / in_product}
    return {
        **found,
        "peak GiB": peak_gib(),
        "largest residual share": float(pc.residuals.max() / pc.variance[0]),
        "last variance share": float(pc.variance[-1] / pc.variance[0]),
        "passes": passes,
    }


def peak_gib() -> float:
    """Return the peak resident memory of this process."""
    status = Path("/proc/self/status")
    if status.is_file():  # ru_maxrss of a new process may still be its parent's
        line = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", type=int)
    parser.add_argument("--vertices", type=int, default=9409)
    parser.add_argument("--modes", type=int, default=200)
    parser.add_argument("--folder", type=Path, help="on the disk to be used")
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--align", action="store_true")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    n = args.shapes or (10_000 if args.exact else 100_000)
    vertices = args.vertices
    if args.quick:
        n, vertices = 2000, 1000
    if args.measure:
        what, path = args.measure
        done = align(Path(path), n, vertices) if what == "align" else measure(Path(path), n, vertices, args.modes)
        print(json.dumps(done))
        return
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        path = Path(folder) / "shapes.f32"
        began = time.perf_counter()
        write_shapes(path, n, vertices)
        print(f"{n} shapes of {vertices} vertices, {path.stat().st_size / 1e9:.2f} GB, {args.modes} modes")
        print(f"written in {time.perf_counter() - began:.0f} s (not counted)")
        for what in ("pca", "align") if args.align else ("pca",):
            command = [sys.executable, __file__, "--measure", what, str(path), "--shapes", str(n)]
            command += ["--vertices", str(vertices), "--modes", str(args.modes)]
            for name, value in json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout).items():
                print(f"{name:24}{value:12.4g}")


if __name__ == "__main__":
    main()
