"""What the commands about cohorts share: arguments, reading the cohort, and printing of the results."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from shapespace.cli.printing import say, show, show_json

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.geometry.procrustes import Gauge
    from shapespace.report.analyses.analysis_report import AnalysisReport


def add_cohort(sub: argparse.ArgumentParser, surfaces: str = "auto") -> None:
    """Add the arguments that name a cohort, and the output folder; `surfaces` is a default."""
    sub.add_argument("data", type=Path, metavar="DATA",
                     help="a table (CSV or .xlsx) with one row per shape, named in the column file, scan, specimen, "
                     "name or id; or a folder of fits, whose metadata are the table")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="output folder")
    sub.add_argument("--shapes", type=Path, metavar="DIR",
                     help="results of fits, or meshes in correspondence (default: the folder of DATA)")  # fmt: skip
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="model of the fits, if its file was moved")
    sub.add_argument("--surfaces", choices=("auto", "coefficients", "fitted", "dense"), default=surfaces,
                     help="shapes of fits: auto uses dense surfaces if all fits have one, otherwise coefficients "
                     f"(default: {surfaces})")  # fmt: skip
    sub.add_argument("--doubtful", action="store_true", help="include doubtful fits (default: excluded)")
    sub.add_argument("--drop-missing", action="store_true",
                     help="exclude shapes with missing values in the table (default: an error)")  # fmt: skip


def add_gauge(sub: argparse.ArgumentParser, default: str = "shape") -> None:
    """Add the choice between shapes and forms."""
    sub.add_argument("--gauge", choices=("form", "shape"), default=default,
                     help=f"form keeps size, shape divides size out (default {default})")  # fmt: skip
    sub.add_argument("--no-unit", action="store_true",
                     help="the coordinates have no unit: lengths are not written in mm")  # fmt: skip


def cohort_of(
    arguments: argparse.Namespace, gauge: Gauge | None = None, onto: Cohort | None = None, *, least: int = 2
) -> Cohort:
    """Return the cohort that the arguments of `add_cohort` name.

    Args:
        arguments: parsed arguments, with those of `add_cohort`.
        gauge: of a command without the argument of `add_gauge`.
        onto: a cohort that this one is compared with.
        least: the smallest number of shapes, if `onto` is None.
    """
    from shapespace.batch.progress import steps
    from shapespace.cohort.read import CohortOptions, read_cohort

    options = CohortOptions(
        arguments.shapes, arguments.model, arguments.surfaces, gauge or arguments.gauge, arguments.doubtful, least
    )
    with steps(None, "reading", "shape", quiet=arguments.quiet) as step:
        cohort = read_cohort(arguments.data, options, onto=onto, on_shape=step)
    return replace(cohort, unit="") if getattr(arguments, "no_unit", False) else cohort


def finish(report: AnalysisReport, arguments: argparse.Namespace) -> int:
    """Write a report to the output folder, and print its summary."""
    from shapespace.commands.answers import save_report
    from shapespace.schemas import to_json

    page, notes = save_report(report, arguments.output, quiet=arguments.quiet)
    for note in notes:
        say(note)
    if arguments.json:
        analysis = to_json(report.analysis())
        show_json({"folder": str(arguments.output), "report": None if page is None else str(page), **analysis})
        return 0
    for sentence in report.summary:
        show(sentence)
    show(f"The report is {page}" if page is not None else f"All numbers are in {arguments.output}")
    return 0
