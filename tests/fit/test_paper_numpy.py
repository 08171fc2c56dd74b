"""The paper's method is, match for match, the one that plain NumPy and SciPy give."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from shapespace.fit.method import Limits
from shapespace.fit.paper.paper_method import Paper
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.types import Similarity
from synthetic_shapes import blob_model, raw_scan, similarity

PLAIN = Path(__file__).resolve().parents[2] / "benchmarks" / "peers" / "paper_numpy.py"


@pytest.fixture(scope="module")
def plain() -> ModuleType:
    spec = importlib.util.spec_from_file_location("paper_numpy", PLAIN)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("seed", range(3))
def test_both_take_the_same_steps_to_the_same_coefficients(plain: ModuleType, seed: int) -> None:
    model = blob_model(vertices=1500)
    z = np.random.default_rng(seed).uniform(-1.2, 1.2, 5)
    raw = raw_scan(z, similarity(seed, 12.0, 1.1), vertices=5000, model_vertices=1500, noise_mm=0.2)
    start = Similarity(1.0, np.eye(3), raw.scan.vertices.mean(axis=0) - model.mean_vertices.mean(axis=0))
    limits = Limits(with_scale=True, modes=None, max_iterations=200)
    states = list(Paper().states(model, ScanTarget(raw.scan), Start(start, "given", np.nan), limits))
    scale, R, T, b, iterations = plain.fit(
        model.mean_vertices, model.basis, raw.scan.vertices, 1.0, np.eye(3), start.translation, max_iterations=200
    )
    ours = tuple(max(s.iteration for s in states if s.phase == phase) for phase in (1, 2))
    assert ours == iterations
    final = states[-1]
    assert np.abs(final.b - b).max() < 1e-9
    assert final.T_scan_model.scale == pytest.approx(scale, rel=1e-12)
    assert np.abs(final.T_scan_model.rotation - R).max() < 1e-12
    assert np.abs(final.T_scan_model.translation - T).max() < 1e-9
