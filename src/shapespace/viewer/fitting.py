"""One dropped scan, fitted in a process of its own by the call of the command line, and what it tells meanwhile.

What travels between the processes is JSON as bytes; pictures go through files in the scan's own folder.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from shapespace.batch.workers import context

if TYPE_CHECKING:
    from shapespace.model.shape_model import ShapeModel
    from shapespace.report.inputs.staged_fit import StagedFit

PREVIEW = "preview.bin"
PICTURE = "fit.bin"
NAME = "fit"
"""NAME of the result files in the folder of a scan."""

LARGEST_SHOWN = 300_000
"""Triangles of a scan that are sent to the page; the fit uses all."""
_LARGEST_MESSAGE = 2**24
_TOLD = (
    "status", "reason", "shown", "shown_scan_mm", "notes", "start", "seconds", "iterations", "b", "z", "b_stddev",
    "distances_mm",
)  # fmt: skip
"""What the page is told of a record."""
_LOOK_EVERY_S = 0.05

DIED = "The fit ended unexpectedly, most likely for lack of memory; thin the scan and try again."
TOO_LONG = "The fit took longer than {:.0f} minutes and was stopped; thin or crop the scan and try again."
STOPPED = "It was stopped before it came to an end; drop the scan again to start anew."
NO_PROCESS = "The system does not let a process for the fit start; close other programs and try again."


@dataclass(frozen=True)
class Upload:
    """A dropped scan as its worker needs it.

    Args:
        scan: the uploaded file, under a name of our own.
        shown: the file's name as its owner knows it; for messages and the record, never a path.
        folder: where results go.
        model: the model's file.
        model_name: the model's name, for the record.
        landmarks: points to start from, or None.
        dense: whether the surface is then taken the rest of the way to the scan.
    """

    scan: Path
    shown: str
    folder: Path
    model: Path
    model_name: str
    landmarks: Path | None = None
    dense: bool = False


Worker: TypeAlias = Callable[[Connection, Upload], None]
Message: TypeAlias = Mapping[str, Any]


def fit_upload(pipe: Connection, upload: Upload) -> None:
    """Fit `upload` and tell of it: the scan, each state of the loop, the verdict; runs in a worker process."""
    _step_back()
    from shapespace.batch.fit_records import write_record
    from shapespace.batch.fit_work import Job, fit_file
    from shapespace.errors import ShapespaceError
    from shapespace.fit.fit_scan import FitConfig
    from shapespace.fit.iteration_state import IcpState
    from shapespace.model.shape_model import ShapeModel

    def tell(event: str, **facts: Any) -> None:
        pipe.send_bytes(json.dumps({"event": event, **facts}).encode())

    def on_state(state: IcpState) -> None:
        T = state.T_scan_model
        tell(
            "state",
            phase=state.phase,
            iteration=state.iteration,
            rms_mm=state.rms_mm,
            b=state.b.tolist(),
            scale=T.scale,
            rotation=T.rotation.tolist(),
            translation=T.translation.tolist(),
        )

    model = ShapeModel.load(upload.model)
    # A file that cannot be shown cannot be fitted either, and the record says why.
    with contextlib.suppress(ShapespaceError, MemoryError):
        tell("scan", **_preview(model, upload))
    job, config = Job(NAME, upload.scan, upload.landmarks), FitConfig(dense=upload.dense)
    record = fit_file(job, model, upload.model, upload.folder, config, stages=True, on_state=on_state)
    for key, name in (("scan", upload.shown), ("model", upload.model_name)):
        # Our own names and folders mean nothing to the visitor.
        record[key] |= {"name": name, "path": ""}
    record["reason"] = _with_shown_name(str(record["reason"]), upload)
    record |= {"notes": [_with_shown_name(str(note), upload) for note in record["notes"]]} if "notes" in record else {}
    write_record(upload.folder / f"{NAME}.fit.json", record)
    pictured, why = False, ""
    if record["status"] != "failed":
        try:
            _picture(upload)
            pictured = True
        except ShapespaceError as error:
            why = _with_shown_name(str(error), upload)
    tell("verdict", pictured=pictured, why_not=why, **{key: record[key] for key in _TOLD if key in record})


def _preview(model: ShapeModel, upload: Upload) -> dict[str, Any]:
    """Write the scan in mm about an origin of its own, and return what leads from there back to the file's frame."""
    import numpy as np

    from shapespace.errors import FitError
    from shapespace.fit.scan_target import mm_frame
    from shapespace.fit.search.initialisation import find_unit
    from shapespace.geometry.doctor import repair
    from shapespace.io.meshes.mesh_io import read_mesh
    from shapespace.report.render.scene import decimate, pack
    from shapespace.types import MM_PER_UNIT

    scan, _ = repair(read_mesh(upload.scan))
    try:
        mm = MM_PER_UNIT[find_unit(model, scan)]
    except FitError:
        mm = 1.0
    # The frame that the states of the fit are in.
    T_mm_scan = mm_frame(scan, mm)
    placed, _ = decimate(scan.with_vertices(T_mm_scan.apply(scan.vertices)), LARGEST_SHOWN)
    arrays: dict[str, Any] = {"vertices": placed.vertices.astype(np.float32)}
    if placed.faces is not None:
        arrays["faces"] = placed.faces.astype(np.uint32)
    (upload.folder / PREVIEW).write_bytes(pack(arrays, {"name": upload.shown}))
    return {
        "origin": T_mm_scan.inverse().translation.tolist(),
        "mm_per_scan_unit": mm,
        "vertices": len(scan.vertices),
        "triangles": 0 if scan.faces is None else len(scan.faces),
    }


