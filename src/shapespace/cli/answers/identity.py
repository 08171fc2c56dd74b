"""`shapespace recognise verify` and `shapespace recognise identify`: identity of the subject of a scan."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from shapespace.cli.answers.common import add_cohort, cohort_of, finish

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.statistics.identity.trial import IdentityConfig


def add_verify(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of verification."""
    _add_who(sub)
    sub.add_argument("--curve", type=_counts, default=(), metavar="K,K,...",
                     help="also compute the equal error rate for these numbers of modes")  # fmt: skip
    sub.add_argument("--by", metavar="COLUMN", help="also report results for each value of this column of the probes")
    sub.set_defaults(run=run_verify)


def add_identify(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of identification."""
    _add_who(sub)
    sub.set_defaults(run=run_identify, curve=(), by=None)


def run_verify(arguments: argparse.Namespace) -> int:
    """Verify whether two scans are of one subject."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.verify import verify_report
    from shapespace.statistics.identity.verify import verify

    cohort, config = _cohort_and_config(arguments)
    with steps(None, "comparing", "draw", quiet=arguments.quiet) as step:
        result = verify(cohort, config, progress=step)
    return finish(verify_report(result), arguments)


def run_identify(arguments: argparse.Namespace) -> int:
    """Identify the subject of a scan among the enrolled ones."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.identify import identify_report
    from shapespace.statistics.identity.identify import identify

    cohort, config = _cohort_and_config(arguments)
    with steps(None, "searching", "score", quiet=arguments.quiet) as step:
        result = identify(cohort, config, progress=step)
    return finish(identify_report(result), arguments)


def _add_who(sub: argparse.ArgumentParser) -> None:
    add_cohort(sub, "coefficients")
    sub.add_argument("--subject", default="subject", metavar="COLUMN",
                     help="column of the subjects (default: subject)")  # fmt: skip
    sub.add_argument("--gallery", metavar="EXPR",
                     help="scans to enrol, such as expression=neutral or session!=2,3 (default: verify compares all "
                     "scans with all, identify enrols the first scan of each subject)")  # fmt: skip
    sub.add_argument("--probe", metavar="EXPR", help="scans to compare with the gallery (default: all others)")
    sub.add_argument("--train", metavar="EXPR", help="training scans (default: the subjects of the other folds)")
    sub.add_argument("--role", metavar="COLUMN",
                     help="column with gallery, probe or train for each scan, instead of expressions (default: role, "
                     "if the table has it)")  # fmt: skip
    sub.add_argument(
        "--folds", type=int, metavar="N", help="folds of subjects; the others train the scores (default 4)"
    )
    sub.add_argument("--scores", type=_names, metavar="LIST",
                     help="scores among plda, cosine, mahalanobis and distance; the summary reports the first "
                     "(default: all)")  # fmt: skip
    sub.add_argument("--modes", type=int, metavar="K", help="number of leading coefficients to use (default: all)")
    sub.add_argument("--no-uncertainty", action="store_true", help="ignore the uncertainty of the fits")
    sub.add_argument("--draws", type=int, default=1000, metavar="N",
                     help="bootstrap draws of subjects, for intervals (default 1000)")  # fmt: skip
    sub.add_argument("--seed", type=int, default=0, metavar="S", help="seed of folds and draws (default 0)")


def _cohort_and_config(arguments: argparse.Namespace) -> tuple[Cohort, IdentityConfig]:
    from shapespace.statistics.identity.trial import IdentityConfig

    cohort = cohort_of(arguments, "shape")
    if arguments.surfaces != "coefficients":
        cohort = replace(cohort, fitted=None)
    chosen: dict[str, Any] = {} if arguments.scores is None else {"scores": arguments.scores}
    config = IdentityConfig(
        subject=arguments.subject,
        gallery=arguments.gallery,
        probe=arguments.probe,
        train=arguments.train,
        role=arguments.role,
        folds=arguments.folds,
        modes=arguments.modes,
        curve=arguments.curve,
        by=arguments.by,
        uncertainty=not arguments.no_uncertainty,
        draws=arguments.draws,
        seed=arguments.seed,
        drop_missing=arguments.drop_missing,
        **chosen,
    )
    return cohort, config


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _counts(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers of modes such as 2,5,10, not {text!r}") from None
