"""Colours of OBJ surfaces from the pictures that their materials name (`mtllib`, `map_Kd`), one a vertex."""

from __future__ import annotations

import re
from array import array
from functools import partial
from pathlib import Path

import numpy as np

from shapespace.io.parsing import line_blocks, plain_text
from shapespace.io.textures import Pictures, TextureError, beside
from shapespace.types import GREY, ByteArray

_LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
_LARGEST_LIBRARY = 2**22


def texture_colours(data: bytes, vertices: int, path: Path) -> tuple[ByteArray | None, tuple[str, ...]]:
    """Return the colours (V, 3) of a surface from its pictures, or None, and what kept them from being read.

    A vertex takes the colour at the first of its corners; one that no textured face uses is grey.

    Args:
        data: of the OBJ file, found to be whole.
        vertices: V.
        path: of the OBJ file; materials and pictures are read from its folder and from nowhere else.
    """
    named = _LIBRARIES.findall(data)
    if not named or b"vt" not in data:
        return None, ()
    try:
        pictures: dict[bytes, str] = {}
        for library in dict.fromkeys(named):
            text = beside(path, library.strip().decode("utf-8", "replace"), "its materials file", _LARGEST_LIBRARY)
            pictures |= _pictures(plain_text(text))
        if not pictures:
            return None, ()
        return _colours(data, vertices, pictures, path), ()
    except TextureError as reason:
        return None, (f"It is read without its colours: {reason}.",)


def _pictures(library: bytes) -> dict[bytes, str]:
    """Return material -> name of its picture."""
    found: dict[bytes, str] = {}
    material = b""
    for line in library.splitlines():
        key, _, rest = line.strip().partition(b" ")
        rest = rest.strip()
        if key == b"newmtl":
            material = rest
        elif key.lower() == b"map_kd" and rest:
            # Options such as -s 1 1 1 stand before the name, which else may hold spaces.
            found[material] = (rest.split()[-1] if rest.startswith(b"-") else rest).decode("utf-8", "replace")
    return found


def _colours(data: bytes, vertices: int, pictures: dict[bytes, str], path: Path) -> ByteArray | None:
    uv, corners, materials = _corners(data)
    if not len(corners):
        return None
    at, texture = corners[:, 0], corners[:, 1]
    good = (at >= 0) & (at < vertices) & (texture >= 0) & (texture < len(uv))
    # Of equal indices numpy keeps the last, and the first corner is wanted.
    first = np.full(vertices, -1, dtype=np.int64)
    first[at[good][::-1]] = np.flatnonzero(good)[::-1]
    out = np.full((vertices, 3), GREY, dtype=np.uint8)
    seen = first >= 0
    shown = Pictures()
    names = list(materials)
    for name in dict.fromkeys(pictures.values()):
        codes = [k for k, material in enumerate(names) if pictures.get(material) == name]
        mine = np.flatnonzero(seen)[np.isin(corners[first[seen], 2], codes)]
        if len(mine):
            content = partial(beside, path, name, "its picture")
            out[mine] = shown.sampled(name, content, uv[texture[first[mine]]])
            seen[mine] = False
    return out


def _corners(data: bytes) -> tuple[np.ndarray, np.ndarray, dict[bytes, int]]:
    """Return the texture coordinates (T, 2), of each corner its vertex, coordinate and material, and these by name."""
    uv, corners = array("d"), array("q")
    materials: dict[bytes, int] = {b"": 0}
    above = now = 0
    try:
        for lines in line_blocks(data):
            for line in lines:
                words = line.split()
                if not words:
                    continue
                key = words[0]
                if key == b"v":
                    above += 1
                elif key == b"vt":
                    uv.extend((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
                elif key == b"usemtl":
                    now = materials.setdefault(line.strip().partition(b" ")[2].strip(), len(materials))
                elif key == b"f":
                    for word in words[1:]:
                        vertex, _, rest = word.partition(b"/")
                        texture = rest.partition(b"/")[0]
                        if texture:
                            v, t = int(vertex), int(texture)
                            corners.extend((v - 1 if v > 0 else above + v, t - 1 if t > 0 else len(uv) // 2 + t, now))
    except (ValueError, IndexError, OverflowError) as error:
        raise TextureError("its texture coordinates are damaged") from error
    return np.array(uv).reshape(-1, 2), np.array(corners, dtype=np.int64).reshape(-1, 3), materials
