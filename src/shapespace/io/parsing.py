"""Parsing functions of all readers: numbers from text, polygons to triangles, untrusted XML and JSON."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError
from shapespace.io.read_limits import MOST_PARTS
from shapespace.types import RAS_TO_LPS, BoolArray, ByteArray, FloatArray, Mesh

IndexArray = npt.NDArray[np.int64]

CUT_SHORT = "the file is damaged or cut short, so export it again"

# Words of text take forty times their size as Python objects, so text is split in blocks of this size.
_BLOCK_BYTES = 1 << 18
_LINE_END = re.compile(rb"\r?\n|\r")
_SPACE = re.compile(rb"\s")
_WORD = re.compile(rb"\s*(\S+)[ \t]*\r?\n?")
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
SPACE = "SPACE=LPS"
"""Mark of the frame in headers of meshes, as 3D Slicer writes it."""
# In a comment, or in a field of legacy VTK, which precedes text with its length in binary files.
_RAS = re.compile(rb"\bSPACE(?:\s*[=:]\s*|\s+1\s+1\s+\w*string\s+)\W?(?:RAS|right-anterior-superior)\b", re.IGNORECASE)
_RAS_NOTE = "Its header states the frame RAS; it was converted to LPS."
_COMMENT = re.compile(rb"\s*(#|//|%|comment\b|.*=)")
"""Lines without coordinates: comments, lines of TPS with a key, and attributes of XML."""
_WORD_END = re.compile(rb"[\s;<>]+")
_WITH_COMMA = re.compile(rb"[+-]?\d*,\d+([eE][+-]?\d+)?")
_COMMA_OF_NUMBER = re.compile(rb"(?<![^\s;<>])([+-]?\d*),(\d+(?:[eE][+-]?\d+)?)(?![^\s;<>])")
_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_OTHER_ROLES = frozenset({"separator", "point"})
"""Roles of commas and points in numbers that exclude decimal commas in the same file."""
_COMMA_AT_NUMBER = re.compile(rb",[+\-.\d]")
_LEADING_ZERO, _LEADING_ZEROS = re.compile(rb"0\d+"), re.compile(rb"[+-]?0\d")
_THIN_SPACES = ("\u00a0".encode(), "\u2009".encode(), "\u202f".encode())
_THOUSANDS_WITH_SPACES = re.compile(rb"\d{1,3}(?:\xc2\xa0|\xe2\x80[\x89\xaf])\d{3}")
_THOUSANDS = re.compile(rb"[+-]?\d{1,3}(,\d{3})+\.|[+-]?\d{1,3}(\.\d{3})+,")


def damage_error(path: Path, problem: str) -> FileFormatError:
    """Return the one-sentence error that `path` cannot be read because of `problem`."""
    return FileFormatError(f"Cannot read {path}: {problem}.")


def is_number(text: str | bytes) -> bool:
    """Return whether text is a number, not-a-number and infinity included."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def plain_text(data: bytes) -> bytes:
    """Return `data` without the byte order mark of UTF-8."""
    return data.removeprefix(_BYTE_ORDER_MARK)


def numeric_text(data: bytes, path: Path, start: int = 0, *, commas_separate: bool = False) -> bytes:
    """Return text without its byte order mark, and with decimal points instead of the decimal commas of some locales.

    A comma is a decimal mark if the numbers of a line have other separators: `1,5 2,0 3` or `1,5; 2,0; 3`.

    Args:
        data: content of the file.
        path: path of the file, used in messages.
        start: index of the first byte after the header.
        commas_separate: whether the format allows commas between numbers, which become spaces: `1.5,2,3`, `1.5, 2, 3`.

    Raises:
        FileFormatError: ambiguous commas, or decimal commas and decimal points in the same file.
    """
    data = plain_text(data)
    if any(space in data for space in _THIN_SPACES) and (cut := _THOUSANDS_WITH_SPACES.search(data, start)):
        number, here = data.count(b"\n", 0, cut.start()) + 1, " ".join(cut[0].decode().split())
        raise damage_error(
            path, f"it has spaces for thousands in line {number} ({here!r}); export it again without them"
        )
    # Most files have no such comma, or only in a comment, and skip the slow check of each line.
    if data.find(b",", start) < 0 or not (commas_separate or _COMMA_AT_NUMBER.search(data, start)):
        return data
    out, first = list[bytes](), dict[str, int]()
    for number, line in enumerate(data[start:].splitlines(), data.count(b"\n", 0, start) + 1):
        role = _role_of_commas(line, commas_separate)
        is_mixed = first.setdefault(role, number) == number and "decimal" in first and bool(first.keys() & _OTHER_ROLES)
        if role == "unclear" or is_mixed:
            here = " ".join(line.decode("utf-8", "replace").split())[:60]
            other = (
                f", unlike line {min(n for other, n in first.items() if other in {'decimal'} | _OTHER_ROLES)}"
                if is_mixed and role != "unclear"
                else ""
            )
            raise damage_error(
                path, f"it may have decimal commas, or commas between numbers, in line {number} ({here!r}){other}; "
                "export it again with decimal points"
            )  # fmt: skip
        mark = rb"\1.\2" if role == "decimal" else b" " if commas_separate and not _COMMENT.match(line) else b""
        out.append(_COMMA_OF_NUMBER.sub(mark, line) if role == "decimal" else line.replace(b",", mark or b","))
    return data[:start] + b"\n".join(out) + b"\n" if commas_separate or "decimal" in first else data


