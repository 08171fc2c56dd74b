"""A task that does nothing, in a module of its own that workers can import."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Nothing:
    """Does nothing."""

    def do(self, task: int) -> int:
        return task

    def give_up(self, task: int, reason: str) -> int:
        return -1
