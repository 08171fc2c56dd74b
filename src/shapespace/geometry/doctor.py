"""The mesh doctor: what is in a scan, what is wrong with it, and the repairs that cannot do harm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from shapespace.errors import MeshError
from shapespace.geometry.normals import without_vertices
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh

NON_FINITE = "coordinates that are NaN or infinite"
"""Text of findings on vertices without a position."""

# Twice the area of a triangle over its longest edge squared; float64 cannot tell less from a line.
_DEGENERATE = 1e-12
# Smallest over largest spread below which points lie on a plane, and second over largest for a line.
_FLAT = 1e-6
# Squares and cubes of coordinates must stay within float64.
_ABSURD = 1e80
# Distance from the origin, over the size, from which coordinates stored as float32 get coarse.
_FAR = 100.0
# How far the normals of an open surface must point to its inside before it is turned: a convex cap gives
# +0.3 or more, and a surface that is as much bowl as cap gives 0.
_REVERSED = -0.05


@dataclass(frozen=True)
class Finding:
    """One thing the doctor found.

    Args:
        level: "fixed" (repaired), "note" (left as it is) or "refused" (cannot be fitted).
        what: a sentence on what is there.
        action: a sentence on what fitting does about it, or for "refused", what the user can do.
    """

    level: Literal["fixed", "note", "refused"]
    what: str
    action: str


@dataclass(frozen=True, eq=False)
class MeshReport:
    """What is in a mesh, as it is in its file.

    Args:
        name: the mesh's name.
        vertices: number of vertices.
        triangles: number of triangles; 0 for a point cloud.
        bounds: (2, 3) float64 lowest and highest finite coordinates, in the mesh's unit; NaN if there are none.
        extent: (3,) float64 size along the axes, in the mesh's unit.
        components: number of connected pieces of surface; 0 for a point cloud.
        largest_component_share: the share of the area that the largest piece has, 0 to 1.
        boundary_edges: edges with one triangle; 0 means the surface is closed.
        non_manifold_edges: edges with more than two triangles.
        duplicate_vertices: vertices that lie exactly on an earlier one.
        unreferenced_vertices: vertices that no triangle uses; 0 for a point cloud.
        degenerate_triangles: triangles without area.
        duplicate_triangles: triangles on the same three points as an earlier one.
        non_finite_vertices: vertices with a coordinate that is NaN or infinite.
        inconsistent_edges: edges whose two triangles wind against each other.
        reversed_triangles: triangles that the repair turns round.
        planarity: smallest over largest singular value of the centred points: 0 on a plane.
        origin_distance: distance of the centroid from the origin over the diagonal of the bounds.
        findings: everything worth saying, in the order in which it was found.
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
        """Whether fitting takes the mesh."""
        return all(finding.level != "refused" for finding in self.findings)


def examine(mesh: Mesh, *, strict: bool = False) -> MeshReport:
    """Return what is in `mesh`, what is wrong with it and what fitting does about it; nothing is refused here.

    Edges, pieces and winding are those of the repaired mesh, since without merging equal vertices a soup of
    triangles has as many pieces as triangles.

    Args:
        mesh: any mesh, also one without points or with NaN in it.
        strict: whether triangles that use vertices with non-finite coordinates are a reason to refuse the mesh.
    """
    return _Doctor(mesh, strict=strict).report()


def repair(mesh: Mesh, *, strict: bool = False) -> tuple[Mesh, tuple[Finding, ...]]:
    """Fix what can be fixed safely and refuse what cannot be fitted.

    Vertices with non-finite coordinates are removed, with the triangles that use them. Exactly equal vertices are
    merged. Triangles without area, repeated triangles, and vertices that no triangle uses are dropped. Winding is made
    consistent and turned outward. Several pieces, non-manifold edges and a far origin are kept and noted.

    Args:
        mesh: a scan as read. The numbering of its vertices does not survive; its landmarks and name do.
        strict: refuse a mesh with triangles that use vertices with non-finite coordinates, instead of removing them.

    Returns:
        The repaired mesh (`mesh` itself where there was nothing to do), and the findings.

    Raises:
        MeshError: it cannot be fitted; the one sentence names it and says what to do.
    """
    doctor = _Doctor(mesh, strict=strict)
    for finding in doctor.findings:
        if finding.level == "refused":
            raise MeshError(f"{mesh.name}: {finding.what[0].lower()}{finding.what[1:-1]}; {finding.action}")
    return doctor.repaired(), tuple(doctor.findings)


