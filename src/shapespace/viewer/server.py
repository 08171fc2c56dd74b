"""The viewer's application: the page, its model and fits, and the scans that the user uploads."""

from __future__ import annotations

import asyncio
import secrets
import shutil
import tempfile
import unicodedata
from collections.abc import AsyncGenerator, Callable, Mapping, Sequence
from contextlib import aclosing
from pathlib import Path
from typing import Any, cast

import numpy as np
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import BaseRoute, Route
from starlette.types import ASGIApp

from shapespace.errors import FileError, ShapespaceError
from shapespace.io.containers.json_files import plain_json
from shapespace.io.files import read_bytes
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, read_mesh, write_mesh
from shapespace.report.render import palette as colours
from shapespace.report.render.scene import SCENE_SCRIPTS
from shapespace.schemas import to_json
from shapespace.types import Mesh
from shapespace.version import __version__
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.fitting import NAME, PICTURE, PREVIEW
from shapespace.viewer.guard import Access, Guard, refusal
from shapespace.viewer.model_view import ModelView, shape_of
from shapespace.viewer.uploaded_scans import MIN_LANDMARKS, Scans, UploadedScan

EXPORTS = ("ply", "obj", "stl")
_MAX_NAME = 120  # characters of a file's name on the page, so that it fits one line
_NO_SCAN = "There is no such scan; it was removed."
_QUEUE_FULL = "{} scans are being fitted or wait; wait for one, or stop one."


def make_app(
    view: ModelView,
    scans: Scans,
    access: Access,
    *,
    loopback: bool = True,
    cookie_name: str = "shapespace",
    framed: bool = False,
) -> ASGIApp:
    """Return the application behind a guard.

    Args:
        view: the model and the saved fits.
        scans: the uploaded scans.
        access: the secrets of this viewer.
        loopback: whether only this machine can reach the server.
        cookie_name: browsers share cookies between ports, so the name should contain the port.
        framed: whether notebooks on this machine may show the page in a frame.
    """
    app = model_app(view, scans)
    return Guard(app, access=access, cookie_name=cookie_name, loopback=loopback, framed=framed)


def model_app(view: ModelView, scans: Scans) -> ASGIApp:
    """Return the application of a model, its saved fits and the uploaded scans."""
    return application(_Endpoints(view, scans).routes(), view.public)


