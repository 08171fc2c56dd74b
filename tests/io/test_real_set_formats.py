"""Formats that are only read: small files written by hand from the documented layouts, and what damage does to them."""

import struct
from pathlib import Path

import numpy as np
import pytest
from hand_made import BND, FACE, LM3, NONE, bnt

from shapespace.errors import FileError, FileFormatError, MeshError
from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS, READ_ONLY_LANDMARKS, read_landmarks, write_landmarks
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, MESH_FORMATS, READ_ONLY_FORMATS, read_mesh, write_mesh
from shapespace.types import Mesh

ENDINGS = list(READ_ONLY_FORMATS)


def one_sentence(error: BaseException, name: str) -> bool:
    text = str(error)
    return name in text and text.endswith(".") and "\n" not in text and len(text) < 600


def refusal(path: Path) -> str:
    with pytest.raises((FileError, MeshError)) as caught:
        read_mesh(path)
    assert one_sentence(caught.value, path.name)
    return str(caught.value)


# VRML

CORNERS = [[-1.5, 0.25, 3.000001], [1, 0, 0], [1, 1, 0], [0, 1, -0.5]]
TWO = [[0, 1, 2], [0, 2, 3]]


def is_face(mesh: Mesh) -> None:
    np.testing.assert_array_equal(mesh.vertices, CORNERS)
    np.testing.assert_array_equal(mesh.faces, TWO)


def test_a_scan_as_bu3dfe_writes_it(write):
    mesh = read_mesh(write("F0001_AN01WH_F3D.wrl", FACE))
    is_face(mesh)
    assert mesh.name == "F0001_AN01WH_F3D.wrl"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\n", "\r\n"),
        ("\n", "\r"),
        (", ", ","),
        (", ", " "),
        (",", " , ,"),
        ("0, 2, 3, -1\n", "0, 2, 3\n"),
        ("0, 2, 3, -1\n", "0 2 3 -1,\n"),
        ("0, 1, 2, -1,\n   0, 2, 3, -1\n", "0 1 2 3 -1"),
        ("0, 1, 2, -1,\n   0, 2, 3, -1\n", "0x0 0X1 0x2 0x03 -1 -1"),
        ("point [", "point["),
        ("Shape {", "# a ] } comment [ {\nDEF face Shape{"),
        ("coord Coordinate", 'info "a \\" # } ] string" coord DEF c Coordinate'),
        ("-1.5 0.25", "-15e-1 # not 7\n 2.5E-1"),
        ("#VRML V2.0 utf8", "\n"),
        ("geometry IndexedFaceSet {", "geometry IndexedFaceSet { ccw TRUE solid FALSE creaseAngle 1.5"),
        ("IndexedFaceSet {", "IndexedFaceSet { colorPerVertex FALSE color Color { color [ 1 0 0, 0 1 0 ] }"),
        ("IndexedFaceSet {", "IndexedFaceSet { normal Normal { vector [ 1 0 0, 0 1 0 ] } normalIndex [0 1 -1]"),
    ],
)
def test_spellings_of_vrml_mean_the_same(write, old: str, new: str):
    assert old in FACE
    is_face(read_mesh(write("a.wrl", FACE.replace(old, new))))


def test_indices_may_come_before_their_points(write):
    points = FACE[FACE.index("coord Coord") : FACE.index("coordIndex")]
    text = FACE.replace(points, "").replace("texCoord Tex", points + "texCoord Tex")
    is_face(read_mesh(write("a.wrl", text)))


