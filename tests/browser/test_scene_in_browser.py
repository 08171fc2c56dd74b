"""What the scripts of scenes and widgets make of packed arrays, in a real browser with software WebGL."""

import base64
import io
from pathlib import Path

import numpy as np
import pytest

from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.report.inputs.saved_fits import StagedFit
from shapespace.report.render import scene
from synthetic_shapes import blob_model, raw_scan

SHELL = """<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>scene</title>
<link rel="icon" href="data:,">
<style>:root {{ --page: #fff; --ink: #111; --soft: #555; --line: #ccc; --card: #fff; --accent: #1f5f99; }}
{style}</style></head><body style="background: #fff">{body}
<script>{before}</script><script>{scripts}</script><script>{script}</script></body></html>"""


@pytest.fixture
def page_of(open_tab, tmp_path: Path):
    """Return a function that opens a page with payloads and a body of its own."""

    def open_(body: str = "", script: str = "", before: str = "", **payloads: bytes):
        hidden = "".join(scene.payload_html(name, data) for name, data in payloads.items())
        page = SHELL.format(
            style=scene.style(), body=body + hidden, before=before, scripts=scene.scripts(), script=script
        )
        path = tmp_path / "scene.html"
        path.write_text(page, encoding="utf-8")
        return open_tab(path.as_uri())

    return open_


def drawn_share(png: bytes) -> float:
    """Return the share of pixels that differ from those of the corner."""
    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)
    return float((np.abs(pixels - pixels[2, 2]).sum(axis=2) > 24).mean())


@pytest.fixture(scope="module")
def staged() -> StagedFit:
    model = blob_model()
    scan = raw_scan(np.full(5, 0.4), seed=3).scan
    return StagedFit.of(
        model, fit_scan(model, scan, FitConfig(method="paper", max_iterations=4)), "<b>somebody</b> & co"
    )


VIEW = """
window.view = new Shapespace.View(document.getElementById("a"), {label: "a blob"});
Shapespace.load("model").then((u) => {
  window.model = new Shapespace.Model(u);
  view.setSurface("s", {positions: model.vertices(new Float32Array(0)), faces: model.faces});
  view.frame();
});
"""
PLACE = '<div id="a" style="width: 400px; height: 300px"></div>'


@pytest.mark.parametrize("small", [False, True])
def test_the_browser_unpacks_and_moves_the_model_as_numpy_does(page_of, small: bool) -> None:
    model = blob_model()
    tab = page_of(PLACE, VIEW, model=scene.pack_model(model, small=small))
    tab.page.wait_for_function("window.model")
    faces, mean, modes = (
        np.array(tab.page.evaluate(code))
        for code in (
            "Array.from(model.faces)",
            "Array.from(model.mean)",
            "Array.from({length: model.K}, (_, k) => Array.from(model.mode(k)))",
        )
    )
    rng = np.random.default_rng(5)
    for _ in range(3):
        z = rng.normal(size=model.n_modes)
        shown = np.array(tab.page.evaluate("(z) => Array.from(model.vertices(Float32Array.from(z)))", z.tolist()))
        assert np.abs(shown - (mean + z @ modes)).max() < 1e-3
        if not small:
            assert np.abs(shown.reshape(-1, 3) - model.reconstruct(z * model.stddev)).max() < 1e-3
            assert np.array_equal(faces.reshape(-1, 3), model.faces)
    outwards = tab.page.evaluate("(z) => Array.from(model.displacement(Float32Array.from(z)))", z.tolist())
    from shapespace.geometry.normals import vertex_normals
    from shapespace.types import Mesh

    normals = vertex_normals(Mesh(mean.reshape(-1, 3), faces.reshape(-1, 3)))
    wanted = ((z @ modes).reshape(-1, 3) * normals).sum(axis=1)
    assert np.abs(np.array(outwards) - wanted).max() < 1e-3
    assert tab.complaints == [] and tab.asked == []


