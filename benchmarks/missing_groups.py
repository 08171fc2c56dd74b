"""Measure false positives of `shapespace compare` where the shapes of one group miss more vertices than the other's.

Shapes of one population, so that groups do not differ: an ellipsoid with six smooth modes and noise at each vertex, in
random poses and sizes. In some shapes of each group an end of the object is missing. Studies are compared by `~ group`.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.cohort.cohort import Cohort
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.types import BoolArray, FloatArray

VERTICES, MODES = 60, 6
NOISE_MM = 0.3
"""At each vertex; the modes move vertices by 1 to 3 mm."""
PERMUTATIONS = 199
LEVEL = 0.05


@dataclass(frozen=True)
class Design:
    """Sizes of the two groups, share of the shapes with a missing end, and share of the vertices there."""

    first: int
    second: int
    first_holed: float
    second_holed: float
    end: float = 0.2

    def __str__(self) -> str:
        holed = f"{100 * self.first_holed:.0f} % / {100 * self.second_holed:.0f} % of the shapes"
        return f"| {self.first} / {self.second} | {holed} | {100 * self.end:.0f} %"


DESIGNS = (
    Design(12, 12, 0.0, 0.0),
    Design(12, 12, 0.1, 0.8),
    Design(12, 12, 0.1, 0.8, 0.4),
    Design(12, 12, 0.0, 1.0),
    Design(8, 24, 0.1, 0.8),
    Design(8, 24, 0.0, 1.0),
)


class Population:
    """Where the shapes come from."""

    def __init__(self) -> None:
        i = np.arange(VERTICES)
        z = 1 - (2 * i + 1) / VERTICES
        angle = np.pi * (3 - np.sqrt(5)) * i
        ring = np.sqrt(1 - z**2)
        self.sphere: FloatArray = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
        self.faces = ConvexHull(self.sphere).simplices.astype(np.int32)
        rng = np.random.default_rng(11)
        centres = self.sphere[rng.choice(VERTICES, MODES, replace=False)]
        bumps = np.exp((self.sphere @ centres.T - 1) / 0.3)
        self.modes: FloatArray = np.linspace(3.0, 1.0, MODES)[:, None, None] * bumps.T[:, :, None] * self.sphere
        self.mean: FloatArray = self.sphere * np.array([30.0, 20.0, 15.0])

    def study(self, design: Design, rng: np.random.Generator) -> tuple[FloatArray, list[str]]:
        """Return shapes (N, V, 3) with not-a-number where missing, and their groups."""
        n = design.first + design.second
        shapes = self.mean + np.tensordot(rng.standard_normal((n, MODES)), self.modes, axes=1)
        shapes += NOISE_MM * rng.standard_normal(shapes.shape)
        groups = ["a"] * design.first + ["b"] * design.second
        there = self.there(design, rng)
        for k, turn in enumerate(Rotation.random(n, random_state=rng).as_matrix()):
            shapes[k] = np.exp(0.1 * rng.standard_normal()) * shapes[k] @ turn.T + 50.0 * rng.standard_normal(3)
        return np.where(there[:, :, None], shapes, np.nan), groups

    def there(self, design: Design, rng: np.random.Generator) -> BoolArray:
        """Return (N, V) bool, which vertices are observed: holed shapes lack one end, by a varying amount."""
        chance = np.repeat([design.first_holed, design.second_holed], [design.first, design.second])
        holed = rng.random(len(chance)) < chance
        share = design.end * rng.uniform(0.7, 1.3, len(chance))
        along = self.sphere[:, 0]
        cut = np.quantile(along, 1 - share)
        return ~(holed[:, None] & (along[None, :] > cut[:, None]))


def false_positives(design: Design, studies: int, seed: int) -> tuple[float, float, float]:
    """Return the share of studies with p at most 5 %: of the term, of any vertex; and the share of estimates."""
    population, found = Population(), np.zeros((studies, 3))
    options = CompareConfig(permutations=PERMUTATIONS + 1)
    for k in range(studies):
        rng = np.random.default_rng([seed, k])
        shapes, groups = population.study(design, rng)
        cohort = Cohort.of_shapes(shapes, {"group": groups}, faces=population.faces)
        result = compare(cohort, "~ group", options)
        shown = result.effects[0].map
        assert shown is not None
        found[k] = (
            result.tests[0].p <= LEVEL,
            bool((shown.test.p_family <= LEVEL).any()),
            float(cohort.estimated_share.mean()),
        )
    return tuple(found.mean(axis=0).tolist())


def main() -> None:
    """Print the table of docs/missing.md."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--studies", type=int, default=400, metavar="N", help="of each design (default 400)")
    words.add_argument("--seed", type=int, default=1, metavar="S")
    asked = words.parse_args()
    print(
        "| shapes | with a missing end | of the vertices | estimated | term | any vertex |\n|---|---|---|---|---|---|"
    )
    for design in DESIGNS:
        term, vertex, share = false_positives(design, asked.studies, asked.seed)
        print(f"{design} | {100 * share:.1f} % | {100 * term:.1f} % | {100 * vertex:.1f} % |", flush=True)


if __name__ == "__main__":
    main()
