"""Results of fits in a folder, from single files or shards of a store, read one at a time or as rows."""

from __future__ import annotations

import difflib
import io
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy.typing as npt

from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.io.containers.archives import arrays_in, read_arrays
from shapespace.io.containers.json_files import LARGEST_BYTES, parse_json, read_json
from shapespace.io.files import read_bytes, read_error
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.tables.table_io import CHECKSUM
from shapespace.lazy import lazy_import, require_package
from shapespace.reprs import describe_briefly
from shapespace.schemas import FIT_AGAIN, FitRecord
from shapespace.store.manifest import Manifest, read_manifest
from shapespace.store.rows import FLAGS, META, coefficient_columns, kind_of, store_row
from shapespace.store.shard import ROW, Shard
from shapespace.types import Mesh, require_path

ENDING = ".fit.json"
"""Ending of the record of a fit, after NAME."""

ENDINGS: Mapping[str, str] = {"fitted": ".fitted.ply", "dense": ".dense.ply", "stages": ".stages.npz"}
"""Kind of a further file of a fit, next to the record -> its ending."""

BATCH = 1000  # rows; a few MB with all columns
_NEAR = 3  # number of similar names in a message
_OPEN = 4  # number of folders that are kept open


class StoredFit(NamedTuple):
    """Location of a fit in a store, and its files.

    Args:
        shard: number of the shard, in the order of the manifest.
        row: row in the table of the shard.
        position: position in the arrays of the shard; -1 without a surface.
        id: identity of the fit; empty if the record has none.
        status: status of the fit.
        fitted: whether the fitted surface is stored.
        dense: whether the dense surface is stored.
        stages: whether the stages are stored.
    """

    shard: int
    row: int
    position: int
    id: str
    status: str
    fitted: bool
    dense: bool
    stages: bool


class _Identity(msgspec.Struct, frozen=True):
    id: str = ""


