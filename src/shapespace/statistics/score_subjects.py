"""Scores of new subjects against a reference population: distances, percentiles, maps, and off-model variation.

Each subject of the reference is held out in turn and scored against the others in the same way as a new subject, so
that the percentiles are valid for any distribution of the distances (Vovk, Gammerman and Shafer, Algorithmic Learning
in a Random World, 2005; with refitting, Barber et al., Annals of Statistics 49(1), 2021).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import fdtrc

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import list_names
from shapespace.errors import CorrespondenceError, InputError
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.geometry.normals import vertex_normals
from shapespace.geometry.procrustes import centroid_size
from shapespace.reprs import list_briefly
from shapespace.schemas import Methods, SampleSize, SurfaceReview, TestScheme
from shapespace.statistics.methods import AnalysisResult, methods_of
from shapespace.statistics.multiple_imputation import Imputations, over_imputations
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, read_only, require

FEWEST_PEOPLE, SMALL = 5, 30
"""Smallest number of people of a reference, and the number below which the result notes that it is small."""

LEVEL = 0.05  # share of people of the reference beyond the limit of the maps
# share of variance of the modes, people per mode that estimate its variance, and folds (each costs a decomposition)
_SHARE, _PEOPLE_PER_MODE, _MOST_FOLDS = 0.95, 5, 100
# least shrinkage, which is divided by; and the ratio of shrinkages above which fits count as equally precise
_LEAST_SHRINKAGE, _EQUALLY_PRECISE = 1e-4, 0.95
_VERTICES_AT_ONCE = 2000  # vertices at a time; bounds memory
_SAME = 1e-6  # share of the size; two different scans never agree to rounding
_MEANS = ("distance", "farther", "rest_mm", "rest_farther", "size_mm", "size_z", "z")
"""Scores that are means over imputations."""
_OUTSIDE = 0.01  # share of the reference beyond a subject from which it is reported as outside


@dataclass(frozen=True, kw_only=True)
class ScoreConfig:
    """Options of the scores against a reference.

    Args:
        modes: number of modes of the reference (default: those of 95 % of its variance, at most one per five subjects).
        subject: column of the subjects in both tables, if subjects have several scans.
        nearest: number of nearest subjects of the reference to name.
        draws: number of draws of the reference, each with the precision of the scored fit.
        seed: seed of the draws of uncertain fits.
        drop_missing: exclude shapes with missing values in the table (default: an error).
    """

    modes: int | None = None
    subject: str | None = None
    nearest: int = 3
    draws: int = 20
    seed: int = 0
    drop_missing: bool = False

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError("The seed must be 0 or more.")


@dataclass(frozen=True, eq=False)
class NearestReference:
    """A person of the reference near a subject: name, distance in standard deviations, and RMS distance in mm."""

    name: str
    distance: float
    rms_mm: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ScoreResult(AnalysisResult):
    """Scores of M subjects against a reference of N scans of P people.

    Args:
        names: names of the subjects.
        reference_names: names of the N scans of the reference.
        people: number P of people in the reference.
        modes: number q of modes of the reference.
        variance_share: share of the reference's variance in these modes.
        mean: the reference's mean shape, mm.
        distance: (M,) Mahalanobis distances in the modes, with each fit's own uncertainty.
        farther: (M,) share of people as far out or farther when held out, among those of the reference and the subject,
            from 1 / (P + 1) to 1; a p value.
        p_value: (M,) p value of the distance by the F distribution of normal shapes.
        rest_mm: (M,) RMS over the vertices of the variation outside the modes, mm.
        rest_farther: (M,) as `farther`, for `rest_mm`.
        beyond_mm: (M,) RMS of the residuals that the model of the fit does not explain, mm; NaN if not known.
        beyond_farther: (M,) as `farther`, for `beyond_mm`; NaN if not known.
        size_mm: (M,) centroid sizes; NaN if not known.
        size_z: (M,) sizes in standard deviations of the reference's; NaN if not known.
        z: (M, V) displacement along the mean's normals in standard deviations, outwards positive; not-a-number where a
            subject's vertex is an estimate without samples.
        z_limit: |z| below which 95 % of the reference's people stay everywhere when held out; NaN for fewer than 19.
        nearest: nearest shapes of the reference, for each subject.
        outside: reasons why the score of each subject may not describe its shape: its shape is outside the modes of the
            reference or the model of its fit, or its fit is doubtful; empty if there are none.
        reference_distance: (N,) Mahalanobis distance of each shape of the reference from the others.
        reference_rest_mm: (N,) as `rest_mm`, for each shape of the reference.
        subjects: cohort of the scored subjects.
        config: options of the scoring.
        notes: excluded shapes with the reasons, and further remarks.
        imputations: imputations that scores combine; None without samples of completed shapes.
        review: number of the surfaces of reference and subjects that need review.

    Example:
        >>> result = ss.statistics.score(cohort.take(range(20)), cohort.take(range(20, 24)))
        >>> result.distance.shape
        (4,)
    """

    names: tuple[str, ...]
    reference_names: tuple[str, ...]
    people: int
    modes: int
    variance_share: float
    mean: Mesh
    distance: FloatArray
    farther: FloatArray
    p_value: FloatArray
    rest_mm: FloatArray
    rest_farther: FloatArray
    beyond_mm: FloatArray
    beyond_farther: FloatArray
    size_mm: FloatArray
    size_z: FloatArray
    z: FloatArray
    z_limit: float
    nearest: tuple[tuple[NearestReference, ...], ...]
    outside: tuple[tuple[str, ...], ...]
    reference_distance: FloatArray
    reference_rest_mm: FloatArray
    subjects: Cohort
    config: ScoreConfig
    notes: tuple[str, ...]
    imputations: Imputations | None = None
    review: SurfaceReview = field(default_factory=SurfaceReview)

    @property
    def percentile(self) -> FloatArray:
        """(M,) Percent of the reference's people who lie nearer to its mean."""
        return read_only(100 * (1 - self.farther))

    @property
    def beyond_2(self) -> FloatArray:
        """(M,) Share of the observed vertices beyond 2 standard deviations."""
        return read_only((np.abs(self.z) > 2).sum(axis=1) / np.maximum(np.isfinite(self.z).sum(axis=1), 1))

    @property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        sizes = (
            SampleSize(
                variables=("cohort",), classes=("reference",), subjects=self.people, shapes=len(self.reference_names)
            ),
            SampleSize(variables=("cohort",), classes=("scored",), subjects=len(self.names), shapes=len(self.subjects)),
        )
        return methods_of(
            self.subjects, len(self.names), dimensions=self.modes, analysed_variance_ratio=self.variance_share,
            sizes=sizes,
            review=self.review,
            tests=(
                TestScheme(tested=("percentiles",), statistic="Mahalanobis distance",
                           resampling="leave-one-out"),
                TestScheme(tested=("Mahalanobis distance",), statistic="F", resampling="none"),
            ),
            corrected_over=("the vertices of a map (limit of |z|)",),
            assumptions=(
                f"The reference has {len(self.reference_names)} shapes of {self.people} subjects. Percentiles leave "
                "each subject of the reference out in turn and assume no distribution; p by the F distribution assumes "
                "normal shapes. z of vertices and sizes are standard deviations of the reference, not effect sizes.",
            ),
        )  # fmt: skip

    def __repr__(self) -> str:
        percentiles = list_briefly(
            [f"{name}: percentile {value:.0f}" for name, value in zip(self.names, self.percentile, strict=True)]
        )
        return (
            f"<ScoreResult of {len(self.names)} shapes against {len(self.reference_names)} of {self.people} subjects, "
            f"{self.modes} modes; {percentiles}>"
        )


