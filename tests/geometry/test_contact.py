"""Penetration of neighbouring parts."""

import numpy as np
import pytest

from shapespace.geometry.contact import find_penetrations
from shapespace.types import Mesh

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) * 10
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                  [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]], dtype=np.int32)  # fmt: skip
PARTS = {"a": np.arange(8, dtype=np.int32), "b": np.arange(8, 16, dtype=np.int32)}


def two_cubes(offset: float, faces: np.ndarray = FACES) -> Mesh:
    return Mesh(np.concatenate([CUBE, CUBE + offset]), np.concatenate([FACES, faces + 8]).astype(np.int32))


def test_a_corner_inside_the_other_part_is_found_with_its_depth() -> None:
    mesh = two_cubes(7.0)
    found = find_penetrations(mesh, PARTS)
    assert [(one.part, one.other) for one in found] in ([("a", "b"), ("b", "a")], [("b", "a"), ("a", "b")])
    assert all(one.share == 1 / 8 and one.depth_mm == pytest.approx(3.0, abs=1e-6) for one in found)


def test_parts_side_by_side_and_open_parts_do_not_penetrate() -> None:
    assert find_penetrations(two_cubes(11.0), PARTS) == []
    found = find_penetrations(two_cubes(7.0, FACES[1:]), PARTS)
    assert [(one.part, one.other) for one in found] == [("b", "a")]
