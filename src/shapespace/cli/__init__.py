"""The command line: parsing, printing and exit codes; the commands themselves are in `commands`.

Exit codes: 0 done; 1 some of several scans failed (or, under --strict, are doubtful); 2 wrong arguments or unusable
input; 130 stopped by Ctrl-C, 143 by SIGTERM and 129 by SIGHUP, files valid.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Generator, Sequence

from shapespace.cli.arguments import parser
from shapespace.cli.printing import say
from shapespace.errors import ShapespaceError

__all__ = ["main", "parser"]

_ENDING = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # The name of a file may contain characters that the encoding of the terminal lacks.
            stream.reconfigure(errors="backslashreplace")
    arguments = parser().parse_args(argv)
    try:
        with _raise_on_signals():
            code = int(arguments.run(arguments))
        sys.stdout.flush()
        return code
    except ShapespaceError as error:
        say(f"shapespace: {error}")
        return 2
    except MemoryError:
        say("shapespace: there is not enough memory for this; give fewer or smaller meshes, or fewer --jobs.")
        return 2
    except KeyboardInterrupt as ended:
        say(f"shapespace: stopped; the files written so far are complete{getattr(arguments, 'goes_on', '')}.")
        return 128 + (ended.signal if isinstance(ended, _TerminationSignal) else signal.SIGINT)
    except BrokenPipeError:
        _drop_output()
        return 0
    except OSError as error:
        _drop_output()
        where = f" ({error.filename})" if error.filename else ""
        say(f"shapespace: the system reports{where}: {error.strerror or error}; check the path and the free space.")
        return 2


class _TerminationSignal(KeyboardInterrupt):
    """A signal that ends this process."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.signal = number


@contextlib.contextmanager
def _raise_on_signals() -> Generator[None]:
    """Let the signals of Ctrl-C, of clusters and of closing terminals all raise, wherever they arrive."""
    asked: list[_TerminationSignal] = []

    def end(number: int, _frame: object) -> None:
        asked.append(_TerminationSignal(number))
        raise asked[-1]

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    taken = [number for name in _ENDING if (number := getattr(signal, name, None)) is not None]
    before = {number: signal.getsignal(number) for number in taken}
    # Under nohup SIGHUP is ignored, and stays ignored.
    before = {k: was for k, was in before.items() if was in (signal.SIG_DFL, signal.default_int_handler)}
    for number in before:
        signal.signal(number, end)
    try:
        yield
    except Exception:
        # Compiled code that receives a signal may raise another error instead.
        if asked:
            raise asked[0] from None
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _drop_output() -> None:
    """Discard the remaining output, so that python does not report an error when it flushes at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
