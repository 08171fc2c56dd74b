"""What reading costs: memory and work grow with the bytes of a file, and small files cannot make much of them.

Each `FILES` is the worst that is known for its reader, at any length; most are files that no program writes.
"""

import base64
import gc
import json
import os
import signal
import struct
import sys
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hand_made import gltf_tree, ply_header

from shapespace.commands.look import check
from shapespace.errors import FileError, FileFormatError, ShapespaceError
from shapespace.io import read_limits as limits
from shapespace.io.files import sha256_of_file
from shapespace.io.landmarks import landmark_io as landmarks
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.landmark_io import LANDMARK_FORMATS, READ_ONLY_LANDMARKS, read_landmarks, write_landmarks
from shapespace.io.meshes import mesh_io as meshes
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, read_mesh, write_mesh
from shapespace.types import Mesh

MOST_FOR_A_BYTE = 100
"""Bytes of memory for each byte of the file, as docs/mesh-formats.md says."""
MOST_BESIDES = 2**28
MOST_STEPS_FOR_A_BYTE = 40
TO_BEGIN_WITH = 2**18
SMALL = 8_000
XYZ = [f"property float {axis}" for axis in "xyz"]
SHAPE = b"Shape { geometry IndexedFaceSet { coord Coordinate { point [ 0 0 0 ] } coordIndex [ 0 0 0 ] } }"


