"""Cohorts of landmarks: read from landmark files and folders that `align` wrote, or taken from surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapespace.cohort.cohort import Cohort, padded
from shapespace.cohort.table import Table, list_names, match_rows, name_key, numbers_as_text, read_table
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.landmark_alignment import AlignConfig, AlignedLandmarks, align_landmarks, match_curves
from shapespace.geometry.procrustes import Gauge, centroid_size
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import make_folder, write_text
from shapespace.io.landmarks.configuration_io import (
    RECORD,
    is_configurations,
    is_lines,
    read_configurations,
    write_configurations,
)
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, ending_of, stem_of
from shapespace.io.tables.table_io import read_rows, write_rows
from shapespace.schemas import AlignRecord, json_text, read
from shapespace.types import FloatArray

ALIGNED, MEAN, ESTIMATED = "aligned.csv", "mean.csv", "estimated.csv"
"""Files of a folder that `align` wrote next to `RECORD`: coordinates, mean, and the landmarks that are estimates."""
SIZE = "centroid_size"
"""Column of `ALIGNED` with centroid sizes in the unit of the file."""
_AGAIN = "run shapespace align again"


def has_landmarks(path: Path) -> bool:
    """Return whether a path is a landmark file, a folder of such files without meshes, or one that `align` wrote."""
    if not path.is_dir() or (path / RECORD).is_file():
        return path.is_dir() or is_configurations(path)
    return is_configurations(path) and all(map(is_lines, (f for f in path.iterdir() if ending_of(f) in MESH_ENDINGS)))


def write_aligned(folder: Path, aligned: AlignedLandmarks, record: AlignRecord) -> None:
    """Write aligned landmarks to a folder, `RECORD` last.

    Raises:
        FileError: the folder cannot be written.
    """
    make_folder(folder)
    columns = {**aligned.columns, SIZE: numbers_as_text(aligned.sizes)}
    table = LandmarkConfigurations(
        names=aligned.names, points=aligned.coords, landmarks=aligned.landmarks, columns=columns
    )
    write_configurations(folder / ALIGNED, table, "csv")
    axes = ("x", "y", "z")[: aligned.dimensions]
    mean = [(name, *map(float, row)) for name, row in zip(aligned.landmarks, aligned.mean, strict=True)]
    write_rows(folder / MEAN, ("landmark", *axes), mean)
    estimates = [(aligned.names[i], aligned.landmarks[j]) for i, j in np.argwhere(aligned.estimated).tolist()]
    write_rows(folder / ESTIMATED, ("specimen", "landmark"), estimates)
    write_text(folder / RECORD, json_text(record))


def read_aligned(folder: Path) -> AlignedLandmarks:
    """Return aligned landmarks from a folder that `align` wrote.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: a file is damaged.
    """
    record = read(AlignRecord, read_json(folder / RECORD, _AGAIN), str(folder / RECORD), _AGAIN)
    table = read_configurations(folder / ALIGNED)
    sizes = Table(table.columns, table.names, str(folder / ALIGNED)).numbers(SIZE)
    row = {name: k for k, name in enumerate(table.names)}
    column = {name: k for k, name in enumerate(table.landmarks)}
    estimated = np.zeros(table.points.shape[:2], dtype=np.bool_)
    try:
        for specimen, landmark in read_rows(folder / ESTIMATED)[1:]:
            if specimen in row:
                estimated[row[specimen], column[landmark]] = True
    except (ValueError, KeyError) as error:
        raise FileFormatError(f"{folder / ESTIMATED} is damaged; {_AGAIN}.") from error
    if np.isnan(table.points).any() or np.isnan(sizes).any():
        raise FileFormatError(f"{folder / ALIGNED} lacks coordinates or sizes; {_AGAIN}.")
    return AlignedLandmarks(
        names=table.names,
        landmarks=table.landmarks,
        coords=table.points,
        sizes=sizes,
        estimated=estimated,
        columns={name: cells for name, cells in table.columns.items() if name != SIZE},
        gauge=record.gauge,
        tangent=record.tangent,
        unit=record.unit,
        iterations=record.iterations,
        converged=record.converged,
        where=str(folder),
        notes=_notes(folder, record),
    )


def _notes(folder: Path, record: AlignRecord) -> tuple[str, ...]:
    """Return one sentence on specimens to check, estimated landmarks and convergence; `align` printed them in full."""
    counts = (("specimen", " to check", len(record.findings)), ("estimated landmark", "", record.estimated))
    facts = [f"{count} {noun}{'s' * (count != 1)}{rest}" for noun, rest, count in counts if count]
    facts += [] if record.converged else ["an alignment that has not converged"]
    return (f"{folder}: {', '.join(facts)} (see {RECORD}).",) if facts else ()


def read_landmark_cohort(
    path: Path, table: Path | Table | None, gauge: Gauge, onto: Cohort | None = None, least: int = 2
) -> Cohort:
    """Return the cohort of a landmark file, aligned by default options, or of a folder that `align` wrote.

    Args:
        path: file or folder.
        table: table of covariates, whose key column names the specimens; None for the columns of the file.
        gauge: size handling, `shape` or `form`.
        onto: cohort to whose mean the specimens are aligned; there may then be a single specimen.
        least: smallest number of specimens, if `onto` is None.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: a file is damaged.
        InputError: specimens that cannot be aligned, or too few specimens in the table.
    """
    source = read_aligned(path) if (path / RECORD).is_file() else read_configurations(path)
    rows, covariates, notes = join_table(source.names, source.columns, table, str(path))
    least = least if onto is None else 1
    if len(rows) < least:
        raise InputError(f"{path}: {len(rows)} specimen{'s' * (len(rows) != 1)} can be used, and {least} are needed.")
    if isinstance(source, AlignedLandmarks):
        if onto is not None:
            coords = np.where(source.estimated[..., None], np.nan, source.forms)[rows]
            return _align_onto(coords, source.landmarks, covariates, onto, notes, source.sizes[rows])
        cohort = Cohort.of_landmarks(source, gauge=gauge).take(rows)
        return replace(cohort, table=covariates, notes=(*notes, *cohort.notes))
    raw = replace(source, names=covariates.rows, points=source.points[rows], columns={})
    if onto is not None:
        mean = onto.vertices(onto.coefficients.mean(axis=0))[:, : onto.dimensions]
        raw = match_curves(raw, mean) if raw.points.shape[1:] == mean.shape else raw
        return _align_onto(raw.points, raw.landmarks, covariates, onto, [*raw.notes, *notes])
    cohort = Cohort.of_landmarks(align_landmarks(raw, AlignConfig(gauge=gauge)), covariates)
    note = "The landmarks are aligned by generalised Procrustes analysis with default options."
    return replace(cohort, notes=(*notes, note, *cohort.notes))


def _align_onto(
    coords: FloatArray, landmarks: Sequence[str], table: Table, onto: Cohort, notes: Sequence[str],
    sizes: FloatArray | None = None,
) -> Cohort:  # fmt: skip
    """Return the cohort of landmarks (N, L, D), of any order if they have names, in the pose of the mean of another."""
    if coords.shape[2] != onto.dimensions:
        raise InputError(
            f"{table.where}: {coords.shape[2]}-D landmarks cannot be compared with {onto.dimensions}-D ones."
        )
    known = () if onto.landmarks is None else onto.landmarks.names
    numbers = set(map(str, range(1, len(landmarks) + 1)))
    if known and numbers not in (set(known), set(landmarks)):
        if other := sorted({*known} ^ {*landmarks}):
            raise InputError(
                f"{table.where}: the landmarks are not those of the shapes to compare with ({list_names(other)}); give "
                "both the same landmarks."
            )
        coords = coords[:, [list(landmarks).index(name) for name in known]]
    cohort = Cohort.of_shapes(padded(coords), {}, names=table.rows, onto=onto, unit=onto.unit)
    return replace(
        cohort,
        table=table,
        source=onto.source,
        landmarks=onto.landmarks,
        sizes_mm=cohort.sizes_mm if sizes is None else sizes,
        notes=(*notes, *cohort.notes),
    )


def landmark_cohort(cohort: Cohort, onto: Cohort | None = None) -> Cohort:
    """Return the cohort of the landmarks on the surfaces of a cohort, aligned without the surfaces.

    Args:
        cohort: cohort of surfaces with `landmarks`; landmarks between unobserved vertices are marked as estimated.
        onto: cohort of landmarks, to whose mean they are aligned; None aligns them to each other.

    Raises:
        InputError: surfaces without landmarks, or with fewer than three.
    """
    marks = cohort.landmarks
    if cohort.source.kind == "landmarks":
        return cohort
    if marks is None or not len(marks):
        raise InputError(
            f"{cohort.table.where}: no landmarks are known on these surfaces; give the folder that landmarks transfer "
            "wrote as --shapes, or use a model or a folder of correspond with landmarks.csv."
        )
    coords = np.stack([marks.interpolate(cohort.vertices(k)) for k in range(len(cohort))])
    surface = np.array([centroid_size(cohort.vertices(k)) for k in range(len(cohort))])
    scale = np.where(np.isfinite(cohort.sizes_mm), cohort.sizes_mm / surface, 1.0)
    coords = coords * scale[:, None, None]
    if onto is not None:
        return _align_onto(coords, marks.names, cohort.table, onto, cohort.notes)
    names = tuple(marks.names)
    configurations = LandmarkConfigurations(
        names=cohort.names, points=coords, landmarks=names, unit=cohort.unit, where=cohort.table.where
    )
    aligned = align_landmarks(configurations, AlignConfig(gauge=cohort.gauge))
    if cohort.observed is not None:
        unseen = np.logical_and(~cohort.observed[:, marks.corners], marks.barycentric > 0).any(axis=2)
        aligned = replace(aligned, estimated=unseen)
    note = f"The analysis is of {len(names)} landmarks on the surfaces, aligned without the surfaces."
    return replace(Cohort.of_landmarks(aligned, cohort.table), notes=(*cohort.notes, note))


def join_table(
    names: Sequence[str],
    columns: Mapping[str, tuple[str, ...]],
    table: Path | Table | None,
    where: str,
    *,
    keep_unmatched: bool = False,
) -> tuple[list[int], Table, list[str]]:
    """Return specimens, their covariates from the landmark file and a table, and notes on those without a row.

    Args:
        names: names of the specimens.
        columns: covariates in the landmark file.
        table: table of further covariates, whose key column names the specimens; None for none.
        where: name of the specimens in messages.
        keep_unmatched: whether to keep specimens without a row, with empty cells, in the order of `names`; otherwise
            specimens are sorted by name.

    Raises:
        InputError: no row is of a specimen.
    """
    own = Table(columns, tuple(names), where)
    every = range(len(names)) if keep_unmatched else sorted(range(len(names)), key=lambda k: name_key(names[k]))
    if table is None:
        return list(every), own.take(every), []
    given = table if isinstance(table, Table) else read_table(table)
    matched, notes = match_rows(
        given, [(name, stem_of(name)) for name in names], where, remedy="name the specimens alike"
    )
    row = {number: k for k, number in matched.items()}
    rows = [k for k in every if keep_unmatched or k in row]
    joined = {name: tuple(cells[row[k]] if k in row else "" for k in rows) for name, cells in given.columns.items()}
    return rows, Table({**own.take(rows).columns, **joined}, tuple(names[k] for k in rows), given.where), notes
