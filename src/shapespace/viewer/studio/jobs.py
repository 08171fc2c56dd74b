"""The jobs of a project: commands that run in processes of their own, and their results."""

from __future__ import annotations

import contextlib
import json
import shlex
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct
from msgspec.structs import replace

from shapespace.batch.workers import cores
from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.io.files import make_folder, write_text
from shapespace.schemas import json_text, read
from shapespace.viewer.studio.run_job import CANCEL, EXIT, JOB, LOG, PARTLY, PROGRESS, is_running, start

Status = Literal["waiting", "running", "done", "failed", "cancelled", "interrupted"]
FOLDER = "jobs"
TAKEN = "taken"
"""File in the folder of a job whose result was taken into the project, with sentences on parts that were not."""
_POLL_S = 0.3  # between looks at the running job
_START_S = 30.0  # after which a process that does not lock its folder, and has not ended, is gone
_LOG_END = 4000  # bytes of the log in which the last message is searched
_ENDED: tuple[Status, ...] = ("done", "failed", "cancelled", "interrupted")
_OF_PROJECT = ("inputs/", "scans/", "surfaces/", "groomed/")
"""Folders of scans and lists, to which lists refer: they stay in the project when its results are computed again."""
_PROGRAM = "shapespace: "  # at the beginning of messages
_NO_MESSAGE = "It ended without a message; look at its log."


class Job(Struct, frozen=True, kw_only=True):
    """A command of a project; `job.json` contains all but its status, which follows from the files of its process.

    Args:
        number: number of the job, from 1.
        kind: kind of the command, such as `build`.
        arguments: arguments of the command, relative to the project's folder.
        output: path of the result, relative to the folder.
        before: arguments of the commands that write its input, in order.
        options: flag -> value, as the user chose them.
        on: number of the job whose shapes a question is about.
        scans: id of each specimen whose scan is read -> hash of the scan, if it was checked.
        wanted: whether the job is to run, or has ended.
        status: status of the job.
        code: exit code after the end.
        seconds: run time, s.
        message: last line of the log.
    """

    number: int
    kind: str
    arguments: tuple[str, ...]
    output: str
    before: tuple[tuple[str, ...], ...] = ()
    options: dict[str, Any] = {}
    on: int | None = None
    scans: dict[str, str] = {}
    wanted: bool = True
    status: Status = "waiting"
    code: int | None = None
    seconds: float = 0.0
    message: str = ""

    @property
    def command(self) -> str:
        """The command line; one line per command."""
        return "\n".join(shlex.join(["shapespace", *words]) for words in (*self.before, self.arguments))

    @property
    def paths(self) -> frozenset[str]:
        """Outputs of jobs that its command reads or writes: its arguments, and the first folder of each argument."""
        return frozenset(self.arguments).union(word.partition("/")[0] for word in self.arguments)


@dataclass(frozen=True)
class Order:
    """A command to be run.

    Args:
        arguments: arguments after `shapespace`, relative to the project's folder.
        output: path of the result, relative to the folder.
        before: arguments of the commands that write its input, in order.
        on: number of the job whose shapes a question is about.
        files: path in the project's folder -> content of the files that the commands read.
        scans: id of each specimen whose scan is read -> hash of the scan, if it was checked.
    """

    arguments: tuple[str, ...]
    output: str
    before: tuple[tuple[str, ...], ...] = ()
    on: int | None = None
    files: Mapping[str, str] = field(default_factory=dict[str, str])
    scans: Mapping[str, str] = field(default_factory=dict[str, str])

    def write_files(self, folder: Path) -> None:
        """Write the files that the commands read into the project's folder.

        Raises:
            FileError: they cannot be written.
        """
        for name, content in self.files.items():
            make_folder((folder / name).parent)
            write_text(folder / name, content)


