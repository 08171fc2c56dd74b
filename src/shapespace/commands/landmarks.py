"""What `landmarks` does: landmarks of marked specimens carried to all scans of a correspondence, and checked."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.batch.fit_work import Job
from shapespace.batch.progress import progress
from shapespace.commands.inputs import Given
from shapespace.commands.landmark_files import LandmarkFiles
from shapespace.correspondence.landmark_transfer import LandmarkCheck, MarkedSpecimens
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.normals import rms_size
from shapespace.io.files import make_folder, write_text
from shapespace.io.landmarks.fiducials import point_texts
from shapespace.io.landmarks.landmark_io import read_landmarks, surface_landmark_cells, tps_text
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.remote import is_address
from shapespace.io.tables.table_io import table_text, write_rows
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, read
from shapespace.store.corresponding import RECORD, SUMMARY, json_of, surface_files, surface_stem
from shapespace.store.results import mesh_at
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks

TPS = "landmarks.tps"
"""File in the output folder with the landmarks of all scans."""
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
    marked: Path, scans: Path, folder: Path, *, quiet: bool = False, say: Say
) -> list[dict[str, Any]]:
    """Write the landmarks of all scans of a correspondence, predicted from those of marked specimens.

    Each scan gets NAME.landmarks.csv, .mrk.json and .fcsv; `TPS` has those of all.

    Args:
        marked: folder of landmark files with the names of the scans.
        scans: folder that `correspond` wrote.
        folder: output folder.
        quiet: show no progress.
        say: called with each message.

    Returns:
        A record of each scan.

    Raises:
        InputError: no correspondence, no usable landmarks, or landmarks that contradict each other.
        FileError: something cannot be read or written.
    """
    same = _open(scans, marked, say)
    if len(same.given) > 1:
        for one in same.specimens.check():
            if one.finding:
                say(f"{_sentence(one)} See shapespace landmarks check.")
    records: list[dict[str, Any]] = []
    names, all_points = same.specimens.names, dict[str, FloatArray]()
    make_folder(folder)
    with progress(len(same.specimens.surfaces), "landmarks on", "scan", quiet=quiet) as bar:
        for surface in same.specimens.surfaces:
            scan = _scan(same, surface, say)
            record, texts = _transferred(same, surface, scan)
            for ending, text in texts.items():
                write_text(folder / f"{surface.name}{ending}", text)
            points = {row["name"]: np.array(row["position"]) for row in record["landmarks"]}
            all_points[surface.name] = np.stack([points.get(name, np.full(3, np.nan)) for name in names])
            records.append(record)
            bar.update()
    write_text(folder / TPS, tps_text(all_points))
    return records


def check_landmarks(marked: Path, scans: Path, output: Path | None = None, *, say: Say) -> list[LandmarkCheck]:
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
    checks = _open(scans, marked, say).specimens.check()
    if output is not None:
        header = list(asdict(checks[0]))
        write_rows(output, header, [list(asdict(one).values()) for one in checks])
    for one in checks:
        if one.finding:
            say(_sentence(one))
    return checks


def suggest_specimens(scans: Path, marked: Path | None = None, count: int = 5, *, say: Say) -> list[tuple[str, float]]:
    """Return the specimens to mark next, best first, each with the mean shape distance that is then left.

    Args:
        scans: folder that `correspond` wrote.
        marked: folder of landmark files with the names of the scans, or None if none is marked.
        count: number of specimens (default 5).
        say: called with each message.

    Raises:
        InputError: no correspondence, or no usable landmarks in `marked`.
    """
    return _open(scans, marked, say).specimens.suggest(count)


def _open(scans: Path, marked: Path | None, say: Say) -> _Correspondence:
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
    marks.tell(say)
    if not given:
        raise InputError(f"{folder}: all marked specimens are excluded from the correspondence; mark others.")
    _say_names(given, say)
    return given


def _say_names(given: Mapping[str, Mapping[str, FloatArray]], say: Say) -> None:
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


def _scan(same: _Correspondence, surface: Mesh, say: Say) -> Mesh | None:
    """Return the raw scan of a surface, None with a message where it cannot be read."""
    file = same.folder / f"{surface.name}{RECORD}"
    try:
        path = read(CorrespondRecord, json_of(file), file.name, CORRESPOND_AGAIN).path
        at = Given(path).path if is_address(path) else Path(os.path.normpath(same.folder / path))
        with Job(surface.name, at, address=path if is_address(path) else "").readable() as copy:
            return read_mesh(copy)
    except ShapespaceError as error:
        say(f"{surface.name}: landmarks are on the corresponding surface, since the scan cannot be read: {error}")
        return None


def _transferred(same: _Correspondence, surface: Mesh, scan: Mesh | None) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the record of one scan, and ending -> text of its files; given landmarks stay where they are."""
    mesh, own = scan or surface, same.given.get(surface.name, {})
    placed = place_landmarks(Mesh(mesh.vertices, mesh.faces, name=surface.name), own) if own else SurfaceLandmarks()
    rows = [(name, "marked", "", None, point) for name, point in own.items()]
    status = "marked"
    if len(same.given) > bool(own):
        predicted = same.specimens.transfer(surface.name, scan)
        new = [k for k, name in enumerate(predicted.names) if name not in own]
        placed = placed.joined(predicted.on_scan.select([predicted.names[k] for k in new]))
        states = ["doubtful" if reason else "converged" for reason in predicted.reasons]
        rows += [
            (predicted.names[k], states[k], predicted.reasons[k], float(predicted.radius_90[k]), predicted.positions[k])
            for k in new
        ]
        status = status if own else predicted.status
    header = ["name", "x", "y", "z", "radius_90_mm", "status", "reason"]
    columns, cells = surface_landmark_cells(placed)
    table = [
        [name, *map(float, point), "" if radius is None else radius, state, reason, *cell]
        for (name, state, reason, radius, point), cell in zip(rows, cells, strict=True)
    ]
    descriptions = {
        name: state if radius is None else f"90 % within {radius:.3g} mm; {state} {reason}".rstrip()
        for name, state, reason, radius, _ in rows
    }
    texts = point_texts(
        {row[0]: np.asarray(row[4]) for row in rows}, descriptions, table_text([*header, *columns], table)
    )
    landmarks = [
        {"name": name, "status": state, "reason": reason, "radius_90_mm": radius, "position": list(map(float, point))}
        for name, state, reason, radius, point in rows
    ]
    return {"name": surface.name, "status": status, "landmarks": landmarks}, texts


def _sentence(one: LandmarkCheck) -> str:
    return (
        f"{one.specimen}: landmark {one.landmark!r} is {100 * one.error_share:.1f} % of the size from its prediction "
        f"by the other marked specimens ({one.finding})."
    )
