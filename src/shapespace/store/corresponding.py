"""Output folders of `correspond`: their surfaces, their unit, and reasons to review surfaces in English."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.io.containers.json_files import read_json
from shapespace.io.meshes.mesh_io import mesh_files, stem_of
from shapespace.reprs import first_names
from shapespace.schemas import (
    CORRESPOND_AGAIN,
    CorrespondenceRecord,
    CorrespondRecord,
    ReviewCode,
    ReviewReason,
    SurfaceReview,
)
from shapespace.store.results import ENDINGS, mesh_at, results_at, surfaces_of
from shapespace.types import Mesh

_OF_PROVENANCE = re.compile(r"; (\d+ of \d+ surfaces needs? review in the correspondence \([^()]*\))$")

_REASON_PHRASES: Mapping[ReviewCode, str] = {
    "doubtful": "doubtful",
    "folded": "with folded triangles",
    "not_settled": "not settled",
    "missing": "with missing parts",
    "unreached": "that do not reach parts of the scan",
    "distance": "far from the scan",
    "area_change": "with large changes of area",
}
"""Description of each reason, after a number of surfaces."""


def _percent(share: float) -> str:
    return f"{float(f'{100 * share:.2g}'):g} %"


_DESCRIPTIONS: Mapping[ReviewCode, Callable[[ReviewReason], str]] = {
    "distance": lambda r: (
        f"1 % of its points lie farther off than {_percent(r.value)} of its size, where {_percent(r.usual)} is usual"
    ),
    "folded": lambda r: f"{_percent(r.value)} of its triangles are folded over",
    "missing": lambda r: f"it shows only {100 * (1 - r.value):.0f} % of the mean shape",
    "unreached": lambda r: f"only {100 * (1 - r.value):.0f} % of its points are reached",
    "area_change": lambda r: f"its triangles grow or shrink up to {r.value:.1f} times, where {r.usual:.1f} is usual",
    "not_settled": lambda r: f"its vertices still moved by {_percent(r.value)} of its size in the last round",
}


def describe_review(record: CorrespondRecord) -> tuple[str, ...]:
    """Return the reasons to review a surface as clauses, the doubt about its correspondence first."""
    doubt = (record.doubt,) if record.doubt else ()
    return (*doubt, *(_DESCRIPTIONS[reason.code](reason) for reason in record.review))


def review_summary(review: SurfaceReview) -> str:
    """Return how many surfaces need review and why, as a clause; empty if none needs review."""
    if not review.needs_review:
        return ""
    reasons = ", ".join(f"{count} {_REASON_PHRASES[code]}" for code, count in review.reasons.items())
    verb = "needs" if review.needs_review == 1 else "need"
    return f"{review.needs_review} of {review.surfaces} surfaces {verb} review in the correspondence ({reasons})"


def provenance_with_review(provenance: str, review: SurfaceReview) -> str:
    """Return the provenance of a model, with the number of its training surfaces that need review."""
    return f"{provenance}; {summary}" if (summary := review_summary(review)) else provenance


def review_of_provenance(provenance: str) -> str:
    """Return the clause that `provenance_with_review` has added; empty if there is none."""
    found = _OF_PROVENANCE.search(provenance)
    return found[1] if found else ""


SURFACE, RECORD = CorrespondRecord.SURFACE, CorrespondRecord.ENDING
SUMMARY, MEAN = CorrespondenceRecord.FILE, CorrespondenceRecord.MEAN
LANDMARKS = "landmarks.csv"
_ENDINGS = (*ENDINGS.values(), SURFACE)
_NAMED = 3  # number of names in a message before the rest is only counted


@dataclass(frozen=True)
class SurfaceFiles:
    """Meshes in correspondence.

    Args:
        files: files of the meshes, in the order given.
        unit_ratios: files in another unit than the majority of their folder -> their ratio, see `CorrespondRecord`.
        mirrored: files of surfaces that are mirror images of the majority of their folder.
        doubtful: files of surfaces that are doubtful.
        needs_review: surfaces that need review, doubtful ones among them -> reasons, by the records of their
            correspondence.
        notes: remarks for the user.
        parts: name -> number of vertices of each part of the objects; empty for objects of one part.
    """

    files: tuple[Path, ...]
    unit_ratios: Mapping[Path, float]
    mirrored: frozenset[Path]
    doubtful: frozenset[Path]
    notes: tuple[str, ...]
    needs_review: Mapping[Path, Sequence[ReviewCode]] = field(default_factory=dict[Path, Sequence[ReviewCode]])
    parts: Mapping[str, int] = field(default_factory=dict[str, int])

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, index: int, /) -> Mesh:
        return self.mesh(self.files[index])

    def mesh(self, file: Path) -> Mesh:
        """Return the mesh in one of the files, in the unit and on the side of the majority.

        Raises:
            As `mesh_at`.
        """
        mesh, ratio = mesh_at(file), self.unit_ratios.get(file, 1.0)
        mesh = mirror_image(mesh) if file in self.mirrored else mesh
        if ratio == 1.0:
            return mesh
        std = None if mesh.position_std is None else mesh.position_std / ratio
        return replace(mesh, vertices=mesh.vertices / ratio, position_std=std)

    def review(self, files: Iterable[Path], option: str = "", *, accept: bool) -> SurfaceReview:
        """Return how many of `files` need review, and why, by the records of their correspondence.

        Args:
            files: files of the surfaces that are used, doubtful ones included.
            option: option of the command that accepts surfaces that need review, for messages.
            accept: whether more than half may need review.

        Raises:
            InputError: more than half need review, without `accept`.
        """
        used = list(files)
        review = SurfaceReview.of(self.needs_review.get(file, ()) for file in used)
        if review.is_majority and not accept:
            named = first_names([file.name for file in used if file in self.needs_review], _NAMED)
            raise InputError(
                f"{review_summary(review)}, which is more than half ({named}); inspect them with shapespace report, "
                f"run shapespace correspond with other settings{f', or use {option} to continue' if option else ''}."
            )
        return review

    def without_doubtful(self, option: str = "") -> SurfaceFiles:
        """Return the files without doubtful surfaces of a correspondence, with a note; `option`, if any, includes them.

        Raises:
            InputError: all are doubtful.
        """
        if not self.doubtful:
            return self
        left = tuple(file for file in self.files if file not in self.doubtful)
        named = first_names([file.name for file in self.files if file in self.doubtful], _NAMED)
        if not left:
            advice = f", and use {option} to include them" if option else " and run shapespace correspond again"
            raise InputError(f"All surfaces are doubtful ({named}); inspect them{advice}.")
        included = f"; {option} includes them" if option else ""
        note = f"{len(self.doubtful)} of {len(self.files)} surfaces are doubtful and excluded ({named}){included}."
        return replace(
            self,
            files=left,
            unit_ratios={file: ratio for file, ratio in self.unit_ratios.items() if file not in self.doubtful},
            mirrored=self.mirrored - self.doubtful,
            doubtful=frozenset(),
            notes=(*self.notes, note),
        )

    def unit_note(self, unit: str) -> str:
        """Return a sentence on the files in another unit, which are converted to the unit of the majority."""
        return f"{self._other_units()}; they are converted to the unit of the majority, which is assumed to be {unit}."

    def refuse_mixed_units(self) -> None:
        """Check that sizes can be compared.

        Raises:
            InputError: files in several units.
        """
        if self.unit_ratios:
            raise InputError(
                f"{self._other_units()}, so that their sizes cannot be compared; bring the scans to one unit, or use "
                "--gauge shape."
            )

    def _other_units(self) -> str:
        file_names = first_names([path.name for path in self.unit_ratios], _NAMED)
        of = "meshes is" if len(self.unit_ratios) == 1 else "meshes are"
        return f"{len(self.unit_ratios)} of {len(self.files)} {of} in another unit than most ({file_names})"


def surface_stem(path: Path) -> str:
    """Return the name of the scan of a surface: its file's name without `.dense.ply` and the like, or its ending."""
    return next((path.name.removesuffix(end) for end in _ENDINGS if path.name.endswith(end)), stem_of(path))