def test_every_kind_of_array_is_unpacked(page_of) -> None:
    values = np.random.default_rng(0).normal(0, 40, (50, 3))
    values[3] = np.nan
    coded = scene.quantise(values, step=0.04, coded=True)
    after = scene.Steps(np.roll(coded.values, 1, axis=0), coded.scale, True, "coded")
    faces = scene.Steps(np.random.default_rng(1).integers(0, 65536, (40, 3)).astype(np.uint16), coded=True)
    arrays = {
        "u8": np.arange(5, dtype=np.uint8),
        "f32": values.astype(np.float32),
        "rows": scene.quantise(values.T, by_row=True),
        "coded": coded,
        "after": after,
        "faces": faces,
        "u32": np.array([2**32 - 1], np.uint32),
    }
    tab = page_of("", it=scene.pack(arrays, {"label": "</script>"}))
    got = tab.page.evaluate(
        "() => Shapespace.load('it').then((u) => [u.facts, Object.fromEntries(Object.entries(u.arrays).map("
        "([k, a]) => [k, Array.from(a, (v) => Number.isNaN(v) ? null : v)]))])"
    )
    facts, back = got
    assert facts == {"label": "</script>"}
    assert back["u8"] == list(range(5)) and back["u32"] == [2**32 - 1]
    assert back["faces"] == faces.values.ravel().tolist()
    assert np.allclose(np.array(back["f32"], float), values.ravel(), atol=1e-4, equal_nan=True)
    for name, wanted in (("rows", values.T), ("coded", values), ("after", np.roll(values, 1, axis=0))):
        assert np.allclose(np.array(back[name], float), wanted.ravel(), atol=0.0201, equal_nan=True), name


@pytest.mark.parametrize("cut", [3, 40, -200])
def test_damaged_data_are_named_in_their_place(page_of, cut: int) -> None:
    whole = scene.pack_model(blob_model())
    tab = page_of('<div id="w"></div>', 'Shapespace.widgets.modes(document.getElementById("w"), "m");', m=whole[:cut])
    tab.page.wait_for_selector("#w .shapespace-note")
    assert "cut short or damaged" in tab.page.inner_text("#w")
    assert tab.complaints == []


def test_a_view_draws_turns_and_moves(page_of) -> None:
    tab = page_of(PLACE, VIEW, model=scene.pack_model(blob_model()))
    page = tab.page
    page.wait_for_function("window.model && view.frames > 0")
    page.wait_for_timeout(400)
    first = page.locator("#a").screenshot()
    assert drawn_share(first) > 0.15
    still = page.evaluate("view.frames")
    page.wait_for_timeout(300)
    assert page.evaluate("view.frames") == still, "it draws although nothing changed"
    page.locator("#a canvas").first.focus()
    before = page.evaluate("view.camera")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("+")
    turned = page.evaluate("view.camera")
    assert turned["yaw"] < before["yaw"] and turned["zoom"] < before["zoom"]
    page.wait_for_timeout(400)
    assert page.locator("#a").screenshot() != first
    page.keyboard.press("Home")
    assert page.evaluate("view.camera") == before
    page.mouse.move(200, 150)
    page.mouse.down()
    page.mouse.move(260, 150, steps=4)
    page.mouse.up()
    assert page.evaluate("view.camera.yaw") < before["yaw"] - 0.2
    page.evaluate("view.reset()")
    page.evaluate("view.move('s', model.vertices(Float32Array.from({length: model.K}, () => 2.5)))")
    page.wait_for_timeout(500)
    assert page.locator("#a").screenshot() != first
    assert page.evaluate("view.png().then((blob) => blob.type)") == "image/png"
    assert tab.complaints == []


