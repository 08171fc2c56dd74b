import errno
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.errors import CorrespondenceError, FileError, InputError, ModelFileError
from shapespace.geometry.procrustes import centroid_size
from shapespace.io.containers.hdf5 import write_hdf5
from shapespace.model.choose_modes import choose_modes
from shapespace.model.model_quality import QualityConfig
from shapespace.model.pca import principal_components
from shapespace.model.shape_model import ShapeModel
from shapespace.store.results import Results
from shapespace.types import Mesh
from synthetic_shapes import blob_model, similarity, training_meshes


@pytest.fixture(scope="module", params=["form", "shape"])
def model(request: pytest.FixtureRequest) -> ShapeModel:
    return blob_model(gauge=request.param)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "blob.h5"
    blob_model(vertices=200).save(path)
    return path


def test_projecting_what_was_reconstructed_gives_the_coefficients_back(model: ShapeModel) -> None:
    for b in model.sample(5, np.random.default_rng(0)):
        assert np.allclose(model.project(model.reconstruct(b), align=False), b, atol=1e-10)


def test_reconstructing_what_was_projected_is_the_nearest_shape_of_the_model(model: ShapeModel) -> None:
    rng = np.random.default_rng(1)
    other = model.mean_vertices + 3 * rng.standard_normal(model.mean_vertices.shape)
    b = model.project(other, align=False)
    best = np.linalg.norm(model.reconstruct(b) - other)
    for step in rng.standard_normal((20, model.n_modes)):
        assert np.linalg.norm(model.reconstruct(b + step) - other) > best


def test_aligning_hardly_changes_a_shape_of_the_model(model: ShapeModel) -> None:
    # Least-squares size and centroid size differ by the square of the deformation, about (8 / 90)^2 here.
    b = model.stddev * np.array([1.0, -1.0, 0.5, 1.0, -0.5])
    assert np.abs(model.project(model.reconstruct(b)) - b).max() < 0.02 * np.abs(b).max()


def test_a_shape_has_the_same_coefficients_wherever_it_lies(model: ShapeModel) -> None:
    mesh = training_meshes()[3]
    b = model.project(mesh)
    for seed in range(3):
        T = similarity(seed, 100.0, 1.0 if model.gauge == "form" else 0.02 * 10**seed, 300.0)
        assert np.allclose(model.project(mesh.with_vertices(T.apply(mesh.vertices))), b, atol=1e-8)
    bigger = model.project(1.1 * np.asarray(mesh.vertices))
    assert np.allclose(bigger, b, atol=1e-8) == (model.gauge == "shape")


def test_the_gauge_says_whether_size_is_in_the_modes() -> None:
    meshes = [
        m.with_vertices(similarity(i, 60.0, 0.8 + 0.05 * i).apply(m.vertices))
        for i, m in enumerate(training_meshes()[:12])
    ]
    shape, form = (ShapeModel.fit(meshes, gauge=g) for g in ("shape", "form"))

    def growth(m: ShapeModel) -> float:
        small, large = (centroid_size(m.reconstruct(sign * m.stddev[:1])) for sign in (-1, 1))
        return abs(large - small) / centroid_size(m.mean_vertices)

    assert growth(form) > 0.2
    assert growth(shape) < 0.03
    assert form.total_variance > 10 * shape.total_variance


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_the_model_does_not_depend_on_where_the_training_meshes_lie(gauge: str) -> None:
    meshes = training_meshes(vertices=200)[:10]
    moved = [
        m.with_vertices(similarity(i, 0.0 if i == 0 else 90.0, 1.0, 1e3).apply(m.vertices))
        for i, m in enumerate(meshes)
    ]
    a, b = ShapeModel.fit(meshes, gauge=gauge), ShapeModel.fit(moved, gauge=gauge)
    assert np.allclose(a.stddev[:5], b.stddev[:5], rtol=1e-6)
    assert np.allclose(a.mean, b.mean, atol=1e-5)


