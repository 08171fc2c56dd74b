"""Volumes are read as labels in RAS millimetres, and what is no sound volume is refused in one sentence."""

import bz2
import gzip
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shapespace.errors import FileError, FileFormatError, InputError, ShapespaceError
from shapespace.io.volume_io import read_volume, volume_name
from shapespace.types import LabelVolume

nib = pytest.importorskip("nibabel", reason="the extra `volumes` is not installed")
nrrd = pytest.importorskip("nrrd", reason="the extra `volumes` is not installed")

LABELS = np.random.default_rng(0).integers(0, 4, (5, 6, 7))
TILTED = np.array([[0.0, -0.9, 0.1, 10], [1.1, 0.0, 0, -20], [0.0, 0.1, 2.5, 30], [0, 0, 0, 1]])


def write_nifti(path: Path, labels: Any = LABELS, affine: Any = TILTED, *, kind: Any = np.uint8, two: bool = False,
                change: Callable[[Any], None] = lambda header: None) -> Path:  # fmt: skip
    image = (nib.Nifti2Image if two else nib.Nifti1Image)(np.asarray(labels, dtype=kind), affine)
    change(image.header)
    nib.save(image, path)
    return path


def write_nrrd(path: Path, labels: Any = LABELS, **header: Any) -> Path:
    fields = {"space": "left-posterior-superior", "space directions": np.eye(3), "space origin": np.zeros(3)}
    fields = {key: value for key, value in {**fields, **header}.items() if value is not None}
    nrrd.write(str(path), np.asarray(labels).astype(np.uint8), fields, index_order="F")
    return path


META = (
    b"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = False\nElementSpacing = 1 2 3\n"
    b"DimSize = 5 6 7\nElementType = MET_UCHAR\nElementDataFile = LOCAL\n"
)


def write_meta(path: Path, labels: Any = LABELS, *, lps: Any = TILTED, kind: Any = np.uint8, packed: bool = False,
               data_file: str = "LOCAL", head: str = "") -> Path:  # fmt: skip
    """Write MetaImage as ITK does: TransformMatrix has the direction of each axis in a row, in LPS."""
    names = {"u1": "UCHAR", "i2": "SHORT", "u4": "UINT", "i8": "LONG_LONG", "f4": "FLOAT"}
    kind = np.dtype(kind)
    steps = np.linalg.norm(lps[:3, :3], axis=0)
    rows, voxels = (lps[:3, :3] / steps).T, np.asarray(labels).astype(kind).tobytes(order="F")
    voxels = zlib.compress(voxels) if packed else voxels
    text = (
        f"ObjectType = Image\nNDims = 3\nBinaryData = True\nBinaryDataByteOrderMSB = {kind.byteorder == '>'}\n"
        f"CompressedData = {packed}\nTransformMatrix = {' '.join(map(repr, rows.ravel().tolist()))}\n"
        f"Offset = {' '.join(map(repr, lps[:3, 3].tolist()))}\nCenterOfRotation = 0 0 0\n"
        f"AnatomicalOrientation = RAI\nElementSpacing = {' '.join(map(repr, steps.tolist()))}\n"
        f"DimSize = {' '.join(map(str, np.shape(labels)))}\n{head}ElementType = MET_{names[kind.str[1:]]}\n"
        f"ElementDataFile = {data_file}\n"
    )
    if data_file != "LOCAL":
        (path.parent / data_file).write_bytes(voxels)
    path.write_bytes(text.encode() + voxels * (data_file == "LOCAL"))
    return path


def patched(path: Path, at: int, content: bytes) -> Path:
    data = path.read_bytes()
    path.write_bytes(data[:at] + content + data[at + len(content) :])
    return path


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "A.NII.GZ"])
@pytest.mark.parametrize("two", [False, True])
@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.int32, np.float32, np.float64, np.uint16, ">i2"])
def test_nifti_labels_and_affine_are_those_written(name: str, two: bool, kind: Any, tmp_path: Path) -> None:
    volume = read_volume(write_nifti(tmp_path / name, kind=kind, two=two))
    assert (volume.labels == LABELS).all() and volume.labels.dtype.kind in "iu"
    assert np.allclose(volume.affine, TILTED, atol=1e-6)
    assert volume.notes == () and not volume.labels.flags.writeable


