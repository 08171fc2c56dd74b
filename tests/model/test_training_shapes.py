"""The training shapes that a model contains: exact, no part of its identity, and in no copy of it."""

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.geometry.similarity import fit_similarity
from shapespace.model import training_shapes
from shapespace.model.build_model import BuildConfig, build_model, extend_model
from shapespace.model.shape_model import ShapeModel
from shapespace.model.training_shapes import TrainingShapes
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import similarity, training_meshes

SOME = np.arange(0, 200, 3, dtype=np.int32)
SIZES = np.array([0.8 + 0.02 * i for i in range(12)])


def posed(noise_mm: float = 0.5) -> list[Mesh]:
    """Return noisy blobs (all of their modes are significant), each in a pose and of one of the sizes `SIZES`."""
    rng = np.random.default_rng(0)
    return [
        mesh.with_vertices(
            similarity(i, 35.0, size).apply(mesh.vertices + noise_mm * rng.standard_normal(mesh.vertices.shape))
        )
        for i, (size, mesh) in enumerate(zip(SIZES, training_meshes(len(SIZES), 200), strict=True))
    ]


def reconstructed(model: ShapeModel) -> FloatArray:
    """Return the training shapes (n, V, 3) that the model contains."""
    training = model.training
    assert training is not None
    modes = np.concatenate([model.vertex_basis, training.rest], axis=1)
    assert np.allclose(modes.T @ modes, np.eye(modes.shape[1]), atol=1e-8)
    return (model.mean_vertices.ravel() + training.coefficients @ modes.T).reshape(len(training), -1, 3)


def poses_apart_mm(shapes: FloatArray, meshes: list[Mesh], *, with_scale: bool = True) -> float:
    """Return the largest distance of a vertex of `shapes` (n, V, 3) from its mesh in the best pose."""
    return max(
        float(np.abs(fit_similarity(m.vertices, s, with_scale=with_scale).apply(m.vertices) - s).max())
        for m, s in zip(meshes, shapes, strict=True)
    )


@pytest.mark.parametrize(
    "options",
    [
        {}, {"modes": 3}, {"gauge": "form"}, {"gauge": "form", "modes": 3}, {"modes": 3, "alignment_vertices": SOME},
        {"align": False}, {"align": False, "modes": 2}, {"modes": "auto"},
    ],
)  # fmt: skip
def test_the_coefficients_reconstruct_the_aligned_training_shapes(options: dict[str, Any]) -> None:
    meshes = posed()
    model = build_model(meshes, BuildConfig(**options))
    shapes = reconstructed(model)
    with_scale = options.get("gauge", "shape") == "shape" and options.get("align", True)
    assert poses_apart_mm(shapes, meshes, with_scale=with_scale) < 1e-9
    if not options.get("align", True):
        assert np.abs(shapes - np.stack([mesh.vertices for mesh in meshes])).max() < 1e-9


def test_truncating_a_model_keeps_its_training_shapes() -> None:
    meshes = posed()
    model = build_model(meshes, BuildConfig(modes=6))
    cut = model.truncate(2)
    assert cut.training is not None and cut.training.coefficients.shape[1] == cut.n_modes + cut.training.rest.shape[1]
    assert np.abs(reconstructed(cut) - reconstructed(model)).max() < 1e-9
    assert poses_apart_mm(reconstructed(cut), meshes) < 1e-9


@pytest.mark.parametrize("options", [{"modes": 2}, {"modes": 2, "out_of_core": True}, {}])
def test_all_modes_together_span_all_training_shapes(options: dict[str, Any]) -> None:
    model = build_model(posed(), BuildConfig(**options))
    whole = model.with_all_modes
    assert whole.n_modes == len(SIZES) - 1
    for shape in reconstructed(model):
        assert np.abs(whole.reconstruct(whole.project(shape, align=False)) - shape).max() < 1e-6
    assert np.allclose(reconstructed(whole), reconstructed(model), atol=1e-9)


@pytest.mark.parametrize("representation", ["bspline", "bspline-detail"])
def test_training_shapes_of_a_model_of_b_splines_are_the_meshes_and_not_what_coding_makes_of_them(
    representation: str,
) -> None:
    from test_bspline_model import meshes as sheets

    meshes = sheets()
    model = build_model(meshes, BuildConfig(representation=representation, control_points=(8, 8), modes=2))
    shapes = reconstructed(model)
    coded = np.stack([model.reconstruct(model.project(shape, align=False)) for shape in shapes])
    loss_mm = np.abs(coded - shapes).max()
    assert poses_apart_mm(shapes, meshes) < 0.1 * loss_mm


def test_missing_vertices_are_reconstructed_where_they_were_observed() -> None:
    meshes = posed()
    holed = [mesh.with_vertices(mesh.vertices.copy()) for mesh in meshes]
    for i, mesh in enumerate(holed):
        vertices = mesh.vertices.copy()
        vertices[10 * i : 10 * i + 10] = np.nan
        holed[i] = mesh.with_vertices(vertices)
    model = build_model(holed, BuildConfig(modes=3))
    for i, shape in enumerate(reconstructed(model)):
        there = np.isfinite(holed[i].vertices).all(axis=1)
        seen = Mesh(holed[i].vertices[there], None, name="seen")
        assert poses_apart_mm(shape[there][None], [seen]) < 1e-2


