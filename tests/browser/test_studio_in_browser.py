"""The studio as a new user meets it: from raw scans to a report by clicks alone, and the same numbers by history.sh."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe
from pages import PANE, hear_signals
from pictures import change, drawn_share, same_as_kept

from shapespace.cli import main
from shapespace.datasets import organs
from shapespace.datasets.simulated_scan import random_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.studio.project import Project, with_cells

WINDOW = {"width": 1440, "height": 900}
MOST_CLICKS = 15


@contextmanager
def studio(project: Path | None, home: Path, name: str = "studio") -> Iterator[str]:
    """Run `shapespace studio`, or another command that shows a project, and yield its address."""
    command = [sys.executable, "-m", "shapespace", name, *([str(project)] if project else []), "--no-open"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=hear_signals,
        env={**os.environ, "XDG_STATE_HOME": str(home)},
    )  # fmt: skip
    try:
        assert process.stdout is not None
        yield process.stdout.readline().rpartition(" ")[2].strip()
    finally:
        process.terminate()
        _, errors = process.communicate(timeout=30)
        assert process.returncode in (0, -15, 143) and errors == ""


def barriers(tab) -> list[str]:
    """Return what axe calls a serious barrier on the page."""
    found = Axe().run(tab.page, options={"preload": False}).response["violations"]  # style sheets of parts
    return [
        f"{one['id']}: {one['nodes'][0]['html'][:120]}" for one in found if one["impact"] in ("serious", "critical")
    ]


class User:
    """A user who only clicks; the clicks are counted."""

    def __init__(self, tab) -> None:
        self.tab, self.clicks = tab, 0

    def click(self, testid: str) -> None:
        self.clicks += 1
        self.tab.page.get_by_test_id(testid).first.click()

    def sees(self, testid: str, seconds: float = 60.0) -> None:
        self.tab.page.get_by_test_id(testid).first.wait_for(timeout=1000 * seconds)

    def has_run(self, number: int, seconds: float = 300.0) -> None:
        state = f"document.querySelector('[data-testid=job-{number}]')?.classList.contains('done')"
        self.tab.until(f"{state} === true", seconds)


def has_drawn(tab, seconds: float = 60.0) -> None:
    """Wait until the result has drawn."""
    waits = (
        f"[...{PANE}.shadowRoot.querySelectorAll('.turning:not(.running, .refused), [aria-busy=true]')].some((part) => "
        "{ const box = part.getBoundingClientRect(); return box.top < innerHeight && box.bottom >= 0; })"
    )
    tab.until(
        f"{PANE}?.dataset.ready === 'true' && !{waits} && "
        "[...window.Shapespace.sceneParts.views].every((view) => view.rests)",
        seconds,
    )
    tab.page.wait_for_timeout(300)


def place_and_drag(tab, project: Path) -> None:
    """Name a vertex that is clicked on one surface, and drag the landmark on another one."""

    def stored(seconds: float = 30.0) -> int:
        end = time.monotonic() + seconds
        while not (marks := json.loads((project / "project.json").read_text())["landmarks"]):
            assert time.monotonic() < end
            tab.page.wait_for_timeout(100)
        return marks["tip"]

    tab.page.get_by_test_id("landmarks").locator("summary").click()
    box = tab.page.get_by_test_id("view-1").bounding_box()
    tab.page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    tab.page.get_by_test_id("landmark-name").fill("tip")
    tab.page.get_by_test_id("landmark-add").click()
    before = stored()
    tab.page.get_by_test_id("clear").click()
    tab.page.wait_for_timeout(500)
    x, y = tab.page.evaluate(
        "(() => { const v = window.shapespaceCells[2].view, b = v.canvas.getBoundingClientRect();"
        "const [x, y] = v.project(v._marks.get('marks')[0].position); return [b.left + x, b.top + y]; })()"
    )
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    tab.page.mouse.move(x, y + 25, steps=4)
    tab.page.mouse.up()
    tab.until(f"document.querySelector('[data-testid=landmark-vertex-tip]').value !== '{before}'")
    assert stored() != before


def exclude_in_morphospace(tab, user: User, project: Path) -> None:
    """Select a specimen in the morphospace, and exclude it by the bar of the page."""
    tab.page.get_by_test_id("tab-model").click()
    tab.page.get_by_test_id("more-morphospace").locator("summary").first.click()
    user.click("run-morphospace")
    user.has_run(4)
    has_drawn(tab)
    widget = tab.page.get_by_test_id("pane").locator("figure.turning .widget")
    widget.scroll_into_view_if_needed()
    widget.locator("select").nth(2).select_option("7")
    widget.get_by_role("button", name="Select this shape").press("Enter")
    user.sees("selection")
    user.click("exclude-selected")
    end = time.monotonic() + 30
    while all(one["included"] for one in json.loads((project / "project.json").read_text())["specimens"]):
        assert time.monotonic() < end
        tab.page.wait_for_timeout(100)


def vertices_apart(tab, view: str, positions: str) -> np.ndarray:
    """Return the direction in a picture from one vertex of the mean shape to another, of length 1."""
    points = [f"{view}.project(Array.from({positions}.subarray({3 * k}, {3 * k + 3})))" for k in (0, 150)]
    first, second = np.array(tab.page.evaluate(f"[{', '.join(points)}]"))[:, :2]
    return (second - first) / np.linalg.norm(second - first)


def name_a_view(tab, user: User) -> np.ndarray:
    """Turn the surfaces and name their view by the keyboard; return a direction in its picture."""
    tab.page.get_by_test_id("view-0").locator("canvas").first.focus()
    for key in ["ArrowUp"] * 5 + ["ArrowRight"] * 3:
        tab.page.keyboard.press(key)
    user.click("views-edit")
    tab.page.get_by_test_id("view-roll").focus()
    tab.page.keyboard.press("PageUp")
    tab.page.get_by_test_id("view-name").fill("dorsal")
    tab.page.keyboard.press("Enter")
    user.sees("named-view-dorsal")
    tab.shot("naming")
    assert barriers(tab) == []
    tab.page.get_by_test_id("view-rename-dorsal").fill("above")
    tab.page.keyboard.press("Enter")
    user.sees("named-view-above")
    tab.page.keyboard.press("Escape")
    named = vertices_apart(tab, "window.shapespaceCells[0].view", "window.shapespaceCells[0].positions")
    tab.page.get_by_test_id("front").click()
    front = vertices_apart(tab, "window.shapespaceCells[0].view", "window.shapespaceCells[0].positions")
    user.click("named-view-above")
    again = vertices_apart(tab, "window.shapespaceCells[0].view", "window.shapespaceCells[0].positions")
    assert named @ again > 0.9999 > 0.99 > named @ front
    return named


def is_outdated_until_undone(tab, user: User) -> None:
    """Change a class of the table: the answer that used it is marked on its screen and in the list of results."""
    tab.page.get_by_test_id("tab-specimens").click()
    tab.page.get_by_test_id("layout-table").click()
    tab.page.get_by_test_id("cell-bone_000-group").fill("elsewhere")
    tab.page.keyboard.press("Enter")
    tab.page.get_by_test_id("tab-export").click()
    user.sees("outdated")
    assert "1 result is outdated" in tab.page.get_by_test_id("outdated").inner_text()
    tab.page.get_by_test_id("tab-questions").click()
    tab.page.get_by_test_id("earlier-3").click()
    user.sees("outdated-3")
    assert tab.page.get_by_test_id("again-3").is_enabled()
    assert barriers(tab) == []
    tab.shot("outdated")
    tab.page.get_by_test_id("tab-model").click()
    assert tab.page.get_by_test_id("outdated-2").count() == 0, "the model does not depend on the table"
    tab.page.get_by_test_id("tab-specimens").click()
    tab.page.get_by_test_id("undo").click()
    tab.page.get_by_test_id("tab-export").click()
    tab.page.get_by_test_id("outdated").wait_for(state="detached")


def turn_scan(tab) -> None:
    """Open a raw scan in 3-D, look at it from behind, and close it."""
    tab.page.get_by_test_id("show-bone_000").click()
    view = tab.page.get_by_test_id("scan-view")
    tab.until("document.querySelector('[data-testid=scan-view]').dataset.ready === 'true'")
    tab.page.wait_for_timeout(800)
    front = view.screenshot()
    assert drawn_share(front) > 0.05
    length, unit = tab.page.get_by_test_id("scan-scale").inner_text().split(" ", 1)
    assert float(length) in (5, 10, 20, 50, 100) and unit == "units of the file"
    tab.page.get_by_test_id("scan-back").click()
    tab.page.wait_for_timeout(800)
    assert change(front, view.screenshot()) > 0.01
    tab.shot("scan")
    assert barriers(tab) == []
    tab.page.keyboard.press("Escape")
    view.wait_for(state="detached")


def write_bones(folder: Path, count: int, degrees: float = 180.0) -> Path:
    """Write bones rotated by up to `degrees`; in any pose, the search for the poses takes most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(organs, "random_similarity", lambda rng, _, scales: random_similarity(rng, degrees, scales))
        assert main(["data", "bones", "-o", str(folder), "--count", str(count), "--quiet"]) == 0
    return folder


