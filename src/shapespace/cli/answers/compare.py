"""`shapespace compare`: linear models of shape on groups and covariates."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import add_cohort, add_gauge, cohort_of, finish


def add(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_cohort(sub)
    sub.add_argument("--formula", required=True, metavar="FORMULA",
                     help="linear model of shape, such as '~ sex + age'; size and log_size are available "
                     "too")  # fmt: skip
    sub.add_argument("--blocks", metavar="COLUMN",
                     help="column of the subjects, if subjects have several scans")  # fmt: skip
    sub.add_argument("--random", metavar="TERMS",
                     help="random effects: those within subjects that differ between subjects, such as '1 + time | "
                     "subject' (default with --blocks: all)")  # fmt: skip
    sub.add_argument("--type", choices=("I", "II", "III"), default="II", dest="anova_type",
                     help="type of the sums of squares (default II: each term after all terms that do not contain "
                     "it)")  # fmt: skip
    sub.add_argument("--permutations", type=int, default=1000, metavar="N",
                     help="number of permutations, including the observed data (default 1000)")  # fmt: skip
    sub.add_argument("--seed", type=int, default=0, metavar="S", help="seed of the permutations (default 0)")
    sub.add_argument("--level", type=float, default=0.05, metavar="P", help="level of significance (default 0.05)")
    sub.add_argument("--unequal-variances", action="store_true",
                     help="allow classes of unequal dispersion: a variance for each subject, and sign "
                     "flips")  # fmt: skip
    sub.add_argument("--effect-size", choices=("box-cox", "log"), default="box-cox",
                     help="transformation of F in the effect size Z (default box-cox, as in RRPP)")  # fmt: skip
    sub.add_argument("--no-maps", action="store_true", help="skip the tests of each vertex")
    sub.add_argument("--bumps", type=float, metavar="MM",
                     help="of fits: also search for bumps of this width beyond the variation between "
                     "shapes")  # fmt: skip
    add_gauge(sub)
    sub.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Compare the shapes of a cohort."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.compare import compare_report
    from shapespace.statistics.compare import CompareConfig, compare

    config = CompareConfig(
        anova_type=arguments.anova_type,
        blocks=arguments.blocks,
        random=arguments.random,
        permutations=arguments.permutations,
        seed=arguments.seed,
        maps=not arguments.no_maps,
        bump_width_mm=arguments.bumps,
        alpha=arguments.level,
        drop_missing=arguments.drop_missing,
        unequal_variances=arguments.unequal_variances,
        effect_size=arguments.effect_size,
    )
    cohort = cohort_of(arguments)
    with steps(None, "permuting", "step", quiet=arguments.quiet) as step:
        result = compare(cohort, arguments.formula, config, progress=step)
    return finish(compare_report(result), arguments)
