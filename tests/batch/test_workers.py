"""Workers: one thread of BLAS each, code compiled once and said so, and a server that never blocks the fit."""

import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numba
import pytest

from shapespace.batch import workers
from shapespace.batch.progress import telling_of_compiling
from shapespace.batch.warm import COMPILING
from shapespace.compiled import notify_compilation
from shapespace.errors import InputError

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="workers are copies of a server on Linux alone")
STATE = """
import os, signal, sys, threadpoolctl
def state():
    threads = [pool["num_threads"] for pool in threadpoolctl.threadpool_info() if pool["user_api"] == "blas"]
    return threads, "shapespace.fit.robust.robust_icp" in sys.modules, signal.getsignal(signal.SIGINT) is signal.SIG_IGN
"""


@LINUX
def test_workers_have_their_code_one_blas_thread_and_no_ear_for_ctrl_c(tmp_path: Path) -> None:
    (tmp_path / "worker_state.py").write_text(STATE)
    code = f"""
import sys, os
sys.path.insert(0, {str(tmp_path)!r})
from shapespace.batch import workers
if __name__ == "__main__":
    before = dict(os.environ)
    workers.start_loading(notify=False)
    assert dict(os.environ) == before and "numpy" not in sys.modules
    workers.wait_until_loaded()
    from concurrent.futures import ProcessPoolExecutor
    from worker_state import state
    with ProcessPoolExecutor(1, mp_context=workers.context()) as pool:
        print(pool.submit(state).result())
"""
    (tmp_path / "main.py").write_text(code)
    done = subprocess.run([sys.executable, tmp_path / "main.py"], capture_output=True, text=True, timeout=60)
    assert done.stderr == ""
    threads, loaded, deaf = eval(done.stdout)
    assert set(threads) == {1} and loaded and deaf


@LINUX
def test_a_server_that_dies_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    class Dead:
        @staticmethod
        def Process(**_: object) -> None:
            raise EOFError

    monkeypatch.setattr(workers, "context", Dead)
    with pytest.raises(workers.FitError, match="--jobs 1"):
        workers.wait_until_loaded()


def test_interrupts_are_heard_again_after_the_block() -> None:
    before = signal.getsignal(signal.SIGINT)
    with workers.interrupts_ignored():
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    assert signal.getsignal(signal.SIGINT) is before


def test_cores_are_those_that_this_process_may_use() -> None:
    assert 1 <= workers.cores() <= (os.cpu_count() or 1)


def test_compiling_is_told_once_and_what_is_there_already_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = "@compiled\ndef {0}(x):\n    return x + {1}\n"
    source = "from shapespace.compiled import compiled\n" + loop.format("first", 1) + loop.format("second", 2)
    (tmp_path / "fresh_loops.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    told: list[str] = []
    for _ in range(2):  # compiled, then read from disk
        loops = importlib.import_module("fresh_loops")
        with notify_compilation(lambda: told.append("compiling")):
            assert loops.first(1) == 2
            assert told == ["compiling"]
            assert loops.second(1) == 3
        assert told == ["compiling"]
        del sys.modules["fresh_loops"]


def test_a_small_fit_meets_every_loop_of_a_real_one() -> None:
    """What the server has loaded, no worker compiles."""
    code = """
import numpy as np
from shapespace.batch.warm import warm_up, _hill
from shapespace.compiled import notify_compilation
from numba.core.dispatcher import Dispatcher
warm_up(notify=False)
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
loaded, compile = [], Dispatcher.compile
Dispatcher.compile = lambda self, sig: (loaded.append(self.py_func.__name__), compile(self, sig))[1]
model = ShapeModel.fit([_hill(25, seed) for seed in range(12)], gauge="form")
scan = _hill(60, 30)
turned = Mesh(scan.vertices @ np.diag([1.0, -1.0, -1.0]) / 10 + 3.0, scan.faces)
for raw in (scan, turned, Mesh(turned.vertices)):
    fit_scan(model, raw, FitConfig())
print(loaded)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="Windows keeps no permissions for this")
def test_code_is_kept_elsewhere_or_nowhere_where_its_folder_cannot_be_written(tmp_path: Path) -> None:
    module = tmp_path / "site" / "loops.py"
    module.parent.mkdir()
    module.write_text("from shapespace.compiled import compiled\n@compiled\ndef one(x):\n    return x + 1\n")
    # A file stands where the folder would be, which not even root can write to.
    (module.parent / "__pycache__").write_text("")
    code = "import loops; print(loops.one(1))"
    for home in (tmp_path / "home", tmp_path / "file" / "home"):
        (tmp_path / "file").write_text("")
        done = subprocess.run(
            [sys.executable, "-B", "-c", code], capture_output=True, text=True, timeout=60,
            env={**os.environ, "PYTHONPATH": str(module.parent), "HOME": str(home), "XDG_CACHE_HOME": str(home)},
        )  # fmt: skip
        assert (done.stdout, done.returncode) == ("2\n", 0), done.stderr
        assert any(home.rglob("*.nbi")) if home.parent == tmp_path else not home.exists()


def test_compiling_is_told_in_a_log_too_unless_asked_not_to(capsys: pytest.CaptureFixture[str]) -> None:
    assert not sys.stderr.isatty()
    with telling_of_compiling(quiet=False):
        fresh()(1.0)
    assert capsys.readouterr().err == COMPILING + "\n"
    with telling_of_compiling(quiet=True):
        fresh()(1.0)
    assert capsys.readouterr().err == ""


def fresh() -> Callable[[float], float]:
    """Return a loop that no cache has."""
    return cast(Any, numba).njit(lambda x: x + 1.0)


def _end_in_another_process(here: int) -> str:
    if os.getpid() != here:
        os._exit(1)
    return "made here"


def _process() -> int:
    return os.getpid()


def _fail() -> None:
    raise InputError("This is wrong.")


def test_deferred_calls_are_made_elsewhere_or_here_and_raise_their_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "cores", lambda: 2)
    with workers.deferred_calls() as defer:
        waits, error = [defer(_process) for _ in range(3)], defer(_fail)
        assert os.getpid() not in [wait() for wait in waits]
        with pytest.raises(InputError, match="wrong"):
            error()
        assert defer(_end_in_another_process, os.getpid())() == "made here"
        assert defer(_process)() == os.getpid()  # no process is left
    monkeypatch.setattr(workers, "cores", lambda: 1)
    with workers.deferred_calls() as defer:
        assert defer(_process)() == os.getpid()
