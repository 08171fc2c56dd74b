"""Program of the sandbox process, which does not import shapespace.

Its standard input is the file. Its output is one line of JSON that describes the content, followed by the bytes of the
arrays.
"""

from __future__ import annotations

import codecs
import io
import json
import math
import pickle
import pickletools
import re
import sys
from typing import Any, BinaryIO, Final, cast

import numpy as np
import numpy.typing as npt

_MOST_NODES = 4096  # limits on damaged files from here on; models have tens of nodes
_MOST_ATTRIBUTES = 64  # of one group or array
_DEEPEST = 16  # levels of groups
_MOST_AXES = 8  # of one array
_LONGEST_TEXT = 2**20  # bytes (1 MiB)
_LONGEST_NAME = 1024  # characters
_FILTERS = {1, 2, 3}
"""HDF5 filters deflate, shuffle and Fletcher-32 checksum, which are part of HDF5 and which models use."""
_NUMBERS: Final = "biuf"
_DEEPEST_CHUMPY = 8  # nested chumpy objects
_MOST_STEPS = 400_000  # opcodes of a pickle; limit on time
_ARRAY_NAMES: Final = {
    ("numpy", "ndarray"): "class",
    ("numpy", "dtype"): "dtype",
    ("__builtin__", "object"): "class",
    ("builtins", "object"): "class",
    **{(f"numpy.{core}.multiarray", "_reconstruct"): "array" for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): "scalar" for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): "buffer" for core in ("core", "_core")},
    **{
        (f"scipy.sparse.{module}{kind}", f"{kind}_matrix"): "class"
        for kind in ("csc", "csr", "coo")
        for module in ("", "_")
    },
}
"""Classes and functions that pickles use for arrays; `_PickledObject` replaces them, so that they are never called."""
_CHUMPY = re.compile(r"chumpy(\.\w+)*")
_DTYPE = re.compile(r"[<>|=]?(b1|[iu][1248]|f[248])")


class _RejectedFileError(ValueError):
    """The file uses a feature that no model needs; the text names it, as a clause."""


class _FileContent:
    """Content read so far, and the number of bytes that remain allowed."""

    def __init__(self, most_bytes: int) -> None:
        self.arrays: dict[str, npt.NDArray[Any]] = {}
        self.texts: dict[str, str] = {}
        self.attributes: dict[str, dict[str, Any]] = {}
        self.groups: list[str] = []
        self._left, self._most = most_bytes, most_bytes

    def charge(self, count: int, path: str) -> None:
        """Subtract `count` bytes from the memory allowed, before they are allocated."""
        self._left -= count
        if self._left < 0:
            raise _RejectedFileError(
                f"{path} expands to more than {self._most >> 20} MiB, out of proportion to the size of the file"
            )

    def add(self, path: str, array: npt.NDArray[Any]) -> None:
        self.arrays[path] = np.asarray(array, array.dtype.newbyteorder("<"), order="C")

    def write(self, out: BinaryIO) -> None:
        descriptions = [[path, array.dtype.str, array.shape] for path, array in self.arrays.items()]
        header = {"arrays": descriptions, "texts": self.texts, "attributes": self.attributes, "groups": self.groups}
        out.write(json.dumps(header).encode() + b"\n")
        for array in self.arrays.values():
            out.write(array.tobytes())


def _hdf5(stream: BinaryIO, request: dict[str, Any], content: _FileContent) -> None:
    import h5py

    with h5py.File(stream, "r") as file:
        _forbid_opening_files()
        _walk(file, "", content, tuple(request["leave"]))


def _walk(group: Any, path: str, content: _FileContent, leave: tuple[str, ...]) -> None:
    import h5py

    content.groups.append(path or "/")
    _attributes(group, path or "/", content)
    if path.count("/") > _DEEPEST or len(content.groups) + len(content.arrays) + len(group) > _MOST_NODES:
        raise _RejectedFileError("it has more groups than any model")
    for name in group:
        if len(name) > _LONGEST_NAME:
            raise _RejectedFileError("it has longer names than any model")
        inner = f"{path}/{name}"
        if inner in leave:
            content.groups.append(inner)
            continue
        if group.get(name, getclass=True, getlink=True) is not h5py.HardLink:
            raise _RejectedFileError(f"{inner} is a link to elsewhere")
        item = group[name]
        if isinstance(item, h5py.Group):
            _walk(item, inner, content, leave)
        elif isinstance(item, h5py.Dataset):
            _dataset(item, inner, content)


def _attributes(item: Any, path: str, content: _FileContent) -> None:
    import h5py

    values: dict[str, Any] = {}
    if len(item.attrs) > _MOST_ATTRIBUTES:
        raise _RejectedFileError(f"{path} has more attributes than any part of a model")
    for name in item.attrs:
        identifier = item.attrs.get_id(name)
        is_text = h5py.check_string_dtype(identifier.dtype) is not None
        if identifier.shape is None or math.prod(identifier.shape) != 1 or identifier.dtype.itemsize > _LONGEST_TEXT:
            continue
        if is_text or identifier.dtype.kind in _NUMBERS:
            value = np.asarray(item.attrs[name]).reshape(-1)[0]
            values[name] = _text(value) if is_text else value.item()
            content.charge(len(str(values[name])), path)
    if values:
        content.attributes[path] = values


