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
    NO_SLIDERS,
    Curve,
    LandmarkConfigurations,
    consecutive_curves,
    equal_curves,
    read_landmark_numbers,
)
from shapespace.io.landmarks.landmark_io import (
    LANDMARK_FORMATS,
    READ_ONLY_LANDMARKS,
    csv_rows,
    read_landmarks,
    slicer_curves,
)
from shapespace.io.landmarks.r_arrays import R_ENDINGS, parse_r
from shapespace.io.landmarks.tps_nts import (
    LEAST_OUTLINE,
    nts_text,
    parse_dta,
    parse_morphologika,
    parse_nts,
    parse_tps,
    tps_text,
)
from shapespace.io.meshes.vtk import LINE_NOTE, read_vtk_lines
from shapespace.io.parsing import damage_error, is_number
from shapespace.io.read_limits import LARGEST_CONFIGURATIONS_FILE_BYTES
from shapespace.io.tables.table_io import decoded_text, table_rows, table_text
from shapespace.reprs import first_names

_TEXTS = {".nts": parse_nts, ".dta": parse_dta}
_MANY = (".tps", *_TEXTS)
_SPECIMEN_OF_FILE = (r"(?P<name>.+?)(?:[ ._-](?P<kind>[^ ._-]+))?", r"(?:(?P<kind>[^ ._-]+)[ ._-])?(?P<name>.+)")
"""Names of files of one specimen: NAME_landmarks and NAME_curve, or landmarks_NAME and curve_NAME."""
_LINES = (".vtk", ".vtp")
"""Endings of files that may contain lines, which are curves, or surfaces."""
_MORPHOLOGIKA = re.compile(rb"^(?:\xef\xbb\xbf)?\s*\[\s*individuals\s*\]", re.IGNORECASE | re.MULTILINE)
_HEAD_BYTES = 2**16  # 64 KiB contain the sections before the coordinates
_TABLES = (".csv", ".txt", ".tsv", ".xlsx")
_SINGLE = tuple(sorted({*LANDMARK_FORMATS, *READ_ONLY_LANDMARKS} - {".tps"}, key=lambda ending: (-len(ending), ending)))
_MILLIMETRES = (".mrk.json", ".fcsv")
CONFIGURATION_ENDINGS = tuple(dict.fromkeys((*_MANY, *_TABLES, *R_ENDINGS, *_SINGLE, *_LINES)))
"""Endings of the files that `read_configurations` reads."""
_TPS_KEYS = ("image", "comment")
"""Columns for which TPS has keys."""
RECORD = "align.json"
"""File with the settings in a folder that `align` wrote, whose coordinates are already aligned."""
CURVE_SLIDERS, SURFACE_SLIDERS = "curveslide.csv", "surfslide.csv"
"""Files with the numbers of semilandmarks, from 1, as in geomorph: before, slide, after; and those of surfaces."""

CONFIGURATION_FORMATS: Mapping[str, str] = MappingProxyType(
    {"tps": ".tps", "nts": ".nts", "morphoj": ".txt", "csv": ".csv", "long": ".csv"}
)
"""Format -> ending of files of all specimens; `csv` is wide, a row for each specimen."""
FOLDER_FORMATS = ("mrk.json", "fcsv")
"""Formats, which are endings, of folders with a file for each specimen."""


