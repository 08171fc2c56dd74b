"""Completion by symmetry: the observed side of an object as a prediction of its other side.

Equation numbers are those of docs/completion.md.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import SYMMETRIC_SHARE, find_mirror
from shapespace.geometry.normals import rms_size
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray

_PATCHES, _PRIOR_PATCHES = 300.0, 10.0
"""Independent patches of a whole surface, as in R20a, and those that the asymmetry of the modes is worth."""
_SEAM = 0.1  # share of the size over which the mirror image passes into what is observed


def add_mirror_image(
    model: ShapeModel, surface: FloatArray, observed: BoolArray, variance: FloatArray | None
) -> tuple[FloatArray, float]:
    """Return the surface with missing vertices moved towards the mirror images of observed ones (E8).

    Args:
        model: the shape space; its mean is symmetric.
        surface: (V, 3) completed by the model, mm of the model's frame.
        observed: (V,).
        variance: (V,) of its vertices, mm^2, against which the mirror image is weighted by the asymmetry of observed
            pairs; None uses the mirror image alone.

    Returns:
        (V, 3) mm, and the mean weight of the mirror image over the missing vertices.

    Raises:
        InputError: the mean is not symmetric.
    """
    mean = model.mean_vertices
    corners, weights, turn = _mirror(model)
    image = mean + np.einsum("vc,vcd->vd", weights, (surface - mean)[corners]) @ turn
    is_shown = observed[corners].all(axis=1)
    weight = np.where(is_shown & ~observed, 1.0, 0.0)
    if variance is not None:
        both = is_shown & observed
        patches = _PATCHES * float(both.mean())
        own = float(((surface - image)[both] ** 2).sum() / max(both.sum(), 1))
        asymmetry = (patches * own + _PRIOR_PATCHES * _asymmetry(model)) / (patches + _PRIOR_PATCHES)  # E7
        weight *= variance / (variance + asymmetry + variance[corners[:, 0]])  # E8
    distance = cKDTree(mean[observed]).query(mean)[0] / (_SEAM * rms_size(mean))
    moved = (weight * (1.0 - np.exp(-(distance**2))))[:, None] * (image - surface)
    return surface + moved, float(weight[~observed].mean()) if not observed.all() else 0.0


@cached_with_owner()
def _mirror(model: ShapeModel) -> tuple[IntArray, FloatArray, FloatArray]:
    mirror = find_mirror(model.mesh())
    if mirror.off_share > SYMMETRIC_SHARE:
        raise InputError(
            f"The mean shape differs from its mirror image by {100 * mirror.off_share:.1f} % of its size, so its sides "
            "do not predict each other; leave --mirror out."
        )
    return mirror.corners, mirror.weights, mirror.turn


@cached_with_owner()
def _asymmetry(model: ShapeModel) -> float:
    """Return the variance of the difference between both sides in the population, mm^2 a vertex, by the modes."""
    corners, weights, turn = _mirror(model)
    modes = model.vertex_basis.reshape(model.n_vertices, 3, -1) * model.stddev
    image = np.einsum("vc,vcdk,de->vek", weights, modes[corners], turn, optimize=True)
    return float(((modes - image) ** 2).sum()) / model.n_vertices
