"""Tables of what is known of shapes: numbers, classes, missing cells, and what is refused by name."""

from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np
import pytest

from shapespace.cohort.table import (
    Table,
    list_names,
    match_rows,
    names_of_file,
    notes_on_classes,
    numbers_as_text,
    read_table,
)
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.files import write_text

LINES = "file,sex,age\nscans/a.ply,f,20\nb.ply,m,\nc.stl,NA,41.5\n"


def written(folder: Path, text: str = LINES) -> Path:
    write_text(folder / "data.csv", text)
    return folder / "data.csv"


def test_rows_are_called_by_their_files_and_cells_that_say_nothing_are_empty(tmp_path: Path) -> None:
    table = read_table(written(tmp_path))
    assert table.rows == ("scans/a.ply", "b.ply", "c.stl") and list(table.columns) == ["sex", "age"]
    assert table.texts("sex") == ("f", "m", "") and table.texts("age") == ("20", "", "41.5")
    assert np.array_equal(table.numbers("age"), [20, np.nan, 41.5], equal_nan=True)
    assert table.kind("sex") == "text" and table.kind("age") == "number"
    assert table.missing(["sex"]) == [2] and table.missing(["sex", "age"]) == [1, 2] and table.missing([]) == []


@pytest.mark.parametrize("word", ["", " ", "NA", "nan", "N/A", "null", "None"])
def test_missing_is_written_in_many_ways(tmp_path: Path, word: str) -> None:
    table = read_table(written(tmp_path, f"id,age\na,{word}\nb,3\n"))
    assert table.missing(["age"]) == [0]


@pytest.mark.parametrize(
    ("heads", "own"), [("file,scan,name,id", 0), ("scan,name,id,other", 0), ("name,id,a,b", 0), ("x,y,z,id", 3)]
)
def test_the_first_of_the_columns_that_may_name_a_shape_does(tmp_path: Path, heads: str, own: int) -> None:
    table = read_table(written(tmp_path, f"{heads}\np,q,r,s\n"))
    assert table.rows == ("pqrs"[own],) and heads.split(",")[own] not in table.columns and len(table.columns) == 3


def matched(rows: str, *specimens: Sequence[str]) -> dict[str, str]:
    """Return row -> specimen of a table with these rows, separated by spaces."""
    names = tuple(rows.split())
    found, _ = match_rows(Table({}, names, "data.csv"), specimens, "scans")
    return {names[row]: specimens[k][0] for row, k in found.items()}


def test_scans_of_one_name_in_different_folders_are_told_apart_by_them() -> None:
    rows = "anna/smile.ply bert/smile.ply bert\\calm.ply"
    assert matched(rows, ["bert_smile"], ["calm"], ["smile"]) == {
        "bert/smile.ply": "bert_smile", "bert\\calm.ply": "calm",
    }  # fmt: skip
    paths = [names_of_file(PurePath(f"/data/{name}.ply")) for name in ("bert/smile", "anna/smile")]
    assert match_rows(Table({}, tuple(rows.split())), paths, "scans")[0] == {0: 1, 1: 0}


@pytest.mark.parametrize(
    ("row", "specimen"),
    [
        ("anna", "anna"), ("ANNA", "anna"), ("Anna.ply", "anna"), ("scans/anna.nii.gz", "anna"), ("anna", "Anna"),
        ("c:\\in\\anna.PLY", "anna"), ("a.1", "a.1"), ("a.1.ply", "a.1"), ("A.1", "a.1"), ("anna.v2", "anna"),
        ("in/anna.ply", "in_anna"), ("x/in/anna.ply", "in_anna"), (" anna ", "anna"), ("Mu\u0308ller", "M\u00fcller"),
        ("STRASSE", "straße"),
    ],
)  # fmt: skip
def test_a_row_names_a_specimen_or_its_file_in_any_case(row: str, specimen: str) -> None:
    others = [["b"], ["ann"], ["annab"]]
    assert match_rows(Table({}, (row,)), [*others, [specimen]], "scans")[0] == {0: 3}


def test_a_row_that_fits_several_specimens_is_of_the_one_that_it_names_exactly_or_of_none() -> None:
    assert matched("a A", ["A"], ["a"]) == {"a": "a", "A": "A"}
    assert matched("B.1 B", ["b"], ["B.1"]) == {"B.1": "B.1", "B": "b"}
    assert matched("Ab x", ["ab"], ["AB"], ["x"]) == {"x": "x"}
    assert matched("a fit1", ["fit1", "a"], ["a", "b"]) == {"a": "a", "fit1": "fit1"}, (
        "the name of a fit goes before those of scans"
    )


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        ("anna bert anna", r"rows 1 \('anna'\) and 3 \('anna'\) are of one specimen;"),
        ("anna Anna", r"rows 1 \('anna'\) and 2 \('Anna'\) are of one specimen;"),
        ("anna.ply anna.stl", r"\('anna.ply'\) and 2 \('anna.stl'\) are of one specimen;"),
        ("in/anna.ply ANNA", "are of one specimen;"),
        ("bert Nobody nobody", r"\('Nobody'\) and 3 \('nobody'\) are of one specimen;"),
        ("anna Anna BERT bert", "are of one specimen; so are those of 1 more;"),
    ],
)
def test_two_rows_of_one_specimen_are_refused_and_both_named(rows: str, told: str) -> None:
    with pytest.raises(FileFormatError, match=told) as error:
        matched(rows, ["anna"], ["bert"])
    assert str(error.value).startswith("data.csv: ") and str(error.value).endswith("keep one row for each specimen.")