@pytest.mark.parametrize("count", [4, pytest.param(12, marks=pytest.mark.long)])
def test_raw_scans_become_a_report_by_clicks_and_history_gives_the_same_numbers(
    open_tab, tmp_path: Path, count: int
) -> None:
    bones = write_bones(tmp_path / "scans", count)

    project = tmp_path / "bones"
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        user, began = User(tab), time.monotonic()
        user.sees("drop-zone")
        # What a drop does; the dialog of the system is not part of the page.
        tab.page.get_by_test_id("choose-files-input").set_input_files(
            [*sorted(bones.glob("*.ply")), bones / "bones.csv"]
        )
        tab.until("document.querySelectorAll('[data-testid^=card-] img').length === " + str(count))
        user.sees("counts")
        tab.page.wait_for_timeout(300)
        shot = tab.shot("specimens", clip={"x": 0, "y": 0, "width": 1440, "height": 740})  # below is nothing
        if count == 12:
            same_as_kept("screen-specimens.png", shot, width=1200)
        assert barriers(tab) == []
        user.click("next")
        tab.page.get_by_test_id("option--vertices").fill("800" if count == 12 else "300")
        if count == 4:
            tab.page.get_by_test_id("more-options").first.locator("summary").first.click()
            tab.page.get_by_test_id("option--rounds").fill("1")
        user.click("run-correspond")
        user.has_run(1)
        has_drawn(tab)
        shot = tab.shot("correspondence")
        if count == 12:
            same_as_kept("screen-correspondence.png", shot, width=1200)
        if count == 4:
            place_and_drag(tab, project)
            clicks, named = user.clicks, name_a_view(tab, user)
            user.clicks = clicks
        user.click("next")
        user.click("run-build")
        user.has_run(2)
        has_drawn(tab)
        tab.shot("model")
        assert barriers(tab) == []
        if count == 4:  # the view that was named on the surfaces is one of the model
            tab.page.get_by_test_id("named-view-above").click()
            mean = "window.shapespaceStage.a._things.get('model').object.geometry.attributes.position.array"
            assert vertices_apart(tab, "window.shapespaceStage.a", mean) @ named > 0.999
        user.click("next")
        user.click("question-compare")
        user.click("term-group")
        user.sees("checks")
        assert barriers(tab) == []
        user.click("run-compare")
        user.has_run(3)
        user.sees("sentences")
        assert "group" in tab.page.get_by_test_id("sentences").inner_text()
        has_drawn(tab)
        shot = tab.shot("answer")
        if count == 12:
            same_as_kept("screen-answer.png", shot, width=1200)
        seconds = time.monotonic() - began
        assert user.clicks <= MOST_CLICKS
        print(f"{user.clicks} clicks, {seconds:.0f} s from the drop to the report")
        for screen in ("fit", "export", "history"):
            tab.page.get_by_test_id(f"tab-{screen}").click()
            tab.page.wait_for_timeout(300)
            assert barriers(tab) == [], screen
        user.sees("history")
        assert "shapespace compare" in tab.page.get_by_test_id("history").inner_text()
        is_outdated_until_undone(tab, user)
        if count == 12:
            exclude_in_morphospace(tab, user, project)
        assert tab.complaints == [] and tab.asked == []
        with studio(project, tmp_path, "view") as place:
            seen = open_tab(place, WINDOW, "dark")
            User(seen).sees("row-bone_001")
            assert seen.page.get_by_test_id("choose-files").count() == 0
            seen.page.get_by_test_id("tab-model").click()
            assert seen.page.get_by_test_id("views").count() == seen.page.get_by_test_id("named-view-above").count()
            assert seen.page.get_by_test_id("views-edit").count() == 0
            seen.page.get_by_test_id("tab-questions").click()
            seen.page.get_by_test_id("earlier-3").click()
            User(seen).sees("sentences")
            has_drawn(seen)
            seen.shot("read-only")
            # A specimen that was excluded in the morphospace is in this answer.
            assert seen.page.locator("[data-testid^=outdated]").count() == (count == 12)
            assert seen.page.get_by_test_id("form-compare").count() == 0
            assert barriers(seen) == [] and seen.complaints == []
    again = tmp_path / "again"
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    subprocess.run(["sh", str(project / "history.sh"), str(again)], check=True, env={**os.environ, "PATH": path})
    first, second = (ShapeModel.load(folder / "model-2.h5") for folder in (project, again))
    assert np.array_equal(first.stddev, second.stddev) and np.array_equal(first.mean_vertices, second.mean_vertices)
    answers = [json.loads((folder / "compare-3" / "analysis.json").read_text()) for folder in (project, again)]
    for key in ("summary", "parts"):
        assert answers[0][key] == answers[1][key]


