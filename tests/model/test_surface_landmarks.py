"""Landmarks stay where they were placed on a surface, from the model file to every surface of the model."""

import copy
import json
import pickle
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapespace.errors import FileFormatError, InputError, MeshError, ModelFileError
from shapespace.formats.registry import MODEL_FORMATS
from shapespace.geometry.landmark_placement import far_landmarks, place_landmarks
from shapespace.geometry.normals import rms_size
from shapespace.io.containers.hdf5 import read_hdf5, write_hdf5
from shapespace.io.landmarks.landmark_io import read_landmark_indices, read_surface_landmarks, write_surface_landmarks
from shapespace.model.additive import AdditiveModel
from shapespace.model.region import ModelRegion
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks
from synthetic_shapes import blob_model, training_meshes

OLD = Path(__file__).parent / "data" / "version_1.h5"
"""Three modes of twelve blobs of 60 vertices, written by shapespace 0.1.0 before there was version 2."""
VERTICES = 60


def on_surface(mesh: Mesh, count: int = 5, seed: int = 0) -> dict[str, FloatArray]:
    """Return points inside triangles of `mesh`, none near a vertex."""
    rng = np.random.default_rng(seed)
    faces = np.asarray(mesh.faces)
    chosen = faces[rng.choice(len(faces), count, replace=False)]
    weights = 0.2 + 0.4 * rng.dirichlet(np.ones(3), count)
    return {f"mark {k}": w @ mesh.vertices[f] for k, (w, f) in enumerate(zip(weights, chosen, strict=True))}


@pytest.fixture(scope="module")
def meshes() -> tuple[Mesh, ...]:
    return training_meshes(count=12, vertices=VERTICES)


@pytest.fixture(scope="module")
def landmarks(meshes: tuple[Mesh, ...]) -> SurfaceLandmarks:
    return place_landmarks(meshes[0], on_surface(meshes[0]))


@pytest.fixture(scope="module")
def model(meshes: tuple[Mesh, ...], landmarks: SurfaceLandmarks) -> ShapeModel:
    return ShapeModel.fit(meshes, modes=3, landmarks=landmarks)


