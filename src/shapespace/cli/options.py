"""Options of commands, generated from the configuration classes and functions that the Python interface uses.

The help, type, choices and default of a field are read from the source text of its class, not from the class itself:
importing the modules of the configuration classes takes seconds, and `--help` must take a fraction of a second.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import pkgutil
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias, cast

from shapespace.cli import values

Container: TypeAlias = argparse._ActionsContainer  # pyright: ignore[reportPrivateUsage]
"""A parser, or a group of its options."""
NO_DEFAULT = argparse.SUPPRESS
"""Default of a field whose value is not a literal: the class or the function sets it."""
_PARSERS: dict[str, Callable[[str], Any]] = {
    "int": values.natural,
    "float": values.number,
    "str": str,
    "Path": Path,
    "tuple[str, ...]": values.words,
    "tuple[int, ...]": values.counts,
    "bool": values.yes_or_no,
}
"""Annotation -> parser of its values."""


@dataclass(frozen=True)
class Field:
    """A field of a configuration class, or a parameter of a function.

    Args:
        help: text of the field in the docstring.
        kinds: types of its annotation, without None.
        choices: values of a `Literal`, else empty.
        default: the default if it is a literal, None without a default, else `NO_DEFAULT`.
    """

    help: str
    kinds: tuple[str, ...]
    choices: tuple[str, ...]
    default: Any


@dataclass(frozen=True)
class Source:
    """A configuration class or a function whose fields or parameters are options.

    Args:
        module: module of the class or function, without `shapespace.`.
        name: name of the class or function in its module.
    """

    module: str
    name: str

    def field(self, name: str) -> Field:
        """Return a field by its name."""
        return _read_fields(self)[name]


@dataclass(frozen=True)
class Option:
    """An argument of a command: positional, an option with a value, or a flag.

    Args:
        names: spellings, such as `-o --output`; one word without dashes is a positional argument.
        metavar: name of its value; empty for a flag, or for a choice.
        help: help text; empty for the text of the field.
        source: class or function that takes the value; None for an option of the command line alone.
        field: field of `source`; empty for the long spelling in the form of a field.
        basic: whether `--help` lists it.
        parse: parser of the value; None for the parser of the field's type.
        choices: accepted values; empty for those of the field.
        default: default; `NO_DEFAULT` for the default of the field.
        required: whether it must be given.
        nargs: number of values, see `nargs` of argparse.
        repeat: whether it can be given several times.
        dest: attribute of the parsed arguments; empty for the long spelling.
        either: name of a group of options of which only one can be given; one must, if they are `required`.
        setting: whether it is given as `--set NAME=VALUE`; its only spelling is NAME.
    """

    names: str
    metavar: str = ""
    help: str = ""
    source: Source | None = None
    field: str = ""
    basic: bool = True
    parse: Callable[[str], Any] | None = None
    choices: tuple[str, ...] = ()
    default: Any = NO_DEFAULT
    required: bool = False
    nargs: str | None = None
    repeat: bool = False
    dest: str = ""
    either: str = ""
    setting: bool = False

    @property
    def spellings(self) -> list[str]:
        """All spellings, the short one first."""
        return self.names.split()

    @property
    def is_positional(self) -> bool:
        """Whether it is given without a name."""
        return not (self.setting or self.names.startswith("-"))

    @property
    def attribute(self) -> str:
        """The attribute of the parsed arguments that contains its value."""
        long = next((name for name in self.spellings if name.startswith("--")), self.names)
        return self.dest or long.lstrip("-").replace("-", "_")

    @property
    def field_name(self) -> str:
        """The name of the field that takes the value."""
        return self.field or self.attribute.removeprefix("no_")

    @property
    def negates(self) -> bool:
        """Whether it is a flag that sets a field to False."""
        return self.attribute.startswith("no_") and self.source is not None

    @property
    def is_flag(self) -> bool:
        """Whether it takes no value."""
        return not (self.setting or self.is_positional or self.metavar or self.accepted)

    @property
    def accepted(self) -> tuple[str, ...]:
        """Choices of the option; empty if it accepts all values that can be parsed."""
        return self.choices or (self._field.choices if self._field and not self.parse and not self.metavar else ())

    @property
    def value_name(self) -> str:
        """The name of its value, or the values that it accepts."""
        return self.metavar or "|".join(self.accepted) or ("yes|no" if self.setting else "")

    @property
    def initial(self) -> Any:
        """Its value if it is not given, or `NO_DEFAULT`."""
        if self.is_flag or self.default is not NO_DEFAULT:
            return False if self.is_flag else self.default
        return self._field.default if self._field else ([] if self.repeat else None)

    @property
    def text(self) -> str:
        """Its help, with the default if the text does not state it."""
        text = self.help or (self._field.help if self._field else "")
        if not self.initial_text or "(default" in text or self.required:
            return text
        return f"{text} (default: {self.initial_text})"

    @property
    def initial_text(self) -> str:
        """Its value if it is not given, as text; empty for a flag, and if the class or the function sets it."""
        initial = self.initial
        if self.is_flag or initial in (NO_DEFAULT, None, "", (), []):
            return ""
        words = cast(Sequence[Any], initial) if isinstance(initial, tuple) else (initial,)
        texts = ({True: "yes", False: "no"}[word] if isinstance(word, bool) else str(word) for word in words)
        return (" " if self.nargs else ",").join(texts)

    @property
    def _field(self) -> Field | None:
        return self.source.field(self.field_name) if self.source else None

    def add_to(self, group: Container, *, in_help: bool) -> None:
        """Add it to a parser or a group of a parser; `in_help` is whether its help text is shown."""
        text = self.text.replace("%", "%%").replace("`", "")
        keywords: dict[str, Any] = {"help": text if in_help else argparse.SUPPRESS}
        if self.is_flag:
            group.add_argument(*self.spellings, action="store_true", dest=self.attribute, **keywords)
            return
        if not self.is_positional:
            keywords |= {"required": self.required and not self.either, "dest": self.attribute}
        if self.repeat:
            keywords["action"] = "append"
        if self.nargs:
            keywords["nargs"] = self.nargs
        if self.accepted:
            keywords["choices"] = self.accepted
        keywords |= {"type": self.parse or self._find_parser(), "default": self.initial}
        group.add_argument(*self.spellings, metavar=self.metavar or None, **keywords)

    def parse_value(self, text: str) -> Any:
        """Return the value of a text.

        Raises:
            ArgumentTypeError: the option does not accept the text.
        """
        if self.accepted and text not in self.accepted:
            raise argparse.ArgumentTypeError(f"is {text!r}; choose from {', '.join(self.accepted)}")
        return (self.parse or self._find_parser())(text)

    def _find_parser(self) -> Callable[[str], Any]:
        kinds = self._field.kinds if self._field else ()
        return next((_PARSERS[kind] for kind in kinds if kind in _PARSERS), str)


basic = Option
"""An option that `--help` lists."""
advanced = partial(Option, basic=False)
"""An option that only `--help-all` lists."""
setting = partial(Option, basic=False, setting=True)
"""A value that is given as `--set NAME=VALUE`."""


def apply_settings(arguments: argparse.Namespace, settings: Sequence[Option]) -> None:
    """Set the attributes of parsed arguments to the values of `--set NAME=VALUE`.

    Args:
        arguments: parsed arguments; `chosen` becomes the names of the settings that are given.
        settings: settings of the command.

    Raises:
        ArgumentTypeError: a setting that the command does not have, or a value that it does not accept.
    """
    known = {option.names: option for option in settings}
    for option in settings:
        if option.initial is not NO_DEFAULT:
            setattr(arguments, option.attribute, option.initial)
    given_texts: list[str] = arguments.set or []
    for text in given_texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise argparse.ArgumentTypeError(f"argument --set: {text!r} is not NAME=VALUE")
        if name not in known:
            options: Sequence[Option] = arguments.command.options
            spelling = next(
                (option.spellings[-1] for option in options if option.attribute == name.replace("-", "_")), ""
            )
            if spelling.startswith("--"):
                raise argparse.ArgumentTypeError(f"argument --set: {name} is an option; write {spelling} {value}")
            nearest = difflib.get_close_matches(name, list(known), 1) or sorted(known)
            raise argparse.ArgumentTypeError(
                f"argument --set: there is no setting {name!r}; choose {', '.join(nearest)}"
            )
        option = known[name]
        try:
            setattr(arguments, option.attribute, option.parse_value(value))
        except argparse.ArgumentTypeError as error:
            raise argparse.ArgumentTypeError(f"argument --set: {name} {error}") from None
    arguments.chosen = frozenset(text.partition("=")[0].strip() for text in given_texts)


def given(arguments: argparse.Namespace, taker: Callable[..., Any], **instead: Any) -> dict[str, Any]:
    """Return the values of the options that a configuration class or a function takes, by the names of its fields.

    Args:
        arguments: parsed arguments.
        taker: the class or the function.
        instead: values of some fields that the command line computes.
    """
    chosen: dict[str, Any] = {}
    for option in (*arguments.command.options, *arguments.command.settings):
        if option.source is not None and option.source.name == taker.__name__ and hasattr(arguments, option.attribute):
            value = getattr(arguments, option.attribute)
            if option.is_flag and not value:
                continue  # the class sets its default, which may be automatic
            chosen[option.field_name] = not value if option.negates else value
    return {**chosen, **instead}


# Reading of source text


@cache
def _parse_module(module: str) -> ast.Module:
    source = pkgutil.get_data("shapespace", f"{module.replace('.', '/')}.py")
    assert source is not None, module
    return ast.parse(source)


@cache
def _read_fields(source: Source) -> Mapping[str, Field]:
    """Return the fields of a class, or the parameters of a function, by name."""
    [node] = [
        node
        for node in _parse_module(source.module).body
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == source.name
    ]
    texts = _read_texts(ast.get_docstring(node) or "")
    definitions: dict[str, tuple[ast.expr | None, ast.expr | None]] = {}
    if isinstance(node, ast.ClassDef):
        for part in node.body:
            if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                definitions[part.target.id] = part.annotation, part.value
    else:
        plain, keyword = node.args.args, node.args.kwonlyargs
        defaults = [*[None] * (len(plain) - len(node.args.defaults)), *node.args.defaults, *node.args.kw_defaults]
        definitions = {
            parameter.arg: (parameter.annotation, default)
            for parameter, default in zip([*plain, *keyword], defaults, strict=True)
        }
    return {
        name: Field(texts.get(name, ""), *_types_and_choices(source.module, annotation), _evaluate_literal(default))
        for name, (annotation, default) in definitions.items()
    }


def _read_texts(docstring: str) -> dict[str, str]:
    """Return the texts of a docstring's section Args by name."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", docstring, re.MULTILINE | re.DOTALL)
    entries = re.findall(r"^    (\w+): (.*?)(?=^    \w|\Z)", section[1] if section else "", re.MULTILINE | re.DOTALL)
    lines = {name: " ".join(text.split()).removesuffix(".") for name, text in entries}
    return {name: re.sub(r" \(in Python [^()]*\)", "", line) for name, line in lines.items()}


