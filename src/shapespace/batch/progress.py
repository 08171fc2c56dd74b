"""Progress of long steps: a bar in a terminal, otherwise log lines at growing intervals."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

FIRST_LOG_LINE_S = 5.0
"""Seconds until the first log line of a step, if there is no terminal."""
LONGEST_PAUSE_S = 60.0
"""Longest pause between two log lines of a step, s; pauses double up to this limit, to keep logs short."""
PROGRESS_VARIABLE = "SHAPESPACE_PROGRESS"
"""Environment variable with the path of a JSON file from which another program reads the progress."""
_WRITE_EVERY_S = 0.3  # s, shortest time between two writes


if TYPE_CHECKING:
    _Tqdm = tqdm[Any]
else:
    _Tqdm = tqdm


class Bar(_Tqdm):
    """A progress bar that also counts when it is not drawn."""

    counted: float = 0
    """Number of completed items."""

    shown_description = ""
    """Current description."""

    _began, _written_at, _label = 0.0, 0.0, ""

    def update(self, n: float | None = 1) -> bool | None:
        """Add `n` to the count."""
        self.counted += n or 0
        if self._label and time.time() - self._written_at > _WRITE_EVERY_S:
            self._written_at = time.time()
            _write_progress(self._label, self.counted, self.total, self._began)
        return super().update(n)

    def write_to_file(self, label: str) -> None:
        """Write the progress to the file of `PROGRESS_VARIABLE` from now on, with `label`."""
        self._label, self._began = label, time.time()
        _write_progress(label, 0, self.total, self._began)

    def set_description_str(self, desc: str | None = None, refresh: bool | None = True) -> None:
        """Set the description."""
        self.shown_description = desc or ""
        super().set_description_str(desc, bool(refresh))


@contextmanager
def progress(total: int | None, doing: str, unit: str, *, quiet: bool) -> Generator[Bar]:
    """Yield a progress bar on standard error, replaced by log lines without a terminal.

    Args:
        total: number of items, or None if unknown.
        doing: action in the present participle, such as "reading".
        unit: singular noun of the items, such as "mesh".
        quiet: whether to print neither a bar nor log lines.
    """
    several = unit + ("es" if unit.endswith("sh") else "s")
    label = f"{doing} {several}" if total is None else f"{doing} {total} {unit if total == 1 else several}"
    # With disable=None, tqdm checks whether there is a terminal.
    with Bar(total=total, desc=doing, unit=unit, leave=False, disable=True if quiet else None) as bar:
        if not quiet:
            bar.write_to_file(label)

        def state() -> str:
            text = f", {bar.shown_description}" if bar.shown_description else ""
            return f"{text}: {bar.counted:g} of {bar.total:g} done" if bar.counted and bar.total else text

        with _logging_progress(label, state, quiet=quiet):
            yield bar


@contextmanager
def steps(total: int | None, doing: str, unit: str, *, quiet: bool) -> Generator[Callable[[int, int], None]]:
    """Yield a function of (done, total) that updates a bar of `progress`."""
    with progress(total, doing, unit, quiet=quiet) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.counted)

        yield step


@contextmanager
def waiting(label: str, *, quiet: bool) -> Generator[None]:
    """Print the step in progress, such as "finding the modes", on standard error if it cannot be counted."""
    if not quiet:
        _write_progress(label, 0, None, time.time())
    with (
        _logging_progress(label, lambda: "", quiet=quiet),
        tqdm(total=0, desc=f"{label} ...", bar_format="{desc}", leave=False, disable=True if quiet else None),
    ):
        yield


def _write_progress(label: str, done: float, total: float | None, began: float) -> None:
    file = os.environ.get(PROGRESS_VARIABLE)
    if not file:
        return
    state = {"doing": label, "done": done, "total": total, "began": began}
    temporary = Path(f"{file}.{os.getpid()}")
    with contextlib.suppress(OSError):  # a full disk must not stop the work
        temporary.write_text(json.dumps(state), encoding="utf-8")
        temporary.replace(file)


def telling_of_compiling(*, quiet: bool) -> AbstractContextManager[None]:
    """Return a context in which a message on standard error reports that code is compiled."""
    if quiet:
        return nullcontext()
    from shapespace.batch.warm import notify_compiling
    from shapespace.compiled import notify_compilation

    return notify_compilation(notify_compiling)


@contextmanager
def _logging_progress(label: str, state: Callable[[], str], *, quiet: bool) -> Generator[None]:
    """Print lines on standard error while the block runs, first after `FIRST_LOG_LINE_S`, then at growing intervals.

    Args:
        label: name of the step.
        state: function that returns the progress, which is printed after `label`; empty if unknown.
        quiet: whether to print nothing.
    """
    if quiet or sys.stderr.isatty():
        yield
        return
    ended, began = threading.Event(), time.monotonic()

    def print_lines() -> None:
        pause, after = FIRST_LOG_LINE_S, ""
        while not ended.wait(pause):
            print(f"shapespace: {label}{state()} ...{after}", file=sys.stderr, flush=True)
            pause = min(max(2 * pause, 1.0), LONGEST_PAUSE_S)
            after = f" ({time.monotonic() - began + pause:.0f} s)"

    threading.Thread(target=print_lines, name="shapespace progress", daemon=True).start()
    try:
        yield
    finally:
        ended.set()


@contextmanager
def tell_after(seconds: float, sentence: str) -> Generator[None]:
    """Print `sentence` on standard error, above any progress bar, if the block takes longer than `seconds`."""
    later = threading.Timer(seconds, tqdm.write, (sentence, sys.stderr))
    later.daemon = True
    later.start()
    try:
        yield
    finally:
        later.cancel()
