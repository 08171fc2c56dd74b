"""Symmetric templates: the mean of a surface and its mirror image, with vertices in pairs and on the mirror plane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shapespace.correspondence.register import ElasticSettings, Template, register
from shapespace.correspondence.settings import SIZE
from shapespace.correspondence.template import check_template
from shapespace.errors import InputError, MeshError
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.closest import on_boundary
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.mirror_plane import (
    FLIP,
    LARGEST_PAIR_SHARE,
    SYMMETRIC_SHARE,
    SurfaceMirror,
    find_mirror,
    mirror_image,
    pairs_of_triangles,
    plane_of_pairs,
)
from shapespace.geometry.normals import face_areas, faces_of, rms_size
from shapespace.geometry.remesh import is_sheet
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

_LARGEST_SHARE, _OTHER_PLANES = 2 * SYMMETRIC_SHARE, 0.4
"""Share of the size, and ratio to that of the best other plane, up to which a surface is symmetric although it is more
than `SYMMETRIC_SHARE` off. Single faces and skulls have ratios up to 0.29, organs, spleens, femora, hippocampi and
molars of 0.52 or more; a real face is 3.3 % of its size off, a fragment of a femur with the ratio 0.32 is 4.5 % off."""
_HARMONICS = 100
"""The sides of a face, paired with 400 functions, are 0.10 mm off before the last projection, with 100 0.17 mm."""
_SNAPPED = 0.25
"""A vertex closer to the plane than this share of an edge across it is moved to it, so that no triangle is thin."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SymmetricMesh:
    """A surface that equals its mirror image, vertex for vertex and triangle for triangle.

    Args:
        mesh: V vertices: first those on the plane, then those of one side, then their partners in the same order. The
            second half of the triangles mirrors the first.
        pairs: (V,) int32 partner of each vertex; a vertex on the plane is its own.
        landmark_pairs: name -> name of the landmark on the other side; a landmark on the plane is its own. Landmarks
            without a partner are missing.
        point: (3,) on the mirror plane.
        normal: (3,) unit normal of the plane, towards the side of the first half.
        asymmetry: RMS distance of the given surface from its mirror image, in the unit of its vertices.
        asymmetry_share: the same as a share of its size (RMS distance from its centre).

    Example:
        >>> symmetric = ss.correspondence.symmetrise(meshes[0])
        >>> bool((symmetric.pairs[symmetric.pairs] == np.arange(len(symmetric.pairs))).all())
        True
    """

    mesh: Mesh
    pairs: IntArray
    landmark_pairs: Mapping[str, str]
    point: FloatArray
    normal: FloatArray
    asymmetry: float
    asymmetry_share: float

    __repr__ = short_repr

    @property
    def midline(self) -> BoolArray:
        """(V,) whether a vertex is on the mirror plane."""
        return self.pairs == np.arange(len(self.pairs))


