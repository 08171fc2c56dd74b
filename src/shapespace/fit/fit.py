"""The whole method: repair, unit, start, phase 1, phase 2, verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Literal, TypeAlias

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace import __version__
from shapespace.errors import FitError, InputError
from shapespace.fit.regions import all_followed
from shapespace.fit.reliability import reliability
from shapespace.fit.result import FitResult, Stage, Status, doubts, posterior_stddev
from shapespace.fit.scan_target import ScanTarget, mm_frame
from shapespace.fit.settings import DenseSettings, RobustSettings
from shapespace.fit.shape_icp import shape_icp
from shapespace.fit.similarity_icp import similarity_icp
from shapespace.fit.start import Start, find_unit, start_from_any_pose, start_from_landmarks
from shapespace.fit.state import Fitted, IcpState, StopRule
from shapespace.fit.trust import doubts_of_robust, start_evidence
from shapespace.geometry.closest import ENGINES
from shapespace.geometry.distance import SurfaceDistances, surface_distances
from shapespace.geometry.doctor import repair
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh, Similarity

_FAR_OUT = 3.0
_FAR_OUT_BY_CHANCE = 0.01
_ALL_BUT_THE_RIM = 0.95
_VANISHED = 0.05
"""Share of the start's scale below which nothing is left to fit."""


@dataclass(frozen=True)
class FitConfig:
    """Settings of a fit.

    Args:
        method: a name of `METHODS`: `robust`, or `paper` for the paper's method as corrected.
        modes: how many coefficients to report, from the first; None for all. The robust method fits with all in any
            case; the paper's fits with these alone.
        unit: of the scan: a name of `MM_PER_UNIT`, or `auto` to find it.
        search: of the paper's method: `vertices` (its closest points, `auto`) or `surface` (closest points on the
            triangles). The robust method always searches the surface.
        scale: `free` fits a similarity, `fixed` a rigid motion; `auto` goes by the model's gauge.
        stop_rate: the paper's tau: stop when the RMS changes by at most this share,
        stop_motion_mm: and no vertex moves more than this, mm of the model's frame.
        max_iterations: cap of each phase.
        seed: of the subsample that the start is searched on.
        robust: settings of the robust method.
        dense: whether its surface is then taken the rest of the way to the scan, as the stage `dense`.
        dense_settings: settings of that.

    Raises:
        InputError: a name that does not exist, a number of modes below one, or a dense stage after the paper's method.
    """

    method: str = "robust"
    modes: int | None = None
    unit: str = "auto"
    search: str = "auto"
    scale: Literal["auto", "free", "fixed"] = "auto"
    stop_rate: float = 1e-4
    stop_motion_mm: float = 1e-3
    max_iterations: int = 500
    seed: int = 0
    robust: RobustSettings = field(default_factory=RobustSettings)
    dense: bool = False
    dense_settings: DenseSettings = field(default_factory=DenseSettings)

    def __post_init__(self) -> None:
        for value, choices, what in (
            (self.method, METHODS, "method"),
            (self.unit, ["auto", *MM_PER_UNIT], "unit"),
            (self.search, ["auto", *ENGINES], "search"),
            (self.scale, ("auto", "free", "fixed"), "scale"),
        ):
            if value not in choices:
                raise InputError(f"There is no {what} {value!r}; choose one of {', '.join(choices)}.")
        if self.method == "robust" and self.search != "auto":
            raise InputError(
                "The robust method always searches the scan's surface; leave search out, or use the paper's."
            )
        if self.dense and self.method != "robust":
            raise InputError(
                f"The dense stage needs the robust method; leave out dense, or the method {self.method!r}."
            )
        if self.modes is not None and self.modes < 1:
            raise InputError(f"A fit must report at least one mode, not {self.modes}.")
        self.stop_rule()

    def stop_rule(self) -> StopRule:
        """Return the stopping rule of both phases of the paper's method."""
        return StopRule(self.stop_rate, self.stop_motion_mm, self.max_iterations)


Method: TypeAlias = Callable[[ShapeModel, ScanTarget, Start, FitConfig], Generator[IcpState, None, Fitted]]
"""(model, scan, start, config) -> the states it goes through, and where it ended."""


def paper_method(
    model: ShapeModel, scan: ScanTarget, start: Start, config: FitConfig
) -> Generator[IcpState, None, Fitted]:
    """Yield the states of the paper's modified ICP: phase 1, then phase 2 from where it ended."""
    model = model if config.modes is None else model.truncate(config.modes)
    stop, with_scale, engine = (
        config.stop_rule(),
        fits_scale(model, config),
        scan.search("vertices" if config.search == "auto" else config.search),
    )
    T_scan_model, state = start.T_scan_model, None
    for state in similarity_icp(model, engine, T_scan_model, stop, with_scale=with_scale):
        T_scan_model = state.T_scan_model
        yield state
    for state in shape_icp(model, engine, T_scan_model, stop, with_scale=with_scale):
        yield state
    assert state is not None
    b_stddev = posterior_stddev(model, float(state.rms_mm**2) / 3.0)
    return Fitted(
        T_scan_model=state.T_scan_model,
        b=state.b,
        b_stddev=b_stddev,
        shrinkage=1.0 - (b_stddev / model.stddev) ** 2,
        vertices_scan_mm=state.T_scan_model.apply(model.reconstruct(state.b)),
        rms_mm=state.rms_mm,
        regions=partial(all_followed, len(model.mean_vertices)),
    )


