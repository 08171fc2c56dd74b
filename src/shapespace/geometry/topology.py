"""Compiled functions of the mesh doctor, with linear time and little memory: equal rows, edges, pieces."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.compiled import compiled
from shapespace.types import BoolArray, FloatArray, IntArray


@compiled
def first_of_equal(rows: npt.NDArray[Any]) -> IntArray:
    """Return (N,) int32 the index of the first row equal to each of `rows` (N, 3), integers."""
    size = 16
    while size < 2 * len(rows):
        size *= 2
    table = np.full(size, -1, dtype=np.int32)
    first = np.empty(len(rows), dtype=np.int32)
    for i in range(len(rows)):
        key = np.uint64(rows[i, 0]) * np.uint64(0x9E3779B97F4A7C15)
        key = (key ^ (key >> np.uint64(29)) ^ np.uint64(rows[i, 1])) * np.uint64(0xBF58476D1CE4E5B9)
        key = (key ^ (key >> np.uint64(32)) ^ np.uint64(rows[i, 2])) * np.uint64(0x94D049BB133111EB)
        slot = np.int64((key ^ (key >> np.uint64(31))) & np.uint64(size - 1))
        while True:
            j = table[slot]
            if j < 0:
                table[slot] = i
                first[i] = i
                break
            if rows[i, 0] == rows[j, 0] and rows[i, 1] == rows[j, 1] and rows[i, 2] == rows[j, 2]:
                first[i] = j
                break
            slot = (slot + 1) & (size - 1)
    return first


@compiled
def sorted_edges(faces: IntArray, vertices: int) -> tuple[npt.NDArray[np.int64], IntArray, IntArray]:
    """Return the edges of `faces` (F, 3) sorted by lower vertex, then upper, then triangle.

    Args:
        faces: (F, 3) triangles with indices below `vertices`.
        vertices: number of vertices, V.

    Returns:
        (V + 1,) the start of the edges of each lower vertex; (3F,) the upper vertex of each edge; (3F,) the side of a
        triangle that the edge is: side k of triangle f, from corner k to the next, has the number 3 f + k.
    """
    # Counting sort by the upper vertex, then by the lower vertex; the second pass preserves the order of the first.
    edges = 3 * len(faces)
    start, rank = np.zeros(vertices + 1, dtype=np.int64), np.zeros(vertices + 1, dtype=np.int64)
    for f in range(len(faces)):
        for k in range(3):
            a, b = faces[f, k], faces[f, k - 2]
            start[min(a, b) + 1] += 1
            rank[max(a, b) + 1] += 1
    for v in range(vertices):
        start[v + 1] += start[v]
        rank[v + 1] += rank[v]
    by_upper = np.empty(edges, dtype=np.int32)
    for f in range(len(faces)):
        for k in range(3):
            high = max(faces[f, k], faces[f, k - 2])
            by_upper[rank[high]] = 3 * f + k
            rank[high] += 1
    upper, side = np.empty(edges, dtype=np.int32), np.empty(edges, dtype=np.int32)
    filled = start[:-1].copy()
    for i in range(edges):
        f, k = by_upper[i] // 3, by_upper[i] % 3
        a, b = faces[f, k], faces[f, k - 2]
        low = min(a, b)
        upper[filled[low]], side[filled[low]] = max(a, b), by_upper[i]
        filled[low] += 1
    return start, upper, side


@compiled
def single_edges(faces: IntArray, vertices: int) -> IntArray:
    """Return the edges (E, 2), lower vertex first and sorted, that belong to exactly one of `faces` (F, 3)."""
    start, upper, _ = sorted_edges(faces, vertices)
    count = 0
    edges = np.empty((len(upper), 2), dtype=np.int32)
    for v in range(vertices):
        for i in range(start[v], start[v + 1]):
            before = i > start[v] and upper[i - 1] == upper[i]
            after = i + 1 < start[v + 1] and upper[i + 1] == upper[i]
            if not (before or after):
                edges[count, 0], edges[count, 1] = v, upper[i]
                count += 1
    return edges[:count].copy()


@compiled
def meeting_triangles(faces: IntArray, vertices: int) -> tuple[IntArray, BoolArray, IntArray, int, int]:
    """Return the triangles that meet at the edges of `faces` (F, 3).

    Returns:
        (E, 2) the triangles at each edge of exactly two triangles; (E,) whether both pass it in the same direction, so
        that one is reversed; (L,) the triangles at all other edges, one for each side; the number of edges of one
        triangle; the number of edges of more than two.
    """
    start, upper, side = sorted_edges(faces, vertices)
    pairs, same_way = np.empty((len(upper) // 2, 2), dtype=np.int32), np.empty(len(upper) // 2, dtype=np.bool_)
    loose = np.empty(len(upper), dtype=np.int32)
    met = left = single = many = 0
    for v in range(vertices):
        i = start[v]
        while i < start[v + 1]:
            j = i + 1
            while j < start[v + 1] and upper[j] == upper[i]:
                j += 1
            if j - i == 2:
                a, b = side[i], side[i + 1]
                pairs[met, 0], pairs[met, 1] = a // 3, b // 3
                same_way[met] = faces[a // 3, a % 3] == faces[b // 3, b % 3]
                met += 1
            else:
                single += j - i == 1
                many += j - i > 2
                for n in range(i, j):
                    loose[left] = side[n] // 3
                    left += 1
            i = j
    return pairs[:met].copy(), same_way[:met].copy(), loose[:left].copy(), single, many


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def join(parent: IntArray, links: IntArray) -> None:
    """Join the sets of `parent` (N,), initially 0 to N - 1, by `links` (E, 2); the root of a set is its minimum."""
    for i in range(len(links)):
        a, b = _root(parent, links[i, 0]), _root(parent, links[i, 1])
        if a < b:
            parent[b] = a
        else:
            parent[a] = b


@compiled
def labels(parent: IntArray) -> tuple[int, IntArray]:
    """Return the number of sets in `parent` (N,), and (N,) int32 the set of each, numbered in order of appearance."""
    count = 0
    label = np.empty(len(parent), dtype=np.int32)
    for i in range(len(parent)):
        root = _root(parent, i)
        if root == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[root]
    return count, label


@compiled
def flat_triangles(vertices: FloatArray, faces: IntArray, tolerance: float) -> BoolArray:
    """Return (F,) whether twice the area of a triangle is at most `tolerance` times its longest edge squared."""
    flat = np.empty(len(faces), dtype=np.bool_)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        wx, wy, wz = vx - ux, vy - uy, vz - uz
        longest = max(ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz)
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        flat[f] = np.sqrt(nx * nx + ny * ny + nz * nz) <= tolerance * longest
    return flat


@compiled
def middles_and_normals(vertices: FloatArray, faces: IntArray, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (F, 3) centroids of triangles relative to `centre`, and (F, 3) normals with the area as length."""
    middles, normals = np.empty((len(faces), 3)), np.empty((len(faces), 3))
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        vx, vy, vz = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
        normals[f, 0], normals[f, 1] = (uy * vz - uz * vy) / 2, (uz * vx - ux * vz) / 2
        normals[f, 2] = (ux * vy - uy * vx) / 2
        middles[f, 0] = vertices[a, 0] - centre[0] + (ux + vx) / 3
        middles[f, 1] = vertices[a, 1] - centre[1] + (uy + vy) / 3
        middles[f, 2] = vertices[a, 2] - centre[2] + (uz + vz) / 3
    return middles, normals


@compiled
def boxes_of(points: FloatArray, label: IntArray, count: int) -> tuple[FloatArray, FloatArray]:
    """Return (count, 3) lowest and highest coordinates of the `points` (N, 3) with each `label` (N,)."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(len(points)):
        for k in range(3):
            low[label[i], k] = min(low[label[i], k], points[i, k])
            high[label[i], k] = max(high[label[i], k], points[i, k])
    return low, high
