"""Transfer of single results into the shards of a store: shard, manifest, then removal of the single files."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import zipfile
from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.io.files import atomic_path, make_folder, remove_file, sha256_of_file, sweep, write_error
from shapespace.io.landmarks.landmark_io import FIDUCIAL_ENDINGS
from shapespace.io.tables.table_io import CHECKSUM
from shapespace.schemas import FitRecord
from shapespace.store import results as reading
from shapespace.store.manifest import (
    PARTS,
    STAGES,
    SURFACES,
    TABLE,
    Manifest,
    ShardEntry,
    StoredFile,
    arrow,
    read_manifest,
    replaced,
    require_store_extra,
)
from shapespace.store.results import ENDING, ENDINGS, Results
from shapespace.store.rows import FLAGS, META, RECORD, TEXTS, coefficient_columns, kind_of, store_row
from shapespace.store.shard import KINDS, ROW, Shard, is_plain_name
from shapespace.types import Mesh

ROWS = 1000
"""Default number of fits in a shard."""

_ROW_GROUP = 250  # rows; readers load complete groups, and 250 wide rows take a few MB


@dataclass(frozen=True)
class Compacted:
    """Result of moving single results into a store.

    Args:
        moved: names of the results that were moved into a shard.
        left: name -> reason why a result remains in single files.
    """

    moved: list[str] = field(default_factory=list[str])
    left: dict[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, eq=False)
class _Result:
    """A single result after the check of its files; its surfaces are read again for writing."""

    name: str
    text: str
    row: dict[str, Any]
    kinds: tuple[str, ...]
    topology: str


class Store:
    """Results of fits in a folder, moved from single files into shards.

    The caller must have the lock of the folder, since only one process may move results at a time. If it is killed, no
    result is lost or counted twice, and the next call completes the transfer.

    Args:
        folder: folder of the results.

    Raises:
        ShapespaceError: the extra `store` is not installed.
    """

    def __init__(self, folder: Path) -> None:
        require_store_extra()
        self.folder = folder

    def identities(self) -> dict[str, str]:
        """Return name -> identity of the fits in readable shards.

        Raises:
            FileFormatError: the manifest is damaged.
        """
        manifest = read_manifest(self.folder)
        return {} if manifest is None else reading.ResultStore(self.folder, manifest).identities()

    def finish(self) -> list[str]:
        """Complete the transfer of a killed run: remove files that the manifest does not list, and moved single files.

        Returns:
            The names of the results whose single files were removed.

        Raises:
            FileError: a file cannot be removed.
            FileFormatError: the manifest is damaged.
        """
        sweep(self.folder)
        manifest = read_manifest(self.folder)
        if manifest is None:
            return []
        results = Results(self.folder)
        self._remove_unnamed(manifest, results)
        done = [name for name in results.files if results.is_moved(name)]
        for name in done:
            self._remove_singles(name)
        return done

    def _remove_unnamed(self, manifest: Manifest, results: Results) -> None:
        """Remove files that are not in the manifest; a table only if other files contain each of its fits."""
        named = {file.file for shard in manifest.shards for file in shard.files}
        unknown: set[str] = set()
        for part in PARTS:
            folder = self.folder / part
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                begun = path.name.startswith(".")
                if f"{part}/{path.name}" in named or not (begun or path.name.endswith(PARTS[part])):
                    continue
                stem = path.name.removesuffix(PARTS[part])
                if part == TABLE and not begun and not _names_in(path) <= {*results.files, *results.names()}:
                    unknown.add(stem)
                elif stem not in unknown:
                    remove_file(path)
        if unknown:
            raise FileFormatError(
                f"{self.folder / Manifest.FILE} does not list {TABLE}/{min(unknown)}{PARTS[TABLE]}, which contains "
                "fits that are in no other file; copy the manifest again, or move that file away."
            )

    def compact(self, names: Iterable[str] | None = None, *, rows: int = ROWS) -> Compacted:
        """Move finished single results into new shards.

        A result that cannot be moved, such as a result without its surface, remains, with the reason in `left`. A fit
        that is already in a shard is replaced there.

        Args:
            names: names of the results; None for all single results.
            rows: largest number of fits in a shard.

        Raises:
            FileError: a file cannot be read or written, or the disk is full; each result is unchanged or moved.
            FileFormatError: the manifest is damaged.
        """
        self.finish()
        if read_manifest(self.folder) is None:
            # Written first, so that shards without a manifest always indicate a lost manifest.
            self._write_manifest(Manifest())
        results = Results(self.folder)
        singles, stored = results.files, self.identities().keys() if results.files else ()
        wanted = list(singles) if names is None else [name for name in dict.fromkeys(names) if name in singles]
        out = Compacted()
        for first in range(0, len(wanted), rows):
            groups: dict[str, list[_Result]] = {}
            for name in wanted[first : first + rows]:
                try:
                    result = self._read(name, singles[name])
                except ShapespaceError as error:
                    out.left[name] = str(error)
                except (ValueError, OverflowError):
                    out.left[name] = f"The record of {name} is damaged; fit the scan again."
                else:
                    groups.setdefault(result.topology, []).append(result)
            # Fits without a surface are added to a group with surfaces.
            if len(groups) > 1 and (bare := groups.pop("", None)):
                next(iter(groups.values())).extend(bare)
            rank = {name: k for k, name in enumerate(wanted)}
            for group in groups.values():
                self._move(sorted(group, key=lambda result: rank[result.name]), stored)
                out.moved.extend(result.name for result in group)
        return out

    def _write_manifest(self, manifest: Manifest) -> None:
        with atomic_path(self.folder / Manifest.FILE) as temporary:
            temporary.write_text(manifest.text(), encoding="utf-8")
            _to_disk(temporary)
        _to_disk(self.folder)

    def _remove_singles(self, name: str) -> None:
        # The record is removed last, so that the other files are never without it.
        landmarks = FIDUCIAL_ENDINGS if reading.has_written_landmarks(self.folder / f"{name}{ENDING}") else ()
        for ending in (*ENDINGS.values(), *landmarks, ENDING):
            remove_file(self.folder / f"{name}{ending}")

    def _read(self, name: str, parts: frozenset[str]) -> _Result:
        """Return a single result, or raise an error with the reason why it cannot be moved."""
        if not is_plain_name(name):
            raise ShapespaceError(f"{name[:80]!r} is not a valid name in a store; rename the scan.")
        path = self.folder / f"{name}{ENDING}"
        text = path.read_bytes().decode("utf-8")
        record = FitRecord.from_json(json.loads(text), str(path))
        fitted = record.is_fitted
        if fitted and "fitted" not in parts:
            raise ShapespaceError(f"{path} has no surface in its folder; fit the scan again.")
        kinds = tuple(kind for kind in ENDINGS if fitted and kind in parts)
        row = store_row(name, record) | {kind: kind in kinds for kind in FLAGS}
        topologies = {_topology(self._surface(name, kind)) for kind in KINDS if kind in kinds}
        if len(topologies) > 1:
            raise ShapespaceError(f"{path}: its surfaces differ in vertices or triangles; fit the scan again.")
        return _Result(name, text, row, kinds, next(iter(topologies), ""))

    def _surface(self, name: str, kind: str) -> Mesh:
        return reading.read_mesh(self.folder / f"{name}{ENDINGS[kind]}")

    def _move(self, group: Sequence[_Result], stored: Container[str]) -> None:
        manifest = read_manifest(self.folder) or Manifest()
        mark = hashlib.sha256("\n".join(result.text for result in group).encode()).hexdigest()[:12]
        stem = f"{len(manifest.shards):05d}-{mark}"
        surfaces = self._write_surfaces(stem, [result for result in group if "fitted" in result.kinds])
        position = {name: k for k, name in enumerate(result.name for result in group if "fitted" in result.kinds)}
        rows = [result.row | {ROW: position.get(result.name, -1), RECORD: result.text} for result in group]
        new = ShardEntry(
            table=self._write_table(stem, rows, self._columns_of(manifest)),
            surfaces=surfaces,
            stages=self._write_stages(stem, [result.name for result in group if "stages" in result.kinds]),
            **_summary(rows),
        )
        older = {result.name for result in group if result.name in stored}
        remaining = [self._remove_rows(shard, older) if older else shard for shard in manifest.shards]
        shards = (*(shard for shard in remaining if shard is not None), new)
        self._write_manifest(Manifest(shards=shards))
        for result in group:
            self._remove_singles(result.name)
        gone = {file.file for shard in manifest.shards for file in shard.files}
        for file in gone - {file.file for shard in shards for file in shard.files}:
            remove_file(self.folder / file)

    def _remove_rows(self, entry: ShardEntry, names: set[str]) -> ShardEntry | None:
        """Return a shard without the rows of `names`, or None if no row remains; a damaged shard is unchanged."""
        if not any(entry.first <= name <= entry.last for name in names):
            return entry
        shard = Shard(self.folder, entry)
        try:
            if not names & set(shard.columns(("scan",))["scan"]):
                return entry
            columns = shard.columns(sorted(shard.column_names()))
        except ShapespaceError:
            return entry
        remaining = [k for k, name in enumerate(columns["scan"]) if name not in names]
        rows = [{column: values[k] for column, values in columns.items() if values[k] is not None} for k in remaining]
        if not rows:
            return None
        mark = hashlib.sha256("\n".join(row["scan"] for row in rows).encode()).hexdigest()[:12]
        stem = f"{Path(entry.table.file).name[:5]}-{mark}"
        return replaced(entry, table=self._write_table(stem, rows, columns), **_summary(rows))

    def _columns_of(self, manifest: Manifest) -> Iterable[str]:
        """Return the columns of the last readable shard, since all tables must have the same columns."""
        for entry in reversed(manifest.shards):
            with contextlib.suppress(ShapespaceError):
                return Shard(self.folder, entry).column_names()
        return ()

    def _write_table(self, stem: str, rows: Sequence[Mapping[str, Any]], also: Iterable[str]) -> StoredFile:
        pa = arrow()
        kinds: dict[str, Any] = {"text": pa.string(), "count": pa.int64(), "flag": pa.bool_(), "number": pa.float64()}
        modes = max(row.get("modes") or 0 for row in rows)
        every = {column for row in rows for column in row}
        columns = _sort_columns(every.union(also, coefficient_columns(modes), TEXTS) - {CHECKSUM})
        types: dict[str, Any] = {column: kinds["count" if column == ROW else kind_of(column)] for column in columns}
        table: Any = pa.table({
            column: pa.array([row.get(column) for row in rows], type=kind) for column, kind in types.items()
        })  # fmt: skip
        texts = [column for column in columns if column not in (RECORD, "scan", "id") and kind_of(column) == "text"]

        def write(path: Path) -> None:
            arrow(".parquet").write_table(
                table, path, compression="zstd", row_group_size=_ROW_GROUP, use_dictionary=texts,
                write_statistics=["scan"], write_page_checksum=True,
            )  # fmt: skip

        return self._write_part(TABLE, stem, write)

    def _write_surfaces(self, stem: str, group: Sequence[_Result]) -> StoredFile | None:
        if not group:
            return None
        import zarr
        from zarr.storage import ZipStore

        kinds = [kind for kind in KINDS if any(kind in result.kinds for result in group)]

        def write(path: Path) -> None:
            first = self._surface(group[0].name, "fitted")
            count = len(first.vertices)
            with ZipStore(path, mode="w", compression=zipfile.ZIP_STORED) as store:
                root: Any = zarr.create_group(store, zarr_format=3)

                def array(name: str, shape: tuple[int, ...], kind: str, chunk: tuple[int, ...]) -> Any:
                    return root.create_array(
                        name, shape=shape, dtype=kind, chunks=chunk, compressors=None, filters=None,
                        fill_value={"i": -1, "u": 0, "f": np.nan}[kind[1]],
                    )  # fmt: skip

                if first.faces is not None:
                    array("faces", first.faces.shape, "<i4", first.faces.shape)[:] = first.faces
                for kind in kinds:
                    offsets = array(kind, (len(group), count, 3), "<f4", (1, count, 3))
                    colours: Any = None
                    origins = np.full((len(group), 3), np.nan)
                    for k, result in enumerate(group):
                        if kind in result.kinds:
                            surface = self._surface(result.name, kind)
                            origins[k] = _middle(surface.vertices)
                            offsets[k] = surface.vertices - origins[k]
                            if surface.colours is not None:
                                colours = colours or array(f"{kind}_colours", offsets.shape, "|u1", (1, count, 3))
                                colours[k] = surface.colours
                    array(f"{kind}_origin", origins.shape, "<f8", origins.shape)[:] = origins

        return self._write_part(SURFACES, stem, write)

    def _write_stages(self, stem: str, names: Sequence[str]) -> StoredFile | None:
        if not names:
            return None

        def write(path: Path) -> None:
            with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
                for name in names:
                    archive.write(self.folder / f"{name}{ENDINGS['stages']}", f"{name}{ENDINGS['stages']}")

        return self._write_part(STAGES, stem, write)

    def _write_part(self, part: str, stem: str, write: Any) -> StoredFile:
        path = make_folder(self.folder / part) / f"{stem}{PARTS[part]}"
        with atomic_path(path) as temporary:
            write(temporary)
            _to_disk(temporary)
            size, digest = temporary.stat().st_size, sha256_of_file(temporary)
            end = _end_of_table(temporary) if part == TABLE else b""
        _to_disk(path.parent)
        ended = hashlib.sha256(end).hexdigest() if end else ""
        return StoredFile(file=f"{part}/{path.name}", bytes=size, sha256=digest, end_bytes=len(end), end_sha256=ended)


def _names_in(table: Path) -> set[str]:
    """Return the names of the fits in a table; if it cannot be read, a name that no fit has."""
    try:
        return {str(name) for name in arrow(".parquet").read_table(table, columns=["scan"]).column("scan").to_pylist()}
    except (OSError, ValueError, KeyError):
        return {""}


def _end_of_table(path: Path) -> bytes:
    """Return the footer of a Parquet file: its schema, the positions of its pages, the footer length, and PAR1."""
    with path.open("rb") as stream:
        stream.seek(-8, os.SEEK_END)
        length = int.from_bytes(stream.read(4), "little")
        stream.seek(-8 - length, os.SEEK_END)
        return stream.read()


def _to_disk(path: Path) -> None:
    """Wait until a file, or the entries of a folder, are on the disk, because the single files whose results they
    contain are removed afterwards.
    """
    if path.is_dir() and os.name == "nt":
        return
    try:
        handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise write_error(path, error) from error


def _summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names = [str(row["scan"]) for row in rows]
    counts = dict(sorted(Counter(str(row["status"]) for row in rows).items()))
    return {"rows": len(rows), "counts": counts, "first": min(names), "last": max(names)}


def _sort_columns(columns: set[str]) -> list[str]:
    """Return columns in the order of the table: identification of a fit, metadata, numbers, and its record."""
    lead = [column for column in TEXTS if column in columns and column != RECORD]
    metas = sorted(column for column in columns if column.startswith(META))
    rest = sorted(columns.difference(lead, metas, (RECORD, ROW, *FLAGS)), key=_natural_key)
    return [*lead, *metas, *rest, *FLAGS, ROW, RECORD]


def _natural_key(column: str) -> tuple[str, int, str]:
    """Return a key that sorts b2 before b10."""
    letter, number = column[:1], column[1:].removesuffix("_stddev").removesuffix("_rms_mm")
    return (f"{letter}{column.removeprefix(letter + number)}", int(number), "") if number.isdigit() else (column, 0, "")


def _topology(mesh: Mesh) -> str:
    """Return a key of the number of vertices and the triangles of a mesh; raise if a store cannot contain the mesh."""
    vertices = mesh.vertices
    if not len(vertices) or not np.isfinite(vertices).all():
        raise ShapespaceError(f"{mesh.name} has no vertices, or vertices that are not finite; fit the scan again.")
    with np.errstate(over="ignore"):
        farthest = np.abs(vertices - _middle(vertices)).max()
    if farthest > np.finfo(np.float32).max:
        raise ShapespaceError(f"{mesh.name} is too large for a store.")
    faces = b"" if mesh.faces is None else hashlib.sha256(mesh.faces.tobytes()).digest()
    return f"{len(vertices)} {faces.hex()}"


def _middle(vertices: Any) -> Any:
    """Return the centre of the box around `vertices` (V, 3), from which offsets are smallest."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return low / 2 + high / 2
