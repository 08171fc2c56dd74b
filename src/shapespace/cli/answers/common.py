"""What the commands about cohorts share: their arguments, the cohort that these name, and how an answer is told."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from shapespace.cli.printing import say, show, show_json

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.geometry.procrustes import Gauge
    from shapespace.statistics.answer import Answer


def add_cohort(sub: argparse.ArgumentParser, surfaces: str = "auto") -> None:
    """Add the arguments that name a cohort, and where the answer is written; `surfaces` is a default."""
    sub.add_argument("data", type=Path, metavar="DATA",
                     help="a table (CSV or .xlsx) whose column file, scan, specimen, name or id names a shape in each "
                     "row; or a folder of fits, whose metadata are the table")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="where to write")
    sub.add_argument("--shapes", type=Path, metavar="DIR",
                     help="results of fits, or meshes in correspondence (default: the folder of DATA)")  # fmt: skip
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="of the fits, where it was moved")
    sub.add_argument("--surfaces", choices=("auto", "coefficients", "fitted", "dense"), default=surfaces,
                     help="shapes of fits: auto takes dense surfaces where all fits have one, else coefficients "
                     f"(default: {surfaces})")  # fmt: skip
    sub.add_argument("--doubtful", action="store_true", help="take doubtful fits too (default: left out and counted)")
    sub.add_argument("--drop-missing", action="store_true",
                     help="leave out shapes of which something is missing in the table (default: refused)")  # fmt: skip


def add_gauge(sub: argparse.ArgumentParser, default: str = "shape") -> None:
    """Add the choice between shapes and forms."""
    sub.add_argument("--gauge", choices=("form", "shape"), default=default,
                     help=f"form keeps size, shape divides it out (default {default})")  # fmt: skip
    sub.add_argument("--no-unit", action="store_true",
                     help="the coordinates have no unit: lengths are not written in mm")  # fmt: skip


def cohort_of(
    arguments: argparse.Namespace, gauge: Gauge | None = None, onto: Cohort | None = None, *, least: int = 2
) -> Cohort:
    """Return the cohort that `add_cohort` asked for.

    Args:
        arguments: with what `add_cohort` added.
        gauge: stands for `add_gauge` where a command has no choice.
        onto: a cohort that it is to be compared with.
        least: how many shapes there must be, where `onto` is None.
    """
    from shapespace.batch.progress import steps
    from shapespace.cohort.read import CohortOptions, read_cohort

    options = CohortOptions(
        arguments.shapes, arguments.model, arguments.surfaces, gauge or arguments.gauge, arguments.doubtful, least
    )
    with steps(None, "reading", "shape", quiet=arguments.quiet) as step:
        cohort = read_cohort(arguments.data, options, onto=onto, on_shape=step)
    return replace(cohort, unit="") if getattr(arguments, "no_unit", False) else cohort


def finish(answer: Answer, arguments: argparse.Namespace) -> int:
    """Write the answer and its report, and tell of it."""
    from shapespace.commands.answers import keep_answer
    from shapespace.schemas import to_json

    report, notes = keep_answer(answer, arguments.output, quiet=arguments.quiet)
    for note in notes:
        say(note)
    if arguments.json:
        told = to_json(answer.analysis())
        show_json({"folder": str(arguments.output), "report": None if report is None else str(report), **told})
        return 0
    for sentence in answer.summary:
        show(sentence)
    show(f"The report is {report}" if report is not None else f"All numbers are in {arguments.output}")
    return 0
