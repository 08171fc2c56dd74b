"""Colours of vertices and of pictures are read and written; what cannot be read leaves the surface, and says so."""

import base64
import io
import json
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hand_made import gltf_tree, ply_header

from shapespace.errors import MeshError
from shapespace.geometry.doctor import repair
from shapespace.io.files import read_bytes
from shapespace.io.meshes import textures
from shapespace.io.meshes.mesh_io import MESH_FORMATS, read_mesh, write_mesh
from shapespace.types import GREY, Mesh

Image = pytest.importorskip("PIL.Image", reason="the extra 'report' is not installed")

FACES = np.array([[0, 1, 2], [1, 3, 2]], dtype=np.int32)
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]])
COLOURS = np.array([[255, 0, 0], [0, 128, 3], [7, 0, 255], [254, 255, 1]], dtype=np.uint8)
PAINTED = Mesh(SQUARE, FACES, colours=COLOURS)
# Red above, blue below; the left half darker.
PIXELS = np.array([[[100, 0, 0], [200, 0, 0]], [[0, 0, 100], [0, 0, 200]]], dtype=np.uint8)
TEXTURED = (
    "mtllib the one.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE) + "v 9 9 9\n"
    "vt 0 0\nvt 1 0\nvt 0 1\nvt 1 1\nusemtl skin of face\nf 1/1 2/2 3/3\nf -4/-3 -2/-1 -3/-2\n"
)
COLOURED = [ending for ending in MESH_FORMATS if ending != ".stl"]


def picture(pixels: np.ndarray = PIXELS, kind: str = "PNG") -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, kind)
    return out.getvalue()


def folder_of(
    root: Path, obj: str = TEXTURED, mtl: str = "newmtl skin of face\nmap_Kd -s 1 1 1 p.png\n", png: bytes | None = None
) -> Path:
    (root / "the one.mtl").write_text(mtl)
    (root / "p.png").write_bytes(picture() if png is None else png)
    path = root / "scan.obj"
    path.write_text(obj)
    return path


