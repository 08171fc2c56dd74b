"""MONAI-Physio and GIAS2, from files laid out here as their writers do (json.dump and numpy.savez)."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import InputError, ShapespaceError
from shapespace.formats.gias_monai import read_gias, read_monai
from shapespace.formats.registry import READ_ONLY_MODELS, format_to_write, is_known, read_linear
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh
from synthetic_shapes import blob_model


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return blob_model(300)


def monai(folder: Path, model: ShapeModel) -> Path:
    folder.mkdir()
    variance = model.stddev**2
    tree = {
        "explained_variance_ratio": (variance / model.total_variance).tolist(),
        "eigenvalues": variance.tolist(),
        "components": model.vertex_basis.T.tolist(),
    }
    (folder / "pca_model.json").write_text(json.dumps(tree, indent=2))
    write_mesh(folder / "pca_mean_surface.vtp", Mesh(model.mean_vertices, model.faces))
    return folder


def gias(path: Path, model: ShapeModel, *, blocked: bool = False, scores: bool = True, **more: object) -> Path:
    """As `PrincipalComponents.savez`: what there is not becomes a pickled None."""
    mean, modes = model.mean_vertices.ravel(), model.vertex_basis
    if blocked:
        mean = mean.reshape(-1, 3).T.ravel()
        modes = modes.reshape(-1, 3, model.n_modes).transpose(1, 0, 2).reshape(modes.shape)
    arrays: dict[str, object] = {
        "mean": mean,
        "weights": np.concatenate([model.stddev**2, [1e-30]]),
        "modes": modes,
        "SD": None,
        "sizes": None,
        "projectedWeights": np.zeros((model.n_modes, 23)) if scores else None,
    }
    np.savez(path, **(arrays | more))  # pyright: ignore
    return path


@pytest.mark.parametrize("given", ["folder", "file"])
def test_monai_physio_is_read_with_its_surface_and_total_variance(
    given: str, model: ShapeModel, tmp_path: Path
) -> None:
    folder = monai(tmp_path / "heart", model)
    path = folder if given == "folder" else folder / "pca_model.json"
    one, found = read_linear(path)
    assert one.name == "monai-physio"
    assert np.allclose(found.mean, model.mean_vertices) and np.array_equal(found.faces, model.faces)  # pyright: ignore
    again = ShapeModel.load(path)
    assert np.allclose(again.stddev, model.stddev) and np.allclose(np.abs(again.basis.T @ model.basis), np.eye(5))
    assert again.total_variance == pytest.approx(model.total_variance)


@pytest.mark.parametrize(
    ("change", "said"),
    [("no surface", "needs the surface"), ("other surface", "do not match"), ("text", "of numbers"), ("cut", "JSON")],
)
def test_damaged_monai_physio_is_refused_in_one_sentence(
    change: str, said: str, model: ShapeModel, tmp_path: Path
) -> None:
    folder = monai(tmp_path / "heart", model)
    file = folder / "pca_model.json"
    if change == "no surface":
        (folder / "pca_mean_surface.vtp").unlink()
    elif change == "other surface":
        write_mesh(folder / "pca_mean_surface.vtp", Mesh(np.eye(3)))
    elif change == "text":
        file.write_text('{"eigenvalues": ["a"], "components": [[1], [1, 2]]}')
    else:
        file.write_bytes(file.read_bytes()[:-5])
    with pytest.raises(ShapespaceError, match=said) as refused:
        read_monai(file)
    assert str(refused.value).endswith(".") and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("ending", "blocked"), [(".ply", False), (".ply", True), (".stl", False), (".stl", True), (None, False)]
)
def test_gias_is_read_with_the_surface_beside_it(
    ending: str | None, blocked: bool, model: ShapeModel, tmp_path: Path
) -> None:
    path = gias(tmp_path / "tibia.pc.npz", model, blocked=blocked)
    if ending is not None:
        write_mesh(tmp_path / f"tibia_mean{ending}", Mesh(model.mean_vertices, model.faces))
    one, found = read_linear(path)
    assert one.name == "gias" and found.n_training == 23
    assert np.allclose(found.mean, model.mean_vertices)
    assert np.allclose(found.shape.moved, model.vertex_basis * model.stddev)
    if ending is None:
        assert found.faces is None and "point model" in found.notes[0]
    else:
        assert {frozenset(row) for row in found.faces.tolist()} == {  # pyright: ignore
            frozenset(row)
            for row in model.faces.tolist()  # pyright: ignore
        }


def test_coordinates_that_were_divided_by_their_spread_are_multiplied_again(model: ShapeModel, tmp_path: Path) -> None:
    each = np.linspace(1, 2, 900)
    path = gias(tmp_path / "a.pc.npz", model, SD=each, scores=False)
    found = read_gias(path)
    assert np.allclose(found.shape.moved, model.vertex_basis * model.stddev * each[:, None])
    assert found.n_training is None


def test_a_surface_of_another_mean_is_refused(model: ShapeModel, tmp_path: Path) -> None:
    path = gias(tmp_path / "a.pc.npz", model)
    write_mesh(tmp_path / "a_mean.ply", Mesh(model.mean_vertices + 1, model.faces))
    with pytest.raises(ShapespaceError, match="another mean"):
        read_gias(path)


def test_pickles_and_bombs_are_refused(model: ShapeModel, tmp_path: Path) -> None:
    path = gias(tmp_path / "a.pc.npz", model, modes=np.array([{}], dtype=object))
    assert is_known(path)
    with pytest.raises(ShapespaceError, match="contains objects"):
        read_gias(path)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mean.npy", bytes(50_000_000))
    path.write_bytes(out.getvalue())
    with pytest.raises(ShapespaceError, match="unpack to far more"):
        read_gias(path)
    good = gias(path, model).read_bytes()
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(ShapespaceError):
        read_gias(path)


@pytest.mark.parametrize("name", READ_ONLY_MODELS)
def test_formats_that_are_only_read_say_so(name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="can only be read; choose one of eos"):
        format_to_write(tmp_path / "a.h5", name)


def test_files_of_other_kinds_are_not_theirs(model: ShapeModel, tmp_path: Path) -> None:
    (tmp_path / "marks.json").write_text('[{"id": "a", "coordinates": [1, 2, 3]}]')
    np.savez(tmp_path / "arrays.npz", mean=np.zeros(3))
    np.savez(tmp_path / "other.pc.npz", x=np.zeros(3))
    assert not any(is_known(tmp_path / name) for name in ("marks.json", "arrays.npz", "other.pc.npz"))
