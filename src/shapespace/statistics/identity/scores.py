"""Scores: how alike two scans are, larger for more alike. Each is learned from people who are not tested."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias

import numpy as np
from scipy.spatial.distance import cdist

from shapespace.errors import InputError
from shapespace.statistics.identity.plda import TwoCovariance
from shapespace.statistics.identity.samples import Samples
from shapespace.types import FloatArray

Scorer: TypeAlias = Callable[[Samples, Samples], FloatArray]
"""(gallery, probes) -> (G, P) scores, alike if the two change places."""


def _plda(training: Samples) -> Scorer:
    return TwoCovariance.learn(training).score


def _cosine(_: Samples) -> Scorer:
    return lambda gallery, probes: _directions(gallery.x) @ _directions(probes.x).T


def _mahalanobis(_: Samples) -> Scorer:
    return lambda gallery, probes: -cdist(gallery.x, probes.x)


def _distance(_: Samples) -> Scorer:
    return lambda gallery, probes: -cdist(gallery.mm, probes.mm) / np.sqrt(gallery.n_vertices)


def _directions(x: FloatArray) -> FloatArray:
    norms = np.linalg.norm(x, axis=1, keepdims=True)
    return x / np.where(norms > 0, norms, 1.0)


SCORES: Mapping[str, Callable[[Samples], Scorer]] = MappingProxyType(
    {
        "plda": _plda,
        "cosine": _cosine,
        "mahalanobis": _mahalanobis,
        "distance": _distance,
    }
)
"""Similarity scores of two scans: by the two-covariance model (PLDA), by the angle and by the distance of whitened
coefficients of identity, and by the plain distance of the shapes, RMS over vertices in mm. No score is a likelihood
ratio."""


def refuse_unknown_scores(names: Sequence[str]) -> None:
    """Check that `names` are scores.

    Raises:
        InputError: there are none, or one is not known.
    """
    unknown = [name for name in names if name not in SCORES]
    if unknown or not names:
        raise InputError(f"Scores are {', '.join(SCORES)}, not {', '.join(unknown) or 'none at all'}.")
