"""The command `export`: fits as files, or a cohort as files of another program."""

from __future__ import annotations

import argparse

from shapespace.cli.answers import cohort_of
from shapespace.cli.options import given
from shapespace.cli.printing import warn
from shapespace.commands.export import export as export_fits
from shapespace.commands.export import export_cohort
from shapespace.commands.outcome import Outcome
from shapespace.errors import InputError


def export(arguments: argparse.Namespace) -> Outcome:
    """Write fits of a store as single files, or all of them as a table; with `--to`, the shapes of a cohort.

    Raises:
        InputError: options of both.
    """
    if arguments.to is None and arguments.formula is None:
        return export_fits(
            arguments.store, arguments.names, arguments.output, every=arguments.all, table=arguments.table,
            quiet=arguments.quiet, say=warn,
        )  # fmt: skip
    if arguments.names or arguments.all or arguments.table is not None:
        raise InputError("--to exports all shapes of DATA; leave out names, --all and --table.")
    if arguments.formula is not None and arguments.to != "geomorph":
        raise InputError("--formula is the model of the script for geomorph; give --to geomorph too.")
    arguments.data = arguments.store
    return export_cohort(cohort_of(arguments), arguments.output, **given(arguments, export_cohort))
