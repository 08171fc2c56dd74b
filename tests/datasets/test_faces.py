import csv
import importlib.resources
import zipfile
from pathlib import Path

import numpy as np
import pytest

import shapespace.datasets.faces as module
from shapespace.datasets.faces import EXPRESSIONS, Expression, Person, Warp, load_faces, write_faces
from shapespace.errors import DataError, InputError
from shapespace.io.meshes.mesh_io import read_mesh

DATA = importlib.resources.files("shapespace.datasets") / "data"


@pytest.fixture(scope="module")
def faces():
    return load_faces()


@pytest.fixture(scope="module")
def people(faces):
    return [faces.draw_person(np.random.default_rng([0, k])) for k in range(30)]


def directed_edges(triangles):
    return triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)


def average(faces):
    """The person whose neutral face is the template."""
    return Person(faces._generic)


def moved(faces, expression):
    neutral = faces.face(average(faces)).vertices
    return np.linalg.norm(faces.face(average(faces), expression).vertices - neutral, axis=1)


def test_the_bundled_file_is_small_and_free_of_pickle():
    source = DATA / "faces.npz"
    assert len(source.read_bytes()) <= 4_000_000
    with zipfile.ZipFile(str(source)) as archive, np.load(str(source), allow_pickle=False) as data:
        assert len(archive.namelist()) == len([data[k] for k in data.files])


def test_licence_and_provenance_lie_beside_the_data():
    assert "CC0 1.0 Universal" in (DATA / "faces.LICENSE.txt").read_text(encoding="utf-8")
    notes = (DATA / "faces.md").read_text(encoding="utf-8")
    assert "SHA-256 `bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2`" in notes
    assert "not scans of people" in notes


def test_the_surface_is_one_oriented_sheet_with_one_rim(faces):
    triangles = faces.template.faces
    assert 11_000 <= len(faces.template.vertices) <= 13_000
    half = directed_edges(triangles)
    assert len(np.unique(half, axis=0)) == len(half)
    edges, count = np.unique(np.sort(half, axis=1), axis=0, return_counts=True)
    assert count.max() == 2
    rim = edges[count == 1]
    assert set(np.bincount(rim.ravel())[np.unique(rim)]) == {2}
    assert np.array_equal(np.unique(rim), np.sort(faces.regions["boundary"]))
    # A disc has Euler number 1, so the eyes, the mouth and the nostrils leave no other hole.
    assert len(np.unique(triangles)) - len(edges) + len(triangles) == 1


def test_faces_look_along_z_with_y_up_and_have_a_real_size(faces):
    at = faces.template.landmarks
    assert at["pronasale"][2] == faces.template.vertices[:, 2].max()
    assert at["glabella"][1] > at["pronasale"][1] > at["menton"][1]
    assert at["left_pupil"][0] > 0
    assert abs(at["left_pupil"][0] - at["right_pupil"][0] - 62) < 1.5
    assert 140 < np.linalg.norm(at["left_tragion"] - at["right_tragion"]) < 165
    assert np.abs(faces.template.vertices.mean(axis=0)).max() < 40
    a, b, c = (faces.template.vertices[faces.template.faces[:, k]] for k in range(3))
    assert np.cross(b - a, c - a)[:, 2].sum() > 0


def test_the_mirror_is_its_own_inverse_and_the_template_is_symmetric(faces):
    assert np.array_equal(faces.mirror[faces.mirror], np.arange(len(faces.mirror)))
    V = faces.template.vertices
    assert np.abs(V[faces.mirror] * [-1, 1, 1] - V).max() < 0.1
    turned = {tuple(np.roll(t, -t.argmin())) for t in faces.mirror[faces.template.faces][:, ::-1]}
    assert turned == {tuple(np.roll(t, -t.argmin())) for t in faces.template.faces}


def test_left_and_right_landmarks_answer_each_other(faces):
    assert len(faces.landmarks) >= 30
    for name, vertex in faces.landmarks.items():
        if name.startswith("left_"):
            assert faces.landmarks["right_" + name[5:]] == faces.mirror[vertex]
            assert faces.template.vertices[vertex, 0] > 0
        elif not name.startswith("right_"):
            assert abs(faces.template.vertices[vertex, 0]) < 1e-6
    assert len(set(faces.landmarks.values())) == len(faces.landmarks)


def test_landmarks_follow_the_vertices_of_each_face(faces, people):
    mesh = faces.face(people[0], faces.draw_expression("smile", 1.0, np.random.default_rng(0)))
    for name, vertex in faces.landmarks.items():
        assert np.array_equal(mesh.landmarks[name], mesh.vertices[vertex])


