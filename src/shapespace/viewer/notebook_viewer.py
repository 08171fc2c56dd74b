"""The viewer in a cell of a notebook: served on this machine by a thread, let in by a ticket that is good once."""

from __future__ import annotations

import secrets
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from shapespace.batch.save import save_fit
from shapespace.errors import ShapespaceError
from shapespace.viewer.serve import listen, page_address, require_view_extra

if TYPE_CHECKING:
    import uvicorn

    from shapespace.fit.result import FitResult
    from shapespace.model.shape_model import ShapeModel
    from shapespace.viewer.guard import Access

_HOST = "127.0.0.1"
_STARTS_IN_S = 30.0


class NotebookView:
    """A viewer that runs until `close`, or until this process ends; a notebook shows it in place of its repr.

    Args:
        server: that runs in `thread`.
        thread: that serves.
        access: what lets visitors in.
        port: of 127.0.0.1 that it listens at.
        height_px: of the frame in the notebook.
        remove: removes what it shows from disk.
    """

    def __init__(
        self,
        server: uvicorn.Server,
        thread: threading.Thread,
        access: Access,
        port: int,
        height_px: int,
        remove: Callable[[], None],
    ) -> None:
        self._server, self._thread, self._access, self._remove = server, thread, access, remove
        self.port = port
        self.height_px = height_px

    @property
    def address(self) -> str:
        """The address with the token, for a tab of a browser on this machine."""
        return page_address(_HOST, self.port, self._access.token)

    def close(self) -> None:
        """End the viewer, and remove its files; it may be called twice."""
        self._server.should_exit = True
        self._thread.join()
        self._remove()

    def __repr__(self) -> str:
        return f"<shapespace viewer at {self.address}; close() ends it>"

    def _repr_html_(self) -> str:
        # A ticket and not the token, since notebooks are saved and sent with what their cells show. The host is that of
        # the notebook's own page: to browsers localhost and 127.0.0.1 are two sites, which share no cookies.
        frame = f"shapespace-{secrets.token_hex(8)}"
        return (
            f'<iframe id="{frame}" title="shapespace viewer" style="border: 0; '
            f'width: 100%; height: {self.height_px}px">'
            "</iframe><script>(() => {"
            f'const here = ["localhost", "{_HOST}"].includes(location.hostname) ? location.hostname : "{_HOST}";'
            f'document.getElementById("{frame}").src = `http://${{here}}:{self.port}/?token={self._access.ticket()}`;'
            "})();</script>"
            "<p>The viewer runs on the machine of this notebook; from another one forward its port "
            f"{self.port}, or run the cell there.</p>"
        )


def view_model(model: ShapeModel, *, height_px: int) -> NotebookView:
    """Do what `ShapeModel.view` says."""
    return _start(model, None, height_px, lambda: None)


def view_fit(result: FitResult, *, height_px: int) -> NotebookView:
    """Do what `FitResult.view` says."""
    require_view_extra()
    from shapespace.viewer.scratch import new_folder

    folder, remove = new_folder()
    try:
        save_fit(result, folder / "fit", "", stages=True)
        return _start(result.model, folder / "fit", height_px, remove)
    except BaseException:
        remove()
        raise


def _start(model: ShapeModel, folder: Path | None, height_px: int, remove: Callable[[], None]) -> NotebookView:
    require_view_extra()
    import uvicorn

    from shapespace.viewer.connections import server_config
    from shapespace.viewer.guard import Access
    from shapespace.viewer.limits import Limits
    from shapespace.viewer.scratch import sweep
    from shapespace.viewer.server import make_app
    from shapespace.viewer.shown import Shown

    sweep()
    limits = Limits()
    access, listening = Access(limits), listen(_HOST, None)
    port = int(listening.getsockname()[1])
    name = model.file.name if model.file else "model"
    app, sessions = make_app(
        Shown(model, name, folder), limits=limits, access=access, cookie_name=f"shapespace_{port}", framed=True
    )
    started = threading.Event()

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            started.set()

    server = Server(server_config(app, limits))

    def serve() -> None:
        try:
            server.run(sockets=[listening])
        finally:
            sessions.close()
            listening.close()

    thread = threading.Thread(target=serve, name="shapespace viewer", daemon=True)
    thread.start()
    view = NotebookView(server, thread, access, port, height_px, remove)
    if not started.wait(_STARTS_IN_S):
        view.close()
        raise ShapespaceError(
            "The viewer did not start in 30 s; try again, or run shapespace view on the saved result."
        )
    return view
