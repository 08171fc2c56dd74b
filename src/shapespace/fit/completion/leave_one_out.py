"""Errors of completions of the training shapes, each by the model of the others: the calibration of a completion.

The training shapes are the only sample of its population that a model has. Each one in turn is observed as the scan
was: at the same vertices, along their normals, in a free pose. It is completed by the model of the others, which is
linear algebra in the coefficients of the shapes. Equation numbers are those of docs/completion.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.stats import chi2, f

from shapespace.fit.dense.residual_modes import ResidualModes
from shapespace.fit.robust.normal_equations import SCALE
from shapespace.geometry.similarity import POSE
from shapespace.model.new_shapes import variances_of_new_shapes
from shapespace.types import FloatArray

MOST_LEFT_OUT = 50  # shapes; standard deviations are then known to 10 %, and the time is seconds for 500 modes
_FEWEST_LEFT_OUT, _MOST_WORK = 12, 10_000  # shapes, and shapes times modes: models of more modes leave out fewer shapes
_OFF_MODEL = 60  # residual modes, the strongest, that vary together with what a shape has outside the others' span
_LEVEL = 0.95  # of the regions for which the covariance is exact
_ROUNDING = 1e-12  # share of the largest variance


@dataclass(frozen=True, eq=False)
class LeftOutErrors:
    """Errors of the completions of n training shapes, each by the model of the others (E4).

    The P parameters are those of the completion: pose, coefficients and off-model variation.

    Args:
        known: (n, 1 + K) log scale and coefficients of the shapes, mm.
        errors: (n, P) of the parameters, without noise of the scan.
        noise: (P, P) covariance of the errors by noise of the scan.
        shifts: (n, P) from the completion of the scan to the one by the model without the shape.
    """

    known: FloatArray
    errors: FloatArray
    noise: FloatArray
    shifts: FloatArray

    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) of the predictive distribution of the error (E4)."""
        n = len(self.errors)
        # Hotelling's T^2 of one of n errors, so that regions of 95 % of a vertex contain 95 %.
        factor = 3 * n / (n - 2) * float(f.ppf(_LEVEL, 3, n - 2) / chi2.ppf(_LEVEL, 3))
        return self.errors.T @ self.errors * (factor / n) + self.noise


def root_of(covariance: FloatArray) -> FloatArray:
    """Return a root R (P, P) of a covariance, R R^T; scaled, as angles and coefficients differ in size."""
    unit = np.sqrt(np.maximum(covariance.diagonal(), 1e-300))
    value, vector = np.linalg.eigh(covariance / np.outer(unit, unit))
    return unit[:, None] * vector * np.sqrt(np.maximum(value, 0.0))


def leave_one_out(
    known: FloatArray, H: FloatArray, pull: FloatArray, mean: FloatArray, variance: FloatArray,
    extra: ResidualModes,
) -> LeftOutErrors:  # fmt: skip
    """Return the errors of the completions of training shapes, each by the model of the others (E4).

    Args:
        known: (n, 1 + K) log scale of the shapes, and coefficients in all modes of the model, mm.
        H: (P, P) precision of the data.
        pull: (P,) of the data.
        mean: (P,) of the posterior of the scan.
        variance: (P,) of the prior; zero holds a parameter.
        extra: the residual modes.
    """
    coefficients = known[:, 1:]
    n, K = coefficients.shape
    end = POSE + K + min(_OFF_MODEL, len(variance) - POSE - K)
    kept = np.arange(SCALE if variance[SCALE] > 0 else POSE, end, dtype=np.int32)
    c = slice(POSE - kept[0], POSE - kept[0] + K)
    # The prior of pose and faint modes is the same for all shapes, so they are eliminated once.
    is_other = variance > 0
    is_other[kept] = False
    other = np.flatnonzero(is_other)
    factor = cho_factor(H[np.ix_(other, other)] + np.diag(1.0 / variance[other]), lower=True)
    slaved, pull_other = cho_solve(factor, H[np.ix_(other, kept)]), cho_solve(factor, pull[other])
    H_kept = H[np.ix_(kept, kept)] - H[np.ix_(kept, other)] @ slaved
    pull_kept = pull[kept] - H[np.ix_(kept, other)] @ pull_other
    share = variance[POSE + K :].sum() / (extra.stddev**2).sum()
    z = coefficients / np.sqrt((coefficients**2).sum(axis=0) / (n - 1))
    prior, mu, theta = np.diag(variance[kept]), np.zeros(len(kept)), np.zeros(len(kept))
    chosen = np.arange(n, dtype=np.int32)
    most = min(MOST_LEFT_OUT, max(_FEWEST_LEFT_OUT, _MOST_WORK // K))
    if n > most:
        chosen = np.sort(np.random.default_rng(0).choice(n, most, replace=False))
    errors, shifts = np.zeros((2, len(chosen), len(variance)))
    for row, i in enumerate(chosen):
        off = ((coefficients - coefficients[i]) ** 2).sum(axis=1)
        others = coefficients[off > _ROUNDING * off.max()]  # a copy of the shape would predict it
        mu[c], theta[c], theta[: c.start] = others.mean(axis=0), coefficients[i], known[i, : c.start]
        prior[c, c], outside = _prior_of(others - mu[c])
        # What leaves the span of the others has the prior of the residual modes, with which it varies together.
        off_model = share * extra.covariance_outside(outside, z[i], n)[:, : end - POSE]
        prior[c, c] += off_model[:, :K] @ outside @ outside.T
        prior[c, c.stop :], prior[c.stop :, c] = off_model[:, K:], off_model[:, K:].T
        both = np.column_stack([mu - theta, prior @ pull_kept + mu])
        solved = np.linalg.solve(np.eye(len(kept)) + prior @ H_kept, both)
        errors[row, kept], shifts[row, kept] = solved.T
    errors[:, other] = -errors[:, kept] @ slaved.T
    shifts[:, other] = pull_other - shifts[:, kept] @ slaved.T
    return LeftOutErrors(known[chosen], errors, _noise(H, variance), shifts - mean)


def _noise(H: FloatArray, variance: FloatArray) -> FloatArray:
    """Return the covariance (P, P) of the posterior mean by noise of the data."""
    free = np.flatnonzero(variance > 0)
    H = H[np.ix_(free, free)]
    gain = np.linalg.inv(H + np.diag(1.0 / variance[free]))
    out = np.zeros((len(variance), len(variance)))
    out[np.ix_(free, free)] = gain @ H @ gain
    return out


def _prior_of(others: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the prior covariance (K, K) of the model of centred shapes (m, K), and a basis (K, r) of what it lacks."""
    m = len(others)
    value, vector = np.linalg.eigh(others.T @ others / (m - 1))
    rank = min(m - 1, int((value > _ROUNDING * value[-1]).sum()))
    sample, axes = value[: -rank - 1 : -1], vector[:, : -rank - 1 : -1]
    new = np.maximum(sample, variances_of_new_shapes(sample, float(sample.sum()), m))
    return (axes * new) @ axes.T, vector[:, :-rank]
