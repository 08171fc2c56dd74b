"""The settings of fits in words: what was chosen first, and all numbers of the method folded away."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping, Sequence
from typing import Any, cast

from shapespace.fit.paper.paper_method import Paper
from shapespace.fit.robust.robust_settings import DenseSettings, ResidualSettings, RobustSettings
from shapespace.report.blocks.blocks import Block, Facts, Folded, text_table
from shapespace.report.blocks.wording import DASH, plain, words

_NOTHING: Mapping[str, Any] = {}
_CAPTION = "Settings and versions"
_OF: Mapping[str, type] = {
    "robust": RobustSettings, "paper": Paper, "dense_settings": DenseSettings, "residual": ResidualSettings,
}  # fmt: skip
_LEVEL = ("modes", "scan_points", "vertices", "triangles", "iterations", "stop_motion_mm")
_LEVEL_HEADS = (
    "Modes", "Points of the scan", "Vertices of the model", "Matched to", "Steps at most", "Stops below, mm",
)  # fmt: skip


def settings_blocks(configs: Sequence[Mapping[str, Any]], first: Sequence[tuple[str, str]]) -> list[Block]:
    """Return what fits ran with: choices as sentences, and the numbers of the method folded away.

    Args:
        configs: settings of each fit, from its record; they may be damaged.
        first: names and values that stand before them.
    """
    rows = list(first)
    for name, tell in _CHOICES:
        texts = list(dict.fromkeys(tell(config) for config in configs))
        if any(texts):
            rows.append((name, "; of others: ".join(texts[:4])))
    out: list[Block] = [Facts(rows, _CAPTION)]
    parts = dict.fromkeys(str(config.get("method")) for config in configs)
    wanted = [*parts, *(["dense_settings"] if any(config.get("dense") is True for config in configs) else [])]
    for key in wanted:
        mappings = [_mapping(config.get(key)) for config in configs]
        values = next((value for value in mappings if value), _NOTHING)
        if not values:
            continue
        part_name = "the dense stage" if key == "dense_settings" else f"the {key} method"
        differs = " of the first fit; others differ" if any(value and value != values for value in mappings) else ""
        out.append(Folded(f"All numbers of {part_name}{differs}", _numbers(key, values, part_name)))
    return out


def described(cls: type) -> dict[str, str]:
    """Return what each argument of a class is, from its docstring."""
    args = (inspect.getdoc(cls) or "").partition("Args:\n")[2].partition("\n\n")[0]
    entries = re.findall(r"^    (\w+): (.*(?:\n        .*)*)", args, re.MULTILINE)
    return {name: " ".join(text.split()).strip(" ,;") for name, text in entries}


def _numbers(key: str, values: Mapping[str, Any], part_name: str) -> list[Block]:
    """Return the settings of one part of the fit as tables of words."""
    out: list[Block] = []
    steps = [_mapping(step) for step in _list(values.get("levels"))]
    rows: list[list[str]] = [
        ["all" if step.get(name) is None else _level(name, step[name]) for name in _LEVEL] for step in steps
    ]
    if rows:
        out.append(text_table(_LEVEL_HEADS, rows, "The steps from coarse to fine"))
    cells: list[list[str]] = []
    for name, value in _flat(key, values):
        owner, _, own = name.rpartition(".")
        meaning = described(_OF[owner]).get(own, "") if owner in _OF else ""
        cells.append([words(own), plain(value), meaning or DASH])
    return [*out, text_table(("Setting", "Value", "What it is"), cells, f"Settings of {part_name}")]


def _level(name: str, value: object) -> str:
    if name == "triangles":
        return "triangles" if value else "vertices"
    return f"{value:,}" if isinstance(value, int) else plain(value)


def _flat(key: str, values: Mapping[str, Any]) -> list[tuple[str, object]]:
    """Return settings by `owner.name`, those of a part in its place; the steps have a table of their own."""
    out: list[tuple[str, object]] = []
    for name, value in values.items():
        if name == "levels":
            continue
        inner = _mapping(value)
        out += _flat(name, inner) if inner else [(f"{key}.{name}", value)]
    return out


def _mapping(value: object) -> Mapping[str, Any]:
    return cast(Mapping[str, Any], value) if isinstance(value, Mapping) else _NOTHING


def _list(value: object) -> list[object]:
    return cast(list[object], value) if isinstance(value, list) else []


def _method(config: Mapping[str, Any]) -> str:
    return {"robust": "robust: what does not match the model is left out", "paper": "the paper's"}.get(
        str(config.get("method")), plain(config.get("method"))
    )


def _modes(config: Mapping[str, Any]) -> str:
    modes = config.get("modes")
    return "all of the model" if modes is None else f"the first {plain(modes)}"


def _unit(config: Mapping[str, Any]) -> str:
    unit = plain(config.get("unit"))
    return "found from the size of each scan" if unit == "auto" else f"{unit}, as given"


def _scale(config: Mapping[str, Any]) -> str:
    effect = str(config.get("scale_in_effect", config.get("scale")))
    text = {"free": "free: each fit finds its own", "fixed": "fixed: scans and model are of one size"}.get(
        effect, plain(effect)
    )
    return f"{text}, as the model is made" if config.get("scale") == "auto" else text


def _dense(config: Mapping[str, Any]) -> str:
    return "made: the surface goes the rest of the way to the scan" if config.get("dense") is True else "not made"


def _iterations(config: Mapping[str, Any]) -> str:
    return f"at most {plain(config.get('max_iterations'))} in each phase"


def _seed(config: Mapping[str, Any]) -> str:
    return f"from seed {plain(config.get('seed'))}"


_CHOICES = (
    ("Method", _method),
    ("Modes", _modes),
    ("Unit of the scans", _unit),
    ("Size", _scale),
    ("Dense stage", _dense),
    ("Iterations", _iterations),
    ("Random numbers", _seed),
)