class ResultStore:
    """Shards of a folder.

    Args:
        folder: folder of the store.
        manifest: manifest in the folder, from `read_manifest`.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder, self.manifest = folder, manifest
        self.shards = [Shard(folder, entry) for entry in manifest.shards]
        self.problems: list[str] = []
        self._index: dict[str, StoredFit] | None = None

    @property
    def index(self) -> Mapping[str, StoredFit]:
        """Name -> location of the fit, in the order of the shards; fits of damaged shards are missing.

        One sentence for each damaged shard is added to `problems`. For a name in two shards the later shard is used.
        """
        if self._index is None:
            index: dict[str, StoredFit] = {}
            for number, shard in enumerate(self.shards):
                try:
                    columns = shard.columns(("scan", "id", "status", ROW, *FLAGS))
                except ShapespaceError as error:
                    if str(error) not in self.problems:
                        self.problems.append(str(error))
                    continue
                for row, (name, identity, status, position, *flags) in enumerate(zip(*columns.values(), strict=True)):
                    index.pop(name, None)
                    index[name] = StoredFit(
                        number, row, position, identity or "", status, *(flag is True for flag in flags)
                    )
            self._index = index
        return self._index

    def identities(self) -> dict[str, str]:
        """Return name -> identity of each fit in a shard that can be read."""
        return {name: stored.id for name, stored in self.index.items()}

    def record_text(self, name: str) -> str:
        """Return the record of a fit as in its file."""
        stored = self.index[name]
        return self.shards[stored.shard].record_text(stored.row)

    def surface(self, name: str, kind: str) -> Mesh:
        """Return a surface of a fit in the frame and unit of its scan."""
        stored = self.index[name]
        return self.shards[stored.shard].surface(stored.position, kind, f"{name}{ENDINGS[kind]}")

    def stages(self, name: str) -> bytes:
        """Return the content of NAME.stages.npz."""
        return self.shards[self.index[name].shard].stages(name)

    def iter_rows(self, columns: Sequence[str], without: Mapping[str, object]) -> Iterator[dict[str, list[Any]]]:
        """Yield columns of the rows of each shard, without some names; damaged shards are skipped."""
        index = self.index
        for number, shard in enumerate(self.shards):
            try:
                table = shard.columns(("scan", *columns))
            except ShapespaceError as error:
                if str(error) not in self.problems:
                    self.problems.append(str(error))
                continue
            current = [
                row
                for row, name in enumerate(table["scan"])
                if name not in without
                and (location := index.get(name))
                and (location.shard, location.row) == (number, row)
            ]
            is_whole = len(current) == len(table["scan"])
            yield {column: table[column] if is_whole else [table[column][row] for row in current] for column in columns}


class Results:
    """Results of fits in a folder, from single files and from a store.

    For a fit that is in both, the single file is used, which is newer. Names and flags are those at the time of
    construction.

    Args:
        folder: folder that `shapespace fit` wrote.
        store: shards of the folder, if they are open already; None opens them.

    Raises:
        FileError: the folder cannot be read.
        FileFormatError: the manifest of its store is damaged.
        ShapespaceError: there is a store, and the extra `store` is not installed.
    """

    def __init__(self, folder: Path | str, store: ResultStore | None = None) -> None:
        require_path(folder, "Results")
        self.folder = Path(folder)
        manifest = None if store is not None else read_manifest(self.folder)
        self.store = store if manifest is None else ResultStore(self.folder, manifest)
        try:
            file_names = {entry.name for entry in os.scandir(self.folder)}
        except OSError as error:
            raise read_error(self.folder, error) from error
        self.files: Mapping[str, frozenset[str]] = {
            name: frozenset(kind for kind, ending in ENDINGS.items() if f"{name}{ending}" in file_names)
            for name in sorted(file.removesuffix(ENDING) for file in file_names if file.endswith(ENDING))
        }
        self._problems: list[str] = []

    @cached_property
    def singles(self) -> Mapping[str, frozenset[str]]:
        """Name -> kinds of `ENDINGS` next to the record, for fits in single files.

        Fits that a killed run had moved to a shard, but not yet removed, are not included.
        """
        return {
            name: kinds for name, kinds in self.files.items() if name not in self._stored or not self.is_moved(name)
        }

    def is_moved(self, name: str) -> bool:
        """Return whether a shard contains the record of a single file, byte for byte."""
        try:
            stored = self.store.record_text(name) if self.store and name in self._stored else None
            return stored is not None and stored.encode() == read_bytes(self.folder / f"{name}{ENDING}")
        except (ShapespaceError, UnicodeError):
            return False

    @property
    def problems(self) -> list[str]:
        """One sentence for each shard, and each single record, that could not be read so far."""
        return list(dict.fromkeys([*(self.store.problems if self.store else ()), *self._problems]))

    @property
    def _stored(self) -> Mapping[str, StoredFit]:
        return self.store.index if self.store else {}

    def names(self) -> list[str]:
        """Return the names of all fits, in order."""
        return sorted({*self.singles, *self._stored})

    def __repr__(self) -> str:
        return f"<Results in {describe_briefly(str(self.folder))}: {len(self):,} fits>"

    def _repr_html_(self) -> str:
        return lazy_import("html_of_results")(self)

    def __len__(self) -> int:
        return len(self.singles) + sum(name not in self.singles for name in self._stored)

    def __contains__(self, name: object) -> bool:
        return name in self.singles or name in self._stored

    def has(self, name: str, kind: str) -> bool:
        """Return whether a file of `kind` of `ENDINGS` is stored for a fit."""
        if name in self.singles:
            return kind in self.singles[name]
        return name in self._stored and bool(getattr(self._stored[name], kind))

    def record_bytes(self, name: str) -> bytes:
        """Return the record of a fit as in its file.

        Raises:
            FileError: the record cannot be read.
            FileFormatError: the shard of the record is damaged.
            InputError: there is no such fit.
        """
        if name in self.singles:
            return read_bytes(self.folder / f"{name}{ENDING}")
        return self._store_of(name).record_text(name).encode("utf-8", "surrogatepass")

    def record(self, name: str) -> dict[str, Any]:
        """Return the checked content of the record of a fit; `fit` returns it typed.

        Raises:
            FileError: the record cannot be read.
            FileFormatError: the record is damaged.
            InputError: there is no such fit.
        """
        content = self._content(name)
        self._parse_record(name, content)
        return cast(dict[str, Any], content)

    def fit(self, name: str) -> FitRecord:
        """Return the record of a fit; for the errors see `record`."""
        return self._parse_record(name, self._content(name))

    def _content(self, name: str) -> object:
        return parse_json(self.record_bytes(name), self.folder / f"{name}{ENDING}", FIT_AGAIN)

    def _parse_record(self, name: str, content: object) -> FitRecord:
        return FitRecord.from_json(content, str(self.folder / f"{name}{ENDING}"))

    def surface(self, name: str, kind: str = "fitted") -> Mesh:
        """Return the `fitted` or `dense` surface of a fit, in the frame and unit of its scan.

        Raises:
            FileError: the surface cannot be read.
            FileFormatError: the surface is damaged, or was not stored.
            InputError: there is no such fit.
        """
        if name in self.singles:
            return read_mesh(self.folder / f"{name}{ENDINGS[kind]}")
        store = self._store_of(name)
        if not self.has(name, kind):
            raise FileFormatError(f"{self.folder}: no {kind} surface of {name} was kept; fit the scan again.")
        return store.surface(name, kind)

    def stages(self, name: str) -> bytes:
        """Return the content of NAME.stages.npz.

        Raises:
            FileError: the stages cannot be read.
            FileFormatError: the stages are damaged, or were not stored.
            InputError: there is no such fit.
        """
        if name in self.singles:
            return read_bytes(self.folder / f"{name}{ENDINGS['stages']}")
        store = self._store_of(name)
        if not self.has(name, "stages"):
            raise FileFormatError(f"{self.folder}: the stages of {name} were not kept; fit it again with --stages.")
        return store.stages(name)

    def _store_of(self, name: str) -> ResultStore:
        """Return the store that contains a fit without a single file, after `known` has checked that it exists."""
        self.known(name)
        assert self.store is not None
        return self.store

    def identities(self) -> dict[str, str]:
        """Return name -> identity of each fit; empty for records that have none, or cannot be read."""
        identities = dict(self.store.identities()) if self.store else {}
        for name in self.singles:
            try:
                identities[name] = msgspec.json.decode(self.record_bytes(name), type=_Identity).id
            except (msgspec.DecodeError, ShapespaceError):
                identities[name] = ""
        return identities

    def counts(self) -> Counter[str]:
        """Return status -> number of fits."""
        counts: Counter[str] = Counter()
        for rows in self.iter_rows(("status",)):
            counts.update(rows["status"])
        return counts

    def iter_rows(self, columns: Sequence[str], batch: int = BATCH) -> Iterator[dict[str, list[Any]]]:
        """Yield columns of all fits, some rows at a time: those of each shard in turn, then single files by name.

        Fits that cannot be read are excluded, and one sentence about each problem is added to `problems`.

        Args:
            columns: columns of the tables of a store, see `store.rows`; None for values that a fit does not state.
            batch: number of rows of single files at a time.
        """
        if self.store is not None:
            yield from self.store.iter_rows(columns, self.singles)
        names = list(self.singles)
        for first in range(0, len(names), batch):
            rows = [row for name in names[first : first + batch] if (row := self._row(name)) is not None]
            yield {column: [row.get(column) for row in rows] for column in columns}

    def column_names(self) -> set[str]:
        """Return the columns that some shard, or the first single record that can be read, has."""
        names: set[str] = set()
        for shard in self.store.shards if self.store else ():
            try:
                names |= shard.column_names()
            except ShapespaceError as error:
                self._add_problem(str(error))
        return names.union(*([next((row.keys() for name in self.singles if (row := self._row(name))), ())]))

    def to_dataframe(self, columns: Sequence[str] | None = None) -> Any:
        """Return the fits as a `pandas.DataFrame`, one row per fit, indexed and sorted by name.

        Args:
            columns: columns among `column_names`; None for those of coefficients.csv.

        Raises:
            InputError: no fit has such a column.
            ShapespaceError: pandas is not installed.
        """
        pandas = require_package("pandas", "Results.to_dataframe")
        available = self.column_names()
        if columns is None:
            known = sorted(column for column in available if column.startswith(META))
            columns = [head for head in coefficient_columns(modes_of(self), known) if head != CHECKSUM]
        elif unknown := [head for head in columns if head not in available]:
            raise InputError(
                f"{self.folder}: no fit has a column {unknown[0]!r}; column_names() lists the available ones."
            )
        requested = list(dict.fromkeys(["scan", *columns]))
        values: dict[str, list[Any]] = {column: [] for column in requested}
        for rows in self.iter_rows(requested):
            for column in requested:
                values[column] += rows[column]
        frame = pandas.DataFrame(values).set_index("scan").sort_index()
        numbers = [head for head in frame.columns if kind_of(head) in ("number", "count")]
        # Scans that could not be fitted have None in all columns, which pandas would store as objects.
        frame[numbers] = frame[numbers].astype("float64")
        return frame

    def to_xarray(self) -> Any:
        """Return the fits as an `xarray.Dataset`: `b` and `b_stddev` in mm and `z` by scan and mode, the rest by scan.

        Raises:
            ShapespaceError: xarray or pandas is not installed.
        """
        xarray = require_package("xarray", "Results.to_xarray")
        frame, modes = self.to_dataframe(), range(1, modes_of(self) + 1)
        of_modes = {
            "b": [f"b{k}" for k in modes], "z": [f"z{k}" for k in modes], "b_stddev": [f"b{k}_stddev" for k in modes]
        }  # fmt: skip
        other_columns = frame.drop(columns=[column for columns in of_modes.values() for column in columns])
        by_mode = {name: (("scan", "mode"), frame[columns].to_numpy()) for name, columns in of_modes.items()}
        by_scan = {name: ("scan", other_columns[name].to_numpy()) for name in other_columns.columns}
        return xarray.Dataset({**by_mode, **by_scan}, coords={"scan": list(frame.index), "mode": list(modes)})

    def _row(self, name: str) -> dict[str, Any] | None:
        try:
            return store_row(name, self.fit(name)) | {kind: kind in self.singles[name] for kind in FLAGS}
        except ShapespaceError as error:
            message = str(error)
        except (ValueError, OverflowError):
            message = f"{self.folder / f'{name}{ENDING}'} is damaged; fit the scan again."
        self._add_problem(message)
        return None

    def _add_problem(self, problem: str) -> None:
        if problem not in self.problems:
            self._problems.append(problem)

    def known(self, name: str) -> None:
        """Check that there is a fit of that name.

        Raises:
            InputError: there is no such fit; the message lists similar names.
        """
        if name not in self:
            suggestions = difflib.get_close_matches(name, [*self.singles, *self._stored], _NEAR, 0.6)
            hint = f"; there is {', '.join(suggestions)}" if suggestions else ""
            damage_note = "; some shards cannot be read" if self.problems else ""
            raise InputError(f"{self.folder} contains no fit called {name[:80]}{hint}{damage_note}.")


# Files of a store, by the names that they would have as single files


def split_file_name(file: str) -> tuple[str, str]:
    """Return the scan name and the kind of a result file: `record`, one of `ENDINGS`, or nothing."""
    for kind, ending in {"record": ENDING, **ENDINGS}.items():
        if file.endswith(ending) and file != ending:
            return file.removesuffix(ending), kind
    return file, ""


def results_at(folder: Path) -> Results | None:
    """Return the results in a folder with a store, kept open while nothing changes; None for other folders.

    Raises:
        FileError: the store cannot be read.
        FileFormatError: the manifest is damaged.
    """
    try:
        modified_ns = (folder / Manifest.FILE).stat().st_mtime_ns
        return _results_at(folder.resolve(), folder, modified_ns, folder.stat().st_mtime_ns)
    except OSError:
        return None if read_manifest(folder) is None else Results(folder)


@lru_cache(maxsize=_OPEN)
def _results_at(resolved: Path, folder: Path, modified_ns: int, _files_changed: int) -> Results | None:
    # Shards stay open if only single files were added.
    store = _store_at(resolved, folder, modified_ns)
    return None if store is None else Results(folder, store)


@lru_cache(maxsize=_OPEN)
def _store_at(_resolved: Path, folder: Path, _changed: int) -> ResultStore | None:
    manifest = read_manifest(folder)
    return None if manifest is None else ResultStore(folder, manifest)


def _stored_at(path: Path) -> tuple[Results, str, str] | None:
    """Return the store with the content of the file `path`, and its name and kind there; None if no store has it."""
    name, kind = split_file_name(path.name)
    if not kind or path.is_file() or (results := results_at(path.parent)) is None:
        return None
    is_there = name in results and (kind == "record" or results.has(name, kind))
    return (results, name, kind) if is_there else None


def has_written_landmarks(record: Path) -> bool:
    """Return whether the fit of `record` wrote landmark files; files of that name may be a user's own."""
    try:
        return b'"found_landmarks"' in read_bytes(record)
    except ShapespaceError:
        return False


