"""Process of one job: runs its command, and stays when the studio's server ends.

    python -m shapespace.viewer.studio.run_job FOLDER

FOLDER contains job.json. This process locks FOLDER/lock while it runs, writes the output of the command to
FOLDER/log.txt, and its exit code to FOLDER/exit.json at the end. A file FOLDER/cancel interrupts the command, as Ctrl-C
does.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from filelock import FileLock, Timeout

from shapespace.batch.progress import PROGRESS_VARIABLE
from shapespace.io.files import write_text

JOB, LOG, EXIT, CANCEL, LOCK, PROGRESS = "job.json", "log.txt", "exit.json", "cancel", "lock", "progress.json"
_NEW_GROUP = 0x200 if sys.platform == "win32" else 0  # CREATE_NEW_PROCESS_GROUP
PARTLY = 1  # exit code of commands of which some scans failed
_POLL_S, _PATIENCE_S = 0.1, 20.0  # between looks at the files; after an interruption until the command is killed


def is_running(folder: Path) -> bool:
    """Return whether the process of the job in `folder` runs."""
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return True
    except OSError:
        return False
    lock.release()
    return False


def start(folder: Path) -> None:
    """Start the process of the job in `folder`, detached from this one.

    Raises:
        OSError: it cannot be started.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "shapespace.viewer.studio.run_job", str(folder)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder,
        start_new_session=True, creationflags=_NEW_GROUP,
    )  # fmt: skip
    # Without a wait it would stay in the list of the system after its end.
    threading.Thread(target=process.wait, name="end of a job", daemon=True).start()


def main(folder: Path) -> int:
    """Run the job in `folder`."""
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return 1
    with lock:
        job = json.loads((folder / JOB).read_text(encoding="utf-8"))
        began = time.time()
        code = 0
        for arguments in (*job.get("before", ()), job["arguments"]):
            code = _run(folder, list(arguments))
            if code not in (0, PARTLY):
                break
        done = {"code": code, "seconds": round(time.time() - began, 1), "cancelled": (folder / CANCEL).exists()}
        write_text(folder / EXIT, json.dumps(done))
    return 0


def _run(folder: Path, arguments: list[str]) -> int:
    environment = {**os.environ, PROGRESS_VARIABLE: str(folder / PROGRESS), "PYTHONUNBUFFERED": "1"}
    with (folder / LOG).open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "shapespace", *arguments],
            stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=folder.parents[1],
            env=environment, creationflags=_NEW_GROUP,
        )  # fmt: skip
        interrupted_at = 0.0
        while process.poll() is None:
            time.sleep(_POLL_S)
            if (folder / CANCEL).exists():
                if not interrupted_at:
                    interrupted_at = time.monotonic()
                    process.send_signal(getattr(signal, "CTRL_BREAK_EVENT", signal.SIGINT))
                elif time.monotonic() - interrupted_at > _PATIENCE_S:
                    process.kill()
        return process.returncode


if __name__ == "__main__":
    # A session of its own ignores no signal: the command must be able to be interrupted.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    raise SystemExit(main(Path(sys.argv[1])))
