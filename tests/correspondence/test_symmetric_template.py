"""Symmetric templates: exactly their own mirror image, in any pose and unit; objects without symmetry are refused."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.cohort.cohort import Cohort
from shapespace.correspondence import SymmetricMesh, symmetrise
from shapespace.correspondence.first_template import first_template
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.bones import Bone
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.errors import InputError, MeshError
from shapespace.geometry.closest import surface_distances
from shapespace.geometry.mirror_plane import find_mirror, pairs_of_triangles, reflect
from shapespace.geometry.normals import boundary_edges, face_areas, faces_of, part_of
from shapespace.model.shape_model import ShapeModel
from shapespace.statistics.asymmetry import measure_asymmetry
from shapespace.types import Mesh
from symmetric_object import symmetric_object


def skull(points: int = 700) -> Mesh:
    """Return a closed surface that is about 1 % of its size off its mirror image, in a random pose."""
    return raw_surface(Bone.draw(np.random.default_rng(3)), np.random.default_rng(3), points)


@pytest.fixture(scope="module")
def closed() -> SymmetricMesh:
    return symmetrise(skull())


@pytest.fixture(scope="module")
def open_mesh() -> Mesh:
    mesh = skull()
    mirror = find_mirror(mesh)
    along = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), full_matrices=False)[2][0]
    assert abs(along @ mirror.normal) < 0.1
    across = (mesh.vertices - mesh.vertices.mean(axis=0)) @ along
    return part_of(mesh, across < 10.0)


@pytest.fixture(scope="module")
def opened(open_mesh: Mesh) -> SymmetricMesh:
    return symmetrise(open_mesh)


def characteristic(mesh: Mesh) -> int:
    faces = faces_of(mesh)
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    return len(np.unique(faces)) - len(edges) + len(faces)


@pytest.mark.parametrize("which", ["closed", "opened"])
def test_the_mesh_is_its_own_mirror_image(which: str, request: pytest.FixtureRequest) -> None:
    made: SymmetricMesh = request.getfixturevalue(which)
    x, faces, pairs = made.mesh.vertices, faces_of(made.mesh), made.pairs
    image = reflect(np.asarray(x), made.normal, float(made.normal @ made.point))
    assert np.abs(image - x[pairs]).max() < 1e-10
    assert np.array_equal(pairs[pairs], np.arange(len(x)))
    assert made.midline.any()
    assert np.abs((x[made.midline] - made.point) @ made.normal).max() < 1e-10
    half = len(faces) // 2
    assert np.array_equal(pairs[faces[:half, ::-1]], faces[half:])
    areas = face_areas(made.mesh)
    assert areas[:half].sum() == pytest.approx(areas[half:].sum(), rel=1e-12)
    assert areas.min() > 1e-3 * np.median(areas)
    count = int(made.midline.sum())
    side = (len(x) - count) // 2
    assert np.array_equal(pairs[count : count + side], np.arange(count + side, len(x)))
    assert np.array_equal(np.flatnonzero(made.midline), np.arange(count))
    assert ((x - made.point) @ made.normal)[count : count + side].min() > 0


def test_a_closed_surface_stays_closed_and_a_border_a_border(
    closed: SymmetricMesh, open_mesh: Mesh, opened: SymmetricMesh
) -> None:
    assert characteristic(closed.mesh) == characteristic(skull()) == 2
    assert not len(boundary_edges(faces_of(closed.mesh)))
    assert characteristic(opened.mesh) == characteristic(open_mesh)
    border, given = boundary_edges(faces_of(opened.mesh)), boundary_edges(faces_of(open_mesh))
    assert 0.8 < len(border) / len(given) < 1.25
    assert len(np.unique(border)) == len(border)


def test_the_mesh_is_between_the_surface_and_its_mirror_image(closed: SymmetricMesh) -> None:
    mesh = skull()
    image = Mesh(reflect(np.asarray(mesh.vertices), closed.normal, float(closed.normal @ closed.point)),
                 faces_of(mesh)[:, ::-1])  # fmt: skip
    apart = surface_distances(mesh, image).model_to_scan_mm
    both = [surface_distances(closed.mesh, surface).model_to_scan_mm for surface in (mesh, image)]
    assert closed.asymmetry == pytest.approx(float(np.sqrt((apart**2).mean())), rel=0.1)
    for off in both:
        assert np.sqrt((off**2).mean()) < 0.65 * closed.asymmetry


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_it_moves_with_pose_and_unit(closed: SymmetricMesh, scale: float) -> None:
    turn, shift = Rotation.random(random_state=1).as_matrix(), np.array([100.0, -50.0, 30.0])
    mesh = skull()
    moved = symmetrise(mesh.with_vertices(scale * (mesh.vertices @ turn.T + shift)))
    expected = scale * (np.asarray(closed.mesh.vertices) @ turn.T + shift)
    assert len(moved.mesh.vertices) == len(expected)
    assert np.abs(moved.mesh.vertices - expected).max() < 1e-4 * scale * 30.0
    assert moved.asymmetry == pytest.approx(scale * closed.asymmetry, rel=1e-4)
    assert moved.asymmetry_share == pytest.approx(closed.asymmetry_share, rel=1e-4)


def test_what_is_missing_on_one_side_comes_from_the_other() -> None:
    thing = symmetric_object(half=400, ring=36)
    centre = np.argmax(thing.x @ [1.0, 0.3, 0.3])
    hole = np.linalg.norm(thing.x - thing.x[centre], axis=1) < 25.0
    made = symmetrise(part_of(Mesh(thing.x, thing.faces), ~hole))
    assert not len(boundary_edges(faces_of(made.mesh)))
    assert np.degrees(np.arccos(min(1.0, abs(made.normal[0])))) < 0.1
    off = surface_distances(Mesh(thing.x, thing.faces), made.mesh).model_to_scan_mm
    assert off.max() < 1.0


def test_landmarks_and_colours_are_symmetric_too() -> None:
    thing = symmetric_object(half=200, ring=28)
    left = int(np.argmax(thing.x @ [1.0, 1.0, 0.5]))
    top = int(np.argmax(np.where(thing.other == np.arange(len(thing.x)), thing.x[:, 1], -np.inf)))
    alone = int(np.argmin(thing.x @ [1.0, 1.0, 0.2]))
    points = {"eye L": left, "eye R": int(thing.other[left]), "top": top, "ear": alone}
    landmarks = {name: thing.x[v] + (0.5 if name == "eye L" else 0.0) for name, v in points.items()}
    colours = np.repeat((thing.x[:, 1] > 0)[:, None] * np.uint8(200), 3, axis=1)
    made = symmetrise(Mesh(thing.x, thing.faces, landmarks, colours=colours))
    assert made.landmark_pairs == {"eye L": "eye R", "eye R": "eye L", "top": "top"}
    placed, offset = made.mesh.landmarks, float(made.normal @ made.point)
    assert np.allclose(reflect(np.asarray(placed["eye L"]), made.normal, offset), placed["eye R"])
    assert placed["top"] @ made.normal == pytest.approx(offset)
    assert np.linalg.norm(placed["ear"] - thing.x[alone]) < 0.5
    assert made.mesh.colours is not None
    assert np.array_equal(made.mesh.colours, made.mesh.colours[made.pairs])
    assert ((made.mesh.colours[:, 0] > 0) == (made.mesh.vertices[:, 1] > 0)).mean() > 0.95


def test_objects_without_mirror_symmetry_are_refused_in_one_sentence() -> None:
    organ = raw_surface(Organ.draw(np.random.default_rng(0)), np.random.default_rng(0), 700)
    with pytest.raises(InputError, match=r"no mirror symmetry: it differs from its mirror image by \d") as error:
        symmetrise(replace(organ, name="spleen.ply"))
    assert str(error.value).startswith("spleen.ply")
    assert str(error.value).count(". ") == 0
    with pytest.raises(MeshError, match="triangles"):
        symmetrise(Mesh(organ.vertices))


def test_the_first_template_is_symmetric_where_that_is_asked_for() -> None:
    scans = [raw_surface(Bone.draw(np.random.default_rng(k)), np.random.default_rng(k), 500) for k in (1, 2)]
    first = first_template(scans, scans[0], CorrespondConfig(symmetric_template=True))
    pairs = pairs_of_triangles(faces_of(first.mesh), len(first.mesh.vertices))
    assert pairs is not None
    assert "made symmetric" in first.origin
    model = ShapeModel.fit([first.mesh.with_vertices(first.mesh.vertices * [1.0, 1.0, s]) for s in (0.9, 1.0, 1.1)])
    with pytest.raises(InputError, match="--symmetric"):
        first_template(scans, None, CorrespondConfig(symmetric_template=True), model)


def test_asymmetry_uses_the_pairs_and_recovers_a_directional_asymmetry(closed: SymmetricMesh) -> None:
    """One side is 1 mm larger in all subjects; the subjects are so asymmetric that no mirror plane would be found."""
    rng, x = np.random.default_rng(0), np.asarray(closed.mesh.vertices)
    side = (x - closed.point) @ closed.normal
    bump = np.exp(-(((x - x[np.argmax(side)]) / 6.0) ** 2).sum(axis=1))
    shapes: list[np.ndarray] = []
    for _ in range(12):
        waves = 0.03 * rng.standard_normal((6, 3))
        both = 0.6 * np.sin(x @ waves.T + rng.uniform(0, 6, 6)) @ rng.standard_normal((6, 3))
        image = reflect(both[closed.pairs], closed.normal, 0.0)
        shapes.append(x + (both + image) / 2.0 + bump[:, None] * closed.normal)
    cohort = Cohort.of_shapes(np.stack(shapes), {}, faces=closed.mesh.faces, gauge="form")
    found = measure_asymmetry(cohort, permutations=0)
    assert found.sides.paired
    assert np.array_equal(found.sides.corners[:, 0], closed.pairs)
    largest = int(np.argmax(bump))
    length = np.linalg.norm(found.difference.mean(axis=0)[largest])
    assert length == pytest.approx(1.0, abs=0.15)
    assert np.abs(np.linalg.norm(found.difference.mean(axis=0), axis=1)).mean() < 0.3


def test_rarely_observed_vertices_leave_a_model_with_their_partners(closed: SymmetricMesh) -> None:
    rng, count = np.random.default_rng(0), len(closed.mesh.vertices)
    missing = np.zeros(count, dtype=np.bool_)
    missing[-20:] = True
    shapes = closed.mesh.vertices + 0.1 * rng.standard_normal((4, count, 3))
    model = ShapeModel.fit([Mesh(x, closed.mesh.faces, observed=~missing) for x in shapes])
    assert model.n_vertices == count - 40
    assert pairs_of_triangles(faces_of(model.mesh()), model.n_vertices) is not None
