"""small_gicp: point-to-plane ICP of the mean shape, rigid; it knows neither scale nor shape."""

from __future__ import annotations

import time

import numpy as np

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("small_gicp",)
REACH_MM = 30.0


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    import small_gicp

    began = time.process_time()
    result = small_gicp.align(
        np.array(scan.vertices),
        np.array(mean.vertices),
        registration_type="PLANE_ICP",
        downsampling_resolution=0.25,
        max_correspondence_distance=REACH_MM,
        max_iterations=100,
    )
    seconds = time.process_time() - began
    T = np.asarray(result.T_target_source)
    return mean.vertices @ T[:3, :3].T + T[:3, 3], seconds
