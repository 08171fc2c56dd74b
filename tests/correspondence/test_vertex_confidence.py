"""Surfaces in correspondence have a standard deviation of each vertex's position along the surface."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raw_blobs import raw_blob
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.vertex_confidence import VertexConfidence
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, sphere

QUICK = ElasticSettings(harmonics=60, points=500, iterations=10)
CONFIG = CorrespondConfig(vertices=300, rounds=1, mirror="never", first=QUICK, next=QUICK)
METRE = 1e-3


@pytest.fixture(scope="module")
def made() -> Correspondence:
    scans = [raw_blob(k, points=700).scan for k in range(5)]
    scans[4] = replace(scans[4], vertices=METRE * scans[4].vertices)
    return correspond(scans, CONFIG)


def stds(mesh: Mesh, vertices: FloatArray, observed: FloatArray | None = None) -> FloatArray:
    shown = np.ones(len(vertices), np.bool_) if observed is None else observed > 0
    return VertexConfidence.of(mesh, Harmonics.of(mesh, 150)).position_std(vertices, shown, 10)


def test_positions_are_more_certain_at_a_bump_than_on_a_smooth_surface() -> None:
    directions, faces = sphere(1500)
    bump = np.exp((directions @ [0.0, 0.0, 1.0] - 1) / 0.02)
    mean = Mesh(100.0 * directions * (1 + 0.3 * bump[:, None]), faces)
    slid = mean.vertices + 2.0 * np.cross([0.0, 1.0, 0.0], directions)
    std = stds(mean, slid)
    near, away = bump > 0.1, np.abs(directions[:, 2]) < 0.3
    assert std[near].mean() < 0.5 * std[away].mean()


def test_uncertainty_changes_gradually_over_a_rough_surface() -> None:
    directions, faces = sphere(6000)
    rng = np.random.default_rng(0)
    mean = Mesh(blob(directions, np.zeros(5)) + 0.2 * rng.standard_normal((6000, 3)), faces)
    std = stds(mean, blob(directions, np.array([0.5, -0.5, 1.0, 0.3, 1.0])))
    ratio = np.log(std[faces[:, 0]] / std[faces[:, 1]])
    assert np.quantile(np.abs(ratio), 0.95) < 0.1


def test_positions_are_less_certain_where_the_scan_shows_nothing() -> None:
    directions, faces = sphere(1500)
    mean = Mesh(blob(directions, np.zeros(5)), faces)
    shape = blob(directions, np.array([0.5, -0.5, 1.0, 0.3, 1.0]))
    hidden = directions[:, 0] > 0.5
    whole, partial = stds(mean, shape), stds(mean, shape, (~hidden).astype(np.float64))
    assert partial[hidden].mean() > 1.4 * whole[hidden].mean()
    far = directions[:, 0] < -0.3
    assert partial[far].mean() < 1.3 * whole[far].mean()


def test_standard_deviations_are_in_the_unit_of_the_scan(made: Correspondence) -> None:
    shares = [np.median(one.position_std) / one.T_scan_template.scale for one in made.scans]
    assert np.median(made.scans[4].position_std) < 2 * METRE * np.median(made.scans[0].position_std)
    assert max(shares) < 3 * min(shares)
    assert all(np.isfinite(one.position_std).all() and (one.position_std > 0).all() for one in made.scans)


def test_a_file_of_a_surface_keeps_them(made: Correspondence, tmp_path: Path) -> None:
    mesh = made.meshes()[0]
    write_mesh(tmp_path / "surface.ply", mesh)
    assert np.allclose(read_mesh(tmp_path / "surface.ply").position_std, mesh.position_std, rtol=1e-6)
