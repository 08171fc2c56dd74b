"""Readers of label volumes: NIfTI (`.nii`, `.nii.gz`), NRRD (`.nrrd`, header and data in one file) and MetaImage
(`.mha`, `.mhd`), as RAS millimetres.

nibabel and pynrrd read the headers of NIfTI and NRRD. The voxels are decoded in this module, so that the following are
rejected before memory is allocated: a header that declares more voxels than its file contains, a volume that takes more
memory than allowed, and a compressed stream that expands without end. Voxels are decompressed and converted in pieces
of 1 MiB, up to the declared size. No other file is opened, except the data file of `.mhd` in the same folder.
"""

from __future__ import annotations

import bz2
import gzip
import io
import math
import os
import re
import zlib
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.io.files import open_file, read_error
from shapespace.io.memory_cache import available_bytes
from shapespace.io.parsing import CUT_SHORT, damage_error
from shapespace.types import MAX_MEMORY_BYTES, FloatArray, LabelVolume, Segment

VOLUME_ENDINGS = (".nii", ".nii.gz", ".nrrd", ".mha", ".mhd")
"""File name endings that `read_volume` accepts."""

_MOST_BYTES = 1 << 31  # 2 GiB
_MOST_HEADER = 1 << 20  # 1 MiB
_PIECE = 1 << 20  # bytes (1 MiB)
_WORK_BYTES = 1 << 26
"""Memory for reading in addition to the labels: libraries, and pieces of 1 MiB as float64 (64 MiB; measured: 40)."""
_MOST_OF_MEMORY = 0.8  # share of the free memory; the rest is for other processes
# A deflate stream expands by a factor of at most 1032.
_DEFLATE_GROWTH = 1032
_BZIP2_SPARE, _BZIP2_GROWTH = 1 << 28, 10_000
"""bzip2 compresses zeros almost without limit. Volumes over 256 MiB may not expand by more than this factor; the border
of a label already prevents a higher compression."""
_HEADS = {348: "Nifti1Header", 540: "Nifti2Header"}
_SINGLE, _PAIR = (b"n+1", b"n+2"), (b"ni1", b"ni2")
_MAGIC_AT = {348: 344, 540: 4}
_NIFTI_MM = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}
MM_OF_UNITS = {"": 1.0, "mm": 1.0, "millimeter": 1.0, "m": 1e3, "meter": 1e3, "cm": 10.0, "um": 1e-3, "µm": 1e-3}
_NRRD_TYPES = {
    "i1": ("signed char", "int8", "int8_t"),
    "u1": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "i2": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "u2": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "i4": ("int", "signed int", "int32", "int32_t"),
    "u4": ("uint", "unsigned int", "uint32", "uint32_t"),
    "i8": ("longlong", "long long", "long long int", "signed long long", "signed long long int", "int64", "int64_t"),
    "u8": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "f4": ("float",),
    "f8": ("double",),
}
_META_TYPES = {"char": "signed char", "long": "int", "ulong": "uint", "ulong long": "ulonglong"}
"""Type of MetaImage after `MET_` -> name in NRRD, for types whose names differ."""
_TRUE = ("true", "1")
_META_END = re.compile(rb"^ElementDataFile\s*=[ \t]*(.*?)[ \t]*\r?(?:\n|\Z)", re.MULTILINE)
# Sign of each axis of a space that converts it to right, anterior, superior.
_NRRD_SPACES = {
    "right-anterior-superior": (1, 1, 1), "ras": (1, 1, 1),
    "left-anterior-superior": (-1, 1, 1), "las": (-1, 1, 1),
    "left-posterior-superior": (-1, -1, 1), "lps": (-1, -1, 1),
}  # fmt: skip
_UNORIENTED = "Its header does not state the orientation in the patient, so left and right may be swapped."
_LEAST_MM, _MOST_MM = 1e-4, 1e3  # mm, voxel sizes from microscopy to thick slices; beyond them the unit is wrong
_FLAT = 1e-4  # volume of unit axes below which they are coplanar
_APART_MM = 0.1  # mm, tolerated difference of sform and qform at the corners: rounding, less than a voxel
_ROUNDING = 1e-4
"""Tolerated difference from integers of labels that are stored as float32 or with a slope (rounding)."""


