"""Whether to trust a robust fit: its evidence against that of simulated fits whose truth is known.

One logistic score says how much the evidence is like that of wrong fits: true vertex error over 3 mm, or a scan of
something else. Each of its few inputs grows with what speaks against the fit, and the reasons given are those that add
most. The coefficients were fitted to 560 fits of the split "dev", 174 of them wrong, by `benchmarks/trust.py --tune`;
the bound leaves 5 % of the good ones doubted there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from shapespace.fit.diagnostics.reliability import FAILED_SHARE

Chirality: TypeAlias = Literal["as scanned", "mirrored", "undecidable"]
"""Whether left and right of a scan are as those of the model."""

_OFFSET = -3.70
_LEAST_SHARE = 0.01
_MOST_LOG_SCALE = 1.0
_TOLD_SHARE = 0.4
_TOLD = 3
_ALL_OVER = 0.8
"""A model is called too narrow only where its surface has the scan near all over."""
_LAYERED = 0.16
"""Share of a scan over which it has two surfaces; chosen on fits of `benchmarks/reliability.py`."""
_PROBABLY_FAILED = 0.5
"""Failure probability above which a fit is doubtful, whatever its score is."""
_DISPLACED, _PURE, _PURE_INWARD = 0.035, 0.6, 0.35
"""Share of the scan that is displaced, and of its unexplained parts, above which its parts do not fit together. Correct
fits of the development seeds of `benchmarks/odd_cases.py` stay below one or the other. Hair lies outside the surface
and reaches a purity of 0.49, so parts inside it need less."""
_SCATTERED, _NOISY = 0.35, 0.02
"""Share of the scan that scatters, and spread of the matches as a share of the size, from which noise hides the shape.
Of those seeds, scans with noise of 5 to 15 % of the size reach both, and those with 20 % outliers neither."""
_FEW_SHAPES = 10
"""Fewest shapes of the models that `reliability` was calibrated on."""
_LEAVES_SPAN = 0.002
"""Share of the size; shapes in the span of a model leave it by at most 0.0012 (`benchmarks/odd_cases.py`)."""
_DECIDED = 5.0
"""Log odds (nats) from which the chirality counts as decided: odds of 150 to 1. Of `benchmarks/odd_cases.py`, the 25
mirrored scans of the development seeds reach 7 and more, correct fits of unmirrored scans -11 and less."""


@dataclass(frozen=True)
class Input:
    """One input of the score.

    Args:
        value: from the evidence; grows with what speaks against the fit.
        least: where it lies for the clearest good fits; below it nothing more speaks for the fit.
        usual: its median over good fits.
        weight: in the score, of each unit above `usual`.
        most: beyond this the fit is doubted whatever the rest says.
        says: the reason in words.
    """

    value: Callable[[Mapping[str, float]], float]
    least: float
    usual: float
    weight: float
    most: float
    says: Callable[[Mapping[str, float]], str]


def _log_share(share: float) -> float:
    return math.log(max(share, _LEAST_SHARE))


INPUTS = (
    Input(
        lambda e: math.log(max(e["posterior_error_mm"] / e["size_mm"], 1e-6)),
        least=-6.5,
        usual=-4.519,
        weight=1.293,
        most=-3.0,
        says=lambda e: f"its vertices are expected to be {e['expected_error_mm']:.1f} mm off",
    ),
    Input(
        lambda e: math.log(max(e["spread_mm"] / e["size_mm"], 1e-6)),
        least=-6.15,
        usual=-4.975,
        weight=0.741,
        most=-3.0,
        says=lambda e: f"even the parts that match lie {e['spread_mm']:.1f} mm apart",
    ),
    Input(
        lambda e: -_log_share(e["model_near_share"]),
        least=0.02,
        usual=0.084,
        weight=1.827,
        most=1.2,
        says=lambda e: f"only {100 * e['model_near_share']:.0f} % of the model has the scan anywhere near",
    ),
    Input(
        lambda e: -_log_share(e["seen_share"]),
        least=0.2,
        usual=0.688,
        weight=1.516,
        most=3.5,
        says=lambda e: f"only {100 * e['seen_share']:.0f} % of the model's vertices have a point of the scan",
    ),
    Input(
        lambda e: -_log_share(e["scan_allowed_share"]),
        least=0.02,
        usual=0.061,
        weight=0.347,
        most=2.5,
        says=lambda e: f"only {100 * e['scan_allowed_share']:.0f} % of the scan faces as the model does",
    ),
    Input(
        lambda e: -_log_share(e["model_matched_share"]),
        least=0.06,
        usual=0.373,
        weight=0.237,
        most=3.5,
        says=lambda e: f"only {100 * e['model_matched_share']:.0f} % of the model lies on the scan",
    ),
    Input(
        lambda e: math.log(max(e["z2"], 1e-6)),
        least=-0.57,
        usual=0.023,
        weight=3.001,
        most=2.2,
        says=lambda e: (
            f"the shape is implausible: its coefficients lie {math.sqrt(e['z2']):.1f} standard deviations out on "
            "average, where about 1 is usual"
        ),
    ),
    Input(
        lambda e: math.log(max(e["z2_leading"], 1e-6)),
        least=-0.7,
        usual=-0.047,
        weight=1.064,
        most=2.5,
        says=lambda e: (
            f"the shape is implausible: its main coefficients lie {math.sqrt(e['z2_leading']):.1f} standard "
            "deviations out on average, where about 1 is usual"
        ),
    ),
    Input(
        lambda e: min(abs(e["log_scale"]), _MOST_LOG_SCALE),
        least=0.0,
        usual=0.010,
        weight=2.298,
        most=0.7,
        says=lambda e: (
            f"the scan is {math.exp(e['log_scale']):.2f} times as large as the model, where about 1 is usual"
        ),
    ),
)


def score(evidence: Mapping[str, float]) -> float:
    """Return how much the evidence is like that of wrong fits: above zero the fit is doubted."""
    return _OFFSET + sum(_contributions(evidence))


def doubts_of_robust(evidence: Mapping[str, float]) -> list[str]:
    """Return reasons not to trust a robust fit, what weighs most first; none where nothing speaks against it.

    Args:
        evidence: of `posterior`, `start_evidence` and `reliability`; lengths in mm of the model's frame.
    """
    if not _is_doubted(evidence):
        return []
    usual = {name: min(evidence[name], 1.0) for name in ("z2", "z2_leading")}
    if evidence["model_near_share"] > _ALL_OVER and not _is_doubted(dict(evidence) | usual):
        out = math.sqrt(max(evidence["z2"], evidence["z2_leading"]))
        return [
            f"the model is too narrow for this scan: its surface follows it, to {evidence['spread_mm']:.2f} mm where "
            f"they match, but its coefficients lie {out:.1f} standard deviations out on average, where about 1 is "
            "usual; build a model of more, or more different, shapes, or follow the scan by --dense and look at it"
        ]
    parts = _contributions(evidence)
    beyond = [i for i, each in enumerate(INPUTS) if each.value(evidence) > each.most]
    found = sorted(range(len(INPUTS)), key=lambda i: (i in beyond, parts[i]), reverse=True)
    least = _TOLD_SHARE * parts[found[0]]
    return [INPUTS[i].says(evidence) for i in found[:_TOLD] if i in beyond or parts[i] >= least]


def _contributions(evidence: Mapping[str, float]) -> list[float]:
    return [each.weight * (max(each.value(evidence), each.least) - each.usual) for each in INPUTS]


def _is_doubted(evidence: Mapping[str, float]) -> bool:
    return score(evidence) > 0.0 or any(each.value(evidence) > each.most for each in INPUTS)


def doubts_of_layers(evidence: Mapping[str, float]) -> list[str]:
    """Return a reason to doubt a fit whose scan holds two surfaces on top of each other; none where it does not."""
    if evidence["layered_share"] < _LAYERED:
        return []
    return [f"the scan shows two surfaces on top of each other, about {evidence['layers_apart_mm']:.1f} mm apart"]


def doubts_of_inconsistent_parts(evidence: Mapping[str, float]) -> list[str]:
    """Return reasons to doubt a fit whose scan has parts that no single instance of the model explains."""
    found: list[str] = []
    if evidence.get("second_instance_gap_mm", 0.0) < 0.0:
        found.append(
            f"the scan shows two overlapping instances, {evidence['second_instance_mm']:.0f} mm apart; crop it to one "
            "of them (--crop)"
        )
    share, inward = evidence["displaced_share"], evidence["displaced_inward_share"]
    pure = _PURE_INWARD if inward > _DISPLACED else _PURE
    if share > _DISPLACED and evidence["displaced_purity"] > pure:
        found.append(
            f"{100 * share:.0f} % of the scan runs along the fitted surface at a distance from it, as where its parts "
            "differ in scale or position; check how the scan was assembled, or crop it (--crop)"
        )
    if evidence["scattered_share"] > _SCATTERED and evidence["spread_mm"] > _NOISY * evidence["size_mm"]:
        found.append(
            f"{100 * evidence['scattered_share']:.0f} % of the scan scatters widely around the fitted surface; remove "
            "its noise first"
        )
    return found


def doubts_of_few_shapes(evidence: Mapping[str, float]) -> list[str]:
    """Return a reason to doubt a fit that leaves the span of a model of few shapes; none where it does not."""
    shapes, left = evidence["training_shapes"], evidence["beyond_model_mm"]
    if not 0 < shapes < _FEW_SHAPES or left < _LEAVES_SPAN * evidence["size_mm"]:
        return []
    return [
        f"the model is made of {shapes:.0f} shapes, too few to predict how others differ, and this shape leaves its "
        f"span by {left:.1f} mm; build a model of at least {_FEW_SHAPES} shapes"
    ]


def doubts_of_reliability(evidence: Mapping[str, float]) -> list[str]:
    """Return a reason to doubt a fit that has probably failed by its expected error; none where it has not."""
    if evidence["failure_probability"] <= _PROBABLY_FAILED:
        return []
    return [
        f"its expected vertex error is {evidence['expected_error_mm']:.1f} mm (90 % interval "
        f"{evidence['error_low_mm']:.1f} to {evidence['error_high_mm']:.1f} mm), where "
        f"{FAILED_SHARE * evidence['size_mm']:.1f} mm is the limit; build a model of more shapes or modes"
    ]


def doubts_of_chirality(evidence: Mapping[str, float]) -> list[str]:
    """Return a reason to doubt a fit whose scan is mirrored; none where it is not, or where that is undecidable."""
    if chirality_of(evidence) != "mirrored":
        return []
    return [
        "the scan is mirrored: its mirror image fits the model better; mirror the scan (negate one coordinate of each "
        "vertex and reverse the triangles) and fit it again"
    ]


def chirality_of(evidence: Mapping[str, float]) -> Chirality:
    """Return whether the scan is mirrored, by `mirrored_log_odds`, which symmetric models do not have."""
    log_odds = evidence.get("mirrored_log_odds", 0.0)
    if abs(log_odds) < _DECIDED:
        return "undecidable"
    return "mirrored" if log_odds > 0.0 else "as scanned"
