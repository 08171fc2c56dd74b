"""A project of the studio: its specimens, their table, landmarks, and their edits."""

from __future__ import annotations

import csv
import filecmp
import hashlib
import io
import json
import re
import threading
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import count
from math import isfinite
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias, TypeVar, cast

import numpy as np
from msgspec import Struct, to_builtins
from msgspec.structs import replace

from shapespace.batch.result_folder import names_for
from shapespace.cohort.orientation import view_rotation
from shapespace.cohort.table import (
    fold_name,
    is_number,
    match_rows,
    name_key,
    names_of_file,
    notes_on_classes,
    read_table,
)
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import atomic_path, make_folder, write_error, write_text
from shapespace.io.landmarks.landmark_configurations import resample_polyline
from shapespace.io.landmarks.landmark_io import read_surface_landmarks, surface_landmarks_text
from shapespace.io.meshes.mesh_io import MESH_FILE_ENDINGS, mesh_files, stem_of
from shapespace.io.tables.table_io import DECIMAL_COMMA, KEYS, MISSING, key_column, table_text
from shapespace.io.volume_io import VOLUME_ENDINGS
from shapespace.schemas import NamedView, Orientation, read
from shapespace.statistics.sides import pairs_by_name
from shapespace.store.corresponding import LANDMARKS
from shapespace.types import MM_PER_UNIT, SurfaceLandmarks

Role = Literal["training", "new"]
Point: TypeAlias = tuple[float, float, float]
_Made = TypeVar("_Made")

_AGAIN = "restore it from a copy, or start a new project"
_PART = "part"
"""Column of a list of scans that names the structure on each scan."""
_MOST_CLASSES = 12  # classes of a column that the page counts
LANDMARK_COLUMN = "landmarks"
"""Column of a list of scans that names their files of landmarks."""
LEAST_LANDMARKS = 3
"""Landmarks that determine a pose."""
MOST_POINTS = 500
"""Largest number of names of landmarks, which the page lists for each scan."""
_LONGEST_NAME = 60  # characters of the name of a landmark
_MOST_UNDONE = 100  # edits that can be undone
_MOST_MADE = 32  # tables and landmarks that are cached: jobs read those of few sets of specimens
_BEGINNING, _MOST_HASHES = 2**14, 2**15  # bytes of a file that are hashed, and hashes in memory
_LONGEST_ID, _LONGEST_CELL = 100, 1000  # characters
_NO_FILE_NAME = re.compile(r'[/\\:*?"<>|\x00-\x1f]')
STALE = "Another tab changed the project; look at it and do it again."


class Specimen(Struct, frozen=True, kw_only=True):
    """A specimen.

    Args:
        id: name of the specimen, which names the files of its results.
        file: path of the scan, relative to the project's folder if it lies there.
        role: `training` for specimens that models are built from, `new` for others.
        included: whether the specimen is used.
        unit: unit of the scan, a name of `MM_PER_UNIT`; empty if commands read the scan as it is.
        mirrored: whether its mirror image is used.
        original: path of the scan before it was groomed, like `file`; empty if it was not groomed.
        part: structure that the scan shows, such as femur; empty if specimens have one scan each.
        subject: id of the specimen whose further part this is; empty for specimens that have rows in tables.
        cells: column -> cell of the specimen.
        points: name -> landmark on the scan, in the frame and unit of its file.
    """

    id: str
    file: str
    role: Role = "training"
    included: bool = True
    unit: str = ""
    mirrored: bool = False
    original: str = ""
    part: str = ""
    subject: str = ""
    cells: dict[str, str] = {}
    points: dict[str, Point] = {}

    def read_points(self) -> dict[str, Point]:
        """Return the landmarks on the scan that commands read: in mm if it has a unit, and reflected if mirrored."""
        mm = MM_PER_UNIT[self.unit] if self.unit else 1.0
        x_mm = -mm if self.mirrored else mm
        return {name: (x_mm * x, mm * y, mm * z) for name, (x, y, z) in self.points.items()}


class ScanCurve(Struct, frozen=True):
    """A curve on the scans, whose points are landmarks called NAME_1, NAME_2 and so on, which slide.

    Args:
        points: number of points.
        closed: whether the first point follows the last.
    """

    points: int
    closed: bool = False

    def names(self, name: str) -> tuple[str, ...]:
        """Return the names of the points of the curve called `name`."""
        return tuple(f"{name}_{k}" for k in range(1, self.points + 1))

    def spaced(self, points: Sequence[Point]) -> list[Point]:
        """Return the points of the curve at equal distances along others in their order, two or more."""
        spaced = resample_polyline(np.array(points), self.points, self.closed)
        return [point_of(point) for point in spaced.tolist()]


