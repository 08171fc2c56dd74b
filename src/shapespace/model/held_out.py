"""What shapes have along modes that were made without them, which the eigenvalues of a sample do not tell.

A direction that no training person has looks impossible to a sample, and what a new person has of it is then read as
something else. Source: Abadir, Distaso and Zikes, J. Econometrics 2014, for eigenvalues from data that did not make the
eigenvectors.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shapespace.model.krylov import largest_eigenpairs
from shapespace.model.new_shapes import HeldOut
from shapespace.types import FloatArray

_PARTS = 25  # folds; each costs a model, built from 4 % fewer shapes
_NO_VARIANCE = 1e-10  # share of the first eigenvalue; below is rounding


def held_out_shapes(gram: FloatArray, groups: Sequence[str], modes: int, *, centred: bool) -> HeldOut:
    """Return what the shapes of groups have along the first `modes` modes of all other groups.

    Args:
        gram: (N, N) inner products of the shapes, about any one point where `centred`, else about zero.
        groups: (N,) of each shape; those of one group are left out together, a 25th of the groups at a time.
        modes: K.
        centred: whether the modes go through the mean of the shapes, and not through zero.
    """
    names = list(dict.fromkeys(groups))
    part_of = {name: number % _PARTS for number, name in enumerate(names)}
    part = np.array([part_of[name] for name in groups])
    squares, seen, left = np.zeros(modes), np.zeros(modes), 0.0
    for k in range(min(_PARTS, len(names)) if len(names) > 1 else 0):
        out, own = np.flatnonzero(part == k), np.flatnonzero(part != k)
        inner, cross = gram[np.ix_(own, own)], gram[np.ix_(out, own)]
        size = gram[out, out].copy()
        if centred:
            size += inner.mean() - 2 * cross.mean(axis=1)
            row = inner.mean(axis=0)
            cross = cross - cross.mean(axis=1, keepdims=True) - row + inner.mean()
            inner = inner - row - row[:, None] + inner.mean()
        count = min(modes, len(own))
        values, vectors = largest_eigenpairs(inner, count)
        retained = int((values > _NO_VARIANCE * max(values[0], 0.0)).sum())
        along = (cross @ (vectors[:, :retained] / np.sqrt(values[:retained]))) ** 2
        squares[:retained] += along.sum(axis=0)
        seen[:retained] += len(out)
        left += float(np.maximum(size - along.sum(axis=1), 0.0).sum())
    return HeldOut(squares, seen / len(gram), len(gram), len(names), left / len(gram))