class _Doctor:
    """One pass over a mesh that repairs as it goes and counts what it met."""

    def __init__(self, mesh: Mesh, *, strict: bool) -> None:
        self.mesh = mesh
        self.strict = strict
        self.findings: list[Finding] = []
        self.vertices = mesh.vertices
        self.colours = mesh.colours
        self.faces: IntArray | None = None if mesh.faces is None else np.array(mesh.faces)
        self.in_file = self.faces
        """The triangles in the numbering of the file, in step with `faces`."""
        self.changed = False
        self.non_finite = self.duplicates = self.unreferenced = self.degenerate = self.repeated = 0
        self.components = self.boundary = self.non_manifold = self.inconsistent = self.turned = 0
        self.share = 1.0 if self.faces is not None else 0.0
        self.planarity = self.origin_distance = float("nan")
        finite = _finite(mesh.vertices)
        self.finite = finite
        if self._drop_non_finite(finite):
            self._run()

    def _run(self) -> None:
        if not len(self.vertices):
            return self._refuse("There are no points in it.", "export the scan again.")
        if np.abs(self.vertices).max() > _ABSURD:
            return self._refuse("Its coordinates are too large to be lengths.", "export the scan again.")
        self._merge_vertices()
        if self.faces is not None:
            self._drop_triangles()
            self._drop_unreferenced()
        self._measure_spread()
        if self.faces is not None and len(self.faces):
            self._inspect_surface()
        return None

    def _refuse(self, what: str, action: str) -> None:
        self.findings.append(Finding("refused", what, action))

    def _fixed(self, what: str, action: str) -> None:
        self.changed = True
        self.findings.append(Finding("fixed", what, action))

    def _note(self, what: str, action: str) -> None:
        self.findings.append(Finding("note", what, action))

    def _drop_non_finite(self, finite: BoolArray) -> bool:
        """Remove vertices that are not finite, and triangles that use them; return whether the rest can go on."""
        bad = int((~finite).sum())
        self.non_finite = bad
        if not bad:
            return True
        what = f"It has {_some(bad, 'vertex', 'vertices')} with {NON_FINITE}"
        whole = None if self.faces is None else np.asarray(finite[self.faces].all(axis=1))
        lost = 0 if whole is None else int((~whole).sum())
        if whole is None or not lost:
            self._keep_vertices(finite)
            self._fixed(f"{what}.", "They are missing points that no triangle uses, and are dropped.")
            return True
        what += f", used by {_some(lost, 'triangle', 'triangles')}."
        if self.strict:
            self._refuse(what, "export the scan again without them, or leave out --strict to remove them.")
            return False
        self._keep_triangles(whole)
        self._keep_vertices(finite)
        self._fixed(what, "They are removed together, which leaves a hole.")
        return True

    def _keep_vertices(self, keep: BoolArray) -> None:
        self.colours = None if self.colours is None else self.colours[keep]
        if self.faces is None:
            self.vertices = self.vertices[keep]
        else:
            self.vertices, self.faces = without_vertices(self.vertices, self.faces, keep)

    def _keep_triangles(self, keep: BoolArray | IntArray) -> None:
        assert self.faces is not None and self.in_file is not None
        self.faces, self.in_file = self.faces[keep], self.in_file[keep]

    def _merge_vertices(self) -> None:
        first, index = _equal_rows((self.vertices + 0.0).view(np.int64))  # 0 and -0 have other bits
        self.duplicates = len(self.vertices) - len(first)
        if self.duplicates:
            self.vertices = self.vertices[first]
            self.colours = None if self.colours is None else self.colours[first]
            self.faces = None if self.faces is None else index[self.faces]
            self._fixed(
                f"{_some(self.duplicates, 'vertex lies', 'vertices lie')} exactly on another.",
                "Equal vertices are merged into one.",
            )

    def _drop_triangles(self) -> None:
        from shapespace.geometry import topology  # compiled

        assert self.faces is not None
        flat = topology.flat_triangles(np.array(self.vertices), self.faces, _DEGENERATE)
        self.degenerate = int(flat.sum())
        if self.degenerate:
            self._keep_triangles(~flat)
            self._fixed(f"{_some(self.degenerate, 'triangle has', 'triangles have')} no area.", "They are dropped.")
        if len(self.faces):
            ranked = np.sort(self.faces, axis=1)
            first, _ = _equal_rows(ranked)
            self.repeated = len(self.faces) - len(first)
            if self.repeated:
                self._keep_triangles(first)
                self._fixed(
                    f"{_some(self.repeated, 'triangle repeats', 'triangles repeat')} an earlier one.",
                    "Only the first of each is kept.",
                )

    def _drop_unreferenced(self) -> None:
        assert self.faces is not None
        if not len(self.faces):
            return
        used = np.zeros(len(self.vertices), dtype=np.bool_)
        used[self.faces] = True
        self.unreferenced = int((~used).sum())
        if self.unreferenced:
            self._keep_vertices(used)
            self._fixed(
                f"{_some(self.unreferenced, 'vertex belongs', 'vertices belong')} to no triangle.",
                "They are not part of the surface, and are dropped.",
            )

    def _measure_spread(self) -> None:
        """Refuse what spans no space; note what lies far from the origin."""
        vertices = self.vertices
        centre = vertices.mean(axis=0)
        centred = vertices - centre
        # The eigenvalues of the 3 x 3 covariance would lose half of the digits; R of QR keeps them.
        spread = np.linalg.svd(np.linalg.qr(centred, mode="r"), compute_uv=False)
        spread = np.concatenate([spread, np.zeros(3 - len(spread))])
        largest = float(spread[0])
        self.planarity = float(spread[2]) / largest if largest > 0 else 0.0
        diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        far = float(np.linalg.norm(centre))
        self.origin_distance = far / diagonal if diagonal > 0 else float("inf")
        tolerance = _FLAT
        coarse = float(np.abs(vertices).max()) * float(np.finfo(np.float32).eps)
        stored_single = bool((np.abs(vertices) <= np.finfo(np.float32).max).all()) and np.array_equal(
            vertices.astype(np.float32), vertices
        )
        if stored_single and largest > 0:
            # Rounding to float32 lifts a plane off itself by up to this much.
            tolerance = max(tolerance, coarse * float(np.sqrt(len(vertices))) / largest)
        if len(vertices) == 1:
            self._refuse("All its points are equal.", "give a scan of a surface.")
        elif spread[1] <= tolerance * largest:
            self._refuse("All its points lie on a line.", "give a scan of a surface.")
        elif self.faces is not None and len(self.faces) <= 1:
            count = "only one triangle" if len(self.faces) else "no triangle that has an area"
            self._refuse(f"It has {count}.", "give a scan of a whole surface.")
        elif len(vertices) < 4:
            self._refuse(f"It has only {len(vertices)} different points.", "give at least 4, not on a plane.")
        elif spread[2] <= tolerance * largest:
            self._refuse("All its points lie on a plane.", "give a scan of a surface with some depth.")
        if diagonal > 0 and self.origin_distance > _FAR:
            grid = f", on a grid of about {coarse:.2g}" if stored_single else ""
            self._note(
                f"It lies {far:.3g} units from the origin, {self.origin_distance:.0f} times its own size{grid}.",
                "It is moved to its centroid in double precision before fitting, and back after.",
            )
        if self.faces is None:
            self._note("It has no triangles: a point cloud.", "Distances are measured to its points.")

    def _inspect_surface(self) -> None:
        from shapespace.geometry import topology  # compiled

        assert self.faces is not None
        edges = _Edges(self.faces, len(self.vertices))
        self.boundary, self.non_manifold = edges.boundary, edges.non_manifold
        if self.non_manifold:
            self._note(
                f"{_some(self.non_manifold, 'edge has', 'edges have')} more than two triangles.",
                "They are kept; winding is not carried across them.",
            )
        self.inconsistent = int(edges.same_way.sum())
        self._orient(edges)
        vertices = np.array(self.vertices)
        middles, normals = topology.middles_and_normals(vertices, self.faces, vertices.mean(axis=0))
        self._turn_outward(edges, middles, normals)
        areas = _lengths(normals)
        self.components, pieces = _components(len(self.vertices), self.faces[:, :2], self.faces[:, 1:])
        by_piece = np.bincount(pieces[self.faces[:, 0]], weights=areas)
        self.share = float(by_piece.max() / areas.sum())
        if self.components > 1:
            self._note(
                f"It has {self.components} separate pieces; the largest has {100 * self.share:.1f} % of the area.",
                "All are kept.",
            )

    def _orient(self, edges: _Edges) -> None:
        """Make winding consistent in each patch, turning the smaller side."""
        assert self.faces is not None and self.in_file is not None
        if not self.inconsistent:
            return
        # Where merging glued two pieces that touch, their winding says nothing about each other; in a soup of
        # triangles every edge is glued, and winding is all there is.
        meet = (self.in_file[edges.pairs[:, 0], :, None] == self.in_file[edges.pairs[:, 1], None, :]).sum(axis=(1, 2))
        glued = meet < 2
        if glued.mean() < 0.5 and (glued & edges.same_way).any():
            count = int((glued & edges.same_way).sum())
            edges.cut(glued & edges.same_way)
            self._note(
                f"At {_some(count, 'edge', 'edges')}, pieces that wind against each other touch.",
                "They are kept; winding is not carried across.",
            )
        n = len(self.faces)
        # Each triangle is there twice, as it is (i) and turned (i + n); an edge ties the states that agree.
        # A patch that can be oriented falls into two mirrored halves; a Moebius strip stays in one.
        a, b = edges.pairs.T
        shift = np.where(edges.same_way, n, 0)
        _, label = _components(2 * n, np.stack([a, b + shift], axis=1), np.stack([a + n, b + n - shift], axis=1))
        as_is, turned = label[:n], label[n:]
        size = np.bincount(as_is, minlength=int(label.max()) + 1)
        smaller = (size[as_is] < size[turned]) | ((size[as_is] == size[turned]) & (as_is > turned))
        stuck = int((as_is == turned).sum())
        flip = smaller & (as_is != turned)
        if flip.any():
            self._turn(flip)
            self._fixed(
                f"{_some(int(flip.sum()), 'triangle winds', 'triangles wind')} against the neighbours.",
                "They are turned round.",
            )
        if stuck:
            self._note(
                f"{_some(stuck, 'triangle is', 'triangles are')} on a one-sided surface (a Moebius strip).",
                "They are kept as they are; their normals cannot be trusted.",
            )

    def _turn(self, flip: BoolArray) -> None:
        assert self.faces is not None
        self.faces = np.where(flip[:, None], self.faces[:, ::-1], self.faces)
        self.turned += int(flip.sum())

    def _turn_outward(self, edges: _Edges, middles: FloatArray, normals: FloatArray) -> None:
        """Turn closed patches with negative volume, and the open surface if its normals point inward."""
        assert self.faces is not None
        count, patch = edges.patches()
        closed = np.ones(count, dtype=np.bool_)
        closed[patch[edges.loose]] = False
        areas = _lengths(normals)
        if closed.any():
            self._turn_closed_outward(closed, patch, areas, middles, normals)
        # Patches of one scan come from one scanner, so the open ones are judged and turned together.
        is_open = ~closed[patch]
        if not is_open.any():
            return
        weight = np.where(is_open, areas, 0.0)
        arm = middles - weight @ middles / weight.sum()
        reach = float(weight @ _lengths(arm))
        outward = np.where(is_open, np.einsum("fi,fi->f", normals, arm), 0.0)
        score = float(outward.sum()) / reach if reach > 0 else 0.0
        if score < _REVERSED:
            self._turn(is_open)
            normals[is_open] *= -1
            self._fixed(
                "The normals of the open surface point to its inside, so its winding looks reversed.",
                "Its winding is reversed.",
            )

    def _turn_closed_outward(
        self, closed: BoolArray, patch: IntArray, areas: FloatArray, middles: FloatArray, normals: FloatArray
    ) -> None:
        from shapespace.geometry import topology  # compiled

        count = len(closed)
        area = np.bincount(patch, weights=areas, minlength=count)
        centre = np.stack(
            [np.bincount(patch, weights=areas * middles[:, k], minlength=count) / area for k in range(3)], axis=1
        )
        outward = np.einsum("fi,fi->f", normals, middles - centre[patch])
        volume = np.bincount(patch, weights=outward, minlength=count) / 3
        biggest = int(np.argmax(np.where(closed, np.abs(volume), -1.0)))
        low, high = topology.boxes_of(middles, patch, count)
        # The wall of a cavity rightly looks inward.
        cavity = (low > low[biggest]).all(axis=1) & (high < high[biggest]).all(axis=1)
        inside_out = closed & (volume < 0) & ~cavity
        if inside_out.any():
            self._turn(inside_out[patch])
            normals[inside_out[patch]] *= -1
            self._fixed(
                f"{_some(int(inside_out.sum()), 'closed piece is', 'closed pieces are')} inside out.",
                "Its winding is reversed." if inside_out.sum() == 1 else "Their winding is reversed.",
            )

    def repaired(self) -> Mesh:
        """Return the mesh after the repairs."""
        if not self.changed:
            return self.mesh
        mesh = self.mesh
        return Mesh(self.vertices, self.faces, mesh.landmarks, mesh.name, self.colours, mesh.notes)

    def report(self) -> MeshReport:
        """Return what was found."""
        finite = self.mesh.vertices[self.finite]
        bounds = np.stack([finite.min(axis=0), finite.max(axis=0)]) if len(finite) else np.full((2, 3), np.nan)
        return MeshReport(
            name=self.mesh.name,
            vertices=len(self.mesh.vertices),
            triangles=0 if self.mesh.faces is None else len(self.mesh.faces),
            bounds=bounds,
            extent=bounds[1] - bounds[0],
            components=self.components,
            largest_component_share=self.share,
            boundary_edges=self.boundary,
            non_manifold_edges=self.non_manifold,
            duplicate_vertices=self.duplicates,
            unreferenced_vertices=self.unreferenced,
            degenerate_triangles=self.degenerate,
            duplicate_triangles=self.repeated,
            non_finite_vertices=self.non_finite,
            inconsistent_edges=self.inconsistent,
            reversed_triangles=self.turned,
            planarity=self.planarity,
            origin_distance=self.origin_distance,
            findings=tuple(self.findings),
        )


