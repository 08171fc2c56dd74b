"""Variances of shapes outside the training set along each mode: one rule from three shapes to thousands.

Modes are chosen to fit the training shapes, so the first variances are too large and the last far too small for others.
Nonlinear shrinkage predicts from the spectrum alone the variances of new shapes (Ledoit and Wolf, Annals of Statistics
48(5), 2020, section 4.5 for more coordinates than shapes). It assumes that shapes are independent, but mirror images
and several expressions of one person are not. If shapes were held out, their variances along modes made without them
correct the prediction by a smooth factor of the rank. The range of the factor about 1 is estimated from the same shapes
(empirical Bayes: MacKay, Neural Computation 4(3), 1992), so that a few shapes change it a little and many as far as
needed.

The eigenvalues of a sample do not determine the variances of shapes along modes that were made without them: the model
excludes a direction in which no training person varies, and the part of a new person along it is then attributed to
other modes. Source:
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import legvander

from shapespace.model.krylov import largest_eigenpairs
from shapespace.types import FloatArray

_DEGREE = 5  # degree of the polynomial in the rank of a mode; a smooth factor needs no more
_WIDTHS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Standard deviations that are compared for the constant part of the log factor; higher degrees have less."""
# limit of Newton steps, the step that ends them, and the longest step, all in the logarithm of the factor
_STEPS, _STILL, _LONGEST = 60, 1e-7, 1.0
_ALL_KEPT = 1e-6  # share of the variance; less beyond the retained modes is rounding error
_BOUNDS = (1e-2, 1e4)  # factors of a variance that no estimate may exceed
_FARTHEST = 30.0  # bound of exponents, which keeps exp() finite


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Variances of shapes along modes that were made without them.

    Args:
        squares: (K,) sum of the squared coefficients, mm^2; 0 if no part had such a mode.
        seen: (K,) share of the shapes that each sum is over, 0 to 1.
        shapes: number of shapes.
        groups: number of independent groups of shapes, such as people.
        left_mm2: mean squared norm of a shape outside all modes, mm^2.
    """

    squares: FloatArray
    seen: FloatArray
    shapes: int
    groups: int
    left_mm2: float


def variances_of_new_shapes(
    sample: FloatArray, total: float, n_shapes: int, held_out: HeldOut | None = None
) -> FloatArray:
    """Return the variances (K,), mm^2, of new shapes along the first modes of a sample, in falling order.

    Args:
        sample: variances in the sample, above 0, in falling order, divisor `n_shapes` - 1; of all modes if they are
            known, since the rest is otherwise assumed to be spread evenly.
        total: total variance of all modes of the sample, kept or not, mm^2.
        n_shapes: number of shapes of the sample.
        held_out: variances of held-out shapes along K modes; None if only the spectrum is known: K is then its length.
    """
    from scipy.optimize import isotonic_regression  # slow to import, and readers of models do not need it

    count = len(sample) if held_out is None else len(held_out.squares)
    spectrum = whole_spectrum(sample, total, n_shapes)
    # If shapes are not independent, a single prediction can be absurd, which its neighbours then correct.
    bounded = np.clip(_shrink_spectrum(spectrum, n_shapes) / spectrum, *_BOUNDS) * spectrum
    variance = np.exp(isotonic_regression(np.log(bounded[:count]), increasing=False).x)
    if held_out is not None:
        variance = variance * np.exp(_log_factor(variance, held_out))
    return np.asarray(isotonic_regression(variance, increasing=False).x)


def whole_spectrum(sample: FloatArray, total: float, n: int) -> FloatArray:
    """Return variances of up to n - 1 modes, mm^2: `sample` (K,), then equal parts of the remainder, if any."""
    rest, left = n - 1 - len(sample), total - float(sample.sum())
    return np.concatenate([sample, np.full(rest, left / rest)]) if rest > 0 and left > _ALL_KEPT * total else sample


def _shrink_spectrum(spectrum: FloatArray, n: int) -> FloatArray:
    c = len(spectrum) / max(n - 1, 1)
    density, transform = _smooth_spectrum(spectrum, n)
    if c < 1:
        return spectrum / ((np.pi * c * spectrum * density) ** 2 + (1 - c - np.pi * c * spectrum * transform) ** 2)
    return 1.0 / (np.pi**2 * spectrum * (density**2 + transform**2))


def _smooth_spectrum(spectrum: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Return the density (D,) of the eigenvalues and its Hilbert transform (D,), by an Epanechnikov kernel."""
    width = n ** (-1.0 / 3.0) * spectrum
    x = (spectrum[:, None] - spectrum) / width
    root = np.sqrt(5.0)
    near = np.maximum(1.0 - x**2 / 5.0, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = np.nan_to_num((1.0 - x**2 / 5.0) * np.log(np.abs((root - x) / (root + x))))
    density = (0.75 / root * near / width).mean(axis=1)
    transform = ((-0.3 * x + 0.75 / root * curved) / np.pi / width).mean(axis=1)
    return density, transform


def _log_factor(variance: FloatArray, held_out: HeldOut) -> FloatArray:
    """Return the log factor (K,) at the likeliest width: a normal prior on Legendre polynomials of the rank."""
    k = len(variance)
    waves: FloatArray = np.asarray(legvander(np.linspace(-1.0, 1.0, k), min(_DEGREE, k - 1)), dtype=np.float64)
    weight = 0.5 * held_out.groups * held_out.seen
    ratio = held_out.squares / np.maximum(held_out.seen * held_out.shapes, 1.0) / variance
    factors = [_evidence_at_width(waves, weight, ratio, width) for width in _WIDTHS]
    return waves @ max(factors, key=lambda one: one[0])[1]


def _evidence_at_width(
    waves: FloatArray, weight: FloatArray, ratio: FloatArray, width: float
) -> tuple[float, FloatArray]:
    """Return the evidence (Laplace) and the likeliest coefficients, by Newton steps on a convex cost."""
    prior = np.arange(1.0, waves.shape[1] + 1.0) ** 4 / width**2
    c = np.zeros(waves.shape[1])
    for _ in range(_STEPS):
        pull = weight * ratio * np.exp(np.clip(-waves @ c, -_FARTHEST, _FARTHEST))
        hessian = (waves.T * pull) @ waves + np.diag(prior)
        step = np.linalg.solve(hessian, waves.T @ (pull - weight) - prior * c)
        longest = float(np.abs(step).max())
        c = c + step * min(1.0, _LONGEST / max(longest, _STILL))
        if longest < _STILL:
            break
    pull = weight * ratio * np.exp(np.clip(-waves @ c, -_FARTHEST, _FARTHEST))
    hessian = (waves.T * pull) @ waves + np.diag(prior)
    cost = pull.sum() + weight @ waves @ c + 0.5 * prior @ c**2
    return float(-cost + 0.5 * np.log(prior).sum() - 0.5 * np.linalg.slogdet(hessian)[1]), c


_PARTS = 25  # folds; each costs a model, built from 4 % fewer shapes
_NO_VARIANCE = 1e-10  # share of the first eigenvalue; below is rounding error


def held_out_shapes(gram: FloatArray, groups: Sequence[str], modes: int, *, centred: bool) -> HeldOut:
    """Return the variances of the shapes of each group along the first `modes` modes of all other groups.

    Args:
        gram: (N, N) inner products of the shapes, about any one point if `centred`, else about zero.
        groups: (N,) group of each shape; the shapes of a group are held out together, a 25th of the groups at a time.
        modes: K, the number of modes.
        centred: whether the modes are about the mean of the shapes, and not about zero.
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
