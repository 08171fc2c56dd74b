import numpy as np
import pytest
from scipy.spatial import Delaunay

from shapespace.errors import MeshError
from shapespace.geometry.flatten import cylinder_map, disc_map, folded_triangles
from shapespace.geometry.normals import face_areas
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import similarity, sphere


def sheet(count: int = 900, seed: int = 0) -> Mesh:
    """A flat sheet of scattered points, counter-clockwise seen from +z."""
    rng = np.random.default_rng(seed)
    points = rng.random((count, 2)) * [100.0, 140.0]
    faces = Delaunay(points).simplices
    p, q = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    turned = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] < 0
    faces[turned] = faces[turned][:, ::-1]
    return Mesh(np.column_stack([points, np.zeros(count)]), faces.astype(np.int32), name="sheet")


def pocketed() -> Mesh:
    """The sheet with a pocket 200 mm deep and 30 mm wide, wider inside than at its mouth, and two holes."""
    flat = sheet()
    x = np.array(flat.vertices)
    r = np.linalg.norm(x[:, :2] - [50.0, 90.0], axis=1)
    inside = np.clip(1 - r / 25.0, 0, 1)
    x[:, 2] -= 200.0 * inside
    x[:, :2] += (x[:, :2] - [50.0, 90.0]) * np.where(r < 25, 1.5 * inside, 0.0)[:, None]
    return cut(flat.with_vertices(x), [(25.0, 40.0, 10.0), (75.0, 40.0, 10.0)])


def cut(mesh: Mesh, holes: list[tuple[float, float, float]]) -> Mesh:
    keep = np.ones(len(mesh.vertices), dtype=bool)
    for x, y, radius in holes:
        keep &= np.linalg.norm(mesh.vertices[:, :2] - [x, y], axis=1) > radius
    return used(mesh.vertices, mesh.faces[keep[mesh.faces].all(axis=1)])


def used(vertices: FloatArray, faces: np.ndarray) -> Mesh:
    index, faces = np.unique(faces, return_inverse=True)
    return Mesh(vertices[index], faces.reshape(-1, 3).astype(np.int32), name="surface")


def covered_twice(uv: FloatArray, faces: np.ndarray) -> int:
    """Return at how many middles of triangles another triangle lies too, by brute force."""
    middles = uv[faces].mean(axis=1)
    count = 0
    for f, at in enumerate(middles):
        a, b, c = (uv[faces[:, k]] - at for k in range(3))
        turns = [p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))]
        inside = (np.min(turns, axis=0) > 0) | (np.max(turns, axis=0) < 0)
        inside[f] = False
        count += bool(inside.any())
    return count


@pytest.mark.parametrize("mesh", [sheet(), pocketed()], ids=["sheet", "pocket and holes"])
def test_a_surface_with_pockets_and_holes_is_spread_out_without_overlap(mesh: Mesh) -> None:
    uv = disc_map(mesh)
    assert uv.shape == (len(mesh.vertices), 2)
    assert 0 <= uv.min() <= uv.max() <= 1
    assert not folded_triangles(uv, mesh.faces).any()
    assert covered_twice(uv, mesh.faces) == 0


def test_the_counter_of_overlaps_sees_the_pocket_from_above() -> None:
    mesh = pocketed()
    from_above = mesh.vertices[:, :2]
    folded = folded_triangles(from_above, mesh.faces)
    assert folded.sum() > 20
    assert covered_twice(from_above, mesh.faces) > folded.sum()


def test_a_deep_pocket_gets_room_half_by_its_area_and_half_by_its_triangles() -> None:
    mesh = pocketed()
    uv = disc_map(mesh)
    p, q = (uv[mesh.faces[:, k]] - uv[mesh.faces[:, 0]] for k in (1, 2))
    room = np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    wanted = np.sqrt(face_areas(mesh))
    deep = mesh.vertices[mesh.faces].mean(axis=1)[:, 2] < -20
    assert deep.sum() > 30
    share, wanted_share = room[deep].sum() / room.sum(), wanted[deep].sum() / wanted.sum()
    assert 0.5 < share / wanted_share < 2.0
    # Averages of neighbours alone squeeze it.
    plain = disc_map(mesh, most_rounds=1)
    p, q = (plain[mesh.faces[:, k]] - plain[mesh.faces[:, 0]] for k in (1, 2))
    squeezed = np.abs(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    assert squeezed[deep].sum() / squeezed.sum() < 0.7 * share


def test_the_map_does_not_depend_on_pose_scale_or_unit() -> None:
    mesh = pocketed()
    moved = mesh.with_vertices(similarity(3, 140.0, 0.01, 5.0).apply(mesh.vertices))
    a, b = disc_map(mesh), disc_map(moved)
    # The axes of a surface have no signs, so the square may be turned by half a turn.
    assert min(np.abs(a - b).max(), np.abs(a - (1 - b)).max()) < 1e-6


def bowtie() -> Mesh:
    return Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0.0]]), np.array([[0, 1, 2], [0, 3, 4]]))


