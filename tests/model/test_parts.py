"""Models of several parts of one subject: shape and relative pose."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shapespace as ss
from shapespace.errors import InputError
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.model_quality import QualityConfig, measure_quality
from shapespace.types import Mesh

COUNTS = {"upper": 80, "lower": 60}


def make_subjects(count: int, seed: int, degrees: float = 40.0, sizes: float = 0.05) -> list[Mesh]:
    """Return surfaces of two parts with a hinge, in random poses: two modes of shape, a size, and the flexion."""
    rng, base = np.random.default_rng(0), []
    for length, n in ((100.0, 80), (90.0, 60)):
        u = rng.normal(size=(n, 3))
        base.append(u / np.linalg.norm(u, axis=1)[:, None] * [length / 2, 12.0, 10.0])
    rng, subjects = np.random.default_rng(seed), []
    for i in range(count):
        size, a, b, angle = 1 + sizes * rng.normal(), rng.normal(), rng.normal(), np.deg2rad(rng.uniform(0, degrees))
        upper = base[0] * [1.0, 1 + 0.1 * a, 1.0] + [0, 0, 2e-4 * b] * base[0][:, :1] ** 2
        lower = base[1] * [1.0, 1.0, 1 + 0.1 * a] + [45.0 + 2, 0, 0]
        R = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        whole = size * np.concatenate([upper - [50.0, 0, 0], lower @ R.T])
        pose = Rotation.random(random_state=rng).as_matrix()
        subjects.append(Mesh(whole @ pose.T + rng.normal(size=3) * 50, None, name=f"s{i}"))
    return subjects


def errors_mm(model: ss.ShapeModel, subjects: list[Mesh]) -> list[float]:
    found = []
    for mesh in subjects:
        shape = model.reconstruct(model.project(mesh))
        T = fit_similarity(shape, mesh.vertices, with_scale=model.gauge == "shape")
        found.append(float(np.sqrt(((T.apply(shape) - mesh.vertices) ** 2).sum(axis=1).mean())))
    return found


def build(subjects: list[Mesh], **options) -> ss.ShapeModel:
    return ss.build_model(subjects, ss.BuildConfig(parts=COUNTS, **options))


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_new_subjects_are_nearer_to_a_model_of_relative_pose_than_to_one_of_vertices(gauge) -> None:
    subjects = make_subjects(50, seed=1)
    modes = 4 if gauge == "form" else 3
    kept, modelled = (
        build(subjects[:30], relative_pose=pose, gauge=gauge, modes=modes) for pose in ("kept", "modelled")
    )
    assert np.mean(errors_mm(modelled, subjects[30:])) < 0.4 * np.mean(errors_mm(kept, subjects[30:]))


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_a_model_of_relative_pose_gives_its_training_shapes_and_coefficients_back(tmp_path: Path, gauge: str) -> None:
    subjects = make_subjects(20, seed=2)
    model = build(subjects, gauge=gauge)
    assert max(errors_mm(model, subjects)) < 1e-3
    b = model.sample(1, 3)[0]
    assert np.allclose(model.project(model.reconstruct(b)), b, atol=1e-6)
    model.save(tmp_path / "model.h5")
    loaded = ss.ShapeModel.load(tmp_path / "model.h5")
    assert loaded.content_hash == model.content_hash and loaded.parts == ("upper", "lower")
    assert np.array_equal(loaded.reconstruct(b), model.reconstruct(b))
    assert np.abs(model.vertex_basis.T @ model.vertex_basis - np.eye(model.n_modes)).max() < 1e-9


def test_modes_do_not_depend_on_the_unit_of_angles_since_they_move_vertices() -> None:
    """The variance of the first mode is that of vertices, as for a model of vertices with little flexion."""
    subjects = make_subjects(30, seed=3, degrees=2.0)
    kept, modelled = (build(subjects, relative_pose=pose, gauge="form") for pose in ("kept", "modelled"))
    assert np.allclose(kept.stddev[:4], modelled.stddev[:4], rtol=0.02)


def test_a_missing_vertex_is_the_likeliest_given_the_others() -> None:
    subjects = make_subjects(40, seed=4)
    model = build(subjects[:30], gauge="form", modes=4)
    whole = model.reconstruct(model.project(subjects[35]))
    seen = whole.copy()
    seen[100:] = np.nan
    assert np.abs(model.reconstruct(model.project(seen)) - whole)[100:].max() < 1.0


def test_removed_relative_pose_leaves_the_shapes_of_the_parts() -> None:
    subjects = make_subjects(30, seed=5)
    model = build(subjects, relative_pose="removed", gauge="form")
    assert model.is_linear and model.parts == ("upper", "lower")
    rigid = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix()
    again = [mesh.vertices.copy() for mesh in subjects]
    for vertices in again:
        vertices[80:] = vertices[80:] @ rigid.T + 20.0
    same = build([Mesh(v, None, name=str(i)) for i, v in enumerate(again)], relative_pose="removed", gauge="form")
    assert np.allclose(same.stddev[:3], model.stddev[:3], rtol=1e-3)


def test_a_part_that_some_subjects_lack_is_estimated_with_a_note() -> None:
    subjects = make_subjects(30, seed=6)
    partly = [mesh.vertices.copy() for mesh in subjects]
    for vertices in partly[:6]:
        vertices[80:] = np.nan
    model = build([Mesh(v, None, name=str(i)) for i, v in enumerate(partly)], gauge="form", modes=4)
    assert model.parts == ("upper", "lower") and any("missing parts" in note for note in model.notes)
    assert np.mean(errors_mm(model, subjects[20:])) < 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parts": {"one": 140}}, "two or more"),
        ({"parts": {"a": 80, "b": 50}}, "have 130 vertices .* s0 has 140"),
        ({"parts": COUNTS, "relative_pose": "free"}, "no relative pose 'free'"),
        ({"parts": COUNTS, "align": False}, "aligns its meshes"),
        ({"parts": COUNTS, "alignment_vertices": np.arange(9)}, "omit alignment_vertices"),
        ({"parts": COUNTS, "out_of_core": True}, "relative-pose kept"),
        ({"representation": "articulated"}, "--relative-pose"),
    ],
)
def test_impossible_options_have_one_sentence(options, message) -> None:
    with pytest.raises(InputError, match=message):
        ss.build_model(make_subjects(5, seed=0), ss.BuildConfig(**options))


def test_parts_that_are_no_regions_are_refused() -> None:
    model = build(make_subjects(10, seed=0))
    fields = {**model.fields(), "parts": ("upper", "foot")}
    with pytest.raises(InputError, match="upper, foot"):
        ss.ShapeModel(**fields)


def test_quality_of_parts_is_measured_on_shapes_whose_parts_turn_exactly() -> None:
    subjects, options = make_subjects(8, seed=5, degrees=80.0), {"folds": 2, "samples": 2, "modes": 3}
    exact = measure_quality(subjects, QualityConfig(representation="articulated", parts=COUNTS, **options))
    linear = measure_quality(subjects, QualityConfig(**options))
    errors = [quality.generalisation_vertices.mean[-1] for quality in (exact, linear)]
    assert errors[0] < 0.5 * errors[1]
    # The flexion is one mode of exact shapes, and several of vertices.
    assert exact.compactness.mean[1] > linear.compactness.mean[1]
    assert (exact.compactness.low <= exact.compactness.mean).all()
    with pytest.raises(InputError, match="of several parts"):
        QualityConfig(representation="articulated")


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_a_model_of_parts_reconstructs_its_subjects_however_far_they_are_flexed(gauge) -> None:
    subjects = make_subjects(6, seed=5, degrees=80.0)
    found = measure_quality(build(subjects, gauge=gauge), unseen=subjects).reconstruction_vertices
    assert found is not None and found.mean[-1] < 1e-3 < found.mean[0]
