"""Label volumes and grooming by clicks: what a user drops, chooses and crops becomes a command and its result."""

import json
import time
from pathlib import Path

import nibabel
import numpy as np
from test_studio_in_browser import WINDOW, User, barriers, studio

from shapespace.datasets.bones import Bone
from shapespace.datasets.organs import raw_surface
from shapespace.geometry.grooming import Crop
from shapespace.geometry.normals import faces_of
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.types import Mesh
from shapespace.viewer.studio.project import Project, with_cells


def specimens(project: Path) -> dict[str, dict]:
    return {one["id"]: one for one in json.loads((project / "project.json").read_text())["specimens"]}


def write_masks(folder: Path) -> list[Path]:
    """Write ellipsoids of two labels; the last volume has only one of them."""
    x = np.stack(np.meshgrid(*(np.arange(40),) * 3, indexing="ij"), axis=-1)
    paths = [folder / f"patient_{k}.nii.gz" for k in range(3)]
    for k, path in enumerate(paths):
        radius = np.linalg.norm((x - 20) / [10, 12 + k, 15], axis=-1)
        labels = np.where(radius < 1, 1 if k == 2 else np.where(x[..., 2] > 20, 2, 1), 0)
        nibabel.save(nibabel.Nifti1Image(labels.astype(np.uint8), np.eye(4)), path)
    return paths


def test_label_volumes_become_specimens_by_clicks(open_tab, tmp_path: Path) -> None:
    project, paths = tmp_path / "organs", write_masks(tmp_path)
    broken = tmp_path / "broken.nii.gz"
    broken.write_bytes(paths[0].read_bytes()[:300])
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        tab.page.get_by_test_id("choose-files-input").set_input_files([*paths, broken])
        tab.page.get_by_test_id("volumes-smooth").wait_for()
        tab.page.get_by_test_id("label-2").wait_for()
        dialog = tab.page.get_by_test_id("volumes")
        dialog.get_by_text("broken.nii.gz").wait_for()
        assert not barriers(tab)
        user.click("label-1")
        dialog.get_by_text("3 surfaces will be added").wait_for()
        user.click("label-2")
        dialog.get_by_text("patient_2.nii.gz lacks a chosen label").wait_for()
        tab.shot("labels")
        user.click("volumes-make")
        user.sees("card-patient_1")
        tab.page.locator("[data-testid=card-patient_1][data-state=ready]").wait_for()
        tab.shot("surfaces")
        assert {name: one["file"] for name, one in specimens(project).items()} == {
            f"patient_{k}": f"surfaces/0001/patient_{k}.ply" for k in range(2)
        }
        assert sorted(path.name for path in (project / "scans").iterdir()) == [path.name for path in paths[:2]]
        assert "surface scans/patient_0.nii.gz scans/patient_1.nii.gz" in json.dumps(
            json.loads((project / "jobs" / "0001" / "job.json").read_text())["arguments"]
        ).replace('", "', " ")
        user.click("undo")
        user.sees("empty")
        # Nothing is left of volumes of which no surface is made.
        tab.page.get_by_test_id("choose-files-input").set_input_files([paths[2]])
        user.click("volumes-cancel")
        dialog.wait_for(state="detached")
        tab.page.wait_for_timeout(500)
        assert len(list((project / "scans").iterdir())) == 2
    assert [text for text in tab.complaints if "422" not in text] == [] and tab.asked == []


def write_dirty_bones(folder: Path) -> list[Path]:
    """Write bones with a separate small piece each."""
    paths = [folder / f"bone_{k}.ply" for k in range(2)]
    for k, path in enumerate(paths):
        rng = np.random.default_rng(k)
        bone = raw_surface(Bone.draw(rng), rng, 3000)
        small = 0.1 * bone.vertices + bone.vertices.max(axis=0) + 5.0
        faces = np.concatenate([faces_of(bone), faces_of(bone) + len(small)]).astype(np.int32)
        write_mesh(path, Mesh(np.concatenate([bone.vertices, small]), faces))
    return paths


