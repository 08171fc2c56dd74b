"""The manifest of a store: its shards, with the size and hash of each file."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, ClassVar, Literal, cast

import msgspec
from msgspec import Struct

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.io.files import read_bytes, read_error, sha256_of_file
from shapespace.schemas import json_text, read
from shapespace.version import __version__

AGAIN = "copy it again from an intact store, or remove it from the folder and fit its scans again"
TABLE, SURFACES, STAGES = "table", "surfaces", "stages"
"""Folders of a store."""
PARTS: Mapping[str, str] = {TABLE: ".parquet", SURFACES: ".zarr.zip", STAGES: ".zip"}
"""Folder -> ending of the files in it."""

LARGEST_MANIFEST = 64 * 2**20  # 64 MiB
MOST_ROWS = 100_000
"""Largest number of rows of a shard."""

_FILE = re.compile(r"(table/[\w-]{1,80}\.parquet|surfaces/[\w-]{1,80}\.zarr\.zip|stages/[\w-]{1,80}\.zip)", re.ASCII)


class StoredFile(Struct, frozen=True, kw_only=True):
    """A file of a store.

    Args:
        file: path of the file, relative to the folder of the store.
        bytes: size of the file, bytes.
        sha256: SHA-256 of the file.
        end_bytes: size of the end of a table, bytes, which locates all other parts; 0 for other files.
        end_sha256: SHA-256 of the end of a table; the rest of a table has checksums of its own.
    """

    file: str
    bytes: int
    sha256: str
    end_bytes: int = 0
    end_sha256: str = ""

    def path(self, root: Path) -> Path:
        """Return the path of the file, after a check of its name, folder and size.

        Raises:
            FileFormatError: the name leads elsewhere, or the file is absent, a link, or of another size.
        """
        path = root / self.file
        if not _FILE.fullmatch(self.file) or path.is_symlink() or path.parent.is_symlink():
            raise FileFormatError(
                f"{root / Manifest.FILE} names {self.file[:80]!r}, which is no file of a store; {AGAIN}."
            )
        if not path.is_file():
            raise FileFormatError(f"{path} is no longer there, and with it a part of the results; {AGAIN}.")
        if path.stat().st_size != self.bytes:
            raise FileFormatError(f"{path} is cut short or of another size than it was; {AGAIN}.")
        return path

    def verify_end(self, root: Path) -> Path:
        """Return the path of the file, after a check of the end of its content; the rest is not read.

        Raises:
            FileError: the file cannot be read.
            FileFormatError: the content has changed.
        """
        path = self.path(root)
        try:
            with path.open("rb") as stream:
                stream.seek(max(self.bytes - max(self.end_bytes, 0), 0))
                end = stream.read()
        except OSError as error:
            raise read_error(path, error) from error
        if hashlib.sha256(end).hexdigest() != self.end_sha256:
            raise FileFormatError(f"{path} is damaged: its content has changed since it was written; {AGAIN}.")
        return path

    def verify(self, root: Path) -> Path:
        """Return the path of the file, after a check of its content.

        Raises:
            FileError: the file cannot be read.
            FileFormatError: the content has changed.
        """
        path = self.path(root)
        if sha256_of_file(path) != self.sha256:
            raise FileFormatError(f"{path} is damaged: its content has changed since it was written; {AGAIN}.")
        return path


class ShardEntry(Struct, frozen=True, kw_only=True):
    """One shard: a table with a row for each fit, and surfaces of some fits.

    Args:
        table: Parquet file of the table.
        surfaces: Zarr file of the surfaces; None if no fit has a surface.
        stages: zip file of NAME.stages.npz; None if no stages are stored.
        rows: number of rows of the table.
        counts: status -> number of fits.
        first: first name in order.
        last: last name in order.
    """

    table: StoredFile
    surfaces: StoredFile | None = None
    stages: StoredFile | None = None
    rows: int
    counts: Mapping[str, int] = {}
    first: str = ""
    last: str = ""

    @property
    def files(self) -> list[StoredFile]:
        """Files of the shard."""
        return [file for file in (self.table, self.surfaces, self.stages) if file is not None]


class Manifest(Struct, frozen=True, kw_only=True):
    """A manifest.json."""

    FORMAT: ClassVar = "shapespace store"
    VERSION: ClassVar = 1
    FILE: ClassVar = "manifest.json"

    format: Literal["shapespace store"] = "shapespace store"
    format_version: int = 1
    version: str = __version__
    shards: tuple[ShardEntry, ...] = ()

    def text(self) -> str:
        """Return the manifest as the text of its file."""
        return json_text(self)


def read_manifest(folder: Path) -> Manifest | None:
    """Return the manifest of the store in `folder`; None without a store.

    Raises:
        FileError: the manifest cannot be read.
        FileFormatError: the manifest is damaged, or of a later version.
    """
    path = folder / Manifest.FILE
    if not path.is_file():
        if (folder / TABLE).is_dir() and any((folder / TABLE).glob(f"[!.]*{PARTS[TABLE]}")):
            raise FileFormatError(f"{folder} contains shards without their {Manifest.FILE}; copy that file too.")
        return None
    if path.stat().st_size > LARGEST_MANIFEST:
        raise FileFormatError(f"{path} is larger than a manifest can be; {AGAIN}.")
    try:
        content: object = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:
        if not (folder / TABLE).is_dir():
            return None  # a manifest of another program
        raise FileFormatError(f"{path} is not JSON, or it is cut short; copy it again.") from error
    known: Mapping[str, object] = cast(dict[str, object], content) if isinstance(content, dict) else {}
    if known.get("format") != Manifest.FORMAT and not (folder / TABLE).is_dir():
        return None
    if known.get("format_version") != Manifest.VERSION and known.get("format") == Manifest.FORMAT:
        raise FileFormatError(f"{path} is of a version of stores that this shapespace does not know; update it.")
    manifest = read(Manifest, cast(object, content), str(path), "copy it again")
    if any(not 0 < shard.rows <= MOST_ROWS for shard in manifest.shards):
        raise FileFormatError(f"{path} is damaged: a shard has no rows, or too many; copy it again.")
    return manifest


def require_store_extra() -> None:
    """Raise an error unless the packages that read and write stores are installed.

    Raises:
        ShapespaceError: packages are missing; the message names the command that installs them.
    """
    missing = [name for name in ("pyarrow", "zarr") if find_spec(name) is None]
    if missing:
        raise ShapespaceError(
            f"These results are in a store, which needs {' and '.join(missing)}; run pip install 'shapespace[store]'."
        )


def arrow(part: str = "") -> Any:
    """Return pyarrow, or a part of it such as `.parquet`, untyped."""
    require_store_extra()
    return import_module(f"pyarrow{part}")


def replaced(entry: ShardEntry, **changes: object) -> ShardEntry:
    """Return `entry` with other fields."""
    return msgspec.structs.replace(entry, **changes)
