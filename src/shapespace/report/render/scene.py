"""Interactive 3-D views for the browser: packed arrays, and the scripts that draw them.

The bytes of `pack` are a uint32 (little-endian) with the length of a JSON header, the header, zeros up to a multiple of
8, then the arrays, each at a multiple of 8. `Shapespace.unpack` of scene-data.js reads them back.
"""

from __future__ import annotations

import base64
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from shapespace.cohort.orientation import current_orientation
from shapespace.errors import InputError, MeshError
from shapespace.geometry.normals import drawable
from shapespace.geometry.remesh import collapse
from shapespace.model.region import articulation_of
from shapespace.report.inputs.saved_fits import StagedFit, mean_mm, measured_mm
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.render import palette as colours
from shapespace.schemas import FitRecord, to_json
from shapespace.types import FloatArray, IntArray, Mesh

if TYPE_CHECKING:
    from shapespace.model.shape_model import ShapeModel
    from shapespace.report.figures.landmark_figures import Morphospace


_DTYPES = ("float32", "int32", "uint32", "uint16", "int16", "uint8")
_UNKNOWN = -32768  # smallest int16
_MOST_STEPS = 32767  # largest int16
# Rounding in a report: an error of 0.02 mm is a hundredth of the residual of a good fit.
_PLACE_STEP_MM = 0.04
_DISTANCE_STEP_MM = 0.05  # mm
_MODE_STEP_MM = 0.02  # mm


@dataclass(frozen=True, eq=False)
class Steps:
    """An array of 16-bit integers, perhaps times a scale, for `pack`.

    Args:
        values: int16 or uint16, any shape; -32768 means NaN if there is a scale.
        scale: one positive number, one for each leading row, or None for integers that are what they are.
        coded: store differences from row to row, byte by byte, which deflate makes small where neighbours are alike.
        follows: name of an array packed before, of the same shape and scale; differences from it are coded.
    """

    values: npt.NDArray[np.int16] | npt.NDArray[np.uint16]
    scale: float | list[float] | None = None
    coded: bool = False
    follows: str | None = None


def quantise(values: npt.ArrayLike, *, step: float = 0.0, by_row: bool = False, coded: bool = False) -> Steps:
    """Return `values` as int16 steps; the error is at most half a step.

    Args:
        values: float, any shape; NaN and infinities become NaN.
        step: the least step; 0 takes the finest, max|values| / 32767.
        by_row: one step for each leading row instead of one for all.
        coded: see `Steps`.
    """
    array = np.asarray(values, dtype=np.float64)
    known = np.isfinite(array)
    size = np.where(known, np.abs(array), 0.0)
    scale = np.maximum(
        np.asarray(size.reshape(len(array), -1).max(axis=1, initial=0.0) if by_row else size.max(initial=0.0))
        / _MOST_STEPS,
        step,
    )
    scale = np.where(scale > 0, scale, 1.0)
    whole_steps = np.where(
        known,
        np.rint(np.where(known, array, 0.0) / (scale.reshape(-1, *[1] * (array.ndim - 1)) if by_row else scale)),
        _UNKNOWN,
    ).astype(np.int16)
    return Steps(whole_steps, [float(value) for value in scale] if by_row else float(scale), coded)


