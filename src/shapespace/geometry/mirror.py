"""Mirror images in correspondence: which vertex is the other side's, and a surface turned about."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from shapespace.errors import InputError
from shapespace.types import FloatArray, IntArray

_OFF = 0.01
"""A surface whose mirror image lies within this share of its size is taken for symmetric."""
FLIP = np.array([-1.0, 1.0, 1.0])
"""What turns points (..., 3) into their mirror images about x = 0."""


def mirror_vertices(vertices: FloatArray) -> IntArray:
    """Return (V,) the vertex on the other side of the plane x = 0, its own inverse.

    Args:
        vertices: (V, 3) of a symmetric surface, such as a mean face, that looks along z.

    Raises:
        InputError: the surface is not its own mirror image, or its vertices do not pair up.
    """
    centred = vertices - vertices.mean(axis=0) * [0.0, 1.0, 1.0]
    found = cKDTree(centred).query(centred * FLIP)
    distance, other = np.asarray(found[0]), np.asarray(found[1], dtype=np.int32)
    size = float(np.sqrt((centred**2).sum(axis=1).mean()))
    if distance.max() > _OFF * size or (other[other] != np.arange(len(other))).any():
        raise InputError("This surface is not its own mirror image about x = 0; train without mirror images.")
    return other


def mirrored(vertices: FloatArray, other: IntArray) -> FloatArray:
    """Return the mirror image (..., V, 3) of surfaces (..., V, 3), in correspondence with them.

    Args:
        vertices: of the surfaces.
        other: (V,) from `mirror_vertices`.
    """
    return vertices[..., other, :] * FLIP
