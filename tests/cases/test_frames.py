"""One frame, LPS, for meshes, landmarks and the surfaces of volumes of one subject, whatever the files state."""

import base64
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cli import main
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.landmark_guide import with_own_landmarks
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.errors import InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.landmark_placement import landmarks_in_frame_of
from shapespace.geometry.normals import rms_size
from shapespace.geometry.volume_surface import surface_of_volume
from shapespace.io.landmarks.landmark_io import read_landmarks
from shapespace.io.meshes.mesh_io import MESH_FORMATS, read_mesh, write_mesh
from shapespace.io.volume_io import read_volume
from shapespace.types import RAS_TO_LPS, FloatArray, LabelVolume, Mesh, Segment, Similarity
from synthetic_shapes import blob_model, raw_scan, sphere

TETRAHEDRON = Mesh(
    np.array([[1.5, 2.25, 3], [11.25, 2, 3], [1, 17, 3], [1, 2, -23.5]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32),
)
V, F = TETRAHEDRON.vertices, TETRAHEDRON.faces
POINTS = "\n".join(" ".join(map(str, point)) for point in V)
MARKED = [ending for ending in MESH_FORMATS if ending not in (".off", ".glb", ".gltf")]


def in_ras(mesh: Mesh) -> FloatArray:
    """Return the vertices of the tetrahedron if it was read as LPS, and refuse a file that was not converted."""
    assert mesh.notes == ("Its header states the frame RAS; it was converted to LPS.",)
    return mesh.vertices * RAS_TO_LPS


@pytest.mark.parametrize("ending", MARKED)
def test_a_written_mesh_has_the_mark_and_is_read_back_equal(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{ending}"
    write_mesh(path, TETRAHEDRON)
    again = read_mesh(path)
    order = again.vertices if ending == ".stl" else V
    assert np.array_equal(np.sort(again.vertices, axis=0), np.sort(V, axis=0)) and again.notes == ()
    content = path.read_bytes()
    ras = content.replace(b"SPACE=LPS", b"SPACE=RAS").replace(b"76 80 83 0", b"82 65 83 0")
    assert ras != content
    path.write_bytes(ras)
    assert np.array_equal(in_ras(read_mesh(path)), order)
    (tmp_path / f"b{ending}.gz").write_bytes(gzip.compress(ras))
    assert np.array_equal(in_ras(read_mesh(tmp_path / f"b{ending}.gz")), order)


def ascii_stl(name: str) -> str:
    facets = ("\n".join(f"vertex {x} {y} {z}" for x, y, z in V[face]) for face in F)
    body = "\n".join(f"facet normal 0 0 0\nouter loop\n{facet}\nendloop\nendfacet" for facet in facets)
    return f"solid {name}\n{body}\nendsolid\n"


def vtk_text(title: str, field: str = "") -> str:
    polygons = "\n".join(f"3 {a} {b} {c}" for a, b, c in F)
    return (
        f"# vtk DataFile Version 4.2\n{title}\nASCII\nDATASET POLYDATA\n{field}POINTS 4 float\n{POINTS}\n"
        f"POLYGONS 4 16\n{polygons}\n"
    )


def vtp_text(array: str, tail: str = "") -> str:
    corners, ends = " ".join(map(str, F.ravel())), "3 6 9 12"
    return (
        '<?xml version="1.0"?><VTKFile type="PolyData" version="0.1" byte_order="LittleEndian" header_type="UInt32">'
        f'<PolyData><FieldData>{array}</FieldData><Piece NumberOfPoints="4" NumberOfPolys="4"><Points>'
        f'<DataArray type="Float32" NumberOfComponents="3" format="ascii">{POINTS}</DataArray></Points><Polys>'
        f'<DataArray type="Int64" Name="connectivity" format="ascii">{corners}</DataArray>'
        f'<DataArray type="Int64" Name="offsets" format="ascii">{ends}</DataArray></Polys></Piece></PolyData>'
        f"{tail}</VTKFile>"
    )


SPACE_FIELD = '<Array type="String" Name="SPACE" NumberOfTuples="1"'
CODES = base64.b64encode((4).to_bytes(4, "little") + b"RAS\0").decode()
OBJ = "\n".join([*(f"v {line}" for line in POINTS.splitlines()), *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in F)])
PLY = (
    "ply\nformat ascii 1.0\ncomment VTK generated PLY File\ncomment SPACE=RAS\nelement vertex 4\nproperty float x\n"
    "property float y\nproperty float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n"
    f"{POINTS}\n" + "\n".join(f"3 {a} {b} {c}" for a, b, c in F) + "\n"
)  # fmt: skip
AS_3D_SLICER_WRITES = {
    "a.ply": PLY,
    "crlf.ply": PLY.replace("\n", "\r\n"),
    "a.obj": f"# 3D Slicer output. SPACE=RAS\n\nmtllib a.mtl\n{OBJ}\n",
    "a.stl": ascii_stl("3D Slicer output. SPACE=RAS"),
    "title.vtk": vtk_text("3D Slicer output. SPACE=RAS"),
    "field.vtk": vtk_text("vtk output", "FIELD FieldData 1\nSPACE 1 1 string\nRAS\n"),
    "long.ply": PLY.replace("=RAS", " = right-anterior-superior"),
    "lower.vtp": vtp_text(f'{SPACE_FIELD.replace("SPACE", "space")} format="ascii">82 65 83 0</Array>'),
    "ascii.vtp": vtp_text(f'{SPACE_FIELD} format="ascii">82 65 83 0</Array>'),
    "binary.vtp": vtp_text(f'{SPACE_FIELD} format="binary">{CODES}</Array>'),
    "appended.vtp": vtp_text(
        f'{SPACE_FIELD} format="appended" offset="0"/>', f'<AppendedData encoding="base64">_{CODES}</AppendedData>'
    ),
}


@pytest.mark.parametrize("name", AS_3D_SLICER_WRITES)
def test_the_mark_ras_is_honoured_and_no_mark_means_as_it_is(name: str, tmp_path: Path) -> None:
    path, text = tmp_path / name, AS_3D_SLICER_WRITES[name]
    path.write_bytes(text.encode())
    ras = in_ras(read_mesh(path))
    assert np.array_equal(np.sort(ras, axis=0), np.sort(V, axis=0))
    for other in ("LPS", "XYZ"):
        codes = base64.b64encode((4).to_bytes(4, "little") + other.encode() + b"\0").decode()
        text_of = (
            text.replace("RAS", other)
            .replace("right-anterior-superior", other)
            .replace("82 65 83 0", "76 80 83 0")
            .replace(CODES, codes)
        )
        path.write_bytes(text_of.encode())
        assert np.array_equal(read_mesh(path).vertices, ras) and not read_mesh(path).notes


def test_the_field_of_a_binary_vtk_file_is_honoured(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.vtk", TETRAHEDRON)
    content = (tmp_path / "a.vtk").read_bytes().replace(b" SPACE=LPS", b"")
    field = b"FIELD FieldData 1\nSPACE 1 1 string\n\xc3RAS\n"
    (tmp_path / "a.vtk").write_bytes(content.replace(b"POLYDATA\n", b"POLYDATA\n" + field))
    assert np.array_equal(in_ras(read_mesh(tmp_path / "a.vtk")), V)


# A ball with a horn to one side, centred on x = y = 0, so that a half turn about z takes most of it to itself.


def horned(vertices: FloatArray) -> FloatArray:
    """Return points of the unit sphere on the horned ball, radius 10 mm."""
    horn = np.exp((vertices @ [0.8, 0, 0.6] - 1) / 0.05)
    return 10 * vertices * (1 + 0.7 * horn[:, None]) + (0, 0, 50)


SCAN = Mesh(horned(sphere(2000)[0]), sphere(2000)[1], name="s0")
DIRECTIONS = {"horn": (0.8, 0, 0.6), "front": (0, 1, 0), "back": (0, -1, 0), "tip": (0, 0, 1)}
MARKS = {name: horned(np.array([at], dtype=float))[0] for name, at in DIRECTIONS.items()}
TURNED = {name: point * RAS_TO_LPS for name, point in MARKS.items()}


def test_landmarks_a_half_turn_off_are_turned_with_a_sentence_and_none_is_on_the_wrong_side() -> None:
    for move in ((0, 0, 0), (30, -90, 5)):
        scan = SCAN.with_vertices(SCAN.vertices + move)
        points = {name: (point + move) * RAS_TO_LPS for name, point in MARKS.items()}
        fixed, notes = with_own_landmarks(Mesh(scan.vertices, scan.faces, points, "s0"))
        assert {name: point.tolist() for name, point in fixed.landmarks.items()} == {
            name: (point + move).tolist() for name, point in MARKS.items()
        }
        assert len(notes) == 1 and "half turn about z" in notes[0] and "SPACE=RAS" in notes[0]


def test_landmarks_that_a_half_turn_does_not_explain_stay_where_they_are() -> None:
    noise = np.random.default_rng(0).normal(scale=0.04 * rms_size(SCAN.vertices), size=(len(MARKS), 3))
    cases: dict[str, dict[str, FloatArray]] = {
        "right": MARKS,
        "noisy": {name: point + off for (name, point), off in zip(MARKS.items(), noise, strict=True)},
        "one wrong": {**MARKS, "tip": MARKS["tip"] + (9, 9, 30)},
        "metres": {name: point / 1000 for name, point in TURNED.items()},
        "of both sides alike": {name: TURNED[name] for name in ("front", "back", "tip")},
        "none": {},
    }
    for name, points in cases.items():
        same, notes = landmarks_in_frame_of(SCAN, points)
        assert notes == () and same is points, name
    one_wrong = {**TURNED, "far": np.array([200.0, 0, 0])}
    fixed, notes = with_own_landmarks(Mesh(SCAN.vertices, SCAN.faces, {**one_wrong, "left": np.array([10.0, 0, 50])}))
    assert set(fixed.landmarks) == {*MARKS, "left"} and len(notes) == 2 and "far" in notes[1]


def test_a_fit_ends_the_same_with_landmarks_a_half_turn_off() -> None:
    model = blob_model()
    raw = raw_scan(np.zeros(5), Similarity(1.0, np.eye(3), np.array([40.0, -60, 10])))
    marks = dict(model.landmarks.positions(raw.truth))
    turned = {name: point * RAS_TO_LPS for name, point in marks.items()}
    right, other = (fit_scan(model, raw.scan, FitConfig(unit="mm"), landmarks=points) for points in (marks, turned))
    assert other.status == right.status == "converged" and np.array_equal(other.b, right.b)
    assert sum("half turn" in note for note in other.notes) == 1 and not any("half turn" in n for n in right.notes)


def test_a_correspondence_carries_the_note_that_landmarks_were_turned() -> None:
    scans: list[Mesh] = []
    for k, bump in enumerate((1.0, 1.05, 1.1)):
        marks = {name: point * (1, bump, 1) for name, point in MARKS.items()}
        scans.append(Mesh(SCAN.vertices * (1, bump, 1), SCAN.faces, marks, f"s{k}"))
    points = {name: point * RAS_TO_LPS for name, point in scans[1].landmarks.items()}
    scans[1] = Mesh(scans[1].vertices, scans[1].faces, points, "s1")
    quick = ElasticSettings(harmonics=60, points=500, iterations=10)
    config = CorrespondConfig(vertices=300, rounds=1, mirror="never", first=quick, next=quick)
    made = correspond(scans, config)
    assert [["half turn" in note for note in scan.notes] for scan in made.scans] == [[], [True], []]
    assert made.scans[1].landmarks < 0.05 * rms_size(SCAN.vertices)  # which are on the right side
    of_template = correspond([scans[0], scans[2]], config, template=scans[1])
    assert "half turn about z" in of_template.why


def slicer_points(points: dict[str, FloatArray], system: str) -> str:
    rows = [{"label": name, "position": point.tolist()} for name, point in points.items()]
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": system, "controlPoints": rows}]})


@pytest.mark.parametrize("format", ["nifti", "nrrd"])
def test_landmarks_of_3d_slicer_lie_on_the_surface_of_their_volume(format: str, tmp_path: Path) -> None:
    nib = pytest.importorskip("nibabel", reason="the extra `volumes` is not installed")
    nrrd = pytest.importorskip("nrrd", reason="the extra `volumes` is not installed")
    places = np.stack(np.meshgrid(*(np.arange(n) for n in (36, 32, 34)), indexing="ij"), axis=-1) - (14, 16, 16)
    labels = (np.linalg.norm(places, axis=-1) < 9) | (np.linalg.norm(places - (10, 0, 8), axis=-1) < 5)
    # voxels along right, anterior, superior, off the origin
    affine = np.eye(4)
    affine[:3, 3] = -14 + 7, -16 - 20, -16 + 40
    if format == "nifti":
        nib.save(nib.Nifti1Image(labels.astype(np.uint8), affine), tmp_path / "v.nii.gz")
    else:
        fields = {"space": "RAS", "space directions": affine[:3, :3].T, "space origin": affine[:3, 3]}
        nrrd.write(str(tmp_path / "v.nrrd"), labels.astype(np.uint8), fields, index_order="F")
    (tmp_path / "v.mrk.json").write_text(slicer_points({"horn": np.array([7 + 10.0, -20, 40 + 13])}, "RAS"))
    (file,) = tmp_path.glob("v.n*")
    assert main(["surface", str(file), "-o", str(tmp_path / "out"), "--quiet"]) == 0
    mesh, point = read_mesh(tmp_path / "out" / "v.ply"), read_landmarks(tmp_path / "v.mrk.json")["horn"]
    assert build_engine(mesh).query(point[None]).distance[0] < 0.5
    assert build_engine(mesh).query(point[None] * RAS_TO_LPS).distance[0] > 20
    assert b"comment SPACE=LPS" in (tmp_path / "out" / "v.ply").read_bytes()[:100]


def layered() -> tuple[Any, dict[str, Any]]:
    """Return (L, X, Y, Z) labels of two segments that overlap, and the header of 3D Slicer."""
    places = np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1)
    bone, cartilage = (np.linalg.norm(places - centre, axis=-1) < 5 for centre in ((9, 12, 12), (13, 12, 12)))
    layers = np.stack([bone, cartilage]).astype(np.uint8)
    layers[0, 20:22, 20:22, 20:22] = 2
    header: dict[str, Any] = {
        "space": "left-posterior-superior", "kinds": ["list", "domain", "domain", "domain"],
        "space directions": np.array([[np.nan] * 3, *np.eye(3)]), "space origin": np.array([5.0, -7, 11]),
    }  # fmt: skip
    for n, (name, label, layer) in enumerate((("bone", 1, 0), ("cartilage", 1, 1), ("left, tooth", 2, 0))):
        for key, value in (("ID", f"Segment_{n + 1}"), ("Name", name), ("LabelValue", label), ("Layer", layer)):
            header[f"Segment{n}_{key}"] = str(value)
    return layers, header


def test_a_segment_of_a_layered_file_is_chosen_by_name_or_number(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nrrd = pytest.importorskip("nrrd", reason="the extra `volumes` is not installed")
    layers, header = layered()
    nrrd.write(str(tmp_path / "a.seg.nrrd"), layers, header, index_order="F")
    volume = read_volume(tmp_path / "a.seg.nrrd")
    assert volume.labels.shape == (24, 24, 24, 2) and volume.segments[1] == Segment("cartilage", 1, 1, "Segment_2")
    origin = np.array([5.0, -7, 11])
    for asked, centre, mask in (
        ("bone", (9, 12, 12), layers[0] == 1), ("cartilage", (13, 12, 12), layers[1] == 1),
        ("Segment_2", (13, 12, 12), layers[1] == 1), (2, (20.5, 20.5, 20.5), layers[0] == 2),
        ("left, tooth", (20.5, 20.5, 20.5), layers[0] == 2),
    ):  # fmt: skip
        made = surface_of_volume(volume, asked)
        vertices = made.mesh.vertices
        assert np.allclose((vertices.min(axis=0) + vertices.max(axis=0)) / 2, origin + centre, atol=0.1)
        assert made.voxels == mask.sum() and made.labels == (asked,)
    both = surface_of_volume(volume, "bone,cartilage")
    assert both.voxels == ((layers == 1).any(axis=0)).sum() and both.labels == ("bone", "cartilage")
    for asked, said in (
        (None, "it has the segments bone, left, tooth, cartilage; choose some"),
        (1, "label 1 is in several layers; choose one of bone, cartilage"),
        ("skin", "it has no label skin; choose from bone, left, tooth, cartilage"),
    ):
        with pytest.raises(InputError, match=said):
            surface_of_volume(volume, asked)
    command = ["surface", str(tmp_path / "a.seg.nrrd"), "-o", str(tmp_path / "out")]
    assert main([*command, "--label", "cartilage"]) == 0 and "of label cartilage" in capsys.readouterr().out
    assert main(command) == 2 and "bone" in capsys.readouterr().err


def test_segments_in_one_layer_have_names_too() -> None:
    layers, _ = layered()
    volume = LabelVolume(layers[0], np.eye(4), segments=(Segment("bone", 1), Segment("tooth", 2), Segment("none", 7)))
    assert surface_of_volume(volume, "tooth").voxels == 8 == surface_of_volume(volume, 2).voxels
    assert surface_of_volume(volume, "all").labels == ("bone", "tooth")
    with pytest.raises(InputError, match="it has no label none; choose from bone, tooth"):
        surface_of_volume(volume, "none")


def test_names_of_segments_may_have_any_letters_and_their_numbers_gaps(tmp_path: Path) -> None:
    nrrd = pytest.importorskip("nrrd", reason="the extra `volumes` is not installed")
    layers, header = layered()
    header = {key.replace("Segment1_", "Segment400_"): value for key, value in header.items()}
    path = tmp_path / "a.seg.nrrd"
    nrrd.write(str(path), layers, header, index_order="F")
    path.write_bytes(path.read_bytes().replace(b":=cartilage", ":=Knörpel".encode()))
    volume = read_volume(path)
    assert [segment.name for segment in volume.segments] == ["bone", "left, tooth", "Knörpel"]
    assert surface_of_volume(volume, "Knörpel").voxels == (layers[1] == 1).sum()
