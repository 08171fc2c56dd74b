"""Cohorts of the parts of objects: each part in its own frame, and the relative poses of the parts.

Equation numbers are those of docs/structures.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import list_names
from shapespace.errors import InputError
from shapespace.geometry.articulation import size_of_parts
from shapespace.geometry.procrustes import centroid_size
from shapespace.model.missing import MIN_SEEN
from shapespace.reprs import short_repr
from shapespace.types import FloatArray, read_only

RELATIVE_POSE = "relative pose"
"""Name of the relative poses among the parts."""
_FEWEST_AXES = 3  # points that define axes


def require_parts(cohort: Cohort, why: str) -> None:
    """Check that the shapes have parts.

    Args:
        cohort: the shapes.
        why: option or analysis that needs them, for the message.

    Raises:
        InputError: they have none.
    """
    if not cohort.parts:
        raise InputError(
            f"{why} needs shapes of several parts, and these have one; give surfaces of several parts in "
            "correspondence."
        )


def cohort_of_part(cohort: Cohort, name: str) -> Cohort:
    """Return the shapes of one part, aligned as if there were no other parts, without shapes that lack the part.

    The sizes are those of the part.

    Args:
        cohort: shapes of several parts.
        name: name of the part.

    Raises:
        InputError: there is no such part.
    """
    require_parts(cohort, f"The part {name}")
    if name not in cohort.parts:
        raise InputError(f"There is no part {name[:40]!r}; choose one of {', '.join(cohort.parts)}.")
    part = cohort.articulation.slices[list(cohort.parts).index(name)]
    rows, note = _rows_with(cohort, [name])
    shapes = np.stack([cohort.part_shapes(row) for row in rows])
    larger = cohort.sizes_mm[rows] / [size_of_parts(shape, cohort.articulation.counts) for shape in shapes]
    observed = None if cohort.observed is None else cohort.observed[rows][:, part]
    faces, inside = cohort.faces, np.zeros(cohort.n_vertices, dtype=np.bool_)
    inside[part] = True
    own = Cohort.of_shapes(
        shapes[:, part],
        {},
        names=[cohort.names[row] for row in rows],
        faces=None if faces is None else faces[inside[faces].all(axis=1)] - part.start,
        gauge=cohort.gauge,
        landmarks=None if cohort.landmarks is None else cohort.landmarks.renumbered(inside),
        unit=cohort.unit,
        observed=observed,
    )
    return replace(
        own,
        sizes_mm=read_only(own.sizes_mm * larger),
        table=cohort.table.take(rows),
        notes=(*cohort.notes, *note),
        source=cohort.source,
        position_std=None if cohort.position_std is None else cohort.position_std[part],
        review=cohort.review,
        cautions=cohort.cautions,
        drop_missing=cohort.drop_missing,
    )


def cohort_of_poses(cohort: Cohort) -> Cohort:
    """Return the mean shapes of the parts in the relative poses of each shape (S5), without shapes that lack a part.

    Distances are mm of vertices, as those of shapes, so that an angle counts as far as it moves vertices.

    Args:
        cohort: shapes of several parts.
    """
    require_parts(cohort, "A relative pose")
    articulation = cohort.articulation
    rows, note = _rows_with(cohort, list(cohort.parts))
    poses = [articulation.from_tangent(cohort.vertices(row)) for row in rows]
    off = np.stack([articulation.to_tangent(replace(own, shape=0 * own.shape)) for own in poses]) - cohort.reference
    u, s, vt = np.linalg.svd(off.reshape(len(rows), -1), full_matrices=False)
    rank = 6 * len(articulation.joints)  # three rotations and three translations per joint
    return replace(
        cohort.take(rows, *note),
        basis=read_only(vt[:rank]),
        coefficients=read_only((u * s)[:, :rank]),
        observed=None,
        analysed=None,
        position_std=None,
        samples=(),
    )


def cohorts_of_parts(cohort: Cohort) -> dict[str, Cohort]:
    """Return the cohort of each part by its name, and then of the relative poses."""
    return {name: cohort_of_part(cohort, name) for name in cohort.parts} | {RELATIVE_POSE: cohort_of_poses(cohort)}


def without_relative_pose(cohort: Cohort) -> Cohort:
    """Return the shapes of all parts, each aligned as if there were no others, without shapes that lack a part.

    Args:
        cohort: shapes of several parts.
    """
    rows, note = _rows_with(cohort, list(cohort.parts))
    cohort = cohort.take(rows, *note)
    parts = [cohort_of_part(cohort, name) for name in cohort.parts]
    return replace(
        cohort,
        reference=read_only(np.concatenate([own.reference for own in parts])),
        basis=read_only(block_diag(*(own.basis for own in parts))),
        coefficients=read_only(np.hstack([own.coefficients for own in parts])),
        samples=(),
    )


@dataclass(frozen=True, eq=False)
class RelativePoses:
    """Relative poses of N shapes at J joints, about the mean relative pose of all shapes of the cohort.

    Args:
        names: names of the shapes.
        joints: names of the joints, such as `tibia to femur`: the pose of the tibia relative to the femur.
        axes: (J, 3, 3) three orthogonal unit axes of each joint as rows, in the frame of the mean shape.
        rotation_deg: (N, J, 3) components of the rotation vector about these axes, degrees.
        translation_mm: (N, J, 3) displacement at the joint along these axes, mm; at the mean size in the gauge `shape`.
    """

    names: tuple[str, ...]
    joints: tuple[str, ...]
    axes: FloatArray
    rotation_deg: FloatArray
    translation_mm: FloatArray

    __repr__ = short_repr

    @property
    def numbers(self) -> FloatArray:
        """(N, J, 6) rotations in degrees, then translations in mm."""
        return np.concatenate([self.rotation_deg, self.translation_mm], axis=2)


def relative_poses(
    cohort: Cohort, axes: Sequence[str] = (), of: Mapping[str, FloatArray] | None = None
) -> RelativePoses:
    """Return the relative poses at the joints in degrees and mm, without shapes that lack a part.

    Args:
        cohort: shapes of several parts.
        axes: three landmarks A, B, C, or numbers of vertices, on the mean shape: axis 1 points from A to B, axis 2 is
            in the plane with C, on its side, and axis 3 is perpendicular to both. By default they are the principal
            axes of inertia of the part to which the other is attached, the longest extent first.
        of: name -> (K,) coefficients of further poses that replace those of the shapes.

    Raises:
        InputError: shapes of one part, or points that do not exist or are on a line.
    """
    require_parts(cohort, "A relative pose")
    articulation, parts = cohort.articulation, list(cohort.parts)
    if of is None:
        rows, _ = _rows_with(cohort, parts)
        of = {cohort.names[row]: cohort.coefficients[row] for row in rows}
    poses = [articulation.from_tangent(cohort.vertices(coefficients)) for coefficients in of.values()]
    frames = np.stack([
        _axes_of_points(cohort, axes) if axes else _inertia_axes(cohort.reference[articulation.slices[joint.parent]])
        for joint in articulation.joints
    ])  # fmt: skip
    rotation, translation = (
        np.einsum("jab,njb->nja", frames, np.stack(values))
        for values in ([own.rotation for own in poses], [own.translation for own in poses])
    )
    return RelativePoses(
        names=tuple(of),
        joints=tuple(f"{parts[joint.part]} to {parts[joint.parent]}" for joint in articulation.joints),
        axes=read_only(frames),
        rotation_deg=read_only(np.degrees(rotation)),
        translation_mm=read_only(translation),
    )


def _rows_with(cohort: Cohort, names: Sequence[str]) -> tuple[list[int], tuple[str, ...]]:
    """Return the rows of the shapes that show `MIN_SEEN` or more of each of these parts, and a note on the others."""
    has = np.ones(len(cohort), dtype=np.bool_)
    for name, part in zip(cohort.parts, cohort.articulation.slices, strict=True):
        if cohort.observed is not None and name in names:
            known = slice(None) if cohort.analysed is None else cohort.analysed[part]
            has &= cohort.observed[:, part][:, known].mean(axis=1) >= MIN_SEEN
    lack = [name for name, own in zip(cohort.names, has, strict=True) if not own]
    note = f"{len(lack)} of {len(cohort)} shapes lack {' or '.join(names)} and are excluded ({list_names(lack)})."
    return np.flatnonzero(has).tolist(), (note,) if lack else ()


def _inertia_axes(part: FloatArray) -> FloatArray:
    """Return the right-handed principal axes (3, 3) of a part (V, 3), the longest extent first, as rows.

    The largest component of each of the first two axes is positive.
    """
    axes = np.linalg.svd(part - part.mean(axis=0), full_matrices=False)[2]
    axes *= np.sign(np.take_along_axis(axes, np.abs(axes).argmax(axis=1)[:, None], axis=1))
    axes[2] = np.cross(axes[0], axes[1])
    return axes


def _axes_of_points(cohort: Cohort, points: Sequence[str]) -> FloatArray:
    """Return the axes (3, 3) of three points, see `relative_poses`."""
    known = {} if cohort.landmarks is None else cohort.landmarks.positions(cohort.reference)
    known = {str(vertex): point for vertex, point in enumerate(cohort.reference)} | known
    unknown = [point for point in points if point not in known]
    if unknown or len(points) != _FEWEST_AXES:
        named = ", ".join(cohort.landmarks or ()) or "none"
        raise InputError(
            f"Axes need three landmarks or numbers of vertices, not {', '.join(points)[:80]} (landmarks: {named})."
        )
    a, b, c = (known[point] for point in points)
    along, third = b - a, np.cross(b - a, c - a)
    if np.linalg.norm(third) <= 1e-6 * centroid_size(cohort.reference) ** 2 or not along.any():
        raise InputError(f"The points {', '.join(points)} of the axes lie on a line; choose other landmarks.")
    first, third = along / np.linalg.norm(along), third / np.linalg.norm(third)
    return np.stack([first, np.cross(third, first), third])
