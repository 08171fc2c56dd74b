"""A browser that is there already, without a GPU or a display, and a record of what went wrong in each page."""

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from pages import DESKTOP, WICKED, World

from shapespace.cli import main
from shapespace.datasets.faces import load_faces
from shapespace.datasets.simulated_scan import Hair, Hole, simulate_scan
from shapespace.io.meshes.mesh_io import write_mesh

FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-gpu-compositing",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--force-color-profile=srgb",
]
"""WebGL by the processor, which would compose the page too, at half the time of its process; no talk with servers."""

SCREENSHOTS = Path(os.environ.get("SHAPESPACE_SCREENSHOTS", Path(__file__).resolve().parents[2] / "screenshots-out"))


@pytest.fixture(scope="session")
def browser() -> Iterator:
    """Chromium; a skip where there is none, an error where SHAPESPACE_BROWSER=required says that there must be one."""
    api = pytest.importorskip("playwright.sync_api", reason="the extra `test` is not installed")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        if os.environ.get("SHAPESPACE_BROWSER") == "required":
            pytest.fail("There is no Chromium, and SHAPESPACE_BROWSER=required asks for one.")
        pytest.skip("no Chromium on the PATH; install it to run the browser tests")
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield chromium
        chromium.close()


class Tab:
    """A page with what it complained of; a test ends with `tab.complaints == []`."""

    def __init__(self, context, name: str) -> None:
        self.page, self.name, self.complaints = context.new_page(), name, []
        self.page.set_default_timeout(60_000)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("console", self._heard)
        self.page.on("request", self._asked)
        self.asked: list[str] = []

    def _heard(self, message) -> None:
        # What WebGL by the processor says of its own speed is no fault of the page.
        if message.type in ("error", "warning") and "GPU stall" not in message.text:
            self.complaints.append(message.text)

    def _asked(self, request) -> None:
        if not request.url.startswith(("file:", "data:", "blob:", "http://127.0.0.1", "http://localhost")):
            self.asked.append(request.url)

    def until(self, expression: str, seconds: float = 120.0) -> None:
        """Wait until `expression` is true; the page's own policy forbids what wait_for_function does."""
        ends = time.monotonic() + seconds
        while not self.page.evaluate(expression):
            assert time.monotonic() < ends, f"not within {seconds:.0f} s: {expression}"
            self.page.wait_for_timeout(50)

    def shot(self, what: str, **options) -> Path:
        """Keep a screenshot for whoever looks at the run; return its path."""
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        path = SCREENSHOTS / f"{self.name}-{what}.png"
        self.page.screenshot(path=path, **options)
        return path


@pytest.fixture
def open_tab(browser, request):
    """Return a function that opens a page of its own visitor: open_tab(url, viewport, colour scheme)."""
    contexts = []

    def open_(url: str | None = None, viewport=DESKTOP, scheme: str = "light", **options) -> Tab:
        context = browser.new_context(viewport=viewport, color_scheme=scheme, **options)
        contexts.append(context)
        tab = Tab(context, request.node.name.removeprefix("test_").partition("[")[0])
        if url is not None:
            tab.page.goto(url)
        return tab

    yield open_
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
def world(made_once: Callable[[Callable[[Path], None]], Path]) -> World:
    return World(made_once(faces_and_fits))


def faces_and_fits(home: Path) -> None:
    faces, rng = load_faces(), np.random.default_rng(11)
    assert main(["data", "faces", "-o", str(home / "people"), "--subjects", "30", "--quiet"]) == 0
    assert main(["build", str(home / "people"), "-o", str(home / "model.h5"), "--quiet"]) == 0
    scans = home / "scans"
    scans.mkdir()
    damage = {"plain": {}, "holes": {"holes": (Hole(9.0), Hole(6.0))}, "hair": {"hair": Hair()}, "half": {"keep": 0.5}}
    rows = ["file,subject,expression"]
    for name, options in damage.items():
        truth = faces.face(faces.draw_person(rng), name=name)
        keep = options.pop("keep", None)
        scan = simulate_scan(truth, rng, triangles=12_000, noise_mm=0.2, **options).scan
        if keep is not None and scan.faces is not None:
            x = scan.vertices[scan.faces].mean(axis=1)[:, 0]
            scan = type(scan)(scan.vertices, scan.faces[x < np.quantile(x, keep)], name=name)
        write_mesh(scans / f"{name}.ply", scan)
        rows.append(f"{name}.ply,{name},{WICKED if name == 'hair' else 'neutral'}")
    (scans / "labels.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (scans / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 12\nproperty float x\n")
    fit = ["fit", "model.h5", "scans", "-o", "fits", "--stages", "--dense", "--jobs", "1", "--quiet"]
    with chdir(home):  # so that no sentence holds a path of this machine
        assert main(fit) == 1  # the broken one failed, the others went on
