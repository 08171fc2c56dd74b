import time

import numpy as np
import pytest
import trimesh

from shapespace.errors import MeshError
from shapespace.geometry.doctor import examine, repair
from shapespace.types import Mesh


def sphere(subdivisions: int = 3, radius: float = 50.0) -> Mesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh(ball.vertices * [1.0, 0.8, 1.3], ball.faces, name="ball.ply")


def cap(mesh: Mesh, lowest: float = 5.0) -> Mesh:
    """The upper part of a closed surface: open, as a scan of a face is."""
    keep = (mesh.vertices[mesh.faces][:, :, 2] > lowest).all(axis=1)
    used, faces = np.unique(mesh.faces[keep], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3), name="cap.ply")


def joined(*meshes: Mesh) -> Mesh:
    shifts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = [m.faces + s for m, s in zip(meshes, shifts[:-1], strict=True)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces), name="joined.ply")


def turned(mesh: Mesh, which: np.ndarray | slice = slice(None)) -> Mesh:
    faces = mesh.faces.copy()
    faces[which] = faces[which][:, ::-1]
    return Mesh(mesh.vertices, faces, mesh.landmarks, mesh.name)


def moved(mesh: Mesh, by: object, scale: float = 1.0) -> Mesh:
    return mesh.with_vertices(mesh.vertices * scale + np.asarray(by))


def volume(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)


def same_triangles(a: Mesh, b: Mesh) -> bool:
    """Whether both hold the same oriented triangles, in whatever order and starting at whatever corner."""

    def canonical(mesh: Mesh) -> set[tuple[bytes, ...]]:
        corners = mesh.vertices[mesh.faces]
        out: set[tuple[bytes, ...]] = set()
        for triangle in corners:
            keys = [corner.tobytes() for corner in triangle]
            start = keys.index(min(keys))
            out.add((*keys[start:], *keys[:start]))
        return out

    return canonical(a) == canonical(b)


def levels(mesh: Mesh) -> list[str]:
    return [finding.level for finding in examine(mesh).findings]


def test_a_sound_mesh_is_returned_as_it_is():
    for mesh in (sphere(), cap(sphere()), moved(sphere(), [300, 0, 0])):
        fixed, findings = repair(mesh)
        assert fixed is mesh
        assert findings == ()
        assert examine(mesh).usable


