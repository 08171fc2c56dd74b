"""Regression of a number, such as age or a severity, on shape, and the mean shape as a function of the number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shapespace.cohort.cohort import SUBJECT, Cohort, subjects_of
from shapespace.cohort.proportions import widen_share
from shapespace.errors import InputError
from shapespace.reprs import describe_briefly, list_briefly
from shapespace.schemas import Methods, TestScheme
from shapespace.statistics.linear_regressors import (
    CHOICES,
    IndexArray,
    Regularisation,
    TrainingDecomposition,
    errors_of,
    folds_of,
    nested,
    weighted_mean,
)
from shapespace.statistics.methods import SCAN_OF_SUBJECT, AnalysisResult, methods_of
from shapespace.statistics.multiple_imputation import Imputations, over_imputations
from shapespace.statistics.predictor import Predictions, Predictor, cv_plus, model_hash_of
from shapespace.statistics.shape_prediction import FEWEST, ShapePrediction, predict_shapes
from shapespace.step_counter import StepCounter
from shapespace.types import FloatArray, read_only, require

SMALL = 100
"""Number of subjects below which a sample is reported as small."""
MEASURES = ("r2", "rmse", "mae", "slope", "intercept", "coverage", "width")
_BLOCK = 500  # permutations at a time; bounds memory


@dataclass(frozen=True)
class AccuracyMeasure:
    """A measure of predictions on held-out subjects, with its interval by resampling subjects; NaN if undefined."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False, kw_only=True)
class RegressionResult(AnalysisResult):
    """A regression of a number on shape, with its cross-validated accuracy.

    Args:
        cohort: cohort of the N shapes.
        target: column of the predicted number.
        observed: (N,) values of the number.
        subjects: (N,) name of the subject of each shape.
        predicted: (N,) predictions by nested cross-validation: neither the regression nor its choice used the subject.
        low, high: (N,) ends of intervals, by the same cross-validation.
        baseline: (N,) the mean of the training set, to which each subject contributes once.
        measures: measures of accuracy by the names in `MEASURES`; `r2` against the baseline, `slope` and `intercept` of
            the observed on the predicted, `coverage` and `width` of the intervals. Each subject counts once.
        baseline_rmse: root mean squared error of predicting the mean.
        baseline_mae: mean absolute error of predicting the mean.
        p: p of R2 by permutation of the targets among subjects; None without permutations.
        choice: regularisation that is chosen on all rows.
        effective: effective degrees of freedom of the choice.
        predictor: learned from all rows.
        shapes: the mean shapes along the target.
        confidence: level of all intervals.
        folds: number of folds of the outer cross-validation.
        permutations: number of permutations.
        draws: number of random draws of subjects, for the intervals of measures.
        seed: seed of folds, permutations and draws.
        subject: column of the subjects, as given; None for the default.
        imputations: imputations that p, predictions and measures combine; None without samples of completed shapes.

    Example:
        >>> result = ss.statistics.regress(cohort, "age", subject="subject")
        >>> result.predicted.shape
        (24,)
    """

    cohort: Cohort
    target: str
    observed: FloatArray
    subjects: tuple[str, ...]
    predicted: FloatArray
    low: FloatArray
    high: FloatArray
    baseline: FloatArray
    measures: Mapping[str, AccuracyMeasure]
    baseline_rmse: float
    baseline_mae: float
    p: float | None
    choice: Regularisation
    effective: float
    predictor: Predictor
    shapes: ShapePrediction
    confidence: float
    folds: int
    permutations: int
    draws: int
    seed: int
    subject: str | None = None
    imputations: Imputations | None = None

    @property
    def n_subjects(self) -> int:
        """Number of subjects."""
        return self.predictor.subjects

    @property
    def small(self) -> bool:
        """Whether the sample is small: measures on fewer than `SMALL` subjects scatter widely from sample to sample."""
        return self.n_subjects < SMALL

    @cached_property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        permutation = TestScheme(
            tested=("R²",), statistic="R²", reduced_model=None, arrangements=1 + self.permutations,
            unit="subject" if _is_constant(self.subjects, self.observed) else SCAN_OF_SUBJECT,
        )  # fmt: skip
        intervals = TestScheme(
            tested=("intervals of R², errors, slope and coverage",), statistic="percentiles", resampling="bootstrap",
            reduced_model=None, arrangements=self.draws,
        )  # fmt: skip
        return methods_of(
            self.cohort, self.n_subjects, tests=(permutation, intervals) if self.permutations else (intervals,),
            assumptions=(
                f"{self.target} is predicted by {self.choice.words()}, chosen in an inner cross-validation; all "
                f"figures are of subjects held out in {self.folds} folds. R² is that of these predictions against the "
                "mean of the training subjects, not a share of the sum of squares of shapes.",
            ),
        )  # fmt: skip

    def __repr__(self) -> str:
        figures = [
            f"{name} {measure.value:.3g} ({measure.low:.3g} to {measure.high:.3g})"
            for name, measure in self.measures.items()
        ]
        tested = [] if self.p is None else [f"p {self.p:.3g}"]
        return (
            f"<RegressionResult of {describe_briefly(self.target)} on {len(self.cohort)} shapes of {self.n_subjects} "
            f"subjects; {list_briefly([*tested, *figures])}>"
        )


