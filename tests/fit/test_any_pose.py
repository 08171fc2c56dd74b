from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.datasets.faces import load_faces
from shapespace.datasets.ict import load_ict
from shapespace.errors import FitError
from shapespace.fit.search import pose_search as any_pose
from shapespace.fit.search.initialisation import Start, find_unit, start_from_any_pose
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh
from synthetic_shapes import angle_deg, sphere

WITHIN_DEG, WITHIN_SCALE = 15.0, 0.1


@pytest.fixture(scope="module")
def head_model() -> ShapeModel:
    faces, rng = load_faces(), np.random.default_rng(31)
    return ShapeModel.fit([faces.face(faces.draw_person(rng)) for _ in range(25)], modes=12)


@pytest.fixture(scope="module")
def head() -> FloatArray:
    faces = load_faces()
    return np.array(faces.face(faces.draw_person(np.random.default_rng(77))).vertices)


@pytest.fixture(scope="module")
def ict_people(shared_data: Path) -> list[Mesh]:
    faces = load_ict(shared_data / "ict-facekit")
    return [faces.mesh(c) for c in faces.draw_people(44, seed=63)]


@pytest.fixture(scope="module")
def ict_model(ict_people: list[Mesh]) -> ShapeModel:
    return ShapeModel.fit(ict_people[:40], modes=20)


def is_right(model: ShapeModel, start: Start, truth: FloatArray) -> bool:
    T = fit_similarity(model.mean_vertices, truth)
    turned = angle_deg(start.T_scan_model.rotation @ T.rotation.T)
    return turned < WITHIN_DEG and abs(start.T_scan_model.scale / T.scale - 1) < WITHIN_SCALE


def anywhere(seed: int, points: FloatArray) -> FloatArray:
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=rng).as_matrix()
    return rng.uniform(0.85, 1.15) * points @ R.T + rng.uniform(-900, 900, 3)


@pytest.mark.parametrize("seed", range(100, 106))
def test_a_head_is_found_in_any_pose_and_size(head_model: ShapeModel, head: FloatArray, seed: int) -> None:
    noise = np.random.default_rng(seed).standard_normal(head.shape)
    scan = anywhere(seed, head + 0.3 * noise)
    start = start_from_any_pose(head_model, np.random.default_rng(seed).permutation(scan), seed=seed)
    assert is_right(head_model, start, anywhere(seed, head))
    assert start.score_mm < 0.7 * start.runner_up_score_mm


def test_the_alternatives_are_other_poses_best_first(head_model: ShapeModel, head: FloatArray) -> None:
    start = start_from_any_pose(head_model, anywhere(200, head), seed=0)
    poses = (start, *start.alternatives)
    assert 2 <= len(poses) <= 4
    assert start.runner_up_score_mm == start.alternatives[0].score_mm
    assert [p.score_mm for p in poses] == sorted(p.score_mm for p in poses)
    for i, one in enumerate(poses):
        assert one.b.shape == (10,)
        assert (np.abs(one.b) <= 3.0001 * head_model.stddev[:10]).all()
        for other in poses[:i]:
            assert angle_deg(one.T_scan_model.rotation @ other.T_scan_model.rotation.T) > 30


def test_the_modes_found_bring_the_model_nearer_to_the_truth(head_model: ShapeModel, head: FloatArray) -> None:
    start = start_from_any_pose(head_model, anywhere(201, head), seed=0)
    truth = anywhere(201, head)
    b = np.zeros(head_model.n_modes)
    b[: len(start.b)] = start.b
    with_modes, without = (
        np.linalg.norm(start.T_scan_model.apply(head_model.reconstruct(c)) - truth, axis=1).mean() for c in (b, 0 * b)
    )
    assert with_modes < 0.8 * without


