import base64
import errno
import json
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hand_made import POINTS, gltf_tree, ply_header, vtp

from shapespace.errors import FileError, FileFormatError, InputError, MeshError, ShapespaceError
from shapespace.geometry.doctor import examine
from shapespace.io.meshes.mesh_io import MESH_FORMATS, read_mesh, write_mesh
from shapespace.types import Mesh

ENDINGS = list(MESH_FORMATS)
CLOUD_ENDINGS = [ending for ending, f in MESH_FORMATS.items() if f.point_clouds]


def one_sentence(error: BaseException, name: str) -> bool:
    text = str(error)
    return name in text and text.endswith(".") and "\n" not in text and len(text) < 600


# Round trips: one contract for all formats


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_written_is_read_back(ending: str, tetrahedron: Mesh, tmp_path: Path):
    path = tmp_path / f"out{ending}"
    write_mesh(path, tetrahedron)
    back = read_mesh(path)
    assert back.name == f"out{ending}"
    if MESH_FORMATS[ending].exact:
        np.testing.assert_array_equal(back.vertices, tetrahedron.vertices)
    if MESH_FORMATS[ending].keeps_vertices:
        np.testing.assert_array_equal(back.faces, tetrahedron.faces)
        np.testing.assert_allclose(back.vertices, tetrahedron.vertices, rtol=1e-6)
    np.testing.assert_allclose(
        back.vertices[back.faces], tetrahedron.vertices[tetrahedron.faces], rtol=1e-6, atol=1e-12
    )


@pytest.mark.parametrize("ending", CLOUD_ENDINGS)
def test_point_clouds_survive_without_triangles(ending: str, tmp_path: Path):
    points = np.random.default_rng(0).normal(size=(17, 3)).astype(np.float32)
    path = tmp_path / f"cloud{ending}"
    write_mesh(path, Mesh(points, None))
    back = read_mesh(path)
    assert back.faces is None
    np.testing.assert_array_equal(back.vertices, points)


@pytest.mark.parametrize("ending", [e for e in ENDINGS if MESH_FORMATS[e].keeps_vertices])
def test_vertices_of_no_triangle_are_kept(ending: str, tmp_path: Path):
    vertices = np.arange(18.0).reshape(6, 3) ** 2
    path = tmp_path / f"m{ending}"
    write_mesh(path, Mesh(vertices, np.array([[4, 1, 3]], dtype=np.int32)))
    back = read_mesh(path)
    np.testing.assert_array_equal(back.vertices, vertices)
    np.testing.assert_array_equal(back.faces, [[4, 1, 3]])


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_far_origin_keeps_micrometres_where_the_format_can(ending: str, tetrahedron: Mesh, tmp_path: Path):
    far = tetrahedron.with_vertices(tetrahedron.vertices + 1e6)
    path = tmp_path / f"far{ending}"
    write_mesh(path, far)
    back = read_mesh(path)
    tolerance = 0.07 if ending == ".stl" else 1e-4
    np.testing.assert_allclose(back.vertices[back.faces], far.vertices[far.faces], atol=tolerance, rtol=0)


@pytest.mark.parametrize("ending", [".ply", ".obj", ".off", ".vtk", ".vtp"])
def test_nan_is_carried_for_the_doctor_to_judge(ending: str, tmp_path: Path):
    vertices = np.array([[0, 0, 0], [np.nan, np.inf, -np.inf], [0, 1, 0], [0, 0, 1.0]])
    path = tmp_path / f"nan{ending}"
    write_mesh(path, Mesh(vertices, None))
    np.testing.assert_array_equal(read_mesh(path).vertices, vertices)


def test_the_ending_may_be_in_capitals(tetrahedron: Mesh, tmp_path: Path):
    write_mesh(tmp_path / "A.PLY", tetrahedron)
    assert len(read_mesh(str(tmp_path / "A.PLY")).vertices) == 4


def test_stl_refuses_a_point_cloud(tmp_path: Path):
    with pytest.raises(InputError, match="no triangles"):
        write_mesh(tmp_path / "a.stl", Mesh(np.eye(3), None))


