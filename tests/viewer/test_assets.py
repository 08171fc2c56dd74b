"""The static files of the pages: each page's scripts and styles are served, and libraries are the recorded files."""

import hashlib
import re
from importlib.resources import files

from shapespace.viewer.server import ASSETS, PAGES, SCENE


def test_the_page_asks_only_for_files_that_are_served_and_for_each_of_them() -> None:
    page, pane = ((PAGES / name).read_text("utf-8") for name in ("studio.html", "studio-pane.js"))
    asked = set(re.findall(r'(?:src|href)="/assets/([^"]+)"', page))
    lists = re.findall(r"const (SCRIPTS|STYLES) = \{(.*?)\};", pane, re.DOTALL)
    endings = {"SCRIPTS": "js", "STYLES": "css"}
    later = {f"{name}.{endings[kind]}" for kind, names in lists for name in re.findall(r'"([^"]+)"', names)}
    assert asked and len(lists) == 2
    assert asked | later == {*ASSETS, SCENE}
    assert all(path.is_file() for path in ASSETS.values())


def test_the_library_is_the_file_that_its_readme_records() -> None:
    folder = files("shapespace.viewer").joinpath("assets/vendor")
    library = folder.joinpath("preact-htm.min.js").read_bytes()
    assert hashlib.sha256(library).hexdigest() in folder.joinpath("README.md").read_text()


def test_the_licences_of_the_libraries_come_with_them() -> None:
    folder = files("shapespace.viewer").joinpath("assets/vendor")
    assert "Apache License" in folder.joinpath("LICENSE-APACHE").read_text("utf-8")
