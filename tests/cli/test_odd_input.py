"""Odd but legal input works: names, links, read-only files; and what the outside world does to a command."""

import csv
import errno
import io
import json
import os
import sys
from collections.abc import Generator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Run, World, leftovers
from shapespace.batch.executors import EXECUTORS
from shapespace.errors import FitError
from shapespace.io import disk_cache
from shapespace.io.meshes.mesh_io import MESH_FORMATS, write_mesh
from shapespace.types import Mesh

FAST = ("--set", "max_iterations=2")
NAMES = ["with space", "Grüße 顔 🙂", "-leading dash", "=1+1", "@cmd", "+x", "line\nbreak", "tab\tname", "a'b\"c;$(x)",
         "dots.in.name", "x" * 240, "\udcff not utf-8"]  # fmt: skip


@pytest.mark.parametrize("name", NAMES, ids=ascii)
def test_scans_of_any_name_are_fitted(name: str, run: Run, world: World, tmp_path: Path) -> None:
    scan = tmp_path / f"{name}.ply"
    scan.write_bytes(world.scan.read_bytes())
    out = tmp_path / "out"
    outcome = run("fit", world.model, scan, "-o", out, *FAST)
    assert outcome.code == 0, outcome.err
    assert len(outcome.out.splitlines()) == 2 and len(outcome.err.splitlines()) == 1
    assert {c for c in outcome.out + outcome.err if not c.isprintable()} == {"\n"}
    (record,) = out.glob("*.fit.json")
    assert json.loads(record.read_text())["scan"]["name"] == scan.name
    assert len(list(out.glob("*.fitted.ply"))) == 1
    text = (out / "coefficients.csv").read_text(encoding="utf-8")
    (row,) = csv.DictReader(io.StringIO(text, newline=""))
    assert row["scan"][0] not in "=+-@"
    assert run("fit", world.model, scan, "-o", out, *FAST, "--json").facts["max_iterations"] == 1
    assert run("check", scan, "--json").facts[0]["usable"]
    assert run("info", record, "--json").facts["status"] == "max_iterations"


def test_a_relative_name_that_starts_with_a_dash_works_after_two_dashes(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "-scan.ply").write_bytes(world.scan.read_bytes())
    monkeypatch.chdir(tmp_path)
    assert run("fit", world.model, "-o", "out", *FAST, "--", "-scan.ply").code == 0


def test_the_same_scan_in_every_format_gives_the_same_fit(
    run: Run, world: World, scan_mesh: Mesh, tmp_path: Path
) -> None:
    files = [tmp_path / f"scan{ending}" for ending in MESH_FORMATS]
    for file in files:
        write_mesh(file, scan_mesh)
    assert run("fit", world.model, *files, "-o", tmp_path / "out").code == 0
    records = [json.loads(path.read_text()) for path in (tmp_path / "out").glob("*.fit.json")]
    assert len(records) == len(MESH_FORMATS)
    for record in records:
        np.testing.assert_allclose(record["b"], records[0]["b"], atol=0.02)


def test_links_and_read_only_input_are_fine(run: Run, world: World, tmp_path: Path) -> None:
    scan = tmp_path / "scan.ply"
    scan.write_bytes(world.scan.read_bytes())
    scan.chmod(0o400)
    (tmp_path / "link.ply").symlink_to(scan)
    (tmp_path / "model.h5").symlink_to(world.model)
    outcome = run("fit", tmp_path / "model.h5", tmp_path / "link.ply", "-o", tmp_path / "out", *FAST)
    assert outcome.code == 0
    assert (tmp_path / "out" / "link.fit.json").is_file()


def test_a_dangling_link_and_a_device_are_refused(run: Run, world: World, tmp_path: Path) -> None:
    dangling = tmp_path / "dangling.ply"
    dangling.symlink_to(tmp_path / "nothing.ply")
    null = tmp_path / "null.ply"
    null.symlink_to("/dev/null")
    for scan in (dangling, null):
        outcome = run("fit", world.model, scan, "-o", tmp_path / "out")
        assert outcome.code == 2 and str(scan) in outcome.sentence()


def test_a_folder_with_a_mesh_name_is_read_as_a_folder(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "scan.ply").mkdir()
    outcome = run("check", tmp_path / "scan.ply")
    assert outcome.code == 2 and "contains no meshes" in outcome.sentence()


def test_names_in_capitals_are_known(run: Run, world: World, tmp_path: Path) -> None:
    (tmp_path / "SCAN.PLY").write_bytes(world.scan.read_bytes())
    assert run("fit", world.model, tmp_path, "-o", tmp_path / "out", *FAST).code == 0


def test_packed_meshes_are_read_and_go_by_the_name_of_what_is_packed(run: Run, world: World, tmp_path: Path) -> None:
    import gzip

    path = tmp_path / "scan.ply.gz"
    path.write_bytes(gzip.compress(world.scan.read_bytes()))
    assert run("fit", world.model, path, "-o", tmp_path / "out", *FAST).code == 0
    assert (tmp_path / "out" / "scan.fit.json").is_file()
    disguised = tmp_path / "scan.ply"
    disguised.write_bytes(path.read_bytes())
    assert run("check", disguised).code == 0


