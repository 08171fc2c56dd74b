from pathlib import Path

import numpy as np
import pytest
from sklearn.base import clone
from sklearn.model_selection import GridSearchCV, cross_val_score
from sklearn.pipeline import make_pipeline

import shapespace as ss
from shapespace.batch.fit_records import failed_record, fit_record
from shapespace.errors import CorrespondenceError, FileFormatError, InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.schemas import File
from shapespace.types import Mesh
from synthetic_shapes import blob_model, raw_scan, similarity, training_meshes

MESHES = training_meshes(20, 300)


def test_it_gives_the_coefficients_of_the_model_in_standard_deviations():
    space = ss.ShapeSpace(modes=4).fit(MESHES)
    model = ss.ShapeModel.fit(MESHES, modes=4)
    assert space.model_hash_ == model.content_hash
    z = space.transform(MESHES[:3])
    np.testing.assert_allclose(z, [model.project(mesh) / model.stddev for mesh in MESHES[:3]])
    assert list(space.get_feature_names_out()) == ["z1", "z2", "z3", "z4"]
    assert space.transform([]).shape == (0, 4)


def test_its_settings_are_those_of_the_model():
    space = ss.ShapeSpace(modes=3, gauge="form", align=False).fit(MESHES)
    assert space.model_hash_ == ss.ShapeModel.fit(MESHES, modes=3, gauge="form", align=False).content_hash
    moved = Mesh(MESHES[0].vertices + 5.0, MESHES[0].faces)
    assert not np.allclose(space.transform([moved]), space.transform([MESHES[0]]))
    aligned = ss.ShapeSpace(modes=3).fit(MESHES)
    np.testing.assert_allclose(aligned.transform([moved]), aligned.transform([MESHES[0]]), atol=1e-6)


def test_back_and_forth_gives_the_same_coefficients():
    space = ss.ShapeSpace(model=blob_model(300)).fit([])
    z = np.random.default_rng(0).standard_normal((4, 5))
    meshes = space.inverse_transform(z)
    assert all(isinstance(mesh, Mesh) for mesh in meshes)
    np.testing.assert_allclose(space.transform(meshes), z, atol=1e-6)


def test_scans_are_fitted_and_fits_and_records_are_taken_as_they_are():
    model = blob_model(300)
    scan = raw_scan(np.array([0.5, -0.5, 1.0, 0.0, 0.3]), similarity(2, 8.0, 1.0)).scan
    config = FitConfig(max_iterations=20)
    result = fit_scan(model, scan, config)
    space = ss.ShapeSpace(model=model, meshes="scans", config=config).fit([])
    record = fit_record(result, File(name="s.ply", hash="a"), File(name="m.h5", hash=model.content_hash))
    failed = failed_record(
        File(name="t.ply", hash="b"), File(name="m.h5", hash=model.content_hash), "t.ply is empty.", {}
    )
    z = space.transform([scan, result, record, failed])
    np.testing.assert_allclose(z[:3], [result.z] * 3)
    assert np.isnan(z[3]).all()


def test_one_bad_scan_is_a_row_that_is_not_a_number_and_the_others_are_fitted():
    space = ss.ShapeSpace(model=blob_model(300), meshes="scans", config=FitConfig(max_iterations=5)).fit([])
    good = raw_scan(np.zeros(5), similarity(2, 8.0, 1.0)).scan
    bad = Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]]), name="flat.ply")
    with pytest.warns(UserWarning, match=r"Number 2 has no coefficients: flat\.ply"):
        z = space.transform([good, bad, good])
    assert np.isnan(z[1]).all()
    np.testing.assert_array_equal(z[0], z[2])
    assert np.isfinite(z[0]).all()


