"""Numbers, counts and settings as people write them."""

from __future__ import annotations

import re
import statistics
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from math import isfinite, nan
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from shapespace.model.shape_model import ShapeModel

STATUS_WORDS: Mapping[str, str] = {
    "converged": "converged",
    "max_iterations": "stopped at the limit",
    "doubtful": "doubtful",
    "failed": "failed",
    "unreadable": "unreadable",
}
"""Statuses in words, from the best to the worst."""
ORDER_OF_CONCERN = ("failed", "unreadable", "doubtful", "max_iterations", "converged")
"""Statuses, those that need review first."""

DASH = "–"
_FOLDERS = re.compile(r"""(?<![\w.~/\\])(?:[A-Za-z]:)?[\\/](?:[^\s'",;:()\\/]+[\\/])*(?=[^\s\\/])""")


def printable(text: str) -> str:
    """Return `text` with control characters and lone surrogates replaced; white space stays."""
    return "".join(c if c.isprintable() or c.isspace() else "\N{REPLACEMENT CHARACTER}" for c in text)


def without_folders(sentence: str) -> str:
    """Return `sentence` with the last part of each absolute path in place of the path."""
    return _FOLDERS.sub("", sentence)


def anchor(text: str) -> str:
    """Return `text` as the name of a place in the page: letters, digits and hyphens only."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "part"


def counted(count: int, one: str, many: str | None = None) -> str:
    """Return a number with its noun, such as `1 scan` or `3 scans`."""
    return f"{count:,} {one if count == 1 else many or one + 's'}"


def training_text(model: ShapeModel) -> str:
    """Return the number of training shapes, how many of them the model contains, and the notes on them."""
    text = counted(model.n_training, "shape")
    text = text if model.training is None else f"{text}, of which the model contains {len(model.training):,}"
    return ". ".join((text, *(note.rstrip(".") for note in model.notes)))


def listed(items: Sequence[str], most: int = 12) -> str:
    """Return items with commas, the last after `and`; beyond `most` the rest is counted."""
    if len(items) > most:
        return f"{', '.join(items[:most])} and {len(items) - most} more"
    return " and ".join(filter(None, (", ".join(items[:-1]), *items[-1:])))


def mm(value: float) -> str:
    """Return a length with three or so digits and its unit."""
    if not isfinite(value):
        return DASH
    digits = 0 if abs(value) >= 99.95 else 1 if abs(value) >= 9.995 else 2
    return f"{value:.{digits}f} mm".replace("-", "−")


def percent(share: float) -> str:
    """Return a percentage that is 100 only for a share of 1, and 0 only for a share of 0."""
    if not isfinite(share) or 0.0 < share < 0.01:
        return f"{max(100 * share, 0.1):.1f} %" if isfinite(share) else DASH
    return f"{min(100 * share, 99.9):.1f} %" if 0.99 < share < 1.0 else f"{100 * share:.0f} %"


def plain(value: object) -> str:
    """Return a setting or a score as text, numbers with three digits or so."""
    if value is None:
        return DASH
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return DASH if not isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    if isinstance(value, list):
        return ", ".join(map(plain, cast(list[object], value))) or "none"
    if isinstance(value, Mapping):
        return ", ".join(f"{words(key)} {plain(item)}" for key, item in cast(Mapping[str, object], value).items())
    return str(value)


def setting(value: object) -> str:
    """Return a setting as text; of a setting with parts, the plain ones."""
    if isinstance(value, Mapping):
        return plain(
            {key: item for key, item in cast(Mapping[str, Any], value).items() if not isinstance(item, dict | list)}
        )
    return plain(value)


def moment(value: str) -> str:
    """Return an ISO time stamp as people write it, or the text as it is."""
    try:
        return datetime.fromisoformat(value).astimezone(UTC).strftime("%Y-%m-%d %H:%M UTC")
    except (ValueError, OverflowError):
        return value


def words(key: str) -> str:
    """Return the name of a setting as words."""
    return key.replace("_", " ")


def known(value: float | None) -> float:
    """Return a number that may be absent, NaN for None."""
    return nan if value is None else value


def median(values: Sequence[float]) -> float:
    """Return the median of the finite numbers, NaN if there are none."""
    numbers = [value for value in values if isfinite(value)]
    return statistics.median(numbers) if numbers else nan


def percent_of(share: float) -> str:
    """Return a small share in percent with two digits or so."""
    return f"{plain(float(f'{100 * share:.2g}'))} %" if isfinite(share) else DASH


def sentence(text: str) -> str:
    """Return `text` from a capital letter to a full stop."""
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith(".") else ".") if text else ""
