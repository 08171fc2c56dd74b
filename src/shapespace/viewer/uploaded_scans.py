"""Uploaded scans: a folder for each one, a queue of fits in processes of their own, and bounds on what is kept."""

from __future__ import annotations

import secrets
import shutil
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from shapespace.batch.workers import cores
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.fitting import NAME, PICTURE, PREVIEW, STOPPED, Message, Upload, Worker, fit_upload, run_worker

FOLDER_PREFIX = "shapespace-view-"
"""Prefix of the temporary folder of a viewer."""
MIN_LANDMARKS = 3  # landmarks that determine a pose
_RESULT_FILES = (
    PREVIEW,
    PICTURE,
    *(f"{NAME}.{kind}" for kind in ("fit.json", "fitted.ply", "dense.ply", "stages.npz")),
)
_STATUSES_TO_REFIT = ("doubtful", "failed", "max_iterations")
"""Placing landmarks can help these fits."""


@dataclass(frozen=True)
class UploadLimits:
    """Bounds on uploads and fits.

    Args:
        upload_bytes: largest scan.
        request_bytes: largest body of any other request.
        unfinished: scans that may be uploading, waiting or being fitted.
        max_fits: largest number of fitted scans in memory; the oldest is removed.
        fit_s: seconds that a fit may take.
    """

    upload_bytes: int = 200 * 2**20
    request_bytes: int = 2**20
    unfinished: int = 3
    max_fits: int = 8
    fit_s: float = 600.0


@dataclass(eq=False)
class UploadedScan:
    """An uploaded scan and the progress of its fit.

    Args:
        key: a random name of our own.
        name: the user's file name, for display only.
        folder: folder of the upload and its results.
        upload: the uploaded file; None once it is removed.
        dense: whether the fit includes the dense surface.
        state: waiting, fitting or done.
        events: messages of the fit so far; only the fit's thread appends.
        stop: event that stops the fit when it is set.
        future: future of the fit.
    """

    key: str
    name: str
    folder: Path
    upload: Path | None
    dense: bool
    state: str = "waiting"
    events: list[Message] = field(default_factory=list[Message])
    stop: threading.Event = field(default_factory=threading.Event)
    future: Future[None] | None = None

    def facts(self) -> dict[str, Any]:
        """Return the row of this scan in the list of scans."""
        return {
            "id": self.key,
            "name": self.name,
            "state": self.state,
            "dense": self.dense,
            "can_place_landmarks": self.state == "done" and self.upload is not None,
        }


class Scans:
    """The uploaded scans of one viewer and the queue of their fits. Call `close` when the viewer ends.

    Args:
        root: an empty folder that only this user can read; the caller removes it.
        model: model that is fitted to the scans.
        model_name: name of the model, for the records.
        limits: bounds on uploads and fits.
        worker: function that fits one scan in a process of its own.
    """

    def __init__(
        self,
        root: Path,
        model: ShapeModel,
        model_name: str,
        limits: UploadLimits | None = None,
        *,
        worker: Worker = fit_upload,
    ) -> None:
        self.root = root
        self.limits = limits or UploadLimits()
        self._model_name = model_name
        self._has_landmarks = len(model.landmarks) >= MIN_LANDMARKS
        self._worker = worker
        self._scans: dict[str, UploadedScan] = {}
        self._lock = threading.Lock()
        self._executor = ThreadPoolExecutor(cores(), thread_name_prefix="fit")
        self._model_file = root / "model.h5"
        model.save(self._model_file)

    def all(self) -> list[UploadedScan]:
        """Return all scans, oldest first."""
        with self._lock:
            return list(self._scans.values())

    def get(self, key: str) -> UploadedScan | None:
        """Return the scan with this key, None if there is none."""
        return self._scans.get(key)

    def unfinished(self) -> int:
        """Return the number of scans that wait or are being fitted."""
        return sum(scan.state != "done" for scan in self.all())

    def queue_position(self, scan: UploadedScan) -> int:
        """Return the place in the queue, 1 for the next scan; 0 if `scan` does not wait."""
        waiting = [other for other in self.all() if other.state == "waiting"]
        return waiting.index(scan) + 1 if scan in waiting else 0

    def new_folder(self) -> Path:
        """Create a folder for one scan, readable by this user only."""
        folder = self.root / secrets.token_hex(12)
        folder.mkdir(mode=0o700)
        return folder

    def add(self, name: str, upload: Path, *, dense: bool = False) -> UploadedScan:
        """Queue the fit of an uploaded file that lies alone in a folder from `new_folder`."""
        scan = UploadedScan(upload.parent.name, name, upload.parent, upload, dense)
        self._queue(scan, None)
        with self._lock:
            self._scans[scan.key] = scan
            done = [other for other in self._scans.values() if other.state == "done"]
            surplus = done[: max(0, len(self._scans) - self.limits.max_fits)]
        for old in surplus:
            self.remove(old)
        return scan

    def refit(self, scan: UploadedScan, landmarks: Path) -> None:
        """Fit a scan again, starting from landmarks."""
        for name in _RESULT_FILES:
            (scan.folder / name).unlink(missing_ok=True)
        scan.events, scan.stop, scan.state = [], threading.Event(), "waiting"
        self._queue(scan, landmarks)

    def remove(self, scan: UploadedScan) -> None:
        """Stop the fit of a scan and remove its files."""
        with self._lock:
            self._scans.pop(scan.key, None)
        scan.stop.set()
        assert scan.future is not None
        scan.future.cancel()
        # Immediately if the fit has ended or has not begun.
        scan.future.add_done_callback(lambda _: shutil.rmtree(scan.folder, ignore_errors=True))

    def close(self) -> None:
        """Stop all fits and wait until their processes have ended."""
        for scan in self.all():
            self.remove(scan)
        self._executor.shutdown(wait=True, cancel_futures=True)

    def _queue(self, scan: UploadedScan, landmarks: Path | None) -> None:
        assert scan.upload is not None
        upload = Upload(
            scan.upload, scan.name, scan.folder, self._model_file, self._model_name, landmarks, dense=scan.dense
        )
        scan.future = self._executor.submit(self._fit, scan, upload)

    def _fit(self, scan: UploadedScan, upload: Upload) -> None:
        scan.state = "fitting"
        error = run_worker(self._worker, upload, scan.events.append, scan.stop, self.limits.fit_s)
        if error is not None:
            status = "stopped" if error == STOPPED else "failed"
            scan.events.append({"event": "verdict", "status": status, "reason": error, "pictured": False})
        is_readable = any(message["event"] == "scan" for message in scan.events)
        can_help = self._has_landmarks and is_readable and scan.events[-1]["status"] in _STATUSES_TO_REFIT
        if not can_help:
            upload.scan.unlink(missing_ok=True)
            scan.upload = None
        scan.state = "done"
