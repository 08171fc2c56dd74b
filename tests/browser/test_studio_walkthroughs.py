"""The two studies of docs/studio.md, as a new user completes them by clicks; their screens are the pictures there."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from pictures import same_as_kept
from test_landmarks_in_browser import VIEW, close_scan, open_scan, placed, project_points
from test_studio_in_browser import WINDOW, User, has_drawn, studio, write_bones

from shapespace.cli import main
from shapespace.datasets.bones import EFFECT_MM, Bone
from shapespace.datasets.organs import raw_surface
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray

PLACES = {
    "snout": (0.0, -0.1, 1.0),
    "crest": (0.0, 1.0, -0.45),
    "left arch": (0.9, -0.15, 0.2),
    "right arch": (-0.9, -0.15, 0.2),
}
"""Name of a landmark -> its direction from the middle of a skull, see `shapespace.datasets.bones`."""


@dataclass(frozen=True)
class Spiked:
    """A skull with a spike in one direction, by which the vertex of its scan there is found."""

    bone: Bone
    direction: FloatArray

    def surface(self, directions: FloatArray) -> FloatArray:
        return self.bone.surface(directions) * (1.0 + (directions @ self.direction > 0.995))[:, None]


def landmark_points(number: int) -> dict[str, FloatArray]:
    """Return name -> place of each landmark on the scan of a skull of `write_bones`."""
    bone = Bone.draw(np.random.default_rng([0, number]), EFFECT_MM * (number % 2))
    plain = raw_surface(bone, np.random.default_rng([0, number, 1]), 2500).vertices
    points = {}
    for name, direction in PLACES.items():
        spiked = Spiked(bone, np.array(direction) / np.linalg.norm(direction))
        moved = raw_surface(spiked, np.random.default_rng([0, number, 1]), 2500).vertices - plain
        on_spike = np.linalg.norm(moved, axis=1) > 5.0
        points[name] = plain[on_spike].mean(axis=0)
    return points


def place_by_clicks(tab, project: Path, scan: Path, number: int) -> None:
    """Turn each landmark to the front and click it."""
    open_scan(tab, scan.stem)
    middle = read_mesh(scan).vertices.mean(axis=0)
    for name, point in landmark_points(number).items():
        if tab.page.get_by_test_id(f"mark-{name}").count() == 0:
            tab.page.get_by_test_id("mark-name").fill(name)
            tab.page.get_by_test_id("mark-name").press("Enter")
        tab.page.get_by_test_id(f"mark-{name}").click()
        x, y, z = (point - middle) / np.linalg.norm(point - middle)
        tab.page.evaluate(
            f"(camera) => {{ {VIEW}.camera = camera; }}", {"yaw": np.arctan2(x, z), "pitch": np.arcsin(y)}
        )
        tab.until(f"{VIEW}.rests")
        tab.page.mouse.click(*project_points(tab, point[None])[0, :2])
        assert np.linalg.norm(placed(tab, project, scan.stem, name) - point) < 2.0  # mm, as exact as a user clicks


@pytest.mark.long
def test_a_study_with_landmarks(open_tab, tmp_path: Path) -> None:
    bones = write_bones(tmp_path / "scans", 8)
    scans, project = sorted(bones.glob("*.ply")), tmp_path / "landmarks"
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        user.sees("drop-zone")
        tab.page.get_by_test_id("choose-files-input").set_input_files([*scans, bones / "bones.csv"])
        tab.until("document.querySelectorAll('[data-testid^=card-] img').length === 8")
        for number, scan in enumerate(scans[:4]):
            place_by_clicks(tab, project, scan, number)
            if scan is scans[3]:
                tab.until("document.querySelector('[data-testid=marks-count]').innerText === '4 of 4 placed'")
                tab.page.wait_for_timeout(500)
                same_as_kept("screen-landmarks.png", tab.shot("placed"), width=1200)
            close_scan(tab)
        user.click("next")
        tab.page.get_by_test_id("option--vertices").fill("800")
        user.click("run-correspond")
        user.has_run(1)
        user.click("next")
        user.click("run-build")
        user.has_run(2)
        has_drawn(tab)
        tab.page.get_by_test_id("landmarks").check()
        tab.page.get_by_test_id("mode-1").evaluate("(e) => { e.value = 2; e.dispatchEvent(new Event('input')); }")
        tab.page.wait_for_timeout(1000)
        same_as_kept("screen-model.png", tab.shot("model"), width=1200)
        user.click("next")
        user.click("question-compare")
        user.click("term-group")
        user.click("run-compare")
        user.has_run(3)
        user.sees("sentences")
        tab.page.get_by_test_id("tab-export").click()
        user.click("write-report")
        user.has_run(4)
        assert tab.complaints == []
    model = ShapeModel.load(project / "model-2.h5")
    assert set(model.landmarks) == set(PLACES) and model.n_modes == 7  # of all 8 scans
    report = (project / "report-4" / "report.html").read_text(encoding="utf-8")
    assert "bone_007" in report and "group" in report
    assert json.loads((project / "jobs" / "0004" / "exit.json").read_text())["code"] == 0


@pytest.mark.long
def test_a_study_from_label_volumes(open_tab, tmp_path: Path) -> None:
    masks, project = tmp_path / "masks", tmp_path / "organs"
    assert main(["data", "organs", "-o", str(masks), "--count", "12", "--volumes", "--quiet"]) == 0
    *volumes, new = sorted(masks.glob("*.nii.gz"))
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        user.sees("drop-zone")
        tab.page.get_by_test_id("choose-files-input").set_input_files(volumes)
        tab.page.get_by_test_id("volumes").get_by_text("11 surfaces will be added").wait_for()
        same_as_kept("screen-volumes.png", tab.shot("labels"), width=1200)
        user.click("volumes-make")
        tab.until("document.querySelectorAll('[data-testid^=card-] img').length === 11", 180)
        same_as_kept(
            "screen-surfaces.png", tab.shot("surfaces", clip={"x": 0, "y": 0, "width": 1440, "height": 560}), width=1200
        )
        user.click("next")
        tab.page.get_by_test_id("option--vertices").fill("800")
        user.click("run-correspond")
        user.has_run(2)
        user.click("next")
        tab.page.get_by_test_id("form-build").get_by_test_id("option--gauge").select_option("form")
        user.click("run-build")
        user.has_run(3)
        user.click("next")
        user.click("question-allometry")
        user.click("run-allometry")
        user.has_run(4)
        user.sees("sentences")
        tab.page.get_by_test_id("tab-fit").click()
        tab.page.locator("[data-testid=screen-fit] input[type=file]").first.set_input_files(new)
        user.click("volumes-make")
        tab.page.get_by_test_id("new-scans").get_by_text("1 new scan").wait_for(timeout=120_000)
        user.click("run-fit")
        user.has_run(6)
        has_drawn(tab)
        same_as_kept("screen-fit.png", tab.shot("fit"), width=1200)
        assert tab.complaints == []
    record = json.loads(next((project / "fits-6").glob("*.fit.json")).read_text(encoding="utf-8"))
    assert record["status"] in ("converged", "doubtful") and ShapeModel.load(project / "model-3.h5").n_modes == 10
