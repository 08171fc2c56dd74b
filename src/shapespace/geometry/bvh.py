"""Exact closest points on triangles by a tree of boxes in float64, compiled; other compiled loops can search it too.

The triangles are distributed by their centroids as in `kdtree`, with boxes around complete triangles. The closest point
of a triangle is the foot of the query on its plane if it is inside the triangle, else a point on one of the edges that
the foot is beyond (Ericson, Real-Time Collision Detection, 2005, section 5.1.5); a triangle without area is reduced to
its edges. Results are exact up to the rounding of float64; if several triangles share the closest point, any may be
returned.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shapespace.compiled import compiled
from shapespace.errors import InputError
from shapespace.geometry.kdtree import (
    STACK_SIZE,
    box_distance,
    checked_guess,
    cover_children,
    order_into_leaves,
    start_at,
    writable,
)
from shapespace.types import FloatArray, IntArray

_LEAF_TRIANGLES = 4  # largest number of triangles in a leaf, all of which a search compares
# Squared sine of the angle between two edges below which a triangle has no area.
_FLAT = 1e-14


class TriangleArrays(NamedTuple):
    """Arrays of a tree, as arguments of compiled loops.

    Args:
        corners: (F, 9) float64, coordinates of the three corners, in leaf order.
        original: (F,) int32, the index of each triangle in the input.
        row_of: (F,) int32, the row of `corners` of each triangle of the input.
        boxes: (2^(depth + 1) - 1, 6) float64, lowest and highest coordinates of the triangles below each node.
        depth: number of splits from the root to a leaf.
    """

    corners: FloatArray
    original: IntArray
    row_of: IntArray
    boxes: FloatArray
    depth: int


class TriangleTree:
    """A search tree of triangles.

    Args:
        vertices: (V, 3) float64 positions; those that triangles use must be finite.
        faces: (F, 3) int32 triangles, at least one; triangles may have no area, or be repeated.

    Raises:
        InputError: no triangles, arrays of another shape, or corners that are not finite.
    """

    def __init__(self, vertices: FloatArray, faces: IntArray) -> None:
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(
                f"A triangle tree needs vertices (V, 3) and triangles (F, 3), at least one, not {vertices.shape} and "
                f"{faces.shape}."
            )
        depth = max(0, int(np.ceil(np.log2(len(faces) / _LEAF_TRIANGLES))))
        original = np.arange(len(faces), dtype=np.int32)
        boxes = np.empty((2 ** (depth + 1) - 1, 6))
        vertices, faces = writable(vertices), np.require(faces, dtype=np.int32, requirements=["C", "W"])
        middles = np.empty((len(faces), 3))
        _middles(vertices, faces, middles)
        if not np.isfinite(middles).all():
            raise InputError("A triangle tree needs finite corners; drop the triangles whose corners are not.")
        order_into_leaves(middles, original, boxes, depth)
        del middles
        row_of, corners = np.empty_like(original), np.empty((len(faces), 9))
        _cover(vertices, faces, original, row_of, corners, boxes, depth)
        self.arrays = TriangleArrays(corners, original, row_of, boxes, depth)
        """Arrays of the tree, as arguments of compiled loops."""

    def closest(
        self, queries: FloatArray, guess: IntArray | None = None
    ) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """Return triangle (M,) int32, barycentric (M, 3), points (M, 3) and squared distance (M,) of closest points.

        Args:
            queries: (M, 3) float64 query points, finite.
            guess: (M,) int32 indices of triangles that may be near, such as the previous results, -1 for none; they
                save time and do not change the distance.

        Raises:
            InputError: shapes that do not match, or a guess that is not the index of a triangle.
        """
        queries = writable(queries)
        guess = checked_guess(guess, len(queries), len(self.arrays.original))
        triangle, squared = np.empty(len(queries), dtype=np.int32), np.empty(len(queries))
        barycentric, points = np.empty((len(queries), 3)), np.empty((len(queries), 3))
        closest_into(self.arrays, queries, guess, triangle, barycentric, points, squared)
        return triangle, barycentric, points, squared


@compiled
def _middles(vertices: FloatArray, faces: IntArray, middles: FloatArray) -> None:
    for f in range(len(faces)):
        for k in range(3):
            middles[f, k] = (vertices[faces[f, 0], k] + vertices[faces[f, 1], k] + vertices[faces[f, 2], k]) / 3.0


@compiled
def _cover(
    vertices: FloatArray,
    faces: IntArray,
    original: IntArray,
    row_of: IntArray,
    corners: FloatArray,
    boxes: FloatArray,
    depth: int,
) -> None:
    """Fill `row_of`, `corners` and `boxes` of triangles in the order `original`, leaves first."""
    count, first_leaf = len(original), (1 << depth) - 1
    for leaf in range(1 << depth):
        box = boxes[first_leaf + leaf]
        box[:3], box[3:] = np.inf, -np.inf
        for row in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
            row_of[original[row]] = row
            for corner in range(3):
                for k in range(3):
                    value = vertices[faces[original[row], corner], k]
                    corners[row, 3 * corner + k] = value
                    box[k] = value if value < box[k] else box[k]
                    box[3 + k] = value if value > box[3 + k] else box[3 + k]
    cover_children(boxes, first_leaf)


@compiled
def _on_edge(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float, ex: float, ey: float, ez: float
) -> tuple[float, float]:
    """Return the position, 0 to 1, of the point of edge a to a + e nearest to the origin, and its squared distance."""
    along, length = -(ax * ex + ay * ey + az * ez), ex * ex + ey * ey + ez * ez
    if along <= 0.0 or length == 0.0:
        return 0.0, ax * ax + ay * ay + az * az
    if along >= length:
        return 1.0, bx * bx + by * by + bz * bz
    t = along / length
    x, y, z = ax + t * ex, ay + t * ey, az + t * ez
    return t, x * x + y * y + z * z


@compiled
def on_triangle(
    corners: FloatArray, row: int, x: float, y: float, z: float, limit: float
) -> tuple[float, float, float]:
    """Return the squared distance of (x, y, z) to triangle `row`, and the weights of its second and third corner.

    The distance is infinite if the distance from the plane of the triangle already exceeds `limit` (squared).
    """
    # Relative to the query, to preserve precision far from the origin.
    ax, ay, az = corners[row, 0] - x, corners[row, 1] - y, corners[row, 2] - z
    bx, by, bz = corners[row, 3] - x, corners[row, 4] - y, corners[row, 5] - z
    cx, cy, cz = corners[row, 6] - x, corners[row, 7] - y, corners[row, 8] - z
    ux, uy, uz = corners[row, 3] - corners[row, 0], corners[row, 4] - corners[row, 1], corners[row, 5] - corners[row, 2]
    vx, vy, vz = corners[row, 6] - corners[row, 0], corners[row, 7] - corners[row, 1], corners[row, 8] - corners[row, 2]
    return _nearest_on(ax, ay, az, bx, by, bz, cx, cy, cz, ux, uy, uz, vx, vy, vz, limit)


@compiled
def edges_of(vertices: FloatArray, faces: IntArray, f: int) -> tuple[float, float, float, float, float, float]:
    """Return the edges from the first corner of triangle `f` to its second and to its third."""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    ux, uy, uz = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
    vx, vy, vz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
    return ux, uy, uz, vx, vy, vz


@compiled
def on_face(
    vertices: FloatArray, faces: IntArray, f: int, x: float, y: float, z: float, limit: float
) -> tuple[float, float, float]:
    """Return the result of `on_triangle` for triangle `f` of `faces` (F, 3) on `vertices` (V, 3).

    Vertices take a sixth of the memory of the corners of all triangles, which saves time for moving surfaces.
    """
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    ax, ay, az = vertices[i, 0] - x, vertices[i, 1] - y, vertices[i, 2] - z
    bx, by, bz = vertices[j, 0] - x, vertices[j, 1] - y, vertices[j, 2] - z
    cx, cy, cz = vertices[k, 0] - x, vertices[k, 1] - y, vertices[k, 2] - z
    ux, uy, uz, vx, vy, vz = edges_of(vertices, faces, f)
    return _nearest_on(ax, ay, az, bx, by, bz, cx, cy, cz, ux, uy, uz, vx, vy, vz, limit)


@compiled
def _nearest_on(
    ax: float, ay: float, az: float, bx: float, by: float, bz: float, cx: float, cy: float, cz: float,
    ux: float, uy: float, uz: float, vx: float, vy: float, vz: float, limit: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the result of `on_triangle` for the origin and corners a, b, c, with u = b - a and v = c - a."""
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area = nx * nx + ny * ny + nz * nz
    above = ax * nx + ay * ny + az * nz
    flat = area <= _FLAT * (ux * ux + uy * uy + uz * uz) * (vx * vx + vy * vy + vz * vz)
    weight_b = weight_c = weight_a = -1.0
    if not flat:
        if above * above > limit * area * (1.0 + 1e-9):
            return np.inf, 0.0, 0.0
        weight_b = (vy * az - vz * ay) * nx + (vz * ax - vx * az) * ny + (vx * ay - vy * ax) * nz
        weight_c = (ay * uz - az * uy) * nx + (az * ux - ax * uz) * ny + (ax * uy - ay * ux) * nz
        weight_a = area - weight_b - weight_c
        if weight_a >= 0.0 and weight_b >= 0.0 and weight_c >= 0.0:
            b, c = weight_b / area, weight_c / area
            dx, dy, dz = ax + b * ux + c * vx, ay + b * uy + c * vy, az + b * uz + c * vz
            return dx * dx + dy * dy + dz * dz, b, c
    squared, b, c = np.inf, 0.0, 0.0
    if weight_c < 0.0:
        t, d = _on_edge(ax, ay, az, bx, by, bz, ux, uy, uz)
        if d < squared:
            squared, b, c = d, t, 0.0
    if weight_b < 0.0:
        t, d = _on_edge(ax, ay, az, cx, cy, cz, vx, vy, vz)
        if d < squared:
            squared, b, c = d, 0.0, t
    if weight_a < 0.0:
        t, d = _on_edge(bx, by, bz, cx, cy, cz, vx - ux, vy - uy, vz - uz)
        if d < squared:
            squared, b, c = d, 1.0 - t, t
    return squared, b, c


