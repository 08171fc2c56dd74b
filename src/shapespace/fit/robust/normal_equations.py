"""The normal equations of one step: pose and coefficients together, data and prior apart.

Equation numbers are those of docs/robust.md. Everything here is a function of its arguments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from shapespace.fit.robust.kernels import rows_into
from shapespace.fit.robust.matching import Gathered
from shapespace.fit.robust.prepared_model import ModelSurface
from shapespace.geometry.similarity import POSE
from shapespace.types import FloatArray, Similarity

_DAMPING = 1e-7
SCALE = 6
"""Where the log scale stands among the pose parameters: rotation 0-2, translation 3-5."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where a fit is.

    Args:
        T_scan_model: from the model's frame to the scan's mm frame.
        b: (K,) coefficients of all modes that there are, mm.
    """

    T_scan_model: Similarity
    b: FloatArray

    def moved_by(self, delta: FloatArray) -> Estimate:
        """Return where `delta` (7 + k,) leads (eq 3): turn, shift, scale in the model's frame, then k coefficients."""
        b = self.b.copy()
        b[: len(delta) - POSE] += delta[POSE:]
        return Estimate(self.T_scan_model @ small_similarity(delta[:POSE]), b)


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of pose and shape before the scan is looked at (eqs 13 and 14).

    Args:
        stddev: (K,) of each coefficient, mm.
        weight: of the prior beside one match.
        start_scale: scale of the start,
        scale_stddev: and how far the log of the scale is from its log; zero where the scale is held.
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
    """(data + prior) delta = -gradient, for turn, shift, log scale and k coefficients.

    Args:
        data: (7 + k, 7 + k) Hessian of the matches, not divided by the variance of the residuals.
        prior: (7 + k,) diagonal of the Hessian of the prior, times that variance.
        gradient: (7 + k,) of both.
        holds_scale: whether the scale has no say.
        marks: (7 + k, 7 + k) Hessian of landmarks as a step weighs them, times that variance; None without any.
    """

    data: FloatArray
    prior: FloatArray
    gradient: FloatArray
    holds_scale: bool
    marks: FloatArray | None = None

    def step(self) -> FloatArray:
        """Return delta (7 + k,), solved with a unit diagonal and hardly damped (eq 15).

        Raises:
            LinAlgError: the equations have no solution.
        """
        free = np.delete(np.arange(len(self.gradient)), [SCALE] if self.holds_scale else [])
        hessian = self.data[np.ix_(free, free)] if self.holds_scale else self.data.copy()
        if self.marks is not None:
            hessian += self.marks[np.ix_(free, free)]
        hessian[np.diag_indices_from(hessian)] += self.prior[free]
        unit = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-30))
        hessian *= np.outer(unit, unit)
        hessian[np.diag_indices_from(hessian)] += _DAMPING
        delta = np.zeros(len(self.gradient))
        try:
            factor = cho_factor(hessian, lower=True, overwrite_a=True)
            delta[free] = -unit * np.asarray(cho_solve(factor, unit * self.gradient[free]))
        except ValueError as error:
            raise LinAlgError(str(error)) from error
        return delta


def normal_equations(
    surface: ModelSurface, gathered: Gathered, prior: Prior, sigma_mm: float, at: Estimate, modes: int
) -> NormalEquations:
    """Return the equations of one Gauss-Newton step on the pose and the first `modes` coefficients.

    Args:
        surface: the model's surface at `at`.
        gathered: what the matches want of each of its vertices.
        prior: of pose and shape.
        sigma_mm: spread of the residuals.
        at: where the fit is.
        modes: how many are free.
    """
    rows = np.empty((len(gathered.weight), POSE + modes), dtype=np.float32)
    gradient = np.zeros(POSE + modes)
    count = rows_into(
        surface.vertices, surface.normals, surface.modes, modes, gathered.weight, gathered.pull, rows, gradient
    )  # eqs 11, 12
    rho = prior.weight * sigma_mm**2
    precision = np.zeros(POSE + modes)
    precision[POSE:] = rho / prior.stddev[:modes] ** 2  # eq 13
    gradient[POSE:] += precision[POSE:] * at.b[:modes]
    if not prior.holds_scale:
        precision[SCALE] = rho / prior.scale_stddev**2  # eq 14
        gradient[SCALE] += precision[SCALE] * np.log(at.T_scan_model.scale / prior.start_scale)
    data = np.asarray(rows[:count].T @ rows[:count], dtype=np.float64)
    return NormalEquations(data, precision, gradient, prior.holds_scale)


def small_similarity(delta: FloatArray) -> Similarity:
    """Return the similarity of a turn (radians), a shift (mm) and a log scale, `delta` (7,), about the origin."""
    turn = np.asarray(Rotation.from_rotvec(delta[:3]).as_matrix())
    return Similarity(float(np.exp(delta[SCALE])), turn, delta[3:6])
