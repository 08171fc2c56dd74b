"""Landmarks in a folder, each file named as the scan it belongs to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.io.landmarks.fiducials import FIDUCIAL_ENDINGS
from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS, READ_ONLY_LANDMARKS, read_landmarks
from shapespace.io.meshes.mesh_io import stem_of
from shapespace.reprs import first_names
from shapespace.types import Mesh

_LISTED = 5  # names in a message, so that it stays short


def _is_result(file: Path) -> bool:
    """Return whether a fit wrote `file` beside its record."""
    name = next((file.name.removesuffix(e) for e in FIDUCIAL_ENDINGS if file.name.endswith(e)), None)
    return name is not None and file.with_name(f"{name}.fit.json").is_file()


@dataclass(frozen=True)
class LandmarkFiles:
    """The landmark files of a folder.

    Args:
        folder: where they are; None where there are none.
        files: name of a scan without its ending -> file.
        used: names that a scan had.
        unread: what is to be said of files that cannot be used.
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
            FileError: it is no folder, or holds no such file.
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
            ending = next((one for one in endings if file.name.lower().endswith(one)), None)
            if ending is None or not file.is_file() or _is_result(file):
                continue
            first = files.setdefault(file.name[: -len(ending)], file)
            if first is not file:
                duplicates.setdefault(file.name[: -len(ending)], []).append(file)
                unread.append(f"{file.name} is not read, since {first.name} has landmarks of the same scan.")
        if not files:
            raise FileError(f"{folder} holds no landmarks; they are read from files with {', '.join(endings)}.")
        return LandmarkFiles(folder, files, unread=unread, duplicates=duplicates)

    def refuse_shared(self, scans: Sequence[Path]) -> None:
        """Raise InputError where two of `scans`, of one name in different folders, would take the same landmarks."""
        owner: dict[str, Path] = {}
        for path in scans:
            name = stem_of(path)
            if name in self.files and owner.setdefault(name, path) != path:
                raise InputError(
                    f"{owner[name]} and {path} would both take the landmarks in {self.files[name]}; rename one of the "
                    "scans."
                )

    def of_scan(self, scan: Path) -> Path | None:
        """Return the file with the landmarks of `scan`, None where there is none."""
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
            self.unread.append(f"{path.name} goes without landmarks: {error}")
            return mesh

    def report_unused(self, say: Callable[[str], None]) -> None:
        """Print which files belong to no scan.

        Raises:
            InputError: all files belong to none.
        """
        if self.folder is None:
            return
        if not self.used:
            names = ", ".join(file.name for file in list(self.files.values())[:_LISTED])
            raise InputError(
                f"No file of landmarks in {self.folder} ({names}) is named as one of the scans; name them alike, "
                "such as anna.ply and anna.csv."
            )
        for sentence in self.unread:
            say(sentence)
        if left := sorted(set(self.files) - self.used):
            say(f"{len(left)} files of landmarks belong to no scan that is given: {first_names(left, _LISTED)}.")
