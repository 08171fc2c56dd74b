"""Completion of a partial scan: the surface that follows the scan where it shows one, and its distribution elsewhere.

Equation numbers are those of docs/completion.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Literal, TypeAlias, cast

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from shapespace.errors import FitError, InputError
from shapespace.fit.completion.part_prediction import PartPrediction, predict_parts
from shapespace.fit.completion.shape_posterior import AS_LIKELY, OTHER_SIZE, ShapePosterior, shape_posterior
from shapespace.fit.completion.surface_calibration import SurfaceCalibration, calibrate
from shapespace.fit.dense.dense_fit import dense_surface
from shapespace.fit.diagnostics.failure_model import converged_reason
from shapespace.fit.diagnostics.reasons import Reason, ReasonCode, sentence_of
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.result import FitResult, Status
from shapespace.fit.robust.kernels import Float32Array
from shapespace.fit.robust.prepared_model import SHARE, LandmarkConstraint
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget, mm_frame
from shapespace.fit.search.initialisation import start_from_any_pose
from shapespace.geometry.closest import build_engine
from shapespace.geometry.landmark_placement import landmarks_in_frame_of
from shapespace.geometry.mirror_plane import SYMMETRIC_SHARE, find_mirror
from shapespace.geometry.normals import boundary_edges, enclosed_volume, face_areas, face_vectors, part_of, rms_size
from shapespace.geometry.procrustes import centroid_size
from shapespace.geometry.remesh import loop_operator
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.interop import MeshLike
from shapespace.io.landmarks.landmark_io import read_landmarks
from shapespace.io.memory_cache import cached_with_owner
from shapespace.model.region import ModelRegion, relative_pose
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import describe_briefly
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity

KNOWLEDGE = ("observed", "estimated", "unknowable")
"""Codes 0 to 2 of vertices: the scan shows them; it determines them in part; it does not reduce their variance."""
OBSERVED, ESTIMATED, UNKNOWABLE = range(3)

_FEWEST_SHAPES = 5  # training shapes; fewer determine no covariance
_SURE, _STANDS_OUT = 0.9, 0.8
"""Share of the vertices from which on a fit without doubts is in the only likely pose; the same from half of it on, if
the score of its start relative to that of other poses is below the second number, as in the choice of the unit."""
_OTHER_POSE = 0.1  # share of the size by which another pose differs
_LEAST_OBSERVED = 0.1  # share of the vertices below which a completion would be the mean shape in an unknown pose
_COMPLETE = 0.97  # share of the vertices from which on only the border of the scan is missing
_ON_SCAN = 5.0  # multiple of the noise within which a refined vertex is on the scan
_LEAST_GAIN = 0.1  # share of a vertex's variance that a scan removes, of models without training shapes
_UNEXPLAINED = 0.57
"""Share of the median distance of training shapes from the mean shape beyond which the model does not explain a scan:
8 cut femora and 16 raw faces in the right pose reached 0.49, other objects without another doubt began at 0.67
(objects of benchmarks/self_calibration.py, models of 12 and 18)."""
_MOST_OFF_MODEL = 4.0
"""Off-model standard deviation of a scan, in units of the predicted one, of models without training shapes: 10 real
femora reach 1.5, 130 of 132 other objects at least 4.6, and the others are doubtful for other reasons (open femur
model, `benchmarks/self_calibration.py wrong`)."""
_LEAST_OF_PART = 1 / 3
"""Share of a part with a modelled relative pose that determines the pose: half of a tibia did in 8 of 8 limbs, and a
fifth in 5 of 6 (docs/structures.md)."""
_LEAST_AREA, _REVERTS = 0.1, 20  # share of its area that a triangle keeps on the scan, and rounds to enforce it
_IMPLAUSIBLE, _RARE = 3.0, 1e-5
"""Mean square of the coefficients in standard deviations of new shapes (1.4 is the most measured, with 51 modes), and
the probability of a normal shape to be implausible, which decides for few modes."""
_OF_MISSING_PARTS = frozenset(
    {
        ReasonCode.EXPECTED_ERROR, ReasonCode.PROBABLY_FAILED, ReasonCode.MODEL_FAR_FROM_SCAN, ReasonCode.MODEL_UNSEEN,
        ReasonCode.MODEL_UNMATCHED, ReasonCode.FEW_TRAINING_SHAPES, ReasonCode.MODEL_TOO_NARROW,
        ReasonCode.MODE_IMPLAUSIBLE, ReasonCode.SHAPE_IMPLAUSIBLE, ReasonCode.LEADING_MODES_IMPLAUSIBLE,
    }
)  # fmt: skip
"""Reasons to doubt a fit that follow from missing parts, and that tests of the completion replace."""
_BY_TRAINING_SHAPES = frozenset(
    {
        ReasonCode.PROBABLY_FAILED, ReasonCode.FEW_TRAINING_SHAPES, ReasonCode.RESIDUAL_SPREAD,
        ReasonCode.NORMALS_DISAGREE,
    }
)  # fmt: skip
"""Those of them whose tests need the training shapes of the model."""

_SETTINGS = RobustSettings(vertex_share=0.0)
"""Of the posterior: vertices on flat triangles of the scan are matched inside of its curved surface."""

Function: TypeAlias = Callable[[Mesh], float]


@dataclass(frozen=True)
class CompletionConfig:
    """Settings of a completion.

    Args:
        samples: number of samples of the complete shape.
        part: region of the model that is estimated even where the scan shows it, such as a diseased or damaged part
            (default: none).
        mirror: `combined` also uses the mirror image of the observed side of a symmetric object, weighted by how well
            sides predict each other; `alone` uses the mirror image instead of the model wherever the mirrored side is
            observed.
        with_doubtful: complete scans whose fit is doubtful too (default: reject them).
        seed: seed of the samples.
        fit: settings of the fit.

    Raises:
        InputError: fewer than two samples, a `mirror` that does not exist, or a fit by another method than `robust`.
    """

    samples: int = 100
    part: str | None = None
    mirror: Literal["never", "combined", "alone"] = "never"
    with_doubtful: bool = False
    seed: int = 0
    fit: FitConfig = field(default_factory=FitConfig)

    def __post_init__(self) -> None:
        if self.samples < 2:
            raise InputError(f"A distribution needs at least two samples, not {self.samples}.")
        if self.mirror not in ("never", "combined", "alone"):
            raise InputError(f"There is no mirror {self.mirror!r}; choose one of never, combined, alone.")
        if self.fit.fitting.name != "robust":
            raise InputError("A completion needs a fit by the robust method.")


@dataclass(frozen=True)
class QuantityEstimate:
    """A quantity of the completed shape.

    Args:
        name: name of the quantity.
        unit: unit of the values, such as mm; empty for plain numbers.
        value: value of the quantity on the completed surface.
        mean: mean of the predictive distribution.
        stddev: standard deviation of the predictive distribution.
        low: lower end of the interval.
        high: upper end of the interval.
        level: probability of the interval.
        calibrated_on: number of training shapes, each held out in turn, from which mean, standard deviation and
            interval are estimated; 0 if they come from the samples and are not calibrated.
    Example:
        >>> completion = ss.complete(model, meshes[0], ss.CompletionConfig(samples=4))
        >>> width = completion.estimate(lambda mesh: float(np.ptp(mesh.vertices[:, 0])), "width", "mm")
        >>> width.low <= width.value <= width.high
        True
    """

    name: str
    unit: str
    value: float
    mean: float
    stddev: float
    low: float
    high: float
    level: float
    calibrated_on: int


@dataclass(frozen=True, eq=False)
class Completion:
    """A completed scan.

    Args:
        fit: the fit that the completion is based on.
        status: `converged` or `doubtful`.
        reasons: reasons for the status.
        notes: sentences on the scan and the completion.
        config: settings.
        vertices: (V, 3) vertices of the completed surface in the frame and unit of the scan.
        knowledge: (V,) int32 code of each vertex in `KNOWLEDGE`.
        stddev_mm: (V,) standard deviation of the position of each vertex, mm of the scan: the root of the sum of the
            variances along three axes.
        posterior: joint distribution of pose, coefficients and off-model variation; for the scan of one part, the
            prediction of all parts.
        T_scan_model: pose of the posterior, from the model's frame (mm) to the frame and unit of the scan.
        calibration: completions of the training shapes, each by a model of the other shapes, from which intervals,
            skill and status are estimated; None if the model neither contains nor counts its training shapes.

    Example:
        >>> completion = ss.complete(model, meshes[0], ss.CompletionConfig(samples=4))
        >>> completion.vertices.shape == meshes[0].vertices.shape
        True
    """

    fit: FitResult
    status: Status
    reasons: tuple[Reason, ...]
    notes: tuple[str, ...]
    config: CompletionConfig
    vertices: FloatArray
    knowledge: IntArray
    stddev_mm: FloatArray
    posterior: ShapePosterior | PartPrediction = field(repr=False)
    T_scan_model: Similarity = field(repr=False)
    calibration: SurfaceCalibration | None = field(repr=False)

    def __repr__(self) -> str:
        return f"<Completion of {describe_briefly(self.scan_name)}: {self.status}. {self.reason}>"

    @property
    def scan_name(self) -> str:
        """Name of the scan."""
        return self.fit.scan_name

    @property
    def model(self) -> ShapeModel:
        """The model."""
        return self.fit.model

    @property
    def reason(self) -> str:
        """One sentence that explains the status."""
        return sentence_of(self.status, self.reasons)

    @property
    def observed(self) -> BoolArray:
        """(V,) True where the scan shows the vertex."""
        return self.knowledge == OBSERVED

    def surface(self) -> Mesh:
        """Return the completed surface on the model's triangles, with its landmarks and mask of observed vertices."""
        return self._mesh(self.vertices, self.observed)

    def draw_samples(self, count: int | None = None) -> Float32Array:
        """Return (count, V, 3) float32 complete shapes in the frame and unit of the scan (E6).

        `count` is None for `config.samples`.

        The same seed and count give the same samples.
        """
        rng = np.random.default_rng(self.config.seed)
        moved = self.posterior.draw_displacements(count or self.config.samples, rng)
        turn = (self.T_scan_model.scale * self.T_scan_model.rotation).astype(np.float32)
        moved = moved @ turn.T
        moved += self.vertices.astype(np.float32)
        return moved

    def estimate(self, function: Function, name: str = "", unit: str = "", *, level: float = 0.95) -> QuantityEstimate:
        """Return the distribution of a function of the shape.

        Args:
            function: function of the mesh of a complete shape, in the frame and unit of the scan, that returns a
                number.
            name: name of the quantity.
            unit: unit of the values.
            level: probability of the interval, between 0 and 1.

        Raises:
            InputError: a level outside 0 to 1, or values that are not finite.
        """
        return self._estimate_quantities({(name, unit): function}, level)[0]

    def estimates(self, *, level: float = 0.95) -> tuple[QuantityEstimate, ...]:
        """Return the volume (of a closed model), area, length and centroid size.

        The length is the extent along the longest axis of the completed surface.
        """
        mm, centred = self.fit.mm_per_scan_unit, self.vertices - self.vertices.mean(axis=0)
        axis = np.linalg.svd(centred, full_matrices=False)[2][0]
        functions: dict[tuple[str, str], Function] = {}
        if _is_closed(self.model):
            functions["volume", "mm3"] = lambda mesh: enclosed_volume(mesh.vertices, np.asarray(mesh.faces)) * mm**3
        functions["area", "mm2"] = lambda mesh: float(face_areas(mesh).sum()) * mm**2
        functions["length", "mm"] = lambda mesh: float(np.ptp(mesh.vertices @ axis)) * mm
        functions["centroid size", "mm"] = lambda mesh: centroid_size(mesh.vertices) * mm
        return self._estimate_quantities(functions, level)

    def _estimate_quantities(
        self, functions: Mapping[tuple[str, str], Function], level: float
    ) -> tuple[QuantityEstimate, ...]:
        if not 0 < level < 1:
            raise InputError(f"The probability of an interval lies between 0 and 1, not {level:g}.")
        return tuple(
            self._estimate_quantity(function, name, unit, level) for (name, unit), function in functions.items()
        )

    def _estimate_quantity(self, function: Function, name: str, unit: str, level: float) -> QuantityEstimate:
        def of(vertices: FloatArray) -> float:
            value = float(function(self._mesh(np.asarray(vertices, dtype=np.float64))))
            if not np.isfinite(value):
                raise InputError(f"The quantity {name or 'of the shape'} is not finite for every shape.")
            return value

        value = of(self.vertices)
        if self.calibration is not None:
            T = self.T_scan_model
            mean, stddev, low, high = self.calibration.interval(
                lambda vertices: of(T.apply(np.asarray(vertices, dtype=np.float64))),
                T.inverse().apply(self.vertices), level,
            )  # fmt: skip
            return QuantityEstimate(
                name, unit, value, mean, stddev, low, high, level, len(self.calibration) * self.calibration.of_training
            )
        over = np.array([of(sample) for sample in self._samples])
        low, high = np.quantile(over, [(1 - level) / 2, (1 + level) / 2])
        mean, stddev = float(over.mean()), float(over.std(ddof=1))
        return QuantityEstimate(name, unit, value, mean, stddev, float(low), float(high), level, 0)

    def landmark_stddev_mm(self) -> dict[str, FloatArray]:
        """Return name -> (3,) standard deviation of each landmark along the axes of the scan's frame, mm."""
        mm = self.fit.mm_per_scan_unit
        spread = self.model.landmarks.interpolate(self._samples.transpose(1, 2, 0).astype(np.float64))
        return dict(zip(self.model.landmarks, spread.std(axis=2, ddof=1) * mm, strict=True))

    @cached_property
    def _samples(self) -> Float32Array:
        return self.draw_samples()

    def _mesh(self, vertices: FloatArray, observed: BoolArray | None = None) -> Mesh:
        landmarks = self.model.landmarks.positions(vertices)
        return Mesh(vertices, self.model.faces, landmarks, self.scan_name, observed=observed)