def test_what_is_under_the_pointer_is_the_nearest_vertex_of_the_front(page_of) -> None:
    model = blob_model()
    tab = page_of(PLACE, VIEW, model=scene.pack_model(model))
    tab.page.wait_for_function("window.model && view.frames > 0")
    hit = tab.page.evaluate(
        "(() => { const b = view.canvas.getBoundingClientRect();"
        " return view.pick(b.left + b.width / 2, b.top + b.height / 2); })()"
    )
    assert hit["id"] == "s"
    point, vertices = np.array(hit["point"]), model.mean_vertices
    nearest = np.linalg.norm(vertices - point, axis=1).argmin()
    assert np.linalg.norm(vertices[hit["vertex"]] - point) <= np.linalg.norm(vertices[nearest] - point) + 1.0
    middle = (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    assert point[2] > middle[2] and np.abs(point[:2] - middle[:2]).max() < 1.0
    assert tab.page.evaluate("view.pick(-50, -50)") is None


def test_odd_surfaces_are_taken(page_of) -> None:
    tab = page_of(PLACE, VIEW, model=scene.pack_model(blob_model()))
    tab.page.wait_for_function("window.model")
    tab.page.evaluate("""() => {
      const empty = new Float32Array(0), p = model.vertices(new Float32Array(0));
      view.setSurface("nothing", {positions: empty, faces: new Uint32Array(0)});
      view.setSurface("points", {positions: p, faces: null, colour: [1, 0, 0]});
      const bad = Float32Array.from(p);
      bad[4] = NaN;
      view.setSurface("holes", {positions: bad, faces: model.faces, opacity: 0.5});
      view.move("holes", p);
      view.move("holes", bad);
      view.setSurface("beyond", {positions: p, faces: Uint32Array.from([0, 1, 9999999])});
      view.paint("holes", new Float32Array(model.V).fill(NaN), {map: Shapespace.colours.diverging, range: [0, 0]});
      view.paint("nowhere", empty, {});
      view.marks("marks", [{position: [0, 0, 60], label: "<i>nose</i>", colour: [0, 0.5, 0]}]);
      view.frame();
      document.getElementById("a").style.width = "0px";
      view.redraw();
      document.getElementById("a").style.width = "300px";
      view.redraw();
    }""")
    tab.page.wait_for_timeout(300)
    assert drawn_share(tab.page.locator("#a").screenshot()) > 0.1
    assert tab.complaints == []


def test_a_map_a_threshold_and_opacity_change_the_picture(page_of) -> None:
    tab = page_of(PLACE, VIEW, model=scene.pack_model(blob_model()))
    page = tab.page
    page.wait_for_function("window.model && view.frames > 0")

    def seen(code: str) -> np.ndarray:
        from PIL import Image

        page.evaluate(code)
        page.wait_for_timeout(400)
        return np.asarray(Image.open(io.BytesIO(page.locator("#a").screenshot())).convert("RGB")).astype(int)[150, 200]

    paint = (
        "view.paint('s', window.d = window.d || new Float32Array(model.V).fill(3),"
        " {{map: [[0, 0, 1], [0, 0, 1]], range: [-5, 5], threshold: {threshold}, signal: [1, 0, 0]}})"
    )
    blue = seen(paint.format(threshold="null"))
    red = seen(paint.format(threshold=2))
    assert blue[2] > 150 > 60 > blue[0] and red[0] > 150 > 60 > red[2]
    assert np.array_equal(seen(paint.format(threshold=4)), blue)
    faded = seen("view.set('s', {opacity: 0.3})")
    assert faded[0] > blue[0] + 80
    green = seen("view.set('s', {opacity: 1}); view.paint('s', new Uint8Array(model.V), {categories: [[0, 1, 0]]})")
    assert green[1] > 150 > 60 > max(green[0], green[2])
    unknown = seen("view.paint('s', new Float32Array(model.V).fill(NaN), {map: [[0, 0, 1]], range: [0, 1]})")
    assert np.ptp(unknown) < 20


def test_many_views_on_one_page_all_draw_and_survive_a_lost_context(page_of) -> None:
    body = "".join(f'<div id="v{k}" style="width: 120px; height: 90px; float: left"></div>' for k in range(24))
    script = """
    window.all = [];
    Shapespace.load("model").then((u) => {
      const model = new Shapespace.Model(u);
      for (let k = 0; k < 24; k++) {
        const view = new Shapespace.View(document.getElementById("v" + k), {label: "view " + k});
        view.setSurface("s", {positions: model.vertices(new Float32Array(0)), faces: model.faces});
        view.frame();
        all.push(view);
      }
    });
    """
    tab = page_of(body, script, model=scene.pack_model(blob_model()))
    page = tab.page
    page.wait_for_function("all.length === 24 && all.every((view) => view.frames > 1)")
    assert all(drawn_share(page.locator(f"#v{k}").screenshot()) > 0.1 for k in (0, 11, 23))
    frames = page.evaluate("all[0].frames")
    page.evaluate("Shapespace.loseContext()")
    page.wait_for_function(f"all[0].frames > {frames}")
    page.evaluate("all[3].link(all[4]); all[3].camera = {yaw: 1}; all[5].dispose()")
    assert page.evaluate("all[4].camera.yaw") == 1
    page.wait_for_timeout(300)
    assert drawn_share(page.locator("#v3").screenshot()) > 0.1
    assert [text for text in tab.complaints if "context" not in text.lower()] == []


WIDGETS = """
window.W = {};
const start = (kind, id) =>
  Shapespace.widgets[kind](document.getElementById(id), id + "-data").then((w) => (W[id] = w));
start("modes", "m"); start("fit", "f"); start("scatter", "s");
"""
PLACES = '<div id="m"></div><div id="f"></div><div id="s"></div>'


def payloads(staged: StagedFit) -> dict[str, bytes]:
    rng = np.random.default_rng(0)
    labels = ["neutral", "<script>document.title = 'broken'</script>"] * 10
    scatter = scene.pack_scatter(
        rng.normal(size=(20, 4)) * 10, labels, [f"<i>{k}</i>" for k in range(20)], axes=["b1", "b2", "b3", "b4"]
    )
    return {
        "m-data": scene.pack_model(blob_model(), 8, small=True),
        "f-data": scene.pack_fit(staged, largest_scan=2000),
        "s-data": scatter,
    }


def test_the_widgets_work_by_their_controls(page_of, staged: StagedFit) -> None:
    tab = page_of(PLACES, WIDGETS, **payloads(staged))
    page = tab.page
    for name in "mfs":
        page.locator(f"#{name}").scroll_into_view_if_needed()
        page.wait_for_function(f"W.{name} && W.{name}.view.frames > 0")

    def changes(name: str, act) -> None:
        before = page.locator(f"#{name} .ss-panes").screenshot()
        act()
        page.wait_for_timeout(250)
        assert page.locator(f"#{name} .ss-panes").screenshot() != before

    first = page.get_by_role("slider", name="Mode 1,")
    changes("m", lambda: first.fill("2.5"))
    assert "+2.50" in page.inner_text("#m")
    changes("m", lambda: page.get_by_label("Colour by distance from the mean").check())
    changes("m", lambda: page.get_by_role("button", name="Random shape").click())
    changes("m", lambda: page.get_by_role("button", name="Mean shape").click())
    assert page.evaluate("W.m.z.every((v) => v === 0)")
    page.get_by_role("button", name="Animate").click()
    page.wait_for_function("Math.abs(W.m.z[0]) > 0.5")
    page.get_by_role("button", name="Pause").click()

    changes("f", lambda: page.get_by_label("Before").check(force=True))
    changes("f", lambda: page.get_by_label("Phase 2").check(force=True))
    changes("f", lambda: page.get_by_label("Plain").check(force=True))
    changes("f", lambda: page.get_by_label("Model to scan").check(force=True))
    changes("f", lambda: page.get_by_label("Side by side").check(force=True))
    assert page.locator("#f .ss-plate").count() == 2
    page.get_by_label("Overlaid").check(force=True)
    page.get_by_label("Mark what lies beyond a threshold").check()
    threshold = page.get_by_label("Threshold", exact=True)
    assert float(threshold.get_attribute("max")) == 2 * staged.scale_mm
    limit = 0.1 * staged.scale_mm
    changes("f", lambda: threshold.fill(f"{limit:g}"))
    shown = staged.model_to_scan_mm["final"]
    share = float(page.inner_text("#f .ss-said").split("mm.")[1].split("%")[0])
    assert abs(share - 100 * (np.abs(shown) > limit).mean()) < 0.6
    changes("f", lambda: page.get_by_label("Regions").check(force=True))
    changes("f", lambda: page.get_by_label("Show model").uncheck())

    changes("s", lambda: page.get_by_label("Point", exact=True).select_option("3"))
    assert page.inner_text("#s .ss-tip") == "<i>3</i>: <script>document.title = 'broken'</script>"
    changes("s", lambda: page.get_by_label("Up", exact=True).select_option("3"))
    assert page.title() == "scene" and page.locator("#s i, #f b").count() == 0
    assert tab.complaints == [] and tab.asked == []


@pytest.mark.parametrize(
    ("most", "ticks"),
    [(23.0, ["10", "20"]), (0.9, ["0.2", "0.4", "0.6", "0.8"]), (4100.0, ["2000", "4000"]), (3.0, ["1", "2", "3"])],
)
def test_the_axes_of_a_scatter_have_numbers(page_of, most: float, ticks: list[str]) -> None:
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (12, 3)) * most
    points[0, 1] = -most
    data = scene.pack_scatter(points, ["one"] * 12, [str(k) for k in range(12)], axes=["b1", "b2", "b3"])
    script = 'Shapespace.widgets.scatter(document.getElementById("s"), "s-data").then((w) => (window.w = w));'
    tab = page_of(PLACES, script, **{"s-data": data})
    tab.page.wait_for_function("window.w && w.view.frames > 0")
    found = tab.page.evaluate("w.ticks()")
    assert found == [sign + tick for tick in ticks for sign in ("\u2212", "")] * 3
    tab.page.wait_for_timeout(300)
    tab.shot(f"{most:g}")
    # They are drawn: without them the picture is another one.
    with_them = tab.page.locator("#s .ss-plate").screenshot()
    tab.page.evaluate("w.view.texts('axes', [])")
    tab.page.wait_for_timeout(300)
    assert tab.page.locator("#s .ss-plate").screenshot() != with_them
    assert tab.complaints == []


