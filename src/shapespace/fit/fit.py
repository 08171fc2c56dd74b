"""The whole method: repair, unit, start, phase 1, phase 2, verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Literal

import numpy as np

from shapespace import __version__
from shapespace.errors import FitError, InputError
from shapespace.fit.result import FitResult, Stage, Status, doubts, posterior_stddev
from shapespace.fit.shape_icp import shape_icp
from shapespace.fit.similarity_icp import similarity_icp
from shapespace.fit.start import Start, find_unit, start_from_any_pose, start_from_landmarks
from shapespace.fit.state import IcpState, StopRule
from shapespace.geometry.closest import ENGINES, ClosestPointEngine, build_engine, finest_engine
from shapespace.geometry.distance import SurfaceDistances, surface_distances
from shapespace.geometry.doctor import repair
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh, Similarity

_FAR_OUT = 3.0
_FAR_OUT_BY_CHANCE = 0.01
_VANISHED = 0.05
"""Share of the start's scale below which nothing is left to fit."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit; the defaults are the paper's method as corrected.

    Args:
        method: a name of `METHODS`.
        unit: of the scan: a name of `MM_PER_UNIT`, or `auto` to find it.
        search: `vertices` (the paper's closest points) or `surface` (closest points on the triangles).
        scale: `free` fits a similarity, `fixed` a rigid motion; `auto` goes by the model's gauge.
        stop_rate: the paper's tau: stop when the RMS changes by at most this share,
        stop_motion_mm: and no vertex moves more than this, mm of the model's frame.
        max_iterations: cap of each phase.
        seed: of the subsample that the start is searched on.

    Raises:
        InputError: a name that does not exist.
    """

    method: str = "paper"
    unit: str = "auto"
    search: str = "vertices"
    scale: Literal["auto", "free", "fixed"] = "auto"
    stop_rate: float = 1e-4
    stop_motion_mm: float = 1e-3
    max_iterations: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        for value, choices, what in (
            (self.method, METHODS, "method"),
            (self.unit, ["auto", *MM_PER_UNIT], "unit"),
            (self.search, ENGINES, "search"),
            (self.scale, ("auto", "free", "fixed"), "scale"),
        ):
            if value not in choices:
                raise InputError(f"There is no {what} {value!r}; choose one of {', '.join(choices)}.")
        self.stop_rule()

    def stop_rule(self) -> StopRule:
        """Return the stopping rule of both phases."""
        return StopRule(self.stop_rate, self.stop_motion_mm, self.max_iterations)


def paper_method(
    model: ShapeModel, scan: ClosestPointEngine, T_scan_model: Similarity, config: FitConfig
) -> Iterator[IcpState]:
    """Yield the states of the paper's modified ICP: phase 1, then phase 2 from where it ended."""
    stop, with_scale = config.stop_rule(), fits_scale(model, config)
    for state in similarity_icp(model, scan, T_scan_model, stop, with_scale=with_scale):
        T_scan_model = state.T_scan_model
        yield state
    yield from shape_icp(model, scan, T_scan_model, stop, with_scale=with_scale)


METHODS: Mapping[str, Callable[[ShapeModel, ClosestPointEngine, Similarity, FitConfig], Iterator[IcpState]]] = {
    "paper": paper_method,
}
"""Fitting methods by name: each yields states, and the last of each phase is where that phase ended."""


def fits_scale(model: ShapeModel, config: FitConfig) -> bool:
    """Return whether the pose has a free scale: as told, or as the model's gauge has it."""
    return model.gauge == "shape" if config.scale == "auto" else config.scale == "free"


def fit_scan(
    model: ShapeModel,
    scan: Mesh,
    config: FitConfig | None = None,
    *,
    landmarks: Mapping[str, FloatArray] | None = None,
    T_scan_model: Similarity | None = None,
    on_state: Callable[[IcpState], None] | None = None,
) -> FitResult:
    """Fit `model` to a raw scan of any topology, pose and unit, and return its coefficients and how far to trust them.

    Args:
        model: the shape space.
        scan: a mesh or point cloud, in its own frame and unit.
        config: settings; None for the paper's method.
        landmarks: name -> (3,) in the scan's frame and unit, to start from; None to use none.
        T_scan_model: a start, from the model's frame (mm) to the scan's frame and unit; None to find one.
        on_state: called with each state of the loop, for progress bars and viewers.

    Raises:
        MeshError: the scan cannot be used at all.
        FitError: no start can be found, or the fit diverged.
        InputError: the search needs triangles that the scan lacks.
    """
    config = config or FitConfig()
    clock = [time.perf_counter()]
    scan, findings = repair(scan)
    unit = find_unit(model, scan) if config.unit == "auto" else config.unit
    mm = MM_PER_UNIT[unit]
    centre = np.median(scan.vertices, axis=0)
    T_mm_scan = Similarity(mm, np.eye(3), -mm * centre)  # near the origin, where float64 is finest
    scan_mm = scan.with_vertices(T_mm_scan.apply(scan.vertices))
    engine = build_engine(scan_mm, config.search)
    start = _start(model, scan_mm, T_mm_scan, landmarks, T_scan_model, config)
    clock.append(time.perf_counter())

    history: list[IcpState] = []
    ended: dict[int, tuple[IcpState, float]] = {}
    try:
        for state in METHODS[config.method](model, engine, start.T_scan_model, config):
            history.append(state)
            ended[state.phase] = (state, time.perf_counter())
            if on_state is not None:
                on_state(state)
            if state.T_scan_model.scale < _VANISHED * start.T_scan_model.scale:
                raise FitError(
                    f"{scan.name}: the model shrank to a point, as the plain method does when a large part of the "
                    "scan is missing; hold the scale (--scale fixed), or crop the model to what the scan shows."
                )
    except InputError as error:
        raise FitError(f"{scan.name}: the fit diverged ({error}); give landmarks, or crop the scan.") from error

    before = Similarity(1.0, np.eye(3), scan_mm.vertices.mean(axis=0) - model.mean_vertices.mean(axis=0))
    final = ended[2][0]
    moments = {
        "before": (before, np.zeros(model.n_modes)),
        "initial": (ended[1][0].T_scan_model, ended[1][0].b),
        "final": (final.T_scan_model, final.b),
    }
    surface_engine = engine if config.search == finest_engine(scan_mm) else build_engine(scan_mm)
    stages = {
        name: _stage(model, scan_mm, surface_engine, T_mm_scan.inverse(), T, b) for name, (T, b) in moments.items()
    }
    start_scale = start.T_scan_model.scale / mm
    status, reason = _verdict(model, stages, start_scale, ended[1][0], final, config)
    clock.append(time.perf_counter())
    residual_variance = float((final.rms_mm**2) / 3.0)
    return FitResult(
        scan_name=scan.name,
        status=status,
        reason=reason,
        T_scan_model=stages["final"].T_scan_model,
        mm_per_scan_unit=mm,
        b=final.b,
        b_stddev=posterior_stddev(model, residual_variance),
        z=final.b / model.stddev,
        stages=stages,
        history=history,
        method=config.method,
        config={
            **asdict(config),
            "scale_in_effect": "free" if fits_scale(model, config) else "fixed",
            "version": __version__,
        },
        start=start.how,
        notes=[
            *(f"{finding.what} {finding.action}".strip() for finding in findings),
            *_far_out(model, final.b),
            *_no_triangles(scan),
        ],
        seconds={
            "start": clock[1] - clock[0],
            "phase_1": ended[1][1] - clock[1],
            "phase_2": ended[2][1] - ended[1][1],
            "distances": clock[2] - ended[2][1],
        },
        model_hash=model.content_hash,
    )


def _no_triangles(scan: Mesh) -> list[str]:
    if scan.faces is not None:
        return []
    return ["It has no triangles, so distances are to its points and larger than to the surface they stand for."]


def _far_out(model: ShapeModel, b: FloatArray) -> list[str]:
    """Say when more coefficients lie far out than chance would have it; without a prior faint modes chase details."""
    far = int((np.abs(b) > _FAR_OUT * model.stddev).sum())
    if far <= 1 + _FAR_OUT_BY_CHANCE * model.n_modes:
        return []
    return [
        f"{far} of {model.n_modes} coefficients lie over {_FAR_OUT:g} standard deviations out; the faint modes follow "
        "details of the scan that the model does not know, so build it with fewer modes for plausible ones."
    ]


def _start(
    model: ShapeModel,
    scan_mm: Mesh,
    T_mm_scan: Similarity,
    landmarks: Mapping[str, FloatArray] | None,
    T_scan_model: Similarity | None,
    config: FitConfig,
) -> Start:
    if T_scan_model is not None:
        return Start(T_mm_scan @ T_scan_model, "given", float("nan"))
    if landmarks:
        placed = {name: T_mm_scan.apply(point) for name, point in landmarks.items()}
        return start_from_landmarks(model, placed, scan_mm.name, with_scale=fits_scale(model, config))
    return start_from_any_pose(model, scan_mm.vertices, seed=config.seed)


def _stage(
    model: ShapeModel, scan_mm: Mesh, engine: ClosestPointEngine, T_scan_mm: Similarity, T: Similarity, b: FloatArray
) -> Stage:
    return Stage(T_scan_mm @ T, b, partial(_distances, model, scan_mm, engine, T, b))


def _distances(
    model: ShapeModel, scan_mm: Mesh, engine: ClosestPointEngine, T: Similarity, b: FloatArray
) -> SurfaceDistances:
    placed = Mesh(T.apply(model.reconstruct(b)), model.faces, name="model")
    return surface_distances(placed, scan_mm, scan_engine=engine, mm_per_length=1.0 / T.scale)


def _verdict(
    model: ShapeModel,
    stages: Mapping[str, Stage],
    start_scale: float,
    phase_1: IcpState,
    phase_2: IcpState,
    config: FitConfig,
) -> tuple[Status, str]:
    against = doubts(model, stages, start_scale)
    if against:
        return "doubtful", f"Do not trust this fit: {'; '.join(against)}."
    if "cap" in (phase_1.stopped, phase_2.stopped):
        which = "phase 1" if phase_1.stopped == "cap" else "phase 2"
        return "max_iterations", f"{which.capitalize()} was cut off after {config.max_iterations} iterations."
    return "converged", (
        f"The RMS closest distance stood still at {phase_2.rms_mm:.2f} mm: it changed by less than "
        f"{config.stop_rate:g} of itself and no vertex moved more than {config.stop_motion_mm:g} mm."
    )