def test_meshes_a_million_millimetres_away_give_the_same_model() -> None:
    meshes = training_meshes(vertices=200)[:10]
    far = [m.with_vertices(m.vertices + 1e6) for m in meshes]
    near, distant = ShapeModel.fit(meshes, modes=5), ShapeModel.fit(far, modes=5)
    assert np.allclose(near.stddev, distant.stddev, rtol=1e-6)
    assert np.allclose(near.mean, distant.mean, atol=1e-6)
    unaligned = ShapeModel.fit(far, modes=5, align=False)
    assert np.allclose(unaligned.stddev, ShapeModel.fit(meshes, modes=5, align=False).stddev, rtol=1e-6)


def test_without_alignment_the_meshes_are_taken_as_they_stand() -> None:
    meshes = training_meshes(vertices=200)
    model = ShapeModel.fit(meshes, align=False)
    assert model.n_modes == 5
    assert np.allclose(model.mean_vertices, np.mean([m.vertices for m in meshes], axis=0))
    for mesh in meshes[:5]:
        assert np.allclose(model.reconstruct(model.project(mesh, align=False)), mesh.vertices, atol=1e-8)


def test_samples_have_the_mean_and_spread_of_the_model(model: ShapeModel) -> None:
    b = model.sample(20000, np.random.default_rng(0))
    assert np.allclose(b.mean(axis=0) / model.stddev, 0, atol=0.03)
    assert np.allclose(np.cov((b / model.stddev).T), np.eye(model.n_modes), atol=0.05)
    assert np.array_equal(b, model.sample(20000, np.random.default_rng(0)))


def test_fewer_coefficients_mean_zeros_and_a_mesh_carries_triangles_and_landmarks(model: ShapeModel) -> None:
    b = np.zeros(5)
    b[:2] = 7.0, -3.0
    assert np.allclose(model.reconstruct(b[:2]), model.reconstruct(b), atol=1e-12)
    assert np.array_equal(model.reconstruct([]), model.mean_vertices)
    mesh = model.mesh(b)
    assert np.array_equal(mesh.faces, training_meshes()[0].faces)
    assert np.array_equal(mesh.landmarks["tip"], mesh.vertices[model.landmarks["tip"]])


@pytest.mark.parametrize("k", [1, 3, 5])
def test_truncation_adds_what_it_drops_to_the_noise_variance(k: int) -> None:
    meshes = training_meshes(vertices=200)
    full = ShapeModel.fit(meshes, align=False)
    short = full.truncate(k)
    data = np.stack([m.vertices.ravel() for m in meshes])
    b = (data - data.mean(axis=0)) @ short.basis
    left_over = ((data - short.mean.ravel() - b @ short.basis.T) ** 2).sum() / (len(meshes) - 1)
    assert short.noise_variance == pytest.approx(left_over / (600 - k), rel=1e-6, abs=1e-12)
    direct = ShapeModel.fit(meshes, modes=k, align=False)
    assert short.noise_variance == pytest.approx(direct.noise_variance, rel=1e-6, abs=1e-12)
    assert np.allclose(short.cumulative_variance, full.cumulative_variance[:k])
    assert full.cumulative_variance[-1] == pytest.approx(1.0)


@pytest.mark.parametrize(("share", "least", "most"), [(0.5, 1, 2), (0.985, 4, 5)])
def test_modes_by_share_of_the_variance(share: float, least: int, most: int) -> None:
    model = ShapeModel.fit(training_meshes(vertices=200), modes=share, align=False)
    assert least <= model.n_modes <= most
    assert model.cumulative_variance[-1] >= share


