import numpy as np
import pytest

from shapespace.errors import MeshError
from shapespace.geometry.remesh import loop_operator

TETRAHEDRON = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    quads = [
        (i * n + j, (i + 1) * n + j, (i + 1) * n + j + 1, i * n + j + 1) for i in range(n - 1) for j in range(n - 1)
    ]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    z = np.random.default_rng(0).normal(size=n * n)
    return np.column_stack([x.ravel(), y.ravel(), z]).astype(float), np.array(faces)


def brute_force(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, dict[tuple[int, int], np.ndarray]]:
    opposite: dict[tuple[int, int], list[int]] = {}
    for t in faces.tolist():
        for k in range(3):
            a, b = sorted((t[k], t[(k + 1) % 3]))
            opposite.setdefault((a, b), []).append(t[(k + 2) % 3])
    old = vertices.copy()
    for v in range(len(vertices)):
        ring = [(set(e) - {v}).pop() for e in opposite if v in e]
        rim = [(set(e) - {v}).pop() for e, o in opposite.items() if v in e and len(o) == 1]
        if rim:
            old[v] = 0.75 * vertices[v] + 0.125 * vertices[rim].sum(axis=0)
        else:
            beta = 3 / 16 if len(ring) == 3 else 3 / (8 * len(ring))
            old[v] = (1 - len(ring) * beta) * vertices[v] + beta * vertices[ring].sum(axis=0)
    middle = {}
    for (a, b), o in opposite.items():
        half = (vertices[a] + vertices[b]) / 2
        middle[a, b] = half if len(o) == 1 else 0.75 * half + 0.125 * (vertices[o[0]] + vertices[o[1]])
    return old, middle


@pytest.mark.parametrize("mesh", [grid(4), (np.random.default_rng(1).normal(size=(4, 3)), TETRAHEDRON)])
def test_the_matrix_does_what_loops_rules_say_vertex_by_vertex(mesh):
    vertices, faces = mesh
    operator, refined = loop_operator(len(vertices), faces)
    out = operator @ vertices
    old, middle = brute_force(vertices, faces)
    assert np.allclose(out[: len(vertices)], old, atol=1e-12)
    assert len(out) == len(old) + len(middle)
    for (a, b), point in middle.items():
        assert np.linalg.norm(out[len(vertices) :] - point, axis=1).min() < 1e-12, (a, b)
    assert len(refined) == 4 * len(faces)


def test_rows_are_averages():
    vertices, faces = grid(5)
    operator, _ = loop_operator(len(vertices), faces)
    assert np.allclose(np.asarray(operator.sum(axis=1)).ravel(), 1.0)
    assert operator.data.min() >= 0


def test_refining_commutes_with_affine_maps():
    vertices, faces = grid(5)
    operator, _ = loop_operator(len(vertices), faces)
    rng = np.random.default_rng(2)
    A, t = rng.normal(size=(3, 3)), rng.normal(size=3)
    assert np.allclose(operator @ (vertices @ A + t), (operator @ vertices) @ A + t)


def test_refined_triangles_keep_their_winding_and_stay_closed():
    vertices = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=float)
    faces = TETRAHEDRON
    for _ in range(2):
        before = volume(vertices, faces)
        operator, refined = loop_operator(len(vertices), faces)
        vertices, faces = operator @ vertices, refined
        assert np.sign(volume(vertices, faces)) == np.sign(before)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1].tolist()) == {2}


def volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


def test_a_vertex_without_triangles_stays_where_it_is():
    operator, _ = loop_operator(4, np.array([[0, 1, 2]]))
    assert np.array_equal(operator[3].toarray(), [[0, 0, 0, 1]])


@pytest.mark.parametrize("faces", [[[0, 1, 9]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]], [[0, 1]]])
def test_surfaces_that_cannot_be_refined_are_refused(faces):
    with pytest.raises(MeshError):
        loop_operator(5, np.array(faces))
