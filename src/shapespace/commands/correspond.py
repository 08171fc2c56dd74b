"""Command `correspond`: bring raw scans from files into correspondence, in a folder that `build` takes."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Generator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from msgspec import structs

from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.fit_work import FitJob
from shapespace.batch.parallel_rounds import RoundRunner
from shapespace.batch.progress import progress, telling_of_compiling, waiting
from shapespace.batch.result_folder import names_for, only_writer
from shapespace.commands.inputs import LandmarkFiles, given_scans, scans_of_parts, with_ids
from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
from shapespace.correspondence.first_template import first_template, usable_scan
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.registration import RegistrationTask, RoundContext, ScanRegistration
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.grooming import pieces_of
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import faces_of, rms_size
from shapespace.geometry.outer_surface import outer_surface
from shapespace.io.containers.json_files import read_json
from shapespace.io.files import make_folder, move_file, remove_file, sha256_of_file, write_text
from shapespace.io.landmarks.landmark_io import write_surface_landmarks
from shapespace.io.meshes.mesh_io import ending_of, read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import first_names
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, json_text, read
from shapespace.store.corresponding import LANDMARKS, MEAN, RECORD, SUMMARY, SURFACE, json_of
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
Say: TypeAlias = Callable[[str], None]


@dataclass(frozen=True)
class CorrespondFiles:
    """Input files of a correspondence, and its execution.

    Args:
        scans: files, folders, patterns, addresses and lists of scans.
        template: mesh of the first template, or None.
        model: model of the first template, or None.
        landmarks: folder of landmark files that are named as the scans, or None.
        execution: Executor of the registrations.
        recursive: take scans in folders below those given too.
        strict: exclude scans with triangles that use vertices with non-finite coordinates.
        subjects: column of the list of scans that names the subjects, or None.
        parts: names of the parts of each specimen, each with scans of its own; empty for objects of one part.
        part: name of the part whose scans are used.
        mirrored: names of the scans that are mirror images of the majority, as other parts of their specimens show;
            None if the scans show it.
    """

    scans: Sequence[str | Path]
    template: Path | None = None
    model: Path | None = None
    landmarks: Path | None = None
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)
    recursive: bool = False
    strict: bool = False
    subjects: str | None = None
    parts: Sequence[str] = ()
    part: str = ""
    mirrored: frozenset[str] | None = None


def correspond_files(
    files: CorrespondFiles,
    folder: Path,
    config: CorrespondConfig,
    *,
    quiet: bool,
    say: Say,
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    """Bring scans from files into correspondence and write the result of each scan into `folder`.

    Finished work stays in the folder until the end, so the same command continues from there after an interruption.

    Raises:
        FileError: the results cannot be written.
        InputError: fewer than two scans, or too few that can be reached.
    """
    jobs = find_jobs(files, folder, say)
    with CorrespondenceFolder(make_folder(folder)).writing() as results:
        marks = LandmarkFiles.of(files.landmarks)
        marks.check_not_shared([job.scan for job in jobs if job.landmarks is None])
        subjects = _subjects_of(jobs, files.subjects)
        inputs_hash = inputs_hash_of(jobs, marks, files, config)
        if files.mirrored is not None:
            say("The sides of these scans are those of the other parts of their specimens.")
        elif (finished := results.finished(inputs_hash, [job.name for job in jobs])) is not None:
            say(f"{results.path} already contains the results of these scans and settings; nothing is computed.")
            return finished
        template = None if files.template is None else marks.onto(read_mesh(files.template), files.template)
        model = None if files.model is None else ShapeModel.load(files.model)
        read = read_scans(jobs, marks, strict=files.strict, outer=config.outer, quiet=quiet, say=say)
        several = [name for name, scan in read.scans.items() if _has_pieces(scan)]
        if 2 * len(several) > len(read.scans):
            say(
                f"{len(several)} of {len(read.scans)} scans have several separate pieces, and the first template has "
                "only the largest; if the pieces are structures of one subject, give a file for each, and --parts."
            )
        # The scans that are read are without inner surfaces, and of known sides or compared.
        own = replace(config, outer=False, mirror=config.mirror if files.mirrored is None else "never")

        def make(rounds: RoundsWithProgress) -> Correspondence:
            mirrored = files.mirrored or ()
            scans = [mirror_image(scan) if name in mirrored else scan for name, scan in read.scans.items()]
            with waiting("choosing the template", quiet=quiet):
                first = first_template(scans, template, own, model)
            of_scans = [subjects[name] for name in read.scans] if subjects else []
            made = correspond(scans, own, template=template, model=model, first=first, subjects=of_scans, run=rounds)
            return made if files.mirrored is None else made.with_sides(mirrored)

        made, records = bring(jobs, read, marks, files, results, make, quiet=quiet, say=say)
        # Until all is written, build must not accept the folder.
        remove_file(results.path / SUMMARY)
        summary = CorrespondenceRecord(
            template=made.why, vertices=len(made.template.vertices), rounds=list(made.moved), corresponding=[],
            set_aside={}, settings=asdict(config), version=__version__, sides_decided=made.sides_decided,
            groups=[list(group) for group in made.groups], inputs_hash=inputs_hash,
        )  # fmt: skip
        # Surfaces of an earlier run are on another template.
        if old := results.forget_others({record.name for record in records}):
            say(f"Results of {old} scans that are not among those given were removed from {results.path}.")
        return results.publish(made, records, with_scans(summary, records), with_mean=True), records


def _has_pieces(scan: Mesh) -> bool:
    return scan.faces is not None and len(np.unique(pieces_of(scan.faces, len(scan.vertices))[1])) > 1


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


def find_jobs(files: CorrespondFiles, folder: Path, say: Say) -> list[FitJob]:
    """Return the given scans, but for the surfaces of an earlier correspondence, with the names of their results.

    Raises:
        FileError: a folder, a list or an address cannot be read.
        InputError: there are no scans, or two would have one name.
    """
    given = given_scans(files.scans, folder, recursive=files.recursive, say=say)
    if files.part:
        given = scans_of_parts(given, files.parts)[files.part]
    distinct = list({scan.source: scan for scan in given}.values())
    scans = [scan for scan in distinct if not scan.path.name.endswith(SURFACE)]
    if len(scans) < len(distinct):
        say(f"{len(distinct) - len(scans)} surfaces of an earlier correspondence are not taken for scans.")
    paths = [scan.path for scan in scans]
    names = names_for(paths, None, {scan.path: scan.address for scan in scans if scan.address})
    return with_ids(
        [FitJob(n, scan.path, scan.landmarks, address=scan.address) for n, scan in zip(names, scans, strict=True)],
        scans,
    )


def bring(
    jobs: Sequence[FitJob],
    read: ScansRead,
    marks: LandmarkFiles,
    files: CorrespondFiles,
    results: CorrespondenceFolder,
    make: Callable[[RoundsWithProgress], Correspondence],
    *,
    quiet: bool,
    say: Say,
) -> tuple[Correspondence, list[CorrespondRecord]]:
    """Bring the scans of `jobs` that are read into correspondence by `make`, and print the messages for the user."""
    for name, reason in read.unread.items():
        say(f"{name} is excluded: {reason.removeprefix(_BROKEN)}")
    if read.unread:
        were = "scan is" if len(jobs) == 1 else "scans are"
        say(f"{len(read.unread)} of {len(jobs)} {were} excluded before the first round.")
    marks.report_unused(say)
    rounds = RoundsWithProgress(results.path / ROUNDS_FOLDER, files.execution, quiet=quiet)
    with telling_of_compiling(quiet=quiet):
        made = make(rounds)
    came = {scan.name: scan for scan in made.scans}
    came |= {name: Corresponding(name, reason) for name, reason in read.unread.items()}
    scans = [came[job.name] for job in jobs]
    noted = [replace(scan, notes=tuple(read.notes.get(scan.name, ()))).noting(*scan.notes) for scan in scans]
    made = replace(made, scans=tuple(noted))
    size = rms_size(made.template.vertices)
    records = [make_record(job, scan, read, results.path, size) for job, scan in zip(jobs, made.scans, strict=True)]
    for sentence in made.notes:
        say(sentence)
    report_landmarks(records, read, say)
    return made, records


def with_scans(summary: CorrespondenceRecord, records: Sequence[CorrespondRecord]) -> CorrespondenceRecord:
    """Return the summary of a correspondence of the scans in `records`."""
    return structs.replace(
        summary,
        corresponding=[record.name for record in records if not record.reason],
        set_aside={record.name: record.reason for record in records if record.reason},
        other_units={record.name: record.unit_ratio for record in records if record.unit_ratio != 1.0},
        mirrored=[record.name for record in records if record.mirrored],
        doubtful=[record.name for record in records if record.doubt],
        needs_review={record.name: codes for record in records if (codes := record.review_codes)},
    )


def _subjects_of(jobs: Sequence[FitJob], column: str | None) -> dict[str, str]:
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
            f"({first_names(missing, _LISTED)}); fill it in, or exclude these scans."
        )
    return subjects


def inputs_hash_of(
    jobs: Sequence[FitJob],
    marks: LandmarkFiles,
    files: CorrespondFiles,
    config: CorrespondConfig,
    change: Sequence[object] = (),
) -> str:
    """Return the SHA-256 of all inputs of a run, without parsing the scans; it does not depend on the executor.

    `change` is the changes of a finished correspondence.
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


