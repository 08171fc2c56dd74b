"""Result of a fit: pose, coefficients, distances in both directions, status and history."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.fit.diagnostics.failure_model import Chirality, FitEvidence, chirality_of
from shapespace.fit.diagnostics.reasons import Reason, sentence_of
from shapespace.fit.iteration_state import MATCHED, SHOWN, IcpState
from shapespace.fit.scan_target import mm_frame
from shapespace.geometry.closest import ClosestPoints, DistanceSummary, SurfaceDistances, build_engine
from shapespace.lazy import OpenViewer, lazy_import
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import describe_briefly, short_repr
from shapespace.types import GREY, BoolArray, ByteArray, FloatArray, IntArray, Mesh, Similarity

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class OverlapDistances:
    """Distances over the parts that scan and model both contain, mm of the scan.

    Args:
        model_to_scan: distances of the model's vertices that the scan shows; the other vertices are estimates.
        scan_to_model: distances of the scan's vertices that the model covers.
        model_seen_share: share of the model's vertices that the scan shows.
        scan_covered_share: share of the scan's vertices that the model covers.

    Example:
        >>> 0 <= fit.overlap_distances.model_seen_share <= 1
        True
    """

    model_to_scan: DistanceSummary
    scan_to_model: DistanceSummary
    model_seen_share: float
    scan_covered_share: float


Status: TypeAlias = Literal["converged", "max_iterations", "doubtful", "failed"]
STAGES = ("before", "initial", "final")
"""Stages of every fit: centroids aligned, after phase 1, after phase 2. `dense` follows if it was requested."""


@dataclass(frozen=True, eq=False)
class Stage:
    """The fitted surface at one stage of the fit.

    Args:
        T_scan_model: similarity from the model's frame (mm) to the scan's frame and unit.
        b: (K,) coefficients, mm.
        measure: function that measures the distances to the scan.
        vertices: (V, 3) vertices in the scan's frame and unit if the surface is not the model's with b; else None.
        seen: (V,) False where the scan does not show such a surface; else None.
        moved_mm: RMS displacement of such a surface along its normals over seen vertices, mm of the scan.

    Example:
        >>> sorted(fit.stages)
        ['before', 'final', 'initial']
    """

    T_scan_model: Similarity
    b: FloatArray
    measure: Callable[[], SurfaceDistances] = field(repr=False)
    vertices: FloatArray | None = None
    seen: BoolArray | None = None
    moved_mm: float = 0.0

    __repr__ = short_repr

    @cached_property
    def distances(self) -> SurfaceDistances:
        """Distances to the scan and back, mm of the scan, measured on first access."""
        return self.measure()


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted scan.

    Lengths are in mm of the scan, its real size; only the coefficients `b` and `b_stddev` are in mm of the model.

    Args:
        scan_name: name of the scan.
        status: `converged`, `max_iterations`, or `doubtful` when the fit should not be trusted.
        reasons: reasons for the status, as codes with data.
        T_scan_model: similarity from the model's frame (mm) to the scan's frame and unit.
        mm_per_scan_unit: unit of the scan, detected or given, in mm.
        b: (K,) coefficients, mm of the model's frame.
        b_stddev: (K,) standard deviations of the coefficients, mm of the model's frame. They are calibrated for the
            robust method (docs/uncertainty.md); for the paper's method they depend on the model's own noise and are
            mostly too small.
        shrinkage: (K,) in [0, 1]: near 1 where the scan determines the coefficient, near 0 where only the prior does.
        z: (K,) coefficients b in standard deviations of the model.
        z_covariance: (K, K) calibrated covariance of z; None for the paper's method. No file contains it.
        stages: surface at each of `STAGES`, and at `dense` if it was requested.
        history: every state of the loop, in the scan's mm frame.
        method: name of the method.
        calibrated: whether `b_stddev` was validated against known truths (docs/uncertainty.md); False for the paper's
            method.
        config: every setting in effect, with the software version.
        start: source of the start: `landmarks`, `upright`, `rotations` or `given`.
        evidence: diagnostics from which the status is computed; None for the paper's method, which uses distances.
        notes: sentences on repairs and problems of the scan.
        seconds: duration of each part.
        model: the model that was fitted.
        scan: the repaired scan, in its own frame and unit.
        find_regions: function that finds `regions`.
        find_closest: function that finds the closest points of the scan to vertices (V, 3) in its own frame and unit.
        landmark_stddev_mm: name -> (3,) standard deviation of the position of each of `landmarks`, along the axes of
            the scan's frame, mm of the scan (docs/landmarks.md); without landmarks outside the region of a region fit;
            None for the paper's method.
        files: paths of `model`, `scan` and `landmarks`, as far as they were read from files.

    Example:
        >>> fit = ss.fit_scan(model, meshes[1])
        >>> fit.b.shape, fit.surface().vertices.shape == meshes[1].vertices.shape
        ((5,), True)
    """

    scan_name: str
    status: Status
    reasons: tuple[Reason, ...]
    T_scan_model: Similarity
    mm_per_scan_unit: float
    b: FloatArray
    b_stddev: FloatArray
    shrinkage: FloatArray
    z: FloatArray
    z_covariance: FloatArray | None
    stages: Mapping[str, Stage]
    history: Sequence[IcpState]
    method: str
    calibrated: bool
    config: Mapping[str, Any]
    start: str
    evidence: FitEvidence | None
    notes: Sequence[str]
    seconds: Mapping[str, float]
    model: ShapeModel = field(repr=False)
    scan: Mesh = field(repr=False)
    find_regions: Callable[[], IntArray] = field(repr=False)
    find_closest: Callable[[FloatArray], ClosestPoints] = field(repr=False)
    landmark_stddev_mm: Mapping[str, FloatArray] | None = field(default=None, repr=False)
    files: Mapping[str, Path] = field(default_factory=dict[str, Path])

    def __repr__(self) -> str:
        far = int(np.abs(self.z).argmax())
        return (
            f"<FitResult of {describe_briefly(self.scan_name)}: {self.status}. {self.reason} {len(self.z)} "
            f"coefficients, the largest {self.z[far]:+.1f} sd (mode {far + 1}); {self.method}, "
            f"{sum(self.seconds.values()):.2f} s>"
        )

    @property
    def reason(self) -> str:
        """One sentence that explains the status, made from `reasons`."""
        return sentence_of(self.status, self.reasons)

    @cached_property
    def regions(self) -> IntArray:
        """(V,) code of each model vertex in `fit.iteration_state.REGIONS`, found on first access.

        With the paper's method every vertex counts as followed, observed or not. Outside the region of a region fit
        (`FitConfig.region`) no vertex is observed.
        """
        return self.find_regions()

    @cached_property
    def landmarks(self) -> dict[str, FloatArray]:
        """Name -> (3,) position of the model's landmarks in the scan's frame and unit, on the dense surface if any.

        Empty if the model has no landmarks.
        """
        return dict(self.surface(stage="dense" if "dense" in self.stages else "final").landmarks)

    @cached_property
    def colours(self) -> Mapping[str, ByteArray]:
        """(V, 3) uint8 colours of the surface at `final`, and at `dense` if any; empty if the scan has no colours.

        A vertex takes the colour of the closest point of the scan. Where the surface does not follow the scan, or the
        scan shows nothing, it is grey.
        """
        colours = self.scan.colours
        if colours is None:
            return {}
        found: dict[str, ByteArray] = {}
        for name in ("final", *(("dense",) if "dense" in self.stages else ())):
            followed = self.stages[name].seen
            seen = np.isin(self.regions, MATCHED) if followed is None else followed
            found[name] = carried_colours(colours, self.scan, self.find_closest(self._vertices(name)), seen)
        return found

    @property
    def chirality(self) -> Chirality:
        """Whether the scan is `mirrored` or `as scanned`; `undecidable` if its mirror image fits about as well.

        It is `undecidable` for a mirror-symmetric model, such as one of faces, for a region of a model, and for the
        paper's method, which does not test it.
        """
        e = self.evidence
        return "undecidable" if e is None else chirality_of(e.mirrored_log_odds, e.mirrored_bound)

    @property
    def iterations(self) -> dict[str, int]:
        """Number of iterations by phase."""
        return {
            f"phase_{phase}": max((s.iteration for s in self.history if s.phase == phase), default=0)
            for phase in (1, 2)
        }

    @property
    def model_hash(self) -> str:
        """Content hash of the model."""
        return self.model.content_hash

    @property
    def distances(self) -> SurfaceDistances:
        """Distances of the final surface, mm of the scan, over all vertices."""
        return self.stages["final"].distances

    @cached_property
    def overlap_distances(self) -> OverlapDistances:
        """Distances of the final surface where scan and model overlap, mm of the scan."""
        return self.overlap_distances_at("final")

    def overlap_distances_at(self, stage: str) -> OverlapDistances:
        """Return the distances at `stage` where scan and model overlap at the end of the fit, mm of the scan."""
        distances, seen = self.stages[stage].distances, np.isin(self.regions, SHOWN)
        counted = slice(None) if distances.model_counted is None else distances.model_counted
        forward, backward = (
            DistanceSummary.of(distances.model_to_scan_mm[counted], seen[counted]),
            distances.scan_to_model,
        )
        return OverlapDistances(forward, backward, forward.fraction, backward.fraction)

    def surface(self, model: ShapeModel | None = None, stage: str = "final") -> Mesh:
        """Return the model's surface at `stage` in the scan's own frame and unit, all vertices in model order.

        At `final` and `dense` it has the colours of the scan, see `colours`.

        Args:
            model: the model that was fitted; None uses the one that the result contains.
            stage: a name of `stages`.

        Raises:
            InputError: another model than the model that was fitted.
        """
        if model is not None and model is not self.model and model.content_hash != self.model_hash:
            raise InputError(
                f"{self.scan_name} was fitted with another model than the given model, whose surface would be wrong; "
                "omit the model, as the result contains its own."
            )
        vertices = self._vertices(stage)
        landmarks = self.model.landmarks.positions(vertices)
        return Mesh(vertices, self.model.faces, landmarks, self.scan_name, self.colours.get(stage))

    def scan_parts(self) -> IntArray:
        """Return the part (S,) of the model that each vertex of the scan belongs to, as an index of `model.parts`.

        It is the given part, or if parts were not given, that whose fitted surface is nearest.

        Raises:
            InputError: the model has no parts.
        """
        if (part := self.model.part_of_vertex) is None:
            raise InputError("The model has no parts; build it from specimens of several parts.")
        if self.scan.parts is not None:
            return self.scan.parts
        return part[build_engine(self.surface()).query(self.scan.vertices).vertex].astype(np.int32)

    def save(self, folder: str | PathLike[str], name: str = "", *, stages: bool = False) -> Path:
        """Write the files that `shapespace fit` writes, and return the path of the record, NAME.fit.json.

        Record and surfaces are published together, and the row of coefficients.csv is added; `report`, `view` and
        `recognise` then accept the folder. If scan or model was not read from a file, the record contains no path, so
        these commands need `--model`, and show the raw scan only with `stages`.

        Args:
            folder: output folder, created if absent.
            name: NAME of the files; empty for the name of the scan, with a part of its hash if another scan has that
                name.
            stages: whether to write NAME.stages.npz too, for figures.

        Raises:
            FileError: the folder cannot be written, or another run writes into it.
            InputError: a name that no file can have.
        """
        return lazy_import("save_fit")(self, Path(folder), name, stages=stages)

    def plot(self, what: str = "distances", **options: Any) -> Figure:
        """Return a matplotlib figure of the fit.

        Args:
            what: `distances` from the fitted surface to the scan, `stages` of the fit, `overlay` of scan and model,
                `histograms` of the distances, `coefficients`, `history` of the iterations, or `regions` of the model.
            options: options of the figure's function in `shapespace.report.figures`.

        Raises:
            InputError: there is no such plot.
            ShapespaceError: the extra `report` is not installed.
        """
        return lazy_import("plot_fit")(self, what, **options)

    def view(self, *, height_px: int = 720) -> OpenViewer:
        """Open the viewer on this fit; in a notebook, in the frame of the cell.

        A thread serves it to this machine only, until `close()` of the returned viewer or the end of the process.

        Args:
            height_px: height of the frame, pixels.

        Raises:
            ShapespaceError: the extra `view` is not installed.
        """
        return lazy_import("view_fit")(self, height_px=height_px)

    def _repr_html_(self) -> str:
        return lazy_import("html_of_fit")(self)

    def _vertices(self, stage: str) -> FloatArray:
        surface = self.stages[stage]
        if surface.vertices is not None:
            return surface.vertices
        return surface.T_scan_model.apply(self.model.reconstruct(surface.b))


