"""Changes between visits come back in mm, whatever pose and noise; what is noise is told as it is."""

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table
from shapespace.errors import InputError
from shapespace.geometry.normals import enclosed_volume, face_vectors, vertex_areas, vertex_normals
from shapespace.geometry.similarity import fit_similarity
from shapespace.report.analyses.result_report import analysis_report
from shapespace.schemas import Analysis, MorphPart, SurfaceMapPart, TablePart, read, read_part
from shapespace.statistics.change_align import align_by, align_robustly
from shapespace.statistics.change_maps import align_visits, swept_mm3
from shapespace.statistics.change_result import ChangeConfig
from shapespace.statistics.change_visits import visits_of
from shapespace.statistics.map_tests import difference_test, mean_test
from shapespace.statistics.measure_change import ChangeResult, change
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks
from synthetic_shapes import blob, blob_model, sphere

V = 400
ORDER = ("before", "after")
TIP = int(sphere(V)[0][:, 2].argmax())


def person(seed: int) -> Mesh:
    d, faces = sphere(V)
    return Mesh(blob(d, 0.5 * np.random.default_rng([5, seed]).standard_normal(5)), faces)


@cache
def bump() -> FloatArray:
    """A smooth bump (V,) of height 1 about the tip."""
    x = person(0).vertices
    return np.exp(-0.5 * (np.linalg.norm(x - x[TIP], axis=1) / 25.0) ** 2)


def pushed(mesh: Mesh, mm: FloatArray) -> FloatArray:
    return mesh.vertices + mm[:, None] * vertex_normals(mesh)


