"""Small whole files of many formats, as other programs write them, from the documented layouts."""

import base64
import struct
import zlib

import numpy as np


def ply_header(form: str, *lines: str) -> bytes:
    return "\n".join(["ply", f"format {form} 1.0", "comment made by hand", *lines, "end_header", ""]).encode()


POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]])


def vtp(form: str, compressed: bool, order: str, header: str) -> bytes:
    """A quad and a triangle as VTK's own writer would encode them."""
    word = order + {"UInt32": "u4", "UInt64": "u8"}[header]
    appended = b""

    def array(name: str, kind: str, values: object) -> bytes:
        nonlocal appended
        data = np.asarray(values).astype(order + {"Float64": "f8", "Int64": "i8"}[kind]).tobytes()
        tag = f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="1" format='.encode()
        if form == "ascii":
            return tag + b'"ascii">\n' + " ".join(map(str, np.ravel(values))).encode() + b"\n</DataArray>"
        if compressed:
            blocks = [data[i : i + 40] for i in range(0, len(data), 40)]
            packed = [zlib.compress(block) for block in blocks]
            sizes = [len(blocks), 40, len(data) % 40, *map(len, packed)]
            head, body = np.array(sizes, word).tobytes(), b"".join(packed)
        else:
            head, body = np.array([len(data)], word).tobytes(), data
        if form == "raw":
            whole = head + body
        elif compressed:
            whole = base64.b64encode(head) + base64.b64encode(body)
        else:
            whole = base64.b64encode(head + body)
        if form == "inline":
            return tag + b'"binary">\n  ' + whole + b"\n</DataArray>"
        offset = len(appended)
        appended += whole
        return tag + f'"appended" offset="{offset}"/>'.encode()

    out = f'<?xml version="1.0"?><VTKFile type="PolyData" header_type="{header}" byte_order='.encode()
    out += b'"LittleEndian"' if order == "<" else b'"BigEndian"'
    out += b' compressor="vtkZLibDataCompressor"' if compressed else b""
    out += b'><PolyData><Piece NumberOfPoints="4"><PointData>' + array("s", "Float64", [1, 2, 3, 4])
    out += b"</PointData><Points>" + array("Points", "Float64", POINTS) + b"</Points><Polys>"
    out += array("connectivity", "Int64", [0, 1, 2, 3, 1, 2, 3]) + array("offsets", "Int64", [4, 7])
    out += b"</Polys></Piece></PolyData>"
    if appended:
        encoding = b"raw" if form == "raw" else b"base64"
        out += b'<AppendedData encoding="' + encoding + b'">\n _' + appended + b"\n</AppendedData>"
    return out + b"</VTKFile>"


def gltf_tree(**changes: object) -> dict[str, object]:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    indices = np.array([0, 1, 2], "<u2").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(points + indices).decode()
    tree: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 6},
        ],
        "buffers": [{"byteLength": 42, "uri": uri}],
    }
    return tree | changes


# As BU-3DFE writes it: no comma after the last point, every face closed, texture parts after the shape.
FACE = """#VRML V2.0 utf8
Shape {
 appearance Appearance {
  texture ImageTexture { url "F0001_AN01WH_F3D.bmp" }
 }
 geometry IndexedFaceSet {
  coord Coordinate {
   point [
    -1.5 0.25 3.000001,
    1 0 0,
    1.0e0 +1 0,
    0 1 -.5
   ]
  }
  coordIndex [
   0, 1, 2, -1,
   0, 2, 3, -1
  ]
  texCoord TextureCoordinate {
   point [
    0.1 0.2,
    0.3 0.4
   ]
  }
  texCoordIndex [
   0, 1, 1, -1,
   0, 1, 0, -1
  ]
 }
}
"""

NONE = -1e9


def bnt(depth: np.ndarray, step: float = 1.0, name: bytes = b"bs000_N_N_0.png", downwards: bool = False) -> bytes:
    """Write a grid byte by byte: rows upwards (or downwards), x and y missing too where the depth is."""
    rows, columns = depth.shape
    y, x = np.mgrid[0:rows, 0:columns] * step
    x, y = (np.where(depth == NONE, NONE, value) for value in (x, -y if downwards else y))
    out = struct.pack("<H", rows) + struct.pack("<H", columns) + struct.pack("<d", NONE)
    out += struct.pack("<H", len(name)) + name + struct.pack("<I", 5 * rows * columns)
    for run in (x, y, depth, x / 100, y / 100):
        out += b"".join(struct.pack("<d", value) for value in run.ravel())
    return out


