"""Correspondences of the parts of a specimen are joined, and specimens whose parts do not belong together are named."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.correspondence import Correspondence, Corresponding, join_parts
from shapespace.correspondence.joined_parts import find_exchanged, find_wrong_sides, outlier_limit, robust_z
from shapespace.correspondence.odd_scans import ScanMeasures
from shapespace.correspondence.scan_status import SurfaceMeasures
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import FLIP, mirror_image
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray, Mesh, Similarity, SurfaceLandmarks
from synthetic_shapes import sphere

DIRECTIONS, FACES = sphere(150, 0.0)
AXES = {"femur": np.array([10.0, 12.0, 40.0]), "tibia": np.array([9.0, 6.0, 30.0])}
PLACES = {"femur": np.zeros(3), "tibia": np.array([2.0, 0.0, -75.0])}
GOOD = SurfaceMeasures(distance=0.01, folded=0, missing=0, unreached=0, area_change=1.1, not_settled=0.001)


def bone(part: str) -> FloatArray:
    """Return the mean shape of a part in the common frame; it has no symmetry."""
    x = DIRECTIONS * AXES[part]
    return x + 3 * np.column_stack([np.sin(x[:, 1] / 5), np.cos(x[:, 2] / 9), np.sin(x[:, 0] / 4)]) + PLACES[part]


def knee(seed: int, flexion_deg: float | None = None) -> dict[str, FloatArray]:
    """Return the vertices of both bones of a knee in any common pose, mm; the tibia is flexed at random."""
    rng = np.random.default_rng(seed)
    angle = rng.normal(20, 6) if flexion_deg is None else flexion_deg
    flexed = Rotation.from_rotvec([np.deg2rad(angle), *(0.02 * rng.standard_normal(2))]).as_matrix()
    T = Similarity(
        float(np.exp(0.08 * rng.standard_normal())), Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 50, 3)
    )
    joint, size = np.array([0, 0, -42.0]), np.exp(0.03 * rng.standard_normal(2))
    bent = (bone("tibia") * size[1] - joint + rng.normal(0, 0.5, 3)) @ flexed.T + joint
    own = {"femur": bone("femur") * size[0], "tibia": bent}
    return {part: T.apply(x + 0.2 * rng.standard_normal(x.shape)) for part, x in own.items()}


def scan(name: str, vertices: FloatArray, **changes: object) -> Corresponding:
    T = Similarity.identity()
    made = Corresponding(
        name, "", vertices, T, seen=1.0, covered=0.9, distance=(0.1, 0.2, 0.3, 0.4), moved=(0.1, 0.01), seconds=(1.0,),
        status="converged", probability=0.99, measures=GOOD, area_share=1.0,
    )  # fmt: skip
    return replace(made, **changes)


def knees(count: int = 12, **changed: dict[str, FloatArray]) -> dict[str, Correspondence]:
    """Return the correspondences of both parts of `count` knees; `changed` are other vertices of specimens."""
    own = {f"k{i}": knee(i) for i in range(count)} | changed
    return {
        part: Correspondence(
            Mesh(bone(part) * 1.3 - 8, FACES, name=part),
            tuple(scan(name, vertices[part]) for name, vertices in own.items() if part in vertices),
            f"{part} of k0.",
            (0.1, 0.01),
            SurfaceLandmarks.of({"tip": 3}),
            sides_decided=True,
        )
        for part in AXES
    }


def with_scan(made: dict[str, Correspondence], part: str, name: str, **changes: object) -> dict[str, Correspondence]:
    scans = tuple(replace(own, **changes) if own.name == name else own for own in made[part].scans)
    return made | {part: replace(made[part], scans=scans)}


def doubts(made: Correspondence) -> dict[str, str]:
    return {own.name: own.doubt for own in made.scans if own.doubt}


def test_surfaces_stay_in_the_frame_of_the_scan_and_landmarks_are_those_of_their_part() -> None:
    made = join_parts(knees())
    assert dict(made.parts) == {"femur": 150, "tibia": 150} and not doubts(made) and not made.notes
    for i, mesh in enumerate(made.meshes()):
        assert np.array_equal(mesh.vertices, np.concatenate([*knee(i).values()]))
    assert np.array_equal(made.template.faces, np.concatenate([FACES, FACES + 150]))
    assert dict(made.landmarks) == {"femur_tip": 3, "tibia_tip": 153}


def test_the_mean_has_the_mean_relative_pose_and_parts_of_their_own_size() -> None:
    template = join_parts(knees(40)).template.vertices
    expected = knee(0, flexion_deg=20.0)
    at = fit_similarity(template[:150], expected["femur"])
    relative = fit_similarity(at.apply(template[150:]), expected["tibia"])
    assert np.rad2deg(Rotation.from_matrix(relative.rotation).magnitude()) < 4.0
    assert relative.scale == pytest.approx(1.0, abs=0.08)


def test_a_missing_part_is_not_observed_and_placed_by_the_mean() -> None:
    made = join_parts(knees(k3={"femur": knee(3)["femur"]}))
    own = next(own for own in made.scans if own.name == "k3")
    assert own.observed is not None and own.observed[:150].all() and not own.observed[150:].any()
    assert own.notes == ("It has no scan of tibia.",) and own.seen == 0.5 and np.isfinite(own.vertices).all()
    assert np.linalg.norm(own.vertices[150:] - knee(3)["tibia"], axis=1).mean() < 25.0
    assert any("femur 12, tibia 11" in note for note in made.notes)


def test_the_status_is_the_worst_of_the_parts_and_names_the_part() -> None:
    parts = with_scan(knees(), "tibia", "k2", doubt="it is odd", status="doubtful", probability=0.3)
    parts = with_scan(parts, "femur", "k4", reason="broken", vertices=None, status="excluded")
    own = {scan.name: scan for scan in join_parts(parts).scans}
    assert (own["k2"].status, own["k2"].doubt, own["k2"].probability) == ("doubtful", "tibia: it is odd", 0.3)
    assert (own["k4"].status, own["k4"].reason) == ("excluded", "femur: broken")


def test_a_part_of_another_subject_is_doubted() -> None:
    mixed = knee(5) | {"tibia": knee(105)["tibia"]}
    assert set(found := doubts(join_parts(knees(k5=mixed)))) == {"k5"}
    assert "tibia relative to femur is" in found["k5"] and "another subject" in found["k5"]


def test_a_part_in_another_unit_is_doubted() -> None:
    parts = with_scan(knees(), "tibia", "k5", vertices=0.001 * knee(5)["tibia"], unit_ratio=0.001)
    found = doubts(join_parts(parts))
    assert set(found) == {"k5"} and "different units" in found["k5"] and "tibia 0.001" in found["k5"]


def test_parts_that_lie_inside_each_other_are_noted() -> None:
    at_femur = knee(5) | {"tibia": knee(5)["tibia"] + 0.5 * (knee(5)["femur"] - knee(5)["tibia"]).mean(axis=0)}
    own = {scan.name: " ".join(scan.notes) for scan in join_parts(knees(k5=at_femur)).scans}
    assert "inside" in own.pop("k5") and not any("inside" in note for note in own.values())


def test_parts_in_frames_of_their_own_are_noted_once() -> None:
    frames = {
        f"k{i}": knee(i)
        | {"tibia": Similarity(1.0, Rotation.random(random_state=i).as_matrix(), np.zeros(3)).apply(bone("tibia"))}
        for i in range(12)
    }
    notes = join_parts(knees(**frames)).notes
    assert sum("not in one frame" in note for note in notes) == 1


def test_a_mirrored_specimen_is_reflected_as_a_whole_and_sides_that_disagree_are_doubted() -> None:
    mirrored = {part: x * FLIP for part, x in knee(4).items()}
    parts = knees(k4=mirrored)
    for part in AXES:
        parts = with_scan(parts, part, "k4", mirrored=True)
    made = join_parts(parts)
    assert not doubts(made) and made.scans[4].mirrored
    assert np.allclose(made.meshes()[4].vertices, np.concatenate([*knee(4).values()]))
    assert "tibia is not a mirror image" in doubts(join_parts(with_scan(parts, "tibia", "k4", mirrored=False)))["k4"]


def test_sides_of_which_a_part_is_unsure_are_those_of_the_other_parts_of_the_specimen() -> None:
    assert not find_wrong_sides(knees())
    other_side = with_scan(knees(), "tibia", "k4", mirrored=True)
    assert not find_wrong_sides(other_side), "a tibia that is clearly of the other side stays a contradiction"
    assert find_wrong_sides(with_scan(other_side, "tibia", "k4", doubt="it is odd")) == {"tibia": frozenset()}
    parts = with_scan(knees(), "femur", "k4", mirrored=True)
    assert find_wrong_sides(with_scan(parts, "tibia", "k4", doubt="it is odd")) == {"tibia": {"k4"}}
    undecided = replace(parts["tibia"], sides_decided=False)
    assert find_wrong_sides(parts | {"tibia": undecided}) == {"tibia": {"k4"}}


def test_a_part_whose_template_is_on_the_other_side_is_reflected() -> None:
    parts, usual = knees(), join_parts(knees())
    tibia = parts["tibia"]
    scans = tuple(replace(own, mirrored=True) for own in tibia.scans)
    other = replace(tibia, template=mirror_image(tibia.template), scans=scans)
    made = join_parts(parts | {"tibia": other})
    assert not doubts(made) and not any(own.mirrored for own in made.scans)
    assert np.array_equal(made.template.faces, usual.template.faces)


def test_too_few_specimens_with_all_parts_are_one_sentence() -> None:
    parts = knees(4)
    renamed = tuple(replace(own, name=f"other{own.name}") for own in parts["tibia"].scans)
    with pytest.raises(
        InputError, match=r"0 specimens have a surface of each part.*name the scans of one specimen alike"
    ):
        join_parts(parts | {"tibia": replace(parts["tibia"], scans=renamed)})
    with pytest.raises(InputError, match="two or more, not 1"):
        join_parts({"femur": parts["femur"]})


def test_a_specimen_in_another_unit_has_its_usual_relative_pose() -> None:
    parts = knees(k5={part: 0.001 * x for part, x in knee(5).items()})
    for part in AXES:
        parts = with_scan(parts, part, "k5", unit_ratio=0.001)
    assert not doubts(join_parts(parts))


def test_exchanged_parts_are_named_and_no_others() -> None:
    own = {part: {f"k{i}": ScanMeasures.of(Mesh(knee(i)[part], FACES)) for i in range(12)} for part in AXES}
    assert not find_exchanged(own)
    own["femur"]["k7"], own["tibia"]["k7"] = own["tibia"]["k7"], own["femur"]["k7"]
    found = find_exchanged(own)
    assert set(found) == {"k7"} and "femur and tibia are probably exchanged" in found["k7"]


@pytest.mark.parametrize("count", [6, 12, 40])
def test_at_most_one_collection_in_twenty_has_a_false_finding_if_sizes_multiply_poses(count: int) -> None:
    rng, columns = np.random.default_rng(1), 14
    limit = outlier_limit(count, columns)
    sizes = np.exp(0.3 * rng.standard_normal((300, count, 1)))
    poses = sizes * rng.standard_normal((300, count, columns))
    assert np.mean([robust_z(own).max() > limit for own in poses]) <= 0.05
    poses[0, 0, 0] = 50.0
    assert robust_z(poses[0])[0, 0] > limit


def test_the_limit_of_unusual_values_is_exceeded_in_one_of_twenty_collections_of_long_tails() -> None:
    rng, count, columns = np.random.default_rng(1), 20, 7
    limit = outlier_limit(count, columns)
    rate = np.mean([robust_z(rng.laplace(size=(count, columns))).max() > limit for _ in range(600)])
    assert 0.02 < rate < 0.09