def test_the_report_counts_what_is_there():
    mesh = sphere(2)
    report = examine(mesh)
    assert (report.vertices, report.triangles, report.components) == (162, 320, 1)
    assert (report.boundary_edges, report.non_manifold_edges, report.inconsistent_edges) == (0, 0, 0)
    assert report.largest_component_share == pytest.approx(1.0)
    np.testing.assert_allclose(report.bounds, [mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
    np.testing.assert_allclose(report.extent, np.ptp(mesh.vertices, axis=0))
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    assert report.planarity == pytest.approx(spread[2] / spread[0])
    opened = Mesh(mesh.vertices, mesh.faces[1:], name=mesh.name)
    assert examine(opened).boundary_edges == 3


def test_duplicate_vertices_are_merged():
    mesh = sphere()
    soup = Mesh(mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(mesh.faces.size).reshape(-1, 3), name="soup")
    report = examine(soup)
    assert report.duplicate_vertices == mesh.faces.size - len(mesh.vertices)
    assert (report.components, report.boundary_edges) == (1, 0)
    fixed, findings = repair(soup)
    assert len(fixed.vertices) == len(mesh.vertices)
    assert same_triangles(fixed, mesh)
    assert [f.level for f in findings] == ["fixed"]
    assert "merged" in findings[0].action


def test_degenerate_and_repeated_triangles_are_dropped():
    mesh = sphere(2)
    middle = mesh.vertices[mesh.faces[0][:2]].mean(axis=0)
    n = len(mesh.vertices)
    extra = [[0, 0, 1], [*mesh.faces[0][:2], n], mesh.faces[5], mesh.faces[6][[1, 0, 2]]]
    bad = Mesh(np.vstack([mesh.vertices, middle]), np.vstack([mesh.faces, extra]), name="bad")
    report = examine(bad)
    assert (report.degenerate_triangles, report.duplicate_triangles, report.unreferenced_vertices) == (2, 2, 1)
    assert same_triangles(repair(bad)[0], mesh)


def test_thin_but_real_triangles_are_kept():
    mesh = sphere(2)
    squeezed = mesh.with_vertices(mesh.vertices * [1, 1, 1e-3])
    assert examine(squeezed).degenerate_triangles == 0


def test_unreferenced_vertices_are_dropped_even_when_they_are_nan():
    mesh = cap(sphere())
    strays = np.array([[np.nan, 0, 0], [1e5, 0, 0], [np.inf, np.inf, 0]])
    bad = Mesh(np.vstack([strays, mesh.vertices]), mesh.faces + 3, {"nose": np.ones(3)}, "cap.ply")
    report = examine(bad)
    assert (report.non_finite_vertices, report.unreferenced_vertices) == (2, 1)
    fixed, findings = repair(bad)
    np.testing.assert_array_equal(fixed.vertices, mesh.vertices)
    np.testing.assert_array_equal(fixed.faces, mesh.faces)
    assert fixed.name == "cap.ply"
    assert list(fixed.landmarks) == ["nose"]
    assert [f.level for f in findings] == ["fixed", "fixed"]


def test_missing_points_of_a_depth_camera_are_dropped():
    points = sphere().vertices.copy()
    points[::3] = np.nan
    fixed, findings = repair(Mesh(points, None, name="cloud"))
    assert np.isfinite(fixed.vertices).all()
    assert len(fixed.vertices) == np.isfinite(points[:, 0]).sum()
    assert [f.level for f in findings] == ["fixed", "note"]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_vertices_that_are_not_finite_go_with_their_triangles_or_are_refused(value: float):
    ball = sphere()
    vertices = ball.vertices.copy()
    vertices[[7, 9], 1] = value
    used = np.isin(ball.faces, (7, 9)).any(axis=1)
    number = np.arange(len(vertices)).astype(np.uint8)
    mesh = Mesh(vertices, ball.faces, {"tip": vertices[0]}, "ball.ply", np.tile(number[:, None], 3))
    repaired, findings = repair(mesh)
    (said,) = [finding for finding in findings if finding.level == "fixed"]
    assert f"2 vertices with coordinates that are NaN or infinite, used by {used.sum()} triangles" in said.problem
    assert np.array_equal(repaired.vertices, np.delete(ball.vertices, [7, 9], axis=0))
    assert np.array_equal(repaired.vertices[repaired.faces], ball.vertices[ball.faces[~used]])
    assert np.array_equal(repaired.colours[:, 0], np.delete(number, [7, 9]))
    assert repaired.landmarks.keys() == {"tip"}
    report = examine(mesh)
    assert report.usable and report.non_finite_vertices == 2 and report.boundary_edges > 0
    assert not examine(mesh, strict=True).usable
    with pytest.raises(MeshError, match=r"ball\.ply.*NaN or infinite.*--strict.*\.$"):
        repair(mesh, strict=True)


def test_a_surface_of_which_nothing_finite_is_left_is_refused():
    ball = sphere()
    for finite in (0, 3):
        vertices = np.where(np.arange(len(ball.vertices))[:, None] < finite, ball.vertices, np.nan)
        with pytest.raises(
            MeshError, match=r"ball\.ply: (it has no points with finite coordinates|it has only 3|it has no triangle)"
        ):
            repair(Mesh(vertices, ball.faces, name="ball.ply"))


def test_a_closed_surface_that_is_inside_out_is_turned():
    fixed, findings = repair(turned(sphere()))
    assert volume(fixed) == pytest.approx(volume(sphere()))
    assert "inside out" in findings[0].problem


def test_the_wall_of_a_cavity_keeps_looking_inward():
    hollow = joined(sphere(), turned(moved(sphere(2), 0, 0.5)))
    assert repair(hollow)[0] is hollow
    fixed, _ = repair(turned(hollow, slice(0, len(sphere().faces))))
    assert same_triangles(fixed, hollow)


def test_an_inside_out_piece_beside_another_is_turned():
    pair = joined(sphere(), moved(sphere(2), [500, 0, 0]))
    fixed, _ = repair(turned(pair, slice(len(sphere().faces), None)))
    assert same_triangles(fixed, pair)


@pytest.mark.parametrize("lowest", [-55.0, -20.0, 5.0, 40.0])
def test_reversed_winding_of_an_open_surface_is_found(lowest: float):
    scan = cap(sphere(), lowest)
    assert repair(scan)[0] is scan
    fixed, findings = repair(turned(scan))
    assert same_triangles(fixed, scan)
    assert "is probably reversed" in findings[0].problem
    assert examine(turned(scan)).reversed_triangles == len(scan.faces)


def test_an_undecided_open_surface_is_left_as_it_is():
    x, y = np.meshgrid(np.linspace(-3, 3, 31), np.linspace(-3, 3, 31))
    at = (np.arange(30)[:, None] * 31 + np.arange(30)).ravel()
    faces = np.concatenate([np.stack([at, at + 1, at + 31], 1), np.stack([at + 1, at + 32, at + 31], 1)])
    saddle = Mesh(np.stack([x, y, x * y / 5], axis=-1).reshape(-1, 3), faces, name="saddle")
    for mesh in (saddle, turned(saddle)):
        assert repair(mesh)[0] is mesh


def test_mixed_winding_is_made_consistent_and_outward():
    for mesh in (sphere(), cap(sphere())):
        which = np.random.default_rng(3).random(len(mesh.faces)) < 0.7
        report = examine(turned(mesh, which))
        assert report.inconsistent_edges > 100
        fixed, findings = repair(turned(mesh, which))
        assert same_triangles(fixed, mesh)
        assert {f.level for f in findings} == {"fixed"}
        assert repair(fixed)[0] is fixed


def test_pieces_that_touch_do_not_turn_each_other():
    # Two parts of one file, wound against each other, whose borders lie on each other without being joined.
    mesh = sphere()
    upper = mesh.vertices[mesh.faces].mean(axis=1)[:, 2] > 30
    parts = []
    for part in (mesh.faces[~upper], mesh.faces[upper][:, ::-1]):
        used, faces = np.unique(part, return_inverse=True)
        parts.append(Mesh(mesh.vertices[used], faces.reshape(-1, 3)))
    fixed, findings = repair(joined(*parts))
    assert examine(joined(*parts)).inconsistent_edges > 10
    assert same_triangles(fixed, joined(*parts))
    assert any("touch" in f.problem and f.level == "note" for f in findings)


def test_a_moebius_strip_is_kept_and_said():
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    edge = [
        np.stack([(50 + s * np.cos(t / 2)) * np.cos(t), (50 + s * np.cos(t / 2)) * np.sin(t), s * np.sin(t / 2)], 1)
        for s in (-10, 10)
    ]
    faces = []
    for i in range(40):
        a, b = i, i + 40
        c, d = (i + 1, i + 41) if i < 39 else (40, 0)
        faces += [[a, c, b], [c, d, b]]
    fixed, findings = repair(Mesh(np.concatenate(edge), np.array(faces), name="strip"))
    assert len(fixed.faces) == 80
    assert any("Moebius" in f.problem and f.level == "note" for f in findings)


def test_non_manifold_edges_are_kept_and_said():
    mesh = sphere(2)
    fin = np.vstack([mesh.vertices, [200.0, 0, 0]])
    bad = Mesh(fin, np.vstack([mesh.faces, [[*mesh.faces[0][:2], len(mesh.vertices)]]]), name="fin")
    fixed, findings = repair(bad)
    assert len(fixed.faces) == len(bad.faces)
    assert examine(bad).non_manifold_edges == 1
    assert any("1 edge has more than two triangles" in f.problem for f in findings)


def test_several_components_are_kept_and_the_largest_share_said():
    far = joined(sphere(), moved(sphere(), [500, 0, 0], 0.5))
    report = examine(far)
    assert report.components == 2
    assert report.largest_component_share == pytest.approx(0.8)
    assert any("80.0 %" in f.problem for f in report.findings)
    assert repair(far)[0] is far


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_far_origin_is_noted_and_changes_nothing(dtype: type):
    near = cap(sphere())
    far = near.with_vertices((near.vertices + 1e6).astype(dtype))
    report = examine(far)
    assert report.usable
    assert report.origin_distance > 5000
    assert [f.level for f in report.findings] == ["note"]
    assert ("grid" in report.findings[0].problem) == (dtype == np.float32)
    assert repair(far)[0] is far
    fixed, _ = repair(turned(far))
    assert same_triangles(fixed, far)


PLANE = np.random.default_rng(0).normal(size=(50, 2)) @ [[1.0, 2.0, 0.5], [0.0, 1.0, -1.0]] * 100
FAR = np.array([10, 20, 1e6])
LINE = np.linspace(-1, 1, 20)[:, None] * [3.0, 1.0, 2.0]
TRIANGLE = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1, 0]])


