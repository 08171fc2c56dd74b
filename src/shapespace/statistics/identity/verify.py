"""Verification of identity: error rates of the decision whether two scans show one person, with their spread over
people, and calibrated likelihood ratios."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.proportions import widen_share
from shapespace.lazy import require_package
from shapespace.reprs import list_briefly, short_repr
from shapespace.statistics.identity.rates import Pairs, RateEstimate, Roc, Sweep, people_drawn, rate_estimate, resampled
from shapespace.statistics.identity.trial import IdentityConfig, Trial, scores_of, trial_of
from shapespace.statistics.methods import AnalysisResult
from shapespace.step_counter import StepCounter
from shapespace.types import BoolArray, FloatArray, IntArray, require

FAR = (1e-1, 1e-2, 1e-3)
"""False accept rates at which the true accept rate is reported."""

GRID = np.geomspace(1e-4, 1.0, 61)
"""False accept rates of the ROC curve: 15 in each decade."""
_BY_DRAWS = 200  # bootstrap draws of a subgroup; fewer than for all, since there are many subgroups
_ENDS = (2.5, 97.5)  # percentiles of a 95 % interval


@dataclass(frozen=True, eq=False)
class SubgroupRates:
    """Error rates of a subgroup of pairs.

    Args:
        genuine: number of pairs of the same person.
        impostor: number of pairs of two people.
        eer: equal error rate.
        tar: FAR -> TAR.
    """

    genuine: int
    impostor: int
    eer: RateEstimate
    tar: Mapping[float, RateEstimate]

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class VerificationRates:
    """Error rates of verification by one score.

    Args:
        name: name of the score.
        score: (M,) score of each pair.
        llr: (M,) calibrated log likelihood ratios, natural; None if there are too few people to calibrate.
        roc: ROC curve.
        eer: equal error rate.
        tar: FAR -> TAR; no value if there are too few impostor pairs.
        cllr: cost of the calibrated ratios, in bits.
        cllr_min: cost after the best monotone calibration.
        band: (2, 61) ends of the interval of TAR at the FAR of `GRID`.
        by: value of the column `by` -> rates of its pairs.
        curve: number of modes -> EER.
    """

    name: str
    score: FloatArray
    llr: FloatArray | None
    roc: Roc
    eer: RateEstimate
    tar: Mapping[float, RateEstimate]
    cllr: RateEstimate
    cllr_min: float
    band: FloatArray
    by: Mapping[str, SubgroupRates]
    curve: Mapping[int, float]

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class VerificationResult(AnalysisResult):
    """Result of the verification of a cohort.

    Args:
        scores: rates of each requested score, in that order.
        pairs: compared pairs of scans.
        people: names of the people.
        trained_on: number of training people, the smallest of all rounds of the cross-validation.
        trial: roles of the scans.
        config: options of the analysis.

    Example:
        >>> result = ss.statistics.verify(cohort, ss.statistics.IdentityConfig(scores=("distance",), draws=20))
        >>> len(result.people)
        12
    """

    scores: tuple[VerificationRates, ...]
    pairs: Pairs
    people: tuple[str, ...]
    trained_on: int
    trial: Trial
    config: IdentityConfig

    def __getitem__(self, name: str) -> VerificationRates:
        return next(rates for rates in self.scores if rates.name == name)

    def __repr__(self) -> str:
        rates = list_briefly([f"{rates.name}: EER {rates.eer.briefly()}" for rates in self.scores])
        return f"<VerificationResult of {len(self.people)} subjects; {rates}>"


def verify(
    cohort: Cohort, config: IdentityConfig | None = None, *, progress: Callable[[int, int], None] | None = None
) -> VerificationResult:
    """Estimate the error rates of verification: do two scans show the same person?

    Args:
        cohort: scans with a column that identifies the person.
        config: roles of the scans; None compares all with all, by folds of the people.
        progress: function called with (done, total).

    Raises:
        InputError: invalid roles, see `trial_of`, or too few training people.
        ShapespaceError: scikit-learn is not installed.
    """
    require(cohort, Cohort, "verify", "read one with shapespace.read_cohort")
    config = config or IdentityConfig()
    trial = trial_of(cohort, config)
    pairs, scores = _pairs_and_scores(trial, config, config.modes)
    values = trial.cohort.table.texts(config.by) if config.by else ()
    chosen = {value: _with_value(values, value, pairs, all_pairs=trial.all_pairs) for value in sorted(set(values))}
    people = people_drawn(trial.tested, config.draws, config.seed)
    step = StepCounter(len(scores) * config.draws, progress).add
    curves: dict[int, Mapping[str, FloatArray]] = {
        modes: _pairs_and_scores(trial, config, modes)[1] for modes in config.curve
    }
    rates = tuple(
        verification_rates(name, score, pairs, trial.group, people, chosen=chosen, on_draw=step,
                 curve={modes: Sweep(curves[modes][name], pairs.same).roc().eer for modes in curves})
        for name, score in scores.items()
    )  # fmt: skip
    n_training = min(len({trial.subjects[row] for row in round_.training}) for round_ in trial.rounds)
    return VerificationResult(
        scores=rates, pairs=pairs, people=trial.people, trained_on=n_training, trial=trial, config=config
    )


def _pairs_and_scores(trial: Trial, config: IdentityConfig, modes: int | None) -> tuple[Pairs, dict[str, FloatArray]]:
    parts: list[Pairs] = []
    scores: dict[str, list[FloatArray]] = {name: [] for name in config.scores}
    for round_, matrices in scores_of(trial, config, modes):
        pairs, indices = trial.pairs(round_)
        parts.append(pairs)
        for name, matrix in matrices.items():
            scores[name].append(matrix[indices[:, 0], indices[:, 1]])
    one, other, rows = (np.concatenate([getattr(part, field) for part in parts]) for field in ("one", "other", "rows"))
    return Pairs(one, other, rows), {name: np.concatenate(parts_of_score) for name, parts_of_score in scores.items()}


def verification_rates(
    name: str,
    score: FloatArray,
    pairs: Pairs,
    group: IntArray,
    people: FloatArray,
    *,
    chosen: Mapping[str, BoolArray] | None = None,
    curve: Mapping[int, float] | None = None,
    on_draw: Callable[[], None] | None = None,
) -> VerificationRates:
    """Return the error rates of one score.

    Args:
        name: name of the score.
        score: (M,) score of each pair.
        pairs: compared pairs.
        group: (P,) group of each person, for calibration on people of other groups.
        people: (draws, P) bootstrap samples from `people_drawn`.
        chosen: value -> (M,) pairs of a subgroup.
        curve: number of modes -> EER.
        on_draw: function called after each draw.

    Raises:
        InputError: no pairs of one person or of two, or scores that are not finite.
        ShapespaceError: scikit-learn is not installed.
    """
    sweep = Sweep(score, pairs.same)
    roc = sweep.roc()
    llr = calibrated(score, pairs, group)
    cost = None if llr is None else cllr(llr, pairs.same)

    def of(weights: FloatArray) -> FloatArray:
        rates = sweep.roc(weights)
        own = np.nan if llr is None else cllr(llr, pairs.same, weights)
        return np.concatenate([[own], _figures(rates), rates.tar_at(GRID)])

    drawn = resampled(pairs, people, of, 2 + len(FAR) + len(GRID), on_draw)
    eer, tar = _rate_estimates(roc, pairs, drawn[:, 1:])
    usable = drawn[np.isfinite(drawn[:, 1]), 2 + len(FAR) :]
    band = np.percentile(usable, _ENDS, axis=0) if len(usable) else np.full((2, len(GRID)), np.nan)
    band = np.stack(widen_share(band[0], band[1], pairs.genuine_people))
    by: dict[str, SubgroupRates] = {}
    for value, own in (chosen or {}).items():
        part = pairs.take(own)
        genuine = int(part.same.sum())
        if genuine in (0, len(part)):
            continue
        own_sweep = Sweep(score[own], part.same)
        spread = resampled(part, people[:_BY_DRAWS], lambda w, s=own_sweep: _figures(s.roc(w)), 1 + len(FAR))
        by[value] = SubgroupRates(genuine, len(part) - genuine, *_rate_estimates(own_sweep.roc(), part, spread))
    return VerificationRates(
        name=name,
        score=score,
        llr=llr,
        roc=roc,
        eer=eer,
        tar=tar,
        cllr=rate_estimate(cost, drawn[:, 0]),
        cllr_min=cllr_min(score, pairs.same),
        band=band,
        by=by,
        curve=dict(curve or {}),
    )


def _figures(rates: Roc) -> FloatArray:
    return np.concatenate([[rates.eer], rates.tar_at(np.array(FAR))])


def _rate_estimates(roc: Roc, pairs: Pairs, drawn: FloatArray) -> tuple[RateEstimate, dict[float, RateEstimate]]:
    """Return EER and TAR at each FAR with their intervals; no value if no impostor pair may be accepted."""
    impostors = int((~pairs.same).sum())
    tar = {
        far: rate_estimate(float(roc.tar_at(far)), drawn[:, 1 + k], pairs.genuine_people)
        if impostors * far >= 1
        else RateEstimate(None)
        for k, far in enumerate(FAR)
    }
    return rate_estimate(roc.eer, drawn[:, 0], pairs.genuine_people), tar


def _with_value(values: tuple[str, ...], value: str, pairs: Pairs, *, all_pairs: bool) -> BoolArray:
    """Return (M,) whether each pair has a value: its probe, or one of its scans if there is no gallery."""
    has: BoolArray = np.array([cell == value for cell in values], dtype=np.bool_)
    probe = has[pairs.rows[:, 1]]
    return probe | has[pairs.rows[:, 0]] if all_pairs else probe


# Scores as likelihood ratios, and their cost: Cllr, and Cllr-min of the best monotone calibration

_NEEDS, _INSTALL = "Calibration of scores", "'shapespace[statistics]'"


def cllr(llr: FloatArray, same: BoolArray, weights: FloatArray | None = None) -> float:
    """Return the cost of log likelihood ratios (M,), natural, in bits; both kinds of pairs have equal weights.

    It is the mean information that is missed: 0 if all is known, 1 if nothing. Source: Brummer and du Preez,
    "Application-independent evaluation of speaker detection", Computer Speech and Language 20, 2006.
    """
    w = np.ones(len(llr)) if weights is None else weights
    cost = np.logaddexp(0.0, np.where(same, -llr, llr)) / np.log(2.0)
    return float(0.5 * (np.average(cost[same], weights=w[same]) + np.average(cost[~same], weights=w[~same])))


def cllr_min(score: FloatArray, same: BoolArray) -> float:
    """Return the smallest cost of any rising function of the scores, by pooling adjacent violators.

    Raises:
        ShapespaceError: scikit-learn is not installed.
    """
    isotonic = require_package("sklearn.isotonic", _NEEDS, _INSTALL).IsotonicRegression
    genuine = int(same.sum())
    weights = np.where(same, 0.5 / genuine, 0.5 / (len(same) - genuine))
    rule = isotonic(y_min=0.0, y_max=1.0).fit(score, same.astype(np.float64), sample_weight=weights)
    p = cast(FloatArray, rule.predict(score))
    p = np.clip(p, 0.0, 1.0)
    with np.errstate(divide="ignore"):
        return cllr(np.log(p) - np.log1p(-p), same)


def calibrated(score: FloatArray, pairs: Pairs, group: IntArray) -> FloatArray | None:
    """Return the natural log likelihood ratio (M,) of each score, by a logistic regression on pairs of other people.

    Args:
        score: (M,) scores.
        pairs: compared pairs.
        group: (P,) group of each person. The score of a pair is calibrated by the pairs without a person of the groups
            of both its people.

    Returns:
        None if the pairs that calibrate a score are all of the same person, or all of different people.

    Raises:
        ShapespaceError: scikit-learn is not installed.
    """
    make: Any = require_package("sklearn.linear_model", _NEEDS, _INSTALL).LogisticRegression
    one, other = group[pairs.one], group[pairs.other]
    out = np.full(len(score), np.nan)
    for a, b in sorted({(min(p), max(p)) for p in zip(one.tolist(), other.tolist(), strict=True)}):
        own = ((one == a) & (other == b)) | ((one == b) & (other == a))
        known = ~np.isin(one, (a, b)) & ~np.isin(other, (a, b))
        if pairs.same[known].all() or not pairs.same[known].any():
            return None
        mean, scale = score[known].mean(), score[known].std() or 1.0
        # Both kinds of pairs have equal weights, so the log odds are the log likelihood ratio.
        rule = make(class_weight="balanced").fit((score[known, None] - mean) / scale, pairs.same[known])
        out[own] = rule.decision_function((score[own, None] - mean) / scale)
    return out
