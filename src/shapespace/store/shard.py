"""Reader of one shard of a store, checked against the manifest."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileError, FileFormatError, ShapespaceError
from shapespace.store.manifest import AGAIN, ShardEntry, arrow, require_store_extra
from shapespace.store.rows import RECORD, kind_of
from shapespace.types import ByteArray, FloatArray, Mesh

if TYPE_CHECKING:
    from collections.abc import Generator

KINDS = ("fitted", "dense")
"""Kinds of surfaces of a fit in a store."""

ROW = "row"
"""Column of the position of a fit in the arrays of its shard."""

MOST_EXPANSION, LEAST_BYTES = 200, 16 * 2**20
"""A table may have this many times its bytes on disk, and this many bytes in any case."""

_OPEN = 16  # number of files that are kept open
_RECORDS_KEPT = 2  # number of row groups; records are read in order


class Shard:
    """One shard; its files are opened on first use.

    Args:
        root: folder of the store.
        entry: entry of the shard in the manifest.

    Raises:
        ShapespaceError: the extra `store` is not installed.
    """

    def __init__(self, root: Path, entry: ShardEntry) -> None:
        require_store_extra()
        self.root, self.entry = root, entry
        self._verified = False
        self._row_groups: tuple[int, ...] = ()
        self._names_of_columns: frozenset[str] = frozenset()

    @property
    def name(self) -> str:
        """Name of the shard in messages."""
        return str(self.root / self.entry.table.file)

    def columns(self, names: Sequence[str]) -> dict[str, list[Any]]:
        """Return columns of the table, one value per row; None for values that a fit, or all fits, do not state.

        Raises:
            FileError: the table cannot be read.
            FileFormatError: the table is damaged, or does not match the manifest.
        """
        with self._table() as table:
            stored = [column for column in names if column in self._names_of_columns]
            columns = table.read(columns=stored)
            column_values: dict[str, list[Any]] = {column: columns.column(column).to_pylist() for column in stored}
        for column, values in column_values.items():
            _check_values(column, values, self.name)
        return {column: column_values.get(column, [None] * self.entry.rows) for column in names}

    def has(self, column: str) -> bool:
        """Return whether the table has a column of that name."""
        with self._table():
            return column in self._names_of_columns

    def column_names(self) -> frozenset[str]:
        """Return the names of all columns."""
        with self._table():
            return self._names_of_columns

    def record_text(self, row: int) -> str:
        """Return the record of a row as in its file.

        Raises:
            FileError: the record cannot be read.
            FileFormatError: the record is damaged.
        """
        with self._table():
            group_ends = np.cumsum(self._row_groups)
        group = int(np.searchsorted(group_ends, row, side="right"))
        text = _records(self, group)[row - int(group_ends[group - 1] if group else 0)]
        if not isinstance(text, str):
            raise FileFormatError(f"{self.name} lacks a record; {AGAIN}.")
        return text

    def surface(self, row: int, kind: str, name: str) -> Mesh:
        """Return a surface in the frame and unit of its scan.

        Args:
            row: position of the fit, its value in the column `ROW`.
            kind: kind of surface, one of `KINDS`.
            name: name of the mesh.

        Raises:
            FileError: the surface cannot be read.
            FileFormatError: the surface is missing or damaged.
        """
        if self.entry.surfaces is None:
            raise FileFormatError(f"{self.name} has no surfaces; {AGAIN}.")
        path = self.entry.surfaces.path(self.root)
        vertices, faces, colours = _surfaces(path, path.stat().st_mtime_ns).read(kind, row)
        return Mesh(vertices, faces, name=name, colours=colours)

    def stages(self, name: str) -> bytes:
        """Return the content of NAME.stages.npz.

        Raises:
            FileError: the stages cannot be read.
            FileFormatError: the stages are missing or damaged.
        """
        if self.entry.stages is None:
            raise FileFormatError(f"{self.name} has no stages; {AGAIN}.")
        path = self.entry.stages.path(self.root)
        with _damage(path), zipfile.ZipFile(path) as archive:
            _check_members(archive, path)
            return archive.read(f"{name}.stages.npz")

    @contextmanager
    def _table(self) -> Generator[Any]:
        path = self.entry.table.path(self.root) if self._verified else self.entry.table.verify_end(self.root)
        with _damage(path), arrow(".parquet").ParquetFile(path, page_checksum_verification=True) as table:
            if not self._verified:
                self._check(table.metadata, table.schema_arrow, path)
            yield table

    def _check(self, metadata: Any, schema: Any, path: Path) -> None:
        """Check that the table is one of a store, and that its columns are not much larger than its file."""
        groups = [metadata.row_group(k) for k in range(metadata.num_row_groups)]
        total_bytes = sum(group.total_byte_size for group in groups)
        kinds = {"text": "string", "number": "double", "count": "int64", "flag": "bool"}
        if (
            metadata.num_rows != self.entry.rows
            or sum(group.num_rows for group in groups) != self.entry.rows
            or any(group.num_rows < 0 for group in groups)
            or total_bytes > max(MOST_EXPANSION * self.entry.table.bytes, LEAST_BYTES)
            or len(set(schema.names)) != len(schema.names)
            or any(str(field.type) != kinds["count" if field.name == ROW else kind_of(field.name)] for field in schema)
            or not {"scan", "status", RECORD, ROW} <= set(schema.names)
        ):
            raise FileFormatError(f"{path} is not a table of a store as its manifest describes it; {AGAIN}.")
        self._row_groups = tuple(group.num_rows for group in groups)
        self._names_of_columns = frozenset(schema.names)
        self._verified = True

    def records(self, group: int) -> list[Any]:
        """Return the records of a row group."""
        with self._table() as table:
            return table.read_row_group(group, columns=[RECORD]).column(RECORD).to_pylist()


@lru_cache(maxsize=_RECORDS_KEPT)
def _records(shard: Shard, group: int) -> list[Any]:
    # Cached for all shards together, since each group has some MB.
    return shard.records(group)


def is_plain_name(name: object) -> bool:
    """Return whether `name` may be a part of a file's name and does not lead to another folder."""
    return (
        isinstance(name, str)
        and bool(name)
        and not set(name) & {"/", "\\", "\0"}
        and name not in (".", "..")
        and len(name.encode("utf-8", "surrogatepass")) <= 255
    )


