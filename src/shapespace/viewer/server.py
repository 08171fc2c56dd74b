"""The viewer's application: the page, what it shows, and scans that visitors drop."""

from __future__ import annotations

import asyncio
import json
import secrets
import shutil
import tempfile
import unicodedata
from collections.abc import AsyncGenerator, Callable, Coroutine, Mapping
from contextlib import aclosing, asynccontextmanager
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp

from shapespace.errors import FileError
from shapespace.io.files import read_bytes
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, read_mesh, write_mesh
from shapespace.report.render import palette as colours
from shapespace.schemas import to_json
from shapespace.types import Mesh
from shapespace.version import __version__
from shapespace.viewer.answers import PAGES, answer, application, asset, binary
from shapespace.viewer.bodies import Bodies
from shapespace.viewer.fitting import NAME, PICTURE, PREVIEW, Worker, fit_upload
from shapespace.viewer.guard import Access, Guard, cookie
from shapespace.viewer.limits import Limits
from shapespace.viewer.scratch import new_folder
from shapespace.viewer.sessions import DroppedScan, Session, Sessions
from shapespace.viewer.shown import Shown, shape_of

EXPORTS = ("ply", "obj", "stl")
_LONGEST_NAME = 120
_FEWEST_LANDMARKS = 3
_NO_SCAN = "There is no such scan; it was removed, or it never was yours."
_NO_SESSION = "This visit has ended, and its scans were removed; reload the page."

Endpoint: TypeAlias = Callable[[Request], Coroutine[Any, Any, Response]]


def make_app(
    shown: Shown,
    *,
    limits: Limits,
    access: Access,
    local: bool = True,
    cookie_name: str = "shapespace",
    worker: Worker = fit_upload,
    framed: bool = False,
) -> tuple[ASGIApp, Sessions]:
    """Return the application and its sessions.

    Args:
        shown: what it shows.
        limits: what visitors may use.
        access: what every request must carry.
        local: whether it is for this machine alone.
        cookie_name: of its cookies; browsers share cookies between ports, so it should name the port.
        worker: what fits a dropped scan, in a process of its own.
        framed: whether notebooks on this machine may hold the page in a frame.
    """
    root, remove_root = new_folder()
    model_file = root / "model.h5"
    try:
        shown.model.save(model_file)
    except BaseException:
        remove_root()
        raise
    sessions = Sessions(
        root,
        model_file,
        shown.model_name,
        with_landmarks=len(shown.model.landmarks) >= _FEWEST_LANDMARKS,
        limits=limits,
        worker=worker,
        remove_root=remove_root,
    )
    viewer = _Viewer(shown, sessions, f"{cookie_name}_session")

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        # The model is packed while the browser still opens.
        working: list[asyncio.Task[Any]] = [
            asyncio.create_task(sessions.watch_over()),
            asyncio.create_task(viewer.packed_model()),
        ]
        try:
            yield
        finally:
            for task in working:
                task.cancel()
            await asyncio.gather(*working, return_exceptions=True)
            sessions.close()

    app = application(viewer.routes(), lifespan, shown.told)
    return Guard(app, access=access, cookie=f"{cookie_name}_token", local=local, framed=framed), sessions


