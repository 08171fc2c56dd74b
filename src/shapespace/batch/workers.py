"""Worker processes: one server loads the code once, and each worker is a copy of it that ends with its parent.

This module imports nothing heavy, so that the server can start before the rest of the program is loaded.

The processes of a command print some messages only once together: that code is being compiled.
"""

from __future__ import annotations

import atexit
import contextlib
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from shapespace.errors import FitError

MARK = "SHAPESPACE_MESSAGE_MARK"
"""Environment variable of the server of the workers alone: a folder that the first process to print creates."""


class _Mark:
    path: str = os.environ.get(MARK, "")


def share_mark() -> str:
    """Return the mark that this process shares with the server that it starts."""
    if not _Mark.path:
        folder = Path(tempfile.mkdtemp(prefix="shapespace-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        _Mark.path = str(folder / "printed")
    return _Mark.path


def remove_mark() -> str:
    """Let this process print whatever others print; return that it has no mark."""
    _Mark.path = ""
    return ""


def is_first() -> bool:
    """Return whether this process is the first to print, of those that share its mark; the next call returns False."""
    if not _Mark.path:
        return True
    try:
        Path(_Mark.path).mkdir()
    except FileExistsError:
        return False
    except OSError:  # the folder is gone, or cannot be written: better twice than never
        return True
    return True


if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from multiprocessing.context import ForkServerContext, SpawnContext

WARM_UP = "SHAPESPACE_WARM_UP"
"""Set for the server alone: `notify` if it may print on standard error that it compiles, else `quiet`."""
COPIED = sys.platform == "linux"
"""Whether workers are copies of one server. Apple's BLAS does not survive a fork, and Windows has none."""
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def context() -> ForkServerContext | SpawnContext:
    """Return how workers start: as copies of a warm server on Linux, from nothing where copies are not safe."""
    return multiprocessing.get_context("forkserver") if COPIED else multiprocessing.get_context("spawn")


def start_loading(*, notify: bool) -> None:
    """Load the code of the workers in the background; where they start from nothing, see that it is compiled.

    Args:
        notify: whether a line on standard error may state that the code is being compiled.
    """
    mark = share_mark() if notify else remove_mark()
    if not COPIED:
        from shapespace.batch.warm import warm_up

        warm_up(notify=notify)
        return
    preload(("shapespace.batch.warm",), {WARM_UP: "notify" if notify else "quiet", MARK: mark})


def preload(modules: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    """Import `modules` in the background for workers that are copies; do nothing where they start from nothing.

    Args:
        modules: names.
        environment: variables of the server alone.
    """
    if not COPIED:
        return
    from multiprocessing import forkserver  # not on Windows

    # One worker is one core: threads of BLAS would spread it over all.
    wanted = dict.fromkeys(_BLAS_THREADS, "1") | dict(environment or {})
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    try:
        with interrupts_ignored():
            forkserver.set_forkserver_preload(list(modules))
            forkserver.ensure_running()
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def wait_until_loaded() -> None:
    """Return when workers start at once; Ctrl-C is heard until then.

    Raises:
        FitError: no process can be started.
    """
    if not COPIED:
        return
    try:
        first = context().Process(target=_nothing)
        with _children_allowed():
            first.start()
        first.join()
    except (EOFError, OSError) as error:
        raise FitError("The system does not let worker processes start; fit with --jobs 1.") from error


def _nothing() -> None:
    pass


class Worker:
    """A process that receives one task after the other through a pipe of its own.

    Args:
        serve: the function it runs, called with its end of the pipe and `arguments`; it sends `()` when it is ready.
        arguments: of `serve`.
        life: of `life_line`; the process ends with it, whatever it does.

    Raises:
        FitError: no process can be started.
    """

    def __init__(self, serve: Callable[..., None], arguments: tuple[Any, ...], life: Connection) -> None:
        self.line, theirs = context().Pipe()
        self._process = context().Process(target=_live, args=(serve, theirs, life, arguments), daemon=True)
        try:
            with interrupts_ignored(), _children_allowed():
                self._process.start()
        except (EOFError, OSError) as error:
            raise FitError("The system does not let worker processes start; use --jobs 1.") from error
        finally:
            theirs.close()

    def give(self, task: object) -> None:
        """Send a task; if the worker has died meanwhile, `answer` returns None."""
        with contextlib.suppress(OSError):
            self.line.send(task)

    def answer(self) -> Any:
        """Return the tuple that it sent, `()` when it is ready, or None if none has arrived or can arrive."""
        try:
            return self.line.recv() if self.line.poll() else None
        except (EOFError, OSError):
            return None

    def stop(self) -> int:
        """End it at once where it has not ended, and return its exit code, below 0 for a signal."""
        self._process.kill()
        self._process.join()
        self.line.close()
        code = self._process.exitcode
        self._process.close()
        return 0 if code is None else code


@contextlib.contextmanager
def life_line() -> Generator[Connection]:
    """Yield what ends with this block, and with this process whatever ends that: nobody else holds its other end."""
    life, ours = context().Pipe(duplex=False)
    try:
        yield life
    finally:
        ours.close()
        life.close()


@contextlib.contextmanager
def _children_allowed() -> Generator[None]:
    """Let workers of Dask, which are daemons, have children too: the life line ends those with them."""
    config: dict[str, Any] = cast(Any, multiprocessing.current_process())._config
    daemon = config.pop("daemon", None)
    try:
        yield
    finally:
        if daemon is not None:
            config["daemon"] = daemon


def end_after(wait: Callable[[], object]) -> None:
    """End this process when `wait`, which waits for the end of its parent, returns."""

    def end() -> None:
        wait()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


def _live(serve: Callable[..., None], line: Connection, life: Connection, arguments: tuple[Any, ...]) -> None:
    end_after(lambda: life.poll(None))
    serve(line, *arguments)


@contextlib.contextmanager
def interrupts_ignored() -> Generator[None]:
    """Let processes that start in this block inherit deafness to Ctrl-C: stopping them is the parent's job."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