def bomb(width: int, height: int) -> bytes:
    """Return a PNG that declares this size and holds next to nothing."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(bytes(64))) + chunk(b"IEND", b"")


@pytest.mark.parametrize("mesh", [PAINTED, Mesh(SQUARE, colours=COLOURS)], ids=["surface", "points"])
@pytest.mark.parametrize("ending", COLOURED)
def test_colours_come_back_as_they_were(ending: str, mesh: Mesh, tmp_path: Path) -> None:
    write_mesh(tmp_path / f"a{ending}", mesh)
    back = read_mesh(tmp_path / f"a{ending}")
    assert np.array_equal(back.colours, COLOURS) and np.array_equal(back.vertices, mesh.vertices)


@pytest.mark.parametrize("ending", COLOURED)
def test_every_shade_survives(ending: str, tmp_path: Path) -> None:
    shades = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    write_mesh(tmp_path / f"a{ending}", Mesh(np.random.default_rng(0).normal(size=(256, 3)), colours=shades))
    assert np.array_equal(read_mesh(tmp_path / f"a{ending}").colours, shades)


@pytest.mark.parametrize("ending", MESH_FORMATS)
def test_what_has_no_colours_is_written_without(ending: str, tmp_path: Path) -> None:
    write_mesh(tmp_path / f"a{ending}", Mesh(SQUARE, FACES))
    written = (tmp_path / f"a{ending}").read_bytes()
    assert not any(word in written for word in (b"red", b"RGB", b"COLOR", b"COFF"))
    assert read_mesh(tmp_path / f"a{ending}").colours is None


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_a_ply_of_trimesh_keeps_its_colours(encoding: str, tmp_path: Path) -> None:
    mesh = trimesh.Trimesh(SQUARE, FACES, vertex_colors=np.column_stack([COLOURS, [255] * 4]), process=False)
    path = tmp_path / "a.ply"
    path.write_bytes(mesh.export(file_type="ply", encoding=encoding))
    assert np.array_equal(read_mesh(path).colours, COLOURS)


@pytest.mark.parametrize(("kind", "values"), [("uchar", "1 0 1"), ("float", "0.0039216 0 0.0039216")])
def test_the_type_of_a_ply_says_what_white_is(kind: str, values: str, tmp_path: Path) -> None:
    names = [f"property float {axis}" for axis in "xyz"] + [f"property {kind} {c}" for c in ("red", "green", "blue")]
    (tmp_path / "a.ply").write_bytes(ply_header("ascii", "element vertex 1", *names) + f"0 0 0 {values}\n".encode())
    assert np.array_equal(read_mesh(tmp_path / "a.ply").colours, [[1, 0, 1]])


def test_vtk_reads_the_colours_of_text_files_among_other_attributes(tmp_path: Path) -> None:
    path = tmp_path / "a.vtk"
    path.write_text(
        "# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n0 0 0\n1 1 1\nPOINT_DATA 2\n"
        "NORMALS n float\n0 0 1\n0 0 1\nCOLOR_SCALARS c 4\n0 0.5 1 1\n1 1 0 1\n"
    )
    assert np.array_equal(read_mesh(path).colours, [[0, 128, 255], [255, 255, 0]])


@pytest.mark.parametrize(
    ("keyword", "row"),
    [("COFF", "0 0 0 255 0 9 255"), ("NCOFF", "0 0 0 0 0 1 255 0 9 255"), ("COFF", "0 0 0 1 0 .0353 1")],
)
def test_off_reads_colours_after_normals(keyword: str, row: str, tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text(f"{keyword}\n1 0 0\n{row}\n")
    assert np.array_equal(read_mesh(tmp_path / "a.off").colours, [[255, 0, 9]])


def test_an_obj_takes_the_colours_of_its_picture(tmp_path: Path) -> None:
    mesh = read_mesh(folder_of(tmp_path))
    blue, bright_blue, red, bright_red = [0, 0, 100], [0, 0, 200], [100, 0, 0], [200, 0, 0]
    assert np.array_equal(mesh.colours, [blue, bright_blue, red, bright_red, [GREY] * 3]) and mesh.notes == ()


def test_each_material_has_its_own_picture(tmp_path: Path) -> None:
    Image.fromarray(np.full((2, 2, 3), 77, dtype=np.uint8)).save(tmp_path / "q.png")
    obj = TEXTURED.replace("f -4/", "usemtl shirt\nf -4/")
    mesh = read_mesh(folder_of(tmp_path, obj, "newmtl skin of face\nmap_Kd p.png\nnewmtl shirt\nmap_Kd q.png\n"))
    assert np.array_equal(mesh.colours[3], [77] * 3) and np.array_equal(mesh.colours[2], [100, 0, 0])


@pytest.mark.parametrize(
    ("mtl", "png", "said"),
    [
        ("newmtl skin of face\nmap_Kd gone.png\n", None, "not in its folder"),
        ("newmtl skin of face\nmap_Kd \x1b[31m.png\n", None, "'?[31m.png' is not in its folder"),
        ("newmtl skin of face\nmap_Kd ../p.png\n", None, "outside its folder"),
        ("newmtl skin of face\nmap_Kd /etc/passwd\n", None, "outside its folder"),
        ("newmtl skin of face\nmap_Kd p.png\n", b"no picture", "damaged or has an unsupported format"),
        ("newmtl skin of face\nmap_Kd p.png\n", picture()[:45], "damaged or has an unsupported format"),
        ("newmtl skin of face\nmap_Kd p.png\n", bomb(8193, 8192), "pixels, too many"),
        ("newmtl skin of face\nmap_Kd p.png\n", bomb(2**30, 2**30), "damaged or has an unsupported format"),
    ],
    ids=["absent", "not printable", "above", "absolute", "no picture", "cut short", "too large", "bomb"],
)
def test_a_picture_that_cannot_be_read_is_a_note(mtl: str, png: bytes | None, said: str, tmp_path: Path) -> None:
    folder = tmp_path / "here"
    folder.mkdir()
    (tmp_path / "p.png").write_bytes(picture())
    mesh = read_mesh(folder_of(folder, mtl=mtl, png=png))
    assert mesh.colours is None and np.array_equal(mesh.vertices[:4], SQUARE)
    (note,) = mesh.notes
    assert said in note and note.endswith(".") and str(tmp_path) not in note


def test_without_the_materials_an_obj_is_read_with_a_note(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(TEXTURED)
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.colours is None and "its materials file 'the one.mtl' is not in its folder" in mesh.notes[0]


def test_materials_without_a_picture_say_nothing(tmp_path: Path) -> None:
    mesh = read_mesh(folder_of(tmp_path, mtl="newmtl skin of face\nKd 1 0 0\n"))
    assert mesh.colours is None and mesh.notes == ()


def test_without_pillow_a_note_says_what_to_install(tmp_path: Path) -> None:
    code = "import sys; sys.modules['PIL'] = None\nfrom shapespace.io.meshes.mesh_io import read_mesh\n"
    code += "print(read_mesh(sys.argv[1]).notes)"
    done = subprocess.run([sys.executable, "-c", code, folder_of(tmp_path)], capture_output=True, text=True, check=True)
    assert "pip install 'shapespace[report]'" in done.stdout


def test_pictures_of_one_surface_are_bounded_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(textures, "MOST_PIXELS_IN_ALL", 7)
    obj = TEXTURED.replace("f -4/", "usemtl shirt\nf -4/")
    (tmp_path / "q.png").write_bytes(picture())
    mesh = read_mesh(folder_of(tmp_path, obj, "newmtl skin of face\nmap_Kd p.png\nnewmtl shirt\nmap_Kd q.png\n"))
    assert mesh.colours is None and "'q.png' has 2 times 2 pixels, too many" in mesh.notes[0]


def test_a_picture_is_sampled_between_its_pixels() -> None:
    uv = np.array([[0.5, 0.75], [0.25, 0.5], [1.25, -0.25], [np.nan, 0.0]])
    shown = textures.Pictures().sampled("p", picture, uv)
    assert np.array_equal(shown, [[150, 0, 0], [50, 0, 50], [100, 0, 0], [0, 0, 100]])


@pytest.mark.parametrize("kind", ["file", "inside"])
def test_gltf_takes_the_colours_of_its_picture(kind: str, tmp_path: Path) -> None:
    (tmp_path / "p q.png").write_bytes(picture())
    uv = np.array([[0, 1], [1, 1], [0, 0]], "<f4").tobytes()
    tree = gltf_tree()
    inside = "data:image/png;base64," + base64.b64encode(picture()).decode()
    tree["buffers"].append({"byteLength": 24, "uri": "data:a;base64," + base64.b64encode(uv).decode()})
    tree["bufferViews"].append({"buffer": 1, "byteLength": 24})
    tree["accessors"].append({"bufferView": 2, "componentType": 5126, "count": 3, "type": "VEC2"})
    tree["meshes"][0]["primitives"][0] |= {"material": 0, "attributes": {"POSITION": 0, "TEXCOORD_0": 2}}
    tree |= {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "textures": [{"source": 0}]}
    tree["images"] = [{"uri": "p%20q.png" if kind == "file" else inside}]
    if kind == "inside":
        # Of a colour of vertices that points nowhere, the surface is read without.
        broken = json.loads(json.dumps(tree))
        broken["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 99
        (tmp_path / "b.gltf").write_text(json.dumps(broken))
        assert read_mesh(tmp_path / "b.gltf").colours is None
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    assert np.array_equal(read_mesh(tmp_path / "a.gltf").colours, [[0, 0, 100], [0, 0, 200], [100, 0, 0]])


def test_repair_keeps_each_vertex_in_its_colour() -> None:
    points = np.vstack([SQUARE, SQUARE[1:2], [[5.0, 5, 5]], [[np.nan, 0, 0]]])
    colours = np.vstack([COLOURS, [[1, 1, 1]], [[2, 2, 2]], [[3, 3, 3]]]).astype(np.uint8)
    mesh, _ = repair(Mesh(points, np.array([[0, 1, 2], [4, 3, 2]]), colours=colours, notes=("a.",)))
    where = [int(np.flatnonzero((point == SQUARE).all(axis=1))[0]) for point in mesh.vertices]
    assert np.array_equal(mesh.colours, COLOURS[where]) and mesh.notes == ("a.",)


def test_colours_that_do_not_fit_the_vertices_are_refused() -> None:
    for wrong in (COLOURS[:3], COLOURS.astype(np.int64), COLOURS[:, :2]):
        with pytest.raises(MeshError, match="colours must be"):
            Mesh(SQUARE, FACES, colours=wrong)
    with pytest.raises(ValueError):
        PAINTED.colours[0, 0] = 1
    assert np.array_equal(replace(PAINTED, name="b").with_vertices(2 * SQUARE).colours, COLOURS)


def test_a_materials_file_of_many_spellings_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder_of(tmp_path)
    (tmp_path / "below").mkdir()
    (tmp_path / "link.mtl").symlink_to(tmp_path / "the one.mtl")
    spelled = ["the one.mtl", "./the one.mtl", ".//the one.mtl", "below/../the one.mtl", ".\\the one.mtl", "link.mtl"]
    path.write_text("".join(f"mtllib {name}\n" for name in spelled) + TEXTURED)
    opened: list[str] = []

    def counted(file: Path, at_most: int | None = None) -> bytes:
        opened.append(file.name)
        return read_bytes(file, at_most)

    monkeypatch.setattr(textures, "read_bytes", counted)
    mesh = read_mesh(path)
    assert sorted(opened) == ["p.png", "the one.mtl"] and mesh.colours is not None and not mesh.notes


def test_files_of_materials_are_read_up_to_a_bound_in_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder_of(tmp_path)
    for name in ("a.mtl", "b.mtl"):
        (tmp_path / name).write_bytes(b"#" * (3 * 2**20))
    path.write_text("mtllib a.mtl\nmtllib b.mtl\n" + TEXTURED)
    mesh = read_mesh(path)
    assert mesh.colours is None and "materials file 'b.mtl' cannot be read" in mesh.notes[0]
    monkeypatch.setattr(textures, "MOST_NAMES", 2)
    path.write_text("".join(f"mtllib {'./' * k}the one.mtl\n" for k in range(3)) + TEXTURED)
    assert "names more than 2 files" in read_mesh(path).notes[0]
