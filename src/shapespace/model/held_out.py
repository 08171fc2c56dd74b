"""Variances of modes as people left out have them, which the eigenvalues of a sample do not tell.

Of N shapes the first eigenvalues are too large and the last far too small: a direction that no training person has
looks impossible, and what a new person has of it is then read as something else. Of few people the eigenvalues are the
better guess all the same, since what is found on those left out is noisier still. Source: Abadir, Distaso and Zikes,
J. Econometrics 2014, for eigenvalues from data that did not make the eigenvectors, put into falling order.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import isotonic_regression

from shapespace.types import FloatArray

_PARTS, _FEWEST_GROUPS = 25, 50
_NO_VARIANCE = 1e-10
_LEAST = 0.01
"""Of the variance in the sample; a mode that those left out hardly have is still one."""


def held_out_variances(
    gram: FloatArray, groups: Sequence[str], sample: FloatArray, *, centred: bool
) -> tuple[FloatArray, float] | None:
    """Return the variances (K,) of modes, and what is left, of shapes whose group did not take part in the modes.

    None where there are fewer than 50 groups, or where without a part of them there are fewer modes.

    Args:
        gram: (N, N) inner products of the shapes, about any one point where `centred`, else about zero.
        groups: (N,) of each shape; those of one group are left out together, a 25th of the groups at a time.
        sample: (K,) variances in the sample, in falling order.
        centred: whether the modes go through the mean of the shapes, and not through zero.
    """
    if len(set(groups)) < _FEWEST_GROUPS:
        return None
    names = {name: number % _PARTS for number, name in enumerate(dict.fromkeys(groups))}
    part = np.array([names[name] for name in groups])
    wanted = len(sample)
    squares, left = np.zeros(wanted), 0.0
    for k in range(part.max() + 1):
        out, own = np.flatnonzero(part == k), np.flatnonzero(part != k)
        inner, cross = gram[np.ix_(own, own)], gram[np.ix_(out, own)]
        size = gram[out, out].copy()
        if centred:
            size += inner.mean() - 2 * cross.mean(axis=1)
            row = inner.mean(axis=0)
            cross = cross - cross.mean(axis=1, keepdims=True) - row + inner.mean()
            inner = inner - row - row[:, None] + inner.mean()
        count = min(wanted, len(own))
        values, vectors = eigh(inner, subset_by_index=(len(own) - count, len(own) - 1), check_finite=False)
        values, vectors = values[::-1], vectors[:, ::-1]
        kept = int((values > _NO_VARIANCE * max(values[0], 0.0)).sum())
        if kept < wanted:
            return None
        along = (cross @ (vectors[:, :kept] / np.sqrt(values[:kept]))) ** 2
        squares += along.sum(axis=0)
        left += float(np.maximum(size - along.sum(axis=1), 0.0).sum())
    # Modes change places from part to part, so single values jump.
    fallen = isotonic_regression(squares / len(gram), increasing=False).x
    return np.maximum(fallen, _LEAST * sample), left / len(gram)
