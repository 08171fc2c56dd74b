"""Colours in the matches: they determine the place of a vertex where the shape does not."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

import shapespace as ss
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

QUICK = ElasticSettings(harmonics=60, points=600, iterations=15)
CONFIG = CorrespondConfig(vertices=300, rounds=1, mirror="never", pose="as-given", first=QUICK, next=QUICK)
TURNS_DEG = (0.0, 12.0, -9.0)


def turn(degrees: float) -> FloatArray:
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


def painted(turn_deg: float, name: str) -> Mesh:
    """Return an object with rotational symmetry and a pattern without, rotated about its axis."""
    directions, faces = sphere(1200, 0.3)
    shape = directions * [60.0, 60.0, 30.0 + 0.1 * abs(turn_deg)]
    shape[:, 2] += 15 * np.exp((directions[:, 2] - 1) / 0.2)
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    stripes = np.column_stack([np.sin(3 * angle), np.cos(3 * angle), np.sin(2 * angle)]) > 0
    colours = (255 * stripes).astype(np.uint8)
    return Mesh(shape @ turn(turn_deg).T, faces, name=name, colours=colours)


def spread_deg(scans: list[Mesh], config: CorrespondConfig) -> float:
    """Return how far apart the same vertex of all surfaces is about the axis, relative to the pattern."""
    made = ss.correspond(scans, config)
    angles: list[FloatArray] = []
    for scan, turn_deg in zip(made.scans, TURNS_DEG, strict=True):
        assert scan.vertices is not None
        own = scan.vertices @ turn(turn_deg)
        angles.append(np.arctan2(own[:, 1], own[:, 0]))
    length = np.abs(np.exp(1j * np.array(angles)).mean(axis=0))
    return float(np.degrees(np.sqrt(-2 * np.log(np.minimum(length, 1.0)))).mean())


def test_colours_determine_the_place_where_the_shape_does_not() -> None:
    scans = [painted(turn_deg, f"scan{k}") for k, turn_deg in enumerate(TURNS_DEG)]
    assert spread_deg(scans, CONFIG) < 0.6 * spread_deg(scans, replace(CONFIG, ignore_colours=True))


def test_scans_without_colours_are_matched_as_if_no_scan_had_any() -> None:
    plain = [replace(painted(turn_deg, f"scan{k}"), colours=None) for k, turn_deg in enumerate(TURNS_DEG)]
    coloured = [painted(TURNS_DEG[0], "scan0"), *plain[1:]]
    made, other = ss.correspond(coloured, CONFIG, template=plain[0]), ss.correspond(plain, CONFIG, template=plain[0])
    for one, two in zip(made.scans, other.scans, strict=True):
        np.testing.assert_array_equal(one.vertices, two.vertices)
