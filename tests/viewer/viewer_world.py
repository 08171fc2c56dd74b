"""A viewer that runs in a thread, and clients that talk to it."""

import json
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.batch.workers import start_loading
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.viewer.fitting import Upload, Worker, fit_upload
from shapespace.viewer.guard import Access
from shapespace.viewer.model_view import ModelView
from shapespace.viewer.serve import make_server
from shapespace.viewer.server import make_app
from shapespace.viewer.uploaded_scans import Scans, UploadLimits
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
    scans: Scans
    access: Access
    clients: ExitStack = field(default_factory=ExitStack)

    @property
    def root(self) -> Path:
        return self.scans.root

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
def running(view: ModelView, limits: UploadLimits, worker: Worker, loopback: bool = True) -> Iterator[Running]:
    access = Access()
    with tempfile.TemporaryDirectory() as root, ExitStack() as clients:
        scans = Scans(Path(root), view.model, view.model_name, limits, worker=worker)
        clients.callback(scans.close)
        with served(make_app(view, scans, access, loopback=loopback)) as address:
            yield Running(address, scans, access, clients)


@pytest.fixture(scope="session")
def model() -> ShapeModel:
    return blob_model(VERTICES)


@pytest.fixture
def start(model: ShapeModel) -> Iterator[Start]:
    """Start a viewer of `model` or of another view."""
    start_loading(notify=False)
    with ExitStack() as stack:

        def start(
            view: ModelView | None = None,
            *,
            worker: Worker = fit_upload,
            loopback: bool = True,
            **limits: Any,
        ) -> Running:
            view = view or ModelView(model, "blobs.h5")
            return stack.enter_context(running(view, UploadLimits(**limits), worker, loopback))

        yield start


@pytest.fixture(scope="session")
def scan_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "face one.ply"
    z = [1.0, -0.5, 0.5, 0.8, -0.3]
    scan = raw_scan(z, similarity(3, degrees=8, scale=1.0), vertices=1000, model_vertices=VERTICES, noise_mm=0.1).scan
    write_mesh(path, scan)
    return path


def agrees(pipe: Connection, upload: Upload) -> None:
    """Converge without a fit."""
    pipe.send_bytes(json.dumps({"event": "verdict", "status": "converged", "reason": "It is good."}).encode())
    time.sleep(60)


def waits(pipe: Connection, upload: Upload) -> None:
    """Never end."""
    time.sleep(60)


def upload(client: httpx.Client, content: bytes, name: str = "scan.ply") -> httpx.Response:
    return client.put("/api/scans", params={"name": name}, content=content)


def wait_for_events(client: httpx.Client, key: str) -> list[dict[str, Any]]:
    """Return all messages of a fit once it is done, and then the state of the scan."""
    until(lambda: progress(client, key)["state"] == "done", 60)
    done = progress(client, key)
    return [*done.pop("events"), done]


def progress(client: httpx.Client, key: str) -> dict[str, Any]:
    return client.get(f"/api/scans/{key}/progress").json()


def until(condition: Callable[[], object], seconds: float = 15) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def sentence(response: httpx.Response) -> str:
    text = response.json()["error"]
    assert isinstance(text, str) and text.endswith(".") and "Traceback" not in text
    return text
