"""Effect sizes Z: a statistic in standard deviations of its permutation distribution.

Collyer, Sekora and Adams, Heredity 115, 2015; Box and Cox, JRSS B 26(2), 1964; RRPP (Collyer and Adams, Methods in
Ecology and Evolution 9, 2018), function `effect.size`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import numpy as np

from shapespace.statistics.tolerances import TIE
from shapespace.types import FloatArray

EffectSize: TypeAlias = Literal["box-cox", "log"]
EFFECT_SIZES: tuple[EffectSize, ...] = ("box-cox", "log")
"""Transformations of the statistic before it is standardised; RRPP from version 0.6 uses Box-Cox, earlier ones log."""

UnknownP: TypeAlias = Literal["short vectors", "raw residuals"]
"""Why a tested statistic has no p: vectors that are no longer than their noise have no direction, and angles of
permuted raw residuals have 12 to 73 % false positives (docs/morphometrics.md)."""

_LAMBDA_BOUNDS = (-2.0, 2.0)
"""Of the Box-Cox exponent, as in RRPP 2.1."""
_LAMBDA_ZERO = 1e-3
"""Absolute exponents below this limit are replaced by the logarithm, as in RRPP 2.1."""
_LAMBDA_TOLERANCE = 1e-5  # absolute, of the Box-Cox exponent
_SMALLEST = 1e-300  # near the smallest float64, so that logarithms are finite


def effect_size(statistic: FloatArray, kind: EffectSize = "box-cox") -> float:
    """Return the first of (P,) positive statistics in standard deviations above the mean of all, transformed.

    Args:
        statistic: (P,) such as F, of the observed data first and then of each permutation.
        kind: `box-cox` estimates the exponent from the permutations without the observed value; `log` takes logarithms.

    Returns:
        Z; 0 if all statistics are the same.
    """
    values = np.maximum(np.asarray(statistic, dtype=np.float64), _SMALLEST)
    logs = np.log(values)
    exponent = box_cox_exponent(values[1:]) if kind == "box-cox" and len(values) > 1 else 0.0
    # Division by the geometric mean keeps powers finite and leaves Z unchanged.
    logs -= logs.mean()
    transformed = logs if exponent == 0 else np.expm1(exponent * logs) / exponent
    spread = float(transformed.std())
    if not np.isfinite(spread) or spread <= 1e-12 * max(float(np.abs(transformed).max()), _SMALLEST):
        return 0.0
    return float((transformed[0] - transformed.mean()) / spread)  # S5


def permutation_p(statistic: FloatArray, tail: Literal["upper", "lower"] = "upper") -> float:
    """Return the share of (P,) statistics that are as large, or as small, as the first; equal ones count."""
    slack = TIE * abs(float(statistic[0]))
    extreme = statistic >= statistic[0] - slack if tail == "upper" else statistic <= statistic[0] + slack
    return float(extreme.mean())  # S4


def holm_p(p: Sequence[float]) -> tuple[float, ...]:
    """Return p values corrected over their family by Holm (1979), whatever the dependence of the tests."""
    order = np.argsort(p, kind="stable")
    corrected = np.maximum.accumulate(np.minimum(np.asarray(p)[order] * np.arange(len(p), 0, -1), 1.0))
    return tuple(corrected[np.argsort(order)].tolist())


def box_cox_exponent(values: FloatArray) -> float:
    """Return the exponent of the Box-Cox transformation of (P,) positive values that maximises the profile likelihood.

    Returns:
        the exponent from -2 to 2; 0, the logarithm, within 0.001 of it and for values that are all the same.
    """
    from scipy.optimize import minimize_scalar  # loads much

    logs = np.log(np.maximum(values, _SMALLEST))
    logs = logs - logs.mean()
    if float(np.ptp(logs)) == 0:
        return 0.0

    def log_variance(exponent: float) -> float:
        # The values are divided by their geometric mean, so the Jacobian of the transformation is 1.
        powers = logs if abs(exponent) < _LAMBDA_ZERO else np.expm1(exponent * logs) / exponent
        return float(np.log(powers.var()))

    with np.errstate(over="ignore"):
        optimum = minimize_scalar(
            log_variance, bounds=_LAMBDA_BOUNDS, method="bounded", options={"xatol": _LAMBDA_TOLERANCE}
        )
    exponent = float(optimum.x)
    return 0.0 if abs(exponent) < _LAMBDA_ZERO else exponent