def test_what_was_dropped_edited_and_excluded_is_there_after_a_restart(open_tab, tmp_path: Path) -> None:
    bones = write_bones(tmp_path / "scans", 4)
    project = tmp_path / "p"
    broken = tmp_path / "broken.ply"
    broken.write_bytes(b"ply\nformat ascii 1.0\n")
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW, "dark")
        user = User(tab)
        user.sees("drop-zone")
        files = [*sorted(bones.glob("*.ply"))[:3], bones / "bones.csv", broken, bones / "bone_001.ply"]
        tab.page.get_by_test_id("choose-files-input").set_input_files(files)
        tab.until("document.querySelectorAll('[data-testid^=card-]').length === 4")
        tab.until("document.querySelectorAll('[data-testid^=card-] img').length === 3")
        # The table is taken after the scans; an undo before would take it back.
        tab.until("document.querySelector('[data-testid=upload-notes]')?.textContent.includes('bones.csv')")
        assert "bone_001" in tab.page.get_by_test_id("upload-notes").text_content()
        turn_scan(tab)
        tab.page.get_by_test_id("include-bone_002").click()
        tab.page.get_by_test_id("undo").click()
        tab.page.get_by_test_id("include-bone_000").click()
        for name in ("bone_001", "bone_002"):
            tab.page.get_by_test_id(f"select-{name}").click()
        tab.page.get_by_test_id("unit-selected").select_option("cm")
        tab.page.get_by_test_id("mirror-selected").click()
        tab.until("document.querySelector('[data-testid=mirror-selected]').innerText !== 'Mirror'")
        remove = tab.page.get_by_test_id("remove-selected").element_handle()
        in_bar = "(button) => [button.offsetLeft, button.offsetTop - button.parentElement.offsetTop]"
        place = remove.evaluate(in_bar)
        tab.page.get_by_test_id("group-selected").click()
        assert remove.evaluate(in_bar) == place
        tab.page.get_by_test_id("group-column").fill("place")
        tab.page.get_by_test_id("group-value").fill("north")
        tab.page.get_by_test_id("group-save").click()
        tab.page.get_by_test_id("group-form").wait_for(state="detached")
        # A click that meets the closing of the form goes to the button that was seen.
        assert remove.get_attribute("data-testid") == "remove-selected"
        assert remove.evaluate(in_bar) == place
        tab.page.get_by_test_id("clear-selection").click()
        tab.page.get_by_test_id("layout-table").click()
        tab.page.get_by_test_id("cell-bone_001-group").click()
        tab.page.keyboard.press("ControlOrMeta+a")
        tab.page.keyboard.type("hill")
        tab.page.keyboard.press("Enter")
        tab.until(
            "document.querySelector('[data-testid=undo]') && !document.querySelector('[data-testid=undo]').disabled"
        )
        tab.shot("dark")
        assert barriers(tab) == []
        tab.page.wait_for_timeout(500)
        assert tab.complaints == []
    stored = {one["id"]: one for one in json.loads((project / "project.json").read_text())["specimens"]}
    assert {name: one["included"] for name, one in stored.items()} == {
        "bone_000": False, "bone_001": True, "bone_002": True, "broken": False,
    }  # fmt: skip
    assert stored["bone_001"]["cells"]["group"] == "hill"
    for name in ("bone_001", "bone_002"):
        one = stored[name]
        assert (one["unit"], one["mirrored"], one["cells"]["place"]) == ("cm", True, "north")
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        tab.until("document.querySelectorAll('[data-testid^=row-]').length === 4")


