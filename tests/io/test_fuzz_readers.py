"""Every reader on valid files that were damaged: a mesh or landmarks, or one sentence; in bounded memory and time.

`SHAPESPACE_FUZZ_MINUTES=60 pytest tests/io/test_fuzz_readers.py` goes on for an hour, each run from other seeds.
A new reader needs an entry in `MESHES` or `LANDMARKS`; what was found by a long run belongs into `FOUND`.
"""

import base64
import gzip
import json
import os
import re
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hand_made import BND, FACE, FCSV, LM3, NONE, TPS, bnt, gltf_tree, pcd, vtk_5_1, vtp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shapespace.errors import ShapespaceError
from shapespace.io.landmarks.configuration_io import read_configurations
from shapespace.io.landmarks.landmark_io import (
    LANDMARK_FORMATS,
    READ_ONLY_LANDMARKS,
    read_landmark_indices,
    read_landmarks,
)
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, MESH_FORMATS, read_mesh
from shapespace.types import Mesh

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded by what Linux tells of a process")
MINUTES = float(os.environ.get("SHAPESPACE_FUZZ_MINUTES", "0"))
EXAMPLES = 300
EXAMPLES_OF_ROWS = 100
ROWS = (".fcsv", ".tps", ".tlms", ".txt", ".pts", ".xyz", ".gz")
"""Formats of rows of numbers under a short head, where less can go wrong."""
MOST_MEMORY = 2**29
MOST_CPU_S = 5.0

SURFACE = Mesh(
    np.random.default_rng(1).normal(size=(5, 3)), np.array([[0, 1, 2], [1, 2, 3], [2, 3, 4]], dtype=np.int32)
)
CLOUD = Mesh(SURFACE.vertices)
PAINTED = replace(SURFACE, colours=np.arange(15, dtype=np.uint8).reshape(5, 3))
MARKS = {"nose tip": np.array([0.1, 1 / 3, -2e-7]), 'left "eye"': np.array([1e6 / 7, -0.0, 3.0])}
MOVED = f"Transform {{ rotation 0 0 1 .5 scale 1 -1 2 children [ {FACE} ] }} DEF a {FACE} Group {{ USE b }}"
VRML_1 = (
    "#VRML V1.0 ascii\nSeparator { Coordinate3 { point [ 0 0 0, 1 0 0, 0 1 0 ] } "
    "IndexedFaceSet { coordIndex [ 0, 1, 2, -1 ] } }"
)
MORPHED = gltf_tree(
    meshes=[
        {
            "primitives": [{"attributes": {"POSITION": 0}, "mode": 5, "targets": [{"POSITION": 0}]}],
            "weights": [0.5],
        }
    ],
    nodes=[{"mesh": 0, "rotation": [0, 0, 0, 1], "scale": [1, 1, 2], "children": [1]}, {"mesh": 0}],
    extensionsUsed=["KHR_mesh_quantization"],
    extensionsRequired=["KHR_mesh_quantization"],
)
SLICER = {
    "markups": [
        {
            "coordinateSystem": "RAS",
            "controlPoints": [{"label": "a", "position": [1, 2, 3]}, {"id": "2", "position": [0, 0, 1]}],
        }
    ]
}
LJSON_1 = {"version": 1, "groups": [{"label": "a", "landmarks": [{"point": [0, 1, 2]}, {"point": [None, None, None]}]}]}
OBJ = "v 0 0 0 1 1 1\nv 1 0 0\n\nv 0 1 0\nv 0 0 1 # c\nvt 0 0\nf 1/1 2/1 3//1\nf -4 \\\n -3 -2 -1\nusemtl a\n"
OFF = "NCOFF # c\n4 2 0\n0 0 0 255\n1 0 0 255\n\n1 1 0 255\n0 1 0 255\n4 0 1 2 3 255 0 0\n3 0 1 2\n"
PLY = trimesh.creation.box().export(file_type="ply", encoding="ascii")
PAINTED_PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n0 0 0 255 0 9\n1 0 0 0 9 255\n"
)
PAINTED_VTK = (
    b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 2 float\n0 0 0\n1 1 1\nPOINT_DATA 2\n"
    b"NORMALS n float\n0 0 1\n0 0 1\nFIELD f 1\nw 1 2 float\n0 1\nCOLOR_SCALARS c 4\n0 0.5 1 1\n1 1 0 1\n"
)
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000002000000020802000000fdd49a73000000164944415478"
    "9c6348616038c1c0c0c0c090c2c07002000f4a02598111cca80000000049454e44ae426082"
)
TEXTURED = (
    b"mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\nf -3/-3 -2/-2 -1/-1\n"
)
MATERIALS = b"newmtl a\nmap_Kd a.png\n"
TEXTURED_GLTF = gltf_tree(
    meshes=[{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 0, "TEXCOORD_1": 2}, "material": 0}]}],
    accessors=[
        *gltf_tree()["accessors"],  # type: ignore[misc]
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC2"},
    ],
    materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}],
    textures=[{"source": 0}],
    images=[{"uri": "data:image/png;base64," + base64.b64encode(PNG).decode()}],
)
LISTS = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 2\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2 2 .5 .5\n4 0 1 2 3 0\n"
)


