"""An option of the command line that is not given means the default of the Python interface."""

import dataclasses
import importlib
import inspect
from collections.abc import Mapping
from typing import Any

import pytest

from shapespace.cli.arguments import parser
from shapespace.cli.command_table import COMMANDS
from shapespace.cli.options import NO_DEFAULT, Option, Source, given
from shapespace.model.build_model import BuildConfig

JUSTIFIED = {
    ("fit", "search"): (
        "auto",
        "means that search was not given, as another method than paper has no such setting",
    ),
    ("regress", "curve"): (None, "means that curve was not given, as --target takes none"),
}
"""Options whose default differs from that of the field: the default, and the reason."""
OPTIONS = [
    (command.name, option)
    for command in COMMANDS
    for option in (*command.options, *command.settings)
    if option.source is not None and not option.required
]


def defaults_of(source: Source) -> Mapping[str, Any]:
    """Return the defaults of a configuration class or a function, by field."""
    taker = getattr(importlib.import_module(f"shapespace.{source.module}"), source.name)
    if not dataclasses.is_dataclass(taker):
        return {name: part.default for name, part in inspect.signature(taker).parameters.items()}
    made = {field.name: field.default_factory for field in dataclasses.fields(taker)}
    return {
        field.name: field.default if made[field.name] is dataclasses.MISSING else made[field.name]()
        for field in dataclasses.fields(taker)
    }


@pytest.mark.parametrize(("command", "option"), OPTIONS, ids=lambda value: getattr(value, "names", value))
def test_an_option_that_is_not_given_means_the_default_of_the_field(command: str, option: Option) -> None:
    assert option.source is not None
    if option.initial is NO_DEFAULT:
        return  # nothing is passed on, so the class sets its default itself
    if option.is_flag:
        return  # only a flag that is given is passed on
    expected = defaults_of(option.source)[option.field_name]
    if expected is inspect.Parameter.empty:
        return  # Python has no default
    if (command, option.names) in JUSTIFIED:
        assert option.initial == JUSTIFIED[command, option.names][0] != expected
    else:
        assert (tuple(option.initial) if option.repeat else option.initial) == expected


def test_only_flags_that_are_given_are_passed_on() -> None:
    plain, streamed = (parser().parse_args(["build", "a", "-o", "m.h5", *more]) for more in ([], ["--out-of-core"]))
    assert "out_of_core" not in given(plain, BuildConfig)
    assert given(streamed, BuildConfig)["out_of_core"] is True
