"""A viewer that really runs, in a thread, and visitors who talk to it."""

import asyncio
import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import uvicorn

from shapespace.batch.workers import start_loading
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.connections import server_config
from shapespace.viewer.fitting import Worker, fit_upload
from shapespace.viewer.guard import Access
from shapespace.viewer.limits import Limits
from shapespace.viewer.server import make_app
from shapespace.viewer.sessions import Sessions
from shapespace.viewer.shown import Shown
from synthetic_shapes import blob_model, raw_scan, similarity

VERTICES = 400


def unpacked(content: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """As scene.js reads it."""
    (length,) = struct.unpack("<I", content[:4])
    header = json.loads(content[4 : 4 + length])
    start, arrays = 8 * -(-(4 + length) // 8), {}
    for name, spec in header["arrays"].items():
        count = int(np.prod(spec["shape"]))
        at = start + spec["offset"]
        if "coded" in spec:
            columns = spec["shape"][-1]
            planes = np.frombuffer(content, np.uint8, 2 * count, at).reshape(columns, 2, -1).astype(np.uint16)
            zigzag = (planes[:, 0] | planes[:, 1] << 8).astype(np.int32)
            steps = np.where(zigzag & 1, -(zigzag >> 1) - 1, zigzag >> 1)
            values = np.cumsum(steps, axis=1).astype(np.int16).T
        else:
            values = np.frombuffer(content, spec["dtype"], count, at).reshape(spec["shape"])
        if "scale" in spec:
            values = np.where(values == -32768, np.nan, values * spec["scale"])
        arrays[name] = values
    return header["facts"], arrays


@dataclass(frozen=True)
class Running:
    """A viewer that runs."""

    address: str
    sessions: Sessions
    root: Path
    access: Access
    clients: ExitStack = field(default_factory=ExitStack)

    def outsider(self) -> httpx.Client:
        """Return a browser that does not know the token."""
        return self.clients.enter_context(httpx.Client(base_url=self.address, timeout=60))

    def stranger(self) -> httpx.Client:
        """Return a browser that has been let in, and has not opened the page."""
        client = self.outsider()
        enter(client, self.access)
        return client

    def visitor(self) -> httpx.Client:
        """Return a browser that has opened the page."""
        client = self.stranger()
        assert client.get("/").status_code == 200
        return client


def enter(client: httpx.Client, access: Access) -> None:
    """Exchange the token for the cookie."""
    assert client.get("/", params={"token": access.token}).status_code == 303


Start = Callable[..., Running]


@contextmanager
def served(app: Any, limits: Limits | None = None) -> Iterator[str]:
    """Serve an application in a thread, and give its address."""
    server = uvicorn.Server(server_config(app, limits or Limits()))
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
def running(shown: Shown, limits: Limits, worker: Worker, local: bool = True) -> Iterator[Running]:
    access = Access(limits)
    app, sessions = make_app(shown, limits=limits, access=access, local=local, worker=worker)
    with served(app, limits) as address:
        try:
            with ExitStack() as clients:
                yield Running(address, sessions, sessions.root, access, clients)
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
            worker: Worker = fit_upload,
            local: bool = True,
            **limits: Any,
        ) -> Running:
            return stack.enter_context(running(shown or Shown(model, "blobs.h5"), Limits(**limits), worker, local))

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