COMPOSE = """(input, key) => {
  input.dispatchEvent(new KeyboardEvent("keydown", { key, isComposing: true, bubbles: true, cancelable: true }));
}"""


@pytest.mark.parametrize("locale", ["de-DE", pytest.param("ja-JP", marks=pytest.mark.pairs)])
def test_numbers_and_words_of_other_languages_are_typed_as_there(open_tab, tmp_path: Path, locale: str) -> None:
    project = Project.open(tmp_path / "p", create=True)
    for k in range(1, 4):
        path = project.new_file(f"s{k}.obj")
        path.write_text(f"v 0 0 0\nv {1500 * k} 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
        project.add(path, "training")
    project.edit(None, with_cells(("masse", "骨"), {}))
    with studio(project.folder, tmp_path) as address:
        tab = open_tab(address, WINDOW, locale=locale)
        User(tab).sees("cell-s1-masse")
        assert tab.page.evaluate("(1.5).toLocaleString()") == ("1,5" if locale == "de-DE" else "1.5")
        cell = tab.page.get_by_test_id("cell-s1-masse")
        cell.fill("3,5")
        cell.press("Enter")
        word = tab.page.get_by_test_id("cell-s1-骨")
        word.fill("大腿骨")
        for key in ("Enter", "ArrowDown"):
            word.evaluate(COMPOSE, key)
            assert word.evaluate("(input) => input === document.activeElement")
        word.press("Enter")
        tab.until("document.querySelector('[data-testid=cell-s1-骨]').dataset.edited === 'false'")
        tab.until(
            "document.querySelector('[data-testid=row-s2]')?.innerText.includes('3,000')"
        )  # numbers as in the texts
        tab.page.wait_for_timeout(500)
        assert tab.complaints == []
    assert Project.open(project.folder).state.specimens[0].cells == {"masse": "3.5", "骨": "大腿骨"}


@pytest.mark.parametrize("count", [60, pytest.param(1000, marks=pytest.mark.long)])
def test_many_files_are_taken_and_the_page_stays_usable(open_tab, tmp_path: Path, count: int) -> None:
    text = "v 0 0 0\nv {k} 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    files = []
    for k in range(1, count + 1):
        files.append(tmp_path / f"s{k:04d}.obj")
        files[-1].write_text(text.format(k=k))
    with studio(tmp_path / "p", tmp_path) as address:
        tab = open_tab(address, WINDOW)
        tab.until("document.querySelector('[data-testid=drop-zone]') !== null")
        tab.page.get_by_test_id("choose-files-input").set_input_files(files)
        tab.until(
            "document.querySelector('[data-testid=specimens-summary]')?.innerText.replace(',', '')"
            f".startsWith('{count} specimens')"
        )
        began = time.monotonic()
        tab.page.get_by_test_id("tab-history").click()
        tab.page.get_by_test_id("screen-history").wait_for()
        assert time.monotonic() - began < 5
        assert tab.complaints == []


@pytest.mark.long
def test_a_run_goes_on_when_the_server_is_killed_and_the_tab_closed(open_tab, tmp_path: Path) -> None:
    bones, project = write_bones(tmp_path / "scans", 4), tmp_path / "p"
    command = [sys.executable, "-m", "shapespace", "studio", str(project), "--no-open"]
    server = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env={**os.environ, "XDG_STATE_HOME": str(tmp_path)}
    )
    assert server.stdout is not None
    tab = open_tab(server.stdout.readline().rpartition(" ")[2].strip(), WINDOW)
    user = User(tab)
    user.sees("drop-zone")
    tab.page.get_by_test_id("choose-files-input").set_input_files(sorted(bones.glob("*.ply")))
    tab.until("document.querySelectorAll('[data-testid^=card-] img').length === 4")
    user.click("next")
    tab.page.get_by_test_id("option--vertices").fill("300")
    user.click("run-correspond")
    user.sees("progress-1")
    tab.until("document.querySelector('[data-testid=progress-1]').hasAttribute('value')")
    server.kill()
    server.communicate(timeout=30)  # its processes hold the pipe, and end with it
    tab.page.locator("#offline").wait_for()
    assert "does not answer" in tab.page.locator("#offline").inner_text()
    tab.page.close()
    with studio(project, tmp_path) as address:
        tab = open_tab(address, WINDOW)
        User(tab).sees("tab-correspondence")
        tab.page.get_by_test_id("tab-correspondence").click()
        User(tab).has_run(1)
        has_drawn(tab)
        assert tab.page.get_by_test_id("job-1").get_attribute("data-status") == "done"
        assert tab.complaints == []


