"""Named arrays and attributes in one HDF5 file, with a hash that detects later changes.

The first 512 bytes (an HDF5 user block, which HDF5 tools skip) contain the SHA-256 of the rest, which is checked before
anything else is read. An attribute contains a second hash, over the arrays and attributes themselves.

The HDF5 library is used for writing only. It follows links to other files and devices, allocates as much memory as a
header declares, and hangs or crashes in damaged structures; a checksum does not protect against an attacker who
recomputes it. The reader of this module therefore accepts only the subset that `write_hdf5` writes and rejects other
features: superblock 0, one group of names, each of a contiguous array, and attributes that are a number or a text
("HDF5 File Format Specification", version 1 of each structure). The reader follows only addresses within the file,
repeats no step more than `_MOST` times, and limits arrays and texts together to the size of the file.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileError, FileFormatError
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import open_file, read_bytes, write_bytes

Attribute: TypeAlias = str | int | float
Arrays: TypeAlias = dict[str, npt.NDArray[Any]]

SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_MOST = 256  # limit on names, messages and objects; a model has tens
_MOST_AXES = 8  # limit on damaged files; arrays of a model have three
# header message types of the HDF5 file format specification, section IV.A.2
_SPACE, _TYPE, _LAYOUT, _ATTRIBUTE, _CONTINUED, _GROUP = 0x01, 0x03, 0x08, 0x0C, 0x10, 0x11
# same section: NIL, old fill value, fill value, modification time
_NOTHING, _OLD_FILL, _FILL, _CHANGED = 0x00, 0x04, 0x05, 0x12
_IN_DATASET = {_NOTHING, _SPACE, _TYPE, _OLD_FILL, _FILL, _LAYOUT, _CHANGED}
_IN_ROOT = {_NOTHING, _ATTRIBUTE, _GROUP, _CHANGED}
_SHARED = 2  # header message flag, bit 1
_ONE_PIECE = (3, 1)  # data layout message: version 3, contiguous storage
# Datatype messages without their trailing zero bytes: float64, then signed integers, little-endian.
_NUMBERS = {
    bytes.fromhex("11203f000800000000004000340b0034ff03"): np.dtype("<f8"),
    bytes.fromhex("1008000004000000000020"): np.dtype("<i4"),
    bytes.fromhex("1008000008000000000040"): np.dtype("<i8"),
}
_TEXT = bytes.fromhex("19010100100000001000000001000000000008")
_USER_BLOCK = 512  # bytes; smallest user block that HDF5 allows
_MAGIC = b"shapespace sha256 "
_HASH_NAME = "content_hash"
_LARGEST_BYTES = 2**33  # 8 GiB


def content_hash(arrays: Mapping[str, npt.NDArray[Any]], attributes: Mapping[str, Attribute]) -> str:
    """Return the hexadecimal SHA-256 of all `arrays` and `attributes`, independent of the file that contains them."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        digest.update(json.dumps([name, little.dtype.str, list(array.shape)]).encode())
        digest.update(little.tobytes())
    digest.update(json.dumps({k: attributes[k] for k in sorted(attributes) if k != _HASH_NAME}).encode())
    return digest.hexdigest()


def write_hdf5(path: Path, arrays: Mapping[str, npt.NDArray[Any]], attributes: Mapping[str, Attribute]) -> str:
    """Write `arrays` and `attributes` to `path` atomically, and return their content hash.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        FileFormatError: a text cannot be stored, or `read_hdf5` cannot read the output of this version of h5py.
    """
    import h5py  # slow import (0.05 s), needed for writing only

    digest = content_hash(arrays, attributes)
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=_USER_BLOCK, libver="earliest", track_order=False) as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array, track_order=False)
        for name, value in {**attributes, _HASH_NAME: digest}.items():
            try:
                file.attrs[name] = value
            except ValueError as error:
                raise FileFormatError(
                    f"Cannot write {path}: the text of {name} contains a null character or invalid Unicode; remove it."
                ) from error
    data = memory.getvalue()[_USER_BLOCK:]
    try:
        _Parts(memoryview(data)).read()
    except _OtherHdf5Error as error:
        raise FileFormatError(
            f"{path} was not written: h5py {h5py.__version__} writes it in a form that cannot be read back ({error}); "
            "install another version of h5py."
        ) from error
    write_bytes(path, _user_block(data) + data)
    return digest


def _user_block(data: bytes | memoryview) -> bytes:
    return (_MAGIC + hashlib.sha256(data).hexdigest().encode() + b"\n").ljust(_USER_BLOCK, b"\0")


