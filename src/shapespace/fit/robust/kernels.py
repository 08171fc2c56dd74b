"""Compiled loops of the robust fit: normals, the walk to the closest point of a moving model, and its rows."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from shapespace.compiled import compiled
from shapespace.geometry.bvh import edges_of, on_face, over_face
from shapespace.types import BoolArray, FloatArray, IntArray

Float32Array = npt.NDArray[np.float32]


@compiled
def normals_into(vertices: FloatArray, faces: IntArray, normals: FloatArray) -> None:
    """Write the area-weighted unit normals (V, 3) of the vertices."""
    normals[:] = 0.0
    for f in range(len(faces)):
        nx, ny, nz = _twice_the_area(vertices, faces, f)
        for k in range(3):
            v = faces[f, k]
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        if length > 0.0:
            for axis in range(3):
                normals[v, axis] /= length


@compiled
def areas_into(vertices: FloatArray, faces: IntArray, areas: FloatArray) -> None:
    """Add to `areas` (V,) a third of the area of each triangle at each of its vertices."""
    for f in range(len(faces)):
        x, y, z = _twice_the_area(vertices, faces, f)
        third = np.sqrt(x * x + y * y + z * z) / 6.0
        for k in range(3):
            areas[faces[f, k]] += third


@compiled
def _twice_the_area(vertices: FloatArray, faces: IntArray, f: int) -> tuple[float, float, float]:
    """Return the normal of triangle `f`, as long as twice its area."""
    ux, uy, uz, vx, vy, vz = edges_of(vertices, faces, f)
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


@compiled
def walk_into(
    points: FloatArray,
    vertex: IntArray,
    vertices: FloatArray,
    faces: IntArray,
    ring_start: IntArray,
    ring: IntArray,
    fan_start: IntArray,
    fan: IntArray,
    triangle: IntArray,
    weights: FloatArray,
) -> None:
    """Find the closest model point of each of `points` (M, 3) by walking over the edges from the last match.

    A point that still lies over its triangle keeps it. Otherwise the walk goes downhill from vertex to vertex, then
    over the triangles around its last vertex. It can end in a local minimum, so callers start from exact matches
    if the model has moved far.

    Args:
        points: (M, 3) query points, mm.
        vertex: (M,) start vertex of each walk, replaced by its end.
        vertices: (V, 3) vertices of the model in the frame of `points`, mm.
        faces: (F, 3) triangles of the model.
        ring_start: (V + 1,) start of the neighbours of each vertex in `ring`.
        ring: (R,) neighbours of the vertices.
        fan_start: (V + 1,) start of the triangles around each vertex in `fan`.
        fan: (3F,) triangles around the vertices.
        triangle: (M,) triangles of the last matches, -1 if unknown, replaced by those of the new matches.
        weights: (M, 3) output: barycentric coordinates of the matches.
    """
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if triangle[i] >= 0:
            b, c = over_face(vertices, faces, triangle[i], x, y, z)
            if b > 0.0 and c > 0.0 and b + c < 1.0:
                weights[i, 0], weights[i, 1], weights[i, 2] = 1.0 - b - c, b, c
                continue
        v = vertex[i]
        dx, dy, dz = vertices[v, 0] - x, vertices[v, 1] - y, vertices[v, 2] - z
        squared, here = dx * dx + dy * dy + dz * dz, -1
        while here != v:
            here = v
            for entry in range(ring_start[here], ring_start[here + 1]):
                w = ring[entry]
                dx, dy, dz = vertices[w, 0] - x, vertices[w, 1] - y, vertices[w, 2] - z
                d = dx * dx + dy * dy + dz * dz
                if d < squared:
                    squared, v = d, w
        vertex[i] = v
        best, b, c, least = -1, 0.0, 0.0, np.inf
        for entry in range(fan_start[v], fan_start[v + 1]):
            d, wb, wc = on_face(vertices, faces, fan[entry], x, y, z, least)
            if d < least or best < 0:
                best, least, b, c = fan[entry], d, wb, wc
        triangle[i] = best
        weights[i, 0], weights[i, 1], weights[i, 2] = max(0.0, 1.0 - b - c), b, c


@compiled
def meet_into(
    points: FloatArray,
    point_normals: FloatArray,
    triangle: IntArray,
    weights: FloatArray,
    vertices: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    rim: BoolArray,
    residual: FloatArray,
    distance: FloatArray,
    cosine: FloatArray,
    covered: BoolArray,
) -> None:
    """Compare each point with the model point it was matched to.

    Args:
        points: (M, 3) points in the model's frame, mm.
        point_normals: (M, 3) unit normals at the points, zero if unknown.
        triangle: (M,) triangle of the model on which each point is matched.
        weights: (M, 3) barycentric coordinates of the match on its triangle.
        vertices: (V, 3) vertices of the model, mm.
        normals: (V, 3) unit normals of the model's vertices.
        faces: (F, 3) triangles of the model.
        rim: (V,) True on the model's border.
        residual: (M,) output: distance by which the model lies beyond the point along the model's normal, mm.
        distance: (M,) output: distance of the point from its match, mm.
        cosine: (M,) output: cosine of the angle between the normals; 1 if the point has no normal.
        covered: (M,) output: False if the match lies on the border, so that the model ends there.
    """
    for i in range(len(points)):
        a, b, c = faces[triangle[i], 0], faces[triangle[i], 1], faces[triangle[i], 2]
        wa, wb, wc = weights[i, 0], weights[i, 1], weights[i, 2]
        along, squared, length, dot, known = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            n = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
            e = wa * vertices[a, k] + wb * vertices[b, k] + wc * vertices[c, k] - points[i, k]
            along += n * e
            squared += e * e
            length += n * n
            dot += n * point_normals[i, k]
            known += point_normals[i, k] ** 2
        length = np.sqrt(length) if length > 0.0 else 1.0
        residual[i], distance[i] = along / length, np.sqrt(squared)  # R4
        cosine[i] = dot / length if known > 0.0 else 1.0
        covered[i] = (wa > 1e-9 and not rim[a]) or (wb > 1e-9 and not rim[b]) or (wc > 1e-9 and not rim[c])


@compiled
def on_scan_into(
    corners: IntArray,
    weights: FloatArray,
    scan_normals: FloatArray,
    rim: BoolArray,
    normals: FloatArray,
    inside: BoolArray,
) -> None:
    """Write the normal of the scan at each match, and whether the match is off the border of the scan.

    Args:
        corners: (N, c) vertices of the scan that carry each match: three of a triangle, or one.
        weights: (N, c) barycentric weights of these vertices.
        scan_normals: (S, 3) unit normals of the scan's vertices.
        rim: (S,) True on the border of the scan.
        normals: (N, 3) output: normals at the matches, not exactly of unit length between vertices.
        inside: (N,) output: True for matches off the border of the scan.
    """
    for i in range(len(corners)):
        x, y, z, off_rim = 0.0, 0.0, 0.0, False
        for c in range(corners.shape[1]):
            v, w = corners[i, c], weights[i, c]
            x += w * scan_normals[v, 0]
            y += w * scan_normals[v, 1]
            z += w * scan_normals[v, 2]
            off_rim = off_rim or (w > 1e-9 and not rim[v])
        normals[i, 0], normals[i, 1], normals[i, 2], inside[i] = x, y, z, off_rim


@compiled
def compare_into(
    to_scan: FloatArray,
    model_normals: FloatArray,
    scan_normals: FloatArray,
    winding: float,
    normal_cosine: float,
    residual: FloatArray,
    allowed: BoolArray,
) -> None:
    """Compare each vertex of the model with its match on the scan (R5, R6).

    Args:
        to_scan: (N, 3) vector from the match to the vertex, in the model's frame, mm.
        model_normals: (N, 3) unit normals of the vertices.
        scan_normals: (N, 3) normals of the matches; (0, 3) for a scan without triangles, whose normals are not tested.
        winding: -1 if the scan's normals are reversed, else 1.
        normal_cosine: cosine of the largest angle between the normals of an allowed match.
        residual: (N,) output: residuals along the normals of the model, mm.
        allowed: (N,) mask of allowed matches, set to False if the normals disagree.
    """
    for i in range(len(to_scan)):
        nx, ny, nz = model_normals[i, 0], model_normals[i, 1], model_normals[i, 2]
        # Sums in the order of NumPy's `einsum`.
        residual[i] = to_scan[i, 0] * nx + to_scan[i, 2] * nz + to_scan[i, 1] * ny  # R5
        if len(scan_normals) > 0:
            x, y, z = scan_normals[i, 0], scan_normals[i, 1], scan_normals[i, 2]
            cosine = winding * (nx * x + nz * z + ny * y)
            allowed[i] = allowed[i] and cosine > normal_cosine * np.sqrt(x * x + y * y + z * z)  # R6


@compiled
def less_sag(
    triangle: IntArray,
    barycentric: FloatArray,
    vertices: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    residual: FloatArray,
) -> None:
    """Add to each residual (M,) the height by which the surface through the corners bulges over its flat triangle.

    The tangent planes at the corners lie twice as far over a point of the triangle as a quadric with those normals
    (Boubekeur and Alexa, ACM Trans. Graph. 27, 2008, with the share of one half).

    Args:
        triangle: (M,) triangle of the surface for each residual.
        barycentric: (M, 3) barycentric coordinates on the triangle.
        vertices: (V, 3) vertices of the surface, mm.
        normals: (V, 3) unit normals of the vertices.
        faces: (F, 3) triangles of the surface.
        residual: (M,) residuals along the normals, mm, to which the height is added.
    """
    for i in range(len(triangle)):
        a, b, c = faces[triangle[i], 0], faces[triangle[i], 1], faces[triangle[i], 2]
        wa, wb, wc = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
        over = 0.0
        for k in range(3):
            p = wa * vertices[a, k] + wb * vertices[b, k] + wc * vertices[c, k]
            over += wa * normals[a, k] * (vertices[a, k] - p)
            over += wb * normals[b, k] * (vertices[b, k] - p)
            over += wc * normals[c, k] * (vertices[c, k] - p)
        residual[i] += 0.5 * over


@compiled
def gather_into(
    triangle: IntArray,
    barycentric: FloatArray,
    faces: IntArray,
    w: FloatArray,
    residual: FloatArray,
    W: FloatArray,
    h: FloatArray,
) -> None:
    """Add the weights w (M,) and weighted residuals of matched points to the model vertices that carry them (R10)."""
    for i in range(len(triangle)):
        if w[i] > 0.0:
            for k in range(3):
                v, share = faces[triangle[i], k], w[i] * barycentric[i, k]
                W[v] += share
                h[v] += share * residual[i]


@compiled
def rows_into(
    vertices: FloatArray,
    normals: FloatArray,
    basis: Float32Array,
    modes: int,
    W: FloatArray,
    h: FloatArray,
    rows: Float32Array,
    gradient: FloatArray,
) -> int:
    """Write the weighted rows of the Jacobian and the gradient (R11, R12); return the number of rows.

    Row j is sqrt(W_j) J_j, with J_j = n_j^T [ -[x_j]x | I | x_j | P_j ].

    Args:
        vertices: (V, 3) model vertices x, mm.
        normals: (V, 3) unit normals of the model vertices.
        basis: (V, 3, C) modes, float32.
        modes: k, the number of free modes.
        W: (V,) weight of each vertex.
        h: (V,) weighted residual of each vertex, mm.
        rows: (V, 7 + C) float32 output: weighted rows of the Jacobian.
        gradient: (7 + C,) gradient, to which that of the matches is added.
    """
    count = 0
    for j in range(len(vertices)):
        if W[j] <= 0.0:
            continue
        nx, ny, nz = normals[j, 0], normals[j, 1], normals[j, 2]
        x, y, z = vertices[j, 0], vertices[j, 1], vertices[j, 2]
        row, root, pull = rows[count], np.float32(np.sqrt(W[j])), h[j]
        pose = (y * nz - z * ny, z * nx - x * nz, x * ny - y * nx, nx, ny, nz, nx * x + ny * y + nz * z)  # R11
        for k in range(7):
            row[k] = root * np.float32(pose[k])
            gradient[k] += pull * pose[k]
        fx, fy, fz, p = np.float32(nx), np.float32(ny), np.float32(nz), np.float32(pull)
        for k in range(modes):
            along = fx * basis[j, 0, k] + fy * basis[j, 1, k] + fz * basis[j, 2, k]
            row[7 + k] = root * along
            gradient[7 + k] += np.float64(p * along)
        count += 1
    return count