CURVES: dict[str, list[bytes]] = {
    ".vtk": [
        b"# vtk DataFile Version 3.0\na\nASCII\nDATASET POLYDATA\nPOINTS 5 float\n0 0 0 1 0 0 1 1 0 0 1 0 2 2 2\n"
        b"LINES 4 13\n2 0 1\n2 2 1\n3 2 3 0\n2 3 4\n"
    ],
    ".vtp": [
        b"<VTKFile type='PolyData'><PolyData><Piece NumberOfPoints='3'><Points>"
        b"<DataArray type='Float32' format='ascii'>0 0 0 1 0 0 1 1 0</DataArray></Points>"
        b"<Lines><DataArray type='Int64' Name='connectivity' format='ascii'>"
        b"0 1 1 2 0</DataArray><DataArray type='Int64' Name='offsets' format='ascii'>2 5</DataArray></Lines></Piece>"
        b"</PolyData></VTKFile>"
    ],
    ".tps": [
        b"LM=1\n1 2\nCURVES=1\nPOINTS=2\n1 2\n3 4\nOUTLINES=1\nPOINTS=4\n0 0\n1 0\n1 1\n0 0\nID=a\n"
        b"LM=1\n1 2\nCURVES=1\nPOINTS=3\n1 2\n3 4\nNA NA\nOUTLINES=1\nPOINTS=3\n0 0\n1 0\n1 1\nID=b\n"
    ],
    ".mrk.json": [
        json.dumps({"markups": [{"type": kind, "controlPoints": [
            {"label": f"{kind}-{k}", "position": [k, k * k, 1]} for k in range(4)
        ]} for kind in ("Fiducial", "Curve", "ClosedCurve")]}).encode()
    ],
}  # fmt: skip


def written(mesh: Mesh, ending: str) -> list[bytes]:
    """Return `mesh` as we write it, where we do."""
    return [MESH_FORMATS[ending].write(mesh)] if ending in MESH_FORMATS else []


def marked(ending: str) -> list[bytes]:
    return [LANDMARK_FORMATS[ending].write(MARKS).encode()]


