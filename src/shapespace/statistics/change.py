"""What changed? Pairs and series of scans of a subject: signed maps in mm, volumes, landmarks, and what is noise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import t as student

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import named
from shapespace.errors import InputError
from shapespace.geometry.similarity import fit_similarity
from shapespace.geometry.surface import boundary_edges, vertex_areas
from shapespace.model.shape_model import region_vertices
from shapespace.statistics.answer import Answer
from shapespace.statistics.change_align import stable_vertices
from shapespace.statistics.change_group import MapTest, difference_test, mean_test
from shapespace.statistics.change_maps import (
    Aligned,
    Known,
    aligned,
    contrast,
    faces_in,
    known_by_fits,
    known_by_stable,
    noise_factor,
    swept_mm3,
    volume_mm3,
)
from shapespace.statistics.change_repeat import Repeatability, Rescans
from shapespace.statistics.change_visits import Visits, time_column, visits_of
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

NINETY_FIVE = 1.96
"""Standard deviations that noise exceeds one time in twenty."""
WHOLE = "whole"
"""What the whole surface is called beside its regions."""
_ROUNDING = 1e-4
"""Share of the size by which surfaces in files are rounded, at most."""
_COUNTED = 0.5
"""Of the weight that it could have, from which a vertex counts as stable."""


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
    """

    name: str
    group: str
    visits: tuple[VisitChange, ...]
    change: Estimate
    rate: Estimate | None
    stable: BoolArray
    area_mm2: FloatArray
    before_mm3: float

    @property
    def rms_mm(self) -> float:
        """RMS of the change over the surface."""
        return float(np.sqrt(np.average(self.change.along_mm**2, weights=self.area_mm2)))

    @property
    def beyond_share(self) -> float:
        """Share of the surface whose change exceeds its uncertainty; noise alone gives 0.05."""
        return float(np.average(self.change.beyond, weights=self.area_mm2))


@dataclass(frozen=True, eq=False)
class Change:
    """What changed in the subjects of a cohort.

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
        groups: names of the two groups, in order.
        before: (V, 3) mean of the first visits,
        after: and moved by the mean change.
        landmarks: name -> vertex.
        parts: names of what volumes are told of: `whole` and the regions.
        unit: of time, as in `mm per year`; empty where times are words.
        closed: whether the surface is.
        model_only: whether the surfaces hold nothing but what the model of the fits can make.
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
    landmarks: Mapping[str, int]
    parts: tuple[str, ...]
    unit: str
    closed: bool
    model_only: bool

    @cached_property
    def by_name(self) -> Mapping[str, SubjectChange]:
        """Subject -> what changed in it."""
        return {subject.name: subject for subject in self.subjects}

    def surfaces(self, name: str) -> tuple[Mesh, Mesh]:
        """Return a subject's surface at its first visit and, aligned to it, at its last."""
        visits = visits_of(self.cohort.table, self.settings.subject, self.settings.time, self.settings.order).of[name]
        found = aligned(self.cohort, visits, stable_vertices(self.cohort, self.settings.stable))
        faces = self.cohort.faces
        return Mesh(found.means[0], faces, name=f"{name} before"), Mesh(found.means[-1], faces, name=f"{name} after")

    def answer(self) -> Answer:
        """Return what is kept of it: a report, tables, arrays and meshes."""
        from shapespace.statistics.change_answer import answer_of

        return answer_of(self)


