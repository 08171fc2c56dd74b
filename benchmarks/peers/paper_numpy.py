"""The paper's method in plain NumPy and SciPy, as a reader of the paper would write it: the yardstick for its speed.

Equation numbers are the paper's, misprints corrected as in `docs/paper-map.md`. The results are those of
`shapespace.fit.fit_scan.paper_method`; `tests/fit/test_paper_numpy.py` holds both to that.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree


def similarity(p: np.ndarray, p_prime: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return scale, rotation and translation of the least-squares similarity of `p` (V, 3) on `p_prime`."""
    p_bar, p_prime_bar = p.mean(axis=0), p_prime.mean(axis=0)  # P8-P9
    q, q_prime = p - p_bar, p_prime - p_prime_bar  # P10-P11
    U, D, Vt = np.linalg.svd(q.T @ q_prime)  # P12-P13
    Z = np.array([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])  # P16
    R = (Vt.T * Z) @ U.T  # P14-P15
    s = (D * Z).sum() / (q**2).sum()  # P18
    return s, R, p_prime_bar - s * R @ p_bar  # P17


def fit(
    mean: np.ndarray,
    basis: np.ndarray,
    scan_vertices: np.ndarray,
    scale: float,
    rotation: np.ndarray,
    translation: np.ndarray,
    tau: float = 1e-4,
    motion_mm: float = 1e-3,
    max_iterations: int = 500,
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, tuple[int, int]]:
    """Return scale, rotation (3, 3), translation (3,), b (K,) and the iterations of both phases.

    Args:
        mean: (V, 3), mm.
        basis: (3V, K), orthonormal columns.
        scan_vertices: (S, 3), mm.
        scale: of the start, from the model's frame to the scan's,
        rotation: (3, 3),
        translation: (3,), mm.
        tau: stop when the RMS closest distance changes by at most this share of itself,
        motion_mm: and no vertex moves more than this, mm of the model's frame.
        max_iterations: cap of each phase.
    """
    tree = cKDTree(scan_vertices)
    s, R, T, Q, b = scale, rotation, translation, mean, np.zeros(basis.shape[1])
    iterations = [0, 0]
    for phase in (0, 1):
        y = s * Q @ R.T + T
        distance, index = tree.query(y, workers=1)
        rms = np.sqrt((distance**2).mean()) / s
        for _ in range(max_iterations):
            c = scan_vertices[index]  # P7, step 1
            s, R, T = similarity(Q, c)  # step 2
            if phase == 1:
                Q_matched = (c - T) @ R / s
                b = basis.T @ (Q_matched - mean).ravel()  # P19, step 3
                Q = mean + (basis @ b).reshape(-1, 3)  # P6
            moved, y = y, s * Q @ R.T + T
            distance, index = tree.query(y, workers=1)
            before, rms = rms, np.sqrt((distance**2).mean()) / s
            iterations[phase] += 1
            motion = np.linalg.norm(y - moved, axis=1).max() / s
            if abs(rms - before) <= tau * before and motion <= motion_mm:  # step 4
                break
    return s, R, T, b, (iterations[0], iterations[1])
