"""Options and results of the analysis of changes between visits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.special import stdtrit

from shapespace.cohort.cohort import Cohort
from shapespace.reprs import list_briefly, short_repr
from shapespace.schemas import Methods, TestScheme
from shapespace.statistics.change_align import stable_vertices
from shapespace.statistics.change_maps import align_visits
from shapespace.statistics.change_repeatability import Repeatability
from shapespace.statistics.change_visits import visits_of
from shapespace.statistics.dispersion import DispersionTest, Variances
from shapespace.statistics.map_tests import LEVEL, MapTest
from shapespace.statistics.methods import AnalysisResult, dispersion_record, methods_of, sample_sizes
from shapespace.types import BoolArray, FloatArray, Mesh, SurfaceLandmarks

NINETY_FIVE = 1.96
"""Standard deviations that noise alone exceeds in 5 % of the cases."""


@dataclass(frozen=True, kw_only=True)
class ChangeConfig:
    """Options of the analysis of changes.

    Args:
        subject: column of the subjects.
        time: column of the times: numbers, dates (2026-05-31) or words (default: time, visit or date).
        order: order of times that are words, the earliest first, such as before,after.
        stable: part that did not change, by which visits are aligned: `auto` (detected), `all`, a region of the model,
            a file of vertices, or `landmarks:NAME,NAME,MM`, the vertices within MM of these landmarks (in Python also
            the vertices).
        regions: name -> vertices, whose volumes are reported in addition to the total; None for the regions of the
            model.
        group: column of two groups whose changes are compared.
        rate: whether to analyse mm per unit of time instead of last minus first visit.
        permutations: number of permutations.
        seed: seed of the permutations.
        variances: assumption on the variances of the groups: `equal` permutes subjects, `unequal` computes Welch's t
            and flips signs, `auto` uses `unequal` if groups may differ: p is at most 0.3 for dispersion or 0.1 for
            form, or 0.05 for either in groups of the same size.
        drop_missing: exclude shapes with missing values in the table (default: an error).
    """

    subject: str = "subject"
    time: str | None = None
    order: tuple[str, ...] | None = None
    stable: str | Path | Sequence[int] = "auto"
    regions: Mapping[str, Sequence[int]] | None = None
    group: str | None = None
    rate: bool = False
    permutations: int = 1000
    seed: int = 0
    variances: Variances = "auto"
    drop_missing: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class VisitChange:
    """A visit compared with the first visit of its subject.

    Args:
        label: time as written in the table.
        time: time as a number.
        scans: number of scans of the visit.
        rms_mm: RMS over the surface of the displacement along the normals.
        volume_mm3: volume swept since the first visit.
    """

    label: str
    time: float
    scans: int
    rms_mm: float
    volume_mm3: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeEstimate:
    """A quantity of one subject with its standard deviations, or its slope by time.

    Args:
        along_mm: (V,) displacement along the normals of the first visit, outwards positive; mm, or mm per unit of time.
        stddev_mm: (V,) standard deviation of `along_mm`.
        landmarks_mm: (L, 3) displacement of each landmark in the frame of the cohort.
        landmarks_stddev_mm: (L,) standard deviation of each landmark: root of the summed variances along the axes.
        volumes_mm3: (P,) volumes swept by the complete surface and by each region.
        volumes_stddev_mm3: (P,) standard deviation of each volume; NaN if not known.
        quantile: number of standard deviations that noise exceeds in 5 % of the cases: 1.96, and more with few rescans.
    """

    along_mm: FloatArray
    stddev_mm: FloatArray
    landmarks_mm: FloatArray
    landmarks_stddev_mm: FloatArray
    volumes_mm3: FloatArray
    volumes_stddev_mm3: FloatArray
    quantile: float = NINETY_FIVE

    __repr__ = short_repr

    @property
    def beyond(self) -> BoolArray:
        """(V,) whether the change exceeds the value that noise alone exceeds in 5 % of the cases."""
        return np.abs(self.along_mm) > self.quantile * self.stddev_mm


@dataclass(frozen=True, eq=False, kw_only=True)
class SubjectChange:
    """Changes of one subject between visits.

    Args:
        name: name of the subject.
        group: group of the subject; empty without groups.
        visits: visits in order, the first among them.
        change: last visit minus first.
        rate: slope of a line through all visits by least squares, per unit of time; None if times are words.
        stable: (V,) bool, vertices by which the last scan is aligned.
        area_mm2: (V,) area of each vertex at the first visit.
        volume_before_mm3: volume at the first visit; NaN for a surface that is not closed.
        observed: (V,) bool, whether all scans of the subject observe a vertex; None if they observe all. Elsewhere the
            change is between estimates, and does not count in `rms_mm` and `beyond_share`.
    """

    name: str
    group: str
    visits: tuple[VisitChange, ...]
    change: ChangeEstimate
    rate: ChangeEstimate | None
    stable: BoolArray
    area_mm2: FloatArray
    volume_before_mm3: float
    observed: BoolArray | None = None

    @property
    def observed_area_mm2(self) -> FloatArray:
        """(V,) `area_mm2`, or 0 if a vertex is an estimate."""
        return self.area_mm2 if self.observed is None else self.area_mm2 * self.observed

    @property
    def unobserved(self) -> BoolArray | None:
        """(V,) bool, where maps of the subject are blank; None if nowhere."""
        return None if self.observed is None else ~self.observed

    __repr__ = short_repr

    @property
    def rms_mm(self) -> float:
        """RMS of the change over the surface."""
        return float(np.sqrt(np.average(self.change.along_mm**2, weights=self.observed_area_mm2)))

    @property
    def beyond_share(self) -> float:
        """Share of the surface whose change exceeds its uncertainty; 0.05 on average for noise alone."""
        return float(np.average(self.change.beyond, weights=self.observed_area_mm2))


@dataclass(frozen=True, eq=False, kw_only=True)
class MeanChangeTests:
    """Tests of the mean change over subjects.

    Args:
        surface: tests at the vertices, along the normals.
        volumes: tests of the volumes of the regions.
        landmarks: tests of the landmarks along the normals; None without landmarks.
    """

    surface: MapTest
    volumes: MapTest
    landmarks: MapTest | None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupDifferenceTests:
    """Tests of the difference between the changes of two groups.

    Args:
        groups: names of the groups, in order; differences are of the second minus the first.
        surface: tests at the vertices, along the normals.
        volumes: tests of the volumes of the regions.
        dispersion: test of equal dispersion of the changes; None if it cannot be tested.
    """

    groups: tuple[str, str]
    surface: MapTest
    volumes: MapTest
    dispersion: DispersionTest | None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False, kw_only=True)
class ChangeResult(AnalysisResult):
    """Changes of the subjects of a cohort between their visits, and tests over subjects.

    Args:
        cohort: cohort of the analysis.
        config: options of the analysis.
        subjects: changes of the subjects with two visits or more, in the order of the table.
        single_visit_subjects: subjects with one visit, who are excluded.
        uncertainty: source of the standard deviations: `rescans`; `fits`, their own standard deviations; `stable`, the
            spread over the stable part.
        repeatability: repeatability from rescans; None without rescans.
        mean_change: tests of the mean over subjects; None for a single subject.
        group_difference: tests of the difference of two groups; None without `ChangeConfig.group`.
        before: (V, 3) mean of the first visits, mm.
        after: (V, 3) the mean of the first visits moved by the mean change, mm.
        landmarks: landmarks on the surfaces.
        regions: names of the parts with volumes: first the complete surface, then the regions.
        time_unit: unit of time for rates, such as `year`; empty if times are words.
        is_closed: whether the surface is closed.
        is_model_only: whether the surfaces contain only variation of the model of the fits.
        blank: (V,) bool, where maps are blank because too few subjects observe the vertex; None if nowhere.

    Example:
        >>> visits = [size * mesh.vertices for mesh in meshes for size in (1.0, 1.01)]
        >>> columns = {"subject": np.repeat(list("abcdef"), 2), "visit": [1, 2] * 6}
        >>> forms = ss.Cohort.of_shapes(visits, columns, faces=meshes[0].faces, gauge="form")
        >>> len(ss.statistics.change(forms, ss.statistics.ChangeConfig(time="visit")).subjects)
        6
    """

    cohort: Cohort
    config: ChangeConfig
    subjects: tuple[SubjectChange, ...]
    single_visit_subjects: tuple[str, ...]
    uncertainty: Literal["rescans", "fits", "stable"]
    repeatability: Repeatability | None
    mean_change: MeanChangeTests | None
    group_difference: GroupDifferenceTests | None
    before: FloatArray
    after: FloatArray
    landmarks: SurfaceLandmarks
    regions: tuple[str, ...]
    time_unit: str
    is_closed: bool
    is_model_only: bool
    blank: BoolArray | None

    @cached_property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        tests: list[TestScheme] = []
        changes = "rate of change" if self.config.rate else "change"
        mean, difference = self.mean_change, self.group_difference
        for tested, all_tests in ((f"mean {changes}", mean), (f"{changes} of two groups", difference)):
            if all_tests is not None:
                test = all_tests.surface
                flipped = len(test.n) == 1 or test.unequal_variances
                tests.append(
                    TestScheme(
                        tested=(tested,), statistic="Welch t" if test.unequal_variances else "t",
                        resampling="sign flips" if flipped else "permutation",
                        reduced_model=() if test.unequal_variances else None, arrangements=test.permutations,
                        exhaustive=test.every, unequal_variances=test.unequal_variances,
                    )
                )  # fmt: skip
        names = [subject.name for subject in self.subjects for visit in subject.visits for _ in range(visit.scans)]
        group = {subject.name: subject.group for subject in self.subjects}
        variables = [(self.config.group, [group[name] for name in names])] if self.config.group else []
        return methods_of(
            self.cohort, len(self.subjects), shapes=len(names), dimensions=None, tests=tuple(tests),
            sizes=sample_sizes(names, variables),
            dispersions=()
            if difference is None or difference.dispersion is None
            else (dispersion_record(difference.dispersion, LEVEL),),
            unequal_variances=None if difference is None else difference.surface.unequal_variances,
            corrected_over=("the vertices of a map", "the parts in the table of volumes", "the landmarks of a table")
            if tests else (),
            assumptions=("Visits of a subject are aligned rigidly to its first by the stable part; p values do not "
                         "contain the uncertainty of this alignment.",),
        )  # fmt: skip

    @cached_property
    def by_name(self) -> Mapping[str, SubjectChange]:
        """Subject -> its change."""
        return {subject.name: subject for subject in self.subjects}

    def __repr__(self) -> str:
        p_values: list[str] = []
        if self.mean_change is not None:
            p_values.append(f"mean change: p {self.mean_change.surface.omnibus_p:.3g}")
        if self.group_difference is not None:
            groups = " and ".join(self.group_difference.groups)
            p_values.append(f"{groups} differ: p {self.group_difference.surface.omnibus_p:.3g}")
        return (
            f"<{type(self).__name__} of {len(self.subjects)} subjects, {len(self.cohort)} scans; uncertainty from "
            f"{self.uncertainty}{f'; {list_briefly(p_values)}' if p_values else ''}>"
        )

    def surfaces(self, name: str) -> tuple[Mesh, Mesh]:
        """Return a subject's surface at its first visit and, aligned to it, at its last."""
        visits = visits_of(self.cohort.table, self.config.subject, self.config.time, self.config.order)
        stable = stable_vertices(self.cohort, self.config.stable)
        means, faces = align_visits(self.cohort, visits.by_subject[name], stable).means, self.cohort.faces
        return Mesh(means[0], faces, name=f"{name} before"), Mesh(means[-1], faces, name=f"{name} after")


def change_or_rate(subject: SubjectChange, *, rate: bool) -> ChangeEstimate:
    """Return the change of a subject, or its rate."""
    estimate = subject.rate if rate else subject.change
    assert estimate is not None
    return estimate


def interval_of_mean(values: FloatArray) -> tuple[float, float]:
    """Return the 95 % interval of the mean of two or more values, by Student's t."""
    half = float(stdtrit(len(values) - 1, 0.975)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return float(values.mean() - half), float(values.mean() + half)
