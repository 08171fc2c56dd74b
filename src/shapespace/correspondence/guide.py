"""Predictions of shapes from other shapes, where the registrations of the next round begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray

_FOLDS, _MODES = 25, 100
"""More shapes are predicted by those of other folds, by their strongest modes, so that cost grows as N does."""


@dataclass(frozen=True, eq=False)
class ShapePredictor:
    """Probabilistic PCA (Tipping and Bishop 1999) of some shapes, which predicts other ones (C13).

    Args:
        mean: (V, 3).
        modes: (3V, K) orthonormal.
        squares: (K,) sum of squares along each mode.
        noise: of a coordinate, in the same sum.
    """

    mean: FloatArray
    modes: FloatArray
    squares: FloatArray
    noise: float

    @staticmethod
    def of(shapes: FloatArray, noise_share: float) -> ShapePredictor:
        """Train on aligned `shapes` (N, V, 3), with noise of that share of the mean square of a mode."""
        mean = shapes.mean(axis=0)
        y = (shapes - mean).reshape(len(shapes), -1)
        squares, vectors = np.linalg.eigh(y @ y.T)
        used = np.flatnonzero(squares > 1e-9 * max(squares[-1], 1e-300))[-_MODES:]
        squares, modes = squares[used], y.T @ (vectors[:, used] / np.sqrt(squares[used]))
        return ShapePredictor(mean, modes, squares, noise_share * float(squares.mean()))

    def predict(self, shape: FloatArray, weights: FloatArray) -> FloatArray:
        """Return (V, 3) the posterior mean of an aligned `shape` (V, 3); `weights` (V,) of its vertices, 0 to 1."""
        weighted = (np.repeat(weights, 3)[:, None] * self.modes).T
        precision = weighted @ self.modes + np.diag(self.noise / self.squares)
        b = np.asarray(np.linalg.solve(precision, weighted @ (shape - self.mean).ravel()))
        return self.mean + (self.modes @ b).reshape(-1, 3)  # C13

    def distance(self, shape: FloatArray, weights: FloatArray) -> float:
        """Return the RMS distance of the vertices of positive weight of `shape`, in any pose, from its prediction."""
        used = weights > 0
        shape = fit_similarity(shape[used], self.mean[used]).apply(shape)
        return float(np.sqrt(((shape - self.predict(shape, weights))[used] ** 2).sum(axis=1).mean()))


def predict_leave_one_out(shapes: FloatArray, weights: FloatArray, noise_share: float) -> FloatArray:
    """Return (N, V, 3) the prediction of each of the aligned `shapes` (N, V, 3) from the others.

    Args:
        shapes: aligned.
        weights: (N, V) of their vertices, 0 to 1.
        noise_share: as in `ShapePredictor.of`.
    """
    n, predicted = len(shapes), np.empty_like(shapes)
    for fold in np.array_split(np.arange(n), min(n, _FOLDS)):
        predictor = ShapePredictor.of(np.delete(shapes, fold, axis=0), noise_share)
        for i in fold.tolist():
            predicted[i] = predictor.predict(shapes[i], weights[i])
    return predicted
