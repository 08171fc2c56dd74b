"""Grooming of raw scans: crop, outer surface, largest piece, filled holes. No vertex that remains is moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from shapespace.errors import InputError, MeshError
from shapespace.geometry.doctor import Finding
from shapespace.geometry.normals import boundary_edges, face_areas, faces_of, part_of, with_triangles
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

CROPS = {"sphere": 4, "outside": 4, "box": 6, "plane": 6, "landmarks": 1}
"""Number of values that each kind of crop needs."""
MOST_EDGES = 500
"""Largest number of border edges of a hole that is filled: the time grows with its cube, and is 1.5 s for 500."""
_LISTED = 12  # runs of vertices in a message
_LEAST_AREA = 1e-6
"""Twice the area of a triangle over its longest edge squared, below which none is made: it would count as a line."""
_SHORT_EDGES = 1e-3
"""Weight of squared edge lengths: it decides between triangulations of equal area, as of a flat hole."""


@dataclass(frozen=True)
class Crop:
    """A crop of a scan: the inside or outside of a sphere, a box, a side of a plane, or surroundings of landmarks.

    Args:
        kind: a name of `CROPS`.
        numbers: centre and radius of a sphere, two opposite corners of a box, or a point of a plane and its normal,
            which points to the side that is kept, all in the scan's own frame and unit; or the largest distance from
            the closest landmark, mm.

    Raises:
        InputError: the numbers do not define such a crop.
    """

    kind: str
    numbers: tuple[float, ...]

    def __post_init__(self) -> None:
        finite = all(np.isfinite(number) for number in self.numbers)
        if CROPS.get(self.kind) != len(self.numbers) or not finite:
            raise _crop_error(self.text)
        if self.kind in ("sphere", "outside", "landmarks") and self.numbers[-1] <= 0:
            raise InputError(f"The crop {self.text!r} needs a radius above zero.")
        if self.kind == "plane" and not any(self.numbers[3:]):
            raise InputError(f"The crop {self.text!r} needs a normal that is not zero.")

    @property
    def text(self) -> str:
        """The crop in the syntax of the command line."""
        return f"{self.kind}:{','.join(f'{number:g}' for number in self.numbers)}"

    @staticmethod
    def of(text: str) -> Crop:
        """Return the crop that `text` specifies, such as `sphere:0,0,0,90`.

        Raises:
            InputError: the text specifies no crop.
        """
        kind, _, numbers = text.partition(":")
        try:
            return Crop(kind.strip(), tuple(float(number) for number in numbers.split(",")))
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise _crop_error(text) from error

    def contains(self, points: FloatArray) -> BoolArray:
        """Return the mask (N,) of the `points` (N, 3) that a crop without landmarks keeps."""
        if self.kind == "box":
            corners = np.reshape(self.numbers, (2, 3))
            return np.asarray(((points >= corners.min(axis=0)) & (points <= corners.max(axis=0))).all(axis=1))
        offset = points - np.array(self.numbers[:3])
        if self.kind == "plane":
            return np.asarray(offset @ np.array(self.numbers[3:]) >= 0)
        return np.asarray((np.linalg.norm(offset, axis=1) <= self.numbers[3]) == (self.kind == "sphere"))

    def cut(self, scan: Mesh, inside: BoolArray, least: int) -> tuple[Mesh, str]:
        """Return the vertices `inside` (V,) of `scan` with the triangles between them, and a sentence on them.

        Raises:
            MeshError: fewer than `least` vertices are inside.
        """
        if inside.sum() < least:
            low, high = (np.array2string(f(scan.vertices, axis=0), precision=4) for f in (np.nanmin, np.nanmax))
            raise MeshError(
                f"{scan.name}: the crop {self.text} leaves {inside.sum()} of its {len(inside)} vertices, which lie "
                f"between {low} and {high}; give a crop in the scan's own frame and unit."
            )
        return part_of(scan, inside), f"Cropped to {inside.sum():,} of {len(inside):,} vertices ({self.text})."


def _crop_error(text: str) -> InputError:
    return InputError(
        f"There is no crop {text!r}; give sphere:X,Y,Z,R or outside:X,Y,Z,R or box:X,Y,Z,X,Y,Z or "
        "plane:X,Y,Z,NX,NY,NZ or landmarks:MM."
    )


@dataclass(frozen=True)
class Grooming:
    """Steps that remove or add parts of scans, applied in the order of these fields; coordinates do not change.

    Args:
        crop: write only the part inside `sphere:X,Y,Z,RADIUS` or `box:X,Y,Z,X,Y,Z`, outside a sphere
            (`outside:X,Y,Z,RADIUS`), or on the side of `plane:X,Y,Z,NX,NY,NZ` to which the normal N points, in the
            frame and unit of the file; can be repeated.
        outer: remove inner surfaces, such as marrow cavities: triangles that are hardly visible from outside.
        largest: write only the connected piece with the largest area.
        fill_holes: fill holes of at most this number of border edges with triangles between their vertices
            (default: none is filled).

    Raises:
        InputError: a text specifies no crop, a crop needs landmarks, or holes cannot have so many edges.
    """

    crop: tuple[str, ...] = ()
    outer: bool = False
    largest: bool = False
    fill_holes: int | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "crop", tuple(self.crop))
        if any(Crop.of(text).kind == "landmarks" for text in self.crop):
            raise InputError(
                "A crop around landmarks needs the landmarks of a fit; give --crop a sphere, box or plane."
            )
        if not 3 <= (self.fill_holes or 3) <= MOST_EDGES:
            raise InputError(f"--fill-holes is {self.fill_holes}; a hole has from 3 to {MOST_EDGES} border edges.")

    def apply(self, mesh: Mesh) -> tuple[Mesh, tuple[Finding, ...]]:
        """Return the groomed `mesh`, which must be repaired, and a finding per step.

        Raises:
            MeshError: nothing would remain, or `mesh` is a point cloud and the step needs triangles.
        """
        findings: list[Finding] = []
        for crop in map(Crop.of, self.crop):
            inside, faces = crop.contains(mesh.vertices), mesh.faces
            part, note = crop.cut(mesh, inside, 1)
            mesh = (
                part
                if faces is None
                else with_triangles(mesh, np.asarray(inside[faces].all(axis=1)), f"the crop {crop.text}")
            )
            findings.append(Finding("fixed", note, "The rest is removed."))
        if self.outer:
            from shapespace.geometry.outer_surface import outer_surface  # compiled

            before = len(faces_of(mesh))
            mesh = outer_surface(mesh)
            problem = f"{before - len(faces_of(mesh)):,} of {before:,} triangles are hardly visible from outside."
            findings.append(Finding("fixed", problem, "They are removed."))
        if self.largest:
            mesh, count, share = _largest_piece(mesh)
            problem = f"It has {count} separate pieces." if count > 1 else "It is in one piece."
            action = f"The largest, with {100 * share:.1f} % of the area, is kept." if count > 1 else ""
            findings.append(Finding("fixed", problem, action))
        if self.fill_holes:
            before = len(faces_of(mesh))
            mesh, filled, left = fill_holes(mesh, self.fill_holes)
            problem = f"{filled} {'hole has' if filled == 1 else 'holes have'} up to {self.fill_holes} border edges."
            action = f"Filled with {len(faces_of(mesh)) - before:,} triangles; {left:,} border edges stay open."
            findings.append(Finding("fixed", problem, action))
        return mesh, tuple(findings)


NO_GROOMING = Grooming()


def pieces_of(faces: IntArray, vertices: int) -> tuple[int, IntArray]:
    """Return the number of pieces and the piece (V,) of each of the `vertices`, connected by `faces` (F, 3)."""
    flat = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = coo_array((np.ones(len(flat)), (flat[:, 0], flat[:, 1])), shape=(vertices, vertices))
    return connected_components(graph, directed=False)


def counts_of_pieces(faces: IntArray | None, n_vertices: int, names: Sequence[str]) -> dict[str, int]:
    """Return the number of vertices of each separate piece of a surface by its name, in the order of the vertices.

    Args:
        faces: (F, 3) triangles; None for points.
        n_vertices: number of all vertices.
        names: names of the pieces, in order.

    Raises:
        InputError: the surface has another number of pieces, or the vertices of a piece do not follow one another.
    """
    pieces, piece = pieces_of(np.zeros((0, 3), dtype=np.int32) if faces is None else faces, n_vertices)
    starts = np.flatnonzero(np.diff(piece, prepend=-1))
    counts = np.diff(starts, append=n_vertices).tolist()
    if not pieces == len(starts) == len(set(names)) == len(names):
        raise InputError(
            f"{len(names)} parts are named ({', '.join(names)}), and the surface has {pieces} separate pieces, whose "
            f"vertices follow one another in runs of {', '.join(map(str, counts[:_LISTED]))}; give each piece a name."
        )
    return dict(zip(names, counts, strict=True))


def _largest_piece(mesh: Mesh) -> tuple[Mesh, int, float]:
    """Return the connected piece with the largest area, the number of pieces, and its share of the area."""
    faces = faces_of(mesh)
    _, piece = pieces_of(faces, len(mesh.vertices))
    area = np.bincount(piece[faces[:, 0]], face_areas(mesh))
    largest = int(area.argmax())
    kept = with_triangles(mesh, piece[faces[:, 0]] == largest, "the largest piece")
    return kept, len(np.unique(piece[faces[:, 0]])), float(area[largest] / area.sum())


def closed_borders(faces: IntArray) -> list[IntArray]:
    """Return the closed borders, each (n,) in the direction of its triangles; none passes a vertex twice.

    Where borders touch at a vertex they are separated; a border that ends is ignored.
    """
    count = int(faces.max()) + 1
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    lone = ~np.isin(ends[:, 1] * count + ends[:, 0], ends[:, 0] * count + ends[:, 1])
    following: dict[int, list[int]] = {}
    for start, end in ends[lone].tolist():
        following.setdefault(start, []).append(end)
    loops: list[IntArray] = []
    while following:
        path = [next(iter(following))]
        place = {path[0]: 0}
        while path and path[-1] in following:
            onward = following[path[-1]]
            vertex = onward.pop()
            if not onward:
                del following[path[-1]]
            if vertex in place:
                loop = path[place[vertex] :]
                loops.append(np.array(loop, dtype=np.int32))
                del path[place[vertex] + 1 :]
                place = {passed: k for k, passed in enumerate(path)}
            else:
                place[vertex] = len(path)
                path.append(vertex)
    return loops


def fill_holes(mesh: Mesh, most_edges: int) -> tuple[Mesh, int, int]:
    """Fill holes with triangles between the vertices of their border, of the smallest total area.

    Args:
        mesh: mesh of consistent winding.
        most_edges: largest number of border edges of a hole that is filled.

    Returns:
        The mesh, the number of filled holes, and the number of border edges that stay open.

    Source: G. Barequet and M. Sharir, Filling Gaps in the Boundary of a Polyhedron, 1995.
    """
    faces, count = faces_of(mesh), len(mesh.vertices)
    sides = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    joined = coo_array((np.ones(len(sides), np.bool_), (sides[:, 0], sides[:, 1])), shape=(count, count)).tocsr()
    added: list[IntArray] = []
    spanned: set[tuple[int, int]] = set()
    for loop in closed_borders(faces):
        if len(loop) > most_edges:
            continue
        near = joined[loop][:, loop].toarray()
        triangles = loop[_triangulate(mesh.vertices[loop], near | near.T)]
        inner = {(a, b) for a, b in np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)).tolist()}
        if len(triangles) and not inner & spanned:  # two holes with two common vertices must not share an edge
            spanned |= inner
            added.append(triangles)
    filled = replace(mesh, faces=np.concatenate([faces, *added]).astype(np.int32))
    return filled, len(added), len(boundary_edges(faces_of(filled)))


def _triangulate(points: FloatArray, joined: BoolArray) -> IntArray:
    """Return triangles (N - 2, 3) between the vertices of a closed border, of the smallest area; (0, 3) if none.

    Args:
        points: (N, 3) vertices of the border, in the direction of its triangles, to which the new ones are opposite.
        joined: (N, N) whether two vertices already have a common edge, which no other triangle may use.
    """
    n = len(points)
    squares = ((points[:, None] - points) ** 2).sum(axis=2)
    cost, middle = np.full((n, n), np.inf), np.zeros((n, n), dtype=np.int32)
    cost[np.arange(n - 1), np.arange(1, n)] = 0.0
    for gap in range(2, n):
        i = np.arange(n - gap)[:, None]
        j, k = i + gap, i + np.arange(1, gap)
        long, near, far = squares[i, j], squares[i, k], squares[k, j]
        double = np.sqrt(np.maximum(long * near - 0.25 * (long + near - far) ** 2, 0.0))
        total = cost[i, k] + cost[k, j] + 0.5 * double + _SHORT_EDGES * (long + near + far)
        is_flat = double <= _LEAST_AREA * np.maximum(np.maximum(long, near), far)
        total[is_flat | (joined[i, j] & (gap < n - 1))] = np.inf
        best = total.argmin(axis=1)[:, None]
        cost[i, j], middle[i, j] = np.take_along_axis(total, best, axis=1), i + 1 + best
    spans = [(0, n - 1)] if np.isfinite(cost[0, n - 1]) else []
    triangles: list[tuple[int, int, int]] = []
    while spans:
        first, last = spans.pop()
        if last - first > 1:
            between = int(middle[first, last])
            triangles.append((last, between, first))
            spans += [(first, between), (between, last)]
    return np.array(triangles, dtype=np.int32).reshape(-1, 3)
