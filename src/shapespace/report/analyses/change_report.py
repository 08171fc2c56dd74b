"""Report of changes between visits: sentences, maps, tables, and the mean change as a morph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.cohort.table import list_names
from shapespace.geometry.normals import factor_to_draw, flip_factor
from shapespace.report.analyses.analysis_report import (
    REDUCED_MORPH_NOTE,
    AnalysisReport,
    Column,
    ResultTable,
    blank_sentence,
    cohort_report,
)
from shapespace.report.analyses.methods_section import (
    dispersion_sentence,
    is_dispersion_warning,
    multiplicity_sentence,
)
from shapespace.schemas import (
    CurvePart,
    MorphPart,
    Part,
    Series,
    SurfaceMapPart,
    TablePart,
    TextPart,
)
from shapespace.statistics.change_result import (
    ChangeResult,
    GroupDifferenceTests,
    MeanChangeTests,
    SubjectChange,
    change_or_rate,
    interval_of_mean,
)
from shapespace.statistics.map_tests import LEVEL, MapTest
from shapespace.statistics.observation_weights import blank_where
from shapespace.types import FloatArray, Mesh

ARRAYS, MAPS = "change.npz", "subjects.npz"
MOST_MAPS = 6
"""Subjects whose maps the report draws."""
# rows and curves of the report: what can be read without scrolling far, and curves that stay distinguishable
MOST_ROWS, MOST_CURVES = 50, 12
_LEVEL = LEVEL
_LEAST_ML_MM3 = 100.0
"""Volumes below this limit (mm³) are written in mm³, others in ml; 0.1 ml needs more than two decimals."""
_FEW = 10  # degrees of freedom; with fewer a standard deviation is known to no better than 22 %
_SOURCES = {
    "rescans": "Standard deviations are those of rescans.",
    "fits": "Standard deviations are those of the coefficients of the fits, propagated through modes and "
    "alignment, and widened where the stable part spreads more; variation outside the model is not included.",
    "stable": "Standard deviations are the spread over the stable part, the same for the entire surface; those of "
    "volumes are unknown.",
}


def change_report(change: ChangeResult) -> AnalysisReport:
    """Return the report of changes between visits, with its tables, arrays and meshes."""
    config = change.config
    arrays: dict[str, npt.NDArray[Any]] = {
        "before": change.before,
        "after": change.after,
        "faces": np.asarray(change.cohort.faces),
        "stable_share": np.mean([subject.stable for subject in change.subjects], axis=0),
    }
    parts: list[Part | ResultTable] = []
    if change.mean_change is not None:
        parts += _mean_change_parts(change, change.mean_change, arrays)
    if change.group_difference is not None:
        parts += _group_difference_parts(change, change.group_difference, arrays)
    parts += [
        *_noise_parts(change, arrays),
        *_subject_parts(change, arrays),
        *_time_series(change),
        SurfaceMapPart(
            title="Stable part", level=2, arrays=ARRAYS, vertices="before", values="stable_share",
            unit="share of subjects", signed=False, limit=1.0,
            note=f"Selected: {config.stable if isinstance(config.stable, str) else 'vertices of a list'}. The "
            "scans of a subject were aligned rigidly by these vertices.",
        ),
        *_file_tables(change),
    ]  # fmt: skip
    stable = config.stable
    return cohort_report(
        "change",
        "Change between visits",
        parts,
        change.cohort,
        summary=tuple(_summary(change)),
        arrays={ARRAYS: arrays, MAPS: _maps(change)},
        meshes={
            "before.ply": Mesh(change.before, change.cohort.faces, name="before"),
            "after.ply": Mesh(change.after, change.cohort.faces, name="after"),
        },
        notes=(*change.cohort.notes, *_notes(change)),
        settings={
            "subject": config.subject,
            "time": config.time,
            "order": config.order,
            "stable": str(stable) if isinstance(stable, str) or not isinstance(stable, Sequence) else list(stable),
            "group": config.group,
            "rate": config.rate,
            "permutations": config.permutations,
            "seed": config.seed,
            "variances": config.variances,
            "unequal_variances": change.methods.unequal_variances,
            "uncertainty": change.uncertainty,
        },
        methods=change.methods,
    )


def _summary(change: ChangeResult) -> Iterator[str]:
    subjects = change.subjects
    rms = float(np.median([subject.rms_mm for subject in subjects]))
    share = 100 * float(np.median([subject.beyond_share for subject in subjects]))
    subjects_text = subjects[0].name if len(subjects) == 1 else f"{len(subjects)} subjects"
    yield (
        f"{subjects_text} changed by {rms:.2f} mm (RMS along the "
        f"normals{'' if len(subjects) == 1 else ', median'}), and on "
        f"{share:.0f} % of the surface by more than its uncertainty, where noise alone gives 5 %."
    )
    if change.mean_change is not None:
        volumes = np.array([change_or_rate(subject, rate=change.config.rate).volumes_mm3[0] for subject in subjects])
        low, high = interval_of_mean(volumes)
        unit = _VolumeUnit.of(volumes.mean(), low, high)
        yield _test_sentence(change, change.mean_change.surface, "the mean change", "none")
        verb = "The volume changed by" if change.is_closed else "The open surface swept"
        yield (
            f"{verb} {unit.text(volumes.mean())} {unit.name}{_per_time(change)} on average (95 %: {unit.text(low)} to "
            f"{unit.text(high)}), "
            f"{_p_text(float(change.mean_change.volumes.p[0]))}."
        )
    if change.group_difference is not None:
        first, second = change.group_difference.groups
        yield _test_sentence(change, change.group_difference.surface, f"the change of {second}", f"that of {first}")
        difference = float(change.group_difference.volumes.effect[0])
        unit = _VolumeUnit.of(difference)
        yield (
            f"The volume of {second} changed by {unit.text(difference)} {unit.name}{_per_time(change)} "
            f"more than that of {first}, {_p_text(float(change.group_difference.volumes.p[0]))}."
        )
        unequal = change.group_difference.surface.unequal_variances
        yield from (
            dispersion_sentence(dispersion, unequal, "mm")
            for dispersion in change.methods.dispersions
            if is_dispersion_warning(dispersion, unequal_variances=unequal) or not dispersion.equal
        )
    if change.repeatability is None:
        yield f"There are no rescans, so the measurement noise is unknown. {_SOURCES[change.uncertainty]}"
    else:
        repeatability, smallest = change.repeatability, change.repeatability.smallest_mm
        least = float(repeatability.volumes_smallest_mm3[0])
        unit = _VolumeUnit.of(least)
        yield (
            f"By {repeatability.scans} scans of {repeatability.visits} "
            f"{'visit' if repeatability.visits == 1 else 'visits'} with rescans, the "
            f"smallest detectable change of one scan against another is {np.median(smallest):.2f} mm (median over the "
            f"surface; {smallest.max():.2f} mm at most), and {unit.text(least).lstrip('+')} {unit.name} of "
            "volume; smaller changes are noise."
        )
    if change.mean_change is not None:
        yield multiplicity_sentence(change.methods)


@dataclass(frozen=True)
class _VolumeUnit:
    """A unit of volumes: its name and its size in mm³."""

    name: str
    mm3: float

    @staticmethod
    def of(*mm3: float | FloatArray) -> _VolumeUnit:
        """Return ml if the largest of the volumes (mm³) is at least `_LEAST_ML_MM3`, else mm³."""
        largest = max((float(np.abs(volume).max(initial=0.0)) for volume in map(np.asarray, mm3)), default=0.0)
        return _VolumeUnit("mm³", 1.0) if largest < _LEAST_ML_MM3 else _VolumeUnit("ml", 1000.0)

    def text(self, mm3: float) -> str:
        """Return a volume, mm³, in this unit with its sign."""
        return f"{mm3 / self.mm3:+.2f}" if self.mm3 > 1 else f"{mm3:+.3g}"


def _test_sentence(change: ChangeResult, test: MapTest, quantity: str, other: str) -> str:
    vertex = int(np.abs(test.t).argmax())
    significant = test.p <= _LEVEL
    low, high = test.interval(vertex)
    vertices = (
        f"vertex by vertex (family-wise error {100 * _LEVEL:g} %) {int(significant.sum()):,} of {len(significant):,} "
        "vertices differ, "
        f"clearest by {test.effect[vertex]:+.2f} mm{_per_time(change)} (simultaneous 95 % interval {low:+.2f} to "
        f"{high:+.2f} "
        "mm)"
        if significant.any()
        else f"vertex by vertex (family-wise error {100 * _LEVEL:g} %) none differs (smallest p = {test.p[vertex]:.3g})"
    )
    differs = "differs from" if test.omnibus_p <= _LEVEL else "is not shown to differ from"
    if significant.any() and test.omnibus_p > _LEVEL:
        vertices = f"exploratory, since the test of the entire surface is not significant: {vertices}"
    limit = (
        f"; so few subjects can reach no p below {1 / test.permutations:.2g}" if 1 / test.permutations > _LEVEL else ""
    )
    return f"Over the entire surface, {quantity} {differs} {other} ({_p_text(test.omnibus_p)}); {vertices}{limit}."


def _p_text(p: float) -> str:
    return f"p = {p:.3g}"


def _per_time(change: ChangeResult) -> str:
    return f" per {change.time_unit}" if change.config.rate else ""


def _mean_change_parts(
    change: ChangeResult, tests: MeanChangeTests, arrays: dict[str, npt.NDArray[Any]]
) -> Iterator[Part | ResultTable]:
    test = tests.surface
    unit = f"mm{_per_time(change)}"
    arrays |= {
        "mean": blank_where(test.effect, change.blank),
        "mean_t": test.t,
        "mean_p": test.p,
        "mean_found": test.p <= _LEVEL,
    }
    grey = "" if change.blank is None else f" {blank_sentence(int(change.blank.sum()), len(change.blank))}"
    least = 1 / test.permutations
    marked = (
        f"No p can be below {least:.2g} with so few, so that nothing is marked."
        if least > _LEVEL
        else f"In full colour where the family-wise p is at most {_LEVEL:g}, by the maximum over vertices of |t| in "
        f"{test.permutations} sign flips{' (all there are)' if test.every else ''}; no p can be below {least:.2g}."
    )
    note = f"Mean of {test.n[0]} subjects along the normals, outwards positive. {marked}{grey}"
    yield SurfaceMapPart(
        title="The mean change", level=2, arrays=ARRAYS, vertices="before", values="mean",
        mask="" if least > _LEVEL else "mean_found", unit=unit, note=note,
    )  # fmt: skip
    yield _morph("From before to after", arrays, "before", "after", "mean first visit", "mean with its change")
    if len(change.regions) > 1:
        yield _region_table(change, tests.volumes)
    if tests.landmarks is not None:
        yield _landmark_table(change, tests.landmarks, unit)


def _region_table(change: ChangeResult, test: MapTest) -> Part:
    volumes = np.array([change_or_rate(subject, rate=change.config.rate).volumes_mm3 for subject in change.subjects])
    unit = _VolumeUnit.of(volumes.mean(axis=0))
    every = zip(change.regions, [own / unit.mm3 for own in volumes.T], test.p, strict=True)
    rows = [(name, float(own.mean()), *interval_of_mean(own), float(p)) for name, own, p in every]
    return TablePart.of(
        "Volumes swept", ("of", f"mean, {unit.name}", "low", "high", "p"), rows,
        note="With the 95 % interval of the mean; p is family-wise over all parts.",
    )  # fmt: skip


def _landmark_table(change: ChangeResult, test: MapTest, unit: str) -> ResultTable:
    maps = np.stack([change_or_rate(subject, rate=change.config.rate).along_mm for subject in change.subjects])
    names = ("mean", "stddev", "low", "high")
    every = zip(change.landmarks.names, change.landmarks.interpolate(maps.T), test.p, strict=True)
    return ResultTable(
        title="Landmarks",
        columns=(
            Column("landmark", field="landmark"), *(Column(name, "mm", name) for name in names), Column("p", "p", "p"),
        ),
        rows=[(name, own.mean(), own.std(ddof=1), *interval_of_mean(own), p) for name, own, p in every],
        note=f"Along the normals, {unit}, with the 95 % interval of the mean; p is family-wise over all landmarks.",
        file="group_landmarks.csv",
    )  # fmt: skip


def _group_difference_parts(
    change: ChangeResult, tests: GroupDifferenceTests, arrays: dict[str, npt.NDArray[Any]]
) -> list[Part]:
    (first, second), test = tests.groups, tests.surface
    arrays |= {
        "difference": blank_where(test.effect, change.blank),
        "difference_p": test.p,
        "difference_found": test.p <= _LEVEL,
    }
    note = (
        f"Mean change of {second} ({test.n[1]} subjects) less that of {first} ({test.n[0]}). In full colour where the "
        f"family-wise p is at most {_LEVEL:g}, by {test.permutations} "
        f"{'sign flips, with unequal variances' if test.unequal_variances else 'permutations of subjects'}"
        f"{' (all there are)' if test.every else ''}."
    )
    return [
        SurfaceMapPart(
            title=f"{second} compared with {first}", level=2, arrays=ARRAYS, vertices="before", values="difference",
            mask="difference_found", unit=f"mm{_per_time(change)}", note=note,
        )
    ]  # fmt: skip


def _noise_parts(change: ChangeResult, arrays: dict[str, npt.NDArray[Any]]) -> list[Part]:
    repeatability = change.repeatability
    if repeatability is None:
        text = f"There are no rescans: no subject was scanned twice at one visit. {_SOURCES[change.uncertainty]}"
        return [TextPart(title="Measurement noise", level=2, text=text)]
    arrays |= {"smallest_mm": repeatability.smallest_mm, "icc": repeatability.icc}
    rows: list[tuple[Any, ...]] = [
        (
            "surface (mm, median)",
            *(float(np.median(of)) for of in (repeatability.within_mm, repeatability.smallest_mm)),
            repeatability.shape_icc,
        ),
        *(
            (
                f"volume of {name} (mm3)",
                float(repeatability.volumes_within_mm3[k]),
                float(repeatability.volumes_smallest_mm3[k]),
                repeatability.volume_icc if k == 0 else None,
            )
            for k, name in enumerate(change.regions)
        ),
        *(
            (f"{name} (mm)", float(within), float(smallest), float(icc))
            for name, within, smallest, icc in zip(
                change.landmarks.names,
                repeatability.landmarks_within_mm,
                repeatability.landmarks_smallest_mm,
                change.landmarks.interpolate(repeatability.icc),
                strict=True,
            )
        ),
    ]
    few = (
        f" {repeatability.freedom} degrees of freedom are few, so these are rough."
        if repeatability.freedom < _FEW
        else ""
    )
    return [
        SurfaceMapPart(
            title="Measurement noise", level=2, arrays=ARRAYS, vertices="before",
            values="smallest_mm", signed=False,
            note="The smallest detectable change: 1.96 sqrt(2) times the within-subject standard deviation of "
            f"{repeatability.scans} scans of {repeatability.visits} visits. A smaller change between two scans is "
            f"noise.{few}",
        ),
        TablePart.of("Repeatability", ("of", "within-subject stddev", "smallest detectable change", "ICC"), rows),
    ]  # fmt: skip


def _subject_table(change: ChangeResult) -> ResultTable:
    every = len(change.subjects)
    more = f" The first {MOST_ROWS} of {every}; all are in subjects.csv." if every > MOST_ROWS else ""
    unit = _VolumeUnit.of(*(subject.change.volumes_mm3[0] for subject in change.subjects[:MOST_ROWS]))
    columns = [
        Column("subject", field="subject"), Column(field="group"), Column("first", field="first"),
        Column("last", field="last"), Column("RMS", "mm", "rms_mm"), Column(field="most_mm"),
        Column("beyond its uncertainty", "percent", "beyond_share"), Column(f"volume, {unit.name}", "number"),
        Column(f"stddev, {unit.name}", "number"), Column(field="volume_change_mm3"),
        Column(field="volume_change_stddev_mm3"),
        Column("of the volume before" if change.is_closed else "", "percent", "volume_change_share"),
        Column(field="visits"), Column(field="scans"), Column(field="median_stddev_mm"),
        Column("" if change.group_difference is None else "group"),
    ]  # fmt: skip
    if change.time_unit:
        rates = ("rms_rate", "volume_rate_mm3", "volume_rate_stddev_mm3", "time_unit")
        columns += [Column(field=name) for name in rates]
    rows: list[Sequence[Any]] = []
    for subject in change.subjects:
        volume, stddev = float(subject.change.volumes_mm3[0]), float(subject.change.volumes_stddev_mm3[0])
        observed = ... if subject.observed is None else subject.observed
        along = subject.change.along_mm[observed]
        row = [
            subject.name, subject.group, subject.visits[0].label, subject.visits[-1].label, subject.rms_mm,
            float(along[np.abs(along).argmax()]), subject.beyond_share, volume / unit.mm3, stddev / unit.mm3, volume,
            stddev, volume / subject.volume_before_mm3, len(subject.visits),
            sum(visit.scans for visit in subject.visits), float(np.median(subject.change.stddev_mm)), subject.group,
        ]  # fmt: skip
        if subject.rate is not None:
            row += [
                float(np.sqrt(np.average(subject.rate.along_mm**2, weights=subject.area_mm2))),
                float(subject.rate.volumes_mm3[0]),
                float(subject.rate.volumes_stddev_mm3[0]),
                change.time_unit,
            ]
        rows.append(row)
    return ResultTable(
        title="Subjects", level=2, columns=columns, rows=rows, file="subjects.csv", shown=range(MOST_ROWS),
        note=f"Last visit less first. {_SOURCES[change.uncertainty]}{more}",
    )  # fmt: skip


def _subject_parts(change: ChangeResult, arrays: dict[str, npt.NDArray[Any]]) -> Iterator[Part | ResultTable]:
    yield _subject_table(change)
    most = sorted(change.subjects, key=lambda subject: -subject.beyond_share)[:MOST_MAPS]
    for number, subject in enumerate(most, 1):
        before, after = change.surfaces(subject.name)
        key = f"subject{number}"
        arrays |= {
            f"{key}_before": before.vertices,
            f"{key}_after": after.vertices,
            f"{key}_change": blank_where(subject.change.along_mm, subject.unobserved),
            f"{key}_beyond": subject.change.beyond,
        }
        yield SurfaceMapPart(
            title=f"{subject.name}, {subject.visits[0].label} to {subject.visits[-1].label}", arrays=ARRAYS,
            vertices=f"{key}_before", values=f"{key}_change", mask=f"{key}_beyond",
            note=f"Outwards positive; in full colour where it exceeds {subject.change.quantile:.2f} standard "
            f"deviations (median of these {np.median(subject.change.stddev_mm):.2f} mm).",
        )  # fmt: skip
        if number == 1:
            yield _morph(
                f"{subject.name} from before to after", arrays, f"{key}_before", f"{key}_after",
                subject.visits[0].label, subject.visits[-1].label,
            )  # fmt: skip
    if len(change.subjects) > MOST_MAPS:
        yield TextPart(text=f"Maps of all {len(change.subjects)} subjects are in {MAPS}.")


def _morph(
    title: str, arrays: dict[str, npt.NDArray[Any]], low: str, high: str, low_label: str, high_label: str
) -> MorphPart:
    """Return the morph between two shapes of `arrays`; if triangles would flip, the difference is drawn smaller."""
    before, change = arrays[low], arrays[high] - arrays[low]
    times = factor_to_draw(1.0, flip_factor(before, change, arrays["faces"]))
    if times < 1:
        high = f"{high}_drawn"
        arrays[high] = before + times * change
    return MorphPart(
        title=title, arrays=ARRAYS, low=low, high=high, low_label=low_label, high_label=high_label, times=times,
        note="" if times == 1 else REDUCED_MORPH_NOTE,
    )  # fmt: skip


def _time_series(change: ChangeResult) -> list[Part]:
    if not change.time_unit or all(len(subject.visits) < 3 for subject in change.subjects):
        return []
    unit = _VolumeUnit.of(*(visit.volume_mm3 for subject in change.subjects[:MOST_CURVES] for visit in subject.visits))
    series = tuple(
        Series(
            label=subject.name,
            x=tuple(visit.time for visit in subject.visits),
            y=tuple(visit.volume_mm3 / unit.mm3 for visit in subject.visits),
        )
        for subject in change.subjects[:MOST_CURVES]
    )
    every = len(change.subjects)
    more = f" The first {MOST_CURVES} of {every}; all are in visits.csv." if every > MOST_CURVES else ""
    return [
        CurvePart(
            title="Over time",
            level=2,
            series=series,
            x=change.time_unit,
            y=f"volume since the first visit, {unit.name}",
            note=f"Rates are the slopes of straight lines through these, in subjects.csv.{more}",
        )
    ]


def _file_tables(change: ChangeResult) -> Iterator[ResultTable]:
    """Yield the tables that are files alone."""
    yield ResultTable.of_fields(
        "visits.csv",
        ("subject", "visit", "time", "scans", "rms_since_first_mm", "volume_since_first_mm3"),
        [
            (subject.name, visit.label, visit.time, visit.scans, visit.rms_mm, visit.volume_mm3)
            for subject in change.subjects
            for visit in subject.visits
        ],
    )
    if len(change.regions) > 1:
        yield ResultTable.of_fields(
            "regions.csv",
            ("subject", "region", "volume_change_mm3", "stddev_mm3"),
            [
                (subject.name, name, float(subject.change.volumes_mm3[k]), float(subject.change.volumes_stddev_mm3[k]))
                for subject in change.subjects
                for k, name in enumerate(change.regions)
            ],
        )
    if change.landmarks:
        yield ResultTable.of_fields(
            "landmarks.csv",
            ("subject", "landmark", "x_mm", "y_mm", "z_mm", "moved_mm", "stddev_mm", "along_normal_mm",
             "along_normal_stddev_mm", "smallest_detectable_mm"),
            [row for subject in change.subjects for row in _landmark_rows(change, subject)],
        )  # fmt: skip


def _landmark_rows(change: ChangeResult, subject: SubjectChange) -> list[Sequence[object]]:
    estimate, repeatability = subject.change, change.repeatability
    along, stddev = change.landmarks.interpolate(np.stack([estimate.along_mm, estimate.stddev_mm], axis=1)).T
    smallest = (
        [None] * len(change.landmarks)
        if repeatability is None
        else list(map(float, repeatability.landmarks_smallest_mm))
    )
    return [
        (
            subject.name,
            name,
            *map(float, estimate.landmarks_mm[k]),
            float(np.linalg.norm(estimate.landmarks_mm[k])),
            float(estimate.landmarks_stddev_mm[k]),
            float(along[k]),
            float(stddev[k]),
            smallest[k],
        )
        for k, name in enumerate(change.landmarks.names)
    ]


def _maps(change: ChangeResult) -> dict[str, npt.NDArray[Any]]:
    def single(values: Sequence[FloatArray]) -> npt.NDArray[Any]:
        return np.stack(values).astype(np.float32)

    rates = [change_or_rate(subject, rate=True) for subject in change.subjects] if change.time_unit else []
    return {
        "subjects": np.array([subject.name for subject in change.subjects]),
        "change_mm": single([blank_where(subject.change.along_mm, subject.unobserved) for subject in change.subjects]),
        "stddev_mm": single([subject.change.stddev_mm for subject in change.subjects]),
        "beyond": np.stack([subject.change.beyond for subject in change.subjects]),
        **({"rate_mm": single([rate.along_mm for rate in rates])} if rates else {}),
        **({"rate_stddev_mm": single([rate.stddev_mm for rate in rates])} if rates else {}),
    }


def _notes(change: ChangeResult) -> Iterator[str]:
    if change.single_visit_subjects:
        alone, every = len(change.single_visit_subjects), len(change.subjects) + len(change.single_visit_subjects)
        names = list_names(change.single_visit_subjects)
        yield f"{alone} of {every} subjects are excluded because they have one visit ({names})."
    ends = {(subject.visits[0].label, subject.visits[-1].label) for subject in change.subjects}
    if not change.time_unit and len(ends) > 1:
        pairs_of_visits = list_names([f"{first} to {last}" for first, last in sorted(ends)])
        yield f"Not all subjects have the same first and last visit ({pairs_of_visits})."
    if change.is_model_only:
        yield ("The surfaces are those of the model, so changes outside its span are missing; fit with --dense.")
