"""statismo and scalismo models in HDF5, and the tree of groups that HDF5 and HDF5/JSON files have in common.

Dialects differ in the storage of texts, attributes and sizes, in the length of the columns of the basis, and in the
location of the points; they are recognised from the content of the tree. A Morphable Model (Basel Face Model,
scalismo-faces) consists of three such models: shape, colour, expression. Models are written as version 0.9.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from shapespace.errors import ModelFileError, ShapespaceError
from shapespace.formats.model_parts import (
    ORTHOGONAL,
    LinearModel,
    Modes,
    are_measurable,
    are_triangles,
    orthonormal,
    parts_of,
    scale_columns,
)
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import write_bytes
from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS
from shapespace.io.meshes.vtk import read_vtk
from shapespace.io.sandbox import HDF5_SIGNATURE, FileContent, SandboxError, read_hdf5_sandboxed
from shapespace.types import FloatArray, IntArray, Mesh, SurfaceLandmarks

_AGAIN = "export it again from the original program"
_LARGEST_BYTES = 2**31  # 2 GiB
_POINTS_AT = 1e-3
"""Share of the extent of the model; landmarks at a larger distance from its surface are omitted."""
_SINGLE = 2e-6
"""Share of the size of the model by which single precision may move a point."""
_UNIT_LENGTH = 1e-2  # deviation of a column's norm from 1 from which the basis counts as scaled
_BFM_MODES = 199  # Basel Face Model 2017 and 2019: shape modes
_BFM_LICENCE = "Basel Face Model: non-commercial research only, see its licence"
_LEGACY_POINTS = "representer/reference-mesh/vertex-coordinates"
_LEGACY_CELLS = "representer/reference-mesh/triangle-list"
_OUTER: Final = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
"""Sides of a tetrahedron, counter-clockwise from outside where its volume is positive."""
_PARAMETERS: Final = "modelinfo/modelBuilder-0/parameters"
"""Group of texts in each model for metadata for which statismo has no field."""
_GREY = 0.5  # mean colour of a model without colours, of 0 to 1
_OMITTED = 1e-6  # relative; rounding in single precision


def is_statismo(path: Path, head: bytes) -> bool:
    """Return whether a file begins like HDF5."""
    return head.startswith(HDF5_SIGNATURE)


def read_statismo(path: Path) -> LinearModel:
    """Read HDF5 files of statismo, scalismo up to 0.91, gravis and the Basel Face Model."""
    check_file(path, _LARGEST_BYTES, _AGAIN)
    try:
        return model_of(read_hdf5_sandboxed(path, leave=("/color",)), path)
    except SandboxError as error:
        raise ModelFileError(f"{path} is damaged or cut short: {error}; {_AGAIN}.") from error


def write_statismo(model: LinearModel, path: Path) -> Sequence[str]:
    """Write version 0.9 in single precision, with expressions a Morphable Model, see `ModelFormat.write`."""
    tree, notes = tree_of(model)
    write_bytes(path, _hdf5_of(tree))
    return notes


def model_of(tree: FileContent, path: Path) -> LinearModel:
    """Return the model in `tree`.

    Args:
        tree: content of the file.
        path: path of the file, used in messages.

    Raises:
        ModelFileError: it contains no model, a model of images, or inconsistent parts.
    """
    try:
        return _model(tree, path)
    except (ValueError, KeyError, OverflowError) as error:
        if isinstance(error, ShapespaceError):
            raise
        raise ModelFileError(f"{path} is not a valid statismo model: {error}; {_AGAIN}.") from error


@dataclass(frozen=True, eq=False)
class _ModelBlock:
    """One model of a tree: mean (D,), displacements (D, K), and the variance of the noise."""

    mean: FloatArray
    moved: FloatArray
    left: float

    def modes(self) -> Modes:
        total = float((self.moved**2).sum()) + self.left if self.left > 0 else None
        return Modes(self.moved, total_variance=total)


def _model(tree: FileContent, path: Path) -> LinearModel:
    root = _root(tree, path)
    part = _part(tree, root)
    mean, expression, notes = part.mean, None, list[str]()
    if root == "/shape" and "/expression/model/mean" in tree.arrays:
        added = _part(tree, "/expression")
        if len(added.mean) != len(mean):
            raise ValueError("its expressions have another number of vertices than its shape")
        mean, expression = mean + added.mean, added.modes()
    if "/color" in tree.groups:
        notes.append("Its colour model is omitted.")
    parameters = _parameters(tree, root)
    points, faces, used_rows = _surface(tree, root, mean.reshape(-1, 3), notes)
    shape = part.modes()
    if used_rows is not None:
        rows = (3 * used_rows[:, None] + np.arange(3)).ravel()
        mean, points, shape = mean[rows], points[used_rows], Modes(shape.moved[rows])
    representer = str(tree.attributes.get(f"{root}/representer", {}).get("name", ""))
    is_bfm = root == "/shape" and part.moved.shape[1] == _BFM_MODES
    return LinearModel(
        mean=mean.reshape(-1, 3),
        shape=shape,
        expression=expression,
        faces=faces,
        mm=_mm(tree, root, parameters),
        landmarks=_landmarks(tree, (points, mean.reshape(-1, 3)), faces, notes, path),
        n_training=_n_training(tree, root, part, parameters),
        # False for Gaussian processes: fits with their uncorrected variances were overconfident.
        held_out=parameters.get("held_out") == "yes",
        provenance=parameters.get("provenance") or " ".join(f"statismo model {representer}".split()),
        parts=parts_of(json.loads(parameters.get("parts") or "{}"), len(mean) // 3),
        licence=parameters.get("licence") or (_BFM_LICENCE if is_bfm else ""),
        notes=tuple(notes),
    )


def _roots(tree: FileContent) -> list[str]:
    """Return the paths of models in the catalogue, without doubled slashes."""
    paths = [text for path, text in tree.texts.items() if path.startswith("/catalog/") and path.endswith("/modelPath")]
    return ["/" + "/".join(part for part in text.split("/") if part) for text in paths]


def _root(tree: FileContent, path: Path) -> str:
    for root in ("/shape", "", *_roots(tree)):
        if f"{root}/model/mean" in tree.arrays:
            return root
    if tree.attributes.get("/", {}).get("format") == "shapespace model":
        raise ValueError("it is a shapespace model, but has no checksum")
    raise ModelFileError(f"{path} is not a shapespace model or a statismo model: it has no /model/mean.")


def _version(tree: FileContent, root: str) -> tuple[int, int] | None:
    for prefix in (root, ""):
        numbers = [tree.arrays.get(f"{prefix}/version/{name}") for name in ("majorVersion", "minorVersion")]
        if all(number is not None and number.size == 1 for number in numbers):
            major, minor = (int(number.reshape(-1)[0]) for number in numbers if number is not None)
            return major, minor
    return None


def _part(tree: FileContent, root: str) -> _ModelBlock:
    mean, variance = _array(tree, f"{root}/model/mean").ravel(), _array(tree, f"{root}/model/pcaVariance").ravel()
    basis = _array(tree, f"{root}/model/pcaBasis")
    if basis.shape == (len(variance), len(mean)) != (len(mean), len(variance)):
        basis = basis.T
    if len(mean) % 3 or basis.shape != (len(mean), len(variance)) or not len(variance):
        raise ValueError(f"its mean, basis and variances have the shapes {mean.shape}, {basis.shape}, {variance.shape}")
    if not (all(map(are_measurable, (mean, basis, variance))) and (variance >= 0).all()):
        raise ValueError("its numbers are not finite, too large, or below 0")
    noise_at = f"{root}/model/noiseVariance"
    noise = float(_array(tree, noise_at).reshape(-1)[:1].sum()) if noise_at in tree.arrays else 0.0
    if not (noise >= 0 and are_measurable(np.array(noise))):
        raise ValueError("its noise is not finite, too large, or below 0")
    version = _version(tree, root)
    length = np.linalg.norm(basis, axis=0)
    if version is None:
        # Version 0.8 has no version number; files of other tools without a number may have columns of length 1.
        is_scaled = bool(np.abs(length - 1).max() > _UNIT_LENGTH)
    elif version == (0, 8):
        is_scaled = True
    elif version[0] == 1 or version in ((0, 9), (0, 91)):
        is_scaled = False
    else:
        raise ValueError(f"it is of version {version[0]}.{version[1]}, and 0.8, 0.9 and 1 are supported")
    unit = basis / np.where(is_scaled & (length > 0), length, 1.0)
    is_used = length > 0
    skew = np.abs(unit[:, is_used].T @ unit[:, is_used] - np.eye(int(is_used.sum()))).max(initial=0.0)
    # The variances in the file exclude the noise, which is added to every direction.
    n_orthogonal = len(variance) if skew <= ORTHOGONAL else 0
    displacements = scale_columns(unit, np.sqrt(variance + (noise if n_orthogonal else 0.0)))
    return _ModelBlock(mean, displacements, noise * (len(mean) - n_orthogonal))


def _array(tree: FileContent, path: str) -> FloatArray:
    if path not in tree.arrays:
        raise ValueError(f"there is no {path} in it")
    return np.asarray(tree.arrays[path], dtype=np.float64)


def _surface(
    tree: FileContent, root: str, mean: FloatArray, notes: list[str]
) -> tuple[FloatArray, IntArray | None, npt.NDArray[np.int64] | None]:
    """Return points (V, 3) of the reference, its triangles or None, and the surface vertices of a solid or None."""
    n = len(mean)
    representer = tree.attributes.get(f"{root}/representer", {})
    kind = str(representer.get("datasetType", "")).upper()
    if kind.startswith("IMAGE") or kind == "VECTOR":
        raise ValueError(f"it is a model of {kind.lower()}s, not of surfaces")
    points, is_by_column = _points(tree, root, mean)
    reference = tree.arrays.get(f"{root}/representer/reference")
    if reference is not None and reference.dtype.itemsize == 1:
        mesh = read_vtk(reference.tobytes(), Path(f"{root}/representer/reference"))
        return mesh.vertices if len(mesh.vertices) == n else points, mesh.faces, None
    cells = tree.arrays.get(f"{root}/{_LEGACY_CELLS}", tree.arrays.get(f"{root}/representer/cells"))
    if cells is None or not cells.size or kind == "POINT_SET":
        return points, None, None
    if cells.ndim != 2 or cells.dtype.kind not in "iu":
        raise ValueError(f"its cells have the shape {cells.shape} and the type {cells.dtype}")
    if 3 in cells.shape and 4 not in cells.shape:
        is_by_column = cells.shape[0] == 3 if cells.shape[0] != cells.shape[1] else is_by_column
    cells = cells.T if is_by_column else cells
    if cells.min() < 0 or cells.max() >= n:
        raise ValueError("its cells refer to points that do not exist")
    if cells.shape[1] == 4:
        faces = _outer_triangles(cells.astype(np.int64), mean)
        used = np.unique(faces)
        notes.append(f"The surface of its tetrahedra is read, {len(faces)} triangles; {n - len(used)} interior points "
                     "are omitted.")  # fmt: skip
        return points, np.searchsorted(used, faces).astype(np.int32), used
    if cells.shape[1] != 3:
        notes.append(f"Its cells of {cells.shape[1]} points are omitted.")
        return points, None, None
    return points, cells.astype(np.int32), None


def _points(tree: FileContent, root: str, mean: FloatArray) -> tuple[FloatArray, bool]:
    """Return the points (V, 3) of the reference, else of the mean, and whether they are stored in columns."""
    points = tree.arrays.get(f"{root}/{_LEGACY_POINTS}")
    if points is not None and points.shape == mean.shape:
        return points.astype(np.float64), False
    points = tree.arrays.get(f"{root}/representer/points")
    if points is None:
        return mean, True
    if points.shape == mean.shape[::-1]:
        return points.T.astype(np.float64), True
    if points.shape != mean.shape:
        raise ValueError(f"its mean has {len(mean)} vertices and its points the shape {points.shape}")
    return points.astype(np.float64), False


def _outer_triangles(cells: npt.NDArray[np.int64], mean: FloatArray) -> npt.NDArray[np.int64]:
    """Return the boundary triangles (M, 3) of tetrahedra (C, 4), oriented outward."""
    a, b, c, d = (mean[cells[:, corner]] for corner in range(4))
    volume = np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)
    cells = np.where((volume < 0)[:, None], cells[:, [0, 2, 1, 3]], cells)
    sides = cells[:, list(_OUTER)].reshape(-1, 3)
    _, first, count = np.unique(np.sort(sides, axis=1), axis=0, return_index=True, return_counts=True)
    return sides[np.sort(first[count == 1])]


def _mm(tree: FileContent, root: str, attributes: Mapping[str, str]) -> float | None:
    length = tree.arrays.get(f"{root}/representer/length-unit")
    if length is not None and length.size == 1 and 0 < float(length.reshape(-1)[0]) < np.inf:
        return round(1000 * float(length.reshape(-1)[0]), 9)
    return 1.0 if attributes.get("unit") == "mm" or root == "/shape" else None


def _parameters(tree: FileContent, root: str) -> dict[str, str]:
    """Return the metadata that `write_statismo` stores."""
    start = f"{root}/{_PARAMETERS}/"
    return {path.removeprefix(start): text for path, text in tree.texts.items() if path.startswith(start)}


def _n_training(tree: FileContent, root: str, part: _ModelBlock, parameters: Mapping[str, str]) -> int | None:
    if parameters.get("n_training", "").isdecimal():
        return int(parameters["n_training"][:9])
    scores = tree.arrays.get(f"{root}/modelinfo/scores")
    if scores is not None and scores.ndim == 2 and len(scores) == part.moved.shape[1] and scores.shape[1] > 1:
        return scores.shape[1]
    return None


def _landmarks(
    tree: FileContent, surfaces: Sequence[FloatArray], faces: IntArray | None, notes: list[str], path: Path
) -> SurfaceLandmarks:
    """Return the landmarks of the file, which are points, on the surface to which they are nearest.

    Args:
        tree: content of the file.
        surfaces: (V, 3) vertices of the reference and of the mean, in the unit of the file.
        faces: (F, 3) triangles of both surfaces.
        notes: list to which a sentence about omitted landmarks is added.
        path: path of the file, used in messages.
    """
    landmark_points = _landmark_points(tree, path)
    if not landmark_points:
        return SurfaceLandmarks()
    usable_faces = faces if faces is not None and are_triangles(faces, len(surfaces[0])) else None
    placed = [place_landmarks(Mesh(surface, usable_faces), landmark_points, precision=_SINGLE) for surface in surfaces]
    best = min(placed, key=lambda candidate: float(candidate.distance_mm.sum()))
    is_on_surface = best.distance_mm <= _POINTS_AT * float(np.ptp(surfaces[0], axis=0).max())
    if not is_on_surface.all():
        notes.append(
            f"{int((~is_on_surface).sum())} of {len(landmark_points)} landmarks lie more than "
            f"{100 * _POINTS_AT:g} % of the extent of the model off its surface and are omitted."
        )
    return best.select([name for name, is_there in zip(best.names, is_on_surface, strict=True) if is_there])


def _landmark_points(tree: FileContent, path: Path) -> dict[str, FloatArray]:
    for kind in ("json", "text"):
        text = tree.texts.get(f"/metadata/landmarks/{kind}", "")
        if not text.strip():
            continue
        try:
            pairs = LANDMARK_FORMATS[".json"].read(text.encode(), path) if kind == "json" else _tlms(text)
        except (ShapespaceError, ValueError, IndexError) as error:
            raise ValueError("its landmarks cannot be read") from error
        return {name: point for name, point in pairs if point is not None and are_measurable(point)}
    return {}


def _tlms(text: str) -> list[tuple[str, FloatArray]]:
    """Return the visible landmarks of lines `name visible x y z`."""
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    return [(row[0], np.array(row[2:5], dtype=np.float64).reshape(3)) for row in rows if row[1] != "0"]


@dataclass
class _TreeBuilder:
    """Builder of the tree of `model`."""

    model: LinearModel
    parameters: Mapping[str, str]
    built: str
    arrays: dict[str, npt.NDArray[Any]] = field(default_factory=dict[str, npt.NDArray[Any]])
    texts: dict[str, str] = field(default_factory=dict[str, str])
    attributes: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    groups: list[str] = field(default_factory=list[str])

    def add_version(self, root: str) -> None:
        self.arrays[f"{root}/version/majorVersion"] = np.array(0, dtype=np.int32)
        self.arrays[f"{root}/version/minorVersion"] = np.array(9, dtype=np.int32)

    def add_model(self, root: str, mean: FloatArray, displacements: FloatArray, representer: str) -> None:
        """Add a model: `mean` (D,), and `displacements` (D, K) of one standard deviation of each mode."""
        basis, stddev, _ = orthonormal(displacements)
        if not len(stddev):
            basis, stddev = np.full((len(mean), 1), len(mean) ** -0.5), np.zeros(1)
        numbers = {"mean": mean, "pcaBasis": basis, "pcaVariance": stddev**2, "noiseVariance": np.zeros(1)}
        self.arrays.update({f"{root}/model/{name}": value.astype(np.float32) for name, value in numbers.items()})
        builder = f"{root}/modelinfo/modelBuilder-0"
        self.arrays[f"{root}/modelinfo/scores"] = np.zeros((1, 1), dtype=np.float32)
        self.texts[f"{root}/modelinfo/build-time"] = self.texts[f"{builder}/buildTime"] = self.built
        self.texts[f"{builder}/builderName"] = "shapespace"
        self.texts.update({f"{root}/{_PARAMETERS}/{name}": text for name, text in self.parameters.items()})
        self.groups += [f"{builder}/dataInfo", f"{root}/{_PARAMETERS}", f"{root}/representer/pointData"]
        faces = self.model.faces
        self.attributes[f"{root}/representer"] = {
            "name": representer,
            "datasetType": "POINT_SET" if faces is None else "POLYGON_MESH",
            "version": "1.0",
            "version/majorVersion": "0",
            "version/minorVersion": "9",
        }
        self.arrays[f"{root}/representer/points"] = np.ascontiguousarray(self.model.mean.T, dtype=np.float32)
        if faces is not None:
            self.arrays[f"{root}/representer/cells"] = np.ascontiguousarray(faces.T, dtype=np.int32)
        self.add_version(root)

    def add_catalogue(self, *names: str) -> None:
        for name in names:
            self.texts[f"/catalog/MorphableModel.{name}/modelType"] = "POLYGON_MESH_MODEL"
            self.texts[f"/catalog/MorphableModel.{name}/modelPath"] = f"/{name}"

    def tree(self) -> FileContent:
        groups = ["/"]
        for path in [*self.arrays, *self.texts, *(f"{group}/" for group in self.groups)]:
            parents = path.split("/")[1:-1]
            groups += ["/" + "/".join(parents[:count]) for count in range(1, len(parents) + 1)]
        return FileContent(self.arrays, self.texts, self.attributes, tuple(dict.fromkeys(groups)))


def tree_of(model: LinearModel) -> tuple[FileContent, list[str]]:
    """Return the tree of `model` in version 0.9 and single precision, and sentences about changed or omitted data.

    With expressions it is a Morphable Model of scalismo-faces, with a grey placeholder for the required colour model.
    """
    provenance = {
        "provenance": model.provenance,
        "licence": model.licence,
        "held_out": "yes" if model.held_out else "no",
    }
    provenance |= {"unit": "mm"} if model.mm == 1.0 else {}
    provenance |= {"parts": json.dumps(dict(model.parts))} if model.parts else {}
    provenance |= {"n_training": str(model.n_training)} if model.n_training else {}
    provenance = {name: text.replace("\0", " ") for name, text in provenance.items() if text}
    growing = _TreeBuilder(model, provenance, datetime.now(UTC).strftime("%a %b %d %H:%M:%S UTC %Y"))
    notes = ["Numbers are in single precision."]
    mean = model.mean.ravel()
    if model.expression is None:
        growing.add_model("", mean, model.shape.moved, "itkStandardMeshRepresenter")
    else:
        no_motion, grey = np.zeros(len(mean)), np.full(len(mean), _GREY)
        growing.add_model("/shape", mean, model.shape.moved, "gravis::MeshShapeRepresenter")
        growing.add_model("/color", grey, np.zeros((len(mean), 0)), "gravis::MeshColorRepresenter")
        growing.add_model("/expression", no_motion, model.expression.moved, "gravis::MeshExpressionRepresenter")
        growing.texts["/color/representer/colorspace"] = "RGB"
        growing.add_version("")
        growing.add_catalogue("shape", "color", "expression")
        notes.append("It is a Morphable Model of scalismo-faces; its colour model is a grey placeholder.")
    if model.landmarks:
        # Positions are on the surface in single precision, as in the file.
        positions = model.landmarks.positions(model.mean.astype(np.float32).astype(np.float64))
        growing.texts["/metadata/landmarks/json"] = LANDMARK_FORMATS[".json"].write(positions)
    kept_variance = sum(float((block.moved**2).sum()) for block in model.blocks)
    total = model.shape.total_variance
    if total is not None and total > kept_variance * (1 + _OMITTED):
        notes.append(f"The {1 - kept_variance / total:.2g} of the variance that the modes do not contain is omitted.")
    return growing.tree(), notes


def _hdf5_of(tree: FileContent) -> bytes:
    """Return `tree` as an HDF5 file; texts and attributes are null-terminated scalars of fixed length."""
    import h5py  # slow import (0.05 s), needed for writing only

    low: Any = h5py

    def fixed(text: str) -> tuple[Any, Any]:
        data = text.encode("utf-8", "replace") + b"\0"
        kind = low.h5t.C_S1.copy()
        kind.set_size(len(data))
        kind.set_strpad(low.h5t.STR_NULLTERM)
        return kind, np.array(data, dtype=f"S{len(data)}")

    memory = io.BytesIO()
    with h5py.File(memory, "w", libver="earliest", track_order=False) as file:
        scalar = low.h5s.create(low.h5s.SCALAR)
        for path in sorted(tree.groups):
            file.require_group(path)
        for path, array in tree.arrays.items():
            file.create_dataset(path, data=array, track_order=False)
        for path, text in tree.texts.items():
            group_path, _, name = path.rpartition("/")
            kind, value = fixed(text)
            parent: Any = file[group_path or "/"]
            low.h5d.create(parent.id, name.encode(), kind, scalar).write(low.h5s.ALL, low.h5s.ALL, value)
        for path, attributes in tree.attributes.items():
            owner: Any = file[path]
            for name, text in attributes.items():
                kind, value = fixed(str(text))
                low.h5a.create(owner.id, name.encode(), kind, scalar).write(value)
    return memory.getvalue()
