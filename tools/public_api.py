"""Write tests/api/released_api.txt: every public name with its signature, as the last release had them.

For developers, once a release is made. A test compares it with what there is, and asks for the changes in CHANGELOG.md.

    python tools/public_api.py
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import shapespace as ss

ROOT = Path(__file__).resolve().parents[1]
RELEASED = ROOT / "tests" / "api" / "released_api.txt"


def lines_of(name: str, of: Any) -> Iterator[str]:
    """Yield a line for a public name: what it is called with, or the type that it has; then one for each member."""
    if inspect.isclass(of):
        # What Exception itself is called with differs between versions of Python.
        plain = issubclass(of, Exception)
        yield f"{name} class" if plain else f"{name}{_called_with(of)}"
        for member in sorted(_members(of)):
            yield f"{name}.{_line_of_member(member, inspect.getattr_static(of, member))}"
    elif callable(of):
        yield f"{name}{_called_with(of)}"
    elif isinstance(of, dict):
        yield f"{name} {', '.join(sorted(map(str, of)))}"
    else:
        yield f"{name} {type(of).__name__}"


def _members(of: type) -> set[str]:
    ours = (one for one in of.__mro__ if one.__module__.startswith("shapespace."))
    return {name for one in ours for name, value in vars(one).items() if not name.startswith("_") and _is_ours(value)}


def _is_ours(value: object) -> bool:
    if isinstance(value, property | cached_property):
        return True
    inner = getattr(value, "__func__", value)
    return inspect.isroutine(inner) and str(getattr(inner, "__module__", "")).startswith("shapespace.")


def _line_of_member(name: str, value: Any) -> str:
    if isinstance(value, property | cached_property):
        function: Any = value.fget if isinstance(value, property) else value.func
        return f"{name} -> {inspect.signature(function).return_annotation}"
    return f"{name}{_called_with(getattr(value, '__func__', value))}"


def _called_with(of: Any) -> str:
    return re.sub(r" at 0x[0-9a-f]+", "", str(inspect.signature(of)))


def names() -> dict[str, Any]:
    """Return the public names, of shapespace and of its packages, with what they are."""
    packages = [ss, *(getattr(ss, name) for name in ss._PACKAGES)]  # pyright: ignore[reportPrivateUsage]
    return {name: getattr(package, name) for package in packages for name in package.__all__}


def lines() -> list[str]:
    """Return the lines of all public names."""
    return [line for name, of in sorted(names().items()) for line in lines_of(name, of)]


def name_in(line: str) -> str:
    """Return the name that a line is of."""
    return re.split(r"[ (]", line, maxsplit=1)[0]


def unnamed(released: Sequence[str], now: Sequence[str], changelog: str) -> list[str]:
    """Return what differs between two lists of lines and is not named in the section of what is not yet released.

    Args:
        released: lines of the last release.
        now: lines of what there is.
        changelog: the text of CHANGELOG.md. Of a class that is new or gone its own name is enough.
    """
    section = changelog.partition("## Unreleased")[2].partition("\n## ")[0]
    before, after = ({name_in(line) for line in some} for some in (released, now))
    changed = {name_in(line) for line in set(released) ^ set(now)}
    whole = {name for name in changed if (name in before) != (name in after)}
    asked = {name for name in changed if (name in whole and "." not in name) or name.partition(".")[0] not in whole}
    return sorted(name for name in asked if not re.search(rf"(?<![\w.]){re.escape(name)}(?!\w)", section))


if __name__ == "__main__":
    RELEASED.write_text("\n".join(lines()) + "\n", encoding="utf-8", newline="\n")
