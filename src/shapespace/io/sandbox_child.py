"""Program of the sandbox process: a program of its own, which imports nothing of shapespace.

Its standard input is the file. It writes one line of JSON on what it found and, after it, the bytes of the arrays.
"""

from __future__ import annotations

import codecs
import json
import math
import sys
from typing import Any, BinaryIO, Final

import numpy as np
import numpy.typing as npt

_MOST_NODES = 4096
_MOST_ATTRIBUTES = 64
_DEEPEST = 16
_MOST_AXES = 8
_LONGEST_TEXT = 2**20
_LONGEST_NAME = 1024
_FILTERS = {1, 2, 3}
"""Deflate, shuffle and checksums: those that HDF5 itself brings, and that models use."""
_NUMBERS: Final = "biuf"


class _RefusedError(ValueError):
    """The file asks for what no model needs; the text says what, as a clause."""


class _Found:
    """What has been read, and how many bytes more may be."""

    def __init__(self, most_bytes: int) -> None:
        self.arrays: dict[str, npt.NDArray[Any]] = {}
        self.texts: dict[str, str] = {}
        self.attributes: dict[str, dict[str, Any]] = {}
        self.groups: list[str] = []
        self._left, self._most = most_bytes, most_bytes

    def charge(self, count: int, path: str) -> None:
        """Take `count` bytes from what the file may fill in memory, before they are taken there."""
        self._left -= count
        if self._left < 0:
            raise _RefusedError(f"{path} unfolds to more than {self._most >> 20} MiB, out of proportion to the file")

    def add(self, path: str, array: npt.NDArray[Any]) -> None:
        self.arrays[path] = np.asarray(array, array.dtype.newbyteorder("<"), order="C")

    def write(self, out: BinaryIO) -> None:
        about = [[path, array.dtype.str, array.shape] for path, array in self.arrays.items()]
        told = {"arrays": about, "texts": self.texts, "attributes": self.attributes, "groups": self.groups}
        out.write(json.dumps(told).encode() + b"\n")
        for array in self.arrays.values():
            out.write(array.tobytes())


def _hdf5(stream: BinaryIO, asked: dict[str, Any], found: _Found) -> None:
    import h5py

    with h5py.File(stream, "r") as file:
        _close_the_door()
        _walk(file, "", found, tuple(asked["leave"]))


def _walk(group: Any, path: str, found: _Found, leave: tuple[str, ...]) -> None:
    import h5py

    found.groups.append(path or "/")
    _attributes(group, path or "/", found)
    if path.count("/") > _DEEPEST or len(found.groups) + len(found.arrays) + len(group) > _MOST_NODES:
        raise _RefusedError("it has more groups than a model")
    for name in group:
        if len(name) > _LONGEST_NAME:
            raise _RefusedError("it has longer names than a model")
        inner = f"{path}/{name}"
        if inner in leave:
            found.groups.append(inner)
            continue
        if group.get(name, getclass=True, getlink=True) is not h5py.HardLink:
            raise _RefusedError(f"{inner} is a link to elsewhere")
        one = group[name]
        if isinstance(one, h5py.Group):
            _walk(one, inner, found, leave)
        elif isinstance(one, h5py.Dataset):
            _dataset(one, inner, found)


def _attributes(one: Any, path: str, found: _Found) -> None:
    import h5py

    told: dict[str, Any] = {}
    if len(one.attrs) > _MOST_ATTRIBUTES:
        raise _RefusedError(f"{path} has more attributes than one of a model")
    for name in one.attrs:
        about = one.attrs.get_id(name)
        is_text = h5py.check_string_dtype(about.dtype) is not None
        if about.shape is None or math.prod(about.shape) != 1 or about.dtype.itemsize > _LONGEST_TEXT:
            continue
        if is_text or about.dtype.kind in _NUMBERS:
            value = np.asarray(one.attrs[name]).reshape(-1)[0]
            told[name] = _text(value) if is_text else value.item()
            found.charge(len(str(told[name])), path)
    if told:
        found.attributes[path] = told


