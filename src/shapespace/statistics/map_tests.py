"""Tests of maps over subjects: the mean by sign flips, two groups by permutation, or by sign flips if variances differ.

Nichols and Holmes, Human Brain Mapping 15, 2002; Winkler et al., NeuroImage 92, 2014.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from shapespace.reprs import short_repr
from shapespace.statistics.dispersion import welch_flips
from shapespace.types import BoolArray, FloatArray

_BLOCK = 64  # permutations at a time; bounds memory
_TIE = 1e-10
"""Relative rounding error within which two equal statistics may differ."""
_FLOOR = 1e-12  # share of the squares; a variance below is rounding
LEVEL = 0.05
"""Family-wise error of maps, and one minus the confidence of their intervals."""


@dataclass(frozen=True, eq=False, kw_only=True)
class MapTest:
    """Result of a test of maps.

    Args:
        effect: (V,) mean, or difference of the means of two groups.
        t: (V,) Student's t.
        p: (V,) family-wise p over all vertices, by the permutation maximum of |t|.
        omnibus_p: p of the test for any change.
        permutations: number of permutations, the observed data among them.
        every: whether these are all possible permutations.
        n: number of subjects, or numbers of subjects of each group.
        critical_t: |t| above which `p` is at most `LEVEL`; effect ± |effect / t| critical_t are simultaneous
            intervals.
        unequal_variances: whether t is Welch's, compared with sign flips, which allows groups of unequal variance.
    """

    effect: FloatArray
    t: FloatArray
    p: FloatArray
    omnibus_p: float
    permutations: int
    every: bool
    n: tuple[int, ...]
    critical_t: float
    unequal_variances: bool = False

    def interval(self, vertex: int) -> tuple[float, float]:
        """Return the interval of the effect at a vertex, simultaneous over all vertices at the level 1 - `LEVEL`."""
        half = abs(float(self.effect[vertex] / self.t[vertex])) * self.critical_t if self.t[vertex] else 0.0
        return float(self.effect[vertex]) - half, float(self.effect[vertex]) + half

    __repr__ = short_repr


def mean_test(
    maps: FloatArray,
    area: FloatArray,
    permutations: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
) -> MapTest:
    """Test whether the mean of `maps` (N, V) differs from zero; without a difference both signs are equally likely.

    Args:
        maps: (N, V) maps of 2 or more subjects.
        area: (V,) weights of the vertices in the omnibus test of the squared mean.
        permutations: largest number of permutations; all sign flips if there are no more.
        seed: seed of random permutations.
        progress: function called with (done, total) permutations.
    """
    n = len(maps)
    every = 2 ** (n - 1) <= permutations
    count = 2 ** (n - 1) if every else permutations
    squares = (maps**2).sum(axis=0)

    def t_of(sums: FloatArray) -> FloatArray:
        within = np.maximum(squares - sums**2 / n, _FLOOR * squares) / (n - 1)
        return _ratio(sums / n, np.sqrt(within / n))  # S24

    def draws() -> Iterator[FloatArray]:
        if every:
            yield from (np.array((1.0, *signs)) for signs in itertools.product((1.0, -1.0), repeat=n - 1))
            return
        rng = np.random.default_rng(seed)
        yield np.ones(n)
        yield from (rng.choice((-1.0, 1.0), n) for _ in range(count - 1))

    t, p, omnibus_p, critical = _permute(maps, area, draws(), count, t_of, progress)
    return MapTest(
        effect=maps.mean(axis=0),
        t=t,
        p=p,
        omnibus_p=omnibus_p,
        permutations=count,
        every=every,
        n=(n,),
        critical_t=critical,
    )


def difference_test(
    maps: FloatArray,
    second: BoolArray,
    area: FloatArray,
    permutations: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
    *,
    unequal_variances: bool = False,
) -> MapTest:
    """Test whether the mean of `maps` (N, V) differs between subjects that are `second` (N,) and those that are not.

    Subjects are permuted between the groups, which assumes equal variances of the groups; with `unequal_variances`
    Welch's t is compared with sign flips of residuals instead. Other arguments are those of `mean_test`; each group has
    two subjects or more.
    """
    n, of_second = len(maps), int(second.sum())
    of_first = n - of_second
    if unequal_variances:
        t, (largest, total) = welch_flips(maps, second, area, permutations, seed)
        p = (len(largest) - np.searchsorted(np.sort(largest), np.abs(t) * (1 - _TIE))) / len(largest)
        omnibus = float((total >= total[0] * (1 - _TIE)).mean())
        effect = maps[second].mean(axis=0) - maps[~second].mean(axis=0)
        return MapTest(
            effect=effect,
            t=t,
            p=p,
            omnibus_p=omnibus,
            permutations=len(largest),
            every=False,
            n=(of_first, of_second),
            critical_t=_critical(largest),
            unequal_variances=True,
        )
    every = math.comb(n, of_second) <= permutations
    count = math.comb(n, of_second) if every else permutations
    centred = maps - maps.mean(axis=0)
    squares = (centred**2).sum(axis=0)

    def contrast(chosen: BoolArray) -> FloatArray:
        return np.where(chosen, 1.0 / of_second, -1.0 / of_first)

    def t_of(difference: FloatArray) -> FloatArray:
        between = difference**2 * of_first * of_second / n
        within = np.maximum(squares - between, _FLOOR * squares) / (n - 2)
        return _ratio(difference, np.sqrt(within * (1.0 / of_first + 1.0 / of_second)))  # S25

    def draws() -> Iterator[FloatArray]:
        yield contrast(second)
        if every:
            own = tuple(np.flatnonzero(second))
            for chosen in itertools.combinations(range(n), of_second):
                if chosen != own:
                    yield contrast(np.isin(np.arange(n), chosen))
            return
        rng = np.random.default_rng(seed)
        yield from (contrast(rng.permutation(second)) for _ in range(count - 1))

    t, p, omnibus_p, critical = _permute(centred, area, draws(), count, t_of, progress)
    return MapTest(
        effect=contrast(second) @ maps,
        t=t,
        p=p,
        omnibus_p=omnibus_p,
        permutations=count,
        every=every,
        n=(of_first, of_second),
        critical_t=critical,
    )


def _permute(
    maps: FloatArray,
    area: FloatArray,
    draws: Iterator[FloatArray],
    count: int,
    t_of: Callable[[FloatArray], FloatArray],
    progress: Callable[[int, int], None] | None,
) -> tuple[FloatArray, FloatArray, float, float]:
    """Return t of the first of `draws`, its p (V,) by the maxima of all draws, the omnibus p and the critical |t|."""
    gram = (maps * area) @ maps.T
    observed, own = np.zeros(maps.shape[1]), 0.0
    maxima: list[float] = []
    as_large = 0
    while block := list(itertools.islice(draws, _BLOCK)):
        weights = np.stack(block)
        t = t_of(weights @ maps)
        overall = np.einsum("pn,nm,pm->p", weights, gram, weights)
        if not maxima:
            observed, own = t[0], float(overall[0])
        maxima += list(np.abs(t).max(axis=1))
        as_large += int((overall >= own * (1 - _TIE)).sum())
        if progress is not None:
            progress(len(maxima), count)
    ordered = np.sort(maxima)
    below = np.searchsorted(ordered, np.abs(observed) * (1 - _TIE))  # S26
    return observed, (len(maxima) - below) / len(maxima), as_large / len(maxima), _critical(ordered)


def _critical(maxima: FloatArray) -> float:
    """Return the value that the largest statistic (P,) exceeds in a share of `LEVEL` of the arrangements."""
    return float(np.sort(maxima)[-(int(LEVEL * len(maxima) * (1 + _TIE)) + 1)])


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    return np.divide(above, below, out=np.zeros_like(above), where=below > 0)