def pack(arrays: Mapping[str, npt.NDArray[Any] | Steps], facts: Mapping[str, Any]) -> bytes:
    """Return `arrays` and `facts` as bytes that `Shapespace.unpack` reads in the browser.

    Args:
        arrays: name -> array; float64 becomes float32, int64 int32 and bool uint8, other types must be float32, int32,
            uint32, uint16, int16 or uint8, or `Steps`.
        facts: any content of JSON; numbers that are not finite become null.

    Raises:
        InputError: an array of another type, or facts that JSON cannot represent.
    """
    specs: dict[str, Any] = {}
    buffers: list[bytes] = []
    offset = 0
    for name, values in arrays.items():
        array = values.values if isinstance(values, Steps) else _portable(name, np.asarray(values))
        spec: dict[str, Any] = {"dtype": array.dtype.name, "shape": list(array.shape), "offset": offset}
        data = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<")).tobytes()
        if isinstance(values, Steps):
            if values.scale is not None:
                spec["scale"] = values.scale
            if values.coded:
                reference = arrays[values.follows] if values.follows is not None else None
                spec["coded"] = values.follows or True
                data = _encode_differences(array, reference.values if isinstance(reference, Steps) else None)
        specs[name] = spec
        buffers.append(data + bytes(-len(data) % 8))
        offset += len(buffers[-1])
    try:
        header = json.dumps({"facts": to_json(facts), "arrays": specs}, allow_nan=False).encode("ascii")
    except (TypeError, ValueError, AttributeError) as error:
        raise InputError(f"The facts of a scene must be plain values that JSON can represent ({error}).") from error
    return struct.pack("<I", len(header)) + header + bytes(-(4 + len(header)) % 8) + b"".join(buffers)


def _encode_differences(array: npt.NDArray[Any], reference: npt.NDArray[Any] | None) -> bytes:
    """Return the differences from row to row modulo 2^16, small ones of both signs as small numbers, by byte planes."""
    columns = array.shape[-1] if array.ndim > 1 else 1
    values = array.reshape(-1, columns).view(np.uint16)
    if reference is not None:
        values = values - reference.reshape(-1, columns).view(np.uint16)
    steps = np.diff(values, axis=0, prepend=np.zeros((1, columns), np.uint16)).view(np.int16).astype(np.int32)
    return (
        np.ascontiguousarray(np.where(steps < 0, -2 * steps - 1, 2 * steps).astype("<u2").T)
        .view(np.uint8)
        .reshape(columns, -1, 2)
        .transpose(0, 2, 1)
        .tobytes()
    )


def pack_model(model: ShapeModel, modes: int | None = None, *, small: bool = False) -> bytes:
    """Return the data of `Shapespace.Model` and the modes widget.

    Arrays: `mean` (V, 3) mm; `faces` (F, 3), absent for point models; `modes` (K, V, 3) quantised, the displacement of
    one standard deviation of each mode, mm; `stddev` (K,) mm; `share` (K,) of the training variance; of a model of
    several parts, `parts` (V,) the index of the part. If their relative pose is modelled, mean and modes are those of
    tangent vertices, and `template` (V, 3) and the fact `joints` determine the vertices (docs/structures.md).

    Args:
        model: any model.
        modes: number of modes, at most that of the model; None for all.
        small: whether to reduce the size for a report: rounded to 0.02 mm, with vertices reordered to deflate well.

    Raises:
        InputError: fewer than one mode.
    """
    if modes is not None and modes < 1:
        raise InputError(f"At least one mode must be packed, not {modes}.")
    K = model.n_modes if modes is None else min(modes, model.n_modes)
    order, faces = np.arange(model.n_vertices), model.faces
    if small and faces is not None:
        order, faces = _neighbours_together(faces, model.n_vertices)
    rank = np.argsort(order)
    joints: dict[str, Any] = {}
    if model.is_linear:
        mean, template = model.mean_vertices, None
        mode_shapes = np.stack([model.reconstruct(b) - mean for b in np.diag(model.stddev[:K])])
    else:
        articulation = articulation_of(model)
        mean, template = model.coding["mean"].reshape(-1, 3), articulation.template
        mode_shapes = (model.basis[:, :K] * model.stddev[:K]).T.reshape(K, -1, 3)
        joints["joints"] = [
            {"part": joint.part, "parent": joint.parent, "own": rank[joint.own].tolist(),
             "other": rank[joint.other].tolist()}
            for joint in articulation.joints
        ]  # fmt: skip
    arrays: dict[str, npt.NDArray[Any] | Steps] = {
        "mean": quantise(mean[order], step=_PLACE_STEP_MM, coded=True) if small else mean,
        "modes": quantise(mode_shapes[:, order], step=_MODE_STEP_MM if small else 0.0, by_row=True, coded=small),
        "stddev": model.stddev[:K],
        "share": model.stddev[:K] ** 2 / model.total_variance,
    }
    arrays |= _indices("faces", faces, model.n_vertices, coded=small)
    if template is not None:
        both = {"mean": mean[order], "template": template[order]}
        arrays |= _shared_steps(both) if small else {"template": template}
    parts = _parts(Parts.of(model), order, arrays)
    facts = {
        **parts,
        **joints,
        "landmarks": {
            name: {"vertices": rank[corners].tolist(), "weights": weights.tolist()}
            for name, corners, weights in zip(
                model.landmarks.names, model.landmarks.corners, model.landmarks.barycentric, strict=True
            )
        },
    }
    return pack(arrays, facts)