@pytest.mark.parametrize("encoding", ["raw", "gzip", "bzip2"])
@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.uint32, np.int64, np.float64])
def test_nrrd_labels_are_those_written(encoding: str, kind: Any, tmp_path: Path) -> None:
    fields = {"space": "RAS", "space directions": TILTED[:3, :3].T, "space origin": TILTED[:3, 3]}
    nrrd.write(str(tmp_path / "a.nrrd"), LABELS.astype(kind), {**fields, "encoding": encoding}, index_order="F")
    volume = read_volume(tmp_path / "a.nrrd")
    assert (volume.labels == LABELS).all()
    assert np.allclose(volume.affine, TILTED)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("kind", ["u1", "<i2", ">i2", ">u4", "<i8", "<f4"])
@pytest.mark.parametrize("name", ["a.mha", "A.MHD"])
def test_metaimage_labels_and_frame_are_those_of_itk(name: str, kind: str, packed: bool, tmp_path: Path) -> None:
    data_file = "LOCAL" if name == "a.mha" else "a b.zraw"
    volume = read_volume(write_meta(tmp_path / name, kind=kind, packed=packed, data_file=data_file))
    assert (volume.labels == LABELS).all() and volume.notes == ()
    assert np.allclose(volume.affine, np.diag([-1.0, -1, 1, 1]) @ TILTED)


def test_a_data_file_of_metaimage_may_have_a_header_of_its_own(tmp_path: Path) -> None:
    for skip in (-1, 40):
        path = write_meta(tmp_path / "a.mhd", data_file="a.raw", head=f"HeaderSize = {skip}\n")
        _put(tmp_path / "a.raw", b"h" * 40 + (tmp_path / "a.raw").read_bytes())
        assert (read_volume(path).labels == LABELS).all()


def test_metaimage_without_a_matrix_lies_along_the_axes_with_a_note(tmp_path: Path) -> None:
    volume = read_volume(_put(tmp_path / "a.mha", META + LABELS.astype(np.uint8).tobytes(order="F")))
    assert (volume.labels == LABELS).all() and np.allclose(volume.affine, np.diag([-1.0, -2, 3, 1]))
    assert len(volume.notes) == 1 and "left and right may be swapped" in volume.notes[0]


@pytest.mark.parametrize(
    ("space", "signs"),
    [("left-posterior-superior", (-1, -1, 1)), ("LPS", (-1, -1, 1)), ("left-anterior-superior", (-1, 1, 1)),
     ("RAS", (1, 1, 1))],
)  # fmt: skip
def test_nrrd_of_any_patient_space_is_turned_to_ras(space: str, signs: tuple[int, ...], tmp_path: Path) -> None:
    directions, origin = TILTED[:3, :3].T, np.array([1.0, 2, 3])
    path = write_nrrd(tmp_path / "a.nrrd", space=space, **{"space directions": directions, "space origin": origin})
    volume = read_volume(path)
    assert np.allclose(volume.affine[:3, :3], np.diag(signs) @ TILTED[:3, :3])
    assert np.allclose(volume.affine[:3, 3], np.array(signs) * origin)


def test_both_formats_put_one_volume_in_one_place(tmp_path: Path) -> None:
    lps = np.diag([-1.0, -1, 1, 1]) @ TILTED
    path = write_nrrd(tmp_path / "a.nrrd", **{"space directions": lps[:3, :3].T, "space origin": lps[:3, 3]})
    assert np.allclose(read_volume(path).affine, read_volume(write_nifti(tmp_path / "a.nii")).affine, atol=1e-6)


def test_units_other_than_millimetres_are_turned_to_them(tmp_path: Path) -> None:
    metres = write_nifti(
        tmp_path / "m.nii", affine=np.diag([1e-3, 1e-3, 2e-3, 1]), change=lambda h: h.set_xyzt_units(1)
    )
    assert np.allclose(read_volume(metres).voxel_mm, (1, 1, 2))
    cm = write_nrrd(tmp_path / "cm.nrrd", **{"space units": ["cm", "cm", "cm"]})
    assert np.allclose(read_volume(cm).voxel_mm, 10)


