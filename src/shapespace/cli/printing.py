"""How the command line speaks: sentences on standard error, lines and JSON on standard output."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, cast


def say(sentence: str) -> None:
    """Print a sentence on standard error."""
    print(_visible(sentence), file=sys.stderr)


def warn(sentence: str) -> None:
    """Print a sentence on standard error that begins with who says it."""
    say(f"shapespace: {sentence}")


def show(line: str) -> None:
    """Print a line on standard output."""
    print(_visible(line))


def arrow() -> str:
    """Return an arrow as the encoding of standard output allows it."""
    try:
        "\N{RIGHTWARDS ARROW}".encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return "->"
    return "\N{RIGHTWARDS ARROW}"


def now(line: str) -> None:
    """Print a line at once, for a command that goes on."""
    show(line)
    sys.stdout.flush()


def show_json(facts: Any) -> None:
    """Print facts as JSON; numbers that are not finite become null."""
    print(json.dumps(_plain(facts), indent=1, allow_nan=False))


def short(value: Any) -> str:
    """Return a value in words that fit a line."""
    plain = _plain(value)
    if isinstance(plain, list):
        items = cast(list[Any], plain)
        items_text = ", ".join(short(item) for item in items[:8])
        return f"[{items_text}{', ...' if len(items) > 8 else ''}]" + (f" ({len(items)})" if len(items) > 8 else "")
    if isinstance(plain, dict):
        return ", ".join(f"{key} {short(item)}" for key, item in cast(dict[str, Any], plain).items())
    return f"{plain:.6g}" if isinstance(plain, float) else str(plain)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in cast(Mapping[Any, Any], value).items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in cast(Sequence[Any], value)]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, type(None))) else str(value)


def _visible(line: str) -> str:
    """Return `line` with control characters as escapes: a file's name may hold line breaks and terminal codes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
