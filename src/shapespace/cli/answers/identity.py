"""`shapespace recognise verify` and `shapespace recognise identify`: identity of the subject of a scan."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.statistics.identity.trial import IdentityConfig


def run_verify(arguments: argparse.Namespace) -> int:
    """Verify whether two scans are of one subject."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.verify_report import verify_report
    from shapespace.statistics.identity.verify import verify

    cohort, config = _cohort_and_config(arguments)
    with steps(None, "comparing", "draw", quiet=arguments.quiet) as step:
        result = verify(cohort, config, progress=step)
    return finish(verify_report(result), arguments)


def run_identify(arguments: argparse.Namespace) -> int:
    """Identify the subject of a scan among the enrolled ones."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.identity import identify_report
    from shapespace.statistics.identity.identify import identify

    cohort, config = _cohort_and_config(arguments)
    with steps(None, "searching", "score", quiet=arguments.quiet) as step:
        result = identify(cohort, config, progress=step)
    return finish(identify_report(result), arguments)


def _cohort_and_config(arguments: argparse.Namespace) -> tuple[Cohort, IdentityConfig]:
    from shapespace.statistics.identity.trial import IdentityConfig

    cohort = cohort_of(arguments, "shape")
    if arguments.surfaces != "coefficients":
        cohort = replace(cohort, fitted=None)
    return cohort, IdentityConfig(**given(arguments, IdentityConfig))
