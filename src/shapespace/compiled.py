"""Compilation of loops by Numba on first use, with a cache on disk."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Any, ParamSpec, TypeVar, cast

import numba  # pyright: ignore[reportMissingTypeStubs]
from numba.core import event  # pyright: ignore[reportMissingTypeStubs]

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function` as machine code: float64 as written, one thread, without Python's lock.

    The Python function remains at `.py_func`, for tests. The code is cached next to the source, or in the cache folder
    of the user if the source folder is read-only, or only in memory if there is no cache folder.
    """

    def compile_function(*, cache: bool) -> Callable[P, R]:
        return cast(Callable[P, R], cast(Any, numba).njit(cache=cache, nogil=True, error_model="numpy")(function))

    try:
        return compile_function(cache=True)
    except RuntimeError:  # there is no folder for the cache
        return compile_function(cache=False)


@contextmanager
def notify_compilation(notify: Callable[[], None]) -> Generator[None]:
    """Call `notify` once before code is compiled in this block; code that is read from disk does not count."""

    class _FirstCompilation(cast(Any, event).Listener):
        has_notified = False

        def on_start(self, event: object) -> None:
            if not self.has_notified:
                self.has_notified = True
                notify()

        def on_end(self, event: object) -> None:
            pass

    with cast(Any, event).install_listener("numba:compile", _FirstCompilation()):
        yield