def test_regions_are_where_their_names_say(faces):
    V, at = faces.template.vertices, faces.template.landmarks
    assert {"semi_rigid", "eyes", "mouth", "ears", "nose", "boundary"} <= set(faces.regions)
    for name, group in faces.regions.items():
        assert np.array_equal(np.sort(faces.mirror[group]), np.sort(group)), name
    assert V[faces.regions["semi_rigid"], 1].min() > at["pronasale"][1]
    assert faces.landmarks["pronasale"] in faces.regions["nose"]
    assert faces.landmarks["left_cheilion"] in faces.regions["mouth"]
    assert faces.landmarks["right_pupil"] in faces.regions["eyes"]
    assert faces.landmarks["left_tragion"] in faces.regions["ears"]


@pytest.mark.parametrize(("name", "share"), [("smile", 0.1), ("surprise", 0.1), ("fear", 0.1), ("anger", 0.7)])
def test_the_semi_rigid_region_moves_less_than_the_mouth(faces, name, share):
    d = moved(faces, faces.draw_expression(name, 1.0, np.random.default_rng(0)))
    assert d[faces.regions["semi_rigid"]].mean() < share * d[faces.regions["mouth"]].mean()


def test_the_generic_person_is_the_template(faces):
    assert np.allclose(faces.face(average(faces)).vertices, faces.template.vertices, atol=1e-12)


def test_there_are_52_units_and_each_but_the_tongue_moves_the_face(faces):
    assert len(faces.unit_names) == 52
    for k, name in enumerate(faces.unit_names):
        d = moved(faces, Expression(np.eye(52)[k]))
        assert (d.max() > 0.5) == (name != "tongueOut"), name
        if name.endswith("Left"):
            other = moved(faces, Expression(np.eye(52)[faces.unit_names.index(name[:-4] + "Right")]))
            assert np.allclose(other[faces.mirror], d, atol=1e-9)


def test_the_same_seed_draws_the_same_face_and_another_seed_another(faces):
    def draw(seed):
        rng = np.random.default_rng(seed)
        return faces.face(faces.draw_person(rng), faces.mixed_expression(rng)).vertices

    assert np.array_equal(draw(3), draw(3))
    assert np.linalg.norm(draw(3) - draw(4), axis=1).mean() > 1.0


def test_people_are_bounded_differ_and_are_almost_symmetric(faces, people):
    shapes = [faces.face(p).vertices for p in people]
    for person, V in zip(people, shapes, strict=True):
        assert person.weights.min() >= 0 and person.weights.max() <= 1
        assert np.linalg.norm(V - faces.template.vertices, axis=1).max() < 60
        lopsided = np.linalg.norm(V[faces.mirror] * [-1, 1, 1] - V, axis=1).mean()
        assert 0.02 < lopsided < 2.0
    for i, a in enumerate(shapes):
        for b in shapes[:i]:
            assert np.linalg.norm(a - b, axis=1).mean() > 1.0


def test_no_face_turns_inside_out_or_grows_shards(faces, people):
    triangles = faces.template.faces
    patch = np.concatenate([faces.regions["mouth_interior"], faces.regions["eyeballs"]])
    skin = ~np.isin(triangles, patch).any(axis=1)

    def normals(V):
        return np.cross(V[triangles[:, 1]] - V[triangles[:, 0]], V[triangles[:, 2]] - V[triangles[:, 0]])

    def lengths(V):
        return np.linalg.norm(V[triangles] - V[np.roll(triangles, 1, axis=1)], axis=2)

    for k, person in enumerate(people[:10]):
        neutral = faces.face(person).vertices
        for name in EXPRESSIONS:
            V = faces.face(person, faces.draw_expression(name, 1.0, np.random.default_rng(k))).vertices
            turned = (normals(V) * normals(neutral)).sum(axis=1) < 0
            # A lid or a lip that closes turns the triangles of its edge; nothing else may turn over.
            assert turned[skin].mean() < 0.015, name
            assert (lengths(V) / np.maximum(lengths(neutral), 1.0))[skin].max() < 8, name


