"""The viewer's server: what it sends, what it refuses and how, and what it leaves behind."""

import json
import os
import time
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import httpx
import numpy as np
import pytest
from viewer_world import (
    Start,
    agrees,
    model,
    progress,
    running,
    scan_file,
    sentence,
    start,
    unpacked,
    until,
    upload,
    wait_for_events,
    waits,
)

from shapespace.batch.fit_work import FitJob, fit_file
from shapespace.errors import InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.meshes.ply import read_ply
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.fitting import Upload, fit_upload
from shapespace.viewer.model_view import ModelView, without_folders
from shapespace.viewer.serve import listen, page_address, serve
from shapespace.viewer.uploaded_scans import UploadLimits

__all__ = ["model", "scan_file", "start"]


def dies(pipe: Connection, upload: Upload) -> None:
    os.abort()


def test_a_dropped_scan_is_fitted_as_the_command_line_does(
    start: Start, model: ShapeModel, scan_file: Path, tmp_path: Path
) -> None:
    viewer = start()
    user = viewer.user()
    answer = upload(user, scan_file.read_bytes(), scan_file.name)
    assert answer.status_code == 201
    key = answer.json()["id"]
    events = wait_for_events(user, key)
    kinds = [event["event"] for event in events[:-1]]
    assert kinds[0] == "scan" and kinds[-1] == "verdict"
    assert set(kinds[1:-1]) == {"state"} and len(kinds) > 8
    later = user.get(f"/api/scans/{key}/progress", params={"after": len(kinds) - 1}).json()
    assert later["state"] == "done" and [event["event"] for event in later["events"]] == ["verdict"]
    verdict = events[-2]
    assert verdict["status"] == "converged" and verdict["pictured"]
    assert 0 < verdict["shown"]["model_to_scan"]["mean"] < 1 and verdict["shown"]["model_seen_share"] > 0.9

    fit_file(FitJob("cli", scan_file), model, Path("blobs.h5"), tmp_path, FitConfig(), stages=True)
    expected = json.loads((tmp_path / "cli.fit.json").read_text())
    record = user.get(f"/api/scans/{key}/record").json()
    for one in (record, expected):
        del one["seconds"]
        del one["scan"]["size_bytes"], one["scan"]["modified_ns"]
        # The viewer leaves out the paths of its own folders.
        one["scan"].pop("path", None), one["model"].pop("path", None)
    assert record == expected
    assert verdict["b"] == record["b"] == events[-3]["b"]

    for part in ("preview", "picture"):
        assert len(user.get(f"/api/scans/{key}/{part}").content) > 10_000
    # What was uploaded is gone, what came of it is not.
    assert not list(viewer.root.rglob("upload-*")) and list(viewer.root.rglob("*.fitted.ply"))


def test_a_dropped_scan_of_a_format_only_read_is_taken_densely(start: Start, scan_file: Path) -> None:
    scan = read_mesh(scan_file)
    assert scan.faces is not None
    points = ", ".join(" ".join(f"{x:.6f}" for x in point) for point in scan.vertices)
    faces = ", ".join(f"{a}, {b}, {c}, -1" for a, b, c in scan.faces)
    text = (
        f"#VRML V2.0 utf8\nShape {{ geometry IndexedFaceSet {{ coord Coordinate {{ point [ {points} ] }} "
        f"coordIndex [ {faces} ] }} }}\n"
    )
    user = start().user()
    assert ".wrl" in user.get("/api/about").json()["formats"]
    answer = user.put("/api/scans?name=face.wrl&dense=1", content=text.encode())
    assert answer.status_code == 201 and answer.json()["dense"]
    key = answer.json()["id"]
    assert wait_for_events(user, key)[-2]["pictured"]
    record = user.get(f"/api/scans/{key}/record").json()
    assert record["config"]["dense"] and "dense" in record["distances_mm"]
    final, dense = (
        user.post("/api/export?format=ply", json={"scan": key, "stage": stage}).content for stage in ("final", "dense")
    )
    assert len(final) > 1000 and len(dense) > 1000 and final != dense


