"""Questions about landmarks and curves on raw scans, by clicks alone and without a correspondence."""

import json
from pathlib import Path

import numpy as np
from test_landmarks_in_browser import close_scan, open_scan, project_points, stored
from test_studio_in_browser import WINDOW, User, barriers, has_drawn, studio, write_bones

from shapespace.io.meshes.mesh_io import read_mesh

COUNT = 6
MARKS = ("left tip", "right tip", "left side", "right side", "left end", "right end")


def state_of(project: Path) -> dict[str, object]:
    return json.loads((project / "project.json").read_text())


def test_a_question_about_landmarks_and_a_curve_on_scans(open_tab, tmp_path: Path) -> None:
    bones = write_bones(tmp_path / "scans", COUNT, degrees=20.0)
    scans = {path.stem: read_mesh(path).vertices for path in sorted(bones.glob("*.ply"))}
    rng, rows = np.random.default_rng(0), ["specimen,landmark,x,y,z"]
    directions = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
    for name, vertices in scans.items():
        places = [*zip(MARKS, vertices[np.argmax(vertices @ directions.T, axis=0)], strict=True)]
        if name != "bone_000":  # whose curve is clicked
            line = np.linspace(vertices.min(axis=0), vertices.mean(axis=0), 3) + rng.normal(size=3)
            places += [(f"ridge_{k}", point) for k, point in enumerate(line, 1)]
        rows += [f"{name},{mark},{x},{y},{z}" for mark, (x, y, z) in places]
    (tmp_path / "marks.csv").write_text("\n".join(rows))
    project = tmp_path / "p"
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        user.sees("drop-zone")
        tab.page.get_by_test_id("choose-files-input").set_input_files(
            [*sorted(bones.glob("*.ply")), bones / "bones.csv"]
        )
        tab.until(f"document.querySelectorAll('[data-testid^=card-] img').length === {COUNT}")
        # A curve by clicks, on one scan.
        open_scan(tab, "bone_000")
        tab.page.get_by_test_id("mark-name").fill("ridge")
        tab.page.get_by_test_id("mark-points").fill("3")
        tab.page.get_by_test_id("mark-add").click()
        tab.page.get_by_test_id("mark-ridge_3").wait_for()
        vertices = scans["bone_000"]
        middle, low, high = project_points(
            tab, np.stack([vertices.mean(axis=0), vertices.min(axis=0), vertices.max(axis=0)])
        )
        for k, share in enumerate((0.5, 0.4, 0.3), 1):
            tab.page.mouse.click(round(middle[0]), round(low[1] + share * (high[1] - low[1])))
            tab.until(f"document.querySelector('[data-testid=mark-ridge_{k}]').className === 'placed'")
        tab.shot("curve")
        assert barriers(tab) == []
        close_scan(tab)
        tab.page.get_by_test_id("choose-files-input").set_input_files([tmp_path / "marks.csv"])
        tab.until("document.querySelector('[data-testid=placed-bone_003]')?.innerText === '9 of 9 landmarks'")
        # Pairs by names, and another number of points.
        tab.page.get_by_test_id("landmarks-all").click()
        assert tab.page.get_by_test_id("pair-left tip").input_value() == "right tip"
        tab.page.get_by_test_id("pair-left end").select_option("")
        tab.until("document.querySelector('[data-testid=\"pair-right end\"]').value === ''")
        tab.page.get_by_test_id("pair-right end").select_option("left end")
        tab.until("document.querySelector('[data-testid=\"pair-left end\"]').value === 'right end'")
        tab.page.get_by_test_id("curve-points-ridge").fill("5")
        tab.page.get_by_test_id("curve-points-ridge").press("Enter")
        tab.until("window.ShapespaceStudio.state.project.point_names.length === 11")
        assert all(f"ridge_{k}" in stored(project, name) for name in scans for k in range(1, 6))
        tab.shot("landmarks-dialog")
        assert barriers(tab) == []
        tab.page.get_by_test_id("landmarks-close").click()
        # The question, with one specimen that lacks a landmark.
        open_scan(tab, "bone_005")
        tab.page.get_by_test_id("mark-left tip").click()
        tab.page.get_by_test_id("mark-remove").click()
        close_scan(tab)
        tab.page.get_by_test_id("tab-questions").click()
        user.click("question-compare")
        assert "Landmarks on the scans" in tab.page.get_by_test_id("of-placed").inner_text()
        user.click("term-group")
        tab.until("document.querySelector('[data-testid=checks]').innerText.includes('bone_005 1 of 11')")
        tab.shot("question-form")
        assert barriers(tab) == []
        tab.page.get_by_test_id("optionmissing-landmarks").select_option("estimate-by-spline")
        tab.until("document.querySelector('[data-testid=checks]').innerText.includes('Included specimens: 6')")
        user.click("run-compare")
        user.has_run(1)
        user.sees("sentences")
        has_drawn(tab)
        tab.shot("answer-of-landmarks")
        command = tab.page.evaluate("window.ShapespaceStudio.state.project.jobs[0].command")
        assert "align inputs/0001-landmarks/landmarks.csv" in command and "--missing=tps" in command
        # After an edit of a landmark the answer is marked.
        tab.page.get_by_test_id("tab-specimens").click()
        open_scan(tab, "bone_004")
        tab.page.get_by_test_id("mark-left tip").click()
        tab.page.get_by_test_id("mark-z").press("ArrowUp")
        close_scan(tab)
        tab.until("window.ShapespaceStudio.state.project.jobs[0].outdated === 'landmarks'")
        tab.page.get_by_test_id("tab-questions").click()
        user.click("earlier-1")
        user.sees("outdated-1")
        # A correspondence that still runs can be waited for.
        tab.page.get_by_test_id("tab-correspondence").click()
        tab.page.get_by_test_id("option--vertices").fill("300")
        user.click("run-correspond")
        user.has_run(2)
        tab.page.get_by_test_id("settings").locator("summary").first.click()
        user.click("run-correspond")
        tab.page.get_by_test_id("tab-model").click()
        user.sees("newer-runs")
        tab.page.get_by_test_id("wait").first.check()
        tab.shot("newer-runs")
        user.click("run-build")
        tab.until("window.ShapespaceStudio.state.project.jobs.length === 4")
        jobs = tab.page.evaluate("window.ShapespaceStudio.state.project.jobs")
        assert [(job["kind"], job["status"]) for job in jobs[1:]] == [
            ("correspond", "done"), ("correspond", "running"), ("build", "waiting")
        ]  # fmt: skip
        assert "build correspondence-3 -o" in jobs[3]["command"]
        for number in (4, 3):
            tab.page.evaluate(f"window.ShapespaceStudio.act('/api/jobs/{number}/cancel')")
        tab.until("window.ShapespaceStudio.state.project.jobs[2].status !== 'running'")
        assert tab.complaints == [] and tab.asked == []
