"""`shapespace complete`: the missing part of partial scans, with its distribution."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import finish
from shapespace.cli.options import given
from shapespace.cli.printing import warn


def run(arguments: argparse.Namespace) -> int:
    """Complete scans; 1 if some failed, 2 if all did."""
    from shapespace.commands.complete import CompletionFiles, complete_scans
    from shapespace.fit.completion.complete import CompletionConfig
    from shapespace.fit.fit_scan import FitConfig
    from shapespace.io.files import write_text
    from shapespace.report.analyses.analysis_report import METHODS_FILE
    from shapespace.report.analyses.completion_report import CompletionReport

    fit = FitConfig(**given(arguments, FitConfig))
    config = CompletionConfig(**given(arguments, CompletionConfig), fit=fit)
    files = CompletionFiles(**given(arguments, CompletionFiles))
    collected = CompletionReport(config)
    failed = complete_scans(
        arguments.model, arguments.scans, arguments.output, config, files, quiet=arguments.quiet, say=warn,
        on_completion=collected.add,
    )  # fmt: skip
    if not collected.count:
        return 2
    finish(collected.report(len(failed)), arguments)
    write_text(arguments.output / METHODS_FILE, collected.methods_text())
    return 1 if failed else 0