def pack_morph(
    low: Mesh,
    high: Mesh,
    labels: tuple[str, str],
    *,
    path: tuple[FloatArray, FloatArray] | None = None,
    variable: str = "",
    ends: tuple[float, float] = (0.0, 1.0),
    largest: int = 20_000,
) -> bytes:
    """Return the data of the morph widget: two shapes in correspondence as a mean and one mode, from -1 to 1, or a path
    between them.

    Arrays: `mean` (V, 3) mm; `faces`, absent for points; `modes` (q, V, 3) mm, of a line half of the difference.

    Args:
        low: shape at the start of the slider.
        high: shape at the end of the slider, in correspondence with `low`.
        labels: names of the two shapes.
        path: modes (q, V, 3) mm and weights (B, q) of the shapes low + weights modes; None for a line.
        variable: name of the variable of the slider; empty for none.
        ends: values of the variable at `low` and `high`.
        largest: largest number of triangles (or points).
    """
    half = (high.vertices - low.vertices) / 2
    modes, weights = (half[None], np.array([[-1.0], [1.0]])) if path is None else path
    middle = low.vertices + (half if path is None else 0.0)
    mesh, source_rows = _decimate(low.with_vertices(middle), largest)
    extent = float(np.ptp(middle, axis=0).max())
    arrays: dict[str, npt.NDArray[Any] | Steps] = {
        "mean": quantise(mesh.vertices, step=min(_PLACE_STEP_MM, extent / 4000), coded=True),
        "modes": quantise(modes[:, source_rows], step=min(_MODE_STEP_MM, extent / 8000), by_row=True, coded=True),
    }
    arrays |= _indices("faces", mesh.faces, len(mesh.vertices), coded=True)
    return pack(
        arrays,
        {
            "low": labels[0],
            "high": labels[1],
            "weights": weights.tolist(),
            "variable": variable,
            "range": ends,
        },
    )


def pack_morphospace(space: Morphospace, *, largest: int = 12_000) -> bytes:
    """Return the data of the morphospace widget: its shape model, whose modes are the axes, and its other arrays.

    Args:
        space: the plot.
        largest: largest number of triangles of a surface.
    """
    part, given, rows = space.part, dict(space.arrays), np.arange(len(space.arrays["mean"]))
    mesh = Mesh(given.pop("mean"), space.faces)
    if space.faces is not None:
        mesh, rows = _decimate(mesh, largest)
    codes = {name: given.pop(name).astype(np.int32) for name in ("groups", "edges")}
    given.pop("faces")
    arrays: dict[str, npt.NDArray[Any] | Steps] = {
        "mean": quantise(mesh.vertices, step=float(np.ptp(mesh.vertices)) / 16000, coded=True),
        "modes": quantise(given.pop("shape_axes")[:, rows], by_row=True, coded=True), **given, **codes,
    }  # fmt: skip
    arrays |= _indices("faces", mesh.faces, len(mesh.vertices), coded=True)
    return pack(
        arrays,
        {
            "names": part.names,
            "axes": part.axes,
            "labels": space.labels,
            "first": part.first,
            "groups": part.groups,
            "variable": part.variable,
            "radii": space.radii.tolist(),
            "planar": space.is_planar,
            "grid": space.grid,
            "landmarks": space.n_landmarks,
            "links": [[a - 1, b - 1] for a, b in current_orientation().links if max(a, b) <= space.n_landmarks],
            "unit": part.unit,
        },
    )


