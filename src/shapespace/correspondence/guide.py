"""What the others say of a shape: the modes of a round, as a guide for the next one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray

_ALIGNMENTS = 6
_FOLDS, _MODES = 25, 100
"""More shapes are told by those of other folds, by the widest modes of those, so that cost grows as N does."""


def aligned(shapes: FloatArray, seen: FloatArray, frame: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return `shapes` (N, V, 3) in the pose and size of their mean, and the mean (V, 3) in those of `frame` (V, 3).

    Args:
        shapes: in any poses and sizes.
        seen: (N, V) how much each vertex counts, 0 to 1.
        frame: the shape whose frame is kept.
    """
    mean, out = frame, shapes
    for _ in range(_ALIGNMENTS):
        poses = [fit_similarity(x[there > 0], mean[there > 0]) for x, there in zip(shapes, seen, strict=True)]
        out = np.stack([pose.apply(x) for pose, x in zip(poses, shapes, strict=True)])
        weight = np.maximum(seen, 1e-3)[:, :, None]
        mean = (weight * out).sum(axis=0) / weight.sum(axis=0)
        mean = fit_similarity(mean, frame).apply(mean)
    return out, mean


@dataclass(frozen=True, eq=False)
class Others:
    """What some shapes say of another one: probabilistic PCA (Tipping and Bishop 1999).

    Args:
        mean: (V, 3).
        modes: (3V, K) orthonormal.
        squares: (K,) sum of squares that each holds.
        noise: of a coordinate, in the same sum.
    """

    mean: FloatArray
    modes: FloatArray
    squares: FloatArray
    noise: float

    @staticmethod
    def of(shapes: FloatArray, noise_share: float) -> Others:
        """Return what aligned `shapes` (N, V, 3) say, with noise of that share of the mean square of a mode."""
        mean = shapes.mean(axis=0)
        y = (shapes - mean).reshape(len(shapes), -1)
        squares, turned = np.linalg.eigh(y @ y.T)
        kept = np.flatnonzero(squares > 1e-9 * max(squares[-1], 1e-300))[-_MODES:]
        squares, modes = squares[kept], y.T @ (turned[:, kept] / np.sqrt(squares[kept]))
        return Others(mean, modes, squares, noise_share * float(squares.mean()))

    def told(self, shape: FloatArray, seen: FloatArray) -> FloatArray:
        """Return (V, 3) as much of `shape` as they tell: mean + U b, b = (U^T W U + s diag(1 / m_k))^-1 U^T W y.

        Args:
            shape: (V, 3), aligned with them.
            seen: (V,) how much each vertex counts, W.
        """
        heard = (np.repeat(seen, 3)[:, None] * self.modes).T
        precision = heard @ self.modes + np.diag(self.noise / self.squares)
        b = np.asarray(np.linalg.solve(precision, heard @ (shape - self.mean).ravel()))
        return self.mean + (self.modes @ b).reshape(-1, 3)

    def apart(self, shape: FloatArray, seen: FloatArray) -> float:
        """Return the RMS distance over what is `seen` between `shape`, in any pose, and what they tell of it."""
        there = seen > 0
        shape = fit_similarity(shape[there], self.mean[there]).apply(shape)
        return float(np.sqrt(((shape - self.told(shape, seen))[there] ** 2).sum(axis=1).mean()))


def predict_leave_one_out(
    shapes: FloatArray, seen: FloatArray, noise_share: float, images: FloatArray | None = None
) -> FloatArray:
    """Return each of the aligned `shapes` (N, V, 3) as far as the others tell it, (N, V, 3).

    Args:
        shapes: aligned.
        seen: (N, V) how much each vertex counts, 0 to 1.
        noise_share: as in `Others.of`.
        images: (N, V, 3) the shapes' mirror images, which tell of others too.
    """
    n, out = len(shapes), np.empty_like(shapes)
    for fold in np.array_split(np.arange(n), min(n, _FOLDS)):
        rest = np.setdiff1d(np.arange(n), fold)
        known = shapes[rest] if images is None else np.concatenate([shapes[rest], images[rest]])
        others = Others.of(known, noise_share)
        for i in fold.tolist():
            out[i] = others.told(shapes[i], seen[i])
    return out