@pytest.mark.parametrize("ending", [".glb", ".gltf"])
def test_gltf_refuses_points_that_it_cannot_hold(ending: str, tmp_path: Path):
    for bad in (np.full((3, 3), np.nan), np.eye(3) * 1e300, np.zeros((0, 3))):
        with pytest.raises(InputError):
            write_mesh(tmp_path / f"a{ending}", Mesh(bad, None))


# Other programs


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl", ".off", ".glb", ".gltf"])
def test_trimesh_reads_what_we_write(ending: str, tetrahedron: Mesh, tmp_path: Path):
    path = tmp_path / f"ours{ending}"
    write_mesh(path, tetrahedron)
    theirs = trimesh.load(path, process=False, force="mesh")
    np.testing.assert_allclose(
        theirs.vertices[theirs.faces], tetrahedron.vertices[tetrahedron.faces], rtol=1e-6, atol=1e-7
    )


@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (".ply", {}),
        (".ply", {"encoding": "ascii"}),
        (".obj", {}),
        (".off", {}),
        (".glb", {}),
        (".stl", {}),
        (".stl", {"file_type": "stl_ascii"}),
    ],
)
def test_we_read_what_trimesh_writes(ending: str, options: dict[str, str], tmp_path: Path):
    theirs = trimesh.creation.icosphere(subdivisions=2)
    theirs.visual.vertex_colors = [10, 20, 30, 255]
    path = tmp_path / f"theirs{ending}"
    theirs.export(path, **options)
    ours = read_mesh(path)
    corners = theirs.vertices[theirs.faces]
    np.testing.assert_allclose(ours.vertices[ours.faces], corners, atol=1e-7)
    assert len(ours.vertices) == len(theirs.vertices)


def test_james_keeps_his_vertices(shared_data: Path):
    james = read_mesh(shared_data / "james" / "james.obj")
    assert (james.vertices.shape, james.faces.shape) == ((6393, 3), (12228, 3))
    np.testing.assert_array_equal(james.vertices[0], [-21.514475, 138.620361, -34.341030])
    np.testing.assert_array_equal(james.faces[0], [2260, 4092, 925])


def test_ict_quads_become_two_triangles_each(shared_data: Path):
    head = read_mesh(shared_data / "ict-facekit" / "FaceXModel" / "generic_neutral_mesh.obj")
    assert (len(head.vertices), len(head.faces)) == (26719, 25836 * 2 + 548)


# OBJ


def test_obj_with_texture_seams_keeps_its_v_lines(write):
    path = write("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\nf 1/1 2/2 3/3\nf 1/4 3/3 2/2\n")
    mesh = read_mesh(path)
    assert len(mesh.vertices) == 3
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 1]])


@pytest.mark.parametrize(
    "faces",
    [
        "f 1 2 3 4",
        "f 1//1 2//1 3//1 4//1",
        "f -4 -3 -2 -1",
        "f 1/1/1 2/2/2 3/3/3 4/4/4",
        "f 1 2 \\\n 3 4",
        "f 1 2 3 4 # a quad",
        "g head\nusemtl skin\ns 1\nf 1 2 3 4",
        "\tf  1  2  3  4 ",
    ],
)
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_obj_dialects_mean_the_same(write, faces: str, newline: str):
    text = f"# c\nv 0 0 0 0.5 0.5 0.5\nv 1 0 0 1 1 1\nvn 0 0 1\nv 1 1 0\nv 0 1 0 1.0\n{faces}\n"
    mesh = read_mesh(write("a.obj", text.replace("\n", newline)))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])


def test_obj_negative_indices_count_from_where_they_stand(write):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\n"
    np.testing.assert_array_equal(read_mesh(write("a.obj", text)).faces, [[0, 1, 2], [3, 4, 5]])


# PLY