# The colours of a scan on the surface that was fitted to it


def carried_colours(colours: ByteArray, scan: Mesh, closest: ClosestPoints, seen: BoolArray) -> ByteArray:
    """Return the colours (V, 3) at the closest points of a surface's vertices, between the scan's vertices linearly.

    Args:
        colours: (S, 3) colours of the scan's vertices.
        scan: the scan, with triangles or only points.
        closest: the closest points of the scan to V vertices.
        seen: (V,) False where the surface follows no part of the scan: there the colour is `GREY`.
    """
    if closest.triangle is None or closest.barycentric is None or scan.faces is None:
        interpolated = colours[closest.vertex]
    else:
        corners = colours[scan.faces[closest.triangle]].astype(np.float64)
        interpolated = np.rint(np.einsum("vc,vcd->vd", closest.barycentric, corners)).clip(0, 255).astype(np.uint8)
    return np.where(seen[:, None], interpolated, np.uint8(GREY))


STAGES_VERSION = 3  # version of the file with the stages of a fit


def stage_arrays(result: FitResult, model: ShapeModel) -> dict[str, npt.NDArray[Any]]:
    """Return the content of NAME.stages.npz: all data of pictures of a fit, in the picture frame.

    The picture frame has the origin and the axes of the model's frame and the size of the scan, in mm.

    For each stage it contains the vertices (V, 3) and the signed distances `model_to_scan_STAGE` (V,) and
    `scan_to_model_STAGE` (S,), positive where the scan lies outside of the model, not-a-number at scan points beyond
    the model's rim. `scan` and `scan_faces` are the repaired scan; `regions` codes of `fit.iteration_state.REGIONS`;
    `history_*` each iteration, with T (I, 3, 4) from the model's frame then to the picture frame. If the scan has
    colours, it also contains `scan_colours` (S, 3), `colours_final` and `colours_dense` (V, 3), uint8.
    """
    T_picture_scan = picture_frame(result.T_scan_model, result.mm_per_scan_unit)
    arrays: dict[str, npt.NDArray[Any]] = {
        "format_version": np.array(STAGES_VERSION),
        "scan": T_picture_scan.apply(result.scan.vertices).astype(np.float32),
        "regions": result.regions.astype(np.uint8),
    }
    for name, stage in result.stages.items():
        arrays[name] = T_picture_scan.apply(result.surface(model, name).vertices).astype(np.float32)
        arrays[f"model_to_scan_{name}"] = stage.distances.model_to_scan_signed_mm.astype(np.float32)
        arrays[f"scan_to_model_{name}"] = stage.distances.scan_to_model_signed_mm.astype(np.float32)
        if stage.seen is not None:
            arrays[f"seen_{name}"] = stage.seen
    for name, colours in result.colours.items():
        arrays[f"colours_{name}"] = colours
    if result.scan.colours is not None:
        arrays["scan_colours"] = result.scan.colours
    if model.faces is not None:
        arrays["faces"] = model.faces
    if result.scan.faces is not None:
        arrays["scan_faces"] = result.scan.faces
    T_picture_mm = T_picture_scan @ mm_frame(result.scan, result.mm_per_scan_unit).inverse()
    T = [T_picture_mm @ state.T_scan_model for state in result.history]
    arrays["history_phase"] = np.array([state.phase for state in result.history], dtype=np.int32)
    arrays["history_iteration"] = np.array([state.iteration for state in result.history], dtype=np.int32)
    arrays["history_rms_mm"] = np.array([state.rms_mm for state in result.history], dtype=np.float32)
    modes = len(result.b)
    b = [np.pad(state.b[:modes], (0, max(modes - len(state.b), 0))) for state in result.history]
    arrays["history_b"] = np.array(b, dtype=np.float32)
    arrays["history_T"] = np.array(
        [np.column_stack([each.scale * each.rotation, each.translation]) for each in T], dtype=np.float64
    ).reshape(-1, 3, 4)
    return arrays


def picture_frame(T_scan_model: Similarity, mm_per_scan_unit: float) -> Similarity:
    """Return the similarity from the scan's own frame and unit to the picture frame of its fit."""
    R = T_scan_model.rotation.T
    return Similarity(mm_per_scan_unit, R, -mm_per_scan_unit * (R @ T_scan_model.translation))