@pytest.mark.parametrize("noise_mm", [0.2, 1.0])
def test_auto_finds_about_as_many_modes_as_there_are(noise_mm: float) -> None:
    rng = np.random.default_rng(4)
    noisy = [
        m.with_vertices(m.vertices + noise_mm * rng.standard_normal(m.vertices.shape))
        for m in training_meshes(count=60, vertices=200)
    ]
    model = ShapeModel.fit(noisy, modes="auto")
    assert 4 <= model.n_modes <= 10
    # A share of the variance would have followed the noise instead.
    if noise_mm == 1.0:
        assert ShapeModel.fit(noisy, modes=0.999).n_modes > 20


def test_auto_needs_four_shapes_keeps_all_of_fewer_and_gives_the_same_twice() -> None:
    few = ShapeModel.fit(training_meshes(vertices=200)[:3], modes="auto")
    assert few.n_modes == 2
    assert few.notes == ("With 3 meshes the number of modes cannot be cross-validated, so all modes are kept.",)
    one, two = (ShapeModel.fit(training_meshes(vertices=200)[:9], modes="auto", seed=3) for _ in range(2))
    assert one.content_hash == two.content_hash


def test_two_meshes_give_one_mode() -> None:
    model = ShapeModel.fit(training_meshes(vertices=200)[:2])
    assert (model.n_modes, model.n_training) == (1, 2)


def test_point_clouds_make_a_model_too() -> None:
    clouds = [Mesh(m.vertices, name=m.name) for m in training_meshes(vertices=200)[:6]]
    assert ShapeModel.fit(clouds).mesh().faces is None


def replaced(index: int, mesh: Mesh) -> list[Mesh]:
    return [mesh if i == index else m for i, m in enumerate(training_meshes(vertices=200)[:4])]


def test_another_number_of_vertices_is_refused_by_name() -> None:
    short = Mesh(np.zeros((150, 3)) + np.arange(3), name="short.ply")
    with pytest.raises(CorrespondenceError, match=r"short\.ply has 150 vertices but blob_0\.ply has 200"):
        ShapeModel.fit(replaced(2, short))
    with pytest.raises(CorrespondenceError, match=r"short\.ply has 150 vertices but the model has 700"):
        blob_model().project(short)


@pytest.mark.parametrize("out_of_core", [False, True], ids=["in memory", "streamed"])
def test_the_same_triangles_in_any_order_rotation_and_orientation_are_those_of_the_first_mesh(
    out_of_core: bool,
) -> None:
    meshes = training_meshes(vertices=200)[:4]
    faces = meshes[0].faces
    assert faces is not None
    mixed = np.where(np.arange(len(faces))[:, None] % 2, faces, np.roll(faces[:, ::-1], 1, axis=1))
    other = [faces, faces[::-1], np.roll(faces, 1, axis=1), np.random.default_rng(0).permutation(mixed)]
    changed = [Mesh(mesh.vertices, own) for mesh, own in zip(meshes, other, strict=True)]
    known, model = (ShapeModel.fit(own, modes=3, out_of_core=out_of_core) for own in (meshes, changed))
    assert model.content_hash == known.content_hash and np.array_equal(model.faces, faces)


@pytest.mark.parametrize("faces", ["others", "none"])
def test_another_topology_is_refused_by_name(faces: str) -> None:
    base = training_meshes(vertices=200)[2]
    odd = Mesh(base.vertices, (base.faces + 1) % 200 if faces == "others" else None, name="odd.ply")
    with pytest.raises(CorrespondenceError, match=r"odd\.ply and blob_0\.ply have different triangles"):
        ShapeModel.fit(replaced(2, odd))


def test_vertices_that_are_not_finite_are_refused_by_name() -> None:
    vertices = np.array(training_meshes(vertices=200)[2].vertices)
    vertices[7, 1] = -np.inf
    with pytest.raises(InputError, match=r"bad\.ply has vertices that are not finite"):
        ShapeModel.fit(replaced(2, Mesh(vertices, training_meshes(vertices=200)[0].faces, name="bad.ply")))


