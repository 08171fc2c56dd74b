import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from refusals import refusal_of
from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.io.landmarks.landmark_io import (
    LANDMARK_FORMATS,
    read_landmark_indices,
    read_landmarks,
    write_landmark_indices,
    write_landmarks,
)

ENDINGS = list(LANDMARK_FORMATS)
POINTS = {
    "nose tip": np.array([0.1, 1 / 3, -2e-7]),
    'left "eye", <outer> & more': np.array([1e6 / 7, -0.0, 3.0]),
    "Ohrläppchen": np.array([1.0, 2.0, 3.0]),
}


refusal = partial(refusal_of, read_landmarks)


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_written_is_read_back(ending: str, tmp_path: Path):
    path = tmp_path / f"marks{ending}"
    write_landmarks(path, POINTS)
    back = read_landmarks(str(path))
    assert list(back) == list(POINTS)
    for name, point in POINTS.items():
        np.testing.assert_array_equal(back[name], point)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("point", [[1, 2], [1, 2, np.nan]])
def test_what_is_not_a_point_is_not_written(ending: str, point: list[float], tmp_path: Path):
    with pytest.raises(InputError, match="'a'"):
        write_landmarks(tmp_path / f"m{ending}", {"a": np.array(point)})
    assert not list(tmp_path.iterdir())


def test_james_has_68_landmarks(shared_data: Path):
    james = read_landmarks(shared_data / "james" / "james.ljson")
    assert len(james) == 68
    assert list(james)[:2] == ["chin_0", "chin_1"]
    assert {"chin_16", "leye_0", "leye_5", "reye_0", "leyebrow_4", "nose_8", "reyebrow_4", "mouth_19"} <= set(james)
    raw = json.loads((shared_data / "james" / "james.ljson").read_text())["groups"]["LJSON"]["landmarks"]["points"]
    np.testing.assert_array_equal(james["leye_0"], raw[17])
    np.testing.assert_array_equal(james["mouth_19"], raw[67])


GROUP = {
    "labels": [{"label": "eye", "mask": [0, 1, 2]}, {"label": "tip", "mask": [3]}, {"label": "all", "mask": [0, 3]}],
    "landmarks": {"connectivity": [], "points": [[0, 0, 0], [None, None, None], [2, 0, 0], [3, 0, 0], [4, 0, 0]]},
}


def test_ljson_2_names_points_by_label_and_position(write):
    marks = read_landmarks(write("a.ljson", json.dumps({"version": 2, **GROUP})))
    assert {name: point[0] for name, point in marks.items()} == {"eye_0": 0, "eye_2": 2, "tip": 3, "point_4": 4}


def test_ljson_3_with_several_groups_says_which(write):
    value = {"version": 3, "groups": {"A": GROUP, "B": GROUP}}
    marks = read_landmarks(write("a.ljson", json.dumps(value)))
    assert len(marks) == 8
    assert {"A_eye_0", "B_eye_0", "B_point_4"} <= set(marks)


def test_ljson_1_is_read(write):
    groups = [{"label": "eye", "landmarks": [{"point": [1, 2, 3]}, {"point": None}, {"point": [4, 5, 6]}]}]
    marks = read_landmarks(write("a.ljson", json.dumps({"version": 1, "groups": groups})))
    assert list(marks) == ["eye_0", "eye_2"]


MESHLAB = """<!DOCTYPE PickedPoints>
<PickedPoints>
 <DocumentData><DateTime date="2020-01-01" time="12:00:00"/><User name="a"/></DocumentData>
 <point x="1.5" y="-2" active="1" z="3e-1" name="nose"/>
 <point z="1" active="0" y="1" x="1" name="unset"/>
</PickedPoints>
"""


def test_meshlab_points_that_are_not_active_are_skipped(write):
    marks = read_landmarks(write("a.pp", MESHLAB))
    assert list(marks) == ["nose"]
    np.testing.assert_array_equal(marks["nose"], [1.5, -2, 0.3])


def test_meshlab_entities_are_refused(write):
    bomb = MESHLAB.replace("PickedPoints>", 'PickedPoints [<!ENTITY a "b">]>', 1)
    assert "document type" in refusal(write("a.pp", bomb))


def slicer(system: str | None) -> str:
    points = [
        {"id": "1", "label": "nose", "position": [1, 2, 3], "positionStatus": "defined"},
        {"id": "2", "label": "unset", "positionStatus": "undefined"},
        {"id": "3", "label": "hover", "position": [0, 0, 0], "positionStatus": "preview"},
        {"id": "vtk4", "label": "", "position": [0, 0, 1]},
    ]
    markup = {"type": "Fiducial", "controlPoints": points} | ({"coordinateSystem": system} if system else {})
    return json.dumps({"markups": [markup]})


