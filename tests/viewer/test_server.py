"""The viewer's server: what it sends, what it refuses and how, and what it leaves behind."""

import json
from pathlib import Path

import numpy as np
import pytest
from viewer_world import Start, model, scan_file, sentence, start, unpacked

from shapespace.batch.fit_work import FitJob, FitTask, FitWork
from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.meshes.ply import read_ply
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.model_view import ModelView, without_folders
from shapespace.viewer.serve import listen, page_address, serve

__all__ = ["model", "scan_file", "start"]


def test_a_body_larger_than_announced_or_without_a_size_is_bounded(start: Start) -> None:
    user = start().user()
    for content in (b" " * 2**21, iter([b" " * 2**19] * 3)):
        refused = user.post("/view/model/api/export?format=ply", content=content)
        assert refused.status_code == 413 and "too long" in sentence(refused)


@pytest.mark.parametrize("loopback", [True, False])
def test_nothing_is_answered_without_the_token(start: Start, loopback: bool) -> None:
    viewer = start(loopback=loopback)
    token = viewer.access.token
    assert len(token) >= 43  # 256 bits
    stranger = viewer.outsider()
    elsewhere = (f"/view/model/api/about?token={token}", f"/x?token={token}")
    for path in (
        "/",
        "/view/model/api/about",
        "/view/model/api/model",
        "/assets/viewer.js",
        "/?token=wrong",
        "/?token=",
        *elsewhere,
    ):
        refused = stranger.get(path)
        assert refused.status_code == 401 and "token" in sentence(refused)
    assert stranger.post(f"/?token={token}").status_code == 401
    invited = viewer.outsider()
    entered = invited.get(f"/?token={token}")
    # The token is in neither the address that stays nor the cookie.
    assert entered.status_code == 303 and entered.headers["location"] == "/"
    assert "HttpOnly" in entered.headers["set-cookie"] and token not in entered.headers["set-cookie"]
    assert invited.get("/").status_code == 200
    assert "token" not in invited.get("/?token=wrong%0d%0aSet-Cookie:x=y").headers.get("set-cookie", "")
    assert invited.get("/view/model/api/about").status_code == 200


def test_the_ticket_that_opens_the_browser_is_good_once(start: Start) -> None:
    viewer = start()
    old, ticket = viewer.access.new_ticket(), viewer.access.new_ticket()
    assert [viewer.outsider().get(f"/?token={ticket}").status_code for _ in range(2)] == [303, 401]
    assert viewer.outsider().get(f"/?token={old}").status_code == 401


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_on_loopback_other_host_names_are_refused(start: Start, host: str) -> None:
    answer = start().user().get("/view/model/api/about", headers={"host": host})
    assert answer.status_code in (400, 421)


def test_other_pages_can_change_and_load_nothing(start: Start) -> None:
    viewer = start()
    user = viewer.user()
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        assert (
            user.post("/view/model/api/export?format=ply", json={"z": []}, headers={"origin": origin}).status_code
            == 403
        )
    assert user.get("/view/model/api/model", headers={"sec-fetch-site": "cross-site"}).status_code == 403
    for kind, status in (("document", 200), ("iframe", 403)):
        headers = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": kind}
        assert viewer.user().get("/", headers=headers).status_code == status
    own = {"origin": viewer.address, "sec-fetch-site": "same-origin"}
    assert user.post("/view/model/api/export?format=ply", json={"z": []}, headers=own).status_code == 200


def test_every_answer_forbids_what_the_page_does_not_need(start: Start) -> None:
    user = start().user()
    for path in ("/", "/view/model/api/about", "/nothing", "/assets/viewer.js"):
        headers = user.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize(
    "path", ["/view/model/api/fits/..%2f..%2fmodel.h5", "/assets/..%2fserver.py", "/assets/guard.py", "/x"]
)
def test_no_address_leads_out_of_what_is_shown(start: Start, path: str) -> None:
    answer = start().user().get(path)
    assert answer.status_code == 404 and sentence(answer)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl"])
def test_an_exported_shape_is_the_models(start: Start, model: ShapeModel, kind: str, tmp_path: Path) -> None:
    z = [1.5, -2.0, 0.25]
    answer = start().user().post(f"/view/model/api/export?format={kind}", json={"z": z})
    path = tmp_path / f"shape.{kind}"
    path.write_bytes(answer.content)
    expected = model.reconstruct(np.array(z) * model.stddev[:3])
    found = read_mesh(path).vertices
    if kind == "stl":
        found, expected = (np.array(sorted(v.round(2).tolist())) for v in (found, expected))
    assert np.allclose(found, expected, atol=2e-2 if kind == "stl" else 1e-12)


