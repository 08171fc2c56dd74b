"""The robust fit as a method: its settings, and what is doubted and said of it."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace
from typing import ClassVar

from shapespace.fit.diagnostics.reliability import reliability
from shapespace.fit.diagnostics.trust import (
    chirality_of,
    doubts_of_chirality,
    doubts_of_few_shapes,
    doubts_of_inconsistent_parts,
    doubts_of_layers,
    doubts_of_reliability,
    doubts_of_robust,
)
from shapespace.fit.iteration_state import Fitted, IcpState
from shapespace.fit.method import Ended, Limits
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start, start_evidence
from shapespace.model.shape_model import ShapeModel


@dataclass(frozen=True)
class Robust(RobustSettings):
    """Pose and shape at once, from both directions, robustly, with the prior (docs/robust.md).

    Its settings are those of `RobustSettings`.
    """

    name: ClassVar[str] = "robust"
    calibrated: ClassVar[bool] = True
    goes_on_densely: ClassVar[bool] = True

    def states(
        self, model: ShapeModel, scan: ScanTarget, start: Start, limits: Limits
    ) -> Generator[IcpState, None, Fitted]:
        """Yield the states of phase 1 with the pose alone, then of phase 2 with pose and shape together."""
        from shapespace.fit.robust.robust_icp import robust_icp
        from shapespace.fit.search.chirality import mirrored_log_odds
        from shapespace.fit.search.second_instance import (  # compiled
            displaced_shares,
            find_second_instance,
            layer_evidence,
        )

        fitted = yield from robust_icp(
            model,
            scan,
            start,
            self,
            with_scale=limits.with_scale,
            modes=limits.modes,
            max_iterations=limits.max_iterations,
        )
        evidence = {
            **fitted.evidence,
            "training_shapes": float(model.n_training),
            **start_evidence(start),
            **layer_evidence(model, scan, fitted),
            **displaced_shares(model, scan, fitted),
        }
        evidence |= reliability(evidence).as_evidence()
        if not limits.part:
            log_odds = mirrored_log_odds(model, scan, fitted, self, with_scale=limits.with_scale)
            evidence |= {} if log_odds is None else {"mirrored_log_odds": log_odds}
        second = find_second_instance(model, scan, fitted, self, with_scale=limits.with_scale)
        notes = [*fitted.notes, *([] if second is None else [second.note])]
        if "mirrored_log_odds" in evidence and chirality_of(evidence) == "undecidable":
            notes.append("Whether the scan is mirrored is undecidable: its mirror image fits the model about as well.")
        return replace(fitted, evidence=evidence | ({} if second is None else second.as_evidence()), notes=notes)

    def doubts(self, ended: Ended) -> list[str]:
        """Return what its evidence says against the fit, beside that of simulated ones whose truth is known."""
        evidence = ended.fitted.evidence
        return [
            *doubts_of_chirality(evidence),
            *doubts_of_layers(evidence),
            *doubts_of_inconsistent_parts(evidence),
            *doubts_of_few_shapes(evidence),
            *(doubts_of_robust(evidence) or doubts_of_reliability(evidence)),
        ]

    def reason(self, ended: Ended) -> str:
        """Return that the fit converged, with its robust residual standard deviation."""
        e = ended.fitted.evidence
        return (
            f"Converged; robust residual SD {e['spread_mm']:.2f} mm over {100 * e['model_matched_share']:.0f} % of the "
            "model's vertices."
        )
