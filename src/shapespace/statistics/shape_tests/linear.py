"""Tests with linear models of shape: trajectories, pairs of groups, allometry and repeatability.

Equations Mn are those of docs/morphometrics.md.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.schemas import CurvePart, Part, Series, SurfaceMapPart, TablePart
from shapespace.statistics.compare_formula import Design, design_of, quoted
from shapespace.statistics.compare_shapes import (
    CompareConfig,
    angles_between,
    complete_cohort,
    off_common_direction,
    term_tests,
)
from shapespace.statistics.compare_strata import Stratum, independent_stratum, less, means_of, span, without_noise
from shapespace.statistics.methods import REDUCED_OF_EACH_TERM
from shapespace.statistics.shape_tests.permutations import Groups, Orders, Residuals, orders
from shapespace.statistics.shape_tests.shape_test_result import (
    LEVEL,
    ShapeTestResult,
    Statistic,
    pair_statistics,
)
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import BoolArray, FloatArray

_ALIASED = 1e-8  # relative length; columns below it follow from others, and estimates below it are equal
_MOST_COORDINATES = 20_000_000
"""Largest number of size-corrected coordinates to write; with more, only the coefficients are written."""
_BLOCK = 20_000  # vertices at a time; bounds memory


def compare_trajectories(
    cohort: Cohort,
    *,
    group: tuple[str, ...],
    points: str,
    order: tuple[str, ...] = (),
    formula: str | None = None,
    null: str | None = None,
    residuals: Residuals = "scaled",
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Compare the size, orientation and shape of trajectories, as `trajectory.analysis` of RRPP.

    Args:
        cohort: the shapes.
        group: columns whose classes, or combinations of classes, each have a trajectory.
        points: column whose classes are the points of each trajectory, such as age classes.
        order: classes of the points in their order (default: numbers ascending, others alphabetically).
        formula: linear model whose least-squares means are the points (default: group * points).
        null: reduced model whose residuals are permuted, `1` for the mean shape (default: without the last term).
        residuals: `scaled` to the variance of errors, or `raw`, as RRPP, which are smaller than errors.
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a group without shapes at a point, fewer than two points, or models that are not
            nested or leave no residuals.

    Example:
        >>> result = ss.statistics.compare_trajectories(cohort, group=["group"], points="visit", permutations=99)
        >>> result.name
        'trajectory'
    """
    if formula is None:
        formula = " * ".join(_class_factor(cohort, column) for column in (*group, points))
    cohort = _complete_cohort(cohort, [formula, null], [*group, points], drop_missing=drop_missing)
    groups, texts = Groups.of(cohort, group), cohort.table.texts(points)
    stages = order or tuple(sorted(set(texts), key=float if cohort.table.kind(points) == "number" else str))
    if set(stages) != set(texts) or len(stages) < 2 or len(set(stages)) < len(stages):
        raise InputError(
            f"{cohort.table.where}: a trajectory needs two or more points: each class of {points!r} exactly once, "
            f"not {', '.join(stages)[:80]}."
        )
    g, p = len(groups.names), len(stages)
    cells = groups.codes * p + np.array([stages.index(text) for text in texts])
    empty = np.flatnonzero(np.bincount(cells, minlength=g * p) == 0)
    if len(empty):
        raise InputError(
            f"{cohort.table.where}: the group {groups.names[empty[0] // p]!r} has no shape with {points} "
            f"{stages[empty[0] % p]!r}; exclude the group or the point."
        )
    design, reduced, labels = _models(cohort, formula, null)
    estimator = _mean_estimator(design, np.eye(g * p)[cells])
    steps = estimator.reshape(g, p, -1) - estimator.reshape(g, p, -1).mean(axis=1, keepdims=True)
    excess, is_long = _excess(steps, reduced, cohort)
    batches: list[FloatArray] = []
    observed, directions = np.zeros(0), np.zeros((g, 1))
    for means in _permute_estimates(estimator, reduced, cohort, residuals, permutations, seed, progress):
        paths = means.reshape(len(means), g, p, -1)
        observed = observed if observed.size else paths[0]
        length = np.linalg.norm(np.diff(paths, axis=2), axis=3).sum(axis=2)  # M31
        centred = paths - paths.mean(axis=2, keepdims=True)
        axis = _principal_axes(centred)
        if residuals == "scaled":
            axis[bool(not batches) :] = _principal_axes(centred[bool(not batches) :] - excess)
        one, other = np.array(groups.pairs).T
        values = [np.abs(length[:, one] - length[:, other]).T,
                  _directions(axis, 1.0 / (steps**2).sum(axis=(1, 2)), groups, residuals)]  # fmt: skip
        directions = directions if batches else axis[0]
        if p > 2:
            aligned = _align_trajectories(centred)
            values.append(np.linalg.norm(aligned[:, one] - aligned[:, other], axis=(2, 3)).T)
        batches.append(np.array(values))
    names = ("difference of path length", "angle, degrees", "difference of trajectory shape")
    center = observed.mean(axis=(0, 1))
    axes = np.linalg.svd((observed - center).reshape(g * p, -1), full_matrices=False)[2][:2].T
    scores, shown = (observed - center) @ axes, (cohort.coefficients - center) @ axes
    figure = CurvePart(
        title="Trajectories", x="principal component 1 of the points", y="principal component 2",
        series=(*(Series(x=tuple(own[:, 0].tolist()), y=tuple(own[:, -1].tolist()), label=name)
                  for name, own in zip(groups.names, scores, strict=True)),
                Series(x=tuple(shown[:, 0].tolist()), y=tuple(shown[:, -1].tolist()), label="shapes", points=True)),
    )  # fmt: skip
    return _pairs_result(
        "trajectory", cohort, groups, batches, names, (*group, points), labels,
        {"group": list(group), "points": list(stages), "formula": formula, "null": null, "residuals": residuals,
         "permutations": permutations, "seed": seed}, (figure,), directions=directions, is_long=is_long,
    )  # fmt: skip


