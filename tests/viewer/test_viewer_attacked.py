"""The viewer with invalid input: nonsense in headers, requests and records, and a full disk."""

import errno
import json
import webbrowser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from viewer_world import Start, model, sentence, start, until

from shapespace.model.shape_model import ShapeModel
from shapespace.viewer import serve as serve_module
from shapespace.viewer.model_view import ModelView

__all__ = ["model", "start"]


NONSENSE = [
    "http://[",
    "http://[::1",
    "[",
    "]",
    "//",
    "http://a@b:99999999",
    "\xff",
    "http://\xe2\x84\x80",
    "a\tb",
    "," * 5000,
]


def test_nonsense_in_a_header_is_ignored_or_refused_in_a_sentence(start: Start) -> None:
    for loopback in (True, False):
        user = start(loopback=loopback).user()
        for header in ("origin", "host", "cookie", "sec-fetch-site"):
            for value in NONSENSE:
                response = user.put("/view/model/api/export", headers={header: value.encode("latin-1")})
                assert 400 <= response.status_code < 500 and sentence(response), (value, response.text)
    assert user.get("/", headers={"origin": "http://["}).status_code == 403
    # Partial responses are not supported, so that no header can ask for thousands of parts.
    for value in ("bytes=x", "bytes=" + "0-1," * 1000):
        whole = user.get("/assets/viewer.css", headers={"range": value, "if-range": "["})
        assert whole.status_code == 200 and len(whole.content) > 10_000


def test_what_is_asked_wrongly_is_refused_in_a_sentence(start: Start) -> None:
    user = start().user()
    deep = '{"fit": ' + "[" * 3000 + "]" * 3000 + "}"
    for kind in ("fit", "scan"):
        for value in ("[]", "{}", "1", "null", r'"\ud800"', '"a", "z": 1'):
            assert sentence(user.post("/view/model/api/export?format=ply", content=f'{{"{kind}": {value}}}'))
    assert sentence(user.post("/view/model/api/export?format=ply", content=deep))
    assert user.post("/view/model/api/about").status_code == 405 and sentence(user.post("/view/model/api/about"))
    assert user.get("/view/model/api/about/").status_code == 404  # and no redirect made of the Host header


def fits(folder: Path, model: ShapeModel) -> Path:
    """A folder of records alone, one of them good."""
    model.save(folder / "model.h5")
    results = folder / "fits"
    results.mkdir()
    write(results, "good", {})
    return results


def write(results: Path, name: str, known: dict[str, Any]) -> None:
    model_file = results.parent / "model.h5"
    source = {"name": "model.h5", "hash": ShapeModel.load(model_file).content_hash, "path": str(model_file)}
    record = {"format": "shapespace fit", "status": "converged", "model": source, "b": [1.0], "z": [1.0], **known}
    # 1e999 is what JSON says for more than a number can be.
    (results / f"{name}.fit.json").write_text(json.dumps(record).replace("Infinity", "1e999"))


def test_a_bad_record_is_listed_with_its_reason_and_hides_no_other(
    start: Start, model: ShapeModel, tmp_path: Path
) -> None:
    results = fits(tmp_path, model)
    write(results, "huge", {"evidence": {"expected_error_mm": 10**400}})
    write(results, "kinds", {"b": {}, "z": "far"})
    (results / "deep.fit.json").write_text('{"a":' + "[" * 5000 + "]" * 5000 + "}")
    (results / "binary.fit.json").write_bytes(bytes(range(256)))
    (results / "folder.fit.json").mkdir()
    (results / "gone.fit.json").symlink_to("nowhere")
    user = start(ModelView.open(results)).user()
    rows = {row["name"]: row for row in user.get("/view/model/api/fits").json()}
    assert rows.pop("good")["status"] == "converged"
    assert set(rows) == {"huge", "kinds", "deep", "binary", "folder", "gone"}
    for name, row in rows.items():
        assert row["status"] == "unreadable" and row["reason"].endswith(".") and name in row["reason"], row
        assert user.get(f"/view/model/api/fits/{name}").status_code == 422
        assert 400 <= user.post("/view/model/api/export?format=ply", json={"fit": name}).status_code < 500


def test_numbers_that_are_none_are_sent_as_none_or_refused(start: Start, model: ShapeModel, tmp_path: Path) -> None:
    results, inf = fits(tmp_path, model), float("inf")
    far = {"final": {"scan_to_model": {"mean": inf, "p95": -inf}}}
    write(results, "odd", {"evidence": {"expected_error_mm": inf}, "distances_mm": far})
    write(results, "shape", {"z": [inf]})
    rows = {row["name"]: row for row in start(ModelView.open(results)).user().get("/view/model/api/fits").json()}
    assert rows["odd"]["expected_error_mm"] is None and rows["odd"]["scan_to_model_mm"] is None
    assert rows["shape"]["status"] == "unreadable" or rows["shape"]["z"] == [None]


def test_whatever_goes_wrong_with_one_fit_stays_with_it(
    start: Start, model: ShapeModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = fits(tmp_path, model)
    write(results, "odd", {})
    row = ModelView._row

    def fails(shown: ModelView, fit: Any) -> dict[str, Any]:
        if fit.name == "odd" and fit.status != "unreadable":
            raise OverflowError("int too large to convert to float")
        return row(shown, fit)

    monkeypatch.setattr(ModelView, "_row", fails)
    rows = start(ModelView.open(results)).user().get("/view/model/api/fits").json()
    assert [(one["name"], one["status"]) for one in rows] == [("odd", "unreadable"), ("good", "converged")]
    assert "files of odd are damaged" in rows[0]["reason"]


def test_a_full_disk_is_one_sentence(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    user = start().user()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/somewhere")

    with monkeypatch.context() as patch:
        patch.setattr("tempfile.mkdtemp", full)
        answer = user.post("/view/model/api/export?format=ply", json={"z": []})
        assert answer.status_code == 507 and "No space left" in sentence(answer) and "somewhere" not in answer.text
    assert user.post("/view/model/api/export?format=ply", json={"z": []}).status_code == 200


def test_the_browser_is_started_with_a_ticket_and_the_token_is_only_printed(
    model: ShapeModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address))
    monkeypatch.setattr(
        serve_module, "make_server", lambda app: SimpleNamespace(run=lambda sockets: until(lambda: opened))
    )
    model.save(tmp_path / "model.h5")
    lines: list[str] = []
    serve_module.serve(tmp_path / "model.h5", say=lines.append)
    printed = lines[0].split()[-1]
    assert "http://127.0.0.1:" in printed and "?token=" in printed
    page, _, ticket = opened[0].partition("?token=")
    assert printed.startswith(page) and len(ticket) >= 43 and not printed.endswith(ticket)
