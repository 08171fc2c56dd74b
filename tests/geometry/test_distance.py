import math

import numpy as np
import pytest

from shapespace.geometry.closest import DistanceSummary, surface_distances
from shapespace.types import Mesh
from synthetic_shapes import similarity, sphere


def sheet(n: int, size: float = 10.0, z: float = 0.0, *, reach: float = 1.0) -> Mesh:
    """A square of side 2 * size * reach about the origin, in n x n squares at height z."""
    t = np.linspace(-size * reach, size * reach, n + 1)
    x, y = np.meshgrid(t, t, indexing="ij")
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))


def test_a_summary_says_what_numpy_says() -> None:
    d = np.array([0.0, 1.0, 2.0, 3.0, 10.0])
    s = DistanceSummary.of(d)
    assert (s.mean, s.median, s.max, s.count, s.fraction) == (3.2, 2.0, 10.0, 5, 1.0)
    assert s.rms == pytest.approx(math.sqrt(114 / 5))
    assert s.p95 == pytest.approx(np.percentile(d, 95))
    part = DistanceSummary.of(d, d < 5)
    assert (part.mean, part.max, part.count, part.fraction) == (1.5, 3.0, 4, 0.8)
    none = DistanceSummary.of(d, d < 0)
    assert math.isnan(none.mean)
    assert (none.count, none.fraction) == (0, 0.0)


def test_parallel_sheets_are_as_far_apart_as_they_are_both_ways() -> None:
    d = surface_distances(sheet(7), sheet(10, z=1.25))
    assert np.allclose(d.model_to_scan_mm, 1.25)
    assert np.allclose(d.scan_to_model_mm, 1.25)


def test_scan_beyond_the_rim_of_the_model_is_not_counted() -> None:
    d = surface_distances(sheet(8), sheet(30, z=1.0, reach=1.5))
    outside = (np.abs(sheet(30, reach=1.5).vertices[:, :2]) > 10.0 + 1e-9).any(axis=1)
    assert not d.scan_counted[outside].any()
    # A triangle with all corners on the rim, as at the corners of the sheet, counts as rim.
    inside = (np.abs(sheet(30, reach=1.5).vertices[:, :2]) < 7.5).all(axis=1)
    assert d.scan_counted[inside].all()
    assert d.scan_to_model.max == pytest.approx(1.0)
    assert d.scan_to_model_mm.max() > 5
    assert d.scan_to_model.fraction == pytest.approx(d.scan_counted.mean())


def test_a_model_shrunk_to_a_point_of_the_scan_is_near_one_way_only() -> None:
    directions, faces = sphere(500)
    scan = Mesh(50 * directions, faces)
    d = surface_distances(Mesh(scan.vertices[0] + 1e-3 * directions, faces), scan)
    assert d.model_to_scan.mean < 1e-2
    assert d.scan_to_model.mean > 30


def test_lengths_are_told_in_the_millimetres_asked_for() -> None:
    T = similarity(1, 60.0, 0.001)
    model, scan = sheet(6), sheet(9, z=2.0)
    metres = surface_distances(
        model.with_vertices(T.apply(model.vertices)), scan.with_vertices(T.apply(scan.vertices)), mm_per_length=1000.0
    )
    assert np.allclose(metres.model_to_scan_mm, 2.0)
    assert metres.as_dict()["scan_to_model"]["mean"] == pytest.approx(2.0)
    assert set(metres.as_dict()["model_to_scan"]) >= {"mean", "median", "rms", "p95", "max", "count"}


def test_point_clouds_are_measured_to_their_points() -> None:
    model, scan = sheet(4), Mesh(sheet(1, z=3.0).vertices)
    d = surface_distances(model, scan)
    corner = np.abs(model.vertices[:, :2]) - 10.0
    assert np.allclose(d.model_to_scan_mm, np.sqrt((corner**2).sum(axis=1) + 9))
    assert np.allclose(d.scan_to_model_mm, 3.0)
    # A model without triangles has no rim, so the whole scan counts.
    assert surface_distances(Mesh(model.vertices), scan).scan_counted.all()


def test_distances_are_signed_by_the_side_of_the_model_on_which_the_scan_lies() -> None:
    above, below = (surface_distances(sheet(7), sheet(10, z=z)) for z in (1.25, -1.25))
    assert np.allclose(above.model_to_scan_signed_mm, 1.25)
    assert np.allclose(below.model_to_scan_signed_mm, -1.25)
    counted = above.scan_counted
    assert np.allclose(above.scan_to_model_signed_mm[counted], 1.25)
    assert np.allclose(below.scan_to_model_signed_mm[counted], -1.25)
    assert np.isnan(above.scan_to_model_signed_mm[~counted]).all()
    cloud = surface_distances(sheet(7), Mesh(sheet(10, z=-1.25).vertices))
    assert (cloud.model_to_scan_signed_mm < 0).all()
    # Points have no sides.
    assert (surface_distances(Mesh(sheet(7).vertices), sheet(10, z=-1.25)).model_to_scan_signed_mm > 0).all()
