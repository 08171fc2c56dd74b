"""Standard deviation of the position of each vertex along its surface, after a correspondence.

Matches determine a position along the surface only as far as a patch around it cannot slide on itself: a plane slides
along two directions, a cylinder along and around its axis, a sphere around its centre. Slippage (Gelfand and Guibas,
Shape segmentation using local slippage analysis, SGP 2004) is the posterior variance of such slides, if matches measure
distances along the normals only. It is scaled by the deviation of the shape from the mean along the surface, since
errors of matches grow with
differences between shapes. Equations Cn are those of docs/correspondence.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from shapespace.correspondence.harmonics import Harmonics
from shapespace.geometry.normals import rms_size, vertex_normals
from shapespace.types import BoolArray, FloatArray, Mesh

_PATCH, _AROUND, _DEVIATION = 0.1, 0.3, 0.6
"""Ranges of a patch, of its surroundings, and of the average of the deviation from the mean, shares of the size."""
_SOURCES, _NEAREST = 5000, 128
"""Largest number of vertices over which patches are averaged, and number of the nearest of these in a patch: three
standard deviations around a vertex, at a cost that grows only linearly with the vertices."""
_ROTATION, _SHARE_AROUND, _LEAST = 0.3, 0.1, 1e-3
"""Prior precision of the rotation of a patch, weight of the information of its surroundings, and the least information
on a position, in units of the information of a patch whose normals are all parallel along their direction."""
_POWER, _FACTOR = 1.25, 0.115
"""Exponent of the deviation from the mean, and factor of (C42). With all these constants, 85 to 95 % of the true
positions are in the 90 % regions of faces, damaged faces, femora, cut femora, molars and blobs."""


@dataclass(frozen=True, eq=False)
class VertexConfidence:
    """Certainty of positions along the surfaces of one correspondence, from the matches.

    Args:
        template: the mean shape.
        harmonics: harmonics of the template.
        patch: (V, V) sparse, weights of the average over the patch around each vertex: a Gaussian in space, over
            vertices whose normals are less than 90 degrees apart. Unlike the weights of heat, cut off at some
            harmonics, none is negative, and vertices far away, which have long arms, have none.
    """

    template: Mesh
    harmonics: Harmonics
    patch: sparse.csr_array

    @staticmethod
    def of(template: Mesh, harmonics: Harmonics) -> VertexConfidence:
        """Return the confidence for surfaces with the vertices of `template`."""
        length, normals = _PATCH * rms_size(template.vertices), vertex_normals(template)
        count = len(normals)
        drawn = np.random.default_rng(0).permutation(count)[:_SOURCES]
        distance, nearest = cKDTree(template.vertices[drawn]).query(template.vertices, k=min(_NEAREST, len(drawn)))
        near = drawn[nearest]
        alike = np.maximum(np.einsum("vd,vkd->vk", normals, normals[near]), 0.0)
        weight = (np.exp(-0.5 * (distance / length) ** 2) * alike + 1e-12) * harmonics.area[near]
        weight /= weight.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(count), near.shape[1])
        patch = sparse.csr_array((weight.ravel(), (rows, near.ravel())), shape=(count, count))
        return VertexConfidence(template, harmonics, patch)

    def position_std(self, vertices: FloatArray, observed: BoolArray, scans: int) -> FloatArray:
        """Return (V,) the standard deviation of the position of each vertex in any direction along the surface.

        Args:
            vertices: (V, 3) vertices of the surface, aligned to the template.
            observed: (V,) whether the scan shows the vertices.
            scans: number of shapes that the template is the mean of.
        """
        template, harmonics = self.template, self.harmonics
        size, normals = rms_size(template.vertices), vertex_normals(template.with_vertices(vertices))
        outward = self.patch @ normals
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
        axis = np.eye(3)[np.abs(outward).argmin(axis=1)]
        first = np.cross(outward, axis) / np.linalg.norm(np.cross(outward, axis), axis=1, keepdims=True)
        along = np.stack([first, np.cross(outward, first)], axis=1)
        # A patch moves by u + w x (y - x): the distance from the surface changes by n.u + ((y - x) x n).w.
        places = vertices / (_PATCH * size)
        rows = np.concatenate([normals, np.cross(places, normals)], axis=1) * observed[:, None]
        products = self.patch @ (rows[:, :, None] * rows[:, None, :]).reshape(-1, 36)
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
        share = np.sqrt(mean_square) / size
        return np.asarray(_FACTOR * size * share**_POWER * slippage)  # C42
