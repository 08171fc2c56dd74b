"""A shape model of one shape: the modes of a smooth Gaussian process on it, before other shapes are known (C2)."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.correspondence.harmonics import Harmonics
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh

MODES = 60  # slowest harmonics, three coordinates each
RANGE_SHARE = 0.4  # share of the size; range of the smooth deformations (C2)
AMPLITUDE_SHARE = 0.1
"""Of the Gaussian process, as shares of the shape's size: how far it reaches along the surface, how much it moves."""


def generic_model(mesh: Mesh, harmonics: Harmonics, shapes: FloatArray | None = None) -> ShapeModel:
    """Return `mesh` as the mean of a model whose modes are those of a smooth Gaussian process on it (C2).

    The process diffuses white noise over the surface, alike in all directions (Luthi, Gerig, Jud and Vetter 2018); its
    part that is a similarity transform is removed.

    Args:
        mesh: the mean, mm.
        harmonics: of it.
        shapes: (N, V, 3) aligned shapes; their variation joins the modes, and the process keeps a quarter of its
            variance.
    """
    size = rms_size(mesh.vertices)
    slow, vertices = harmonics.slowest(MODES), len(mesh.vertices)
    columns = np.kron(slow.functions * slow.attenuation(RANGE_SHARE * size), np.eye(3))  # C2
    columns *= AMPLITUDE_SHARE * size * np.sqrt(vertices / float((columns**2).sum()))
    if shapes is not None:
        of_shapes = (shapes - shapes.mean(axis=0)).reshape(len(shapes), -1).T / np.sqrt(max(len(shapes) - 1, 1))
        columns = np.column_stack([of_shapes, 0.5 * columns])
    pose = np.linalg.qr(small_poses(mesh.vertices - mesh.vertices.mean(axis=0)))[0]
    columns -= pose @ (pose.T @ columns)
    with threadpool_limits(limits=1, user_api="blas"):  # threads take up to 50 times as long on a busy machine
        basis, stddev, _ = np.linalg.svd(columns, full_matrices=False)
    significant = stddev > 1e-3 * stddev[0]
    basis, stddev = basis[:, significant], stddev[significant]
    return ShapeModel(mesh.vertices.ravel(), basis, stddev, float((stddev**2).sum()), 1, faces=mesh.faces)
