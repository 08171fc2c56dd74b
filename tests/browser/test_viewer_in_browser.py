"""The view of a model and of fits as a user meets it: sliders, distances, charts, files to take away."""

import csv
import io
import re
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pages import DESKTOP, ONE_WINDOW, PANE, PHONE, World, viewer
from pictures import change, drawn_share, same_as_kept
from PIL import Image

from shapespace.batch.fit_records import read_record
from shapespace.cli import main
from shapespace.io.meshes.mesh_io import read_mesh

MOVE = "(slider, value) => { slider.value = value; slider.dispatchEvent(new Event('input', {bubbles: true})); }"


@pytest.fixture(scope="module")
def address(world: World) -> Iterator[str]:
    with viewer(world.fits) as found:
        yield found


def test_a_viewer_whose_terminal_is_closed_leaves_nothing_behind(world: World) -> None:
    with viewer(world.model, signal.SIGHUP):
        pass


def ready(tab, part: str = "model"):
    tab.until(f"{PANE}?.dataset.ready === 'true'")
    tab.page.get_by_test_id(f"tab-{part}").click()
    return tab


def view(tab) -> bytes:
    # What is drawn coarsely while it moves is drawn finely at rest.
    # A change takes effect in the next frame.
    tab.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    tab.until(f"{PANE}.shadowRoot.getElementById('loading').hidden && window.shapespaceStage.a.rests")
    return tab.page.get_by_test_id("view").screenshot()


def slide(tab, mode: int, value: float) -> None:
    tab.page.get_by_test_id(f"mode-{mode}").evaluate(MOVE, value)


@pytest.mark.parametrize(("viewport", "scheme"), ONE_WINDOW)
def test_the_model_is_shown_and_a_slider_changes_it(open_tab, address: str, viewport: dict, scheme: str) -> None:
    tab = ready(open_tab(address, viewport, scheme))
    mean = view(tab)
    assert drawn_share(mean) > 0.1
    slide(tab, 1, 3.0)
    moved = view(tab)
    assert change(mean, moved) > 0.01
    tab.shot(f"{viewport['width']}-{scheme}")
    assert tab.page.get_by_test_id("value-1").inner_text().lstrip("+").startswith("3.0")
    tab.page.get_by_test_id("reset-all").click()
    assert change(mean, view(tab)) < 0.002
    assert tab.complaints == []
    assert tab.asked == []


