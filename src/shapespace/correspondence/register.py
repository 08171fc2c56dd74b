"""Elastic registration of a template to a scan: forces in both directions, averaged over the surface.

Viscous and elastic, as in White et al. (2019). In each iteration every point of the template is drawn to the scan
and by the scan (C3, C4), outliers are down-weighted (C5), and the forces are averaged over a range of the surface (C6)
and added to the movement, which is smoothed over the same range (C7). The range decreases from a large part of the
object to its details. An averaged force does not pull a smooth field through every match, as a fit would; therefore
matches with a tangential error, as most have at first, do little harm. Equations Cn are those of
docs/correspondence.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import ScanLandmarks
from shapespace.fit.robust.kernels import normals_into
from shapespace.fit.robust.prepared_model import Topology
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

_NEAR = 3
"""Number of points of the other side that a point is matched with, by inverse squared distance."""
_TOUCHING = 1e-8
"""Square of a length, mm^2, so that a point that touches another one has a finite weight."""
_OUTLIER_ROUNDS = 4  # reweighting iterations for outliers


@dataclass(frozen=True)
class ElasticSettings:
    """Settings of a registration; lengths are shares of the template's size (RMS distance from its centre).

    Args:
        harmonics: number of functions of which the movement consists.
        widest: range of (C6) in the first iteration.
        narrowest: range of (C6) in the last iteration; it decreases geometrically.
        iterations: number of iterations.
        points: number of points of each side that are matched while the range is wide; all are matched below `fine` of
            the widest range.
        normal_cosine: cosine of the angle between normals beyond which matches are excluded.
        inliers: number of standard deviations beyond which residuals are more likely wrong than right.
        borders: whether matches with a border count.
        floor: share of full weight below which a point counts as unobserved, and the average fades.
        turn: length that a difference of the normals by about a radian counts as.
        colour: length that a difference between black and a full red, green or blue counts as, if template
            and scan have colours; 0 ignores them.
        tangential: smallest range over which forces along the surface are averaged: over shorter ranges they are noise
            of the triangles, and move points away from their correct positions.
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
    colour: float = 0.1
    tangential: float = 0.1


@dataclass(frozen=True, eq=False)
class Template:
    """The surface that scans are registered to.

    Args:
        mesh: triangles, and vertices in mm, from which a registration begins.
        topology: topology of the triangles.
        harmonics: harmonics of the surface.
        size_mm: RMS distance of the vertices from their centre.
    """

    mesh: Mesh
    topology: Topology
    harmonics: Harmonics
    size_mm: float

    @staticmethod
    def of(mesh: Mesh, harmonics: Harmonics | int) -> Template:
        """Return `mesh` with data for registrations: that many harmonics of its own, or those of a similar surface."""
        functions = harmonics if isinstance(harmonics, Harmonics) else Harmonics.of(mesh, harmonics)
        return Template(mesh, Topology.of(mesh), functions, rms_size(mesh.vertices))


@dataclass(frozen=True, eq=False)
class ElasticState:
    """The template in one iteration of its registration to a scan, and the result of the last iteration.

    Args:
        vertices: (V, 3) vertices in the template's frame.
        T_scan_template: similarity from the template's frame to the scan's mm frame.
    """

    vertices: FloatArray
    T_scan_template: Similarity


@dataclass(frozen=True, eq=False)
class _RegistrationConstants:
    """Constants of all iterations.

    Args:
        template: the surface.
        target: the scan in its mm frame.
        base: (V, 3) shape without movement, in the template's frame.
        landmarks: landmarks of the scan, in its mm frame.
        settings: settings of the registration.
        colours: (V, 3) colours of the template and (S, 3) of the scan, as lengths in mm about their medians; without
            columns if either has no colours.
    """

    template: Template
    target: ScanTarget
    base: FloatArray
    landmarks: ScanLandmarks | None
    settings: ElasticSettings
    colours: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class _Samples:
    """Points of one surface that are matched with the other one, in the template's frame.

    Args:
        points: (M, 3) positions, mm.
        normals: (M, 3) normals, zero if the surface has no triangles.
        on_border: (M,) whether the points are on the border of the surface.
        colours: (M, 3) colours as lengths in mm; (M, 0) if the surface or the other one has no colours.
    """

    points: FloatArray
    normals: FloatArray
    on_border: BoolArray
    colours: FloatArray