@settings(max_examples=60, deadline=None, database=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_position_on_an_affinely_moved_mesh_is_the_moved_position(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mesh = training_meshes(count=12, vertices=VERTICES)[seed % 12]
    landmarks = place_landmarks(mesh, on_surface(mesh, seed=seed))
    matrix, shift = rng.normal(0, 3, (3, 3)), rng.normal(0, 200, 3)
    moved = landmarks.interpolate(mesh.vertices @ matrix.T + shift)
    expected = landmarks.interpolate(mesh.vertices) @ matrix.T + shift
    np.testing.assert_allclose(moved, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_points_on_a_surface_stay_there_to_rounding(meshes: tuple[Mesh, ...]) -> None:
    points = on_surface(meshes[0])
    landmarks = place_landmarks(meshes[0], points)
    back = landmarks.positions(meshes[0].vertices)
    size_mm = rms_size(meshes[0].vertices)
    assert max(np.linalg.norm(back[name] - points[name]) for name in points) < 1e-13 * size_mm
    assert landmarks.distance_mm.max() < 1e-13 * size_mm
    nearest = meshes[0].vertices[list(landmarks.values())]
    assert np.linalg.norm(nearest - np.stack(list(points.values())), axis=1).min() > 1.0  # mm by which they snapped


def test_points_off_a_surface_are_at_its_closest_point_with_their_distance(meshes: tuple[Mesh, ...]) -> None:
    mesh = meshes[0]
    a, b, c = mesh.vertices[np.asarray(mesh.faces)[0]]
    normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    middle = (a + b + c) / 3
    landmarks = place_landmarks(mesh, {"out": middle + 2.5 * normal, "on": middle, "corner": a})
    np.testing.assert_allclose(landmarks.positions(mesh.vertices)["out"], middle, atol=1e-10)
    np.testing.assert_allclose(landmarks.distance_mm, [2.5, 0.0, 0.0], atol=1e-10)
    assert landmarks["corner"] == np.asarray(mesh.faces)[0, 0] and landmarks.select(["corner"]).are_vertices


def test_only_landmarks_beyond_an_edge_and_a_hundredth_of_the_size_are_far(meshes: tuple[Mesh, ...]) -> None:
    coarse = meshes[0]
    fine = training_meshes(count=2, vertices=3000)[0]
    for mesh, off_mm, is_far in ((coarse, 5.0, False), (coarse, 60.0, True), (fine, 0.5, False), (fine, 12.0, True)):
        outward = mesh.vertices[0] / np.linalg.norm(mesh.vertices[0])
        placed = place_landmarks(mesh, {"a": mesh.vertices[0] + off_mm * outward})
        assert bool(far_landmarks(mesh, placed)) is is_far


def test_missing_vertices_and_clouds_take_the_nearest_that_is_there(meshes: tuple[Mesh, ...]) -> None:
    vertices = np.array(meshes[0].vertices)
    gone = int(np.asarray(meshes[0].faces)[0, 0])
    vertices[gone] = np.nan
    holed = place_landmarks(Mesh(vertices, meshes[0].faces), {"a": meshes[0].vertices[gone]})
    assert gone not in holed.corners and np.isfinite(holed.interpolate(vertices)).all()
    cloud = place_landmarks(Mesh(vertices), {"a": vertices[7] + 0.5})
    assert dict(cloud) == {"a": 7} and cloud.distance_mm[0] == pytest.approx(0.5 * np.sqrt(3))
    with pytest.raises(MeshError, match="no vertices"):
        place_landmarks(Mesh(np.full((4, 3), np.nan)), {"a": np.zeros(3)})
    with pytest.raises(InputError, match="'a' is not three finite numbers"):
        place_landmarks(meshes[0], {"a": np.array([0.0, np.nan, 0.0])})


def test_a_mapping_of_vertices_is_as_good_as_landmarks() -> None:
    landmarks = SurfaceLandmarks.of({"tip": 7, "back": 3})
    assert landmarks == {"tip": 7, "back": 3} and landmarks.are_vertices and landmarks["tip"] == 7
    assert SurfaceLandmarks.of(landmarks) is landmarks and "tip" in landmarks and len(landmarks) == 2
    halfway = SurfaceLandmarks(("tip",), np.array([[7, 3, 1]]), np.array([[0.6, 0.4, 0.0]]))
    assert dict(halfway) == {"tip": 7} and halfway != {"tip": 7} and halfway != landmarks and halfway != 7
    for back in (pickle.loads(pickle.dumps(halfway)), copy.deepcopy(halfway), copy.copy(halfway)):
        assert back == halfway and not back.corners.flags.writeable


def test_a_corner_without_weight_does_not_matter() -> None:
    edge = SurfaceLandmarks(("m",), np.array([[5, 9, 2]]), np.array([[0.0, 0.75, 0.25]]))
    values = np.arange(30.0).reshape(10, 3)
    values[5] = np.nan
    np.testing.assert_array_equal(edge.interpolate(values)[0], 0.75 * values[9] + 0.25 * values[2])
    assert edge["m"] == 9 and list(edge.within(np.arange(10) != 5)) == ["m"]


@pytest.mark.parametrize(
    ("parts", "what"),
    [
        ((("a", "a"), np.zeros((2, 3)), np.full((2, 3), 1 / 3)), "same name"),
        ((("a",), np.zeros((1, 2)), np.full((1, 3), 1 / 3)), "1 landmarks need corners"),
        ((("a",), np.zeros((1, 3)), np.array([[1.2, -0.2, 0.0]])), "not be negative"),
        ((("a",), np.zeros((1, 3)), np.array([[0.5, 0.4, 0.0]])), "with the sum 1"),
        ((("a",), np.zeros((1, 3)), np.full((1, 3), np.nan)), "with the sum 1"),
        ((("a",), np.array([[0, -4, 1]]), np.full((1, 3), 1 / 3)), "vertex -4"),
        ((("a",), np.zeros((1, 3)), np.full((1, 3), 1 / 3), np.array([-1.0])), "Distances"),
    ],
)
def test_what_is_no_landmark_is_refused(parts: tuple[object, ...], what: str) -> None:
    with pytest.raises(InputError, match=what):
        SurfaceLandmarks(*parts)  # type: ignore[arg-type]


def test_a_model_keeps_landmarks_in_their_triangles_through_its_file(
    model: ShapeModel, landmarks: SurfaceLandmarks, tmp_path: Path
) -> None:
    off = replace(model, landmarks=replace(landmarks, distance_mm=np.arange(5.0)))
    off.save(tmp_path / "m.h5")
    again = ShapeModel.load(tmp_path / "m.h5")
    assert again.landmarks == off.landmarks and again.content_hash == off.content_hash != model.content_hash
    with h5py.File(tmp_path / "m.h5") as file:
        assert file.attrs["format_version"] == 2
        assert json.loads(file.attrs["landmarks"]) == dict(landmarks)
    points = again.mesh(again.stddev).landmarks
    for name, expected in again.landmarks.positions(again.reconstruct(again.stddev)).items():
        np.testing.assert_array_equal(points[name], expected)


def test_a_model_file_of_another_version_is_refused_with_both_versions() -> None:
    sentence = r"version_1\.h5 is a model of format version 1, .* reads version 2; build"
    with pytest.raises(ModelFileError, match=sentence):
        ShapeModel.load(OLD)


@pytest.mark.parametrize(
    ("array", "value"),
    [
        ("landmark_corners", np.full((5, 3), VERTICES, dtype=np.int32)),
        ("landmark_corners", np.zeros((5, 3), dtype=np.int32)),
        ("landmark_corners", np.zeros((4, 3), dtype=np.int32)),
        ("landmark_corners", np.zeros((5, 3))),
        ("landmark_barycentric", np.full((5, 3), np.nan)),
        ("landmark_barycentric", np.full((5, 3), -1.0)),
        ("landmark_barycentric", np.full((5, 3), 1e308)),
        ("landmark_distance_mm", np.full(5, np.inf)),
        ("landmark_distance_mm", np.zeros((5, 5))),
        ("landmark_distance_mm", None),
    ],
)
def test_landmarks_that_do_not_belong_to_their_model_are_refused(
    model: ShapeModel, array: str, value: np.ndarray | None, tmp_path: Path
) -> None:
    model.save(tmp_path / "m.h5")
    arrays, attributes = read_hdf5(tmp_path / "m.h5")
    told = {name: value for name, value in attributes.items() if name != "content_hash"}
    changed = {name: one for name, one in arrays.items() if name != array} | ({} if value is None else {array: value})
    write_hdf5(tmp_path / "bad.h5", changed, told)
    with pytest.raises(ModelFileError, match=r"bad\.h5"):
        ShapeModel.load(tmp_path / "bad.h5")


@pytest.mark.parametrize("representation", ["vertices", "bspline"])
def test_landmarks_stay_through_truncation_representations_and_copies(representation: str) -> None:
    half = [m.with_vertices(m.vertices) for m in training_meshes(count=6, vertices=300)]
    faces = np.asarray(half[0].faces)
    faces = faces[(half[0].vertices[faces][:, :, 2] > 0).all(axis=1)]
    used = np.unique(faces)
    number = np.zeros(300, dtype=np.int32)
    number[used] = np.arange(len(used))
    half = [Mesh(m.vertices[used], number[faces], name=m.name) for m in half]
    landmarks = place_landmarks(half[0], on_surface(half[0]))
    points = {} if representation == "vertices" else {"control_points": (12, 12)}
    whole = ShapeModel.fit(half, landmarks=landmarks, representation=representation, **points)
    for one in (whole, whole.truncate(2), pickle.loads(pickle.dumps(whole)), copy.deepcopy(whole)):
        assert one.landmarks == landmarks
        np.testing.assert_array_equal(
            np.stack(list(one.mesh().landmarks.values())), landmarks.interpolate(one.mean_vertices)
        )


def test_a_landmark_goes_where_its_triangle_is_cut_away_and_not_otherwise(
    meshes: tuple[Mesh, ...], model: ShapeModel, landmarks: SurfaceLandmarks
) -> None:
    gone = int(landmarks.corners[0, 2])
    left = [name for name, corners in zip(landmarks.names, landmarks.corners, strict=True) if gone not in corners]
    assert 0 < len(left) < len(landmarks)
    inside = np.arange(VERTICES) != gone
    holed: list[Mesh] = []
    for k, mesh in enumerate(meshes):
        vertices = np.array(mesh.vertices)
        vertices[gone if k > 1 else []] = np.nan
        holed.append(mesh.with_vertices(vertices))
    seldom = ShapeModel.fit(holed, modes=2, landmarks=landmarks)
    region = ModelRegion.of(model, tuple(np.flatnonzero(inside).tolist())).model
    for part in (seldom, region):
        assert list(part.landmarks) == left and part.n_vertices == VERTICES - 1
    for name in left:
        np.testing.assert_allclose(region.mesh().landmarks[name], model.mesh().landmarks[name], atol=1e-12)
    with pytest.raises(InputError, match="which the surface does not have"):
        ShapeModel.fit(holed, landmarks=SurfaceLandmarks(("a",), np.array([[0, 1, 60]]), np.full((1, 3), 1 / 3)))


def test_streamed_and_additive_models_keep_them_too(
    meshes: tuple[Mesh, ...], landmarks: SurfaceLandmarks, tmp_path: Path
) -> None:
    streamed = ShapeModel.fit(meshes, modes=3, landmarks=landmarks, keep_shapes=tmp_path / "shapes")
    assert streamed.landmarks == landmarks
    assert streamed.with_more(meshes[:2], tmp_path / "shapes", modes=3).landmarks == landmarks
    people, neutral = [f"p{k // 2}" for k in range(12)], [k % 2 == 0 for k in range(12)]
    additive = AdditiveModel.fit(meshes, people, neutral, identity_modes=2, expression_modes=2, landmarks=landmarks)
    additive.save(tmp_path / "a.h5")
    again = AdditiveModel.load(tmp_path / "a.h5")
    assert again.shape.landmarks == landmarks
    at = again.mesh([1.0], [0.5])
    np.testing.assert_array_equal(at.landmarks["mark 0"], landmarks.interpolate(at.vertices)[0])


def test_csv_keeps_triangles_exactly_and_vertices_as_before(landmarks: SurfaceLandmarks, tmp_path: Path) -> None:
    path = tmp_path / "landmarks.csv"
    off = replace(landmarks, distance_mm=np.linspace(0, 1 / 3, 5))
    write_surface_landmarks(path, off)
    assert read_surface_landmarks(path) == off
    assert read_landmark_indices(path) == dict(off)  # as readers of the old form take it
    vertices = SurfaceLandmarks.of({"nose": 12, "a, b": 0})
    write_surface_landmarks(path, vertices)
    assert path.read_text("utf-8") == 'name,vertex\nnose,12\n"a, b",0\n'
    assert read_surface_landmarks(path) == vertices


@pytest.mark.parametrize(
    "row", ["a,1,0.5,2,0.6,3,0", "a,1,0.5,2,0.5", "a,1,0.5,x,0.5,3,0", "a,1,nan,2,0.5,3,0.5", "a,1,1,-2,0,3,0",
            "a,99999999999,1,2,0,3,0", "a,1,0.5,2,half,3,0"],
)  # fmt: skip
def test_malformed_rows_of_triangles_are_refused(row: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"name,vertex,weight,vertex_2,weight_2,vertex_3,weight_3\n{row}\n", "utf-8")
    with pytest.raises(FileFormatError, match=r"a\.csv.*\.$"):
        read_surface_landmarks(tmp_path / "a.csv")


@pytest.mark.parametrize("name", list(MODEL_FORMATS))
def test_formats_of_other_tools_keep_them_or_say_by_how_much_they_move(name: str, tmp_path: Path) -> None:
    whole = blob_model(300)
    landmarks = place_landmarks(whole.mesh(), on_surface(whole.mesh()))
    model = replace(whole, landmarks=landmarks)
    one = MODEL_FORMATS[name]
    path = tmp_path / f"model{one.suffixes[0] if one.suffixes else ''}"
    said = [note for note in one.write(model.as_linear(), path) if "andmarks are moved" in note]
    again = ShapeModel.load(path)
    assert list(again.landmarks) == (sorted(landmarks) if name == "eos" else list(landmarks))
    at = again.landmarks.select(landmarks.names).interpolate(again.mean_vertices)
    off = np.linalg.norm(at - landmarks.interpolate(model.mean_vertices), axis=1)
    if name == "eos":
        nearest = model.mean_vertices[list(landmarks.values())] - landmarks.interpolate(model.mean_vertices)
        moved = np.linalg.norm(nearest, axis=1)
        assert f"{moved.mean():.2g} mm on average, at most {moved.max():.2g} mm" in said[0]
        np.testing.assert_allclose(off, moved, atol=1e-3)
    else:
        assert not said and off.max() < 2e-6 * float(np.ptp(model.mean_vertices))
        assert again.landmarks.distance_mm.max() < 1e-4