def test_a_slider_moves_by_the_keyboard(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    mean = view(tab)
    tab.page.get_by_test_id("mode-2").focus()
    for _ in range(20):
        tab.page.keyboard.press("ArrowRight")
    assert change(mean, view(tab)) > 0.002


def test_the_map_of_displacement_is_painted(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    slide(tab, 1, 2.0)
    plain = view(tab)
    tab.page.get_by_test_id("map").check()
    assert change(plain, view(tab)) > 0.05
    assert "mm" in tab.page.get_by_test_id("colour-bar").inner_text()


def test_random_shapes_differ_and_reset_comes_home(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    mean = view(tab)
    tab.page.get_by_test_id("random").click()
    first = view(tab)
    tab.page.get_by_test_id("random").click()
    assert change(first, view(tab)) > 0.01
    tab.page.get_by_test_id("reset-all").click()
    assert change(mean, view(tab)) < 0.002


def test_exports_are_the_shape_that_is_shown(open_tab, address: str, world: World, tmp_path: Path) -> None:
    tab = ready(open_tab(address))
    slide(tab, 1, 2.0)
    from shapespace.model.shape_model import ShapeModel

    model = ShapeModel.load(world.model)
    wanted = model.reconstruct(np.array([2.0 * model.stddev[0]]))
    for kind in ("ply", "obj", "stl"):
        with tab.page.expect_download() as waiting:
            tab.page.get_by_test_id("panel-model").get_by_test_id(f"export-{kind}").click()
        waiting.value.save_as(tmp_path / f"s.{kind}")
        mesh = read_mesh(tmp_path / f"s.{kind}")
        if kind != "stl":
            assert np.allclose(mesh.vertices, wanted, atol=1e-3)
        assert np.allclose(mesh.vertices.max(axis=0), wanted.max(axis=0), atol=1e-3)
    with tab.page.expect_download() as waiting:
        tab.page.get_by_test_id("panel-model").get_by_test_id("export-csv").click()
    waiting.value.save_as(tmp_path / "s.csv")
    rows = list(csv.reader(io.StringIO((tmp_path / "s.csv").read_text())))
    assert any("2" in cell for row in rows for cell in row)
    with tab.page.expect_download() as waiting:
        tab.page.get_by_test_id("export-png").click()
    waiting.value.save_as(tmp_path / "s.png")
    assert drawn_share(tmp_path / "s.png") > 0.1


def test_saved_fits_come_doubtful_ones_first_and_step_through(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    tab.page.get_by_test_id("tab-fits").click()
    rows = tab.page.get_by_test_id("fit")
    rows.first.wait_for()
    chosen = tab.page.locator('[data-testid="fit"][aria-selected="true"]')
    assert "converged" in (chosen.get_attribute("class") or "")  # it opens on the first good fit
    assert tab.page.get_by_test_id("fit-filter").is_hidden()  # there are few
    assert rows.first.get_attribute("data-name") == "broken"
    seen = []
    for _ in range(rows.count()):
        tab.page.get_by_test_id("next-doubtful").click()
        seen.append(tab.page.get_by_test_id("fit-detail").inner_text())
    assert any("broken" in detail for detail in seen)
    assert not any("Converged; robust residual SD" in detail for detail in seen)
    tab.page.locator('[data-testid="fit"][data-name="holes"]').click()
    tab.until(f"{PANE}.shadowRoot.querySelector('.ss-caption').textContent.startsWith('holes')")
    told = tab.page.get_by_test_id("fit-detail").get_by_test_id("shown").inner_text()
    assert "mean where the scan shows it" in told and "mean where the model covers it" in told
    shown = view(tab)
    assert drawn_share(shown) > 0.1
    tab.shot("holes")
    tab.page.get_by_test_id("fit-moment").evaluate(
        "e => { e.value = 0; e.dispatchEvent(new Event('input', {bubbles: true})); }"
    )
    assert change(shown, view(tab)) > 0.01
    assert tab.complaints == []


def inked(chart) -> tuple[str, int]:
    """Return the colour of a chart's lines and points, and how many pixels have it, at two per CSS pixel."""
    accent = chart.evaluate("(chart) => getComputedStyle(chart).getPropertyValue('--accent').trim()")
    pixels = np.asarray(Image.open(io.BytesIO(chart.screenshot())).convert("RGB"))
    assert pixels.shape[1] == round(2 * chart.bounding_box()["width"])
    return accent, int((pixels == list(bytes.fromhex(accent[1:]))).all(axis=2).sum())


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.pairs)])
def test_charts_show_the_iterations_and_the_coefficients(open_tab, address: str, world: World, scheme: str) -> None:
    tab = ready(open_tab(address, scheme=scheme, device_scale_factor=2), "fits")
    tab.page.locator('[data-testid="fit"][data-name="plain"]').click()
    tab.until(f"{PANE}.shadowRoot.querySelector('.ss-caption').textContent.startsWith('plain')")
    detail, moment = tab.page.get_by_test_id("fit-detail"), tab.page.get_by_test_id("fit-moment")
    rms, bars = detail.get_by_role("img", name="RMS distance by"), detail.get_by_role("img", name="Coefficients in")
    last = int(moment.get_attribute("max"))
    assert rms.get_attribute("data-points") == str(last + 1) and rms.get_attribute("data-now") == str(last)
    at_last = rms.screenshot()
    moment.evaluate(MOVE, 2)
    assert rms.get_attribute("data-now") == "2"
    assert change(at_last, rms.screenshot()) > 0.001
    record = read_record(world.fits / "plain.fit.json")
    K = min(len(record.b), 20)
    assert bars.get_attribute("data-points") == str(K)
    for chart in (rms, bars):
        before, ink = inked(chart)
        assert ink > 300

    bars.scroll_into_view_if_needed()
    tab.page.wait_for_timeout(50)
    x0, y0, x1, y1 = box(bars.locator(".band"))
    tab.page.mouse.move(x0 + 2.5 / K * (x1 - x0), (y0 + y1) / 2)
    told = bars.locator(".tip")
    told.wait_for()
    tab.shot(scheme)
    assert re.fullmatch(r"mode 3: [+\u2212]\d\.\d\d \u00b1 \d\.\d\d", told.inner_text())
    assert told.inner_text().split()[2] == f"{record.z[2]:+.2f}".replace("-", "\u2212")
    tab.page.mouse.move(x0, y0 - 200)
    assert told.is_hidden()

    tab.page.get_by_test_id("theme").click()
    tab.until("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
    for chart in (rms, bars):
        after, ink = inked(chart)
        assert ink > 300 and after != before
    tab.page.get_by_test_id("tab-compare").click()
    tab.page.get_by_test_id("compare-a").select_option("fit plain")
    both = tab.page.get_by_role("img", name="Coefficients in standard deviations, from and to")
    assert both.get_attribute("data-points") == str(2 * K)
    assert both.locator(".title span").all_inner_texts()[1:] == ["from", "to"]
    tab.page.set_viewport_size(PHONE)
    chart = f"{PANE}.shadowRoot.getElementById('compare-chart')"
    tab.until(f"{chart}.querySelector('svg').clientWidth === {chart}.clientWidth")
    tab.shot(f"phone-{scheme}")
    assert tab.complaints == []


def test_fits_without_stages_are_drawn_and_one_without_its_scan_says_so(open_tab, world: World, tmp_path: Path) -> None:
    for name in ("fits", "scans"):
        ignored = shutil.ignore_patterns("*.stages.npz")
        shutil.copytree(world.home / name, tmp_path / name, ignore=ignored)
    shutil.copy(world.model, tmp_path)
    (tmp_path / "scans" / "holes.ply").unlink()
    with viewer(tmp_path / "fits", signal.SIGTERM) as address:
        tab = ready(open_tab(address))
        tab.page.get_by_test_id("tab-fits").click()
        for name, alone in (("plain", False), ("holes", True)):
            tab.page.locator(f'[data-testid="fit"][data-name="{name}"]').click()
            tab.until(f"{PANE}.shadowRoot.querySelector('.ss-caption').textContent === '{name}. The fitted model'")
            assert drawn_share(view(tab)) > 0.1
            assert (tab.page.get_by_test_id("fit-without-scan").count() == 1) is alone
            assert (tab.page.locator("[data-testid=fit-colour] [data-value=model]").count() == 0) is alone
            assert tab.page.locator("[data-testid=fit-colour] [data-value=regions]").count() == 0
        tab.shot("alone")
        assert tab.complaints == []


def test_the_difference_is_told_by_what_it_moves(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    slide(tab, 1, 1.0)
    tab.page.get_by_test_id("more-modes").click()
    tab.page.locator("[data-testid=sliders] input[type=range]").last.evaluate(MOVE, 3.0)
    tab.page.get_by_test_id("tab-compare").click()
    told = tab.page.get_by_test_id("compare-facts").inner_text()
    assert "mode 1: it moves" in told and "at +1.00 standard deviations" in told


def add_csv(tab, path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
    tab.page.get_by_test_id("csv-file").set_input_files(path)


def test_coefficients_of_another_model_are_refused(open_tab, address: str, world: World, tmp_path: Path) -> None:
    tab = ready(open_tab(address), "compare")
    message, to = tab.page.get_by_test_id("message"), tab.page.get_by_test_id("compare-b")
    text = (world.fits / "coefficients.csv").read_text()
    head, *rows = list(csv.reader(io.StringIO(text)))
    K = sum(name[1:].isdigit() and name[0] == "z" for name in head)

    def table(keep) -> str:
        kept = [i for i, name in enumerate(head) if keep(name)]
        return "\n".join(",".join(row[i] for i in kept) for row in (head, *rows)) + "\n"

    fewer = table(lambda name: name == "scan" or (name[0] == "z" and name[1:].isdigit() and int(name[1:]) <= K - 2))
    add_csv(tab, tmp_path / "fewer.csv", fewer)
    message.wait_for(state="visible")
    assert f"fewer.csv contains {K - 2} coefficients and model.h5 has {K}" in message.inner_text()
    holes = table(lambda name: name == "scan" or (name[0] == "z" and name[1:].isdigit() and name != "z3"))
    add_csv(tab, tmp_path / "holes.csv", holes)
    tab.until("document.querySelector('[data-testid=message]').innerText.includes('holes.csv')")
    at = head.index("b2")
    scaled = [head] + [[*row[:at], str(2 * float(row[at])), *row[at + 1 :]] for row in rows if row[at]]
    add_csv(tab, tmp_path / "other.csv", "\n".join(",".join(row) for row in scaled) + "\n")
    tab.until("document.querySelector('[data-testid=message]').innerText.includes('another model')")
    assert "csv" not in to.inner_text()

    add_csv(tab, tmp_path / "own.csv", text)
    message.wait_for(state="hidden")  # the older message goes when something succeeds
    assert "(own.csv)" in to.inner_text()
    # What the viewer writes itself is read again.
    with tab.page.expect_download() as waiting:
        tab.page.get_by_test_id("tab-model").click()
        slide(tab, 2, 1.5)
        tab.page.get_by_test_id("panel-model").get_by_test_id("export-csv").click()
    waiting.value.save_as(tmp_path / "shape.csv")
    tab.page.get_by_test_id("tab-compare").click()
    tab.page.get_by_test_id("csv-file").set_input_files(tmp_path / "shape.csv")
    tab.until(f"{PANE}.shadowRoot.getElementById('compare-b').innerText.includes('(shape.csv)')")
    assert message.is_hidden()
    assert tab.complaints == []


def box(locator) -> tuple[float, float, float, float]:
    found = locator.bounding_box()
    return found["x"], found["y"], found["x"] + found["width"], found["y"] + found["height"]


@pytest.mark.parametrize("viewport", [pytest.param(DESKTOP, marks=pytest.mark.pairs), PHONE], ids=["desktop", "phone"])
def test_a_message_covers_nothing_and_goes(open_tab, address: str, tmp_path: Path, viewport: dict) -> None:
    tab = ready(open_tab(address, viewport))
    tab.page.get_by_test_id("map").check()
    message = tab.page.get_by_test_id("message")

    def fail() -> None:
        tab.page.get_by_test_id("tab-compare").click()
        add_csv(tab, tmp_path / "notes.csv", "not a table")
        message.wait_for(state="visible")

    fail()
    tab.shot(f"{viewport['width']}")
    x0, y0, x1, y1 = box(message)
    for name in ("view", "view-home", "export-png", "tab-model", "csv-button"):
        a0, b0, a1, b1 = box(tab.page.get_by_test_id(name))
        assert min(x1, a1) - max(x0, a0) < 1 or min(y1, b1) - max(y0, b0) < 1, name
    tab.page.get_by_test_id("message-close").click()
    assert message.is_hidden()
    fail()
    tab.page.keyboard.press("Escape")
    assert message.is_hidden()
    fail()
    tab.page.get_by_test_id("tab-model").click()
    message.wait_for(state="hidden")
    fail()
    tab.page.route("**/api/export*", lambda route: route.abort())
    tab.page.get_by_test_id("tab-model").click()
    tab.page.get_by_test_id("panel-model").get_by_test_id("export-ply").click()
    tab.until("document.querySelector('[data-testid=message]').innerText.includes('does not answer')")
    tab.page.wait_for_timeout(200)
    assert message.is_visible()  # a failure is no success


def test_on_a_phone_no_key_covers_the_picture(open_tab, address: str) -> None:
    tab = ready(open_tab(address, PHONE), "fits")
    tab.page.locator('[data-testid="fit"][data-name="holes"]').click()
    for colour, key in (("plain", "legend"), ("regions", "legend"), ("model", "colour-bar")):
        tab.page.get_by_test_id("fit-detail").locator(f"[data-testid=fit-colour] [data-value={colour}]").click()
        tab.page.evaluate(f"{PANE}.shadowRoot.querySelector('.shown').scrollTop = 0")
        below = box(tab.page.get_by_test_id(key))
        assert below[1] >= box(tab.page.get_by_test_id("view"))[3] - 1
        assert below[3] <= box(tab.page.get_by_test_id("tab-fits"))[1] + 1


def test_the_names_of_files_keep_their_letters(open_tab, address: str) -> None:
    tab = open_tab()
    told = {
        "a": ("failed", "broken.ply: it is empty."),
        "b": ("doubtful", "Do not trust this fit: its vertices are expected to be 9.0 mm off."),
    }
    rows = [
        {"name": name, "label": name, "status": status, "reason": reason, "pictured": False, "why_not": "",
         "z": None, "scan_to_model_mm": None if name == "a" else 1.234,
         "expected_error_mm": None}
        for name, (status, reason) in told.items()
    ]  # fmt: skip
    rows += [{**rows[1], "name": f"fit {k}", "label": f"fit {k}", "status": "converged"} for k in range(12)]
    tab.page.route("**/api/fits", lambda route: route.fulfill(json=rows))
    tab.page.goto(address)
    ready(tab, "fits")
    detail = tab.page.get_by_test_id("fit-detail")
    tab.page.locator('[data-testid="fit"][data-name="a"]').click()
    assert "broken.ply: it is empty." in detail.inner_text()
    tab.page.locator('[data-testid="fit"][data-name="b"]').click()
    assert "Its vertices are expected" in detail.inner_text()
    assert "scan to model, mean" in tab.page.get_by_test_id("fit-head").inner_text()
    assert "1.23 mm" in tab.page.locator('[data-testid="fit"][data-name="b"]').inner_text()
    # About ten of them are seen at once, and a filter finds the others.
    lists = tab.page.get_by_test_id("fit-list").bounding_box()
    row = tab.page.get_by_test_id("fit").first.bounding_box()
    assert 9 <= lists["height"] / row["height"] <= 11
    tab.shot("list")
    tab.page.get_by_test_id("fit-filter").fill("Fit 1")
    shown = [one.get_attribute("data-name") for one in tab.page.get_by_test_id("fit").all() if one.is_visible()]
    assert shown == ["fit 1", "fit 10", "fit 11"]
    assert "3 of 14 fits" in tab.page.get_by_test_id("fit-filter-said").inner_text()
    tab.page.get_by_test_id("fit-filter").fill("failed")
    shown = [one.get_attribute("data-name") for one in tab.page.get_by_test_id("fit").all() if one.is_visible()]
    assert shown == ["a"]


@pytest.mark.long
def test_a_fit_of_james_is_shown_beside_his_scan(open_tab, shared_data: Path, tmp_path: Path) -> None:
    """By a model of 200 ICT people."""
    from shapespace.datasets.ict import landmark_vertices, load_ict
    from shapespace.model.shape_model import ShapeModel

    ict = load_ict(shared_data / "ict-facekit")
    meshes = [ict.mesh(c, name=f"{i}") for i, c in enumerate(ict.draw_people(200, seed=1))]
    path = tmp_path / "people.h5"
    ShapeModel.fit(meshes, modes=None, landmarks=landmark_vertices("face")).save(path)
    scan = shared_data / "james" / "james.obj"
    assert main(["fit", str(path), str(scan), "-o", str(tmp_path / "fits"), "--stages", "--quiet"]) == 0
    with viewer(tmp_path / "fits") as address:
        tab = ready(open_tab(address, {"width": 1200, "height": 720}), "fits")
        panel = tab.page.get_by_test_id("fit-detail")
        panel.locator("[data-value=side]").click()
        panel.locator("[data-value=model]").click()
        tab.page.wait_for_timeout(1500)
        assert drawn_share(view(tab)) > 0.1
        same_as_kept("viewer.png", tab.shot("readme"))
        assert tab.complaints == []


def test_a_link_shows_the_same_and_back_goes_back(open_tab, address: str) -> None:
    tab = ready(open_tab(address))
    slide(tab, 2, -1.5)
    tab.page.evaluate("window.shapespaceStage.a.camera = { yaw: 0.7, pitch: 0.2, zoom: 0.8 }")
    tab.until("location.hash.includes('camera=0.7')")
    link = tab.page.url
    assert "z=2:-1.5" in link and "tab=model" in link
    shown = view(tab)
    other = open_tab(address)
    other.page.goto(link)
    other.page.reload()
    other.until(f"{PANE}?.dataset.ready === 'true'")
    assert other.page.get_by_test_id("value-2").inner_text() == "\u22121.50"
    assert change(shown, view(other)) < 0.002
    fits = link.partition("#")[0] + "#?tab=fits&fit=holes"
    other.page.goto(fits)
    other.until(f"{PANE}.shadowRoot?.querySelector('.ss-caption')?.textContent.startsWith('holes')")
    other.page.go_back()
    shows_model = f"{PANE}.shadowRoot?.querySelector('[data-testid=value-2]')?.innerText === '\u22121.50'"
    other.until(shows_model)
    # A view that is about to be written into the address does not replace an address whose event comes late.
    other.until(f"{PANE}.dataset.ready === 'true'")
    other.page.evaluate(
        """fits => {
          window.shapespaceStage.a.camera = { yaw: 0.1, pitch: 0.2, zoom: 0.8 };
          history.pushState(null, "", fits);
          setTimeout(() => dispatchEvent(new HashChangeEvent("hashchange")), 500);
        }""",
        "#?tab=fits&fit=holes",
    )
    other.until(f"{PANE}.shadowRoot?.querySelector('.ss-caption')?.textContent.startsWith('holes')")
    assert tab.complaints == [] and other.complaints == []


def test_the_token_does_not_stay_in_the_address_and_a_link_from_elsewhere_leads_in(
    open_tab, address: str, tmp_path: Path
) -> None:
    page_at, _, token = address.partition("?")
    assert token.startswith("token=")
    tab = ready(open_tab(address))
    assert tab.page.url.partition("#")[0] == page_at
    assert "token" not in tab.page.evaluate("performance.getEntries()[0].name")
    tab.page.reload()
    ready(tab)
    assert tab.page.evaluate("history.length") <= 2  # the empty page it was opened with, and this one
    mail = tmp_path / "mail.html"
    mail.write_text(f'<a href="{address}">The viewer</a>')
    other = open_tab(mail.as_uri())
    other.page.get_by_role("link").click()
    ready(other)
    assert other.page.url.partition("#")[0] == page_at
    assert tab.complaints == [] and other.complaints == []
