"""Protocol of a fitting method: an object that owns its settings, its loop, its doubts and its reason."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

from shapespace.fit.diagnostics.reasons import Reason
from shapespace.fit.iteration_state import Fitted, IcpState
from shapespace.fit.result import Stage
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.model.shape_model import ShapeModel


@dataclass(frozen=True)
class Limits:
    """Input of every fit method.

    Args:
        with_scale: whether the pose has a free scale.
        modes: how many coefficients to report, from the first; None for all.
        max_iterations: cap of each phase.
        part: whether the model is a part of a larger one, which need not be symmetric where the whole is.
    """

    with_scale: bool
    modes: int | None
    max_iterations: int
    part: bool = False


@dataclass(frozen=True, eq=False)
class Ended:
    """A fit at its end, to be judged.

    Args:
        model: the shape space.
        start: where it began, in the scan's mm frame.
        fitted: where it ended, in that frame.
        stages: the surface at each stage, with its distances when they are asked for.
        phases: the last state of each phase, by its number.
        size_mm: RMS distance of the model's mean from its centre, mm of the scan.
    """

    model: ShapeModel
    start: Start
    fitted: Fitted
    stages: Mapping[str, Stage]
    phases: Mapping[int, IcpState]
    size_mm: float


class Method(Protocol):
    """A way to fit a placed model; a frozen dataclass whose fields are its settings."""

    name: ClassVar[str]
    """By which it is chosen, and called in results."""
    calibrated: ClassVar[bool]
    """Whether `b_stddev` was checked against truths (docs/uncertainty.md)."""
    goes_on_densely: ClassVar[bool]
    """Whether the surface it ends with can be taken the rest of the way to the scan."""

    def states(
        self, model: ShapeModel, scan: ScanTarget, start: Start, limits: Limits
    ) -> Generator[IcpState, None, Fitted]:
        """Yield the states it goes through, the last of each phase being where that phase ended; return the end.

        Raises:
            InputError: model or scan lack what it needs.
            FitError: the fit diverged.
        """
        ...

    def doubts(self, ended: Ended) -> list[Reason]:
        """Return reasons not to trust the fit, the most serious first; empty where there are none."""
        ...

    def reason(self, ended: Ended) -> Reason:
        """Return why a fit without doubts ended where it did."""
        ...
