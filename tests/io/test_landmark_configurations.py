"""Landmarks of many specimens: each format is read back exactly, conventions are applied, damage is one sentence."""

import base64
import bz2
import contextlib
import gzip
import lzma
import struct
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from refusals import refusal_of
from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.io.landmarks import configuration_io, r_arrays
from shapespace.io.landmarks.configuration_io import (
    CONFIGURATION_FORMATS,
    FOLDER_FORMATS,
    is_configurations,
    read_configurations,
    write_configurations,
)
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.tables.table_io import table_rows
from shapespace.types import FloatArray

refusal = partial(refusal_of, read_configurations)
NEWTS = base64.b64decode(
    "/Td6WFoAAAFpIt42AgAhARwAAAAQz1jM4AKzAPVdACkRB1RXIuRuUsqfktkkYTyzHMdu+351IdX0vSzDv3kB3YvezX4wGFfm6+cO"
    "7ixxYxPWwOwsgD8DY+SPgLIVRuCCvb+5cLtIADJUmAXBkoAYTQE8U+hNzTIE5ZD/qB4qw5K1BZNXKbP7QVeW1t1xVS3UFt115yrN"
    "edOmO8ctZb2X8ANEoEiu4o+GtrTXKl+S7qKYSEljnLgT5dk+FX4E9nJ6lpmcpG4e1XkLPmF5+msyfQGGDzHgaiAz2c0VHUkJjKlP"
    "ce29/lMLstS/E5ESIRp0nApS/E0FRwVIRQZnDymWyhqTQp2M7UQBhYNz88biO/bKLbeaAAAAAEpaySYAAY0CtAUAAJ2bYI8+MA2L"
    "AgAAAAABWVo="
)
"""An .rda by R 4.2: list(land (4 x 2 x 3, a landmark of c missing), species, n, curvepts), and a function."""
ENDINGS = {**CONFIGURATION_FORMATS, **dict.fromkeys(FOLDER_FORMATS, "")}


def configurations(dimensions: int = 3, *, missing: bool = False) -> LandmarkConfigurations:
    rng = np.random.default_rng(dimensions)
    points = 1e3 * rng.normal(size=(4, 5, dimensions))
    points[1, 2] = 1 / 3, -2e-17, *[5e300] * (dimensions - 2)
    if missing:
        points[2, 1] = points[3, 4] = np.nan
    return LandmarkConfigurations(
        names=("a1", "b.2", "Ü", "-d"), points=points, columns={"sex": ("f", "", "m", "f"), "age": ("1", "2", "", "4")}
    )


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, "utf-8")
    return path


@pytest.mark.parametrize("format", ENDINGS)
@pytest.mark.parametrize("dimensions", [2, 3])
def test_what_is_written_is_read_back_to_the_bit(format: str, dimensions: int, tmp_path: Path) -> None:
    lossy, missing = format in ("tps", "nts", *FOLDER_FORMATS), format not in ("morphoj", "fcsv")
    given, path = configurations(dimensions, missing=missing), tmp_path / f"set{ENDINGS[format]}"
    if format in FOLDER_FORMATS and dimensions == 2:
        with pytest.raises(InputError, match="cannot store 2-D"):
            write_configurations(path, given, format)
        return
    notes = write_configurations(path, given, format)
    assert any("omitted" in note for note in notes) == lossy
    assert is_configurations(path)
    back = read_configurations(path)
    order = [back.names.index(name) for name in given.names]
    np.testing.assert_array_equal(back.points[order], given.points)
    assert back.landmarks == given.landmarks
    classes = [table_rows(file.read_bytes()) for file in tmp_path.glob("*.classifiers.txt")]
    assert [row[1:] for rows in classes for row in rows] == (
        [["sex", "age"], ["f", "1"], ["", "2"], ["m", ""], ["f", "4"]] if format == "morphoj" else []
    )
    assert dict(back.columns) == ({} if lossy or format == "morphoj" else dict(given.columns))


@pytest.mark.parametrize("format", ["csv", "long", "mrk.json"])
def test_names_of_landmarks_are_kept_where_a_format_has_them(format: str, tmp_path: Path) -> None:
    named = replace(configurations(missing=True), landmarks=("nose", "lm1", "x.y", "eye 2", "5"))
    write_configurations(tmp_path / f"set{ENDINGS[format]}", named, format)
    assert read_configurations(tmp_path / f"set{ENDINGS[format]}").landmarks == named.landmarks


