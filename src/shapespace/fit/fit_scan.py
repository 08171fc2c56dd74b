"""The complete fit of a scan: initialise the pose, run the method, measure the distances, assess the fit."""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, cast

import numpy as np
from threadpoolctl import ThreadpoolController

from shapespace.errors import FitError, InputError
from shapespace.fit.diagnostics.reasons import Reason
from shapespace.fit.diagnostics.verdict import judge
from shapespace.fit.iteration_state import UNSEEN, Fitted, IcpState
from shapespace.fit.method import FitOutcome, Limits, Method
from shapespace.fit.method_choices import method_named
from shapespace.fit.result import FitResult, Stage
from shapespace.fit.robust.prepared_model import SHARE, LandmarkConstraint
from shapespace.fit.robust.robust_settings import DenseSettings
from shapespace.fit.scan_target import ScanTarget, crop_scan, mm_frame
from shapespace.fit.search.initialisation import (
    Start,
    find_unit,
    start_from_any_pose,
    start_from_landmarks,
    start_of_any_size,
)
from shapespace.geometry.closest import ClosestPoints, SurfaceDistances, surface_distances
from shapespace.geometry.contact import find_penetrations
from shapespace.geometry.doctor import repair
from shapespace.geometry.grooming import Crop
from shapespace.geometry.landmark_placement import landmarks_in_frame_of
from shapespace.geometry.normals import part_of, rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.interop import MeshLike, as_mesh
from shapespace.io.landmarks.landmark_io import read_landmarks
from shapespace.model.region import ModelRegion, articulation_of, relative_pose
from shapespace.model.shape_model import ShapeModel
from shapespace.types import MM_PER_UNIT, BoolArray, FloatArray, IntArray, Mesh, Similarity
from shapespace.version import __version__

if TYPE_CHECKING:
    from shapespace.model.additive import AdditiveModel


@dataclass(frozen=True, eq=False)
class RegionFit:
    """Conversion of a fit of a part of a model into a fit of the complete model.

    Args:
        full: the complete model.
        part: the part of the model that is fitted.
    """

    full: ShapeModel
    part: ModelRegion

    def note(self, region: str | tuple[int, ...] | None) -> str:
        """Return a sentence on the region that the fit is restricted to."""
        called = f" {region!r}" if isinstance(region, str) else ""
        inside = self.part.inside
        return (
            f"Restricted to the region{called} of {int(inside.sum()):,} of the model's {len(inside):,} vertices; the "
            "rest of the surface is estimated by the model."
        )

    def state(self, state: IcpState) -> IcpState:
        """Return a state with the coefficients of the complete model."""
        return replace(state, b=self.part.to_b(state.b, self.full))

    def fitted(self, fitted: Fitted, modes: int | None) -> Fitted:
        """Return the end of the fit for the complete model, with its first `modes` coefficients; None for all."""
        from shapespace.fit.robust.posterior import variance_of_new_shapes  # compiled, and loads SciPy

        full, part, k = self.full, self.part, modes
        b = part.to_b(fitted.b, full)
        known = np.diag(fitted.b_stddev**2) if fitted.b_covariance is None else fitted.b_covariance
        variance = variance_of_new_shapes(full) if fitted.b_covariance is not None else full.stddev**2
        covariance = part.to_covariance(known, full, variance)
        after = np.clip(covariance.diagonal(), 0.0, variance)
        T_scan_model, shape = fitted.T_scan_model, full.reconstruct(b)
        if full.articulation is not None:
            # The part has its own frame and its own shape, which the predicted coefficients only approximate.
            own = part.model.reconstruct(fitted.b)
            index = full.articulation.part_with(part.inside)
            if index is not None and part.inside[full.articulation.slices[index]].all():
                shape = full.articulation.decode(full.vector(b).reshape(-1, 3), index, own)
            T_scan_model = T_scan_model @ fit_similarity(shape[part.inside], own, with_scale=False)
        vertices = T_scan_model.apply(shape)
        vertices[part.inside] = fitted.vertices_scan_mm
        return replace(
            fitted,
            T_scan_model=T_scan_model,
            b=b[:k],
            b_stddev=np.sqrt(after)[:k],
            shrinkage=(1.0 - after / variance)[:k],
            b_covariance=None if fitted.b_covariance is None else covariance[:k, :k],
            vertices_scan_mm=vertices,
            regions=self._regions(fitted),
        )

    def _regions(self, fitted: Fitted) -> Callable[[], IntArray]:
        def find() -> IntArray:
            regions = np.full(len(self.part.inside), UNSEEN, dtype=np.int32)
            regions[self.part.inside] = fitted.regions()
            return regions

        return find


