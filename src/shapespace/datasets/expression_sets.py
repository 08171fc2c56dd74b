"""Folders of labelled face scans: BU-3DFE, Bosphorus, and any folder with a `labels.csv`.

The licensed sets are not shipped; their naming rules are taken from L. Yin et al., *A 3D Facial Expression
Database For Facial Behavior Research*, FGR 2006, A. Savran et al., *Bosphorus Database for 3D Face Analysis*, BioID
2008, and public code that reads them.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from shapespace.errors import InputError
from shapespace.io.files import read_bytes, read_error
from shapespace.io.meshes.mesh_io import MESH_ENDINGS
from shapespace.io.tables.table_io import table_rows

EXPRESSIONS = ("neutral", "anger", "disgust", "fear", "smile", "sadness", "surprise")
"""Expressions of the studies, in the order in which they are listed."""

KINDS = ("neutral", "expression", "action unit", "rotation", "occlusion")
"""Kinds of scans; only the first two are returned by default."""

BU3DFE_EXPRESSIONS: Mapping[str, str] = MappingProxyType(
    {
        "NE": "neutral", "AN": "anger", "DI": "disgust", "FE": "fear", "HA": "smile", "SA": "sadness",
        "SU": "surprise",
    }
)  # fmt: skip
"""Code in a BU-3DFE name -> word."""

BU3DFE_LEVELS: Mapping[str, float] = MappingProxyType({"00": 0.0, "01": 0.25, "02": 0.5, "03": 0.75, "04": 1.0})
"""Level in a BU-3DFE name -> intensity; 00 occurs only for the neutral face."""

BU3DFE_ANCESTRY: Mapping[str, str] = MappingProxyType(
    {
        "AE": "East Asian", "AM": "Middle-East Asian", "BL": "Black", "IN": "Indian", "LA": "Hispanic or Latino",
        "WH": "White",
    }
)  # fmt: skip
"""The two letters at the end of a BU-3DFE name; read, and not used."""

BOSPHORUS_EXPRESSIONS: Mapping[str, str] = MappingProxyType(
    {
        "ANGER": "anger", "DISGUST": "disgust", "FEAR": "fear", "HAPPY": "smile", "SADNESS": "sadness",
        "SURPRISE": "surprise",
    }
)  # fmt: skip
"""Word after `E_` in a Bosphorus name -> word of the studies."""

BOSPHORUS_KINDS: Mapping[str, str] = MappingProxyType(
    {
        "N": "neutral", "E": "expression", "LFAU": "action unit", "UFAU": "action unit", "CAU": "action unit",
        "YR": "rotation", "PR": "rotation", "CR": "rotation", "O": "occlusion",
    }
)  # fmt: skip
"""Group in a Bosphorus name -> kind: lower, upper and combined action units; yaw, pitch and cross rotations."""

LABEL_WORDS: Mapping[str, str] = MappingProxyType(
    {
        "angry": "anger", "disgusted": "disgust", "afraid": "fear", "fearful": "fear", "happy": "smile",
        "happiness": "smile", "joy": "smile", "sad": "sadness", "surprised": "surprise",
    }
)  # fmt: skip
"""Other words in `labels.csv` -> word of the studies."""

LABELS = "labels.csv"

_BU3DFE = re.compile(r"([FM]\d{4})_([A-Z]{2})(\d{2})([A-Z]{2})(?:_(F3D|RAW))?", re.IGNORECASE)
_BOSPHORUS = re.compile(r"(bs\d{3})_([A-Z]+)_([A-Z0-9]+)_(\d+)", re.IGNORECASE)
# The face cut out by the database's authors is preferred to the complete scan with ears, hair and collar.
_PARTS = ("F3D", "", "RAW")
_SHOWN = 3  # number of names in a message before the rest is only counted


@dataclass(frozen=True)
class ScanEntry:
    """A scan with its subject and expression.

    Args:
        path: path of the file.
        subject: subject of the scan, as the set names people.
        expression: one of `EXPRESSIONS`; another word of `labels.csv`; the code of an action unit, a rotation or an
            occlusion, such as `LFAU_12`.
        intensity: 0 for neutral, up to 1.
        kind: one of `KINDS`.
    """

    path: Path
    subject: str
    expression: str
    intensity: float
    kind: str


@dataclass(frozen=True)
class LeftOut:
    """A file, or a line of `labels.csv`, that is excluded, with the reason."""

    name: str
    why: str


@dataclass(frozen=True)
class ScanSet:
    """Labelled scans of a folder.

    Args:
        folder: folder of the scans.
        layout: layout of the folder: "BU-3DFE", "Bosphorus" or "labels.csv".
        scans: labelled scans, sorted by subject, expression, intensity and path.
        left_out: excluded files that look like scans, with the reasons.
    """

    folder: Path
    layout: str
    scans: tuple[ScanEntry, ...]
    left_out: tuple[LeftOut, ...]

    def subjects_without_neutral(self) -> tuple[str, ...]:
        """Return the people without a neutral scan, in order."""
        neutral = {scan.subject for scan in self.scans if scan.kind == "neutral"}
        return tuple(dict.fromkeys(scan.subject for scan in self.scans if scan.subject not in neutral))

    def summary(self) -> str:
        """Return lines on the number of scans of each expression, excluded scans and why, and missing neutrals."""
        words = Counter(scan.expression for scan in self.scans)
        people = len({scan.subject for scan in self.scans})
        counts = ", ".join(f"{word} {words[word]}" for word in sorted(words, key=_order))
        lines = [
            f"{self.layout}: {_count_words(len(self.scans), 'scan')} of {_count_words(people, 'subject')} ({counts})."
        ]
        reasons: dict[str, list[str]] = {}
        for left in self.left_out:
            reasons.setdefault(left.why, []).append(left.name)
        lines += [f"Excluded, {reason}: {_list_names(names)}." for reason, names in reasons.items()]
        if alone := self.subjects_without_neutral():
            lines.append(f"No neutral scan: {_list_names(alone)}.")
        unlisted_names = {scan.expression for scan in self.scans if scan.kind == "expression"} - set(EXPRESSIONS)
        if unlisted_names:
            lines.append(f"Expressions of other names: {_list_names(sorted(unlisted_names))}.")
        return "\n".join(lines)


def find_scans(folder: Path | str, kinds: Collection[str] = ("neutral", "expression")) -> tuple[ScanEntry, ...]:
    """Return the labelled scans in `folder` and below; `scan_set` also returns the excluded files.

    Args:
        folder: BU-3DFE (`F0001/F0001_AN01WH_F3D.wrl`), Bosphorus (`bs000/bs000_E_HAPPY_0.bnt`), or with `labels.csv`.
        kinds: kinds of scans to return, from `KINDS`.

    Returns:
        The scans by subject, expression, intensity and path; never empty.

    Raises:
        FileError: the folder or its `labels.csv` cannot be read.
        InputError: the folder contains no such scans, it mixes both databases, or `labels.csv` has a wrong layout.
    """
    return scan_set(folder, kinds).scans


def scan_set(folder: Path | str, kinds: Collection[str] = ("neutral", "expression")) -> ScanSet:
    """Return the labelled scans in `folder` and below, and the excluded files.

    If `folder` contains a `labels.csv` (file, subject, expression, and intensity if known), only this table is used.
    Otherwise names are parsed. Of several files of the same BU-3DFE scan, `_F3D` (the face, cut out) is preferred to a
    name without part, and that to `_RAW` (the complete scan); of equal ones, `.wrl` is preferred to other endings, then
    the first path. Of the same Bosphorus scan, `.bnt` is preferred to other endings. The number at the end of a
    Bosphorus name counts repeated takes, which are separate scans.

    Args:
        folder: folder of the scans.
        kinds: kinds of scans to return, from `KINDS`.

    Raises:
        FileError: the folder or its `labels.csv` cannot be read.
        InputError: the folder contains no such scans, it mixes both databases, or `labels.csv` has a wrong layout.
    """
    folder = Path(folder)
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown or not kinds:
        raise InputError(f"Unknown kind of scan {', '.join(unknown) or 'none'}; choose from {', '.join(KINDS)}.")
    files = _meshes_in(folder)
    if (folder / LABELS).is_file():
        layout, entries, left_out = "labels.csv", *_from_labels(folder, files)
    else:
        layout, entries, left_out = _from_names(folder, files)
    scans: list[ScanEntry] = []
    for scan in sorted(entries, key=lambda s: (s.subject, _order(s.expression), s.intensity, s.path)):
        if scan.kind in kinds:
            scans.append(scan)
        else:
            left_out.append(LeftOut(_relative_name(scan.path, folder), f"not asked for ({scan.kind})"))
    if not scans:
        raise InputError(f"{folder} contains no scans of kind {' or '.join(kinds)}; choose other kinds or folders.")
    return ScanSet(folder, layout, tuple(scans), tuple(left_out))


def _meshes_in(folder: Path) -> list[Path]:
    def raise_error(error: OSError) -> None:
        raise read_error(Path(error.filename or folder), error) from error

    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder} is a file, not a folder of scans; give the folder.")
    meshes: list[Path] = []
    for home, inner, names in os.walk(folder, onerror=raise_error):
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        meshes += [
            Path(home) / name
            for name in sorted(names)
            if Path(name).suffix.lower() in MESH_ENDINGS and not name.startswith(".")
        ]
    return meshes


def _from_names(folder: Path, files: Iterable[Path]) -> tuple[str, list[ScanEntry], list[LeftOut]]:
    readers: Mapping[str, Callable[[Path], tuple[ScanEntry, tuple[str, ...], tuple[int, int]] | None]] = {
        "BU-3DFE": _bu3dfe,
        "Bosphorus": _bosphorus,
    }
    best: dict[tuple[str, ...], tuple[tuple[int, int], ScanEntry]] = {}
    layouts: dict[str, Path] = {}
    left_out: list[LeftOut] = []
    for path in files:
        recognised = next(((layout, read) for layout, reader in readers.items() if (read := reader(path))), None)
        if recognised is None:
            left_out.append(LeftOut(_relative_name(path, folder), "a name of unknown form"))
            continue
        layout, (entry, key, rank) = recognised
        layouts.setdefault(layout, path)
        if key not in best:
            best[key] = (rank, entry)
            continue
        reason = "the same scan twice" if rank == best[key][0] else "another file of the same scan"
        loser = entry
        if rank < best[key][0]:
            loser = best[key][1]
            best[key] = (rank, entry)
        left_out.append(LeftOut(_relative_name(loser.path, folder), reason))
    if len(layouts) > 1:
        first, second = (_relative_name(path, folder) for path in layouts.values())
        raise InputError(
            f"{folder} contains scans of {' and '.join(layouts)} ({first}, {second}); give the folder of one set."
        )
    if not layouts:
        raise InputError(
            f"{folder} contains no labelled scans: no {LABELS}, and no names as in BU-3DFE (F0001_AN01WH_F3D.wrl) or "
            "Bosphorus (bs000_E_HAPPY_0.bnt); check the folder."
        )
    return next(iter(layouts)), [entry for _, entry in best.values()], left_out


def _ending_rank(path: Path, preferred: str) -> int:
    ending = path.suffix.lower()
    return -1 if ending == preferred else MESH_ENDINGS.index(ending)


def _bu3dfe(path: Path) -> tuple[ScanEntry, tuple[str, ...], tuple[int, int]] | None:
    match = _BU3DFE.fullmatch(path.stem)
    if match is None:
        return None
    subject, code, level, ancestry, part = (group.upper() if group else "" for group in match.groups())
    neutral = code == "NE"
    known = code in BU3DFE_EXPRESSIONS and level in BU3DFE_LEVELS and ancestry in BU3DFE_ANCESTRY
    if not known or neutral != (level == "00"):
        return None
    entry = ScanEntry(
        path, subject, BU3DFE_EXPRESSIONS[code], BU3DFE_LEVELS[level], "neutral" if neutral else "expression"
    )
    return entry, (subject, code, level), (_PARTS.index(part), _ending_rank(path, ".wrl"))


def _bosphorus(path: Path) -> tuple[ScanEntry, tuple[str, ...], tuple[int, int]] | None:
    match = _BOSPHORUS.fullmatch(path.stem)
    if match is None:
        return None
    subject, group, detail, take = (part.upper() for part in match.groups())
    kind = BOSPHORUS_KINDS.get(group)
    if kind is None:
        return None
    if kind == "neutral":
        expression = "neutral" if detail == "N" else None
    else:
        expression = BOSPHORUS_EXPRESSIONS.get(detail) if kind == "expression" else f"{group}_{detail}"
    if expression is None:
        return None
    entry = ScanEntry(path, subject.lower(), expression, 0.0 if kind == "neutral" else 1.0, kind)
    return entry, (subject, group, detail, take), (0, _ending_rank(path, ".bnt"))


def _from_labels(folder: Path, files: Iterable[Path]) -> tuple[list[ScanEntry], list[LeftOut]]:
    path = folder / LABELS
    try:
        rows = list(table_rows(read_bytes(path)))
    except ValueError as error:
        raise InputError(f"{path} {error}, so it is not comma-separated text; save it again.") from error
    numbered = [(n, [cell.strip() for cell in row]) for n, row in enumerate(rows, start=1)]
    numbered = [(n, row) for n, row in numbered if any(row)]
    header = [cell.lower() for cell in numbered[0][1]] if numbered else []
    missing = [name for name in ("file", "subject", "expression") if name not in header]
    if missing:
        raise InputError(f"{path} has no column {' and '.join(missing)}; its first line names the columns.")
    known = {file.resolve() for file in files}
    entries: dict[Path, ScanEntry] = {}
    left_out: list[LeftOut] = []
    for line, row in numbered[1:]:
        cells = dict(zip(header, row, strict=False))
        entry = _entry_of_row(cells, f"{path}, line {line}", folder)
        row_name = f"{cells['file']} (line {line})"
        target = _resolve_existing(entry.path)
        if target is None:
            left_out.append(LeftOut(row_name, "no such file"))
        elif target in entries:
            left_out.append(LeftOut(row_name, "a second label of the same file"))
        elif entry.path.suffix.lower() not in MESH_ENDINGS:
            left_out.append(LeftOut(row_name, "not a mesh"))
        else:
            entries[target] = entry
    unlisted = sorted(known - set(entries))
    left_out += [LeftOut(_relative_name(file, folder.resolve()), f"not in {LABELS}") for file in unlisted]
    if not entries:
        raise InputError(f"{path} names no scan that is there; its column 'file' is relative to its own folder.")
    return list(entries.values()), left_out


def _resolve_existing(path: Path) -> Path | None:
    try:
        return path.resolve() if path.is_file() else None
    except (OSError, ValueError, RuntimeError):
        # Names that are too long, contain null characters, or form a cycle of links.
        return None


def _entry_of_row(cells: Mapping[str, str], row_name: str, folder: Path) -> ScanEntry:
    empty = [name for name in ("file", "subject", "expression") if not cells.get(name)]
    if empty:
        raise InputError(f"{row_name} has no {' and no '.join(empty)}; fill it in.")
    word = cells["expression"].lower()
    expression = LABEL_WORDS.get(word, word)
    neutral = expression == "neutral"
    text = cells.get("intensity", "") or "1"
    try:
        intensity = float(text)
    except ValueError:
        intensity = -1.0
    # NaN fails this comparison, too.
    if not 0 <= intensity <= 1:
        raise InputError(f"{row_name} has the intensity '{text[:40]}', which is no number from 0 to 1; correct it.")
    kind = "neutral" if neutral else "expression"
    return ScanEntry(folder / cells["file"], cells["subject"], expression, 0.0 if neutral else intensity, kind)


def _order(expression: str) -> tuple[int, str]:
    return (EXPRESSIONS.index(expression) if expression in EXPRESSIONS else len(EXPRESSIONS), expression)


def _relative_name(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def _count_words(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _list_names(names: Collection[str]) -> str:
    first_names = ", ".join(list(names)[:_SHOWN])
    return first_names if len(names) <= _SHOWN else f"{first_names} and {len(names) - _SHOWN} more"