def test_the_qform_counts_where_there_is_no_sform(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / "a.nii", affine=None, change=lambda h: h.set_qform(np.diag([2.0, 2, 3, 1]), 1))
    volume = read_volume(path)
    assert np.allclose(volume.affine, np.diag([2, 2, 3, 1])) and volume.notes == ()


def test_that_a_header_says_nothing_of_the_patient_is_noted(tmp_path: Path) -> None:
    def neither(header: Any) -> None:
        header.set_qform(None, 0)
        header.set_sform(None, 0)

    nifti = write_nifti(tmp_path / "a.nii", affine=None, change=neither)
    for path in (nifti, write_nrrd(tmp_path / "a.nrrd", space=None, **{"space dimension": 3})):
        (note,) = read_volume(path).notes
        assert "left and right may be swapped" in note
    spacings = write_nrrd(tmp_path / "b.nrrd", **dict.fromkeys(("space", "space directions", "space origin")),
                          spacings=[1, 2, 3])  # fmt: skip
    assert np.allclose(read_volume(spacings).voxel_mm, (1, 2, 3)) and read_volume(spacings).notes


def test_two_places_in_one_header_are_noted(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / "a.nii", change=lambda h: h.set_qform(np.diag([1, 1, 1, 1.0]), 1))
    assert "sform and qform disagree" in read_volume(path).notes[0]
    assert np.allclose(read_volume(path).affine, TILTED)


def test_scaled_labels_are_what_the_header_makes_of_them(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / "a.nii")
    data = bytearray(path.read_bytes())
    data[112:120] = struct.pack("<2f", 2.0, 1.0)
    path.write_bytes(data)
    assert (read_volume(path).labels == 2 * LABELS + 1).all()


def test_axes_of_length_one_beyond_space_do_no_harm(tmp_path: Path) -> None:
    assert read_volume(write_nifti(tmp_path / "a.nii", LABELS[..., None])).labels.shape == LABELS.shape
    directions = np.vstack([np.full(3, np.nan), np.eye(3)])
    path = write_nrrd(tmp_path / "a.nrrd", LABELS[None], **{"space directions": directions})
    assert (read_volume(path).labels == LABELS).all()


def _affine_of(value: float, at: tuple[int, int]) -> Any:
    affine = np.eye(4)
    affine[at] = value
    return affine


def _placed(path: Path, affine: Any) -> Path:
    """Return the file with the first rows of `affine` as its sform, whatever they are."""
    return patched(write_nifti(path), 280, np.asarray(affine, dtype="<f4")[:3].tobytes())


