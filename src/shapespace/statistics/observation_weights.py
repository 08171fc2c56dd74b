"""Weights of vertices by their observations: a map is blank where the observed vertices carry too little information.

An estimated vertex is computed from the observed vertices of its shape and from the other shapes, so it is not an
additional observation.
"""

from __future__ import annotations

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.types import BoolArray, FloatArray

LEAST_INFORMATION = 0.5
"""Share of the information below which a map is blank; the share of shapes that a model needs (`MIN_SEEN`)."""
_ESTIMABLE = 1e-6  # relative; a contrast off by less is estimable within rounding
_BLOCK = 4096  # rows at a time; bounds memory


def information(cohort: Cohort, matrix: FloatArray, contrasts: FloatArray) -> FloatArray | None:
    """Return the share of the information on each contrast in the shapes that observe a vertex.

    It is the variance of the least-squares estimate of the contrast by all shapes, divided by that by the shapes that
    observe the vertex; 0 where these do not determine it, and at vertices that are not analysed.

    Args:
        cohort: N shapes.
        matrix: (N, p) design without intercept.
        contrasts: (E, p) linear combinations of its coefficients.

    Returns:
        (E, V), or None if all vertices are observed.
    """
    if cohort.observed is None and cohort.analysed is None:
        return None
    observed = np.ones((len(cohort), cohort.n_vertices), np.bool_) if cohort.observed is None else cohort.observed
    if cohort.analysed is not None:
        observed = np.logical_and(observed, cohort.analysed)
    X = np.column_stack([np.ones(len(matrix)), matrix])
    C = np.column_stack([np.zeros(len(contrasts)), contrasts])
    complete = _variance(X.T @ X, C)
    patterns, of_vertex = np.unique(np.packbits(observed, axis=0).T, axis=0, return_inverse=True)
    rows = np.unpackbits(patterns, axis=1, count=len(X)).astype(np.float64)
    products = (X[:, :, None] * X[:, None, :]).reshape(len(X), -1)
    out = np.empty((len(C), len(rows)))
    for start in range(0, len(rows), _BLOCK):
        part = slice(start, start + _BLOCK)
        systems = (rows[part] @ products).reshape(-1, X.shape[1], X.shape[1])
        out[:, part] = complete[:, None] / _variance(systems, C)
    return np.minimum(out, 1.0)[:, of_vertex.reshape(-1)]


def _variance(systems: FloatArray, C: FloatArray) -> FloatArray:
    """Return c' S^+ c of each contrast (E, p) in each system (..., p, p), (E, ...); infinite if not estimable."""
    inverse = np.linalg.pinv(systems, rcond=1e-10, hermitian=True)
    solved = np.einsum("...ij,ej->e...i", inverse, C)
    back = np.einsum("...ij,e...j->e...i", systems, solved)
    shape = (len(C), *(1,) * (systems.ndim - 2), C.shape[1])
    off = np.abs(back - C.reshape(shape)).max(axis=-1)
    variance = np.einsum("e...i,ei->e...", solved, C)
    known = off <= _ESTIMABLE * np.abs(C).max(axis=1).reshape(shape[:-1])
    return np.where(known & (variance > 0), variance, np.inf)


def weights_of(share: FloatArray) -> FloatArray:
    """Return weights (..., V) of vertices by their share of information or observations, 0 where maps are blank."""
    return np.where(share < LEAST_INFORMATION, 0.0, share)


def blank_where(values: FloatArray, blank: BoolArray | None) -> FloatArray:
    """Return values (..., V) with not-a-number, which maps draw in grey, where `blank` (..., V)."""
    return values if blank is None else np.where(blank, np.nan, values)
