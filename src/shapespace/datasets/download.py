"""Downloads that resume after an interruption, and file locks between processes."""

from __future__ import annotations

import contextlib
import http.client
import logging
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, cast

import pooch
from tqdm import tqdm

from shapespace.errors import DataError
from shapespace.io.files import read_error, write_error

_ATTEMPTS = 3  # tries of one file; each resumes the one before
_TIMEOUT_S = 30.0  # seconds without a byte
_BLOCK = 1 << 16  # bytes (64 KiB), between updates of the progress bar
_MAX_FILE_BYTES = 32 << 20  # 32 MiB, for files without a published size


def download(url: str, path: Path, bar: tqdm[Any], *, sha256: str | None = None, size: int | None = None) -> None:
    """Get one file, going on where a broken run stopped.

    Args:
        url: where it is.
        path: where it goes.
        bar: updated after each block.
        sha256: what it must hash to, or None.
        size: in bytes, or None where it is not known.

    Raises:
        DataError: there is no network, no such file (`NotThereError`), or it is not the one published.
        FileError: it cannot be written.
    """
    resuming = _ResumingDownload(path.with_name(f"{path.name}.part"), size, bar)
    try:
        with _quiet_pooch():
            pooch.retrieve(  # pyright: ignore[reportUnknownMemberType]  # its os.PathLike is bare
                url,
                None if sha256 is None else f"sha256:{sha256}",
                fname=path.name,
                path=path.parent,
                downloader=resuming,
            )
    except OSError as error:
        raise write_error(path, error) from error
    except ValueError as error:
        raise DataError(
            f"{url} does not match its published SHA-256; what came was deleted, so try again later or set "
            "SHAPESPACE_DATA to a local copy."
        ) from error


class NotThereError(DataError):
    """The server has no file at the address."""


class _CutError(Exception):
    """The connection closed before the end of the file."""


@dataclass(frozen=True)
class _ResumingDownload:
    """A downloader for pooch that keeps what it has in a `.part` file and asks only for the rest.

    Pooch's own names for the arguments of the call are misleading: `fname` is the address, `action` the target.
    """

    part: Path
    expected_bytes: int | None
    bar: tqdm[Any]

    def __call__(self, fname: str, action: Any, pooch: Any = None, *, check_only: bool | None = None) -> bool | None:
        reason: Exception | None = None
        for attempt in range(_ATTEMPTS):
            if attempt:
                time.sleep(0.2 * 2**attempt)
            try:
                self._get_rest(fname)
                self.part.replace(cast(str, action))
                return None
            except urllib.error.HTTPError as error:
                error.close()
                if error.code == 416:
                    self.part.unlink(missing_ok=True)
                elif error.code < 500:
                    kind = NotThereError if error.code in (404, 410) else DataError
                    raise kind(
                        f"Cannot download {fname}: the server answered {error.code} {error.reason}; "
                        "set SHAPESPACE_DATA to a local copy, or SHAPESPACE_DATA_URL to a server that has it."
                    ) from error
                reason = error
            except (
                _CutError,
                urllib.error.URLError,
                http.client.HTTPException,
                ConnectionError,
                TimeoutError,
            ) as error:
                reason = error
        cause = getattr(reason, "reason", None) or reason
        raise DataError(
            f"Cannot download {fname} ({str(cause).strip('.')}), and {self.part.parent} does not hold it yet: "
            "check the network and run again, which goes on where it stopped, or set SHAPESPACE_DATA to a local copy."
        ) from reason

    def _get_rest(self, url: str) -> None:
        offset = self.part.stat().st_size if self.part.is_file() else 0
        if offset > (self.expected_bytes or _MAX_FILE_BYTES):
            self.part.unlink()
            offset = 0
        if offset and offset == self.expected_bytes:
            return
        request = urllib.request.Request(url, headers={"User-Agent": "shapespace", "Accept-Encoding": "identity"})
        if offset:
            request.add_header("Range", f"bytes={offset}-")
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
            resumed = response.status == 206 and str(response.headers.get("Content-Range", "")).startswith(
                f"bytes {offset}-"
            )
            if response.status == 206 and not resumed:
                raise _CutError("the server sent another part than was asked for")
            offset = offset if resumed else 0
            length = response.headers.get("Content-Length")
            total = offset + int(length) if length and length.isdigit() else self.expected_bytes
            limit = self.expected_bytes or _MAX_FILE_BYTES
            if total is not None and total > limit:
                raise DataError(f"{url} is larger than the published file ({total} bytes); it is not the same file.")
            try:
                stream = self.part.open("ab" if resumed else "wb")
            except OSError as error:
                raise write_error(self.part, error) from error
            with stream:
                self.bar.update(offset)
                self._copy(response, stream, url, limit - offset)
                size = stream.tell()
        if total is not None and size < total:
            self.bar.update(-size)
            raise _CutError(f"the connection was cut after {size} of {total} bytes")

    def _copy(self, response: Any, stream: BinaryIO, url: str, room: int) -> None:
        while block := cast(bytes, response.read(_BLOCK)):
            room -= len(block)
            if room < 0:
                raise DataError(f"{url} is larger than the published file; it is not the same file.")
            try:
                stream.write(block)
            except OSError as error:
                raise write_error(self.part, error) from error
            self.bar.update(len(block))


@contextlib.contextmanager
def _quiet_pooch() -> Generator[None]:
    """Keep pooch from logging to standard error, where the progress bar is."""
    logger = pooch.get_logger()
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def hold_lock(path: Path) -> Generator[None]:
    """Hold a lock on the file `path`; the system releases it even if the process is killed."""
    try:
        stream = path.open("a+b")
    except OSError as error:
        raise write_error(path, error) from error
    with stream:
        if sys.platform == "win32":
            import msvcrt

            while True:
                with contextlib.suppress(OSError):
                    msvcrt.locking(stream.fileno(), msvcrt.LK_LOCK, 1)
                    break
            try:
                yield
            finally:
                stream.seek(0)
                msvcrt.locking(stream.fileno(), msvcrt.LK_UNLCK, 1)
        else:
            import fcntl

            try:
                fcntl.flock(stream, fcntl.LOCK_EX)
            except OSError as error:
                raise read_error(path, error) from error
            yield