def pack_fit(staged: StagedFit, *, largest_scan: int | None = None, most_sent: int | None = None) -> bytes:
    """Return the data of the fit widget: the scan, the model at each stage, distances, regions, iterations.

    Arrays: `scan` (S, 3) mm and `scan_faces`; `faces` of the model; by stage `surface_STAGE` (V, 3) mm,
    `model_to_scan_STAGE` (V,) and `scan_to_model_STAGE` (S,) mm, signed where the fact `signed` is true, lengths where
    the scan is a point cloud, NaN where unknown; `beyond_model_STAGE` and
    `beyond_scan_STAGE` (101,), the shares of all vertices farther than 0, 2, ... 200 % of `scale_mm`; `regions` (V,)
    codes, where the stages were saved;
    of a scan with colours `scan_colours` (S, 3), `colours_final` and `colours_dense` (V, 3) uint8;
    `b`, `z`, `b_stddev` (K,); `history_b` (n, K) mm, `history_T` (n, 3, 4), `history_phase`, `history_iteration`
    and `history_rms_mm` (n,). The fact `scale_mm` is the end of the one colour scale of this fit.

    Args:
        staged: fit with its stages.
        largest_scan: limit for a report: scan and model are thinned to at most this many triangles (or points) each,
            rounded to 0.02 mm, their vertices put in another order, and the iterations omitted. None packs all data.
        most_sent: limit without `largest_scan`: only the scan is thinned to at most this many triangles (or points).

    Raises:
        InputError: `largest_scan` or `most_sent` below 1.
    """
    for limit in (largest_scan, most_sent):
        if limit is not None and limit < 1:
            raise InputError(f"A scan must keep at least one triangle, not {limit}.")
    small = largest_scan is not None
    last = list(staged.surfaces.values())[-1]
    scan, model = staged.scan, last
    of_scan, of_model = np.arange(len(scan.vertices)), np.arange(len(model.vertices))
    if largest_scan is not None:
        scan, of_scan = _decimate(scan, largest_scan)
        model, of_model = _decimate(last, largest_scan)
    elif most_sent is not None:
        scan, of_scan = decimate(scan, most_sent)
    arrays: dict[str, npt.NDArray[Any] | Steps] = {"scan": _places(scan.vertices, small)}
    arrays |= _indices("scan_faces", scan.faces, len(scan.vertices), coded=small)
    arrays |= _indices("faces", model.faces, len(model.vertices), coded=small)
    arrays |= _stage_arrays(staged, of_model, of_scan, small=small)
    arrays |= {
        "b": staged.b,
        "z": staged.z,
        "b_stddev": staged.b_stddev,
    }
    if staged.regions is not None:
        arrays["regions"] = staged.regions[of_model].astype(np.uint8)
    parts = _parts(staged.parts, of_model, arrays)
    if staged.history and not small:
        arrays |= _history(staged)
    arrays |= _colours(staged, of_model, of_scan)
    facts = {
        "name": staged.name,
        "label": staged.label,
        "status": staged.status,
        "stages": list(staged.surfaces),
        "scale_mm": staged.scale_mm,
        # Points have no inside.
        "signed": staged.scan.faces is not None,
        "mean_mm": {
            stage: {"model": mean_mm(staged.model_to_scan_mm[stage]), "scan": mean_mm(staged.scan_to_model_mm[stage])}
            for stage in staged.surfaces
        },
        **parts,
        "region_shares": list(staged.region_shares.values()),
        "thinned": len(scan.vertices) < len(staged.scan.vertices) or len(model.vertices) < len(last.vertices),
    }
    return pack(arrays, facts)


