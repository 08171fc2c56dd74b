"""The files of ICT-FaceKit: its published OBJ files, one packed `.npz` made from them, and hashes of their content.

Of each published OBJ file we keep the first 11,248 `v` lines (face, head and neck; the rest is teeth, eyes and
sockets) and of the neutral mesh the first 11,144 polygons, quads split as a fan. A mode is stored as the difference
to the neutral mesh, taken in float64 and rounded once to float32, in centimetres as published. That is a pure function
of the file, so its SHA-256 verifies a download bit by bit even where the hash of the raw file is not known:

* neutral mesh: SHA-256 of the vertices (11248, 3) as little-endian float64, then the triangles (22288, 3) as int32;
* every other file: SHA-256 of the difference (11248, 3) as little-endian float32.

Source: https://github.com/USC-ICT/ICT-FaceKit, README, "Face Model Topology" (MIT licence).
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from shapespace.errors import DataError, FileFormatError
from shapespace.io.containers.archives import npy_header
from shapespace.io.files import atomic_path, read_bytes, read_error
from shapespace.types import FloatArray, IntArray

Float32Array: TypeAlias = npt.NDArray[np.float32]

# ICT-FaceKit: vertices 0 to 9408 are the face, 9409 to 11247 the rest of the head and neck
FACE_VERTICES, HEAD_VERTICES = 9409, 11248
FACE_POLYGONS, HEAD_POLYGONS = 9230, 11144  # ICT-FaceKit: quads of the same two parts, in the order of its OBJ files
PACKED_NAME = "ict_face_and_head.npz"
NEUTRAL_NAME = "generic_neutral_mesh"

_MAX_OBJ_BYTES = 32 << 20  # 32 MiB, above ten times a published file
_MAX_MODES = 1000  # above the modes of ICT-FaceKit, as a limit on damaged files


@dataclass(frozen=True, eq=False)
class PackedIct:
    """Arrays of ICT-FaceKit, in centimetres as published.

    Args:
        mean: (11248, 3) float64, the neutral mesh.
        identity: (I, 11248, 3) float32, differences to the mean.
        expression: (E, 11248, 3) float32, differences to the mean.
        expression_names: E names, sorted.
        faces: (22288, 3) int32.
    """

    mean: FloatArray
    identity: Float32Array
    expression: Float32Array
    expression_names: tuple[str, ...]
    faces: IntArray


def read_obj(path: Path) -> tuple[FloatArray, list[list[int]]]:
    """Return the first 11,248 vertices (11248, 3) float64 and the first 11,144 polygons, zero-based, of an OBJ file.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is not a mesh of the ICT-FaceKit topology.
    """
    try:
        size = path.stat().st_size
    except OSError as error:
        raise read_error(path, error) from error
    if size > _MAX_OBJ_BYTES:
        raise FileFormatError(f"{path} has {size} bytes, far more than a file of ICT-FaceKit; download it again.")
    rows: list[list[float]] = []
    polygons: list[list[int]] = []
    try:
        for line in read_bytes(path).decode("ascii", errors="replace").splitlines():
            if line.startswith("v ") and len(rows) < HEAD_VERTICES:
                x, y, z = line.split()[1:4]
                rows.append([float(x), float(y), float(z)])
            elif line.startswith("f ") and len(polygons) < HEAD_POLYGONS:
                polygons.append([int(corner.split("/")[0]) - 1 for corner in line.split()[1:]])
    except ValueError as error:
        raise FileFormatError(f"{path} has a line that is not OBJ; download it again.") from error
    if len(rows) < HEAD_VERTICES or len(polygons) < HEAD_POLYGONS:
        raise FileFormatError(
            f"{path} has {len(rows)} vertices and {len(polygons)} polygons, but ICT-FaceKit has {HEAD_VERTICES} and "
            f"{HEAD_POLYGONS} in face and head; it is cut short or not a file of ICT-FaceKit, so download it again."
        )
    vertices = np.array(rows)
    if not np.isfinite(vertices).all():
        raise FileFormatError(f"{path} has vertices that are not finite; download it again.")
    return vertices, polygons


def triangulate(polygons: list[list[int]]) -> IntArray:
    """Return (T, 3) int32 triangles: each polygon as a fan from its first corner, in order."""
    return np.array([[p[0], p[j], p[j + 1]] for p in polygons for j in range(1, len(p) - 1)], dtype=np.int32)


def difference(vertices: FloatArray, neutral: FloatArray) -> Float32Array:
    """Return `vertices - neutral` (11248, 3) in float64, rounded once to float32."""
    return (vertices - neutral).astype(np.float32)


def neutral_hash(mean: FloatArray, faces: IntArray) -> str:
    """Return the hexadecimal content hash of the neutral mesh; see the module's docstring."""
    return hashlib.sha256(mean.astype("<f8").tobytes() + faces.astype("<i4").tobytes()).hexdigest()


def mode_hash(mode: Float32Array) -> str:
    """Return the hexadecimal content hash of one difference; see the module's docstring."""
    return hashlib.sha256(mode.astype("<f4").tobytes()).hexdigest()