_FAR_OUT = 3.0  # standard deviations; a normal coefficient exceeds them once in 370
_FAR_OUT_BY_CHANCE = 0.01  # share of coefficients beyond it up to which there is no note; chance alone gives 0.3 %
_ALL_BUT_THE_RIM = 0.95  # share of vertices; a complete scan still lacks vertices at its border
_NO_TRIANGLES = "It has no triangles, so distances are to its points and larger than to the surface that they sample."
_FAR_AWAY = 5.0  # standard deviations of the residuals; the median of normal ones is 0.7
_UNLIKELY = 6.0
"""Standard deviations of a relative pose in the model, beyond which a part has another pose than its fit alone: normal
values exceed it once in 500 million, and other poses by far more."""
_VANISHED = 0.05
"""Share of the start's scale below which the model counts as shrunk to a point."""

OnState: TypeAlias = Callable[[IcpState], None]
PathTo: TypeAlias = str | os.PathLike[str]


@dataclass(frozen=True)
class FitConfig:
    """Settings that all fitting methods share.

    Args:
        method: method that fits the placed model: a name of `METHODS` for its default settings, or an object such as
            `Robust(...)` or `Paper(...)`. `robust`: pose and shape jointly, from distances in both directions; `paper`:
            the paper's modified ICP.
        modes: number of coefficients to report, from the first; None for all. The robust method fits all modes in any
            case; the paper's method fits only these.
        unit: unit of the scan; `auto` detects it from its size.
        scale: `free` estimates the scale, `fixed` keeps it; `auto`: free if size is divided out of the model,
            fixed if size is kept.
        max_iterations: maximum number of iterations of each phase.
        seed: seed of the random subsample of the pose search.
        landmark_stddev_mm: standard deviation of the landmarks in mm of the scan (default: 3 % of the model's size, the
            RMS distance from its centre); `inf`: they only initialise the fit. The paper's method uses landmarks for
            the initialisation alone.
        dense: also deform the fitted surface further onto the scan, as the stage `dense` (robust method only).
        dense_settings: settings of the dense stage.
        crop: fit only the part of the scan inside `sphere:X,Y,Z,RADIUS` or `box:X,Y,Z,X,Y,Z`, outside a sphere
            (`outside:X,Y,Z,RADIUS`), or on the side of `plane:X,Y,Z,NX,NY,NZ` to which the normal N points (in its
            frame and unit), or `landmarks:MM`, within this distance in mm of the landmarks; empty for the complete
            scan.
        region: part of the model to which fit, distances and verdict are restricted: a name of `ShapeModel.regions`, or
            indices of vertices; None for the complete model.
        strict: reject scans with coordinates that are NaN or infinite (default: remove the triangles that use them,
            with a note).

    Raises:
        InputError: a name that does not exist, numbers below one, or a dense stage after a method that has none.
    """

    method: Method | str = "robust"
    modes: int | None = None
    unit: str = "auto"
    scale: Literal["auto", "free", "fixed"] = "auto"
    max_iterations: int = 500
    seed: int = 0
    dense: bool = False
    dense_settings: DenseSettings = field(default_factory=DenseSettings)
    landmark_stddev_mm: float | None = None
    crop: str = ""
    region: str | tuple[int, ...] | None = None
    strict: bool = False

    def __post_init__(self) -> None:
        for value, choices, name in (
            (self.unit, ["auto", *MM_PER_UNIT], "unit"),
            (self.scale, ("auto", "free", "fixed"), "scale"),
        ):
            if value not in choices:
                raise InputError(f"There is no {name} {value!r}; choose one of {', '.join(choices)}.")
        fitting = self.fitting
        if self.dense and not fitting.goes_on_densely:
            raise InputError(f"The dense stage needs the robust method; omit dense, or the method {fitting.name!r}.")
        if self.landmark_stddev_mm is not None and not self.landmark_stddev_mm > 0:
            raise InputError(f"Landmarks need a positive standard deviation in mm, not {self.landmark_stddev_mm}.")
        if self.crop:
            object.__setattr__(self, "crop", Crop.of(self.crop).text)
        if self.region is not None and not isinstance(self.region, str):
            object.__setattr__(self, "region", tuple(sorted({int(vertex) for vertex in self.region})))
        if self.dense and self.region is not None:
            raise InputError("The dense stage follows the complete scan; omit dense, or the region.")
        if self.modes is not None and self.modes < 1:
            raise InputError(f"A fit must report at least one mode, not {self.modes}.")
        if self.max_iterations < 1:
            raise InputError(f"A fit needs at least one iteration, not {self.max_iterations}.")

    @property
    def fitting(self) -> Method:
        """The method as an object, even if it was given by name."""
        return method_named(self.method) if isinstance(self.method, str) else self.method

    def for_scan(self, model: ShapeModel, name: str) -> FitConfig:
        """Return the settings for a scan, restricted to a part of the model if `name` ends in _PART, -PART or .PART."""
        part = next((part for part in model.parts if re.search(rf"[_.-]{re.escape(part)}$", name, re.IGNORECASE)), None)
        if part is None or self.region is not None or not self.fitting.calibrated:
            return self
        return replace(self, region=part, dense=False)

    def limits(self, model: ShapeModel) -> Limits:
        """Return the limits of the method; `auto` frees the scale if the size was removed from the model."""
        with_scale = model.gauge == "shape" if self.scale == "auto" else self.scale == "free"
        return Limits(with_scale, self.modes, self.max_iterations)

    def as_dict(self) -> dict[str, Any]:
        """Return all settings as plain data for a record, those of the method under its name."""
        # Not `asdict` of all fields: a method given by name has settings too.
        common = {name: getattr(self, name) for name in ("modes", "unit", "scale", "max_iterations", "seed", "dense")}
        method = self.fitting
        optional = {
            # JSON has no infinity.
            "landmark_stddev_mm": "inf" if self.landmark_stddev_mm == np.inf else self.landmark_stddev_mm,
            "crop": self.crop,
            "region": self.region
            if self.region is None or isinstance(self.region, str)
            else _region_settings(self.region),
            "strict": self.strict,
        }
        # Options that are not set are not written, so that such records equal those of versions without the options.
        common |= {name: value for name, value in optional.items() if value}
        return {
            "method": method.name, **common, "dense_settings": asdict(self.dense_settings),
            method.name: asdict(method),  # type: ignore[call-overload]
        }  # fmt: skip


