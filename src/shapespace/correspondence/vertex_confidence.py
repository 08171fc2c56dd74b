"""Standard deviation of the position of each vertex along its surface, after a correspondence.

Matches determine a position along the surface only as far as a patch around it cannot slide on itself: a plane slides
along two directions, a cylinder along and around its axis, a sphere around its centre. This is the slippage of Gelfand
and Guibas (Shape segmentation using local slippage analysis, SGP 2004), a posterior variance for matches along the
normals. It is scaled by how far the shape differs from the mean along the surface, since a match is as wrong as shapes
differ. Equations Cn are those of docs/correspondence.md.
"""

from __future__ import annotations

import numpy as np

from shapespace.correspondence.harmonics import Harmonics
from shapespace.geometry.normals import rms_size, vertex_normals
from shapespace.types import BoolArray, FloatArray, Mesh

_PATCH, _AROUND, _DEVIATION = 0.1, 0.3, 0.6
"""Ranges of a patch, of its surroundings, and of the average of the deviation from the mean, shares of the size."""
_ROTATION, _SHARE_AROUND, _LEAST = 0.3, 0.1, 1e-3
"""Prior precision of the rotation of a patch, weight of the information of its surroundings, and the least information
on a position, in units of the information of a patch whose normals are all parallel along their direction."""
_POWER, _FACTOR = 0.85, 0.071
"""Exponent and factor of (C42). All constants are values for which 86 to 95 % of the true positions are in the 90 %
regions of faces, damaged faces, femora, cut femora, molars and blobs; 84 % of other femora (docs/correspondence.md)."""


def estimate_position_std(
    vertices: FloatArray, observed: BoolArray, template: Mesh, harmonics: Harmonics, scans: int
) -> FloatArray:
    """Return (V,) the standard deviation of the position of each vertex in any direction along the surface.

    Args:
        vertices: (V, 3) of the surface, aligned to the template.
        observed: (V,) whether the scan shows them.
        template: the mean shape.
        harmonics: of the template.
        scans: number of shapes that the template is the mean of.
    """
    size, normals = rms_size(template.vertices), vertex_normals(template.with_vertices(vertices))
    axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, axis) / np.linalg.norm(np.cross(normals, axis), axis=1, keepdims=True)
    along = np.stack([first, np.cross(normals, first)], axis=1)
    # A patch moves by u + w x (y - x): the distance from the surface changes by n.u + ((y - x) x n).w.
    places = vertices / (_PATCH * size)
    rows = np.concatenate([normals, np.cross(places, normals)], axis=1) * observed[:, None]
    products = harmonics.diffused((rows[:, :, None] * rows[:, None, :]).reshape(-1, 36), _PATCH * size)
    about_vertex = np.tile(np.eye(6), (len(vertices), 1, 1))
    about_vertex[:, 3:, :3] = np.cross(places[:, None], np.eye(3))
    information = about_vertex @ products.reshape(-1, 6, 6) @ about_vertex.transpose(0, 2, 1)  # C40
    rotation = np.linalg.solve(information[:, 3:, 3:] + _ROTATION * np.eye(3), information[:, 3:, :3])
    translation = information[:, :3, :3] - information[:, :3, 3:] @ rotation
    shown = normals * observed[:, None]
    around = harmonics.diffused((shown[:, :, None] * shown[:, None, :]).reshape(-1, 9), _AROUND * size)
    translation = translation + _SHARE_AROUND * around.reshape(-1, 3, 3)
    certain = np.linalg.eigvalsh(np.einsum("vad,vde,vbe->vab", along, translation, along))  # C41
    slippage = (1.0 / (np.maximum(certain, 0.0) + _LEAST)).mean(axis=1)
    deviation = np.einsum("vad,vd->va", along, vertices - template.vertices)
    mean_square = harmonics.diffused(0.5 * (deviation**2).sum(axis=1, keepdims=True), _DEVIATION * size)[:, 0]
    mean_square = np.maximum(mean_square, 0.0) * scans / max(scans - 1, 1)
    return _FACTOR * np.sqrt(mean_square) * slippage**_POWER  # C42