def complete(
    model: ShapeModel | str | PathLike[str],
    scan: MeshLike | Mapping[str, MeshLike],
    config: CompletionConfig | None = None,
    *,
    landmarks: Mapping[str, FloatArray] | str | PathLike[str] | None = None,
    T_scan_model: Similarity | None = None,
) -> Completion:
    """Complete a partial scan: its surface, and the distribution of the missing parts.

    Args:
        model: the shape model, or the path of its file.
        scan: a mesh or point cloud, in its own frame and unit, or its path; or parts with their scans, see `fit_scan`.
        config: settings; None for the defaults.
        landmarks: landmarks of the scan, see `fit_scan`; they may lie on missing parts.
        T_scan_model: initial pose, see `fit_scan`.

    Raises:
        FitError: too little of the scan matches, or its fit is doubtful.
        InputError: the model has no triangles or fewer than five training shapes, it has no such region, or a mirror
            image is requested of a model that is not symmetric.
    """
    config = config or CompletionConfig()
    model = model if isinstance(model, ShapeModel) else ShapeModel.load(Path(model))
    if model.is_n_training_known and model.n_training < _FEWEST_SHAPES:
        raise InputError(
            f"The model was built from {model.n_training} shapes; a completion needs one of at least {_FEWEST_SHAPES}."
        )
    parts = list(cast("Mapping[str, MeshLike]", scan)) if isinstance(scan, Mapping) else []
    if len(parts) == 1:
        config = replace(config, fit=config.fit.for_scan(model, f"_{parts[0]}"))
    landmarks = read_landmarks(Path(landmarks)) if isinstance(landmarks, str | PathLike) else landmarks
    if config.fit.region is not None and config.fit.region not in model.parts:
        of_parts = f"one of the parts {', '.join(model.parts)}" if model.parts else "no region"
        raise InputError(f"A completion needs a fit of the complete model, or of a part; give {of_parts}.")
    fit = fit_scan(model, cast("MeshLike", scan), config.fit, landmarks=landmarks, T_scan_model=T_scan_model)
    model = model.with_all_modes
    if config.part is not None:
        fit = fit_scan(
            model, _remove_part(fit, config.part), config.fit, landmarks=landmarks, T_scan_model=T_scan_model
        )
    T_mm_scan = mm_frame(fit.scan, fit.mm_per_scan_unit)
    scan_mm, part = fit.scan.with_vertices(T_mm_scan.apply(fit.scan.vertices)), config.fit.region
    if part is not None:
        scan_mm = replace(scan_mm, parts=np.full(len(scan_mm.vertices), model.parts.index(part), dtype=np.int32))
    target = ScanTarget(scan_mm, None if scan_mm.parts is None else model.part_of_vertex)
    marks = None
    if landmarks:
        landmarks, _ = landmarks_in_frame_of(fit.scan, landmarks)  # as in the fit, whose notes state it
        scale = (T_mm_scan @ fit.T_scan_model).scale
        stddev_mm = config.fit.landmark_stddev_mm or SHARE * rms_size(model.mean_vertices) * scale
        marks_mm = {name: T_mm_scan.apply(point) for name, point in landmarks.items()}
        marks = LandmarkConstraint.of(model, marks_mm, stddev_mm)
    with_scale = config.fit.limits(model).with_scale
    if part is not None and not model.is_linear:
        return _complete_from_part(fit, target, T_mm_scan, config)

    def posterior_at(fit: FitResult, *, calibrated: bool = True) -> ShapePosterior:
        b = np.pad(fit.b, (0, model.n_modes - len(fit.b)))
        return shape_posterior(
            model, target, T_mm_scan @ fit.T_scan_model, b, _SETTINGS, with_scale=with_scale, marks=marks,
            calibrated=calibrated,
        )  # fmt: skip

    apart_mm = None
    evidence = fit.evidence
    assert evidence is not None
    stands_out = evidence.start_score_mm < _STANDS_OUT * evidence.start_runner_up_score_mm
    is_sure = fit.status != "doubtful" and evidence.seen_share > (_SURE / 2 if stands_out else _SURE)
    if not landmarks and T_scan_model is None and scan_mm.parts is None and not is_sure:
        fit, apart_mm = _find_likeliest_pose(
            fit, target, T_mm_scan.inverse(), config, lambda fit: posterior_at(fit, calibrated=False)
        )
    posterior = posterior_at(fit)
    T = posterior.T_scan_model
    start = T.apply(posterior.surface.vertices)
    dense = dense_surface(model, target, start, T, config.fit.dense_settings)
    observed = dense.seen.copy()
    if config.part is not None:
        observed[ModelRegion.of(model, config.part).inside] = False
    calibration = calibrate(posterior, model, ~observed)
    seen = [] if model.is_linear else [float(observed[part].mean()) for part in model.vertices_of_parts.values()]
    of_part = min((share for share in seen if share > 0.0), default=1.0)
    status, reasons = _judge_completion(fit, posterior, calibration, dense.noise_mm, apart_mm, config, of_part)
    notes = [*fit.notes, *_describe_missing_parts(model, fit, observed, with_scale=with_scale)]
    if scan_mm.parts is not None and (pose := relative_pose(model)) is not None and pose.choice == "removed":
        notes.append(
            "The relative pose was removed from the model: other parts are in their mean pose, whose spread is unknown."
        )
    completed = T.inverse().apply(dense.vertices_scan_mm)
    variance = np.einsum("vii->v", posterior.vertex_covariance())
    if calibration is None:
        is_unknowable = variance > (1 - _LEAST_GAIN) * posterior.prior_vertex_variance()
    else:
        is_unknowable = calibration.skill <= 0
        if status == "converged" and not observed.all():
            held_out = "training shapes" if calibration.of_training else "samples of the model"
            notes.append(
                f"{calibration.n_nearer} of {len(calibration)} {held_out}, each held out in turn, have a completion "
                "that is nearer to the missing part than the mean shape is."
            )
        weight = np.where(observed, 0.0, calibration.mean_weight)[:, None]
        pose = fit_similarity(model.mean_vertices[observed], completed[observed], with_scale=with_scale)
        completed = completed + weight * (pose.apply(model.mean_vertices) - completed)  # E10
    if config.mirror != "never":
        weighed_by = variance if config.mirror == "combined" else None
        completed, weight = add_mirror_image(model, completed, observed, weighed_by)
        notes.append(
            f"The mirror image of the observed side has a mean weight of {weight:.2f} where vertices are missing."
        )
    knowledge = np.where(is_unknowable, UNKNOWABLE, ESTIMATED)
    knowledge[observed] = OBSERVED
    T_scan_model = T_mm_scan.inverse() @ T
    return Completion(
        fit, status, reasons, tuple(notes), config, T_scan_model.apply(completed), knowledge.astype(np.int32),
        np.sqrt(variance) * T.scale, posterior, T_scan_model, calibration,
    )  # fmt: skip


