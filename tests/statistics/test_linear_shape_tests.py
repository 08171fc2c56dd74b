"""Trajectories, pairs of groups, allometry and repeatability: published results of geomorph, other libraries, nulls."""

from typing import Any, Literal

import numpy as np
import pytest
from scipy.spatial import procrustes

from shapespace.cohort.cohort import Cohort, with_columns
from shapespace.errors import InputError
from shapespace.report.analyses.result_report import shape_test_report
from shapespace.statistics.compare_shapes import CompareConfig, SquaresType, compare, off_common_direction
from shapespace.statistics.effect_size import permutation_p
from shapespace.statistics.shape_tests.linear import (
    analyse_allometry,
    compare_pairs,
    compare_trajectories,
    measure_repeatability,
)
from shapespace.types import FloatArray

pytest.importorskip("formulaic")


def planar(rows: Any, table: dict[str, Any]) -> Cohort:
    flat = np.array(rows, dtype=np.float64)
    shapes = np.pad(flat.reshape(len(flat), -1, 2), ((0, 0), (0, 0), (0, 1)))
    return Cohort.of_shapes(shapes, table, align=False)


@pytest.fixture(scope="module")
def plethodon(geomorph_reference: dict[str, Any]) -> Cohort:
    table = geomorph_reference["plethodon_table"]
    cohort = planar(geomorph_reference["plethodon_gpa"]["coords"], {name: table[name] for name in ("species", "site")})
    sizes = np.array(table["cs"], dtype=np.float64)
    return with_columns(cohort, {"Csize": sizes, "lcs": np.log(sizes)})


@pytest.fixture(scope="module")
def pupfish(geomorph_reference: dict[str, Any]) -> Cohort:
    table = geomorph_reference["pupfish_table"]
    cohort = planar(geomorph_reference["pupfish_coords"], {name: table[name] for name in ("Sex", "Pop")})
    return with_columns(cohort, {"lcs": np.log(np.array(table["CS"], dtype=np.float64))})


def simulate(rows: FloatArray, table: dict[str, Any]) -> Cohort:
    """Shapes of five points from rows (N, 15)."""
    base = np.random.default_rng(0).normal(size=(5, 3)) * 30
    return Cohort.of_shapes(base + rows.reshape(len(rows), 5, 3), table, align=False)


def test_published_analyses_of_variance_are_reproduced(
    geomorph_reference: dict[str, Any], plethodon: Cohort, pupfish: Cohort
) -> None:
    lm = geomorph_reference["plethodon_lm_raw_landmark_gpa"]
    types: list[SquaresType] = ["I", "II", "III"]
    for squares in types:
        for cohort, formula, expected in (
            (plethodon, "~ species * site", lm[f"pleth_{squares}"]),
            (plethodon, "~ log(Csize) * species + site", lm[f"plethcov_{squares}"]),
            (pupfish, "~ lcs + Sex * Pop", geomorph_reference["pupfish_lm"][f"pup_{squares}"]),
        ):
            options = CompareConfig(
                anova_type=squares, permutations=400, maps=False, coding="treatment", variances="equal"
            )
            result = compare(cohort, formula, options)
            for k, term in enumerate(expected["terms"]):
                test = result.test(term)
                assert test.df == expected["df"][k]
                assert test.squares == pytest.approx(expected["SS"][k], rel=1e-6)
                assert test.r2 == pytest.approx(expected["R2"][k], rel=1e-6)
                assert test.f == pytest.approx(expected["F"][k], rel=1e-6)
                assert test.p == pytest.approx(expected["P"][k], abs=0.06)  # 4 sd of 400 permutations
            rest = result.strata[0]
            assert (rest.df, rest.df_total) == tuple(expected["df"][-2:])
            assert rest.squares == pytest.approx(expected["SS"][-2], rel=1e-6)
            assert rest.squares_total == pytest.approx(expected["SS"][-1], rel=1e-6)


def test_types_i_and_ii_do_not_depend_on_the_coding_of_classes(pupfish: Cohort) -> None:
    for squares in ("I", "II"):
        found = [
            compare(pupfish, "~ Sex * Pop", CompareConfig(anova_type=squares, permutations=20, maps=False, coding=one))
            for one in ("deviation", "treatment")
        ]
        assert [t.f for t in found[0].tests] == pytest.approx([t.f for t in found[1].tests])
        assert [e.distance_mm for e in found[0].effects] == pytest.approx([e.distance_mm for e in found[1].effects])


