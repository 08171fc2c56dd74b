"""Tests of groups of shapes: disparity, equality of means and covariance, equivalence, power and discriminants.

Equations Sn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.schemas import TableColumn, TablePart
from shapespace.statistics.compare_formula import columns_of, design_of
from shapespace.statistics.methods import sample_sizes
from shapespace.statistics.shape_tests.permutations import Groups, orders
from shapespace.statistics.shape_tests.shape_test_result import ShapeTestResult, Statistic
from shapespace.statistics.shape_tests.test_table import shape_test
from shapespace.step_counter import StepCounter
from shapespace.types import FloatArray


def compare_disparity(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    formula: str | None = None,
    partial: bool = False,
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> ShapeTestResult:
    """Compare the disparity of groups of shapes, as `morphol.disparity` of geomorph.

    Args:
        cohort: the shapes.
        group: columns whose classes, or combinations of classes, are the groups.
        formula: linear model about whose predictions disparity is measured (default: the mean of all shapes).
        partial: whether to divide sums of squares by the number of all shapes, so that those of the groups add up.
        permutations: number of permutations, including the observed data.
        seed: of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: called with (done, total).

    Raises:
        InputError: no such column, a group of one shape, or a formula that cannot be read.
    """
    named = [*group, *(columns_of(formula, cohort.table) if formula else ())]
    cohort = cohort.complete(named, drop_missing=drop_missing)
    groups = Groups.of(cohort, group, least=2, why="a variance")
    n = len(cohort)
    design = np.ones((n, 1)) if formula is None else np.column_stack(
        [np.ones(n), design_of(formula, cohort.table).matrix]
    )  # fmt: skip
    q = np.linalg.qr(design)[0]
    residual = cohort.coefficients - q @ (q.T @ cohort.coefficients)
    divisor = np.full(len(groups.names), float(n)) if partial else groups.counts.astype(np.float64)
    indicator = groups.indicator / divisor
    # Rows of residuals are permuted, so their squared norms are.
    squares = (residual**2).sum(axis=1)
    variances = np.empty((permutations, len(groups.names)))
    step = StepCounter(permutations, progress)
    for part, rows in orders(n, permutations, seed):
        variances[part] = squares[rows] @ indicator
        step.add(len(rows))
    statistics = [
        Statistic.of(
            "difference of disparity", np.abs(variances[:, a] - variances[:, b]),
            f"{groups.names[a]} – {groups.names[b]}",
        )
        for a, b in groups.pairs
    ]  # fmt: skip
    return ShapeTestResult(
        test=shape_test("disparity"),
        cohort=cohort,
        statistics=tuple(statistics),
        tables=(_disparity_table(groups, variances[0]),),
        settings={"group": list(group), "formula": formula, "partial": partial, "permutations": permutations,
                  "seed": seed},
        sizes=sample_sizes(cohort.names, [(column, cohort.table.texts(column)) for column in group]),
        reduced_model=tuple(term.label for term in design_of(formula, cohort.table).terms) if formula else (),
    )  # fmt: skip


def _disparity_table(groups: Groups, variances: FloatArray) -> TablePart:
    return TablePart(
        title="Disparity",
        columns=(TableColumn(name="group"), TableColumn(name="shapes", kind="count"),
                 TableColumn(name="Procrustes variance", kind="number")),
        rows=tuple(
            (name, int(count), float(value))
            for name, count, value in zip(groups.names, groups.counts, variances, strict=True)
        ),
    )  # fmt: skip
