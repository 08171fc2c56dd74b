"""Training of a classifier on labelled fits, and prediction for other fits, one row per scan."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult
from shapespace.geometry.procrustes import Gauge
from shapespace.io.interop import MeshLike, as_mesh, as_meshes
from shapespace.io.tables.table_io import write_rows
from shapespace.model.pca import Modes
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise.classifier_file import SavedClassifier, software_versions
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.labelled_scans import NEUTRAL, ScanCoefficients, from_record, one_model, relative_to_neutral
from shapespace.recognise.learn import BaseEstimator, TransformerMixin, check_is_fitted
from shapespace.recognise.predictions import (
    cross_validated_probabilities,
    fit_temperature,
    macro_accuracy,
    subject_folds,
)
from shapespace.reprs import short_repr
from shapespace.schemas import FIT_AGAIN, FitRecord, read
from shapespace.types import FloatArray, IntArray, Mesh, require

Surface: TypeAlias = MeshLike | FitResult | FitRecord | Mapping[str, Any]
"""A mesh or input of `as_mesh`, the result of a fit, or its record, typed or as the content of NAME.fit.json."""
Surfaces: TypeAlias = Sequence[Surface] | FloatArray | str | PathLike[str]
"""Several surfaces; (n, V, 3) vertices; or the folder of meshes in correspondence."""
_COUNT = re.compile(r"\d+ (of \d+ )?(vertex is|vertices are) (missing|removed)")  # sentences on missing vertices


class ShapeSpace(TransformerMixin, BaseEstimator):
    """Transformer of meshes or fits to coefficients in standard deviations, z, for scikit-learn pipelines.

    `fit` builds a `ShapeModel` from meshes in correspondence, or uses `model` as it is. `transform` takes a mix of:

    - meshes in the model's vertex order, which are projected (`meshes="corresponding"`), or raw scans, which are fitted
      by `fit_scan` (`meshes="scans"`); a mesh alone does not show which kind it is;
    - `FitResult`s and records of fits (as read from NAME.fit.json), of the same model, whose z is used.

    A record of a failed fit, or a scan that cannot be fitted, becomes a row of NaN; it is not dropped, and a warning
    states the reason. A doubtful fit keeps its coefficients here: see `status` of the fit.

    Args:
        modes: number of modes, as in `BuildConfig`: a number, a share of the variance, "auto" or "all". Notes of the
            model, such as that the meshes determine fewer modes, become warnings.
        n_components: number of modes by the name that scikit-learn uses; None for `modes`. Only one may be given.
        gauge: size handling, `form` or `shape`.
        align: whether to align the meshes, also in `transform`; False uses them unchanged.
        alignment_vertices: indices of the vertices by which the training meshes are aligned.
        model: model, or its file, to use instead of building one; the settings above, except `align`, then have no
            effect.
        meshes: kind of the meshes in `transform`: "corresponding" or "scans".
        config: settings of the fits of scans; None for the defaults.
        seed: seed of the choice of modes.

    Attributes:
        model_: the `ShapeModel`.
        model_hash_: content hash of the model.
        n_features_out_: K, the number of modes.
    """

    def __init__(
        self,
        modes: Modes = "all",
        *,
        n_components: Modes = None,
        gauge: Gauge = "shape",
        align: bool = True,
        alignment_vertices: IntArray | None = None,
        model: ShapeModel | str | PathLike[str] | None = None,
        meshes: Literal["corresponding", "scans"] = "corresponding",
        config: FitConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.modes: Modes = modes
        self.n_components: Modes = n_components
        self.gauge: Gauge = gauge
        self.align = align
        self.alignment_vertices = alignment_vertices
        self.model = model
        self.meshes = meshes
        self.config = config
        self.seed = seed

    def __sklearn_clone__(self) -> ShapeSpace:
        # A model is never changed, and its read-only parts cannot be copied deeply.
        return ShapeSpace(**cast(dict[str, Any], self.get_params(deep=False)))

    def fit(self, X: Surfaces, y: Any = None) -> ShapeSpace:
        """Build the shape space of meshes in correspondence, mm, or use the given `model` and ignore `X`.

        Raises:
            CorrespondenceError: the meshes differ in vertices or triangles.
            InputError: something else than meshes, too few meshes, no variation, unknown settings.
        """
        if self.n_components is not None and self.modes not in (None, "all", self.n_components):
            raise InputError(
                f"modes is {self.modes!r} and n_components {self.n_components!r}, but both are the number of modes; "
                "give only one."
            )
        if self.meshes not in ("corresponding", "scans"):
            raise InputError(f"There is no kind of meshes {self.meshes!r}; choose corresponding or scans.")
        if isinstance(self.model, str | PathLike):
            self.model_ = ShapeModel.load(Path(self.model))
        else:
            self.model_ = self.model if self.model is not None else self._build(X)
        self.model_hash_ = self.model_.content_hash
        self.n_features_out_ = self.model_.n_modes
        return self

    def _build(self, X: Surfaces) -> ShapeModel:
        surfaces = _items(X)
        if any(isinstance(item, FitResult | FitRecord | Mapping) for item in surfaces):
            raise InputError("A shape space is built from meshes in correspondence; give those, or a ready model.")
        model = ShapeModel.fit(
            surfaces,
            modes=self.modes if self.n_components is None else self.n_components,
            gauge=self.gauge,
            align=self.align,
            alignment_vertices=self.alignment_vertices,
            seed=self.seed,
        )
        # Counts of missing vertices are no warnings: each fold of a cross-validation would repeat them.
        for note in [note for note in model.notes if not _COUNT.match(note)]:
            warnings.warn(note, stacklevel=3)
        return model

    def transform(self, X: Surfaces) -> FloatArray:
        """Return coefficients z (n, K) in standard deviations of the model; rows of failed fits are NaN.

        Raises:
            CorrespondenceError: a mesh that is not in the model's vertex order, if meshes are not scans.
            InputError: a fit of another model, or something that is neither mesh nor fit.
            FileFormatError: a record that is damaged.
        """
        check_is_fitted(self)
        rows = [self._coefficients(surface, number) for number, surface in enumerate(_items(X), 1)]
        return np.stack(rows) if rows else np.zeros((0, self.n_features_out_))

    def _coefficients(self, surface: Surface, number: int) -> FloatArray:
        model = self.model_
        if isinstance(surface, FitResult):
            self._check_model_hash(surface.model_hash, surface.scan_name)
            return self._coefficients_of_fit(surface)
        name = f"number {number}"
        if not isinstance(surface, FitRecord | Mapping):
            if self.meshes == "scans":
                return self._coefficients_of_scan(surface, number)
            return model.to_z(model.project(as_mesh(surface, name), align=self.align))
        record = (
            surface
            if isinstance(surface, FitRecord)
            else read(FitRecord, cast(Mapping[str, Any], surface), f"The record of {name}", FIT_AGAIN)
        )
        scan = from_record(name, record)
        self._check_model_hash(scan.model_hash, scan.file)
        if scan.z is None:
            return np.full(model.n_modes, np.nan)
        if scan.z.shape != (model.n_modes,):
            raise InputError(f"The record of {scan.file} has {len(scan.z)} coefficients, not {model.n_modes}.")
        return scan.z

    def _coefficients_of_scan(self, scan: MeshLike, number: int) -> FloatArray:
        try:
            return self._coefficients_of_fit(
                fit_scan(self.model_, as_mesh(scan, f"number {number}"), self.config or FitConfig())
            )
        except ShapespaceError as error:
            warnings.warn(f"Number {number} has no coefficients: {error}", stacklevel=4)
            return np.full(self.model_.n_modes, np.nan)

    def _coefficients_of_fit(self, result: FitResult) -> FloatArray:
        return np.full(self.model_.n_modes, np.nan) if result.status == "failed" else result.z

    def _check_model_hash(self, model_hash: str, name: str) -> None:
        if model_hash != self.model_hash_:
            raise InputError(
                f"{name} was fitted with the model {model_hash[:12]}, and this shape space is {self.model_hash_[:12]}; "
                "fit the scan with this model."
            )

    def inverse_transform(self, X: Any) -> list[Mesh]:
        """Return the shapes with coefficients `X` (n, k), in standard deviations, as meshes in the model's frame, mm.

        Raises:
            InputError: more coefficients than modes, or values that are not finite.
        """
        check_is_fitted(self)
        z = np.asarray(X, dtype=np.float64)
        if z.ndim != 2 or z.shape[1] > self.n_features_out_:
            raise InputError(f"Coefficients must be (n, k) with k at most {self.n_features_out_}, not {z.shape}.")
        return [self.model_.mesh(self.model_.to_b(row)) for row in z]

    def get_feature_names_out(self, input_features: Any = None) -> Any:
        """Return the names z1 to zK, (K,)."""
        check_is_fitted(self)
        return np.asarray([f"z{k}" for k in range(1, self.n_features_out_ + 1)], dtype=object)


def _items(X: Surfaces) -> Sequence[Any]:
    return as_meshes(X, "ShapeSpace") if isinstance(X, str | PathLike) else cast(Sequence[Any], X)


UNSURE = "unsure"
"""Answer if the likeliest class is less likely than the stated confidence, or if the fit is doubtful."""

CONFIDENCE = 0.5
"""Default confidence: below it the likeliest class is more likely wrong than right."""

_FOLDS = 5  # number of folds by subject for the calibration


@dataclass(frozen=True, eq=False)
class ScanPrediction:
    """Predicted class of one scan, with probabilities and status.

    Args:
        scan: name of the fit.
        status: status of the fit.
        prediction: class, `UNSURE`, or empty if the fit failed or the reference face is missing.
        probabilities: (C,) probabilities of the classes; None if they cannot be computed.
        reason: reason why there is no class; empty if there is one.
        neutral: whether it is a neutral face with which others are compared, and which needs no answer.

    Example:
        >>> from shapespace.recognise.predict import predict_scans
        >>> saved, notes = ss.train_classifier(scans)
        >>> predict_scans(saved, scans[:1])[0].status
        'converged'
    """

    scan: str
    status: str
    prediction: str
    probabilities: FloatArray | None
    reason: str
    neutral: bool = False

    __repr__ = short_repr


def train_classifier(
    scans: Sequence[ScanCoefficients],
    *,
    classifier: str = "lda",
    relative: bool = False,
    neutral: str = NEUTRAL,
    confidence: float = CONFIDENCE,
    modes: int | None = None,
    projection: FloatArray | None = None,
    seed: int = 0,
) -> tuple[SavedClassifier, list[str]]:
    """Train a classifier on fitted scans with labels; return it with notes for the user.

    Failed and doubtful fits and scans without a label are excluded and counted. Probabilities are calibrated on
    held-out people (on held-out scans if no people are named), which also gives the accuracy that is reported.

    Args:
        scans: scans with labels, and for `relative` with subjects.
        classifier: a name of `CLASSIFIERS`.
        relative: whether to use coefficients relative to the subject's neutral face; neutral faces are then no class.
        neutral: label of neutral faces.
        confidence: probability, 0 to 1, below which the answer will be `UNSURE`.
        modes: number of leading coefficients to use; None for all.
        projection: (Ke, K) matrix from coefficients to those of expression, to use only these: the last rows of
            `AdditiveModel.rotation`.
        seed: seed of folds and classifier.

    Raises:
        InputError: an unknown classifier, fits of different models, too few labels, people without a neutral face,
            or too many modes.

    Example:
        >>> saved, notes = ss.train_classifier(scans, modes=3)
        >>> saved.classes
        ('smile', 'surprise')
    """
    if classifier not in CLASSIFIERS:
        raise InputError(f"There is no classifier {classifier!r}; choose among {', '.join(CLASSIFIERS)}.")
    if not 0 <= confidence <= 1:
        raise InputError(f"The confidence must lie from 0 to 1, not {confidence!r}.")
    for scan in scans:
        require(
            scan,
            ScanCoefficients,
            "train_classifier",
            "read them with shapespace.recognise.labelled_scans.read_coefficients",
        )
    model_hash = one_model(scans)
    used, left_out_counts, notes = _select_labelled(scans)
    z, labels, subjects = _samples(used, neutral if relative else None, projection)
    K = _modes(z.shape[1], modes)
    z = z[:, :K]
    classes, counts = _classes(labels)
    pipeline: Any = CLASSIFIERS[classifier](seed)
    with threadpool_limits(1):
        pipeline.fit(z, labels)
        temperature, checked, note = _calibrate(z, labels, subjects, classes, classifier, seed)
    if note:
        notes.append(note)
    training: dict[str, Any] = {
        "scans": len(labels),
        "subjects": len(set(subjects)) if all(subjects) else None,
        "per_class": dict(zip(classes, counts, strict=True)),
        "left_out": left_out_counts,
    }
    saved = SavedClassifier(
        pipeline=pipeline,
        classifier=classifier,
        model_hash=model_hash,
        modes=K,
        relative_to_neutral=relative,
        neutral=neutral,
        classes=tuple(classes),
        confidence=float(confidence),
        temperature=temperature,
        training=training,
        cross_validation=checked,
        versions=software_versions(),
        projection=projection,
    )
    return saved, notes


def _select_labelled(scans: Sequence[ScanCoefficients]) -> tuple[list[ScanCoefficients], dict[str, int], list[str]]:
    """Return the training scans, the number of excluded scans by reason, and the same as sentences."""
    labelled = [scan for scan in scans if scan.label]
    used = [scan for scan in labelled if scan.trusted]
    untrusted = Counter(scan.status for scan in labelled if not scan.trusted)
    without_label = len(scans) - len(labelled)
    if not used:
        raise InputError(
            f"None of the {len(scans)} scans has both a label and a fit to be trusted; check that the table of labels "
            "names the scans."
        )
    notes = [f"{count} {status} of the fits with a label excluded." for status, count in sorted(untrusted.items())]
    if without_label:
        notes.append(f"{without_label} of {len(scans)} scans have no label and are excluded.")
    return used, {**dict(untrusted), "without_label": without_label}, notes


def _samples(
    scans: Sequence[ScanCoefficients], neutral: str | None, projection: FloatArray | None
) -> tuple[FloatArray, Any, list[str]]:
    """Return features (n, k), labels (n,) and subjects; with `neutral`, relative to the faces that it labels."""
    z = _stack_coefficients(scans)
    if projection is not None:
        if projection.shape[1:] != z.shape[1:]:
            raise InputError(
                f"The fits have {z.shape[1]} coefficients, this model {projection.shape[1]}; fit with all modes."
            )
        z = z @ projection.T
    labels = np.asarray([scan.label for scan in scans])
    subjects = [scan.subject for scan in scans]
    if neutral is None:
        return z, labels, subjects
    if not all(subjects):
        raise InputError(
            "Coefficients relative to neutral need the subject of each scan; add a column subject to the labels."
        )
    expressive = labels != neutral
    z = relative_to_neutral(z, subjects, ~expressive)[expressive]
    return (
        z,
        labels[expressive],
        [name for name, is_expressive in zip(subjects, expressive, strict=True) if is_expressive],
    )


def _classes(labels: Any) -> tuple[list[str], list[int]]:
    """Return the classes and their sample counts; raise an error if they cannot be learned."""
    classes, counts = np.unique(labels, return_counts=True)
    if len(classes) < 2 or counts.min() < 2:
        counts_text = ", ".join(f"{name} ({n})" for name, n in zip(classes, counts, strict=True)) or "none"
        raise InputError(
            f"Training needs at least two classes with at least two scans each; these were found: {counts_text}."
        )
    if UNSURE in classes:
        raise InputError(f"The label {UNSURE!r} is the answer below the confidence; give it another name.")
    return classes.tolist(), counts.tolist()


def _calibrate(
    z: FloatArray, labels: Any, subjects: Sequence[str], classes: Sequence[str], classifier: str, seed: int
) -> tuple[float, dict[str, Any], str]:
    """Return the temperature, the cross-validation result, and a note for the user."""
    by_subject = all(subjects)
    groups = list(subjects) if by_subject else [str(i) for i in range(len(z))]
    folds = min(_FOLDS, len(set(groups)))
    splits = subject_folds(groups, folds, seed) if folds >= 2 else []
    # A fold with a single training class cannot be used.
    if not splits or any(len(np.unique(labels[train])) < 2 for train, _ in splits):
        note = "There are too few subjects for cross-validation: accuracy is unknown, probabilities are not calibrated."
        return 1.0, {"macro_accuracy": None, "by": None, "folds": 0}, note
    probabilities = cross_validated_probabilities(
        X=z, labels=labels, folds=splits, classes=classes, classifier=classifier, parameters={}, seed=seed
    )
    temperature = fit_temperature(labels.tolist(), probabilities, classes)
    answers = np.asarray(classes)[probabilities.argmax(axis=1)]
    accuracy = macro_accuracy(labels, answers, classes)
    note = (
        "" if by_subject else "The labels name no subjects, so a subject may be on both sides of the cross-validation."
    )
    return temperature, {"macro_accuracy": accuracy, "by": "subject" if by_subject else "scan", "folds": folds}, note


def predict_scans(saved: SavedClassifier, scans: Sequence[ScanCoefficients]) -> list[ScanPrediction]:
    """Return one prediction per scan, in the order of `scans`.

    A failed fit gets no prediction. A doubtful fit gets `UNSURE`, and so does a fit whose most probable class has a
    probability below the confidence of the classifier. In these cases the prediction has a reason.

    Raises:
        InputError: the fits are not of the classifier's model, or have fewer modes than it uses.
    """
    saved.refuse_other_model(one_model(scans))
    zero = _neutral_of(saved, scans) if saved.relative_to_neutral else {}
    answers: list[ScanPrediction] = []
    for scan in scans:
        is_reference = saved.relative_to_neutral and scan.label == saved.neutral
        refusal = _reason_without_prediction(saved, scan, zero, is_reference)
        if refusal is not None or scan.z is None:
            doubtful = scan.status == "doubtful" and not is_reference
            answers.append(
                ScanPrediction(
                    scan.name, scan.status, UNSURE if doubtful else "", None, refusal or scan.reason, is_reference
                )
            )
            continue
        z = scan.z - zero[scan.subject] if saved.relative_to_neutral else scan.z
        p = saved.probabilities(z[None])[0]
        best = int(p.argmax())
        is_certain = bool(p[best] >= saved.confidence)
        name = saved.classes[best]
        reason = f"The likeliest class, {name}, has the probability {p[best]:.2f}, below {saved.confidence:g}."
        answers.append(
            ScanPrediction(scan.name, scan.status, name if is_certain else UNSURE, p, "" if is_certain else reason)
        )
    return answers


def _neutral_of(saved: SavedClassifier, scans: Sequence[ScanCoefficients]) -> dict[str, FloatArray]:
    neutrals: dict[str, list[FloatArray]] = {}
    for scan in scans:
        if scan.label == saved.neutral and scan.subject and scan.trusted and scan.z is not None:
            neutrals.setdefault(scan.subject, []).append(scan.z)
    return {name: np.mean(z, axis=0) for name, z in neutrals.items()}


def _reason_without_prediction(
    saved: SavedClassifier, scan: ScanCoefficients, zero: dict[str, FloatArray], is_reference: bool
) -> str | None:
    """Return the reason why `scan` has no probabilities; None if it has."""
    if scan.z is None:
        return scan.reason
    if not scan.trusted:
        return f"The fit is doubtful: {scan.reason}"
    if is_reference:
        return "The neutral face that its subject's other scans are compared with."
    if saved.relative_to_neutral and not scan.subject:
        return (
            "The classifier compares with the subject's neutral face, and the labels do not name this scan's subject."
        )
    if saved.relative_to_neutral and scan.subject not in zero:
        return f"There is no usable neutral face of {scan.subject} to compare this scan with."
    return None


def write_answers(path: Path, answers: Sequence[ScanPrediction], classes: Sequence[str]) -> None:
    """Write a CSV table: scan, status, prediction, p_CLASS for each class, reason.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    header = ("scan", "status", "prediction", *(f"p_{name}" for name in classes), "reason")
    rows = [
        (
            prediction.scan,
            prediction.status,
            prediction.prediction,
            *(
                ["" for _ in classes]
                if prediction.probabilities is None
                else [f"{p:.6f}" for p in prediction.probabilities]
            ),
            prediction.reason,
        )
        for prediction in answers
    ]
    write_rows(path, header, rows)


def _stack_coefficients(scans: Sequence[ScanCoefficients]) -> FloatArray:
    rows = [scan.z for scan in scans if scan.z is not None]
    if len({len(z) for z in rows}) != 1:
        raise InputError("The fits have different numbers of coefficients; fit all scans with one model.")
    return np.stack(rows)


def _modes(available: int, modes: int | None) -> int:
    if modes is None:
        return available
    if not 1 <= modes <= available:
        raise InputError(f"There are {available} coefficients, so a classifier cannot use {modes}.")
    return modes