def _principal_axes(centred: FloatArray) -> FloatArray:
    """Return the first principal axes (b, G, K) of centred trajectories (b, G, P, K), towards the last point (M32)."""
    vectors = np.linalg.eigh(centred @ centred.swapaxes(2, 3))[1][..., -1]
    axis = np.einsum("bgpk,bgp->bgk", centred, vectors)
    axis *= np.where(((centred[:, :, -1] - centred[:, :, 0]) * axis).sum(axis=2) < 0, -1.0, 1.0)[:, :, None]
    return axis


def _directions(vectors: FloatArray, weights: FloatArray, groups: Groups, residuals: Residuals) -> FloatArray:
    """Return the statistics (pairs, b) of the angles of vectors (b, G, K): S10a, or with raw residuals the angles."""
    if residuals == "raw":
        return np.array([angles_between(vectors[:, a], vectors[:, b]) for a, b in groups.pairs])
    return np.array(
        [off_common_direction(vectors[:, a], vectors[:, b], weights[a], weights[b]) for a, b in groups.pairs]
    )


def _excess(estimators: FloatArray, reduced: FloatArray, cohort: Cohort) -> tuple[FloatArray, BoolArray]:
    """Return the excess (G, r, K) of noise in vectors of the reduced model, and whether those of a group exceed noise.

    Args:
        estimators: (G, r, N) of the r vectors of each group, which are shortened together.
        reduced: (N, q) columns of the reduced model.
        cohort: the shapes.
    """
    residual, columns = less(cohort.coefficients, reduced), span(reduced)
    vectors = estimators @ (cohort.coefficients - residual)
    variance = float((residual**2).sum()) / (len(residual) - columns.shape[1])
    noise = variance * ((estimators @ columns) ** 2).sum(axis=(1, 2))
    flat = vectors.reshape(len(vectors), -1)
    own = ((estimators @ cohort.coefficients) ** 2).sum(axis=(1, 2))
    is_long = own > variance * (estimators**2).sum(axis=(1, 2))
    return vectors - without_noise(flat, noise).reshape(vectors.shape), is_long


def _align_trajectories(centred: FloatArray) -> FloatArray:
    """Return trajectories (b, G, P, P) of size 1 rotated to their mean, in the coordinates of the mean (M33)."""
    unit = centred / np.linalg.norm(centred, axis=(2, 3), keepdims=True)
    mean = unit.mean(axis=1, keepdims=True)
    own, target = (_root(part @ part.swapaxes(2, 3)) for part in (unit, mean))
    u, _, vt = np.linalg.svd(target @ own)
    return own @ (u @ vt).swapaxes(2, 3)


