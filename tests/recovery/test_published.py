"""Three frozen cases on the bundled faces, held to what docs/benchmarks.md publishes of them."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from shapespace.datasets.faces import load_faces
from shapespace.datasets.simulated_scan import Cut, Hole, random_similarity, simulate_scan
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.robust_method import Robust
from shapespace.model.model_quality import floor_mm
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh

Measured: TypeAlias = tuple[FloatArray, FloatArray, list[str]]
BENCHMARKS = Path(__file__).parents[2] / "docs" / "benchmarks.md"
SCANS, PEOPLE, FEW_PEOPLE, TOLERANCE = 2, 40, 15, 1.05
TRIANGLES, NOISE_MM = 15_000, 0.2
CUT = Cut((40.0, 0.0, 0.0), (1.0, 0.2, 0.1))


@dataclass(frozen=True)
class Case:
    """One row of the table: how the scan is damaged, and whether its person is in the span of the model."""

    in_span: bool
    damage: dict[str, object]


CASES = {
    "complete": Case(True, {}),
    "side cut, 15 mm hole, 10 % outliers": Case(
        True, {"crop": (CUT,), "holes": (Hole(15.0),), "outlier_fraction": 0.1}
    ),
    "outside the span": Case(False, {}),
}


def published() -> dict[str, tuple[float, float]]:
    """Return case -> (error, floor), mm, from the document."""
    section = BENCHMARKS.read_text("utf-8").split("### Figures the tests hold")[1].split("\n#")[0]
    rows = re.findall(r"^\| ([^|]+) \| (\d+\.\d+) \| (\d+\.\d+) \|", section, re.MULTILINE)
    return {name.strip(): (float(error), float(floor)) for name, error, floor in rows}


@pytest.fixture(scope="module")
def people() -> list[Mesh]:
    faces, rng = load_faces(), np.random.default_rng(2026)
    return [faces.face(faces.draw_person(rng)) for _ in range(PEOPLE + SCANS)]


@pytest.fixture(scope="module")
def models(people: list[Mesh]) -> dict[bool, ShapeModel]:
    """Models by whether their scans are in their span: the generator's people stand in one frame."""
    return {
        in_span: ShapeModel.fit(people[:count], align=False) for in_span, count in ((True, PEOPLE), (False, FEW_PEOPLE))
    }


def measured(
    case: Case, models: dict[bool, ShapeModel], people: list[Mesh], method: Robust | str = "robust"
) -> Measured:
    """Return error and floor, mm of the model's frame, and the status of each scan of `case`."""
    model, errors, floors, statuses = models[case.in_span], [], [], []
    for index in range(SCANS):
        rng = np.random.default_rng(index)
        truth = (
            model.mesh(0.8 * model.stddev * rng.standard_normal(model.n_modes)) if case.in_span else people[-1 - index]
        )
        raw = simulate_scan(
            truth, rng, T_scan_model=random_similarity(rng, 15.0, (1.1, 1.1)), triangles=TRIANGLES,
            noise_mm=NOISE_MM, **case.damage,
        )  # fmt: skip
        result = fit_scan(model, raw.scan, FitConfig(method=method))
        apart = np.linalg.norm(result.surface(model).vertices - raw.truth_vertices, axis=1)
        errors.append(apart.mean() / raw.T_scan_model.scale)
        floors.append(floor_mm(model, truth.vertices))
        statuses.append(result.status)
    return np.array(errors), np.array(floors), statuses


@pytest.fixture(scope="module")
def measure(models: dict[bool, ShapeModel], people: list[Mesh]) -> Callable[[str], Measured]:
    return cache(lambda name: measured(CASES[name], models, people))


@pytest.mark.parametrize("name", CASES)
def test_each_case_is_as_good_as_published(name: str, measure: Callable[[str], Measured]) -> None:
    error_mm, floor = published()[name]
    errors, floors, statuses = measure(name)
    assert statuses == ["converged"] * SCANS
    assert floors.mean() == pytest.approx(floor, rel=0.02, abs=1e-3), "the case is another one than was published"
    assert errors.mean() <= TOLERANCE * error_mm


def test_without_the_modes_beside_the_model_a_stranger_is_missed(
    measure: Callable[[str], Measured], models: dict[bool, ShapeModel], people: list[Mesh]
) -> None:
    with_them, floors, _ = measure("outside the span")
    without, _, _ = measured(CASES["outside the span"], models, people, Robust(beyond_share=1e9))
    # Of what a fit loses beyond what no fit with this model could reach, they win back most.
    assert (with_them - floors).mean() < 0.5 * (without - floors).mean()
