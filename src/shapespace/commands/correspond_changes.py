"""Changes of a finished correspondence: scans are added, registered again or removed, and all others stay bit for bit.

With an update one more round over all scans follows, which computes the mean and all surfaces again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from msgspec import structs

from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.fit_work import FitJob
from shapespace.commands.correspond import (
    CHANGE_FOLDER,
    CorrespondenceFolder,
    CorrespondFiles,
    RoundsWithProgress,
    Say,
    ScansRead,
    bring,
    content_hash_of,
    correspond_files,
    correspond_groups,
    find_jobs,
    inputs_hash_of,
    read_scans,
    with_scans,
)
from shapespace.commands.correspond_parts import check_parts, correspond_each_part
from shapespace.commands.finished_correspondence import FinishedFolder
from shapespace.commands.inputs import TABLE_ENDINGS, LandmarkFiles, expand_part_folders
from shapespace.commands.outcome import Aside, Outcome, first_lines
from shapespace.correspondence.correspondence_result import Correspondence, Corresponding
from shapespace.correspondence.groupwise import FinishedCorrespondence, add_scans
from shapespace.correspondence.scan_status import SurfaceMeasures
from shapespace.correspondence.settings import FEWEST, CorrespondConfig
from shapespace.errors import InputError
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.landmarks.landmark_io import read_surface_landmarks
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, SurfaceReview, to_json
from shapespace.store.corresponding import LANDMARKS, SUMMARY, describe_review, review_summary
from shapespace.types import SurfaceLandmarks

_LISTED = 5  # names in a message, so that it stays short


@dataclass(frozen=True)
class Change:
    """Changes of a finished correspondence; `add`, `redo` and `remove` exclude each other.

    Args:
        add: add the given scans to the finished correspondence in the output folder; all others stay as they are.
        redo: register this scan of the output folder again, from its file as it is now, or from the given scans.
        remove: remove the results of this scan from the output folder.
        update: also compute the mean and all surfaces again, by one more round over all scans.
    """

    add: bool = False
    redo: Sequence[str] = ()
    remove: Sequence[str] = ()
    update: bool = False

    def __bool__(self) -> bool:
        return bool(self.add or self.redo or self.remove or self.update)

    @property
    def option(self) -> str:
        """The option that requests the change."""
        return "--add" if self.add else "--redo" if self.redo else "--remove" if self.remove else "--update"


def change_correspondence(
    change: Change, files: CorrespondFiles, folder: Path, config: CorrespondConfig, *, quiet: bool, say: Say
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    """Change the finished correspondence in `folder`, and return its summary and all records.

    Finished work stays in the folder until the end, so the same command continues from there after an interruption.

    Raises:
        FileError: something cannot be read or written.
        InputError: there is no finished correspondence, it is contradicted, or fewer than two scans would be left.
    """
    if not (folder / SUMMARY).is_file() and not (folder / CHANGE_FOLDER).is_dir():
        raise InputError(
            f"{folder} contains no finished correspondence, and {change.option} needs one; run shapespace correspond "
            f"without {change.option} first."
        )
    with CorrespondenceFolder(folder).writing() as results:
        finished = FinishedFolder.of(results)
        config, summary = finished.config(files, config), finished.summary
        marks = LandmarkFiles.of(files.landmarks)
        for record in finished.records.values():
            marks.of_scan(Path(record.path))  # so that it is not reported as unused
        given = find_jobs(files, folder, say) if files.scans else []
        new = _new_jobs(finished, change, given)
        kept = [name for name in summary.corresponding if name not in (*change.redo, *change.remove)]
        old = _old_jobs(finished, change, given) if change.update else []
        jobs = list({job.name: job for job in (*old, *new)}.values())
        marks.check_not_shared([job.scan for job in jobs if job.landmarks is None])
        what = [change.option, sorted({*change.redo, *change.remove}), change.update]
        inputs_hash = inputs_hash_of(sorted(jobs, key=lambda job: job.name), marks, files, config, what)
        if inputs_hash == summary.inputs_hash or not (new or change.remove or change.update):
            say(f"{folder} already contains the results of this command; nothing is computed.")
            return summary, list(finished.records.values())
        finished.check_names(change.remove, "--remove")
        if len(kept) < (1 if new else FEWEST):
            raise InputError(
                f"{change.option} leaves {len(kept)} of the scans in {folder} as they are, which are too few; run "
                "shapespace correspond on all scans instead."
            )
        read = read_scans(jobs, marks, strict=files.strict, outer=config.outer, quiet=quiet, say=say)
        _check_unchanged(finished, read, files, kept if change.update else [])
        first = {finished.records[name].hash: name for name in kept if name not in read.scans}
        for name, content_hash in read.hashes.items():
            if name in read.notes and content_hash in first:
                read.notes[name].append(f"It is {first[content_hash]} again; exclude one of the two.")

        def make(rounds: RoundsWithProgress) -> Correspondence:
            return _register_scans(
                finished, kept, read, marks, replace(config, outer=False), rounds, update=change.update
            )

        made, records = bring(jobs, read, marks, files, finished.results, make, quiet=quiet, say=say)
        every = {name: record for name, record in finished.records.items() if name not in change.remove}
        every |= {record.name: record for record in records}
        summary = structs.replace(_summary(finished, change, records, every), inputs_hash=inputs_hash)
        if change.update:
            summary = structs.replace(summary, rounds=[*summary.rounds, *made.moved])
        else:
            done = "removed from" if change.remove else "registered to the mean in"
            count = len(set(change.remove)) or sum(not record.reason for record in records)
            were = "scan was" if count == 1 else "scans were"
            say(f"{count} {were} {done} {folder}; the other {len(kept)} are unchanged.")
        summary = finished.results.publish(made, records, summary, with_mean=change.update)
        return summary, list(every.values())


# Which scans


def _new_jobs(finished: FinishedFolder, change: Change, given: Sequence[FitJob]) -> list[FitJob]:
    """Return the scans that are registered to the mean: new ones, or those that are registered again."""
    if change.add:
        return _jobs_to_add(finished, given)
    finished.check_names(change.redo, "--redo")
    if given and not (change.redo or change.update):
        raise InputError("--remove takes the names of scans, and no files; omit the files.")
    by_name = {job.name: job for job in given}
    if given and (unnamed := [name for name in change.redo if name not in by_name]):
        raise InputError(f"None of the given scans is named {unnamed[0]}; rename its file, or give a list with ids.")
    return [by_name.get(name) or finished.job(name) for name in dict.fromkeys(change.redo)]


def _jobs_to_add(finished: FinishedFolder, given: Sequence[FitJob]) -> list[FitJob]:
    """Return the `given` scans that the correspondence does not have yet; it has no others of the same names."""
    if not given:
        raise InputError("--add needs scans; give their files or folders.")
    for job in given:
        record = finished.records.get(job.name)
        if record is not None and record.hash and record.hash != content_hash_of(job):
            raise InputError(
                f"{job.label} differs from the scan {job.name} in {finished.results.path}; register it again with "
                f"--redo {job.name}, or rename its file."
            )
    return [job for job in given if job.name not in finished.records]


def _old_jobs(finished: FinishedFolder, change: Change, given: Sequence[FitJob]) -> list[FitJob]:
    """Return the scans of the correspondence that stay in it, from the `given` scans or from where they were."""
    moved = {} if change.add else {job.name: job for job in given}
    names = [name for name in finished.records if name not in (*change.redo, *change.remove)]
    return [moved.get(name) or finished.job(name) for name in names]


def _check_unchanged(finished: FinishedFolder, read: ScansRead, files: CorrespondFiles, kept: Sequence[str]) -> None:
    """Raise InputError if a scan of `kept` has changed, or if a scan had landmarks that are not given."""
    for name in kept:
        record = finished.records[name]
        if name in read.unread:
            raise InputError(f"--update reads all scans again, and {name} is {read.unread[name]}")
        if read.hashes[name] != record.hash:
            raise InputError(f"{record.path} has changed since it was registered; run --redo {name} before --update.")
    is_listed = any(str(scan).lower().endswith(TABLE_ENDINGS) for scan in files.scans)  # with its landmarks, if any
    for name, scan in read.scans.items():
        had = name in finished.records and finished.records[name].landmark_distances
        if had and not scan.landmarks and files.landmarks is None and not is_listed:
            raise InputError(f"{name} was registered with landmarks; give them again with --landmarks, or by a list.")


# Their registration


def _register_scans(
    finished: FinishedFolder,
    kept: Sequence[str],
    read: ScansRead,
    marks: LandmarkFiles,
    config: CorrespondConfig,
    rounds: RoundsWithProgress,
    *,
    update: bool,
) -> Correspondence:
    """Return the correspondence of the scans in `read`, which with an update are all; `kept` are prior."""
    if not read.scans:
        return Correspondence(finished.mean, (), "", ())
    added = [scan for name, scan in read.scans.items() if not update or name not in kept]
    raw = [read.scans[name] for name in kept] if update else []
    file = finished.results.path / LANDMARKS
    landmarks = read_surface_landmarks(file) if file.is_file() else SurfaceLandmarks()
    surfaces = [replace(finished.surfaces[name], name=name) for name in kept]
    if not landmarks and not raw:  # the landmarks of scans that stay determine where the mean has them
        paths = [Path(finished.records[name].path) for name in kept]
        surfaces = [marks.onto(surface, path) for surface, path in zip(surfaces, paths, strict=True)]
    mirrored = [name in finished.summary.mirrored for name in kept]
    start = FinishedCorrespondence(
        finished.mean, landmarks, surfaces, raw, mirrored, finished.summary.sides_decided,
        judged=[] if update else [_registration_of_record(finished, name) for name in kept],
    )  # fmt: skip
    return add_scans(start, added, config, run=rounds)


def _registration_of_record(finished: FinishedFolder, name: str) -> Corresponding:
    """Return the registration of a scan that is kept unchanged, from its record and its surface."""
    record, surface, mean = finished.records[name], finished.surfaces[name], finished.mean.vertices
    observed = np.ones(len(mean), np.bool_) if surface.observed is None else surface.observed
    T = fit_similarity(mean[observed], surface.vertices[observed])
    return Corresponding(
        name, "", T_scan_template=T, distance=(np.nan, record.distance_p95 or np.nan, np.nan, np.nan),
        measures=SurfaceMeasures.of_record(record, T.scale * rms_size(mean)), scale=record.scale or np.nan,
        unit_ratio=record.unit_ratio, area_share=record.area_share,
    )  # fmt: skip


# The folder


def _summary(
    finished: FinishedFolder,
    change: Change,
    records: Sequence[CorrespondRecord],
    every: Mapping[str, CorrespondRecord],
) -> CorrespondenceRecord:
    """Return the summary of the scans in `every`, of which `records` are new."""
    summary = with_scans(finished.summary, list(every.values()))
    there, aside = summary.corresponding, summary.set_aside
    if len(there) < FEWEST:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(aside.items())[:_LISTED])
        raise InputError(f"Only {len(there)} of {len(every)} scans would be in correspondence: {reasons}.")
    other_kinds = [[name for name in group if name in aside] for group in finished.summary.groups[1:]]
    groups = [group for group in other_kinds if group]
    added = dict.fromkeys([*finished.summary.added, *(record.name for record in records)])
    return structs.replace(
        summary,
        groups=[there, *groups] if groups else [],
        added=[] if change.update else [name for name in added if name in there],
    )


def correspond(
    scans: Sequence[str | Path],
    output: Path,
    config: CorrespondConfig,
    change: Change,
    execution: ExecutionConfig,
    *,
    template: Path | None,
    model: Path | None,
    landmarks: Path | None,
    subjects: str | None,
    groups: bool,
    parts: Sequence[str] | None,
    recursive: bool,
    strict: bool,
    quiet: bool,
    say: Callable[[str], None],
) -> Outcome:
    """Bring scans into correspondence, or change a finished correspondence.

    Args:
        scans: files, folders, patterns, addresses and lists of scans.
        output: folder of the results, or of the finished correspondence.
        config: settings.
        change: changes of the finished correspondence.
        execution: Executor of the registrations.
        template: mesh of the first template, or None.
        model: model of the first template, or None.
        landmarks: folder of landmark files that are named as the scans, or None.
        subjects: column of the list of scans.
        groups: bring each kind of object into correspondence.
        parts: names of the parts of each specimen, or None.
        recursive: take scans in folders below those given too.
        strict: exclude scans with non-finite coordinates.
        quiet: no progress.
        say: called with each message.

    Raises:
        FileError: something cannot be read or written.
        InputError: options that exclude each other, or too few scans.
    """
    if change and groups:
        raise InputError(f"--groups cannot be combined with {change.option}; omit one of the two options.")
    if subjects and (change or groups):
        other = change.option if change else "--groups"
        raise InputError(f"--subjects cannot be combined with {other}; omit one of the two options.")
    if not (change or scans):
        raise InputError("Give scans, or a change of a finished correspondence by --redo, --remove or --update.")
    files = CorrespondFiles(scans, template, model, landmarks, execution, recursive, strict, subjects)
    if change and (output / SUMMARY).is_file():
        of_folder = list(CorrespondenceFolder(output).read()[0].parts)
        if parts is not None and parts != of_folder:
            raise InputError(f"{output} has the parts {', '.join(of_folder) or 'of one structure'}; omit --parts.")
        parts = of_folder or None
    if parts:
        if groups:
            raise InputError("--groups cannot be combined with --parts; omit one of the two options.")
        files = replace(files, scans=expand_part_folders(scans, parts), parts=parts)
        summary, records = _correspond_parts(change, files, output, config, quiet=quiet, say=say)
    elif change:
        summary, records = change_correspondence(change, files, output, config, quiet=quiet, say=say)
    else:
        bring = correspond_groups if groups else correspond_files
        summary, records = bring(files, output, config, quiet=quiet, say=say)
    facts = {"folder": str(output), **to_json(summary), "records": to_json(records)}
    return Outcome(facts, _lines(summary, records, output), exit_code=int(bool(summary.set_aside)))


def _correspond_parts(
    change: Change, files: CorrespondFiles, output: Path, config: CorrespondConfig, *, quiet: bool, say: Say
) -> tuple[CorrespondenceRecord, list[CorrespondRecord]]:
    """Bring the scans of several parts into correspondence, or change it in the parts that have the named scans."""

    def run(own: CorrespondFiles, folder: Path) -> FinishedFolder:
        if not change:
            correspond_files(own, folder, config, quiet=quiet, say=say)
        elif own.mirrored is None:
            known = CorrespondenceFolder(folder).read()[1]
            of_part = replace(
                change,
                redo=[name for name in change.redo if name in known],
                remove=[name for name in change.remove if name in known],
            )
            if of_part and (find_jobs(own, folder, say) if own.scans and change.add else True):
                change_correspondence(of_part, own, folder, config, quiet=quiet, say=say)
        return FinishedFolder.of(CorrespondenceFolder(folder))

    if change:
        FinishedFolder.of(CorrespondenceFolder(output)).check_names([*change.redo, *change.remove], change.option)
    else:
        check_parts(files, output, say)
    return correspond_each_part(files, output, run, say=say)


def _lines(summary: CorrespondenceRecord, records: Sequence[CorrespondRecord], folder: Path) -> list[str]:
    rounds = [
        f"round {number}: vertices moved by {100 * moved:.2f} % of the size (RMS)"
        for number, moved in enumerate(summary.rounds, 1)
    ]
    warnings = [
        f"{record.name} is {'excluded' if record.reason else 'doubtful'}: {record.reason or record.doubt}"
        for record in records
        if record.reason or record.doubt
    ]
    there = [record for record in records if not record.reason]
    unusual = [record for record in there if record.review and not record.doubt]
    warnings += first_lines(
        unusual,
        lambda record: [f"{record.name} needs review: {'; '.join(describe_review(record))}"],
        "more surfaces need review",
    )
    seen = sum(record.seen_share or 0.0 for record in there) / len(there)
    doubtful = sum(bool(record.doubt) for record in there)
    total = (
        f"{len(there)} of {len(records)} scans in correspondence{f' ({doubtful} doubtful)' if doubtful else ''}, "
        f"{summary.vertices} vertices, of which a scan shows {100 * seen:.1f} % on average; results in {folder}"
    )
    review = review_summary(SurfaceReview.of(record.review_codes for record in there))
    reviewed = [f"{review}; inspect them with shapespace report {folder}"] if review else []
    asides = [Aside(f"shapespace: {warning}") for warning in warnings]
    return [summary.template, *rounds, *asides, total, *reviewed, f"next: shapespace build {folder} -o model.h5"]
