"""The static files of the pages: each page's scripts and styles are served, and libraries are the recorded files."""

import hashlib
import re
from importlib.resources import files

import pytest

from shapespace.viewer.server import ASSETS, PAGES


@pytest.mark.parametrize("page", ["viewer.html", "surfaces.html", "studio.html"])
def test_a_page_asks_only_for_files_that_are_served(page: str) -> None:
    wanted = re.findall(r'(?:src|href)="/assets/([^"]+)"', (PAGES / page).read_text("utf-8"))
    assert wanted and set(wanted) <= set(ASSETS)


def test_every_served_file_exists_and_is_asked_for() -> None:
    pages = "".join(path.read_text("utf-8") for path in PAGES.glob("*.html"))
    for name, (path, _) in ASSETS.items():
        assert path.is_file() and f'"/assets/{name}"' in pages, name


@pytest.mark.parametrize("name", ["preact-htm.min.js", "uPlot.iife.min.js", "uPlot.min.css"])
def test_a_library_is_the_file_that_its_readme_records(name: str) -> None:
    folder = files("shapespace.viewer").joinpath("assets/vendor")
    assert hashlib.sha256(folder.joinpath(name).read_bytes()).hexdigest() in folder.joinpath("README.md").read_text()


def test_the_licences_of_the_libraries_come_with_them() -> None:
    folder = files("shapespace.viewer").joinpath("assets/vendor")
    assert "Leon Sorokin" in folder.joinpath("LICENSE-UPLOT").read_text("utf-8")
    assert "Apache License" in folder.joinpath("LICENSE-APACHE").read_text("utf-8")
