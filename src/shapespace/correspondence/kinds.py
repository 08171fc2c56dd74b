"""Kinds of object in a collection: groups of shapes that predict each other, and shapes that no group predicts (C14).

A leave-one-out prediction from all shapes does not show a second kind that is frequent, since it is a part of the
training set. Here a core of shapes grows from a few similar ones: it predicts all shapes, and takes those that it
predicts about as well as its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.correspondence.guide import ShapePredictor, predict_leave_one_out
from shapespace.geometry.procrustes import align_to_weighted_mean
from shapespace.types import FloatArray

_Indices: TypeAlias = npt.NDArray[np.int_]
SAME_KIND = 2.0
"""Distance from the prediction, in medians of the core's own, up to which the core takes a shape: it was at most 1.7 in
12 collections of one kind, but for one wrong pose, and at least 2.4 for another kind in 9 mixed ones
(benchmarks/kinds.py)."""
_FEWEST = 5  # shapes of a core
_POINTS = 600  # vertices that shapes are compared at
_SEEDS = 8  # shapes that a core is grown from
_GROWTH = 1.25  # factor by which a core grows in one step at most, so that its prediction follows
_STEPS = 30  # at most


@dataclass(frozen=True, eq=False)
class Kinds:
    """The kinds of object of a collection.

    Args:
        groups: indices of the shapes that are alike, largest group first; those in no group are missing.
        distance: (N,) from the prediction by the largest group, in medians of its own.
    """

    groups: tuple[_Indices, ...]
    distance: FloatArray


def find_kinds(shapes: FloatArray, observed: FloatArray, template: FloatArray, noise_share: float) -> Kinds:
    """Return the groups of `shapes` that predict each other.

    Args:
        shapes: (N, V, 3) in correspondence.
        observed: (N, V) weights, 1 where a vertex is observed.
        template: (V, 3) that shapes are aligned to.
        noise_share: as in `ShapePredictor.of`.
    """
    collection = Collection.of(shapes, observed, template, noise_share)
    groups: list[_Indices] = []
    rest = np.arange(len(shapes))
    while len(rest) >= _FEWEST:
        core = collection.largest_core(rest)
        if not len(core):
            break
        groups.append(core)
        rest = np.setdiff1d(rest, core)
    groups.sort(key=len, reverse=True)
    groups = groups or [np.arange(len(shapes))]
    return Kinds(tuple(groups), collection.distances(groups[0]))


@dataclass(frozen=True, eq=False)
class Collection:
    """Shapes in correspondence, at some vertices, as for `find_kinds`."""

    shapes: FloatArray
    observed: FloatArray
    template: FloatArray
    noise_share: float

    @staticmethod
    def of(shapes: FloatArray, observed: FloatArray, template: FloatArray, noise_share: float) -> Collection:
        """Return a collection at `_POINTS` of the vertices, drawn at random."""
        chosen = np.sort(np.random.default_rng(0).permutation(len(template))[:_POINTS])
        return Collection(shapes[:, chosen], observed[:, chosen], template[chosen], noise_share)

    def distances(self, core: _Indices) -> FloatArray:
        """Return (N,) the distance of each shape from its prediction by the rest of `core`, in medians of the core."""
        aligned, _ = align_to_weighted_mean(self.shapes[core], self.observed[core], self.template)
        predictor = ShapePredictor.of(aligned, self.noise_share)
        rms = np.array([predictor.distance(*one) for one in zip(self.shapes, self.observed, strict=True)])
        predicted = predict_leave_one_out(aligned, self.observed[core], self.noise_share)
        squares = ((aligned - predicted) ** 2).sum(axis=2)
        weights = self.observed[core]
        rms[core] = np.sqrt((weights * squares).sum(axis=1) / np.maximum(weights.sum(axis=1), 1))
        return rms / np.median(rms[core])

    def largest_core(self, candidates: _Indices) -> _Indices:
        """Return the largest core of `candidates` (M,) that grows from one of them and those most similar; or none."""
        aligned, _ = align_to_weighted_mean(self.shapes[candidates], self.observed[candidates], self.template)
        flat = aligned.reshape(len(candidates), -1)
        squares = (flat**2).sum(axis=1)
        squared = squares[:, None] + squares - 2 * flat @ flat.T
        size = max(_FEWEST, len(candidates) // 4)
        seeds = np.unique(np.linspace(0, len(candidates) - 1, _SEEDS).round().astype(int))
        cores = [self._grown(candidates[np.argsort(squared[seed])[:size]], candidates) for seed in seeds]
        return max(cores, key=len)

    def _grown(self, core: _Indices, candidates: _Indices) -> _Indices:
        for _ in range(_STEPS):
            distance = self.distances(np.sort(core))[candidates]
            nearest = np.argsort(distance)[: int(_GROWTH * len(core)) + 1]
            grown = np.sort(candidates[nearest[distance[nearest] <= SAME_KIND]])
            if np.array_equal(grown, np.sort(core)):
                break
            if len(grown) < _FEWEST:
                return grown[:0]
            core = grown
        return np.sort(core)
