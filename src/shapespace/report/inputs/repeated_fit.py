"""The command that repeats the fits of a folder."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

from shapespace.errors import ShapespaceError
from shapespace.fit.fit_scan import FitConfig
from shapespace.io.files import read_bytes
from shapespace.io.tables.table_io import table_rows
from shapespace.schemas import FitRecord

_MOST_SCANS = 50  # paths in a command; more do not belong in a line
_OPTIONS = {
    "method": "--method", "unit": "--unit", "scale": "--scale", "dense": "--dense", "crop": "--crop",
    "region": "--region", "strict": "--strict",
}  # fmt: skip
"""Setting in a record -> its option."""
_SETTINGS = ("max_iterations", "seed", "landmark_stddev_mm")
"""Those that are given by --set."""


def command_with_stages(root: Path, records: Mapping[str, FitRecord]) -> str:
    """Return the command, to be run in the folder `root`, that fits the scans of `records` again and saves the stages.

    The scans are those of the folder's list, which has landmarks and metadata too, if it contains these and no others;
    otherwise, and for a scan without both, they are named one by one.

    Args:
        root: folder of the results.
        records: NAME -> record of each fit.
    """
    first = next(iter(records.values()))
    scans = [record.scan.path or "SCAN" for record in records.values()]
    is_plain = len(records) == 1 and first.landmarks is None and not first.metadata
    if not is_plain and _listed(root / FitRecord.LIST) == set(records):
        scans = [FitRecord.LIST]
    elif len(scans) > _MOST_SCANS:
        scans = ["SCANS"]
    usual, options = FitConfig().as_dict(), list[str]()
    for name in (*_OPTIONS, *_SETTINGS):
        value = first.config.get(name)
        if value in (None, usual.get(name), False) or not isinstance(value, str | int | float):
            continue
        given = ["--set", f"{name}={value}"] if name in _SETTINGS else [_OPTIONS[name], str(value)]
        options += given[:1] if value is True else given
    return shlex.join(["shapespace", "fit", first.model.path or "MODEL.h5", *scans, "-o", ".", "--stages", *options])


def _listed(file: Path) -> set[str]:
    """Return the names of the results in a list of scans; none if there is no such list."""
    try:
        rows = table_rows(read_bytes(file))
        column = next(rows).index("id")
        return {row[column] for row in rows}
    except (ShapespaceError, ValueError):
        return set()
