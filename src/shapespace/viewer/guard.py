"""Who may ask for what: the token, the Host and Origin headers, and the headers that every answer carries."""

from __future__ import annotations

import hmac
import secrets
import time
from collections.abc import Callable, Mapping
from types import MappingProxyType
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from shapespace.viewer.limits import Limits

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
_HERE = "http://localhost:* http://127.0.0.1:* https://localhost:* https://127.0.0.1:*"
FRAMED_HEADERS: Mapping[str, str] = MappingProxyType(
    {
        **{name: value for name, value in SECURITY_HEADERS.items() if name != "X-Frame-Options"},
        "Content-Security-Policy": SECURITY_HEADERS["Content-Security-Policy"].replace(
            "frame-ancestors 'none'", f"frame-ancestors {_HERE}"
        ),
    }
)
"""The same where notebooks that this machine serves may hold the page in a frame."""
_CHANGING = ("PUT", "POST", "DELETE", "PATCH")
_SECRET_BYTES = 32
_UNHEARD = (b"range", b"if-range")
"""Headers that are passed over: no answer is sent in parts."""

_NO_TOKEN = "This address needs the token that shapespace view printed; open the whole address."
_WRONG_TOKEN = "This token is not, or no longer, that of this viewer; open the address that shapespace view printed."
_TOO_MANY = "Too many wrong tokens were tried; wait a moment, and open the address that shapespace view printed."


class Access:
    """What lets a visitor in: a token or a ticket in the address, which are exchanged for a cookie.

    The token is in the address that is printed. The browser is started with a ticket, which is good for one use: other
    users of the machine can see what a program is started with. The cookie is a secret of its own and is
    looked at every time, so that whoever has it is not held up by the wrong guesses of others.

    Args:
        limits: how many wrong guesses are looked at, and how long a ticket is good for.
        token: None for a new one of 256 bits.
    """

    def __init__(self, limits: Limits, token: str | None = None) -> None:
        self.token = token or secrets.token_urlsafe(_SECRET_BYTES)
        self.cookie = secrets.token_urlsafe(_SECRET_BYTES)
        self._limits = limits
        self._ticket = ""
        self._ticket_ends = 0.0
        self._guesses = float(limits.guesses)
        self._counted = time.monotonic()

    def ticket(self) -> str:
        """Return a new ticket; an older one is void."""
        self._ticket = secrets.token_urlsafe(_SECRET_BYTES)
        self._ticket_ends = time.monotonic() + self._limits.ticket_s
        return self._ticket

    def admits(self, given: str) -> bool | None:
        """Return whether a token or ticket is right; None, whatever it is, after too many wrong ones."""
        now = time.monotonic()
        self._guesses = min(self._limits.guesses, self._guesses + (now - self._counted) / self._limits.guess_s)
        self._counted = now
        if self._guesses < 1:
            return None
        if same(given, self.token):
            return True
        if self._ticket and same(given, self._ticket) and now < self._ticket_ends:
            self._ticket = ""
            return True
        self._guesses -= 1
        return False


class Guard:
    """Wraps the application: refuses what does not come from its own page, and adds the headers.

    Args:
        app: what is guarded.
        access: what a visitor must show, in the address once and in a cookie from then on.
        cookie: name of that cookie.
        local: whether the viewer is for this machine alone, and answers under its names only.
        framed: whether notebooks on this machine may hold the page in a frame.
    """

    def __init__(self, app: ASGIApp, *, access: Access, cookie: str, local: bool, framed: bool = False) -> None:
        self._app = app
        self._access = access
        self._cookie = cookie
        self._local = local
        self._framed = framed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return
        scope["headers"] = [(name, value) for name, value in scope["headers"] if name not in _UNHEARD]

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in (FRAMED_HEADERS if self._framed else SECURITY_HEADERS).items():
                    headers[name] = value
            await send(message)

        answer: Callable[[Scope, Receive, Send], object] = self._answered(Request(scope)) or self._app
        await answer(scope, receive, with_headers)  # type: ignore[misc]

    def _answered(self, request: Request) -> Response | None:
        """Return what answers `request` before it comes to the application, None for what may pass."""
        headers = request.headers
        # A foreign name that leads here by DNS would otherwise be let in by the browser.
        if self._local and _host_name(headers.get("host", "")) not in LOOPBACK:
            return refusal(421, "This viewer answers only under 127.0.0.1 or localhost; open it by that address.")
        known = same(request.cookies.get(self._cookie, ""), self._access.cookie)
        entering = request.scope["path"] == "/" and request.method == "GET" and "token" in request.query_params
        if not known and not entering:
            return refusal(401, _NO_TOKEN)
        if not _from_own_page(headers, request.method, framed=self._framed):
            return refusal(403, "This request came from another page; use the viewer's own page.")
        if not entering:
            return None
        # By a redirect the token is neither in the address that stays nor in the history.
        redirect = RedirectResponse("/", 303)
        if not known:
            admitted = self._access.admits(request.query_params["token"])
            if admitted is None:
                return refusal(429, _TOO_MANY)
            if not admitted:
                return refusal(401, _WRONG_TOKEN)
            # Lax, since Strict is not sent after the redirect of a link that stood in a mail.
            redirect.headers.append("Set-Cookie", cookie(self._cookie, self._access.cookie, same_site="Lax"))
        return redirect


def same(given: str, secret: str) -> bool:
    """Return whether both are equal, in a time that does not tell where they differ."""
    return hmac.compare_digest(given.encode(errors="replace"), secret.encode())


def cookie(name: str, value: str, *, same_site: str = "Strict") -> str:
    """Return a Set-Cookie header that scripts cannot read and other sites cannot send."""
    return f"{name}={value}; HttpOnly; SameSite={same_site}; Path=/"


def refusal(status: int, sentence: str) -> JSONResponse:
    """Return an error as the page shows it."""
    return JSONResponse({"error": sentence}, status)


def _from_own_page(headers: Headers, method: str, *, framed: bool) -> bool:
    origin = headers.get("origin")
    # Compared as it stands: a parser would have to make something of every nonsense.
    if origin is not None and origin.partition("://")[2] != headers.get("host", ""):
        return False
    site = headers.get("sec-fetch-site")
    if method in _CHANGING:
        return site in (None, "same-origin")
    # A link to the page may stand anywhere, but no other page may load parts of it or hold it in a frame.
    dest = headers.get("sec-fetch-dest")
    # Whose frame it may be, the browser asks of the answer's headers.
    return site in (None, "same-origin", "none") or dest == "document" or (framed and dest == "iframe")


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