def change(
    cohort: Cohort, settings: ChangeSettings | None = None, *, on_step: Callable[[int, int], None] | None = None
) -> Change:
    """Return what changed between the visits of each subject, in millimetres, and in the group.

    Scans of a subject are brought to its first rigidly, by what is stable. Standard deviations are those of rescans
    where there are some (two scans of a subject at a time, or rows that the column `rescan` marks), else what the fits
    say of themselves, else the spread over the stable part.

    Args:
        cohort: in the gauge `form`, with triangles; its table tells subject and time of each shape.
        settings: what is asked; None for the defaults.
        on_step: called with (done, total) subjects.

    Raises:
        FileError: the file of the stable region cannot be read.
        InputError: another gauge, no triangles, subjects or times missing, times without an order, two scans of a visit
            that are not marked as rescans, no such stable region, groups other than two, or nobody with two visits.
    """
    settings = settings or ChangeSettings()
    if cohort.gauge != "form":
        raise InputError("Changes are in millimetres, but this cohort has sizes divided out; read it with gauge form.")
    if cohort.faces is None:
        raise InputError("Changes are along normals, and points have none; give surfaces with triangles.")
    if settings.permutations < 1 or settings.seed < 0:
        raise InputError("Tests need at least one permutation and a seed of 0 or more.")
    columns = [settings.subject, time_column(cohort.table, settings.time)]
    cohort = cohort.complete([*columns, settings.group] if settings.group else columns)
    visits = visits_of(cohort.table, settings.subject, settings.time, settings.order)
    single = tuple(name for name, own in visits.of.items() if len(own) < 2)
    if len(single) == len(visits.of):
        raise InputError(
            f"{cohort.table.where}: none of its {len(single)} subjects has two visits ({named(single)}); give the same "
            f"subject in {settings.subject} and another time in {visits.column}."
        )
    groups = _groups(cohort, settings, visits, single)
    stable = stable_vertices(cohort, settings.stable)
    landmarks = dict(cohort.landmarks or {})
    regions = _regions(cohort, settings)
    parts = np.zeros((len(regions), cohort.n_vertices))
    for row, vertices in zip(parts, regions.values(), strict=True):
        row[vertices] = 1.0
    rescans = Rescans(cohort.reference, faces_in(cohort), list(landmarks.values()), parts)
    drafts: list[_Draft] = []
    source: Literal["rescans", "fits", "stable"] = (
        "rescans" if visits.rescans else "fits" if cohort.fitted is not None else "stable"
    )
    before, moved = np.zeros_like(cohort.reference), np.zeros_like(cohort.reference)
    closed = not len(boundary_edges(faces_in(cohort)))
    for done, (name, own) in enumerate(visits.of.items(), 1):
        found = aligned(cohort, own, stable)
        rescans.add(found)
        if len(own) > 1:
            drafts.append(
                _draft(cohort, name, found, list(landmarks.values()), parts, source, visits.unit, closed=closed)
            )
            before += found.means[0]
            moved += found.means[-1] - found.means[0]
        if on_step is not None:
            on_step(done, len(visits.of))
    repeatability = rescans.told()
    subjects = tuple(draft.subject(groups.get(draft.name, ""), repeatability) for draft in drafts)
    before /= len(subjects)
    answer = Change(
        cohort, settings, subjects, single, source, repeatability, None, None, None, None, None, (), before,
        before + moved / len(subjects), landmarks, tuple(regions), visits.unit, closed, _model_only(cohort),
    )  # fmt: skip
    return _tested(answer, groups)


def _model_only(cohort: Cohort) -> bool:
    if cohort.fitted is None:
        return False
    own, there = cohort.fitted.model.reconstruct(cohort.fitted.b[0]), cohort.vertices(0)
    off = np.linalg.norm(fit_similarity(own, there).apply(own) - there, axis=1).max()
    return bool(off < _ROUNDING * np.linalg.norm(np.ptp(there, axis=0)))


@dataclass(frozen=True, eq=False)
class _Draft:
    """A subject before its standard deviations are known, which rescans of all tell."""

    name: str
    visits: tuple[VisitChange, ...]
    sums: tuple[Estimate, ...]
    factors: tuple[float, ...]
    stable: BoolArray
    area_mm2: FloatArray
    before_mm3: float

    def subject(self, group: str, repeatability: Repeatability | None) -> SubjectChange:
        sums = list(self.sums)
        if repeatability is not None:
            quantile = float(student.ppf(0.975, repeatability.freedom))
            sums = [
                replace(
                    one,
                    stddev_mm=factor * repeatability.within_mm,
                    landmarks_stddev_mm=factor * repeatability.landmarks_within_mm,
                    volumes_stddev_mm3=factor * repeatability.volumes_within_mm3,
                    quantile=quantile,
                )
                for one, factor in zip(sums, self.factors, strict=True)
            ]
        rate = sums[1] if len(sums) > 1 else None
        return SubjectChange(
            self.name, group, self.visits, sums[0], rate, self.stable, self.area_mm2, self.before_mm3
        )  # fmt: skip


