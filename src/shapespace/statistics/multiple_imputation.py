"""Multiple imputation of completed shapes: an analysis of each imputation, and results combined by Rubin's rules.

Rubin, Multiple Imputation for Nonresponse in Surveys, 1987; Barnard and Rubin, Biometrika 86(4), 1999. p values by
their normal quantiles: Licht, New Methods for Generating Significance Levels from Multiply-Imputed Data, 2010;
Marshall, Altman, Holder and Royston, BMC Medical Research Methodology 9:57, 2009.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeAlias, TypeVar, cast

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.step_counter import progress_of_run
from shapespace.types import FloatArray, read_only

_P_VALUES = ("p", "p_other", "p_family", "q", "p_value", "directional_p")
_INTERVALS = (("value", "low", "high"), ("predicted", "low", "high"))
_LABELS = ("term", "label", "source", "target")
"""Fields of results: p values, estimates with the ends of their intervals, and names of tests."""
_LARGEST = 1e12  # reciprocal of the least p of a distribution, so that normal quantiles are finite
_Figures: TypeAlias = Sequence[Mapping[str, Any]]
"""Numbers by field, of each part of a result in turn."""
_Options = ParamSpec("_Options")
_Result = TypeVar("_Result")


@dataclass(frozen=True)
class Imputations:
    """Contribution of multiple imputation to a result.

    Args:
        count: number of imputations, M.
        missing_information: fraction of the information that is missing, 0 to 1, by the name of the test.
        stddev: standard deviations by the imputations, by the field of the result.
    """

    count: int
    missing_information: Mapping[str, float]
    stddev: Mapping[str, FloatArray]


@dataclass(frozen=True, eq=False)
class PooledEstimate:
    """Estimates that are combined over imputations.

    Args:
        value: mean over the imputations.
        variance: within and between imputations, T.
        df: degrees of freedom of Student's t.
        missing_information: fraction of the information that is missing.
    """

    value: FloatArray
    variance: FloatArray
    df: FloatArray
    missing_information: FloatArray


def pool_estimates(values: FloatArray, variances: FloatArray | float, df: float = math.inf) -> PooledEstimate:
    """Combine estimates by Rubin's rules.

    Args:
        values: (M, ...) estimate of each imputation.
        variances: (M, ...) their variances, or one for all.
        df: degrees of freedom without missing data.
    """
    count = len(values)
    between = (1 + 1 / count) * values.var(axis=0, ddof=1)
    total = np.broadcast_to(variances, values.shape).mean(axis=0) + between  # S71
    share = np.divide(between, total, out=np.zeros_like(total), where=total > 0)
    with np.errstate(divide="ignore"):
        own = (count - 1) / share**2  # S72
        known = 0.0 if math.isinf(df) else (df + 3) / ((df + 1) * df * (1 - share))
    missing = share + (1 - share) * 2 / (own + 3)  # S74
    with np.errstate(divide="ignore"):
        return PooledEstimate(values.mean(axis=0), total, 1 / (1 / own + known), missing)  # S73


def pool_p_values(p: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Combine p values by Rubin's rules for their normal quantiles.

    Args:
        p: (M, ...) p value of each imputation.
        least: smallest p, 1 / number of arrangements; the largest is 1 - least.

    Returns:
        p (...), and the fraction of missing information.
    """
    from scipy.special import ndtr, ndtri  # loads much

    pooled = pool_estimates(-ndtri(np.clip(p, least, 1 - least)), 1.0)  # S75
    return ndtr(-pooled.value / np.sqrt(pooled.variance)), pooled.missing_information  # S76


def pool_intervals(figures: FloatArray, level: float) -> FloatArray:
    """Combine estimates with intervals, whose halves replace the standard deviation on either side.

    Args:
        figures: (M, ..., 3) estimate, low and high of each imputation.
        level: confidence of the intervals.

    Returns:
        The same (..., 3), combined.
    """
    from scipy.special import ndtri, stdtrit  # loads much

    values, tail = figures[..., 0], (1 + level) / 2
    ends: list[FloatArray] = []
    for column, sign in ((1, -1.0), (2, 1.0)):
        pooled = pool_estimates(values, ((figures[..., column] - values) / ndtri(tail)) ** 2)
        ends.append(pooled.value + sign * stdtrit(pooled.df, tail) * np.sqrt(pooled.variance))
    return np.stack([values.mean(axis=0), *ends], axis=-1)