class State(Struct, frozen=True, kw_only=True):
    """Content of `project.json`.

    Args:
        name: name of the project.
        columns: columns of the table, except the id.
        specimens: specimens in the order in which they were added.
        parts: names of the parts of specimens, the reference of relative poses first; empty for one scan per specimen.
        point_names: names of the landmarks on scans, in their order in files.
        curves: name -> curve whose points are among these landmarks.
        pairs: pairs of names of landmarks that mirror each other; None for those that their names show.
        landmarks: name -> vertex of the surfaces in correspondence.
        landmarks_on: folder of these surfaces in the project.
        views: folder of surfaces -> named views in the frame of their mean shape; those of the key "" are in the frames
            of the scans' files, which may differ.
    """

    FORMAT: ClassVar[str] = "shapespace-project"

    format: str = FORMAT
    format_version: int = 1
    name: str
    columns: tuple[str, ...] = ()
    specimens: tuple[Specimen, ...] = ()
    parts: tuple[str, ...] = ()
    point_names: tuple[str, ...] = ()
    curves: dict[str, ScanCurve] = {}
    pairs: tuple[tuple[str, str], ...] | None = None
    landmarks: dict[str, int] = {}
    landmarks_on: str = ""
    views: dict[str, tuple[NamedView, ...]] = {}

    @property
    def names(self) -> list[tuple[str, ...]]:
        """The names by which a table can refer to each specimen: its id, and names of its file."""
        return [(specimen.id, *names_of_file(Path(specimen.file).name)) for specimen in self.specimens]

    @property
    def curve_points(self) -> frozenset[str]:
        """The names of the landmarks that are points of curves."""
        return frozenset(point for name, curve in self.curves.items() for point in curve.names(name))

    @property
    def mirrored_pairs(self) -> tuple[tuple[str, str], ...]:
        """The pairs of landmarks that mirror each other: those that the user chose, or that the names show."""
        found = pairs_by_name(self.point_names) if self.pairs is None else self.pairs
        counts = {point: curve.points for name, curve in self.curves.items() for point in curve.names(name)}
        named = (pair for pair in found if {*pair} <= {*self.point_names})
        return tuple(pair for pair in named if counts.get(pair[0]) == counts.get(pair[1]))

    def chosen(self, role: Role, *, with_parts: bool = True) -> tuple[Specimen, ...]:
        """Return the included specimens of a role by name: the order in which they were added differs between drops.

        Args:
            role: role of the specimens.
            with_parts: whether the further parts of specimens are among them.
        """
        of_role = self.specimens if with_parts else self.rows
        chosen = (specimen for specimen in of_role if specimen.included and specimen.role == role)
        return tuple(sorted(chosen, key=lambda specimen: name_key(specimen.id)))

    @property
    def rows(self) -> tuple[Specimen, ...]:
        """The specimens that have rows in tables: the first part of each."""
        return tuple(specimen for specimen in self.specimens if not specimen.subject)

    def with_parts(self, ids: Iterable[str]) -> set[str]:
        """Return the ids of specimens, and those of their further parts."""
        return {*ids}.union(specimen.id for specimen in self.specimens if specimen.subject in {*ids})

    def notes(self) -> list[str]:
        """Return sentences on classes of the table that may be misspelt."""
        cells = {column: [specimen.cells.get(column, "") for specimen in self.rows] for column in self.columns}
        notes = [note for column in self.columns for note in notes_on_classes(column, cells[column])]
        return [note for note in notes if not note.startswith("Shapes in each class")]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the number of included specimens of each class, of columns with few classes that specimens share."""
        counts, rows = dict[str, dict[str, int]](), self.rows
        for column in self.columns:
            of_all = Counter(specimen.cells.get(column, "") for specimen in rows)
            if len(of_all) <= _MOST_CLASSES and any(name and count > 1 for name, count in of_all.items()):
                used = Counter(specimen.cells.get(column, "") for specimen in rows if specimen.included)
                counts[column] = {name: used[name] for name in of_all}
        return counts


class Project:
    """A project in a folder: the owner of its state, which is written with every edit.

    Args:
        folder: folder with `project.json`.
        state: state of the project.
    """

    FILE = "project.json"

    def __init__(self, folder: Path, state: State) -> None:
        self.folder = folder
        self.state = state
        self.revision = 0
        self._undo: list[tuple[str, State]] = []
        self._redo: list[tuple[str, State]] = []
        self._made: list[tuple[tuple[object, ...], Any]] = []
        self._lock = threading.RLock()

    @staticmethod
    def open(folder: Path, *, create: bool = False) -> Project:
        """Open the project in a folder, or create one in an empty or new folder.

        Raises:
            FileError: there is no project, or the folder cannot be read or written.
            FileFormatError: `project.json` is damaged, or of a later version.
            InputError: a project is to be created in a folder with other files.
        """
        folder = folder.resolve()
        path = folder / Project.FILE
        if path.is_file():
            content: Any = read_json(path, _AGAIN)
            if not isinstance(content, dict) or content.get("format") != State.FORMAT:
                raise FileFormatError(f"{path} is not a project of the studio; give another folder.")
            if content.get("format_version") != 1:
                raise FileFormatError(f"{path} was written by a later version of shapespace; update shapespace.")
            return Project(folder, read(State, cast(object, content), str(path), _AGAIN))
        if not create:
            raise FileError(f"{folder} contains no project; create one there, or give the folder of a project.")
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"{folder} is not empty; give a new folder for the project.")
        make_folder(folder / "scans")
        project = Project(folder, State(name=folder.name))
        project._write()
        return project

    @property
    def undo_text(self) -> str | None:
        """Description of the edit that an undo would revert."""
        return self._undo[-1][0] if self._undo else None

    @property
    def redo_text(self) -> str | None:
        """Description of the edit that was undone last."""
        return self._redo[-1][0] if self._redo else None

    def path(self, specimen: Specimen) -> Path:
        """Return the path of a scan."""
        return self.folder / specimen.file

    def edit(self, revision: int | None, change: Callable[[State], tuple[str, State]], *, together: str = "") -> None:
        """Apply an edit, which can be undone.

        Args:
            revision: revision of the state that the user saw; None for edits that any state allows.
            change: function that returns a description of the edit and the new state.
            together: text of consecutive edits that are undone together.

        Raises:
            InputError: another edit came in between, or `change` rejects it.
            FileError: it cannot be written; the state stays as it was.
        """
        with self._lock:
            self._check(revision)
            text, state = change(self.state)
            before = self.state
            self._replace(state)
            if not together or not self._undo or self._undo[-1][0] != together:
                self._undo = [*self._undo[-_MOST_UNDONE + 1 :], (together or text, before)]
            self._redo = []

    def exclude(self, file: Path) -> None:
        """Exclude a scan that cannot be used, also in the states that an undo brings back.

        This is no edit of the user's: the revision does not change, so that the user's next edit is accepted.

        Raises:
            FileError: it cannot be written.
        """

        def without(state: State) -> State:
            specimens = (
                replace(specimen, included=False) if self.path(specimen) == file else specimen
                for specimen in state.specimens
            )
            return replace(state, specimens=tuple(specimens))

        with self._lock:
            self._replace(without(self.state), is_edit=False)
            self._undo = [(text, without(state)) for text, state in self._undo]
            self._redo = [(text, without(state)) for text, state in self._redo]

    def undo(self, revision: int) -> None:
        """Take the last edit back; nothing happens without one."""
        self._step(revision, self._undo, self._redo)

    def redo(self, revision: int) -> None:
        """Apply the edit that was undone last."""
        self._step(revision, self._redo, self._undo)

    def _step(self, revision: int, source: list[tuple[str, State]], other: list[tuple[str, State]]) -> None:
        with self._lock:
            self._check(revision)
            if source:
                text, state = source[-1]
                other.append((text, self.state))
                self._replace(state)
                source.pop()

    def _check(self, revision: int | None) -> None:
        if revision is not None and revision != self.revision:
            raise StaleError(STALE)

    def _replace(self, state: State, *, is_edit: bool = True) -> None:
        before, self.state = self.state, state
        try:
            self._write()
        except BaseException:
            self.state = before
            raise
        self.revision += is_edit

    def _write(self) -> None:
        # Each specimen on a line of its own; with indentation it would take four times as long.
        text = json.dumps(to_builtins(self.state), allow_nan=False).replace('{"id": ', '\n{"id": ')
        write_text(self.folder / self.FILE, text + "\n")

    # Scans

    def new_file(self, name: str) -> Path:
        """Return the path of a new empty file in the project for a scan that is uploaded as `name`.

        Raises:
            FileError: it cannot be created.
        """
        stem, ending = _stem(name), _ending(name)
        with self._lock:
            taken = {path.name.casefold() for path in (self.folder / "scans").glob("*")}
            path = make_folder(self.folder / "scans") / _free_name(stem, taken, ending)
            try:
                path.touch()  # uploads at the same time, of files with one name, get names of their own
            except OSError as error:
                raise write_error(path, error) from error
            return path

    @staticmethod
    @contextmanager
    def removed_on_error(path: Path) -> Generator[None]:
        """Remove a file of the project if the block fails."""
        try:
            yield
        except BaseException:
            path.unlink(missing_ok=True)
            raise

    def add(self, file: Path, role: Role, called: str = "") -> tuple[str, str | None]:
        """Add a scan; return its id, and that of a specimen with the same file content, in which case it is not added.

        Args:
            file: the scan.
            role: role of the specimen.
            called: name of the file for the user (default: its own name).

        Raises:
            FileError: the scan cannot be read.
        """
        [added] = self._add_all([(file, called or file.name)], role)
        return added

    def _add_all(self, files: Sequence[tuple[Path, str]], role: Role) -> list[tuple[str, str | None]]:
        """Add scans, each with the name of its file for the user, by one edit; see `add`."""
        with self._lock:
            specimens, added = list[Specimen](), list[tuple[str, str | None]]()
            taken = {specimen.id.casefold() for specimen in self.state.specimens}
            known: dict[object, list[tuple[str, Path]]] = {}  # beginning of a file -> specimens with such a file
            for specimen in self.state.specimens:
                for other in (self.folder / place for place in (specimen.file, specimen.original) if place):
                    with suppress(OSError):  # a scan that was moved is no duplicate
                        known.setdefault(_beginning_of(other), []).append((specimen.id, other))
            for file, called in files:
                try:
                    alike = known.setdefault(_beginning_of(file), [])
                    same = next((name for name, other in alike if filecmp.cmp(file, other, shallow=False)), None)
                except OSError as error:
                    raise FileError(f"Cannot read {file}: {error.strerror or error}.") from error
                name = same or _free_name(_stem(called), taken)
                added.append((name, same))
                if same is None:
                    is_inside = file.is_relative_to(self.folder)
                    place = file.relative_to(self.folder).as_posix() if is_inside else str(file)
                    specimens.append(Specimen(id=name, file=place, role=role))
                    taken.add(name.casefold())
                    alike.append((name, file))
            if specimens:
                self.edit(
                    None,
                    lambda state: ("", replace(state, specimens=(*state.specimens, *specimens))),
                    together="add specimens",
                )
            return added

    def add_stored(self, file: Path, role: Role, called: str) -> tuple[str, str | None]:
        """Add a scan in the project's folder, as `add` does; its file is removed if the scan is not added."""
        with self.removed_on_error(file):
            name, same = self.add(file, role, called)
        if same is not None:
            file.unlink(missing_ok=True)
        return name, same

    def keep_volume(self, file: Path) -> Path:
        """Return the file of an uploaded volume: an earlier one with the same content, in whose place it is removed."""
        with self._lock:
            earlier = sorted(path for path in file.parent.glob("*") if path.name.lower().endswith(VOLUME_ENDINGS))
            same = next((path for path in earlier if path != file and filecmp.cmp(path, file, shallow=False)), None)
            if same is not None:
                file.unlink()
            return same or file

    def import_files(self, place: Path, role: Role, *, copy: bool) -> tuple[int, list[str]]:
        """Add a scan or the scans of a folder on this machine; return the number of those added, and
        sentences on the scans that are not.

        Raises:
            FileError: it cannot be read, or the copies not written.
            InputError: a folder without scans.
        """
        import shutil

        listed = mesh_files([place.resolve()])
        notes, added = list(listed.left_out), list[tuple[str, str | None]]()
        if not copy:
            added = self._add_all([(file, file.name) for file in listed.files], role)
        else:
            for file in listed.files:
                target = self.new_file(file.name)
                with self.removed_on_error(target), atomic_path(target) as path:
                    shutil.copyfile(file, path)
                added.append(self.add_stored(target, role, file.name))
        for file, (_, same) in zip(listed.files, added, strict=True):
            if same is not None:
                notes.append(f"{file.name} is the same file as {same}; it was not added again.")
        return sum(same is None for _, same in added), notes

    # Results that become scans

    def add_surfaces(self, folder: Path, role: Role) -> list[str]:
        """Add the surfaces of label volumes in a folder of the project; return sentences on those not added."""
        files = sorted(folder.glob("*.ply"))
        added = zip(files, self._add_all([(file, file.name) for file in files], role), strict=True)
        return [f"{file.stem} is the same surface as {same}; it was not added." for file, (_, same) in added if same]

    def take_groomed(self, groomed: Mapping[str, str]) -> None:
        """Use groomed scans; a specimen whose scan was changed since the start of the grooming keeps its scan.

        Args:
            groomed: path of a scan, as in `Specimen.file` -> path of the groomed scan.
        """

        def change(state: State) -> tuple[str, State]:
            ids = [specimen.id for specimen in state.specimens if specimen.file in groomed]
            return f"groom {_count_text(ids)}", _edit_specimens(
                state,
                ids,
                lambda specimen: replace(
                    specimen, file=groomed[specimen.file], original=specimen.original or specimen.file
                ),
            )

        if any(specimen.file in groomed for specimen in self.state.specimens):
            self.edit(None, change)

    # Files that commands read

    def scan_list(
        self, path: Path, specimens: Sequence[Specimen], names: Collection[str] | None = None
    ) -> tuple[dict[str, str], tuple[tuple[str, ...], ...]]:
        """Return the list of scans with their ids and cells, as `correspond` and `fit` read it, with the files of their
        landmarks, and the commands that write scans in mm and their mirror images, whose output the list names.

        Args:
            path: path of the list, in a folder of the project.
            specimens: specimens of the list.
            names: names of the landmarks that the command knows; scans with fewer than three of these landmarks, which
                determine no pose, are listed without landmarks. None for all landmarks.
        """
        columns, commands = self.state.columns, list[tuple[str, ...]]()
        columns = tuple(column for column in columns if column.lower() != LANDMARK_COLUMN)  # it would name files
        marks = self._landmark_texts(specimens, names)
        marks_folder = f"{path.stem}-landmarks"
        files = {
            specimen.id: specimen.file if Path(specimen.file).is_absolute() else f"../{specimen.file}"
            for specimen in specimens
        }
        for unit, mirrored in sorted({(specimen.unit, specimen.mirrored) for specimen in specimens} - {("", False)}):
            group = [specimen for specimen in specimens if (specimen.unit, specimen.mirrored) == (unit, mirrored)]
            folder = f"{path.stem}-{unit or 'scans'}{'-mirrored' if mirrored else ''}"
            paths = [self.path(specimen) for specimen in group]  # `check` names its files by them
            files |= {
                specimen.id: f"{folder}/{name}.ply" for specimen, name in zip(group, names_for(paths), strict=True)
            }
            scans = [specimen.file for specimen in group]
            options = [*([f"--unit={unit}"] if unit else []), *(["--mirror"] if mirrored else [])]
            commands.append(("check", *scans, "-o", f"{path.parent.name}/{folder}", *options, "--quiet"))
        cells = {specimen.id: specimen.cells for specimen in self.state.specimens}
        has_parts = names is None and any(specimen.part for specimen in specimens)  # fits are of one scan each
        rows = [
            ((specimen.subject if has_parts else "") or specimen.id, files[specimen.id],
             *([specimen.part] if has_parts else []),
             *(cells[specimen.subject or specimen.id].get(column, "") for column in columns),
             *([f"{marks_folder}/{specimen.id}.csv" if specimen.id in marks else ""] if marks else []))
            for specimen in specimens
        ]  # fmt: skip
        header = ("id", "file", *([_PART] if has_parts else []), *columns, *([LANDMARK_COLUMN] if marks else []))
        texts = {f"{path.parent.name}/{path.name}": table_text(header, rows)}
        texts |= {f"{path.parent.name}/{marks_folder}/{name}.csv": text for name, text in marks.items()}
        return texts, tuple(commands)

    def table(self, specimens: Iterable[Specimen]) -> str:
        """Return the table of specimens, as `compare` reads it."""
        columns, chosen = self.state.columns, tuple(specimen for specimen in specimens if not specimen.subject)

        def make() -> str:
            rows = [(specimen.id, *(specimen.cells.get(column, "") for column in columns)) for specimen in chosen]
            return table_text(("specimen", *columns), rows)

        return self.cached((columns, chosen), make)

    def cached(self, key: tuple[object, ...], make: Callable[[], _Made]) -> _Made:
        """Return the result of `make` for a key, computed once: all jobs ask for it after each edit."""
        made = next((made for known, made in self._made if known == key), None)
        if made is None:
            made = make()
            self._made = [(key, made), *self._made[: _MOST_MADE - 1]]
        return made

    def landmark_table(self, surfaces: str) -> str:
        """Return the landmarks of the surfaces in a folder as a table: those that the user placed on them, and those
        that come from the landmarks of the scans.
        """
        path, placed = self.folder / surfaces / LANDMARKS, SurfaceLandmarks.of(self.state.landmarks)
        of_scans = read_surface_landmarks(path) if path.is_file() else SurfaceLandmarks()
        others = of_scans.select([name for name in of_scans.names if name not in placed])
        return surface_landmarks_text(others.joined(placed))

    def point_table(self, specimens: Iterable[Specimen]) -> str:
        """Return the landmarks on scans, in the frames and units of their files, as `landmarks convert` reads them."""
        return points_text({specimen.id: specimen.points for specimen in specimens}, self.state.point_names)

    def _landmark_texts(self, specimens: Iterable[Specimen], names: Collection[str] | None) -> dict[str, str]:
        """Return id -> table of the landmarks of each specimen that has some, as they are on the scan that commands
        read, without points of curves, which are not at the same place. See `scan_list` for `names`.
        """
        texts: dict[str, str] = {}
        on_curves = self.state.curve_points
        for specimen in specimens:
            points = specimen.read_points()
            rows = [
                (name, *points[name])
                for name in self.state.point_names
                if name in points and name not in on_curves and (names is None or name in names)
            ]
            if len(rows) >= (1 if names is None else LEAST_LANDMARKS):
                texts[specimen.id] = table_text(("name", *"xyz"), rows)
        return texts


