"""The first template: the scan that is nearest to all others, without holes and evenly meshed.

Before other shapes are known, its shape model has the modes of a smooth Gaussian process on it (C2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.kinds import SAME_KIND
from shapespace.correspondence.settings import LARGEST_ROTATION_DEG, PoseRange
from shapespace.errors import MeshError, ShapespaceError
from shapespace.fit.search.initialisation import Start, start_from_any_pose, start_near_frame
from shapespace.geometry import remesh
from shapespace.geometry.doctor import repair
from shapespace.geometry.grooming import closed_borders, pieces_of
from shapespace.geometry.normals import boundary_edges, face_areas, faces_of, rms_size, without_vertices
from shapespace.geometry.outer_surface import hidden_share, outer_surface
from shapespace.geometry.similarity import small_poses
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Mesh, Similarity

MODES = 60  # slowest harmonics, three coordinates each
RANGE_SHARE = 0.4  # share of the size; range of the smooth deformations (C2)
AMPLITUDE_SHARE = 0.1
"""Range and amplitude of the Gaussian process, as shares of the shape's size."""


def generic_model(mesh: Mesh, harmonics: Harmonics, shapes: FloatArray | None = None) -> ShapeModel:
    """Return `mesh` as the mean of a model whose modes are those of a smooth Gaussian process on it (C2).

    The process diffuses white noise over the surface, alike in all directions (Luthi, Gerig, Jud and Vetter 2018); its
    part that is a similarity transform is removed.

    Args:
        mesh: mean of the model, mm.
        harmonics: harmonics of `mesh`.
        shapes: (N, V, 3) aligned shapes; their variation is added to the modes, and the process keeps a quarter of its
            variance.
    """
    size = rms_size(mesh.vertices)
    slow, vertices = harmonics.slowest(MODES), len(mesh.vertices)
    columns = np.kron(slow.functions * slow.attenuation(RANGE_SHARE * size), np.eye(3))  # C2
    columns *= AMPLITUDE_SHARE * size * np.sqrt(vertices / float((columns**2).sum()))
    if shapes is not None:
        of_shapes = (shapes - shapes.mean(axis=0)).reshape(len(shapes), -1).T / np.sqrt(max(len(shapes) - 1, 1))
        columns = np.column_stack([of_shapes, 0.5 * columns])
    pose = np.linalg.qr(small_poses(mesh.vertices - mesh.vertices.mean(axis=0)))[0]
    columns -= pose @ (pose.T @ columns)
    with threadpool_limits(limits=1, user_api="blas"):  # threads take up to 50 times as long on a busy machine
        basis, stddev, _ = np.linalg.svd(columns, full_matrices=False)
    significant = stddev > 1e-3 * stddev[0]
    basis, stddev = basis[:, significant], stddev[significant]
    return ShapeModel(mesh.vertices.ravel(), basis, stddev, float((stddev**2).sum()), 1, faces=mesh.faces)


_POSE_VERTICES = 1500  # vertices of the coarse mesh for poses, which need no detail; time grows with them
_POSE_HARMONICS = 40  # harmonics on the coarse mesh of the pose model
# scans that may become the template, and scans each one is tried on: 36 registrations at most
_CANDIDATES, _OTHERS = 6, 6
_FEWEST = 100
"""Number of vertices: fewer do not describe an object's shape."""
_AS_WHOLE = 0.93
"""Share of the surface of the most complete candidate; a candidate that shows less lacks a part."""
_INSIDE = 0.05
"""Share of a scan's area that cannot be seen from outside, above which the scan has inner surfaces, as CT scans do."""
_SMALL_HOLE, _LONGEST_HOLE = 0.15, 0.05
"""Holes with a border shorter than this share of the longest border, or of a circle of that size, are closed;
the longest border of all may belong to the object, and must be shorter to be closed."""


