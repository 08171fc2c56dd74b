"""Each file that was made after a report of a user, from the command line to the right value."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import shapespace as ss
from shapespace.io.landmarks.configuration_io import read_configurations

Run = Callable[..., str]


def test_decimal_commas_of_a_cloud(reported: Path) -> None:
    points = ss.read_mesh(reported / "08_comma.xyz").vertices
    np.testing.assert_array_equal(points[[0, 4]], [[-10.08985, 63.10333, 0], [7.605, -39, 38.83282]])


def test_commas_between_columns_of_tps(reported: Path, run: Run, tmp_path: Path) -> None:
    run("landmarks", "convert", reported / "16b_tps_comma_space.tps", "-o", tmp_path / "a.csv")
    found = read_configurations(tmp_path / "a.csv")
    assert found.points.shape == (6, 6, 2) and found.points[0, 0].tolist() == [98.84, 93.83]


def test_the_frame_of_a_ply_file(reported: Path, run: Run, tmp_path: Path) -> None:
    path = reported / "30_space_ras.ply"
    first = np.array([49.9101, -31.8967, 30.0])
    np.testing.assert_allclose(ss.read_mesh(path).vertices[0], first * (-1, -1, 1), rtol=1e-6)
    run("check", path, "-o", tmp_path)
    (written,) = tmp_path.glob("*.ply")
    assert b"comment SPACE=LPS" in written.read_bytes()[:400]


def test_landmarks_lie_on_the_surface_of_their_volume(reported: Path, run: Run, tmp_path: Path) -> None:
    run("surface", reported / "frame_ras_lps" / "masks", "-o", tmp_path)
    for path in sorted((reported / "frame_ras_lps" / "lm").glob("*.json")):
        (surface,) = (ss.read_mesh(one).vertices for one in tmp_path.glob(f"{path.name.split('.')[0]}*.ply"))
        marks = json.loads(path.read_text())["markups"][0]["controlPoints"]
        for mark in marks:
            assert np.sqrt(((surface - mark["position"]) ** 2).sum(axis=1).min()) < 3.0, (path, mark["label"])


def test_mirrored_copies_have_the_same_triangles(reported: Path, run: Run, tmp_path: Path) -> None:
    run("build", reported / "mirror_then_build", "-o", tmp_path / "model.h5")
    assert ss.ShapeModel.load(tmp_path / "model.h5").n_training == 5


@pytest.mark.parametrize(
    ("name", "shape", "n_sliders", "told"),
    [
        ("06_slicer_default_labels", (6, 6, 3), 0, "matched by number"),
        ("08_curve_in_file", (5, 10, 3), 2, "are semilandmarks"),
        ("08b_curve_in_own_file", (4, 10, 3), 2, "8 files are joined to 4 specimens"),
        ("03_same_id_other_image.tps", (8, 6, 2), 0, "named after their IMAGE="),
        ("04_outlines_only.tps", (6, 60, 2), 59, "59 points of 1 curve are semilandmarks"),
        ("11_idav.dta", (6, 6, 3), 0, "1 missing landmark is an estimate"),
        ("12_morphologika.txt", (4, 6, 3), 0, ""),
    ],
)
def test_landmarks_of_other_tools_are_aligned(
    name: str, shape: tuple[int, ...], n_sliders: int, told: str, reported: Path, run: Run, tmp_path: Path
) -> None:
    found = read_configurations(reported / name)
    assert found.points.shape == shape and len(found.curve_sliders) == n_sliders
    assert told in run("align", reported / name, "-o", tmp_path)


def test_raw_coordinates_of_morphoj_of_two_or_three_dimensions(reported: Path, run: Run, tmp_path: Path) -> None:
    table = reported / "14b_morphoj_upper_raw.txt"
    assert "--dimensions 2 (or 3)" in run("align", table, "-o", tmp_path, code=2)
    run("align", table, "--dimensions", 3, "-o", tmp_path / "aligned")
    run("landmarks", "convert", table, "--dimensions", 3, "-o", tmp_path / "a.csv")
    assert read_configurations(tmp_path / "a.csv").points.shape == (8, 4, 3)


def test_lines_of_vtk_are_a_curve(reported: Path, run: Run) -> None:
    found = read_configurations(reported / "24_contour.vtk")
    ((points, is_closed),) = found.curves
    assert is_closed and len(points) == found.points.shape[1]
    assert "align reads them as curves" in run("check", reported / "24_contour.vtk")


def test_a_segment_of_overlapping_ones(reported: Path, run: Run, tmp_path: Path) -> None:
    volume = reported / "layers.seg.nrrd"
    assert "bone, cartilage" in run("surface", volume, "-o", tmp_path / "none", code=2)
    centers: list[np.ndarray] = []
    for name in ("bone", "cartilage"):
        run("surface", volume, "--label", name, "-o", tmp_path / name)
        (path,) = (tmp_path / name).glob("*.ply")
        centers.append(ss.read_mesh(path).vertices.mean(axis=0))
    np.testing.assert_allclose(centers[0] - centers[1], [6.4, 0, 0], atol=0.1)  # 8 voxels of 0.8 mm


def test_a_face_of_any_size_has_the_same_fit_or_a_reason_that_names_the_size() -> None:
    """Sizes of 0.4 to 3 of the model, where gauge `shape` divides size out (`scale_face.py`)."""
    faces, rng = ss.load_faces(), np.random.default_rng(1)
    *people, scan = (faces.cut_to_face(faces.face(faces.draw_person(rng))) for _ in range(31))
    model = ss.build_model(people, ss.BuildConfig(modes=10))
    known = ss.fit_scan(model, scan)
    shift = np.array([3000.0, -2000.0, 900.0])
    for size in (0.4, 0.75, 3.0):
        found = ss.fit_scan(model, scan.with_vertices(scan.vertices * size + shift))
        back = (found.surface().vertices - shift) / size
        assert found.status == "converged" or "times as large as the model" in found.reason, (size, found.reason)
        assert np.sqrt(((back - known.surface().vertices) ** 2).sum(axis=1).mean()) < 0.1, size
