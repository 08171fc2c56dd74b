"""The scan as the target of a fit: search structures of its surface, its normals, its border."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.errors import FitError, MeshError
from shapespace.geometry.closest import ClosestPointEngine, ClosestPoints, VertexEngine, build_engine, finest_engine
from shapespace.geometry.grooming import Crop
from shapespace.geometry.normals import boundary_vertices, rms_size
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, BoolArray, FloatArray, IntArray, Mesh, Similarity

_APART = 10.0  # extents of a scan, by which its parts are moved apart: no other part is nearer
_ROUNDS = 4
"""Rounds in which the share of the larger areas is adjusted for vertices that are drawn for certain."""


def mm_frame(scan: Mesh, mm_per_scan_unit: float) -> Similarity:
    """Return T_mm_scan: from the scan's own frame to mm, near the origin, where float64 is most precise."""
    centre = np.median(scan.vertices, axis=0)
    return Similarity(mm_per_scan_unit, np.eye(3), -mm_per_scan_unit * centre)


@dataclass(frozen=True, eq=False)
class ScanTarget:
    """A scan in its mm frame; derived data are computed once, on first access.

    The parts of a scan with known parts are moved apart by `shift` for all searches, so that
    they match the vertices of their own part only.

    Args:
        mesh: the scan.
        part_of_vertex: (V,) part of each vertex of the model, to which `mesh.parts` refers; None if parts are unknown.
    """

    mesh: Mesh
    part_of_vertex: IntArray | None = None

    @cached_property
    def shown(self) -> BoolArray | None:
        """(V,) False for vertices of the model in parts that the scan lacks; None if its parts are unknown."""
        if self.part_of_vertex is None or self.mesh.parts is None:
            return None
        return np.isin(self.part_of_vertex, self.mesh.parts)

    def shift(self, parts: IntArray | None) -> FloatArray | float:
        """Return the shifts (M, 3) mm by which points of `parts` (M,) are searched, or 0 if parts are unknown."""
        if parts is None or self.part_of_vertex is None:
            return 0.0
        far = _APART * float(np.ptp(self.mesh.vertices))
        return parts[:, None].astype(np.float64) * [far, 0.0, 0.0]

    def vertex_shift(self, vertex: IntArray | slice) -> FloatArray | float:
        """Return `shift` of the vertices `vertex` (M,) of the model."""
        return self.shift(None if self.part_of_vertex is None else self.part_of_vertex[vertex])

    @cached_property
    def searched(self) -> Mesh:
        """The scan with its parts moved apart."""
        shift = self.shift(self.mesh.parts)
        return self.mesh if isinstance(shift, float) else self.mesh.with_vertices(self.mesh.vertices + shift)

    @cached_property
    def engine(self) -> ClosestPointEngine:
        """Search structure of the surface, or of the points if the scan has no triangles."""
        return build_engine(self.searched)

    @cached_property
    def vertex_engine(self) -> VertexEngine:
        """Search structure of the vertices."""
        return VertexEngine(self.searched)

    def search(self, name: str) -> ClosestPointEngine:
        """Return the engine called `name` in `ENGINES`."""
        if name == "vertices":
            return self.vertex_engine if self.mesh.faces is not None else self.engine
        return self.engine if name == finest_engine(self.mesh) else build_engine(self.mesh, name)

    @cached_property
    def rim(self) -> BoolArray:
        """(S,) True on the border of the scan."""
        return boundary_vertices(self.mesh)

    @cached_property
    def _normals_and_areas(self) -> tuple[FloatArray, FloatArray]:
        from shapespace.fit.robust.kernels import areas_into, normals_into  # compiled

        normals, areas = np.zeros(self.mesh.vertices.shape), np.zeros(len(self.mesh.vertices))
        if self.mesh.faces is None:
            return normals, np.ones(len(areas))
        vertices, faces = np.array(self.mesh.vertices), np.array(self.mesh.faces)
        normals_into(vertices, faces, normals)
        areas_into(vertices, faces, areas)
        return normals, areas

    @property
    def normals(self) -> FloatArray:
        """(S, 3) unit normals at the vertices; zero at vertices without a triangle of positive area."""
        return self._normals_and_areas[0]

    def draw(self, count: int | None, rng: np.random.Generator) -> IntArray:
        """Return the indices of about `count` vertices, spread as evenly by area as possible; None for all.

        Scanners and editors sample hair, rims and creases more densely; equal weights would give such parts too much
        influence.
        """
        areas = self._normals_and_areas[1]
        if count is None or count >= len(areas) or areas.sum() <= 0.0:
            return np.arange(len(areas), dtype=np.int32)
        areas = np.minimum(areas, areas.mean())  # spikes from outliers have a large area and little information
        share = areas * (count / areas.sum())
        for _ in range(_ROUNDS):
            share *= count / np.minimum(1.0, share).sum()
        reached = np.cumsum(np.minimum(1.0, share)) + rng.random()
        return np.flatnonzero(np.diff(np.floor(reached), prepend=0.0) > 0).astype(np.int32)

    def carriers(self, matches: ClosestPoints) -> tuple[IntArray, FloatArray]:
        """Return the vertices (M, c) that carry `matches`, three or one, and their barycentric weights (M, c)."""
        if matches.triangle is None or matches.barycentric is None or self.mesh.faces is None:
            return matches.vertex[:, None], np.ones((len(matches.vertex), 1))
        return self.mesh.faces[matches.triangle], matches.barycentric


_FEWEST = 30  # vertices; with fewer no fit has enough matches (`_FEWEST_MATCHES` of the robust method)


def crop_scan(
    crop: Crop, scan: Mesh, model: ShapeModel, landmarks: Mapping[str, FloatArray] | None, unit: str
) -> tuple[Mesh, str]:
    """Return the part of `scan` inside the crop, and a sentence on it.

    Args:
        crop: the crop.
        scan: the scan in its own frame and unit.
        model: shape model, whose landmarks determine the unit of the scan's landmarks.
        landmarks: name -> (3,) of the scan.
        unit: unit of the scan, or `auto`.

    Raises:
        FitError: hardly any vertex is left, or the crop needs landmarks and there are none.
    """
    if crop.kind != "landmarks":
        inside = crop.contains(scan.vertices)
    elif landmarks:
        mm = MM_PER_UNIT[unit if unit != "auto" else _find_landmark_unit(model, landmarks, scan.name)]
        inside = np.zeros(len(scan.vertices), dtype=np.bool_)
        for point in np.stack(list(landmarks.values())):
            inside |= np.linalg.norm(scan.vertices - point, axis=1) * mm <= crop.numbers[0]
    else:
        raise FitError(f"{scan.name}: the crop {crop.text} needs landmarks, and none are given for it.")
    try:
        return crop.cut(scan, inside, _FEWEST)
    except MeshError as error:
        raise FitError(str(error)) from error


def _find_landmark_unit(model: ShapeModel, landmarks: Mapping[str, FloatArray], scan_name: str) -> str:
    """Return the unit for which the landmarks are about as far apart as the model's."""
    shared = [name for name in model.landmarks if name in landmarks]
    there = rms_size(np.stack([landmarks[name] for name in shared])) if len(shared) > 1 else 0.0
    if there == 0.0:
        raise FitError(f"{scan_name}: its landmarks do not determine its unit, which the crop needs; give --unit.")
    ratio = there / rms_size(model.landmarks.select(shared).interpolate(model.mean_vertices))
    return min(MM_PER_UNIT, key=lambda unit: abs(float(np.log(ratio * MM_PER_UNIT[unit]))))
