import csv
import shutil
from pathlib import Path

import numpy as np
import pytest

from shapespace.datasets import ict, ict_files
from shapespace.errors import DataError, FileFormatError, InputError
from shapespace.geometry.normals import face_areas
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.landmarks.landmark_io import read_landmarks
from shapespace.io.meshes.mesh_io import read_mesh


@pytest.fixture(scope="module")
def model(shared_data: Path) -> ict.IctFaces:
    return ict.load_ict(shared_data / "ict-facekit")


def test_the_model_is_in_millimetres_and_of_the_published_size(model: ict.IctFaces) -> None:
    assert model.identity.shape == (100, 11248, 3)
    assert model.expression.shape == (57, 11248, 3)
    assert model.faces.shape == (22288, 3)
    assert 200 < np.ptp(model.mean[:, 1]) < 400
    assert not model.mean.flags.writeable


def test_published_objs_load_as_the_packed_file_does(model: ict.IctFaces, shared_data: Path) -> None:
    from_objs = ict.load_ict(shared_data / "ict-facekit" / "FaceXModel")
    assert np.array_equal(from_objs.mean, model.mean)
    assert np.array_equal(from_objs.identity, model.identity[:3])
    assert from_objs.expression_names == ("jawOpen", "mouthSmile_L")
    for name in from_objs.expression_names:
        a = from_objs.expression[from_objs.expression_names.index(name)]
        assert np.array_equal(a, model.expression[model.expression_names.index(name)])


@pytest.mark.parametrize(("area", "vertices", "faces"), [("face", 9409, 18460), ("face_and_head", 11248, 22288)])
def test_an_area_is_a_clean_surface(model: ict.IctFaces, area: ict.Area, vertices: int, faces: int) -> None:
    mesh = model.mesh(area=area)
    assert mesh.faces is not None
    assert (len(mesh.vertices), len(mesh.faces)) == (vertices, faces)
    assert len(np.unique(mesh.faces)) == vertices
    assert face_areas(mesh).min() > 0


def test_the_mean_is_the_mean_and_a_mode_is_added_once(model: ict.IctFaces) -> None:
    assert np.array_equal(model.mesh().vertices, model.mean[:9409])
    one = model.mesh([0.0, 2.0]).vertices
    assert np.allclose(one, model.mean[:9409] + 2 * model.identity[1, :9409])
    jaw = model.mesh(None, {"jawOpen": 0.5}).vertices - model.mean[:9409]
    assert np.allclose(jaw, 0.5 * model.expression[model.expression_names.index("jawOpen"), :9409])


def test_landmarks_are_symmetric_and_where_they_should_be(model: ict.IctFaces) -> None:
    marks = model.mesh().landmarks
    assert len(marks) == 68
    mirror = np.array([-1.0, 1.0, 1.0])
    pairs = [(f"chin_{i}", f"chin_{16 - i}") for i in range(17)]
    pairs += [(f"leyebrow_{i}", f"reyebrow_{4 - i}") for i in range(5)]
    pairs += [(f"leye_{i}", f"reye_{(3 - i) % 6}") for i in range(6)]
    pairs += [(f"nose_{i}", f"nose_{i}") for i in range(4)]
    pairs += [(f"nose_{i}", f"nose_{12 - i}") for i in range(4, 9)]
    pairs += [(f"mouth_{i}", f"mouth_{6 - i}") for i in range(7)]
    for a, b in pairs:
        assert np.linalg.norm(marks[a] - mirror * marks[b]) < 1.0, (a, b)
    # The tip of the nose is the foremost landmark, and menpo's "l" is the person's own right.
    assert max(marks, key=lambda name: marks[name][2]) == "nose_3"
    assert marks["leye_0"][0] < 0 < marks["reye_3"][0]
    heights = [marks[name][1] for name in ("leyebrow_2", "leye_1", "nose_3", "mouth_3", "mouth_9", "chin_8")]
    assert heights == sorted(heights, reverse=True)


def test_landmarks_match_those_of_james_by_name(model: ict.IctFaces, shared_data: Path) -> None:
    james = read_landmarks(shared_data / "james" / "james.ljson")
    marks = model.mesh().landmarks
    assert set(marks) == set(james)
    names = sorted(marks)
    source, target = np.array([marks[n] for n in names]), np.array([james[n] for n in names])
    T = fit_similarity(source, target)
    residual = np.linalg.norm(T.apply(source) - target, axis=1)
    assert np.sqrt((residual**2).mean()) < 7.0
    assert 0.9 < T.scale < 1.15
    inner = [i for i, n in enumerate(names) if n.startswith(("leye_", "reye_", "nose", "mouth"))]
    T = fit_similarity(source[inner], target[inner])
    residual = np.linalg.norm(T.apply(source[inner]) - target[inner], axis=1)
    assert np.sqrt((residual**2).mean()) < 3.5


