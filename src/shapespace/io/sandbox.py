"""HDF5 and MATLAB files and pickles from other tools, read by a library in a sandboxed process.

Those libraries take what memory a file asks for, follow links to other files, and hang or crash in damaged structures.
In that process they see one open file and can open no other, are held to a share of memory and time, and only numbers
and texts come back, in proportion to the size of the file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shapespace.io import sandbox_child
from shapespace.io.files import open_file

MOST_BYTES: Final = 2**32
"""Bytes that all arrays of one file may have, however large it is (4 GiB)."""
GROWTH: Final = 8
"""Bytes of arrays for each byte of the file, since they may be packed in it."""
SPARE_BYTES: Final = 2**26
"""Bytes of arrays besides, for small files (64 MiB)."""
PROGRAM_BYTES: Final = 2**30
"""Memory of the process besides three times the arrays: Python and the libraries (1 GiB)."""
MOST_SECONDS: Final = 60
"""Time that the process has, and a second more for each `BYTES_A_SECOND` of the file."""
BYTES_A_SECOND: Final = 2**22  # 4 MiB; far below the reading speed of a disk

HDF5_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"


class SandboxError(ValueError):
    """The file is damaged or malicious; the text gives the reason, as a clause."""


@dataclass(frozen=True)
class Tree:
    """Content of an HDF5 file, or of a file with the same structure, by path: "/model/mean".

    Args:
        arrays: of numbers.
        texts: single ones.
        attributes: numbers and texts by name, of groups and arrays that have any.
        groups: paths of all groups, with "/", and of what was left.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    texts: Mapping[str, str] = field(default_factory=dict[str, str])
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])
    groups: Sequence[str] = ("/",)


def read_hdf5_sandboxed(path: Path, leave: Sequence[str] = ()) -> Tree:
    """Return the content of an HDF5 file, without the paths in `leave` and objects of other kinds.

    Raises:
        FileError: it cannot be read.
        SandboxError: The file is damaged, reaches outside itself, or unfolds to far more than its size.
    """
    return _read(path, {"kind": "hdf5", "leave": list(leave)})


def read_matlab_sandboxed(path: Path, variables: Sequence[str]) -> Tree:
    """Return the variables `variables` of a MATLAB file of version 4 to 7, structures as groups, those that are there.

    Raises:
        FileError: it cannot be read.
        SandboxError: See `read_hdf5_sandboxed`.
    """
    return _read(path, {"kind": "matlab", "wanted": list(variables)})


def read_pickle_sandboxed(path: Path, names: Sequence[str]) -> Tree:
    """Return the arrays `names` of the dictionary in a pickle, those that are there; nothing in it is called.

    Raises:
        FileError: it cannot be read.
        SandboxError: It is damaged, or names what no array needs.
    """
    return _read(path, {"kind": "pickle", "wanted": list(names)})


def _read(path: Path, request: dict[str, Any]) -> Tree:
    with open_file(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        most_bytes = min(SPARE_BYTES + GROWTH * size, MOST_BYTES)
        seconds = MOST_SECONDS + size // BYTES_A_SECOND
        request |= {
            "most_bytes": most_bytes,
            "most_memory": PROGRAM_BYTES + 3 * most_bytes,
            "most_seconds": seconds,
        }
        # A program of its own and not a copy: a copy of a process with threads may hang, and a script without a guard
        # would be run again. -P, since modules beside the program are none of its own.
        command = [sys.executable, "-P", str(Path(sandbox_child.__file__)), json.dumps(request)]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),  # not the folder that one stands in
            "OPENBLAS_NUM_THREADS": "1",
            "HDF5_PLUGIN_PRELOAD": "::",  # no code of filters from elsewhere
        }
        try:
            completed = subprocess.run(
                command, stdin=stream, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment,
                timeout=seconds, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise SandboxError(f"reading it takes longer than {seconds} s") from error
        except OSError as error:
            raise SandboxError(f"the system does not let a process start that reads it ({error.strerror})") from error
    return _tree(completed.stdout)


def _tree(output: bytes) -> Tree:
    head, newline, _ = output.partition(b"\n") if len(output) < 2**16 else (output[: output.find(b"\n")], b"\n", b"")
    if not newline or not head:
        raise SandboxError("the library that reads it does not survive it")
    header = json.loads(head)
    if "wrong" in header:
        raise SandboxError(header["wrong"])
    arrays: dict[str, npt.NDArray[Any]] = {}
    offset = len(head) + 1
    for path, kind, shape in header["arrays"]:
        dtype = np.dtype(kind)
        count = int(np.prod(shape, dtype=np.int64))
        if offset + count * dtype.itemsize > len(output):
            raise SandboxError("the library that reads it does not survive it")
        arrays[path] = np.frombuffer(output, dtype, count, offset).reshape(shape)
        offset += count * dtype.itemsize
    return Tree(arrays, header["texts"], header["attributes"], tuple(header["groups"]))
