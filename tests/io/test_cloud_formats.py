"""Point clouds of scanners: `.xyz`, `.pts`, `.pcd`, and any mesh packed by gzip."""

import gzip
import io
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hand_made import pcd

from refusals import refusal_of
from shapespace.commands.look import check
from shapespace.errors import FileFormatError
from shapespace.io import read_limits as limits
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, ending_of, mesh_files, probe_mesh, read_mesh, stem_of, write_mesh
from shapespace.types import Mesh

POINTS = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32).astype(np.float64)
NAN = float("nan")


refusal = partial(refusal_of, read_mesh)


def rows(*more: float, separator: str = " ") -> str:
    return "".join(separator.join(repr(float(v)) for v in (*point, *more)) + "\n" for point in POINTS)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.xyz", rows()),
        ("a.xyz", "\ufeff//X Y Z R G B\r\n" + rows(255, 0, 0).replace("\n", "\r\n")),
        ("a.xyz", "x,y,z,nx,ny,nz\n" + rows(0, 0, 1, separator=",")),
        ("a.xyz", "# a\n50\n" + rows(separator="; ")),
        ("a.pts", "50\r\n" + rows(-1200, 10, 20, 30)),
        ("a.PTS", rows(0.5)),
    ],
)
def test_rows_of_points_are_read_whatever_follows_them(name: str, text: str, write) -> None:
    found = read_mesh(write(name, text))
    assert found.faces is None
    np.testing.assert_array_equal(found.vertices, POINTS)


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("a.pts", "51\n" + rows(), "declares 51 points, but 50"),
        ("a.xyz", "1 2\n3 4\n", "three or more columns"),
        ("a.xyz", "1 2 3\n1 2 3 4\n", "not a table"),
        ("a.xyz", "3\nwater\nO 0 0 0.1\nH 0 0.7 -0.4\nH 0 -0.7 -0.4\n", "words next to"),
        ("a.xyz", "1\n\nO 0 0 0.1\n", "molecule"),
        ("a.xyz", "1 2 a\n1 2 3\n", "words next to"),
        ("a.xyz", "1 2 3\n1 2 a\n", "text where a number"),
        ("a.xyz", "a\0b", "binary"),
        ("a.xyz", "# nothing\n", "no rows"),
        ("a.pts", "version: 1\nn_points: 2\n{\n1 2\n3 4\n}\n", "not a table"),
    ],
)
def test_other_tables_are_refused(name: str, text: str, why: str, write) -> None:
    assert why in refusal(write(name, text))


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_pcd_is_read_without_the_points_that_are_not_there(data: str, write) -> None:
    np.testing.assert_array_equal(read_mesh(write("a.pcd", pcd(data, POINTS))).vertices, POINTS)
    holes = POINTS.copy()
    holes[3:8] = NAN
    found = read_mesh(write("b.pcd", pcd(data, holes, width=10)))
    np.testing.assert_array_equal(found.vertices, np.delete(POINTS, range(3, 8), axis=0))


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_cut_short_is_refused(data: str, write) -> None:
    whole = pcd(data, POINTS)
    for length in (10, len(whole) // 4, len(whole) - 30):
        refusal(write("a.pcd", whole[:length]))


@pytest.mark.parametrize(
    ("old", "new", "why"),
    [
        ("DATA binary", "DATA zip", "'zip'"), ("FIELDS x y", "FIELDS x a", "not define x, y and z"),
        ("SIZE 4 4", "SIZE 4 5", "unknown type"), ("POINTS 50", "POINTS 9999999", "9999999 points"),
        ("COUNT 1 1 2", "COUNT 1 1 999999999", "per point, too many"), ("POINTS 50", "POINTS x", "number of points"),
        ("COUNT 1 1", "COUNT 2 1", "more than once"), ("TYPE F F U", "TYPE F F F", "unknown type"),
        ("DATA binary\n", "", "no header that ends"), ("POINTS 50", "POINTS -1", "-1 points"),
    ],
)  # fmt: skip
def test_a_pcd_that_contradicts_itself_is_refused(old: str, new: str, why: str, write) -> None:
    assert why in refusal(write("a.pcd", pcd("binary", POINTS).replace(old.encode(), new.encode(), 1)))


@pytest.mark.parametrize("packed", [b"\xff", b"\x20\x05", b"\x1f" + bytes(3), b"\x00a" + b"\xe0\xff\x00" * 9])
def test_packed_data_that_are_wrong_are_refused(packed: bytes, write) -> None:
    whole = pcd("binary_compressed", POINTS)
    start = whole.index(b"binary_compressed\n") + 18
    size = whole[start + 4 : start + 8]
    assert "compressed data" in refusal(write("a.pcd", whole[:start] + struct.pack("<I", len(packed)) + size + packed))


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("a.las", "convert it to PLY."),
        ("a.LAZ", "convert it to PLY."),
        ("a.raw", "convert a mesh to PLY, a volume to NRRD or NIfTI."),
        ("a.raw.gz", "convert a mesh to PLY, a volume to NRRD or NIfTI."),
    ],
)
def test_a_scan_in_a_format_that_is_not_read_is_to_be_converted(name: str, advice: str, write) -> None:
    text = refusal(write(name, b"LASF"))
    assert "is not a mesh format" in text and text.endswith(advice)
    with pytest.raises(FileFormatError, match=advice):
        probe_mesh(write(name, b"LASF"))


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl", ".off", ".vtk", ".vtp", ".glb", ".gltf"])
def test_what_gzip_packed_is_the_mesh(ending: str, tmp_path: Path) -> None:
    mesh = Mesh(POINTS, np.arange(48, dtype=np.int32).reshape(-1, 3))
    write_mesh(tmp_path / f"a{ending}", mesh)
    plain = read_mesh(tmp_path / f"a{ending}")
    data = (tmp_path / f"a{ending}").read_bytes()
    (tmp_path / f"a{ending}.GZ").write_bytes(gzip.compress(data[:100]) + gzip.compress(data[100:]))
    (tmp_path / f"b{ending}").write_bytes(gzip.compress(data))  # as some programs name it
    for name in (f"a{ending}.GZ", f"b{ending}"):
        found = read_mesh(tmp_path / name)
        np.testing.assert_array_equal(found.vertices, plain.vertices)
        np.testing.assert_array_equal(np.asarray(found.faces), np.asarray(plain.faces))


