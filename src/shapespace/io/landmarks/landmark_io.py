"""Readers and writers of landmark files, of landmarks and regions by numbers of vertices, and of fitted landmarks."""

from __future__ import annotations

import csv
import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.files import read_bytes, write_text
from shapespace.io.landmarks.tps_nts import tps_specimens
from shapespace.io.parsing import CUT_SHORT, damage_error, is_number, json_value, numeric_text, xml_root
from shapespace.io.read_limits import LARGEST_LANDMARK_FILE_BYTES
from shapespace.io.tables.table_io import MISSING, csv_lines, rows_text, unescape_formula
from shapespace.io.volume_io import MM_OF_UNITS
from shapespace.types import RAS_TO_LPS, FloatArray, SurfaceLandmarks

Pairs: TypeAlias = Iterable[tuple[str, FloatArray | None]]
"""Names and points (3,) in the order of a file; None as the point of a landmark that is marked as absent."""
# A label is repeated for each of its points, so a long label would take much memory.
_LONGEST_LABEL = 256
_VERTEX = "vertex"
"""Column of regions."""
_DIGITS = 10  # digits of the number of a vertex, which fits into int32


@dataclass(frozen=True)
class LandmarkFormat:
    """A file format for named points.

    Args:
        name: common name of the format.
        read: function (content, path) -> names and points in the order of the file; the names are not yet checked.
        write: function names and points -> text.
    """

    name: str
    read: Callable[[bytes, Path], Pairs]
    write: Callable[[Mapping[str, FloatArray]], str]


def read_landmarks(path: Path | str, *, keep_absent: bool = False) -> dict[str, FloatArray]:
    """Read named points, in the frame and unit of the file; points that are marked as absent are omitted.

    Files of menpo (`.ljson`) name groups of points, not points. If a label has several points, these are named
    `label_0`, `label_1`, ... by their position in the label, including absent points; the only point of a label has the
    name of the label. Points without a label are named `point_0`, ... by their position in the file. With several
    groups, the prefix `group_` is added.

    Files of 3D Slicer (`.mrk.json`, `.fcsv`) are returned in LPS, the frame in which Slicer saves meshes: RAS, which is
    the default of `.fcsv`, is converted by changing the signs of x and y. CSV is `name,x,y,z`, with or without this
    header, and `#` begins a comment. The points of BU-3DFE (`.bnd`, a vertex number and x y z in each row) and `.tps`,
    and rows `x y z` without a name in `.txt` and `.pts`, are named `point_0`, ... by their position in the file.
    Bosphorus (`.lm3`) and scalismo (`.tlms`) name their points.

    Args:
        path: path of a file with one of the endings in `LANDMARK_FORMATS` or `READ_ONLY_LANDMARKS`; the format of a
            `.json` file is determined from its content.
        keep_absent: whether to return not-a-number for landmarks that are marked as absent.

    Returns:
        name -> (3,) float64, in the file's order.

    Raises:
        FileError: it does not exist, cannot be read, or is longer than `LARGEST_LANDMARK_FILE_BYTES`.
        FileFormatError: it is not in that format, or has a name twice, numbers that are not finite, or no
            landmarks.
    """
    path = Path(path)
    read = READ_ONLY_LANDMARKS.get(path.suffix.lower()) or _format(path, "read").read
    pairs = list(read(_content(path), path))
    landmarks: dict[str, FloatArray] = {}
    for name, point in pairs:
        if point is None and not keep_absent:
            continue
        if not name:
            raise damage_error(path, "it has a landmark without a name, so name them all")
        if name in landmarks:
            raise damage_error(path, f"it has two landmarks named '{name[:60]}', so rename one")
        if point is not None and not np.isfinite(point).all():
            raise damage_error(path, f"landmark '{name[:60]}' has a coordinate that is not finite, so remove it")
        landmarks[name] = np.full(3, np.nan) if point is None else point
    if not landmarks:
        raise damage_error(path, "it contains no landmarks")
    return landmarks


