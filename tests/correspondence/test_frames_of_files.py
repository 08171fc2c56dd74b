"""With `pose="as-given"` or `"near"`, the rotation of a scan is that of the frame of its file, within a range."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shapespace as ss
from raw_blobs import dispersion_mm, raw_blob
from shapespace.correspondence import groupwise
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import ScanSides
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import sphere

QUICK = ElasticSettings(harmonics=60, points=500, iterations=10)
CONFIG = CorrespondConfig(vertices=300, rounds=1, mirror="never", pose="as-given", first=QUICK, next=QUICK)


def turned(degrees: float, axis: tuple[float, float, float], scale: float = 1.0) -> Similarity:
    R = Rotation.from_rotvec(np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)).as_matrix()
    return Similarity(scale, R, np.array([300.0, -20.0, 5.0]))


def rotation_deg(T: Similarity) -> float:
    return float(np.degrees(Rotation.from_matrix(T.rotation).magnitude()))


def rod(k: int) -> Mesh:
    """Return an object that looks the same upside down, but for noise."""
    rng = np.random.default_rng(k)
    directions, faces = sphere(600, 0.3 * k)
    points: FloatArray = directions * [20.0 + k, 100.0, 30.0] + 0.5 * rng.standard_normal(directions.shape)
    return Mesh(points, faces, name=f"rod{k}")


def test_an_object_that_looks_the_same_from_two_sides_keeps_the_rotation_of_its_file() -> None:
    scans = [rod(k) for k in range(5)]
    turns = [rotation_deg(scan.T_scan_template) for scan in ss.correspond(scans, CONFIG).scans]
    assert max(turns) < 15.0


@pytest.mark.parametrize(("pose", "degrees"), [("as-given", 10.0), ("near", 35.0)])
def test_scans_rotated_within_the_range_are_registered(pose: str, degrees: float) -> None:
    axes = [(1, 0, 0), (0, 1, 0), (1, 1, 1), (0, -1, 1)]
    blobs = [raw_blob(0, T=turned(0.0, (1, 0, 0)), points=700)]
    blobs += [raw_blob(k + 1, T=turned(degrees, axis, 0.8), points=700) for k, axis in enumerate(axes)]
    template = blobs[0].scan
    made = ss.correspond([one.scan for one in blobs], replace(CONFIG, pose=pose), template=template)
    assert not any(scan.reason for scan in made.scans)
    assert dispersion_mm(blobs, [scan.vertices for scan in made.scans]) < 10.0


def test_a_scan_rotated_beyond_the_range_is_excluded_with_the_reason() -> None:
    blobs = [raw_blob(k, T=turned(90.0 * (k == 3), (1, 0, 0)), points=700) for k in range(8)]
    config = replace(CONFIG, rounds=2)
    made = ss.correspond([one.scan for one in blobs], config, template=blobs[0].scan)
    assert [scan.name for scan in made.scans if scan.reason] == ["blob3"]
    assert "the frame of its file is rotated by about" in made.scans[3].reason


def test_frames_cannot_be_used_where_the_template_is_reflected(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = [raw_blob(k, T=turned(0.0, (1, 0, 0)), points=700).scan for k in range(4)]
    sides = ScanSides(np.array([True, True, True, False]), np.ones(4), decided=True)
    monkeypatch.setattr(groupwise, "solve_sides", lambda *_: sides)
    with pytest.raises(InputError, match="the first template is a mirror image of most scans"):
        ss.correspond(scans, replace(CONFIG, mirror="auto"))
