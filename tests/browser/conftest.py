"""A browser that is there already, without a GPU or a display, and a record of what went wrong in each page."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

FLAGS = [
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--force-color-profile=srgb",
]
"""WebGL by the processor, and no talk with anybody's servers."""

DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 375, "height": 740}
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