def pack_surfaces(
    surfaces: Mapping[str, Mesh], record: FitRecord, *, name: str, label: str, reason: str, largest: int | None = None,
    parts: Parts | None = None,
) -> bytes:  # fmt: skip
    """Return the data for the widget of a fit without its scan: as `pack_fit`, without scan and distances.

    Args:
        surfaces: `final`, and `dense` if there is one, with the same triangles, in the picture frame.
        record: record of the fit.
        name: name of the fit.
        label: label in pictures.
        reason: reason why the scan is not shown, as the end of a sentence.
        largest: largest number of triangles (or points) in a report; None packs all as it is.
        parts: parts of the model; None if it has one structure, or is not known.
    """
    last = list(surfaces.values())[-1]
    model, source_rows = (last, np.arange(len(last.vertices))) if largest is None else _decimate(last, largest)
    small = largest is not None
    places = {f"surface_{stage}": surface.vertices[source_rows] for stage, surface in surfaces.items()}
    arrays = _indices("faces", model.faces, len(model.vertices), coded=small)
    arrays |= _shared_steps(places) if small else {key: _places(points, small) for key, points in places.items()}
    arrays |= {key: np.array(getattr(record, key), dtype=np.float64) for key in ("b", "z", "b_stddev")}
    facts = {
        **_parts(parts, source_rows, arrays),
        "name": name,
        "label": label,
        "status": record.status,
        "stages": list(surfaces),
        "without_scan": f"The fitted surface is shown alone, since {reason}",
        "thinned": len(model.vertices) < len(last.vertices),
    }
    return pack(arrays, facts)


def _parts(
    parts: Parts | None, rows: npt.NDArray[np.integer[Any]], arrays: dict[str, npt.NDArray[Any] | Steps]
) -> dict[str, Any]:
    """Add the index of the part of each of the vertices `rows` to `arrays`, and return the fact with their names."""
    if parts is None:
        return {}
    arrays["parts"] = parts.labels[rows]
    return {"parts": list(parts.names)}


def _stage_arrays(
    staged: StagedFit, of_model: npt.NDArray[np.intp], of_scan: npt.NDArray[np.intp], *, small: bool
) -> dict[str, npt.NDArray[Any] | Steps]:
    """Return surface and distances at each stage, for some vertices and scan points; shares are those of all."""
    surfaces = {f"surface_{stage}": surface.vertices[of_model] for stage, surface in staged.surfaces.items()}
    arrays: dict[str, npt.NDArray[Any] | Steps] = {}
    arrays |= _shared_steps(surfaces) if small else {name: _places(values, small) for name, values in surfaces.items()}
    step = _DISTANCE_STEP_MM if small else 0.0
    signed = staged.scan.faces is not None
    for stage in staged.surfaces:
        forward, backward = staged.model_to_scan_mm[stage][of_model], staged.scan_to_model_mm[stage][of_scan]
        if not signed:
            forward, backward = np.abs(forward), np.abs(backward)
        arrays[f"model_to_scan_{stage}"] = quantise(forward, step=step, coded=small)
        arrays[f"scan_to_model_{stage}"] = quantise(backward, step=step, coded=small)
        arrays[f"beyond_model_{stage}"] = _shares_beyond(staged.model_to_scan_mm[stage], staged.scale_mm)
        arrays[f"beyond_scan_{stage}"] = _shares_beyond(staged.scan_to_model_mm[stage], staged.scale_mm)
    return arrays


def _colours(
    staged: StagedFit, of_model: npt.NDArray[np.intp], of_scan: npt.NDArray[np.intp]
) -> dict[str, npt.NDArray[Any] | Steps]:
    """Return the colours of the scan, and the colours transferred from it to the surfaces, if there are any."""
    colours = {"scan_colours": (staged.scan.colours, of_scan)}
    colours |= {f"colours_{stage}": (surface.colours, of_model) for stage, surface in staged.surfaces.items()}
    return {name: values[rows] for name, (values, rows) in colours.items() if values is not None}


