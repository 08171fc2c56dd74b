"""Options are those of the classes and functions that take them, and help lists the basic ones first."""

import argparse
import contextlib
import dataclasses
import importlib
import inspect
import io
import time
from typing import Any

import pytest

from conftest import Run
from shapespace import cli
from shapespace.cli import command_table
from shapespace.cli.command_table import COMMANDS, CommandSpec
from shapespace.cli.options import NO_DEFAULT, Option, Source
from shapespace.cli.values import number

SOURCES = [value for value in vars(command_table).values() if isinstance(value, Source)]
MOST_BASIC = 10


def printed(*arguments: str) -> str:
    out = io.StringIO()
    with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as ended:
        cli.main(list(arguments))
    assert ended.value.code == 0
    return out.getvalue()


def listed(help_text: str) -> set[str]:
    """Return the long spellings that a help lists."""
    rows = [line for line in help_text.splitlines() if line.startswith("  -")]
    return {word.rstrip(",") for row in rows for word in row.strip().split("  ")[0].split() if word.startswith("--")}


def long_names(options: list[Option]) -> set[str]:
    return {name for option in options for name in option.spellings if name.startswith("--")}


@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.name)
def test_fields_read_from_source_text_are_those_of_the_imported_class_or_function(source: Source) -> None:
    taker: Any = getattr(importlib.import_module(f"shapespace.{source.module}"), source.name)
    defaults = {name: one.default for name, one in inspect.signature(taker).parameters.items()}
    used = [o for command in COMMANDS for o in (*command.options, *command.settings) if o.source == source]
    assert used, "no option uses this source"
    for option in used:
        field = source.field(option.field_name)
        assert option.field_name in defaults
        if field.default is not NO_DEFAULT:
            default = defaults[option.field_name]
            assert field.default == (None if default is inspect.Parameter.empty else default)
        if dataclasses.is_dataclass(taker):
            assert option.field_name in {one.name for one in dataclasses.fields(taker)}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_help_lists_at_most_ten_options_and_help_all_the_others(command: CommandSpec) -> None:
    basic = [o for o in command.options if o.basic and not o.is_positional]
    every = [o for o in command.options if not o.is_positional]
    assert len(basic) <= MOST_BASIC
    help_options = {"--help", "--help-all"}
    text = printed(*command.name.split(), "--help")
    assert listed(text) == long_names(basic) | help_options
    assert (f"shapespace {command.name} --help-all" in text) == (len(every) > len(basic))
    assert listed(printed(*command.name.split(), "--help-all")) == long_names(every) | help_options


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_every_option_has_a_help_text(command: CommandSpec) -> None:
    assert all(option.text for option in (*command.options, *command.settings))


def test_an_option_of_no_command_is_refused_with_the_usage_of_the_command(run: Run) -> None:
    outcome = run("fit", "model.h5", "scan.ply", "-o", "out", "--nonsense")
    assert outcome.code == 2 and outcome.err.startswith("usage: ") and "--nonsense" in outcome.err


def test_help_of_all_commands_takes_less_than_a_second_each() -> None:
    for command in COMMANDS:
        start = time.process_time()
        printed(*command.name.split(), "--help-all")
        assert time.process_time() - start < 1.0, command.name


@pytest.mark.parametrize(
    ("arguments", "usage", "sentence"),
    [
        (("buidl", "faces"), "usage: shapespace [-h]", "there is no command 'buidl'; did you mean build?"),
        (("landmarks", "convrt", "a"), "usage: shapespace landmarks", "'convrt'; did you mean convert?"),
        (("build", "faces", "--outpt", "m.h5"), "usage: shapespace build", "no option --outpt; did you mean --output?"),
        (("test", "pls", "x", "--permutatoins=9"), "usage: shapespace test pls", "did you mean --permutations?"),
        (("build", "faces", "-o", "m.h5", "--qqq"), "usage: shapespace build", "there is no option --qqq\n"),
        (("info", "m.h5", "-z"), "usage: shapespace info", "unrecognized arguments: -z"),
    ],
)
def test_a_misspelt_command_or_option_names_the_nearest_below_the_usage_of_its_command(
    run: Run, arguments: tuple[str, ...], usage: str, sentence: str
) -> None:
    outcome = run(*arguments)
    assert outcome.code == 2 and outcome.err.startswith(usage) and sentence in outcome.err


@pytest.mark.parametrize(("text", "value"), [("0,95", 0.95), ("0,125", 0.125), ("-1,5e-3", -1.5e-3), ("12.5", 12.5)])
def test_a_number_may_have_a_decimal_comma(text: str, value: float) -> None:
    assert number(text) == value


@pytest.mark.parametrize("text", ["1,000", "12,345", "1,2,3", "1.000,5", ","])
def test_a_number_that_could_be_a_thousand_or_a_list_is_rejected(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is not a number"):
        number(text)
