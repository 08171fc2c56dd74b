"""Sample sizes of a comparison of groups, by simulation from pilot data.

Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.schemas import CurvePart, Series, TablePart
from shapespace.statistics.compare_strata import means_of
from shapespace.statistics.effect_size import permutation_p
from shapespace.statistics.shape_tests.groups import groups_of
from shapespace.statistics.shape_tests.ordination import principal_components
from shapespace.statistics.shape_tests.permutations import Groups, Orders, orders
from shapespace.statistics.shape_tests.shape_test_result import LEVEL, ShapeTestResult, Statistic
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import FloatArray

_POWER = 0.8  # that is planned for, as usual


def plan_sample_size(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    effect: str = "corrected",
    sizes: tuple[int, ...] = (10, 20, 40),
    simulations: int = 400,
    permutations: int = 200,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Estimate the power of a comparison of group means, and the sample size for a power of 80 %, from pilot data.

    Args:
        cohort: the shapes of the pilot study.
        group: columns whose classes, or combinations of classes, are the groups.
        effect: distance of the means: `corrected`, that of the pilot without its upward bias; `observed`; a multiple
            of the corrected one such as `0.5x`; or a Procrustes distance such as `0.03`. For more than two groups it is
            the root mean square over all pairs.
        sizes: numbers of shapes in each group.
        simulations: number of simulated studies for each size.
        permutations: number of permutations in the test of each simulated study, including its data as simulated.
        seed: seed of the simulations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a group of fewer than three shapes, sizes below 2, an effect that cannot be read or
            is not above 0, or fewer than 20 permutations.

    Example:
        >>> settings = {"sizes": (5, 10), "simulations": 20, "permutations": 50}
        >>> plan = ss.statistics.plan_sample_size(cohort, group=["group"], **settings)
        >>> plan.name
        'power'
    """
    from scipy.stats import binomtest  # loads much

    if not sizes or min(sizes) < 2 or simulations < 1 or permutations < 1 / LEVEL:
        raise InputError("Planning needs sizes of 2 or more, 1 or more simulations and 20 or more permutations.")
    cohort, groups = groups_of(cohort, group, drop_missing, 3, "planning")
    means, residual = means_of(cohort.coefficients, groups.codes), groups.residuals(cohort.coefficients)
    variances = np.bincount(groups.codes, (residual**2).sum(axis=1)) / groups.counts
    first, second = np.array(groups.pairs).T
    observed = math.sqrt(((means[first] - means[second]) ** 2).sum(axis=1).mean())
    noise = (variances / groups.counts)[[first, second]].sum(axis=0).mean()
    corrected = math.sqrt(max(observed**2 - noise, 0.0))  # M24
    distance = _distance(effect, observed, corrected)
    means = (means - means.mean(axis=0)) * distance / observed
    simulate = _simulator(residual, means, np.sqrt(variances), groups)
    step, powers = StepCounter(len(set(sizes)) * simulations, progress), list[Statistic]()
    for size in sorted(set(sizes)):
        rng, found = np.random.default_rng([seed, size]), 0
        simulated = Groups(groups.names, np.repeat(np.arange(len(groups.names)), size))
        for _ in range(simulations):
            shapes = simulate(simulated.codes, rng)
            products = shapes @ shapes.T
            labels = np.concatenate(
                [simulated.labels(r) for _, r in orders(len(shapes), permutations, seed + step.done)]
            )
            between = (labels * (labels.reshape(-1, len(shapes)) @ products).reshape(labels.shape)).sum(axis=(1, 2))
            found += permutation_p(between) <= LEVEL
            step.add()
        low, high = map(float, binomtest(found, simulations).proportion_ci(method="wilson"))
        powers.append(
            Statistic(name="power", tested=f"{size} per group", value=found / simulations, low=low, high=high)
        )
    counts, values = tuple(map(float, sorted(set(sizes)))), tuple(power.value for power in powers)
    smallest = _smallest_size(counts, values)
    note = (
        f"The means of the pilot have a distance of {observed:.3g}, which is biased upwards by sampling; without this "
        f"bias it is {corrected:.3g}. Planned for {distance:.3g}: a power of 80 % needs "
        + (f"{'fewer' if values[0] >= _POWER else 'more'} shapes per group than these sizes." if smallest is None
           else f"{smallest} shapes per group.")
    )  # fmt: skip
    if smallest is not None:
        powers.append(Statistic(name="shapes per group", tested="power of 80 %", value=float(smallest)))
    limits = [(power.low, power.high) for power in powers[: len(counts)]]
    curve = Series(x=counts, y=values, low=tuple(low for low, _ in limits), high=tuple(high for _, high in limits))
    shares = ("power", "lower 95 %", "upper 95 %")
    rows = [(int(count), value, *limit) for count, value, limit in zip(counts, values, limits, strict=True)]
    return ShapeTestResult(
        name="power", cohort=replace(cohort, notes=(*cohort.notes, note)), statistics=powers, classes=group,
        settings={"group": list(group), "effect": effect, "distance": distance, "sizes": sorted(set(sizes)),
                  "simulations": simulations, "permutations": permutations, "seed": seed},
        tables=(TablePart.of("Power", ("shapes per group", *shares), rows, percent=shares),),
        figures=(CurvePart(title="Power by sample size", series=(curve,), x="shapes per group", y="power"),),
        assumptions=(
            f"Power is the share of {simulations} simulated studies whose permutation test of the group means is "
            "significant at 5 %; shapes are drawn by a smoothed bootstrap of the residuals of the pilot.",
        ),
    )  # fmt: skip