def _picture(upload: Upload) -> None:
    from shapespace.report.inputs.saved_fits import Folder, find_fits, staged_fit

    folder = Folder(upload.folder)
    (found,) = find_fits(folder)
    (upload.folder / PICTURE).write_bytes(packed(staged_fit(folder, found.with_entry(name=upload.shown))))


def packed(staged: StagedFit) -> bytes:
    """Return a fit for the page, with all its iterations; a scan of very many triangles is thinned."""
    from shapespace.report.render.scene import pack_fit

    return pack_fit(staged, most_sent=LARGEST_SHOWN)


def _with_shown_name(sentence: str, upload: Upload) -> str:
    """Return `sentence` with the file's own name in place of ours, and without our folders."""
    ours = f"{re.escape(str(upload.scan))}|{re.escape(upload.scan.name)}"
    for folder in (upload.folder, upload.model.parent):
        sentence = sentence.replace(f"{folder}{os.sep}", "")
    return re.sub(ours, lambda _: upload.shown, sentence)


def _step_back() -> None:
    """Let the server go first: it gets the cores it asks for, and lives when memory ends."""
    if sys.platform != "win32":
        os.nice(5)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000")


def converse(
    worker: Worker, upload: Upload, tell: Callable[[Message], None], stop: threading.Event, limit_s: float
) -> str | None:
    """Run `worker` in a process, hand on what it tells, and return one sentence where it did not reach a verdict.

    Args:
        worker: a function that a new process can import.
        upload: what it is given.
        tell: called with each message, in this thread.
        stop: ends the process when set.
        limit_s: seconds after which it is ended.
    """
    if stop.is_set():
        return STOPPED
    ours, theirs = context().Pipe(duplex=False)
    process = context().Process(target=worker, args=(theirs, upload), daemon=True)
    try:
        process.start()
    except (EOFError, OSError):
        ours.close()
        return NO_PROCESS
    finally:
        theirs.close()
    ends = time.monotonic() + limit_s
    done = False
    try:
        while not done:
            if stop.is_set():
                return STOPPED
            if time.monotonic() > ends:
                return TOO_LONG.format(limit_s / 60)
            if ours.poll(_LOOK_EVERY_S):
                message: dict[str, Any] = json.loads(ours.recv_bytes(_LARGEST_MESSAGE))
                done = message["event"] == "verdict"
                tell(message)
    except (EOFError, OSError, ValueError, KeyError):
        return DIED
    finally:
        process.kill()
        process.join()
        process.close()
        ours.close()
    return None
