"""Initialisation of a fit: the unit of the scan, and a pose from landmarks or by global search.

A start with aligned centroids converges for rotations up to about 45 degrees. Beyond, or if the fit is
not clear, many rotations are tried (`start_from_any_pose`), and their results with free leading modes are compared in
both directions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.errors import FitError, InputError
from shapespace.fit.robust.prepared_model import LandmarkConstraint
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh, Similarity

_SAME_TURN_TRACE = 1 + 2 * np.cos(np.radians(25.0))
_TYPICAL_COVER = 1.2  # scan size over model size of a typical crop
_INCH_IS_RARE = 0.5  # penalty in log size
_PLAUSIBLE_COVER = (0.2, 2.6)  # scan size over model size for a plausible unit; 0.3 of a femur cut in half
_LIKELIER_BY_FAR = 0.5  # difference in log size from which the second unit is ruled out
_ONE_BASIN_DEG = 30.0  # rotation from which a refinement finds the pose of simulated scans
_STANDS_OUT = 0.8  # score relative to that of the runner-up below which a start is unambiguous
_COVERS = (_TYPICAL_COVER, 0.5)  # scan size over model size of other sizes; a search reaches 0.6 to 1.6 times each


@dataclass(frozen=True, eq=False)
class Start:
    """A pose that initialises a fit.

    Args:
        T_scan_model: similarity from the model's frame to the scan's frame in mm.
        how: source of the pose: `landmarks`, `upright` (no rotation), `rotations` (another of the tried rotations was
            better), or `given`.
        score_mm: two-way capped distance of the adapted model in this pose, mm of the model; not-a-number for landmarks
            and `given`.
        b: (K',) coefficients of the leading modes in this pose, mm; (0,) if unknown.
        runner_up_score_mm: `score_mm` of the best distinct pose; infinite if no other pose was tried.
        alternatives: up to three such distinct poses, best first, without alternatives of their own.
        marks: landmarks of the scan that constrain the fit; None without any.
    """

    T_scan_model: Similarity
    how: str
    score_mm: float
    b: FloatArray = field(default_factory=lambda: np.zeros(0))
    runner_up_score_mm: float = float("inf")
    alternatives: tuple[Start, ...] = ()
    marks: LandmarkConstraint | None = None

    def scaled(self, factor: float) -> Start:
        """Return the start, and its alternatives, for the scan scaled by `factor` about the origin."""
        T = Similarity(factor, np.eye(3), np.zeros(3)) @ self.T_scan_model
        return replace(self, T_scan_model=T, alternatives=tuple(start.scaled(factor) for start in self.alternatives))


def find_unit(model: ShapeModel, scan: Mesh) -> str:
    """Return the unit, a name of `MM_PER_UNIT`, for which the sizes of scan and model agree best.

    If two units are about equally likely by size, as centimetres and inches are for a part of a face, the likelier unit
    with an unambiguous pose of the model wins, else the unit in which the model fits better.

    Raises:
        FitError: no unit brings the sizes within a factor of five.
    """
    ratio = _size(scan.vertices) / _size(model.mean_vertices)
    with np.errstate(divide="ignore"):
        penalty = {
            unit: abs(float(np.log(ratio * mm / _TYPICAL_COVER))) + (_INCH_IS_RARE if unit == "inch" else 0.0)
            for unit, mm in MM_PER_UNIT.items()
        }
    best, second = sorted(penalty, key=lambda name: penalty[name])[:2]
    if not 0.2 < ratio * MM_PER_UNIT[best] < 5.0:
        raise FitError(
            f"{scan.name}: in no unit (um, mm, cm, inch, m) is it of the model's size; give its unit (--unit), or crop "
            "it to the part that the model contains (--crop)."
        )
    low, high = _PLAUSIBLE_COVER
    if not low < ratio * MM_PER_UNIT[second] < high or penalty[second] > penalty[best] + _LIKELIER_BY_FAR:
        return best
    centred = scan.vertices - np.median(scan.vertices, axis=0)
    scores: dict[str, float] = {}
    for unit in (best, second):
        start = start_from_any_pose(model, MM_PER_UNIT[unit] * centred, seed=0)
        # In a wrong unit no pose is clearly better than the others.
        if start.score_mm <= _STANDS_OUT * start.runner_up_score_mm:
            return unit
        scores[unit] = start.score_mm
    return min(scores, key=lambda unit: scores[unit])


def start_from_landmarks(
    model: ShapeModel, scan_landmarks_mm: Mapping[str, FloatArray], scan_name: str, *, with_scale: bool
) -> Start:
    """Return the least-squares pose from the landmarks that model and scan share by name.

    Raises:
        FitError: the model has no landmarks, or fewer than three names are shared.
    """
    if not model.landmarks:
        raise FitError(
            f"The model has no landmarks, so those given for {scan_name} cannot be used; omit them, or build it "
            "with --landmarks."
        )
    names = [name for name in model.landmarks if name in scan_landmarks_mm]
    if len(names) < 3:
        raise FitError(
            f"{scan_name}: only {len(names)} of its landmarks share a name with the model's, and three are needed; "
            f"the model has {', '.join(list(model.landmarks)[:5])} and so on, the scan "
            f"{', '.join(list(scan_landmarks_mm)[:5]) or 'none'}."
        )
    source = model.landmarks.select(names).interpolate(model.mean_vertices)
    target = np.stack([scan_landmarks_mm[name] for name in names])
    try:
        T = fit_similarity(source, target, with_scale=with_scale)
    except InputError as error:
        raise FitError(
            f"{scan_name}: its landmarks give no pose, since they lie on a line or are not finite; check them."
        ) from error
    return Start(T, "landmarks", float("nan"))


def start_from_any_pose(
    model: ShapeModel, scan_vertices_mm: FloatArray, *, seed: int, with_scale: bool | None = None, quick: bool = False
) -> Start:
    """Return the best pose of a search over all rotations, with the leading modes adapted, and the alternatives.

    A scan that clearly fits without a rotation is not searched further. Another rotation wins only if it is clearly
    better, since most scans are upright and some objects look the same from several sides.

    Args:
        model: the shape model to place.
        scan_vertices_mm: (S, 3) vertices of the scan, at least one, mm.
        seed: seed of the subsample that is searched.
        with_scale: whether the pose has a free scale; None frees it if the model's gauge is shape.
        quick: whether ambiguous poses are refined once only, which is enough for a score.
    """
    from shapespace.fit.search.pose_search import search  # numba takes a while to import

    scaled = model.gauge == "shape" if with_scale is None else with_scale
    upright, poses = search(model, scan_vertices_mm, with_scale=scaled, seed=seed, quick=quick)
    traces = [float(np.trace(upright.T_scan_model.rotation @ pose.T_scan_model.rotation.T)) for pose in poses]
    starts = [
        Start(pose.T_scan_model, "upright" if trace > _SAME_TURN_TRACE else "rotations", pose.score_mm, pose.b)
        for pose, trace in zip(poses, traces, strict=True)
    ]
    best, alternatives = starts[0], tuple(starts[1:])
    runner_up = min((other.score_mm for other in alternatives), default=float("inf"))
    return replace(best, runner_up_score_mm=runner_up, alternatives=alternatives)


def start_of_any_size(model: ShapeModel, scan_vertices_mm: FloatArray, *, seed: int) -> Start:
    """Return the best pose with a free scale, for a scan that can be many times larger or smaller than the model.

    Other sizes are tried only if no pose is unambiguous at the scan's own size. They win only if they fit clearly
    better.

    Args:
        model: the shape model.
        scan_vertices_mm: (S, 3) vertices of the scan, at least one, mm.
        seed: seed of the subsample that is searched.
    """
    start = start_from_any_pose(model, scan_vertices_mm, seed=seed, with_scale=True)
    if start.score_mm <= _STANDS_OUT * start.runner_up_score_mm:
        return start
    size, limit_mm = _size(scan_vertices_mm), _STANDS_OUT * start.score_mm
    for cover in _COVERS if size > 0.0 else ():
        ratio = size / (cover * _size(model.mean_vertices))
        other = start_from_any_pose(model, scan_vertices_mm / ratio, seed=seed, with_scale=True)
        if other.score_mm <= limit_mm:
            start, limit_mm = other.scaled(ratio), other.score_mm
    return start


def start_near_frame(model: ShapeModel, scan_vertices_mm: FloatArray, *, largest_deg: float, seed: int) -> Start:
    """Return the best pose with free scale whose rotation from the scan's frame is at most `largest_deg`.

    Args:
        model: the shape model to place.
        scan_vertices_mm: (S, 3) vertices of the scan, at least one, mm.
        largest_deg: largest rotation, degrees; beyond 30, the search also starts from poses rotated by two thirds of
            it. If no refined pose is within it, the pose has the rotation of the frame.
        seed: seed of the subsample that is searched.
    """
    from shapespace.fit.search.pose_search import refine  # numba takes a while to import

    middle, centre = model.mean_vertices.mean(axis=0), scan_vertices_mm.mean(axis=0)
    turns = np.vstack([np.zeros((1, 3)), np.eye(3), -np.eye(3)])[: 1 if largest_deg <= _ONE_BASIN_DEG else None]
    rotations = Rotation.from_rotvec(2 / 3 * largest_deg * turns, degrees=True).as_matrix()
    poses = refine(
        model,
        scan_vertices_mm,
        [Similarity(1.0, R, centre - R @ middle) for R in rotations],
        with_scale=True,
        seed=seed,
    )
    limit = 1 + 2 * np.cos(np.radians(largest_deg))
    near = [pose for pose in poses if np.isfinite(pose.score_mm) and np.trace(pose.T_scan_model.rotation) >= limit]
    if not near:
        return Start(Similarity(1.0, np.eye(3), centre - middle), "given", poses[0].score_mm)
    best = min(near, key=lambda pose: pose.score_mm)
    return Start(best.T_scan_model, "given", best.score_mm, best.b)


def _size(points: FloatArray) -> float:
    return float(np.sqrt(((points - np.median(points, axis=0)) ** 2).sum(axis=1).mean()))