@dataclass(frozen=True, eq=False)
class _VolumeHeader:
    """Shape, type and orientation that a header declares.

    Args:
        shape: numbers of voxels along the axes of the file; the first axis varies fastest.
        kind: data type of a voxel.
        start: number of bytes before the first voxel.
        affine: (4, 4) affine transform from voxels to RAS, mm.
        slope: factor by which values in the file are multiplied.
        shift: offset added to the values after multiplication.
        notes: sentences for the user about the header.
        axes: indices of the three spatial axes.
        segments: segments of 3D Slicer, if any; one further axis may then be that of layers.
    """

    shape: tuple[int, ...]
    kind: np.dtype[Any]
    start: int
    affine: FloatArray
    slope: float = 1.0
    shift: float = 0.0
    notes: tuple[str, ...] = ()
    axes: tuple[int, ...] = (0, 1, 2)
    segments: tuple[Segment, ...] = ()

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * self.kind.itemsize


def require_volumes_extra() -> None:
    """Check that the packages for volumes are installed.

    Raises:
        ShapespaceError: the extra `volumes` is not installed.
    """
    packages = {"nibabel": "nibabel", "nrrd": "pynrrd", "skimage": "scikit-image"}
    missing = [package for module, package in packages.items() if find_spec(module) is None]
    if missing:
        raise ShapespaceError(
            f"Volumes need {' and '.join(missing)}, which is not installed; run pip install 'shapespace[volumes]'."
        )


def default_limit_bytes() -> int:
    """Return the memory limit of one volume: `MAX_MEMORY_BYTES`, or 80 % of the free memory if that is less."""
    free = available_bytes()
    return MAX_MEMORY_BYTES if free is None else min(MAX_MEMORY_BYTES, int(_MOST_OF_MEMORY * free))


def volume_name(path: Path) -> str:
    """Return the name of the file without its ending; `.nii.gz` and `.seg.nrrd` are endings of two parts."""
    for ending in (*sorted(VOLUME_ENDINGS, key=len, reverse=True), ".seg"):
        if path.name.lower().endswith(ending) and len(path.name) > len(ending):
            path = path.with_name(path.name[: -len(ending)])
    return path.name


def read_volume(path: Path | str, *, max_memory_bytes: int = MAX_MEMORY_BYTES) -> LabelVolume:
    """Read a label volume and the position of its voxels in the patient.

    Args:
        path: path of a file with one of the endings in `VOLUME_ENDINGS`, in upper or lower case.
        max_memory_bytes: largest allowed memory of the volume, bytes, checked before memory is allocated.

    Returns:
        The labels, and the affine transform from voxels to RAS, mm. For NIfTI, this is the sform, or else the qform.
        For NRRD, it is computed from space directions and origin, with LPS and LAS converted to RAS and units to
        millimetres. For MetaImage, it is computed from TransformMatrix, Offset and ElementSpacing, which are in LPS.
        Segments of 3D Slicer keep their names; overlapping segments are in layers.

    Raises:
        ShapespaceError: the extra `volumes` is not installed.
        FileError: it does not exist, cannot be read, or is too large.
        FileFormatError: it is not such a volume, is cut short or damaged, or declares more voxels than it contains.
        InputError: it is not a single 3-D volume of labels, or takes too much memory.
    """
    path = Path(path)
    require_volumes_extra()
    name = path.name.lower()
    if name.endswith((".nhdr", ".hdr", ".img")):
        raise damage_error(path, "its header and its data are two files; save it as one, .nii.gz or .nrrd")
    if not name.endswith(VOLUME_ENDINGS):
        raise damage_error(path, f"its ending is not that of a volume; use one of {', '.join(VOLUME_ENDINGS)}")
    # A damaged header may contain non-finite numbers, which are rejected below.
    with open_file(path) as file, ExitStack() as stack, np.errstate(invalid="ignore", over="ignore"):
        try:
            size = os.fstat(file.fileno()).st_size
            _check_size(size, path)
            read = _open_nrrd if name.endswith(".nrrd") else _open_nifti if ".nii" in name[-7:] else _open_meta
            head, stream = read(file, size, stack, path)
        except OSError as error:
            raise read_error(path, error) from error
        order, shape = _spatial_order(head, path)
        affine = _check_affine(head.affine, path)
        labels = _labels(stream, head, max_memory_bytes, path)
    labels = labels.reshape(head.shape, order="F").transpose(order).reshape(shape)
    return LabelVolume(labels, affine, path.name, head.notes, head.segments)


