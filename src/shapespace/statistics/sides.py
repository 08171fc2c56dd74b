"""Sides of symmetric objects: pairs of mirrored vertices, given or found from the mean, and images of shapes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from shapespace.cohort.cohort import Cohort, padded, subjects_of
from shapespace.cohort.table import list_names
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.landmark_alignment import AlignConfig, superimpose
from shapespace.geometry.mirror_plane import FLIP, SYMMETRIC_SHARE, find_mirror, mirror_pairs, pairs_of_triangles
from shapespace.geometry.normals import rms_size
from shapespace.geometry.procrustes import align_in_place, scale_to_tangent
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.containers.json_files import check_file
from shapespace.io.tables.table_io import read_rows
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, IntArray, Mesh, SurfaceLandmarks

LARGEST_PAIRED_OFF = 0.1
"""Largest `off_share` of given pairs, from vertex to vertex."""
_LARGEST_BYTES = 2**26  # bytes; a table of pairs of millions of vertices is smaller
_FEWEST = 4  # vertices, two pairs: one pair leaves the plane of symmetry to chance
_MIRROR_IMAGE = 0.5
"""The two sides are mirror images if reflection reduces the distance of their means to this share or below."""
_NUMBER = re.compile(r"[0-9]{1,12}")
_SIDE = re.compile(r"(?<![a-z])(?:left|right|l|r)(?![a-z])")
_OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}


@dataclass(frozen=True, eq=False, kw_only=True)
class Sides:
    """Mirror image of each vertex of an object.

    Args:
        vertices: (M,) vertices of the cohort that take part.
        faces: (F, 3) triangles between these vertices; None without triangles.
        corners: (M, 3) numbers among the M vertices; their weighted mean is the mirror image of each vertex.
        weights: (M, 3) weights of the corners; where vertices pair up the first is 1.
        paired: whether vertices pair up, so that the mirror image of the mirror image is the shape itself.
        off_share: RMS distance of the mean from its mirror image, or of the means of two sides, as a share of its size.
        notes: remarks for the user, a sentence each.
        space: dimensions of the coordinates: 2 for planar landmarks.
        classes: the two sides if they are separate shapes (matching symmetry); empty for symmetric objects.
    """

    vertices: IntArray
    faces: IntArray | None
    corners: IntArray
    weights: FloatArray
    paired: bool
    off_share: float
    notes: tuple[str, ...] = ()
    space: Literal[2, 3] = 3
    classes: tuple[str, ...] = ()

    __repr__ = short_repr

    def __len__(self) -> int:
        return len(self.vertices)

    def image(self, fields: FloatArray) -> FloatArray:
        """Return the mirror images (..., M, 3) about x = 0 of shapes, or displacements, (..., M, 3)."""
        if self.paired:
            return fields[..., self.corners[:, 0], :] * FLIP
        return sum(self.weights[:, c, None] * fields[..., self.corners[:, c], :] for c in range(3)) * FLIP

    def chord_heights(self, mean: FloatArray, normals: FloatArray) -> FloatArray:
        """Return the height (M,) of the curved surface above its triangle at the mirror image of each vertex.

        A vertex is on the curved surface, but its mirror image is interpolated on a flat triangle, below the surface.
        Without this height the vertex would seem to be further out than the other side. Near the mirror plane, where
        sides hardly vary, that would look like directional asymmetry. The height is exact for quadratic surfaces: half
        of the projection of Boubekeur and Alexa (Phong tessellation, 2008).

        Args:
            mean: (M, 3) vertices of the mean, mm.
            normals: (M, 3) normals of the mean.
        """
        image = np.einsum("mc,mcd->md", self.weights, mean[self.corners])
        return 0.5 * np.einsum(
            "mc,mcd,mcd->m", self.weights, mean[self.corners] - image[:, None], normals[self.corners], optimize=True
        )

    @cached_property
    def on_the_plane(self) -> float:
        """Number of vertices that are their own mirror image; vertices with a weighted mean count by their weight."""
        return float((self.weights * (self.corners == np.arange(len(self))[:, None])).sum())

    def dimensions(self, *, scaled: bool) -> tuple[float, float]:
        """Return the numbers of dimensions of symmetric and asymmetric variation, without those of pose.

        With l pairs and k vertices on the plane they are 3 l + 2 k less 3, and 3 l + k less 3; of planar landmarks
        2 l + k less 1, and 2 l + k less 2. Symmetric variation has one less if size is divided out (Klingenberg,
        Barluenga and Meyer 2002, table 2). If vertices do not pair up, displacements along the normals count; those on
        the plane are symmetric. Separate sides have all dimensions of a shape.

        Args:
            scaled: whether size is divided out.
        """
        if self.classes:
            shape = self.space * len(self) - (4 if self.space == 2 else 7) + (not scaled)
            return shape, shape
        if self.space == 2:
            return len(self) - (2 if scaled else 1), len(self) - 2  # M12
        half, plane = (1.5 if self.paired else 0.5) * len(self), 0.5 * self.on_the_plane
        return half + plane - (4 if scaled else 3), half - plane - 3


def find_sides(cohort: Cohort) -> Sides:
    """Return the sides of an object from the mean of its cohort, or of the model if the cohort consists of fits.

    Raises:
        InputError: it has no triangles, or it is not symmetric about any plane.
    """
    if cohort.faces is None:
        raise InputError("Landmarks and other points without triangles need --pairs, which names those that mirror "
                         "each other, or --side, the column of the sides of separate shapes.")  # fmt: skip
    if (known := pairs_of_triangles(cohort.faces, cohort.n_vertices)) is not None:
        rows = list(zip(range(len(known)), known.tolist(), strict=True))
        return given_sides(cohort, rows, "The pairs of the symmetric template")
    # A model has more training shapes than most cohorts, so its mean is more symmetric.
    mean = cohort.reference if cohort.fitted is None else cohort.fitted.model.mean_vertices
    mesh = Mesh(mean, cohort.faces, name="mean")
    symmetry = find_mirror(mesh)
    if symmetry.off_share > SYMMETRIC_SHARE:
        raise InputError(
            f"The mean lies {100 * symmetry.off_share:.1f} % of its size from its own mirror image about the best "
            f"plane, and above {100 * SYMMETRIC_SHARE:.0f} % an object, such as a femur, has no mirror symmetry; name "
            "partners with --pairs, or use a symmetric template (correspond --symmetric-template)."
        )
    notes: list[str] = []
    rival = min(symmetry.others_share, default=np.inf)
    if rival <= SYMMETRIC_SHARE:
        notes.append(
            f"The mean has another plane of symmetry, {100 * rival:.2f} % of its size off compared with "
            f"{100 * symmetry.off_share:.2f} %; if you mean that plane, name the pairs with --pairs."
        )
    everything = np.arange(cohort.n_vertices, dtype=np.int32)
    other = mirror_pairs(mesh, symmetry)
    if other is not None:
        return _paired_sides(everything, cohort.faces, other, off_share=symmetry.off_share, notes=tuple(notes))
    notes.append(
        "The vertices of the mean do not pair up, so each is compared with the place nearest to its mirror image; "
        "differences between the mean's sides along the surface cannot be detected, and the Procrustes ANOVA uses only "
        "differences along the normals."
    )
    return Sides(
        vertices=everything, faces=cohort.faces, corners=symmetry.corners, weights=symmetry.weights, paired=False,
        off_share=symmetry.off_share, notes=tuple(notes),
    )  # fmt: skip


def given_sides(cohort: Cohort, pairs: Sequence[tuple[int, int]], where: str = "The pairs") -> Sides:
    """Return the sides that are defined by pairs of vertices.

    In a cohort of landmarks those in no pair lie on the plane of symmetry, as in geomorph; other vertices are excluded.

    Args:
        cohort: cohort of the shapes.
        pairs: pairs of vertices; a vertex on the plane is paired with itself.
        where: name of the pairs in messages.

    Raises:
        InputError: vertices that do not exist or are in two pairs, fewer than four, or pairs about which the mean is
            far from its mirror image.
    """
    other: dict[int, int] = {}
    is_landmarks = cohort.source.kind == "landmarks"
    noun, first = ("landmark", 1) if is_landmarks else ("vertex", 0)
    for a, b in pairs:
        for v in (a, b):
            if not 0 <= v < cohort.n_vertices:
                raise InputError(
                    f"{where}: there is no {noun} {v + first}; they are counted from {first} to "
                    f"{cohort.n_vertices - 1 + first}."
                )
        if other.get(a, b) != b or other.get(b, a) != a:
            twice = (a if other.get(a, b) != b else b) + first
            raise InputError(f"{where}: the {noun} {twice} is in two pairs; keep one of the pairs.")
        other[a], other[b] = b, a
    notes: tuple[str, ...] = ()
    single = [v for v in range(cohort.n_vertices) if v not in other]
    if other and single and is_landmarks:
        other |= {v: v for v in single}
        of = {vertex: name for name, vertex in (cohort.landmarks or SurfaceLandmarks()).items()}
        notes = (f"{len(single)} landmarks in no pair of {where} are taken to lie on the plane of symmetry "
                 f"({list_names([of.get(v, str(v + 1)) for v in single])}).",)  # fmt: skip
    if len(other) < _FEWEST:
        raise InputError(
            f"{where} name {len(other)} vertices, and {_FEWEST} are the least that define a plane; add some."
        )
    vertices = np.array(sorted(other), dtype=np.int32)
    number = {int(v): k for k, v in enumerate(vertices)}
    partner = np.array([number[other[int(v)]] for v in vertices], dtype=np.int32)
    own = np.full(cohort.n_vertices, -1, dtype=np.int32)
    own[vertices] = np.arange(len(vertices))
    faces = np.zeros((0, 3), dtype=np.int32) if cohort.faces is None else own[cohort.faces]
    faces = faces[(faces >= 0).all(axis=1)]
    sides = _paired_sides(vertices, faces if len(faces) else None, partner, off_share=0.0, space=cohort.dimensions)
    x = cohort.reference[vertices]
    image = sides.image(x)
    try:
        off = float(np.sqrt(((fit_similarity(image, x, with_scale=False).apply(image) - x) ** 2).sum(axis=1).mean()))
    except InputError as error:
        raise InputError(f"{where} lie on a line, so they define no plane; add pairs off the line.") from error
    share = off / rms_size(x)
    if share > LARGEST_PAIRED_OFF:
        raise InputError(
            f"{where}: the mean lies {100 * share:.0f} % of its size from its mirror image by these "
            f"pairs, and at most {100 * LARGEST_PAIRED_OFF:.0f} % is allowed; check that each row names points that "
            "mirror each other."
        )
    left = cohort.n_vertices - len(vertices)
    notes += (f"{left} of {cohort.n_vertices} vertices are in no pair of {where} and are excluded.",) if left else ()
    return replace(sides, off_share=share, notes=notes)


def match_sides(cohort: Cohort, subject: str | None, side: str) -> tuple[Cohort, Sides]:
    """Return pairs of shapes of the two sides of each subject, its repeated shapes in the order of the table.

    Args:
        cohort: cohort of separate left and right shapes, one side reflected.
        subject: column of the subjects; None for `subject`.
        side: column of the sides.

    Returns:
        P shapes of the first side, then P of the other; and the two sides.

    Raises:
        InputError: no such columns, other than two sides, no subject with both, or sides that are mirror images.
    """
    where, cells, owners = cohort.table.where, cohort.table.texts(side), subjects_of(cohort, subject)
    classes = tuple(sorted(set(cells) - {""}))
    if len(classes) != 2:
        raise InputError(
            f"{where}: {side!r} has {len(classes)} classes ({list_names(classes)}), not one for each side."
        )
    rows: tuple[list[int], list[int]] = [], []
    for owner in dict.fromkeys(owners):
        own = [
            [k for k, cell in enumerate(cells) if cell == side_class and owners[k] == owner] for side_class in classes
        ]
        for both, part in zip(rows, own, strict=True):
            both += part[: min(map(len, own))]
    if not rows[0]:
        raise InputError(f"{where}: no subject has both sides; name the subjects with --set subject=COLUMN.")
    left = [cohort.names[k] for k in sorted(set(range(len(cohort))) - {*rows[0], *rows[1]})]
    verb = (
        "s without a counterpart on the other side are"
        if len(left) > 1
        else " without a counterpart on the other side is"
    )
    note = f"{len(left)} shape{verb} excluded ({list_names(left)})."
    one, other = (cohort.vertices(cohort.coefficients[part].mean(axis=0)) for part in rows)

    def off(image: FloatArray) -> float:
        return float(np.linalg.norm(fit_similarity(image, one, with_scale=False).apply(image) - one))

    if off(other * FLIP) <= _MIRROR_IMAGE * off(other):
        raise InputError(
            f"{where}: shapes with {side} {classes[1]} are mirror images of the others; reflect them before the "
            f"alignment, landmarks with shapespace align --reflect {side}={classes[1]}."
        )
    everything = np.arange(cohort.n_vertices, dtype=np.int32)
    sides = _paired_sides(
        everything, cohort.faces, everything, off_share=off(other) / float(np.linalg.norm(one - one.mean(axis=0))),
        notes=(note,) if left else (), space=cohort.dimensions, classes=classes,
    )  # fmt: skip
    return cohort.take([*rows[0], *rows[1]]), sides


def aligned_shapes(cohort: Cohort, shapes: FloatArray) -> FloatArray:
    """Return shapes (N, V, 3) after generalised Procrustes analysis in the gauge of a cohort.

    Landmarks are aligned and projected as by `align_landmarks`, so that sums of squares are those of geomorph.
    """
    if cohort.source.kind == "landmarks":
        config = AlignConfig(gauge=cohort.gauge)
        return padded(superimpose(shapes[..., : cohort.dimensions], config).coords)
    out = shapes.copy()
    align_in_place(out, cohort.gauge)
    if cohort.gauge == "shape":
        scale_to_tangent(out)
    return out


def read_pairs(path: Path, cohort: Cohort) -> tuple[tuple[int, int], ...]:
    """Return the pairs in a CSV table of two columns, with or without a header, as names of landmarks or as numbers.

    Vertices count from 0, and landmarks of a cohort of landmarks from 1, as in geomorph. A cell that is the name of a
    landmark is not read as a number. A first column without a name, which R writes for the rows, is ignored.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is no such table.
        InputError: a name that is no landmark of the cohort.
    """
    check_file(path, _LARGEST_BYTES, "give a smaller table")
    rows = read_rows(path)
    landmarks, first = dict(cohort.landmarks or {}), int(cohort.source.kind == "landmarks")

    def is_place(cell: str) -> bool:
        return cell in landmarks or bool(_NUMBER.fullmatch(cell))

    if rows and not all(map(is_place, rows[0])):
        rows = [row[1:] if rows[0][0] == "" else row for row in rows][1:]
    if not rows or any(len(row) != 2 for row in rows):
        raise FileFormatError(f"{path} is no table of pairs; write two columns, a pair in each row.")
    unknown = sorted({cell for row in rows for cell in row if not is_place(cell)})
    if unknown:
        there = list_names(sorted(landmarks)) if landmarks else "none are known"
        kind = "landmark" if first else "vertex or landmark"
        raise InputError(f"{path}: no {kind} has the name or number {list_names(unknown)} (landmarks: {there}).")
    pairs = [tuple(landmarks[cell] if cell in landmarks else int(cell) - first for cell in row) for row in rows]
    return tuple((a, b) for a, b in pairs)


def pairs_by_name(names: Sequence[str]) -> tuple[tuple[str, str], ...]:
    """Return the pairs of landmarks whose names differ only in their side: left and right, or l and r, as words.

    Args:
        names: names of landmarks, such as `left arch`, `arch_R` or `L3`.
    """
    folded = {name.casefold(): name for name in names}
    others = {name: folded.get(_SIDE.sub(lambda side: _OTHER_SIDE[side[0]], key)) for key, name in folded.items()}
    return tuple((a, b) for a, b in others.items() if b is not None and names.index(a) < names.index(b))


def _paired_sides(vertices: IntArray, faces: IntArray | None, partner: IntArray, **known: Any) -> Sides:
    """Return sides in which the mirror image of each vertex (M,) is its partner (M,), a number among the M vertices."""
    weights = np.zeros((len(partner), 3))
    weights[:, 0] = 1.0
    corners = np.tile(partner[:, None], (1, 3))
    return Sides(vertices=vertices, faces=faces, corners=corners, weights=weights, paired=True, **known)
