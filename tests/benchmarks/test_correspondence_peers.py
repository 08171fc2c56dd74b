"""What stands beside the peers: surfaces that stop short of a scan must look worse, and nothing depends on pose."""

import sys
from pathlib import Path

import numpy as np
import pytest

from shapespace.types import Mesh
from synthetic_shapes import blob, sphere

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))
import correspondence_peers


def blobs(count: int, vertices: int, turn: float) -> dict[str, Mesh]:
    d, faces = sphere(vertices, turn)
    drawn = np.random.default_rng(0).standard_normal((count, 5))
    return {f"blob_{i}": Mesh(blob(d, z), faces, name=f"blob_{i}") for i, z in enumerate(drawn)}


@pytest.fixture(scope="module")
def scans() -> dict[str, Mesh]:
    return blobs(12, 900, 0.7)


@pytest.fixture(scope="module")
def right() -> correspondence_peers.Way:
    return correspondence_peers.Way(blobs(12, 400, 0.0), {}, {})


def flattened(way: correspondence_peers.Way) -> correspondence_peers.Way:
    """Return surfaces whose end stops short of the scan, where none of their own vertices can tell."""
    surfaces = {}
    for name, mesh in way.surfaces.items():
        x = np.array(mesh.vertices)
        x[:, 1] = np.minimum(x[:, 1], np.quantile(x[:, 1], 0.9))
        surfaces[name] = mesh.with_vertices(x)
    return correspondence_peers.Way(surfaces, {}, {})


def test_a_surface_that_stops_short_of_the_scan_is_farther_off(scans, right):
    names = list(scans)
    near = correspondence_peers.nearness(right, scans, names)
    short = correspondence_peers.nearness(flattened(right), scans, names)
    assert near["mean_share"] < 0.002
    assert near["failed"] == 0
    assert short["p99_share"] > 5 * near["p99_share"]
    assert near["seen_share"] == 1.0


def test_random_shapes_of_a_model_that_stops_short_are_farther_from_the_scans(scans, right):
    names = list(scans)

    def off(way: correspondence_peers.Way) -> float:
        curve = correspondence_peers.specificity([way.surfaces[n] for n in names], list(scans.values()), [1, 5], 0)
        return correspondence_peers.at_modes(curve, 5)[0]

    assert off(flattened(right)) > 1.1 * off(right)


def test_what_a_method_made_is_read_again_and_not_made_again(tmp_path, right):
    kept = correspondence_peers.Way(right.surfaces, dict.fromkeys(right.surfaces, 1.5), {"blob_99": "broken"})
    assert correspondence_peers.read_again(tmp_path) is None
    correspondence_peers.kept(kept, tmp_path)
    again = correspondence_peers.read_again(tmp_path)
    assert again is not None
    assert (again.seconds, again.aside) == (kept.seconds, kept.aside)
    for name, mesh in kept.surfaces.items():
        np.testing.assert_array_equal(again.surfaces[name].vertices, mesh.vertices)
        np.testing.assert_array_equal(again.surfaces[name].faces, mesh.faces)


def test_a_peer_that_is_not_installed_is_named(monkeypatch, scans):
    monkeypatch.setattr("peers.load", lambda name: f"{name} not installed")
    said = correspondence_peers.by_peer("meshmonk", next(iter(scans.values())), scans)
    assert said == "meshmonk_pyramid not installed"
