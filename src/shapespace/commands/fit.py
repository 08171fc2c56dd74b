"""Command `fit`: a model and scans in files to result files in a folder."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from shapespace.batch.executors import ExecutionConfig, Serial
from shapespace.batch.fit_records import source_of
from shapespace.batch.fit_work import FitJob
from shapespace.batch.progress import progress, telling_of_compiling
from shapespace.batch.result_folder import RECORD
from shapespace.batch.run import STORE_FROM, BatchConfig, FolderSink, Plan, StoreSink, fit_many, make_jobs
from shapespace.commands.inputs import (
    PART,
    Given,
    LandmarkFiles,
    expand_part_folders,
    given_scans,
    is_of_fit,
    join_specimens,
    with_ids,
)
from shapespace.commands.outcome import LISTED, Outcome, exit_code_of, first_lines
from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig
from shapespace.fit.iteration_state import IcpState
from shapespace.fit.method_choices import method_named
from shapespace.geometry.doctor import NON_FINITE
from shapespace.io.files import make_folder, read_bytes, remove_file, write_bytes, write_text
from shapespace.io.landmarks.landmark_io import FIDUCIAL_ENDINGS, read_region
from shapespace.io.meshes.mesh_io import probe_mesh, read_mesh, stem_of
from shapespace.io.remote import is_address
from shapespace.io.tables.table_io import table_rows, table_text
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import first_names
from shapespace.schemas import FitRecord, OverlapRecord
from shapespace.store.manifest import read_manifest

FULL_CHECK_BYTES = 2**28
"""Total size of scans up to which all are read before the first fit (256 MiB: 0.4 s of binary PLY, 14 s of OBJ)."""
_STATUSES = ("converged", "max_iterations", "doubtful", "failed")
_SURFACES = (".fitted.ply", ".dense.ply")


def fit(
    model: Path,
    scans: Sequence[str | Path],
    output: Path,
    config: FitConfig,
    execution: ExecutionConfig,
    *,
    method: str,
    search: str,
    no_contact: bool,
    region: str | None,
    landmarks: Path | None,
    again: bool,
    stages: bool,
    recursive: bool,
    store: bool,
    strict: bool,
    quiet: bool,
    say: Callable[[str], None],
) -> Outcome:
    """Fit scans into a folder; of a store, only counts are returned.

    Args:
        model: file of the model.
        scans: files, folders, patterns, addresses and lists, as `given_scans` takes them.
        output: folder of the results.
        config: settings of each fit, except method and region.
        execution: Executor of the fits.
        method: name of the method.
        search: closest points of the method paper; `auto` for the default of the method.
        no_contact: whether parts must not lie inside each other.
        region: name of a region of the model, or file of its vertices; None for the complete model.
        landmarks: file of the only scan, or folder with a file for each scan, named as the scans; None without
            landmarks, or if a list of scans names the files.
        again: fit also scans whose results are still valid.
        stages: also write the surfaces at each stage.
        recursive: take scans in folders below those given too.
        store: keep results in a store, as for `STORE_FROM` scans or more, and if there is a store.
        strict: whether a doubtful fit makes the exit code 1.
        quiet: no progress.
        say: called with messages on skipped files and on each fit that did not converge.

    Raises:
        FileError: the model cannot be read, or the results not written.
        InputError: one file of landmarks for more than one scan, landmarks of no scan, or no scans.
    """
    config = replace(
        config,
        method=method_named(
            method, **({} if search == "auto" else {"search": search}), **({"no_contact": True} if no_contact else {})
        ),
        region=read_region(region) if region is not None and Path(region).is_file() else region,
    )
    loaded = ShapeModel.load(model)
    scans = expand_part_folders(scans, loaded.parts)
    given = join_specimens(_scans_to_fit(scans, output, recursive=recursive, say=say), loaded.parts)
    one, many = landmark_files(landmarks, len(given))
    make_folder(output)
    write_bytes(output / ".writable", b"")
    remove_file(output / ".writable")
    work = list({job.name: job for job in scan_jobs(given, one, many, output)}.values())
    many.report_unused(say)
    if len(work) < len(given):
        say(f"Scans given more than once are fitted once: {len(work)} of {len(given)}.")
    stored = store or len(work) >= STORE_FROM or read_manifest(output) is not None
    if stored and not store:
        say(f"Results are kept in a store ({output}); shapespace export gives single files back.")
    first = find_suspects(work, quiet=quiet)
    batch = BatchConfig(loaded, model, config, stages, not again, first)
    executor = execution.executor(len(work), quiet=quiet)
    sink = StoreSink(output) if stored else FolderSink(output)
    with (
        progress(len(work), "fitting", "scan", quiet=quiet) as bar,
        telling_of_compiling(quiet=quiet or not isinstance(executor, Serial)),
    ):
        watch = _Watch(bar, say)
        done = fit_many(work, batch, executor, sink, on_plan=watch.plan, on_done=watch.done, on_state=watch.state)
        if len(work) > 1 or stored:
            watch.say_removed()
    _write_list(output, work)
    counts = dict.fromkeys(_STATUSES, 0) | done
    records = {job.name: sink.records[job.name] for job in work if sink.records}

    def facts() -> dict[str, Any]:
        contents = [
            {"name": name, **{key: value for key, value in record.to_json().items() if key != "history"}}
            for name, record in records.items()
        ]
        return {"folder": str(output), "scans": every, **counts, "records": contents}

    every, failed = sum(counts.values()), counts["failed"]
    return Outcome(
        facts,
        _lines(records, counts, output) if failed < every else (),
        exit_code=exit_code_of(failed, every) or int(strict and counts["doubtful"] > 0),
    )


def _lines(records: Mapping[str, FitRecord], counts: Mapping[str, int], folder: Path) -> list[str]:
    fitted = [(name, record) for name, record in records.items() if record.is_fitted]
    noun = "scan" if len(fitted) == LISTED + 1 else "scans"
    lines = first_lines(fitted, _fit_lines, f"more {noun}; all are in {folder / 'coefficients.csv'}")
    every = sum(counts.values())
    statuses = ", ".join(f"{count} {status}" for status, count in counts.items() if count)
    return [*lines, f"{every} {'scan' if every == 1 else 'scans'}: {statuses}; results in {folder}"]


def _fit_lines(named: tuple[str, FitRecord]) -> list[str]:
    name, record = named
    file = record.scan.name
    # A scan that shares its file's name with others is named by its results.
    called = file if stem_of(file) == name else f"{name} ({file})"
    distances, dense = _distances(record.shown), _distances(record.shown_dense, measure="median")
    return [
        f"{called}: {record.status}" + (f": {distances}" if distances else ""),
        *([f"  dense surface: {dense}"] if dense else []),
        *(f"  {note}" for note in record.notes),
    ]


def _distances(overlap: OverlapRecord | None, measure: str = "mean") -> str:
    """Return the overlap distances as text; empty if the record has none."""
    if overlap is None:
        return ""
    distances = [getattr(way, measure) for way in (overlap.model_to_scan, overlap.scan_to_model)]
    if any(value is None or not math.isfinite(value) for value in distances):
        return "scan and model do not overlap"
    shares = [
        f"{100 * (share or 0.0):.0f} % overlap" for share in (overlap.model_seen_share, overlap.scan_covered_share)
    ]
    to = _arrow()
    return (
        f"{measure} distance model{to}scan {distances[0]:.2f} mm ({shares[0]}), "
        f"scan{to}model {distances[1]:.2f} mm ({shares[1]})"
    )


def _arrow() -> str:
    """Return an arrow as the encoding of standard output allows it."""
    try:
        "\N{RIGHTWARDS ARROW}".encode(sys.stdout.encoding or "ascii")
    except (UnicodeEncodeError, LookupError):
        return "->"
    return "\N{RIGHTWARDS ARROW}"


def _write_list(folder: Path, jobs: Sequence[FitJob]) -> None:
    """Write the list of the scans whose results are in a folder, by which `fit` takes them again.

    It has the scans of this run, and those of the earlier list whose results are still there. One scan without
    landmarks and metadata needs no list.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    file, is_store = folder / FitRecord.LIST, read_manifest(folder) is not None
    rows: dict[tuple[str, str], Mapping[str, str]] = {}
    with suppress(ShapespaceError, ValueError, KeyError):  # there is none, or it was changed and is not ours
        header, *earlier = table_rows(read_bytes(file))
        known = [dict(zip(header, row, strict=True)) for row in earlier]
        rows = {
            (row["id"], row.get(PART, "")): row
            for row in known
            if is_store or (folder / f"{row['id']}{RECORD}").is_file()
        }
    for job in jobs:
        marks = {} if job.landmarks is None else {"landmarks": source_of(job.landmarks, "", folder).path}
        for part, scan in (job.parts or {"": job.scan}).items():
            places = {"scan": job.address or source_of(scan, "", folder).path, **marks}
            rows[job.name, part] = {**job.metadata, "id": job.name, **({PART: part} if part else {}), **places}
    columns = list(dict.fromkeys(["id", "scan", *(column for row in rows.values() for column in row)]))
    if len(rows) == 1 and len(columns) == 2 and not file.exists():
        return
    write_text(file, table_text(columns, [[row.get(column, "") for column in columns] for row in rows.values()]))


