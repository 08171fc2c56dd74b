"""Arrays kept between runs: checked, bounded, safe among processes, and never in anybody's way."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shapespace.io import disk_cache

ARRAYS = {"a": np.arange(12.0).reshape(3, 4), "b": np.ones(3, dtype=np.float32)}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path))
    monkeypatch.delenv("SHAPESPACE_KEEP", raising=False)
    return tmp_path / "kept"


def equal(found: object) -> bool:
    return isinstance(found, dict) and found.keys() == ARRAYS.keys() and all(
        found[key].dtype == array.dtype and np.array_equal(found[key], array) for key, array in ARRAYS.items()
    )  # fmt: skip


def test_what_was_kept_comes_back_to_the_bit(folder: Path) -> None:
    assert disk_cache.recall("x") is None
    disk_cache.keep("x", ARRAYS)
    assert equal(disk_cache.recall("x")) and disk_cache.recall("y") is None
    assert [file.name for file in folder.iterdir()] == ["x.kept"]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_a_file_cut_short_counts_as_not_there_and_is_replaced(folder: Path, share: float) -> None:
    disk_cache.keep("x", ARRAYS)
    content = (folder / "x.kept").read_bytes()
    (folder / "x.kept").write_bytes(content[: int(share * len(content))])
    assert disk_cache.recall("x") is None
    disk_cache.keep("x", ARRAYS)
    assert equal(disk_cache.recall("x"))


def test_a_changed_byte_counts_as_not_there(folder: Path) -> None:
    disk_cache.keep("x", ARRAYS)
    content = (folder / "x.kept").read_bytes()
    for at in range(0, len(content), 7):
        changed = bytearray(content)
        changed[at] ^= 0x10
        (folder / "x.kept").write_bytes(changed)
        assert disk_cache.recall("x") is None, at


def test_pickled_objects_are_refused(folder: Path) -> None:
    disk_cache.keep("x", {"a": np.array([{"never": "run"}], dtype=object)})
    assert disk_cache.recall("x") is None


def test_the_files_used_last_stay_below_the_bound(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk_cache.keep("first", ARRAYS)
    size = (folder / "first.kept").stat().st_size
    monkeypatch.setattr(disk_cache, "MOST_BYTES", int(2.5 * size))
    for age, name in ((300, "first"), (200, "second")):
        disk_cache.keep(name, ARRAYS)
        os.utime(folder / f"{name}.kept", (folder.stat().st_mtime - age,) * 2)
    disk_cache.recall("first")  # so that the second is now the one used longest ago
    disk_cache.keep("third", ARRAYS)
    assert sorted(file.stem for file in folder.iterdir()) == ["first", "third"]


def test_what_alone_is_beyond_the_bound_is_not_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_cache, "MOST_BYTES", 10)
    disk_cache.keep("x", ARRAYS)
    assert not folder.exists()


@pytest.mark.parametrize("word", ["no", "off", "0", "NO"])
def test_it_can_be_switched_off(folder: Path, monkeypatch: pytest.MonkeyPatch, word: str) -> None:
    disk_cache.keep("x", ARRAYS)
    monkeypatch.setenv("SHAPESPACE_KEEP", word)
    disk_cache.keep("y", ARRAYS)
    assert disk_cache.recall("x") is None and [file.stem for file in folder.iterdir()] == ["x"]


def test_it_can_stand_in_another_folder(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHAPESPACE_KEEP", str(tmp_path / "elsewhere"))
    disk_cache.keep("x", ARRAYS)
    assert equal(disk_cache.recall("x")) and [file.name for file in (tmp_path / "elsewhere").iterdir()] == ["x.kept"]
    assert not folder.exists()


def test_a_folder_that_cannot_be_made_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path / "file"))
    monkeypatch.delenv("SHAPESPACE_KEEP", raising=False)
    disk_cache.keep("x", ARRAYS)
    assert disk_cache.recall("x") is None


def test_writers_at_the_same_time_leave_whole_files_alone(folder: Path) -> None:
    code = (
        "import numpy as np; from shapespace.io import disk_cache\n"
        "for k in range(40):\n"
        "    disk_cache.keep('x', {'a': np.full(20_000, 7.0)})\n"
        "    found = disk_cache.recall('x')\n"
        "    assert found is not None and (found['a'] == 7.0).all()\n"
    )
    writers = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(3)]
    assert [writer.wait(120) for writer in writers] == [0, 0, 0]
    assert [file.name for file in folder.iterdir()] == ["x.kept"]


def test_the_key_depends_on_kind_version_and_every_dependency() -> None:
    keys = {disk_cache.key(*parts) for parts in (("a", 1, "x"), ("b", 1, "x"), ("a", 2, "x"), ("a", 1, "y"), ("a", 1))}
    assert len(keys) == 5 and disk_cache.key("a", 1, "x") in keys


def test_clearing_removes_the_entries_and_nothing_else(folder: Path) -> None:
    disk_cache.clear()
    disk_cache.keep("x", ARRAYS)
    disk_cache.keep("y", ARRAYS)
    (folder / "note.txt").touch()
    disk_cache.clear()
    assert disk_cache.recall("x") is None and [file.name for file in folder.iterdir()] == ["note.txt"]
