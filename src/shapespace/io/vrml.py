"""VRML 1 and 2 (`.wrl`): the points and faces of its IndexedFaceSets; textures, normals and colours change nothing.

Written from ISO/IEC 14772-1:1997 (VRML 2) and "VRML 1.0 Specification" (1995). BU-3DFE stores its scans as VRML 2: one
Shape with `coord Coordinate { point [ ... ] }`, `coordIndex [ a, b, c, -1, ... ]`, and texture parts that are skipped.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from shapespace.errors import MeshError
from shapespace.io.parsing import CUT_SHORT, IndexArray, damaged, fan_triangles, floats, ints, mesh_of
from shapespace.types import FloatArray, Mesh

# A string without an end swallows the rest, so that no position is scanned twice.
_SKIPPED = re.compile(rb'"(?:[^"\\]|\\.)*+(?:"|\\?\Z)|#[^\r\n]*', re.DOTALL)
_TOKEN = re.compile(rb"[{}\[\]]|[^\s,{}\[\]]+")
# Each open bracket may cost one look over the rest of the file.
_DEEPEST = 500
_POINTS = (b"Coordinate", b"Coordinate3", b"CoordinateDouble")
_MOVES_OF_VRML_1 = (b"MatrixTransform", b"Translation", b"Rotation", b"Scale")
_FIELDS = {b"translation": 3, b"rotation": 4, b"scale": 3, b"scaleFactor": 3, b"scaleOrientation": 4, b"center": 3}


@dataclass
class _Node:
    """A node, or a list of nodes, whose closing bracket has not come yet."""

    kind: bytes
    name: bytes = b""
    first_block: int = 0
    first_set: int = 0
    outer_points: int | None = None
    points: int | None = None
    index: IndexArray | None = None
    clockwise: bool = False
    numbers: dict[bytes, FloatArray] = field(default_factory=lambda: dict[bytes, FloatArray]())


@dataclass
class _Scene:
    """What has been read so far: blocks of points, and triangles with the block that each set points into."""

    path: Path
    version_1: bool
    blocks: list[FloatArray] = field(default_factory=lambda: list[FloatArray]())
    sets: list[tuple[int, IndexArray]] = field(default_factory=lambda: list[tuple[int, IndexArray]]())
    stack: list[_Node] = field(default_factory=lambda: list[_Node]())
    named_points: dict[bytes, int] = field(default_factory=lambda: dict[bytes, int]())
    named_shapes: set[bytes] = field(default_factory=lambda: set[bytes]())
    last_points: int | None = None
    shared: bool = False
    moved: bool = False
    clockwise: bool = False

    def open(self, kind: bytes, name: bytes = b"") -> None:
        if len(self.stack) >= _DEEPEST:
            raise damaged(self.path, f"its nodes are nested more than {_DEEPEST} deep")
        node = _Node(kind, name, len(self.blocks), len(self.sets), self.last_points, clockwise=self.clockwise)
        self.stack.append(node)

    def words(self, words: list[bytes]) -> None:
        """Take the plain fields that stand in the innermost node."""
        node = self.stack[-1] if self.stack else _Node(b"")
        for at, word in enumerate(words):
            after = words[at + 1 : at + 2]
            if word == b"USE" and after:
                self.use(after[0], node)
            elif node.kind == b"IndexedFaceSet" and word == b"ccw" and after:
                node.clockwise = after[0] == b"FALSE"
            elif node.kind == b"ShapeHints" and word == b"vertexOrdering" and after:
                self.clockwise = after[0] == b"CLOCKWISE"
            elif node.kind == b"Transform" and word in _FIELDS:
                numbers = floats(words[at + 1 : at + 1 + _FIELDS[word]], self.path)
                if len(numbers) < _FIELDS[word]:
                    raise damaged(self.path, f"a Transform has a {word.decode()} of too few numbers; {CUT_SHORT}")
                node.numbers[b"scale" if word == b"scaleFactor" else word] = numbers

    def use(self, name: bytes, node: _Node) -> None:
        if name in self.named_points:
            self.shared = True
            if node.kind == b"IndexedFaceSet":
                node.points = self.named_points[name]
            else:
                self.last_points = self.named_points[name]
        elif name in self.named_shapes:
            shown = name[:60].decode("ascii", "replace")
            raise damaged(self.path, f"it shows the shape '{shown}' twice (USE), so export it again as plain triangles")

    def numbers(self, name: bytes, text: bytes) -> None:
        """Take a list that holds no nodes."""
        node = self.stack[-1] if self.stack else _Node(b"")
        if name == b"point" and node.kind in _POINTS:
            points = floats(text.replace(b",", b" ").split(), self.path)
            if len(points) % 3:
                raise damaged(self.path, f"its points have {len(points)} numbers, not three each; {CUT_SHORT}")
            self.blocks.append(points.reshape(-1, 3))
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
            raise damaged(self.path, f"it moves its shapes by '{kind}' of VRML 1, so export it again as VRML 2 or PLY")
        elif node.kind in (b"Separator", b"TransformSeparator"):
            self.last_points = node.outer_points
        holds_shapes = len(self.sets) > node.first_set or len(self.blocks) > node.first_block
        if node.name and holds_shapes and node.kind not in _POINTS:
            self.named_shapes.add(node.name)

    def add_faces(self, node: _Node) -> None:
        block = self.last_points if node.points is None else node.points
        if block is None or node.index is None:
            raise damaged(self.path, f"an IndexedFaceSet has no points; {CUT_SHORT}")
        ends = np.flatnonzero(node.index == -1)
        counts = np.diff(ends, prepend=-1) - 1
        counts = counts[counts > 0]
        if len(counts) and counts.min() < 3:
            raise damaged(self.path, f"a face has only {int(counts.min())} corners; {CUT_SHORT}")
        corners = node.index[node.index >= 0]
        points = len(self.blocks[block])
        if len(corners) and corners.max() >= points:
            raise MeshError(
                f"{self.path.name}: a face points at vertex {int(corners.max())}, but there are only {points} "
                "vertices; the file is damaged or cut short."
            )
        faces = fan_triangles(counts, corners)
        self.sets.append((block, faces[:, ::-1] if node.clockwise else faces))

    def move(self, node: _Node) -> None:
        """Apply a Transform to what stands in it: T C R SR S -SR -C, section 6.52 of the standard."""
        given = node.numbers
        zero, none = np.zeros(3), np.array([0.0, 0.0, 1.0, 0.0])
        turned = _turn(given.get(b"scaleOrientation", none))
        linear = _turn(given.get(b"rotation", none)) @ turned * given.get(b"scale", np.ones(3)) @ turned.T
        center = given.get(b"center", zero)
        if (linear == np.eye(3)).all() and not given.get(b"translation", zero).any():
            return
        if self.version_1:
            raise damaged(
                self.path, "it moves its shapes by 'Transform' of VRML 1, so export it again as VRML 2 or PLY"
            )
        self.moved = True
        shift = given.get(b"translation", zero) + center
        for block in range(node.first_block, len(self.blocks)):
            self.blocks[block] = (self.blocks[block] - center) @ linear.T + shift
        if np.linalg.det(linear) < 0:
            for at in range(node.first_set, len(self.sets)):
                block, faces = self.sets[at]
                self.sets[at] = (block, faces[:, ::-1])


def _turn(axis_angle: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation about an axis of any length by an angle in radians (Rodrigues)."""
    length = float(np.linalg.norm(axis_angle[:3]))
    if length == 0 or axis_angle[3] == 0:
        return np.eye(3)
    x, y, z = axis_angle[:3] / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(axis_angle[3]) * cross + (1 - np.cos(axis_angle[3])) * cross @ cross


