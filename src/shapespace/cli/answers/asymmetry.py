"""`shapespace asymmetry`: asymmetry of the objects of a cohort."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given


def run(arguments: argparse.Namespace) -> int:
    """Measure the asymmetry of a cohort, and write its report."""
    from shapespace.batch.progress import steps
    from shapespace.errors import InputError
    from shapespace.report.analyses.asymmetry_report import asymmetry_report
    from shapespace.statistics.asymmetry import measure_asymmetry
    from shapespace.statistics.sides import read_pairs

    column, equals, value = (arguments.reference or "").partition("=")
    if arguments.reference and not (column and equals and value):
        raise InputError(f"--reference is {arguments.reference!r}; write COLUMN=VALUE, such as group=control.")
    cohort = cohort_of(arguments)
    pairs = None if arguments.pairs is None else read_pairs(arguments.pairs, cohort)
    options = given(arguments, measure_asymmetry, pairs=pairs, reference=(column, value) if column else None)
    with steps(None, "permuting", "shape", quiet=arguments.quiet) as step:
        result = measure_asymmetry(cohort, **options, where=str(arguments.pairs), progress=step)
    return finish(asymmetry_report(result), arguments)
