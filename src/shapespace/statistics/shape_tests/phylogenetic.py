"""Tests of shapes of species on a phylogeny: signal, and generalised least squares.

The shapes of a cohort are those of the tips, one shape for each tip. Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.cohort.cohort import Cohort
from shapespace.io.trees import Tree, read_tree
from shapespace.schemas import TablePart
from shapespace.statistics.compare_formula import Term, design_of
from shapespace.statistics.compare_shapes import CompareConfig, SquaresType, complete_cohort, term_tests
from shapespace.statistics.compare_strata import Stratum, check_error_freedom, check_not_aliased, less
from shapespace.statistics.methods import REDUCED_OF_EACH_TERM
from shapespace.statistics.shape_tests.permutations import Orders, permuted
from shapespace.statistics.shape_tests.shape_test_result import ShapeTestResult, Statistic, pair_statistics
from shapespace.statistics.tolerances import RANK
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import FloatArray

_MOST_AXES = 10  # principal components in the table of signal


def least_squares(covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return weights (N,) whose mean is the state at the root, and the matrix (N, N) of squares about it (M51)."""
    inverse = np.linalg.inv(covariance)
    rows = inverse.sum(axis=0)
    return rows / rows.sum(), inverse - np.outer(rows, rows) / rows.sum()


def inverse_root(covariance: FloatArray) -> FloatArray:
    """Return the symmetric root (N, N) of the inverse of the covariance of species (M50)."""
    values, vectors = np.linalg.eigh(covariance)
    return (vectors / np.sqrt(values)) @ vectors.T


def _match_tree(cohort: Cohort, tree: Tree | Path) -> tuple[Cohort, Tree]:
    """Return the cohort with the notes of the tree, and the tree whose tips are its shapes."""
    own = (tree if isinstance(tree, Tree) else read_tree(tree)).matched(cohort.names)
    return replace(cohort, notes=(*cohort.notes, *own.notes)), own


def ancestral_states(tree: Tree, values: FloatArray) -> FloatArray:
    """Return the maximum-likelihood states (M - T, K) of internal nodes, root first, by Brownian motion (M52).

    Args:
        tree: tree with T tips.
        values: (T, K) states of the tips in their order.
    """
    root = least_squares(tree.covariance)[0] @ values
    shared = tree.paths[len(values) :] @ tree.paths[: len(values)].T
    return root + shared @ np.linalg.solve(tree.covariance, values - root)