@pytest.mark.parametrize(
    ("vertices", "why"),
    [
        (np.zeros((0, 3)), "no points"),
        (np.full((5, 3), np.nan), "no points"),
        (np.full((9, 3), 4.2), "points are equal"),
        (LINE, "on a line"),
        (LINE + 1e6, "on a line"),
        (TRIANGLE[:2], "on a line"),
        (TRIANGLE, "3 different points"),
        (PLANE, "on a plane"),
        (PLANE + FAR, "on a plane"),
        ((PLANE + FAR).astype(np.float32), "on a plane"),
        (sphere().vertices * 1e100, "too large"),
    ],
)
@pytest.mark.parametrize("with_faces", [False, True])
def test_what_spans_no_space_is_refused(vertices: np.ndarray, why: str, with_faces: bool):
    faces = None
    if with_faces:
        if len(vertices) < 4 or np.isnan(vertices).any():
            return
        n = len(vertices)
        faces = np.stack([np.arange(n - 2), np.arange(1, n - 1), np.arange(2, n)], axis=1)
    mesh = Mesh(vertices, faces, name="flat.ply")
    report = examine(mesh)
    assert [f.level for f in report.findings].count("refused") == 1
    with pytest.raises(MeshError, match=why) as caught:
        repair(mesh)
    assert str(caught.value).startswith("flat.ply: ")
    assert str(caught.value).endswith(".")


