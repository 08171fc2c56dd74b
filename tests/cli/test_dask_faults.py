"""A cluster whose scheduler or worker is killed: the command ends with a sentence or goes on; the next one finishes."""

import csv
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from conftest import World, leftovers

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
pytestmark = pytest.mark.long
SCANS = 60
FAST = ("--set", "max_iterations=3", "--quiet")


@contextmanager
def dask(*arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of Dask until the block ends."""
    program = Path(sys.executable).with_name("dask")
    with subprocess.Popen(
        [program, *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            yield process
        finally:
            process.terminate()


@contextmanager
def cluster(file: Path) -> Iterator[tuple[subprocess.Popen[bytes], list[subprocess.Popen[bytes]]]]:
    """Yield the processes of a scheduler and of two workers."""
    loopback = ("--dashboard-address", "127.0.0.1:0")
    with ExitStack() as stack:
        scheduler = stack.enter_context(
            dask("scheduler", "--host", "127.0.0.1", "--port", 0, *loopback, "--scheduler-file", file)
        )
        workers = [
            stack.enter_context(dask("worker", "--scheduler-file", file, "--nthreads", 1, "--no-nanny", *loopback))
            for _ in range(2)
        ]
        yield scheduler, workers


def fit(world: World, scans: Path, out: Path, file: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "shapespace", "fit", world.model, scans, "-o", out, *FAST]
    return subprocess.Popen(
        [*command, "--set", "executor=dask", "--set", f"dask={file}"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(count: int, out: Path) -> dict[str, int]:
    limit = time.monotonic() + 120
    while len(found := list(out.glob("*.fit.json"))) < count and time.monotonic() < limit:
        time.sleep(0.02)
    return {path.name: path.stat().st_mtime_ns for path in found}


def table(out: Path) -> dict[str, dict[str, str]]:
    with (out / "coefficients.csv").open(newline="") as stream:
        return {row["scan"]: row for row in csv.DictReader(stream)}


def test_a_batch_outlives_its_workers_and_its_scheduler(world: World, tmp_path: Path) -> None:
    scans, out = tmp_path / "scans", tmp_path / "out"
    scans.mkdir()
    for k in range(SCANS):
        shutil.copy(world.scans[k % 3], scans / f"s{k:03d}.ply")
    with cluster(tmp_path / "one.json") as (scheduler, _):
        process = fit(world, scans, out, tmp_path / "one.json")
        wait_for(3, out)
        scheduler.send_signal(signal.SIGKILL)
        _, said = process.communicate(timeout=120)
        assert process.returncode == 2, said
        assert "The Dask scheduler is gone" in said.splitlines()[-1]
    # Workers end what they are at, after the command too.
    done = wait_for(3, out)
    assert len(done) < SCANS and table(out).keys() <= {name.removesuffix(".fit.json") for name in done}
    with cluster(tmp_path / "two.json") as (_, workers):
        process = fit(world, scans, out, tmp_path / "two.json")
        wait_for(len(done) + 3, out)
        workers[0].send_signal(signal.SIGKILL)
        _, said = process.communicate(timeout=120)
        assert process.returncode == 0, said
    assert {path.name: path.stat().st_mtime_ns for path in out.glob("*.fit.json") if path.name in done} == done
    rows = table(out)
    assert len(rows) == SCANS and len({row["b1"] for row in rows.values()}) == 3
    assert leftovers(tmp_path) == []
