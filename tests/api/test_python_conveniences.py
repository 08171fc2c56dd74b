"""Small things that users of other packages expect of the Python interface."""

import dataclasses
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shapespace as ss
from shapespace.cohort.table import Table
from shapespace.errors import FileError, FileFormatError, InputError, MeshError
from shapespace.io.containers.row_spill import Spill
from shapespace.io.files import read_error, write_error


def meshes(count: int = 6, vertices: int = 30) -> list[ss.Mesh]:
    """Shapes that are noise about random points."""
    rng = np.random.default_rng(0)
    base = 50.0 * rng.normal(size=(vertices, 3))
    return [ss.Mesh(base + rng.normal(size=base.shape), name=f"shape{k}") for k in range(count)]


def test_a_seed_is_taken_where_a_generator_is() -> None:
    model = ss.build_model(meshes(), ss.BuildConfig(modes=3))
    expected = np.random.default_rng(7).standard_normal((2, 3)) * model.stddev
    for rng in (7, np.int64(7), np.random.default_rng(7)):
        np.testing.assert_array_equal(model.sample(2, rng), expected)  # type: ignore[arg-type]
    for wrong in (-1, 1.5, "a", None, True):
        with pytest.raises(InputError, match="takes a seed from 0 or a "):
            model.sample(2, wrong)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="a number of shapes, not -1"):
        model.sample(-1, 0)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"modes": -3}, "one mode or more, not -3"), ({"modes": 0}, "one mode or more"), ({"modes": 1.5}, "not at 1.5"),
        ({"modes": "most"}, "'most'"), ({"modes": float("nan")}, "nan"),
        ({"gauge": "size"}, "no gauge 'size'"), ({"min_seen": 2}, "from 0 to 1, not 2"), ({"min_seen": "x"}, "not 'x'"),
        ({"seed": -1}, "not -1"), ({"representation": "nurbs"}, "no representation 'nurbs'"),
        ({"control_points": (9, 9)}, "Only B-spline surfaces have control points"),
    ],
)  # fmt: skip
def test_options_of_a_model_are_refused_at_once(options: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        ss.BuildConfig(**options)


@pytest.mark.parametrize("options", [{}, {"modes": 3}, {"modes": np.int64(3)}, {"modes": 0.9}, {"modes": "auto"}])
def test_options_that_can_be_are_kept(options: dict[str, Any]) -> None:
    assert ss.BuildConfig(**options).modes == options.get("modes", "all")


def test_the_mean_of_a_model_is_its_vertices() -> None:
    shapes = meshes()
    model = ss.build_model(shapes, ss.BuildConfig(modes=3, align=False))
    expected = np.mean([mesh.vertices for mesh in shapes], axis=0)
    np.testing.assert_allclose(model.mean, expected, atol=1e-12)
    assert model.mean.shape == (30, 3) and not model.mean.flags.writeable
    flat = ss.ShapeModel(expected.ravel(), model.basis, model.stddev, model.total_variance, model.n_training)
    np.testing.assert_array_equal(flat.mean, expected)
    for same in (pickle.loads(pickle.dumps(model)), dataclasses.replace(model)):
        assert same.content_hash == model.content_hash
    with pytest.raises(InputError, match=r"mean \(V, 3\)"):
        ss.ShapeModel(expected.T, model.basis, model.stddev, model.total_variance, model.n_training)


def test_a_model_is_one_line() -> None:
    text = repr(ss.build_model(meshes(), ss.BuildConfig(modes=3)))
    assert "\n" not in text and len(text) < 140
    assert text.startswith("<ShapeModel of 6 shapes with 30 vertices, 3 modes, gauge shape; ")


def test_an_error_of_a_file_is_an_os_error_with_its_sentence(tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"Cannot read .*there is no such file; check the name\.") as caught:
        ss.read_mesh(tmp_path / "absent.ply")
    assert isinstance(caught.value, FileError)
    for error in (FileError("a sentence."), FileFormatError("a sentence.")):
        assert str(pickle.loads(pickle.dumps(error))) == "a sentence."
        assert read_error(tmp_path, error) is error and write_error(tmp_path, error) is error
    (tmp_path / "rows").write_bytes(b"other than the size")
    with pytest.raises(FileFormatError, match="cut short"):
        Spill(tmp_path / "rows", 2, 2, new=False)
    assert (tmp_path / "rows").exists(), "a file that is refused is not removed"


def test_meshes_have_the_measures_of_other_tools(tmp_path: Path) -> None:
    mesh = ss.Mesh([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, -1]], [[0, 1, 2]])  # type: ignore[arg-type]
    assert mesh.area == 3.0 and mesh.bounds.tolist() == [[0, 0, -1], [2, 3, 0]]
    assert ss.Mesh(mesh.vertices).area == 0.0
    mesh.export(tmp_path / "a.ply")
    mesh.export(str(tmp_path / "b.obj"))
    for name in ("a.ply", "b.obj"):
        np.testing.assert_array_equal(ss.read_mesh(tmp_path / name).vertices, mesh.vertices)
    with pytest.raises(FileFormatError):
        mesh.export(tmp_path / "a.docx")


