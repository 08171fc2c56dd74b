"""Exact nearest points by a kd-tree in float64, compiled; other compiled loops can search it point by point.

The tree is implicit: node n has the children 2n + 1 and 2n + 2, its 2^depth leaves share the points evenly, and it
stores only the points in leaf order and one tight box per node. A search skips boxes that are farther than the best
point so far; both distances are rounded in the same way, so the result is that of brute force, and the lowest index of
ties.
Source: Friedman, Bentley and Finkel, ACM TOMS 3(3), 1977.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shapespace.compiled import compiled
from shapespace.errors import InputError
from shapespace.types import FloatArray, IntArray

_LEAF_POINTS = 12  # largest number of points in a leaf, all of which a search compares
_BLOCK = 16
"""Number of rows that `_select` compares before it swaps: fastest for 20,000 to 200,000 points."""
NOTED = 2
"""Number of nearest points that `follow_into` stores for a query, and checks before it searches again."""
STACK_SIZE = 128
"""Length of the float64 workspace that `nearest_few` needs."""


class KdArrays(NamedTuple):
    """Arrays of a tree, as arguments of compiled loops.

    Args:
        points: (N, 3) float64, in leaf order.
        original: (N,) int32, the index of each of `points` in the input.
        row_of: (N,) int32, the row of `points` of each input point.
        boxes: (2^(depth + 1) - 1, 6) float64, lowest and highest coordinates below each node.
        depth: number of splits from the root to a leaf.
    """

    points: FloatArray
    original: IntArray
    row_of: IntArray
    boxes: FloatArray
    depth: int


class WarmStart(NamedTuple):
    """Stored results that give queries with small movements their nearest points without a search.

    At the last search for a query, from its anchor, the nearest points were stored, and all others were at least
    `reach` away. While the sum of the distances from the query to the nearest stored point and to the anchor is less
    than `reach`, no other point can be nearer (Greenspan and Godin, 3DIM 2001, here with several stored points).

    Args:
        rows: (M, NOTED + 1) int32, rows of `KdArrays.points`, nearest to the anchor first, -1 if there are fewer
            points; the last row is that of the point at `reach`.
        anchor: (M, 3) float64, position of each query at its last search.
        reach: (M,) float64, distance from the anchor; infinite if every point is stored, 0 if the query was never
            searched.
    """

    rows: IntArray
    anchor: FloatArray
    reach: FloatArray


class KdTree:
    """A search tree of points.

    Args:
        points: (N, 3) float64, finite, at least one; they may be repeated, or be on a line or a plane. A query compares
            all copies of its nearest point, so merge thousands of copies before.

    Raises:
        InputError: no points, another shape, or points that are not finite.
    """

    def __init__(self, points: FloatArray) -> None:
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise InputError(f"A kd-tree needs points of the shape (N, 3), at least one, not {points.shape}.")
        if not np.isfinite(points).all():
            raise InputError("A kd-tree needs finite points; remove the others.")
        depth = max(0, int(np.ceil(np.log2(len(points) / _LEAF_POINTS))))
        ordered = np.array(points, dtype=np.float64, order="C")
        index = np.arange(len(points), dtype=np.int32)
        boxes = np.empty((2 ** (depth + 1) - 1, 6))
        order_into_leaves(ordered, index, boxes, depth)
        row_of = np.empty_like(index)
        row_of[index] = np.arange(len(points), dtype=np.int32)
        self.arrays = KdArrays(ordered, index, row_of, boxes, depth)
        """Arrays of the tree, as arguments of compiled loops."""

    def moved(self, points: FloatArray) -> KdTree:
        """Return the tree with the points moved to `points` (N, 3), with the same points in each leaf.

        Results are as exact as those of a new tree. Building a new tree takes several times as long, but its searches
        are faster if points have moved past each other.
        """
        tree, old = object.__new__(KdTree), self.arrays
        boxes = np.empty_like(old.boxes)
        ordered = np.ascontiguousarray(points[old.original], dtype=np.float64)
        _boxes_of_leaves(ordered, boxes, old.depth)
        tree.arrays = KdArrays(ordered, old.original, old.row_of, boxes, old.depth)
        return tree

    def nearest(self, queries: FloatArray, guess: IntArray | None = None) -> tuple[IntArray, FloatArray]:
        """Return the index (M,) int32 of the point nearest to each query, and its squared distance (M,).

        Args:
            queries: (M, 3) float64 query points, finite.
            guess: (M,) int32 indices of points that may be near, such as the previous results, -1 for none; they save
                time and do not change the result.

        Raises:
            InputError: shapes that do not match, or a guess that is not the index of a point.
        """
        queries = writable(queries)
        guess = checked_guess(guess, len(queries), len(self.arrays.original))
        index, squared = np.empty(len(queries), dtype=np.int32), np.empty(len(queries))
        nearest_into(self.arrays, queries, guess, index, squared)
        return index, squared

    def follow(
        self, queries: FloatArray, known: WarmStart | None = None
    ) -> tuple[IntArray, FloatArray, FloatArray, WarmStart]:
        """Return the results of `nearest`, the nearest points (M, 3), and the argument `known` of the next call.

        For moving queries, this is several times faster than `nearest` once they move less than the distance between
        points.

        Args:
            queries: (M, 3) float64 query points, finite.
            known: warm start from the last call for these queries; None for the first call. It is updated in place.

        Raises:
            InputError: shapes that do not match.
        """
        queries, m = writable(queries), len(queries)
        if known is None:
            known = WarmStart(np.full((m, NOTED + 1), -1, dtype=np.int32), np.zeros((m, 3)), np.zeros(m))
        elif len(known.reach) != m:
            raise InputError(f"The warm start of {len(known.reach)} queries does not match {m} queries.")
        nearest, squared, points = np.empty(m, dtype=np.int32), np.empty(m), np.empty((m, 3))
        follow_into(self.arrays, queries, known, nearest, squared, points)
        return nearest, squared, points, known


def writable(queries: FloatArray) -> FloatArray:
    """Return `queries` (M, 3) as a writable array, copied if needed; read-only arrays are another type when compiled.

    Raises:
        InputError: another shape.
    """
    if queries.ndim != 2 or queries.shape[1] != 3:
        raise InputError(f"Closest-point queries must have the shape (M, 3), not {queries.shape}.")
    return np.require(queries, dtype=np.float64, requirements=["C", "W"])


def checked_guess(guess: IntArray | None, queries: int, count: int) -> IntArray:
    """Return `guess` as (M,) int32 for M = `queries`, all -1 for None.

    Raises:
        InputError: another shape, or an index that is not below `count`.
    """
    if guess is None:
        return np.full(queries, -1, dtype=np.int32)
    if guess.shape != (queries,) or (queries and not (guess.min() >= -1 and guess.max() < count)):
        raise InputError(f"A guess must be one index below {count} per query, or -1 for none.")
    return np.require(guess, dtype=np.int32, requirements=["C", "W"])


@compiled
def _select(
    points: FloatArray, index: IntArray, low: int, high: int, middle: int, axis: int, left: IntArray, right: IntArray
) -> None:
    """Reorder rows low to high - 1 so that no row before `middle` is greater along `axis` and no row after it is less.

    `left` and `right` (_BLOCK,) are workspace for rows to be swapped. These are found in blocks, which avoids branch
    mispredictions (Edelkamp and Weiss, ESA 2016); the order is that of the plain loop.
    """
    last = high - 1
    while low < last:
        a, b, c = points[low, axis], points[(low + last) >> 1, axis], points[last, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, last
        lefts: int = 0
        rights: int = 0
        next_left = next_right = 0
        while j - i >= 2 * _BLOCK:
            if lefts == 0:
                next_left = 0
                for k in range(_BLOCK):
                    left[lefts] = i + k
                    lefts += not points[i + k, axis] < pivot
            if rights == 0:
                next_right = 0
                for k in range(_BLOCK):
                    right[rights] = j - k
                    rights += not pivot < points[j - k, axis]
            swaps = min(lefts, rights)
            for n in range(swaps):
                a, b = left[next_left + n], right[next_right + n]
                for k in range(3):
                    points[a, k], points[b, k] = points[b, k], points[a, k]
                index[a], index[b] = index[b], index[a]
            next_left, next_right = next_left + swaps, next_right + swaps
            lefts, rights = lefts - swaps, rights - swaps
            i = i if lefts else i + _BLOCK
            j = j if rights else j - _BLOCK
        i, j = (left[next_left] if lefts else i), (right[next_right] if rights else j)
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while pivot < points[j, axis]:
                j -= 1
            if i <= j:
                for k in range(3):
                    points[i, k], points[j, k] = points[j, k], points[i, k]
                index[i], index[j] = index[j], index[i]
                i += 1
                j -= 1
        if middle <= j:
            last = j
        elif middle >= i:
            low = i
        else:
            return


@compiled
def order_into_leaves(points: FloatArray, index: IntArray, boxes: FloatArray, depth: int) -> None:
    """Sort `points` and `index` into leaves, splitting the longest side at the median; fill `boxes`."""
    count = len(points)
    left, right = np.empty(_BLOCK, dtype=np.int32), np.empty(_BLOCK, dtype=np.int32)
    for level in range(depth + 1):
        width = depth - level
        for i in range(1 << level):
            low, high = ((i << width) * count) >> depth, (((i + 1) << width) * count) >> depth
            # Scalars stay in registers, unlike entries of an array that is written to.
            x0, y0, z0 = points[low, 0], points[low, 1], points[low, 2]
            x1, y1, z1 = x0, y0, z0
            for row in range(low + 1, high):
                x, y, z = points[row, 0], points[row, 1], points[row, 2]
                x0, y0, z0 = (x if x < x0 else x0), (y if y < y0 else y0), (z if z < z0 else z0)
                x1, y1, z1 = (x if x > x1 else x1), (y if y > y1 else y1), (z if z > z1 else z1)
            box = boxes[(1 << level) - 1 + i]
            box[0], box[1], box[2], box[3], box[4], box[5] = x0, y0, z0, x1, y1, z1
            if level < depth:
                x, y, z = x1 - x0, y1 - y0, z1 - z0
                axis = 0 if x >= y and x >= z else (1 if y >= z else 2)
                _select(points, index, low, high, (((2 * i + 1) << (width - 1)) * count) >> depth, axis, left, right)


@compiled
def cover_children(boxes: FloatArray, first_leaf: int) -> None:
    """Fill the `boxes` before `first_leaf`, each around its two children, starting from those of the leaves."""
    for node in range(first_leaf - 1, -1, -1):
        for k in range(3):
            boxes[node, k] = min(boxes[2 * node + 1, k], boxes[2 * node + 2, k])
            boxes[node, 3 + k] = max(boxes[2 * node + 1, 3 + k], boxes[2 * node + 2, 3 + k])


@compiled
def _boxes_of_leaves(points: FloatArray, boxes: FloatArray, depth: int) -> None:
    """Fill `boxes`, first of the leaves, then of their parents; `points` are in the order of the leaves."""
    count, first_leaf = len(points), (1 << depth) - 1
    for leaf in range(1 << depth):
        box = boxes[first_leaf + leaf]
        box[:3], box[3:] = np.inf, -np.inf
        for row in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
            for k in range(3):
                value = points[row, k]
                box[k] = value if value < box[k] else box[k]
                box[3 + k] = value if value > box[3 + k] else box[3 + k]
    cover_children(boxes, first_leaf)


@compiled
def box_distance(boxes: FloatArray, node: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of (x, y, z) from box `node`, which is at most that of any point in the box."""
    dx, ex = boxes[node, 0] - x, x - boxes[node, 3]
    dy, ey = boxes[node, 1] - y, y - boxes[node, 4]
    dz, ez = boxes[node, 2] - z, z - boxes[node, 5]
    dx, dy, dz = (dx if dx > ex else ex), (dy if dy > ey else ey), (dz if dz > ez else ez)
    dx, dy, dz = (dx if dx > 0.0 else 0.0), (dy if dy > 0.0 else 0.0), (dz if dz > 0.0 else 0.0)
    return dx * dx + dy * dy + dz * dz


