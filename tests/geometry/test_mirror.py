"""Mirror planes: found in any pose, also where a part is missing on one side; pairs by the order of triangles."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.geometry.mirror_plane import find_mirror, mirror_pairs, pairs_of_triangles, reflect
from shapespace.geometry.normals import part_of
from shapespace.types import Mesh
from symmetric_object import Symmetric, symmetric_object


@pytest.fixture(scope="module")
def thing() -> Symmetric:
    return symmetric_object()


def ordered(thing: Symmetric) -> tuple[np.ndarray, np.ndarray]:
    """Return triangles of the object, those of one side first, then their mirror images in the same order."""
    # Triangles across the plane are their own images there, and are left out.
    one_side = thing.faces[(thing.x[thing.faces][:, :, 0] >= 0).all(axis=1)]
    return np.concatenate([one_side, thing.other[one_side[:, ::-1]]]), one_side


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_plane_is_found_in_any_pose_and_unit(thing: Symmetric, scale: float) -> None:
    turn, shift = Rotation.random(random_state=4).as_matrix(), np.array([300.0, -20.0, 7.0])
    found = find_mirror(Mesh(scale * (thing.x @ turn.T + shift), thing.faces))
    assert abs(found.normal @ turn[:, 0]) == pytest.approx(1.0, abs=1e-10)
    assert found.offset == pytest.approx(scale * float(found.normal @ shift), rel=1e-5)
    assert found.off_share < 1e-5
    assert np.allclose(found.image, reflect(np.asarray(scale * (thing.x @ turn.T + shift)), found.normal, found.offset))


def test_a_part_that_is_missing_on_one_side_does_not_move_the_plane() -> None:
    fine = symmetric_object(half=600, ring=44)
    centre = np.argmax(fine.x @ [1.0, 0.3, 0.3])
    hole = np.linalg.norm(fine.x - fine.x[centre], axis=1) < 30.0
    assert 0.05 < hole.mean() < 0.2
    found = find_mirror(part_of(Mesh(fine.x, fine.faces), ~hole))
    assert np.degrees(np.arccos(min(1.0, abs(found.normal[0])))) < 0.1
    assert abs(found.offset) < 0.1
    assert found.off_share < 0.005


def test_the_order_of_triangles_defines_the_pairs(thing: Symmetric) -> None:
    faces, one_side = ordered(thing)
    used = np.unique(faces)
    for same in (faces, faces[:, ::-1]):
        pairs = pairs_of_triangles(same, len(thing.x))
        assert pairs is not None
        assert np.array_equal(pairs[used], thing.other[used])
    assert pairs_of_triangles(np.random.default_rng(0).permutation(faces), len(thing.x)) is None
    assert pairs_of_triangles(faces[1:], len(thing.x)) is None
    double_sided = np.concatenate([one_side, one_side[:, ::-1]])
    assert pairs_of_triangles(double_sided, len(thing.x)) is None


def test_pairs_of_the_order_hold_where_the_surface_itself_is_asymmetric(thing: Symmetric) -> None:
    faces, _ = ordered(thing)
    bent = thing.x + 8.0 * thing.smooth(np.random.default_rng(1), 1)[0]
    mesh = Mesh(bent, faces)
    mirror = find_mirror(mesh)
    assert mirror.off_share > 0.02
    used = np.unique(faces)
    pairs = mirror_pairs(mesh, mirror)
    assert pairs is not None
    assert np.array_equal(pairs[used], thing.other[used])


def test_the_plane_of_pairs_is_the_one_that_brings_partners_closest(thing: Symmetric) -> None:
    faces, _ = ordered(thing)
    bent = thing.x + 8.0 * thing.smooth(np.random.default_rng(2), 1)[0]
    mirror = find_mirror(Mesh(bent, faces))
    assert mirror.pairs is not None

    def off(normal: np.ndarray, offset: float) -> float:
        return float(((reflect(bent, normal / np.linalg.norm(normal), offset) - bent[mirror.pairs]) ** 2).sum())

    best = off(mirror.normal, mirror.offset)
    for step in 0.01 * np.eye(3):
        assert off(mirror.normal + step, mirror.offset) > best
        assert off(mirror.normal - step, mirror.offset) > best
    assert off(mirror.normal, mirror.offset + 0.1) > best
    assert np.allclose(mirror.turn @ mirror.normal, -mirror.normal)