def symmetrise(mesh: Mesh) -> SymmetricMesh:
    """Return the mean of a surface and its mirror image, with vertices in left and right pairs and on the midline.

    The surface is registered to its mirror image at the plane of `find_mirror`, and each vertex moves half way to its
    position there. The mean is cut at the plane of these pairs, and the side with the larger area is mirrored.
    Landmarks are averaged with their partners on the other side.

    Args:
        mesh: surface with triangles and mirror symmetry, such as a face or a skull, in any pose and unit. A part that
            is missing on one side is taken from the other one.

    Raises:
        InputError: the surface has no mirror symmetry.
        MeshError: it has no triangles, fewer than 100 vertices, or edges that more than two triangles share.
    """
    mesh = check_template(mesh)
    if not is_sheet(faces_of(mesh)):
        raise MeshError(
            f"{mesh.name}: more than two triangles share an edge, or neighbours disagree on which side is outside; "
            "clean the mesh in MeshLab (Cleaning) first."
        )
    mirror = find_mirror(mesh)
    _check_symmetry(mirror, mesh.name)
    faces, size = faces_of(mesh), rms_size(mesh.vertices)
    side = np.sign(mesh.vertices @ mirror.normal - mirror.offset)[faces].sum(axis=1)
    larger = -1.0 if float(face_areas(mesh) @ side) < 0 else 1.0
    T = _plane_frame(mesh.vertices, larger * mirror.normal, larger * mirror.offset, SIZE / size)
    own = mesh.with_vertices(T.apply(mesh.vertices))
    image, is_paired = _register_to_image(own, mirror_image(own))
    # The mirror image at the plane of these pairs follows from the one at the first plane.
    normal, offset = plane_of_pairs(own.vertices[is_paired], image[is_paired] * FLIP)
    towards = np.sign(normal[0])
    T_plane = _plane_frame(own.vertices, towards * normal, towards * offset, 1.0)
    vertices = (T_plane.apply(own.vertices) + T_plane.apply(image * FLIP) * FLIP) / 2.0
    T_input_plane = (T_plane @ T).inverse()
    landmarks, landmark_pairs = _average_landmarks(place_landmarks(mesh, mesh.landmarks).positions(vertices))
    vertices, faces, origin = _mirrored_half(vertices, faces, mesh.name)
    pairs = pairs_of_triangles(faces, len(vertices))
    assert pairs is not None
    symmetric = Mesh(
        T_input_plane.apply(vertices), faces, {name: T_input_plane.apply(p) for name, p in landmarks.items()},
        mesh.name, None if mesh.colours is None else mesh.colours[origin], mesh.notes,
        None if mesh.observed is None else mesh.observed[origin],
    )  # fmt: skip
    return SymmetricMesh(
        mesh=symmetric, pairs=pairs, landmark_pairs=landmark_pairs, point=T_input_plane.translation,
        normal=T_input_plane.rotation[:, 0], asymmetry=mirror.off_share * size, asymmetry_share=mirror.off_share,
    )  # fmt: skip


def _check_symmetry(mirror: SurfaceMirror, name: str) -> None:
    """Check that a surface has mirror symmetry.

    Raises:
        InputError: it has no mirror symmetry.
    """
    share, other = mirror.off_share, min(mirror.others_share, default=np.inf)
    if share > SYMMETRIC_SHARE and (share > _LARGEST_SHARE or share > _OTHER_PLANES * other):
        raise InputError(
            f"{name} has no mirror symmetry: it differs from its mirror image by {100 * share:.1f} % of its size, and "
            f"{100 * SYMMETRIC_SHARE:.0f} % is the limit, or {100 * _LARGEST_SHARE:.0f} % if no other plane is nearly "
            "as good; use it unchanged, or give a more symmetric object."
        )


def _plane_frame(vertices: FloatArray, normal: FloatArray, offset: float, scale: float) -> Similarity:
    """Return the similarity to a frame with a plane at x = 0 and the centre of `vertices`, projected onto it, at 0."""
    rotation = np.linalg.svd(normal[None])[2]
    rotation[0] = normal
    rotation[2] *= np.linalg.det(rotation)
    centre = vertices.mean(axis=0)
    return Similarity(scale, rotation, -scale * rotation @ (centre - (normal @ centre - offset) * normal))


def _register_to_image(mesh: Mesh, image: Mesh) -> tuple[FloatArray, BoolArray]:
    """Return the position (V, 3) of each vertex on the mirror image, and whether (V,) the image is observed there."""
    target = ScanTarget(image)
    settings = ElasticSettings(harmonics=_HARMONICS)
    state = register(Template.of(mesh, settings.harmonics), target, Similarity.identity(), settings)
    moved = state.T_scan_template.apply(state.vertices)
    nearest = target.engine.query(moved)
    observed = ~on_boundary(nearest, image, target.rim)
    return np.where(observed[:, None], nearest.points, moved), observed


