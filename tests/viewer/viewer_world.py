"""A viewer that really runs, in a thread, and visitors who talk to it."""

import asyncio
import json
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn

from shapespace.batch.workers import start_loading
from shapespace.io.meshes import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.fitting import Worker, fit_upload
from shapespace.viewer.server import make_app
from shapespace.viewer.sessions import Limits, Sessions
from shapespace.viewer.shown import Shown
from synthetic_shapes import blob_model, raw_scan, similarity

VERTICES = 400


@dataclass(frozen=True)
class Running:
    """A viewer that runs."""

    address: str
    sessions: Sessions
    root: Path
    clients: ExitStack

    def stranger(self) -> httpx.Client:
        """Return a browser that has not opened the page."""
        return self.clients.enter_context(httpx.Client(base_url=self.address, timeout=60))

    def visitor(self) -> httpx.Client:
        """Return a browser that has opened the page."""
        client = self.stranger()
        assert client.get("/").status_code == 200
        return client


Start = Callable[..., Running]


@contextmanager
def served(app: Any) -> Iterator[str]:
    """Serve an application in a thread, and give its address."""
    server = uvicorn.Server(
        uvicorn.Config(app, log_level="error", access_log=False, ws="none", timeout_graceful_shutdown=2)
    )
    listening = socket.socket()
    listening.bind(("127.0.0.1", 0))
    listening.listen()
    thread = threading.Thread(target=lambda: asyncio.run(server.serve([listening])))
    thread.start()
    try:
        yield f"http://127.0.0.1:{listening.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()


@contextmanager
def running(shown: Shown, limits: Limits, token: str | None, worker: Worker) -> Iterator[Running]:
    app, sessions = make_app(shown, limits=limits, token=token, worker=worker)
    with served(app) as address:
        try:
            with ExitStack() as clients:
                yield Running(address, sessions, sessions.root, clients)
        finally:
            sessions.closing = True


@pytest.fixture(scope="session")
def model() -> ShapeModel:
    return blob_model(VERTICES)


@pytest.fixture
def start(model: ShapeModel) -> Iterator[Start]:
    """Start a viewer of the model, or of what is given."""
    start_loading(tell=False)
    with ExitStack() as stack:

        def start(
            shown: Shown | None = None,
            *,
            token: str | None = None,
            worker: Worker = fit_upload,
            **limits: Any,
        ) -> Running:
            return stack.enter_context(running(shown or Shown(model, "blobs.h5"), Limits(**limits), token, worker))

        yield start


@pytest.fixture(scope="session")
def scan_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "face one.ply"
    z = [1.0, -0.5, 0.5, 0.8, -0.3]
    scan = raw_scan(z, similarity(3, degrees=8, scale=1.0), vertices=1000, model_vertices=VERTICES, noise_mm=0.1).scan
    write_mesh(path, scan)
    return path


def drop(visitor: httpx.Client, content: bytes, name: str = "scan.ply") -> httpx.Response:
    return visitor.put("/api/scans", params={"name": name}, content=content)


def told(visitor: httpx.Client, key: str) -> list[dict[str, Any]]:
    """Everything the page is told about a scan, until there is no more to come."""
    with visitor.stream("GET", f"/api/scans/{key}/events") as answer:
        assert answer.status_code == 200
        return [json.loads(line[6:]) for line in answer.iter_lines() if line.startswith("data: ")]


def sentence(answer: httpx.Response) -> str:
    text = answer.json()["error"]
    assert isinstance(text, str) and text.endswith(".") and "Traceback" not in text
    return text
