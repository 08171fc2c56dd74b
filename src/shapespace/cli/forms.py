"""Forms of the commands for the studio, made from the table of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from shapespace.cli.options import Option
from shapespace.formats.registry import MODEL_FORMATS

_KINDS: Mapping[str, str] = {"identify": "recognise identify"}
_FIRST: Mapping[str, tuple[str, ...]] = {
    "correspond": ("--vertices", "--mirror", "--pose"),
    "figures": ("--format",),
    "build": ("--modes", "--gauge", "--unit"),
    "quality": ("--folds", "--samples", "--modes"),
    "morphospace": ("--method", "--group", "--gauge"),
    "fit": ("--dense", "--unit", "--stages"),
    "complete": ("--samples", "--mirror", "--stl"),
    "compare": ("--formula", "--blocks", "--permutations"),
    "change": ("--subject", "--time", "--order"),
    "asymmetry": ("--subject", "--reference", "--gauge"),
    "regress": ("--target", "--along", "--at", "--curve", "--covariates", "--subject"),
    "score": ("--reference", "--subject", "--nearest"),
    "identify": ("--subject", "--gallery", "--probe"),
    "convert": ("--to",),
    "export": (),
    "report": (),
}
"""Command -> the options that its form shows; the others are folded."""
_FILES = frozenset(
    f"--{name}"
    for name in (
        "output", "shapes", "model", "table", "labels", "template", "subjects", "add", "redo", "remove", "update",
        "recursive", "dask", "executor", "predictor", "predict", "no-open", "json", "quiet", "all", "groups",
        "surfaces", "set", "orientation",
    )
)  # fmt: skip
"""Options that the studio sets itself, or that name files."""


def forms(commands: Mapping[str, tuple[str, Sequence[Option]]]) -> dict[str, dict[str, Any]]:
    """Return kind -> the words and the summary of its command, and the options of its form.

    Args:
        commands: name -> summary and options, of all commands.
    """
    made: dict[str, dict[str, Any]] = {}
    for kind, first in _FIRST.items():
        command = _KINDS.get(kind, kind)
        made[kind] = {"command": tuple(command.split()), **_make_form(*commands[command], first)}
    made["convert"]["options"][0] |= {"kind": "choice", "choices": list(MODEL_FORMATS)}
    made["score"]["options"][0] |= {"kind": "class", "help": "class that the others are compared with"}
    return made


def _make_form(summary: str, options: Sequence[Option], first: tuple[str, ...]) -> dict[str, Any]:
    order = {flag: place for place, flag in enumerate(first)}
    offered = [option for option in options if not option.is_positional or option.metavar == "FORMULA"]
    described = [_describe_option(option, visible=_page_name(option) in order) for option in offered]
    described = [option for option in described if option["flag"] not in _FILES]
    described.sort(key=lambda one: order.get(one["flag"], len(order)))
    return {"summary": summary, "options": described}


def _page_name(option: Option) -> str:
    """Return the name of an option on the page, also of a setting and of a formula."""
    return f"--{option.names.replace('_', '-')}" if option.setting or option.is_positional else option.spellings[-1]


def _describe_option(option: Option, *, visible: bool) -> dict[str, Any]:
    choices = list(option.accepted) or (["yes", "no"] if option.value_name == "yes|no" else [])
    argument = f"--set {option.names}" if option.setting else "" if option.is_positional else option.spellings[-1]
    return {
        "flag": _page_name(option), "argument": argument, "help": option.text.replace("`", ""),
        "kind": "choice" if choices else _kind(option), "choices": choices,
        "initial": option.initial_text or None, "visible": visible,
        "required": (option.required and not option.either) or option.names in ("formula", "--to"),
    }  # fmt: skip


def _kind(option: Option) -> str:
    if option.is_flag:
        return "flag"
    if option.accepted:
        return "choice"
    if option.metavar == "FORMULA":
        return "formula"
    if option.metavar == "COLUMN":
        return "column"
    if option.metavar == "COLUMN=VALUE":
        return "class"
    return "number" if option.metavar in ("N", "K", "S", "M") else "text"
