"""The parser of the command line, built from the table of commands."""

from __future__ import annotations

import argparse
import difflib
import itertools
import textwrap
from collections.abc import Sequence
from functools import partial
from typing import Any

from shapespace.cli.command_table import COMMANDS, GROUPS, CommandSpec
from shapespace.cli.dispatch import run_command
from shapespace.cli.options import Container, Option, apply_settings
from shapespace.version import __version__


def parser(kind: type[CommandParser] | None = None) -> argparse.ArgumentParser:
    """Return the parser of all commands; `kind` is its class."""
    top = (kind or CommandParser)(
        prog="shapespace",
        description="Statistical shape models from raw 3-D scans: correspondence, model building, robust fitting and "
        "shape statistics.",
    )
    top.add_argument("--version", action="version", version=f"shapespace {__version__}")
    parents = {"": top.add_subparsers(required=True, metavar="COMMAND")}
    for command in COMMANDS:
        group, _, name = command.name.rpartition(" ")
        if group not in parents:
            names = [other.name.removeprefix(f"{group} ") for other in COMMANDS if other.name.startswith(f"{group} ")]
            sub = parents[""].add_parser(group, help=GROUPS[group], description=_sentence(GROUPS[group]))
            parents[group] = sub.add_subparsers(required=True, metavar="|".join(names))
        parents[group].add_parser(name, help=command.summary, command=command)
    return top


class CommandParser(argparse.ArgumentParser):
    """The parser of a command, whose options are added on first use.

    Args:
        command: the command; None for a parser of commands.
        **keywords: See `argparse.ArgumentParser`.
    """

    def __init__(self, *, command: CommandSpec | None = None, **keywords: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **keywords)
        self._command = command

    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, args: Any = None, namespace: Any = None
    ) -> Any:
        """Parse arguments after adding the options."""
        self._add_options(help_level="basic")
        # Before the check of required options; the parser of all commands would print another usage.
        if self._command:
            known = [name for name in self._option_string_actions if name.startswith("--")]
            for text in itertools.takewhile(lambda text: text != "--", args):
                option = text.partition("=")[0]
                if option.startswith("--") and not any(name.startswith(option) for name in known):
                    name = option.removeprefix("--").replace("-", "_")
                    if name in [setting.names for setting in self._command.settings]:
                        self.error(f"there is no option {option}; write --set {name}=VALUE")
                    self.error(f"there is no option {option}{_suggestion(option, known)}")
        parsed, unknown = super().parse_known_args(args, namespace)
        if unknown and self._command:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        if self._command and self._command.settings:
            try:
                apply_settings(parsed, self._command.settings)
            except argparse.ArgumentTypeError as error:
                self.error(str(error))
        return parsed, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Reject an unknown command, and suggest the command with the nearest name."""
        names: list[str] = list(action.choices or ()) if action.metavar and not action.option_strings else []
        if self._command is None and names and value not in names:
            raise argparse.ArgumentError(
                None, f"there is no command {value!r}{_suggestion(value, names)} (commands: {', '.join(names)})"
            )
        super()._check_value(action, value)

    def format_help(self, *, everything: bool = False) -> str:
        """Return the help: basic options, or all."""
        if everything and self._command:
            full = CommandParser(prog=self.prog, command=self._command)
            full._add_options(help_level="all")
            return full.format_help()
        self._add_options(help_level="basic")
        return super().format_help()

    def _add_options(self, help_level: str) -> None:
        command = self._command
        if command is None or self.description is not None:
            return
        self.set_defaults(run=partial(run_command, command.run), command=command, **command.defaults)
        more = sum(not option.basic for option in command.options)
        self.usage, self.description = command.usage, _sentence(command.summary)
        self.epilog = "example: " + "\n         ".join(command.examples)
        if help_level == "all":
            self.description += "".join(f"\n\n{textwrap.fill(text, 78)}" for text in command.details)
            self.epilog += _settings_text(command.settings)
        elif more:
            self.epilog += f"\n\n{more} more options: {self.prog} --help-all"
        self.add_argument("--help-all", action=_HelpAll, help="show all options and exit")
        self._add_group(command.options, help_level)

    def _add_group(self, options: Sequence[Option], help_level: str) -> None:
        advanced = self.add_argument_group("advanced options")
        exclusive: dict[str, Container] = {}
        for option in options:
            group: Container = self if option.basic else advanced
            if option.either:
                if option.either not in exclusive:
                    exclusive[option.either] = group.add_mutually_exclusive_group(required=option.required)
                group = exclusive[option.either]
            option.add_to(group, in_help=option.basic or help_level == "all")


class _HelpAll(argparse.Action):
    """Prints the help with all options."""

    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:
        super().__init__(option_strings, argparse.SUPPRESS, nargs=0, default=argparse.SUPPRESS, help=help)

    def __call__(self, parser: Any, *_: Any, **__: Any) -> None:
        """Print it, and end."""
        print(parser.format_help(everything=True), end="")
        parser.exit()


def _settings_text(settings: Sequence[Option]) -> str:
    """Return the list of settings at the end of the help; empty for none."""
    texts = [f"{setting.names}={setting.value_name}: {setting.text}".replace("`", "") for setting in settings]
    rows = [textwrap.fill(text, 78, subsequent_indent="    ") for text in texts]
    return "".join(["\n\nsettings (--set NAME=VALUE):", *(f"\n  {row}" for row in rows)] if rows else [])


def _suggestion(text: str, known: Sequence[str]) -> str:
    nearest = difflib.get_close_matches(text, known, 1)
    return f"; did you mean {nearest[0]}?" if nearest else ""


def _sentence(summary: str) -> str:
    return f"{summary[0].upper()}{summary[1:]}."
