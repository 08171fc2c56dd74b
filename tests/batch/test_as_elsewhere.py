"""What Windows and macOS do otherwise, as far as Linux can show it."""

import ast
import csv
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shapespace.batch import workers
from shapespace.batch.executors import Local, Serial
from shapespace.batch.run import BatchConfig, FolderSink, fit_many, make_jobs
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.inputs.saved_fits import Folder, find_fits
from shapespace.report.inputs.saved_fits import raw_scan as saved_scan
from synthetic_shapes import blob_model, raw_scan

SRC = Path(__file__).resolve().parents[2] / "src" / "shapespace"
POSIX_ONLY = {
    ("batch/workers.py", "sched_getaffinity"): "on Linux alone; elsewhere cpu_count",
    ("datasets/fetch.py", "fcntl"): "elsewhere msvcrt",
    ("io/sandbox_child.py", "resource"): "elsewhere its parent ends it when it is late",
    ("io/files.py", "kill"): "on Windows nothing is asked, and files are left for an hour",
    ("viewer/studio/specimen_checks.py", "nice"): "elsewhere the process keeps its place",
}
"""Each use of what Windows lacks, with what happens there."""
MODULES = {"fcntl", "grp", "pty", "pwd", "resource", "syslog", "termios", "tty"}
NAMES = {
    "O_NOFOLLOW", "SIGHUP", "SIGKILL", "SIGQUIT", "SIGUSR1", "SIGUSR2", "alarm", "chown", "fork", "forkpty", "geteuid",
    "getpgid", "getuid", "kill", "killpg", "mkfifo", "nice", "preexec_fn", "sched_getaffinity", "setitimer", "setpgid",
    "setsid", "statvfs", "uname", "wait3", "wait4", "waitpid",
}  # fmt: skip


def names_of_posix(file: Path) -> set[str]:
    """Return the modules, and attributes of `os` and `signal`, in a file that Windows does not have."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(file.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= MODULES & {name.name for name in node.names}
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in ("os", "signal"):
            found |= NAMES & {node.attr}
        elif isinstance(node, ast.keyword):
            found |= {"preexec_fn"} & {node.arg}
    return found


def test_what_windows_lacks_is_used_only_where_it_is_known_what_happens_there() -> None:
    found = {(file.relative_to(SRC).as_posix(), name) for file in SRC.rglob("*.py") for name in names_of_posix(file)}
    assert found == set(POSIX_ONLY)


def test_every_module_loads_where_there_are_no_modules_of_posix() -> None:
    # What None stands for in sys.modules cannot be imported. Python's own modules that need these are loaded before.
    script = f"""
import importlib, pkgutil, subprocess, sys, tempfile, multiprocessing.util, distributed, shapespace
sys.modules.update(dict.fromkeys({sorted(MODULES)!r}))
for found in pkgutil.walk_packages(shapespace.__path__, "shapespace."):
    if not found.name.endswith("__main__"):
        importlib.import_module(found.name)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]


def test_workers_that_start_from_nothing_fit_scans_of_any_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "COPIED", False)
    assert workers.context().get_start_method() == "spawn"
    folder = tmp_path / "Grüße 顔" / "with space"
    folder.mkdir(parents=True)
    # A backslash is a letter like others here, and ends a folder's name on Windows.
    names = ["two words", "zoë", "back\\slash" if sys.platform != "win32" else "plain"]
    for seed, name in enumerate(names):
        z = np.random.default_rng(seed).standard_normal(5)
        write_mesh(folder / f"{name}.ply", raw_scan(z, vertices=600, seed=seed).scan)
    model, model_file, out = blob_model(), folder / "the model.h5", folder / "öut put"
    model.save(model_file)
    jobs = make_jobs(sorted(folder.glob("*.ply")), folder=out)
    parallel, serial = FolderSink(out), FolderSink(tmp_path / "serial")
    for executor, sink in ((Local(workers=2), parallel), (Serial(), serial)):
        fit_many(jobs, BatchConfig(model, model_file), executor, sink)
    assert [parallel.records[job.name].b for job in jobs] == [serial.records[job.name].b for job in jobs]
    with (out / "coefficients.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert sorted(row["scan"] for row in rows) == sorted(names)
    assert all(row["path"].startswith("../") for row in rows)
    results = Folder(out)
    assert all(len(saved_scan(results, fit).vertices) == 600 for fit in find_fits(results))