def _complete_from_part(
    fit: FitResult, target: ScanTarget, T_mm_scan: Similarity, config: CompletionConfig
) -> Completion:
    """Complete the scan of one part: the dense surface of the part, and the prediction of the others.

    Raises:
        FitError: there are reasons to doubt the completion, and `with_doubtful` is not set.
        InputError: the model does not contain its training shapes.
    """
    posterior = predict_parts(fit, T_mm_scan)
    T, inside = posterior.T_scan_model, posterior.region.inside
    start = T.apply(posterior.surface.vertices)
    dense = dense_surface(posterior.model, target, start, T, config.fit.dense_settings)
    observed = dense.seen & inside
    calibration = posterior.calibration(~observed)
    status, reasons = _judge_completion(fit, posterior, calibration, dense.noise_mm, None, config)
    completed = np.where(inside[:, None], dense.vertices_scan_mm, start)
    knowledge = np.where(calibration.skill <= 0, UNKNOWABLE, ESTIMATED)
    knowledge[observed] = OBSERVED
    others = ", ".join(part for part in fit.model.parts if part != config.fit.region)
    notes = (
        f"The scan shows {config.fit.region}; {others} and their relative poses are predicted from it. Of "
        f"{len(calibration)} training shapes, each held out in turn, {calibration.n_nearer} have a prediction that is "
        "nearer than the mean shape is.",
    )
    variance = np.einsum("vii->v", posterior.vertex_covariance())
    T_scan_mm = T_mm_scan.inverse()
    return Completion(
        fit, status, reasons, (*fit.notes, *notes), config, T_scan_mm.apply(completed), knowledge.astype(np.int32),
        np.sqrt(variance) * T.scale, posterior, T_scan_mm @ T, calibration,
    )  # fmt: skip


