"""Reports of verification and identification."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from shapespace.cohort.proportions import zero_bound
from shapespace.report.analyses.analysis_report import AnalysisReport, ResultTable, cohort_report, histogram_part
from shapespace.schemas import CurvePart, HistogramPart, Part, Series, TablePart, TextPart
from shapespace.statistics.identity.identify import IdentificationRates, IdentificationResult
from shapespace.statistics.identity.rates import RateEstimate
from shapespace.statistics.identity.trial import Trial
from shapespace.statistics.identity.verify import FAR, GRID, VerificationRates, VerificationResult
from shapespace.statistics.methods import methods_of
from shapespace.types import FloatArray

_LEAST_RATE = 1e-4  # lowest false accept rate of the plot, the end of `GRID`
_BINS = 40  # bins of a histogram of thousands of pairs
_ERRORS = 30  # expected errors; a rate from fewer is uncertain by more than 30 % ("rule of 30")
_POINTS = 300  # points of a drawn curve, more than its pixels show
_PLDA = "Ioffe S. (2006) Probabilistic linear discriminant analysis. European Conference on Computer Vision, 531-542."
_SCORE_NAMES = {
    "plda": "PLDA score",
    "cosine": "cosine",
    "mahalanobis": "whitened distance",
    "distance": "plain distance",
}
_INTERVALS = (
    "95 % intervals are percentiles over draws of subjects with replacement; near 0 and 1 they are at least as wide as "
    "the exact interval of Clopper and Pearson for no error among the same number of subjects."
)


def verify_report(result: VerificationResult) -> AnalysisReport:
    """Return the report of `shapespace recognise verify`."""
    pairs, first = result.pairs, result.scores[0]
    genuine, impostor = int(pairs.same.sum()), int((~pairs.same).sum())
    rare = [far for far in FAR if impostor * far < _ERRORS]
    summary = (
        f"By {_score_label(first.name)} the equal error rate is {_percent_text(first.eer)}, over {genuine} pairs of "
        f"one subject and {impostor} pairs of two.",
        *(
            f"At a false accept rate of {100 * far:g} % it accepts {_percent_text(estimate)} of the pairs of one "
            "subject."
            for far, estimate in first.tar.items()
            if estimate.value is not None
        ),
        ""
        if first.cllr.value is None
        else f"Its calibrated likelihood ratios miss {first.cllr.value:.3f} bits of 1 (Cllr), of which "
        f"{first.cllr_min:.3f} would be missed by the best calibration.",
        *(
            f"By {_score_label(score.name)} the equal error rate is {_percent_text(score.eer)}."
            for score in result.scores[1:]
        ),
    )
    notes = (
        _no_error_sentence((first.eer.value or 0.0) > 0, pairs.genuine_people),
        f"{impostor} pairs of two make {', '.join(f'{impostor * far:.1f}' for far in rare)} false accepts at a rate of "
        f"{', '.join(f'{far:g}' for far in rare)}, and 30 are needed for a reliable rate; with fewer than one no "
        "rate is stated."
        if rare
        else "",
        "There are too few subjects to calibrate scores on subjects who are not tested, so there are no likelihood "
        "ratios."
        if first.llr is None
        else "",
    )
    arrays = {
        "rows": pairs.rows,
        "same": pairs.same,
        **{f"score_{score.name}": score.score for score in result.scores},
        **{f"llr_{score.name}": score.llr for score in result.scores if score.llr is not None},
    }
    figures = [row for score in result.scores for row in _verification_rows(score)]
    return _identity_report(
        result, "verify", "Verification", summary, notes, _verification_parts(result), figures, {"pairs.npz": arrays}
    )


def identify_report(result: IdentificationResult) -> AnalysisReport:
    """Return the report of `shapespace recognise identify`."""
    first = result.scores[0]
    enrolled = first.searches.enrolled
    unmeasured = ", ".join(f"{rate:g}" for rate, estimate in first.fnir.items() if estimate.value is None)
    summary = (
        f"By {_score_label(first.name)} the right subject is the first of {result.enrolled} in "
        f"{_percent_text(first.rank_1)} of {result.probes - int((~enrolled).sum())} searches.",
        *(
            f"Where {100 * rate:g} % of searches for strangers may return a person, "
            f"{_percent_text(estimate)} of those enrolled are missed."
            for rate, estimate in first.fnir.items()
            if estimate.value is not None
        ),
        *(
            f"By {_score_label(score.name)} the right subject is the first in {_percent_text(score.rank_1)}."
            for score in result.scores[1:]
        ),
    )
    notes = (
        _no_error_sentence((first.rank_1.value or 0.0) < 1, first.searches.people),
        f"There are too few searches for a false positive identification rate of {unmeasured}." if unmeasured else "",
        "All probes are of enrolled subjects, so each is also searched for in a gallery without its subject."
        if enrolled.all()
        else "",
    )
    arrays = {
        f"{field}_{score.name}": getattr(score.searches, field)
        for score in result.scores
        for field in ("rank", "own", "best_other")
    }
    figures = [row for score in result.scores for row in _identification_rows(score)]
    return _identity_report(
        result, "identify", "Identification", summary, notes, _identification_parts(result), figures,
        {"searches.npz": arrays},
    )  # fmt: skip


def _identity_report(
    result: VerificationResult | IdentificationResult,
    command: str,
    title: str,
    summary: Sequence[str],
    notes: Sequence[str],
    parts: Iterable[Part],
    figures: Sequence[Sequence[object]],
    arrays: Any,
) -> AnalysisReport:
    """Return a report with the content that both commands share: the role of each scan, the methods and the settings.

    Empty sentences in `summary` and `notes` are omitted.
    """
    trial, config, trained_on = result.trial, result.config, result.trained_on
    role = dict.fromkeys(range(len(trial.cohort)), "train")
    for trial_round in trial.rounds:
        role |= dict.fromkeys(trial_round.gallery, "both" if trial.all_pairs else "gallery")
        if not trial.all_pairs:
            role |= dict.fromkeys(trial_round.probes, "probe")
    used = {
        row
        for trial_round in trial.rounds
        for row in (*trial_round.training, *trial_round.gallery, *trial_round.probes)
    }
    # The order of `role` is that of the scans, since all of them are in it from the start.
    scans = [
        (name, subject, own if row in used else "")
        for name, subject, (row, own) in zip(trial.cohort.names, trial.subjects, role.items(), strict=True)
    ]
    measured = _subjects_sentence(trial, trained_on)
    scores = f"Two scans are compared by {', '.join(map(_score_label, config.scores))}."
    return cohort_report(
        f"recognise {command}",
        f"Who is it? {title}",
        [
            *parts,
            ResultTable.of_fields("figures.csv", ("score", "figure", "value", "low", "high"), figures),
            ResultTable.of_fields("scans.csv", ("scan", "subject", "role"), scans),
        ],
        trial.cohort,
        summary=tuple(filter(None, (*summary, measured))),
        arrays=arrays,
        notes=tuple(filter(None, (*trial.notes, *notes))),
        settings=asdict(config),
        methods=methods_of(trial.cohort, len(set(trial.subjects)), assumptions=(scores, measured, _INTERVALS)),
        state_methods=False,
        citations=(_PLDA,) if "plda" in config.scores else (),
    )


def _score_label(name: str) -> str:
    """Return the name of a score in words."""
    return _SCORE_NAMES.get(name, name)


def _percent_text(estimate: RateEstimate) -> str:
    """Return a share with its interval in words."""
    if estimate.value is None:
        return "not known"
    ends = _interval(estimate)
    return f"{100 * estimate.value:.2f} %" + (f" (95 %: {100 * ends[0]:.2f} to {100 * ends[1]:.2f} %)" if ends else "")


def _interval(estimate: RateEstimate) -> tuple[float, float] | None:
    """Return the ends of an interval, or None if there is none."""
    return None if estimate.low is None or estimate.high is None else (estimate.low, estimate.high)


def _cells(estimate: RateEstimate) -> tuple[float | None, float | None, float | None]:
    return estimate.value, estimate.low, estimate.high


def _cells_with_intervals(estimates: Iterable[RateEstimate]) -> tuple[object, ...]:
    return tuple(cell for estimate in estimates for cell in (estimate.value, _interval(estimate)))


def _thin_curve(x: FloatArray, y: FloatArray, label: str) -> Series:
    """Return a line through the ends and a few hundred points of a curve, those where it turns first."""
    corners = np.ones(len(x), dtype=np.bool_)
    corners[1:-1] = ~(((x[1:-1] == x[:-2]) & (x[1:-1] == x[2:])) | ((y[1:-1] == y[:-2]) & (y[1:-1] == y[2:])))
    kept_points = np.flatnonzero(corners)
    if len(kept_points) > _POINTS:
        kept_points = kept_points[np.unique(np.linspace(0, len(kept_points) - 1, _POINTS).round().astype(np.intp))]
    return Series(x=tuple(x[kept_points].tolist()), y=tuple(y[kept_points].tolist()), label=label)


def _subjects_sentence(trial: Trial, trained_on: int) -> str:
    """Return a sentence on the tested subjects and on those of the training set."""
    tested = int(trial.tested.sum())
    training = f"on {trained_on} other subjects" if trained_on else "on no subjects"
    if len(trial.rounds) == 1:
        return f"{tested} subjects were tested; scores and calibration were trained {training}."
    return (
        f"{tested} subjects were tested in {len(trial.rounds)} folds, each compared within itself; scores and "
        f"calibration were trained on the other folds, of at least {trained_on} subjects."
    )


def _no_error_sentence(errors: bool, people: int) -> str:
    """Return a sentence on the exact upper bound where no error was found among some people."""
    return (
        ""
        if errors
        else f"No error among {people} subjects does not mean an error rate of zero: up to "
        f"{100 * zero_bound(people):.1f} % of subjects may be affected by errors (95 %, Clopper-Pearson, "
        "with subjects as the units)."
    )


def _identification_rows(rates: IdentificationRates) -> list[Sequence[object]]:
    ranks = enumerate(zip(rates.cmc.tolist(), *rates.band.tolist(), strict=True), 1)
    return [
        [rates.name, "rank 1", *_cells(rates.rank_1)],
        *([rates.name, f"within {k}", share, *ends] for k, (share, *ends) in ranks),
        *([rates.name, f"fnir at fpir {rate:g}", *_cells(estimate)] for rate, estimate in rates.fnir.items()),
    ]


def _identification_parts(result: IdentificationResult) -> tuple[Part, ...]:
    rates = ["first", *(f"FNIR at FPIR {rate:g}" for rate in result.scores[0].fnir)]
    columns = ["score", *(name for rate in rates for name in (rate, "95 %"))]
    rows = tuple(
        (_score_label(score.name), *_cells_with_intervals((score.rank_1, *score.fnir.values())))
        for score in result.scores
    )
    ranks = tuple(float(k) for k in range(1, result.enrolled + 1))
    return (
        TablePart.of(
            "Identification rates", columns, rows, percent=rates,
            note="FPIR: searches for people who are not enrolled that return a person. FNIR: searches for "
            "enrolled people that do not return them first and above the threshold.",
        ),
        CurvePart(
            title="CMC curve",
            note="Share of probes whose subject is within the first ranks.",
            series=tuple(
                Series(x=ranks, y=tuple(score.cmc.tolist()), label=_score_label(score.name),
                       low=tuple(score.band[0].tolist()), high=tuple(score.band[1].tolist()))
                for score in result.scores
            ),
            x="rank",
            y="share of searches",
        ),
        TextPart(
            title="How it was measured",
            text=(
                _subjects_sentence(result.trial, result.trained_on),
                f"{result.enrolled} subjects are enrolled"
                + (" in each part at least." if len(result.trial.rounds) > 1 else ".")
                + " A subject's score is that of its most similar scan; ties count against the"
                f" right subject. {_INTERVALS}",
            ),
        ),
    )  # fmt: skip


def _verification_rows(rates: VerificationRates) -> Iterator[Sequence[object]]:
    yield rates.name, "eer", *_cells(rates.eer)
    yield from ((rates.name, f"tar at far {far:g}", *_cells(estimate)) for far, estimate in rates.tar.items())
    yield rates.name, "cllr", *_cells(rates.cllr)
    yield rates.name, "cllr_min", rates.cllr_min, None, None
    yield from ((rates.name, f"eer with {modes} modes", eer, None, None) for modes, eer in rates.curve.items())
    for value, part in rates.by.items():
        yield rates.name, f"eer of {value}", *_cells(part.eer)
        for far, estimate in part.tar.items():
            yield rates.name, f"tar at far {far:g} of {value}", *_cells(estimate)


def _verification_parts(result: VerificationResult) -> Iterator[Part]:
    yield from (_rates_table(result), _det_curve(result), _roc_curve(result))
    if any(score.curve for score in result.scores):
        yield CurvePart(
            title="Equal error rate by the number of modes",
            note="Leading coefficients of identity; the plain distance uses complete shapes.",
            series=tuple(
                Series(x=tuple(map(float, score.curve)), y=tuple(score.curve.values()), label=_score_label(score.name))
                for score in result.scores
            ),
            x="modes",
            y="equal error rate",
            x_scale="log",
        )
    if any(score.by for score in result.scores):
        yield _subgroup_table(result)
    yield from (_histogram(score, result) for score in result.scores[:2])
    yield TextPart(
        title="How it was measured",
        text=(
            _subjects_sentence(result.trial, result.trained_on),
            f"{_INTERVALS} Scores, PLDA scores among them, are not likelihood ratios until they are calibrated, by a "
            "logistic regression on pairs of subjects of other groups. The shape model must not have been built from "
            "the subjects tested here; its file does not show whether it was.",
        ),
    )


def _rates_table(result: VerificationResult) -> TablePart:
    rates = ["EER", *(f"TAR at FAR {far:g}" for far in FAR)]
    columns = ["score", *(name for rate in rates for name in (rate, "95 %")), "Cllr, bits", "Cllr-min, bits"]
    rows = tuple(
        (
            _score_label(score.name),
            *_cells_with_intervals((score.eer, *score.tar.values())),
            score.cllr.value,
            score.cllr_min,
        )
        for score in result.scores
    )
    return TablePart.of(
        "Verification rates", columns, rows, percent=rates,
        note="EER: error rate where false rejection and false acceptance are equal. TAR: pairs of one subject "
        "accepted, at a rate FAR of pairs of two accepted. Cllr: bits that the likelihood ratios lose, 0 to 1 and "
        "more.",
    )  # fmt: skip


def _det_curve(result: VerificationResult) -> CurvePart:
    genuine = int(result.pairs.same.sum())
    # A rate of 0 has no place on this scale, and a score without an error would have no line.
    ends = [0.5 / (len(result.pairs) - genuine), 0.5 / genuine]
    series: list[Series] = []
    for score in result.scores:
        rates = (score.roc.far[1:-1], 1 - score.roc.tar[1:-1])
        far, missed = (np.clip(rate, end, 1 - end) for rate, end in zip(rates, ends, strict=True))
        series.append(_thin_curve(far, missed, _score_label(score.name)))
    return CurvePart(
        title="DET curve",
        note="Both error rates as normal deviates; a rate of zero is drawn at half a pair.",
        series=tuple(series),
        x="false accept rate",
        y="false reject rate",
        x_scale="probit",
        y_scale="probit",
        diagonal=True,
    )


def _roc_curve(result: VerificationResult) -> CurvePart:
    least = max(1.0 / int((~result.pairs.same).sum()), _LEAST_RATE)
    series: list[Series] = []
    for score in result.scores:
        far = np.unique(np.concatenate([[least], GRID[least <= GRID]]))
        grid_points = np.searchsorted(GRID, far)
        band = [tuple(side[np.minimum(grid_points, len(GRID) - 1)].tolist()) for side in score.band]
        has_band = bool(np.isfinite(score.band).all())
        series.append(
            Series(
                x=tuple(far.tolist()),
                y=tuple(score.roc.tar_at(far).tolist()),
                label=_score_label(score.name),
                low=band[0] if has_band else None,
                high=band[1] if has_band else None,
            )
        )
    return CurvePart(
        title="ROC curve", series=tuple(series), x="false accept rate", y="true accept rate", x_scale="log"
    )


def _subgroup_table(result: VerificationResult) -> TablePart:
    rates = ("EER", "TAR at FAR 0.01")
    columns = (result.config.by or "", "score", "pairs of one", "pairs of two", rates[0], "95 %", rates[1], "95 %")
    rows = [
        (value, _score_label(score.name), part.genuine, part.impostor,
         *_cells_with_intervals((part.eer, part.tar[1e-2])))
        for value in (result.scores[0].by)
        for score in result.scores
        for part in (score.by[value],)
    ]  # fmt: skip
    return TablePart.of(f"By {result.config.by}", columns, rows, percent=rates)


def _histogram(rates: VerificationRates, result: VerificationResult) -> HistogramPart:
    values = rates.score if rates.llr is None else rates.llr / np.log(10.0)
    edges = np.linspace(float(values.min()), float(values.max()) + 1e-12, _BINS + 1)
    same = result.pairs.same
    return histogram_part(
        f"Scores: {_score_label(rates.name)}",
        {"one subject": values[same], "two subjects": values[~same]},
        edges,
        shares=True,
        note="Shares of each kind of pair.",
        x="score" if rates.llr is None else "calibrated likelihood ratio, powers of ten",
        y="share",
    )