def _corners(text: bytes, path: Path) -> IndexArray:
    tokens = text.replace(b",", b" ").split()
    if b"x" in text or b"X" in text:
        # VRML allows hexadecimal whole numbers.
        tokens = [b"%d" % int(t, 16) if re.fullmatch(rb"0[xX][0-9a-fA-F]{1,16}", t) else t for t in tokens]
    index = ints(tokens, path)
    if len(index) and index.min() < -1:
        raise damaged(path, f"a face points at vertex {int(index.min())}; {CUT_SHORT}")
    # The last face may do without its end.
    return np.append(index, -1) if len(index) and index[-1] != -1 else index


def read_vrml(data: bytes, path: Path) -> Mesh:
    """Read VRML: all points in the file's order, those of several shapes one after another, and polygons as fans.

    A Transform of VRML 2 moves what stands in it, and a mirroring one keeps the outside outside; `ccw FALSE` turns the
    faces. Points without an IndexedFaceSet become a point cloud.

    Args:
        data: the whole file.
        path: its name, for messages and the mesh's name.

    Raises:
        FileFormatError: it holds no points, is cut short or compressed, shows a shape twice (`USE`), or moves shapes by
            nodes of VRML 1.
        MeshError: faces that point past the end of their points.
    """
    if data[:2] == b"\x1f\x8b":
        raise damaged(path, "it is compressed, so unpack it with gunzip first")
    scene = _Scene(path, version_1=data.lstrip()[:8].upper() == b"#VRML V1")
    text = _SKIPPED.sub(b" ", data)
    words: list[bytes] = []
    at = 0
    while match := _TOKEN.search(text, at):
        token, at = match[0], match.end()
        if token not in (b"{", b"}", b"[", b"]"):
            words.append(token)
            continue
        if token == b"{":
            name = words[-2] if words[-3:-2] == [b"DEF"] else b""
            kind = words.pop() if words else b""
            scene.words(words)
            scene.open(kind, name)
        elif token == b"[":
            close = text.find(b"]", at)
            if close < 0:
                raise damaged(path, f"a list has no end; {CUT_SHORT}")
            kind = words.pop() if words else b""
            scene.words(words)
            if text.find(b"{", at, close) < 0:
                scene.numbers(kind, text[at:close])
                at = close + 1
            else:
                scene.open(b"[")
        else:
            scene.words(words)
            if not scene.stack or (scene.stack[-1].kind == b"[") != (token == b"]"):
                raise damaged(path, f"its brackets do not match; {CUT_SHORT}")
            scene.close()
        words.clear()
    if scene.stack:
        raise damaged(path, f"{len(scene.stack)} of its nodes have no end; {CUT_SHORT}")
    if not sum(map(len, scene.blocks)):
        raise damaged(path, "it holds no points of an IndexedFaceSet, so it is not VRML or holds other shapes")
    if scene.shared and scene.moved:
        raise damaged(path, "shapes that are moved share their points (USE), so export it again as plain triangles")
    starts = np.cumsum([0, *map(len, scene.blocks)])
    faces = [triangles + starts[block] for block, triangles in scene.sets]
    return mesh_of(np.concatenate(scene.blocks), np.concatenate(faces) if faces else None, path)
