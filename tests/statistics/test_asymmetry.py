"""Asymmetry: the ANOVA is that of Klingenberg, what is put in comes back with its interval, and nonsense is refused."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table
from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.mirror_plane import find_mirror, mirror_pairs
from shapespace.geometry.normals import face_vectors, vertex_normals
from shapespace.model.shape_model import ShapeModel
from shapespace.report.analyses.result_report import analysis_report
from shapespace.schemas import read_part
from shapespace.statistics.asymmetry import (
    ERROR_ASYMMETRIC,
    ERROR_SYMMETRIC,
    AsymmetryScores,
    first_pattern,
    measure_asymmetry,
)
from shapespace.statistics.sides import find_sides, given_sides, read_pairs
from shapespace.types import FloatArray, IntArray, Mesh, read_only
from symmetric_object import FLIP, Symmetric, cohort_of, posed, symmetric_object


@pytest.fixture(scope="module")
def thing() -> Symmetric:
    return symmetric_object()


def people(thing: Symmetric, count: int, repeats: int, seed: int, *, own: float = 1.0, noise: float = 0.5) -> Cohort:
    rng = np.random.default_rng(seed)
    both = thing.smooth(rng, count)
    x = thing.x + both + thing.image(both) + own * thing.sides_differ(thing.smooth(rng, count))
    x = np.repeat(x, repeats, axis=0)
    x = x + noise * rng.standard_normal(x.shape)
    return cohort_of(thing, posed(x, rng), [f"s{k}" for k in range(count) for _ in range(repeats)])


def superimposed(thing: Symmetric, shapes: np.ndarray, *, scaled: bool) -> np.ndarray:
    """Shapes and then their images, all superimposed by plain NumPy."""
    both = np.concatenate([shapes, shapes[:, thing.other] * FLIP])
    both = both - both.mean(axis=1, keepdims=True)
    size = np.linalg.norm(both, axis=(1, 2))
    if scaled:
        both = both / size[:, None, None] * size.mean()
    mean = both[0]
    for _ in range(200):
        for k, one in enumerate(both):
            u, _, vt = np.linalg.svd(one.T @ mean)
            turn = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
            both[k] = one @ turn
        mean = both.mean(axis=0)
    if scaled:
        for _ in range(30):
            mean = both.mean(axis=0)
            both = both * (np.vdot(mean, mean) / np.einsum("nvd,vd->n", both, mean))[:, None, None]
    return both


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_sums_of_squares_are_those_of_a_plain_anova_of_shapes_and_their_images(thing: Symmetric, gauge: str) -> None:
    rng = np.random.default_rng(3)
    who = np.repeat(np.arange(6), [2, 3, 1, 2, 2, 4])
    shapes = posed((thing.x + 3.0 * thing.smooth(rng, 6))[who] + rng.standard_normal((14, *thing.x.shape)), rng)
    cohort = Cohort.of_shapes(shapes, {"subject": [f"s{k}" for k in who]}, faces=thing.faces, gauge=gauge)  # type: ignore[arg-type]
    found = measure_asymmetry(cohort, pairs=thing.pairs, permutations=0)

    both = superimposed(thing, np.stack([cohort.vertices(k) for k in range(14)]), scaled=gauge == "shape")
    grand, codes, side = both.mean(axis=0), np.tile(who, 2), np.repeat([0, 1], 14)
    subject = np.stack([both[codes == k].mean(axis=0) for k in range(6)])
    sides = np.stack([both[side == j].mean(axis=0) for j in (0, 1)])
    cells = np.stack([[both[(codes == k) & (side == j)].mean(axis=0) for j in (0, 1)] for k in range(6)])
    expected = {
        "individual": ((subject[codes] - grand) ** 2).sum(),
        "side": ((sides[side] - grand) ** 2).sum(),
        "individual x side": ((cells[codes, side] - subject[codes] - sides[side] + grand) ** 2).sum(),
    }
    for source, ss in expected.items():
        assert found.effect(source).ss == pytest.approx(ss, rel=1e-8)
    error = found.effect(ERROR_ASYMMETRIC).ss + found.effect(ERROR_SYMMETRIC).ss
    assert error == pytest.approx(((both - cells[codes, side]) ** 2).sum(), rel=1e-8)
    assert found.effect("side").f == pytest.approx(5 * expected["side"] / expected["individual x side"], rel=1e-8)


def test_dimensions_are_those_of_klingenberg(thing: Symmetric) -> None:
    sides = given_sides(people(thing, 4, 1, 0), thing.pairs)
    plane = int((thing.other == np.arange(len(thing.other))).sum())
    pairs = (len(thing.x) - plane) // 2
    assert sides.dimensions(scaled=True) == (3 * pairs + 2 * plane - 4, 3 * pairs + plane - 3)
    assert sides.dimensions(scaled=False)[0] == 3 * pairs + 2 * plane - 3


def test_the_symmetric_part_stays_in_the_mirror_and_the_other_turns_over(thing: Symmetric) -> None:
    found = measure_asymmetry(people(thing, 5, 1, 1), pairs=thing.pairs, permutations=0)
    normal = (found.mean - found.mean[thing.other])[np.argmax(thing.x[:, 0])]
    turn = np.eye(3) - 2 * np.outer(normal, normal) / (normal @ normal)
    assert np.allclose(found.symmetric[:, thing.other] @ turn, found.symmetric, atol=1e-7)
    assert np.allclose(found.difference[:, thing.other] @ turn, -found.difference, atol=1e-7)


def test_pairs_are_found_on_an_asymmetric_surface_wherever_it_lies() -> None:
    faces = load_faces()
    person = faces.face(faces.draw_person(np.random.default_rng(1)))
    turned = Rotation.from_rotvec([1.0, 0.4, 2.0]).apply(person.vertices.copy()) + np.array([300.0, -20.0, 7.0])
    mesh = Mesh(turned, person.faces)
    found = find_mirror(mesh)
    other = mirror_pairs(mesh, found)
    nearest = np.linalg.norm(mesh.vertices[faces.mirror] - found.image, axis=1).max()
    assert nearest > 1.0, "the nearest vertex would do"
    assert other is not None and np.array_equal(other, faces.mirror)


def test_scores_come_back_and_their_intervals_hold_them(thing: Symmetric) -> None:
    rng = np.random.default_rng(5)
    n, normals = 150, vertex_normals(Mesh(thing.x, thing.faces))
    own = thing.sides_differ(thing.smooth(rng, n))
    own -= own.mean(axis=1, keepdims=True)
    mm = np.tile([1.0, 2.0, 3.0], n // 3)
    own *= (mm / np.sqrt((np.einsum("nvd,vd->nv", 2 * own, normals) ** 2).mean(axis=1)))[:, None, None]
    truth = measure_asymmetry(cohort_of(thing, thing.x + own), pairs=thing.pairs, permutations=0).scores.raw_mm
    x = np.repeat(thing.x + own, 2, axis=0)
    noise = 0.5 * thing.smooth(rng, 2 * n, 15.0) + 0.4 * rng.standard_normal(x.shape)
    cohort = cohort_of(thing, posed(x + noise, rng), [f"s{k}" for k in range(n) for _ in range(2)])
    scores = measure_asymmetry(cohort, pairs=thing.pairs, permutations=0).scores
    for level in (1.0, 2.0, 3.0):
        assert abs(((scores.mm - truth) / truth)[mm == level].mean()) < 0.05
    assert ((scores.raw_mm - truth) / truth)[mm == 1.0].mean() > 0.1
    assert 0.90 <= ((scores.low <= truth) & (truth <= scores.high)).mean() <= 0.98


def test_what_fits_know_of_themselves_makes_intervals_that_hold_the_truth(thing: Symmetric) -> None:
    rng = np.random.default_rng(8)
    shapes = thing.x + 2.0 * thing.smooth(rng, 12)
    model = ShapeModel.fit([Mesh(x, thing.faces) for x in (*shapes, *thing.image(shapes))])
    b = rng.standard_normal((150, model.n_modes)) * model.stddev
    stddev = np.full_like(b, 0.1 * float(np.linalg.norm(model.stddev)) / np.sqrt(model.n_modes))

    def measured(b: np.ndarray) -> AsymmetryScores:
        names = [f"fit {k}" for k in range(len(b))]
        fitted = FitDiagnostics(model, read_only(b), read_only(stddev), ("converged",) * len(b), "fits")
        cohort = Cohort.of_fits(fitted, names, Table({}, tuple(names)), read_only(np.full(len(b), np.nan)))
        return measure_asymmetry(cohort, permutations=0).scores

    truth, told = measured(b).mm, measured(b + stddev * rng.standard_normal(b.shape))
    assert 0.90 <= ((told.low <= truth) & (truth <= told.high)).mean() <= 0.98
    assert np.isnan(told.error_mm) and np.array_equal(told.mm, told.raw_mm)


def test_directional_asymmetry_is_found_where_it_was_put_and_on_its_side(thing: Symmetric) -> None:
    rng = np.random.default_rng(7)
    normals = vertex_normals(Mesh(thing.x, thing.faces))
    place = np.argmax(thing.x[:, 0])
    bump = np.exp(-(np.linalg.norm(thing.x - thing.x[place], axis=1) ** 2) / (2 * 12.0**2))
    x = (
        thing.x
        + (2.0 * bump)[:, None] * normals
        + 0.3 * thing.smooth(rng, 25)
        + 0.3 * rng.standard_normal((25, *thing.x.shape))
    )
    found = measure_asymmetry(cohort_of(thing, posed(x, rng)), pairs=thing.pairs, permutations=199)
    shown = found.directional_p <= 0.05
    assert shown[place] and found.directional[place] > 1.0
    assert found.directional[thing.other[place]] == pytest.approx(-found.directional[place], rel=1e-6)
    assert found.effect("side").p == pytest.approx(1 / 200)
    assert bump[shown].max() > 0.9 and shown.mean() < 0.5


def test_without_directional_asymmetry_five_in_a_hundred_studies_claim_it() -> None:
    small = symmetric_object(8, 5)
    claimed = np.zeros(2)
    for seed in range(100):
        found = measure_asymmetry(people(small, 8, 1, seed), pairs=small.pairs, permutations=19, seed=seed)
        p = found.effect("side").p
        assert p is not None
        claimed += [p <= 0.05, found.directional_p.min() <= 0.05]
    assert (claimed <= 0.12 * 100).all() and claimed.sum() > 0


def test_fluctuating_asymmetry_is_told_from_measurement_error(thing: Symmetric) -> None:
    real = measure_asymmetry(people(thing, 12, 2, 1), pairs=thing.pairs, permutations=99)
    none = measure_asymmetry(people(thing, 12, 2, 2, own=0.0), pairs=thing.pairs, permutations=99)
    assert real.effect("individual x side").p == 0.01
    f = none.effect("individual x side").f
    assert f is not None and 0.3 < f < 3


def test_poses_of_the_shapes_do_not_matter(thing: Symmetric) -> None:
    rng = np.random.default_rng(2)
    shapes = thing.x + thing.smooth(rng, 6)
    one, other = (measure_asymmetry(cohort_of(thing, s), pairs=thing.pairs) for s in (shapes, posed(shapes, rng)))
    assert np.allclose(one.scores.mm, other.scores.mm, rtol=1e-8)
    assert np.allclose(one.maps, other.maps, atol=1e-6)
    assert [e.p for e in one.anova] == [e.p for e in other.anova]


def test_the_same_seed_gives_the_same_numbers_and_another_does_not(thing: Symmetric) -> None:
    cohort = people(thing, 7, 2, 4)
    first, again, other = (measure_asymmetry(cohort, pairs=thing.pairs, seed=s, permutations=99) for s in (1, 1, 2))
    assert first.anova == again.anova and np.array_equal(first.directional_p, again.directional_p)
    assert not np.array_equal(first.directional_p, other.directional_p)


def test_the_first_pattern_is_what_was_put_in(thing: Symmetric) -> None:
    rng = np.random.default_rng(9)
    pattern, amount = thing.sides_differ(thing.smooth(rng, 1))[0], 3.0 * rng.standard_normal(20)
    x = thing.x + amount[:, None, None] * pattern + 0.05 * rng.standard_normal((20, *thing.x.shape))
    found = measure_asymmetry(cohort_of(thing, x), pairs=thing.pairs, permutations=0)
    _, share, along = first_pattern(found)
    assert share > 0.9 and abs(np.corrcoef(along, amount)[0, 1]) > 0.99


def test_standard_deviations_are_those_of_the_reference_group_without_the_subject(thing: Symmetric) -> None:
    rng = np.random.default_rng(11)
    own = thing.sides_differ(thing.smooth(rng, 9)) * np.array([1, 1.2, 0.9, 1.1, 0.8, 1, 1.3, 4, 5])[:, None, None]
    cohort = cohort_of(thing, thing.x + own, group=["control"] * 7 + ["case"] * 2)
    found = measure_asymmetry(cohort, pairs=thing.pairs, reference=("group", "control"), permutations=0)
    mm = found.scores.mm
    assert found.z[8] == pytest.approx((mm[8] - mm[:7].mean()) / mm[:7].std(ddof=1))
    assert found.z[0] == pytest.approx((mm[0] - mm[1:7].mean()) / mm[1:7].std(ddof=1))


def test_vertices_that_do_not_pair_up_are_mixed_and_give_about_the_same_scores() -> None:
    rng = np.random.default_rng(0)
    fine = symmetric_object(700, 60)
    own = fine.sides_differ(fine.smooth(rng, 4, 40.0)) * np.array([0.5, -0.5, 1, -1])[:, None, None]
    # Sliding the vertices of one side along the surface leaves the object as it is, and the pairs not.
    slid = fine.x[fine.faces[:, 0]] * 0.2 + fine.x[fine.faces[:, 1]] * 0.5 + fine.x[fine.faces[:, 2]] * 0.3
    take = np.unique(fine.faces[:, 0], return_index=True)[1]
    weights = np.array([0.2, 0.5, 0.3])
    shapes = np.stack([np.einsum("fcd,c->fd", (fine.x + o)[fine.faces[take]], weights) for o in own])
    faces = hull(slid[take] / np.linalg.norm(slid[take], axis=1, keepdims=True))
    mixed = measure_asymmetry(Cohort.of_shapes(shapes, {}, faces=faces, gauge="form"), permutations=0)
    paired = measure_asymmetry(cohort_of(fine, fine.x + own), pairs=fine.pairs, permutations=0)
    assert not mixed.sides.paired and "do not pair up" in mixed.sides.notes[-1]
    assert np.allclose(mixed.vertex_scores.mm, paired.vertex_scores.mm, rtol=0.15)


def hull(directions: FloatArray) -> IntArray:
    """Return the triangles of points on a sphere, all facing outwards."""
    faces = ConvexHull(directions).simplices.astype(np.int32)
    a, b, c = (directions[faces[:, j]] for j in range(3))
    inward = np.einsum("fd,fd->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces


def egg(vertices: int) -> tuple[FloatArray, IntArray]:
    """Return a surface that is symmetric about x = 0, while its vertices are not."""
    k = np.arange(vertices) + 0.5
    polar, turn = np.arccos(1 - 2 * k / vertices), np.pi * (1 + 5**0.5) * k
    ball = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    x = ball * [50.0, 70.0, 40.0]
    x[:, 1] += 0.006 * x[:, 2] ** 2 + 0.1 * x[:, 2]
    x[:, 2] += 0.15 * x[:, 1] + 0.003 * x[:, 1] ** 2
    return x, hull(ball)


def test_vertices_that_do_not_pair_up_show_no_directional_asymmetry_of_a_symmetric_population() -> None:
    x, faces = egg(1200)
    rng = np.random.default_rng(5)
    on_maps, p_side = 0, list[float]()
    for _ in range(8):
        waves, phases = rng.normal(size=(20, 3, 3)) / 30, rng.uniform(0, 6, (20, 1, 3))
        fields = np.sin(x @ waves + phases)
        noise = 0.7 * np.einsum("nk,kvd->nvd", rng.normal(size=(16, 20)), fields)
        shapes = x + noise + 0.2 * rng.normal(size=(16, *x.shape))
        found = measure_asymmetry(Cohort.of_shapes(shapes, {}, faces=faces, gauge="form"), permutations=99)
        assert not found.sides.paired
        on_maps += bool((found.directional_p <= 0.05).any())
        p_side.append(next(one.p for one in found.anova if one.source == "side") or 1.0)
    assert on_maps <= 2
    assert min(p_side) < 0.5


def test_the_height_of_a_surface_above_its_triangles_is_that_of_its_curvature() -> None:
    x, faces = egg(1200)
    cohort = Cohort.of_shapes(
        x + 1e-3 * np.random.default_rng(0).normal(size=(3, *x.shape)), {}, faces=faces, gauge="form", align=False
    )
    sides = find_sides(cohort)
    normals = vertex_normals(Mesh(x, faces))
    off = ((x - sides.image(x)) * normals).sum(axis=1)
    left = off - sides.chord_heights(x, normals)
    assert off.mean() > 0.05 and abs(left.mean()) < 0.2 * off.mean() and left.std() < 0.5 * off.std()


def test_landmarks_alone_will_do(thing: Symmetric, tmp_path: Path) -> None:
    cohort = people(thing, 6, 1, 3)
    plane = np.flatnonzero(thing.other == np.arange(len(thing.other)))[:2]
    landmarks = {"left": 0, "right": int(thing.other[0]), "chin": int(plane[0])}
    (tmp_path / "pairs.csv").write_text(f"a,b\nleft,right\nchin,chin\n5,{thing.other[5]}\n{plane[1]},{plane[1]}\n")
    named = replace(cohort, landmarks=landmarks)
    pairs = read_pairs(tmp_path / "pairs.csv", named)
    found = measure_asymmetry(named, pairs=pairs, permutations=9)
    assert len(found.sides) == 6 and found.normals is None
    assert "are excluded" in found.sides.notes[0]
    answer = analysis_report(found)
    points = next(p for p in answer.parts if p.title == "Vertices")
    assert {row[0] for row in points.rows} >= {"left", "right", "chin"}  # type: ignore[attr-defined]


def test_landmarks_without_a_unit_are_never_in_mm_and_the_methods_name_each_test(thing: Symmetric) -> None:
    found = measure_asymmetry(replace(people(thing, 6, 2, 3), unit=""), pairs=thing.pairs, permutations=9)
    answer = analysis_report(found)
    assert not any(re.search(r"\bmm\b|mm²", sentence) for sentence in answer.summary)
    assert not any(head.endswith(("_mm", "_mm2")) for header, _ in answer.tables.values() for head in header)
    schemes = {one.tested: (one.resampling, one.arrangements) for one in found.methods.tests}
    assert schemes["side", "directional asymmetry of each vertex"] == ("sign flips", 10)
    assert schemes["individual", "individual x side"] == ("permutation", 10)
    assert [(one.classes, one.subjects, one.shapes) for one in found.methods.sizes] == [(("2",), 6, 12)]
    assert "Methods" in [part.title for part in answer.parts]


def test_the_answer_can_be_read_and_says_what_is_not_known(thing: Symmetric, tmp_path: Path) -> None:
    once = analysis_report(measure_asymmetry(people(thing, 6, 1, 3), pairs=thing.pairs, permutations=9))
    assert "No subject was measured twice" in " ".join(once.summary)
    assert any("6 subjects are few" in note for note in once.notes)
    twice = analysis_report(measure_asymmetry(people(thing, 20, 2, 3), pairs=thing.pairs, permutations=9))
    assert "fluctuating asymmetry" in twice.summary[2] and twice.notes == (
        "Shapes in each class of subject: 2 in 20 classes.",
    )
    path = twice.save(tmp_path)
    told = json.loads(path.read_text())
    kinds = [type(read_part(part, "part")).__name__ for part in told["parts"]]
    assert {"TablePart", "HistogramPart", "SurfaceMapPart", "MorphPart"} <= set(kinds)
    with np.load(tmp_path / "asymmetry.npz") as arrays:
        for part in told["parts"]:
            if part["kind"] in ("surface_map", "morph"):
                names = (
                    [part.get(k, k) for k in ("low", "high", "faces")] if part["kind"] == "morph" else [part["values"]]
                )
                assert all(name in arrays for name in names)
            if part["kind"] == "morph":
                faces = arrays["faces"]
                middle = (arrays[names[0]] + arrays[names[1]]) / 2
                area = face_vectors(middle, faces)
                for end in names[:2]:
                    assert (np.einsum("fd,fd->f", face_vectors(arrays[end], faces), area) > 0).all(), part["title"]


def organ_cohort() -> Cohort:
    rng = np.random.default_rng(0)
    organ = raw_surface(Organ.draw(rng), rng, 800)
    shapes = organ.vertices + rng.standard_normal((4, *organ.vertices.shape))
    return Cohort.of_shapes(shapes, {}, faces=organ.faces, gauge="form")


def test_an_object_without_mirror_symmetry_is_refused() -> None:
    with pytest.raises(InputError, match=r"lies \d\.\d % of its size from its own mirror image.*no mirror symmetry"):
        measure_asymmetry(organ_cohort())


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([(0, 10_000)], "there is no vertex 10000"),
        ([(0, 1), (0, 2), (3, 4)], "is in two pairs"),
        ([(0, 1)], "name 2 vertices"),
        ([(k, (k * 7 + 3) % 5 + 60) for k in range(5)], "of its size from its mirror image by these pairs"),
    ],
)
def test_pairs_that_cannot_be_are_refused(thing: Symmetric, pairs: list[tuple[int, int]], said: str) -> None:
    with pytest.raises(InputError, match=said):
        measure_asymmetry(people(thing, 4, 1, 0), pairs=pairs)


def test_cohorts_that_say_nothing_are_refused(thing: Symmetric) -> None:
    cohort = people(thing, 4, 1, 0)
    with pytest.raises(InputError, match="2 subjects are too few"):
        measure_asymmetry(cohort.take([0, 1]), pairs=thing.pairs)
    with pytest.raises(InputError, match="has no column 'who'"):
        measure_asymmetry(cohort, subject="who", pairs=thing.pairs)
    with pytest.raises(InputError, match="reference group needs 3"):
        measure_asymmetry(cohort, reference=("subject", "s0"), pairs=thing.pairs)
    with pytest.raises(InputError, match="Landmarks and other points without triangles need --pairs"):
        find_sides(Cohort.of_shapes(np.random.default_rng(0).standard_normal((3, 8, 3)), {}))
    torn = cohort_of(thing, thing.x + thing.smooth(np.random.default_rng(0), 6), ["a", "a", "b", "b", "c", "d"],
                     group=["x", "y", "x", "x", "x", "x"])  # fmt: skip
    with pytest.raises(InputError, match="some shapes of a have group x and others not"):
        measure_asymmetry(torn, reference=("group", "x"), pairs=thing.pairs)
    lacking = cohort_of(thing, thing.x + thing.smooth(np.random.default_rng(0), 4), ["a", "", "b", "c"])
    with pytest.raises(InputError, match=r"subject of 1 of 4 shapes is missing \(shape 2\)"):
        measure_asymmetry(lacking, pairs=thing.pairs)


@pytest.mark.parametrize("text", ["", "a,b\n", "a\n1\n", "a,b\n1,2,3\n", '"'])
def test_tables_that_hold_no_pairs_are_refused(thing: Symmetric, tmp_path: Path, text: str) -> None:
    (tmp_path / "pairs.csv").write_text(text)
    with pytest.raises(FileFormatError, match=r"pairs\.csv"):
        read_pairs(tmp_path / "pairs.csv", people(thing, 3, 1, 0))


def test_names_that_are_no_landmarks_are_refused(thing: Symmetric, tmp_path: Path) -> None:
    (tmp_path / "pairs.csv").write_text("a,b\nnose,-3\n")
    with pytest.raises(InputError, match="no vertex or landmark has the name or number -3, nose "):
        read_pairs(tmp_path / "pairs.csv", people(thing, 3, 1, 0))
