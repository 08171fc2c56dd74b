"""Meshes, tables and pictures for other tools and from them: real ones where installed, else what looks like them."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html import escape
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_validate
from sklearn.pipeline import Pipeline

import shapespace as ss
from shapespace import cli
from shapespace.fit.diagnostics.reasons import Reason
from shapespace.lazy import require_package
from synthetic_shapes import blob_model, raw_scan, training_meshes

ROOT = Path(__file__).resolve().parents[2]
TOOLS = ("trimesh", "pyvista", "open3d", "meshio", "menpo")


@pytest.fixture(scope="module")
def mesh() -> ss.Mesh:
    return training_meshes(vertices=200)[0]


@pytest.fixture(scope="module")
def result() -> ss.FitResult:
    return ss.fit_scan(blob_model(), raw_scan(np.array([1.0, -1.0, 0.5, 0.0, 0.3]), vertices=900, noise_mm=0.2).scan)


@pytest.fixture(scope="module")
def folder(result: ss.FitResult, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("fits")
    result.save(out, "anna", stages=True)
    result.save(out, "zoë smile")
    bad = tmp_path_factory.mktemp("bad") / "bad.ply"
    bad.write_text("nothing")
    blob_model().save(out.parent / "model.h5")
    assert cli.main(["fit", str(out.parent / "model.h5"), str(bad), "-o", str(out), "--quiet"]) == 2
    return out


def same(a: ss.Mesh, b: ss.Mesh) -> bool:
    faces = a.faces is b.faces if a.faces is None else np.array_equal(a.faces, b.faces)  # type: ignore[arg-type]
    return bool(np.array_equal(a.vertices, b.vertices) and faces)


def coloured(mesh: ss.Mesh) -> ss.Mesh:
    at = np.arange(len(mesh.vertices))
    return replace(mesh, colours=np.stack([at % 256, at * 7 % 256, 255 - at % 256], axis=1).astype(np.uint8))


@pytest.mark.parametrize("tool", TOOLS)
def test_colours_go_to_another_tool_and_back(mesh: ss.Mesh, tool: str) -> None:
    pytest.importorskip(tool)
    if tool == "menpo":
        pytest.skip("menpo's own meshes have no colours")
    for there in (coloured(mesh), replace(coloured(mesh), faces=None)):
        assert np.array_equal(ss.as_mesh(getattr(there, f"to_{tool}")()).colours, there.colours)  # type: ignore[arg-type]


def test_colours_are_taken_as_each_tool_keeps_them_or_not_at_all(mesh: ss.Mesh) -> None:
    shares = np.linspace(0.0, 1.0, 600).reshape(200, 3)
    bytes_ = np.rint(255 * shares).astype(np.uint8)
    known = {"points": mesh.vertices, "n_points": 200, "trilist": mesh.faces}
    solid = {"vertices": mesh.vertices, "triangles": mesh.faces}
    for there in (
        SimpleNamespace(**known, colours=shares), SimpleNamespace(**solid, vertex_colors=shares),
        SimpleNamespace(**solid, vertex_colors=np.column_stack([bytes_, np.full(200, 255, np.uint8)])),
        SimpleNamespace(points=mesh.vertices, n_points=200, point_data={"RGB": bytes_}),
    ):  # fmt: skip
        assert np.array_equal(ss.as_mesh(there).colours, bytes_)  # type: ignore[arg-type]
    for there in (
        SimpleNamespace(**solid, vertex_colors=shares[:5]), SimpleNamespace(**solid, vertex_colors=np.zeros((0, 3))),
        SimpleNamespace(**known, colours=shares * np.nan), SimpleNamespace(**known, point_data={"red": bytes_[:, 0]}),
    ):  # fmt: skip
        assert ss.as_mesh(there).colours is None


@pytest.mark.parametrize("tool", TOOLS)
def test_a_mesh_goes_to_another_tool_and_back_as_it_was(mesh: ss.Mesh, tool: str) -> None:
    pytest.importorskip(tool)
    for there in (mesh, ss.Mesh(mesh.vertices)):
        assert same(ss.as_mesh(getattr(there, f"to_{tool}")()), there)


@pytest.mark.parametrize("tool", TOOLS)
def test_a_tool_that_is_absent_is_one_sentence_with_the_command(
    mesh: ss.Mesh, tool: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # What None stands for in sys.modules cannot be imported.
    monkeypatch.setitem(sys.modules, tool, None)
    with pytest.raises(ss.ShapespaceError, match=rf"needs {tool}, .*(install|loaded)"):
        getattr(mesh, f"to_{tool}")()


def test_the_sentence_on_an_absent_package_names_the_command() -> None:
    with pytest.raises(ss.ShapespaceError, match=r"^Knitting needs no_such_wool, .*; run pip install wool\.$"):
        require_package("no_such_wool", "Knitting", "wool")


def like_other_tools(mesh: ss.Mesh) -> dict[str, Any]:
    """Return objects with the attributes that those of the tools have."""
    assert mesh.faces is not None
    padded = np.insert(mesh.faces, 0, 3, axis=1).ravel()
    legacy = SimpleNamespace(vertices=mesh.vertices, triangles=mesh.faces)
    trimesh = SimpleNamespace(vertices=mesh.vertices, faces=mesh.faces, metadata={"file_name": "anna.obj"})
    polygons = SimpleNamespace(
        points=mesh.vertices, n_points=200, faces=np.array([4, 0, 1, 2, 3]), is_all_triangles=False,
        triangulate=lambda: SimpleNamespace(points=mesh.vertices, faces=padded, is_all_triangles=True),
    )  # fmt: skip
    return {
        "pair": (mesh.vertices, mesh.faces),
        "trimesh": trimesh,
        "scene": SimpleNamespace(geometry={}, to_mesh=lambda: trimesh),
        "pyvista": SimpleNamespace(points=mesh.vertices, n_points=200, faces=padded, is_all_triangles=True),
        "pyvista polygons": polygons,
        "open3d": legacy,
        "open3d tensors": SimpleNamespace(vertex=None, triangle=None, to_legacy=lambda: legacy),
        "meshio": SimpleNamespace(points=mesh.vertices, cells=[], cells_dict={"triangle": mesh.faces}),
        "menpo": SimpleNamespace(points=mesh.vertices, n_points=200, trilist=mesh.faces, path=Path("anna.obj")),
    }


def test_what_looks_like_a_mesh_of_another_tool_is_one(mesh: ss.Mesh) -> None:
    for tool, there in like_other_tools(mesh).items():
        assert same(ss.as_mesh(there), mesh), tool


def test_clouds_of_points_have_no_triangles(mesh: ss.Mesh) -> None:
    points = mesh.vertices
    for cloud in (
        points, SimpleNamespace(points=points), SimpleNamespace(vertices=points),
        SimpleNamespace(points=points, n_points=200), SimpleNamespace(points=points, n_points=200, faces=np.array([])),
        SimpleNamespace(points=points, cells=[], cells_dict={}),
    ):  # fmt: skip
        assert same(ss.as_mesh(cloud), ss.Mesh(points))


def test_names_come_from_files_and_arguments(mesh: ss.Mesh) -> None:
    there = like_other_tools(mesh)
    assert [ss.as_mesh(there[tool]).name for tool in ("trimesh", "menpo", "open3d")] == ["anna.obj", "anna.obj", "mesh"]
    assert ss.as_mesh(there["trimesh"], "ben").name == "ben"


def test_quads_of_meshio_are_two_triangles_each(mesh: ss.Mesh) -> None:
    cells = {"quad": np.array([[0, 1, 2, 3]]), "line": np.array([[0, 1]])}
    found = ss.as_mesh(SimpleNamespace(points=mesh.vertices, cells=[], cells_dict=cells))
    np.testing.assert_array_equal(found.faces, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("there", "says"),
    [
        (3, r"builtins\.int is not a mesh"),
        ({"vertices": 1}, r"builtins\.dict is not a mesh"),
        (np.zeros((4, 2)), r"shape \(V, 3\)"),
        (np.array([["a", "b", "c"]]), "not numbers"),
        (SimpleNamespace(points=np.zeros((4, 3)), n_points=4, extract_surface=None), "extract_surface"),
        (SimpleNamespace(points=np.zeros((4, 3)), cells=[], cells_dict={"tetra": [[0, 1, 2, 3]]}), "type tetra"),
        ((np.zeros((4, 3)), np.array([[0, 1, 9]])), "points at vertex 9"),
    ],
)
def test_what_is_no_surface_is_refused_in_one_sentence(there: Any, says: str) -> None:
    with pytest.raises(ss.ShapespaceError, match=says):
        ss.as_mesh(there)


def test_a_scan_of_another_tool_is_fitted_as_ours(result: ss.FitResult) -> None:
    scan = raw_scan(np.array([1.0, -1.0, 0.5, 0.0, 0.3]), vertices=900, noise_mm=0.2).scan
    theirs = SimpleNamespace(vertices=scan.vertices, faces=scan.faces)
    np.testing.assert_array_equal(ss.fit_scan(blob_model(), theirs).b, result.b)


# Tables


def test_a_data_frame_has_the_rows_and_columns_of_the_table(folder: Path, result: ss.FitResult) -> None:
    pytest.importorskip("pandas")
    results = ss.store.Results(folder)
    frame = results.to_dataframe()
    assert list(frame.index) == ["anna", "bad", "zoë smile"]
    np.testing.assert_array_equal(frame.loc["anna", [f"z{k}" for k in range(1, 6)]].to_numpy(float), result.z)
    assert frame.loc["bad", "status"] == "failed" and np.isnan(frame.loc["bad", "z1"])
    header = (folder / "coefficients.csv").read_text("utf-8").splitlines()[0].split(",")
    assert ["scan", *frame.columns] == [column for column in header if column != "checksum"]
    assert list(results.to_dataframe(["z2", "seconds"]).columns) == ["z2", "seconds"]
    with pytest.raises(ss.ShapespaceError, match="has a column 'z9'"):
        results.to_dataframe(["z9"])


def test_xarray_has_coefficients_by_scan_and_mode(folder: Path, result: ss.FitResult) -> None:
    pytest.importorskip("xarray")
    data = ss.store.Results(folder).to_xarray()
    np.testing.assert_array_equal(data["z"].sel(scan="anna"), result.z)
    assert data["b_stddev"].shape == (3, 5) and "z1" not in data


def test_matlab_reads_the_table_by_the_rules_of_its_names(folder: Path, result: ss.FitResult, tmp_path: Path) -> None:
    loadmat = pytest.importorskip("scipy.io").loadmat
    files = [tmp_path / "one.mat", tmp_path / "two.mat"]
    for file in files:
        assert cli.main(["export", str(folder), "--table", str(file), "--quiet"]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    fits = loadmat(files[0], simplify_cells=True)["fits"]
    assert list(fits["scan"]) == ["anna", "bad", "zoë smile"]
    np.testing.assert_array_equal(fits["b"][0], result.b)
    assert fits["z"].shape == (3, 5) and np.isnan(fits["z"][1]).all()
    assert all(re.fullmatch(r"[A-Za-z]\w{0,62}", name) for name in fits)


@pytest.mark.skipif(shutil.which("Rscript") is None, reason="R is not installed: apt-get install r-base-core")
def test_r_reads_coefficients_by_the_snippet_of_the_document(
    folder: Path, result: ss.FitResult, tmp_path: Path
) -> None:
    [snippet] = re.findall(r"^```r\n(.*?)^```", (ROOT / "docs" / "interop.md").read_text("utf-8"), re.DOTALL | re.M)
    (tmp_path / "out").symlink_to(folder)
    script = tmp_path / "read.R"
    script.write_text(snippet + '\nwrite.csv(z, "z.csv")\nstopifnot(is.na(fits[fits$scan == "bad", "z1"]))\n', "utf-8")
    told = subprocess.run(["Rscript", "--vanilla", script], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stderr
    table = np.genfromtxt(tmp_path / "z.csv", delimiter=",", skip_header=1, usecols=range(1, 6), encoding="utf-8")
    np.testing.assert_allclose(table, [result.z, result.z], rtol=1e-14)


# scikit-learn


@pytest.fixture(scope="module")
def labelled() -> tuple[list[ss.Mesh], np.ndarray, np.ndarray]:
    return list(training_meshes(12, vertices=200)), np.arange(12) % 2, np.repeat(np.arange(6), 2)


def test_a_shape_space_works_where_transformers_of_scikit_learn_do(
    labelled: tuple[list[ss.Mesh], np.ndarray, np.ndarray],
) -> None:
    pytest.importorskip("pandas")
    meshes, y, people = labelled
    frame = ss.ShapeSpace(modes=3).set_output(transform="pandas").fit_transform(meshes)
    assert list(frame.columns) == ["z1", "z2", "z3"] and len(frame) == 12
    pipeline = Pipeline([("shape", ss.ShapeSpace(modes=3)), ("classify", LogisticRegression())])
    assert len(cross_validate(pipeline, meshes, y, groups=people, cv=GroupKFold(3))["test_score"]) == 3
    search = GridSearchCV(pipeline, {"shape__modes": [1, 0.9]}, cv=GroupKFold(2)).fit(meshes, y, groups=people)
    assert search.best_params_["shape__modes"] in (1, 0.9)
    assert search.best_estimator_[:-1].get_feature_names_out()[0] == "z1"


def test_a_fitted_pipeline_is_kept_by_skops_and_names_what_it_trusts(
    labelled: tuple[list[ss.Mesh], np.ndarray, np.ndarray],
) -> None:
    sio = pytest.importorskip("skops.io")
    meshes, y, _ = labelled
    pipeline = Pipeline([("shape", ss.ShapeSpace(modes=3)), ("classify", LogisticRegression())]).fit(meshes, y)
    content = sio.dumps(pipeline)
    ours = ["shapespace.model.shape_model.ShapeModel", "shapespace.recognise.predict.ShapeSpace"]
    assert sorted(sio.get_untrusted_types(data=content)) == ours
    again = sio.loads(content, trusted=ours)
    np.testing.assert_array_equal(again.predict_proba(meshes), pipeline.predict_proba(meshes))
    assert again[0].model_.content_hash == pipeline[0].model_.content_hash
    assert not again[0].model_.mean.flags.writeable


# Notebooks


def test_notebooks_show_a_picture_the_numbers_and_the_verdict(result: ss.FitResult) -> None:
    page = result._repr_html_()
    assert (
        escape(result.reason).replace("&#x27;", "&#39;") in page
        and "data:image/webp;base64," in page
        and "Scan to model" in page
    )
    assert len(page) < 120_000
    quality = ss.model.measure_quality(list(training_meshes()[:6]), config=ss.model.QualityConfig(folds=2, samples=2))
    assert "Generalisation" in quality._repr_html_() and quality.sentences()[0] in quality._repr_html_()


def test_nothing_that_a_file_holds_gets_into_a_page_unescaped(result: ss.FitResult) -> None:
    evil = "<img src=x onerror=alert(1)>"
    fit = replace(result, scan_name=evil, reasons=(Reason.other(evil),), notes=[evil])
    for shown in (fit, replace(blob_model(200), licence=evil)):
        page = shown._repr_html_()
        assert "<img src=x" not in page and "&lt;img src=x" in page


def test_without_what_draws_a_notebook_shows_the_line_and_the_command(
    result: ss.FitResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapespace.report.pages.write_html.find_spec", lambda _: None)
    told = replace(result, scan_name="<b>")._repr_html_()
    assert told.startswith("<pre>&lt;FitResult of") and "pip install &#x27;shapespace[report]&#x27;" in told


def test_plots_are_figures_of_matplotlib(result: ss.FitResult) -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure
    assert isinstance(result.plot("coefficients"), figure)
    assert isinstance(result.model.plot("spectrum", title="Blobs"), figure)
    with pytest.raises(ss.ShapespaceError, match="no plot 'mean'; choose one of distances"):
        result.plot("mean")


def test_the_viewer_in_a_cell_lets_notebooks_of_this_machine_in_and_nobody_else(result: ss.FitResult) -> None:
    view = result.view()
    try:
        cell = view._repr_html_()  # type: ignore[attr-defined]
        token = view.address.partition("token=")[2]
        assert "<iframe" in cell and token not in cell
        [ticket] = re.findall(r"token=([\w-]+)", cell)
        framed = {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Dest": "iframe"}
        base = view.address.partition("/?")[0]
        with httpx.Client(base_url=base, headers=framed, follow_redirects=True) as cellmate:
            page = cellmate.get("/", params={"token": ticket})
            assert page.status_code == 200 and "x-frame-options" not in page.headers
            assert "frame-ancestors http://localhost:* http://127.0.0.1:*" in page.headers["content-security-policy"]
            [fit] = cellmate.get(
                "/view/model/api/fits", headers={"Sec-Fetch-Dest": "empty", "Sec-Fetch-Site": "same-origin"}
            ).json()
            assert fit["pictured"] and fit["status"] == result.status
            assert cellmate.get("/view/model/api/fits", headers={"Sec-Fetch-Dest": "script"}).status_code == 403
        with httpx.Client(base_url=base) as stranger:
            assert stranger.get("/view/model/api/fits").status_code == 401
            assert stranger.get("/", params={"token": ticket}).status_code == 401
    finally:
        view.close()
        view.close()
    with pytest.raises(httpx.ConnectError):
        httpx.get(base)