def test_vrml_1_keeps_points_beside_the_faces(write):
    inner = "Separator { Coordinate3 { point [ 9 9 9, 8 8 8, 7 7 7 ] } IndexedFaceSet { coordIndex [ 2 1 0 -1 ] } }"
    text = (
        "#VRML V1.0 ascii\nSeparator { ShapeHints { vertexOrdering COUNTERCLOCKWISE }\n"
        f"DEF c Coordinate3 {{ point [ -1.5 .25 3.000001, 1 0 0, 1 1 0, 0 1 -.5 ] }}\n{inner}\n"
        "Texture2 { filename \"a.bmp\" } TextureCoordinate2 { point [ 0 0, 1 1 ] }\n"
        "IndexedFaceSet { coordIndex [ 0, 1, 2, -1, 0, 2, 3, -1 ] textureCoordIndex [ 0, 1, 1, -1 ] } }\n"
    )  # fmt: skip
    mesh = read_mesh(write("a.wrl", text))
    np.testing.assert_array_equal(mesh.vertices, [*CORNERS, [9, 9, 9], [8, 8, 8], [7, 7, 7]])
    np.testing.assert_array_equal(mesh.faces, [[6, 5, 4], *TWO])
    turned = read_mesh(write("b.wrl", text.replace("COUNTERCLOCKWISE", "CLOCKWISE")))
    np.testing.assert_array_equal(turned.faces, np.array([[6, 5, 4], *TWO])[:, ::-1])


def test_several_shapes_stand_one_after_another(write):
    group = f"Group {{ children [ {FACE}, {FACE} Shape {{ geometry Box {{ size 1 1 1 }} }} ] }}"
    mesh = read_mesh(write("a.wrl", group))
    np.testing.assert_array_equal(mesh.vertices, CORNERS * 2)
    np.testing.assert_array_equal(mesh.faces, [*TWO, [4, 5, 6], [4, 6, 7]])


def test_shapes_may_share_points(write):
    one = (
        "Shape { geometry IndexedFaceSet { coord DEF c Coordinate { point [0 0 0 1 0 0 0 1 0] } coordIndex [0 1 2] } }"
    )
    two = "Shape { geometry IndexedFaceSet { coord USE c coordIndex [ 0 2 1 -1 ] } }"
    mesh = read_mesh(write("a.wrl", one + two))
    assert len(mesh.vertices) == 3
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 1]])


def test_appearances_may_be_used_twice_but_shapes_not(write):
    shared = FACE.replace("appearance App", "appearance DEF a App") + FACE.replace(
        FACE[FACE.index("appearance") : FACE.index("geometry")], "appearance USE a "
    )
    assert len(read_mesh(write("a.wrl", shared)).faces) == 4
    for text in (f"DEF s {FACE} Transform {{ children [ USE s ] }}",
                 FACE.replace("geometry I", "geometry DEF s I") + "Shape { geometry USE s }"):  # fmt: skip
        assert "shape 's' twice" in refusal(write("b.wrl", text))


def test_faces_that_say_they_are_clockwise_are_turned(write):
    mesh = read_mesh(write("a.wrl", FACE.replace("IndexedFaceSet {", "IndexedFaceSet { ccw FALSE")))
    np.testing.assert_array_equal(mesh.faces, np.array(TWO)[:, ::-1])


def test_transforms_move_what_stands_in_them(write):
    shape = (
        "Shape { geometry IndexedFaceSet { coord Coordinate { point [ 1 0 0, 2 0 0, 1 1 0 ] } coordIndex [ 0 1 2 ] } }"
    )
    inner = f"Transform {{ scale 2 1 1 center 1 0 0 children [ {shape} ] }}"
    text = (
        f"{shape} Transform {{ rotation 0 0 2 1.5707963267948966 children [ {inner} ] translation 10 0 5 }} "
        f"Transform {{ scale -1 1 1 children {shape} }}"
    )
    mesh = read_mesh(write("a.wrl", text))
    plain = [[1, 0, 0], [2, 0, 0], [1, 1, 0]]
    moved = [[10, 1, 5], [10, 3, 5], [9, 1, 5]]
    np.testing.assert_allclose(mesh.vertices, [*plain, *moved, [-1, 0, 0], [-2, 0, 0], [-1, 1, 0]], atol=1e-12)
    # The mirrored copy keeps its outside outside.
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [3, 4, 5], [8, 7, 6]])


def test_a_scale_along_turned_axes(write):
    text = (
        "Transform { scale 3 1 1 scaleOrientation 0 0 1 1.5707963267948966 children Shape { geometry PointSet { "
        "coord Coordinate { point [ 1 0 0, 0 1 0 ] } } } }"
    )
    mesh = read_mesh(write("a.wrl", text))
    np.testing.assert_allclose(mesh.vertices, [[1, 0, 0], [0, 3, 0]], atol=1e-12)
    assert mesh.faces is None


