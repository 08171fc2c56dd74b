"""What a result says beside its numbers."""

import numpy as np

from shapespace.fit.fit_scan import fit_scan
from shapespace.types import Mesh
from synthetic_shapes import blob_model


def test_coefficients_far_out_are_said():
    model = blob_model()
    z = np.array([0.5, 0.5, 4.5, -4.5, 4.5])
    scan = Mesh(model.reconstruct(z * model.stddev), model.faces)
    far = fit_scan(model, scan)
    assert np.abs(far.z).max() > 3
    assert any("standard deviations out" in note for note in far.notes)
    near = fit_scan(model, model.mesh(0.3 * model.stddev))
    assert not any("standard deviations out" in note for note in near.notes)


def test_a_point_cloud_is_told_that_distances_are_to_its_points():
    model = blob_model()
    shape = model.mesh(0.3 * model.stddev)
    assert any("no triangles" in note for note in fit_scan(model, Mesh(shape.vertices)).notes)
    assert not any("no triangles" in note for note in fit_scan(model, shape).notes)