def test_wide_people_are_the_same_people_with_smooth_changes_that_fold_nothing(faces, people):
    triangles, distances = faces.template.faces, []
    for k, plain in enumerate(people[:10]):
        person = faces.draw_person(np.random.default_rng([0, k]), wide=True)
        assert np.array_equal(person.weights, plain.weights)
        before, after = (faces.face(p).vertices for p in (plain, person))
        distances.append(np.linalg.norm(after - before, axis=1).mean())
        assert np.linalg.norm(after[faces.mirror] * [-1, 1, 1] - after, axis=1).mean() < 4.0
        a, b = (np.cross(V[triangles[:, 1]] - V[triangles[:, 0]], V[triangles[:, 2]] - V[triangles[:, 0]])
                for V in (before, after))  # fmt: skip
        assert ((a * b).sum(axis=1) < 0).mean() < 0.003
    assert 2.0 < np.mean(distances) < 8.0
    again = faces.draw_person(np.random.default_rng([0, 9]), wide=True)
    assert np.array_equal(again.warp_mm, person.warp_mm)
    assert people[0].warp_mm is None


def test_the_face_alone_is_a_sheet_with_the_landmarks_of_the_face(faces, people):
    whole = faces.face(people[0])
    face = faces.cut_to_face(whole)
    assert 0.5 < len(face.vertices) / len(whole.vertices) < 0.8
    assert {"pronasale", "menton", "left_pupil"} <= set(face.landmarks) == set(faces.face_landmarks)
    for name, vertex in faces.face_landmarks.items():
        assert np.array_equal(face.vertices[vertex], whole.landmarks[name])
        assert np.array_equal(face.landmarks[name], whole.landmarks[name])
    assert np.array_equal(np.unique(face.faces), np.arange(len(face.vertices)))
    edges, count = np.unique(np.sort(directed_edges(face.faces), axis=1), axis=0, return_counts=True)
    assert len(face.vertices) - len(edges) + len(face.faces) == 1  # a disc
    assert count.max() == 2


def test_a_warp_varies_as_much_as_it_says(faces):
    x, mirror = faces.template.vertices, faces.mirror
    off = np.abs(x[:, 0]) > 60  # in the middle the two sides are one
    warp = Warp(stretch=0.0, fields=((15.0, 2.0),), lopsided=0.0)
    drawn = np.stack([warp.draw(x, mirror, np.random.default_rng(k))[off] for k in range(30)])
    assert drawn.std() == pytest.approx(2.0, rel=0.1)


