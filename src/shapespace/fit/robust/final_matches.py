"""How a robust fit ended at each vertex of the model, found when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.fit.robust.matching import match_vertices
from shapespace.fit.robust.prepared_model import ModelSurface
from shapespace.fit.robust.weights import match_weights
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.vertex_regions import BORDER, FOLLOWED, REJECTED, UNSEEN
from shapespace.geometry.closest import on_boundary
from shapespace.geometry.normals import rms_size
from shapespace.types import IntArray, Similarity

_COUNTS = 0.5
"""A match that counts less than this was left out, in the main."""
_SPACINGS = 4.0
"""Nearest points of a cloud lie to the side by half its spacing as a rule; so many times that is a hole."""
_FINEST = 0.01
"""Of the model's size: what lies nearer than this is followed, however exact the rest is."""


@dataclass(frozen=True, eq=False)
class FinalMatches:
    """What decides the regions at the end of a robust fit; called, it finds them.

    Args:
        target: the scan.
        T_scan_model: the final pose, in the scan's mm frame.
        surface: the final one, in the model's frame.
        winding: -1 where the scan's normals are reversed, else 1.
        normal_cosine: matches whose normals disagree more than this do not count.
        weight: name of the weight.
        width_mm: scale of the residuals at the end.
        far_mm: scale of the distances at the end.
    """

    target: ScanTarget
    T_scan_model: Similarity
    surface: ModelSurface
    winding: float
    normal_cosine: float
    weight: str
    width_mm: float
    far_mm: float

    def __call__(self) -> IntArray:
        """Return the code of each vertex, (V,)."""
        every = np.arange(len(self.surface.vertices), dtype=np.int32)
        matches = match_vertices(
            target=self.target,
            engine=self.target.engine,
            T_scan_model=self.T_scan_model,
            surface=self.surface,
            vertex=every,
            near=None,
            winding=self.winding,
            normal_cosine=self.normal_cosine,
        )
        w = match_weights(
            self.weight, matches.residual, np.zeros(len(every)), matches.allowed, self.width_mm, self.far_mm
        )
        near_mm = max(self.width_mm, _FINEST * rms_size(self.surface.vertices))
        sideways = np.sqrt(np.maximum(matches.distance**2 - matches.residual**2, 0.0))
        counted = (w > _COUNTS) | (matches.allowed & (np.abs(matches.residual) < near_mm))
        regions = np.where(counted, FOLLOWED, REJECTED)
        # Where the nearest point of the scan lies off to the side, the scan has nothing at the vertex itself.
        regions[sideways > max(self.far_mm, _SPACINGS * float(np.median(sideways)))] = UNSEEN
        at_rim = on_boundary(matches.near, self.target.mesh, self.target.rim)
        regions[at_rim] = np.where(sideways[at_rim] > near_mm, UNSEEN, BORDER)
        return regions.astype(np.int32)
