"""Hierarchical classification: first the type of face, then an expression model for that type (the paper, section 5).

Types are the components of a Gaussian mixture of identity coefficients, as many as the Bayesian information criterion
asks for. The hard form takes the likeliest type; the soft one weighs the answers of all by how likely each type is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.special import logsumexp

from shapespace.errors import InputError
from shapespace.recognise.classifiers import ShrinkageLDA
from shapespace.types import FloatArray

_LEAST_VARIANCE = 1e-3  # added to each variance, of coefficients in sd; keeps components from collapsing
_KEPT = 0.995  # share of the variance


@dataclass(frozen=True, eq=False)
class FaceTypes:
    """A mixture of T normal distributions of the leading identity coefficients.

    Args:
        share: (T,) shares of the people.
        mean: (T, D) means.
        variance: (T, D) variances.
        bic: BIC by number of types, from 1; the smallest is best.
    """

    share: FloatArray
    mean: FloatArray
    variance: FloatArray
    bic: tuple[float, ...]

    @classmethod
    def fit(
        cls, a: FloatArray, *, types: int | None = None, max_types: int = 6, leading: int = 10, seed: int = 0
    ) -> FaceTypes:
        """Fit to identity coefficients, one row per person.

        Args:
            a: (S, Ka) identity coefficients in standard deviations.
            types: number of types; None for the number with the smallest BIC.
            max_types: largest number of types to try if `types` is None.
            leading: number of leading coefficients that are used.
            seed: seed of the starts of the mixture.

        Raises:
            InputError: fewer people than types.
        """
        from sklearn.mixture import GaussianMixture

        people = np.asarray(a, dtype=np.float64)[:, :leading]
        tried = range(1, min(max_types, len(people) // 4) + 1)
        if not tried or (types is not None and not 1 <= types <= len(people)):
            raise InputError(f"{len(people)} people are too few for {types or 'any'} types of face.")
        mixtures: dict[int, Any] = {}
        for number in {*tried} if types is None else {*tried, types}:
            mixture = cast(Any, GaussianMixture)(
                number, covariance_type="diag", n_init=4, random_state=seed, reg_covar=_LEAST_VARIANCE
            )
            mixtures[number] = mixture.fit(people)
        bic = {number: float(mixtures[number].bic(people)) for number in mixtures}
        best = mixtures[min(tried, key=lambda number: bic[number]) if types is None else types]
        return cls(
            np.asarray(best.weights_), np.asarray(best.means_), np.asarray(best.covariances_),
            tuple(bic[number] for number in tried),
        )  # fmt: skip

    @property
    def count(self) -> int:
        """T."""
        return len(self.share)

    def posterior(self, a: FloatArray) -> FloatArray:
        """Return (n, T) how likely each type is for identities a (n, Ka)."""
        leading = np.asarray(a, dtype=np.float64)[:, None, : self.mean.shape[1]]
        log = np.log(self.share) - 0.5 * (
            (leading - self.mean) ** 2 / self.variance + np.log(2 * np.pi * self.variance)
        ).sum(axis=2)
        return np.exp(log - logsumexp(log, axis=1, keepdims=True))


class ExpressionByType:
    """An expression model and a linear classifier for each type of face.

    Args:
        types: types of faces, by identity coefficients.
        soft: whether to weight the answers by the probability of each type; otherwise only the likeliest type answers.
    """

    def __init__(self, types: FaceTypes, *, soft: bool) -> None:
        self.types = types
        self.soft = soft
        self.classes: tuple[str, ...] = ()
        self._models: list[tuple[FloatArray, Any]] = []

    def fit(self, a: FloatArray, e: FloatArray, labels: Sequence[str]) -> ExpressionByType:
        """Fit to identity a (n, Ka), expression e (n, Ke) and classes.

        Every sample trains its likeliest type.

        Raises:
            InputError: a type that too few samples or classes belong to.
        """
        names = np.asarray(labels, dtype=str)
        self.classes = tuple(np.unique(names).tolist())
        type_index = self.types.posterior(a).argmax(axis=1)
        self._models = []
        for number in range(self.types.count):
            is_member = type_index == number
            if set(names[is_member]) != set(self.classes):
                raise InputError(
                    f"Type {number + 1} of {self.types.count} has too few faces for a classifier of its own; "
                    "ask for fewer types."
                )
            modes = _modes(e[is_member])
            self._models.append((modes, ShrinkageLDA().fit(e[is_member] @ modes, names[is_member])))
        return self

    def predict_proba(self, a: FloatArray, e: FloatArray) -> FloatArray:
        """Return (n, C) how likely each class is."""
        weight = self.types.posterior(a)
        if not self.soft:
            weight = np.eye(self.types.count)[weight.argmax(axis=1)]
        answers = [np.asarray(model.predict_proba(e @ modes)) for modes, model in self._models]
        return np.einsum("nt,tnc->nc", weight, np.stack(answers))


def _modes(e: FloatArray) -> FloatArray:
    """Return (Ke, k) the type's own modes of expression, through neutral."""
    _, size, rows = np.linalg.svd(e, full_matrices=False)
    n_kept = int(np.searchsorted(np.cumsum(size**2) / (size**2).sum(), _KEPT)) + 1
    return rows[: min(n_kept, len(rows))].T