def test_arrays_that_are_wrong_are_not_called_a_file() -> None:
    with pytest.raises(MeshError, match="points at vertex 9, but there are only 3 vertices, counted from 0") as caught:
        ss.Mesh(np.eye(3), np.array([[0, 1, 9]]))
    assert "damaged" not in str(caught.value)


def test_a_shape_space_takes_the_name_of_scikit_learn() -> None:
    shapes = meshes()
    space = ss.ShapeSpace(n_components=2).fit(shapes)
    np.testing.assert_array_equal(space.transform(shapes), ss.ShapeSpace(2).fit(shapes).transform(shapes))
    assert space.set_params(n_components=3).fit(shapes).n_features_out_ == 3
    with pytest.raises(InputError, match="modes is 2 and n_components 3"):
        ss.ShapeSpace(2, n_components=3).fit(shapes)


def test_a_table_in_memory_is_taken_where_a_file_is(tmp_path: Path) -> None:
    for mesh in meshes():
        ss.write_mesh(tmp_path / f"{mesh.name}.ply", mesh)
    names = [f"shape{k}" for k in (4, 0, 2)]
    config = ss.CohortConfig(shapes=tmp_path)
    columns = {"Specimen": names, "age": [3.0, None, 5.5], "family": [13.0, 14.0, float("nan")]}
    found = ss.read_cohort(columns, config)
    assert found.names == tuple(sorted(names))
    assert found.table.columns == {"age": ("", "5.5", "3"), "family": ("14", "", "13")}
    assert "3 of 6 specimens" in found.notes[0]
    with pytest.raises(InputError, match=r"CohortConfig\(shapes=...\)"):
        ss.read_cohort(columns)
    for wrong in (3, {}, {"age": [1]}, {"id": []}, {"id": ["a", None]}):
        with pytest.raises(InputError):
            ss.read_cohort(wrong, config)
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"sex": pandas.Categorical(["f", None, "m"]), "n": pandas.array([1, None, 2])}, names)
    for given in (frame, frame.rename_axis("id"), frame.reset_index(names="file")):
        found = ss.read_cohort(given, config)
        assert found.names == tuple(sorted(names))
        assert found.table.columns == {"sex": ("", "m", "f"), "n": ("", "2", "1")}
    numbered = pandas.DataFrame({"n": [1, 2]}, index=pandas.Index([7, 8], name="specimen"))
    assert Table.of(numbered).rows == ("7", "8")
    with pytest.raises(InputError, match="names no specimen"):
        Table.of(pandas.DataFrame({"n": [1, 2]}))


V, F = np.arange(60.0).reshape(20, 3) ** 1.5, np.array([[0, 1, 2], [2, 3, 4]])
SHAPES = np.stack([V + k * np.sin(V) for k in range(4)])
WRONG_ARRAYS: dict[str, tuple[Callable[[], object], str]] = {
    "vertices": (lambda: ss.Mesh(V[:, :2]), r"\(V, 3\), not \(20, 2\)"),
    "faces": (lambda: ss.Mesh(V, F + 30), "points at vertex 34.*correct the faces"),
    "fractions": (lambda: ss.Mesh(V, F + 0.5), "integers"),
    "model": (lambda: ss.ShapeModel(V, np.eye(60)[:, :1], np.ones(1), 1.0, 2, faces=F + 30), "correct the faces"),
    "projected": (lambda: ss.build_model(SHAPES).project(V[:, :2]), r"\(V, 3\), not \(20, 2\)"),
    "fitted": (lambda: ss.fit_scan(ss.build_model(SHAPES), V + np.nan), "no points with finite coordinates; correct"),
    "scans": (lambda: ss.correspond([ss.Mesh(V + np.nan, F)] * 2), "no points with finite coordinates; correct"),
    "cohort": (lambda: ss.Cohort.of_shapes(SHAPES[0], {}), r"\(N, V, 3\), not \(20, 3\)"),
    "faces of a cohort": (lambda: ss.Cohort.of_shapes(SHAPES, {}, faces=F + 30), "points at vertex 34"),
    "landmarks of a cohort": (lambda: ss.Cohort.of_shapes(SHAPES, {}, landmarks={"a": 99}), "'a' is at vertex 99"),
    "observed": (lambda: ss.Cohort.of_shapes(SHAPES, {}, observed=np.ones((3, 3), bool)), r"\(N, V\) \(4, 20\), not"),
}


@pytest.mark.parametrize("case", WRONG_ARRAYS)
def test_a_wrong_array_is_named_and_no_file_is_blamed(case: str) -> None:
    make, told = WRONG_ARRAYS[case]
    with pytest.raises((InputError, MeshError), match=told) as caught:
        make()
    assert "damaged" not in str(caught.value) and "cut short" not in str(caught.value)
