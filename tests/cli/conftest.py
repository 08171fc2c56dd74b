"""A small model and scans on disk, made by the command line itself, and a way to run it."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest

from shapespace.batch import progress
from shapespace.batch.warm import COMPILING
from shapespace.cli import main
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob_model, raw_scan, similarity, training_meshes

VERTICES = 400
Z = (
    np.array([1.0, -0.5, 0.5, 0.8, -0.3]),
    np.array([-0.8, 0.6, 0.2, -1.0, 0.5]),
    np.array([0.3, 1.1, -0.9, 0.1, 0.4]),
)


@dataclass(frozen=True)
class Outcome:
    """What one command line gave."""

    code: int
    out: str
    err: str

    @property
    def facts(self) -> Any:
        """Standard output as strict JSON."""

        def refuse(constant: str) -> NoReturn:
            raise AssertionError(f"{constant} is not JSON")

        return json.loads(self.out, parse_constant=refuse)

    def sentence(self) -> str:
        """The one sentence on standard error."""
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("shapespace: ") and lines[0].endswith("."), lines[0]
        assert ". " not in lines[0].removeprefix("shapespace: "), f"more than one sentence: {lines[0]}"
        return lines[0]


Run = Callable[..., Outcome]


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run one command line in this process, with no word on what takes long: machines differ in that."""
    monkeypatch.setattr(progress, "FIRST_LOG_LINE_S", 3600.0)

    def run(*arguments: object) -> Outcome:
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
        printed = capsys.readouterr()
        assert "Traceback" not in printed.out + printed.err
        return Outcome(code, printed.out, printed.err.replace(f"{COMPILING}\n", ""))

    return run


@dataclass(frozen=True)
class World:
    """Folders of a small model and its scans."""

    meshes: Path
    model: Path
    scans: tuple[Path, ...]

    @property
    def scan(self) -> Path:
        """The first scan: 1,000 vertices on triangles of its own, in mm."""
        return self.scans[0]


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """Twelve corresponding meshes with landmarks.csv, the model of all their modes, and three raw scans."""
    folder = tmp_path_factory.mktemp("world")
    meshes = folder / "meshes"
    meshes.mkdir()
    for k, mesh in enumerate(training_meshes(12, VERTICES)):
        write_mesh(meshes / f"blob_{k:02d}.ply", mesh)
    write_landmark_indices(meshes / "landmarks.csv", blob_model(VERTICES).landmarks)
    model = folder / "model.h5"
    assert main(["build", str(meshes), "-o", str(model), "--modes", "4", "--licence", "CC0", "--quiet"]) == 0
    scans: list[Path] = []
    for k, z in enumerate(Z):
        scans.append(folder / f"scan_{k}.ply")
        write_mesh(scans[-1], raw(z, seed=k))
    return World(meshes, model, tuple(scans))


def raw(z: FloatArray = Z[0], *, seed: int = 0, degrees: float = 8.0) -> Mesh:
    """Return a scan (mm) of the blob with `z`, turned and moved a little."""
    return raw_scan(
        z, similarity(seed, degrees=degrees, scale=1.0), vertices=1000, model_vertices=VERTICES, noise_mm=0.1
    ).scan


@pytest.fixture(scope="session")
def scan_mesh() -> Mesh:
    """The first scan of the world as it was written."""
    return raw(Z[0], seed=0)


def without_waiting(said: str) -> str:
    """Return standard error without lines on what is waited for, which depend on the machine."""
    return "".join(line for line in said.splitlines(keepends=True) if not line.endswith(" ...\n"))


def leftovers(folder: Path) -> list[str]:
    """Return the names of temporary files below `folder`."""
    return [path.name for path in folder.rglob(".*")]
