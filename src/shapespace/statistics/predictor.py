"""A linear predictor of a number from shape, with intervals by cross-validation, and its file.

Intervals are those of CV+ (Barber, Candes, Ramdas and Tibshirani, Annals of Statistics 49(1), 2021) with folds of
subjects, each of whom counts once however often it was scanned.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import list_names
from shapespace.errors import CorrespondenceError, FileFormatError, InputError
from shapespace.geometry.procrustes import Gauge
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.containers.archives import read_arrays, write_arrays
from shapespace.io.containers.json_files import plain_json
from shapespace.lazy import lazy_import
from shapespace.reprs import describe_briefly, short_repr
from shapespace.statistics.linear_regressors import IndexArray
from shapespace.statistics.multiple_imputation import Imputations, pool_intervals
from shapespace.types import FloatArray, read_only

FORMAT, VERSION = "shapespace predictor", 1
_ROUNDING = 1e-9  # relative slack, so that training shapes never count as outside their own range
_REMAKE = "make it again with shapespace regress"
_FLOATS = ("mean", "weights", "intercepts", "residuals", "share")
_FACTS = ("target", "gauge", "model_hash", "lowest", "highest", "farthest_mm", "subjects", "confidence", "method")


@dataclass(frozen=True, eq=False)
class Predictions:
    """Predicted values of n shapes.

    Args:
        names: names of the shapes.
        value: (n,) predicted values.
        low, high: (n,) ends of the intervals.
        outside: n sentences that describe how a shape lies outside the training data; empty if it does not.
        imputations: imputations that predictions combine; None without samples of completed shapes.

    Example:
        >>> predictor = ss.statistics.regress(cohort, "age", subject="subject").predictor
        >>> predictions = predictor.predict(cohort)
        >>> bool((predictions.low <= predictions.value).all())
        True
    """

    names: tuple[str, ...]
    value: FloatArray
    low: FloatArray
    high: FloatArray
    outside: tuple[str, ...]
    imputations: Imputations | None = None

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        return lazy_import("html_of_predictions")(self)


@dataclass(frozen=True, eq=False, kw_only=True)
class Predictor:
    """A number as a linear function of the positions of the vertices.

    Args:
        target: name of the predicted number.
        gauge: gauge of the shapes.
        model_hash: hash of the model whose fits it takes; empty for other surfaces, which it aligns itself.
        mean: (V, 3) mean of the training shapes, mm.
        weights: (1 + F, 3V) weights per mm: first of all training shapes, then without each fold.
        intercepts: (1 + F,) predictions for the mean.
        residuals: (N,) absolute residuals of the training rows, each predicted without its fold.
        fold: (N,) fold of each training row, from 1.
        share: (N,) weight of each training row: 1 over the number of rows of its subject.
        lowest, highest: ends of the range of the training targets.
        farthest_mm: largest RMS distance of a training shape from the mean.
        subjects: number of training subjects.
        confidence: level of the intervals.
        method: method of the regression, in words.

    Example:
        >>> predictor = ss.statistics.regress(cohort, "age", subject="subject").predictor
        >>> predictor.target
        'age'
    """

    target: str
    gauge: Gauge
    model_hash: str
    mean: FloatArray
    weights: FloatArray
    intercepts: FloatArray
    residuals: FloatArray
    fold: IndexArray
    share: FloatArray
    lowest: float
    highest: float
    farthest_mm: float
    subjects: int
    confidence: float
    method: str

    def __repr__(self) -> str:
        return (
            f"<Predictor of {describe_briefly(self.target)} from {self.subjects} subjects; {self.method}; targets from "
            f"{self.lowest:.4g} to {self.highest:.4g}>"
        )

    def _repr_html_(self) -> str:
        return lazy_import("html_of_predictor")(self)

    def predict(self, cohort: Cohort) -> Predictions:
        """Predict the number from the shapes of a cohort whose subjects are not in the training data.

        Predictions of completed shapes with samples combine the imputations by Rubin's rules.

        Raises:
            CorrespondenceError: shapes with other vertices, or fits by another model.
            InputError: another gauge.
        """
        self._check(cohort)
        result = self._predict(cohort)
        if cohort.imputations < 2:
            return result
        each = [self._predict(cohort.imputation(k)) for k in range(cohort.imputations)]
        figures = np.stack([np.column_stack([own.value, own.low, own.high]) for own in each])
        value, low, high = map(read_only, pool_intervals(figures, self.confidence).T)
        return replace(result, value=value, low=low, high=high, imputations=Imputations(len(each), {}, {}))

    def _predict(self, cohort: Cohort) -> Predictions:
        off = np.stack([self._align(cohort.vertices(k)) for k in range(len(cohort))]) - self.mean
        all_ways = off.reshape(len(off), -1) @ self.weights.T + self.intercepts
        low, high = cv_plus(all_ways[:, 1:], self.residuals, self.fold - 1, self.share, self.confidence)
        away = np.sqrt((off**2).sum(axis=2).mean(axis=1))
        outside = tuple(
            self._describe_outside(float(value), float(length), cohort.unit)
            for value, length in zip(all_ways[:, 0], away, strict=True)
        )
        return Predictions(cohort.names, read_only(all_ways[:, 0]), low, high, outside)

    def _check(self, cohort: Cohort) -> None:
        if cohort.n_vertices != len(self.mean):
            raise CorrespondenceError(
                f"The shapes have {cohort.n_vertices} vertices, and those that {self.target} was learned from "
                f"{len(self.mean)}; give shapes in correspondence with the training shapes."
            )
        own = model_hash_of(cohort)
        if own != self.model_hash:
            raise CorrespondenceError(
                f"{self.target} was learned from {'fits by one model' if self.model_hash else 'surfaces'}, but the new "
                f"shapes are {'surfaces' if not own else 'fits by another model' if self.model_hash else 'fits'}; "
                "give shapes like the training shapes."
            )
        if cohort.gauge != self.gauge:
            raise InputError(f"{self.target} was learned in the gauge {self.gauge}, not {cohort.gauge}; read the new "
                             f"shapes with --set gauge={self.gauge}.")  # fmt: skip

    def _align(self, vertices: FloatArray) -> FloatArray:
        """Return a shape (V, 3) in the pose of the training shapes, and in the gauge `shape` also in their scale."""
        if self.model_hash:
            return vertices
        placed = fit_similarity(vertices, self.mean, with_scale=False).apply(vertices)
        if self.gauge == "shape":
            centre = self.mean.mean(axis=0)
            own, other = placed - centre, self.mean - centre
            placed = centre + own * float((other**2).sum() / (own * other).sum())
        return placed

    def _describe_outside(self, value: float, away: float, unit: str) -> str:
        if away > self.farthest_mm * (1 + _ROUNDING):
            own, farthest = (f"{length:.2f} {unit}" if unit else f"{length:.4f}" for length in (away, self.farthest_mm))
            return f"its shape lies {own} RMS from the mean, beyond all training shapes ({farthest})"
        slack = _ROUNDING * (self.highest - self.lowest)
        if not self.lowest - slack <= value <= self.highest + slack:
            return f"{self.target} was learned between {self.lowest:g} and {self.highest:g} alone"
        return ""

    def save(self, path: Path | str) -> None:
        """Write the predictor to a file of numbers, .npz.

        Raises:
            FileError: the folder cannot be written.
        """
        facts = {name: getattr(self, name) for name in _FACTS}
        text = json.dumps({"format": FORMAT, "format_version": VERSION, **facts}, allow_nan=False)
        arrays: dict[str, npt.NDArray[Any]] = {name: getattr(self, name) for name in _FLOATS}
        write_arrays(Path(path), {**arrays, "fold": self.fold.astype(np.int64), "facts": np.array(text)})

    @staticmethod
    def load(path: Path | str) -> Predictor:
        """Return the predictor in a file, which is checked and never executed.

        Raises:
            FileError: the file cannot be read.
            FileFormatError: the file is no predictor, of another version, or damaged.
        """
        path = Path(path)
        arrays = read_arrays(path, _REMAKE, (*_FLOATS, "fold", "facts"))
        try:
            facts = _read_facts(arrays)
            parts = {name: read_only(arrays[name]) for name in _FLOATS}
            made = Predictor(**facts, fold=np.asarray(arrays["fold"], dtype=np.intp), **cast(dict[str, Any], parts))
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(f"{path} is no predictor of shapespace, or it is damaged; {_REMAKE}.") from error
        wrong = made._find_fault()
        if wrong:
            raise FileFormatError(f"{path} is damaged ({wrong}); {_REMAKE}.")
        return made

    def _find_fault(self) -> str:
        ways, rows = len(self.intercepts), len(self.residuals)
        if self.mean.ndim != 2 or self.mean.shape[1] != 3 or self.intercepts.ndim != 1 or self.residuals.ndim != 1:
            return "its arrays have other dimensions"
        if self.weights.shape != (ways, self.mean.size) or self.fold.shape != (rows,) or self.share.shape != (rows,):
            return "its arrays do not fit each other"
        if ways < 3 or not rows or self.fold.min() < 1 or self.fold.max() >= ways:
            return "its folds do not exist"
        if not all(np.isfinite(getattr(self, name)).all() for name in _FLOATS):
            return "it contains numbers that are not finite"
        if (self.residuals < 0).any() or (self.share <= 0).any() or not 0 < self.confidence < 1:
            return "it contains numbers that are out of range"
        return ""


def _read_facts(arrays: Mapping[str, npt.NDArray[Any]]) -> dict[str, Any]:
    content: object = plain_json(str(arrays["facts"]))
    if not isinstance(content, dict):
        raise ValueError("no facts")
    facts = cast(dict[str, Any], content)
    if facts.get("format") != FORMAT or facts.get("format_version") != VERSION:
        raise ValueError("another format")
    texts = {name: facts[name] for name in ("target", "gauge", "model_hash", "method")}
    numbers = {name: float(facts[name]) for name in ("lowest", "highest", "farthest_mm", "confidence")}
    if not all(isinstance(text, str) for text in texts.values()) or texts["gauge"] not in ("form", "shape"):
        raise ValueError("facts of another kind")
    if not all(map(math.isfinite, numbers.values())):
        raise ValueError("numbers that are not finite")
    return {**texts, **numbers, "subjects": int(facts["subjects"])}


def model_hash_of(cohort: Cohort) -> str:
    """Return the hash of the model whose coefficients a cohort's shapes are; empty if they are surfaces."""
    if cohort.fitted is None:
        return ""
    # Coefficients are counted from the model's mean, in its own size or another; surfaces from their own mean.
    mean, reference = cohort.fitted.model.mean_vertices, cohort.reference
    scale = float(np.vdot(reference, mean) / np.vdot(mean, mean))
    counted = np.allclose(reference, scale * mean, rtol=0.0, atol=1e-9 * float(np.abs(mean).max()))
    return cohort.fitted.model.content_hash if counted else ""


