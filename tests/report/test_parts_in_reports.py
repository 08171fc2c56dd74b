"""Parts of one subject in reports: packed data, facts of relative poses, colours of pictures."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_scene import unpack

import shapespace as ss
from shapespace.cli import main
from shapespace.model.region import articulation_of, relative_pose
from shapespace.report import figures
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import Table
from shapespace.report.inputs.saved_fits import StagedFit
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.render import scene
from shapespace.report.render.palette import PARTS, oklab
from shapespace.report.render.renderer import Camera, part_layer, render
from two_parts import VERTICES, two_part_surfaces

COUNTS = {"upper": VERTICES, "lower": VERTICES}


@pytest.fixture(scope="module", params=["modelled", "kept", "removed"])
def model(request) -> ss.ShapeModel:
    return build(request.param)


def build(relative_pose: str, degrees: float = 50.0) -> ss.ShapeModel:
    options = ss.BuildConfig(parts=COUNTS, relative_pose=relative_pose, gauge="form", modes=4)
    return ss.build_model(two_part_surfaces(25, seed=4, degrees=degrees), options)


def hues(image: np.ndarray) -> set[int]:
    """Return the parts whose hue many pixels have."""
    lab, wanted = oklab(image.reshape(-1, 3) / 255)[:, 1:], oklab(np.array(PARTS[:3]))[:, 1:]
    off = np.linalg.norm(lab[:, None] - wanted, axis=2)
    return {k for k in range(3) if ((off.argmin(axis=1) == k) & (off[:, k] < 0.03)).sum() > 100}


def test_a_model_of_parts_is_packed_with_the_part_of_each_vertex_and_a_model_of_one_without(model) -> None:
    facts, arrays = unpack(scene.pack_model(model, small=True))
    corners = arrays["faces"].astype(int)
    assert facts["parts"] == ["upper", "lower"] and np.bincount(arrays["parts"]).tolist() == list(COUNTS.values())
    assert (arrays["parts"][corners] == arrays["parts"][corners[:, :1]]).all()
    assert ("joints" in facts) == ("template" in arrays) == (not model.is_linear)
    whole, only = unpack(scene.pack_model(ss.build_model(two_part_surfaces(9, seed=4)), small=True))
    assert set(whole) == {"landmarks"} and set(only) == {"mean", "modes", "stddev", "share", "faces"}


def test_joints_are_packed_by_the_vertices_of_the_reordered_template() -> None:
    model = build("modelled")
    facts, arrays = unpack(scene.pack_model(model, small=True))
    (joint,), (known,) = facts["joints"], articulation_of(model).joints
    for key in ("own", "other"):
        packed, exact = arrays["template"][joint[key]], model.coding["template"][getattr(known, key)]
        assert np.abs(packed - exact).max() < 0.03


@pytest.mark.parametrize("relative_pose_", ["modelled", "kept"])
def test_standard_deviations_of_a_joint_are_those_of_many_samples(relative_pose_: str) -> None:
    """Of little flexion, where first order is exact enough for a linear model too."""
    model = build(relative_pose_, degrees=12.0)
    pose = relative_pose(model)
    assert pose is not None and pose.choice == relative_pose_
    (joint,) = pose.joints
    assert (joint.part, joint.parent) == ("lower", "upper")
    articulation = articulation_of(model)
    poses = [articulation.poses_of(model.reconstruct(b)) for b in model.sample(1500, 1)]
    rotation = np.rad2deg(np.sqrt(np.var([own.rotation[0] for own in poses], axis=0).sum()))
    translation = np.sqrt(np.var([own.translation[0] for own in poses], axis=0).sum())
    assert joint.rotation_deg == pytest.approx(rotation, rel=0.05)
    assert joint.translation_mm == pytest.approx(translation, rel=0.05)


def test_a_model_of_shapes_of_parts_has_no_joints_and_of_one_structure_no_parts() -> None:
    pose = relative_pose(build("removed"))
    assert pose is not None and pose.choice == "removed" and pose.joints == ()
    plain = ss.build_model(two_part_surfaces(9, seed=4))
    assert relative_pose(plain) is None and Parts.of(plain) is None


def test_pictures_and_the_table_of_a_model_have_its_parts(model) -> None:
    labels = Parts.of(model).labels
    mesh = model.mesh()
    camera = Camera.framing(mesh.vertices, aspect=1.0)
    assert hues(render(part_layer(mesh, labels), camera=camera, size=(160, 160))) == {0, 1}
    assert hues(render(part_layer(mesh, None), camera=camera, size=(160, 160))) == set()
    for figure in (figures.mean_figure(model), figures.modes_figure(model, 2)):
        assert {text.get_text() for text in figure.findobj() if hasattr(text, "get_text")} >= {"upper", "lower"}
    (table,) = sections._parts_of_model(model)
    assert isinstance(table, Table) and [row[0].text for row in table.rows] == ["upper", "lower"]
    assert (table.rows[1][2].text == "upper") == (relative_pose(model).choice != "removed")


def test_the_ends_of_a_mode_are_those_of_the_model_where_poses_turn(monkeypatch) -> None:
    """Not the mean minus the movement to the other side, which shrinks a part that turns."""
    model, drawn = build("modelled"), []
    kept = figures.model_figures.render

    def record(layer, **options):
        drawn.append(layer.mesh.vertices)
        return kept(layer, **options)

    monkeypatch.setattr(figures.model_figures, "render", record)
    figures.modes_figure(model, 1)
    b = 3 * model.stddev[:1]
    assert any(np.allclose(vertices, model.reconstruct(-b)) for vertices in drawn)
    mirrored = 2 * model.mean_vertices - model.reconstruct(b)
    assert not any(np.allclose(vertices, mirrored, atol=1.0) for vertices in drawn)


def test_a_fit_is_packed_with_the_parts_of_its_model() -> None:
    model = build("kept")
    result = ss.fit_scan(model, model.mesh(0.5 * model.stddev))
    for largest in (None, 300):
        facts, arrays = unpack(scene.pack_fit(StagedFit.of(model, result), largest_scan=largest))
        corners = arrays["faces"].astype(int)
        assert facts["parts"] == ["upper", "lower"] and set(arrays["parts"].tolist()) == {0, 1}
        assert (arrays["parts"][corners] == arrays["parts"][corners[:, :1]]).all()


def test_info_states_parts_and_joints_and_convert_that_poses_become_linear(tmp_path: Path, capsys) -> None:
    model = build("modelled")
    model.save(tmp_path / "model.h5")
    assert main(["info", str(tmp_path / "model.h5"), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["parts"] == COUNTS and facts["relative_pose"] == "modelled"
    assert facts["joints"]["lower to upper"]["rotation_stddev_deg"] > 5
    assert main(["convert", str(tmp_path / "model.h5"), str(tmp_path / "model.glb")]) == 0
    assert "Relative pose is linear in glTF" in capsys.readouterr().out
    assert "Parts" in model._repr_html_()