def test_rows_without_a_specimen_and_specimens_without_a_row_are_counted() -> None:
    table = Table({}, tuple("abcxyzw"), "data.csv")
    assert match_rows(table, [[name] for name in "dcbaq"], "scans")[1] == [
        "4 of 7 rows of data.csv have no specimen in scans and are excluded (x, y, z and 1 more).",
        "2 of 5 specimens in scans have no row in data.csv (d, q).",
    ]
    assert match_rows(table.take([0, 3]), [["a"], ["b"]], "scans")[1] == [
        "1 of 2 rows of data.csv has no specimen in scans and is excluded (x).",
        "1 of 2 specimens in scans has no row in data.csv (b).",
    ]
    assert match_rows(table.take([0]), [["a"]], "scans")[1] == []
    with pytest.raises(
        InputError, match=r"scans contains no specimen of data.csv \(rows such as x; specimens a\); give"
    ):
        match_rows(table.take([3]), [["a"]], "scans")


def test_a_string_among_numbers_is_refused_by_its_row_and_many_make_classes() -> None:
    names = ("a", "b", "c", "d", "e")
    table = Table({"age": ("20", "30", "old", "41", ""), "site": ("1", "2", "x", "y", "z")}, names, "data.csv")
    for ask in (table.kind, table.numbers):
        with pytest.raises(InputError, match="'old' at c"):
            ask("age")
    assert table.kind("site") == "text"
    assert Table({"x": ("", "")}, ("a", "b")).kind("x") == "text"
    for odd in ("1_000", "inf", "nan1", "0x1"):
        with pytest.raises(InputError, match="no number"):
            Table({"x": ("1", odd)}, ("a", "b")).numbers("x")


def test_numbers_written_as_cells_read_back_to_the_last_digit() -> None:
    values = np.array([np.pi, 1e-300, -2.5e17, np.nan, 0.1 + 0.2])
    table = Table({"x": numbers_as_text(values)}, tuple("abcde"))
    assert np.array_equal(table.numbers("x"), values, equal_nan=True)


def test_what_is_asked_for_in_vain_is_answered_with_what_there_is() -> None:
    table = Table({"age": ("1",)}, ("a",), "data.csv")
    with pytest.raises(InputError, match=r"data.csv has no column 'sex'; it has age\."):
        table.texts("sex")
    with pytest.raises(InputError, match="has 1 cells for 2 rows"):
        Table({"age": ("1",)}, ("a", "b"))


def test_rows_can_be_taken_in_any_order() -> None:
    table = Table({"x": ("1", "2", "3")}, ("a", "b", "c"), "data.csv").take([2, 0])
    assert table.rows == ("c", "a") and table.texts("x") == ("3", "1") and table.where == "data.csv"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("age,sex\n1,2\n", "no table of specimens"),
        ("file,age\n", "no table of specimens"),
        ("", "no table of specimens"),
        ("file,age\na,1\n,2\n", "has no file in row 2"),
        ("file,age,age\na,1,2\n", r"two columns of the same name \('age'\)"),
        ("file,age\na,1,2\n", "3 cells in row 1"),
        ('file,age\n"a,1\n', "not a CSV table"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_sentence(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(FileFormatError, match=told) as error:
        read_table(written(tmp_path, text))
    assert str(error.value).endswith(".") and "\n" not in str(error.value)


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252"])
def test_tables_are_read_in_the_encodings_and_with_the_delimiters_that_programs_write(
    tmp_path: Path, encoding: str, delimiter: str
) -> None:
    text = "File,sex,age\nMüller.ply,f,20\nb.ply,m,\n".replace(",", delimiter)
    (tmp_path / "data.csv").write_bytes(text.encode(encoding))
    table = read_table(tmp_path / "data.csv")
    assert (
        table.rows == ("Müller.ply", "b.ply") and table.texts("sex") == ("f", "m") and table.texts("age") == ("20", "")
    )


def test_what_is_no_text_or_not_there_is_refused(tmp_path: Path) -> None:
    for content in (b"\xff\xfe\x00", "file,age\na,1\n".encode("utf-16-le"), b"\xd0\xcf\x11\xe0old", b"PK\x03\x04x"):
        (tmp_path / "data.csv").write_bytes(content)
        with pytest.raises(FileFormatError, match=r"data\.csv (is|has) .*\.$"):
            read_table(tmp_path / "data.csv")
    with pytest.raises(FileError):
        read_table(tmp_path / "gone.csv")


@pytest.mark.parametrize("key", ["ID", "Specimen", "SCAN", "Name", "file", " id "])
def test_the_key_may_be_any_of_five_columns_in_any_case(tmp_path: Path, key: str) -> None:
    table = read_table(written(tmp_path, f"sex,{key}\nf,a\nm,b\n"))
    assert table.rows == ("a", "b") and list(table.columns) == ["sex"]


def test_decimal_commas_are_read_where_commas_do_not_part_cells(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "id;age;site;n\na;20,5;1,2a;1\nb;-3;x;2\nc;NA;y;3\n"))
    assert np.array_equal(table.numbers("age"), [20.5, -3, np.nan], equal_nan=True)
    assert table.texts("site") == ("1,2a", "x", "y") and table.texts("n") == ("1", "2", "3")
    for cells in ("20,5 1.5", "1.234,5 2", "1.234,5 1,5"):
        one, other = cells.split()
        with pytest.raises(FileFormatError, match="with commas and with points in the column 'age'"):
            read_table(written(tmp_path, f"id;age\na;{one}\nb;{other}\n"))


def test_rows_may_be_shorter_than_the_header_and_have_empty_cells_beside_it(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "sep=;\nid;sex;age;;\na;f;20;;\nb;m\n;;;;\n"))
    assert table.rows == ("a", "b") and table.texts("age") == ("20", "")