def test_tps_has_scale_curves_keys_and_missing_landmarks(tmp_path: Path) -> None:
    block = "lm=2\n1 2\n{}\nCURVES=1\nPOINTS=3\n0,5 0\n1 1\n2 3\nOUTLINES=1\nPOINTS=1\n9 9\n{}\n\n"
    text = block.format("3 4", "IMAGE=first.jpg\nID=anna\nSCALE=0,5") + block.format(
        "NA NA", "IMAGE = second.JPG\nCOMMENT=old\nSCALE=2"
    )
    found = read_configurations(write(tmp_path, "two.TPS", text))
    assert found.names == ("anna", "second")
    np.testing.assert_array_equal(found.points[0], [[0.5, 1], [1.5, 2], [0.25, 0], [0.5, 0.5], [1, 1.5]])
    np.testing.assert_array_equal(found.points[1], [[2, 4], [np.nan] * 2, [1, 0], [2, 2], [4, 6]])
    np.testing.assert_array_equal(found.curve_sliders, [[2, 3, 4]])
    assert dict(found.columns) == {"image": ("first.jpg", "second.JPG"), "comment": ("", "old")}
    assert len(found.notes) == 3


@pytest.mark.parametrize(
    ("lines", "note"),
    [(("", ""), "No specimen has SCALE="), (("\nSCALE=3", ""), "because 1 of 2 specimens have none (b)")],
)
def test_coordinates_are_scaled_only_if_all_specimens_have_a_scale(
    lines: tuple[str, str], note: str, tmp_path: Path
) -> None:
    found = read_configurations(write(tmp_path, "a.tps", "LM=1\n1 2\nID=a{}\nLM=1\n3 4\nID=b{}\n".format(*lines)))
    np.testing.assert_array_equal(found.points[:, 0], [[1, 2], [3, 4]])
    assert len(found.notes) == 1 and note in found.notes[0]


@pytest.mark.parametrize(
    ("code", "taken"), [("-999 -999", True), ("-1 -1", True), ("nan nan", False), ("NA", False), ("? ?", False)]
)
def test_codes_of_missing_landmarks_are_taken_as_missing_and_noted(code: str, taken: bool, tmp_path: Path) -> None:
    found = read_configurations(write(tmp_path, "a.tps", f"LM=3\n1 2\n{code}\n5 6\nID=a\nSCALE=1\n"))
    np.testing.assert_array_equal(found.observed, [[True, False, True]])
    assert any("interpreted as missing" in note for note in found.notes) == taken


def test_minus_one_is_a_coordinate_where_others_are_negative(tmp_path: Path) -> None:
    found = read_configurations(write(tmp_path, "a.tps", "LM=3\n-1 -1\n-999 4\n5 6\n"))
    assert found.observed.all()


def test_nts_has_labels_comments_and_a_missing_value(tmp_path: Path) -> None:
    text = "\"rats\n'a comment\n1 2L 4L 1 9 dim=2\nanna ben\nx1 y1 x2 y2\n1 2\n3 4\n5 6 9 9\n"
    found = read_configurations(write(tmp_path, "a.nts", text))
    assert found.names == ("anna", "ben")
    np.testing.assert_array_equal(found.points, [[[1, 2], [3, 4]], [[5, 6], [np.nan] * 2]])
    at_rows = read_configurations(write(tmp_path, "b.nts", "1 2B 4 0 DIM=2\nanna 1 2 3 4\nben 3 4 5 6\n"))
    assert at_rows.names == ("anna", "ben")
    single = read_configurations(write(tmp_path, "carl.nts", "1 3 2 0 DIM=2\n1 2\n3 4\n5 6\n"))
    assert single.names == ("carl",) and single.points.shape == (1, 3, 2)


@pytest.mark.parametrize(
    "header", ["x1,y1,x2,y2", "X1,Y1,X2,Y2", "1.X,1.Y,2.X,2.Y", "X1.X,X1.Y,X2.X,X2.Y", "x_1,y_1,x_2,y_2"]
)
def test_wide_tables_have_the_column_names_of_geomorph_morphoj_and_r(header: str, tmp_path: Path) -> None:
    text = f'"",sex,{header},pos_x\na,f,1,2,3,4,9\nb,,5,6,NA,,8\n'
    found = read_configurations(write(tmp_path, "a.csv", text))
    assert found.names == ("a", "b") and found.landmarks == ("1", "2")
    np.testing.assert_array_equal(found.points, [[[1, 2], [3, 4]], [[5, 6], [np.nan] * 2]])
    assert dict(found.columns) == {"sex": ("f", ""), "pos_x": ("9", "8")}


