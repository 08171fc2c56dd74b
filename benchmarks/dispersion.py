"""Measure the tests of docs/compare.md and docs/change.md in groups of unequal dispersion: level, power, and warnings.

`python benchmarks/dispersion.py` prints the tables in Markdown, `--only auto` the one of `--variances auto`. Shapes are
40 points of a curve whose displacements are smooth noise plus a share of independent noise, so that covariances have
the few large eigenvalues of real shapes.
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

import shapespace.statistics.compare_shapes as compare_module
from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table
from shapespace.statistics.compare_formula import Coding, design_of
from shapespace.statistics.compare_formula import Design as FormulaDesign
from shapespace.statistics.compare_shapes import CompareConfig, compare, term_tests, units_of
from shapespace.statistics.compare_within import strata_of
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
        rough: whether coordinates vary independently.
        scans: shapes of each subject, with as much noise as subjects vary.
    """

    name: str
    counts: tuple[int, ...]
    spread: tuple[float, ...]
    local: tuple[bool, ...] = ()
    effect: float = 0.0
    covariate: bool = False
    rough: bool = False
    scans: int = 1


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
AUTO = (
    *COMPARED,
    Design("10 v 40, smaller group SD × 1.1", (10, 40), (1.1, 1)),
    Design("10 v 40, smaller group SD × 1.2", (10, 40), (1.2, 1)),
    Design("5 v 25, smaller group SD × 1.2", (5, 25), (1.2, 1)),
    Design("20 v 60, same SD, other covariance", (20, 60), (1, 1), (True, False)),
    Design("8 v 24, smaller group SD × 1.2, with age", (8, 24), (1.2, 1), covariate=True),
    Design("10 v 40, smaller group SD × 2, independent", (10, 40), (2, 1), rough=True),
    Design("10 v 40, smaller group SD × 1.2, independent", (10, 40), (1.2, 1), rough=True),
    Design("12, 12, 12, SD × 3, 1, 1", (12, 12, 12), (3, 1, 1)),
    Design("6, 6, 6, 30, SD × 1.5, 1, 1, 1", (6, 6, 6, 30), (1.5, 1, 1, 1)),
    Design("5, 5, 25, 25, 25, SD × 2, 2, 1, 1, 1", (5, 5, 25, 25, 25), (2, 2, 1, 1, 1)),
    Design("10 v 30 subjects, 2 scans each, SD × 1.5", (10, 30), (1.5, 1), scans=2),
    Design("8 v 24 subjects, 3 scans each, SD × 1.2, with age", (8, 24), (1.2, 1), covariate=True, scans=3),
    Design("4 v 16, equal SD", (4, 16), (1, 1)),
    Design("3 v 15, smaller group SD × 3", (3, 15), (3, 1)),
    Design("5 v 25, equal SD, a difference", (5, 25), (1, 1), effect=1.5),
    Design("6 v 12, equal SD, a difference", (6, 12), (1, 1), effect=1.6),
    Design("15 v 30, equal SD, with age, a difference", (15, 30), (1, 1), effect=1.0, covariate=True),
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
        root = np.eye(POINTS * directions) if design.rough else factor(local=own, directions=directions)
        noise[codes == group] = spread * noise[codes == group] @ root.T
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
        options = CompareConfig(permutations=permutations, seed=study, variances="unequal" if unequal else "equal")
        found = compare(cohort, "~ group + age" if design.covariate else "~ group", options)
        maps = [effect.map for effect in found.effects if effect.name == "group" and effect.map is not None]
        # The family-wise error does not include the pairs of three groups, so only the first pair is counted.
        out += [found.test("group").p <= LEVEL, bool((maps[0].any_way.p_family <= LEVEL).any())]
    return np.array([*out, found.dispersions[0].p <= LEVEL], dtype=np.float64)


@cache
def formula_of(design: Design) -> FormulaDesign:
    """Return the columns of the formula, which are the same in all studies of a design."""
    _, codes, age = draw(design, np.random.default_rng(0))
    cells = {"group": [f"g{code}" for code in codes], "age": [f"{value:.6f}" for value in age]}
    names = tuple(f"s{k}" for k in range(len(codes) * design.scans))
    table = Table({name: tuple(np.repeat(values, design.scans).tolist()) for name, values in cells.items()}, names)
    return design_of("~ group + age" if design.covariate else "~ group", table)


def chosen(design: Design, study: int, permutations: int) -> FloatArray:
    """Return whether the term is significant with equal and unequal variances and by `auto`, and which that takes.

    The strata are tested without reading a formula, maps or pairs, so that a study takes milliseconds.
    """
    rng = np.random.default_rng([1, study])
    noise, codes, _ = draw(design, rng)
    formula, subjects = formula_of(design), None
    if design.scans > 1:
        noise = np.repeat(noise, design.scans, axis=0)
        noise = noise + rng.normal(size=noise.shape)
        subjects = [f"s{k}" for k in np.repeat(np.arange(len(codes)), design.scans)]
    stratum = strata_of(noise, formula, subjects, "subject", "II", None).every[0]
    units = units_of(stratum, formula, subjects)
    (spread,) = units.dispersions(POINTS, permutations, study)
    options = CompareConfig(permutations=permutations, seed=study, effect_size="log")
    test = next(one for one in term_tests(stratum, options, units=units) if one.term == "group")
    assert test.p_other is not None
    p = (test.p, test.p_other, test.p if spread.is_equality_plausible else test.p_other)
    return np.array([*(one <= LEVEL for one in p), not spread.is_equality_plausible], dtype=np.float64)


def changed(design: Design, study: int, permutations: int) -> FloatArray:
    """Return the same of the maps of changes of two groups."""
    rng = np.random.default_rng([2, study])
    maps, codes, _ = draw(design, rng, directions=1)
    out: list[bool] = []
    for unequal in (False, True):
        test = difference_test(maps, codes == 1, np.ones(POINTS), permutations, study, unequal_variances=unequal)
        out += [test.omnibus_p <= LEVEL, bool((test.p <= LEVEL).any())]
    full = np.eye(2)[codes] / np.sqrt(np.bincount(codes))
    spread = dispersion_test("group", maps, full, codes, ("g0", "g1"), POINTS, permutations, study)
    assert spread is not None
    return np.array([*out, spread.p <= LEVEL], dtype=np.float64)


_designs: dict[Any, FormulaDesign] = {}
_contrasts: dict[Any, FloatArray] = {}
_contrast = FormulaDesign.contrast


def _design_once(formula: str, cells: Any, coding: Coding = "deviation") -> FormulaDesign:
    key = (formula, coding, tuple(cells.columns["group"]))
    if key not in _designs:
        _designs[key] = design_of(formula, cells, coding)
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
    permutations: int, header: str = "permutation: whole | map | unequal variances: whole | map | dispersion unequal",
) -> None:  # fmt: skip
    """Print the table of one command."""
    print(f"\n{title}, {studies} studies of each design\n")
    print(f"| design | {header} |")
    print("|---" * (2 + header.count("|")) + "|")
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
    parser.add_argument("--only", choices=("auto",), help="print one table")
    given = parser.parse_args()
    table("compare --variances auto", AUTO, chosen, given.studies, given.permutations,
          "equal | unequal | auto | auto takes unequal")  # fmt: skip
    if given.only:
        return
    # Two thirds of the time of a small study are the formula, whose columns are the same in all studies of a design.
    with (
        patch.object(compare_module, "design_of", _design_once),
        patch.object(FormulaDesign, "contrast", _contrast_once),
    ):
        table("compare", COMPARED, compared, given.studies, given.permutations)
    table("change --group", CHANGED, changed, given.studies, given.permutations)


if __name__ == "__main__":
    main()
