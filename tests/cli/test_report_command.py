"""The command `report`: one file, one line; and one sentence where there is nothing to report."""

import webbrowser
from pathlib import Path

import pytest

from conftest import Run, World

pytest.importorskip("matplotlib", reason="the extra `report` is not installed")


@pytest.fixture
def folder(run: Run, world: World, tmp_path: Path) -> Path:
    assert run("fit", world.model, world.scans[0], "-o", tmp_path / "out", "--stages", "--quiet").code == 0
    return tmp_path / "out"


def test_it_writes_one_file_and_says_where(run: Run, folder: Path, tmp_path: Path) -> None:
    outcome = run("report", folder, "--no-open", "-o", tmp_path / "new.html", "--json")
    assert outcome.code == 0 and outcome.err == ""
    size = (tmp_path / "new.html").stat().st_size
    assert outcome.facts == {"report": str(tmp_path / "new.html"), "bytes": size}
    assert not (folder / "report.html").exists()


def test_it_opens_the_report_unless_told_not_to(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    monkeypatch.setattr("shapespace.report.pages.folder_page.FolderPage.html", lambda self: "<!DOCTYPE html>")
    assert run("report", folder).out == f"The report is {folder / 'report.html'}\n"
    assert run("report", folder, "--no-open").code == 0
    assert opened == [(folder / "report.html").absolute().as_uri()]


def damaged(folder: Path) -> Path:
    (folder / "a.fit.json").write_text('{"format": "shapespace fit", ')
    return folder


def is_file(folder: Path) -> Path:
    (folder / "it").write_text("")
    return folder / "it"


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda folder: folder / "absent", "no such file"),
        (lambda folder: folder, "contains no fits"),
        (is_file, "it"),
        (damaged, "none of its 1 records can be read"),
    ],
)
def test_where_there_is_nothing_to_report_one_sentence_says_so(run: Run, tmp_path: Path, made, said: str) -> None:
    outcome = run("report", made(tmp_path), "--no-open")
    assert outcome.code == 2 and outcome.out == ""
    assert said in outcome.sentence()


@pytest.mark.parametrize("option", ["--model", "--labels"])
def test_options_that_name_what_cannot_be_used_are_refused(run: Run, folder: Path, tmp_path: Path, option: str) -> None:
    (tmp_path / "bad").write_bytes(b"\xff nothing")
    for path in (tmp_path / "absent", tmp_path / "bad"):
        outcome = run("report", folder, "--no-open", option, path)
        assert outcome.code == 2
        assert path.name in outcome.sentence()
    assert not (folder / "report.html").exists()


def test_the_model_of_other_fits_is_refused(run: Run, folder: Path, world: World, tmp_path: Path) -> None:
    assert run("build", world.meshes, "-o", tmp_path / "other.h5", "--modes", 2, "--quiet").code == 0
    outcome = run("report", folder, "--no-open", "--model", tmp_path / "other.h5")
    assert outcome.code == 2
    assert "not the model of the fits" in outcome.sentence()


def test_a_report_that_cannot_be_written_is_told(run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.report.pages.folder_page.FolderPage.html", lambda self: "<!DOCTYPE html>")
    outcome = run("report", folder, "--no-open", "-o", folder)
    assert outcome.code == 2
    assert str(folder) in outcome.sentence()