def test_published_distances_of_means_are_reproduced(geomorph_reference: dict[str, Any], plethodon: Cohort) -> None:
    expected = geomorph_reference["plethodon_lm_raw_landmark_gpa"]
    result = compare_pairs(
        plethodon, formula="~ species * site", group=("species", "site"), permutations=2000, residuals="raw"
    )
    assert result.reduced_model == ("species", "site")
    table = expected["pleth_pw"]["tab"]
    for k, row in enumerate(table["_row"]):
        tested = " – ".join(sorted(row.split(":")))
        [found] = [one for one in result.table("Pairs of groups").rows if one[1] == tested]
        assert found[2] == pytest.approx(table["d"][k], rel=1e-6)
        assert found[3] == pytest.approx(table["UCL (95%)"][k], rel=0.02)
        assert found[4] == pytest.approx(table["Z"][k], abs=0.35)
        assert found[5] == pytest.approx(table["Pr > d"][k], abs=0.035)
    species = compare_pairs(
        plethodon, formula="~ site + species", group=("species",), null="~ site", permutations=2000, residuals="raw"
    ).statistics[0]
    assert species.value == pytest.approx(expected["pleth_sp"]["d"][0], rel=1e-6)
    assert species.z == pytest.approx(expected["pleth_sp"]["Z"][0], abs=0.35)


def test_published_vectors_of_slopes_are_reproduced(geomorph_reference: dict[str, Any], plethodon: Cohort) -> None:
    expected = geomorph_reference["plethodon_lm_raw_landmark_gpa"]
    result = compare_pairs(
        plethodon, formula="~ lcs * species", group=("species",), covariate="lcs", permutations=2000, residuals="raw"
    )
    distance, angle = result.statistic("distance"), result.statistic("angle, degrees")
    assert distance.value == pytest.approx(expected["pleth_vcd"]["d"][0], rel=1e-6)
    assert distance.z == pytest.approx(expected["pleth_vcd"]["Z"][0], abs=0.2)
    assert distance.p == pytest.approx(expected["pleth_vcd"]["Pr > d"][0], abs=0.03)
    assert angle.value == pytest.approx(expected["pleth_vc"]["angle"][0], rel=1e-6)
    assert np.cos(np.radians(angle.value)) == pytest.approx(expected["pleth_vc"]["r"][0], rel=1e-6)
    assert angle.z == pytest.approx(expected["pleth_vc"]["Z"][0], abs=0.2)
    assert permutation_p(angle.arrangements) == pytest.approx(expected["pleth_vc"]["Pr > angle"][0], abs=0.03)
    assert angle.p is None and angle.unknown_p == "raw residuals"


def test_published_trajectories_are_reproduced(geomorph_reference: dict[str, Any], pupfish: Cohort) -> None:
    expected = geomorph_reference["pupfish_trajectory"]
    result = compare_trajectories(pupfish, group=("Pop",), points="Sex", residuals="raw")
    length, angle = result.statistics
    assert length.value == pytest.approx(expected["MD"]["d"][0], rel=1e-6)
    assert length.z == pytest.approx(expected["MD"]["Z"][0], abs=0.35)
    assert angle.value == pytest.approx(expected["TC"]["angle"][0], rel=1e-6)
    assert length.p is not None and length.p <= 0.01
    assert permutation_p(angle.arrangements) <= 0.01