def _check_size(size: int, path: Path) -> None:
    if size > _MOST_BYTES + _MOST_HEADER:
        raise FileError(
            f"Cannot read {path}: it has {size:,} bytes, over the limit of {_MOST_BYTES:,}; crop it, as in 3D Slicer."
        )
    if not size:
        raise damage_error(path, "it is empty; export or copy it again")


def _open_nifti(file: BinaryIO, size: int, stack: ExitStack, path: Path) -> tuple[_VolumeHeader, IO[bytes]]:
    """Return the header of a NIfTI file, and a stream at its first voxel."""
    zipped = file.read(2) == b"\x1f\x8b"
    file.seek(0)
    stream: IO[bytes] = cast("IO[bytes]", stack.enter_context(gzip.GzipFile(fileobj=file))) if zipped else file
    with _translate_errors(path):
        head = _nifti_head(stream.read(540), path)
        _check_declared(head, size * _DEFLATE_GROWTH if zipped else size, path)
        stream.seek(head.start)
    return head, stream


@contextmanager
def _translate_errors(path: Path) -> Generator[None]:
    try:
        yield
    except FileError:
        raise
    except (OSError, EOFError, zlib.error) as error:
        raise damage_error(path, f"its compressed data end early or are wrong; {CUT_SHORT}") from error


def _labels(stream: IO[bytes], head: _VolumeHeader, max_memory_bytes: int, path: Path) -> npt.NDArray[np.integer[Any]]:
    """Return the labels as a flat array, decoded in pieces so that no more than the array is in memory at a time."""
    is_integral = head.kind.kind in "iu" and (head.slope, head.shift) == (1.0, 0.0)
    kind: np.dtype[Any] = head.kind.newbyteorder("=") if is_integral else np.dtype(np.int32)
    count = math.prod(head.shape)
    needed_bytes = count * kind.itemsize + _WORK_BYTES
    if needed_bytes > max_memory_bytes:
        raise InputError(
            f"{path} has {' x '.join(map(str, head.shape))} voxels, which take {needed_bytes / 2**30:.2g} GiB of "
            f"memory, over the limit of {max_memory_bytes / 2**30:.2g} GiB; crop or resample it, or allow "
            "more (--max-memory)."
        )
    # Memory pages of zeros, such as most of a mask, are not allocated.
    labels = np.zeros(count, dtype=kind)
    values = _LabelStatistics()
    buffer = memoryview(bytearray(min(_PIECE, head.bytes)))
    offset = 0
    with _translate_errors(path):
        while offset < count:
            request_bytes = min(len(buffer), (count - offset) * head.kind.itemsize)
            read = _fill_buffer(stream, buffer[:request_bytes])
            if read < request_bytes:
                available_values = offset * head.kind.itemsize + read
                raise damage_error(
                    path, f"it ends after {available_values:,} of {head.bytes:,} bytes of voxels; {CUT_SHORT}"
                )
            piece: npt.NDArray[Any] = np.frombuffer(buffer[:request_bytes], dtype=head.kind)
            if piece.any() or not is_integral:
                labels[offset : offset + len(piece)] = (
                    piece if is_integral else values.round_labels(piece * head.slope + head.shift, path)
                )
            offset += len(piece)
        # The checksum of a stream is checked only at its end.
        stream.read(1)
    values.check(path)
    return labels


def _fill_buffer(stream: IO[bytes], view: memoryview) -> int:
    """Read into `view` until it is full or the stream ends, and return how many bytes were read."""
    filled = 0
    while filled < len(view) and (count := cast(Any, stream).readinto(view[filled:])):
        filled += count
    return filled


