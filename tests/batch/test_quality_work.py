"""Quality measured in one process, in several and on a Dask cluster: the same numbers, and nothing left behind."""

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.batch.executors import EXECUTORS, ExecutionConfig, Local, Serial, Shared
from shapespace.commands.quality import QualityRunner, QualityWork
from shapespace.errors import FitError
from shapespace.io import memory_cache
from shapespace.model.model_quality import Curve, ModelQuality, QualityConfig, QualityTask, Shapes, measure_quality
from shapespace.types import Mesh
from synthetic_shapes import blob_model

SETTINGS = QualityConfig(folds=3, samples=7, seed=2)


@pytest.fixture(scope="module")
def meshes() -> list[Mesh]:
    model = blob_model(200)
    drawn = model.sample(8, np.random.default_rng(0))
    return [Mesh(model.mesh(b).vertices, model.faces, name=f"blob {i}") for i, b in enumerate(drawn)]


def numbers(quality: ModelQuality) -> list[float]:
    curves = [value for value in vars(quality).values() if isinstance(value, Curve)]
    assert len(curves) == 6
    return [float(x) for curve in curves for x in np.concatenate([curve.mean, curve.low, curve.high])]


@pytest.mark.parametrize("kind", ["serial", "local", "dask"])
def test_every_executor_measures_the_same_to_the_bit(
    kind: str, meshes: list[Mesh], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    dask = request.getfixturevalue("cluster").scheduler.address if kind == "dask" else ""
    run = QualityRunner(
        ExecutionConfig(kind, jobs=2 if kind == "local" else 0, dask=dask), tmp_path / "out", quiet=True
    )
    assert numbers(measure_quality(meshes, SETTINGS, run=run)) == numbers(measure_quality(meshes, SETTINGS))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize("judged_by", ["themselves", "scans"])
def test_what_workers_read_is_what_was_to_be_measured(judged_by: str, meshes: list[Mesh], tmp_path: Path) -> None:
    scans = None
    if judged_by == "scans":
        scans = [Mesh(mesh.vertices[:150], None, name=f"scan of {mesh.name}") for mesh in meshes]
    config = QualityConfig(folds=None, samples=4, representation="vertices", gauge="form", align=False, modes=3)
    shapes = Shapes(meshes, scans, config)
    with Shared.by(Local(), shapes, tmp_path) as shared:
        work = QualityWork(shared)
        memory_cache.clear()  # as in another process
        first, last = shapes.parts()[0], shapes.parts()[-1]
        for part in (first, last):
            assert np.array_equal(np.asarray(work.do(part)[0]), shapes.do(part))
        read = shared.value()
    assert read is not shapes and read.config == config
    assert [mesh.name for mesh in read.meshes] == [mesh.name for mesh in meshes]


def test_a_part_that_no_worker_survives_ends_in_a_sentence(
    meshes: list[Mesh], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Lost(Serial):
        def run(self, work: Any, tasks: Sequence[QualityTask], /) -> Any:
            return nullcontext((task, work.give_up(task, "its worker ended by signal 9")) for task in tasks)

    monkeypatch.setitem(EXECUTORS, "serial", lambda *_: Lost())
    run = QualityRunner(ExecutionConfig("serial"), tmp_path, quiet=True)
    with pytest.raises(FitError, match="signal 9; run it with fewer"):
        measure_quality(meshes, SETTINGS, run=run)