def posed(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    return x @ Rotation.random(random_state=rng).as_matrix().T + rng.uniform(-100, 100, 3)


def cohort_of(scans: Sequence[FloatArray], columns: Mapping[str, Sequence[object]], **more: object) -> Cohort:
    marks = {"tip": TIP, "back": int(sphere(V)[0][:, 2].argmin())}
    cohort = Cohort.of_shapes(np.stack(scans), columns, faces=sphere(V)[1], gauge="form", landmarks=marks)
    return replace(cohort, **more)


def pairs(
    changes: Sequence[FloatArray],
    *,
    noise_mm: float = 0.1,
    rescans: bool = False,
    seed: int = 0,
    **columns: Sequence[str],
) -> Cohort:
    """Return s0, s1, ... before and after being pushed outwards by `changes`, each scan in a pose of its own."""
    rng = np.random.default_rng(seed)
    scans: list[FloatArray] = []
    told: dict[str, list[object]] = {"subject": [], "visit": [], **{name: [] for name in columns}}
    for k, mm in enumerate(changes):
        mesh = person(k)
        for visit, x in (("before", mesh.vertices), ("after", pushed(mesh, mm))):
            for _ in range(2 if rescans else 1):
                scans.append(posed(x + noise_mm * rng.standard_normal(x.shape), rng))
                told["subject"].append(f"s{k}")
                told["visit"].append(visit)
                for name, values in columns.items():
                    told[name].append(values[k])
    return cohort_of(scans, told)


def asked(cohort: Cohort, **settings: object) -> ChangeResult:
    return change(cohort, ChangeConfig(order=ORDER, **settings))  # type: ignore[arg-type]


# Alignment and maps


def test_half_a_surface_that_moved_by_3_mm_is_brought_back_where_least_squares_smears() -> None:
    mesh, rng = person(3), np.random.default_rng(0)
    area = vertex_areas(mesh)
    half = mesh.vertices[:, 2] > np.median(mesh.vertices[:, 2])
    after = pushed(mesh, 3.0 * half) + 0.1 * rng.standard_normal((V, 3))
    normals = vertex_normals(mesh)

    def along(moved: FloatArray) -> FloatArray:
        return ((moved - mesh.vertices) * normals).sum(axis=1)

    moved = posed(after, rng)
    T, weights = align_robustly(moved, mesh.vertices, area)
    found = along(T.apply(moved))
    assert np.abs(found[half] - 3.0).mean() < 0.15 and np.abs(found[~half]).mean() < 0.15
    assert weights[half].sum() < 0.02 * weights.sum()
    smeared = along(align_by(moved, mesh.vertices, area, np.arange(V, dtype=np.int32))[0].apply(moved))
    assert np.abs(smeared[~half]).mean() > 0.3


def test_what_stays_is_found_where_more_than_half_moves_away_as_one() -> None:
    mesh, rng = person(3), np.random.default_rng(0)
    still = mesh.vertices[:, 1] > np.quantile(mesh.vertices[:, 1], 0.55)
    turn = Rotation.from_rotvec([0.3, 0.0, 0.1]).as_matrix().T
    after = np.where(still[:, None], mesh.vertices, mesh.vertices @ turn + 0.03 * mesh.vertices**2 / 100)
    moved = posed(after + 0.05 * rng.standard_normal((V, 3)), rng)
    T, weights = align_robustly(moved, mesh.vertices, vertex_areas(mesh))
    assert np.linalg.norm(T.apply(moved) - mesh.vertices, axis=1)[still].max() < 0.4
    assert weights[~still].sum() < 0.02 * weights.sum()


def test_without_a_change_the_robust_alignment_is_nearly_as_sharp_as_least_squares() -> None:
    mesh, rng = person(3), np.random.default_rng(0)
    area, every = vertex_areas(mesh), np.arange(V, dtype=np.int32)
    off_mm2 = 0.0
    for _ in range(10):
        moved = posed(mesh.vertices + rng.standard_normal((V, 3)), rng)
        robust, squares = (align_by(moved, mesh.vertices, area, stable)[0].apply(moved) for stable in (None, every))
        off_mm2 += float(((robust - squares) ** 2).sum()) / (10 * V)
    assert np.sqrt(off_mm2) < 0.1  # of noise of 1 mm; the error of least squares itself is about 0.12


@pytest.mark.parametrize("stable", ["auto", "landmarks:back,90"])
def test_a_bump_comes_back_in_millimetres_from_other_poses_and_noise(stable: str) -> None:
    found = asked(pairs([3.0 * bump(), -2.0 * bump(), 0.0 * bump()]), stable=stable)
    for subject, true in zip(found.subjects, (3.0, -2.0, 0.0), strict=True):
        weights = bump() * subject.area_mm2
        assert weights @ subject.change.along_mm / (weights @ bump()) == pytest.approx(true, abs=0.1)
        nothing = bump() < 0.01
        assert np.sqrt((subject.change.along_mm[nothing] ** 2).mean()) < 0.2


def test_turning_and_moving_the_scans_changes_nothing() -> None:
    rng = np.random.default_rng(9)
    cohort = pairs([3.0 * bump(), bump()], rescans=True)
    turned = cohort_of(
        [posed(cohort.vertices(k), rng) for k in range(len(cohort))],
        {name: cohort.table.texts(name) for name in ("subject", "visit")},
    )
    one, other = asked(cohort), asked(turned)
    for a, b in zip(one.subjects, other.subjects, strict=True):
        np.testing.assert_allclose(a.change.along_mm, b.change.along_mm, atol=1e-6)
        np.testing.assert_allclose(a.change.stddev_mm, b.change.stddev_mm, atol=1e-6)
        np.testing.assert_allclose(a.change.volumes_mm3, b.change.volumes_mm3, rtol=1e-6, atol=1e-3)


def test_the_volume_swept_is_the_difference_of_volumes_of_closed_surfaces_and_that_of_a_slab() -> None:
    rng = np.random.default_rng(0)
    one, faces = person(1), sphere(V)[1]
    other = person(2).vertices + rng.standard_normal((V, 3))
    swept = swept_mm3(one.vertices, other, faces)
    assert swept.sum() == pytest.approx(enclosed_volume(other, faces) - enclosed_volume(one.vertices, faces), rel=1e-9)
    square = np.array([[0.0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]])
    sheet = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    assert swept_mm3(square, square + np.array([3.0, 1.0, 2.0]), sheet).sum() == pytest.approx(200.0)


def test_a_surface_that_grew_as_a_whole_tells_its_volume_and_share() -> None:
    mesh, nearly = person(0), person(1).vertices + 1.0
    nearly[0] += 0.01  # or it would be refused as a copy
    scans = [mesh.vertices, 1.02 * mesh.vertices, person(1).vertices, nearly]
    cohort = cohort_of(scans, {"subject": ["a", "a", "b", "b"], "visit": ["before", "after"] * 2})
    grown = asked(cohort, stable="all").by_name["a"]
    assert grown.change.volumes_mm3[0] / grown.volume_before_mm3 == pytest.approx(1.02**3 - 1, rel=1e-6)
    still = asked(cohort, stable="all").by_name["b"]
    assert still.rms_mm < 1e-3 and abs(still.change.volumes_mm3[0]) < 10


def test_regions_and_landmarks_tell_where_it_changed() -> None:
    near = np.flatnonzero(bump() > 0.05)
    far = np.flatnonzero(bump() < 0.01)
    found = asked(pairs([3.0 * bump()] * 2, noise_mm=0.02), regions={"nose": near, "rest": far})
    assert found.regions == ("whole", "nose", "rest")
    for subject in found.subjects:
        whole, nose, rest = subject.change.volumes_mm3
        assert abs(rest) < 0.05 * nose and whole == pytest.approx(nose, rel=0.1)
        tip, back = subject.change.landmarks_mm
        assert np.linalg.norm(tip) == pytest.approx(3.0, abs=0.15) and np.linalg.norm(back) < 0.15


def test_a_landmark_between_vertices_moves_as_its_place_in_the_triangle_does() -> None:
    cohort = pairs([3.0 * bump(), 2.0 * bump(), bump()], rescans=True, noise_mm=0.2)
    face = np.asarray(cohort.faces)[(np.asarray(cohort.faces) == TIP).any(axis=1)][0]
    weights = np.array([0.5, 0.3, 0.2])
    whole = SurfaceLandmarks(("between",), face[None], weights[None])
    corners = SurfaceLandmarks.of({str(k): int(v) for k, v in enumerate(face)})
    one, three = (asked(replace(cohort, landmarks=marks), stable="all") for marks in (whole, corners))
    for subject, parts in zip(one.subjects, three.subjects, strict=True):
        np.testing.assert_allclose(subject.change.landmarks_mm[0], weights @ parts.change.landmarks_mm, atol=1e-12)
    assert (
        one.mean_change is not None
        and one.mean_change.landmarks is not None
        and one.repeatability is not None
        and three.repeatability is not None
    )
    maps = np.stack([subject.change.along_mm[face] @ weights for subject in one.subjects])
    np.testing.assert_allclose(one.mean_change.landmarks.effect, [maps.mean()])
    # Noise of a weighted mean is at most the weighted mean of the noise.
    within = three.repeatability.landmarks_within_mm
    assert 0.3 * within.min() < one.repeatability.landmarks_within_mm[0] < weights @ within


# What is noise


def test_the_smallest_detectable_change_is_the_formula_by_brute_force() -> None:
    cohort = pairs([bump(), 2 * bump(), 0 * bump()], rescans=True, noise_mm=0.3)
    found = asked(cohort, stable="all").repeatability
    assert found is not None and (found.scans, found.visits, found.freedom) == (12, 6, 6)
    squares, moved, volumes = np.zeros(V), 0.0, 0.0
    visits = visits_of(cohort.table, "subject", None, ORDER)
    for own in visits.by_subject.values():
        subject = align_visits(cohort, own, np.arange(V, dtype=np.int32))
        base = subject.means[0]
        for scans in subject.scans:
            for v in range(V):
                values = [float((scan[v] - base[v]) @ subject.normals[v]) for scan in scans]
                squares[v] += sum((value - sum(values) / len(values)) ** 2 for value in values)
            moved += sum(((scan[TIP] - (scans[0][TIP] + scans[1][TIP]) / 2) ** 2).sum() for scan in scans)
            own_volumes = [enclosed_volume(scan, sphere(V)[1]) for scan in scans]
            volumes += sum((value - sum(own_volumes) / 2) ** 2 for value in own_volumes)
    factor = 1.96 * 2**0.5
    np.testing.assert_allclose(found.smallest_mm, factor * np.sqrt(squares / 6), rtol=1e-9)
    assert found.landmarks_smallest_mm[0] == pytest.approx(factor * np.sqrt(moved / 6))
    assert found.volumes_smallest_mm3[0] == pytest.approx(factor * np.sqrt(volumes / 6), rel=1e-6)
    assert 0.25 < np.median(found.within_mm) < 0.35


def test_rescans_give_standard_deviations_of_one_scan_less_another_and_of_means() -> None:
    cohort = pairs([bump(), bump()], rescans=True)
    fewer = cohort.take([0, 1, 2, 4, 6])
    found = asked(fewer)
    assert found.uncertainty == "rescans" and found.repeatability is not None
    within = found.repeatability.within_mm
    np.testing.assert_allclose(found.by_name["s0"].change.stddev_mm, within * np.sqrt(1.5))
    np.testing.assert_allclose(found.by_name["s1"].change.stddev_mm, within * np.sqrt(2.0))
    assert found.subjects[0].change.quantile == pytest.approx(12.706, abs=1e-3)


def test_the_intraclass_correlation_is_that_of_an_analysis_of_variance() -> None:
    cohort = pairs([0 * bump()] * 4, rescans=True, noise_mm=1.0)
    found = asked(cohort, stable="all").repeatability
    assert found is not None
    area = vertex_areas(Mesh(cohort.reference, cohort.faces))
    groups: list[FloatArray] = []
    for own in visits_of(cohort.table, "subject", None, ORDER).by_subject.values():
        scans = align_visits(cohort, own, np.arange(V, dtype=np.int32)).scans[0]
        T = fit_similarity(scans.mean(axis=0), cohort.reference, area, with_scale=False)
        groups.append(np.stack([T.apply(scan) for scan in scans]))
    grand = np.concatenate(groups).mean(axis=0)
    between = sum(len(scans) * (scans.mean(axis=0) - grand) ** 2 for scans in groups).sum(axis=1) / 3  # type: ignore[union-attr]
    within = sum(((scans - scans.mean(axis=0)) ** 2).sum(axis=0) for scans in groups).sum(axis=1) / 4  # type: ignore[union-attr]
    np.testing.assert_allclose(found.icc, (between - within) / (between + within), rtol=1e-6)
    whole = (between.sum() - within.sum()) / (between.sum() + within.sum())
    assert found.shape_icc == pytest.approx(whole) and 0.3 < whole < 0.99


def fitted_pairs(subjects: int, stddev_mm: float, stated_mm: float) -> Cohort:
    """Return fits of scans that did not change, with coefficients off by one standard deviation and another stated."""
    model, rng = blob_model(V, gauge="form"), np.random.default_rng(1)
    true = np.repeat(0.5 * model.stddev * rng.standard_normal((subjects, model.n_modes)), 2, axis=0)
    b = true + stddev_mm * rng.standard_normal(true.shape)
    names = tuple(f"scan {k}" for k in range(len(b)))
    stated = np.full(b.shape, stated_mm)
    fitted = FitDiagnostics(model, b, stated, ("converged",) * len(b), "out")
    columns = {
        "subject": tuple(f"s{k // 2}" for k in range(len(b))),
        "visit": tuple(("before", "after")[k % 2] for k in range(len(b))),
    }
    sizes = np.array([np.linalg.norm(x - x.mean(axis=0)) for x in map(model.reconstruct, b)])
    return Cohort.of_fits(fitted, names, Table(columns, names), sizes, "form")


def test_standard_deviations_of_fits_are_the_spread_that_their_coefficients_make() -> None:
    found = asked(fitted_pairs(150, 4.0, 4.0), stable="landmarks:back,100", permutations=1)
    assert found.uncertainty == "fits" and found.is_model_only
    assert any("fit with --dense" in note for note in analysis_report(found).notes)
    observed = np.sqrt(np.mean([one.change.along_mm**2 for one in found.subjects], axis=0))
    told = np.sqrt(np.mean([one.change.stddev_mm**2 for one in found.subjects], axis=0))
    largest = told > 0.3 * told.max()
    assert 0.85 < np.median(observed[largest] / told[largest]) < 1.1
    volume = [(one.change.volumes_mm3[0], one.change.volumes_stddev_mm3[0]) for one in found.subjects]
    assert 0.75 < np.std([v for v, _ in volume]) / np.sqrt(np.mean([s**2 for _, s in volume])) < 1.1
    marks = np.array([[np.linalg.norm(m) for m in one.change.landmarks_mm] for one in found.subjects])
    stated = np.array([one.change.landmarks_stddev_mm for one in found.subjects])
    tip = list(found.landmarks).index("tip")
    assert 0.75 < np.sqrt((marks[:, tip] ** 2).mean() / (stated[:, tip] ** 2).mean()) < 1.1


def test_fits_that_state_too_little_are_widened_by_what_the_stable_part_shows() -> None:
    right = asked(fitted_pairs(10, 4.0, 4.0), stable="all", permutations=1)
    bold = asked(fitted_pairs(10, 4.0, 0.4), stable="all", permutations=1)
    ratio = [
        np.median(b.change.stddev_mm / r.change.stddev_mm) for b, r in zip(bold.subjects, right.subjects, strict=True)
    ]
    assert 0.4 < np.median(ratio) <= 1.0


def test_without_rescans_it_says_so_and_goes_by_the_stable_part() -> None:
    found = asked(pairs([3 * bump()] * 2, noise_mm=0.2))
    assert found.repeatability is None and found.uncertainty == "stable"
    for subject in found.subjects:
        assert np.ptp(subject.change.stddev_mm) == 0 and subject.change.stddev_mm[0] == pytest.approx(0.28, abs=0.08)
        assert np.isnan(subject.change.volumes_stddev_mm3[0])
    assert any("no rescans" in sentence for sentence in analysis_report(found).summary)


# Series


def test_a_series_gives_rates_and_dates_give_years() -> None:
    mesh, rng = person(0), np.random.default_rng(0)
    days = (0, 365.25, 730.5, 1461)
    scans = [pushed(mesh, day / 365.25 * 0.5 * bump()) + 0.02 * rng.standard_normal((V, 3)) for day in days]
    dates = ("2020-01-01", "2020-12-31", "2021-12-31", "2024-01-01")
    others = [scan + 0.02 * rng.standard_normal((V, 3)) for scan in scans[:2]]
    cohort = cohort_of([*scans, *others], {
        "subject": [*"aaaa", *"bb"], "date": [*dates, *dates[:2]], "months": [0, 12, 24, 48, 0, 12],
    })  # fmt: skip
    weights = bump()
    for time, per_unit, unit in (("date", 0.5, "year"), ("months", 0.5 / 12, "unit of months")):
        found = change(cohort, ChangeConfig(time=time, rate=True, stable="landmarks:back,90"))
        for subject in found.subjects:
            assert subject.rate is not None
            assert weights @ subject.rate.along_mm / (weights @ weights) == pytest.approx(
                per_unit, rel=0.12 if subject.name == "b" else 0.02
            )
        assert found.time_unit == unit and found.mean_change is not None
        assert found.mean_change.surface.effect[TIP] == pytest.approx(per_unit, rel=0.15)
    assert [visit.label for visit in found.by_name["a"].visits] == ["0", "12", "24", "48"]
    assert any(part.title == "Over time" for part in analysis_report(found).parts)


# Groups


def smooth_noise(rng: np.random.Generator, n: int) -> FloatArray:
    return rng.standard_normal((n, 6)) @ np.cos(np.outer(np.arange(6), np.linspace(0, np.pi, 40))) + 0.3 * (
        rng.standard_normal((n, 40))
    )


def test_error_over_all_vertices_is_held_for_the_mean_and_for_two_groups() -> None:
    rng, area = np.random.default_rng(0), np.ones(40)
    second = np.arange(12) < 5
    found = {"mean": 0, "groups": 0, "omnibus": 0, "each vertex": 0}
    for study in range(300):
        maps = smooth_noise(rng, 12)
        mean, groups = mean_test(maps, area, 99, study), difference_test(maps, second, area, 99, study)
        found["mean"] += mean.p.min() <= 0.05
        found["groups"] += groups.p.min() <= 0.05
        found["omnibus"] += mean.omnibus_p <= 0.05
        found["each vertex"] += np.abs(mean.t).max() > 2.2
    assert all(3 <= found[name] <= 28 for name in ("mean", "groups", "omnibus")), found  # 5 % are 15, ± 3.4 stddev
    assert found["each vertex"] > 60


def test_permutations_are_all_there_are_where_they_are_few_as_brute_force_has_it() -> None:
    rng = np.random.default_rng(3)
    maps = smooth_noise(rng, 6) + 0.8
    found = mean_test(maps, np.ones(40), 1000, 0)

    def t_of(x: FloatArray) -> FloatArray:
        return x.mean(axis=0) / (x.std(axis=0, ddof=1) / np.sqrt(len(x)))

    flips = [t_of(maps * np.array(signs)[:, None]) for signs in itertools.product((1, -1), repeat=6)]
    largest = np.array([np.abs(t).max() for t in flips])
    np.testing.assert_allclose(found.t, t_of(maps))
    np.testing.assert_allclose(found.p, [(largest >= abs(t) - 1e-9).mean() for t in t_of(maps)])
    assert found.every and found.permutations == 32

    second = np.array([True, False, True, False, False, True])
    between = difference_test(maps, second, np.ones(40), 1000, 0)
    overall = [
        float(((maps[list(chosen)].mean(axis=0) - np.delete(maps, chosen, 0).mean(axis=0)) ** 2).sum())
        for chosen in itertools.combinations(range(6), 3)
    ]
    own = float((between.effect**2).sum())
    assert between.omnibus_p == pytest.approx(np.mean(np.array(overall) >= own - 1e-9))
    np.testing.assert_allclose(between.effect, maps[second].mean(axis=0) - maps[~second].mean(axis=0))


def test_treatment_against_control_is_found_where_it_is() -> None:
    arms = ["treated"] * 5 + ["control"] * 5
    cohort = pairs([(1.0 if arm == "treated" else 0.0) * bump() for arm in arms], noise_mm=0.1, arm=arms)
    found = asked(cohort, group="arm", permutations=300)
    assert not found.is_model_only
    assert found.group_difference is not None and found.group_difference.groups == ("control", "treated")
    assert found.group_difference.surface.effect[TIP] == pytest.approx(1.0, abs=0.2)
    assert (
        found.group_difference.surface.p[TIP] <= 0.05
        and found.group_difference.surface.omnibus_p <= 0.02
        and found.group_difference.volumes.p[0] <= 0.02
    )
    assert (found.group_difference.surface.p[bump() < 0.01] <= 0.05).mean() < 0.05
    assert {subject.name: subject.group for subject in found.subjects}["s9"] == "control"


# What is kept


def test_the_answer_is_the_same_by_its_seed_and_its_parts_are_bounded(tmp_path: Path) -> None:
    arms = ["a", "b"] * 5
    cohort = pairs([k / 5 * bump() for k in range(10)], rescans=True, arm=arms)
    told = []
    for folder in ("one", "two"):
        answer = analysis_report(asked(cohort, group="arm", permutations=50, seed=4, stable="all"))
        path, parts = answer.save(tmp_path / folder), answer.parts
        told.append({**json.loads(path.read_text()), "created": ""})
    assert told[0] == told[1]
    analysis = read(Analysis, told[0], "analysis.json", "again")
    assert [type(read_part(part, "analysis.json")) for part in analysis.parts] == [type(part) for part in parts]
    assert analysis.question == "change" and analysis.settings["seed"] == 4
    with np.load(tmp_path / "one" / "change.npz") as arrays:
        for part in parts:
            if isinstance(part, SurfaceMapPart):
                assert arrays[part.values].shape == (V,) and arrays[part.vertices].shape == (V, 3)
            if isinstance(part, MorphPart):
                assert arrays[part.low].shape == arrays[part.high].shape == (V, 3)
    assert sum(isinstance(part, SurfaceMapPart) for part in parts) <= 10
    assert len((tmp_path / "one" / "subjects.csv").read_text().splitlines()) == 11
    with np.load(tmp_path / "one" / "subjects.npz") as maps:
        assert maps["change_mm"].shape == (10, V)


def test_a_noisy_change_is_drawn_as_a_part_so_that_no_triangle_turns_over() -> None:
    noise = np.random.default_rng(5).normal(0, 12.0, (V, 3))
    x = person(1).vertices
    found = asked(cohort_of([x, x + noise], {"subject": ["a", "a"], "time": ["before", "after"]}), stable="all")
    answer = analysis_report(found)
    [morph] = [part for part in answer.parts if isinstance(part, MorphPart)]
    arrays = answer.arrays["change.npz"]
    low, high, faces = (arrays[name] for name in (morph.low, morph.high, morph.faces))
    whole = arrays[morph.high.removesuffix("_drawn")]
    area = face_vectors(low, faces)
    assert (np.einsum("fd,fd->f", face_vectors(whole, faces), area) <= 0).any()
    assert (np.einsum("fd,fd->f", face_vectors(high, faces), area) > 0).all()
    assert 0 < morph.times < 1 and np.allclose(high - low, morph.times * (whole - low))
    assert "Drawn smaller" in morph.note


@pytest.mark.parametrize(("mm", "unit"), [(2.0, "ml"), (0.002, "mm³")])
def test_volumes_below_a_tenth_of_a_millilitre_are_stated_in_cubic_millimetres(mm: float, unit: str) -> None:
    answer = analysis_report(asked(pairs([mm * bump() for _ in range(4)], rescans=True, noise_mm=0.002)))
    assert any(f" {unit} on average" in sentence for sentence in answer.summary)
    tables = [part for part in answer.parts if isinstance(part, TablePart) and part.title == "Subjects"]
    columns = [column.name for table in tables for column in table.columns]
    assert f"volume, {unit}" in columns and f"stddev, {unit}" in columns


def uneven(arms: int = 16) -> Cohort:
    """Changes whose mean is alike in both arms, and three times as variable in the smaller one."""
    rng = np.random.default_rng(1)
    arm = ["treated" if k < arms // 4 else "control" for k in range(arms)]
    # Standard deviations in mm of the height of the bump.
    return pairs([rng.normal(0, 3.0 if name == "treated" else 1.0) * bump() for name in arm], arm=arm)


def test_unequal_dispersion_of_two_groups_is_a_warning_in_the_summary_and_the_analysis(tmp_path: Path) -> None:
    found = asked(uneven(), group="arm", permutations=199, stable="all", variances="equal")
    (one,) = found.methods.dispersions
    assert (
        not one.equal
        and one.smaller_is_more_variable
        and one.counts == (12, 4)
        and found.group_difference is not None
        and found.group_difference.dispersion is not None
    )
    answer = analysis_report(found)
    (warning,) = [sentence for sentence in answer.summary if sentence.startswith("Warning: dispersion")]
    assert "differences are found that do not exist" in warning and "--variances unequal" in warning
    kept = json.loads(answer.save(tmp_path).read_text())
    assert kept["methods"]["dispersions"][0]["equal"] is False
    allowed = asked(uneven(), group="arm", permutations=199, stable="all", variances="unequal")
    assert allowed.group_difference is not None and allowed.group_difference.surface.unequal_variances
    assert not [sentence for sentence in analysis_report(allowed).summary if sentence.startswith("Warning: dispersion")]
    chosen = asked(uneven(), group="arm", permutations=199, stable="all").group_difference
    assert chosen is not None and chosen.surface.omnibus_p == allowed.group_difference.surface.omnibus_p
    assert (
        allowed.group_difference.surface.omnibus_p > found.group_difference.surface.omnibus_p
        if found.group_difference is not None
        else False
    )


def test_the_methods_count_subjects_of_each_group_and_name_each_test() -> None:
    found = asked(uneven(), group="arm", permutations=199, stable="all", variances="equal")
    sizes = {one.classes: (one.subjects, one.shapes) for one in found.methods.sizes}
    assert sizes == {("control",): (12, 24), ("treated",): (4, 8)}
    assert [(one.resampling, one.statistic) for one in found.methods.tests] == [
        ("sign flips", "t"),
        ("permutation", "t"),
    ]
    assert found.methods.unit == "mm" and found.methods.unequal_variances is False
    last = [part.title for part in analysis_report(found).parts][-4:]
    assert last == ["Methods", "Sample sizes", "Tests", "Equal dispersion of groups"]


def test_an_interval_of_a_map_holds_the_effect_and_not_0_where_p_is_small() -> None:
    rng = np.random.default_rng(3)
    maps = rng.normal(size=(12, 30)) + 2.0 * (np.arange(30) < 5)
    test = mean_test(maps, np.ones(30), 400, 0)
    for vertex in range(30):
        low, high = test.interval(vertex)
        assert low < test.effect[vertex] < high
        assert (low > 0 or high < 0) == (test.p[vertex] <= 0.05)


def test_one_subject_alone_has_maps_and_no_test() -> None:
    found = asked(pairs([2 * bump()], rescans=True))
    assert found.mean_change is None
    assert any(isinstance(part, MorphPart) for part in analysis_report(found).parts)
    before, after = found.surfaces("s0")
    assert before.vertices.shape == after.vertices.shape == (V, 3)


# Bad input


def cells(**columns: Sequence[object]) -> Cohort:
    rng = np.random.default_rng(0)
    count = len(next(iter(columns.values())))
    return cohort_of([person(0).vertices + rng.standard_normal((V, 3)) for _ in range(count)], columns)


def refusal(cohort: Cohort, **settings: object) -> str:
    with pytest.raises(InputError) as caught:
        change(cohort, ChangeConfig(**settings))  # type: ignore[arg-type]
    text = str(caught.value)
    assert text.endswith(".") and ". " not in text, text
    return text


PAIR = {"subject": [*"aabb"], "visit": ["before", "after"] * 2}


def test_subjects_with_one_visit_are_counted_and_left_out() -> None:
    found = asked(cells(subject=[*"aabbc"], visit=[*["before", "after"] * 2, "before"]))
    assert found.single_visit_subjects == ("c",) and len(found.subjects) == 2
    assert "1 of 3 subjects are excluded because they have one visit (c)." in analysis_report(found).notes
    assert "none of its 3 subjects has two visits" in refusal(cells(subject=[*"abc"], visit=[1, 1, 1]))


def test_times_must_have_an_order() -> None:
    assert "--order before,after" in refusal(cells(**PAIR))
    assert "'after' at shape 2, which is not in the order before,later" in refusal(
        cells(**PAIR), order=("before", "later")
    )
    assert "two or more words" in refusal(cells(**PAIR), order=("before",))
    assert "two or more words" in refusal(cells(**PAIR), order=("before", "after", "after"))
    odd = {"subject": [*"aabbcc"], "visit": [1, 2, 1, "soon", 1, 2]}
    assert "'soon' at shape 4" in refusal(cells(**odd))
    dates = {"subject": [*"aabb"], "date": ["2020-01-01", "2021-01-01", "2020-01-01", "31.5.2021"]}
    assert "'31.5.2021' at shape 4" in refusal(cells(**dates))
    assert "--time" in refusal(cells(subject=[*"aabb"], when=[1, 2, 1, 2]))
    assert "no column 'when'" in refusal(cells(**PAIR), time="when")
    assert "no column 'who'" in refusal(cells(**PAIR), order=ORDER, subject="who")


def test_a_visit_twice_is_a_rescan_unless_the_table_marks_others() -> None:
    twice = {"subject": [*"aaabb"], "visit": [1, 1, 2, 1, 2]}
    found = change(cells(**twice))
    assert found.repeatability is not None and found.repeatability.scans == 2
    marked = change(cells(**twice, rescan=["", "yes", "", "", ""]))
    assert marked.repeatability is not None
    assert "a has 2 scans at 1" in refusal(cells(**twice, rescan=["", "no", "yes", "", ""]))


def test_missing_cells_groups_and_stable_parts_are_refused_by_name(tmp_path: Path) -> None:
    assert "missing=drop" in refusal(cells(subject=["a", None, "b", "b"], visit=[1, 2, 1, 2]))
    assert "two groups by 'arm'" in refusal(cells(**PAIR, arm=[*"xyxx"]), order=ORDER, group="arm")
    assert "two groups of two or more" in refusal(cells(**PAIR, arm=[*"xxyy"]), order=ORDER, group="arm")
    assert "two groups of two or more" in refusal(cells(**PAIR, arm=[*"xxxx"]), order=ORDER, group="arm")
    assert "Rates need times" in refusal(cells(**PAIR), order=ORDER, rate=True)
    assert "no stable region 'brow'" in refusal(cells(**PAIR), order=ORDER, stable="brow")
    assert "no landmark 'brow'" in refusal(cells(**PAIR), order=ORDER, stable="landmarks:tip,brow")
    assert "has 1 vertices" in refusal(cells(**PAIR), order=ORDER, stable="landmarks:tip,0.5")
    assert f"0 to {V - 1}" in refusal(cells(**PAIR), order=ORDER, stable=[1, 2, V])
    (tmp_path / "region.csv").write_text("vertex\n1\n2\n")
    assert "three are the least" in refusal(cells(**PAIR), order=ORDER, stable=tmp_path / "region.csv")
    assert f"0 to {V - 1}" in refusal(cells(**PAIR), order=ORDER, regions={"nose": [V]})
    assert "one permutation" in refusal(cells(**PAIR), order=ORDER, permutations=0)


def test_shapes_without_size_and_points_are_refused() -> None:
    cohort = cells(**PAIR)
    assert "gauge form" in refusal(replace(cohort, gauge="shape"), order=ORDER)
    assert "triangles" in refusal(replace(cohort, faces=None), order=ORDER)
    assert "no unit" in refusal(replace(cohort, unit=""), order=ORDER)


def test_a_stable_region_is_read_from_a_file_and_found_in_the_model(tmp_path: Path) -> None:
    far = np.flatnonzero(bump() < 0.01)
    (tmp_path / "back.csv").write_text("vertex\n" + "\n".join(map(str, far)))
    cohort = pairs([3 * bump()] * 2)
    by_file, by_list = asked(cohort, stable=tmp_path / "back.csv"), asked(cohort, stable=far.tolist())
    np.testing.assert_array_equal(by_file.subjects[0].change.along_mm, by_list.subjects[0].change.along_mm)
    np.testing.assert_array_equal(np.flatnonzero(by_file.subjects[0].stable), far)
    fits = fitted_pairs(2, 1.0, 1.0)
    assert fits.fitted is not None
    model = replace(fits.fitted.model, regions={"back": far.astype(np.int32)})
    named = asked(replace(fits, fitted=replace(fits.fitted, model=model)), stable="back")
    np.testing.assert_array_equal(np.flatnonzero(named.subjects[0].stable), far)
    assert named.regions == ("whole", "back")
