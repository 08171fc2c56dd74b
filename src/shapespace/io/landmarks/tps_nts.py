"""TPS files of tpsDig and geomorph, and NTS files of NTSYS, with the landmarks of many specimens."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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


def coordinate(cell: str, landmark: str, path: Path) -> float:
    """Return the number in a cell, not-a-number for a missing one.

    Raises:
        FileFormatError: it is neither, or infinite.
    """
    if cell.lower() in MISSING or cell == "?":
        return math.nan
    try:
        number = float(cell)
    except ValueError as error:
        raise damage_error(path, f"{landmark} has a coordinate that is not a number ({cell[:20]!r})") from error
    if math.isinf(number):
        raise damage_error(path, f"{landmark} has a coordinate that is infinite, so correct it or write NA")
    return number


@dataclass
class _TpsSpecimen:
    """Landmarks and curves of one specimen, each a list of rows of coordinates."""

    landmarks: list[list[float]]
    curves: list[list[list[float]]] = field(default_factory=list[list[list[float]]])
    values: dict[str, str] = field(default_factory=dict[str, str])

    def name(self, number: int) -> str:
        image = self.values.get("image", "")
        return self.values.get("id") or re.sub(r"\.\w{1,5}$", "", image) or f"specimen {number}"

    @property
    def rows(self) -> list[list[float]]:
        return self.landmarks + [row for curve in self.curves for row in curve]


def parse_tps(text: str, path: Path) -> LandmarkConfigurations:
    """Return the landmarks of a TPS file; the points of curves are semilandmarks after the landmarks.

    The inner points of a curve slide between their neighbours. SCALE= is applied if all specimens have it, as in
    geomorph. IMAGE=, COMMENT= and other keys become columns. Outlines are left out.

    Raises:
        FileFormatError: it is no TPS, is cut short, or its specimens have other numbers of landmarks or dimensions.
        InputError: two specimens have one name.
    """
    specimens = _tps_specimens([line.strip() for line in text.splitlines() if line.strip()], path)
    names = tuple(specimen.name(number) for number, specimen in enumerate(specimens, 1))
    first, notes = specimens[0], list[str]()
    for name, specimen in zip(names, specimens, strict=True):
        for what, count, expected in (
            ("landmarks", len(specimen.landmarks), len(first.landmarks)),
            ("curves", len(specimen.curves), len(first.curves)),
            ("points on curves", *(len(one.rows) - len(one.landmarks) for one in (specimen, first))),
        ):
            if count != expected:
                problem = f"specimen {name[:60]!r} has {count} {what} and {names[0][:60]!r} {expected}"
                raise damage_error(path, f"{problem}; digitise the same {what}, with NA for those that are missing")
    points = _same_width([specimen.rows for specimen in specimens], names, path)
    points, coded = marked_missing(points, names)
    scaled = [name for name, specimen in zip(names, specimens, strict=True) if "scale" in specimen.values]
    if len(scaled) == len(names):
        scales = np.array([coordinate(one.values["scale"], "SCALE=", path) for one in specimens])
        if not (scales > 0).all():
            raise damage_error(path, "a SCALE= is not above 0, so correct it")
        points *= scales[:, None, None]
        notes.append("The coordinates are multiplied by the SCALE= of each specimen.")
    elif scaled:
        without = [name for name in names if name not in set(scaled)]
        notes.append(
            f"No coordinates are multiplied by SCALE=, because {len(without)} of {len(names)} specimens have none "
            f"({first_names(without, _NAMED)}); sizes may differ in unit."
        )
    elif points.shape[2] == 2:
        notes.append("No specimen has SCALE=, so sizes are in the unit of the file, such as pixels.")
    if any("outlines" in one.values for one in specimens):
        notes.append("Outlines (OUTLINES=) are left out.")
    sliders, start = list[tuple[int, int, int]](), len(first.landmarks)
    for curve in first.curves:
        sliders += [(start + k - 1, start + k, start + k + 1) for k in range(1, len(curve) - 1)]
        start += len(curve)
    if sliders:
        notes.append(f"{len(sliders)} inner points of {len(first.curves)} curves are semilandmarks.")
    keys = dict.fromkeys(key for one in specimens for key in one.values if key not in ("id", "scale", "outlines"))
    return LandmarkConfigurations(
        names=names,
        points=points,
        columns={key: tuple(one.values.get(key, "") for one in specimens) for key in keys},
        curve_sliders=np.array(sliders, dtype=np.int32).reshape(-1, 3),
        where=str(path),
        notes=(*notes, *coded),
    )


def _tps_specimens(lines: Sequence[str], path: Path) -> list[_TpsSpecimen]:
    specimens: list[_TpsSpecimen] = []
    at, is_outline = 0, False
    while at < len(lines):
        key, equals, value = (part.strip() for part in lines[at].partition("="))
        key, at = key.lower(), at + 1
        if not equals or not (specimens or key in ("lm", "lm3")):
            if not specimens:
                raise damage_error(path, "it is no TPS file, since it does not begin with LM= or LM3=")
            raise damage_error(
                path,
                f"specimen {len(specimens)} has more rows of coordinates than it declares ({lines[at - 1][:40]!r})",
            )
        if key not in ("lm", "lm3", "points", "points3"):
            if key in ("curves", "outlines"):
                is_outline = key == "outlines"
            if key != "curves":
                specimens[-1].values[key] = value
            continue
        count = int(value) if re.fullmatch(r"\d{1,10}", value) else -1
        rows = lines[at : at + max(count, 0)]
        rows = rows[: next((k for k, row in enumerate(rows) if "=" in row), len(rows))]
        number = len(specimens) + key.startswith("lm")
        if len(rows) != count:
            declared = f"specimen {number} declares {value[:20]!r} points, and {len(rows)} rows of coordinates follow"
            raise damage_error(path, f"{declared}; {CUT_SHORT}")
        # tpsDig writes the decimal comma of the system.
        label = f"specimen {number}"
        parsed = [[coordinate(word, label, path) for word in row.replace(",", ".").split()] for row in rows]
        at += count
        if key.startswith("lm"):
            specimens.append(_TpsSpecimen(parsed))
            is_outline = False
        elif not is_outline:
            specimens[-1].curves.append(parsed)
    return specimens


def _same_width(specimens: Sequence[list[list[float]]], names: Sequence[str], path: Path) -> FloatArray:
    """Return (N, L, D) coordinates; a row of not-a-number alone may have any width."""
    rows = [(name, row) for name, points in zip(names, specimens, strict=True) for row in points]
    known = [(name, len(row)) for name, row in rows if not all(map(math.isnan, row))]
    if not known or known[0][1] not in (2, 3):
        width = f"{known[0][1]} coordinates in a row" if known else "no landmarks"
        raise damage_error(path, f"it has {width}; landmarks need 2 or 3 coordinates each")
    name, width = known[0]
    other = next(((other, k) for other, k in known if k != width), None)
    if other is not None:
        problem = f"specimen {other[0][:60]!r} has {other[1]} coordinates in a row and {name[:60]!r} {width}"
        raise damage_error(path, f"{problem}; do not mix 2-D and 3-D landmarks")
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
    """Return the landmarks of an NTS file: a row for each specimen, or one specimen with a row for each landmark.

    Raises:
        FileFormatError: it is no NTS file with DIM=, or is cut short.
        InputError: two specimens have one name.
    """
    lines = [line.strip() for line in text.splitlines() if line.strip() and line.lstrip()[0] not in "\"'"]
    header = _NTS_HEADER.fullmatch(lines[0]) if lines else None
    if header is None or header[7] is None:
        raise damage_error(path, "it has no NTS header with its dimensions, such as '1 40L 24 0 DIM=2'")
    n, p, width = int(header[1]), int(header[3]), int(header[7])
    place, words = header[2].upper(), " ".join(lines[1:]).split()
    if p % width or not n or not p:
        raise damage_error(path, f"its {n} rows of {p} numbers are not landmarks with DIM={width} coordinates")
    labels = n * bool(place) + p * bool(header[4])
    if len(words) != n * p + labels:
        problem = f"its header declares {n} rows of {p} numbers, and {len(words) - labels} numbers follow"
        raise damage_error(path, f"{problem}; labels must not contain spaces, or {CUT_SHORT}")
    names = [f"specimen {k}" for k in range(1, n + 1)]
    if place == "L":
        names, words = words[:n], words[n:]
    words = words[p * bool(header[4]) :]
    if place in ("B", "E"):
        rows = [words[k * (p + 1) : (k + 1) * (p + 1)] for k in range(n)]
        names = [row[0 if place == "B" else -1] for row in rows]
        words = [word for row in rows for word in (row[1:] if place == "B" else row[:-1])]
    points = np.array([coordinate(word, "a landmark", path) for word in words], dtype=np.float64)
    notes: list[str] = []
    if header[5] == "1" and header[6]:
        code = coordinate(header[6], "the missing value", path)
        points[points == code] = math.nan
        notes.append(f"Coordinates {code:g} are missing, as the header says.")
    if p == width and n > 1:
        names, points = [re.sub(r"\.\w+$", "", path.name)], points.reshape(1, n, width)
    points, coded = marked_missing(points.reshape(len(names), -1, width), names)
    return LandmarkConfigurations(names=tuple(names), points=points, where=str(path), notes=(*notes, *coded))


def nts_text(configurations: LandmarkConfigurations) -> str:
    """Return an NTS file with a labelled row for each specimen.

    Raises:
        InputError: a name has white space, which the format cannot hold.
    """
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
