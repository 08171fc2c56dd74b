"""Report of verification."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shapespace.report.analyses.analysis_report import AnalysisReport
from shapespace.report.analyses.identity import (
    INTERVALS,
    config_settings,
    csv_cells,
    identity_methods,
    interval,
    no_error_sentence,
    percent_text,
    scan_rows,
    score_label,
    subjects_sentence,
    thin_curve,
    without_empty,
)
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes
from shapespace.schemas import Counts, CurvePart, HistogramPart, Part, Series, TablePart, TextPart
from shapespace.statistics.identity.verify import FAR, GRID, VerificationRates, VerificationResult

_LEAST_RATE = 1e-4  # lowest false accept rate of the plot, the end of `GRID`
_BINS = 40  # bins of a histogram of thousands of pairs
_ERRORS = 30  # expected errors; a rate from fewer is uncertain by more than 30 % ("rule of 30")


def verify_report(result: VerificationResult) -> AnalysisReport:
    """Return what `shapespace recognise verify` writes."""
    trial, first = result.trial, result.scores[0]
    pairs = result.pairs
    genuine = int(pairs.same.sum())
    impostor = len(pairs) - genuine
    summary = without_empty(
        [
            f"By {score_label(first.name)} the equal error rate is {percent_text(first.eer)}, over {genuine} pairs "
            "of one "
            f"subject and {impostor} pairs of two.",
            *(
                f"At a false accept rate of {100 * far:g} % it accepts {percent_text(one)} of the pairs of one subject."
                for far, one in first.tar.items()
                if one.value is not None
            ),
            _calibration_sentence(first),
            *(
                f"By {score_label(one.name)} the equal error rate is {percent_text(one.eer)}."
                for one in result.scores[1:]
            ),
            subjects_sentence(trial, result.trained_on),
        ]
    )
    rare_rates = [far for far in FAR if impostor * far < _ERRORS]
    notes = without_empty(
        [
            *trial.notes,
            no_error_sentence((first.eer.value or 0.0) > 0, pairs.genuine_people),
            f"{impostor} pairs of two make {', '.join(f'{impostor * far:.1f}' for far in rare_rates)} false accepts at "
            f"a rate of {', '.join(f'{far:g}' for far in rare_rates)}, and 30 are wanted for a rate to be trusted; "
            "below one "
            "nothing is stated."
            if rare_rates
            else "",
            "There are too few subjects to calibrate scores on subjects who are not tested, so there are no likelihood "
            "ratios."
            if first.llr is None
            else "",
        ]
    )
    arrays = {
        "rows": pairs.rows,
        "same": pairs.same,
        **{f"score_{one.name}": one.score for one in result.scores},
        **{f"llr_{one.name}": one.llr for one in result.scores if one.llr is not None},
    }
    header = ("score", "figure", "value", "low", "high")
    report = AnalysisReport(
        question="recognise verify",
        title="Who is it? Verification",
        summary=summary,
        parts=_parts(result),
        tables={
            "figures.csv": (header, [row for one in result.scores for row in _rows(one)]),
            "scans.csv": scan_rows(trial),
        },
        arrays={"pairs.npz": arrays},
        notes=notes,
        settings=config_settings(result.config),
        model_hashes=model_hashes(trial.cohort),
        **identity_methods(trial, result.config, result.trained_on),
    )
    return add_shape_data(report, trial.cohort)


def _calibration_sentence(one: VerificationRates) -> str:
    if one.cllr.value is None:
        return ""
    return (
        f"Its calibrated likelihood ratios miss {one.cllr.value:.3f} bits of 1 (Cllr), of which {one.cllr_min:.3f} "
        "would be missed by the best calibration."
    )


def _rows(one: VerificationRates) -> list[Sequence[object]]:
    rows: list[Sequence[object]] = [[one.name, "eer", *csv_cells(one.eer)]]
    rows += [[one.name, f"tar at far {far:g}", *csv_cells(estimate)] for far, estimate in one.tar.items()]
    rows += [[one.name, "cllr", *csv_cells(one.cllr)], [one.name, "cllr_min", one.cllr_min, "", ""]]
    rows += [[one.name, f"eer with {modes} modes", eer, "", ""] for modes, eer in one.curve.items()]
    for value, part in one.by.items():
        rows.append([one.name, f"eer of {value}", *csv_cells(part.eer)])
        rows += [
            [one.name, f"tar at far {far:g} of {value}", *csv_cells(estimate)] for far, estimate in part.tar.items()
        ]
    return rows


def _parts(result: VerificationResult) -> tuple[Part, ...]:
    parts: list[Part] = [_rates_table(result), _det_curve(result), _roc_curve(result)]
    if any(one.curve for one in result.scores):
        parts.append(
            CurvePart(
                title="Equal error rate by the number of modes",
                note="Leading coefficients of identity; the plain distance uses the whole shapes.",
                series=tuple(
                    Series(x=tuple(map(float, one.curve)), y=tuple(one.curve.values()), label=score_label(one.name))
                    for one in result.scores
                ),
                x="modes",
                y="equal error rate",
                x_scale="log",
            )
        )
    if any(one.by for one in result.scores):
        parts.append(_subgroup_table(result))
    parts += [_histogram(one, result) for one in result.scores[:2]]
    parts.append(
        TextPart(
            title="How it was measured",
            text=(
                subjects_sentence(result.trial, result.trained_on),
                f"{INTERVALS} Scores, PLDA scores among them, are not likelihood ratios until they are calibrated, by "
                "a logistic regression on pairs of subjects of other groups. Whether the shape model "
                "was built from subjects tested here cannot be seen from its file; it must not have been.",
            ),
        )
    )
    return tuple(parts)


def _rates_table(result: VerificationResult) -> TablePart:
    rates = ["EER", *(f"TAR at FAR {far:g}" for far in FAR)]
    columns = ["score", *(name for rate in rates for name in (rate, "95 %")), "Cllr, bits", "Cllr-min, bits"]
    rows: list[tuple[object, ...]] = []
    for one in result.scores:
        figure_cells = [
            cell
            for rate_estimate in (one.eer, *one.tar.values())
            for cell in (rate_estimate.value, interval(rate_estimate))
        ]
        rows.append((score_label(one.name), *figure_cells, one.cllr.value, one.cllr_min))
    return TablePart.of(
        "Verification rates", columns, rows, percent=rates,
        note="EER: error rate where false rejection and false acceptance are equal. TAR: pairs of one subject "
        "accepted, at a rate FAR of pairs of two accepted. Cllr: what the likelihood ratios miss, 0 to 1 and more.",
    )  # fmt: skip


def _det_curve(result: VerificationResult) -> CurvePart:
    genuine = int(result.pairs.same.sum())
    # A rate of 0 has no place on this scale, and a score without an error would have no line.
    ends = [0.5 / (len(result.pairs) - genuine), 0.5 / genuine]
    series: list[Series] = []
    for one in result.scores:
        rates = (one.roc.far[1:-1], 1 - one.roc.tar[1:-1])
        far, missed = (np.clip(rate, end, 1 - end) for rate, end in zip(rates, ends, strict=True))
        series.append(thin_curve(far, missed, score_label(one.name)))
    return CurvePart(
        title="DET curve",
        note="Both errors at their normal deviates; none at all stands at half a pair.",
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
    for one in result.scores:
        far = np.unique(np.concatenate([[least], GRID[least <= GRID]]))
        grid_points = np.searchsorted(GRID, far)
        band = [tuple(side[np.minimum(grid_points, len(GRID) - 1)].tolist()) for side in one.band]
        has_band = bool(np.isfinite(one.band).all())
        series.append(
            Series(
                x=tuple(far.tolist()),
                y=tuple(one.roc.tar_at(far).tolist()),
                label=score_label(one.name),
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
        (value, score_label(one.name), part.genuine, part.impostor, part.eer.value, interval(part.eer),
         part.tar[1e-2].value, interval(part.tar[1e-2]))
        for value in (result.scores[0].by)
        for one in result.scores
        for part in (one.by[value],)
    ]  # fmt: skip
    return TablePart.of(f"By {result.config.by}", columns, rows, percent=rates)


def _histogram(one: VerificationRates, result: VerificationResult) -> HistogramPart:
    values = one.score if one.llr is None else one.llr / np.log(10.0)
    edges = np.linspace(float(values.min()), float(values.max()) + 1e-12, _BINS + 1)
    counts = [
        Counts(counts=tuple((np.histogram(values[kind], edges)[0] / kind.sum()).tolist()), label=label)
        for kind, label in ((result.pairs.same, "one subject"), (~result.pairs.same, "two subjects"))
    ]
    return HistogramPart(
        title=f"Scores: {score_label(one.name)}",
        note="Shares of each kind of pair.",
        edges=tuple(edges.tolist()),
        series=tuple(counts),
        x="score" if one.llr is None else "calibrated likelihood ratio, powers of ten",
        y="share",
    )