def test_a_crash_in_a_fit_leaves_the_server_up_and_is_one_sentence(start: Start) -> None:
    viewer = start(worker=dies)
    user = viewer.user()
    events = wait_for_events(user, upload(user, b"anything").json()["id"])
    assert events[-2]["status"] == "failed" and "memory" in events[-2]["reason"]
    assert user.get("/api/about").status_code == 200 and not list(viewer.root.rglob("upload-*"))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("empty.ply", b"", "empty.ply: it is empty"),
        ("broken.ply", b"ply\nformat ascii 1.0\nelement vertex 5\n", "broken.ply"),
        ("one.obj", b"v 0 0 0\n", "one.obj"),
        ("../../../etc/passwd.stl", b"solid\n", "passwd.stl"),
    ],
)
def test_a_broken_file_is_one_sentence_that_names_it(start: Start, name: str, content: bytes, says: str) -> None:
    viewer = start()
    user = viewer.user()
    events = wait_for_events(user, upload(user, content, name).json()["id"])
    assert events[-2]["event"] == "verdict" and events[-1]["state"] == "done"
    reason = events[-2]["reason"]
    assert events[-2]["status"] == "failed" and says in reason and reason.endswith(".")
    assert str(viewer.root) not in reason and "upload-" not in reason
    assert not list(viewer.root.rglob("upload-*"))


def test_scans_that_are_too_large_or_of_another_kind_are_refused(start: Start) -> None:
    viewer = start(worker=agrees, upload_bytes=1000)
    user = viewer.user()
    assert upload(user, b"x" * 1000).status_code == 201
    announced = upload(user, b"x" * 1001)
    assert announced.status_code == 413 and "larger than" in sentence(announced)

    def slowly() -> Iterator[bytes]:
        for _ in range(2):
            yield b"x" * 600
            time.sleep(0.2)

    grown = user.put("/api/scans?name=a.ply", content=slowly())
    assert grown.status_code == 413 and "larger than" in sentence(grown)
    for name in ("a.exe", "a", "", "a.ply.html"):
        other = upload(user, b"x", name)
        assert other.status_code == 415 and ".ply" in sentence(other)
    assert len([path for path in viewer.root.iterdir() if path.is_dir()]) == 1


def test_a_body_larger_than_announced_or_without_a_size_is_bounded(start: Start) -> None:
    user = start(request_bytes=1000).user()
    for content in (b" " * 2000, iter([b" " * 600] * 2)):
        refused = user.post("/api/export?format=ply", content=content)
        assert refused.status_code == 413 and "too long" in sentence(refused)