def _dataset(one: Any, path: str, found: _Found) -> None:
    import h5py as library

    h5py: Any = library
    stored = one.id.get_create_plist()
    if stored.get_external_count() or stored.get_layout() == h5py.h5d.VIRTUAL:
        raise _RefusedError(f"{path} lies in another file")
    if one.shape is None or len(one.shape) > _MOST_AXES:
        return
    used = {stored.get_filter(index)[0] for index in range(stored.get_nfilters())}
    if not used <= _FILTERS:
        raise _RefusedError(f"{path} is packed in a way that no model needs")
    count, each = math.prod(one.shape), one.dtype.itemsize
    of_text = h5py.check_string_dtype(one.dtype)
    if of_text is None and one.dtype.kind not in _NUMBERS:
        return
    if of_text is not None and count > 1 and of_text.length != 1:
        return
    found.charge(count * each + (math.prod(one.chunks) * each if one.chunks else 0), path)
    _attributes(one, path, found)
    if of_text is None:
        found.add(path, one[()])
    elif count == 1:
        found.texts[path] = _text(np.asarray(one[()]).reshape(-1)[0])
        found.charge(len(found.texts[path]), path)
    elif count:
        found.add(path, np.frombuffer(one[()].tobytes(), np.uint8))


def _text(value: Any) -> str:
    data = value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")
    return data.partition(b"\0")[0].decode("utf-8", "replace")[:_LONGEST_TEXT]


def _matlab(stream: BinaryIO, asked: dict[str, Any], found: _Found) -> None:
    from scipy import io as scipy_io

    library: Any = scipy_io
    _close_the_door()
    there = [(name, shape) for name, shape, _ in library.whosmat(stream)]
    wanted = [(name, shape) for name, shape in there if name in asked["wanted"]]
    found.groups.extend(f"/{name}" for name, _ in there if name not in asked["wanted"])
    for name, shape in wanted:
        found.charge(8 * math.prod(shape), f"/{name}")
    stream.seek(0)
    loaded = library.loadmat(stream, variable_names=[name for name, _ in wanted])
    for name, _ in wanted:
        if name in loaded:
            _unfold(loaded[name], f"/{name}", found)


def _unfold(value: Any, path: str, found: _Found) -> None:
    """Add a variable, or the fields of a structure, as groups of HDF5 would hold them."""
    if path.count("/") > _DEEPEST or type(value) is not np.ndarray:
        return
    if value.dtype.kind in _NUMBERS:
        found.add(path, value)
    elif value.dtype.names and value.size == 1:
        found.groups.append(path)
        for name in value.dtype.names:
            _unfold(value.reshape(-1)[0][name], f"{path}/{name}", found)


def _close_the_door() -> None:
    """Open no more files, where the system can hold a process to that."""
    if sys.platform != "win32":
        import resource

        for name in ("ascii", "latin-1", "utf-8", "utf-16"):  # which are files too, opened when first used
            codecs.lookup(name)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))


def _hold(most_memory: int, most_seconds: int) -> None:
    """Hold this process to so much memory and work, where the system can."""
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (most_seconds, most_seconds))
        if sys.platform == "linux":
            resource.setrlimit(resource.RLIMIT_AS, (most_memory, most_memory))


def _main() -> None:
    asked = json.loads(sys.argv[1])
    _hold(asked["most_memory"], asked["most_seconds"])
    found, out = _Found(asked["most_bytes"]), sys.stdout.buffer
    try:
        {"hdf5": _hdf5, "matlab": _matlab}[asked["kind"]](sys.stdin.buffer, asked, found)
    except _RefusedError as error:
        out.write(json.dumps({"wrong": str(error)}).encode() + b"\n")
    except MemoryError:
        out.write(json.dumps({"wrong": "it asks for more memory than such a file can"}).encode() + b"\n")
    except Exception as error:  # libraries may raise anything at all in a damaged file
        told = " ".join(str(error).split())[:120].rstrip(".;")
        out.write(json.dumps({"wrong": f"it cannot be read ({told})"}).encode() + b"\n")
    else:
        found.write(out)
    out.flush()


if __name__ == "__main__":
    _main()