def _find_likeliest_pose(
    fit: FitResult,
    target: ScanTarget,
    T_scan_mm: Similarity,
    config: CompletionConfig,
    posterior_at: Callable[[FitResult], ShapePosterior],
) -> tuple[FitResult, float | None]:
    """Return the likeliest of the fits from all poses of the search (E9), and its distance to another likely fit.

    A small part of an object fits a model in several poses.

    Args:
        fit: fit from the best pose of the search.
        target: the scan in its mm frame.
        T_scan_mm: transform from that mm frame to the scan's own frame.
        config: settings.
        posterior_at: returns the posterior at a fit.

    Returns:
        The fit, and the RMS distance of its vertices to those of the other fit, mm; None if no other fit is likely.
    """
    model, fits = fit.model, [fit]
    with_scale = config.fit.limits(model).with_scale
    start = start_from_any_pose(model, target.mesh.vertices, seed=config.fit.seed, with_scale=with_scale)
    for other in start.alternatives:
        with suppress(FitError):
            fits.append(fit_scan(model, fit.scan, config.fit, T_scan_model=T_scan_mm @ other.T_scan_model))
    found: list[tuple[float, FitResult, FloatArray, float]] = []
    for candidate in fits:
        with suppress(FitError):
            posterior = posterior_at(candidate)
            vertices = posterior.T_scan_model.apply(posterior.surface.vertices)
            found.append((posterior.log_density(), candidate, vertices, posterior.covered_mismatch_mm))
    if not found:
        return fit, None
    found.sort(key=lambda one: -one[0])
    best = found[0]
    for density, _, vertices, mismatch_mm in found[1:]:
        apart_mm = float(np.sqrt(((vertices - best[2]) ** 2).sum(axis=1).mean()))
        # Another pose with a smaller mismatch is evidence against the likeliest pose, whatever their densities are.
        is_likely = density > best[0] - AS_LIKELY or mismatch_mm < best[3]
        if is_likely and apart_mm > _OTHER_POSE * rms_size(best[2]):
            return best[1], apart_mm
    return best[1], None


