"""Command `landmarks`: landmarks of marked specimens transferred to all scans of a correspondence, and checked."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from shapespace.batch.fit_work import FitJob
from shapespace.batch.progress import progress
from shapespace.commands.inputs import Given, LandmarkFiles
from shapespace.commands.outcome import LISTED, Outcome, first_lines
from shapespace.correspondence.landmark_transfer import LandmarkCheck, MarkedSpecimens, TransferredLandmarks
from shapespace.correspondence.semilandmarks import Semilandmarks, SemilandmarkSet
from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.geometry.landmark_placement import landmarks_in_frame_of, place_landmarks
from shapespace.geometry.normals import rms_size
from shapespace.io.files import make_folder, write_text
from shapespace.io.landmarks.configuration_io import CURVE_SLIDERS, SURFACE_SLIDERS
from shapespace.io.landmarks.landmark_io import point_texts, read_landmarks, surface_landmark_cells
from shapespace.io.landmarks.tps_nts import tps_text
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.remote import is_address
from shapespace.io.tables.table_io import read_rows, table_text, write_rows
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, read
from shapespace.store.corresponding import RECORD, SUMMARY, json_of, surface_files, surface_stem
from shapespace.store.results import mesh_at
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks

TPS = "landmarks.tps"
"""File in the output folder with the landmarks of all scans."""
_SET_COLUMNS, _THEN = ("name", "kind", "along", "points"), ">"
"""Columns of a table of curves and patches, and the character between the names along one."""
_SAME_MARK = 0.01
"""Share of the specimen's size: two files with landmarks of one specimen that differ more contradict each other."""
Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class _Correspondence:
    """A folder of `correspond`, its specimens, and the landmark files that belong to them."""

    folder: Path
    summary: CorrespondenceRecord
    specimens: MarkedSpecimens
    given: Mapping[str, Mapping[str, FloatArray]]


def transfer_landmarks(
    marked: Path, scans: Path, output: Path, semilandmarks: Path | None = None, *, quiet: bool = False, say: Say
) -> Outcome:
    """Write the landmarks of all scans of a correspondence, predicted from those of marked specimens.

    Each scan gets NAME.landmarks.csv, .mrk.json and .fcsv; `TPS` has those of all, `CURVE_SLIDERS` and
    `SURFACE_SLIDERS` which of them are semilandmarks.

    Args:
        marked: folder of landmark files with the names of the scans.
        scans: folder that `correspond` wrote.
        output: output folder.
        semilandmarks: table of curves and patches for evenly spaced semilandmarks: name, kind (curve or patch), along
            (names of landmarks along the curve, with > between them; of landmarks and curves around the patch, which
            end where they begin), points
        quiet: show no progress.
        say: called with each message.

    Raises:
        InputError: no correspondence, no usable landmarks, or landmarks that contradict each other.
        FileError: something cannot be read or written.
    """
    same = _open_correspondence(scans, marked, say)
    sets = [] if semilandmarks is None else _read_sets(semilandmarks)
    planned = Semilandmarks.of(same.specimens, sets) if sets else None
    if len(same.given) > 1:
        for check in same.specimens.check():
            if check.finding:
                say(f"{_finding_sentence(check)} See shapespace landmarks check.")
    records: list[dict[str, Any]] = []
    names, all_points = [*same.specimens.names, *(planned.names if planned else ())], dict[str, FloatArray]()
    make_folder(output)
    with progress(len(same.specimens.surfaces), "landmarks on", "scan", quiet=quiet) as bar:
        for surface in same.specimens.surfaces:
            scan = _read_scan(same, surface, say)
            record, texts = _transfer_to_scan(same, surface, scan, planned)
            for ending, text in texts.items():
                write_text(output / f"{surface.name}{ending}", text)
            points = {row["name"]: np.array(row["position"]) for row in record["landmarks"]}
            all_points[surface.name] = np.stack([points.get(name, np.full(3, np.nan)) for name in names])
            records.append(record)
            bar.update()
    write_text(output / TPS, tps_text(all_points))
    if planned:
        number = {name: k for k, name in enumerate(names, start=1)}
        curves = [[number[name] for name in row] for row in planned.sliders()]
        write_rows(output / CURVE_SLIDERS, ("before", "slide", "after"), curves)
        surface_rows = [[number[name]] for patch in sets if patch.kind == "patch" for name in patch.names]
        write_rows(output / SURFACE_SLIDERS, ("surface",), surface_rows)
    doubtful = [record for record in records if record["status"] == "doubtful"]
    lines = first_lines(doubtful, _doubtful_lines, "more scans with doubtful landmarks")
    total = f"landmarks of {len(records)} scans in {output} and in {output / TPS}"
    return Outcome({"folder": str(output), "records": records}, [*lines, total])