def surface_files(paths: Sequence[Path], *, recursive: bool = False) -> SurfaceFiles:
    """Return `paths` with each folder replaced by its meshes; that of a correspondence only by its surfaces.

    Raises:
        InputError: a folder without meshes, or a correspondence that is not finished.
        FileError: a file or folder cannot be read.
        FileFormatError: a correspondence.json that is no record of a correspondence.
    """
    files: list[Path] = []
    parts: dict[Path, Mapping[str, int]] = {}
    notes: list[str] = []
    for path in paths:
        summary = _summary_of(path)
        if summary is None and (summary_files := _stored_surfaces(path, notes)):
            files += summary_files
        elif summary is None:
            listing = mesh_files([path], recursive=recursive)
            files += listing.files
            notes += listing.left_out
        else:
            files += _surfaces(path, summary)
            if summary.set_aside:
                names = first_names(list(summary.set_aside), _NAMED)
                notes.append(f"{path}: without {len(summary.set_aside)} excluded scans ({names}).")
    ratios: dict[Path, float] = {}
    mirrored: set[Path] = set()
    doubtful: set[Path] = set()
    needs_review: dict[Path, Sequence[ReviewCode]] = {}
    for folder in dict.fromkeys(file.parent for file in files if file.name.endswith(SURFACE)):
        if (summary := _summary_of(folder)) is not None:
            parts[folder] = summary.parts
            other_units = {folder / f"{name}{SURFACE}": ratio for name, ratio in summary.other_units.items()}
            ratios |= {file: other_units[file] for file in files if file in other_units}
            reflected = {folder / f"{name}{SURFACE}" for name in summary.mirrored}
            mirrored |= reflected.intersection(files)
            doubtful |= {folder / f"{name}{SURFACE}" for name in summary.doubtful}.intersection(files)
            needs_review |= {folder / f"{name}{SURFACE}": ["doubtful"] for name in summary.doubtful}
            needs_review |= {folder / f"{name}{SURFACE}": codes for name, codes in summary.needs_review.items()}
    if mirrored:
        of = "meshes is a mirror image" if len(mirrored) == 1 else "meshes are mirror images"
        names = first_names([file.name for file in files if file in mirrored], _NAMED)
        notes.append(f"{len(mirrored)} of {len(files)} {of} of the others ({names}) and reflected.")
    if len({tuple(own.items()) for own in parts.values()}) > 1:
        stated = "; ".join(f"{folder}: {', '.join(own) or 'none'}" for folder, own in parts.items())
        raise InputError(f"The folders have different parts ({stated}); give surfaces of the same parts.")
    return SurfaceFiles(
        tuple(files), ratios, frozenset(mirrored), frozenset(doubtful), tuple(notes), needs_review,
        next(iter(parts.values()), dict[str, int]()),
    )  # fmt: skip


