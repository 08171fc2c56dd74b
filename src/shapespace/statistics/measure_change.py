"""Change between visits of the same subjects: signed maps in mm, volumes and landmarks, with their uncertainty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import list_names
from shapespace.errors import InputError
from shapespace.geometry.normals import boundary_edges, enclosed_volume, vertex_areas
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import region_vertices
from shapespace.statistics.change_align import stable_vertices
from shapespace.statistics.change_maps import (
    AlignedVisits,
    ChangeUncertainty,
    align_visits,
    contrast,
    faces_in,
    noise_factor,
    swept_mm3,
    uncertainty_from_fits,
    uncertainty_from_stable_part,
)
from shapespace.statistics.change_repeatability import Repeatability, RepeatabilityEstimator
from shapespace.statistics.change_result import (
    ChangeConfig,
    ChangeEstimate,
    ChangeResult,
    GroupDifferenceTests,
    MeanChangeTests,
    SubjectChange,
    VisitChange,
    change_or_rate,
)
from shapespace.statistics.change_visits import Visits, time_column, visits_of
from shapespace.statistics.dispersion import VARIANCES, DispersionTest, dispersion_test
from shapespace.statistics.map_tests import difference_test, mean_test
from shapespace.statistics.observation_weights import weights_of
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, SurfaceLandmarks, require

WHOLE = "whole"
"""Name of the complete surface among the regions."""
_ROUNDING = 1e-4
"""Largest share of the size by which surfaces in files are rounded."""
_COUNTED = 0.5
"""Share of its largest possible weight from which a vertex counts as stable."""


def change(
    cohort: Cohort, config: ChangeConfig | None = None, *, progress: Callable[[int, int], None] | None = None
) -> ChangeResult:
    """Measure the changes between the visits of each subject, in millimetres, and test them over subjects.

    The scans of a subject are aligned rigidly to its first by the stable part. Standard deviations are those of rescans
    where there are some (two scans of a subject at a time, or rows that the column `rescan` marks), else those stated
    by the fits, else the spread over the stable part.

    Args:
        cohort: cohort in the gauge `form`, with triangles; its table contains subject and time of each shape.
        config: options; None for the defaults.
        progress: function called with (done, total) subjects.

    Raises:
        FileError: the file of the stable region cannot be read.
        InputError: another gauge, no triangles, subjects or times missing, times without an order, two scans of a visit
            that are not marked as rescans, no such stable region, groups other than two, or no subject with two visits.
    """
    require(cohort, Cohort, "change", "read one with shapespace.read_cohort")
    config = config or ChangeConfig()
    _check_cohort(cohort, config)
    time = time_column(cohort.table, config.time)
    columns = [config.subject, time, *([config.group] if config.group else [])]
    cohort = cohort.complete(columns, drop_missing=config.drop_missing, numbers=[time])
    visits = visits_of(cohort.table, config.subject, config.time, config.order)
    single = tuple(name for name, own in visits.by_subject.items() if len(own) < 2)
    if len(single) == len(visits.by_subject):
        raise InputError(
            f"{cohort.table.where}: none of its {len(single)} subjects has two visits ({list_names(single)}); give the "
            f"same subject in {config.subject} and another time in {visits.column}."
        )
    if config.rate and not visits.time_unit:
        raise InputError("Rates need times that are numbers or dates; remove --rate, or name such a --time.")
    groups = _groups(cohort, config, visits, single)
    stable = stable_vertices(cohort, config.stable)
    regions = _regions(cohort, config)
    problem = _SharedEstimates(
        cohort=cohort,
        landmarks=cohort.landmarks or SurfaceLandmarks(),
        regions=np.stack([_indicator(vertices, cohort.n_vertices) for vertices in regions.values()]),
        uncertainty="rescans" if visits.rescans else "fits" if cohort.fitted is not None else "stable",
        time_unit=visits.time_unit,
        is_closed=not len(boundary_edges(faces_in(cohort))),
    )
    estimator = RepeatabilityEstimator(cohort.reference, faces_in(cohort), problem.landmarks, problem.regions)
    drafts: list[_SubjectDraft] = []
    before, displacement = np.zeros_like(cohort.reference), np.zeros_like(cohort.reference)
    for done, (name, own) in enumerate(visits.by_subject.items(), 1):
        subject = align_visits(cohort, own, stable)
        estimator.add(subject)
        if len(own) > 1:
            drafts.append(_draft(problem, name, subject))
            before += subject.means[0]
            displacement += subject.means[-1] - subject.means[0]
        if progress is not None:
            progress(done, len(visits.by_subject))
    repeatability = estimator.repeatability()
    subjects = tuple(draft.subject(groups.get(draft.name, ""), repeatability) for draft in drafts)
    before /= len(subjects)
    result = ChangeResult(
        cohort=cohort,
        config=config,
        subjects=subjects,
        single_visit_subjects=single,
        uncertainty=problem.uncertainty,
        repeatability=repeatability,
        mean_change=None,
        group_difference=None,
        before=before,
        after=before + displacement / len(subjects),
        landmarks=problem.landmarks,
        regions=tuple(regions),
        time_unit=visits.time_unit,
        is_closed=problem.is_closed,
        is_model_only=_is_model_only(cohort),
        blank=None,
    )
    return _add_tests(result, groups)


def _check_cohort(cohort: Cohort, config: ChangeConfig) -> None:
    """Check that changes of a cohort can be measured in millimetres along normals.

    Raises:
        InputError: another gauge, no unit, no triangles, or options that are out of range.
    """
    if config.variances not in VARIANCES:
        raise InputError(f"There are no variances {config.variances!r}; choose one of {', '.join(VARIANCES)}.")
    if cohort.gauge != "form":
        raise InputError("Changes are in millimetres, but this cohort has sizes divided out; read it with gauge form.")
    if cohort.unit != "mm":
        raise InputError("Changes are in millimetres, but these coordinates have no unit; give surfaces in mm.")
    if cohort.faces is None:
        raise InputError("Changes are along normals, and points have none; give surfaces with triangles.")
    if config.permutations < 1 or config.seed < 0:
        raise InputError("Tests need at least one permutation and a seed of 0 or more.")


def _indicator(vertices: IntArray, n_vertices: int) -> FloatArray:
    """Return (V,) numbers, 1 for some vertices and 0 for the others."""
    indicator = np.zeros(n_vertices)
    indicator[vertices] = 1.0
    return indicator


def _is_model_only(cohort: Cohort) -> bool:
    """Return whether the first surface is the reconstruction by its model, up to the rounding of files."""
    if cohort.fitted is None:
        return False
    reconstruction, surface = cohort.fitted.model.reconstruct(cohort.fitted.b[0]), cohort.vertices(0)
    T = fit_similarity(reconstruction, surface)
    largest = np.linalg.norm(T.apply(reconstruction) - surface, axis=1).max()
    return bool(largest < _ROUNDING * np.linalg.norm(np.ptp(surface, axis=0)))


@dataclass(frozen=True, eq=False, kw_only=True)
class _SharedEstimates:
    """Input that the estimates of all subjects have in common.

    Args:
        cohort: cohort of the scans.
        landmarks: landmarks on the surfaces.
        regions: (P, V) 1 for the vertices of each region, the complete surface first.
        uncertainty: source of the standard deviations, as in `ChangeResult`.
        time_unit: unit of time of the rates; empty if times are words, for which no rates are computed.
        is_closed: whether the surface is closed.
    """

    cohort: Cohort
    landmarks: SurfaceLandmarks
    regions: FloatArray
    uncertainty: Literal["rescans", "fits", "stable"]
    time_unit: str
    is_closed: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class _SubjectDraft:
    """A subject before its standard deviations are estimated from the rescans of all subjects."""

    name: str
    visits: tuple[VisitChange, ...]
    estimates: tuple[ChangeEstimate, ...]
    noise_factors: tuple[float, ...]
    stable: BoolArray
    area_mm2: FloatArray
    volume_before_mm3: float
    observed: BoolArray | None

    def subject(self, group: str, repeatability: Repeatability | None) -> SubjectChange:
        estimates = list(self.estimates)
        if repeatability is not None:
            quantile = float(stdtrit(repeatability.freedom, 0.975))
            estimates = [
                replace(
                    estimate,
                    stddev_mm=factor * repeatability.within_mm,
                    landmarks_stddev_mm=factor * repeatability.landmarks_within_mm,
                    volumes_stddev_mm3=factor * repeatability.volumes_within_mm3,
                    quantile=quantile,
                )
                for estimate, factor in zip(estimates, self.noise_factors, strict=True)
            ]
        return SubjectChange(
            name=self.name,
            group=group,
            visits=self.visits,
            change=estimates[0],
            rate=estimates[1] if len(estimates) > 1 else None,
            stable=self.stable,
            area_mm2=self.area_mm2,
            volume_before_mm3=self.volume_before_mm3,
            observed=self.observed,
        )


def _draft(problem: _SharedEstimates, name: str, subject: AlignedVisits) -> _SubjectDraft:
    """Return the changes of a subject, with standard deviations unless these are estimated from rescans."""
    faces, first = faces_in(problem.cohort), subject.means[0]
    area = vertex_areas(Mesh(first, faces))
    along = subject.along_mm
    swept = np.stack([swept_mm3(first, mean, faces) for mean in subject.means]) @ problem.regions.T
    visits = tuple(
        VisitChange(
            label=visit.label,
            time=visit.time,
            scans=len(visit.rows),
            rms_mm=float(np.sqrt(np.average(along[k] ** 2, weights=area))),
            volume_mm3=float(swept[k, 0]),
        )
        for k, visit in enumerate(subject.visits)
    )
    estimates: list[ChangeEstimate] = []
    factors: list[float] = []
    for rate in (False, True) if problem.time_unit else (False,):
        weights = contrast(subject.visits, rate=rate)
        factors.append(noise_factor(subject.visits, weights))
        stddev = _uncertainty(problem, subject, weights, factors[-1] / factors[0])
        estimates.append(
            ChangeEstimate(
                along_mm=weights @ along,
                stddev_mm=stddev.along_mm,
                landmarks_mm=problem.landmarks.interpolate(np.tensordot(weights, subject.means, axes=1)),
                landmarks_stddev_mm=stddev.landmarks_mm,
                volumes_mm3=weights @ swept,
                volumes_stddev_mm3=stddev.volumes_mm3,
            )
        )
    return _SubjectDraft(
        name=name,
        visits=visits,
        estimates=tuple(estimates),
        noise_factors=tuple(factors),
        stable=subject.weights > _COUNTED * area,
        area_mm2=area,
        volume_before_mm3=enclosed_volume(first, faces) if problem.is_closed else float("nan"),
        observed=subject.observed,
    )


def _uncertainty(
    problem: _SharedEstimates, subject: AlignedVisits, weights: FloatArray, noise_ratio: float
) -> ChangeUncertainty:
    """Return the standard deviations of the sum over visits weighted by `weights` (T,); 0 if rescans determine them.

    `noise_ratio` is the noise of the sum divided by that of the difference of the last visit and the first.
    """
    if problem.uncertainty == "stable":
        spread = uncertainty_from_stable_part(subject, problem.landmarks, problem.regions)
        return ChangeUncertainty(noise_ratio * spread.along_mm, noise_ratio * spread.landmarks_mm, spread.volumes_mm3)
    if problem.uncertainty == "fits":
        return uncertainty_from_fits(problem.cohort, subject, weights, problem.landmarks, problem.regions)
    sizes = problem.cohort.n_vertices, len(problem.landmarks), len(problem.regions)
    return ChangeUncertainty(*map(np.zeros, sizes))


def _regions(cohort: Cohort, config: ChangeConfig) -> dict[str, IntArray]:
    """Return name -> vertices of the complete surface and of the regions whose volumes are measured.

    Raises:
        InputError: a region with vertices that the surfaces do not have.
    """
    regions = config.regions
    if regions is None:
        regions = {} if cohort.fitted is None else {k: v.tolist() for k, v in cohort.fitted.model.regions.items()}
    all_vertices = {WHOLE: np.arange(cohort.n_vertices, dtype=np.int32)}
    return all_vertices | {name: region_vertices(own, cohort.n_vertices, name) for name, own in regions.items()}


def _groups(cohort: Cohort, config: ChangeConfig, visits: Visits, single: Sequence[str]) -> dict[str, str]:
    """Return subject -> group of the subject; empty without groups.

    Raises:
        InputError: a subject in two groups, or other than two groups of two subjects with two visits.
    """
    if config.group is None:
        return {}
    cells, where = cohort.table.texts(config.group), cohort.table.where
    group_of_subject: dict[str, str] = {}
    for name, own in visits.by_subject.items():
        groups = sorted({cells[row] for visit in own for row in visit.rows})
        if len(groups) > 1:
            raise InputError(
                f"{where}: {name} is in two groups by {config.group!r} ({', '.join(groups[:2])}); correct the table."
            )
        if name not in single:
            group_of_subject[name] = groups[0]
    counts = Counter(group_of_subject.values())
    if len(counts) != 2 or min(counts.values()) < 2:
        counted = ", ".join(f"{group}: {count}" for group, count in sorted(counts.items())[:5])
        raise InputError(
            f"{where}: {config.group!r} must divide the subjects with two visits into two groups of two or more, not "
            f"{counted}; choose another column."
        )
    return group_of_subject


def _dispersion(result: ChangeResult, maps: FloatArray, second: BoolArray, area: FloatArray) -> DispersionTest | None:
    """Return the test of equal dispersion of the changes (N, V) of two groups, vertices weighted by their area."""
    config, codes = result.config, second.astype(np.intp)
    groups = tuple(sorted({subject.group for subject in result.subjects}))
    rooted = maps * np.sqrt(area / area.mean())
    return dispersion_test(
        variable=config.group or "",
        shapes=rooted,
        full=np.eye(2)[codes] / np.sqrt(np.bincount(codes)),
        codes=codes,
        groups=groups,
        n_vertices=maps.shape[1],
        permutations=config.permutations,
        seed=config.seed,
    )


def _blank(subjects: Sequence[SubjectChange]) -> BoolArray:
    """Return (V,) bool, where maps are blank: too few subjects, of all or of a group, observe the vertex."""
    every = np.ones(len(subjects[0].area_mm2), dtype=np.bool_)
    observed = np.stack([every if subject.observed is None else subject.observed for subject in subjects])
    groups = np.array([subject.group for subject in subjects])
    shares = [observed[groups == group].mean(axis=0) for group in dict.fromkeys(groups.tolist())]
    return weights_of(np.min(shares, axis=0)) == 0


def _add_tests(result: ChangeResult, groups: Mapping[str, str]) -> ChangeResult:
    """Return a result with its tests over subjects."""
    config, subjects = result.config, result.subjects
    if len(subjects) < 2:
        return result
    estimates = [change_or_rate(subject, rate=config.rate) for subject in subjects]
    maps = np.stack([estimate.along_mm for estimate in estimates])
    blank, landmarks = _blank(subjects), result.landmarks
    at_landmarks = landmarks.interpolate(maps.T)
    at_landmarks[blank[landmarks.corners].any(axis=1)] = 0.0
    # Vertices without variation are never significant, and are excluded from the maxima.
    maps[:, blank] = 0.0
    volumes = np.stack([estimate.volumes_mm3 for estimate in estimates])
    area = np.mean([subject.area_mm2 for subject in subjects], axis=0)
    run = (config.permutations, config.seed)
    equal_weights = np.ones(len(result.regions))
    mean_change = MeanChangeTests(
        surface=mean_test(maps, area, *run),
        volumes=mean_test(volumes, equal_weights, *run),
        landmarks=mean_test(at_landmarks.T, np.ones(len(landmarks)), *run) if landmarks else None,
    )
    difference = None
    if groups:
        first_name, second_name = sorted(set(groups.values()))
        second = np.array([groups[subject.name] == second_name for subject in subjects])
        dispersion = _dispersion(result, maps, second, area)
        unequal = config.variances == "unequal" or (
            config.variances == "auto" and dispersion is not None and not dispersion.is_equality_plausible
        )
        difference = GroupDifferenceTests(
            groups=(first_name, second_name),
            surface=difference_test(maps, second, area, *run, unequal_variances=unequal),
            volumes=difference_test(volumes, second, equal_weights, *run, unequal_variances=unequal),
            dispersion=dispersion,
        )
    return replace(result, blank=blank if blank.any() else None, mean_change=mean_change, group_difference=difference)