def _history(staged: StagedFit) -> dict[str, npt.NDArray[Any]]:
    """Return the iterations as arrays."""
    moments = staged.history
    poses = [moment.T_final_now for moment in moments]
    return {
        "history_b": np.array([moment.b for moment in moments]).reshape(-1, len(staged.b)),
        "history_T": np.array([np.column_stack([T.scale * T.rotation, T.translation]) for T in poses]).reshape(
            -1, 3, 4
        ),
        "history_phase": np.array([moment.phase for moment in moments], dtype=np.int32),
        "history_iteration": np.array([moment.iteration for moment in moments], dtype=np.int32),
        "history_rms_mm": np.array([moment.rms_mm for moment in moments], dtype=np.float32),
    }


def pack_scatter(
    points: FloatArray, labels: Sequence[str], names: Sequence[str], *, axes: Sequence[str], unit: str = "mm"
) -> bytes:
    """Return the data of the scatter widget.

    Arrays: `points` (n, K) float32; `labels` (n,) int32 codes into the fact `labels`, by first appearance.

    Args:
        points: (n, K) coefficients, K at least 1.
        labels: n labels, which select the colours.
        names: n names.
        axes: K names of the coefficients.
        unit: unit of the coefficients, in words.

    Raises:
        InputError: lengths that do not match.
    """
    points = np.asarray(points, dtype=np.float64)
    if (
        points.ndim != 2
        or not len(points) == len(labels) == len(names)
        or points.shape[1] != len(axes)
        or not len(axes)
    ):
        raise InputError(
            f"A scatter of points {points.shape} needs a label and a name for each point and a name for each "
            f"coefficient, not {len(labels)}, {len(names)} and {len(axes)}."
        )
    kinds = list(dict.fromkeys(labels))
    return pack(
        {"points": points, "labels": np.array([kinds.index(label) for label in labels], dtype=np.int32)},
        {"labels": kinds, "names": list(names), "axes": list(axes), "unit": unit},
    )


def scripts() -> str:
    """Return the JavaScript for the scenes of a page, for one inline `<script>`."""
    folder = files("shapespace.report").joinpath("assets")
    shared = {
        "sequential": colours.as_list(colours.SEQUENTIAL),
        "diverging": colours.as_list(colours.DIVERGING),
        "regions": {name: list(colour) for name, colour in colours.REGION_COLOURS.items()},
        "categories": [list(colour) for colour in colours.CATEGORIES],
        "parts": [list(colour) for colour in colours.PARTS],
        "clay": list(colours.CLAY),
        "scan": list(colours.SCAN_COLOUR),
        "model": list(colours.MODEL_COLOUR),
        "dense": list(colours.DENSE_COLOUR),
        "unknown": list(colours.UNKNOWN_COLOUR),
        "signal": list(colours.BEYOND_COLOUR),
    }
    scenes, widgets = (
        [folder.joinpath(name).read_text(encoding="utf-8") for name in names]
        for names in (("vendor/three.min.js", *SCENE_SCRIPTS), WIDGET_SCRIPTS)
    )
    return "\n".join([*scenes, f"Shapespace.colours = {json.dumps(shared)};\n", *widgets])


def style() -> str:
    """Return the CSS of views and widgets, for a page that defines --page, --ink, --soft, --line, --card, --accent."""
    return files("shapespace.report").joinpath("assets/widgets.css").read_text(encoding="utf-8")


def payload_html(identifier: str, payload: bytes) -> str:
    """Return `payload` as a script element of a type that browsers keep but never run: deflated, in base64.

    Args:
        identifier: id of the element, escaped here; widgets are given the element or this id.
        payload: bytes from `pack`.
    """
    text = base64.b64encode(zlib.compress(payload, 9)).decode("ascii")
    mark = escape(identifier, quote=True)
    return f'<script type="application/octet-stream" data-coding="deflate" id="{mark}">{text}</script>\n'


