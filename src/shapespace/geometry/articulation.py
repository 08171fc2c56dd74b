"""Several parts on one list of vertices: shape of each part, and relative pose at the joints between them.

A surface of parts is converted to tangent vertices and back. Tangent vertices are those of the template, displaced by
the shape of each part and by small rotations and translations of the parts, to first order: on them PCA is linear, and
lengths are mm of vertices. Rotations become exact, and parts rigid, in the conversion back. Relative poses are in
logarithmic coordinates about the template (Rasoulian, Rohling and Abolmaesumi, IEEE TMI 32(2), 2013; Bossa and Olmos,
MMBIA 2007), measured at the joints. Equation numbers are those of docs/structures.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.errors import InputError
from shapespace.geometry.procrustes import Gauge, align_shapes, centroid_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import BoolArray, FloatArray, IntArray

_JOINT_SHARE = 0.05
"""Share of a part's vertices, those nearest to the other part, whose mean is its side of the joint."""
_FEWEST = 4  # vertices of a part, which determine its pose
_ROUNDS, _STILL = 20, 1e-7
"""Limit of the iterations of the mean of the parts, and the movement, as a share of the size, that ends them."""


def _skew(v: FloatArray) -> FloatArray:
    """Return the matrices (..., 3, 3) of the cross products with v (..., 3)."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - out.swapaxes(-1, -2)


def _left_jacobian(omega: FloatArray) -> FloatArray:
    """Return J (3, 3): exp(omega + d) = exp(J d) exp(omega) to first order in d."""
    angle, K = float(np.linalg.norm(omega)), _skew(omega)
    if angle < 1e-4:  # rad; the next term of the series is below rounding
        return np.eye(3) + K / 2 + K @ K / 6
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K


@dataclass(frozen=True, eq=False)
class Joint:
    """Where a part is attached to its parent.

    Args:
        part: index of the part.
        parent: index of its parent.
        own: vertices of the part, as indices of all vertices, whose mean is its side of the joint.
        other: vertices of the parent likewise.
    """

    part: int
    parent: int
    own: IntArray
    other: IntArray


@dataclass(frozen=True, eq=False)
class PartPoses:
    """Parts of one surface in their own frames, and the relative poses at the joints.

    Args:
        shape: (V, 3) displacement of each vertex from the template in the template's frame, without the motion of its
            part, mm (S1).
        rotation: (P - 1, 3) rotation vector of each jointed part relative to its parent, about the template, rad (S2).
        translation: (P - 1, 3) displacement at each joint in the frame of the parent, mm (S3).
    """

    shape: FloatArray
    rotation: FloatArray
    translation: FloatArray


class Articulation:
    """Parts of a surface, in a tree of joints whose root is the first part.

    Args:
        template: (V, 3) vertices of the mean shape with the parts in their mean relative pose, mm.
        counts: number of vertices of each part; the vertices of parts follow one another.

    Raises:
        InputError: numbers that are not those of the vertices, or a part with too few vertices.
    """

    def __init__(self, template: FloatArray, counts: Sequence[int]) -> None:
        if len(counts) < 2 or min(counts) < _FEWEST or sum(counts) != len(template):
            raise InputError(
                f"Parts with {', '.join(map(str, counts))} vertices are not those of a surface with {len(template)} "
                f"vertices; give two or more parts, each with {_FEWEST} vertices or more."
            )
        self.template, self.counts = template, tuple(int(count) for count in counts)
        ends = np.cumsum([0, *counts]).tolist()
        self.slices = tuple(slice(start, end) for start, end in pairwise(ends))
        self._centred = tuple(template[s] - template[s].mean(axis=0) for s in self.slices)
        self.joints = self._find_joints()
        self._gap = tuple(template[j.own].mean(axis=0) - template[j.other].mean(axis=0) for j in self.joints)

    def _find_joints(self) -> tuple[Joint, ...]:
        """Attach each part to the tree where it is nearest to it, starting from the first part."""
        parts = [self.template[s] for s in self.slices]
        trees = [cKDTree(part) for part in parts]
        nearest, gap = dict[tuple[int, int], IntArray](), dict[tuple[int, int], float]()
        for a in range(len(parts)):
            for b in range(len(parts)):
                if a != b:
                    distance: FloatArray = np.asarray(trees[b].query(parts[a])[0], dtype=np.float64)
                    chosen = np.argsort(distance, kind="stable")[: max(1, round(_JOINT_SHARE * len(distance)))]
                    nearest[a, b] = (chosen + self.slices[a].start).astype(np.int32)
                    gap[a, b] = float(distance[chosen].mean())
        joints, attached = list[Joint](), [0]
        while len(attached) < len(parts):
            pairs = [(k, p) for k in range(len(parts)) if k not in attached for p in attached]
            part, parent = min(pairs, key=lambda pair: gap[pair] + gap[pair[1], pair[0]])
            joints.append(Joint(part, parent, nearest[part, parent], nearest[parent, part]))
            attached.append(part)
        return tuple(joints)

    @cached_property
    def levers_mm(self) -> FloatArray:
        """(P - 1,) RMS movement, mm, of the vertices of each jointed part by a rotation of 1 rad about its joint."""
        off = [self.template[self.slices[j.part]] - self.template[j.own].mean(axis=0) for j in self.joints]
        return np.array([np.sqrt(2 / 3 * (x**2).sum(axis=1).mean()) for x in off])

    def poses_of(self, vertices: FloatArray) -> PartPoses:
        """Return the parts of a surface with `vertices` (V, 3), mm in any pose, and their relative poses (S1-S3).

        Raises:
            InputError: the vertices of a part are on a line or not finite.
        """
        shape, R = np.empty_like(self.template), list[FloatArray]()
        for s, centred in zip(self.slices, self._centred, strict=True):
            own = vertices[s] - vertices[s].mean(axis=0)
            rotation = fit_similarity(centred, own, with_scale=False).rotation
            shape[s] = own @ rotation - centred  # S1
            R.append(rotation)
        relative = [R[j.parent].T @ R[j.part] for j in self.joints]
        translation = [
            (vertices[j.own].mean(axis=0) - vertices[j.other].mean(axis=0)) @ R[j.parent] - gap
            for j, gap in zip(self.joints, self._gap, strict=True)
        ]
        return PartPoses(shape, Rotation.from_matrix(relative).as_rotvec(), np.array(translation))  # S2, S3

    def _compose(self, poses: PartPoses) -> tuple[FloatArray, list[FloatArray]]:
        """Return the vertices (V, 3) and the rotation (3, 3) of each part, in the frame of the first part (S4)."""
        vertices = self.template + poses.shape
        R = [np.eye(3)] * len(self.counts)
        for j, gap, omega, d in zip(self.joints, self._gap, poses.rotation, poses.translation, strict=True):
            s = self.slices[j.part]
            R[j.part] = R[j.parent] @ Rotation.from_rotvec(omega).as_matrix()
            vertices[s] = vertices[s] @ R[j.part].T
            joint = vertices[j.other].mean(axis=0) + R[j.parent] @ (gap + d)
            vertices[s] += joint - vertices[j.own].mean(axis=0)
        return vertices, R

    def to_tangent(self, poses: PartPoses) -> FloatArray:
        """Return the tangent vertices (V, 3), mm: displacements to first order, without a motion of all parts (S5)."""
        off, theta = poses.shape.copy(), np.zeros((len(self.counts), 3))
        for j, gap, omega, d in zip(self.joints, self._gap, poses.rotation, poses.translation, strict=True):
            s = self.slices[j.part]
            theta[j.part] = theta[j.parent] + omega
            off[s] += np.cross(theta[j.part], self._centred[j.part])
            joint = off[j.other].mean(axis=0) + np.cross(theta[j.parent], gap) + d
            off[s] += joint - off[j.own].mean(axis=0)
        return self.template + self._without_motion(off)

    def from_tangent(self, tangent: FloatArray) -> PartPoses:
        """Return the poses of tangent vertices (V, 3); the inverse of `to_tangent`."""
        poses = self._first_order((tangent - self.template)[None])
        return PartPoses(poses.shape[0], poses.rotation[:, 0], poses.translation[:, 0])

    def _first_order(self, off: FloatArray) -> PartPoses:
        """Return the poses of displacements (K, V, 3) to first order: shapes (K, V, 3), and (P - 1, K, 3) at joints."""
        shape, theta = np.empty_like(off), np.empty((len(self.counts), len(off), 3))
        for k, s in enumerate(self.slices):
            theta[k] = np.cross(self._centred[k], off[:, s]).sum(axis=1) @ self._inertia[k]
            turned = np.cross(theta[k][:, None], self._centred[k])
            shape[:, s] = off[:, s] - off[:, s].mean(axis=1, keepdims=True) - turned
        rotation = [theta[j.part] - theta[j.parent] for j in self.joints]
        translation = [
            off[:, j.own].mean(axis=1) - off[:, j.other].mean(axis=1) - np.cross(theta[j.parent], gap)
            for j, gap in zip(self.joints, self._gap, strict=True)
        ]
        return PartPoses(shape, np.array(rotation), np.array(translation))

    def part_with(self, inside: BoolArray) -> int | None:
        """Return the index of the part that has all vertices of the mask `inside` (V,); None if several have them."""
        return next((k for k, s in enumerate(self.slices) if inside[s].sum() == inside.sum()), None)

    def shape_of_part(self, tangent: FloatArray, part: int) -> FloatArray:
        """Return tangent vertices of one part in its own frame, without its motion.

        Args:
            tangent: (3V,) tangent vertices, or (3V, K) displacements, mm.
            part: index of the part.

        Returns:
            (V', 3, 1) vertices, or (V', 3, K) displacements.
        """
        own, centred = self.template[self.slices[part]][:, :, None], self._centred[part][:, :, None]
        off = tangent.reshape(len(self.template), 3, -1)[self.slices[part]]
        off = off - own if tangent.ndim == 1 else off
        theta = self._inertia[part] @ np.cross(centred, off, axis=1).sum(axis=0)
        shape = off - off.mean(axis=0) - np.cross(theta[None], centred, axis=1)
        return shape + own if tangent.ndim == 1 else shape

    @cached_property
    def _inertia(self) -> tuple[FloatArray, ...]:
        """Inverse inertia (3, 3) of each part about its centroid."""
        return tuple(_inverse_inertia(x) for x in self._centred)

    @cached_property
    def _all_parts(self) -> tuple[FloatArray, FloatArray]:
        """The template about its centroid, and its inverse inertia."""
        centred = self.template - self.template.mean(axis=0)
        return centred, _inverse_inertia(centred)

    def _without_motion(self, off: FloatArray) -> FloatArray:
        """Return displacements (V, 3) without the rigid motion of all parts together."""
        centred, inverse = self._all_parts
        return off - off.mean(axis=0) - np.cross(inverse @ np.cross(centred, off).sum(axis=0), centred)

    def encode(self, vertices: FloatArray) -> FloatArray:
        """Return the tangent vertices (V, 3) of a surface with `vertices` (V, 3) in any pose."""
        return self.to_tangent(self.poses_of(vertices))

    def decode(self, tangent: FloatArray, part: int | None = None, own: FloatArray | None = None) -> FloatArray:
        """Return the vertices (V, 3) of tangent vertices (V, 3), rigidly aligned to the template (S6).

        Args:
            tangent: (V, 3) tangent vertices, mm.
            part: index of a part with another shape; None for none.
            own: (V', 3) vertices of that part as `shape_of_part` returns them.
        """
        poses = self.from_tangent(tangent)
        if part is not None and own is not None:
            poses.shape[self.slices[part]] = own - self.template[self.slices[part]]
        vertices = self._compose(poses)[0]
        return fit_similarity(vertices, self.template, with_scale=False).apply(vertices)

    def directions(self, basis: FloatArray, tangent: FloatArray) -> FloatArray:
        """Return the derivatives (3V, K) of `decode` at `tangent` (V, 3) along the columns of `basis` (3V, K) (S7)."""
        V, K = len(self.template), basis.shape[1]
        off = np.ascontiguousarray(basis.T).reshape(K, V, 3)
        poses, changes = self.from_tangent(tangent), self._first_order(off)
        vertices, R = self._compose(poses)
        moved, spin = changes.shape.copy(), np.zeros((len(self.counts), K, 3))
        for k, (j, gap, omega, d) in enumerate(
            zip(self.joints, self._gap, poses.rotation, poses.translation, strict=True)
        ):
            s, parent = self.slices[j.part], R[j.parent]
            spin[j.part] = spin[j.parent] + changes.rotation[k] @ (parent @ _left_jacobian(omega)).T
            own = vertices[s] - vertices[j.own].mean(axis=0)
            moved[:, s] = changes.shape[:, s] @ R[j.part].T + np.cross(spin[j.part][:, None], own)
            turned = np.cross(spin[j.parent], parent @ (gap + d)) + changes.translation[k] @ parent.T
            joint = moved[:, j.other].mean(axis=1) + turned
            moved[:, s] += (joint - moved[:, j.own].mean(axis=1))[:, None]
        return self._aligned_directions(vertices, moved).reshape(K, -1).T

    def _aligned_directions(self, vertices: FloatArray, moved: FloatArray) -> FloatArray:
        """Return the derivatives (K, V, 3) after the rigid alignment of `vertices` to the template."""
        R = fit_similarity(vertices, self.template, with_scale=False).rotation
        x, d = (vertices - vertices.mean(axis=0)) @ R.T, (moved - moved.mean(axis=1, keepdims=True)) @ R.T
        # The aligned surface x satisfies sum x cross t = 0, t the template, so d + omega cross x does too.
        t = self._all_parts[0]
        M = np.einsum("vi,vi->", x, t) * np.eye(3) - x.T @ t
        omega: FloatArray = np.asarray(-np.linalg.solve(M.T, np.cross(t, d).sum(axis=1).T).T, dtype=np.float64)
        return d + np.cross(omega[:, None], x)


def _inverse_inertia(x: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.inv((x**2).sum() * np.eye(3) - x.T @ x), dtype=np.float64)


def regions_of_parts(counts: Mapping[str, int]) -> dict[str, IntArray]:
    """Return the vertices (n,) of each part by its name, from the numbers of vertices, which follow one another."""
    bounds = pairwise(np.cumsum([0, *counts.values()]).tolist())
    return {name: np.arange(*ends, dtype=np.int32) for name, ends in zip(counts, bounds, strict=True)}


def size_of_parts(vertices: FloatArray, counts: Sequence[int]) -> float:
    """Return the root of the sum of the squared centroid sizes of parts (V, 3), which does not depend on their pose."""
    return float(np.linalg.norm([centroid_size(part) for part in np.split(vertices, np.cumsum(counts)[:-1])]))


def articulate(
    shapes: FloatArray, counts: Sequence[int], gauge: Gauge
) -> tuple[Articulation, list[PartPoses], FloatArray]:
    """Return the mean of parts, the parts of each shape about the mean, and the sizes (N,) that are divided out.

    Args:
        shapes: (N, V, 3) vertices, mm, aligned to each other.
        counts: number of vertices of each part.
        gauge: size handling: `shape` divides the size of all parts together out, relative to its mean; `form` keeps it,
            and the returned sizes are ones.

    Raises:
        InputError: the parts of a shape have no pose, see `Articulation`.
    """
    larger = np.ones(len(shapes))
    if gauge == "shape":
        larger = np.array([size_of_parts(shape, counts) for shape in shapes])
        larger /= larger.mean()
        shapes = align_shapes(shapes / larger[:, None, None], "form")
    template = shapes.mean(axis=0)
    articulation, poses = Articulation(template, counts), list[PartPoses]()
    for _ in range(_ROUNDS):
        articulation = Articulation(template, counts)
        poses = [articulation.poses_of(shape) for shape in shapes]
        template = articulation.decode(np.mean([articulation.to_tangent(own) for own in poses], axis=0))
        if np.abs(template - articulation.template).max() <= _STILL * np.ptp(template):
            break
    return articulation, poses, larger
