"""scalismo's `.h5.json`: the tree of a statismo file as text, in HDF5/JSON of The HDF Group."""

from __future__ import annotations

import json
import math
import uuid
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, cast

import msgspec
import numpy as np
import numpy.typing as npt

from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import LinearModel
from shapespace.formats.statismo import model_of, tree_of
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import atomic_path, read_bytes
from shapespace.io.sandbox import FileContent, SandboxError

_AGAIN = "export it again from the original program"
_LARGEST_BYTES = 2**31  # 2 GiB
_MOST_NODES = 4096  # limit on damaged files; models have tens
_DEEPEST = 16  # limit on damaged files; models have three levels
_LONGEST_NAME = 1024  # characters; limit on damaged files
_MARKS = (b'"apiVersion"', b"H5T_", b"H5S_", b"H5L_")
_FLOAT: Final = {"class": "H5T_FLOAT", "base": "H5T_IEEE_F32LE"}
_INTEGER: Final = {"class": "H5T_INTEGER", "base": "H5T_STD_I32LE"}
_TEXT: Final = {
    "class": "H5T_STRING",
    "charSet": "H5T_CSET_UTF8",
    "strPad": "H5T_STR_NULLTERM",
    "length": "H5T_VARIABLE",
}
_SCALAR: Final = {"class": "H5S_SCALAR"}


def is_scalismo_json(path: Path, head: bytes) -> bool:
    """Return whether a file begins like JSON, and has the ending of scalismo or the beginning of HDF5/JSON."""
    start = head.lstrip()
    if not start.startswith(b"{"):
        return False
    return path.name.lower().endswith((".h5.json", ".h5")) or any(mark in head for mark in _MARKS)


def read_scalismo_json(path: Path) -> LinearModel:
    """Read HDF5/JSON, the only format that scalismo writes from 0.92 on, with the ending `.json` or `.h5`."""
    check_file(path, _LARGEST_BYTES, _AGAIN)
    try:
        tree = _tree(read_bytes(path))
    except (ValueError, OverflowError, RecursionError, MemoryError) as error:
        message = " ".join(str(error).split())[:120].rstrip(".")
        raise ModelFileError(f"{path} is damaged, or not HDF5/JSON: {message}; {_AGAIN}.") from error
    return model_of(tree, path)


def write_scalismo_json(model: LinearModel, path: Path) -> Sequence[str]:
    """As `ModelFormat.write`."""
    tree, notes = tree_of(model)
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8", newline="\n") as out:
        out.writelines(_text_of(tree))
    return notes


class _Link(msgspec.Struct):
    title: str
    id: str
    collection: str = ""
    kind: str = msgspec.field(default="H5L_TYPE_HARD", name="class")


class _Attribute(msgspec.Struct):
    name: str
    value: Any = None


class _Group(msgspec.Struct):
    links: list[_Link] = []
    attributes: list[_Attribute] = []


class _Dataset(msgspec.Struct):
    type: Any = None
    shape: Any = None
    value: msgspec.Raw = msgspec.Raw(b"null")
    attributes: list[_Attribute] = []


class _File(msgspec.Struct):
    root: str
    groups: dict[str, _Group]
    datasets: dict[str, _Dataset] = {}


def _tree(text: bytes) -> FileContent:
    """Return the tree of linked objects from the root; objects without a link are ignored.

    Raises:
        ValueError: it is not such a file; the message is a clause.
    """
    file = msgspec.json.decode(text, type=_File)
    arrays: dict[str, npt.NDArray[Any]] = {}
    texts: dict[str, str] = {}
    attributes: dict[str, Mapping[str, Any]] = {}
    groups: list[str] = []
    left, waiting = len(text), [("", file.root)]
    while waiting:
        path, known_as = waiting.pop()
        if known_as not in file.groups:
            raise SandboxError(f"there is no group {path or '/'} in it")
        if len(groups) + len(arrays) + len(waiting) > _MOST_NODES or path.count("/") > _DEEPEST:
            raise SandboxError("it has more groups than any model")
        group = file.groups[known_as]
        groups.append(path or "/")
        attributes[path or "/"] = _attributes(group.attributes)
        for link in group.links:
            inner = f"{path}/{link.title}"
            if link.kind != "H5L_TYPE_HARD" or len(link.title) > _LONGEST_NAME:
                raise SandboxError(f"{inner[:_LONGEST_NAME]} is a link to elsewhere")
            if link.collection == "groups":
                waiting.append((inner, link.id))
            elif link.id in file.datasets:
                dataset = file.datasets[link.id]
                left -= len(bytes(dataset.value))
                if left < 0:
                    raise SandboxError("it links to the same values too often")
                attributes[inner] = _attributes(dataset.attributes)
                value = _value(dataset, inner)
                if isinstance(value, str):
                    texts[inner] = value
                elif value is not None:
                    arrays[inner] = value
    return FileContent(arrays, texts, attributes, tuple(groups))


