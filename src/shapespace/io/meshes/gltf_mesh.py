"""glTF 2.0 reader and writer, as `.gltf` with its buffers and as one `.glb` file; see the Khronos specification.

trimesh reads glTF too, but it decodes textures, merges by material and raises internal errors for damaged files.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.files import read_bytes
from shapespace.io.meshes.textures import CompanionFiles, Pictures, TextureError
from shapespace.io.parsing import (
    CUT_SHORT,
    IndexArray,
    check_count,
    damage_error,
    fan_triangles,
    json_value,
    mesh_of,
    strip_triangles,
)
from shapespace.io.read_limits import LARGEST_MESH_FILE_BYTES, Allowance
from shapespace.types import GREY, ByteArray, FloatArray, IntArray, Mesh

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# glTF 2.0 primitive.mode: POINTS, TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
_VERTICES, _CORNERS = 34962, 34963  # glTF 2.0 bufferView.target: ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER
_COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
# Extensions that a file may require and that do not affect its points and triangles.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_", "KHR_xmp")
_HARMLESS_TOO = ("KHR_mesh_quantization", "KHR_animation_pointer")
# Far from the origin float32 is too coarse, so the node stores the centre, in double precision.
_FAR = 16.0

Values = npt.NDArray[Any]
Found = TypeVar("Found")


@dataclass(frozen=True, eq=False)
class Morphs:
    """A mesh with morph targets.

    Args:
        vertices: (V, 3) positions for weights of zero, in the frame of the scene.
        faces: (F, 3) triangles, or None for a point cloud.
        targets: (K, V, 3) displacement of the vertices per unit of each weight.
        names: (K,) names of the targets; empty if the file has none.
        weights: (K,) weights in the file.
        extras: application-specific data of the mesh.
        copyright: copyright notice of the file.
        n_others: number of other meshes in the scene.
    """

    vertices: FloatArray
    faces: IndexArray | None
    targets: FloatArray
    names: tuple[str, ...]
    weights: tuple[float, ...]
    extras: Any
    copyright: str
    n_others: int


@dataclass
class _Gltf:
    """The JSON of a file and its buffers."""

    path: Path
    tree: dict[str, Any]
    binary: bytes | None
    allowance: Allowance
    buffers: dict[str | None, bytes] = field(default_factory=lambda: dict[str | None, bytes]())
    pictures: Pictures = field(default_factory=Pictures)
    files: CompanionFiles = field(init=False)

    def __post_init__(self) -> None:
        self.files = CompanionFiles(self.path)

    def buffer(self, index: int) -> bytes:
        entry = self.tree["buffers"][index]
        uri = entry.get("uri")
        if uri is None and index != 0:
            raise self.compressed("a buffer has no data")
        # The URI is the key, because several buffers may refer to one file.
        if uri not in self.buffers:
            data = self.binary if uri is None else self.fetch(uri)
            self.buffers[uri] = b"" if data is None else data
        data = self.buffers[uri]
        if len(data) < entry["byteLength"]:
            raise damage_error(self.path, f"its buffer {index} is shorter than declared; {CUT_SHORT}")
        return data

    def fetch(self, uri: str) -> bytes:
        """Return the bytes of a buffer inside the JSON, or in a file in its folder."""
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            if not head.endswith(";base64"):
                raise damage_error(self.path, "it has a buffer that is not base64; export it again")
            return base64.b64decode(body, validate=True)
        folder = self.path.parent.resolve()
        try:
            target = (folder / unquote(uri)).resolve()
            is_there = target.exists()
        except OSError as error:  # a name too long for the system
            raise damage_error(self.path, f"it names a buffer '{uri[:80]}' that is not a file; {CUT_SHORT}") from error
        if "://" in uri or not target.is_relative_to(folder):
            raise damage_error(self.path, f"it names a buffer outside its folder ('{uri[:80]}'), which is not read")
        if not is_there:
            raise damage_error(self.path, f"its buffer '{uri[:80]}' is missing in its folder; copy that file there")
        try:
            data = read_bytes(target, max(LARGEST_MESH_FILE_BYTES - self.allowance.file_bytes, 0))
        except FileError as error:
            raise damage_error(self.path, f"its buffer '{uri[:80]}' cannot be read or is too long") from error
        self.allowance.more_file(len(data))
        return data

    def compressed(self, otherwise: str) -> FileFormatError:
        """Return the error for missing data, which names the compression that the file declares, if any."""
        used = self.tree.get("extensionsUsed", [])
        extension = next((name for name in _COMPRESSIONS if name in used), None)
        if extension is None:
            return damage_error(self.path, f"{otherwise}; {CUT_SHORT}")
        return damage_error(self.path, f"it is compressed ({extension}), so export it again without compression")

    def view(self, index: int, offset: int, kind: np.dtype[Any], count: int, width: int) -> Values:
        """Return (count, width) numbers from a buffer view."""
        view = self.tree["bufferViews"][index]
        data = self.buffer(view["buffer"])
        row = kind.itemsize * width
        stride = view.get("byteStride", row)
        start = view.get("byteOffset", 0) + offset
        end = view.get("byteOffset", 0) + view["byteLength"]
        if min(start, stride, offset, count) < 0 or stride < row or end > len(data):
            raise ValueError("buffer view")
        if count == 0:
            return np.zeros((0, width), dtype=kind)
        if start + (count - 1) * stride + row > end:
            check_count(count, stride, end - start, "numbers in an accessor", self.path)
            raise ValueError("buffer view")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def accessor(self, index: int) -> Values:
        """Return the (count, width) values of an accessor; normalised integers become float64."""
        if index < 0:
            raise IndexError(index)
        entry = self.tree["accessors"][index]
        kind = np.dtype(_COMPONENTS[entry["componentType"]])
        width, count = _WIDTHS[entry["type"]], int(entry["count"])
        if count < 0:
            raise ValueError("count")
        # Every array is converted to eight bytes per number.
        self.allowance.take(count * width, 8)
        if "bufferView" in entry:
            values = self.view(entry["bufferView"], entry.get("byteOffset", 0), kind, count, width).copy()
        elif "sparse" in entry:
            values = np.zeros((count, width), dtype=kind)
        else:
            raise self.compressed("its points or triangles have no data")
        if "sparse" in entry:
            sparse = entry["sparse"]
            index_view, value_view = sparse["indices"], sparse["values"]
            index_kind = np.dtype(_COMPONENTS[index_view["componentType"]])
            n = int(sparse["count"])
            element_rows = self.view(index_view["bufferView"], index_view.get("byteOffset", 0), index_kind, n, 1)[:, 0]
            values[element_rows] = self.view(value_view["bufferView"], value_view.get("byteOffset", 0), kind, n, width)
        if entry.get("normalized") and kind.kind in "iu":
            return np.maximum(values / np.iinfo(kind).max, -1.0)
        return values


def read_gltf(data: bytes, path: Path) -> Mesh:
    """Read glTF or GLB: all meshes of the scene in the order of its nodes, moved by the nodes' transforms.

    Primitives that share their positions share their vertices here too. Morph targets are applied with the
    weights of the node or mesh; skins, lines and animations are ignored. The unit of glTF is metres. Colours are those
    of the vertices, or else of the base colour textures; a note gives the reason if a texture cannot be read.

    Args:
        data: complete content of the file.
        path: path of the file; external buffers are read from its folder only.

    Raises:
        FileFormatError: it is not glTF 2.0, is cut short, is compressed, requires an unsupported extension,
            contains no points, or exceeds the limits of `io.read_limits`.
        MeshError: faces that point past the end of the vertices.
    """
    return _parse(data, path, _scene)


def read_morphs(data: bytes, path: Path) -> Morphs:
    """Read the mesh with morph targets that has most vertices in glTF or GLB, and count the other meshes.

    Args:
        data: complete content of the file.
        path: path of the file; external buffers are read from its folder only.

    Raises:
        FileFormatError: no mesh has morph targets, or see `read_gltf`.
    """
    return _parse(data, path, _morphs)


def _parse(data: bytes, path: Path, build: Callable[[_Gltf], Found]) -> Found:
    binary: bytes | None = None
    if data[:4] == b"glTF":
        text, binary = _chunks(data, path)
    else:
        text = data
    tree = json_value(text, path)
    # Any part of the JSON may be missing or of the wrong type; such errors are handled here only.
    try:
        if not str(tree["asset"]["version"]).startswith("2"):
            raise damage_error(path, "it is not glTF of version 2")
        _check_extensions(tree.get("extensionsRequired", []), path)
        return build(_Gltf(path, tree, binary, Allowance(len(data), path)))
    except (FileError, InputError):
        raise
    except (KeyError, IndexError, TypeError, AttributeError, OverflowError, ValueError) as error:
        raise damage_error(path, f"it is not valid glTF; {CUT_SHORT}") from error


def _check_extensions(required: list[Any], path: Path) -> None:
    for name in map(str, required):
        if name in _COMPRESSIONS:
            raise damage_error(path, f"it is compressed ({name}), so export it again without compression")
        if name not in _HARMLESS_TOO and not name.startswith(_HARMLESS):
            raise damage_error(
                path, f"it requires the extension '{name[:60]}', which is not supported, so export it again without it"
            )


def _chunks(data: bytes, path: Path) -> tuple[bytes, bytes | None]:
    version, length = int.from_bytes(data[4:8], "little"), int.from_bytes(data[8:12], "little")
    if version != 2:
        raise damage_error(path, f"it is GLB of version {version}, not 2")
    if length > len(data):
        raise damage_error(path, f"it declares {length} bytes, but has {len(data)}; {CUT_SHORT}")
    offset = 12
    chunks: dict[bytes, bytes] = {}
    while offset + 8 <= length:
        size, kind = int.from_bytes(data[offset : offset + 4], "little"), data[offset + 4 : offset + 8]
        if offset + 8 + size > length:
            raise damage_error(path, f"it ends inside a chunk; {CUT_SHORT}")
        chunks.setdefault(kind, data[offset + 8 : offset + 8 + size])
        offset += 8 + size
    if b"JSON" not in chunks:
        raise damage_error(path, f"it has no JSON chunk; {CUT_SHORT}")
    return chunks[b"JSON"], chunks.get(b"BIN\0")


def _nodes_with_meshes(gltf: _Gltf) -> Iterator[tuple[dict[str, Any], FloatArray]]:
    """Yield the nodes of the scene with a mesh, and their (4, 4) transforms to the frame of the scene."""
    tree = gltf.tree
    nodes: list[Any] = tree.get("nodes", [])
    scenes: list[Any] = tree.get("scenes", [])
    if scenes:
        scene: Any = scenes[tree.get("scene", 0)]
        roots: list[int] = list(scene.get("nodes", []))
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in children]
    if not nodes and tree.get("meshes"):
        nodes, roots = [{"mesh": i} for i in range(len(tree["meshes"]))], list(range(len(tree["meshes"])))
    visited: set[int] = set()
    stack: list[tuple[int, FloatArray]] = [(int(root), np.eye(4)) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        if index in visited or index < 0:
            raise damage_error(gltf.path, "its nodes do not form a tree; export it again")
        visited.add(index)
        gltf.allowance.part()
        node = nodes[index]
        matrix = parent @ _local_transform(node)
        stack += [(int(child), matrix) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            yield node, matrix


def _scene(gltf: _Gltf) -> Mesh:
    points: list[FloatArray] = []
    colours: list[ByteArray | None] = []
    notes: list[str] = []
    faces: list[IndexArray] = []
    n_vertices = 0
    for node, matrix in _nodes_with_meshes(gltf):
        for vertices, triangles, vertex_colours, _ in _primitives(gltf, node, notes):
            gltf.allowance.take(3 * (len(vertices) + (0 if triangles is None else len(triangles))), 8)
            points.append(vertices @ matrix[:3, :3].T + matrix[:3, 3])
            if triangles is not None:
                faces.append(_keep_orientation(triangles, matrix) + n_vertices)
            colours.append(vertex_colours)
            n_vertices += len(vertices)
    if not points:
        raise damage_error(gltf.path, "its scene contains no points and no triangles")
    joined = np.concatenate(faces) if faces else None
    return mesh_of(
        np.concatenate(points), joined, gltf.path, _join_colours(points, colours), tuple(dict.fromkeys(notes))
    )


def _keep_orientation(triangles: IndexArray, matrix: FloatArray) -> IndexArray:
    """Return triangles (F, 3), flipped if a transform (4, 4) is mirroring, which reverses their orientation."""
    return triangles[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else triangles


def _join_colours(points: list[FloatArray], colours: list[ByteArray | None]) -> ByteArray | None:
    """Return the colours of all parts, grey for parts without colours; None if no part has colours."""
    if all(part is None for part in colours):
        return None
    pairs = zip(points, colours, strict=True)
    return np.concatenate(
        [np.full(positions.shape, GREY, np.uint8) if part is None else part for positions, part in pairs]
    )


def _morphs(gltf: _Gltf) -> Morphs:
    """Return the mesh with morph targets that has most vertices."""
    mesh_nodes = list(_nodes_with_meshes(gltf))
    sizes = [_morphed_vertices(gltf, node) for node, _ in mesh_nodes]
    if not any(sizes):
        raise damage_error(gltf.path, "it has no mesh with morph targets")
    node, matrix = mesh_nodes[int(np.argmax(sizes))]
    mesh = gltf.tree["meshes"][node["mesh"]]
    count = len(mesh["primitives"][0]["targets"])
    gltf.allowance.part(count)
    # Without weights, so that the result is the base shape, to which the targets are relative.
    parts = _primitives(gltf, {"mesh": node["mesh"], "weights": ()}, [])
    vertices = np.concatenate([points for points, *_ in parts])
    gltf.allowance.take(vertices.size * (count + 1), 8)
    targets = np.zeros((count, len(vertices), 3))
    n_vertices, faces = 0, list[IndexArray]()
    for points, triangles, _, primitive in parts:
        end = n_vertices + len(points)
        for k, target in enumerate(primitive.get("targets", ())):
            gltf.allowance.part()
            if "POSITION" in target:
                targets[k, n_vertices:end] = gltf.accessor(target["POSITION"]).reshape(len(points), 3)
        if triangles is not None:
            faces.append(_keep_orientation(triangles, matrix) + n_vertices)
        n_vertices = end
    rotation = matrix[:3, :3]
    extras: Any = mesh.get("extras", {})
    names = tuple(map(str, extras.get("targetNames", ()) if isinstance(extras, dict) else ()))  # pyright: ignore[reportUnknownMemberType, reportUnknownArgumentType]
    weights = node.get("weights", mesh.get("weights", []))
    return Morphs(
        vertices=vertices @ rotation.T + matrix[:3, 3],
        faces=np.concatenate(faces) if faces else None,
        targets=targets @ rotation.T,
        names=names if len(names) == count else (),
        weights=tuple(float(weight) for weight in weights),
        extras=extras,
        copyright=str(gltf.tree["asset"].get("copyright", "")),
        n_others=len(mesh_nodes) - 1,
    )


def _morphed_vertices(gltf: _Gltf, node: dict[str, Any]) -> int:
    primitives = gltf.tree["meshes"][node["mesh"]]["primitives"]
    gltf.allowance.part(len(primitives))
    accessors = gltf.tree["accessors"]
    return sum(
        int(accessors[primitive["attributes"]["POSITION"]]["count"])
        for primitive in primitives
        if primitive.get("targets")
    )


def _local_transform(node: dict[str, Any]) -> FloatArray:
    """Return the (4, 4) transform of a node, from its matrix or its translation, rotation and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), dtype=np.float64).reshape(1, 3)
    out[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=np.float64).reshape(3)
    return out


