"""Protocol of a fitting method: an object with its settings, its loop, its doubts and its reason."""

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
        modes: number of coefficients to report, from the first; None for all.
        max_iterations: cap of each phase.
        part: whether the model is a part of a larger model, which need not be symmetric even if the larger model is.
    """

    with_scale: bool
    modes: int | None
    max_iterations: int
    part: bool = False


@dataclass(frozen=True, eq=False)
class FitOutcome:
    """The end of a fit, from which its status is computed.

    Args:
        model: the shape model.
        start: initial pose, in the scan's mm frame.
        fitted: end of the fit, in that frame.
        stages: surface at each stage, with its distances, which are measured on demand.
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
    """Name by which the method is selected and reported."""
    calibrated: ClassVar[bool]
    """Whether `b_stddev` was validated against known truths (docs/uncertainty.md)."""
    goes_on_densely: ClassVar[bool]
    """Whether the dense stage can follow the method."""

    def states(
        self, model: ShapeModel, scan: ScanTarget, start: Start, limits: Limits
    ) -> Generator[IcpState, None, Fitted]:
        """Yield the states of the fit; the last state of each phase is the end of the phase. Return the end of the fit.

        Raises:
            InputError: model or scan lack data that the method needs.
            FitError: the fit diverged.
        """
        ...

    def doubts(self, ended: FitOutcome) -> list[Reason]:
        """Return reasons not to trust the fit, the most serious first; empty without doubts."""
        ...

    def reason(self, ended: FitOutcome) -> Reason:
        """Return why a fit without doubts stopped."""
        ...
