"""Measure whether `b_stddev` says what it says: how often the true coefficients lie within 1 and 1.96 of them.

Models are aligned by their gauge, as users build them. The truth b* is `ShapeModel.project` of the true surface. The
constants of `fit/robust/posterior.py` were chosen on the split "dev"; "test" judges them.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import trust
from cases import CASES, MISSING_SHARE, NOISE_MM, OFF_DEG, OFF_MM, OFF_SCALE, TRIANGLES, Bench, Case, Split, run
from threadpoolctl import threadpool_limits

from shapespace import fit_scan
from shapespace.datasets.simulated_scan import random_similarity, simulate_scan
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh

SCANS = 30
DRAWN_SEED = 3000
BOUNDS = {"68 %": (0.60, 0.76), "95 %": (0.90, 0.98)}
_WIDTHS = {"68 %": 1.0, "95 %": 1.96}
_GROUPS = ((0, 10), (10, 50), (50, 1000))


@dataclass(frozen=True)
class Condition:
    """Scans of one kind, fitted with one model of gauge-aligned people.

    Args:
        case: a name of `cases.CASES`, whose scans are taken.
        people: number of people in the model.
        modes: the model is cut to its first so many; None for all.
        drawn: whether the shapes are drawn from the model itself, so that they lie in its span; they are scanned whole.
    """

    name: str
    case: str
    people: int
    modes: int | None = None
    drawn: bool = False


CONDITIONS = (
    Condition("complete", "complete", 200),
    Condition(f"{100 * MISSING_SHARE:.0f} % missing", "missing40", 200),
    Condition("noise 1 mm", "noise1", 200),
    Condition("4,000 triangles", "coarse", 200),
    Condition("outside the span", "complete", 60),
    Condition(f"outside, {100 * MISSING_SHARE:.0f} % missing", "missing40", 60),
    Condition("outside the span of 20", "complete", 20),
    Condition(f"outside 20, {100 * MISSING_SHARE:.0f} % missing", "missing40", 20),
    *(Condition(f"in the span of {n}", "complete", n, drawn=True) for n in (20, 60, 200)),
    Condition("50 modes of 200", "complete", 200, 50),
    Condition(f"50 modes, {100 * MISSING_SHARE:.0f} % missing", "missing40", 200, 50),
)


@dataclass(frozen=True)
class Coverage:
    """How often the truth lay within the intervals, of a group of modes.

    Args:
        modes: first and last, from 1.
        within: share by interval.
        rms: of (b - b*) / b_stddev; 1 is right.
        shrinkage: mean.
        error: RMS of b - b* beside what a new shape varies by; 0 is exact, 1 is as good as no scan.
    """

    condition: str
    modes: tuple[int, int]
    within: Mapping[str, float]
    rms: float
    shrinkage: float
    error: float


def measure(bench: Bench, condition: Condition, scans: int) -> list[Coverage]:
    """Fit `scans` scans of unseen people and return the coverage of all modes, and by group."""
    model = _model(bench, condition)
    case: Case = CASES[condition.case]
    z, shrinkage, off = [], [], []
    for index in range(scans):
        raw, face = _scan_of(model, index) if condition.drawn else case.make(bench, index)
        assert face is not None
        result = fit_scan(model, raw)
        error = result.b - model.project(face)
        z.append(error / result.b_stddev)
        off.append(error)
        shrinkage.append(result.shrinkage)
    ratio, shrinkages, wrong = np.array(z), np.array(shrinkage), np.array(off)
    K = model.n_modes
    new = variance_of_new_shapes(model)

    def of(first: int, last: int) -> Coverage:
        part = np.abs(ratio[:, first:last])
        return Coverage(
            condition.name,
            (first + 1, last),
            {name: float((part < width).mean()) for name, width in _WIDTHS.items()},
            float(np.sqrt((part**2).mean())),
            float(shrinkages[:, first:last].mean()),
            float(np.sqrt((wrong[:, first:last] ** 2 / new[first:last]).mean())),
        )

    return [of(0, K)] + [of(a, min(b, K)) for a, b in _GROUPS if a < K]


def _scan_of(model: ShapeModel, index: int) -> tuple[Mesh, Mesh]:
    """Return a scan of a shape drawn from `model`, near it, and that shape."""
    rng = np.random.default_rng([DRAWN_SEED, index])
    face = model.mesh(model.stddev * rng.standard_normal(model.n_modes))
    T = random_similarity(rng, max_angle_deg=OFF_DEG, scale_range=(1.0, OFF_SCALE), translation_mm=OFF_MM)
    return simulate_scan(face, rng, triangles=TRIANGLES, noise_mm=NOISE_MM, T_scan_model=T).scan, face


def _model(bench: Bench, condition: Condition) -> ShapeModel:
    if condition.people == 200:
        return bench.model("aligned200", condition.modes)
    return ShapeModel.fit([bench.faces.mesh(c) for c in bench.training_people(condition.people)])


def table(rows: Sequence[Coverage]) -> str:
    """Return a markdown table; the intervals should hold 60-76 % and 90-98 %."""
    lines = [
        "| scans, model | modes | within 1 stddev | within 1.96 | rms of error / stddev | mean shrinkage |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        shares = [
            f"{100 * row.within[name]:.0f} %{'' if low <= row.within[name] <= high else ' (out)'}"
            for name, (low, high) in BOUNDS.items()
        ]
        span = f"{row.modes[0]}-{row.modes[1]}"
        lines.append(f"| {row.condition} | {span} | {' | '.join(shares)} | {row.rms:.2f} | {row.shrinkage:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=("test", "dev"), default="test")
    parser.add_argument("--scans", type=int, default=SCANS, help="of each condition")
    parser.add_argument("--only", help="conditions that begin so", default="")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    parser.add_argument("--cache", type=Path)
    options = parser.parse_args()
    split: Split = options.split
    threadpool_limits(1)
    bench = Bench(split, options.cache)
    rows: list[Coverage] = []
    for condition in CONDITIONS:
        if condition.name.startswith(options.only):
            found = measure(bench, condition, options.scans)
            print(table(found), flush=True)
            rows += found
    about = {"split": split, "scans": options.scans, **trust.machine()}
    trust.write(options.out, f"calibration_{split}", table(rows), {**about, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    run(main)
