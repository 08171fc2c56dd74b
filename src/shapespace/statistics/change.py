"""What changed? Pairs and series of scans of a subject: signed maps in mm, volumes, landmarks, and what is noise."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import t as student

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import list_names
from shapespace.errors import InputError
from shapespace.geometry.normals import boundary_edges, vertex_areas
from shapespace.geometry.similarity import fit_similarity
from shapespace.lazy import lazy_import
from shapespace.model.shape_model import region_vertices
from shapespace.statistics.answer import Answer
from shapespace.statistics.change_align import stable_vertices
from shapespace.statistics.change_answer import answer_of
from shapespace.statistics.change_found import ChangeSettings, Estimate, Found, SubjectChange, VisitChange, effect_of
from shapespace.statistics.change_group import difference_test, mean_test
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
from shapespace.statistics.dispersion import DispersionTest, dispersion_test
from shapespace.statistics.observed import weights_of
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, SurfaceLandmarks, require

WHOLE = "whole"
"""What the whole surface is called beside its regions."""
_ROUNDING = 1e-4
"""Share of the size by which surfaces in files are rounded, at most."""
_COUNTED = 0.5
"""Of the weight that it could have, from which a vertex counts as stable."""


class Change(Found):
    """What changed in the subjects of a cohort: `Found`, which lists it, and its report."""

    def answer(self) -> Answer:
        """Return what is kept of it: a report, tables, arrays and meshes."""
        return answer_of(self)

    def _repr_html_(self) -> str:
        return lazy_import("html_of_analysis")(self)


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
    require(cohort, Cohort, "change", "read one with shapespace.read_cohort")
    settings = settings or ChangeSettings()
    if cohort.gauge != "form":
        raise InputError("Changes are in millimetres, but this cohort has sizes divided out; read it with gauge form.")
    if cohort.unit != "mm":
        raise InputError("Changes are in millimetres, but these coordinates have no unit; give surfaces in mm.")
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
            f"{cohort.table.where}: none of its {len(single)} subjects has two visits ({list_names(single)}); give the "
            f"same subject in {settings.subject} and another time in {visits.column}."
        )
    groups = _groups(cohort, settings, visits, single)
    stable = stable_vertices(cohort, settings.stable)
    landmarks = cohort.landmarks or SurfaceLandmarks()
    regions = _regions(cohort, settings)
    parts = np.zeros((len(regions), cohort.n_vertices))
    for row, vertices in zip(parts, regions.values(), strict=True):
        row[vertices] = 1.0
    rescans = Rescans(cohort.reference, faces_in(cohort), landmarks, parts)
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
            drafts.append(_draft(cohort, name, found, landmarks, parts, source, visits.unit, closed=closed))
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
    observed: BoolArray | None

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
            self.name, group, self.visits, sums[0], rate, self.stable, self.area_mm2, self.before_mm3, self.observed,
        )  # fmt: skip


def _draft(
    cohort: Cohort,
    name: str,
    found: Aligned,
    landmarks: SurfaceLandmarks,
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
        moved = landmarks.interpolate(np.tensordot(weights, found.means, axes=1))
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
    return _Draft(name, told, tuple(sums), tuple(factors), stable, area, before_mm3, found.observed)


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


def _dispersion(
    answer: Change, maps: FloatArray, second: BoolArray, area: FloatArray, names: tuple[str, ...]
) -> DispersionTest | None:
    """Return the test of equal dispersion of the changes (N, V) of two groups, vertices weighted by their area."""
    settings, codes = answer.settings, second.astype(np.intp)
    rooted = maps * np.sqrt(area / area.mean())
    residual = rooted - np.stack([rooted[codes == k].mean(axis=0) for k in (0, 1)])[codes]
    leverage = 1.0 / np.bincount(codes)[codes]
    return dispersion_test(
        settings.group or "", residual, leverage, codes, names, maps.shape[1], settings.permutations, settings.seed
    )


def _blank(subjects: Sequence[SubjectChange]) -> BoolArray:
    """Return (V,) bool, where maps are blank: too few subjects, of all or of a group, observe the vertex."""
    every = np.ones(len(subjects[0].area_mm2), dtype=np.bool_)
    observed = np.stack([every if one.observed is None else one.observed for one in subjects])
    groups = np.array([one.group for one in subjects])
    shares = [observed[groups == group].mean(axis=0) for group in dict.fromkeys(groups.tolist())]
    return weights_of(np.min(shares, axis=0)) == 0


def _tested(answer: Change, groups: Mapping[str, str]) -> Change:
    """Return the same with its tests over subjects."""
    settings, subjects = answer.settings, answer.subjects
    if settings.rate and not answer.unit:
        raise InputError("Rates need times that are numbers or dates; leave out --rate, or name such a --time.")
    if len(subjects) < 2:
        return answer
    asked = [effect_of(subject, rate=settings.rate) for subject in subjects]
    maps = np.stack([one.along_mm for one in asked])
    blank, landmarks = _blank(subjects), answer.landmarks
    at_landmarks = landmarks.interpolate(maps.T)
    at_landmarks[blank[landmarks.corners].any(axis=1)] = 0.0
    # Vertices without variation are never significant, and are excluded from the maxima.
    maps[:, blank] = 0.0
    volumes = np.stack([one.volumes_mm3 for one in asked])
    area = np.mean([subject.area_mm2 for subject in subjects], axis=0)
    run = (settings.permutations, settings.seed)
    unequal = settings.unequal_variances
    whole, few = np.ones(len(answer.parts)), np.ones(len(landmarks))
    names: tuple[str, ...] = tuple(sorted(set(groups.values())))
    second = np.array([groups.get(subject.name) == names[1] for subject in subjects]) if names else None
    return replace(
        answer,
        blank=blank if blank.any() else None,
        group=mean_test(maps, area, *run),
        group_volumes=mean_test(volumes, whole, *run),
        group_landmarks=mean_test(at_landmarks.T, few, *run) if landmarks else None,
        between=None if second is None else difference_test(maps, second, area, *run, unequal_variances=unequal),
        between_volumes=None
        if second is None
        else difference_test(volumes, second, whole, *run, unequal_variances=unequal),
        groups=names,
        dispersion=None if second is None else _dispersion(answer, maps, second, area, names),
    )