def _portable(name: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    target_dtype = {"float64": np.float32, "int64": np.int32, "bool": np.uint8}.get(array.dtype.name)
    if target_dtype is not None:
        if array.dtype == np.int64 and array.size and np.abs(array).max() > np.iinfo(np.int32).max:
            raise InputError(f"The array {name!r} contains integers beyond 32 bits, which scenes do not have.")
        array = array.astype(target_dtype)
    if array.dtype.name not in _DTYPES:
        raise InputError(f"The array {name!r} has the type {array.dtype}; scenes have {', '.join(_DTYPES)}.")
    return array


def _indices(name: str, faces: IntArray | None, vertices: int, *, coded: bool) -> dict[str, npt.NDArray[Any] | Steps]:
    """Return the triangles of a surface by their name; nothing for points."""
    if faces is None:
        return {}
    return {name: faces.astype(np.uint32) if vertices > 1 << 16 else Steps(faces.astype(np.uint16), coded=coded)}


def _places(points: FloatArray, small: bool) -> npt.NDArray[Any] | Steps:
    return quantise(points, step=_PLACE_STEP_MM, coded=True) if small else points.astype(np.float32)


def _shared_steps(surfaces: Mapping[str, FloatArray]) -> dict[str, Steps]:
    """Quantise surfaces of the same vertices in one step, each after the first as the difference to the previous."""
    step = max(
        max(float(np.abs(points).max(initial=0.0)) for points in surfaces.values()) / _MOST_STEPS, _PLACE_STEP_MM
    )
    return {
        name: Steps(np.rint(points / step).astype(np.int16), step, True, previous)
        for (name, points), previous in zip(surfaces.items(), [None, *surfaces], strict=False)
    }


def _decimate(mesh: Mesh, largest: int) -> tuple[Mesh, npt.NDArray[np.intp]]:
    """Return `mesh` decimated, with neighbours close in the vertex order, and the indices of its vertices."""
    small_mesh, source_rows = decimate(mesh, largest)
    if small_mesh.faces is None:
        return small_mesh, source_rows
    order, faces = _neighbours_together(small_mesh.faces, len(small_mesh.vertices))
    return Mesh(small_mesh.vertices[order], faces, name=mesh.name), source_rows[order]


def _neighbours_together(faces: IntArray, vertices: int) -> tuple[npt.NDArray[np.intp], IntArray]:
    """Return a vertex order, (V,), that keeps neighbours close, and the sorted triangles in that order."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    rows, columns = faces[:, [0, 1, 2, 1, 2, 0]].ravel(), faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    order = np.asarray(
        reverse_cuthill_mckee(
            coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(vertices, vertices)).tocsr(),
            symmetric_mode=True,
        ),
        dtype=np.intp,
    )
    rank = np.empty(vertices, dtype=np.int32)
    rank[order] = np.arange(vertices, dtype=np.int32)
    new_faces = rank[faces]
    new_faces = np.take_along_axis(new_faces, (new_faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return order, new_faces[np.lexsort((new_faces[:, 2], new_faces[:, 1], new_faces[:, 0]))]


def _shares_beyond(signed_mm: FloatArray, scale_mm: float) -> npt.NDArray[Any]:
    sorted_mm, limits_mm = np.sort(measured_mm(signed_mm)), np.arange(101) / 50.0 * scale_mm
    return (1.0 - np.searchsorted(sorted_mm, limits_mm + 1e-9, side="right") / max(len(sorted_mm), 1)).astype(
        np.float32
    )


SCENE_SCRIPTS = tuple(f"scene-{part}.js" for part in (
    "data", "articulation", "camera", "material", "surfaces", "drawing", "controls", "view", "colours",
))  # fmt: skip
"""Views, shape models and colour bars; they need three.min.js before them."""

WIDGET_SCRIPTS = tuple(f"widget-{part}.js" for part in (
    "parts", "stage", "model", "fit", "scatter", "morphospace-drawing", "morphospace",
))  # fmt: skip
"""Views with their controls for reports; they need the scripts of scenes and `Shapespace.colours` before them."""


_MOST_PICTURED = 400_000  # triangles of a scan; more are smaller than a pixel of the pictures
_MOST_COLLAPSED = 150_000  # triangles; larger scans are clustered on a grid first, which is faster


def bounded_scan(scan: Mesh) -> Mesh:
    """Return a scan without missing vertices, and with at most as many triangles as pictures show."""
    return drawable(decimate(scan, _MOST_PICTURED)[0])[0]


def decimate(scan: Mesh, largest: int) -> tuple[Mesh, npt.NDArray[np.intp]]:
    """Return `scan` with at most `largest` triangles (or points), and the indices of the remaining vertices.

    No new point is made, so values measured at a vertex remain valid. Of surfaces, the shortest edges are
    collapsed. Points, surfaces that branch, and very large ones, which would take long, are thinned by a cubic grid
    instead (Rossignac and Borrel 1993): of each cell the vertex nearest to the mean stays.

    Args:
        scan: any surface or points.
        largest: largest number of triangles or points, at least 1.

    Returns:
        The mesh, and (S',) indices into the vertices of `scan`.
    """
    if _count(scan) <= largest:
        return scan, np.arange(len(scan.vertices))
    if scan.faces is not None and len(scan.faces) <= _MOST_COLLAPSED:
        collapsed = _collapse_edges(scan, scan.faces, largest)
        if collapsed is not None:
            return collapsed
    cell = float(np.ptp(scan.vertices, axis=0).max()) / math.sqrt(largest)
    best: tuple[Mesh, npt.NDArray[np.intp]] | None = None
    # Of a surface, what is left goes with the inverse square of the cell, so a few steps come close to `largest`.
    for _ in range(8):
        trial = _cluster_on_grid(scan, cell)
        left = _count(trial[0])
        if left <= largest and (best is None or left > _count(best[0])):
            best = trial
            if left >= 0.9 * largest:
                break
        cell *= math.sqrt(max(left, 1) / (0.95 * largest))
    while best is None:
        cell *= 2.0
        trial = _cluster_on_grid(scan, cell)
        best = trial if _count(trial[0]) <= largest else None
    return best


def _collapse_edges(scan: Mesh, faces: IntArray, largest: int) -> tuple[Mesh, npt.NDArray[np.intp]] | None:
    """Return the surface after edge collapse and its remaining vertices; None for a non-manifold surface."""
    try:
        _, triangles, source_rows = collapse(scan.vertices, faces, largest, scan.name)
    except MeshError:
        return None
    if len(triangles) > largest:
        return None
    return Mesh(scan.vertices[source_rows], triangles.astype(np.int32), name=scan.name), source_rows


def _count(mesh: Mesh) -> int:
    return len(mesh.vertices) if mesh.faces is None else len(mesh.faces)


def _cluster_on_grid(scan: Mesh, cell: float) -> tuple[Mesh, npt.NDArray[np.intp]]:
    points = scan.vertices
    cells = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    side = cells.max(axis=0) + 1
    _, group = np.unique((cells[:, 0] * side[1] + cells[:, 1]) * side[2] + cells[:, 2], return_inverse=True)
    size = np.bincount(group)
    middle = np.stack([np.bincount(group, points[:, k]) / size for k in range(3)], axis=1)
    representatives = np.lexsort((((points - middle[group]) ** 2).sum(axis=1), group))[np.r_[0, np.cumsum(size)[:-1]]]
    if scan.faces is None:
        return Mesh(points[representatives], None, name=scan.name), representatives
    faces = group[scan.faces].astype(np.int32)
    is_whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    faces = faces[is_whole]
    _, unique_rows = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return Mesh(points[representatives], faces[np.sort(unique_rows)], name=scan.name), representatives
