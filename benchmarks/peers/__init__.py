"""Other tools on the same scans, each optional, all behind one contract.

A peer is a module here with `NEEDS`, the names it imports, and

    fit(mean, model, scan, T_scan_model) -> ((V, 3) vertices in the scan's frame, CPU seconds)

where `mean` is the model's mean as a mesh, already placed by `T_scan_model`, the same crude start for everyone. The
seconds are of the tool's own work on arrays that are ready for it. Tools that know no pose of their own are first
placed by the similarity ICP of the mean (`prealigned`), which is counted; without it they end four times further off.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from types import ModuleType

from shapespace.fit.iteration_state import StopRule
from shapespace.fit.paper.paper_method import similarity_icp
from shapespace.geometry.closest import build_engine
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity

PEERS: Mapping[str, str] = {
    "open3d_icp": "similarity of the mean only",
    "small_gicp_icp": "rigid motion of the mean only",
    "meshmonk_pyramid": "non-rigid, no model",
    "biocpd_atlas": "PCA model, K=50",
    "trimesh_amberg": "non-rigid, no model",
    "trimesh_sumner": "non-rigid, no model",
    "pycpd_deformable": "non-rigid, no model, on 2,000 points",
}
"""Name and what it does."""


def load(name: str) -> ModuleType | str:
    """Return the peer, or the reason why it cannot run here."""
    module = importlib.import_module(f"peers.{name}")
    missing = [needed for needed in module.NEEDS if importlib.util.find_spec(needed) is None]
    return f"{', '.join(missing)} not installed" if missing else module


def prealigned(model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> Mesh:
    """Return the mean where phase 1 of the paper's method leaves it."""
    engine = build_engine(scan, "vertices")
    for state in similarity_icp(model, engine, T_scan_model, StopRule(rate=1e-4)):
        T_scan_model = state.T_scan_model
    return Mesh(T_scan_model.apply(model.mean_vertices), model.faces, name="mean")