def write_landmarks(path: Path | str, landmarks: Mapping[str, FloatArray]) -> None:
    """Write named points exactly, in the format of the ending of `path`, atomically.

    Files of 3D Slicer declare LPS and mm; `.json` without `.mrk` is the format of scalismo; in `.ljson` each point has
    its own label.

    Args:
        path: path of the file, with one of the endings in `LANDMARK_FORMATS`.
        landmarks: name -> (3,) float64 coordinates; in LPS and millimetres for Slicer.

    Raises:
        InputError: a point that is not three finite numbers, or a name that is empty.
        FileFormatError: the ending is unknown.
        FileError: the folder cannot be written, or the disk is full.
    """
    path = Path(path)
    for name, point in landmarks.items():
        if not name.strip() or name != name.strip():
            raise InputError(f"Cannot write {path}: a landmark's name ('{name}') is empty or has outer spaces.")
        if np.shape(point) != (3,) or not np.isfinite(point).all():
            raise InputError(f"Cannot write {path}: landmark '{name}' is not three finite numbers.")
    write_text(path, _format(path, "write").write(landmarks))


def read_landmark_indices(path: Path | str) -> dict[str, int]:
    """Read landmarks given as vertex numbers, from CSV with the header `name,vertex`; `#` begins a comment.

    Args:
        path: the file; vertices count from 0.

    Returns:
        name -> vertex, in the file's order.

    Raises:
        FileError: it does not exist or cannot be read.
        FileFormatError: another header, a name twice, or a vertex that is not a non-negative integer.
    """
    path = Path(path)
    rows = csv_rows(_content(path), path)
    if not _has_vertex_header(rows):
        raise damage_error(path, "it does not start with the header 'name,vertex'")
    indices: dict[str, int] = {}
    for row in rows[1:]:
        if len(row) < 2 or not row[1].isascii() or not row[1].isdecimal() or len(row[1]) > 18:
            raise damage_error(path, f"landmark '{row[0][:60]}' has no vertex number (an integer from 0)")
        if not row[0] or row[0] in indices:
            raise damage_error(path, f"it has the name '{row[0][:60]}' twice or empty, so rename it")
        indices[row[0]] = int(row[1])
    return indices


def read_region(path: Path | str) -> tuple[int, ...]:
    """Read vertices, counted from 0: a CSV table with a column `vertex`, or one number per line; `#` begins a comment.

    Raises:
        FileError: it does not exist or cannot be read.
        FileFormatError: it contains other data, or nothing.
    """
    path = Path(path)
    remedy = "give one vertex number in each line, or a column named vertex"
    data = read_bytes(path, LARGEST_LANDMARK_FILE_BYTES)
    try:
        rows = csv_rows(data, path)
    except FileFormatError as error:
        raise FileFormatError(f"{path} is not a list of vertices; {remedy}.") from error
    header = [cell.lower() for cell in rows[0]] if rows else []
    column = header.index(_VERTEX) if _VERTEX in header else 0
    cells = [row[column] if column < len(row) else "" for row in (rows[1:] if _VERTEX in header else rows)]
    wrong = next((cell for cell in cells if not (cell.isascii() and cell.isdecimal() and len(cell) < _DIGITS)), None)
    if wrong is not None or not cells:
        problem = (
            "it is empty" if not cells else f"{wrong[:40]!r} is not a vertex number" if wrong else "a row has none"
        )
        raise FileFormatError(f"{path} is not a list of vertices ({problem}); {remedy}.")
    return tuple(int(cell) for cell in cells)


_CORNER_COLUMNS = (("vertex", "weight"), ("vertex_2", "weight_2"), ("vertex_3", "weight_3"))
_DISTANCE_COLUMN = "distance_mm"


def is_of_vertices(path: Path | str) -> bool:
    """Return whether a CSV file has the header `name,vertex` of landmarks at vertices.

    Raises:
        FileError: it does not exist or cannot be read.
        FileFormatError: it is empty, or not comma-separated text.
    """
    path = Path(path)
    return _has_vertex_header(csv_rows(_content(path), path))


def _has_vertex_header(rows: list[list[str]]) -> bool:
    return bool(rows) and [cell.lower() for cell in rows[0][:2]] == ["name", "vertex"]