@pytest.mark.parametrize(
    "question", [{"z": [0] * 99}, {"z": ["a"]}, {"z": None}, {"z": [1e300]}, {"fit": "none"}, {"scan": "none"}, []]
)
def test_an_export_of_what_there_is_not_is_one_sentence(start: Start, question: object) -> None:
    answer = start().user().post("/view/model/api/export?format=ply", json=question)
    assert answer.status_code in (400, 404, 422) and sentence(answer)


@pytest.fixture
def fits(model: ShapeModel, scan_file: Path, tmp_path: Path) -> Path:
    """A folder of results: a good fit with stages, one without, a failed one, a damaged record."""
    model.save(tmp_path / "model.h5")
    folder = tmp_path / "fits"
    folder.mkdir()
    (tmp_path / "empty.ply").write_bytes(b"")
    for name, file, stages in (("a", scan_file, True), ("b", scan_file, False), ("c", tmp_path / "empty.ply", True)):
        FitWork.of(model, tmp_path / "model.h5", folder).do(
            FitTask(FitJob(name, file), FitConfig(), stages, resume=False)
        )
    (folder / "d.fit.json").write_text("{")
    return folder


def test_the_fits_of_a_folder_are_listed_worst_first_and_shown(start: Start, fits: Path, model: ShapeModel) -> None:
    user = start(ModelView.open(fits)).user()
    listed = user.get("/view/model/api/fits").json()
    assert [(row["name"], row["status"], row["pictured"]) for row in listed] == [
        ("d", "unreadable", False),
        ("c", "failed", False),
        ("a", "converged", True),
        ("b", "converged", True),
    ]
    assert len(listed[2]["z"]) == model.n_modes
    assert len(user.get("/view/model/api/fits/a").content) > 10_000
    assert len(user.get("/view/model/api/fits/b").content) > 10_000
    for name in ("c", "d"):
        answer = user.get(f"/view/model/api/fits/{name}")
        assert answer.status_code == 422 and sentence(answer)
    saved = user.post("/view/model/api/export?format=ply", json={"fit": "a"})
    sent, written = read_ply(saved.content, Path("a.ply")), read_mesh(fits / "a.fitted.ply")
    assert np.array_equal(sent.vertices, written.vertices) and np.array_equal(sent.faces, written.faces)
    record = json.loads((fits / "a.fit.json").read_text())
    record["distances_mm"]["final"]["model_to_scan"]["mean"] = "far"
    (fits / "e.fit.json").write_text(json.dumps(record | {"status": "<script>"}))
    assert [(row["name"], row["status"]) for row in user.get("/view/model/api/fits").json()][:2] == [
        ("d", "unreadable"),
        ("e", "unreadable"),
    ]


def test_a_fit_without_stages_is_shown_from_its_surfaces_and_its_scan(start: Start, fits: Path) -> None:
    user = start(ModelView.open(fits)).user()
    (_, staged), (facts, plain) = (unpacked(user.get(f"/view/model/api/fits/{name}").content) for name in ("a", "b"))
    assert facts["stages"] == ["final"] and "regions" not in plain
    assert np.allclose(plain["scan"], staged["scan"], atol=1e-3)
    assert np.allclose(plain["surface_final"], staged["surface_final"], atol=1e-3)
    both = np.isfinite(plain["model_to_scan_final"]) & np.isfinite(staged["model_to_scan_final"])
    assert both.mean() > 0.9
    assert np.allclose(plain["model_to_scan_final"][both], staged["model_to_scan_final"][both], atol=1e-2)
    record = json.loads((fits / "b.fit.json").read_text())
    (fits / "b.fit.json").write_text(json.dumps(record | {"scan": {**record["scan"], "path": "gone.ply"}}))
    user = start(ModelView.open(fits)).user()
    facts, alone = unpacked(user.get("/view/model/api/fits/b").content)
    assert np.allclose(alone["surface_final"], plain["surface_final"]) and "scan" not in alone
    assert facts["without_scan"].startswith("The fitted surface is shown alone, since the scan is no longer")


def test_the_list_of_fits_tells_what_scan_and_model_both_show(fits: Path) -> None:
    record = json.loads((fits / "a.fit.json").read_text())
    older = {key: value for key, value in record.items() if key != "shown"}
    (fits / "older.fit.json").write_text(json.dumps(older))
    (fits / "odd.fit.json").write_text(json.dumps(record | {"shown": {"model_to_scan": 3}}))
    rows = {row["name"]: row for row in ModelView.open(fits).fit_list()}
    for way in ("model_to_scan", "scan_to_model"):
        assert {name: rows["a"]["shown"][way][name] for name in ("mean", "p95")} == {
            name: record["shown"][way][name] for name in ("mean", "p95")
        }
    assert rows["a"]["shown"]["model_seen_share"] == record["shown"]["model_seen_share"]
    assert rows["older"]["shown"] is None and rows["older"]["status"] == "converged"
    assert rows["odd"]["status"] == "unreadable" and rows["c"]["shown"] is None


