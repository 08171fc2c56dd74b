"""What is asked of changes, and what was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import t as student

from shapespace.cohort.cohort import Cohort
from shapespace.reprs import list_briefly, short_repr
from shapespace.schemas import Methods, TestScheme
from shapespace.statistics.change_align import stable_vertices
from shapespace.statistics.change_group import LEVEL, MapTest
from shapespace.statistics.change_maps import aligned
from shapespace.statistics.change_repeat import Repeatability
from shapespace.statistics.change_visits import visits_of
from shapespace.statistics.dispersion import DispersionTest
from shapespace.statistics.methods import dispersion_record, methods_of, sample_sizes
from shapespace.types import BoolArray, FloatArray, Mesh, SurfaceLandmarks

NINETY_FIVE = 1.96
"""Standard deviations that noise exceeds one time in twenty."""


@dataclass(frozen=True)
class ChangeSettings:
    """What is asked.

    Args:
        subject: column of the table that tells whose scan it is.
        time: column that tells when; None takes `time`, `visit` or `date`. Numbers, dates such as 2026-05-31, or words.
        order: of times that are words, the earliest first.
        stable: what did not change, and so carries the alignment: `auto` finds it, `all` is the whole surface; a region
            of the model by its name; a file of vertices; `landmarks:NAME,NAME,...` and a radius in mm, for what is near
            these; or the vertices.
        regions: name -> vertices, whose volumes are told beside that of the whole; None takes those of the model.
        group: column with two groups, whose changes are compared; None compares none.
        rate: maps over the group are in mm per unit of time, rather than last visit minus first.
        permutations: of the tests.
        seed: of these.
        unequal_variances: compare the groups by Welch's t with sign flips, which allows unequal dispersion.
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
    unequal_variances: bool = False