@dataclass(frozen=True, eq=False)
class PoseModel:
    """A template with few vertices, as a shape model for the pose search, in mm and in its own size.

    Args:
        model: shape model with generic modes, and those of aligned shapes if there are any.
    """

    model: ShapeModel

    @staticmethod
    def of(mesh: Mesh, shapes: FloatArray | None = None) -> PoseModel:
        """Return the pose model of `mesh`, with the modes of aligned `shapes` (N, V, 3) on the same vertices too.

        Raises:
            MeshError: the mesh is not a sheet.
        """
        parts, own = remesh.parted(faces_of(mesh))
        wanted = round(len(parts) * min(1.0, _POSE_VERTICES / len(own)))
        _, faces, origin = remesh.collapse(mesh.vertices[own], parts, wanted, mesh.name)
        origin = own[origin]
        coarse = Mesh(mesh.vertices[origin], faces.astype(np.int32), name=mesh.name)
        harmonics = Harmonics.of(coarse, _POSE_HARMONICS)
        return PoseModel(generic_model(coarse, harmonics, None if shapes is None else shapes[:, origin]))

    def search(self, vertices_mm: FloatArray, seed: int, *, quick: bool = False, pose: PoseRange = "search") -> Start:
        """Search the poses and sizes of the surface in a scan with `vertices_mm` (S, 3); `quick` for a score alone.

        The score is in mm of this surface.
        """
        size = rms_size(self.model.mean_vertices)
        centre, ratio = np.median(vertices_mm, axis=0), rms_size(vertices_mm) / size
        T = Similarity(1.0 / ratio, np.eye(3), -centre / ratio)
        if pose == "search":
            start = start_from_any_pose(self.model, T.apply(vertices_mm), seed=seed, with_scale=True, quick=quick)
        else:
            largest_deg = LARGEST_ROTATION_DEG[pose]
            start = start_near_frame(self.model, T.apply(vertices_mm), largest_deg=largest_deg, seed=seed)
        back = T.inverse()
        return Start(
            back @ start.T_scan_model, start.how, start.score_mm, start.b, start.runner_up_score_mm,
            tuple(Start(back @ s.T_scan_model, s.how, s.score_mm, s.b) for s in start.alternatives),
        )  # fmt: skip


@dataclass(frozen=True)
class TemplateChoice:
    """Choice of the first template among the scans.

    Args:
        index: index of the chosen scan.
        nearness: (N,) mean distance from a candidate to other scans after smooth adaptation, share of its size;
            not-a-number for scans that were no candidates.
    """

    index: int
    nearness: tuple[float, ...]


def choose_template(scans: Sequence[Mesh], seed: int) -> TemplateChoice:
    """Return which of `scans` is nearest to the others, judged by a few candidates and a few others.

    Candidates are scans with few pieces and short borders, as they are the most complete. A candidate that is more than
    twice as far from the others as the median candidate is another object. If some scans have inner surfaces, all are
    compared by their outer surfaces, and one without inner surfaces is preferred. A candidate that lacks a part shows
    less of the surface than the others do where it lies on them, and is chosen only if all lack as much.

    Raises:
        MeshError: none of the scans can be a template.
    """
    rng = np.random.default_rng(seed)
    incompleteness = np.array([_incompleteness(scan) for scan in scans])
    has_inside = np.array([hidden_share(scan) > _INSIDE for scan in scans])
    usable = np.isfinite(incompleteness)
    is_mixed = bool((usable & ~has_inside).any() and (usable & has_inside).any())
    candidates = _candidates(np.where(has_inside & is_mixed, np.inf, incompleteness), _CANDIDATES, rng)
    others = np.sort(rng.choice(len(scans), min(_OTHERS, len(scans)), replace=False))
    if is_mixed:
        hollow = _candidates(np.where(has_inside, incompleteness, np.inf), _CANDIDATES - len(candidates), rng)
        candidates = np.sort(np.concatenate([candidates, hollow]))
        compared = {*candidates.tolist(), *others.tolist()}
        scans = [outer_surface(s) if has_inside[k] and k in compared else s for k, s in enumerate(scans)]
    nearness, visible = np.full(len(scans), np.nan), np.full(len(scans), np.nan)
    for i in map(int, candidates):
        try:
            pose_model = PoseModel.of(clean_scan(scans[i]))
        except ShapespaceError:
            continue
        size = rms_size(pose_model.model.mean_vertices)
        starts = {j: pose_model.search(np.array(scans[j].vertices), seed) for j in map(int, others) if j != i}
        nearness[i] = float(np.median([start.score_mm / size for start in starts.values()])) if starts else 0.0
        shares = [_area(scans[i]) * s.T_scan_model.scale**2 / _area(scans[j]) for j, s in starts.items()]
        visible[i] = np.median([share for share in shares if np.isfinite(share)] or [1.0])
    if not np.isfinite(nearness).any():
        raise MeshError(
            f"None of the scans can be a template, since none is a sheet of triangles with {_FEWEST} vertices or more; "
            "give --template MESH."
        )
    is_possible = nearness <= SAME_KIND * np.nanmedian(nearness)
    if is_mixed and (is_possible & ~has_inside).any():
        is_possible &= ~has_inside
    is_possible &= visible >= _AS_WHOLE * visible[is_possible].max()
    chosen = int(np.argmin(np.where(is_possible, nearness, np.inf)))
    return TemplateChoice(chosen, tuple(float(share) for share in nearness))


