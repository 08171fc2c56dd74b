"""Which scans of a collection are mirror images of the others, decided for the collection as a whole (C30, C31).

A few scans are anchors. Each scan and its mirror image are compared with each anchor: raw scans by the scores of the
pose search, shapes in correspondence by their Procrustes distances. The sides of anchors and scans that explain the
scores best are those of the collection.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from shapespace.reprs import first_names
from shapespace.types import BoolArray, FloatArray

_LARGEST_EVIDENCE = 0.3
"""Log ratio of scores beyond which a comparison counts no more: among 39 molars that were alike it was at most 0.2."""
_DRAWS, _P_VALUE = 1000, 0.01
"""Draws of random signs, and the share of them that may agree as well: beyond it the object is taken as symmetric."""
ASYMMETRIC = 0.08
"""Median log ratio of scores up to which an object is taken as symmetric: it was at most 0.06 for faces, whose missing
parts and expressions can agree on wrong sides, 0.07 for spleens, 0.12 or more for molars, and 0.19 or more for femora
and 11 simulated kinds."""
_ALONE = np.log(0.85)
"""Log ratio of scores of a scan and its mirror image below which one comparison decides: of 60 faces, femora and
spleens that were not mirrored none had less than log 0.88."""
_ANCHORS = 3
"""Shapes in correspondence that all others are compared with, as many as of raw scans."""
_ROUNDING = 1e-12  # squared Procrustes distance, as a share of the squared size, of equal shapes
_NAMED = 3  # names in a message


@dataclass(frozen=True, eq=False)
class Sides:
    """The sides of the scans of a collection.

    Args:
        mirrored: (N,) which scans are mirror images of the majority.
        margin: (N,) mean log ratio of scores by which the side was decided; 0 where nothing was compared.
        decided: whether the scores of different anchors agree; False for a symmetric object or too few comparisons.
        asymmetry: median absolute log ratio of scores.
    """

    mirrored: BoolArray
    margin: FloatArray
    decided: bool
    asymmetry: float = 0.0


def solve_sides(scores: FloatArray, anchors: Sequence[int], seed: int) -> Sides:
    """Return the sides that agree best with the scores of all comparisons.

    Args:
        scores: (A, N, 2) of each scan and of its mirror image, compared with each anchor; not-a-number where they were
            not compared.
        anchors: (A,) their numbers among the scans; -1 for one that is none of them.
        seed: of the draws for the test of agreement.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        evidence = np.log(scores[:, :, 1]) - np.log(scores[:, :, 0])  # C30
    evidence = np.clip(np.nan_to_num(evidence, nan=0.0), -_LARGEST_EVIDENCE, _LARGEST_EVIDENCE)
    for a, i in enumerate(anchors):
        if i >= 0:
            evidence[a, i] = 0.0  # a scan agrees with itself whatever its side
    asymmetry = float(np.median(np.abs(evidence[evidence != 0]))) if evidence.any() else 0.0
    signs, agreement = _best_signs(evidence, anchors)
    rng = np.random.default_rng(seed)
    drawn = [_best_signs(evidence * rng.choice([-1.0, 1.0], evidence.shape), anchors)[1] for _ in range(_DRAWS)]
    compared = (evidence != 0).sum(axis=0)
    margin = np.einsum("a,an->n", signs, evidence) / np.maximum(compared, 1)  # C31
    agrees = len(anchors) > 1 and np.mean(np.array(drawn) >= agreement) <= _P_VALUE
    decided = agrees and asymmetry > ASYMMETRIC
    mirrored = margin < 0 if decided else margin < _ALONE
    for a, i in enumerate(anchors):
        if decided and i >= 0:
            mirrored[i] = signs[a] < 0
    return Sides(np.asarray(mirrored), np.abs(margin), bool(decided), asymmetry)


def mirrored_note(shape: Callable[[int], FloatArray], name: Callable[[int], str], count: int) -> list[str]:
    """Return a sentence that names the shapes in correspondence that are mirror images of the majority, if any.

    Args:
        shape: returns the vertices (V, 3) of a shape by its index, in any pose and unit.
        name: returns the name of a shape by its index.
        count: number of shapes.
    """
    anchors = np.unique(np.linspace(0, count - 1, min(count, _ANCHORS)).round().astype(np.int32)).tolist()
    references = [_normalised(shape(i)) for i in anchors]
    scores = np.empty((len(anchors), count, 2))
    for j in range(count):
        vertices = _normalised(shape(j))
        for a, reference in enumerate(references):
            u, s, vt = np.linalg.svd(reference.T @ vertices)
            last = s[2] if np.linalg.det(u @ vt) > 0 else -s[2]
            cosines = np.array([s[0] + s[1] + last, s[0] + s[1] - last])  # of the best rotation and reflection
            scores[a, j] = np.sqrt(np.maximum(1.0 - cosines**2, _ROUNDING))
    if (scores[:, :, 0] <= scores[:, :, 1]).all():  # the draws would take a tenth of a second
        return []
    mirrored = solve_sides(scores, anchors, 0).mirrored
    mirrored = ~mirrored if 2 * mirrored.sum() > count else mirrored
    if not mirrored.any():
        return []
    of = "shapes is a mirror image" if mirrored.sum() == 1 else "shapes are mirror images"
    flagged = first_names([name(int(i)) for i in np.flatnonzero(mirrored)[: _NAMED + 1]], _NAMED)
    return [f"{mirrored.sum()} of {count} {of} of the others ({flagged}); reflect or remove them."]


def _normalised(vertices: FloatArray) -> FloatArray:
    """Return vertices (V, 3) about their centroid, with centroid size 1."""
    centred = vertices - vertices.mean(axis=0)
    return centred / np.linalg.norm(centred)


def _best_signs(evidence: FloatArray, anchors: Sequence[int]) -> tuple[FloatArray, float]:
    """Return the signs (A,) of the anchors, the first +1, that leave most evidence undisputed, and its amount."""
    patterns = np.array([(1.0, *signs) for signs in product((1.0, -1.0), repeat=len(evidence) - 1)])
    total = patterns @ evidence
    undisputed = np.abs(total)
    for a, i in enumerate(anchors):
        if i >= 0:
            undisputed[:, i] = patterns[:, a] * total[:, i]
    best = int(undisputed.sum(axis=1).argmax())  # C31
    return patterns[best], float(undisputed[best].sum())
