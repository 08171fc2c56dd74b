"""The files that a fit ends in: NAME.fit.json, NAME.fitted.ply, NAME.dense.ply, NAME.stages.npz, coefficients.csv."""

from __future__ import annotations

import csv
import io
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from shapespace.errors import FileFormatError
from shapespace.fit.result import FitResult
from shapespace.fit.stages import stage_arrays
from shapespace.geometry.surface import rms_size
from shapespace.io.files import atomic_path, write_text
from shapespace.io.meshes import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import FitRecord, to_json
from shapespace.store.results import bytes_at
from shapespace.store.rows import coefficient_columns, safe_cells
from shapespace.store.rows import coefficient_row as coefficient_row
from shapespace.version import __version__

RECORD_FORMAT, RECORD_VERSION = FitRecord.FORMAT, FitRecord.VERSION


@dataclass(frozen=True)
class Source:
    """A file that took part.

    Args:
        name: of the file.
        content_hash: SHA-256 of its content; of models their content hash.
        path: where it was, relative to the folder of the results where there is such a path; empty if not known.
    """

    name: str
    content_hash: str
    path: str = ""

    @staticmethod
    def at(file: Path, content_hash: str, folder: Path) -> Source:
        """Return the source `file` as results in `folder` refer to it."""
        try:
            path = os.path.relpath(file.resolve(), folder.resolve())
        except (ValueError, OSError):  # another drive, or a folder that is gone
            path = str(file)
        return Source(file.name, content_hash, Path(path).as_posix())

    def as_dict(self) -> dict[str, str]:
        """Return it as it stands in a result file; a path that is not known is left out."""
        known = {"path": self.path} if self.path else {}
        return {"name": self.name, "hash": self.content_hash, **known}


def fit_record(result: FitResult, scan: Source, model: Source, landmarks: Source | None = None) -> dict[str, Any]:
    """Return what NAME.fit.json says of `result`; `landmarks` is the file it started from, None if it used none."""
    T = result.T_scan_model
    return {
        "format": RECORD_FORMAT,
        "format_version": RECORD_VERSION,
        "scan": scan.as_dict(),
        "model": model.as_dict(),
        "landmarks": landmarks.as_dict() if landmarks else None,
        "status": result.status,
        "reason": result.reason,
        **_shown(result),
        "method": result.method,
        "config": dict(result.config),
        "start": result.start,
        "notes": list(result.notes),
        "T_scan_model": {
            "scale": T.scale,
            "rotation": T.rotation.tolist(),
            "translation": T.translation.tolist(),
        },
        "mm_per_scan_unit": result.mm_per_scan_unit,
        "size_mm": rms_size(result.surface().vertices) * result.mm_per_scan_unit,
        "b": result.b.tolist(),
        "z": result.z.tolist(),
        "b_stddev": result.b_stddev.tolist(),
        "b_stddev_calibrated": result.calibrated,
        "shrinkage": result.shrinkage.tolist(),
        "evidence": dict(result.evidence),
        "distances_mm": {name: stage.distances.as_dict() for name, stage in result.stages.items()},
        "history": [
            {
                "phase": state.phase,
                "iteration": state.iteration,
                "rms_mm": state.rms_mm,
                "motion_mm": state.motion_mm,
                "scale": state.T_scan_model.scale,
            }
            for state in result.history
        ],
        "iterations": result.iterations,
        "seconds": dict(result.seconds),
        "version": __version__,
    }


def _shown(result: FitResult) -> dict[str, Any]:
    """Return the distances over what scan and model both show, in mm of the model's frame and of the scan."""
    told: dict[str, Any] = {}
    for key, stage in (("shown", "final"), ("shown_dense", "dense")):
        if stage in result.stages:
            shown = result.shown_at(stage)
            told |= {key: asdict(shown), f"{key}_scan_mm": asdict(shown.in_unit(result.scan_mm_per_model_mm))}
    return told


def failed_record(scan: Source, model: Source, reason: str, config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record of a scan that could not be fitted at all."""
    return {
        "format": RECORD_FORMAT,
        "format_version": RECORD_VERSION,
        "scan": scan.as_dict(),
        "model": model.as_dict(),
        "status": "failed",
        "reason": reason,
        "config": dict(config),
        "version": __version__,
    }


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON; numbers that are not finite become null.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
        FileFormatError: it is no record that `schemas.FitRecord` could read again.
    """
    plain = to_json(record)
    FitRecord.from_json(plain, path.name)
    write_text(path, json.dumps(plain, indent=1, allow_nan=False) + "\n")


def read_record(path: Path) -> dict[str, Any]:
    """Return the record in a NAME.fit.json, or the one of a store that such a file would hold.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not the record of a fit.
    """
    try:
        record = json.loads(bytes_at(path))
    except (ValueError, RecursionError) as error:
        raise FileFormatError(f"{path} is not JSON, or it is cut short; fit the scan again.") from error
    if not isinstance(record, dict) or cast(dict[str, Any], record).get("format") != RECORD_FORMAT:
        raise FileFormatError(f"{path} is not the record of a fit; give a .fit.json written by shapespace fit.")
    FitRecord.from_json(cast(object, record), str(path))
    return cast(dict[str, Any], record)


def write_fitted_mesh(path: Path, result: FitResult, model: ShapeModel, stage: str = "final") -> None:
    """Write the surface at `stage`, in the model's vertex order and the scan's own frame and unit."""
    write_mesh(path, result.surface(model, stage))


def write_stages(path: Path, result: FitResult, model: ShapeModel) -> None:
    """Write `stage_arrays` as NAME.stages.npz."""
    with atomic_path(path) as temporary:
        arrays: dict[str, Any] = dict(stage_arrays(result, model))  # savez has keywords of its own type
        np.savez_compressed(temporary, **arrays)


def write_coefficients(path: Path, rows: Sequence[Mapping[str, Any]], n_modes: int) -> None:
    """Write the coefficient table, one row a scan, in the order given.

    Raises:
        FileError: the folder cannot be written, or the disk is full.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, coefficient_columns(n_modes), restval="", lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(safe_cells(row) for row in rows)
    write_text(path, text.getvalue())
