"""Parts of one subject in the browser: vertices as those of Python, colours, hidden and exploded parts."""

import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pages import PANE, viewer
from pictures import same_as_kept
from test_scene_in_browser import SHELL
from test_studio_in_browser import WINDOW, User, studio

import shapespace as ss
from same_blobs import NAMES, write_same
from shapespace.geometry.articulation import PartPoses
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.region import articulation_of
from shapespace.report.render import palette, scene
from shapespace.schemas import CorrespondenceRecord
from two_parts import VERTICES, two_part_surfaces

COUNTS = {"upper": VERTICES, "lower": VERTICES}
PLACE = (
    "<style>* { box-sizing: border-box; }</style>"
    '<div id="a" style="padding: 14px; background: #f1efea; font-family: sans-serif"></div>'
)
LOADED = 'Shapespace.load("model").then((u) => { window.model = new Shapespace.Model(u); });'
WIDGET = """
Shapespace.widgets.modes(document.getElementById("a"), "model").then((made) => { window.made = made; });
"""


def model_of(relative_pose: str = "modelled") -> ss.ShapeModel:
    config = ss.BuildConfig(parts=COUNTS, relative_pose=relative_pose, gauge="form", modes=4)
    return ss.build_model(two_part_surfaces(25, seed=1), config)


@pytest.fixture(scope="module")
def model() -> ss.ShapeModel:
    return model_of()


@pytest.fixture
def page_of(open_tab, tmp_path: Path):
    """Return a function that opens a page with payloads and a script."""

    def open_(script: str, **payloads: bytes):
        body = PLACE + "".join(scene.payload_html(name, data) for name, data in payloads.items())
        path = tmp_path / "parts.html"
        page = SHELL.format(style=scene.style(), body=body, before="", scripts=scene.scripts(), script=script)
        path.write_text(page, encoding="utf-8")
        return open_tab(path.as_uri())

    return open_


SHOWN = "([z, moves]) => Array.from(model.vertices(Float64Array.from(z), null, moves))"


@pytest.mark.parametrize("small", [False, True])
def test_vertices_of_the_browser_are_those_of_python_where_poses_turn(page_of, model, small: bool) -> None:
    """In every coordinate, at poses of up to 60 degrees; shape alone and pose alone as their definitions."""
    tab = page_of(LOADED, model=scene.pack_model(model, small=small))
    tab.page.wait_for_function("window.model")
    order = scene._neighbours_together(model.faces, model.n_vertices)[0] if small else np.arange(model.n_vertices)
    at_most = 0.15 if small else 1e-3  # mm; in reports rounded to 0.04 mm, which the joint moves on
    articulation = articulation_of(model)
    rng = np.random.default_rng(3)
    for z in (np.zeros(4), np.array([3.0, 0, 0, 0]), np.array([-3.0, 1, -1, 2]), rng.normal(size=4)):
        b = z * model.stddev
        poses = articulation.from_tangent((model.coding["mean"] + model.basis @ b).reshape(-1, 3))
        none = PartPoses(0 * poses.shape, 0 * poses.rotation, 0 * poses.translation)
        wanted = {
            "both": model.reconstruct(b),
            "shape": articulation.decode(articulation.to_tangent(replace(none, shape=poses.shape))),
            "pose": articulation.decode(articulation.to_tangent(replace(poses, shape=none.shape))),
        }
        for moves, vertices in wanted.items():
            shown = np.array(tab.page.evaluate(SHOWN, [z.tolist(), moves])).reshape(-1, 3)
            assert np.abs(shown - vertices[order]).max() < at_most, (z, moves)
    flexion = model.reconstruct(np.array([3.0, 0, 0, 0]) * model.stddev)
    linear = model.mean_vertices + 3 * (model.vertex_basis[:, 0] * model.stddev[0]).reshape(-1, 3)
    assert np.abs(flexion - linear).max() > 5.0  # mm; what a page would be off that added modes to the mean
    labels = np.array(tab.page.evaluate("Array.from(model.parts)"))
    assert np.array_equal(labels, np.repeat([0, 1], list(COUNTS.values()))[order])
    assert tab.complaints == [] and tab.asked == []


def colours_drawn(tab) -> set[int]:
    """Return the parts whose hue is seen in the picture, of many pixels."""
    from PIL import Image

    tab.page.wait_for_function("made.view.rests")
    image = Image.open(io.BytesIO(tab.page.get_by_test_id("view").screenshot())).convert("RGB")
    pixels = np.asarray(image).reshape(-1, 3) / 255
    lab = palette.oklab(pixels)[:, 1:]
    hues = palette.oklab(np.array(palette.PARTS[:2]))[:, 1:]
    off = np.linalg.norm(lab[:, None] - hues, axis=2)
    return {k for k in range(2) if ((off.argmin(axis=1) == k) & (off[:, k] < 0.03)).sum() > 300}