@compiled
def start_at(
    boxes: FloatArray,
    row: int,
    count: int,
    depth: int,
    x: float,
    y: float,
    z: float,
    squared: float,
    stack: FloatArray,
) -> tuple[int, int]:
    """Return the leaf of `row`, of `count` rows, and the top of `stack`, with other boxes that may be within `squared`.

    This computes half as many box distances as a search from the root, with few mispredicted branches.
    """
    leaf = (((row + 1) << depth) - 1) // count + (1 << depth) - 1
    top = 0
    for level in range(1, depth + 1):
        sibling = (((leaf + 1) >> (depth - level)) ^ 1) - 1
        d = box_distance(boxes, sibling, x, y, z)
        if d <= squared:
            stack[top], stack[top + 1] = sibling, d
            top += 2
    return leaf, top


@compiled
def nearest_few(
    tree: KdArrays,
    x: float,
    y: float,
    z: float,
    limit: float,
    start: int,
    rows: IntArray,
    squared: FloatArray,
    stack: FloatArray,
) -> None:
    """Write the rows of the nearest points and their squared distances, nearest first, the lowest index of ties.

    Args:
        tree: arrays of the tree of points.
        x: x coordinate of the query, in the unit of the points.
        y: y coordinate of the query.
        z: z coordinate of the query.
        limit: squared distance within which there are certainly at least k points; infinity if unknown.
        start: row of a point that may be near, or -1.
        rows: (k,) int32 output, -1 if there are fewer points.
        squared: (k,) float64 output, infinite if there are fewer points.
        stack: (STACK_SIZE,) float64 workspace, one per thread.
    """
    points, index, boxes, depth = tree.points, tree.original, tree.boxes, tree.depth
    count, first_leaf, last = len(index), (1 << depth) - 1, len(rows) - 1
    rows[:], squared[:] = -1, np.inf
    node, top = 0, 0
    if start >= 0:
        node, top = start_at(boxes, start, count, depth, x, y, z, limit, stack)
    while True:
        while node < first_leaf:
            left = 2 * node + 1
            near, far = box_distance(boxes, left, x, y, z), box_distance(boxes, left + 1, x, y, z)
            node = left
            if far < near:
                node = left + 1
                near, far = far, near
            if near > limit:
                node = -1
                break
            if far <= limit:
                stack[top], stack[top + 1] = 2 * left + 1 - node, far
                top += 2
        if node >= 0:
            leaf = node - first_leaf
            for row in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
                dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
                d = dx * dx + dy * dy + dz * dz
                if d > limit or d > squared[last]:
                    continue
                k = last
                while k > 0 and (
                    d < squared[k - 1] or (d == squared[k - 1] and rows[k - 1] >= 0 and index[row] < index[rows[k - 1]])
                ):
                    k -= 1
                if k == last and d == squared[last] and rows[last] >= 0 and index[row] > index[rows[last]]:
                    continue
                for j in range(last, k, -1):
                    rows[j], squared[j] = rows[j - 1], squared[j - 1]
                rows[k], squared[k] = row, d
                limit = min(limit, squared[last])
        while top > 0 and stack[top - 1] > limit:
            top -= 2
        if top == 0:
            return
        top -= 2
        node = int(stack[top])


