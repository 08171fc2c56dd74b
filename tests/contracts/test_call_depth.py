"""How many functions of shapespace a command passes through before the first numerical step of a fit."""

import traceback
from pathlib import Path

import numpy as np
import pytest

import shapespace
from shapespace.cli import main
from shapespace.fit.robust.robust_icp import Problem
from shapespace.io.meshes.mesh_io import write_mesh
from synthetic_shapes import blob_model, raw_scan

MAX_FRAMES = 8
"""From `main` to the caller of the first matching step."""


@pytest.mark.parametrize("scans", [1, 2])
@pytest.mark.parametrize("store", [False, True])
def test_few_frames_lie_between_the_command_and_the_first_matching_step(
    scans: int, store: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if store:
        pytest.importorskip("zarr", reason="the extra 'store' is not installed")
        pytest.importorskip("pyarrow", reason="the extra 'store' is not installed")
    package = str(Path(shapespace.__file__).parent)
    stacks: list[list[str]] = []
    match = Problem.match

    def noted(problem: Problem, *arguments: object) -> object:
        stacks.append(
            [
                f"{frame.filename.removeprefix(package)}:{frame.name}"
                for frame in traceback.extract_stack()
                if frame.filename.startswith(package)
            ]
        )
        return match(problem, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Problem, "match", noted)
    blob_model().save(tmp_path / "model.h5")
    for k in range(scans):
        (tmp_path / "scans").mkdir(exist_ok=True)
        write_mesh(tmp_path / "scans" / f"{k}.ply", raw_scan(np.full(5, 0.3), seed=k).scan)
    options = ["--quiet", "--set", "executor=serial", *(["--store"] if store else [])]
    assert main(["fit", f"{tmp_path}/model.h5", f"{tmp_path}/scans", "-o", f"{tmp_path}/out", *options]) == 0
    assert stacks[0][0].endswith(":main")
    assert len(stacks[0]) <= MAX_FRAMES, "\n".join(stacks[0])
