"""Progress of long computations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

Progress: TypeAlias = Callable[[int, int], None]
"""Called with (steps done, in all)."""


@dataclass
class StepCounter:
    """Counts the steps of a computation and reports them.

    Args:
        total: number of steps in all.
        progress: called with (steps done, in all); None for nothing.
        done: number of steps done.
    """

    total: int
    progress: Progress | None
    done: int = 0

    def add(self, count: int = 1) -> None:
        """Count steps that are done."""
        self.done += count
        if self.progress is not None:
            self.progress(self.done, self.total)