def test_what_does_not_belong_to_the_model_is_refused():
    model = blob_model(300)
    space = ss.ShapeSpace(model=model).fit([])
    scan = raw_scan(np.zeros(5), similarity(2, 8.0, 1.0)).scan
    with pytest.raises(CorrespondenceError, match="fit this mesh instead"):
        space.transform([scan])
    other = failed_record(File(name="t.ply", hash="b"), File(name="m.h5", hash="f" * 64), "t.ply is empty.", {})
    with pytest.raises(InputError, match=r"t\.ply was fitted with the model ffffffffffff"):
        space.transform([other])
    with pytest.raises(FileFormatError, match="record of number 1 is incomplete"):
        space.transform([{"status": "converged"}])
    with pytest.raises(InputError, match="int is not a mesh"):
        space.transform([3])
    with pytest.raises(InputError, match="meshes in correspondence"):
        ss.ShapeSpace().fit([other])
    with pytest.raises(InputError, match="no kind of meshes"):
        ss.ShapeSpace(meshes="raw").fit(MESHES)
    with pytest.raises(InputError, match="at most 5"):
        space.inverse_transform(np.zeros((1, 6)))


def test_a_clone_has_the_same_settings_and_is_not_fitted():
    model = blob_model(300)
    space = ss.ShapeSpace(0.9, gauge="form", model=model, seed=3).fit([])
    copy = clone(space)
    assert copy.get_params() == space.get_params()
    assert copy.model is model and not hasattr(copy, "model_")


def test_it_is_the_first_step_of_a_pipeline_that_can_be_cloned():
    labels = ["long" if np.ptp(mesh.vertices[:, 1]) > 205 else "short" for mesh in MESHES]
    labels[:2] = ["long", "short"]
    pipeline = make_pipeline(ss.ShapeSpace(modes=4), CLASSIFIERS["lda"](0))
    fitted = clone(pipeline).fit(MESHES, labels)
    assert fitted.predict_proba(MESHES[:5]).shape == (5, 2)
    assert fitted[0].model_hash_ == ss.ShapeModel.fit(MESHES, modes=4).content_hash


def partly_observed(meshes: tuple[Mesh, ...]) -> list[Mesh]:
    """Return meshes as correspond writes them: estimates where they are not observed, at vertices 0 to 8 most often."""
    out: list[Mesh] = []
    for k, mesh in enumerate(meshes):
        observed = np.ones(len(mesh.vertices), dtype=np.bool_)
        observed[: 9 if k % 5 else 3], observed[20 + 3 * k : 30 + 3 * k] = False, False
        out.append(Mesh(mesh.vertices, mesh.faces, name=mesh.name, observed=observed))
    return out


def test_meshes_with_rarely_observed_vertices_go_through_all_steps_of_scikit_learn():
    plain = training_meshes(12, 100)
    meshes = partly_observed(plain)
    space = ss.ShapeSpace(modes=3).fit(meshes)
    model, z = space.model_, space.transform(meshes)
    assert model.n_vertices == 91 and list(model.dropped_vertices) == list(range(9))
    np.testing.assert_allclose(z, [model.to_z(model.project(mesh)) for mesh in meshes])
    complete = ss.ShapeSpace(modes=3).fit_transform(plain)
    assert np.abs(np.corrcoef(z[:, 0], complete[:, 0])[0, 1]) > 0.95  # a fifth of the vertices is missing
    labels = ["long", "short"] * 6
    pipeline = make_pipeline(ss.ShapeSpace(modes=2), CLASSIFIERS["lda"](0))
    search = GridSearchCV(pipeline, {"shapespace__modes": [2]}, cv=2, error_score="raise", refit=False)
    score = search.fit(meshes, labels).cv_results_["mean_test_score"][0]
    assert score == cross_val_score(pipeline, meshes, labels, cv=2, error_score="raise").mean()


@pytest.mark.parametrize("kind", ["paths", "folder", "array"])
def test_paths_folders_and_arrays_are_taken_as_build_model_takes_them(kind: str, tmp_path: Path):
    meshes = [Mesh(mesh.vertices.astype(np.float32), mesh.faces) for mesh in MESHES[:6]]
    paths = [tmp_path / f"m{k}.ply" for k in range(6)]
    for path, mesh in zip(paths, meshes, strict=True):
        write_mesh(path, mesh)
    given = {"paths": paths, "folder": tmp_path, "array": np.stack([mesh.vertices for mesh in meshes])}[kind]
    space = ss.ShapeSpace(modes=3).fit(given)
    np.testing.assert_allclose(space.transform(given), ss.ShapeSpace(modes=3).fit_transform(meshes), atol=1e-9)
    model = ss.build_model(given, ss.BuildConfig(modes=3))
    assert model.content_hash == space.model_hash_ and model.n_training == 6
