"""`fit --store`: the same results in few files, kept where they hold, whole whatever ends the run."""

import csv
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from conftest import Run, World, leftovers
from shapespace.batch import run as batch_run
from shapespace.store.results import Results

pytest.importorskip("zarr", reason="the extra 'store' is not installed")
pytest.importorskip("pyarrow", reason="the extra 'store' is not installed")
FAST = ("--set", "max_iterations=3", "--quiet")


def scans(world: World, folder: Path, count: int) -> Path:
    (folder / "scans").mkdir()
    for k in range(count):
        shutil.copy(world.scans[k % 3], folder / "scans" / f"s{k:03d}.ply")
    return folder / "scans"


def rows(table: Path) -> dict[str, dict[str, str]]:
    with table.open(newline="") as stream:
        return {row["scan"]: row for row in csv.DictReader(stream)}


def test_a_store_holds_what_single_files_hold_and_is_kept(run: Run, world: World, tmp_path: Path) -> None:
    raw = scans(world, tmp_path, 4)
    (raw / "bad.ply").write_text("no mesh")
    store = ("fit", world.model, raw, "-o", tmp_path / "store", "--store", *FAST)
    assert run("fit", world.model, raw, "-o", tmp_path / "single", *FAST).code == 1
    first = run(*store)
    assert first.code == 1 and "5 scans: 4 max_iterations, 1 failed" in first.out
    assert {path.name for path in (tmp_path / "store").iterdir()} == {"manifest.json", "table", "surfaces", "scans.csv"}
    assert run("export", tmp_path / "store", "--table", tmp_path / "fits.csv").code == 0
    assert rows(tmp_path / "fits.csv") == rows(tmp_path / "single" / "coefficients.csv")
    assert run("export", tmp_path / "store", "s001", "-o", tmp_path / "one").code == 0
    # Without --store the folder goes on as what it is, and does what is missing or has changed.
    shutil.copy(world.scans[0], raw / "s004.ply")
    shutil.copy(world.scans[2], raw / "s000.ply")
    again = run("fit", world.model, raw, "-o", tmp_path / "store", *FAST)
    assert "3 of 6 scans have valid results" in again.err and "1 of 6 scan is fitted again" in again.err
    found = Results(tmp_path / "store")
    assert len(found) == 6 and found.record("s000")["b"] == found.record("s002")["b"]
    assert leftovers(tmp_path) == []
    assert "6 of 6" not in again.err and "5 of 6" in run(*store).err, "the failed one is tried again"


def test_a_run_into_a_store_that_is_killed_goes_on(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raw, out = scans(world, tmp_path, 60), tmp_path / "out"
    code = (
        "from shapespace.batch import run; run.ROWS = 10\n"
        "import sys\nfrom shapespace.cli import main\nsys.exit(main(sys.argv[1:]))"
    )
    told = ["fit", str(world.model), str(raw), "-o", str(out), "--store", "--jobs", "1", *FAST]
    process = subprocess.Popen(
        [sys.executable, "-c", code, *told], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    limit = time.monotonic() + 120
    while not list(out.glob("table/*.parquet")) and time.monotonic() < limit:
        time.sleep(0.01)
    process.kill()
    process.wait()
    done = Results(out).identities()
    assert 0 < len(done) < 60
    monkeypatch.setattr(batch_run, "ROWS", 10)
    outcome = run(*told)
    assert outcome.code == 0 and f"{len(done)} of 60" in outcome.err, outcome.err
    found = Results(out)
    assert len(found) == 60 and not found.singles and done.items() <= found.identities().items()
    assert leftovers(tmp_path) == []