def test_people_differ_and_do_not_depend_on_how_many_are_drawn(model: ict.IctFaces) -> None:
    few, many = model.draw_people(2, 5), model.draw_people(200, 5)
    assert np.array_equal(few, many[:2])
    assert abs(many.mean()) < 0.05
    assert abs(many.std() - 1) < 0.05


def test_written_people_read_back_in_correspondence(model: ict.IctFaces, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    paths = ict.write_people(
        tmp_path / "people",
        subjects=2,
        seed=1,
        expressions=("neutral", "smile", "jawOpen"),
        faces=model,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert [p.name for p in paths[:2]] == ["person_000_neutral.ply", "person_000_smile.ply"]
    assert seen[-1] == (6, 6)
    meshes = [read_mesh(path) for path in paths]
    assert np.allclose(meshes[0].vertices, model.mesh(model.draw_people(2, 1)[0]).vertices, atol=1e-4)
    with (tmp_path / "people" / "labels.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [r["expression"] for r in rows] == ["neutral", "smile", "jawOpen"] * 2
    assert rows[0] == {
        "file": "person_000_neutral.ply",
        "subject": "person_000",
        "expression": "neutral",
        "intensity": "0.0",
    }
    with (tmp_path / "people" / "landmarks.csv").open() as stream:
        marks = {r["name"]: int(r["vertex"]) for r in csv.DictReader(stream)}
    assert marks == dict(ict.LANDMARK_VERTICES)


def test_every_named_expression_moves_the_face(model: ict.IctFaces) -> None:
    for name, mixture in ict.EXPRESSIONS.items():
        moved = np.linalg.norm(model.mesh(None, mixture).vertices - model.mean[:9409], axis=1).max()
        assert moved == 0 if name == "neutral" else 3 < moved < 60, name


def test_wrong_requests_are_refused_in_one_sentence(model: ict.IctFaces, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at most 100"):
        model.mesh(np.zeros(101))
    with pytest.raises(InputError, match="did you mean 'jawOpen'"):
        model.mesh(None, {"jawopen": 1.0})
    with pytest.raises(InputError, match="finite"):
        model.mesh([np.nan])
    with pytest.raises(InputError, match="area"):
        model.mesh(area="neck")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="no expression 'joy'"):
        ict.write_people(tmp_path / "x", subjects=1, seed=0, expressions=("joy",), faces=model)
    assert not (tmp_path / "x").exists()


def test_absent_data_say_how_to_get_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SHAPESPACE_DATA", raising=False)
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path))
    assert not ict.ict_available()
    with pytest.raises(DataError, match="shapespace data get ict-facekit"):
        ict.load_ict()
    with pytest.raises(DataError, match="neither"):
        ict.load_ict(tmp_path)


def test_the_mirror_is_loaded_when_named(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", str(shared_data))
    assert ict.ict_available()
    assert len(ict.load_ict().identity) == 100


@pytest.mark.parametrize("damage", ["cut", "bytes", "text", "shape", "pickle", "nan", "huge"])
def test_a_damaged_packed_file_is_refused(damage: str, shared_data: Path, tmp_path: Path) -> None:
    path = tmp_path / ict_files.PACKED_NAME
    data = (shared_data / "ict-facekit" / ict_files.PACKED_NAME).read_bytes()
    parts = {
        "mean": np.zeros((11248, 3)),
        "identity": np.zeros((1, 11248, 3), np.float32),
        "expression": np.zeros((0, 11248, 3), np.float32),
        "expression_names": np.zeros(0, dtype="<U4"),
        "faces": np.zeros((1, 3), np.int32),
    }
    if damage == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "bytes":
        path.write_bytes(data[:2_000_000] + b"\0" * 100 + data[2_000_100:])
    elif damage == "text":
        path.write_text("hello")
    elif damage == "shape":
        np.savez(path, **{**parts, "mean": np.zeros((5, 3))})
    elif damage == "pickle":
        np.savez(path, **{**parts, "expression_names": np.array([{}], dtype=object)})
    elif damage == "nan":
        np.savez(path, **{**parts, "mean": np.full((11248, 3), np.nan)})
    else:
        np.savez(path, **{**parts, "expression_names": np.zeros(1, dtype="<U100000")})
    with pytest.raises(FileFormatError, match=ict_files.PACKED_NAME):
        ict.load_ict(tmp_path)


@pytest.mark.parametrize("damage", ["cut", "word", "nan", "other"])
def test_a_damaged_obj_is_refused_by_name(damage: str, shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "ict-facekit" / "FaceXModel"
    shutil.copyfile(source / "generic_neutral_mesh.obj", tmp_path / "generic_neutral_mesh.obj")
    text = (source / "identity000.obj").read_text()
    start = text.index("\nv ")
    path = tmp_path / "identity000.obj"
    path.write_text(
        {
            "cut": text[:200_000],
            "word": text[:start] + "\nv one two three" + text[start:],
            "nan": text[:start] + "\nv nan 0 0" + text[start:],
            "other": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        }[damage]
    )
    with pytest.raises(FileFormatError, match=r"identity000\.obj"):
        ict.load_ict(tmp_path)
