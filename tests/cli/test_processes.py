"""The command as the system runs it: start-up, signals, pipes, and workers of their own."""

import argparse
import csv
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest

from conftest import World, leftovers, without_waiting
from shapespace.cli import main
from shapespace.io.meshes.mesh_io import read_mesh

COMMAND = [sys.executable, "-m", "shapespace"]
# Buffered output, as users have it, meets a full disk only when it is flushed.
STOPPED = "shapespace: stopped; the files written so far are complete; the same command continues from there."
BUFFERED = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}


def call(*arguments: object, **options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=600, env={**os.environ, **options}
    )


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, shapespace.cli as c\ntry: c.main(['fit', '--help'])\nexcept SystemExit: pass\nprint(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.splitlines()[-1].split())
    assert not loaded & {"numpy", "scipy", "h5py", "igl", "tqdm", "pooch", "matplotlib"}


def test_the_console_script_and_the_module_are_the_same_command() -> None:
    script = Path(sys.executable).with_name("shapespace")
    if not script.is_file():
        pytest.skip("the package's console script is not installed beside python")
    both = [subprocess.run([*c, "--help"], capture_output=True, text=True) for c in ([str(script)], COMMAND)]
    assert both[0].returncode == both[1].returncode == 0
    assert both[0].stdout == both[1].stdout


def test_exit_codes_reach_the_shell(world: World, tmp_path: Path) -> None:
    done = call("check", tmp_path / "none.ply", world.scan)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert call("info", tmp_path / "none.ply").returncode == 2
    assert call("info", world.model, "--json").returncode == 0


def test_names_that_the_terminal_cannot_show_are_printed_as_escapes(world: World, tmp_path: Path) -> None:
    scan = tmp_path / "顔\udcff.ply"
    shutil.copy(world.scan, scan)
    done = call("check", scan, PYTHONIOENCODING="ascii")
    assert done.returncode == 0, done.stderr
    assert r"\u9854\udcff.ply" in done.stdout


def test_a_reader_that_goes_away_is_no_error(world: World) -> None:
    scans = [world.scan] * 300
    with subprocess.Popen(
        [*COMMAND, "check", *map(str, scans)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(60) == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_standard_output_on_a_full_disk_is_one_sentence(world: World) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, "info", str(world.model)],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=60,
            env=BUFFERED,
        )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1 and done.stderr.startswith("shapespace: ")