@pytest.mark.parametrize("order", ["<", ">"])
def test_ply_binary_with_extras_and_mixed_polygons(write, order: str):
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = ply_header(
        form,
        "element camera 1", "property float focal",
        "element vertex 5", "property uchar red", "property float z", "property double y", "property short x",
        "element face 3", "property uchar flags", "property list uint ushort vertex_index",
        "property list uchar float texcoord",
        "element edge 1", "property int a", "property int b",
    )  # fmt: skip
    row = np.dtype([("r", "u1"), ("z", order + "f4"), ("y", order + "f8"), ("x", order + "i2")])
    vertices = np.zeros(5, row)
    vertices["x"], vertices["y"], vertices["z"] = [0, 1, 2, 3, 4], 0.1, [0, 0.5, 0, 0.5, 0]
    body = np.array([35], order + "f4").tobytes() + vertices.tobytes()
    for polygon in ([0, 1, 2], [0, 2, 3, 4], [1, 2, 3]):
        body += b"\x07" + np.array([len(polygon)], order + "u4").tobytes()
        body += np.array(polygon, order + "u2").tobytes() + b"\x02" + np.zeros(2, order + "f4").tobytes()
    mesh = read_mesh(write("a.ply", header + body + bytes(8)))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [1, 2, 3]])
    np.testing.assert_array_equal(mesh.vertices[3], [3, 0.1, 0.5])


def test_ply_ascii_with_extras_and_crlf(write):
    header = ply_header(
        "ascii", "element vertex 4", "property float x", "property float y", "property float z",
        "property uchar red", "element face 2", "property list uchar int vertex_indices", "property int id",
    )  # fmt: skip
    body = b"0 0 0 9\n1 0 0 9\n1 1 0 9\n0 1 0.125 9\n4 0 1 2 3 7\n3 0 1 2 7\n"
    mesh = read_mesh(write("a.ply", (header + body).replace(b"\n", b"\r\n")))
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])
    assert mesh.vertices[3, 2] == 0.125


def test_ply_keeps_which_vertices_are_observed(tetrahedron: Mesh, tmp_path: Path):
    observed = np.array([True, False, True, True])
    colours = np.arange(12, dtype=np.uint8).reshape(4, 3)
    for mesh in (replace(tetrahedron, observed=observed), replace(tetrahedron, observed=observed, colours=colours)):
        path = tmp_path / "out.ply"
        write_mesh(path, mesh)
        assert b"property uchar observed\n" in path.read_bytes()
        back = read_mesh(path)
        np.testing.assert_array_equal(back.observed, observed)
        np.testing.assert_array_equal(back.vertices, mesh.vertices)
        assert mesh.colours is None or (back.colours == colours).all()
        other = trimesh.load(path, process=False)
        np.testing.assert_array_equal(other.vertices, mesh.vertices)
        np.testing.assert_array_equal(other.metadata["_ply_raw"]["vertex"]["data"]["observed"], observed)
        assert not [f for f in examine(back).findings if f.level == "refused"]
    write_mesh(tmp_path / "whole.ply", replace(tetrahedron, observed=np.ones(4, np.bool_)))
    assert read_mesh(tmp_path / "whole.ply").observed is None
    assert b"observed" not in (tmp_path / "whole.ply").read_bytes()


@pytest.mark.parametrize(("kind", "known"), [("uchar", True), ("int", True), ("float", False)])
def test_ply_ascii_observed_is_a_whole_number(write, kind: str, known: bool):
    text = f"ply\nformat ascii 1.0\nelement vertex 3\nproperty {kind} observed\n"
    text += "".join(f"property float {axis}\n" for axis in "xyz")
    path = write("a.ply", (text + "end_header\n1 0 0 0\n0 1 0 0\n1 0 1 0\n").encode())
    back = read_mesh(path)
    assert (back.observed is not None and back.observed.tolist() == [True, False, True]) is known
    np.testing.assert_array_equal(back.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_ply_binary_that_starts_with_a_newline_byte(write):
    header = ply_header(
        "binary_little_endian", "element vertex 1", "property float x", "property float y", "property float z"
    )
    point = b"\x0a\x0d\x0a\x3f" + np.array([1, 2], "<f4").tobytes()
    np.testing.assert_array_equal(read_mesh(write("a.ply", header + point)).vertices[0, 1:], [1, 2])


def test_ply_tristrips_are_refused(write):
    header = ply_header(
        "ascii", "element vertex 1", "property float x", "property float y", "property float z",
        "element tristrips 1", "property list int int vertex_indices",
    )  # fmt: skip
    with pytest.raises(FileFormatError, match="triangle strips"):
        read_mesh(write("a.ply", header + b"0 0 0\n3 0 0 0\n"))


# STL and OFF


def test_stl_merges_equal_corners_in_order_of_first_appearance(write):
    facets = [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, -0.0]]]
    text = "solid vertex of things\n"
    for facet in facets:
        text += "facet normal 0 0 1\nouter loop\n"
        text += "".join("vertex {} {} {}\n".format(*corner) for corner in facet) + "endloop\nendfacet\n"
    mesh = read_mesh(write("a.stl", text + "endsolid\n"))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [1, 3, 2]])


