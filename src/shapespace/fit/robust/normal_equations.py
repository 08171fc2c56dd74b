"""The normal equations of one Gauss-Newton step on pose and coefficients, with data and prior as separate terms.

Equation numbers and symbols are those of docs/robust.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt

import numpy as np
from scipy.linalg import LinAlgError
from scipy.linalg.lapack import dpotrf, dpotrs

from shapespace.fit.robust.kernels import rows_into
from shapespace.fit.robust.matching import Gathered
from shapespace.fit.robust.prepared_model import ModelSurface
from shapespace.geometry.similarity import POSE
from shapespace.types import FloatArray, Similarity

_DAMPING = 1e-7
"""Added to the unit diagonal of R15a; far below the precision of the float32 rows."""
SCALE = 6
"""Index of the log scale among the pose parameters: rotation 0-2, translation 3-5."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pose and coefficients of an iterate.

    Args:
        T_scan_model: from the model's frame to the scan's mm frame (R2).
        b: (K,) coefficients of all modes, mm.
    """

    T_scan_model: Similarity
    b: FloatArray

    def moved_by(self, delta: FloatArray) -> Estimate:
        """Return the estimate after the step `delta` (7 + k,): omega, tau, ds, then db (R3, R16)."""
        b = self.b.copy()
        b[: len(delta) - POSE] += delta[POSE:]
        return Estimate(self.T_scan_model @ small_similarity(delta[:POSE]), b)


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal prior of the coefficients and of the log scale (R13, R14).

    Args:
        stddev: (K,) of each coefficient, mm.
        weight: alpha, weight of the prior relative to one match.
        start_scale: s_0, scale of the start.
        scale_stddev: of log(s / s_0); zero where the scale is held.
    """

    stddev: FloatArray
    weight: float
    start_scale: float
    scale_stddev: float

    @property
    def holds_scale(self) -> bool:
        """Whether the scale is that of the start."""
        return self.scale_stddev == 0.0


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """(H + D + H_landmarks) delta = -gradient, for rotation, translation, log scale and k coefficients (R15).

    All terms are multiplied by sigma^2, the variance of the residuals.

    Args:
        H: (7 + k, 7 + k) Hessian of the matches (R12).
        D: (7 + k,) diagonal of the Hessian of the prior (R13, R14).
        gradient: (7 + k,) g + e, of matches, prior and landmarks.
        holds_scale: whether the scale is fixed, so that its row and column are left out.
        H_landmarks: (7 + k, 7 + k) Hessian of the landmarks with their gain (R16c); None without landmarks.
    """

    H: FloatArray
    D: FloatArray
    gradient: FloatArray
    holds_scale: bool
    H_landmarks: FloatArray | None = None

    def step(self) -> FloatArray:
        """Return delta (7 + k,), solved with a unit diagonal and light damping (R15, R15a).

        Raises:
            LinAlgError: the equations have no solution.
        """
        free = np.delete(np.arange(len(self.gradient)), SCALE) if self.holds_scale else slice(None)
        hessian = np.array(self.H[free][:, free], order="F")
        if self.H_landmarks is not None:
            hessian += self.H_landmarks[free][:, free]
        diagonal = np.einsum("ii->i", hessian)  # a view
        diagonal += self.D[free]
        unit = 1.0 / np.sqrt(np.maximum(diagonal, 1e-30))  # R15a
        hessian *= unit[:, None] * unit
        diagonal += _DAMPING
        # LAPACK itself: the checks of `cho_factor` take as long as its work.
        factor, not_definite = dpotrf(hessian, lower=1, overwrite_a=1, clean=0)
        if not_definite:
            raise LinAlgError("The normal equations are not positive definite.")
        delta = np.zeros(len(self.gradient))
        delta[free] = -unit * dpotrs(factor, unit * self.gradient[free], lower=1)[0]  # R15
        if not np.isfinite(delta).all():
            raise LinAlgError("The normal equations have no finite solution.")
        return delta


def normal_equations(
    surface: ModelSurface, gathered: Gathered, prior: Prior, sigma_mm: float, estimate: Estimate, modes: int
) -> NormalEquations:
    """Return the equations of one Gauss-Newton step on the pose and the first `modes` coefficients.

    Args:
        surface: of the model, with the coefficients of `at`.
        gathered: weights and weighted residuals of the matches at each of its vertices.
        prior: of coefficients and scale.
        sigma_mm: spread of the residuals.
        estimate: pose and coefficients.
        modes: k, the number of free modes.
    """
    rows = np.empty((len(gathered.W), POSE + modes), dtype=np.float32)
    gradient = np.zeros(POSE + modes)
    count = rows_into(
        surface.vertices, surface.normals, surface.modes, modes, gathered.W, gathered.h, rows, gradient
    )  # R11, R12
    rho = prior.weight * sigma_mm**2
    D = np.zeros(POSE + modes)
    D[POSE:] = rho / prior.stddev[:modes] ** 2  # R13
    gradient[POSE:] += D[POSE:] * estimate.b[:modes]
    if not prior.holds_scale:
        D[SCALE] = rho / prior.scale_stddev**2  # R14
        gradient[SCALE] += D[SCALE] * np.log(estimate.T_scan_model.scale / prior.start_scale)
    H = np.asarray(rows[:count].T @ rows[:count], dtype=np.float64)  # R12
    return NormalEquations(H, D, gradient, prior.holds_scale)


def small_similarity(delta: FloatArray) -> Similarity:
    """Return S of R3 from `delta` (7,): omega (radians), tau (mm) and ds, about the origin."""
    x, y, z = delta[:3].tolist()
    angle = sqrt(x * x + y * y + z * z)
    # The unit quaternion of the rotation, by a series where the quotient loses its digits.
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
