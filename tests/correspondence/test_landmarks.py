"""Landmarks, a model to begin with, mirror images and scans that lack a part: what each tells a correspondence."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shapespace as ss
from raw_blobs import LANDMARKS, RawBlob, dispersion_mm, marked, raw_blob
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmarks import Marks, Places, agreed
from shapespace.correspondence.mirror import Mirror
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.rounds import CorrespondSettings, correspond
from shapespace.correspondence.template import choose
from shapespace.errors import InputError
from shapespace.geometry.closest import build_engine
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import blob, sphere, training_meshes

QUICK = ElasticSettings(harmonics=150, points=1000)
SETTINGS = CorrespondSettings(vertices=900, rounds=1, first=QUICK, next=QUICK)
FLIP = np.array([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def blobs() -> list[RawBlob]:
    return [raw_blob(k) for k in range(6)]


def cut(one: RawBlob, share: float) -> Mesh:
    """Return the scan of a blob without that share of its points, at the lower end."""
    height = one.directions[:, 1]
    kept = height > np.quantile(height, share)
    faces = one.scan.faces[kept[one.scan.faces].all(axis=1)]
    used = np.unique(faces)
    number = np.full(len(kept), -1)
    number[used] = np.arange(len(used))
    return Mesh(one.scan.vertices[used], number[faces].astype(np.int32), name=one.scan.name)


def mirrored(mesh: Mesh) -> Mesh:
    """Return the mirror image of a scan."""
    return Mesh(mesh.vertices * FLIP, mesh.faces[:, ::-1], name=mesh.name)


def even(directions: FloatArray) -> FloatArray:
    """Return a blob that is its own mirror image."""
    side = directions * [-1, 1, 1]
    return 0.5 * (blob(directions, np.zeros(5)) + blob(side, np.zeros(5)) * FLIP)


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
    places = Places.on(mesh, {str(k): mesh.vertices[k] for k in where})
    moved = Marks(places, points, 0.02).pull(mesh.vertices, harmonics, 20.0, 80.0)
    kernel = harmonics.functions @ np.diag(harmonics.kept(20.0)) @ harmonics.functions.T
    noise = (0.02 * 80.0 / 10.0) ** 2 * kernel[where, where].mean()
    inverse = np.linalg.inv(kernel[np.ix_(where, where)] + noise * np.eye(3))
    np.testing.assert_allclose(moved, kernel[:, where] @ inverse @ (points - mesh.vertices[where]), atol=1e-9)


def test_landmarks_tell_the_pose_or_why_they_cannot() -> None:
    directions, faces = sphere(300)
    mesh = Mesh(blob(directions, np.zeros(5)), faces)
    points = {str(k): mesh.vertices[k] for k in (5, 60, 150, 290)}
    places = Places.on(mesh, points)
    T = Similarity(0.4, Rotation.from_rotvec([0.3, -2.0, 1.0]).as_matrix(), np.array([5.0, 0.0, -3.0]))
    pose = Marks(places, T.apply(np.stack(list(points.values()))), 0.02).pose(mesh.vertices)
    np.testing.assert_allclose(pose.apply(mesh.vertices), T.apply(mesh.vertices), atol=1e-6)
    image = T.apply(np.stack(list(points.values())) * FLIP)
    with pytest.raises(InputError, match="mirrored"):
        Marks(places, image, 0.02).pose(mesh.vertices)
    with pytest.raises(InputError, match="check their names"):
        Marks(places, image[[2, 0, 3, 1]] * [3.0, 1.0, 1.0], 0.02).pose(mesh.vertices)
    two = places.of(["5", "60"])
    assert Marks(two, two.at(mesh.vertices), 0.02).pose(mesh.vertices) is None


def test_a_landmark_lies_on_the_mean_where_most_have_it() -> None:
    directions, faces = sphere(300)
    shapes = [blob(directions, z) for z in np.eye(5)]
    mean = Mesh(np.mean(shapes, axis=0), faces)
    told = [(x, {"a": x[7], "b": x[90]} if k else {"a": x[40]}) for k, x in enumerate(shapes)]
    places = agreed(mean, told)
    np.testing.assert_allclose(places.of(["a", "b"]).at(mean.vertices), mean.vertices[[7, 90]], atol=1e-6)


def test_a_model_to_begin_with_gives_its_triangles_and_what_it_knows(blobs: list[RawBlob]) -> None:
    model = ss.ShapeModel.fit(training_meshes())
    scans = [one.scan for one in blobs]
    guided, alone = correspond(scans, SETTINGS, model=model), correspond(scans, SETTINGS)
    np.testing.assert_array_equal(guided.template.faces, model.faces)
    apart = [dispersion_mm(blobs, [np.array(scan.vertices) for scan in made.scans]) for made in (guided, alone)]
    assert apart[0] < 0.7 * apart[1]
    with pytest.raises(InputError, match="leave one out"):
        correspond(scans, SETTINGS, model=model, template=scans[0])


def test_a_mirrored_scan_is_named(blobs: list[RawBlob]) -> None:
    scans = [one.scan for one in blobs]
    scans[3] = mirrored(scans[3])
    made = correspond(scans, SETTINGS)
    assert [scan.reason.startswith("mirrored") for scan in made.scans] == [k == 3 for k in range(6)]


def test_the_mirror_image_of_a_shape_is_its_surface_turned_over() -> None:
    directions, faces = sphere(900)
    mesh = Mesh(even(directions), faces)
    mirror = Mirror.of(mesh, Harmonics.of(mesh, 150), QUICK, 0)
    assert np.linalg.norm(mirror.image(mesh.vertices) - mesh.vertices, axis=1).mean() < 1.0
    other = mesh.vertices + 15 * np.exp(-(((directions - [0.8, 0.6, 0]) / 0.5) ** 2).sum(axis=1))[:, None] * directions
    flipped = Mesh(other * FLIP, faces[:, ::-1])
    off = build_engine(flipped).query(mirror.image(other)).distance.mean()
    assert off < 0.5 * build_engine(flipped).query(other).distance.mean()


def test_an_object_that_is_not_symmetric_is_refused_as_such() -> None:
    directions, faces = sphere(900)
    spiral = directions * np.array([30.0, 100.0, 30.0])
    spiral[:, 0] += 60 * np.sin(2.5 * directions[:, 1])
    spiral[:, 2] += 60 * np.cos(2.5 * directions[:, 1])
    scans = [Mesh(spiral * (1 + 0.01 * k), np.roll(faces, k, axis=1), name=str(k)) for k in range(2)]
    with pytest.raises(InputError, match="leave --symmetric out"):
        correspond(scans, replace(SETTINGS, symmetric=True), template=scans[0])


def test_a_scan_that_lacks_a_part_is_no_template(blobs: list[RawBlob]) -> None:
    scans = [cut(one, 0.3) if k % 2 else one.scan for k, one in enumerate(blobs)]
    assert choose(scans, 0).index % 2 == 0


def test_a_scan_that_lacks_a_part_takes_its_size_from_the_others() -> None:
    blobs = [raw_blob(k, T=Similarity.identity()) for k in range(6)]
    scans = [cut(one, 0.4) if k == 2 else one.scan for k, one in enumerate(blobs)]
    made = correspond(scans, replace(SETTINGS, rounds=2))
    sizes = [scan.T_scan_template.scale for scan in made.scans]
    assert abs(np.log(sizes[2] / np.median(sizes))) < 0.05
