"""The viewer in a notebook cell: a thread serves it on this machine; the cell's output contains a one-time ticket."""

from __future__ import annotations

import secrets
import threading
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from shapespace.batch.fit_work import save_fit
from shapespace.viewer.serve import listen, make_server, page_address, require_view_extra

if TYPE_CHECKING:
    import uvicorn

    from shapespace.fit.result import FitResult
    from shapespace.model.shape_model import ShapeModel
    from shapespace.viewer.guard import Access

_HOST = "127.0.0.1"


class NotebookView:
    """A viewer that runs until `close` or the end of this process; a notebook shows it in a frame.

    Args:
        server: server that runs in `thread`.
        thread: thread of the server.
        access: secrets of this viewer.
        port: port at 127.0.0.1.
        height_px: height of the frame in the notebook, pixels.
        resources: resources that are closed with the viewer.
    """

    def __init__(
        self,
        server: uvicorn.Server,
        thread: threading.Thread,
        access: Access,
        port: int,
        height_px: int,
        resources: ExitStack,
    ) -> None:
        self._server, self._thread, self._access, self._resources = server, thread, access, resources
        self.port, self.height_px = port, height_px

    @property
    def address(self) -> str:
        """The address with the token, for a browser on this machine."""
        return page_address(_HOST, self.port, self._access.token)

    def close(self) -> None:
        """Stop the viewer and remove its files; further calls do nothing."""
        self._server.should_exit = True
        self._thread.join()
        self._resources.close()

    def __repr__(self) -> str:
        return f"<shapespace viewer at {self.address}; close() ends it>"

    def _repr_html_(self) -> str:
        # The host is that of the notebook's own page: to browsers localhost and 127.0.0.1 are two sites, which share no
        # cookies.
        frame = f"shapespace-{secrets.token_hex(8)}"
        return (
            f'<iframe id="{frame}" title="shapespace viewer" style="border: 0; '
            f'width: 100%; height: {self.height_px}px">'
            "</iframe><script>(() => {"
            f'const here = ["localhost", "{_HOST}"].includes(location.hostname) ? location.hostname : "{_HOST}";'
            f'document.getElementById("{frame}").src = `http://${{here}}:{self.port}/?token={self._access.new_ticket()}`;'
            "})();</script>"
            "<p>The viewer runs on the machine of this notebook; from another one forward its port "
            f"{self.port}, or run the cell there.</p>"
        )


def view_model(model: ShapeModel, *, height_px: int) -> NotebookView:
    """Show a model; see `ShapeModel.view`."""
    return _start(model, None, height_px)


def view_fit(result: FitResult, *, height_px: int) -> NotebookView:
    """Show a fit; see `FitResult.view`."""
    return _start(result.model, result, height_px)


def _start(model: ShapeModel, result: FitResult | None, height_px: int) -> NotebookView:
    require_view_extra()
    from shapespace.viewer.guard import Access, Guard
    from shapespace.viewer.model_view import ModelView
    from shapespace.viewer.server import model_app
    from shapespace.viewer.studio.views import single_result_app

    access, name = Access(), model.file.name if model.file else "model"
    with ExitStack() as stack:
        folder = None
        if result is not None:
            root = stack.enter_context(TemporaryDirectory(prefix="shapespace-view-", ignore_cleanup_errors=True))
            folder = Path(root) / "fits"
            save_fit(result, folder, "", stages=True)
        listener = stack.enter_context(listen(_HOST, None))
        port = int(listener.getsockname()[1])
        page = single_result_app(name, {"model": model_app(ModelView(model, name, folder))})
        app = Guard(page, access=access, cookie_name=f"shapespace_{port}", loopback=True, framed=True)
        server = make_server(app)
        thread = threading.Thread(
            target=server.run, kwargs={"sockets": [listener]}, name="shapespace viewer", daemon=True
        )
        thread.start()
        return NotebookView(server, thread, access, port, height_px, stack.pop_all())
