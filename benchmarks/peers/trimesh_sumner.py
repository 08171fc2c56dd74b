"""trimesh: nricp_sumner of the mean shape, with its defaults."""

from __future__ import annotations

import time

import numpy as np

from peers import prealigned
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("trimesh", "rtree")


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    import trimesh

    began = time.process_time()
    placed = prealigned(model, scan, T_scan_model)
    source, target = (trimesh.Trimesh(np.array(m.vertices), np.array(m.faces), process=False) for m in (placed, scan))
    vertices = trimesh.registration.nricp_sumner(source, target)
    return np.asarray(vertices, dtype=np.float64), time.process_time() - began
