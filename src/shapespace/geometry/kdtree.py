"""Exact nearest points by a kd-tree in float64, compiled; other compiled loops may search it point by point.

The tree is implicit: node n has the children 2n + 1 and 2n + 2, its 2^depth leaves share the points evenly, and all it
stores are the points in leaf order and one tight box a node. A box is passed over when it lies farther than the best
point so far; both distances are rounded alike, so the answer is that of brute force, and the lowest index of ties.
Source: Friedman, Bentley and Finkel, ACM TOMS 3(3), 1977.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shapespace.compiled import compiled
from shapespace.errors import InputError
from shapespace.types import FloatArray, IntArray

_LEAF_POINTS = 12  # points in a leaf, at most: all of them are compared, instead of another level of boxes
_BLOCK = 16
"""Rows that `_select` compares before it swaps: fastest for 20,000 to 200,000 points."""
NOTED = 2
"""How many nearest points `follow_into` chooses from before it searches again."""
STACK_SIZE = 128
"""Length of the float64 workspace that `nearest_one` and `nearest_few` need."""


class KdArrays(NamedTuple):
    """What a tree consists of, as compiled loops take it.

    Args:
        points: (N, 3) float64, in leaf order.
        original: (N,) int32, the number each of `points` had when it was given.
        row_of: (N,) int32, the row of `points` where each number is.
        boxes: (2^(depth + 1) - 1, 6) float64, lowest and highest coordinates below each node.
        depth: number of splits from the root to a leaf.
    """

    points: FloatArray
    original: IntArray
    row_of: IntArray
    boxes: FloatArray
    depth: int


class Followed(NamedTuple):
    """What lets queries that have moved a little find their answer without a search.

    Where a query was last searched, at its anchor, its nearest points were noted, and all others were at least `reach`
    away. So long as its distance to the nearest of those noted and its way from the anchor make less than `reach`, no
    other point can be nearer (Greenspan and Godin, 3DIM 2001, with more points than one).

    Args:
        rows: (M, NOTED + 1) int32, rows of `KdArrays.points`, nearest to the anchor first, -1 where there are no
            more; the last one is that at `reach`.
        anchor: (M, 3) float64.
        reach: (M,) float64, infinite where every point is noted, 0 where the query was never searched this way.
    """

    rows: IntArray
    anchor: FloatArray
    reach: FloatArray


class KdTree:
    """Points to be searched.

    Args:
        points: (N, 3) float64, finite, at least one; they may repeat, or lie on a line or a plane.
            A query looks at every repeat of its nearest point, so thousands of repeats are better merged before.

    Raises:
        InputError: no points, of another shape, or not finite.
    """

    def __init__(self, points: FloatArray) -> None:
        if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
            raise InputError(f"A kd-tree needs points of the shape (N, 3), at least one, not {points.shape}.")
        if not np.isfinite(points).all():
            raise InputError("A kd-tree needs finite points; drop those that are not.")
        depth = max(0, int(np.ceil(np.log2(len(points) / _LEAF_POINTS))))
        ordered = np.array(points, dtype=np.float64, order="C")
        index = np.arange(len(points), dtype=np.int32)
        boxes = np.empty((2 ** (depth + 1) - 1, 6))
        order_into_leaves(ordered, index, boxes, depth)
        self.arrays = KdArrays(ordered, index, rows_of(index), boxes, depth)
        """The tree as compiled loops take it."""

    def moved(self, points: FloatArray) -> KdTree:
        """Return the tree of `points` (N, 3), which these have become: its leaves hold the same ones.

        Answers are as exact as those of a tree made anew, which takes several times as long and serves faster where
        points have moved past each other.
        """
        tree, old = object.__new__(KdTree), self.arrays
        boxes = np.empty_like(old.boxes)
        ordered = np.ascontiguousarray(points[old.original], dtype=np.float64)
        cover(ordered, boxes, old.depth)
        tree.arrays = KdArrays(ordered, old.original, old.row_of, boxes, old.depth)
        return tree

    def nearest(self, queries: FloatArray, guess: IntArray | None = None) -> tuple[IntArray, FloatArray]:
        """Return the index (M,) int32 of the point nearest to each query, and its squared distance (M,).

        Args:
            queries: (M, 3) float64, finite.
            guess: (M,) int32 points that may be near, such as the last answers, -1 for none; they save time and
                change nothing.

        Raises:
            InputError: shapes that do not match, or a guess that is no point.
        """
        queries = writable(queries)
        guess = checked_guess(guess, len(queries), len(self.arrays.original))
        index, squared = np.empty(len(queries), dtype=np.int32), np.empty(len(queries))
        nearest_into(self.arrays, queries, guess, index, squared)
        return index, squared

    def follow(
        self, queries: FloatArray, known: Followed | None = None
    ) -> tuple[IntArray, FloatArray, FloatArray, Followed]:
        """Return what `nearest` does, the points themselves (M, 3), and what is to be given as `known` next time.

        For queries that keep moving: several times faster than `nearest` once they move less than the points are apart.

        Args:
            queries: (M, 3) float64, finite.
            known: what the last call for these queries returned; None for the first. It is brought up to date in
                place: it says what is true of the points, whatever the queries are.

        Raises:
            InputError: shapes that do not match.
        """
        queries, m = writable(queries), len(queries)
        if known is None:
            known = Followed(np.full((m, NOTED + 1), -1, dtype=np.int32), np.zeros((m, 3)), np.zeros(m))
        elif len(known.reach) != m:
            raise InputError(f"What is known of {len(known.reach)} queries cannot serve {m}.")
        nearest, squared, points = np.empty(m, dtype=np.int32), np.empty(m), np.empty((m, 3))
        follow_into(self.arrays, queries, known, nearest, squared, points)
        return nearest, squared, points, known


def rows_of(original: IntArray) -> IntArray:
    """Return the row (N,) int32 at which each of the numbers `original` (N,) stands."""
    row_of = np.empty_like(original)
    row_of[original] = np.arange(len(original), dtype=np.int32)
    return row_of


def writable(queries: FloatArray) -> FloatArray:
    """Return `queries` (M, 3) as compiled loops take them: a copy where writing is refused, which is a type of its own.

    Raises:
        InputError: another shape.
    """
    if queries.ndim != 2 or queries.shape[1] != 3:
        raise InputError(f"Closest-point queries must have the shape (M, 3), not {queries.shape}.")
    return np.require(queries, dtype=np.float64, requirements=["C", "W"])


def checked_guess(guess: IntArray | None, queries: int, count: int) -> IntArray:
    """Return `guess` as (M,) int32 for as many `queries`, -1 throughout for None.

    Raises:
        InputError: another shape, or an index that is not below `count`.
    """
    if guess is None:
        return np.full(queries, -1, dtype=np.int32)
    if guess.shape != (queries,) or (queries and not (guess.min() >= -1 and guess.max() < count)):
        raise InputError(f"A guess must be one index below {count} a query, or -1 for none.")
    return np.require(guess, dtype=np.int32, requirements=["C", "W"])


@compiled
def _select(
    points: FloatArray, index: IntArray, low: int, high: int, middle: int, axis: int, left: IntArray, right: IntArray
) -> None:
    """Reorder rows low to high - 1 so that none before `middle` is greater along `axis` and none after is less.

    `left` and `right` (_BLOCK,) are workspace for rows to be swapped. They are found a block at a time, so that the
    processor need not guess the comparisons (Edelkamp and Weiss, ESA 2016); the order is that of the plain loop.
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
            # Plain numbers stay in registers, as the entries of an array that is written to do not.
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
def cover(points: FloatArray, boxes: FloatArray, depth: int) -> None:
    """Fill `boxes` around rows of one or several points, (N, 3 n) in leaf order, leaves first."""
    count, first_leaf = len(points), (1 << depth) - 1
    for leaf in range(1 << depth):
        box = boxes[first_leaf + leaf]
        box[:3], box[3:] = np.inf, -np.inf
        for row in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
            for start in range(0, points.shape[1], 3):
                for k in range(3):
                    value = points[row, start + k]
                    box[k] = value if value < box[k] else box[k]
                    box[3 + k] = value if value > box[3 + k] else box[3 + k]
    for node in range(first_leaf - 1, -1, -1):
        for k in range(3):
            boxes[node, k] = min(boxes[2 * node + 1, k], boxes[2 * node + 2, k])
            boxes[node, 3 + k] = max(boxes[2 * node + 1, 3 + k], boxes[2 * node + 2, 3 + k])


