"""Measure false positives of `shapespace compare` where the shapes of one group miss more vertices than the other's.

Shapes of one population, so that groups do not differ: an ellipsoid with six smooth modes and noise at each vertex, in
random poses and sizes. In some shapes of each group an end of the object is missing. Studies are compared by `~ group`.

With `--samples` the missing ends are completed instead, in given poses, with samples of their conditional normal
distribution in the whole population, and imputations are combined. `FREE_MM` moves the end independently of the rest.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.cohort.cohort import Cohort
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.multiple_imputation import pool_p_values
from shapespace.types import BoolArray, FloatArray

VERTICES, MODES = 60, 6
NOISE_MM = 0.3
"""At each vertex; the modes move vertices by 1 to 3 mm."""
PERMUTATIONS = 199
IMPUTATIONS = 20
FREE_MM = 6.0
"""Standard deviation of the movement of the missing end that nothing else shows."""
NARROW = 0.3
"""Standard deviation of samples that are too similar, as a share of the right one."""
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


@dataclass(frozen=True)
class CompletedDesign:
    """A design with completed ends: how far they move freely, and the difference of the second group."""

    holes: Design
    free_mm: float = 0.0
    shift: float = 0.0

    def __str__(self) -> str:
        return f"{self.holes} | {self.free_mm:g} mm | {self.shift:g} SD"


COMPLETED_DESIGNS = (
    CompletedDesign(Design(12, 12, 0.1, 0.8, 0.4)),
    CompletedDesign(Design(12, 12, 0.5, 0.5), FREE_MM),
    CompletedDesign(Design(12, 12, 0.1, 0.8), FREE_MM),
    CompletedDesign(Design(12, 12, 0.0, 1.0), FREE_MM),
    CompletedDesign(Design(12, 12, 0.1, 0.8), 3 * FREE_MM),
    CompletedDesign(Design(8, 24, 0.0, 1.0), FREE_MM),
    CompletedDesign(Design(8, 24, 0.0, 1.0), 3 * FREE_MM),
    CompletedDesign(Design(12, 12, 0.1, 0.8, 0.4), shift=0.4),
    CompletedDesign(Design(12, 12, 0.1, 0.8), FREE_MM, shift=0.4),
)
METHODS = ("complete", "mean", "one sample", "narrow", "imputed")


def completed_study(design: CompletedDesign, population: Population, rng: np.random.Generator) -> FloatArray:
    """Return p of complete shapes, of conditional means, of one sample, of narrow samples, of samples; and FMI."""
    n, V = design.holes.first + design.holes.second, VERTICES
    free = design.free_mm * np.exp((population.sphere[:, :1] - 1) / 0.05) * population.sphere
    modes = np.concatenate([population.modes, free[None]]).reshape(MODES + 1, -1)
    y = rng.standard_normal((n, MODES + 1))
    y[design.holes.first :] += design.shift
    whole = (population.mean.ravel() + y @ modes + NOISE_MM * rng.standard_normal((n, 3 * V))).reshape(n, V, 3)
    observed, means = population.there(design.holes, rng), whole.copy()
    samples: dict[str, list[FloatArray | None]] = {"narrow": [None] * n, "imputed": [None] * n}
    for k in np.flatnonzero(~observed.all(axis=1)).tolist():
        part = np.repeat(observed[k], 3)
        seen, unseen = modes[:, part].T, modes[:, ~part].T
        covariance = np.linalg.inv(np.eye(MODES + 1) + seen.T @ seen / NOISE_MM**2)
        residual = (whole[k] - population.mean).ravel()[part]
        centre = population.mean.ravel()[~part] + unseen @ (covariance @ (seen.T @ residual)) / NOISE_MM**2
        means[k].reshape(-1)[~part] = centre
        off = rng.standard_normal((IMPUTATIONS, MODES + 1)) @ np.linalg.cholesky(covariance).T @ unseen.T
        off += NOISE_MM * rng.standard_normal(off.shape)
        for name, spread in (("narrow", NARROW), ("imputed", 1.0)):
            drawn = np.repeat(whole[k].reshape(1, -1), IMPUTATIONS, axis=0)
            drawn[:, ~part] = centre + spread * off
            samples[name][k] = drawn.reshape(-1, V, 3)
    group = np.repeat([-1.0, 1.0], [design.holes.first, design.holes.second])
    orders = np.stack([np.arange(n), *(rng.permutation(n) for _ in range(PERMUTATIONS))])
    p_of_mean, p_of_whole = p_value(means, group[orders]), p_value(whole, group[orders])
    p: dict[str, FloatArray] = {}
    for name, own in samples.items():
        drawn = np.stack(
            [np.repeat(x[None], IMPUTATIONS, axis=0) if s is None else s for x, s in zip(means, own, strict=True)]
        )
        p[name] = np.array([p_value(drawn[:, k], group[orders]) for k in range(IMPUTATIONS)])
    pooled = {name: pool_p_values(own, 1 / (1 + PERMUTATIONS)) for name, own in p.items()}
    narrow, (imputed, missing) = pooled["narrow"][0], pooled["imputed"]
    return np.array([p_of_whole, p_of_mean, p["imputed"][0], narrow, imputed, missing])


def p_value(shapes: FloatArray, groups: FloatArray) -> float:
    """Return p of shapes (N, V, 3) as of `compare`, of groups (P, N) in each arrangement, the observed one first."""
    centred = shapes.reshape(len(shapes), -1) - shapes.reshape(len(shapes), -1).mean(axis=0)
    contrast = groups - groups.mean(axis=1, keepdims=True)
    squares = ((contrast @ (centred @ centred.T)) * contrast).sum(axis=1)
    return float((squares >= squares[0] * (1 - 1e-9)).mean())


def print_completed(studies: int, seed: int, designs: Sequence[int]) -> None:
    """Print the table of completed shapes."""
    print("| shapes | with a missing end | of the vertices | free end | difference |", end="")
    print(f" {' | '.join(METHODS)} | missing information |\n{'|---' * (6 + len(METHODS))}|")
    population = Population()
    for number in designs:
        design = COMPLETED_DESIGNS[number]
        found = np.stack(
            [completed_study(design, population, np.random.default_rng([seed, number, k])) for k in range(studies)]
        )
        shares = [f"{100 * share:.1f} %" for share in (found[:, :-1] <= LEVEL).mean(axis=0)]
        print(f"{design} | {' | '.join(shares)} | {100 * found[:, -1].mean():.0f} % |", flush=True)


def main() -> None:
    """Print the tables of docs/missing.md."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--studies", type=int, default=400, metavar="N", help="of each design (default 400)")
    words.add_argument("--seed", type=int, default=1, metavar="S")
    words.add_argument("--samples", action="store_true", help="completed shapes with samples")
    every = range(len(COMPLETED_DESIGNS))
    words.add_argument("--designs", type=int, nargs="*", default=every, metavar="K", help="of --samples (default all)")
    asked = words.parse_args()
    if asked.samples:
        print_completed(asked.studies, asked.seed, asked.designs)
        return
    print(
        "| shapes | with a missing end | of the vertices | estimated | term | any vertex |\n|---|---|---|---|---|---|"
    )
    for design in DESIGNS:
        term, vertex, share = false_positives(design, asked.studies, asked.seed)
        print(f"{design} | {100 * share:.1f} % | {100 * term:.1f} % | {100 * vertex:.1f} % |", flush=True)


if __name__ == "__main__":
    main()
