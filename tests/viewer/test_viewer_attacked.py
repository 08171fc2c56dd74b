"""The viewer under attack: nonsense in headers and records, visitors that crowd others out, requests without an end."""

import errno
import json
import re
import socket
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import httpx
import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from viewer_world import Running, Start, drop, model, sentence, served, start, told

from shapespace.model.shape_model import ShapeModel
from shapespace.viewer import serve as serve_module
from shapespace.viewer.answers import binary
from shapespace.viewer.fitting import Upload
from shapespace.viewer.limits import Limits
from shapespace.viewer.sessions import Sessions
from shapespace.viewer.shown import Shown

__all__ = ["model", "start"]


def agrees(pipe: Connection, upload: Upload) -> None:
    pipe.send_bytes(json.dumps({"event": "verdict", "status": "converged", "reason": "It is good."}).encode())
    time.sleep(60)


def waits(pipe: Connection, upload: Upload) -> None:
    time.sleep(60)


@pytest.fixture
def connect() -> Iterator[Callable[..., socket.socket]]:
    """Return what opens a connection to an address, and sends the beginning of a request of a visitor."""
    with ExitStack() as stack:

        def open_(address: str, begin: str = "", visitor: httpx.Client | None = None) -> socket.socket:
            host, port = address.removeprefix("http://").split(":")
            one = stack.enter_context(socket.create_connection((host, int(port)), timeout=10))
            cookies = "" if visitor is None else "; ".join(f"{key}={value}" for key, value in visitor.cookies.items())
            if begin:
                one.sendall(f"{begin} HTTP/1.1\r\nHost: {host}:{port}\r\nCookie: {cookies}\r\n".encode())
            return one

        yield open_


def ended(one: socket.socket, within_s: float, trickle: bytes = b"") -> bytes:
    """Return what came until the server closed the connection; it fails where it does not in time."""
    came, ends = b"", time.monotonic() + within_s
    one.settimeout(0.1)
    while time.monotonic() < ends:
        try:
            if trickle:
                one.sendall(trickle)
            piece = one.recv(2**16)
            if not piece:
                return came
            came += piece
        except TimeoutError:
            continue
        except OSError:
            return came
    raise AssertionError(f"still open after {within_s} s: {came[:200]!r}")


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


@pytest.mark.parametrize("header", ["origin", "host", "range", "cookie", "referer", "sec-fetch-site", "if-range"])
def test_nonsense_in_a_header_is_passed_over_or_refused_in_a_sentence(start: Start, header: str) -> None:
    for local in (True, False):
        visitor = start(local=local).visitor()
        for value in NONSENSE:
            for method, path in (("GET", "/"), ("GET", "/api/about/"), ("POST", "/api/export?format=ply")):
                answer = visitor.request(method, path, headers={header: value.encode("latin-1")})
                assert answer.status_code < 500, (value, answer.text)
                assert answer.status_code == 200 or sentence(answer)
    assert visitor.get("/", headers={"origin": "http://["}).status_code == 403


def test_what_is_asked_wrongly_is_refused_in_a_sentence(start: Start) -> None:
    visitor = start().visitor()
    deep = '{"fit": ' + "[" * 3000 + "]" * 3000 + "}"
    for kind in ("fit", "scan"):
        for value in ("[]", "{}", "1", "null", r'"\ud800"', '"a", "z": 1'):
            assert sentence(visitor.post("/api/export?format=ply", content=f'{{"{kind}": {value}}}'))
    assert sentence(visitor.post("/api/export?format=ply", content=deep))
    assert visitor.post("/api/about").status_code == 405 and sentence(visitor.post("/api/about"))
    assert visitor.get("/api/about/").status_code == 404  # and no redirect made of the Host header


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
    visitor = start(Shown.open(results)).visitor()
    rows = {row["name"]: row for row in visitor.get("/api/fits").json()}
    assert rows.pop("good")["status"] == "converged"
    assert set(rows) == {"huge", "kinds", "deep", "binary", "folder", "gone"}
    for name, row in rows.items():
        assert row["status"] == "unreadable" and row["reason"].endswith(".") and name in row["reason"], row
        assert visitor.get(f"/api/fits/{name}").status_code == 422
        assert 400 <= visitor.post("/api/export?format=ply", json={"fit": name}).status_code < 500


