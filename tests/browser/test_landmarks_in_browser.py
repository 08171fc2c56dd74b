"""Landmarks on raw scans: placed by clicks, moved by drags and keys, imported, and used by the correspondence."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from test_studio_in_browser import WINDOW, User, barriers, studio, write_bones

from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.normals import rms_size
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import FloatArray, Mesh

VIEW = "[...window.Shapespace.sceneParts.views][0]"
MOST_SHARE = 0.001  # of the size, between a landmark and its place


def stored(project: Path, name: str) -> dict[str, FloatArray]:
    specimens = json.loads((project / "project.json").read_text())["specimens"]
    return {key: np.array(at) for one in specimens if one["id"] == name for key, at in one.get("points", {}).items()}


def placed(tab, project: Path, name: str, mark: str, before: Any = None, seconds: float = 30.0) -> FloatArray:
    """Return where a landmark is once it is stored, and is no longer where it was `before`."""
    end = time.monotonic() + seconds
    while (at := stored(project, name).get(mark)) is None or (before is not None and np.array_equal(at, before)):
        assert time.monotonic() < end, stored(project, name)
        tab.page.wait_for_timeout(50)
    return at


def open_scan(tab, name: str) -> None:
    tab.page.get_by_test_id(f"show-{name}").click()
    tab.until("document.querySelector('[data-testid=scan-view]')?.dataset.ready === 'true'")
    tab.page.get_by_test_id("marks").wait_for()
    tab.until(f"{VIEW}.rests && {VIEW}.frames > 0")


def close_scan(tab) -> None:
    tab.page.get_by_test_id("scan-close").click()
    tab.page.get_by_test_id("scan-view").wait_for(state="detached")


def project_points(tab, points: FloatArray) -> FloatArray:
    """Return (n, 3) pixels in the window, and the distance behind the middle of the scan, of points in the view."""
    at = np.array(tab.page.evaluate(f"(points) => points.map((point) => {VIEW}.project(point))", points.tolist()))
    corner = tab.page.evaluate(
        f"(() => {{ const b = {VIEW}.canvas.getBoundingClientRect(); return [b.left, b.top, 0]; }})()"
    )
    return at + np.array(corner)


def check_at_pixel(tab, mesh: Mesh, point: FloatArray, pixel: Sequence[float], *, mirrored: bool = False) -> None:
    """Check that a landmark is the point of the scan that is seen at a pixel: on it, at the pixel, and in front."""
    size, flip = rms_size(mesh.vertices), np.array([-1.0 if mirrored else 1.0, 1.0, 1.0])
    assert place_landmarks(mesh, {"point": point}).distance_mm[0] < MOST_SHARE * size
    own, above, *others = project_points(tab, np.array([point, point + np.eye(3)[1], *mesh.vertices]) * flip)
    mm_per_pixel = 1.0 / np.hypot(*(above - own)[:2])
    assert np.hypot(*(own[:2] - pixel)) * mm_per_pixel < MOST_SHARE * size
    near = [other for other in others if np.hypot(*(other - own)[:2]) < 12]
    assert near and own[2] < min(other[2] for other in near) + 0.2 * size


def test_landmarks_are_placed_by_clicks_drags_keys_and_files(open_tab, tmp_path: Path) -> None:
    bones = write_bones(tmp_path / "scans", 3)
    meshes = {path.stem: read_mesh(path) for path in sorted(bones.glob("*.ply"))}
    project = tmp_path / "p"
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        user.sees("drop-zone")
        tab.page.get_by_test_id("choose-files-input").set_input_files(sorted(bones.glob("*.ply")))
        tab.until("document.querySelectorAll('[data-testid^=card-] img').length === 3")
        assert tab.page.get_by_test_id("placed-bone_000").count() == 0
        open_scan(tab, "bone_000")
        for name in ("head", "shaft", "foot"):
            tab.page.get_by_test_id("mark-name").fill(name)
            tab.page.get_by_test_id("mark-name").press("Enter")
            tab.page.get_by_test_id(f"mark-{name}").wait_for()
        tab.page.get_by_test_id("mark-head").click()
        scan = meshes["bone_000"]
        middle, low, high = project_points(
            tab, np.stack([scan.vertices.mean(axis=0), scan.vertices.min(axis=0), scan.vertices.max(axis=0)])
        )
        x, ys = round(middle[0]), [round(low[1] + share * (high[1] - low[1])) for share in (0.5, 0.35, 0.2)]
        for name, y in zip(("head", "shaft", "foot"), ys, strict=True):
            tab.page.mouse.click(x, y)
            check_at_pixel(tab, scan, placed(tab, project, "bone_000", name), (x, y))
        tab.until("document.querySelector('[data-testid=marks-count]').innerText === '3 of 3 placed'")
        tab.shot("landmarks")
        assert barriers(tab) == []
        # A drag moves, a click on the mark only chooses it.
        before = placed(tab, project, "bone_000", "shaft")
        tab.page.mouse.click(x, ys[1])
        tab.until("document.querySelector('[data-testid=mark-shaft]').getAttribute('aria-pressed') === 'true'")
        tab.page.mouse.move(x, ys[1])
        tab.page.mouse.down()
        tab.page.mouse.move(x, ys[1] + 12, steps=4)
        tab.page.mouse.up()
        moved = placed(tab, project, "bone_000", "shaft", before)
        check_at_pixel(tab, scan, moved, (x, ys[1] + 12))
        # Keys: an arrow moves it by a step, a typed number places it.
        tab.page.get_by_test_id("mark-z").press("ArrowUp")
        nudged = placed(tab, project, "bone_000", "shaft", moved)
        step = np.ptp(scan.vertices, axis=0).max() / 500
        assert np.allclose(nudged - moved, [0, 0, step], atol=1e-4 * step)
        tab.page.get_by_test_id("mark-undo").click()
        assert np.array_equal(placed(tab, project, "bone_000", "shaft", nudged), moved)
        tab.until(f"Number(document.querySelector('[data-testid=mark-z]').value) === {moved[2]}")
        tab.page.get_by_test_id("mark-x").fill("1,5")
        tab.page.get_by_test_id("mark-x").press("Enter")
        typed = placed(tab, project, "bone_000", "shaft", moved)
        assert typed[0] == 1.5
        tab.page.get_by_test_id("mark-undo").click()
        assert np.array_equal(placed(tab, project, "bone_000", "shaft", typed), moved)
        tab.until(f"Number(document.querySelector('[data-testid=mark-x]').value) === {moved[0]}")
        tab.page.get_by_test_id("mark-remove").click()
        tab.until("document.querySelector('[data-testid=mark-x]').value === ''")
        for axis, value in zip("xyz", moved, strict=True):
            tab.page.get_by_test_id(f"mark-{axis}").fill(str(value))
        tab.page.keyboard.press("Tab")
        assert np.array_equal(placed(tab, project, "bone_000", "shaft"), moved)
        tab.until("document.querySelector('[data-testid=marks-count]').innerText === '3 of 3 placed'")
        tab.page.get_by_test_id("mark-z").press("ArrowDown")
        tab.page.get_by_test_id("mark-z").press("ArrowDown")
        tab.page.get_by_test_id("mark-z").press("ArrowUp")
        tab.page.get_by_test_id("mark-z").press("ArrowUp")
        tab.until(f"Number(document.querySelector('[data-testid=mark-z]').value) === {moved[2]}")
        end = time.monotonic() + 30
        while not np.allclose(stored(project, "bone_000")["shaft"], moved, rtol=0, atol=1e-3 * step):
            assert time.monotonic() < end, stored(project, "bone_000")
            tab.page.wait_for_timeout(50)
        tab.page.get_by_test_id("mark-remove").click()
        close_scan(tab)
        tab.until("document.querySelector('[data-testid=placed-bone_000]').innerText === '2 of 3 landmarks'")
        tab.page.get_by_test_id("undo").click()
        tab.until("document.querySelector('[data-testid=placed-bone_000]').innerText === '3 of 3 landmarks'")
        # A mirrored scan is seen as its mirror image; the landmark is stored on the scan as it is in its file.
        tab.page.get_by_test_id("select-bone_001").click()
        tab.page.get_by_test_id("mirror-selected").click()
        tab.page.get_by_test_id("card-bone_001").get_by_text("mirrored").wait_for()
        open_scan(tab, "bone_001")
        middle = project_points(tab, meshes["bone_001"].vertices.mean(axis=0)[None] * [-1.0, 1.0, 1.0])[0]
        pixel = [round(value) for value in middle[:2].tolist()]
        tab.page.mouse.click(*pixel)
        check_at_pixel(tab, meshes["bone_001"], placed(tab, project, "bone_001", "head"), pixel, mirrored=True)
        close_scan(tab)
        # A file has the same points as the clicks, and a broken one and one of no specimen are named.
        write_landmarks(tmp_path / "bone_002.mrk.json", stored(project, "bone_000"))
        (tmp_path / "zoe.fcsv").write_text("# CoordinateSystem = LPS\n1,0,0,0,0,0,0,1,1,1,0,head,,\n")
        (tmp_path / "bone_001.tps").write_text("LM3=3\n1 2 3\n")
        tab.page.get_by_test_id("choose-files-input").set_input_files(
            [tmp_path / "bone_002.mrk.json", tmp_path / "zoe.fcsv", tmp_path / "bone_001.tps"]
        )
        tab.until("document.querySelectorAll('[data-testid=upload-notes] li').length === 4")
        notes = tab.page.get_by_test_id("upload-notes").locator("li").all_text_contents()
        assert any("contains no specimen of zoe.fcsv" in note for note in notes)
        assert any("bone_001.tps" in note for note in notes)
        assert "bone_002.mrk.json: 3 landmarks of 1 specimen read." in notes
        assert any("bone_002: not on its scan" in note for note in notes)  # they are of another scan
        for name, point in stored(project, "bone_000").items():
            assert np.array_equal(stored(project, "bone_002")[name], point)
        tab.shot("landmarks-cards")
        # The export is a command of the history.
        tab.page.get_by_test_id("landmarks-all").click()
        tab.page.get_by_test_id("option--to").select_option("tps")
        tab.page.get_by_test_id("run-landmarks").click()
        tab.page.get_by_test_id("landmarks-download").wait_for()
        tab.shot("landmarks-export")
        assert barriers(tab) == []
        with tab.page.expect_download() as download:
            tab.page.get_by_test_id("landmarks-download").click()
        download.value.save_as(tmp_path / "out.tps")
        read = read_configurations(tmp_path / "out.tps")
        assert read.names == ("bone_000", "bone_001", "bone_002")
        assert np.array_equal(
            read.points[0], np.stack([stored(project, "bone_000")[name] for name in ("head", "shaft", "foot")])
        )
        history = (project / "history.sh").read_text()
        assert 'landmarks convert "$PROJECT"/inputs/0001-landmarks.csv -o landmarks-1.tps --to=tps' in history
        assert len(tab.complaints) == 2 and all("422" in one for one in tab.complaints)  # of the two files
        assert tab.asked == []
