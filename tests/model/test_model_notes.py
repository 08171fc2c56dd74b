"""A model keeps the modes that its shapes determine, and its notes state why they are fewer than asked for, and which
shapes are mirror images of the others."""

import json
from pathlib import Path

import numpy as np
import pytest

import shapespace as ss
from shapespace.cli import main
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.model.additive import AdditiveModel
from shapespace.model.build_model import BuildConfig, build_model, extend_model
from shapespace.report.blocks.wording import training_text
from shapespace.statistics.compare_shapes import complete_cohort
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import training_meshes

FEWER = "The 6 training shapes determine 5 modes, so the model has 5 and not the requested 30."


def of_few_modes(count: int, modes: int) -> list[Mesh]:
    """Return shapes about a lump that vary along few directions."""
    rng = np.random.default_rng(3)
    mean = training_meshes(vertices=120)[0]
    along = rng.standard_normal((modes, *mean.vertices.shape))
    return [mesh_of(mean, mean.vertices + np.tensordot(b, along, 1), k)
            for k, b in enumerate(rng.standard_normal((count, modes)))]  # fmt: skip


def mesh_of(mesh: Mesh, vertices: FloatArray, number: int) -> Mesh:
    return Mesh(vertices, mesh.faces, name=f"s{number}")


@pytest.mark.parametrize(
    "options",
    [{}, {"out_of_core": True}, {"align": False}, {"gauge": "form"}],
    ids=["memory", "streamed", "as they are", "form"],
)
def test_a_model_has_the_modes_that_its_shapes_determine_and_a_note(options: dict[str, object], tmp_path: Path) -> None:
    model = build_model(training_meshes(6, 200), BuildConfig(modes=30, **options))  # type: ignore[arg-type]
    assert (model.n_modes, model.notes) == (5, (FEWER,))
    model.save(tmp_path / "m.h5")
    assert ss.ShapeModel.load(tmp_path / "m.h5").notes == (FEWER,)
    assert FEWER[:-1] in training_text(model) and "1 in notes" in repr(model)


def test_shapes_that_vary_along_few_directions_determine_no_more_modes() -> None:
    model = build_model(of_few_modes(12, 3), BuildConfig(modes=8, align=False))
    assert model.n_modes == 3
    assert model.notes == ("The 12 training shapes determine 3 modes, so the model has 3 and not the requested 8.",)


@pytest.mark.parametrize("modes", [1, 4, 5, 0.9, "all", None, "auto"])
def test_a_model_with_the_modes_asked_for_has_no_notes(modes: ss.BuildConfig) -> None:
    assert build_model(training_meshes(6, 200), BuildConfig(modes=modes)).notes == ()  # type: ignore[arg-type]


def test_incomplete_shapes_and_b_splines_follow_the_same_rule(faces_in_memory: list[Mesh]) -> None:
    meshes = training_meshes(6, 200)
    vertices = np.array(meshes[2].vertices)
    vertices[5] = np.nan
    holed = [*meshes[:2], meshes[2].with_vertices(vertices), *meshes[3:]]
    lacking = f"1 of {6 * len(vertices)} vertices are missing (0.1 %), in 1 of 6 meshes."
    assert build_model(holed, BuildConfig(modes=30)).notes == (lacking, FEWER)
    spline = build_model(faces_in_memory, BuildConfig(modes=30, representation="bspline", control_points=(8, 8)))
    assert spline.n_modes == len(faces_in_memory) - 1 and "has 3 and not the requested 30" in spline.notes[0]


@pytest.fixture(scope="module")
def faces_in_memory() -> list[Mesh]:
    faces = ss.load_faces()
    return [faces.face(faces.draw_person(seed), name=f"p{seed}") for seed in range(4)]


def test_models_that_shapes_are_added_to_follow_the_same_rule(tmp_path: Path) -> None:
    meshes = training_meshes(6, 200)
    old = build_model(meshes[:4], BuildConfig(), keep_shapes=tmp_path / "kept")
    new = extend_model(old, meshes[4:], tmp_path / "kept", BuildConfig(modes=30))
    assert (new.n_modes, new.notes) == (5, (FEWER,))


def test_the_shape_space_warns_and_keeps_what_is_determined() -> None:
    for settings in ({"n_components": 30}, {"modes": 30}):
        with pytest.warns(UserWarning, match=FEWER):
            space = ss.ShapeSpace(**settings).fit(training_meshes(6, 200))
        assert space.n_features_out_ == 5


