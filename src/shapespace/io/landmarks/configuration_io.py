"""Readers and writers of the landmarks of many specimens, in files of morphometrics programs and in folders."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.io.files import make_folder, read_bytes, write_text
from shapespace.io.landmarks.configuration_tables import header_kind, long_text, morphoj_texts, parse_table, wide_text
from shapespace.io.landmarks.landmark_configurations import (
    LandmarkConfigurations,
    read_landmark_numbers,
    sliders_of_curves,
)
from shapespace.io.landmarks.landmark_io import (
    LANDMARK_FORMATS,
    READ_ONLY_LANDMARKS,
    csv_rows,
    read_landmarks,
    slicer_curves,
)
from shapespace.io.landmarks.r_arrays import R_ENDINGS, parse_r
from shapespace.io.landmarks.tps_nts import nts_text, parse_dta, parse_morphologika, parse_nts, parse_tps, tps_text
from shapespace.io.parsing import damage_error, is_number
from shapespace.io.read_limits import LARGEST_CONFIGURATIONS_FILE_BYTES
from shapespace.io.tables.table_io import decoded_text, table_rows, table_text
from shapespace.reprs import first_names

_TEXTS = {".tps": parse_tps, ".nts": parse_nts, ".dta": parse_dta}
_MORPHOLOGIKA = re.compile(rb"^(?:\xef\xbb\xbf)?\s*\[\s*individuals\s*\]", re.IGNORECASE | re.MULTILINE)
_HEAD_BYTES = 2**16  # 64 KiB hold the sections before the coordinates
_TABLES = (".csv", ".txt", ".tsv", ".xlsx")
_SINGLE = tuple(sorted({*LANDMARK_FORMATS, *READ_ONLY_LANDMARKS} - {".tps"}, key=lambda one: (-len(one), one)))
_MILLIMETRES = (".mrk.json", ".fcsv")
_TPS_KEYS = ("image", "comment")
"""Columns that TPS has keys for."""
_NAMED = 3  # names in a sentence
RECORD = "align.json"
"""File of a folder that `align` wrote, with its settings; its coordinates have been aligned."""
CURVE_SLIDERS, SURFACE_SLIDERS = "curveslide.csv", "surfslide.csv"
"""Files with the numbers of semilandmarks, from 1, as geomorph reads them: before, slide, after; surface."""

CONFIGURATION_FORMATS: Mapping[str, str] = MappingProxyType(
    {"tps": ".tps", "nts": ".nts", "morphoj": ".txt", "csv": ".csv", "long": ".csv"}
)
"""Format -> ending of files of all specimens; `csv` is wide, a row for each specimen."""
FOLDER_FORMATS = ("mrk.json", "fcsv")
"""Formats, which are endings, of folders with a file for each specimen."""


def read_configurations(
    path: Path | str, *, name: str | None = None, sliders: Sequence[Path] = ()
) -> LandmarkConfigurations:
    """Read the landmarks of many specimens, missing ones as not-a-number.

    Formats: TPS with curves and scale, NTS, IDAV Landmark (.dta), Morphologika (.txt), wide and long tables (CSV,
    Excel), MorphoJ tables (.txt), arrays of R
    (.rda, .RData, .rds), and folders with a file for each specimen in any format of `read_landmarks`, TPS or NTS.
    Values that are scaled, left out or taken as missing are in the notes.

    Args:
        path: the file or folder.
        name: of the array, for R files with several.
        sliders: tables of semilandmarks, as geomorph has them: before, slide, after; or surface alone. Each replaces
            those in `path`.

    Raises:
        FileError: it cannot be read, or is too long.
        FileFormatError: it is damaged, is in none of the formats, or its specimens have other landmarks.
        InputError: two specimens have one name.
        ShapespaceError: the extra `r`, which R files need, is not installed.

    Example:
        >>> _ = ss.io.write_configurations("landmarks.tps", configurations)
        >>> ss.io.read_configurations("landmarks.tps").points.shape
        (6, 10, 3)
    """
    raw = _read_folder(Path(path)) if Path(path).is_dir() else _read_file(Path(path), name)
    for file in sliders:
        form = "before, slide, after, or one landmark on the surface,"
        numbers = read_landmark_numbers(file, raw.landmarks, (1, 3), form) - 1
        is_surface = numbers.shape[1] == 1
        raw = replace(raw, **({"surface_sliders": numbers[:, 0]} if is_surface else {"curve_sliders": numbers}))
    return raw


def _read_file(path: Path, name: str | None) -> LandmarkConfigurations:
    suffix = path.suffix.lower()
    single = next((ending for ending in _SINGLE if path.name.lower().endswith(ending)), None)
    if not (suffix in (*_TEXTS, *_TABLES, *R_ENDINGS) or single):
        endings = ", ".join(dict.fromkeys((*_TEXTS, *_TABLES, *R_ENDINGS, *_SINGLE)))
        raise damage_error(path, f"the ending {suffix!r} is none of landmark files ({endings})")
    data = read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES)
    if not data.strip():
        raise damage_error(path, "it is empty; export or copy it again")
    if suffix in R_ENDINGS:
        return parse_r(data, path, name)
    if name is not None:
        raise InputError(f"{path} is no file of R, whose arrays have names; leave --object out.")
    is_morphologika = _is_morphologika(data)
    if suffix in _TEXTS or is_morphologika or re.match(rb"\s*LM3?\s*=", data, re.IGNORECASE):
        try:
            text = decoded_text(data)
        except ValueError as error:
            raise FileFormatError(f"{path} {error}; export it again.") from error
        return (parse_morphologika if is_morphologika else _TEXTS.get(suffix, parse_tps))(text, path)
    kind = _header_kind(data) if suffix in _TABLES else "single"
    if single is None or kind in ("wide", "long") or (suffix == ".csv" and kind != "single"):
        return parse_table(data, path)
    return _read_specimen(path, single)


def is_configurations(path: Path | str) -> bool:
    """Return whether a path is landmarks of many specimens by its ending, header, or the files in a folder."""
    path = Path(path)
    if path.is_dir():
        names = [file.name.lower() for file in path.iterdir()]
        return any(n.endswith((*_TEXTS, *_SINGLE)) for n in names) and not any(n.endswith(".fit.json") for n in names)
    if path.suffix.lower() not in _TABLES:
        return path.is_file() and path.suffix.lower() in (*_TEXTS, *R_ENDINGS)
    try:
        data = read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES)
        return _is_morphologika(data) or _header_kind(data) in ("wide", "long")
    except ShapespaceError:
        return False


def _is_morphologika(data: bytes) -> bool:
    return _MORPHOLOGIKA.search(data[:_HEAD_BYTES]) is not None


def _header_kind(data: bytes) -> str:
    try:
        return header_kind(next(table_rows(data), list[str]()))
    except ValueError:
        return ""


def _read_specimen(path: Path, ending: str) -> LandmarkConfigurations:
    points = read_landmarks(path, keep_absent=True)
    is_numbered = all(re.fullmatch(r"point_\d+", label) for label in points)
    number, curves = {label: k for k, label in enumerate(points)}, list[tuple[list[int], bool]]()
    if ending == ".mrk.json":
        found = slicer_curves(read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES), path)
        curves = [([number[label] for label in labels], closed) for labels, closed in found]
    sliders = sliders_of_curves(curves)
    note = f"{len(sliders)} points of curves (Curve, ClosedCurve) are semilandmarks."
    return LandmarkConfigurations(
        names=(path.name[: -len(ending)].removesuffix(".landmarks"),),
        points=np.array([list(points.values())]),
        landmarks=() if is_numbered else tuple(points),
        unit="mm" if ending in _MILLIMETRES else "",
        curve_sliders=sliders,
        where=str(path),
        notes=(note,) if len(sliders) else (),
    )


def _is_other_table(file: Path) -> bool:
    """Return whether a CSV file is of something else than landmarks, such as covariates, by its first line."""
    row = next(iter(csv_rows(read_bytes(file, LARGEST_CONFIGURATIONS_FILE_BYTES), file)), list[str]())
    return bool(row) and not header_kind(row) and not any(map(is_number, row[1:4]))


def _read_folder(folder: Path) -> LandmarkConfigurations:
    """Return the landmarks in the files of the most frequent ending, in the order of the first file."""
    if (folder / RECORD).is_file():
        raise InputError(
            f"{folder} is a folder that align wrote; give the landmark file that it was made from, or write its shapes "
            "to a landmark file with shapespace export."
        )
    endings = (*_TEXTS, *_SINGLE)
    files: dict[str, list[Path]] = {}
    for file in sorted(folder.iterdir()):
        ending = next((ending for ending in endings if file.name.lower().endswith(ending)), None)
        if ending is not None and file.is_file() and not file.name.endswith((CURVE_SLIDERS, SURFACE_SLIDERS)):
            files.setdefault(ending, []).append(file)
    if all(ending == ".csv" and all(map(_is_other_table, listed)) for ending, listed in files.items()):
        raise damage_error(folder, f"it has no landmark files, which end with {', '.join(endings)} (.csv: name,x,y,z)")
    # Slicer's markups first among equally many: they mark missing landmarks.
    ending = max(files, key=lambda one: (len(files[one]), one == ".mrk.json"))
    others = [file.name for other, listed in files.items() if other != ending for file in listed]
    notes = [f"{len(others)} files without {ending} are left out ({first_names(others, _NAMED)})."] if others else []
    first, *rest = parts = _join_files(
        [_read_file(file, None) if ending in _TEXTS else _read_specimen(file, ending) for file in files[ending]]
    )
    if len(parts) < len(files[ending]):
        notes.append(
            f"{len(files[ending])} files are joined to {len(parts)} specimens by the first part of their names."
        )
    points, renamed = [first.points], list[str]()
    for part in rest:
        file, place = Path(part.where), {name: k for k, name in enumerate(part.landmarks)}
        if (
            place.keys() != set(first.landmarks)
            and set(own := _numbering(part)) == set(keys := _numbering(first)) != set()
        ):
            place = {label: own.index(key) for label, key in zip(first.landmarks, keys, strict=True)}
            renamed.append(file.name)
        if part.dimensions != first.dimensions or place.keys() != set(first.landmarks):
            has, expected = (f"{len(one.landmarks)} landmarks in {one.dimensions}-D" for one in (part, first))
            other = first_names(sorted(place.keys() ^ set(first.landmarks)), _NAMED)
            raise damage_error(
                file, f"it has {has} and {Path(first.where).name} has {expected}"
                f"{f' ({other} in one of them alone)' if other else ''}; give the same landmarks to all files, with NA "
                "or as undefined where one is missing"
            )  # fmt: skip
        points.append(part.points[:, [place[name] for name in first.landmarks]])
    if renamed:
        notes.append(
            f"Labels of {first_names(renamed, _NAMED)} differ from {Path(first.where).name} before the number, "
            "and are matched by number."
        )  # fmt: skip
    keys = dict.fromkeys(key for part in parts for key in part.columns)
    return replace(
        first,
        names=tuple(name for part in parts for name in part.names),
        points=np.concatenate(points),
        columns={key: tuple(c for p in parts for c in p.columns.get(key, [""] * len(p))) for key in keys},
        where=str(folder),
        notes=(*notes, *dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _numbering(part: LandmarkConfigurations) -> list[tuple[bool, str]]:
    """Return whether a landmark is on a curve, and the number in its label, such as `F-1`; empty if labels have others.

    3D Slicer calls points as their node and a number by default, and nodes of one name get `_1`, `_2` and so on.
    """
    on_curve = np.isin(np.arange(len(part.landmarks)), part.curve_sliders).tolist()
    found = [re.fullmatch(r"(.*[-_])(\d+)", label) for label in part.landmarks]
    keys = [(is_on, match[2]) for is_on, match in zip(on_curve, found, strict=True) if match]
    prefixes = {(is_on, match[1]) for is_on, match in zip(on_curve, found, strict=True) if match}
    return keys if len(keys) == len(found) and len(prefixes) == len(set(on_curve)) else []


def _join_files(parts: Sequence[LandmarkConfigurations]) -> Sequence[LandmarkConfigurations]:
    """Return one part of each specimen where the files NAME_a and NAME_b have its landmarks and its curves."""
    split = [re.split(r"[ ._-](?=[^ ._-]+$)", part.names[0], maxsplit=1) for part in parts if len(part) == 1]
    groups: dict[str, list[LandmarkConfigurations]] = {}
    for words, part in zip(split, parts, strict=False):
        groups.setdefault(words[0], []).append(part)
    kinds = {tuple(sorted(tuple(words[1:]) for words in split if words[0] == stem)) for stem in groups}
    has_curves = [bool(len(part.curve_sliders)) for part in parts]
    if len(split) < len(parts) or len(kinds) != 1 or len(groups) == len(parts) or len(set(has_curves)) == 1:
        return parts
    return [_joined(stem, sorted(own, key=lambda one: len(one.curve_sliders) > 0)) for stem, own in groups.items()]


def _joined(name: str, parts: Sequence[LandmarkConfigurations]) -> LandmarkConfigurations:
    """Return the landmarks of one specimen from several files; labels of several files get the name of their file."""
    counts = Counter(label for part in parts for label in part.landmarks)
    starts = np.cumsum([0, *(len(part.landmarks) for part in parts)]).tolist()
    return replace(
        parts[0],
        names=(name,),
        points=np.concatenate([part.points for part in parts], axis=1),
        landmarks=tuple(
            label if counts[label] == 1 else f"{part.names[0].removeprefix(name)[1:]}_{label}"
            for part in parts
            for label in part.landmarks
        ),
        curve_sliders=np.concatenate([p.curve_sliders + at for p, at in zip(parts, starts, strict=False)]),
        notes=tuple(dict.fromkeys(note for part in parts for note in part.notes)),
    )


def slider_texts(raw: LandmarkConfigurations) -> dict[str, str]:
    """Return file name -> CSV of the sliders as geomorph reads them; empty without sliders."""
    tables = {
        CURVE_SLIDERS: (("before", "slide", "after"), (raw.curve_sliders + 1).tolist()),
        SURFACE_SLIDERS: (("surface",), (raw.surface_sliders[:, None] + 1).tolist()),
    }
    return {name: table_text(header, rows) for name, (header, rows) in tables.items() if rows}


def write_configurations(path: Path | str, raw: LandmarkConfigurations, format: str | None = None) -> tuple[str, ...]:
    """Write the landmarks of many specimens, and return sentences on what the format cannot hold.

    Args:
        path: the file; a folder for the formats of `FOLDER_FORMATS`.
        raw: the landmarks; sliders are not written.
        format: one of `CONFIGURATION_FORMATS` or `FOLDER_FORMATS`; None for that of the ending of `path`.

    Raises:
        InputError: an unknown format, or one that cannot hold these landmarks.
        FileError: it cannot be written.

    Example:
        >>> ss.io.write_configurations("specimens.csv", configurations)
        ()
    """
    path = Path(path)
    if format is None:
        format = next((key for key, ending in CONFIGURATION_FORMATS.items() if path.suffix.lower() == ending), None)
    if format not in (*CONFIGURATION_FORMATS, *FOLDER_FORMATS):
        known = ", ".join((*CONFIGURATION_FORMATS, *FOLDER_FORMATS))
        problem = f"the ending {path.suffix!r} has no format" if format is None else f"there is no format {format!r}"
        raise InputError(f"Cannot write {path}: {problem}; give one of {known} with --to.")
    texts = _texts_in_folder(path, raw, format) if format in FOLDER_FORMATS else _texts(path, raw, format)
    for file, text in texts.items():
        make_folder(file.parent)
        write_text(file, text)
    notes: list[str] = []
    held = raw.columns if format in ("csv", "long", "morphoj") else _TPS_KEYS if format == "tps" else ()
    if lost := [column for column in raw.columns if column not in held]:
        notes.append(f"Columns of the table ({', '.join(lost)}) are left out, since the format {format} has none.")
    if format == "morphoj" and raw.columns:
        notes.append(f"The columns are in {list(texts)[1].name}; import it as classifier variables.")
    numbers = tuple(map(str, range(1, len(raw.landmarks) + 1)))
    if format in ("tps", "nts", "morphoj") and raw.landmarks != numbers:
        notes.append("The landmarks are numbered in their order, because the format has no names of landmarks.")
    return tuple(notes)


def _texts(path: Path, raw: LandmarkConfigurations, format: str) -> dict[Path, str]:
    if format == "tps":
        if bad := [name for name in raw.names if "\n" in name or "\r" in name]:
            raise InputError(f"{raw.where}: TPS cannot hold the specimen name {bad[0][:60]!r}; rename it.")
        # A line break would end the value.
        values = {k.upper(): [" ".join(c.split()) for c in raw.columns.get(k, [""] * len(raw))] for k in _TPS_KEYS}
        return {path: tps_text(dict(zip(raw.names, raw.points, strict=True)), values)}
    if format == "morphoj":
        table, classes = morphoj_texts(raw)
        classifiers = path.with_name(f"{path.name.removesuffix(path.suffix)}.classifiers.txt")
        return {path: table, **({classifiers: classes} if raw.columns else {})}
    return {path: {"nts": nts_text, "csv": wide_text, "long": long_text}[format](raw)}


def _texts_in_folder(folder: Path, raw: LandmarkConfigurations, format: str) -> dict[Path, str]:
    if raw.dimensions != 3:
        raise InputError(f"{raw.where}: .{format} files cannot hold 2-D landmarks; write tps, nts or csv.")
    if format == "fcsv" and not raw.observed.all():
        raise InputError(f"{raw.where}: .fcsv files cannot hold missing landmarks; write mrk.json.")
    bad = next((name for name in raw.names if re.search(r'[/\\:*?"<>|\x00-\x1f]|^\.', name)), None)
    if bad is not None:
        raise InputError(f"{raw.where}: the specimen name {bad[:60]!r} cannot name a file; rename it.")
    write = LANDMARK_FORMATS[f".{format}"].write
    marks = (dict(zip(raw.landmarks, points, strict=True)) for points in raw.points)
    return {folder / f"{name}.{format}": write(one) for name, one in zip(raw.names, marks, strict=True)}
