"""Principal components with the mean surface in a separate file: GIAS2 and MONAI-Physio.

GIAS2 has `NAME.pc.npz` and `NAME_mean.*`, MONAI-Physio (PhysioTwin4D) `pca_model.json` and `pca_mean_surface.vtp`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from shapespace.errors import FileError, FileFormatError, ModelFileError
from shapespace.formats.model_parts import LinearModel, Modes, json_object, scale_columns
from shapespace.io.containers.archives import LARGEST_BYTES, npy_array, zip_members
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import open_file, read_bytes
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, read_mesh
from shapespace.io.parsing import json_value
from shapespace.types import FloatArray, IntArray

_AGAIN = "save the principal components again"
_NEEDED = ("mean", "weights", "modes")
_FIRST_MEMBERS = (b"mean.npy", b"weights.npy", b"modes.npy")
_SAME = 1e-4  # share of the extent: single precision and rounding in text
_MONAI_MODEL, _MONAI_SURFACE = "pca_model.json", "pca_mean_surface.vtp"
_LARGEST_JSON_BYTES = 2**29  # 512 MiB
_EXPORT_AGAIN = "export the model again"
_MONAI_KEYS = (b'"eigenvalues"', b'"explained_variance_ratio"')


def is_gias(path: Path, head: bytes) -> bool:
    """Return whether a file has the ending of GIAS2, or is an `.npz` that begins with the mean as in GIAS2."""
    if not path.name.lower().endswith(".npz") or head[:2] != b"PK":
        return False
    member_name = head[30 : 30 + int.from_bytes(head[26:28], "little")]
    return path.name.lower().endswith(".pc.npz") and member_name in _FIRST_MEMBERS


def read_gias(path: Path) -> LinearModel:
    """Read `PrincipalComponents` of GIAS2 with interleaved coordinates (`gias-trainpcashapemodel`), or all x first."""
    check_file(path, LARGEST_BYTES, _AGAIN)
    try:
        with open_file(path) as stream:
            members = zip_members(stream, path.stat().st_size)
        mean, variance, modes = (_numbers(members[f"{name}.npy"]) for name in _NEEDED)
    except FileError:
        raise
    except (KeyError, ValueError, OSError) as error:
        problem = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        raise ModelFileError(f"{path} contains no principal components of GIAS2 ({problem}); {_AGAIN}.") from error
    mean, variance = mean.ravel(), variance.ravel()
    if modes.ndim != 2 or mean.size % 3 or len(modes) != mean.size or modes.shape[1] > variance.size:
        raise ModelFileError(
            f"{path} has inconsistent parts: mean {mean.shape}, modes {modes.shape}, weights "
            f"{variance.shape}; {_AGAIN}."
        )
    variance = variance[: modes.shape[1]]
    displacements = scale_columns(modes, np.sqrt(np.maximum(variance, 0.0)))
    notes: list[str] = []
    spread = _read_optional(members, "SD")
    if spread is not None and spread.size == mean.size:
        displacements = displacements * spread.reshape(-1, 1)
        notes.append("Each coordinate was divided by its standard deviation; this is reverted.")
    scores = _read_optional(members, "projectedWeights")
    stem = path.name[: -len(".pc.npz")] if path.name.lower().endswith(".pc.npz") else path.stem
    candidates = (path.with_name(f"{stem}_mean{ending}") for ending in MESH_ENDINGS)
    surface = next((candidate for candidate in candidates if candidate.is_file()), None)
    faces: IntArray | None = None
    if surface is None:
        notes.append("Its folder contains no surface of its mean (NAME_mean.ply), so it is a point model.")
    else:
        points, faces, blocked = _match_surface(surface, mean, path)
        if blocked:
            mean = points.ravel()
            displacements = displacements.reshape(3, len(points), -1).transpose(1, 0, 2).reshape(mean.size, -1)
            notes.append("Its coordinates were stored one after another, all x first.")
    return LinearModel(
        mean=mean.reshape(-1, 3),
        shape=Modes(displacements),
        faces=faces,
        n_training=scores.shape[1] if scores is not None and scores.ndim == 2 and scores.shape[1] > 1 else None,
        provenance=f"GIAS2 principal components {path.name}",
        notes=tuple(notes),
    )


def _numbers(data: bytes) -> FloatArray:
    array = npy_array(data)
    if array.dtype.kind not in "fiu":
        raise ValueError("it contains other data than numbers")
    return array.astype(np.float64)


def _read_optional(members: dict[str, bytes], name: str) -> FloatArray | None:
    """Return an optional array, which GIAS2 saves as a pickled None if it is missing."""
    try:
        return _numbers(members[f"{name}.npy"])
    except (KeyError, ValueError):
        return None


def _match_surface(surface: Path, mean: FloatArray, path: Path) -> tuple[FloatArray, IntArray | None, bool]:
    """Return vertices and triangles, and whether `mean` has all x before all y."""
    mesh = read_mesh(surface)
    if not np.isfinite(mean).all() or not np.isfinite(mesh.vertices).all():
        raise ModelFileError(f"{path} has a mean that is not finite; {_AGAIN}.")
    size = float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0
    layouts: list[tuple[npt.NDArray[np.float64], bool]] = [(mean.reshape(-1, 3), False), (mean.reshape(3, -1).T, True)]
    for points, blocked in layouts:
        if points.shape == mesh.vertices.shape and np.abs(points - mesh.vertices).max() <= _SAME * size:
            return points, mesh.faces, blocked
    for points, blocked in layouts:
        # STL does not preserve the order of vertices, only their positions.
        nearest = np.asarray(cKDTree(points).query(mesh.vertices)[1], dtype=np.int32)
        if mesh.faces is not None and np.abs(points[nearest] - mesh.vertices).max() <= _SAME * size:
            return points, nearest[mesh.faces], blocked
    raise ModelFileError(f"{path} has another mean than {surface.name} in its folder; remove or rename that surface.")


def is_monai(path: Path, head: bytes) -> bool:
    """Return whether a path is a `pca_model.json` or JSON with the same beginning, or a folder with such a file."""
    if path.is_dir():
        return (path / _MONAI_MODEL).is_file() and (path / _MONAI_SURFACE).is_file()
    if path.suffix.lower() != ".json":
        return False
    return path.name == _MONAI_MODEL or (head.lstrip()[:1] == b"{" and any(key in head for key in _MONAI_KEYS))


def read_monai(path: Path) -> LinearModel:
    """Read mean surface and principal components from a folder, or from the JSON file in it."""
    file = path / _MONAI_MODEL if path.is_dir() else path
    check_file(file, _LARGEST_JSON_BYTES, _EXPORT_AGAIN)
    surface = file.with_name(_MONAI_SURFACE)
    if not surface.is_file():
        raise ModelFileError(f"{file} needs the surface {_MONAI_SURFACE} in its folder; copy it there.")
    mean = read_mesh(surface)
    tree = json_object(json_value(read_bytes(file), file))
    try:
        components = np.array(tree["components"], dtype=np.float64)
        variance = np.array(tree["eigenvalues"], dtype=np.float64)
        ratio = np.array(tree.get("explained_variance_ratio", ()), dtype=np.float64)
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise FileFormatError(f"{file} has no components and eigenvalues of numbers; {_EXPORT_AGAIN}.") from error
    if components.ndim != 2 or components.shape != (variance.size, mean.vertices.size) or (variance < 0).any():
        raise ModelFileError(
            f"{file} has components of the shape {components.shape} and {variance.size} eigenvalues, which do not "
            f"match the {len(mean.vertices)} points of {_MONAI_SURFACE}; {_EXPORT_AGAIN}."
        )
    return LinearModel(
        mean=mean.vertices,
        shape=Modes(scale_columns(components.T, np.sqrt(variance)), total_variance=_total_variance(variance, ratio)),
        faces=mean.faces,
        provenance=f"MONAI-Physio model in {file.parent.name}",
    )


def _total_variance(variance: FloatArray, ratio: npt.NDArray[np.float64]) -> float | None:
    """Return the total variance, including omitted modes, from the explained variance ratio of the first mode."""
    if ratio.shape != variance.shape or not variance.size or not 0 < ratio[0] <= 1:
        return None
    return float(variance[0] / ratio[0])