def _primitives(
    gltf: _Gltf, node: dict[str, Any], notes: list[str]
) -> list[tuple[FloatArray, IndexArray | None, ByteArray | None, dict[str, Any]]]:
    """Return points, triangles, colours and first primitive of each group of primitives that share positions."""
    mesh = gltf.tree["meshes"][node["mesh"]]
    weights = node.get("weights", mesh.get("weights", []))
    vertices: dict[int, FloatArray] = {}
    first: dict[int, tuple[ByteArray | None, dict[str, Any]]] = {}
    triangles: dict[int, list[IndexArray]] = {}
    for primitive in mesh["primitives"]:
        gltf.allowance.part()
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_POINTS, _TRIANGLES, _STRIP, _FAN):
            continue
        key = primitive["attributes"]["POSITION"]
        if key not in vertices:
            position = gltf.accessor(key).astype(np.float64)
            if position.shape[1] != 3:
                raise ValueError("POSITION")
            for weight, target in zip(weights, primitive.get("targets", []), strict=False):
                if weight and "POSITION" in target:
                    position = position + float(weight) * gltf.accessor(target["POSITION"])
            vertices[key] = position
            first[key] = _colours(gltf, primitive, len(position), notes), primitive
        if mode == _POINTS:
            continue
        if "indices" in primitive:
            corners = gltf.accessor(primitive["indices"])[:, 0].astype(np.int64)
        else:
            corners = np.arange(len(vertices[key]), dtype=np.int64)
        gltf.allowance.take(len(corners) if mode == _TRIANGLES else 3 * len(corners), 8)
        if mode == _TRIANGLES:
            if len(corners) % 3:
                raise damage_error(gltf.path, f"its triangles have {len(corners)} corners; {CUT_SHORT}")
            corner_triples = corners.reshape(-1, 3)
        else:
            corner_triples = (strip_triangles if mode == _STRIP else fan_triangles)([len(corners)], corners)
        # Checked before joining, which would make an index past this primitive refer to the next one.
        mesh_of(vertices[key], corner_triples, gltf.path)
        triangles.setdefault(key, []).append(corner_triples)
    return [(v, np.concatenate(triangles[k]) if k in triangles else None, *first[k]) for k, v in vertices.items()]


