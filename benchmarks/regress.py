"""Measure `regress` where subjects have unequal numbers of scans: false positives, R2 and the coverage of intervals.

With `--along` it measures mean shapes along a number, by `predict_shapes`: the coverage of 95 % intervals at both ends
and in the middle, and false positives, with variances that depend on the number, and one scan of each subject, two at
one age, or two at different ages.

Shapes are simulated as 20 coefficients of falling variance. A subject has a mean shape, each of its scans a deviation
from it. The target depends on three coefficients, or on none of them; it belongs to the subject, or it varies from scan
to scan as well. Figures on left-out subjects are compared with those on 400 new subjects.

    python benchmarks/regress.py
    python benchmarks/regress.py --studies 40
    python benchmarks/regress.py --along --studies 300
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table, numbers_as_text
from shapespace.statistics.regression import compare_with, regress
from shapespace.statistics.shape_prediction import Curve, predict_shapes
from shapespace.types import FloatArray, IntArray, read_only

MODES, VERTICES, SUBJECTS, NEW = 20, 30, 30, 400
STDDEV_MM = 10 * 0.85 ** np.arange(MODES)
SLOPES = np.zeros(MODES)
SLOPES[[0, 3, 7]] = 5.0, 5.0, 3.0
NOISE = 5.0
"""Standard deviation of the part of the target that shape does not determine; the best R2 is 0.70."""
WITHIN = 0.5
"""Standard deviation of a scan about its subject's mean shape, relative to that between subjects."""


def _one(rng: np.random.Generator) -> IntArray:
    return np.ones(SUBJECTS, dtype=np.int32)


def _three(rng: np.random.Generator) -> IntArray:
    return np.full(SUBJECTS, 3, dtype=np.int32)


def _forty(rng: np.random.Generator) -> IntArray:
    return np.array([40] + [1] * (SUBJECTS - 1), dtype=np.int32)


def _geometric(rng: np.random.Generator) -> IntArray:
    return rng.geometric(0.25, SUBJECTS).astype(np.int32)


DESIGNS: Mapping[str, Callable[[np.random.Generator], IntArray]] = MappingProxyType(
    {
        "1 scan of each": _one,
        "3 scans of each": _three,
        "one subject 40 scans, the others 1": _forty,
        "1 to 20 scans (geometric, mean 4)": _geometric,
    }
)


SPREADS: Mapping[str, Callable[[FloatArray], FloatArray]] = MappingProxyType(
    {
        "equal": np.ones_like,
        "rising to 3 times": lambda age: 1 + (age - 20) / 20,
        "falling from 3 times": lambda age: 3 - (age - 20) / 20,
        "5 times at both ends": lambda age: 1 + 4 * ((age - 40) / 20) ** 2,
    }
)
"""Standard deviation of shapes by age."""
ALONG: tuple[tuple[Curve, int], ...] = (("linear", 12), ("linear", 30), ("linear", 100), ("spline", 20),
                                        ("spline", 30), ("spline", 100))  # fmt: skip
"""Curves and numbers of subjects."""


@dataclass(frozen=True)
class AlongStudy:
    """One simulated study of mean shapes along age, which do not depend on it."""

    curve: Curve
    subjects: int
    spread: str
    seed: int


def run_along(study: AlongStudy) -> FloatArray:
    """Return (4,): coverage of the intervals at the 5th, 50th and 95th percentile, NaN where not known, and p."""
    rng = np.random.default_rng(
        (study.seed, study.subjects, list(SPREADS).index(study.spread), study.curve == "spline")
    )
    scans, moves = ((1, 0.0), (2, 0.0), (2, 5.0))[study.seed % 3]
    codes = np.repeat(np.arange(study.subjects), scans)
    # Every other study has few old subjects.
    drawn = rng.uniform(size=study.subjects) if study.seed % 2 else rng.beta(1.2, 3.0, study.subjects)
    age = np.clip((20 + 40 * drawn)[codes] + moves * rng.uniform(-1, 1, len(codes)), 20, 60)
    own = rng.standard_normal((study.subjects, MODES))[codes] + WITHIN * rng.standard_normal((len(codes), MODES))
    names = tuple(f"s {k}" for k in range(len(codes)))
    table = Table({"age": numbers_as_text(age), "subject": tuple(f"s {k}" for k in codes)}, names)
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((3 * VERTICES, MODES)))[0].T
    reference = 50 * np.random.default_rng(1).standard_normal((VERTICES, 3))
    coefficients = read_only(SPREADS[study.spread](age)[:, None] * own * STDDEV_MM)
    sizes = read_only(np.full(len(codes), np.nan))
    cohort = Cohort(names, read_only(reference), read_only(basis), coefficients, sizes, table, "form")
    at = tuple(np.percentile(age, [5, 50, 95]).tolist())
    found = predict_shapes(cohort, "age", at=at, curve=study.curve, permutations=100)
    off = [
        np.abs(cohort.vertices(own) - reference) <= found.half_width_mm(k) for k, own in enumerate(found.coefficients)
    ]
    inside = [one.mean() if known else np.nan for one, known in zip(off, found.is_known, strict=False)]
    return np.array([*inside, np.nan if found.p is None else found.p])


