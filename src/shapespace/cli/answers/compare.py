"""`shapespace compare`: linear models of shape on groups and covariates."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, finish


def run(arguments: argparse.Namespace) -> int:
    """Compare the shapes of a cohort."""
    from shapespace.batch.progress import steps
    from shapespace.report.analyses.compare_report import compare_report
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
