"""meshmonk: pyramid non-rigid registration after its own rigid stage with scale, both with its defaults."""

from __future__ import annotations

import time

import numpy as np

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("meshmonk",)


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    import meshmonk

    began = time.process_time()
    floating, target = (
        meshmonk.features_from_vertices(np.array(m.vertices, dtype=np.float32), np.array(m.faces)) for m in (mean, scan)
    )
    result = meshmonk.pyramid_register(
        floating_features=floating,
        target_features=target,
        floating_faces=np.array(mean.faces),
        target_faces=np.array(scan.faces),
        rigid_params={"use_scaling": True},
    )
    return np.asarray(result.aligned_vertices, dtype=np.float64), time.process_time() - began
