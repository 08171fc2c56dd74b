"""Connections to a viewer: so many at a time, and none for long that asks for nothing or takes no answer."""

from __future__ import annotations

import json
import time
from typing import Any, cast

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from shapespace.viewer.guard import SECURITY_HEADERS
from shapespace.viewer.limits import Limits

_BUSY = {"error": "The viewer has as many visitors as it takes; try again in a minute."}


def server_config(app: object, limits: Limits) -> uvicorn.Config:
    """Return how `app` is served."""

    class Connection(_Connection):
        bounds = limits

    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        http=Connection,
        log_level="error",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=3,
        timeout_keep_alive=round(limits.quiet_s) or 1,
        ws="none",
        lifespan="on",
    )


class _Connection(H11Protocol):
    bounds = Limits()

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.idle_since = time.monotonic()
        self._untaken = 0
        self._asked = False

    @property
    def idle(self) -> bool:
        """Whether no request is being answered; one whose headers are not all here does not count."""
        return not self._asked or self.cycle.response_complete

    def connection_made(self, transport: Any) -> None:
        super().connection_made(transport)
        if len(self.connections) > self.bounds.connections:
            every = cast("set[_Connection]", self.connections)
            oldest = min((one for one in every if one.idle and one is not self), key=_idle_since, default=None)
            if oldest is None:
                transport.write(_busy())
                transport.close()
                return
            self.connections.discard(oldest)
            oldest.transport.abort()
        self.loop.call_later(self.bounds.quiet_s, self._look)

    def handle_events(self) -> None:
        super().handle_events()
        # uvicorn types it as always there.
        self._asked = bool(self.cycle)

    def on_response_complete(self) -> None:
        self.idle_since = time.monotonic()
        super().on_response_complete()

    def _look(self) -> None:
        if self.transport.is_closing() and not self.transport.get_write_buffer_size():
            return
        quiet_s = time.monotonic() - self.idle_since
        untaken = self.transport.get_write_buffer_size()
        stuck = untaken > 0 and untaken == self._untaken
        self._untaken = untaken
        if stuck or (self.idle and quiet_s >= self.bounds.quiet_s):
            self.transport.abort()
            return
        wait_s = self.bounds.quiet_s - quiet_s if self.idle else self.bounds.quiet_s
        self.loop.call_later(wait_s, self._look)


def _idle_since(connection: _Connection) -> float:
    return connection.idle_since


def _busy() -> bytes:
    body = json.dumps(_BUSY).encode()
    headers = {
        **SECURITY_HEADERS,
        "Content-Type": "application/json",
        "Content-Length": str(len(body)),
        "Connection": "close",
    }
    head = "".join(f"{name}: {value}\r\n" for name, value in headers.items())
    return f"HTTP/1.1 503 Service Unavailable\r\n{head}\r\n".encode() + body