def read_surface_landmarks(path: Path | str) -> SurfaceLandmarks:
    """Read landmarks on surfaces in correspondence, from CSV; `#` begins a comment.

    The header is `name,vertex` for landmarks at vertices, or else that of `write_surface_landmarks`.

    Args:
        path: the file; vertices count from 0.

    Raises:
        FileError: it does not exist or cannot be read.
        FileFormatError: another header, a name twice, a vertex that is not a non-negative integer, or coordinates that
            are not barycentric.
    """
    path = Path(path)
    indices = read_landmark_indices(path)
    rows = csv_rows(_content(path), path)
    header = [cell.lower() for cell in rows[0]]
    columns = [name for pair in _CORNER_COLUMNS for name in pair]
    try:
        if not set(columns) <= set(header):
            return SurfaceLandmarks.of(indices)
        cells = [dict(zip(header, row, strict=False)) for row in rows[1:]]
        corners = [[_index(row[vertex]) for vertex, _ in _CORNER_COLUMNS] for row in cells]
        weights = [[float(row[weight]) for _, weight in _CORNER_COLUMNS] for row in cells]
        distance = [float(row.get(_DISTANCE_COLUMN) or 0.0) for row in cells]
        return SurfaceLandmarks(
            tuple(indices), np.reshape(corners, (-1, 3)), np.reshape(weights, (-1, 3)), np.array(distance)
        )
    except InputError as error:
        raise FileFormatError(f"Cannot read {path}: {error}") from error
    except (KeyError, ValueError, OverflowError) as error:
        raise damage_error(path, "it has a row without three vertices and their weights") from error


def _index(cell: str) -> int:
    if not cell.isascii() or not cell.isdecimal():
        raise ValueError("not an integer")
    return int(cell)


def write_surface_landmarks(path: Path | str, landmarks: SurfaceLandmarks) -> None:
    """Write landmarks on surfaces in correspondence exactly, as CSV, atomically.

    Each row contains the vertices of a triangle, their weights (barycentric coordinates, the largest first), and the
    distance of the given point from the surface. If all landmarks are at vertices, the columns are `name,vertex`.

    Args:
        path: the file.
        landmarks: landmarks on the surfaces; vertices count from 0.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    write_text(Path(path), surface_landmarks_text(landmarks))


def surface_landmarks_text(landmarks: SurfaceLandmarks) -> str:
    """Return the content of the file of `write_surface_landmarks`."""
    if landmarks.are_vertices:
        return _indices_text(landmarks)
    columns, cells = surface_landmark_cells(landmarks)
    rows = [[name, *row] for name, row in zip(landmarks.names, cells, strict=True)]
    return rows_text([["name", *columns], *rows])


def surface_landmark_cells(landmarks: SurfaceLandmarks) -> tuple[list[str], list[list[str]]]:
    """Return the columns of `write_surface_landmarks` after the name, and the cells of each landmark."""
    rows = [
        [*(text for pair in zip(corners, weights, strict=True) for text in map(repr, pair)), repr(distance)]
        for corners, weights, distance in zip(
            landmarks.corners.tolist(), landmarks.barycentric.tolist(), landmarks.distance_mm.tolist(), strict=True
        )
    ]
    return [*(name for pair in _CORNER_COLUMNS for name in pair), _DISTANCE_COLUMN], rows


def write_landmark_indices(path: Path | str, indices: Mapping[str, int]) -> None:
    """Write landmarks given as vertex numbers, as CSV with the header `name,vertex`, atomically.

    Args:
        path: the file.
        indices: name -> vertex, counting from 0.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    write_text(Path(path), _indices_text(indices))


def _indices_text(indices: Mapping[str, int]) -> str:
    return rows_text([["name", "vertex"], *([k, str(int(v))] for k, v in indices.items())])


def _format(path: Path, verb: str) -> LandmarkFormat:
    # The longest ending first, so that .mrk.json is not read as .json.
    for ending in sorted(LANDMARK_FORMATS, key=len, reverse=True):
        if path.name.lower().endswith(ending):
            return LANDMARK_FORMATS[ending]
    endings = [*LANDMARK_FORMATS, *(READ_ONLY_LANDMARKS if verb == "read" else ())]
    problem = "can be read, not written" if path.suffix.lower() in READ_ONLY_LANDMARKS else "is not a landmark format"
    raise FileFormatError(
        f"Cannot {verb} {path}: the ending '{path.suffix}' {problem}; use one of {', '.join(endings)}."
    )