def test_published_scores_of_allometry_are_reproduced(
    geomorph_reference: dict[str, Any], plethodon: Cohort, pupfish: Cohort
) -> None:
    lm = geomorph_reference["plethodon_lm_raw_landmark_gpa"]
    result = analyse_allometry(plethodon, covariate="lcs")
    rows = np.array([row[3:] for row in result.table("Allometry scores").rows])
    assert rows[:, 0] == pytest.approx(np.array(lm["pleth_regscore"]), abs=1e-12)
    assert rows[:, 1] == pytest.approx(np.array(lm["pleth_cac"]), abs=1e-12)
    assert result.arrays["allometry.npz"]["slopes"][0, :, :2].ravel() == pytest.approx(np.array(lm["pleth_beta"]))
    f, allom = result.statistic("F"), lm["pleth_allom"]
    assert f.value == pytest.approx(allom["F"][0], rel=1e-6)
    assert f.z == pytest.approx(allom["Z"][0], abs=0.2)
    assert f.p == pytest.approx(allom["P"][0], abs=0.04)
    rows = np.array([row[3:] for row in analyse_allometry(pupfish, covariate="lcs").table("Allometry scores").rows])
    assert rows[:, 0] == pytest.approx(np.array(geomorph_reference["pupfish_regscore"]["RegScore"]), abs=1e-12)
    assert rows[:, 1] == pytest.approx(np.array(geomorph_reference["pupfish_regscore"]["CAC"]), abs=1e-12)


def test_trajectories_of_three_points_have_the_size_angle_and_shape_by_hand() -> None:
    rng = np.random.default_rng(1)
    stage = np.tile(np.repeat(["1", "2", "10"], 5), 2)
    group = np.repeat(["a", "b"], 15)
    cohort = simulate(rng.normal(size=(30, 15)), {"group": group, "stage": stage})
    result = compare_trajectories(cohort, group=("group",), points="stage", permutations=20)
    paths = [
        np.stack([cohort.coefficients[(group == g) & (stage == s)].mean(axis=0) for s in ("1", "2", "10")])
        for g in ("a", "b")
    ]
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths]
    axes = [np.linalg.svd(path - path.mean(axis=0))[2][0] for path in paths]
    axes = [axis * np.sign((path[-1] - path[0]) @ axis) for axis, path in zip(axes, paths, strict=True)]
    assert result.statistics[0].value == pytest.approx(abs(lengths[0] - lengths[1]))
    assert result.statistics[1].value == pytest.approx(np.degrees(np.arccos(axes[0] @ axes[1])))
    # Rotations of each to the mean of both, at unit size.
    unit = [(path - path.mean(axis=0)) / np.linalg.norm(path - path.mean(axis=0)) for path in paths]
    mean = (unit[0] + unit[1]) / 2
    turned = list[FloatArray]()
    for one in unit:
        u, _, vt = np.linalg.svd(one.T @ mean)
        turned.append(one @ u @ vt)
    assert result.statistics[2].value == pytest.approx(float(np.linalg.norm(turned[0] - turned[1])))
    # The disparity of scipy, which also scales, is no larger.
    assert procrustes(*paths)[2] <= result.statistics[2].value ** 2 + 1e-9


def test_trajectories_of_the_same_shape_differ_in_size_and_angle_alone() -> None:
    rng = np.random.default_rng(2)
    path = np.zeros((3, 15))
    path[1, :2], path[2, 0] = (1, 1), 2
    turned = np.zeros((3, 15))
    turned[:, [5, 6]] = 2 * path[:, [0, 1]]
    turned[:, 7] = 1  # elsewhere
    noise = 1e-3 * rng.normal(size=15) * np.tile([[1.0], [-1.0]], (3, 1))
    rows = np.concatenate([np.repeat(one, 2, axis=0) + noise for one in (path, turned)])
    table = {"group": ["a"] * 6 + ["b"] * 6, "stage": ["p1", "p1", "p2", "p2", "p3", "p3"] * 2}
    result = compare_trajectories(simulate(rows, table), group=("group",), points="stage", permutations=20)
    length, angle, shape = (one.value for one in result.statistics)
    assert length == pytest.approx(2 * np.sqrt(2), rel=1e-6)
    assert angle == pytest.approx(90, abs=1e-5)
    assert shape == pytest.approx(0, abs=1e-6)
    reverse = compare_trajectories(
        simulate(rows, table), group=("group",), points="stage", order=("p2", "p1", "p3"), permutations=20
    )
    assert reverse.statistics[0].value == pytest.approx(2 + np.sqrt(2), rel=1e-6)