@pytest.mark.parametrize("node", ["Translation { translation 1 0 0 }", "Scale { scaleFactor 2 2 2 }",
                                  "MatrixTransform { matrix 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1 }",
                                  "Rotation { rotation 0 0 1 1 }", "Transform { scaleFactor 2 2 2 }"])  # fmt: skip
def test_movements_of_vrml_1_are_refused_by_name(write, node: str):
    text = f"#VRML V1.0 ascii\nSeparator {{ {node} Coordinate3 {{ point [ 0 0 0 ] }} }}"
    assert f"by '{node.split()[0]}' of VRML 1" in refusal(write("a.wrl", text))


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("0, 2, 3, -1", "0, 2, 4, -1", "points at vertex 4"),
        ("0, 2, 3, -1", "0, 2, -3, -1", "points at vertex -3"),
        ("0, 2, 3, -1", "0, 2, -1", "only 2 corners"),
        ("0, 2, 3, -1", "0, 2, 3.5, -1", "text where an integer should be"),
        ("0, 2, 3, -1", "0, 2, 0xZ, -1", "text where an integer should be"),
        ("0, 2, 3, -1", "0, [], 3, -1", "brackets in it"),
        ("1 0 0,", "1 0 {} 0,", "brackets in it"),
        ("+1 0,", "+1 ,", "not three each"),
        ("+1 0,", "+1 zero,", "text where a number"),
        ("coord Coordinate {", "other Stuff {", "has no points"),
        ("coordIndex", "] coordIndex", "brackets do not match"),
        ("#VRML", "\x1f\x8b", "compressed data"),
        ("Shape {", "Shape { " + "Group { children [ " * 600, "nested"),
        ("Shape {", "Transform { scale 2 } Shape {", "too few numbers"),
    ],
)
def test_vrml_that_contradicts_itself_is_refused(write, old: str, new: str, why: str):
    assert old in FACE
    assert why in refusal(write("a.wrl", FACE.replace(old, new, 1).encode("latin-1")))


def test_faces_of_one_shape_cannot_reach_the_points_of_another(write):
    assert "points at vertex 4" in refusal(write("a.wrl", FACE.replace("0, 2, 3, -1", "0, 2, 4, -1") + FACE))


def test_moved_shapes_that_share_points_are_refused(write):
    one = (
        "Shape { geometry IndexedFaceSet { coord DEF c Coordinate { point [0 0 0 1 0 0 0 1 0] } coordIndex [0 1 2] } }"
    )
    two = "Shape { geometry IndexedFaceSet { coord USE c coordIndex [ 0 2 1 -1 ] } }"
    text = f"{one} Transform {{ translation 1 0 0 children [ {two} ] }}"
    assert "share their points" in refusal(write("a.wrl", text))


# Bosphorus


def towards(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)[:, 2]


@pytest.mark.parametrize("downwards", [False, True])
def test_a_whole_grid_gives_two_triangles_a_cell_that_look_at_the_camera(write, downwards: bool):
    depth = np.arange(12.0).reshape(3, 4) / 10
    mesh = read_mesh(write("bs000_N_N_0.bnt", bnt(depth, downwards=downwards)))
    np.testing.assert_array_equal(mesh.vertices[:, 2], depth.ravel())
    np.testing.assert_array_equal(mesh.vertices[5], [1, -1 if downwards else 1, 0.5])
    assert len(mesh.faces) == 12
    np.testing.assert_allclose(towards(mesh), 1.0)


def triangles_of(mesh: Mesh, grid_of: dict[int, tuple[int, int]]) -> set[frozenset[tuple[int, int]]]:
    return {frozenset(grid_of[int(corner)] for corner in face) for face in mesh.faces}