class Jobs:
    """The owner of the jobs of a project, which a thread starts in the order of their numbers.

    A job waits while an earlier one runs or waits that writes what the job reads or writes, or reads what it writes.

    Args:
        folder: folder of the project.
        changed: function that is called when a job changed.
        takers: kind of a job -> function that takes the result of such a job into the project, called once after it
            succeeded, also if the studio was closed then; it returns sentences on the parts that were not taken.
        at_once: largest number of running jobs (default: half of the cores, as many commands use several).
        read_only: whether to only read the jobs; nothing is started or written.
    """

    def __init__(
        self,
        folder: Path,
        changed: Callable[[], None],
        takers: Mapping[str, Callable[[Job], Sequence[str]]] | None = None,
        *,
        at_once: int | None = None,
        read_only: bool = False,
    ) -> None:
        self._at_once = max(1, cores() // 2) if at_once is None else at_once
        self._folder = folder / FOLDER
        self._takers = takers or {}
        self._changed = changed
        self._lock = threading.RLock()
        self._jobs: dict[int, Job] = {}
        self._started: dict[int, float] = {}
        self._alive: dict[int, float] = {}
        self._seen_progress: dict[int, int] = {}
        self._stop = threading.Event()
        for path in sorted(self._folder.glob(f"*/{JOB}")):
            with contextlib.suppress(OSError, ValueError):
                job = read(Job, json.loads(path.read_text(encoding="utf-8")), str(path), "remove it")
                self._jobs[job.number] = self._with_status(job)
        self._thread = threading.Thread(target=self._work, name="studio jobs", daemon=True)
        if not read_only:
            self._write_history()
            for job in self.all():
                self._take(job)
            self._thread.start()

    def all(self) -> list[Job]:
        """Return all jobs, the oldest first."""
        with self._lock:
            return [self._jobs[number] for number in sorted(self._jobs)]

    def get(self, number: int) -> Job:
        """Return a job.

        Raises:
            InputError: there is no such job.
        """
        with self._lock:
            if number not in self._jobs:
                raise InputError(f"There is no job {number}; reload the page.")
            return self._jobs[number]

    def add(self, kind: str, make: Callable[[int, list[Job]], Order], options: Mapping[str, Any] | None = None) -> Job:
        """Add a job.

        Args:
            kind: kind of the command.
            make: function that returns its command, given its number and the earlier jobs.
            options: flag -> value, as the user chose them.

        Raises:
            FileError: its files cannot be written.
        """
        with self._lock:
            number = max(self._jobs, default=0) + 1
            made = make(number, self.all())
            made.write_files(self._folder.parent)
            job = Job(
                number=number, kind=kind, arguments=made.arguments, output=made.output, before=made.before,
                options=dict(options or {}), on=made.on, scans=dict(made.scans),
            )  # fmt: skip
            make_folder(self.folder_of(job))
            self._put(job)
            return job

    def cancel(self, number: int) -> None:
        """Interrupt a running job, or take a waiting one out of the queue."""
        with self._lock:
            job = self.get(number)
            if job.status == "running":
                (self.folder_of(job) / CANCEL).touch()
            elif job.status == "waiting":
                self._put(replace(job, wanted=False, status="cancelled", message="It was cancelled before it began."))

    def go_on(self, number: int) -> None:
        """Queue a job that did not succeed again; commands continue from the complete results.

        Raises:
            InputError: it waits, runs or succeeded.
        """
        with self._lock:
            job = self.get(number)
            if job.status not in ("failed", "cancelled", "interrupted"):
                raise InputError(f"Job {number} is {job.status}; only a job that did not succeed can be continued.")
            self._started.pop(number, None)
            for name in (EXIT, CANCEL, PROGRESS):
                (self.folder_of(job) / name).unlink(missing_ok=True)
            self._put(replace(job, wanted=True, status="waiting", code=None, message=""))

    def log(self, number: int) -> str:
        """Return the output of the command."""
        try:
            return (self.folder_of(self.get(number)) / LOG).read_text(encoding="utf-8", errors="replace")
        except OSError:
            return ""

    def problems(self, job: Job) -> str:
        """Return the messages on inputs that a command could not use, and on results that were not taken."""
        messages = [
            line.removeprefix(_PROGRAM)
            for line in self.log(job.number).splitlines()
            if line.startswith(_PROGRAM) and not line.endswith("...")
        ]  # progress ends so
        with contextlib.suppress(OSError):
            messages.append((self.folder_of(job) / TAKEN).read_text(encoding="utf-8"))
        return " ".join(filter(None, messages))

    def progress(self, job: Job) -> dict[str, Any] | None:
        """Return the progress of a running job (`doing`, `done`, `total`, `left_s`); None if it is unknown."""
        try:
            state = json.loads((self.folder_of(job) / PROGRESS).read_text(encoding="utf-8"))
            done, total, began = float(state["done"]), float(state["total"] or 0), float(state["began"])
        except (OSError, ValueError, TypeError, KeyError):
            return None
        left = (time.time() - began) * (total - done) / done if done and total else None
        return {"doing": str(state["doing"]), "done": done, "total": total or None, "left_s": left}

    def running_for(self, job: Job) -> float:
        """Return the run time of a job, s."""
        return time.time() - self._started.get(job.number, time.time()) if job.status == "running" else job.seconds

    def folder_of(self, job: Job) -> Path:
        """Return the folder of the files of a job."""
        return self._folder / f"{job.number:04d}"

    def close(self) -> None:
        """End the thread; a running job continues."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _put(self, job: Job) -> None:
        stored = replace(job, status="waiting", message="", code=None, seconds=0.0)
        write_text(self.folder_of(job) / JOB, json_text(stored))
        self._jobs[job.number] = job
        self._changed()

    def _work(self) -> None:
        while not self._stop.wait(_POLL_S):
            with self._lock:
                for job in self.all():
                    if job.status == "running":
                        self._set(self._with_status(job))
                jobs = self.all()
                active = [job for job in jobs if job.status == "running"]
                free = self._at_once - len(active)
                for job in jobs:
                    if job.status == "waiting" and free > 0:
                        if not any(job.output in other.paths or other.output in job.paths for other in active):
                            self._start(job)
                            free -= 1
                        active.append(job)  # later jobs do not overtake it if it waits

    def _start(self, job: Job) -> None:
        self._started[job.number] = self._alive[job.number] = time.time()
        try:
            start(self.folder_of(job))
        except OSError as error:
            self._put(replace(job, wanted=False, status="failed", message=f"It cannot be started: {error.strerror}."))
        else:
            self._set(replace(job, status="running"))

    def _set(self, job: Job) -> None:
        stamp = self._progress_stamp(job)
        if job != self._jobs[job.number] or stamp != self._seen_progress.get(job.number):
            self._seen_progress[job.number] = stamp
            self._jobs[job.number] = job
            if job.status == "done":
                self._write_history()
                self._take(job)
            self._changed()

    def _take(self, job: Job) -> None:
        """Take the result of a job into the project; on a full disk it is tried again when the project is opened."""
        taken = self.folder_of(job) / TAKEN
        if job.status == "done" and job.kind in self._takers and not taken.exists():
            with contextlib.suppress(ShapespaceError, OSError):
                write_text(taken, " ".join(self._takers[job.kind](job)))

    def _write_history(self) -> None:
        """Write `history.sh` into the project's folder; a full disk does not prevent the end of a job."""
        with contextlib.suppress(FileError):
            write_text(self._folder.parent / "history.sh", history(self.all()))

    def _progress_stamp(self, job: Job) -> int:
        try:
            return (self.folder_of(job) / PROGRESS).stat().st_mtime_ns
        except OSError:
            return 0

    def _with_status(self, job: Job) -> Job:
        """Return a job with the status that follows from the files of its process."""
        folder = self.folder_of(job)
        if not job.wanted:
            return job if job.status in _ENDED else replace(job, status="cancelled")
        ended = self._exit(folder)
        if ended is not None:
            code = int(ended.get("code", -1))
            status: Status = "done" if code in (0, PARTLY) else "cancelled" if ended.get("cancelled") else "failed"
            seconds = float(ended.get("seconds", 0.0))
            return replace(job, status=status, code=code, seconds=seconds, message=self._last_line(folder))
        if is_running(folder):
            self._started.setdefault(job.number, _modified_s(folder / JOB))
            self._alive[job.number] = time.time()
            return replace(job, status="running")
        if job.status == "running" and time.time() - self._alive.get(job.number, 0.0) < _START_S:
            # Its process is about to lock the folder, or has let go of it and is about to write how it ended.
            return job
        has_begun = job.status == "running" or (folder / LOG).exists()
        message = (
            "It ended without a result, as when the machine was switched off; it can be continued." if has_begun else ""
        )
        return replace(job, status="interrupted" if has_begun else "waiting", message=message)

    @staticmethod
    def _exit(folder: Path) -> Mapping[str, Any] | None:
        try:
            return json.loads((folder / EXIT).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    @staticmethod
    def _last_line(folder: Path) -> str:
        try:
            content = (folder / LOG).read_bytes()[-_LOG_END:].decode("utf-8", errors="replace")
        except OSError:
            return _NO_MESSAGE
        lines = [line.strip() for line in content.splitlines() if line.strip()]
        messages = [line for line in lines if not line.startswith("next: ")]  # the page itself shows what comes next
        return messages[-1].removeprefix(_PROGRAM) if messages else _NO_MESSAGE


def _modified_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return time.time()


def history(jobs: list[Job]) -> str:
    """Return a shell script that computes the results of all jobs that succeeded again."""
    lines = [
        "#!/bin/sh",
        "# Computes the results of this project again, from its inputs, in the folder given: sh history.sh FOLDER",
        "set -u",
        'PROJECT=$(cd "$(dirname "$0")" && pwd)',
        'mkdir -p "${1:?Give a new folder for the results.}" && cd "$1" || exit 2',
        'run() { "$@"; code=$?; [ $code -le 1 ] || { echo "This command failed: $*" >&2; exit $code; }; }',
    ]
    done = [job for job in jobs if job.status == "done"]
    # Outputs that a job reads by its arguments; others are in lists, which refer to files of the project.
    outputs = {words[words.index("-o") + 1] for job in done for words in job.before}
    outputs &= {word for job in done for word in job.arguments}
    for arguments in (words for job in done for words in (*job.before, job.arguments)):
        words = [
            f'"$PROJECT"/{shlex.quote(word)}'
            if word.startswith(_OF_PROJECT) and word not in outputs
            else shlex.quote(word)
            for word in arguments
        ]
        lines.append(" ".join(["run", "shapespace", *words]))
    return "\n".join(lines) + "\n"
