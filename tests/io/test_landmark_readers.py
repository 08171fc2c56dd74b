"""Landmarks of 3D Slicer, tps programs, scalismo and plain rows, in files as those programs write them."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hand_made import FCSV, TPS

from refusals import refusal_of
from shapespace.io.landmarks.landmark_io import read_landmarks, write_landmarks

refusal = partial(refusal_of, read_landmarks)


def test_fiducials_in_ras_are_turned_to_lps(write):
    marks = read_landmarks(write("a.fcsv", FCSV))
    assert list(marks) == ["nose tip", "left, eye"]
    np.testing.assert_array_equal(marks["nose tip"], [10.5, -20, 3.25])
    np.testing.assert_array_equal(marks["left, eye"], [0, 100, 7])


@pytest.mark.parametrize(("said", "sign"), [("LPS", 1), ("1", 1), ("RAS", -1), ("0", -1), (None, -1)])
def test_the_coordinate_system_is_that_which_the_file_says(said: str | None, sign: int, write):
    head = "# Markups fiducial file version = 4.13\n" + (f"# CoordinateSystem = {said}\n" if said else "")
    marks = read_landmarks(write("a.fcsv", head + "1,1,2,3,0,0,0,1,1,1,0,a,,\n"))
    np.testing.assert_array_equal(marks["a"], [sign * 1, sign * 2, 3])


def test_fiducials_of_slicer_3_have_other_columns(write):
    text = "# columns = label,x,y,z,sel,vis\n# CoordinateSystem = LPS\nF-1,1,2,3,1,1\n"
    np.testing.assert_array_equal(read_landmarks(write("a.fcsv", text))["F-1"], [1, 2, 3])


def test_what_is_written_for_slicer_says_lps(tmp_path: Path):
    write_landmarks(tmp_path / "a.fcsv", {"a": np.array([1.0, 2, 3])})
    assert "# CoordinateSystem = LPS\n" in (tmp_path / "a.fcsv").read_text()


def test_tps_has_points_by_number_without_those_that_are_missing(write):
    marks = read_landmarks(write("a.tps", TPS))
    assert list(marks) == ["point_0", "point_2"]
    np.testing.assert_array_equal(marks["point_2"], [4, 5, 6])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TPS + TPS, "2 specimens"), ("LM=1\n1 2\nID=a\n", "two dimensions"), (TPS.replace("LM3=3", "LM3=4"), "3 rows"),
        ("ID=a\n", "does not begin with LM= or LM3="),
    ],
)  # fmt: skip
def test_other_tps_is_refused(text: str, said: str, write):
    assert said in refusal(write("a.tps", text))


def test_tlms_leaves_out_what_is_not_visible(write):
    marks = read_landmarks(write("a.tlms", "right.eye 1 1 2 3\r\nleft.eye 0 0 0 0\r\n"))
    assert list(marks) == ["right.eye"]
    np.testing.assert_array_equal(marks["right.eye"], [1, 2, 3])


@pytest.mark.parametrize(
    ("name", "text", "names"),
    [
        ("a.txt", "1 2 3\n4 5 6\n", ["point_0", "point_1"]),
        ("a.txt", "\ufeff# by hand\nname,x,y,z\nnose,1,2,3\nchin;4;5;6\n", ["nose", "chin"]),
        ("a.pts", "Version 1.0\n2\nS000 1 2 3\nS001 4 5 6\n", ["S000", "S001"]),
        ("a.pts", "version: 1\nn_points: 2\n{\n1 2 3\n4 5 6\n}\n", ["point_0", "point_1"]),
    ],
)
def test_plain_rows_are_read(name: str, text: str, names: list[str], write):
    marks = read_landmarks(write(name, text))
    assert list(marks) == names
    np.testing.assert_array_equal(list(marks.values()), [[1, 2, 3], [4, 5, 6]])


def test_points_of_a_picture_are_refused(write):
    assert "has 2 columns" in refusal(write("a.pts", "version: 1\nn_points: 2\n{\n1 2\n4 5\n}\n"))


def test_a_count_that_is_wrong_is_refused(write):
    assert "declares 3 landmarks, but 2" in refusal(write("a.pts", "3\n1 2 3\n4 5 6\n"))