def fit_scan(
    model: ShapeModel | AdditiveModel | PathTo,
    scan: MeshLike | Mapping[str, MeshLike],
    config: FitConfig | None = None,
    *,
    landmarks: Mapping[str, FloatArray] | PathTo | None = None,
    T_scan_model: Similarity | None = None,
    on_state: OnState | None = None,
) -> FitResult:
    """Fit `model` to a raw scan of any topology, pose and unit, and return coefficients, distances and a status.

    Args:
        model: the shape model, or the path of its file.
        scan: a mesh or point cloud, in its own frame and unit; its path; or any other input of `as_mesh`. For a model
            of several parts also name of a part -> its scan, all in one frame and unit: points of a scan belong to its
            part only. The scan of one part is fitted by this part alone.
        config: settings; None for the defaults.
        landmarks: name -> (3,) in the scan's frame and unit, or the path of their file; they initialise the fit and, in
            the robust method, constrain it (`FitConfig.landmark_stddev_mm`); None to use none.
        T_scan_model: initial pose, from the model's frame (mm) to the scan's frame and unit; None to search for it.
        on_state: called with each state of the loop, for progress bars and viewers.

    Raises:
        MeshError: the scan cannot be used at all.
        FitError: no initial pose can be found, or the fit diverged.
        InputError: the search needs triangles that the scan lacks; or `model` or `scan` has an unsupported type.
        FileError: a file cannot be read.
    """
    config = config or FitConfig()
    given = {"model": model, "scan": scan, "landmarks": landmarks}
    files = {
        name: Path(cast(PathTo, path)).absolute() for name, path in given.items() if isinstance(path, str | os.PathLike)
    }
    model = _as_model(model)
    parts = cast("Mapping[str, MeshLike]", scan) if isinstance(scan, Mapping) else dict[str, MeshLike]()
    if len(parts) == 1:
        [(part, scan)] = parts.items()
        config = config.for_scan(model, f"_{part}")
    elif parts:
        if config.region is not None or not config.fitting.calibrated:
            raise InputError("Scans of several parts need the robust method and no region; omit these options.")
        scan = join_scans(model, parts, strict=config.strict)
    scan = as_mesh(cast("MeshLike", scan))
    if "landmarks" in files:
        landmarks = read_landmarks(files["landmarks"])
    landmarks = cast("Mapping[str, FloatArray] | None", landmarks)
    # Such small products are slower with several threads, and parallel fits share the cores anyway.
    with _thread_controller().limit(limits=1, user_api="blas"):
        clock = [time.perf_counter()]
        held = None if config.region is None else RegionFit(model, ModelRegion.of(model, config.region))
        own = model if held is None else held.part.model
        placed = _place_scan(model, own, scan, config, landmarks, T_scan_model)
        clock.append(time.perf_counter())
        limits = config.limits(model)
        if held is not None:
            limits = replace(limits, modes=None, part=True)
        states = config.fitting.states(own, placed.target, placed.start, limits)
        history, phase_2_from = list[IcpState](), clock[-1]
        try:
            while True:
                state = next(states)
                if state.phase == 2 and (not history or history[-1].phase == 1):
                    phase_2_from = time.perf_counter()
                history.append(state)
                if on_state is not None:
                    on_state(state if held is None else held.state(state))
                _check_scale(state, placed)
        except StopIteration as end:
            driven = _MethodRun(history, phase_2_from, end.value)
        except InputError as error:
            advice = "give landmarks (--landmarks), or crop the scan (--crop)"
            raise FitError(f"{placed.scan.name}: the fit diverged ({error}); {advice}.") from error
        clock.append(time.perf_counter())
        stages = _measure_stages(own, placed, driven, config)
        clock.append(time.perf_counter())
        size_mm = rms_size(own.mean_vertices) * driven.fitted.T_scan_fitted.scale
        ended = FitOutcome(own, placed.start, driven.fitted, stages, driven.ended, size_mm)
        status, reasons = judge(config.fitting, ended)
        if far := _parts_far_away(model, placed.scan, driven.fitted, stages["final"]):
            status, reasons = "doubtful", (*far, *(reasons if status == "doubtful" else ()))
        if held is not None:
            driven = replace(
                driven,
                history=[held.state(state) for state in driven.history],
                fitted=held.fitted(driven.fitted, config.modes),
            )
            stages = _measure_stages(model, placed, driven, config, held.part.inside)
        clock.append(time.perf_counter())
    fitted = driven.fitted
    return FitResult(
        scan_name=placed.scan.name,
        status=status,
        reasons=reasons,
        T_scan_model=stages["final"].T_scan_model,
        mm_per_scan_unit=placed.mm_per_scan_unit,
        b=fitted.b,
        b_stddev=fitted.b_stddev,
        shrinkage=fitted.shrinkage,
        z=fitted.b / model.stddev[: len(fitted.b)],
        z_covariance=_in_standard_deviations(fitted.b_covariance, model),
        stages=stages,
        history=driven.history,
        method=config.fitting.name,
        calibrated=config.fitting.calibrated,
        config={
            **config.as_dict(),
            "scale_in_effect": "free" if config.limits(model).with_scale else "fixed",
            "version": __version__,
        },
        start=placed.start.how,
        evidence=fitted.evidence,
        notes=[
            *placed.findings,
            *([] if held is None else [held.note(config.region)]),
            *_note_large_coefficients(model, fitted.b),
            *([_NO_TRIANGLES] if placed.scan.faces is None else []),
            *_note_unobserved(stages),
            *_note_penetrations(model, fitted),
            *fitted.notes,
        ],
        seconds={
            "start": clock[1] - clock[0],
            "phase_1": driven.phase_2_from - clock[1],
            "phase_2": clock[2] - driven.phase_2_from,
            **({"dense": clock[3] - clock[2]} if config.dense else {}),
            "distances": clock[4] - clock[3],
        },
        model=model,
        scan=placed.scan,
        find_regions=fitted.regions,
        find_closest=partial(_closest, placed.target, placed.T_scan_mm.inverse()),
        landmark_stddev_mm=_landmark_stddev_mm(model, fitted, held, dense=config.dense),
        files=files,
    )