def test_packed_scans_of_a_folder_are_taken(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.ply", Mesh(POINTS))
    (tmp_path / "b.xyz.gz").write_bytes(gzip.compress(rows().encode()))
    (tmp_path / "notes.txt.gz").write_bytes(gzip.compress(b"a"))
    found = mesh_files([tmp_path])
    assert [path.name for path in found.files] == ["a.ply", "b.xyz.gz"] and not found.left_out
    assert all(report["usable"] for report in check([tmp_path], recursive=False, say=print).facts)


def test_a_packed_scan_goes_by_the_name_of_what_is_packed() -> None:
    assert [stem_of(name) for name in ("a.ply", "x/a.b.ply.GZ", "a", "a.gz")] == ["a", "a.b", "a", "a"]
    assert [ending_of(name) for name in ("a.PLY", "a.ply.gz", "a.gz")] == [".ply", ".ply", ""]


def bomb(size: int) -> bytes:
    out = io.BytesIO()
    with gzip.GzipFile(fileobj=out, mode="wb") as stream:
        stream.write(b"0 0 0\n" * (size // 6))
    return out.getvalue()


def test_a_bomb_is_refused_before_it_is_unpacked(write, monkeypatch: pytest.MonkeyPatch) -> None:
    data = bomb(30_000_000)
    assert len(data) < 100_000
    assert "unpacks to more than" in refusal(write("a.xyz.gz", data))
    monkeypatch.setattr("shapespace.io.meshes.mesh_io.LARGEST_MESH_FILE_BYTES", 2000)
    assert "unpacks to more than" in refusal(write("b.xyz.gz", bomb(3000)))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.999])
def test_packed_data_cut_short_are_refused(share: float, write) -> None:
    data = gzip.compress(rows().encode())
    assert "compressed data" in refusal(write("a.xyz.gz", data[: int(share * len(data))]))
    broken = bytearray(data)
    broken[-6] ^= 1  # of the checksum
    assert "compressed data" in refusal(write("b.xyz.gz", bytes(broken)))


def test_small_files_may_be_packed_well(write) -> None:
    assert len(read_mesh(write("a.xyz.gz", bomb(60_000))).vertices) == 10_000
    assert limits.GROWTH * len(bomb(60_000)) < 60_000


def test_what_is_packed_by_nobody_is_read_as_it_is(write) -> None:
    np.testing.assert_array_equal(read_mesh(write("a.xyz.gz", rows())).vertices, POINTS)
    assert "is not a mesh format" in refusal(write("a.jpg.gz", gzip.compress(b"a")))
    assert "empty" in refusal(write("a.ply.gz", gzip.compress(b"")))
    assert {".xyz", ".pts", ".pcd"} <= set(MESH_ENDINGS)