class _Viewer:
    def __init__(self, shown: Shown, sessions: Sessions, cookie_name: str) -> None:
        self._shown = shown
        self._sessions = sessions
        self._bodies = Bodies(sessions.limits, sessions.kept_bytes)
        self._cookie = cookie_name
        self._packed: tuple[bytes, int] | None = None
        self._packing = asyncio.Lock()

    def routes(self) -> list[Route]:
        scan = "/api/scans/{key}"
        return [
            Route("/", self.page),
            Route("/assets/{name}", asset),
            Route("/api/about", self.about),
            Route("/api/model", self.model),
            Route("/api/fits", self.fits),
            Route("/api/fits/{name}", self.fit),
            Route("/api/export", self.export, methods=["POST"]),
            Route("/api/scans", self.scans),
            Route("/api/scans", self.drop, methods=["PUT"]),
            Route(scan, self.remove, methods=["DELETE"]),
            Route(f"{scan}/events", self.events),
            Route(f"{scan}/preview", self.preview),
            Route(f"{scan}/picture", self.picture),
            Route(f"{scan}/record", self.record),
            Route(f"{scan}/landmarks", self.landmarks, methods=["POST"]),
            Route(f"{scan}/cancel", self.cancel, methods=["POST"]),
        ]

    async def page(self, request: Request) -> Response:
        session = self._sessions.find(request.cookies.get(self._cookie))
        response = FileResponse(PAGES / "viewer.html", media_type="text/html")
        if session is None:
            response.headers.append("Set-Cookie", cookie(self._cookie, self._sessions.new().key))
        return response

    async def about(self, request: Request) -> Response:
        model, limits = self._shown.model, self._sessions.limits
        _, modes = await self.packed_model()
        return answer(
            {
                "version": __version__,
                "model": self._shown.model_name,
                "modes": model.n_modes,
                "modes_sent": modes,
                "stddev": model.stddev.tolist(),
                "vertices": model.n_vertices,
                "triangles": 0 if model.faces is None else len(model.faces),
                "landmarks": list(model.landmarks),
                "has_fits": self._shown.folder is not None,
                "upload_bytes": limits.upload_bytes,
                "unfinished": limits.unfinished,
                "kept": limits.kept,
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

    async def model(self, request: Request) -> Response:
        packed, _ = await self.packed_model()
        return binary(packed)

    async def fits(self, request: Request) -> Response:
        return answer(await asyncio.to_thread(self._shown.fit_list))

    async def fit(self, request: Request) -> Response:
        try:
            packed = await asyncio.to_thread(self._shown.packed_fit, request.path_params["name"])
        except KeyError:
            raise HTTPException(
                404, "There is no such fit; reload the page to see what the folder holds now."
            ) from None
        return binary(packed)

    async def export(self, request: Request) -> Response:
        kind = request.query_params.get("format", "")
        if kind not in EXPORTS:
            raise HTTPException(400, f"There is no export as {kind[:20]!r}; choose one of {', '.join(EXPORTS)}.")
        question = await self._question(request)
        content = await asyncio.to_thread(self._exported, kind, question, self._session(request))
        return binary(content, f"shape.{kind}")

    def _exported(self, kind: str, question: Mapping[str, Any], session: Session | None) -> bytes:
        mesh = self._asked_mesh(question, session)
        with tempfile.TemporaryDirectory(prefix="export-", dir=self._sessions.root) as folder:
            path = Path(folder) / f"shape.{kind}"
            write_mesh(path, mesh)
            return read_bytes(path)

    def _asked_mesh(self, question: Mapping[str, Any], session: Session | None) -> Mesh:
        fit, key, dense = question.get("fit"), question.get("scan"), question.get("stage") == "dense"
        if isinstance(fit, str):
            try:
                return self._shown.fitted_mesh(fit, dense=dense)
            except KeyError:
                raise HTTPException(404, "There is no such fit.") from None
        if isinstance(key, str):
            scan = session.scans.get(key) if session else None
            surface = None if scan is None else scan.folder / f"{NAME}.{'dense' if dense else 'fitted'}.ply"
            if surface is None or not surface.is_file():
                raise HTTPException(404, _NO_SCAN)
            return read_mesh(surface)
        z = question.get("z")
        if not _numbers(z):
            raise HTTPException(400, "An export needs z, a list of numbers in standard deviations.")
        return shape_of(self._shown.model, cast(list[float], z))

    async def scans(self, request: Request) -> Response:
        session = self._session(request)
        return answer([scan.facts() for scan in session.scans.values()] if session else [])

    async def drop(self, request: Request) -> Response:
        session = self._own_session(request)
        limits = self._sessions.limits
        name = _shown_name(request.query_params.get("name", ""))
        ending = Path(name).suffix.lower()
        if ending not in MESH_ENDINGS:
            raise HTTPException(415, f"{name} is not a scan that can be read; drop {', '.join(MESH_ENDINGS)}.")
        if session.unfinished() >= limits.unfinished:
            raise HTTPException(
                429, f"{limits.unfinished} of your scans are being fitted or wait for it; wait for one, or stop one."
            )
        too_large = (
            f"{name} is larger than the {limits.upload_bytes / 2**20:g} MB that this viewer takes; thin it, or start "
            "the viewer with a larger --max-upload-mb."
        )
        announced = request.headers.get("content-length", "0")
        if not (announced.isascii() and announced.isdigit()):
            raise HTTPException(400, "The length of the scan is not a number; drop it again.")
        if int(announced) > limits.upload_bytes:
            raise HTTPException(413, too_large)
        self._bodies.check_room(int(announced))
        if not self._sessions.has_room(session):
            raise HTTPException(503, f"{limits.visitors} visitors have scans here, as many as may; try again later.")
        folder = self._sessions.new_folder()
        session.uploading += 1
        try:
            # A name of our own: what the visitor calls the file never becomes a path.
            path = folder / f"upload-{secrets.token_hex(4)}{ending}"
            size = await self._receive(request, path, too_large)
            if self._sessions.find(session.key) is None:
                raise HTTPException(403, _NO_SESSION)
            scan = self._sessions.add(session, name, folder, path, size, dense=request.query_params.get("dense") == "1")
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        finally:
            session.uploading -= 1
        return answer(scan.facts(), 201)

    async def events(self, request: Request) -> Response:
        scan = self._own_scan(request)

        async def stream() -> AsyncGenerator[str]:
            async for message in scan.follow(lambda: self._sessions.closing):
                if message is None:
                    self._session(request)  # a visitor who watches is not idle
                    yield ": waiting\n\n"
                else:
                    yield f"data: {json.dumps(to_json(message))}\n\n"

        return StreamingResponse(stream(), media_type="text/event-stream")

    async def preview(self, request: Request) -> Response:
        return await _file(self._own_scan(request).folder / PREVIEW)

    async def picture(self, request: Request) -> Response:
        return await _file(self._own_scan(request).folder / PICTURE)

    async def record(self, request: Request) -> Response:
        path = self._own_scan(request).folder / f"{NAME}.fit.json"
        if not path.is_file():
            raise HTTPException(404, "This scan has no result yet.")
        return binary(await asyncio.to_thread(read_bytes, path), "scan.fit.json")

    async def landmarks(self, request: Request) -> Response:
        session, scan = self._own_session(request), self._own_scan(request)
        if not scan.finished or scan.upload is None:
            raise HTTPException(409, "Landmarks can be placed on a scan whose fit has ended in doubt; drop it again.")
        if session.unfinished() >= self._sessions.limits.unfinished:
            raise HTTPException(429, "Too many of your scans are being fitted; wait for one, or stop one.")
        given: object = (await self._question(request)).get("landmarks")
        points = cast(dict[str, Any], given) if isinstance(given, dict) else dict[str, Any]()
        known = self._shown.model.landmarks
        if not all(name in known and _numbers(point) and len(point) == 3 for name, point in points.items()):
            raise HTTPException(400, "A landmark needs a name of the model and three numbers.")
        if len(points) < _FEWEST_LANDMARKS:
            raise HTTPException(400, f"At least {_FEWEST_LANDMARKS} landmarks are needed, not {len(points)}.")
        path = scan.folder / "landmarks.csv"
        write_landmarks(path, {name: np.asarray(point, dtype=np.float64) for name, point in points.items()})
        self._sessions.fit_again(scan, path)
        return answer(scan.facts())

    async def cancel(self, request: Request) -> Response:
        self._sessions.cancel(self._own_scan(request))
        return answer({})

    async def remove(self, request: Request) -> Response:
        self._sessions.remove(self._own_session(request), self._own_scan(request))
        return answer({})

    def _session(self, request: Request) -> Session | None:
        return self._sessions.find(request.cookies.get(self._cookie))

    def _own_session(self, request: Request) -> Session:
        session = self._session(request)
        if session is None:
            raise HTTPException(403, _NO_SESSION)
        return session

    def _own_scan(self, request: Request) -> DroppedScan:
        session = self._session(request)
        scan = session.scans.get(request.path_params["key"]) if session else None
        if scan is None:
            raise HTTPException(404, _NO_SCAN)
        return scan

    async def _receive(self, request: Request, path: Path, too_large: str) -> int:
        """Write the body of `request` to `path`, and return how many bytes it has."""
        size = 0
        most = self._sessions.limits.upload_bytes
        with path.open("xb") as file:
            async with aclosing(self._bodies.pieces(request, most, too_large)) as pieces:
                async for piece in pieces:
                    size += file.write(piece)
        return size

    async def _question(self, request: Request) -> Mapping[str, Any]:
        """Return the JSON object in the body of `request`."""
        body = bytearray()
        most = self._sessions.limits.question_bytes
        async with aclosing(self._bodies.pieces(request, most, "The request is too long.")) as pieces:
            async for piece in pieces:
                body += piece
        try:
            question: object = json.loads(body)
        except (ValueError, RecursionError):
            question = None
        if not isinstance(question, dict):
            raise HTTPException(400, "The request is not a JSON object.")
        return cast(Mapping[str, Any], question)

    async def packed_model(self) -> tuple[bytes, int]:
        async with self._packing:
            if self._packed is None:
                self._packed = await asyncio.to_thread(self._shown.packed_model)
            return self._packed


def _numbers(value: object) -> bool:
    if not isinstance(value, list):
        return False
    items = cast(list[object], value)
    return all(isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < 1e9 for x in items)


def _shown_name(name: str) -> str:
    """Return a file's name that can be shown: its last part, without what cannot be printed."""
    last = name.replace("\\", "/").rpartition("/")[2]
    plain = "".join(c for c in unicodedata.normalize("NFC", last) if c.isprintable())
    stem, dot, ending = plain.rpartition(".")
    return f"{stem[:_LONGEST_NAME]}{dot}{ending[:10]}" or "The file"


async def _file(path: Path) -> Response:
    try:
        return binary(await asyncio.to_thread(read_bytes, path))
    except FileError:
        raise HTTPException(404, "There is no picture of this scan.") from None
