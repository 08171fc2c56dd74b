"""The viewer of a folder in correspondence: what it sends, in which order, and what it refuses."""

import csv
import io
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from viewer_world import enter, served, unpacked

from same_blobs import ASIDE, FAR, FOLDED, HIDDEN, NAMES, VERTICES, mean_blob, surface, write_same
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.normals import Distortion, rms_size, vertex_normals
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.files import sha256_of_file
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.schemas import CorrespondRecord
from shapespace.viewer import corresponding_surfaces as module
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import SECURITY_HEADERS, Access, Guard
from shapespace.viewer.serve import serve
from shapespace.viewer.server import surfaces_app
from shapespace.viewer.studio.views import open_view, single_result_app, view_kinds


@contextmanager
def opened(surfaces: Surfaces, token: str = "secret", *, known: bool = True) -> Iterator[httpx.Client]:
    access = Access(token)
    page = single_result_app("blobs", {"surfaces": surfaces_app(surfaces)})
    app = Guard(page, access=access, cookie_name="shapespace", loopback=True)
    with served(app) as address, httpx.Client(base_url=address, timeout=60) as client:
        if known:
            enter(client, access)
        yield client


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_same(tmp_path_factory.mktemp("blobs"))


@pytest.fixture(scope="module")
def client(template: Path) -> Iterator[httpx.Client]:
    with opened(Surfaces(template)) as one:
        yield one


def test_the_population_has_how_many_scans_show_each_vertex_of_the_mean_shape(client: httpx.Client) -> None:
    facts, population = unpacked(client.get("/view/surfaces/api/population").content)
    _, arrays = unpacked(client.get("/view/surfaces/api/mean").content)
    hidden = np.isnan(surface(HIDDEN, NAMES.index(HIDDEN))[0].vertices).any(axis=1)
    assert facts["scans"] == 6
    np.testing.assert_array_equal(population["seen"], np.where(hidden, 5, 6))
    assert arrays["positions"].shape == (VERTICES, 3) and arrays["places"].shape == (VERTICES, 2)
    np.testing.assert_allclose(arrays["positions"].mean(axis=0), 0, atol=1e-3)


def test_a_surface_lies_on_the_mean_shape_and_misses_what_its_scan_does(client: httpx.Client) -> None:
    _, mean = unpacked(client.get("/view/surfaces/api/mean").content)
    facts, arrays = unpacked(client.get(f"/view/surfaces/api/surfaces/{HIDDEN}").content)
    own = surface(HIDDEN, NAMES.index(HIDDEN))[0].vertices
    np.testing.assert_array_equal(np.isnan(arrays["positions"]), np.isnan(own))
    off = np.linalg.norm(arrays["positions"] - mean["positions"], axis=1)
    assert facts["name"] == HIDDEN and np.nanmean(off) < 6
    assert len(client.get(f"/view/surfaces/api/surfaces/{HIDDEN}").content) < 6 * VERTICES + 500  # two bytes a number


def test_the_worst_places_are_where_a_surface_is_folded_stretched_or_far_from_its_scan(client: httpx.Client) -> None:
    facts, arrays = unpacked(client.get(f"/view/surfaces/api/faults/{FOLDED}").content)
    by_kind = {
        kind: [place for place in facts["places"] if place["kind"] == kind] for kind in ("fold", "stretch", "distance")
    }
    own, mean = (surface(FOLDED, NAMES.index(FOLDED))[0], mean_blob())
    folded = np.unique(mean.faces[Distortion.of(own, mean).folded])
    assert by_kind["fold"] and {place["vertex"] for place in by_kind["fold"]} <= set(folded.tolist())
    worst = by_kind["stretch"][0]
    assert abs(worst["value"]) == pytest.approx(np.nanmax(np.abs(arrays["growth"])), rel=1e-5)
    assert (
        client.get(f"/view/surfaces/api/faults/{ASIDE}").status_code
        == client.get("/view/surfaces/api/faults/nobody").status_code
        == 404
    )


def test_the_worst_distance_is_where_the_scan_bulges_and_unknown_without_it(template: Path, tmp_path: Path) -> None:
    shutil.copytree(template.parent, tmp_path / "work")
    scan, record = (
        tmp_path / "work" / "scans" / "able.ply",
        tmp_path / "work" / "same" / f"able{CorrespondRecord.ENDING}",
    )
    mesh = read_mesh(scan)
    bulge = 40
    near = np.linalg.norm(mesh.vertices - mesh.vertices[bulge], axis=1) < 25
    write_mesh(scan, mesh.with_vertices(mesh.vertices + 8 * near[:, None] * vertex_normals(mesh)))

    def faults() -> tuple[list[dict], dict[str, np.ndarray]]:
        facts, arrays = unpacked(Surfaces(record.parent).packed_faults("able"))
        return [place for place in facts["places"] if place["kind"] == "distance"], arrays

    assert faults()[0] == [] and "distance" not in faults()[1]  # the scan is not that of the record
    record.write_text(json.dumps({**json.loads(record.read_text()), "hash": sha256_of_file(scan)}))
    places, arrays = faults()
    own = read_mesh(record.parent / f"able{CorrespondRecord.SURFACE}").vertices
    assert np.linalg.norm(own[places[0]["vertex"]] - mesh.vertices[bulge]) < 25
    assert places[0]["value"] == pytest.approx(np.nanmax(arrays["distance"]), rel=1e-5)
    size = rms_size(mean_blob().vertices) * fit_similarity(mean_blob().vertices, own).scale
    assert places[0]["value"] * size == pytest.approx(8, rel=0.2)
    assert np.linalg.norm(places[0]["normal"]) == pytest.approx(1, abs=1e-2)


