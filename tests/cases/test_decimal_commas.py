"""Numbers with decimal commas, as programs write them under a German or French locale."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from refusals import refusal_of
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.landmark_io import read_landmarks
from shapespace.io.meshes.mesh_io import read_mesh

POINTS = np.array([[-10.08985, 63.10333, 0.0], [49.5, 6.0, -2.25], [1.5, 2.0, 3.25]])
ROWS = "-10,08985 63,10333 0,00000\n49,5 6 -2,25\n1,5 2,0 3,25\n"
VTK = "# vtk DataFile Version 5.1\nvtk, 1,5\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n{}POLYGONS 1 4\n3 0 1 2\n"
VTP = (
    '<VTKFile type="PolyData" version="0.1"><PolyData><Piece NumberOfPoints="3"><Points>\n'
    '<DataArray type="Float32" NumberOfComponents="3" format="ascii">\n{}'
    "</DataArray></Points></Piece></PolyData></VTKFile>"
)
PLY = (
    "ply\nformat ascii 1.0\ncomment made by a, b 0.5\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n{}3 0 1 2\n"
)
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n{}"
STL = "solid a, b\nfacet normal 0,0 0,5 1\nouter loop\n{}endloop\nendfacet\nendsolid a\n"
refused_mesh, refused_landmarks = partial(refusal_of, read_mesh), partial(refusal_of, read_landmarks)


def prefixed(word: str) -> str:
    return "".join(f"{word} {row}\n" for row in ROWS.splitlines())


WRL = (
    "#VRML V2.0 utf8\nShape {{ geometry IndexedFaceSet {{ coord Coordinate {{ point [\n{}] }} "
    "coordIndex [0,1,2,-1] }} }}"
)
MESHES = {
    "a.xyz": ROWS,
    "b.xyz": "x,y,z\n" + ROWS.replace(" ", "\t"),
    "c.xyz": "# a, 1.5\n" + ROWS.replace(" ", ";"),
    "d.xyz": ROWS.replace(" ", "; ").replace("\n", "\r\n"),
    "a.pts": "3\n" + ROWS.replace("\n", " 0,5 0 0 255\n"),
    "a.obj": "# a, 1.5\no Cube 1.5\nmtllib a,b.mtl\n" + prefixed("v") + "vn 0,0 0,0 1,0\nf 1//1 2//1 3//1\n",
    "a.off": "OFF\n3 1 0\n" + ROWS + "3 0 1 2\n",
    "a.ply": PLY.format(ROWS),
    "a.stl": STL.format(prefixed("vertex")),
    "a.vtk": VTK.format(ROWS),
    "b.vtk": VTK.format(ROWS.replace("\n", " ")),
    "a.vtp": VTP.format(ROWS),
    "a.pcd": PCD.format(ROWS),
    "a.wrl": WRL.format(ROWS),
    "b.wrl": WRL.format(ROWS.replace("\n", ",\n")),
}


@pytest.mark.parametrize(
    "rows", ["0 0 0,1 0 0,0 2 0", "0 0 0, 1 0 0, 0 2 0,", "0,0,0,1,0,0,0,2,0", "0, 0, 0,\n1,0,0\n0 2 0"]
)
def test_commas_between_numbers_of_vrml_stay_what_they_are(rows: str, write) -> None:
    np.testing.assert_array_equal(
        read_mesh(write("a.wrl", WRL.format(rows))).vertices, [[0, 0, 0], [1, 0, 0], [0, 2, 0]]
    )


@pytest.mark.parametrize("name", MESHES)
def test_a_comma_is_the_decimal_mark_where_the_columns_show_it(name: str, write) -> None:
    np.testing.assert_array_equal(read_mesh(write(name, MESHES[name])).vertices, POINTS)


@pytest.mark.parametrize("row", ["1,5,2", "1, 5, 2", "1 ,5 ,2", "1,5,2,", "1.0,5.0,2", "1, 5.0 ,2", "1; 5; 2"])
def test_a_comma_separates_numbers_where_the_columns_show_it(row: str, write) -> None:
    np.testing.assert_array_equal(read_mesh(write("a.xyz", f"{row}\n{row}\n")).vertices, [[1, 5, 2]] * 2)
    np.testing.assert_array_equal(read_mesh(write("b.xyz", f"x, y, z\n{row}\n")).vertices, [[1, 5, 2]])


UNCLEAR = {
    "both roles": "1,5, 2,0, 3,25",
    "a comma alone": "1,5 , 2,0 , 3,25",
    "points too": "1,5 2.5 3,5",
    "thousands": "1,234.5 2,345.5 3,456.5",
    "thousands with points": "1.234,5 2.345,5 3.456,5",
    "a list": "1,5,2 1,5 2,5",
    "comma-separated": "-10,08985,63,10333,0,00000",
}


@pytest.mark.parametrize("row", UNCLEAR.values(), ids=UNCLEAR)
def test_commas_of_two_meanings_are_refused_with_the_line(row: str, write) -> None:
    sentence = refused_mesh(write("a.xyz", f"# first\n{row}\n"))
    assert "decimal comma" in sentence and "line 2" in sentence and row in sentence and "a.xyz" in sentence
    sentence = refused_landmarks(write("a.pts", f"# first\n{row}\n"))
    assert "decimal comma" in sentence and "line 2" in sentence and row in sentence
    assert "decimal comma" in refused_mesh(write("a.obj", f"v {row}\n"))


@pytest.mark.parametrize("other", ["1.5 2.5 3.5", "1,5,2"])
@pytest.mark.parametrize("is_first", [True, False])
def test_a_file_has_one_decimal_mark(other: str, is_first: bool, write) -> None:
    rows = [other, "1,5 2,5 3,5"][:: 1 if is_first else -1]
    sentence = refused_mesh(write("a.xyz", "\n".join(rows) + "\n"))
    assert "decimal commas" in sentence and "line 2" in sentence and "line 1" in sentence


LANDMARKS = {
    "a.pts": ROWS,
    "b.pts": "version: 1\nn_points: 3\n{\n" + ROWS + "}\n",
    "a.txt": "".join(f"lm{k} {row}\n" for k, row in enumerate(ROWS.splitlines())),
    "a.tps": "LM3=3\n" + ROWS + "IMAGE=a,b 1.5.jpg\nID=a\n",
    "a.bnd": "".join(f"{k} {row}\n" for k, row in enumerate(ROWS.splitlines())),
    "a.tlms": "".join(f"lm{k} 1 {row}\n" for k, row in enumerate(ROWS.splitlines())),
    "a.lm3": "3 landmarks:\n" + "".join(f"lm, {k}\n{row}\n" for k, row in enumerate(ROWS.splitlines())),
    "a.csv": "name;x;y;z\n" + "".join(f"lm{k};{row}\n".replace(" ", ";") for k, row in enumerate(ROWS.splitlines())),
    "b.csv": "".join(f"lm{k};{row}\n".replace(" ", ";") for k, row in enumerate(ROWS.splitlines())),
}


@pytest.mark.parametrize("name", LANDMARKS)
def test_landmarks_may_have_decimal_commas(name: str, write) -> None:
    np.testing.assert_array_equal(list(read_landmarks(write(name, LANDMARKS[name])).values()), POINTS)


REFUSED = {
    "a.csv": "name,x,y,z\nnose,1,5,2,0,3,25\n",
    "a.fcsv": "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label\n1,-23,531,12,250,-7,125,0,0,0,1,1,1,0,F-1,,\n",
    "a.pp": '<PickedPoints><point x="1,5" y="2,0" z="3,25" name="a" active="1"/></PickedPoints>',
    "a.tps": "LM=2\n98,84 , 12,5\n1,5 , 2,5\nID=a\n",
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_decimal_commas_are_named(name: str, write) -> None:
    assert "decimal comma" in refused_landmarks(write(name, REFUSED[name]))


def test_the_message_quotes_the_file(write) -> None:
    path = write("a.tps", "LM=2\n98.5, 12.5\n98,84 , 12,5\nID=a\n")
    assert "'98,84 , 12,5'" in refusal_of(read_configurations, path)
    np.testing.assert_array_equal(
        read_configurations(write("b.tps", "LM=2\n98.84, 93.83\n1,2\nID=a\n")).points, [[[98.84, 93.83], [1, 2]]]
    )


def test_tables_name_the_decimal_comma(write) -> None:
    quoted = write("a.csv", 'id,x1,y1,x2,y2\na,"1,5","2,5","3,5","4,5"\n')
    assert "decimal comma" in refusal_of(read_configurations, quoted)
    shifted = write("b.csv", "id,x1,y1,x2,y2\na,1,5,2,5,3,5,4,5\n")
    assert "decimal comma" in refusal_of(read_configurations, shifted)


def test_nts_may_have_decimal_commas(tmp_path: Path, write) -> None:
    found = read_configurations(write("a.nts", "1 2L 4 0 DIM=2\na b\n1,5 2,5 3,5 4\n0,5 1 2 3\n"))
    np.testing.assert_array_equal(found.points, [[[1.5, 2.5], [3.5, 4]], [[0.5, 1], [2, 3]]])


@pytest.mark.parametrize("space", ["\u00a0", "\u2009", "\u202f"])
def test_spaces_for_thousands_are_named(space: str, write) -> None:
    for name, head in (("a.xyz", ""), ("a.obj", "v ")):
        assert "spaces for thousands in line 1" in refused_mesh(write(name, f"{head}1{space}234,5 2,0 3,0\n"))
    assert "spaces for thousands in line 2" in refused_landmarks(write("a.tps", f"LM3=1\n1{space}234.5 2 3\nID=a\n"))
    assert len(read_mesh(write("b.xyz", f"# made{space}by 1{space}b\n1 2 3\n")).vertices) == 1


def test_the_rest_of_a_number_after_a_space_is_no_coordinate(write) -> None:
    assert "line 1 ('v 1 000,5 2,0 3,0')" in refused_mesh(write("a.obj", "v 1 000,5 2,0 3,0\n"))


def test_semicolons_separate_coordinates_of_tps(write) -> None:
    for rows in ("1.5;2.5\n2;3\n", "1,5; 2,5\n2;3\n"):
        found = read_configurations(write("a.tps", f"LM=2\n{rows}ID=a\n"))
        np.testing.assert_array_equal(found.points, [[[1.5, 2.5], [2, 3]]])
