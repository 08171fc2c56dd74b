"""Calibration of a completed surface on the training shapes: skill, and intervals of functions of the shape.

Equation numbers are those of docs/completion.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from shapespace.errors import FitError
from shapespace.fit.completion.shape_posterior import ShapePosterior, root_of, shape_posterior
from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.similarity import POSE, fit_similarity, small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, Similarity

_SAMPLED = 1_000  # missing vertices over which the expected error is averaged
_SIGNIFICANT = 0.01  # probability to call a completion better than the mean shape although it is not


@dataclass(frozen=True, eq=False)
class SurfaceCalibration:
    """Completions of n training shapes, each by the model of the other shapes, mm of the model's frame.

    Args:
        shapes: (n, V, 3) the training shapes.
        errors: (n, V, 3) errors of their completions.
        mean_errors: (n, V, 3) errors of the mean shape in the best pose on the observed vertices.
        shifts: (n, V, 3) differences between the completion of the scan by the model without the shape and its
            completion by the complete model.
        missing: (V,) True where the scan shows nothing.
        of_training: False if samples of the model represent its training shapes, which it does not contain.
    """

    shapes: Float32Array
    errors: Float32Array
    mean_errors: Float32Array
    shifts: Float32Array
    missing: BoolArray
    of_training: bool

    def __len__(self) -> int:
        """Return n, the number of shapes."""
        return len(self.shapes)

    @property
    def skill(self) -> FloatArray:
        """(V,) reduction of the squared error by the completion, as a share of that of the mean shape; at most 1,
        negative if the completion is worse.
        """
        own, mean = ((errors.astype(np.float64) ** 2).sum(axis=(0, 2)) for errors in (self.errors, self.mean_errors))
        return 1.0 - own / np.maximum(mean, 1e-30)

    @property
    def mean_weight(self) -> FloatArray:
        """(V,) weight of the mean shape, 0 to 1, that minimises the squared error of the held-out shapes (E10)."""
        off = self.errors.astype(np.float64) - self.mean_errors
        along = np.einsum("nvd,nvd->v", self.errors, off)
        return np.clip(along / np.maximum(np.einsum("nvd,nvd->v", off, off), 1e-30), 0.0, 1.0)

    @property
    def log_ratios(self) -> FloatArray:
        """(n,) logarithm of the RMS error of the mean shape over that of the completion, missing vertices."""
        own, mean = (
            (errors[:, self.missing].astype(np.float64) ** 2).sum(axis=(1, 2))
            for errors in (self.errors, self.mean_errors)
        )
        return 0.5 * np.log(np.maximum(mean, 1e-30) / np.maximum(own, 1e-30))

    @property
    def n_nearer(self) -> int:
        """Number of shapes whose missing vertices the completion predicts better than the mean shape."""
        return int((self.log_ratios > 0).sum())

    @property
    def is_skilled(self) -> bool:
        """Whether missing vertices are predicted better than by the mean shape (t test over the shapes)."""
        ratios = self.log_ratios
        n = len(ratios)
        limit = float(stdtrit(n - 1, 1.0 - _SIGNIFICANT)) * float(ratios.std(ddof=1)) / np.sqrt(n)
        return float(ratios.mean()) > limit

    def interval(
        self, function: Callable[[FloatArray], float], vertices: FloatArray, level: float
    ) -> tuple[float, float, float, float]:
        """Return mean, standard deviation and the ends of the interval of a function of the shape (E11, E12).

        It is the cross-conformal interval of Barber et al. (Annals of Statistics 49(1), 2021, CV+), and that of the t
        distribution if there are too few shapes for its quantiles.

        Args:
            function: function of the vertices (V, 3) in the frame of the model, mm.
            vertices: (V, 3) vertices of the completed surface in that frame.
            level: probability of the interval.
        """
        n, value = len(self), function(vertices)
        off = np.array([function(x + e) - function(x) for x, e in zip(self.shapes, self.errors, strict=True)])
        others = np.array([function(vertices + shift) for shift in self.shifts])
        spread = float(np.sqrt((off**2).mean() * (1.0 + 1.0 / n)))
        k = int(np.floor((1.0 - level) * (n + 1)))
        if k < 1:
            reach = float(stdtrit(n - 1, 0.5 + level / 2)) * spread  # E12
            return value - float(off.mean()), spread, value - reach, value + reach
        low, high = np.sort(others - np.abs(off)), np.sort(others + np.abs(off))
        return value - float(off.mean()), spread, float(low[k - 1]), float(high[n - k])  # E11


def missing_error_mm(
    model: ShapeModel, target: ScanTarget, T_scan_model: Similarity, b: FloatArray, observed: BoolArray,
    *, with_scale: bool,
) -> float | None:  # fmt: skip
    """Return the expected distance of missing vertices of a fit from their true positions, mm of the scan.

    It is the mean over the training shapes, each held out in turn; None without training shapes, or if the scan does
    not determine the pose.

    Args:
        model: the shape model.
        target: the scan in its mm frame.
        T_scan_model: pose of the fit in that frame.
        b: (K,) coefficients of the fit, mm.
        observed: (V,) True where the scan shows a vertex.
        with_scale: whether the scale was free.
    """
    if model.training is None:
        return None
    model = model.with_all_modes
    try:
        posterior = shape_posterior(
            model, target, T_scan_model, np.pad(b, (0, model.n_modes - len(b))), RobustSettings(vertex_share=0.0),
            with_scale=with_scale, settled=True,
        )  # fmt: skip
    except FitError:
        return None
    left = posterior.left_out
    assert left is not None
    missing = np.flatnonzero(~observed)
    some = np.random.default_rng(0).choice(missing, min(len(missing), _SAMPLED), replace=False)
    rows = posterior.rows()[some]
    errors = (rows.reshape(-1, rows.shape[2]) @ left.errors.T.astype(np.float32)).reshape(len(some), 3, -1)
    noise = np.maximum(np.einsum("vip,pq,viq->v", rows, left.noise.astype(np.float32), rows, optimize=True), 0.0)
    # The errors are those of the posterior mean, from which the fit differs.
    step = ((rows @ posterior.step.astype(np.float32)) ** 2).sum(axis=1)
    return float(np.sqrt((errors**2).sum(axis=1) + (noise + step)[:, None]).mean()) * T_scan_model.scale


def calibrate(posterior: ShapePosterior, model: ShapeModel, missing: BoolArray) -> SurfaceCalibration | None:
    """Return the calibration of the surface on the training shapes; None if the model neither contains nor counts them.

    Args:
        posterior: posterior of the scan, with the errors of the held-out shapes.
        model: the model with all modes of its training shapes.
        missing: (V,) True where the scan shows nothing.
    """
    left = posterior.left_out
    if left is None:
        return None
    n, V = len(left.errors), model.n_vertices
    rows = posterior.rows()
    flat = rows.reshape(3 * V, -1)
    rng = np.random.default_rng(0)
    noise = root_of(left.noise) @ rng.standard_normal((len(left.noise), n))

    def moved(parameters: FloatArray, b: FloatArray) -> Float32Array:
        if model.is_linear:
            fields = (flat @ parameters.T.astype(np.float32)).T.reshape(n, V, 3)
        else:
            fields = posterior.displacements(parameters, np.pad(b, ((0, 0), (0, len(posterior.b) - b.shape[1]))))
        # The completed surface follows the scan along its normals.
        normals = posterior.surface.normals[~missing].astype(np.float32)
        along = np.einsum("nvd,vd->nv", fields[:, ~missing], normals)
        fields[:, ~missing] -= along[:, :, None] * normals
        return fields

    mean = model.mean_vertices
    if model.is_linear:
        deviation = (left.known[:, 1:].astype(np.float32) @ model.vertex_basis.T.astype(np.float32)).reshape(n, V, 3)
    else:
        deviation = np.stack([model.reconstruct(c) for c in left.known[:, 1:]]).astype(np.float32) - np.float32(mean)
    pose = small_poses(mean).reshape(V, 3, POSE)
    pose = pose if posterior.prior_variance[POSE - 1] > 0 else pose[:, :, : POSE - 1]
    from_others = deviation * np.float32(n / (n - 1))
    seen = pose[~missing].reshape(-1, pose.shape[2])
    q = np.linalg.lstsq(seen, from_others[:, ~missing].reshape(n, -1).T, rcond=None)[0]
    mean_errors = (pose.reshape(3 * V, -1) @ q).T.reshape(n, V, 3) - from_others
    if not model.is_linear:  # large rotations of the mean
        for row, off in zip(mean_errors, from_others.astype(np.float64), strict=True):
            T = fit_similarity(mean[~missing], (mean + off)[~missing], with_scale=pose.shape[2] == POSE)
            row[:] = T.apply(mean) - mean - off
    shapes = (mean + deviation).astype(np.float32)
    mean_errors = mean_errors.astype(np.float32)
    return SurfaceCalibration(
        shapes,
        moved(left.errors + noise.T, left.known[:, 1:]),
        mean_errors,
        moved(left.shifts, np.tile(posterior.b, (n, 1))),
        missing,
        model.training is not None,
    )