def score(
    reference: Cohort,
    subjects: Cohort,
    config: ScoreConfig | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> ScoreResult:
    """Return scores of `subjects` against the population that `reference` is a sample of.

    Distances are measured in q principal components of the reference, by its covariance there and the fit's own
    uncertainty: d^2 = y' (S (1 + 1 / P) + D)^-1 y. For the percentiles each person of the reference is held out, made
    as uncertain as the subject, and measured by the others; of more than 100 people, a hundredth at a time.

    If completed shapes have samples, scores are means over the imputations, in the same number of modes, with a
    standard deviation by Rubin's rules.

    Args:
        reference: N shapes.
        subjects: M shapes, read with `onto=reference`.
        config: options; None for the defaults.
        progress: function called with (done, total).

    Raises:
        InputError: fewer than five people, too many modes, cohorts of different models or gauges, a subject who is in
            the reference, or missing values in the column of subjects.
        CorrespondenceError: shapes of different vertices.
    """
    require(reference, Cohort, "score", "read one with shapespace.read_cohort")
    require(subjects, Cohort, "score", "read one with shapespace.read_cohort")
    config = config or ScoreConfig()
    if config.subject is not None:
        reference = reference.complete([config.subject], drop_missing=config.drop_missing)
        subjects = subjects.complete([config.subject], drop_missing=config.drop_missing)
    _check_comparable(reference, subjects)
    modes = _modes(reference, _people(reference, config.subject), config.modes)
    return _score_shapes(reference, subjects, config, modes, progress=progress)


def _update(result: ScoreResult) -> ScoreResult:
    """Return scores whose sentences agree with the combined scores."""
    return replace(result, outside=tuple(tuple(_describe_outside(result, k)) for k in range(len(result.names))))


@over_imputations(means=_MEANS, finish=_update)
def _score_shapes(
    reference: Cohort,
    subjects: Cohort,
    config: ScoreConfig,
    modes: int,
    *,
    progress: Callable[[int, int], None] | None,
) -> ScoreResult:
    """Return the scores in a given number of modes; for the arguments see `score`."""
    people = _people(reference, config.subject)
    own, outside_basis = _in_basis_of(reference, subjects)
    _check_not_in_reference(reference, subjects, own, outside_basis, config.subject)
    if progress is not None:
        progress(0, len(subjects))
    population = _Population(reference, people, modes)
    theirs, ours = _FitUncertainty.of(reference), _FitUncertainty.of(subjects)
    notes = [*reference.notes, *(note for note in subjects.notes if note not in reference.notes)]
    if theirs is None or ours is None or not np.array_equal(theirs.prior, ours.prior):
        if reference.fitted is not None:
            notes.append("The uncertainty of each fit was not taken into account; that needs coefficients of fits.")
        theirs = ours = None
    m, draws = len(subjects), _draws(theirs, config)
    measures = np.empty((5, m))
    nearest: list[tuple[NearestReference, ...]] = []
    plain = None if theirs is not None else population.left_out(reference.coefficients[None], None)
    for k in range(m):
        noise = None
        if theirs is not None and ours is not None:
            noise = ours.covariance(k)
            d2, rest = population.left_out(theirs.degraded(reference.coefficients, ours.shrinkage[k], draws), noise)
        else:
            d2, rest = plain if plain is not None else population.left_out(reference.coefficients[None], None)
        y = population.distribution.scores(own[k])
        own_d2 = float(population.distribution.squared(y[None], noise)[0])
        left = float(np.sum((own[k] - population.distribution.mean) ** 2) - y @ y) + outside_basis[k]
        own_rest = float(population.rms(np.array(left)))
        measures[:, k] = (
            np.sqrt(own_d2), population.share(d2 >= own_d2), population.p_value(own_d2),
            own_rest, population.share(rest >= own_rest),
        )  # fmt: skip
        nearest.append(_nearest_references(population, reference, own[k], outside_basis[k], noise, config.nearest))
        if progress is not None:
            progress(k + 1, m)
    beyond = np.array([_residual_rms_mm(subjects), np.full(m, np.nan)])
    theirs_beyond = _residual_rms_mm(reference)
    if np.isfinite(theirs_beyond).all():
        for k in np.flatnonzero(np.isfinite(beyond[0])):
            beyond[1, k] = population.share(theirs_beyond[None] >= beyond[0, k])
    own_d2, own_rest = population.left_out(reference.coefficients[None], None if theirs is None else theirs.typical())
    z, limit = _maps(reference, subjects, people, ours)
    sizes = reference.sizes_mm
    size_z = (subjects.sizes_mm - sizes.mean()) / max(float(sizes.std(ddof=1)), 1e-12)
    scores = ScoreResult(
        names=subjects.names, reference_names=reference.names, people=population.people, modes=population.modes,
        variance_share=population.variance_share,
        mean=Mesh(reference.vertices(population.distribution.mean), reference.faces, name="mean"),
        distance=read_only(measures[0]), farther=read_only(measures[1]), p_value=read_only(measures[2]),
        rest_mm=read_only(measures[3]), rest_farther=read_only(measures[4]), beyond_mm=read_only(beyond[0]),
        beyond_farther=read_only(beyond[1]), size_mm=subjects.sizes_mm, size_z=read_only(size_z), z=z, z_limit=limit,
        nearest=tuple(nearest), outside=(), reference_distance=read_only(np.sqrt(own_d2[0])),
        reference_rest_mm=read_only(own_rest[0]), subjects=subjects, config=config,
        review=reference.review + subjects.review, notes=(*notes, *_size_notes(population.people)),
    )  # fmt: skip
    return replace(scores, outside=tuple(tuple(_describe_outside(scores, k)) for k in range(m)))


def _check_comparable(reference: Cohort, subjects: Cohort) -> None:
    if reference.n_vertices != subjects.n_vertices:
        raise CorrespondenceError(
            f"The subjects have {subjects.n_vertices} vertices and the reference {reference.n_vertices}; fit both with "
            "one model, or bring both into correspondence together."
        )
    if reference.gauge != subjects.gauge:
        raise InputError(
            f"The reference is in the gauge {reference.gauge}, the subjects in {subjects.gauge}; use the same for both."
        )
    if (reference.fitted is None) != (subjects.fitted is None):
        raise InputError("Fits cannot be compared with other surfaces; fit both with one model.")
    if reference.fitted is not None and subjects.fitted is not None:
        own, other = reference.fitted.model.content_hash, subjects.fitted.model.content_hash
        if own != other:
            raise InputError(
                f"The subjects are fits by another model ({other[:12]}) than the reference ({own[:12]}); fit all scans "
                "with one model."
            )


def _people(reference: Cohort, column: str | None) -> IntArray:
    """Return (N,) a number for each person of the reference."""
    who = reference.names if column is None else reference.table.texts(column)
    codes = np.unique(np.array(who), return_inverse=True)[1].ravel()
    count = int(codes.max()) + 1
    if count < FEWEST_PEOPLE:
        raise InputError(
            f"A reference of {count} {'shapes' if column is None else 'subjects'} is too small to estimate the "
            f"variation; give {FEWEST_PEOPLE} or more, better {SMALL} and more."
        )
    return codes.astype(np.int32)


def _modes(reference: Cohort, people: IntArray, wanted: int | None) -> int:
    """Return the number of principal components of the reference in which distances are measured."""
    count = int(people.max()) + 1
    centred = reference.coefficients - reference.coefficients.mean(axis=0)
    variance = np.linalg.svd(centred, compute_uv=False) ** 2
    there = int((variance > 1e-12 * variance.sum()).sum())
    most = min(there, count - 3)
    if wanted is not None:
        if not 1 <= wanted <= most:
            raise InputError(f"A reference of {count} subjects has 1 to {most} modes, not {wanted}.")
        return wanted
    enough = int(np.searchsorted(np.cumsum(variance) / variance.sum(), _SHARE)) + 1
    return max(1, min(enough, count // _PEOPLE_PER_MODE, most))


def _in_basis_of(reference: Cohort, subjects: Cohort) -> tuple[FloatArray, FloatArray]:
    """Return the subjects' coefficients (M, K) in the reference's basis, and the squares (M,) of the rest."""
    into = subjects.basis @ reference.basis.T
    shift = (subjects.reference - reference.reference).ravel()
    own = subjects.coefficients @ into + reference.basis @ shift
    squared = [float(np.sum((subjects.vertices(k) - reference.reference) ** 2)) for k in range(len(subjects))]
    left = np.array(squared) - (own**2).sum(axis=1)
    # A rest below rounding is zero.
    return own, np.where(left > 1e-12 * np.array(squared), left, 0.0)


def _check_not_in_reference(
    reference: Cohort, subjects: Cohort, own: FloatArray, outside: FloatArray, column: str | None
) -> None:
    """Check that neither the subjects' scans nor other scans of the same subjects are in the reference."""
    distance = cdist(own, reference.coefficients)
    near = np.sqrt(distance.min(axis=1) ** 2 + outside) < _SAME * centroid_size(reference.reference)
    if near.any():
        k = int(np.flatnonzero(near)[0])
        raise InputError(
            f"{subjects.names[k]} is in the reference too, as {reference.names[int(distance[k].argmin())]}"
            f"{f', and {int(near.sum()) - 1} more are' if near.sum() > 1 else ''}; exclude one of the two scans."
        )
    if column is not None:
        both = sorted({*reference.table.texts(column)} & {*subjects.table.texts(column)})
        if both:
            raise InputError(
                f"{list_names(both)} of {column} is among the subjects and in the reference; exclude one scan."
            )


@dataclass(frozen=True, eq=False)
class _ShapeDistribution:
    """Mean (K,), components (q, K) and variances (q,) of some people; the variances include that of the mean."""

    mean: FloatArray
    components: FloatArray
    variance: FloatArray

    @staticmethod
    def of(coefficients: FloatArray, people: int, modes: int) -> _ShapeDistribution:
        mean = coefficients.mean(axis=0)
        _, s, vt = np.linalg.svd(coefficients - mean, full_matrices=False)
        variance = s[:modes] ** 2 / (len(coefficients) - 1)
        floor = 1e-12 * max(float(variance.max()), 1e-300)
        return _ShapeDistribution(mean, vt[:modes], np.maximum(variance, floor) * (1 + 1 / people))

    def scores(self, coefficients: FloatArray) -> FloatArray:
        return (coefficients - self.mean) @ self.components.T

    def squared(self, scores: FloatArray, noise: FloatArray | None) -> FloatArray:
        """Return squared Mahalanobis distances (...,) of scores (..., q), with noise (K, K) of coefficients (S51)."""
        if noise is None:
            return (scores**2 / self.variance).sum(axis=-1)
        covariance = np.diag(self.variance) + self.components @ noise @ self.components.T
        return (
            scores * np.linalg.solve(covariance, scores.reshape(-1, len(covariance)).T).T.reshape(scores.shape)
        ).sum(axis=-1)


class _Population:
    """Distribution of the reference: of all people, and with each fold of people held out."""

    def __init__(self, reference: Cohort, people: IntArray, modes: int) -> None:
        self.people, self.modes = int(people.max()) + 1, modes
        self.n_vertices = reference.n_vertices
        x = reference.coefficients
        self.distribution = _ShapeDistribution.of(x, self.people, modes)
        centred = x - x.mean(axis=0)
        self.least = 1e-12 * float((centred**2).sum()) / len(x)
        self.variance_share = float((self.distribution.scores(x) ** 2).sum() / (centred**2).sum())
        counts = np.bincount(people)
        self.weight = 1 / counts[people]
        parts = people % min(self.people, _MOST_FOLDS)
        self.folds: list[tuple[IntArray, _ShapeDistribution]] = []
        for part in range(int(parts.max()) + 1):
            inside = parts == part
            left = len(np.unique(people[~inside]))
            self.folds.append((np.flatnonzero(inside).astype(np.int32), _ShapeDistribution.of(x[~inside], left, modes)))

    def left_out(self, coefficients: FloatArray, noise: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return squared distances and RMS of the rest in mm, (R, N) each, of (R, N, K) held-out coefficients."""
        d2 = np.empty(coefficients.shape[:2])
        rest = np.empty_like(d2)
        for rows, measure in self.folds:
            y = measure.scores(coefficients[:, rows])
            d2[:, rows] = measure.squared(y, noise)
            left = ((coefficients[:, rows] - measure.mean) ** 2).sum(axis=-1) - (y**2).sum(axis=-1)
            rest[:, rows] = self.rms(left)
        return d2, rest

    def rms(self, squares: FloatArray) -> FloatArray:
        """Return sums of squares as RMS over the vertices, mm; a rest that is only rounding is zero."""
        return np.sqrt(np.where(squares > self.least, squares, 0.0) / self.n_vertices)

    def share(self, farther: BoolArray) -> float:
        """Return the share of people, with a new person, who are `farther` (R, N); all scans of a person count once."""
        return (1 + float((farther.mean(axis=0) * self.weight).sum())) / (self.people + 1)  # S52

    def p_value(self, squared: float) -> float:
        """Return the chance of a squared distance as large by the F distribution."""
        q, n = self.modes, self.people
        return float(fdtrc(q, n - q, squared * (n - q) / ((n - 1) * q)))  # S53


@dataclass(frozen=True, eq=False)
class _FitUncertainty:
    """Uncertainty of the coefficients of fits.

    Args:
        b: (N, K) coefficients, mm.
        shrinkage: (N, K) share of the prior variance that each scan removes.
        variance: (N, K) variance of the coefficients, mm^2.
        prior: (K,) variance of the coefficients of a new shape, mm^2.
        into: (K, K') matrix from the model's coefficients to those of the cohort.
    """

    b: FloatArray
    shrinkage: FloatArray
    variance: FloatArray
    prior: FloatArray
    into: FloatArray

    @staticmethod
    def of(cohort: Cohort) -> _FitUncertainty | None:
        """Return the uncertainty of the fits of a cohort; None if the surfaces are not the model's own."""
        fitted = cohort.fitted
        if fitted is None or not np.isfinite(fitted.b_stddev).all():
            return None
        modes = fitted.b.shape[1]
        rows = fitted.model.vertex_basis[:, :modes].T
        into = rows @ cohort.basis.T
        if np.abs((into**2).sum(axis=1) - (rows**2).sum(axis=1)).max() > 1e-6:
            return None
        scale = centroid_size(cohort.reference) / centroid_size(fitted.model.mean_vertices)
        prior = np.maximum(variance_of_new_shapes(fitted.model)[:modes], (fitted.b_stddev**2).max(axis=0))
        shrinkage = np.clip(1 - fitted.b_stddev**2 / prior, _LEAST_SHRINKAGE, 1.0)
        return _FitUncertainty(fitted.b, shrinkage, fitted.b_stddev**2, prior, into * scale)

    def covariance(self, k: int) -> FloatArray:
        """Return the covariance (K', K') of the coefficients of fit k."""
        return (self.into.T * self.variance[k]) @ self.into

    def typical(self) -> FloatArray:
        """Return the covariance (K', K') of the coefficients of a typical fit."""
        return (self.into.T * np.median(self.variance, axis=0)) @ self.into

    def degraded(self, coefficients: FloatArray, shrinkage: FloatArray, draws: FloatArray) -> FloatArray:
        """Return (R, N, K') coefficients as fits with less shrinkage (K,) would estimate them."""
        ratio = np.minimum(shrinkage / self.shrinkage, 1.0)
        if ratio.min() > _EQUALLY_PRECISE:
            return coefficients[None]
        # The model's mean replaces the part that a scan does not show, with the remaining scatter of such estimates.
        moved = (ratio - 1) * self.b + np.sqrt(self.prior * shrinkage * (1 - ratio)) * draws
        return coefficients + moved @ self.into


def _draws(uncertainty: _FitUncertainty | None, config: ScoreConfig) -> FloatArray:
    """Return standard normal numbers (R, N, K)."""
    shape = (0, 0) if uncertainty is None else uncertainty.shrinkage.shape
    return np.random.default_rng(config.seed).standard_normal((config.draws, *shape))


def _residual_rms_mm(cohort: Cohort) -> FloatArray:
    if cohort.fitted is None or cohort.fitted.beyond_mm is None:
        return np.full(len(cohort), np.nan)
    return cohort.fitted.beyond_mm


def _nearest_references(
    population: _Population, reference: Cohort, own: FloatArray, outside: float, noise: FloatArray | None, count: int
) -> tuple[NearestReference, ...]:
    between = own - reference.coefficients
    far = np.sqrt(population.distribution.squared(between @ population.distribution.components.T, noise))
    rms = np.sqrt(((between**2).sum(axis=1) + outside) / population.n_vertices)
    order: list[int] = np.argsort(far, kind="stable")[:count].tolist()
    return tuple(NearestReference(reference.names[k], float(far[k]), float(rms[k])) for k in order)


def _maps(
    reference: Cohort, subjects: Cohort, people: IntArray, uncertainty: _FitUncertainty | None
) -> tuple[FloatArray, float]:
    """Return standard deviations (M, V) along the mean's normals, and the limit that 95 % of the people stay within."""
    mean = reference.vertices(reference.coefficients.mean(axis=0))
    mesh = Mesh(mean, reference.faces)
    if reference.faces is not None:
        normals = vertex_normals(mesh)
    else:
        # Points have no surface; outwards is away from their middle.
        away = mean - mean.mean(axis=0)
        normals = away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    n, count = len(reference), int(people.max()) + 1
    z = np.empty((len(subjects), len(mean)))
    largest = np.zeros(n)
    rows = None if uncertainty is None else uncertainty.into @ reference.basis
    groups = np.zeros((count, n))
    groups[people, np.arange(n)] = 1
    size = groups.sum(axis=1, keepdims=True)
    for start in range(0, len(mean), _VERTICES_AT_ONCE):
        part = slice(start, start + _VERTICES_AT_ONCE)
        own = normals[part]
        x = np.einsum("nmi,mi->nm", reference.displacements(part), own)
        x -= np.einsum("mi,mi->m", (mean - reference.reference)[part], own)
        squares, total = (x**2).sum(axis=0), x.sum(axis=0)
        variance = np.maximum((squares - total**2 / n) / (n - 1), 1e-18)
        moved = np.einsum("nmi,mi->nm", subjects.displacements(part), own)
        moved += np.einsum("mi,mi->m", (subjects.reference - mean)[part], own)
        uncertain = 0.0
        if uncertainty is not None and rows is not None:
            along = np.einsum("kmi,mi->km", rows.reshape(len(rows), -1, 3)[:, part], own)
            uncertain = uncertainty.variance @ along**2
        z[:, part] = moved / np.sqrt(variance * (1 + 1 / count) + uncertain)  # S54
        rest = n - size
        others = (total - groups @ x) / rest
        spread = np.maximum((squares - groups @ x**2 - rest * others**2) / np.maximum(rest - 1, 1), 1e-18)
        left_out = (x - others[people]) / np.sqrt(spread[people] * (1 + 1 / (count - 1)))
        largest = np.maximum(largest, np.abs(left_out).max(axis=1))
    by_person = np.sort(np.array([largest[people == k].mean() for k in range(count)]))
    rank = int(np.ceil((1 - LEVEL) * (count + 1)))
    for k in range(len(subjects)):
        mask = subjects.observed_in([k])
        z[k] = z[k] if mask is None else np.where(mask, z[k], np.nan)
    return read_only(z), float(by_person[rank - 1]) if rank <= count else float("nan")


def _size_notes(people: int) -> list[str]:
    if people >= SMALL:
        return []
    step = 100 / (people + 1)
    return [
        f"The reference is small: with {people} subjects shares come in steps of {step:.0f} %, and the usual variation "
        "is known only roughly."
    ]


def _describe_outside(scores: ScoreResult, k: int) -> list[str]:
    """Return the reasons why the score of a subject may not describe its shape."""
    out: list[str] = []
    # With a small reference, "beyond all of the reference" is the strongest possible statement.
    rare = max(_OUTSIDE, 1 / (scores.people + 1)) + 1e-9

    def beyond(share: float) -> str:
        return "all" if share <= 1 / (scores.people + 1) + 1e-9 else f"{100 * (1 - share):.0f} %"

    rest = f"{scores.rest_mm[k]:.2f} mm" if scores.subjects.unit else f"{scores.rest_mm[k]:.4f}"
    if scores.rest_farther[k] <= rare:
        modes = f"{scores.modes} modes of the reference leave" if scores.modes > 1 else "mode of the reference leaves"
        out.append(
            f"the {modes} {rest} of its shape (RMS), more than "
            f"of {beyond(float(scores.rest_farther[k]))} of the reference"
        )
    if scores.beyond_farther[k] <= rare:
        out.append(
            f"the model of its fit left {scores.beyond_mm[k]:.2f} mm of the scan (RMS), more than of "
            f"{beyond(float(scores.beyond_farther[k]))} of the reference"
        )
    fitted = scores.subjects.fitted
    if fitted is not None and fitted.status[k] == "doubtful":
        out.append("its fit is doubtful")
    return out
