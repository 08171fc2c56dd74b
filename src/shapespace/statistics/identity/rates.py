"""Error rates of verification: ROC, EER and TAR at FAR from scores of pairs, and their spread over people."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.cohort.proportions import widen_share
from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, IntArray

_LEVEL = 0.95  # of confidence intervals, the usual one
_JUST = 1e-12  # relative slack for rates that rounding puts just below a step


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of scans.

    Args:
        one: (M,) number of the person of the first scan.
        other: (M,) number of the person of the second scan.
        rows: (M, 2) rows of the two scans in the cohort.
    """

    one: IntArray
    other: IntArray
    rows: IntArray

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.one)

    @cached_property
    def same(self) -> BoolArray:
        """(M,) whether both scans are of one person."""
        return self.one == self.other

    @property
    def genuine_people(self) -> int:
        """Number of people with a pair of their own, the independent units of error rates."""
        return len(np.unique(self.one[self.same]))

    def take(self, chosen: BoolArray) -> Pairs:
        """Return the chosen pairs, (M,)."""
        return Pairs(self.one[chosen], self.other[chosen], self.rows[chosen])

    def weights(self, times: FloatArray) -> FloatArray:
        """Return (M,) the multiplicity of each pair if person k occurs `times[k]` times."""
        return np.where(self.same, times[self.one], times[self.one] * times[self.other])


@dataclass(frozen=True, eq=False)
class Roc:
    """Error rates by threshold: a pair is accepted if its score is at least the threshold.

    Args:
        threshold: (T,) thresholds, descending, the first of them infinite.
        far: (T,) share of impostor pairs accepted, from 0 to 1.
        tar: (T,) share of genuine pairs accepted, from 0 to 1.
    """

    threshold: FloatArray
    far: FloatArray
    tar: FloatArray

    __repr__ = short_repr

    @property
    def eer(self) -> float:
        """Equal error rate, at which FAR and 1 - TAR are equal, interpolated between the two nearest thresholds."""
        gap = 1.0 - self.tar - self.far
        after = int(np.argmax(gap <= 0))
        before = after - 1
        share = gap[before] / (gap[before] - gap[after])
        return float(self.far[before] + share * (self.far[after] - self.far[before]))

    def tar_at(self, far: float | FloatArray) -> FloatArray:
        """Return the share of genuine pairs accepted at the lowest threshold whose FAR is at most `far`."""
        return self.tar[np.searchsorted(self.far, np.asarray(far) * (1 + _JUST), side="right") - 1]


class Sweep:
    """All thresholds of some scores, sorted once for any weights.

    Args:
        score: (M,) scores.
        same: (M,) whether each pair is genuine.

    Raises:
        InputError: scores that are not finite, or no pair of one of the two kinds.
    """

    def __init__(self, score: FloatArray, same: BoolArray) -> None:
        if score.shape != same.shape or not np.isfinite(score).all():
            raise InputError("Rates need a finite score for each pair.")
        if same.all() or not same.any():
            raise InputError(
                f"There are {int(same.sum())} pairs of one subject and {int((~same).sum())} of two; error rates need "
                "both."
            )
        self._order = np.argsort(-score, kind="stable")
        ranked = score[self._order]
        self._ends = np.flatnonzero(np.append(ranked[1:] != ranked[:-1], True))
        self._threshold = np.concatenate([[np.inf], ranked[self._ends]])
        self._same = same[self._order]

    def roc(self, weights: FloatArray | None = None) -> Roc:
        """Return the rates with each pair counted `weights` (M,) times; None for once."""
        w = np.ones(len(self._order)) if weights is None else weights[self._order]
        genuine = np.cumsum(np.where(self._same, w, 0.0))
        impostor = np.cumsum(np.where(self._same, 0.0, w))
        rates = [np.concatenate([[0.0], total[self._ends] / total[-1]]) for total in (impostor, genuine)]
        return Roc(self._threshold, *rates)


@dataclass(frozen=True)
class RateEstimate:
    """A rate with its 95 % interval over people; None if the data are too few.

    The interval of a share is never narrower than the exact one without an error, see `widen_share`.
    """

    value: float | None
    low: float | None = None
    high: float | None = None

    def briefly(self) -> str:
        """Return the rate in percent with its interval, for a one-line repr."""
        if self.value is None:
            return "unknown"
        interval = "" if self.low is None or self.high is None else f" ({100 * self.low:.3g} to {100 * self.high:.3g})"
        return f"{100 * self.value:.3g} %{interval}"


def people_drawn(tested: BoolArray, draws: int, seed: int) -> FloatArray:
    """Return (draws, P) how often each person occurs in draws with replacement of the `tested` (P,) people."""
    rng = np.random.default_rng((seed, 14))
    count = int(tested.sum())
    out = np.zeros((draws, len(tested)))
    out[:, tested] = rng.multinomial(count, np.full(count, 1.0 / count), size=draws)
    return out


def rate_estimate(value: float | None, drawn: Sequence[float] | FloatArray, people: int | None = None) -> RateEstimate:
    """Return a rate with its bootstrap interval over people.

    Args:
        value: rate of all people.
        drawn: rate of each draw of people; NaN if a draw has none.
        people: number of people in a share of errors, for its ends near 0 and 1; None for other quantities.
    """
    known = np.asarray([rate for rate in drawn if np.isfinite(rate)])
    if value is None or not (len(known) or (people and value in (0.0, 1.0))):
        return RateEstimate(value)
    tail = 50.0 * (1.0 - _LEVEL)
    low, high = np.percentile(known if len(known) else [value], [tail, 100.0 - tail])
    if people is not None:
        low, high = widen_share(low, high, people, _LEVEL)
    return RateEstimate(value, float(low), float(high))


def resampled(
    pairs: Pairs,
    people: FloatArray,
    of: Callable[[FloatArray], FloatArray],
    figures: int,
    on_draw: Callable[[], None] | None = None,
) -> FloatArray:
    """Return the (draws, figures) values of the function `of` for weights of pairs; NaN if a draw loses a kind of pair.

    Args:
        pairs: compared pairs.
        people: (draws, P) bootstrap samples from `people_drawn`.
        of: function from weights (M,) to values (figures,).
        figures: number of values.
        on_draw: function called after each draw.
    """
    out = np.full((len(people), figures), np.nan)
    for row, times in zip(out, people, strict=True):
        weights = pairs.weights(times)
        if weights[pairs.same].sum() > 0 and weights[~pairs.same].sum() > 0:
            row[:] = of(weights)
        if on_draw is not None:
            on_draw()
    return out
