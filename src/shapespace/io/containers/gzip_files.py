"""Reader of gzip files with a limit on the unpacked size."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path

from shapespace.io.parsing import CUT_SHORT, damage_error
from shapespace.io.read_limits import GROWTH

GZIP = b"\x1f\x8b"
"""With which such a file begins."""
_SMALL = 2**20  # 1 MiB that any file may unpack to


def unpack_gzip(data: bytes, path: Path, max_bytes: int) -> bytes:
    """Return what `data`, all of a gzip file, holds.

    Args:
        data: the whole file.
        path: its name, for messages.
        max_bytes: largest size of the content.

    Raises:
        FileFormatError: it is cut short or damaged, or unpacks to more than `max_bytes`, or `limits.GROWTH` times its
            size.
    """
    max_bytes = min(max_bytes, max(GROWTH * len(data), _SMALL))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as stream:
            content = stream.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise damage_error(path, f"its compressed data end early or are wrong; {CUT_SHORT}") from error
    if len(content) > max_bytes:
        raise damage_error(
            path, f"it unpacks to more than {max_bytes / 2**20:.0f} MiB, so unpack it with gunzip and look at it"
        )
    return content
