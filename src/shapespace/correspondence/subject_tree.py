"""The order in which the scans of a subject are registered, each from another scan of the same subject."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from shapespace.types import FloatArray

_LEAST = 1e-9  # share of the largest distance, so that equal shapes are connected


def subject_levels(shapes: FloatArray, mean: FloatArray, subjects: Sequence[Hashable]) -> list[list[tuple[int, int]]]:
    """Return pairs of shape and parent; those of a level have parents in the levels before, or roots.

    The shapes of a subject are the nodes of a minimum spanning tree of their RMS distances. Its root is the shape
    nearest to the mean, such as the neutral face; extreme shapes follow through intermediate ones.

    Args:
        shapes: (N, V, 3) aligned.
        mean: (V, 3) of all shapes.
        subjects: (N,) of the shapes.
    """
    members: dict[Hashable, list[int]] = {}
    for i, subject in enumerate(subjects):
        members.setdefault(subject, []).append(i)
    levels: dict[int, list[tuple[int, int]]] = {}
    for own in members.values():
        flat = shapes[own].reshape(len(own), -1)
        distances = np.linalg.norm(flat[:, None] - flat, axis=2)
        root = int(np.linalg.norm(flat - mean.ravel(), axis=1).argmin())
        tree = minimum_spanning_tree(distances + _LEAST * max(float(distances.max()), 1.0))
        order, parents = breadth_first_order(tree, root, directed=False)
        depth = {root: 0}
        for child in map(int, order[1:]):
            parent = int(parents[child])
            depth[child] = depth[parent] + 1
            levels.setdefault(depth[child], []).append((own[child], own[parent]))
    return [levels[depth] for depth in sorted(levels)]
