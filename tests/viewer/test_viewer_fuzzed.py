"""Random requests to both viewers: every response is a success or the client's fault, and no traceback is logged.

`SHAPESPACE_FUZZ=100000 pytest tests/viewer/test_viewer_fuzzed.py` goes on for an hour or so, with other requests.
"""

import json
import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import httpx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from starlette.types import ASGIApp
from viewer_world import VERTICES, enter, served

from same_blobs import write_same
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import Access, Guard
from shapespace.viewer.model_view import ModelView
from shapespace.viewer.server import model_app, surfaces_app
from shapespace.viewer.studio.views import ViewKind, single_result_app
from synthetic_shapes import blob_model

BY_HAND = int(os.environ.get("SHAPESPACE_FUZZ", "0"))
MANY = settings(
    max_examples=BY_HAND or 250, derandomize=not BY_HAND, deadline=None, database=None,
    suppress_health_check=list(HealthCheck),
)  # fmt: skip


@dataclass(frozen=True)
class Target:
    """A viewer that runs, the kind of its view, the cookie of its user, and the log of the server."""

    address: tuple[str, int]
    kind: str
    cookies: str
    log: list[str]


@contextmanager
def target(kind: ViewKind, view: ASGIApp) -> Iterator[Target]:
    access = Access()
    app = Guard(single_result_app("result", {kind: view}), access=access, cookie_name="shapespace", loopback=True)
    log: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: log.append(record.getMessage())
    loggers = [logging.getLogger(name) for name in ("uvicorn.error", "asyncio")]
    with served(app) as address, httpx.Client(base_url=address) as user:
        for logger in loggers:
            logger.addHandler(handler)
        try:
            enter(user, access)
            host, port = address.removeprefix("http://").split(":")
            cookies = "; ".join(f"{key}={value}" for key, value in user.cookies.items())
            yield Target((host, int(port)), kind, cookies, log)
        finally:
            for logger in loggers:
                logger.removeHandler(handler)


@pytest.fixture(scope="module")
def fits(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    """A viewer of records that are mostly nonsense."""
    folder = tmp_path_factory.mktemp("fits")
    model = blob_model(VERTICES)
    good = {"format": "shapespace fit", "status": "converged", "model": {"hash": model.content_hash}, "z": [1]}
    for name, record in (("good", good), ("huge", {**good, "evidence": {"expected_error_mm": 10**400}}), ("list", [])):
        (folder / f"{name}.fit.json").write_text(json.dumps(record))
    with target("model", model_app(ModelView(model, "m.h5", folder))) as one:
        yield one


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    with target("surfaces", surfaces_app(Surfaces(write_same(tmp_path_factory.mktemp("blobs"))))) as one:
        yield one


TEXT = st.one_of(
    st.sampled_from(
        ["", "[", "http://[", "%", "%zz", "%00", "%ff%fe", "..", "..%2f..", "/", "%2e%2e/%2e%2e", "\xb2", "-1", "1e999",
         "NaN", "0", "9" * 5000, "a" * 70_000, "{}", "null", "'", "able", "good", "huge", "list", "ply", "a.ply"]
    ),
    st.text(st.characters(max_codepoint=255), max_size=12),
)  # fmt: skip
ROUTES = (
    "GET /", "GET /assets/X", "GET /api/project", "GET KIND/api/about", "GET KIND/api/model", "GET KIND/api/fits",
    "GET KIND/api/fits/X", "HEAD /X", "POST KIND/api/export?format=X", "POST KIND/api/export?format=ply",
    "GET KIND/api/mean", "GET KIND/api/surfaces", "GET KIND/api/surfaces/X", "GET KIND/api/faults/X", "X KIND/api/X",
    "GET KIND/api/places?vertices=X", "GET KIND/api/places?vertices=1,X", "GET /view/X", "GET /view/X/api/about",
    "GET /?token=X", "GET /?X=X", "GET X", "OPTIONS *", "X /", "CONNECT http://X/", "PUT KIND/api/export?format=X",
)  # fmt: skip
HEADERS = st.lists(
    st.tuples(
        st.sampled_from(["Host", "Origin", "Cookie", "Range", "If-Range", "Content-Length", "Transfer-Encoding",
             "Sec-Fetch-Site", "Sec-Fetch-Dest", "Connection", "Upgrade", "Expect", "Content-Type", "Accept", "X"]),
        TEXT | st.sampled_from(["chunked", "100-continue", "websocket", "bytes=0-,0-,5-1", "cross-site", "close"]),
    ),
    max_size=2,
)  # fmt: skip
JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just(10**400)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.sampled_from(["z", "fit", "scan", "landmarks", "tip", "format"]), inner, max_size=3),
    ),
    max_leaves=8,
)  # fmt: skip
BODIES = st.one_of(
    st.just(b""),
    JSON.map(lambda value: json.dumps(value).encode()),
    st.builds(lambda inner: json.dumps({"landmarks": inner}).encode(), JSON),
    st.sampled_from([b"[" * 4000, b"ply\n", b"x" * 6000, b"5\r\nhello\r\n0\r\n\r\n", b"zz\r\n", b"\x00"]),
    st.binary(max_size=40),
)