@pytest.mark.parametrize("name", [n for n in EXPRESSIONS if n != "neutral"])
def test_an_expression_grows_with_its_intensity_from_nothing(faces, name):
    size = [
        moved(faces, faces.draw_expression(name, i, np.random.default_rng(1))).mean()
        for i in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    assert size[0] == 0
    assert (np.diff(size) > 0).all()


def test_expressions_move_the_face_the_way_they_are_named(faces):
    def shift(name, landmark):
        mesh = faces.face(average(faces), faces.draw_expression(name, 1.0, np.random.default_rng(0), 0.0))
        return mesh.landmarks[landmark] - faces.template.landmarks[landmark]

    assert shift("smile", "left_cheilion")[1] > 2 and shift("smile", "left_cheilion")[0] > 1
    assert shift("sadness", "left_cheilion")[1] < -2
    assert shift("anger", "left_brow_inner")[1] < -1
    assert shift("surprise", "left_brow_peak")[1] > 1 and shift("surprise", "menton")[1] < -8
    assert shift("fear", "left_palpebrale_superius")[1] > 0.5
    assert shift("disgust", "labiale_superius")[1] > 1


def test_people_show_an_expression_differently_but_alike(faces):
    drawn = [faces.draw_expression("fear", 1.0, np.random.default_rng(k)).weights for k in range(5)]
    assert min(np.abs(a - b).max() for i, a in enumerate(drawn) for b in drawn[:i]) > 0.01
    assert min(np.corrcoef(a, b)[0, 1] for i, a in enumerate(drawn) for b in drawn[:i]) > 0.9


def test_mixed_expressions_of_one_person_span_about_five_modes(faces):
    X = np.array(
        [
            faces.face(average(faces), faces.mixed_expression(np.random.default_rng([1, k]))).vertices.ravel()
            for k in range(100)
        ]
    )
    X -= X.mean(axis=0)
    variance = np.linalg.eigvalsh(X @ X.T)[::-1]
    share = np.cumsum(variance) / variance.sum()
    assert 4 <= np.searchsorted(share, 0.985) + 1 <= 6


def test_written_faces_read_back_and_do_not_depend_on_how_many_are_asked_for(tmp_path, faces):
    seen = []
    few = write_faces(tmp_path / "few", subjects=1, expressions=["smile"], seed=7, progress=lambda *x: seen.append(x))
    many = write_faces(tmp_path / "many", subjects=2, expressions=["neutral", "smile"], seed=7)
    assert seen == [(1, 1)]
    name = "subject_000_smile.ply"
    assert (few / name).read_bytes() == (many / name).read_bytes()
    mesh = read_mesh(many / "subject_001_neutral.ply")
    assert np.array_equal(mesh.faces, faces.template.faces)
    person = faces.draw_person(np.random.default_rng([7, 1]))
    assert np.allclose(mesh.vertices, faces.face(person).vertices, atol=1e-4)
    with (many / "labels.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [r["expression"] for r in rows] == ["neutral", "smile"] * 2
    assert rows[3] == {
        "file": "subject_001_smile.ply",
        "subject": "subject_001",
        "expression": "smile",
        "intensity": "1",
    }
    with (many / "landmarks.csv").open(newline="") as stream:
        assert {r["name"]: int(r["vertex"]) for r in csv.DictReader(stream)} == dict(faces.landmarks)


def test_wide_people_and_faces_alone_are_written_beside_their_landmarks(tmp_path, faces):
    write_faces(tmp_path, subjects=1, seed=3, wide=True, face_only=True)
    person = faces.draw_person(np.random.default_rng([3, 0]), wide=True)
    written = read_mesh(tmp_path / "subject_000_neutral.ply")
    assert np.abs(written.vertices - faces.cut_to_face(faces.face(person)).vertices).max() < 1e-3
    with (tmp_path / "landmarks.csv").open(encoding="utf-8") as file:
        rows = {row["name"]: int(row["vertex"]) for row in csv.DictReader(file)}
    assert rows == dict(faces.face_landmarks)


@pytest.mark.parametrize(
    "wrong",
    [{"subjects": 0}, {"subjects": 10**9}, {"seed": -1}, {"expressions": ["grin"]}, {"expressions": []},
     {"expressions": ["fear", "fear"]}],
)  # fmt: skip
def test_impossible_orders_are_refused_before_anything_is_written(tmp_path, wrong):
    with pytest.raises(InputError):
        write_faces(tmp_path / "out", **({"subjects": 1} | wrong))
    assert not (tmp_path / "out").exists()


def test_impossible_weights_are_refused(faces):
    with pytest.raises(InputError, match="0 to 1"):
        Person(np.array([1.5]))
    with pytest.raises(InputError, match="weights"):
        faces.face(Person(np.array([0.5])))
    with pytest.raises(InputError, match="another number of vertices"):
        faces.face(Person(faces._generic, warp_mm=np.zeros((3, 3))))
    with pytest.raises(InputError, match="intensity"):
        faces.draw_expression("smile", 1.5, np.random.default_rng(0))
    with pytest.raises(InputError, match="grin"):
        faces.draw_expression("grin", 0.5, np.random.default_rng(0))


def test_a_damaged_bundle_is_reported_in_one_sentence(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "faces.npz").write_bytes((DATA / "faces.npz").read_bytes()[:1000])
    monkeypatch.setattr(module.importlib.resources, "files", lambda _: tmp_path)
    with pytest.raises(DataError, match=r"faces\.npz"):
        load_faces.__wrapped__()


def test_weak_expressions_are_written_with_their_intensity_and_full_ones_as_before(tmp_path: Path) -> None:
    asked = {"subjects": 3, "expressions": ("neutral", "smile"), "seed": 5, "face_only": True}
    full = write_faces(tmp_path / "full", **asked)
    weak = write_faces(tmp_path / "weak", **asked, intensities=(0.25, 0.5))
    with (weak / "labels.csv").open(newline="") as stream:
        told = {row["file"]: float(row["intensity"]) for row in csv.DictReader(stream)}
    assert {told[f"subject_00{k}_smile.ply"] for k in range(3)} <= {0.25, 0.5}
    for k in range(3):
        rest, smile, weakly = (
            read_mesh(folder / f"subject_00{k}_{name}.ply").vertices
            for folder, name in ((full, "neutral"), (full, "smile"), (weak, "smile"))
        )
        # Units add up, so a weak smile is the share of the full one that its label says.
        np.testing.assert_allclose(weakly - rest, told[f"subject_00{k}_smile.ply"] * (smile - rest), atol=0.05)
    with pytest.raises(InputError, match="above 0 and at most 1"):
        write_faces(tmp_path / "none", **asked, intensities=(0.0,))