def _content(path: Path) -> bytes:
    data = read_bytes(path, LARGEST_LANDMARK_FILE_BYTES)
    if not data.strip():
        raise FileFormatError(f"Cannot read {path}: it is empty; export or copy it again.")
    return data


def _point(values: Iterable[Any], landmark_name: str, path: Path) -> FloatArray:
    try:
        numbers = [float(value) for value in values]
    except (TypeError, ValueError, OverflowError) as error:
        comma = " but may have a decimal comma, so export it with decimal points" * ("," in str(error))
        raise damage_error(path, f"{landmark_name} has a coordinate that is not a number{comma}") from error
    if len(numbers) != 3:
        raise damage_error(path, f"{landmark_name} has {len(numbers)} coordinates, not 3")
    return np.array(numbers, dtype=np.float64)


def _json_reader(parse: Callable[[Any, Path], Pairs]) -> Callable[[bytes, Path], Pairs]:
    """Return a reader of JSON in which missing or wrong values raise a `FileFormatError`."""

    def wrapped(data: bytes, path: Path) -> Pairs:
        value = json_value(data, path)
        try:
            return list(parse(value, path))
        except FileError:
            raise
        except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError) as error:
            raise damage_error(path, "it is JSON, but not laid out as a landmark file, so export it again") from error

    return wrapped


def _ljson(value: Any, path: Path) -> Pairs:
    version = value["version"]
    if version == 1:
        for group in value["groups"]:
            points = [entry["point"] for entry in group["landmarks"]]
            labels = [{"label": group["label"], "mask": range(len(points))}]
            yield from _ljson_group({"landmarks": {"points": points}, "labels": labels}, "", path)
    elif version == 2:
        yield from _ljson_group(value, "", path)
    elif version == 3:
        groups = value["groups"]
        for name, group in groups.items():
            _label(name, path)
            yield from _ljson_group(group, f"{name}_" if len(groups) > 1 else "", path)
    else:
        raise damage_error(path, f"it is LJSON of version {str(version)[:20]}, but only 1 to 3 are known")


def _ljson_group(group: Any, prefix: str, path: Path) -> Pairs:
    points = group["landmarks"]["points"]
    names: dict[int, str] = {}
    for entry in group.get("labels", []):
        mask, label = entry["mask"], _label(entry["label"], path)
        for position, index in enumerate(mask):
            if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(points):
                raise damage_error(path, f"label '{label[:60]}' names a point that does not exist")
            name = label if len(mask) == 1 else f"{label}_{position}"
            names.setdefault(index, prefix + name)
    ordered = [*names, *(i for i in range(len(points)) if i not in names)]
    for i in ordered:
        name = names.get(i, f"{prefix}point_{i}")
        yield name, None if _is_missing(points[i]) else _point(points[i], f"landmark '{name[:60]}'", path)


def _label(value: Any, path: Path) -> str:
    label = str(value)
    if len(label) > _LONGEST_LABEL:
        raise damage_error(path, f"it has a label of {len(label)} characters ('{label[:60]}...'), so shorten it")
    return label


def _is_missing(point: Any) -> bool:
    """Return whether LJSON has no point here: null, or null coordinates."""
    return point is None or all(value is None for value in point)


def _write_ljson(landmarks: Mapping[str, FloatArray]) -> str:
    group = {
        "labels": [{"label": name, "mask": [i]} for i, name in enumerate(landmarks)],
        "landmarks": {"connectivity": [], "points": [_numbers(point) for point in landmarks.values()]},
    }
    return json.dumps({"groups": {"LJSON": group}, "version": 3}, indent=1) + "\n"


def _slicer(value: Any, path: Path) -> Pairs:
    for markup in value["markups"]:
        sign = _sign_of_frame(str(markup.get("coordinateSystem", "LPS")), path)
        # A unit, or a list of units of the axes.
        unit = next(iter(re.findall(r"\w+", str(markup.get("coordinateUnits") or "mm").lower())), "mm")
        if unit not in MM_OF_UNITS:
            raise damage_error(path, f"its coordinate units are {unit[:20]!r}, so save it in mm")
        for entry in markup["controlPoints"]:
            name = str(entry.get("label") or entry.get("id") or "").strip()
            is_absent = entry.get("positionStatus", "defined") != "defined"
            xyz = None if is_absent else _point(entry["position"], f"landmark '{name[:60]}'", path)
            yield name, None if xyz is None else MM_OF_UNITS[unit] * sign * xyz + 0.0