def test_scans_are_groomed_by_clicks_and_the_originals_come_back(open_tab, tmp_path: Path) -> None:
    project, paths = tmp_path / "bones", write_dirty_bones(tmp_path)
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        tab.page.get_by_test_id("choose-files-input").set_input_files(paths)
        tab.page.locator("[data-testid=card-bone_1][data-state=ready]").wait_for()
        user.click("select-all")
        user.click("groom-selected")
        user.click("groom--largest")
        tab.shot("form")
        user.click("groom-apply")
        groomed = tab.page.locator("[data-testid=card-bone_1][data-state=ready]").get_by_text("groomed")
        groomed.wait_for()
        assert {one["file"] for one in specimens(project).values()} == {f"groomed/0001/bone_{k}.ply" for k in range(2)}
        for k, path in enumerate(paths):
            before, after = read_mesh(path), read_mesh(project / f"groomed/0001/bone_{k}.ply")
            assert np.array_equal(after.vertices, before.vertices[: len(before.vertices) // 2])
        # A crop by a sphere around a clicked point of a mirrored scan.
        user.click("mirror-selected")
        user.click("show-bone_0")
        view = tab.page.get_by_test_id("scan-view")
        tab.page.locator("[data-testid=scan-view][data-ready=true]").wait_for()
        user.click("crop-sphere")
        box = view.bounding_box()
        tab.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        user.sees("crop-share")
        tab.page.get_by_test_id("crop-radius").fill("0.2")
        tab.page.wait_for_timeout(600)
        tab.shot("sphere")
        assert not barriers(tab)
        user.click("groom-apply")
        ends = time.monotonic() + 60
        while specimens(project)["bone_0"]["file"] != "groomed/0002/bone_0.ply":
            assert time.monotonic() < ends
            tab.page.wait_for_timeout(100)
        tab.page.wait_for_timeout(1500)  # until the page has this state; its view then shows the other file
        tab.page.locator("[data-testid=scan-view][data-ready=true]").wait_for()
        tab.page.wait_for_timeout(600)
        tab.shot("cropped")
        job = json.loads((project / "jobs" / "0002" / "job.json").read_text())
        crop = Crop.of(job["options"]["--crop"])
        before, after = read_mesh(project / "groomed/0001/bone_0.ply"), read_mesh(project / "groomed/0002/bone_0.ply")
        inside = crop.contains(before.vertices)
        assert crop.kind == "sphere" and 0 < inside.sum() < len(inside)
        assert crop.contains(after.vertices).all()
        # The centre is on the surface of the file, which the view shows reflected.
        assert np.linalg.norm(before.vertices - crop.numbers[:3], axis=1).min() < 5.0
        # The same crop by the keyboard, and a plane.
        user.click("crop-sphere")
        for axis, value in zip("xyz", crop.numbers[:3], strict=True):
            tab.page.get_by_test_id(f"crop-{axis}").fill(str(value))
        tab.page.get_by_test_id("crop-radius").fill("0.2")
        size = np.ptp(after.vertices, axis=0).max()
        for steps in (0, 100):
            for _ in range(steps):
                tab.page.get_by_test_id("crop-x").press("ArrowUp")
            centre = np.add(crop.numbers[:3], [steps * size / 500, 0, 0])
            share = (np.linalg.norm(after.vertices - centre, axis=1) <= 0.2 * size).mean()
            assert abs(int(tab.page.get_by_test_id("crop-share").inner_text().split()[0]) - 100 * share) < 1
        user.click("crop-plane")
        assert tab.page.get_by_test_id("crop-share").inner_text().startswith(("4", "5"))
        tab.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        tab.page.get_by_test_id("crop-keep").select_option("front")
        tab.page.wait_for_timeout(600)
        tab.shot("plane")
        user.click("scan-close")
        user.click("undo")
        tab.page.wait_for_timeout(300)
        user.click("clear-selection")
        user.click("select-bone_1")
        user.click("groom-selected")
        user.click("groom-original")
        groomed.wait_for(state="detached")
        assert specimens(project)["bone_1"]["file"] == "scans/bone_1.ply"
    assert tab.complaints == [] and tab.asked == []


def test_odd_specimens_are_named_before_the_run_and_rows_of_the_table_are_one_line_high(
    open_tab, tmp_path: Path
) -> None:
    project = Project.open(tmp_path / "bones", create=True)
    for k in range(24):
        rng = np.random.default_rng(k)
        bone = raw_surface(Bone.draw(rng), rng, 300)
        path = project.new_file(f"museum_of_natural_history_specimen_{k:03}.ply")
        faces = np.concatenate([faces_of(bone), faces_of(bone)[: k % 3]])  # repaired: some triangles repeat others
        write_mesh(path, Mesh(bone.vertices * (0.1 if k == 5 else 1.0), faces.astype(np.int32)))
        if k == 7:
            path.write_bytes(b"ply\nnonsense that cannot be read, as the message says in a long sentence")
        project.add(path, "training")
    cells = {one.id: {"species": "Pan troglodytes", "sex": "f"} for one in project.state.specimens}
    project.edit(None, with_cells(("species", "sex"), cells))
    odd = "museum_of_natural_history_specimen_005"
    with studio(project.folder, tmp_path) as address:
        tab = open_tab(address, {"width": 1024, "height": 768})
        user = User(tab)
        user.sees(f"odd-{odd}")
        tab.until("document.querySelectorAll('tbody .refused').length === 1")
        tab.until("!document.querySelector('tbody .waiting')")
        heights = tab.page.evaluate("[...document.querySelectorAll('tbody tr')].map((row) => row.offsetHeight)")
        assert len(heights) == 24 and max(heights) < 36
        assert barriers(tab) == []
        tab.shot("table")
        user.click("tab-correspondence")
        user.sees("odd-link")
        tab.page.get_by_test_id("checks").get_by_text("in cm it would have their size").wait_for()
        user.click("odd-link")
        user.click(f"odd-unit-{odd}")
        tab.page.get_by_test_id("odd").wait_for(state="detached")
        tab.until(f"document.querySelector('[data-testid=unit-{odd}]').value === 'cm'")
    assert tab.complaints == []