def test_one_triangle_is_refused():
    for vertices in (TRIANGLE, np.vstack([TRIANGLE, [[0, 0, 9], [3, 4, 5]]])):
        with pytest.raises(MeshError, match="one triangle"):
            repair(Mesh(vertices, np.array([[0, 1, 2]]), name="one.ply"))


def test_triangles_that_all_lack_area_are_refused():
    vertices = sphere(1).vertices
    with pytest.raises(MeshError, match="no triangle that has an area"):
        repair(Mesh(vertices, np.array([[0, 0, 1], [2, 3, 3]]), name="sticks.ply"))


def test_a_nearly_flat_surface_is_still_taken():
    mesh = cap(sphere())
    assert examine(mesh.with_vertices(mesh.vertices * [1, 1, 1e-4])).usable


def test_forty_thousand_triangles_take_well_under_a_second():
    mesh = sphere(6)
    which = np.random.default_rng(0).random(len(mesh.faces)) < 0.3
    scan = turned(mesh, which)
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        repair(scan)
        best = min(best, time.perf_counter() - start)
    assert len(scan.faces) == 81920
    assert best < 1.0


def test_james_is_sound(shared_data):
    from shapespace.io.meshes.mesh_io import read_mesh

    james = read_mesh(shared_data / "james" / "james.obj")
    report = examine(james)
    assert report.usable
    assert (report.components, report.duplicate_vertices, report.non_manifold_edges) == (6, 0, 0)
    assert repair(james)[0] is james
    fixed, _ = repair(turned(james))
    np.testing.assert_array_equal(fixed.faces, james.faces)
