"""What a file of ours costs to read is in proportion to its bytes, whatever it declares."""

import io
import json
import os
import struct
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.batch.fit_records import read_record
from shapespace.batch.result_folder import records_in
from shapespace.cohort.table import read_labels
from shapespace.errors import FileError, FileFormatError
from shapespace.io.containers.archives import kept_arrays, read_arrays
from shapespace.io.containers.json_files import plain_json, read_json
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise.classifier_file import load_classifier
from shapespace.recognise.labelled_scans import read_coefficients
from shapespace.report.inputs.saved_fits import Folder, find_fits

AGAIN = "make it again"
READERS: list[Callable[[Path], object]] = [
    read_record, read_coefficients, load_classifier, lambda path: read_arrays(path, AGAIN),
    lambda path: read_json(path, AGAIN), ShapeModel.load,
]  # fmt: skip


def peak_mib(read: Callable[[], object]) -> float:
    """Return the most memory that `read`, which is refused or not, takes."""
    tracemalloc.start()
    try:
        read()
    except FileFormatError as error:
        assert str(error).endswith(".") and "\n" not in str(error)
    finally:
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return most / 2**20


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
@pytest.mark.parametrize("reader", READERS)
def test_no_reader_waits_at_a_pipe(reader: Callable[[Path], object], tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.fit.json")
    with pytest.raises(FileFormatError, match="is a pipe or a device"):
        reader(tmp_path / "pipe.fit.json")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_a_folder_with_a_pipe_for_a_record_is_read_and_the_pipe_told(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.fit.json")
    assert list(records_in(tmp_path)) == []
    (fit,) = find_fits(Folder(tmp_path))
    assert fit.status == "unreadable" and "is a pipe or a device" in fit.reason


@pytest.mark.parametrize("reader", READERS)
def test_files_far_too_large_are_refused_unread(reader: Callable[[Path], object], tmp_path: Path) -> None:
    with (tmp_path / "x.json").open("wb") as stream:
        stream.truncate(2**40)  # sparse: it takes no room on the disk
    with pytest.raises(FileFormatError, match="larger"):
        reader(tmp_path / "x.json")
    for wrong in (tmp_path / "none", tmp_path):
        with pytest.raises(FileError, match=r"no such file|it is a folder"):
            reader(wrong)


def npy(shape: tuple[Any, ...], data: bytes = b"", kind: str = "<f8") -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": kind, "fortran_order": False, "shape": shape})
    return stream.getvalue() + data


def archive(path: Path, members: dict[str, bytes], how: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", how) as out:
        for name, data in members.items():
            out.writestr(name, data)
    return path


def test_archives_that_unpack_to_far_more_than_their_size_are_refused(tmp_path: Path) -> None:
    zeros = npy((2**21,), bytes(2**24))
    for how in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        path = archive(tmp_path / "x.npz", {"a.npy": zeros}, how)
        assert path.stat().st_size < 2**15
        assert peak_mib(lambda path=path: read_arrays(path, AGAIN)) < 2
    for shape, kind in (((10**12, 3), "<f8"), ((-1,), "<f8"), ((10**9,), "<U0"), ((2**40,), "|O"), ((1,) * 90, "<f8")):
        path = archive(tmp_path / "x.npz", {"a.npy": npy(shape, bytes(8), kind)})
        with pytest.raises(FileFormatError):
            read_arrays(path, AGAIN)
    for shape in ((True,), (False,), (2**40, 0), (0, 10**30), (-1, -1), (1.0,), (None,)):
        for data in (b"", bytes(8)):
            path = archive(tmp_path / "x.npz", {"a.npy": npy(shape, data)})
            with pytest.raises(FileFormatError):
                read_arrays(path, AGAIN)
            assert kept_arrays(path) is None
    path = archive(tmp_path / "x.npz", {"a.npy": b"\x93NUMPY\x01\x00" + struct.pack("<H", 9000) + b"(" * 9000})
    with pytest.raises(FileFormatError, match="is not an array"):
        read_arrays(path, AGAIN)


def test_one_part_of_an_archive_under_many_names_is_refused(tmp_path: Path) -> None:
    data = npy((2**17,), np.random.default_rng(0).bytes(2**20))
    path = archive(tmp_path / "x.npz", {"a00.npy": data})
    content = path.read_bytes()
    start, end = content.index(b"PK\1\2"), content.index(b"PK\5\6")
    entry, count = content[start:end], 200
    entries = b"".join(entry.replace(b"a00.npy", f"{k:03}.npy".encode()) for k in range(count))
    closing = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, count, count, len(entries), start, 0)
    path.write_bytes(content[:start] + entries + closing)
    assert peak_mib(lambda: read_arrays(path, AGAIN)) < 5


def test_arrays_come_back_as_numpy_reads_them(tmp_path: Path) -> None:
    arrays = {
        "a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.arange(6).reshape(2, 3)), "c": np.array(2),
        "d": np.zeros((0, 3), np.float32), "e": np.array(["näse", ""]), "f": np.array([True, False]),
    }  # fmt: skip
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    for name, array in read_arrays(tmp_path / "x.npz", AGAIN).items():
        assert array.dtype == arrays[name].dtype and np.array_equal(array, arrays[name]) and array.flags.writeable


@pytest.mark.parametrize("text", [b"[[],[],[0,0],", b'{"a":{},"b":[],"c":[', b"[1.5,0,1,0,", b'["","",'])
def test_json_takes_memory_in_proportion_to_its_bytes(text: bytes) -> None:
    def read(size: int) -> None:
        inner = text[1:] * (size // len(text))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                plain_json(text[:1] + inner + b"0]")
            except ValueError:
                return

    once, twice = peak_mib(lambda: read(2**16)), peak_mib(lambda: read(2**17))
    assert twice < 2.5 * once and twice < 7  # 56 times the bytes of the text


def test_numbers_that_are_not_finite_are_none_and_ones_too_large_are_refused() -> None:
    assert plain_json('{"a": [NaN, -Infinity, 1e400, 1.5], "b": {"c": Infinity}}') == {
        "a": [None, None, None, 1.5],
        "b": {"c": None},
    }
    assert plain_json(json.dumps([2**63 - 1, -(2**63), True])) == [2**63 - 1, -(2**63), True]
    for wrong in (f"[{2**63}]", "1" + "0" * 400, "1" + "0" * 5000, "[" * 70 + "]" * 70, "[" * 10**5, b"\xff", "", "[1"):
        with pytest.raises(ValueError, match=r"\w"):
            plain_json(wrong)


def test_a_table_of_many_columns_and_many_short_rows_is_refused_before_it_is_filled(tmp_path: Path) -> None:
    heads = ",".join(["scan", "status", "reason", "model_hash", *(f"z{k}" for k in range(1, 10_000))])
    (tmp_path / "c.csv").write_text(heads + "\n" + "a\n" * 20_000)
    assert peak_mib(lambda: read_coefficients(tmp_path / "c.csv")) < 5
    (tmp_path / "l.csv").write_text("file,label," + heads + "\n" + "a\n" * 20_000)
    assert peak_mib(lambda: read_labels(tmp_path / "l.csv")) < 15
