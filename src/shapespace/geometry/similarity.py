"""Least-squares similarity between two matched point sets: equations 8 to 18 of the paper, misprints corrected.

Sources: Arun, Huang and Blostein, PAMI 9(5), 1987; Umeyama, PAMI 13(4), 1991. `docs/paper-map.md` lists the
misprints and their corrections.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from shapespace.errors import InputError
from shapespace.types import FloatArray, Similarity

_RANK_TOLERANCE = 1e-9  # ratio of singular values; points nearer to a line than rounding determine no rotation
_PLANAR = 1e-13  # ratio of products; points nearer to the plane z = 0 than float64 rounding are in it
_NO_ROTATION = "The matched points are on a line or coincide, so they determine no rotation; use more points."

POSE = 7
"""Number of pose parameters, which precede the coefficients: rotation, translation, scale."""
SCALE = 6
"""Index of the log scale among the pose parameters: rotation 0-2, translation 3-5."""


def fit_similarity(
    source: FloatArray, target: FloatArray, weights: FloatArray | None = None, *, with_scale: bool = True
) -> Similarity:
    """Return the `T_target_source` that minimises sum_i w_i |target_i - (s R source_i + T)|^2.

    The rotation is proper even if a mirror image would fit better, and the points may be on a plane.

    Args:
        source: (N, 3) points p, mm.
        target: (N, 3) matched points p', mm.
        weights: (N,) non-negative weights; None for ones.
        with_scale: whether to fit the scale; False for a rigid motion (s = 1).

    Raises:
        InputError: shapes differ, values are not finite, weights are negative, or the points with positive weight
            are on a line, so that no rotation is determined.
    """
    if source.ndim != 2 or source.shape[1] != 3 or source.shape != target.shape:
        raise InputError(
            f"A similarity needs two point sets of the same shape (N, 3), not {source.shape} and {target.shape}."
        )
    if weights is None:
        w = np.full(len(source), 1.0 / max(len(source), 1))
    elif weights.shape != (len(source),) or (weights < 0).any() or not np.isfinite(weights).all():
        raise InputError("The weights of a similarity must be one finite, non-negative number per point.")
    else:
        w = weights / max(weights.sum(), np.finfo(float).tiny)
    if not w.any():
        raise InputError("A similarity needs at least three points with a positive weight.")

    mean_source, mean_target = w @ source, w @ target  # P8, P9
    q, q_prime = source - mean_source, target - mean_target  # P10, P11
    weighted = q * w[:, None]
    H = weighted.T @ q_prime  # P12
    spread = np.vdot(weighted, q)
    if not (np.isfinite(spread) and np.isfinite(H).all()):
        raise InputError("The points of a similarity must be finite.")

    if spread <= 0:
        raise InputError(_NO_ROTATION)
    R = fit_rotations(H[None], reject_lines=True)[0]
    s = float((R * H.T).sum() / spread) if with_scale else 1.0  # P18, as corrected
    if s <= 0:
        raise InputError("The matched points are so far from similar that no positive scale fits; check the matches.")
    T = mean_target - s * R @ mean_source  # P17, as corrected
    return Similarity(s, R, T)


def fit_rotations(products: FloatArray, *, reject_lines: bool = False) -> FloatArray:
    """Return the rotations R (n, D, D) that maximise trace(R H) for products H = q^T q' (n, D, D) of centred points.

    Points in the plane z = 0, such as planar landmarks padded with zeros, are rotated within the plane, because a
    rotation about an axis of the plane would reflect them.

    Args:
        products: (n, D, D) products of centred points (row vectors) and their targets, with D 2 or 3.
        reject_lines: whether points on a line raise an error.

    Raises:
        InputError: the points are on a line or coincide, and `reject_lines` is true.
    """
    D = products.shape[1]
    largest = np.abs(products).max(axis=(1, 2), initial=0.0)
    across, down = np.abs(products[:, 2:]), np.abs(products[:, :, 2:])
    off_plane = np.maximum(across.max(axis=(1, 2), initial=0.0), down.max(axis=(1, 2), initial=0.0))
    if D == 3 and bool((off_plane <= _PLANAR * largest).all()):
        out = np.zeros_like(products)
        out[:, :2, :2], out[:, 2, 2] = fit_rotations(products[:, :2, :2], reject_lines=reject_lines), 1.0
        return out
    U, values, Vt = np.linalg.svd(products)  # P13
    if reject_lines and (values[:, 1] <= _RANK_TOLERANCE * np.maximum(values[:, 0], np.finfo(float).tiny)).any():
        raise InputError(_NO_ROTATION)
    V, Ut = Vt.transpose(0, 2, 1), U.transpose(0, 2, 1)
    Z = np.ones((len(products), D))
    Z[:, -1] = np.sign(np.linalg.det(V @ Ut))  # P16: the reflection guard
    return np.asarray((V * Z[:, None]) @ Ut, dtype=np.float64)  # P14, P15, as corrected


def small_poses(x: FloatArray) -> FloatArray:
    """Return derivatives (3V, 7) of x (V, 3) by a rotation about each axis, a translation along each, and a scaling."""
    pose = np.zeros((len(x), 3, POSE))
    pose[:, 0, 1], pose[:, 0, 2], pose[:, 1, 2] = x[:, 2], -x[:, 1], x[:, 0]
    pose[:, :, :3] -= pose[:, :, :3].transpose(0, 2, 1)
    pose[:, :, 3:6] = np.eye(3)
    pose[:, :, 6] = x
    return pose.reshape(-1, POSE)


def small_similarity(delta: FloatArray) -> Similarity:
    """Return S of R3 from `delta` (7,): omega (radians), tau (mm) and ds, about the origin."""
    x, y, z = delta[:3].tolist()
    angle = sqrt(x * x + y * y + z * z)
    # The unit quaternion of the rotation, by a series where the quotient loses precision.
    squared = angle * angle
    half = 0.5 - squared / 48 + squared * squared / 3840 if angle <= 1e-3 else sin(angle / 2) / angle
    x, y, z, w = x * half, y * half, z * half, cos(angle / 2)
    rotation = np.array(
        [
            [x * x - y * y - z * z + w * w, 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), -x * x + y * y - z * z + w * w, 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), -x * x - y * y + z * z + w * w],
        ]
    )
    return Similarity(float(np.exp(delta[SCALE])), rotation, delta[3:6])