def test_parts_are_drawn_in_their_colours_hidden_and_exploded_by_keys(page_of, model) -> None:
    tab = page_of(WIDGET, model=scene.pack_model(model))
    tab.page.wait_for_function("window.made")
    page = tab.page
    assert colours_drawn(tab) == {0, 1}
    box = page.get_by_role("group", name="Parts").get_by_role("checkbox", name="lower")
    box.focus()
    page.keyboard.press("Space")
    assert colours_drawn(tab) == {0}
    before = page.evaluate("made.view.camera.extent")
    page.keyboard.press("Tab")  # to the slider
    for _ in range(20):
        page.keyboard.press("ArrowRight")
    apart = "Array.from(made.view.placed('model', Float32Array.from(model.vertices([]))))"
    page.evaluate(LOADED)
    page.wait_for_function("window.model")
    placed = np.array([np.nan if value is None else value for value in page.evaluate(apart)]).reshape(-1, 3)
    assert np.isnan(placed[COUNTS["upper"] :]).all()
    mean = model.mean_vertices
    centres = [mean[: COUNTS["upper"]].mean(axis=0), mean[COUNTS["upper"] :].mean(axis=0)]
    shift = (centres[0] - centres[1]) / 2  # from the centre of both, at 100 %
    assert np.abs(placed[: COUNTS["upper"]] - mean[: COUNTS["upper"]] - shift).max() < 1e-3
    assert max(page.evaluate("made.view.camera.extent")) > 1.2 * max(before)
    page.get_by_test_id("part-lower").check()
    assert colours_drawn(tab) == {0, 1}
    page.get_by_label("Colour by distance from the mean").check()
    page.get_by_test_id("mode-1").focus()
    for _ in range(30):
        page.keyboard.press("ArrowRight")
    assert 1 not in colours_drawn(tab)  # the map wins, which has no yellow
    tab.shot("parts-map")
    assert tab.complaints == []


@pytest.mark.parametrize(("relative_pose", "is_offered"), [("modelled", True), ("kept", False), ("removed", False)])
def test_shape_and_pose_are_moved_apart_only_where_poses_are_modelled(page_of, relative_pose, is_offered) -> None:
    tab = page_of(WIDGET, model=scene.pack_model(model_of(relative_pose), small=True))
    tab.page.wait_for_function("window.made")
    assert tab.page.get_by_role("checkbox", name="upper").is_checked()
    assert tab.page.get_by_test_id("moves").count() == is_offered
    if is_offered:
        tab.page.get_by_test_id("mode-1").focus()
        tab.page.keyboard.press("End")
        tab.page.get_by_label("Shape only").check(force=True)
        assert tab.page.locator(".ss-caption").first.text_content() == "Shape only"
        tab.shot("parts-shape-only")
        tab.page.get_by_label("Shape and pose").check(force=True)
        tab.page.get_by_test_id("exploded").fill("25")
        tab.page.wait_for_function("made.view.rests")
        png = tab.shot("parts-exploded", clip=tab.page.locator("#a").bounding_box())
        same_as_kept("joint-modes.png", png, width=1000)
    assert tab.complaints == []


def test_surfaces_in_correspondence_show_their_parts_and_marks_of_hidden_ones_are_named(open_tab, tmp_path) -> None:
    folder = write_same(tmp_path, NAMES)
    file = folder / CorrespondenceRecord.FILE
    record = json.loads(file.read_text())
    below = record["vertices"] // 2
    file.write_text(json.dumps({**record, "parts": {"first": below, "second": record["vertices"] - below}}))
    with viewer(folder) as address:
        tab = open_tab(address)
        tab.until(f"{PANE}?.dataset.ready === 'true'")
        page = tab.page
        page.get_by_test_id("colour-plain").click()
        assert page.get_by_test_id("colour-plain").inner_text() == "Parts"
        cells = "window.shapespaceCells.slice(0, 2).map((cell) => "
        shown = cells + "cell.view._things.get('surface').object.geometry.index.count)"
        all_shown = page.evaluate(shown)
        for vertex in (1, below + 1):
            page.get_by_test_id("number").fill(str(vertex))
            page.get_by_test_id("mark").click()
        page.get_by_test_id("part-second").uncheck()
        assert all(0 < few < 0.7 * many for few, many in zip(page.evaluate(shown), all_shown, strict=True))
        labels = cells + "cell.view._marks.get('marks').map((mark) => mark.label))"
        assert page.evaluate(labels) == [["1"]] * 2
        assert page.get_by_test_id("note-0").inner_text() == f"{below + 1} not shown"
        page.get_by_test_id("exploded").fill("60")
        mark = cells + "Array.from(cell.view._marks.get('marks')[0].position))"
        place = cells + "Array.from(cell.positions.slice(3, 6)))"
        assert np.abs(np.array(page.evaluate(mark)) - page.evaluate(place)).min(axis=1).max() > 1e-3
        tab.shot("surfaces")
        page.get_by_test_id("part-second").check()
        assert page.evaluate(shown) == all_shown
        tab.shot("surfaces-exploded")
        assert tab.complaints == []


def test_scans_of_parts_become_one_card_per_specimen_by_clicks(open_tab, tmp_path: Path) -> None:
    for mesh in two_part_surfaces(2, seed=4):
        for k, part in enumerate(("femur", "tibia")):
            vertices = mesh.vertices[k * VERTICES : (k + 1) * VERTICES]
            own = replace(mesh, vertices=vertices, faces=mesh.faces[: len(mesh.faces) // 2])
            write_mesh(tmp_path / f"{mesh.name}_{part}.ply", own)
    with studio(tmp_path / "project", tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user = User(tab)
        user.sees("drop-zone")
        tab.page.get_by_test_id("choose-files-input").set_input_files(sorted(tmp_path.glob("*.ply")))
        tab.until("document.querySelectorAll('[data-testid^=card-] img').length === 4")
        user.click("select-all")
        user.click("parts-selected")
        assert tab.page.get_by_test_id("parts-names").input_value() == "femur, tibia"
        user.click("parts-join")
        tab.until("document.querySelectorAll('[data-testid^=card-]').length === 2")
        assert tab.page.get_by_test_id("card-s0").locator("img").count() == 2
        assert tab.page.get_by_test_id("specimens-summary").inner_text() == "2 specimens, 2 included"
        assert tab.complaints == []
