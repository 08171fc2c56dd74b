"""Other tools on the same scans, each optional, all behind one contract.

A peer is a module here with `NEEDS`, the names it imports, and

    fit(mean, model, scan, T_scan_model) -> ((V, 3) vertices in the scan's frame, CPU seconds)

where `mean` is the model's mean as a mesh, already placed by `T_scan_model`, the same crude start for everyone. The
seconds are of the tool's own work on arrays that are ready for it.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Mapping
from types import ModuleType

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