def reviewed_surfaces(
    paths: Sequence[Path], option: str = "", *, recursive: bool = False, with_doubtful: bool = False
) -> tuple[SurfaceFiles, SurfaceReview]:
    """Return the surfaces of `surface_files` without doubtful ones, and the number of all that need review.

    Args:
        paths: files and folders.
        option: option of the command for `with_doubtful`, in messages; empty without a command.
        recursive: whether to also search subfolders.
        with_doubtful: whether to include doubtful surfaces, and to accept that more than half need review.

    Raises:
        InputError: see `surface_files`; all are doubtful, or more than half need review.
    """
    listing = surface_files(paths, recursive=recursive)
    review = listing.review(listing.files, option, accept=with_doubtful)
    return listing if with_doubtful else listing.without_doubtful(option), review


def trusted_surfaces(folder: Path) -> SurfaceFiles:
    """Return the surfaces of a folder that `build` uses, with its notes as warnings.

    Raises:
        InputError: see `surface_files`; all are doubtful, or more than half need review.
    """
    listing, _ = reviewed_surfaces([folder])
    for note in listing.notes:
        warnings.warn(note, stacklevel=4)
    return listing


def _summary_of(folder: Path) -> CorrespondenceRecord | None:
    """Return the record of the correspondence in `folder`; None without a correspondence."""
    file = folder / SUMMARY
    if not file.is_file():
        if folder.is_dir() and any(folder.glob(f"*{RECORD}")):
            raise InputError(f"{folder}: the correspondence in it is not finished; {CORRESPOND_AGAIN}.")
        return None
    return CorrespondenceRecord.from_json(json_of(file), str(file))


def json_of(file: Path) -> object:
    """Return the content of a JSON file that `correspond` wrote.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is not JSON.
    """
    return read_json(file, CORRESPOND_AGAIN)


def _surfaces(folder: Path, summary: CorrespondenceRecord) -> list[Path]:
    files = [folder / f"{name}{SURFACE}" for name in summary.corresponding]
    missing = [file.name for file in files if not file.is_file()]
    if missing or not files:
        raise InputError(
            f"{folder}: {', '.join(missing[:_NAMED]) or 'every surface'} is no longer in it; {CORRESPOND_AGAIN}."
        )
    return files


def _stored_surfaces(path: Path, notes: list[str]) -> list[Path]:
    """Return the surfaces of the fits in a folder with a store, as files for `mesh_at`; empty for other folders."""
    results = results_at(path) if path.is_dir() else None
    if results is None:
        return []
    files = surfaces_of(results)
    if not files:
        raise InputError(f"{path} contains no surfaces of fits; fit some scans first.")
    if len(files) < len(results):
        notes.append(f"{path}: of {len(results)} fits the {len(files)} surfaces that end as {files[0].name} are taken.")
    notes += results.problems
    return files