def test_binary_stl_that_says_solid_is_binary(tetrahedron: Mesh, tmp_path: Path):
    path = tmp_path / "a.stl"
    write_mesh(path, tetrahedron)
    path.write_bytes(b"solid facet" + path.read_bytes()[11:])
    assert len(read_mesh(path).faces) == 4


@pytest.mark.parametrize(
    "head", ["OFF\n4 2 0", "OFF 4 2 0", "OFF4 2 0", "# c\nOFF # c\n\n4 2 0", "COFF\n4 2 0", "STOFF\n4 2"]
)
def test_off_dialects_mean_the_same(write, head: str):
    text = head + "\n0 0 0 255\n1 0 0 255\n\n1 1 0 255\n0 1 0 255\n4 0 1 2 3 255 0 0\n3 0 1 2\n"
    np.testing.assert_array_equal(read_mesh(write("a.off", text)).faces, [[0, 1, 2], [0, 2, 3], [0, 1, 2]])


# VTK

QUAD_AND_TRIANGLE = [[0, 1, 2], [0, 2, 3], [1, 2, 3]]


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("offsets", [False, True])
def test_vtk_legacy_of_all_ages(write, binary: bool, offsets: bool):
    def numbers(values: object, kind: str) -> bytes:
        array = np.asarray(values)
        if binary:
            return array.astype(">" + kind).tobytes() + b"\n"
        return " ".join(map(str, array.ravel())).encode() + b"\n"

    out = b"# vtk DataFile Version 5.1\ntitle\n" + (b"BINARY\n" if binary else b"ASCII\n")
    out += b"DATASET POLYDATA\nFIELD FieldData 1\nTimeValue 1 1 double\n" + numbers([0.5], "f8")
    out += b"POINTS 4 float\n" + numbers(POINTS, "f4")
    out += b"METADATA\nINFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1\n\n"
    if offsets:
        out += b"LINES 2 2\nOFFSETS vtktypeint64\n" + numbers([0, 2], "i8")
        out += b"CONNECTIVITY vtktypeint64\n" + numbers([0, 1], "i8")
        out += b"POLYGONS 3 7\nOFFSETS vtktypeint64\n" + numbers([0, 4, 7], "i8")
        out += b"CONNECTIVITY vtktypeint64\n" + numbers([0, 1, 2, 3, 1, 2, 3], "i8")
    else:
        out += b"LINES 1 3\n" + numbers([2, 0, 1], "i4")
        out += b"POLYGONS 2 9\n" + numbers([4, 0, 1, 2, 3, 3, 1, 2, 3], "i4")
    out += b"TRIANGLE_STRIPS 1 5\n" + numbers([4, 0, 1, 3, 2], "i4") if not offsets else b""
    mesh = read_mesh(write("a.vtk", out + b"POINT_DATA 4\nSCALARS s float 1\nLOOKUP_TABLE default\n"))
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    strips = [] if offsets else [[0, 1, 3], [1, 2, 3]]
    np.testing.assert_array_equal(mesh.faces, QUAD_AND_TRIANGLE + strips)