@pytest.mark.parametrize("gauge", ["form", "shape"])
@pytest.mark.parametrize("index", [0, 2])
@pytest.mark.parametrize("how", ["point", "line"])
def test_a_training_mesh_without_extent_is_refused_by_name(gauge: str, index: int, how: str) -> None:
    along = np.zeros(200) if how == "point" else np.arange(200.0)
    flat = Mesh(np.outer(along, [1.0, 2.0, 3.0]) + 5.0, training_meshes(vertices=200)[0].faces, name="flat.ply")
    with pytest.raises(InputError, match=r"flat\.ply"):
        ShapeModel.fit(replaced(index, flat), gauge=gauge)


@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_equal_meshes_are_refused_even_in_other_poses(gauge: str, moved: bool) -> None:
    mesh = training_meshes(vertices=200)[0]
    meshes = [
        mesh.with_vertices(similarity(i, 30.0, 1.0, 200.0).apply(mesh.vertices) if moved else mesh.vertices)
        for i in range(5)
    ]
    with pytest.raises(InputError, match="all equal"):
        ShapeModel.fit(meshes, gauge=gauge)


def test_too_few_meshes_are_refused() -> None:
    for n in (0, 1):
        with pytest.raises(InputError, match="at least two"):
            ShapeModel.fit(training_meshes(vertices=200)[:n])


def test_coefficients_and_shapes_that_do_not_fit_are_refused(model: ShapeModel) -> None:
    with pytest.raises(InputError, match="at most 5"):
        model.reconstruct(np.zeros(6))
    with pytest.raises(InputError, match="finite"):
        model.reconstruct([np.nan])
    with pytest.raises(InputError, match="finite"):
        model.project(np.full((700, 3), np.inf))
    with pytest.raises(InputError, match=r"the shape \(V, 3\), not \(2100,\)"):
        model.project(np.zeros(2100))
    for k in (0, 6):
        with pytest.raises(InputError, match="cannot be cut"):
            model.truncate(k)


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    m = blob_model(vertices=200)
    for change in (
        {"basis": m.basis[:, :3]},
        {"mean": m.mean.ravel()[:-1]},
        {"stddev": np.zeros(0)},
        {"stddev": -m.stddev},
        {"stddev": 0 * m.stddev},
        {"mean": m.mean * np.nan},
        {"landmarks": {"x": 200}},
        {"representation": "splines"},
        {"gauge": "size"},
    ):
        fields = {k: getattr(m, k) for k in ("mean", "basis", "stddev", "total_variance", "n_training", "faces")}
        with pytest.raises(InputError):
            ShapeModel(**(fields | change))


@pytest.mark.parametrize(("times", "said"), [(1e-30, "less than the rounding"), (1e12, "no shape of its size")])
def test_standard_deviations_that_cannot_be_are_refused_in_one_sentence(
    saved: Path, tmp_path: Path, times: float, said: str
) -> None:
    model = ShapeModel.load(saved)
    with pytest.raises(InputError, match=said):
        replace(model, stddev=model.stddev * [1.0, *[times] * (model.n_modes - 1)])
    with h5py.File(saved) as file:
        arrays = {k: v[()] for k, v in file.items()} | {"stddev": model.stddev * times}
        attributes = {k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}
    write_hdf5(tmp_path / "m.h5", arrays, attributes)
    with pytest.raises(ModelFileError, match=said):
        ShapeModel.load(tmp_path / "m.h5")


def test_models_a_thousand_times_too_narrow_or_too_wide_are_no_error(model: ShapeModel) -> None:
    for times in (1e-3, 1e3):
        assert replace(model, stddev=model.stddev * times).n_modes == model.n_modes


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_a_saved_model_loads_as_it_was(tmp_path: Path, gauge: str) -> None:
    model = blob_model(gauge=gauge)
    model.save(tmp_path / "m.h5")
    loaded = ShapeModel.load(tmp_path / "m.h5")
    for name in ("mean", "basis", "stddev", "faces"):
        assert np.array_equal(getattr(model, name), getattr(loaded, name))
    for name in ("total_variance", "n_training", "gauge", "representation", "provenance", "licence", "content_hash"):
        assert getattr(model, name) == getattr(loaded, name)
    assert dict(loaded.landmarks) == dict(model.landmarks)
    assert len(loaded.landmarks) == 4
    assert loaded.licence == "CC0"
    assert loaded.noise_variance == model.noise_variance
    replace(model, is_n_training_known=False).save(tmp_path / "m.h5")
    assert loaded.is_n_training_known and not ShapeModel.load(tmp_path / "m.h5").is_n_training_known