def is_ours(path: Path) -> bool:
    """Return whether `path` begins like a file of `write_hdf5`; False if it cannot be read."""
    if not path.is_file():  # opening a pipe would block
        return False
    try:
        with open_file(path) as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except (OSError, FileError):
        return False


def read_hdf5(path: Path) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Attribute]]:
    """Return the arrays (read-only) and attributes in `path`, checked against the checksum and the content hash.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is not HDF5, was not written by `write_hdf5`, or is cut short or changed since.
    """
    check_file(path, _LARGEST_BYTES, "give a model written by shapespace build")
    data = read_bytes(path)
    damaged = FileFormatError(
        f"{path} is damaged: its content does not match its checksum; copy it again or rebuild the model."
    )
    if not data.startswith(_MAGIC):
        if data.startswith(SIGNATURE):
            raise FileFormatError(
                f"{path} is HDF5 but not a shapespace model: it has no checksum; give a model written by shapespace "
                "build."
            )
        if SIGNATURE in data[: 2 * _USER_BLOCK]:
            raise damaged
        raise FileFormatError(
            f"{path} is neither an HDF5 file nor a model of another tool; give a model that shapespace build wrote, or "
            "a model in a format that shapespace convert reads."
        )
    if data[:_USER_BLOCK] != _user_block(memoryview(data)[_USER_BLOCK:]):
        raise damaged
    try:
        arrays, attributes = _Parts(memoryview(data)[_USER_BLOCK:]).read()
    except _OtherHdf5Error as error:
        raise FileFormatError(
            f"{path} is HDF5, but not in the layout of shapespace: {error}; give a model written by shapespace build."
        ) from error
    if attributes.get(_HASH_NAME) != content_hash(arrays, attributes):
        raise damaged
    return arrays, attributes


class _OtherHdf5Error(ValueError):
    """An HDF5 file that does not use the layout of the shapespace writer; the text gives the reason, as a clause."""