def _average_landmarks(positions: Mapping[str, FloatArray]) -> tuple[dict[str, FloatArray], dict[str, str]]:
    """Return landmarks averaged with the mirror images of their partners at x = 0, and name -> name of the partner.

    Two landmarks are partners if each is the closest to the mirror image of the other. Others remain as they are.
    """
    if not positions:
        return {}, {}
    names, points = list(positions), np.array(list(positions.values()))
    distance, nearest = map(np.asarray, cKDTree(points).query(points * FLIP))
    paired = (nearest[nearest] == np.arange(len(names))) & (distance <= LARGEST_PAIR_SHARE * SIZE)
    points = np.where(paired[:, None], (points + points[nearest] * FLIP) / 2.0, points)
    partners = {name: names[int(nearest[k])] for k, name in enumerate(names) if paired[k]}
    return dict(zip(names, points, strict=True)), partners


def _mirrored_half(vertices: FloatArray, faces: IntArray, name: str) -> tuple[FloatArray, IntArray, IntArray]:
    """Return a surface that consists of the half of a surface with x > 0 and of the mirror image of this half.

    Returns:
        (W, 3) vertices in the order of `SymmetricMesh`, (G, 3) triangles, and (W,) the vertex each of them is from.

    Raises:
        MeshError: the surface cannot be cut.
    """
    x = vertices[:, 0]
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    a, b = edges[x[edges].prod(axis=1) < 0].T
    snapped = np.zeros(len(x), dtype=np.bool_)
    for end, other in ((a, b), (b, a)):
        snapped[end[np.abs(x[end]) < _SNAPPED * np.abs(x[end] - x[other])]] = True
    while True:
        half, triangles, origin = _cut_at_plane(np.where(snapped[:, None], vertices * [0.0, 1.0, 1.0], vertices), faces)
        count, on_plane = len(half), half[:, 0] == 0.0
        middle = int(on_plane.sum())
        order = np.argsort(~on_plane, kind="stable")
        triangles = np.argsort(order)[triangles]
        mirrored = np.where(triangles < middle, triangles, triangles + count - middle)[:, ::-1]
        both, origin = np.concatenate([triangles, mirrored]).astype(np.int32), origin[order]
        if is_sheet(both):
            break
        # If the surface is almost in the plane, vertices that were moved to it join parts that are separate.
        ends = both[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        _, first, often = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
        wrong = ends[often[first] > 1].ravel()
        wrong = origin[wrong[wrong < middle]]
        if not snapped[wrong].any():
            raise MeshError(f"{name} cannot be cut at its mirror plane; clean the mesh in MeshLab (Cleaning) first.")
        snapped[wrong] = False
    half = half[order]
    return np.concatenate([half, half[middle:] * FLIP]), both, np.concatenate([origin, origin[middle:]])


def _cut_at_plane(vertices: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
    """Return the part of a surface with x >= 0 and triangles not in the plane x = 0, cut at that plane.

    Returns:
        (H, 3) vertices, exactly on the plane where it was cut, (G, 3) triangles, and (H,) the closest vertex of the
        surface of each.
    """
    x = vertices[:, 0]
    low, high = x[faces].min(axis=1), x[faces].max(axis=1)
    triangles = faces[(low >= 0) & (high > 0)].tolist()
    cuts: dict[tuple[int, int], int] = {}
    for face in faces[(low < 0) & (high > 0)].tolist():
        corners: list[int] = []
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            corners += [a] if x[a] >= 0 else []
            if x[a] * x[b] < 0:
                corners.append(cuts.setdefault((min(a, b), max(a, b)), len(x) + len(cuts)))
        triangles += [[corners[0], corners[k], corners[k + 1]] for k in range(1, len(corners) - 1)]
    ends = np.array(list(cuts), dtype=np.int64).reshape(-1, 2)
    share = np.abs(x[ends]) / np.abs(x[ends]).sum(axis=1, keepdims=True)
    points = share[:, 1:] * vertices[ends[:, 0]] + share[:, :1] * vertices[ends[:, 1]]
    origin = np.concatenate([np.arange(len(x)), ends[np.arange(len(ends)), share.argmin(axis=1)]])
    used, kept = np.unique(triangles, return_inverse=True)
    points = np.concatenate([vertices, points * [0.0, 1.0, 1.0]])[used]
    return points, kept.reshape(-1, 3).astype(np.int32), origin[used].astype(np.int32)
