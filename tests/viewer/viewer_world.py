"""A viewer that runs in a thread, and clients that talk to it."""

import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.guard import Access, Guard
from shapespace.viewer.model_view import ModelView
from shapespace.viewer.serve import make_server
from shapespace.viewer.server import model_app
from shapespace.viewer.studio.views import single_result_app
from synthetic_shapes import blob_model, raw_scan, similarity

VERTICES = 400


def unpacked(content: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """As scene-data.js reads it."""
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
    access: Access
    clients: ExitStack = field(default_factory=ExitStack)

    def outsider(self) -> httpx.Client:
        """Return a browser without the token."""
        return self.clients.enter_context(httpx.Client(base_url=self.address, timeout=60))

    def user(self) -> httpx.Client:
        """Return a browser that has exchanged the token for the cookie."""
        client = self.outsider()
        enter(client, self.access)
        return client


def enter(client: httpx.Client, access: Access) -> None:
    """Exchange the token for the cookie."""
    assert client.get("/", params={"token": access.token}).status_code == 303


Start = Callable[..., Running]


@contextmanager
def served(app: Any) -> Iterator[str]:
    """Serve an application in a thread, and yield its address."""
    server = make_server(app)
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()


@contextmanager
def running(view: ModelView, loopback: bool = True) -> Iterator[Running]:
    access = Access()
    page = single_result_app(view.model_name, {"model": model_app(view)})
    app = Guard(page, access=access, cookie_name="shapespace", loopback=loopback)
    with ExitStack() as clients, served(app) as address:
        yield Running(address, access, clients)


@pytest.fixture(scope="session")
def model() -> ShapeModel:
    return blob_model(VERTICES)


@pytest.fixture
def start(model: ShapeModel) -> Iterator[Start]:
    """Start a viewer of `model` or of another view."""
    with ExitStack() as stack:

        def start(view: ModelView | None = None, *, loopback: bool = True) -> Running:
            return stack.enter_context(running(view or ModelView(model, "blobs.h5"), loopback))

        yield start


@pytest.fixture(scope="session")
def scan_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "face one.ply"
    z = [1.0, -0.5, 0.5, 0.8, -0.3]
    scan = raw_scan(z, similarity(3, degrees=8, scale=1.0), vertices=1000, model_vertices=VERTICES, noise_mm=0.1).scan
    write_mesh(path, scan)
    return path


def until(condition: Callable[[], object], seconds: float = 15) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def sentence(response: httpx.Response) -> str:
    text = response.json()["error"]
    assert isinstance(text, str) and text.endswith(".") and "Traceback" not in text
    return text
