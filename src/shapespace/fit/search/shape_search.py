"""Last steps of the pose search: symmetric Gauss-Newton over pose and leading modes, from one pose.

Matches are exact. Residuals have no side, so the winding of triangles does not matter. Weights are those of
`rigid_search`. The normal equations are its own: those of `robust` find the same poses, at 1.6 times the CPU time of a
search (docs/architecture.md).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from shapespace.compiled import compiled
from shapespace.geometry.kdtree import NOTED, KdArrays, WarmStart, follow_into
from shapespace.types import FloatArray, IntArray


class ShapePoints(NamedTuple):
    """Points, normals and modes of the model for the shape search, in the model's frame.

    Args:
        points: (M, 3) points of the mean, mm.
        normals: (M, 3) unit normals, of either sign; zero if unknown.
        modes: (M, 3, K) rows of the basis.
        precision: (K,) 1 / stddev^2, mm^-2.
        tree: search tree of `points`.
    """

    points: FloatArray
    normals: FloatArray
    modes: FloatArray
    precision: FloatArray
    tree: KdArrays


# Loops instead of NumPy's functions of matrices, whose compilation takes half a minute.


@compiled
def _turn_about(R: FloatArray, v: FloatArray) -> None:
    """Replace R (3, 3) by R times the rotation about `v` by its length, rad, by Rodrigues' formula."""
    angle = max(np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]), 1e-9)
    along, across = (1.0 - np.cos(angle)) / angle**2, np.sin(angle) / angle
    for k in range(3):
        x, y, z = R[k, 0], R[k, 1], R[k, 2]
        dot = along * (x * v[0] + y * v[1] + z * v[2])
        for m in range(3):
            R[k, m] = np.cos(angle) * R[k, m] + dot * v[m]
        R[k, 0] += across * (y * v[2] - z * v[1])
        R[k, 1] += across * (z * v[0] - x * v[2])
        R[k, 2] += across * (x * v[1] - y * v[0])