@pytest.mark.parametrize("header", ["UInt32", "UInt64"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("form", ["ascii", "inline", "appended", "raw"])
def test_vtp_in_all_encodings(write, form: str, compressed: bool, order: str, header: str):
    mesh = read_mesh(write("a.vtp", vtp(form, compressed, order, header)))
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    np.testing.assert_array_equal(mesh.faces, QUAD_AND_TRIANGLE)


def test_vtp_pieces_are_joined_and_checked_one_by_one(write):
    piece = vtp("ascii", False, "<", "UInt32").partition(b"<PolyData>")[2].partition(b"</PolyData>")[0]
    whole = b'<VTKFile type="PolyData"><PolyData>' + piece + piece + b"</PolyData></VTKFile>"
    mesh = read_mesh(write("a.vtp", whole))
    np.testing.assert_array_equal(mesh.faces[3:], np.array(QUAD_AND_TRIANGLE) + 4)
    with pytest.raises(MeshError, match="vertex 4"):
        read_mesh(write("b.vtp", whole.replace(b"0 1 2 3 1 2 3", b"0 1 2 4 1 2 3")))


def test_vtp_under_the_ending_vtk_is_read(write):
    assert len(read_mesh(write("a.vtk", vtp("raw", True, "<", "UInt32"))).vertices) == 4


def test_xml_entities_are_refused(write):
    bomb = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><VTKFile type="PolyData">&b;</VTKFile>'
    with pytest.raises(FileFormatError, match="document type"):
        read_mesh(write("a.vtp", bomb))


def test_a_decompression_bomb_is_refused(write):
    word = np.array([1, 1 << 40, 1 << 40, 20], "<u8").tobytes()
    text = base64.b64encode(word) + base64.b64encode(zlib.compress(bytes(1 << 20))[:20])
    data = vtp("inline", True, "<", "UInt64")
    start = data.index(b"\n  ", data.index(b"<Points>"))
    data = data[:start] + b"\n" + text + data[data.index(b"\n</DataArray>", start) :]
    with pytest.raises(FileFormatError, match="declares 1099511627776 bytes"):
        read_mesh(write("a.vtp", data))


# glTF


def test_gltf_nodes_move_their_meshes(write):
    turn = [0, 0, 2**-0.5, 2**-0.5]
    nodes = [
        {"children": [2, 1], "translation": [10, 0, 0]},
        {"mesh": 0, "matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"mesh": 0, "rotation": turn, "scale": [2, 1, 1]},
    ]
    mesh = read_mesh(write("a.gltf", json.dumps(gltf_tree(nodes=nodes))))
    turned = [[10, 0, 0], [10, 2, 0], [9, 0, 0]]
    np.testing.assert_allclose(mesh.vertices, [*turned, [10, 0, 0], [9, 0, 0], [10, 1, 0]], atol=1e-12)
    # The mirrored copy keeps its outside outside.
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [5, 4, 3]])


def test_gltf_primitives_on_the_same_points_share_them(write):
    one = {"attributes": {"POSITION": 0}, "indices": 1, "material": 0}
    mesh = read_mesh(write("a.gltf", json.dumps(gltf_tree(meshes=[{"primitives": [one, one]}]))))
    assert (len(mesh.vertices), len(mesh.faces)) == (3, 2)


def test_gltf_sparse_and_morph_positions(write):
    tree = gltf_tree()
    raw = np.array([1], "<u2").tobytes() + b"\0\0" + np.array([0, 0, 5], "<f4").tobytes()
    tree["buffers"] += [{"byteLength": 16, "uri": "data:;base64," + base64.b64encode(raw).decode()}]
    tree["bufferViews"] += [
        {"buffer": 1, "byteLength": 2},
        {"buffer": 1, "byteOffset": 4, "byteLength": 12},
    ]
    sparse = {"count": 1, "indices": {"bufferView": 2, "componentType": 5123}, "values": {"bufferView": 3}}
    tree["accessors"] += [{"componentType": 5126, "count": 3, "type": "VEC3", "sparse": sparse}]
    tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 2}]
    tree["meshes"][0]["weights"] = [0.5]
    mesh = read_mesh(write("a.gltf", json.dumps(tree)))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 2.5], [0, 1, 0]])


def test_gltf_reads_buffers_beside_it_and_from_nowhere_else(write, tmp_path: Path):
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes() + bytes([0, 0, 1, 0, 2, 0])
    (tmp_path / "a b.bin").write_bytes(points)
    folder = tmp_path / "inner"
    folder.mkdir()
    (folder / "a b.bin").write_bytes(points)
    inner = folder / "a.gltf"
    inner.write_text(json.dumps(gltf_tree(buffers=[{"byteLength": 42, "uri": "a%20b.bin"}])))
    assert len(read_mesh(inner).vertices) == 3
    for uri in ("../a b.bin", str(tmp_path / "a b.bin"), "file:///etc/passwd", "http://127.0.0.1/a.bin"):
        inner.write_text(json.dumps(gltf_tree(buffers=[{"byteLength": 42, "uri": uri}])))
        with pytest.raises(FileFormatError, match="outside"):
            read_mesh(inner)
    inner.write_text(json.dumps(gltf_tree(buffers=[{"byteLength": 42, "uri": "gone.bin"}])))
    with pytest.raises(FileFormatError, match="missing"):
        read_mesh(inner)


