"""How many modes: cross-validation on vertices that the fit did not see.

Shares of the variance say nothing once shapes are noisy; predicting hidden vertices of unseen shapes does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.errors import InputError
from shapespace.model.pca import principal_components
from shapespace.types import FloatArray, IntArray

_LEAST_NOISE = 1e-6


@dataclass(frozen=True, eq=False)
class ModeChoice:
    """The error curve and the choice.

    Args:
        modes: the smallest number within one standard error of the best.
        candidates: (C,) int32 numbers of modes tried.
        error_mm: (C,) mean distance of hidden vertices from their prediction.
        standard_error_mm: (C,) of that mean over the held-out shapes.
    """

    modes: int
    candidates: IntArray
    error_mm: FloatArray
    standard_error_mm: FloatArray


def choose_modes(data: FloatArray, *, folds: int = 5, seed: int = 0) -> ModeChoice:
    """Choose the number of modes by held-out vertices with the one-standard-error rule.

    In each fold the model is made without some shapes; half of the vertices of each are shown, coefficients are
    their maximum a posteriori, and the hidden half is predicted.

    Args:
        data: (N, 3V) aligned shapes, mm.
        folds: how many, at most N.
        seed: of the split and of the hidden halves.

    Raises:
        InputError: fewer than four shapes.
    """
    n, d = data.shape
    if n < 4:
        raise InputError(
            f"Choosing the number of modes by cross-validation needs at least four shapes, not {n}; "
            "ask for a number of modes or a share of the variance instead."
        )
    folds = min(folds, n)
    rng = np.random.default_rng(seed)
    parts = np.array_split(rng.permutation(n), folds)
    most = n - max(len(part) for part in parts) - 1
    spaced = {round(most ** (step / 23)) for step in range(24)}
    candidates: IntArray = np.array(sorted(spaced), dtype=np.int32)
    errors = np.zeros((n, len(candidates)))
    for held_out in parts:
        pc = principal_components(np.delete(data, held_out, axis=0))
        shown = np.zeros(d // 3, dtype=np.bool_)
        shown[rng.permutation(d // 3)[: d // 6]] = True
        shown_coordinates = np.repeat(shown, 3)
        seen, hidden = pc.basis[shown_coordinates], pc.basis[~shown_coordinates]
        overlap = seen.T @ seen
        residual = data[held_out] - pc.mean
        evidence = residual[:, shown_coordinates] @ seen
        for column, k in enumerate(candidates):
            kept = min(int(k), len(pc.variance))
            noise = max((pc.total_variance - pc.variance[:kept].sum()) / (d - kept), _LEAST_NOISE * pc.variance[0] / d)
            system = overlap[:kept, :kept] + noise * np.diag(1.0 / pc.variance[:kept])
            b: FloatArray = np.asarray(np.linalg.solve(system, evidence[:, :kept].T), dtype=np.float64)
            wrong: FloatArray = residual[:, ~shown_coordinates] - (hidden[:, :kept] @ b).T
            errors[held_out, column] = np.linalg.norm(wrong.reshape(len(held_out), -1, 3), axis=2).mean(axis=1)
    mean = errors.mean(axis=0)
    standard_error = errors.std(axis=0, ddof=1) / np.sqrt(n)
    best = int(mean.argmin())
    choice = int(np.flatnonzero(mean <= mean[best] + standard_error[best])[0])
    return ModeChoice(int(candidates[choice]), candidates, mean, standard_error)
