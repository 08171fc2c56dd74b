"""What `correspond` does: raw scans in files to the same surfaces in correspondence, in a folder that `build` takes."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from msgspec import structs

from shapespace.batch.execution import ExecutionConfig
from shapespace.batch.fit_records import Source
from shapespace.batch.fit_work import Job
from shapespace.batch.lock import only_writer
from shapespace.batch.parallel_rounds import RoundRunner
from shapespace.batch.progress import progress, telling_of_compiling, waiting
from shapespace.batch.result_folder import names_for
from shapespace.commands.inputs import LandmarkFiles, given_scans, with_ids
from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
from shapespace.correspondence.first_template import first_template, usable_scan
from shapespace.correspondence.groupwise import ENOUGH_TO_JUDGE, correspond
from shapespace.correspondence.registration import RegistrationTask, RoundContext, ScanRegistration
from shapespace.correspondence.scan_set import copies, unit_ratios
from shapespace.correspondence.scan_status import SurfaceMeasures, find_review_reasons
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_placement import far_landmarks, place_landmarks
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import face_areas, faces_of, rms_size, without_estimates
from shapespace.geometry.outer_surface import outer_surface
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import make_folder, move_file, remove_file, sha256_of_file, write_text
from shapespace.io.landmarks.landmark_io import write_surface_landmarks
from shapespace.io.meshes.mesh_io import ending_of, read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import describe_groups, first_names
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, json_text, read
from shapespace.store.corresponding import LANDMARKS, MEAN, RECORD, SUMMARY, SURFACE
from shapespace.types import Mesh
from shapespace.version import __version__

ROUNDS_FOLDER, CHANGE_FOLDER = ".rounds", ".change"
"""Folders in that of the results: finished work of a run that is not finished, and the files of a change of results."""
_BROKEN = "broken: "
"""Beginning of the reason for a scan that cannot be used."""
_UNREADABLE = "unreadable"
_WITH_OTHER_FILES = (".gltf",)
"""Endings of mesh formats that can store vertices in other files."""
_LISTED = 10  # names in a message, so that it stays readable
_ANOTHER_SHAPE = 0.25
"""The mean change of another object, as a share of its size."""
_OTHER_SIZE = 2.0  # ratio of sizes: beyond twice the median a scan is probably of another object or unit
_ENOUGH_TO_COMPARE, _FAR = 4, 3.0
"""Times the usual distance (95 % of both directions), sizes divided out."""
Say: TypeAlias = Callable[[str], None]


@dataclass(frozen=True)
class CorrespondFiles:
    """What is brought into correspondence, and how.

    Args:
        scans: files, folders, patterns, addresses and lists of these.
        template: a mesh to begin with, or None.
        model: to begin with, or None.
        landmarks: a folder of files that are named as the scans, or None.
        execution: Executor of the registrations.
        recursive: take scans in folders below those given too.
        strict: exclude scans with triangles that use vertices with non-finite coordinates.
        subjects: column of the list of scans that names the subjects, or None.
    """

    scans: Sequence[str | Path]
    template: Path | None = None
    model: Path | None = None
    landmarks: Path | None = None
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)
    recursive: bool = False
    strict: bool = False
    subjects: str | None = None


def correspond_files(
    files: CorrespondFiles,
    folder: Path,
    config: CorrespondConfig,
    *,
    quiet: bool,
    say: Say,
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    """Bring scans from files into correspondence and write what came of each into `folder`.

    What was done is kept in the folder until the end, so the same command goes on from there after an interruption.

    Raises:
        FileError: the results cannot be written.
        InputError: fewer than two scans, or too few that can be reached.
    """
    jobs = find_jobs(files, folder, say)
    make_folder(folder)
    with only_writer(folder):
        complete_change(folder)
        return _corresponding(jobs, files, folder, config, quiet=quiet, say=say)


def correspond_groups(
    files: CorrespondFiles, folder: Path, config: CorrespondConfig, *, quiet: bool, say: Say
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    """Bring the scans of each kind of object into correspondence, in folders group_1, group_2, ... of `folder`.

    Returns:
        The summary and records of the largest group, which also name all other scans.

    Raises:
        FileError, InputError: as for `correspond_files`.
    """
    paths = {job.name: job.address or job.scan for job in find_jobs(files, folder, lambda _: None)}
    summary, records = correspond_files(files, folder / "group_1", config, quiet=quiet, say=say)
    for number, group in enumerate(summary.groups[1:], start=2):
        own = replace(files, scans=[paths[name] for name in group])
        correspond_files(own, folder / f"group_{number}", config, quiet=quiet, say=say)
    return summary, records


def find_jobs(files: CorrespondFiles, folder: Path, say: Say) -> list[Job]:
    """Return the given scans, but for the surfaces of an earlier correspondence, with the names of their results.

    Raises:
        FileError: a folder, a list or an address cannot be read.
        InputError: there are no scans, or two would have one name.
    """
    given = given_scans(files.scans, folder, recursive=files.recursive, say=say)
    distinct = list({one.source: one for one in given}.values())
    scans = [one for one in distinct if not one.path.name.endswith(SURFACE)]
    if len(scans) < len(distinct):
        say(f"{len(distinct) - len(scans)} surfaces of an earlier correspondence are not taken for scans.")
    paths = [one.path for one in scans]
    names = names_for(paths, None, {one.path: one.address for one in scans if one.address})
    return with_ids(
        [Job(n, one.path, one.landmarks, address=one.address) for n, one in zip(names, scans, strict=True)], scans
    )


def _corresponding(
    jobs: Sequence[Job], files: CorrespondFiles, folder: Path, config: CorrespondConfig, *, quiet: bool, say: Say
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    marks = LandmarkFiles.of(files.landmarks)
    marks.refuse_shared([job.scan for job in jobs if job.landmarks is None])
    subjects = _subjects_of(jobs, files.subjects)
    inputs_hash = inputs_hash_of(jobs, marks, files, config)
    if (finished := _finished(jobs, folder, inputs_hash)) is not None:
        say(f"{folder} already contains the results of these scans and settings; nothing is computed.")
        return finished
    template = None if files.template is None else marks.onto(read_mesh(files.template), files.template)
    model = None if files.model is None else ShapeModel.load(files.model)
    read = read_scans(jobs, marks, strict=files.strict, outer=config.outer, quiet=quiet, say=say)
    say_excluded(read.unread, len(jobs), say)
    scans, notes = read.scans, read.notes
    marks.report_unused(say)
    settings, config = asdict(config), replace(config, outer=False)  # the scans are without inner surfaces now
    rounds = RoundsWithProgress(folder / ROUNDS_FOLDER, files.execution, quiet=quiet)
    with telling_of_compiling(quiet=quiet), waiting("choosing the template", quiet=quiet):
        first = first_template(list(scans.values()), template, config, model)
    of_scans = [subjects[name] for name in scans] if subjects else []
    made = correspond(
        list(scans.values()), config, template=template, model=model, first=first, subjects=of_scans, run=rounds
    )
    note_copies(scans, notes)
    given = template.name if template is not None else "" if model is None else "The model's mean"
    if not given or made.moved[0] < _ANOTHER_SHAPE:
        _note_other_objects(made, notes)
    records = records_of(made, read, jobs, folder, config.settled)
    say_notes(records, made, given, say)
    report_landmarks(records, read, say)
    # Until all is written the folder is none that build takes.
    remove_file(folder / SUMMARY)
    # Surfaces of an earlier run are on another template.
    if old := _forget_others({record.name for record in records}, folder):
        say(f"Results of {old} scans that are not among those given were removed from {folder}.")
    write_results(made, records, folder)
    write_mean(made, folder)
    summary = CorrespondenceRecord(
        template=made.why,
        vertices=len(made.template.vertices),
        rounds=list(made.moved),
        corresponding=[record.name for record in records if not record.reason],
        set_aside={record.name: record.reason for record in records if record.reason},
        settings=settings,
        version=__version__,
        other_units={record.name: record.unit_ratio for record in records if record.unit_ratio != 1.0},
        mirrored=[record.name for record in records if record.mirrored],
        sides_decided=made.sides_decided,
        groups=[list(group) for group in made.groups],
        inputs_hash=inputs_hash,
        doubtful=[record.name for record in records if record.doubt],
        needs_review={record.name: codes for record in records if (codes := record.review_codes)},
    )
    summary = structs.replace(summary, results_hash=results_hash_of(summary, folder))
    write_text(folder / SUMMARY, json_text(summary))
    shutil.rmtree(folder / ROUNDS_FOLDER, ignore_errors=True)
    return summary, records


def _subjects_of(jobs: Sequence[Job], column: str | None) -> dict[str, str]:
    """Return the subject of each scan by its name; empty if no column is given.

    Raises:
        InputError: no list of scans has the column, or scans have no value in it.
    """
    if column is None:
        return {}
    subjects = {job.name: job.metadata.get(column, "").strip() for job in jobs}
    if not any(subjects.values()):
        columns = first_names(sorted({name for job in jobs for name in job.metadata}), _LISTED) or "none"
        raise InputError(f"No scan has a value in the column {column} of --subjects; the list of scans has: {columns}.")
    if missing := [name for name, subject in subjects.items() if not subject]:
        raise InputError(
            f"The column {column} of --subjects has no value for {len(missing)} of {len(jobs)} scans "
            f"({first_names(missing, _LISTED)}); fill it in, or leave these scans out."
        )
    return subjects


def inputs_hash_of(
    jobs: Sequence[Job],
    marks: LandmarkFiles,
    files: CorrespondFiles,
    config: CorrespondConfig,
    change: Sequence[object] = (),
) -> str:
    """Return the SHA-256 of all inputs of a run, without parsing the scans; it does not depend on the executor.

    `change` is what is changed in a finished correspondence.
    """

    def landmarks_hash(scan: Path, own: Path | None) -> str:
        file = own or marks.of_scan(scan)
        return "" if file is None else file_hash(file)

    scans: list[object] = []
    for job in jobs:
        scans.append([job.name, content_hash_of(job), landmarks_hash(job.scan, job.landmarks), dict(job.metadata)])
    template = None if files.template is None else [file_hash(files.template), landmarks_hash(files.template, None)]
    model = None if files.model is None else file_hash(files.model)
    inputs = [scans, template, model, asdict(config), files.strict, files.subjects, __version__, *change]
    content = json.dumps(inputs, sort_keys=True, default=str)
    return hashlib.sha256(content.encode()).hexdigest()


def content_hash_of(job: Job) -> str:
    """Return the SHA-256 of the file of a scan."""
    try:
        with job.readable() as file:
            return file_hash(file)
    except ShapespaceError:
        return _UNREADABLE


def file_hash(file: Path) -> str:
    """Return the SHA-256 of a file, and of the vertices of a mesh that names other files with its content."""
    try:
        own = sha256_of_file(file)
        if ending_of(file) not in _WITH_OTHER_FILES:
            return own
        mesh = read_mesh(file)
    except ShapespaceError:
        return _UNREADABLE
    parts = [own.encode(), mesh.vertices.tobytes(), b"" if mesh.faces is None else mesh.faces.tobytes()]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def results_hash_of(summary: CorrespondenceRecord, *folders: Path) -> str:
    """Return the SHA-256 of the names and contents of all files of a correspondence, except its summary.

    Each file is that of the first of `folders` that has it.
    """
    every = sorted([*summary.corresponding, *summary.set_aside])
    records = [[f"{name}{RECORD}", *([f"{name}{SURFACE}"] * (name in summary.corresponding))] for name in every]
    digest = hashlib.sha256()
    for name in (MEAN, LANDMARKS, *(file for files in records for file in files)):
        # A mean has landmarks of its own, or none.
        places = folders[:1] if name == LANDMARKS and (folders[0] / MEAN).is_file() else folders
        file = next((folder / name for folder in places if (folder / name).is_file()), None)
        if file is not None:
            digest.update(f"{name} {sha256_of_file(file)}\n".encode())
    return digest.hexdigest()


def _finished(
    jobs: Sequence[Job], folder: Path, inputs_hash: str
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]] | None:
    """Return the summary and records of a finished run with the same inputs whose files are whole; else None."""
    try:
        summary = CorrespondenceRecord.from_json(read_json(folder / SUMMARY, CORRESPOND_AGAIN))
        if summary.inputs_hash != inputs_hash or summary.results_hash != results_hash_of(summary, folder):
            return None
        files = [folder / f"{job.name}{RECORD}" for job in jobs]
        return summary, [
            read(CorrespondRecord, read_json(file, CORRESPOND_AGAIN), file.name, CORRESPOND_AGAIN) for file in files
        ]
    except ShapespaceError:
        return None


class RoundsWithProgress:
    """Runs rounds with a bar for each."""

    def __init__(self, folder: Path, execution: ExecutionConfig, *, quiet: bool) -> None:
        self._folder, self._execution_config, self._quiet, self._number = folder, execution, quiet, 0

    def __call__(self, context: RoundContext, tasks: Sequence[RegistrationTask]) -> list[ScanRegistration]:
        """Register the scans of one round, or compare them with their mirror images."""
        comparing = bool(tasks) and tasks[0].sides == "scores"
        self._number += not comparing
        label = "comparing with mirror images" if comparing else f"round {self._number}: registering"
        with progress(len(tasks), label, "scan", quiet=self._quiet) as bar:

            def count() -> None:
                bar.update()

            return list(RoundRunner(self._folder, self._execution_config, self._quiet, count)(context, tasks))


@dataclass(frozen=True)
class ScansRead:
    """By the names of the scans: what they hold, what is to be known of them, their hashes, and why others are not."""

    scans: dict[str, Mesh] = field(default_factory=dict[str, Mesh])
    notes: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    hashes: dict[str, str] = field(default_factory=dict[str, str])
    unread: dict[str, str] = field(default_factory=dict[str, str])
    landmark_distances: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])


def say_excluded(reasons: Mapping[str, str], scans: int, say: Say) -> None:
    """Print the excluded scans, with the reason, before the first round."""
    for name, reason in reasons.items():
        say(f"{name} is excluded: {reason.removeprefix(_BROKEN)}")
    if reasons:
        say(f"{len(reasons)} of {scans} {'scan is' if scans == 1 else 'scans are'} excluded before the first round.")


def read_scans(
    jobs: Sequence[Job], marks: LandmarkFiles, *, strict: bool, outer: bool, quiet: bool, say: Say
) -> ScansRead:
    """Read and repair every scan; those that cannot be used are in `unread`, with the reason."""
    read = ScansRead()
    removed: list[float] = []
    with progress(len(jobs), "reading", "scan", quiet=quiet) as bar:
        for job in jobs:
            try:
                with job.readable() as file:
                    mesh, content_hash = read_mesh(file), sha256_of_file(file)
                mesh = marks.onto(mesh, job.scan, job.landmarks)
                read.hashes[job.name] = content_hash
                own = Mesh(mesh.vertices, mesh.faces, mesh.landmarks, job.name)
                if outer and (visible := outer_surface(own)) is not own:
                    removed.append(1 - len(faces_of(visible)) / len(faces_of(own)))
                    own = visible
                read.scans[job.name], read.notes[job.name] = scan, notes = usable_scan(own, strict=strict)
                if scan.landmarks:
                    placed = place_landmarks(scan, scan.landmarks)
                    read.landmark_distances[job.name] = dict(zip(placed, placed.distance_mm.tolist(), strict=True))
                    notes += far_landmarks(scan, placed)
            except ShapespaceError as error:
                read.unread[job.name] = f"{_BROKEN}{error}"
            bar.update()
    if removed:
        say(
            f"Inner surfaces of {len(removed)} of {len(jobs)} scans were removed: {100 * np.mean(removed):.0f} % of "
            "their triangles on average."
        )
    return read


def report_landmarks(records: Sequence[CorrespondRecord], read: ScansRead, say: Say) -> None:
    """Print the distances of the given landmarks from the scans, and from those of the corresponding surfaces."""
    shares = {
        (name, scan): distance / rms_size(read.scans[scan].vertices)
        for scan, distances in read.landmark_distances.items()
        for name, distance in distances.items()
    }
    if not shares:
        return
    name, scan = max(shares, key=lambda key: shares[key])
    sentence = (
        f"The given landmarks of {len(read.landmark_distances)} scans are {100 * np.mean(list(shares.values())):.2g} % "
        f"of the size from the surface of their scan on average, at most {100 * shares[name, scan]:.2g} % ({name} of "
        f"{scan})"
    )
    off = [
        one.landmark_rms / rms_size(read.scans[one.name].vertices) for one in records if one.landmark_rms is not None
    ]
    after = f"; from their places on the corresponding surfaces {100 * np.mean(off):.2g} % (RMS)" if off else ""
    say(f"{sentence}{after}.")


def note_copies(scans: dict[str, Mesh], notes: dict[str, list[str]]) -> None:
    """Add a note to each scan that is an earlier one again."""
    names = list(scans)
    for copy, first in copies(list(scans.values())).items():
        notes[names[copy]].append(f"It is {names[first]} again; leave one of them out.")


def _note_other_objects(made: Correspondence, notes: dict[str, list[str]]) -> None:
    """Where too few scans are there to tell an object of another kind, say which one is quite another shape."""
    there = [scan for scan in made.scans if not scan.reason]
    if len(there) >= ENOUGH_TO_JUDGE:
        return
    for scan in there:
        if scan.moved and scan.moved[0] > _ANOTHER_SHAPE:
            notes[scan.name].append(
                f"It differs from the others by {100 * scan.moved[0]:.0f} % of its size, and there are too "
                "few scans to decide whether it is another object; inspect it."
            )


def say_notes(records: Sequence[CorrespondRecord], made: Correspondence, given: str, say: Say) -> None:
    """Say what should be known before the results are used; `given` is what the template given is called, if one is."""
    if given and made.moved[0] >= _ANOTHER_SHAPE:
        say(
            f"{given} had to change by {100 * made.moved[0]:.0f} % of its size to become these scans, so it is "
            "hardly an object of their kind; look at the surfaces, or leave it out."
        )
    if mirrored := [record.name for record in records if record.mirrored]:
        named = first_names(mirrored, _LISTED)
        of = "scan is a mirror image" if len(mirrored) == 1 else "scans are mirror images"
        say(
            f"{len(mirrored)} {of} of {given or 'the others'} ({named}) and reflected for the correspondence; surfaces "
            "are in the frames of their scans."
        )
    if made.groups:
        say(describe_groups(made.groups))
    noted = [record for record in records if record.notes]
    for record in noted[:_LISTED]:
        say(f"{record.name}: {' '.join(record.notes)}")
    if len(noted) > _LISTED:
        say(f"Notes on {len(noted) - _LISTED} more scans are in their records.")
    if others := [record for record in records if record.unit_ratio != 1.0]:
        named = first_names([record.name for record in others], _LISTED)
        noun = "scans is" if len(others) == 1 else "scans are"
        say(
            f"{len(others)} of {len(records)} {noun} in another unit than the majority, judging by size ({named}); "
            "so are the surfaces, and build converts them to the unit of the majority."
        )


def records_of(
    made: Correspondence,
    read: ScansRead,
    jobs: Sequence[Job],
    folder: Path,
    settled: float,
    kept: Sequence[tuple[float, CorrespondRecord]] = (),
) -> list[CorrespondRecord]:
    """Return the records of the scans `jobs`; `kept` are scales and records of the scans that they are added to.

    `settled` is the setting of the correspondence.
    """
    came = {scan.name: scan for scan in made.scans}
    surfaces = {mesh.name: mesh for mesh in made.meshes()}
    scaled = {scan.name: scan.T_scan_template.scale for scan in made.scans if scan.T_scan_template is not None}
    sizes = _sizes(scaled, kept)
    mean_size = rms_size(made.template.vertices)
    of_kept = [SurfaceMeasures.of_record(record, scale * mean_size) for scale, record in kept]
    measures = {scan.name: scan.measures for scan in made.scans if scan.measures is not None}
    reviews = find_review_reasons([*of_kept, *measures.values()], settled)[len(kept) :]
    review = dict(zip(measures, reviews, strict=True))
    records: list[CorrespondRecord] = []
    for job in jobs:
        name, one = job.name, came.get(job.name)
        source = replace(job.source(folder), content_hash=read.hashes.get(name, ""))
        record = _record(name, source, one, read.unread.get(name, ""), read.notes.get(name, []))
        record = structs.replace(record, metadata=dict(job.metadata))
        if name in surfaces:
            scan = read.scans[name]
            area = float(np.nansum(face_areas(without_estimates(surfaces[name]))))
            share = None if scan.faces is None else area / float(face_areas(scan).sum())
            record = structs.replace(record, area_share=share, size=scaled[name] * mean_size, review=review[name])
        record = structs.replace(record, landmark_distances=read.landmark_distances.get(name, {}))
        if name in sizes:
            scale, ratio = map(float, sizes[name])
            odd = [] if 1 / _OTHER_SIZE < scale < _OTHER_SIZE else [_size_note(scale)]
            record = structs.replace(record, scale=scale, unit_ratio=ratio, notes=[*record.notes, *odd])
        records.append(record)
    before = [record for _, record in kept]
    return _with_far_ones([*before, *records])[len(before) :]


def _sizes(
    scales: Mapping[str, float], kept: Sequence[tuple[float, CorrespondRecord]]
) -> dict[str, tuple[np.float64, np.float64]]:
    """Return size and unit of scans, by name, relative to the others, or to the scans that they are added to."""
    if not kept:
        return dict(zip(scales, zip(*unit_ratios(list(scales.values())), strict=True), strict=True))
    usual = [scale / record.unit_ratio for scale, record in kept]
    ratios = {name: unit_ratios([*usual, *usual, scale]) for name, scale in scales.items()}  # the others are most
    return {name: (sizes[-1], units[-1]) for name, (sizes, units) in ratios.items()}


def _with_far_ones(records: Sequence[CorrespondRecord]) -> list[CorrespondRecord]:
    """Return `records` with a note on those whose surface lies much farther from its scan than is usual.

    Point clouds are compared with each other, since their distances are those to points.
    """
    far = np.array([(r.distance_p95 or np.nan) / ((r.scale or np.nan) * r.unit_ratio) for r in records])
    is_cloud = np.array([r.area_share is None for r in records])
    ratios = np.full(len(records), np.nan)
    for alike in (is_cloud, ~is_cloud):
        if np.isfinite(far[alike]).sum() >= _ENOUGH_TO_COMPARE:
            ratios[alike] = far[alike] / np.nanmedian(far[alike])
    return [
        record
        if not times > _FAR
        else structs.replace(
            record,
            notes=[*record.notes, f"Its surface lies {times:.2g} times as far from it as is usual; look at it."],
        )
        for record, times in zip(records, ratios, strict=True)
    ]


def _size_note(scale: float) -> str:
    return f"It is {scale:.2g} times as large as most; look whether it is the same kind of object."


def _record(
    name: str, source: Source, one: Corresponding | None, unread: str, notes: Sequence[str]
) -> CorrespondRecord:
    path = source.path or source.name
    if one is None or one.vertices is None or one.measures is None:
        reason = unread if one is None else one.reason
        return CorrespondRecord(
            name=name, path=path, hash=source.content_hash, status="excluded", reason=reason, notes=list(notes)
        )
    mean, p95, p99, largest = one.distance
    return CorrespondRecord(
        name=name, path=path, hash=source.content_hash, status=one.status, doubt=one.doubt,
        probability=one.probability if np.isfinite(one.probability) else None, seen_share=one.seen,
        covered_share=one.covered, folded_share=one.measures.folded, area_factor=one.measures.area_change,
        distance_mean=mean, distance_p95=p95, distance_p99=p99, distance_max=largest,
        notes=list(notes), moved_share=list(one.moved), cpu_s=list(one.seconds),
        landmark_rms=one.landmarks if np.isfinite(one.landmarks) else None, mirrored=one.mirrored,
    )  # fmt: skip


def write_results(made: Correspondence, records: Sequence[CorrespondRecord], folder: Path) -> None:
    """Write records and surfaces into `folder`, and remove those surfaces that the records do not have.

    Raises:
        FileError: they cannot be written.
    """
    surfaces = {mesh.name: replace(mesh, landmarks={}) for mesh in made.meshes()}
    for record in records:
        file = folder / f"{record.name}{SURFACE}"
        surface = surfaces.get(record.name)
        if record.reason or surface is None:
            remove_file(file)
        else:
            write_mesh(file, mirror_image(surface) if record.mirrored else surface)
        write_text(folder / f"{record.name}{RECORD}", json_text(record))


def write_mean(made: Correspondence, folder: Path) -> None:
    """Write the mean and its landmarks into `folder`.

    Raises:
        FileError: they cannot be written.
    """
    make_folder((folder / MEAN).parent)
    write_mesh(folder / MEAN, made.template)
    if made.landmarks:
        write_surface_landmarks(folder / LANDMARKS, made.landmarks)
    else:
        remove_file(folder / LANDMARKS)


def complete_change(folder: Path) -> None:
    """Move the files of a change into `folder` if all are written; otherwise remove what was written of them.

    A folder that is left in between has no summary, so that nothing takes it; this function then completes it.

    Raises:
        FileError: they cannot be moved.
    """
    change = folder / CHANGE_FOLDER
    if (change / SUMMARY).is_file():
        summary = CorrespondenceRecord.from_json(read_json(change / SUMMARY, CORRESPOND_AGAIN))
        remove_file(folder / SUMMARY)
        for name in summary.set_aside:
            remove_file(folder / f"{name}{SURFACE}")
        if (change / MEAN).is_file() and not (change / LANDMARKS).is_file():
            remove_file(folder / LANDMARKS)
        results = (file for pattern in (RECORD, SURFACE) for file in sorted(change.glob(f"*{pattern}")))
        for file in (*results, change / MEAN, change / LANDMARKS):
            if file.is_file():
                move_file(file, folder / file.relative_to(change))
        _forget_others({*summary.corresponding, *summary.set_aside}, folder)
        move_file(change / SUMMARY, folder / SUMMARY)
    shutil.rmtree(change, ignore_errors=True)


def _forget_others(names: set[str], folder: Path) -> int:
    """Remove the results of scans other than `names`, and return of how many."""
    old = [file for file in sorted(folder.glob(f"*{RECORD}")) if file.name.removesuffix(RECORD) not in names]
    for file in old:
        remove_file(folder / (file.name.removesuffix(RECORD) + SURFACE))
        remove_file(file)
    return len(old)