@pytest.mark.parametrize("out_of_core", [False, True])
@pytest.mark.parametrize("alignment_vertices", [None, SOME])
def test_the_sizes_that_alignment_removed_are_those_of_the_meshes(out_of_core: bool, alignment_vertices: Any) -> None:
    meshes = posed()
    model = build_model(meshes, BuildConfig(out_of_core=out_of_core, alignment_vertices=alignment_vertices))
    training = model.training
    assert training is not None
    removed = np.log(
        [
            fit_similarity(shape, mesh.vertices, with_scale=True).scale
            for shape, mesh in zip(reconstructed(model), meshes, strict=True)
        ]
    )
    assert np.allclose(training.log_scale, removed - removed.mean(), atol=1e-6)
    assert training.log_scale_stddev == pytest.approx(
        training.log_scale.std(ddof=1) * np.sqrt(1 + 1 / len(SIZES)), rel=1e-9
    )
    assert training.log_scale.mean() == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("options", [{"gauge": "form"}, {"align": False}])
@pytest.mark.parametrize("out_of_core", [False, True])
def test_size_that_is_part_of_the_modes_has_no_spread_of_its_own(options: dict[str, Any], out_of_core: bool) -> None:
    training = build_model(posed(), BuildConfig(**options, out_of_core=out_of_core)).training
    assert training is not None and training.log_scale_stddev is None and not training.log_scale.any()


def test_streamed_shapes_and_shapes_that_are_added_are_those_of_all_meshes(tmp_path: Path) -> None:
    meshes = posed()
    first = build_model(meshes[:8], BuildConfig(modes=2), keep_shapes=tmp_path / "kept")
    model = extend_model(first, meshes[8:], tmp_path / "kept", BuildConfig(modes=2))
    assert poses_apart_mm(reconstructed(first), meshes[:8]) < 1e-3  # the file has single precision
    assert poses_apart_mm(reconstructed(model), meshes) < 1e-3
    in_memory = build_model(meshes, BuildConfig(modes=2)).training
    assert model.training is not None and in_memory is not None
    assert np.allclose(model.training.log_scale, in_memory.log_scale, atol=1e-6)
    config = BuildConfig(modes=2, without_training_shapes=True)
    assert extend_model(first, meshes[8:], tmp_path / "kept", config).training is None


def test_the_hash_does_not_depend_on_training_shapes_and_a_file_keeps_them(tmp_path: Path) -> None:
    model, without = (
        build_model(posed(), BuildConfig(modes=3, without_training_shapes=leave_out)) for leave_out in (False, True)
    )
    assert without.training is None and model.content_hash == without.content_hash
    model.save(tmp_path / "model.h5")
    without.save(tmp_path / "without.h5")
    loaded = ShapeModel.load(tmp_path / "model.h5")
    assert loaded.training is not None and model.training is not None
    for name in ("coefficients", "rest", "log_scale"):
        assert np.array_equal(getattr(loaded.training, name), getattr(model.training, name))
    assert loaded.content_hash == model.content_hash
    assert ShapeModel.load(tmp_path / "without.h5").training is None
    content = (tmp_path / "without.h5").read_bytes()
    assert model.training.coefficients[3].tobytes() not in content
    assert model.training.coefficients[3].tobytes() in (tmp_path / "model.h5").read_bytes()


def test_copies_and_pickles_do_not_contain_training_shapes() -> None:
    model = build_model(posed(), BuildConfig(modes=3))
    assert model.training is not None
    pickled = pickle.dumps(model)
    assert model.stddev.tobytes() in pickled  # so that the next line can fail
    assert model.training.coefficients[0].tobytes() not in pickled
    assert pickle.loads(pickled).training is None and copy.deepcopy(model).training is None
    assert "TrainingShapes" not in repr(model)


def test_of_many_shapes_a_fixed_subset_is_kept_and_no_other_shape_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(training_shapes, "MOST_SHAPES", 5)
    meshes, read = posed(), list[int]()
    shapes = np.stack([mesh.vertices for mesh in meshes])

    def shape(index: int) -> FloatArray:
        read.append(index)
        return shapes[index]

    mean = shapes.mean(axis=0)
    basis = np.linalg.qr((shapes - mean).reshape(len(shapes), -1)[:2].T)[0]
    training = TrainingShapes.of(shape, SIZES, mean, basis)
    assert len(training) == 5 and read == sorted(set(read)) == TrainingShapes.indices(len(meshes)).tolist()
    assert np.allclose(training.log_scale, np.log(SIZES[read]) - np.log(SIZES[read]).mean())
    modes = np.concatenate([basis, training.rest], axis=1)
    off = training.coefficients @ modes.T - (shapes[read] - mean).reshape(5, -1)
    assert np.abs(off).max() < 1e-9
    models = [build_model(meshes, BuildConfig(out_of_core=True, modes=2)) for _ in range(2)]
    assert all(model.training is not None and len(model.training) == 5 and model.n_training == 12 for model in models)
    assert np.array_equal(reconstructed(models[0]), reconstructed(models[1]))
    assert poses_apart_mm(reconstructed(models[0]), [meshes[i] for i in read]) < 1e-3


def test_two_shapes_and_repeated_shapes_have_training_shapes_too() -> None:
    first, second = posed()[:2]
    for meshes in ([first, second], [first, second, second], [first, first, first, second]):
        model = build_model(meshes)
        assert model.training is not None and model.n_modes == 1 and model.with_all_modes is model
        assert poses_apart_mm(reconstructed(model), meshes) < 1e-9
