"""`shapespace morphospace`: ordinations of shapes."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given


def run(arguments: argparse.Namespace) -> int:
    """Compute an ordination of a cohort, and write its report."""
    from shapespace.report.analyses.morphospace_report import morphospace_report
    from shapespace.statistics.shape_tests.ordination import ordinate

    result = ordinate(cohort_of(arguments), **given(arguments, ordinate))
    return finish(morphospace_report(result, arguments.axes), arguments)