def _check_values(column: str, values: Sequence[object], path_name: str) -> None:
    if column == "scan" and not (all(map(is_plain_name, values)) and len(set(values)) == len(values)):
        raise FileFormatError(f"{path_name} has names that no results can have; {AGAIN}.")
    if column == ROW and any(not isinstance(value, int) or value < -1 for value in values):
        raise FileFormatError(f"{path_name} does not state where its surfaces are; {AGAIN}.")
    if column == "status" and not all(isinstance(value, str) for value in values):
        raise FileFormatError(f"{path_name} has rows without a status; {AGAIN}.")


@contextmanager
def _damage(path: Path) -> Generator[None]:
    """Replace the exceptions of libraries for damaged files by a shapespace error with one sentence."""
    try:
        yield
    except ShapespaceError:
        raise
    except OSError as error:
        # pyarrow raises plain OSErrors without a number for files that it cannot decode.
        if error.errno is not None:
            raise FileError(f"Cannot read {path}: {error.strerror or error}.") from error
        raise FileFormatError(f"{path} is damaged; {AGAIN}.") from error
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, RuntimeError) as error:
        raise FileFormatError(f"{path} is damaged; {AGAIN}.") from error
    except (zipfile.BadZipFile, EOFError, NotImplementedError, UnicodeError) as error:
        raise FileFormatError(f"{path} is damaged; {AGAIN}.") from error


def _check_members(archive: zipfile.ZipFile, path: Path) -> None:
    """Check that no member is compressed or listed twice, so that none is larger than the bytes of the file."""
    members = archive.infolist()
    if (
        any(member.compress_type != zipfile.ZIP_STORED for member in members)
        or any(member.file_size != member.compress_size for member in members)
        or len({member.filename for member in members}) != len(members)
        or sum(member.file_size for member in members) > path.stat().st_size
    ):
        raise FileFormatError(f"{path} is not a file of a store; {AGAIN}.")