@dataclass(frozen=True, eq=False)
class VisitChange:
    """One visit beside the first of its subject.

    Args:
        label: the time as the table tells it.
        at: the same as a number.
        scans: of it.
        rms_mm: RMS over the surface of the displacement along the normals.
        volume_mm3: swept since the first visit.
    """

    label: str
    at: float
    scans: int
    rms_mm: float
    volume_mm3: float

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Estimate:
    """A quantity of one subject with its standard deviations, or its slope by time.

    Args:
        along_mm: (V,) displacement along the normals of the first visit, outwards positive; mm, or mm per unit of time.
        stddev_mm: (V,) of it.
        landmarks_mm: (L, 3) displacement of each landmark in the frame of the cohort.
        landmarks_stddev_mm: (L,) of each: root of the summed variances along the axes.
        volumes_mm3: (P,) volumes swept by the whole and by each region.
        volumes_stddev_mm3: (P,) of these; NaN where nothing is known of them.
        quantile: standard deviations that noise exceeds one time in twenty: 1.96, and more where few rescans tell them.
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
        """(V,) where it exceeds what noise alone exceeds one time in twenty."""
        return np.abs(self.along_mm) > self.quantile * self.stddev_mm


@dataclass(frozen=True, eq=False)
class SubjectChange:
    """What changed in one subject.

    Args:
        name: of the subject.
        group: that it is in; empty where none was asked for.
        visits: in order, the first among them.
        change: last visit minus first.
        rate: slope of a line through all visits by least squares, per unit of time; None where times are words.
        stable: (V,) bool, what carried the alignment of the last scan.
        area_mm2: (V,) of each vertex at the first visit.
        before_mm3: volume at the first visit; NaN of a surface that is not closed.
        observed: (V,) bool, whether all scans of the subject observe a vertex; None if they observe all. Elsewhere the
            change is between estimates, and does not count in `rms_mm` and `beyond_share`.
    """

    name: str
    group: str
    visits: tuple[VisitChange, ...]
    change: Estimate
    rate: Estimate | None
    stable: BoolArray
    area_mm2: FloatArray
    before_mm3: float
    observed: BoolArray | None = None

    @property
    def observed_area_mm2(self) -> FloatArray:
        """(V,) `area_mm2`, 0 where a vertex is an estimate."""
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
        """Share of the surface whose change exceeds its uncertainty; noise alone gives 0.05."""
        return float(np.average(self.change.beyond, weights=self.observed_area_mm2))


@dataclass(frozen=True, eq=False)
class Found:
    """What changed in the subjects of a cohort, as numbers.

    Args:
        cohort: it is of.
        settings: that were asked.
        subjects: with two visits or more, in the order of the table.
        single: subjects with one visit, who are left out.
        uncertainty: where standard deviations come from: `rescans`; `fits`, their own; `stable`, the spread over what
            is stable.
        repeatability: from rescans; None without.
        group: test of the mean over subjects; None of a single one.
        group_volumes: the same of the volumes of `parts`.
        group_landmarks: the same of the landmarks, along the normals.
        between: test of the second group against the first, where they were asked for.
        between_volumes: the same of the volumes.
        dispersion: test of equal dispersion of the changes of the two groups; None without groups.
        groups: names of the two groups, in order.
        before: (V, 3) mean of the first visits,
        after: and moved by the mean change.
        landmarks: on the surfaces.
        parts: names of what volumes are told of: `whole` and the regions.
        unit: of time, as in `mm per year`; empty where times are words.
        closed: whether the surface is.
        model_only: whether the surfaces hold nothing but what the model of the fits can make.
        blank: (V,) bool, where maps are blank because too few subjects observe the vertex; None if nowhere.
    """

    cohort: Cohort
    settings: ChangeSettings
    subjects: tuple[SubjectChange, ...]
    single: tuple[str, ...]
    uncertainty: Literal["rescans", "fits", "stable"]
    repeatability: Repeatability | None
    group: MapTest | None
    group_volumes: MapTest | None
    group_landmarks: MapTest | None
    between: MapTest | None
    between_volumes: MapTest | None
    groups: tuple[str, ...]
    before: FloatArray
    after: FloatArray
    landmarks: SurfaceLandmarks
    parts: tuple[str, ...]
    unit: str
    closed: bool
    model_only: bool
    dispersion: DispersionTest | None = None
    blank: BoolArray | None = None

    @cached_property
    def methods(self) -> Methods:
        """Sample sizes, tests and assumptions."""
        tests: list[TestScheme] = []
        changes = "rate of change" if self.settings.rate else "change"
        for tested, test in ((f"mean {changes}", self.group), (f"{changes} of two groups", self.between)):
            if test is not None:
                flipped = len(test.n) == 1 or test.unequal_variances
                tests.append(
                    TestScheme(
                        tested=(tested,), statistic="Welch t" if test.unequal_variances else "t",
                        resampling="sign flips" if flipped else "permutation",
                        reduced_model=() if test.unequal_variances else None, arrangements=test.permutations,
                        exhaustive=test.every, unequal_variances=test.unequal_variances,
                    )
                )  # fmt: skip
        names = [one.name for one in self.subjects for visit in one.visits for _ in range(visit.scans)]
        group = {one.name: one.group for one in self.subjects}
        variables = [(self.settings.group, [group[name] for name in names])] if self.settings.group else []
        return methods_of(
            self.cohort, len(self.subjects), shapes=len(names), dimensions=None, tests=tuple(tests),
            sizes=sample_sizes(names, variables),
            dispersions=() if self.dispersion is None else (dispersion_record(self.dispersion, LEVEL),),
            unequal_variances=None if self.between is None else self.settings.unequal_variances,
            corrected_over=("the vertices of a map", "the parts in the table of volumes", "the landmarks of a table")
            if tests else (),
            assumptions=("Visits of a subject are aligned rigidly to its first by the stable part; p values do not "
                         "contain the uncertainty of this alignment.",),
        )  # fmt: skip

    @cached_property
    def by_name(self) -> Mapping[str, SubjectChange]:
        """Subject -> what changed in it."""
        return {subject.name: subject for subject in self.subjects}

    def __repr__(self) -> str:
        tests = {"mean change": self.group, " and ".join(self.groups) + " differ": self.between}
        p_values = list_briefly([f"{name}: p {test.omnibus_p:.3g}" for name, test in tests.items() if test is not None])
        return (
            f"<{type(self).__name__} of {len(self.subjects)} subjects, {len(self.cohort)} scans; uncertainty from "
            f"{self.uncertainty}{f'; {p_values}' if p_values else ''}>"
        )

    def surfaces(self, name: str) -> tuple[Mesh, Mesh]:
        """Return a subject's surface at its first visit and, aligned to it, at its last."""
        visits = visits_of(self.cohort.table, self.settings.subject, self.settings.time, self.settings.order).of[name]
        found = aligned(self.cohort, visits, stable_vertices(self.cohort, self.settings.stable))
        faces = self.cohort.faces
        return Mesh(found.means[0], faces, name=f"{name} before"), Mesh(found.means[-1], faces, name=f"{name} after")


def effect_of(subject: SubjectChange, *, rate: bool) -> Estimate:
    """Return the change of a subject, or its rate."""
    found = subject.rate if rate else subject.change
    assert found is not None
    return found


def interval_of_mean(values: FloatArray) -> tuple[float, float]:
    """Return the 95 % interval of the mean of two or more values, by Student's t."""
    half = float(student.ppf(0.975, len(values) - 1)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return float(values.mean() - half), float(values.mean() + half)
