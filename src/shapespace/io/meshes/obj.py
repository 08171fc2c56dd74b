"""Wavefront OBJ: `v` and `f` lines, and colours of vertices or of the textures of materials (`mtllib`, `map_Kd`).

Texture seams, normals and groups are ignored.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterable
from functools import partial
from itertools import chain
from pathlib import Path

import numpy as np

from shapespace.io.meshes.textures import CompanionFiles, Pictures, TextureError
from shapespace.io.parsing import (
    CUT_SHORT,
    SPACE,
    IndexArray,
    colours_of_words,
    damage_error,
    fan_triangles,
    floats,
    ints,
    join_parts,
    joined_colours,
    line_blocks,
    mesh_of,
    number_lines,
    numeric_text,
    plain_text,
)
from shapespace.types import GREY, ByteArray, FloatArray, Mesh

_COLOURED_WORDS = 7
"""Number of words of a line `v x y z r g b`."""
_LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", re.MULTILINE)
_LARGEST_LIBRARIES = 2**22
"""Limit of the total size of the materials files of a surface (4 MiB); files of scanners have some hundred bytes."""
_LIBRARY, _PICTURE = "its materials file", "its picture"


def read_obj(data: bytes, path: Path) -> Mesh:
    """Read OBJ: one vertex for each `v` line, in the file's order, and polygons as fans.

    Negative indices count back from the last `v` line above. Colours are those after `x y z` if all vertices have them,
    or else those of the textures; a note gives the reason if a texture cannot be read. Weights are ignored.

    Args:
        data: complete content of the file.
        path: path of the OBJ file; materials and textures are read from its folder only.

    Raises:
        FileFormatError: it has no `v` line, a line with too few numbers, or an index of zero.
        MeshError: faces that point past the end of the vertices.
    """
    data = numeric_text(data, path)
    if b"\\" in data:
        data = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    vertices: list[FloatArray] = []
    colours: list[FloatArray | None] = []
    faces: list[IndexArray] = []
    count = polygon_count = 0
    for lines in line_blocks(data):
        points: list[list[bytes]] = []
        polygons: list[list[bytes]] = []
        vertices_above: list[int] = []
        for line in lines:
            words = line.split()
            if not words:
                continue
            if words[0] == b"v":
                points.append(words)
            elif words[0] == b"f":
                polygons.append(words)
                vertices_above.append(count + len(points))
        if points:
            vertices.append(_points(points, count, path))
            # Six numbers are x y z and a colour; a fourth alone is a weight.
            is_coloured = set(map(len, points)) == {_COLOURED_WORDS}
            colours.append(colours_of_words(points, 4, path) if is_coloured else None)
            count += len(points)
        if polygons:
            faces.append(_faces(polygons, vertices_above, polygon_count, path))
            polygon_count += len(polygons)
    if not count:
        raise damage_error(path, "it has no 'v' lines, so it is not an OBJ file or contains no points")
    vertex_colours = joined_colours(colours)
    notes: tuple[str, ...] = ()
    if vertex_colours is None:
        vertex_colours, notes = _texture_colours(data, count, path)
    if b"\nl " in data:
        notes = (*notes, "Its lines (l) are not a surface; only their points are read. Save them as VTK for curves.")
    header = data[: data.find(b"\nv")]
    return mesh_of(np.concatenate(vertices), join_parts(faces, np.int64, 3), path, vertex_colours, notes, header=header)


def _points(points: list[list[bytes]], lines_before: int, path: Path) -> FloatArray:
    widths = set(map(len, points))
    if min(widths) < 4:
        line_number = lines_before + next(i for i, words in enumerate(points) if len(words) < 4)
        raise damage_error(path, f"vertex {line_number + 1} has fewer than three numbers; {CUT_SHORT}")
    if len(widths) == 1:
        flat = list(chain.from_iterable(points))
        return np.stack([floats(flat[axis :: len(points[0])], path) for axis in (1, 2, 3)], axis=1)
    return floats(chain.from_iterable(words[1:4] for words in points), path).reshape(-1, 3)


def _faces(polygons: list[list[bytes]], vertices_above: list[int], lines_before: int, path: Path) -> IndexArray:
    # Comments after the corners are rare; lines are parsed again only if one contains a mark.
    if any(b"#" in word for words in polygons for word in (words[-1], *words[4:])):
        polygons = [b" ".join(words).partition(b"#")[0].split() for words in polygons]
    counts = np.fromiter(map(len, polygons), dtype=np.int64, count=len(polygons)) - 1
    if counts.min() < 3:
        line_number = lines_before + int(np.argmin(counts))
        raise damage_error(path, f"face {line_number + 1} has fewer than three corners; {CUT_SHORT}")
    tokens = chain.from_iterable(words[1:] for words in polygons)
    corners = ints((token.partition(b"/")[0] for token in tokens), path)
    if (corners == 0).any():
        raise damage_error(path, "a face points at vertex 0, but OBJ counts from 1; export it again")
    declared = np.repeat(np.array(vertices_above, dtype=np.int64), counts)
    absolute = np.where(corners > 0, corners - 1, corners + declared)
    if absolute.min() < 0:
        raise damage_error(path, f"a face points back past the first vertex; {CUT_SHORT}")
    return fan_triangles(counts, absolute)


def _texture_colours(data: bytes, vertices: int, path: Path) -> tuple[ByteArray | None, tuple[str, ...]]:
    """Return the colours (V, 3) of a surface from its textures, or None, and notes on the reason.

    A vertex has the colour at its first corner; vertices without a textured face are grey.

    Args:
        data: content of the OBJ file, already checked for damage.
        vertices: number of vertices, V.
        path: path of the OBJ file; materials and textures are read from its folder only.
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
    """Return material -> name of its picture, of all materials files; a file with several spellings is read once."""
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
            # Options such as -s 1 1 1 precede the name; a name without options may contain spaces.
            pictures[material] = (value.split()[-1] if value.startswith(b"-") else value).decode("utf-8", "replace")
    return pictures


def _colours(data: bytes, vertices: int, pictures: dict[bytes, str], files: CompanionFiles) -> ByteArray | None:
    uv, corners, materials = _corners(data)
    if not len(corners):
        return None
    vertex_rows, texture = corners[:, 0], corners[:, 1]
    is_valid = (vertex_rows >= 0) & (vertex_rows < vertices) & (texture >= 0) & (texture < len(uv))
    # For equal indices, numpy assigns the last value; reversed, it is that of the first corner.
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
    # The index of the picture of each material, -1 for none, and then of each vertex.
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
    """Return texture coordinates (T, 2), the vertex, coordinate and material of each corner, and material indices."""
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


def write_obj(mesh: Mesh) -> bytes:
    """Return `mesh` as OBJ text with 17 significant digits, so that reading it back is exact, colours after them."""
    pattern = "v %.17g %.17g %.17g"
    if mesh.colours is None:
        text = number_lines(mesh.vertices, pattern)
    else:
        text = number_lines(np.hstack([mesh.vertices, mesh.colours / 255.0]), f"{pattern} %.6g %.6g %.6g")
    if mesh.faces is not None:
        text += number_lines(mesh.faces.astype(np.int64) + 1, "f %d %d %d")
    return f"# {SPACE}\n{text}".encode("ascii")
