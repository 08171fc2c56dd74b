"""Ordination of shapes: principal components, between-group and phylogenetic components, canonical variates.

Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.io.trees import Tree, read_tree
from shapespace.reprs import short_repr
from shapespace.statistics.compare_strata import means_of
from shapespace.statistics.shape_tests.permutations import Groups, Orders
from shapespace.statistics.shape_tests.phylogenetic import ancestral_states, inverse_root, least_squares
from shapespace.statistics.tolerances import RANK
from shapespace.types import FloatArray, IntArray

OrdinationMethod: TypeAlias = Literal["pca", "between-groups", "cva", "phylogenetic-pca", "paca"]
AXIS_NAMES = {"pca": "PC", "between-groups": "bgPC", "cva": "CV", "phylogenetic-pca": "pPC", "paca": "PAC"}
"""Prefix of the number of an axis, by method."""
_MOST_VARIANCE = 0.95
"""Share of the variance that the default number of components keeps where the within-group covariance is singular."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Ordination:
    """Shapes as scores on the axes of an ordination.

    Args:
        method: method by which the axes were computed.
        cohort: cohort of the shapes that were used.
        axes: (A, K) scores are (coefficients - centre) axes^T.
        shape_axes: (A, K) change of the coefficients per unit of score; equal to `axes` if these are orthonormal.
        centre: (K,) coefficients of the shape at the origin.
        scores: (N, A) scores of the shapes.
        eigenvalues: (A,) variance of the scores of principal components; variance of the group means of between-group
            components; F of canonical variates; of phylogenetic axes the square of `sdev` of geomorph (M54).
        groups: groups of the shapes; None without a variable.
        variable: name of that variable.
        cross_validated: (N, A) scores of each shape on axes computed without it; None without groups.
        predicted: (N,) group of each shape by axes computed without it; None without groups.
        components: principal components that canonical variates are combinations of; None if all are used.
        ancestors: (M, A) scores of the internal nodes of a tree; None without.
        edges: (E, 2) parent and child of each branch: shapes from 0, internal nodes from N; None without.
        notes: sentences on the method.

    Example:
        >>> ordination = ss.statistics.ordinate(cohort)
        >>> bool(ordination.eigenvalues[0] >= ordination.eigenvalues[1])
        True
    """

    method: OrdinationMethod
    cohort: Cohort
    axes: FloatArray
    shape_axes: FloatArray
    centre: FloatArray
    scores: FloatArray
    eigenvalues: FloatArray
    groups: Groups | None = None
    variable: str = ""
    cross_validated: FloatArray | None = None
    predicted: IntArray | None = None
    components: int | None = None
    ancestors: FloatArray | None = None
    edges: IntArray | None = None
    notes: tuple[str, ...] = ()

    __repr__ = short_repr

    @property
    def explained_variance_ratio(self) -> FloatArray:
        """(A,) share of each eigenvalue in their sum."""
        return self.eigenvalues / self.eigenvalues.sum()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the A axes."""
        return tuple(f"{AXIS_NAMES[self.method]}{k + 1}" for k in range(len(self.axes)))

    def group_share(self, scores: FloatArray) -> float:
        """Return the share of the variance of scores (N, A) that lies between the groups (R²).

        Raises:
            InputError: there are no groups.
        """
        if self.groups is None:
            raise InputError("There are no groups, so there is no share of variance between them; give a column.")
        centred = scores - scores.mean(axis=0)
        means = means_of(centred, self.groups.codes)
        return float(self.groups.counts @ (means**2).sum(axis=1) / (centred**2).sum())


_Make: TypeAlias = Callable[..., Ordination]


def ordinate(
    cohort: Cohort,
    *,
    method: OrdinationMethod = "pca",
    group: tuple[str, ...] = (),
    tree: Tree | Path | None = None,
    components: int | None = None,
    drop_missing: bool = False,
) -> Ordination:
    """Compute an ordination of shapes.

    Args:
        cohort: the shapes.
        method: `pca`: principal components; `between-groups`: principal components of the group means; `cva`:
            canonical variates; `phylogenetic-pca`: principal components about the phylogenetic mean; `paca`:
            phylogenetically aligned components.
        group: columns whose classes, or combinations of classes, are the groups.
        tree: phylogeny (Newick or Nexus) whose tips are the shapes; drawn into the plot of principal components.
        components: number of principal components that cva uses. Default: all; if these are too many for the number of
            shapes, those of 95 % of the variance, but at most half of (number of shapes - number of groups).
        drop_missing: exclude shapes with missing values in the table (default: an error).

    Raises:
        InputError: no groups or no tree for a method that needs them, fewer than three shapes, shapes that do not
            differ, or a within-group covariance that is singular.

    Example:
        >>> ss.statistics.ordinate(cohort).scores.shape[0]
        24
    """
    cohort = cohort.complete(group, drop_missing=drop_missing)
    if len(cohort) < 3:
        raise InputError(f"An ordination needs three or more shapes, not {len(cohort)}; add shapes.")
    needs_groups = method in ("between-groups", "cva")
    if needs_groups and not group:
        raise InputError(f"The method {method} needs groups; name a column of the table with --group.")
    if method in ("phylogenetic-pca", "paca") and tree is None:
        raise InputError(f"The method {method} needs a phylogeny; name a Newick or Nexus file with --tree.")
    if components is not None and method != "cva":
        raise InputError("A number of components applies to the method cva alone; remove --components.")
    groups = Groups.of(cohort, group, least=2 if needs_groups else 1, why=method) if group else None
    make: _Make = partial(Ordination, method=method, cohort=cohort, groups=groups, variable=" × ".join(group))
    if tree is not None:
        if needs_groups:
            raise InputError(f"A phylogeny is not drawn into {method}; remove --tree, or take the method pca.")
        return _phylogenetic_axes(cohort, tree, method, make)
    if method == "between-groups" and groups is not None:
        return _between_groups(cohort.coefficients, groups, make)
    if method == "cva" and groups is not None:
        return _canonical_variates(cohort.coefficients, groups, components, make)
    centre, axes, values = principal_components(cohort.coefficients)
    scores = (cohort.coefficients - centre) @ axes.T
    return make(axes=axes, shape_axes=axes, centre=centre, scores=scores, eigenvalues=values)


def principal_components(coefficients: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the mean (K,), the orthonormal axes (A, K) and the variances (A,) of coefficients (N, K).

    The sign of each axis makes the score of largest magnitude positive.

    Raises:
        InputError: the shapes do not differ.
    """
    # M13
    centre = coefficients.mean(axis=0)
    u, s, vt = np.linalg.svd(coefficients - centre, full_matrices=False)
    known = s > RANK * max(s[0], np.finfo(np.float64).tiny)
    if not known.any():
        raise InputError("All shapes are equal, so there are no principal components; check the data.")
    return centre, _orient_axes(u[:, known] * s[known], vt[known]), s[known] ** 2 / (len(coefficients) - 1)


