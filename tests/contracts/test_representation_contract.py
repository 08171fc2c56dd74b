"""What every representation must do; a new entry of REPRESENTATIONS is tested by being there."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.articulation import Articulation
from shapespace.model.build_model import BuildConfig, build_model
from shapespace.model.representation import REPRESENTATIONS, Articulated, Representation
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, raw_scan, similarity, sphere, training_meshes

COUNTS = (16, 16)
LINEAR = [name for name, kind in REPRESENTATIONS.items() if kind.is_linear]
KEPT = -0.6
"""Height along x above which the blob is kept: an open surface, as B-splines need."""


def control_points(name: str) -> tuple[int, int] | None:
    return COUNTS if name.startswith("bspline") else None


def counts_of_parts() -> dict[str, int]:
    """Return two parts: the first and the second half of the vertices."""
    count = len(open_blobs()[0].vertices)
    return {"first": count // 2, "second": count - count // 2}


@cache
def open_blobs() -> tuple[Mesh, ...]:
    d, faces = sphere(700)
    faces = faces[(d[faces, 0] > KEPT).all(axis=1)]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    return tuple(Mesh(m.vertices[used], faces, name=m.name) for m in training_meshes())


@cache
def coder(name: str) -> Representation:
    mean = np.mean([mesh.vertices for mesh in open_blobs()], axis=0)
    if name == "articulated":
        return Articulated(Articulation(mean, list(counts_of_parts().values())))
    return REPRESENTATIONS[name].of(Mesh(mean, open_blobs()[0].faces), control_points(name))


@cache
def model(name: str) -> ShapeModel:
    tip = int(open_blobs()[0].vertices[:, 2].argmax())
    if name == "articulated":
        config = BuildConfig(
            modes=5, landmarks={"tip": tip}, parts=counts_of_parts(), provenance="blobs", licence="CC0"
        )
        return build_model(open_blobs(), config)
    return ShapeModel.fit(
        open_blobs(),
        modes=5,
        landmarks={"tip": tip},
        representation=name,
        control_points=control_points(name),
        provenance="blobs",
        licence="CC0",
    )


def shapes() -> FloatArray:
    return np.stack([mesh.vertices for mesh in open_blobs()[:3]])


def rms(difference: FloatArray) -> float:
    return float(np.sqrt((difference**2).sum(axis=-1).mean()))


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_a_surface_that_is_held_comes_back(name: str) -> None:
    held = coder(name).decode(coder(name).encode(shapes()))
    assert held.shape == shapes().shape
    # A spline leaves to its thin-plate energy what hardly any vertex tells.
    assert rms(coder(name).decode(coder(name).encode(held)) - held) < (1e-9 if name == "vertices" else 0.03)


@pytest.mark.parametrize(("name", "lost_mm"), [("vertices", 1e-9), ("bspline", 1.0), ("bspline-detail", 0.4)])
def test_what_coding_loses_is_small(name: str, lost_mm: float) -> None:
    assert rms(coder(name).decode(coder(name).encode(shapes())) - shapes()) < lost_mm


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_one_shape_is_coded_as_among_many(name: str) -> None:
    many = coder(name).encode(shapes())
    assert many.ndim == 2
    np.testing.assert_array_equal(coder(name).encode(shapes()[1]), many[1])
    np.testing.assert_array_equal(coder(name).decode(many[1]), coder(name).decode(many)[1])


@pytest.mark.parametrize("name", LINEAR)
def test_coding_is_affine(name: str) -> None:
    code, (a, b, _) = coder(name), shapes()
    np.testing.assert_allclose(code.encode(2 * a - b), 2 * code.encode(a) - code.encode(b), atol=1e-6)
    u, v = code.encode(a), code.encode(b)
    np.testing.assert_allclose(code.decode(2 * u - v), 2 * code.decode(u) - code.decode(v), atol=1e-8)


@pytest.mark.parametrize("name", LINEAR)
def test_directions_are_what_decoding_does_to_differences(name: str) -> None:
    u, v = coder(name).encode(shapes()[:2])
    moved = coder(name).decode(u + v) - coder(name).decode(u)
    np.testing.assert_allclose(coder(name).directions(v[:, None])[:, 0], moved.ravel(), atol=1e-7)


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_what_is_coded_is_left_as_it_was(name: str) -> None:
    given = shapes()
    coder(name).encode(given)
    np.testing.assert_array_equal(given, shapes())


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_its_arrays_make_the_same_again(name: str) -> None:
    again = REPRESENTATIONS[name].from_arrays(coder(name).arrays())
    np.testing.assert_array_equal(again.encode(shapes()), coder(name).encode(shapes()))


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_modes_are_orthonormal_in_decoded_vertices(name: str) -> None:
    m = model(name)
    assert m.vertex_basis.shape == (3 * m.n_vertices, 5)
    np.testing.assert_allclose(m.vertex_basis.T @ m.vertex_basis, np.eye(5), atol=1e-9)
    step = np.eye(5)[2] * (1.0 if m.is_linear else 1e-5)
    moved = (m.reconstruct(step) - m.mean_vertices).ravel() / step[2]
    np.testing.assert_allclose(moved, m.vertex_basis[:, 2], atol=1e-9 if m.is_linear else 1e-5)


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_derivatives_at_any_shape_are_those_of_differences(name: str) -> None:
    m = model(name)
    b, step = 0.7 * m.stddev, 1e-5 * np.eye(5)
    moved = np.stack([(m.reconstruct(b + e) - m.reconstruct(b - e)).ravel() / 2e-5 for e in step], axis=1)
    np.testing.assert_allclose(m.directions(b), moved, atol=1e-6)


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_shapes_of_the_model_have_their_own_coefficients(name: str) -> None:
    m = model(name)
    b = 0.7 * m.stddev
    np.testing.assert_allclose(m.project(m.reconstruct(b), align=False), b, atol=1e-8)


@pytest.mark.parametrize("name", LINEAR)
def test_projection_is_least_squares_on_vertices(name: str) -> None:
    m, given = model(name), open_blobs()[4].vertices
    wanted = np.linalg.lstsq(m.vertex_basis, (given - m.mean_vertices).ravel(), rcond=None)[0]
    np.testing.assert_allclose(m.project(given, align=False), wanted, atol=1e-8)
    b = 0.7 * m.stddev
    np.testing.assert_allclose(m.project(m.reconstruct(b), align=False), b, atol=1e-8)


@pytest.mark.parametrize("name", LINEAR)
def test_coefficients_vary_over_the_training_shapes_as_the_model_says(name: str) -> None:
    rng = np.random.default_rng(5)
    meshes = [m.with_vertices(m.vertices + 0.3 * rng.standard_normal(m.vertices.shape)) for m in open_blobs()]
    m = ShapeModel.fit(meshes, modes=5, align=False, representation=name, control_points=control_points(name))
    b = np.stack([m.project(mesh, align=False) for mesh in meshes])
    np.testing.assert_allclose(b.std(axis=0, ddof=1), m.stddev, rtol=2e-3)
    flat = np.stack([mesh.vertices.ravel() for mesh in meshes])
    assert m.total_variance == pytest.approx(flat.var(axis=0, ddof=1).sum())
    # The variance per coordinate that the modes leave over, of the vertices as they were measured.
    centred = flat - flat.mean(axis=0)
    left = centred - centred @ m.vertex_basis @ m.vertex_basis.T
    expected = (left**2).sum() / (len(flat) - 1) / (flat.shape[1] - 5)
    assert m.noise_variance == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("name", REPRESENTATIONS)
def test_its_model_is_read_back_as_it_was_written(name: str, tmp_path: Path) -> None:
    m = model(name)
    m.save(tmp_path / "model.h5")
    again = ShapeModel.load(tmp_path / "model.h5")
    assert again.content_hash == m.content_hash
    assert again.representation == name
    b = m.stddev * [1.0, -1.0, 0.5, 2.0, -0.3]
    np.testing.assert_array_equal(again.reconstruct(b), m.reconstruct(b))
    np.testing.assert_array_equal(again.truncate(2).reconstruct(b[:2]), m.truncate(2).reconstruct(b[:2]))


@pytest.mark.parametrize("name", REPRESENTATIONS)
@pytest.mark.parametrize("method", ["robust", "paper"])
def test_a_fit_finds_a_shape_of_the_model(name: str, method: str) -> None:
    m = model(name)
    z = np.array([1.0, -1.0, 0.5, 1.0, -0.5])
    T = similarity(1, 12.0, 1.1, 30.0)
    scan = raw_scan(z, T, keep=KEPT).scan
    result = fit_scan(m, scan, FitConfig(method=method, unit="mm"))
    truth = T.apply(open_truth(z))
    found = result.T_scan_model.apply(m.reconstruct(result.b))
    assert rms(found - truth) / T.scale < {"robust": 1.0, "paper": 4.0}[method]
    assert result.b.shape == (5,)


def open_truth(z: FloatArray) -> FloatArray:
    d, faces = sphere(700)
    used = np.unique(faces[(d[faces, 0] > KEPT).all(axis=1)])
    return blob(d[used], z)
