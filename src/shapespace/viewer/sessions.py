"""Visitors and their dropped scans: each sees its own, each has a folder of its own, and what is left behind goes."""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import shutil
import threading
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from shapespace.viewer.fitting import NAME, PICTURE, PREVIEW, STOPPED, Message, Upload, Worker, converse, fit_upload
from shapespace.viewer.limits import Limits

_RESULTS = ("fit.json", "fitted.ply", "dense.ply", "stages.npz")
_HELPED_BY_LANDMARKS = ("doubtful", "failed", "max_iterations")


class DroppedScan:
    """A scan that a visitor dropped: its files, and everything the page has been told about it.

    All of it is touched by the server's event loop alone, except `stop`.
    """

    def __init__(self, key: str, name: str, folder: Path, upload: Path, size: int, *, dense: bool = False) -> None:
        self.key = key
        self.name = name
        self.folder = folder
        self.upload: Path | None = upload
        self.size = size
        self.dense = dense
        self.state = "waiting"
        self.run = 0
        self.gone = False
        self.stop = threading.Event()
        self.events: list[Message] = []
        self._changed = asyncio.Event()
        self._watchers = 0
        self._unwatched_since = time.monotonic()

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to come."""
        return self.state == "done"

    def facts(self) -> dict[str, Any]:
        """Return what the list of a visitor's scans says of it."""
        return {
            "id": self.key,
            "name": self.name,
            "state": self.state,
            "dense": self.dense,
            "can_place_landmarks": self.upload is not None,
        }

    def start_over(self) -> None:
        """Forget an earlier fit of the same scan."""
        self.run += 1
        self.state = "waiting"
        self.stop = threading.Event()
        self.events = []
        self._unwatched_since = time.monotonic()
        for name in (PREVIEW, PICTURE, *(f"{NAME}.{kind}" for kind in _RESULTS)):
            (self.folder / name).unlink(missing_ok=True)

    def tell(self, message: Message) -> None:
        """Add a message for everybody who watches."""
        self.events.append(message)
        self._changed.set()
        self._changed = asyncio.Event()

    def unwatched_s(self) -> float:
        """Return for how many seconds nobody has watched."""
        return 0.0 if self._watchers else time.monotonic() - self._unwatched_since

    async def follow(self, closing: Callable[[], bool]) -> AsyncGenerator[Message | None]:
        """Yield every message from the first on, None from time to time while there are none, until it is finished."""
        self._watchers += 1
        run, told = self.run, 0
        try:
            while run == self.run and not closing():
                while told < len(self.events):
                    told += 1
                    yield self.events[told - 1]
                if self.finished or self.gone:
                    return
                changed = self._changed
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), 1.0)
                if not changed.is_set():
                    yield None
        finally:
            self._watchers -= 1
            self._unwatched_since = time.monotonic()


class Session:
    """A visitor."""

    def __init__(self, key: str) -> None:
        self.key = key
        self.seen = time.monotonic()
        self.uploading = 0
        self.scans: dict[str, DroppedScan] = {}

    @property
    def has_scans(self) -> bool:
        """Whether scans of this visitor are here, or on their way."""
        return bool(self.scans) or self.uploading > 0

    def unfinished(self) -> int:
        """Return how many fits run or wait, and how many scans are on their way here."""
        return self.uploading + sum(not scan.finished for scan in self.scans.values())