@cache
def _thread_controller() -> ThreadpoolController:
    """Return the controller of the BLAS libraries; finding them takes 2 ms, so it is done once per process."""
    import scipy.linalg  # pyright: ignore[reportUnusedImport]  # noqa: F401  # its library must be loaded to be found

    return ThreadpoolController()


def _as_model(model: ShapeModel | AdditiveModel | PathTo) -> ShapeModel:
    if isinstance(model, str | os.PathLike):
        return ShapeModel.load(Path(model))
    if isinstance(model, ShapeModel):
        return model
    shape = getattr(model, "shape", None)  # an additive model has one
    if not isinstance(shape, ShapeModel):
        raise InputError(f"A scan is fitted by a ShapeModel or by its file, not by {type(model).__name__}.")
    return shape


@dataclass(frozen=True, eq=False)
class _PlacedScan:
    """A scan in its mm frame, and the initial pose of the model there."""

    scan: Mesh
    mm_per_scan_unit: float
    T_scan_mm: Similarity
    target: ScanTarget
    start: Start
    findings: Sequence[str]


@dataclass(frozen=True, eq=False)
class _MethodRun:
    """The run of a method: every state, the time when phase 2 began, the end."""

    history: Sequence[IcpState]
    phase_2_from: float
    fitted: Fitted

    @property
    def ended(self) -> dict[int, IcpState]:
        """Last state of each phase."""
        return {state.phase: state for state in self.history}


