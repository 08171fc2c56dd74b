"""Models with their fits, and surfaces, as applications that send the data of the page; parts that all share."""

from __future__ import annotations

import asyncio
import tempfile
import unicodedata
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import aclosing
from functools import partial
from pathlib import Path
from typing import Any, cast

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp

from shapespace.errors import ShapespaceError
from shapespace.io.containers.json_files import plain_json
from shapespace.io.files import read_bytes
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.render.scene import scripts
from shapespace.schemas import to_json
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import refusal
from shapespace.viewer.model_view import ModelView, shape_of

EXPORTS = ("ply", "obj", "stl")
_MAX_NAME = 120  # characters of a file's name on the page, so that it fits one line
_EXPORT_BYTES = 2**20  # bytes of a request for an exported shape; 10,000 coefficients have 200,000


def model_app(view: ModelView) -> ASGIApp:
    """Return the application with the data of a model and its saved fits."""
    return application(
        [
            Route("/api/about", partial(_about, view)),
            route("/api/model", lambda _: binary(view.packed_model())),
            route("/api/fits", lambda _: json_response(view.fit_list())),
            Route("/api/fits/{name}", partial(_fit, view)),
            Route("/api/export", partial(_export, view), methods=["POST"]),
        ],
        view.public,
    )


def _about(view: ModelView, request: Request) -> Response:
    model = view.model
    return json_response(
        {
            "model": view.model_name,
            "modes": model.n_modes,
            "modes_sent": view.n_modes_sent,
            "stddev": model.stddev.tolist(),
            "vertices": model.n_vertices,
            "has_fits": view.folder is not None,
            "exports": [kind for kind in EXPORTS if model.faces is not None or kind != "stl"],
        }
    )


def _fit(view: ModelView, request: Request) -> Response:
    try:
        return binary(view.packed_fit(request.path_params["name"]))
    except KeyError:
        raise HTTPException(
            404, "There is no such fit; reload the page to see the current fits of the folder."
        ) from None


async def _export(view: ModelView, request: Request) -> Response:
    kind = request.query_params.get("format", "")
    if kind not in EXPORTS:
        raise HTTPException(400, f"There is no export as {kind[:20]!r}; choose one of {', '.join(EXPORTS)}.")
    content = await json_body(request, _EXPORT_BYTES)
    return binary(await asyncio.to_thread(_exported, view, kind, content), f"shape.{kind}")


def _exported(view: ModelView, kind: str, content: Mapping[str, Any]) -> bytes:
    fit, z = content.get("fit"), content.get("z")
    if isinstance(fit, str):
        try:
            mesh = view.fitted_mesh(fit, dense=content.get("stage") == "dense")
        except KeyError:
            raise HTTPException(404, "There is no such fit.") from None
    elif _is_numbers(z):
        mesh = shape_of(view.model, cast(list[float], z))
    else:
        raise HTTPException(400, "An export needs z, a list of numbers in standard deviations.")
    with tempfile.TemporaryDirectory(prefix="shapespace-export-") as folder:
        path = Path(folder) / f"shape.{kind}"
        write_mesh(path, mesh)
        return read_bytes(path)


async def json_body(request: Request, max_bytes: int) -> Mapping[str, Any]:
    """Return the JSON object in the body of `request`, and reject anything else with 400 or 413."""
    try:
        content: object = plain_json(await whole_body(request, max_bytes, "The request is too long."))
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise HTTPException(400, "The request is not a JSON object.")
    return cast(Mapping[str, Any], content)


async def whole_body(request: Request, max_bytes: int, too_large: str) -> bytes:
    """Return the body of `request`; see `body_pieces` for the arguments."""
    async with aclosing(body_pieces(request, max_bytes, too_large)) as pieces:
        return b"".join([piece async for piece in pieces])


async def body_pieces(request: Request, max_bytes: int, too_large: str) -> AsyncGenerator[bytes]:
    """Yield the body of `request`, and reject it with 413 and the sentence `too_large` beyond `max_bytes`."""
    announced = request.headers.get("content-length", "")
    if len(announced) > 15 or (announced.isdigit() and announced.isascii() and int(announced) > max_bytes):
        raise HTTPException(413, too_large)
    size = 0
    async for piece in request.stream():
        size += len(piece)
        if size > max_bytes:
            raise HTTPException(413, too_large)
        yield piece


def _is_numbers(value: object) -> bool:
    if not isinstance(value, list):
        return False
    items = cast(list[object], value)
    return all(isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < 1e9 for x in items)


def display_name(name: str) -> str:
    """Return the last part of a file name, without unprintable characters."""
    last = name.replace("\\", "/").rpartition("/")[2]
    plain = "".join(c for c in unicodedata.normalize("NFC", last) if c.isprintable())
    stem, dot, ending = plain.rpartition(".")
    return f"{stem[:_MAX_NAME]}{dot}{ending[:10]}" or "The file"