def points_text(points: Mapping[str, Mapping[str, Point]], names: Sequence[str]) -> str:
    """Return the landmarks of specimens as a table with a row for each one; specimens are sorted by name."""
    rows = [
        (specimen, name, *points[specimen].get(name, ("NA",) * 3))
        for specimen in sorted(points, key=name_key)
        for name in names
    ]
    return table_text(("specimen", "landmark", *"xyz"), rows)


class MatchedBlock(Struct, frozen=True, kw_only=True):
    """The cells that a pasted block would change.

    Args:
        columns: columns that are added to the table.
        cells: id -> column -> value.
        by_name: whether the rows name their specimens; otherwise they follow the order of the page.
        certain: whether it can be pasted without a question.
        notes: sentences on rows and columns that are not pasted, and on specimens without a row.
    """

    columns: tuple[str, ...] = ()
    cells: dict[str, dict[str, str]]
    by_name: bool
    certain: bool
    notes: tuple[str, ...]


class PastedBlock(Struct, frozen=True, kw_only=True):
    """Cells that are pasted from a spreadsheet into the table.

    Args:
        rows: rows of cells; short rows lack their last cells.
        column: column of the cell into which they are pasted; empty for the names of the specimens.
        order: ids of the specimens from the row of this cell on, in the order of the page.
    """

    rows: tuple[tuple[str, ...], ...]
    column: str
    order: tuple[str, ...]

    def match(self, state: State) -> MatchedBlock:
        """Return the cells that the block would change: by the names in its first column, or else by position.

        A first row with the heading of a column of names, or with the headings of the columns that it is pasted into,
        is a header. Names are matched as in tables that are imported.

        Raises:
            FileFormatError: two rows are of one specimen.
            InputError: there are no rows, or names are expected, as the block is pasted into the column of names or has
                a heading of names, and no row names a specimen.
        """
        width = max(map(len, self.rows), default=0)
        if not width:
            raise InputError("The pasted block has no cells; copy cells of a spreadsheet.")
        rows = [[*map(str.strip, row), *[""] * (width - len(row))] for row in self.rows]
        gaps = _emptied(sum(len(row) < width for row in self.rows), [cell for row in rows for cell in row])
        columns = list(state.columns[state.columns.index(self.column) :] if self.column in state.columns else ())
        has_heading = key_column(rows[0]) is not None
        if width == 1 and not self.column:
            raise InputError("The pasted block has one column; paste it into the column that it belongs to.")
        known = {fold_name(name) for own in state.names for name in own}
        named = [fold_name(row[0].replace("\\", "/").rpartition("/")[2]) in known for row in rows]
        has_names = any(name and not is_number(row[0]) for name, row in zip(named, rows, strict=True))
        if not has_heading and self.column and not (has_names and width > 1):
            return self._by_position(rows, columns, gaps)
        heads = rows[0][1:]
        is_new = not named[0] and any(named) and not any(map(is_number, heads))
        has_heads = all(heads) and len(set(heads)) == len(heads) and (is_new or set(heads) <= set(state.columns))
        header = rows.pop(0) if has_heading or has_heads else ["", *(columns if self.column else state.columns)]
        return self._by_name(
            header if has_heading else [KEYS[0], *header[1:]],
            rows,
            state,
            gaps,
            is_sure=has_heading,
            is_asked=bool(self.column),
        )

    def _by_name(
        self, header: list[str], rows: list[list[str]], state: State, gaps: list[str], *, is_sure: bool, is_asked: bool
    ) -> MatchedBlock:
        width = max(map(len, self.rows))
        text = io.StringIO()
        csv.writer(text, delimiter="\t").writerows([header[:width], *(row[: len(header)] for row in rows)])
        pasted, cells, notes = cells_of_table(text.getvalue().encode(), state, "The pasted block")
        new = tuple(column for column in pasted if column not in state.columns)
        notes += [*gaps, *_beyond(width - len(header), "column")]
        names = {fold_name(column) for column in state.columns}
        is_sure = is_sure and not any(fold_name(column) in names for column in new)
        return MatchedBlock(
            columns=new,
            cells=cells,
            by_name=True,
            certain=not notes and (is_sure or not (new or is_asked)),
            notes=tuple(notes),
        )

    def _by_position(self, rows: list[list[str]], columns: list[str], gaps: list[str]) -> MatchedBlock:
        notes = gaps
        if rows[0] == columns[: len(rows[0])] and len(rows) > 1:
            notes.append("The first row contains the headings of these columns, and is not pasted.")
            rows = rows[1:]
        notes += [*_beyond(len(rows) - len(self.order), "row"), *_beyond(len(rows[0]) - len(columns), "column")]
        cells = {name: dict(zip(columns, row, strict=False)) for name, row in zip(self.order, rows, strict=False)}
        for column in columns:
            values = [own[column] for own in cells.values() if column in own]
            for own in cells.values():
                if column in own:
                    own[column] = "" if own[column].lower() in MISSING else _with_point(own[column], values)
        return MatchedBlock(cells=cells, by_name=False, certain=not notes and len(rows) == 1, notes=tuple(notes))


