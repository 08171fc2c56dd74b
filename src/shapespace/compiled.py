"""Loops that numpy cannot express, compiled by Numba on first use and kept on disk from then on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba  # pyright: ignore[reportMissingTypeStubs]

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function` as machine code: float64 as written, one thread, without Python's lock.

    Its Python form stays at `.py_func`, for tests.
    """
    return cast(Callable[P, R], cast(Any, numba).njit(cache=True, nogil=True, error_model="numpy")(function))
