"""`shapespace asymmetry`: asymmetry of the objects of a cohort."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, column_value, finish
from shapespace.cli.options import given


def run(arguments: argparse.Namespace) -> int:
    """Measure the asymmetry of a cohort, and write its report."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.asymmetry_report import asymmetry_report
    from shapespace.statistics.asymmetry import measure_asymmetry
    from shapespace.statistics.sides import read_pairs

    reference = column_value(arguments.reference, "--reference") if arguments.reference else None
    cohort = cohort_of(arguments)
    pairs = None if arguments.pairs is None else read_pairs(arguments.pairs, cohort)
    options = given(arguments, measure_asymmetry, pairs=pairs, reference=reference)
    with steps(None, "permuting", "shape", quiet=arguments.quiet) as step:
        result = measure_asymmetry(cohort, **options, where=str(arguments.pairs), progress=step)
    return finish(asymmetry_report(result), arguments)