BND = "1123\t\t-34.11 20.5 80.25\n1200 -3.0e1 21 81\n0 1 2 3\n"


def lzf(data: bytes) -> bytes:
    """Literal runs, and copies of four bytes before where the data repeat, as liblzf writes them."""
    out, at = bytearray(), 0
    while at < len(data):
        run = 0
        while at >= 4 and at + run < len(data) and run < 264 and data[at + run] == data[at + run - 4]:
            run += 1
        if run >= 3:
            length = run - 2
            out += bytes([(min(length, 7) << 5), *([length - 7] if length >= 7 else []), 3])
            at += run
        else:
            part = data[at : at + 4]
            out += bytes([len(part) - 1]) + part
            at += len(part)
    return bytes(out)


def pcd(form: str, points: np.ndarray = POINTS, *, width: int | None = None) -> bytes:
    """As PCL writes points with a colour, a padding of two bytes and a descriptor of three numbers."""
    n = len(points)
    row = np.dtype([("x", "<f4"), ("y", "<f4"), ("p", "u1", (2,)), ("z", "<f4"), ("rgb", "<u4"), ("d", "<f8", (3,))])
    table = np.zeros(n, row)
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y _ z rgb d\nSIZE 4 4 1 4 4 8\n"
        f"TYPE F F U F U F\nCOUNT 1 1 2 1 1 3\nWIDTH {width or n}\nHEIGHT {n // (width or n)}\nVIEWPOINT 0 0 0 1 0 0 "
        f"0\nPOINTS {n}\nDATA {form}\n"
    ).encode()
    if form == "ascii":
        return head + b"".join(f"{x!r} {y!r} 0 0 {z!r} 4278190080 0 0 0\n".encode() for x, y, z in points.tolist())
    if form == "binary":
        return head + table.tobytes()
    runs = b"".join(np.ascontiguousarray(table[name]).tobytes() for name in row.names or ())
    packed = lzf(runs)
    return head + struct.pack("<II", len(packed), len(runs)) + packed


# As Slicer 4.10 and 4.13 write fiducials, and as geomorph's writeland.tps writes a specimen.
FCSV = """# Markups fiducial file version = 4.10
# CoordinateSystem = 0
# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID
vtkMRMLMarkupsFiducialNode_0,-10.5,20,3.25,0.000,0.000,0.000,1.000,1,1,0,nose tip,,
vtkMRMLMarkupsFiducialNode_1,0,-1e2,7,0.000,0.000,0.000,1.000,1,1,0,"left, eye",,vtkMRMLModelNode1
"""
TPS = "LM3=3\r\n1.5 2 -3\r\nNA NA NA\r\n4 5 6\r\nIMAGE=a.jpg\r\nID=skull 1\r\nSCALE=1.0\r\n"
LM3 = "# Landmark file\n\n3 landmarks\nOuter left eyebrow\n-50.5 30.25 1\nNose tip\n0 0 0\nChin middle\n1 -60.0 -2e1\n"


def vtk_5_1(*, binary: bool) -> bytes:
    """Three points and a triangle as VTK 9 writes them, with a field of each kind that is no number."""

    def numbers(values: object, kind: str) -> bytes:
        array = np.asarray(values)
        packed = array.astype(">" + kind).tobytes() if binary else " ".join(map(str, array.ravel())).encode()
        return packed + b"\n"

    long = "x" * 70
    words = b"\xc5hello\xc0" + b"\x80\x46" + long.encode() + b"\n" if binary else f"hello\n\n{long}\n".encode()
    return (
        b"# vtk DataFile Version 5.1\nvtk output\n" + (b"BINARY" if binary else b"ASCII") + b"\nDATASET POLYDATA\n"
        b"FIELD FieldData 5\nnames 1 3 string\n" + words + b"METADATA\nINFORMATION 0\n\n"
        b"bits 1 10 bit\n" + (b"\xff\xc0\n" if binary else b"1 1 1 1 1 1 1 1 1 1\n")
        + b"letters 1 3 signed_char\n" + numbers([1, 2, 3], "i1")
        + b"any 1 2 variant\n6 12\n13 %20a\n"
        + b"Time 1 1 double\n" + numbers([0.5], "f8")
        + b"POINTS 3 double\n" + numbers([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]], "f8")
        + b"METADATA\nINFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1\n\n"
        + b"POLYGONS 2 3\nOFFSETS vtktypeint64\n" + numbers([0, 3], "i8")
        + b"CONNECTIVITY vtktypeint64\n" + numbers([0, 1, 2], "i8")
    )  # fmt: skip