def test_wide_tables_may_have_named_landmarks_all_x_first_and_decimal_commas(tmp_path: Path) -> None:
    text = "Id;nose_x;lm2_x;nose_y;lm2_y;nose_z;lm2_z\na;1,5;2;3;4;5;6\n"
    found = read_configurations(write(tmp_path, "a.csv", text))
    assert found.landmarks == ("nose", "lm2")
    np.testing.assert_array_equal(found.points, [[[1.5, 3, 5], [2, 4, 6]]])


def test_long_tables_have_a_row_for_each_landmark(tmp_path: Path) -> None:
    text = "specimen,landmark,x,y,sex,note\na,nose,1,2,f,p\nb,nose,3,4,m,q\nb,chin,5,6,m,r\n"
    found = read_configurations(write(tmp_path, "a.csv", text))
    assert found.landmarks == ("nose", "chin") and dict(found.columns) == {"sex": ("f", "m")}
    np.testing.assert_array_equal(found.observed, [[True, False], [True, True]])
    assert [note[:20] for note in found.notes] == ["The column note is o", "1 landmark without a"]


def test_arrays_of_r_have_factors_and_sliders_beside(tmp_path: Path) -> None:
    (tmp_path / "newts.rda").write_bytes(NEWTS)
    found = read_configurations(tmp_path / "newts.rda")
    assert found.names == ("a", "b", "c") and dict(found.columns) == {"species": ("x", "", "y"), "n": ("1", "2", "3")}
    np.testing.assert_array_equal(found.points[1], [[1.5, 5.5], [2.5, 6.5], [3.5, 7.5], [4.5, 8.5]])
    np.testing.assert_array_equal(found.observed[2], [True, False, True, True])
    np.testing.assert_array_equal(found.curve_sliders, [[0, 1, 2]])
    assert read_configurations(tmp_path / "newts.rda", name="newts$land").names == found.names
    with pytest.raises(FileError, match=r"no array 'tails'; name one of newts\$land with --object"):
        read_configurations(tmp_path / "newts.rda", name="tails")


def r_doubles(values: FloatArray) -> bytes:
    """Return an array as R serialises it (XDR)."""
    name = struct.pack(">3i", 1, 0x00040009, 3) + b"dim"
    dim = struct.pack(f">ii{values.ndim}i", 13, values.ndim, *values.shape)
    body = struct.pack(">ii", 14 | 0x200, values.size) + values.astype(">f8").tobytes(order="F")
    return body + struct.pack(">i", 0x402) + name + dim + struct.pack(">i", 254)


def r_file(*objects: tuple[str, bytes]) -> bytes:
    entries = b"".join(
        struct.pack(">4i", 0x402, 1, 0x00040009, len(name)) + name.encode() + data for name, data in objects
    )
    return b"RDX2\nX\n" + struct.pack(">3i", 2, 0x00040202, 0x00020300) + entries + struct.pack(">i", 254)


def test_arrays_of_r_without_one_choice_are_refused_by_name(tmp_path: Path) -> None:
    points = np.random.default_rng(1).normal(size=(5, 3, 4))
    path = tmp_path / "a.RData"
    path.write_bytes(r_file(("A", r_doubles(points))))
    np.testing.assert_array_equal(read_configurations(path).points, np.moveaxis(points, 2, 0))
    path.write_bytes(gzip.compress(r_file(("A", r_doubles(points)), ("B", r_doubles(points)))))
    assert "several arrays; name one of A, B with --object" in refusal(path)
    assert len(read_configurations(path, name="B")) == 4
    path.write_bytes(r_file(("A", r_doubles(points[0]))))
    assert "no array of landmarks x 2 or 3 dimensions x specimens" in refusal(path)
    for damaged in (NEWTS[:150], b"LM=3\n1 2\n", r_file(("A", r_doubles(points)))[:200]):
        path.write_bytes(damaged)
        assert "not an R data file, or is damaged" in refusal(path)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress, lzma.compress])
