"""Kinds of object in a collection: groups of shapes that predict each other, and shapes that no group predicts (C14).

A leave-one-out prediction from all shapes does not show a second kind that is frequent, since it is a part of the
training set. Here a core of shapes grows from a few similar ones: it predicts all shapes, and takes those that it
predicts about as well as its own. Scans of one person also predict each other best, but another person is not another
kind of object, since the reliefs agree (C35). The registrations of the next round begin at the same predictions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.correspondence.harmonics import Reliefs
from shapespace.geometry.normals import rms_size
from shapespace.geometry.procrustes import align_to_weighted_mean
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import BoolArray, FloatArray

_FOLDS, _MODES = 25, 100
"""Number of shapes above which shapes are predicted by those of other folds, by their strongest modes: linear cost."""


@dataclass(frozen=True, eq=False)
class ShapePredictor:
    """Probabilistic PCA (Tipping and Bishop 1999) of some shapes, which predicts other ones (C13).

    Args:
        mean: (V, 3) mean shape.
        modes: (3V, K) orthonormal.
        squares: (K,) sum of squares along each mode.
        noise: noise of a coordinate, as a sum of squares like `squares`.
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
        shapes: (N, V, 3) aligned shapes.
        weights: (N, V) weights of their vertices, 0 to 1.
        noise_share: share of noise, see `ShapePredictor.of`.
    """
    n, predicted = len(shapes), np.empty_like(shapes)
    for fold in np.array_split(np.arange(n), min(n, _FOLDS)):
        predictor = ShapePredictor.of(np.delete(shapes, fold, axis=0), noise_share)
        for i in fold.tolist():
            predicted[i] = predictor.predict(shapes[i], weights[i])
    return predicted


_Indices: TypeAlias = npt.NDArray[np.int_]
SAME_KIND = 2.0
"""Distance from the prediction, in medians of the core's own, up to which the core takes a shape: it was at most 1.7 in
12 collections of one kind, but for one wrong pose, and at least 2.4 for another kind in 9 mixed ones
(benchmarks/kinds.py)."""
ANOTHER_KIND = 2.2
"""Median distance of a group from the largest one, beyond which it is another kind: it was at least 2.4 in mixed
collections."""
SAME_RELIEF = 0.87
"""Agreement of a relief with the median of a group (a correlation of 0.7), above which the shape is no other kind: the
correlation was 0.85 or more for faces of other people with expressions, and 0.45 or less in groups of other kinds."""
_NOISE_SHARE = 0.1
"""Noise of predictions (C13). With 1, shapes of few modes are shrunk so much that their extremes look like others: 15
of 20 simulated collections of 80 shapes with three modes were split, with 0.1 none of 8 of 40 shapes."""
_LEAST_DISTANCE = 0.01
"""Lower bound of the usual distance from the prediction, share of the size: without noise the distance goes to 0."""
_FEWEST = 5  # shapes of a core
_POINTS = 600  # number of vertices at which shapes are compared
_SEEDS = 8  # number of shapes from which a core is grown
_GROWTH = 1.25  # largest factor by which a core grows in one step, so that its prediction follows
_STEPS = 30  # maximum number of steps


@dataclass(frozen=True, eq=False)
class Kinds:
    """The kinds of object of a collection.

    Args:
        groups: indices of the shapes of each group of similar shapes, largest group first; some shapes are in no group.
        distance: (N,) distances from the prediction by the largest group, relative to the median of the group.
        relief_agreement: (N,) agreement with the median relief of the largest group (C35); not-a-number if unknown.
    """

    groups: tuple[_Indices, ...]
    distance: FloatArray
    relief_agreement: FloatArray


def find_kinds(shapes: FloatArray, observed: FloatArray, template: FloatArray, reliefs: Reliefs | None = None) -> Kinds:
    """Return the groups of `shapes` that predict each other and whose reliefs agree.

    Args:
        shapes: (N, V, 3) shapes in correspondence.
        observed: (N, V) weights, 1 at observed vertices.
        template: (V, 3) shape to which shapes are aligned.
        reliefs: reliefs of the shapes; None if unknown.
    """
    collection = Collection.of(shapes, observed, template)
    groups: list[_Indices] = []
    rest = np.arange(len(shapes))
    while len(rest) >= _FEWEST:
        core = collection.separate_core(rest)
        if not len(core):
            break
        groups.append(core)
        rest = np.setdiff1d(rest, core)
    groups.sort(key=len, reverse=True)
    groups = groups or [np.arange(len(shapes))]
    agreement = np.full(len(shapes), np.nan)
    if reliefs is not None:
        agreement = reliefs.agreements(groups[0])
        same = [group for group in groups[1:] if np.median(agreement[group]) > SAME_RELIEF]
        others = [group for group in groups[1:] if not np.median(agreement[group]) > SAME_RELIEF]
        groups = [np.sort(np.concatenate([groups[0], *same])), *others]
    distance = collection.distances(groups[0])
    others = [group for group in groups[1:] if np.median(distance[group]) > ANOTHER_KIND]
    return Kinds((groups[0], *others), distance, agreement)


def is_outlier(distance: FloatArray, relief_agreement: FloatArray, threshold: float) -> BoolArray:
    """Return which shapes are far from their prediction by a group (C14), and have another relief (C35).

    Another relief alone is not sufficient, as that of smooth objects is noise; their status shows it.
    """
    return (distance > threshold) & ~(relief_agreement > SAME_RELIEF)


@dataclass(frozen=True, eq=False)
class Collection:
    """Shapes in correspondence, at some vertices, see `find_kinds`."""

    shapes: FloatArray
    observed: FloatArray
    template: FloatArray

    @staticmethod
    def of(shapes: FloatArray, observed: FloatArray, template: FloatArray) -> Collection:
        """Return the collection of `shapes` at `_POINTS` of their vertices, which are drawn at random."""
        chosen = np.sort(np.random.default_rng(0).permutation(len(template))[:_POINTS])
        return Collection(shapes[:, chosen], observed[:, chosen], template[chosen])

    def distances(self, core: _Indices) -> FloatArray:
        """Return (N,) the distance of each shape from its prediction by the rest of `core`, in medians of the core."""
        aligned, _ = align_to_weighted_mean(self.shapes[core], self.observed[core], self.template)
        predictor = ShapePredictor.of(aligned, _NOISE_SHARE)
        rms = np.empty(len(self.shapes))
        for i in np.setdiff1d(np.arange(len(rms)), core):
            rms[i] = predictor.distance(self.shapes[i], self.observed[i])
        predicted = predict_leave_one_out(aligned, self.observed[core], _NOISE_SHARE)
        squares = ((aligned - predicted) ** 2).sum(axis=2)
        weights = self.observed[core]
        rms[core] = np.sqrt((weights * squares).sum(axis=1) / np.maximum(weights.sum(axis=1), 1))
        return rms / max(float(np.median(rms[core])), _LEAST_DISTANCE * rms_size(self.template))

    def separate_core(self, candidates: _Indices) -> _Indices:
        """Return the core of `candidates` (M,) that is most separate from the rest; empty if there is none.

        Several cores are grown, each from a few similar shapes. A core of two kinds also
        predicts both, so the largest core can be mixed.
        """
        aligned, _ = align_to_weighted_mean(self.shapes[candidates], self.observed[candidates], self.template)
        flat = aligned.reshape(len(candidates), -1)
        squares = (flat**2).sum(axis=1)
        squared = squares[:, None] + squares - 2 * flat @ flat.T
        size = max(_FEWEST, len(candidates) // 4)
        seeds = np.unique(np.linspace(0, len(candidates) - 1, _SEEDS).round().astype(int))
        cores = [self._grow_core(candidates[np.argsort(squared[seed])[:size]], candidates) for seed in seeds]
        distinct = {core.tobytes(): core for core in cores}.values()  # mostly all are the same
        return max(distinct, key=lambda core: self._separation(core, candidates))

    def _separation(self, core: _Indices, candidates: _Indices) -> float:
        """Return the distance of the nearest shape outside `core`, as a ratio to that of the farthest one inside."""
        if not len(core):
            return 0.0
        distance = self.distances(core)
        outside = distance[np.setdiff1d(candidates, core)]
        return float(outside.min(initial=SAME_KIND) / max(distance[core].max(), SAME_KIND / 2))

    def _grow_core(self, core: _Indices, candidates: _Indices) -> _Indices:
        core = last = np.sort(core)
        for _ in range(_STEPS):
            distance = self.distances(core)[candidates]
            nearest = np.argsort(distance)[: int(_GROWTH * len(core)) + 1]
            grown = np.sort(candidates[nearest[distance[nearest] <= SAME_KIND]])
            if np.array_equal(grown, core) or len(grown) < _FEWEST:
                return grown if len(grown) >= _FEWEST else grown[:0]
            if np.array_equal(grown, last):  # one shape alternates between in and out
                return np.intersect1d(grown, core)
            core, last = grown, core
        return core
