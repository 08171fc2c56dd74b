"""What `check` and `info` do: facts of meshes, models and fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.batch.results import read_record
from shapespace.batch.run import naming
from shapespace.errors import ShapespaceError
from shapespace.geometry.doctor import examine
from shapespace.io.folders import mesh_files
from shapespace.io.meshes import read_mesh
from shapespace.model.shape_model import ShapeModel


def check(paths: Sequence[Path], *, recursive: bool, say: Callable[[str], None]) -> list[dict[str, Any]]:
    """Return what is in each mesh file, what is wrong with it, and what fitting will do about it.

    Args:
        paths: files and folders.
        recursive: whether to take what lies in folders below these too.
        say: told what was not taken.
    """
    reports: list[dict[str, Any]] = []
    found = mesh_files(paths, recursive=recursive)
    for sentence in found.left_out:
        say(sentence)
    for path in found.files:
        try:
            report = examine(read_mesh(path))
        except ShapespaceError as error:
            reports.append({"file": str(path), "usable": False, "error": naming(path, str(error))})
            continue
        facts = asdict(report)
        usable = not any(finding["level"] == "refused" for finding in facts["findings"])
        reports.append({"file": str(path), "usable": usable, **facts})
    return reports


def info(path: Path) -> dict[str, Any]:
    """Return the facts of a model, a mesh or the record of a fit.

    Raises:
        FileError: it cannot be read, or is none of these.
    """
    if path.name.endswith(".json"):
        record = read_record(path)
        return {"kind": "fit", **{key: value for key, value in record.items() if key != "history"}}
    if path.suffix.lower() in (".h5", ".hdf5"):
        return {"kind": "model", **model_facts(ShapeModel.load(path))}
    mesh = read_mesh(path)
    return {"kind": "mesh", "file": str(path), **asdict(examine(mesh))}


def model_facts(model: ShapeModel) -> dict[str, Any]:
    """Return the facts of a model as plain values."""
    counts = model.coding.get("control_counts")
    needed = {f"{share:g}": model.modes_for_variance(share) for share in (0.9, 0.95, 0.98, 0.985, 0.99)}
    return {
        "vertices": model.n_vertices,
        "triangles": 0 if model.faces is None else len(model.faces),
        "modes": model.n_modes,
        "training_shapes": model.n_training,
        "gauge": model.gauge,
        "units": "mm",
        "extent_mm": np.ptp(model.mean_vertices, axis=0).tolist(),
        "variance_held": float(model.cumulative_variance[-1]),
        "variance_of": "people left out" if model.held_out else "training shapes",
        "modes_for_variance": {share: modes for share, modes in needed.items() if modes is not None},
        "stddev_mm": model.stddev.tolist(),
        "noise_variance_mm2": model.noise_variance,
        "landmarks": list(model.landmarks),
        "representation": model.representation,
        **({} if counts is None else {"control_points": counts.tolist()}),
        "provenance": model.provenance,
        "licence": model.licence,
        "hash": model.content_hash,
    }
