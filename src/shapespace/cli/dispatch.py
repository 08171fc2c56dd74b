"""Calls the function of a command with the values of its options, and prints its outcome."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_type_hints

from shapespace.cli.options import given
from shapespace.cli.printing import show_outcome, warn
from shapespace.commands.outcome import Outcome


def run_command(name: str, arguments: argparse.Namespace) -> int:
    """Run a command and return its exit code.

    Args:
        name: module and name of its function, without `shapespace.`; it returns an `Outcome`, or an exit code if it
            prints itself.
        arguments: parsed arguments.
    """
    if arguments.command.has_workers:
        _start_workers(arguments)
    function = resolve_name(f"shapespace.{name}")
    outcome: Outcome | int = function(**_parameter_values(arguments, function))
    return outcome if isinstance(outcome, int) else show_outcome(outcome, as_json=arguments.json)


def _parameter_values(arguments: argparse.Namespace, function: Callable[..., object]) -> dict[str, Any]:
    """Return the values of the parameters of a function.

    A parameter of a configuration class is an instance made from its options, that for messages is `printing.warn`,
    `arguments` are all arguments, and other parameters have the names of options.
    """
    kinds: dict[str, type[Any]] = get_type_hints(function)
    values = {"say": warn, "arguments": arguments, **vars(arguments), **given(arguments, function)}
    configurations = {name: kind for name, kind in kinds.items() if is_dataclass(kind) and name != "return"}
    values |= {name: kind(**given(arguments, kind)) for name, kind in configurations.items()}
    return {name: values[name] for name in kinds if name in values}


def _start_workers(arguments: argparse.Namespace) -> None:
    """Load the code of the workers while this process loads its own, which takes half of the start of many scans."""
    one = len(arguments.scans) == 1 and Path(arguments.scans[0]).is_file()
    if not one and arguments.jobs != 1 and arguments.executor == "local":
        from shapespace.batch.workers import start_loading

        start_loading(notify=not arguments.quiet)