FLAT = np.array([[1, 1, 0, 0], [1, 1 + 1e-6, 0, 0], [0, 0, 1, 0]])
BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no file": (lambda d: d / "a.nii.gz", "no such file"),
    "empty file": (lambda d: _put(d / "a.nii", b""), "it is empty"),
    "text": (lambda d: _put(d / "a.nii", b"Dear reader, this is no volume." * 20), "not that of a NIfTI"),
    "text as nrrd": (lambda d: _put(d / "a.nrrd", b"Dear reader, this is no volume." * 20), "not that of a NRRD"),
    "other ending": (lambda d: _put(d / "a.mnc", b"x"), ".nii.gz"),
    "text as mha": (lambda d: _put(d / "a.mha", b"Dear reader, this is no volume." * 20), "not that of a MetaImage"),
    "cut short, mha": (lambda d: _cut(write_meta(d / "a.mha")), "than the file can contain"),
    "cut short, mha zlib": (lambda d: _put(d / "a.mha", write_meta(d / "a.mha", packed=True).read_bytes()[:-20]),
                            "cut short"),
    "checksum, mha zlib": (lambda d: _flip(write_meta(d / "a.mha", packed=True), -1), "or are wrong"),
    "mhd elsewhere": (lambda d: _put(d / "a.mhd", META.replace(b"LOCAL", b"../a.raw")), "in one file in its folder"),
    "mhd in slices": (lambda d: _put(d / "a.mhd", META.replace(b"LOCAL", b"LIST")), "not in one file in its folder"),
    "mhd with a zero": (lambda d: _put(d / "a.mhd", META.replace(b"LOCAL", b"a\0.raw")), "in one file in its folder"),
    "mhd alone": (lambda d: _put(d / "a.mhd", META.replace(b"LOCAL", b"b.raw")), "'b.raw' is not in its folder"),
    "mhd without data": (lambda d: _put(d / "a.mhd", META.replace(b"LOCAL", b"a.mhd")), "than the file can contain"),
    "mha of vectors": (lambda d: _put(d / "a.mha", b"ElementNumberOfChannels = 3\n" + META), "several values"),
    "mha without spacing": (lambda d: _put(d / "a.mha", META.replace(b"Spacing", b"Space")), "state the voxel size"),
    "mha of words": (lambda d: _put(d / "a.mha", META.replace(b"5 6 7", b"five")), "is damaged"),
    "mha of no size": (lambda d: _put(d / "a.mha", META.replace(b"5 6 7", b"0 6 7")), "the volume is empty"),
    "mha of slices": (lambda d: _put(d / "a.mha", META.replace(b"5 6 7", b"5 6").replace(b"NDims = 3", b"NDims = 2")
                                     .replace(b"1 2 3", b"1 2")), "three dimensions"),
    "huge mha": (lambda d: _put(d / "a.mha", META.replace(b"5 6 7", b"9999 9999 9999")), "over the limit"),
    "cut short": (lambda d: _cut(write_nifti(d / "a.nii")), "than the file can contain"),
    "cut short, gz": (lambda d: _cut(write_nifti(d / "a.nii.gz", np.arange(8000).reshape(20, 20, 20) % 251)),
                      "end early"),
    "cut in the header": (lambda d: _put(d / "a.nii", write_nifti(d / "b.nii").read_bytes()[:200]), "of a NIfTI"),
    "cut short, nrrd": (lambda d: _cut(write_nrrd(d / "a.nrrd", encoding="raw")), "than the file can contain"),
    "cut short, nrrd gz": (lambda d: _cut(write_nrrd(d / "a.nrrd")), "cut short"),
    "nrrd header alone": (lambda d: _put(d / "a.nrrd", b"NRRD0004\ntype: uchar\n"), "no end"),
    "checksum": (lambda d: _flip(write_nifti(d / "a.nii.gz"), -6), "or are wrong"),
    "header and data apart": (lambda d: patched(write_nifti(d / "a.nii"), 344, b"ni1\0"), "two files"),
    "ending of a header": (lambda d: _put(d / "a.nhdr", b"NRRD0004\n\n"), "two files"),
    "data in another file": (
        lambda d: _put(d / "a.nrrd", b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n"
                       b"spacings: 1 1 1\ndata file: /etc/hostname\n\n"), "in another file"),
    "ascii nrrd": (lambda d: write_nrrd(d / "a.nrrd", encoding="ascii"), "only raw, gzip and bzip2"),
    "unknown space": (lambda d: write_nrrd(d / "a.nrrd", space="scanner-xyz-time", **{"space directions": np.eye(3)}),
                      "not supported"),
    "unknown unit": (lambda d: write_nrrd(d / "a.nrrd", **{"space units": ["ell", "ell", "ell"]}), "space units"),
    "four dimensions": (lambda d: write_nifti(d / "a.nii", np.stack([LABELS] * 2, -1)), "more than one volume"),
    "two dimensions": (lambda d: write_nifti(d / "a.nii", LABELS[0]), "not a volume"),
    "probabilities": (lambda d: write_nifti(d / "a.nii", LABELS / 3, kind=np.float32), "not integers"),
    "not finite": (lambda d: write_nifti(d / "a.nii", np.where(LABELS, np.nan, 0), kind=np.float32), "not finite"),
    "complex": (lambda d: write_nifti(d / "a.nii", kind=np.complex64), "colours or complex"),
    "zero affine": (lambda d: _placed(d / "a.nii", np.zeros((4, 4))), "singular"),
    "singular affine": (lambda d: _placed(d / "a.nii", np.diag([1.0, 1, 0, 1])), "singular"),
    "flat affine": (lambda d: _placed(d / "a.nii", FLAT), "singular"),
    "NaN affine": (lambda d: _placed(d / "a.nii", _affine_of(np.nan, (1, 3))), "not finite"),
    "infinite affine": (lambda d: _placed(d / "a.nii", _affine_of(np.inf, (0, 0))), "not finite"),
    "absurd voxels": (lambda d: _placed(d / "a.nii", np.diag([1e9, 1e9, 1e9, 1])), "voxels of 1e+09"),
    "huge, gz": (lambda d: _put(d / "a.nii.gz", gzip.compress(_huge(30000))), "over the limit"),
    "huge": (lambda d: _put(d / "a.nii", _huge(30000)), "over the limit"),
    "more than it can hold": (lambda d: _put(d / "a.nii.gz", gzip.compress(_huge(1200))), "can contain"),
    "negative size": (lambda d: patched(write_nifti(d / "a.nii"), 42, struct.pack("<h", -5)), "the volume is empty"),
    "unknown type": (lambda d: patched(write_nifti(d / "a.nii"), 70, struct.pack("<h", 777)), "damaged"),
    "NaN offset": (lambda d: patched(write_nifti(d / "a.nii"), 108, struct.pack("<f", np.nan)), "damaged"),
    "huge offset": (lambda d: patched(write_nifti(d / "a.nii"), 108, struct.pack("<f", 1e18)), "can contain"),
    "offset in the header": (lambda d: patched(write_nifti(d / "a.nii"), 108, struct.pack("<f", 8)), "within the"),
    "huge nrrd": (lambda d: _put(d / "a.nrrd", _nrrd_text(99999, b"gzip")), "over the limit"),
    "bzip2 bomb": (lambda d: _put(d / "a.nrrd", _nrrd_text(1280, b"bzip2") + bz2.compress(bytes(100_000))), "contain;"),
    "nrrd of no size": (lambda d: _put(d / "a.nrrd", _nrrd_text(0, b"raw")), "the volume is empty"),
    "nrrd of a size beyond all": (lambda d: _put(d / "a.nrrd", _nrrd_text(10**30, b"raw")), "cannot"),
}  # fmt: skip
"""What is no sound volume: how it is made, and a part of what is said."""


