"""Command `cache`: print the folder and the size of the cache, or clear it."""

from __future__ import annotations

from shapespace.commands.outcome import Outcome
from shapespace.io import disk_cache


def cache(*, clear: bool) -> Outcome:
    """Return the folder and the size of the cache on disk, after it was cleared if `clear`."""
    if clear:
        disk_cache.clear()
    folder, entries = disk_cache.entries_folder(), disk_cache.entries()
    size = sum(file.stat().st_size for file in entries)
    if folder is None:
        return Outcome({"folder": None, "entries": 0, "bytes": 0}, ["The cache is off (SHAPESPACE_KEEP)."])
    facts = {"folder": str(folder), "entries": len(entries), "bytes": size}
    return Outcome(facts, [f"{folder}: {len(entries)} entries, {size / 1e6:.1f} MB"])
