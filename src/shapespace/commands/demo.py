"""Command `demo`: both experiments of the paper, ending in a report."""

from __future__ import annotations

from pathlib import Path

from shapespace.batch.workers import DRAWING, cores, start_loading
from shapespace.commands.outcome import Outcome


def demo(out: Path, *, quick: bool, no_open: bool, quiet: bool) -> Outcome:
    """Run both experiments of the paper on simulated faces, and write their report.

    Raises:
        ShapespaceError: the extra `report` is not installed.
        FileError: something cannot be written.
    """
    if cores() > 1:
        start_loading(*DRAWING, notify=False)  # while this process loads its own code
    from shapespace.demo import run_demo

    report = run_demo(out, quick=quick, quiet=quiet)
    return Outcome({"report": str(report)}, [f"The report is {report}"], page=None if no_open else report)