def _root(gram: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(gram)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ vectors.swapaxes(-1, -2)


def compare_pairs(
    cohort: Cohort,
    *,
    formula: str,
    group: tuple[str, ...],
    covariate: str | None = None,
    null: str | None = None,
    residuals: Residuals = "scaled",
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Compare each pair of groups by their least-squares means, or by their slopes, as `pairwise` of RRPP.

    Args:
        cohort: the shapes.
        formula: linear model, such as `~ species * site`.
        group: columns whose classes, or combinations of classes, are the groups.
        covariate: column of numbers whose slopes are compared (default: means are, at the mean of all numbers).
        null: reduced model whose residuals are permuted, `1` for the mean shape (default: without the last term).
        residuals: `scaled` to the variance of errors, or `raw`, as RRPP, which are smaller than errors.
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a covariate that is constant within a group, models that are not nested or leave no
            residuals, or groups that are all the same in the model.

    Example:
        >>> result = ss.statistics.compare_pairs(cohort, formula="~ group", group=["group"], permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    numbers = [covariate] if covariate else []
    cohort = _complete_cohort(cohort, [formula, null], group, drop_missing=drop_missing, numbers=numbers)
    groups = Groups.of(cohort, group)
    design, reduced, labels = _models(cohort, formula, null)
    if covariate is None:
        estimator, names = _mean_estimator(design, groups.indicator), ("distance",)
    else:
        lines = _lines(groups.indicator, cohort.table.numbers(covariate), covariate)
        full = _with_constant(design.matrix)
        estimator = np.linalg.pinv(lines)[len(groups.names) :] @ full @ np.linalg.pinv(full)
        names = ("distance", "difference of vector length", "angle, degrees")
    if float(np.ptp(estimator, axis=0).max()) <= _ALIASED * float(np.abs(estimator).max()):
        raise InputError(
            f"In {formula!r} all groups of {' × '.join(group)} have the same {'slope' if covariate else 'mean'}; add "
            f"{'the interaction of the groups with the covariate' if covariate else 'the groups'}."
        )
    batches: list[FloatArray] = []
    directions = estimator @ cohort.coefficients
    excess, is_long = _excess(estimator[:, None], reduced, cohort)
    one, other = np.array(groups.pairs).T
    for vectors in _permute_estimates(estimator, reduced, cohort, residuals, permutations, seed, progress):
        values = [np.linalg.norm(vectors[:, one] - vectors[:, other], axis=2).T]
        if covariate is not None:
            length = np.linalg.norm(vectors, axis=2)
            values.append(np.abs(length[:, one] - length[:, other]).T)
            if residuals == "scaled":
                vectors[bool(not batches) :] -= excess[:, 0]
            values.append(_directions(vectors, 1.0 / (estimator**2).sum(axis=1), groups, residuals))
        batches.append(np.array(values))
    return _pairs_result(
        "pairwise", cohort, groups, batches, names, group, labels,
        {"formula": formula, "group": list(group), "covariate": covariate, "null": null, "residuals": residuals,
         "permutations": permutations, "seed": seed}, directions=directions, is_long=is_long,
    )  # fmt: skip


def analyse_allometry(
    cohort: Cohort,
    *,
    covariate: str = "log_size",
    group: str | None = None,
    separate: bool = False,
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Regress shape on size, test common slopes of groups, and correct shapes for size.

    Args:
        cohort: the shapes.
        covariate: column of numbers, `size`, or `log_size`, the logarithm of centroid size.
        group: column whose classes may differ in mean and slope.
        separate: whether each group has its own slope in predicted lines and size-corrected shapes.
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, a covariate that is constant, too few shapes, or separate slopes without groups.

    Example:
        >>> result = ss.statistics.analyse_allometry(cohort, group="group", permutations=99)
        >>> 0 < result.statistics[0].p <= 1
        True
    """
    if separate and group is None:
        raise InputError("Separate slopes need groups; name their column with --group.")
    formula = quoted(covariate)
    if group is not None:
        formula += f" * {_class_factor(cohort, group)}"
    cohort = _complete_cohort(cohort, [formula], [], drop_missing=drop_missing, numbers=[covariate])
    x, y = cohort.table.numbers(covariate), cohort.coefficients - cohort.coefficients.mean(axis=0)
    classes = ["all"] * len(cohort) if group is None else list(cohort.table.texts(group))
    names = sorted(set(classes))
    indicator = np.array([[label == name for name in names] for label in classes], dtype=np.float64)
    lines, within = _lines(indicator, x, covariate), less(x[:, None], indicator)
    step = StepCounter(3 if group else 1, progress)
    stratum = independent_stratum(cohort.coefficients, design_of(formula, cohort.table))
    tests = list(term_tests(stratum, CompareConfig(permutations=permutations, seed=seed, maps=False), step.add))
    model = lines if separate else np.hstack([indicator, x[:, None]])
    coefficients = np.linalg.pinv(model) @ y
    fitted, slopes = model @ coefficients, coefficients[len(names) :]
    own = slopes[indicator.argmax(axis=1)] if separate else np.repeat(slopes, len(x), axis=0)
    corrected = cohort.coefficients - (x - x.mean())[:, None] * own  # M38
    directions = [(x - x.mean()) @ y, within[:, 0] @ y]
    scores = [y @ direction / max(float(np.linalg.norm(direction)), 1e-300) for direction in directions]  # M36, M37
    line = np.linalg.svd(fitted - fitted.mean(axis=0), full_matrices=False)
    predicted = line[0][:, 0] * line[1][0]
    scores.append(predicted if predicted @ (x - x.mean()) >= 0 else -predicted)
    titles = ("regression score", "common allometric component", "predicted line")
    rows = list(zip(cohort.names, classes, *(column.tolist() for column in (x, *scores)), strict=True))
    tables = (
        TablePart.of("Analysis of variance", ("term", "df", "sum of squares", "R²", "F", "Z", "p"),
                     [(t.term, t.df, t.squares, t.r2, t.f, t.z, t.p) for t in tests], percent=("R²",)),
        TablePart.of("Allometry scores", ("shape", "group", covariate, *titles), rows),
    )  # fmt: skip
    members = [indicator[:, k] > 0 for k in range(len(names))]
    figures = tuple(
        CurvePart(title=title.capitalize(), x=covariate, y=title, series=tuple(
            Series(x=tuple(x[own].tolist()), y=tuple(score[own].tolist()), label=name, points=True, group=k)
            for k, (name, own) in enumerate(zip(names, members, strict=True))))
        for title, score in zip(titles, scores, strict=True)
    )  # fmt: skip
    arrays = {"names": np.array(cohort.names), "groups": np.array(names), "size_corrected_coefficients": corrected,
              "slopes": (slopes @ cohort.basis).reshape(len(slopes), -1, 3)}  # fmt: skip
    if len(cohort) * cohort.reference.size <= _MOST_COORDINATES:
        arrays["size_corrected"] = cohort.reference + (corrected @ cohort.basis).reshape(len(cohort), -1, 3)
    return ShapeTestResult(
        name="allometry", cohort=cohort, classes=(group,) if group else (),
        statistics=[Statistic.of("F", test.arrangements, test.term) for test in tests],
        settings={"covariate": covariate, "group": group, "separate": separate, "permutations": permutations,
                  "seed": seed},
        tables=tables, figures=figures, arrays={"allometry.npz": arrays},
        reduced_model=REDUCED_OF_EACH_TERM if group else (),
        assumptions=("The residuals of each test are those of the model of the terms that do not contain its term.",)
        if group else (),
    )  # fmt: skip


def measure_repeatability(
    cohort: Cohort,
    *,
    subject: str = "subject",
    session: str | None = None,
    permutations: int = 1000,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> ShapeTestResult:
    """Measure repeatability and measurement error of replicates by Procrustes analysis of variance.

    Args:
        cohort: the shapes.
        subject: column of the subjects or specimens that were measured repeatedly.
        session: column of sessions or observers, a systematic factor; each subject must have all sessions.
        permutations: number of permutations, including the observed data.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (done, total).

    Raises:
        InputError: no such column, one subject, no replicates, or subjects without some sessions.

    Example:
        >>> result = ss.statistics.measure_repeatability(cohort, subject="subject", permutations=99)
        >>> result.name
        'repeatability'
    """
    named = [subject, *([session] if session else [])]
    cohort = cohort.complete(named, drop_missing=drop_missing)
    groups = Groups.of(cohort, [subject])
    n, s = len(cohort), len(groups.names)
    if s < 3 or n == s:
        raise InputError(
            f"{cohort.table.where}: repeatability needs three or more subjects and replicates, and {subject!r} has {s} "
            f"values for {n} shapes; name the column of the specimens."
        )
    occasions = None if session is None else Groups.of(cohort, [session])
    if occasions is not None and np.ptp(groups.indicator.T @ occasions.indicator) > 0:
        raise InputError(
            f"{cohort.table.where}: the subjects of {subject!r} have different numbers of shapes of {session!r}; "
            "exclude those without all sessions, or remove --session."
        )
    sessions = np.zeros(n, dtype=np.intp) if occasions is None else occasions.codes
    y = cohort.coefficients - cohort.coefficients.mean(axis=0)
    squares, df, _ = _squares(y, groups.codes, sessions)
    if df[2] < 1:
        raise InputError(f"{cohort.table.where}: no degrees of freedom are left for measurement error; add replicates.")
    # Sums of squares of subjects come from inner products of the residuals of sessions, permuted within sessions.
    away = y - means_of(y, sessions)[sessions]
    stratum = Stratum(name="", shapes=away, matrix=groups.indicator, columns=np.arange(s), terms=(), groups=sessions,
                      removed=0, number=0)  # fmt: skip
    first, second = np.nonzero(groups.indicator @ groups.indicator.T)
    gram, weight, f = away @ away.T, 1.0 / groups.counts[groups.codes[first]], np.empty(permutations)
    step = StepCounter(permutations, progress)
    for start, rows, _ in stratum.arrangements(permutations, seed):
        among = gram[rows[:, first], rows[:, second]] @ weight
        f[start : start + len(rows)] = among / df[0] * df[2] / np.maximum(np.trace(gram) - among, 1e-300)
        step.add(len(rows))
    values = _repeatabilities(y, groups.codes, sessions)
    parts = [groups.codes != k for k in range(s)]
    left_out = [_repeatabilities(y[part], groups.codes[part], sessions[part]) for part in parts]
    statistics = [_jackknife(name, values[name], [part[name] for part in left_out]) for name in values]
    statistics.append(Statistic.of("F", f, subject))
    within = y - means_of(y, groups.codes)[groups.codes]
    error = within - (means_of(within, sessions)[sessions] if df[1] else 0.0)
    if occasions is not None:
        blocks = np.linalg.qr(occasions.indicator - occasions.indicator.mean(axis=0))[0][:, : df[1]]
        drawn = replace(stratum, groups=groups.codes).products(blocks, within, permutations, seed)
        explained = (drawn**2).sum(axis=(1, 2))
        left = np.maximum(squares[1] + squares[2] - explained, 1e-300)
        statistics.append(Statistic.of("F", explained / df[1] * df[2] / left, session or ""))
    sources = (subject, session or "", "measurement error")
    rows = [(name, d, ss, ss / d) for name, d, ss in zip(sources, df, squares, strict=True) if d]
    factor = np.linalg.qr(error)[1] / np.sqrt(df[2])
    basis = cohort.basis.reshape(len(cohort.basis), -1, 3)
    deviation = np.concatenate([
        np.sqrt((np.tensordot(factor, basis[:, k : k + _BLOCK], axes=1) ** 2).sum(axis=(0, 2)))
        for k in range(0, cohort.n_vertices, _BLOCK)
    ])  # fmt: skip
    faces = np.zeros((0, 3), dtype=np.int32) if cohort.faces is None else cohort.faces
    return ShapeTestResult(
        name="repeatability", cohort=cohort, statistics=statistics, classes=named[1:], subject=subject,
        settings={"subject": subject, "session": session, "permutations": permutations, "seed": seed},
        tables=(TablePart.of("Analysis of variance", ("source", "df", "sum of squares", "mean square"), rows),),
        figures=(SurfaceMapPart(title="Standard deviation of measurement", arrays="measurement_error.npz",
                                signed=False, unit=cohort.unit or "units of the coordinates"),),
        arrays={"measurement_error.npz": {"vertices": cohort.reference, "faces": faces, "values": deviation}},
        reduced_model=REDUCED_OF_EACH_TERM if session else (),
    )  # fmt: skip


def _squares(y: FloatArray, subjects: Orders, sessions: Orders) -> tuple[list[float], tuple[int, int, int], float]:
    """Return sums of squares and degrees of freedom of subjects, sessions and error, and shapes per subject (mean)."""
    codes, counts = np.unique(subjects, return_inverse=True, return_counts=True)[1:]
    n, s, m = len(y), len(counts), int(sessions.max())
    y = y - y.mean(axis=0)
    among, between = (float((means_of(y, own)[own] ** 2).sum()) for own in (codes, sessions))
    squares = [among, between if m else 0.0, float((y**2).sum()) - among - (between if m else 0.0)]
    return squares, (s - 1, m, n - s - m), (n - float((counts**2).sum()) / n) / (s - 1)


def _repeatabilities(y: FloatArray, subjects: Orders, sessions: Orders) -> dict[str, tuple[float, float]]:
    """Return intraclass correlations (M39) of shapes, each with the mean number of shapes per subject."""
    (among, between, left), (s, m, free), k = _squares(y, subjects, sessions)
    ms, mw, me = among / s, (between + left) / (m + free), left / max(free, 1)
    out = {"ICC": ((ms - mw) / (ms + (k - 1) * mw), k)}
    if m:
        systematic = k * (m + 1) / len(y) * (between / m - me)
        out["ICC of agreement"] = ((ms - me) / (ms + (k - 1) * me + systematic), k)
        out["ICC of consistency"] = ((ms - me) / (ms + (k - 1) * me), k)
    return out


def _jackknife(name: str, value: tuple[float, float], left_out: Sequence[tuple[float, float]]) -> Statistic:
    """Return an intraclass correlation with the jackknife interval of its Fisher transform."""
    from scipy.special import stdtrit  # loads much

    def transform(r: float, k: float) -> float:
        return 0.5 * float(np.log(max(1 + (k - 1) * r, 1e-12) / max(1 - r, 1e-12)))

    s, center = len(left_out), transform(*value)
    each = np.array([transform(*estimate) for estimate in left_out])
    width = float(stdtrit(s - 1, 1 - LEVEL / 2) * np.sqrt((s - 1) / s * ((each - each.mean()) ** 2).sum()))
    low, high = (
        (ratio - 1) / (ratio + value[1] - 1) for ratio in np.exp(2 * np.array([center - width, center + width]))
    )
    return Statistic(name=name, value=value[0], low=float(low), high=float(high))


def _complete_cohort(
    cohort: Cohort, formulas: Sequence[str | None], columns: Sequence[str], *, drop_missing: bool,
    numbers: Sequence[str] = (),
) -> Cohort:  # fmt: skip
    given = [formula for formula in formulas if formula is not None and formula.strip(" ~") != "1"]
    return complete_cohort(cohort, given, columns, drop_missing=drop_missing, numbers=numbers)


def _class_factor(cohort: Cohort, column: str) -> str:
    return f"C({quoted(column)})" if cohort.table.kind(column) == "number" else quoted(column)


def _with_constant(columns: FloatArray) -> FloatArray:
    return np.column_stack([np.ones(len(columns)), columns])


def _models(cohort: Cohort, formula: str, null: str | None) -> tuple[Design, FloatArray, tuple[str, ...]]:
    """Return the design of the full model, the columns (N, q) of the reduced model, and the terms of the latter."""
    design = design_of(formula, cohort.table)
    full, terms = _with_constant(design.matrix), design.terms[:-1]
    if null is None:
        reduced = _with_constant(design.matrix[:, [c for term in terms for c in term.columns]])
    elif null.strip(" ~") == "1":
        reduced, terms = np.ones((len(cohort), 1)), ()
    else:
        small = design_of(null, cohort.table)
        reduced, terms = _with_constant(small.matrix), small.terms
    rank = int(np.linalg.matrix_rank(full))
    if rank >= len(cohort):
        raise InputError(f"{formula!r} has {rank} columns for {len(cohort)} shapes, which leaves no residuals.")
    if np.linalg.norm(reduced - full @ (np.linalg.pinv(full) @ reduced)) > _ALIASED * np.linalg.norm(reduced):
        raise InputError(
            f"The null model {null!r} must be nested in {formula!r}; remove the terms not contained in it."
        )
    return design, reduced, tuple(term.label for term in terms)


def _mean_estimator(design: Design, indicator: FloatArray) -> FloatArray:
    """Return the (G, N) estimator of least-squares means of groups, with numeric covariates at their mean (M30)."""
    n = len(indicator)
    values = {v.column: design.values[v.column] if v.levels else [v.middle] * n for v in design.variables}
    rows = indicator.T @ _with_constant(design.rows(values)) / indicator.sum(axis=0)[:, None]
    return rows @ np.linalg.pinv(_with_constant(design.matrix))


def _lines(indicator: FloatArray, x: FloatArray, covariate: str) -> FloatArray:
    """Return the columns (N, 2 G) of a line for each group."""
    lines = np.hstack([indicator, indicator * x[:, None]])
    if (np.linalg.norm(less(lines[:, len(indicator.T) :], indicator), axis=0) <= _ALIASED * np.linalg.norm(x)).any():
        if indicator.shape[1] == 1:
            raise InputError(f"{covariate!r} is the same for all shapes, so there is no slope; choose another column.")
        raise InputError(f"{covariate!r} is constant within a group, which has no slope; exclude the group.")
    return lines


def _permute_estimates(
    estimator: FloatArray, reduced: FloatArray, cohort: Cohort, residuals: Residuals, permutations: int, seed: int,
    progress: Progress | None,
) -> Iterator[FloatArray]:  # fmt: skip
    """Yield estimates (b, m, K) of batches, with the residuals of the reduced model permuted (M30)."""
    n = len(cohort)
    residual = less(cohort.coefficients, reduced)
    fixed, step = estimator @ (cohort.coefficients - residual), StepCounter(permutations, progress)
    # Distances and angles are not divided by an error. A sum of permuted residuals has the variance of their squares by
    # n - 1, and that of errors is their squares by n - q.
    scale = float(np.sqrt((n - 1) / (n - np.linalg.matrix_rank(reduced)))) if residuals == "scaled" else 1.0
    for part, rows in orders(n, permutations, seed):
        factor = np.full((len(rows), 1, 1), scale)
        factor[: int(part.start == 0)] = 1.0
        placed = estimator.T[rows].transpose(0, 2, 1).reshape(-1, n) @ residual
        yield fixed + factor * placed.reshape(len(rows), len(estimator), -1)
        step.add(len(rows))


def _pairs_result(
    name: str, cohort: Cohort, groups: Groups, batches: Sequence[FloatArray], names: Sequence[str],
    classes: Sequence[str], reduced_model: tuple[str, ...], settings: dict[str, Any], figures: tuple[Part, ...] = (),
    *, directions: FloatArray, is_long: BoolArray,
) -> ShapeTestResult:  # fmt: skip
    """Return the result of statistics of pairs of groups, from batches (statistics, pairs, b) of permutations.

    Angles are between `directions` (G, K); their arrangements are of another statistic unless residuals are raw. Their
    p is not known for raw residuals, nor if no vector of the pair is longer than its noise, `is_long` (G,).
    """
    values = np.concatenate(batches, axis=2)
    statistics = [
        statistic for name_of_statistic, own in zip(names, values, strict=False)
        for statistic in pair_statistics(name_of_statistic, own, groups.pair_names)
    ]  # fmt: skip
    for k, statistic in enumerate(statistics):
        if statistic.name.startswith("angle"):
            pair = list(groups.pairs[groups.pair_names.index(statistic.tested)])
            if settings["residuals"] == "raw":
                statistics[k] = replace(statistic, p=None, unknown_p="raw residuals")
                continue
            angle = float(angles_between(*directions[pair][:, None])[0])
            statistic = replace(statistic, value=angle, arrangements=np.zeros(0))
            statistics[k] = (
                statistic if is_long[pair].any() else replace(statistic, p=None, z=None, unknown_p="short vectors")
            )
    rows = [
        (own.name, own.tested, own.value,
         float(np.quantile(own.arrangements, 1 - LEVEL)) if len(own.arrangements) else None, own.z, own.p)
        for own in statistics
    ]  # fmt: skip
    table = TablePart.of("Pairs of groups", ("statistic", "groups", "value", "95 % limit", "Z", "p"), rows)
    return ShapeTestResult(
        name=name, cohort=cohort, statistics=statistics, settings=settings, classes=classes, tables=(table,),
        figures=figures, reduced_model=reduced_model,
    )  # fmt: skip