def array_metadata(shape: Sequence[int], chunk: Sequence[int], kind: str) -> dict[str, Any]:
    """Return the expected content of the zarr.json of an array of a store; nothing else is read."""
    return {
        "shape": list(shape),
        "data_type": kind,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(chunk)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [{"name": "bytes", "configuration": {"endian": "little"}}],
        "zarr_format": 3,
        "node_type": "array",
    }


_ITEM = {"float32": 4, "float64": 8, "int32": 4, "uint8": 1}


@lru_cache(maxsize=_OPEN)
def _surfaces(path: Path, _changed: int) -> _Surfaces:
    return _Surfaces(path)


class _Surfaces:
    """The open Zarr file of a shard; arrays are checked before the library reads them."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with _damage(path):
            with zipfile.ZipFile(path) as archive:
                _check_members(archive, path)
                self._sizes = {member.filename: member.file_size for member in archive.infolist()}
                metadata = {name: archive.read(name) for name in self._sizes if name.endswith("/zarr.json")}
            self._shapes = {
                name.removesuffix("/zarr.json"): self._shape(json.loads(text)) for name, text in metadata.items()
            }
            import zarr
            from zarr.storage import ZipStore

            self._group: Any = zarr.open_group(ZipStore(path, mode="r"), mode="r", zarr_format=3)
            self._faces: npt.NDArray[np.int32] | None = None
            if "faces" in self._shapes:
                self._faces = self._chunk("faces", 0)

    def read(self, kind: str, row: int) -> tuple[FloatArray, npt.NDArray[np.int32] | None, ByteArray | None]:
        """Return vertices (V, 3) of row `row`, the faces, and the colours (V, 3) if there are some."""
        with _damage(self._path):
            offsets, origin = self._chunk(kind, row)[0], self._chunk(f"{kind}_origin", 0)[row]
            # Only fits with colours have a chunk there.
            colour_kind = f"{kind}_colours"
            colours = self._chunk(colour_kind, row)[0] if f"{colour_kind}/c/{row}/0/0" in self._sizes else None
            return offsets.astype(np.float64) + origin, self._faces, colours

    def _chunk(self, name: str, row: int) -> npt.NDArray[Any]:
        """Return the chunk `row` of an array, which must be in the file with its full size."""
        shape, chunk, item = self._shapes[name]
        key = f"{name}/c/{row}" + "/0" * (len(shape) - 1)
        if row < 0 or self._sizes.get(key) != item * int(np.prod(chunk, dtype=np.int64)):
            raise FileFormatError(f"{self._path} lacks a surface that its table has; {AGAIN}.")
        return np.asarray(self._group[name][row * chunk[0] : (row + 1) * chunk[0]])

    def _shape(self, metadata: Any) -> tuple[tuple[int, ...], tuple[int, ...], int]:
        shape, chunk = tuple(metadata["shape"]), tuple(metadata["chunk_grid"]["configuration"]["chunk_shape"])
        kind = str(metadata["data_type"])
        expected = array_metadata(shape, chunk, kind)
        values = {key: metadata.get(key) for key in expected}
        if kind == "uint8" and values["codecs"] == [{"name": "bytes"}]:
            values["codecs"] = expected["codecs"]  # bytes have no order, which zarr omits since 3.1
        if (
            values != expected
            or kind not in _ITEM
            or not set(metadata) <= {*expected, "fill_value", "attributes", "storage_transformers"}
            or metadata.get("storage_transformers") or metadata.get("attributes")
            or len(shape) not in (2, 3) or len(chunk) != len(shape)
            or not all(type(n) is int and 0 < n < 2**31 for n in (*shape, *chunk))
            or shape[-1] != 3 or chunk[1:] != shape[1:]
        ):  # fmt: skip
            raise FileFormatError(f"{self._path} contains arrays that no store has; {AGAIN}.")
        return cast("tuple[tuple[int, ...], tuple[int, ...], int]", (shape, chunk, _ITEM[kind]))