def _role_of_commas(line: bytes, commas_separate: bool) -> str:
    """Return `decimal`, `separator`, `unclear`, `point` (numbers with decimal points), or `none`."""
    has_comma = b"," in line
    if not (has_comma or b"." in line) or _COMMENT.match(line):
        return "none"
    words = [word for word in (part.strip(b",") for part in _WORD_END.split(line)) if word]
    plain = [word for word in words if _NUMBER.fullmatch(word)]
    decimal = [word for word in words if _WITH_COMMA.fullmatch(word)]
    lists = [word for word in words if b"," in word and word not in decimal]
    # The name of a part or material may contain a number; coordinates are several numbers, or a number alone in a line.
    is_numeric = len(plain) + len(decimal) > 1 or len(plain) + len(decimal) == len(words)
    has_points = is_numeric and any(b"." in word for word in plain)
    if decimal and len(words) > commas_separate and (is_numeric or (commas_separate and lists)):
        between = commas_separate and re.search(rb",[\s;]|[\s;],", line.strip())
        # A word that begins with zeros is the rest of a number with spaces between thousands.
        is_cut = any(map(_LEADING_ZEROS.match, decimal))
        return "unclear" if has_points or lists or between or is_cut else "decimal"
    if commas_separate and has_comma:
        cells = b",".join([*lists, *plain]).split(b",")
        # Thousands, or the digits after a decimal comma, which may begin with a zero, unlike an integer.
        is_cut = any(map(_LEADING_ZERO.fullmatch, cells)) or (len(words) > 1 and any(map(_THOUSANDS.match, words)))
        return "unclear" if is_cut else "separator" if any(map(_NUMBER.fullmatch, cells)) else "none"
    is_list = any(len(cells := word.split(b",")) > 2 and all(map(_NUMBER.fullmatch, cells)) for word in lists)
    return "unclear" if is_list else "point" if has_points else "none"


def _block(text: bytes, start: int, end: re.Pattern[bytes], size: int = _BLOCK_BYTES) -> tuple[bytes, int]:
    match = end.search(text, start + min(size, _BLOCK_BYTES))
    stop = match.end() if match else len(text)
    return text[start:stop], stop


def line_blocks(text: bytes) -> Iterator[list[bytes]]:
    """Yield the lines of `text` in lists of some thousand, so that splitting the text takes little memory."""
    offset = 0
    while offset < len(text):
        block, offset = _block(text, offset, _LINE_END)
        yield block.splitlines()


class WordCursor:
    """Read position in text of words between white space; only a few words are in memory at a time.

    Args:
        data: content of the file.
        path: path of the file, used in messages.
        position: index of the first byte to read.
    """

    def __init__(self, data: bytes, path: Path, position: int = 0) -> None:
        self.data, self.path, self.position = data, path, position
        self.left = len(data) - position + 1
        """Bytes of text from the first position on, plus 1 because no space follows the last word."""

    def word(self) -> bytes:
        """Return the next word, or empty bytes at the end."""
        match = _WORD.match(self.data, self.position)
        if match is None:
            return b""
        self.position = match.end()
        return match[1]

    def words(self, count: int) -> Iterator[list[bytes]]:
        """Yield the next `count` words in lists; fewer if the text ends before."""
        while count > 0 and self.position < len(self.data):
            block, stop = _block(self.data, self.position, _SPACE, 16 * count)
            words = block.split(None, count)
            if len(words) > count:
                stop -= len(words.pop())
            self.position = stop
            count -= len(words)
            yield words


def floats_of(text: bytes, path: Path) -> FloatArray:
    """Return the numbers in `text`, between white space, as a flat float64 array.

    Raises:
        FileFormatError: a word is not a number.
    """
    return join_parts([floats(words, path) for words in WordCursor(text, path).words(len(text))], np.float64)


