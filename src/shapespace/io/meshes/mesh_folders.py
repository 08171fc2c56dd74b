"""Lists of meshes and other files in folders, with notes on the files that are skipped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from shapespace.errors import InputError
from shapespace.io.files import read_error
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, MESH_FILE_ENDINGS
from shapespace.reprs import first_names

_NAMED = 3  # names in a message before the rest is only counted


@dataclass(frozen=True)
class MeshFiles:
    """Result of `mesh_files`.

    Args:
        files: in the order given, those of a folder in the order of their names.
        left_out: a sentence for each kind of thing that was not taken.
    """

    files: tuple[Path, ...]
    left_out: tuple[str, ...]


@dataclass
class _FolderListing:
    endings: tuple[str, ...]
    files: list[Path] = field(default_factory=list[Path])
    folders: list[str] = field(default_factory=list[str])
    linked: list[str] = field(default_factory=list[str])
    broken: list[str] = field(default_factory=list[str])
    packed: list[str] = field(default_factory=list[str])


def mesh_files(
    paths: Sequence[Path],
    *,
    recursive: bool = False,
    apart_from: Path | None = None,
    endings: Sequence[str] = MESH_FILE_ENDINGS,
    kind_name: str = "meshes",
) -> MeshFiles:
    """Return `paths` with each folder replaced by the meshes in it, or by other files of some kind.

    Args:
        paths: files, taken as they are, and folders.
        recursive: whether to take what lies in folders below these too. Links to folders are not followed.
        apart_from: a folder below that is not looked into, such as that of the results.
        endings: of the files to take, in small letters.
        kind_name: they are called.

    Raises:
        InputError: a folder without meshes.
        FileError: a folder that cannot be read.
    """
    files: list[Path] = []
    left_out: list[str] = []
    for path in paths:
        if not _is_folder(path):
            files.append(path)
            continue
        listing = _FolderListing(tuple(endings))
        _list_folder(path, path, listing, recursive, None if apart_from is None else apart_from.resolve())
        if not listing.files:
            advice = "; give --recursive for what lies in the folders below it" if listing.folders else ""
            advice += "; unpack those that are compressed with gunzip" if listing.packed else ""
            known = MESH_ENDINGS if endings is MESH_FILE_ENDINGS else endings
            raise InputError(f"{path} holds no {kind_name}{advice}; shapespace reads {', '.join(known)}.")
        files += listing.files
        left_out += _omission_notes(path, listing, kind_name)
    return MeshFiles(tuple(files), tuple(left_out))


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError as error:
        raise read_error(path, error) from error


def _list_folder(folder: Path, top: Path, listing: _FolderListing, recursive: bool, apart_from: Path | None) -> None:
    try:
        inside = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
        for path in inside:
            name = path.relative_to(top).as_posix()
            of_kind = path.name.lower().endswith(listing.endings)
            if path.is_dir():
                if path.resolve() == apart_from:
                    continue
                if not recursive:
                    listing.folders.append(name)
                elif path.is_symlink():
                    listing.linked.append(name)
                else:
                    _list_folder(path, top, listing, recursive, apart_from)
            elif of_kind and path.is_file():
                listing.files.append(path)
            elif path.name.lower().endswith(tuple(f"{ending}.gz" for ending in listing.endings)):
                listing.packed.append(name)
            elif path.is_symlink() and not path.exists() and (of_kind or not path.suffix):
                listing.broken.append(name)
    except OSError as error:
        raise read_error(folder, error) from error


def _omission_notes(folder: Path, listing: _FolderListing, kind_name: str) -> Iterator[str]:
    for names, singular, plural, verb, advice in (
        (listing.folders, "folder", "folders", "looked into", f"--recursive takes the {kind_name} there"),
        (listing.linked, "link to a folder", "links to folders", "followed", "give that folder too"),
        (listing.broken, "broken link", "broken links", "taken", "mend or remove it"),
        (listing.packed, "compressed file", "compressed files", "taken", "unpack them with gunzip first"),
    ):
        if names:
            count_words = f"1 {singular} is" if len(names) == 1 else f"{len(names)} {plural} are"
            names_shown = first_names(names, _NAMED)
            yield f"{folder}: {count_words} not {verb} ({names_shown}); {advice}."
