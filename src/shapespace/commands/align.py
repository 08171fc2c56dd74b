"""Command `align`: align, check and write the landmarks of many specimens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from shapespace.cohort.landmark_cohort import join_table, write_aligned
from shapespace.cohort.orientation import find_orientation
from shapespace.cohort.table import Table, list_names, refuse_repeated
from shapespace.commands.landmark_data import find_other_scales
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.landmark_alignment import (
    AlignConfig,
    AlignedLandmarks,
    align_landmarks,
    find_outliers,
    with_criterion,
)
from shapespace.io.files import make_folder, write_text
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.tables.table_io import key_column, read_rows
from shapespace.report.analyses.analysis_report import METHODS_FILE
from shapespace.report.analyses.methods_section import alignment_text
from shapespace.schemas import AlignFinding, AlignRecord, Orientation, json_text, to_json
from shapespace.version import __version__


def align(
    data: Path,
    folder: Path,
    config: AlignConfig | None = None,
    *,
    table: Path | None = None,
    sliders: Sequence[Path] = (),
    separate: Path | None = None,
    reflect: tuple[str, str] | None = None,
    curve_points: int | None = None,
    dimensions: int | None = None,
) -> tuple[AlignedLandmarks, AlignRecord]:
    """Align the landmarks of many specimens, name specimens to check, and write all to a folder.

    links.csv and orientation.json next to the data become orientation.json in the folder, for its figures. Without
    links, figures draw the curves.

    Args:
        data: landmark file, or folder of landmark files.
        folder: output folder.
        config: options; None for the defaults.
        table: covariates, with a row for each specimen.
        sliders: files of semilandmarks: rows of before, slide, after for curves; a single column for surfaces.
        separate: table of landmark and structure, for structures that are aligned separately.
        reflect: column and value of specimens that are reflected before the alignment, such as left sides.
        curve_points: points of each curve or outline, at equal distances (default: as in the file if all specimens
            have the same number, else their least number; of outlines at most 100)
        dimensions: 2 or 3, of raw coordinates of MorphoJ whose number fits both (default: by their number)

    Raises:
        FileError: something cannot be read or written.
        FileFormatError: something is damaged.
        InputError: landmarks that cannot be aligned.
    """
    raw = read_configurations(data, sliders=sliders, curve_points=curve_points, dimensions=dimensions)
    config = with_criterion(config or AlignConfig(), raw)
    if separate is not None:
        config = replace(config, structures=_read_structures(separate))
    if table is not None:
        _, covariates, notes = join_table(raw.names, raw.columns, table, raw.where, keep_unmatched=True)
        raw = replace(raw, columns=covariates.columns, notes=(*raw.notes, *notes))
    if reflect is not None:
        raw = _reflect_specimens(raw, *reflect)
    orientation = find_orientation(None, [data if data.is_dir() else data.parent], raw.landmarks, raw.curve_links)
    aligned = align_landmarks(raw, config)
    findings = find_outliers(aligned)
    record = AlignRecord(
        source=str(data),
        specimens=len(aligned),
        landmarks=len(aligned.landmarks),
        dimensions=2 if aligned.dimensions == 2 else 3,
        unit="mm" if aligned.unit == "mm" else "",
        gauge=aligned.gauge,
        tangent=aligned.tangent,
        settings=to_json({**asdict(config), "reflect": reflect, "curves": len(raw.curves),
                          "curve_semilandmarks": len(raw.curve_sliders),
                          "surface_semilandmarks": len(raw.surface_sliders)}),
        estimated=int(aligned.estimated.sum()),
        iterations=aligned.iterations,
        converged=aligned.converged,
        findings=tuple(AlignFinding(**asdict(finding)) for finding in findings),
        notes=(*aligned.notes, *map(str, findings), *find_other_scales(raw)),
        version=__version__,
    )  # fmt: skip
    write_text(make_folder(folder) / METHODS_FILE, alignment_text(record))
    if orientation is not None:
        write_text(folder / Orientation.FILE, json_text(orientation))
    write_aligned(folder, aligned, record)
    return aligned, record


def _reflect_specimens(raw: LandmarkConfigurations, column: str, value: str) -> LandmarkConfigurations:
    cells = Table(raw.columns, raw.names, raw.where).texts(column)
    rows = [k for k, cell in enumerate(cells) if cell == value]
    if not all(cells):
        missing = list_names([name for name, cell in zip(raw.names, cells, strict=True) if not cell])
        raise InputError(f"{raw.where}: {column} of {missing} is missing; fill it in, as --reflect needs it of all.")
    if not rows:
        raise InputError(f"{raw.where}: no specimen has {column} {value}; correct --reflect.")
    points = raw.points.copy()
    points[rows, :, 0] *= -1.0
    note = f"{len(rows)} of {len(raw)} specimens are reflected, those with {column} {value}."
    return replace(raw, points=points, notes=(*raw.notes, note))


def _read_structures(path: Path) -> dict[str, str]:
    header, *rows = read_rows(path)
    landmark, structure = (key_column(header, (name,)) for name in ("landmark", "structure"))
    if landmark is None or structure is None:
        raise FileFormatError(f"{path} has no columns landmark and structure; write one row for each landmark.")
    names = [row[landmark] for row in rows]
    refuse_repeated(path, names, names, "landmark")
    return {row[landmark]: row[structure] for row in rows}
