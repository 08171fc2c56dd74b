"""Curves and outlines of tpsDig, 3D Slicer and VTK: resampled by arc length, with starts and directions matched."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refusals import refusal_of
from shapespace.cohort.landmark_cohort import has_landmarks
from shapespace.commands.align import align
from shapespace.geometry.landmark_alignment import AlignConfig, AlignedLandmarks, align_landmarks, match_curves
from shapespace.io.landmarks.configuration_io import is_configurations, read_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.meshes.mesh_io import MESH_FORMATS, read_mesh
from shapespace.types import FloatArray, Mesh

MODES = np.array([[2, 1.0], [3, 0.0], [4, 1.5]])
STDDEV = np.array([0.08, 0.05, 0.03])


def outline(b: FloatArray, at: FloatArray, dimensions: int) -> FloatArray:
    """Return points of a leaf-like closed curve; b are the amplitudes of three modes of its radius."""
    radius = 1 + 0.25 * np.cos(2 * at) + 0.12 * np.cos(3 * at + 0.4) + 0.05 * np.cos(5 * at)
    radius = radius + sum(amount * np.cos(n * at + phase) for amount, (n, phase) in zip(b, MODES, strict=True))
    plane = np.stack([1.6 * radius * np.cos(at), radius * np.sin(at)], axis=1)
    return np.column_stack([plane, 0.3 * np.sin(2 * at) + 0.2 * np.cos(at) ** 2])[:, :dimensions]


def arch(b: FloatArray, at: FloatArray, dimensions: int) -> FloatArray:
    """Return points of an open curve without symmetry, for `at` from 0 to 1."""
    t = np.clip(at, 0, 1) * 3
    x = np.stack([t + b[0] * np.sin(t), t**1.5 * (0.4 + b[1]) + b[2] * np.cos(2 * t), 0.3 * np.sin(2 * t)], axis=1)
    return x[:, :dimensions]


def posed(x: FloatArray, rng: np.random.Generator) -> FloatArray:
    Q, R = np.linalg.qr(rng.normal(size=(x.shape[1], x.shape[1])))
    Q = Q * np.sign(np.diag(R))
    Q[:, 0] *= np.linalg.det(Q)
    return rng.uniform(50, 200) * x @ Q.T + rng.normal(size=x.shape[1]) * 500


def tps(parts: list[tuple[FloatArray, list[FloatArray], list[FloatArray]]]) -> str:
    lines = list[str]()
    for k, (landmarks, curves, outlines) in enumerate(parts):
        n = "3" * (np.concatenate([landmarks, *curves, *outlines]).shape[1] == 3)
        lines.append(f"LM{n}={len(landmarks)}")
        rows = [" ".join(map(repr, p)) for p in landmarks.tolist()]
        for key, listed in (("CURVES", curves), ("OUTLINES", outlines)):
            rows += [f"{key}={len(listed)}"] if listed else []
            for x in listed:
                rows += [f"POINTS{n}={len(x)}", *(" ".join(map(repr, p)) for p in x.tolist())]
        lines += [*rows, f"ID=s{k}"]
    return "\n".join(lines) + "\n"


def outlines_in_file(dimensions: int, coefficients: FloatArray, seed: int = 0) -> tuple[str, FloatArray]:
    """Return TPS of outlines with random starts, directions, poses and numbers of points; and who is reversed."""
    rng = np.random.default_rng(seed)
    is_reversed, parts = (
        rng.random(len(coefficients)) < 0.3,
        list[tuple[FloatArray, list[FloatArray], list[FloatArray]]](),
    )
    for b, reverse in zip(coefficients, is_reversed, strict=True):
        at = np.linspace(0, 2 * np.pi, int(rng.integers(150, 400)), endpoint=False) + rng.uniform(0, 2 * np.pi)
        x = posed(outline(b, at[::-1] if reverse else at, dimensions), rng)
        parts.append((np.zeros((0, dimensions)), [], [x]))
    return tps(parts), is_reversed


def residuals(aligned: AlignedLandmarks) -> FloatArray:
    return np.linalg.norm(aligned.coords - aligned.mean, axis=(1, 2))


@pytest.mark.parametrize("slide_by", ["bending-energy", "procrustes"])
@pytest.mark.parametrize("dimensions", [2, 3])
def test_one_outline_from_any_start_and_direction_aligns_to_itself(dimensions: int, slide_by: str, write) -> None:
    text, is_reversed = outlines_in_file(dimensions, np.zeros((20, 3)))
    raw = read_configurations(write("a.tps", text))
    assert raw.points.shape == (20, 100, dimensions) and raw.curves == ((tuple(range(100)), True),)
    aligned = align_landmarks(raw, AlignConfig(slide_by=slide_by))  # type: ignore[arg-type]
    # The polygons of 150 to 400 points differ from the curve by 2e-4 of the size.
    assert residuals(aligned).max() < 5e-4 and (aligned.converged or slide_by == "bending-energy")
    kept = align_landmarks(raw, AlignConfig(slide_by="procrustes", match_curves=False))
    assert residuals(kept).max() > 0.3
    [note] = [note for note in aligned.notes if "opposite direction" in note]
    named = [f"s{k}" in note.replace(";", " ").split() for k in range(20)]
    fewer = is_reversed if is_reversed.sum() < 10 else ~is_reversed
    assert all(fewer[k] for k in range(20) if named[k]) and sum(named) >= min(3, fewer.sum())


@pytest.mark.parametrize("dimensions", [2, 3])
def test_principal_components_of_outlines_are_the_simulated_modes(dimensions: int, write) -> None:
    b = np.random.default_rng(1).normal(size=(60, 3)) * STDDEV
    text, _ = outlines_in_file(dimensions, b, seed=2)
    aligned = align_landmarks(read_configurations(write("a.tps", text)))
    U, S, _ = np.linalg.svd((aligned.coords - aligned.mean).reshape(60, -1), full_matrices=False)
    assert (S[:3] ** 2).sum() > 0.9 * (S**2).sum()
    scores = U[:, :3] * S[:3]
    # Shapes of unit size are no linear functions of the amplitudes.
    terms = np.column_stack([np.ones(60), scores, scores**2])
    left = b - terms @ np.linalg.lstsq(terms, b, rcond=None)[0]
    assert (1 - left.var(axis=0) / b.var(axis=0) > 0.95).all()


def test_points_of_an_outline_without_landmarks_do_not_drift_around_it(write) -> None:
    rng = np.random.default_rng(3)
    at = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    ellipses = [
        np.stack([1.3 * np.cos(at), np.sin(at)], axis=1) + rng.normal(scale=0.005, size=(60, 2)) for _ in range(8)
    ]
    raw = read_configurations(write("a.tps", tps([(np.zeros((0, 2)), [], [x]) for x in ellipses])))
    still = align_landmarks(raw, AlignConfig(iterations=1))
    assert (residuals(align_landmarks(raw)) <= 1.05 * residuals(still)).all()
    # Affine movements have no bending energy, so that it lets them add up.
    assert residuals(align_landmarks(raw, AlignConfig(slide_by="bending-energy"))).mean() > 2 * residuals(still).mean()


@pytest.mark.parametrize("dimensions", [2, 3])
def test_open_curves_are_resampled_and_reversed_where_digitised_backwards(dimensions: int, write) -> None:
    rng, parts = np.random.default_rng(4), list[tuple[FloatArray, list[FloatArray], list[FloatArray]]]()
    backwards = {2, 5, 6}
    for k in range(10):
        at = np.linspace(0, 1, int(rng.integers(40, 90)))
        landmarks = np.array([[1.5, 3, 1], [0, 2, -1]])[:, :dimensions]
        both = posed(np.concatenate([landmarks, arch(0.05 * rng.normal(size=3), at, dimensions)]), rng)
        curve = both[2:][::-1] if k in backwards else both[2:]
        parts.append((both[:2], [curve], []))
    path = write("a.tps", tps(parts))
    raw = read_configurations(path)
    assert raw.points.shape[1] == 2 + min(len(curves[0]) for _, curves, _ in parts)
    np.testing.assert_allclose(raw.points[:, -1], [curves[0][-1] for _, curves, _ in parts], rtol=1e-12)
    gaps = np.linalg.norm(np.diff(raw.points[:, 2:], axis=1), axis=2)
    assert (gaps.std(axis=1) < 0.02 * gaps.mean(axis=1)).all()
    matched = match_curves(raw)
    for k, (_, [curve], _) in enumerate(parts):
        np.testing.assert_allclose(
            matched.points[k, [2, -1]], curve[[-1, 0] if k in backwards else [0, -1]], rtol=1e-12
        )
    assert any("s2; s5; s6" in note for note in matched.notes)
    assert (
        residuals(align_landmarks(raw)).max()
        < 0.2
        < residuals(align_landmarks(raw, AlignConfig(match_curves=False))).max()
    )
    finer = read_configurations(path, curve_points=30)
    assert finer.points.shape[1] == 32 and len(finer.curve_sliders) == 28


def test_a_curve_that_fits_as_well_backwards_keeps_its_direction() -> None:
    rng, at = np.random.default_rng(5), np.linspace(-1, 1, 21)
    points = np.stack([np.stack([at, at**2, 0 * at], axis=1) + rng.normal(scale=0.02, size=(21, 3)) for _ in range(12)])
    raw = LandmarkConfigurations(names=tuple("abcdefghijkl"), points=points, curves=((tuple(range(21)), False),))
    np.testing.assert_array_equal(match_curves(raw).points, points)


def test_outlines_beside_landmarks_are_closed_curves(write) -> None:
    rng, parts = np.random.default_rng(6), list[tuple[FloatArray, list[FloatArray], list[FloatArray]]]()
    for _ in range(6):
        start = rng.uniform(0, 2 * np.pi)
        at = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        inner = 0.2 * np.stack([np.cos(at + start), np.sin(at + start)], axis=1) + (0.5, 0.3)
        both = posed(np.concatenate([[[0, 0], [1, 0.2], [0.3, 0.8]], outline(np.zeros(3), at + start, 2), inner]), rng)
        parts.append((both[:3], [], [both[3:203], both[203:]]))
    raw = read_configurations(write("a.tps", tps(parts)))
    assert raw.points.shape == (6, 203, 2) and [closed for _, closed in raw.curves] == [True, True]
    assert residuals(align_landmarks(raw)).max() < 1e-3
    other = tps([parts[0], (parts[1][0], [], parts[1][2][:1])])
    assert "has 3 landmarks, curves of [200 (closed)] points" in refusal_of(read_configurations, write("b.tps", other))


def markup(points: FloatArray, label: str, kind: str) -> dict[str, object]:
    controls = [{"label": f"{label}{k}", "position": point} for k, point in enumerate(points.tolist(), 1)]
    return {"type": kind, "coordinateSystem": "LPS", "controlPoints": controls}


def save(path: Path, *markups: dict[str, object]) -> None:
    path.write_text(json.dumps({"markups": markups}))


def test_curves_of_slicer_with_other_numbers_of_points_and_default_names_are_matched(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    for k in range(5):
        at = np.linspace(0, 2 * np.pi, 150 + 10 * k, endpoint=False) + rng.uniform(0, 2 * np.pi)
        both = posed(
            np.concatenate([np.eye(3), arch(np.zeros(3), np.linspace(0, 1, 60 + k), 3), outline(np.zeros(3), at, 3)]),
            rng,
        )
        n = 3 + 60 + k
        save(
            tmp_path / f"s{k}.mrk.json", markup(both[n:], f"CC_{k}-", "ClosedCurve"),
            markup(both[:3], f"F_{k}-", "Fiducial"), markup(both[3:n], "C-" if k else "OC-", "Curve"),
        )  # fmt: skip
    raw = read_configurations(tmp_path)
    assert raw.points.shape == (5, 3 + 100 + 60, 3) and raw.landmarks[:4] == ("F_0-1", "F_0-2", "F_0-3", "CC_0-1")
    assert [(len(at), closed) for at, closed in raw.curves] == [(100, True), (60, False)]
    [note] = [note for note in raw.notes if "matched by number" in note]
    assert "s1.mrk.json, s2.mrk.json, s3.mrk.json, ..." in note and "by their order" in note
    assert residuals(align_landmarks(raw)).max() < 1e-3


@pytest.mark.parametrize("names", [
    ("{}_landmarks", "{}_curve"), ("{}", "{} curve"), ("points-{}", "curve-{}"), ("{}.F", "{}.C"),
])  # fmt: skip
@pytest.mark.parametrize("stem", ["s{}", "case_{}", "{}"])
def test_files_of_one_specimen_are_joined_however_they_are_called(
    names: tuple[str, str], stem: str, tmp_path: Path
) -> None:
    rng = np.random.default_rng(11)
    expected: dict[str, FloatArray] = {}
    for k in range(3):
        points, curve = rng.normal(size=(4, 3)), rng.normal(size=(5, 3))
        name = stem.format(k)
        save(tmp_path / f"{names[0].format(name)}.mrk.json", markup(points, "F-", "Fiducial"))
        save(tmp_path / f"{names[1].format(name)}.mrk.json", markup(curve, "F-", "Curve"))
        expected[name] = np.concatenate([points, curve])
    found = read_configurations(tmp_path)
    assert set(found.names) == set(expected) and [len(at) for at, _ in found.curves] == [5]
    for name, points in zip(found.names, found.points, strict=True):
        np.testing.assert_array_equal(points, expected[name])


def test_curves_of_several_sides_are_specimens_of_their_own(tmp_path: Path) -> None:
    for name in ("a_left", "a_right", "b_left", "b_right"):
        save(tmp_path / f"{name}.mrk.json", markup(np.random.default_rng(12).normal(size=(4, 3)), "C-", "Curve"))
    assert read_configurations(tmp_path).names == ("a_left", "a_right", "b_left", "b_right")


def test_lines_of_obj_are_named(write) -> None:
    assert any("lines (l)" in note for note in read_mesh(write("a.obj", "v 1 2 3\nv 4 5 6\nl 1 2\n")).notes)


def test_curves_of_one_name_are_the_same_in_any_order(tmp_path: Path) -> None:
    ridge, rim = (np.random.default_rng(k).normal(size=(6, 3)) for k in (8, 9))
    save(tmp_path / "a.mrk.json", markup(ridge, "ridge-", "Curve"), markup(rim, "rim-", "Curve"))
    save(tmp_path / "b.mrk.json", markup(rim[:5], "rim-", "Curve"), markup(ridge, "ridge-", "Curve"))
    found = read_configurations(tmp_path)
    assert found.landmarks == (*(f"ridge-{k}" for k in range(1, 7)), *(f"rim-{k}" for k in range(1, 6)))
    np.testing.assert_array_equal(found.points[:, :6], [ridge, ridge])
    np.testing.assert_allclose(found.points[1, 6:], rim[:5], rtol=0, atol=2)
    assert not any("matched by number" in note for note in found.notes)


def test_labels_that_share_a_prefix_in_another_order_are_no_default_labels(tmp_path: Path) -> None:
    save(tmp_path / "a.mrk.json", markup(np.eye(3), "eye-", "Fiducial"), markup(2 * np.eye(3), "ear-", "Fiducial"))
    save(tmp_path / "b.mrk.json", markup(np.eye(3), "ear-", "Fiducial"), markup(2 * np.eye(3), "mouth-", "Fiducial"))
    assert "same landmarks to all files" in refusal_of(read_configurations, tmp_path)


def vtk_lines(points: FloatArray, cells: list[list[int]]) -> str:
    rows = "\n".join(" ".join(map(repr, p)) for p in points.tolist())
    lines = "\n".join(" ".join(map(str, [len(cell), *cell])) for cell in cells)
    size = sum(len(cell) + 1 for cell in cells)
    return (
        f"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS {len(points)} double\n{rows}\n"
        f"LINES {len(cells)} {size}\n{lines}\n"
    )


def vtp_lines(points: FloatArray, cells: list[list[int]]) -> str:
    corners, ends = " ".join(str(i) for cell in cells for i in cell), np.cumsum([len(cell) for cell in cells])
    return (
        '<VTKFile type="PolyData"><PolyData>'
        f'<Piece NumberOfPoints="{len(points)}" NumberOfLines="{len(cells)}"><Points>'
        f'<DataArray type="Float64" format="ascii">{" ".join(map(repr, points.ravel().tolist()))}</DataArray></Points>'
        f'<Lines><DataArray type="Int64" Name="connectivity" format="ascii">{corners}</DataArray>'
        f'<DataArray type="Int64" Name="offsets" format="ascii">{" ".join(map(str, ends))}</DataArray></Lines>'
        "</Piece></PolyData></VTKFile>"
    )


SQUARE = np.array([[1.0, 2, 3], [4, 2, 3], [4, 6, 3], [1, 6, 3], [9, 9, 9], [8, 9, 9], [8, 8, 9]])


@pytest.mark.parametrize("text", [vtk_lines, vtp_lines])
@pytest.mark.parametrize("cells", [
    [[0, 1, 2, 3, 0], [4, 5, 6]], [[1, 2], [0, 1], [2, 3], [0, 3], [6, 5], [4, 5]], [[0, 1, 2], [0, 3, 2], [4, 5, 6]],
])  # fmt: skip
def test_lines_of_vtk_are_curves_of_their_joined_cells(text, cells: list[list[int]], write) -> None:
    path = write("a.vtk" if text is vtk_lines else "a.vtp", text(SQUARE, cells))
    found = read_configurations(path)
    assert [(len(at), closed) for at, closed in found.curves] == [(4, True), (3, False)] and is_configurations(path)
    ring = found.points[0, :4].tolist()
    assert {tuple(p) for p in ring} == {tuple(p) for p in SQUARE[:4].tolist()}
    np.testing.assert_allclose(np.linalg.norm(np.diff([*ring, ring[0]], axis=0), axis=1) % 1, 0, atol=1e-12)
    assert found.points[0, 4:].tolist() in (SQUARE[4:].tolist(), SQUARE[:3:-1].tolist())
    mesh = read_mesh(path)
    assert mesh.faces is None and [note for note in mesh.notes if "lines" in note]
    np.testing.assert_array_equal(mesh.vertices, SQUARE)


def test_a_folder_of_lines_is_a_cohort_of_curves_and_one_of_surfaces_is_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(10)
    for k in range(4):
        at = np.linspace(0, 2 * np.pi, 120 + k, endpoint=False) + rng.uniform(0, 2 * np.pi)
        (tmp_path / f"s{k}.vtk").write_text(vtk_lines(posed(outline(np.zeros(3), at, 3), rng), [[*range(120 + k), 0]]))
    assert is_configurations(tmp_path) and has_landmarks(tmp_path)
    found = read_configurations(tmp_path)
    assert found.names == ("s0", "s1", "s2", "s3") and found.points.shape == (4, 100, 3)
    assert residuals(align_landmarks(found)).max() < 2e-3
    surface = Mesh(SQUARE[:3], np.array([[0, 1, 2]], dtype=np.int32))
    (tmp_path / "z.vtk").write_bytes(MESH_FORMATS[".vtk"].write(surface))
    assert not has_landmarks(tmp_path)
    assert "it has no lines" in refusal_of(read_configurations, tmp_path / "z.vtk")


def test_the_mark_of_the_frame_holds_for_lines(write) -> None:
    text = vtk_lines(SQUARE, [[0, 1, 2]]).replace("\na\n", "\nSPACE=RAS\n")
    found = read_configurations(write("a.vtk", text))
    np.testing.assert_array_equal(found.points[0], SQUARE[:3] * (-1, -1, 1))
    assert any("RAS" in note for note in found.notes)


def test_sliders_of_the_user_replace_those_of_curves(write) -> None:
    x = outline(np.zeros(3), np.linspace(0, 6, 30), 2)
    path = write("a.tps", tps([(np.zeros((0, 2)), [], [x]), (np.zeros((0, 2)), [], [x[::-1]])]))
    found = read_configurations(path, sliders=[write("s.csv", "before,slide,after\n1,2,3\n")])
    assert found.curves == () and found.curve_sliders.tolist() == [[0, 1, 2]]
    np.testing.assert_array_equal(replace(found, notes=()).points[0], x)


def test_figures_draw_the_lines_of_curves_unless_links_are_given(tmp_path: Path) -> None:
    x = outline(np.zeros(3), np.linspace(0, 6, 5), 2)
    text = tps([(np.eye(2), [x[:3]], [posed(x, np.random.default_rng(k))]) for k in range(3)])
    (tmp_path / "a.tps").write_text(text)
    raw = read_configurations(tmp_path / "a.tps")
    assert raw.curve_links == ((3, 4), (4, 5), (6, 7), (7, 8), (8, 9), (9, 10), (10, 6))
    align(tmp_path / "a.tps", tmp_path / "out", curve_points=4)
    assert json.loads((tmp_path / "out" / "orientation.json").read_text())["links"][-1] == [10, 7]
    (tmp_path / "links.csv").write_text("1,2\n")
    align(tmp_path / "a.tps", tmp_path / "out")
    assert json.loads((tmp_path / "out" / "orientation.json").read_text())["links"] == [[1, 2]]