def _judge_completion(
    fit: FitResult,
    posterior: ShapePosterior | PartPrediction,
    calibration: SurfaceCalibration | None,
    noise_mm: float,
    apart_mm: float | None,
    config: CompletionConfig,
    of_part: float = 1.0,
) -> tuple[Status, tuple[Reason, ...]]:
    """Return status and reasons: the doubts about the fit that no test replaces, then those of the tests.

    Raises:
        FitError: there are reasons to doubt the completion, and `with_doubtful` is not set.
    """
    tested = _OF_MISSING_PARTS if calibration is not None else _OF_MISSING_PARTS - _BY_TRAINING_SHAPES
    reasons = [reason for reason in fit.reasons if reason.code not in tested]
    doubts = [] if fit.status != "doubtful" else reasons
    if apart_mm is not None:
        doubts.append(Reason(ReasonCode.POSE_AMBIGUOUS, {"apart_mm": apart_mm}))
    if of_part < _LEAST_OF_PART:
        doubts.append(Reason(ReasonCode.PART_HARDLY_SEEN, {"seen_share": of_part}))
    modes = posterior.n_modes
    z2, limit = posterior.mean_square_z, max(_IMPLAUSIBLE, float(chdtri(modes, _RARE)) / modes)
    if z2 > limit:
        doubts.append(Reason(ReasonCode.SHAPE_IMPLAUSIBLE, {"z_rms": float(np.sqrt(z2))}))
    if calibration is not None:
        doubts += _find_doubts_by_training_shapes(posterior, calibration, noise_mm)
    elif (off_model := float(np.sqrt(posterior.amplitude))) > _MOST_OFF_MODEL:
        doubts.append(Reason(ReasonCode.SCAN_OFF_MODEL, {"off_model": off_model}))
    if not doubts:
        if fit.status != "doubtful":
            return "converged", fit.reasons
        spread_mm = posterior.noise_mm * posterior.T_scan_model.scale
        return "converged", (converged_reason(spread_mm, float(posterior.followed.mean()), fit.evidence),)
    if not config.with_doubtful:
        raise FitError(
            f"{fit.scan_name}: {sentence_of('doubtful', doubts)} Its completion would look more certain than it is; "
            "check scan, model and unit, give landmarks (--landmarks), or pass --with-doubtful."
        )
    return "doubtful", tuple(doubts)