@dataclass
class _LabelStatistics:
    """Statistics of label values that are stored as floats or with a slope."""

    low: float = math.inf
    high: float = -math.inf
    off: float = 0.0

    def round_labels(self, values: npt.NDArray[Any], path: Path) -> npt.NDArray[Any]:
        """Return values as integers, or zeros if they are not labels, for which `check` raises an error."""
        low, high = float(values.min()), float(values.max())
        if not math.isfinite(low) or not math.isfinite(high):
            raise InputError(f"{path} has voxels that are not finite, so it is not a label map; give the label map.")
        self.low, self.high = min(self.low, low), max(self.high, high)
        integers = np.rint(values)
        self.off = max(self.off, float(np.abs(values - integers).max()))
        return integers if self._are_labels() else np.zeros(len(values))

    def _are_labels(self) -> bool:
        return max(-self.low, self.high) < 2**31 and self.off <= _ROUNDING

    def check(self, path: Path) -> None:
        """Check that the values are labels.

        Raises:
            InputError: some values are not integers, or are too large.
        """
        if not self._are_labels():
            raise InputError(
                f"{path} has values between {self.low:.4g} and {self.high:.4g} that are not integers, such as "
                "probabilities; convert them to labels first, for example by a threshold."
            )


def _nifti_head(start: bytes, path: Path) -> _VolumeHeader:
    import nibabel

    size = next((n for n in _HEADS for order in ("<", ">") if start[:4] == np.array(n, order + "i4").tobytes()), 0)
    magic = start[_MAGIC_AT[size] :][:3] if size else b""
    if magic in _PAIR:
        raise damage_error(path, "its header and its data are two files; save it as one, .nii.gz")
    if magic not in _SINGLE or len(start) < size:
        raise damage_error(path, "its header is not that of a NIfTI volume; export it again as .nii.gz")
    try:
        header: Any = getattr(nibabel, _HEADS[size]).from_fileobj(io.BytesIO(start[:size]), check=False)
        slope, shift = header.get_slope_inter()
        kind, shape = np.dtype(header.get_data_dtype()), tuple(map(int, header.get_data_shape()))
        offset = int(header.get_data_offset())
        affine, notes = _nifti_affine(header)
        unit = str(header.get_xyzt_units()[0])
    except Exception as error:
        # nibabel may raise any exception for a manipulated header.
        raise damage_error(path, f"its header is damaged ({_first_words(error)}), so export it again") from error
    if unit not in _NIFTI_MM:
        raise damage_error(path, f"its header gives lengths in '{unit}', so export it again in mm")
    if offset < size:
        raise damage_error(path, f"its header declares that the voxels begin within the header; {CUT_SHORT}")
    slope, shift = (1.0, 0.0) if slope is None else (float(slope), float(shift or 0.0))
    return _VolumeHeader(
        shape=shape,
        kind=kind,
        start=offset,
        affine=_to_mm(affine, _NIFTI_MM[unit]),
        slope=slope,
        shift=shift,
        notes=notes,
    )


def _nifti_affine(header: Any) -> tuple[FloatArray, tuple[str, ...]]:
    form, code = header.get_sform(coded=True)
    other, other_code = header.get_qform(coded=True) if not code else _read_qform(header)
    if not code and not other_code:
        return np.array(header.get_base_affine(), dtype=np.float64), (_UNORIENTED,)
    if not code:
        return np.array(other, dtype=np.float64), ()
    affine = np.array(form, dtype=np.float64)
    notes: tuple[str, ...] = ()
    if other_code and other is not None:
        corners = np.array([[0, 0, 0, 1], [*np.array(header.get_data_shape())[:3], 1]], dtype=np.float64)
        distance_mm = float(np.abs(corners @ (affine - np.asarray(other)).T).max())
        if distance_mm > _APART_MM:
            notes = (f"Its sform and qform disagree by up to {distance_mm:.3g} mm; the sform is used.",)
    return affine, notes


def _read_qform(header: Any) -> tuple[Any, int]:
    try:
        return header.get_qform(coded=True)
    except Exception:  # an invalid qform is ignored, because the sform is used
        return None, 0


