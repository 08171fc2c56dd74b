"""`shapespace test`: tests of shape, from their table."""

from __future__ import annotations

import argparse
from pkgutil import resolve_name

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given


def run(arguments: argparse.Namespace) -> int:
    """Run a test of shape on a cohort, and write its report."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.shape_test_report import shape_test_report

    test = arguments.shape_test
    function = resolve_name(f"shapespace.statistics.shape_tests.{test.function}")
    cohort = cohort_of(arguments)
    options = given(arguments, function)
    with steps(None, "permuting", "permutation", quiet=arguments.quiet) as step:
        result = function(cohort, **options, progress=step)
    return finish(shape_test_report(result), arguments)