def ribbon(twisted: bool) -> Mesh:
    """A closed band; twisted it is a Moebius band."""
    n = 20
    vertices = np.array(
        [[np.cos(t), np.sin(t), z] for t in np.linspace(0, 2 * np.pi, n, endpoint=False) for z in (0, 1)]
    )
    faces = []
    for i in range(n):
        a, b = 2 * i, 2 * i + 1
        c, d = (2 * i + 2) % (2 * n), (2 * i + 3) % (2 * n)
        if twisted and i == n - 1:
            c, d = d, c
        faces += [[a, c, b], [b, c, d]]
    return Mesh(vertices, np.array(faces, dtype=np.int32), name="band")


def torus_with_a_hole() -> Mesh:
    n = 12
    t = np.linspace(0, 2 * np.pi, n, endpoint=False)
    u, v = (x.ravel() for x in np.meshgrid(t, t, indexing="ij"))
    vertices = np.column_stack([(3 + np.cos(v)) * np.cos(u), (3 + np.cos(v)) * np.sin(u), np.sin(v)])
    faces = []
    for i in range(n):
        for j in range(n):
            a, b = n * i + j, n * ((i + 1) % n) + j
            c, d = n * i + (j + 1) % n, n * ((i + 1) % n) + (j + 1) % n
            faces += [[a, b, c], [b, d, c]]
    return used(vertices, np.array(faces[2:], dtype=np.int32))


@pytest.mark.parametrize(
    ("mesh", "why"),
    [
        (Mesh(*sphere(100)), "closed"),
        (Mesh(sphere(100)[0]), "has no faces"),
        (Mesh(np.concatenate([sheet(50).vertices, [[0, 0, 0]]]), sheet(50).faces), "belong to no triangle"),
        (
            Mesh(
                np.concatenate([sheet(50).vertices, sheet(50).vertices + 500]),
                np.concatenate([sheet(50).faces, sheet(50).faces + 50]),
            ),
            "in 2 pieces",
        ),
        (Mesh(sheet(50).vertices, np.concatenate([sheet(50).faces, sheet(50).faces[:1]])), "more than two"),
        (Mesh(sheet(50).vertices, np.concatenate([sheet(50).faces[:1, ::-1], sheet(50).faces[1:]])), "opposite"),
        (bowtie(), "touch each other at a vertex"),
        (ribbon(twisted=True), "opposite"),
        (torus_with_a_hole(), "handles"),
        (sheet(50).with_vertices(sheet(50).vertices * [1, 1, np.nan]), "not finite"),
    ],
)  # fmt: skip
def test_what_is_no_disc_is_refused_in_one_sentence(mesh: Mesh, why: str) -> None:
    with pytest.raises(MeshError, match=why) as error:
        disc_map(mesh)
    assert str(error.value).count(". ") == 0


def test_a_band_is_a_disc_with_a_hole_and_one_triangle_is_a_disc() -> None:
    band = ribbon(twisted=False)
    assert not folded_triangles(disc_map(band), band.faces).any()
    triangle = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1.0, 0]]), np.array([[0, 1, 2]]))
    assert disc_map(triangle).shape == (3, 2)


def test_a_cylinder_is_unrolled_and_a_pocket_overlaps_on_it() -> None:
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-1.0, 1.0, 800), rng.uniform(0.0, 50.0, 800)
    faces = Delaunay(np.column_stack([angle, height / 40])).simplices
    x = np.column_stack([7 + 40 * np.sin(angle), height, 40 * np.cos(angle) - 3])
    uv = cylinder_map(Mesh(x, faces.astype(np.int32)))
    shares = np.column_stack([(angle - angle.min()) / np.ptp(angle), (height - height.min()) / np.ptp(height)])
    assert min(np.abs(uv - shares).max(), np.abs(uv - np.column_stack([1 - shares[:, 0], shares[:, 1]])).max()) < 1e-9
    assert not folded_triangles(uv, faces).any()
    pushed = np.where((np.abs(angle) < 0.3) & (np.abs(height - 25) < 10), -0.5, 0.0)
    folded = cylinder_map(
        Mesh(x + np.column_stack([0 * angle, pushed * (25 - height) * -3, 0 * angle]), faces.astype(np.int32))
    )
    assert folded_triangles(folded, faces).any()
