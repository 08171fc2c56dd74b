"""Fits and completions of scans of several parts of one subject."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import shapespace as ss
from shapespace.cli import main
from shapespace.errors import FitError, InputError
from shapespace.fit.diagnostics.reasons import ReasonCode
from shapespace.fit.fit_scan import join_scans
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.contact import find_penetrations
from shapespace.geometry.normals import part_of
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.types import Mesh

COUNTS = {"upper": 162, "lower": 162}


def ball() -> Mesh:
    """Return a sphere of 162 vertices."""
    t = (1 + 5**0.5) / 2
    vertices = np.array([[-1, t, 0], [1, t, 0], [-1, -t, 0], [1, -t, 0], [0, -1, t], [0, 1, t], [0, -1, -t], [0, 1, -t],
                         [t, 0, -1], [t, 0, 1], [-t, 0, -1], [-t, 0, 1]], dtype=float)  # fmt: skip
    faces = np.array([[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2],
                      [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5],
                      [2, 4, 11], [6, 2, 10], [8, 6, 7], [9, 8, 1]])  # fmt: skip
    for _ in range(2):
        edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        unique, inverse = np.unique(edges, axis=0, return_inverse=True)
        a, b, c = len(vertices) + inverse.reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        corners = faces.T
        faces = np.concatenate([np.stack(three, axis=1) for three in (
            (corners[0], a, c), (corners[1], b, a), (corners[2], c, b), (a, b, c))])  # fmt: skip
    return Mesh(vertices / np.linalg.norm(vertices, axis=1)[:, None], faces.astype(np.int32))


BALL = ball()
FACES = np.concatenate([np.asarray(BALL.faces), np.asarray(BALL.faces) + 162]).astype(np.int32)


def bump(u: np.ndarray, at: list[float], height: list[float]) -> np.ndarray:
    return np.exp(-4 * ((u - at) ** 2).sum(axis=1))[:, None] * height


def make_subjects(count: int, seed: int) -> list[Mesh]:
    """Return two bones with a hinge; the lower one has the thickness of the upper one."""
    rng, out = np.random.default_rng(seed), []
    u = BALL.vertices
    for i in range(count):
        a, b, size = 0.12 * rng.normal(), rng.normal(), 1 + 0.04 * rng.normal()
        angle = np.deg2rad(rng.uniform(0, 40))
        upper = u * [50.0, 12 * (1 + a), 10.0] + np.column_stack([0 * u[:, 0], 0 * u[:, 0], 3 * b * u[:, 0] ** 2])
        upper += bump(u, [0.6, 0.8, 0.0], [0.0, 14.0, 4.0]) + bump(u, [-0.7, 0.0, 0.7], [-4.0, 0.0, 10.0])
        lower = u * [45.0, 9.0, 9 * (1 + a)] + [48.0, 0, 0]
        lower += bump(u, [-0.6, 0.0, 0.8], [0.0, 3.0, 12.0]) + bump(u, [0.7, 0.7, 0.0], [5.0, 8.0, 0.0])
        R = Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
        vertices = size * np.concatenate([upper - [51.0, 0, 0], lower @ R.T])
        pose = Rotation.random(random_state=rng).as_matrix()
        out.append(Mesh(vertices @ pose.T + rng.normal(size=3) * 50, FACES, name=f"s{i}"))
    return out


@pytest.fixture(scope="module")
def model() -> ss.ShapeModel:
    return ss.build_model(make_subjects(40, seed=0), ss.BuildConfig(parts=COUNTS, gauge="form"))


def test_a_scan_of_all_parts_is_fitted_in_any_pose_and_flexion_and_its_vertices_get_their_part(model) -> None:
    rng = np.random.default_rng(1)
    for scan in make_subjects(3, seed=5):
        noisy = scan.with_vertices(scan.vertices + 0.1 * rng.normal(size=scan.vertices.shape))
        fit = ss.fit_scan(model, noisy)
        off_mm = np.linalg.norm(fit.surface().vertices - scan.vertices, axis=1)
        assert fit.status == "converged" and off_mm.mean() < 0.5
        assert (fit.scan_parts() == np.repeat([0, 1], 162)).mean() > 0.95


def test_a_scan_of_one_part_predicts_the_other_as_well_as_true_correspondences_do(model) -> None:
    subjects, errors, inside = make_subjects(12, seed=9), [], []
    config = ss.CompletionConfig(fit=ss.FitConfig(region="upper"), with_doubtful=True)
    for subject in subjects:
        scan = Mesh(subject.vertices[:162], BALL.faces, name="upper")
        found = ss.complete(model, scan, config)
        off = (found.vertices - subject.vertices)[162:]
        errors.append(np.sqrt((off**2).sum(axis=1).mean()))
        assert np.linalg.norm((found.vertices - subject.vertices)[:162], axis=1).mean() < 0.7
        local = (found.vertices - subject.vertices) @ found.T_scan_model.rotation
        covariance = found.posterior.vertex_covariance()
        squared = np.einsum("vi,vij,vj->v", local, np.linalg.inv(covariance), local)
        inside.append((squared[162:] < 7.81).mean())  # 95 % of chi squared with 3 degrees of freedom
        assert np.all(found.knowledge[:162] == 0) and np.all(found.knowledge[162:] != 0)
        assert any("lower and their relative poses are predicted" in note for note in found.notes)
    assert np.mean(inside) > 0.8
    # The flexion is random, so that the mean flexion is the best prediction: 11.5 degrees times the lever.
    assert np.sqrt(np.mean(np.square(errors))) < 15.0


def test_the_surface_of_a_part_is_its_own_and_not_the_nearest_with_likely_relative_pose(model) -> None:
    subject = make_subjects(1, seed=11)[0]
    scan = Mesh(subject.vertices[:162], BALL.faces, name="bone")
    fit = ss.fit_scan(model, scan, ss.FitConfig(region="upper"))
    assert np.linalg.norm(fit.surface().vertices[:162] - scan.vertices, axis=1).mean() < 0.5


def test_the_commands_take_the_part_from_the_name_of_the_file(model, tmp_path, capsys) -> None:
    subject = make_subjects(1, seed=12)[0]
    (tmp_path / "scans").mkdir()
    write_mesh(tmp_path / "scans" / "anna_lower.ply", Mesh(subject.vertices[162:], BALL.faces))
    model.save(tmp_path / "limb.h5")
    model_file, scans = str(tmp_path / "limb.h5"), str(tmp_path / "scans")
    assert main(["complete", model_file, scans, "-o", str(tmp_path / "done"), "--with-doubtful", "--quiet"]) in (0, 1)
    done = read_mesh(tmp_path / "done" / "anna_lower.ply")
    assert len(done.vertices) == 324
    assert np.linalg.norm(done.vertices[162:] - subject.vertices[162:], axis=1).mean() < 0.7
    assert main(["fit", model_file, scans, "-o", str(tmp_path / "fits"), "--quiet", "--jobs", "1"]) in (0, 1)
    fitted = read_mesh(tmp_path / "fits" / "anna_lower.fitted.ply")
    assert np.linalg.norm(fitted.vertices[162:] - subject.vertices[162:], axis=1).mean() < 0.7
    capsys.readouterr()


def scans_of(subject: Mesh, name: str = "anna") -> dict[str, Mesh]:
    """Return the scans of both parts, with 0.1 mm of noise."""
    noisy = subject.vertices + 0.1 * np.random.default_rng(3).normal(size=subject.vertices.shape)
    return {
        "upper": Mesh(noisy[:162], BALL.faces, name=f"{name}_upper"),
        "lower": Mesh(noisy[162:], BALL.faces, name=f"{name}_lower"),
    }  # fmt: skip


def test_scans_of_known_parts_have_one_fit_in_which_each_point_belongs_to_its_part(model) -> None:
    subject = make_subjects(1, seed=5)[0]
    scans = scans_of(subject)
    fit = ss.fit_scan(model, scans)
    assert fit.status == "converged" and fit.scan_name == "anna" and fit.start == "parts"
    assert np.linalg.norm(fit.surface().vertices - subject.vertices, axis=1).mean() < 0.1
    assert np.array_equal(fit.scan_parts(), np.repeat([0, 1], 162))
    assert fit.overlap_distances.model_seen_share == 1.0
    # The scan of the lower bone lacks its end at the joint; points of the upper bone there must not belong to it.
    apart = scans["lower"].vertices - subject.vertices[:162].mean(axis=0)
    piece = part_of(scans["lower"], np.linalg.norm(apart, axis=1) > np.median(np.linalg.norm(apart, axis=1)))
    partial = ss.fit_scan(model, {"upper": scans["upper"], "lower": piece})
    assert np.linalg.norm(partial.surface().vertices - subject.vertices, axis=1).mean() < 1.0


def test_a_completion_is_doubtful_if_a_small_piece_of_a_part_determines_its_pose(model) -> None:
    subject = make_subjects(1, seed=5)[0]
    scans = scans_of(subject)
    along = np.linalg.norm(scans["lower"].vertices - subject.vertices[:162].mean(axis=0), axis=1)
    for share, is_doubtful in ((0.2, True), (0.6, False)):
        piece = part_of(scans["lower"], along < np.quantile(along, share))
        found = ss.complete(model, {"upper": scans["upper"], "lower": piece}, ss.CompletionConfig(with_doubtful=True))
        codes = {reason.code for reason in found.reasons}
        assert (ReasonCode.PART_HARDLY_SEEN in codes) == is_doubtful and (found.status == "doubtful") >= is_doubtful


def test_points_of_one_part_never_match_another_part_even_inside_it(model) -> None:
    subject = make_subjects(1, seed=5)[0]
    mesh = join_scans(model, scans_of(subject), strict=False)
    # Both parts are moved to the same place; each vertex still finds the point of its own part.
    moved = mesh.with_vertices(
        mesh.vertices - np.repeat([mesh.vertices[:162].mean(0), mesh.vertices[162:].mean(0)], 162, axis=0)
    )
    target = ScanTarget(moved, model.part_of_vertex)
    near = target.engine.query(moved.vertices + target.vertex_shift(slice(None)))
    assert np.array_equal(near.vertex, np.arange(324)) and near.distance.max() < 1e-9
    assert ScanTarget(part_of(moved, np.arange(324) < 162), model.part_of_vertex).shown.sum() == 162


def test_scans_that_are_not_the_parts_of_one_subject_are_named_in_one_sentence(model) -> None:
    scans = scans_of(make_subjects(1, seed=5)[0])
    upper, lower = scans.values()
    other_frame = lower.with_vertices(lower.vertices @ Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix())
    for wrong, error, sentence in (
        ({"upper": lower, "lower": upper}, FitError, "upper and lower|lower and upper"),
        ({"upper": upper, "lower": upper}, InputError, "upper and lower are the same scan"),
        ({"upper": upper, "lower": lower.with_vertices(lower.vertices / 10)}, FitError, "lower has another unit"),
        ({"upper": upper, "tibia": lower}, InputError, "the parts upper, lower"),
    ):
        with pytest.raises(error, match=sentence):
            ss.fit_scan(model, wrong)
    with pytest.raises(InputError, match="no region"):
        ss.fit_scan(model, scans, ss.FitConfig(region="upper"))
    for apart in (other_frame, lower.with_vertices(lower.vertices + np.array([0.0, 0.0, 60.0]))):
        fit = ss.fit_scan(model, {"upper": upper, "lower": apart})
        assert fit.status == "doubtful" and "mm from its scan (median), which may be in another frame" in fit.reason


def test_the_commands_join_the_scans_of_a_subject_by_their_names_or_folders(model, tmp_path, capsys) -> None:
    subject = make_subjects(1, seed=12)[0]
    for name, scan in scans_of(subject).items():
        (tmp_path / "bones" / name).mkdir(parents=True)
        write_mesh(tmp_path / "bones" / name / "anna.ply", scan)
    write_mesh(tmp_path / "bones" / "upper" / "ben.ply", scans_of(make_subjects(1, seed=14)[0])["upper"])
    model.save(tmp_path / "limb.h5")
    first = [
        "fit",
        str(tmp_path / "limb.h5"),
        str(tmp_path / "bones"),
        "-o",
        str(tmp_path / "out"),
        "--quiet",
        "--jobs",
        "1",
    ]
    assert main(first) == 0
    fitted = read_mesh(tmp_path / "out" / "anna.fitted.ply")
    assert np.linalg.norm(fitted.vertices - subject.vertices, axis=1).mean() < 0.1
    assert (tmp_path / "out" / "ben_upper.fit.json").is_file() and not (tmp_path / "out" / "ben.fit.json").exists()
    written = (tmp_path / "out" / "anna.fit.json").stat().st_mtime_ns
    # The list names each scan with its part; the same results are valid for it.
    again = [
        "fit",
        str(tmp_path / "limb.h5"),
        str(tmp_path / "out" / "scans.csv"),
        "-o",
        str(tmp_path / "out"),
        "--jobs",
        "1",
    ]
    assert main(again) == 0
    assert "2 of 2 scans have valid results" in capsys.readouterr().err
    assert (tmp_path / "out" / "anna.fit.json").stat().st_mtime_ns == written
    write_mesh(tmp_path / "bones" / "lower" / "anna.ply", scans_of(make_subjects(1, seed=15)[0])["lower"])
    assert main([*first, "--strict"]) == 1
    assert "may be in another frame or of another subject" in capsys.readouterr().err
    pair = [str(tmp_path / "bones" / name / "anna.ply") for name in ("upper", "lower")]
    assert main(["complete", str(tmp_path / "limb.h5"), *pair, "-o", str(tmp_path / "done"), "--quiet"]) == 2
    assert "may be in another frame or of another subject" in capsys.readouterr().err


@pytest.mark.parametrize("pose", ["kept", "removed"])
def test_a_linear_model_completes_a_scan_of_one_part(pose) -> None:
    linear = ss.build_model(make_subjects(12, seed=0), ss.BuildConfig(parts=COUNTS, gauge="form", relative_pose=pose))
    subject = make_subjects(1, seed=9)[0]
    config = ss.CompletionConfig(samples=4, with_doubtful=True)
    found = ss.complete(linear, {"lower": scans_of(subject)["lower"]}, config)
    assert np.linalg.norm(found.vertices - subject.vertices, axis=1)[162:].mean() < 0.3
    assert found.observed[162:].mean() > 0.9 and not found.observed[:162].any()
    is_noted = any("mean pose, whose spread is unknown" in note for note in found.notes)
    assert is_noted == (pose == "removed")


def touching(gap: float, sizes: tuple[float, float], angle: float) -> np.ndarray:
    """Return two ellipsoids whose ends are `gap` mm apart, the second rotated about its end."""
    first, second = BALL.vertices * [10.0 * sizes[0], 10.0, 10.0], BALL.vertices * [10.0 * sizes[1], 8.0, 8.0]
    turned = (second + np.array([10.0 * sizes[1] + gap, 0.0, 0.0])) @ Rotation.from_rotvec(
        [0.0, 0.0, angle]
    ).as_matrix().T
    return np.concatenate([first, turned + np.array([10.0 * sizes[0], 0.0, 0.0])])


def test_without_contact_no_part_lies_inside_another_and_the_depths_before_and_after_are_noted() -> None:
    rng = np.random.default_rng(0)
    shapes = [
        Mesh(touching(rng.uniform(0.2, 3.0), tuple(1 + 0.2 * rng.normal(size=2)), 0.2 * rng.normal()), FACES)
        for _ in range(20)
    ]
    pair = ss.build_model(shapes, ss.BuildConfig(parts=COUNTS, gauge="form"))
    scan = Mesh(touching(-1.5, (1.1, 1.0), 0.1) + 0.05 * rng.normal(size=(324, 3)), FACES, name="pair")
    parts = pair.vertices_of_parts
    usual, apart = (ss.fit_scan(pair, scan, ss.FitConfig(ss.fit.Robust(no_contact=no))) for no in (False, True))
    assert find_penetrations(usual.surface(), parts)[0].depth_mm > 1.0
    assert any("lie inside" in note for note in usual.notes)
    left = max((found.depth_mm for found in find_penetrations(apart.surface(), parts)), default=0.0)
    assert left < 0.1
    depths = next(note for note in apart.notes if note.startswith("Parts lay inside each other by up to 1."))
    assert f"{left:.2f} mm after contact was forbidden" in depths
    # Parts that do not touch are fitted as before.
    free = Mesh(touching(1.0, (1.1, 1.0), 0.1), FACES, name="free")
    both = [ss.fit_scan(pair, free, ss.FitConfig(ss.fit.Robust(no_contact=no))) for no in (False, True)]
    assert np.array_equal(both[0].surface().vertices, both[1].surface().vertices)


def test_what_a_part_does_not_give_is_refused_in_one_sentence(model) -> None:
    subject = make_subjects(1, seed=13)[0]
    scan = Mesh(subject.vertices[:162], BALL.faces, name="bone")
    with pytest.raises(InputError, match="a region lies in one part"):
        ss.fit_scan(model, scan, ss.FitConfig(region=tuple(range(100, 300))))
    with pytest.raises(InputError, match="one of the parts upper, lower"):
        ss.complete(model, scan, ss.CompletionConfig(fit=ss.FitConfig(region="middle")))
    shared = ss.build_model(
        make_subjects(12, seed=0), ss.BuildConfig(parts=COUNTS, gauge="form", without_training_shapes=True)
    )
    with pytest.raises(InputError, match="training shapes"):
        ss.complete(shared, scan, ss.CompletionConfig(fit=ss.FitConfig(region="upper"), with_doubtful=True))
    one = ss.build_model(make_subjects(8, seed=0), ss.BuildConfig(gauge="form"))
    with pytest.raises(InputError, match="no parts"):
        ss.fit_scan(one, subject).scan_parts()
    with pytest.raises(FitError, match=r"one part.*--no-contact"):
        ss.fit_scan(one, subject, ss.FitConfig(ss.fit.Robust(no_contact=True)))
