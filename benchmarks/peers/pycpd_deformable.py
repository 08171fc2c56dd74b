"""pycpd: deformable coherent point drift on 2,000 points of each, carried to the other vertices by its own kernel."""

from __future__ import annotations

import time

import numpy as np

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("pycpd",)
POINTS = 2000
KERNEL_MM = 30.0
OUTLIERS = 0.1


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    from pycpd import DeformableRegistration

    rng = np.random.default_rng(0)
    Y = mean.vertices[rng.choice(len(mean.vertices), POINTS, replace=False)]
    X = scan.vertices[rng.choice(len(scan.vertices), min(POINTS, len(scan.vertices)), replace=False)]
    began = time.process_time()
    registration = DeformableRegistration(X=X, Y=Y, alpha=2.0, beta=KERNEL_MM, w=OUTLIERS, max_iterations=100)
    registration.register()
    vertices = registration.transform_point_cloud(np.array(mean.vertices))
    return vertices, time.process_time() - began