def _doubtful_lines(record: Mapping[str, Any]) -> list[str]:
    reasons = ", ".join(
        f"{landmark['name']} ({landmark['reason']})" for landmark in record["landmarks"] if landmark["reason"]
    )
    return [f"{record['name']}: doubtful landmarks: {reasons}"]


def _read_sets(file: Path) -> list[SemilandmarkSet]:
    """Read a table of curves and patches.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is no such table.
    """
    header, *rows = read_rows(file)
    if not rows or not set(_SET_COLUMNS) <= set(header):
        raise FileFormatError(f"{file} needs the columns {', '.join(_SET_COLUMNS)} and a row for each curve or patch.")
    sets: list[SemilandmarkSet] = []
    for row in rows:
        name, kind, along, points = (row[header.index(column)] for column in _SET_COLUMNS)
        if kind not in ("curve", "patch") or not name or not points.isdecimal():
            raise FileFormatError(
                f"{file}: the row {', '.join(row)!r} needs a name, the kind curve or patch, and a number of points."
            )
        sets.append(SemilandmarkSet(name, kind, tuple(part.strip() for part in along.split(_THEN)), int(points)))
    return sets


def check_marked(marked: Path, scans: Path, output: Path | None, *, say: Say) -> Outcome:
    """Compare the landmarks of each marked specimen with their prediction from the others.

    Args:
        marked: folder of landmark files with the names of the scans.
        scans: folder that `correspond` wrote.
        output: table of all landmarks and specimens (CSV), or None.
        say: called with each message.

    Raises:
        InputError: no correspondence, or fewer than two marked specimens.
        FileError: something cannot be read or written.
    """
    checks = _open_correspondence(scans, marked, say).specimens.check()
    if output is not None:
        header = list(asdict(checks[0]))
        write_rows(output, header, [list(asdict(check).values()) for check in checks])
    found = [check for check in checks if check.finding]
    for check in found:
        say(_finding_sentence(check))
    lines: list[str] = []
    for kind in ("landmark", "specimen"):
        errors: dict[str, list[float]] = {}
        for check in checks:
            errors.setdefault(getattr(check, kind), []).append(100 * check.error_share)
        means = sorted(((fmean(shares), name) for name, shares in errors.items()), reverse=True)
        listed = ", ".join(f"{name} {share:.1f} %" for share, name in means[:LISTED])
        lines.append(f"mean leave-one-out error by {kind}, largest first, of the size: {listed}")
    lines.append(f"{len(checks)} landmarks compared, {len(found)} with a finding")
    return Outcome([asdict(check) for check in checks], lines, exit_code=int(bool(found)))


def suggest_specimens(scans: Path, marked: Path | None = None, count: int = 5, *, say: Say) -> Outcome:
    """Name the specimens to mark next, best first, each with the mean shape distance that is then left.

    Args:
        scans: folder that `correspond` wrote.
        marked: folder of landmark files with the names of the scans, or None if none is marked.
        count: number of specimens (default 5).
        say: called with each message.

    Raises:
        InputError: no correspondence, or no usable landmarks in `marked`.
    """
    found = _open_correspondence(scans, marked, say).specimens.suggest(count)
    lines = [
        f"{rank}. {name}: mean shape distance to the nearest marked specimen {100 * share:.1f} % of the size"
        for rank, (name, share) in enumerate(found, start=1)
    ]
    return Outcome([{"name": name, "mean_distance_share": share} for name, share in found], lines)


def _open_correspondence(scans: Path, marked: Path | None, say: Say) -> _Correspondence:
    if not (scans / SUMMARY).is_file():
        surface_files([scans])  # names what is wrong with an unfinished correspondence
        raise InputError(
            f"{scans} contains no correspondence; run 'shapespace correspond {scans} -o same' and give the folder same."
        )
    files = surface_files([scans])
    summary = CorrespondenceRecord.from_json(json_of(scans / SUMMARY), str(scans / SUMMARY))
    surfaces = {surface_stem(file): mesh_at(file) for file in files.files}
    meshes = [Mesh(mesh.vertices, mesh.faces, name=name, observed=mesh.observed) for name, mesh in surfaces.items()]
    given = {} if marked is None else _read_marks(marked, summary, {m.name: rms_size(m.vertices) for m in meshes}, say)
    for mesh in meshes:
        if mesh.name in given:
            points, notes = landmarks_in_frame_of(mesh, given[mesh.name])
            given[mesh.name] = dict(points)
            for note in notes:
                say(f"{mesh.name}: {note}")
    specimens = MarkedSpecimens.of(meshes, given, summary.mirrored)
    return _Correspondence(scans, summary, specimens, given)


