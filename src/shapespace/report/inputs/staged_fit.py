"""A fit in the frame of the pictures: scan and model in mm, iteration by iteration, with signed distances."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.fit.iteration_state import REGIONS, SHOWN
from shapespace.fit.result import STAGES, FitResult
from shapespace.fit.stages import STAGES_VERSION, stage_arrays
from shapespace.geometry.closest import build_engine, on_boundary, surface_distances
from shapespace.geometry.normals import boundary_vertices
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import FitRecord
from shapespace.types import FloatArray, IntArray, Mesh, Similarity


@dataclass(frozen=True, eq=False)
class Moment:
    """One iteration of a fit.

    Args:
        phase: 1 or 2.
        iteration: from 0, by phase.
        rms_mm: RMS closest distance, mm of the scan.
        b: (K,) coefficients then, mm of the model's frame.
        T_final_now: from the model's frame then to the picture frame, see `stage_arrays`.
    """

    phase: int
    iteration: int
    rms_mm: float
    b: FloatArray
    T_final_now: Similarity

    def vertices(self, model: ShapeModel) -> FloatArray:
        """Return the model's surface then, (V, 3), in the picture frame."""
        return self.T_final_now.apply(model.reconstruct(self.b))


@dataclass(frozen=True, eq=False)
class StagedFit:
    """A fit in the picture frame: the axes of the model's frame, and the size of the scan in mm.

    Args:
        name: of the fit.
        label: what pictures call it.
        status: `converged`, `max_iterations` or `doubtful`.
        reason: one sentence on why.
        scan: the raw surface or points, as repaired.
        surfaces: the model at each stage: `final`; `before` and `initial` where the stages were saved; `dense` where
            there was one.
        model_to_scan_mm: by stage, (V,) signed closest distances: positive where the scan lies outside of the model;
            not-a-number at vertices that the scan does not show, as in `OverlapDistances`.
        scan_to_model_mm: by stage, (S,) the same of scan points; not-a-number beyond the model's rim.
        regions: (V,) codes of `fit.regions.REGIONS`; None where the stages were not saved.
        b: (K,) mm.
        z: (K,) in standard deviations of the model.
        b_stddev: (K,) mm.
        shrinkage: (K,) in [0, 1].
        history: the iterations, in order; empty where the stages were not saved.
    """

    name: str
    label: str
    status: str
    reason: str
    scan: Mesh
    surfaces: Mapping[str, Mesh]
    model_to_scan_mm: Mapping[str, FloatArray]
    scan_to_model_mm: Mapping[str, FloatArray]
    regions: IntArray | None
    b: FloatArray
    z: FloatArray
    b_stddev: FloatArray
    shrinkage: FloatArray
    history: tuple[Moment, ...]

    @cached_property
    def scale_mm(self) -> float:
        """Where the colour scale of the signed distances ends, in every picture of this fit."""
        return scale_end(np.concatenate([self.model_to_scan_mm["final"], self.scan_to_model_mm["final"]]))

    @staticmethod
    def of(model: ShapeModel, result: FitResult, label: str = "") -> StagedFit:
        """Return the staged fit of `result`, which was fitted by `model`."""
        return StagedFit.from_arrays(
            stage_arrays(result, model), result, name=result.scan_name, label=label or result.scan_name
        )

    @staticmethod
    def from_surfaces(
        surfaces: Mapping[str, Mesh], scan: Mesh, record: FitRecord, *, name: str, label: str
    ) -> StagedFit:
        """Return a fit from its saved surfaces and its scan, and measure its distances.

        A vertex counts as not shown by the scan where its closest point lies on the border of the scan; nowhere if the
        record states that the scan shows the complete model.

        Args:
            surfaces: `final`, and `dense` where there is one, in the picture frame.
            scan: as repaired, in the picture frame.
            record: of the fit.
            name: of the fit.
            label: what pictures call it.

        Raises:
            FileFormatError: the numbers of the record do not fit together.
        """
        b, z, b_stddev, shrinkage = (
            np.array(values, dtype=np.float64) for values in (record.b, record.z, record.b_stddev, record.shrinkage)
        )
        if not all(values.shape == b.shape for values in (z, b_stddev, shrinkage)):
            raise FileFormatError(f"{name}: the coefficients of its record do not fit together; fit the scan again.")
        engine = build_engine(scan)
        is_complete = record.shown is not None and record.shown.model_seen_share == 1.0
        forward: dict[str, FloatArray] = {}
        backward: dict[str, FloatArray] = {}
        for stage, surface in surfaces.items():
            distances = surface_distances(surface, scan, scan_engine=engine)
            unseen = np.zeros(len(surface.vertices), dtype=bool)
            if scan.faces is not None and surface.faces is not None and not is_complete:
                unseen = on_boundary(engine.query(surface.vertices), scan, boundary_vertices(scan))
            forward[stage] = np.where(unseen, np.nan, distances.model_to_scan_signed_mm)
            backward[stage] = distances.scan_to_model_signed_mm
        return StagedFit(
            name=name,
            label=label,
            status=record.status,
            reason=record.reason,
            scan=scan,
            surfaces=surfaces,
            model_to_scan_mm=forward,
            scan_to_model_mm=backward,
            regions=None,
            b=b,
            z=z,
            b_stddev=b_stddev,
            shrinkage=shrinkage,
            history=(),
        )

    @staticmethod
    @np.errstate(all="ignore")  # what overflows, or is divided by zero, is refused at the end
    def from_arrays(
        arrays: Mapping[str, npt.NDArray[Any]], record: FitResult | FitRecord, *, name: str, label: str
    ) -> StagedFit:
        """Return a fit from the arrays of NAME.stages.npz.

        Args:
            arrays: of the file.
            record: its result, or its record: status, reason and numbers.
            name: of the fit.
            label: what pictures call it.

        Raises:
            FileFormatError: arrays are absent, of an earlier version, or do not fit together.
        """
        remedy = "fit the scan again with --stages"
        b, z, b_stddev, shrinkage = (
            np.array(values, dtype=np.float64) for values in (record.b, record.z, record.b_stddev, record.shrinkage)
        )
        if not np.array_equal(arrays.get("format_version", 0), STAGES_VERSION):
            raise FileFormatError(f"{name}: its stages were saved by another version of shapespace; {remedy}.")
        try:
            faces = arrays.get("faces")
            scan = Mesh(
                arrays["scan"].astype(np.float64), arrays.get("scan_faces"), name=name,
                colours=arrays.get("scan_colours"),
            )  # fmt: skip
            surfaces: dict[str, Mesh] = {}
            forward: dict[str, FloatArray] = {}
            backward: dict[str, FloatArray] = {}
            for stage in (*STAGES, *(("dense",) if "dense" in arrays else ())):
                surfaces[stage] = Mesh(
                    arrays[stage].astype(np.float64), faces, name=name, colours=arrays.get(f"colours_{stage}")
                )
                forward[stage] = arrays[f"model_to_scan_{stage}"].astype(np.float64)
                backward[stage] = arrays[f"scan_to_model_{stage}"].astype(np.float64)
            regions = np.clip(arrays["regions"], 0, len(REGIONS)).astype(np.int32)
            history = tuple(
                Moment(int(phase), int(iteration), float(rms), np.asarray(b_now, dtype=np.float64), _similarity(T))
                for phase, iteration, rms, b_now, T in zip(
                    *(arrays[f"history_{key}"] for key in ("phase", "iteration", "rms_mm", "b", "T")), strict=True
                )
            )
        except (KeyError, ValueError, TypeError, IndexError, OverflowError, ShapespaceError) as error:
            raise FileFormatError(f"{name}: its saved stages are damaged ({error}); {remedy}.") from error
        V, S = len(surfaces["final"].vertices), len(scan.vertices)
        checks = (
            all(np.isfinite(mesh.vertices).all() for mesh in (scan, *surfaces.values())),
            all(len(surface.vertices) == V for surface in surfaces.values()),
            all(d.shape == (V,) and np.isfinite(d).all() for d in forward.values()),
            all(d.shape == (S,) and not np.isinf(d).any() for d in backward.values()),
            regions.shape == (V,) and int(regions.max(initial=0)) < len(REGIONS),
            all(values.shape == b.shape for values in (z, b_stddev, shrinkage)),
            all(moment.b.shape == b.shape and np.isfinite(moment.b).all() for moment in history),
        )
        if not all(checks):
            raise FileFormatError(f"{name}: its saved stages do not fit together; {remedy}.")
        return StagedFit(
            name=name,
            label=label,
            status=record.status,
            reason=record.reason,
            scan=scan,
            surfaces=surfaces,
            model_to_scan_mm={stage: np.where(np.isin(regions, SHOWN), d, np.nan) for stage, d in forward.items()},
            scan_to_model_mm=backward,
            regions=regions,
            b=b,
            z=z,
            b_stddev=b_stddev,
            shrinkage=shrinkage,
            history=history,
        )