def _evaluate_literal(node: ast.expr | None) -> Any:
    try:
        return None if node is None else ast.literal_eval(node)
    except ValueError:
        return NO_DEFAULT


def _types_and_choices(module: str, annotation: ast.expr | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the types of an annotation, and the values of a `Literal` in it."""
    parts = [annotation]
    while isinstance(parts[0], ast.BinOp):
        parts[:1] = [parts[0].left, parts[0].right]
    kinds = [ast.unparse(part) for part in parts if part is not None]
    choices: tuple[str, ...] = ()
    for part in parts:
        literal = _resolve_alias(module, part.id) if isinstance(part, ast.Name) else part
        if isinstance(literal, ast.Subscript) and ast.unparse(literal.value) == "Literal":
            value = ast.literal_eval(literal.slice)
            choices += value if isinstance(value, tuple) else (value,)
    return tuple(kind for kind in kinds if kind != "None"), choices


@cache
def _resolve_alias(module: str, name: str) -> ast.expr | None:
    """Return the definition of a name in a module, followed through its imports from this package."""
    for node in ast.walk(_parse_module(module)):
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id == name:
            return node.value
        if isinstance(node, ast.ImportFrom) and name in [imported.name for imported in node.names]:
            package, _, home = (node.module or "").partition(".")
            return _resolve_alias(home, name) if package == "shapespace" else None
    return None