def test_doubt_comes_first_and_then_the_error_a_fit_expects(fits: Path, model: ShapeModel) -> None:
    record = json.loads((fits / "a.fit.json").read_text())
    for name, status, expected in (("g", "converged", 9.0), ("h", "doubtful", 0.1), ("i", "converged", None)):
        evidence = {**record["evidence"], "expected_error_mm": expected}
        (fits / f"{name}.fit.json").write_text(json.dumps(record | {"status": status, "evidence": evidence}))
    ours = record["evidence"]["expected_error_mm"]
    by_scan = record["distances_mm"]["final"]["scan_to_model"]["mean"]
    assert 0 < ours < 9 and 0 < by_scan < 9
    rows = {row["name"]: row for row in ModelView.open(fits).fit_list()}
    assert list(rows)[:4] == ["d", "c", "h", "g"]
    assert rows["a"]["expected_error_mm"] == ours and rows["i"]["expected_error_mm"] is None
    # One that expects nothing of itself is ranked by what was measured.
    assert (list(rows).index("i") > list(rows).index("a")) == (by_scan <= ours)


def test_no_folder_of_this_machine_reaches_a_user(start: Start, fits: Path, tmp_path: Path) -> None:
    record = json.loads((fits / "c.fit.json").read_text())
    assert str(tmp_path) in record["reason"]  # as long as records hold what was typed
    odd = tmp_path / "two words" / "a scan.ply"
    record |= {"reason": f"Cannot read {odd}: it is empty.", "scan": {**record["scan"], "name": "a scan.ply"}}
    (fits / "f.fit.json").write_text(json.dumps(record))
    (fits / "a.stages.npz").write_bytes(b"damaged")
    user = start(ModelView.open(fits)).user()
    answers = [user.get("/view/model/api/fits"), user.get("/view/model/api/fits/a"), user.get("/view/model/api/fits/d")]
    assert [answer.status_code for answer in answers] == [200, 422, 422]
    assert all(str(tmp_path.parent) not in answer.text and tmp_path.name not in answer.text for answer in answers)
    reasons = {row["name"]: row["reason"] for row in answers[0].json()}
    assert "empty.ply: it is empty" in reasons["c"] and reasons["f"] == "Cannot read a scan.ply: it is empty."
    assert "d.fit.json" in reasons["d"] and "a.stages.npz" in sentence(answers[1])
    (fits / "a.fitted.ply").unlink()
    gone = user.post("/view/model/api/export?format=ply", json={"fit": "a"})
    assert tmp_path.name not in gone.text and sentence(gone)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("Cannot read /home/me/scans/a.ply: it is empty.", "Cannot read a.ply: it is empty."),
        ("'/data/x' and C:\\Users\\me\\b.obj, (/tmp/y/z.npz)", "'x' and b.obj, (z.npz)"),
        ("mixed/a.ply or ../b.ply: 3/4 and/or http://127.0.0.1/x", "mixed/a.ply or ../b.ply: 3/4 and/or http://127.0.0.1/x"),
    ],
)  # fmt: skip
def test_a_path_is_told_by_its_last_part(given: str, told: str) -> None:
    assert without_folders(given) == told


@pytest.mark.parametrize(
    ("name", "says"),
    [("fits", "such as .*deep/er"), ("none.h5", "no such file"), ("a.ply", "no model"), ("empty", "no fits")],
)
def test_what_cannot_be_shown_is_one_sentence(name: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "fits" / "deep" / "er").mkdir(parents=True)
    (tmp_path / "fits" / "deep" / "er" / "a.fit.json").write_text("{}")
    (tmp_path / "a.ply").write_text("ply")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ShapespaceError, match=says):
        ModelView.open(tmp_path / name)


def test_a_taken_port_is_one_sentence_and_without_a_wish_the_next_one_is_found() -> None:
    with listen("127.0.0.1", None) as first, listen("127.0.0.1", None) as second:
        taken = first.getsockname()[1]
        assert second.getsockname()[1] > taken
        with pytest.raises(InputError, match=f"Port {taken} is taken"):
            listen("127.0.0.1", taken)
    for host, port in (("192.0.2.1", None), ("no such host", None), ("127.0.0.1", 99999)):
        with pytest.raises(InputError, match=r"listen|used"):
            listen(host, port)
    assert page_address("::1", 1, "t") == "http://[::1]:1/?token=t"
    assert page_address("0.0.0.0", 1, "t").endswith(":1/?token=t")


def test_without_its_packages_the_viewer_says_how_to_install_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ShapespaceError, match=r"pip install 'shapespace\[view\]'"):
        serve(tmp_path)
