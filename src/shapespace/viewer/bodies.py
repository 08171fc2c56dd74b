"""What visitors send: received piece by piece, within bounds of time and of bytes that all share."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable

from starlette.exceptions import HTTPException
from starlette.requests import Request

from shapespace.viewer.limits import Limits

_FULL = "The viewer holds as many scans as it takes, {:.0f} MB; try again when a fit has ended."
_SLOW = "The request came too slowly and was given up; send it again."


class Bodies:
    """Receives the bodies of all requests.

    Args:
        limits: see there.
        kept_bytes: how many bytes of earlier bodies are still held.
    """

    def __init__(self, limits: Limits, kept_bytes: Callable[[], int]) -> None:
        self._limits = limits
        self._kept_bytes = kept_bytes
        self._coming_bytes = 0

    def check_room(self, size: int) -> None:
        """Refuse `size` bytes more than are held now where all together would be too many.

        Raises:
            HTTPException: 503.
        """
        most = self._limits.all_bytes
        if self._coming_bytes + self._kept_bytes() + size > most:
            raise HTTPException(503, _FULL.format(most / 2**20))

    async def pieces(self, request: Request, most: int, too_large: str) -> AsyncGenerator[bytes]:
        """Yield the body of `request`; its bytes count as held until the generator is closed.

        Args:
            request: whose body it is.
            most: bytes that it may have.
            too_large: said where it has more.

        Raises:
            HTTPException: 408, 413 or 503, where it comes too slowly, is too large, or all together are.
        """
        ends = time.monotonic() + self._limits.body_s
        coming, size = request.stream(), 0
        try:
            while True:
                try:
                    async with asyncio.timeout(min(self._limits.stalled_s, ends - time.monotonic())):
                        piece = await anext(coming, None)
                except TimeoutError:
                    raise HTTPException(408, _SLOW) from None
                if piece is None:
                    return
                if size + len(piece) > most:
                    raise HTTPException(413, too_large)
                self.check_room(len(piece))
                size += len(piece)
                self._coming_bytes += len(piece)
                yield piece
        finally:
            self._coming_bytes -= size