def _find_doubts_by_training_shapes(
    posterior: ShapePosterior | PartPrediction, calibration: SurfaceCalibration, noise_mm: float
) -> list[Reason]:
    """Return how the scan and its completion differ from those of the training shapes, each held out in turn."""
    doubts, scale = list[Reason](), posterior.T_scan_model.scale
    followed = posterior.followed
    along = np.einsum("nvd,vd->nv", calibration.mean_errors[:, followed], posterior.surface.normals[followed])
    usual_mm = float(np.median(np.sqrt((along**2).mean(axis=1))))
    # Noise of the scan is no mismatch; it differs between neighbouring points.
    mismatch_mm = float(np.sqrt(max(posterior.covered_mismatch_mm**2 - noise_mm**2, 0.0)))
    if mismatch_mm > _UNEXPLAINED * usual_mm:
        doubts.append(
            Reason(ReasonCode.SCAN_UNEXPLAINED, {"mismatch_mm": scale * mismatch_mm, "usual_mm": scale * usual_mm})
        )
    if calibration.missing.mean() > 1 - _COMPLETE and not calibration.is_skilled:
        data = {"training_shapes": float(len(calibration)), "nearer": float(calibration.n_nearer)}
        doubts.append(Reason(ReasonCode.NO_SKILL, data))
    return doubts