def _read_marks(
    folder: Path, summary: CorrespondenceRecord, sizes: Mapping[str, float], say: Say
) -> dict[str, dict[str, FloatArray]]:
    """Return the landmarks of the marked specimens that are in the correspondence."""
    marks = LandmarkFiles.of(folder)
    given: dict[str, dict[str, FloatArray]] = {}
    for name, file in marks.files.items():
        if name in summary.set_aside:
            say(f"{file.name} is not used: {name} is excluded from the correspondence: {summary.set_aside[name]}")
        marks.used.update({name} & {*sizes, *summary.set_aside})
        if name not in sizes:
            continue
        given[name] = read_landmarks(file)
        for other in marks.duplicates.get(name, ()):
            again = read_landmarks(other)
            off = [
                k
                for k in given[name]
                if k in again and np.linalg.norm(given[name][k] - again[k]) > _SAME_MARK * sizes[name]
            ]
            if off:
                raise InputError(
                    f"{file.name} and {other.name} give different positions for landmark {off[0]!r} of {name}; remove "
                    "one of the files."
                )
    marks.report_unused(say)
    if not given:
        raise InputError(f"{folder}: all marked specimens are excluded from the correspondence; mark others.")
    _report_names(given, say)
    return given


def _report_names(given: Mapping[str, Mapping[str, FloatArray]], say: Say) -> None:
    """Print landmark names that only some marked specimens have, and those that differ in case or punctuation alone."""
    count = Counter(name for marks in given.values() for name in marks)
    alike: dict[str, list[str]] = {}
    for name in count:
        alike.setdefault("".join(c for c in name.casefold() if c.isalnum()), []).append(name)
    for names in alike.values():
        if len(names) > 1:
            say(f"The landmark names {' and '.join(map(repr, names))} differ in spelling only, and count as different.")
    if some := [f"{name} ({n})" for name, n in count.items() if n < len(given)]:
        say(f"Not all {len(given)} marked specimens have {', '.join(some)}; each comes from those that have it.")


def _read_scan(same: _Correspondence, surface: Mesh, say: Say) -> Mesh | None:
    """Return the raw scan of a surface, or None and a message if it cannot be read."""
    file = same.folder / f"{surface.name}{RECORD}"
    try:
        path = read(CorrespondRecord, json_of(file), file.name, CORRESPOND_AGAIN).path
        at = Given(path).path if is_address(path) else Path(os.path.normpath(same.folder / path))
        with FitJob(surface.name, at, address=path if is_address(path) else "").readable() as copy:
            return read_mesh(copy)
    except ShapespaceError as error:
        say(f"{surface.name}: landmarks are on the corresponding surface, since the scan cannot be read: {error}")
        return None


def _transfer_to_scan(
    same: _Correspondence, surface: Mesh, scan: Mesh | None, semilandmarks: Semilandmarks | None
) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the record of one scan, and ending -> text of its files; given landmarks stay where they are."""
    mesh, own = scan or surface, same.given.get(surface.name, {})
    placed = place_landmarks(Mesh(mesh.vertices, mesh.faces, name=surface.name), own) if own else SurfaceLandmarks()
    rows: list[dict[str, Any]] = [
        {"name": name, "status": "marked", "reason": "", "radius_90": None, "position": point.tolist()}
        for name, point in own.items()
    ]

    def add(found: TransferredLandmarks) -> None:
        nonlocal placed
        new = [k for k, name in enumerate(found.names) if name not in own]
        placed = placed.joined(found.on_scan.select([found.names[k] for k in new]))
        for k in new:
            radius, status = float(found.radius_90[k]), "doubtful" if found.reasons[k] else "converged"
            rows.append(
                {"name": found.names[k], "status": status, "reason": found.reasons[k],
                 "radius_90": radius if np.isfinite(radius) else None, "position": found.positions[k].tolist()}
            )  # fmt: skip

    if len(same.given) > bool(own):
        add(same.specimens.transfer(surface.name, scan))
    if semilandmarks is not None:
        at = {row["name"]: np.array(row["position"]) for row in rows}
        add(semilandmarks.place(surface, at, {row["name"]: row["radius_90"] for row in rows if row["radius_90"]}, scan))
    columns, cells = surface_landmark_cells(placed)
    table = [
        [row["name"], *row["position"], row["radius_90"], row["status"], row["reason"], *cell]
        for row, cell in zip(rows, cells, strict=True)
    ]
    descriptions = {
        row["name"]: f"90 % within {row['radius_90']:.3g}; {row['status']} {row['reason']}".rstrip()
        if row["radius_90"]
        else row["status"]
        for row in rows
    }
    header = ["name", "x", "y", "z", "radius_90", "status", "reason", *columns]
    points = {row["name"]: np.array(row["position"]) for row in rows}
    doubtful = any(row["reason"] for row in rows)
    status = "marked" if own else "doubtful" if doubtful else "converged"
    record = {"name": surface.name, "status": status, "landmarks": rows}
    return record, point_texts(points, descriptions, table_text(header, table))


def _finding_sentence(check: LandmarkCheck) -> str:
    return (
        f"{check.specimen}: landmark {check.landmark!r} is {100 * check.error_share:.1f} % of the size from its "
        f"prediction by the other marked specimens ({check.finding})."
    )