@pytest.mark.parametrize(("system", "sign"), [("LPS", 1), ("RAS", -1), (None, 1)])
@pytest.mark.parametrize("name", ["a.mrk.json", "A.MRK.JSON", "a.json"])
def test_slicer_markups_come_in_lps(write, name: str, system: str | None, sign: int):
    marks = read_landmarks(write(name, slicer(system)))
    assert list(marks) == ["nose", "vtk4"]
    np.testing.assert_array_equal(marks["nose"], [sign * 1, sign * 2, 3])


def test_slicer_in_another_system_is_refused(write):
    assert "neither LPS nor RAS" in refusal(write("a.mrk.json", slicer("IJK")))


@pytest.mark.parametrize(
    "text",
    [
        "a,1,2,3\nb,4,5,6\n",
        "name,x,y,z\na,1,2,3\nb,4,5,6",
        "\ufeffName, X, Y, Z\r\n# c\r\n\r\na, 1, 2, 3\r\nb,4,5,6\r\n",
        "landmark,z,y,x,note\na,3,2,1,hi\nb,6,5,4,\n",
    ],
)
def test_csv_with_and_without_header(write, text: str):
    marks = read_landmarks(write("a.csv", text))
    np.testing.assert_array_equal([marks["a"], marks["b"]], [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.csv", "a,1,2,3\na,4,5,6\n", "two landmarks named 'a'"),
        ("a.csv", "a,1,2,nan\n", "not finite"),
        ("a.csv", "a,1,2,inf\n", "not finite"),
        ("a.csv", "a,1,2\n", "3 columns"),
        ("a.csv", "a,1,2,3\nb,1,2\n", "fewer"),
        ("a.csv", "a,1,2,3\nb,1,2,x\n", "not a number"),
        ("a.csv", "a|1|2|3\n", "columns"),
        ("a.csv", "name,vertex\na,1\n", "vertex numbers"),
        ("a.csv", ",1,2,3\n", "without a name"),
        ("a.csv", "name,x,y,z\n", "no landmarks"),
        ("a.csv", "# only a comment\n", "no landmarks"),
        ("a.csv", '"a,1,2,3\n', "comma-separated"),
        ("a.csv", "", "empty"),
        ("a.pp", "<PickedPoints/>", "no landmarks"),
        ("a.pp", "<Other/>", "not a MeshLab"),
        ("a.pp", "<PickedPoints>", "not well-formed"),
        ("a.pp", '<PickedPoints><point x="1" y="2" name="a"/></PickedPoints>', "not a number"),
        ("a.json", "[]", "no landmarks"),
        ("a.json", "3", "not laid out"),
        ("a.json", '[{"id": "a", "coordinates": [1, 2]}]', "2 coordinates"),
        ("a.json", '[{"id": "a", "coordinates": [1, 2, NaN]}]', "not finite"),
        ("a.json", '[{"id": "a", "coordinates": [1, 2, null]}]', "not a number"),
        ("a.json", '[{"id": "a"}]', "not laid out"),
        ("a.json", "[" * 100_000, "not valid JSON"),
        ("a.mrk.json", '{"markups": [{"controlPoints": [{"label": "a"}]}]}', "not laid out"),
        ("a.ljson", '{"version": 9}', "version 9"),
        (
            "a.ljson",
            '{"version": 2, "labels": [{"label": "a", "mask": [5]}], "landmarks": {"points": []}}',
            "does not exist",
        ),
        ("a.ljson", '{"version": 2, "landmarks": {"points": [[1, 2]]}}', "2 coordinates"),
        ("a.doc", "a,1,2,3\n", "not a landmark format"),
    ],
)
def test_malformed_landmarks_are_refused(write, name: str, text: str, why: str):
    assert why in refusal(write(name, text))


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_missing_file_is_named(ending: str, tmp_path: Path):
    with pytest.raises(FileError, match="no such file"):
        read_landmarks(tmp_path / f"gone{ending}")


def test_vertex_numbers_round_trip(tmp_path: Path):
    path = tmp_path / "indices.csv"
    write_landmark_indices(path, {"nose": 12, "a, b": 0})
    assert read_landmark_indices(path) == {"nose": 12, "a, b": 0}
    assert path.read_text().splitlines()[0] == "name,vertex"


@pytest.mark.parametrize(
    "text", ["nose,1\n", "name,vertex\nnose,-1\n", "name,vertex\nnose,1.5\n",
     "name,vertex\nnose\n", "\n", "name,vertex\na,1\na,2\n",
     "name,vertex\na," + "9" * 5000, "name,x,y,z\na,1,2,3\n"],
)  # fmt: skip
def test_malformed_vertex_numbers_are_refused(write, text: str):
    with pytest.raises(FileFormatError, match=r"a\.csv.*\.$"):
        read_landmark_indices(write("a.csv", text))