def is_result(path: Path) -> bool:
    """Return whether `path` is a file, or a store in its folder contains the content of such a file."""
    return path.is_file() or _stored_at(path) is not None


def mesh_at(path: Path) -> Mesh:
    """Return the mesh in a file, or the surface of a store that replaces such a file.

    Raises:
        As `read_mesh`, and FileFormatError: the store is damaged.
    """
    if stored := _stored_at(path):
        results, name, kind = stored
        return results.surface(name, kind)
    return read_mesh(path)


def _stored_bytes(path: Path) -> bytes | None:
    """Return the record or stages of a store that replace a file; None if there is a file, or no store."""
    stored = _stored_at(path)
    if stored is None:
        return None
    results, name, kind = stored
    return results.stages(name) if kind == "stages" else results.record_bytes(name)


def json_at(path: Path, remedy: str, most_bytes: int = LARGEST_BYTES) -> Any:
    """Return the value in a JSON file, or in the record of a store that replaces such a file.

    Args:
        path: path of the file.
        remedy: advice for a file that is wrong, in messages.
        most_bytes: largest allowed size of the file, bytes.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is too large, or not plain JSON.
    """
    content = _stored_bytes(path)
    if content is None:
        return read_json(path, remedy, most_bytes)
    if len(content) > most_bytes:
        raise FileFormatError(f"{path} is larger ({len(content) / 2**20:.0f} MiB) than such a file can be; {remedy}.")
    return parse_json(content, path, remedy)


def arrays_at(path: Path, remedy: str) -> dict[str, npt.NDArray[Any]]:
    """Return the arrays of an .npz file, or of stages of a store that replace such a file, by name.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is damaged, or contains other data than arrays.
    """
    content = _stored_bytes(path)
    if content is None:
        return read_arrays(path, remedy)
    try:
        return arrays_in(io.BytesIO(content), len(content))
    except ValueError as error:
        raise FileFormatError(f"{path} is not an .npz file of arrays ({error}); {remedy}.") from error


def surfaces_of(results: Results) -> list[Path]:
    """Return the files that the surfaces of a store replace: the dense ones if there are any, else the fitted ones."""
    for kind in ("dense", "fitted"):
        if paths := [results.folder / f"{name}{ENDINGS[kind]}" for name in results.names() if results.has(name, kind)]:
            return paths
    return []


def modes_of(results: Results) -> int:
    """Return the largest number of coefficients that a fit has."""
    return max((int(name[1:]) for name in results.column_names() if re.fullmatch(r"z\d{1,5}", name)), default=0)