@compiled
def _solve(A: FloatArray, g: FloatArray) -> bool:
    """Replace g (N,) by the solution of A x = g, and return whether there is one.

    A (N, N) is positive definite, and its lower half is overwritten (Cholesky).
    """
    for p in range(len(g)):
        for r in range(p + 1):
            for k in range(r):
                A[p, r] -= A[p, k] * A[r, k]
            if r < p:
                A[p, r] /= A[r, r]
            elif not A[p, p] > 0.0:
                return False
            else:
                A[p, p] = np.sqrt(A[p, p])
        for k in range(p):
            g[p] -= A[p, k] * g[k]
        g[p] /= A[p, p]
    for p in range(len(g) - 1, -1, -1):
        for k in range(p + 1, len(g)):
            g[p] -= A[k, p] * g[k]
        g[p] /= A[p, p]
    return True


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
    radii: FloatArray,
    prior_weight: float,
    scale_precision: float,
    slack: FloatArray,
    cap: float,
    out: FloatArray,
) -> float:
    """Run symmetric Gauss-Newton over pose and leading modes from one pose, in place, and return the final scale.

    The equations are solved in the model's frame, where the modes need no rotation; a mean point x and a scan point q
    in that frame differ by e = x - q, and the cost is sum w e^T (n n^T + eta I) e + prior_weight radius^2 (sum b_k^2 /
    lam_k + c log(scale)^2), with w of Geman and McClure.

    Args:
        R: (3, 3) rotation from the model's frame to the scan's, replaced.
        t: (3,) translation, replaced.
        scale: initial scale.
        b: (K,) coefficients, replaced, mm.
        shape: the model.
        scan: (N, 3) points of the scan, in any order.
        tree: search tree of the scan's points.
        counts: (2,) number of the first points of the model, and of the scan, that are matched to the other.
        radii: (I,) reach of the weights for each iteration, mm.
        prior_weight: weight of the prior.
        scale_precision: c; infinity fixes the scale.
        slack: (2,) largest sideways distance of a match, model to scan and back, mm.
        cap: distance at which matches are capped in the score, mm.
        out: (3,) replaced by: score of the model to the scan, of the scan to the model, mm, and the share of the
            model's points for which the scan has a point there; infinite if a step has no solution.
    """
    n_modes = len(b)
    size = 7 + n_modes
    A, g, J = np.empty((size, size)), np.empty(size), np.empty((3, size))
    J0, J1, J2 = J[0], J[1], J[2]
    n_model, n_scan = counts[0], counts[1]
    n_all = n_model + n_scan
    best, squared = np.full(n_all, -1, dtype=np.int32), np.empty(n_all)
    queries, matches = np.empty((n_all, 3)), np.empty((n_all, 3))
    known = WarmStart(np.full((n_all, NOTED + 1), -1, dtype=np.int32), np.zeros((n_all, 3)), np.zeros(n_all))
    known_of_model = WarmStart(known.rows[:n_model], known.anchor[:n_model], known.reach[:n_model])
    known_of_scan = WarmStart(known.rows[n_model:], known.anchor[n_model:], known.reach[n_model:])
    x, q, e, n, y = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    is_scale_fixed = not np.isfinite(scale_precision)
    for step in range(len(radii) + 1):
        last = step == len(radii)
        nu = radii[len(radii) - 1] ** 2 if last else radii[step] ** 2
        A[:], g[:], out[:] = 0.0, 0.0, 0.0
        n_used = 0
        for i in range(n_all):
            if i < n_model:
                for k in range(3):
                    x[k] = shape.points[i, k]
                    for m in range(n_modes):
                        x[k] += shape.modes[i, k, m] * b[m]
                for k in range(3):
                    queries[i, k] = scale * (R[k, 0] * x[0] + R[k, 1] * x[1] + R[k, 2] * x[2]) + t[k]
            else:
                for k in range(3):
                    y[k] = scan[i - n_model, k] - t[k]
                for k in range(3):
                    queries[i, k] = (R[0, k] * y[0] + R[1, k] * y[1] + R[2, k] * y[2]) / scale
                # The tree is of the mean, so the query goes back by the last match's displacement.
                if best[i] >= 0:
                    for k in range(3):
                        for m in range(n_modes):
                            queries[i, k] -= shape.modes[best[i], k, m] * b[m]
        follow_into(tree, queries[:n_model], known_of_model, best[:n_model], squared[:n_model], matches[:n_model])
        follow_into(shape.tree, queries[n_model:], known_of_scan, best[n_model:], squared[n_model:], matches[n_model:])
        for i in range(n_all):
            forward = i < n_model
            best_index = i if forward else best[i]
            for k in range(3):
                y[k] = (matches[i, k] if forward else scan[i - n_model, k]) - t[k]
                x[k] = shape.points[best_index, k]
                for m in range(n_modes):
                    x[k] += shape.modes[best_index, k, m] * b[m]
            for k in range(3):
                q[k] = (R[0, k] * y[0] + R[1, k] * y[1] + R[2, k] * y[2]) / scale
            along, total, facing = 0.0, 0.0, 0.0
            for k in range(3):
                n[k] = shape.normals[best_index, k]
                e[k] = x[k] - q[k]
                along += n[k] * e[k]
                total += e[k] * e[k]
                facing += n[k] * n[k]
            if facing == 0.0:
                along = np.sqrt(total)
            sideways = np.sqrt(max(total - along * along, 0.0))
            allowed = slack[0] if forward else slack[1]
            if last:
                is_within = sideways <= allowed
                d = min(abs(along), cap)
                if forward:
                    out[0] += d if is_within else cap
                    out[2] += 1.0 if is_within and d < cap else 0.0
                elif is_within:
                    n_used += 1
                    out[1] += d
                continue
            excess = max(sideways - allowed, 0.0)
            w = (nu / (nu + along * along + excess * excess * 4.0)) ** 2
            for m in range(n_modes):
                for k in range(3):
                    J[k, 7 + m] = shape.modes[best_index, k, m]
            J[0, 0], J[0, 1], J[0, 2] = 0.0, q[2], -q[1]
            J[1, 0], J[1, 1], J[1, 2] = -q[2], 0.0, q[0]
            J[2, 0], J[2, 1], J[2, 2] = q[1], -q[0], 0.0
            for k in range(3):
                for m in range(3):
                    J[k, 3 + m] = 1.0 if k == m else 0.0
                J[k, 6] = q[k]
            eta = 0.1 if facing > 0 else 1.0
            for p in range(size):
                dot = n[0] * J0[p] + n[1] * J1[p] + n[2] * J2[p]
                w0 = w * (dot * n[0] + eta * J0[p])
                w1 = w * (dot * n[1] + eta * J1[p])
                w2 = w * (dot * n[2] + eta * J2[p])
                g[p] += w0 * e[0] + w1 * e[1] + w2 * e[2]
                for r in range(p + 1):
                    A[p, r] += w0 * J0[r] + w1 * J1[r] + w2 * J2[r]
        if last:
            out[0] /= n_model
            out[2] /= n_model
            out[1] = out[1] / n_used if n_used > 0 else cap
            break
        for m in range(n_modes):
            A[7 + m, 7 + m] += prior_weight * nu * shape.precision[m]
            g[7 + m] += prior_weight * nu * shape.precision[m] * b[m]
        if is_scale_fixed:
            A[6, :7], A[7:, 6], A[6, 6], g[6] = 0.0, 0.0, 1.0, 0.0
        else:
            A[6, 6] += prior_weight * nu * scale_precision
            g[6] += prior_weight * nu * scale_precision * np.log(scale)
        for p in range(6):
            A[p, p] += 1e-6 * (A[p, p] + 1.0)
        if not _solve(A, g):
            out[:] = np.inf
            break
        angle = np.sqrt(g[0] ** 2 + g[1] ** 2 + g[2] ** 2)
        # A step of Gauss-Newton is only good for small motions.
        shrink = min(1.0, 0.35 / max(angle, 1e-12))
        for k in range(3):
            y[k] = -shrink * g[k]
        _turn_about(R, y)
        if not is_scale_fixed:
            scale *= np.exp(max(min(-g[6] * shrink, 0.1), -0.1))
            scale = max(min(scale, 1.6), 0.6)
        for k in range(3):
            t[k] -= shrink * scale * (R[k, 0] * g[3] + R[k, 1] * g[4] + R[k, 2] * g[5])
        for m in range(n_modes):
            b[m] -= shrink * g[7 + m]
            limit = 3.0 / np.sqrt(shape.precision[m])
            b[m] = max(min(b[m], limit), -limit)
    return scale
