"""Scores: how alike two scans are, larger for more alike. Each is learned from people who are not tested."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TypeAlias
from warnings import warn

import numpy as np
from scipy.spatial.distance import cdist

from shapespace.errors import InputError
from shapespace.statistics.identity.plda import TwoCovariance
from shapespace.statistics.identity.samples import Samples
from shapespace.types import FloatArray

Scorer: TypeAlias = Callable[[Samples, Samples], FloatArray]
"""(gallery, probes) -> (G, P) scores, alike if the two change places."""


def _directions(x: FloatArray) -> FloatArray:
    norms = np.linalg.norm(x, axis=1, keepdims=True)
    return x / np.where(norms > 0, norms, 1.0)


SCORES: Mapping[str, Callable[[Samples], Scorer]] = MappingProxyType(
    {
        "plda": lambda training: TwoCovariance.learn(training).score,
        "cosine": lambda _: lambda gallery, probes: _directions(gallery.x) @ _directions(probes.x).T,
        "mahalanobis": lambda _: lambda gallery, probes: -cdist(gallery.x, probes.x),
        "distance": lambda _: lambda gallery, probes: -cdist(gallery.mm, probes.mm) / np.sqrt(gallery.n_vertices),
    }
)
"""Similarity scores of two scans: by the two-covariance model (PLDA), by the angle and by the distance of whitened
coefficients of identity, and by the plain distance of the shapes, RMS over vertices in mm. No score is a likelihood
ratio."""


_FORMER = {"likelihood-ratio": "plda"}


def score_name(name: str) -> str:
    """Return the current name of a score, with a warning for a former name."""
    if name not in _FORMER:
        return name
    warn(
        f"The score {name!r} is now called {_FORMER[name]!r}, since only calibrated scores are likelihood ratios.",
        DeprecationWarning,
        stacklevel=3,
    )
    return _FORMER[name]


def refuse_unknown_scores(names: Sequence[str]) -> None:
    """Check that `names` are scores.

    Raises:
        InputError: there are none, or one is not known.
    """
    unknown = [name for name in names if name not in SCORES]
    if unknown or not names:
        raise InputError(f"Scores are {', '.join(SCORES)}, not {', '.join(unknown) or 'none at all'}.")
