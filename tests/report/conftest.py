"""A small demo folder as the demo writes it, on round heads of a few hundred vertices."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.io.meshes import write_mesh
from shapespace.types import Mesh, Similarity

STAGES = ("before", "initial", "final")


def make_head(n: int = 14) -> Mesh:
    u, v = np.meshgrid(np.linspace(0.02, np.pi - 0.02, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    points = np.stack([60 * np.sin(u) * np.sin(v), 90 * np.cos(u), 70 * np.sin(u) * np.cos(v)], axis=-1).reshape(-1, 3)
    i = np.arange(n * 2 * n).reshape(n, 2 * n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), name="head")


def summary(values: np.ndarray) -> dict[str, float]:
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "rms": float(np.sqrt((values**2).mean())),
        "p95": float(np.percentile(values, 95)),
        "max": float(values.max()),
        "count": len(values),
        "fraction": 1.0,
    }


def write_fit(root: Path, part: str, name: str, expression: str, level: float, modes: int = 4) -> dict[str, Any]:
    rng = np.random.default_rng(len(name) + round(100 * level))
    mesh = make_head()
    assert mesh.faces is not None
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T_scan_model = Similarity(0.5, turn, np.array([300.0, -20.0, 5.0]))
    for folder in ("scans", "fits"):
        (root / part / folder).mkdir(parents=True, exist_ok=True)
    scan = T_scan_model.apply(mesh.vertices + rng.normal(0, 0.3, mesh.vertices.shape))
    write_mesh(root / part / "scans" / f"{name}.ply", Mesh(scan, mesh.faces))
    arrays: dict[str, Any] = {"faces": mesh.faces}
    distances: dict[str, Any] = {}
    for stage, size in zip(STAGES, (20.0, 4.0, 1.0), strict=True):
        arrays[stage] = (T_scan_model.apply(mesh.vertices + np.array([size, 0, 0]))).astype(np.float32)
        forward, backward = (np.abs(rng.normal(0, size, count)) for count in (len(mesh.vertices), 150))
        arrays[f"model_to_scan_{stage}"], arrays[f"scan_to_model_{stage}"] = forward, backward
        distances[stage] = {"model_to_scan": summary(forward), "scan_to_model": summary(backward)}
    np.savez_compressed(root / part / "fits" / f"{name}.stages.npz", **arrays)
    z = rng.normal(0, 1, modes) * (level + 0.1)
    record = {
        "format": "shapespace fit",
        "scan": {"name": f"{name}.ply", "hash": "ab" * 32},
        "model": {"name": "model.h5", "hash": "cd" * 32},
        "status": "converged",
        "reason": "The RMS closest distance stood still at 1.00 mm.",
        "config": {"method": "paper", "max_iterations": 500},
        "T_scan_model": {"scale": 0.5, "rotation": turn.tolist(), "translation": [300.0, -20.0, 5.0]},
        "mm_per_scan_unit": 1.0,
        "b": (z * np.arange(40, 40 - 5 * modes, -5)).tolist(),
        "z": z.tolist(),
        "distances_mm": distances,
        "history": [
            {"phase": 1 + k // 5, "iteration": k % 5, "rms_mm": 20.0 / (k + 1), "motion_mm": None} for k in range(10)
        ],
        "iterations": {"phase_1": 5, "phase_2": 5},
        "seconds": {"phase_1": 0.1},
    }
    (root / part / "fits" / f"{name}.fit.json").write_text(json.dumps(record))
    return {
        "name": name,
        "expression": expression,
        "intensity": level,
        "scan": f"{part}/scans/{name}.ply",
        "json": f"{part}/fits/{name}.fit.json",
        "stages": f"{part}/fits/{name}.stages.npz",
        "vertex_error_mm": {"mean": 0.51, "rms": 0.6, "max": 2.0},
        "floor_mm": {"mean": 0.21, "rms": 0.3, "max": 1.0},
    }


def write_demo(root: Path) -> dict[str, Any]:
    mesh, rng = make_head(), np.random.default_rng(0)
    training = root / "experiment1" / "training"
    training.mkdir(parents=True)
    (root / "experiment2").mkdir()
    examples = []
    for k in range(4):
        write_mesh(training / f"{k:03}.ply", mesh.with_vertices(mesh.vertices * (1 + 0.02 * k)))
        examples.append({"file": f"experiment1/training/{k:03}.ply", "label": f"training {k}"})
    for part in ("experiment1", "experiment2"):
        np.savez_compressed(
            root / part / "modes.npz",
            mean=mesh.vertices,
            faces=mesh.faces,
            stddev=np.array([40.0, 35.0, 30.0, 25.0]),
            basis5=rng.normal(0, 0.5, (4, *mesh.vertices.shape)),
        )
    cumulative = [0.6, 0.85, 0.96, 0.986, 0.995, 1.0]
    demo: dict[str, Any] = {
        "version": "0.1.0",
        "quick": True,
        "created": "2026-01-02T03:04:05+00:00",
        "machine": "a machine",
        "seed": 1,
        "seconds": {"total": 12.3},
        "versions": {"numpy": "2"},
        "paper_table": [
            {"quantity": "Modes", "paper": "5", "measured": "4", "truth": None, "why": "Other expressions."},
            {"quantity": "Mean distance", "paper": "1.24 mm", "measured": "1.0 mm", "truth": "0.5 mm", "why": None},
        ],
        "experiment1": {
            "title": "Expressions of one person",
            "n_training": 100,
            "modes_for_98_5": 4,
            "cumulative_variance": cumulative,
            "training_examples": examples,
            "mode_shapes": "experiment1/modes.npz",
            "population_z": rng.normal(0, 1, (20, 4)).tolist(),
            "fits": [
                write_fit(root, "experiment1", "neutral", "neutral", 0.0),
                *(
                    write_fit(root, "experiment1", f"{name}_{round(100 * level):03}", name, level)
                    for name in ("anger", "smile")
                    for level in (0.5, 1.0)
                ),
            ],
            "scores": {
                "left_out": [],
                "line_spearman": {"anger": 1.0, "smile": 0.8},
                "disjointness": {"leave_one_out_accuracy": 0.9375},
            },
        },
        "experiment2": {
            "cases": [
                {
                    "title": "Simulated scan of a stranger",
                    "simulated": True,
                    "note": "It has hair.",
                    "n_training": 100,
                    "modes_for_98_5": 40,
                    "cumulative_variance": cumulative,
                    "mode_shapes": "experiment2/modes.npz",
                    "fit": write_fit(root, "experiment2", "stranger", "neutral", 0.0),
                }
            ]
        },
    }
    (root / "demo.json").write_text(json.dumps(demo))
    return demo


@pytest.fixture
def head() -> Callable[..., Mesh]:
    return make_head


@pytest.fixture(scope="session")
def demo_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("demo")
    write_demo(root)
    return root