@pytest.mark.parametrize(
    "change",
    [
        {"nodes": [{"mesh": 0, "children": [0]}]},
        {"nodes": [{"mesh": 7}]},
        {"accessors": [{"componentType": 5126, "count": 10**12, "type": "VEC3"}]},
        {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}]},
        {"asset": {"version": "1.0"}},
        {"asset": 3},
        {"extensionsRequired": ["KHR_draco_mesh_compression"]},
        {"scenes": [{"nodes": []}]},
        {"buffers": [{"byteLength": 10**12, "uri": "data:;base64,AAAA"}]},
        {"buffers": [{"byteLength": 42}]},
        {"buffers": [{"byteLength": 42, "uri": "data:;base64,A"}]},
        {"nodes": [{"mesh": 0, "scale": ["a", 1, 1]}]},
    ],
)
def test_gltf_that_contradicts_itself_is_refused(write, change: dict[str, object]):
    path = write("bad.gltf", json.dumps(gltf_tree(**change)))
    with pytest.raises(FileFormatError) as caught:
        read_mesh(path)
    assert one_sentence(caught.value, "bad.gltf")


# Bad input


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_missing_file_is_named(ending: str, tmp_path: Path):
    with pytest.raises(FileError, match="no such file") as caught:
        read_mesh(tmp_path / f"gone{ending}")
    assert one_sentence(caught.value, f"gone{ending}")


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b" \n\t\n",
        b"Dear reader, this is not a mesh.\n" * 9,
        bytes(200),
        bytes(range(256)) * 3,
        b"\xff\xfe<\x00?\x00x\x00m\x00l\x00",
        b"v",
        b"{}",
        b"[" * 100000,
        b"<" * 1000,
        b'{"asset": {"version": "2.0"}}',
    ],
)
def test_what_is_not_a_mesh_is_refused(ending: str, content: bytes, write):
    path = write(f"text{ending}", content)
    with pytest.raises(FileFormatError) as caught:
        read_mesh(path)
    assert one_sentence(caught.value, f"text{ending}")