@compiled
def nearest_into(
    tree: KdArrays, queries: FloatArray, guess: IntArray, index_out: IntArray, squared_out: FloatArray
) -> None:
    """Write index (M,) and squared distance (M,) of the points nearest to `queries` (M, 3) given `guess` (M,)."""
    points, stack, rows, squared = tree.points, np.empty(STACK_SIZE), np.empty(1, dtype=np.int32), np.empty(1)
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        row, limit = -1, np.inf
        if guess[i] >= 0:
            row = int(tree.row_of[guess[i]])
            dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
            limit = dx * dx + dy * dy + dz * dz
        nearest_few(tree, x, y, z, limit, row, rows, squared, stack)
        index_out[i], squared_out[i] = tree.original[rows[0]], squared[0]


@compiled
def follow_into(
    tree: KdArrays,
    queries: FloatArray,
    known: WarmStart,
    index_out: IntArray,
    squared_out: FloatArray,
    points_out: FloatArray,
) -> None:
    """Write the results of `KdTree.follow` to the output arrays, and update `known`."""
    points, stack, noted_squared = tree.points, np.empty(STACK_SIZE), np.empty(NOTED + 1)
    for i in range(len(queries)):
        x, y, z = queries[i, 0], queries[i, 1], queries[i, 2]
        dx, dy, dz = known.anchor[i, 0] - x, known.anchor[i, 1] - y, known.anchor[i, 2] - z
        way, reach = np.sqrt(dx * dx + dy * dy + dz * dz), known.reach[i]
        best, squared = -1, np.inf
        for k in range(NOTED):
            row = known.rows[i, k]
            if row < 0:
                break
            dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
            d = dx * dx + dy * dy + dz * dz
            if d < squared or (d == squared and tree.original[row] < tree.original[best]):
                best, squared = row, d
        # The margin excludes ties up to rounding.
        if np.sqrt(squared) + way >= reach * (1.0 - 1e-12):
            # All stored points are within this distance, so the search can start with it.
            far = way + reach if known.rows[i, NOTED] >= 0 else np.inf
            nearest_few(tree, x, y, z, far * far * (1.0 + 1e-12), known.rows[i, 0], known.rows[i], noted_squared, stack)
            best, squared = known.rows[i, 0], noted_squared[0]
            known.reach[i] = np.sqrt(noted_squared[NOTED])
            known.anchor[i, 0], known.anchor[i, 1], known.anchor[i, 2] = x, y, z
        index_out[i], squared_out[i] = tree.original[best], squared
        points_out[i, 0], points_out[i, 1], points_out[i, 2] = points[best, 0], points[best, 1], points[best, 2]
