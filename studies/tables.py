"""From the fits of the simulated study to recognition.json: every table, each with nobody tested who was trained on."""

from __future__ import annotations

import io
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

import approaches
from approaches import APPROACHES, Features, Rows
from shapespace.datasets.ict import IctFaces, load_ict
from shapespace.errors import InputError
from shapespace.io.files import make_folder, write_bytes, write_text
from shapespace.io.meshes import write_mesh
from shapespace.model.additive import AdditiveModel
from shapespace.recognise import evaluate
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.hierarchy import FaceTypes
from shapespace.recognise.line_structure import disjointness, line_scores, pooled_line_scores
from shapespace.study import parts
from shapespace.study.parts import Part, target, words
from shapespace.types import BoolArray, FloatArray, IntArray
from simulated import (
    PAPER_EXPRESSIONS,
    STATUSES,
    Fits,
    StudyConfig,
    model_path,
    paper_path,
    paper_shown,
    person_path,
    read_fits,
    read_paper,
    stranger_path,
    stranger_shown,
)

Told = Callable[[str], None]
TextArray = npt.NDArray[np.str_]

_HIGH = 0.75
_CEILING_MOST = 0.97
_NEAR_HIGH, _NEAR_ALL = 0.03, 0.08
_ADDITIVE_GAIN = 0.05
_STRANGERS_LEAST = 0.85
_RANK_1_LEAST = 0.95
_LINE_R2_LEAST = 0.98
_P_MOST = 0.01
SHAPE_SPACES = "shape spaces"
_OF_ALL_SCANS = {
    "together": "one identity for all scans of a person",
    "mean": "about the mean of all scans of a person",
}
_CURVE = (2, 5, 10, 20, 40, 75)
NOT_REAL = (
    "All faces here are simulated, so these figures cannot be compared with those published for real scans, such as "
    "the 81 to 92 % on BU-3DFE, which themselves depend on the protocol."
)


@dataclass(frozen=True, eq=False)
class Study:
    """Everything that the tables are made of.

    Args:
        folder: of the study.
        config: its settings.
        models: one a fold.
        fits: of all scans.
        ict: the face model, for the true unit weights.
    """

    folder: Path
    config: StudyConfig
    models: tuple[AdditiveModel, ...]
    fits: Fits
    ict: IctFaces

    @classmethod
    def read(cls, folder: Path, config: StudyConfig) -> Study:
        """Read what `run_fits` wrote.

        Raises:
            FileError: a file cannot be read.
            FileFormatError: a file is damaged.
        """
        models = tuple(AdditiveModel.load(model_path(folder, fold)) for fold in range(config.folds))
        most = max(model.shape.n_modes for model in models)
        paths = [person_path(folder, person) for person in range(config.people.people)]
        return cls(folder, config, models, read_fits(paths, most), load_ict())

    @cached_property
    def expression(self) -> TextArray:
        """(N,) what each scan shows."""
        return np.array([name for name, _ in self.config.people.shown], dtype=np.str_)[self.fits.shown]

    @cached_property
    def level(self) -> FloatArray:
        """(N,) at which intensity."""
        return np.array([level for _, level in self.config.people.shown])[self.fits.shown]

    @cached_property
    def subject(self) -> TextArray:
        """(N,) who."""
        return np.array([self.config.people.subject(int(p)) for p in self.fits.person], dtype=np.str_)

    @cached_property
    def fold(self) -> IntArray:
        """(N,) where each scan is tested."""
        return self.config.fold_of()[self.fits.person]

    @cached_property
    def place(self) -> IntArray:
        """(N,) place among the taught scans of the person, or -1."""
        return np.concatenate([self.config.taught(person) for person in range(self.config.people.people)])

    def rows(self, fold: int, chosen: BoolArray) -> Rows:
        """Return the fits of `chosen` scans by the model of `fold`; those that failed are NaN."""
        k, e = self.models[fold].shape.n_modes, self.models[fold].n_expression
        shown = np.where(self.place >= 0, self.place, self.fits.shown)
        return Rows(
            self.fits.z[fold][chosen][:, :k],
            self.fits.z_stddev[fold][chosen][:, :k],
            self.expression[chosen],
            shown[chosen],
            self.subject[chosen],
            self.fits.e_beside[fold][chosen][:, :e],
            self.fits.e_together[fold][chosen][:, :e],
        )

    def training(self, fold: int) -> Rows:
        """Return the taught scans of everybody who is not tested in `fold`, without those that failed."""
        rows = self.rows(fold, (self.fold != fold) & (self.place >= 0))
        return rows.where(rows.usable)

    def tested(self, fold: int) -> BoolArray:
        """Return (N,) which scans are tested in `fold`: expressive ones of its people."""
        return (self.fold == fold) & (self.level > 0)

    def neutral(self, fold: int) -> Rows:
        """Return everybody's neutral scans by the model of `fold`."""
        return self.rows(fold, self.fits.shown == 0)


