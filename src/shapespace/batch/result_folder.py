"""A folder of results: names of results, the table of all records, and a lock for one writing run at a time."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections import Counter
from collections.abc import Container, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import msgspec
from filelock import lock_descriptor

from shapespace.batch.fit_records import coefficient_row, read_record, source_of, write_coefficients
from shapespace.errors import FileError, ShapespaceError
from shapespace.io.containers.json_files import LARGEST_BYTES, check_file
from shapespace.io.files import sha256_of_file, sweep, write_error
from shapespace.io.meshes.mesh_io import stem_of
from shapespace.schemas import FIT_AGAIN, File, FitRecord
from shapespace.store.results import results_at

LOCK = ".shapespace.lock"
"""File that exists while a run writes; the system keeps the lock, and releases it when the process ends."""


@contextlib.contextmanager
def only_writer(folder: Path) -> Generator[None]:
    """Keep other runs from writing into `folder` during the block, and remove partial files of killed runs.

    Raises:
        FileError: another run writes into it, or it cannot be written.
    """
    path = folder / LOCK
    try:
        descriptor = _open_lock(path)
    except OSError as error:
        raise write_error(path, error) from error
    try:
        sweep(folder)
        yield
    finally:
        sweep(folder)
        # Before the lock is released; only Windows cannot remove open files.
        if os.name == "nt":
            os.close(descriptor)
        with contextlib.suppress(OSError):
            path.unlink()
        if os.name != "nt":
            os.close(descriptor)


def _open_lock(path: Path) -> int:
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not lock_descriptor(descriptor, blocking=False):
                raise FileError(
                    f"{path.parent} is being written by another run of shapespace; wait for its end, or give another "
                    "folder."
                )
            if _is_open_as(path, descriptor):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_open_as(path: Path, descriptor: int) -> bool:
    """Return whether `path` is still the open file, and was not removed by the run that had the lock."""
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False


COEFFICIENTS = "coefficients.csv"
RECORD = ".fit.json"
_LONGEST_NAME = 200  # bytes; file systems allow 255, and endings such as .fit.json follow the name
_SCAN_COLUMNS = ("scan", "scan_name", "path", "scan_hash")


def records_in(folder: Path, without: Container[str] = ()) -> Iterator[tuple[str, FitRecord]]:
    """Yield NAME and record of each NAME.fit.json directly in `folder` that can be read, in order of the names."""
    for file in sorted(folder.glob(f"*{RECORD}")):
        if file.name.removesuffix(RECORD) in without:
            continue
        try:
            yield file.name.removesuffix(RECORD), read_record(file)
        except ShapespaceError:
            continue  # a report lists it


_Scan: TypeAlias = tuple[str, str]
"""Key of a scan: its file name, and its path as in records of the folder."""


def names_for(
    scans: Sequence[Path], folder: Path | None = None, addresses: Mapping[Path, str] | None = None
) -> list[str]:
    """Return NAME of the result files of each scan: its file name without its ending, if that is free.

    A scan with results in `folder` keeps their name. If scans share a name, with each other or with results of another
    scan, enough of their path is prepended to distinguish them. Names do not depend on the order of `scans`.

    Args:
        scans: paths of the scans; a path that is given twice has one name.
        folder: folder of the results; None if there are no results.
        addresses: addresses of remote scans, by their paths in `scans`.
    """
    sources = dict(_sources_in(folder)) if folder is not None else {}
    taken: dict[str, _Scan] = {name: (source.name, source.path) for name, source in sources.items()}
    own = {scan: name for name, scan in reversed(taken.items())}
    keys = {scan: _key(scan, folder, (addresses or {}).get(scan, "")) for scan in scans}
    names = {key: own[key] for key in keys.values() if key in own}
    groups: dict[str, dict[_Scan, Path]] = {}
    for scan, key in keys.items():
        if key not in names:
            groups.setdefault(_stem(scan).casefold(), {})[key] = scan
    used = {name.casefold() for name in (*taken, *names.values())}
    # Unique names are assigned first, so that no scan loses its name.
    for _, group in sorted(groups.items(), key=lambda item: (len(item[1]) > 1, item[0])):
        (key, scan), *others = group.items()
        stem = _stem(scan)
        if not others and (stem.casefold() not in used or _is_same(scan, sources.get(stem), folder)):
            new = {key: stem}
        else:
            new = _distinct_names(group, used)
        names |= new
        used |= {name.casefold() for name in new.values()}
    return [names[keys[scan]] for scan in scans]


def _sources_in(folder: Path) -> Iterator[tuple[str, File]]:
    """Yield NAME of each result in `folder` or its store, and the reference to the scan in its record."""
    if (results := results_at(folder)) is not None:
        for rows in results.iter_rows(_SCAN_COLUMNS):
            for name, scan_name, path, content_hash in zip(*(rows[column] for column in _SCAN_COLUMNS), strict=True):
                yield name, File(name=scan_name or "", path=path or "", hash=content_hash or "")
    else:
        for file in sorted(folder.glob(f"*{RECORD}")):
            with contextlib.suppress(ShapespaceError, msgspec.MsgspecError, ValueError):  # a report lists it
                check_file(file, LARGEST_BYTES, FIT_AGAIN)
                yield file.name.removesuffix(RECORD), msgspec.json.decode(file.read_bytes(), type=_ScanOnly).scan


class _ScanOnly(msgspec.Struct, frozen=True):
    """Reference to the scan in a record; decoding only this part is twenty times as fast."""

    scan: File = File()


def _key(scan: Path, folder: Path | None, address: str) -> _Scan:
    if address:
        return scan.name, address
    if folder is None:
        return scan.name, str(scan.parent.resolve())
    return scan.name, source_of(scan, "", folder).path


def _stem(scan: Path) -> str:
    return _shorten(stem_of(scan) or scan.name)


def _is_same(scan: Path, source: File | None, folder: Path | None) -> bool:
    """Return whether results of the same name belong to `scan` at another path, or do not name their scan."""
    if source is None or folder is None:
        return False
    if not source.path:
        return source.name == scan.name
    try:
        return not (folder / source.path).exists() and sha256_of_file(scan) == source.hash
    except FileError:
        return False


def _distinct_names(group: Mapping[_Scan, Path], used: set[str]) -> dict[_Scan, str]:
    folders = {key: scan.parent.resolve().parts[1:] for key, scan in group.items()}
    ends = {key: stem_of(scan) or scan.name for key, scan in group.items()}
    if len({(folders[key], end) for key, end in ends.items()}) < len(group):
        ends = {key: scan.name for key, scan in group.items()}
    for depth in range(1, 1 + max(map(len, folders.values()))):
        names = {key: "_".join((*folders[key][-depth:], ends[key])) for key in group}
        counts = Counter(name.casefold() for name in names.values())
        short = all(len(os.fsencode(name)) <= _LONGEST_NAME for name in names.values())
        if short and max(counts.values()) == 1 and not counts.keys() & used:
            return names
    return {
        key: f"{_shorten(stem_of(scan), 180)}_{hashlib.sha256(os.fsencode(scan.resolve())).hexdigest()[:12]}"
        for key, scan in group.items()
    }


def _shorten(stem: str, most: int = _LONGEST_NAME) -> str:
    # File names are limited to 255 bytes, including the endings of the results.
    content = os.fsencode(stem)
    return stem if len(content) <= most else content[:most].decode("utf-8", "ignore")


class CoefficientTable:
    """coefficients.csv of a folder: a row for each record, those of this run last.

    Records of this run are added by `add` and `catch_up`; the others are read at the start.

    Args:
        folder: folder of the results.
        names: names of the results of this run, in order.
        n_modes: number of modes of the model; the table has at least as many coefficients as the largest record.
    """

    def __init__(self, folder: Path, names: Sequence[str], n_modes: int) -> None:
        self._folder = folder
        self._names = tuple(dict.fromkeys(names))
        self._n_modes = n_modes
        self._rows: dict[str, dict[str, Any]] = {}
        of_this_run = set(self._names)
        for name, record in records_in(folder, without=of_this_run):
            self._add_earlier(name, record)

    def add(self, name: str, record: FitRecord) -> None:
        """Add the row of a record, which replaces an earlier row of that name."""
        self._rows[name] = coefficient_row(name, record)
        self._n_modes = max(self._n_modes, len(record.b))

    def catch_up(self, names: Sequence[str]) -> None:
        """Add the existing records of `names`, of earlier runs or written by workers that were stopped."""
        for name in names:
            with contextlib.suppress(ShapespaceError):  # never written
                self._add_earlier(name, read_record(self._folder / f"{name}{RECORD}"))

    def save(self) -> None:
        """Write the table.

        Raises:
            FileError: the folder cannot be written, or the disk is full.
        """
        others = [row for name, row in self._rows.items() if name not in self._names]
        rows = [*others, *(self._rows[name] for name in self._names if name in self._rows)]
        write_coefficients(self._folder / COEFFICIENTS, rows, self._n_modes)

    def _add_earlier(self, name: str, record: FitRecord) -> None:
        try:
            self.add(name, record)
        except ValueError:
            self._rows.pop(name, None)  # damaged; a report lists it