def _candidates(incompleteness: FloatArray, most: int, rng: np.random.Generator) -> npt.NDArray[np.intp]:
    """Return the sorted indices of at most `most` scans, drawn from the most complete ones."""
    candidates = np.argsort(incompleteness, kind="stable")[: max(_CANDIDATES, len(incompleteness) // 2)]
    candidates = candidates[np.isfinite(incompleteness[candidates])]
    return np.sort(rng.choice(candidates, min(most, len(candidates)), replace=False))


def check_template(template: Mesh) -> Mesh:
    """Return the repaired template that the user gave.

    Raises:
        MeshError: it has no triangles, cannot be repaired, or has too few vertices to follow a scan.
    """
    if template.faces is None:
        raise MeshError(
            f"{template.name} is a point cloud, and a template needs triangles; give a mesh, for example the "
            "reconstruction of MeshLab."
        )
    mesh = repair(template)[0]
    if len(mesh.vertices) < _FEWEST:
        raise MeshError(
            f"{template.name} has {len(mesh.vertices)} vertices, and a template needs {_FEWEST} at least; give a finer "
            "mesh."
        )
    return mesh


def clean_scan(scan: Mesh) -> Mesh:
    """Return the largest piece of `scan`, repaired, small holes closed by a fan.

    Raises:
        MeshError: it has no triangles, or cannot be repaired.
    """
    mesh = repair(scan)[0]
    vertices, faces = _largest_piece(mesh.vertices, faces_of(mesh))
    faces, origin = remesh.parted(_without_branches(faces))
    vertices, faces = _largest_piece(vertices[origin], faces.astype(np.int32))
    for hole in _small_holes(vertices, faces):
        fan = np.column_stack([np.roll(hole, -1), hole, np.full(len(hole), len(vertices), dtype=np.int32)])
        vertices = np.concatenate([vertices, vertices[hole].mean(axis=0, keepdims=True)])
        faces = np.concatenate([faces, fan.astype(np.int32)])
    return Mesh(vertices, faces, name=scan.name)


def resample(mesh: Mesh, vertices: int) -> Mesh:
    """Return `mesh` with about that many vertices, evenly spread: split until fine enough, shortest edges collapsed.

    Raises:
        MeshError: it is not a sheet.
    """
    x, faces = np.array(mesh.vertices), faces_of(mesh).astype(np.int64)
    while len(x) < 2 * vertices:
        x, faces = remesh.split(x, faces, mesh.name)
    wanted = round(len(faces) * vertices / len(x))
    coarse, left, _ = remesh.collapse(x, faces, wanted, mesh.name)
    return Mesh(remesh.onto(coarse, mesh.vertices, faces_of(mesh)), left.astype(np.int32), name=mesh.name)


def _area(scan: Mesh) -> float:
    """Return the area of the triangles of `scan`; not-a-number for points."""
    return np.nan if scan.faces is None else float(face_areas(scan).sum())


def _incompleteness(scan: Mesh) -> float:
    """Return a number that grows with the border of `scan`; infinite for a scan that cannot be a template."""
    if scan.faces is None or len(scan.vertices) < _FEWEST:
        return np.inf
    ends = scan.vertices[boundary_edges(scan.faces)]
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum()) / max(rms_size(scan.vertices), 1e-12)


def _largest_piece(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    _, piece = pieces_of(faces, len(vertices))
    largest = np.bincount(piece[faces[:, 0]]).argmax()
    return without_vertices(vertices, faces, piece == largest)


def _without_branches(faces: IntArray) -> IntArray:
    """Return `faces` without those at edges that are passed twice in one direction."""
    count = int(faces.max()) + 1
    key = (faces.astype(np.int64) * count + faces[:, [1, 2, 0]]).ravel()
    _, which, often = np.unique(key, return_inverse=True, return_counts=True)
    return faces[(often[which] == 1).reshape(-1, 3).all(axis=1)]


def _small_holes(vertices: FloatArray, faces: IntArray) -> list[IntArray]:
    loops = closed_borders(faces)
    passed = np.bincount(np.concatenate(loops)) if loops else np.zeros(0, np.int64)
    loops = [loop for loop in loops if (passed[loop] == 1).all()]  # borders that touch are not holes of a sheet
    length = np.array([np.linalg.norm(vertices[loop] - vertices[np.roll(loop, 1)], axis=1).sum() for loop in loops])
    if not len(length):
        return []
    around = max(float(length.max()), 2 * np.pi * rms_size(vertices))
    most = np.full(len(loops), _SMALL_HOLE * around)
    most[length.argmax()] = _LONGEST_HOLE * around
    return [loop for loop, own, limit in zip(loops, length, most, strict=True) if own < limit and len(loop) >= 3]
