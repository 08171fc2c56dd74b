"""Progress of long computations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int], None]
"""Function that is called with (completed steps, total steps)."""


@dataclass
class StepCounter:
    """Counts the steps of a computation and reports them.

    Args:
        total: total number of steps.
        progress: function that is called with (completed steps, total steps), or None.
        done: number of completed steps.
    """

    total: int
    progress: Progress | None
    done: int = 0

    def add(self, count: int = 1) -> None:
        """Add completed steps."""
        self.done += count
        if self.progress is not None:
            self.progress(self.done, self.total)


def progress_of_run(progress: Progress | None, run: int, runs: int) -> Progress | None:
    """Return the progress function of one of several runs of equal length, counted from 0; None without progress."""
    return None if progress is None else lambda done, total: progress(run * total + done, runs * total)