def _check_scale(state: IcpState, placed: _PlacedScan) -> None:
    """Raise a FitError if the model has shrunk to a point."""
    if state.T_scan_model.scale < _VANISHED * placed.start.T_scan_model.scale:
        raise FitError(
            f"{placed.scan.name}: the model shrank to a point, as the plain method does when a large part of the scan "
            "is missing; fix the scale (--scale fixed), or fit only the part that it shows (--region)."
        )


def _place_scan(
    full_model: ShapeModel,
    model: ShapeModel,
    scan: Mesh,
    config: FitConfig,
    landmarks: Mapping[str, FloatArray] | None,
    T_scan_model: Similarity | None,
) -> _PlacedScan:
    """Crop and repair the scan, find its unit and the initial pose; landmarks are those of the complete model."""
    landmarks, turned = landmarks_in_frame_of(scan, landmarks or {})
    notes = list(turned)
    if config.crop:
        scan, cropped = crop_scan(Crop.of(config.crop), scan, full_model, landmarks, config.unit)
        notes.append(cropped)
    scan, findings = repair(scan, strict=config.strict) if scan.parts is None else (scan, ())
    find = find_unit if scan.parts is None else _unit_of_parts
    mm = MM_PER_UNIT[find(model, scan) if config.unit == "auto" else config.unit]
    T_mm_scan = mm_frame(scan, mm)
    scan_mm = scan.with_vertices(T_mm_scan.apply(scan.vertices))
    with_scale = config.limits(model).with_scale
    marks_mm = {name: T_mm_scan.apply(point) for name, point in landmarks.items()}
    if T_scan_model is not None:
        start = Start(T_mm_scan @ T_scan_model, "given", float("nan"))
    elif landmarks:
        start = start_from_landmarks(full_model, marks_mm, scan.name, with_scale=with_scale)
    elif scan.parts is not None:
        part_config = replace(config, unit="mm", crop="", dense=False, modes=None)
        start = _start_from_parts(
            model,
            scan_mm,
            lambda own, part: fit_scan(model, own, replace(part_config, region=part)),
            with_scale=with_scale,
        )
    elif with_scale:
        start = start_of_any_size(model, scan_mm.vertices, seed=config.seed)
    else:
        start = start_from_any_pose(model, scan_mm.vertices, seed=config.seed, with_scale=False)
    if landmarks:
        stddev_mm = config.landmark_stddev_mm or SHARE * rms_size(full_model.mean_vertices) * start.T_scan_model.scale
        start = replace(start, marks=LandmarkConstraint.of(model, marks_mm, stddev_mm))
    notes += [*scan.notes, *(f"{finding.problem} {finding.action}".strip() for finding in findings)]
    target = ScanTarget(scan_mm, None if scan.parts is None else model.part_of_vertex)
    return _PlacedScan(scan, mm, T_mm_scan.inverse(), target, start, notes)


