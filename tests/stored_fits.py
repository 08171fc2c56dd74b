"""Single results of fits as `shapespace fit` writes them, made up and not fitted, for tests of stores."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from synthetic_shapes import blob_model

VERTICES, MODES = 60, 4


def model() -> ShapeModel:
    return blob_model(VERTICES, MODES)


def distances(mean: float) -> dict[str, Any]:
    each = {"mean": mean, "median": mean, "rms": mean, "p95": 2 * mean, "max": 3 * mean, "count": 60, "fraction": 1.0}
    return {"model_to_scan": each, "scan_to_model": each | {"count": 500}}


def record(name: str, k: int, *, status: str = "converged", **more: Any) -> dict[str, Any]:
    """Return the record of a fit that depends on `k` alone."""
    rng = np.random.default_rng(k)
    found: dict[str, Any] = {
        "format": "shapespace fit",
        "format_version": 1,
        "scan": {"name": f"{name}.ply", "hash": f"{k:064x}", "path": f"../scans/{name}.ply"},
        "model": {"name": "model.h5", "hash": model().content_hash, "path": "../model.h5"},
        "status": status,
        "reason": f"It is {status} after {k} steps.",
        "config": {"method": "robust", "dense": False},
        "version": "0.1.0",
        "id": f"{k + 1:064x}",
        **more,
    }
    if status == "failed":
        return found
    z = rng.normal(0, 1, MODES)
    shown = distances(0.3) | {"model_seen_share": 0.9, "scan_covered_share": 1.0}
    return found | {
        "shown": shown,
        "method": "robust",
        "start": "upright",
        "notes": [],
        "T_scan_model": {"scale": 1.0, "rotation": np.eye(3).tolist(), "translation": [1.0, 2.0, 3.0]},
        "mm_per_scan_unit": 1.0,
        "size_mm": 80.0,
        "b": (z * model().stddev).tolist(),
        "z": z.tolist(),
        "b_stddev": [0.1] * MODES,
        "shrinkage": [1.0] * MODES,
        "evidence": {"expected_error_mm": 0.5 + 0.01 * k, "z2": float(z @ z)},
        "distances_mm": {"final": distances(0.5)},
        "iterations": {"phase_1": 3, "phase_2": 5},
        "seconds": {"phase_1": 0.5, "phase_2": 1.0},
        **more,
    }


def write_fit(folder: Path, name: str, k: int, *, dense: bool = False, stages: bool = False, **more: Any) -> None:
    """Write a single result with its surfaces, far from the origin as scans may be."""
    folder.mkdir(parents=True, exist_ok=True)
    told = record(name, k, **more)
    if told["status"] != "failed":
        shape = model().reconstruct(np.array(told["b"])) + np.array([5000.0, -300.0, 1e5])
        for kind, shift in (("fitted", 0.0), ("dense", 0.25)):
            if kind == "fitted" or dense:
                write_mesh(folder / f"{name}.{kind}.ply", model().mesh().with_vertices(shape + shift))
        if stages:
            np.savez_compressed(folder / f"{name}.stages.npz", b=np.array(told["b"]))
    (folder / f"{name}.fit.json").write_text(json.dumps(told, indent=1) + "\n")


def write_fits(folder: Path, count: int = 12, **more: Any) -> list[str]:
    """Write results of several statuses and return their names."""
    names = [f"scan{k:03d}" for k in range(count)]
    for k, name in enumerate(names):
        status = "failed" if k % 6 == 5 else "doubtful" if k % 6 == 4 else "converged"
        write_fit(folder, name, k, dense=k % 2 == 0, stages=k % 3 == 0, status=status, **more)
    return names


def content(folder: Path) -> dict[str, bytes]:
    """Return name -> bytes of every file below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}