def _describe_missing_parts(model: ShapeModel, fit: FitResult, observed: BoolArray, *, with_scale: bool) -> list[str]:
    """Return sentences on the extent of the missing parts.

    Raises:
        FitError: nearly everything is missing.
    """
    share = float(observed.mean())
    if share < _LEAST_OBSERVED:
        raise FitError(
            f"{fit.scan_name}: it shows {100 * share:.1f} % of the model, and {100 * _LEAST_OBSERVED:g} % are needed "
            "to complete it; scan more of the object, or use a model of the part that it shows."
        )
    notes = list[str]()
    if share > _COMPLETE:
        notes.append(
            f"Nothing of the model is missing: the scan shows {100 * share:.0f} % of its vertices. Parts that the "
            "model does not have cannot be completed."
        )
    size_stddev = None if model.training is None else model.training.log_scale_stddev
    if not with_scale:
        notes.append("The size was fixed: sizes of shapes are part of the model, or the scale was fixed.")
    elif size_stddev is None:
        notes.append("The size was free: the model does not contain the sizes of its training shapes.")
    elif abs(np.log(fit.T_scan_model.scale * fit.mm_per_scan_unit)) > OTHER_SIZE * size_stddev:
        notes.append(
            "The size was free: no training shape has the size of the fit, so the unit or scale of the scan is unknown."
        )
    else:
        notes.append(
            f"The size was free, with the standard deviation of the training shapes' sizes ({100 * size_stddev:.2g} %)."
        )
    if model.training is None:
        notes.append(
            "The result is not calibrated: the model does not contain its training shapes, so intervals and standard "
            "deviations are those of the model, and are too small if it is wrong."
        )
    if not model.is_n_training_known:
        notes.append(
            "The model does not state the number of its training shapes, so its variances are taken to be exact; if "
            "it was made of few shapes, the standard deviations are too small."
        )
    return notes


def _remove_part(fit: FitResult, part: str) -> Mesh:
    """Return the scan without the points that show a region of the model.

    Raises:
        InputError: there is no such region.
        FitError: no point is left.
    """
    inside = ModelRegion.of(fit.model, part).inside
    surface = fit.surface()
    near = build_engine(surface).query(fit.scan.vertices)
    outside = ~inside[near.vertex]
    if not outside.any():
        raise FitError(f"{fit.scan_name}: it shows only the region {part!r}; scan more of the object.")
    return part_of(fit.scan, outside)


def _is_closed(model: ShapeModel) -> bool:
    return not len(boundary_edges(np.asarray(model.faces)))


