"""What is packed for the browser comes back as it was, or as near as it says."""

import base64
import hashlib
import json
import re
import struct
import zlib
from dataclasses import replace
from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.report.inputs.saved_fits import StagedFit
from shapespace.report.render import scene
from shapespace.report.render.scene import SCENE_SCRIPTS, WIDGET_SCRIPTS
from shapespace.types import Mesh, SurfaceLandmarks
from synthetic_shapes import blob_model, raw_scan


def unpack(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The reader of scene-data.js, in NumPy."""
    (length,) = struct.unpack("<I", data[:4])
    header = json.loads(data[4 : 4 + length])
    start = -(-(4 + length) // 8) * 8
    whole: dict[str, np.ndarray] = {}
    out: dict[str, np.ndarray] = {}
    for name, spec in header["arrays"].items():
        at, count, shape = start + spec["offset"], int(np.prod(spec["shape"])), spec["shape"]
        assert at % 8 == 0
        if spec.get("coded"):
            columns = shape[-1] if len(shape) > 1 else 1
            planes = np.frombuffer(data, np.uint8, 2 * count, at).reshape(columns, 2, -1).astype(np.int64)
            zigzag = (planes[:, 0] + 256 * planes[:, 1]).T
            steps = np.where(zigzag % 2, -(zigzag + 1) // 2, zigzag // 2).cumsum(axis=0).reshape(shape)
            if isinstance(spec["coded"], str):
                steps = steps + whole[spec["coded"]]
            array = steps.astype(np.uint16).view(spec["dtype"])
        else:
            array = np.frombuffer(data, spec["dtype"], count, at).reshape(shape)
        whole[name] = array.astype(np.int64) if array.dtype.kind in "iu" else array
        if "scale" in spec:
            scale = np.asarray(spec["scale"])
            wide = scale.reshape(-1, *[1] * (array.ndim - 1)) if scale.ndim else scale
            array = np.where(array == -32768, np.nan, array * wide)
        out[name] = array
    return header["facts"], out


@pytest.fixture(scope="module")
def staged() -> StagedFit:
    model = blob_model()
    scan = raw_scan(np.full(5, 0.4), seed=3).scan
    return StagedFit.of(model, fit_scan(model, scan, FitConfig(method="paper", max_iterations=4)), "somebody")


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ("float64", "float32"),
        ("float32", "float32"),
        ("int64", "int32"),
        ("int32", "int32"),
        ("uint32", "uint32"),
        ("uint16", "uint16"),
        ("int16", "int16"),
        ("uint8", "uint8"),
        ("bool", "uint8"),
    ],
)
def test_arrays_of_each_type_come_back(given: str, read: str) -> None:
    array = np.arange(21).reshape(7, 3).astype(given)
    _, arrays = unpack(scene.pack({"odd": np.ones(3, np.uint8), "it": array, "none": np.zeros((0, 3))}, {}))
    assert arrays["it"].dtype == read
    assert np.array_equal(arrays["it"], array)
    assert arrays["none"].shape == (0, 3)


def test_facts_come_back_and_what_is_not_finite_is_null() -> None:
    facts = {
        "name": 'a "quoted" </script> ü',
        "n": np.int64(3),
        "rms": float("nan"),
        "list": [1.5, np.inf],
        "in": {"k": ()},
    }
    back, _ = unpack(scene.pack({}, facts))
    assert back == {"name": facts["name"], "n": 3, "rms": None, "list": [1.5, None], "in": {"k": []}}


def test_what_a_scene_cannot_hold_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"'depth'.*complex"):
        scene.pack({"depth": np.ones(2, complex)}, {})
    with pytest.raises(InputError, match=r"'big'.*32 bits"):
        scene.pack({"big": np.array([2**40])}, {})
    with pytest.raises(InputError, match="JSON"):
        scene.pack({}, {"it": object()})


@pytest.mark.parametrize("by_row", [False, True])
@pytest.mark.parametrize("coded", [False, True])
@pytest.mark.parametrize("step", [0.0, 0.04])
def test_rounding_stays_within_half_a_step(by_row: bool, coded: bool, step: float) -> None:
    values = np.random.default_rng(0).normal(0, [[[30.0]], [[0.5]], [[1e-4]]], (3, 40, 3))
    values[0, 3] = np.nan
    values[1, 4, 1] = np.inf
    packed = scene.quantise(values, step=step, by_row=by_row, coded=coded)
    _, arrays = unpack(scene.pack({"it": packed}, {}))
    known = np.isfinite(values)
    assert np.array_equal(np.isnan(arrays["it"]), ~known)
    largest = np.where(known, np.abs(values), 0).max(axis=(1, 2) if by_row else None)
    half = 0.5 * np.maximum(largest / 32767, step)
    error = np.where(known, np.abs(arrays["it"] - values), 0).max(axis=(1, 2) if by_row else None)
    assert (error <= half * (1 + 1e-9)).all()


@pytest.mark.parametrize("values", [np.zeros((0, 3)), np.zeros(5), np.full(4, np.nan)])
def test_nothing_zeros_and_unknowns_can_be_rounded(values: np.ndarray) -> None:
    _, arrays = unpack(scene.pack({"it": scene.quantise(values, by_row=len(values) > 0)}, {}))
    assert np.array_equal(arrays["it"], values, equal_nan=True)


def test_a_model_comes_back_to_a_thousandth_of_a_millimetre() -> None:
    model = blob_model()
    _, arrays = unpack(scene.pack_model(model))
    assert np.array_equal(arrays["faces"], model.faces)
    z = np.random.default_rng(1).normal(size=model.n_modes)
    shown = arrays["mean"] + np.tensordot(z, arrays["modes"], 1)
    assert np.abs(shown - model.reconstruct(z * model.stddev)).max() < 1e-3
    assert np.allclose(arrays["stddev"], model.stddev, rtol=1e-6)
    assert np.allclose(np.cumsum(arrays["share"]), model.cumulative_variance, rtol=1e-5)


def test_a_small_model_is_the_same_surface_in_another_order() -> None:
    corners, weights = np.array([[7, 7, 7], [3, 40, 9]]), np.array([[1.0, 0.0, 0.0], [0.5, 0.3, 0.2]])
    model = replace(blob_model(), landmarks=SurfaceLandmarks(("top", "between"), corners, weights))
    facts, arrays = unpack(scene.pack_model(model, 2, small=True))
    _, plain = unpack(scene.pack_model(model, 2))
    assert arrays["modes"].shape == (2, model.n_vertices, 3)
    for name, expected in model.landmarks.positions(model.mean_vertices).items():
        at = facts["landmarks"][name]
        assert np.abs(at["weights"] @ arrays["mean"][at["vertices"]] - expected).max() < 0.03
    corners = [np.sort(np.round(a["mean"][a["faces"].astype(int)].mean(axis=1), 1).sum(1)) for a in (arrays, plain)]
    assert np.abs(corners[0] - corners[1]).max() < 0.4
    z = np.array([2.0, -1.5])
    moved = [np.tensordot(z, a["modes"], 1) for a in (arrays, plain)]
    assert np.allclose(*(np.sort(np.linalg.norm(m, axis=1)) for m in moved), atol=0.1)


def test_more_modes_than_there_are_is_all_and_fewer_than_one_is_refused() -> None:
    model = blob_model()
    _, arrays = unpack(scene.pack_model(model, 999))
    assert len(arrays["modes"]) == model.n_modes
    with pytest.raises(InputError, match="At least one mode"):
        scene.pack_model(model, 0)


def test_a_point_model_has_no_faces() -> None:
    model = replace(blob_model(), faces=None)
    for small in (False, True):
        _, arrays = unpack(scene.pack_model(model, small=small))
        assert "faces" not in arrays
        assert np.abs(arrays["mean"] - model.mean_vertices).max() < 0.03


def test_a_whole_fit_comes_back(staged: StagedFit) -> None:
    facts, arrays = unpack(scene.pack_fit(staged))
    assert facts["stages"] == list(staged.surfaces)
    assert (facts["label"], facts["status"], facts["thinned"]) == ("somebody", staged.status, False)
    assert np.allclose(arrays["scan"], staged.scan.vertices, atol=1e-4)
    assert np.array_equal(arrays["scan_faces"], staged.scan.faces)
    assert np.array_equal(arrays["regions"], staged.regions)
    for stage, surface in staged.surfaces.items():
        assert np.allclose(arrays[f"surface_{stage}"], surface.vertices, atol=1e-4)
        for key, given in (("model_to_scan", staged.model_to_scan_mm), ("scan_to_model", staged.scan_to_model_mm)):
            step = np.nanmax(np.abs(given[stage])) / 32767
            assert np.allclose(arrays[f"{key}_{stage}"], given[stage], atol=step, equal_nan=True)
    model = blob_model()
    last = arrays["history_T"][-1] @ np.c_[model.reconstruct(arrays["history_b"][-1]), np.ones(model.n_vertices)].T
    assert np.abs(last.T - staged.surfaces["final"].vertices).max() < 0.01
    assert len(arrays["history_phase"]) == len(staged.history)


def test_a_small_fit_is_small_and_true_where_it_has_points(staged: StagedFit) -> None:
    facts, arrays = unpack(scene.pack_fit(staged, largest_scan=400))
    whole = scene.pack_fit(staged)
    assert len(arrays["scan_faces"]) <= 400 and len(arrays["faces"]) <= 400
    assert facts["thinned"]
    assert len(scene.payload_html("x", scene.pack_fit(staged, largest_scan=400))) < 0.3 * len(whole)
    for points, mesh, distances, key in (
        (arrays["scan"], staged.scan, staged.scan_to_model_mm, "scan_to_model"),
        (arrays["surface_final"], staged.surfaces["final"], staged.model_to_scan_mm, "model_to_scan"),
    ):
        gap = np.linalg.norm(points[:, None] - mesh.vertices, axis=2)
        nearest = gap.argmin(axis=1)
        assert gap.min(axis=1).max() < 0.04
        for stage in staged.surfaces:
            assert np.allclose(arrays[f"{key}_{stage}"], distances[stage][nearest], atol=0.026, equal_nan=True)
            if key == "model_to_scan":
                surface = staged.surfaces[stage].vertices[nearest]
                assert np.abs(arrays[f"surface_{stage}"] - surface).max() < 0.021
        if key == "model_to_scan":
            assert np.array_equal(arrays["regions"], staged.regions[nearest])


@pytest.mark.parametrize("largest", [None, 400])
def test_the_numbers_of_a_fit_are_of_all_its_vertices(staged: StagedFit, largest: int | None) -> None:
    facts, arrays = unpack(scene.pack_fit(staged, largest_scan=largest))
    for stage in staged.surfaces:
        for key, given in (("model", staged.model_to_scan_mm[stage]), ("scan", staged.scan_to_model_mm[stage])):
            known = np.abs(given[np.isfinite(given)])
            assert facts["mean_mm"][stage][key] == pytest.approx(known.mean())
            for k in (0, 2, 20, 100):
                assert arrays[f"beyond_{key}_{stage}"][k] == pytest.approx(
                    (known > k / 50 * staged.scale_mm).mean(), abs=1e-6
                )
    assert facts["region_shares"] == pytest.approx([(staged.regions == k).mean() for k in range(4)])
    nothing = {stage: np.full_like(values, np.nan) for stage, values in staged.scan_to_model_mm.items()}
    facts, _ = unpack(scene.pack_fit(replace(staged, scan_to_model_mm=nothing)))
    assert facts["mean_mm"]["final"]["scan"] is None


@pytest.mark.parametrize("largest", [None, 400])
def test_what_the_scan_does_not_show_stays_unknown_and_the_scale_is_that_of_the_fit(
    staged: StagedFit, largest: int | None
) -> None:
    seen = np.arange(len(staged.regions)) % 3 > 0
    forward = {stage: np.where(seen, d, np.nan) for stage, d in staged.model_to_scan_mm.items()}
    facts, arrays = unpack(scene.pack_fit(replace(staged, model_to_scan_mm=forward), largest_scan=largest))
    assert facts["signed"] is True
    assert facts["scale_mm"] == replace(staged, model_to_scan_mm=forward).scale_mm
    for stage in staged.surfaces:
        unknown = np.isnan(arrays[f"model_to_scan_{stage}"])
        assert 0.2 < unknown.mean() < 0.5
        if largest is None:
            assert np.array_equal(unknown, ~seen)


def test_a_scan_that_is_thinned_to_be_sent_keeps_the_scale_and_the_numbers(staged: StagedFit) -> None:
    whole, _ = unpack(scene.pack_fit(staged))
    facts, arrays = unpack(scene.pack_fit(staged, most_sent=300))
    assert len(arrays["scan_faces"]) <= 300 and len(arrays["history_phase"]) == len(staged.history)
    assert len(arrays["surface_final"]) == len(staged.surfaces["final"].vertices)
    assert len(arrays["scan_to_model_final"]) == len(arrays["scan"]) < len(staged.scan.vertices)
    assert facts == {**whole, "thinned": True}


def test_a_fit_of_points_is_packed_without_triangles(staged: StagedFit) -> None:
    cloud = replace(staged, scan=Mesh(staged.scan.vertices, None))
    for largest in (None, 100):
        facts, arrays = unpack(scene.pack_fit(cloud, largest_scan=largest))
        assert "scan_faces" not in arrays
        # Points have no inside: what is told of them are lengths.
        assert facts["signed"] is False
        assert all(not (arrays[f"{key}_final"] < 0).any() for key in ("model_to_scan", "scan_to_model"))
        assert largest is None or len(arrays["scan"]) <= largest
    with pytest.raises(InputError, match="at least one"):
        scene.pack_fit(cloud, largest_scan=0)


def branching(n: int = 40) -> Mesh:
    """Three sheets that meet in one edge line."""
    x, y = np.meshgrid(np.linspace(0, 60, n), np.linspace(0, 60, n), indexing="ij")
    points, faces = [], []
    for k, turn in enumerate((0.0, 2.1, 4.2)):
        points.append(np.stack([x.ravel() * np.cos(turn), y.ravel(), x.ravel() * np.sin(turn)], axis=1))
        i = np.arange(n * n).reshape(n, n) + k * n * n
        if k:
            i[0] = np.arange(n)
        a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
        faces += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    return Mesh(np.concatenate(points), np.concatenate(faces))


@pytest.mark.parametrize("largest", [1, 50, 900])
@pytest.mark.parametrize("kind", ["surface", "points", "branching"])
def test_thinning_keeps_the_limit_the_place_and_the_points(kind: str, largest: int, staged: StagedFit) -> None:
    mesh = {"surface": staged.scan, "points": Mesh(staged.scan.vertices), "branching": branching()}[kind]
    few, kept = scene.decimate(mesh, largest)
    count = len(few.vertices) if mesh.faces is None else 0 if few.faces is None else len(few.faces)
    assert count <= largest
    assert np.array_equal(few.vertices, mesh.vertices[kept])
    if largest == 900:
        assert count > 0.5 * largest
        assert np.abs(np.ptp(few.vertices, axis=0) - np.ptp(mesh.vertices, axis=0)).max() < 15.0
    assert scene.decimate(mesh, 10**6)[0] is mesh


def test_a_scatter_has_its_labels_as_codes() -> None:
    points = np.arange(12.0).reshape(4, 3)
    facts, arrays = unpack(scene.pack_scatter(points, ["b", "a", "b", "c"], list("wxyz"), axes=["b1", "b2", "b3"]))
    assert facts["labels"] == ["b", "a", "c"]
    assert arrays["labels"].tolist() == [0, 1, 0, 2]
    assert np.array_equal(arrays["points"], points)
    with pytest.raises(InputError, match="a label and a name for each point"):
        scene.pack_scatter(points, ["b"], list("wxyz"), axes=["b1", "b2", "b3"])


def test_a_payload_is_kept_by_the_page_and_never_run() -> None:
    payload = scene.pack({"it": np.arange(9)}, {"label": "</script><script>alert(1)</script>"})
    html = scene.payload_html('a"><script>', payload)
    assert html.count("<script") == 1
    found = re.fullmatch(
        r'<script type="application/octet-stream" data-coding="deflate" id="(.*)">(.*)</script>\n', html
    )
    assert found and found[1] == "a&quot;&gt;&lt;script&gt;"
    assert zlib.decompress(base64.b64decode(found[2])) == payload


def test_the_scripts_can_stand_inside_a_page() -> None:
    text = scene.scripts()
    assert text.index("var THREE") < text.index("Shapespace.View =") < text.index("Shapespace.colours =")
    assert text.index("Shapespace.colours =") < text.index("Shapespace.widgets =")
    assert "</script" not in text.lower() and "<!--" not in text
    assert not re.search(r"\b(import|export)\s*[({*]", text.split("three.js", 1)[0])
    assert ".ss-widget" in scene.style()


def test_every_script_of_scenes_and_widgets_is_listed_once_and_short() -> None:
    folder = files("shapespace.report").joinpath("assets")
    present = [entry.name for entry in folder.iterdir() if re.match(r"(scene|widget).*\.js$", entry.name)]
    assert sorted(present) == sorted(SCENE_SCRIPTS + WIDGET_SCRIPTS)
    assert all(len(folder.joinpath(name).read_text("utf-8").splitlines()) <= 300 for name in present)


def test_three_js_is_the_file_that_its_readme_records() -> None:
    folder = files("shapespace.report").joinpath("assets/vendor")
    script, readme = folder.joinpath("three.min.js").read_bytes(), folder.joinpath("README.md").read_text("utf-8")
    assert hashlib.sha256(script).hexdigest() in readme
    assert "three.js authors" in folder.joinpath("LICENSE").read_text("utf-8")
    assert len(script) < 500_000
