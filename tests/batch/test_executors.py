"""One contract for every executor: each task is answered once, whatever becomes of the workers."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from shapespace.batch.executors import EXECUTORS, ExecutionConfig, Executor, Local, Serial
from shapespace.errors import FileError, FitError, InputError

SEVERAL = [kind for kind in EXECUTORS if kind != "serial"]
TIMEOUT_S = 3.0


@dataclass(frozen=True)
class Letters:
    """Writes a line for each task, and does what the task says."""

    folder: Path

    def do(self, task: str) -> tuple[str, int]:
        if (given_up := self.folder / f"{task}.given_up").is_file():
            return given_up.read_text(), 0
        with (self.folder / f"{task}.done").open("a") as stream:
            stream.write(f"{os.getpid()}\n")
        tries = len((self.folder / f"{task}.done").read_text().splitlines())
        if task == "full":
            raise FileError("The disk is full.")
        if task.startswith("kill") or (task.startswith("unlucky") and tries == 1):
            os.kill(os.getpid(), signal.SIGKILL)
        if task.startswith("hang"):
            time.sleep(600)
        time.sleep(0.01)
        return task.upper(), os.getpid()

    def give_up(self, task: str, reason: str) -> tuple[str, int]:
        (self.folder / f"{task}.given_up").write_text(reason)
        return reason, 0


@pytest.fixture(params=EXECUTORS)
def executor(request: pytest.FixtureRequest) -> Callable[..., Executor]:
    """What makes an executor of each kind."""
    kind: str = request.param
    if kind == "serial":
        return Serial
    if kind == "local":
        return partial(Local, 2)
    client = request.getfixturevalue("cluster")
    from shapespace.batch.on_dask import OnDask

    return partial(OnDask, client)


def results(executor: Executor, work: Any, tasks: Any) -> list[tuple[Any, Any]]:
    with executor.run(work, tasks) as found:
        return list(found)


def several(executor: Callable[..., Executor]) -> Callable[..., Executor]:
    if executor is Serial:
        pytest.skip("a process cannot do without itself")
    return executor


def test_each_task_is_answered_once(executor: Callable[..., Executor], tmp_path: Path) -> None:
    tasks = [f"t{k}" for k in range(40)]
    answers = results(executor(), Letters(tmp_path), tasks)
    assert sorted((task, answer[0]) for task, answer in answers) == sorted((task, task.upper()) for task in tasks)
    assert all(len((tmp_path / f"{task}.done").read_text().splitlines()) == 1 for task in tasks)
    assert results(executor(), Letters(tmp_path), []) == []


def test_what_stops_every_task_is_raised(executor: Callable[..., Executor], tmp_path: Path) -> None:
    with pytest.raises(FileError, match="disk is full"):
        results(executor(), Letters(tmp_path), ["a", "full", *(f"t{k}" for k in range(20))])


def test_a_task_that_kills_its_workers_is_given_up_and_the_others_go_on(
    executor: Callable[..., Executor], tmp_path: Path
) -> None:
    tasks = ["a", "kill", "b", "unlucky1", "c", "unlucky2", "d"]
    answers = {task: answer[0] for task, answer in results(several(executor)(), Letters(tmp_path), tasks)}
    assert "lack of memory" in answers.pop("kill")
    assert answers == {task: task.upper() for task in tasks if task != "kill"}


def test_a_task_that_hangs_is_given_up_and_the_others_go_on(executor: Callable[..., Executor], tmp_path: Path) -> None:
    began = time.monotonic()
    tasks = ["a", "hang", *"bcd"]
    limited = several(executor)(timeout_s=TIMEOUT_S)
    answers = {task: answer[0] for task, answer in results(limited, Letters(tmp_path), tasks)}
    assert "--set timeout" in answers.pop("hang")
    assert answers == {task: task.upper() for task in tasks if task != "hang"}
    assert time.monotonic() - began < 60


def test_closed_early_nothing_goes_on(executor: Callable[..., Executor], tmp_path: Path) -> None:
    tasks = [f"t{k:03d}" for k in range(400)]
    with executor().run(Letters(tmp_path), tasks) as ended:
        next(ended)
    time.sleep(0.3)
    done = len(list(tmp_path.glob("*.done")))
    time.sleep(0.5)
    assert done == len(list(tmp_path.glob("*.done"))) < len(tasks)


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_workers_end_with_their_parent_whatever_ends_it(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
from shapespace.batch.executors import Local
from test_executors import Letters, results
if __name__ == "__main__":
    results(Local(2), Letters(Path({str(tmp_path)!r})), ["hang1", "hang2"])
"""
    (tmp_path / "main.py").write_text(code)
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    parent = subprocess.Popen([sys.executable, tmp_path / "main.py"], env={**os.environ, "PYTHONPATH": path})
    lines = [tmp_path / f"hang{k}.done" for k in (1, 2)]
    limit = time.monotonic() + 60
    while not all(line.is_file() and line.read_text() for line in lines) and time.monotonic() < limit:
        time.sleep(0.02)
    parent.kill()
    parent.wait()
    pids = [int(line.read_text().split()[0]) for line in lines]
    while any(Path(f"/proc/{pid}/stat").exists() for pid in pids) and time.monotonic() < limit:
        time.sleep(0.02)
    assert not [pid for pid in pids if Path(f"/proc/{pid}/stat").exists()]