def ints_of(text: bytes, path: Path) -> IndexArray:
    """Return the numbers in `text`, between white space, as a flat int64 array.

    Raises:
        FileFormatError: a word is not an integer, or is too large for 64 bits.
    """
    return join_parts([ints(words, path) for words in WordCursor(text, path).words(len(text))], np.int64)


def join_parts(parts: Sequence[npt.NDArray[Any]], kind: npt.DTypeLike, *row: int) -> npt.NDArray[Any]:
    """Return `parts` one after another, or an empty array with rows of shape `row`."""
    return np.concatenate(parts) if parts else np.zeros((0, *row), dtype=kind)


def floats(tokens: Iterable[bytes], path: Path) -> FloatArray:
    """Return `tokens` as a flat float64 array.

    Raises:
        FileFormatError: a word is not a number.
    """
    try:
        return np.fromiter(map(float, tokens), dtype=np.float64)
    except ValueError as error:
        comma = ", perhaps a decimal comma, so export it with decimal points" * ("," in str(error))
        raise damage_error(path, f"it has text where a number should be ({_shorten(error)}){comma}") from error


def ints(tokens: Iterable[bytes], path: Path) -> IndexArray:
    """Return `tokens` as a flat int64 array.

    Raises:
        FileFormatError: a word is not an integer, or is too large for 64 bits.
    """
    try:
        return np.fromiter(map(int, tokens), dtype=np.int64)
    except (ValueError, OverflowError) as error:
        raise damage_error(path, f"it has text where an integer should be ({_shorten(error)})") from error


def _shorten(error: Exception) -> str:
    return " ".join(str(error).rstrip(".").split())[:80]


def fan_triangles(counts: npt.ArrayLike, corners: npt.ArrayLike) -> IndexArray:
    """Cut polygons into fans of triangles around their first corners, in order.

    Args:
        counts: (P,) number of corners of each polygon; polygons with fewer than 3 corners yield no triangle.
        corners: (sum of counts,) the corners of all polygons, one after another.

    Returns:
        (F, 3) int64, F = sum of (count - 2).
    """
    sizes = np.asarray(counts, dtype=np.int64).reshape(-1)
    flat = np.asarray(corners, dtype=np.int64).reshape(-1)
    if len(sizes) and (sizes == sizes[0]).all():
        polygons = flat.reshape(len(sizes), sizes[0])
        width = max(int(sizes[0]) - 2, 0)
        out = np.empty((len(sizes), width, 3), dtype=np.int64)
        out[:, :, 0] = polygons[:, :1]
        out[:, :, 1] = polygons[:, 1 : 1 + width]
        out[:, :, 2] = polygons[:, 2 : 2 + width]
        return out.reshape(-1, 3)
    starts = np.cumsum(sizes) - sizes
    fans = np.maximum(sizes - 2, 0)
    first = np.repeat(starts, fans)
    # The second corner of triangle k of a polygon is at k + 1 after the first corner of the polygon.
    corner = np.arange(1, len(first) + 1, dtype=np.int64)
    corner += np.repeat(starts - (np.cumsum(fans) - fans), fans)
    out = np.empty((len(first), 3), dtype=np.int64)
    out[:, 0], out[:, 1] = flat[first], flat[corner]
    corner += 1
    out[:, 2] = flat[corner]
    return out


def strip_triangles(counts: npt.ArrayLike, corners: npt.ArrayLike) -> IndexArray:
    """Split triangle strips into triangles (F, 3) int64; every second triangle is flipped for a consistent orientation.

    Args:
        counts: (P,) number of corners of each strip.
        corners: (sum of counts,) the corners of all strips, one after another.
    """
    sizes = np.asarray(counts, dtype=np.int64).reshape(-1)
    flat = np.asarray(corners, dtype=np.int64).reshape(-1)
    starts = np.cumsum(sizes) - sizes
    triangle_counts = np.maximum(sizes - 2, 0)
    step = np.arange(int(triangle_counts.sum()), dtype=np.int64) - np.repeat(
        np.cumsum(triangle_counts) - triangle_counts, triangle_counts
    )
    first_corner = np.repeat(starts, triangle_counts) + step
    step %= 2
    out = np.empty((len(first_corner), 3), dtype=np.int64)
    out[:, 0], out[:, 1], out[:, 2] = flat[first_corner], flat[first_corner + 1 + step], flat[first_corner + 2 - step]
    return out