def make_tables(
    folder: Path,
    config: StudyConfig,
    *,
    seconds: Mapping[str, float],
    on_part: Told | None = None,
    further: Sequence[Part] = (),
) -> Path:
    """Write recognition.json and what it shows, and return its path.

    Args:
        folder: of a study whose fits are done.
        config: its settings.
        seconds: what each part of the run took, for the record.
        on_part: told what is made next.
        further: parts that follow, such as those of other shape spaces.

    Raises:
        FileError: files cannot be read or written.
        FileFormatError: a file of the study is damaged.
    """
    told: Told = on_part or _untold
    told("reading the fits")
    study = Study.read(folder, config)
    made = _Maker(study, told).document(seconds)
    made["parts"] += further
    path = folder / "recognition.json"
    write_text(path, json.dumps(made, indent=1, allow_nan=False) + "\n")
    return path


def _untold(what: str) -> None:
    pass


def seconds_of_study(seconds: Mapping[str, float]) -> float:
    """Return what the study itself took, without the comparison of shape spaces that may follow it."""
    return sum(value for name, value in seconds.items() if name != SHAPE_SPACES)


class _Maker:
    """Makes the parts in order, with the targets that they answer."""

    def __init__(self, study: Study, told: Told) -> None:
        self.study = study
        self.told = told
        self.targets: list[dict[str, Any]] = []
        self.parts: list[Part] = []
        tested = study.level > 0
        self.labels = study.expression[tested]
        self.subjects = study.subject[tested]
        self.level = study.level[tested]
        self.high = self.level >= _HIGH
        self.classes = tuple(sorted(set(self.labels.tolist())))
        self.index = np.full(len(tested), -1)
        self.index[tested] = np.arange(int(tested.sum()))

    def document(self, seconds: Mapping[str, float]) -> dict[str, Any]:
        """Return recognition.json."""
        study, config = self.study, self.study.config
        self.told("the ceiling")
        ceiling = self.ceiling()
        self.told("the paper's experiment 1")
        self.paper()
        self.told("six approaches")
        compared = self.compare(ceiling)
        self.told("classifiers")
        chosen = self.automatic(ceiling)
        self.told("where the decision lies")
        self.where()
        self.told("identity")
        self.identity()
        self.told("another generator")
        strangers = self.strangers()
        self.told("transfer")
        self.transfer()
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
            f"The true unit weights themselves are told apart at {words(ceiling['high'])} for the two "
            f"highest intensities and {words(ceiling['all'])} for all, since people make expressions in ways of their "
            "own: that is the ceiling.",
            f"The additive model reaches {words(chosen['high, known'])} and {words(chosen['all, known'])} beside the "
            f"person's neutral scan, {words(chosen['high'])} and {words(chosen['all'])} from one scan alone; one PCA "
            f"with LDA reaches {words(compared['one PCA (the paper)'])} for all from one scan.",
            "Trained on these faces, a system tells the paper's four expressions on another generator's right at "
            + ", ".join(f"{words(share)} {how}" for how, share in strangers.items())
            + ".",
            NOT_REAL,
        ]
        total = seconds_of_study(seconds)
        if total:
            self.targets.append(
                target("Wall time of the whole study", "below 15 minutes on 2 cores", f"{total / 60:.1f} minutes",
                       met=total < 900, note=f"on {platform.machine()}, as run here")
            )  # fmt: skip
        own_error = study.fits.error_mm
        self.parts.insert(0, parts.table(
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
        ))  # fmt: skip
        return parts.document(
            "Expressions, identities and their models: a simulated study",
            summary,
            self.targets,
            self.parts,
            settings=_flat(asdict(config)) | {f"seconds, {name}": round(value, 1) for name, value in seconds.items()},
            model_hashes=[model.shape.content_hash for model in study.models],
        )

    # What everything is compared with

    def ceiling(self) -> dict[str, float]:
        """Classify the true unit weights under the same folds."""
        study, config = self.study, self.study.config
        weights = np.concatenate([config.people.unit_weights(study.ict, p) for p in range(config.people.people)])
        weights = weights[:, weights.std(axis=0) > 0]
        folds = [self._fold(weights, weights, fold, taught=False) for fold in range(config.folds)]
        found = evaluate.nested_predictions(
            folds, classifiers=("lda", "logistic", "svm"), modes=(None,), inner_folds=parts.inner_folds(folds)
        )
        self.true_weights = np.asarray(found.predicted)
        every, interval = parts.accuracy_of(self.labels, found.predicted, self.subjects)
        high, _ = parts.accuracy_of(self.labels, found.predicted, self.subjects, self.high)
        self.targets.append(
            target("A classifier on the true unit weights", f"below {words(_CEILING_MOST)}", words(max(high, every)),
                   met=max(high, every) < _CEILING_MOST, note=f"95 % interval over people {_interval(interval)}")
        )  # fmt: skip
        return {"high": high, "all": every}

    # The paper's experiment 1

    def paper(self) -> None:
        """Score experiment 1: lines, and whether they are apart."""
        b, stddev, status = read_paper(paper_path(self.study.folder))
        shown = paper_shown()[1:]
        labels, level = [name for name, _ in shown], np.array([level for _, level in shown])
        if not np.isfinite(b).all():
            self.parts.append(
                {
                    "kind": "text",
                    "title": "Experiment 1 of the paper",
                    "text": ["Some fits failed, so it has no scores."],
                }
            )
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
        self.targets += [
            target("Experiment 1 of the paper, test faces told right", "16 of 16", f"{right} of {len(labels)}",
                   met=right == len(labels)),
            target("Its lines through neutral, least R²", f"at least {_LINE_R2_LEAST:g}", f"{least:.4f}",
                   met=least >= _LINE_R2_LEAST),
            target("Its permutation tests, largest p", f"below {_P_MOST:g}", f"{worst_p:.3f}", met=worst_p < _P_MOST,
                   note="line R² of each expression, order on the lines, accuracy, silhouette, separability, margin"),
        ]  # fmt: skip
        doubtful = int((status == STATUSES.index("doubtful")).sum())
        self.parts += [
            parts.table(
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
            ),
            parts.table(
                "Whether the four lines are apart",
                [("Measure", "text"), ("Value", "number"), ("p", "p")],
                [
                    ("Leave-one-out accuracy, nearest mean direction", apart.leave_one_out_accuracy, apart.accuracy_p),
                    ("Cosine silhouette", round(apart.cosine_silhouette, 3), apart.silhouette_p),
                    ("Separability tr(Sw⁻¹ Sb)", round(apart.separability, 2), apart.separability_p),
                    (f"Smallest margin ({' and '.join(apart.smallest_margin_pair)}), pooled standard deviations",
                     round(apart.smallest_margin, 2), apart.margin_p),
                ],
            ),
            {
                "kind": "lines",
                "title": "The lines of figures 9 and 10",
                "points": [
                    {"label": f"{name} {100 * level:.0f} %", "expression": name, "intensity": level,
                     "b": b[1 + k].tolist(), "z": (b[1 + k] / stddev).tolist()}
                    for k, (name, level) in enumerate(shown)
                ],
                "neutral": {"b": b[0].tolist(), "z": (b[0] / stddev).tolist()},
            },
        ]  # fmt: skip

    # Approaches under the same folds

    def compare(self, ceiling: Mapping[str, float]) -> dict[str, float]:
        """Compare all approaches, with the subject's neutral face unknown and known; return accuracy over all."""
        study, config = self.study, self.study.config
        rows: list[tuple[object, ...]] = []
        accuracy: dict[str, float] = {}
        self.features: dict[str, list[Features]] = {}
        for name, approach in APPROACHES.items():
            self.told(name)
            learned = [approach(study.models[f], study.training(f)) for f in range(config.folds)]
            self.features[name] = learned
            for relative in (False, True):
                if name == "additive":
                    folds = self._additive_folds("known" if relative else "unknown")
                else:
                    folds = [self._learned_fold(learned[f], f, relative=relative) for f in range(config.folds)]
                found = evaluate.fixed_predictions(folds, "lda")
                row = self._row(name, found.predicted, "known" if relative else "unknown")
                rows.append(row)
                accuracy[f"{name}, known" if relative else name] = float(str(row[3]))
        typed, note = self.hierarchies()
        rows[2:2] = typed
        for how, title in _OF_ALL_SCANS.items():
            found = evaluate.fixed_predictions(self._additive_folds(how), "lda")
            rows.append(self._row(f"additive, {title}", found.predicted, "unknown"))
        rows.append(self._row("true unit weights (the ceiling)", tuple(self.true_weights.tolist()), "not needed"))
        gain = accuracy["additive"] - accuracy["one PCA (the paper)"]
        known = accuracy["additive, known"] - accuracy["one PCA (the paper), known"]
        self.targets.append(
            target("Additive model against one PCA, unseen people",
                   f"at least {100 * _ADDITIVE_GAIN:.0f} points better",
                   f"{100 * gain:+.1f} points", met=gain >= _ADDITIVE_GAIN,
                   note=f"all intensities, same registrations and classifier; with neutral known {100 * known:+.1f}")
        )  # fmt: skip
        self.parts.append(
            parts.table(
                "Six approaches, one classifier, the same folds",
                [
                    ("Approach", "text"),
                    ("Neutral face", "text"),
                    ("Two highest", "percent"),
                    ("All four", "percent"),
                    ("95 % over people, all four", "interval"),
                    ("Lowest", "percent"),
                ],
                rows,
                "Macro accuracy of shrinkage LDA on unseen people, by the same fits. With the neutral face known, "
                "codes are relative to it, and in the additive model it shares its identity. What takes all scans of a "
                "person takes no label of them; about their mean, it needs the expressions to be balanced, as they are "
                f"here. {note}",
            )
        )
        return accuracy

    def hierarchies(self) -> tuple[list[tuple[object, ...]], str]:
        """Return rows of the paper's hierarchy, hard and soft, with the number of types by BIC and with three."""
        study = self.study
        rows: list[tuple[object, ...]] = []
        counts: list[int] = []
        for types in (None, 3):
            how = "types by BIC" if types is None else f"{types} types"
            try:
                found = [
                    approaches.face_types(study.models[f], study.training(f), types, study.config.people.seed)
                    for f in range(study.config.folds)
                ]
                answers = {soft: self._by_type(found, soft=soft) for soft in (False, True)}
            except InputError as error:
                rows += [
                    (f"{word} hierarchy, {how}: {error}", "unknown", None, None, None, None)
                    for word in ("hard", "soft")
                ]
                continue
            counts += [one.count for one in found if types is None]
            for soft, predicted in answers.items():
                rows.append(self._row(f"{'soft' if soft else 'hard'} hierarchy, {how}", predicted, "unknown"))
        asked = " or ".join(map(str, sorted(set(counts)))) or "an unknown number of"
        return rows, (
            f"BIC asks for {asked} type(s) of face: identities of these people are drawn from one normal cloud. Three "
            "types are forced on them for the comparison, and each has fewer training faces."
        )

    def _by_type(self, types: Sequence[FaceTypes], *, soft: bool) -> tuple[str, ...]:
        study = self.study
        predicted = np.full(len(self.labels), "", dtype=self.labels.dtype)
        for fold, one in enumerate(types):
            tested = study.tested(fold)
            faces = study.rows(fold, tested)
            classes, likely = approaches.by_type(
                study.models[fold], study.training(fold), faces.where(faces.usable), one, soft=soft
            )
            predicted[self.index[np.flatnonzero(tested)[faces.usable]]] = np.asarray(classes)[likely.argmax(axis=1)]
        return tuple(predicted.tolist())

    # The default

    def automatic(self, ceiling: Mapping[str, float]) -> dict[str, float]:
        """Choose classifiers by nested cross-validation on the additive model's expressions; return the accuracies."""
        best: dict[str, float] = {}
        rows: list[tuple[object, ...]] = []
        by_neutral: dict[bool, evaluate.Predictions] = {}
        for relative in (False, True):
            folds = self._additive_folds("known" if relative else "unknown")
            self.told("the classifier, by nested cross-validation")
            nested = evaluate.nested_predictions(folds, modes=(10, None), inner_folds=parts.inner_folds(folds))
            by_neutral[relative] = nested
            chosen = ", ".join(sorted({choice.classifier for choice in nested.chosen}))
            word = "known" if relative else "unknown"
            rows.append(self._row(f"chosen by nested cross-validation ({chosen})", nested.predicted, word))
            for name in CLASSIFIERS:
                fixed = parts.fixed(folds, name)
                if fixed is None:
                    rows.append((f"{name} (too few samples)", word, None, None, None, None))
                else:
                    rows.append(self._row(name, fixed.predicted, word))
        for relative, key in ((False, ""), (True, ", known")):
            found = by_neutral[relative].predicted
            best[f"all{key}"] = parts.accuracy_of(self.labels, found, self.subjects)[0]
            best[f"high{key}"] = parts.accuracy_of(self.labels, found, self.subjects, self.high)[0]
        for key, near, what in (
            ("high", _NEAR_HIGH, "two highest intensities"),
            ("all", _NEAR_ALL, "all four intensities"),
        ):
            wanted = f"within {100 * near:.0f} points of the ceiling of {words(ceiling[key])}"
            self.targets += [
                target(f"Six expressions, unseen people, {what}, neutral face {word}", wanted, words(reached),
                       met=reached >= ceiling[key] - near, note=note)
                for word, reached, note in (
                    ("known", best[f"{key}, known"], "relative to the person's own neutral scan, no landmarks"),
                    ("unknown", best[key], "from one scan alone"),
                )
            ]  # fmt: skip
        found = by_neutral[False]
        folds = self._additive_folds("unknown")
        self.told("permutations")
        test = evaluate.permutation_test(_same_rows(folds), permutations=99)
        self.parts += [
            parts.table(
                "Classifiers on the additive model's expressions",
                [("Classifier", "text"), ("Neutral face", "text"), ("Two highest", "percent"), ("All four", "percent"),
                 ("95 % over people, all four", "interval"), ("Lowest", "percent")],
                rows,
                f"Macro accuracy on unseen people. With labels shuffled within each person LDA gets "
                f"{words(float(test.null.mean()))} (p = {test.p:.3f}).",
            ),
            parts.confusion("All four intensities", self.labels.tolist(), found.predicted, self.classes,
                            "The additive model, classifier chosen inside the training people, neutral face unknown."),
            parts.confusion("Two highest intensities", self.labels[self.high].tolist(),
                            np.asarray(found.predicted)[self.high].tolist(), self.classes, "The same."),
            parts.per_class("Each expression, all intensities", self.labels.tolist(), found.predicted, self.classes),
            parts.calibration("Whether the probabilities come true", self.labels.tolist(), found.probabilities,
                              found.classes),
            parts.learning_curve("How many people it takes", folds, _CURVE, ceiling=ceiling["all"]),
        ]  # fmt: skip
        return best

    def where(self) -> None:
        """Show which modes and which parts of the face carry the decision."""
        study = self.study
        folds = self._additive_folds("unknown")
        fewest = min(fold.train.shape[1] for fold in folds)
        losses = [evaluate.mode_importance([fold], modes=fewest, repeats=2)[0, :fewest] for fold in folds]
        loss = np.mean(losses, axis=0)
        model = study.models[0]
        training = study.training(0).expressive
        a, e = model.split(training.z)
        t: FloatArray = np.concatenate([np.zeros(a.shape), e], axis=1)
        basis = _basis_of_codes(model)
        decision = evaluate.decision_map(basis, np.ones(model.shape.n_modes), t, training.expression.tolist())
        regions = _regions(study)
        faces: IntArray = model.shape.faces if model.shape.faces is not None else np.zeros((0, 3), dtype=np.int32)
        memory = io.BytesIO()
        np.savez(memory, vertices=model.shape.mean_vertices, faces=faces, decision=decision)
        write_bytes(study.folder / "recognition.npz", memory.getvalue())
        self.parts += [
            {
                "kind": "modes", "title": "Which modes carry the decision",
                "importance": [round(100 * float(x), 3) for x in loss],
                "names": [f"e{k + 1}" for k in range(len(loss))],
                "unit": "points of accuracy lost when the mode is shuffled",
                "note": "Means over the folds, whose models number their modes alike only about.",
            },
            {
                "kind": "face_map", "title": "Which parts of the face carry the decision", "arrays": "recognition.npz",
                "vertices": "vertices", "faces": "faces", "values": "decision",
                "unit": "variance between expressions over variance within",
                "regions": evaluate.region_shares(decision, regions),
            },
        ]  # fmt: skip

    # Identity

    def identity(self) -> None:
        """Recognise people from expressive scans, and measure how far identity and expression are apart."""
        study, config = self.study, self.study.config
        rows: list[tuple[object, ...]] = []
        codes: dict[str, Callable[[int, Rows], FloatArray]] = {
            "additive model, a": lambda f, r: study.models[f].split(r.z)[0],
            "one PCA (the paper), b": lambda f, r: self.features["one PCA (the paper)"][f](r),
            "additive model, e (should be chance)": lambda f, r: study.models[f].split(r.z)[1],
        }
        reached = float("nan")
        for name, code in codes.items():
            hits: list[FloatArray] = []
            for fold in range(config.folds):
                gallery = study.neutral(fold)
                enrolled = _unit(code(fold, gallery.where(gallery.usable)))
                names = gallery.subject[gallery.usable]
                probes = study.rows(fold, study.tested(fold))
                usable = probes.usable
                nearest = (_unit(code(fold, probes.where(usable))) @ enrolled.T).argmax(axis=1)
                hit = np.zeros(len(usable))
                hit[usable] = names[nearest] == probes.subject[usable]
                hits.append(hit)
            level = np.concatenate([study.level[study.tested(fold)] for fold in range(config.folds)])
            all_hits = np.concatenate(hits)
            rows.append((name, float(all_hits.mean()), float(all_hits[level >= _HIGH].mean())))
            if name.endswith(" a"):
                reached = float(all_hits.mean())
        tied = self.tied()
        rows.append(("additive model, a of all a person's expressive scans together", tied, None))
        people = config.people.people
        self.targets.append(
            target(f"Identity, rank 1 of {people} enrolled neutral faces, from expressive scans",
                   f"at least {words(_RANK_1_LEAST)}", words(reached), met=reached >= _RANK_1_LEAST,
                   note=f"from all scans of a person together {words(tied)}")
        )  # fmt: skip
        self.parts += [
            parts.table(
                "Whose face it is, from expressive scans",
                [("Code, nearest by cosine", "text"), ("All four intensities", "percent"), ("Two highest", "percent")],
                rows,
                f"Rank 1 among the neutral faces of all {people} people; chance is {words(1 / people)}. Whoever is "
                "looked for was not in the shape model.",
            ),
            self.apart(),
        ]

    def tied(self) -> float:
        """Return the rank-1 rate with one identity for all of a person's expressive scans."""
        study, hits = self.study, list[bool]()
        for fold in range(study.config.folds):
            model, gallery = study.models[fold], study.neutral(fold)
            finite = gallery.usable
            enrolled, names = _unit(model.split(gallery.z[finite])[0]), gallery.subject[finite]
            for person in np.flatnonzero(study.config.fold_of() == fold):
                a = study.fits.a_together[fold, person, : model.n_identity]
                name = study.config.people.subject(int(person))
                hits.append(bool(np.isfinite(a).all() and names[(enrolled @ (a / np.linalg.norm(a))).argmax()] == name))
        return float(np.mean(hits))

    def apart(self) -> Part:
        """Measure disentanglement: what should be chance, and the spread of neutralised faces."""
        study, config = self.study, self.study.config
        from_a = self._accuracy_of(lambda f, r: study.models[f].split(r.z)[0])
        spread_a: list[float] = []
        spread_e: list[float] = []
        between: list[float] = []
        for fold in range(config.folds):
            model = study.models[fold]
            chosen = study.fold == fold
            faces = study.rows(fold, chosen)
            usable = faces.usable
            faces, level = faces.where(usable), study.level[chosen][usable]
            a, e = model.split(faces.z)
            for name in np.unique(faces.subject):
                spread_a.append(_spread_mm(model, a[faces.subject == name], identity=True))
            for name in config.people.expressions:
                same = (faces.expression == name) & (level == max(config.people.levels))
                spread_e.append(_spread_mm(model, e[same], identity=False))
            between.append(_spread_mm(model, a[faces.expression == "neutral"], identity=True))
        return parts.table(
            "How far identity and expression are apart",
            [("Measure", "text"), ("Value", "text"), ("Should be", "text")],
            [
                ("Expression from identity a", words(from_a), f"chance, {words(1 / len(self.classes))}"),
                ("Spread of one person's faces made neutral (e = 0)", f"{np.mean(spread_a):.2f} mm", "0 mm"),
                ("Spread of neutral faces between people, the same measure", f"{np.mean(between):.2f} mm", "large"),
                ("Spread of one expression at its strongest put on the mean (a = 0)", f"{np.mean(spread_e):.2f} mm",
                 "as much as people make it differently"),
            ],
            "Spread is the standard deviation of each vertex, averaged over the surface.",
        )  # fmt: skip

    # Others

    def strangers(self) -> dict[str, float]:
        """Classify faces of the bundled generator by what was learned on ICT-FaceKit; return how well."""
        study, config = self.study, self.study.config
        shown = stranger_shown(config)
        model = study.models[0]
        paths = [stranger_path(study.folder, person) for person in range(config.strangers)]
        fits = read_fits(paths, study.fits.z.shape[2])
        z = fits.z[0][:, : model.shape.n_modes]
        labels = np.array([name for name, _ in shown])[fits.shown]
        level = np.array([level for _, level in shown])[fits.shown]
        subject = np.array([f"stranger_{int(person):03d}" for person in fits.person])
        training = study.training(0)
        four = training.where(np.isin(training.expression, ("neutral", *PAPER_EXPRESSIONS)))
        kept = level > 0
        new = Rows(z, fits.z_stddev[0][:, : model.shape.n_modes], labels, fits.shown, subject)
        known = approaches.beside_neutral(model, new, _neutral_of(z, subject, level == 0, subject))
        at_rest = _neutral_of(four.z, four.subject, four.shown == 0, four.subject)
        learned = approaches.beside_neutral(model, four, at_rest)
        taught = (four.shown != 0) & np.isfinite(learned).all(axis=1)
        X, names, by = learned[taught], four.expression[taught], four.subject[taught]
        as_it_stands = known[kept]
        usable = np.isfinite(as_it_stands).all(axis=1)
        centre, spread = as_it_stands[usable].mean(axis=0), as_it_stands[usable].std(axis=0)
        adapted = (as_it_stands - centre) / spread * X.std(axis=0) + X.mean(axis=0)
        shown_by_new = new.where(kept)
        about_mean = np.full(as_it_stands.shape, np.nan)
        about_mean[shown_by_new.usable] = approaches.about_own_mean(model, shown_by_new.where(shown_by_new.usable))
        own_mean = approaches.about_own_mean(model, four.where(taught))
        rows: list[tuple[object, ...]] = []
        answers: dict[str, TextArray] = {}
        reached: dict[str, float] = {}
        for how, training_codes, codes in (
            ("as it stands", X, as_it_stands), ("about each person's own mean", own_mean, about_mean),
            ("adapted", X, adapted),
        ):  # fmt: skip
            fold = evaluate.Fold(
                training_codes, names.tolist(), by.tolist(), codes, labels[kept].tolist(), subject[kept].tolist()
            )
            nested = evaluate.nested_predictions([fold], modes=(10, None), inner_folds=parts.inner_folds([fold]))
            answers[how] = np.asarray(nested.predicted)
            reached[how], interval = parts.accuracy_of(labels[kept], answers[how], subject[kept])
            chosen = f"chosen inside the training people ({nested.chosen[0].classifier})"
            rows.append((how, chosen, reached[how], interval))
            for classifier in ("lda", "mean-direction", "logistic"):
                fixed = parts.fixed([fold], classifier)
                if fixed is not None:
                    rows.append((how, classifier, *parts.accuracy_of(labels[kept], fixed.predicted, subject[kept])))
        doubtful = int((fits.status[0] == STATUSES.index("doubtful")).sum())
        self.targets += [
            target(f"ICT-trained system on faces of another generator and topology, four expressions, {how}",
                   f"at least {words(_STRANGERS_LEAST)}", words(reached[how]), met=reached[how] >= _STRANGERS_LEAST,
                   note=note)
            for how, note in (
                ("as it stands", "each scan relative to the person's neutral scan"),
                ("about each person's own mean", "relative to the mean of the person's scans, without their labels"),
                ("adapted", "as it stands, then centred and scaled over all new scans, without their labels"),
            )
        ]  # fmt: skip
        self.parts += [
            parts.table(
                "Trained on ICT-FaceKit, tested on the bundled generator",
                [("Coefficients", "text"), ("Classifier", "text"), ("Macro accuracy", "percent"),
                 ("95 % over people", "interval")],
                rows,
                f"{config.strangers} people of another generator, with triangles and expressions of its own. "
                "As it stands, expression is solved for beside each person's neutral scan. About their own mean, it is "
                "relative to all scans of the person, which takes no label, but a balanced set. Adapted: every "
                "coefficient is centred and scaled over the new scans as it was over the training ones. "
                f"{doubtful} of {len(z)} fits are called doubtful, since no such face was in the model.",
            ),
            *(
                parts.confusion(f"Another generator, {how}", labels[kept].tolist(), answers[how].tolist(),
                                PAPER_EXPRESSIONS, "The classifier chosen inside the training people.")
                for how in answers
            ),
        ]  # fmt: skip
        return reached

    def transfer(self) -> None:
        """Put expressions of one person on another, from fits alone."""
        study = self.study
        model = study.models[0]
        faces = study.rows(0, study.fold == 0)
        level = study.level[study.fold == 0]
        usable = faces.usable
        names = np.unique(faces.subject[usable])[:3]
        folder = make_folder(study.folder / "transfer")
        rows: list[dict[str, Any]] = []
        source = str(names[0])
        for expression in ("smile", "surprise"):
            meshes: list[dict[str, str]] = []
            taken = (faces.subject == source) & (faces.expression == expression) & (level == level.max()) & usable
            if not taken.any():
                continue
            for name in names:
                own = (faces.subject == name) & (faces.expression == "neutral") & usable
                if not own.any():
                    continue
                path = folder / f"{expression}_on_{name}.ply"
                write_mesh(path, model.transfer(faces.z[own][0], faces.z[taken][0]))
                meshes.append({"label": f"{name}", "file": f"transfer/{path.name}"})
            rows.append({"label": f"{expression} of {source}", "meshes": meshes})
        self.parts.append(
            {"kind": "meshes", "title": "One person's expression put on others", "rows": rows,
             "note": "From fits of raw scans: identity of one, expression of another."}
        )  # fmt: skip

    # Shared

    def _additive_folds(self, how: str) -> list[evaluate.Fold]:
        """Return the additive model's expressions: of one scan, beside the neutral scan, or of all a person's scans."""
        readers: dict[str, Callable[[int], Features]] = {
            "unknown": lambda f: self.features["additive"][f],
            "known": lambda f: lambda rows: rows.e_beside,
            "together": lambda f: lambda rows: rows.e_together,
            "mean": lambda f: lambda rows: approaches.about_own_mean(self.study.models[f], rows),
        }
        return [self._learned_fold(readers[how](f), f, relative=False) for f in range(self.study.config.folds)]

    def _learned_fold(self, features: Features, fold: int, *, relative: bool) -> evaluate.Fold:
        study = self.study
        training, tested = study.training(fold), study.tested(fold)
        faces = study.rows(fold, tested)
        usable = faces.usable
        found = features(faces.where(usable))
        known = np.full((len(usable), found.shape[1]), np.nan)
        known[usable] = found
        if relative:
            neutral = study.rows(fold, (study.fold == fold) & (study.fits.shown == 0))
            neutral = neutral.where(neutral.usable)
            at_rest = _neutral_of(features(neutral), neutral.subject, neutral.shown == 0, faces.subject)
            known = known - at_rest
            learned = features(training)
            learned = learned - _neutral_of(learned, training.subject, training.shown == 0, training.subject)
            learned, taught = learned[training.shown != 0], training.expressive
        else:
            taught = training.expressive
            learned = features(taught)
        kept = np.isfinite(learned).all(axis=1)
        return evaluate.Fold(
            learned[kept], taught.expression[kept].tolist(), taught.subject[kept].tolist(),
            known, faces.expression.tolist(), faces.subject.tolist(), self.index[tested],
        )  # fmt: skip

    def _fold(self, learned: FloatArray, known: FloatArray, fold: int, *, taught: bool) -> evaluate.Fold:
        study = self.study
        tested = study.tested(fold)
        training = (study.fold != fold) & (study.level > 0) & ((study.place >= 0) | (not taught))
        return evaluate.Fold(
            learned[training], study.expression[training].tolist(), study.subject[training].tolist(),
            known[tested], study.expression[tested].tolist(), study.subject[tested].tolist(), self.index[tested],
        )  # fmt: skip

    def _row(self, name: str, predicted: Sequence[str], neutral: str) -> tuple[object, ...]:
        every, interval = parts.accuracy_of(self.labels, predicted, self.subjects)
        high, _ = parts.accuracy_of(self.labels, predicted, self.subjects, self.high)
        low, _ = parts.accuracy_of(self.labels, predicted, self.subjects, self.level == self.level.min())
        return name, neutral, high, every, interval, low

    def _accuracy_of(self, code: Callable[[int, Rows], FloatArray]) -> float:
        folds = [
            self._learned_fold(lambda rows, f=f: code(f, rows), f, relative=False)
            for f in range(self.study.config.folds)
        ]
        return parts.accuracy_of(self.labels, evaluate.fixed_predictions(folds, "lda").predicted, self.subjects)[0]