def read_configurations(
    path: Path | str,
    *,
    name: str | None = None,
    sliders: Sequence[Path] = (),
    curve_points: int | None = None,
    dimensions: int | None = None,
) -> LandmarkConfigurations:
    """Read the landmarks of many specimens, missing ones as not-a-number.

    Formats: TPS with curves, outlines and scale, NTS, IDAV Landmark (.dta), Morphologika (.txt), wide and long tables
    (CSV, Excel), MorphoJ tables (.txt), arrays of R (.rda, .RData, .rds), and folders with a file for each specimen in
    any format of `read_landmarks`, TPS, NTS, or lines of VTK (.vtk, .vtp). Points of curves are semilandmarks; curves
    with other numbers of points are resampled at equal distances. Values that are scaled, omitted or interpreted as
    missing are listed in the notes.

    Args:
        path: path of the file or folder.
        name: name of the array, for R files with several.
        sliders: paths of tables of semilandmarks as in geomorph: before, slide, after; or surface points only. Each
            replaces those in `path`.
        curve_points: number of points to which each curve is resampled; None for the smallest number among the
            specimens, at most 100, if they differ.
        dimensions: dimension of the space, 2 or 3, for a MorphoJ table whose number of coordinates fits both.

    Raises:
        FileError: it cannot be read, or is too long.
        FileFormatError: it is damaged, is in none of the formats, or its specimens have different landmarks.
        InputError: two specimens have one name.
        ShapespaceError: the extra `r`, which R files need, is not installed.

    Example:
        >>> _ = ss.io.write_configurations("landmarks.tps", configurations)
        >>> ss.io.read_configurations("landmarks.tps").points.shape
        (6, 10, 3)
    """
    path = Path(path)
    if curve_points is not None and curve_points < LEAST_OUTLINE:
        raise InputError(
            f"A curve of {curve_points} points has no shape; give {LEAST_OUTLINE} or more with --curve-points."
        )
    if dimensions not in (None, 2, 3):
        raise InputError(f"Landmarks have 2 or 3 dimensions, not {dimensions}; correct --dimensions.")
    raw = _read_folder(path, curve_points) if path.is_dir() else _read_file(path, name, curve_points, dimensions)
    if dimensions not in (None, raw.dimensions):
        raise InputError(f"{path} has landmarks in {raw.dimensions}-D; omit --dimensions {dimensions}.")
    for file in sliders:
        form = "before, slide, after, or one landmark on the surface,"
        numbers = read_landmark_numbers(file, raw.landmarks, (1, 3), form) - 1
        is_surface = numbers.shape[1] == 1
        changed = {"surface_sliders": numbers[:, 0]} if is_surface else {"curve_sliders": numbers, "curves": ()}
        raw = replace(raw, **changed)
    note = f"{len(raw.curve_sliders)} points of {len(raw.curves)} curve{'s' * (len(raw.curves) > 1)} are semilandmarks."
    return replace(raw, notes=(*raw.notes, note)) if raw.curves else raw


def _read_file(
    path: Path, name: str | None, curve_points: int | None = None, dimensions: int | None = None
) -> LandmarkConfigurations:
    suffix = path.suffix.lower()
    single = next((ending for ending in (*_SINGLE, *_LINES) if path.name.lower().endswith(ending)), None)
    if not (suffix in (*_MANY, *_TABLES, *R_ENDINGS) or single):
        endings = ", ".join(CONFIGURATION_ENDINGS)
        raise damage_error(path, f"the ending {suffix!r} is not that of a landmark file ({endings})")
    data = read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES)
    if not data.strip():
        raise damage_error(path, "it is empty; export or copy it again")
    if suffix in R_ENDINGS:
        return parse_r(data, path, name)
    if name is not None:
        raise InputError(f"{path} is not an R file, whose arrays have names; omit --object.")
    is_morphologika = _is_morphologika(data)
    if suffix in _MANY or is_morphologika or re.match(rb"\s*LM3?\s*=", data, re.IGNORECASE):
        try:
            text = decoded_text(data)
        except ValueError as error:
            raise FileFormatError(f"{path} {error}; export it again.") from error
        if is_morphologika:
            return parse_morphologika(text, path)
        return _TEXTS[suffix](text, path) if suffix in _TEXTS else parse_tps(text, path, curve_points)
    kind = _header_kind(data) if suffix in _TABLES else "single"
    if single is None or kind in ("wide", "long") or (suffix == ".csv" and kind != "single"):
        return parse_table(data, path, dimensions)
    [raw] = _with_equal_curves([_read_specimen(path, single)], path, curve_points)
    return raw


def is_configurations(path: Path | str) -> bool:
    """Return whether a path contains landmarks of many specimens, by its ending, header, or the files in a folder."""
    path = Path(path)
    if path.is_dir():
        names = [file.name.lower() for file in path.iterdir()]
        lines = min((file for file in path.iterdir() if file.suffix.lower() in _LINES), default=None)
        has_landmarks = any(n.endswith((*_MANY, *_SINGLE)) for n in names) or (lines is not None and is_lines(lines))
        return has_landmarks and not any(n.endswith(".fit.json") for n in names)
    if path.suffix.lower() not in _TABLES:
        return path.is_file() and (path.suffix.lower() in (*_MANY, *R_ENDINGS) or is_lines(path))
    try:
        data = read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES)
        return _is_morphologika(data) or _header_kind(data) in ("wide", "long")
    except ShapespaceError:
        return False


def is_lines(path: Path) -> bool:
    """Return whether a file is VTK with lines and no surface, which are curves."""
    if path.suffix.lower() not in _LINES:
        return False
    try:
        mesh, lines = read_vtk_lines(read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES), path)
    except ShapespaceError:
        return False
    return mesh.faces is None and bool(lines)