def test_landmarks_from_numpy_and_unicode_text_survive(tmp_path: Path) -> None:
    model = ShapeModel.fit(
        training_meshes(vertices=200)[:4],
        landmarks={"näse": np.int64(3)},
        provenance="Gesichter «éà» 顔",
        licence="CC BY 4.0",
    )
    model.save(tmp_path / "m.h5")
    loaded = ShapeModel.load(tmp_path / "m.h5")
    assert dict(loaded.landmarks) == {"näse": 3}
    assert loaded.provenance == "Gesichter «éà» 顔"


def test_a_point_model_has_no_faces_in_its_file(tmp_path: Path) -> None:
    ShapeModel.fit([Mesh(m.vertices) for m in training_meshes(vertices=200)[:4]]).save(tmp_path / "m.h5")
    assert ShapeModel.load(tmp_path / "m.h5").faces is None


def test_the_hash_is_of_the_content(tmp_path: Path, saved: Path) -> None:
    model = ShapeModel.load(saved)
    assert model.content_hash == blob_model(vertices=200).content_hash
    assert model.truncate(4).content_hash != model.content_hash
    with h5py.File(saved) as file:
        assert file.attrs["model_hash"] == model.content_hash


def test_the_file_says_what_it_is_and_holds_no_pickle(saved: Path) -> None:
    with h5py.File(saved) as file:
        said = dict(file.attrs)
        kinds = {name: item.dtype.kind for name, item in file.items()}
    assert said["format"] == "shapespace model"
    assert said["units"] == "mm"
    assert said["variance_divisor"] == "N - 1"
    assert {"gauge", "landmarks", "provenance", "licence", "software_version", "content_hash"} <= set(said)
    assert set(kinds.values()) <= {"f", "i"}
    data = saved.read_bytes()
    assert b"cnumpy" not in data
    assert b"pickle" not in data


def test_every_cut_is_noticed(saved: Path, tmp_path: Path) -> None:
    data = saved.read_bytes()
    damaged = tmp_path / "cut.h5"
    for length in (1, 10, 100, 511, 512, 513, 520, 2000, len(data) // 2, len(data) - 513, len(data) - 1):
        damaged.write_bytes(data[:length])
        with pytest.raises(ModelFileError, match=r"cut\.h5"):
            ShapeModel.load(damaged)
    for more in (b"\0", data):
        damaged.write_bytes(data + more)
        with pytest.raises(ModelFileError, match="damaged"):
            ShapeModel.load(damaged)


def test_every_changed_byte_is_noticed(saved: Path, tmp_path: Path) -> None:
    data = saved.read_bytes()
    rng = np.random.default_rng(0)
    places = [0, 5, 17, 18, 50, 81, 82, 83, 300, 511, 512, 513, 520, len(data) - 1]
    for at in [*places, *rng.integers(0, len(data), 50).tolist()]:
        changed = bytearray(data)
        changed[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "changed.h5").write_bytes(changed)
        with pytest.raises(ModelFileError, match=r"changed\.h5"):
            ShapeModel.load(tmp_path / "changed.h5")


@pytest.mark.parametrize(
    "content",
    [b"", b"\n", b"ply\nformat ascii 1.0\n", bytes(range(256)) * 20, b"\x89HDF\r\n\x1a\n" + bytes(300)],
    ids=["empty", "blank", "ply", "noise", "signature only"],
)
def test_what_is_not_a_model_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "other.h5").write_bytes(content)
    with pytest.raises(ModelFileError, match=r"other\.h5"):
        ShapeModel.load(tmp_path / "other.h5")