class _Parts:
    """Parts of an HDF5 file without its user block: arrays by name, read-only views of its data, and attributes."""

    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._left = len(data)

    def read(self) -> tuple[Arrays, dict[str, Attribute]]:
        signature, version, offset_bytes, length_bytes = self._fields("8sB4xBB", 0)
        if (signature, version, offset_bytes, length_bytes) != (SIGNATURE, 0, 8, 8):
            raise _OtherHdf5Error("it has another superblock")
        root = self._messages(self._fields("Q", 64)[0], _IN_ROOT, "the file")
        attributes = dict(self._attribute(body) for kind, body in root if kind == _ATTRIBUTE)
        arrays: Arrays = {}
        for tree, heap in (_unpack("QQ", body) for kind, body in root if kind == _GROUP):
            for name, header in self._names(tree, heap):
                if name in arrays:
                    raise _OtherHdf5Error(f"it names {name!r} twice")
                arrays[name] = self._array(name, header)
        return arrays, attributes

    def _bytes(self, offset: int, count: int) -> memoryview:
        if offset + count > len(self._data):
            raise _OtherHdf5Error("it points past its own end")
        return self._data[offset : offset + count]

    def _fields(self, layout: str, offset: int) -> tuple[Any, ...]:
        return _unpack(layout, self._bytes(offset, struct.calcsize(f"<{layout}")))

    def _charge(self, count: int, part_name: str) -> None:
        """Subtract `count` bytes from the remaining memory, before they are allocated."""
        self._left -= count
        if self._left < 0:
            raise _OtherHdf5Error(f"it declares {count} bytes in {part_name} but is only {len(self._data)} bytes long")

    def _messages(self, offset: int, allowed: set[int], part_name: str) -> list[tuple[int, memoryview]]:
        """Return the messages of the object whose header begins at `offset`, by kind."""
        version, length = self._fields("B7xI", offset)
        if version != 1:
            raise _OtherHdf5Error(f"{part_name} has a header of another version")
        messages: list[tuple[int, memoryview]] = []
        blocks = [self._bytes(offset + 16, length)]
        for block in blocks:  # continuation messages append further blocks during the loop
            position = 0
            while position + 8 <= len(block):
                kind, size, flags = _unpack("HHB", block[position : position + 5])
                body = block[position + 8 : position + 8 + size]
                position += 8 + size
                if position > len(block) or flags & _SHARED or len(messages) + len(blocks) > _MOST:
                    raise _OtherHdf5Error(f"{part_name} has a header that is damaged")
                if kind == _CONTINUED:
                    blocks.append(self._bytes(*_unpack("QQ", body)))
                elif kind in allowed:
                    messages.append((kind, body))
                else:
                    raise _OtherHdf5Error(f"{part_name} uses a feature of HDF5 ({kind:#04x}) that no model needs")
        return messages

    def _names(self, tree: int, heap: int) -> list[tuple[str, int]]:
        """Return each name in the group with the address of its header; all names are at one level of the tree."""
        mark, kind, level, count = self._fields("4sBBH", tree)
        heap_mark, texts = self._fields("4s20xQ", heap)
        if (mark, kind, level, heap_mark) != (b"TREE", 0, 0, b"HEAP") or count > _MOST:
            raise _OtherHdf5Error("its names are stored in another layout")
        addresses: list[tuple[str, int]] = []
        for child in range(count):
            (node,) = self._fields("Q", tree + 32 + 16 * child)
            mark, entries = self._fields("4s2xH", node)
            if mark != b"SNOD" or len(addresses) + entries > _MOST:
                raise _OtherHdf5Error("its names are stored in another layout")
            for entry in range(entries):
                name, header, link = self._fields("QQI", node + 8 + 40 * entry)
                if link:
                    raise _OtherHdf5Error("it contains a link or a group")
                addresses.append((self._name(texts + name), header))
        return addresses

    def _name(self, offset: int) -> str:
        return _text(bytes(self._data[offset : offset + _MOST]).partition(b"\0")[0])

    def _array(self, name: str, offset: int) -> npt.NDArray[Any]:
        messages = dict(self._messages(offset, _IN_DATASET, repr(name)))
        if not {_SPACE, _TYPE, _LAYOUT} <= messages.keys():
            raise _OtherHdf5Error(f"{name!r} is not an array")
        dtype = _NUMBERS.get(bytes(messages[_TYPE]).rstrip(b"\0"))
        if dtype is None:
            raise _OtherHdf5Error(f"{name!r} is neither float64 nor an integer of 32 or 64 bits")
        shape = _shape(messages[_SPACE])
        size = math.prod(shape) * dtype.itemsize
        self._charge(size, repr(name))
        if tuple(messages[_LAYOUT][:2]) != _ONE_PIECE:
            raise _OtherHdf5Error(f"{name!r} is not stored in one piece")
        address, stored = _unpack("QQ", messages[_LAYOUT][2:18])
        if stored != size or not size:
            raise _OtherHdf5Error(f"{name!r} is empty or cut short")
        return np.frombuffer(self._bytes(address, size), dtype).reshape(shape)

    def _attribute(self, body: memoryview) -> tuple[str, Attribute]:
        version, *sizes = _unpack("BxHHH", body[:8])
        bounds = np.cumsum([8, *(-(-size // 8) * 8 for size in sizes)]).tolist()
        name, kind, space, value = (bytes(body[a:b]) for a, b in zip(bounds, [*bounds[1:], None], strict=True))
        attribute = _text(name.partition(b"\0")[0])
        kind = kind.rstrip(b"\0")
        if version != 1 or _shape(memoryview(space)) or not (kind == _TEXT or kind in _NUMBERS):
            raise _OtherHdf5Error(f"its attribute {attribute!r} is neither a number nor a text")
        if kind == _TEXT:
            length, heap, index = _unpack("IQI", value[:16])
            return attribute, self._text_in_heap(length, heap, index, attribute)
        number = np.frombuffer(value[: _NUMBERS[kind].itemsize], _NUMBERS[kind])
        if not len(number):
            raise _OtherHdf5Error(f"its attribute {attribute!r} is cut short")
        return attribute, number[0].item()

    def _text_in_heap(self, length: int, heap: int, text_index: int, attribute: str) -> str:
        mark, size = self._fields("4s4xQ", heap)
        objects = self._bytes(heap, size)
        offset = 16
        for _ in range(_MOST if mark == b"GCOL" else 0):
            index, stored_length = _unpack("H6xQ", objects[offset : offset + 16])
            if index == text_index:
                if stored_length < length or offset + 16 + stored_length > size:
                    break
                self._charge(length, f"the attribute {attribute!r}")
                return _text(bytes(objects[offset + 16 : offset + 16 + length]))
            offset += 16 + -(-stored_length // 8) * 8
        raise _OtherHdf5Error(f"its attribute {attribute!r} is damaged")


def _unpack(layout: str, data: memoryview | bytes) -> tuple[Any, ...]:
    try:
        return struct.unpack(f"<{layout}", data)
    except struct.error as error:
        raise _OtherHdf5Error("it is cut short") from error


def _shape(space: memoryview) -> tuple[int, ...]:
    version, rank = _unpack("BB", space[:2])
    if version != 1 or rank > _MOST_AXES:
        raise _OtherHdf5Error("it contains an array with an invalid shape")
    return _unpack(f"{rank}Q", space[8 : 8 + 8 * rank])


def _text(data: bytes) -> str:
    return data.decode("utf-8", "replace")  # text with replacements fails the checksum
