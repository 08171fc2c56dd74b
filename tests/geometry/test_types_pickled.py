"""What goes to other processes comes back whole."""

import copy
import pickle

import numpy as np

from shapespace.types import Mesh
from synthetic_shapes import sphere


def test_a_mesh_comes_back_with_all_that_it_has() -> None:
    vertices, faces = sphere(20)
    colours = np.arange(vertices.size, dtype=np.uint8).reshape(-1, 3)
    mesh = Mesh(vertices, faces, {"tip": np.zeros(3)}, "scan", colours, ("A picture is missing.",))
    for back in (pickle.loads(pickle.dumps(mesh)), copy.deepcopy(mesh)):
        assert back.name == "scan" and back.notes == mesh.notes and list(back.landmarks) == ["tip"]
        for name in ("vertices", "faces", "colours"):
            np.testing.assert_array_equal(getattr(back, name), getattr(mesh, name))
