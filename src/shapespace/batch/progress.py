"""What the user waits for: a bar or a line in a terminal, and in a log one line where it takes more than a moment."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from tqdm import tqdm

TOLD_AFTER_S = 5.0
"""What takes longer than this is told where there is no terminal."""


@contextmanager
def progress(total: int | None, doing: str, unit: str, *, quiet: bool) -> Generator[tqdm[Any]]:
    """Yield a bar on standard error; without a terminal one line says what is being done, with `quiet` nothing.

    Args:
        total: how many there are, where that is known.
        doing: such as "reading".
        unit: one of them, such as "mesh".
        quiet: whether to be silent.
    """
    several = unit + ("es" if unit.endswith("sh") else "s")
    what = f"{doing} {several}" if total is None else f"{doing} {total} {unit if total == 1 else several}"
    # disable=None is tqdm's way to ask whether there is a terminal.
    with (
        _telling_a_log(what, quiet=quiet),
        tqdm(total=total, desc=doing, unit=unit, leave=False, disable=True if quiet else None) as bar,
    ):
        yield bar


@contextmanager
def steps(total: int | None, doing: str, unit: str, *, quiet: bool) -> Generator[Callable[[int, int], None]]:
    """Yield what is called with (done, total), and moves a bar of `progress` there."""
    with progress(total, doing, unit, quiet=quiet) as bar:

        def step(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield step


@contextmanager
def waiting(what: str, *, quiet: bool) -> Generator[None]:
    """Say on standard error what the user waits for while it cannot be counted, such as "finding the modes"."""
    with (
        _telling_a_log(what, quiet=quiet),
        tqdm(total=0, desc=f"{what} ...", bar_format="{desc}", leave=False, disable=True if quiet else None),
    ):
        yield


def telling_of_compiling(*, quiet: bool) -> AbstractContextManager[None]:
    """Return a block in which a line on standard error says why the user waits while code is compiled."""
    if quiet:
        return nullcontext()
    from shapespace.batch.warm import tell_compiling
    from shapespace.compiled import on_compiling

    return on_compiling(tell_compiling)


@contextmanager
def _telling_a_log(what: str, *, quiet: bool) -> Generator[None]:
    if quiet or sys.stderr.isatty():
        yield
        return
    with tell_after(TOLD_AFTER_S, f"shapespace: {what} ..."):
        yield


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