def robust_method(
    model: ShapeModel, scan: ScanTarget, start: Start, config: FitConfig
) -> Generator[IcpState, None, Fitted]:
    """Yield the states of the robust fit: phase 1 with the pose alone, phase 2 with pose and shape together."""
    from shapespace.fit.robust import robust_icp  # compiled

    return robust_icp(
        model,
        scan,
        start,
        config.robust,
        with_scale=fits_scale(model, config),
        modes=config.modes,
        max_iterations=config.max_iterations,
    )


METHODS: Mapping[str, Method] = {"robust": robust_method, "paper": paper_method}
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
        config: settings; None for the defaults.
        landmarks: name -> (3,) in the scan's frame and unit, to start from; None to use none.
        T_scan_model: a start, from the model's frame (mm) to the scan's frame and unit; None to find one.
        on_state: called with each state of the loop, for progress bars and viewers.

    Raises:
        MeshError: the scan cannot be used at all.
        FitError: no start can be found, or the fit diverged.
        InputError: the search needs triangles that the scan lacks.
    """
    config = config or FitConfig()
    # Products this small go slower by several threads, and many fits at a time share the cores anyway.
    with threadpool_limits(limits=1, user_api="blas"):
        return _fit_scan(model, scan, config, landmarks, T_scan_model, on_state)


def _fit_scan(
    model: ShapeModel,
    scan: Mesh,
    config: FitConfig,
    landmarks: Mapping[str, FloatArray] | None,
    T_scan_model: Similarity | None,
    on_state: Callable[[IcpState], None] | None,
) -> FitResult:
    clock = [time.perf_counter()]
    scan, findings = repair(scan)
    unit = find_unit(model, scan) if config.unit == "auto" else config.unit
    mm = MM_PER_UNIT[unit]
    T_mm_scan = mm_frame(scan, mm)
    scan_mm = scan.with_vertices(T_mm_scan.apply(scan.vertices))
    target = ScanTarget(scan_mm)
    start = _start(model, scan_mm, T_mm_scan, landmarks, T_scan_model, config)
    clock.append(time.perf_counter())

    history: list[IcpState] = []
    ended: dict[int, tuple[IcpState, float]] = {}
    try:
        states = METHODS[config.method](model, target, start, config)
        while True:
            state = next(states)
            history.append(state)
            ended[state.phase] = (state, time.perf_counter())
            if on_state is not None:
                on_state(state)
            if state.T_scan_model.scale < _VANISHED * start.T_scan_model.scale:
                raise FitError(
                    f"{scan.name}: the model shrank to a point, as the plain method does when a large part of the "
                    "scan is missing; hold the scale (--scale fixed), or crop the model to what the scan shows."
                )
    except StopIteration as end:
        fitted: Fitted = end.value
    except InputError as error:
        raise FitError(f"{scan.name}: the fit diverged ({error}); give landmarks, or crop the scan.") from error

    before = Similarity(1.0, np.eye(3), scan_mm.vertices.mean(axis=0) - model.mean_vertices.mean(axis=0))
    moments = {
        "before": (before, np.zeros(model.n_modes)),
        "initial": (ended[1][0].T_scan_model, ended[1][0].b),
        "final": (fitted.T_scan_model, fitted.b),
    }
    T_scan_mm = T_mm_scan.inverse()
    stages = {
        name: Stage(T_scan_mm @ T, b, partial(_distances, model, target, T, b)) for name, (T, b) in moments.items()
    }
    dense_from = time.perf_counter()
    if config.dense:
        stages["dense"] = _dense_stage(model, target, T_scan_mm, fitted, config)
    dense_s = time.perf_counter() - dense_from
    evidence, beside = dict(fitted.evidence), None
    if config.method == "robust":
        from shapespace.fit.another import another_beside, doubts_of_layers, layers  # compiled

        evidence |= {**start_evidence(start), **layers(model, target, fitted)}
        evidence |= reliability(evidence).as_evidence()
        against = [*doubts_of_layers(evidence), *doubts_of_robust(evidence)]
        beside = another_beside(model, target, fitted, config.robust, with_scale=fits_scale(model, config))
    else:
        against = doubts(model, stages, start.T_scan_model.scale / mm)
    status, reason = _verdict(against, ended[1][0], ended[2][0], config)
    clock.append(time.perf_counter())
    return FitResult(
        scan_name=scan.name,
        status=status,
        reason=reason,
        T_scan_model=stages["final"].T_scan_model,
        mm_per_scan_unit=mm,
        b=fitted.b,
        b_stddev=fitted.b_stddev,
        shrinkage=fitted.shrinkage,
        z=fitted.b / model.stddev[: len(fitted.b)],
        z_covariance=_in_standard_deviations(fitted.b_covariance, model),
        stages=stages,
        history=history,
        method=config.method,
        config={
            **asdict(config),
            "scale_in_effect": "free" if fits_scale(model, config) else "fixed",
            "version": __version__,
        },
        start=start.how,
        evidence=evidence,
        notes=[
            *(f"{finding.what} {finding.action}".strip() for finding in findings),
            *_far_out(model, fitted.b),
            *_no_triangles(scan),
            *_not_all_seen(stages),
            *([] if beside is None else [beside]),
        ],
        seconds={
            "start": clock[1] - clock[0],
            "phase_1": ended[1][1] - clock[1],
            "phase_2": ended[2][1] - ended[1][1],
            **({"dense": dense_s} if config.dense else {}),
            "distances": clock[2] - ended[2][1] - dense_s,
        },
        model=model,
        scan=scan,
        find_regions=fitted.regions,
    )


def _in_standard_deviations(b_covariance: FloatArray | None, model: ShapeModel) -> FloatArray | None:
    if b_covariance is None:
        return None
    stddev = model.stddev[: len(b_covariance)]
    return b_covariance / (stddev[:, None] * stddev)


def _not_all_seen(stages: Mapping[str, Stage]) -> list[str]:
    dense = stages.get("dense")
    if dense is None or dense.seen is None or dense.seen.mean() > _ALL_BUT_THE_RIM:
        return []
    return [
        f"The dense surface follows the scan at {100 * dense.seen.mean():.0f} % of its vertices; where the scan shows "
        "nothing the model stands in."
    ]


def _no_triangles(scan: Mesh) -> list[str]:
    if scan.faces is not None:
        return []
    return ["It has no triangles, so distances are to its points and larger than to the surface they stand for."]


def _far_out(model: ShapeModel, b: FloatArray) -> list[str]:
    """Say when more coefficients lie far out than chance would have it; without a prior faint modes chase details."""
    far = int((np.abs(b) > _FAR_OUT * model.stddev[: len(b)]).sum())
    if far <= 1 + _FAR_OUT_BY_CHANCE * len(b):
        return []
    return [
        f"{far} of {len(b)} coefficients lie over {_FAR_OUT:g} standard deviations out; the faint modes follow "
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
    return start_from_any_pose(model, scan_mm.vertices, seed=config.seed, with_scale=fits_scale(model, config))


def _dense_stage(
    model: ShapeModel, target: ScanTarget, T_scan_mm: Similarity, fitted: Fitted, config: FitConfig
) -> Stage:
    from shapespace.fit.dense import dense_surface  # compiled

    T = fitted.T_scan_model
    dense = dense_surface(model, target, fitted.vertices_scan_mm, T, config.dense_settings)
    return Stage(
        T_scan_mm @ T,
        fitted.b,
        partial(_distances, model, target, T, fitted.b, dense.vertices_scan_mm),
        vertices=T_scan_mm.apply(dense.vertices_scan_mm),
        seen=dense.seen,
    )


def _distances(
    model: ShapeModel, target: ScanTarget, T: Similarity, b: FloatArray, vertices_scan_mm: FloatArray | None = None
) -> SurfaceDistances:
    """Measure the shape with coefficients `b` at `T`, or the surface `vertices_scan_mm` (V, 3) that was made of it."""
    vertices = T.apply(model.reconstruct(b)) if vertices_scan_mm is None else vertices_scan_mm
    placed = Mesh(vertices, model.faces, name="model")
    return surface_distances(placed, target.mesh, scan_engine=target.engine, mm_per_length=1.0 / T.scale)


def _verdict(against: Sequence[str], phase_1: IcpState, phase_2: IcpState, config: FitConfig) -> tuple[Status, str]:
    if against:
        return "doubtful", f"Do not trust this fit: {'; '.join(against)}."
    if "cap" in (phase_1.stopped, phase_2.stopped):
        which = "phase 1" if phase_1.stopped == "cap" else "phase 2"
        iterations = (phase_1 if phase_1.stopped == "cap" else phase_2).iteration
        return "max_iterations", f"{which.capitalize()} was cut off after {iterations} iterations."
    if config.method == "robust":
        return "converged", (
            f"Pose and shape stood still: the parts that match lie {phase_2.rms_mm:.2f} mm (RMS) from the scan."
        )
    return "converged", (
        f"The RMS closest distance stood still at {phase_2.rms_mm:.2f} mm: it changed by less than "
        f"{config.stop_rate:g} of itself and no vertex moved more than {config.stop_motion_mm:g} mm."
    )
