"""Folders of dropped scans: what a dead viewer left is swept, and nothing else."""

import tempfile
from pathlib import Path

import pytest

from shapespace.viewer import scratch

pytest.importorskip("fcntl", reason="there are no such locks on Windows")


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def dead(folder: Path, name: str) -> Path:
    made = folder / f"{scratch.PREFIX}{name}"
    (made / "scan").mkdir(parents=True)
    (made / "scan" / "upload-1.ply").write_text("ply")
    (made / "in-use.lock").touch()
    return made


def test_a_folder_in_use_stays_and_one_of_the_dead_goes(temporary: Path) -> None:
    mine, remove = scratch.new_folder()
    left = dead(temporary, "dead")
    assert mine.parent == temporary and oct(mine.stat().st_mode)[-3:] == "700"
    assert scratch.sweep() == 1
    assert mine.is_dir() and not left.exists()
    remove()
    remove()
    assert not mine.exists() and scratch.sweep() == 0


def test_what_is_not_surely_of_a_dead_viewer_stays(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (temporary / "shapespace-view-young").mkdir()  # not locked yet
    other = dead(temporary / "elsewhere", "x")
    (temporary / "shapespace-view-link").symlink_to(other)
    linked = temporary / "shapespace-view-linked"
    linked.mkdir()
    (linked / "in-use.lock").symlink_to(other / "in-use.lock")
    (temporary / "shapespace-view-file").touch()
    (temporary / "shapespace-other").mkdir()
    before = sorted(temporary.rglob("*"))
    assert scratch.sweep() == 0 and sorted(temporary.rglob("*")) == before
    left = dead(temporary, "of-another-user")
    owner = left.stat().st_uid
    monkeypatch.setattr("os.getuid", lambda: owner + 1)
    assert scratch.sweep() == 0 and left.is_dir()


def test_a_sweep_looks_at_so_many_folders_only(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch, "_MOST_SWEPT", 2)
    for k in range(3):
        dead(temporary, str(k))
    assert scratch.sweep() == 2 and scratch.sweep() == 1
