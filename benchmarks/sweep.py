"""How the settings of the robust method were chosen: one varied at a time, on people that no test table has.

    python benchmarks/sweep.py [--people 5] [--only narrow,prior] [--out DIR]

The score of a setting is the geometric mean, over cases, of its true vertex error beside that of the defaults: below 1
is better. The defaults stand where no neighbour is better by more than a few per cent in all, or where a neighbour that
is better on simulated scans is worse on the real one, which is shown beside it and not scored.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import machine_facts
from cases import CASES, Bench, error_mm, run, surface_figures
from tqdm import tqdm

from shapespace.errors import ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.robust_method import Robust

CASES_SWEPT = ("complete", "holes", "outside", "outside_holes", "missing40", "coarse", "noise1", "jaw")
VALUES: Mapping[str, tuple[Any, ...]] = {
    "narrow": (1.0, 1.5, 2.5),
    "wide": (2.5, 3.5, 5.0),
    "weight": ("welsch", "geman_mcclure", "huber"),
    "normal_cosine": (0.2, 0.4, 0.6),
    "reach": (2.0, 4.0, 8.0),
    "vertex_share": (0.1, 0.3, 1.0),
    "prior": (0.1, 0.3, 1.0),
    "beyond_prior": (0.3, 1.0, 3.0),
    "scale_stddev": (0.05, 0.15, 0.5),
    "beyond_share": (0.1, 0.2, 0.4),
    "residual.count": (150, 300, 450),
    "residual.range_share": (1.0, 1.6, 2.4),
    "residual.local_share": (0.01, 0.03, 0.1),
    "residual.mirror_share": (0.3, 1.0, 3.0),
}
FAILED_MM = 30.0


def settings_with(name: str, value: Any) -> Robust:
    base = Robust()
    if name.startswith("residual."):
        part = dataclasses.replace(base.residual, **{name.removeprefix("residual."): value})
        return dataclasses.replace(base, residual=part)
    return dataclasses.replace(base, **{name: value})


def default_of(name: str) -> Any:
    base: Any = Robust()
    for part in name.split("."):
        base = getattr(base, part)
    return base


def errors(bench: Bench, settings: Robust, people: int) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for name in CASES_SWEPT:
        model = bench.model(CASES[name].model)
        for index in range(people):
            scan = bench.scan(name, index)
            try:
                result = fit_scan(model, scan.mesh, FitConfig(settings), T_scan_model=scan.start)
                error = float(error_mm(result.surface(model).vertices, scan).mean())
            except ShapespaceError:
                error = FAILED_MM
            found.setdefault(name, []).append(error)
    return found


def on_james(bench: Bench, settings: Robust) -> float:
    model, scan = bench.model("ict200"), bench.scan("james", 0)
    result = fit_scan(model, scan.mesh, FitConfig(settings))
    mm = 1.0 / result.T_scan_model.scale
    return surface_figures(result.surface(model).vertices, model, scan, mm)["m2s_median_mm"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=5)
    parser.add_argument("--only", default="", help="names of settings, with commas between")
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    arguments = parser.parse_args()
    names = [n for n in arguments.only.split(",") if n] or list(VALUES)
    bench = Bench("dev")
    base = errors(bench, Robust(), arguments.people)
    james = on_james(bench, Robust())
    rows: list[dict[str, Any]] = []
    for name in tqdm(names, desc="settings"):
        for value in VALUES[name]:
            chosen = value == default_of(name)
            found = base if chosen else errors(bench, settings_with(name, value), arguments.people)
            ratio = {case: float(np.mean(found[case]) / np.mean(base[case])) for case in CASES_SWEPT}
            rows.append(
                {
                    "setting": name,
                    "value": value,
                    "chosen": chosen,
                    "score": float(np.exp(np.mean(np.log(list(ratio.values()))))),
                    "james_m2s_median_mm": james if chosen else on_james(bench, settings_with(name, value)),
                    **ratio,
                }
            )
    arguments.out.mkdir(parents=True, exist_ok=True)
    facts = {"machine": machine_facts(), "people": arguments.people, "date": time.strftime("%Y-%m-%d")}
    (arguments.out / "sweep.json").write_text(json.dumps({**facts, "base_mm": base, "rows": rows}, indent=1))
    lines = [
        "| setting | value | score | James, mm | " + " | ".join(CASES_SWEPT) + " |",
        "|---" * (4 + len(CASES_SWEPT)) + "|",
    ]
    for row in rows:
        mark = "**" if row["chosen"] else ""
        cells = [f"{row[case]:.2f}" for case in CASES_SWEPT]
        head = [f"`{row['setting']}`", f"{mark}{row['value']}{mark}", f"{row['score']:.3f}"]
        lines.append("| " + " | ".join([*head, f"{row['james_m2s_median_mm']:.2f}", *cells]) + " |")
    table = "\n".join(lines)
    (arguments.out / "sweep.md").write_text(table + "\n")
    print(table)


if __name__ == "__main__":
    run(main)
