"""The commands that run in the browser until they are stopped."""

from __future__ import annotations

import argparse

from shapespace.cli.forms import forms
from shapespace.cli.options import given
from shapespace.cli.printing import now
from shapespace.viewer.serve import serve, serve_studio


def view(arguments: argparse.Namespace) -> int:
    """Show a result or a project in the browser."""
    options = given(arguments, serve)
    serve(
        arguments.path,
        **options,
        open_browser=not arguments.no_open,
        forms=lambda: forms(arguments.commands()),
        say=now,
    )
    return 0


def studio(arguments: argparse.Namespace) -> int:
    """Run the studio in the browser."""
    options = given(arguments, serve_studio)
    serve_studio(arguments.project, forms(arguments.commands()), **options, open_browser=not arguments.no_open, say=now)
    return 0