def _same_rows(folds: Sequence[evaluate.Fold]) -> list[evaluate.Fold]:
    """Return folds in which everybody has as many rows to be tested as to be taught from, as a shuffle needs."""
    taught: dict[str, int] = {}
    for fold in folds:
        for name in set(fold.train_subjects):
            count = list(fold.train_subjects).count(name)
            taught[name] = min(taught.get(name, count), count)
    out: list[evaluate.Fold] = []
    for fold in folds:
        train, test = (_first_rows(part, taught) for part in (fold.train_subjects, fold.test_subjects))
        out.append(
            evaluate.Fold(
                fold.train[train], [fold.train_labels[i] for i in train], [fold.train_subjects[i] for i in train],
                fold.test[test], [fold.test_labels[i] for i in test], [fold.test_subjects[i] for i in test],
            )
        )  # fmt: skip
    return out


def _first_rows(subjects: Sequence[str], counts: Mapping[str, int]) -> list[int]:
    seen: dict[str, int] = {}
    kept: list[int] = []
    for row, name in enumerate(subjects):
        seen[name] = seen.get(name, 0) + 1
        if seen[name] <= counts[name]:
            kept.append(row)
    return kept


def _neutral_of(codes: FloatArray, subjects: TextArray, neutral: BoolArray, wanted: TextArray) -> FloatArray:
    """Return (n, K) the neutral code of each `wanted` person; NaN where there is none."""
    at_rest = dict(zip(subjects[neutral].tolist(), codes[neutral], strict=True))
    none = np.full(codes.shape[1], np.nan)
    return np.stack([at_rest.get(str(name), none) for name in wanted])