def test_identity_and_expression_have_the_modes_that_their_shapes_determine(faces_in_memory: list[Mesh]) -> None:
    smile = np.zeros_like(faces_in_memory[0].vertices)
    smile[:200, 2] = 3.0
    moved = [mesh.with_vertices(mesh.vertices + (1 + k) * smile) for k, mesh in enumerate(faces_in_memory)]
    people = [mesh.name for mesh in faces_in_memory]
    model = AdditiveModel.fit([*faces_in_memory, *moved], people * 2, [True] * 4 + [False] * 4, identity_modes=9)
    assert model.n_identity == 3
    assert "The 4 neutral shapes determine 3 modes, so the model has 3 and not the requested 9." in model.shape.notes


def test_the_command_prints_the_note_and_its_answer_contains_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    for k, mesh in enumerate(training_meshes(6, 200)):
        ss.write_mesh(tmp_path / "in" / f"m{k}.ply", mesh)
    for options in ([], ["--out-of-core"], ["--keep-shapes"]):
        build = ["build", str(tmp_path / "in"), "-o", str(tmp_path / "m.h5"), "--modes", "30", *options]
        assert main([*build, "--quiet", "--json"]) == 0
        printed = capsys.readouterr()
        assert FEWER in printed.err and json.loads(printed.out)["notes"] == [FEWER]
        assert json.loads(printed.out)["modes"] == 5
    assert main(["info", str(tmp_path / "m.h5")]) == 0
    assert FEWER in capsys.readouterr().out


def test_all_modes_are_the_default_in_python_and_in_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    meshes = training_meshes(12, 200)
    (tmp_path / "in").mkdir()
    for k, mesh in enumerate(meshes):
        ss.write_mesh(tmp_path / "in" / f"m{k:02}.ply", mesh)
    assert main(["build", str(tmp_path / "in"), "-o", str(tmp_path / "m.h5"), "--quiet"]) == 0
    capsys.readouterr()
    built = ss.ShapeModel.load(tmp_path / "m.h5")
    models = [
        build_model(tmp_path / "in"),
        ss.ShapeModel.fit(tmp_path / "in"),
        ss.ShapeSpace().fit(tmp_path / "in").model_,
    ]
    assert [model.n_modes for model in (built, *models)] == [11] * 4
    assert all(np.array_equal(model.basis, built.basis) for model in models)


# Mirror images


@pytest.mark.parametrize("mirrored", [(0,), (3, 4), (1, 2, 3), (0, 1, 2, 3)])
@pytest.mark.parametrize("out_of_core", [False, True])
def test_meshes_that_are_mirror_images_of_most_are_named(mirrored: tuple[int, ...], out_of_core: bool) -> None:
    meshes = training_meshes(9, 200)
    meshes = [Mesh(mirror_image(mesh).vertices if k in mirrored else mesh.vertices, mesh.faces, name=f"m{k}.ply")
              for k, mesh in enumerate(meshes)]  # fmt: skip
    notes = build_model(meshes, BuildConfig(out_of_core=out_of_core)).notes
    named = ", ".join(f"m{k}.ply" for k in mirrored[:3]) + (", ..." if len(mirrored) > 3 else "")
    of = "is a mirror image" if len(mirrored) == 1 else "are mirror images"
    assert len(notes) == 1 and notes[0].startswith(f"{len(mirrored)} of 9 shapes {of} of the others ({named})")


@pytest.mark.parametrize("count", [2, 3, 5, 30])
def test_shapes_of_one_side_are_not_called_mirrored(count: int, faces_in_memory: list[Mesh]) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        mean = rng.normal(0, 30, (40, 3)) * rng.uniform(0.05, 1.0, 3)
        shapes = [Mesh(mean + rng.normal(0, 6, mean.shape)) for _ in range(count)]
        assert build_model(shapes).notes == ()
    assert build_model(faces_in_memory).notes == ()  # nearly symmetric


def test_flat_shapes_have_no_side() -> None:
    rng = np.random.default_rng(0)
    mean = rng.normal(0, 30, (20, 3)) * [1, 1, 0]
    shapes = [mean + rng.normal(0, 2, mean.shape) * [1, 1, 0] for _ in range(8)]
    assert build_model([Mesh(x * [1, -1 if k < 3 else 1, 1]) for k, x in enumerate(shapes)]).notes == ()


def test_an_analysis_begins_with_the_mirror_images() -> None:
    shapes = np.stack([mesh.vertices for mesh in training_meshes(8, 200)])
    for mirrored in ((), (2, 5)):
        sided = shapes * np.where(np.isin(np.arange(8), mirrored)[:, None, None], (-1.0, 1.0, 1.0), 1.0)
        cohort = ss.Cohort.of_shapes(sided, {"group": list("abababab")})
        cautions = complete_cohort(cohort, ["~ group"], [], drop_missing=False).cautions
        assert [text.partition(" of the others")[0] for text in cautions] == (
            ["2 of 8 shapes are mirror images"] if mirrored else []
        )
