"""The outer surface of scans with inner walls: what is visible from outside stays, and the rest goes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from raw_blobs import raw_blob
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.template import choose_template
from shapespace.geometry.normals import faces_of
from shapespace.geometry.outer_surface import hidden_share, outer_surface
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

AROUND = 60
"""Vertices around the axis of a surface of revolution."""


def with_shell(scan: Mesh, ratio: float = 0.75) -> Mesh:
    """Return a closed scan with an inner wall, as a second piece."""
    centre, faces = scan.vertices.mean(axis=0), faces_of(scan)
    inner = centre + ratio * (scan.vertices - centre)
    both = np.vstack([faces, faces[:, ::-1] + len(inner)]).astype(np.int32)
    return Mesh(np.vstack([scan.vertices, inner]), both, scan.landmarks, scan.name)


def revolved(profile: FloatArray) -> tuple[Mesh, FloatArray]:
    """Return the surface of revolution of `profile` (N, 2), radius and height, and for each triangle its row."""
    angle = np.linspace(0, 2 * np.pi, AROUND, endpoint=False)
    ring = np.column_stack([np.cos(angle), np.sin(angle)])
    x = np.concatenate([np.column_stack([r * ring, np.full(AROUND, z)]) for r, z in profile])
    row, k = np.divmod(np.arange((len(profile) - 1) * AROUND), AROUND)
    a, b = row * AROUND + k, row * AROUND + (k + 1) % AROUND
    faces = np.vstack([np.column_stack([a, b, b + AROUND]), np.column_stack([a, b + AROUND, a + AROUND])])
    return Mesh(x, faces.astype(np.int32), name="revolved"), np.concatenate([row, row])


def arc(start: float, end: float, radius: float) -> FloatArray:
    """Return the profile of a sphere from one angle to another, in degrees from the north pole."""
    t = np.radians(np.linspace(start, end, 40))
    return radius * np.column_stack([np.sin(t), np.cos(t)])


def with_canal(*, cavity: bool) -> tuple[Mesh, FloatArray, int]:
    """Return a ball with a canal from the north to its centre, or to a cavity, in one piece.

    Also returns the row of each triangle, and the number of rows that are outside.
    """
    outer = arc(179.5, 8.0, 100.0)
    deep = 80.0 if cavity else 0.0
    canal = np.column_stack([np.full(30, outer[-1, 0]), np.linspace(outer[-1, 1], deep, 30)])[1:]
    inner = arc(np.degrees(np.arcsin(outer[-1, 0] / 80.0)), 179.5, 80.0) if cavity else np.array([[0.1, deep]])
    mesh, row = revolved(np.vstack([outer, canal, inner]))
    return mesh, row, len(outer) - 1


def test_an_inner_shell_goes_and_nothing_else() -> None:
    scan = raw_blob(0, points=1500).scan
    outer = outer_surface(with_shell(scan))
    np.testing.assert_array_equal(outer.vertices[faces_of(outer)], scan.vertices[faces_of(scan)])
    assert len(outer.vertices) == len(scan.vertices)
    assert 0.3 < hidden_share(with_shell(scan)) < 0.4 and hidden_share(scan) == 0.0


@pytest.mark.parametrize("cavity", [False, True])
def test_a_canal_and_what_is_seen_through_it_go_and_its_mouth_stays(cavity: bool) -> None:
    mesh, row, outside = with_canal(cavity=cavity)
    kept = {tuple(corners.ravel()) for corners in outer_surface(mesh).vertices[faces_of(outer_surface(mesh))]}
    is_kept = np.array([tuple(corners.ravel()) in kept for corners in mesh.vertices[faces_of(mesh)]])
    assert is_kept[row < outside].all()
    height = mesh.vertices[faces_of(mesh)].mean(axis=(1))[:, 2]
    radius = 100.0 * np.sin(np.radians(8.0))
    # Below three radii of the canal nothing is visible from more than 5 % of all directions.
    deep = (row >= outside) & (height < 99.0 - 3.0 * radius)
    assert deep.any() and not is_kept[deep].any()


def test_pose_size_and_the_order_of_triangles_do_not_matter() -> None:
    mesh, _, _ = with_canal(cavity=True)
    T = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
    moved = Mesh(1e-3 * mesh.vertices @ T.T + 5.0, faces_of(mesh)[::-1], name="moved")
    area = [hidden_share(one) for one in (mesh, moved)]
    assert area[0] > 0.3 and abs(area[0] - area[1]) < 0.01
    counts = [len(faces_of(outer_surface(one))) for one in (mesh, moved)]
    assert abs(counts[0] - counts[1]) < 0.03 * counts[0]


def test_triangles_without_common_vertices_are_treated_as_a_surface() -> None:
    scan = with_shell(raw_blob(1, points=1200).scan)
    corners = scan.vertices[faces_of(scan)].reshape(-1, 3)
    soup = Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3), name="soup")
    assert len(faces_of(outer_surface(soup))) == len(faces_of(outer_surface(scan)))


def test_open_sheets_points_and_broken_triangles_stay() -> None:
    directions, faces = sphere(1500)
    bowl = Mesh(100 * directions, faces[(directions[faces, 2] > -0.3).all(axis=1)], name="bowl")
    assert outer_surface(bowl) is bowl
    cloud = Mesh(directions, None, name="cloud")
    assert outer_surface(cloud) is cloud and hidden_share(cloud) == 0.0
    vertices = 100 * directions
    vertices[7] = np.nan
    broken = Mesh(vertices, faces, name="broken")
    assert outer_surface(broken) is broken


def test_a_scan_with_inner_surfaces_is_no_template_where_others_have_none() -> None:
    scans = [raw_blob(k, points=700).scan for k in range(4)]
    shelled = [with_shell(scan) if k != 2 else scan for k, scan in enumerate(scans)]
    assert choose_template(shelled, 0).index == 2
    everywhere = choose_template([with_shell(scan) for scan in scans], 0)
    assert np.isfinite(everywhere.nearness).all()


@pytest.mark.parametrize("at", [0, 3])
def test_another_object_without_inner_surfaces_is_no_template(at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.correspondence.template.MODES", 15)
    scans = [with_shell(raw_blob(k, points=700).scan) for k in range(3)]
    directions, faces = sphere(700)
    scans.insert(at, Mesh(0.1 * directions, faces, name="ball"))
    choice = choose_template(scans, 0)
    assert choice.index != at and np.nanargmax(choice.nearness) == at


@pytest.mark.long
def test_outer_registers_the_scans_without_their_shells() -> None:
    quick = ElasticSettings(harmonics=100, points=500, iterations=10)
    config = CorrespondConfig(vertices=300, rounds=1, first=quick, next=quick)
    scans = [raw_blob(k, points=700).scan for k in range(3)]
    plain = correspond(scans, config, template=scans[0])
    outer = correspond(
        [with_shell(scan) for scan in scans],
        CorrespondConfig(vertices=300, rounds=1, first=quick, next=quick, outer=True),
        template=scans[0],
    )
    for a, b in zip(plain.scans, outer.scans, strict=True):
        np.testing.assert_allclose(np.array(a.vertices), np.array(b.vertices), atol=1e-6)
