"""Caches in memory: values computed from an object, and values that the tasks of a run share.

All are emptied by `clear` and end with the process; `shapespace cache --clear` empties those on disk (`disk_cache`).
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar
from weakref import WeakSet

OwnerT = TypeVar("OwnerT")
ValueT = TypeVar("ValueT")
P = ParamSpec("P")

_ATTRIBUTE = "_cached_values"
_owners: WeakSet[Any] = WeakSet()
_latest: WeakSet[LatestValue[Any]] = WeakSet()


def cached_with_owner(
    *, limit: int | None = None
) -> Callable[[Callable[Concatenate[OwnerT, P], ValueT]], Callable[Concatenate[OwnerT, P], ValueT]]:
    """Return a decorator that stores a function's results with its first argument, as long as that object lives.

    The key is the function and its other arguments, which must be hashable. The object itself must not change.

    Args:
        limit: largest number of results of the function for one object; the oldest is dropped. None for no limit.
    """

    def decorator(compute: Callable[Concatenate[OwnerT, P], ValueT]) -> Callable[Concatenate[OwnerT, P], ValueT]:
        name = f"{compute.__module__}.{compute.__qualname__}"

        @functools.wraps(compute)
        def cached(owner: OwnerT, *args: P.args, **kwargs: P.kwargs) -> ValueT:
            # Stored in the object, because a weak dictionary would never free a value that refers to its own key.
            values: dict[Hashable, ValueT] = vars(owner).setdefault(_ATTRIBUTE, {}).setdefault(name, {})
            key = (args, *sorted(kwargs.items()))
            if key not in values:
                value = compute(owner, *args, **kwargs)
                while limit is not None and len(values) >= limit:
                    values.pop(next(iter(values)))
                values[key] = value
                _owners.add(owner)
            return values[key]

        return cached

    return decorator


class LatestValue(Generic[ValueT]):
    """The value of the last requested key, such as the model of the batch that runs in this process."""

    def __init__(self) -> None:
        self._entry: tuple[Hashable, ValueT] | None = None
        _latest.add(self)

    def set(self, key: Hashable, value: ValueT) -> None:
        """Replace the value."""
        self._entry = key, value

    def get(self, key: Hashable, load: Callable[[], ValueT]) -> ValueT:
        """Return the value of `key`, loaded if another key was the last."""
        entry = self._entry
        if entry is None or entry[0] != key:
            entry = self._entry = key, load()
        return entry[1]

    def clear(self) -> None:
        """Drop the value."""
        self._entry = None


def clear() -> None:
    """Empty all caches in the memory of this process."""
    for owner in tuple(_owners):
        vars(owner).pop(_ATTRIBUTE, None)
    for latest in tuple(_latest):
        latest.clear()


_MEMINFO, _CGROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def available_bytes() -> int | None:
    """Return the bytes of memory that this process can still allocate; None if the system does not report them."""
    sizes = [size for size in (_system_bytes(), _container_bytes()) if size is not None]
    return min(sizes) if sizes else None


def _system_bytes() -> int | None:
    try:
        lines = _MEMINFO.read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration):
        pass
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return None


def _container_bytes() -> int | None:
    try:
        limit, used = ((_CGROUP / f"memory.{name}").read_text().strip() for name in ("max", "current"))
        return None if limit == "max" else max(int(limit) - int(used), 0)
    except (OSError, ValueError):
        return None