def _colours(gltf: _Gltf, primitive: dict[str, Any], vertices: int, notes: list[str]) -> ByteArray | None:
    """Return the colours (V, 3) of the points of a primitive; None if it has no readable colours."""
    attributes = primitive["attributes"]
    try:
        if "COLOR_0" in attributes:
            values = gltf.accessor(attributes["COLOR_0"])
            return _from_linear(values[:, :3]) if len(values) == vertices and values.shape[1] >= 3 else None
        if "TEXCOORD_0" not in attributes or "material" not in primitive:
            return None
        base = gltf.tree["materials"][primitive["material"]]["pbrMetallicRoughness"]["baseColorTexture"]
        coordinates = attributes[f"TEXCOORD_{int(base.get('texCoord', 0))}"]
        number = int(gltf.tree["textures"][base["index"]]["source"])
        image = gltf.tree["images"][number]
        uv = gltf.accessor(coordinates).astype(np.float64)
        if len(uv) != vertices or uv.shape[1] != 2:
            return None
        # The origin of texture coordinates of glTF is the upper left corner.
        uv[:, 1] = 1.0 - uv[:, 1]
        uri = str(image.get("uri", ""))
        if not uri or uri.startswith("data:"):
            return gltf.pictures.sampled(f"{number} in it", partial(_picture, gltf, image), uv)
        file = gltf.files.find(unquote(uri), "its picture")
        return gltf.pictures.sampled(file.name, partial(gltf.files.read, file, "its picture"), uv, str(file))
    except TextureError as reason:
        notes.append(f"It is read without all of its colours: {reason}.")
        return None
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError, FileError):
        return None  # a damaged material does not affect the surface