def refine_surface(completion: Completion) -> Mesh:
    """Return the completed surface with four times the triangles, for CAD: smooth, and on the scan where observed.

    Loop subdivision keeps a closed surface closed. Normals point outwards.
    """
    model, scan = completion.model, completion.fit.scan
    M, faces = loop_operator(model.n_vertices, np.asarray(model.faces))
    x = completion.vertices
    # Subdivision smooths the surface; the difference is added beforehand, so that the vertices keep their positions.
    smooth = np.asarray(M @ (2.0 * x - (M @ x)[: len(x)]))
    near = build_engine(scan).query(smooth)
    reach = _ON_SCAN * completion.posterior.noise_mm * completion.T_scan_model.scale
    is_observed = (np.asarray(M @ completion.observed.astype(np.float64)) > 1.0 - 1e-9) & (near.distance < reach)
    vertices = np.where(is_observed[:, None], near.points, smooth)
    # Closest points of a border coincide; triangles that would shrink or turn keep their smooth vertices.
    usual = face_vectors(smooth, faces)
    for _ in range(_REVERTS):
        area = face_vectors(vertices, faces)
        is_bad = np.einsum("fd,fd->f", area, usual) < _LEAST_AREA * np.einsum("fd,fd->f", usual, usual)
        is_bad &= is_observed[faces].any(axis=1)
        if not is_bad.any():
            break
        is_observed[faces[is_bad]] = False
        vertices = np.where(is_observed[:, None], near.points, smooth)
    mesh = Mesh(vertices, faces, name=completion.scan_name)
    if _is_closed(model) and enclosed_volume(mesh.vertices, faces) < 0:
        return replace(mesh, faces=np.ascontiguousarray(faces[:, ::-1]))
    return mesh


_PATCHES, _PRIOR_PATCHES = 300.0, 10.0
"""Independent patches of a complete surface (R20a), and the number of patches that the asymmetry of the modes counts
for."""
_SEAM = 0.1  # share of the size over which the mirror image blends into the observed surface


def add_mirror_image(
    model: ShapeModel, surface: FloatArray, observed: BoolArray, variance: FloatArray | None
) -> tuple[FloatArray, float]:
    """Return the surface with missing vertices moved towards the mirror images of observed ones (E8).

    Args:
        model: the shape model; its mean is symmetric.
        surface: (V, 3) completed by the model, mm of the model's frame.
        observed: (V,) True where the scan shows the vertex.
        variance: (V,) variance of the vertices, mm^2, against which the mirror image is weighted by the asymmetry of
            observed pairs; None uses the mirror image alone.

    Returns:
        (V, 3) mm, and the mean weight of the mirror image over the missing vertices.

    Raises:
        InputError: the mean is not symmetric.
    """
    mean = model.mean_vertices
    corners, weights, turn = _mirror(model)
    image = mean + np.einsum("vc,vcd->vd", weights, (surface - mean)[corners]) @ turn
    is_shown = observed[corners].all(axis=1)
    weight = np.where(is_shown & ~observed, 1.0, 0.0)
    if variance is not None:
        both = is_shown & observed
        patches = _PATCHES * float(both.mean())
        own = float(((surface - image)[both] ** 2).sum() / max(both.sum(), 1))
        asymmetry = (patches * own + _PRIOR_PATCHES * _asymmetry_variance(model)) / (patches + _PRIOR_PATCHES)  # E7
        weight *= variance / (variance + asymmetry + variance[corners[:, 0]])  # E8
    distance = cKDTree(mean[observed]).query(mean)[0] / (_SEAM * rms_size(mean))
    moved = (weight * (1.0 - np.exp(-(distance**2))))[:, None] * (image - surface)
    return surface + moved, float(weight[~observed].mean()) if not observed.all() else 0.0


@cached_with_owner()
def _mirror(model: ShapeModel) -> tuple[IntArray, FloatArray, FloatArray]:
    mirror = find_mirror(model.mesh())
    if mirror.off_share > SYMMETRIC_SHARE:
        raise InputError(
            f"The mean shape differs from its mirror image by {100 * mirror.off_share:.1f} % of its size, so its sides "
            "do not predict each other; omit --mirror."
        )
    return mirror.corners, mirror.weights, mirror.turn


@cached_with_owner()
def _asymmetry_variance(model: ShapeModel) -> float:
    """Return the variance of the difference between both sides in the population, mm^2 per vertex, from the modes."""
    corners, weights, turn = _mirror(model)
    modes = model.vertex_basis.reshape(model.n_vertices, 3, -1) * model.stddev
    image = np.einsum("vc,vcdk,de->vek", weights, modes[corners], turn, optimize=True)
    return float(((modes - image) ** 2).sum()) / model.n_vertices
