"""The error that a model leaves where every correspondence is known: what no fit can do better than."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Similarity

_STEPS, _REACHED_MM = 20, 1e-4  # limit of Gauss-Newton steps, and the vertex motion in mm that ends them


def floor_mm(model: ShapeModel, truth: FloatArray) -> float:
    """Return the mean error, mm, of the shape of `model` and the pose that come nearest to `truth` (V, 3).

    Pose and coefficients are solved for together: in turn they crawl where modes hold pose or size.
    """
    b, T = model.project(truth, align=False), Similarity.identity()
    modes = model.vertex_basis.reshape(-1, 3, model.n_modes)
    for _ in range(_STEPS):
        shape = T.apply(model.reconstruct(b))
        arm = shape - T.translation
        turn = np.cross(np.eye(3), arm[:, None]).transpose(0, 2, 1)
        move = np.broadcast_to(np.eye(3), turn.shape)
        reach = T.scale * (T.rotation @ modes)
        J = np.concatenate([turn, move, arm[:, :, None], reach], axis=2).reshape(-1, 7 + model.n_modes)
        # A touch of damping, since modes may hold all of a pose.
        H = J.T @ J
        H[np.diag_indices_from(H)] *= 1.0 + 1e-9
        step = np.linalg.solve(H, J.T @ (truth - shape).ravel())
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ T.rotation
        T = Similarity(T.scale * np.exp(step[6]), turned, T.translation + step[3:6])
        b = b + step[7:]
        if np.abs(J @ step).max() < _REACHED_MM:
            break
    return float(np.linalg.norm(T.apply(model.reconstruct(b)) - truth, axis=1).mean())