def test_a_scan_that_fits_no_unit_is_refused(run: Run, world: World, scan_mesh: Mesh, tmp_path: Path) -> None:
    for factor in (1e-9, 1e9):
        write_mesh(tmp_path / "odd.ply", scan_mesh.with_vertices(scan_mesh.vertices * factor))
        outcome = run("fit", world.model, tmp_path / "odd.ply", "-o", tmp_path / "out")
        assert outcome.code == 2 and "unit" in outcome.sentence()


def test_a_handful_of_points_never_passes_for_a_good_fit(run: Run, world: World, tmp_path: Path) -> None:
    for count in (4, 5, 10):
        points = 60 * np.random.default_rng(count).standard_normal((count, 3))
        write_mesh(tmp_path / "few.ply", Mesh(points))
        outcome = run("fit", world.model, tmp_path / "few.ply", "-o", tmp_path / f"out{count}", "--strict")
        assert outcome.code in (1, 2), outcome.out
        assert len(outcome.err.splitlines()) == 1


class _Killed:
    """Workers that the system ends, as it does when memory runs out."""

    def run(self, work: Any, tasks: Any, /) -> closing[Generator[Any]]:
        return closing(self._answers(work, tasks))

    def _answers(self, work: Any, tasks: Any) -> Generator[Any]:
        yield tasks[0], work.do(tasks[0])
        yield tasks[1], work.give_up(tasks[1], "its worker ended by signal 9")
        raise FitError("The system ends worker processes as they start; use --jobs 1, or free some memory.")


def test_workers_that_are_killed_end_in_one_sentence_and_a_table(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(EXECUTORS, "local", lambda *_: _Killed())
    outcome = run("fit", world.model, *world.scans, "-o", tmp_path, "--jobs", 2)
    assert outcome.code == 2
    assert "use --jobs 1" in outcome.err.splitlines()[-1]
    with (tmp_path / "coefficients.csv").open(newline="") as stream:
        rows = {row["scan"]: row for row in csv.DictReader(stream)}
    assert rows["scan_0"]["status"] == "converged" and rows["scan_1"]["status"] == "failed"
    assert rows["scan_1"]["reason"] == f"{world.scans[1]}: its worker ended by signal 9."
    assert leftovers(tmp_path) == []


@pytest.mark.parametrize("where", ["shapespace.io.meshes.mesh_io.read_bytes", "shapespace.batch.fit_work.fit_scan"])
def test_too_little_memory_for_one_scan_fails_that_scan(
    where: str, run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def exhausted(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr(where, exhausted)
    outcome = run("fit", world.model, world.scan, "-o", tmp_path)
    assert outcome.code == 2
    assert str(world.scan) in outcome.sentence() and "memory" in outcome.err


def test_too_little_memory_to_build_ends_in_one_sentence(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def exhausted(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("shapespace.commands.build.build_model", exhausted)
    outcome = run("build", world.meshes, "-o", tmp_path / "m.h5")
    assert outcome.code == 2 and "not enough memory" in outcome.err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["build", "fit", "check"])
def test_ctrl_c_ends_with_130_and_whole_files(
    command: str, run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from shapespace.io.meshes.mesh_io import read_mesh

    seen: list[Path] = []

    def interrupted(path: Path) -> Mesh:
        seen.append(path)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return read_mesh(path)

    for reader in ("store.corresponding.mesh_at", "commands.look.read_mesh", "batch.fit_work.read_mesh"):
        monkeypatch.setattr(f"shapespace.{reader}", interrupted)
    arguments: dict[str, tuple[object, ...]] = {
        "build": ("build", world.meshes, "-o", tmp_path / "m.h5"),
        "fit": ("fit", world.model, *world.scans, "-o", tmp_path, "--jobs", 1, *FAST),
        "check": ("check", *world.scans),
    }
    outcome = run(*arguments[command])
    assert outcome.code == 130
    goes_on = "; the same command continues from there" if command == "fit" else ""
    assert outcome.err.splitlines()[-1] == f"shapespace: stopped; the files written so far are complete{goes_on}."
    assert leftovers(tmp_path) == []
    if command == "fit":
        assert {path.name for path in tmp_path.iterdir()} == {
            "coefficients.csv", "scan_0.fit.json", "scan_0.fitted.ply",
            "scan_0.landmarks.csv", "scan_0.landmarks.fcsv", "scan_0.landmarks.mrk.json",
        }  # fmt: skip
        with (tmp_path / "coefficients.csv").open(newline="") as stream:
            assert [row["scan"] for row in csv.DictReader(stream)] == ["scan_0"]
    else:
        assert not list(tmp_path.iterdir())


class _FullOutput(io.StringIO):
    def write(self, text: str) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_output_that_cannot_be_written_is_said(
    world: World, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from shapespace.cli import main

    monkeypatch.setattr(sys, "stdout", _FullOutput())
    assert main(["info", str(world.model)]) == 2
    assert "No space left on device" in capsys.readouterr().err


def test_the_cache_is_described_and_cleared(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHAPESPACE_KEEP", str(tmp_path))
    disk_cache.keep("x", {"a": np.zeros(3)})
    assert run("cache").out.endswith("1 entries, 0.0 MB\n")
    facts = run("cache", "--clear", "--json").facts
    assert facts == {"folder": str(tmp_path), "entries": 0, "bytes": 0} and not list(tmp_path.iterdir())
    monkeypatch.setenv("SHAPESPACE_KEEP", "no")
    assert "off" in run("cache").out
