import base64
import importlib.util
import io
import json
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from report_page import Page, edit

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.report.pages.write_html import LARGEST_REPORT_BYTES, require_report_extra, write_report


@pytest.fixture
def folder(demo_template: Path, tmp_path: Path, sketched: None) -> Path:
    """A copy that may be damaged, reported without drawing."""
    shutil.copytree(demo_template, tmp_path / "demo")
    return tmp_path / "demo"


@pytest.fixture
def lean(folder: Path) -> Path:
    """The same without fits, for tests of what else the page is made of."""
    edit(folder, lambda demo: (demo["experiment1"].update(fits=[]), demo["experiment2"].update(cases=[])))
    return folder


@pytest.fixture(scope="module")
def page(demo_template: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("page") / "demo"
    shutil.copytree(demo_template, folder)
    path = write_report(folder)
    assert path == folder / "report.html"
    return path.read_text(encoding="utf-8")


def test_the_page_needs_nothing_from_outside(page: str) -> None:
    parsed = Page(page)
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:|//|file:)""", page)
    assert "@import" not in page and "url(" not in page
    for tag, attributes in parsed.tags:
        for key in ("src", "href"):
            value = attributes.get(key)
            assert value is None or value.startswith(("data:", "#")), (tag, value)
    assert len(page.encode()) <= LARGEST_REPORT_BYTES


def test_every_section_is_made_when_everything_is_there(page: str) -> None:
    assert 'class="broken"' not in page
    headings = Page(page).headings
    for wanted in ("Summary", "Comparison with the paper", "Experiment 1", "Experiment 2", "Distance maps"):
        assert wanted in headings
    order = [headings.index(name) for name in ("Summary", "Experiment 1", "Experiment 2")]
    assert order == sorted(order)


def test_every_picture_can_be_decoded_has_words_for_it_and_its_own_size(page: str) -> None:
    images = Page(page).images()
    assert len(images) >= 14
    for attributes in images:
        assert len(attributes["alt"] or "") > 12
        kind, _, data = (attributes["src"] or "").partition(",")
        assert kind == "data:image/webp;base64"
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            assert (str(image.width), str(image.height)) == (attributes["width"], attributes["height"])
            assert np.ptp(np.asarray(image.convert("L"))) > 100


def test_links_within_the_page_lead_somewhere(page: str) -> None:
    tags = Page(page).tags
    anchors = {attributes["id"] for _, attributes in tags if "id" in attributes}
    links = {str(attributes["href"])[1:] for tag, attributes in tags if tag == "a"}
    assert links and links <= anchors


def test_numbers_of_the_files_stand_in_the_page_with_units(page: str) -> None:
    words = Page(page).words
    for wanted in ("1.24 mm", "0.51 mm", "0.21 mm", "6 of 6", "Other expressions.", "0.938", "2026-01-02 03:04 UTC"):
        assert wanted in words


def test_a_simulated_scan_is_called_simulated(page: str) -> None:
    assert "Simulated scan. It has hair." in Page(page).words


def test_strings_from_files_stay_text(folder: Path) -> None:
    evil = "<script>alert(1)</script>\"'>&$x^ $"
    paths = {"file", "scan", "json", "stages", "model", "created", "status", "chirality", "format"}

    def poison(value: Any, key: str = "") -> Any:
        if isinstance(value, str):
            return value if key in paths else value + evil
        if isinstance(value, list):
            return [poison(item, key) for item in value]
        if isinstance(value, dict):
            return {
                (k + evil if key in ("versions", "scores", "line_spearman", "seconds") else k): poison(item, k)
                for k, item in value.items()
            }
        return value

    for path in [folder / "demo.json", *folder.glob("*/fits/*.fit.json")]:
        path.write_text(json.dumps(poison(json.loads(path.read_text()))))
    page = write_report(folder).read_text(encoding="utf-8")
    parsed = Page(page)
    assert "<script>alert" not in page and 'class="broken"' not in page
    assert "anger<script>alert(1)</script>" in parsed.words
    assert all(set(attributes) <= {"alt", "width", "height", "src", "decoding"} for attributes in parsed.images())
    assert all(tag != "script" or set(attributes) <= {"type", "id", "data-coding"} for tag, attributes in parsed.tags)


def test_control_characters_and_lone_surrogates_do_not_stop_the_report(lean: Path) -> None:
    edit(lean, lambda demo: demo.update(machine="a\x00b\ud800c\u202ed"))
    edit(lean, lambda demo: demo["experiment1"]["training_examples"][0].update(label="\u4f60\x07\ud801"))
    page = write_report(lean).read_text(encoding="utf-8")
    assert "\x00" not in page and "a\ufffdb\ufffdc" in page
    assert "4 faces of one person" in page


def test_a_section_that_fails_says_why_and_spares_the_rest(folder: Path) -> None:
    (folder / "experiment1" / "model.h5").unlink()
    (folder / "experiment1" / "training" / "002.ply").write_bytes(b"not a mesh")
    page = write_report(folder).read_text(encoding="utf-8")
    assert page.count('class="broken"') == 2
    words = Page(page).words
    assert "model.h5: there is no such file" in words and "002.ply" in words
    assert len(Page(page).images()) >= 10


def test_failed_and_unreadable_fits_are_named_and_cost_only_themselves(folder: Path) -> None:
    edit(folder, lambda demo: demo["experiment1"]["fits"][1].update(stages=None, vertex_error_mm=None, floor_mm=None))
    failed = {"format": "shapespace fit", "status": "failed", "reason": "The scan has 3 points only.", "config": {}}
    (folder / "experiment1" / "fits" / "anger_050.fit.json").write_text(json.dumps(failed))
    (folder / "experiment1" / "fits" / "smile_050.fit.json").write_text('{"status": ')
    page = write_report(folder).read_text(encoding="utf-8")
    assert 'class="broken"' not in page
    words = Page(page).words
    assert "4 of 6" in words and "Besides those that converged: 1 failed." in words
    assert "anger_050: The scan has 3 points only." in words
    assert "smile_050.fit.json is not JSON" in words
    pictures = " ".join(str(attributes["alt"]) for attributes in Page(page).images())
    assert "anger 50 %" not in pictures and "smile 50 %" not in pictures and "smile 100 %" in pictures


def test_files_outside_the_folder_are_not_read(lean: Path) -> None:
    secret = lean.parent / "secret.ply"
    shutil.copy(lean / "experiment1" / "training" / "000.ply", secret)
    for name in ("../secret.ply", str(secret)):
        edit(lean, lambda demo, name=name: demo["experiment1"]["training_examples"][0].update(file=name))
        page = write_report(lean).read_text(encoding="utf-8")
        assert "leads out of the folder" in page


def test_arrays_larger_than_their_file_are_refused_before_they_are_allocated(folder: Path) -> None:
    path = folder / "experiment2" / "fits" / "stranger.stages.npz"
    content = path.read_bytes()
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 3)})
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("mean.npy", stream.getvalue() + b"\0" * 24)
    edit(folder, lambda demo: demo["experiment1"].update(fits=[]))
    page = write_report(folder).read_text(encoding="utf-8")
    assert "does not match its header" in page
    path.write_bytes(content[: len(content) // 2])
    assert "cut short" in write_report(folder).read_text(encoding="utf-8")


def test_arrays_with_pickles_are_refused(folder: Path) -> None:
    edit(folder, lambda demo: demo["experiment1"].update(fits=[]))
    np.savez(folder / "experiment2" / "fits" / "stranger.stages.npz", mean=np.array([{"a": 1}], dtype=object))
    page = write_report(folder).read_text(encoding="utf-8")
    assert "does not match its header" in page


def test_a_damaged_demo_is_refused_in_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "demo.json").write_text("[1, 2]")
    with pytest.raises(FileFormatError, match="does not contain a JSON object"):
        write_report(tmp_path)
    (tmp_path / "demo.json").write_text("[" * 100_000)
    with pytest.raises(FileFormatError, match="is not JSON"):
        write_report(tmp_path)
    for key, value in (("experiment1", 3), ("experiment2", {"cases": [None]}), ("seconds", {"fit": "long"})):
        (tmp_path / "demo.json").write_text(json.dumps({key: value}))
        with pytest.raises(FileFormatError, match=r"demo\.json.*run the demo again"):
            write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_without_matplotlib_the_sentence_says_how_to_install_it(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    missing = lambda name: None if name == "matplotlib" else found(name)  # noqa: E731
    monkeypatch.setattr("shapespace.report.pages.write_html.find_spec", missing)
    for action in (require_report_extra, lambda: write_report(folder)):
        with pytest.raises(ShapespaceError, match=r"pip install 'shapespace\[report\]'"):
            action()


def test_the_report_module_loads_without_matplotlib() -> None:
    code = (
        "import sys; sys.modules['matplotlib'] = None; sys.modules['PIL'] = None; "
        "import shapespace.report.pages.write_html as h; "
        "print(h.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "shapespace.report.pages.write_html", done.stderr


def test_drawing_leaves_pyplot_alone() -> None:
    code = "import shapespace.report.figures, sys; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
