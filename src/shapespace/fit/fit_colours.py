"""The colours of a scan on the surface that was fitted to it."""

from __future__ import annotations

import numpy as np

from shapespace.geometry.closest import ClosestPoints
from shapespace.types import GREY, BoolArray, ByteArray, Mesh


def carried_colours(colours: ByteArray, scan: Mesh, closest: ClosestPoints, seen: BoolArray) -> ByteArray:
    """Return the colours (V, 3) at the closest points of a surface's vertices, between the scan's vertices linearly.

    Args:
        colours: (S, 3) of the scan's vertices.
        scan: its surface or points.
        closest: the closest points of the scan to V vertices.
        seen: (V,) False where the scan shows nothing that the surface follows: there it is `GREY`.
    """
    if closest.triangle is None or closest.barycentric is None or scan.faces is None:
        interpolated = colours[closest.vertex]
    else:
        corners = colours[scan.faces[closest.triangle]].astype(np.float64)
        interpolated = np.rint(np.einsum("vc,vcd->vd", closest.barycentric, corners)).clip(0, 255).astype(np.uint8)
    return np.where(seen[:, None], interpolated, np.uint8(GREY))
