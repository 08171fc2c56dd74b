"""The report of a folder of fits: what it says, in which order, how large it gets, and what damaged files cost."""

import base64
import hashlib
import io
import itertools
import json
import os
import re
import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_page import Page, edit

from shapespace.batch.workers import DRAWING, deferred_calls
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.tables.table_io import write_rows
from shapespace.report.pages import folder_page
from shapespace.report.pages.write_html import LARGEST_REPORT_BYTES, write_report
from shapespace.report.render import scene

EVIL = "</script><script>alert(1)</script>"


def report(folder: Path, **options: object) -> str:
    path = write_report(folder, folder.parent / "r.html", **options)
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(fits_template: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Drawn once in full."""
    steps: list[tuple[str, int]] = []
    path = tmp_path_factory.mktemp("page") / "it.html"
    assert write_report(fits_template / "out", path, on_step=lambda *step: steps.append(step)) == path
    assert 0.5 * steps[0][1] <= len(steps) <= 1.5 * steps[0][1]
    return path.read_text(encoding="utf-8")


def test_pictures_drawn_by_other_processes_are_the_same(fits_template: Path, page: str, tmp_path: Path) -> None:
    with deferred_calls(*DRAWING) as defer:
        path = write_report(fits_template / "out", tmp_path / "it.html", defer=defer)
    assert path.read_text(encoding="utf-8") == page


def test_every_part_is_there_in_order_and_none_is_broken(page: str) -> None:
    assert 'class="broken"' not in page
    headings = [text.strip() for text in Page(page).headings]
    wanted = ["6 fits in out", "Summary", "The fits", "Every fit in numbers", "charlie in detail"]
    wanted += ["The fits together", "The model", "Settings, versions and hashes"]
    at = [headings.index(text) for text in wanted]
    assert at == sorted(at)
    assert "Recognition" not in headings


def test_details_of_several_fits_are_folded_and_settings_told_in_words(page: str) -> None:
    parts = re.findall(r'<details class="part"><summary><h3 id="pictures-of-([^"]+)"', page)
    assert parts[0] == "charlie" and len(parts) == 3
    words = Page(page).words
    assert "found from the size of each scan" in words and "at most 4 in each phase" in words


def test_headings_go_down_one_level_at_a_time(page: str) -> None:
    levels = [int(tag[1]) for tag, _ in Page(page).tags if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_every_picture_has_words_and_every_link_a_target(page: str) -> None:
    parsed = Page(page)
    assert len(parsed.images()) > 20
    assert all(len(image["alt"] or "") > 10 for image in parsed.images())
    places = [attributes["id"] for _, attributes in parsed.tags if "id" in attributes]
    assert len(places) == len(set(places))
    links = {str(attributes["href"])[1:] for tag, attributes in parsed.tags if tag == "a"}
    assert links <= set(places)
    named = {attributes["aria-labelledby"] for _, attributes in parsed.tags if "aria-labelledby" in attributes}
    assert named <= set(places)


def test_a_label_that_is_a_script_stays_text_everywhere(page: str) -> None:
    parsed = Page(page)
    assert EVIL not in page and "<script>alert" not in page
    assert parsed.words.count(EVIL) >= 3
    payloads = re.findall(r'<script type="application/octet-stream"[^>]*>(.*?)</script>', page, re.DOTALL)
    assert len(payloads) == 2 + 3
    assert all(re.fullmatch(r"[A-Za-z0-9+/=\s]+", payload) for payload in payloads)


def test_only_its_own_scripts_and_style_may_run(page: str) -> None:
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    assert policy is not None
    assert "default-src 'none'" in policy[1] and "unsafe" not in policy[1] and "http" not in policy[1]
    parts = dict(part.strip().split(" ", 1) for part in policy[1].split(";"))
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        texts = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        hashes = {f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in texts}
        assert hashes and set(parts[rule].split()) == hashes
    assert not [tag for tag, attributes in Page(page).tags for key in attributes if key == "style" or key[:2] == "on"]
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:|//|file:)""", page)


def test_both_ways_to_dark_have_the_same_colours(page: str) -> None:
    sets = re.findall(r":root[^{]*\{\s*color-scheme: dark;([^}]*)\}", page)
    assert len(sets) == 2 and len({" ".join(colours.split()) for colours in sets}) == 1


def luminance(colour: str) -> float:
    parts = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_the_contrast_of_wcag_aa(page: str, scheme: str) -> None:
    block = re.search(rf":root[^{{]*\{{\s*color-scheme: {scheme};([^}}]*)\}}", page)
    assert block is not None
    colours = dict(re.findall(r"--([a-z]+): (#[0-9a-f]{6})", block[1]))
    for ground in ("page", "card", "note"):
        for ink in ("ink", "soft", "accent", "good", "warn", "bad"):
            a, b = sorted((luminance(colours[ink]), luminance(colours[ground])))
            assert (b + 0.05) / (a + 0.05) >= 4.5, (ink, ground)