@pytest.mark.parametrize("kind", ["surface", "points"])
def test_a_fit_says_what_its_colours_mean(page_of, staged: StagedFit, kind: str) -> None:
    from dataclasses import replace

    from shapespace.types import Mesh

    forward = {stage: np.where(np.arange(len(d)) % 2, d, np.nan) for stage, d in staged.model_to_scan_mm.items()}
    backward = {stage: np.nan_to_num(d) for stage, d in staged.scan_to_model_mm.items()}
    given = replace(staged, model_to_scan_mm=forward, scan_to_model_mm=backward)
    if kind == "points":
        given = replace(given, scan=Mesh(staged.scan.vertices))
    tab = page_of(PLACES, 'Shapespace.widgets.fit(document.getElementById("f"), "f-data").then((w) => (window.w = w));',
                  **{"f-data": scene.pack_fit(given, largest_scan=900)})  # fmt: skip
    tab.page.wait_for_function("window.w")
    bar, end = tab.page.locator("#f .ss-bar").first, f"{given.scale_mm:g}"
    told = bar.inner_text()
    assert "not shown by the scan" in told
    assert f"\u2265 {end}" in told
    if kind == "points":
        assert "Distance to the points (mm)" in told and "\u2212" not in told
    else:
        assert "Scan inside (\u2212) or outside (+) of the model (mm)" in told and f"\u2264 \u2212{end}" in told
    tab.page.get_by_label("Scan to model").check(force=True)
    assert "not shown by the scan" not in bar.inner_text()
    tab.page.get_by_label("Mark what lies beyond a threshold").check()
    assert "beyond " in bar.inner_text()
    tab.page.get_by_label("Plain").check(force=True)
    assert "nearer one is shown" in tab.page.inner_text("#f .ss-legend")
    assert tab.complaints == []


