import json

import numpy as np
import pytest

from shapespace.batch.fit_records import read_record
from shapespace.demo import DemoScale, run_demo
from shapespace.model.shape_model import ShapeModel


@pytest.fixture(scope="module")
def demo(tmp_path_factory, monkeypatch_module):
    pytest.importorskip("matplotlib", reason="the extra `report` is not installed")
    folder = tmp_path_factory.mktemp("demo")
    monkeypatch_module.setenv("SHAPESPACE_CACHE", str(folder / "no cache"))
    monkeypatch_module.delenv("SHAPESPACE_DATA", raising=False)
    scale = DemoScale(training=40, triangles=16_000, stop_motion_mm=0.02)
    return run_demo(folder, quick=True, quiet=True, scale=scale).parent


@pytest.fixture(scope="module")
def monkeypatch_module():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def summary(demo):
    return json.loads((demo / "demo.json").read_text())


def test_the_demo_ends_in_one_self_contained_report(demo):
    page = (demo / "report.html").read_text()
    assert "<html" in page
    assert len(page) < 8_000_000
    assert 'src="http' not in page
    assert "simulated" in page.lower()


def test_sixteen_unseen_faces_and_neutral_are_fitted(summary):
    fits = summary["experiment1"]["fits"]
    assert len(fits) == 17
    assert {fit["expression"] for fit in fits} == {"neutral", "anger", "disgust", "fear", "smile"}
    assert all(fit["status"] == "converged" for fit in fits)


def test_a_handful_of_modes_holds_the_papers_share(summary):
    assert 4 <= summary["experiment1"]["modes_for_98_5"] <= 7


def test_coarse_scans_are_fitted_to_a_millimetre_of_the_truth(summary):
    for fit in summary["experiment1"]["fits"]:
        assert fit["floor_mm"]["mean"] <= fit["vertex_error_mm"]["mean"] < 1.0, fit["name"]


def test_expressions_lie_on_lines_and_apart(summary):
    scores = summary["experiment1"]["scores"]
    assert min(scores["line_r2_through_neutral"].values()) > 0.8
    assert scores["disjointness"]["leave_one_out_accuracy"] == 1.0


def test_every_claim_of_the_paper_has_a_measured_row(summary):
    rows = summary["paper_table"]
    assert len(rows) >= 5
    assert all(row["paper"] and row["measured"] for row in rows)


def test_without_downloads_the_only_scan_is_a_labelled_simulation(summary):
    cases = summary["experiment2"]["cases"]
    assert [case["simulated"] for case in cases] == [True]
    assert "imulated" in cases[0]["title"]


def test_the_robust_fit_is_shown_beside_the_papers_and_is_nearer_to_the_truth(demo, summary):
    (case,) = summary["experiment2"]["cases"]
    paper, robust = (case[method]["vertex_error_mm"]["mean"] for method in ("fit", "robust"))
    floor = case["fit"]["floor_mm"]["mean"]
    assert floor <= robust and robust - floor < 0.5 * (paper - floor)
    page = (demo / "report.html").read_text()
    assert f"mean true vertex error {paper:.2f} mm by the method of the paper, {robust:.2f} mm by the robust" in page


def test_the_saved_files_agree_with_each_other(demo, summary):
    first = summary["experiment1"]
    model = ShapeModel.load(demo / first["model"])
    assert model.content_hash == first["model_hash"]
    record = read_record(demo / first["fits"][1]["json"])
    assert record["model"]["hash"] == model.content_hash
    assert len(record["b"]) == model.n_modes
    with np.load(demo / first["fits"][1]["stages"], allow_pickle=False) as stages:
        assert stages["final"].shape == (model.n_vertices, 3)
