"""Parsers of the values of options: each returns the value, or raises an error with the accepted values."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable
from pathlib import Path

_THOUSANDS = re.compile(r"[+-]?[1-9][0-9]{0,2},[0-9]{3}")
_LARGEST = 2**63
"""Bound of integers: JSON, in which all settings are written, has no larger ones."""


def integer(text: str) -> int:
    """Return an integer of any sign."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not an integer") from None
    if abs(value) >= _LARGEST:
        raise argparse.ArgumentTypeError(f"must be below {_LARGEST}")
    return value


def natural(text: str) -> int:
    """Return an integer of 0 or more."""
    value = integer(text)
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def positive(text: str) -> int:
    """Return an integer of 1 or more."""
    value = natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def number(text: str) -> float:
    """Return a number."""
    try:
        return _decimal(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def _decimal(text: str) -> float:
    """Return a number with a decimal point or comma; 1,000 is rejected, as it may be a thousand."""
    if "," in text and not _THOUSANDS.fullmatch(text):
        from shapespace.io.tables.table_io import DECIMAL_COMMA  # slow to import, and few numbers have a comma

        text = text.replace(",", ".") if DECIMAL_COMMA.fullmatch(text) else text
    return float(text)


def probability(text: str) -> float:
    """Return a number from 0 to 1."""
    value = number(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError("must lie from 0 to 1")
    return value


def share(text: str) -> float:
    """Return a number above 0 and at most 1."""
    value = probability(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must lie above 0 and at most at 1")
    return value


def seconds(text: str) -> float:
    """Return a time in seconds above 0."""
    return _parse_number(text, lambda value: 0 < value < float("inf"), "seconds above 0")


def std_mm(text: str) -> float:
    """Return a standard deviation in mm; infinity is accepted."""
    return _parse_number(text, lambda value: value > 0, "a number of millimetres above 0, or inf")


def smoothing(text: str) -> float:
    """Return a standard deviation in voxels, from 0 to 10."""
    return _parse_number(text, lambda value: 0 <= value <= 10, "a number from 0 to 10")


def _parse_number(text: str, accepts: Callable[[float], bool], accepted: str) -> float:
    try:
        value = _decimal(text)
    except ValueError:
        value = float("nan")  # which no comparison accepts
    if not accepts(value):
        raise argparse.ArgumentTypeError(f"must be {accepted}, not {text!r}")
    return value


def yes_or_no(text: str) -> bool:
    """Return whether a text is `yes` or `true`."""
    if text.lower() not in ("yes", "true", "no", "false"):
        raise argparse.ArgumentTypeError(f"must be yes or no, not {text!r}")
    return text.lower() in ("yes", "true")


def memory_bytes(text: str) -> int:
    """Return a size such as 8G as bytes."""
    match = re.fullmatch(r"(\d{1,9}(?:\.\d{1,6})?)([KMGT])(?:i?B)?", text, re.IGNORECASE | re.ASCII)
    value = float(match[1]) * 1024 ** (1 + "KMGT".index(match[2].upper())) if match else 0.0
    if not value:
        raise argparse.ArgumentTypeError(f"must be a size such as 8G or 500M, not {text!r}")
    return int(value)


def folds(text: str) -> int | None:
    """Return a number of folds; None for `loo`, leave-one-out."""
    if text == "loo":
        return None
    value = natural(text)
    if value < 2:
        raise argparse.ArgumentTypeError("must be at least 2, or loo")
    return value


def modes(text: str) -> int | str:
    """Return a number of modes, `auto` or `all`."""
    return text if text in ("auto", "all") else positive(text)


def control_points(text: str) -> tuple[int, int]:
    """Return the counts of MxN."""
    counts = text.lower().split("x")
    if len(counts) != 2 or not all(count.isascii() and count.isdigit() and len(count) < 4 for count in counts):
        raise argparse.ArgumentTypeError(f"must be two integers such as 24x24, not {text!r}")
    return int(counts[0]), int(counts[1])


def error_term(text: str) -> tuple[str, str]:
    """Return a term and its error term of TERM=ERROR."""
    term, equals, error = text.rpartition("=")
    if not equals or not term.strip() or not error.strip():
        raise argparse.ArgumentTypeError(f"must be TERM=ERROR, such as genus=genus:species, not {text!r}")
    return term.strip(), error.strip()


def counts(text: str) -> tuple[int, ...]:
    """Return integers of 1 or more, separated by commas."""
    return tuple(positive(word) for word in words(text))


def words(text: str) -> tuple[str, ...]:
    """Return words separated by commas."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def numbers(text: str) -> tuple[float, ...]:
    """Return numbers separated by commas."""
    return tuple(number(word) for word in words(text))


def shares(text: str) -> tuple[float, ...]:
    """Return numbers above 0 and at most 1, separated by commas."""
    return tuple(share(part) for part in text.split(","))


def mode_counts(text: str) -> tuple[int, ...]:
    """Return numbers of modes separated by commas."""
    try:
        return tuple(int(word) for word in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers of modes such as 2,5,10, not {text!r}") from None


def axes(text: str) -> tuple[int, int]:
    """Parse two numbers of axes, from 1, separated by a comma."""
    across, comma, up = text.partition(",")
    if not comma:
        raise argparse.ArgumentTypeError(f"must be two numbers of axes such as 1,2, not {text!r}")
    return positive(across), positive(up)


def named_file(text: str) -> tuple[str, Path]:
    """Return the name and the path of NAME=FILE."""
    name, equals, file = text.partition("=")
    if not (name.strip() and equals and file):
        raise argparse.ArgumentTypeError(f"must be NAME=FILE, not {text!r}")
    return name.strip(), Path(file)
