"""Named arrays and attributes in one HDF5 file that shows any later change.

The first 512 bytes (an HDF5 user block, which HDF5 tools skip) hold the SHA-256 of the rest, and are checked before
the HDF5 library parses anything. A content hash over the arrays and attributes themselves travels inside.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias, cast

import h5py
import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError
from shapespace.io.files import read_bytes, write_bytes

Attribute: TypeAlias = str | int | float
_USER_BLOCK = 512
_MAGIC = b"shapespace sha256 "
_HASH_NAME = "content_hash"
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def content_hash(arrays: Mapping[str, npt.NDArray[Any]], attributes: Mapping[str, Attribute]) -> str:
    """Return the hexadecimal SHA-256 of all `arrays` and `attributes`, whatever file they stand in."""
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
    """
    digest = content_hash(arrays, attributes)
    memory = io.BytesIO()
    with h5py.File(memory, "w", userblock_size=_USER_BLOCK) as file:
        for name, array in arrays.items():
            file.create_dataset(name, data=array)
        for name, value in {**attributes, _HASH_NAME: digest}.items():
            file.attrs[name] = value
    data = memory.getvalue()[_USER_BLOCK:]
    write_bytes(path, _user_block(data) + data)
    return digest


def _user_block(data: bytes) -> bytes:
    return (_MAGIC + hashlib.sha256(data).hexdigest().encode() + b"\n").ljust(_USER_BLOCK, b"\0")


def read_hdf5(path: Path) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Attribute]]:
    """Return the arrays and attributes in `path`, checked against both hashes.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is not HDF5, or it is cut short or changed since it was written.
    """
    data = read_bytes(path)
    damaged = FileFormatError(
        f"{path} is damaged: its content does not match its checksum; copy it again or rebuild the model."
    )
    if data.startswith(_MAGIC):
        if data[:_USER_BLOCK] != _user_block(data[_USER_BLOCK:]):
            raise damaged
    elif not data.startswith(_HDF5_SIGNATURE):
        if _HDF5_SIGNATURE in data[: 2 * _USER_BLOCK]:
            raise damaged
        raise FileFormatError(f"{path} is not an HDF5 file; give a model written by shapespace build.")
    arrays: dict[str, npt.NDArray[Any]] = {}
    attributes: dict[str, Attribute] = {}
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            for name, item in cast(Any, file).items():
                if isinstance(item, h5py.Dataset):
                    # We write uncompressed; a declared size beyond the file's would be memory for nothing.
                    declared = int(cast(Any, item).nbytes)
                    if declared > len(data):
                        raise FileFormatError(
                            f"{path} declares {declared} bytes in {name!r} but is only {len(data)} bytes long; "
                            "give a model written by shapespace build."
                        )
                    arrays[str(name)] = np.asarray(cast(Any, item)[()])
            stored = cast(dict[str, Any], dict(file.attrs))
            for name, value in stored.items():
                attributes[name] = value.item() if isinstance(value, np.generic) else value
    except FileFormatError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise damaged from error
    if _HASH_NAME in attributes and attributes[_HASH_NAME] != content_hash(arrays, attributes):
        raise damaged
    return arrays, attributes
