"""Compiled loops of the dense stage: a smooth field on a surface by conjugate gradients."""

from __future__ import annotations

import numpy as np

from shapespace.compiled import compiled
from shapespace.types import BoolArray, FloatArray, IntArray


@compiled
def compare_triangles(
    vertices: FloatArray,
    normals: FloatArray,
    faces: IntArray,
    normals_before: FloatArray,
    cosine: FloatArray,
    even: BoolArray,
) -> None:
    """Compute the rotation of each triangle, and whether it agrees with its neighbours.

    Args:
        vertices: (V, 3),
        normals: (V, 3) unit.
        faces: (F, 3).
        normals_before: (F, 3) their unit normals before.
        cosine: (F,) to be written: of the angle between then and now; 0 without area.
        even: (F,) to be written: whether each lies within 90 degrees of the normals at its corners.
    """
    n = np.empty(3)
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        length, along = 0.0, 0.0
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            n[k] = (b[i] - a[i]) * (c[j] - a[j]) - (b[j] - a[j]) * (c[i] - a[i])
            length += n[k] * n[k]
            along += n[k] * normals_before[f, k]
        cosine[f] = along / np.sqrt(length) if length > 0.0 else 0.0
        even[f] = True
        for corner in range(3):
            v = faces[f, corner]
            if n[0] * normals[v, 0] + n[1] * normals[v, 1] + n[2] * normals[v, 2] <= 0.0:
                even[f] = False


@compiled
def _times_into(
    x: FloatArray,
    ring_start: IntArray,
    ring: IntArray,
    off_diagonal: FloatArray,
    diagonal: FloatArray,
    scale: FloatArray,
    out: FloatArray,
) -> None:
    """Write the rows of A x, each times its `scale` (V,)."""
    if x.shape[1] == 3:
        for v in range(len(x)):
            a, b, c = diagonal[v] * x[v, 0], diagonal[v] * x[v, 1], diagonal[v] * x[v, 2]
            for entry in range(ring_start[v], ring_start[v + 1]):
                w, r = off_diagonal[entry], ring[entry]
                a += w * x[r, 0]
                b += w * x[r, 1]
                c += w * x[r, 2]
            out[v, 0], out[v, 1], out[v, 2] = scale[v] * a, scale[v] * b, scale[v] * c
    else:
        for v in range(len(x)):
            a = diagonal[v] * x[v, 0]
            for entry in range(ring_start[v], ring_start[v + 1]):
                a += off_diagonal[entry] * x[ring[entry], 0]
            out[v, 0] = scale[v] * a


@compiled
def _conditioned_into(
    left: FloatArray, along: FloatArray, seen_at: FloatArray, stiffness: FloatArray, out: FloatArray
) -> float:
    """Write (k I + s n n^T)^-1 left for each vertex, and return its product with `left`."""
    product = 0.0
    for v in range(len(left)):
        k, s, pull = stiffness[v], seen_at[v], 0.0
        for d in range(left.shape[1]):
            pull += along[v, d] * left[v, d]
        pull *= s / (k + s)
        for d in range(left.shape[1]):
            out[v, d] = (left[v, d] - pull * along[v, d]) / k
            product += out[v, d] * left[v, d]
    return product


@compiled
def solve_field(
    ring_start: IntArray,
    ring: IntArray,
    off_diagonal: FloatArray,
    diagonal: FloatArray,
    inverse_mass: FloatArray,
    stiffness: FloatArray,
    seen_at: FloatArray,
    pull_at: FloatArray,
    along: FloatArray,
    x: FloatArray,
    tolerance: float,
    iterations: int,
) -> int:
    """Solve (D + A M^-1 A) x = r by preconditioned conjugate gradients from `x`; return the iterations done.

    D has s_v n_v n_v^T for each vertex v, and r has p_v n_v.

    Args:
        ring_start: (V + 1,) where the neighbours of each vertex start in
        ring: (R,).
        off_diagonal: (R,) of A, symmetric, and
        diagonal: (V,) of A.
        inverse_mass: (V,) of M.
        stiffness: (V,) the diagonal of A M^-1 A.
        seen_at: (V,) s, how much the data weigh at each vertex.
        pull_at: (V,) p, where they want it, times s.
        along: (V, C) unit vectors n; C is 3, or 1 for a field without direction.
        x: (V, C) the start, to be overwritten.
        tolerance: it ends when the error has this share of the size of the first, from a field of zeros.
        iterations: at most.
    """
    ones = np.ones(len(x))
    left, image, between, z = np.empty_like(x), np.empty_like(x), np.empty_like(x), np.empty_like(x)
    for v in range(len(x)):
        for d in range(x.shape[1]):
            left[v, d] = pull_at[v] * along[v, d]
    size = _conditioned_into(left, along, seen_at, stiffness, z)
    _times_into(x, ring_start, ring, off_diagonal, diagonal, inverse_mass, between)
    _times_into(between, ring_start, ring, off_diagonal, diagonal, ones, image)
    for v in range(len(x)):
        inner = 0.0
        for d in range(x.shape[1]):
            inner += along[v, d] * x[v, d]
        for d in range(x.shape[1]):
            left[v, d] -= image[v, d] + seen_at[v] * inner * along[v, d]
    product = _conditioned_into(left, along, seen_at, stiffness, z)
    direction = z.copy()
    for iteration in range(iterations):
        if product <= tolerance * tolerance * size:
            return iteration
        _times_into(direction, ring_start, ring, off_diagonal, diagonal, inverse_mass, between)
        _times_into(between, ring_start, ring, off_diagonal, diagonal, ones, image)
        curvature = 0.0
        for v in range(len(x)):
            inner = 0.0
            for d in range(x.shape[1]):
                inner += along[v, d] * direction[v, d]
            for d in range(x.shape[1]):
                image[v, d] += seen_at[v] * inner * along[v, d]
                curvature += direction[v, d] * image[v, d]
        step = product / curvature
        for v in range(len(x)):
            for d in range(x.shape[1]):
                x[v, d] += step * direction[v, d]
                left[v, d] -= step * image[v, d]
        previous_product, product = product, _conditioned_into(left, along, seen_at, stiffness, z)
        keep = product / previous_product
        for v in range(len(x)):
            for d in range(x.shape[1]):
                direction[v, d] = z[v, d] + keep * direction[v, d]
    return iterations