def _distance(effect: str, observed: float, corrected: float) -> float:
    """Return the distance of the means that an effect stands for."""
    number = re.fullmatch(r"(\d*\.?\d+(?:e-?\d+)?)(x?)", effect.strip())
    if effect not in ("observed", "corrected") and not (number and float(number[1]) > 0):
        raise InputError(
            f"The effect {effect[:40]!r} cannot be read; write corrected, observed, a multiple such as 0.5x, or a "
            "distance above 0."
        )
    if effect == "observed" or (number and not number[2]):
        return float(number[1]) if number else observed
    if corrected == 0.0:
        raise InputError(
            f"The distance {observed:.3g} of the means of the pilot is not above that by sampling alone, so there is "
            "no effect to plan with; give a distance with --effect."
        )
    return corrected * (float(number[1]) if number else 1.0)


def _simulator(
    residual: FloatArray, means: FloatArray, deviations: FloatArray, groups: Groups
) -> Callable[[Orders, np.random.Generator], FloatArray]:
    """Return a function that simulates centred shapes (n, d) of groups (n,), in rotated axes, by a smoothed bootstrap.

    Residuals (N, K) of all groups are pooled after division by the standard deviation of their group. The noise lies in
    the span of these residuals, so that a singular covariance stays singular.
    """
    # Smoothed bootstrap (Silverman and Young 1987)
    _, axes, variances = principal_components(residual / deviations[groups.codes, None])
    scores = residual @ axes.T / deviations[groups.codes, None]
    spread = np.sqrt((scores**2).mean(axis=0))
    off = means - means @ axes.T @ axes
    centres = np.hstack([means @ axes.T, off @ np.linalg.svd(off, full_matrices=False)[2].T])
    dimensions = variances.sum() ** 2 / (variances**2).sum()
    width = (4 / ((dimensions + 2) * len(scores))) ** (1 / (dimensions + 4))  # Silverman (1986)

    def simulate(codes: Orders, rng: np.random.Generator) -> FloatArray:
        drawn = scores[rng.integers(len(scores), size=len(codes))]
        drawn = (drawn + width * spread * rng.normal(size=drawn.shape)) / math.hypot(1, width)
        shapes = centres[codes]
        shapes[:, : scores.shape[1]] += deviations[codes, None] * drawn
        return shapes - shapes.mean(axis=0)

    return simulate


def _smallest_size(sizes: tuple[float, ...], powers: tuple[float, ...]) -> int | None:
    """Return the smallest sample size with the planned power; None if it is not within the range of `sizes`."""
    if not powers[0] < _POWER <= max(powers):
        return None
    # The probit of the power is nearly linear in the root of the size.
    probits = ndtri(np.clip(np.maximum.accumulate(powers), 1e-3, 1 - 1e-3))
    return math.ceil(float(np.interp(float(ndtri(_POWER)), probits, np.sqrt(sizes))) ** 2)
