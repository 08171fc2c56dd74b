import numpy as np
import pytest
from scipy.spatial import cKDTree

from shapespace.datasets.simulated_scan import (
    Collar,
    Cut,
    Hair,
    Hole,
    Retriangulation,
    random_similarity,
    retriangulate,
    simulate_scan,
)
from shapespace.errors import InputError, MeshError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import boundary_edges, face_vectors
from shapespace.types import Mesh


def bumpy_face(rows: int = 90) -> Mesh:
    """A face-like half ellipsoid with a nose, 8,100 vertices, y up, facing +z, mm."""
    u, v = np.meshgrid(np.linspace(-1.35, 1.35, rows), np.linspace(-1.2, 1.2, rows))
    nose = 22 * np.exp(-((u / 0.16) ** 2) - ((v + 0.1) / 0.25) ** 2)
    r = 80 + nose + 1.5 * np.sin(9 * u) * np.cos(8 * v)
    points = np.stack([r * np.sin(u) * np.cos(v), 1.3 * r * np.sin(v), r * np.cos(u) * np.cos(v)], axis=2)
    i = (np.arange(rows - 1)[:, None] * rows + np.arange(rows - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + rows], 1), np.stack([i + 1, i + rows + 1, i + rows], 1)]).astype(
        np.int32
    )
    vertices = points.reshape(-1, 3)
    return Mesh(vertices, faces, {"nose": vertices[(rows // 2 - 4) * rows + rows // 2]}, "bumpy")


@pytest.fixture(scope="module")
def face() -> Mesh:
    return bumpy_face()


def distance_to(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    return build_engine(mesh, "surface").query(points).distance


def test_new_vertices_lie_on_the_surface_and_none_is_an_old_one(face: Mesh) -> None:
    vertices, faces = retriangulate(face, np.random.default_rng(0), 40_000)
    assert abs(len(faces) - 40_000) <= 2
    assert distance_to(face, vertices).max() < 1e-6
    gap = cKDTree(vertices).query(face.vertices)[0]
    assert (gap < 0.01).mean() < 0.005
    new = Mesh(vertices, faces.astype(np.int32))
    # The border loses a few tenths of a millimetre at its corners; the inside does not.
    assert np.quantile(distance_to(new, face.vertices), 0.95) < 0.1
    assert np.sqrt((distance_to(face, vertices[faces].mean(axis=1)) ** 2).mean()) < 0.05


def test_scans_that_share_triangles_lie_on_their_own_surfaces(face: Mesh) -> None:
    rng = np.random.default_rng(0)
    shared = Retriangulation.of(face, rng, 8_000)
    wider = face.with_vertices(face.vertices * [1.1, 1.0, 1.0])
    first, second = (simulate_scan(wider, rng, triangles=shared, noise_mm=0.0).scan for _ in range(2))
    for scan in (first, second):
        assert scan.faces is not None and len(scan.faces) == len(shared.faces)
        assert distance_to(wider, scan.vertices).max() < 1e-6
        assert (cKDTree(scan.vertices).query(wider.vertices)[0] < 0.01).mean() < 0.005
    assert cKDTree(first.vertices).query(second.vertices)[0].mean() > 0.05


def test_new_triangles_keep_their_winding_and_the_border(face: Mesh) -> None:
    vertices, faces = retriangulate(face, np.random.default_rng(0), 20_000)
    inside = vertices[faces].mean(axis=1) * face_vectors(vertices, faces.astype(np.int32))
    assert (inside.sum(axis=1) < 0).mean() < 0.002
    assert len(np.unique(faces)) == len(vertices)
    edges = boundary_edges(faces.astype(np.int32))
    length = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1).sum()
    old = boundary_edges(face.faces)
    expected = np.linalg.norm(face.vertices[old[:, 0]] - face.vertices[old[:, 1]], axis=1).sum()
    assert length == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("triangles", [500, 100_000])
def test_fewer_and_more_triangles_than_the_model_has(face: Mesh, triangles: int) -> None:
    scan = simulate_scan(face, np.random.default_rng(0), triangles=triangles).scan
    assert scan.faces is not None
    assert abs(len(scan.faces) - triangles) <= 2


def test_noise_is_along_the_normals_and_as_large_as_asked(face: Mesh) -> None:
    quiet = simulate_scan(face, np.random.default_rng(2), triangles=20_000, noise_mm=0.0)
    loud = simulate_scan(face, np.random.default_rng(2), triangles=20_000, noise_mm=0.5)
    assert distance_to(face, quiet.scan.vertices).max() < 1e-6
    rms = np.sqrt((distance_to(face, loud.scan.vertices) ** 2).mean())
    assert rms == pytest.approx(0.5, rel=0.1)


def test_truth_is_the_model_moved_by_the_stated_similarity(face: Mesh) -> None:
    T = random_similarity(np.random.default_rng(4), 30.0, (0.8, 1.2), 500.0)
    result = simulate_scan(face, np.random.default_rng(5), triangles=20_000, noise_mm=0.0, T_scan_model=T)
    assert np.allclose(result.truth_vertices, T.apply(face.vertices))
    assert np.allclose(result.truth_landmarks["nose"], T.apply(face.landmarks["nose"]))
    truth = Mesh(result.truth_vertices, face.faces)
    assert distance_to(truth, result.scan.vertices).max() < 1e-6
    assert result.on_surface.all()
    assert not result.scan.landmarks


def test_the_same_seed_gives_the_same_scan_and_another_does_not(face: Mesh) -> None:
    options = {"triangles": 8_000, "hair": Hair(), "collar": Collar(), "holes": [Hole(10.0)], "outlier_fraction": 0.01}
    one, two, three = (simulate_scan(face, np.random.default_rng(s), **options) for s in (1, 1, 2))
    assert np.array_equal(one.scan.vertices, two.scan.vertices)
    assert np.array_equal(one.scan.faces, two.scan.faces)
    assert np.array_equal(one.on_surface, two.on_surface)
    assert one.scan.vertices.shape != three.scan.vertices.shape or not np.array_equal(
        one.scan.vertices, three.scan.vertices
    )


def test_holes_and_cuts_leave_nothing_within_them(face: Mesh) -> None:
    center = face.landmarks["nose"]
    result = simulate_scan(
        face,
        np.random.default_rng(0),
        triangles=20_000,
        holes=[Hole(15.0, center)],
        crop=[Cut((40.0, 0.0, 0.0), (2.0, 0.0, 0.0))],
    )
    vertices = result.scan.vertices
    assert np.linalg.norm(vertices - center, axis=1).min() > 15.0
    assert vertices[:, 0].max() <= 40.0
    assert distance_to(result.scan, center[None])[0] > 10.0
    assert len(result.truth_vertices) == len(face.vertices)


def test_hair_stands_off_the_upper_border_and_is_marked(face: Mesh) -> None:
    result = simulate_scan(face, np.random.default_rng(0), triangles=20_000, hair=Hair())
    hair = result.scan.vertices[~result.on_surface]
    assert 0.1 < (~result.on_surface).mean() < 0.7
    top = face.vertices[:, 1].max()
    near = hair[(hair[:, 1] < top) & (hair[:, 2] > 20)]
    gap = distance_to(face, near)
    # It covers a part of the forehead without lying in the skin, and rises above the face.
    assert 1.0 < np.median(gap) < 20.0
    assert (gap > 0.5).mean() > 0.95
    assert hair[:, 1].max() > top + 5
    assert distance_to(face, result.scan.vertices[result.on_surface]).max() < 2.0


def test_a_collar_lies_below_and_faces_outward(face: Mesh) -> None:
    result = simulate_scan(face, np.random.default_rng(0), triangles=10_000, collar=Collar())
    collar = result.scan.vertices[~result.on_surface]
    low = face.vertices[:, 1].min()
    assert low - 60 < collar[:, 1].min() < low - 20
    assert collar[:, 1].max() < low + 15
    faces = result.scan.faces[(~result.on_surface)[result.scan.faces].all(axis=1)]
    away = result.scan.vertices[faces].mean(axis=1) - collar.mean(axis=0)
    assert ((face_vectors(result.scan.vertices, faces) * away)[:, [0, 2]].sum(axis=1) > 0).mean() > 0.9


def test_outliers_are_as_many_as_asked_and_marked(face: Mesh) -> None:
    result = simulate_scan(face, np.random.default_rng(0), triangles=20_000, outlier_fraction=0.05)
    assert (~result.on_surface).mean() == pytest.approx(0.05, abs=0.01)
    assert distance_to(face, result.scan.vertices[result.on_surface]).max() < 1.5
    assert np.median(distance_to(face, result.scan.vertices[~result.on_surface])) > 3.0


def test_the_order_of_the_scan_says_nothing_about_the_model(face: Mesh) -> None:
    scan = simulate_scan(face, np.random.default_rng(0), triangles=20_000).scan
    step = np.linalg.norm(np.diff(scan.vertices, axis=0), axis=1)
    assert np.median(step) > 40


def test_random_similarities_stay_within_their_bounds() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        T = random_similarity(rng, 15.0, (0.5, 2.0), 10.0)
        angle = np.rad2deg(np.arccos(np.clip((np.trace(T.rotation) - 1) / 2, -1, 1)))
        assert angle <= 15.0 + 1e-6
        assert 0.5 <= T.scale <= 2.0
        assert np.abs(T.translation).max() <= 10.0


def test_what_cannot_be_simulated_is_refused(face: Mesh) -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="leave nothing"):
        simulate_scan(face, rng, triangles=2_000, holes=[Hole(1e4, (0, 0, 0))])
    with pytest.raises(InputError, match="at least 4"):
        simulate_scan(face, rng, triangles=1)
    with pytest.raises(InputError, match="positive"):
        random_similarity(rng, scale_range=(0.0, 1.0))
    with pytest.raises(MeshError, match="no faces"):
        simulate_scan(Mesh(face.vertices), rng)
    fin = Mesh(np.eye(5, 3) + np.arange(15).reshape(5, 3) % 4, np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]), name="fin")
    with pytest.raises(MeshError, match="fin cannot be re-triangulated"):
        simulate_scan(fin, rng, triangles=100)