def join_scans(model: ShapeModel, scans: Mapping[str, MeshLike], *, strict: bool) -> Mesh:
    """Return scans of parts of one subject, by the names of the parts, as one repaired scan with `Mesh.parts`.

    Args:
        model: shape model with these parts.
        scans: scan of each part, in one frame and unit.
        strict: see `repair`.

    Raises:
        InputError: other parts than those of the model, or the same scan twice.
        MeshError: a scan cannot be used.
    """
    if not scans or not set(scans) <= set(model.parts):
        raise InputError(
            f"The scans are of {', '.join(scans) or 'no part'}, and the model has the parts "
            f"{', '.join(model.parts) or '(none)'}; give scans of its parts."
        )
    meshes, notes = list[Mesh](), list[str]()
    for part, scan in scans.items():
        mesh, findings = repair(as_mesh(scan), strict=strict)
        for other, own in zip(scans, meshes, strict=False):
            if np.array_equal(own.vertices, mesh.vertices):
                raise InputError(f"{mesh.name}: {other} and {part} are the same scan; give the scan of each part.")
        notes += [f"{part}: {note}" for note in (*mesh.notes, *(f"{f.problem} {f.action}".strip() for f in findings))]
        meshes.append(mesh)
    counts = [len(mesh.vertices) for mesh in meshes]
    starts = np.cumsum([0, *counts])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False) if mesh.faces is not None]
    colours = [mesh.colours for mesh in meshes if mesh.colours is not None]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces) if len(faces) == len(meshes) else None,
        {name: point for mesh in meshes for name, point in mesh.landmarks.items()},
        meshes[0].name.removesuffix(next(iter(scans))).rstrip("_-. ") or meshes[0].name,
        np.concatenate(colours) if len(colours) == len(meshes) else None,
        tuple(notes),
        parts=np.repeat([model.parts.index(part) for part in scans], counts).astype(np.int32),
    )


def _scan_of_each_part(model: ShapeModel, scan: Mesh) -> dict[str, Mesh]:
    """Return the scan of each part that a scan with known parts has, by the name of the part."""
    found = {part: scan.parts == k for k, part in enumerate(model.parts)}
    return {
        part: replace(part_of(scan, own), parts=None, name=f"{scan.name} {part}")
        for part, own in found.items()
        if own.any()
    }  # fmt: skip


def _unit_of_parts(model: ShapeModel, scan: Mesh) -> str:
    """Return the unit of a scan with known parts: that of the part of which it shows most, by its size.

    Raises:
        FitError: that part has the size of its part of the model in no unit.
    """
    sizes = {
        part: rms_size(own.vertices) / rms_size(model.mean_vertices[model.regions[part]])
        for part, own in _scan_of_each_part(model, scan).items()
    }
    largest = max(sizes, key=lambda part: sizes[part])
    return find_unit(ModelRegion.of(model, largest).model, _scan_of_each_part(model, scan)[largest])