class _Endpoints:
    def __init__(self, view: ModelView, scans: Scans) -> None:
        self._view = view
        self._scans = scans
        self._uploading = 0

    def routes(self) -> list[Route]:
        scan = "/api/scans/{key}"
        return [
            route("/", lambda _: html_page("viewer")),
            Route("/assets/{name}", asset),
            Route("/api/about", self.about),
            route("/api/model", lambda _: binary(self._view.packed_model())),
            route("/api/fits", lambda _: json_response(self._view.fit_list())),
            Route("/api/fits/{name}", self.fit),
            Route("/api/export", self.export, methods=["POST"]),
            route("/api/scans", lambda _: json_response([scan.facts() for scan in self._scans.all()])),
            Route("/api/scans", self.upload, methods=["PUT"]),
            Route(scan, self.remove, methods=["DELETE"]),
            Route(f"{scan}/progress", self.progress),
            Route(f"{scan}/preview", self.preview),
            Route(f"{scan}/picture", self.picture),
            Route(f"{scan}/record", self.record),
            Route(f"{scan}/landmarks", self.landmarks, methods=["POST"]),
            Route(f"{scan}/cancel", self.cancel, methods=["POST"]),
        ]

    # The model and the saved fits

    def about(self, request: Request) -> Response:
        model, limits = self._view.model, self._scans.limits
        return json_response(
            {
                "version": __version__,
                "model": self._view.model_name,
                "modes": model.n_modes,
                "modes_sent": self._view.n_modes_sent,
                "stddev": model.stddev.tolist(),
                "vertices": model.n_vertices,
                "triangles": 0 if model.faces is None else len(model.faces),
                "landmarks": list(model.landmarks),
                "has_fits": self._view.folder is not None,
                "upload_bytes": limits.upload_bytes,
                "unfinished": limits.unfinished,
                "kept": limits.max_fits,
                "formats": list(MESH_ENDINGS),
                "exports": [kind for kind in EXPORTS if model.faces is not None or kind != "stl"],
                "sequential": colours.as_list(colours.SEQUENTIAL),
                "diverging": colours.as_list(colours.DIVERGING),
                "clay": colours.CLAY,
                "scan_colour": colours.SCAN_COLOUR,
                "model_colour": colours.MODEL_COLOUR,
                "region_colours": dict(colours.REGION_COLOURS),
                "unknown_colour": colours.UNKNOWN_COLOUR,
                "signal_colour": colours.BEYOND_COLOUR,
            }
        )

    def fit(self, request: Request) -> Response:
        try:
            return binary(self._view.packed_fit(request.path_params["name"]))
        except KeyError:
            raise HTTPException(
                404, "There is no such fit; reload the page to see the current fits of the folder."
            ) from None

    async def export(self, request: Request) -> Response:
        kind = request.query_params.get("format", "")
        if kind not in EXPORTS:
            raise HTTPException(400, f"There is no export as {kind[:20]!r}; choose one of {', '.join(EXPORTS)}.")
        content = await self._json(request)
        return binary(await asyncio.to_thread(self._export, kind, content), f"shape.{kind}")

    def _export(self, kind: str, content: Mapping[str, Any]) -> bytes:
        mesh = self._requested_mesh(content)
        with tempfile.TemporaryDirectory(prefix="export-", dir=self._scans.root) as folder:
            path = Path(folder) / f"shape.{kind}"
            write_mesh(path, mesh)
            return read_bytes(path)

    def _requested_mesh(self, content: Mapping[str, Any]) -> Mesh:
        fit, key, z, dense = content.get("fit"), content.get("scan"), content.get("z"), content.get("stage") == "dense"
        if isinstance(fit, str):
            try:
                return self._view.fitted_mesh(fit, dense=dense)
            except KeyError:
                raise HTTPException(404, "There is no such fit.") from None
        if isinstance(key, str):
            scan = self._scans.get(key)
            surface = None if scan is None else scan.folder / f"{NAME}.{'dense' if dense else 'fitted'}.ply"
            if surface is None or not surface.is_file():
                raise HTTPException(404, _NO_SCAN)
            return read_mesh(surface)
        if not _is_numbers(z):
            raise HTTPException(400, "An export needs z, a list of numbers in standard deviations.")
        return shape_of(self._view.model, cast(list[float], z))

    # Uploaded scans

    async def upload(self, request: Request) -> Response:
        name, limits = display_name(request.query_params.get("name", "")), self._scans.limits
        ending = Path(name).suffix.lower()
        if ending not in MESH_ENDINGS:
            raise HTTPException(415, f"{name} is not a scan that can be read; drop {', '.join(MESH_ENDINGS)}.")
        if self._uploading + self._scans.unfinished() >= limits.unfinished:
            raise HTTPException(429, _QUEUE_FULL.format(limits.unfinished))
        too_large = (
            f"{name} is larger than the {limits.upload_bytes / 2**20:g} MB that this viewer takes; thin it, or start "
            "the viewer with a larger --max-upload-mb."
        )
        folder = self._scans.new_folder()
        self._uploading += 1
        try:
            # The user's file name never becomes a path.
            path = folder / f"upload-{secrets.token_hex(4)}{ending}"
            with path.open("xb") as file:
                async with aclosing(body_pieces(request, limits.upload_bytes, too_large)) as pieces:
                    async for piece in pieces:
                        file.write(piece)
            scan = self._scans.add(name, path, dense=request.query_params.get("dense") == "1")
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            self._uploading -= 1
        return json_response(scan.facts(), 201)

    def progress(self, request: Request) -> Response:
        scan = self._scan(request)
        first = request.query_params.get("after", "0")
        if not (first.isascii() and first.isdigit() and len(first) < 10):
            raise HTTPException(400, "after must be a number of events.")
        # The state first: once it is "done", there are no more events.
        facts = scan.facts()
        return json_response(
            {**facts, "position": self._scans.queue_position(scan), "events": scan.events[int(first) :]}
        )

    def preview(self, request: Request) -> Response:
        return _file(self._scan(request).folder / PREVIEW, "There is no picture of this scan.")

    def picture(self, request: Request) -> Response:
        return _file(self._scan(request).folder / PICTURE, "There is no picture of this scan.")

    def record(self, request: Request) -> Response:
        path = self._scan(request).folder / f"{NAME}.fit.json"
        return _file(path, "This scan has no result yet.", "scan.fit.json")

    async def landmarks(self, request: Request) -> Response:
        scan = self._scan(request)
        if not scan.facts()["can_place_landmarks"]:
            raise HTTPException(409, "Landmarks can be placed on a scan with a doubtful or failed fit; drop it again.")
        content: object = (await self._json(request)).get("landmarks")
        points = cast(dict[str, Any], content) if isinstance(content, dict) else dict[str, Any]()
        known = self._view.model.landmarks
        if not all(name in known and _is_numbers(point) and len(point) == 3 for name, point in points.items()):
            raise HTTPException(400, "A landmark needs a name of the model and three numbers.")
        if len(points) < MIN_LANDMARKS:
            raise HTTPException(400, f"At least {MIN_LANDMARKS} landmarks are needed, not {len(points)}.")
        path = scan.folder / "landmarks.csv"
        write_landmarks(path, {name: np.asarray(point, dtype=np.float64) for name, point in points.items()})
        self._scans.refit(scan, path)
        return json_response(scan.facts())

    def cancel(self, request: Request) -> Response:
        self._scan(request).stop.set()
        return json_response({})

    def remove(self, request: Request) -> Response:
        self._scans.remove(self._scan(request))
        return json_response({})

    def _scan(self, request: Request) -> UploadedScan:
        scan = self._scans.get(request.path_params["key"])
        if scan is None:
            raise HTTPException(404, _NO_SCAN)
        return scan

    async def _json(self, request: Request) -> Mapping[str, Any]:
        return await json_body(request, self._scans.limits.request_bytes)


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


