"""Responses that both applications of the viewer share: static files, JSON, bytes, and errors as sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute

from shapespace.errors import ShapespaceError
from shapespace.report.render.scene_scripts import SCENE_SCRIPTS
from shapespace.schemas import to_json
from shapespace.viewer.guard import refusal

PAGES = Path(__file__).parent / "assets"
_SHARED = Path(__file__).parents[1] / "report" / "assets"
_VIEWER_SCRIPTS = (
    "page.js", "charts.js", "coefficients-csv.js", "fit-controls.js", "fit-view.js", "viewer.js", "surfaces.js",
    *(f"viewer-{part}.js" for part in ("stage", "model", "compare", "fits", "scan", "uploads", "landmarks")),
)  # fmt: skip
_STUDIO_SCRIPTS = ("studio.js", *(f"studio-{part}.js" for part in (
    "texts", "store", "widgets", "start", "table", "specimens", "jobs", "steps", "questions", "results",
)))  # fmt: skip
ASSETS: Mapping[str, tuple[Path, str]] = {
    "viewer.css": (PAGES / "viewer.css", "text/css"),
    "studio.css": (PAGES / "studio.css", "text/css"),
    **{name: (PAGES / name, "text/javascript") for name in (*_VIEWER_SCRIPTS, *_STUDIO_SCRIPTS)},
    "preact-htm.min.js": (PAGES / "vendor" / "preact-htm.min.js", "text/javascript"),
    "uPlot.iife.min.js": (PAGES / "vendor" / "uPlot.iife.min.js", "text/javascript"),
    "uPlot.min.css": (PAGES / "vendor" / "uPlot.min.css", "text/css"),
    "theme.js": (_SHARED / "theme.js", "text/javascript"),
    "widgets.css": (_SHARED / "widgets.css", "text/css"),
    **{name: (_SHARED / name, "text/javascript") for name in SCENE_SCRIPTS},
    "three.min.js": (_SHARED / "vendor" / "three.min.js", "text/javascript"),
}
"""Path and media type of each static file, by name."""

_MESSAGES = {"Not Found": "There is nothing at this address.", "Method Not Allowed": "This cannot be done here."}
_STORAGE_ERROR = "The server could not store a file: {}; free some space there and try again."
_INTERNAL_ERROR = "The server met an error of its own; look at the terminal where it runs, and reload the page."


def asset(request: Request) -> Response:
    """Return a static file of the page."""
    name = request.path_params["name"]
    if name not in ASSETS:
        raise HTTPException(404, "There is no such file.")
    path, media_type = ASSETS[name]
    return FileResponse(path, media_type=media_type)


def json_response(content: object, status: int = 200) -> Response:
    """Return `content` as JSON; numbers that are not finite become null."""
    return JSONResponse(to_json(content), status)


def binary(content: bytes, file_name: str | None = None) -> Response:
    """Return `content` as bytes, as a download where `file_name` is given."""
    headers = {} if file_name is None else {"Content-Disposition": f'attachment; filename="{file_name}"'}
    return Response(content, media_type="application/octet-stream", headers=headers)


def application(routes: Sequence[BaseRoute], public: Callable[[str], str]) -> Starlette:
    """Return an application of `routes`.

    Args:
        routes: of the application.
        public: removes the folders of this machine from an error message.
    """

    async def input_error(_: Request, error: Exception) -> Response:
        return refusal(422, public(str(error)))

    app = Starlette(
        routes=routes,
        exception_handlers={
            HTTPException: _http_error,
            ShapespaceError: input_error,
            ClientDisconnect: _disconnected,
            OSError: _storage_error,
            Exception: _internal_error,
        },
    )
    # The redirect would repeat the Host header of the request.
    app.router.redirect_slashes = False
    return app


async def _http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return refusal(error.status_code, _MESSAGES.get(error.detail, error.detail))


async def _disconnected(_: Request, error: Exception) -> Response:
    return refusal(400, "The upload ended early.")


async def _storage_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    return refusal(507, _STORAGE_ERROR.format(error.strerror or "its disk failed"))


async def _internal_error(_: Request, error: Exception) -> Response:
    return refusal(500, _INTERNAL_ERROR)
