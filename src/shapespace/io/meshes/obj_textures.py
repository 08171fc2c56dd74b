"""Vertex colours of OBJ surfaces from the textures of their materials (`mtllib`, `map_Kd`)."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.meshes.textures import CompanionFiles, Pictures, TextureError
from shapespace.io.parsing import line_blocks, plain_text
from shapespace.types import GREY, ByteArray

_LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
_LARGEST_LIBRARIES = 2**22
"""Limit of the bytes of all materials files of one surface (4 MiB); those of scanners have some hundred."""
_LIBRARY, _PICTURE = "its materials file", "its picture"


def texture_colours(data: bytes, vertices: int, path: Path) -> tuple[ByteArray | None, tuple[str, ...]]:
    """Return the colours (V, 3) of a surface from its pictures, or None, and what kept them from being read.

    A vertex takes the colour at the first of its corners; one that no textured face uses is grey.

    Args:
        data: of the OBJ file, found to be whole.
        vertices: V.
        path: of the OBJ file; materials and pictures are read from its folder and from nowhere else.
    """
    libraries = _LIBRARIES.findall(data)
    if not libraries or b"vt" not in data:
        return None, ()
    try:
        files = CompanionFiles(path)
        pictures = _libraries(files, dict.fromkeys(libraries))
        if not pictures:
            return None, ()
        return _colours(data, vertices, pictures, files), ()
    except TextureError as reason:
        return None, (f"It is read without its colours: {reason}.",)


def _libraries(files: CompanionFiles, names: Iterable[bytes]) -> dict[bytes, str]:
    """Return material -> name of its picture, of all materials files; each is read once, however it is spelled."""
    paths = dict.fromkeys(files.find(name.strip().decode("utf-8", "replace"), _LIBRARY) for name in names)
    pictures: dict[bytes, str] = {}
    left = _LARGEST_LIBRARIES
    for file in paths:
        text = files.read(file, _LIBRARY, left)
        left -= len(text)
        pictures |= _pictures(plain_text(text))
    return pictures


def _pictures(library: bytes) -> dict[bytes, str]:
    """Return material -> name of its picture."""
    pictures: dict[bytes, str] = {}
    material = b""
    for line in chain.from_iterable(line_blocks(library)):
        key, _, value = line.strip().partition(b" ")
        value = value.strip()
        if key == b"newmtl":
            material = value
        elif key.lower() == b"map_kd" and value:
            # Options such as -s 1 1 1 stand before the name, which else may hold spaces.
            pictures[material] = (value.split()[-1] if value.startswith(b"-") else value).decode("utf-8", "replace")
    return pictures


def _colours(data: bytes, vertices: int, pictures: dict[bytes, str], files: CompanionFiles) -> ByteArray | None:
    uv, corners, materials = _corners(data)
    if not len(corners):
        return None
    vertex_rows, texture = corners[:, 0], corners[:, 1]
    is_valid = (vertex_rows >= 0) & (vertex_rows < vertices) & (texture >= 0) & (texture < len(uv))
    # Of equal indices numpy keeps the last, and the first corner is wanted.
    first = np.full(vertices, -1, dtype=np.int64)
    first[vertex_rows[is_valid][::-1]] = np.flatnonzero(is_valid)[::-1]
    out = np.full((vertices, 3), GREY, dtype=np.uint8)
    textured = np.flatnonzero(first >= 0)
    material = corners[first[textured], 2]
    used = np.zeros(len(materials), dtype=bool)
    used[material] = True
    names = [pictures.get(name) if is_used else None for name, is_used in zip(materials, used, strict=True)]
    targets = {name: files.find(name, _PICTURE) for name in names if name is not None}
    numbers = {target: number for number, target in enumerate(dict.fromkeys(targets.values()))}
    # The number of the picture of each material, -1 for none, and so of each vertex.
    of_material = np.array([-1 if name is None else numbers[targets[name]] for name in names], dtype=np.int64)
    of_vertex = of_material[material]
    order = np.argsort(of_vertex, kind="stable")
    bounds = np.searchsorted(of_vertex[order], np.arange(-1, len(numbers)), side="right")
    images = Pictures()
    for target, begin, end in zip(numbers, bounds[:-1], bounds[1:], strict=True):
        corners_here = textured[order[begin:end]]
        content = partial(files.read, target, _PICTURE)
        out[corners_here] = images.sampled(target.name, content, uv[texture[first[corners_here]]], str(target))
    return out


def _corners(data: bytes) -> tuple[np.ndarray, np.ndarray, dict[bytes, int]]:
    """Return the texture coordinates (T, 2), of each corner its vertex, coordinate and material, and these by name."""
    uv, corners = array("d"), array("q")
    materials: dict[bytes, int] = {b"": 0}
    n_vertices = current = 0
    try:
        for lines in line_blocks(data):
            for line in lines:
                words = line.split()
                if not words:
                    continue
                key = words[0]
                if key == b"v":
                    n_vertices += 1
                elif key == b"vt":
                    uv.extend((float(words[1]), float(words[2]) if len(words) > 2 else 0.0))
                elif key == b"usemtl":
                    current = materials.setdefault(line.strip().partition(b" ")[2].strip(), len(materials))
                elif key == b"f":
                    for word in words[1:]:
                        vertex, _, tail = word.partition(b"/")
                        texture = tail.partition(b"/")[0]
                        if texture:
                            v, t = int(vertex), int(texture)
                            corners.extend(
                                (v - 1 if v > 0 else n_vertices + v, t - 1 if t > 0 else len(uv) // 2 + t, current)
                            )
    except (ValueError, IndexError, OverflowError) as error:
        raise TextureError("its texture coordinates are damaged") from error
    return np.array(uv).reshape(-1, 2), np.array(corners, dtype=np.int64).reshape(-1, 3), materials