def test_failed_and_doubtful_fits_come_first_with_their_reason(page: str) -> None:
    words = Page(page).words
    cards = re.findall(r'<li class="card" id="([^"]+)"', page)
    assert cards[:2] == ["fit-broken", "fit-charlie"]
    assert "2 fits converged with no problems detected" in words and "1 could not be fitted" in words
    assert "broken.ply" in words and "No picture: the scan cannot be read." in words


def test_coefficients_by_different_models_are_never_compared(fits: Path, worded: None) -> None:
    def other(record: dict[str, Any]) -> None:
        record["model"]["hash"] = "0" * 64

    assert "cannot be compared" not in Page(report(fits)).words
    edit(fits, other, "able.fit.json")
    words = Page(report(fits)).words
    assert "The fits are by 2 different models, so their coefficients cannot be compared" in words
    words = Page(report(fits, model=fits.parent / "model.h5")).words
    assert "Fitted with another model than model.h5" in words and "cannot be compared" not in words


@pytest.mark.parametrize(("subject", "drawn"), [("s1", True), ("", False)])
def test_lines_through_neutral_need_one_known_subject(fits: Path, worded: None, subject: str, drawn: bool) -> None:
    rows = [("able", "calm", "0.5"), ("baker", "calm", "1"), ("charlie", "neutral", "0"), ("dog", "wild", "1")]
    write_rows(fits / "labels.csv", ("file", "expression", "intensity", "subject"), [(*row, subject) for row in rows])
    assert ("Larger marks are stronger expressions" in Page(report(fits)).words) == drawn


def test_messages_about_result_files_name_no_folder_of_the_machine(fits: Path, sketched: None) -> None:
    (fits / "able.fit.json").write_text("{")
    (fits / "baker.stages.npz").write_bytes(b"no")
    words = Page(report(fits)).words
    assert "able.fit.json is not JSON" in words and "baker.stages.npz is not an .npz file" in words
    assert str(fits.parent.parent) not in words


def test_labels_are_found_beside_the_scans_and_can_be_given(fits: Path, worded: None) -> None:
    assert "Labels are from scans/labels.csv, next to the scans." in Page(report(fits)).words
    (fits / "labels.csv").write_text("name,label\nable,LOCAL\n")
    words = Page(report(fits)).words
    assert "Labels are from labels.csv in the folder." in words and "LOCAL" in words and "calm" not in words
    (fits.parent / "mine.csv").write_text("scan,group\nable.ply,GIVEN\n")
    assert "GIVEN" in Page(report(fits, labels=fits.parent / "mine.csv")).words


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"", b"file\nable.ply\n", b"a,b\n1,2\n", b'file,label\n"x'])
def test_a_damaged_table_of_labels_is_refused_when_given_and_told_when_found(
    fits: Path, worded: None, content: bytes
) -> None:
    (fits / "labels.csv").write_bytes(content)
    with pytest.raises(FileFormatError, match=r"labels\.csv"):
        report(fits, labels=fits / "labels.csv")
    assert "There are no labels:" in Page(report(fits)).words


def test_without_stages_scans_and_fitted_surfaces_are_drawn_with_their_distances(fits: Path, sketched: None) -> None:
    for path in fits.glob("*.stages.npz"):
        path.unlink()
    page = report(fits)
    words = Page(page).words
    assert 'class="broken"' not in page and "No picture: the scan is" not in words
    scans = sorted(f"../scans/{path.name}" for path in (fits.parent / "scans").glob("*.ply"))
    [command] = re.findall(r"shapespace fit (\S+) (.*) -o \. --stages", words)
    assert command[0] == "../model.h5" and set(command[1].split()) <= set(scans)
    assert len(command[1].split()) == len(list(fits.glob("*.fit.json")))
    alts = [str(image["alt"]) for image in Page(page).images()]
    assert [alt for alt in alts if alt.startswith("able: the scan, scan and model over each other, and a map")]
    assert [alt for alt in alts if alt.startswith("Signed distance maps of charlie")]
    assert not [alt for alt in alts if alt.startswith(("Regions of", "RMS of", "Scan and model of charlie by stage"))]
    assert "charlie in detail" in words


def test_without_stages_and_scans_the_fitted_surfaces_are_drawn_alone(fits: Path, sketched: None) -> None:
    for path in (*fits.glob("*.stages.npz"), *(fits.parent / "scans").glob("*.ply")):
        path.unlink()
    page = report(fits)
    words = Page(page).words
    assert "charlie: the scan is no longer where it was, or has changed; the fitted surface is shown alone." in words
    alts = [str(image["alt"]) for image in Page(page).images()]
    assert "The fitted surface of able" in alts and not [alt for alt in alts if "over each other" in alt]


def test_stages_with_an_impossible_header_leave_a_page_without_them(fits: Path, sketched: None) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<i8", "fortran_order": False, "shape": (True,)})
    with zipfile.ZipFile(fits / "baker.stages.npz", "w") as archive:
        archive.writestr("format_version.npy", header.getvalue() + bytes(8))
    page = Page(write_report(fits).read_text(encoding="utf-8"))
    assert "baker.stages.npz is not an .npz file of arrays" in page.words and "not an integer" in page.words
    assert "able" in page.words