def test_size_corrected_shapes_do_not_vary_with_size_within_groups() -> None:
    rng = np.random.default_rng(3)
    x, group = rng.normal(size=30), np.array(["a", "b"] * 15)
    slope = np.where(group == "a", 1.0, 3.0)[:, None] * np.linspace(1, 2, 15)
    cohort = simulate(x[:, None] * slope + 0.1 * rng.normal(size=(30, 15)), {"x": x, "group": group})
    separate = analyse_allometry(cohort, covariate="x", group="group", separate=True, permutations=50)
    assert separate.statistic("F", "x:group").p == pytest.approx(0.02)
    corrected = separate.arrays["allometry.npz"]["size_corrected"].reshape(30, -1)
    for name in ("a", "b"):
        own = group == name
        assert np.cov(x[own], corrected[own].T)[0, 1:] == pytest.approx(0.0, abs=1e-10)
    lengths = np.linalg.norm(separate.arrays["allometry.npz"]["slopes"], axis=(1, 2))
    assert lengths[1] / lengths[0] == pytest.approx(3, rel=0.1)
    common = analyse_allometry(cohort, covariate="x", group="group", permutations=50)
    within = np.concatenate([x[group == name] - x[group == name].mean() for name in ("a", "b")])
    corrected = common.arrays["allometry.npz"]["size_corrected"].reshape(30, -1)
    assert within @ np.concatenate([corrected[group == name] for name in ("a", "b")]) == pytest.approx(0, abs=1e-9)
    assert shape_test_report(common).tables["allometry_scores.csv"]


def test_intraclass_correlations_are_those_of_one_coordinate_by_hand() -> None:
    """Table 2 of Shrout and Fleiss (Psychological Bulletin 86, 1979): six targets, four judges."""
    ratings = np.array([[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]])
    rows = np.zeros((24, 15))
    rows[:, 0] = ratings.ravel()
    rows[:, 1:] = 1e-2 * np.random.default_rng(0).normal(size=(24, 14))  # no two shapes are the same
    table = {"target": np.repeat([f"t{k}" for k in range(6)], 4), "judge": ["a", "b", "c", "d"] * 6}
    result = measure_repeatability(simulate(rows, table), subject="target", session="judge", permutations=200)
    assert result.statistic("ICC").value == pytest.approx(0.17, abs=0.005)
    assert result.statistic("ICC of agreement").value == pytest.approx(0.29, abs=0.005)
    assert result.statistic("ICC of consistency").value == pytest.approx(0.71, abs=0.006)
    squares = {row[0]: (row[1], row[3]) for row in result.table("Analysis of variance").rows}
    assert squares["target"] == pytest.approx((5, 11.24), rel=1e-3)
    assert squares["judge"] == pytest.approx((3, 32.49), rel=1e-3)
    assert squares["measurement error"] == pytest.approx((15, 1.02), rel=2e-3)
    assert result.statistic("F", "target").value == pytest.approx(11.03, rel=3e-3)
    assert result.statistic("F", "judge").value == pytest.approx(31.87, rel=3e-3)


def test_the_map_of_measurement_error_is_the_deviation_within_subjects() -> None:
    rng = np.random.default_rng(4)
    noise = np.repeat([0.1, 0.1, 0.1, 0.1, 1.0], 3)
    rows = np.repeat(rng.normal(size=(40, 15)), 3, axis=0) + noise * rng.normal(size=(120, 15))
    subject = np.repeat([f"s{k}" for k in range(40)], 3)
    result = measure_repeatability(simulate(rows, {"subject": subject}), permutations=50)
    deviation = result.arrays["measurement_error.npz"]["values"]
    assert getattr(result.figures[0], "unit", None) == (result.cohort.unit or "units of the coordinates")
    centred = rows.reshape(40, 3, 5, 3) - rows.reshape(40, 3, 5, 3).mean(axis=1, keepdims=True)
    assert deviation == pytest.approx(np.sqrt((centred**2).sum(axis=(0, 1, 3)) / 80))
    icc = result.statistic("ICC")
    assert icc.low is not None and icc.high is not None
    assert icc.low < icc.value < icc.high
    assert icc.value == pytest.approx(15 / (15 + (noise**2).sum()), abs=0.05)


def test_unequal_replicates_have_their_mean_number_in_the_correlation() -> None:
    rng = np.random.default_rng(5)
    counts = np.array([1, 2, 3, 4, 5])
    subject = np.repeat([f"s{k}" for k in range(5)], counts)
    rows = rng.normal(size=(15, 15))
    result = measure_repeatability(simulate(rows, {"subject": subject}), permutations=20)
    (_, among), (_, error) = ((row[0], row[3]) for row in result.table("Analysis of variance").rows)
    k = (15 - (counts**2).sum() / 15) / 4
    assert result.statistic("ICC").value == pytest.approx((among - error) / (among + (k - 1) * error))