@pytest.mark.parametrize("missing", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_cell_with_three_corners_gives_one_triangle(write, missing: tuple[int, int]):
    depth = np.zeros((2, 2))
    depth[missing] = NONE
    mesh = read_mesh(write("a.bnt", bnt(depth)))
    assert (len(mesh.vertices), len(mesh.faces)) == (3, 1)
    np.testing.assert_allclose(towards(mesh), 1.0)


def test_triangles_of_a_grid_with_holes_are_those_of_brute_force(write):
    rng = np.random.default_rng(3)
    depth = rng.normal(scale=0.1, size=(7, 9))
    depth[rng.random(depth.shape) < 0.3] = NONE
    depth[4:, 6:] -= np.where(depth[4:, 6:] == NONE, 0, 30)
    mesh = read_mesh(write("a.bnt", bnt(depth)))
    there = [(r, c) for r in range(7) for c in range(9) if depth[r, c] != NONE]
    wanted = set()
    for r in range(6):
        for c in range(8):
            cell = [p for p in [(r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1)] if depth[p] != NONE]
            parts = {3: [cell], 4: [cell[:3], cell[1:]]}.get(len(cell), [])
            # A jump of 30 is more than 8 steps of about 1.
            wanted |= {frozenset(p) for p in parts if np.ptp([depth[q] for q in p]) < 10}
    assert triangles_of(mesh, dict(enumerate(there))) == wanted
    assert len(mesh.faces) == len(wanted) > 10
    assert (towards(mesh) > 0).all()


@pytest.mark.parametrize("step", [0.3, 1.0, 250.0])
def test_jumps_in_depth_are_cut_at_eight_steps_in_any_unit(write, step: float):
    depth = np.zeros((5, 8))
    depth[:, 4:] = step * np.sqrt(8**2 - 1) * 0.98
    # The sides of the step are below the limit, its diagonals too: sqrt(7.78^2 + 2) < 8.
    assert len(read_mesh(write("a.bnt", bnt(depth, step))).faces) == 56
    depth[:, 4:] = step * 8.1
    assert len(read_mesh(write("a.bnt", bnt(depth, step))).faces) == 48


def test_scattered_points_without_neighbours_are_a_cloud(write):
    depth = np.full((3, 3), NONE)
    depth[0, 0] = depth[2, 2] = 1
    mesh = read_mesh(write("a.bnt", bnt(depth)))
    assert len(mesh.vertices) == 2 and mesh.faces is None


def test_points_that_are_no_numbers_are_kept_without_triangles_for_the_doctor(write):
    depth = np.zeros((3, 3))
    depth[1, 1] = np.nan
    mesh = read_mesh(write("a.bnt", bnt(depth)))
    assert len(mesh.vertices) == 9
    assert 4 not in mesh.faces and len(mesh.faces) == 2


def test_a_name_of_any_length_and_bytes_after_the_data_change_nothing(write):
    for name in (b"", b"\0\xff" * 300):
        assert len(read_mesh(write("a.bnt", bnt(np.zeros((2, 2)), name=name) + b"more")).vertices) == 4


def header(rows: int, columns: int, count: int, zmin: float = NONE, name: int = 0) -> bytes:
    return struct.pack("<HHdH", rows, columns, zmin, name) + struct.pack("<I", count)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (header(65535, 65535, 0xFFFFFFFF) + bytes(99), "not a Bosphorus file"),
        (header(20000, 20000, 2_000_000_000) + bytes(99), "but only 99 bytes follow"),
        (header(2, 2, 20) + bytes(159), "but only 159 bytes follow"),
        (header(2, 2, 12) + bytes(160), "not a Bosphorus file"),
        (header(0, 5, 0) + bytes(160), "not a Bosphorus file"),
        (header(2, 2, 20, name=40000) + bytes(160), "header is cut off"),
        (header(2, 2, 20, zmin=float("nan")) + bytes(160), "not finite"),
        (header(2, 2, 20, zmin=0.0) + bytes(160), "all its points are missing"),
        (b"\1\0\1\0", "too short"),
    ],
)
def test_a_grid_that_contradicts_itself_is_refused_before_memory_is_taken(write, content: bytes, why: str):
    assert why in refusal(write("a.bnt", content))


# All of them


