"""Time each test of `shapespace test`, and the ordinations: 400 specimens, 500 landmarks in 3-D, 1,000 permutations.

The data are simulated: two groups at two sites, replicates of each specimen, a covariate, two modules and a tree.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.statistics.asymmetry import measure_asymmetry
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.shape_tests.ordination import ordinate
from shapespace.statistics.shape_tests.test_table import SHAPE_TESTS

SPECIMENS, LANDMARKS, PERMUTATIONS = 400, 500, 1000
DECAY = 0.98  # ratio of the variances of neighbouring components
NOISE = 1e-3  # standard deviation of independent noise of a coordinate; the size is about 40


def simulated_cohort(specimens: int, landmarks: int) -> Cohort:
    """Return shapes with correlated variation, in pairs of mirrored landmarks about x = 0."""
    rng = np.random.default_rng(0)
    half = rng.normal([2.0, 0.0, 0.0], 1.0, (landmarks // 2, 3))
    mean = np.concatenate([half, half * [-1.0, 1.0, 1.0]])
    count = min(specimens - 1, 100)
    axes = np.linalg.qr(rng.normal(size=(mean.size, count)))[0]
    scores = rng.normal(size=(specimens, count)) * DECAY ** np.arange(count)
    shapes = mean + (scores @ axes.T).reshape(specimens, -1, 3) + NOISE * rng.normal(size=(specimens, *mean.shape))
    cells: Mapping[str, list[Any]] = {
        "group": [f"g{k % 2}" for k in range(specimens)],
        "site": [f"s{k // 2 % 3}" for k in range(specimens)],
        "subject": [f"p{k // 2}" for k in range(specimens)],
        **{name: rng.normal(size=specimens).tolist() for name in ("x", "y", "z")},
    }
    return Cohort.of_shapes(shapes, cells, names=[f"t{k}" for k in range(specimens)])


def write_tree(path: Path, specimens: int) -> Path:
    """Write a random ultrametric tree of the specimens."""
    rng = np.random.default_rng(1)
    nodes = [(f"t{k}", 0.0) for k in range(specimens)]
    age = 0.0
    while len(nodes) > 1:
        age += float(rng.exponential(1.0 / len(nodes)))
        a, b = (nodes.pop(int(rng.integers(len(nodes)))) for _ in range(2))
        nodes.append((f"({a[0]}:{age - a[1]:.9f},{b[0]}:{age - b[1]:.9f})", age))
    path.write_text(f"{nodes[0][0]};\n")
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="name of one test")
    arguments = parser.parse_args()
    cohort = simulated_cohort(SPECIMENS, LANDMARKS)
    with tempfile.TemporaryDirectory() as folder:
        modules = Path(folder, "modules.csv")
        modules.write_text("vertex,module\n" + "".join(f"{v},m{v % 2}\n" for v in range(LANDMARKS)))
        tree = write_tree(Path(folder, "tree.nwk"), SPECIMENS)
        options: dict[str, dict[str, Any]] = {
            "pairwise": {"formula": "~ group * site", "group": ("group", "site")},
            "trajectory": {"group": ("group",), "points": "site"},
            "allometry": {"group": "group"},
            "repeatability": {},
            "pls": {"columns": ("x", "y", "z")},
            "integration": {"modules": modules},
            "modularity": {"modules": modules},
            "signal": {"tree": tree},
            "pgls": {"formula": "~ group * x", "tree": tree},
            "power": {"group": ("group",), "effect": "1.0"},
            "equivalence": {"group": ("group",), "margin_sd": 0.5},
        }
        for test in SHAPE_TESTS:
            if arguments.only in (None, test.name):
                function = resolve_name(f"shapespace.statistics.shape_tests.{test.function}")
                own = options.get(test.name, {"group": ("group",)})
                own |= {} if test.name == "power" else {"permutations": PERMUTATIONS}
                report(test.name, lambda function=function, own=own: function(cohort, **own))
        if arguments.only is None:
            config = CompareConfig(permutations=PERMUTATIONS)
            report("compare, with maps", lambda: compare(cohort, "~ group * site + x", config))
            report("asymmetry", lambda: measure_asymmetry(cohort, pairs=mirrored(), permutations=PERMUTATIONS))
            for method in ("pca", "between-groups", "cva"):
                report(f"morphospace {method}", lambda method=method: ordinate(cohort, method=method, group=("group",)))


def mirrored() -> list[tuple[int, int]]:
    return [(k, k + LANDMARKS // 2) for k in range(LANDMARKS // 2)]


def report(name: str, run: Any) -> None:
    start, cpu = time.perf_counter(), time.process_time()
    run()
    print(f"{name:24} {time.perf_counter() - start:6.2f} s, {time.process_time() - cpu:6.2f} s of CPU", flush=True)


if __name__ == "__main__":
    main()