class Sessions:
    """All visitors, the queue of their fits, and the folder that holds their scans.

    Args:
        root: a folder that only this user can read.
        model: the model's file.
        model_name: for the records.
        with_landmarks: whether the model has any, so that placing them can help.
        limits: what a visitor may use.
        worker: what fits a scan, in a process of its own.
        remove_root: removes `root`; called when all sessions have ended, perhaps twice.
    """

    def __init__(
        self,
        root: Path,
        model: Path,
        model_name: str,
        *,
        with_landmarks: bool,
        limits: Limits,
        worker: Worker = fit_upload,
        remove_root: Callable[[], None],
    ) -> None:
        self.limits = limits
        self.closing = False
        self.root = root
        self._model = model
        self._model_name = model_name
        self._with_landmarks = with_landmarks
        self._worker = worker
        self._remove_root = remove_root
        self._sessions: dict[str, Session] = {}
        self._waiting: list[DroppedScan] = []
        self._threads = ThreadPoolExecutor(limits.fits_at_once, thread_name_prefix="fit")

    def find(self, key: str | None) -> Session | None:
        """Return the session with this key, and note that its visitor is there."""
        session = self._sessions.get(key or "")
        if session is not None:
            session.seen = time.monotonic()
        return session

    def new(self) -> Session:
        """Return a new session; where too many have no scans, the one of them that is idle for longest goes."""
        onlookers = [session for session in self._sessions.values() if not session.has_scans]
        if len(onlookers) >= self.limits.onlookers:
            self._end(min(onlookers, key=lambda session: session.seen))
        session = Session(secrets.token_urlsafe(24))
        self._sessions[session.key] = session
        return session

    def has_room(self, session: Session) -> bool:
        """Return whether `session` may have scans: it has some, or few enough others do."""
        return session.has_scans or sum(one.has_scans for one in self._sessions.values()) < self.limits.visitors

    def kept_bytes(self) -> int:
        """Return how many bytes the dropped files have that wait for a fit or are kept for another."""
        scans = (scan for session in self._sessions.values() for scan in session.scans.values())
        return sum(scan.size for scan in scans if scan.upload is not None)

    def new_folder(self) -> Path:
        """Return a new folder for one scan, for this user alone."""
        folder = self.root / secrets.token_hex(12)
        folder.mkdir(mode=0o700)
        return folder

    def add(
        self, session: Session, name: str, folder: Path, upload: Path, size: int, *, dense: bool = False
    ) -> DroppedScan:
        """Take a scan of `size` bytes that lies in `folder`, and put its fit into the queue."""
        scan = DroppedScan(folder.name, name, folder, upload, size, dense=dense)
        session.scans[scan.key] = scan
        finished = [old for old in session.scans.values() if old.finished]
        for old in finished[: max(0, len(session.scans) - self.limits.kept)]:
            self.remove(session, old)
        self._queue(scan, None)
        return scan

    def fit_again(self, scan: DroppedScan, landmarks: Path) -> None:
        """Fit a finished scan once more, from landmarks."""
        scan.start_over()
        self._queue(scan, landmarks)

    def remove(self, session: Session, scan: DroppedScan) -> None:
        """Stop the fit of a scan if it runs, and remove its files."""
        session.scans.pop(scan.key, None)
        scan.gone = True
        scan.stop.set()
        scan.tell({"event": "removed"})
        if scan.finished:
            shutil.rmtree(scan.folder, ignore_errors=True)
        elif scan in self._waiting:
            self._finish(scan, None)

    def cancel(self, scan: DroppedScan) -> None:
        """Stop the fit of a scan."""
        scan.stop.set()

    def sweep(self) -> None:
        """Stop fits that nobody watches, and end sessions that nobody uses."""
        now = time.monotonic()
        for session in list(self._sessions.values()):
            for scan in session.scans.values():
                if not scan.finished and scan.unwatched_s() > self.limits.unwatched_s:
                    scan.stop.set()
            if session.unfinished() == 0 and now - session.seen > self.limits.idle_s:
                self._end(session)

    async def watch_over(self) -> None:
        """Sweep for as long as the server runs."""
        while True:
            await asyncio.sleep(min(2.0, self.limits.unwatched_s, self.limits.idle_s))
            self.sweep()

    def close(self) -> None:
        """End all sessions, and wait until their processes are gone."""
        self.closing = True
        for session in list(self._sessions.values()):
            self._end(session)
        self._threads.shutdown(wait=True, cancel_futures=True)
        self._remove_root()

    def _end(self, session: Session) -> None:
        del self._sessions[session.key]
        for scan in list(session.scans.values()):
            self.remove(session, scan)

    def _queue(self, scan: DroppedScan, landmarks: Path | None) -> None:
        assert scan.upload is not None
        upload = Upload(scan.upload, scan.name, scan.folder, self._model, self._model_name, landmarks, scan.dense)
        self._waiting.append(scan)
        self._tell_positions()
        stop, loop = scan.stop, asyncio.get_running_loop()

        def on_loop(call: Callable[..., None], *arguments: Any) -> None:
            # The loop is closed when the server ends.
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(call, *arguments)

        def run() -> None:
            on_loop(self._begin, scan)
            sentence = converse(
                self._worker, upload, lambda message: on_loop(scan.tell, message), stop, self.limits.fit_s
            )
            on_loop(self._finish, scan, sentence)
            if self.closing:
                shutil.rmtree(scan.folder, ignore_errors=True)

        self._threads.submit(run)

    def _begin(self, scan: DroppedScan) -> None:
        if scan in self._waiting:
            self._waiting.remove(scan)
            scan.state = "fitting"
            scan.tell({"event": "started"})
        self._tell_positions()

    def _tell_positions(self) -> None:
        for position, scan in enumerate(self._waiting, 1):
            if not scan.events or scan.events[-1].get("position") != position:
                scan.tell({"event": "queue", "position": position})

    def _finish(self, scan: DroppedScan, sentence: str | None) -> None:
        if scan in self._waiting:
            self._waiting.remove(scan)
        if scan.gone:
            scan.state = "done"
            shutil.rmtree(scan.folder, ignore_errors=True)
            return
        if sentence is not None:
            status = "stopped" if sentence == STOPPED else "failed"
            scan.tell({"event": "verdict", "status": status, "reason": sentence, "pictured": False})
        shown = any(message["event"] == "scan" for message in scan.events)
        verdict: Mapping[str, Any] = scan.events[-1]
        helped = self._with_landmarks and shown and verdict["status"] in _HELPED_BY_LANDMARKS
        if not helped and scan.upload is not None:
            scan.upload.unlink(missing_ok=True)
            scan.upload = None
        scan.state = "done"
        scan.tell({"event": "done", "can_place_landmarks": helped})
