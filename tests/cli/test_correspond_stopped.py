"""A correspondence that is stopped, or meets a full disk or other scans, leaves whole files and goes on from there."""

import errno
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Run
from raw_blobs import raw_blob
from shapespace.batch import parallel_rounds as rounds
from shapespace.cli import main
from shapespace.commands import correspond
from shapespace.io.meshes.mesh_io import write_mesh

pytestmark = pytest.mark.usefixtures("few_modes")
SCANS = 3
QUICK = ("--mirror", "never", "--vertices", "300", "--rounds", "2", "--jobs", "1", "--quiet")


def scans(folder: Path, *numbers: int) -> Path:
    folder.mkdir(exist_ok=True)
    for k, number in enumerate(numbers):
        write_mesh(folder / f"blob{k}.ply", raw_blob(number, points=700).scan)
    return folder


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scans(tmp_path_factory.mktemp("raw"), 0, 1, 2)


@pytest.fixture(scope="module")
def whole(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("whole")
    assert main(["correspond", str(raw), "-o", str(folder), *QUICK]) == 0
    return surfaces(folder)


def surfaces(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.glob("**/*.ply")}


def after(times: int, do: Callable[..., Any], error: BaseException) -> Callable[..., Any]:
    """Return what does `do` so many times, and then meets `error`."""
    done: list[int] = []

    def first_some(*arguments: Any, **options: Any) -> Any:
        if len(done) == times:
            raise error
        done.append(1)
        return do(*arguments, **options)

    return first_some


def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list of the tasks that are done from now on."""
    done: list[str] = []
    write = rounds._write
    monkeypatch.setattr(rounds, "_write", lambda file, placed: (done.append(file.name), write(file, placed)))
    return done


def no_temporary_files(folder: Path) -> bool:
    return not [path for path in folder.rglob(".*") if path.name != ".rounds"]


def test_after_an_interrupt_in_round_two_only_the_rest_is_done(
    run: Run, raw: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as stopped:
        stopped.setattr(rounds, "_write", after(SCANS + 1, rounds._write, KeyboardInterrupt()))
        outcome = run("correspond", raw, "-o", tmp_path / "same", *QUICK)
    assert outcome.code == 130
    assert "the files written so far are complete; the same command continues from there" in outcome.err
    assert no_temporary_files(tmp_path)
    assert run("build", tmp_path / "same", "-o", tmp_path / "model.h5").code == 2
    done = counted(monkeypatch)
    assert run("correspond", raw, "-o", tmp_path / "same", *QUICK).code == 0
    assert len(done) == SCANS - 1
    assert surfaces(tmp_path / "same") == whole


def test_a_disk_that_is_full_in_round_two_is_one_sentence_and_costs_nothing_that_is_done(
    run: Run, raw: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    with monkeypatch.context() as filled:
        filled.setattr(np, "savez", after(SCANS + 1, np.savez, full))
        outcome = run("correspond", raw, "-o", tmp_path / "same", *QUICK)
    assert outcome.code == 2 and "the disk is full; free some space and run again" in outcome.sentence()
    assert no_temporary_files(tmp_path)
    done = counted(monkeypatch)
    assert run("correspond", raw, "-o", tmp_path / "same", *QUICK).code == 0
    assert len(done) == SCANS - 1
    assert surfaces(tmp_path / "same") == whole


@pytest.mark.long
def test_a_scan_that_changed_since_the_interrupt_counts_as_it_is_now(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = scans(tmp_path / "scans", 0, 1, 2)
    with monkeypatch.context() as stopped:
        stopped.setattr(rounds, "_write", after(SCANS + 1, rounds._write, KeyboardInterrupt()))
        assert run("correspond", folder, "-o", tmp_path / "same", *QUICK).code == 130
    scans(folder, 0, 1, 3)
    assert run("correspond", folder, "-o", tmp_path / "same", *QUICK).code == 0
    assert run("correspond", folder, "-o", tmp_path / "fresh", *QUICK).code == 0
    assert surfaces(tmp_path / "same") == surfaces(tmp_path / "fresh")


@pytest.mark.long
def test_results_that_are_not_all_written_are_not_taken(
    run: Run, raw: Path, whole: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    same, model = tmp_path / "same", tmp_path / "model.h5"
    assert run("correspond", raw, "-o", same, *QUICK).code == 0
    # The template of another seed is another one, and the first surface on it lies beside others on the old one.
    with monkeypatch.context() as stopped:
        stopped.setattr(correspond, "write_mesh", after(1, correspond.write_mesh, KeyboardInterrupt()))
        assert run("correspond", raw, "-o", same, *QUICK, "--set", "seed=5").code == 130
    for command in ("build", "quality"):
        outcome = run(command, same, "-o", model)
        assert outcome.code == 2 and "not finished; run shapespace correspond again" in outcome.sentence()
    assert run("correspond", raw, "-o", same, *QUICK).code == 0
    assert surfaces(same) == whole
    assert run("build", same, "-o", model).code == 0


@pytest.mark.long
def test_a_finished_run_is_repeated_only_for_other_inputs_or_damaged_results(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, same = scans(tmp_path / "scans", 0, 1, 2), tmp_path / "same"
    (folder / "torn.ply").write_text("ply\n", "utf-8")
    told = "already contains the results of these scans and settings; nothing is computed"
    first = run("correspond", folder, "-o", same, *QUICK)
    assert first.code == 1 and told not in first.err
    before = {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in same.rglob("*") if path.is_file()}

    done = counted(monkeypatch)
    again = run("correspond", folder, "-o", same, *QUICK)
    assert again.code == 1 and told in again.err and again.out == first.out and not done
    assert before == {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in same.rglob("*") if path.is_file()}

    def computed(*options: str) -> bool:
        done.clear()
        outcome = run("correspond", folder, "-o", same, *QUICK, *options)
        assert (told in outcome.err) is not bool(done)
        return bool(done)

    assert computed("--rounds", "1") and not computed("--rounds", "1")
    (same / "blob1.corresponding.ply").unlink()
    assert computed("--rounds", "1") and (same / "blob1.corresponding.ply").is_file()
    (same / "template" / "mean.ply").write_text("damaged", "utf-8")
    assert computed("--rounds", "1")
    scans(folder, 0, 1, 3)
    assert computed("--rounds", "1") and not computed("--rounds", "1")


def test_a_surface_that_is_gone_is_named(run: Run, raw: Path, tmp_path: Path) -> None:
    same = tmp_path / "same"
    assert run("correspond", raw, "-o", same, *QUICK).code == 0
    shutil.copy(raw / "blob0.ply", same / "a raw scan.ply")
    assert run("build", same, "-o", tmp_path / "model.h5").code == 0
    (same / "blob1.corresponding.ply").unlink()
    outcome = run("build", same, "-o", tmp_path / "model.h5")
    assert outcome.code == 2 and "blob1.corresponding.ply is no longer in it" in outcome.sentence()
    (same / "correspondence.json").write_text("{", "utf-8")
    told = run("build", same, "-o", tmp_path / "m.h5").sentence()
    assert "cut short" in told and "run shapespace correspond again" in told
