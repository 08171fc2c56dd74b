"""Access control of the viewer: the token, the Host and Origin headers, and the security headers of every response."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from types import MappingProxyType
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
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
_NOTEBOOKS = "http://localhost:* http://127.0.0.1:* https://localhost:* https://127.0.0.1:*"
FRAMED_HEADERS: Mapping[str, str] = MappingProxyType(
    {
        **{name: value for name, value in SECURITY_HEADERS.items() if name != "X-Frame-Options"},
        "Content-Security-Policy": SECURITY_HEADERS["Content-Security-Policy"].replace(
            "frame-ancestors 'none'", f"frame-ancestors {_NOTEBOOKS}"
        ),
    }
)
"""The same headers for a page that notebooks on this machine may show in a frame."""
_SECRET_BYTES = 32  # bytes, 256 bits: cannot be guessed
_IGNORED_HEADERS = (b"range", b"if-range")
"""Partial responses are not supported."""

_NO_TOKEN = "This address needs the token that shapespace view printed; open the complete address."
_WRONG_TOKEN = "This token is not, or no longer, that of this viewer; open the address that shapespace view printed."


class Access:
    """The secrets of one viewer: its token, its cookie and its one-time ticket.

    The printed address contains the token. It is exchanged for the cookie and does not stay in the history of the
    browser. A ticket replaces the token where others can read it: on the command line that starts the browser, and in
    the saved output of a notebook.

    Args:
        token: None for a new random token of 256 bits.
    """

    def __init__(self, token: str | None = None) -> None:
        self.token = token or secrets.token_urlsafe(_SECRET_BYTES)
        self.cookie = secrets.token_urlsafe(_SECRET_BYTES)
        self._ticket = ""

    def new_ticket(self) -> str:
        """Return a ticket that is valid for one use; the previous ticket becomes invalid."""
        self._ticket = secrets.token_urlsafe(_SECRET_BYTES)
        return self._ticket

    def accepts(self, secret: str) -> bool:
        """Return whether `secret` is the token or the ticket; a ticket is used up."""
        if self._ticket and is_same(secret, self._ticket):
            self._ticket = ""
            return True
        return is_same(secret, self.token)


class Guard:
    """Middleware that rejects requests without the token or from other pages, and adds the security headers.

    Args:
        app: the guarded application.
        access: secrets of the viewer.
        cookie_name: browsers share cookies between ports, so the name should contain the port.
        loopback: whether only this machine can reach the server; requests for other host names are then rejected.
        framed: whether notebooks on this machine may show the page in a frame.
    """

    def __init__(self, app: ASGIApp, *, access: Access, cookie_name: str, loopback: bool, framed: bool = False) -> None:
        self._app = app
        self._access = access
        self._cookie_name = cookie_name
        self._loopback = loopback
        self._framed = framed
        self._headers = FRAMED_HEADERS if framed else SECURITY_HEADERS

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] != "http":
            return
        scope["headers"] = [(name, value) for name, value in scope["headers"] if name not in _IGNORED_HEADERS]

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in self._headers.items():
                    headers.setdefault(name, value)
            await send(message)

        await (self._early_response(Request(scope)) or self._app)(scope, receive, send_with_headers)

    def _early_response(self, request: Request) -> Response | None:
        """Return an error response or the redirect that sets the cookie; None for a request that may pass."""
        # Against DNS rebinding: a foreign host name that resolves to this machine.
        if self._loopback and _host_name(request.headers.get("host", "")) not in LOOPBACK:
            return refusal(421, "This viewer answers only under 127.0.0.1 or localhost; open it by that address.")
        has_cookie = is_same(request.cookies.get(self._cookie_name, ""), self._access.cookie)
        has_token = request.scope["path"] == "/" and request.method == "GET" and "token" in request.query_params
        if not has_cookie and not has_token:
            return refusal(401, _NO_TOKEN)
        if not _is_from_own_page(request.headers, framed=self._framed):
            return refusal(403, "This request came from another page; use the viewer's own page.")
        if not has_token:
            return None
        redirect = RedirectResponse("/", 303)
        if not has_cookie:
            if not self._access.accepts(request.query_params["token"]):
                return refusal(401, _WRONG_TOKEN)
            # Lax: Strict is not sent after the redirect of a link from another page.
            redirect.set_cookie(self._cookie_name, self._access.cookie, httponly=True, samesite="lax")
        return redirect


def is_same(secret: str, expected: str) -> bool:
    """Compare two secrets in constant time."""
    return hmac.compare_digest(secret.encode(errors="replace"), expected.encode())


def refusal(status: int, sentence: str) -> JSONResponse:
    """Return an error response with a sentence for the user."""
    return JSONResponse({"error": sentence}, status)


def _is_from_own_page(headers: Headers, *, framed: bool) -> bool:
    origin = headers.get("origin")
    if origin is not None and origin.partition("://")[2] != headers.get("host", ""):
        return False
    # Any page may link to the viewer, but not load parts of it or show it in a frame.
    site, destination = headers.get("sec-fetch-site"), headers.get("sec-fetch-dest")
    return site in (None, "same-origin", "none") or destination == "document" or (framed and destination == "iframe")


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
