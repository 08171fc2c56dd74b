"""From the fits of the simulated study to recognition.json: every table, each with nobody tested who was trained on."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np

from expression_tables import automatic, compare, where
from maker import Maker, OnPart, Study
from people_tables import identity, strangers, transfer
from shapespace.io.files import write_text
from shapespace.recognise import evaluate
from shapespace.recognise.line_structure import (
    DisjointnessScores,
    LineScores,
    PooledLineScores,
    disjointness,
    line_scores,
    pooled_line_scores,
)
from shapespace.schemas import CurvePart, Part, Series, TextPart
from shapespace.study import parts
from shapespace.study.parts import target, words
from shapespace.types import IntArray
from simulated import PAPER_EXPRESSIONS, StudyConfig, paper_shown
from study_fits import STATUSES, paper_path, read_paper

_CEILING_MOST = 0.97
_LINE_R2_LEAST = 0.98
_P_MOST = 0.01
SHAPE_SPACES = "shape spaces"
NOT_REAL = (
    "All faces here are simulated, so these figures cannot be compared with those published for real scans, such as "
    "the 81 to 92 % on BU-3DFE, which themselves depend on the protocol."
)


def make_tables(
    folder: Path,
    config: StudyConfig,
    *,
    seconds: Mapping[str, float],
    on_part: OnPart | None = None,
    further: Sequence[Part] = (),
) -> Path:
    """Write recognition.json and what it shows, and return its path.

    Args:
        folder: of a study whose fits are done.
        config: its settings.
        seconds: what each part of the run took, for the record.
        on_part: called with what is made next.
        further: parts that follow, such as those of other shape spaces.

    Raises:
        FileError: files cannot be read or written.
        FileFormatError: a file of the study is damaged.
    """
    on_part = on_part or _no_progress
    on_part("reading the fits")
    study = Study.read(folder, config)
    made = document(Maker(study, on_part), seconds, further)
    path = folder / "recognition.json"
    write_text(path, json.dumps(made, indent=1, allow_nan=False) + "\n")
    return path


def _no_progress(what: str) -> None:
    pass


def seconds_of_study(seconds: Mapping[str, float]) -> float:
    """Return what the study itself took, without the comparison of shape spaces that may follow it."""
    return sum(value for name, value in seconds.items() if name != SHAPE_SPACES)


def document(maker: Maker, seconds: Mapping[str, float], further: Sequence[Part]) -> dict[str, Any]:
    """Return recognition.json."""
    study, config = maker.study, maker.study.config
    maker.on_part("the ceiling")
    most = ceiling(maker)
    maker.on_part("the paper's experiment 1")
    paper(maker)
    maker.on_part("six approaches")
    compared = compare(maker)
    maker.on_part("classifiers")
    chosen = automatic(maker, most)
    maker.on_part("where the decision lies")
    where(maker)
    maker.on_part("identity")
    identity(maker)
    maker.on_part("another generator")
    of_strangers = strangers(maker)
    maker.on_part("transfer")
    transfer(maker)
    own = study.fits.status[study.fold, np.arange(len(study.fold))]
    counts = ", ".join(
        f"{int((own == k).sum())} {name.replace('max_iterations', 'stopped at the iteration limit')}"
        for k, name in enumerate(STATUSES)
        if (own == k).any()
    )
    summary = [
        f"{config.people.people} simulated people in {len(config.people.expressions)} expressions at "
        f"{len(config.people.levels)} intensities and neutral: {len(own)} raw scans, each of other triangles, in "
        f"any pose, with {config.people.noise_mm:g} mm of noise and {100 * config.people.missing:.0f} % missing, "
        f"fitted without landmarks. {counts}.",
        f"{config.folds} folds by subject: shape model, alignment, scaling and classifier are made anew without "
        "the people tested.",
        f"The true unit weights themselves are told apart at {words(most['high'])} for the two "
        f"highest intensities and {words(most['all'])} for all, since people make expressions in ways of their "
        "own: that is the ceiling.",
        f"The additive model reaches {words(chosen['high, known'])} and {words(chosen['all, known'])} beside the "
        f"person's neutral scan, {words(chosen['high'])} and {words(chosen['all'])} from one scan alone; one PCA "
        f"with LDA reaches {words(compared['one PCA (the paper)'])} for all from one scan.",
        "Trained on these faces, a system tells the paper's four expressions on another generator's right at "
        + ", ".join(f"{words(share)} {how}" for how, share in of_strangers.items())
        + ".",
        NOT_REAL,
    ]
    total = seconds_of_study(seconds)
    if total:
        maker.targets.append(
            target("Wall time of the whole study", "below 15 minutes on 2 cores", f"{total / 60:.1f} minutes",
                   met=total < 900, note=f"on {platform.machine()}, as run here")
        )  # fmt: skip
    return parts.document(
        "Expressions, identities and their models: a simulated study",
        summary,
        maker.targets,
        [fits_table(study, own), *maker.parts, *further],
        settings=_flat(asdict(config)) | {f"seconds, {name}": round(value, 1) for name, value in seconds.items()},
        model_hashes=[model.shape.content_hash for model in study.models],
    )


def fits_table(study: Study, own: IntArray) -> Part:
    """Return how the fits went, by expression; `own` (N,) is the status of each where the scan is tested."""
    config = study.config
    own_error = study.fits.error_mm
    return parts.table(
        "The fits",
        [("Expression", "text"), ("Scans", "count"), ("Mean vertex error", "mm"), ("Largest", "mm"),
         ("Doubtful", "count"), ("Failed", "count"), ("Seconds a fit", "number")],
        [
            (name, int(of.sum()), np.nanmean(own_error[of]), np.nanmax(own_error[of]),
             int((own[of] == STATUSES.index("doubtful")).sum()), int((own[of] == STATUSES.index("failed")).sum()),
             round(float(np.nanmean(study.fits.seconds[of])), 3))
            for name in ("neutral", *config.people.expressions)
            for of in (study.expression == name,)
        ],
        "Distance of the model's vertices to the true ones, all of them, also where the scan is missing. Doubtful "
        "fits are classified and counted here; a failed one counts as wrong.",
    )  # fmt: skip


def ceiling(maker: Maker) -> dict[str, float]:
    """Classify the true unit weights under the same folds."""
    study, config = maker.study, maker.study.config
    weights = np.concatenate([config.people.unit_weights(study.ict, p) for p in range(config.people.people)])
    weights = weights[:, weights.std(axis=0) > 0]
    folds = [maker.fold_of(weights, fold) for fold in range(config.folds)]
    found = evaluate.nested_predictions(
        folds, classifiers=("lda", "logistic", "svm"), modes=(None,), inner_folds=parts.inner_folds(folds)
    )
    maker.true_weights = np.asarray(found.predicted)
    every, interval = parts.accuracy_of(maker.labels, found.predicted, maker.subjects)
    high, _ = parts.accuracy_of(maker.labels, found.predicted, maker.subjects, maker.high)
    maker.targets.append(
        target("A classifier on the true unit weights", f"below {words(_CEILING_MOST)}", words(max(high, every)),
               met=max(high, every) < _CEILING_MOST, note=f"95 % interval over people {_interval(interval)}")
    )  # fmt: skip
    return {"high": high, "all": every}


def paper(maker: Maker) -> None:
    """Score experiment 1: lines, and whether they are apart."""
    b, stddev, status = read_paper(paper_path(maker.study.folder))
    shown = paper_shown()[1:]
    labels, level = [name for name, _ in shown], np.array([level for _, level in shown])
    if not np.isfinite(b).all():
        maker.parts.append(TextPart(title="Experiment 1 of the paper", text="Some fits failed, so it has no scores."))
        return
    v = (b[1:] - b[0]) / stddev
    lines = {
        name: line_scores(v[[x == name for x in labels]], level[[x == name for x in labels]])
        for name in PAPER_EXPRESSIONS
    }
    apart, pooled = disjointness(v, labels), pooled_line_scores(v, labels, level)
    right = round(apart.leave_one_out_accuracy * len(labels))
    worst_p = max(
        apart.accuracy_p, apart.silhouette_p, apart.separability_p, apart.margin_p, pooled.mean_r2_p,
        pooled.monotonicity_p or 0.0, *pooled.r2_p.values(),
    )  # fmt: skip
    least = min(line.r2_through_neutral for line in lines.values())
    maker.targets += [
        target("Experiment 1 of the paper, test faces told right", "16 of 16", f"{right} of {len(labels)}",
               met=right == len(labels)),
        target("Its lines through neutral, least R²", f"at least {_LINE_R2_LEAST:g}", f"{least:.4f}",
               met=least >= _LINE_R2_LEAST),
        target("Its permutation tests, largest p", f"below {_P_MOST:g}", f"{worst_p:.3f}", met=worst_p < _P_MOST,
               note="line R² of each expression, order on the lines, accuracy, silhouette, separability, margin"),
    ]  # fmt: skip
    maker.parts += [
        _of_lines(lines, pooled, status),
        _of_apartness(apart),
        CurvePart(
            title="The lines of figure 9",
            x="first coefficient (mm)",
            y="second coefficient (mm)",
            series=tuple(
                Series(label=name, x=line[:, 0].tolist(), y=line[:, 1].tolist())
                for name in PAPER_EXPRESSIONS
                for line in (np.concatenate([b[:1], b[1:][[x == name for x in labels]]]),)
            ),
        ),
    ]  # fmt: skip


def _of_lines(lines: Mapping[str, LineScores], pooled: PooledLineScores, status: IntArray) -> Part:
    doubtful = int((status == STATUSES.index("doubtful")).sum())
    return parts.table(
        "Experiment 1 of the paper: one person, four expressions, 16 test faces",
        [("Expression", "text"), ("R² through neutral", "number"), ("p", "p"), ("R² of best line", "number"),
         ("Same side", "percent"), ("Rank correlation with intensity", "number")],
        [
            (name, round(line.r2_through_neutral, 4), pooled.r2_p[name], round(line.r2_free, 4),
             line.sign_consistency, line.spearman)
            for name, line in lines.items()
        ],
        f"Raw scans with noise and holes, from any pose; {doubtful} of {len(status)} fits are called doubtful, "
        f"since the strongest expressions lie far from the model's mean. Order along the lines, all "
        f"expressions together: p = {pooled.monotonicity_p:.3f}.",
    )  # fmt: skip


def _of_apartness(apart: DisjointnessScores) -> Part:
    return parts.table(
        "Whether the four lines are apart",
        [("Measure", "text"), ("Value", "number"), ("p", "p")],
        [
            ("Leave-one-out accuracy, nearest mean direction", apart.leave_one_out_accuracy, apart.accuracy_p),
            ("Cosine silhouette", round(apart.cosine_silhouette, 3), apart.silhouette_p),
            ("Separability tr(Sw⁻¹ Sb)", round(apart.separability, 2), apart.separability_p),
            (f"Smallest margin ({' and '.join(apart.smallest_margin_pair)}), pooled standard deviations",
             round(apart.smallest_margin, 2), apart.margin_p),
        ],
    )  # fmt: skip


def _interval(interval: tuple[float, float]) -> str:
    return f"{words(interval[0])} to {words(interval[1])}"


def _flat(settings: Mapping[str, object], before: str = "") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            out |= _flat(cast(dict[str, object], value), f"{key}: ")
        else:
            out[f"{before}{key}"] = list(cast(tuple[object, ...], value)) if isinstance(value, tuple) else value
    return out
