"""The mirror image of a shape, in the same correspondence, for `--symmetric`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import on_triangles
from shapespace.correspondence.register import ElasticSettings, Template, register
from shapespace.correspondence.template import PoseModel
from shapespace.errors import InputError
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.mirror_plane import FLIP, mirror_image
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, IntArray, Mesh

_UNLIKE = 0.1
"""A template that is this far (RMS, share of its size) from its mirror image is not symmetric."""


@dataclass(frozen=True, eq=False)
class MirrorMap:
    """For each vertex of a template, the place on it that is the same place on its mirror image.

    Args:
        corners: (V, 3) of the triangle that the place lies on.
        weights: (V, 3) barycentric.
    """

    corners: IntArray
    weights: FloatArray

    @staticmethod
    def of(mesh: Mesh, harmonics: Harmonics, settings: ElasticSettings, seed: int) -> MirrorMap:
        """Return the map of a template, from the template registered to its own mirror image.

        Raises:
            InputError: the template is not symmetric.
        """
        image = mirror_image(mesh)
        T = PoseModel.of(mesh).search(np.array(image.vertices), seed).T_scan_model
        registered = register(Template.of(mesh, harmonics), ScanTarget(image), T, settings, seed=seed)
        mirror = MirrorMap(*on_triangles(image, registered.T_scan_template.apply(registered.vertices)))
        off = mirror.image(mesh.vertices) - mesh.vertices
        share = float(np.sqrt((off**2).sum(axis=1).mean())) / rms_size(mesh.vertices)
        if share > _UNLIKE:
            raise InputError(
                f"The template lies {100 * share:.0f} % of its size from its own mirror image, so it is not symmetric; "
                "leave --symmetric out."
            )
        return mirror

    def image(self, vertices: FloatArray) -> FloatArray:
        """Return the mirror image (V, 3) of a shape (V, 3) in correspondence with it, in the pose of the shape."""
        flipped = np.einsum("vc,vcd->vd", self.weights, vertices[self.corners]) * FLIP
        return fit_similarity(flipped, vertices).apply(flipped)

    def observed(self, weights: FloatArray) -> FloatArray:
        """Return (N, V) the weights of the vertices of mirror images, from those of the shapes (N, V)."""
        return weights[:, self.corners].min(axis=2)
