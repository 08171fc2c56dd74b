"""`shapespace score`: where new subjects lie in a reference population."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, finish
from shapespace.cli.options import given


def run(arguments: argparse.Namespace) -> int:
    """Score subjects against a reference."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.score_report import score_report
    from shapespace.statistics.score_subjects import ScoreConfig, score

    config = ScoreConfig(**given(arguments, ScoreConfig))
    known = {"data": arguments.reference, "shapes": arguments.reference_shapes, "doubtful": False}
    reference = cohort_of(argparse.Namespace(**{**vars(arguments), **known}), accept_review=arguments.doubtful)
    subjects = cohort_of(arguments, onto=reference)
    with steps(len(subjects), "scoring", "subject", quiet=arguments.quiet) as step:
        result = score(reference, subjects, config, progress=step)
    return finish(score_report(result), arguments)