def _put(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def _cut(path: Path) -> Path:
    return _put(path, path.read_bytes()[: -max(40, path.stat().st_size // 4)])


def _flip(path: Path, at: int) -> Path:
    data = bytearray(path.read_bytes())
    data[at] ^= 0xFF
    return _put(path, bytes(data))


def _huge(side: int) -> bytes:
    header = nib.Nifti1Header()
    header.set_data_shape((side, side, side))
    header.set_data_dtype(np.uint8)
    header["magic"], header["vox_offset"] = b"n+1", 352
    return header.binaryblock + b"\0" * 4


def _nrrd_text(side: int, encoding: bytes) -> bytes:
    return b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: %d %d %d\nencoding: %s\nspacings: 1 1 1\n\n" % (
        side, side, side, encoding)  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_sound_volume_is_refused_in_one_sentence(kind: str, tmp_path: Path) -> None:
    make, part = BAD[kind]
    path = make(tmp_path)
    with pytest.raises((FileError, InputError)) as caught:
        read_volume(path)
    sentence = str(caught.value)
    assert str(path) in sentence and sentence.endswith(".") and "\n" not in sentence
    assert part.lower() in sentence.lower()
    assert ";" in sentence or ", so " in sentence, f"no advice: {sentence}"


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, zlib.compress])
def test_what_grows_beyond_its_header_takes_no_more_memory_than_declared(pack: Any, tmp_path: Path) -> None:
    encoding = b"gzip" if pack is gzip.compress else b"bzip2"
    path = _put(tmp_path / "a.nrrd", _nrrd_text(20, encoding) + pack(bytes(200_000_000)))
    if pack is zlib.compress:
        head = b"CompressedData = True\n" + META.replace(b"5 6 7", b"20 20 20")
        path = _put(tmp_path / "a.mha", head + pack(bytes(200_000_000)))
    tracemalloc.start()
    try:
        assert read_volume(path).labels.shape == (20, 20, 20)
        assert tracemalloc.get_traced_memory()[1] < 5_000_000
    finally:
        tracemalloc.stop()


def _refused(read: Callable[[], object], most_bytes: int) -> str:
    """Return the sentence with which `read` refuses, in as little memory as that."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read()
        assert tracemalloc.get_traced_memory()[1] < most_bytes
    finally:
        tracemalloc.stop()
    return str(caught.value)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.nrrd"])
@pytest.mark.parametrize("kind", [np.uint8, np.float64])
def test_a_volume_over_the_limit_of_memory_is_refused_before_it_is_taken(name: str, kind: Any, tmp_path: Path) -> None:
    labels = np.zeros((300, 300, 200))
    labels[2:9, 2:9, 2:9] = 1
    path = tmp_path / name
    if name.endswith(".nrrd"):
        write_nrrd(path, labels, encoding="bzip2")
    else:
        write_nifti(path, labels, kind=kind)
    sentence = _refused(lambda: read_volume(path, max_memory_bytes=50_000_000), 4_000_000)
    assert str(path) in sentence and "300 x 300 x 200 voxels" in sentence and "--max-memory" in sentence


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.float64])
@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_reading_takes_the_memory_of_the_labels_alone(name: str, kind: Any, tmp_path: Path) -> None:
    labels = np.zeros((100, 100, 200), dtype=np.int16)
    labels[2:90, 2:90, 2:90] = 300 if kind != np.uint8 else 3
    path = write_nifti(tmp_path / name, labels, kind=kind)
    tracemalloc.start()
    try:
        read = read_volume(path)
        assert tracemalloc.get_traced_memory()[1] < read.labels.nbytes + 12_000_000
    finally:
        tracemalloc.stop()
    assert (read.labels == labels).all()


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(name=st.sampled_from(["a.nii", "a.nii.gz", "a.nrrd", "a.mha", "z.mha"]), data=st.data())
def test_damage_ends_in_a_volume_or_in_a_sentence(name: str, data: st.DataObject, tmp_path: Path) -> None:
    path = tmp_path / name
    if name.endswith(".mha"):
        write_meta(path, packed=name == "z.mha")
    else:
        write_nrrd(path) if name.endswith(".nrrd") else write_nifti(path)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))] if data.draw(st.booleans()) else content)
    try:
        volume = read_volume(path)
    except ShapespaceError as error:
        assert str(path) in str(error)
    else:
        assert np.isfinite(volume.affine).all()


def test_the_sentence_says_how_to_get_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.io.volume_io.find_spec", lambda name: None)
    with pytest.raises(ShapespaceError, match=r"pip install 'shapespace\[volumes\]'"):
        read_volume(write_nifti(tmp_path / "a.nii"))


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a.nii", "a"),
        ("a.NII.gz", "a"),
        ("a.b.nrrd", "a.b"),
        ("a.seg.nrrd", "a"),
        ("a.mhd", "a"),
        ("nii", "nii"),
        (".nii", ".nii"),
    ],
)
def test_a_name_is_that_of_the_file_without_its_ending(file: str, name: str) -> None:
    assert volume_name(Path(file)) == name


@pytest.mark.parametrize("affine", [np.zeros((4, 4)), np.eye(3), np.full((4, 4), np.nan)])
def test_a_volume_needs_an_affine_that_can_be_inverted(affine: Any) -> None:
    with pytest.raises(InputError, match="affine"):
        LabelVolume(LABELS, affine)


@pytest.mark.parametrize("labels", [LABELS / 2, LABELS[0], LABELS[:0]])
def test_a_volume_needs_labels_in_three_dimensions(labels: Any) -> None:
    with pytest.raises(InputError, match="labels must be"):
        LabelVolume(labels, np.eye(4))


def test_a_wrong_format_is_an_error_of_format(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError):
        read_volume(_put(tmp_path / "a.nii", b"x" * 400))