def read_obj_folder(folder: Path) -> PackedIct:
    """Return the packed content of the published OBJ files in `folder`: the neutral mesh and the modes present.

    Raises:
        FileError: there is no neutral mesh, or a file cannot be read.
        FileFormatError: a file is not of the ICT-FaceKit topology.
    """
    mean, polygons = read_obj(folder / f"{NEUTRAL_NAME}.obj")
    faces = triangulate(polygons)
    if faces.min() < 0 or faces.max() >= HEAD_VERTICES:
        raise FileFormatError(f"{folder / NEUTRAL_NAME}.obj has triangles of another topology; download it again.")
    identity: list[Float32Array] = []
    expression: list[Float32Array] = []
    names: list[str] = []
    for path in sorted(folder.glob("*.obj")):
        if path.stem == NEUTRAL_NAME:
            continue
        mode = difference(read_obj(path)[0], mean)
        if path.stem.startswith("identity"):
            identity.append(mode)
        else:
            expression.append(mode)
            names.append(path.stem)
    return PackedIct(mean, _stack(identity), _stack(expression), tuple(names), faces)


def _stack(modes: list[Float32Array]) -> Float32Array:
    return np.stack(modes) if modes else np.zeros((0, HEAD_VERTICES, 3), dtype=np.float32)


def write_packed(path: Path, packed: PackedIct) -> None:
    """Write `packed` to the `.npz` file `path`, completely or not at all.

    Raises:
        FileError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        np.savez_compressed(
            temporary,
            mean=packed.mean,
            identity=packed.identity,
            expression=packed.expression,
            expression_names=np.array(packed.expression_names, dtype=np.str_),
            faces=packed.faces,
        )


def read_packed(path: Path) -> PackedIct:
    """Return the content of a packed `.npz` file; sizes are checked before anything is allocated.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is cut short, damaged, or not packed ICT-FaceKit.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            for entry, dtype, tail in (
                ("mean", "<f8", (HEAD_VERTICES, 3)),
                ("identity", "<f4", (HEAD_VERTICES, 3)),
                ("expression", "<f4", (HEAD_VERTICES, 3)),
                ("expression_names", "<U", ()),
                ("faces", "<i4", (3,)),
            ):
                with archive.open(f"{entry}.npy") as stream:
                    shape, fortran, stored_dtype = npy_header(stream)
                if fortran:
                    raise ValueError(f"{entry} is in column order")
                modes = entry in ("identity", "expression", "expression_names")
                fits = shape == tail if entry == "mean" else shape[1:] == tail and len(shape) == len(tail) + 1
                if not fits or not stored_dtype.str.startswith(dtype) or (modes and shape[0] > _MAX_MODES):
                    raise ValueError(f"{entry} has the shape {shape} and type {stored_dtype}")
                if stored_dtype.itemsize > 512 or (entry == "faces" and shape[0] > 4 * HEAD_POLYGONS):
                    raise ValueError(f"{entry} is far too large")
        with np.load(path, allow_pickle=False) as content:
            packed = PackedIct(
                content["mean"],
                content["identity"],
                content["expression"],
                tuple(str(name) for name in content["expression_names"]),
                content["faces"],
            )
        if len(packed.expression_names) != len(packed.expression):
            raise ValueError("there is not one name for each expression")
        if packed.faces.min() < 0 or packed.faces.max() >= HEAD_VERTICES:
            raise ValueError("its triangles point past its vertices")
        if not all(np.isfinite(a).all() for a in (packed.mean, packed.identity, packed.expression)):
            raise ValueError("its numbers are not finite")
    except OSError as error:
        raise read_error(path, error) from error
    except (ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise FileFormatError(
            f"{path} is not packed ICT-FaceKit or is damaged ({str(error).strip('.')}); delete it and get it again."
        ) from error
    return packed


def check_content(packed: PackedIct, hashes: Mapping[str, str], source: Path) -> None:
    """Check `packed` against the content `hashes` of the published files, by path such as `FaceXModel/jawOpen.obj`.

    Raises:
        DataError: a mode is missing, or its content differs from the published content.
    """
    found_hashes = {NEUTRAL_NAME: neutral_hash(packed.mean, packed.faces)}
    found_hashes |= {f"identity{i:03d}": mode_hash(mode) for i, mode in enumerate(packed.identity)}
    found_hashes |= {
        name: mode_hash(mode) for name, mode in zip(packed.expression_names, packed.expression, strict=True)
    }
    for path, expected in hashes.items():
        name = PurePosixPath(path).stem
        if found_hashes.get(name) != expected:
            problem = "lacks" if name not in found_hashes else "differs from the published"
            raise DataError(f"{source} {problem} {name}; delete it and get it again.")


def check_obj(path: Path, neutral: FloatArray | None, expected: str) -> None:
    """Check the content of one OBJ file against its hash; `neutral` (11248, 3) is None for the neutral mesh itself.

    Raises:
        DataError: its content differs from the published content.
        FileError: it cannot be read.
        FileFormatError: it is not a file of ICT-FaceKit.
    """
    vertices, polygons = read_obj(path)
    content_hash = (
        neutral_hash(vertices, triangulate(polygons)) if neutral is None else mode_hash(difference(vertices, neutral))
    )
    if content_hash != expected:
        raise DataError(f"{path} differs from the published file; delete it and get it again.")
