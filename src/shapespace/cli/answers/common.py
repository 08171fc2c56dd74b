"""What the commands about cohorts share: reading the cohort, and printing of the results."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from shapespace.cli.options import given
from shapespace.cli.printing import say, show, show_json
from shapespace.errors import InputError

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.commands.answers import FigureConfig
    from shapespace.geometry.procrustes import Gauge
    from shapespace.report.analyses.analysis_report import AnalysisReport
    from shapespace.schemas import Orientation


def column_value(text: str, option: str) -> tuple[str, str]:
    """Return the column and the value of COLUMN=VALUE.

    Raises:
        InputError: it is something else.
    """
    column, _, value = (part.strip() for part in text.partition("="))
    if not (column and value):
        raise InputError(f"{option} is {text!r}; write COLUMN=VALUE, such as group=control.")
    return column, value


def cohort_of(
    arguments: argparse.Namespace,
    gauge: Gauge | None = None,
    onto: Cohort | None = None,
    *,
    least: int = 2,
    accept_review: bool | None = None,
) -> Cohort:
    """Return the cohort that the arguments name.

    Args:
        arguments: parsed arguments of a command that reads a cohort.
        gauge: gauge of a command that has no option for it; None for the value of the option.
        onto: a cohort that this one is compared with.
        least: the smallest number of shapes, if `onto` is None.
        accept_review: see `CohortConfig`; None for the value of --doubtful, or True for a command without the option.
    """
    from shapespace.batch.progress import steps
    from shapespace.cohort.read import CohortConfig, read_cohort

    _figures(arguments)  # files and options that do not fit are refused before the analysis
    fixed = {} if gauge is None else {"gauge": gauge}
    accept_review = getattr(arguments, "doubtful", True) if accept_review is None else accept_review
    config = CohortConfig(**given(arguments, CohortConfig, least=least, accept_review=accept_review, **fixed))
    with steps(None, "reading", "shape", quiet=arguments.quiet) as step:
        cohort = read_cohort(arguments.data, config, onto=onto, on_shape=step)
    return replace(cohort, unit="") if getattr(arguments, "no_unit", False) else cohort


def _figures(arguments: argparse.Namespace) -> tuple[FigureConfig, Orientation | None]:
    """Return the formats of figures, and the named views of the shapes."""
    from shapespace.commands.answers import FigureConfig
    from shapespace.report.inputs.orientation import find_orientation

    config = FigureConfig(**given(arguments, FigureConfig))
    sources = [path for path in (getattr(arguments, "shapes", None), getattr(arguments, "data", None)) if path]
    folders = [path if path.is_dir() else path.parent for path in sources]
    return config, find_orientation(config.orientation, folders)


def finish(report: AnalysisReport, arguments: argparse.Namespace) -> int:
    """Write a report to the output folder, and print its summary."""
    from shapespace.commands.answers import save_report
    from shapespace.schemas import to_json

    figures, orientation = _figures(arguments)
    page, notes = save_report(report, arguments.output, quiet=arguments.quiet, figures=figures, orientation=orientation)
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
