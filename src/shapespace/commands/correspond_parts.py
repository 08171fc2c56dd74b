"""Correspondence of several parts of each specimen: a folder for each, and the joined surfaces above them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapespace.batch.fit_work import FitJob
from shapespace.commands.correspond import (
    CorrespondenceFolder,
    CorrespondFiles,
    Say,
    ScansRead,
    make_record,
    with_scans,
)
from shapespace.commands.finished_correspondence import FinishedFolder
from shapespace.commands.inputs import given_scans, scans_of_parts
from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
from shapespace.correspondence.joined_parts import find_exchanged, find_wrong_sides, join_parts
from shapespace.correspondence.odd_scans import ScanMeasures
from shapespace.correspondence.scan_status import SurfaceMeasures
from shapespace.correspondence.settings import FEWEST
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.doctor import repair
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.files import make_folder, remove_file
from shapespace.io.landmarks.landmark_io import read_surface_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.reprs import first_names
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord
from shapespace.store.corresponding import LANDMARKS, SUMMARY
from shapespace.types import SurfaceLandmarks
from shapespace.version import __version__

_LISTED = 5  # names in a message, so that it stays short
_NAME_ADVICE = "name the scans NAME_PART, put them in a folder per part, or give a list with the column part"


def check_parts(files: CorrespondFiles, folder: Path, say: Say) -> None:
    """Check that each part has scans, and report scans of no part and the numbers of specimens.

    Raises:
        InputError: fewer than two parts, options of one structure, a part with too few scans, or no specimen with two.
    """
    parts = files.parts
    if len({part.casefold() for part in parts}) < max(len(parts), 2):
        raise InputError(f"--parts needs two or more different names, not {' '.join(parts)}; omit it for one part.")
    if wrong := [part for part in parts if not part or part.startswith(".") or set(part) & set('/\\:*?"<>|\0')]:
        raise InputError(f"--parts {wrong[0]}: the name of a part is that of a folder; give another name.")
    if files.template is not None or files.model is not None:
        option = "--model" if files.template is None else "--template"
        raise InputError(f"{option} is of one structure, and --parts are several; omit {option}.")
    given = given_scans(files.scans, folder, recursive=files.recursive, say=lambda _: None)
    by_part = scans_of_parts(given, parts)
    used = {scan.source for scans in by_part.values() for scan in scans}
    left = [scan.path.name for scan in given if scan.source not in used]
    for part, scans in by_part.items():
        if len(scans) < FEWEST:
            others = f" ({len(left)} scans are of no part: {first_names(left, _LISTED)})" if left else ""
            raise InputError(
                f"{len(scans)} of {len(given)} scans are of the part {part}, and a correspondence needs {FEWEST}"
                f"{others}; {_NAME_ADVICE}."
            )
    counts = Counter(scan.called.casefold() for scans in by_part.values() for scan in scans)
    if sum(number == len(parts) for number in counts.values()) < FEWEST:
        of = "; ".join(f"{part}: {first_names([s.called for s in by_part[part]], 3)}" for part in parts)
        raise InputError(f"Fewer than {FEWEST} specimens have scans of all parts ({of}); {_NAME_ADVICE}.")
    if left:
        say(f"{len(left)} of {len(given)} scans are of none of the parts, and omitted: {first_names(left, _LISTED)}.")


def correspond_each_part(
    files: CorrespondFiles, folder: Path, run: Callable[[CorrespondFiles, Path], FinishedFolder], *, say: Say
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    """Bring the scans of each part into correspondence by `run`, in a folder of its own, and join the results.

    Raises:
        FileError, FileFormatError: something cannot be read or written.
        InputError: too few specimens have all parts.
    """
    finished: dict[str, FinishedFolder] = {}
    for part in files.parts:
        say(f"Part {part}:")
        finished[part] = run(replace(files, part=part), folder / part)
    parts = {part: _correspondence(own) for part, own in finished.items()}
    for part, mirrored in find_wrong_sides(parts).items():
        finished[part] = run(replace(files, part=part, mirrored=mirrored), folder / part)
        parts[part] = _correspondence(finished[part])
    with CorrespondenceFolder(make_folder(folder)).writing() as results:
        inputs_hash = " ".join(f"{part} {own.summary.results_hash}" for part, own in finished.items())
        names = list(dict.fromkeys(name for own in finished.values() for name in own.records))
        if (earlier := results.finished(inputs_hash, names)) is not None:
            return earlier
        made = join_parts(parts, doubts=_doubts(finished))
        for sentence in made.notes:
            say(sentence)
        size = rms_size(made.template.vertices)
        records = [_joined_record(scan, finished, folder, size) for scan in made.scans]
        remove_file(folder / SUMMARY)  # until all is written, build must not accept the folder
        summary = CorrespondenceRecord(
            template=made.why, vertices=len(made.template.vertices), rounds=list(made.moved), corresponding=[],
            set_aside={}, settings=finished[files.parts[0]].summary.settings, version=__version__,
            sides_decided=made.sides_decided, inputs_hash=inputs_hash, parts=dict(made.parts),
        )  # fmt: skip
        return results.publish(made, records, with_scans(summary, records), with_mean=True), records


def _correspondence(finished: FinishedFolder) -> Correspondence:
    """Return the correspondence in a folder."""
    summary, file = finished.summary, finished.results.path / LANDMARKS
    return Correspondence(
        finished.mean, tuple(_registration(finished, name) for name in finished.records), summary.template,
        tuple(summary.rounds), read_surface_landmarks(file) if file.is_file() else SurfaceLandmarks(),
        sides_decided=summary.sides_decided,
    )  # fmt: skip


def _registration(finished: FinishedFolder, name: str) -> Corresponding:
    """Return the registration of a scan, from its record and its surface."""
    record, surface = finished.records[name], finished.surfaces.get(name)
    if surface is None:
        return Corresponding(name, record.reason, notes=tuple(record.notes))
    T = fit_similarity(finished.mean.vertices, surface.vertices)
    distances = (record.distance_mean, record.distance_p95, record.distance_p99, record.distance_max)
    mean, p95, p99, largest = (np.nan if value is None else value for value in distances)
    return Corresponding(
        name, "", surface.vertices * (FLIP if record.mirrored else 1.0), T,
        seen=record.seen_share or 0.0, covered=record.covered_share or 0.0, distance=(mean, p95, p99, largest),
        moved=tuple(record.moved_share), seconds=tuple(record.cpu_s),
        landmarks=np.nan if record.landmark_rms is None else record.landmark_rms, observed=surface.observed,
        mirrored=record.mirrored, status=record.status, position_std=surface.position_std,
        probability=np.nan if record.probability is None else record.probability, doubt=record.doubt,
        measures=SurfaceMeasures.of_record(record, T.scale * rms_size(finished.mean.vertices)),
        review=tuple(record.review), notes=tuple(record.notes), unit_ratio=record.unit_ratio,
        area_share=record.area_share,
    )  # fmt: skip


def _doubts(finished: Mapping[str, FinishedFolder]) -> dict[str, str]:
    """Return the specimens two of whose parts are exchanged, or are the same scan, with the reason."""
    measures: dict[str, dict[str, ScanMeasures]] = {part: {} for part in finished}
    content: dict[str, str] = {}
    doubts: dict[str, str] = {}
    for part, own in finished.items():
        for name, record in own.records.items():
            first = content.setdefault(record.hash, f"{name} {part}") if record.hash else f"{name} {part}"
            if first != f"{name} {part}":
                doubts[name] = f"its {part} is the same scan as {first}"
            try:
                with own.job(name).readable() as file:
                    measures[part][name] = ScanMeasures.of(repair(read_mesh(file))[0])
            except ShapespaceError:  # the part is excluded with the reason, or its scan was moved
                continue
    return {**find_exchanged(measures), **doubts}


def _joined_record(
    scan: Corresponding, finished: Mapping[str, FinishedFolder], folder: Path, size: float
) -> CorrespondRecord:
    """Return the record of a specimen, whose scans are in the records of its parts."""
    own = {part: there.records[scan.name] for part, there in finished.items() if scan.name in there.records}
    metadata = {key: str(value) for record in own.values() for key, value in record.metadata.items()}
    distances = {
        f"{part}_{name}": off for part, record in own.items() for name, off in record.landmark_distances.items()
    }
    read = ScansRead(landmark_distances={scan.name: distances})
    return make_record(FitJob(scan.name, Path(), metadata=metadata), scan, read, folder, size)