_MAX_QUERY = 2000  # characters; bounds the work of one request


def surfaces_app(surfaces: Surfaces) -> ASGIApp:
    """Return the application with the data of surfaces in correspondence."""

    def of_scan(pack: Callable[[str], bytes]) -> Callable[[Request], Response]:
        def answer(request: Request) -> Response:
            try:
                return binary(pack(request.path_params["name"]))
            except KeyError:
                raise HTTPException(404, "There is no such scan in correspondence; reload the page.") from None

        return answer

    def positions(request: Request) -> Response:
        numbers = request.query_params.get("vertices", "")[:_MAX_QUERY].split(",")
        if not all(part.isascii() and part.isdigit() for part in numbers):
            raise HTTPException(400, "Give the numbers of vertices with commas between them.")
        return binary(surfaces.positions_csv([int(part) for part in numbers]).encode(), "places.csv")

    routes = [
        route("/api/about", lambda _: json_response(surfaces.about())),
        route("/api/mean", lambda _: binary(surfaces.packed_mean())),
        route("/api/population", lambda _: binary(surfaces.packed_population())),
        route("/api/names", lambda _: json_response(surfaces.names())),
        route("/api/surfaces", lambda _: json_response(surfaces.rows())),
        Route("/api/surfaces/{name}", of_scan(surfaces.packed_surface)),
        Route("/api/faults/{name}", of_scan(surfaces.packed_faults)),
        Route("/api/places", positions),
    ]
    return application(routes, surfaces.public)


PAGES = Path(__file__).parent / "assets"
_SHARED = Path(__file__).parents[1] / "report" / "assets"
SCENE = "scene.js"
"""The scripts of views and widgets as one; see `report.render.scene.scripts`."""
ASSETS: Mapping[str, Path] = {
    path.name: path
    for path in (
        *PAGES.glob("*.js"), *PAGES.glob("*.css"), *PAGES.glob("vendor/*"),
        *(_SHARED / name for name in ("theme.js", "report.js", "report.css", "widgets.css")),
    )
    if path.suffix in (".js", ".css")
}  # fmt: skip
"""Path of each other static file, by name."""
_MEDIA_TYPES = {".js": "text/javascript", ".css": "text/css"}

_MESSAGES = {"Not Found": "There is nothing at this address.", "Method Not Allowed": "This cannot be done here."}
_STORAGE_ERROR = "The server could not store a file: {}; free some space there and try again."
_INTERNAL_ERROR = "The server met an error of its own; look at the terminal where it runs, and reload the page."


def asset(request: Request) -> Response:
    """Return a static file of the page."""
    name = request.path_params["name"]
    if name == SCENE:
        return Response(scripts(), media_type=_MEDIA_TYPES[".js"])
    if name not in ASSETS:
        raise HTTPException(404, "There is no such file.")
    return FileResponse(ASSETS[name], media_type=_MEDIA_TYPES[ASSETS[name].suffix])


def route(path: str, answer: Callable[[Request], Response]) -> Route:
    """Return the route of a path."""
    return Route(path, answer)


def html_page() -> Response:
    """Return the page of the browser application."""
    return FileResponse(PAGES / "studio.html", media_type="text/html")


def json_response(content: object, status: int = 200) -> Response:
    """Return `content` as JSON; numbers that are not finite become null."""
    return JSONResponse(to_json(content), status)


def binary(content: bytes, file_name: str | None = None) -> Response:
    """Return `content` as bytes, as a download if `file_name` is given."""
    headers = {} if file_name is None else {"Content-Disposition": f'attachment; filename="{file_name}"'}
    return Response(content, media_type="application/octet-stream", headers=headers)


def application(routes: Sequence[BaseRoute], public: Callable[[str], str]) -> Starlette:
    """Return an application of `routes`.

    Args:
        routes: routes of the application.
        public: function that removes the folders of this machine from an error message.
    """
    app = Starlette(
        routes=routes,
        exception_handlers={
            HTTPException: _http_error,
            ShapespaceError: lambda _, error: refusal(422, public(str(error))),
            ClientDisconnect: lambda _, __: refusal(400, "The upload ended early."),
            OSError: _storage_error,
            Exception: lambda _, __: refusal(500, _INTERNAL_ERROR),
        },
    )
    # The redirect would repeat the Host header of the request.
    app.router.redirect_slashes = False
    return app


async def _http_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return refusal(error.status_code, _MESSAGES.get(error.detail, error.detail))


async def _storage_error(_: Request, error: Exception) -> Response:
    assert isinstance(error, OSError)
    return refusal(507, _STORAGE_ERROR.format(error.strerror or "its disk failed"))
