"""Least squares in which each subject counts once, with variances that allow repeated scans and unequal residuals.

The variance of an estimate sums over subjects, each with residuals of its own, corrected for their leverage (bias-
reduced linearization, CR2: Bell and McCaffrey, Survey Methodology 28, 2002), and Student's t has the degrees of freedom
of this variance (Imbens and Kolesar, Review of Economics and Statistics 98, 2016). Terms are tested by sign flips of
the residuals of all scans of a subject (the restricted wild bootstrap of `dispersion`). Equations Sn: docs/regress.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from shapespace.errors import InputError
from shapespace.statistics.dispersion import FULL_LEVERAGE
from shapespace.statistics.linear_regressors import IndexArray
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import FloatArray

_BATCH = 50
"""Number of sign flips drawn from one seed."""
_STREAM = 6  # separates these sign flips from those of other tests with the same seed


@dataclass(frozen=True, eq=False)
class SubjectRegression:
    """A linear model of rows, which are scans of subjects.

    Args:
        columns: (N, p) columns of the model, independent, the constant among them.
        owner: (N,) number of the subject of each row, ascending from 0.
    """

    columns: FloatArray
    owner: IndexArray

    @cached_property
    def _starts(self) -> list[int]:
        """First row of each subject."""
        return [k for k, own in enumerate(self.owner.tolist()) if k == 0 or own != self.owner[k - 1]]

    @cached_property
    def root(self) -> FloatArray:
        """(N,) root of the weight of each row, 1 / number of scans of its subject."""
        return np.asarray(1.0 / np.sqrt(np.bincount(self.owner)[self.owner]), dtype=np.float64)

    def predict(self, rows: FloatArray, responses: FloatArray) -> FloatArray:
        """Return linear combinations (A, K) of the parameters; for the arguments see `estimate`."""
        return rows @ np.linalg.lstsq(self.root[:, None] * self.columns, self.root[:, None] * responses, rcond=None)[0]

    def estimate(self, rows: FloatArray, responses: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Estimate linear combinations of the parameters.

        Args:
            rows: (A, p) combinations of the columns.
            responses: (N, K) responses.

        Returns:
            Estimates (A, K); the part of each of the S subjects in their error (A, S, K), whose squares sum to the
            variance; degrees of freedom of the variance (A,).

        Raises:
            InputError: a subject that the model fits exactly.
        """
        q, r = np.linalg.qr(self.root[:, None] * self.columns)
        weighted = self.root[:, None] * responses
        residual = weighted - q @ (q.T @ weighted)
        weights = np.asarray(q @ np.linalg.solve(r.T, rows.T), dtype=np.float64)  # S44
        corrected = self._correct_leverage(weights, q)
        parts = np.stack([self._sums(column[:, None] * residual) for column in corrected.T])  # S45
        df = np.empty(len(rows))
        for k, column in enumerate(corrected.T):
            own = column[:, None] * np.eye(len(self._starts))[self.owner]
            gram = own.T @ own - (own.T @ q) @ (q.T @ own)
            df[k] = np.trace(gram) ** 2 / (gram**2).sum()  # S46
        return weights.T @ weighted, parts, df

    def statistics(
        self, tested: Sequence[int], responses: FloatArray, permutations: int, seed: int, progress: Progress | None
    ) -> FloatArray:
        """Return the (permutations,) squared effects of some columns divided by their variance, the observed one first.

        Further values are those of sign flips of the residuals of the model without these columns.

        Args:
            tested: numbers of the columns.
            responses: (N, K) responses.
            permutations: number of sign flips, the observed data among them.
            seed: seed of the sign flips.
            progress: function called with (done, total).

        Raises:
            InputError: a subject that the model fits exactly.
        """
        others = [column for column in range(self.columns.shape[1]) if column not in tested]
        q = np.linalg.qr(self.root[:, None] * self.columns[:, [*others, *tested]])[0]
        reduced, weighted = q[:, : len(others)], self.root[:, None] * responses
        residual = weighted - reduced @ (reduced.T @ weighted)
        corrected = self._correct_leverage(q[:, len(others) :], q)
        between = self._sums(corrected[:, :, None] * q[:, None])
        products = np.einsum("gjm,gjn->mn", between, between)

        def statistic(rows: FloatArray, signs: FloatArray) -> FloatArray:
            parts = self._sums(corrected[:, :, None] * rows[:, None])
            fitted = (signs[:, None, self.owner] * q.T) @ rows
            placed = signs[:, None, :, None] * between.transpose(2, 0, 1)
            crossed = placed.reshape(*placed.shape[:2], -1) @ parts.reshape(-1, parts.shape[2])
            variance = (parts**2).sum() + ((products @ fitted - 2.0 * crossed) * fitted).sum(axis=(1, 2))
            return (fitted[:, len(others) :] ** 2).sum(axis=(1, 2)) / np.maximum(variance, 1e-300)  # S48

        count, step = len(self._starts), StepCounter(permutations, progress)
        found, scaled = [statistic(residual, np.ones((1, count)))], self._correct_leverage(residual, reduced)
        for start in range(1, permutations, _BATCH):
            signs = np.random.default_rng([seed, _STREAM, start]).choice((-1.0, 1.0), (_BATCH, count))
            found.append(statistic(scaled, signs[: permutations - start]))
            step.add(len(found[-1]))
        return np.concatenate(found)

    def _sums(self, values: FloatArray) -> FloatArray:
        """Return the sums of rows (N, ...) over each subject."""
        return np.add.reduceat(values, self._starts, axis=0)

    def _correct_leverage(self, values: FloatArray, columns: FloatArray) -> FloatArray:
        """Return `values` (N, c), the rows of each subject times (I - H)^(-1/2), H its block of the hat matrix."""
        out = np.empty_like(values)
        for first, last in pairwise([*self._starts, len(values)]):
            own = columns[first:last]
            free, axes = np.linalg.eigh(np.eye(last - first) - own @ own.T)
            if free[0] < FULL_LEVERAGE:
                raise InputError(
                    "The model fits a subject exactly, as the only member of a class, so its variance is not known; "
                    "exclude the subject, or merge its class with another."
                )
            out[first:last] = (axes / np.sqrt(free)) @ (axes.T @ values[first:last])
        return out