def _draft(
    cohort: Cohort,
    name: str,
    found: Aligned,
    landmarks: list[int],
    parts: FloatArray,
    source: Literal["rescans", "fits", "stable"],
    unit: str,
    *,
    closed: bool,
) -> _Draft:
    faces = faces_in(cohort)
    first = found.means[0]
    area = vertex_areas(Mesh(first, faces))
    along = found.along_mm
    swept = np.stack([swept_mm3(first, mean, faces) for mean in found.means]) @ parts.T
    told = tuple(
        VisitChange(
            visit.label,
            visit.at,
            len(visit.rows),
            float(np.sqrt(np.average(along[k] ** 2, weights=area))),
            float(swept[k, 0]),
        )
        for k, visit in enumerate(found.visits)
    )
    sums: list[Estimate] = []
    factors: list[float] = []
    by_stable = known_by_stable(found, landmarks, parts) if source == "stable" else None
    for rate in (False, True) if unit else (False,):
        weights = contrast(found.visits, rate=rate)
        factors.append(noise_factor(found.visits, weights))
        if by_stable is not None:
            # Its spread is that of a difference of the last visit and the first.
            share = factors[-1] / factors[0]
            known = Known(share * by_stable.along_mm, share * by_stable.landmarks_mm, by_stable.volumes_mm3)
        elif source == "fits":
            known = known_by_fits(cohort, found, weights, landmarks, parts)
        else:
            known = Known(np.zeros(len(area)), np.zeros(len(landmarks)), np.zeros(len(parts)))
        moved = np.tensordot(weights, found.means[:, landmarks], axes=1)
        sums.append(
            Estimate(
                weights @ along,
                known.along_mm,
                moved,
                known.landmarks_mm,
                weights @ swept,
                known.volumes_mm3,
            )
        )
    stable = found.weights > _COUNTED * area
    before_mm3 = volume_mm3(first, faces) if closed else float("nan")
    return _Draft(name, told, tuple(sums), tuple(factors), stable, area, before_mm3)


def _regions(cohort: Cohort, settings: ChangeSettings) -> dict[str, IntArray]:
    """Return name -> vertices of what volumes are told of: the whole, and regions.

    Raises:
        InputError: a region with vertices that the surfaces do not have.
    """
    asked = settings.regions
    if asked is None:
        asked = {} if cohort.fitted is None else {k: v.tolist() for k, v in cohort.fitted.model.regions.items()}
    whole = {WHOLE: np.arange(cohort.n_vertices, dtype=np.int32)}
    return whole | {name: region_vertices(own, cohort.n_vertices, name) for name, own in asked.items()}


def _groups(cohort: Cohort, settings: ChangeSettings, visits: Visits, single: Sequence[str]) -> dict[str, str]:
    """Return subject -> its group; empty where none was asked for.

    Raises:
        InputError: a subject in two groups, or other than two groups of two subjects with two visits.
    """
    if settings.group is None:
        return {}
    cells, where = cohort.table.texts(settings.group), cohort.table.where
    found: dict[str, str] = {}
    for name, own in visits.of.items():
        held = sorted({cells[row] for visit in own for row in visit.rows})
        if len(held) > 1:
            raise InputError(
                f"{where}: {name} is in two groups by {settings.group!r} ({', '.join(held[:2])}); correct one of them."
            )
        if name not in single:
            found[name] = held[0]
    counts = Counter(found.values())
    if len(counts) != 2 or min(counts.values()) < 2:
        told = ", ".join(f"{group}: {count}" for group, count in sorted(counts.items())[:5])
        raise InputError(
            f"{where}: {settings.group!r} must part the subjects with two visits into two groups of two or more, not "
            f"{told}; choose another column."
        )
    return found


def _tested(answer: Change, groups: Mapping[str, str]) -> Change:
    """Return the same with its tests over subjects."""
    settings, subjects = answer.settings, answer.subjects
    if settings.rate and not answer.unit:
        raise InputError("Rates need times that are numbers or dates; leave out --rate, or name such a --time.")
    if len(subjects) < 2:
        return answer
    asked = [effect_of(subject, rate=settings.rate) for subject in subjects]
    maps = np.stack([one.along_mm for one in asked])
    volumes = np.stack([one.volumes_mm3 for one in asked])
    area = np.mean([subject.area_mm2 for subject in subjects], axis=0)
    vertices = list(answer.landmarks.values())
    run = (settings.permutations, settings.seed)
    whole, few = np.ones(len(answer.parts)), np.ones(len(vertices))
    names: tuple[str, ...] = tuple(sorted(set(groups.values())))
    second = np.array([groups.get(subject.name) == names[1] for subject in subjects]) if names else None
    return replace(
        answer,
        group=mean_test(maps, area, *run),
        group_volumes=mean_test(volumes, whole, *run),
        group_landmarks=mean_test(maps[:, vertices], few, *run) if vertices else None,
        between=None if second is None else difference_test(maps, second, area, *run),
        between_volumes=None if second is None else difference_test(volumes, second, whole, *run),
        groups=names,
    )


def effect_of(subject: SubjectChange, *, rate: bool) -> Estimate:
    """Return the change of a subject, or its rate."""
    found = subject.rate if rate else subject.change
    assert found is not None
    return found


def interval_of_mean(values: FloatArray) -> tuple[float, float]:
    """Return the 95 % interval of the mean of two or more values, by Student's t."""
    half = float(student.ppf(0.975, len(values) - 1)) * float(values.std(ddof=1)) / np.sqrt(len(values))
    return float(values.mean() - half), float(values.mean() + half)