def test_levels_are_kept_where_nothing_differs() -> None:
    counts = dict.fromkeys(("path", "angle", "shape", "mean", "slope", "homogeneity", "subject", "session"), 0)
    for seed in range(40):
        rng = np.random.default_rng([9, seed])
        group, stage = np.repeat(["a", "b"], 18), np.tile(["p", "q", "r"], 12)
        x = rng.normal(size=36)
        trend = {"p": np.zeros(15), "q": np.linspace(0, 2, 15), "r": np.linspace(2, -2, 15)}
        rows = rng.normal(size=(36, 15))
        cohort = simulate(rows + np.stack([trend[one] for one in stage]), {"g": group, "p": stage})
        found = compare_trajectories(cohort, group=("g",), points="p", permutations=60, seed=seed)
        p = dict(zip(("path", "angle", "shape"), (one.p for one in found.statistics), strict=True))
        cohort = simulate(rows + x[:, None], {"g": rng.permutation(group), "x": x, "s": np.repeat(np.arange(12), 3),
                                              "v": np.tile(["1", "2", "3"], 12)})  # fmt: skip
        options = {"permutations": 60, "seed": seed}
        p["mean"] = compare_pairs(cohort, formula="~ x + g", group=("g",), **options).statistics[0].p
        slopes = compare_pairs(cohort, formula="~ x * g", group=("g",), covariate="x", **options)
        p["slope"] = slopes.statistics[0].p
        p["homogeneity"] = analyse_allometry(cohort, covariate="x", group="g", **options).statistics[-1].p
        cohort = simulate(rows, {"s": np.repeat([f"s{k}" for k in range(12)], 3), "v": ["1", "2", "3"] * 12})
        found = measure_repeatability(cohort, subject="s", session="v", **options)
        p |= {"subject": found.statistic("F", "s").p, "session": found.statistic("F", "v").p}
        for name, value in p.items():
            counts[name] += value is not None and value <= 0.05
    assert max(counts.values()) <= 8  # of 40; 99.9 % of a binomial of 5 %


def test_designs_that_cannot_be_tested_are_refused() -> None:
    rng = np.random.default_rng(6)
    table = {"g": ["a"] * 6 + ["b"] * 6, "p": (["u", "v"] * 3 + ["u"] * 6), "x": [1.0] * 6 + list(range(6)),
             "s": [f"s{k}" for k in range(12)], "r": ["s1", "s2"] * 6, "t": ["t1", "t2", "t3"] * 4,
             "one": ["k"] * 12}  # fmt: skip
    cohort = simulate(rng.normal(size=(12, 15)), table)
    for words, call in (
        ("no shape with p", lambda: compare_trajectories(cohort, group=("g",), points="p")),
        ("two or more points: each class of 'one' exactly once, not k",
         lambda: compare_trajectories(cohort, group=("g",), points="one")),
        ("two or more points: each class of 't' exactly once, not t1, t2",
         lambda: compare_trajectories(cohort, group=("g",), points="t", order=("t1", "t2"), formula="~ g * t")),
        ("two different values", lambda: compare_pairs(cohort, formula="~ g", group=("one",))),
        ("nested", lambda: compare_pairs(cohort, formula="~ g", group=("g",), null="~ t")),
        ("constant within a group", lambda: compare_pairs(cohort, formula="~ g + x", group=("g",), covariate="x")),
        ("same mean", lambda: compare_pairs(cohort, formula="~ t", group=("r",), null="~ 1")),
        ("leaves no residuals", lambda: compare_pairs(cohort, formula="~ s", group=("g",))),
        ("no column", lambda: compare_pairs(cohort, formula="~ g", group=("nothing",))),
        ("Separate slopes need groups", lambda: analyse_allometry(cohort, covariate="x", separate=True)),
        ("constant within a group", lambda: analyse_allometry(cohort, covariate="x", group="g", separate=True)),
        ("replicates", lambda: measure_repeatability(cohort, subject="s")),
        ("three or more subjects", lambda: measure_repeatability(cohort, subject="r")),
        ("different numbers", lambda: measure_repeatability(cohort, subject="t", session="x")),
    ):  # fmt: skip
        with pytest.raises(InputError, match=words):
            call()


