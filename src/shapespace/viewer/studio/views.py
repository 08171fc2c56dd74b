"""The views of results: surfaces in correspondence, models with their fits, and reports; each is an application."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal

import anyio.to_thread
from starlette._utils import get_route_path
from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Mount, Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.errors import InputError, ShapespaceError
from shapespace.schemas import CorrespondenceRecord
from shapespace.store.manifest import Manifest
from shapespace.version import __version__
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import refusal
from shapespace.viewer.model_view import ModelView
from shapespace.viewer.server import application, asset, html_page, json_response, model_app, route, surfaces_app
from shapespace.viewer.studio.job_commands import OptionLabels

ViewKind = Literal["surfaces", "model", "report"]

REPORT = "report.html"
_MOST_OPEN = 6  # views whose data are in memory at a time
REPORT_HEADERS = {
    # In a tab of its own, the scripts of a report run, but cannot reach the page that links to it.
    "Content-Security-Policy": (
        "sandbox allow-scripts allow-downloads allow-popups; default-src 'none'; script-src 'unsafe-inline' blob:; "
        "style-src 'unsafe-inline'; img-src data: blob:; font-src data:; frame-ancestors 'none'"
    ),
}


def view_kinds(path: Path) -> list[ViewKind]:
    """Return which views a result has, the main one first; none if nothing of it can be shown."""
    if path.is_file():
        return ["report"] if path.suffix == ".html" else ["model"] if path.suffix == ".h5" else []
    kinds: list[ViewKind] = []
    if (path / CorrespondenceRecord.FILE).is_file():
        kinds.append("surfaces")
    elif (path / Manifest.FILE).is_file() or next(path.glob("*.fit.json"), None) is not None:
        kinds.append("model")
    return [*kinds, "report"] if (path / REPORT).is_file() else kinds


def open_view(kind: ViewKind, path: Path, labels: OptionLabels | None = None, model: Path | None = None) -> ASGIApp:
    """Return the application of a view.

    Args:
        kind: kind of the view.
        path: the result.
        labels: labels that replace the names of options in a report, or None.
        model: model of the fits in the folder (default: the one that their records name).

    Raises:
        ShapespaceError: the result cannot be read.
    """
    if kind == "surfaces":
        return surfaces_app(Surfaces(path))
    if kind == "model":
        return model_app(ModelView.open(path, model))
    file = path / REPORT if path.is_dir() else path

    def report(request: Request) -> Response:
        page = file.read_text(encoding="utf-8")
        return HTMLResponse(page if labels is None else labels.page(page), headers=REPORT_HEADERS)

    return application([Route("/", report)], str)


class Views:
    """ASGI application of the views of jobs' results, `/NUMBER/KIND/...`; each is opened when it is first asked for.

    Args:
        result: function that returns the path of the result of a job; None if it has none.
        labels: labels of options in the messages of commands.
    """

    def __init__(self, result: Callable[[int], Path | None], labels: OptionLabels) -> None:
        self._result = result
        self._labels = labels
        self._open: OrderedDict[tuple[ViewKind, Path, int], ASGIApp] = OrderedDict()
        self._lock = threading.Lock()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request of a view."""
        number, kind, *_ = [*get_route_path(scope).lstrip("/").split("/"), ""]
        path = self._result(int(number)) if number.isdigit() and len(number) < 8 else None
        known: list[ViewKind] = [] if path is None else [shown for shown in view_kinds(path) if shown == kind]
        if path is None or not known:
            await refusal(404, "There is no view of this result; reload the studio.")(scope, receive, send)
            return
        try:
            app = await anyio.to_thread.run_sync(lambda: self._app(known[0], path))
        except ShapespaceError as error:
            await refusal(422, self._labels.sentence(str(error)))(scope, receive, send)
            return
        inner = dict(scope, root_path=f"{scope.get('root_path', '')}/{number}/{kind}")
        await app(inner, receive, self._with_labels(send))

    def close(self) -> None:
        """Close all views."""
        with self._lock:
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

    def _app(self, kind: ViewKind, path: Path) -> ASGIApp:
        record = path / CorrespondenceRecord.FILE
        key = (kind, path, (record if record.is_file() else path).stat().st_mtime_ns)
        with self._lock:
            if key not in self._open:
                self._open[key] = open_view(kind, path, self._labels)
            self._open.move_to_end(key)
            while len(self._open) > _MOST_OPEN:
                self._open.popitem(last=False)
            return self._open[key]


def single_result_app(name: str, views: Mapping[ViewKind, ASGIApp]) -> ASGIApp:
    """Return the application of the page that only shows one result.

    Args:
        name: name of the result on the page.
        views: the views of the result, the main one first.
    """
    hrefs = [{"kind": kind, "href": f"/view/{kind}/"} for kind in views]
    result = {"number": 1, "output": name, "views": hrefs, "sentences": []}
    state: dict[str, object] = {
        "version": __version__,
        "project": None,
        "result": result,
        "recent": [],
        "read_only": True,
    }
    return application(
        [
            route("/", lambda _: html_page()),
            Route("/assets/{name}", asset),
            route("/api/project", lambda _: json_response(state)),
            *(Mount(f"/view/{kind}", app=app) for kind, app in views.items()),
        ],
        str,
    )


def result_path(folder: Path, output: str) -> Path:
    """Return the path of a result in a project.

    Raises:
        InputError: it would lie elsewhere.
    """
    path = (folder / output).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise InputError("This file is not in the project.")
    return path
