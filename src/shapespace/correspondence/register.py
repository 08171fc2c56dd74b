"""One scan registered to a template: forces from both sides, averaged over the surface and never fitted.

Viscous and elastic, as White et al. (2019) have it. In each iteration every point of the template is drawn to the scan
and by the scan; the forces f, weighted by w, are averaged over a range r of the surface, as heat diffuses (H_r):

    v = H_r(w f) / H_r(w),     d <- H_e(d + v)                                        (1)

The range r of what moves and the range e of what stays moved fall together, from a good part of the object to its
details. A force that is averaged does not pull a smooth field through every match, as a fit would; that is why matches
that are wrong sideways, as most are at first, do so little harm here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import Marks
from shapespace.fit.robust.kernels import normals_into
from shapespace.fit.robust.prepared_model import Topology
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

_NEAR = 3
"""Points of the other side that a point is matched with, by inverse squared distance."""
_TOUCHING = 1e-8


@dataclass(frozen=True)
class ElasticSettings:
    """How a scan is registered; lengths are shares of the template's size (RMS distance from its middle).

    Args:
        harmonics: functions that the movement is made of.
        widest: range of (1) in the first iteration,
        narrowest: and in the last; it falls geometrically.
        iterations: of these many.
        points: of each side that are matched while the range is wide; all are below `fine` of the widest.
        normal_cosine: matches whose normals differ more are none.
        inliers: residuals beyond this many standard deviations are likelier wrong than right.
        borders: whether what is matched with a border counts.
        floor: share of full weight below which nothing is seen, and the average fades.
        turn: length that a difference of the normals by a radian, or so, counts as much as.
    """

    harmonics: int = 400
    widest: float = 0.6
    narrowest: float = 0.03
    iterations: int = 40
    points: int = 2500
    fine: float = 0.15
    normal_cosine: float = 0.3
    inliers: float = 6.0
    borders: bool = False
    floor: float = 0.05
    turn: float = 0.1


@dataclass(frozen=True, eq=False)
class Template:
    """The surface that scans are registered to.

    Args:
        mesh: its triangles; its vertices in mm are where a registration begins.
        topology: who neighbours whom.
        harmonics: its smooth functions.
        size_mm: RMS distance from its middle.
    """

    mesh: Mesh
    topology: Topology
    harmonics: Harmonics
    size_mm: float

    @staticmethod
    def of(mesh: Mesh, harmonics: Harmonics | int) -> Template:
        """Return `mesh` ready to be registered, with that many functions of its own, or those of a like surface."""
        functions = harmonics if isinstance(harmonics, Harmonics) else Harmonics.of(mesh, harmonics)
        return Template(mesh, Topology.of(mesh), functions, rms_size(mesh.vertices))


@dataclass(frozen=True, eq=False)
class Registered:
    """A template on a scan.

    Args:
        vertices: (V, 3) in the template's frame.
        T_scan_template: to the scan's mm frame.
    """

    vertices: FloatArray
    T_scan_template: Similarity


def register(
    template: Template,
    target: ScanTarget,
    T_scan_template: Similarity,
    settings: ElasticSettings,
    *,
    expected: FloatArray | None = None,
    marks: Marks | None = None,
    seed: int = 0,
) -> Registered:
    """Return the template moved onto the scan, all of it: where the scan shows nothing, as its neighbours move.

    Args:
        template: the surface.
        target: the scan in its mm frame.
        T_scan_template: where to begin.
        settings: how.
        expected: (V, 3) the shape that the scan is thought to have, in the template's frame; None is the template.
        marks: the scan's landmarks, in its mm frame.
        seed: of the points that are matched.
    """
    rng, t = np.random.default_rng(seed), settings
    base = np.array(template.mesh.vertices if expected is None else expected)
    x, T = base.copy(), T_scan_template
    normals = np.empty_like(x)
    for range_share in np.geomspace(t.widest, t.narrowest, t.iterations):
        coarse = range_share > t.fine * t.widest
        own = template.topology.used
        if coarse and len(own) > t.points:
            own = np.sort(rng.choice(own, t.points, replace=False))
        chosen = target.draw(t.points if coarse else None, rng)
        y = T.inverse().apply(target.mesh.vertices[chosen])
        side = target.normals[chosen] @ T.rotation
        normals_into(x, template.topology.faces, normals)
        force, weight = _forces(template, x, normals, own, y, side, target.rim[chosen], t)
        weight = weight * _inlying(force, weight, t.inliers, template.size_mm)
        x = x + _averaged(template.harmonics, own, force, weight, range_share * template.size_mm, t.floor)
        pose = fit_similarity(base, x)
        T, x = T @ pose, pose.inverse().apply(x)
        x = base + template.harmonics.diffused(x - base, range_share * template.size_mm)
        if marks is not None:
            here = marks.moved(T.inverse())
            x = x + here.pull(x, template.harmonics, range_share * template.size_mm, template.size_mm)
    return Registered(x, T)


def _forces(
    template: Template,
    x: FloatArray,
    normals: FloatArray,
    own: IntArray,
    y: FloatArray,
    side: FloatArray,
    rim: BoolArray,
    settings: ElasticSettings,
) -> tuple[FloatArray, FloatArray]:
    """Return forces (M, 3), mm, on the vertices `own` (M,), and their weights (M,): 1 for each side that is sure."""
    at, up, count = x[own], normals[own], len(own)
    bare = not side.any()  # points without triangles have no normals
    turn = settings.turn * template.size_mm
    here, there = (at, y) if bare else (np.hstack([at, turn * up]), np.hstack([y, turn * side]))
    near, share = _weighted(there, here)
    pull = np.einsum("mk,mkd->md", share, y[near]) - at
    allowed = bare | (np.einsum("md,mkd,mk->m", up, side[near], share) > settings.normal_cosine)
    back, back_share = _weighted(here, there)
    push = y - np.einsum("mk,mkd->md", back_share, at[back])
    heard = bare | (np.einsum("md,mkd,mk->m", side, up[back], back_share) > settings.normal_cosine)
    if not settings.borders:
        allowed &= ~rim[near].any(axis=1)
        heard &= ~template.topology.rim[own][back].any(axis=1)
    # Each side counts alike, however densely it is sampled.
    carried = (back_share * heard[:, None]).ravel() * (count / len(y))
    weight = allowed + np.bincount(back.ravel(), carried, count)
    moved = np.stack(
        [np.bincount(back.ravel(), carried * np.repeat(push[:, k], _NEAR), count) for k in range(3)], axis=1
    )
    force = (allowed[:, None] * pull + moved) / np.maximum(weight, 1e-9)[:, None]
    return force, np.minimum(weight, 1.0)


def _weighted(points: FloatArray, queries: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return (M, `_NEAR`) the nearest of `points` to each of `queries`, and what each counts."""
    distance, near = cKDTree(points).query(queries, k=_NEAR)
    share = 1.0 / (np.asarray(distance) ** 2 + _TOUCHING)
    return np.asarray(near, dtype=np.int32), share / share.sum(axis=1, keepdims=True)


def _inlying(force: FloatArray, weight: FloatArray, inliers: float, size_mm: float) -> FloatArray:
    """Return (M,) how likely each force is none of the outliers, whose density is even."""
    length = np.linalg.norm(force, axis=1)
    share = np.ones(len(force))
    for _ in range(4):
        sure = weight * share
        spread = max(float(np.sqrt((sure * length**2).sum() / max(sure.sum(), 1e-12))), 1e-4 * size_mm)
        inside = np.exp(-0.5 * (length / spread) ** 2)
        share = inside / (inside + np.exp(-0.5 * inliers**2))
    return share


def _averaged(
    harmonics: Harmonics, own: IntArray, force: FloatArray, weight: FloatArray, range_mm: float, floor: float
) -> FloatArray:
    """Return (V, 3) the average (1) of forces at the vertices `own`, everywhere."""
    functions, area = harmonics.functions[own], harmonics.area[own]
    area = area * (harmonics.area.sum() / area.sum())
    kept = harmonics.kept(range_mm)[:, None]
    weighed = np.column_stack([weight[:, None] * force, weight])
    spread = harmonics.functions @ (kept * (functions.T @ (area[:, None] * weighed)))
    return spread[:, :3] / np.maximum(spread[:, 3:], floor)