def _is_morphologika(data: bytes) -> bool:
    return _MORPHOLOGIKA.search(data[:_HEAD_BYTES]) is not None


def _header_kind(data: bytes) -> str:
    try:
        return header_kind(next(table_rows(data), list[str]()))
    except ValueError:
        return ""


def _read_specimen(path: Path, ending: str) -> LandmarkConfigurations:
    curves, notes = tuple[Curve, ...](), list[str]()
    data = read_bytes(path, LARGEST_CONFIGURATIONS_FILE_BYTES)
    if ending in _LINES:
        mesh, lines = read_vtk_lines(data, path)
        if not lines:
            raise damage_error(path, "it has no lines, which would be curves; give landmarks, or use a command "
                               "for surfaces")  # fmt: skip
        points, labels = mesh.vertices[[k for line, _ in lines for k in line]], ()
        curves = consecutive_curves(0, [line for line, _ in lines], [closed for _, closed in lines])
        notes += [note for note in mesh.notes if note != LINE_NOTE]
    else:
        named = read_landmarks(path, keep_absent=True)
        points, labels = np.array(list(named.values())), tuple(named)
        if ending == ".mrk.json":
            number = {label: k for k, label in enumerate(labels)}
            found = slicer_curves(data, path)
            curves = tuple((tuple(number[label] for label in own), closed) for own, closed in found if own)
        if all(re.fullmatch(r"point_\d+", label) for label in labels):
            labels = ()
    return LandmarkConfigurations(
        names=(path.name[: -len(ending)].removesuffix(".landmarks"),),
        points=points[None],
        landmarks=labels,
        unit="mm" if ending in _MILLIMETRES else "",
        curves=curves,
        where=str(path),
        notes=tuple(notes),
    )


def _is_other_table(file: Path) -> bool:
    """Return whether the first line of a CSV file indicates other data than landmarks, such as covariates."""
    row = next(iter(csv_rows(read_bytes(file, LARGEST_CONFIGURATIONS_FILE_BYTES), file)), list[str]())
    return bool(row) and not header_kind(row) and not any(map(is_number, row[1:4]))


def _read_folder(folder: Path, curve_points: int | None) -> LandmarkConfigurations:
    """Return the landmarks in the files of the most frequent ending, in the order of the first file."""
    if (folder / RECORD).is_file():
        raise InputError(
            f"{folder} is a folder that align wrote; give the original landmark file, or write its shapes "
            "to a landmark file with shapespace export."
        )
    endings = (*_MANY, *_SINGLE, *_LINES)
    files: dict[str, list[Path]] = {}
    for file in sorted(folder.iterdir()):
        ending = next((ending for ending in endings if file.name.lower().endswith(ending)), None)
        if ending is not None and file.is_file() and not file.name.endswith((CURVE_SLIDERS, SURFACE_SLIDERS)):
            files.setdefault(ending, []).append(file)
    if all(ending == ".csv" and all(map(_is_other_table, listed)) for ending, listed in files.items()):
        raise damage_error(folder, f"it has no landmark files, which end with {', '.join(endings)} (.csv: name,x,y,z)")
    # VTK files are surfaces if there are other files. Among equally frequent endings, markups of Slicer are preferred,
    # because they mark missing landmarks.
    ending = max(files, key=lambda end: (end not in _LINES, len(files[end]), end == ".mrk.json"))
    others = [file.name for other, listed in files.items() if other != ending for file in listed]
    notes = [f"Files without {ending} are skipped: {first_names(others)}."] if others else []
    parts = _join_files(
        [_read_file(file, None) if ending in _MANY else _read_specimen(file, ending) for file in files[ending]]
    )
    if len(parts) < len(files[ending]):
        notes.append(f"{len(files[ending])} files are joined to {len(parts)} specimens by their names.")
    labelled = [_with_labels_of(parts[0], part) for part in parts]
    if renamed := [Path(old.where).name for old, new in zip(parts, labelled, strict=True) if new is not old]:
        notes.append(
            f"Labels of {first_names(renamed)} differ from {Path(parts[0].where).name} before the number, and "
            "are matched by number; lists and curves by their order."
        )
    parts = labelled
    first, *rest = parts = _with_equal_curves(parts, folder, curve_points)
    points = [first.points]
    for part in rest:
        file, place = Path(part.where), {name: k for k, name in enumerate(part.landmarks)}
        if part.dimensions != first.dimensions or place.keys() != set(first.landmarks):
            has, expected = (f"{len(config.landmarks)} landmarks in {config.dimensions}-D" for config in (part, first))
            other = first_names(sorted(place.keys() ^ set(first.landmarks)))
            raise damage_error(
                file, f"it has {has} and {Path(first.where).name} has {expected}"
                f"{f' ({other} in only one file)' if other else ''}; give the same landmarks to all files, with NA "
                "or as undefined if one is missing"
            )  # fmt: skip
        points.append(part.points[:, [place[name] for name in first.landmarks]])
    keys = dict.fromkeys(key for part in parts for key in part.columns)
    return replace(
        first,
        names=tuple(name for part in parts for name in part.names),
        points=np.concatenate(points),
        columns={key: tuple(c for p in parts for c in p.columns.get(key, [""] * len(p))) for key in keys},
        where=str(folder),
        notes=(*notes, *dict.fromkeys(note for part in parts for note in part.notes)),
    )