def mesh_of(
    vertices: FloatArray,
    faces: IndexArray | None,
    path: Path,
    colours: ByteArray | None = None,
    notes: tuple[str, ...] = (),
    observed: BoolArray | None = None,
    position_std: FloatArray | None = None,
    header: bytes = b"",
) -> Mesh:
    """Return the mesh read from `path`: (V, 3) float64 and (F, 3) int64, which `Mesh` checks and narrows.

    Vertices of a file whose `header` has the mark SPACE=RAS are converted to LPS, with a note.

    Raises:
        MeshError: faces that point past the end of the vertices.
    """
    if _RAS.search(header):
        vertices, notes = vertices * RAS_TO_LPS + 0.0, (*notes, _RAS_NOTE)  # no -0.0
    return Mesh(
        vertices=vertices,
        faces=faces,  # pyright: ignore[reportArgumentType]  # Mesh narrows it to int32
        name=path.name,
        colours=colours,
        notes=notes,
        observed=observed,
        position_std=position_std,
    )


def bytes_of_colours(values: npt.NDArray[Any]) -> ByteArray | None:
    """Return (V, 3) uint8 from the colours of a file, or None if they are invalid; a mesh may have no colours.

    Args:
        values: (V, 3) uint8, or other numbers up to 1, 255 or 65535.
    """
    if values.dtype == np.uint8:
        return values
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    if not (low >= 0.0 and high <= 65535.0):
        return None
    scale = 255.0 if high <= 1.0 else 1.0 if high <= 255.0 else 255.0 / 65535.0
    return np.rint(values * scale).astype(np.uint8)


def colours_of_words(rows: Sequence[Sequence[bytes]], first: int, path: Path) -> FloatArray | None:
    """Return the three numbers from word `first` of each row, (n, 3), or None if a row lacks them."""
    try:
        columns = chain.from_iterable(words[first : first + 3] for words in rows)
        return floats(columns, path).reshape(-1, 3) if min(map(len, rows)) >= first + 3 else None
    except FileFormatError:
        return None


def joined_colours(parts: Sequence[npt.NDArray[Any] | None]) -> ByteArray | None:
    """Return the colours of all parts (V, 3), see `bytes_of_colours`; None if a part has no colours."""
    known = [part for part in parts if part is not None]
    return bytes_of_colours(np.concatenate(known)) if known and len(known) == len(parts) else None


def number_lines(values: npt.NDArray[Any], pattern: str) -> str:
    """Return the rows of `values` (N, C) as text, each formatted with the %-`pattern`, ending in newlines."""
    if not len(values):
        return ""
    return (pattern + "\n") * len(values) % tuple(values.ravel().tolist())


_BARE_DOCTYPE = re.compile(rb"<!DOCTYPE\s+[\w:.-]{1,80}\s*>")


class _LimitedTreeBuilder(ET.TreeBuilder):
    elements = 0

    def start(self, tag: str, attrs: dict[str, str], /) -> ET.Element:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.elements += 1
        if self.elements > MOST_PARTS:
            raise ValueError(f"it has more than {MOST_PARTS} elements, which no such file needs")
        return super().start(tag, attrs)

    def doctype(self, name: str, pubid: str | None, system: str | None) -> None:
        raise ValueError("it declares a document type, which is not allowed in such a file")


def xml_root(data: bytes, path: Path) -> ET.Element:
    """Parse untrusted XML; document types with declarations, and therefore entities, are rejected.

    Raises:
        FileFormatError: it is not well-formed XML, or its document type is more than a name.
    """
    # MeshLab starts its files with a bare <!DOCTYPE name>, which declares nothing.
    data = _BARE_DOCTYPE.sub(b"", data, count=1)
    parser = ET.XMLParser(target=_LimitedTreeBuilder())
    try:
        parser.feed(data)
        return parser.close()
    except ET.ParseError as error:
        raise damage_error(path, f"it is not well-formed XML ({_shorten(error)})") from error
    except (ValueError, LookupError) as error:
        raise damage_error(path, _shorten(error)) from error


def json_value(data: bytes, path: Path) -> Any:
    """Parse untrusted JSON.

    Raises:
        FileFormatError: it is not JSON, or is nested too deeply.
    """
    try:
        return json.loads(data.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise damage_error(path, f"it is not valid JSON ({_shorten(error)})") from error


def check_count(declared: int, bytes_each: int, available: int, item_name: str, path: Path) -> None:
    """Check that a file is large enough for the items that its header declares, before they are allocated.

    Args:
        declared: number of items that the header declares.
        bytes_each: smallest size of an item in the file, bytes.
        available: number of bytes in the file for these items.
        item_name: plural noun of the items for the message, such as "vertices" or "faces".
        path: path of the file, used in messages.

    Raises:
        FileFormatError: the declared number is too large or negative.
    """
    if declared < 0:
        raise damage_error(path, f"its header declares {declared} {item_name}")
    if declared * bytes_each > available:
        raise damage_error(
            path,
            f"its header declares {declared} {item_name}, but only {max(available, 0)} bytes follow; {CUT_SHORT}",
        )