MESHES: dict[str, list[bytes]] = {
    ".ply": [*written(SURFACE, ".ply"), *written(PAINTED, ".ply"), PAINTED_PLY, PLY, LISTS],
    ".obj": [
        *written(SURFACE, ".obj"),
        *written(PAINTED, ".obj"),
        OBJ.encode(),
        b"\xef\xbb\xbf" + OBJ.replace("\n", "\r\n").encode(),
    ],
    ".stl": [*written(SURFACE, ".stl"), trimesh.creation.box().export(file_type="stl_ascii").encode()],
    ".off": [*written(SURFACE, ".off"), *written(PAINTED, ".off"), OFF.encode()],
    ".vtk": [
        *written(SURFACE, ".vtk"),
        *written(CLOUD, ".vtk"),
        *written(PAINTED, ".vtk"),
        PAINTED_VTK,
        vtk_5_1(binary=True),
        vtk_5_1(binary=False),
    ],
    ".vtp": [
        *written(SURFACE, ".vtp"),
        *written(PAINTED, ".vtp"),
        *(
            vtp(form, packed, order, header)
            for form, packed, order, header in [
                ("raw", True, "<", "UInt32"),
                ("appended", False, ">", "UInt64"),
                ("appended", True, "<", "UInt64"),
                ("ascii", False, "<", "UInt32"),
                ("inline", True, "<", "UInt32"),
            ]
        ),
    ],
    ".glb": [*written(SURFACE, ".glb"), *written(PAINTED, ".glb"), *written(CLOUD, ".glb")],
    ".gltf": [
        *written(SURFACE, ".gltf"),
        *written(PAINTED, ".gltf"),
        json.dumps(TEXTURED_GLTF).encode(),
        json.dumps(gltf_tree()).encode(),
        json.dumps(MORPHED).encode(),
    ],
    ".wrl": [FACE.encode(), MOVED.encode(), VRML_1.encode()],
    ".xyz": [b"//X Y Z R\n0 0 0 255\n1 0.5 -1e3 0\n", b"2\n1,2,3\n4;5;6\n"],
    ".pts": [b"3\n1 2 3 -700 1 2 3\n4 5 6 0 0 0 0\n7 8 9 0 0 0 0\n"],
    ".pcd": [pcd(form) for form in ("ascii", "binary", "binary_compressed")],
    ".bnt": [bnt(np.where(np.arange(12.0) == 5, NONE, np.arange(12.0)).reshape(3, 4), name=b"a")],
}
LANDMARKS: dict[str, list[bytes]] = {
    ".ljson": [*marked(".ljson"), json.dumps(LJSON_1).encode()],
    ".pp": marked(".pp"),
    ".mrk.json": [*marked(".mrk.json"), json.dumps(SLICER).encode()],
    ".json": [*marked(".json"), *marked(".ljson"), json.dumps(SLICER).encode()],
    ".csv": [*marked(".csv"), b'# c\na,1,2,3\n"b, c",4,5,6\n'],
    ".bnd": [BND.encode()],
    ".lm3": [LM3.encode()],
    ".fcsv": [*marked(".fcsv"), FCSV.encode()],
    ".landmarkascii": [
        b"# AmiraMesh 3D ASCII 2.0\ndefine Markers 2\nMarkers { float[3] Coordinates } @1\n@1\n1 2 3\n4 5 6\n"
    ],
    ".tps": [TPS.encode()],
    ".tlms": [b"nose 1 1.5 -2 3\nchin 0 0 0 0\near_left 1 1e3 0 2\n"],
    ".txt": [b"# c\nname x y z\nnose 1 2 3\nchin 4,5,6\n", b"1 2 3\n4 5 6\n"],
    ".pts": [b"Version 1.0\n2\nS000 1 2 3\nS001 4 5 6\n", b"version: 1\nn_points: 1\n{\n0.5 1 2\n}\n"],
}
NO_DATA = gltf_tree(accessors=[{"componentType": 5126, "count": 5 * 10**7, "type": "VEC3"}])
LONG_LABEL = {"landmarks": {"points": [[0, 1, 2]] * 9}, "labels": [{"label": "a" * 10**6, "mask": [*range(9)]}]}
FOUND: list[tuple[str, bytes]] = [
    (".gltf", json.dumps(NO_DATA).encode()),
    (".ljson", json.dumps({"version": 2, **LONG_LABEL}).encode()),
    (".gltf", json.dumps(gltf_tree(buffers=[{"byteLength": 42, "uri": "dat`:" + "a" * 5000}])).encode()),
]