PASTE = """(input, text) => {
  const data = new DataTransfer();
  data.setData("text/plain", text);
  input.dispatchEvent(new ClipboardEvent("paste", { clipboardData: data, bubbles: true, cancelable: true }));
}"""


def test_pasted_rows_find_their_specimens_and_a_second_tab_and_a_press_lose_nothing(open_tab, tmp_path: Path) -> None:
    names = [*(f"B{k}" for k in range(8, 12)), "B6AF1", "B6129"]
    files = []
    for k, name in enumerate(names, 1):
        files.append(tmp_path / f"{name}.obj")
        files[-1].write_text(f"v 0 0 0\nv {k} 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    project = tmp_path / "p"

    def stored(column: str) -> dict[str, str]:
        specimens = json.loads((project / "project.json").read_text())["specimens"]
        return {one["id"]: one["cells"].get(column, "") for one in specimens}

    with studio(project, tmp_path) as address:
        tab, other = open_tab(address, WINDOW), open_tab(address, WINDOW)
        tab.until("document.querySelector('[data-testid=drop-zone]') !== null")
        tab.page.get_by_test_id("choose-files-input").set_input_files(files)
        tab.until(f"document.querySelectorAll('[data-testid^=card-]').length === {len(names)}")
        tab.until("document.querySelector('[data-testid=uploads-close]') !== null")
        tab.page.get_by_test_id("layout-table").click()
        first = sorted(names, key=lambda name: (name[1:2].isdigit(), name))[0]
        # A sheet with its names and a new column, in the order of a spreadsheet, into a cell of names.
        sheet = "\n".join(["specimen\tmass", *(f"{name}\t{len(name)}.{k}" for k, name in enumerate(sorted(names)))])
        tab.page.get_by_test_id(f"cell-{first}-id").evaluate(PASTE, sheet)
        tab.until(f"document.querySelector('[data-testid=cell-{first}-mass]')?.value.length > 0")
        assert stored("mass") == {name: f"{len(name)}.{k}" for k, name in enumerate(sorted(names))}
        # Values without names are shown with the specimens that they would go to.
        shown = tab.page.evaluate(
            "[...document.querySelectorAll('tr[data-testid^=row-]')].map((row) => row.dataset.testid.slice(4))"
        )
        tab.page.get_by_test_id(f"cell-{shown[0]}-mass").evaluate(PASTE, "\n".join("abcdefg"))
        tab.page.get_by_test_id("paste").wait_for()
        rows = tab.page.get_by_test_id("paste").locator("tbody tr").all_inner_texts()
        assert [row.split() for row in rows] == [[name, letter] for name, letter in zip(shown, "abcdef", strict=True)]
        assert "1 row is not pasted" in tab.page.get_by_test_id("paste-notes").inner_text()
        tab.shot("paste")
        assert barriers(tab) == []
        tab.page.get_by_test_id("paste-cancel").click()
        assert stored("mass")[first] != "a"
        # A cell that is typed does not overwrite what another tab saves in the meantime.
        other.page.get_by_test_id("layout-table").click()
        cell = tab.page.get_by_test_id("cell-B8-mass")
        cell.fill("7")
        other.page.get_by_test_id("cell-B8-mass").fill("8")
        other.page.keyboard.press("Enter")
        other.until("document.querySelector('[data-testid=undo]').disabled === false")
        tab.page.wait_for_timeout(800)
        cell.press("Enter")
        tab.page.locator("#message").wait_for()
        assert "Another tab changed mass of B8 to '8'" in tab.page.locator("#message").inner_text()
        assert stored("mass")["B8"] == "8" and cell.input_value() == "8"
        # Nor does a group that is made, until the user has seen the other value.
        for name in ("B8", "B9"):
            tab.page.get_by_test_id(f"select-{name}").click()
        tab.page.get_by_test_id("group-selected").click()
        tab.page.get_by_test_id("group-column").fill("mass")
        tab.page.get_by_test_id("group-value").fill("big")
        other.page.get_by_test_id("cell-B9-mass").fill("9")
        other.page.keyboard.press("Enter")
        tab.until("document.querySelector('[data-testid=cell-B9-mass]').value === '9'")
        tab.page.get_by_test_id("group-save").click()
        tab.until("document.getElementById('message').innerText.includes(\"changed mass of B9 to '9'\")")
        assert (stored("mass")["B8"], stored("mass")["B9"]) == ("8", "9")
        tab.page.get_by_test_id("group-save").click()
        tab.page.get_by_test_id("group-form").wait_for(state="detached")
        assert (stored("mass")["B8"], stored("mass")["B9"]) == ("big", "big")
        # Nothing moves between press and release, so that the first click on Run counts.
        tab.page.get_by_test_id("tab-correspondence").click()
        long = tab.page.locator("[data-testid=form-correspond] .option:has(details.hint) >> visible=true").first
        long.locator("input, select").first.focus()
        run = tab.page.get_by_test_id("run-correspond")
        box = run.bounding_box()
        tab.page.mouse.move(box["x"] + 20, box["y"] + 10)
        tab.page.mouse.down()
        tab.page.wait_for_timeout(300)
        assert run.bounding_box() == box
        tab.page.mouse.up()
        tab.page.get_by_test_id("job-1").wait_for()
        assert other.complaints == []