def measure_along(studies: int, jobs: int) -> None:
    """Print the table of mean shapes along a number."""
    print(
        "| curve | subjects | standard deviation | 5th percentile | median | 95th percentile | not known | p ≤ 0.05 |"
    )
    print("|---|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor(jobs) as pool:
        for curve, subjects in ALONG:
            for spread in SPREADS:
                chosen = [AlongStudy(curve, subjects, spread, seed) for seed in range(studies)]
                rows = np.array(list(pool.map(run_along, chosen, chunksize=10)))
                cells = [f"{100 * np.nanmean(own):.1f} %" for own in rows[:, :3].T]
                unknown, false = np.isnan(rows[:, :3]).mean(), (rows[:, 3] <= 0.05 + 1e-9).mean()
                cells += [f"{100 * unknown:.0f} %", f"{100 * false:.1f} %"]
                print(f"| {curve} | {subjects} | {spread} | {' | '.join(cells)} |", flush=True)


@dataclass(frozen=True)
class Study:
    """One simulated study: the design, whether the target varies within subjects and depends on shape, and the seed."""

    design: str
    varies: bool
    signal: bool
    seed: int


def simulate_cohort(counts: IntArray, rng: np.random.Generator, *, varies: bool, signal: bool, name: str) -> Cohort:
    """Return scans of subjects with `counts` scans each."""
    codes = np.repeat(np.arange(len(counts)), counts)
    between = rng.standard_normal((len(counts), MODES))[codes]
    within = WITHIN * rng.standard_normal((len(codes), MODES))
    total = np.sqrt(1.0 + WITHIN**2)
    shown = (between + within) / total
    own = rng.standard_normal(len(counts))[codes]
    if varies:
        observed, noise = shown, (own + WITHIN * rng.standard_normal(len(codes))) / total
    else:
        observed, noise = between, own
    if not signal:
        fresh = rng.standard_normal((len(counts), MODES))[codes]
        observed = (fresh + WITHIN * rng.standard_normal((len(codes), MODES))) / total if varies else fresh
    age = 50 + observed @ SLOPES + NOISE * noise
    names = tuple(f"{name} {k}" for k in range(len(codes)))
    table = Table({"age": numbers_as_text(age), "subject": tuple(f"{name} {k}" for k in codes)}, names)
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((3 * VERTICES, MODES)))[0].T
    reference = 50 * np.random.default_rng(1).standard_normal((VERTICES, 3))
    coefficients = read_only(shown * STDDEV_MM)
    sizes = read_only(np.full(len(codes), np.nan))
    return Cohort(names, read_only(reference), read_only(basis), coefficients, sizes, table, "form")


def run_study(study: Study) -> FloatArray:
    """Return (8,): p, R2, its interval, coverage and slope on left-out subjects, R2 and coverage on new subjects."""
    rng = np.random.default_rng((study.seed, list(DESIGNS).index(study.design), study.varies, study.signal))
    counts = DESIGNS[study.design](rng)
    cohort = simulate_cohort(counts, rng, varies=study.varies, signal=study.signal, name="s")
    found = regress(cohort, "age", permutations=99, draws=200, seed=study.seed)
    new = simulate_cohort(np.ones(NEW, dtype=np.int32), rng, varies=study.varies, signal=study.signal, name="n")
    r2, _, coverage = compare_with(found.predictor.predict(new), new.table.numbers("age"))
    measures = found.measures
    p = np.nan if found.p is None else found.p
    return np.array(
        [
            p,
            measures["r2"].value,
            measures["r2"].low,
            measures["r2"].high,
            measures["coverage"].value,
            measures["slope"].value,
            r2,
            coverage,
        ]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--studies", type=int, default=1000, help="for each row without a relation, four times as many "
                        "as with one (default 1000)")  # fmt: skip
    parser.add_argument("--designs", type=int, nargs="*", default=list(range(len(DESIGNS))), help="rows, from 0")
    parser.add_argument("--along", action="store_true", help="measure mean shapes along a number")
    parser.add_argument("--jobs", type=int, default=1)
    chosen = parser.parse_args()
    if chosen.along:
        measure_along(chosen.studies, chosen.jobs)
        return 0
    null = [
        "| scans | target | R² left out, mean | R² left out, largest | p ≤ 0.05 | p ≤ 0.20 | p ≤ 0.50 |",
        "|---|---|---|---|---|---|---|",
    ]
    signal = [
        "| scans | target | p ≤ 0.05 | R² left out | R² new | slope | 90 % intervals contain, left out | new |",
        "|---|---|---|---|---|---|---|---|",
    ]
    with ProcessPoolExecutor(chosen.jobs) as pool:
        for design in (list(DESIGNS)[k] for k in chosen.designs):
            for varies in (False, True):
                target = "varies within subjects" if varies else "one per subject"
                for is_signal in (False, True):
                    count = max(chosen.studies // 4, 1) if is_signal else chosen.studies
                    studies = [Study(design, varies, is_signal, seed) for seed in range(count)]
                    rows = np.array(list(pool.map(run_study, studies, chunksize=10)))
                    p, r2, _, _, inside, slope, r2_new, inside_new = rows.T
                    shares = [f"{100 * (p <= level + 1e-9).mean():.1f} %" for level in (0.05, 0.2, 0.5)]
                    if is_signal:
                        cells = [shares[0], *(f"{np.median(v):.2f}" for v in (r2, r2_new, slope))]
                        cells += [f"{100 * v.mean():.1f} %" for v in (inside, inside_new)]
                        signal.append(f"| {design} | {target} | {' | '.join(cells)} |")
                    else:
                        null.append(
                            f"| {design} | {target} | {r2.mean():.2f} | {r2.max():.2f} | {' | '.join(shares)} |"
                        )
                    print(
                        f"{design}, {target}, {'related' if is_signal else 'unrelated'}: done",
                        file=sys.stderr,
                        flush=True,
                    )
    print(f"No relation ({chosen.studies} studies a row):\n", *null, sep="\n")
    print(
        f"\nA relation whose best R² is 0.70 (medians of {max(chosen.studies // 4, 1)} studies a row):\n",
        *signal,
        sep="\n",
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
