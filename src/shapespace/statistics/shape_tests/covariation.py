"""Covariation of shape: two-block partial least squares, and integration and modularity of groups of landmarks.

Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.part_cohorts import require_parts, without_relative_pose
from shapespace.errors import FileFormatError, InputError
from shapespace.io.files import read_bytes
from shapespace.io.read_limits import LARGEST_LANDMARK_FILE_BYTES
from shapespace.io.tables.table_io import read_rows
from shapespace.schemas import CurvePart, Series, TablePart
from shapespace.statistics.shape_tests.permutations import Groups, Orders, permuted
from shapespace.statistics.shape_tests.shape_test_result import (
    ShapeTestResult,
    Statistic,
    pair_statistics,
)
from shapespace.statistics.tolerances import RANK
from shapespace.step_counter import Progress
from shapespace.types import FloatArray

_MOST_POINTS = 4_000  # of all modules; the covariances of all pairs then take 0.4 GB
_ANGLES = np.radians(np.arange(0.0, 90.0, 0.05))  # rotations of CR, as in geomorph
_BOOTSTRAP_ANGLES = np.radians(np.arange(-44.0, 45.0, 2.0))  # as in geomorph
_INTERVAL = (2.5, 97.5)  # percentiles of the bootstrap
_BOOTSTRAP_STREAM = 40  # separates the bootstrap from permutations with the same seed
_STEPS = 40  # of the Lanczos iteration; r is accurate to 1e-9, and to 1e-6 for 400 shapes of white noise
_SHOWN = 3  # pairs of axes whose scores are in the table


def fit_pls(
    cohort: Cohort, *, columns: tuple[str, ...] = (), modules: Path | None = None, permutations: int = 1000,
    seed: int = 0, drop_missing: bool = False, progress: Progress | None = None,
) -> ShapeTestResult:  # fmt: skip
    """Fit partial least squares of shape and columns of the table, or of modules (the mean of all pairs).

    Modules of objects of several parts are aligned part by part, so that relative pose is no covariation of shape.

    These are `two.b.pls` and `integration.test` of geomorph: variables are centred and not standardised.

    Args:
        cohort: the shapes.
        columns: columns of numbers, as the first block; shape is the second.
        modules: table of landmark,module or vertex,module with all landmarks, or vertices (from 0), of each module
            (default without columns: the parts of the objects).
        permutations: number of permutations of the shapes in one block, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: columns and modules, or neither for objects of one part, columns that are no numbers, a block
            without variance, or modules that the shapes do not have.

    Example:
        >>> result = ss.statistics.fit_pls(cohort, columns=["age"], permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    if bool(columns) == (modules is not None) and (columns or not cohort.parts):
        raise InputError(
            "Partial least squares needs either --columns of the table as the first block, or --modules or shapes of "
            "several parts."
        )
    cohort = cohort.complete(columns, drop_missing=drop_missing, numbers=columns)
    if columns:
        given = np.column_stack([cohort.table.numbers(column) for column in columns])
        blocks = {"columns": given, "shape": cohort.coefficients}
    else:
        cohort, points = _modules(cohort, modules)
        blocks = {name: _coordinates(cohort, own).reshape(len(cohort), -1) for name, own in points.items()}
    scores, axes = zip(*(_principal_components(name, block) for name, block in blocks.items()), strict=True)
    pairs = list(itertools.combinations(range(len(blocks)), 2))

    def correlations(rows: Orders) -> FloatArray:
        return np.column_stack([_first_correlations(scores[a], scores[b], rows) for a, b in pairs])

    # Threads of many small products wait for one another on a machine with other work.
    with threadpool_limits(1, user_api="blas"):
        values = permuted(len(cohort), permutations, seed, correlations, progress)
    result = ShapeTestResult(
        name="pls" if columns else "integration", cohort=cohort,
        statistics=_mean_and_pairs("r-PLS", values, [f"{a} – {b}" for a, b in itertools.combinations(blocks, 2)]),
        settings={"columns": list(columns), "modules": modules and str(modules), "permutations": permutations,
                  "seed": seed},
    )  # fmt: skip
    if len(blocks) > 2:
        return result
    u, s, vt = np.linalg.svd(scores[0].T @ scores[1] / (len(cohort) - 1), full_matrices=False)  # M40
    left, right = scores[0] @ u, scores[1] @ vt.T
    lengths = np.linalg.norm(left, axis=0) * np.linalg.norm(right, axis=0)
    r, share = (left * right).sum(axis=0) / np.maximum(lengths, 1e-300), s**2 / (s**2).sum()
    directions = axes[0].T @ u, (cohort.basis.T @ axes[1].T if columns else axes[1].T) @ vt.T
    names = [f"{name} {k + 1}" for name in blocks for k in range(min(len(s), _SHOWN))]
    shown = np.hstack([left[:, :_SHOWN], right[:, :_SHOWN]])
    return replace(
        result,
        tables=(
            TablePart.of("Pairs of axes", ("axis", "singular value", "squared covariance", "r"),
                         [(k, *map(float, row)) for k, row in enumerate(zip(s, share, r, strict=True), 1)],
                         percent=("squared covariance",)),
            TablePart.of("Scores", ("shape", *names),
                         [(name, *row) for name, row in zip(cohort.names, shown.tolist(), strict=True)]),
        ),
        figures=(
            CurvePart(title="Scores of the first pair of axes", x=names[0], y=names[len(names) // 2],
                      series=(Series(x=tuple(left[:, 0].tolist()), y=tuple(right[:, 0].tolist()), points=True),)),
        ),
        arrays={"pls.npz": {"singular_values": s, "scores_1": left, "scores_2": right, "loadings_1": directions[0],
                            "loadings_2": directions[1]}},
    )  # fmt: skip


def estimate_modularity(
    cohort: Cohort, *, modules: Path | None = None, permutations: int = 1000, seed: int = 0, drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:  # fmt: skip
    """Estimate modularity by the covariance ratio CR (the mean of all pairs of modules).

    CR depends on the directions of the axes. As in `modularity.test` of geomorph, it is taken at the rotation in the
    plane of x and y (steps of 0.05°) at which it is nearest to its mean over all rotations. Objects of several parts
    are aligned part by part.

    Args:
        cohort: the shapes.
        modules: table of landmark,module or vertex,module with all landmarks, or vertices (from 0), of each module
            (default: the parts of the objects).
        permutations: number of permutations of the points among modules, including the observed data; the interval is
            from as many bootstrap samples of shapes.
        seed: seed of the permutations and the bootstrap.
        drop_missing: has no effect, because no column of the table is used.
        progress: function called with (done, total).

    Raises:
        InputError: modules that these shapes do not have, too many points, or modules without covariances.

    Example:
        >>> result = ss.statistics.estimate_modularity(landmarked, modules="modules.csv", permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    cohort, points = _modules(cohort.complete((), drop_missing=drop_missing), modules)
    flat = [point for own in points.values() for point in own]
    if len(flat) > _MOST_POINTS:
        raise InputError(f"Modules of {len(flat):,} points are too large; choose {_MOST_POINTS:,} of the vertices.")
    groups = Groups(tuple(points), np.repeat(np.arange(len(points)), [len(own) for own in points.values()]))
    x = _coordinates(cohort, flat)
    # Squared norms of the covariances of two points do not change with the axes; variances on the diagonal do.
    norms = np.zeros((len(flat), len(flat)))
    for a, b in itertools.product(range(x.shape[2]), repeat=2):
        norms += (x[:, :, a].T @ x[:, :, b]) ** 2
    variances = _squared_variances([(x[:, :, a] * x[:, :, b]).sum(axis=0) for a, b in _moments(x)])
    own = groups.indicator.T[None]
    ratios = _ratios(own @ norms @ own.transpose(0, 2, 1), _at(own @ variances, _ANGLES), groups)[0].mean(axis=0)
    if not np.isfinite(ratios).all():
        raise InputError(
            f"{modules or 'Parts'}: the points of a module do not covary, so CR is not defined; give it more points."
        )
    angle = _ANGLES[[int(np.abs(ratios - ratios.mean()).argmin())]]
    diagonal = _at(variances, angle)

    def covariance_ratios(rows: Orders) -> FloatArray:
        members = groups.labels(rows)
        return _ratios(members @ norms @ members.transpose(0, 2, 1), members @ diagonal, groups)[:, :, 0]

    values = permuted(len(flat), permutations, seed, covariance_ratios, progress)
    first, *pairs = _mean_and_pairs("CR", values, groups.pair_names, "lower")
    low, high = np.percentile(_bootstrap(x, groups, permutations, seed), _INTERVAL).tolist()
    return ShapeTestResult(
        name="modularity", cohort=cohort, statistics=(replace(first, low=low, high=high), *pairs),
        settings={"modules": modules and str(modules), "rotation_degrees": float(np.degrees(angle[0])),
                  "mean_over_rotations": float(ratios.mean()), "permutations": permutations, "seed": seed},
        assumptions=("CR depends on the axes; it is taken at the rotation about z at which it is nearest to its mean "
                     "over all rotations. Its interval comes from a bootstrap of shapes.",),
    )  # fmt: skip


def compare_effect_sizes(first: Statistic, second: Statistic) -> Statistic:
    """Compare Z of one statistic in two cohorts with a two-sided normal p, as `compare.pls` and `compare.CR`.

    Raises:
        InputError: a statistic without permutations.

    Example:
        >>> results = [ss.statistics.fit_pls(part, columns=["age"], permutations=99) for part in (cohort, landmarked)]
        >>> 0 < ss.statistics.compare_effect_sizes(*(result.statistics[0] for result in results)).p <= 1
        True
    """
    if first.z is None or second.z is None or min(len(first.arrangements), len(second.arrangements)) < 3:
        raise InputError("Effect sizes are compared by Z, which needs permutations; repeat both tests with them.")
    z = (first.z - second.z) / math.sqrt(sum(1 - 1 / (len(own.arrangements) - 1) for own in (first, second)))  # M44
    return Statistic(name=f"difference of Z of {first.name}", value=z, z=z, p=math.erfc(abs(z) / math.sqrt(2)))


def _mean_and_pairs(
    name: str, values: FloatArray, pairs: Sequence[str], tail: Literal["upper", "lower"] = "upper"
) -> list[Statistic]:
    """Return the statistic of the mean of pairs of modules, and those of the pairs if there are several."""
    each = pair_statistics(name, values.T, pairs, tail)
    mean = Statistic.of(name, values.mean(axis=1), f"mean of {len(each)} pairs", tail=tail)
    return each if len(each) == 1 else [mean, *each]


def _modules(cohort: Cohort, path: Path | None) -> tuple[Cohort, dict[str, list[int]]]:
    """Read the points of each module, and return them with the cohort, with a note if points are excluded.

    Without a path modules are the parts, each in its own frame.

    Raises:
        FileError: the file cannot be read, or is no table of modules.
        InputError: fewer than two modules, a module of one point, points that the shapes lack or that are listed twice.
    """
    cohort = without_relative_pose(cohort) if cohort.parts else cohort
    if path is None:
        require_parts(cohort, "Covariation without --modules")
        known = np.ones(cohort.n_vertices, np.bool_) if cohort.analysed is None else cohort.analysed
        own = zip(cohort.parts, cohort.articulation.slices, strict=True)
        return cohort, {name: (s.start + np.flatnonzero(known[s])).tolist() for name, s in own}
    noun = "landmarks" if cohort.source.kind == "landmarks" else "vertices"
    titles, *rows = read_rows(path, read_bytes(path, LARGEST_LANDMARK_FILE_BYTES))
    header = [title.lower() for title in titles]
    if header not in (["landmark", "module"], ["vertex", "module"]):
        raise FileFormatError(f"{path} is no table of modules; write the columns landmark,module or vertex,module.")
    first = int(header[0] == "landmark")  # numbers of landmarks count from 1, those of vertices from 0
    numbers = {str(k + first): k for k in range(cohort.n_vertices)} | (dict(cohort.landmarks or {}) if first else {})
    points = {module: [numbers.get(cell, -1) for cell, own in rows if own == module] for _, module in rows}
    flat = sorted(point for own in points.values() for point in own)
    unknown = [cell for cell, module in rows if cell not in numbers or not module]
    if unknown or len(set(flat)) < len(flat):
        problem = (
            f"{unknown[0][:40]!r} is not in the shapes or has no module"
            if unknown
            else f"a {header[0]} is listed twice"
        )
        raise InputError(f"{path}: list each {header[0]} of the shapes once, with its module; {problem}.")
    if len(points) < 2 or min(map(len, points.values())) < 2 or len(cohort) < 3:
        raise InputError(f"{path}: covariation needs 3 shapes or more, and two modules of two {noun} or more each.")
    if cohort.analysed is not None and not cohort.analysed[flat].all():
        raise InputError(f"{path} lists {noun} that are missing in most shapes; remove them.")
    left = cohort.n_vertices - len(flat)
    note = f"{left:,} of {cohort.n_vertices:,} {noun} belong to no module and are excluded."
    return (replace(cohort, notes=(*cohort.notes, note)) if left else cohort), points


def _coordinates(cohort: Cohort, points: Sequence[int]) -> FloatArray:
    """Return the coordinates (N, m, D) of points less their means, with D 2 or 3."""
    basis = cohort.basis.reshape(len(cohort.basis), -1, 3)[:, list(points), : cohort.dimensions]
    centred: FloatArray = cohort.coefficients - cohort.coefficients.mean(axis=0)
    return np.asarray(np.tensordot(centred, basis, axes=1), dtype=np.float64)


def _principal_components(name: str, block: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return principal component scores (N, P) of a block (N, K), and the axes (P, K).

    Raises:
        InputError: it is the same for all shapes.
    """
    u, s, vt = np.linalg.svd(block - block.mean(axis=0), full_matrices=False)
    kept = s > RANK * float(np.abs(block).max())
    if not kept.any():
        raise InputError(f"The block of {name} is the same for all shapes, so that it does not covary; choose another.")
    return u[:, kept] * s[kept], vt[kept]


def _first_correlations(x: FloatArray, y: FloatArray, rows: Orders) -> FloatArray:
    """Return r-PLS (b,) of blocks x (N, P), with rows in b orders, and y (N, Q) (M41).

    The first singular vector of x[rows]^T y is by Lanczos iteration, for all orders at once.
    """
    if y.shape[1] > x.shape[1]:
        return _first_correlations(y, x, np.argsort(rows, axis=1))
    count, q = len(rows), len(y[0])
    steps, places, gram = min(q, _STEPS), np.argsort(rows, axis=1), x @ x.T

    def scores(v: FloatArray) -> FloatArray:
        return np.take_along_axis(np.take_along_axis(v @ y.T, places, axis=1) @ gram, rows, axis=1)

    vectors, along, across = (np.zeros((count, *shape)) for shape in ((steps + 1, q), (steps,), (steps,)))
    start = np.random.default_rng(0).normal(size=q)
    vectors[:, 0] = start / np.linalg.norm(start)
    for k in range(steps):
        w = scores(vectors[:, k]) @ y
        along[:, k] = (w * vectors[:, k]).sum(axis=1)
        w -= ((vectors[:, : k + 1] @ w[:, :, None]).transpose(0, 2, 1) @ vectors[:, : k + 1])[:, 0]
        across[:, k] = np.linalg.norm(w, axis=1)
        vectors[:, k + 1] = w / np.maximum(across[:, k], 1e-14 * along.max())[:, None]
    index, tridiagonal = np.arange(steps), np.zeros((count, steps, steps))
    tridiagonal[:, index, index] = along
    tridiagonal[:, index[1:], index[:-1]] = across[:, :-1]  # the lower triangle is read
    axis = (np.linalg.eigh(tridiagonal)[1][:, None, :, -1] @ vectors[:, :-1])[:, 0]
    a, b = scores(axis), axis @ y.T
    return (a * b).sum(axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))


def _moments(x: FloatArray) -> list[tuple[int, int]]:
    return [(0, 0), (1, 1), (0, 1), (2, 2)][: 1 + x.shape[2]]


def _squared_variances(moments: Sequence[FloatArray]) -> FloatArray:
    """Return h (..., L, 3): the squared variances of a point sum to h0 + h1 cos 4t + h2 sin 4t at axes turned by t.

    Args:
        moments: (..., L) sums of squares of x, of y, of products x y, and of squares of z if there is one.
    """
    middle, half, mixed = (moments[0] + moments[1]) / 2, (moments[0] - moments[1]) / 2, moments[2]
    constant = 2 * middle**2 + half**2 + mixed**2 + sum(moment**2 for moment in moments[3:])
    return np.stack([constant, half**2 - mixed**2, 2 * half * mixed], axis=-1)


def _at(variances: FloatArray, angles: FloatArray) -> FloatArray:
    """Return the sums (..., A) of `_squared_variances` (..., 3) at A angles."""
    return variances @ np.stack([np.ones(len(angles)), np.cos(4 * angles), np.sin(4 * angles)])


def _ratios(sums: FloatArray, diagonal: FloatArray, groups: Groups) -> FloatArray:
    """Return CR (b, pairs, A) from sums of squared covariances (b, m, m), and squared variances (b, m, A) (M42)."""
    m = sums.shape[1]
    within = sums[:, range(m), range(m), None] - diagonal
    with np.errstate(divide="ignore", invalid="ignore"):
        made = [np.sqrt(sums[:, a, b, None] / np.sqrt(within[:, a] * within[:, b]))
                for a, b in groups.pairs]  # fmt: skip
    return np.stack(made, axis=1)


def _bootstrap(x: FloatArray, groups: Groups, samples: int, seed: int) -> FloatArray:
    """Return CR (samples,), mean over pairs of modules and rotations, of bootstrap samples of shapes (N, L, D).

    Samples are counts of shapes; all sums over the shapes of a sample follow from Gram matrices of the modules.
    """
    n, m = len(x), len(groups.names)
    generator = np.random.default_rng([seed, _BOOTSTRAP_STREAM])
    counts = generator.multinomial(n, np.full(n, 1 / n), size=samples).astype(np.float64)
    blocks = [x[:, groups.codes == k].reshape(n, -1) for k in range(m)]
    grams = [block @ block.T for block in blocks]
    means = [counts @ gram / n for gram in grams]
    sums = np.empty((samples, m, m))
    for a, b in itertools.combinations_with_replacement(range(m), 2):
        totals = (counts * means[a]).sum(axis=1) * (counts * means[b]).sum(axis=1)
        products = ((counts @ (grams[a] * grams[b]) - 2 * n * means[a] * means[b]) * counts).sum(axis=1)
        sums[:, a, b] = sums[:, b, a] = products + totals  # M43
    centres = [counts @ x[:, :, a] for a in range(x.shape[2])]
    moments = [counts @ (x[:, :, a] * x[:, :, b]) - centres[a] * centres[b] / n for a, b in _moments(x)]
    diagonal = _at(groups.indicator.T @ _squared_variances(moments), _BOOTSTRAP_ANGLES)
    return np.nanmean(_ratios(sums, diagonal, groups), axis=(1, 2))
