"""What looked like a mesh and was another one, and what was one and was refused."""

import gzip
import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hand_made import gltf_tree, vtk_5_1
from test_fuzz_readers import MESHES

from refusals import refusal_of
from shapespace.errors import InputError, ShapespaceError
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, MESH_FORMATS, read_mesh, write_mesh
from shapespace.types import Mesh

MARK = b"\xef\xbb\xbf"
BINARY = (".stl", ".glb", ".bnt")


refusal = partial(refusal_of, read_mesh)


def globe(size: float = 100.0) -> Mesh:
    """A closed surface of 2,562 vertices, `size` across."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4, radius=size / 2)
    return Mesh(ball.vertices, np.array(ball.faces, dtype=np.int32), name="globe")


@pytest.mark.parametrize("ending", MESH_ENDINGS)
def test_a_byte_order_mark_changes_nothing(ending: str, tmp_path: Path) -> None:
    taken = 0
    for data in MESHES[ending]:
        (tmp_path / f"a{ending}").write_bytes(data)
        (tmp_path / f"b{ending}").write_bytes(MARK + data.removeprefix(MARK))
        plain = read_mesh(tmp_path / f"a{ending}")
        try:
            marked = read_mesh(tmp_path / f"b{ending}")
        except ShapespaceError:
            assert ending in BINARY
            continue
        taken += 1
        np.testing.assert_array_equal(marked.vertices, plain.vertices)
        np.testing.assert_array_equal(marked.faces, plain.faces)
    assert taken == len(MESHES[ending]) or ending in BINARY


def test_a_byte_order_mark_before_ascii_stl_is_passed(write) -> None:
    ascii_stl = next(data for data in MESHES[".stl"] if data.startswith(b"solid"))
    assert len(read_mesh(write("a.stl", MARK + ascii_stl)).vertices) == 8


# glTF


@pytest.mark.parametrize("name", ["EXT_mesh_gpu_instancing", "ACME_curves", "KHR_draco_mesh_compression"])
def test_an_extension_that_is_required_and_not_known_is_refused(name: str, write) -> None:
    said = refusal(write("a.gltf", json.dumps(gltf_tree(extensionsRequired=["KHR_materials_unlit", name]))))
    assert name in said and "export it again without" in said


@pytest.mark.parametrize("name", ["KHR_materials_unlit", "KHR_texture_basisu", "KHR_mesh_quantization"])
def test_an_extension_that_moves_no_point_may_be_required(name: str, write) -> None:
    assert len(read_mesh(write("a.gltf", json.dumps(gltf_tree(extensionsRequired=[name])))).vertices) == 3


@pytest.mark.parametrize("which", [0, 1])
def test_an_array_without_data_is_refused(which: int, write) -> None:
    tree = gltf_tree()
    del tree["accessors"][which]["bufferView"]
    assert "no data" in refusal(write("a.gltf", json.dumps(tree)))
    tree["extensionsUsed"] = ["KHR_draco_mesh_compression"]
    assert "compressed (KHR_draco_mesh_compression)" in refusal(write("b.gltf", json.dumps(tree)))


def test_a_buffer_that_only_a_decoder_fills_is_refused(write) -> None:
    tree = gltf_tree(extensionsUsed=["EXT_meshopt_compression"])
    tree["buffers"] += [{"byteLength": 36, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}]
    tree["bufferViews"][0] = {"buffer": 1, "byteLength": 36}
    assert "compressed (EXT_meshopt_compression)" in refusal(write("a.gltf", json.dumps(tree)))


# STL


@pytest.mark.parametrize("away", [0.0, 1e4, 1e6])
def test_stl_is_written_where_float32_tells_the_vertices_apart(away: float, tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.stl", globe().with_vertices(globe().vertices + away))
    assert len(read_mesh(tmp_path / "a.stl").vertices) == 2562


def test_stl_that_would_merge_vertices_is_refused_with_their_number(tmp_path: Path) -> None:
    far = globe().with_vertices(globe().vertices + 3e8)
    with pytest.raises(InputError, match=r"merge its 2562 vertices into \d+; move it to the origin") as caught:
        write_mesh(tmp_path / "a.stl", far)
    assert str(caught.value).startswith("globe lies so far from the origin")
    assert not list(tmp_path.iterdir())


def test_a_few_vertices_that_nearly_touch_do_not_stop_stl(tmp_path: Path) -> None:
    ball = globe()
    vertices = ball.vertices.copy()
    vertices[ball.faces[0, 0]] = vertices[ball.faces[0, 1]] + 1e-9
    write_mesh(tmp_path / "a.stl", ball.with_vertices(vertices))
    assert len(read_mesh(tmp_path / "a.stl").vertices) == 2561


@pytest.mark.parametrize("tail", [b"", b"\0", b"made by a scanner"])
@pytest.mark.parametrize("head", [b"solid", b"solid facet", b"solid ascii facet normal vertex"])
def test_binary_stl_that_looks_like_text_is_read(head: bytes, tail: bytes, write) -> None:
    data = MESH_FORMATS[".stl"].write(globe())
    assert len(read_mesh(write("a.stl", head + data[len(head) :] + tail)).vertices) == 2562


# OFF and VTK


@pytest.mark.parametrize("keyword", ["OFF", "COFF", "NOFF", "CNOFF", "NCOFF", "STCNOFF"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_off_of_any_extras_is_read(keyword: str, mark: str, write) -> None:
    rows = "0 0 0 0 0 1 9 9 9 255\n1 0 0 0 0 1 9 9 9 255\n0 1 0 0 0 1 9 9 9 255\n"
    mesh = read_mesh(write("a.off", f"{mark}{keyword}\n3 1 0\n{rows}3 0 1 2\n"))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("newline", [b"\n", b"\r\n"])
def test_fields_of_text_bits_and_letters_are_passed_over(binary: bool, newline: bytes, write) -> None:
    data = vtk_5_1(binary=binary)
    mesh = read_mesh(write("a.vtk", data if binary else data.replace(b"\n", newline)))
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0.5]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2]])


@pytest.mark.parametrize("binary", [False, True])
def test_vtk_5_1_cut_short_is_refused(binary: bool, write) -> None:
    data = vtk_5_1(binary=binary).rstrip() if not binary else vtk_5_1(binary=binary)[:-1]
    # Up to the end of its points, and of what is told of them, a file is a whole point cloud; in text, 0.5 cut is 0.
    cloud = data.index(b"POLYGONS")
    told = data.index(b"METADATA", data.index(b"POINTS"))
    whole = {*range(told - 4, told + 1), cloud, cloud - 1}
    passed: list[int] = []
    for length in range(len(data)):
        try:
            found = read_mesh(write("a.vtk", data[:length]))
        except ShapespaceError:
            continue
        assert found.faces is None
        passed.append(length)
    assert set(passed) <= whole and passed


# gzip


@pytest.mark.parametrize("ending", MESH_ENDINGS)
@pytest.mark.parametrize("gz", ["", ".gz", ".GZ"])
def test_gzip_is_unpacked_and_not_taken_for_damage(ending: str, gz: str, write) -> None:
    plain = read_mesh(write(f"plain{ending}", MESHES[ending][0]))
    assert np.array_equal(plain.vertices, read_mesh(write(f"a{ending}{gz}", gzip.compress(MESHES[ending][0]))).vertices)
