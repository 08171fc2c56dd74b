"""What the applications of the viewer share: their files, and errors as sentences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, Response

from shapespace.errors import ShapespaceError
from shapespace.viewer.guard import refusal

PAGES = Path(__file__).parent / "assets"
_SHARED = Path(__file__).parents[1] / "report" / "assets"
ASSETS: Mapping[str, tuple[Path, str]] = {
    "viewer.css": (PAGES / "viewer.css", "text/css"),
    "page.js": (PAGES / "page.js", "text/javascript"),
    "charts.js": (PAGES / "charts.js", "text/javascript"),
    "fit-view.js": (PAGES / "fit-view.js", "text/javascript"),
    "viewer.js": (PAGES / "viewer.js", "text/javascript"),
    "surfaces.js": (PAGES / "surfaces.js", "text/javascript"),
    "theme.js": (_SHARED / "theme.js", "text/javascript"),
    "widgets.css": (_SHARED / "widgets.css", "text/css"),
    "scene.js": (_SHARED / "scene.js", "text/javascript"),
    "three.min.js": (_SHARED / "vendor" / "three.min.js", "text/javascript"),
}
"""What a page may load, by name."""

BINARY = "application/octet-stream"
_BROKEN = "The server met an error of its own; look at the terminal where it runs, and reload the page."


async def asset(request: Request) -> Response:
    """Return a file that pages load."""
    name = request.path_params["name"]
    if name not in ASSETS:
        raise HTTPException(404, "There is no such file.")
    path, kind = ASSETS[name]
    return FileResponse(path, media_type=kind)


def download(content: bytes, name: str) -> Response:
    """Return `content` as a file to be saved as `name`."""
    return Response(content, media_type=BINARY, headers={"Content-Disposition": f'attachment; filename="{name}"'})


def handlers(told: Callable[[str], str]) -> dict[Any, Callable[[Request, Exception], Any]]:
    """Return what answers errors, each with one sentence; `told` makes one of our own fit for visitors."""

    async def sentence(_: Request, error: Exception) -> Response:
        return refusal(422, told(str(error)))

    return {HTTPException: _http, ShapespaceError: sentence, ClientDisconnect: _left, Exception: _broken}


async def _http(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    plain = "There is nothing at this address." if error.detail == "Not Found" else error.detail
    return refusal(error.status_code, plain)


async def _left(_: Request, error: Exception) -> Response:
    return refusal(400, "The upload ended early.")


async def _broken(_: Request, error: Exception) -> Response:
    return refusal(500, _BROKEN)
