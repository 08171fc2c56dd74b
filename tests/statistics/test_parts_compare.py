"""Comparisons of objects of several parts: each part, the relative pose, and all together."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shapespace as ss
from jointed_parts import FLEXION, PARTS, knees, sexes
from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.part_cohorts import RELATIVE_POSE, cohort_of_part, cohort_of_poses, relative_poses
from shapespace.cohort.table import Table
from shapespace.errors import InputError
from shapespace.geometry.procrustes import Gauge, centroid_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.effect_size import holm_p
from shapespace.statistics.relative_pose import mean_with_interval, pose_changes, pose_means
from shapespace.statistics.shape_tests.covariation import estimate_modularity, fit_pls
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")

FEMUR = PARTS["femur"]
CONFIG = CompareConfig(permutations=200, maps=False)


def cohort_of(subjects: Sequence[Mesh], gauge: Gauge = "form", parts: dict[str, int] | None = PARTS) -> Cohort:
    names = tuple(mesh.name for mesh in subjects)
    return Cohort.of_meshes(subjects, Table({"sex": tuple(sexes(len(names)))}, names), gauge, parts=parts)


def gram_of(values: FloatArray) -> FloatArray:
    """Return the products of all pairs of rows about their mean, which do not depend on axes."""
    off = values - values.mean(axis=0)
    return off @ off.T


def gram(cohort: Cohort) -> FloatArray:
    return gram_of(cohort.coefficients)


def part_of(mesh: Mesh) -> Mesh:
    assert mesh.faces is not None
    return Mesh(mesh.vertices[:FEMUR], mesh.faces[(mesh.faces < FEMUR).all(axis=1)], name=mesh.name)


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_the_tests_of_a_part_are_those_of_its_surfaces_alone(gauge: Gauge) -> None:
    subjects = knees(10, seed=1)
    result = compare(cohort_of(subjects, gauge), "~ sex + log_size", CONFIG)
    alone = compare(cohort_of([part_of(mesh) for mesh in subjects], gauge, None), "~ sex + log_size", CONFIG)
    assert list(result.parts) == ["femur", "tibia", RELATIVE_POSE]
    assert [test.p for test in result.parts["femur"].tests] == [test.p for test in alone.tests]
    assert np.allclose(result.parts["femur"].cohort.sizes_mm, alone.cohort.sizes_mm, rtol=1e-9)


def test_a_part_with_missing_vertices_is_that_of_its_surfaces_alone_with_these_missing() -> None:
    subjects = knees(10, seed=2)
    for number, vertex in ((1, 3), (2, 9), *((k, 20) for k in range(6))):
        subjects[number].vertices.setflags(write=True)
        subjects[number].vertices[vertex] = np.nan
    own, alone = cohort_of_part(cohort_of(subjects), "femur"), cohort_of([part_of(m) for m in subjects], parts=None)
    assert np.abs(gram(own) - gram(alone)).max() < 1e-6 * np.abs(gram(alone)).max()
    assert own.analysed is not None and alone.analysed is not None and np.array_equal(own.analysed, alone.analysed)


def test_surfaces_have_exact_rotations() -> None:
    subjects = knees(10, seed=3)
    cohort = cohort_of(subjects)
    for row, mesh in enumerate(subjects):
        vertices = cohort.mesh(row).vertices
        T = fit_similarity(vertices, mesh.vertices, with_scale=False)
        assert np.abs(T.apply(vertices) - mesh.vertices).max() < 1e-6


def test_a_flexion_is_found_in_the_relative_pose_and_in_no_part() -> None:
    result = compare(cohort_of(knees(24, seed=4, bend=25.0)), "~ sex", CONFIG)
    p = {test.part: test.p_family for test in result.part_tests}
    assert p[RELATIVE_POSE] < 0.05 < min(p["femur"], p["tibia"])


def test_a_difference_of_the_tibia_is_found_in_the_tibia_alone() -> None:
    result = compare(cohort_of(knees(24, seed=5, widen=0.2)), "~ sex", CONFIG)
    p = {test.part: test.p_family for test in result.part_tests}
    assert p["tibia"] < 0.05 < min(p["femur"], p[RELATIVE_POSE])


def base_axes(points: list[int]) -> FloatArray:
    """Return the axes of three vertices of the femur in the frame of the hinge."""
    a, b, c = (sphere(FEMUR)[0] * [50.0, 12.0, 10.0])[points]
    first, third = (v / np.linalg.norm(v) for v in (b - a, np.cross(b - a, c - a)))
    return np.stack([first, np.cross(third, first), third])


def test_a_change_of_the_relative_pose_is_that_of_the_groups_in_degrees_about_the_axes() -> None:
    x = sphere(FEMUR)[0]
    points = [int(x[:, 0].argmin()), int(x[:, 0].argmax()), int(x[:, 1].argmax())]
    subjects = knees(12, seed=6, degrees=0.0, bend=10.0)
    result = compare(cohort_of(subjects), "~ sex", replace(CONFIG, pose_axes=tuple(map(str, points))))
    change = pose_changes(result)["sex f to m"][0]
    assert np.allclose(change[:3], 10.0 * base_axes(points) @ FLEXION, atol=0.3)
    assert np.abs(change[3:]).max() < 2.0  # the scatter of the joint is 1 mm
    means = {mean.group: mean for mean in pose_means(result)}
    assert list(means) == ["all", "sex f", "sex m"] and means["sex m"].subjects == 6
    assert np.allclose(means["sex m"].mean - means["sex f"].mean, change, atol=1e-6)
    assert np.abs(means["all"].mean).max() < 1e-3


def test_intervals_of_means_hold_the_mean() -> None:
    inside = 0
    rng = np.random.default_rng(0)
    for _ in range(1000):
        mean, half, _ = mean_with_interval(rng.normal(size=(8, 6)))
        inside += int((np.abs(mean) <= half).sum())
    assert 0.94 < inside / 6000 < 0.96


def test_inertia_axes_are_right_handed_and_begin_with_the_longest_extent() -> None:
    poses = relative_poses(cohort_of(knees(8, seed=7)))
    assert poses.joints == ("tibia to femur",)
    axes = poses.axes[0]
    assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) == pytest.approx(1.0)
    femur = cohort_of(knees(8, seed=7)).reference[:FEMUR]
    extents = ((femur - femur.mean(axis=0)) @ axes.T).std(axis=0)
    assert extents[0] > extents[1] > extents[2]


def test_relative_poses_are_mm_of_vertices() -> None:
    """Shapes of rigid parts differ by their poses alone, so that both cohorts have the same distances."""
    femur, *_ = knees(1, seed=8, degrees=0.0)
    rng, subjects = np.random.default_rng(9), list[Mesh]()
    for number in range(6):
        vertices = femur.vertices - femur.vertices[:FEMUR].mean(axis=0)
        turn = Rotation.from_rotvec(np.deg2rad(rng.normal(size=3))).as_matrix()
        vertices[FEMUR:] = vertices[FEMUR:] @ turn.T + rng.normal(size=3)
        subjects.append(Mesh(vertices, femur.faces, name=f"s{number}"))
    poses, whole = cohort_of_poses(cohort_of(subjects)), cohort_of(subjects, parts=None)
    assert np.allclose(gram(poses), gram(whole), atol=0.02 * np.abs(gram(whole)).max())


def test_subjects_without_a_part_count_for_the_other_part_alone() -> None:
    subjects = knees(12, seed=10)
    for mesh in subjects[:3]:
        mesh.vertices.setflags(write=True)
        mesh.vertices[FEMUR:] = np.nan
    result = compare(cohort_of(subjects), "~ sex", CONFIG)
    assert [test.shapes for test in result.part_tests] == [12, 9, 9] and len(result.cohort) == 12
    notes = result.parts["tibia"].cohort.notes
    assert any("3 of 12 shapes lack tibia and are excluded (s00, s01, s02)" in note for note in notes)
    assert len(relative_poses(result.cohort).names) == 9
    assert fit_pls(cohort_of(subjects), permutations=20).cohort.names[0] == "s03"


def test_p_is_corrected_over_the_parts_as_by_holm() -> None:
    assert holm_p([0.01, 0.04, 0.03]) == pytest.approx((0.03, 0.06, 0.06))
    assert holm_p([0.9, 0.5]) == pytest.approx((1.0, 1.0))
    result = compare(cohort_of(knees(10, seed=11)), "~ sex", CONFIG)
    assert [t.p_family for t in result.part_tests] == list(holm_p([t.test.p for t in result.part_tests]))
    assert "Holm" in result.methods.corrected_over[-1]


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_covariation_of_parts_does_not_depend_on_their_pose(gauge: Gauge) -> None:
    straight, bent = (cohort_of(knees(12, seed=12, degrees=degrees), gauge) for degrees in (0.0, 70.0))
    for test in (fit_pls, estimate_modularity):
        one, other = (test(cohort, permutations=40).statistics[0] for cohort in (straight, bent))
        assert other.value == pytest.approx(one.value, rel=0.01), test.__name__


def test_shapes_compared_with_a_cohort_have_its_coordinates() -> None:
    subjects = knees(10, seed=13)
    for gauge in ("form", "shape"):
        cohort = cohort_of(subjects, gauge)
        table = Table({"sex": ("f",)}, (subjects[4].name,))
        again = Cohort.of_meshes(subjects[4:5], table, onto=cohort, parts=PARTS)
        assert np.abs(again.vertices(0) - cohort.vertices(4)).max() < 1e-3


def test_samples_of_completed_parts_are_imputed() -> None:
    subjects = knees(10, seed=14)
    vertices = np.stack([mesh.vertices for mesh in subjects])
    observed = np.ones(vertices.shape[:2], dtype=np.bool_)
    observed[0, FEMUR:] = False
    samples = [vertices[:1] + np.random.default_rng(0).normal(size=(3, 1, 1)) if k == 0 else None for k in range(10)]
    columns = {"sex": sexes(10)}
    cohort = Cohort.of_shapes(vertices, columns, gauge="form", observed=observed, samples=samples, parts=PARTS)
    result = compare(cohort, "~ sex", CONFIG)
    assert result.imputations is not None and result.imputations.count == 3
    assert np.abs(cohort.imputation(1).vertices(0) - cohort.vertices(0)).max() < 1e-3  # samples differ by their place
    assert [test.shapes for test in result.part_tests] == [10, 9, 9]


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_fits_of_a_model_of_relative_pose_are_compared_as_their_surfaces(gauge: Gauge) -> None:
    subjects = knees(10, seed=15)
    model = ss.build_model(subjects, ss.BuildConfig(parts=PARTS, gauge="form", modes=9))
    b = np.stack([model.project(mesh) for mesh in subjects])
    names, sizes = tuple(mesh.name for mesh in subjects), [centroid_size(mesh.vertices) for mesh in subjects]
    fits = FitDiagnostics(model, b, np.ones_like(b), ("converged",) * 10, "fits")
    cohort = Cohort.of_fits(fits, names, Table({"sex": tuple(sexes(10))}, names), np.array(sizes), gauge)
    same = cohort_of(subjects, gauge)
    assert dict(cohort.parts) == PARTS
    turns = [gram_of(np.radians(relative_poses(own).rotation_deg[:, 0])) for own in (cohort, same)]
    assert np.allclose(*turns, atol=0.03 * np.abs(turns[1]).max())
    assert np.abs(gram(cohort) - gram(same)).max() < 0.03 * np.abs(gram(same)).max()


def test_impossible_input_has_one_sentence() -> None:
    subjects = knees(8, seed=16)
    cohort, one = cohort_of(subjects), cohort_of(subjects, parts=None)
    lacking = knees(8, seed=16)
    for mesh in lacking[:5]:
        mesh.vertices.setflags(write=True)
        mesh.vertices[FEMUR:] = np.nan
    one_sex = knees(8, seed=16)
    for mesh in one_sex[::2]:
        mesh.vertices.setflags(write=True)
        mesh.vertices[FEMUR:] = np.nan
    axes = replace(CONFIG, pose_axes=("0", "1", "2"))
    for call, message in (
        (lambda: compare(one, "~ sex", axes), "pose_axes needs shapes of several parts"),
        (lambda: compare(cohort, "~ sex", replace(axes, pose_axes=("0", "1", "knee"))), "three landmarks .* knee"),
        (lambda: compare(cohort, "~ sex", replace(axes, pose_axes=("0", "1"))), "three landmarks .* 0, 1 "),
        (lambda: compare(cohort, "~ sex", replace(axes, pose_axes=("0", "1", "1"))), "on a line"),
        (lambda: estimate_modularity(one), "Covariation without --modules needs shapes of several parts"),
        (lambda: cohort_of_part(cohort, "foot"), "no part 'foot'; choose one of femur, tibia"),
        (lambda: cohort_of(subjects, parts={"femur": 80, "tibia": 50}), "have 130 vertices .* shapes 140"),
        (lambda: cohort_of(lacking), "The part tibia is missing in 5 of 8 shapes"),
        (lambda: compare(cohort_of(one_sex), "~ sex", CONFIG), "The comparison of tibia: .*sex"),
        (lambda: Cohort.of_meshes(subjects[:1], cohort.table.take([0]), onto=cohort), "same parts"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            call()