def _open_nrrd(file: BinaryIO, size: int, stack: ExitStack, path: Path) -> tuple[_VolumeHeader, IO[bytes]]:
    """Return the header of a NRRD file, and a stream at its first voxel."""
    import nrrd

    data = file.read(_MOST_HEADER)
    if data[:4] != b"NRRD":
        raise damage_error(path, "its header is not that of a NRRD volume; export it again as .nrrd")
    header_ends = [(position, len(blank)) for blank in (b"\n\n", b"\r\n\r\n") if (position := data.find(blank)) >= 0]
    if not header_ends:
        raise damage_error(path, f"its header has no end; {CUT_SHORT}")
    start = sum(min(header_ends))
    try:
        fields: dict[str, Any] = dict(nrrd.read_header(io.StringIO(data[:start].decode("utf-8", "replace"))))
    except Exception as error:
        # pynrrd may raise any exception for a manipulated header.
        raise damage_error(path, f"its header is damaged ({_first_words(error)}), so export it again") from error
    if "data file" in fields or "datafile" in fields:
        raise damage_error(path, "its data are in another file; save it with header and data in one")
    if any(fields.get(key) for key in ("line skip", "lineskip", "byte skip", "byteskip")):
        raise damage_error(path, "its header skips a part of the data, which is not supported; save it again")
    head = _nrrd_head(fields, path)
    encoding = str(fields.get("encoding", "")).lower()
    encoding = {"gz": "gzip", "bz2": "bzip2"}.get(encoding, encoding)
    if encoding not in ("raw", "gzip", "bzip2"):
        raise damage_error(path, f"its encoding is '{encoding}', but only raw, gzip and bzip2 are read; save it again")
    file.seek(start)
    return head, _voxel_stream(file, encoding, head, size - start, stack, path)


def _voxel_stream(
    file: BinaryIO, encoding: str, head: _VolumeHeader, size: int, stack: ExitStack, path: Path
) -> IO[bytes]:
    """Return a stream of the voxels in the next `size` bytes of a file, and check that all voxels fit in them."""
    growth = {"raw": size, "bzip2": _BZIP2_SPARE + _BZIP2_GROWTH * size}
    _check_declared(head, growth.get(encoding, _DEFLATE_GROWTH * size), path)
    if encoding == "gzip":
        return cast("IO[bytes]", stack.enter_context(gzip.GzipFile(fileobj=file)))
    if encoding == "bzip2":
        return stack.enter_context(bz2.BZ2File(file))
    return file if encoding == "raw" else cast("IO[bytes]", _ZlibStream(file))


def _open_meta(file: BinaryIO, size: int, stack: ExitStack, path: Path) -> tuple[_VolumeHeader, IO[bytes]]:
    """Return the header of a MetaImage file, and a stream at its first voxel."""
    data = file.read(_MOST_HEADER)
    end = _META_END.search(data)
    if end is None:
        raise damage_error(path, "its header is not that of a MetaImage volume; export it again as .mha")
    lines = (line.partition("=") for line in data[: end.start()].decode("latin-1").splitlines())
    fields = {key.strip().lower(): value.strip() for key, _, value in lines}

    def numbers(*keys: str) -> FloatArray | None:
        return next((np.array(fields[key].split(), dtype=np.float64) for key in keys if key in fields), None)

    big = fields.get("binarydatabyteordermsb", fields.get("elementbyteordermsb", ""))
    kind = fields.get("elementtype", "").lower().removeprefix("met_").replace("_", " ")
    try:
        steps, turn = numbers("elementspacing", "elementsize"), numbers("transformmatrix", "rotation", "orientation")
        origin = numbers("offset", "position", "origin")
        if steps is not None:
            steps = (np.eye(len(steps)) if turn is None else turn.reshape(-1, len(steps))) * steps[:, None]
        known: dict[str, Any] = {
            "type": _META_TYPES.get(kind, kind),
            "endian": "big" if big.lower() in _TRUE else "little",
            "sizes": fields.get("dimsize", "").split(),
            "dimension": fields.get("ndims"),
            "space": "lps",
            "space directions": steps,
            "space origin": np.zeros(3) if origin is None else origin,
        }
        skip = int(fields.get("headersize", "0"))
    except ValueError as error:
        raise damage_error(path, f"its header is damaged ({_first_words(error)}), so export it again") from error
    head = _nrrd_head(known, path)
    head = replace(head, notes=(_UNORIENTED,)) if turn is None else head
    if fields.get("elementnumberofchannels", "1") != "1" or fields.get("binarydata", "true").lower() == "false":
        raise damage_error(path, "its voxels have several values or are text; save one label per voxel, as binary data")
    name, start = end[1].decode("utf-8", "replace"), end.end()
    if name.upper() != "LOCAL":
        if not name or name.upper().startswith("LIST") or re.search(r"[/\\%\x00-\x1f]", name):
            raise damage_error(path, f"its data are not in one file in its folder ({name[:60]!r}); save it as .mha")
        if not (path.parent / name).is_file():
            raise damage_error(path, f"its data file {name[:60]!r} is not in its folder; copy it there or save as .mha")
        file = stack.enter_context(open_file(path.parent / name))
        size = os.fstat(file.fileno()).st_size
        start = size - head.bytes if skip < 0 else skip
    file.seek(max(start, 0))
    encoding = "zlib" if fields.get("compresseddata", "").lower() in _TRUE else "raw"
    return head, _voxel_stream(file, encoding, head, size - start, stack, path)


