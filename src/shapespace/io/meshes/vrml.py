"""VRML 1 and 2 (`.wrl`): points and faces of IndexedFaceSets; textures, normals and colours are ignored.

Implemented after ISO/IEC 14772-1:1997 (VRML 2) and "VRML 1.0 Specification" (1995). BU-3DFE stores its scans as VRML 2:
one Shape with `coord Coordinate { point [ ... ] }`, `coordIndex [ a, b, c, -1, ... ]`, and textures, which are skipped.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from shapespace.errors import MeshError
from shapespace.io.parsing import (
    CUT_SHORT,
    IndexArray,
    damage_error,
    fan_triangles,
    floats,
    floats_of,
    ints_of,
    mesh_of,
    numeric_text,
    plain_text,
)
from shapespace.io.read_limits import Allowance
from shapespace.types import FloatArray, Mesh

# A string without an end extends to the end of the file, so that no position is scanned twice.
_SKIPPED = re.compile(rb'(?:(?:"(?:[^"\\]|\\.)*+(?:"|\\?\Z)|#[^\r\n]*)[\s,]*+)++', re.DOTALL)
_TO_BRACKET = re.compile(rb"[^{}\[\]]*+")
_HEXADECIMAL = re.compile(rb"(?<!\S)0[xX][0-9a-fA-F]{1,16}(?!\S)")
_TIGHT_COMMA, _LAST_COMMA, _WORD = re.compile(rb"\d,\d"), re.compile(rb",(?=\s|\Z)"), re.compile(rb"\S+")
_DECIMAL = re.compile(rb"(?<!\S)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\S)")
_DEEPEST = 500  # nodes; limit on damaged files
_POINTS = (b"Coordinate", b"Coordinate3", b"CoordinateDouble")
_MOVES_OF_VRML_1 = (b"MatrixTransform", b"Translation", b"Rotation", b"Scale")
_FIELDS = {b"translation": 3, b"rotation": 4, b"scale": 3, b"scaleFactor": 3, b"scaleOrientation": 4, b"center": 3}
_KNOWN = {b"USE", b"ccw", b"vertexOrdering", *_FIELDS}


def _replace_decimal_commas(text: bytes, path: Path) -> bytes:
    """Return the text of coordinates with decimal points in place of decimal commas.

    In VRML commas may also separate points; then fewer than half of the words contain a comma, and they are kept.
    """
    if _TIGHT_COMMA.search(text):
        spaced = _LAST_COMMA.sub(b" ", text)
        words, decimals = (sum(1 for _ in pattern.finditer(spaced)) for pattern in (_WORD, _DECIMAL))
        text = numeric_text(spaced, path) if 2 * decimals > words else text
    return text


@dataclass
class _Node:
    """A node, or a list of nodes, whose closing bracket has not been read yet."""

    kind: bytes
    name: bytes = b""
    frame: int = 0
    first_block: int = 0
    first_set: int = 0
    outer_points: int | None = None
    points: int | None = None
    index: IndexArray | None = None
    clockwise: bool = False
    numbers: dict[bytes, FloatArray] = field(default_factory=lambda: dict[bytes, FloatArray]())


@dataclass
class _Scene:
    """State of the parser: blocks of points, triangles with the block of their points, and frames.

    A frame is the coordinate frame of a Transform: the index of its outer frame, and its (3, 4) matrix, which is only
    known at the end of the Transform. Frame 0 is that of the file.
    """

    path: Path
    version_1: bool
    allowance: Allowance
    blocks: list[tuple[FloatArray, int]] = field(default_factory=lambda: list[tuple[FloatArray, int]]())
    sets: list[tuple[int, IndexArray, int]] = field(default_factory=lambda: list[tuple[int, IndexArray, int]]())
    frames: list[tuple[int, FloatArray]] = field(default_factory=lambda: [(0, np.eye(3, 4))])
    stack: list[_Node] = field(default_factory=lambda: list[_Node]())
    named_points: dict[bytes, int] = field(default_factory=lambda: dict[bytes, int]())
    named_shapes: set[bytes] = field(default_factory=lambda: set[bytes]())
    last_points: int | None = None
    shared: bool = False
    moved: bool = False
    clockwise: bool = False

    def open(self, kind: bytes, name: bytes = b"") -> None:
        if len(self.stack) >= _DEEPEST:
            raise damage_error(self.path, f"its nodes are nested more than {_DEEPEST} deep")
        self.allowance.part()
        frame = self.frame
        if kind == b"Transform":
            frame = len(self.frames)
            self.frames.append((self.frame, np.eye(3, 4)))
        node = _Node(kind, name, frame, len(self.blocks), len(self.sets), self.last_points, clockwise=self.clockwise)
        self.stack.append(node)

    @property
    def frame(self) -> int:
        """Return the index of the current frame."""
        return self.stack[-1].frame if self.stack else 0

    def words(self, words: list[bytes]) -> None:
        """Read the plain fields of the innermost node."""
        node = self.stack[-1] if self.stack else _Node(b"")
        for index in [index for index, word in enumerate(words) if word in _KNOWN]:
            word = words[index]
            after = words[index + 1 : index + 2]
            if word == b"USE" and after:
                self.use(after[0], node)
            elif node.kind == b"IndexedFaceSet" and word == b"ccw" and after:
                node.clockwise = after[0] == b"FALSE"
            elif node.kind == b"ShapeHints" and word == b"vertexOrdering" and after:
                self.clockwise = after[0] == b"CLOCKWISE"
            elif node.kind == b"Transform" and word in _FIELDS:
                numbers = floats(words[index + 1 : index + 1 + _FIELDS[word]], self.path)
                if len(numbers) < _FIELDS[word]:
                    raise damage_error(self.path, f"a Transform has a {word.decode()} of too few numbers; {CUT_SHORT}")
                node.numbers[b"scale" if word == b"scaleFactor" else word] = numbers

    def use(self, name: bytes, node: _Node) -> None:
        if name in self.named_points:
            self.shared = True
            if node.kind == b"IndexedFaceSet":
                node.points = self.named_points[name]
            else:
                self.last_points = self.named_points[name]
        elif name in self.named_shapes:
            printable_name = name[:60].decode("ascii", "replace")
            raise damage_error(
                self.path, f"it uses the shape '{printable_name}' twice (USE), so export it again as plain triangles"
            )

    def numbers(self, name: bytes, text: bytes) -> None:
        """Process a list of numbers."""
        node = self.stack[-1] if self.stack else _Node(b"")
        if name == b"point" and node.kind in _POINTS:
            points = floats_of(_replace_decimal_commas(text, self.path).replace(b",", b" "), self.path)
            if len(points) % 3:
                raise damage_error(self.path, f"its points have {len(points)} numbers, not three each; {CUT_SHORT}")
            self.blocks.append((points.reshape(-1, 3), node.frame))
            block = len(self.blocks) - 1
            if node.name:
                self.named_points[node.name] = block
            if node.kind == b"Coordinate3":
                self.last_points = block
            elif len(self.stack) > 1:
                self.stack[-2].points = block
        elif name == b"coordIndex" and node.kind == b"IndexedFaceSet":
            node.index = _corners(text, self.path)
        elif b"USE" in text:
            self.words(text.replace(b",", b" ").split())

    def close(self) -> None:
        node = self.stack.pop()
        if node.kind == b"IndexedFaceSet" and node.index is not None and len(node.index):
            self.add_faces(node)
        elif node.kind == b"Transform":
            self.move(node)
        elif node.kind in _MOVES_OF_VRML_1:
            kind = node.kind.decode()
            raise damage_error(
                self.path, f"it moves its shapes by '{kind}' of VRML 1, so export it again as VRML 2 or PLY"
            )
        elif node.kind in (b"Separator", b"TransformSeparator"):
            self.last_points = node.outer_points
        holds_shapes = len(self.sets) > node.first_set or len(self.blocks) > node.first_block
        if node.name and holds_shapes and node.kind not in _POINTS:
            self.named_shapes.add(node.name)

    def add_faces(self, node: _Node) -> None:
        block = self.last_points if node.points is None else node.points
        if block is None or node.index is None:
            raise damage_error(self.path, f"an IndexedFaceSet has no points; {CUT_SHORT}")
        face_ends = np.flatnonzero(node.index == -1)
        counts = np.diff(face_ends, prepend=-1) - 1
        counts = counts[counts > 0]
        if len(counts) and counts.min() < 3:
            raise damage_error(self.path, f"a face has only {int(counts.min())} corners; {CUT_SHORT}")
        corners = node.index[node.index >= 0]
        points = len(self.blocks[block][0])
        if len(corners) and corners.max() >= points:
            raise MeshError(
                f"{self.path.name}: a face points at vertex {int(corners.max())}, but there are only {points} "
                "vertices; the file is damaged or cut short."
            )
        faces = fan_triangles(counts, corners)
        self.sets.append((block, faces[:, ::-1] if node.clockwise else faces, node.frame))

    def move(self, node: _Node) -> None:
        """Apply a Transform to its children: T C R SR S -SR -C, section 6.52 of the standard."""
        values = node.numbers
        zero, none = np.zeros(3), np.array([0.0, 0.0, 1.0, 0.0])
        orientation = _rotation(values.get(b"scaleOrientation", none))
        linear = (
            _rotation(values.get(b"rotation", none)) @ orientation * values.get(b"scale", np.ones(3)) @ orientation.T
        )
        center = values.get(b"center", zero)
        if (linear == np.eye(3)).all() and not values.get(b"translation", zero).any():
            return
        if self.version_1:
            raise damage_error(
                self.path, "it moves its shapes by 'Transform' of VRML 1, so export it again as VRML 2 or PLY"
            )
        self.moved = True
        shift = values.get(b"translation", zero) + center - linear @ center
        self.frames[node.frame] = (self.frames[node.frame][0], np.column_stack([linear, shift]))

    def joined_points(self) -> tuple[FloatArray, IndexArray | None]:
        """Return all points in the frame of the file, and the triangles; mirrored triangles are flipped."""
        matrices = self.frames[:1]
        for outer, inner in self.frames[1:]:
            # An outer frame precedes its inner frames, so its matrix already refers to the frame of the file.
            outer_matrix = matrices[outer][1]
            matrices.append(
                (outer, outer_matrix[:, :3] @ inner + np.column_stack([np.zeros((3, 3)), outer_matrix[:, 3]]))
            )
        points = [
            vertices if not k else vertices @ matrices[k][1][:, :3].T + matrices[k][1][:, 3]
            for vertices, k in self.blocks
        ]
        starts = np.cumsum([0, *map(len, points)])
        mirrored = np.linalg.det(np.stack([matrix[:, :3] for _, matrix in matrices])) < 0
        faces = [(vertices[:, ::-1] if mirrored[k] else vertices) + starts[block] for block, vertices, k in self.sets]
        return np.concatenate(points), np.concatenate(faces) if faces else None


def _rotation(axis_angle: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation about an axis of any length by an angle in radians (Rodrigues)."""
    length = float(np.linalg.norm(axis_angle[:3]))
    if length == 0 or axis_angle[3] == 0:
        return np.eye(3)
    x, y, z = axis_angle[:3] / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(axis_angle[3]) * cross + (1 - np.cos(axis_angle[3])) * cross @ cross


