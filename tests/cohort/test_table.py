"""Tables of what is known of shapes: numbers, classes, missing cells, and what is refused by name."""

from pathlib import Path

import numpy as np
import pytest

from shapespace.cohort.classes import notes_on_classes
from shapespace.cohort.table import Table, list_names, numbers_as_text, read_table
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.files import write_text

LINES = "file,sex,age\nscans/a.ply,f,20\nb.ply,m,\nc.stl,NA,41.5\n"


def written(folder: Path, text: str = LINES) -> Path:
    write_text(folder / "data.csv", text)
    return folder / "data.csv"


def test_rows_are_called_by_their_files_and_cells_that_say_nothing_are_empty(tmp_path: Path) -> None:
    table, keys = read_table(written(tmp_path))
    assert keys == table.rows == ("a", "b", "c") and list(table.columns) == ["sex", "age"]
    assert table.texts("sex") == ("f", "m", "") and table.texts("age") == ("20", "", "41.5")
    assert np.array_equal(table.numbers("age"), [20, np.nan, 41.5], equal_nan=True)
    assert table.kind("sex") == "text" and table.kind("age") == "number"
    assert table.missing(["sex"]) == [2] and table.missing(["sex", "age"]) == [1, 2] and table.missing([]) == []


@pytest.mark.parametrize("word", ["", " ", "NA", "nan", "N/A", "null", "None"])
def test_missing_is_written_in_many_ways(tmp_path: Path, word: str) -> None:
    table, _ = read_table(written(tmp_path, f"id,age\na,{word}\nb,3\n"))
    assert table.missing(["age"]) == [0]


@pytest.mark.parametrize(
    ("heads", "own"), [("file,scan,name,id", 0), ("scan,name,id,other", 0), ("name,id,a,b", 0), ("x,y,z,id", 3)]
)
def test_the_first_of_the_columns_that_may_name_a_shape_does(tmp_path: Path, heads: str, own: int) -> None:
    table, keys = read_table(written(tmp_path, f"{heads}\np,q,r,s\n"))
    assert keys == ("pqrs"[own],) and heads.split(",")[own] not in table.columns and len(table.columns) == 3


def test_scans_of_one_name_in_different_folders_are_told_apart_by_them(tmp_path: Path) -> None:
    _, keys = read_table(written(tmp_path, "file\nanna/smile.ply\nbert/smile.ply\nbert\\calm.ply\n"))
    assert keys == ("anna_smile", "bert_smile", "calm")


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
        ("age,sex\n1,2\n", "no table of shapes"),
        ("file,age\n", "no table of shapes"),
        ("", "no table of shapes"),
        ("file,age\na,1\na,2\n", "two or more rows of 'a'"),
        ("file,age\na,1\n,2\n", "has no file in row 2"),
        ("file,age\na.ply,1\na.stl,2\n", "two or more rows of 'a'"),
        ("file,age,age\na,1,2\n", r"two columns of one name \('age'\)"),
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
    table, keys = read_table(tmp_path / "data.csv")
    assert keys == ("Müller", "b") and table.texts("sex") == ("f", "m") and table.texts("age") == ("20", "")


def test_what_is_no_text_or_not_there_is_refused(tmp_path: Path) -> None:
    for content in (b"\xff\xfe\x00", "file,age\na,1\n".encode("utf-16-le"), b"\xd0\xcf\x11\xe0old", b"PK\x03\x04x"):
        (tmp_path / "data.csv").write_bytes(content)
        with pytest.raises(FileFormatError, match=r"data\.csv (is|has) .*\.$"):
            read_table(tmp_path / "data.csv")
    with pytest.raises(FileError):
        read_table(tmp_path / "gone.csv")


@pytest.mark.parametrize("key", ["ID", "Specimen", "SCAN", "Name", "file", " id "])
def test_the_key_may_be_any_of_five_columns_in_any_case(tmp_path: Path, key: str) -> None:
    table, keys = read_table(written(tmp_path, f"sex,{key}\nf,a\nm,b\n"))
    assert keys == ("a", "b") and list(table.columns) == ["sex"]


def test_decimal_commas_are_read_where_commas_do_not_part_cells(tmp_path: Path) -> None:
    table, _ = read_table(written(tmp_path, "id;age;site;n\na;20,5;1,2a;1\nb;-3;x;2\nc;NA;y;3\n"))
    assert np.array_equal(table.numbers("age"), [20.5, -3, np.nan], equal_nan=True)
    assert table.texts("site") == ("1,2a", "x", "y") and table.texts("n") == ("1", "2", "3")
    for cells in ("20,5 1.5", "1.234,5 2", "1.234,5 1,5"):
        one, other = cells.split()
        with pytest.raises(FileFormatError, match="with commas and with points in the column 'age'"):
            read_table(written(tmp_path, f"id;age\na;{one}\nb;{other}\n"))


def test_rows_may_be_shorter_than_the_header_and_have_empty_cells_beside_it(tmp_path: Path) -> None:
    table, keys = read_table(written(tmp_path, "sep=;\nid;sex;age;;\na;f;20;;\nb;m\n;;;;\n"))
    assert keys == ("a", "b") and table.texts("age") == ("20", "")


def test_white_space_of_cells_and_names_of_columns_makes_no_class(tmp_path: Path) -> None:
    table, _ = read_table(written(tmp_path, "id, Group \na,Wild \nb,\xa0Wild\nc,Wild\n"))
    own = Table({" Group ": ("Wild ", " Wild", "Wild\t")}, ("a", "b", "c"))
    assert table.texts("Group") == own.texts("Group") == ("Wild",) * 3
    with pytest.raises(InputError, match="two columns whose names differ only in white space"):
        Table({"a": ("1",), "a ": ("2",)}, ("x",))


def test_what_a_spreadsheet_would_run_loses_its_apostrophe_and_columns_of_lists_their_mark(tmp_path: Path) -> None:
    table, _ = read_table(written(tmp_path, "scan,meta_sex,meta_age,age\na,'=f(),1,2\n"))
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
        "sex has 1 class with one shape ('0'); check the spelling, or leave these shapes out.",
    ]
    assert not notes_on_classes("age", ("20", "21", "21", "22"))


def test_names_that_differ_in_case_are_named_and_not_counted() -> None:
    (note,) = notes_on_classes("subject", ("anna", "Anna", "bert", "carl"))
    assert "'anna' (1) and 'Anna' (1), which differ only in case" in note
