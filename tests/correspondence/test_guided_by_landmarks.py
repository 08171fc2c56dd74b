"""Landmarks, a model to begin with, mirror images and scans that lack a part: what each tells a correspondence."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shapespace as ss
from raw_blobs import ANY_POSE, LANDMARKS, RawBlob, dispersion_mm, marked, raw_blob
from shapespace.correspondence.first_template import first_template
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import ScanLandmarks, consensus_landmarks, stray_landmarks
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.registration import RegistrationTask, RoundContext
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.template import PoseModel, choose_template
from shapespace.errors import InputError, MeshError
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, Mesh, Similarity, SurfaceLandmarks
from synthetic_shapes import blob, sphere, training_meshes

QUICK = ElasticSettings(harmonics=150, points=1000)
SETTINGS = CorrespondConfig(vertices=900, rounds=1, mirror="never", first=QUICK, next=QUICK)
SHORT = replace(QUICK, iterations=2)
"""Too short for landmarks to turn a surface round by their pull."""
FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def blobs() -> list[RawBlob]:
    return [raw_blob(k, degrees=ANY_POSE) for k in range(6)]


def cut(one: RawBlob, share: float) -> Mesh:
    """Return the scan of a blob without that share of its points, at the lower end."""
    height = one.directions[:, 1]
    kept = height > np.quantile(height, share)
    faces = one.scan.faces[kept[one.scan.faces].all(axis=1)]
    used = np.unique(faces)
    number = np.full(len(kept), -1)
    number[used] = np.arange(len(used))
    return Mesh(one.scan.vertices[used], number[faces].astype(np.int32), name=one.scan.name)


def bowl(mesh: Mesh) -> Mesh:
    """Return a mesh of the blobs without its back, which has a rim."""
    front = sphere(len(mesh.vertices))[0][:, 2] > -0.5
    number = np.cumsum(front) - 1
    return Mesh(
        mesh.vertices[front], number[mesh.faces[front[mesh.faces].all(axis=1)]].astype(np.int32), name=mesh.name
    )


def even(directions: FloatArray) -> FloatArray:
    """Return a blob that is its own mirror image."""
    side = directions * [-1, 1, 1]
    return 0.5 * (blob(directions, np.zeros(5)) + blob(side, np.zeros(5)) * FLIP)


@pytest.mark.long
def test_landmarks_bring_their_places_together_as_far_as_they_are_believed(blobs: list[RawBlob]) -> None:
    scans = [marked(one) for one in blobs[:4]]
    off = [
        np.mean([scan.landmarks for scan in correspond(scans, replace(SETTINGS, landmark_uncertainty=sd)).scans])
        for sd in (0.01, 100.0)
    ]
    assert off[0] < 0.4 * off[1]


def test_the_template_has_the_landmarks_and_scans_without_them_come_along(blobs: list[RawBlob]) -> None:
    made = correspond([marked(blobs[0]), marked(blobs[1]), blobs[2].scan], SETTINGS)
    assert set(made.template.landmarks) == set(LANDMARKS)
    assert [bool(np.isfinite(scan.landmarks)) for scan in made.scans] == [True, True, False]
    assert not any(scan.reason for scan in made.scans)


def test_the_pull_is_the_posterior_mean_of_a_gaussian_process() -> None:
    directions, faces = sphere(300)
    mesh = Mesh(blob(directions, np.zeros(5)), faces)
    harmonics, where, rng = Harmonics.of(mesh, 60), np.array([3, 80, 200]), np.random.default_rng(0)
    points = mesh.vertices[where] + rng.standard_normal((3, 3))
    places = place_landmarks(mesh, {str(k): mesh.vertices[k] for k in where})
    moved = ScanLandmarks(places, points, 0.02).correction(mesh.vertices, harmonics, 20.0, 80.0)
    kernel = harmonics.functions @ np.diag(harmonics.attenuation(20.0)) @ harmonics.functions.T
    noise = (0.02 * 80.0 / 10.0) ** 2 * kernel[where, where].mean()
    inverse = np.linalg.inv(kernel[np.ix_(where, where)] + noise * np.eye(3))
    np.testing.assert_allclose(moved, kernel[:, where] @ inverse @ (points - mesh.vertices[where]), atol=1e-9)


def test_landmarks_tell_the_pose_or_why_they_cannot() -> None:
    directions, faces = sphere(300)
    mesh = Mesh(blob(directions, np.zeros(5)), faces)
    points = {str(k): mesh.vertices[k] for k in (5, 60, 150, 290)}
    places = place_landmarks(mesh, points)
    T = Similarity(0.4, Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), np.array([5.0, 0.0, -3.0]))
    pose = ScanLandmarks(places, T.apply(np.stack(list(points.values()))), 0.02).pose(mesh.vertices)
    np.testing.assert_allclose(pose.apply(mesh.vertices), T.apply(mesh.vertices), atol=1e-6)
    image = T.apply(np.stack(list(points.values())) * FLIP)
    with pytest.raises(InputError, match="mirrored"):
        ScanLandmarks(places, image, 0.02).pose(mesh.vertices)
    with pytest.raises(InputError, match="check their names"):
        ScanLandmarks(places, image[[2, 0, 3, 1]] * [3.0, 1.0, 1.0], 0.02).pose(mesh.vertices)
    two = places.select(["5", "60"])
    assert ScanLandmarks(two, two.interpolate(mesh.vertices), 0.02).pose(mesh.vertices) is None


def test_landmarks_as_good_as_on_a_line_tell_no_pose() -> None:
    directions, faces = sphere(300)
    mesh = Mesh(blob(directions, np.zeros(5)), faces)
    poles = [directions[:, 1].argmax(), directions[:, 1].argmin()]
    ends = mesh.vertices[poles]
    middle = ends.mean(axis=0) + np.array([0.5, 0.0, 0.0])
    corners = np.array([[poles[0]] * 3, [poles[1]] * 3, [*poles, 0]])
    line = SurfaceLandmarks(("a", "b", "c"), corners, np.array([[1.0, 0, 0], [1.0, 0, 0], [0.495, 0.495, 0.01]]))
    assert ScanLandmarks(line, np.stack([*ends, middle]), 0.02).pose(mesh.vertices) is None
    assert ScanLandmarks(line, np.stack([*ends, middle]), 1e-6).pose(mesh.vertices) is not None


def test_landmarks_in_another_unit_or_far_off_are_left_out(blobs: list[RawBlob]) -> None:
    scan = marked(blobs[0])
    assert stray_landmarks(scan) == {}
    metres = replace(scan, landmarks={name: point / 1000 + 500 for name, point in scan.landmarks.items()})
    assert set(stray_landmarks(metres)) == set(LANDMARKS)
    far = replace(scan, landmarks={**scan.landmarks, "nose": scan.landmarks["nose"] + [400, 0, 0]})
    assert set(stray_landmarks(far)) == {"nose"} and stray_landmarks(far)["nose"] > 1
    made = correspond([metres, marked(blobs[1]), far], SETTINGS)
    assert not any(scan.reason for scan in made.scans)
    assert [bool(np.isfinite(scan.landmarks)) for scan in made.scans] == [False, True, True]


def test_a_template_whose_landmarks_have_wrong_names_does_not_set_the_others_aside(blobs: list[RawBlob]) -> None:
    scans = [marked(one) for one in blobs[:4]]
    points = scans[0].landmarks
    wrong = dict(zip(points, [points[name] for name in ("back", "nose", "low", "left", "top")], strict=True))
    scans[0] = replace(scans[0], landmarks=wrong)
    first = first_template(scans, scans[0], SETTINGS)
    assert not first.mesh.landmarks and "contradict those of most scans" in first.origin
    made = correspond(scans, replace(SETTINGS, rounds=2), first=first)
    assert ["check their names" in scan.reason for scan in made.scans] == [True, False, False, False]
    assert first_template(scans, marked(blobs[4]), SETTINGS).mesh.landmarks


def _context(template: Mesh) -> tuple[RoundContext, SurfaceLandmarks]:
    harmonics = Harmonics.of(template, QUICK.harmonics)
    names = {name: template.vertices[(template.vertices @ np.array(at)).argmax()] for name, at in LANDMARKS.items()}
    return RoundContext(template, harmonics, (PoseModel.of(template),), 0), place_landmarks(template, names)


def test_landmarks_correct_a_pose_that_was_found_without_them() -> None:
    directions, faces = sphere(900)
    mesh = Mesh(directions * [100.0, 30.0, 45.0], faces)
    context, places = _context(mesh)
    over = Similarity(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    landmarks = ScanLandmarks(places, places.interpolate(mesh.vertices), 0.1)
    placed = context.register(RegistrationTask(0, mesh, over, mesh.vertices, SHORT, landmarks=landmarks))
    assert np.trace(placed.T_scan_template.rotation) > 2.9


def test_landmarks_of_another_size_than_their_scan_are_named() -> None:
    directions, faces = sphere(900)
    mesh = Mesh(directions * [100.0, 30.0, 45.0], faces)
    context, places = _context(mesh)
    landmarks = ScanLandmarks(places, places.interpolate(mesh.vertices) / 1000, 0.02)
    placed = context.register(RegistrationTask(0, mesh, None, None, QUICK, landmarks=landmarks))
    assert "check their unit" in placed.reason


def test_a_scan_not_reached_from_the_pose_of_its_landmarks_says_so(blobs: list[RawBlob]) -> None:
    three = [
        replace(scan, landmarks={name: scan.landmarks[name] for name in ("nose", "left", "top")})
        for scan in map(marked, blobs[:3])
    ]
    points = three[1].landmarks
    three[1] = replace(three[1], landmarks={**points, "left": points["top"], "top": points["left"]})
    strict = replace(QUICK, inliers=3.0)
    made = correspond(three, replace(SETTINGS, first=strict, next=strict), template=three[0])
    assert ["have wrong names" in scan.reason for scan in made.scans] == [False, True, False]


def test_a_landmark_lies_on_the_mean_where_most_have_it() -> None:
    directions, faces = sphere(300)
    shapes = [blob(directions, z) for z in np.eye(5)]
    mean = Mesh(np.mean(shapes, axis=0), faces)
    told = [(x, {"a": x[7], "b": x[90]} if k else {"a": x[40]}) for k, x in enumerate(shapes)]
    places = consensus_landmarks(mean, told)
    np.testing.assert_allclose(places.select(["a", "b"]).interpolate(mean.vertices), mean.vertices[[7, 90]], atol=1e-6)


def test_landmarks_in_one_place_that_are_quite_sure_pull_as_one(blobs: list[RawBlob]) -> None:
    directions, faces = sphere(300)
    mesh = Mesh(blob(directions, np.zeros(5)), faces)
    harmonics, at = Harmonics.of(mesh, 60), mesh.vertices[5]
    twice = ScanLandmarks(place_landmarks(mesh, {"a": at, "b": at}), np.stack([at, at]) + 1.0, 1e-300)
    once = ScanLandmarks(place_landmarks(mesh, {"a": at}), at[None] + 1.0, 1e-300)
    x = mesh.vertices
    np.testing.assert_allclose(
        twice.correction(x, harmonics, 20.0, 80.0), once.correction(x, harmonics, 20.0, 80.0), atol=1e-3
    )
    for uncertainty in (0.0, np.nan, -1.0):
        with pytest.raises(InputError, match="above 0"):
            correspond([blobs[0].scan, blobs[1].scan], replace(SETTINGS, landmark_uncertainty=uncertainty))


def test_shapes_that_are_wrongly_placed_do_not_move_landmarks() -> None:
    directions, faces = sphere(300)
    shapes = [blob(directions, z) for z in np.eye(5)]
    mean = Mesh(np.mean(shapes, axis=0), faces)
    right, wrong = {"a": 7, "b": 150}, [{"a": 290, "b": 20}, {"a": 60, "b": 250}]
    marks = [*wrong, right, right, {"c": 30}]
    told = [(x, {name: x[k] for name, k in one.items()}) for x, one in zip(shapes, marks, strict=True)]
    places = consensus_landmarks(mean, told)
    found = places.select(["a", "b", "c"]).interpolate(mean.vertices)
    np.testing.assert_allclose(found, mean.vertices[[7, 150, 30]], atol=1e-6)


@pytest.mark.long
def test_a_model_to_begin_with_gives_its_triangles_and_what_it_knows(blobs: list[RawBlob]) -> None:
    model = ss.ShapeModel.fit(training_meshes())
    scans = [one.scan for one in blobs]
    guided, alone = correspond(scans, SETTINGS, model=model), correspond(scans, SETTINGS)
    np.testing.assert_array_equal(guided.template.faces, model.faces)
    apart = [dispersion_mm(blobs, [np.array(scan.vertices) for scan in made.scans]) for made in (guided, alone)]
    assert apart[0] < 0.7 * apart[1]
    with pytest.raises(InputError, match="omit template or model"):
        correspond(scans, SETTINGS, model=model, template=scans[0])


def test_a_model_of_splines_guides_with_its_shapes_and_one_of_points_is_refused(blobs: list[RawBlob]) -> None:
    meshes = [bowl(mesh) for mesh in training_meshes()]
    splines = ss.ShapeModel.fit(meshes, representation="bspline", control_points=(8, 8))
    scans = [one.scan for one in blobs[:2]]
    first = first_template(scans, None, SETTINGS, splines)
    assert first.guide is not None
    T = fit_similarity(splines.mean_vertices, first.mesh.vertices)
    b = 0.5 * splines.stddev
    np.testing.assert_allclose(first.guide.reconstruct(T.scale * b), T.apply(splines.reconstruct(b)), atol=1e-6)
    points = ss.ShapeModel.fit([Mesh(mesh.vertices, None, name=mesh.name) for mesh in meshes])
    with pytest.raises(MeshError, match="no triangles"):
        first_template(scans, None, SETTINGS, points)


@pytest.mark.long
def test_a_scan_that_lacks_a_part_is_no_template(blobs: list[RawBlob]) -> None:
    scans = [cut(one, 0.3) if k % 2 else one.scan for k, one in enumerate(blobs)]
    assert choose_template(scans, 0).index % 2 == 0


def test_a_scan_that_lacks_a_part_takes_its_size_from_the_others() -> None:
    blobs = [raw_blob(k, T=Similarity.identity()) for k in range(6)]
    scans = [cut(one, 0.4) if k == 2 else one.scan for k, one in enumerate(blobs)]
    made = correspond(scans, replace(SETTINGS, rounds=2))
    sizes = [scan.T_scan_template.scale for scan in made.scans]
    assert abs(np.log(sizes[2] / np.median(sizes))) < 0.05