def test_what_fits_clearly_as_it_stands_is_not_searched_further(
    head_model: ShapeModel, head: FloatArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the search went on")

    monkeypatch.setattr(any_pose._Sides, "everywhere", refuse)  # pyright: ignore[reportPrivateUsage]
    R = Rotation.from_rotvec([0.1, -0.2, 0.1]).as_matrix()
    start = start_from_any_pose(head_model, 1.1 * head @ R.T + 70.0, seed=0)
    assert start.how == "upright"
    assert is_right(head_model, start, 1.1 * head @ R.T + 70.0)
    with pytest.raises(AssertionError, match="went on"):
        start_from_any_pose(head_model, head * [1.0, -1.0, -1.0], seed=0)


def test_the_same_seed_gives_the_same_start(head_model: ShapeModel, head: FloatArray) -> None:
    one, two = (start_from_any_pose(head_model, anywhere(202, head), seed=5) for _ in range(2))
    assert np.array_equal(one.T_scan_model.rotation, two.T_scan_model.rotation)
    assert one.score_mm == two.score_mm


def test_the_scale_is_free_only_where_the_gauge_or_the_caller_says_so(head: FloatArray) -> None:
    faces, rng = load_faces(), np.random.default_rng(31)
    people = [faces.face(faces.draw_person(rng)) for _ in range(6)]
    form, shape = (ShapeModel.fit(people, gauge=gauge) for gauge in ("form", "shape"))
    assert start_from_any_pose(form, 1.1 * head, seed=0).T_scan_model.scale == 1.0
    assert start_from_any_pose(shape, 1.1 * head, seed=0, with_scale=False).T_scan_model.scale == 1.0
    sizes = [start_from_any_pose(shape, s * head, seed=0).T_scan_model.scale for s in (0.9, 1.1)]
    assert sizes[1] / sizes[0] == pytest.approx(1.1 / 0.9, rel=0.03)


def test_a_ball_looks_the_same_from_everywhere_and_still_gets_a_start() -> None:
    d, faces = sphere(600)
    balls = [Mesh(r * d * [1.0, 1.0, 1 + 1e-3 * r], faces) for r in (90.0, 100.0, 110.0, 105.0)]
    model = ShapeModel.fit(balls, gauge="form")
    start = start_from_any_pose(model, 100.0 * sphere(900, 0.7)[0] + 30.0, seed=0)
    assert start.how == "upright"
    assert np.linalg.norm(start.T_scan_model.translation - 30.0) < 5.0


@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_few_points_on_a_line_give_a_start_of_finite_numbers(head_model: ShapeModel, count: int) -> None:
    start = start_from_any_pose(head_model, np.outer(np.arange(count), [50.0, 0.0, 0.0]), seed=0)
    assert np.isfinite(start.T_scan_model.translation).all()


def test_a_lone_point_far_away_does_not_hide_the_rest(head_model: ShapeModel, head: FloatArray) -> None:
    scan = np.concatenate([anywhere(203, head), [[1e6, -1e6, 1e6]]])
    assert is_right(head_model, start_from_any_pose(head_model, scan, seed=0), anywhere(203, head))


@pytest.mark.parametrize("unit", MM_PER_UNIT)
def test_the_unit_is_found_of_a_part_and_of_much_more_than_the_model(
    ict_model: ShapeModel, ict_people: list[Mesh], unit: str
) -> None:
    face = ict_people[41].vertices
    for part in (face[face[:, 0] > np.quantile(face[:, 0], 0.45)], np.concatenate([face, face * [1, 1, -1.2]])):
        scan = Mesh(anywhere(204, part) / MM_PER_UNIT[unit], name="part.ply")
        assert find_unit(ict_model, scan) == unit


def test_no_unit_is_made_up_for_a_scan_without_extent(head_model: ShapeModel) -> None:
    with pytest.raises(FitError, match=r"dot\.ply"):
        find_unit(head_model, Mesh(np.ones((5, 3)), name="dot.ply"))


@pytest.mark.parametrize("seed", range(300, 306))
def test_a_face_with_two_fifths_missing_is_found_in_any_pose(
    ict_model: ShapeModel, ict_people: list[Mesh], seed: int
) -> None:
    face = ict_people[40 + seed % 4].vertices
    rng = np.random.default_rng(seed)
    along = face @ rng.standard_normal(3)
    hole = np.linalg.norm(face - face[rng.integers(len(face))], axis=1)
    cut = along < np.quantile(along, 0.75)
    left = cut & (hole > np.quantile(hole[cut], 0.2))
    assert 0.55 < left.mean() < 0.65
    scan = anywhere(seed, face)[left] + 0.2 * rng.standard_normal((left.sum(), 3))
    assert is_right(ict_model, start_from_any_pose(ict_model, scan, seed=seed), anywhere(seed, face))


def test_rotations_are_spread_so_that_none_is_far_from_one() -> None:
    tried = Rotation.from_matrix(any_pose._even_rotations(any_pose.ROTATIONS))  # pyright: ignore[reportPrivateUsage]
    far = [np.degrees((tried * R.inv()).magnitude().min()) for R in Rotation.random(500, random_state=8)]
    assert max(far) < 50.0


def test_directions_of_a_cloud_without_triangles_are_across_it() -> None:
    d = sphere(2000)[0]
    n = any_pose._normals(100.0 * d)  # pyright: ignore[reportPrivateUsage]
    assert np.abs((n * d).sum(axis=1)).min() > 0.97


def test_thinning_leaves_one_point_in_each_cell_that_has_any_and_no_lone_point_far_outside() -> None:
    points = np.random.default_rng(1).uniform(0, 50, (3000, 3))
    points[7] = 1e6
    kept = any_pose._thin_evenly(points, 9.0, 100.0)  # pyright: ignore[reportPrivateUsage]
    cells = np.rint((points - np.delete(points, 7, axis=0).min(axis=0)) / 9.0).astype(int)
    assert 7 not in kept
    assert (np.diff(kept) > 0).all()
    assert len(np.unique(cells[kept], axis=0)) == len(kept) == len(np.unique(np.delete(cells, 7, axis=0), axis=0))


@pytest.mark.parametrize(
    ("points", "share", "is_part"), [(700, 1.0, False), (20_000, 1.0, False), (700, 0.4, True), (20_000, 0.4, True)]
)
def test_a_sparse_scan_is_no_part_and_a_part_is_one_however_dense(points: int, share: float, is_part: bool) -> None:
    ball = 50.0 * sphere(2000)[0]
    model = ShapeModel.fit([Mesh(ball * (1 + 0.1 * k * np.array([1.0, 0.5, 0.2]))) for k in range(4)], gauge="form")
    directions = np.random.default_rng(0).standard_normal((points, 3))
    scan = np.asarray(model.mean_vertices).std() * np.sqrt(3) * directions / np.linalg.norm(directions, axis=1)[:, None]
    scan = scan[scan[:, 2] >= np.quantile(scan[:, 2], 1 - share)]
    sides = any_pose._Sides.of(model, scan, False, 0)
    starts = len(sides._place_rotations(np.eye(3)[None])[0])
    assert starts == (8 if is_part else 2)