@dataclass(frozen=True)
class Asked:
    """A request; `sized` says whether it says how long it is, `known` whether it carries the cookies."""

    line: str
    headers: list[tuple[str, str]]
    body: bytes
    sized: bool
    known: bool

    def written(self, at: Target) -> bytes:
        own = {} if any(name == "Host" for name, _ in self.headers) else {"Host": "{}:{}".format(*at.address)}
        if self.known:
            own["Cookie"] = at.cookies
        if self.sized:
            own["Content-Length"] = str(len(self.body))
        lines = [f"{self.line.replace('KIND', f'/view/{at.kind}')} HTTP/1.1"]
        lines += [f"{name}: {value}" for name, value in (*own.items(), *self.headers)]
        return "\r\n".join(lines).encode("latin-1") + b"\r\n\r\n" + self.body


def put_together(route: str, text: str, **rest: Any) -> Asked:
    return Asked(line=route.replace("X", text), **rest)


ASKED = st.builds(
    put_together, route=st.sampled_from(ROUTES), text=TEXT, headers=st.just([]) | HEADERS, body=BODIES,
    sized=st.sampled_from([True, True, True, False]), known=st.sampled_from([True] * 5 + [False]),
)  # fmt: skip


def answered(at: Target, request: bytes) -> bytes:
    """Return the answer to a request, empty where the server closed the connection."""
    came = b""
    with socket.create_connection(at.address, timeout=10) as one:
        try:
            one.sendall(request)
            while b"\r\n\r\n" not in came and (piece := one.recv(2**16)):
                came += piece
        except ConnectionError:
            pass
    return came


def check(at: Target, request: bytes) -> None:
    came = answered(at, request)
    status = int(came.split()[1]) if came else 400
    assert status < 500 or status == 503, came
    assert not at.log, at.log


@MANY
@given(asked=ASKED)
def test_no_request_is_the_fault_of_the_viewer_of_fits(fits: Target, asked: Asked) -> None:
    check(fits, asked.written(fits))


@MANY
@given(asked=ASKED)
def test_no_request_is_the_fault_of_the_viewer_of_surfaces(surfaces: Target, asked: Asked) -> None:
    check(surfaces, asked.written(surfaces))


def test_after_all_that_the_user_is_served(fits: Target, surfaces: Target) -> None:
    for one in (fits, surfaces):
        came = answered(
            one, f"GET /view/{one.kind}/api/about HTTP/1.1\r\nHost: localhost\r\nCookie: {one.cookies}\r\n\r\n".encode()
        )
        assert came.startswith(b"HTTP/1.1 200")
