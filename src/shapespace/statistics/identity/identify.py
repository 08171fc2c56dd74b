"""Identification of the enrolled person that a scan shows: ranks, and miss rates of open-set searches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.proportions import widen_share
from shapespace.errors import InputError
from shapespace.reprs import list_briefly, short_repr
from shapespace.statistics.identity.rates import RateEstimate, people_drawn, rate_estimate
from shapespace.statistics.identity.trial import IdentityConfig, Trial, scores_of, trial_of
from shapespace.statistics.methods import AnalysisResult
from shapespace.step_counter import StepCounter
from shapespace.types import BoolArray, FloatArray, IntArray, require

FPIR = (1e-1, 1e-2)
"""False positive identification rates at which the miss rate is reported."""

_JUST = 1e-12  # relative slack for rates that rounding puts just below a step


@dataclass(frozen=True, eq=False)
class Searches:
    """Results of searching a gallery for each probe.

    Args:
        person: (S,) number of the person of each probe.
        rank: (S,) rank of that person among all enrolled, 1 for the first, ties counted against it; 0 if not enrolled.
        own: (S,) score of that person; minus infinity if not enrolled.
        best_other: (S,) highest score of another person.
    """

    person: IntArray
    rank: IntArray
    own: FloatArray
    best_other: FloatArray

    __repr__ = short_repr

    @property
    def people(self) -> int:
        """Number of enrolled people who are searched for, the independent units of error rates."""
        return len(np.unique(self.person[self.enrolled]))

    @property
    def enrolled(self) -> BoolArray:
        """(S,) whether the person of each probe is in the gallery."""
        return self.rank > 0

    def cmc(self, most: int, weights: FloatArray | None = None) -> FloatArray:
        """Return (most,) the share of enrolled probes found within the first 1, 2, ... people."""
        w = (np.ones(len(self.rank)) if weights is None else weights)[self.enrolled]
        rank = np.minimum(self.rank[self.enrolled] - 1, most)
        return np.cumsum(np.bincount(rank, weights=w, minlength=most + 1))[:most] / w.sum()

    def fnir(self, fpir: FloatArray, weights: FloatArray | None = None) -> FloatArray:
        """Return the share of enrolled probes missed at thresholds that accept at most `fpir` of the impostor searches.

        Impostor searches are probes of people who are not enrolled or, if all are enrolled, all probes searched for
        without their own person. A miss is a person who is below the threshold or not the first.
        """
        w = np.ones(len(self.rank)) if weights is None else weights
        strangers = ~self.enrolled if not self.enrolled.all() else self.enrolled
        score, own = self.best_other[strangers], w[strangers]
        order = np.argsort(-score, kind="stable")
        ranked, let_in = score[order], np.cumsum(own[order]) / own.sum()
        # The lowest score that may be accepted at each threshold, ties accepted together.
        ends = np.flatnonzero(np.append(ranked[1:] != ranked[:-1], True))
        count = np.searchsorted(let_in[ends], np.asarray(fpir) * (1 + _JUST), side="right")
        first_refused = np.append(ranked[ends], -np.inf)[count]
        hit = (self.rank == 1)[:, None] & (self.own[:, None] > first_refused)
        return 1.0 - np.average(hit[self.enrolled], axis=0, weights=w[self.enrolled])


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationRates:
    """Error rates of identification by one score.

    Args:
        name: name of the score.
        searches: results of all probes.
        rank_1: share of enrolled probes whose person is first.
        cmc: (R,) share found within the first 1 to R people.
        band: (2, R) ends of its interval.
        fnir: FPIR -> share missed; no value if there are too few searches.
    """

    name: str
    searches: Searches
    rank_1: RateEstimate
    cmc: FloatArray
    band: FloatArray
    fnir: Mapping[float, RateEstimate]

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class IdentificationResult(AnalysisResult):
    """Result of the identification in a cohort.

    Args:
        scores: rates of each requested score, in that order.
        enrolled: number of people in the gallery; the smallest of all rounds.
        probes: number of searches.
        trained_on: number of training people, the smallest of all rounds of the cross-validation.
        trial: roles of the scans.
        config: options of the analysis.

    Example:
        >>> result = ss.statistics.identify(cohort, ss.statistics.IdentityConfig(scores=("distance",), draws=20))
        >>> bool(result["distance"].cmc[-1] <= 1)
        True
    """

    scores: tuple[IdentificationRates, ...]
    enrolled: int
    probes: int
    trained_on: int
    trial: Trial
    config: IdentityConfig

    def __getitem__(self, name: str) -> IdentificationRates:
        return next(rates for rates in self.scores if rates.name == name)

    def __repr__(self) -> str:
        ranks = list_briefly([f"{rates.name}: rank 1 {rates.rank_1.briefly()}" for rates in self.scores])
        return f"<IdentificationResult of {self.probes} probes among {self.enrolled} subjects; {ranks}>"


def search(scores: FloatArray, gallery: IntArray, probes: IntArray) -> Searches:
    """Search the gallery for each probe; the score of a person is that of the most similar scan.

    Args:
        scores: (G, P) scores.
        gallery: (G,) number of the person of each scan.
        probes: (P,) number of the person of each probe.

    Raises:
        InputError: fewer than two people are enrolled.
    """
    people, whose = np.unique(gallery, return_inverse=True)
    if len(people) < 2:
        raise InputError(f"{len(people)} subjects are enrolled, but at least two are needed; use fewer folds.")
    best = np.full((len(people), len(probes)), -np.inf)
    np.maximum.at(best, whose, scores)
    own = people[:, None] == probes
    others = np.where(own, -np.inf, best)
    of_own = np.where(own, best, -np.inf).max(axis=0)
    enrolled = own.any(axis=0)
    rank = np.where(enrolled, 1 + (others >= of_own).sum(axis=0), 0)
    return Searches(probes, rank.astype(np.int32), of_own, others.max(axis=0))


def identify(
    cohort: Cohort, config: IdentityConfig | None = None, *, progress: Callable[[int, int], None] | None = None
) -> IdentificationResult:
    """Estimate the error rates of identification: which enrolled person does a scan show?

    Args:
        cohort: scans with a column that identifies the person.
        config: roles of the scans; None enrols the first scan of each person. With folds, people are searched for among
            those of their own fold.
        progress: function called with (done, total).

    Raises:
        InputError: invalid roles, see `trial_of`, or too few training people.
        ShapespaceError: scikit-learn is not installed.

    Example:
        >>> config = ss.statistics.IdentityConfig(scores=("distance",), draws=20)
        >>> bool(ss.statistics.identify(cohort, config)["distance"].cmc[0] <= 1)
        True
    """
    require(cohort, Cohort, "identify", "read one with shapespace.read_cohort")
    config = config or IdentityConfig()
    trial = trial_of(cohort, config, enrol=True)
    parts: dict[str, list[Searches]] = {name: [] for name in config.scores}
    sizes: list[int] = []
    for round_, matrices in scores_of(trial, config, config.modes):
        gallery, probes = (trial.person[list(rows)] for rows in (round_.gallery, round_.probes))
        sizes.append(len(np.unique(gallery)))
        for name, scores in matrices.items():
            parts[name].append(search(scores, gallery, probes))
    people = people_drawn(trial.tested, config.draws, config.seed)
    rates: list[IdentificationRates] = []
    step = StepCounter(len(parts), progress)
    for name, searches in parts.items():
        rates.append(identification_rates(name, joined(searches), min(sizes), people))
        step.add()
    return IdentificationResult(
        scores=tuple(rates),
        enrolled=min(sizes),
        probes=sum(len(round_.probes) for round_ in trial.rounds),
        trained_on=min(len({trial.subjects[row] for row in round_.training}) for round_ in trial.rounds),
        trial=trial,
        config=config,
    )


def joined(parts: Sequence[Searches]) -> Searches:
    """Return the searches of several rounds together."""
    fields = ("person", "rank", "own", "best_other")
    return Searches(*(np.concatenate([getattr(part, field) for part in parts]) for field in fields))


def identification_rates(name: str, searches: Searches, n_ranks: int, people: FloatArray) -> IdentificationRates:
    """Return the error rates of one score.

    Args:
        name: name of the score.
        searches: results of all probes.
        n_ranks: number of ranks of the CMC curve.
        people: (draws, P) bootstrap samples from `people_drawn`.
    """
    rates = np.array(FPIR)
    rows: list[FloatArray] = []
    for times in people:
        weights = times[searches.person]
        strangers = ~searches.enrolled if not searches.enrolled.all() else searches.enrolled
        if weights[searches.enrolled].sum() > 0 and weights[strangers].sum() > 0:
            rows.append(np.concatenate([searches.cmc(n_ranks, weights), searches.fnir(rates, weights)]))
    drawn = np.array(rows).reshape(len(rows), n_ranks + len(rates))
    cmc, fnir = searches.cmc(n_ranks), searches.fnir(rates)
    searched = len(searches.rank) if searches.enrolled.all() else int((~searches.enrolled).sum())
    band = np.percentile(drawn[:, :n_ranks], [2.5, 97.5], axis=0) if len(drawn) else np.full((2, n_ranks), np.nan)
    band = np.stack(widen_share(band[0], band[1], searches.people))
    missed = {
        rate: rate_estimate(float(fnir[k]), drawn[:, n_ranks + k], searches.people)
        if searched * rate >= 1
        else RateEstimate(None)
        for k, rate in enumerate(FPIR)
    }
    return IdentificationRates(
        name=name,
        searches=searches,
        rank_1=rate_estimate(float(cmc[0]), drawn[:, 0], searches.people),
        cmc=cmc,
        band=band,
        fnir=missed,
    )