NUMBERS = [
    *b"-1 0 1.5 1e999 nan 1e-320 4294967295 99999999999 0x7f 1_0 null {} [] true".split(),
    b"9" * 25,
    b"9" * 5000,
]
PATCHES = [b"", bytes(4), b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x80", b"\n", b"\r\n", *(b"%c" % c for c in b' "[{]#')]
NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
TOKEN = re.compile(rb"[^\s,]+")
PLACES = st.integers(0, 10**6)
EDITS = st.one_of(
    st.tuples(st.just("flip"), PLACES, st.integers(0, 7)),
    st.tuples(st.just("write"), PLACES, st.one_of(st.sampled_from(PATCHES), st.binary(max_size=6))),
    st.tuples(st.just("drop"), PLACES, st.integers(1, 40)),
    st.tuples(st.just("number"), PLACES, st.sampled_from(NUMBERS)),
    st.tuples(st.just("token"), PLACES, st.integers(1, 3)),
    st.tuples(st.just("repeat"), PLACES, st.integers(1, 200)),
    st.tuples(st.just("cut"), PLACES, st.just(0)),
)  # fmt: skip


def edited(data: bytes, kind: str, place: int, what: int | bytes) -> bytes:
    """Return `data` with one kind of damage at about `place`."""
    at = place % max(len(data), 1)
    if isinstance(what, bytes):
        if kind == "write":
            return data[:at] + what + data[at + len(what) :]
        found = list(NUMBER.finditer(data))
        if not found:
            return data
        one = found[place % len(found)]
        return data[: one.start()] + what + data[one.end() :]
    if kind == "flip" and data:
        return data[:at] + bytes([data[at] ^ (1 << what)]) + data[at + 1 :]
    if kind == "drop":
        return data[:at] + data[at + what :]
    if kind == "repeat":
        return data[:at] + data[at : at + 30] * what + data[at + 30 :]
    if kind == "token" and (found := list(TOKEN.finditer(data))):
        one = found[place % len(found)]
        return data[: one.end()] + (b" " + one[0]) * what + data[one.end() :]
    return data[:at] if kind == "cut" else data


class HungError(BaseException):
    """A reader took too long; not an Exception, so that no reader catches it."""


@contextmanager
def held() -> Iterator[None]:
    """Let what runs within take neither much memory nor long."""
    import resource

    def stop(*_: object) -> None:
        raise HungError(f"no answer after {MOST_CPU_S} s")

    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = taken + MOST_MEMORY
    before = signal.signal(signal.SIGVTALRM, stop)
    resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(soft, most), hard))
    signal.setitimer(signal.ITIMER_VIRTUAL, MOST_CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def judge(read: Callable[[Path], object], path: Path, data: bytes) -> None:
    """Read `data` and let nothing pass but a result that holds together, or one sentence that names the file."""
    path.write_bytes(data)
    try:
        with held():
            found = read(path)
    except ShapespaceError as error:
        said = str(error)
        assert path.name in said and said.endswith(".") and "\n" not in said and len(said) < 800
        return
    if isinstance(found, Mesh):
        assert found.vertices.dtype == np.float64 and found.vertices.shape[1] == 3
        assert found.faces is None or 0 <= found.faces.min() <= found.faces.max() < len(found.vertices)
    else:
        assert isinstance(found, dict) and (found or read is read_landmark_indices)
        assert all(np.isfinite(point).all() for point in found.values())


def fuzz(read: Callable[[Path], object], path: Path, samples: list[bytes]) -> None:
    """Damage `samples` in many ways, for a share of `MINUTES` where these are given."""
    readers = len(MESHES) + len(LANDMARKS) + 1

    @settings(
        max_examples=EXAMPLES_OF_ROWS if path.suffix in ROWS else EXAMPLES,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        derandomize=not MINUTES,
        database=None,
    )
    @given(
        sample=st.one_of(st.sampled_from(samples), st.binary(max_size=300)),
        edits=st.lists(EDITS, max_size=5),
    )
    def once(sample: bytes, edits: list[tuple[str, int, int | bytes]]) -> None:
        for kind, place, what in edits:
            sample = edited(sample, kind, place, what)
        judge(read, path, sample)

    ends = time.monotonic() + 60 * MINUTES / readers
    once()
    while time.monotonic() < ends:
        once()


@pytest.mark.parametrize("ending", MESHES)
def test_a_damaged_mesh_file_is_a_mesh_or_one_sentence(ending: str, tmp_path: Path) -> None:
    fuzz(read_mesh, tmp_path / f"bad{ending}", MESHES[ending])


@pytest.mark.parametrize("ending", [".vtk", ".vtp", ".tps", ".mrk.json"])
def test_a_damaged_file_of_curves_is_curves_or_one_sentence(ending: str, tmp_path: Path) -> None:
    def read(path: Path) -> dict[str, np.ndarray]:
        found = read_configurations(path)
        assert all(0 <= k < found.points.shape[1] for at, _ in found.curves for k in at)
        return dict.fromkeys(found.landmarks, np.zeros(3))

    fuzz(read, tmp_path / f"a{ending}", CURVES[ending])


def test_a_damaged_packed_file_is_a_mesh_or_one_sentence(tmp_path: Path) -> None:
    fuzz(read_mesh, tmp_path / "bad.xyz.gz", [gzip.compress(data, mtime=0) for data in MESHES[".xyz"]])


@pytest.mark.parametrize("damaged", ["a.obj", "a.mtl", "a.png"])
def test_a_damaged_texture_leaves_a_mesh_or_one_sentence(damaged: str, tmp_path: Path) -> None:
    whole = {"a.obj": TEXTURED, "a.mtl": MATERIALS, "a.png": PNG}
    for name, data in whole.items():
        (tmp_path / name).write_bytes(data)
    assert read_mesh(tmp_path / "a.obj").colours is not None
    scan = tmp_path / "a.obj"

    def read(path: Path) -> Mesh:
        mesh = read_mesh(scan)
        assert damaged == "a.obj" or len(mesh.vertices) == 3
        assert all(note.endswith(".") and "\n" not in note for note in mesh.notes)
        return mesh

    fuzz(read, tmp_path / damaged, [whole[damaged]])


@pytest.mark.parametrize("ending", LANDMARKS)
def test_a_damaged_landmark_file_is_landmarks_or_one_sentence(ending: str, tmp_path: Path) -> None:
    fuzz(read_landmarks, tmp_path / f"bad{ending}", LANDMARKS[ending])


def test_damaged_vertex_numbers_are_numbers_or_one_sentence(tmp_path: Path) -> None:
    fuzz(read_landmark_indices, tmp_path / "bad.csv", [b"name,vertex\nnose,12\nchin,7\n# c\n"])


def test_every_reader_has_a_fuzzer() -> None:
    assert set(MESHES) == set(MESH_ENDINGS)
    assert set(LANDMARKS) == {*LANDMARK_FORMATS, *READ_ONLY_LANDMARKS}


@pytest.mark.parametrize(
    ("read", "ending"),
    [*((read_mesh, ending) for ending in MESHES), *((read_landmarks, ending) for ending in LANDMARKS)],
)
def test_what_is_damaged_was_whole(read: Callable[[Path], object], ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"good{ending}"
    for data in (MESHES if read is read_mesh else LANDMARKS)[ending]:
        path.write_bytes(data)
        assert read(path)


@pytest.mark.parametrize("which", range(len(FOUND)))
def test_what_was_found_stays_mended(which: int, tmp_path: Path) -> None:
    ending, data = FOUND[which]
    judge(read_mesh if ending in MESHES else read_landmarks, tmp_path / f"bad{ending}", data)


def test_a_reader_that_hangs_or_takes_much_is_noticed(tmp_path: Path) -> None:
    def hang(path: Path) -> Mesh:
        while True:
            pass

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("test_fuzz_readers.MOST_CPU_S", 0.05)
        with pytest.raises(HungError):
            judge(hang, tmp_path / "a.ply", b"")
    with pytest.raises(MemoryError):
        judge(lambda path: np.ones(2 * MOST_MEMORY // 8), tmp_path / "a.ply", b"")