def cv_plus(
    ways: FloatArray, residuals: FloatArray, fold: IndexArray, share: FloatArray, confidence: float
) -> tuple[FloatArray, FloatArray]:
    """Return low and high (n,) of CV+ intervals.

    Args:
        ways: (n, F) predictions by the regression without each fold.
        residuals: (N,) absolute residuals of the training rows, each predicted without its fold.
        fold: (N,) fold of each training row, from 0.
        share: (N,) weight of each training row; the weights sum to the number of subjects.
        confidence: level of the interval; with too few subjects for it the ends are the outermost.
    """
    subjects = float(share.sum())
    past = min(confidence * (1.0 + 1.0 / subjects), 1.0) * subjects
    by_row = ways[:, fold]
    high = _weighted_quantile(by_row + residuals, share, past)
    low = -_weighted_quantile(residuals - by_row, share, past)
    return read_only(low), read_only(high)


def _weighted_quantile(values: FloatArray, share: FloatArray, past: float) -> FloatArray:
    """Return (n,) the smallest value of each row of `values` (n, N) up to which `share` (N,) sums to `past`."""
    order = np.argsort(values, axis=1, kind="stable")
    reached = np.cumsum(share[order], axis=1) >= past - 1e-9
    reached[:, -1] = True
    rows = np.arange(len(values))
    return values[rows, order[rows, reached.argmax(axis=1)]]


def refuse_known(known: tuple[str, ...], new: tuple[str, ...], where: str) -> None:
    """Check that new shapes are not of training subjects.

    Raises:
        InputError: some are of training subjects.
    """
    both = sorted(set(known) & set(new))
    if both:
        raise InputError(
            f"{where}: {list_names(both)} {'was' if len(both) == 1 else 'were'} learned from too, so their predictions "
            "are meaningless; exclude them."
        )