def test_numbers_that_are_none_are_sent_as_none_or_refused(start: Start, model: ShapeModel, tmp_path: Path) -> None:
    results, inf = fits(tmp_path, model), float("inf")
    far = {"final": {"scan_to_model": {"mean": inf, "p95": -inf}}}
    write(results, "odd", {"evidence": {"expected_error_mm": inf}, "distances_mm": far})
    write(results, "shape", {"z": [inf]})
    rows = {row["name"]: row for row in start(Shown.open(results)).visitor().get("/api/fits").json()}
    assert rows["odd"]["expected_error_mm"] is None and rows["odd"]["scan_to_model_mm"] is None
    assert rows["shape"]["status"] == "unreadable" or rows["shape"]["z"] == [None]


def test_whatever_goes_wrong_with_one_fit_stays_with_it(
    start: Start, model: ShapeModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = fits(tmp_path, model)
    write(results, "odd", {})
    row = Shown._row

    def fails(shown: Shown, fit: Any) -> dict[str, Any]:
        if fit.name == "odd" and fit.status != "unreadable":
            raise OverflowError("int too large to convert to float")
        return row(shown, fit)

    monkeypatch.setattr(Shown, "_row", fails)
    rows = start(Shown.open(results)).visitor().get("/api/fits").json()
    assert [(one["name"], one["status"]) for one in rows] == [("odd", "unreadable"), ("good", "converged")]
    assert "files of odd are damaged" in rows[0]["reason"]


def test_nobody_is_crowded_out_who_has_scans(start: Start) -> None:
    viewer = start(worker=agrees, visitors=2, onlookers=5)
    first, second, third = (viewer.visitor() for _ in range(3))
    keys = [drop(one, b"x").json()["id"] for one in (first, second)]
    for one, key in zip((first, second), keys, strict=True):
        assert told(one, key)[-1]["event"] == "done"
    # Somebody without a cookie, again and again: those that have no scans go, the one idle for longest first.
    for _ in range(8):
        viewer.visitor()
    assert [[scan["id"] for scan in one.get("/api/scans").json()] for one in (first, second)] == [[key] for key in keys]
    gone = drop(third, b"x")
    assert gone.status_code == 403 and "reload" in sentence(gone)
    assert third.get("/").status_code == 200
    full = drop(third, b"x")
    assert full.status_code == 503 and "2 visitors" in sentence(full)
    assert first.delete(f"/api/scans/{keys[0]}").status_code == 200
    assert drop(third, b"x").status_code == 201


def left_behind(viewer: Running) -> list[Path]:
    return [path for path in viewer.root.iterdir() if path.is_dir()]


def until(true: Callable[[], object], seconds: float = 15) -> None:
    ends = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < ends
        time.sleep(0.02)


def test_a_full_disk_is_one_sentence_and_takes_nobodys_place(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    viewer = start(worker=agrees, unfinished=1)
    visitor = viewer.visitor()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(viewer.root))

    with monkeypatch.context() as patch:
        patch.setattr(Sessions, "new_folder", full)
        patch.setattr("tempfile.mkdtemp", full)
        for answer in (
            drop(visitor, b"x"),
            drop(visitor, b"x"),
            visitor.post("/api/export?format=ply", json={"z": []}),
        ):
            assert answer.status_code == 507 and "No space left" in sentence(answer)
            assert str(viewer.root) not in answer.text
    assert drop(visitor, b"x").status_code == 201


@pytest.mark.parametrize("trickle", [b"", b"x"])
@pytest.mark.parametrize("asked", ["PUT /api/scans?name=a.ply", "POST /api/export?format=ply"])
def test_a_body_that_never_ends_is_given_up(start: Start, connect: Any, asked: str, trickle: bytes) -> None:
    viewer = start(worker=agrees, stalled_s=0.3, body_s=0.6, quiet_s=0.5)
    stalled = connect(viewer.address, asked, viewer.visitor())
    stalled.sendall(b"Content-Length: 100000\r\n\r\nsome")
    came = ended(stalled, 15, trickle)
    assert came.startswith(b"HTTP/1.1 408") and came.endswith(b'send it again."}')
    assert not left_behind(viewer)


def test_all_bodies_together_are_bounded(start: Start, connect: Any) -> None:
    viewer = start(worker=waits, upload_bytes=100_000, all_bytes=150_000)
    one, other = viewer.visitor(), viewer.visitor()
    stalled = connect(viewer.address, "PUT /api/scans?name=a.ply", one)
    stalled.sendall(b"Content-Length: 100000\r\n\r\n" + b"x" * 90_000)
    # Bytes count before they are written, of which a buffer holds some back.
    until(lambda: sum(path.stat().st_size for path in viewer.root.glob("*/upload-*")) > 80_000)
    full = drop(other, b"x" * 80_000)
    assert "as many scans as it takes" in sentence(full)
    grown = other.put("/api/scans?name=a.ply", content=iter([b"x" * 80_000]))  # which does not announce its size
    assert grown.status_code == 503 and sentence(grown)
    asked = other.post("/api/export?format=ply", content=b" " * 80_000)
    assert asked.status_code == 503 and sentence(asked)
    stalled.close()
    until(lambda: not left_behind(viewer))
    kept = drop(other, b"x" * 80_000)
    assert kept.status_code == 201
    assert drop(one, b"x" * 80_000).status_code == 503  # the first one waits for its fit
    assert other.delete(f"/api/scans/{kept.json()['id']}").status_code == 200
    assert drop(one, b"x" * 80_000).status_code == 201


def test_a_connection_that_asks_for_nothing_is_closed(start: Start, connect: Any) -> None:
    viewer = start(quiet_s=0.3)
    silent = connect(viewer.address)
    slow = connect(viewer.address, "GET /")
    refused = connect(viewer.address, "PUT /api/scans?name=a.ply")
    refused.sendall(b"Content-Length: 100000\r\n\r\n")
    assert ended(silent, 15) == b""
    assert ended(slow, 15, b"X") == b""
    assert ended(refused, 15, b"x").startswith(b"HTTP/1.1 401")


def test_connections_are_bounded_and_the_idle_ones_go_first(start: Start, connect: Any) -> None:
    viewer = start(worker=waits, connections=3)
    idle = [connect(viewer.address) for _ in range(3)]
    visitor = viewer.visitor()  # by one connection of its own
    assert ended(idle[0], 15) == b""
    key = drop(visitor, b"x").json()["id"]
    for _ in range(3):
        watching = connect(viewer.address, f"GET /api/scans/{key}/events", visitor)
        watching.sendall(b"\r\n")
        assert watching.recv(20).startswith(b"HTTP/1.1 200")
    busy = viewer.outsider().get("/")
    assert busy.status_code == 503 and "visitors" in sentence(busy)


def test_an_answer_that_nobody_takes_is_neither_held_nor_kept(connect: Any) -> None:
    taken = 0
    whole = bytes(64 * 2**20)

    async def large(request: Request) -> Response:
        answer = binary(whole)
        body = answer.body_iterator

        async def counted() -> Any:
            nonlocal taken
            async for piece in body:
                taken += len(piece)
                yield piece

        answer.body_iterator = counted()
        return answer

    limits = Limits(quiet_s=0.7)
    with served(Starlette(routes=[Route("/", large)]), limits) as address:
        stuck = connect(address, "GET /")
        stuck.sendall(b"\r\n")
        until(lambda: taken)
        time.sleep(0.1)
        assert taken < 16 * 2**20  # by the buffers of the system
        time.sleep(2.0)
        assert len(ended(stuck, 15)) < len(whole)
        assert httpx.get(address).content == whole


def test_the_document_tells_the_limits() -> None:
    limits = Limits()
    text = (Path(__file__).parents[2] / "docs" / "viewer.md").read_text(encoding="utf-8")
    _, _, told = text.partition("## What it takes of the machine")
    cells = [
        [cell.strip() for cell in line.split("|")[2:3]]
        for line in told.split("\n## ")[0].splitlines()
        if line[:1] == "|"
    ]
    numbers = [re.findall(r"\d+", cell.replace(",", "")) for (cell,) in cells[2:]]
    assert [[int(number) for number in row] for row in numbers] == [
        [limits.upload_bytes // 2**20],
        [limits.all_bytes // 2**30],
        [limits.body_s, limits.stalled_s],
        [limits.visitors],
        [limits.onlookers],
        [limits.unfinished],
        [limits.kept],
        [limits.fit_s, limits.unwatched_s],
        [limits.connections],
        [limits.quiet_s],
    ]
    assert f"After {limits.guesses} wrong tokens one a second" in text and limits.guess_s == 1
    assert "within a minute" in text and limits.ticket_s == 60


def test_the_browser_is_started_with_a_ticket_and_the_token_is_only_printed(
    model: ShapeModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address))

    def run(
        app: object, sessions: Sessions, limits: Limits, listening: socket.socket, started: Callable[[], None]
    ) -> None:
        started()
        until(lambda: opened)
        listening.close()
        sessions.close()

    monkeypatch.setattr(serve_module, "run", run)
    model.save(tmp_path / "model.h5")
    said: list[str] = []
    serve_module.serve(tmp_path / "model.h5", say=said.append, quiet=True)
    printed = said[0].split()[-1]
    assert "http://127.0.0.1:" in printed and "?token=" in printed
    at, _, ticket = opened[0].partition("?token=")
    assert printed.startswith(at) and len(ticket) >= 43 and not printed.endswith(ticket)
