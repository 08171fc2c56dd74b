"""Fit one uploaded scan in a process of its own, with the function of the command line, and report its progress.

Messages between the processes are JSON as bytes; large data goes through files in the scan's folder.
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
    from shapespace.report.inputs.saved_fits import StagedFit

PREVIEW = "preview.bin"
PICTURE = "fit.bin"
NAME = "fit"
"""Stem of the result files in the folder of a scan."""

MAX_TRIANGLES = 300_000
"""Triangles of a scan that are sent to the page; the fit uses all."""
_MAX_MESSAGE_BYTES = 2**24  # bytes of a message of the fitting process; a state has some hundred kB
_VERDICT_KEYS = (
    "status", "reason", "shown", "notes", "start", "seconds", "iterations", "b", "z", "b_stddev",
    "distances_mm",
)  # fmt: skip
"""Keys of a record that are sent to the page."""
_POLL_S = 0.05  # seconds between two looks at the stop button, below what a user notices

DIED = "The fit ended unexpectedly, most likely for lack of memory; thin the scan and try again."
TOO_LONG = "The fit took longer than {:.0f} minutes and was stopped; thin or crop the scan and try again."
STOPPED = "The fit was stopped; drop the scan again to restart it."
NO_PROCESS = "The system does not let a process for the fit start; close other programs and try again."


@dataclass(frozen=True)
class Upload:
    """An uploaded scan and the settings of its fit.

    Args:
        scan: the uploaded file, under a name of our own.
        display_name: the user's file name, for messages and the record; never used as a path.
        folder: folder of the results.
        model: file of the model.
        model_name: name of the model, for the record.
        landmarks: file of landmarks to start from, or None.
        dense: whether to compute the dense surface too.
    """

    scan: Path
    display_name: str
    folder: Path
    model: Path
    model_name: str
    landmarks: Path | None = None
    dense: bool = False


Worker: TypeAlias = Callable[[Connection, Upload], None]
Message: TypeAlias = Mapping[str, Any]


def fit_upload(pipe: Connection, upload: Upload) -> None:
    """Fit `upload` and send the scan, each iterate and the verdict through `pipe`; runs in a worker process."""
    lower_priority()
    from msgspec import structs

    from shapespace.batch.fit_records import write_record
    from shapespace.batch.fit_work import FitJob, fit_file
    from shapespace.errors import ShapespaceError
    from shapespace.fit.fit_scan import FitConfig
    from shapespace.fit.iteration_state import IcpState
    from shapespace.model.shape_model import ShapeModel

    def send(event: str, **facts: Any) -> None:
        pipe.send_bytes(json.dumps({"event": event, **facts}).encode())

    def on_state(state: IcpState) -> None:
        T = state.T_scan_model
        send(
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
    # A file that cannot be read cannot be fitted either, and the record contains the reason.
    with contextlib.suppress(ShapespaceError, MemoryError):
        send("scan", **_preview(model, upload))
    job, config = FitJob(NAME, upload.scan, upload.landmarks), FitConfig(dense=upload.dense)
    record = fit_file(job, model, upload.model, upload.folder, config, stages=True, on_state=on_state)
    # Our own names and folders mean nothing to the user.
    record = structs.replace(
        record,
        scan=structs.replace(record.scan, name=upload.display_name, path=""),
        model=structs.replace(record.model, name=upload.model_name, path=""),
        reason=_with_display_name(record.reason, upload),
        notes=tuple(_with_display_name(note, upload) for note in record.notes),
    )
    write_record(upload.folder / f"{NAME}.fit.json", record)
    pictured, error_text = False, ""
    if record.is_fitted:
        try:
            _write_picture(upload)
            pictured = True
        except ShapespaceError as error:
            error_text = _with_display_name(str(error), upload)
    content = record.to_json()
    facts = {key: content[key] for key in _VERDICT_KEYS if key in content}
    send("verdict", pictured=pictured, why_not=error_text, **facts)


def _preview(model: ShapeModel, upload: Upload) -> dict[str, Any]:
    """Write the scan in mm and centred, and return the origin and unit that lead back to the file's frame."""
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
    placed, _ = decimate(scan.with_vertices(T_mm_scan.apply(scan.vertices)), MAX_TRIANGLES)
    arrays: dict[str, Any] = {"vertices": placed.vertices.astype(np.float32)}
    if placed.faces is not None:
        arrays["faces"] = placed.faces.astype(np.uint32)
    (upload.folder / PREVIEW).write_bytes(pack(arrays, {"name": upload.display_name}))
    return {
        "origin": T_mm_scan.inverse().translation.tolist(),
        "mm_per_scan_unit": mm,
        "vertices": len(scan.vertices),
        "triangles": 0 if scan.faces is None else len(scan.faces),
    }


def _write_picture(upload: Upload) -> None:
    from shapespace.report.inputs.saved_fits import Folder, find_fits, staged_fit

    folder = Folder(upload.folder)
    (fit,) = find_fits(folder)
    (upload.folder / PICTURE).write_bytes(pack_staged(staged_fit(folder, fit.with_entry(name=upload.display_name))))


def pack_staged(staged: StagedFit) -> bytes:
    """Return a fit with all its iterations for the page; a scan with too many triangles is thinned."""
    from shapespace.report.render.scene import pack_fit

    return pack_fit(staged, most_sent=MAX_TRIANGLES)


def _with_display_name(sentence: str, upload: Upload) -> str:
    """Return `sentence` with the user's file name in place of ours, and without our folders."""
    own_names = f"{re.escape(str(upload.scan))}|{re.escape(upload.scan.name)}"
    for folder in (upload.folder, upload.model.parent):
        sentence = sentence.replace(f"{folder}{os.sep}", "")
    return re.sub(own_names, lambda _: upload.display_name, sentence)


def lower_priority() -> None:
    """Prefer the server: for processor time, and as the process that survives when memory runs out."""
    if sys.platform != "win32":
        os.nice(5)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            Path("/proc/self/oom_score_adj").write_text("1000")


def run_worker(
    worker: Worker, upload: Upload, on_message: Callable[[Message], None], stop: threading.Event, limit_s: float
) -> str | None:
    """Run `worker` in a process, and return an error sentence if it ends without a verdict.

    Args:
        worker: a function that a new process can import.
        upload: argument of `worker`.
        on_message: called with each message, in this thread.
        stop: event that ends the process when it is set.
        limit_s: seconds after which the process is ended.
    """
    if stop.is_set():
        return STOPPED
    receiver, sender = context().Pipe(duplex=False)
    process = context().Process(target=worker, args=(sender, upload), daemon=True)
    try:
        process.start()
    except (EOFError, OSError):
        receiver.close()
        return NO_PROCESS
    finally:
        sender.close()
    deadline = time.monotonic() + limit_s
    try:
        while not stop.is_set():
            if time.monotonic() > deadline:
                return TOO_LONG.format(limit_s / 60)
            if receiver.poll(_POLL_S):
                message: Message = json.loads(receiver.recv_bytes(_MAX_MESSAGE_BYTES))
                is_verdict = message["event"] == "verdict"
                on_message(message)
                if is_verdict:
                    return None
        return STOPPED
    except (EOFError, OSError, ValueError, KeyError):
        return DIED
    finally:
        process.kill()
        process.join()
        process.close()
        receiver.close()