@compiled
def box_distance(boxes: FloatArray, node: int, x: float, y: float, z: float) -> float:
    """Return the squared distance of (x, y, z) from box `node`, never more than that of any point in it."""
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
    """Return the leaf of `row`, of `count` rows, and the top of `stack`, which gets what else may lie within `squared`.

    Half of the boxes that a search from the root would measure, and hardly a branch that goes wrong.
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
def descend(
    boxes: FloatArray,
    node: int,
    first_leaf: int,
    top: int,
    x: float,
    y: float,
    z: float,
    squared: float,
    stack: FloatArray,
) -> tuple[int, int]:
    """Return the leaf below `node` nearest to (x, y, z), -1 if nothing lies within `squared`, and the top of `stack`.

    Args:
        boxes: of the tree.
        node: where to begin.
        first_leaf: the first node that is a leaf.
        top: of the stack, which gets what else may lie within `squared`.
        x: coordinates of the query,
        y: in the unit
        z: of the boxes.
        squared: what lies farther is passed over.
        stack: (STACK_SIZE,) float64 workspace.
    """
    while node < first_leaf:
        left = 2 * node + 1
        near, far = box_distance(boxes, left, x, y, z), box_distance(boxes, left + 1, x, y, z)
        node = left
        if far < near:
            node = left + 1
            near, far = far, near
        if near > squared:
            return -1, top
        if far <= squared:
            stack[top], stack[top + 1] = 2 * left + 1 - node, far
            top += 2
    return node, top


@compiled
def next_node(stack: FloatArray, top: int, squared: float) -> tuple[int, int]:
    """Return the last node of `stack` that may hold something within `squared`, -1 for none, and the top below it."""
    while top > 0 and stack[top - 1] > squared:
        top -= 2
    return (int(stack[top - 2]), top - 2) if top > 0 else (-1, 0)


@compiled
def nearest_one(tree: KdArrays, x: float, y: float, z: float, guess: int, stack: FloatArray) -> tuple[int, float]:
    """Return the index of the point nearest to (x, y, z) and its squared distance.

    Args:
        tree: the points.
        x: coordinates of the query,
        y: in the unit
        z: of the points.
        guess: a point that may be near, or -1.
        stack: (STACK_SIZE,) float64 workspace, one a thread.
    """
    points, index, boxes, depth = tree.points, tree.original, tree.boxes, tree.depth
    count, first_leaf = len(index), (1 << depth) - 1
    best, squared = -1, np.inf
    node, top = 0, 0
    if guess >= 0:
        row = tree.row_of[guess]
        dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
        best, squared = guess, dx * dx + dy * dy + dz * dz
        node, top = start_at(boxes, row, count, depth, x, y, z, squared, stack)
    while node >= 0:
        node, top = descend(boxes, node, first_leaf, top, x, y, z, squared, stack)
        if node >= 0:
            leaf = node - first_leaf
            for row in range((leaf * count) >> depth, ((leaf + 1) * count) >> depth):
                dx, dy, dz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
                d = dx * dx + dy * dy + dz * dz
                if d < squared or (d == squared and (best < 0 or index[row] < best)):
                    best, squared = index[row], d
        node, top = next_node(stack, top, squared)
    return best, squared


@compiled
def nearest_into(
    tree: KdArrays, queries: FloatArray, guess: IntArray, index_out: IntArray, squared_out: FloatArray
) -> None:
    """Write index (M,) and squared distance (M,) of the points nearest to `queries` (M, 3) given `guess` (M,)."""
    stack = np.empty(STACK_SIZE)
    for i in range(len(queries)):
        nearest, squared = nearest_one(tree, queries[i, 0], queries[i, 1], queries[i, 2], guess[i], stack)
        index_out[i], squared_out[i] = nearest, squared


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
        tree: the points.
        x: coordinates of the query,
        y: in the unit
        z: of the points.
        limit: squared distance within which there are surely as many points as `rows` takes; infinity if unknown.
        start: row of a point that may be near, or -1.
        rows: (k,) int32 to be written, -1 where there are fewer points.
        squared: (k,) to be written, infinite there.
        stack: (STACK_SIZE,) float64 workspace, one a thread.
    """
    points, index, boxes, depth = tree.points, tree.original, tree.boxes, tree.depth
    count, first_leaf, last = len(index), (1 << depth) - 1, len(rows) - 1
    rows[:], squared[:] = -1, np.inf
    node, top = 0, 0
    if start >= 0:
        node, top = start_at(boxes, start, count, depth, x, y, z, limit, stack)
    while node >= 0:
        node, top = descend(boxes, node, first_leaf, top, x, y, z, limit, stack)
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
        node, top = next_node(stack, top, limit)


@compiled
def follow_into(
    tree: KdArrays,
    queries: FloatArray,
    known: Followed,
    index_out: IntArray,
    squared_out: FloatArray,
    points_out: FloatArray,
) -> None:
    """Write what `KdTree.follow` returns, and into `known` what was found."""
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
        # Rounding must not let a tie pass for a clear case.
        if np.sqrt(squared) + way >= reach * (1.0 - 1e-12):
            # All that were noted lie within this, so the search may start with it.
            far = way + reach if known.rows[i, NOTED] >= 0 else np.inf
            nearest_few(tree, x, y, z, far * far * (1.0 + 1e-12), known.rows[i, 0], known.rows[i], noted_squared, stack)
            best, squared = known.rows[i, 0], noted_squared[0]
            known.reach[i] = np.sqrt(noted_squared[NOTED])
            known.anchor[i, 0], known.anchor[i, 1], known.anchor[i, 2] = x, y, z
        index_out[i], squared_out[i] = tree.original[best], squared
        points_out[i, 0], points_out[i, 1], points_out[i, 2] = points[best, 0], points[best, 1], points[best, 2]