def estimate_phylogenetic_signal(
    cohort: Cohort, *, tree: Tree | Path, permutations: int = 1000, seed: int = 0, drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:  # fmt: skip
    """Estimate phylogenetic signal: K of shape (`physignal` of geomorph), and of principal components.

    Args:
        cohort: one shape for each species.
        tree: Newick or Nexus file whose tips have the names of the shapes; other tips are pruned.
        permutations: number of permutations of the shapes over the tips, including the observed data.
        seed: seed of the permutations.
        drop_missing: has no effect, because no column of the table is used.
        progress: function called with (done, total).

    Raises:
        InputError: shapes without tip, fewer than three, or tips without a distance between them.

    Example:
        >>> result = ss.statistics.estimate_phylogenetic_signal(species, tree=tree, permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    cohort, tree = _match_tree(cohort.complete((), drop_missing=drop_missing), tree)
    n = len(cohort)
    u, s, _ = np.linalg.svd(cohort.coefficients - cohort.coefficients.mean(axis=0), full_matrices=False)
    gram, share = (u * s**2) @ u.T, s**2 / (s**2).sum()
    components = (u * s)[:, : min(_MOST_AXES, int((s > RANK * s[0]).sum()))]
    weights, precision = least_squares(tree.covariance)
    expected = (float(np.trace(tree.covariance)) - n * float(weights @ tree.covariance @ weights)) / (n - 1)
    factor = np.linalg.cholesky(precision + 1.0 / n).T  # its squares are those about the root, as rows are centred
    forms = np.column_stack([n * np.outer(weights, weights).ravel(), precision.ravel()])

    def ratios(rows: Orders) -> FloatArray:
        root, squares = np.stack([gram[np.ix_(order, order)].ravel() @ forms for order in rows]).T
        whole = ((s**2).sum() + root) / squares
        roots = np.tensordot(components[rows], weights, axes=(1, 0))
        total = (components**2).sum(axis=0) + n * roots**2
        by_axis = total / ((factor @ components[rows]) ** 2).sum(axis=1)
        return np.column_stack([whole, by_axis]) / expected  # M53

    # Threads of many small products wait for one another on a machine with other work.
    with threadpool_limits(1, user_api="blas"):
        k = permuted(n, permutations, seed, ratios, progress)
    by_axis = pair_statistics("K", k.T[1:], [f"principal component {j}" for j in range(1, k.shape[1])])
    rows = [
        (statistic.tested, float(own), statistic.value, statistic.z, statistic.p)
        for statistic, own in zip(by_axis, share, strict=False)
    ]
    table = TablePart.of("Phylogenetic signal of principal components", ("component", "variance", "K", "Z", "p"), rows,
                         percent=("variance",))  # fmt: skip
    return ShapeTestResult(
        name="signal", cohort=cohort, statistics=[Statistic.of("K", k[:, 0], "shape")], tables=(table,),
        settings={"tree": tree.where, "permutations": permutations, "seed": seed},
        assumptions=("Shapes evolve by Brownian motion along the branches of the tree.",),
    )  # fmt: skip


def fit_pgls(
    cohort: Cohort, *, formula: str, tree: Tree | Path, anova_type: SquaresType = "II", permutations: int = 1000,
    seed: int = 0, drop_missing: bool = False, progress: Progress | None = None,
) -> ShapeTestResult:  # fmt: skip
    """Fit a linear model of shape by phylogenetic generalised least squares, as `procD.pgls` of geomorph.

    Args:
        cohort: one shape for each species.
        formula: linear model such as '~ diet + log_size'.
        tree: Newick or Nexus file whose tips have the names of the shapes; other tips are pruned.
        anova_type: type of the sums of squares: `I`, each term after those before it; `II`, each term after all terms
            that do not contain it; `III`, each term after all others.
        permutations: number of permutations of residuals, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: a formula that cannot be read, terms that follow from others, missing values, shapes without tip,
            tips without a distance between them, or too few shapes.

    Example:
        >>> result = ss.statistics.fit_pgls(species, formula="~ length", tree=tree, permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    config = CompareConfig(anova_type=anova_type, permutations=permutations, seed=seed, maps=False)
    cohort, tree = _match_tree(complete_cohort(cohort, [formula], [], drop_missing=drop_missing), tree)
    design = design_of(formula, cohort.table)
    n, p = len(cohort), len(design.matrix[0])
    check_error_freedom(n - 1, design, "", n, "shapes", p)
    transformation = inverse_root(tree.covariance)  # M55
    constant, columns = transformation.sum(axis=1)[:, None], np.arange(p + 1, dtype=np.intp)
    matrix = transformation @ design.matrix
    check_not_aliased(less(matrix, constant), columns[:p], design.terms, design)
    stratum = Stratum(
        name="", shapes=less(transformation @ cohort.coefficients, constant), matrix=np.hstack([matrix, constant]),
        columns=columns, terms=design.terms, groups=np.zeros(n, dtype=np.intp), removed=0, number=0,
        nuisance=(Term("1", frozenset(), frozenset(), (p,)),),
    )  # fmt: skip
    tests = list(term_tests(stratum, config, StepCounter(len(design.terms), progress).add))
    residual = less(stratum.shapes, stratum.matrix)
    total, left = (float((rows**2).sum()) for rows in (stratum.shapes, residual))
    rows = [*((test.term, test.df, test.squares, test.r2, test.f, test.z, test.p) for test in tests),
            ("residuals", stratum.df_error, left, left / total, None, None, None),
            ("total", n - 1, total, None, None, None, None)]  # fmt: skip
    table = TablePart.of("Phylogenetic analysis of variance", ("term", "df", "SS", "R²", "F", "Z", "p"), rows)
    return ShapeTestResult(
        name="pgls", cohort=cohort, tables=(table,),
        statistics=[Statistic.of("F", test.arrangements, test.term) for test in tests],
        settings={"formula": formula, "tree": tree.where, "anova_type": anova_type, "permutations": permutations,
                  "seed": seed},
        reduced_model=REDUCED_OF_EACH_TERM,
        assumptions=("Residuals evolve by Brownian motion along the branches of the tree.",),
    )  # fmt: skip
