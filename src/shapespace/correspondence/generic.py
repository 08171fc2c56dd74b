"""A shape model of one shape: modes that any object of its size might have, since nothing else is known yet."""

from __future__ import annotations

import numpy as np

from shapespace.correspondence.harmonics import Harmonics
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh

MODES = 60
RANGE_SHARE = 0.4
AMPLITUDE_SHARE = 0.1
"""Of the Gaussian process, as shares of the shape's size: how far it reaches along the surface, how much it moves."""


def generic_model(mesh: Mesh, harmonics: Harmonics, known: FloatArray | None = None) -> ShapeModel:
    """Return `mesh` as the mean of a model whose modes are those of a smooth Gaussian process on it.

    The process diffuses white noise over the surface, alike in all directions (Luthi, Gerig, Jud and Vetter 2018); what
    of it a similarity does is taken out.

    Args:
        mesh: the mean, mm.
        harmonics: of it.
        known: (N, V, 3) aligned shapes; what they vary by joins the modes, and the process keeps a quarter of its
            variance.
    """
    size = rms_size(mesh.vertices)
    slow, vertices = harmonics.slowest(MODES), len(mesh.vertices)
    columns = np.kron(slow.functions * slow.kept(RANGE_SHARE * size), np.eye(3))
    columns *= AMPLITUDE_SHARE * size * np.sqrt(vertices / float((columns**2).sum()))
    if known is not None:
        seen = (known - known.mean(axis=0)).reshape(len(known), -1).T / np.sqrt(max(len(known) - 1, 1))
        columns = np.column_stack([seen, 0.5 * columns])
    pose = np.linalg.qr(small_poses(mesh.vertices - mesh.vertices.mean(axis=0)))[0]
    columns -= pose @ (pose.T @ columns)
    basis, length, _ = np.linalg.svd(columns, full_matrices=False)
    kept = length > 1e-3 * length[0]
    basis, length = basis[:, kept], length[kept]
    return ShapeModel(mesh.vertices.ravel(), basis, length, float((length**2).sum()), 1, faces=mesh.faces)