def over_imputations(
    *,
    parts: Collection[str] = (),
    means: Collection[str] = (),
    finish: Callable[[Any], Any] = lambda result: result,
    fixed: Callable[[Any], Mapping[str, Any]] = lambda result: {},
) -> Callable[[Callable[_Options, _Result]], Callable[_Options, _Result]]:
    """Return a decorator of an analysis: if its cohorts have samples, each imputation is analysed too, and combined.

    Options, permutations and seeds are the same in each imputation, and one imputation at a time is in memory. p values
    and estimates with intervals are combined; other numbers of the result are those of the completed shapes.

    Args:
        parts: fields whose content is searched for p values and intervals too.
        means: fields of the result that become means over the imputations.
        finish: function applied to the combined result, to update values that depend on p.
        fixed: arguments of each imputation that follow from the result of the completed shapes, such as a choice of
            the test.
    """

    def decorate(analyse: Callable[_Options, _Result]) -> Callable[_Options, _Result]:
        @wraps(analyse)
        def analyse_all(*args: _Options.args, **options: _Options.kwargs) -> _Result:
            given = cast("tuple[Any, ...]", args), cast("dict[str, Any]", options)
            values = (*given[0], *given[1].values())
            count = min(
                (own for value in values if isinstance(value, Cohort) and (own := value.imputations)), default=0
            )
            if count < 2:
                return analyse(*args, **options)
            result = _analyse_one(analyse, *given, None, count)
            own = {**signature(analyse).bind(*args, **options).arguments, **fixed(result)}
            each = [_figures(_analyse_one(analyse, (), own, k, count), parts, means) for k in range(count)]
            return finish(_pool(result, each, parts, means))

        return analyse_all

    return decorate


def _analyse_one(
    analyse: Callable[..., _Result], args: Sequence[Any], options: Mapping[str, Any], k: int | None, count: int
) -> _Result:
    """Return the analysis of imputation `k` of all cohorts, aligned to the first; None for the completed shapes."""
    first = next(value for value in (*args, *options.values()) if isinstance(value, Cohort))

    def imputed(value: Any) -> Any:
        if k is None or not isinstance(value, Cohort) or not value.imputations:
            return value
        return value.imputation(k, first)

    known: dict[str, Any] = {name: imputed(value) for name, value in options.items()}
    known["progress"] = progress_of_run(options.get("progress"), 0 if k is None else k + 1, count + 1)
    return analyse(*map(imputed, args), **known)


def _visit(value: Any, parts: Collection[str], change: Callable[[Any], Mapping[str, Any]]) -> Any:
    """Return a result with the fields that `change` returns for it, and for each of its parts in turn."""
    if isinstance(value, tuple):
        return tuple(_visit(item, parts, change) for item in cast("tuple[Any, ...]", value))
    if isinstance(value, dict):
        return {key: _visit(item, parts, change) for key, item in cast("dict[Any, Any]", value).items()}
    if not is_dataclass(value) or isinstance(value, type):
        return value
    inner = {name: _visit(getattr(value, name), parts, change) for name in parts if hasattr(value, name)}
    return replace(value, **{**inner, **change(value)})


def _figures(result: Any, parts: Collection[str], means: Collection[str]) -> _Figures:
    """Return the numbers of a result that are combined."""
    found: list[Mapping[str, Any]] = []

    def collect(owner: Any) -> Mapping[str, Any]:
        intervals = [name for names in _INTERVALS if all(hasattr(owner, own) for own in names) for name in names]
        names = (*_P_VALUES, "unknown_p", *means, *intervals)
        found.append({name: getattr(owner, name) for name in names if getattr(owner, name, None) is not None})
        return {}

    _visit(result, parts, collect)
    return found


def _pool(result: Any, each: Sequence[_Figures], parts: Collection[str], means: Collection[str]) -> Any:
    """Return a result with the numbers of all imputations combined."""
    tests = [test.arrangements for test in result.methods.tests if test.resampling in ("permutation", "sign flips")]
    numbers, missing, stddev = iter(range(len(each[0]))), dict[str, float](), dict[str, FloatArray]()

    def combine(owner: Any) -> Mapping[str, Any]:
        number, changed = next(numbers), dict[str, Any]()
        unknown = {name: own[number][name] for own in each for name in ("unknown_p",) if name in own[number]}
        if unknown:
            return {"p": None, **unknown}
        values = {name: np.stack([own[number][name] for own in each]) for name in each[0][number]}
        for name in (field for field in values.keys() & set(_P_VALUES) if getattr(owner, field) is not None):
            p, fraction = pool_p_values(values[name], 1 / max(tests, default=_LARGEST))
            changed[name] = np.where(getattr(owner, name) == 1, 1.0, p)  # blank vertices keep p = 1
            label = next((str(getattr(owner, field)) for field in _LABELS if hasattr(owner, field)), "")
            if name == "p" and label:
                missing.setdefault(f"{label} {getattr(owner, 'stratum', '')}".strip(), float(fraction))
        for name in values.keys() & set(means):
            pooled = pool_estimates(values[name], 0.0)
            changed[name], stddev[name] = pooled.value, read_only(np.sqrt(pooled.variance))
        for names in (names for names in _INTERVALS if names[0] in values):
            ends = pool_intervals(np.stack([values[name] for name in names], axis=-1), result.confidence)
            changed |= {name: ends[..., k] for k, name in enumerate(names)}
        return {name: read_only(array) if array.ndim else float(array) for name, array in changed.items()}

    return replace(_visit(result, parts, combine), imputations=Imputations(len(each), missing, stddev))
