"""TPS files of tpsDig and geomorph, and NTS files of NTSYS, with the landmarks of many specimens."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from shapespace.errors import InputError
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations, marked_missing
from shapespace.io.parsing import CUT_SHORT, damage_error
from shapespace.io.tables.table_io import MISSING
from shapespace.reprs import first_names
from shapespace.types import FloatArray

_NAMED = 3  # specimens in a sentence
_NTS_HEADER = re.compile(
    r"1\s+(\d{1,9})\s*([LBE]?)\s+(\d{1,9})\s*(L?)\s+([01])(?:\s+([^\sD]\S*))?(?:\s+DIM\s*=\s*([23]))?\s*", re.IGNORECASE
)
_NTS_MISSING = -999.0
"""Written for missing coordinates, ten times as much where a coordinate is the same."""


def coordinates(cells: Iterable[str], path: Path, describe: Callable[[int], str]) -> list[float]:
    """Return the numbers in cells, not-a-number for missing ones; `describe` names a cell in messages."""
    numbers: list[float] = []
    for at, cell in enumerate(cells):
        try:
            number = float(cell)
        except ValueError as error:
            if cell.lower() not in MISSING and cell != "?":
                problem = f"{describe(at)} has a coordinate that is not a number ({cell[:20]!r})"
                raise damage_error(path, problem) from error
            number = math.nan
        if math.isinf(number):
            raise damage_error(path, f"{describe(at)} has a coordinate that is infinite, so correct it or write NA")
        numbers.append(number)
    return numbers


@dataclass
class _Specimen:
    """Rows of coordinates of the landmarks and of each curve, and the values of other keys."""

    parts: list[list[list[float]]]
    values: dict[str, str] = field(default_factory=dict[str, str])

    def name(self, number: int) -> str:
        image = re.sub(r"\.\w{1,5}$", "", self.values.get("image", ""))
        return self.values.get("id") or image or f"specimen {number}"


def parse_tps(text: str, path: Path) -> LandmarkConfigurations:
    """Return the landmarks of a TPS file; the points of curves are semilandmarks after the landmarks.

    The inner points of a curve slide between their neighbours. SCALE= is applied if all specimens have it, as in
    geomorph. IMAGE=, COMMENT= and other keys become columns. Outlines are left out.
    """
    specimens = _specimens([line.strip() for line in text.splitlines() if line.strip()], path)
    names = tuple(specimen.name(number) for number, specimen in enumerate(specimens, 1))
    counts = [list(map(len, specimen.parts)) for specimen in specimens]
    for name, count in zip(names, counts, strict=True):
        if count != counts[0]:
            has, expected = (
                f"{c[0]} landmarks" + f", curves of {c[1:]} points" * (len(c) > 1) for c in (count, counts[0])
            )
            problem = f"specimen {name[:60]!r} has {has} and {names[0][:60]!r} has {expected}"
            raise damage_error(path, f"{problem}; digitise the same for all, with NA for missing landmarks")
    points = _array([[row for part in one.parts for row in part] for one in specimens], names, path)
    points, coded = marked_missing(points, names)
    notes, unscaled = list[str](), [n for n, one in zip(names, specimens, strict=True) if "scale" not in one.values]
    if not unscaled:
        scales = np.array(
            coordinates((one.values["scale"] for one in specimens), path, lambda k: f"SCALE= of {names[k]}")
        )
        if not (scales > 0).all():
            raise damage_error(path, "a SCALE= is not above 0, so correct it")
        points *= scales[:, None, None]
        notes.append("The coordinates are multiplied by the SCALE= of each specimen.")
    elif len(unscaled) < len(names):
        notes.append(
            f"No coordinates are multiplied by SCALE=, because {len(unscaled)} of {len(names)} specimens have none "
            f"({first_names(unscaled, _NAMED)}); sizes may differ in unit."
        )
    elif points.shape[2] == 2:
        notes.append("No specimen has SCALE=, so sizes are in the unit of the file, such as pixels.")
    if any("outlines" in one.values for one in specimens):
        notes.append("Outlines (OUTLINES=) are left out.")
    ends = np.cumsum(counts[0])
    inner = [k for a, b in pairwise(ends) for k in range(int(a) + 1, int(b) - 1)]
    if inner:
        notes.append(f"{len(inner)} inner points of {len(ends) - 1} curves are semilandmarks.")
    keys = dict.fromkeys(key for one in specimens for key in one.values if key not in ("id", "scale", "outlines"))
    return LandmarkConfigurations(
        names=names,
        points=points,
        columns={key: tuple(one.values.get(key, "") for one in specimens) for key in keys},
        curve_sliders=(np.array(inner, dtype=np.int32)[:, None] + np.arange(-1, 2)).astype(np.int32),
        where=str(path),
        notes=(*notes, *coded),
    )


def _specimens(lines: Sequence[str], path: Path) -> list[_Specimen]:
    specimens: list[_Specimen] = []
    at, is_outline = 0, False
    while at < len(lines):
        key, equals, value = (part.strip() for part in lines[at].partition("="))
        key, at, is_new = key.lower(), at + 1, key.lower() in ("lm", "lm3")
        if not specimens and not is_new:
            raise damage_error(path, "it is no TPS file, since it does not begin with LM= or LM3=")
        if not equals:
            problem = f"specimen {len(specimens)} has more rows of coordinates than it declares"
            raise damage_error(path, f"{problem} ({lines[at - 1][:40]!r})")
        if is_new or key in ("points", "points3"):
            count = int(value) if re.fullmatch(r"\d{1,10}", value) else -1
            rows = lines[at : at + max(count, 0)]
            rows = rows[: next((k for k, row in enumerate(rows) if "=" in row), len(rows))]
            label, at = f"specimen {len(specimens) + is_new}", at + count
            if len(rows) != count:
                declared = f"{label} declares {value[:20]!r} points, and {len(rows)} rows of coordinates follow"
                raise damage_error(path, f"{declared}; {CUT_SHORT}")
            # tpsDig writes the decimal comma of the system.
            words = (row.replace(",", ".").split() for row in rows)
            parsed = [coordinates(row, path, lambda _, label=label: label) for row in words]
            if is_new:
                specimens.append(_Specimen([parsed]))
            elif not is_outline:
                specimens[-1].parts.append(parsed)
        elif key != "curves":
            specimens[-1].values[key] = value
        is_outline = key == "outlines" or (is_outline and not is_new and key != "curves")
    return specimens


def _array(specimens: Sequence[list[list[float]]], names: Sequence[str], path: Path) -> FloatArray:
    """Return (N, L, D) coordinates; a row of not-a-number alone may have any width."""
    rows = [(name, row) for name, points in zip(names, specimens, strict=True) for row in points]
    widths = {len(row): name for name, row in reversed(rows) if not all(map(math.isnan, row))}
    if len(widths) > 1:
        several = " and ".join(f"{width} coordinates in a row of {name[:60]!r}" for width, name in widths.items())
        raise damage_error(path, f"it has {several}; do not mix 2-D and 3-D landmarks")
    width = next(iter(widths), 0)
    if width not in (2, 3):
        has = f"{width} coordinates in a row" if width else "no landmarks"
        raise damage_error(path, f"it has {has}; landmarks need 2 or 3 coordinates each")
    flat = [row if len(row) == width else [math.nan] * width for _, row in rows]
    return np.array(flat, dtype=np.float64).reshape(len(specimens), -1, width)


def tps_text(specimens: Mapping[str, FloatArray], values: Mapping[str, Sequence[str]] | None = None) -> str:
    """Return a TPS file of several specimens, as geomorph reads it, with missing landmarks as NA.

    Args:
        specimens: name -> (L, 2) or (L, 3).
        values: key, such as `IMAGE` -> value of each specimen; empty ones are left out.
    """
    blocks: list[str] = []
    for at, (name, points) in enumerate(specimens.items()):
        rows = [" ".join(map(repr, p)) if np.isfinite(p).all() else " ".join(["NA"] * len(p)) for p in points.tolist()]
        known = [f"{key}={cells[at]}" for key, cells in (values or {}).items() if cells[at]]
        blocks.append(
            "\n".join([f"LM{'3' if points.shape[1] == 3 else ''}={len(points)}", *rows, *known, f"ID={name}"])
        )
    return "\n".join(blocks) + "\n"


def parse_nts(text: str, path: Path) -> LandmarkConfigurations:
    """Return the landmarks of an NTS file: a row for each specimen, or one specimen with a row for each landmark."""
    lines = [line.strip() for line in text.splitlines() if line.strip() and line.lstrip()[0] not in "\"'"]
    header = _NTS_HEADER.fullmatch(lines[0]) if lines else None
    if header is None or header[7] is None:
        raise damage_error(path, "it has no NTS header with its dimensions, such as '1 40L 24 0 DIM=2'")
    n, p, width, place = int(header[1]), int(header[3]), int(header[7]), header[2].upper()
    words = " ".join(lines[1:]).split()
    if p % width or not n or not p:
        raise damage_error(path, f"its {n} rows of {p} numbers are not landmarks with DIM={width} coordinates")
    labels = n * bool(place) + p * bool(header[4])
    if len(words) != n * p + labels:
        problem = f"its header declares {n} rows of {p} numbers, and {len(words) - labels} numbers follow"
        raise damage_error(path, f"{problem}; labels must not contain spaces, or {CUT_SHORT}")
    names = words[:n] if place == "L" else [f"specimen {k}" for k in range(1, n + 1)]
    words = words[n * (place == "L") + p * bool(header[4]) :]
    if place in ("B", "E"):
        label = 0 if place == "B" else p
        names, words = words[label :: p + 1], [word for k, word in enumerate(words) if k % (p + 1) != label]
    points = np.array(coordinates(words, path, lambda k: f"specimen {names[k // p]!r}"))
    notes: list[str] = []
    if header[5] == "1" and header[6]:
        [code] = coordinates([header[6]], path, lambda _: "the header")
        points[points == code] = math.nan
        notes.append(f"Coordinates {code:g} are missing, as the header says.")
    if p == width and n > 1:
        names = [path.name.removesuffix(path.suffix)]
    points, coded = marked_missing(points.reshape(len(names), -1, width), names)
    return LandmarkConfigurations(names=tuple(names), points=points, where=str(path), notes=(*notes, *coded))


def nts_text(configurations: LandmarkConfigurations) -> str:
    """Return an NTS file with a labelled row for each specimen; names with white space raise InputError."""
    bad = next((name for name in configurations.names if not name or len(name.split()) != 1 or name[0] in "\"'"), None)
    if bad is not None:
        raise InputError(f"NTS cannot hold the specimen name {bad[:60]!r}; rename it without spaces or write TPS.")
    n, count, width = configurations.points.shape
    missing = _NTS_MISSING
    while (configurations.points == missing).any():
        missing *= 10
    flag = "0" if configurations.observed.all() else f"1 {missing:.0f}"
    flat = np.where(configurations.observed[..., None], configurations.points, missing).reshape(n, -1)
    rows = [" ".join(map(repr, row)) for row in flat.tolist()]
    head = ['"written by shapespace', f"1 {n}L {count * width} {flag} DIM={width}", " ".join(configurations.names)]
    return "\n".join([*head, *rows]) + "\n"
