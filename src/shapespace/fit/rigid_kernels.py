"""The loops of the search for a start: even thinning, a grid of nearest points, rigid and shape ICP from many poses.

Coarse poses are found on grids that hold a near point for each cell, so that a match is one look-up; the few that are
left are refined with exact matches, a scale and the leading modes. Residuals have no side, so the winding of triangles
does not matter. Weights are Geman and McClure's, with a reach that falls from step to step (graduated, as in Zhang,
Yao and Deng, PAMI 44(7), 2022).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shapespace.compiled import compiled
from shapespace.geometry.kdtree import STACK_SIZE, KdArrays, nearest_one
from shapespace.types import FloatArray, IntArray

_JACOBI_SWEEPS = 12


class NearGrid(NamedTuple):
    """A near point for each cell of a box.

    Args:
        near: (X, Y, Z) int32, the point nearest to the middle of each cell, up to the error of the sweeps.
        origin: (3,) lowest corner, mm.
        cell: length of the edges of a cell, mm.
    """

    near: IntArray
    origin: FloatArray
    cell: float


class ShapePoints(NamedTuple):
    """What the shape ICP knows of the model, in the model's frame.

    Args:
        points: (M, 3) of the mean, mm.
        normals: (M, 3) unit normals of either side; zero where there is none.
        modes: (M, 3, K) rows of the basis.
        precision: (K,) 1 / stddev^2, mm^-2.
        tree: of `points`.
    """

    points: FloatArray
    normals: FloatArray
    modes: FloatArray
    precision: FloatArray
    tree: KdArrays


@compiled
def one_in_each_cell(points: FloatArray, origin: FloatArray, cell: float, dims: IntArray) -> IntArray:
    """Return the indices of the first of `points` (N, 3) in each cell; those outside the box are left out."""
    taken = np.zeros((dims[0], dims[1], dims[2]), dtype=np.bool_)
    out = np.empty(len(points), dtype=np.int32)
    count = 0
    for i in range(len(points)):
        x, y, z = (
            (points[i, 0] - origin[0]) / cell,
            (points[i, 1] - origin[1]) / cell,
            (points[i, 2] - origin[2]) / cell,
        )
        if x < 0 or y < 0 or z < 0 or x >= dims[0] or y >= dims[1] or z >= dims[2]:
            continue
        a, b, c = int(x), int(y), int(z)
        if not taken[a, b, c]:
            taken[a, b, c] = True
            out[count] = i
            count += 1
    return out[:count].copy()


@compiled
def near_grid(points: FloatArray, origin: FloatArray, cell: float, dims: IntArray) -> IntArray:
    """Return (X, Y, Z) int32 a point near to the middle of each cell: seeds spread by sweeps along the axes.

    Source: Danielsson, Computer Graphics and Image Processing 14, 1980, with one neighbour a sweep.
    """
    nx, ny, nz = dims[0], dims[1], dims[2]
    grid = np.full((nx, ny, nz), -1, dtype=np.int32)
    for i in range(len(points)):
        a = min(max(int((points[i, 0] - origin[0]) / cell), 0), nx - 1)
        b = min(max(int((points[i, 1] - origin[1]) / cell), 0), ny - 1)
        c = min(max(int((points[i, 2] - origin[2]) / cell), 0), nz - 1)
        grid[a, b, c] = i
    flat = grid.reshape(-1)
    for _ in range(2):
        for axis in range(3):
            stride = 1 if axis == 2 else (nz if axis == 1 else ny * nz)
            for way in range(2):
                for a in range(nx):
                    p = a if way == 0 else nx - 1 - a
                    x = origin[0] + (p + 0.5) * cell
                    for b in range(ny):
                        q = b if way == 0 else ny - 1 - b
                        y = origin[1] + (q + 0.5) * cell
                        for c in range(nz):
                            r = c if way == 0 else nz - 1 - c
                            place = p if axis == 0 else (q if axis == 1 else r)
                            if (way == 0 and place == 0) or (way == 1 and place == dims[axis] - 1):
                                continue
                            here = (p * ny + q) * nz + r
                            other = flat[here - stride] if way == 0 else flat[here + stride]
                            mine = flat[here]
                            if other < 0 or other == mine:
                                continue
                            if mine < 0:
                                flat[here] = other
                                continue
                            z = origin[2] + (r + 0.5) * cell
                            dx, dy, dz = points[other, 0] - x, points[other, 1] - y, points[other, 2] - z
                            ex, ey, ez = points[mine, 0] - x, points[mine, 1] - y, points[mine, 2] - z
                            if dx * dx + dy * dy + dz * dz < ex * ex + ey * ey + ez * ez:
                                flat[here] = other
    return grid


@compiled
def _look_up(grid: NearGrid, x: float, y: float, z: float) -> int:
    nx, ny, nz = grid.near.shape
    a = min(max(int((x - grid.origin[0]) / grid.cell), 0), nx - 1)
    b = min(max(int((y - grid.origin[1]) / grid.cell), 0), ny - 1)
    c = min(max(int((z - grid.origin[2]) / grid.cell), 0), nz - 1)
    return grid.near[a, b, c]


@compiled
def best_rotation(H: FloatArray, R: FloatArray) -> None:
    """Write into `R` (3, 3) the rotation that maximises trace(R^T H), H = sum target source^T.

    Horn, JOSA A 4(4), 1987: the eigenvector of a symmetric 4 x 4 matrix, here by Jacobi's rotations.
    """
    N, V = np.empty((4, 4)), np.eye(4)
    N[0, 0] = H[0, 0] + H[1, 1] + H[2, 2]
    N[0, 1] = H[2, 1] - H[1, 2]
    N[0, 2] = H[0, 2] - H[2, 0]
    N[0, 3] = H[1, 0] - H[0, 1]
    N[1, 1] = H[0, 0] - H[1, 1] - H[2, 2]
    N[1, 2] = H[0, 1] + H[1, 0]
    N[1, 3] = H[2, 0] + H[0, 2]
    N[2, 2] = H[1, 1] - H[0, 0] - H[2, 2]
    N[2, 3] = H[1, 2] + H[2, 1]
    N[3, 3] = H[2, 2] - H[0, 0] - H[1, 1]
    size = 0.0
    for i in range(4):
        for j in range(i):
            N[i, j] = N[j, i]
        for j in range(4):
            size += N[i, j] * N[i, j]
    for _ in range(_JACOBI_SWEEPS):
        off = 0.0
        for i in range(3):
            for j in range(i + 1, 4):
                off += N[i, j] * N[i, j]
        if off <= 1e-26 * size:
            break
        for i in range(3):
            for j in range(i + 1, 4):
                if N[i, j] == 0.0:
                    continue
                theta = (N[j, j] - N[i, i]) / (2.0 * N[i, j])
                t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1.0))
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(4):
                    a, b = N[k, i], N[k, j]
                    N[k, i], N[k, j] = c * a - s * b, s * a + c * b
                for k in range(4):
                    a, b = N[i, k], N[j, k]
                    N[i, k], N[j, k] = c * a - s * b, s * a + c * b
                    a, b = V[k, i], V[k, j]
                    V[k, i], V[k, j] = c * a - s * b, s * a + c * b
    m = 0
    for i in range(1, 4):
        if N[i, i] > N[m, m]:
            m = i
    _from_quaternion(V[0, m], V[1, m], V[2, m], V[3, m], R)


@compiled
def _from_quaternion(w: float, x: float, y: float, z: float, R: FloatArray) -> None:
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@compiled
def rigid_search(
    rotations: FloatArray,
    translations: FloatArray,
    model: FloatArray,
    scan: FloatArray,
    scan_points: FloatArray,
    scan_grid: NearGrid,
    model_points: FloatArray,
    model_grid: NearGrid,
    reaches: FloatArray,
    cap: float,
) -> FloatArray:
    """Run two-way rigid ICP from each pose, in place, and return the score (S,) of each, mm.

    Args:
        rotations: (S, 3, 3) from the model's frame to the scan's, replaced by where they end.
        translations: (S, 3), likewise.
        model: (M, 3) points of the model that look for the scan.
        scan: (N, 3) points of the scan that look for the model.
        scan_points: (P, 3) those that `scan_grid` tells of.
        scan_grid: near points of the scan.
        model_points: (Q, 3) those that `model_grid` tells of.
        model_grid: near points of the model, in its own frame.
        reaches: (I,) distance at which a match loses three quarters of its weight, for each iteration, mm.
        cap: distance beyond which a match counts no more in the score, mm.
    """
    scores = np.empty(len(rotations))
    H, R = np.empty((3, 3)), np.empty((3, 3))
    a, c, x, y = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for start in range(len(rotations)):
        R[:] = rotations[start]
        tx, ty, tz = translations[start]
        for step in range(len(reaches) + 1):
            last = step == len(reaches)
            nu = cap if last else reaches[step] ** 2
            H[:] = 0.0
            a[:], c[:] = 0.0, 0.0
            total, forward, backward = 0.0, 0.0, 0.0
            for i in range(len(model) + len(scan)):
                if i < len(model):
                    for k in range(3):
                        x[k] = model[i, k]
                    px = R[0, 0] * x[0] + R[0, 1] * x[1] + R[0, 2] * x[2] + tx
                    py = R[1, 0] * x[0] + R[1, 1] * x[1] + R[1, 2] * x[2] + ty
                    pz = R[2, 0] * x[0] + R[2, 1] * x[1] + R[2, 2] * x[2] + tz
                    j = _look_up(scan_grid, px, py, pz)
                    for k in range(3):
                        y[k] = scan_points[j, k]
                    d = (px - y[0]) ** 2 + (py - y[1]) ** 2 + (pz - y[2]) ** 2
                else:
                    for k in range(3):
                        y[k] = scan[i - len(model), k]
                    qx, qy, qz = y[0] - tx, y[1] - ty, y[2] - tz
                    px = R[0, 0] * qx + R[1, 0] * qy + R[2, 0] * qz
                    py = R[0, 1] * qx + R[1, 1] * qy + R[2, 1] * qz
                    pz = R[0, 2] * qx + R[1, 2] * qy + R[2, 2] * qz
                    j = _look_up(model_grid, px, py, pz)
                    for k in range(3):
                        x[k] = model_points[j, k]
                    d = (px - x[0]) ** 2 + (py - x[1]) ** 2 + (pz - x[2]) ** 2
                if last:
                    d = min(np.sqrt(d), cap)
                    if i < len(model):
                        forward += d
                    else:
                        backward += d
                    continue
                w = (nu / (nu + d)) ** 2
                total += w
                for k in range(3):
                    a[k] += w * x[k]
                    c[k] += w * y[k]
                    for m in range(3):
                        H[k, m] += w * y[k] * x[m]
            if last:
                scores[start] = 0.5 * (forward / len(model) + backward / len(scan))
                break
            for k in range(3):
                a[k], c[k] = a[k] / total, c[k] / total
            for k in range(3):
                for m in range(3):
                    H[k, m] -= total * c[k] * a[m]
            best_rotation(H, R)
            tx = c[0] - (R[0, 0] * a[0] + R[0, 1] * a[1] + R[0, 2] * a[2])
            ty = c[1] - (R[1, 0] * a[0] + R[1, 1] * a[1] + R[1, 2] * a[2])
            tz = c[2] - (R[2, 0] * a[0] + R[2, 1] * a[1] + R[2, 2] * a[2])
        rotations[start] = R
        translations[start, 0], translations[start, 1], translations[start, 2] = tx, ty, tz
    return scores


@compiled
def shape_search(
    R: FloatArray,
    t: FloatArray,
    scale: float,
    b: FloatArray,
    shape: ShapePoints,
    scan: FloatArray,
    tree: KdArrays,
    counts: IntArray,
    reaches: FloatArray,
    prior: float,
    scale_precision: float,
    slack: FloatArray,
    cap: float,
    out: FloatArray,
) -> float:
    """Run two-way Gauss-Newton over pose and leading modes from one pose, in place, and return the scale it ends at.

    All is solved in the model's frame, where the modes need no turning; a mean point x and a scan point q brought
    there differ by e = x - q, and the cost is sum w e^T (n n^T + eta I) e + prior reach^2 (sum b_k^2 / lam_k + c
    log(scale)^2), w Geman and McClure's.

    Args:
        R: (3, 3) rotation from the model's frame to the scan's, replaced.
        t: (3,) translation, replaced.
        scale: where it begins.
        b: (K,) coefficients, replaced, mm.
        shape: the model.
        scan: (N, 3) points of the scan, in any order.
        tree: of the scan's points.
        counts: (2,) how many of the first points of the model and of the scan look for the other.
        reaches: (I,) of the weights, for each iteration, mm.
        prior: weight of the prior.
        scale_precision: c; infinity holds the scale.
        slack: (2,) how far a match may lie sideways, model to scan and back, mm.
        cap: distance beyond which a match counts no more in the score, mm.
        out: (3,) replaced by: score of the model to the scan, of the scan to the model, mm, and the share of the
            model's points that have the scan where they are.
    """
    n_modes = len(b)
    size = 7 + n_modes
    A, g, J, W = np.empty((size, size)), np.empty(size), np.empty((3, size)), np.empty((3, size))
    stack = np.empty(STACK_SIZE)
    n_model, n_scan = counts[0], counts[1]
    guess = np.full(n_model + n_scan, -1, dtype=np.int32)
    x, q, e, n, y = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    turn = np.empty((3, 3))
    held = not np.isfinite(scale_precision)
    for step in range(len(reaches) + 1):
        last = step == len(reaches)
        nu = reaches[len(reaches) - 1] ** 2 if last else reaches[step] ** 2
        A[:], g[:], out[:] = 0.0, 0.0, 0.0
        seen = 0
        for i in range(n_model + n_scan):
            forward = i < n_model
            if forward:
                at = i
                for k in range(3):
                    x[k] = shape.points[at, k]
                    for m in range(n_modes):
                        x[k] += shape.modes[at, k, m] * b[m]
                for k in range(3):
                    y[k] = scale * (R[k, 0] * x[0] + R[k, 1] * x[1] + R[k, 2] * x[2]) + t[k]
                j, _ = nearest_one(tree, y[0], y[1], y[2], guess[i], stack)
                guess[i] = j
                for k in range(3):
                    y[k] = tree.points[tree.place[j], k] - t[k]
                for k in range(3):
                    q[k] = (R[0, k] * y[0] + R[1, k] * y[1] + R[2, k] * y[2]) / scale
            else:
                for k in range(3):
                    y[k] = scan[i - n_model, k] - t[k]
                for k in range(3):
                    q[k] = (R[0, k] * y[0] + R[1, k] * y[1] + R[2, k] * y[2]) / scale
                for k in range(3):
                    y[k] = q[k]
                # The tree is of the mean, so the query goes back by the last match's displacement.
                at = guess[i]
                if at >= 0:
                    for k in range(3):
                        for m in range(n_modes):
                            y[k] -= shape.modes[at, k, m] * b[m]
                at, _ = nearest_one(shape.tree, y[0], y[1], y[2], at, stack)
                guess[i] = at
                for k in range(3):
                    x[k] = shape.points[at, k]
                    for m in range(n_modes):
                        x[k] += shape.modes[at, k, m] * b[m]
            along, whole, facing = 0.0, 0.0, 0.0
            for k in range(3):
                n[k] = shape.normals[at, k]
                e[k] = x[k] - q[k]
                along += n[k] * e[k]
                whole += e[k] * e[k]
                facing += n[k] * n[k]
            if facing == 0.0:
                along = np.sqrt(whole)
            sideways = np.sqrt(max(whole - along * along, 0.0))
            allowed = slack[0] if forward else slack[1]
            if last:
                covered = sideways <= allowed
                d = min(abs(along), cap)
                if forward:
                    out[0] += d if covered else cap
                    out[2] += 1.0 if covered and d < cap else 0.0
                elif covered:
                    seen += 1
                    out[1] += d
                continue
            beyond = max(sideways - allowed, 0.0)
            w = (nu / (nu + along * along + beyond * beyond * 4.0)) ** 2
            for m in range(n_modes):
                for k in range(3):
                    J[k, 7 + m] = shape.modes[at, k, m]
            J[0, 0], J[0, 1], J[0, 2] = 0.0, q[2], -q[1]
            J[1, 0], J[1, 1], J[1, 2] = -q[2], 0.0, q[0]
            J[2, 0], J[2, 1], J[2, 2] = q[1], -q[0], 0.0
            for k in range(3):
                for m in range(3):
                    J[k, 3 + m] = 1.0 if k == m else 0.0
                J[k, 6] = q[k]
            eta = 0.1 if facing > 0 else 1.0
            for p in range(size):
                dot = n[0] * J[0, p] + n[1] * J[1, p] + n[2] * J[2, p]
                if facing == 0.0:
                    dot = 0.0
                for k in range(3):
                    W[k, p] = w * (dot * n[k] + eta * J[k, p])
                g[p] += W[0, p] * e[0] + W[1, p] * e[1] + W[2, p] * e[2]
            for p in range(size):
                for r in range(p + 1):
                    A[p, r] += W[0, p] * J[0, r] + W[1, p] * J[1, r] + W[2, p] * J[2, r]
        if last:
            out[0] /= n_model
            out[2] /= n_model
            out[1] = out[1] / seen if seen > 0 else cap
            break
        for m in range(n_modes):
            A[7 + m, 7 + m] += prior * nu * shape.precision[m]
            g[7 + m] += prior * nu * shape.precision[m] * b[m]
        if held:
            A[6, :7], A[7:, 6], A[6, 6], g[6] = 0.0, 0.0, 1.0, 0.0
        else:
            A[6, 6] += prior * nu * scale_precision
            g[6] += prior * nu * scale_precision * np.log(scale)
        for p in range(6):
            A[p, p] += 1e-6 * (A[p, p] + 1.0)
        _solve(A, g)
        angle = np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2)
        # A step of Gauss-Newton is only good nearby.
        shrink = min(1.0, 0.35 / max(angle, 1e-12))
        half = 0.5 * angle * shrink
        sine = -np.sin(half) / max(angle, 1e-12)
        _from_quaternion(np.cos(half), sine * g[0], sine * g[1], sine * g[2], turn)
        if not held:
            scale *= np.exp(max(min(-g[6] * shrink, 0.1), -0.1))
            scale = max(min(scale, 1.6), 0.6)
        for k in range(3):
            y[k] = R[k, 0]
        for k in range(3):
            u, v, z = R[k, 0], R[k, 1], R[k, 2]
            for m in range(3):
                R[k, m] = u * turn[0, m] + v * turn[1, m] + z * turn[2, m]
        for k in range(3):
            t[k] -= shrink * scale * (R[k, 0] * g[3] + R[k, 1] * g[4] + R[k, 2] * g[5])
        for m in range(n_modes):
            b[m] -= shrink * g[7 + m]
            limit = 3.0 / np.sqrt(shape.precision[m])
            b[m] = max(min(b[m], limit), -limit)
    return scale


@compiled
def _solve(A: FloatArray, g: FloatArray) -> None:
    """Replace `g` by A^-1 g by Cholesky's method, A positive definite and given by its lower triangle."""
    size = len(g)
    for p in range(size):
        for r in range(p + 1):
            s = A[p, r]
            for k in range(r):
                s -= A[p, k] * A[r, k]
            A[p, r] = np.sqrt(max(s, 1e-300)) if p == r else s / A[r, r]
    for p in range(size):
        for k in range(p):
            g[p] -= A[p, k] * g[k]
        g[p] /= A[p, p]
    for p in range(size - 1, -1, -1):
        for k in range(p + 1, size):
            g[p] -= A[k, p] * g[k]
        g[p] /= A[p, p]
