"""PCA of many large shapes beside the one matrix product that it cannot do without, and beside its peers.

    python benchmarks/pca.py            1,000 shapes of 26,719 vertices, 50 modes
    python benchmarks/pca.py --quick    200 shapes of 5,000 vertices

Targets: at most 1.3 times one BLAS syrk of that size, at most 0.1 GiB above the data, exact.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from scipy.linalg import blas

from shapespace.model.pca import principal_components

GIB = 2**30
MODES = 50


def shapes(n: int, vertices: int) -> np.ndarray:
    """Return (n, 3 * vertices): 60 true modes of falling variance about a mean off the origin, and noise."""
    rng = np.random.default_rng(0)
    d = 3 * vertices
    modes = rng.standard_normal((60, d)) * np.geomspace(3.0, 0.05, 60)[:, None]
    mean = 80.0 * rng.standard_normal(d)
    out = np.empty((n, d))
    for row in out:
        row[:] = rng.standard_normal(d)
        row *= 0.2
        row += rng.standard_normal(60) @ modes
        row += mean
    return out


def syrk(data: np.ndarray) -> None:
    blas.dsyrk(1.0, data.T, trans=1, lower=1)


def ours(data: np.ndarray) -> None:
    principal_components(data, MODES)


def scikit_learn(data: np.ndarray) -> None:
    from sklearn.decomposition import PCA

    PCA(MODES, svd_solver="randomized", random_state=0).fit(data)


def contenders() -> dict[str, Callable[[np.ndarray], None]]:
    found: dict[str, Callable[[np.ndarray], None]] = {"one BLAS syrk": syrk, "shapespace": ours}
    if importlib.util.find_spec("sklearn"):
        found["scikit-learn, randomized"] = scikit_learn
    return found


def peak_above_data(name: str, n: int, vertices: int) -> float:
    """Return GiB of peak memory above the data, in a process of its own since peaks never fall."""
    command = [sys.executable, __file__, "--memory-of", name, "--shapes", str(n), "--vertices", str(vertices)]
    return float(json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout))


def memory_of(name: str, n: int, vertices: int) -> None:
    rng = np.random.default_rng(0)
    data = np.empty((n, 3 * vertices))
    for row in data:  # row by row, so that making the data leaves no peak of its own
        row[:] = rng.standard_normal(3 * vertices)
    run = contenders()[name]
    run(data[:60, :300].copy())  # imports and thread buffers are not the algorithm's
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    run(data)
    print(json.dumps((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 / GIB))


def exactness(n: int = 150, vertices: int = 2000) -> dict[str, float]:
    """Return the largest relative errors against the thin SVD of the centred shapes, on a case small enough for it."""
    data = shapes(n, vertices)
    pc = principal_components(data, MODES)
    _, s, Vt = np.linalg.svd(data - data.mean(axis=0), full_matrices=False)
    variance = s[:MODES] ** 2 / (n - 1)
    cosines = np.linalg.svd(Vt[:MODES] @ pc.basis, compute_uv=False)
    return {
        "variance, relative": float(np.abs(pc.variance / variance - 1).max()),
        "subspace, 1 - cosine": float(np.abs(1 - cosines).max()),
        "orthonormality": float(np.abs(pc.basis.T @ pc.basis - np.eye(MODES)).max()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shapes", type=int, default=1000)
    parser.add_argument("--vertices", type=int, default=26719)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--memory-of", help=argparse.SUPPRESS)
    args = parser.parse_args()
    n, vertices = (200, 5000) if args.quick else (args.shapes, args.vertices)
    if args.memory_of:
        memory_of(args.memory_of, n, vertices)
        return
    memory = {name: peak_above_data(name, n, vertices) for name in contenders()}
    data = shapes(n, vertices)
    seconds: dict[str, list[float]] = {name: [] for name in contenders()}
    for _ in range(args.repeats):
        for name, run in contenders().items():  # interleaved, so that a busy moment hits all
            began = time.perf_counter()
            run(data)
            seconds[name].append(time.perf_counter() - began)
    base = seconds["one BLAS syrk"]
    print(f"{n} shapes of {vertices} vertices ({data.nbytes / GIB:.2f} GiB), {MODES} modes, {args.repeats} repeats\n")
    print(f"{'':26}{'min s':>8}{'median s':>10}{'x syrk (min)':>14}{'x syrk (median)':>17}{'GiB above data':>16}")
    for name, times in seconds.items():
        print(
            f"{name:26}{min(times):8.2f}{np.median(times):10.2f}{min(times) / min(base):14.2f}"
            f"{np.median(np.array(times) / np.array(base)):17.2f}{memory[name]:16.3f}"
        )
    print("\nlargest error against the SVD (150 shapes of 2,000 vertices)")
    for name, error in exactness().items():
        print(f"{name:26}{error:8.1e}")


if __name__ == "__main__":
    main()
