"""The viewer's application for a folder in correspondence: it only reads, and knows no visitors."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from typing import Any

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from shapespace.viewer.answers import PAGES, answer, application, asset, binary
from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import Access, Guard

_LONGEST = 2000


def make_surfaces_app(
    surfaces: Surfaces, *, access: Access, local: bool = True, cookie_name: str = "shapespace"
) -> ASGIApp:
    """Return the application.

    Args:
        surfaces: what it shows.
        access: what every request must carry.
        local: whether it is for this machine alone.
        cookie_name: of its cookie; browsers share cookies between ports, so it should name the port.
    """
    shown = _Viewer(surfaces)

    @asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncGenerator[None]:
        # All surfaces are read once while the browser still opens.
        reading: asyncio.Task[Any] = asyncio.create_task(shown.packed_mean())
        try:
            yield
        finally:
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)

    routes = [
        Route("/", shown.page),
        Route("/assets/{name}", asset),
        Route("/api/about", shown.about),
        Route("/api/mean", shown.mean),
        Route("/api/surfaces", shown.listed),
        Route("/api/surfaces/{name}", shown.surface),
        Route("/api/places", shown.places),
    ]
    app = application(routes, lifespan, surfaces.told)
    return Guard(app, access=access, cookie=f"{cookie_name}_token", local=local)


class _Viewer:
    def __init__(self, surfaces: Surfaces) -> None:
        self._surfaces = surfaces
        self._packed: bytes | None = None
        self._packing = asyncio.Lock()

    async def page(self, request: Request) -> Response:
        return FileResponse(PAGES / "surfaces.html", media_type="text/html")

    async def about(self, request: Request) -> Response:
        return answer(self._surfaces.about())

    async def mean(self, request: Request) -> Response:
        return binary(await self.packed_mean())

    async def packed_mean(self) -> bytes:
        async with self._packing:
            if self._packed is None:
                self._packed = await asyncio.to_thread(self._surfaces.packed_mean)
            return self._packed

    async def listed(self, request: Request) -> Response:
        return answer(await asyncio.to_thread(self._surfaces.listed))

    async def surface(self, request: Request) -> Response:
        try:
            packed = await asyncio.to_thread(self._surfaces.packed_surface, request.path_params["name"])
        except KeyError:
            raise HTTPException(404, "There is no such scan in correspondence; reload the page.") from None
        return binary(packed)

    async def places(self, request: Request) -> Response:
        given = request.query_params.get("vertices", "")[:_LONGEST].split(",")
        if not all(part.isascii() and part.isdigit() for part in given):
            raise HTTPException(400, "Give the numbers of vertices with commas between them.")
        text = await asyncio.to_thread(self._surfaces.places, [int(part) for part in given])
        return binary(text.encode(), "places.csv")