def content_hash_of(job: FitJob) -> str:
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
    """Content, notes and hashes of the usable scans by name, and why the other scans cannot be used."""

    scans: dict[str, Mesh] = field(default_factory=dict[str, Mesh])
    notes: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    hashes: dict[str, str] = field(default_factory=dict[str, str])
    unread: dict[str, str] = field(default_factory=dict[str, str])
    landmark_distances: dict[str, dict[str, float]] = field(default_factory=dict[str, dict[str, float]])


def read_scans(
    jobs: Sequence[FitJob], marks: LandmarkFiles, *, strict: bool, outer: bool, quiet: bool, say: Say
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
                read.scans[job.name], read.notes[job.name] = scan, _ = usable_scan(own, strict=strict)
                if scan.landmarks:
                    placed = place_landmarks(scan, scan.landmarks)
                    read.landmark_distances[job.name] = dict(zip(placed, placed.distance_mm.tolist(), strict=True))
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
        record.landmark_rms / rms_size(read.scans[record.name].vertices)
        for record in records
        if record.landmark_rms is not None
    ]
    after = f"; from their places on the corresponding surfaces {100 * np.mean(off):.2g} % (RMS)" if off else ""
    say(f"{sentence}{after}.")


def make_record(job: FitJob, scan: Corresponding, read: ScansRead, folder: Path, mean_size: float) -> CorrespondRecord:
    """Return the record of a scan; `mean_size` is the RMS size of the mean shape."""
    source = job.source(folder)
    record = CorrespondRecord(
        name=job.name, path=source.path or source.name, hash=read.hashes.get(job.name, ""), status=scan.status,
        reason=scan.reason, notes=list(scan.notes), metadata=dict(job.metadata),
        landmark_distances=read.landmark_distances.get(job.name, {}),
    )  # fmt: skip
    if scan.measures is None or scan.T_scan_template is None:
        return record
    mean, p95, p99, largest = scan.distance
    return structs.replace(
        record, doubt=scan.doubt, probability=scan.probability if np.isfinite(scan.probability) else None,
        review=list(scan.review), seen_share=scan.seen, covered_share=scan.covered, area_share=scan.area_share,
        folded_share=scan.measures.folded, area_factor=scan.measures.area_change, distance_mean=mean, distance_p95=p95,
        distance_p99=p99, distance_max=largest, moved_share=list(scan.moved), cpu_s=list(scan.seconds),
        landmark_rms=scan.landmarks if np.isfinite(scan.landmarks) else None, mirrored=scan.mirrored,
        scale=float(scan.scale), size=scan.T_scan_template.scale * mean_size, unit_ratio=float(scan.unit_ratio),
    )  # fmt: skip


