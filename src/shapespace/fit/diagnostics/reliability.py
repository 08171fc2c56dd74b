"""How far off a robust fit is, by its evidence: an expected error, an interval, a probability that it failed.

The posterior's own figure takes for granted that residuals are noise, and that shapes vary as the model says; where
neither holds it falls while the error rises. So the mean vertex error is foretold from that figure together with what
speaks against it, as a product of powers: true / size = exp(offset) * product of inputs ** weight, no weight below
zero. How far the truth then lies from it was counted on fits that took no part in the weights (split-conformal:
Papadopoulos et al., ECML 2002), which gives the interval. The expected error alone foretells a failure as well as with
any other evidence beside it. Every input is free of units.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import TypeAlias

FAILED_SHARE = 0.0375
"""A fit has failed if its mean vertex error exceeds this share of the model's size (3 mm on a face), or if the scan
shows something else."""
COVERAGE = 0.9
_LEAST_LACK, _LEAST_LENGTH = 1e-3, 1e-4


@dataclass(frozen=True)
class Reliability:
    """What is expected of a fit.

    Args:
        expected_error_mm: half of such fits are closer to the truth on average over the model's vertices, half farther.
        error_low_mm: the mean error of 90 % of fits lies between this,
        error_high_mm: and this.
        failure_probability: that the mean error exceeds `FAILED_SHARE` of the model's size, or that the scan shows
            something else, where as many fits fail as among those it was tuned on.
    """

    expected_error_mm: float
    error_low_mm: float
    error_high_mm: float
    failure_probability: float

    def as_evidence(self) -> dict[str, float]:
        """Return the figures by name."""
        return asdict(self)


def _log(value: float, least: float = _LEAST_LENGTH) -> float:
    return math.log(max(value, least))


Input: TypeAlias = Callable[[Mapping[str, float]], float]
"""Of the evidence."""

INPUTS: Mapping[str, Input] = {
    "posterior": lambda e: _log(e["posterior_error_mm"] / e["size_mm"]),
    "spread": lambda e: _log(e["spread_mm"] / e["size_mm"]),
    "spread beside the model's": lambda e: _log(e["spread_mm"] / max(e["model_spread_mm"], 1e-9)),
    "lack": lambda e: _log(e["model_lack_mm"] / e["size_mm"], _LEAST_LACK),
    "far out": lambda e: max(_log(e["z2"]), 0.0),
    "layers": lambda e: e["layered_share"],
}
"""Inputs by name, each growing with the error it foretells. Shares of the scan are not among them, since hair and
collars lower those too."""

# Made by `python benchmarks/reliability.py --tune`; see there.
WEIGHTS: Mapping[str, float] = {
    "posterior": 0.995,
    "spread": 0.222,
    "spread beside the model's": 0.163,
    "lack": 0.129,
    "far out": 0.244,
    "layers": 2.762,
}
OFFSET = 2.103
LOW, HIGH = 0.594, 2.292
FAILURE_OFFSET, FAILURE_SLOPE = 0.132, 3.429


def log_error(evidence: Mapping[str, float]) -> float:
    """Return the logarithm of the expected error as a share of the model's size, at most 0."""
    return min(OFFSET + sum(weight * INPUTS[name](evidence) for name, weight in WEIGHTS.items()), 0.0)


def reliability(evidence: Mapping[str, float]) -> Reliability:
    """Return how far off the fit with this evidence is.

    Args:
        evidence: of `posterior`, with `layered_share` of `second_instance`; lengths in mm of the model's frame.
    """
    error = log_error(evidence)
    margin = FAILURE_OFFSET + FAILURE_SLOPE * (error - math.log(FAILED_SHARE))
    expected = math.exp(error) * evidence["size_mm"]
    return Reliability(expected, LOW * expected, HIGH * expected, 1.0 / (1.0 + math.exp(-margin)))
