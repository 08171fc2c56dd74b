"""A fit as plain arrays, from which all pictures of it are made."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.fit.result import FitResult
from shapespace.fit.scan_target import mm_frame
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Similarity

STAGES_VERSION = 3  # of the file with the stages of a fit


def stage_arrays(result: FitResult, model: ShapeModel) -> dict[str, npt.NDArray[Any]]:
    """Return the content of NAME.stages.npz: all data of pictures of a fit, in the picture frame.

    The picture frame has the origin and the axes of the model's frame and the size of the scan, in mm.

    Of each stage the vertices (V, 3), the signed distances `model_to_scan_STAGE` (V,) and `scan_to_model_STAGE` (S,),
    positive where the scan lies outside of the model, not-a-number at scan points beyond the model's rim. `scan` and
    `scan_faces` are the scan as repaired; `regions` the codes of `fit.regions.REGIONS`; `history_*` each iteration,
    with T (I, 3, 4) from the model's frame then to the picture frame. Of a scan with colours, `scan_colours`
    (S, 3), `colours_final` and `colours_dense` (V, 3) are there too, uint8.
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
