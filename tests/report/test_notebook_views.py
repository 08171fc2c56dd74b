"""What prompts and notebooks show of results: one short line, one escaped page, and each figure once."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

import shapespace as ss
from identity_people import cohort as people_cohort
from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.fit.diagnostics.reasons import Reason
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.analyses.result_report import analysis_report
from shapespace.report.figures import spectrum_figure
from shapespace.statistics.predictor import Predictions
from symmetric_object import symmetric_object
from synthetic_shapes import blob_model, training_meshes

EVIL = "<img src=x onerror=alert(1)>"
LONGEST_REPR = 500


def shapes(n: int = 24, gauge: Literal["shape", "form"] = "shape") -> Cohort:
    thing, rng = symmetric_object(), np.random.default_rng(3)
    age = np.linspace(20, 60, n)
    fields = thing.smooth(rng, n) + 0.05 * (age - 40)[:, None, None] * thing.smooth(rng, 1)
    columns = {
        "subject": [f"{EVIL}{k // 2}" for k in range(n)],
        "visit": [("one", "two")[k % 2] for k in range(n)],
        "age": age.tolist(),
        "sex": [("f", EVIL)[k // 2 % 2] for k in range(n)],
    }
    names = [f"{EVIL} {k}" for k in range(n)]
    return Cohort.of_shapes(thing.x + fields, columns, names=names, faces=thing.faces, gauge=gauge)


@pytest.fixture(scope="module")
def results() -> dict[str, object]:
    pytest.importorskip("formulaic", reason="the extra `statistics` is not installed")
    cohort, people, thing = shapes(), people_cohort(10, 3), symmetric_object()
    identity = ss.statistics.IdentityConfig(folds=2, draws=20)
    regression = ss.statistics.regress(cohort, "age", subject="subject", folds=3, permutations=3, draws=20)
    return {
        "cohort": cohort,
        "comparison": ss.statistics.compare(
            cohort, "age + sex", ss.statistics.CompareConfig(permutations=20, maps=False)
        ),
        "change": ss.statistics.change(
            shapes(gauge="form"), ss.statistics.ChangeConfig(time="visit", order=("one", "two"), permutations=20)
        ),
        "asymmetry": ss.statistics.measure_asymmetry(cohort, subject="subject", pairs=thing.pairs, permutations=19),
        "regression": regression,
        "predictor": regression.predictor,
        "predictions": Predictions((EVIL,), np.ones(1), np.zeros(1), np.ones(1), ("",)),
        "scores": ss.statistics.score(cohort, shapes(4), ss.statistics.ScoreConfig(modes=3, draws=2)),
        "verification": ss.statistics.verify(people, identity),
        "identification": ss.statistics.identify(people, identity),
        "model": blob_model(60),
    }


KINDS = (
    "cohort",
    "comparison",
    "change",
    "asymmetry",
    "regression",
    "predictor",
    "predictions",
    "scores",
    "verification",
    "identification",
    "model",
)


@pytest.mark.parametrize("kind", KINDS)
def test_a_result_is_one_short_line_at_a_prompt_and_so_are_its_parts(results: dict[str, object], kind: str) -> None:
    result = results[kind]
    parts = [getattr(result, field.name) for field in dataclasses.fields(result)]  # type: ignore[arg-type]
    items = [item for part in parts if isinstance(part, tuple) for item in part[:2] if dataclasses.is_dataclass(item)]
    for shown in (result, *(part for part in parts if dataclasses.is_dataclass(part)), *items):
        line = repr(shown)
        assert len(line) < 2 * LONGEST_REPR and "array(" not in line and "\n" not in line, line
    assert len(repr(result)) < LONGEST_REPR


@pytest.mark.parametrize("kind", KINDS)
def test_a_notebook_shows_a_result_as_a_page_in_which_everything_is_text(results: dict[str, object], kind: str) -> None:
    page = results[kind]._repr_html_()  # type: ignore[attr-defined]
    assert page.startswith("<div") and "<img src=x" not in page and "array(" not in page
    assert len(page) < 200_000


@pytest.mark.parametrize("kind", ["comparison", "change", "asymmetry", "regression", "scores", "verification"])
def test_the_page_of_an_analysis_says_what_its_report_says_first(results: dict[str, object], kind: str) -> None:
    from html import escape

    answer, page = analysis_report(results[kind]), results[kind]._repr_html_()  # type: ignore[attr-defined]
    assert escape(answer.summary[0], quote=False) in page.replace("&#39;", "'").replace("&#34;", '"')
    assert "<table" in page


def test_scans_in_correspondence_and_results_in_a_folder_are_shown(tmp_path: Path) -> None:
    meshes = list(training_meshes(vertices=150)[:3])
    result = ss.fit_scan(blob_model(150), meshes[0], ss.FitConfig(method="paper", max_iterations=2))
    dataclasses.replace(result, reasons=(Reason.other(EVIL),)).save(tmp_path, "one")
    results = ss.store.Results(tmp_path)
    assert len(repr(results)) < LONGEST_REPR
    assert "<img src=x" not in results._repr_html_() and "&lt;img src=x" in results._repr_html_()
    config = ss.CorrespondConfig(vertices=120, rounds=1, mirror="never")
    found = ss.correspond(meshes, config)
    assert len(repr(found)) < LONGEST_REPR and "in correspondence" in found._repr_html_()


def test_a_figure_shows_itself_once_in_a_notebook_without_pyplot() -> None:
    figure = spectrum_figure(blob_model(60))
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]
    from matplotlib import _pylab_helpers

    # What pyplot keeps it would show a second time.
    assert figure not in [manager.canvas.figure for manager in _pylab_helpers.Gcf.get_all_fig_managers()]


def test_paths_may_be_text_and_shapes_may_be_arrays_or_files(tmp_path: Path) -> None:
    meshes = list(training_meshes(vertices=100)[:4])
    for k, mesh in enumerate(meshes):
        write_mesh(tmp_path / f"m{k}.ply", mesh)
    (tmp_path / "table.csv").write_text("file,group\n" + "".join(f"m{k}.ply,a\n" for k in range(4)))
    cohort = ss.read_cohort(str(tmp_path / "table.csv"), ss.CohortConfig(shapes=str(tmp_path)))
    assert len(cohort) == 4
    of_files = ss.ShapeModel.fit([str(tmp_path / f"m{k}.ply") for k in range(4)])
    of_arrays = ss.ShapeModel.fit(np.stack([mesh.vertices for mesh in meshes]))
    whole = ss.ShapeModel.fit(meshes)
    assert np.allclose(of_arrays.stddev, whole.stddev) and np.allclose(of_files.stddev, whole.stddev)
    assert of_arrays.faces is None


@pytest.mark.parametrize(
    "call",
    [
        lambda: ss.CohortConfig(shapes=3),  # type: ignore[arg-type]
        lambda: ss.CohortConfig(gauge="size"),  # type: ignore[arg-type]
        lambda: ss.CohortConfig(surfaces="raw"),  # type: ignore[arg-type]
        lambda: ss.ShapeModel.fit("meshes"),  # type: ignore[arg-type]
        lambda: ss.ShapeModel.fit([None, None]),
        lambda: ss.ShapeModel.fit(np.zeros((10, 3))),
        lambda: ss.model.measure_quality("meshes"),  # type: ignore[arg-type]
        lambda: ss.correspond("scans"),  # type: ignore[arg-type]
        lambda: ss.surface_distances(np.zeros((9, 3)), np.zeros((9, 3))),  # type: ignore[arg-type]
        lambda: ss.write_mesh("out.ply", np.zeros((9, 3))),  # type: ignore[arg-type]
        lambda: ss.simulate_scan(np.zeros((9, 3)), np.random.default_rng(0)),  # type: ignore[arg-type]
        lambda: ss.geometry.surface_of_volume(np.zeros((3, 3, 3))),  # type: ignore[arg-type]
        lambda: ss.statistics.compare("out", "age"),  # type: ignore[arg-type]
        lambda: ss.statistics.change("out"),  # type: ignore[arg-type]
        lambda: ss.statistics.measure_asymmetry("out"),  # type: ignore[arg-type]
        lambda: ss.statistics.regress("out", "age"),  # type: ignore[arg-type]
        lambda: ss.statistics.score("out", "out"),  # type: ignore[arg-type]
        lambda: ss.statistics.verify("out"),  # type: ignore[arg-type]
        lambda: ss.statistics.identify("out"),  # type: ignore[arg-type]
        lambda: ss.train_classifier("out"),  # type: ignore[arg-type]
    ],
)
def test_arguments_of_another_kind_are_refused_in_a_sentence(call) -> None:
    with pytest.raises(InputError, match=r"^\S.*\.$"):
        call()