@dataclass(frozen=True)
class _Watch:
    """Shows the progress of the fits, and prints which did not converge."""

    bar: tqdm[Any]
    say: Callable[[str], None]
    removed: list[str] = field(default_factory=list[str])
    """Names of scans from which triangles were removed, for vertices with non-finite coordinates."""

    def say_removed(self) -> None:
        if self.removed:
            named = first_names(self.removed, LISTED)
            count_text = "1 scan has" if len(self.removed) == 1 else f"{len(self.removed)} scans have"
            self.say(
                f"{count_text} vertices with {NON_FINITE}, which were removed with their triangles ({named}); --strict "
                "rejects such scans."
            )

    def state(self, state: IcpState) -> None:
        self.bar.set_postfix_str(f"phase {state.phase}, iteration {state.iteration}, RMS {state.rms_mm:.2f} mm")

    def plan(self, plan: Plan) -> None:
        for sentence in plan.sentences():
            self.say(sentence)

    def done(self, job: FitJob, record: FitRecord) -> None:
        self.bar.update()
        if any(NON_FINITE in note for note in record.notes):
            self.removed.append(job.name)
        # The record of a valid result in a store has no reason: it was printed when the scan was fitted.
        if record.status == "converged" or not record.reason:
            return
        self.bar.clear()
        # The reason of a failure names the file already.
        failed = record.status == "failed"
        self.say(record.reason if failed else f"{job.label}: {record.status}: {record.reason}")