def _prefixes(part: LandmarkConfigurations) -> dict[int, tuple[int, str, str]]:
    """Return landmark -> curve (-1 for none), and prefix and number of its label, such as `F-1`."""
    curve = {point: k for k, (points, _) in enumerate(part.curves) for point in points}
    found = {k: re.fullmatch(r"(|.*[-_ ])(\d+)", label) for k, label in enumerate(part.landmarks)}
    return {k: (curve.get(k, -1), match[1], match[2]) for k, match in found.items() if match}


def _with_labels_of(first: LandmarkConfigurations, part: LandmarkConfigurations) -> LandmarkConfigurations:
    """Return a part with the labels of the first part if they differ only in the prefix before the number.

    By default, 3D Slicer names points by their node and a number, and appends `_1`, `_2` and so on to nodes of the same
    name. Lists and curves are matched by their order.
    """
    theirs, own = (
        sorted(
            dict.fromkeys((curve, prefix) for curve, prefix, _ in _prefixes(source).values()), key=lambda key: key[0]
        )
        for source in (first, part)
    )
    new = {key: prefix for key, (_, prefix) in zip(own, theirs, strict=False) if key[1] != prefix}
    is_shared = {prefix for _, prefix in new} & {prefix for _, prefix in theirs}
    if not new or is_shared or [curve for curve, _ in own] != [curve for curve, _ in theirs]:
        return part
    labels = {k: f"{new[curve, prefix]}{number}" for k, (curve, prefix, number) in _prefixes(part).items()
              if (curve, prefix) in new}  # fmt: skip
    renamed = tuple(labels.get(k, label) for k, label in enumerate(part.landmarks))
    return replace(part, landmarks=renamed)


def _with_equal_curves(
    parts: Sequence[LandmarkConfigurations], path: Path, count: int | None
) -> list[LandmarkConfigurations]:
    """Return parts whose curves have equal numbers of points, `count` if given, and follow the other landmarks."""
    names = [[re.sub(r"\d+$", "", part.landmarks[points[0]]) for points, _ in part.curves] for part in parts]
    curves = list[Sequence[Curve]]()
    for part, own in zip(parts, names, strict=True):
        # Curves with the same names may be in different order.
        rank = [names[0].index(name) if set(own) == set(names[0]) else 0 for name in own]
        curves.append([part.curves[int(k)] for k in np.argsort(rank, kind="stable")])
    closed = [is_closed for _, is_closed in curves[0]]
    if not closed or any([is_closed for _, is_closed in own] != closed for own in curves):
        return list(parts)
    given = [[x[list(at)] for at, _ in own] for part, own in zip(parts, curves, strict=True) for x in part.points]
    specimens = [name for part in parts for name in part.names]
    made, notes = equal_curves(given, closed, specimens, path, count)
    if [list(map(len, own)) for own in made] == [list(map(len, own)) for own in given]:
        return list(parts)
    at, out = 0, list[LandmarkConfigurations]()
    for part in parts:
        fixed = sorted(set(range(len(part.landmarks))) - {point for own, _ in part.curves for point in own})
        points = [np.concatenate([x[fixed], *own]) for x, own in zip(part.points, made[at:], strict=False)]
        at += len(part)
        labels = [f"{name}{k + 1}" for name, own in zip(names[0], made[0], strict=True) for k in range(len(own))]
        is_numbered = all(label.isdecimal() for label in part.landmarks)
        out.append(replace(
            part, points=np.array(points), curves=consecutive_curves(len(fixed), made[0], closed),
            landmarks=() if is_numbered else (*(part.landmarks[k] for k in fixed), *labels),
            curve_sliders=NO_SLIDERS, notes=(*part.notes, *notes),
        ))  # fmt: skip
    return out


