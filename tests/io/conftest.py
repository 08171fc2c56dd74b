import numpy as np
import pytest

from shapespace.types import Mesh


@pytest.fixture
def tetrahedron() -> Mesh:
    """A closed surface whose coordinates need all digits of float64."""
    vertices = np.array([[0.1, 0.2, 0.3], [1 / 3, 0, 0], [0, 1e3 / 7, 0], [0, 0, -2 / 7]])
    return Mesh(vertices, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32), name="t")