def _sign_of_frame(system: str, path: Path) -> FloatArray:
    """Return the signs (3,) that convert coordinates of 3D Slicer to LPS; old files use 0 for RAS and 1 for LPS."""
    letters = "".join(word[:1] for word in system.strip().upper().split("-"))
    frame = {"0": "RAS", "1": "LPS"}.get(letters, letters if "-" in system else system.strip().upper())
    if frame not in ("LPS", "RAS"):
        raise damage_error(path, f"its coordinate system is '{system[:20]}', neither LPS nor RAS")
    return np.array(RAS_TO_LPS if frame == "RAS" else [1.0, 1.0, 1.0])


def slicer_curves(data: bytes, path: Path) -> list[tuple[list[str], bool]]:
    """Return the labels along each curve of a file of 3D Slicer, and whether it is closed."""
    return [
        (
            [str(entry.get("label") or entry.get("id") or "").strip() for entry in markup["controlPoints"]],
            "Closed" in kind,
        )
        for markup in json_value(data, path)["markups"]
        if (kind := str(markup.get("type"))) in ("Curve", "ClosedCurve")
    ]


def markups_text(landmarks: Mapping[str, FloatArray], descriptions: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return landmarks in LPS and mm as the text of a file of 3D Slicer, with descriptions by name."""
    points = [
        {"id": str(i), "label": name, "position": _numbers(np.nan_to_num(point)),
         "positionStatus": "undefined" if np.isnan(point).any() else "defined",
         **({"description": descriptions[name]} if descriptions else {})}
        for i, (name, point) in enumerate(landmarks.items(), start=1)
    ]  # fmt: skip
    schema = (
        "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
        "markups-schema-v1.0.3.json#"
    )
    markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
    return json.dumps({"@schema": schema, "markups": [markup]}, indent=1) + "\n"


def _scalismo(value: Any, path: Path) -> Pairs:
    return [
        (str(entry["id"]), _point(entry["coordinates"], f"landmark '{str(entry['id'])[:60]}'", path)) for entry in value
    ]


def _write_scalismo(landmarks: Mapping[str, FloatArray]) -> str:
    entries = [{"id": name, "coordinates": _numbers(point)} for name, point in landmarks.items()]
    return json.dumps(entries, indent=1) + "\n"


def _any_json(value: Any, path: Path) -> Pairs:
    if isinstance(value, list):
        return _scalismo(value, path)
    if "markups" in value:
        return _slicer(value, path)
    return _ljson(value, path)


def _numbers(point: FloatArray) -> list[float]:
    return [float(value) for value in point]


def _read_pp(data: bytes, path: Path) -> Pairs:
    root = xml_root(data, path)
    if root.tag != "PickedPoints":
        raise damage_error(path, "it is not a MeshLab file of picked points")
    for entry in root.iter("point"):
        name = (entry.get("name") or "").strip()
        is_absent = entry.get("active", "1").strip().lower() in ("0", "false")
        xyz = (entry.get(axis) for axis in "xyz")
        yield name, None if is_absent else _point(xyz, f"landmark '{name[:60]}'", path)


def _write_pp(landmarks: Mapping[str, FloatArray]) -> str:
    root = ET.Element("PickedPoints")
    for name, point in landmarks.items():
        x, y, z = (repr(value) for value in _numbers(point))
        ET.SubElement(root, "point", {"x": x, "y": y, "z": z, "name": name, "active": "1"})
    ET.indent(root)
    return "<!DOCTYPE PickedPoints>\n" + ET.tostring(root, encoding="unicode") + "\n"


def csv_rows(data: bytes, path: Path) -> list[list[str]]:
    """Return the rows of UTF-8 text separated by commas, semicolons or tabs, without white space around cells.

    Empty lines and comments (`#`) are skipped.

    Raises:
        FileFormatError: it is something else.
    """
    try:
        text = data.decode("utf-8-sig")
        lines = [f"{line}\n" for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        return [[unescape_formula(cell.strip()) for cell in row] for row in csv_lines("".join(lines))]
    except (UnicodeDecodeError, csv.Error) as error:
        raise damage_error(path, "it is not comma-separated text") from error
    except ValueError as error:
        raise FileFormatError(f"{path} {error}; correct the table.") from error


def _read_csv(data: bytes, path: Path) -> Pairs:
    rows = csv_rows(data, path)
    columns, width = [1, 2, 3], len(rows[0]) if rows else 0
    if rows and not all(is_number(cell) for cell in rows[0][1:4]):
        header = [cell.lower() for cell in rows[0]]
        if header[:2] == ["name", "vertex"]:
            raise damage_error(path, "it contains vertex numbers, not coordinates ('name,x,y,z')")
        if not {"x", "y", "z"} <= set(header[1:]):
            raise damage_error(path, "its first line is neither 'name,x,y,z' nor a landmark")
        columns = [header.index(axis, 1) for axis in "xyz"]
        rows = rows[1:]
    elif rows and len(rows[0]) != 4:
        raise damage_error(path, f"its first line has {len(rows[0])} columns, not the four of 'name,x,y,z'")
    for row in rows:
        if len(row) <= max(columns):
            raise damage_error(path, f"landmark '{row[0][:60]}' has fewer than 3 coordinates")
        if len(row) > width and any(row[width:]):
            problem = f"landmark '{row[0][:60]}' has {len(row)} columns, and the first line {width}"
            raise damage_error(path, f"{problem}; if it has decimal commas, separate the columns by semicolons")
        is_absent = all(row[c].lower() in MISSING for c in columns)
        xyz = (row[c] for c in columns)
        yield row[0], None if is_absent else _point(xyz, f"landmark '{row[0][:60]}'", path)


def _write_csv(landmarks: Mapping[str, FloatArray]) -> str:
    rows = [[name, *(["NA"] * 3 if np.isnan(p).any() else map(repr, _numbers(p)))] for name, p in landmarks.items()]
    return rows_text([["name", "x", "y", "z"], *rows])


def _text_lines(data: bytes) -> list[str]:
    return [line.strip() for line in data.decode("utf-8-sig", "replace").splitlines()]


def _number_lines(data: bytes, path: Path) -> list[str]:
    """Return the lines of text with numbers that commas may separate, without white space around them."""
    return _text_lines(numeric_text(data, path, commas_separate=True))


def _read_bnd(data: bytes, path: Path) -> Pairs:
    for k, line in enumerate(filter(None, _number_lines(data, path))):
        name, words = f"point_{k}", line.split()
        if len(words) != 4 or not words[0].isascii() or not words[0].isdecimal():
            raise damage_error(path, f"{name} is not a row of a vertex number and x y z; it is damaged or cut short")
        yield name, _point(words[1:], name, path)


def _read_lm3(data: bytes, path: Path) -> Pairs:
    lines = [line for line in _text_lines(numeric_text(data, path)) if line]
    header_matches = (re.fullmatch(r"(\d{1,6})(?:\s+landmarks?\s*:?)?", line, re.IGNORECASE) for line in lines)
    header_row, count = next(((i, int(m[1])) for i, m in enumerate(header_matches) if m), (0, -1))
    if count < 0:
        raise damage_error(path, "it does not state the number of landmarks, so it is not an .lm3 file")
    body = lines[header_row + 1 :]
    if len(body) != 2 * count:
        raise damage_error(
            path, f"it declares {count} landmarks, but {len(body)} lines follow; it is damaged or cut short"
        )
    return [
        (n, _point(xyz.split(), f"landmark '{n[:60]}'", path)) for n, xyz in zip(body[::2], body[1::2], strict=True)
    ]


_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"
_FCSV_EXTRA = 2  # cells after the columns, which Slicer 5 writes


def _read_fcsv(data: bytes, path: Path) -> Pairs:
    columns, system = _FCSV_COLUMNS.split(","), "RAS"
    for line in _text_lines(data):
        name, separator, value = line.lstrip("# ").partition("=")
        if line.startswith("#") and separator:
            if name.strip().lower() == "columns":
                columns = [cell.strip() for cell in value.split(",")]
            elif name.strip().lower() == "coordinatesystem":
                system = value
    sign = _sign_of_frame(system, path)
    if not {"x", "y", "z"} <= set(columns):
        raise damage_error(path, "its columns are not those of 3D Slicer's fiducials, so export it again")
    for row in csv_rows(data, path):
        entry = dict(zip(columns, row, strict=False))
        name = entry.get("label") or entry.get("id") or ""
        if len(row) > len(columns) + _FCSV_EXTRA and not any("." in entry.get(axis, "") for axis in "xyz"):
            raise damage_error(path, f"landmark '{name[:60]}' has {len(row)} cells, perhaps for decimal commas; "
                               "export it again with decimal points")  # fmt: skip
        point = _point((entry.get(axis) for axis in "xyz"), f"landmark '{name[:60]}'", path)
        yield name, sign * point + 0.0


def fcsv_text(landmarks: Mapping[str, FloatArray], descriptions: Mapping[str, str] = MappingProxyType({})) -> str:
    """Return landmarks in LPS as the text of a 3D Slicer fiducial file, with descriptions by name."""
    head = f"# Markups fiducial file version = 5.6\n# CoordinateSystem = LPS\n# columns = {_FCSV_COLUMNS}\n"
    rows = (
        [str(i), *map(repr, _numbers(point)), "0", "0", "0", "1", "1", "1", "0", name, descriptions.get(name, ""), ""]
        for i, (name, point) in enumerate(landmarks.items(), start=1)
    )
    return head + rows_text(rows)


def _read_tps(data: bytes, path: Path) -> Pairs:
    specimens = list(tps_specimens(data.decode("utf-8-sig", "replace"), path))
    if len(specimens) != 1:
        raise damage_error(path, f"it has {len(specimens)} specimens, so save each in a file of its own")
    [(rows, curves, _)] = specimens
    if any(len(row) == 2 for row in rows):
        raise damage_error(path, "its landmarks are of two dimensions (LM=), and those of a surface have three (LM3=)")
    rows = [*rows, *(row for curve, _ in curves for row in curve)]
    return [(f"point_{i}", None if np.isnan(p).any() else _point(p, f"point_{i}", path)) for i, p in enumerate(rows)]


def _read_amira(data: bytes, path: Path) -> Pairs:
    text = "\n".join(_text_lines(numeric_text(data, path)))
    count = re.search(r"^define\s+Markers\s+(\d{1,9})\s*$", text, re.MULTILINE)
    block = re.search(r"^Markers\s*\{\s*(?:float|double)\[3\]\s+Coordinates\s*\}\s*=?\s*@(\d+)", text, re.MULTILINE)
    if not text.startswith("#") or " ASCII " not in text.partition("\n")[0] or not (count and block):
        raise damage_error(path, "it is not an ASCII landmark file of Amira with Markers, so save it as landmarkAscii")
    if sets := re.search(r"NumSets\s+(?!1\b)(\d+)", text):
        raise damage_error(path, f"it has {sets[1][:9]} sets of landmarks, so save each in a file of its own")
    body = re.search(rf"^@{block[1]}\s*\n([^@]*)", text, re.MULTILINE)
    rows = [row for row in (body[1] if body else "").splitlines() if row and not row.startswith("#")]
    if len(rows) != int(count[1]):
        raise damage_error(path, f"it declares {count[1]} landmarks, and {len(rows)} rows follow; {CUT_SHORT}")
    return [(f"point_{k}", _point(row.split(), f"point_{k}", path)) for k, row in enumerate(rows)]


def _read_tlms(data: bytes, path: Path) -> Pairs:
    for line in filter(None, _text_lines(numeric_text(data, path))):
        words = line.split()
        if len(words) != 5 or words[1] not in ("0", "1"):
            raise damage_error(path, "it has a line other than 'name visible x y z', so it is not scalismo's .tlms")
        yield words[0], _point(words[2:], f"landmark '{words[0][:60]}'", path) if words[1] == "1" else None


_POINTS_HEAD = re.compile(r"version\b.*|n_points\s*:\s*(\d{1,6})|(?:s\s+)?(\d{1,6})|[{}]", re.IGNORECASE)


def _read_points(data: bytes, path: Path) -> Pairs:
    """Read rows `x y z` or `name x y z`, optionally after a count or a header, as landmark editors save them."""
    count, declared = 0, None
    for line in _number_lines(data, path):
        row = line.partition("#")[0].strip()
        head = _POINTS_HEAD.fullmatch(row)
        if not row or head:
            declared = int(next(filter(None, head.groups()), 0)) or declared if head else declared
            continue
        words = row.replace(";", " ").split()
        name = words[0] if len(words) == 4 else f"point_{count}"
        if not count and not any(map(is_number, words)):
            continue  # names of columns
        if len(words) not in (3, 4):
            raise damage_error(path, f"{name} is not a row of 'x y z' or 'name x y z' but has {len(words)} columns")
        yield name, _point(words[-3:], f"landmark '{name[:60]}'", path)
        count += 1
    if declared is not None and declared != count:
        raise damage_error(
            path, f"it declares {declared} landmarks, but {count} rows follow; it is damaged or cut short"
        )


LANDMARK_FORMATS: Mapping[str, LandmarkFormat] = MappingProxyType(
    {
        ".ljson": LandmarkFormat("menpo LJSON", _json_reader(_ljson), _write_ljson),
        ".pp": LandmarkFormat("MeshLab picked points", _read_pp, _write_pp),
        ".mrk.json": LandmarkFormat("3D Slicer markups", _json_reader(_slicer), markups_text),
        ".json": LandmarkFormat("scalismo", _json_reader(_any_json), _write_scalismo),
        ".csv": LandmarkFormat("CSV", _read_csv, _write_csv),
        ".fcsv": LandmarkFormat("3D Slicer fiducials", _read_fcsv, fcsv_text),
    }
)
"""File name ending -> landmark format that is read and written."""

READ_ONLY_LANDMARKS: Mapping[str, Callable[[bytes, Path], Pairs]] = MappingProxyType(
    {
        ".bnd": _read_bnd,
        ".lm3": _read_lm3,
        ".tps": _read_tps,
        ".tlms": _read_tlms,
        ".landmarkascii": _read_amira,
        ".txt": _read_points,
        ".pts": _read_points,
    }
)
"""File name ending -> reader (content, path) -> names and points, for formats that are not written."""

FIDUCIAL_ENDINGS = (".landmarks.csv", ".landmarks.mrk.json", ".landmarks.fcsv")
"""Endings, after NAME, of the files with the landmarks of a fit."""

Found = Mapping[str, Mapping[str, Any]]
"""Name -> `at` (x, y, z) in the frame and unit of the scan, and `stddev_mm` along its axes, None if unknown."""


def fiducial_texts(fiducials: Found) -> dict[str, str]:
    """Return ending -> text of each file: a table, and 3D Slicer's two formats, all in the scan's frame and unit.

    Slicer interprets the coordinates of a mesh as LPS and mm, so it shows the points on the scan.
    """
    points = {name: np.array(fiducial["at"], dtype=np.float64) for name, fiducial in fiducials.items()}
    descriptions = {name: _describe(fiducial["stddev_mm"]) for name, fiducial in fiducials.items()}
    return point_texts(points, descriptions, _table(fiducials))


def point_texts(points: Mapping[str, FloatArray], descriptions: Mapping[str, str], table: str) -> dict[str, str]:
    """Return ending -> text of each file: `table`, and 3D Slicer's two formats of `points` with `descriptions`."""
    texts = table, markups_text(points, descriptions), fcsv_text(points, descriptions)
    return dict(zip(FIDUCIAL_ENDINGS, texts, strict=True))


def _table(fiducials: Found) -> str:
    rows = (
        [name, *_format_numbers(fiducial["at"]), *_format_numbers(fiducial["stddev_mm"])]
        for name, fiducial in fiducials.items()
    )
    return rows_text([["name", *"xyz", *(f"stddev_{axis}_mm" for axis in "xyz")], *rows])


def _format_numbers(numbers: Sequence[float] | None) -> list[str]:
    return [""] * 3 if numbers is None else [repr(float(number)) for number in numbers]


def _describe(stddev_mm: Sequence[float] | None) -> str:
    return "" if stddev_mm is None else f"standard deviation {' '.join(f'{mm:.2f}' for mm in stddev_mm)} mm"
