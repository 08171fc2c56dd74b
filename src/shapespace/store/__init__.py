"""Results of many fits in a few files: a manifest, Parquet tables, Zarr surfaces; and one way to read them all."""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.store.results import Results

__all__ = [
    "Results",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "store.results": ("Results",),
    },
)