def _attributes(entries: Sequence[_Attribute]) -> dict[str, Any]:
    """Return numbers and texts by name; converters of HDF5 files write single values as lists with one item."""
    values: dict[str, Any] = {}
    for entry in entries:
        value = _unwrap_lists(entry.value)
        if isinstance(value, str | int | float):
            values[entry.name] = value.rstrip("\0") if isinstance(value, str) else value
    return values


def _value(dataset: _Dataset, path: str) -> npt.NDArray[Any] | str | None:
    """Return the content of a data set: numbers, a text, or None for other types."""
    kind = str(_get_item(dataset.type, "class"))
    base = str(_get_item(dataset.type, "base"))
    if kind == "H5T_STRING":
        value = _unwrap_lists(msgspec.json.decode(dataset.value))
        return value.rstrip("\0") if isinstance(value, str) else None
    if kind not in ("H5T_FLOAT", "H5T_INTEGER"):
        return None
    number_type: Any = int if kind == "H5T_INTEGER" else float
    dims = _get_item(dataset.shape, "dims")
    shape = cast(list[Any], dims) if isinstance(dims, list) else []
    if len(shape) > 2 or not all(isinstance(size, int) and size >= 0 for size in shape):
        return None
    if shape and math.prod(shape) == 0:
        return np.empty(shape)
    typed = number_type if not shape else list[number_type] if len(shape) == 1 else list[list[number_type]]
    array = np.array(msgspec.json.decode(dataset.value, type=typed, strict=True))
    if array.shape != tuple(shape) or array.dtype.kind not in "iuf":
        raise SandboxError(f"{path} is cut short, or does not have its declared shape {shape}")
    # Characters of legacy VTK files are stored as such numbers.
    return array.astype(np.uint8) if base.endswith(("I8LE", "U8LE", "I8BE", "U8BE")) else array


def _unwrap_lists(value: Any) -> Any:
    """Return the innermost value of nested lists with one item."""
    while isinstance(value, list) and len(cast(list[Any], value)) == 1:
        value = cast(list[Any], value)[0]
    return cast(Any, value)


def _get_item(value: Any, key: str) -> Any:
    return cast(dict[str, Any], value).get(key) if isinstance(value, dict) else None


def _text_of(tree: FileContent) -> Generator[str]:
    """Yield the file in pieces; attributes and texts are scalars, since scalismo does not read lists with one item."""
    paths = (*tree.groups, *tree.arrays, *tree.texts)
    known_as = {path: str(uuid.uuid5(uuid.NAMESPACE_URL, f"shapespace:{path}")) for path in paths}
    inside: dict[str, list[str]] = {path: [] for path in tree.groups}
    for path in known_as:
        if path != "/":
            inside[path.rpartition("/")[0] or "/"].append(path)
    groups: dict[str, Any] = {}
    for path, children in inside.items():
        links = [
            {
                "title": child.rpartition("/")[2],
                "collection": "groups" if child in inside else "datasets",
                "id": known_as[child],
                "class": "H5L_TYPE_HARD",
            }
            for child in children
        ]
        entries = [
            {"name": name, "type": _TEXT, "shape": _SCALAR, "value": str(value)}
            for name, value in tree.attributes.get(path, {}).items()
        ]
        groups[known_as[path]] = {"alias": [path], "attributes": entries, "links": links}
    yield f'{{"apiVersion":"1.0.0","root":"{known_as["/"]}","groups":{_json(groups)},"datasets":{{'
    comma = ""
    for path, text in tree.texts.items():
        yield f'{comma}"{known_as[path]}":{_json({**_head(path, _TEXT, ()), "value": text})}'
        comma = ","
    for path, array in tree.arrays.items():
        kind = _INTEGER if array.dtype.kind in "iu" else _FLOAT
        yield f'{comma}"{known_as[path]}":{_json(_head(path, kind, array.shape))[:-1]},"value":'
        yield from _numbers(array)
        yield "}"
        comma = ","
    yield "}}\n"


def _head(path: str, kind: Mapping[str, Any], shape: tuple[int, ...]) -> dict[str, Any]:
    space = {"class": "H5S_SIMPLE", "dims": list(shape)} if shape else _SCALAR
    return {"alias": [path], "creationProperties": {}, "type": kind, "shape": space}


def _numbers(array: npt.NDArray[Any]) -> Generator[str]:
    """Yield rows as JSON, each number as short as its single precision allows."""
    if array.ndim < 2:
        values = array.reshape(-1).astype(str).tolist()
        yield ",".join(values) if not array.ndim else f"[{','.join(values)}]"
        return
    yield "["
    for number, row in enumerate(array):
        yield from ("," if number else "", *_numbers(row))
    yield "]"


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"))