class _ZlibStream(io.RawIOBase):
    """The bytes that a zlib stream in a file unpacks to."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._unpacking = file, zlib.decompressobj()

    def readinto(self, buffer: Any) -> int:
        """Unpack as much as fits in the buffer, and return how many bytes there are, 0 at the end."""
        data = b""
        while not data and not self._unpacking.eof:
            packed = self._unpacking.unconsumed_tail or self._file.read(_PIECE)
            if not packed:
                raise EOFError
            data = self._unpacking.decompress(packed, len(buffer))
        buffer[: len(data)] = data
        return len(data)


def _nrrd_head(fields: dict[str, Any], path: Path) -> _VolumeHeader:
    kinds = {name: code for code, names in _NRRD_TYPES.items() for name in names}
    code = kinds.get(str(fields.get("type", "")).lower())
    if code is None:
        raise damage_error(
            path, f"its voxels are of the type '{fields.get('type')}', which is not a type of labels; export it again"
        )
    order = str(fields.get("endian", "little")).lower()
    if order not in ("little", "big"):
        raise damage_error(path, f"its header states endian '{order[:40]}', so export it again")
    try:
        shape = tuple(int(n) for n in fields["sizes"])
        if len(shape) != int(fields["dimension"]):
            raise ValueError("sizes and dimension disagree")
        affine, notes, axes = _nrrd_affine(fields, path)
        numbers = sorted(int(match[1]) for key in fields if (match := re.fullmatch(r"Segment(\d{1,9})_ID", key)))
        segments = tuple(_segment(fields, n) for n in numbers)
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        raise damage_error(path, f"its header is damaged ({_first_words(error)}), so export it again") from error
    kind = np.dtype(code).newbyteorder("<" if order == "little" else ">")
    return _VolumeHeader(shape, kind, 0, affine, notes=notes, axes=axes, segments=segments)


def _segment(fields: dict[str, Any], n: int) -> Segment:
    name, own = str(fields.get(f"Segment{n}_Name") or fields[f"Segment{n}_ID"]), str(fields[f"Segment{n}_ID"])
    # Before 3D Slicer 4.11, a file had one layer per segment and did not state labels.
    layer = int(fields.get(f"Segment{n}_Layer", n if len(fields["sizes"]) > 3 else 0))
    return Segment(name, int(fields.get(f"Segment{n}_LabelValue", 1)), layer, own)


def _nrrd_affine(fields: dict[str, Any], path: Path) -> tuple[FloatArray, tuple[str, ...], tuple[int, ...]]:
    """Return the affine transform (4, 4), notes for the user, and the indices of the spatial axes."""
    directions, space = fields.get("space directions"), str(fields.get("space", "")).lower()
    if directions is None:
        if fields.get("spacings") is None:
            raise InputError(f"{path}: its header does not state the voxel size; export it again with spacings.")
        spacings = np.asarray(fields["spacings"], dtype=np.float64)
        axes = tuple(map(int, np.flatnonzero(~np.isnan(spacings))))
        return _affine(np.diag(spacings[list(axes[:3])]), np.zeros(3)), (_UNORIENTED,), axes
    axis_vectors = [None if row is None else np.asarray(row, dtype=np.float64) for row in directions]
    rows = {axis: row for axis, row in enumerate(axis_vectors) if row is not None and not np.isnan(row).all()}
    if len(rows) != 3 or any(row.shape != (3,) for row in rows.values()):
        raise InputError(f"{path}: its space does not have three dimensions; save one volume of labels as LPS.")
    signs = _NRRD_SPACES.get(space)
    if signs is None and space not in ("", "3d-right-handed", "scanner-xyz"):
        raise InputError(f"{path}: its space is '{space[:60]}', which is not supported; save it as LPS or RAS.")
    units = {str(unit).strip('" ').lower() for unit in fields.get("space units") or ("mm",)}
    if len(units) != 1 or (unit := units.pop()) not in MM_OF_UNITS:
        raise InputError(f"{path}: its space units are not one of mm, cm, m and um; save it in mm.")
    origin = np.asarray(fields.get("space origin", np.zeros(3)), dtype=np.float64).reshape(3)
    turn = np.diag(np.array(signs or (1, 1, 1), dtype=np.float64))
    affine = _to_mm(_affine(turn @ np.array(list(rows.values())).T, turn @ origin), MM_OF_UNITS[unit])
    return affine, () if signs else (_UNORIENTED,), tuple(rows)


def _affine(steps: FloatArray, origin: FloatArray) -> FloatArray:
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = steps, origin
    return affine


def _to_mm(affine: FloatArray, mm: float) -> FloatArray:
    return _affine(affine[:3, :3] * mm, affine[:3, 3] * mm)


def _check_declared(head: _VolumeHeader, most_bytes: int, path: Path) -> None:
    """Check that a header declares label voxels, and not more bytes than its file can unpack to."""
    size = " x ".join(map(str, head.shape)) or "no"
    if head.kind.kind not in "iuf":
        raise InputError(f"{path} has voxels of colours or complex numbers, not of labels; save the label map alone.")
    if not head.shape or min(head.shape) < 1:
        raise damage_error(path, f"its header declares {size} voxels, so the volume is empty; export it again")
    if head.bytes > _MOST_BYTES:
        raise damage_error(
            path,
            f"its header declares {size} voxels, {head.bytes:,} bytes, over the limit of {_MOST_BYTES:,}; crop it, as "
            "in 3D Slicer",
        )
    if head.start + head.bytes > _MOST_BYTES + _MOST_HEADER or head.start + head.bytes > most_bytes:
        raise damage_error(path, f"its header declares {size} voxels, more than the file can contain; {CUT_SHORT}")


def _spatial_order(head: _VolumeHeader, path: Path) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the axes with the spatial ones first, and the shape (X, Y, Z) or (X, Y, Z, L) of the labels."""
    size = " x ".join(map(str, head.shape))
    if len(head.shape) < 3 or len(head.axes) != 3:
        raise InputError(f"{path} has {len(head.shape)} dimensions ({size}), which is not a volume; give a label map.")
    others = tuple(axis for axis in range(len(head.shape)) if axis not in head.axes)
    layers = tuple(head.shape[axis] for axis in others if head.shape[axis] > 1)
    if len(layers) > (1 if head.segments else 0):
        raise InputError(
            f"{path} has {len(head.shape)} dimensions ({size}), which is more than one volume; give a label map."
        )
    return (*head.axes, *others), (*(head.shape[axis] for axis in head.axes), *layers)


def _check_affine(affine: FloatArray, path: Path) -> FloatArray:
    steps = affine[:3, :3]
    wrong = ""
    if not np.isfinite(affine).all():
        wrong = "has numbers that are not finite"
    else:
        lengths = np.linalg.norm(steps, axis=0)
        lengths_text = " x ".join(f"{length:.3g}" for length in lengths)
        if not lengths.all() or abs(np.linalg.det(steps / lengths)) < _FLAT:
            wrong = "is singular, so that voxels have no volume"
        elif lengths.min() < _LEAST_MM or lengths.max() > _MOST_MM:
            wrong = f"gives voxels of {lengths_text} mm"
    if wrong:
        raise InputError(f"{path}: its affine {wrong}; export it again with voxel sizes and directions.")
    return affine


def _first_words(error: Exception) -> str:
    return " ".join(str(error).rstrip(".").split())[:80] or type(error).__name__
