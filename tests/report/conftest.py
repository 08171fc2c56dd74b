"""Folders as `shapespace fit` and the demo write them, on blobs of a few hundred vertices; each is made once."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_page import edit

from shapespace.batch.executors import Serial
from shapespace.batch.run import BatchConfig, FolderSink, fit_many, make_jobs
from shapespace.fit.fit_scan import FitConfig
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import write_rows
from shapespace.types import Mesh
from synthetic_shapes import blob_model, raw_scan, training_meshes

VERTICES, MODES = 300, 4
EVIL = "</script><script>alert(1)</script>"


def make_head(n: int = 14) -> Mesh:
    u, v = np.meshgrid(np.linspace(0.02, np.pi - 0.02, n), np.linspace(0, 2 * np.pi, 2 * n), indexing="ij")
    points = np.stack([60 * np.sin(u) * np.sin(v), 90 * np.cos(u), 70 * np.sin(u) * np.cos(v)], axis=-1).reshape(-1, 3)
    i = np.arange(n * 2 * n).reshape(n, 2 * n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    return Mesh(points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), name="head")


def write_fits(home: Path, names: Sequence[str], *, stages: bool = True, sub: str = "fits", **settings: Any) -> None:
    """Write a model, scans and their fits below `home`."""
    model = blob_model(VERTICES, MODES)
    (home / "scans").mkdir(parents=True, exist_ok=True)
    if not (home / "model.h5").exists():
        model.save(home / "model.h5")
    for k, name in enumerate(names):
        z = np.random.default_rng(k).normal(0, 0.6, MODES + 1)
        write_mesh(home / "scans" / f"{name}.ply", raw_scan(z, seed=k, vertices=500).scan)
    scans = [home / "scans" / f"{name}.ply" for name in names]
    config = FitConfig(**{"method": "paper", "max_iterations": 4, **settings})
    batch = BatchConfig(model, home / "model.h5", config, stages=stages)
    fit_many(make_jobs(scans), batch, Serial(), FolderSink(home / sub))


def write_demo(root: Path) -> dict[str, Any]:
    """Write a small demo folder; its fits are too short to converge, so their records are made to say so."""
    expressions = [("neutral", 0.0), *((name, level) for name in ("anger", "smile") for level in (0.5, 1.0))]
    first = ["neutral" if not level else f"{name}_{round(100 * level):03}" for name, level in expressions]
    entries: dict[str, dict[str, Any]] = {}
    for part, names, labels in (
        ("experiment1", first, expressions),
        ("experiment2", ["stranger"], [("neutral", 0.0)]),
    ):
        write_fits(root / part, names)
        for name, (expression, level) in zip(names, labels, strict=True):
            base = f"{part}/fits/{name}"
            record = json.loads((root / f"{base}.fit.json").read_text())
            record.update(status="converged", reason="The RMS closest distance stood still at 1.00 mm.")
            (root / f"{base}.fit.json").write_text(json.dumps(record))
            entries[name] = {
                "name": name,
                "expression": expression,
                "intensity": level,
                "scan": f"{part}/scans/{name}.ply",
                "json": f"{base}.fit.json",
                "stages": f"{base}.stages.npz",
                "vertex_error_mm": {"mean": 0.51, "rms": 0.6, "max": 2.0},
                "floor_mm": {"mean": 0.21, "rms": 0.3, "max": 1.0},
            }
    training = root / "experiment1" / "training"
    training.mkdir()
    examples = []
    for k, mesh in enumerate(training_meshes(vertices=VERTICES)[:4]):
        write_mesh(training / f"{k:03}.ply", mesh)
        examples.append({"file": f"experiment1/training/{k:03}.ply", "label": f"training {k}"})
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
            "model": "experiment1/model.h5",
            "n_training": 100,
            "modes_for_98_5": 4,
            "training_examples": examples,
            "population_z": np.random.default_rng(0).normal(0, 1, (20, MODES)).tolist(),
            "fits": [entries[name] for name in first],
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
                    "short": "stranger",
                    "simulated": True,
                    "note": "It has hair.",
                    "model": "experiment2/model.h5",
                    "n_training": 100,
                    "modes_for_98_5": 40,
                    "fit": entries["stranger"],
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


@pytest.fixture(scope="session")
def fits_template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans with labels, one of them a script; six fits in out/: two converged, one doubtful, one failed."""
    root = tmp_path_factory.mktemp("fits")
    write_fits(root, ["able", "baker", "charlie", "dog", "easy"], sub="out")
    (root / "scans" / "broken.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 9\n")
    batch = BatchConfig(blob_model(VERTICES, MODES), root / "model.h5", FitConfig(method="paper"), stages=True)
    fit_many(make_jobs([root / "scans" / "broken.ply"]), batch, Serial(), FolderSink(root / "out"))
    for name, status in (("able", "converged"), ("baker", "converged"), ("charlie", "doubtful")):
        edit(root / "out", lambda record, status=status: record.update(status=status), f"{name}.fit.json")
    rows = [("able.ply", "calm", "0.5"), ("baker.ply", EVIL, "1"), ("charlie.ply", "calm", "1"), ("dog.ply", EVIL, "")]
    write_rows(root / "scans" / "labels.csv", ("file", "expression", "intensity"), rows)
    return root


@pytest.fixture
def sketched(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the drawing out, for tests of what stands around the pictures."""
    from matplotlib.figure import Figure

    from shapespace.report import figures

    for name in figures.__all__:
        if name.endswith(
            ("_figure", "_grid", "_maps", "_matrix", "_3d", "_curves", "_histograms", "_spread")
        ) or name in (
            "b_plane",
            "b_space",
            "gallery",
        ):
            monkeypatch.setattr(figures, name, lambda *_, **__: Figure(figsize=(1, 1), dpi=20))


@pytest.fixture
def worded(sketched: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the stills of the cards out too, for tests of words that neither damage surfaces nor count bytes."""
    from shapespace.report.render import thumbnails

    strip = thumbnails.encoded(np.full((10, 30, 3), 255, dtype=np.uint8))
    monkeypatch.setattr(thumbnails, "fit_strip", lambda *_: strip)
    monkeypatch.setattr(thumbnails, "correspondence_strip", lambda *_: strip)


@pytest.fixture
def fits(fits_template: Path, tmp_path: Path) -> Path:
    """A copy of the folder of fits that may be damaged."""
    shutil.copytree(fits_template, tmp_path / "work")
    return tmp_path / "work" / "out"
