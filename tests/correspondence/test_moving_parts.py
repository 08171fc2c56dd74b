"""Objects whose parts move: limbs are followed along the surface, and scans of a subject follow each other."""

from dataclasses import replace

import numpy as np
import pytest

from shapespace.correspondence.groupwise import correspond, subject_levels
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.isometry import IntrinsicShape, bent_shapes, common_symmetries
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.template import resample
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import edge_stretch, faces_of
from shapespace.types import FloatArray, Mesh

ARMS = np.array([[1.0, 0, 0], [-0.5, 0.7, 0.2], [-0.3, -0.8, 0.5], [0.1, 0.2, -1.0]])
LENGTHS = (1.0, 0.8, 1.3, 0.6)


def star() -> Mesh:
    """Return a body with four arms of different lengths, which is not its own mirror image."""
    from scipy.spatial import ConvexHull

    golden = np.arange(1000) + 0.5
    height, turn = 1 - 2 * golden / 1000, np.pi * (1 + 5**0.5) * golden
    around = np.sqrt(1 - height**2)
    directions = np.stack([around * np.cos(turn), around * np.sin(turn), height], axis=1)
    faces = ConvexHull(directions).simplices
    a, b, c = (directions[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    arms = ARMS / np.linalg.norm(ARMS, axis=1, keepdims=True)
    radius = 0.4 + np.exp((directions @ arms.T - 1) / 0.03) @ np.array(LENGTHS)
    return Mesh(100 * radius[:, None] * directions, faces.astype(np.int32), name="star")


def bent(mesh: Mesh) -> FloatArray:
    """Return the vertices with the longest arm turned by 70 degrees about its root."""
    arm = ARMS[2] / np.linalg.norm(ARMS[2])
    x = np.array(mesh.vertices)
    height = x @ arm
    share = np.clip((height - 50) / 30, 0, 1)[:, None]
    side = np.cross(arm, [0.0, 0, 1])
    side /= np.linalg.norm(side)
    angle = np.radians(70) * share[:, 0]
    root, c, s = 50 * arm, np.cos(angle)[:, None], np.sin(angle)[:, None]
    v = x - root
    turned = v * c + np.cross(side, v) * s + (v @ side)[:, None] * side * (1 - c)
    return root + turned


@pytest.fixture(scope="module")
def template() -> Mesh:
    return resample(star(), 900)


def test_a_limb_is_followed_along_the_surface(template: Mesh) -> None:
    truth = bent(template)
    scan = resample(Mesh(truth, template.faces, name="scan"), 1000)
    shapes = bent_shapes(IntrinsicShape.of(template, Harmonics.of(template, 100)), IntrinsicShape.of_scan(scan), 0)
    moved = np.linalg.norm(truth - template.vertices, axis=1).max()
    errors = [np.linalg.norm(shape - truth, axis=1).mean() for shape in shapes]
    assert moved > 100
    assert min(errors) < 0.05 * moved


def test_a_map_does_not_turn_the_surface_inside_out(template: Mesh) -> None:
    scan = IntrinsicShape.of_scan(mirror_image(Mesh(bent(template), template.faces, name="scan")))
    shapes = bent_shapes(IntrinsicShape.of(template, Harmonics.of(template, 100)), scan, 0)
    assert all(volume(shape, template) > 0 for shape in shapes)
    assert volume(mirror_image(template).vertices, template) < 0


def volume(vertices: FloatArray, template: Mesh) -> float:
    a, b, c = (vertices[faces_of(template)[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum()) / 6


def test_a_rigid_motion_stretches_no_edge(template: Mesh) -> None:
    turned = 3 * template.vertices[:, [1, 2, 0]] + 5
    assert edge_stretch(turned, template) < 1e-9
    assert edge_stretch(template.vertices * [1, 1, 2.0], template) > 0.1


def test_two_extremities_leave_the_map_open(template: Mesh) -> None:
    shape = IntrinsicShape.of(template, Harmonics.of(template, 100))
    assert bent_shapes(shape, shape, 0)
    assert not bent_shapes(replace(shape, ends=shape.ends[:2]), shape, 0)


def test_extreme_shapes_of_a_subject_follow_through_intermediate_ones() -> None:
    along = np.array([0.0, 1.0, 3.0, 0.2, 2.0])
    shapes = along[:, None, None] * np.ones((5, 4, 3))
    levels = subject_levels(shapes, np.zeros((4, 3)), ["a", "a", "a", "b", "a"])
    assert levels == [[(1, 0)], [(4, 1)], [(2, 4)]]


def test_a_limb_that_moved_comes_into_correspondence(template: Mesh) -> None:
    scans = [Mesh(template.vertices, template.faces, name="rest")]
    scans += [resample(Mesh(bent(template), template.faces, name=name), 800) for name in ("one", "two")]
    made = correspond(scans, CorrespondConfig(rounds=1, mirror="never"), template=replace(template, name="template"))
    for scan in made.scans[1:]:
        assert scan.vertices is not None
        assert np.linalg.norm(scan.vertices - bent(template), axis=1).mean() < 6


def test_each_scan_needs_a_subject(template: Mesh) -> None:
    with pytest.raises(InputError, match="1 subjects for 2 scans"):
        correspond([template, Mesh(bent(template), template.faces)], subjects=["a"])


def test_the_symmetries_that_most_scans_have_are_found_once() -> None:
    corners = np.array([[x, y, z] for x in (-2.0, 2.0) for y in (-1.5, 1.5) for z in (-1.0, 1.0)])
    box = Mesh(corners, np.array([[0, 1, 2]]))

    def exchanged(*signs: float) -> list[int]:
        return [int(np.flatnonzero((corners == corner * signs).all(axis=1))[0]) for corner in corners]

    x, y, both = exchanged(-1, 1, 1), exchanged(1, -1, 1), exchanged(-1, -1, 1)
    maps = [np.array(rows, np.int32) for rows in ([both, x], [x, y], [y, x], [list(range(8))])]
    found = common_symmetries(maps, box)
    assert found is not None
    assert found.tolist() == [x, y, both]
    assert common_symmetries(maps[3:], box) is None