def _file(path: Path, missing: str, file_name: str | None = None) -> Response:
    try:
        return binary(read_bytes(path), file_name)
    except FileError:
        raise HTTPException(404, missing) from None


_MAX_QUERY = 2000  # characters; bounds the work of one request


def make_surfaces_app(
    surfaces: Surfaces, access: Access, *, loopback: bool = True, cookie_name: str = "shapespace"
) -> ASGIApp:
    """Return the application behind a guard.

    Args:
        surfaces: the folder.
        access: the secrets of this viewer.
        loopback: whether only this machine can reach the server.
        cookie_name: browsers share cookies between ports, so the name should contain the port.
    """
    return Guard(surfaces_app(surfaces), access=access, cookie_name=cookie_name, loopback=loopback)


def surfaces_app(surfaces: Surfaces) -> ASGIApp:
    """Return the application."""

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
        route("/", lambda _: html_page("surfaces")),
        Route("/assets/{name}", asset),
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
_VIEWER_SCRIPTS = (
    "page.js", "charts.js", "coefficients-csv.js", "fit-controls.js", "fit-view.js", "viewer.js", "surfaces.js",
    *(f"viewer-{part}.js" for part in ("stage", "model", "compare", "fits", "scan", "uploads", "landmarks")),
)  # fmt: skip
_STUDIO_SCRIPTS = ("studio.js", *(f"studio-{part}.js" for part in (
    "texts", "store", "widgets", "start", "table", "volumes", "groom", "scan", "specimens", "jobs", "steps",
    "questions", "results",
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


def route(path: str, answer: Callable[[Request], Response]) -> Route:
    """Return the route of a path."""
    return Route(path, answer)


def html_page(name: str) -> Response:
    """Return a page of the browser application."""
    return FileResponse(PAGES / f"{name}.html", media_type="text/html")


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
