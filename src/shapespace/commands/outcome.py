"""Result of a command, and the format of its lines."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast

LISTED = 10
"""Items that a command lists."""
_T = TypeVar("_T")
Facts: TypeAlias = Mapping[str, Any] | Sequence[Any]
"""Content of `--json`."""


class Aside(str):
    """A line that the terminal prints on standard error, among those on standard output."""

    __slots__ = ()


@dataclass(frozen=True)
class Outcome:
    """Result of a command.

    Args:
        facts: content of `--json`, or a function that returns it, for content that takes time to make.
        lines: lines on standard output without `--json`; only an `Aside` goes to standard error.
        notes: sentences on standard error, before the facts or lines.
        errors: sentences on standard error, after the facts or lines.
        exit_code: 0 done; 1 some failed; 2 all failed.
        page: HTML file that the browser opens at the end; None for none.
    """

    facts: Facts | Callable[[], Facts]
    lines: Sequence[str]
    notes: Sequence[str] = ()
    errors: Sequence[str] = ()
    exit_code: int = 0
    page: Path | None = None


def exit_code_of(failed: int, every: int) -> int:
    """Return the exit code of a command that failed for some, or all, of its files."""
    return 0 if not failed else 2 if failed == every else 1


def first_lines(items: Sequence[_T], describe: Callable[[_T], Sequence[str]], rest: str = "more") -> list[str]:
    """Return the lines of the first items, and a line with the number of the others and `rest`."""
    lines = [line for item in items[:LISTED] for line in describe(item)]
    return [*lines, f"and {len(items) - LISTED} {rest}"] if len(items) > LISTED else lines


def short(value: Any) -> str:
    """Return a value in words that fit a line."""
    plain = plain_value(value)
    if isinstance(plain, list):
        items = cast(list[Any], plain)
        items_text = ", ".join(short(item) for item in items[:8])
        return f"[{items_text}{', ...' if len(items) > 8 else ''}]" + (f" ({len(items)})" if len(items) > 8 else "")
    if isinstance(plain, dict):
        return ", ".join(f"{key} {short(item)}" for key, item in cast(dict[str, Any], plain).items())
    return f"{plain:.6g}" if isinstance(plain, float) else str(plain)


def plain_value(value: Any) -> Any:
    """Return a value as JSON has it; numbers that are not finite become None."""
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in cast(Mapping[Any, Any], value).items()}
    if isinstance(value, (list, tuple)):
        return [plain_value(item) for item in cast(Sequence[Any], value)]
    if hasattr(value, "tolist"):
        return plain_value(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, type(None))) else str(value)
