"""Inputs of commands: scans in files, folders, patterns, addresses and lists, and landmarks named as the scans."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from shapespace.batch.fit_work import FitJob, naming
from shapespace.batch.progress import progress
from shapespace.batch.result_folder import RECORD
from shapespace.cohort.table import fold_name, refuse_repeated
from shapespace.errors import FileError, InputError, MeshError, ShapespaceError
from shapespace.geometry.normals import without_estimates
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import read_bytes
from shapespace.io.landmarks.landmark_io import FIDUCIAL_ENDINGS, LANDMARK_FORMATS, READ_ONLY_LANDMARKS, read_landmarks
from shapespace.io.meshes.mesh_io import MESH_FILE_ENDINGS, mesh_files, stem_of
from shapespace.io.remote import addresses, is_address
from shapespace.io.tables.table_io import decoded_text, key_column, table_rows
from shapespace.reprs import first_names
from shapespace.store.corresponding import SurfaceFiles
from shapespace.types import MM_PER_UNIT, Mesh

TABLE_ENDINGS = (".csv", ".tsv", ".xlsx")
"""Endings of lists of scans that are tables, which may name landmarks."""
_LISTS = (*TABLE_ENDINGS, ".txt")
_PLACES = ("scan", "file", "path", "specimen", "name", "id")
_LANDMARKS, _ID = "landmarks", "id"
PART = "part"
"""Column of a list with the part of its specimen that each scan shows."""
_SPECIMENS = ("specimen", "subject", "name")
"""Columns of such a list that may name the specimens."""
_LARGEST_BYTES = 2**26
"""Largest size of a list of scans in bytes; a million rows need less."""
_FILES_LISTED = 5  # names of files in a message, so that it stays short
_LONGEST = 200  # bytes of an id; file systems allow 255, and endings follow it


@dataclass(frozen=True)
class Given:
    """A scan as it was given.

    Args:
        source: path of the scan, or its address.
        called: name in the column `id` of a list, or empty.
        metadata: the other columns of the list.
        landmarks: landmark file in the column `landmarks` of the list; None if there is none.
        parts: path of the scan of each part, if there are several; `source` then only names the specimen.
    """

    source: Path | str
    called: str = ""
    metadata: dict[str, str] = field(default_factory=dict[str, str])
    landmarks: Path | None = None
    parts: dict[str, Path] = field(default_factory=dict[str, Path])

    @property
    def address(self) -> str:
        """Address of a remote scan; empty for a local one."""
        return self.source if isinstance(self.source, str) else ""

    def column(self, *names: str) -> str:
        """Return the value in the first of the columns `names` that the list has, in any case; empty without any."""
        values = {name.casefold(): value.strip() for name, value in self.metadata.items()}
        return next((values[name] for name in names if values.get(name)), "")

    @property
    def path(self) -> Path:
        """Path of the scan; for a remote scan, a path made of its address, from which it is named."""
        if isinstance(self.source, Path):
            return self.source
        head = self.source.split("::", 1)[0].partition("?")[0]
        return Path("/", *(part for part in head.replace("://", "/").split("/") if part not in ("", ".", "..")))


def given_scans(
    scans: Sequence[str | Path], folder: Path, *, recursive: bool, say: Callable[[str], None]
) -> list[Given]:
    """Return the scans that `scans` stand for.

    Args:
        scans: paths of scans and of folders, patterns, addresses, and lists: a text file with one of these in a line,
            or a table that `io.tables.table_rows` reads, with a column `scan`, `file`, `path`, `specimen`, `name` or
            `id`, perhaps `id` and `landmarks` as well, and others that are kept.
        folder: folder of the results, which is not searched.
        recursive: whether to search subfolders too.
        say: called with each message on skipped files.

    Raises:
        InputError: there are no scans, or a list is invalid.
        FileError: a folder, a list or an address cannot be read.
    """
    rows: list[Given] = []
    for item in scans:
        text = str(item)
        if not is_address(text) and text.lower().endswith(_LISTS) and Path(text).is_file():
            for row in _read_rows(Path(text)):
                there = _expand_source(row.source, folder, recursive=recursive, say=say)
                if row.called and len(there) > 1:
                    raise InputError(f"{text}: {row.called} stands for {len(there)} scans; give a row for each.")
                if row.landmarks is not None and len(there) > 1:
                    raise InputError(f"{text}: the landmarks {row.landmarks} cannot be those of {len(there)} scans.")
                rows += [replace(row, source=source) for source in there]
        else:
            rows += [Given(source) for source in _expand_source(text, folder, recursive=recursive, say=say)]
    _check_ids(rows)
    return rows


def with_ids(jobs: Sequence[FitJob], given: Sequence[Given]) -> list[FitJob]:
    """Return `jobs` named by the ids of their scans, if these have ids, with the metadata of the scans.

    Raises:
        InputError: two scans would have the same name.
    """
    named = [
        replace(job, name=scan.called or job.name, metadata=scan.metadata)
        for job, scan in zip(jobs, given, strict=True)
    ]
    seen: dict[str, FitJob] = {}
    for job in named:
        if seen.setdefault(job.name.casefold(), job).label != job.label:
            raise InputError(
                f"{seen[job.name.casefold()].label} and {job.label} would both be named {job.name}; give each an id."
            )
    return named


def _expand_source(
    text: str | Path, folder: Path, *, recursive: bool, say: Callable[[str], None]
) -> Sequence[Path | str]:
    if isinstance(text, str) and is_address(text):
        return addresses(text, MESH_FILE_ENDINGS, recursive=recursive)
    path = Path(text)
    if glob.has_magic(str(path)) and not path.exists():
        matched = sorted(Path(path.anchor).glob(str(path.relative_to(path.anchor))))
        if not matched:
            raise InputError(f"No file matches {path}; check the pattern.")
        # A pattern that ends in an ending names scans; another one may take what is none.
        files = [file for file in matched if file.is_dir() or file.name.lower().endswith(MESH_FILE_ENDINGS)]
        paths = files or matched
    else:
        if not path.name.lower().endswith(MESH_FILE_ENDINGS) and not os.path.lexists(path):
            raise FileError(f"Cannot read {path}: there is no such file or folder; check the name.")
        paths = [path]
    listed = mesh_files(paths, recursive=recursive, apart_from=folder)
    for sentence in listed.left_out:
        say(sentence)
    return listed.files


def _read_rows(file: Path) -> list[Given]:
    """Return the rows of a list, with places relative to its folder."""
    check_file(file, _LARGEST_BYTES, "give a smaller list")
    try:
        content = read_bytes(file)
        if file.suffix.lower() == ".txt":
            lines = [line.strip() for line in decoded_text(content).splitlines()]
            rows = [Given(_relative_to(file, line)) for line in lines if line and not line.startswith("#")]
        else:
            rows = _read_table(file, content)
    except ShapespaceError:
        raise
    except ValueError as error:
        raise InputError(f"{file} {error}; save it as a CSV table or an Excel workbook.") from error
    if not rows:
        raise InputError(f"{file} lists no scans; write one in a line.")
    return rows


def _read_table(file: Path, content: bytes) -> list[Given]:
    """Return the rows of a table of scans.

    Raises:
        InputError: it has no column for the scans, or a row without one or with an id that no file can have.
        ValueError: it is no table; the message is a clause on the fault.
    """
    lines = table_rows(content)
    header = next(lines)
    column, called_by, marks_by = (key_column(header, names) for names in (_PLACES, (_ID,), (_LANDMARKS,)))
    if column is None:
        raise InputError(f"{file} needs a column named {' or '.join(_PLACES)}; it has {', '.join(header)}.")
    own = {column, called_by, marks_by}
    rows: list[Given] = []
    names: list[str] = []
    for number, line in enumerate(lines, 2):
        cells = [cell.strip() for cell in line]
        if any("\0" in cell for cell in cells):
            raise ValueError("is not a table but binary")
        source, marks = cells[column], "" if marks_by is None else cells[marks_by]
        called = "" if called_by is None or called_by == column else cells[called_by]
        if not source:
            raise InputError(f"{file}: row {number} names no scan in the column {header[column]}.")
        if called and (called.startswith(".") or len(called.encode()) > _LONGEST or set(called) & set('/\\:*?"<>|\0')):
            raise InputError(f"{file}: row {number} has an id that no file can have, {called[:40]!r}; change it.")
        names.append(called or source)
        known = {head: cells[index] for index, head in enumerate(header) if head and index not in own}
        rows.append(Given(_scan_source(file, source), called, known, file.parent / marks if marks else None))
    refuse_repeated(file, names, [(fold_name(row.called), row.source) for row in rows])
    return rows


def _scan_source(file: Path, text: str) -> Path | str:
    """Return the place of a scan, which may be named without its ending if one mesh file has that name."""
    source = _relative_to(file, text)
    if isinstance(source, str) or source.name.lower().endswith(MESH_FILE_ENDINGS) or glob.has_magic(text):
        return source
    try:
        there = [match for match in sorted(source.parent.glob(f"{source.name}.*")) if stem_of(match) == source.name]
        meshes = [match for match in there if match.name.lower().endswith(MESH_FILE_ENDINGS)]
        return meshes[0] if len(meshes) == 1 and not source.exists() else source
    except (OSError, ValueError):
        return source  # the reader of the scans reports such a name


def _relative_to(file: Path, text: str) -> Path | str:
    return text if is_address(text) else file.parent / text


def _check_ids(scans: Sequence[Given]) -> None:
    named: dict[tuple[str, str], Given] = {}
    for scan in scans:
        key = (scan.called.casefold(), scan.column(PART).casefold())
        if scan.called and named.setdefault(key, scan).source != scan.source:
            raise InputError(f"Two scans have the id {scan.called}; give each one of its own.")


def is_of_fit(file: Path, endings: Sequence[str]) -> bool:
    """Return whether a fit wrote `file`, which has one of `endings` and lies next to its record."""
    names = [file.name.removesuffix(ending) for ending in endings if file.name.endswith(ending)]
    return any(file.with_name(f"{name}{RECORD}").is_file() for name in names)


def scans_of_parts(scans: Sequence[Given], parts: Sequence[str]) -> dict[str, list[Given]]:
    """Return the scans of each part, named after their specimens; others are omitted.

    The part of a scan is in the column `part` of a list; otherwise it is the name of its folder, or the end of its file
    name after `_`, `-` or `.`, as in anna_femur.ply. Its specimen is in the column `id`, `specimen`, `subject` or
    `name`; otherwise it is the rest of the file name. Upper and lower case are equal.

    Raises:
        InputError: a specimen has two scans of a part.
    """
    found: dict[str, list[Given]] = {part: [] for part in parts}
    for scan in scans:
        stem, own = stem_of(scan.path), scan.column(PART).casefold()
        for part, there in found.items():
            name = part.casefold()
            is_end = stem.casefold().endswith(tuple(f"{separator}{name}" for separator in "_-."))
            if own == name or (not own and (is_end or scan.path.parent.name.casefold() == name)):
                specimen = scan.called or scan.column(*_SPECIMENS) or (stem[: -len(part) - 1] if is_end else stem)
                if other := next(
                    (earlier for earlier in there if earlier.called.casefold() == specimen.casefold()), None
                ):
                    raise InputError(
                        f"{other.source} and {scan.source} are both the {part} of {specimen}; omit or rename one."
                    )
                there.append(replace(scan, called=specimen))
                break
    return found


def expand_part_folders(scans: Sequence[str | Path], parts: Sequence[str]) -> list[str | Path]:
    """Return `scans` with each folder that contains folders of the parts replaced by these folders."""
    expanded: list[str | Path] = []
    for scan in scans:
        folders = [Path(scan) / part for part in parts if (Path(scan) / part).is_dir()]
        expanded += folders or [scan]
    return expanded


def join_specimens(scans: Sequence[Given], parts: Sequence[str]) -> list[Given]:
    """Return `scans`, with local scans of several parts of a specimen as one, and those of one part named after both.

    Raises:
        InputError: a specimen has two scans of a part, or two landmark files.
    """
    local = {scan.source: scan for scan in scans if parts and not scan.address}
    specimens: dict[str, dict[str, Given]] = {}
    for part, found in scans_of_parts(list(local.values()), parts).items():
        for scan in found:
            specimens.setdefault(scan.called.casefold(), {})[part] = scan
    joined = [
        scan for scan in scans if scan.source not in {s.source for own in specimens.values() for s in own.values()}
    ]
    for own in specimens.values():
        first, marks = next(iter(own.values())), {scan.landmarks for scan in own.values()} - {None}
        if len(marks) > 1:
            raise InputError(f"{first.called}: its parts have several files of landmarks; give one with all landmarks.")
        if len(own) > 1:
            first = replace(
                first, source=first.path.with_name(first.called), landmarks=next(iter(marks), None),
                metadata={name: value for name, value in first.metadata.items() if name.casefold() != PART},
                parts={part: scan.path for part, scan in own.items()},
            )  # fmt: skip
        elif not first.called.casefold().endswith(next(iter(own)).casefold()):
            first = replace(first, called=f"{first.called}_{next(iter(own))}")
        joined.append(first)
    return joined


@dataclass(frozen=True)
class LandmarkFiles:
    """The landmark files of a folder.

    Args:
        folder: folder of the files; None without files.
        files: name of a scan without its ending -> file.
        used: names that a scan had.
        unread: messages on files that cannot be used.
        duplicates: name of a scan -> further files with its landmarks.
    """

    folder: Path | None
    files: dict[str, Path] = field(default_factory=dict[str, Path])
    used: set[str] = field(default_factory=set[str])
    unread: list[str] = field(default_factory=list[str])
    duplicates: dict[str, list[Path]] = field(default_factory=dict[str, list[Path]])

    @staticmethod
    def of(folder: Path | None) -> LandmarkFiles:
        """Return the landmark files in `folder`.

        Raises:
            FileError: it is no folder, or contains no such file.
        """
        if folder is None:
            return LandmarkFiles(None)
        if not folder.is_dir():
            raise FileError(f"{folder} is no folder; give one with landmarks in files named as the scans.")
        endings = sorted([*LANDMARK_FORMATS, *READ_ONLY_LANDMARKS], key=len, reverse=True)
        files: dict[str, Path] = {}
        unread: list[str] = []
        duplicates: dict[str, list[Path]] = {}
        for file in sorted(folder.iterdir()):
            ending = next((suffix for suffix in endings if file.name.lower().endswith(suffix)), None)
            if ending is None or not file.is_file() or is_of_fit(file, FIDUCIAL_ENDINGS):
                continue
            first = files.setdefault(file.name[: -len(ending)], file)
            if first is not file:
                duplicates.setdefault(file.name[: -len(ending)], []).append(file)
                unread.append(f"{file.name} is not read, since {first.name} has landmarks of the same scan.")
        if not files:
            raise FileError(f"{folder} contains no landmarks; they are read from files with {', '.join(endings)}.")
        return LandmarkFiles(folder, files, unread=unread, duplicates=duplicates)

    def check_not_shared(self, scans: Sequence[Path]) -> None:
        """Raise InputError if two of `scans`, of one name in different folders, would take the same landmarks."""
        owner: dict[str, Path] = {}
        for path in scans:
            name = stem_of(path)
            if name in self.files and owner.setdefault(name, path) != path:
                raise InputError(
                    f"{owner[name]} and {path} would both take the landmarks in {self.files[name]}; rename one of the "
                    "scans."
                )

    def of_scan(self, scan: Path) -> Path | None:
        """Return the file with the landmarks of `scan`, None if there is none."""
        file = self.files.get(stem_of(scan))
        if file is not None:
            self.used.add(stem_of(scan))
        return file

    def onto(self, mesh: Mesh, path: Path, own: Path | None = None) -> Mesh:
        """Return `mesh`, read from `path`, with the landmarks in the file `own`, or those of the folder for it."""
        file = own or self.of_scan(path)
        if file is None:
            return mesh
        try:
            return replace(mesh, landmarks=read_landmarks(file))
        except ShapespaceError as error:
            self.unread.append(f"{path.name} is used without landmarks: {error}")
            return mesh

    def report_unused(self, say: Callable[[str], None]) -> None:
        """Print the files that belong to no scan.

        Raises:
            InputError: all files belong to none.
        """
        if self.folder is None:
            return
        if not self.used:
            names = ", ".join(file.name for file in list(self.files.values())[:_FILES_LISTED])
            raise InputError(
                f"No file of landmarks in {self.folder} ({names}) is named as one of the scans; name them alike, "
                "such as anna.ply and anna.csv."
            )
        for sentence in self.unread:
            say(sentence)
        if left := sorted(set(self.files) - self.used):
            say(f"{len(left)} files of landmarks belong to no scan that is given: {first_names(left, _FILES_LISTED)}.")


@dataclass(frozen=True)
class SurfacesOnDisk:
    """Meshes in correspondence, in mm, on one side, without estimates, each read when it is asked for.

    Args:
        files: files of the meshes.
        listed: reader of the files.
        unit: unit of most meshes.
        without_vertices: end of the message on a mesh without vertices.
    """

    files: Sequence[Path]
    listed: SurfaceFiles
    unit: str = "mm"
    without_vertices: str = "; omit it"

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int, /) -> Mesh:
        file, mm = self.files[index], MM_PER_UNIT[self.unit]
        try:
            mesh = without_estimates(self.listed.mesh(file))
        except MeshError as error:
            raise MeshError(naming(file, str(error))) from error
        if not len(mesh.vertices):
            raise MeshError(f"{file}: it has no vertices{self.without_vertices}.")
        return mesh if mm == 1.0 else mesh.with_vertices(mesh.vertices * mm)

    def read(self, *, quiet: bool) -> list[Mesh]:
        """Return all meshes.

        Raises:
            FileError: one cannot be read.
            MeshError: one is damaged, or has no vertices.
        """
        with progress(len(self), "reading", "mesh", quiet=quiet) as bar:
            meshes: list[Mesh] = []
            for index in range(len(self)):
                meshes.append(self[index])
                bar.update()
        return meshes
