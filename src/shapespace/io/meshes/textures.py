"""Textures of surfaces, sampled to vertex colours; read with Pillow from the extra `report`.

If a texture cannot be read, the surface has no colours, and a note gives the reason: a fit needs only the shape.
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
"""Largest size of the file of a picture (256 MiB)."""

MOST_PIXELS = 2**26
"""Largest number of pixels of a picture (8192 x 8192)."""

MOST_PIXELS_IN_ALL = 2**28
"""Largest number of pixels of all pictures of a surface."""

MOST_BYTES_IN_ALL = 2**29
"""Largest total size of the files of materials and pictures of a surface (512 MiB)."""

MOST_NAMES = 2**14
"""Largest number of files of materials and pictures that a surface names; a lookup takes about 40 microseconds."""

_SIDE = 2048  # pixels; textures are sampled at vertices, so a higher resolution only costs memory
_KINDS = ("JPEG", "PNG", "BMP", "TIFF")


class TextureError(Exception):
    """The reason why a texture cannot be used, as a clause."""


class CompanionFiles:
    """Materials and textures in the folder of a surface or below it, at most `MOST_BYTES_IN_ALL` together.

    Args:
        path: path of the file of the surface.
    """

    def __init__(self, path: Path) -> None:
        self._folder = path.parent.resolve()
        self._found: dict[str, Path] = {}
        self._bytes = MOST_BYTES_IN_ALL

    def find(self, name: str, file_kind: str) -> Path:
        """Return the resolved path of the file called `name`, so that two spellings of one file are recognised.

        Args:
            name: name of the file, as in the file of the surface.
            file_kind: description of the file, used in messages.

        Raises:
            TextureError: it is in another folder or does not exist, or the surface names too many files.
        """
        if name in self._found:
            return self._found[name]
        if len(self._found) >= MOST_NAMES:
            raise TextureError(f"it names more than {MOST_NAMES:,} files of materials and pictures")
        short = _printable_name(name)
        try:
            target = (self._folder / PurePosixPath(name.replace("\\", "/"))).resolve()
            if "://" in name or not target.is_relative_to(self._folder):
                raise TextureError(f"{file_kind} '{short}' is outside its folder, and is not read")
            if not target.is_file():
                raise TextureError(f"{file_kind} '{short}' is not in its folder")
        except (OSError, ValueError, RuntimeError) as error:
            raise TextureError(f"{file_kind} '{short}' cannot be read") from error
        self._found[name] = target
        return target

    def read(self, file: Path, file_kind: str, at_most: int = LARGEST_FILE_BYTES) -> bytes:
        """Return the content of a file that `find` returned.

        Args:
            file: resolved path of the file.
            file_kind: description of the file, used in messages.
            at_most: largest allowed size of the file, bytes.

        Raises:
            TextureError: it cannot be read, is too long, or exceeds the total limit with the files read before.
        """
        try:
            content = read_bytes(file, min(at_most, self._bytes))
        except (ShapespaceError, OSError) as error:
            raise TextureError(f"{file_kind} '{_printable_name(file.name)}' cannot be read") from error
        self._bytes -= len(content)
        return content


class Pictures:
    """Textures of one surface, each unpacked once, with at most `MOST_PIXELS_IN_ALL` pixels together."""

    def __init__(self) -> None:
        self._unpacked: dict[str, ByteArray | TextureError] = {}
        self._pixels = MOST_PIXELS_IN_ALL

    def sampled(self, name: str, content: Callable[[], bytes], uv: FloatArray, key: str = "") -> ByteArray:
        """Return the colours (N, 3) of a picture at `uv`, interpolated linearly between its pixels.

        Args:
            name: name of the picture, used in messages.
            content: function that returns the bytes of the JPEG, PNG, BMP or TIFF file.
            uv: (N, 2) texture coordinates from the lower left corner (0, 0) to the upper right (1, 1); the picture is
                repeated beyond this range.
            key: key of the picture in the cache, such as its resolved path; empty for its name.

        Raises:
            TextureError: Pillow is not installed, or the picture cannot be read, is damaged, unsupported or too large.
        """
        known = key or name
        if known not in self._unpacked:
            try:
                self._unpacked[known] = self._unpack(content(), _printable_name(name))
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
            raise TextureError(f"its picture '{name}' needs Pillow; run pip install 'shapespace[report]'") from error
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                image = Image.open(io.BytesIO(picture), formats=_KINDS)
                count = image.width * image.height
                if count > min(MOST_PIXELS, self._pixels):
                    raise TextureError(f"its picture '{name}' has {image.width} times {image.height} pixels, too many")
                self._pixels -= count
                # A JPEG is decoded only at the resolution that is needed.
                image.draft("RGB", (_SIDE, _SIDE))
                image.thumbnail((_SIDE, _SIDE))
                return np.asarray(image.convert("RGB"))
        except TextureError:
            raise
        except Exception as error:  # a damaged picture may raise any exception
            raise TextureError(f"its picture '{name}' is damaged or has an unsupported format") from error


def _printable_name(name: str) -> str:
    """Return a name from a file, shortened and safe to print in a terminal."""
    return "".join(letter if letter.isprintable() else "?" for letter in name[:80])


def _interpolate(pixels: ByteArray, uv: FloatArray) -> ByteArray:
    height, width = pixels.shape[:2]
    known = np.where(np.isfinite(uv), uv, 0.0)
    # A coordinate of exactly 1 is the last pixel, not the first pixel of the next repetition.
    inside = np.where((known >= 0.0) & (known <= 1.0), known, known - np.floor(known))
    x = np.clip(inside[:, 0] * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - inside[:, 1]) * height - 0.5, 0.0, height - 1.0)
    left, top = x.astype(np.int64), y.astype(np.int64)
    right, low = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    across, down = (x - left)[:, None], (y - top)[:, None]
    upper = pixels[top, left] * (1.0 - across) + pixels[top, right] * across
    lower = pixels[low, left] * (1.0 - across) + pixels[low, right] * across
    return np.rint(upper * (1.0 - down) + lower * down).astype(np.uint8)
