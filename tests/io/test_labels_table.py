import pytest

from shapespace.errors import FileFormatError
from shapespace.io.labels import Label, read_labels


def test_labels_are_read_by_the_name_of_the_scan_without_folder_and_ending(tmp_path):
    (tmp_path / "l.csv").write_text("file,subject,expression,intensity\nin/a.ply,anna,smile,0.5\nb.obj,ben,fear,x\n")
    assert read_labels(tmp_path / "l.csv") == {"a": Label("smile", 0.5, "anna"), "b": Label("fear", None, "ben")}


def test_a_scan_may_have_a_subject_and_no_class(tmp_path):
    (tmp_path / "l.csv").write_text("scan,label,subject\na,,anna\nb,,\nc,smile,\n")
    assert read_labels(tmp_path / "l.csv") == {"a": Label("", None, "anna"), "c": Label("smile")}


@pytest.mark.parametrize("text", ["", "file,label\n", "x,y\n1,2\n", 'file,label\n"a'])
def test_what_is_no_table_of_labels_is_refused_by_name(tmp_path, text):
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(FileFormatError, match=r"l\.csv"):
        read_labels(tmp_path / "l.csv")
