"""Asymmetry of objects: Procrustes ANOVA with object symmetry, and the distance of each shape from its mirror image.

Klingenberg, Barluenga and Meyer, Evolution 56(10), 2002; Mardia, Bookstein and Moreton, Biometrika 87(2), 2000;
Klingenberg, Symmetry 7(2), 2015. Every shape and its mirror image in correspondence are superimposed together. Half
their sum is the symmetric part of a shape, half their difference the asymmetric one; this module returns the full
difference, which is the distance between the sides.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from shapespace.cohort.cohort import SUBJECT, Cohort, subjects_of
from shapespace.errors import InputError
from shapespace.geometry.normals import vertex_normals
from shapespace.geometry.procrustes import centroid_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.reprs import list_briefly, short_repr
from shapespace.schemas import Methods, SampleSize, TestScheme
from shapespace.statistics.effect_size import effect_size
from shapespace.statistics.methods import AnalysisResult, methods_of
from shapespace.statistics.multiple_imputation import Imputations, over_imputations
from shapespace.statistics.observation_weights import weights_of
from shapespace.statistics.sides import Sides, aligned_shapes, find_sides, given_sides, match_sides
from shapespace.step_counter import Progress, StepCounter
from shapespace.types import BoolArray, FloatArray, Mesh, read_only, require

ERROR_ASYMMETRIC, ERROR_SYMMETRIC = "measurement error, asymmetric", "measurement error, symmetric"
MEASUREMENT_ERROR = "measurement error"
DegreesOfFreedom: TypeAlias = Literal["klingenberg", "observations"]
LEVEL = 0.95  # of confidence intervals, the usual one
_BLOCK = 100  # permutations at a time; bounds memory and spaces the progress messages
_HEIGHT_OFF = 2.0
"""Error of the height of the surface above a triangle, as a share of the height: curvature differs at its corners."""
_FEWEST = 3  # subjects; two leave one degree of freedom
_PAndZ: TypeAlias = tuple[float | None, float | None]
"""p and Z."""
_UNTESTED: _PAndZ = None, None
_MOSTLY = 0.5
"""Share of the shapes of a subject that must observe a vertex, so that it counts as observed."""


@dataclass(frozen=True)
class AnovaRow:
    """A row of the Procrustes ANOVA; sums of squares over all vertices of all shapes and their images.

    Args:
        source: name of the effect: `individual`, `side`, `individual x side`, or the measurement error of either part;
            the sum of the two errors is the row of Klingenberg, who assumes equal error in all directions.
        ss: sum of squares, mm^2.
        df: degrees of freedom: those of the subjects times the dimensions of the shapes (Klingenberg 2002).
        ms: mean square, ss / df.
        f: ms divided by the ms of `individual x side`; for the row `individual x side`, divided by the ms of the
            asymmetric error; None without a divisor.
        p: p value by permutation; None if nothing can be permuted.
        z: F in standard deviations of its permutation distribution, after a Box-Cox transformation; None without p.
        r2: share of the total sum of squares.
    """

    source: str
    ss: float
    df: float
    ms: float
    f: float | None = None
    p: float | None = None
    z: float | None = None
    r2: float = 0.0


@dataclass(frozen=True, eq=False)
class AsymmetryScores:
    """Distance of each of n subjects from its own mirror image, RMS over the vertices.

    Args:
        mm: (n,) distance less the measurement error, if that is known from repeated shapes.
        low, high: (n,) ends of the 95 % interval, by repeated shapes and by the uncertainty of fits; NaN without
            either.
        raw_mm: (n,) distance as measured.
        error_mm: RMS distance that measurement error alone causes in one shape; NaN if not known.
    """

    mm: FloatArray
    low: FloatArray
    high: FloatArray
    raw_mm: FloatArray
    error_mm: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class AsymmetryResult(AnalysisResult):
    """Differences between the sides of n subjects.

    Args:
        cohort: cohort of the N shapes.
        sides: sides of the object, with M vertices.
        subjects: names of the n subjects.
        counts: (n,) number of shapes of each subject.
        mean: (M, 3) the symmetric mean, mm.
        normals: (M, 3) normals of the mean; None for points.
        symmetric: (n, M, 3) the symmetric part of each subject, mm.
        difference: (n, M, 3) each subject less its mirror image, mm: twice the asymmetric part.
        anova: rows of the ANOVA: individual, side, individual x side and, with repeated shapes, measurement error.
        scores: scores along the normals if there are any, else over all directions.
        vertex_scores: scores over all directions.
        z: (n,) scores in standard deviations of the reference group; a member is compared with the other members.
        z_low, z_high: (n,) ends of the interval of `z`, from that of the scores.
        in_reference: (n,) whether a subject is of that group.
        directional: (M,) mean difference along the normals, mm; its length, for points.
        directional_p: (M,) family-wise p of `directional`, by flipping signs.
        permutations: number of permutations.
        seed: seed of the permutations.
        observed: (n, M) bool, False where a subject's vertex, or its mirror image, is an estimate in most of its
            shapes; None if all are observed.
        size_anova: rows of the ANOVA of the centroid sizes of separate sides, with the degrees of freedom of
            `observations`.
        degrees_of_freedom: kind of the degrees of freedom of the ANOVA of shape.
        imputations: imputations that p values combine; None without samples of completed shapes.

    Example:
        >>> surfaces = ss.Cohort.of_shapes([mesh.vertices for mesh in meshes], {}, faces=meshes[0].faces)
        >>> result = ss.statistics.measure_asymmetry(surfaces, permutations=99)
        >>> len(result.subjects)
        6
    """

    cohort: Cohort
    sides: Sides
    subjects: tuple[str, ...]
    counts: npt.NDArray[np.intp]
    mean: FloatArray
    normals: FloatArray | None
    symmetric: FloatArray
    difference: FloatArray
    anova: tuple[AnovaRow, ...]
    scores: AsymmetryScores
    vertex_scores: AsymmetryScores
    z: FloatArray
    z_low: FloatArray
    z_high: FloatArray
    in_reference: npt.NDArray[np.bool_]
    directional: FloatArray
    directional_p: FloatArray
    permutations: int
    seed: int
    observed: BoolArray | None = None
    size_anova: tuple[AnovaRow, ...] = ()
    degrees_of_freedom: DegreesOfFreedom = "klingenberg"
    imputations: Imputations | None = None

    @property
    def observed_share(self) -> FloatArray:
        """(M,) share of the subjects that observe a vertex and its mirror image."""
        return np.ones(len(self.mean)) if self.observed is None else self.observed.mean(axis=0)

    @property
    def blank(self) -> BoolArray | None:
        """(M,) bool, where maps of the group are blank because too few subjects observe both sides; None if nowhere."""
        blank = weights_of(self.observed_share) == 0
        return blank if blank.any() else None

    @cached_property
    def maps(self) -> FloatArray:
        """(n, M) distance of each subject outside its mirror image along the normals, mm; lengths, for points."""
        return _along_normals(self.difference, self.normals)

    @cached_property
    def fluctuating(self) -> FloatArray:
        """(M,) standard deviation of `maps` over the subjects, about the directional asymmetry, mm."""
        if self.normals is None:
            off = self.difference - self.difference.mean(axis=0)
            return np.sqrt((off**2).sum(axis=(0, 2)) / (len(off) - 1))
        return self.maps.std(axis=0, ddof=1)

    @cached_property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        tests: list[TestScheme] = []
        if self.permutations:
            count = 1 + self.permutations
            flipped = ("side", "directional asymmetry of each vertex")
            tests.append(TestScheme(tested=flipped, resampling="sign flips", reduced_model=None, arrangements=count))
            tested = [row.source for row in self.anova if row.p is not None and row.source != "side"]
            if _exchanges_sides(self.sides, self.degrees_of_freedom):
                unit = "mean of a side of a subject"
                tests.append(TestScheme(tested=("individual",), unit=unit, reduced_model=None, arrangements=count))
                tested.remove("individual")
            if tested:
                tests.append(TestScheme(tested=tuple(tested), unit="shape", reduced_model=None, arrangements=count))
        sides = self.sides
        paired = "given or found by mirroring the mean" if sides.paired else "the nearest place of the mirror image"
        compared = (
            f"Shapes of the sides {' and '.join(sides.classes)} of a subject are paired in the order of the table."
            if sides.classes
            else f"Shapes and their mirror images are superimposed together; partners of vertices are {paired}."
        )
        dimensions = " times the dimensions of the shapes, of Klingenberg et al. (2002)"
        freedom = "of the observations" if self.degrees_of_freedom == "observations" else f"of the subjects{dimensions}"
        return methods_of(
            self.cohort, len(self.subjects), vertices=len(self.sides),
            sizes=tuple(
                SampleSize(variables=("shapes of a subject",), classes=(str(count),), subjects=of, shapes=count * of)
                for count, of in sorted(Counter(map(int, self.counts)).items())
            ),
            tests=tuple(tests),
            corrected_over=("the vertices of a map",) if tests else (),
            assumptions=(
                f"{compared} Sums of squares are over all vertices; degrees of freedom are those {freedom}.",
                "Scores in standard deviations are distances from the mean of the reference group, not effect sizes.",
            ),
        )  # fmt: skip

    def effect(self, source: str) -> AnovaRow:
        """Return the row of the ANOVA of that name."""
        return next(effect for effect in self.anova if effect.source == source)

    def __repr__(self) -> str:
        rows = list_briefly([f"{row.source}: p {row.p:.3g}" for row in self.anova if row.p is not None])
        return f"<AsymmetryResult of {len(self.subjects)} subjects, {len(self.cohort)} shapes; {rows or 'no test'}>"


def measure_asymmetry(
    cohort: Cohort,
    *,
    subject: str | None = None,
    pairs: Sequence[tuple[int, int]] | None = None,
    where: str = "The pairs",
    side: str | None = None,
    reference: tuple[str, str] | None = None,
    degrees_of_freedom: DegreesOfFreedom = "klingenberg",
    permutations: int = 999,
    seed: int = 0,
    drop_missing: bool = False,
    progress: Progress | None = None,
) -> AsymmetryResult:
    """Measure the differences between the sides of the objects of a cohort.

    If completed shapes have samples, each imputation is tested too, and p values combine them by Rubin's rules.

    Args:
        cohort: cohort of the shapes; in the gauge `form` millimetres are those of each object.
        subject: column of the subjects; several shapes of a subject measure the measurement error (default: `subject`,
            if the table has it; otherwise each shape is of another subject).
        pairs: pairs of vertices that mirror each other, a vertex on the plane with itself (default: found on the mean).
        where: name of the pairs in messages.
        side: column of the sides if they are separate shapes, such as left and right wings, for matching symmetry
            (default: symmetric objects).
        reference: column and value of the subjects that scores are compared with; None for all.
        degrees_of_freedom: kind of the degrees of freedom of the ANOVA: those of the subjects times the dimensions of
            the shapes (`klingenberg`), or those of the `observations` alone, as in geomorph.
        permutations: number of permutations for p; 0 for none.
        seed: seed of the permutations.
        drop_missing: exclude shapes with missing values in the table (default: an error).
        progress: function called with (permutations done, in all).

    Raises:
        InputError: an object without mirror symmetry, invalid pairs, fewer than three subjects, no such column,
            a subject in two groups, or a reference group of fewer than three.
    """
    require(cohort, Cohort, "measure_asymmetry", "read one with shapespace.read_cohort")
    if permutations < 0 or seed < 0:
        raise InputError("The number of permutations and the seed must be 0 or more.")
    if degrees_of_freedom not in get_args(DegreesOfFreedom):
        raise InputError(f"There are no degrees of freedom {degrees_of_freedom!r}; choose klingenberg or observations.")
    subject = subject or (SUBJECT if SUBJECT in cohort.table.columns else None)
    wanted = [name for name in (subject, reference[0] if reference else None, side) if name]
    cohort = cohort.complete(wanted, drop_missing=drop_missing)
    if side is not None:
        cohort, sides = match_sides(cohort, subject, side)
    else:
        sides = find_sides(cohort) if pairs is None else given_sides(cohort, pairs, where)
    return _measure_sides(
        cohort, sides, subject, reference, degrees_of_freedom, permutations, seed, progress=progress
    )  # fmt: skip


@over_imputations(parts=("anova", "size_anova"))
def _measure_sides(
    cohort: Cohort,
    sides: Sides,
    subject: str | None,
    reference: tuple[str, str] | None,
    degrees_of_freedom: DegreesOfFreedom,
    permutations: int,
    seed: int,
    *,
    progress: Progress | None,
) -> AsymmetryResult:
    """Return the differences between given sides of a cohort's objects; for the arguments see `measure_asymmetry`."""
    if sides.classes:
        first, both = cohort.take(range(len(cohort) // 2)), np.stack([cohort.vertices(k) for k in range(len(cohort))])
    else:
        first, both = cohort, _add_images(cohort, sides)
    names, codes = _subjects(first, subject)
    in_reference = _in_reference(first, names, codes, reference)
    symmetric, difference, mean = _split(first, sides, both)
    pairs_observed = _pairs_observed(cohort, sides)
    counts = np.bincount(codes)
    normals = None if sides.faces is None else vertex_normals(Mesh(mean, sides.faces))
    heights = None
    if normals is not None and not sides.paired:
        heights = sides.chord_heights(mean, normals)
        difference -= heights[:, None] * normals
    rng = np.random.default_rng(seed)

    subjects = _Subjects(codes, counts)
    along = _along_normals(difference, normals) if normals is not None else difference
    own, own_difference = subjects.means(along), subjects.means(difference)
    asymmetry = own[..., None] * normals if normals is not None else own
    fitted = cohort if not sides.classes else replace(first, fitted=None)
    scores = _scores(along, subjects, _shared_error(fitted, sides, mean, asymmetry, subjects))
    vertex_scores = _scores(difference, subjects, _shared_error(fitted, sides, mean, own_difference, subjects))
    z, z_low, z_high = _standardise(scores, in_reference)
    steps = _Steps(4 * permutations, progress)
    parts = symmetric, difference
    if normals is not None and not sides.paired:
        # If each vertex is paired with the place nearest on the mean, differences along the surface cannot be measured.
        parts = _along_normals(symmetric, normals), along
    exchange = _exchanges_sides(sides, degrees_of_freedom)
    if degrees_of_freedom == "klingenberg":
        dimensions = sides.dimensions(scaled=cohort.gauge == "shape")
        anova = _anova(*parts, subjects, dimensions, rng, steps, exchange_sides=exchange)
    else:
        anova = _pooled_anova(*parts, subjects, rng, steps, exchange_sides=exchange)
    size_anova: tuple[AnovaRow, ...] = ()
    if sides.classes and np.isfinite(cohort.sizes_mm).all():
        one, other = cohort.sizes_mm[: len(first), None], cohort.sizes_mm[len(first) :, None]
        middle, own_rng, own_steps = (one + other) / 2, np.random.default_rng(seed), _Steps(4 * permutations, None)
        size_anova = _pooled_anova(middle, one - other, subjects, own_rng, own_steps, exchange_sides=exchange)
    directional = own.mean(axis=0) if normals is not None else np.linalg.norm(own.mean(axis=0), axis=1)
    observed = None if pairs_observed is None else subjects.means(pairs_observed.astype(np.float64)) >= _MOSTLY
    weight = None if observed is None else weights_of(observed.mean(axis=0))
    if heights is not None:
        # Signs do not change the weights, so permutations stay exchangeable.
        known = _known_beyond(own, heights)
        weight = known if weight is None else weight * known
    p = _family_wise_p(own, rng, steps, weight)
    return AsymmetryResult(
        cohort=cohort, sides=sides, subjects=names, counts=counts, mean=mean, normals=normals,
        symmetric=subjects.means(symmetric), difference=own_difference, observed=observed,
        anova=anova, size_anova=size_anova, degrees_of_freedom=degrees_of_freedom,
        scores=scores, vertex_scores=vertex_scores, z=z, z_low=z_low, z_high=z_high, in_reference=in_reference,
        directional=read_only(directional), directional_p=p, permutations=permutations, seed=seed,
    )  # fmt: skip


def _exchanges_sides(sides: Sides, degrees_of_freedom: DegreesOfFreedom) -> bool:
    """Return whether individuals are tested by exchange of sides, rather than of shapes as in geomorph."""
    return bool(sides.classes) and degrees_of_freedom == "klingenberg"


class _Steps(StepCounter):
    """Permutations of the four tests."""

    @property
    def each(self) -> int:
        """The number of permutations of one test."""
        return self.total // 4

    def blocks(self) -> list[int]:
        """Return the sizes of the blocks of permutations that are in memory at once."""
        return [min(_BLOCK, self.each - start) for start in range(0, self.each, _BLOCK)]


@dataclass(frozen=True, eq=False)
class _Subjects:
    """Subjects by number: (N,) the subject of each shape, and (n,) the number of shapes of each."""

    codes: npt.NDArray[np.intp]
    counts: npt.NDArray[np.intp]

    @property
    def shares(self) -> FloatArray:
        """(N, n) weight of each shape in the mean of each subject."""
        out = np.zeros((len(self.codes), len(self.counts)))
        out[np.arange(len(self.codes)), self.codes] = 1.0 / self.counts[self.codes]
        return out

    def means(self, rows: FloatArray) -> FloatArray:
        """Return the means (n, ...) over the shapes of each subject."""
        if (self.counts == 1).all():
            return rows[np.argsort(self.codes)]
        return np.stack([rows[self.codes == k].mean(axis=0) for k in range(len(self.counts))])


def _subjects(cohort: Cohort, column: str | None) -> tuple[tuple[str, ...], npt.NDArray[np.intp]]:
    cells = subjects_of(cohort, column)
    names = tuple(dict.fromkeys(cells))
    number = {name: k for k, name in enumerate(names)}
    codes = np.array([number[cell] for cell in cells])
    if len(names) < _FEWEST:
        raise InputError(
            f"{cohort.table.where}: {len(names)} subjects are too few for asymmetry; {_FEWEST} are the least."
        )
    return names, codes


def _in_reference(
    cohort: Cohort, names: tuple[str, ...], codes: npt.NDArray[np.intp], reference: tuple[str, str] | None
) -> npt.NDArray[np.bool_]:
    if reference is None:
        return np.ones(len(names), dtype=np.bool_)
    column, value = reference
    inside = np.array([cell == value for cell in cohort.table.texts(column)])
    share = np.bincount(codes, weights=inside) / np.bincount(codes)
    if ((share > 0) & (share < 1)).any():
        mixed = names[int(np.flatnonzero((share > 0) & (share < 1))[0])]
        raise InputError(
            f"{cohort.table.where}: some shapes of {mixed} have {column} {value} and others not; give each "
            "subject one value."
        )
    if share.sum() < _FEWEST:
        raise InputError(
            f"{cohort.table.where}: {int(share.sum())} subjects have {column} {value}, and a reference group needs "
            f"{_FEWEST}."
        )
    return share > 0


def _add_images(cohort: Cohort, sides: Sides) -> FloatArray:
    """Return N shapes and their mirror images (2N, M, 3), superimposed."""
    n = len(cohort)
    both = np.empty((2 * n, len(sides), 3))
    for k in range(n):
        both[k] = cohort.vertices(k)[sides.vertices]
    both[n:] = sides.image(both[:n])
    return aligned_shapes(cohort, both)


def _split(cohort: Cohort, sides: Sides, both: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the symmetric parts and differences (N, M, 3) of N superimposed pairs (2N, M, 3), and the mean."""
    n, both = len(cohort), both.copy()
    mean = both.mean(axis=0)
    difference = both[:n] - both[n:]  # S31
    if cohort.analysed is not None:
        # A vertex that no shape observes on both sides contains no information on their difference.
        known = cohort.analysed[sides.vertices]
        known = known & np.logical_or(known[sides.corners], sides.weights == 0).all(axis=1)
        difference[:, ~known] = 0.0
    both[:n] -= difference / 2.0
    return both[:n], difference, mean


def _pairs_observed(cohort: Cohort, sides: Sides) -> BoolArray | None:
    """Return (N, M) whether a shape observes a vertex and its mirror image; None if all are observed."""
    if cohort.observed is None and cohort.analysed is None:
        return None
    own = np.ones((len(cohort), cohort.n_vertices), np.bool_) if cohort.observed is None else cohort.observed
    if cohort.analysed is not None:
        own = np.logical_and(own, cohort.analysed)
    own = own[:, sides.vertices]
    if sides.classes:
        return np.logical_and(own[: len(own) // 2], own[len(own) // 2 :])
    image = np.logical_or(own[:, sides.corners], sides.weights == 0).all(axis=2)
    return np.logical_and(own, image)


def _along_normals(difference: FloatArray, normals: FloatArray | None) -> FloatArray:
    if normals is None:
        return np.linalg.norm(difference, axis=-1)
    return np.einsum("nvd,vd->nv", difference, normals)


def _anova(
    symmetric: FloatArray,
    difference: FloatArray,
    subjects: _Subjects,
    dimensions: tuple[float, float],
    rng: np.random.Generator,
    steps: _Steps,
    *,
    exchange_sides: bool,
) -> tuple[AnovaRow, ...]:
    n, rows = len(subjects.counts), len(subjects.codes)
    flat_s = symmetric.reshape(rows, -1) - symmetric.reshape(rows, -1).mean(axis=0)
    flat_d = difference.reshape(rows, -1)
    mean_d = flat_d.mean(axis=0)
    gram_s, gram_d = flat_s @ flat_s.T, flat_d @ flat_d.T
    off = flat_d - mean_d
    gram_off = off @ off.T
    between = subjects.shares @ (subjects.shares > 0).T
    # A shape and its image lie half of their difference from the symmetric part, one on either side.
    individual = 2.0 * float((between * gram_s).sum())  # S32
    side = rows * float(mean_d @ mean_d) / 2.0  # S33
    both = float((between * gram_off).sum()) / 2.0  # S34
    # S35
    error_s, error_d = 2.0 * float(np.trace(gram_s)) - individual, float(np.trace(gram_off)) / 2.0 - both
    d_sym, d_asym = dimensions
    repeated = rows > n

    sums = np.zeros((n, rows))
    sums[subjects.codes, np.arange(rows)] = 1.0
    p_side = _p_flipping(sums @ gram_d @ sums.T, 2.0 * rows * (side + both), rng, steps)
    p_both = _p_permuting(gram_off, between, rng, steps) if repeated else _UNTESTED
    if exchange_sides:
        p_individual = _p_exchanging(subjects.means(flat_s), subjects.means(off) / 2.0, subjects.counts, rng, steps)
    else:
        p_individual = _p_permuting(gram_s, between, rng, steps) if repeated else _UNTESTED
    total = individual + side + both + error_s + error_d

    def row(source: str, ss: float, df: float, f: float | None = None, p: _PAndZ = _UNTESTED) -> AnovaRow:
        return AnovaRow(source, ss, df, ss / df, f, *p, r2=ss / max(total, 1e-300))

    df_subject, df_both, df_error = (n - 1) * d_sym, (n - 1) * d_asym, (rows - n) * d_asym
    ms_both = both / df_both
    rows_of_table = [
        row("individual", individual, df_subject, _f_ratio(individual / df_subject, ms_both), p_individual),
        row("side", side, d_asym, _f_ratio(side / d_asym, ms_both), p_side),
    ]
    if not repeated:
        return (*rows_of_table, row("individual x side", both, df_both))
    return (
        *rows_of_table,
        row("individual x side", both, df_both, _f_ratio(ms_both, error_d / df_error), p_both),
        row(ERROR_ASYMMETRIC, error_d, df_error),
        row(ERROR_SYMMETRIC, error_s, (rows - n) * d_sym),
    )


def _pooled_anova(
    symmetric: FloatArray, difference: FloatArray, subjects: _Subjects, rng: np.random.Generator, steps: _Steps, *,
    exchange_sides: bool,
) -> tuple[AnovaRow, ...]:  # fmt: skip
    """Return an ANOVA of one dimension with the errors of both parts pooled, as in geomorph."""
    anova = _anova(symmetric, difference, subjects, (1.0, 1.0), rng, steps, exchange_sides=exchange_sides)
    rows, errors = list(anova[:3]), anova[3:]
    if errors:
        ss, df = sum(row.ss for row in errors), sum(row.df for row in errors)
        rows[2] = replace(rows[2], f=_f_ratio(rows[2].ms, ss / df))
        rows.append(AnovaRow(MEASUREMENT_ERROR, ss, df, ss / df, r2=sum(row.r2 for row in errors)))
    return tuple(rows)


def _f_ratio(ms: float, error: float) -> float | None:
    return ms / error if error > 0 else None


def _p_and_z(draw: Callable[[int], FloatArray], observed: float, total: float, steps: _Steps) -> _PAndZ:
    """Return the share of arrangements with as large a statistic as the observed one, and the effect size of F.

    Args:
        draw: function that returns the statistics (k,) of k random arrangements.
        observed: statistic of the data.
        total: sum of the statistic and the divisor of F, the same in all arrangements.
        steps: counter of permutations, advanced after each block.
    """
    if not steps.each:
        return _UNTESTED
    values = [np.array([observed])]
    for count in steps.blocks():
        values.append(draw(count))
        steps.add(count)
    statistic = np.concatenate(values)
    f = statistic / np.maximum(total - statistic, 1e-12 * total + 1e-300)
    return float((statistic >= observed * (1 - 1e-12)).mean()), effect_size(f)


def _p_flipping(gram: FloatArray, total: float, rng: np.random.Generator, steps: _Steps) -> _PAndZ:
    """Test the mean of vectors by random signs; `gram` (n, n) contains their inner products."""

    def draw(count: int) -> FloatArray:
        signs = rng.choice([-1.0, 1.0], (count, len(gram)))
        return np.einsum("pi,pi->p", signs @ gram, signs)

    return _p_and_z(draw, float(gram.sum()), total, steps)


def _p_permuting(gram: FloatArray, between: FloatArray, rng: np.random.Generator, steps: _Steps) -> _PAndZ:
    """Test whether subjects differ by permutation of shapes; `gram` (N, N) has inner products of centred shapes."""

    def draw(count: int) -> FloatArray:
        orders = [rng.permutation(len(gram)) for _ in range(count)]
        return np.array([float((between * gram[np.ix_(order, order)]).sum()) for order in orders])

    return _p_and_z(draw, float((between * gram).sum()), float(np.trace(gram)), steps)


def _p_exchanging(
    middle: FloatArray, half: FloatArray, counts: npt.NDArray[np.intp], rng: np.random.Generator, steps: _Steps
) -> _PAndZ:
    """Test whether the two sides of a subject are alike by pairing them with sides of other subjects.

    Unlike permutations of all shapes, this keeps the difference between a subject's sides, which is the divisor of F.

    Args:
        middle: (n, K) mean of the two sides of each subject, centred.
        half: (n, K) half of their difference, centred.
        counts: (n,) number of shapes per side.
        rng: random generator of the permutations.
        steps: counter of permutations, advanced after each block.
    """
    share = counts / counts.sum()
    one, other = (side - share @ side for side in (middle + half, middle - half))
    cross = (counts[:, None] * one) @ other.T
    lengths = counts[:, None] * (other**2).sum(axis=1)
    own = np.arange(len(one))
    base = float((counts * (one**2).sum(axis=1)).sum())

    def sums(order: npt.NDArray[np.intp]) -> tuple[float, float]:
        return float(cross[own, order].sum()), base + float(lengths[own, order].sum())

    def draw(count: int) -> FloatArray:
        # The ratio of SS_I to SS_I + SS_IS, which has the order of F.
        pairs = np.array([sums(rng.permutation(len(own))) for _ in range(count)])
        return 0.5 + pairs[:, 0] / pairs[:, 1]

    cross_sum, total = sums(own)
    return _p_and_z(draw, 0.5 + cross_sum / max(total, 1e-300), 1.0, steps)


def _known_beyond(own: FloatArray, heights: FloatArray) -> FloatArray:
    """Return weights (M,) of vertices, by how far differences `own` (n, M) exceed the possible error of `heights`."""
    squares = (own**2).mean(axis=0)
    return squares / np.maximum(squares + (_HEIGHT_OFF * heights) ** 2, 1e-300)


def _family_wise_p(
    own: FloatArray, rng: np.random.Generator, steps: _Steps, weight: FloatArray | None = None
) -> FloatArray:
    """Return p (M,) of the mean of fields (n, M) or (n, M, 3), by the permutation maximum over random signs.

    The statistic of a vertex is multiplied by its `weight` (M,), unless that is None.
    """
    n, m = own.shape[:2]
    flat, square = own.reshape(n, -1), (own**2).reshape(n, m, -1).sum(axis=(0, 2))

    def statistic(signs: FloatArray) -> FloatArray:
        between = (signs @ flat / n) ** 2
        between = n * between.reshape(len(signs), m, -1).sum(axis=2)
        ratio = between / np.maximum(square - between, 1e-30 + 1e-12 * square)
        return ratio if weight is None else ratio * weight

    observed = statistic(np.ones((1, n)))[0]
    beyond = np.ones(m)
    for count in steps.blocks():
        most = statistic(rng.choice([-1.0, 1.0], (count, n))).max(axis=1)
        beyond += (most[:, None] >= observed * (1 - 1e-12)).sum(axis=0)
        steps.add(count)
    return read_only(beyond / (1 + steps.each)) if steps.each else read_only(np.full(m, np.nan))


def _shared_error(
    cohort: Cohort, sides: Sides, mean: FloatArray, asymmetry: FloatArray, subjects: _Subjects
) -> FloatArray | None:
    """Return the variance (n,), mm^2, of the length of asymmetries (n, M, 3) by the uncertainty of their fits.

    All scans of a subject share most of this error, as the model's deficits are the same for each; None without fits.
    """
    fitted = cohort.fitted
    if fitted is None:
        return None
    model = fitted.model.mean_vertices[sides.vertices]
    turn = fit_similarity(model, mean, with_scale=False).rotation
    scale = centroid_size(mean) / centroid_size(model)
    modes = fitted.model.vertex_basis.reshape(-1, 3, fitted.model.n_modes)[sides.vertices][:, :, : fitted.b.shape[1]]
    flat = (asymmetry @ turn).reshape(len(asymmetry), -1)
    unit = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    # An asymmetric field is minus its own image, so that a mode and its image do the same to it.
    along = 2.0 * scale * unit @ modes.reshape(unit.shape[1], -1)
    return ((along[subjects.codes] * fitted.b_stddev) ** 2).sum(axis=1) @ subjects.shares


def _scores(fields: FloatArray, subjects: _Subjects, shared: FloatArray | None) -> AsymmetryScores:
    """Return the RMS over the vertices of the subjects' means of `fields` (N, M) or (N, M, 3), less their error.

    The squared length of a mean is that of the truth, and the trace of the error's covariance, and scatters with
    variance 2 tr C^2 + 4 d C d. Solving for the truth gives its interval, as Wilson's does for shares. The error that
    the scans of a subject share, of variance `shared` (n,) along d, widens the interval and is not subtracted.
    """
    vertices, flat = fields.shape[1], fields.reshape(len(fields), -1)
    own = subjects.means(flat)
    squares = np.einsum("nk,nk->n", own, own)
    raw = np.sqrt(squares / vertices)
    df = len(flat) - len(own)
    trace, squared, along = 0.0, 0.0, np.zeros(len(own))
    if df:
        off = flat - own[subjects.codes]
        gram = off @ off.T
        trace = float(np.trace(gram)) / df
        # Correction of the squared sample covariance for its bias with df degrees of freedom (Bai and Saranadasa 1996).
        squared = (float((gram**2).sum()) - df * trace**2) / max((df - 1) * (df + 2), 1)
        squared = max(squared, trace**2 / flat.shape[1])
        along = ((own @ off.T) ** 2).sum(axis=1) / df
    of_mean, of_mean_squared = trace / subjects.counts, squared / subjects.counts**2
    net = squares - of_mean  # S36
    # A mean lies partly along its own error, so that the error scatters it less than the formula states.
    steep = np.maximum(along / subjects.counts - of_mean_squared, 0.0) / np.maximum(net, 1e-30)
    steep = np.where(net > 0, np.minimum(steep, np.sqrt(of_mean_squared)), 0.0)
    steep = steep if shared is None else steep + shared
    normal = NormalDist().inv_cdf(0.5 + LEVEL / 2) ** 2
    middle = net + 2 * normal * steep  # S37
    half = np.sqrt(np.maximum(middle**2 - net**2 + 2 * normal * of_mean_squared, 0.0))

    def mm(square: FloatArray) -> FloatArray:
        return read_only(np.sqrt(np.maximum(square, 0.0) / vertices))

    known = 1.0 if df or shared is not None else np.nan
    error = float(np.sqrt(trace / vertices)) if df else float("nan")
    low, high = (read_only(known * mm(end)) for end in (middle - half, middle + half))
    return AsymmetryScores(mm(net), low, high, read_only(raw), error)


def _standardise(scores: AsymmetryScores, group: npt.NDArray[np.bool_]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return z (n,) of the scores, and of the lower and upper ends of their intervals, relative to the group's scores.

    A member of the group is compared with the other members.
    """
    inside = scores.mm[group]
    n, total, square = len(inside), inside.sum(), (inside**2).sum()
    less = group.astype(np.float64)
    count = n - less
    mean = (total - less * scores.mm) / count
    variance = (square - less * scores.mm**2 - count * mean**2) / np.maximum(count - 1, 1)
    spread = np.sqrt(np.maximum(variance, 0.0))

    def z(value: FloatArray) -> FloatArray:
        return read_only(np.divide(value - mean, spread, out=np.full(len(value), np.nan), where=spread > 0))

    return z(scores.mm), z(scores.low), z(scores.high)


def first_pattern(result: AsymmetryResult) -> tuple[FloatArray, float, FloatArray]:
    """Return the first principal pattern of fluctuating asymmetry.

    Returns:
        (M, 3) change of the difference by one standard deviation of the pattern, mm; its share of the variance; (n,)
        score of each subject, in standard deviations.
    """
    off: Any = (result.difference - result.difference.mean(axis=0)).reshape(len(result.subjects), -1)
    value, vector = np.linalg.eigh(off @ off.T)
    if value[-1] <= 0:
        raise InputError("All subjects are equally asymmetric, so there is no pattern of fluctuating asymmetry.")
    spread = float(np.sqrt(value[-1] / (len(off) - 1)))
    along = vector[:, -1] * np.sqrt(value[-1]) / spread
    pattern = (vector[:, -1] @ off / np.sqrt(value[-1]) * spread).reshape(-1, 3)
    return read_only(pattern), float(value[-1] / value.sum()), read_only(along)