def _start_from_parts(
    model: ShapeModel, scan_mm: Mesh, fit: Callable[[Mesh, str], FitResult], *, with_scale: bool
) -> Start:
    """Return the pose and shape that are nearest to the fits of the parts of a scan, each alone.

    Args:
        model: shape model of several parts.
        scan_mm: scan with known parts in its mm frame.
        fit: function that fits a scan by a part of the model.
        with_scale: whether the scale is free.

    Raises:
        FitError: two parts are exchanged or have different units.
        InputError: the relative pose was removed from the model.
    """
    pose = relative_pose(model)
    if pose is None or pose.choice == "removed":
        raise InputError(
            "The relative pose was removed from the model, so parts have no joint fit; fit each part alone, or build "
            "the model with --relative-pose modelled."
        )
    scans = _scan_of_each_part(model, scan_mm)
    fits = {part: fit(own, part) for part, own in scans.items()}

    def is_fit(scan: Mesh, part: str) -> bool:
        with suppress(FitError):
            return fit(scan, part).status != "doubtful"
        return False

    doubtful = [part for part, found in fits.items() if found.status == "doubtful"]
    for part in doubtful:
        for other in set(fits) - {part}:
            if is_fit(scans[part], other) and is_fit(scans[other], part):
                raise FitError(f"{scan_mm.name}: {part} and {other} are exchanged; rename their scans.")
        mm = MM_PER_UNIT[find_unit(ModelRegion.of(model, part).model, scans[part])]
        if mm != 1.0 and is_fit(scans[part].with_vertices(mm * scans[part].vertices), part):
            raise FitError(f"{scan_mm.name}: {part} has another unit than the other parts; export them in one unit.")
    # A small piece of a part has no certain pose alone.
    sure = [part for part in fits if part not in doubtful] or list(fits)
    vertices = np.full(model.mean_vertices.shape, np.nan)
    for part in sure:
        vertices[model.regions[part]] = fits[part].surface().vertices[model.regions[part]]
    scale = fits[sure[0]].T_scan_model.scale
    poses = articulation_of(model).poses_of(np.where(np.isnan(vertices), model.mean_vertices, vertices / scale))
    for joint, rotation, translation in zip(pose.joints, poses.rotation, poses.translation, strict=True):
        turn, shift = np.rad2deg(np.linalg.norm(rotation)), np.linalg.norm(translation)
        # A part that looks alike from both ends, or is in another frame; the joint fit decides.
        if max(turn / joint.rotation_deg, shift / joint.translation_mm) > _UNLIKELY and joint.parent in sure:
            vertices[model.regions[joint.part]] = np.nan
    error_mm = max(e.expected_error_mm for part in sure if (e := fits[part].evidence) is not None) / scale
    b, T = model.nearest_in_any_pose(vertices, with_scale=with_scale, noise=error_mm**2 / 3.0)
    is_complete = not any(np.isnan(vertices[model.regions[part]]).any() for part in scans)
    return Start(T, "parts", float("nan"), b if is_complete else np.zeros(len(b)))  # the mean pose is nearer then


def _parts_far_away(model: ShapeModel, scan: Mesh, fitted: Fitted, final: Stage) -> list[Reason]:
    """Return a reason for doubt for each part of a scan with known parts that its fitted surface does not follow."""
    if scan.parts is None or fitted.evidence is None:
        return []
    distance_mm, limit_mm = final.distances.scan_to_model_mm, _FAR_AWAY * fitted.evidence.spread_mm
    return [
        Reason.other(
            f"the fitted {part} is {median_mm:.1f} mm from its scan (median), which may be in another frame or of "
            "another subject"
        )
        for k, part in enumerate(model.parts)
        if (own := scan.parts == k).any() and (median_mm := float(np.median(distance_mm[own]))) > limit_mm
    ]


def _measure_stages(
    model: ShapeModel, placed: _PlacedScan, driven: _MethodRun, config: FitConfig, region: BoolArray | None = None
) -> dict[str, Stage]:
    """Return the surface at each stage, with its distances, restricted to `region` (V,) and measured on demand."""
    target, fitted, T_scan_mm = placed.target, driven.fitted, placed.T_scan_mm
    together = target.mesh.vertices.mean(axis=0) - model.mean_vertices.mean(axis=0)
    moments = {
        "before": (Similarity(1.0, np.eye(3), together), np.zeros(model.n_modes)),
        "initial": (driven.ended[1].T_scan_model, driven.ended[1].b),
        "final": (fitted.T_scan_model, fitted.b),
    }
    stages = {
        name: Stage(T_scan_mm @ T, b, partial(_measure_distances, model, target, T, b, None, region))
        for name, (T, b) in moments.items()
    }
    if region is not None and not model.is_linear:
        own_mm = fitted.vertices_scan_mm
        measure = partial(_measure_distances, model, target, fitted.T_scan_model, fitted.b, own_mm, region)
        stages["final"] = replace(stages["final"], measure=measure, vertices=T_scan_mm.apply(own_mm))
    if config.dense:
        stages["dense"] = _dense_stage(model, target, T_scan_mm, fitted, config)
    return stages


def _landmark_stddev_mm(
    model: ShapeModel, fitted: Fitted, held: RegionFit | None, *, dense: bool
) -> dict[str, FloatArray] | None:
    """Return name -> (3,) standard deviation of the position of each landmark of the model, mm of the scan."""
    if fitted.landmark_covariance is None:
        return None
    variance = np.einsum("lii->li", fitted.landmark_covariance).copy()
    landmarks = model.landmarks if held is None else model.landmarks.within(held.part.inside)
    if not dense:
        # The surface was projected onto the model's modes, and the projection moves a landmark away from its position.
        in_modes = fitted.T_scan_model.apply(landmarks.interpolate(model.reconstruct(fitted.b)))
        variance += (in_modes - landmarks.interpolate(fitted.vertices_scan_mm)) ** 2
    return dict(zip(landmarks, np.sqrt(variance), strict=True))