def _unit(codes: FloatArray) -> FloatArray:
    return codes / np.linalg.norm(codes, axis=1, keepdims=True)


def _spread_mm(model: AdditiveModel, codes: FloatArray, *, identity: bool) -> float:
    """Return the mean over the vertices of the standard deviation of surfaces with these codes alone, mm."""
    none = np.zeros(0)
    surfaces = np.stack([(model.mesh(code, none) if identity else model.mesh(none, code)).vertices for code in codes])
    return float(np.sqrt(surfaces.var(axis=0).sum(axis=1)).mean())


def _basis_of_codes(model: AdditiveModel) -> FloatArray:
    """Return (V, 3, K) what one standard deviation of each of [a; e] does to each vertex, mm."""
    flat: FloatArray = model.shape.vertex_basis @ model.shape.to_b(model.rotation).T
    return flat.reshape(model.shape.n_vertices, 3, model.shape.n_modes)


def _regions(study: Study) -> dict[str, IntArray]:
    """Return parts of the face about the landmarks of the model: each vertex belongs to the nearest named part."""
    model = study.models[0].shape
    groups: dict[str, list[int]] = {}
    for name, vertex in model.landmarks.items():
        part = {"leyebrow": "brows", "reyebrow": "brows", "leye": "eyes", "reye": "eyes"}.get(
            name.rpartition("_")[0], name.rpartition("_")[0]
        )
        groups.setdefault("jaw" if part == "chin" else part, []).append(vertex)
    vertices = model.mean_vertices
    names = list(groups)
    distance = np.stack(
        [np.min(np.linalg.norm(vertices[:, None] - vertices[groups[name]], axis=2), axis=1) for name in names]
    )
    nearest, near = distance.argmin(axis=0), distance.min(axis=0) < 25.0
    found = {name: np.flatnonzero((nearest == k) & near).astype(np.int32) for k, name in enumerate(names)}
    return found | {"elsewhere": np.flatnonzero(~near).astype(np.int32)}


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
