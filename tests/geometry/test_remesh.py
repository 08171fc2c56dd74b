import numpy as np
import pytest

from shapespace.errors import MeshError
from shapespace.geometry import remesh
from shapespace.geometry.closest import build_engine
from shapespace.report.render.scene import decimate
from shapespace.types import Mesh


def bump(side: int = 20) -> Mesh:
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    vertices = np.stack([x, y, np.exp(-3 * (x**2 + y**2))], axis=2).reshape(-1, 3)
    i = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + side], 1), np.stack([i + 1, i + side + 1, i + side], 1)])
    return Mesh(vertices, faces.astype(np.int32), name="bump")


FAULTY = {
    "an edge of three triangles": [[0, 1, 300]],
    "a triangle twice": [[0, 1, 20]],
    "a triangle with two corners": [[0, 0, 399]],
    "a triangle with one corner": [[5, 5, 5]],
    "a neighbour turned over": [[18, 19, 399]],
}


@pytest.mark.parametrize("more", FAULTY.values(), ids=FAULTY)
def test_what_libigl_would_write_beyond_its_tables_for_never_reaches_it(
    more: list[list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = bump()
    monkeypatch.setattr(remesh, "_igl", lambda: pytest.fail("libigl was asked"))
    faces = np.concatenate([mesh.faces, np.array(more, dtype=np.int32)])
    assert remesh.is_sheet(mesh.faces)
    assert not remesh.is_sheet(faces)
    with pytest.raises(MeshError, match="bump cannot be re-triangulated"):
        remesh.collapse(mesh.vertices, faces, 100, "bump")
    with pytest.raises(MeshError, match="bump cannot be re-triangulated"):
        remesh.split(mesh.vertices, faces, "bump")
    thin, kept = decimate(Mesh(mesh.vertices, faces, name="bump"), 100)
    assert 0 < len(thin.faces) <= 100
    np.testing.assert_array_equal(thin.vertices, mesh.vertices[kept])


def test_two_sheets_that_touch_in_a_point_are_a_sheet() -> None:
    assert remesh.is_sheet(np.array([[0, 1, 2], [0, 3, 4]]))
    assert not remesh.is_sheet(np.empty((0, 3), dtype=np.int32))


def test_finer_and_coarser_triangles_lie_on_the_surface() -> None:
    mesh = bump()
    fine, triangles = remesh.split(mesh.vertices, mesh.faces, "bump")
    assert len(triangles) == 4 * len(mesh.faces)
    assert build_engine(mesh, "surface").query(fine).distance.max() < 1e-12
    coarse, left, origin = remesh.collapse(mesh.vertices, mesh.faces, 200, "bump")
    assert len(left) <= 200 and len(origin) == len(coarse)
    assert np.linalg.norm(coarse - mesh.vertices[origin], axis=1).max() < 0.3
    assert build_engine(mesh, "surface").query(remesh.onto(coarse, mesh.vertices, mesh.faces)).distance.max() < 1e-12


def test_what_cannot_collapse_stays() -> None:
    _, left, _ = remesh.collapse(np.eye(3), np.array([[0, 1, 2]]), 0, "bump")
    np.testing.assert_array_equal(left, [[0, 1, 2]])