def register(
    template: Template,
    target: ScanTarget,
    T_scan_template: Similarity,
    settings: ElasticSettings,
    *,
    expected: FloatArray | None = None,
    landmarks: ScanLandmarks | None = None,
    seed: int = 0,
) -> ElasticState:
    """Return the template moved onto the scan; where the scan shows nothing, the template moves as its neighbours do.

    Args:
        template: the surface.
        target: the scan in its mm frame.
        T_scan_template: initial pose, from the template's frame to the scan's mm frame.
        settings: settings of the registration.
        expected: (V, 3) expected shape of the scan, in the template's frame; None is the template.
        landmarks: landmarks of the scan, in its mm frame.
        seed: seed of the sample of points that are matched.
    """
    base = np.array(template.mesh.vertices if expected is None else expected)
    colours = _colour_lengths(template, target, settings)
    problem = _RegistrationConstants(template, target, base, landmarks, settings, colours)
    state, rng = ElasticState(base, T_scan_template), np.random.default_rng(seed)
    for range_share in np.geomspace(settings.widest, settings.narrowest, settings.iterations):
        state = _step(problem, state, float(range_share), rng)
    return state


def _step(
    problem: _RegistrationConstants, state: ElasticState, range_share: float, rng: np.random.Generator
) -> ElasticState:
    """Return the state after one iteration over a range of the surface, a share of its size; `rng` draws the points."""
    template, settings = problem.template, problem.settings
    harmonics, size_mm = template.harmonics, template.size_mm
    range_mm = range_share * size_mm
    x, T = state.vertices, state.T_scan_template
    own, surface, scan = _sample_points(problem, state, range_share > settings.fine * settings.widest, rng)
    force, weight = _compute_forces(surface, scan, settings, size_mm)
    weight = weight * _inlier_probability(force, weight, settings.inliers, size_mm)
    x = x + _average_forces(
        harmonics, own, _split_forces(force, surface.normals, range_share, settings), weight, settings, size_mm
    )
    pose = fit_similarity(problem.base, x)
    T, x = T @ pose, pose.inverse().apply(x)
    x = problem.base + harmonics.diffused(x - problem.base, range_mm)  # C7
    if problem.landmarks is not None:
        x = x + problem.landmarks.transformed(T.inverse()).correction(x, harmonics, range_mm, size_mm)
    return ElasticState(x, T)


def _colour_lengths(template: Template, target: ScanTarget, settings: ElasticSettings) -> tuple[FloatArray, FloatArray]:
    """Return the colours as lengths, about the medians of each surface, which removes differences in lighting."""
    own, scan = template.mesh.colours, target.mesh.colours
    if own is None or scan is None or not settings.colour:
        return np.empty((len(template.mesh.vertices), 0)), np.empty((len(target.mesh.vertices), 0))
    scale = settings.colour * template.size_mm / 255.0
    return scale * (own - np.median(own, axis=0)), scale * (scan - np.median(scan, axis=0))


def _sample_points(
    problem: _RegistrationConstants, state: ElasticState, coarse: bool, rng: np.random.Generator
) -> tuple[IntArray, _Samples, _Samples]:
    """Return the vertices (M,) of the template that are matched, with their points, and points of the scan."""
    topology, target, settings = problem.template.topology, problem.target, problem.settings
    own = topology.used
    if coarse and len(own) > settings.points:
        own = np.sort(rng.choice(own, settings.points, replace=False))
    chosen = target.draw(settings.points if coarse else None, rng)
    T = state.T_scan_template
    normals = np.empty_like(state.vertices)
    normals_into(state.vertices, topology.faces, normals)
    own_colours, scan_colours = problem.colours
    surface = _Samples(state.vertices[own], normals[own], topology.rim[own], own_colours[own])
    points = T.inverse().apply(target.mesh.vertices[chosen])
    scan = _Samples(points, target.normals[chosen] @ T.rotation, target.rim[chosen], scan_colours[chosen])
    return own, surface, scan