def _join_files(parts: Sequence[LandmarkConfigurations]) -> Sequence[LandmarkConfigurations]:
    """Return one part per specimen; files such as NAME_a and NAME_b with its landmarks and its curves are joined."""
    points = sorted((re.escape(part.names[0]) for part in parts if not part.curves), key=len, reverse=True)
    own_names = rf"(?P<name>{'|'.join(points)})(?:[ ._-](?P<kind>.+))?"
    for pattern in (own_names, *_SPECIMEN_OF_FILE) if all(len(part) == 1 for part in parts) else ():
        kinds, groups = dict[str, list[str | None]](), dict[str, list[LandmarkConfigurations]]()
        for part in parts:
            if match := re.fullmatch(pattern, part.names[0]):
                kinds.setdefault(match["name"], []).append(match["kind"])
                groups.setdefault(match["name"], []).append(part)
        is_mixed = all({bool(part.curves) for part in own} == {True, False} for own in groups.values())
        is_complete = sum(map(len, groups.values())) == len(parts)
        if is_mixed and is_complete and len({frozenset(own) for own in kinds.values()}) == 1:
            return [_join_parts(name, sorted(own, key=lambda part: bool(part.curves))) for name, own in groups.items()]
    return parts


def _join_parts(name: str, parts: Sequence[LandmarkConfigurations]) -> LandmarkConfigurations:
    """Return the landmarks of one specimen from several files; labels that occur in several files get a file prefix."""
    counts = Counter(label for part in parts for label in part.landmarks)
    starts = np.cumsum([0, *(len(part.landmarks) for part in parts)]).tolist()
    return replace(
        parts[0],
        names=(name,),
        points=np.concatenate([part.points for part in parts], axis=1),
        landmarks=tuple(
            label if counts[label] == 1 else f"{part.names[0].replace(name, '').strip(' ._-')}_{label}"
            for part in parts
            for label in part.landmarks
        ),
        curves=tuple(
            (tuple(point + at for point in points), closed)
            for part, at in zip(parts, starts, strict=False)
            for points, closed in part.curves
        ),
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
    """Write the landmarks of many specimens, and return notes on data that the format cannot store.

    Args:
        path: path of the file, or of a folder for the formats of `FOLDER_FORMATS`.
        raw: landmarks of the specimens; sliders are not written.
        format: one of `CONFIGURATION_FORMATS` or `FOLDER_FORMATS`; None for the format of the ending of `path`.

    Raises:
        InputError: the format is unknown, or cannot store these landmarks.
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
        notes.append(f"Columns of the table ({', '.join(lost)}) are omitted, since the format {format} has no columns.")
    if format == "morphoj" and raw.columns:
        notes.append(f"The columns are in {list(texts)[1].name}; import it as classifier variables.")
    numbers = tuple(map(str, range(1, len(raw.landmarks) + 1)))
    if format in ("tps", "nts", "morphoj") and raw.landmarks != numbers:
        notes.append("The landmarks are numbered in their order, because the format has no names of landmarks.")
    return tuple(notes)


def _texts(path: Path, raw: LandmarkConfigurations, format: str) -> dict[Path, str]:
    if format == "tps":
        if bad := [name for name in raw.names if "\n" in name or "\r" in name]:
            raise InputError(f"{raw.where}: TPS cannot store the specimen name {bad[0][:60]!r}; rename it.")
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
        raise InputError(f"{raw.where}: .{format} files cannot store 2-D landmarks; write tps, nts or csv.")
    if format == "fcsv" and not raw.observed.all():
        raise InputError(f"{raw.where}: .fcsv files cannot store missing landmarks; write mrk.json.")
    bad = next((name for name in raw.names if re.search(r'[/\\:*?"<>|\x00-\x1f]|^\.', name)), None)
    if bad is not None:
        raise InputError(f"{raw.where}: the specimen name {bad[:60]!r} is not a valid file name; rename it.")
    write = LANDMARK_FORMATS[f".{format}"].write
    specimens = (dict(zip(raw.landmarks, points, strict=True)) for points in raw.points)
    return {folder / f"{name}.{format}": write(landmarks) for name, landmarks in zip(raw.names, specimens, strict=True)}