class _Edges:
    """The edges of triangles (F, 3): how many are boundary or non-manifold, and who meets across the others."""

    def __init__(self, faces: IntArray, vertices: int) -> None:
        from shapespace.geometry import topology  # compiled

        self.faces = len(faces)
        self.pairs, self.same_way, self.loose, self.boundary, self.non_manifold = topology.meeting_triangles(
            faces, vertices
        )
        """`pairs` (E, 2) are the triangles that meet across each manifold edge, `same_way` (E,) whether they run along
        it in the same direction, so that one of them is turned; `loose` are the triangles at all other edges."""

    def cut(self, seam: BoolArray) -> None:
        """Take the pairs where `seam` (E,) as not joined."""
        self.loose = np.concatenate([self.loose, self.pairs[seam].ravel()])
        self.pairs, self.same_way = self.pairs[~seam], self.same_way[~seam]

    def patches(self) -> tuple[int, IntArray]:
        """Return the number of patches joined by manifold edges, and (F,) the patch of each triangle."""
        return _components(self.faces, self.pairs)


def _components(nodes: int, *links: IntArray) -> tuple[int, IntArray]:
    """Return the number of connected components and (nodes,) the component of each; `links` are (E, 2)."""
    from shapespace.geometry import topology  # compiled

    parent = np.arange(nodes, dtype=np.int32)
    for ties in links:
        topology.join(parent, np.require(ties, np.int32, ["C", "W"]))
    return topology.labels(parent)


def _equal_rows(rows: npt.NDArray[np.int64] | IntArray) -> tuple[IntArray, IntArray]:
    """Return where each different row of `rows` (N, 3) first appears, in that order, and (N,) which one each is."""
    from shapespace.geometry import topology  # compiled

    first = topology.first_of_equal(rows)
    is_first = first == np.arange(len(rows), dtype=np.int32)
    return np.flatnonzero(is_first).astype(np.int32), (np.cumsum(is_first, dtype=np.int32) - 1)[first]


def _finite(vertices: FloatArray) -> BoolArray:
    """Return (V,) whether all coordinates are finite; one pass where they are, as nearly always."""
    if np.isfinite(vertices).all():
        return np.ones(len(vertices), dtype=np.bool_)
    return np.asarray(np.isfinite(vertices).all(axis=1))


def _lengths(vectors: FloatArray) -> FloatArray:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def _some(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"