def _compute_forces(
    surface: _Samples, scan: _Samples, settings: ElasticSettings, size_mm: float
) -> tuple[FloatArray, FloatArray]:
    """Return forces (M, 3), mm, on the points of the surface, and their weights (M,): 1 for each certain side."""
    x, y, count = surface.points, scan.points, len(surface.points)
    is_cloud = not scan.normals.any()
    turn = settings.turn * size_mm
    surface_features = np.hstack([x, surface.colours] if is_cloud else [x, turn * surface.normals, surface.colours])
    scan_features = np.hstack([y, scan.colours] if is_cloud else [y, turn * scan.normals, scan.colours])
    near, share = _soft_matches(scan_features, surface_features)
    to_scan = np.einsum("mk,mkd->md", share, y[near]) - x
    cosine = np.einsum("md,mkd,mk->m", surface.normals, scan.normals[near], share)
    is_valid = is_cloud | (cosine > settings.normal_cosine)
    back, back_share = _soft_matches(surface_features, scan_features)
    from_surface = y - np.einsum("mk,mkd->md", back_share, x[back])
    cosine = np.einsum("md,mkd,mk->m", scan.normals, surface.normals[back], back_share)
    back_is_valid = is_cloud | (cosine > settings.normal_cosine)
    if not settings.borders:
        is_valid &= ~scan.on_border[near].any(axis=1)
        back_is_valid &= ~surface.on_border[back].any(axis=1)
    # Both sides have equal weight, however densely they are sampled.
    back_weight = (back_share * back_is_valid[:, None]).ravel() * (count / len(y))
    weight = is_valid + np.bincount(back.ravel(), back_weight, count)
    by_scan = np.stack(
        [np.bincount(back.ravel(), back_weight * np.repeat(from_surface[:, k], _NEAR), count) for k in range(3)], axis=1
    )
    force = (is_valid[:, None] * to_scan + by_scan) / np.maximum(weight, 1e-9)[:, None]  # C4
    return force, np.minimum(weight, 1.0)


def _soft_matches(points: FloatArray, queries: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return the indices (M, `_NEAR`) of the `points` nearest to each of `queries`, and their weights, which sum to
    one.
    """
    distance, near = cKDTree(points).query(queries, k=_NEAR)
    share = 1.0 / (np.asarray(distance) ** 2 + _TOUCHING)
    return np.asarray(near, dtype=np.int32), share / share.sum(axis=1, keepdims=True)  # C3


def _inlier_probability(force: FloatArray, weight: FloatArray, inliers: float, size_mm: float) -> FloatArray:
    """Return (M,) the probability that each force is not an outlier; the density of outliers is uniform."""
    length = np.linalg.norm(force, axis=1)
    probability = np.ones(len(force))
    for _ in range(_OUTLIER_ROUNDS):
        sure = weight * probability
        spread = max(float(np.sqrt((sure * length**2).sum() / max(sure.sum(), 1e-12))), 1e-4 * size_mm)
        inlier = np.exp(-0.5 * (length / spread) ** 2)
        probability = inlier / (inlier + np.exp(-0.5 * inliers**2))  # C5
    return probability


def _split_forces(
    force: FloatArray, normals: FloatArray, range_share: float, settings: ElasticSettings
) -> list[tuple[float, FloatArray]]:
    """Return the parts of the forces that are averaged over different ranges, shares of the size."""
    if range_share >= settings.tangential:
        return [(range_share, force)]
    normal = np.einsum("md,md->m", force, normals)[:, None] * normals
    return [(range_share, normal), (settings.tangential, force - normal)]


def _average_forces(
    harmonics: Harmonics,
    own: IntArray,
    parts: Sequence[tuple[float, FloatArray]],
    weight: FloatArray,
    settings: ElasticSettings,
    size_mm: float,
) -> FloatArray:
    """Return (V, 3) the average (C6) at all vertices of forces at the vertices `own`: each part over its range."""
    functions, area = harmonics.functions[own], harmonics.area[own]
    area = area * (harmonics.area.sum() / area.sum())
    columns = [np.column_stack([weight[:, None] * force, weight]) for _, force in parts]
    coefficients = np.split(functions.T @ (area[:, None] * np.hstack(columns)), len(parts), axis=1)
    smooth = [
        harmonics.attenuation(range_share * size_mm)[:, None] * own_coefficients
        for (range_share, _), own_coefficients in zip(parts, coefficients, strict=True)
    ]
    diffused = np.split(harmonics.functions @ np.hstack(smooth), len(parts), axis=1)
    return np.sum([part[:, :3] / np.maximum(part[:, 3:], settings.floor) for part in diffused], axis=0)  # C6
