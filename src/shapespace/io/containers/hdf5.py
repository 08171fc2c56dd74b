"""Named arrays and attributes in one HDF5 file, with a hash that detects later changes.

The first 512 bytes (an HDF5 user block, which HDF5 tools skip) hold the SHA-256 of the rest, and are checked before
anything else is read. A content hash over the arrays and attributes themselves travels inside. The HDF5 library writes,
but never reads: see `hdf5_parts`.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileError, FileFormatError
from shapespace.io.containers.hdf5_subset import SIGNATURE, Attribute, OtherHdf5Error, hdf5_parts
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import open_file, read_bytes, write_bytes

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
    """Write `arrays` and `attributes` to `path`, whole or not at all, and return their content hash.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        FileFormatError: a text that cannot be stored, or this version of h5py does not write what `read_hdf5` reads.
    """
    import h5py  # a twentieth of a second that only those who write should wait

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
                    f"Cannot write {path}: the text of {name} holds a zero or what is no Unicode; leave that out."
                ) from error
    data = memory.getvalue()[_USER_BLOCK:]
    try:
        hdf5_parts(memoryview(data))
    except OtherHdf5Error as error:
        raise FileFormatError(
            f"{path} was not written: h5py {h5py.__version__} writes it so that it could not be read ({error}); "
            "install another version of h5py."
        ) from error
    write_bytes(path, _user_block(data) + data)
    return digest


def _user_block(data: bytes | memoryview) -> bytes:
    return (_MAGIC + hashlib.sha256(data).hexdigest().encode() + b"\n").ljust(_USER_BLOCK, b"\0")


def is_ours(path: Path) -> bool:
    """Whether `path` is a file that begins as `write_hdf5` has files begin; False where it cannot be read."""
    if not path.is_file():  # a pipe would have its reader wait
        return False
    try:
        with open_file(path) as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except (OSError, FileError):
        return False


def read_hdf5(path: Path) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Attribute]]:
    """Return the arrays (read-only) and attributes in `path`, checked against both hashes.

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
            f"{path} is not an HDF5 file, nor a model of another tool; give one that shapespace build wrote, or one in "
            "a format that shapespace convert --help names."
        )
    if data[:_USER_BLOCK] != _user_block(memoryview(data)[_USER_BLOCK:]):
        raise damaged
    try:
        arrays, attributes = hdf5_parts(memoryview(data)[_USER_BLOCK:])
    except OtherHdf5Error as error:
        raise FileFormatError(
            f"{path} is HDF5 but not as shapespace writes it: {error}; give a model written by shapespace build."
        ) from error
    if attributes.get(_HASH_NAME) != content_hash(arrays, attributes):
        raise damaged
    return arrays, attributes