def test_damaged_stages_and_records_cost_only_themselves(fits: Path, sketched: None) -> None:
    (fits / "baker.stages.npz").write_bytes(b"PK\x03\x04 nothing")
    (fits / "dog.fit.json").write_text('{"format": ')
    edit(fits, lambda record: record.update(distances_mm=3, evidence=[], history="x", notes={"a": 1}), "easy.fit.json")
    words = Page(report(fits)).words
    assert "dog.fit.json is not JSON" in words and "2 cannot be read" in words
    assert "easy.fit.json is damaged: expected" in words
    assert "baker.stages.npz is not an .npz file of arrays" in words
    assert "The fits together" in words and "charlie in detail" in words


@pytest.mark.parametrize("key", ["scan", "model", "config", "z", "b", "iterations", "seconds", "reason", "version"])
@pytest.mark.parametrize("value", [None, "text", [None]])
def test_a_record_with_a_part_of_another_kind_never_stops_the_report(
    fits: Path, sketched: None, key: str, value: object
) -> None:
    for path in [*fits.glob("*.npz"), *fits.glob("*.ply")]:
        path.unlink()
    edit(fits, lambda record: record.update({key: value}), "able.fit.json")
    assert "6 fits in out" in Page(report(fits)).headings


def test_a_model_that_was_moved_is_asked_for_and_taken(fits: Path, worded: None) -> None:
    shutil.move(fits.parent / "model.h5", fits.parent / "elsewhere.h5")
    page = report(fits)
    assert page.count('class="broken"') == 1 and "give it with --model" in Page(page).words
    assert 'class="broken"' not in report(fits, model=fits.parent / "elsewhere.h5")
    (fits.parent / "wrong.h5").write_bytes(b"no model")
    with pytest.raises(FileFormatError, match=r"wrong\.h5"):
        report(fits, model=fits.parent / "wrong.h5")


def test_scores_of_recognition_are_shown_where_there_are_some(fits: Path, worded: None) -> None:
    (fits / "recognition.json").write_text(json.dumps({"accuracy": 0.875, "by_class": {"calm": 0.5, EVIL: 1.0}}))
    words = Page(report(fits)).words
    assert "Recognition" in words and "0.875" in words and EVIL in words


def test_the_quality_of_the_model_is_shown_where_it_was_measured(fits: Path, worded: None) -> None:
    assert "Generalisation" not in Page(report(fits)).words
    (fits / "quality.json").write_text(json.dumps({"compactness": [0.5, 0.8], "generalisation": [2.0, 1.5]}))
    assert "Generalisation" in Page(report(fits)).words
    (fits / "quality.json").write_text('{"compactness": [0.5,')
    assert report(fits).count('class="broken"') == 1


def test_many_fits_stay_below_the_limit_and_the_rest_is_told(fits: Path, sketched: None) -> None:
    for k in range(60):
        for ending in ("fit.json", "stages.npz"):
            os.link(fits / f"able.{ending}", fits / f"more_{k:03}.{ending}")
        shutil.copy(fits / "broken.fit.json", fits / f"bad_{k:03}.fit.json")
    page = report(fits)
    words = Page(page).words
    assert len(page.encode()) <= LARGEST_REPORT_BYTES
    cards = re.findall(r'<li class="card" id="fit-([^"]+)"', page)
    assert len(cards) == folder_page.MOST_CARDS and "charlie" in cards
    assert f"{126 - len(cards)} other fits have no picture here" in words
    assert page.count('<tr><th scope="row"') > 126


def test_what_turns_becomes_a_still_where_the_file_would_grow_too_large(
    fits: Path, sketched: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapespace.report.pages.page.LARGEST_REPORT_BYTES", 1_600_000)
    monkeypatch.setattr(
        scene, "payload_html", lambda name, payload: f'<script type="x" id="{name}">{"A" * 300_000}</script>'
    )
    page = report(fits)
    assert len(page.encode()) < 1_600_000
    assert "It does not turn, so that this file stays below" in Page(page).words
    assert "Its pictures would make this file larger" in Page(page).words


def test_a_folder_without_results_is_refused_in_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="absent"):
        write_report(tmp_path / "absent")
    with pytest.raises(InputError, match="contains no fits"):
        write_report(tmp_path)
    (tmp_path / "a.fit.json").write_text("{")
    with pytest.raises(InputError, match="none of its 1 records can be read"):
        write_report(tmp_path)
    assert not (tmp_path / "report.html").exists()


def test_results_are_not_changed_and_the_page_is_the_same_again(fits: Path, sketched: None) -> None:
    before = {path.name: path.read_bytes() for path in fits.iterdir()}
    assert report(fits) == report(fits)
    assert {path.name: path.read_bytes() for path in fits.iterdir()} == before
