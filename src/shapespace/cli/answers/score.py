"""`shapespace score`: where new subjects lie in a reference population."""

from __future__ import annotations

import argparse
from pathlib import Path

from shapespace.cli.answers.common import add_cohort, add_gauge, cohort_of, finish


def add(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_cohort(sub, "coefficients")
    sub.add_argument("--reference", type=Path, required=True, metavar="DATA",
                     help="the population: a table or a folder of fits, without its doubtful fits")  # fmt: skip
    sub.add_argument("--reference-shapes", type=Path, metavar="DIR",
                     help="its results of fits, or meshes (default: the folder of the reference)")  # fmt: skip
    sub.add_argument("--modes", type=int, metavar="N",
                     help="of the reference (default: of 95 %% of its variance, one for five subjects)")  # fmt: skip
    sub.add_argument("--subject", metavar="COLUMN",
                     help="column of the subjects, if subjects have several scans")  # fmt: skip
    sub.add_argument("--nearest", type=int, default=3, metavar="N", help="of the reference to name (default 3)")
    sub.add_argument("--seed", type=int, default=0, metavar="S", help="of the draws of uncertain fits")
    add_gauge(sub)
    sub.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Score subjects against a reference."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.score import score_report
    from shapespace.statistics.score import ScoreConfig, score

    config = ScoreConfig(
        modes=arguments.modes,
        subject=arguments.subject,
        nearest=arguments.nearest,
        seed=arguments.seed,
        drop_missing=arguments.drop_missing,
    )
    known = {"data": arguments.reference, "shapes": arguments.reference_shapes, "doubtful": False}
    reference = cohort_of(argparse.Namespace(**{**vars(arguments), **known}))
    subjects = cohort_of(arguments, onto=reference)
    with steps(len(subjects), "scoring", "subject", quiet=arguments.quiet) as step:
        result = score(reference, subjects, config, progress=step)
    return finish(score_report(result), arguments)
