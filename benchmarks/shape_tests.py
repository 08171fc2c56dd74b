"""Time each test of `shapespace test`, and the ordinations: 400 specimens, 500 landmarks in 3-D, 1,000 permutations.

The data are simulated: two groups at two sites, replicates of each specimen, a covariate, two modules and a tree.
`--angles STUDIES` prints the false positives of the angles of trajectories and slopes instead, in studies whose groups
have the same change, of 0 to 4 standard errors, and in how many studies p is known.
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
from shapespace.statistics.shape_tests.linear import compare_pairs, compare_trajectories
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


LENGTHS = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Length of the common change, in standard errors of its estimate."""


def simulate_angle(design: str, length: float, smooth: bool, seed: int) -> float | None:
    """Return p of the angle between the same change of two groups, with 12 landmarks; None where it is not known.

    Args:
        design: `cells` of 6 shapes of 2 groups at 2 times, or `slopes` of 20 shapes of each group on a covariate whose
            standard deviation is 1 and 0.3.
        length: of the change, in standard errors.
        smooth: whether neighbouring landmarks vary together.
        seed: of the study.
    """
    rng = np.random.default_rng([3, seed])
    group, count = np.repeat([0, 1], 12 if design == "cells" else 20), 24 if design == "cells" else 40
    x = np.tile(np.repeat([0.0, 1.0], 6), 2) if design == "cells" else rng.normal(size=40) * (1.0 - 0.7 * group)
    along = np.linspace(0.0, 1.0, 12)
    covariance = np.exp(-0.5 * ((along[:, None] - along) / 0.15) ** 2) + 0.1 * np.eye(12) if smooth else np.eye(12)
    noise = np.einsum("lm,nmd->nld", np.linalg.cholesky(covariance), rng.normal(size=(count, 12, 3)))
    within = x - np.array([x[group == k].mean() for k in (0, 1)])[group]
    error = np.sqrt(3.0 * np.trace(covariance) / (within**2).sum())
    change = rng.normal(size=(12, 3))
    shapes = noise + x[:, None, None] * change * (length * error / np.linalg.norm(change))
    table = {"group": [f"g{k}" for k in group], "x": [f"t{v:.0f}" for v in x] if design == "cells" else x.tolist()}
    cohort = Cohort.of_shapes(shapes, table, align=False)
    if design == "cells":
        found = compare_trajectories(cohort, group=("group",), points="x", permutations=200, seed=seed)
    else:
        found = compare_pairs(
            cohort, formula="~ group * x", group=("group",), covariate="x", permutations=200, seed=seed
        )
    return found.statistic("angle, degrees").p


def report_angles(studies: int) -> None:
    """Print the share of studies with p of at most 5 % among those with p, and the share of these where it is not 1."""
    print(f"| design, {studies} studies each | {' | '.join(f'{one:g}' for one in LENGTHS)} |")
    print("|---" * (1 + len(LENGTHS)) + "|")
    for design, smooth in (("cells", False), ("cells", True), ("slopes", False), ("slopes", True)):
        cells: list[str] = []
        for length in LENGTHS:
            known = [p for seed in range(studies) if (p := simulate_angle(design, length, smooth, seed)) is not None]
            share = "" if len(known) == studies else f" of {100 * len(known) / studies:.0f} %"
            cells.append(f"{100 * (np.array(known) <= 0.05).mean():.1f} %{share}")
        print(f"| {design}, {'smooth' if smooth else 'independent'} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="name of one test")
    parser.add_argument("--angles", type=int, metavar="STUDIES", help="print false positives of angles")
    arguments = parser.parse_args()
    if arguments.angles:
        report_angles(arguments.angles)
        return
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
