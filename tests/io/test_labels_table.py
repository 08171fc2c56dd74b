import pytest

from shapespace.errors import FileFormatError
from shapespace.io.tables.label_table import Label, label_of, read_labels


def test_labels_are_read_by_the_name_of_the_scan_without_folder_and_ending(tmp_path):
    (tmp_path / "l.csv").write_text("file,subject,expression,intensity\nin/a.ply,anna,smile,0.5\nb.obj,ben,fear,x\n")
    assert read_labels(tmp_path / "l.csv") == {"a": Label("smile", 0.5, "anna"), "b": Label("fear", None, "ben")}


def test_a_scan_may_have_a_subject_and_no_class(tmp_path):
    (tmp_path / "l.csv").write_text("scan,label,subject\na,,anna\nb,,\nc,smile,\n")
    assert read_labels(tmp_path / "l.csv") == {"a": Label("", None, "anna"), "c": Label("smile")}


def test_scans_of_the_same_name_are_told_apart_by_their_folders(tmp_path):
    table = "file,subject,label\nanna/smile.ply,anna,smile\nben/smile.ply,ben,smile\nc/x.ply,c,fear\nc/x.obj,c,fear\n"
    (tmp_path / "l.csv").write_text(table)
    labels = read_labels(tmp_path / "l.csv")
    assert labels == {
        "anna_smile": Label("smile", None, "anna"), "ben_smile": Label("smile", None, "ben"),
        "x": Label("fear", None, "c"),
    }  # fmt: skip
    assert label_of(labels, tmp_path / "ben" / "smile.ply") == Label("smile", None, "ben")
    assert label_of(labels, tmp_path / "carl" / "smile.ply") is None
    assert label_of(labels, tmp_path / "elsewhere" / "x.stl") == Label("fear", None, "c")


@pytest.mark.parametrize("text", ["", "file,label\n", "x,y\n1,2\n", 'file,label\n"a'])
def test_what_is_no_table_of_labels_is_refused_by_name(tmp_path, text):
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(FileFormatError, match=r"l\.csv"):
        read_labels(tmp_path / "l.csv")
