"""Open3D: point-to-point ICP with scale of the mean shape; it has no shape to fit."""

from __future__ import annotations

import time

import numpy as np

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("open3d",)
REACH_MM = 30.0


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    import open3d as o3d

    source, target = (o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.array(m.vertices))) for m in (mean, scan))
    icp = o3d.pipelines.registration
    began = time.process_time()
    result = icp.registration_icp(
        source,
        target,
        REACH_MM,
        np.eye(4),
        icp.TransformationEstimationPointToPoint(with_scaling=True),
        icp.ICPConvergenceCriteria(1e-7, 1e-7, 200),
    )
    seconds = time.process_time() - began
    T = np.asarray(result.transformation)
    return mean.vertices @ T[:3, :3].T + T[:3, 3], seconds
