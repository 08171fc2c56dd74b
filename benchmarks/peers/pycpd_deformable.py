"""pycpd: deformable coherent point drift on 2,000 points of each, carried to all vertices by its kernel."""

from __future__ import annotations

import time

import numpy as np
from scipy.spatial.distance import cdist

from peers import prealigned
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("pycpd",)
POINTS = 2000
KERNEL_MM = 30.0
OUTLIERS = 0.1


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    from pycpd import DeformableRegistration

    began = time.process_time()
    placed = prealigned(model, scan, T_scan_model).vertices
    rng = np.random.default_rng(0)
    Y = placed[rng.choice(len(placed), POINTS, replace=False)]
    X = scan.vertices[rng.choice(len(scan.vertices), min(POINTS, len(scan.vertices)), replace=False)]
    registration = DeformableRegistration(X=X, Y=Y, alpha=2.0, beta=KERNEL_MM, w=OUTLIERS, max_iterations=100)
    registration.register()
    # Its own kernel, since version 2.0.0 moves only the points that it was given.
    weights = np.exp(-cdist(placed, Y, "sqeuclidean") / (2 * KERNEL_MM**2))
    vertices = placed + weights @ registration.W
    return vertices, time.process_time() - began