@dataclass(frozen=True)
class CorrespondenceFolder:
    """The output folder of a correspondence: its content, and the files that a run writes into it, all or nothing.

    Args:
        path: path of the folder.
    """

    path: Path

    @contextlib.contextmanager
    def writing(self) -> Generator[CorrespondenceFolder]:
        """Yield the folder, locked against other writing runs, after an interrupted change of it was completed.

        Raises:
            FileError: another run writes into the folder, or files cannot be moved.
        """
        with only_writer(self.path):
            self._complete_change()
            yield self

    def read(self) -> tuple[CorrespondenceRecord, dict[str, CorrespondRecord]]:
        """Return the summary, and all records by name, those in correspondence first.

        Raises:
            FileError, FileFormatError: a file cannot be read, or is damaged.
        """
        summary = CorrespondenceRecord.from_json(json_of(self.path / SUMMARY), str(self.path / SUMMARY))
        files = {name: self.path / f"{name}{RECORD}" for name in (*summary.corresponding, *summary.set_aside)}
        return summary, {
            name: read(CorrespondRecord, json_of(file), str(file), CORRESPOND_AGAIN) for name, file in files.items()
        }

    def finished(
        self, inputs_hash: str, names: Sequence[str]
    ) -> tuple[CorrespondenceRecord, list[CorrespondRecord]] | None:
        """Return summary and records of a finished run with the same inputs whose files are intact; else None."""
        try:
            summary, records = self.read()
            is_same = summary.inputs_hash == inputs_hash and summary.results_hash == self.hash_of(summary)
            return (summary, [records[name] for name in names]) if is_same else None
        except (ShapespaceError, KeyError):
            return None

    def hash_of(self, summary: CorrespondenceRecord, change: Path | None = None) -> str:
        """Return the SHA-256 of the names and contents of all files of a correspondence, except its summary.

        Each file is that of the folder `change` where it has it.
        """
        every = sorted([*summary.corresponding, *summary.set_aside])
        records = [[f"{name}{RECORD}", *([f"{name}{SURFACE}"] * (name in summary.corresponding))] for name in every]
        folders, digest = [self.path] if change is None else [change, self.path], hashlib.sha256()
        for name in (MEAN, LANDMARKS, *(file for files in records for file in files)):
            # A mean has landmarks of its own, or none.
            places = folders[:1] if name == LANDMARKS and (folders[0] / MEAN).is_file() else folders
            file = next((folder / name for folder in places if (folder / name).is_file()), None)
            if file is not None:
                digest.update(f"{name} {sha256_of_file(file)}\n".encode())
        return digest.hexdigest()

    def publish(
        self,
        made: Correspondence,
        records: Sequence[CorrespondRecord],
        summary: CorrespondenceRecord,
        *,
        with_mean: bool,
    ) -> CorrespondenceRecord:
        """Write results apart, the summary last, then move them into the folder; return the summary with their hash.

        Raises:
            FileError: they cannot be written.
        """
        change = make_folder(self.path / CHANGE_FOLDER)
        surfaces = {mesh.name: replace(mesh, landmarks={}) for mesh in made.meshes()}
        for record in records:
            if not record.reason:
                surface = surfaces[record.name]
                write_mesh(change / f"{record.name}{SURFACE}", mirror_image(surface) if record.mirrored else surface)
            write_text(change / f"{record.name}{RECORD}", json_text(record))
        if with_mean:
            make_folder((change / MEAN).parent)
            write_mesh(change / MEAN, made.template)
            if made.landmarks:
                write_surface_landmarks(change / LANDMARKS, made.landmarks)
        summary = structs.replace(summary, results_hash=self.hash_of(summary, change))
        write_text(change / SUMMARY, json_text(summary))
        self._complete_change()
        shutil.rmtree(self.path / ROUNDS_FOLDER, ignore_errors=True)
        return summary

    def _complete_change(self) -> None:
        """Move the files of a change into the folder if all are written; otherwise remove those that were written.

        A folder that is left in between has no summary, so that nothing takes it; this function then completes it.

        Raises:
            FileError: they cannot be moved.
        """
        folder, change = self.path, self.path / CHANGE_FOLDER
        if (change / SUMMARY).is_file():
            summary = CorrespondenceRecord.from_json(read_json(change / SUMMARY, CORRESPOND_AGAIN))
            remove_file(folder / SUMMARY)
            for name in summary.set_aside:
                remove_file(folder / f"{name}{SURFACE}")
            if (change / MEAN).is_file():
                make_folder((folder / MEAN).parent)
                if not (change / LANDMARKS).is_file():
                    remove_file(folder / LANDMARKS)
            results = (file for pattern in (RECORD, SURFACE) for file in sorted(change.glob(f"*{pattern}")))
            for file in (*results, change / MEAN, change / LANDMARKS):
                if file.is_file():
                    move_file(file, folder / file.relative_to(change))
            self.forget_others({*summary.corresponding, *summary.set_aside})
            move_file(change / SUMMARY, folder / SUMMARY)
        shutil.rmtree(change, ignore_errors=True)

    def forget_others(self, names: set[str]) -> int:
        """Remove the results of scans other than `names`, and return of how many."""
        files = sorted(self.path.glob(f"*{RECORD}"))
        old = [file for file in files if file.name.removesuffix(RECORD) not in names]
        for file in old:
            remove_file(self.path / (file.name.removesuffix(RECORD) + SURFACE))
            remove_file(file)
        return len(old)