def _corners(text: bytes, path: Path) -> IndexArray:
    text = text.replace(b",", b" ")
    if b"x" in text or b"X" in text:
        # VRML allows hexadecimal integers.
        text = _HEXADECIMAL.sub(lambda match: b"%d" % int(match[0], 16), text)
    index = ints_of(text, path)
    if len(index) and index.min() < -1:
        raise damage_error(path, f"a face points at vertex {int(index.min())}; {CUT_SHORT}")
    # The last face may lack its end marker.
    return np.append(index, -1) if len(index) and index[-1] != -1 else index


def read_vrml(data: bytes, path: Path) -> Mesh:
    """Read VRML: the points of all shapes in the order of the file, and polygons as fans.

    A Transform of VRML 2 is applied to its children, and a mirroring one also flips the triangles, so that normals stay
    outward; `ccw FALSE` flips the faces. Points without an IndexedFaceSet become a point cloud.

    Args:
        data: complete content of the file.
        path: path of the file, used in messages and as the name of the mesh.

    Raises:
        FileFormatError: it contains no points, is cut short, has too many nodes (`io.read_limits`), uses a shape twice
            (`USE`), or moves shapes by nodes of VRML 1.
        MeshError: faces that point past the end of their points.
    """
    data = plain_text(data)
    scene = _Scene(path, data.lstrip()[:8].upper() == b"#VRML V1", Allowance(len(data), path))
    text = _SKIPPED.sub(b" ", data)
    offset = 0
    while offset < len(text):
        stop = _to_bracket(text, offset)
        words = text[offset:stop].replace(b",", b" ").split()
        bracket, offset = text[stop : stop + 1], stop + 1
        if bracket == b"{":
            name = words[-2] if words[-3:-2] == [b"DEF"] else b""
            kind = words.pop() if words else b""
            scene.words(words)
            scene.open(kind, name)
        elif bracket == b"[":
            kind = words.pop() if words else b""
            scene.words(words)
            close = _to_bracket(text, offset)
            if text[close : close + 1] == b"]":
                scene.allowance.part()
                scene.numbers(kind, text[offset:close])
                offset = close + 1
            elif close == len(text):
                raise damage_error(path, f"a list has no end; {CUT_SHORT}")
            elif text[close : close + 1] == b"[" or kind in (b"point", b"coordIndex"):
                raise damage_error(path, f"a list of numbers has brackets in it; {CUT_SHORT}")
            else:
                scene.open(b"[")
        else:
            scene.words(words)
            if bracket:
                if not scene.stack or (scene.stack[-1].kind == b"[") != (bracket == b"]"):
                    raise damage_error(path, f"its brackets do not match; {CUT_SHORT}")
                scene.close()
    if scene.stack:
        raise damage_error(path, f"{len(scene.stack)} of its nodes have no end; {CUT_SHORT}")
    if not sum(len(points) for points, _ in scene.blocks):
        raise damage_error(path, "it has no points of an IndexedFaceSet, so it is not VRML or contains other shapes")
    if scene.shared and scene.moved:
        raise damage_error(
            path, "shapes that are moved share their points (USE), so export it again as plain triangles"
        )
    return mesh_of(*scene.joined_points(), path)


def _to_bracket(text: bytes, offset: int) -> int:
    """Return the index of the next bracket, or of the end."""
    match = _TO_BRACKET.match(text, offset)
    return match.end() if match else len(text)