def test_the_distance_from_a_common_direction_is_the_smallest_over_all_directions() -> None:
    rng = np.random.default_rng(2)
    one, other, weights = rng.normal(size=(60, 2)), rng.normal(size=(60, 2)), (2.0, 0.5)
    turns = np.radians(np.arange(0, 360, 0.05))
    directions = np.stack([np.cos(turns), np.sin(turns)])
    distances = [
        weight * ((own**2).sum(axis=1)[:, None] - np.maximum(own @ directions, 0.0) ** 2)
        for own, weight in zip((one, other), weights, strict=True)
    ]
    expected = (distances[0] + distances[1]).min(axis=1)
    np.testing.assert_allclose(off_common_direction(one, other, *weights), expected, atol=1e-4)
    parallel = off_common_direction(one, 3.0 * one, *weights)
    np.testing.assert_allclose(parallel, 0.0, atol=1e-12)


@pytest.mark.parametrize("residuals", ["scaled", "raw"])
def test_angles_without_a_common_change_are_rarely_significant_unless_its_length_is_taken_as_known(
    residuals: Literal["scaled", "raw"],
) -> None:
    found = 0
    for seed in range(20):
        shapes = np.random.default_rng(seed).normal(size=(24, 12, 3))
        table = {"group": ["a", "b"] * 12, "time": [f"t{k // 2 % 2}" for k in range(24)]}
        given = Cohort.of_shapes(shapes, table, align=False)
        result = compare_trajectories(
            given, group=("group",), points="time", residuals=residuals, permutations=60, seed=seed
        )
        angle = result.statistic("angle, degrees")
        assert 0 <= angle.value <= 180
        if residuals == "raw":
            found += permutation_p(angle.arrangements) <= 0.05
        elif angle.unknown_p is None:
            assert angle.p is not None
            found += angle.p <= 0.05
    assert found <= 3 if residuals == "scaled" else found > 8


@pytest.mark.parametrize("turned", [False, True])
def test_p_of_an_angle_is_not_known_unless_a_change_is_longer_than_its_noise(turned: bool) -> None:
    unknown = {0.0: 0, 6.0: 0}
    for seed in range(20):
        for length in unknown:
            shapes = np.random.default_rng(seed).normal(size=(24, 12, 3))
            shapes[[k // 2 % 2 == 1 for k in range(24)], 0, 0] += length
            if turned:
                # Opposite changes have no common direction, but clear ones of their own.
                shapes[[k % 4 == 3 for k in range(24)], 0, 0] -= 2 * length
            table = {"group": ["a", "b"] * 12, "time": [f"t{k // 2 % 2}" for k in range(24)]}
            given = Cohort.of_shapes(shapes, table, align=False)
            result = compare_trajectories(given, group=("group",), points="time", permutations=20, seed=seed)
            angle = result.statistic("angle, degrees")
            assert (angle.p is None) == (angle.unknown_p == "short vectors")
            unknown[length] += angle.p is None
            if angle.p is None:
                summary = " ".join(shape_test_report(result).summary)
                assert "p not known: neither vector is longer than its noise" in summary
                assert "p not known" in repr(result)
    assert unknown[6.0] == 0 and 0 < unknown[0.0] < 20


def test_too_few_different_arrangements_for_a_small_p_are_stated() -> None:
    shapes = np.random.default_rng(0).normal(size=(12, 6, 3))
    for subjects, is_limited in ((5, True), (6, False)):
        count = 2 * subjects
        table = {"subject": [f"s{k // 2}" for k in range(count)], "session": [f"v{k % 2}" for k in range(count)]}
        given = Cohort.of_shapes(shapes[:count], table, align=False)
        result = measure_repeatability(given, session="session", permutations=400)
        [sentence] = [one for one in shape_test_report(result).summary if one.startswith("session: F")]
        # The sessions of n subjects can be exchanged in 2^n ways, of which pairs have the same F.
        assert ("no p below 0.0" in sentence) == is_limited