def test_the_colour_of_the_scan_is_shown_where_there_is_one(page_of, staged: StagedFit) -> None:
    from dataclasses import replace

    from PIL import Image

    script = 'Shapespace.widgets.fit(document.getElementById("f"), "f-data").then((w) => (window.w = w));'
    tab = page_of(PLACES, script, **{"f-data": scene.pack_fit(staged)})
    tab.page.wait_for_function("window.w")
    assert tab.page.locator("#f [data-value=colour]").count() == 0
    final = staged.surfaces["final"]
    green = np.tile(np.array([0, 255, 0], np.uint8), (len(final.vertices), 1))
    given = replace(
        staged,
        scan=replace(staged.scan, colours=np.zeros(staged.scan.vertices.shape, np.uint8)),
        surfaces={**staged.surfaces, "final": replace(final, colours=green)},
    )
    tab = page_of(PLACES, script, **{"f-data": scene.pack_fit(given)})
    tab.page.wait_for_function("window.w")
    tab.page.get_by_label("Colour of the scan").check(force=True)
    tab.page.wait_for_timeout(300)
    shown = Image.open(io.BytesIO(tab.page.locator("#f .ss-plate").screenshot())).convert("RGB")
    red, light, blue = np.moveaxis(np.asarray(shown).astype(int), 2, 0)
    assert ((light > red + 80) & (light > blue + 80)).mean() > 0.1
    assert "does not follow" in tab.page.inner_text("#f .ss-legend")
    assert tab.complaints == []


