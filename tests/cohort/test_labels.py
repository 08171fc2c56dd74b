from pathlib import Path

import pytest

from shapespace.cohort.table import Label, names_of_file, read_labels
from shapespace.errors import FileFormatError


def labels_of(folder: Path, *scans: str) -> list[Label | None]:
    """Return the labels that l.csv gives to the scans of these paths."""
    return read_labels(folder / "l.csv").match([names_of_file(scan) for scan in scans], "scans")[0]


def test_labels_are_read_by_the_name_of_the_scan_without_folder_and_ending(tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("file,subject,expression,intensity\nin/a.ply,anna,smile,0.5\nb.obj,ben,fear,x\n")
    assert labels_of(tmp_path, "b.ply", "c.ply", "/out/A.ply") == [
        Label("fear", None, "ben"), None, Label("smile", 0.5, "anna"),
    ]  # fmt: skip


def test_a_scan_may_have_a_subject_and_no_class(tmp_path: Path) -> None:
    (tmp_path / "l.csv").write_text("scan,label,subject\na,,anna\nb,,\nc,smile,\n")
    assert labels_of(tmp_path, "a", "b", "c") == [Label("", None, "anna"), Label(""), Label("smile")]


def test_scans_of_the_same_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    table = "file,subject,label\nanna/smile.ply,anna,smile\nben/smile.ply,ben,smile\nc/x.ply,c,fear\n"
    (tmp_path / "l.csv").write_text(table)
    assert labels_of(tmp_path, "/data/ben/smile.ply", "/data/carl/smile.ply", "/elsewhere/x.stl") == [
        Label("smile", None, "ben"), None, Label("fear", None, "c"),
    ]  # fmt: skip
    assert labels_of(tmp_path, "anna_smile.ply", "smile.ply") == [Label("smile", None, "anna"), None]
    (tmp_path / "l.csv").write_text(table + "c/x.obj,c,fear\n")
    with pytest.raises(FileFormatError, match=r"rows 3 \('c/x.ply'\) and 4 \('c/x.obj'\) are of one specimen;"):
        labels_of(tmp_path, "/elsewhere/x.stl")


@pytest.mark.parametrize("text", ["", "file,label\n", "x,y\n1,2\n", 'file,label\n"a'])
def test_what_is_no_table_of_labels_is_refused_by_name(tmp_path, text):
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(FileFormatError, match=r"l\.csv"):
        read_labels(tmp_path / "l.csv")
