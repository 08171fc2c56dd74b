"""Forms of the commands for the studio, made of the table of commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

from shapespace.cli.options import NO_DEFAULT, Option
from shapespace.formats.registry import MODEL_FORMATS

_KINDS: Mapping[str, str] = {"identify": "recognise identify"}
_FIRST: Mapping[str, tuple[str, ...]] = {
    "correspond": ("--vertices", "--mirror", "--pose"),
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
    {
        "--output", "--shapes", "--model", "--reference-shapes", "--table", "--labels", "--template", "--subjects",
        "--add", "--redo", "--remove", "--update", "--recursive", "--dask", "--executor", "--predictor", "--predict",
        "--new-shapes", "--no-open", "--json", "--quiet", "--all", "--groups", "--surfaces",
    }
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
        made[kind] = {"command": tuple(command.split()), **_form(*commands[command], first)}
    made["convert"]["options"][0] |= {"kind": "choice", "choices": list(MODEL_FORMATS)}
    made["score"]["options"][0] |= {"kind": "class", "help": "class that the others are compared with"}
    return made


def _form(summary: str, options: Sequence[Option], first: tuple[str, ...]) -> dict[str, Any]:
    offered = [option for option in options if not option.is_positional and not _FILES & set(option.spellings)]
    order = {flag: place for place, flag in enumerate(first)}
    described = [_described(option, visible=option.spellings[-1] in order) for option in offered]
    described.sort(key=lambda one: order.get(one["flag"], len(order)))
    return {"summary": summary, "options": described}


def _described(option: Option, *, visible: bool) -> dict[str, Any]:
    initial = option.initial
    known = initial is not NO_DEFAULT and initial not in (None, (), [], "") and not option.is_flag
    words = " ".join(map(str, cast(tuple[Any, ...], initial))) if isinstance(initial, tuple) else str(initial)
    return {
        "flag": option.spellings[-1], "help": option.text.replace("`", ""), "kind": _kind(option),
        "choices": list(option.accepted), "initial": words if known else None, "visible": visible,
        "required": (option.required and not option.either) or option.spellings[-1] == "--to",
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