def test_the_widgets_fit_a_narrow_phone(browser, open_tab, page_of, staged: StagedFit) -> None:
    tab = page_of(PLACES, WIDGETS, **payloads(staged))
    tab.page.set_viewport_size({"width": 340, "height": 700})
    for name in "mfs":
        tab.page.locator(f"#{name}").scroll_into_view_if_needed()
        tab.page.wait_for_function(f"W.{name}")
    assert tab.page.evaluate("document.documentElement.scrollWidth") <= 340


def test_without_webgl_the_page_says_so_and_goes_on(page_of, staged: StagedFit) -> None:
    before = "OffscreenCanvas.prototype.getContext = () => null; HTMLCanvasElement.prototype.getContext = () => null;"
    tab = page_of(PLACES, WIDGETS, before=before, **payloads(staged))
    for name in "mfs":
        tab.page.locator(f"#{name}").scroll_into_view_if_needed()
        tab.page.wait_for_function(f"W.{name}")
        assert "WebGL is switched off or missing" in tab.page.inner_text(f"#{name}")
    tab.page.get_by_role("slider", name="Mode 1,").fill("1")
    tab.page.get_by_label("Model to scan").check(force=True)
    assert "Mean distance" in tab.page.inner_text("#f")
    assert tab.complaints == []


def test_the_picture_is_the_shape_that_numpy_draws(page_of) -> None:
    model = blob_model()
    tab = page_of(PLACE, VIEW, model=scene.pack_model(model))
    tab.page.wait_for_function("window.model && view.frames > 0")
    data = tab.page.evaluate("""() => view.png().then(async (blob) => {
      const bytes = new Uint8Array(await blob.arrayBuffer());
      return btoa(Array.from(bytes, (b) => String.fromCharCode(b)).join(""));
    })""")
    from PIL import Image

    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(int)
    rows, columns = np.nonzero(np.abs(pixels - 255).sum(axis=2) > 24)
    width, height = np.ptp(columns), np.ptp(rows)
    extent = np.ptp(model.mean_vertices, axis=0)
    assert abs(width / height - extent[0] / extent[1]) < 0.08
    assert height > 0.6 * pixels.shape[0]