def _emptied(short_rows: int, cells: Sequence[str]) -> list[str]:
    """Return sentences on the cells of a block that become empty although they are absent, or have a text."""
    marks = [cell for cell in cells if cell and cell.lower() in MISSING]
    notes: list[str] = []
    if short_rows:
        rows = "1 row is shorter than the others: its" if short_rows == 1 else f"{short_rows} rows are shorter: their"
        notes.append(f"{rows} last cells become empty.")
    if marks:
        word = "1 cell is" if len(marks) == 1 else f"{len(marks)} cells are"
        notes.append(f"{word} marked as missing ({', '.join(dict.fromkeys(marks))}), and will be empty.")
    return notes


def _beyond(count: int, noun: str) -> list[str]:
    """Return a sentence on the rows or columns of a block that lie beyond those of the table; none if none do."""
    number = f"1 {noun} is" if count == 1 else f"{count} {noun}s are"
    return [f"{number} not pasted, beyond the last {noun} of the table."] if count > 0 else []


class StaleError(InputError):
    """The project was changed after the user looked at it."""


def change_of(request: Mapping[str, Any]) -> Callable[[State], tuple[str, State]]:
    """Return the edit that a request of the page asks for.

    Raises:
        InputError: by the edit, if a specimen or column does not exist, or a name cannot be used.
    """
    what = str(request.get("what", ""))
    edits = {
        "cells": _edit_cells, "block": _edit_block, "include": _set_field, "set": _set_field, "remove": _remove,
        "rename": _rename, "unit": _set_field, "mirror": _set_field, "original": _use_original, "parts": _join_parts,
        "add-column": _add_column, "remove-column": _remove_column, "landmarks": _set_landmarks,
        "points": _edit_points, "point-names": _set_point_names, "views": _set_views, "curve": _set_curve,
        "pair": _set_pair,
    }  # fmt: skip

    def change(state: State) -> tuple[str, State]:
        try:
            return edits[what](state, request)
        except InputError:
            raise
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"The edit {what[:30]!r} cannot be read; reload the page.") from error

    return change


