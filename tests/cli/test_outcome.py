"""A command's function gets the values of its options by name, and what it returns is printed by one function."""

import inspect
from dataclasses import is_dataclass
from pkgutil import resolve_name
from typing import get_type_hints

import pytest

from shapespace.cli.command_table import COMMANDS, CommandSpec
from shapespace.cli.printing import show_outcome
from shapespace.commands.outcome import Aside, Outcome, exit_code_of, first_lines


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.name)
def test_each_parameter_of_a_command_is_an_option(command: CommandSpec) -> None:
    function = resolve_name(f"shapespace.{command.run}")
    kinds = get_type_hints(function)
    options = (*command.options, *command.settings)
    known = {option.attribute for option in options} | {"say", "arguments"}
    known |= {option.field_name for option in options if option.source and option.source.name == function.__name__}
    for name, parameter in inspect.signature(function).parameters.items():
        assert name in known or is_dataclass(kinds[name]) or parameter.default is not parameter.empty, name


def test_an_outcome_is_printed_as_lines_or_as_facts(capsys: pytest.CaptureFixture[str]) -> None:
    outcome = Outcome({"n": float("nan")}, ["one", Aside("aside"), "tw\no"], ["note"], ["error"], exit_code=1)
    assert show_outcome(outcome, as_json=False) == 1
    printed = capsys.readouterr()
    assert printed.out == "one\ntw\\no\n" and printed.err == "note\naside\nerror\n"
    assert show_outcome(outcome, as_json=True) == 1
    printed = capsys.readouterr()
    assert printed.out == '{\n "n": null\n}\n' and printed.err == "note\nerror\n"


def test_the_first_ten_are_listed_and_the_others_counted() -> None:
    assert first_lines(range(10), lambda k: [str(k)]) == [str(k) for k in range(10)]
    assert first_lines(range(12), lambda k: [str(k)], "more scans")[10:] == ["and 2 more scans"]


@pytest.mark.parametrize(("failed", "every", "code"), [(0, 0, 0), (0, 3, 0), (1, 3, 1), (3, 3, 2)])
def test_the_exit_code_says_whether_some_or_all_failed(failed: int, every: int, code: int) -> None:
    assert exit_code_of(failed, every) == code
