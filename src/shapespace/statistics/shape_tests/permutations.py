"""Permutations that tests of shape share: orders of rows, residuals of a reduced model, and groups of the table."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.statistics.compare_strata import means_of
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import FloatArray

_BATCH = 50
"""Permutations that are drawn from one seed."""
_STREAM = 22  # separates these permutations from those of other tests with the same seed
_RESAMPLES = 1  # no multiple of the batch, so that bootstrap samples differ from permutations
Orders = npt.NDArray[np.intp]
Residuals: TypeAlias = Literal["scaled", "raw"]
"""That are permuted: scaled to the variance of errors, or raw, as in RRPP and geomorph."""


def orders(n: int, permutations: int, seed: int, stream: int = _STREAM) -> Iterator[tuple[slice, Orders]]:
    """Yield (part of the permutations, (b, n) orders of n rows) in batches; the first order is as observed.

    They are the same on each call, and do not depend on how many are drawn. Tests with other numbers of a `stream` have
    other orders for the same seed.

    Raises:
        InputError: a number of permutations below 1, or a negative seed.
    """
    if permutations < 1 or seed < 0:
        raise InputError(f"There must be 1 or more permutations, and a seed from 0, not {permutations} and {seed}.")
    for start in range(0, permutations, _BATCH):
        count = min(_BATCH, permutations - start)
        rows = np.argsort(np.random.default_rng([seed, stream, start]).random((_BATCH, n)), axis=1)[:count]
        if start == 0:
            rows[0] = np.arange(n)
        yield slice(start, start + count), rows


def permuted(
    n: int, permutations: int, seed: int, statistic: Callable[[Orders], FloatArray],
    progress: Progress | None,
) -> FloatArray:  # fmt: skip
    """Return the (P, ...) statistics of all `orders`; `statistic` is called with batches of orders."""
    step, batches = StepCounter(permutations, progress), list[FloatArray]()
    for _, rows in orders(n, permutations, seed):
        batches.append(statistic(rows))
        step.add(len(rows))
    return np.concatenate(batches)


@dataclass(frozen=True, eq=False)
class Groups:
    """Groups of the shapes of a cohort.

    Args:
        names: names of the groups, in alphabetical order.
        codes: (N,) number of the group of each shape.
    """

    names: tuple[str, ...]
    codes: Orders

    @property
    def counts(self) -> Orders:
        """(G,) number of shapes of each."""
        return np.bincount(self.codes, minlength=len(self.names))

    @property
    def indicator(self) -> FloatArray:
        """(N, G) 1 where a shape is of a group."""
        return (self.codes[:, None] == np.arange(len(self.names))).astype(np.float64)

    @property
    def pairs(self) -> list[tuple[int, int]]:
        """Pairs of groups by number."""
        return [(a, b) for a in range(len(self.names)) for b in range(a + 1, len(self.names))]

    @property
    def pair_names(self) -> list[str]:
        """Pairs of groups in words, such as `female – male`."""
        return [f"{self.names[a]} – {self.names[b]}" for a, b in self.pairs]

    def labels(self, rows: Orders) -> FloatArray:
        """Return (b, G, N) labels, 1 for the members of each group, permuted by orders (b, N)."""
        return (self.codes[rows][:, None, :] == np.arange(len(self.names))[:, None]).astype(np.float64)

    def sums(self, values: FloatArray, rows: Orders) -> FloatArray:
        """Return the (b, G, K) sums of values (N, K) in each group, with members permuted by orders (b, N)."""
        return (self.labels(rows).reshape(-1, len(values)) @ values).reshape(len(rows), len(self.names), -1)

    def residuals(self, values: FloatArray) -> FloatArray:
        """Return the (N, K) differences of values from group means, with a variance that is free of group size."""
        counts = self.counts[self.codes, None]
        return (values - means_of(values, self.codes)[self.codes]) * np.sqrt(counts / (counts - 1))

    def resamples(self, draws: int, seed: int) -> FloatArray:
        """Return how often each shape is drawn (draws, N) in bootstrap samples within each group.

        The first sample contains each shape once.
        """
        rng = np.random.default_rng([seed, _STREAM, _RESAMPLES])
        counts = np.ones((draws, len(self.codes)))
        for g, n in enumerate(self.counts.tolist()):
            counts[1:, self.codes == g] = rng.multinomial(n, [1 / n] * n, size=draws - 1)
        return counts

    @staticmethod
    def of(cohort: Cohort, columns: Sequence[str], *, least: int = 1, why: str = "") -> Groups:
        """Return the groups by the classes of one column, or of several combined as `a.b`.

        Args:
            cohort: cohort with a table without missing values in these columns.
            columns: columns of the table.
            least: smallest number of shapes of a group.
            why: analysis that needs that many, for the message.

        Raises:
            InputError: no such column, fewer than two groups, or a group with too few shapes.
        """
        texts = [cohort.table.texts(column) for column in columns]
        cells = [".".join(parts) for parts in zip(*texts, strict=True)]
        names = tuple(sorted(set(cells)))
        label = " × ".join(columns)
        if len(names) < 2:
            raise InputError(
                f"{cohort.table.where}: {label} is {cells[0][:40]!r} for all {len(cells)} shapes; groups need two "
                "different values."
            )
        number = {name: k for k, name in enumerate(names)}
        groups = Groups(names, np.array([number[cell] for cell in cells], dtype=np.intp))
        small = int(groups.counts.argmin())
        if groups.counts[small] < least:
            raise InputError(
                f"{cohort.table.where}: the group {names[small]!r} of {label} has {groups.counts[small]} "
                f"shape{'s' if groups.counts[small] > 1 else ''}, and "
                f"{why or 'this test'} needs {least} or more; exclude the group, or combine groups."
            )
        return groups
