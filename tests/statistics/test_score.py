"""Scores against a reference: percentiles that hold, distances by a plain oracle, and who cannot be scored."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.cli import main
from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.read import CohortConfig, read_cohort
from shapespace.cohort.table import Table
from shapespace.errors import CorrespondenceError, InputError
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.geometry.normals import vertex_normals
from shapespace.io.files import write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.analyses.result_report import analysis_report
from shapespace.schemas import Analysis
from shapespace.statistics.score_subjects import ScoreConfig, ScoreResult, score
from shapespace.types import FloatArray, Mesh
from stored_fits import MODES, VERTICES, model, write_fit
from synthetic_shapes import similarity, training_meshes

SPREAD = np.sqrt(variance_of_new_shapes(model()))
LEVELS = (0.1, 0.2, 0.5, 0.8)


def population(
    n: int,
    rng: np.random.Generator,
    *,
    told: float | FloatArray = 0.99,
    name: str = "r",
    shift: FloatArray | float = 0.0,
) -> Cohort:
    """Return fits of random people, each coefficient told by its scan as far as `told` says, and else by the model."""
    b = SPREAD * (rng.standard_normal((n, MODES)) + shift)
    told = np.broadcast_to(told, b.shape)
    seen = told * b + np.sqrt(told * (1 - told)) * SPREAD * rng.standard_normal(b.shape)
    names = tuple(f"{name}{k}" for k in range(n))
    beyond = rng.gamma(5.0, 0.1, n)
    fitted = FitDiagnostics(model(), seen, np.sqrt(1 - told) * SPREAD, ("converged",) * n, "fits", beyond)
    return Cohort.of_fits(fitted, names, Table({}, names), np.full(n, np.nan))


def shares(found: list[ScoreResult], which: str) -> FloatArray:
    every = np.concatenate([getattr(one, which) for one in found])
    return np.array([(every <= level).mean() for level in LEVELS])


# What the numbers are


def test_distances_are_those_of_a_plain_oracle() -> None:
    rng = np.random.default_rng(0)
    reference, subjects = population(30, rng), population(4, rng, told=0.8, name="s")
    found = score(reference, subjects, ScoreConfig(modes=3))
    x, y = reference.coefficients, subjects.coefficients
    mean, S = x.mean(axis=0), np.cov(x.T)
    values, vectors = np.linalg.eigh(S)
    top = vectors[:, ::-1][:, :3]
    assert subjects.fitted is not None
    for k in range(4):
        D = np.diag(subjects.fitted.b_stddev[k] ** 2)
        V = np.diag(values[::-1][:3]) * (1 + 1 / 30) + top.T @ D @ top
        own = top.T @ (y[k] - mean)
        assert found.distance[k] == pytest.approx(np.sqrt(own @ np.linalg.solve(V, own)), rel=1e-10)
        rest = (y[k] - mean) - top @ own
        assert found.rest_mm[k] == pytest.approx(np.linalg.norm(rest) / np.sqrt(VERTICES), rel=1e-9)
        between = (y[k] - x) @ top
        far = np.sqrt(np.einsum("ni,ij,nj->n", between, np.linalg.inv(V), between))
        assert [one.name for one in found.nearest[k]] == [f"r{i}" for i in np.argsort(far)[:3]]
        assert found.nearest[k][0].distance == pytest.approx(far.min())
    assert found.variance_share == pytest.approx(values[::-1][:3].sum() / values.sum())


def test_the_reference_is_measured_by_the_others() -> None:
    reference = population(12, np.random.default_rng(1), told=1.0)
    found = score(reference, population(2, np.random.default_rng(2), told=1.0, name="s"), ScoreConfig(modes=2))
    for k in range(12):
        others = np.delete(reference.coefficients, k, axis=0)
        values, vectors = np.linalg.eigh(np.cov(others.T))
        own = vectors[:, ::-1][:, :2].T @ (reference.coefficients[k] - others.mean(axis=0))
        d2 = (own**2 / (values[::-1][:2] * (1 + 1 / 11))).sum()
        assert found.reference_distance[k] == pytest.approx(np.sqrt(d2), rel=1e-6)


def test_maps_are_displacements_along_the_normals_in_standard_deviations() -> None:
    rng = np.random.default_rng(3)
    reference, subjects = population(25, rng), population(2, rng, told=0.7, name="s")
    found = score(reference, subjects)
    shapes = np.stack([reference.vertices(k) for k in range(25)])
    mean = shapes.mean(axis=0)
    normals = vertex_normals(Mesh(mean, reference.faces))
    along = np.einsum("nvi,vi->nv", shapes - mean, normals)
    assert subjects.fitted is not None
    rows = np.einsum("kvi,vi->kv", model().vertex_basis.T.reshape(MODES, -1, 3), normals)
    for k in range(2):
        variance = along.var(axis=0, ddof=1) * (1 + 1 / 25) + subjects.fitted.b_stddev[k] ** 2 @ rows**2
        own = ((subjects.vertices(k) - mean) * normals).sum(axis=1)
        assert np.abs(found.z[k] - own / np.sqrt(variance)).max() < 1e-8
    largest = np.sort([np.abs(left_out(along, k)).max() for k in range(25)])
    # The mean of the others is another, whose normals are nearly the same.
    assert found.z_limit == pytest.approx(largest[24], rel=0.02)


def left_out(along: FloatArray, k: int) -> FloatArray:
    others = np.delete(along, k, axis=0)
    return (along[k] - others.mean(axis=0)) / (others.std(axis=0, ddof=1) * np.sqrt(1 + 1 / len(others)))


# What they promise


@pytest.mark.parametrize("told", [0.99, np.array([0.9, 0.5, 0.3, 0.7])], ids=["as well seen", "badly seen"])
def test_percentiles_of_members_held_out_are_uniform(told: FloatArray | float) -> None:
    rng = np.random.default_rng(5)
    options = ScoreConfig(modes=2, draws=8)
    found = [score(population(30, rng), population(16, rng, told=told, name="s"), options) for _ in range(30)]
    for which in ("farther", "rest_farther", "beyond_farther"):
        assert np.abs(shares(found, which) - LEVELS).max() < 0.08, which
    # The leading modes of a sample vary more in it than in others, and uncertain fits lie nearer to the model's mean.
    assert (shares(found, "p_value") - LEVELS).max() < 0.03
    beyond = np.concatenate([np.abs(one.z).max(axis=1) > one.z_limit for one in found])
    assert beyond.mean() < 0.1


def test_the_f_distribution_holds_where_all_modes_are_taken() -> None:
    rng = np.random.default_rng(4)
    options = ScoreConfig(modes=MODES)
    found = [score(population(30, rng, told=1.0), population(20, rng, told=1.0, name="s"), options) for _ in range(25)]
    assert np.abs(shares(found, "p_value") - LEVELS).max() < 0.06
    assert all(np.array_equal(one.rest_farther, np.ones(20)) for one in found)


def test_who_lies_far_out_is_told_so() -> None:
    rng = np.random.default_rng(6)
    reference = population(40, rng)
    far = score(reference, population(20, rng, name="s", shift=np.array([4.0, 0, 0, 0])))
    assert np.median(far.farther) == pytest.approx(1 / 41) and np.median(far.percentile) > 97
    assert np.median(far.p_value) < 0.01 and (far.beyond_2 > 0.046).mean() > 0.9


def test_what_the_model_left_and_what_the_modes_cannot_make_are_said_to_be_outside() -> None:
    rng = np.random.default_rng(7)
    reference, usual = population(40, rng), population(3, rng, name="s")
    assert usual.fitted is not None
    b = np.array(usual.fitted.b)
    b[0] = [0, 0, 0, 12 * SPREAD[3]]
    odd = replace(usual.fitted, b=b, beyond_mm=np.array([0.3, 9.0, 0.3]), status=("converged", "converged", "doubtful"))
    subjects = Cohort.of_fits(odd, usual.names, usual.table, usual.sizes_mm)
    found = score(reference, subjects, ScoreConfig(modes=2))
    assert (
        "modes of the reference leave" in found.outside[0][0]
        and "more than of all of the reference" in found.outside[0][0]
    )
    assert "left 9.00 mm of the scan" in found.outside[1][0] and found.outside[2] == ("its fit is doubtful",)
    methods = found.methods
    assert methods.dimensions == 2 and methods.analysed_variance_ratio == found.variance_share
    assert [one.resampling for one in methods.tests] == ["leave-one-out", "none"]
    summary = analysis_report(found).summary
    assert sum("Its score may not describe its shape: " in sentence for sentence in summary) == 3


def test_repeated_scans_of_a_person_count_once_and_leave_together() -> None:
    rng = np.random.default_rng(8)
    people = population(12, rng, told=1.0)
    assert people.fitted is not None
    b = np.repeat(people.fitted.b, 5, axis=0) + 0.01 * SPREAD * rng.standard_normal((60, MODES))
    who = tuple(f"p{k // 5}" for k in range(60))
    fitted = FitDiagnostics(model(), b, np.full(b.shape, 1e-3), ("converged",) * 60, "fits")
    names = tuple(f"scan{k}" for k in range(60))
    reference = Cohort.of_fits(fitted, names, Table({"who": who}, names), np.full(60, np.nan))
    subjects = replace(population(2, rng, name="s"), table=Table({"who": ("a", "b")}, ("s0", "s1")))
    by_person = score(reference, subjects, ScoreConfig(subject="who", modes=4))
    by_scan = score(reference, subjects, ScoreConfig(modes=4))
    assert (by_person.people, by_scan.people) == (12, 60)
    assert score(reference, subjects, ScoreConfig(subject="who")).modes == 2
    # Left out alone, a scan finds its own person among the others.
    assert by_person.reference_distance.mean() > 1.1 * by_scan.reference_distance.mean()
    assert by_person.farther.min() >= 1 / 13 and by_person.farther.max() <= 1
    both = replace(subjects, table=Table({"who": ("p3", "b")}, ("s0", "s1")))
    with pytest.raises(InputError, match="p3 of who is among the subjects and in the reference"):
        score(reference, both, ScoreConfig(subject="who"))


def test_the_same_seed_gives_the_same_scores_and_one_subject_those_among_many() -> None:
    rng = np.random.default_rng(9)
    reference, subjects = population(20, rng), population(6, rng, told=0.5, name="s")
    one, other = score(reference, subjects), score(reference, subjects)
    alone = score(reference, subjects.take([4]))
    assert np.array_equal(one.farther, other.farther) and np.array_equal(one.z, other.z)
    assert alone.farther[0] == one.farther[4] and alone.distance[0] == one.distance[4]


def test_a_small_reference_is_said_to_be_small() -> None:
    rng = np.random.default_rng(10)
    found = score(population(8, rng), population(2, rng, name="s"))
    assert "small" in found.notes[-1] and "8 subjects" in found.notes[-1] and np.isnan(found.z_limit)
    assert "a small reference" in analysis_report(found).summary[0]
    large = score(population(30, rng), population(2, rng, name="s"))
    assert not any("small" in note for note in large.notes)


def test_more_than_a_hundred_people_are_left_out_in_groups() -> None:
    rng = np.random.default_rng(11)
    found = score(population(130, rng), population(40, rng, name="s"))
    assert found.people == 130 and len(found.reference_distance) == 130
    assert abs(float(np.median(found.farther)) - 0.5) < 0.2


# What is refused


def test_who_cannot_be_scored_is_refused_in_one_sentence() -> None:
    rng = np.random.default_rng(12)
    reference, subjects = population(20, rng), population(2, rng, name="s")
    with pytest.raises(InputError, match="reference of 4 shapes is too small"):
        score(reference.take(range(4)), subjects)
    with pytest.raises(InputError, match="has 1 to 4 modes, not 9"):
        score(reference, subjects, ScoreConfig(modes=9))
    with pytest.raises(InputError, match="r3 is in the reference too, as r3; exclude one of the two scans"):
        score(reference, reference.take([3]))
    with pytest.raises(InputError, match="in the gauge shape, the subjects in form"):
        score(reference, replace(subjects, gauge="form"))
    with pytest.raises(InputError, match="no column 'who'"):
        score(reference, subjects, ScoreConfig(subject="who"))
    with pytest.raises(InputError, match="cannot be compared with other surfaces"):
        score(reference, replace(subjects, fitted=None))
    other = replace(subjects, fitted=replace(subjects.fitted, model=replace(model(), stddev=2 * model().stddev)))  # type: ignore[type-var]
    with pytest.raises(InputError, match="fits by another model"):
        score(reference, other)
    shapes = Cohort.of_shapes(np.stack([mesh.vertices for mesh in training_meshes(3, vertices=80)]), {})
    with pytest.raises(CorrespondenceError, match="80 vertices and the reference 60"):
        score(reference, shapes)


# Surfaces, and the command


def test_a_mesh_in_any_pose_is_scored_by_meshes_in_correspondence(tmp_path: Path) -> None:
    meshes = training_meshes(24, vertices=80)
    reference = Cohort.of_meshes(meshes[:22], Table({}, tuple(mesh.name for mesh in meshes[:22])))
    straight = [replace(mesh, name=f"n{k}") for k, mesh in enumerate(meshes[22:])]
    posed = [mesh.with_vertices(similarity(k, 80.0, 1.3).apply(mesh.vertices)) for k, mesh in enumerate(straight)]
    table = Table({}, ("n0", "n1"))
    found = score(reference, Cohort.of_meshes(posed, table, onto=reference))
    plain = score(reference, Cohort.of_meshes(straight, table, onto=reference))
    assert np.abs(found.distance - plain.distance).max() < 1e-6 and np.abs(found.z - plain.z).max() < 1e-6
    alone = score(reference, Cohort.of_meshes(posed[:1], table.take([0]), onto=reference))
    assert alone.distance[0] == pytest.approx(found.distance[0]) and (found.rest_mm < 5).all()
    copy = [replace(posed[0].with_vertices(similarity(9).apply(meshes[5].vertices)), name="copy")]
    with pytest.raises(InputError, match=r"copy is in the reference too, as blob_5\.ply"):
        score(reference, Cohort.of_meshes(copy, table.take([0]), onto=reference))


@pytest.fixture
def fits(tmp_path: Path) -> Path:
    model().save(tmp_path / "model.h5")
    for k in range(24):
        write_fit(tmp_path / "fits", f"p{k:02d}", k, centroid_size_mm=600.0 + k, metadata={"who": f"w{k}"})
    write_fit(tmp_path / "fits", "bad", 50, status="doubtful", centroid_size_mm=600.0, metadata={"who": "w50"})
    write_fit(tmp_path / "new", "patient", 60, centroid_size_mm=650.0, metadata={"who": "w60"})
    return tmp_path / "fits"


def test_the_command_scores_a_new_folder_by_a_folder_of_fits(
    fits: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")
    out = fits.parent / "out"
    command = ["score", str(fits.parent / "new"), "-o", str(out), "--reference", str(fits), "--quiet"]
    assert main(command) == 0
    told = capsys.readouterr()
    assert "patient lies" in told.out and "which are doubtful (bad)" in told.err
    analysis = Analysis.from_json(json.loads((out / "analysis.json").read_text()))
    assert analysis.question == "score" and any("bad" in note for note in analysis.notes)
    assert {"scores.csv", "nearest.csv", "reference.csv", "score.npz"} <= {path.name for path in out.iterdir()}
    with np.load(out / "score.npz") as arrays:
        assert arrays["z_1"].shape == (VERTICES,) and arrays["shape_1"].shape == (VERTICES, 3)
    assert main([*command, "--set", "gauge=form", "--json", "--modes", "2"]) == 0
    assert json.loads(capsys.readouterr().out)["settings"]["modes"] == 2


def test_the_command_says_what_is_wrong_in_one_sentence(fits: Path, capsys: pytest.CaptureFixture[str]) -> None:
    new, out = fits.parent / "new", fits.parent / "out"
    write_fit(fits.parent / "unsure", "odd", 61, status="doubtful")
    for subjects, more, told in (
        (fits, [], "is in the reference too"),
        (fits.parent / "unsure", [], "0 of its fits can be used, and one is the least"),
        (new, ["--modes", "99"], "has 1 to 4 modes"),
        (new, ["--set", "subject=site"], "no column 'site'"),
    ):
        assert main(["score", str(subjects), "-o", str(out), "--reference", str(fits), "--quiet", *more]) == 2
        said = capsys.readouterr().err
        assert told in said and "Traceback" not in said and not out.exists()


def test_one_subject_is_read_beside_a_reference_and_not_alone(fits: Path) -> None:
    reference = read_cohort(fits)
    assert len(read_cohort(fits.parent / "new", onto=reference)) == 1
    with pytest.raises(InputError, match="two are the least"):
        read_cohort(fits.parent / "new")
    fitted = read_cohort(fits, CohortConfig(surfaces="fitted"))
    one = read_cohort(fits.parent / "new", CohortConfig(surfaces="fitted"), onto=fitted)
    found, plain = score(fitted, one), score(reference, read_cohort(fits.parent / "new", onto=reference))
    assert "The uncertainty of each fit was not taken into account" in " ".join(found.notes)
    assert found.distance[0] == pytest.approx(plain.distance[0], rel=0.1)


def test_meshes_of_a_table_are_subjects_too(tmp_path: Path) -> None:
    for name, part in (("controls", training_meshes(20, vertices=60)), ("new", training_meshes(21, vertices=60)[20:])):
        (tmp_path / name).mkdir()
        for mesh in part:
            write_mesh(tmp_path / name / mesh.name, mesh)
        write_text(tmp_path / name / "data.csv", "file\n" + "".join(f"{mesh.name}\n" for mesh in part))
    reference = read_cohort(tmp_path / "controls" / "data.csv")
    found = score(reference, read_cohort(tmp_path / "new" / "data.csv", onto=reference))
    assert found.names == ("blob_20",) and 0 < found.distance[0] < 20
