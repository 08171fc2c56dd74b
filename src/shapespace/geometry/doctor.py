"""The mesh doctor: properties of a scan, its defects, and safe repairs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import MeshError
from shapespace.geometry.normals import without_vertices
from shapespace.types import BoolArray, ByteArray, FloatArray, IntArray, Mesh

NON_FINITE = "coordinates that are NaN or infinite"
"""Text of findings on vertices without a position."""

# Twice the area of a triangle over its longest edge squared; smaller values are a line up to float64 rounding.
_DEGENERATE = 1e-12
# Ratio of the smallest to the largest spread below which points are on a plane, and of the second for a line.
_FLAT = 1e-6
# Squares and cubes of coordinates must stay within float64.
_ABSURD = 1e80
# Distance from the origin, relative to the size, above which coordinates stored as float32 are coarse.
_FAR = 100.0
# Mean inward component of the normals of an open surface above which it is reversed: a convex cap has +0.3 or more,
# and a surface with equal convex and concave parts has 0.
_REVERSED = -0.05


FindingLevel: TypeAlias = Literal["fixed", "note", "refused"]


@dataclass(frozen=True)
class Finding:
    """A finding of the mesh doctor.

    Args:
        level: severity, see `FindingLevel`: "fixed" (repaired), "note" (unchanged), or an error that prevents fitting.
        problem: sentence about the problem.
        action: sentence about the action of fitting, or for an error, about the action of the user.
    """

    level: FindingLevel
    problem: str
    action: str


@dataclass(frozen=True, eq=False)
class MeshReport:
    """Properties of a mesh as in its file.

    Args:
        name: name of the mesh.
        vertices: number of vertices.
        triangles: number of triangles; 0 for a point cloud.
        bounds: (2, 3) float64 lowest and highest finite coordinates, in the unit of the mesh; NaN if there are none.
        extent: (3,) float64 size along the axes, in the unit of the mesh.
        components: number of connected pieces of surface; 0 for a point cloud.
        largest_component_share: share of the area of the largest piece, 0 to 1.
        boundary_edges: number of edges with one triangle; 0 for a closed surface.
        non_manifold_edges: number of edges with more than two triangles.
        duplicate_vertices: number of vertices with the position of an earlier vertex.
        unreferenced_vertices: number of vertices that no triangle uses; 0 for a point cloud.
        degenerate_triangles: number of triangles without area.
        duplicate_triangles: number of triangles with the same corners as an earlier triangle.
        non_finite_vertices: number of vertices with a coordinate that is NaN or infinite.
        inconsistent_edges: number of edges whose two triangles have opposite winding.
        reversed_triangles: number of triangles that the repair reverses.
        planarity: ratio of the smallest to the largest singular value of the centred points; 0 on a plane.
        origin_distance: distance of the centroid from the origin, relative to the diagonal of the bounds.
        findings: all findings, in the order of the checks.
    """

    name: str
    vertices: int
    triangles: int
    bounds: FloatArray
    extent: FloatArray
    components: int
    largest_component_share: float
    boundary_edges: int
    non_manifold_edges: int
    duplicate_vertices: int
    unreferenced_vertices: int
    degenerate_triangles: int
    duplicate_triangles: int
    non_finite_vertices: int
    inconsistent_edges: int
    reversed_triangles: int
    planarity: float
    origin_distance: float
    findings: tuple[Finding, ...]

    @property
    def usable(self) -> bool:
        """Whether fitting accepts the mesh."""
        return all(finding.level != "refused" for finding in self.findings)


def examine(mesh: Mesh, *, strict: bool = False) -> MeshReport:
    """Return the properties of `mesh`, its defects and their treatment in fitting, without raising errors.

    Edges, pieces and winding are those of the repaired mesh, since before merging equal vertices, each triangle of a
    triangle soup is a separate piece.

    Args:
        mesh: any mesh, including a mesh without points or with NaN coordinates.
        strict: whether triangles that use vertices with non-finite coordinates are an error.
    """
    return _examine_and_repair(mesh, strict=strict).report


def repair(mesh: Mesh, *, strict: bool = False) -> tuple[Mesh, tuple[Finding, ...]]:
    """Repair defects that can be repaired safely, and raise an error for a mesh that cannot be fitted.

    Vertices with non-finite coordinates are removed, with the triangles that use them. Exactly equal vertices are
    merged. Triangles without area, repeated triangles, and vertices that no triangle uses are removed. Winding is made
    consistent and outward. Several pieces, non-manifold edges and a far origin are kept and noted.

    Args:
        mesh: a scan as read. Its landmarks and name are preserved; the numbering of its vertices is not.
        strict: whether triangles that use vertices with non-finite coordinates are an error, instead of being removed.

    Returns:
        The repaired mesh (`mesh` itself if no repair was needed), and the findings.

    Raises:
        MeshError: the mesh cannot be fitted; the message names the mesh, the problem and the action of the user.
    """
    state = _examine_and_repair(mesh, strict=strict)
    for finding in state.report.findings:
        if finding.level == "refused":
            raise MeshError(f"{mesh.name}: {finding.problem[0].lower()}{finding.problem[1:-1]}; {finding.action}")
    return state.repaired(mesh), state.report.findings


def examine_and_repair(mesh: Mesh, *, strict: bool = False) -> tuple[MeshReport, Mesh | None]:
    """Return the report of `examine` and the mesh of `repair`, or None if the mesh cannot be fitted."""
    state = _examine_and_repair(mesh, strict=strict)
    is_refused = any(finding.level == "refused" for finding in state.report.findings)
    return state.report, None if is_refused else state.repaired(mesh)


@dataclass(frozen=True, eq=False)
class _RepairState:
    """A partly repaired mesh and its report; each step returns a new state.

    Args:
        vertices: (V, 3) positions.
        faces: (F, 3) triangles, or None for a point cloud.
        faces_in_file: (F, 3) the same triangles with the vertex numbers of the file.
        colours: (V, 3) colours of the vertices, or None.
        report: counts and findings of the steps so far.
    """

    vertices: FloatArray
    faces: IntArray | None
    faces_in_file: IntArray | None
    colours: ByteArray | None
    report: MeshReport

    def repaired(self, mesh: Mesh) -> Mesh:
        """Return the repaired mesh, or `mesh` itself if nothing was repaired."""
        if all(finding.level != "fixed" for finding in self.report.findings):
            return mesh
        return Mesh(self.vertices, self.faces, mesh.landmarks, mesh.name, self.colours, mesh.notes)

    def measured(self, **values: Any) -> _RepairState:
        """Return a copy of the state in whose report these fields have the given values."""
        return replace(self, report=replace(self.report, **values))

    def reported(self, level: FindingLevel, problem: str, action: str) -> _RepairState:
        """Return the state with one more finding."""
        return self.measured(findings=(*self.report.findings, Finding(level, problem, action)))

    def fixed(
        self,
        without: Callable[[], _RepairState],
        measure: str,
        count: int,
        names: tuple[str, str],
        what: str,
        action: str,
    ) -> _RepairState:
        """Return the state without the defective elements, with their count and a finding in its report.

        If the count is 0, the state itself is returned.

        Args:
            without: function that returns the state without these elements.
            measure: name of the field of the report for their count.
            count: number of defective elements.
            names: subject and verb of the sentence about the problem, such as `triangle has` and `triangles have`.
            what: rest of this sentence, such as `no area.`.
            action: sentence about the repair.
        """
        if not count:
            return self
        problem = f"{_format_count(count, *names)} {what}"
        return without().measured(**{measure: count}).reported("fixed", problem, action)

    def with_vertices_where(self, keep: BoolArray) -> _RepairState:
        """Return the state with the vertices `keep` (V,) and the triangles between them."""
        colours = None if self.colours is None else self.colours[keep]
        if self.faces is None:
            return replace(self, vertices=self.vertices[keep], colours=colours)
        vertices, faces = without_vertices(self.vertices, self.faces, keep)
        return replace(self, vertices=vertices, faces=faces, colours=colours)

    def with_triangles_where(self, keep: BoolArray | IntArray) -> _RepairState:
        """Return the state with the triangles `keep`, a mask (F,) or indices."""
        assert self.faces is not None and self.faces_in_file is not None
        return replace(self, faces=self.faces[keep], faces_in_file=self.faces_in_file[keep])

    def with_triangles_reversed(self, reverse: BoolArray) -> _RepairState:
        """Return the state with the winding of the triangles `reverse` (F,) reversed."""
        assert self.faces is not None
        faces = np.where(reverse[:, None], self.faces[:, ::-1], self.faces)
        count = self.report.reversed_triangles + int(reverse.sum())
        return replace(self, faces=faces).measured(reversed_triangles=count)


def _examine_and_repair(mesh: Mesh, *, strict: bool) -> _RepairState:
    finite = _finite_vertices(mesh.vertices)
    state = _drop_non_finite_vertices(_initial_state(mesh, finite), finite, strict=strict)
    if not state.report.usable:
        return state
    if not len(state.vertices):
        problem = "It has no points with finite coordinates."
        return state.reported("refused", problem, "correct its coordinates, or export the scan again.")
    if np.abs(state.vertices).max() > _ABSURD:
        return state.reported("refused", "Its coordinates are too large to be lengths.", "export the scan again.")
    state = _merge_vertices(state)
    if state.faces is not None:
        state = _drop_unreferenced(_drop_repeated(_drop_degenerate(state)))
    state = _check_spread(state)
    return _inspect_surface(state) if state.faces is not None and len(state.faces) else state


def _initial_state(mesh: Mesh, finite: BoolArray) -> _RepairState:
    """Return the state of `mesh` as in its file; `finite` (V,) is the mask of vertices with finite coordinates."""
    faces = None if mesh.faces is None else np.array(mesh.faces)
    points = mesh.vertices[finite]
    bounds = _bounds(points) if len(points) else np.full((2, 3), np.nan)
    report = MeshReport(
        name=mesh.name,
        vertices=len(mesh.vertices),
        triangles=0 if faces is None else len(faces),
        bounds=bounds,
        extent=bounds[1] - bounds[0],
        components=0,
        largest_component_share=0.0 if faces is None else 1.0,
        boundary_edges=0,
        non_manifold_edges=0,
        duplicate_vertices=0,
        unreferenced_vertices=0,
        degenerate_triangles=0,
        duplicate_triangles=0,
        non_finite_vertices=int((~finite).sum()),
        inconsistent_edges=0,
        reversed_triangles=0,
        planarity=float("nan"),
        origin_distance=float("nan"),
        findings=(),
    )
    return _RepairState(mesh.vertices, faces, faces, mesh.colours, report)


def _drop_non_finite_vertices(state: _RepairState, finite: BoolArray, *, strict: bool) -> _RepairState:
    """Remove vertices that are not finite and triangles that use them; such triangles are an error if `strict`."""
    count = state.report.non_finite_vertices
    if not count:
        return state
    problem = f"It has {_format_count(count, 'vertex', 'vertices')} with {NON_FINITE}"
    finite_faces = None if state.faces is None else np.asarray(finite[state.faces].all(axis=1))
    lost = 0 if finite_faces is None else int((~finite_faces).sum())
    if finite_faces is None or not lost:
        action = "They are missing points that no triangle uses, and are removed."
        return state.with_vertices_where(finite).reported("fixed", f"{problem}.", action)
    problem += f", used by {_format_count(lost, 'triangle', 'triangles')}."
    if strict:
        action = "export the scan again without them, or omit --strict to remove them."
        return state.reported("refused", problem, action)
    state = state.with_triangles_where(finite_faces).with_vertices_where(finite)
    return state.reported("fixed", problem, "They are removed together, which leaves a hole.")


def _merge_vertices(state: _RepairState) -> _RepairState:
    first, index = _equal_rows((state.vertices + 0.0).view(np.int64))  # 0 and -0 have different bits

    def merged() -> _RepairState:
        faces = None if state.faces is None else index[state.faces]
        colours = None if state.colours is None else state.colours[first]
        return replace(state, vertices=state.vertices[first], faces=faces, colours=colours)

    count, action = len(state.vertices) - len(first), "Equal vertices are merged into one."
    return state.fixed(
        merged, "duplicate_vertices", count, ("vertex lies", "vertices lie"), "exactly on another.", action
    )


def _drop_degenerate(state: _RepairState) -> _RepairState:
    from shapespace.geometry import topology  # compiled

    assert state.faces is not None
    flat = topology.flat_triangles(np.array(state.vertices), state.faces, _DEGENERATE)
    others, count = partial(state.with_triangles_where, ~flat), int(flat.sum())
    return state.fixed(
        others, "degenerate_triangles", count, ("triangle has", "triangles have"), "no area.", "They are removed."
    )


def _drop_repeated(state: _RepairState) -> _RepairState:
    assert state.faces is not None
    if not len(state.faces):
        return state
    first, _ = _equal_rows(np.sort(state.faces, axis=1))
    others, count = partial(state.with_triangles_where, first), len(state.faces) - len(first)
    names, action = ("triangle repeats", "triangles repeat"), "Only the first of each is kept."
    return state.fixed(others, "duplicate_triangles", count, names, "an earlier one.", action)


def _drop_unreferenced(state: _RepairState) -> _RepairState:
    assert state.faces is not None
    if not len(state.faces):
        return state
    used = np.zeros(len(state.vertices), dtype=np.bool_)
    used[state.faces] = True
    others, count = partial(state.with_vertices_where, used), int((~used).sum())
    names, action = ("vertex belongs", "vertices belong"), "They are not part of the surface, and are removed."
    return state.fixed(others, "unreferenced_vertices", count, names, "to no triangle.", action)


def _check_spread(state: _RepairState) -> _RepairState:
    """Report an error if the points do not span the space, and a note if they are far from the origin or a cloud."""
    vertices = state.vertices
    centre = vertices.mean(axis=0)
    # The eigenvalues of the 3 x 3 covariance would lose half of the digits; R of QR preserves them.
    spread = np.linalg.svd(np.linalg.qr(vertices - centre, mode="r"), compute_uv=False)
    spread = np.concatenate([spread, np.zeros(3 - len(spread))])
    largest = float(spread[0])
    low, high = _bounds(vertices)
    diagonal = float(np.linalg.norm(high - low))
    distance = float(np.linalg.norm(centre))
    origin_distance = distance / diagonal if diagonal > 0 else float("inf")
    state = state.measured(
        planarity=float(spread[2]) / largest if largest > 0 else 0.0, origin_distance=origin_distance
    )
    rounding = _float32_rounding(vertices)
    tolerance = _FLAT
    if rounding is not None and largest > 0:
        # Rounding to float32 displaces points of a plane by up to this distance.
        tolerance = max(tolerance, rounding * float(np.sqrt(len(vertices))) / largest)
    if (refusal := _find_degeneracy(state, spread, tolerance)) is not None:
        state = state.reported("refused", *refusal)
    if diagonal > 0 and origin_distance > _FAR:
        grid = "" if rounding is None else f", on a grid of about {rounding:.2g}"
        state = state.reported(
            "note",
            f"It lies {distance:.3g} units from the origin, {origin_distance:.0f} times its own size{grid}.",
            "It is moved to its centroid in double precision before fitting, and back afterwards.",
        )
    if state.faces is None:
        state = state.reported("note", "It has no triangles: a point cloud.", "Distances are measured to its points.")
    return state


def _float32_rounding(vertices: FloatArray) -> float | None:
    """Return the rounding error of coordinates that are stored as float32, in their unit; None if they are not."""
    largest = np.abs(vertices).max()
    in_range = bool((np.abs(vertices) <= np.finfo(np.float32).max).all())
    if not in_range or not np.array_equal(vertices.astype(np.float32), vertices):
        return None
    return float(largest) * float(np.finfo(np.float32).eps)


def _find_degeneracy(state: _RepairState, spread: FloatArray, tolerance: float) -> tuple[str, str] | None:
    """Return the problem of points with these singular values (3,) and the action of the user, or None."""
    if len(state.vertices) == 1:
        return "All its points are equal.", "give a scan of a surface."
    if spread[1] <= tolerance * float(spread[0]):
        return "All its points lie on a line.", "give a scan of a surface."
    if state.faces is not None and len(state.faces) <= 1:
        count = "only one triangle" if len(state.faces) else "no triangle that has an area"
        return f"It has {count}.", "give a scan of a complete surface."
    if len(state.vertices) < 4:
        return f"It has only {len(state.vertices)} different points.", "give at least 4, not on a plane."
    if spread[2] <= tolerance * float(spread[0]):
        return "All its points lie on a plane.", "give a scan of a surface with some depth."
    return None


def _inspect_surface(state: _RepairState) -> _RepairState:
    """Count edges and pieces, and make the winding consistent and outward."""
    from shapespace.geometry import topology  # compiled

    assert state.faces is not None
    edges = _Edges.of(state.faces, len(state.vertices))
    state = state.measured(
        boundary_edges=edges.boundary,
        non_manifold_edges=edges.non_manifold,
        inconsistent_edges=int(edges.same_way.sum()),
    )
    if edges.non_manifold:
        state = state.reported(
            "note",
            f"{_format_count(edges.non_manifold, 'edge has', 'edges have')} more than two triangles.",
            "They are kept; winding is not made consistent across them.",
        )
    if state.report.inconsistent_edges:
        state, edges = _cut_glued_edges(state, edges)
        state = _make_winding_consistent(state, edges)
    assert state.faces is not None
    vertices = np.array(state.vertices)
    middles, normals = topology.middles_and_normals(vertices, state.faces, vertices.mean(axis=0))
    state = _turn_outward(state, edges, middles, normals)
    assert state.faces is not None
    components, pieces = _components(len(vertices), state.faces[:, :2], state.faces[:, 1:])
    areas = _lengths(normals)
    share = float(np.bincount(pieces[state.faces[:, 0]], weights=areas).max() / areas.sum())
    state = state.measured(components=components, largest_component_share=share)
    if components > 1:
        problem = f"It has {components} separate pieces; the largest has {100 * share:.1f} % of the area."
        state = state.reported("note", problem, "All are kept.")
    return state


def _cut_glued_edges(state: _RepairState, edges: _Edges) -> tuple[_RepairState, _Edges]:
    """Separate pieces of opposite winding that are joined only because their vertices were merged.

    In a triangle soup, merging joins every edge, and winding is the only information.
    """
    assert state.faces_in_file is not None
    first, second = state.faces_in_file[edges.pairs].swapaxes(0, 1)
    glued = (first[:, :, None] == second[:, None, :]).sum(axis=(1, 2)) < 2
    seam = glued & edges.same_way
    if glued.mean() >= 0.5 or not seam.any():
        return state, edges
    problem = f"At {_format_count(int(seam.sum()), 'edge', 'edges')}, pieces with opposite winding touch."
    return state.reported("note", problem, "They are kept; winding is not made consistent across them."), edges.without(
        seam
    )


def _make_winding_consistent(state: _RepairState, edges: _Edges) -> _RepairState:
    """Make winding consistent in each patch by reversing the smaller set of triangles."""
    assert state.faces is not None
    n = len(state.faces)
    # Each triangle has two nodes, unchanged (i) and reversed (i + n); an edge links nodes of consistent winding.
    # An orientable patch consists of two separate components; a Moebius strip of a single component.
    a, b = edges.pairs.T
    shift = np.where(edges.same_way, n, 0)
    _, label = _components(2 * n, np.stack([a, b + shift], axis=1), np.stack([a + n, b + n - shift], axis=1))
    as_is, turned = label[:n], label[n:]
    size = np.bincount(as_is, minlength=int(label.max()) + 1)
    smaller = (size[as_is] < size[turned]) | ((size[as_is] == size[turned]) & (as_is > turned))
    one_sided = int((as_is == turned).sum())
    flip = smaller & (as_is != turned)
    if flip.any():
        problem = (
            f"{_format_count(int(flip.sum()), 'triangle has', 'triangles have')} a winding opposite to the neighbours."
        )
        state = state.with_triangles_reversed(flip).reported("fixed", problem, "Their winding is reversed.")
    if one_sided:
        state = state.reported(
            "note",
            f"{_format_count(one_sided, 'triangle is', 'triangles are')} on a one-sided surface (a Moebius strip).",
            "They are unchanged; their normals are not reliable.",
        )
    return state


def _turn_outward(state: _RepairState, edges: _Edges, middles: FloatArray, normals: FloatArray) -> _RepairState:
    """Reverse closed patches with negative volume, and the open surface if its normals point inward.

    Args:
        state: mesh with consistent winding in each patch.
        edges: edges of the triangles of `state`.
        middles: (F, 3) centroids of the triangles, relative to the centroid of the vertices.
        normals: (F, 3) normals of the triangles, with the area as length.
    """
    count, patch = edges.patches()
    closed = np.ones(count, dtype=np.bool_)
    closed[patch[edges.loose]] = False
    if closed.any() and (inside_out := _find_inside_out(closed, patch, middles, normals)).any():
        problem = f"{_format_count(int(inside_out.sum()), 'closed piece is', 'closed pieces are')} inside out."
        action = "Its winding is reversed." if inside_out.sum() == 1 else "Their winding is reversed."
        state = state.with_triangles_reversed(inside_out[patch]).reported("fixed", problem, action)
    # Patches of a scan come from one scanner, so open patches are tested and reversed together.
    is_open = ~closed[patch]
    if is_open.any() and _points_inward(is_open, middles, normals):
        problem = "The normals of the open surface point inward, so its winding is probably reversed."
        state = state.with_triangles_reversed(is_open).reported("fixed", problem, "Its winding is reversed.")
    return state


def _find_inside_out(closed: BoolArray, patch: IntArray, middles: FloatArray, normals: FloatArray) -> BoolArray:
    """Return the mask (P,) of `closed` patches (P,) that have a negative volume and are not the wall of a cavity."""
    from shapespace.geometry import topology  # compiled

    count, areas = len(closed), _lengths(normals)
    area = np.bincount(patch, weights=areas, minlength=count)
    centre = np.stack(
        [np.bincount(patch, weights=areas * middles[:, k], minlength=count) / area for k in range(3)], axis=1
    )
    outward = np.einsum("fi,fi->f", normals, middles - centre[patch])
    volume = np.bincount(patch, weights=outward, minlength=count) / 3
    biggest = int(np.argmax(np.where(closed, np.abs(volume), -1.0)))
    low, high = topology.boxes_of(middles, patch, count)
    # The normals of the wall of a cavity correctly point inward.
    cavity = (low > low[biggest]).all(axis=1) & (high < high[biggest]).all(axis=1)
    return np.asarray(closed & (volume < 0) & ~cavity)


def _points_inward(is_open: BoolArray, middles: FloatArray, normals: FloatArray) -> bool:
    """Return whether the normals of the triangles `is_open` (F,) point inward."""
    weight = np.where(is_open, _lengths(normals), 0.0)
    arm = middles - weight @ middles / weight.sum()
    reach = float(weight @ _lengths(arm))
    outward = np.where(is_open, np.einsum("fi,fi->f", normals, arm), 0.0)
    return (float(outward.sum()) / reach if reach > 0 else 0.0) < _REVERSED


@dataclass(frozen=True, eq=False)
class _Edges:
    """The edges of F triangles.

    Args:
        n_faces: number of triangles, F.
        pairs: (E, 2) triangles at each manifold edge.
        same_way: (E,) whether both triangles pass the edge in the same direction, so that one is reversed.
        loose: (L,) triangles at all other edges.
        boundary: number of edges with one triangle.
        non_manifold: number of edges with more than two triangles.
    """

    n_faces: int
    pairs: IntArray
    same_way: BoolArray
    loose: IntArray
    boundary: int
    non_manifold: int

    @staticmethod
    def of(faces: IntArray, vertices: int) -> _Edges:
        from shapespace.geometry import topology  # compiled

        pairs, same_way, loose, boundary, non_manifold = topology.meeting_triangles(faces, vertices)
        return _Edges(len(faces), pairs, same_way, loose, boundary, non_manifold)

    def without(self, seam: BoolArray) -> _Edges:
        """Return the edges without the pairs `seam` (E,)."""
        loose = np.concatenate([self.loose, self.pairs[seam].ravel()])
        return replace(self, pairs=self.pairs[~seam], same_way=self.same_way[~seam], loose=loose)

    def patches(self) -> tuple[int, IntArray]:
        """Return the number of patches, connected by manifold edges, and the patch (F,) of each triangle."""
        return _components(self.n_faces, self.pairs)


def _components(nodes: int, *links: IntArray) -> tuple[int, IntArray]:
    """Return the number of connected components and the component (nodes,) of each node; `links` are (E, 2)."""
    from shapespace.geometry import topology  # compiled

    parent = np.arange(nodes, dtype=np.int32)
    for ties in links:
        topology.join(parent, np.require(ties, np.int32, ["C", "W"]))
    return topology.labels(parent)


def _equal_rows(rows: npt.NDArray[np.int64] | IntArray) -> tuple[IntArray, IntArray]:
    """Return the first index of each distinct row of `rows` (N, 3), in order, and the distinct row (N,) of each row."""
    from shapespace.geometry import topology  # compiled

    first = topology.first_of_equal(rows)
    is_first = first == np.arange(len(rows), dtype=np.int32)
    return np.flatnonzero(is_first).astype(np.int32), (np.cumsum(is_first, dtype=np.int32) - 1)[first]


def _finite_vertices(vertices: FloatArray) -> BoolArray:
    """Return the mask (V,) of vertices with finite coordinates; the usual case, in which all are, takes one pass."""
    if np.isfinite(vertices).all():
        return np.ones(len(vertices), dtype=np.bool_)
    return np.asarray(np.isfinite(vertices).all(axis=1))


def _bounds(points: FloatArray) -> FloatArray:
    """Return (2, 3): the lowest and the highest coordinates of `points` (N, 3), at least one."""
    columns = np.ascontiguousarray(points.T)  # NumPy is 20 times slower along the columns of an (N, 3) array
    return np.stack([columns.min(axis=1), columns.max(axis=1)])


def _lengths(vectors: FloatArray) -> FloatArray:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def _format_count(count: int, singular: str, plural: str) -> str:
    return f"{count} {singular if count == 1 else plural}"