def _picture(gltf: _Gltf, image: dict[str, Any]) -> bytes:
    """Return the content of a picture that is stored in a buffer or in the JSON."""
    if "bufferView" in image:
        length = int(gltf.tree["bufferViews"][image["bufferView"]]["byteLength"])
        return gltf.view(image["bufferView"], 0, np.dtype(np.uint8), length, 1).tobytes()
    return base64.b64decode(image["uri"].partition(",")[2], validate=True)


def _from_linear(values: Values) -> ByteArray | None:
    """Return sRGB colours (N, 3) of linear colours from 0 to 1."""
    light = values.astype(np.float64) / (1.0 if values.dtype.kind == "f" else np.iinfo(values.dtype).max)
    if not np.isfinite(light).all():
        return None
    light = np.clip(light, 0.0, 1.0)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * srgb).astype(np.uint8)


def _to_linear(colours: ByteArray) -> Values:
    """Return linear opaque colours (N, 4) uint16 of sRGB colours (N, 3), precise enough for an exact round trip."""
    srgb = np.arange(256) / 255.0
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    out = np.full((len(colours), 4), 65535, dtype="<u2")
    out[:, :3] = np.rint(65535.0 * light).astype(np.uint16)[colours]
    return out


class GltfBuffer:
    """Binary data of a file to write, with the position of each array."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.is_finite = True

    def vectors(self, values: FloatArray, *, bounds: bool = True) -> int:
        """Add vectors (V, 3) in single precision, positions with bounds, and return the index of their accessor."""
        with np.errstate(over="ignore"):
            single = values.astype("<f4")
        self.is_finite &= bool(np.isfinite(single).all())
        limits = {"min": single.min(axis=0).tolist(), "max": single.max(axis=0).tolist()} if bounds else {}
        return self._add(single, _VERTICES, type="VEC3", **limits)

    def indices(self, faces: IntArray) -> int:
        """Add triangles and return the index of their accessor."""
        return self._add(faces.astype("<u4").reshape(-1), _CORNERS, type="SCALAR")

    def colours(self, colours: ByteArray) -> int:
        """Add colours (V, 3) and return the index of their accessor."""
        return self._add(_to_linear(colours), _VERTICES, type="VEC4", normalized=True)

    def _add(self, values: Values, target: int, **kind: Any) -> int:
        data = values.tobytes()
        start = sum(map(len, self.parts))
        self.views.append({"buffer": 0, "byteOffset": start, "byteLength": len(data), "target": target})
        code = next(code for code, component in _COMPONENTS.items() if component == values.dtype.str)
        view = {"bufferView": len(self.views) - 1, "componentType": code, "count": len(values)}
        self.accessors.append({**view, **kind})
        self.parts.append(data)
        return len(self.accessors) - 1

    def content(
        self, mesh: Mapping[str, Any], name: str, centre: FloatArray, **asset: str
    ) -> tuple[dict[str, Any], bytes]:
        """Return the JSON of a scene with one mesh, whose positions are relative to `centre` (3,), and its buffer."""
        translation = {"translation": centre.tolist()} if centre.any() else {}
        tree = {
            "asset": {"version": "2.0", "generator": "shapespace", **asset},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": name, **translation}],
            "meshes": [mesh],
            "accessors": self.accessors,
            "bufferViews": self.views,
        }
        return tree, b"".join(self.parts)


def centre_if_far(points: FloatArray) -> FloatArray:
    """Return the centre (3,) of points (V, 3) that are far from the origin relative to their size, else zeros."""
    low, high = points.min(axis=0), points.max(axis=0)
    extent = max(float((high - low).max()), np.finfo(np.float64).tiny)
    return (low + high) / 2 if np.abs([low, high]).max() > _FAR * extent else np.zeros(3)


def _content(mesh: Mesh) -> tuple[dict[str, Any], bytes]:
    if not len(mesh.vertices):
        raise InputError(f"{mesh.name} has no points, so it cannot be written as glTF.")
    if not np.isfinite(mesh.vertices).all():
        raise InputError(f"{mesh.name} has points that are not finite, which glTF cannot store; write it as PLY.")
    centre, buffer = centre_if_far(mesh.vertices), GltfBuffer()
    primitive: dict[str, Any] = {"attributes": {"POSITION": buffer.vectors(mesh.vertices - centre)}, "mode": _POINTS}
    if not buffer.is_finite:
        raise InputError(f"{mesh.name} has coordinates too large for glTF; write it as PLY instead.")
    if mesh.faces is not None:
        primitive |= {"indices": buffer.indices(mesh.faces), "mode": _TRIANGLES}
    if mesh.colours is not None:
        primitive["attributes"]["COLOR_0"] = buffer.colours(mesh.colours)
    return buffer.content({"primitives": [primitive]}, mesh.name, centre)


def write_gltf(mesh: Mesh) -> bytes:
    """Return `mesh` as one glTF JSON file with its buffer inside, in float32; coordinates are not converted to metres.

    Raises:
        InputError: no points, or coordinates that are not finite or too large for float32.
    """
    return gltf_bytes(*_content(mesh))


def write_glb(mesh: Mesh) -> bytes:
    """Return `mesh` as binary glTF, in float32; coordinates are not converted to metres, the unit of glTF.

    Raises:
        InputError: no points, or coordinates that are not finite or too large for float32.
    """
    return glb_bytes(*_content(mesh))


def gltf_bytes(tree: dict[str, Any], binary: bytes) -> bytes:
    """Return the JSON file of `tree` with `binary`, its only buffer, inside."""
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    return json.dumps({**tree, "buffers": [{"byteLength": len(binary), "uri": uri}]}).encode("utf-8")


def glb_bytes(tree: dict[str, Any], binary: bytes) -> bytes:
    """Return the binary file of `tree` and `binary`, its only buffer."""
    text = json.dumps({**tree, "buffers": [{"byteLength": len(binary)}]}).encode("utf-8")
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    out = b"glTF" + (2).to_bytes(4, "little") + length.to_bytes(4, "little")
    out += len(text).to_bytes(4, "little") + b"JSON" + text
    return out + len(binary).to_bytes(4, "little") + b"BIN\0" + binary
