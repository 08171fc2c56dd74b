"""eos `.bin`: a cereal archive of one morphable model, little-endian, without names or a magic number."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from shapespace.errors import ModelFileError
from shapespace.formats.model_parts import LinearModel, Modes, orthonormal, scale_columns
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import read_bytes, write_bytes
from shapespace.types import FloatArray, SurfaceLandmarks

_AGAIN = "give a model that eos has saved"
_BLENDSHAPES_AGAIN = "give the blendshapes that eos has saved"
_LARGEST_BYTES = 2**32  # 4 GiB
_NEWEST = 4  # newest version of eos::morphablemodel::MorphableModel; it is the one written
_MOST_NAME_BYTES = 4096  # limit on damaged files; names of blendshapes are words
_PCA, _BLENDSHAPES = 0, 1  # index of the std::variant of expression models in eos::morphablemodel::MorphableModel
_NOTHING: Final = np.zeros((0, 0))
_SFM = (3448, 63, 6736)  # vertices, modes and triangles of the Surrey Face Model
_SFM_LICENCE = "Surrey Face Model (3448): non-commercial use only, see its README"
Item = TypeVar("Item")


def is_eos(path: Path, head: bytes) -> bool:
    """Return whether a file begins with a version of eos and a mean of one column."""
    if path.suffix.lower() != ".bin" or len(head) < 12:
        return False
    version, rows, columns = struct.unpack_from("<Iii", head)
    if 1 <= version <= _NEWEST and rows > 0 and rows % 3 == 0 and columns == 1:
        return True
    return _are_blendshapes(head)


def read_eos(path: Path) -> LinearModel:
    """Read `eos.morphablemodel`: shape, colour, expressions of PCA or blendshapes; versions 1 to 4."""
    check_file(path, _LARGEST_BYTES, _AGAIN)
    data = read_bytes(path)
    if _are_blendshapes(data[:16]):
        raise ModelFileError(
            f"{path} contains only the blendshapes of an eos model; give the model, and this file with --expressions."
        )
    try:
        return _model(_Archive(data))
    except (_DamagedArchiveError, ValueError, OverflowError) as error:
        raise ModelFileError(f"{path} is damaged, or not a model of eos: {error}; {_AGAIN}.") from error


def write_eos(model: LinearModel, path: Path) -> Sequence[str]:
    """Write version 4 in single precision, see `ModelFormat.write`."""
    out = bytearray(struct.pack("<I", _NEWEST))
    out += _pca_bytes(model.mean.ravel(), model.shape.moved, model)
    out += _pca_bytes(_NOTHING, _NOTHING, None)
    if model.expression is None:
        out += struct.pack("<B", 1)
    else:
        zero = np.zeros(model.mean.size)
        out += struct.pack("<Bi", 0, _PCA) + _pca_bytes(zero, model.expression.moved, model)
    if model.landmarks:
        out += struct.pack("<BQ", 0, len(model.landmarks))
        for name in sorted(model.landmarks):
            text = name.encode()
            out += struct.pack("<Q", len(text)) + text + struct.pack("<i", model.landmarks[name])
    else:
        out += struct.pack("<B", 1)
    out += struct.pack("<QQ", 0, 0)
    write_bytes(path, bytes(out))
    notes = ["Numbers are in single precision.", *_moved_landmarks(model)]
    if model.provenance or model.licence:
        notes.append("Provenance and licence are omitted, since eos has no field for them.")
    if model.parts:
        notes.append(f"The parts {', '.join(model.parts)} are omitted, since eos has no field for them.")
    return notes


def _moved_landmarks(model: LinearModel) -> list[str]:
    """Return a sentence on the distances by which landmarks move to vertices; an empty list if all are at vertices."""
    vertices = model.mean[list(model.landmarks.values())]
    moved_mm = np.linalg.norm(model.landmarks.interpolate(model.mean) - vertices, axis=1) * (model.mm or 1.0)
    if not moved_mm.any():
        return []
    return [
        f"Landmarks are moved to the nearest vertices, since eos stores vertices only: {moved_mm.mean():.2g} mm on "
        f"average, at most {moved_mm.max():.2g} mm ({model.landmarks.names[int(moved_mm.argmax())]})."
    ]


def read_blendshapes(path: Path) -> Modes:
    """Return the expressions in a file that `eos.morphablemodel.save_blendshapes` wrote.

    Raises:
        FileError: it cannot be read.
        ModelFileError: it is damaged, or not such a file.
    """
    check_file(path, _LARGEST_BYTES, _BLENDSHAPES_AGAIN)
    archive = _Archive(read_bytes(path))
    try:
        with np.errstate(invalid="ignore"):
            names, displacements = archive.blendshapes()
        if not archive.at_end:
            raise _DamagedArchiveError("it contains other data than blendshapes")
        if len(set(map(len, displacements))) != 1 or len(displacements[0]) % 3:
            raise _DamagedArchiveError("they have different numbers of vertices")
    except (_DamagedArchiveError, ValueError, OverflowError) as error:
        raise ModelFileError(f"{path} contains no blendshapes of eos: {error}; {_BLENDSHAPES_AGAIN}.") from error
    return Modes(np.stack(displacements, axis=1), names)


def _are_blendshapes(head: bytes) -> bool:
    """Return whether a file begins with a number of blendshapes and the length of the first name."""
    count, length = struct.unpack_from("<QQ", head) if len(head) >= 16 else (0, 0)
    return bool(0 < count < 2**16 and 0 < length < _MOST_NAME_BYTES)


class _DamagedArchiveError(ValueError):
    """The bytes are not an eos archive; the message gives the reason, as a clause."""


class _Archive:
    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def at_end(self) -> bool:
        return self._at == len(self._data)

    def fields(self, layout: str) -> tuple[Any, ...]:
        return struct.unpack(f"<{layout}", self._take(struct.calcsize(f"<{layout}")))

    def number(self, layout: str) -> int:
        return int(self.fields(layout)[0])

    def array(self, kind: str, count: int, *row: int) -> npt.NDArray[Any]:
        dtype = np.dtype(kind)
        content = self._take(count * int(np.prod(row, dtype=np.int64)) * dtype.itemsize)
        return np.frombuffer(content, dtype).reshape(count, *row)

    def matrix(self) -> FloatArray:
        rows, columns = self.fields("ii")
        if rows < 0 or columns < 0:
            raise _DamagedArchiveError("a matrix has a negative size")
        return self.array("<f4", rows * columns).reshape(columns, rows).T.astype(np.float64)

    def vector(self, kind: str, *row: int) -> npt.NDArray[Any]:
        return self.array(kind, self.number("Q"), *row)

    def text(self) -> str:
        size = self.number("Q")
        if size > _MOST_NAME_BYTES:
            raise _DamagedArchiveError("a name is too long")
        return self._take(size).decode(errors="replace")

    def many(self, read_item: Callable[[], Item], least_bytes: int) -> list[Item]:
        count = self.number("Q")
        if count * least_bytes > len(self._data) - self._at:
            raise _DamagedArchiveError("it is cut short")
        return [read_item() for _ in range(count)]

    def blendshapes(self) -> tuple[tuple[str, ...], list[FloatArray]]:
        """Return the names and displacements (D,) of the blendshapes."""
        pairs = self.many(lambda: (self.text(), self.matrix().ravel()), 16)
        return tuple(name for name, _ in pairs), [displacements for _, displacements in pairs]

    def _take(self, size: int) -> bytes:
        if size > len(self._data) - self._at:
            raise _DamagedArchiveError("it is cut short")
        self._at += size
        return self._data[self._at - size : self._at]


def _model(archive: _Archive) -> LinearModel:
    version = archive.number("I")
    if not 1 <= version <= _NEWEST:
        raise _DamagedArchiveError(f"it is of version {version}, and versions 1 to {_NEWEST} are supported")
    mean, displacements, faces = _pca(archive)
    colour = _pca(archive)[0]
    expression, notes = None, list[str]()
    if version >= 2 and not archive.number("B"):
        expression, displaced = _expression(archive, len(mean))
        mean = mean + displaced
    landmarks: dict[str, int] = {}
    if version >= 3 and not archive.number("B"):
        landmarks = dict(archive.many(lambda: (archive.text(), archive.number("i")), 12))
    textured = len(archive.vector("<f8", 2))
    if version >= 4:
        archive.vector("<i4", 3)
    if not archive.at_end:
        raise _DamagedArchiveError("it contains other data than a model")
    if len(colour):
        notes.append("Its colour model is omitted.")
    if textured:
        notes.append("Its texture coordinates are omitted.")
    is_sfm = (len(mean) // 3, displacements.shape[1], len(faces)) == _SFM
    return LinearModel(
        mean=mean.reshape(-1, 3),
        shape=Modes(displacements),
        expression=expression,
        faces=faces.astype(np.int32) if len(faces) else None,
        landmarks=SurfaceLandmarks.of(landmarks),
        provenance=f"eos model of version {version}",
        licence=_SFM_LICENCE if is_sfm else "",
        notes=tuple(notes),
    )


def _pca(archive: _Archive) -> tuple[FloatArray, FloatArray, npt.NDArray[Any]]:
    """Return mean (D,), displacements (D, K) of one standard deviation of each mode, and triangles."""
    mean, basis, variance = archive.matrix(), archive.matrix(), archive.matrix()
    faces = archive.vector("<i4", 3)
    if mean.shape[1] > 1 or basis.shape != (mean.size, variance.size) or (variance < 0).any() or mean.size % 3:
        raise _DamagedArchiveError(f"its parts have the shapes {mean.shape}, {basis.shape} and {variance.shape}")
    return mean.ravel(), scale_columns(basis, np.sqrt(variance.ravel())), faces


def _expression(archive: _Archive, size: int) -> tuple[Modes, FloatArray]:
    """Return the modes of expressions, and their mean displacement (D,)."""
    kind = archive.number("i")
    if kind == _PCA:
        mean_displacement, displacements, _ = _pca(archive)
        if len(mean_displacement) != size:
            raise _DamagedArchiveError("expressions have another number of vertices")
        return Modes(displacements), mean_displacement
    if kind != _BLENDSHAPES:
        raise _DamagedArchiveError(f"its type of expressions, {kind}, is unknown")
    names, blendshapes = archive.blendshapes()
    if not blendshapes or any(len(displacements) != size for displacements in blendshapes):
        raise _DamagedArchiveError("blendshapes have another number of vertices")
    return Modes(np.stack(blendshapes, axis=1), names), np.zeros(size)


def _pca_bytes(mean: FloatArray, displacements: FloatArray, model: LinearModel | None) -> bytes:
    basis, stddev = (displacements, np.zeros(0)) if not displacements.size else orthonormal(displacements)[:2]
    faces = None if model is None else model.faces
    triangles = np.zeros((0, 3), dtype="<i4") if faces is None else faces.astype("<i4")
    column = mean.reshape(-1, 1)
    parts = [column, basis, (stddev**2).reshape(-1, 1)]
    return b"".join(map(_matrix_bytes, parts)) + struct.pack("<Q", len(triangles)) + triangles.tobytes()


def _matrix_bytes(matrix: FloatArray) -> bytes:
    return struct.pack("<ii", *matrix.shape) + matrix.T.astype("<f4").tobytes()
