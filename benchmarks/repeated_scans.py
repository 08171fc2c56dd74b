"""Measure false positives of `shapespace compare --blocks` where subjects are scanned several times.

Shapes are points about a rigid configuration, with differences between subjects, with a response to the conditions that
each subject has of its own and that is zero on average, and with noise. The tests are those of `compare` at 5 %, with
200 arrangements; `align` brings the shapes of each study to each other by generalised Procrustes first.

    python benchmarks/repeated_scans.py --studies 1000
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table
from shapespace.statistics.compare_formula import Design, design_of
from shapespace.statistics.compare_shapes import CompareConfig, TermTest, compare, term_tests
from shapespace.statistics.compare_within import strata_of
from shapespace.types import FloatArray

POINTS, RADIUS_MM = 24, 40.0
IDENTITY_MM, NOISE_MM = 2.0, 1.0
"""Standard deviations of each coordinate: between subjects, and between scans of a subject in one condition."""
ARRANGEMENTS, LEVEL = 200, 0.05
EXPRESSION_MM = 6.0
"""Mean effect of expressions, in designs that do not test it."""


@dataclass(frozen=True)
class Row:
    """A design, and its tested terms.

    Args:
        name: as it is printed.
        formula: of `compare`.
        terms: whose false positives are counted; their true effect is zero.
        table: returns the columns of the table from a random generator; `subject`, and those that the formula names.
        own: standard deviation in mm of each coordinate of what a subject changes beyond the mean of all, from one
            class to another, or in four units of a number.
        response: columns of the table to which subjects respond.
        mean_mm: mean effect, in each coordinate, of the first class of the first of these against the others.
        random: as of `compare`.
    """

    name: str
    formula: str
    terms: tuple[str, ...]
    table: Callable[[np.random.Generator], dict[str, tuple[str, ...]]]
    own: float
    response: tuple[str, ...]
    mean_mm: float = 0.0
    random: str | None = None


def factorial(
    _: np.random.Generator, subjects: int, scans: int, conditions: dict[str, int], numbers: tuple[str, ...] = ()
) -> dict[str, tuple[str, ...]]:
    """Return a table of subjects of two sexes, each with some scans in all conditions."""
    shape = (subjects, *conditions.values(), scans)
    at = np.indices(shape).reshape(len(shape), -1)
    out = {"subject": named("s", at[0]), "sex": named("sex ", at[0] % 2)}
    for place, name in enumerate(conditions, 1):
        out[name] = named("" if name in numbers else "c", at[place])
    return out


def named(prefix: str, values: Iterable[object]) -> tuple[str, ...]:
    """Return numbers as cells of a table."""
    return tuple(f"{prefix}{value}" for value in values)


def irregular(rng: np.random.Generator, subjects: int) -> dict[str, tuple[str, ...]]:
    """Return a table of 2 to 8 visits of each subject, at any time within six years."""
    visits = rng.integers(2, 9, subjects)
    who = np.repeat(np.arange(subjects), visits)
    return {
        "subject": named("s", who),
        "sex": named("sex ", who % 2),
        "time": named("", np.round(rng.uniform(0.0, 6.0, len(who)), 3)),
    }


def with_missing_cells(rng: np.random.Generator, subjects: int, share: float) -> dict[str, tuple[str, ...]]:
    """Return a table of four expressions, of which a share is missing, each with one to three scans."""
    whole = factorial(rng, subjects, 3, {"expression": 4})
    cells = rng.uniform(size=(subjects * 4, 1)) >= share
    kept = (cells & (np.arange(3) <= rng.integers(0, 3, (subjects * 4, 1)))).ravel()
    return {name: tuple(cell for cell, one in zip(values, kept, strict=True) if one) for name, values in whole.items()}


def confounded(_: np.random.Generator, subjects: int, both: int) -> dict[str, tuple[str, ...]]:
    """Return a table of two sexes, one neutral and the other smiling, of which a few subjects show both."""
    who, smile = list[int](), list[int]()
    for one in range(subjects):
        shown = (0, 1) if one < both else (one % 2,)
        who += [one] * len(shown)
        smile += shown
    return {
        "subject": named("s", who),
        "sex": named("sex ", [one % 2 for one in who]),
        "expression": named("c", smile),
    }


def rows() -> Iterator[Row]:
    """Yield the designs of the table."""
    visit = ("visit",)
    for scans, own in ((1, 1.0), (2, 0.5), (2, 1.0), (3, 1.0)):
        table = partial(factorial, subjects=20, scans=scans, conditions={"visit": 2})
        yield Row(f"pre/post, {scans} scans each, own change {own:g}", "~ visit", visit, table, own, visit)
    table = partial(factorial, subjects=20, scans=3, conditions={"visit": 2})
    yield Row("group x visit, 3 scans each", "~ sex * visit", ("sex", "visit", "sex:visit"), table, 1.0, visit)
    table = partial(factorial, subjects=16, scans=1, conditions={"expression": 6, "intensity": 4})
    both = ("expression", "intensity")
    yield Row("6 expressions x 4 intensities", "~ sex * expression", ("sex", "sex:expression"), table, 1.0, both, 3.0)
    table = partial(factorial, subjects=16, scans=1, conditions={"expression": 3, "intensity": 3})
    terms = ("sex:expression", "intensity", "sex:intensity", "sex:expression:intensity")
    yield Row("3 x 3, intensity in the model", "~ sex * expression * intensity", terms, table, 1.0, both, 3.0)
    times = ("time", "sex:time")
    table = partial(factorial, subjects=20, scans=1, conditions={"time": 5}, numbers=("time",))
    yield Row("5 visits, own growth", "~ sex * time", ("sex", *times), table, 1.0, ("time",))
    for name, own, random in (
        ("the same, `time` random", 1.0, "1 + time | subject"),
        ("the same, growth alike, no random `time`", 0.0, "1 | subject"),
    ):
        yield Row(name, "~ sex * time", times, table, own, ("time",), random=random)
    yield Row("2 to 8 visits at any time, own growth", "~ sex * time", ("sex", *times), partial(irregular, subjects=24), 1.0, ("time",))  # noqa: E501  # fmt: skip
    yield Row("2 to 8 visits at any time, growth alike", "~ sex * time", times, partial(irregular, subjects=24), 0.0, ("time",))  # noqa: E501  # fmt: skip
    table = partial(with_missing_cells, subjects=30, share=0.15)
    terms = ("sex", "expression", "sex:expression")
    yield Row("4 expressions, 15 % of cells missing", "~ sex * expression", terms, table, 1.0, ("expression",))
    for count in (2, 6, 12):
        table = partial(confounded, subjects=40, both=count)
        yield Row(f"sexes differ in expression, {count} of 40 show both", "~ sex + expression", ("sex",), table, 1.0, ("expression",), EXPRESSION_MM)  # noqa: E501  # fmt: skip


def simulated(row: Row, table: dict[str, tuple[str, ...]], rng: np.random.Generator) -> FloatArray:
    """Return the (N, V, 3) shapes of a table, mm."""
    base = np.random.default_rng(5).normal(size=(POINTS, 3))
    base *= RADIUS_MM / np.linalg.norm(base, axis=1)[:, None]
    who = np.unique(table["subject"], return_inverse=True)[1]
    count = int(who.max()) + 1
    shapes: FloatArray = base + (rng.normal(size=(count, POINTS, 3)) * IDENTITY_MM)[who]
    for name in row.response:
        levels, at = np.unique(table[name], return_inverse=True)
        if name == "time":
            values = np.array(table[name], dtype=np.float64)[:, None, None] / 4.0
            shapes += values * (rng.normal(size=(count, POINTS, 3)) * row.own)[who]
        else:
            own = rng.normal(size=(count, len(levels), POINTS, 3)) * row.own / np.sqrt(2.0)
            shapes += own[who, at]
    if row.mean_mm:
        first = np.array(table[row.response[0]]) == min(table[row.response[0]])
        shapes[first] += row.mean_mm * np.random.default_rng(6).normal(size=(POINTS, 3))
    return shapes + rng.normal(size=shapes.shape) * NOISE_MM


def aligned(shapes: FloatArray) -> FloatArray:
    """Return shapes as `Cohort.of_shapes` aligns them, all at once; up to a rotation of all."""
    x = shapes - shapes.mean(axis=1, keepdims=True)
    x /= np.linalg.norm(x, axis=(1, 2))[:, None, None]
    mean = x[0]
    for _ in range(20):
        u, _s, vt = np.linalg.svd(np.einsum("nvi,vj->nij", x, mean))
        u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
        x = x @ (u @ vt)
        last, mean = mean, x.mean(axis=0)
        mean = mean / np.linalg.norm(mean)
        if np.linalg.norm(mean - last) < 1e-7:
            break
    along = np.einsum("nvi,vi->n", x, mean)
    size = float(np.linalg.norm(shapes - shapes.mean(axis=1, keepdims=True), axis=(1, 2)).mean())
    return size * x / along[:, None, None]


def check() -> None:
    """Check that the fast path of this program computes what `compare` does."""
    for row in list(rows())[4::6]:
        rng = np.random.default_rng(0)
        table = row.table(rng)
        shapes = simulated(row, table, rng)
        cohort = Cohort.of_shapes(shapes, table)
        options = CompareConfig(blocks="subject", random=row.random, permutations=ARRANGEMENTS, maps=False)
        expected = [test.p for test in compare(cohort, row.formula, options).tests]
        found = [test.p for test in tests_of(row, aligned(shapes), design_of_table(row.formula, table), table, 0)]
        if np.abs(np.array(expected) - found).max() > 1.5 / ARRANGEMENTS:
            raise SystemExit(f"{row.name}: the tests differ from those of compare: {found} and {expected}.")


@lru_cache(maxsize=8)
def _design(formula: str, columns: tuple[tuple[str, tuple[str, ...]], ...]) -> Design:
    count = len(columns[0][1])
    return design_of(formula, Table(dict(columns), tuple(f"scan {k}" for k in range(count))))


def design_of_table(formula: str, table: dict[str, tuple[str, ...]]) -> Design:
    """Return the design of a formula, the same object for the same table."""
    return _design(formula, tuple(table.items()))


def tests_of(
    row: Row, shapes: FloatArray, design: Design, table: dict[str, tuple[str, ...]], seed: int
) -> list[TermTest]:
    """Return the tests of the terms of one study."""
    flat = shapes.reshape(len(shapes), -1)
    random = None if row.random is None else tuple(
        frozenset({part.strip()}) for part in row.random.partition("|")[0].split("+")[1:]
    )  # fmt: skip
    strata = strata_of(flat - flat.mean(axis=0), design, table["subject"], "subject", "II", random)
    options = CompareConfig(permutations=ARRANGEMENTS, maps=False, seed=seed)
    return [test for stratum in strata.every for test in term_tests(stratum, options)]


def count(which: int, seeds: range) -> FloatArray:
    """Return how many of some studies of a row find each of its terms, unaligned and aligned."""
    row = list(rows())[which]
    out = np.zeros((2, len(row.terms)))
    for seed in seeds:
        rng = np.random.default_rng([17, which, seed])
        table = row.table(rng)
        design = design_of_table(row.formula, table)
        shapes = simulated(row, table, rng)
        for at, made in enumerate((shapes, aligned(shapes))):
            found = {test.term: test.p for test in tests_of(row, made, design, table, seed)}
            out[at] += [found[term] <= LEVEL for term in row.terms]
    return out


def main() -> None:
    """Print the table."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--studies", type=int, default=1000)
    words.add_argument("--jobs", type=int, default=1, help="processes")
    words.add_argument("--rows", type=int, nargs="*", help="only these rows, from 0")
    asked = words.parse_args()
    check()
    print("| design | term | false positives | aligned |\n|---|---|---|---|")
    with ProcessPoolExecutor(asked.jobs) as pool:
        for which, row in enumerate(rows()):
            if asked.rows and which not in asked.rows:
                continue
            start = time.perf_counter()
            batches = [range(at, min(at + 50, asked.studies)) for at in range(0, asked.studies, 50)]
            found = np.sum(list(pool.map(partial(count, which), batches)), axis=0) / asked.studies
            for term, off, on in zip(row.terms, *found, strict=True):
                print(f"| {row.name} | `{term}` | {100 * off:.1f} % | {100 * on:.1f} % |", flush=True)
            print(f"{time.perf_counter() - start:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
