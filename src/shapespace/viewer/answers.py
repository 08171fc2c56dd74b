"""What the applications of the viewer share: their files, and errors as sentences."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Mapping
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from shapespace.errors import ShapespaceError
from shapespace.schemas import to_json
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
_PLAIN = {"Not Found": "There is nothing at this address.", "Method Not Allowed": "This cannot be done here."}
_PIECE = 2**18
_DISK = "The server could not store what this needs: {}; free some space there and try again."
_BROKEN = "The server met an error of its own; look at the terminal where it runs, and reload the page."


async def asset(request: Request) -> Response:
    """Return a file that pages load."""
    name = request.path_params["name"]
    if name not in ASSETS:
        raise HTTPException(404, "There is no such file.")
    path, kind = ASSETS[name]
    return FileResponse(path, media_type=kind)


def answer(content: object, status: int = 200) -> Response:
    """Return `content` as JSON; numbers that are not finite become null."""
    return JSONResponse(to_json(content), status)


def binary(content: bytes, name: str | None = None) -> StreamingResponse:
    """Return `content`, handed on as it is taken, so that who takes none of it holds next to nothing.

    Args:
        content: of the answer.
        name: of the file that it is to be saved as; None for what the page itself takes.
    """
    headers = {"Content-Length": str(len(content))}
    if name is not None:
        headers["Content-Disposition"] = f'attachment; filename="{name}"'

    async def pieces() -> AsyncGenerator[bytes]:
        for start in range(0, len(content), _PIECE):
            yield content[start : start + _PIECE]

    return StreamingResponse(pieces(), media_type=BINARY, headers=headers)


def application(routes: list[Route], lifespan: Any, told: Callable[[str], str]) -> Starlette:
    """Return an application of `routes`; `told` makes a sentence of ours fit for visitors."""
    app = Starlette(routes=routes, lifespan=lifespan, exception_handlers=_handlers(told))
    # What would be redirected to is made of the Host header.
    app.router.redirect_slashes = False
    return app


def _handlers(told: Callable[[str], str]) -> dict[Any, Callable[[Request, Exception], Any]]:

    async def sentence(_: Request, error: Exception) -> Response:
        return refusal(422, told(str(error)))

    return {
        HTTPException: _http,
        ShapespaceError: sentence,
        ClientDisconnect: _left,
        OSError: _disk,
        Exception: _broken,
    }


async def _http(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return refusal(error.status_code, _PLAIN.get(error.detail, error.detail))


async def _left(_: Request, error: Exception) -> Response:
    return refusal(400, "The upload ended early.")


async def _disk(_: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    return refusal(507, _DISK.format(error.strerror or "its disk failed"))


async def _broken(_: Request, error: Exception) -> Response:
    return refusal(500, _BROKEN)
