"""Point clouds from file to coefficients by the default method."""

import json
from pathlib import Path

import numpy as np

from shapespace.cli import main
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.types import Mesh, Similarity
from synthetic_shapes import blob, blob_model, similarity, sphere

POINTS, NOISE_MM = 20_000, 0.2


def test_a_noisy_uneven_cloud_is_fitted_to_its_true_vertices(tmp_path: Path) -> None:
    model = blob_model(700)
    model.save(tmp_path / "blob.h5")
    rng = np.random.default_rng(0)
    z = rng.uniform(-1, 1, 5)
    d, _ = sphere(60_000, turn=0.7)
    # One side is seen three times as often as the other.
    share = np.where(d @ [0.6, 0.0, 0.8] > 0, 3.0, 1.0) * np.exp(0.5 * np.sin(9 * d[:, 1]))
    d = d[rng.choice(len(d), POINTS, replace=False, p=share / share.sum())]
    T: Similarity = similarity(3, 15.0, 1.1)
    write_mesh(tmp_path / "cloud.ply", Mesh(T.apply(blob(d, z) + NOISE_MM * rng.standard_normal((POINTS, 3)))))
    out = tmp_path / "out"
    assert main(["fit", str(tmp_path / "blob.h5"), str(tmp_path / "cloud.ply"), "-o", str(out), "--quiet"]) == 0
    record = json.loads((out / "cloud.fit.json").read_text())
    assert record["method"] == "robust" and record["status"] == "converged"
    assert any("no triangles" in note for note in record["notes"])
    truth = T.apply(blob(sphere(700)[0], z))
    error = np.linalg.norm(read_mesh(out / "cloud.fitted.ply").vertices - truth, axis=1) / T.scale
    assert error.mean() < 0.6, error.mean()