def repeated(one: bytes, size: int, head: bytes = b"", tail: bytes = b"") -> bytes:
    return head + one * (size // len(one)) + tail


def ply_ascii(size: int, row: bytes) -> bytes:
    count = size // len(row)
    head = ply_header("ascii", "element vertex 1", *XYZ, f"element face {count}", "property list int int vertex_index")
    return head + b"0 0 0\n" + row * count


def ply_fan(size: int) -> bytes:
    head = ply_header(
        "binary_little_endian", "element vertex 1", *XYZ, "element face 2", "property list uint uchar vertex_index"
    )
    return head + bytes(12) + struct.pack("<I", size) + bytes(size) + struct.pack("<I", 1) + b"\0"


def ply_elements(size: int) -> bytes:
    count = size // 40
    elements = ["element a 1", "property list uchar uchar b"] * count
    return ply_header("binary_little_endian", "element vertex 1", *XYZ, *elements) + bytes(12 + count)


def ply_faces(size: int) -> bytes:
    count = size // 60
    elements = ["element face 2", "property list uchar int vertex_index"] * count
    return ply_header("ascii", "element vertex 1", *XYZ, *elements) + b"0 0 0\n" + b"1 0\n2 0 0\n" * count


def vtk(body: Callable[[int], bytes], form: bytes = b"ASCII") -> Callable[[int], bytes]:
    points = b"POINTS 1 float\n" + (b"0 0 0" if form == b"ASCII" else bytes(12)) + b"\n"
    return lambda size: b"# vtk DataFile Version 3.0\nt\n" + form + b"\nDATASET POLYDATA\n" + points + body(size)


def vtk_cells(size: int) -> bytes:
    return b"POLYGONS %d %d\n" % (2 * (size // 10), 5 * (size // 10)) + b"1 0 2 0 0 " * (size // 10)


def vtp(pieces: bytes, attributes: bytes = b"", appended: bytes = b"") -> bytes:
    tail = b'<AppendedData encoding="raw">_' + appended + b"</AppendedData>" if appended else b""
    head = b'<VTKFile type="PolyData" ' + attributes + b"><PolyData>"
    return head + pieces + b"</PolyData>" + tail + b"</VTKFile>"


APPENDED = b"<Points><DataArray type='Float32' format='appended' offset='0'/></Points></Piece>"


def vtp_on_one_offset(size: int) -> bytes:
    points = bytes(size // 24 * 12)
    piece = b"<Piece NumberOfPoints='%d'>" % (len(points) // 12) + APPENDED
    return vtp(piece * (size // 2 // len(piece)), appended=struct.pack("<I", len(points)) + points)


def vtp_bomb(size: int) -> bytes:
    """Each thousand bytes hold a million zeros."""
    block = zlib.compress(bytes(960_000), 9)
    count = size // len(block) + 1
    head = struct.pack("<3I", count, 960_000, 0) + struct.pack("<I", len(block)) * count
    piece = b"<Piece NumberOfPoints='%d'>" % (80_000 * count) + APPENDED
    return vtp(piece, b"compressor='vtkZLibDataCompressor'", head + block * count)


def vtp_text(size: int) -> bytes:
    numbers = b"0 0 0 " * (size // 6)
    array = b"<DataArray type='Float32' format='ascii'>" + numbers + b"</DataArray>"
    return vtp(b"<Piece NumberOfPoints='%d'><Points>" % (size // 6) + array + b"</Points></Piece>")


def vrml_nested(size: int) -> bytes:
    """Half of the file nests transforms, the other half stands in all of them."""
    depth = min(size // 80, 490)
    inside = repeated(b"Coordinate{point[0 0 0]}", size // 2)
    return b"Transform{translation 1 0 0 children " * depth + inside + b"}" * depth


def pcd(size: int, data: bytes) -> bytes:
    n = size // 12
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary_compressed\n"
    return head.encode() + struct.pack("<II", len(data), 12 * n) + data


def pcd_runs(size: int) -> bytes:
    """A zero, and copies of it, three bytes for 264."""
    count = size // 3
    made = 12 * (264 * count // 12)
    last = made - 1 - 264 * (made // 264 - 1)
    rest, tail = divmod(last, 264)
    data = b"\0\0" + b"\xe0\xff\0" * (made // 264 - 1 + rest)
    return pcd(made, data + b"\0\0" * tail)


def pcd_ones(size: int) -> bytes:
    """Two bytes for one."""
    return pcd(12 * (size // 24), b"\0\0" * 12 * (size // 24))


def gltf(**changes: object) -> bytes:
    return json.dumps(gltf_tree(**changes), separators=(",", ":")).encode()


def big_gltf(size: int, **changes: object) -> bytes:
    """A buffer in half of the file, and whatever uses it again and again in the other."""
    count = size // 2 // 16
    raw = bytes(12 * count)
    uri = "data:;base64," + base64.b64encode(raw).decode()
    whole: dict[str, object] = {
        "buffers": [{"byteLength": len(raw), "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": len(raw)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}],
    }
    return gltf(**(whole | changes))


def gltf_nodes(size: int) -> bytes:
    count = size // 2 // 20
    return big_gltf(size, nodes=[{"mesh": 0}] * count, scenes=[{"nodes": [*range(count)]}])


def gltf_strips(size: int) -> bytes:
    strip = {"attributes": {"POSITION": 0}, "mode": 5}
    return big_gltf(size, meshes=[{"primitives": [strip] * (size // 2 // 45)}])


def gltf_targets(size: int) -> bytes:
    count = size // 2 // 20
    one = {"attributes": {"POSITION": 0}, "mode": 0, "targets": [{"POSITION": 0}] * count}
    return big_gltf(size, meshes=[{"primitives": [one], "weights": [1] * count}])


def gltf_indices(size: int) -> bytes:
    raw = bytes(size * 3 // 4)
    return gltf(
        buffers=[{"byteLength": len(raw), "uri": "data:;base64," + base64.b64encode(raw).decode()}],
        bufferViews=[{"buffer": 0, "byteLength": 12}, {"buffer": 0, "byteLength": len(raw)}],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "count": 1, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": len(raw), "type": "SCALAR"},
        ],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]}],
    )


def bnt(size: int) -> bytes:
    side = int((size / 40) ** 0.5)
    return struct.pack("<HHdHI", side, side, -1e9, 0, 5 * side * side) + bytes(40 * side * side)


FILES: dict[str, Callable[[int], bytes]] = {
    "points.obj": lambda size: repeated(b"v 0 0 0\n", size),
    "short.obj": lambda size: repeated(b"f\n", size, b"v 0 0 0\n"),
    "faces.obj": lambda size: repeated(b"f 1 1 1\n", size, b"v 0 0 0\n"),
    "polygon.obj": lambda size: b"v 0 0 0\nf" + b" 1" * (size // 2),
    "points.off": lambda size: repeated(b"0 0 0\n", size, b"OFF %d 0\n" % (size // 6)),
    "short.off": lambda size: repeated(b"1 0\n", size, b"OFF 1 %d\n0 0 0\n" % (size // 4)),
    "rest.off": lambda size: repeated(b"#\n0\n", size, b"OFF 1 0\n0 0 0\n"),
    "corners.stl": lambda size: repeated(b"facet\n" + b"vertex 0 0 0\n" * 3, size, b"solid\n", b"endsolid"),
    "lines.stl": lambda size: repeated(b"a\n", size, b"solid facet\n", b"endsolid"),
    "binary.stl": lambda size: bytes(80) + struct.pack("<I", size // 50) + bytes(size // 50 * 50),
    "grid.bnt": bnt,
    "same.ply": lambda size: ply_ascii(size, b"1 0\n"),
    "other.ply": lambda size: ply_ascii(size, b"0\n"),
    "fan.ply": ply_fan,
    "elements.ply": ply_elements,
    "faces.ply": ply_faces,
    "sections.vtk": vtk(lambda size: repeated(b"POLYGONS 0 0\n", size)),
    "packed.vtk": vtk(lambda size: repeated(b"POLYGONS 0 0\n", size), b"BINARY"),
    "fields.vtk": vtk(lambda size: repeated(b"FIELD a 1 b 1 0 int\n", size)),
    "cells.vtk": vtk(vtk_cells),
    "curves.vtk": vtk(lambda size: repeated(b"2 0 0\n", size, b"LINES %d %d\n" % (size // 6, size // 6 * 3))),
    "offset.vtp": vtp_on_one_offset,
    "bomb.vtp": vtp_bomb,
    "text.vtp": vtp_text,
    "elements.vtp": lambda size: vtp(repeated(b"<a/>", size)),
    "pieces.vtp": lambda size: vtp(repeated(b"<Piece NumberOfPoints='0'/>", size)),
    "nested.wrl": vrml_nested,
    "nodes.wrl": lambda size: repeated(b"a{}", size, SHAPE),
    "lists.wrl": lambda size: repeated(b"[]", size, SHAPE),
    "moves.wrl": lambda size: repeated(b"Transform{translation 1 0 0}", size, SHAPE),
    "words.wrl": lambda size: repeated(b"USE a ", size, SHAPE),
    "comments.wrl": lambda size: repeated(b"#\n", size, SHAPE),
    "open.wrl": lambda size: b"a [{" * (size // 200) + b"a " * (size // 3) + b"}]" * (size // 200),
    "nodes.gltf": gltf_nodes,
    "strips.gltf": gltf_strips,
    "targets.gltf": gltf_targets,
    "indices.gltf": gltf_indices,
    "json.gltf": lambda size: b'{"a":[' + b"[]," * (size // 3) + b"0]}",
    "chunks.glb": lambda size: struct.pack("<4s2I", b"glTF", 2, 12 + size // 8 * 8) + b"\0\0\0\0ABCD" * (size // 8),
    "many.xyz": lambda size: repeated(b"0 0 0\n", size),
    "counts.pts": lambda size: repeated(b"1\n0 0 0\n", size),
    "runs.pcd": pcd_runs,
    "ones.pcd": pcd_ones,
    "many.csv": lambda size: b"".join(b"a%d,0,0,0\n" % k for k in range(size // 14)),
    "many.bnd": lambda size: repeated(b"1 0 0 0\n", size),
    "many.lm3": lambda size: b"%d\n" % (size // 8) + b"a\n0 0 0\n" * (size // 8),
    "many.landmarkascii": lambda size: (
        b"# AmiraMesh 3D ASCII 2.0\ndefine Markers %d\nMarkers { float[3] Coordinates } @1\n@1\n" % (size // 6)
        + b"0 0 0\n" * (size // 6)
    ),
    "many.fcsv": lambda size: b"".join(b"%d,0,0,0\n" % k for k in range(size // 11)),
    "heads.fcsv": lambda size: repeated(b"#columns=x,y,z\n", size),
    "many.tps": lambda size: b"LM3=%d\n" % (size // 6) + b"0 0 0\n" * (size // 6),
    "many.tlms": lambda size: repeated(b"a 1 0 0 0\n", size),
    "many.txt": lambda size: repeated(b"0 0 0\n", size),
    "heads.pts": lambda size: repeated(b"{\n", size),
    "many.pp": lambda size: repeated(b'<point x="0" y="0" z="0"/>', size, b"<PickedPoints>", b"</PickedPoints>"),
    "many.json": lambda size: b"[" + b'{"id":"a","coordinates":[0,0,0]},' * (size // 33) + b"0]",
    "many.mrk.json": lambda size: (
        b'{"markups":[' + b'{"controlPoints":[{"id":"a","position":[0,0,0]}]},' * (size // 50) + b"0]}"
    ),
    "mask.ljson": lambda size: (
        b'{"version":2,"landmarks":{"points":[[0,0,0]]},"labels":[{"label":"a","mask":['
        + b"0," * (size // 2)
        + b"0]}]}"
    ),
}


def read(path: Path) -> object:
    if path.name == "curves.vtk":
        return read_configurations(path)
    ending = next(e for e in (*MESH_ENDINGS, *LANDMARK_FORMATS, *READ_ONLY_LANDMARKS) if path.name.endswith(e))
    try:
        return read_mesh(path) if ending in MESH_ENDINGS else read_landmarks(path)
    except ShapespaceError as error:
        return error


@pytest.fixture(autouse=True, scope="module")
def frozen() -> Iterator[None]:
    """Let the garbage collector leave out all that is imported, which it goes through otherwise for every file."""
    gc.freeze()
    yield
    gc.unfreeze()


def memory(path: Path) -> int:
    """Return the most bytes that reading takes at a time."""
    gc.collect()
    tracemalloc.start()
    try:
        read(path)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def work(path: Path) -> int:
    """Return how many lines of Python run in reading, and how many functions in C they call."""
    steps = 0

    def line(_: object, __: str, ___: object) -> Any:
        nonlocal steps
        steps += 1
        return line

    def call(_: object, event: str, __: object) -> None:
        nonlocal steps
        steps += event == "c_call"

    before = sys.gettrace()
    sys.settrace(line)
    sys.setprofile(call)
    try:
        read(path)
    finally:
        sys.setprofile(None)
        sys.settrace(before)
    return steps


@pytest.mark.parametrize("name", FILES)
def test_twice_the_bytes_take_twice_the_memory_and_work(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without what every file may take, so that small ones show what large ones do.
    monkeypatch.setattr(limits, "SPARE_BYTES", 0)
    monkeypatch.setattr("shapespace.io.parsing._BLOCK_BYTES", 2**10)
    path = tmp_path / name
    sizes, memories, works = [], [], []
    for size in (SMALL, 2 * SMALL):
        path.write_bytes(FILES[name](size))
        read(path)
        sizes.append(path.stat().st_size)
        memories.append(memory(path))
        works.append(work(path))
    growth = sizes[1] / sizes[0]
    assert works[1] <= 1.15 * growth * works[0] + 200
    assert works[1] <= MOST_STEPS_FOR_A_BYTE * sizes[1]
    assert memories[1] <= 1.15 * growth * memories[0] + 2**16
    assert memories[1] <= MOST_FOR_A_BYTE * sizes[1] + TO_BEGIN_WITH


def test_twice_the_materials_of_an_obj_take_twice_the_work(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image", reason="the extra 'report' is not installed")
    image.new("RGB", (2, 2), (200, 0, 0)).save(tmp_path / "p.png")
    path = tmp_path / "scan.obj"
    works = []
    for count in (400, 800):
        # Each spelling of the picture names the same file.
        names = [f".{'/' * (1 + k % 128)}{'./' * (k // 128)}p.png" for k in range(count)]
        (tmp_path / "scan.mtl").write_text("".join(f"newmtl {k}\nmap_Kd {name}\n" for k, name in enumerate(names)))
        rows = "".join(f"v 0 0 0\nusemtl {k}\nf {k + 1}/1 1/1 1/1\n" for k in range(count))
        path.write_text(f"mtllib scan.mtl\nvt 0.1 0.1\n{rows}")
        assert np.array_equal(read_mesh(path).colours, np.tile([200, 0, 0], (count, 1)))
        works.append(work(path))
    assert works[1] <= 2.3 * works[0]


def test_the_ceilings_are_those_that_are_documented() -> None:
    said = " ".join((Path(__file__).parents[2] / "docs" / "mesh-formats.md").read_text().split())
    for ceiling in (
        f"mesh files up to {limits.LARGEST_MESH_FILE_BYTES >> 30} GiB",
        f"landmark files up to {limits.LARGEST_LANDMARK_FILE_BYTES >> 20} MiB",
        f"{MOST_FOR_A_BYTE} bytes of memory per byte of the file plus {MOST_BESIDES >> 20} MiB",
        f"more than {limits.GROWTH} times their size and {limits.SPARE_BYTES >> 20} MiB",
        f"files of more than {limits.MOST_PARTS:,} parts",
    ):
        assert ceiling in said


def test_every_reader_has_a_costly_file() -> None:
    endings = {*MESH_ENDINGS, *LANDMARK_FORMATS, *READ_ONLY_LANDMARKS}
    assert {name[name.index(".") :] for name in FILES} == endings


@pytest.mark.parametrize("name", ["offset.vtp", "bomb.vtp", "strips.gltf", "nodes.gltf", "targets.gltf"])
def test_a_file_that_makes_much_of_little_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(FILES[name](600_000))
    error = read(path)
    assert isinstance(error, FileFormatError)
    assert f"expand to more than {limits.GROWTH} times" in str(error) and str(error).endswith(".")
    assert memory(path) < MOST_FOR_A_BYTE * path.stat().st_size + MOST_BESIDES


@pytest.mark.parametrize("name", ["sections.vtk", "fields.vtk", "elements.vtp", "nodes.wrl", "moves.wrl"])
def test_a_file_of_too_many_parts_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "MOST_PARTS", 200)
    monkeypatch.setattr("shapespace.io.parsing.MOST_PARTS", 200)
    path = tmp_path / name
    path.write_bytes(FILES[name](SMALL))
    assert "more than 200" in str(read(path))


@pytest.mark.parametrize("count", [5 * 10**7, 10**9, 10**18])
def test_gltf_without_data_is_refused_before_memory_is_taken(count: int, tmp_path: Path) -> None:
    path = tmp_path / "a.gltf"
    path.write_bytes(gltf(accessors=[{"componentType": 5126, "count": count, "type": "VEC3"}]))
    assert isinstance(read(path), FileFormatError)
    assert memory(path) < 2**20


def test_buffers_on_one_file_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "side.bin").write_bytes(bytes(2**20))
    count = 300
    path = tmp_path / "a.gltf"
    path.write_bytes(
        gltf(
            buffers=[{"byteLength": 12, "uri": "side.bin"}] * count,
            bufferViews=[{"buffer": k, "byteLength": 12} for k in range(count)],
            accessors=[{"bufferView": k, "componentType": 5126, "count": 1, "type": "VEC3"} for k in range(count)],
            meshes=[{"primitives": [{"attributes": {"POSITION": k}, "mode": 0} for k in range(count)]}],
        )
    )
    assert len(read_mesh(path).vertices) == count
    assert memory(path) < 2**23
    monkeypatch.setattr("shapespace.io.meshes.gltf_mesh.LARGEST_MESH_FILE_BYTES", 2**20)
    assert "too long" in str(read(path))


@pytest.fixture
def soon() -> Iterator[None]:
    """End what waits for ever."""

    def stop(*_: object) -> None:
        raise AssertionError("it waits")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(5)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("soon")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    for name, act in (("a.ply", read_mesh), ("a.csv", read_landmarks), ("a.bin", sha256_of_file)):
        os.mkfifo(tmp_path / name)
        with pytest.raises(FileError, match=r"pipe or a device, not a file; give a file\.$"):
            act(tmp_path / name)
    path = tmp_path / "a.gltf"
    path.write_bytes(gltf(buffers=[{"byteLength": 42, "uri": "a.bin"}]))
    assert "cannot be read or is too long" in str(read(path))


@pytest.mark.usefixtures("soon")
def test_a_device_is_refused() -> None:
    with pytest.raises(FileError, match="device"):
        sha256_of_file(Path("/dev/zero"))


def test_a_file_beyond_the_ceiling_is_not_read(tmp_path: Path) -> None:
    for name, act, most in (
        ("a.ply", read_mesh, limits.LARGEST_MESH_FILE_BYTES),
        ("a.csv", read_landmarks, limits.LARGEST_LANDMARK_FILE_BYTES),
    ):
        with (tmp_path / name).open("wb") as stream:
            stream.truncate(most + 1)
        with pytest.raises(FileError, match=f"is {most >> 20} MiB; decimate or split it first"):
            act(tmp_path / name)
        assert memory(tmp_path / name) < 2**20


def test_a_file_at_the_ceiling_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mesh(tmp_path / "a.ply", Mesh(np.eye(3)))
    write_landmarks(tmp_path / "a.csv", {"a": np.zeros(3)})
    for module, name, act, constant in (
        (meshes, "a.ply", read_mesh, "LARGEST_MESH_FILE_BYTES"),
        (landmarks, "a.csv", read_landmarks, "LARGEST_LANDMARK_FILE_BYTES"),
    ):
        size = (tmp_path / name).stat().st_size
        monkeypatch.setattr(module, constant, size)
        assert act(tmp_path / name)
        monkeypatch.setattr(module, constant, size - 1)
        with pytest.raises(FileError, match="the limit for such files is"):
            act(tmp_path / name)


def test_check_goes_on_after_files_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    box = Mesh(np.random.default_rng(0).normal(size=(9, 3)))
    for name in ("a.ply", "d.ply", "z.ply"):
        write_mesh(tmp_path / name, box)
    (tmp_path / "b.vtp").write_bytes(FILES["offset.vtp"](600_000))
    (tmp_path / "c.gltf").write_bytes(gltf(accessors=[{"componentType": 5126, "count": 10**9, "type": "VEC3"}]))
    (tmp_path / "e.ply.gz").write_bytes(b"\x1f\x8b")

    def short(path: Path) -> Mesh:
        if path.name == "d.ply":
            raise MemoryError
        return read_mesh(path)

    monkeypatch.setattr("shapespace.commands.look.read_mesh", short)
    said: list[str] = []
    reports = check([tmp_path], recursive=False, say=said.append).facts
    assert [report["usable"] for report in reports] == [True, False, False, False, False, True]
    assert all(str(tmp_path) in report["error"] for report in reports[1:5])
    assert "not enough memory" in reports[3]["error"] and "compressed data" in reports[4]["error"]
    assert not said
