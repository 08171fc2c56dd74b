"""How far the percentiles of `shapespace score` hold, and what they find: simulated people, and fits of raw scans.

Simulated people are drawn by the variances that a model expects of new shapes, and seen as fits see them. Fits of raw
scans are those of `studies/recognition.py`: of each fold the people that its model did not see. Everybody is left out
in turn, with all scans, and scored by the neutral faces of the others.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.statistics.score_subjects import ScoreConfig, ScoreResult, score
from shapespace.types import FloatArray

LEVELS = (0.05, 0.1, 0.2, 0.5)
STRENGTHS = (0.25, 0.5, 0.75, 1.0)
_USED = (0, 1)


def cohort(model: ShapeModel, b: FloatArray, b_stddev: FloatArray, names: Sequence[str]) -> Cohort:
    """Return fits as a cohort."""
    fitted = FitDiagnostics(model, b, b_stddev, ("converged",) * len(b), "fits")
    return Cohort.of_fits(fitted, names, Table({}, tuple(names)), np.full(len(b), np.nan))


Kept = dict[str, list[FloatArray]]
"""By name of a column: p values of subjects, and whether their maps pass the limit."""


def add(collected: Kept, scores: ScoreResult, rows: Sequence[int]) -> None:
    """Add those of some subjects."""
    indices = list(rows)
    for which in ("farther", "p_value", "rest_farther"):
        collected.setdefault(which, []).append(getattr(scores, which)[indices])
    if np.isfinite(scores.z_limit):
        collected.setdefault("map", []).append((np.abs(scores.z[indices]) > scores.z_limit).any(axis=1).astype(float))


def rates_text(collected: Kept) -> str:
    """Return cells: share of subjects whose p values lie below each level, and of those whose map passes its limit."""
    cells = []
    for which in ("farther", "p_value", "rest_farther"):
        p = np.concatenate(collected[which])
        cells.append(" / ".join(f"{100 * (p <= level).mean():.0f}" for level in LEVELS))
    cells.append(f"{100 * np.concatenate(collected['map']).mean():.0f}" if "map" in collected else "-")
    return " | ".join(cells)


def simulated(model: ShapeModel, people: int, seen: float, runs: int, seed: int) -> Kept:
    """Return scores of ten new people by each of `runs` references; half of their modes are told to `seen` alone."""
    rng = np.random.default_rng((seed, people, round(100 * seen)))
    prior = variance_of_new_shapes(model)

    def fits(count: int, shares: FloatArray, name: str) -> Cohort:
        b = rng.standard_normal((count, len(prior))) * np.sqrt(prior)
        noise = np.sqrt(shares * (1 - shares) * prior) * rng.standard_normal(b.shape)
        stddev = np.broadcast_to(np.sqrt((1 - shares) * prior), b.shape)
        return cohort(model, shares * b + noise, stddev, [f"{name}{k}" for k in range(count)])

    well = np.full(len(prior), 0.97)
    badly = np.where(rng.random(len(prior)) < 0.5, seen, well)
    kept: Kept = {}
    for _ in range(runs):
        add(kept, score(fits(people, well, "r"), fits(10, badly, "s")), range(10))
    return kept


def of_study(folder: Path, fold: int, most: int | None, found: dict[float, Kept]) -> None:
    """Add scores of people that a fold's model did not see, by strength of expression; 0 is neutral."""
    model = ShapeModel.load(folder / f"fold_{fold}.h5")
    z, stddev, status = [], [], []
    for path in sorted((folder / "fits").glob("person_*.npz")):
        with np.load(path) as kept:
            counts = (kept["status"] >= 0).sum(axis=1)
            if counts.argmax() == fold:
                z.append(kept["z"][fold, :, : model.n_modes].astype(float))
                stddev.append(kept["z_stddev"][fold, :, : model.n_modes].astype(float))
                status.append(kept["status"][fold])
    usable = np.isin(status, _USED)
    for person in range(len(z))[:most]:
        others = [k for k in range(len(z)) if k != person and usable[k, 0]]
        reference = cohort(
            model, np.stack([z[k][0] for k in others]) * model.stddev,
            np.stack([stddev[k][0] for k in others]) * model.stddev, [f"person {k}" for k in others],
        )  # fmt: skip
        strengths = [0.0, *(STRENGTHS[k % len(STRENGTHS)] for k in range(z[person].shape[0] - 1))]
        scans = [
            k
            for k, strength in enumerate(strengths)
            if strength in (0.0, 0.5, 1.0) and np.isfinite(z[person][k]).all() and (k or usable[person, 0])
        ]
        subjects = cohort(
            model, z[person][scans] * model.stddev, stddev[person][scans] * model.stddev, [str(k) for k in scans]
        )
        scores = score(reference, subjects, ScoreConfig(draws=10))
        for strength in (0.0, 0.5, 1.0):
            rows = [row for row, k in enumerate(scans) if strengths[k] == strength]
            if rows:
                add(found.setdefault(strength, {}), scores, rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="draw people by this model")
    parser.add_argument("--study", type=Path, nargs="*", default=[], help="folders that studies/recognition.py wrote")
    parser.add_argument("--people", type=int, nargs="+", default=(10, 25, 100))
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--most", type=int, help="people of each fold of a study")
    parser.add_argument("--quick", action="store_true", help="few runs, and two people a fold")
    options = parser.parse_args(arguments)
    runs = 4 if options.quick else options.runs
    head = " / ".join(f"{100 * level:g} %" for level in LEVELS)
    print(f"| subjects | {head} left out | F | left by the modes | map |\n|---|---|---|---|---|")
    start = time.process_time()
    if options.model:
        model = ShapeModel.load(options.model)
        for people in options.people:
            for seen in (0.97, 0.4):
                print(
                    f"| {people}, told {seen:g} | {rates_text(simulated(model, people, seen, runs, 0))} |", flush=True
                )
    for folder in options.study:
        found: dict[float, Kept] = {}
        for fold in range(4):
            of_study(folder, fold, 2 if options.quick else options.most, found)
        for strength, kept in found.items():
            count = sum(map(len, kept["farther"]))
            print(f"| expressions at {strength:g}, {count} scans | {rates_text(kept)} |", flush=True)
    print(f"{time.process_time() - start:.0f} CPU s")


if __name__ == "__main__":
    main()
