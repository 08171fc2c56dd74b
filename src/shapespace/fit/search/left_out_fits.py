"""Fits of training shapes, each by the model of the other shapes: the reference for fits of correct new scans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from shapespace.errors import FitError, InputError
from shapespace.fit.iteration_state import MATCHED, RobustFitted, last_of
from shapespace.fit.robust.robust_icp import robust_icp
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from shapespace.geometry.normals import part_of
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

_MOST = 10  # training shapes, a fixed random subset of larger sets, to bound the time: 2 to 10 s
_ROUNDING = 1e-9  # share of the largest variance; modes with less are rounding errors
_FEWEST = 3  # training shapes; two others have one mode


def fit_left_out(
    model: ShapeModel, fitted: RobustFitted, settings: RobustSettings, *, with_scale: bool
) -> Iterator[tuple[ShapeModel, ScanTarget, RobustFitted]]:
    """Yield, for each training shape, the model of the others, the part of the shape that the scan shows, and its fit.

    Args:
        model: shape model with its training shapes; nothing is yielded without them.
        fitted: result of the fit to the scan.
        settings: settings of the robust method.
        with_scale: whether the pose has a free scale.
    """
    training = model.training
    if training is None or len(training) < _FEWEST or model.faces is None:
        return
    complete, shown = model.with_all_modes, np.isin(fitted.regions(), MATCHED)
    for i in np.sort(np.random.default_rng(0).permutation(len(training))[:_MOST]):
        others = _model_of_others(complete, training.coefficients, int(i), model.n_modes)
        shape = part_of(Mesh(complete.reconstruct(training.coefficients[i]), model.faces), shown)
        if shape.faces is None or not len(shape.faces):
            return
        target = ScanTarget(shape)
        start = Start(Similarity.identity(), "given", float("nan"))
        try:
            yield others, target, last_of(robust_icp(others, target, start, settings, with_scale=with_scale))
        except (FitError, InputError):
            continue


def _model_of_others(complete: ShapeModel, coefficients: FloatArray, i: int, modes: int) -> ShapeModel:
    """Return the model of all training shapes but one.

    Args:
        complete: model with all modes of its training shapes.
        coefficients: (n, K) coefficients of the training shapes, mm.
        i: index of the shape that is not used.
        modes: largest number of modes.
    """
    others = np.delete(coefficients, i, axis=0)
    centre = others.mean(axis=0)
    _, singular, axes = np.linalg.svd(others - centre, full_matrices=False)
    variance = singular**2 / (len(others) - 1)
    kept = min(modes, int((variance > _ROUNDING * variance[0]).sum()))
    return replace(
        complete, mean=complete.vector(centre), basis=complete.basis @ axes[:kept].T,
        stddev=np.sqrt(variance[:kept]), total_variance=float(variance.sum()), n_training=len(others),
        held_out=False, residuals=None, training=None,
    )  # fmt: skip
