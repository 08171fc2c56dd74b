"""TPS files of tpsDig and geomorph, and NTS files of NTSYS, with the landmarks of many specimens."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import TypeAlias

import numpy as np

from shapespace.errors import InputError
from shapespace.io.landmarks.landmark_configurations import (
    LandmarkConfigurations,
    consecutive_curves,
    equal_curves,
    mark_missing,
)
from shapespace.io.parsing import CUT_SHORT, damage_error, numeric_text
from shapespace.io.tables.table_io import MISSING
from shapespace.reprs import first_names
from shapespace.types import FloatArray

_OMITTED_OUTLINE = "="
"""Internal key of the values of specimens with an outline of too few points to enclose an area."""
LEAST_OUTLINE = 3  # points that enclose an area
Rows: TypeAlias = list[list[float]]
_NTS_HEADER = re.compile(
    r"1\s+(\d{1,9})\s*([LBE]?)\s+(\d{1,9})\s*(L?)\s+([01])(?:\s+([^\sD]\S*))?(?:\s+DIM\s*=\s*([23]))?\s*", re.IGNORECASE
)
_NTS_MISSING = -999.0
"""Code of missing coordinates; multiplied by ten if a coordinate has this value."""


def coordinates(
    cells: Iterable[str], path: Path, describe: Callable[[int], str], noun: str = "coordinate"
) -> list[float]:
    """Return the numbers in cells, NaN for missing values.

    Args:
        cells: texts of the cells.
        path: path of the file, for messages.
        describe: function from the number of a cell to its specimen or landmark, for messages.
        noun: noun for the numbers, for messages.
    """
    numbers: list[float] = []
    for at, cell in enumerate(cells):
        try:
            number = float(cell)
        except ValueError as error:
            if cell.lower() not in MISSING and cell != "?":
                problem = f"{describe(at)} has a {noun} that is not a number ({cell[:20]!r})"
                problem += ", perhaps with a decimal comma; write decimal points" * ("," in cell)
                raise damage_error(path, problem) from error
            number = math.nan
        if math.isinf(number):
            raise damage_error(path, f"{describe(at)} has a {noun} that is infinite, so correct it or write NA")
        numbers.append(number)
    return numbers


def parse_tps(text: str, path: Path, curve_points: int | None = None) -> LandmarkConfigurations:
    """Return the landmarks of a TPS file; the points of curves and outlines are semilandmarks after the landmarks.

    Outlines are closed curves. Curves with other numbers of points are resampled. SCALE= is applied if all specimens
    have it, as in geomorph. IMAGE=, COMMENT= and other keys become columns.
    """
    specimens, curves, values = zip(*tps_specimens(text, path), strict=True)
    images = _names_of_files([fields.get("image", "") for fields in values], r"\.\w{1,5}$")
    names = tuple(
        fields.get("id") or image or f"specimen {k}"
        for k, (fields, image) in enumerate(zip(values, images, strict=True), 1)
    )
    notes = list[str]()
    if len(set(names)) < len(names) == len(set(images)) and all(images):
        names = tuple(images)
        notes.append("Specimens are named after their IMAGE=, since values of ID= are repeated.")
    closed = [is_closed for _, is_closed in curves[0]]
    for name, rows, own in zip(names, specimens, curves, strict=True):
        if len(rows) != len(specimens[0]) or [is_closed for _, is_closed in own] != closed:
            numbers = [", ".join(f"{len(curve)}{' (closed)' * closed}" for curve, closed in part)[:60]
                       for part in (own, curves[0])]  # fmt: skip
            has, expected = (
                f"{len(part)} landmarks" + f", curves of [{number}] points" * bool(number)
                for part, number in zip((rows, specimens[0]), numbers, strict=True)
            )
            problem = f"specimen {name[:60]!r} has {has} and {names[0][:60]!r} has {expected}"
            raise damage_error(path, f"{problem}; digitise the same for all, with NA for missing landmarks")
    parts = [[rows, *(curve for curve, _ in own)] for rows, own in zip(specimens, curves, strict=True)]
    arrays = _arrays([[row for part in own for row in part] for own in parts], names, path)
    split = [np.split(array, np.cumsum([*map(len, own[:-1])])) for array, own in zip(arrays, parts, strict=True)]
    resampled, changes = equal_curves([own[1:] for own in split], closed, names, path, curve_points)
    points = np.stack([np.concatenate([own[0], *others]) for own, others in zip(split, resampled, strict=True)])
    notes += changes
    unscaled = [name for name, fields in zip(names, values, strict=True) if "scale" not in fields]
    scales = np.ones(len(names))
    if not unscaled:
        cells = [fields["scale"].replace(",", ".") for fields in values]  # a decimal comma, as in coordinates
        scales = np.array(coordinates(cells, path, lambda k: f"specimen {names[k]!r}", "SCALE="))
        if not (scales > 0).all():
            raise damage_error(path, "a SCALE= is not above 0, so correct it")
        notes.append("The coordinates are multiplied by the SCALE= of each specimen.")
    elif len(unscaled) < len(names):
        notes.append(
            f"No coordinates are multiplied by SCALE=, because {len(unscaled)} of {len(names)} specimens have none "
            f"({first_names(unscaled)}); sizes may differ in unit."
        )
    elif points.shape[2] == 2:
        notes.append("No specimen has SCALE=, so sizes are in the unit of the file, such as pixels.")
    if any(_OMITTED_OUTLINE in fields for fields in values):
        notes.append("Outlines (OUTLINES=) of fewer than 3 points are omitted.")
    keys = dict.fromkeys(key for fields in values for key in fields if key not in ("id", "scale", _OMITTED_OUTLINE))
    raw = mark_missing(LandmarkConfigurations(
        names=names, points=points, columns={key: tuple(fields.get(key, "") for fields in values) for key in keys},
        curves=consecutive_curves(len(specimens[0]), resampled[0], closed),
        where=str(path), notes=tuple(notes),
    ))  # fmt: skip
    return replace(raw, points=raw.points * scales[:, None, None])


def tps_specimens(text: str, path: Path) -> Iterator[tuple[Rows, list[tuple[Rows, bool]], dict[str, str]]]:
    """Yield the landmark coordinates of each specimen, its curves and whether they are closed, and other keys."""
    text = numeric_text(text.encode("utf-8", "replace"), path, commas_separate=True).decode()
    lines = "\n".join(line.strip() for line in text.splitlines() if line.strip())
    start, *blocks = re.split(r"^(?=LM3?\s*=)", lines, flags=re.IGNORECASE | re.MULTILINE)
    if start or not blocks:
        raise damage_error(path, "it is not a TPS file, since it does not begin with LM= or LM3=")
    for number, block in enumerate(blocks, 1):
        yield _specimen(block, number, path)


def _specimen(block: str, number: int, path: Path) -> tuple[Rows, list[tuple[Rows, bool]], dict[str, str]]:
    lines, values = block.splitlines(), dict[str, str]()
    parts = list[tuple[Rows, bool]]()
    at, is_outline = 0, False
    while at < len(lines):
        key, equals, value = (part.strip() for part in lines[at].partition("="))
        key, at = key.lower(), at + 1
        if not equals:
            problem = f"specimen {number} has more rows of coordinates than it declares"
            raise damage_error(path, f"{problem} ({lines[at - 1][:40]!r})")
        if key in ("lm", "lm3", "points", "points3"):
            count = int(value) if re.fullmatch(r"\d{1,10}", value) else -1
            rows = list(takewhile(lambda row: "=" not in row, lines[at : at + max(count, 0)]))
            if len(rows) != count:
                declared = f"specimen {number} declares {value[:20]!r} points"
                raise damage_error(path, f"{declared}, and {len(rows)} rows of coordinates follow; {CUT_SHORT}")
            at += count
            parts.append(
                (
                    [coordinates(row.replace(";", " ").split(), path, lambda _: f"specimen {number}") for row in rows],
                    is_outline,
                )
            )
            if is_outline and count < LEAST_OUTLINE:
                del parts[-1]
                values[_OMITTED_OUTLINE] = ""
        elif key in ("curves", "outlines"):
            is_outline = key == "outlines"
        else:
            values[key] = value
    return parts[0][0], parts[1:], values


def _names_of_files(files: Sequence[str], ending: str) -> list[str]:
    """Return the names of files without an ending, and without their folders if the names alone are distinct."""
    names = [re.sub(ending, "", file, flags=re.IGNORECASE) for file in files]
    bases = [re.split(r"[/\\]", name)[-1] for name in names]
    return bases if len(set(bases)) == len(set(names)) else names


def _arrays(specimens: Sequence[Rows], names: Sequence[str], path: Path) -> list[FloatArray]:
    """Return the (L, D) coordinates of each specimen; a row that is all not-a-number may have any width."""
    rows = [(name, row) for name, points in zip(names, specimens, strict=True) for row in points]
    widths = {len(row): name for name, row in reversed(rows) if not all(map(math.isnan, row))}
    if set(widths) not in ({2}, {3}):
        has = " and ".join(f"{width} coordinates in a row of {name[:60]!r}" for width, name in widths.items())
        advice = "do not mix 2-D and 3-D landmarks" if len(widths) > 1 else "landmarks need 2 or 3 coordinates each"
        raise damage_error(path, f"it has {has or 'no landmarks'}; {advice}")
    [width] = widths
    return [
        np.array([row if len(row) == width else [math.nan] * width for row in points]).reshape(-1, width)
        for points in specimens
    ]


def tps_text(specimens: Mapping[str, FloatArray], values: Mapping[str, Sequence[str]] | None = None) -> str:
    """Return a TPS file of several specimens, as geomorph reads it, with missing landmarks as NA.

    Args:
        specimens: name -> landmarks (L, 2) or (L, 3).
        values: key, such as `IMAGE` -> value of each specimen; empty values are not written.
    """
    lines: list[str] = []
    for at, (name, points) in enumerate(specimens.items()):
        lines.append(f"LM{'3' if points.shape[1] == 3 else ''}={len(points)}")
        lines += [" ".join(map(repr, p) if np.isfinite(p).all() else ["NA"] * len(p)) for p in points.tolist()]
        lines += [f"{key}={cells[at]}" for key, cells in (values or {}).items() if cells[at]]
        lines.append(f"ID={name}")
    return "\n".join(lines) + "\n"


def parse_nts(text: str, path: Path) -> LandmarkConfigurations:
    """Return the landmarks of an NTS file: a row for each specimen, or one specimen with a row for each landmark."""
    text = numeric_text(text.encode("utf-8", "replace"), path).decode()
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
        notes.append(f"Coordinates {code:g} are missing, as the header declares.")
    if p == width and n > 1:
        names = [path.name.removesuffix(path.suffix)]
    points = points.reshape(len(names), -1, width)
    return mark_missing(LandmarkConfigurations(names=tuple(names), points=points, where=str(path), notes=tuple(notes)))


def parse_dta(text: str, path: Path) -> LandmarkConfigurations:
    """Return the landmarks of a file of IDAV Landmark, which is NTS with names of meshes."""
    raw = parse_nts(text, path)
    return replace(raw, names=tuple(_names_of_files(raw.names, r"\.(ply|obj|stl|off|vtk|vtp)(\.gz)?$")))


def parse_morphologika(text: str, path: Path) -> LandmarkConfigurations:
    """Return the landmarks of a Morphologika file; its labels and groups become columns."""
    data = text.encode("utf-8", "replace")
    rows = re.search(rb"\[\s*rawpoints\s*\][^\[]*", data, re.IGNORECASE)
    if rows is not None:
        data = numeric_text(data[: rows.end()], path, rows.start(), commas_separate=True) + data[rows.end() :]
    sections, own = dict[str, list[str]](), list[str]()
    for line in filter(None, map(str.strip, data.decode().splitlines())):
        if section := re.fullmatch(r"\[\s*(\w+)\s*\]\s*(.*)", line):
            own = sections.setdefault(section[1].lower(), [])
            line = section[2]
        if line and not line.startswith(("'", "#")):
            own.append(line)
    try:
        n, p, width = (int(sections[key][0]) for key in ("individuals", "landmarks", "dimensions"))
        words = " ".join(sections["rawpoints"]).split()
    except (KeyError, IndexError, ValueError) as error:
        problem = "a Morphologika file needs [individuals], [landmarks], [dimensions] and [rawpoints]"
        raise damage_error(path, f"{problem}, each with its numbers") from error
    names = sections.get("names") or [f"specimen {k}" for k in range(1, n + 1)]
    if width not in (2, 3) or min(n, p) < 1 or len(words) != n * p * width or len(names) != n:
        declared = f"it declares {n} individuals with {p} landmarks in {width} dimensions"
        raise damage_error(path, f"{declared}, and has {len(names)} names and {len(words)} coordinates; {CUT_SHORT}")
    points = np.array(coordinates(words, path, lambda k: f"specimen {names[k // (p * width)]!r}"))
    labels, rows = " ".join(sections.get("labels", [])).split(), sections.get("labelvalues", [])
    cells = [[row] if len(labels) == 1 else row.split("\t" if "\t" in row else None) for row in rows]
    if labels and (len(cells) != n or any(len(row) != len(labels) for row in cells)):
        raise damage_error(
            path, f"its [labelvalues] are not {n} rows with a value for each of {', '.join(labels)[:60]}"
        )
    columns = {label: tuple(row[k] for row in cells) for k, label in enumerate(labels)}
    groups = re.findall(r"(\S+)\s+(\d{1,9})(?=\s|$)", " ".join(sections.get("groups", [])))
    if groups and sum(int(count) for _, count in groups) == n:
        columns["group"] = tuple(name for name, count in groups for _ in range(int(count)))
    return mark_missing(LandmarkConfigurations(
        names=tuple(names), points=points.reshape(n, p, width), columns=columns, where=str(path)
    ))  # fmt: skip


def nts_text(raw: LandmarkConfigurations) -> str:
    """Return an NTS file with a labelled row for each specimen; names with white space raise InputError."""
    bad = next((name for name in raw.names if not name or len(name.split()) != 1 or name[0] in "\"'"), None)
    if bad is not None:
        raise InputError(f"NTS cannot store the specimen name {bad[:60]!r}; rename it without spaces or write TPS.")
    n, count, width = raw.points.shape
    missing = _NTS_MISSING
    while (raw.points == missing).any():
        missing *= 10
    flag = "0" if raw.observed.all() else f"1 {missing:.0f}"
    flat = np.where(raw.observed[..., None], raw.points, missing).reshape(n, -1)
    rows = [" ".join(map(repr, row)) for row in flat.tolist()]
    head = ['"written by shapespace', f"1 {n}L {count * width} {flag} DIM={width}", " ".join(raw.names)]
    return "\n".join([*head, *rows]) + "\n"