def _note_penetrations(model: ShapeModel, fitted: Fitted) -> list[str]:
    """Return a sentence on each part of the fitted surface that lies inside another by more than the expected error."""
    if not model.parts or model.faces is None or fitted.evidence is None:
        return []
    surface = Mesh(fitted.vertices_scan_mm, model.faces)
    found = find_penetrations(surface, model.vertices_of_parts)
    return [
        f"{100 * penetration.share:.1f} % of the vertices of {penetration.part} lie inside {penetration.other}, by up "
        f"to {penetration.depth_mm:.1f} mm; the parts of a subject do not."
        for penetration in found
        if penetration.depth_mm > fitted.evidence.posterior_error_mm
    ]


def _region_settings(vertices: tuple[int, ...]) -> dict[str, Any]:
    """Return the entry of a record for a region that has no name in the model."""
    numbers = np.array(vertices, dtype="<i8").tobytes()
    return {"vertices": len(vertices), "hash": hashlib.sha256(numbers).hexdigest()}


def _in_standard_deviations(b_covariance: FloatArray | None, model: ShapeModel) -> FloatArray | None:
    if b_covariance is None:
        return None
    stddev = model.stddev[: len(b_covariance)]
    return b_covariance / (stddev[:, None] * stddev)


def _note_unobserved(stages: Mapping[str, Stage]) -> list[str]:
    dense = stages.get("dense")
    if dense is None or dense.seen is None or dense.seen.mean() > _ALL_BUT_THE_RIM:
        return []
    return [
        f"The dense surface follows the scan at {100 * dense.seen.mean():.0f} % of its vertices; at the others the "
        "scan shows nothing, and the surface follows the model."
    ]


def _note_large_coefficients(model: ShapeModel, b: FloatArray) -> list[str]:
    """Return a note if more coefficients are large than by chance; without a prior, faint modes follow scan details."""
    far = int((np.abs(b) > _FAR_OUT * model.stddev[: len(b)]).sum())
    if far <= 1 + _FAR_OUT_BY_CHANCE * len(b):
        return []
    return [
        f"{far} of {len(b)} coefficients lie over {_FAR_OUT:g} standard deviations out; the faint modes follow "
        "details of the scan that the model does not contain; build the model with fewer modes (--modes) for plausible "
        "coefficients."
    ]


def _dense_stage(
    model: ShapeModel, target: ScanTarget, T_scan_mm: Similarity, fitted: Fitted, config: FitConfig
) -> Stage:
    from shapespace.fit.dense.dense_fit import dense_surface  # compiled

    T = fitted.T_scan_model
    dense = dense_surface(model, target, fitted.vertices_scan_mm, fitted.T_scan_fitted, config.dense_settings)
    return Stage(
        T_scan_mm @ T,
        fitted.b,
        partial(_measure_distances, model, target, T, fitted.b, dense.vertices_scan_mm),
        vertices=T_scan_mm.apply(dense.vertices_scan_mm),
        seen=dense.seen,
        moved_mm=dense.moved_mm * fitted.T_scan_fitted.scale,
    )


def _closest(target: ScanTarget, T_mm_scan: Similarity, points: FloatArray) -> ClosestPoints:
    return target.engine.query(T_mm_scan.apply(points) + target.vertex_shift(slice(None)))


def _measure_distances(
    model: ShapeModel, target: ScanTarget, T: Similarity, b: FloatArray, vertices_scan_mm: FloatArray | None = None,
    region: BoolArray | None = None,
) -> SurfaceDistances:  # fmt: skip
    """Measure the shape with coefficients `b` at `T`, or the surface `vertices_scan_mm` (V, 3) derived from that shape.

    Distances are in mm of the scan. If `region` (V,) is given, only its vertices count.
    """
    vertices = T.apply(model.reconstruct(b)) if vertices_scan_mm is None else vertices_scan_mm
    placed = Mesh(vertices + target.vertex_shift(slice(None)), model.faces, name="model")
    region = target.shown if region is None else region
    return surface_distances(placed, target.searched, scan_engine=target.engine, region=region)