def _between_groups(coefficients: FloatArray, groups: Groups, make: _Make) -> Ordination:
    means, counts = means_of(coefficients, groups.codes), groups.counts
    centre, axes, squares = _between_axes(means, counts)
    known = squares > RANK**2 * float(((coefficients - centre) ** 2).sum())
    if not known.any():
        raise InputError("The means of the groups are equal, so there are no between-group components.")
    axes = _orient_axes((coefficients - centre) @ axes[known].T, axes[known])
    validated, predicted = np.empty((len(coefficients), len(axes))), np.empty(len(coefficients), dtype=np.int32)
    for k, (shape, code) in enumerate(zip(coefficients, groups.codes, strict=True)):
        others, sizes = _group_means_without(means, counts, shape, int(code))
        # M15
        middle, own, _ = _between_axes(others, sizes)
        validated[k] = (shape - middle) @ own.T @ _rotation(own @ axes.T)
        predicted[k] = (((others - shape) @ own.T) ** 2).sum(axis=1).argmin()
    return make(
        axes=axes, shape_axes=axes, centre=centre, scores=(coefficients - centre) @ axes.T,
        eigenvalues=squares[known] / (len(coefficients) - 1), cross_validated=validated, predicted=predicted,
    )  # fmt: skip


def discriminant_components(coefficients: FloatArray, groups: Groups, components: int | None = None) -> int:
    """Return the number of principal components of shapes (N, K) that linear discriminants of groups can use.

    Args:
        coefficients: (N, K) coefficients of the shapes.
        groups: groups of the shapes, two or more shapes in each.
        components: requested number; None for all, or, if the covariance within groups would be singular, for those of
            95 % of the variance, at most half of N - G.

    Raises:
        InputError: more components than the shapes have, or than N - G - 1, which leave-one-out needs.
    """
    free, variances = len(coefficients) - len(groups.names), principal_components(coefficients)[2]
    most = min(len(variances), free - 1)
    if components is None:
        share = variances.cumsum() / variances.sum()
        components = most if most == len(variances) else min(int((share < _MOST_VARIANCE).sum()) + 1, max(free // 2, 1))
    if not 1 <= components <= most:
        raise InputError(
            f"The covariance within {len(groups.names)} groups of {len(coefficients)} shapes is singular with "
            f"{components} principal components; take {f'1 to {most}, or ' if most > 0 else ''}more shapes."
        )
    return components


def _canonical_variates(coefficients: FloatArray, groups: Groups, components: int | None, make: _Make) -> Ordination:
    n, n_groups, counts = len(coefficients), len(groups.names), groups.counts
    used = discriminant_components(coefficients, groups, components)
    centre, all_axes, _ = principal_components(coefficients)
    values = (coefficients - centre) @ all_axes[:used].T
    residual = values - means_of(values, groups.codes)[groups.codes]
    # M16
    _, s, vt = np.linalg.svd(residual / np.sqrt(n - n_groups), full_matrices=False)
    if s[-1] <= RANK * np.linalg.norm(values):
        raise InputError(
            f"The covariance within groups is singular: in some direction of {used} principal components the shapes of "
            "each group are equal; take fewer with --components."
        )
    whitened = values @ (vt.T / s)
    means = means_of(whitened, groups.codes)
    _, rotation, squares = _between_axes(means, counts)
    rotation = _orient_axes(whitened @ rotation.T, rotation)
    validated, predicted = np.empty((n, len(rotation))), np.empty(n, dtype=np.int32)
    for k, (shape, code) in enumerate(zip(whitened, groups.codes, strict=True)):
        others, sizes = _group_means_without(means, counts, shape, int(code))
        # M17: without this shape, the covariance within groups changes by a matrix of rank one.
        away = shape - means[code]
        lost = away @ away * counts[code] / (sizes[code] * (n - n_groups))
        change = (1 / np.sqrt(1 - lost) - 1) / max(away @ away, np.finfo(np.float64).tiny)
        rows = np.vstack([others, shape]) * np.sqrt((n - 1 - n_groups) / (n - n_groups))
        rows += change * np.outer(rows @ away, away)
        middle, own, _ = _between_axes(rows[:-1], sizes)
        validated[k] = (rows[-1] - middle) @ own.T @ _rotation(own @ rotation.T)
        predicted[k] = (np.log(counts) - ((rows[:-1] - rows[-1]) ** 2).sum(axis=1) / 2).argmax()
    axes = rotation @ (vt / s[:, None]) @ all_axes[:used]
    is_reduced = used < len(all_axes)
    note = f"Canonical variates are of {used} of {len(all_axes)} principal components."
    return make(
        axes=axes, shape_axes=(rotation * s) @ vt @ all_axes[:used], centre=centre,
        scores=(coefficients - centre) @ axes.T, eigenvalues=squares / (n_groups - 1), cross_validated=validated,
        predicted=predicted, components=used if is_reduced else None, notes=(note,) if is_reduced else (),
    )  # fmt: skip


def _phylogenetic_axes(cohort: Cohort, tree: Tree | Path, method: str, make: _Make) -> Ordination:
    """Return axes of species as `gm.prcomp` of geomorph, with their ancestors."""
    tree = (tree if isinstance(tree, Tree) else read_tree(tree)).matched(cohort.names)
    is_phylogenetic, values = method == "phylogenetic-pca", cohort.coefficients
    centre = least_squares(tree.covariance)[0] @ values if is_phylogenetic else values.mean(axis=0)
    weighted = inverse_root(tree.covariance) @ (values - centre) if is_phylogenetic else values - centre
    s, vt = np.linalg.svd(tree.covariance @ weighted if method == "paca" else weighted, full_matrices=False)[1:]
    axes = vt[s > RANK * s[0]]
    scores = (values - centre) @ axes.T
    variances = s**2 * float((weighted**2).sum() / (s**2).sum()) / (len(values) - 1)  # M54
    return make(
        axes=axes, shape_axes=axes, centre=centre, scores=scores, eigenvalues=variances[: len(axes)],
        ancestors=ancestral_states(tree, scores), edges=tree.edges, notes=tree.notes,
    )  # fmt: skip


def _between_axes(means: FloatArray, counts: Orders) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the centre (K,), axes (A, K) and sums of squares (A,) of group means (G, K), weighted by group size."""
    # M14
    centre = counts @ means / counts.sum()
    _, s, vt = np.linalg.svd(np.sqrt(counts)[:, None] * (means - centre), full_matrices=False)
    return centre, vt[: len(counts) - 1], s[: len(counts) - 1] ** 2


def _group_means_without(means: FloatArray, counts: Orders, shape: FloatArray, code: int) -> tuple[FloatArray, Orders]:
    """Return the means (G, K) and counts (G,) of groups without a shape (K,) of the group `code`."""
    others, sizes = means.copy(), counts.copy()
    sizes[code] -= 1
    others[code] -= (shape - means[code]) / sizes[code]
    return others, sizes


def _orient_axes(scores: FloatArray, axes: FloatArray) -> FloatArray:
    """Return axes (A, K) whose score (N, A) of largest magnitude is positive."""
    largest = scores[np.abs(scores).argmax(axis=0), np.arange(len(axes))]
    return np.where(largest < 0, -1.0, 1.0)[:, None] * axes


def _rotation(overlap: FloatArray) -> FloatArray:
    """Return the rotation (A', A) of axes onto others, from their products (A', A)."""
    u, _, vt = np.linalg.svd(overlap, full_matrices=False)
    return u @ vt