def test_an_r_file_that_unpacks_to_too_much_is_refused(
    pack: Callable[[bytes], bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(r_arrays, "LARGEST_CONFIGURATIONS_FILE_BYTES", 2**20)
    (tmp_path / "a.rda").write_bytes(pack(b"RDX2\nX\n" + bytes(2**21)))
    assert "unpacks to more than 1 MiB" in refusal(tmp_path / "a.rda")


def test_r_files_need_their_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rdata", None)
    (tmp_path / "a.rds").write_bytes(NEWTS)
    with pytest.raises(ShapespaceError, match="rdata"):
        read_configurations(tmp_path / "a.rds")


def test_a_folder_has_a_file_for_each_specimen(tmp_path: Path) -> None:
    marks = {"nose": np.array([1.0, 2, 3]), "chin": np.array([4.0, 5, 6])}
    write_landmarks(tmp_path / "a.landmarks.fcsv", marks)
    write_landmarks(tmp_path / "b.landmarks.fcsv", dict(reversed(marks.items())))
    write_landmarks(tmp_path / "old.pp", marks)
    for name in ("curveslide.csv", "x.curveslide.csv", "surfslide.csv"):
        write(tmp_path, name, "surface\n1\n")
    found = read_configurations(tmp_path)
    assert found.names == ("a", "b") and found.landmarks == ("nose", "chin") and found.unit == "mm"
    np.testing.assert_array_equal(found.points[0], found.points[1])
    assert found.notes == ("Files without .fcsv are skipped: old.pp.",)
    write_landmarks(tmp_path / "c.fcsv", {"nose": marks["nose"]})
    with pytest.raises(
        FileError,
        match=r"c\.fcsv: it has 1 landmarks in 3-D and a\.landmarks\.fcsv has 2 landmarks in 3-D \(chin in only one",
    ):
        read_configurations(tmp_path)


def test_a_folder_of_tps_files_is_joined(tmp_path: Path) -> None:
    write(tmp_path, "a.tps", "LM=1\n1 2\nID=a\n")
    write(tmp_path, "b.tps", "LM=1\n3 4\nID=b\nCOMMENT=c\n")
    found = read_configurations(tmp_path)
    assert found.names == ("a", "b") and found.columns["comment"] == ("", "c")
    write(tmp_path, "c.tps", "LM3=1\n3 4 5\nID=c\n")
    with pytest.raises(FileError, match=r"c\.tps: it has 1 landmarks in 3-D and a\.tps has 1 landmarks in 2-D;"):
        read_configurations(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.tps", "", "it is empty"),
        ("a.tps", " \n", "it is empty"),
        ("a.tps", "hello world\n", "it is not a TPS file"),
        ("a.tps", "ID=3\n", "it is not a TPS file"),
        ("a.tps", "LM=1000000000\n1 2\n", "declares '1000000000' points, and 1 rows of coordinates follow"),
        ("a.tps", "LM=2\n1 2\n3 4\nID=a\nLM=2\n1 2\n", "specimen 2 declares '2' points, and 1 rows"),
        ("a.tps", "LM=1\n1 2\n3 4\n", "more rows of coordinates than it declares"),
        ("a.tps", "LM=x\n1 2\n", "declares 'x' points"),
        ("a.tps", "LM=0\nID=a\n", "it has no landmarks"),
        ("a.tps", "LM=1\n1 2\nID=a\nLM=2\n1 2\n3 4\nID=b\n", "specimen 'b' has 2 landmarks and 'a' has 1 landmarks"),
        ("a.tps", "LM=1\n1 2\nCURVES=1\nPOINTS=1\n1 2\nLM=1\n1 2\n", "has 1 landmarks, curves of [1] points"),
        ("a.tps", "LM=1\n1 2\nID=a\nLM3=1\n1 2 3\nID=b\n", "do not mix 2-D and 3-D"),
        ("a.tps", "LM=1\n1 inf\nID=a\n", "coordinate that is infinite"),
        ("a.tps", "LM=1\n1 a\nID=a\n", "coordinate that is not a number ('a')"),
        ("a.tps", "LM=1\n1 2\nID=a\nSCALE=0\n", "a SCALE= is not above 0"),
        ("a.tps", "LM=1\n1 2\nID=a\nSCALE=x\n", "specimen 'a' has a SCALE= that is not a number ('x')"),
        ("a.tps", "LM=1\n1\n", "landmarks need 2 or 3 coordinates"),
        ("a.nts", "1 2 4 0\n1 2 3 4 5 6 7 8\n", "no NTS header with its dimensions"),
        ("a.nts", "1 2 5 0 DIM=2\n1 2 3 4 5 6 7 8 9 0\n", "are not landmarks with DIM=2"),
        ("a.nts", "1 2 4 0 DIM=2\n1 2 3 4 5 6 7\n", "declares 2 rows of 4 numbers, and 7 numbers follow"),
        ("a.nts", "1 999999999 999999999 0 DIM=3\n1 2\n", "and 2 numbers follow"),
        ("a.csv", "name,a,b\nx,1,2\n", "its header has no landmark columns"),
        ("a.csv", "name,x1,y1,x2,y2\n", "no specimens"),
        ("a.csv", "name,x1,y1,x2,y2,x3\na,1,2,3,4,5\n", "landmark '3' has no column for its y"),
        ("a.csv", "name,x1,y1,z1,x2,y2\na,1,2,3,4,5\n", "do not mix 2-D and 3-D"),
        ("a.csv", "name,x1,y1,x2,y2\na,1,2,3,inf\n", "landmark 2 of 'a' has a coordinate that is infinite"),
        ("a.csv", "name,x1,y1,x2,y2\na,1,2,3,b\n", "landmark 2 of 'a' has a coordinate that is not a number"),
        ("a.csv", "name,x1,y1,x2,y2\na,1,2,3,4,5\n", "has 6 cells in row 1"),
        ("a.csv", "landmark,x,y\na,1,2\n", "its header names no specimen"),
        ("a.csv", "id,lm,x,y\na,1,1,2\na,1,3,4\n", "'a' has two rows of landmark '1'"),
        ("a.csv", "id,lm,x,y\na,p,1,2\nb,q,3,4\nc,r,3,4\n", "most specimens lack most landmarks"),
        ("a.xyz", "1 2 3\n", "the ending '.xyz' is not that of a landmark file"),
    ],
)
def test_what_is_damaged_is_refused_with_one_sentence(name: str, text: str, words: str, tmp_path: Path) -> None:
    assert words in refusal(write(tmp_path, name, text))


@pytest.mark.parametrize("text", ["LM=1\n1 2\nID=a\nLM=1\n1 2\nID=a\n"])
def test_two_specimens_of_one_name_are_refused(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.tps: two specimens are called 'a'; rename one"):
        read_configurations(write(tmp_path, "a.tps", text))
    with pytest.raises(InputError, match="a specimen has no name"):
        read_configurations(write(tmp_path, "a.csv", "name,x1,y1,x2,y2\n,1,2,3,4\n"))


def test_files_beyond_the_limit_and_absent_ones_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(FileError, match="it has no landmark files"):
        read_configurations(write(tmp_path, "labels.csv", "file,sex\na.ply,f\n").parent)
    monkeypatch.setattr(configuration_io, "LARGEST_CONFIGURATIONS_FILE_BYTES", 8)
    with pytest.raises(FileError, match="decimate or split it"):
        read_configurations(write(tmp_path, "a.tps", "LM=1\n1 2\nID=a\n"))
    with pytest.raises(FileError, match="no such file"):
        read_configurations(tmp_path / "b.tps")
    with pytest.raises(FileError, match="no landmark files"):
        (tmp_path / "empty").mkdir()
        read_configurations(tmp_path / "empty")


def test_formats_refuse_what_they_cannot_hold(tmp_path: Path) -> None:
    whole, missing = configurations(), configurations(missing=True)
    spaced = replace(whole, names=("a b", *whole.names[1:]))
    broken = replace(whole, names=("a\nb", *whole.names[1:]))
    tabbed = replace(whole, columns={"a": ("\t", "", "", "")})
    same = replace(whole, names=("a/b", "a:b", "c", "d"))
    for given, format, words in (
        (missing, "morphoj", "cannot read missing landmarks"), (tabbed, "morphoj", "tabs or line breaks"),
        (spaced, "nts", "cannot store the specimen name 'a b'"), (broken, "tps", "cannot store the specimen name"),
        (missing, "fcsv", "cannot store missing landmarks"),
        (same, "mrk.json", "the specimen name 'a/b' is not a valid file name"), (whole, "doc", "no format 'doc'"),
        (whole, None, "the ending '' has no format"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            write_configurations(tmp_path / "out", given, format)
    assert not list(tmp_path.iterdir())


def read_with_sliders(path: Path) -> LandmarkConfigurations:
    tps = write(path.parent, "a.tps", "LM=4\n1 2\n3 4\n5 6\n7 8\nID=a\n")
    return read_configurations(tps, sliders=[path])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("before,slide,after\n1,2,3\n2,3,1\n", [[0, 1, 2], [1, 2, 0]]),
        ('"","before","slide","after"\n"1",1,2,3\n', [[0, 1, 2]]),
        ("1;2;3\n", [[0, 1, 2]]),
        ("surface\n2\n4\n", [1, 3]),
    ],
)
def test_sliders_are_those_of_geomorph(text: str, expected: list[object], tmp_path: Path) -> None:
    found = read_with_sliders(write(tmp_path, "s.csv", text))
    given = found.surface_sliders if len(found.surface_sliders) else found.curve_sliders
    np.testing.assert_array_equal(given, expected)
    assert len(found.curve_sliders) + len(found.surface_sliders) == len(expected)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("before,slide,after\n1,2,5\n", "the row '1, 2, 5'; write before, slide, after"),
        ("before,slide,after\n0,2,3\n", "the row '0, 2, 3'"),
        ("before,slide,after\n1,2,2\n", "the row '1, 2, 2'"),
        ("before,slide,after\n1,2\n", "the row '1, 2, '"),
        ("before,slide,after\n", "no row"),
        ("a,b\n1,2\n", "the row '1, 2'; write before, slide, after"),
        ("surface\n1.5\n", "the row '1.5'"),
        ("surface\nx\n", "by number from 1 to 4, or by name"),
    ],
)
def test_sliders_that_are_none_are_refused(text: str, words: str, tmp_path: Path) -> None:
    assert words in refusal_of(read_with_sliders, write(tmp_path, "s.csv", text))


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.tps", "x", True), ("a.csv", "name,x1,y1,x2,y2\n", True), ("a.csv", "id,landmark,x,y\n", True),
        ("a.csv", "name,sex\n", False), ("a.csv", "name,x,y,z\n", False), ("a.txt", "1 2 3\n", False),
        ("a.txt", "ID\tx1\ty1\tx2\ty2\n", True), ("a.ply", "", False), ("a.csv", '"', False),
    ],
)  # fmt: skip
def test_landmark_files_are_recognised_by_ending_and_header(
    name: str, text: str, expected: bool, tmp_path: Path
) -> None:
    assert is_configurations(write(tmp_path, name, text)) is expected