def _edit_cells(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    by_id: dict[str, dict[str, str]] = {}
    stored = {specimen.id: specimen.cells for specimen in state.specimens}
    for cell in request["cells"]:
        _check_column(state, cell["column"])
        others = (cells.get(cell["column"], "") for name, cells in stored.items() if name != cell["id"])
        value = _with_point(str(cell["value"]).strip()[:_LONGEST_CELL], others)
        by_id.setdefault(cell["id"], {})[cell["column"]] = value
        now = stored.get(cell["id"], {}).get(cell["column"], "")
        if now != cell.get("before", now):
            raise StaleError(
                f"Another tab changed {cell['column']} of {cell['id']} to {now[:40]!r} in the meantime; look at it, "
                "and edit it again if it is wrong."
            )
    edited = _edit_specimens(
        state, by_id, lambda specimen: replace(specimen, cells={**specimen.cells, **by_id[specimen.id]})
    )
    count = sum(map(len, by_id.values()))
    return f"edit {count} cell{'' if count == 1 else 's'}", edited


def _edit_block(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    cells = {
        str(name): {str(column): str(value).strip()[:_LONGEST_CELL] for column, value in own.items()}
        for name, own in request["cells"].items()
    }
    for column in request["columns"]:
        _, state = _add_column(state, {"column": column})
    for column in {column for own in cells.values() for column in own}:
        _check_column(state, column)
    return with_cells((), cells)(state)


def _set_field(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Set the use, unit, side or role of specimens and of their parts."""
    what, ids = str(request["what"]), request["ids"]
    field = {"include": "included", "unit": "unit", "mirror": "mirrored", "set": "role"}[what]
    value = request["set" if what == "set" else field]
    if what == "unit" and value and value not in MM_PER_UNIT:
        raise InputError(f"There is no unit {value!r:.30}; choose one of {', '.join(MM_PER_UNIT)}.")
    new = {"set": "new" if value == "new" else "training", "unit": value}.get(what, bool(value))
    text = {"include": "include" if value else "exclude", "unit": "set the unit of", "set": "move"}.get(what, what)
    changed = _edit_specimens(state, state.with_parts(ids), lambda specimen: replace(specimen, **{field: new}))
    return f"{text} {_count_text(ids)}", changed


def _use_original(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Return the state in which groomed specimens have their original scans again."""
    ids = request["ids"]
    return f"use the original scan of {_count_text(ids)}", _edit_specimens(
        state,
        state.with_parts(ids),
        lambda specimen: replace(specimen, file=specimen.original or specimen.file, original=""),
    )


def _remove(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    gone = state.with_parts(request["ids"])
    _edit_specimens(state, gone, lambda specimen: specimen)
    return f"remove {_count_text(request['ids'])}", replace(
        state, specimens=tuple(specimen for specimen in state.specimens if specimen.id not in gone)
    )


def _rename(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    old, new = request["id"], str(request["to"]).strip()
    if not new or len(new) > _LONGEST_ID or new.startswith(".") or _NO_FILE_NAME.search(new):
        raise InputError(f"A specimen cannot be called {new[:40]!r}, as files of results are called so.")
    if any(specimen.id.casefold() == new.casefold() for specimen in state.specimens if specimen.id != old):
        raise InputError(f"There is a specimen {new} already; choose another name.")
    parts = tuple(replace(part, subject=new) if part.subject == old else part for part in state.specimens)
    state = replace(state, specimens=parts)
    return f"rename {old}", _edit_specimens(state, [old], lambda specimen: replace(specimen, id=new))


def _join_parts(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Return the state in which scans called SPECIMEN_PART are parts of one specimen, whose first part has its row."""
    parts = tuple(dict.fromkeys(str(part).strip() for part in request["parts"]))
    ending = re.compile(rf"(.+)[_.-]({'|'.join(map(re.escape, parts))})")
    known = {name: (match[1], match[2]) for name in request["ids"] if (match := ending.fullmatch(name)) and match[2]}
    if len(parts) < 2 or len(known) < len(request["ids"]):
        lacking = next((name for name in request["ids"] if name not in known), "")
        raise InputError(
            f"Name two or more parts in which the names of the scans end, such as femur for anna_femur"
            f"{f'; {lacking} ends in none of them' if lacking else ''}."
        )
    rows: dict[str, str] = {}
    for name, (subject, _) in sorted(known.items(), key=lambda scan: parts.index(scan[1][1])):
        rows.setdefault(subject, name)
    if taken := sorted(rows.keys() & {specimen.id for specimen in state.specimens}):
        raise InputError(f"There is a specimen {taken[0]} already; rename it.")

    def join(specimen: Specimen) -> Specimen:
        subject, part = known[specimen.id]
        is_row = rows[subject] == specimen.id
        return replace(specimen, id=subject if is_row else specimen.id, subject="" if is_row else subject, part=part)

    return f"join the parts of {_count_text(rows)}", replace(_edit_specimens(state, known, join), parts=parts)


def _add_column(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    column = str(request["column"]).strip()[:60]
    if not column or not _can_be_column(column) or column in state.columns:
        raise InputError(f"A column cannot be called {column!r}; choose a name that is not in use.")
    return f"add the column {column}", replace(state, columns=(*state.columns, column))


def _can_be_column(name: str) -> bool:
    """Return whether a column can have a name: it names no specimens, is no term of formulas, and can be quoted."""
    is_key = key_column([name], (*KEYS, LANDMARK_COLUMN)) is not None
    return not is_key and name != "log_size" and "`" not in name


def _with_point(value: str, others: Iterable[str]) -> str:
    """Return a cell with a decimal point for a comma if the `others` of its column are numbers, as tables are read."""
    plain = value.replace(",", ".") if DECIMAL_COMMA.fullmatch(value) else value
    return plain if plain != value and all(is_number(cell.replace(",", ".")) for cell in others if cell) else value


def _remove_column(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    column = request["column"]
    _check_column(state, column)
    specimens = tuple(
        replace(specimen, cells={key: cell for key, cell in specimen.cells.items() if key != column})
        for specimen in state.specimens
    )
    kept = tuple(name for name in state.columns if name != column)
    return f"remove the column {column}", replace(state, columns=kept, specimens=specimens)


def _set_landmarks(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    landmarks = {str(name).strip()[:60]: int(vertex) for name, vertex in request["landmarks"].items()}
    if "" in landmarks or min(landmarks.values(), default=0) < 0:
        raise InputError("A landmark needs a name and a vertex.")
    return "change the landmarks", replace(state, landmarks=landmarks, landmarks_on=str(request.get("on", "")))


def _set_views(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Set the named views of the surfaces in a folder, or of scans."""
    on = str(request["on"])
    views, before = (
        read(Orientation, {"views": request[key]}, "The named views", "reload the page").views
        for key in ("views", "before")
    )
    if state.views.get(on, ()) != before:
        raise StaleError("Another tab changed the named views in the meantime; look at them, and do it again.")
    names = [view.name for view in views]
    for view in views:
        view_rotation(view)
        if not view.name.strip() or len(view.name) > _LONGEST_NAME or names.count(view.name) > 1:
            raise InputError(
                f"A view cannot be called {view.name[:_LONGEST_NAME]!r}; give it a name of at most {_LONGEST_NAME} "
                "characters that no other has."
            )
    return "change the named views", replace(state, views={**state.views, on: views})


def _edit_points(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Place the landmarks of a specimen, or remove those without coordinates."""
    name, wanted = str(request["id"]), dict(request["points"])
    now = next((specimen.points for specimen in state.specimens if specimen.id == name), dict[str, Point]())
    for mark, before in request.get("before", {}).items():
        if now.get(mark) != (None if before is None else point_of(before)):
            raise StaleError(
                f"Another tab changed the landmark {mark[:_LONGEST_NAME]} of {name} in the meantime; look at it, and "
                "place it again if it is wrong."
            )
    placed = {mark: point_of(point) for mark, point in wanted.items() if point is not None}
    others = {mark: point for mark, point in now.items() if mark not in wanted}
    _, edited = with_points(tuple(placed), {name: placed})(
        _edit_specimens(state, [name], lambda specimen: replace(specimen, points=others))
    )
    marks = next(iter(wanted)) if len(wanted) == 1 else f"{len(wanted)} landmarks"
    return f"{'place' if placed else 'remove'} {marks} {'on' if placed else 'from'} {name}", edited


def point_of(values: Iterable[Any]) -> Point:
    """Return the coordinates of a landmark.

    Raises:
        InputError: a coordinate is not finite.
        TypeError, ValueError: they are not three numbers.
    """
    x, y, z = map(float, values)
    if not all(map(isfinite, (x, y, z))):
        raise InputError("A landmark needs three finite coordinates; give a number for each.")
    return x, y, z


def _set_point_names(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Set the names of the landmarks; the points of those that are removed are removed from all scans."""
    names = tuple(str(name).strip() for name in request["names"])
    specimens = tuple(
        replace(specimen, points={name: point for name, point in specimen.points.items() if name in names})
        for specimen in state.specimens
    )
    curves = {name: curve for name, curve in state.curves.items() if {*curve.names(name)} <= {*names}}
    _, edited = with_points(names, {})(replace(state, point_names=(), specimens=specimens, curves=curves))
    return "change the names of landmarks", edited


def _set_curve(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Add a curve, or set the number of its points, which are then spaced evenly on all scans."""
    name, curve = str(request["name"]).strip(), ScanCurve(int(request["points"]), bool(request["closed"]))
    if not name or not LEAST_LANDMARKS <= curve.points <= MOST_POINTS:
        raise InputError(f"A curve needs a name, and {LEAST_LANDMARKS} to {MOST_POINTS} points.")
    if name in state.point_names:
        raise InputError(f"There is a landmark called {name}; give the curve another name.")
    old, new = state.curves.get(name, curve).names(name), curve.names(name)
    partly = [specimen.id for specimen in state.specimens if 0 < len({*old} & {*specimen.points}) < len(old)]
    if partly:
        raise InputError(
            f"Only some points of the curve {name} are placed on {partly[0]}; place all, or remove them, and try again."
        )

    def with_spaced(specimen: Specimen) -> Specimen:
        placed = [specimen.points[point] for point in old if point in specimen.points]
        spaced = curve.spaced(placed) if placed else []
        others = {point: place for point, place in specimen.points.items() if point not in old}
        return replace(specimen, points=others | dict(zip(new, spaced, strict=False)))

    edited = replace(
        state,
        point_names=tuple(point for point in state.point_names if point not in old),
        specimens=tuple(map(with_spaced, state.specimens)),
        curves={**state.curves, name: curve},
        pairs=state.pairs and tuple(pair for pair in state.pairs if new == old or not {*pair} & {*old}),
    )
    return f"set the points of the curve {name}", with_points(new, {})(edited)[1]


def _set_pair(state: State, request: Mapping[str, Any]) -> tuple[str, State]:
    """Let two landmarks, or two curves, mirror each other, or one of them none."""
    name, other = str(request["name"]), str(request["other"])
    points, others = (state.curves[end].names(end) if end in state.curves else (end,) for end in (name, other))
    kept = [pair for pair in state.mirrored_pairs if not {*pair} & {*points, *others}]
    pairs = (*kept, *zip(points, others, strict=False)) if other else tuple(kept)
    return f"set the mirrored pair of {name}", replace(state, pairs=pairs)


def with_points(
    names: Sequence[str], points: Mapping[str, Mapping[str, Point]], curves: Mapping[str, ScanCurve] = {}
) -> Callable[[State], tuple[str, State]]:
    """Return the edit that adds landmarks, with their points by specimen, to those that the project has, and curves.

    Raises:
        InputError: by the edit, if a name cannot be in a table of landmarks, or there are too many names.
    """

    def change(state: State) -> tuple[str, State]:
        together = tuple(dict.fromkeys((*state.point_names, *names)))
        for name in names:
            is_comment = name.startswith("#")  # in tables
            if is_comment or name != name.strip() or not 0 < len(name) <= _LONGEST_NAME or not name.isprintable():
                shown, most = name[:_LONGEST_NAME], f"{_LONGEST_NAME} characters"
                raise InputError(f"A landmark cannot be called {shown!r}; give it a name of at most {most} without #.")
        if len(together) > MOST_POINTS:
            raise InputError(f"There would be {len(together)} names of landmarks, and the studio takes {MOST_POINTS}.")
        edited = _edit_specimens(
            state, points, lambda specimen: replace(specimen, points={**specimen.points, **points[specimen.id]})
        )
        edited = replace(edited, point_names=together, curves={**state.curves, **curves})
        return f"take landmarks of {_count_text(points)}", edited

    return change


def cells_of_table(
    content: bytes, state: State, name: str = "The table"
) -> tuple[list[str], dict[str, dict[str, str]], list[str]]:
    """Return the columns of a table (CSV, TSV or .xlsx), the cells of each specimen with a row, and sentences
    on rows without a specimen and specimens without a row.

    Rows are matched to ids and files as commands match them.

    Raises:
        FileFormatError: it is no such table, or two rows are of one specimen.
        InputError: no row is of a specimen.
    """
    table, state = read_table(Path(name), content), replace(state, specimens=state.rows)
    reserved = [head for head in table.columns if not _can_be_column(head)]
    matched, notes = match_rows(table, state.names, "the project", "name the specimens alike")
    cells = {
        state.specimens[k].id: {
            head: column[row][:_LONGEST_CELL] for head, column in table.columns.items() if head not in reserved
        }
        for row, k in matched.items()
    }
    if reserved:
        notes.append(f"Not taken, as these names have a meaning of their own: {', '.join(reserved)}; rename them.")
    return [head for head in table.columns if head not in reserved], cells, notes


def with_cells(columns: Sequence[str], cells: Mapping[str, Mapping[str, str]]) -> Callable[[State], tuple[str, State]]:
    """Return the edit that takes the columns and cells of a table."""

    def change(state: State) -> tuple[str, State]:
        edited = _edit_specimens(
            state, cells, lambda specimen: replace(specimen, cells={**specimen.cells, **cells[specimen.id]})
        )
        together = tuple(dict.fromkeys((*state.columns, *columns)))
        return f"take a table of {len(cells)} specimens", replace(edited, columns=together)

    return change


def _edit_specimens(state: State, ids: Iterable[str], change: Callable[[Specimen], Specimen]) -> State:
    wanted = set(ids)
    if unknown := wanted - {specimen.id for specimen in state.specimens}:
        raise InputError(f"There is no specimen {sorted(unknown)[0][:40]!r}; reload the page.")
    return replace(
        state, specimens=tuple(change(specimen) if specimen.id in wanted else specimen for specimen in state.specimens)
    )


def _check_column(state: State, column: str) -> None:
    if column not in state.columns:
        raise InputError(f"The table has no column {str(column)[:40]!r}; add it first.")


def _count_text(ids: Iterable[str]) -> str:
    names = list(ids)
    return names[0] if len(names) == 1 else f"{len(names)} specimens"


def scan_key(scan: Path, folder: Path) -> str:
    """Return a key that changes with a scan: that of its path, size and time of change.

    Scans in the project's `folder`, which may be moved, are identified by their path in it, others by their complete
    path: those of an archive can have the same name, size and time in different folders.
    """
    # Methods of pathlib would take most of the time of a state.
    place = scan.as_posix().removeprefix(f"{folder.as_posix()}/")
    try:
        stat = scan.stat()
        text = f"{place}|{stat.st_size}|{stat.st_mtime_ns}"
    except OSError:
        text = f"{place}|missing"
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()[:24]


def _beginning_of(file: Path) -> tuple[int, bytes]:
    """Return the size of a file and a hash of its beginning, which distinguish nearly all files."""
    stat = file.stat()
    return stat.st_size, _hash_of_beginning(str(file), stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=_MOST_HASHES)
def _hash_of_beginning(path: str, size: int, modified_ns: int) -> bytes:
    with Path(path).open("rb") as file:
        return hashlib.sha256(file.read(_BEGINNING)).digest()


def _ending(name: str) -> str:
    known = (*MESH_FILE_ENDINGS, *VOLUME_ENDINGS)
    return next((end for end in sorted(known, key=len, reverse=True) if name.lower().endswith(end)), "")


def _stem(name: str) -> str:
    """Return a name for a scan in a file called `name`, which any file system can have."""
    plain = _NO_FILE_NAME.sub("_", stem_of(Path(Path(name.replace("\\", "/")).name)))
    return plain.strip(". ")[:_LONGEST_ID] or "scan"


def _free_name(stem: str, taken: set[str], ending: str = "") -> str:
    """Return the first of stem, stem-2, stem-3, ... that is not `taken` (in lower case) with its ending."""
    numbered = (f"{stem}{'' if number == 1 else f'-{number}'}{ending}" for number in count(1))
    return next(name for name in numbered if name.casefold() not in taken)


def recent_projects(add: Path | None = None) -> list[dict[str, Any]]:
    """Return the projects that were opened last; `add` comes first from now on."""
    from platformdirs import user_state_path

    path = user_state_path("shapespace", appauthor=False) / "projects.json"
    try:
        folders = [str(folder) for folder in json.loads(path.read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        folders = []
    if add is not None:
        folders = [str(add), *(folder for folder in folders if folder != str(add))][:10]
        try:
            make_folder(path.parent)
            write_text(path, json.dumps(folders))
        except FileError:
            pass  # the list is a convenience; a read-only home must not keep a project from being opened
    return [
        {"name": Path(folder).name, "folder": folder, "exists": (Path(folder) / Project.FILE).is_file()}
        for folder in folders
    ]