def hear_hangups() -> None:
    """Undo what nohup hands down."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
@pytest.mark.parametrize(
    ("jobs", "by"),
    [
        (2, "SIGINT"),
        (1, "SIGTERM"),
        *(pytest.param(*one, marks=pytest.mark.long) for one in ((1, "SIGINT"), (2, "SIGTERM"), (1, "SIGHUP"))),
    ],
)
def test_ended_in_a_batch_it_leaves_whole_files_that_the_same_command_takes_up(
    jobs: int, by: str, world: World, tmp_path: Path
) -> None:
    scans = tmp_path / "scans"
    scans.mkdir()
    for k in range(150):
        shutil.copy(world.scans[k % 3], scans / f"s{k:03d}.ply")
    out = tmp_path / "out"
    command = [*COMMAND, "fit", str(world.model), str(scans), "-o", str(out), "--jobs", str(jobs)]
    # A session of its own, so that like in a terminal the workers get the signal too.
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=hear_hangups,
    )  # fmt: skip
    limit = time.monotonic() + 60
    while len(list(out.glob("*.fit.json"))) < 3 and time.monotonic() < limit:
        time.sleep(0.02)
    # A terminal sends Ctrl-C to all, clusters send SIGTERM to the command.
    (os.killpg if by == "SIGINT" else os.kill)(process.pid, signal.Signals[by])
    printed, said = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.Signals[by]
    assert printed == ""
    assert without_waiting(said).splitlines() == [STOPPED]
    assert leftovers(tmp_path) == []
    records = sorted(out.glob("*.fit.json"))
    assert 3 <= len(records) < 150
    for path in records:
        assert json.loads(path.read_text())["status"] == "converged"
        assert len(read_mesh(out / path.name.replace(".fit.json", ".fitted.ply")).vertices) == 400
    with (out / "coefficients.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["scan"] for row in rows} == {path.name.removesuffix(".fit.json") for path in records}
    # Resumed on what is done, nothing is fitted again.
    times = {path: path.stat().st_mtime_ns for path in records}
    done = call("fit", world.model, *(scans / p.name.replace(".fit.json", ".ply") for p in records), "-o", out)
    assert done.returncode == 0, done.stderr
    assert {path: path.stat().st_mtime_ns for path in records} == times


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_ctrl_c_that_compiled_code_turns_into_another_error_is_ctrl_c_still(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def turned(_: object) -> int:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise SystemError("a compiled function returned a result with an exception set") from None
        return 0

    parsed = argparse.Namespace(run=turned)
    monkeypatch.setattr("shapespace.cli.parser", lambda: types.SimpleNamespace(parse_args=lambda _: parsed))
    assert main([]) == 130
    assert capsys.readouterr().err == "shapespace: stopped; the files written so far are complete.\n"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_ctrl_c_while_the_workers_start_is_quiet_too(world: World, tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [*COMMAND, "fit", str(world.model), *map(str, world.scans), "-o", str(out), "--jobs", "2"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    limit = time.monotonic() + 60
    while not out.exists() and time.monotonic() < limit:
        time.sleep(0.005)
    time.sleep(0.2)  # the workers are importing now, which takes them longer than this
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert without_waiting(said).splitlines() == [STOPPED]


def batch(world: World, folder: Path, count: int) -> Path:
    """Write as many scans, and return their folder."""
    scans = folder / "scans"
    scans.mkdir()
    for k in range(count):
        os.link(world.scans[k % 3], scans / f"s{k:04d}.ply")
    return scans


def children_of(pid: int) -> list[int]:
    """Return the processes below `pid` that fit."""
    found: list[int] = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            if int(stat.read_text().rpartition(")")[2].split()[1]) == pid:
                found += [int(stat.parent.name), *children_of(int(stat.parent.name))]
        except (OSError, ValueError):
            continue
    return found


def told(folder: Path) -> list[dict[str, str]]:
    with (folder / "coefficients.csv").open(newline="") as stream:
        return sorted(
            ({**row, "path": "", "checksum": ""} for row in csv.DictReader(stream)), key=lambda row: row["scan"]
        )


def wait_for(count: int, out: Path) -> None:
    limit = time.monotonic() + 60
    while len(list(out.glob("*.fit.json"))) < count and time.monotonic() < limit:
        time.sleep(0.01)


@pytest.fixture(scope="module")
def undisturbed(world: World, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, str]]]:
    """A batch of scans, and the table of a run that nothing disturbed."""
    folder = tmp_path_factory.mktemp("undisturbed")
    scans = batch(world, folder, BATCH)
    assert call("fit", world.model, scans, "-o", folder / "out", *FAST, "--quiet").returncode == 0
    return scans, told(folder / "out")


# By hand SHAPESPACE_FAULTS=1 kills a batch of 1,000 at 20 moments.
BATCH, KILLS = (1000, 20) if os.environ.get("SHAPESPACE_FAULTS") else (90, 5)
FAST = ("--set", "max_iterations=3")
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


@LINUX
@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux bounds the memory of a process for certain")
def test_a_scan_for_which_there_is_not_enough_memory_fails_alone(world: World, tmp_path: Path) -> None:
    import resource

    scans = tmp_path / "scans"
    scans.mkdir()
    for k in range(3):
        shutil.copy(world.scans[k], scans / f"s{k}.ply")
    vertices = 80_000_000
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    with (scans / "giant.ply").open("wb") as file:
        file.write(head.encode() + np.random.default_rng(0).normal(size=30_000).astype("<f4").tobytes())
        file.truncate(len(head) + 12 * vertices)  # zeros that take no room on the disk
    done = subprocess.run(
        [*COMMAND, "fit", str(world.model), str(scans), "-o", str(tmp_path / "out"), "--jobs", "2", "--quiet"],
        capture_output=True, text=True, timeout=200, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (3_500_000_000, 3_500_000_000)),
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert "not enough memory" in done.stderr and "giant.ply" in done.stderr and "Traceback" not in done.stderr
    with (tmp_path / "out" / "coefficients.csv").open(newline="") as stream:
        status = {row["scan"]: row["status"] for row in csv.DictReader(stream)}
    assert status == {"giant": "failed", "s0": "converged", "s1": "converged", "s2": "converged"}


@pytest.mark.long
def test_workers_that_are_killed_change_nothing(
    world: World, undisturbed: tuple[Path, list[dict[str, str]]], tmp_path: Path
) -> None:
    scans, table = undisturbed
    command = [*COMMAND, "fit", str(world.model), str(scans), "-o", str(tmp_path), "--jobs", "4", *FAST, "--quiet"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(20, tmp_path)
    workers = [pid for pid in children_of(process.pid) if not children_of(pid) and b"forkserver" in cmdline(pid)]
    for pid in workers[1:3]:
        os.kill(pid, signal.SIGKILL)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0, said
    assert told(tmp_path) == table and leftovers(tmp_path) == []


def cmdline(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@LINUX
@pytest.mark.long
def test_a_batch_that_is_killed_again_and_again_ends_as_if_nothing_had_been(
    world: World, undisturbed: tuple[Path, list[dict[str, str]]], tmp_path: Path
) -> None:
    scans, table = undisturbed
    command = [*COMMAND, "fit", str(world.model), str(scans), "-o", str(tmp_path), "--jobs", "2", *FAST, "--quiet"]
    rng = random.Random(5)
    done: dict[str, int] = {}
    for _ in range(KILLS):
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wait_for(len(done) + rng.randrange(BATCH // KILLS), tmp_path)
        time.sleep(rng.uniform(0.0, 0.05))
        below = children_of(process.pid)
        process.kill()
        process.wait()
        limit = time.monotonic() + 10
        while any(b"forkserver" in cmdline(pid) for pid in below) and time.monotonic() < limit:
            time.sleep(0.01)
        assert not [pid for pid in below if b"forkserver" in cmdline(pid)], "workers end with their parent"
        times = {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.fit.json")}
        assert times | done == times, "what was done is there, and was not done again"
        done = times
    assert 0 < len(done) < BATCH
    assert call(*command[3:]).returncode == 0
    assert told(tmp_path) == table and leftovers(tmp_path) == []
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.fit.json")} | done == {
        path.name: path.stat().st_mtime_ns for path in tmp_path.glob("*.fit.json")
    }


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT for one process")
def test_a_second_ctrl_c_ends_it_at_once(world: World, tmp_path: Path) -> None:
    scans = batch(world, tmp_path, 200)
    command = [*COMMAND, "fit", str(world.model), str(scans), "-o", str(tmp_path / "out"), "--jobs", "2"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    wait_for(3, tmp_path / "out")
    for _ in range(2):
        os.killpg(process.pid, signal.SIGINT)
        time.sleep(0.02)
    began = time.monotonic()
    process.communicate(timeout=60)
    # The second one may meet an interpreter that is about to exit.
    assert process.returncode in (130, -signal.SIGINT) and time.monotonic() - began < 10
    assert leftovers(tmp_path) == []