def find_suspects(jobs: Sequence[FitJob], *, quiet: bool) -> set[str]:
    """Return the names of jobs whose scans probably cannot be read, so that they are done, and reported, first.

    Scans of up to `FULL_CHECK_BYTES` together are read completely; of larger sets, each scan is checked by its first
    64 KiB and its size. Scans at addresses are not fetched twice, and are not checked. A single scan is not checked.
    """
    here = [job for job in jobs if not job.address]
    if len(jobs) < 2 or not here:
        return set()
    total = 0
    for job in here:
        with suppress(OSError):
            total += sum(file.stat().st_size for file in job.files)
    suspects: set[str] = set()
    with progress(len(here), "checking", "scan", quiet=quiet) as bar:
        for job in here:
            try:
                if total > FULL_CHECK_BYTES:
                    for file in job.files:
                        probe_mesh(file)
                elif not all(np.isfinite(read_mesh(file).vertices).all(axis=1).any() for file in job.files):
                    suspects.add(job.name)
            except (ShapespaceError, MemoryError):
                suspects.add(job.name)
            bar.update()
    return suspects


def landmark_files(landmarks: Path | None, scans: int) -> tuple[Path | None, LandmarkFiles]:
    """Return the landmarks of the one scan there is, or those of many in a folder."""
    if landmarks is None or landmarks.is_dir():
        return None, LandmarkFiles.of(landmarks)
    if scans > 1:
        raise InputError(
            "--landmarks belongs to one scan, but several were given; give a folder with a file for each, named as it, "
            "or name the files in the column landmarks of a list of scans."
        )
    return landmarks, LandmarkFiles.of(None)


def scan_jobs(given: Sequence[Given], landmarks: Path | None, many: LandmarkFiles, folder: Path) -> list[FitJob]:
    """Return a job for each scan; the address of a remote scan names it as a path does.

    Args:
        given: the scans.
        landmarks: landmark file of the only scan.
        many: landmark files of many scans; the columns of a list have priority.
        folder: folder of the results.
    """
    many.check_not_shared([scan.path for scan in given if scan.landmarks is None])
    addresses = {scan.path: scan.address for scan in given if scan.address}
    made = with_ids(make_jobs([scan.path for scan in given], landmarks, folder, addresses), given)
    jobs = [
        replace(job, landmarks=scan.landmarks or job.landmarks or many.of_scan(job.scan), parts=scan.parts)
        for job, scan in zip(made, given, strict=True)
    ]
    for job in jobs:
        written = {(folder / f"{job.name}{ending}").resolve() for ending in FIDUCIAL_ENDINGS}
        if job.landmarks is not None and job.landmarks.resolve() in written:
            raise InputError(f"{job.landmarks} would be overwritten by the landmarks of the fit; rename it.")
    return jobs


def _scans_to_fit(
    scans: Sequence[str | Path], folder: Path, *, recursive: bool, say: Callable[[str], None]
) -> list[Given]:
    """Return the files to fit: without the surfaces that earlier runs left, if scans and results are in one folder."""
    scans_found = given_scans(scans, folder, recursive=recursive, say=say)
    here = folder.resolve()
    given = {Path(scan).resolve() for scan in scans if not is_address(str(scan))}

    def is_result(scan: Path | str) -> bool:
        if isinstance(scan, str) or not is_of_fit(scan, _SURFACES):
            return False
        return scan.parent.resolve() == here or not {scan.resolve(), scan.parent.resolve()} & given

    left = [scan for scan in scans_found if not is_result(scan.source)]
    if not left:
        raise InputError(
            f"{folder} contains only results of earlier fits; give the scans, or another folder for results."
        )
    if len(left) < len(scans_found):
        results = len(scans_found) - len(left)
        count_text = "1 surface of an earlier fit is" if results == 1 else f"{results} surfaces of earlier fits are"
        say(f"{count_text} not taken for a scan." if results == 1 else f"{count_text} not taken for scans.")
    return left
