"""biocpd: coherent point drift with a PCA model and a similarity, the only peer that fits the same model."""

from __future__ import annotations

import time

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

NEEDS = ("biocpd",)
MODES = 50
OUTLIERS = 0.1


def fit(mean: Mesh, model: ShapeModel, scan: Mesh, T_scan_model: Similarity) -> tuple[FloatArray, float]:
    from biocpd import AtlasRegistration

    cut = model.truncate(min(MODES, model.n_modes))
    # Its modes act before its similarity, so they are turned and scaled into the frame of the placed mean.
    modes = T_scan_model.scale * (T_scan_model.rotation @ cut.vertex_basis.reshape(-1, 3, cut.n_modes))
    began = time.process_time()
    registration = AtlasRegistration(
        X=scan.vertices,
        Y=mean.vertices,
        mean_shape=mean.vertices,
        U=modes,
        eigenvalues=cut.stddev**2,
        normalize=True,
        with_scale=True,
        w=OUTLIERS,
        max_iterations=200,
        tolerance=1e-6,
    )
    vertices, _ = registration.register()
    return vertices.astype("float64"), time.process_time() - began
