"""Measure the tests of docs/compare.md and docs/change.md in groups of unequal dispersion: level, power, and warnings.

`python benchmarks/dispersion.py` prints the tables in Markdown. Shapes are 40 points of a curve whose displacements are
smooth noise plus a share of independent noise, so that covariances have the few large eigenvalues of real shapes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.statistics import compare as compare_module
from shapespace.statistics.compare_formula import Design as FormulaDesign
from shapespace.statistics.compare_formula import design_of
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.dispersion import dispersion_test
from shapespace.statistics.map_tests import difference_test
from shapespace.types import FloatArray

POINTS = 40
SMOOTH = 0.1
"""Length of the correlation along the curve, as a share of it."""
ROUGH = 0.1
"""Variance of the independent noise of each coordinate, that of the smooth noise being 1."""
LEVEL = 0.05
ALONG = np.linspace(0.0, 1.0, POINTS)


@dataclass(frozen=True)
class Design:
    """A simulated study.

    Args:
        name: as the table names it.
        counts: subjects of each group.
        spread: standard deviation of each group.
        local: groups whose variation is concentrated on a third of the curve, so that covariances are not proportional.
        effect: difference of the second group's mean, at the middle of the curve.
        covariate: whether the model has a covariate, which is related to the group.
    """

    name: str
    counts: tuple[int, ...]
    spread: tuple[float, ...]
    local: tuple[bool, ...] = ()
    effect: float = 0.0
    covariate: bool = False


COMPARED = (
    Design("10 v 40, equal SD", (10, 40), (1, 1)),
    Design("10 v 40, smaller group SD × 1.5", (10, 40), (1.5, 1)),
    Design("10 v 40, smaller group SD × 2", (10, 40), (2, 1)),
    Design("10 v 40, larger group SD × 2", (10, 40), (1, 2)),
    Design("10 v 40, same SD, other covariance", (10, 40), (1, 1), (True, False)),
    Design("10 v 40, smaller group SD × 2, other covariance", (10, 40), (2, 1), (True, False)),
    Design("10 v 40, smaller group SD × 2, with age", (10, 40), (2, 1), covariate=True),
    Design("20 v 20, equal SD", (20, 20), (1, 1)),
    Design("20 v 20, SD × 2", (20, 20), (2, 1)),
    Design("6, 12, 40, SD × 3, 2, 1", (6, 12, 40), (3, 2, 1)),
    Design("5 v 15, smaller group SD × 3", (5, 15), (3, 1)),
    Design("4 v 16, smaller group SD × 3", (4, 16), (3, 1)),
    Design("20 v 20, equal SD, a difference", (20, 20), (1, 1), effect=0.8),
    Design("10 v 40, equal SD, a difference", (10, 40), (1, 1), effect=1.0),
    Design("5 v 15, equal SD, a difference", (5, 15), (1, 1), effect=1.6),
)
CHANGED = (
    Design("5 v 15, equal SD", (5, 15), (1, 1)),
    Design("5 v 15, smaller group SD × 3", (5, 15), (3, 1)),
    Design("5 v 15, larger group SD × 3", (5, 15), (1, 3)),
    Design("10 v 40, smaller group SD × 2", (10, 40), (2, 1)),
    Design("5 v 5, SD × 3", (5, 5), (3, 1)),
    Design("5 v 15, equal SD, a difference", (5, 15), (1, 1), effect=1.6),
)


@cache
def factor(*, local: bool, directions: int) -> FloatArray:
    """Return a root of the covariance of displacements of the points, in one or three directions."""
    smooth = np.exp(-0.5 * ((ALONG[:, None] - ALONG) / SMOOTH) ** 2)
    root: FloatArray = np.linalg.cholesky(np.kron(smooth + ROUGH * np.eye(POINTS), np.eye(directions)))
    if not local:
        return root
    weighted = root * np.repeat(np.where(ALONG < 0.3, 3.0, 0.3), directions)[:, None]
    return weighted * np.sqrt((root**2).sum() / (weighted**2).sum())


def draw(design: Design, rng: np.random.Generator, directions: int = 3) -> tuple[FloatArray, np.ndarray, FloatArray]:
    """Return displacements (N, 40 directions) of a study, the group of each subject, and its age."""
    codes = np.repeat(np.arange(len(design.counts)), design.counts)
    noise = rng.normal(size=(len(codes), POINTS * directions))
    local = design.local or (False,) * len(design.counts)
    for group, (spread, own) in enumerate(zip(design.spread, local, strict=True)):
        noise[codes == group] = spread * noise[codes == group] @ factor(local=own, directions=directions).T
    # The same in all studies, so that the design of the formula is.
    age = np.random.default_rng(0).normal(size=len(codes)) + (0.8 * codes if design.covariate else 0.0)
    bump = np.zeros((POINTS, directions))
    bump[:, -1] = np.exp(-0.5 * ((ALONG - 0.5) / 0.15) ** 2)
    noise += age[:, None] * (np.sin(2 * np.pi * np.repeat(ALONG, directions)) if design.covariate else 0.0)
    noise[codes == 1] += design.effect * bump.ravel()
    return noise, codes, age


def compared(design: Design, study: int, permutations: int) -> FloatArray:
    """Return whether a study has a significant term and vertex by permutation, by unequal variances, and dispersion."""
    rng = np.random.default_rng([1, study])
    noise, codes, age = draw(design, rng)
    curve = 100 * np.stack([ALONG, ALONG**2, 0 * ALONG], axis=1)
    table = {"group": [f"g{code}" for code in codes], "age": age.tolist()}
    cohort = Cohort.of_shapes(curve + noise.reshape(len(codes), POINTS, 3), table, align=False)
    out: list[bool] = []
    for unequal in (False, True):
        options = CompareConfig(permutations=permutations, seed=study, unequal_variances=unequal)
        found = compare(cohort, "~ group + age" if design.covariate else "~ group", options)
        maps = [effect.map for effect in found.effects if effect.name == "group" and effect.map is not None]
        # The family-wise error does not include the pairs of three groups, so only the first pair is counted.
        out += [found.test("group").p <= LEVEL, bool((maps[0].any_way.p_family <= LEVEL).any())]
    return np.array([*out, found.dispersions[0].p <= LEVEL], dtype=np.float64)


def changed(design: Design, study: int, permutations: int) -> FloatArray:
    """Return the same of the maps of changes of two groups."""
    rng = np.random.default_rng([2, study])
    maps, codes, _ = draw(design, rng, directions=1)
    out: list[bool] = []
    for unequal in (False, True):
        test = difference_test(maps, codes == 1, np.ones(POINTS), permutations, study, unequal_variances=unequal)
        out += [test.omnibus_p <= LEVEL, bool((test.p <= LEVEL).any())]
    residual = maps - np.stack([maps[codes == k].mean(axis=0) for k in (0, 1)])[codes]
    leverage = 1.0 / np.bincount(codes)[codes]
    spread = dispersion_test("group", residual, leverage, codes, ("g0", "g1"), POINTS, permutations, study)
    assert spread is not None
    return np.array([*out, spread.p <= LEVEL], dtype=np.float64)


_designs: dict[Any, FormulaDesign] = {}
_contrasts: dict[Any, FloatArray] = {}
_contrast = FormulaDesign.contrast


def _design_once(formula: str, cells: Any) -> FormulaDesign:
    key = (formula, tuple(cells.columns["group"]))
    if key not in _designs:
        _designs[key] = design_of(formula, cells)
    return _designs[key]


def _contrast_once(
    own: FormulaDesign, column: str, low: str | float, high: str | float, fixed: Mapping[str, str | float] | None = None
) -> FloatArray:
    key = (id(own), column, low, high)
    if key not in _contrasts:
        _contrasts[key] = _contrast(own, column, low, high, fixed)
    return _contrasts[key]


def table(
    title: str, designs: tuple[Design, ...], one: Callable[[Design, int, int], FloatArray], studies: int,
    permutations: int,
) -> None:  # fmt: skip
    """Print the table of one command."""
    print(f"\n{title}, {studies} studies of each design\n")
    print("| design | permutation: whole | map | unequal variances: whole | map | dispersion unequal |")
    print("|---|---|---|---|---|---|")
    for design in designs:
        began = time.perf_counter()
        share = np.mean([one(design, study, permutations) for study in range(studies)], axis=0)
        cells = " | ".join(f"{100 * value:.1f} %" for value in share)
        print(f"| {design.name} | {cells} |", flush=True)
        print(f"<!-- {time.perf_counter() - began:.0f} s -->", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--studies", type=int, default=1000)
    parser.add_argument("--permutations", type=int, default=200)
    given = parser.parse_args()
    # Two thirds of the time of a small study are the formula, whose columns are the same in all studies of a design.
    with (
        patch.object(compare_module, "design_of", _design_once),
        patch.object(FormulaDesign, "contrast", _contrast_once),
    ):
        table("compare", COMPARED, compared, given.studies, given.permutations)
    table("change --group", CHANGED, changed, given.studies, given.permutations)


if __name__ == "__main__":
    main()
