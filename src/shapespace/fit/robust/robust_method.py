"""The robust fit as a method: its settings, its doubts and its reason."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import asdict, dataclass, replace
from typing import ClassVar

import numpy as np

from shapespace.errors import FitError
from shapespace.fit.diagnostics.failure_model import (
    FitEvidence,
    ScanEvidence,
    converged_reason,
    estimate_error,
    find_failure_reasons,
    find_odd_scan_reasons,
    has_displaced_parts,
    is_side_undecidable,
    with_mirror_image,
)
from shapespace.fit.diagnostics.reasons import Reason
from shapespace.fit.iteration_state import SHOWN, Fitted, IcpState, RobustFitted
from shapespace.fit.method import FitOutcome, Limits
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.model.shape_model import ShapeModel

_STEPS_OF_JOINTS = 4
"""Factor of the iterations of each level if relative poses are modelled; with 1, half of the fits of a femur and a
fifth of a tibia stop too early."""
_COMPLETE = 0.95  # share of the vertices; a complete scan still omits vertices at its border


def _missing_part(
    model: ShapeModel, scan: ScanTarget, fitted: RobustFitted, *, with_scale: bool
) -> tuple[float, float]:
    """Return the share of the vertices that a partial scan does not show, and their expected error, mm of the scan.

    Zero for complete scans, and for models without training shapes, which the estimate needs.
    """
    from shapespace.fit.completion.surface_calibration import missing_error_mm  # compiled

    if model.training is None or fitted.match_evidence.model_allowed_share > _COMPLETE:
        return 0.0, 0.0
    observed = np.isin(fitted.regions(), SHOWN)
    if observed.mean() > _COMPLETE:
        return 0.0, 0.0
    T, b = fitted.T_scan_model, fitted.b
    error_mm = missing_error_mm(model, scan, T, b, observed, with_scale=with_scale)
    return (0.0, 0.0) if error_mm is None else (float(1.0 - observed.mean()), error_mm)


@dataclass(frozen=True)
class Robust(RobustSettings):
    """Pose and shape together, from matches in both directions, robustly, with the prior (docs/robust.md).

    Its settings are those of `RobustSettings`.

    Example:
        >>> config = ss.FitConfig(ss.fit.Robust(weight="huber"))
        >>> ss.fit_scan(model, meshes[1], config).method
        'robust'
    """

    name: ClassVar[str] = "robust"
    calibrated: ClassVar[bool] = True
    goes_on_densely: ClassVar[bool] = True

    def states(
        self, model: ShapeModel, scan: ScanTarget, start: Start, limits: Limits
    ) -> Generator[IcpState, None, Fitted]:
        """Yield the states of phase 1 with the pose alone, then of phase 2 with pose and shape together."""
        from shapespace.fit.robust.robust_icp import robust_icp
        from shapespace.fit.search.chirality import compare_with_mirror_image
        from shapespace.fit.search.second_instance import (  # compiled
            compare_displaced,
            find_displaced,
            find_layers,
            find_second_instance,
        )

        if self.no_contact and not (model.parts or limits.part):
            raise FitError("The model has one part, which no other part can be in contact with; omit --no-contact.")
        # Joints that turn need more steps; a level still ends as soon as nothing moves.
        more = 1 if model.is_linear else _STEPS_OF_JOINTS
        levels = tuple(replace(level, iterations=more * level.iterations) for level in self.levels)
        fitted = yield from robust_icp(
            model,
            scan,
            start,
            replace(self, levels=levels),
            with_scale=limits.with_scale,
            modes=limits.modes,
            max_iterations=limits.max_iterations,
        )
        measured = ScanEvidence(
            **asdict(fitted.match_evidence),
            training_shapes=float(model.n_training),
            start_score_mm=start.score_mm * start.T_scan_model.scale,
            start_runner_up_score_mm=start.runner_up_score_mm * start.T_scan_model.scale,
            **asdict(find_layers(model, scan, fitted)),
            **asdict(find_displaced(model, scan, fitted)),
        )
        missing = (0.0, 0.0) if limits.part else _missing_part(model, scan, fitted, with_scale=limits.with_scale)
        evidence = FitEvidence(**asdict(measured), **asdict(estimate_error(measured, *missing)))
        notes = list(fitted.notes)
        second = find_second_instance(model, scan, fitted, self, with_scale=limits.with_scale)
        if second is not None:
            evidence = replace(evidence, second_instance_mm=second.away_mm, second_instance_gap_mm=second.gap_mm)
            notes.append(second.note)
        if not limits.part:
            mirror = compare_with_mirror_image(model, scan, fitted, self, with_scale=limits.with_scale)
            evidence = evidence if mirror is None else replace(evidence, **asdict(mirror))
            evidence = with_mirror_image(evidence) if is_side_undecidable(evidence) else evidence
        # A mirrored scan has parts at a distance everywhere.
        if has_displaced_parts(evidence) and (evidence.mirrored_log_odds or 0.0) <= 0.0:
            displaced = compare_displaced(model, scan, fitted, self, with_scale=limits.with_scale)
            evidence = replace(evidence, **asdict(displaced))
        return replace(fitted, evidence=evidence, notes=notes)

    def doubts(self, ended: FitOutcome) -> list[Reason]:
        """Return reasons in the evidence to doubt the fit: an odd scan, then a probable failure."""
        evidence = ended.fitted.evidence
        assert evidence is not None
        return [*find_odd_scan_reasons(evidence), *find_failure_reasons(evidence)]

    def reason(self, ended: FitOutcome) -> Reason:
        """Return that the fit converged, with its robust residual standard deviation."""
        evidence = ended.fitted.evidence
        assert evidence is not None
        return converged_reason(evidence.spread_mm, evidence.model_matched_share, evidence)