@pytest.mark.parametrize("ending", [".ply", ".stl", ".vtk", ".vtp", ".glb", ".gltf", ".off"])
def test_a_file_cut_short_anywhere_is_refused(ending: str, tetrahedron: Mesh, tmp_path: Path):
    path = tmp_path / f"cut{ending}"
    write_mesh(path, tetrahedron)
    whole = path.read_bytes().rstrip()
    if ending == ".off":
        whole = whole.rpartition(b"\n")[0]
    # Up to the end of its points, a VTK file is a whole point cloud, so that one cut cannot be told.
    whole_cloud = (whole.find(b"\nPOLYGONS"), whole.find(b"\nPOLYGONS") + 1) if ending == ".vtk" else ()
    for length in (n for n in range(0, len(whole), 7) if n not in whole_cloud):
        path.write_bytes(whole[:length])
        with pytest.raises((FileError, MeshError)) as caught:
            read_mesh(path)
        assert one_sentence(caught.value, f"cut{ending}")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", ply_header("ascii", "element vertex 3", "property float x", "property float y", "property float z",
                             "element face 1", "property list uchar int vertex_indices")
                  + b"0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n"),
        ("a.vtk", b"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS 3 float\n0 0 0 1 0 0 0 1 0\n"
                  b"POLYGONS 1 4\n3 0 1 3\n"),
        ("a.gltf", json.dumps(gltf_tree(accessors=[
            {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"}])).encode()),
    ],
)  # fmt: skip
def test_faces_that_point_past_the_end_are_refused(write, name: str, content: bytes):
    with pytest.raises(MeshError, match="points at vertex") as caught:
        read_mesh(write(name, content))
    assert one_sentence(caught.value, name)


@pytest.mark.parametrize("index", ["0", "-9", "1.5", "x", "9" * 30, "9" * 5000])
def test_obj_indices_that_are_none_are_refused(write, index: str):
    with pytest.raises(ShapespaceError) as caught:
        read_mesh(write("a.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {index}\n"))
    assert one_sentence(caught.value, "a.obj")


@pytest.mark.parametrize("line", ["v 1 2", "v 1 2 z", "v", "f 1 2"])
def test_obj_lines_with_too_little_are_refused(write, line: str):
    with pytest.raises(FileFormatError):
        read_mesh(write("a.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{line}\n"))


TRILLION = 10**12


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *(
            ("a.ply", ply_header(form, f"element {element} {TRILLION}", *lines) + b"0 0 0\n")
            for form in ("ascii", "binary_little_endian")
            for element, lines in [
                ("vertex", ["property float x", "property float y", "property float z"]),
                ("face", ["property list uchar int vertex_indices"]),
                ("face", ["property list int int vertex_indices"]),
            ]
        ),
        ("a.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(50)),
        ("a.off", f"OFF\n{TRILLION} 0 0\n0 0 0\n".encode()),
        ("b.off", f"OFF\n1 {TRILLION} 0\n0 0 0\n".encode()),
        ("a.vtk", f"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS {TRILLION} float\n0 0 0\n".encode()),
        ("b.vtk", f"# vtk DataFile Version 3.0\nt\nBINARY\nDATASET POLYDATA\nPOINTS {TRILLION} float\n0 0 0".encode()),
        ("c.vtk", f"# vtk DataFile Version 3.0\nt\nBINARY\nDATASET POLYDATA\nPOINTS -{TRILLION} float\n0 0".encode()),
        ("a.vtp", f'<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="{TRILLION}"><Points>'
                  '<DataArray type="Float32" format="ascii">0 0 0</DataArray></Points></Piece></PolyData></VTKFile>'
                  .encode()),
        ("a.glb", b"glTF\2\0\0\0\xff\xff\xff\xff\xff\xff\xff\xffJSON{}"),
    ],
)  # fmt: skip
def test_a_header_that_declares_too_much_is_refused_before_allocation(write, name: str, content: bytes):
    path = write(name, content)
    with pytest.raises(FileFormatError) as caught:
        read_mesh(path)
    assert one_sentence(caught.value, name)


def test_a_ply_list_of_absurd_length_is_refused(write):
    header = ply_header(
        "binary_little_endian", "element vertex 1", "property float x", "property float y", "property float z",
        "element face 2", "property list uint int vertex_indices",
    )  # fmt: skip
    with pytest.raises(FileFormatError, match="cut short"):
        read_mesh(write("a.ply", header + bytes(12) + b"\xff\xff\xff\xff" + bytes(8)))


@pytest.mark.parametrize("name", ["scan.jpg", "scan", "scan.jpg.gz"])
def test_an_unknown_ending_is_refused_with_the_known_ones(name: str, tmp_path: Path, tetrahedron: Mesh):
    for act in (read_mesh, lambda path: write_mesh(path, tetrahedron)):
        with pytest.raises(FileFormatError, match=r"\.ply, \.obj") as caught:
            act(tmp_path / name)
        assert one_sentence(caught.value, name)


def test_a_folder_is_not_a_mesh(tmp_path: Path):
    (tmp_path / "a.ply").mkdir()
    with pytest.raises(FileError, match="folder"):
        read_mesh(tmp_path / "a.ply")


@pytest.mark.parametrize("place", ["file/out.ply", "gone/out.ply"])
def test_a_folder_that_cannot_be_written_is_named(place: str, tmp_path: Path, tetrahedron: Mesh):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FileError) as caught:
        write_mesh(tmp_path / place, tetrahedron)
    assert one_sentence(caught.value, "out.ply")


def test_a_full_disk_leaves_the_old_file_whole(tmp_path: Path, tetrahedron: Mesh, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "out.ply"
    write_mesh(path, tetrahedron)
    before = path.read_bytes()

    def full(self: Path, data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FileError, match="disk is full"):
        write_mesh(path, tetrahedron.with_vertices(tetrahedron.vertices * 2))
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["out.ply"]