def test_formats_that_are_only_read_are_not_those_that_are_written():
    assert not set(READ_ONLY_FORMATS) & set(MESH_FORMATS)
    assert not set(READ_ONLY_LANDMARKS) & set(LANDMARK_FORMATS)
    assert set(MESH_ENDINGS) == set(MESH_FORMATS) | set(READ_ONLY_FORMATS)


@pytest.mark.parametrize("ending", ENDINGS)
def test_they_are_not_written(ending: str, tmp_path: Path):
    with pytest.raises(FileFormatError, match=r"can be read, not written; use one of \.ply") as caught:
        write_mesh(tmp_path / f"a{ending}", Mesh(np.eye(3)))
    assert one_sentence(caught.value, f"a{ending}")
    with pytest.raises(FileFormatError, match="can be read, not written"):
        write_landmarks(tmp_path / "a.bnd", {"a": np.zeros(3)})


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_missing_file_is_named(ending: str, tmp_path: Path):
    assert "no such file" in refusal(tmp_path / f"gone{ending.upper()}")


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    "content",
    [b"", b" \n\t\n", b"Dear reader, this is not a mesh.\n" * 9, bytes(200), bytes(range(256)) * 3, b"v", b"{}", b'"',
     b"[" * 100000, b"{" * 100000, b"[{" * 50000, b'"\\"' * 50000, b"}", b"\\" * 9999, b"point [ 1 2 3 ]"],
)  # fmt: skip
def test_what_is_not_a_mesh_is_refused(ending: str, content: bytes, write):
    refusal(write(f"text{ending}", content))


@pytest.mark.parametrize("name", ["a.wrl", "a.bnt"])
def test_a_file_cut_short_anywhere_is_refused(write, name: str):
    whole = {"a.wrl": FACE.strip().encode(), "a.bnt": bnt(np.zeros((3, 4)))}[name]
    for length in range(0, len(whole), 3):
        refusal(write(name, whole[:length]))


# Landmarks


def test_points_of_bu3dfe_are_named_by_their_position(write):
    marks = read_landmarks(write("F0001_AN01WH_F3D.bnd", BND))
    assert list(marks) == ["point_0", "point_1", "point_2"]
    np.testing.assert_array_equal(marks["point_0"], [-34.11, 20.5, 80.25])
    assert len(read_landmarks(write("b.bnd", "".join(f"{k} {k} 0 1\r\n" for k in range(83))))) == 83


@pytest.mark.parametrize(
    "head", ["# Landmark file\n\n3 landmarks\n", "*\n3 landmarks:\n", "\ufeff3\n", "a\nb\n\n 3 \n\n"]
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_points_of_bosphorus_carry_their_names(write, head: str, newline: str):
    text = head + LM3.split("landmarks\n")[1]
    marks = read_landmarks(write("bs000_N_N_0.lm3", text.replace("\n", newline)))
    assert list(marks) == ["Outer left eyebrow", "Nose tip", "Chin middle"]
    np.testing.assert_array_equal(marks["Chin middle"], [1, -60, -20])


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.bnd", "1 2 3\n", "point_0 is not a row"),
        ("a.bnd", "1 2 3 4\nx 2 3 4\n", "point_1 is not a row"),
        ("a.bnd", "1 2 3 z\n", "not a number"),
        ("a.bnd", "1 2 3 nan\n", "not finite"),
        ("a.lm3", "# no number\nNose tip\n1 2 3\n", "number of landmarks"),
        ("a.lm3", LM3.replace("3 landmarks", "4 landmarks"), "declares 4 landmarks, but 6 lines"),
        ("a.lm3", LM3.replace("0 0 0", "0 0"), "has 2 coordinates"),
        ("a.lm3", LM3.replace("Nose tip", "Chin middle"), "two landmarks named 'Chin middle'"),
        ("a.lm3", "0 landmarks\n", "contains no landmarks"),
    ],
)
def test_landmarks_that_contradict_themselves_are_refused(write, name: str, content: str, why: str):
    with pytest.raises(FileFormatError) as caught:
        read_landmarks(write(name, content))
    assert why in str(caught.value) and one_sentence(caught.value, name)
