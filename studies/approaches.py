"""Six ways from one fit to an expression, under the same folds: what the study compares in one table.

Each reads the coefficients of the same registrations, made by a model that has not seen the people tested, so that only
what becomes of them differs. `Rows` of training people teach it; `features` are then asked for of anybody.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from bilinear import BilinearModel
from shapespace.model.additive import AdditiveModel
from shapespace.model.pca import modes_for_variance
from shapespace.recognise.hierarchy import ExpressionByType, FaceTypes
from shapespace.types import BoolArray, FloatArray, IntArray

PAPER_VARIANCE = 0.985
_BILINEAR_IDENTITIES = 30
"""Twice as many were worse: the product then explains what it should not."""
TextArray = npt.NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class Rows:
    """Fits by one model.

    Args:
        z: (n, K) in standard deviations, finite.
        z_stddev: (n, K) theirs.
        expression: n names; neutral among them.
        shown: (n,) place of the scan among its person's: 0 is neutral, and the same number is the same expression.
        subject: n names.
        e_beside: (n, Ke) expressions found together with the person's neutral scan, less that scan's; NaN where there
            is none.
        e_together: (n, Ke) expressions found together with all other expressive scans of the person, without labels.
    """

    z: FloatArray
    z_stddev: FloatArray
    expression: TextArray
    shown: IntArray
    subject: TextArray
    e_beside: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    e_together: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def where(self, chosen: BoolArray) -> Rows:
        """Return some of them."""
        return Rows(
            self.z[chosen], self.z_stddev[chosen], self.expression[chosen], self.shown[chosen], self.subject[chosen],
            *(part[chosen] if len(part) else part for part in (self.e_beside, self.e_together)),
        )  # fmt: skip

    @property
    def usable(self) -> BoolArray:
        """(n,) whether the fit did not fail."""
        return np.asarray(np.isfinite(self.z).all(axis=1), dtype=np.bool_)

    @property
    def expressive(self) -> Rows:
        """Those that are not neutral."""
        return self.where(self.shown != 0)


Features = Callable[[Rows], FloatArray]


class Approach(Protocol):
    """Learns from training people how to read an expression."""

    def __call__(self, model: AdditiveModel, training: Rows) -> Features:
        """Return what gives (n, k) features of an expression."""
        ...


def one_pca(model: AdditiveModel, training: Rows) -> Features:
    """The paper: one PCA of all training faces, whitened, with 98.5 % of the variance."""
    b = training.z * model.shape.stddev
    mean = b.mean(axis=0)
    _, size, rows = np.linalg.svd(b - mean, full_matrices=False)
    kept = modes_for_variance(size**2, PAPER_VARIANCE)
    basis, stddev = rows[:kept].T, size[:kept] / np.sqrt(len(b) - 1)
    return lambda faces: (faces.z * model.shape.stddev - mean) @ basis / stddev


def additive(model: AdditiveModel, training: Rows) -> Features:
    """Identity and expression solved for at once; e alone is the feature."""
    return lambda faces: model.split(faces.z)[1]


def continuous(model: AdditiveModel, training: Rows) -> Features:
    """Personalise the mean by identity alone, fit expression to it, and once more."""

    def features(faces: Rows) -> FloatArray:
        Ra, Re = model.rotation[: model.n_identity], model.rotation[model.n_identity :]
        out = np.empty((len(faces.z), model.n_expression))
        for row, (z, stddev) in enumerate(zip(faces.z, faces.z_stddev, strict=True)):
            variance = np.minimum(stddev, 0.999) ** 2
            told, pulled = 1.0 / variance - 1.0, z / variance
            left_a = (Ra * told) @ Ra.T + np.eye(len(Ra))
            left_e = (Re * told) @ Re.T + np.eye(len(Re))
            cross = (Ra * told) @ Re.T
            e: FloatArray = np.zeros(len(Re))
            for _ in range(2):
                a: FloatArray = np.asarray(np.linalg.solve(left_a, Ra @ pulled - cross @ e), dtype=np.float64)
                e = np.asarray(np.linalg.solve(left_e, Re @ pulled - cross.T @ a), dtype=np.float64)
            out[row] = e
        return out

    return features


def bilinear(model: AdditiveModel, training: Rows) -> Features:
    """A tensor of people times expressions; the expression vector is the feature."""
    columns = np.unique(training.shown)
    table: list[FloatArray] = []
    for name in np.unique(training.subject):
        mine = training.where(training.subject == name)
        order = np.argsort(mine.shown)
        if len(order) == len(columns):
            table.append(mine.z[order] * model.shape.stddev)
    identity_rank = min(len(table), model.n_identity, _BILINEAR_IDENTITIES)
    expression_rank = min(len(columns), model.n_expression)
    fitted = BilinearModel.fit(np.stack(table), identity_rank, expression_rank)
    stddev = model.shape.stddev
    return lambda faces: fitted.encode(faces.z * stddev, faces.z_stddev * stddev)[1]


def about_own_mean(model: AdditiveModel, faces: Rows) -> FloatArray:
    """Return expressions (n, Ke) less the mean of all scans of the same person, whatever they show.

    Which takes no label, but a set of scans of each person in which expressions are balanced.
    """
    e = model.split(faces.z)[1]
    for name in np.unique(faces.subject):
        own = faces.subject == name
        e[own] -= e[own].mean(axis=0)
    return e


def beside_neutral(model: AdditiveModel, faces: Rows, z_neutral: FloatArray) -> FloatArray:
    """Return expressions (n, Ke) where the same person's neutral scan is known: identity stays, e alone is solved for.

    Args:
        model: of the fits.
        faces: the fits.
        z_neutral: (n, K) fits of the neutral scans of the same people; NaN gives NaN.
    """
    Re = model.rotation[model.n_identity :]
    out = np.full((len(faces.z), len(Re)), np.nan)
    for row in np.flatnonzero(faces.usable & np.isfinite(z_neutral).all(axis=1)):
        told = 1.0 / np.minimum(faces.z_stddev[row], 0.999) ** 2 - 1.0
        moved = (Re * told) @ (faces.z[row] - z_neutral[row])
        out[row] = np.linalg.solve((Re * told) @ Re.T + np.eye(len(Re)), moved)
    return out


APPROACHES: Mapping[str, Approach] = {
    "one PCA (the paper)": one_pca,
    "additive": additive,
    "bilinear": bilinear,
    "continuous": continuous,
}
"""Approaches whose features go to one classifier."""


def face_types(model: AdditiveModel, training: Rows, types: int | None, seed: int) -> FaceTypes:
    """Return the types of the training people's neutral faces."""
    neutral = training.where(training.shown == 0)
    return FaceTypes.fit(model.split(neutral.z)[0], types=types, seed=seed)


def by_type(
    model: AdditiveModel, training: Rows, faces: Rows, types: FaceTypes, *, soft: bool
) -> tuple[tuple[str, ...], FloatArray]:
    """Return the classes and how likely each is, (n, C), by the paper's hierarchy."""
    taught = training.expressive
    a, e = model.split(taught.z)
    hierarchy = ExpressionByType(types, soft=soft).fit(a, e, taught.expression.tolist())
    return hierarchy.classes, hierarchy.predict_proba(*model.split(faces.z))
