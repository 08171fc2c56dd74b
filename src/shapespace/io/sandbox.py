"""HDF5 and MATLAB files and pickles from other tools, read by a library in a sandboxed process.

These libraries allocate as much memory as a file declares, follow links to other files, and hang or crash in damaged
structures. In the sandboxed process they have one open file and cannot open others, their memory and time are limited,
and they return only numbers and texts, in proportion to the size of the file.
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
"""Limit of the total size of the arrays of a file of any size (4 GiB)."""
GROWTH: Final = 8
"""Bytes of arrays per byte of the file, which may be compressed."""
SPARE_BYTES: Final = 2**26
"""Bytes of arrays in addition, for small files (64 MiB)."""
PROGRAM_BYTES: Final = 2**30
"""Memory of the process in addition to three times the arrays: Python and the libraries (1 GiB)."""
MOST_SECONDS: Final = 60
"""Time limit of the process, plus one second for each `BYTES_A_SECOND` of the file."""
BYTES_A_SECOND: Final = 2**22  # 4 MiB; far below the reading speed of a disk

HDF5_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"


class SandboxError(ValueError):
    """The file is damaged or malicious; the text gives the reason, as a clause."""


@dataclass(frozen=True)
class FileContent:
    """Content of an HDF5 file, or of a file with the same structure, by path: "/model/mean".

    Args:
        arrays: path -> array of numbers.
        texts: path -> text, for single texts.
        attributes: path -> numbers and texts by name, for groups and arrays with attributes.
        groups: paths of all groups, including "/", and of the objects that were not read.
    """

    arrays: Mapping[str, npt.NDArray[Any]]
    texts: Mapping[str, str] = field(default_factory=dict[str, str])
    attributes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, Mapping[str, Any]])
    groups: Sequence[str] = ("/",)


def read_hdf5_sandboxed(path: Path, leave: Sequence[str] = ()) -> FileContent:
    """Return the content of an HDF5 file, without the paths in `leave` and without objects of unsupported types.

    Raises:
        FileError: it cannot be read.
        SandboxError: the file is damaged, links to other files, or expands to far more than its size.
    """
    return _read(path, {"kind": "hdf5", "leave": list(leave)})


def read_matlab_sandboxed(path: Path, variables: Sequence[str]) -> FileContent:
    """Return those of `variables` that a MATLAB file of version 4 to 7 contains, structures as groups.

    Raises:
        FileError: it cannot be read.
        SandboxError: see `read_hdf5_sandboxed`.
    """
    return _read(path, {"kind": "matlab", "wanted": list(variables)})


def read_pickle_sandboxed(path: Path, names: Sequence[str]) -> FileContent:
    """Return those arrays of `names` that the dictionary in a pickle contains; no code of the pickle is called.

    Raises:
        FileError: it cannot be read.
        SandboxError: it is damaged, or refers to objects that no array needs.
    """
    return _read(path, {"kind": "pickle", "wanted": list(names)})


def _read(path: Path, request: dict[str, Any]) -> FileContent:
    with open_file(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        most_bytes = min(SPARE_BYTES + GROWTH * size, MOST_BYTES)
        seconds = MOST_SECONDS + size // BYTES_A_SECOND
        request |= {
            "most_bytes": most_bytes,
            "most_memory": PROGRAM_BYTES + 3 * most_bytes,
            "most_seconds": seconds,
        }
        # A separate program, not multiprocessing: a fork of a process with threads may hang, and spawn would run a
        # script without a main guard again. -P excludes the folder of the program from the module search path.
        command = [sys.executable, "-P", str(Path(sandbox_child.__file__)), json.dumps(request)]
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),  # without the current folder
            "OPENBLAS_NUM_THREADS": "1",
            "HDF5_PLUGIN_PRELOAD": "::",  # no filter plugins, which would be foreign code
        }
        try:
            completed = subprocess.run(
                command, stdin=stream, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment,
                timeout=seconds, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise SandboxError(f"reading it takes longer than {seconds} s") from error
        except OSError as error:
            raise SandboxError(f"the system cannot start the process that reads it ({error.strerror})") from error
    return _tree(completed.stdout)


def _tree(output: bytes) -> FileContent:
    head, newline, _ = output.partition(b"\n") if len(output) < 2**16 else (output[: output.find(b"\n")], b"\n", b"")
    if not newline or not head:
        raise SandboxError("the library that reads it crashes")
    header = json.loads(head)
    if "wrong" in header:
        raise SandboxError(header["wrong"])
    arrays: dict[str, npt.NDArray[Any]] = {}
    offset = len(head) + 1
    for path, kind, shape in header["arrays"]:
        dtype = np.dtype(kind)
        count = int(np.prod(shape, dtype=np.int64))
        if offset + count * dtype.itemsize > len(output):
            raise SandboxError("the library that reads it crashes")
        arrays[path] = np.frombuffer(output, dtype, count, offset).reshape(shape)
        offset += count * dtype.itemsize
    return FileContent(arrays, header["texts"], header["attributes"], tuple(header["groups"]))