def _dataset(dataset: Any, path: str, content: _FileContent) -> None:
    import h5py as library

    h5py: Any = library
    stored = dataset.id.get_create_plist()
    if stored.get_external_count() or stored.get_layout() == h5py.h5d.VIRTUAL:
        raise _RejectedFileError(f"{path} is stored in another file")
    if dataset.shape is None or len(dataset.shape) > _MOST_AXES:
        return
    used = {stored.get_filter(index)[0] for index in range(stored.get_nfilters())}
    if not used <= _FILTERS:
        raise _RejectedFileError(f"{path} is compressed in a way that no model needs")
    count, item_bytes = math.prod(dataset.shape), dataset.dtype.itemsize
    of_text = h5py.check_string_dtype(dataset.dtype)
    if of_text is None and dataset.dtype.kind not in _NUMBERS:
        return
    if of_text is not None and count > 1 and of_text.length != 1:
        return
    content.charge(count * item_bytes + (math.prod(dataset.chunks) * item_bytes if dataset.chunks else 0), path)
    _attributes(dataset, path, content)
    if of_text is None:
        content.add(path, dataset[()])
    elif count == 1:
        content.texts[path] = _text(np.asarray(dataset[()]).reshape(-1)[0])
        content.charge(len(content.texts[path]), path)
    elif count:
        content.add(path, np.frombuffer(dataset[()].tobytes(), np.uint8))


def _text(value: Any) -> str:
    data = value if isinstance(value, bytes) else str(value).encode("utf-8", "replace")
    return data.partition(b"\0")[0].decode("utf-8", "replace")[:_LONGEST_TEXT]


def _matlab(stream: BinaryIO, request: dict[str, Any], content: _FileContent) -> None:
    from scipy import io as scipy_io

    library: Any = scipy_io
    _forbid_opening_files()
    variables = [(name, shape) for name, shape, _ in library.whosmat(stream)]
    requested = [(name, shape) for name, shape in variables if name in request["wanted"]]
    content.groups.extend(f"/{name}" for name, _ in variables if name not in request["wanted"])
    for name, shape in requested:
        content.charge(8 * math.prod(shape), f"/{name}")
    stream.seek(0)
    loaded = library.loadmat(stream, variable_names=[name for name, _ in requested])
    for name, _ in requested:
        if name in loaded:
            _add_variable(loaded[name], f"/{name}", content)


def _add_variable(value: Any, path: str, content: _FileContent) -> None:
    """Add a variable, or the fields of a structure, as HDF5 groups."""
    if path.count("/") > _DEEPEST or type(value) is not np.ndarray:
        return
    if value.dtype.kind in _NUMBERS:
        content.add(path, value)
    elif value.dtype.names and value.size == 1:
        content.groups.append(path)
        for name in value.dtype.names:
            _add_variable(value.reshape(-1)[0][name], f"{path}/{name}", content)


class _PickledObject:
    """Arguments and state of an object that a pickle would create."""

    kind = ""
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Unpickler(pickle.Unpickler):
    """An unpickler of numbers, texts, lists, dictionaries and the parts of arrays."""

    def find_class(self, module: str, name: str, /) -> Any:
        if module in ("copy_reg", "copyreg") and name == "_reconstructor":
            return _create_pickled_object
        if (module, name) == ("_codecs", "encode"):
            return _latin_bytes
        kind = "chumpy" if _CHUMPY.fullmatch(module) and name.isidentifier() else _ARRAY_NAMES.get((module, name))
        if kind is None:
            raise _RejectedFileError(f"it asks for {module[:40]}.{name[:40]}, which no array needs")
        return type(kind, (_PickledObject,), {"kind": kind})


def _create_pickled_object(kind: Any, *_: Any) -> _PickledObject:
    if not (isinstance(kind, type) and issubclass(kind, _PickledObject)):
        raise _RejectedFileError("it calls an object that is not a class")
    return kind()


