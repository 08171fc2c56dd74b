"""One Gauss-Newton step of the robust fit in plain NumPy: the oracle of the compiled one, written to be read.

The Jacobian of the distance r = n . (x - q) of a model point x = sum_c beta_c x_c from its match q, along the model's
normal n, by a small rotation, translation and log scale of the model and by the coefficients b, is
[ x_c x n_c | n_c | n_c . x_c | n_c^T P_c ], summed over the corners c of the triangle with their weights beta_c.
"""

import numpy as np

from shapespace.fit.robust.robust_icp import Iterate, Problem, WeightedMatches
from shapespace.geometry.similarity import POSE
from shapespace.types import FloatArray


def vertex_rows(vertices: FloatArray, normals: FloatArray, modes: FloatArray) -> FloatArray:
    """Return how each vertex moves along its normal with each parameter, (V, 7 + K)."""
    turn = np.cross(vertices, normals)
    size = (vertices * normals).sum(axis=1, keepdims=True)
    return np.concatenate([turn, normals, size, np.einsum("vd,vdk->vk", normals, modes)], axis=1)


def gauss_newton_step(
    problem: Problem, weighted: WeightedMatches, iterate: Iterate, modes: int
) -> tuple[FloatArray, FloatArray]:
    """Return the step (7 + K,) from an iterate with its weighted matches, and the Hessian of the cost."""
    surface, prior, scan, vertices = iterate.surface, problem.prior, weighted.matches.points, weighted.matches.vertices
    w, v = weighted.weights.points, weighted.weights.vertices
    rows = vertex_rows(surface.vertices, surface.normals, surface.modes[:, :, :modes].astype(float))
    hessian, gradient = np.zeros((POSE + modes, POSE + modes)), np.zeros(POSE + modes)
    corners = surface.topology.faces[scan.triangle]
    for i in np.flatnonzero(w):
        for c, share in zip(corners[i], scan.barycentric[i], strict=True):
            hessian += w[i] * share * np.outer(rows[c], rows[c])  # lumped on the corners
            gradient += w[i] * share * scan.residual[i] * rows[c]
    for j, weight, residual in zip(vertices.vertex, v, vertices.residual, strict=True):
        hessian += weight * np.outer(rows[j], rows[j])
        gradient += weight * residual * rows[j]
    rho = prior.weight * weighted.sigma_mm**2
    hessian[POSE:, POSE:] += np.diag(rho / prior.stddev[:modes] ** 2)
    gradient[POSE:] += rho * iterate.b[:modes] / prior.stddev[:modes] ** 2
    hessian[6, 6] += rho / prior.scale_stddev**2
    gradient[6] += rho / prior.scale_stddev**2 * np.log(iterate.T_scan_model.scale / prior.start_scale)
    return -np.linalg.solve(hessian, gradient), hessian
