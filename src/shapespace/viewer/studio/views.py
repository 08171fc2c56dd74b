"""The pages of results in the studio: those of the viewer, and the reports of analyses, under `/view/NUMBER/`."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import anyio.to_thread
from starlette._utils import get_route_path
from starlette.datastructures import MutableHeaders
from starlette.responses import HTMLResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.errors import InputError, ShapespaceError
from shapespace.schemas import CorrespondenceRecord
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import refusal
from shapespace.viewer.model_view import ModelView
from shapespace.viewer.server import model_app, surfaces_app
from shapespace.viewer.studio.job_commands import OptionLabels
from shapespace.viewer.uploaded_scans import FOLDER_PREFIX, Scans, UploadLimits

REPORT, REPORT_PAGE = "report.html", "report"
_MOST_OPEN = 6  # pages whose data are in memory at a time
REPORT_HEADERS = {
    # A report is a page of its own: its scripts run, but cannot reach the studio.
    "Content-Security-Policy": (
        "sandbox allow-scripts allow-downloads allow-popups; default-src 'none'; script-src 'unsafe-inline' blob:; "
        "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; frame-ancestors 'self'"
    ),
}


def view_kinds(path: Path) -> list[str]:
    """Return which pages show a result: `surfaces`, `model`, `report`; the first one is that of `/view/NUMBER/`."""
    if path.is_file():
        return ["report"] if path.name == REPORT else ["model"] if path.suffix == ".h5" else []
    kinds: list[str] = []
    if (path / CorrespondenceRecord.FILE).is_file():
        kinds.append("surfaces")
    elif next(path.glob("*.fit.json"), None) is not None:
        kinds.append("model")
    return [*kinds, "report"] if (path / REPORT).is_file() else kinds


class Views:
    """ASGI application of the pages of results, opened when they are first asked for.

    Args:
        result: function that returns the path of the result of a job; None if it has none.
        upload_bytes: size limit of scans that are dropped onto a model's page.
        labels: labels of options in the messages of commands.
    """

    def __init__(self, result: Callable[[int], Path | None], upload_bytes: int, labels: OptionLabels) -> None:
        self._result = result
        self._labels = labels
        self._upload_bytes = upload_bytes
        self._open: OrderedDict[tuple[Path, int], tuple[ASGIApp, ExitStack]] = OrderedDict()
        self._lock = threading.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request of a page."""
        number, _, rest = get_route_path(scope).lstrip("/").partition("/")
        path = self._result(int(number)) if number.isdigit() and len(number) < 8 else None
        kinds = [] if path is None else view_kinds(path)
        if path is None or not kinds:
            await refusal(404, "There is no page of this result; reload the studio.")(scope, receive, send)
        elif "report" in kinds and (kinds[0] == "report" or rest == f"{REPORT_PAGE}/"):
            file = path if path.name == REPORT else path / REPORT
            page = await anyio.to_thread.run_sync(lambda: self._labels.page(file.read_text(encoding="utf-8")))
            await HTMLResponse(page, headers=REPORT_HEADERS)(scope, receive, send)
        else:
            try:
                app = await anyio.to_thread.run_sync(self._app, path)
            except ShapespaceError as error:
                await refusal(422, str(error))(scope, receive, send)
                return
            inner = dict(scope, root_path=f"{scope.get('root_path', '')}/{number}")
            if not rest:
                # Of the page itself, whose addresses are relative to the folder.
                inner["path"] = f"{inner['root_path']}/"
            await app(inner, receive, self._with_labels(send))

    def close(self) -> None:
        """Close all pages."""
        with self._lock:
            for _, stack in self._open.values():
                stack.close()
            self._open.clear()

    def _with_labels(self, send: Send) -> Send:
        """Return a function that sends a response, of which JSON gets labels of options."""
        held: list[Message] = []

        async def send_message(message: Message) -> None:
            if (
                message["type"] == "http.response.start"
                and (b"content-type", b"application/json") in message["headers"]
            ):
                held.append(message)
                return
            if held:
                start, message = (
                    held.pop(),
                    {**message, "body": self._labels.sentence(message["body"].decode()).encode()},
                )
                MutableHeaders(scope=start)["content-length"] = str(len(message["body"]))
                await send(start)
            await send(message)

        return send_message

    def _app(self, path: Path) -> ASGIApp:
        record = path / CorrespondenceRecord.FILE
        key = (path, (record if record.is_file() else path).stat().st_mtime_ns)
        with self._lock:
            if key not in self._open:
                stack = ExitStack()
                self._open[key] = (self._make_app(path, stack), stack)
            self._open.move_to_end(key)
            while len(self._open) > _MOST_OPEN:
                self._open.popitem(last=False)[1][1].close()
            return self._open[key][0]

    def _make_app(self, path: Path, stack: ExitStack) -> ASGIApp:
        if (path / CorrespondenceRecord.FILE).is_file():
            return surfaces_app(Surfaces(path))
        view = ModelView.open(path)
        root = Path(stack.enter_context(TemporaryDirectory(prefix=FOLDER_PREFIX, ignore_cleanup_errors=True)))
        scans = Scans(root, view.model, view.model_name, UploadLimits(upload_bytes=self._upload_bytes))
        stack.callback(scans.close)
        return model_app(view, scans)


def result_path(folder: Path, output: str) -> Path:
    """Return the path of a result in a project.

    Raises:
        InputError: it would lie elsewhere.
    """
    path = (folder / output).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise InputError("This file is not in the project.")
    return path