def test_other_hdf5_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["a"] = np.zeros(5)
        file["text"] = "words"
        file.create_group("g")
    with pytest.raises(ModelFileError, match="not a shapespace model"):
        ShapeModel.load(path)


def test_a_file_that_declares_more_than_it_holds_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    with h5py.File(path, "w") as file:
        file.attrs["format"] = "shapespace model"
        file.create_dataset("mean", shape=(10**12,), dtype="f8", chunks=(1024,))
    assert path.stat().st_size < 1e5
    with pytest.raises(ModelFileError, match="declares"):
        ShapeModel.load(path)


@pytest.mark.parametrize(
    ("attributes", "said"),
    [
        ({"format": "shapespace model", "format_version": 3}, "version 3"),
        ({"format": "shapespace model", "format_version": 2}, "missing"),
        ({"format": "shapespace model"}, "version None"),
        ({"format": "shapespace model", "format_version": 1}, "version 1"),
        ({"format": "a cat"}, "not a shapespace model"),
    ],
)
def test_other_versions_and_models_with_missing_parts_are_refused(
    tmp_path: Path, attributes: dict[str, str | int], said: str
) -> None:
    write_hdf5(tmp_path / "m.h5", {"mean": np.zeros(6)}, attributes)
    with pytest.raises(ModelFileError, match=rf"m\.h5.*{said}"):
        ShapeModel.load(tmp_path / "m.h5")


def test_a_file_whose_parts_do_not_belong_together_is_refused(saved: Path, tmp_path: Path) -> None:
    with h5py.File(saved) as file:
        arrays = {k: v[()] for k, v in file.items()}
        attributes = {k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}
    for wrong in ({"stddev": arrays["stddev"][:2]}, {"mean": np.float64(3.0)}, {"faces": arrays["faces"] + 190}):
        write_hdf5(tmp_path / "m.h5", {k: np.asarray(v) for k, v in (arrays | wrong).items()}, attributes)
        with pytest.raises(ModelFileError, match=r"m\.h5"):
            ShapeModel.load(tmp_path / "m.h5")


