"""Fits as rows of coefficients.csv and of the tables of a store."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from shapespace.io.tables.table_io import CHECKSUM
from shapespace.schemas import Distances, FitRecord, PoseRecord

_DIRECTIONS = ("model_to_scan", "scan_to_model")
_DISTANCE_COLUMNS = ("mean", "median", "rms", "p95", "max", "count")
_SHARES = ("model_seen_share", "scan_covered_share")
_EXPECTED = ("expected_error_mm", "beyond_model_mm")
_AXES = "xyz"
_SIZES = ("centroid_size_mm", "length_mm", "width_mm", "depth_mm", "area_mm2")
_LAST_COLUMNS = (
    *(f"shown_{direction}_{measure}_mm" for direction in _DIRECTIONS for measure in ("mean", "median")),
    *_SHARES,
    "path",
    *_EXPECTED,
    "size_mm",
    *_SIZES,
    "shape_rms_mm",
    *(f"rotation_{axis}_deg" for axis in _AXES),
    *(f"translation_{axis}" for axis in _AXES),
)
"""Columns before the last, `model_hash`, so that those of earlier versions keep their order."""

RECORD = "record"
"""Column of a store with the complete record as in its file."""

META = "meta_"
"""Prefix of the columns that were in the list of the scans."""

_EVIDENCE = "evidence_"
FLAGS = ("fitted", "dense", "stages")
"""Columns of a store that state which files of a fit are stored."""

TEXTS = (
    "scan", "id", "status", "reason", "start", "path", "scan_name", "scan_hash", "scan_version", "model_name",
    "model_hash", "method", "version", RECORD,
)  # fmt: skip
"""Columns of text, in addition to those whose names begin with `META`."""

COUNTS = (
    *(f"{direction}_count" for direction in _DIRECTIONS),
    "iterations",
    "modes",
    "scan_size_bytes",
    "scan_modified_ns",
)
"""Columns of integers."""


def coefficient_row(name: str, record: FitRecord) -> dict[str, Any]:
    """Return the row of coefficients.csv for `record`; a failed scan has its reason and path, and no numbers.

    Raises:
        ValueError: a record of a fit lacks its model, pose, distances or some of its coefficients.
    """
    if not record.model.hash:
        raise ValueError(f"The record of {name} does not name its model.")
    row: dict[str, Any] = {"scan": name, "status": record.status, "reason": record.reason}
    row |= {"model_hash": record.model.hash, "path": record.scan.path}
    row |= {f"{META}{key}": "" if value is None else str(value) for key, value in record.metadata.items()}
    if not record.b:
        return row
    if record.T_scan_model is None or "final" not in record.distances_mm:
        raise ValueError(f"The record of {name} has coefficients without a pose or without distances.")
    if not len(record.b) == len(record.z) == len(record.b_stddev):
        raise ValueError(f"The record of {name} does not have the same number of b, z and b_stddev.")
    for letter, values in (("b", record.b), ("z", record.z)):
        row |= {f"{letter}{k}": value for k, value in enumerate(values, 1)}
    final = record.distances_mm["final"]
    for direction in _DIRECTIONS:
        summary: Distances = getattr(final, direction)
        row |= {_distance_column(direction, measure): getattr(summary, measure) for measure in _DISTANCE_COLUMNS}
    row |= {"mm_per_scan_unit": record.mm_per_scan_unit, "size_mm": record.size_mm}
    row |= {key: value for key, value in record.evidence.items() if key in _EXPECTED}
    row |= _size_cells(record) | _moved_cells(record)
    row |= {f"b{k}_stddev": value for k, value in enumerate(record.b_stddev, 1)}
    return row | _pose_cells(record.T_scan_model) | _overlap_cells(record)


def _size_cells(record: FitRecord) -> dict[str, Any]:
    extents_mm = record.extents_mm or (None, None, None)
    sizes = record.centroid_size_mm, *extents_mm, record.area_mm2
    return {key: value for key, value in zip(_SIZES, sizes, strict=True) if value is not None}


def _moved_cells(record: FitRecord) -> dict[str, float]:
    """Return the RMS displacement of a vertex by each mode and by all modes, mm of the scan; b is a norm over all."""
    if not record.n_vertices or record.T_scan_model is None or record.mm_per_scan_unit is None:
        return {}
    scan_mm_per_model_mm = record.T_scan_model.scale * record.mm_per_scan_unit
    moved = np.abs(np.asarray(record.b, dtype=np.float64)) * scan_mm_per_model_mm / np.sqrt(float(record.n_vertices))
    cells = {f"b{k}_rms_mm": float(value) for k, value in enumerate(moved, 1)}
    return cells | {"shape_rms_mm": float(np.linalg.norm(moved))}


def _distance_column(direction: str, measure: str) -> str:
    return f"{direction}_{measure}" + ("" if measure == "count" else "_mm")


def _overlap_cells(record: FitRecord) -> dict[str, Any]:
    overlap = record.shown
    if overlap is None:
        return {}
    cells: dict[str, Any] = {key: getattr(overlap, key) for key in _SHARES}
    for direction in _DIRECTIONS:
        summary: Distances = getattr(overlap, direction)
        cells |= {f"shown_{direction}_{measure}_mm": getattr(summary, measure) for measure in ("mean", "median")}
    return cells


def _pose_cells(pose: PoseRecord) -> dict[str, float]:
    """Return scale, rotation vector (its direction the axis, its length the angle in degrees) and translation."""
    from scipy.spatial.transform import Rotation  # a tenth of a second that only those who fit should wait

    turn = Rotation.from_matrix(np.asarray(pose.rotation, dtype=np.float64)).as_rotvec(degrees=True)
    cells = {"scale": float(pose.scale)}
    cells |= {f"rotation_{axis}_deg": float(angle) for axis, angle in zip(_AXES, turn, strict=True)}
    return cells | {f"translation_{axis}": offset for axis, offset in zip(_AXES, pose.translation, strict=True)}


def coefficient_columns(n_modes: int, metadata_columns: Sequence[str] = ()) -> list[str]:
    """Return the columns of coefficients.csv in order: for `n_modes` coefficients, and for metadata of the scans."""
    modes = range(1, n_modes + 1)
    # The two means come first: older readers look for them there.
    lead = [_distance_column(direction, "mean") for direction in _DIRECTIONS]
    distance_columns = [
        _distance_column(direction, measure) for direction in _DIRECTIONS for measure in _DISTANCE_COLUMNS
    ]
    columns = ["scan", "status", "reason", *(f"b{k}" for k in modes), *(f"z{k}" for k in modes), *lead]
    columns += [column for column in distance_columns if column not in lead]
    columns += [
        "scale",
        "mm_per_scan_unit",
        *(f"b{k}_stddev" for k in modes),
        *(f"b{k}_rms_mm" for k in modes),
        *_LAST_COLUMNS,
    ]
    return [*columns, *metadata_columns, CHECKSUM, "model_hash"]


def store_row(name: str, record: FitRecord) -> dict[str, Any]:
    """Return the row of a store for `record`, without the record itself.

    Raises:
        ValueError: the record is damaged.
    """
    scan = record.scan
    row = coefficient_row(name, record)
    row |= {"id": record.id, "scan_name": scan.name, "scan_hash": scan.hash, "scan_version": scan.remote_version}
    row |= {"scan_size_bytes": scan.size_bytes, "scan_modified_ns": scan.modified_ns}
    row |= {"model_name": record.model.name, "method": record.method or None, "version": record.version or None}
    row |= {"start": record.start, "modes": len(record.b)}
    if record.seconds:
        row |= {"seconds": float(sum(record.seconds.values())), "iterations": sum(record.iterations.values())}
    row |= {
        f"{_EVIDENCE}{key}": float(value)
        for key, value in record.evidence.items()
        if isinstance(value, int | float) and key not in _EXPECTED
    }
    return row


def kind_of(column: str) -> str:
    """Return the kind of values of a column of a store: `text`, `count`, `flag` or `number`."""
    if column in TEXTS or column.startswith(META):
        return "text"
    return "count" if column in COUNTS else "flag" if column in FLAGS else "number"
