"""Who may ask for what: the token, the Host and Origin headers, and the headers that every answer carries."""

from __future__ import annotations

import hmac
from collections.abc import Callable, Mapping
from types import MappingProxyType
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOOPBACK = ("127.0.0.1", "localhost", "::1")
SECURITY_HEADERS: Mapping[str, str] = MappingProxyType(
    {
        "Content-Security-Policy": (
            "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        ),
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
        "Cache-Control": "no-store",
    }
)
_CHANGING = ("PUT", "POST", "DELETE", "PATCH")


class Guard:
    """Wraps the application: refuses what does not come from its own page, and adds the headers.

    Args:
        app: what is guarded.
        token: what a visitor must show, in the address once and in a cookie from then on; None on loopback.
        cookie: name of that cookie.
    """

    def __init__(self, app: ASGIApp, *, token: str | None, cookie: str) -> None:
        self._app = app
        self._token = token
        self._cookie = cookie

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        request = Request(scope)
        given = request.query_params.get("token", "")
        refused = self._refusal(request, given)
        set_cookie = self._token is not None and same(given, self._token)

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers[name] = value
                if set_cookie and self._token is not None:
                    headers.append("Set-Cookie", cookie(self._cookie, self._token))
            await send(message)

        answer: Callable[[Scope, Receive, Send], object] = refused or self._app
        await answer(scope, receive, with_headers)  # type: ignore[misc]

    def _refusal(self, request: Request, given: str) -> JSONResponse | None:
        headers = request.headers
        if self._token is None:
            # A foreign name that leads here by DNS would otherwise be let in by the browser.
            if _host_name(headers.get("host", "")) not in LOOPBACK:
                return refusal(421, "This viewer answers only under 127.0.0.1 or localhost; open it by that address.")
        elif not any(same(shown, self._token) for shown in (given, request.cookies.get(self._cookie, ""))):
            return refusal(401, "This address needs the token that shapespace view printed; open the whole address.")
        if not _from_own_page(headers, request.method):
            return refusal(403, "This request came from another page; use the viewer's own page.")
        return None


def same(given: str, secret: str) -> bool:
    """Return whether both are equal, in a time that does not tell where they differ."""
    return hmac.compare_digest(given.encode(), secret.encode())


def cookie(name: str, value: str) -> str:
    """Return a Set-Cookie header that scripts cannot read and other sites cannot send."""
    return f"{name}={value}; HttpOnly; SameSite=Strict; Path=/"


def refusal(status: int, sentence: str) -> JSONResponse:
    """Return an error as the page shows it."""
    return JSONResponse({"error": sentence}, status)


def _from_own_page(headers: Headers, method: str) -> bool:
    origin = headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != headers.get("host", ""):
        return False
    site = headers.get("sec-fetch-site")
    if method in _CHANGING:
        return site in (None, "same-origin")
    # A link to the page may stand anywhere, but no other page may load parts of it or hold it in a frame.
    return site in (None, "same-origin", "none") or headers.get("sec-fetch-dest") == "document"


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