@compiled
def over_face(vertices: FloatArray, faces: IntArray, f: int, x: float, y: float, z: float) -> tuple[float, float]:
    """Return the weights of the second and third corner at the foot of (x, y, z) on the plane of triangle `f`.

    The foot is inside the triangle if both weights are above 0 and their sum is below 1; this is false without area.
    """
    i = faces[f, 0]
    ax, ay, az = x - vertices[i, 0], y - vertices[i, 1], z - vertices[i, 2]
    ux, uy, uz, vx, vy, vz = edges_of(vertices, faces, f)
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    au, av = ax * ux + ay * uy + az * uz, ax * vx + ay * vy + az * vz
    area = uu * vv - uv * uv
    if area <= _FLAT * uu * vv:
        return 0.0, 0.0
    return (vv * au - uv * av) / area, (uu * av - uv * au) / area


@compiled
def closest_one(
    tree: TriangleArrays, x: float, y: float, z: float, guess: int, stack: FloatArray
) -> tuple[int, float, float, float]:
    """Return the triangle closest to (x, y, z), the squared distance, and the weights of its second and third corner.

    Args:
        tree: arrays of the tree of triangles.
        x: x coordinate of the query, in the unit of the triangles.
        y: y coordinate of the query.
        z: z coordinate of the query.
        guess: index of a triangle that may be near, or -1.
        stack: (STACK_SIZE,) float64 workspace, one per thread.
    """
    corners, boxes, depth = tree.corners, tree.boxes, tree.depth
    count, first_leaf = len(corners), (1 << depth) - 1
    best, squared, weight_b, weight_c = -1, np.inf, 0.0, 0.0
    node, top = 0, 0
    if guess >= 0:
        best = tree.row_of[guess]
        squared, weight_b, weight_c = on_triangle(corners, best, x, y, z, np.inf)
        node, top = start_at(boxes, best, count, depth, x, y, z, squared, stack)
    while True:
        while node < first_leaf:
            left = 2 * node + 1
            near, far = box_distance(boxes, left, x, y, z), box_distance(boxes, left + 1, x, y, z)
            node = left
            if far < near:
                node = left + 1
                near, far = far, near
            if near >= squared:
                node = -1
                break
            if far < squared:
                stack[top], stack[top + 1] = 2 * left + 1 - node, far
                top += 2
        if node >= 0:
            leaf = node - first_leaf
            for row in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
                d, b, c = on_triangle(corners, row, x, y, z, squared)
                if d < squared or best < 0:
                    best, squared, weight_b, weight_c = row, d, b, c
        while top > 0 and stack[top - 1] >= squared:
            top -= 2
        if top == 0:
            return tree.original[best], squared, weight_b, weight_c
        top -= 2
        node = int(stack[top])


@compiled
def closest_into(
    tree: TriangleArrays,
    queries: FloatArray,
    guess: IntArray,
    triangle_out: IntArray,
    barycentric_out: FloatArray,
    points_out: FloatArray,
    squared_out: FloatArray,
) -> None:
    """Write the results of `TriangleTree.closest` for `queries` (M, 3) with `guess` (M,) to the output arrays."""
    stack = np.empty(STACK_SIZE)
    for i in range(len(queries)):
        triangle, squared, b, c = closest_one(tree, queries[i, 0], queries[i, 1], queries[i, 2], guess[i], stack)
        a = max(0.0, 1.0 - b - c)
        row = tree.row_of[triangle]
        for k in range(3):
            points_out[i, k] = a * tree.corners[row, k] + b * tree.corners[row, 3 + k] + c * tree.corners[row, 6 + k]
        barycentric_out[i, 0], barycentric_out[i, 1], barycentric_out[i, 2] = a, b, c
        triangle_out[i], squared_out[i] = triangle, squared