def _update(result: RegressionResult) -> RegressionResult:
    """Return a regression whose combined interval of the coverage ends at 1."""
    coverage = result.measures["coverage"]
    return replace(result, measures={**result.measures, "coverage": replace(coverage, high=min(coverage.high, 1.0))})


@over_imputations(parts=("measures",), finish=_update)
def regress(
    cohort: Cohort,
    target: str,
    *,
    subject: str | None = None,
    folds: int = 10,
    permutations: int = 199,
    draws: int = 2000,
    confidence: float = 0.9,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> RegressionResult:
    """Predict a number from shape, and estimate the error of prediction on held-out subjects.

    If completed shapes have samples, each imputation is analysed too; p, measures and predictions of the cohort combine
    them by Rubin's rules.

    Args:
        cohort: cohort of the shapes.
        target: column of the number to predict.
        subject: column of the subjects, none of whom is on both sides of a fold (default: `subject`, if the table has
            it; otherwise each shape is of another subject).
        folds: number of folds of the outer cross-validation; the inner one has five.
        permutations: number of permutations for p; 0 for none.
        draws: number of random draws of subjects, for the intervals of measures.
        confidence: coverage of intervals.
        seed: seed of folds, permutations and draws.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (steps done, in all).

    Raises:
        InputError: no such column, values that are missing, no numbers or all the same, fewer than ten subjects, fewer
            subjects than folds, or invalid options.
    """
    require(cohort, Cohort, "regress", "read one with shapespace.read_cohort")
    _check_options(folds, permutations, draws, confidence, seed)
    subject = subject or (SUBJECT if SUBJECT in cohort.table.columns else None)
    cohort = cohort.complete([target, *([subject] if subject else [])], drop_missing=drop_missing, numbers=[target])
    y = cohort.table.numbers(target)
    if np.ptp(y) == 0:
        raise InputError(f"{cohort.table.where}: {target} is {y[0]:g} for all shapes, so there is nothing to learn.")
    subjects = subjects_of(cohort, subject)
    names = tuple(dict.fromkeys(subjects))
    number = {name: k for k, name in enumerate(names)}
    codes = np.array([number[name] for name in subjects])
    if len(names) < max(FEWEST, folds):
        raise InputError(
            f"{cohort.table.where}: {len(names)} subjects are too few to learn {target} from in {folds} folds; "
            f"{max(FEWEST, folds)} are the least."
        )
    share = share_of(subjects)
    X = cohort.coefficients
    rng = np.random.default_rng(seed)
    outer = folds_of(codes, folds, rng)
    inner = [folds_of(codes[outer != fold], min(5, len(names) // 2), rng) for fold in range(folds)]
    steps = StepCounter((1 + -(-permutations // _BLOCK)) * folds, progress)
    done = nested(X, y[:, None], share, outer, inner, on_fold=lambda _done, _folds: steps.add())
    predicted, baseline = done.predicted[:, 0], done.baseline[:, 0]
    low, high = _intervals(
        X=X, y=y, share=share, outer=outer, inner=inner, chosen=done.chosen[:, 0], confidence=confidence
    )
    measures = _measures(
        y=y,
        predicted=predicted,
        baseline=baseline,
        low=low,
        high=high,
        share=share,
        codes=codes,
        draws=draws,
        confidence=confidence,
        rng=rng,
    )
    p = _permutation_p(
        X=X,
        y=y,
        codes=codes,
        share=share,
        outer=outer,
        inner=inner,
        observed=measures["r2"].value,
        permutations=permutations,
        rng=rng,
        steps=steps,
    )

    errors = errors_of(X, y[:, None], share, outer, CHOICES)[:, 0]
    predictor, choice, effective = _predictor(
        cohort=cohort,
        target=target,
        y=y,
        share=share,
        outer=outer,
        choice=CHOICES[int(errors.argmin())],
        confidence=confidence,
    )
    return RegressionResult(
        cohort=cohort,
        target=target,
        observed=read_only(y),
        subjects=subjects,
        predicted=read_only(predicted),
        low=read_only(low),
        high=read_only(high),
        baseline=read_only(baseline),
        measures=measures,
        baseline_rmse=_rms(y - baseline, share),
        baseline_mae=float(np.average(np.abs(y - baseline), weights=share)),
        p=p,
        choice=choice,
        effective=effective,
        predictor=predictor,
        shapes=predict_shapes(cohort, target, subject=subject, confidence=confidence, permutations=0),
        confidence=confidence,
        folds=folds,
        permutations=permutations,
        draws=draws,
        seed=seed,
        subject=subject,
    )


def compare_with(
    predictions: Predictions, observed: FloatArray, share: FloatArray | None = None
) -> tuple[float, float, float]:
    """Return R2 (against the mean of the new shapes), RMSE and coverage of predictions of known targets.

    Args:
        predictions: predictions of n shapes.
        observed: (n,) their targets.
        share: (n,) weight of each shape, 1 / the number of scans of its subject; None if each subject has one scan.
    """
    share = np.ones(len(observed)) if share is None else share
    off = observed - predictions.value
    spread = float(share @ (observed - weighted_mean(observed, share)) ** 2)
    inside = (observed >= predictions.low) & (observed <= predictions.high)
    return (
        1.0 - float(share @ off**2) / spread if spread > 0 else float("nan"),
        _rms(off, share),
        float(share @ inside / share.sum()),
    )


def share_of(subjects: Sequence[str]) -> FloatArray:
    """Return the (N,) weight of each scan: 1 / the number of scans of its subject."""
    counts = Counter(subjects)
    return np.array([1.0 / counts[name] for name in subjects])


def _check_options(folds: int, permutations: int, draws: int, confidence: float, seed: int) -> None:
    if folds < 3:
        raise InputError(f"Cross-validation needs at least 3 folds, not {folds}.")
    if permutations < 0 or seed < 0 or draws < 1:
        raise InputError("The number of permutations and the seed must be 0 or more, and that of draws 1 or more.")
    if not 0.5 <= confidence < 1:
        raise InputError(f"The level of intervals must lie between 0.5 and 1, not at {confidence}.")


def _intervals(
    X: FloatArray,
    y: FloatArray,
    share: FloatArray,
    outer: IndexArray,
    inner: list[IndexArray],
    chosen: IndexArray,
    confidence: float,
) -> tuple[FloatArray, FloatArray]:
    """Return low and high (N,) of CV+ intervals of held-out rows, by the inner folds of their training sets."""
    low, high = np.empty_like(y), np.empty_like(y)
    for fold, own in enumerate(inner):
        test, train = outer == fold, outer != fold
        choice = CHOICES[int(chosen[fold])]
        residuals, ways, _, _ = _cross_validate(X[train], y[train], share[train], own, choice, X[test])
        low[test], high[test] = cv_plus(ways, residuals, own, share[train], confidence)
    return low, high


def _cross_validate(
    X: FloatArray, y: FloatArray, share: FloatArray, folds: IndexArray, choice: Regularisation, new: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return residuals (N,) without each row's fold, predictions (n, F) of `new`, weights (F, K), intercepts (F,)."""
    residuals = np.empty_like(y)
    weights: list[FloatArray] = []
    intercepts: list[float] = []
    for fold in range(int(folds.max()) + 1):
        test = folds == fold
        beta, intercept = TrainingDecomposition.of(X[~test], share[~test]).weights(y[~test], choice)
        residuals[test] = np.abs(y[test] - X[test] @ beta - intercept)
        weights.append(beta)
        intercepts.append(intercept)
    beta, intercept = np.stack(weights), np.array(intercepts)
    return residuals, new @ beta.T + intercept, beta, intercept


def _predictor(
    cohort: Cohort,
    target: str,
    y: FloatArray,
    share: FloatArray,
    outer: IndexArray,
    choice: Regularisation,
    confidence: float,
) -> tuple[Predictor, Regularisation, float]:
    X = cohort.coefficients
    decomposition = TrainingDecomposition.of(X, share)
    if choice.space == "whitened":
        choice = Regularisation("whitened", min(choice.amount, len(decomposition.singular)))
    beta, intercept = decomposition.weights(y, choice)
    residuals, _, weights, intercepts = _cross_validate(X, y, share, outer, choice, X[:1])
    middle = decomposition.middle
    all_beta, all_intercepts = np.vstack([beta, weights]), np.concatenate([[intercept], intercepts])
    farthest = float(np.sqrt(((X - middle) ** 2).sum(axis=1).max() / cohort.n_vertices))
    predictor = Predictor(
        target=target,
        gauge=cohort.gauge,
        model_hash=model_hash_of(cohort),
        mean=read_only(cohort.vertices(middle)),
        weights=read_only(all_beta @ cohort.basis),
        intercepts=read_only(all_intercepts + all_beta @ middle),
        residuals=read_only(residuals),
        fold=outer + 1,
        share=read_only(share),
        lowest=float(y.min()),
        highest=float(y.max()),
        farthest_mm=farthest,
        subjects=round(float(share.sum())),
        confidence=confidence,
        method=choice.words(),
    )
    return predictor, choice, decomposition.effective(choice)


def _measures(
    y: FloatArray,
    predicted: FloatArray,
    baseline: FloatArray,
    low: FloatArray,
    high: FloatArray,
    share: FloatArray,
    codes: IndexArray,
    draws: int,
    confidence: float,
    rng: np.random.Generator,
) -> dict[str, AccuracyMeasure]:
    """Return all measures with their intervals, in which each draw is a weighting of subjects."""
    n = int(codes.max()) + 1
    times = np.vstack([np.ones(n), rng.multinomial(n, np.full(n, 1.0 / n), draws)])
    off = y - predicted
    inside = (y >= low) & (y <= high)
    columns = np.column_stack([
        np.ones(len(y)), off**2, (y - baseline) ** 2, np.abs(off), inside, high - low,
        predicted, y, predicted**2, predicted * y,
    ])  # fmt: skip
    of_subject = np.zeros((n, columns.shape[1]))
    np.add.at(of_subject, codes, share[:, None] * columns)
    sums = times @ of_subject
    mean = (sums / sums[:, :1]).T
    _, square, by_mean, absolute, covered, width, m_p, m_y, m_pp, m_py = mean
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = (m_py - m_p * m_y) / (m_pp - m_p**2)
        measures = (1.0 - square / by_mean, np.sqrt(square), absolute, slope, m_y - slope * m_p, covered, width)
    tail = 50.0 * (1.0 - confidence)

    def measure(values: FloatArray) -> AccuracyMeasure:
        drawn = values[1:][np.isfinite(values[1:])]
        ends = np.percentile(drawn, [tail, 100.0 - tail]) if len(drawn) else (np.nan, np.nan)
        return AccuracyMeasure(float(values[0]), float(ends[0]), float(ends[1]))

    measured = {name: measure(values) for name, values in zip(MEASURES, measures, strict=True)}
    inside = measured["coverage"]
    ends = widen_share(np.array(inside.low), np.array(inside.high), n, confidence)
    return {**measured, "coverage": AccuracyMeasure(inside.value, *map(float, ends))}


def _permutation_p(
    X: FloatArray,
    y: FloatArray,
    codes: IndexArray,
    share: FloatArray,
    outer: IndexArray,
    inner: list[IndexArray],
    observed: float,
    permutations: int,
    rng: np.random.Generator,
    steps: StepCounter,
) -> float | None:
    """Return the share of permutations, the observed order among them, whose R2 is at least as high, each with its own
    choice."""
    if not permutations:
        return None
    beyond = 1
    for start in range(0, permutations, _BLOCK):
        targets = np.stack([_permute_targets(codes, y, rng) for _ in range(min(_BLOCK, permutations - start))], axis=1)
        done = nested(X, targets, share, outer, inner, on_fold=lambda _done, _folds: steps.add())
        # S43
        r2 = 1.0 - (share @ (targets - done.predicted) ** 2) / (share @ (targets - done.baseline) ** 2)
        beyond += int((r2 >= observed - 1e-12).sum())
    return beyond / (1 + permutations)


def _permute_targets(codes: IndexArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return the targets (N,) permuted between subjects, and within them if they vary; see `permutation_scheme`."""
    counts = np.bincount(codes)
    rows = [np.flatnonzero(codes == subject) for subject in range(len(counts))]
    if not any(np.ptp(y[own]) for own in rows):
        return y[[own[0] for own in rows]][rng.permutation(len(rows))][codes]
    order = np.arange(len(codes))
    for count in np.unique(counts):
        alike = np.flatnonzero(counts == count)
        for to, source in zip(alike, rng.permutation(alike), strict=True):
            given = rows[int(source)]
            # If all subjects have the same targets, exchanges between subjects alone have no effect.
            order[rows[to]] = rng.permutation(given) if np.ptp(y[given]) else given
    return y[order]


def _is_constant(subjects: Sequence[str], y: FloatArray) -> bool:
    """Return whether all scans of each subject have the same target."""
    return len(set(zip(subjects, y.tolist(), strict=True))) == len(set(subjects))


def permutation_scheme(subjects: Sequence[str], y: FloatArray) -> str:
    """Return a sentence that states which targets are exchanged under the null hypothesis of no relation with shape.

    Args:
        subjects: (N,) the subject of each row.
        y: (N,) targets.
    """
    scans = Counter(subjects)
    if _is_constant(subjects, y):
        return f"The permutations exchange the targets of all {len(scans)} subjects."
    partners = Counter(scans.values())
    alone = sum(partners[count] == 1 for count in scans.values())
    rest = f"; {alone} of {len(scans)} subjects have no such partner" if alone else ""
    return (
        "The target varies within subjects: the permutations exchange the targets of subjects with the same number of "
        f"scans, and the targets within each subject{rest}."
    )


def _rms(values: FloatArray, share: FloatArray) -> float:
    return float(np.sqrt(np.average(values**2, weights=share)))
