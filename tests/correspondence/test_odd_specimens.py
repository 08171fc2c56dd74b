"""Odd scans before a correspondence: units, sizes and shapes that differ, and natural variation that does not."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.correspondence.odd_scans import (
    ScanMeasures,
    _medians_of_others,
    find_mirrored_scans,
    find_odd_scans,
    side_sample,
)
from shapespace.datasets.bones import Bone
from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.types import MM_PER_UNIT, Mesh
from synthetic_shapes import twisted

COUNT = 12


def bone(rng: np.random.Generator) -> Mesh:
    return raw_surface(Bone.draw(rng), rng, 800)


def organ(rng: np.random.Generator) -> Mesh:
    return raw_surface(Organ.draw(rng), rng, 800)


def face(rng: np.random.Generator) -> Mesh:
    faces = load_faces()
    return faces.face(faces.draw_person(rng))


@cache
def measured(kind: Callable[[np.random.Generator], Mesh], count: int = COUNT) -> tuple[ScanMeasures, ...]:
    return tuple(ScanMeasures.of(kind(np.random.default_rng(k))) for k in range(count))


def scaled(measures: ScanMeasures, factor: float) -> ScanMeasures:
    return replace(measures, size=factor * measures.size)


def mm(count: int = COUNT) -> list[str]:
    return ["mm"] * count


KINDS = pytest.mark.parametrize("kind", [bone, organ, face])


@KINDS
def test_scans_of_one_kind_are_not_odd(kind: Callable[[np.random.Generator], Mesh]) -> None:
    assert find_odd_scans(measured(kind), mm()) == {}


@KINDS
@pytest.mark.parametrize("unit", ["um", "cm", "inch", "m"])
def test_a_copy_in_another_unit_is_named_with_its_unit(kind: Callable[[np.random.Generator], Mesh], unit: str) -> None:
    own = list(measured(kind))
    factor = 1 / MM_PER_UNIT[unit]
    own[3] = scaled(own[3], factor)
    odd = find_odd_scans(own, mm())
    others = np.median([one.size for k, one in enumerate(own) if k != 3])
    assert list(odd) == [3] and odd[3].unit == unit
    assert odd[3].factor == pytest.approx(own[3].size / others)
    assert f"in {unit} it would have their size." in odd[3].text
    assert find_odd_scans(own, ["mm"] * 3 + [unit] + ["mm"] * (COUNT - 4)) == {}


@KINDS
def test_a_natural_difference_of_size_is_no_unit(kind: Callable[[np.random.Generator], Mesh]) -> None:
    own = list(measured(kind))
    odd = find_odd_scans([scaled(own[0], 1 / 3.1), *own[1:]], mm())
    assert odd[0].unit == "" and "times smaller than the median of the others." in odd[0].text
    assert list(odd) == [0]
    # Sizes that vary from 1 to 9 in all steps, as of species.
    assert find_odd_scans([scaled(one, 9 ** (k / (COUNT - 1))) for k, one in enumerate(own)], mm()) == {}
    # Several juveniles.
    juveniles = find_odd_scans([scaled(one, 1 / 3.1 if k < 3 else 1.0) for k, one in enumerate(own)], mm())
    assert all(one.unit == "" for one in juveniles.values())


def test_two_scans_of_another_kind_are_named() -> None:
    long = Mesh(measured_mesh().vertices * [1.0, 1.0, 6.0], measured_mesh().faces)
    own = [*measured(organ)[: COUNT - 2], ScanMeasures.of(long), scaled(ScanMeasures.of(long), 1.1)]
    odd = find_odd_scans(own, mm())
    assert sorted(odd) == [COUNT - 2, COUNT - 1]
    assert all(one.shape_ratio > 6 and one.unit == "" for one in odd.values())
    assert "times as much as usual: look whether it is another kind of object" in odd[COUNT - 1].text


def measured_mesh() -> Mesh:
    return organ(np.random.default_rng(77))


def test_measures_depend_on_neither_pose_nor_unit_nor_triangles() -> None:
    rng = np.random.default_rng(5)
    points, faces = sphere_like(rng)
    turn = Rotation.random(random_state=1).as_matrix()
    first = ScanMeasures.of(Mesh(points, faces))
    moved = ScanMeasures.of(Mesh(25.4 * points @ turn.T + 100.0, faces))
    assert moved.size == pytest.approx(25.4 * first.size)
    assert np.allclose(moved.profile, first.profile)
    cloud = ScanMeasures.of(Mesh(points, None))
    assert cloud.size == pytest.approx(first.size, rel=0.2)


def sphere_like(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    mesh = organ(rng)
    assert mesh.faces is not None
    return mesh.vertices, mesh.faces


def test_few_or_equal_scans_are_not_compared() -> None:
    own = measured(bone)
    assert find_odd_scans([own[0], own[1], scaled(own[2], 0.1)], mm(3)) == {}
    assert find_odd_scans([], []) == {}
    assert find_odd_scans([own[0]] * COUNT, mm()) == {}
    half = find_odd_scans([scaled(one, 0.1 if k % 2 else 1.0) for k, one in enumerate(own)], mm())
    assert sorted(half) == list(range(1, COUNT, 2)) and {one.unit for one in half.values()} == {"cm"}


def test_the_median_of_the_others_is_that_without_the_row() -> None:
    rng = np.random.default_rng(0)
    for count in (2, 3, 4, 7, 10):
        values = rng.integers(0, 5, (count, 6)).astype(np.float64)  # with equal numbers
        wanted = [np.median(np.delete(values, k, axis=0), axis=0) for k in range(count)]
        assert np.array_equal(_medians_of_others(values), wanted)


def screw(rng: np.random.Generator) -> Mesh:
    """Return a twisted organ, which has a side, in any pose and size."""
    mesh = twisted(organ(rng))
    return mesh.with_vertices(Rotation.random(random_state=rng).apply(mesh.vertices.copy()) * rng.uniform(0.5, 2.0))


def sampled(kind: Callable[[np.random.Generator], Mesh], mirrored: tuple[int, ...], count: int = COUNT) -> list[int]:
    meshes = [kind(np.random.default_rng(k)) for k in range(count)]
    return find_mirrored_scans([side_sample(mirror_image(m) if k in mirrored else m) for k, m in enumerate(meshes)])


@pytest.mark.parametrize("mirrored", [(), (2, 7, 9), (0, 6)])
def test_mirror_images_of_most_are_named_in_any_pose_and_size(mirrored: tuple[int, ...]) -> None:
    assert sampled(screw, mirrored) == list(mirrored)
    assert sampled(screw, tuple(set(range(COUNT)) - set(mirrored))) == list(mirrored)


@pytest.mark.parametrize("kind", [bone, organ, face])
def test_no_side_is_found_of_symmetric_objects_or_few_scans(kind: Callable[[np.random.Generator], Mesh]) -> None:
    assert sampled(kind, (2, 7, 9)) == [] == sampled(screw, (2,), count=9)
