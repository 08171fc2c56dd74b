"""What killed processes left half written goes with the next write into the folder, by whichever command."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shapespace.cli import main
from shapespace.formats.model_parts import write_folder
from shapespace.io.containers.archives import write_arrays
from shapespace.io.files import atomic_path, sweep, temporary_folder, write_bytes, write_text, write_together
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.types import Mesh

HIDDEN = ".shapespace-*"
KILLED = """
import os, pathlib, signal, sys
from shapespace.io.files import atomic_path, temporary_folder
folder = pathlib.Path(sys.argv[1])
with atomic_path(folder / "a.ply") as path, temporary_folder(folder) as below:
    path.write_bytes(b"half")
    (below / "b.ply").write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
"""


@pytest.fixture(scope="module")
def dead(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Names of a temporary file and a temporary folder of a process that was killed."""
    folder = tmp_path_factory.mktemp("dead")
    subprocess.run([sys.executable, "-c", KILLED, str(folder)])
    names = [path.name for path in folder.glob(HIDDEN)]
    assert len(names) == 2
    return names


def leave(folder: Path, names: list[str]) -> None:
    for name in names:
        if "-folder." in name:
            (folder / name).mkdir()
            (folder / name / "part").write_bytes(b"half")
        else:
            (folder / name).write_bytes(b"half")


@pytest.mark.skipif(os.name == "nt", reason="on Windows they stay for an hour")
@pytest.mark.parametrize("writer", ["bytes", "text", "mesh", "arrays", "together", "folder", "atomic", "temporary"])
def test_every_writer_first_removes_what_killed_processes_left(writer: str, dead: list[str], tmp_path: Path) -> None:
    leave(tmp_path, dead)
    new = tmp_path / "new.ply"
    match writer:
        case "bytes":
            write_bytes(new, b"whole")
        case "text":
            write_text(new, "whole")
        case "mesh":
            write_mesh(new, Mesh([[0.0, 0, 0]]))  # pyright: ignore[reportArgumentType]
        case "arrays":
            write_arrays(new, {})
        case "together":
            write_together({new: lambda path: path.write_bytes(b"whole")})
        case "folder":
            write_folder(new, {"a": b"whole"})
        case "atomic":
            with atomic_path(new) as path:
                path.write_bytes(b"whole")
        case _:
            with temporary_folder(tmp_path):
                new.write_bytes(b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["new.ply"]


def test_what_live_processes_and_other_machines_write_stays(dead: list[str], tmp_path: Path) -> None:
    _, rest = dead[0].removeprefix(".shapespace-").split("-", 1)
    others = [f".shapespace-elsewhere-{rest}", ".shapespace-x-99999999999999999999-a.ply", ".shapespace-mine"]
    leave(tmp_path, others)
    with atomic_path(tmp_path / "live.ply") as live:
        sweep(tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others, live.name])
        live.write_bytes(b"whole")
    old = time.time() - 7200
    os.utime(tmp_path / others[0], (old, old))
    sweep(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*others[1:], "live.ply"])


@pytest.mark.skipif(os.name == "nt", reason="on Windows they stay for an hour")
def test_data_faces_removes_what_a_killed_run_left(dead: list[str], tmp_path: Path) -> None:
    leave(tmp_path, dead)
    assert main(["data", "faces", "-o", str(tmp_path), "--subjects", "1", "--expressions", "neutral", "--quiet"]) == 0
    assert not list(tmp_path.glob(HIDDEN)) and list(tmp_path.glob("*.ply"))