def test_the_queue_is_bounded_and_a_fit_can_be_stopped(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.viewer.uploaded_scans.cores", lambda: 1)
    viewer = start(worker=waits, unfinished=2)
    user = viewer.user()
    first, second = (upload(user, b"x").json()["id"] for _ in range(2))
    full = upload(user, b"x")
    assert full.status_code == 429 and "2 scans" in sentence(full)
    until(lambda: progress(user, first)["state"] == "fitting")
    assert progress(user, second)["state"] == "waiting" and progress(user, second)["position"] == 1
    assert user.post(f"/api/scans/{first}/cancel").status_code == 200
    assert "stopped" in wait_for_events(user, first)[-2]["reason"]
    until(lambda: progress(user, second)["state"] == "fitting")
    assert user.delete(f"/api/scans/{second}").status_code == 200
    until(lambda: not (viewer.root / second).exists())
    assert user.get(f"/api/scans/{second}/progress").status_code == 404


def test_the_oldest_fitted_scan_is_removed_and_a_waiting_one_at_once(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapespace.viewer.uploaded_scans.cores", lambda: 1)
    viewer = start(worker=agrees, max_fits=2)
    user = viewer.user()
    keys = []
    for _ in range(3):
        keys.append(upload(user, b"x").json()["id"])
        wait_for_events(user, keys[-1])
    assert [scan["id"] for scan in user.get("/api/scans").json()] == keys[1:]
    assert not (viewer.root / keys[0]).exists()
    slow = start(worker=waits)
    user = slow.user()
    first, waiting = (upload(user, b"x").json()["id"] for _ in range(2))
    assert user.delete(f"/api/scans/{waiting}").status_code == 200
    assert not (slow.root / waiting).exists() and (slow.root / first).exists()


def test_a_fit_that_takes_too_long_is_stopped(start: Start) -> None:
    user = start(worker=waits, fit_s=0.2).user()
    assert "longer than" in wait_for_events(user, upload(user, b"x").json()["id"])[-2]["reason"]


def test_nothing_is_left_when_the_server_ends(model: ShapeModel) -> None:
    with running(ModelView(model, "m.h5"), UploadLimits(), waits) as viewer:
        user = viewer.user()
        key = upload(user, b"x").json()["id"]
        assert oct(viewer.root.stat().st_mode)[-3:] == oct((viewer.root / key).stat().st_mode)[-3:] == "700"
        until(lambda: progress(user, key)["state"] == "fitting")
        began = time.monotonic()
    assert not viewer.root.exists() and time.monotonic() - began < 10


@pytest.mark.parametrize("loopback", [True, False])
def test_nothing_is_answered_without_the_token(start: Start, loopback: bool) -> None:
    viewer = start(loopback=loopback)
    token = viewer.access.token
    assert len(token) >= 43  # 256 bits
    stranger = viewer.outsider()
    elsewhere = (f"/api/about?token={token}", f"/x?token={token}")
    for path in ("/", "/api/about", "/api/model", "/assets/viewer.js", "/?token=wrong", "/?token=", *elsewhere):
        refused = stranger.get(path)
        assert refused.status_code == 401 and "token" in sentence(refused)
    assert upload(stranger, b"x").status_code == 401
    assert stranger.post(f"/?token={token}").status_code == 401
    invited = viewer.outsider()
    entered = invited.get(f"/?token={token}")
    # The token is in neither the address that stays nor the cookie.
    assert entered.status_code == 303 and entered.headers["location"] == "/"
    assert "HttpOnly" in entered.headers["set-cookie"] and token not in entered.headers["set-cookie"]
    assert invited.get("/").status_code == 200
    assert "token" not in invited.get("/?token=wrong%0d%0aSet-Cookie:x=y").headers.get("set-cookie", "")
    assert invited.get("/api/about").status_code == 200 and upload(invited, b"").status_code == 201


def test_the_ticket_that_opens_the_browser_is_good_once(start: Start) -> None:
    viewer = start()
    old, ticket = viewer.access.new_ticket(), viewer.access.new_ticket()
    assert [viewer.outsider().get(f"/?token={ticket}").status_code for _ in range(2)] == [303, 401]
    assert viewer.outsider().get(f"/?token={old}").status_code == 401


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", ""])
def test_on_loopback_other_host_names_are_refused(start: Start, host: str) -> None:
    answer = start().user().get("/api/about", headers={"host": host})
    assert answer.status_code in (400, 421)


def test_other_pages_can_change_and_load_nothing(start: Start) -> None:
    viewer = start(worker=agrees)
    user = viewer.user()
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        assert user.put("/api/scans?name=a.ply", content=b"x", headers={"origin": origin}).status_code == 403
        assert user.post("/api/export?format=ply", json={"z": []}, headers={"origin": origin}).status_code == 403
    assert user.get("/api/model", headers={"sec-fetch-site": "cross-site"}).status_code == 403
    for kind, status in (("document", 200), ("iframe", 403)):
        headers = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": kind}
        assert viewer.user().get("/", headers=headers).status_code == status
    own = {"origin": viewer.address, "sec-fetch-site": "same-origin"}
    assert user.put("/api/scans?name=a.ply", content=b"x", headers=own).status_code == 201


def test_every_answer_forbids_what_the_page_does_not_need(start: Start) -> None:
    user = start().user()
    for path in ("/", "/api/about", "/nothing", "/assets/viewer.js"):
        headers = user.get(path).headers
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert "unsafe" not in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff" and headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize("path", ["/api/fits/..%2f..%2fmodel.h5", "/assets/..%2fserver.py", "/assets/fitting.py", "/x"])
def test_no_address_leads_out_of_what_is_shown(start: Start, path: str) -> None:
    answer = start().user().get(path)
    assert answer.status_code == 404 and sentence(answer)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl"])
def test_an_exported_shape_is_the_models(start: Start, model: ShapeModel, kind: str, tmp_path: Path) -> None:
    z = [1.5, -2.0, 0.25]
    answer = start().user().post(f"/api/export?format={kind}", json={"z": z})
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
    answer = start().user().post("/api/export?format=ply", json=question)
    assert answer.status_code in (400, 404, 422) and sentence(answer)


def test_a_doubtful_fit_is_helped_by_landmarks_and_by_no_nonsense(
    start: Start, model: ShapeModel, scan_file: Path
) -> None:
    viewer = start(worker=doubts)
    user = viewer.user()
    key = upload(user, scan_file.read_bytes()).json()["id"]
    events = wait_for_events(user, key)
    assert events[-2]["status"] == "doubtful" and events[-1]["can_place_landmarks"]
    good = {name: model.mean_vertices[vertex].tolist() for name, vertex in model.landmarks.items()}

    def place(landmarks: object) -> httpx.Response:
        return user.post(f"/api/scans/{key}/landmarks", json={"landmarks": landmarks})

    for bad in ({}, dict(list(good.items())[:2]), good | {"=evil()": [0, 0, 0]}, good | {"tip": [0, "a", 0]}, [1]):
        assert place(bad).status_code == 400 and sentence(place(bad))
    assert place(good).status_code == 200
    events = wait_for_events(user, key)
    assert events[-2]["status"] == "converged" and events[-2]["start"] == "landmarks"
    assert place(good).status_code == 409 and not list(viewer.root.rglob("upload-*"))


def doubts(pipe: Connection, upload: Upload) -> None:
    """Doubt every scan without landmarks; with them fit it for once."""
    if upload.landmarks:
        fit_upload(pipe, upload)
        return
    for event in ({"event": "scan"}, {"event": "verdict", "status": "doubtful", "reason": "It is not."}):
        pipe.send_bytes(json.dumps(event).encode())
    time.sleep(60)


@pytest.fixture
def fits(model: ShapeModel, scan_file: Path, tmp_path: Path) -> Path:
    """A folder of results: a good fit with stages, one without, a failed one, a damaged record."""
    model.save(tmp_path / "model.h5")
    folder = tmp_path / "fits"
    folder.mkdir()
    (tmp_path / "empty.ply").write_bytes(b"")
    for name, file, stages in (("a", scan_file, True), ("b", scan_file, False), ("c", tmp_path / "empty.ply", True)):
        fit_file(FitJob(name, file), model, tmp_path / "model.h5", folder, FitConfig(), stages=stages)
    (folder / "d.fit.json").write_text("{")
    return folder


def test_the_fits_of_a_folder_are_listed_worst_first_and_shown(start: Start, fits: Path, model: ShapeModel) -> None:
    user = start(ModelView.open(fits)).user()
    listed = user.get("/api/fits").json()
    assert [(row["name"], row["status"], row["pictured"]) for row in listed] == [
        ("d", "unreadable", False),
        ("c", "failed", False),
        ("a", "converged", True),
        ("b", "converged", True),
    ]
    assert len(listed[2]["z"]) == model.n_modes
    assert len(user.get("/api/fits/a").content) > 10_000
    assert len(user.get("/api/fits/b").content) > 10_000
    for name in ("c", "d"):
        answer = user.get(f"/api/fits/{name}")
        assert answer.status_code == 422 and sentence(answer)
    saved = user.post("/api/export?format=ply", json={"fit": "a"})
    sent, written = read_ply(saved.content, Path("a.ply")), read_mesh(fits / "a.fitted.ply")
    assert np.array_equal(sent.vertices, written.vertices) and np.array_equal(sent.faces, written.faces)
    record = json.loads((fits / "a.fit.json").read_text())
    record["distances_mm"]["final"]["model_to_scan"]["mean"] = "far"
    (fits / "e.fit.json").write_text(json.dumps(record | {"status": "<script>"}))
    assert [(row["name"], row["status"]) for row in user.get("/api/fits").json()][:2] == [
        ("d", "unreadable"),
        ("e", "unreadable"),
    ]


def test_a_fit_without_stages_is_shown_from_its_surfaces_and_its_scan(start: Start, fits: Path) -> None:
    user = start(ModelView.open(fits)).user()
    (_, staged), (facts, plain) = (unpacked(user.get(f"/api/fits/{name}").content) for name in ("a", "b"))
    assert facts["stages"] == ["final"] and "regions" not in plain
    assert np.allclose(plain["scan"], staged["scan"], atol=1e-3)
    assert np.allclose(plain["surface_final"], staged["surface_final"], atol=1e-3)
    both = np.isfinite(plain["model_to_scan_final"]) & np.isfinite(staged["model_to_scan_final"])
    assert both.mean() > 0.9
    assert np.allclose(plain["model_to_scan_final"][both], staged["model_to_scan_final"][both], atol=1e-2)
    record = json.loads((fits / "b.fit.json").read_text())
    (fits / "b.fit.json").write_text(json.dumps(record | {"scan": {**record["scan"], "path": "gone.ply"}}))
    user = start(ModelView.open(fits)).user()
    facts, alone = unpacked(user.get("/api/fits/b").content)
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
    answers = [user.get("/api/fits"), user.get("/api/fits/a"), user.get("/api/fits/d")]
    assert [answer.status_code for answer in answers] == [200, 422, 422]
    assert all(str(tmp_path.parent) not in answer.text and tmp_path.name not in answer.text for answer in answers)
    reasons = {row["name"]: row["reason"] for row in answers[0].json()}
    assert "empty.ply: it is empty" in reasons["c"] and reasons["f"] == "Cannot read a scan.ply: it is empty."
    assert "d.fit.json" in reasons["d"] and "a.stages.npz" in sentence(answers[1])
    (fits / "a.fitted.ply").unlink()
    gone = user.post("/api/export?format=ply", json={"fit": "a"})
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
