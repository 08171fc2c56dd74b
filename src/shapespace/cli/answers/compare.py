"""`shapespace compare`: linear models of shape on groups and covariates."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given


def run(arguments: argparse.Namespace) -> int:
    """Compare the shapes of a cohort."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.compare_report import compare_report
    from shapespace.statistics.compare_shapes import CompareConfig, compare

    config = CompareConfig(**given(arguments, CompareConfig, errors=dict(arguments.error)))
    cohort = cohort_of(arguments)
    with steps(None, "permuting", "step", quiet=arguments.quiet) as step:
        result = compare(cohort, arguments.formula, config, progress=step)
    return finish(compare_report(result), arguments)