def test_of_a_large_folder_names_and_surfaces_come_before_all_surfaces_are_read(
    template: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapespace.viewer.corresponding_surfaces._LARGE", 1000)
    monkeypatch.setattr("shapespace.viewer.corresponding_surfaces._MOST_DRAWN", 300)
    monkeypatch.setattr("shapespace.viewer.corresponding_surfaces._MOST_TURNING", 100)
    monkeypatch.setattr("shapespace.report.inputs.correspondence_folder.Corresponded.population", None)
    with opened(Surfaces(template)) as client:
        assert client.get("/view/surfaces/api/about").json()["is_large"]
        assert {row["name"]: row["status"] for row in client.get("/view/surfaces/api/names").json()} == {
            **dict.fromkeys(NAMES, "converged"), ASIDE: "excluded",
        }  # fmt: skip
        _, mean = unpacked(client.get("/view/surfaces/api/mean").content)
        # Fewer triangles are drawn, between vertices of the surface, and all vertices keep their numbers.
        assert len(mean["faces"]) <= 300 and mean["faces"].max() < len(mean["positions"]) == VERTICES
        assert 0 < len(mean["draft"]) <= 100 and np.isin(mean["draft"], mean["faces"]).all()
        _, able = unpacked(client.get("/view/surfaces/api/surfaces/able").content)
        assert len(able["positions"]) == VERTICES


def test_scans_are_listed_with_what_speaks_against_them_first(client: httpx.Client) -> None:
    rows = client.get("/view/surfaces/api/surfaces").json()
    assert rows[0]["name"] == ASIDE and {row["name"] for row in rows[1:4]} == {FAR, FOLDED, HIDDEN}
    assert [row["status"] for row in rows] == ["excluded", *["look"] * 3, *["converged"] * 3]
    assert "/home/somebody" not in client.get("/view/surfaces/api/surfaces").text
    assert all(row["reason"].endswith(".") for row in rows)


def test_places_of_vertices_are_those_of_each_scans_own_file(client: httpx.Client) -> None:
    top = int(np.flatnonzero(np.isnan(surface(HIDDEN, NAMES.index(HIDDEN))[0].vertices[:, 0]))[0])
    bottom = VERTICES - 1
    answer = client.get(f"/view/surfaces/api/places?vertices={top},{bottom}")
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [(row["scan"], row["vertex"]) for row in rows] == [
        (name, str(vertex)) for name in sorted(NAMES) for vertex in (top, bottom)
    ]
    for row in rows:
        own = surface(row["scan"], NAMES.index(row["scan"]))[0].vertices[int(row["vertex"])]
        if np.isnan(own).any():
            assert (row["x"], row["y"], row["z"]) == ("", "", "")
        else:
            np.testing.assert_allclose([float(row[axis]) for axis in "xyz"], own, atol=1e-3)
    assert sum(row["x"] == "" for row in rows) == 1
    assert 'filename="places.csv"' in answer.headers["content-disposition"]


@pytest.mark.parametrize("asked", ["", "x", "-1", "1,,2", "600", "1.5", "0," * 100 + "0", "²"])
def test_places_of_what_is_no_vertex_are_refused_in_a_sentence(client: httpx.Client, asked: str) -> None:
    answer = client.get("/view/surfaces/api/places", params={"vertices": asked})
    assert answer.status_code in (400, 422) and answer.json()["error"].endswith(".")


@pytest.mark.parametrize(
    "path",
    [
        "/view/surfaces/api/surfaces/nobody",
        f"/view/surfaces/api/surfaces/{ASIDE}",
        "/view/surfaces/api/surfaces/..%2Fsame",
        "/x",
    ],
)
def test_what_is_not_there_is_refused_in_a_sentence(client: httpx.Client, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 404 and answer.json()["error"].endswith(".")
    assert client.get("/assets/../serve.py").status_code == 404


def test_only_its_own_page_may_ask_and_only_read(client: httpx.Client) -> None:
    page = client.get("/")
    assert page.status_code == 200 and all(page.headers[name] == value for name, value in SECURITY_HEADERS.items())
    assert client.get("/view/surfaces/api/mean", headers={"host": "evil.example"}).status_code == 421
    assert client.get("/view/surfaces/api/mean", headers={"origin": "http://evil.example"}).status_code == 403
    for method in ("POST", "PUT", "DELETE"):
        assert client.request(method, "/view/surfaces/api/surfaces").status_code == 405


def test_nonsense_in_a_header_is_refused_in_a_sentence(client: httpx.Client) -> None:
    for origin in ("http://[", "http://", "[", "null"):
        refused = client.get("/view/surfaces/api/mean", headers={"origin": origin})
        assert refused.status_code == 403 and refused.json()["error"].endswith(".")
    assert client.get("/", headers={"range": "bytes=x"}).status_code == 200


def test_a_bad_record_is_listed_with_its_reason_and_hides_no_other(template: Path, tmp_path: Path) -> None:
    shutil.copytree(template.parent, tmp_path / "w")
    folder = tmp_path / "w" / "same"
    record = json.loads((folder / "able.correspond.json").read_text())
    bad = {"area_factor": -1.0, "seen_share": 1e999, "distance_p99": -1e999, "unit_ratio": "one"}
    for key, value in bad.items():
        text = json.dumps(record | {"name": key, key: value}).replace("Infinity", "1e999")
        (folder / f"{key}.correspond.json").write_text(text)
        shutil.copy(folder / "able.corresponding.ply", folder / f"{key}.corresponding.ply")
    with opened(Surfaces(folder)) as one:
        rows = {row["name"]: row for row in one.get("/view/surfaces/api/surfaces").json()}
        assert one.get("/view/surfaces/api/mean").status_code == 200
    assert {*NAMES, *bad} <= {*rows}
    for key in ("area_factor", "unit_ratio"):
        assert rows[key]["status"] == "unreadable" and f"{key}.correspond.json" in rows[key]["reason"]


def test_with_a_token_nothing_is_answered_without_it(template: Path) -> None:
    with opened(Surfaces(template), token="secret", known=False) as stranger:
        for path in (
            "/",
            "/view/surfaces/api/about",
            "/view/surfaces/api/mean",
            "/view/surfaces/api/surfaces",
            "/view/surfaces/api/surfaces/able",
            "/assets/surfaces.js",
        ):
            assert stranger.get(path).status_code == 401
        assert stranger.get("/?token=secret").status_code == 303
        assert stranger.get("/view/surfaces/api/about").status_code == 200  # the cookie


def test_few_surfaces_are_held_however_many_there_are(template: Path, tmp_path: Path, monkeypatch) -> None:
    shutil.copytree(template.parent, tmp_path / "w")
    folder = tmp_path / "w" / "same"
    record = json.loads((folder / "able.correspond.json").read_text())
    for k in range(40):
        (folder / f"more{k}.correspond.json").write_text(json.dumps(record | {"name": f"more{k}"}))
        shutil.copy(folder / "able.corresponding.ply", folder / f"more{k}.corresponding.ply")
    shown = Surfaces(folder)
    for k in range(40):
        shown.packed_surface(f"more{k}")
    assert shown.packed_surface.cache_info().currsize <= 2 * shown.about()["page"] < 40
    monkeypatch.setattr(module, "_PAGE_BYTES", 3 * module._BYTES_PER_VERTEX * VERTICES)
    assert shown.about()["page"] == 3


def test_a_surface_that_is_damaged_is_one_sentence_and_the_others_stay(template: Path, tmp_path: Path) -> None:
    shutil.copytree(template.parent, tmp_path / "w")
    folder = tmp_path / "w" / "same"
    (folder / "able.corresponding.ply").write_bytes(b"ply\n")
    with opened(Surfaces(folder)) as one:
        answer = one.get("/view/surfaces/api/surfaces/able")
        assert answer.status_code == 422 and "able.corresponding.ply" in answer.json()["error"]
        assert str(tmp_path) not in answer.text and str(tmp_path) not in one.get("/view/surfaces/api/surfaces").text
        assert one.get("/view/surfaces/api/surfaces/baker").status_code == 200
        assert unpacked(one.get("/view/surfaces/api/population").content)[0]["scans"] == 5
        places = one.get("/view/surfaces/api/places?vertices=3").text
        assert "able,3,,," in places


def test_a_folder_that_cannot_be_shown_is_one_sentence(template: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="omit --model"):
        serve(template, model=template / "m.h5", open_browser=False)
    (tmp_path / "correspondence.json").write_text("{")
    with pytest.raises(FileFormatError, match=r"correspondence\.json"):
        serve(tmp_path, open_browser=False)


def test_an_analysis_is_shown_by_its_report_which_cannot_act_in_the_page(tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text("<html><body>Groups differ.</body></html>", encoding="utf-8")
    views = {kind: open_view(kind, tmp_path) for kind in view_kinds(tmp_path)}
    app = Guard(single_result_app("compare", views), access=Access("secret"), cookie_name="c", loopback=True)
    with served(app) as address, httpx.Client(base_url=address) as client:
        enter(client, Access("secret"))
        result = client.get("/api/project").json()["result"]
        assert result["views"] == [{"kind": "report", "href": "/view/report/"}]
        report = client.get("/view/report/")
        assert "Groups differ." in report.text and "sandbox" in report.headers["content-security-policy"]
        assert "script-src 'self'" in client.get("/").headers["content-security-policy"]
