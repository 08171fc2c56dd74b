"""One-line representations of objects that contain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

_SMALL = 9  # elements; a rotation matrix is printed in full
_MOST_NAMES = 4  # entries in one line
_LONGEST = 80  # characters of a line in a terminal


def short_repr(self: Any) -> str:
    """Return the fields of a dataclass in one line: arrays by shape and type, long sequences by length.

    A class uses it as `__repr__ = short_repr`.
    """
    shown_fields = (f"{item.name}={describe_briefly(getattr(self, item.name))}" for item in fields(self) if item.repr)
    return f"{type(self).__name__}({', '.join(shown_fields)})"


def first_names(names: Sequence[object], most: int = 3) -> str:
    """Return the first `most` of `names` with commas; dots stand for the others."""
    return ", ".join(map(str, names[:most])) + (", ..." if len(names) > most else "")


def list_briefly(parts: Sequence[str]) -> str:
    """Return the first of `parts`, and the number of further ones, in one line."""
    others_note = f"; and {len(parts) - _MOST_NAMES} more" if len(parts) > _MOST_NAMES else ""
    return "; ".join(_clip(part) for part in parts[:_MOST_NAMES]) + others_note


def describe_briefly(value: Any) -> str:
    """Return a short text for `value`, without computing or reading anything."""
    if isinstance(value, np.ndarray):
        return _describe_array(cast(npt.NDArray[Any], value))
    if isinstance(value, Mapping):
        return _describe_mapping(cast(Mapping[object, object], value))
    if isinstance(value, list | tuple):
        items = cast(Sequence[object], value)
        if len(items) > _MOST_NAMES or any(not isinstance(item, str | int | float) for item in items):
            return f"<{len(items)} items>"
    return f"{value:.6g}" if isinstance(value, float) else _describe_other(cast(object, value))


def _describe_mapping(value: Mapping[object, object]) -> str:
    names = [str(name) for name in value]
    others_note = f", and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return "{" + ", ".join(_clip(name) for name in names[:_MOST_NAMES]) + others_note + "}"


def _describe_other(value: object) -> str:
    text = repr(value)
    return f"{type(value).__name__}(…)" if is_dataclass(value) and len(text) > _LONGEST else _clip(text)


def _describe_array(array: npt.NDArray[Any]) -> str:
    if array.size <= _SMALL and array.dtype.kind in "iufb":
        return " ".join(np.array2string(array, precision=4, separator=", ").split())
    return f"<{' x '.join(map(str, array.shape))} {array.dtype}>"


def _clip(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 2]} …"


def describe_groups(groups: Sequence[Sequence[str]]) -> str:
    """Return a sentence on the groups of scans of a correspondence; empty if all belong to one group."""
    if not groups:
        return ""
    others = (f"{len(group)} are alike and differ from them" for group in groups[1:])
    return "; ".join([f"{len(groups[0])} scans are alike", *others]) + "."
