"""The viewer's application for a folder of corresponding surfaces; it only reads."""

from __future__ import annotations

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from shapespace.viewer.corresponding_surfaces import Surfaces
from shapespace.viewer.guard import Access, Guard
from shapespace.viewer.responses import PAGES, application, asset, binary, json_response

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

    def page(request: Request) -> Response:
        return FileResponse(PAGES / "surfaces.html", media_type="text/html")

    def about(request: Request) -> Response:
        return json_response(surfaces.about())

    def mean(request: Request) -> Response:
        return binary(surfaces.packed_mean())

    def population(request: Request) -> Response:
        return binary(surfaces.packed_population())

    def names(request: Request) -> Response:
        return json_response(surfaces.names())

    def surface_list(request: Request) -> Response:
        return json_response(surfaces.rows())

    def surface(request: Request) -> Response:
        try:
            return binary(surfaces.packed_surface(request.path_params["name"]))
        except KeyError:
            raise HTTPException(404, "There is no such scan in correspondence; reload the page.") from None

    def positions(request: Request) -> Response:
        numbers = request.query_params.get("vertices", "")[:_MAX_QUERY].split(",")
        if not all(part.isascii() and part.isdigit() for part in numbers):
            raise HTTPException(400, "Give the numbers of vertices with commas between them.")
        return binary(surfaces.positions_csv([int(part) for part in numbers]).encode(), "places.csv")

    routes = [
        Route("/", page),
        Route("/assets/{name}", asset),
        Route("/api/about", about),
        Route("/api/mean", mean),
        Route("/api/population", population),
        Route("/api/names", names),
        Route("/api/surfaces", surface_list),
        Route("/api/surfaces/{name}", surface),
        Route("/api/places", positions),
    ]
    return application(routes, surfaces.public)
