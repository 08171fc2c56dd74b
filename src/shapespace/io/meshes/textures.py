"""Textures of surfaces, sampled to vertex colours; read by Pillow, of the extra `report`.

What cannot be read leaves a surface without colours and says so in a note: a fit needs the shape alone.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path, PurePosixPath

import numpy as np

from shapespace.errors import ShapespaceError
from shapespace.io.files import read_bytes
from shapespace.types import ByteArray, FloatArray

LARGEST_FILE_BYTES = 2**28
"""Pictures in longer files are not read (256 MiB)."""

MOST_PIXELS = 2**26
"""Pictures with more are not unpacked (8192 times 8192)."""

MOST_PIXELS_IN_ALL = 2**28
"""All pictures of one surface have no more than these."""

MOST_BYTES_IN_ALL = 2**29
"""Limit of the bytes of all files of materials and pictures of one surface (512 MiB)."""

MOST_NAMES = 2**14
"""Limit of the files of materials and pictures that a surface names; finding one takes some 40 microseconds."""

_SIDE = 2048  # pixels; a texture is sampled at vertices, so finer ones cost memory only
_KINDS = ("JPEG", "PNG", "BMP", "TIFF")


class TextureError(Exception):
    """The reason why a texture cannot be used, as a clause."""


class CompanionFiles:
    """Materials and textures in the folder of a surface or below it, at most `MOST_BYTES_IN_ALL` together.

    Args:
        path: of the surface.
    """

    def __init__(self, path: Path) -> None:
        self._folder = path.parent.resolve()
        self._found: dict[str, Path] = {}
        self._bytes = MOST_BYTES_IN_ALL

    def find(self, name: str, file_kind: str) -> Path:
        """Return the resolved path of the file called `name`, so that two spellings of one file are recognised.

        Args:
            name: as the surface's file has it.
            file_kind: the file is, for messages.

        Raises:
            TextureError: it lies elsewhere or does not exist, or the surface names too many files.
        """
        if name in self._found:
            return self._found[name]
        if len(self._found) >= MOST_NAMES:
            raise TextureError(f"it names more than {MOST_NAMES:,} files of materials and pictures")
        short = _short(name)
        try:
            target = (self._folder / PurePosixPath(name.replace("\\", "/"))).resolve()
            if "://" in name or not target.is_relative_to(self._folder):
                raise TextureError(f"{file_kind} '{short}' is outside its folder, where nothing is read")
            if not target.is_file():
                raise TextureError(f"{file_kind} '{short}' is not in its folder")
        except (OSError, ValueError, RuntimeError) as error:
            raise TextureError(f"{file_kind} '{short}' cannot be read") from error
        self._found[name] = target
        return target

    def read(self, file: Path, file_kind: str, at_most: int = LARGEST_FILE_BYTES) -> bytes:
        """Return the content of a file that `find` returned.

        Args:
            file: its resolved path.
            file_kind: the file is, for messages.
            at_most: bytes; a longer file is not read.

        Raises:
            TextureError: it cannot be read or is too long, alone or together with those read before it.
        """
        try:
            content = read_bytes(file, min(at_most, self._bytes))
        except (ShapespaceError, OSError) as error:
            raise TextureError(f"{file_kind} '{_short(file.name)}' cannot be read") from error
        self._bytes -= len(content)
        return content


class Pictures:
    """Textures of one surface, each unpacked once, with at most `MOST_PIXELS_IN_ALL` pixels together."""

    def __init__(self) -> None:
        self._unpacked: dict[str, ByteArray | TextureError] = {}
        self._pixels = MOST_PIXELS_IN_ALL

    def sampled(self, name: str, content: Callable[[], bytes], uv: FloatArray, key: str = "") -> ByteArray:
        """Return the colours (N, 3) of a picture at `uv`, between its pixels linearly.

        Args:
            name: of the picture, for messages.
            content: gives the bytes of its JPEG, PNG, BMP or TIFF file.
            uv: (N, 2) from the lower left corner (0, 0) to the upper right (1, 1); beyond these it repeats.
            key: by which the picture is recognised, such as its resolved path; empty for its name.

        Raises:
            TextureError: no Pillow, or the picture cannot be had, is damaged, of another kind or too large.
        """
        known = key or name
        if known not in self._unpacked:
            try:
                self._unpacked[known] = self._unpack(content(), _short(name))
            except TextureError as reason:
                self._unpacked[known] = reason
        picture = self._unpacked[known]
        if isinstance(picture, TextureError):
            raise picture
        return _interpolate(picture, uv)

    def _unpack(self, picture: bytes, name: str) -> ByteArray:
        try:
            from PIL import Image
        except ImportError as error:
            raise TextureError(
                f"its picture '{name}' is read with Pillow, which pip install 'shapespace[report]' adds"
            ) from error
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                image = Image.open(io.BytesIO(picture), formats=_KINDS)
                count = image.width * image.height
                if count > min(MOST_PIXELS, self._pixels):
                    raise TextureError(f"its picture '{name}' has {image.width} times {image.height} pixels, too many")
                self._pixels -= count
                # Of a JPEG only as much is unpacked as is needed.
                image.draft("RGB", (_SIDE, _SIDE))
                image.thumbnail((_SIDE, _SIDE))
                return np.asarray(image.convert("RGB"))
        except TextureError:
            raise
        except Exception as error:  # a damaged picture may raise anything at all
            raise TextureError(f"its picture '{name}' is damaged or of a kind that is not read") from error


def _short(name: str) -> str:
    """Return a name out of a file as a terminal may show it."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:80])


def _interpolate(pixels: ByteArray, uv: FloatArray) -> ByteArray:
    height, width = pixels.shape[:2]
    known = np.where(np.isfinite(uv), uv, 0.0)
    # 1 is the last pixel and not the first one again.
    inside = np.where((known >= 0.0) & (known <= 1.0), known, known - np.floor(known))
    x = np.clip(inside[:, 0] * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - inside[:, 1]) * height - 0.5, 0.0, height - 1.0)
    left, top = x.astype(np.int64), y.astype(np.int64)
    right, low = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left)[:, None], (y - top)[:, None]
    upper = pixels[top, left] * (1.0 - across) + pixels[top, right] * across
    lower = pixels[low, left] * (1.0 - across) + pixels[low, right] * across
    return np.rint(upper * (1.0 - down) + lower * down).astype(np.uint8)