def test_white_space_of_cells_and_names_of_columns_makes_no_class(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "id, Group \na,Wild \nb,\xa0Wild\nc,Wild\n"))
    own = Table({" Group ": ("Wild ", " Wild", "Wild\t")}, ("a", "b", "c"))
    assert table.texts("Group") == own.texts("Group") == ("Wild",) * 3
    with pytest.raises(InputError, match="two columns whose names differ only in white space"):
        Table({"a": ("1",), "a ": ("2",)}, ("x",))


def test_what_a_spreadsheet_would_run_loses_its_apostrophe_and_columns_of_lists_their_mark(tmp_path: Path) -> None:
    table = read_table(written(tmp_path, "scan,meta_sex,meta_age,age\na,'=f(),1,2\n"))
    assert table.texts("sex") == ("=f()",) and table.texts("meta_age") == ("1",) and table.texts("age") == ("2",)


def test_names_are_told_until_they_are_many() -> None:
    assert list_names(["a", "b", "c"]) == "a, b, c" and list_names(["a", "b", "c", "d"]) == "a, b, c and 1 more"


def test_the_shapes_in_each_class_are_counted_and_likely_misspellings_named() -> None:
    cells = ("Wild",) * 9 + ("Lab",) * 8 + ("wild", "Wil d", "Labx")
    notes = notes_on_classes("origin", cells)
    assert notes[0] == "Shapes in each class of origin: Wild 9, Lab 8, wild 1, Wil d 1, Labx 1."
    assert notes[1].startswith("origin has 3 classes with one shape ('wild', 'Wil d', 'Labx')")
    assert [note for note in notes if "case or white space" in note] == [
        f"origin has the classes 'Wild' (9) and {other} (1), which differ only in case or white space; correct the "
        "table if they are the same."
        for other in ("'wild'", "'Wil d'")
    ]
    assert len(notes) == 4, "short words that differ in a letter are other words"


@pytest.mark.parametrize("other", ["femal", "femalee", "femole", "fmeale", "Females"])
def test_long_words_that_differ_in_one_letter_are_named(other: str) -> None:
    notes = notes_on_classes("sex", ("female",) * 5 + (other,) * 5)
    assert f"'female' (5) and {other!r} (5), which differ only in one letter" in notes[-1] and len(notes) == 2


@pytest.mark.parametrize(
    "cells", [("1", "2") * 5, ("male", "female") * 5, ("upper1", "upper2") * 5, ("anna", "hanna", "")]
)
def test_numbers_other_words_numbered_words_and_names_are_no_misspellings(cells: tuple[str, ...]) -> None:
    assert all(note.startswith("Shapes in each class") for note in notes_on_classes("x", cells))


def test_many_classes_are_counted_and_not_listed() -> None:
    cells = [f"animal {k}" for k in range(20)] * 2
    assert notes_on_classes("animal", cells) == ["Shapes in each class of animal: 2 in 20 classes."]
    assert notes_on_classes("animal", cells + cells[:20:2]) == ["Shapes in each class of animal: 2 to 3 in 20 classes."]


def test_groups_coded_as_two_numbers_are_counted() -> None:
    assert notes_on_classes("sex", ("0", *"11111", "")) == [
        "Shapes in each class of sex: 1 5, 0 1.",
        "sex has 1 class with one shape ('0'); check the spelling, or exclude these shapes.",
    ]
    assert not notes_on_classes("age", ("20", "21", "21", "22"))


def test_names_that_differ_in_case_are_named_and_not_counted() -> None:
    (note,) = notes_on_classes("subject", ("anna", "Anna", "bert", "carl"))
    assert "'anna' (1) and 'Anna' (1), which differ only in case" in note