def _latin_bytes(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        raise _RejectedFileError("it asks for an unsupported text encoding")
    return text.encode("latin-1", "replace")


def _pickle(stream: BinaryIO, request: dict[str, Any], content: _FileContent) -> None:
    data = stream.read()
    _forbid_opening_files()
    try:
        for step, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            # An index in the memo beyond the length of the file would only fill the memory.
            if step > _MOST_STEPS or (opcode.name.endswith("PUT") and (argument or 0) > len(data)):
                raise _RejectedFileError(f"it has more than {_MOST_STEPS} steps, or an invalid memo index")
        values = _Unpickler(io.BytesIO(data), encoding="latin-1").load()
    except (_RejectedFileError, MemoryError):
        raise
    except Exception as error:  # pickles may raise any exception
        raise _RejectedFileError("it is not a pickle of arrays, or it is cut short") from error
    if type(values) is not dict:
        raise _RejectedFileError("it does not contain a dictionary")
    for name in request["wanted"]:
        if name in values:
            array = _pickled_array(values[name])
            content.charge(array.nbytes, f"/{name}")
            content.add(f"/{name}", array)


def _pickled_array(value: Any, depth: int = 0) -> npt.NDArray[Any]:
    """Return the array that `value` of a pickle describes, also inside chumpy."""
    if isinstance(value, list) and set(map(type, cast(list[object], value))) <= {int, float}:
        return np.array(value, dtype=np.float64)
    if not isinstance(value, _PickledObject) or depth > _DEEPEST_CHUMPY:
        raise _RejectedFileError("an entry that should be an array is none")
    match value.kind, value.state, value.arguments:
        case "array", (_, shape, dtype, fortran, data), _:
            return _numbers(data, dtype, shape, bool(fortran))
        case "buffer", _, (data, dtype, shape, order, *_):
            return _numbers(data, dtype, shape, order == "F")
        case "scalar", _, (dtype, data):
            return _numbers(data, dtype, (), False)
        case "chumpy", {"x": inner}, _:
            return _pickled_array(inner, depth + 1)
        case "chumpy", {"a": inner, "idxs": indices, **others}, _:  # elements that chumpy's Select takes
            flat = _pickled_array(inner, depth + 1).ravel()
            chosen = _pickled_array(indices, depth + 1).astype(np.int64).ravel()
            if chosen.size and (chosen.min() < 0 or chosen.max() >= len(flat)):
                raise _RejectedFileError("it selects elements beyond the end of an array")
            return flat[chosen].reshape(_shape(others.get("preferred_shape") or (len(chosen),), len(chosen)))
        case _:
            raise _RejectedFileError("an entry that should be an array is none")


def _numbers(data: Any, described: Any, shape: Any, fortran: bool) -> npt.NDArray[Any]:
    kind = described.arguments[0] if isinstance(described, _PickledObject) and described.arguments else None
    match = _DTYPE.fullmatch(kind) if isinstance(kind, str) else None
    if match is None:
        raise _RejectedFileError("an array in it does not consist of numbers")
    is_big = described.arguments[0][:1] == ">" or (
        isinstance(described.state, tuple) and described.state[1:2] == (">",)
    )
    dtype = np.dtype(match[1]).newbyteorder(">" if is_big else "<")
    if isinstance(data, str):  # as Python 2 wrote bytes
        data = data.encode("latin-1", "replace")
    if not isinstance(data, bytes | bytearray):
        raise _RejectedFileError("an array in it contains objects")
    if len(data) % dtype.itemsize:
        raise _RejectedFileError("an array in it does not have the declared length")
    sizes = _shape(shape, len(data) // dtype.itemsize)
    return np.frombuffer(data, dtype).reshape(sizes, order="F" if fortran else "C")


def _shape(shape: Any, count: int) -> tuple[int, ...]:
    sizes = tuple(shape) if type(shape) in (tuple, list) else (-1,)
    if len(sizes) > _MOST_AXES or not all(type(size) is int and 0 <= size < 2**40 for size in sizes):
        raise _RejectedFileError("an array in it has an invalid shape")
    if math.prod(sizes) != count:
        raise _RejectedFileError("an array in it does not have the declared length")
    return sizes


def _forbid_opening_files() -> None:
    """Limit this process to the files that are open, where the system supports it."""
    if sys.platform != "win32":
        import resource

        for name in (
            "ascii",
            "latin-1",
            "raw-unicode-escape",
            "utf-8",
            "utf-16",
        ):  # codecs are loaded from files at their first use
            codecs.lookup(name)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))


def _limit_resources(most_memory: int, most_seconds: int) -> None:
    """Limit memory and processor time of this process, where the system supports it."""
    if sys.platform != "win32":
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (most_seconds, most_seconds))
        if sys.platform == "linux":
            resource.setrlimit(resource.RLIMIT_AS, (most_memory, most_memory))


def _main() -> None:
    request = json.loads(sys.argv[1])
    _limit_resources(request["most_memory"], request["most_seconds"])
    content, out = _FileContent(request["most_bytes"]), sys.stdout.buffer
    try:
        {"hdf5": _hdf5, "matlab": _matlab, "pickle": _pickle}[request["kind"]](sys.stdin.buffer, request, content)
    except _RejectedFileError as error:
        out.write(json.dumps({"wrong": str(error)}).encode() + b"\n")
    except MemoryError:
        out.write(json.dumps({"wrong": "it asks for more memory than such a file can"}).encode() + b"\n")
    except Exception as error:  # libraries may raise anything at all in a damaged file
        message = " ".join(str(error).split())[:120].rstrip(".;")
        out.write(json.dumps({"wrong": f"it cannot be read ({message})"}).encode() + b"\n")
    else:
        content.write(out)
    out.flush()


if __name__ == "__main__":
    _main()