def test_missing_files_and_folders_are_named(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.h5: there is no such file"):
        ShapeModel.load(tmp_path / "none.h5")
    with pytest.raises(FileError, match="it is a folder"):
        ShapeModel.load(tmp_path)
    (tmp_path / "file").write_text("x")
    for target in (tmp_path / "no" / "m.h5", tmp_path / "file" / "m.h5"):
        with pytest.raises(FileError, match=r"Cannot write .*m\.h5"):
            blob_model(vertices=200).save(target)


@pytest.mark.parametrize(("code", "said"), [(errno.ENOSPC, "disk is full"), (errno.EACCES, "no permission")])
def test_a_failed_save_names_the_file_and_leaves_the_old_one(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, said: str
) -> None:
    target = tmp_path / "m.h5"
    target.write_bytes(saved.read_bytes())

    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(FileError, match=rf"m\.h5: .*{said}"):
        blob_model(vertices=200).truncate(2).save(target)
    assert [p.name for p in tmp_path.iterdir()] == ["m.h5"]
    assert ShapeModel.load(target).n_modes == 5


def test_turning_a_model_shape_about_does_not_matter_at_any_angle(model: ShapeModel) -> None:
    x = model.reconstruct(model.stddev)
    b = model.project(x)
    for R in Rotation.create_group("O").as_matrix():
        assert np.allclose(model.project(x @ R.T), b, atol=1e-8)


def test_the_choice_of_modes_is_the_smallest_within_one_standard_error_of_the_best() -> None:
    rng = np.random.default_rng(4)
    modes = np.linalg.qr(rng.standard_normal((600, 25)))[0] * np.geomspace(100, 1, 25)
    data = rng.standard_normal((60, 25)) @ modes.T
    choice = choose_modes(data + 0.5 * rng.standard_normal(data.shape))
    best = choice.error_mm.argmin()
    near = choice.error_mm <= choice.error_mm[best] + choice.standard_error_mm[best]
    assert choice.modes == choice.candidates[near].min()
    assert choice.modes < choice.candidates[best]
    # Hidden vertices cannot be told better than their own noise, sqrt(8 / pi) of its deviation in three dimensions.
    assert 0.5 * np.sqrt(8 / np.pi) < choice.error_mm[best] < 1.3
    assert choice.error_mm[0] > 2 * choice.error_mm[best]


def plain_error_curve(data: np.ndarray, candidates: np.ndarray) -> np.ndarray:
    """Return the mean error of hidden vertices by one model a fold, written out."""
    (n, d), rng = data.shape, np.random.default_rng(0)
    errors = np.zeros((n, len(candidates)))
    for held_out in np.array_split(rng.permutation(n), 5):
        pc = principal_components(np.delete(data, held_out, axis=0))
        shown = np.zeros(d // 3, dtype=bool)
        shown[rng.permutation(d // 3)[: d // 6]] = True
        seen = np.repeat(shown, 3)
        for column, k in enumerate(np.minimum(candidates, len(pc.variance))):
            noise = max((pc.total_variance - pc.variance[:k].sum()) / (d - k), 1e-6 * pc.variance[0] / d)
            P = pc.basis[seen, :k]
            for i in held_out:
                b = np.linalg.solve(P.T @ P + noise * np.diag(1 / pc.variance[:k]), P.T @ (data[i] - pc.mean)[seen])
                wrong = (data[i] - pc.mean - pc.basis[:, :k] @ b)[~seen].reshape(-1, 3)
                errors[i, column] = np.linalg.norm(wrong, axis=1).mean()
    return errors.mean(axis=0)


@pytest.mark.parametrize("rank", [4, 40])
def test_the_errors_that_choose_the_modes_are_those_of_one_model_a_fold(rank: int) -> None:
    rng = np.random.default_rng(7)
    data = 30.0 + rng.standard_normal((27, rank)) * np.geomspace(50, 0.5, rank) @ rng.standard_normal((rank, 300))
    choice = choose_modes(data)
    np.testing.assert_allclose(choice.error_mm, plain_error_curve(data, choice.candidates), rtol=1e-6, atol=1e-9)


def test_modes_for_a_share_that_the_kept_modes_do_not_reach_are_none():
    model = blob_model()
    for share in (0.5, 0.9, float(model.cumulative_variance[-1])):
        k = model.modes_for_variance(share)
        assert k is not None
        assert model.cumulative_variance[k - 1] >= share - 1e-12
        assert k == 1 or model.cumulative_variance[k - 2] < share
    assert model.truncate(1).modes_for_variance(0.999) is None


def test_coefficients_in_mm_and_in_standard_deviations_are_each_others_inverse():
    model = blob_model(300)
    z = np.random.default_rng(0).standard_normal((3, 2, 4))
    b = model.to_b(z)
    np.testing.assert_allclose(b, z * model.stddev[:4])
    np.testing.assert_allclose(model.to_z(b), z)
    np.testing.assert_allclose(model.to_z(b[0, 0]), z[0, 0])
    for wrong in (np.zeros(6), 1.0):
        with pytest.raises(InputError, match="at most 5"):
            model.to_z(wrong)


def test_arguments_of_another_type_are_refused_in_a_sentence() -> None:
    calls: list[Callable[[], object]] = [
        lambda: QualityConfig(folds="a"),  # type: ignore[arg-type]
        lambda: ShapeModel.load(3),  # type: ignore[arg-type]
        lambda: Results(3),  # type: ignore[arg-type]
    ]
    for call in calls:
        with pytest.raises(InputError, match=r", not (str|int); give "):
            call()
