"""Grooming: what remains is exactly the part that was asked for, no vertex moves, and filled holes are closed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapespace.errors import InputError, MeshError
from shapespace.geometry.doctor import examine
from shapespace.geometry.grooming import Crop, Grooming, closed_borders, counts_of_pieces, fill_holes
from shapespace.geometry.normals import enclosed_volume, face_areas, faces_of
from shapespace.geometry.remesh import is_sheet
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

POINTS, FACES = sphere(642)


def ball(radius: float = 1.0, centre: float = 0.0) -> Mesh:
    return Mesh(radius * POINTS + [centre, 0.0, 0.0], FACES, name="ball.ply")


def together(*parts: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = np.concatenate([faces_of(part) + start for part, start in zip(parts, starts, strict=False)])
    return Mesh(np.concatenate([part.vertices for part in parts]), faces.astype(np.int32), name="parts.ply")


def rows(points: FloatArray) -> set[tuple[float, ...]]:
    return {tuple(point) for point in points.tolist()}


def triangles(mesh: Mesh) -> set[frozenset[tuple[float, ...]]]:
    return {frozenset(map(tuple, corners)) for corners in mesh.vertices[faces_of(mesh)].tolist()}


def test_the_largest_of_two_balls_is_kept_as_it_is() -> None:
    large = ball(2.0, 5.0)
    both = together(ball(), large)
    groomed, findings = Grooming(largest=True).apply(both)
    assert triangles(groomed) == triangles(large) and rows(groomed.vertices) == rows(large.vertices)
    assert findings[0].problem == "It has 2 separate pieces." and "80.0 % of the area" in findings[0].action


def test_the_largest_piece_has_the_largest_area_not_the_most_triangles() -> None:
    points, faces = sphere(42)
    large = Mesh(9.0 * points, faces)
    assert triangles(Grooming(largest=True).apply(together(ball(centre=30.0), large))[0]) == triangles(large)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["sphere", "outside", "box", "plane"]))
def test_a_crop_keeps_exactly_the_triangles_inside(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    mesh = together(ball(), ball(0.7, 2.5))
    centre = mesh.vertices[rng.integers(len(mesh.vertices))]
    numbers = {
        "sphere": [*centre, rng.uniform(0.5, 2.0)],
        "outside": [*centre, rng.uniform(0.1, 5.0)], "box": [*(centre - 0.7), *(centre + rng.uniform(0.5, 2.0, 3))],
        "plane": [*(0.5 * centre), *rng.normal(size=3)],
    }[kind]  # fmt: skip
    crop = Crop(kind, tuple(map(float, numbers)))
    n = np.array(numbers)

    def is_inside(p: FloatArray) -> bool:
        if kind in ("sphere", "outside"):
            return (float(np.sqrt(((p - n[:3]) ** 2).sum())) <= n[3]) == (kind == "sphere")
        if kind == "box":
            return all(n[k] <= p[k] <= n[k + 3] for k in range(3))
        return sum((p[k] - n[k]) * n[k + 3] for k in range(3)) >= 0

    wanted = {
        frozenset(map(tuple, mesh.vertices[face].tolist()))
        for face in faces_of(mesh)
        if all(is_inside(mesh.vertices[v]) for v in face)
    }
    text = f"{kind}:{','.join(repr(float(number)) for number in numbers)}"
    assert Crop.of(text) == crop
    if wanted:
        assert triangles(Grooming(crop=(text,)).apply(mesh)[0]) == wanted
    else:
        with pytest.raises(MeshError, match="leaves"):
            Grooming(crop=(text,)).apply(mesh)


def test_two_halves_of_a_plane_have_all_triangles_but_those_across_it() -> None:
    mesh = ball()
    above, below = (triangles(Grooming(crop=(f"plane:0,0,0.1,0,0,{side}",)).apply(mesh)[0]) for side in (1, -1))
    across = mesh.vertices[faces_of(mesh)][:, :, 2] - 0.1
    assert not above & below
    assert len(above) + len(below) == len(mesh.faces) - int(((across.min(axis=1) < 0) & (across.max(axis=1) > 0)).sum())


def with_holes(rng: np.random.Generator) -> Mesh:
    """Return a bumpy ball without the triangles around some vertices."""
    mesh = ball(50.0)
    bumpy = mesh.vertices * rng.uniform(0.9, 1.1, (len(mesh.vertices), 1))
    holes = bumpy[rng.integers(len(bumpy), size=rng.integers(1, 6))]
    far = np.linalg.norm(bumpy[:, None] - holes, axis=2) > rng.uniform(5.0, 25.0, len(holes))
    kept = far.all(axis=1)[faces_of(mesh)].all(axis=1)
    return Grooming(largest=True).apply(Mesh(bumpy, faces_of(mesh)[kept], name="holes.ply"))[0]


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_filled_holes_close_the_surface_and_move_no_vertex(seed: int) -> None:
    mesh = with_holes(np.random.default_rng(seed))
    filled, count, left = fill_holes(mesh, 1000)
    assert left == 0 and count == len(closed_borders(faces_of(mesh)))
    assert np.array_equal(filled.vertices, mesh.vertices)
    assert np.array_equal(faces_of(filled)[: len(faces_of(mesh))], faces_of(mesh))
    assert is_sheet(faces_of(filled))
    report = examine(filled)
    assert (report.boundary_edges, report.non_manifold_edges, report.degenerate_triangles) == (0, 0, 0)
    assert report.reversed_triangles == 0 and enclosed_volume(filled.vertices, faces_of(filled)) > 0


def test_a_flat_hole_of_any_outline_is_filled_without_folds() -> None:
    """A C-shaped hole in a plate: the filled plate has exactly the area of the plate."""
    n = 31
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    plate = np.column_stack([i.ravel(), j.ravel(), np.zeros(i.size)]).astype(np.float64)
    corner = (i * n + j)[:-1, :-1].ravel()
    squares = np.stack([corner, corner + n, corner + n + 1, corner, corner + n + 1, corner + 1], axis=1)
    x, y = np.divmod(np.arange((n - 1) ** 2), n - 1) - np.array([[15], [15]])
    ring = (np.hypot(x, y) < 7) & ~((np.hypot(x, y) < 4) | ((x > 0) & (abs(y) < 2)))
    holed = Mesh(plate, squares[~ring].reshape(-1, 3).astype(np.int32), name="plate.ply")
    filled, count, left = fill_holes(holed, 4 * (n - 1) - 1)
    assert count == 1 and left == 4 * (n - 1)  # the rim of the plate has more edges
    assert face_areas(filled).sum() == pytest.approx((n - 1) ** 2)
    a, b, c = np.moveaxis(filled.vertices[faces_of(filled)], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_only_holes_with_few_edges_are_filled() -> None:
    mesh = ball(50.0)
    small, large = mesh.vertices[0], -mesh.vertices[0]
    far = (np.linalg.norm(mesh.vertices - small, axis=1) > 1) & (np.linalg.norm(mesh.vertices - large, axis=1) > 20)
    holed = Mesh(mesh.vertices, faces_of(mesh)[far[faces_of(mesh)].all(axis=1)], name="holes.ply")
    sizes = sorted(map(len, closed_borders(faces_of(holed))))
    filled, count, left = fill_holes(holed, sizes[0])
    assert len(sizes) == 2 and count == 1 and left == sizes[1]
    assert len(faces_of(filled)) == len(faces_of(holed)) + sizes[0] - 2


@pytest.mark.parametrize(("grooming", "message"), [
    ({"crop": ("sphere:1,2,3",)}, "There is no crop 'sphere:1,2,3'"),
    ({"crop": ("plane:0,0,0,0,0,0",)}, "normal that is not zero"),
    ({"crop": ("landmarks:30",)}, "needs the landmarks of a fit"),
    ({"fill_holes": 2}, "from 3 to 500"),
    ({"fill_holes": 10**9}, "from 3 to 500"),
])  # fmt: skip
def test_settings_that_cannot_be_are_rejected(grooming: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Grooming(**grooming)


@pytest.mark.parametrize(("crop", "message"), [
    ("sphere:99,0,0,5", "ball.ply: the crop sphere:99,0,0,5 leaves 0 of its 642 vertices, which lie between"),
    ("sphere:1,0,0,0.01", "ball.ply: the crop sphere:1,0,0,0.01 leaves no triangle"),
])  # fmt: skip
def test_a_crop_that_misses_the_mesh_is_rejected(crop: str, message: str) -> None:
    mesh = ball()
    moved = Mesh(mesh.vertices + np.array([1.0, 0.0, 0.0]) - mesh.vertices[0], faces_of(mesh), name="ball.ply")
    with pytest.raises(MeshError, match=message):
        Grooming(crop=(crop,)).apply(moved)


def test_a_point_cloud_can_be_cropped_but_has_no_pieces() -> None:
    cloud = Mesh(ball().vertices, None, name="cloud.ply")
    half, _ = Grooming(crop=("plane:0,0,0,0,0,1",)).apply(cloud)
    assert rows(half.vertices) == {row for row in rows(cloud.vertices) if row[2] >= 0}
    for grooming in (Grooming(largest=True), Grooming(fill_holes=9), Grooming(outer=True)):
        with pytest.raises(MeshError, match=r"cloud\.ply has no faces"):
            grooming.apply(cloud)


def test_pieces_of_a_surface_are_named_in_the_order_of_their_vertices() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 3], [4, 5, 6]], dtype=np.int32)
    assert counts_of_pieces(faces, 7, ["femur", "tibia"]) == {"femur": 4, "tibia": 3}
    for names in (["femur"], ["femur", "femur"], ["femur", "tibia", "patella"]):
        with pytest.raises(InputError, match=r"2 separate pieces, .* in runs of 4, 3"):
            counts_of_pieces(faces, 7, names)
    with pytest.raises(InputError, match="in runs of 3, 3, 1"):
        counts_of_pieces(np.array([[0, 1, 2], [3, 4, 5], [2, 1, 6]], dtype=np.int32), 7, ["femur", "tibia"])