@dataclass(frozen=True)
class Unloadable:
    """Ends each worker as it starts."""

    def __reduce__(self) -> Any:
        return os._exit, (3,)

    def do(self, task: str) -> str:
        return task

    def give_up(self, task: str, reason: str) -> str:
        return reason


def test_workers_that_cannot_start_are_one_sentence() -> None:
    with pytest.raises(FitError, match="--jobs 1"):
        results(Local(2), Unloadable(), ["a", "b", "c"])


@pytest.mark.parametrize(
    ("told", "match"),
    [
        ({"kind": "slurm"}, "local, serial, dask"),
        ({"dask": "tcp://x:1"}, "omit one of the two"),
        ({"kind": "serial", "timeout_s": 3.0}, "hangs"),
    ],
)
def test_where_tasks_cannot_run_is_said(told: dict[str, Any], match: str) -> None:
    with pytest.raises(InputError, match=match):
        ExecutionConfig(**told)


def test_a_scheduler_that_is_not_there_is_named(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    from shapespace.batch import on_dask

    on_dask.FINDS_S, before = 0.2, on_dask.FINDS_S
    try:
        with pytest.raises(InputError, match=r"127\.0\.0\.1:9"):
            results(on_dask.OnDask("tcp://127.0.0.1:9"), Letters(tmp_path), ["a"])
    finally:
        on_dask.FINDS_S = before


def set_version(version: str) -> None:
    """Let the code that Dask runs in this worker, and what it starts, be of another version."""
    import shapespace.batch.on_dask
    import shapespace.version

    shapespace.version.__version__ = shapespace.batch.on_dask.__version__ = version


def test_workers_of_another_version_are_refused_by_name(cluster: Any, tmp_path: Path) -> None:
    from shapespace.batch import on_dask
    from shapespace.version import __version__

    other, same = sorted(cluster.nthreads())
    cluster.run(set_version, "9.8.7", workers=[other])
    try:
        with pytest.raises(FitError) as refused:
            results(on_dask.OnDask(cluster), Letters(tmp_path), ["a", "b"])
        said = str(refused.value)
        assert __version__ in said and f"9.8.7 at {other}" in said and same not in said and said.endswith(".")
        assert not list(tmp_path.iterdir())
        # One that comes after the versions were checked refuses its tasks.
        late = cluster.submit(
            on_dask.do_chunk, Letters(tmp_path), ["a"], None, __version__, workers=[other], allow_other_workers=False
        )
        with pytest.raises(FitError, match=r"9\.8\.7"):
            late.result()
        assert not list(tmp_path.iterdir())
    finally:
        cluster.run(set_version, __version__, workers=[other])
    assert [answer[0] for _, answer in results(on_dask.OnDask(cluster), Letters(tmp_path), ["a"])] == ["A"]


def test_a_cluster_without_workers_is_told_while_it_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    from shapespace.batch import on_dask

    assert on_dask.REPORT_S == 10.0
    monkeypatch.setattr(on_dask, "REPORT_S", 0.1)
    monkeypatch.setattr(on_dask, "WORKERS_S", 0.5)
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as empty,
        distributed.Client(empty) as client,
        pytest.raises(FitError, match=r"no worker after 0\.5 s"),
    ):
        results(on_dask.OnDask(client), Letters(tmp_path), ["a"])
    said = capsys.readouterr().err
    assert "No Dask worker has connected" in said and "dask worker" in said and said.count("\n") == 1