def measured_mm(distances_mm: FloatArray) -> FloatArray:
    """Return the absolute values of the finite signed distances, (n,)."""
    return np.abs(distances_mm[np.isfinite(distances_mm)])


_MEDIANS = 5.0
"""Of the distances, at which a scale ends at the latest; beyond it lies what is no part of the object."""


def scale_end(distances_mm: FloatArray) -> float:
    """Return the end of a colour scale for signed distances (N,), mm, robust against outliers."""
    known = measured_mm(distances_mm)
    if not len(known):
        return 1.0
    return nice_ceiling(min(float(np.percentile(known, 97)), _MEDIANS * float(np.median(known))))


def nice_ceiling(value: float) -> float:
    """Return a round number at or a little above `value`, 1 where that is not positive."""
    if not (value > 0 and np.isfinite(value)):
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    steps = np.array([1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10])
    return float(power * steps[np.searchsorted(steps, value / power - 1e-9)])


def _similarity(T: npt.NDArray[Any]) -> Similarity:
    matrix = np.asarray(T, dtype=np.float64)
    if not np.isfinite(matrix).all():
        raise ValueError("a pose that is not finite")
    scale = float(np.cbrt(np.linalg.det(matrix[:, :3])))
    return Similarity(scale, matrix[:, :3] / scale, matrix[:, 3])