def test_plethodon_is_read_back_from_every_format(geomorph_reference: dict[str, Any], tmp_path: Path) -> None:
    points = np.array(geomorph_reference["plethodon_raw"]).reshape(40, 12, 2)
    given = LandmarkConfigurations(names=tuple(f"p{k}" for k in range(40)), points=points)
    for format, ending in CONFIGURATION_FORMATS.items():
        write_configurations(tmp_path / f"p{ending}", given, format)
        np.testing.assert_array_equal(read_configurations(tmp_path / f"p{ending}").points, points)


@pytest.mark.parametrize("format", [*CONFIGURATION_FORMATS, "rda"])
def test_damaged_files_are_read_or_refused_without_a_traceback(format: str, tmp_path: Path) -> None:
    path = tmp_path / f"set{ENDINGS.get(format, '.rda')}"
    if format == "rda":
        path.write_bytes(r_file(("A", r_doubles(np.ones((5, 3, 4))))))
    else:
        write_configurations(path, configurations(missing=format != "morphoj"), format)
    whole, rng = path.read_bytes(), np.random.default_rng(4)
    for _ in range(60):
        data, at = bytearray(whole), int(rng.integers(len(whole)))
        data[at : at + int(rng.integers(3))] = bytes(
            rng.choice([b"\xff", b"=", b"\n", b"inf", b"9" * 10, b'"', b"\t,"])
        )
        path.write_bytes(data[: len(data) if rng.random() < 0.7 else at])
        with contextlib.suppress(ShapespaceError):
            read_configurations(path)
