"""Triage of scans in correspondence: scans to review first, with reasons."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import exp, inf, isfinite, log, nan

import numpy as np

from shapespace.report.blocks.wording import DASH, percent, plain
from shapespace.report.inputs.correspondence_folder import Corresponded
from shapespace.schemas import CorrespondRecord

_DOUBTFUL_WEIGHT = 1e6  # before all that stands out
_STANDS_OUT = 4.0
"""How many times the usual spread above the middle makes a scan one to look at."""
_LEAST_SPREAD = 0.25  # share of the median that counts as usual variation, where all scans are alike
_TO_STDDEV = 1.4826  # MAD to standard deviation of a normal distribution: 1 / 0.6745


@dataclass(frozen=True)
class Concern:
    """Reasons to review a scan in correspondence.

    Args:
        weight: how much it stands out, 0 for not at all.
        reasons: in words, the weightiest first.
    """

    weight: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Reasons as a sentence."""
        return sentence("; ".join(self.reasons)) if self.reasons else "Nothing about it stands out."


@dataclass(frozen=True)
class _Measure:
    """A measure with its usual range.

    Args:
        of: value of each scan, not-a-number where it is not known.
        describe: formats a value as a clause.
        least_spread: the spread of values is at least this.
        at_least: smaller values are not reported.
        always: larger values are reported however many scans have them.
    """

    of: Sequence[float]
    describe: Callable[[float], str]
    least_spread: float
    at_least: float = 0.0
    always: float = inf


def concerns_of(folder: Corresponded) -> dict[str, Concern]:
    """Return the concerns about each scan in correspondence, by name."""
    population = folder.population()
    records = [folder.records[name] for name in population.names]
    reasons_by_record: list[list[tuple[float, str]]] = [[] for _ in records]
    for measure in _measures(records, population.sizes.tolist(), folder.settled):
        centre = median(measure.of)
        spread = _TO_STDDEV * median([abs(value - centre) for value in measure.of])
        spread = max(spread, measure.least_spread, 1e-12)
        for reasons, value in zip(reasons_by_record, measure.of, strict=True):
            over = (value - centre) / spread
            if value > measure.always:
                over = max(over, _STANDS_OUT * value / measure.always)
            if over > _STANDS_OUT and value > measure.at_least:
                reasons.append((over, measure.describe(value)))
    for reasons, record in zip(reasons_by_record, records, strict=True):
        if record.doubt:
            reasons.append((_DOUBTFUL_WEIGHT, record.doubt))
    ordered = [sorted(reasons, reverse=True) for reasons in reasons_by_record]
    return {
        record.name: Concern(reasons[0][0] if reasons else 0.0, tuple(reason for _, reason in reasons))
        for record, reasons in zip(records, ordered, strict=True)
    }


def _measures(records: Sequence[CorrespondRecord], sizes: Sequence[float], settled_mm: float) -> list[_Measure]:
    tail_shares = [distance_share(record, "p99", size) for record, size in zip(records, sizes, strict=True)]
    growth = [log(record.area_factor) if record.area_factor else nan for record in records]
    last_movements = [record.moved_share[-1] if record.moved_share else nan for record in records]
    return [
        _Measure(
            tail_shares,
            lambda v: (
                f"1 % of its points lie farther off than {percent_of(v)} of its size, where "
                f"{percent_of(median(tail_shares))} is usual"
            ),
            _LEAST_SPREAD * known(median(tail_shares)),
            always=0.1,
        ),
        _Measure(
            [known(record.folded_share) for record in records],
            lambda v: f"{percent_of(v)} of its triangles are folded over",
            0.0005,
            at_least=0.001,
            always=0.01,
        ),
        _Measure(
            [1 - known(record.seen_share) for record in records],
            lambda v: f"it shows only {percent(1 - v)} of the mean shape",
            0.03,
            at_least=0.2,
        ),
        _Measure(
            [1 - known(record.covered_share) for record in records],
            lambda v: f"only {percent(1 - v)} of its points are reached",
            0.02,
            at_least=0.1,
            always=0.25,
        ),
        _Measure(
            growth,
            lambda v: (
                f"its triangles grow or shrink up to {exp(v):.1f} times, where {exp(median(growth)):.1f} is usual"
            ),
            _LEAST_SPREAD * known(median(growth)),
        ),
        _Measure(
            last_movements,
            lambda v: f"its vertices still moved by {percent_of(v)} of its size in the last round",
            _LEAST_SPREAD * known(median(last_movements)),
            at_least=settled_mm,
        ),
    ]


def distance_share(record: CorrespondRecord, statistic: str, size: float) -> float:
    """Return the distance `mean`, `p95`, `p99` or `max` of a record as a share of `size`, which is in its unit."""
    return known(getattr(record, f"distance_{statistic}")) / size


def known(value: float | None) -> float:
    """Return a number that may be absent, NaN for None."""
    return nan if value is None else value


def median(values: Sequence[float]) -> float:
    """Return the median of the finite numbers, NaN if there are none."""
    numbers = [value for value in values if isfinite(value)]
    return float(np.median(numbers)) if numbers else nan


def percent_of(share: float) -> str:
    """Return a small share in percent with two digits or so."""
    return f"{plain(float(f'{100 * share:.2g}'))} %" if isfinite(share) else DASH


def sentence(text: str) -> str:
    """Return `text` from a capital letter to a full stop."""
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith(".") else ".") if text else ""


def scan_status(record: CorrespondRecord, concerns: Mapping[str, Concern]) -> str:
    """Return `converged`, `look` for an unusual scan, `doubtful`, `excluded`, or `unreadable`."""
    if record.is_excluded:
        return "excluded"
    concern = concerns.get(record.name)
    if concern is None:
        return "unreadable"
    return "doubtful" if record.status == "doubtful" else "look" if concern.reasons else "converged"
