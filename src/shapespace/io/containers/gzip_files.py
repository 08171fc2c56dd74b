"""Files packed by gzip, unpacked in proportion to their bytes."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path

from shapespace.io.parsing import CUT_SHORT, damaged
from shapespace.io.read_limits import GROWTH

GZIP = b"\x1f\x8b"
"""With which such a file begins."""
_SMALL = 2**20


def unpacked(data: bytes, path: Path, most: int) -> bytes:
    """Return what `data`, all of a gzip file, holds.

    Args:
        data: the whole file.
        path: its name, for messages.
        most: bytes that the content may have.

    Raises:
        FileFormatError: it is cut short or damaged, or unpacks to more than `most`, or `limits.GROWTH` times its bytes.
    """
    most = min(most, max(GROWTH * len(data), _SMALL))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            content = stream.read(most + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise damaged(path, f"its compressed data end early or are wrong; {CUT_SHORT}") from error
    if len(content) > most:
        raise damaged(path, f"it unpacks to more than {most / 2**20:.0f} MiB, so unpack it with gunzip and look at it")
    return content
