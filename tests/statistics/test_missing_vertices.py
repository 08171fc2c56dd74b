"""Missing vertices in statistics: estimates are no evidence, maps are blank without it, and answers state how much."""

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.report.analyses.analysis_report import shape_notes, shape_settings
from shapespace.report.analyses.result_report import analysis_report
from shapespace.statistics.asymmetry import measure_asymmetry
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.measure_change import change
from shapespace.statistics.observation_weights import information
from shapespace.statistics.regression import regress
from shapespace.statistics.score_subjects import score
from shapespace.types import BoolArray, FloatArray
from symmetric_object import posed, symmetric_object
from synthetic_shapes import training_meshes

N, V = 20, 80
GROUPS = ["a"] * 10 + ["b"] * 10
SEEN_BY_FEW = slice(0, 6)
"""Vertices that group b hardly observes."""


def shapes(count: int = N, noise_mm: float = 0.3) -> FloatArray:
    rng = np.random.default_rng(4)
    whole = np.stack([mesh.vertices for mesh in training_meshes(count, vertices=V)])
    return whole + noise_mm * rng.standard_normal(whole.shape)


def mask(count: int = N) -> BoolArray:
    """Return (N, V) observed vertices: two shapes of group b observe the first ones; one shape lacks ten others."""
    observed = np.ones((count, V), np.bool_)
    observed[12:, SEEN_BY_FEW] = False
    observed[3, 40:50] = False
    return observed


def cohort(**columns: list[object]) -> Cohort:
    whole = shapes()
    holed = np.where(mask()[:, :, None], whole, np.nan)
    return Cohort.of_shapes(holed, {"group": GROUPS, **columns}, faces=training_meshes(3, vertices=V)[0].faces)


def test_information_is_the_ratio_of_variances_of_the_estimate() -> None:
    rng = np.random.default_rng(0)
    made = cohort()
    matrix = np.column_stack([np.repeat([-1.0, 1.0], 10), rng.standard_normal(N)])
    contrasts = np.array([[2.0, 0.0], [0.0, 1.0]])
    found = information(made, matrix, contrasts)
    assert found is not None and made.observed is not None
    X = np.column_stack([np.ones(N), matrix])
    for vertex in (0, 45, 70):
        own = X[made.observed[:, vertex]]
        for at, c in enumerate(np.column_stack([np.zeros(2), contrasts])):
            ratio = (c @ np.linalg.inv(X.T @ X) @ c) / (c @ np.linalg.inv(own.T @ own) @ c)
            assert abs(found[at, vertex] - ratio) < 1e-9
    assert np.allclose(found[:, 70], 1, rtol=0, atol=1e-12) and found[0, 0] < 0.5  # processors round differently


def test_no_information_is_where_a_group_observes_nothing() -> None:
    observed = np.ones((N, V), np.bool_)
    observed[10:, 5] = False
    made = Cohort.of_shapes(shapes(), {"group": GROUPS}, observed=observed)
    found = information(made, np.repeat([-1.0, 1.0], 10)[:, None], np.array([[2.0]]))
    assert found is not None and found[0, 5] == 0 and (np.delete(found[0], 5) == 1).all()
    whole = Cohort.of_shapes(shapes(), {"group": GROUPS})
    assert information(whole, np.repeat([-1.0, 1.0], 10)[:, None], np.array([[2.0]])) is None


def test_a_difference_that_only_estimates_show_is_not_on_the_map() -> None:
    whole = shapes()
    # A difference next to the missing vertices, which estimates would spread to them.
    near = np.exp(-0.5 * (np.linalg.norm(whole[0] - whole[0, 0], axis=1) / 40.0) ** 2)
    whole[10:] += 25.0 * near[:, None] * whole[0] / np.linalg.norm(whole[0], axis=1, keepdims=True)
    holed = np.where(mask()[:, :, None], whole, np.nan)
    made = Cohort.of_shapes(holed, {"group": GROUPS}, faces=training_meshes(3, vertices=V)[0].faces)
    found = compare(made, "~ group", CompareConfig(permutations=200))
    shown = found.effects[0].map
    assert shown is not None and shown.weight is not None and shown.blank is not None
    np.testing.assert_array_equal(np.flatnonzero(shown.blank), np.arange(6))
    assert (shown.test.p_family[:6] == 1).all() and (shown.shown_mm[:6] == 0).all()
    assert (shown.test.p_family[6:] <= 0.05).any()
    answer = analysis_report(found)
    assert any("6 of 80 vertices are grey" in sentence for sentence in answer.summary)
    assert np.isnan(answer.arrays["effect_1.npz"]["normal_mm"][:6]).all()
    assert np.isfinite(answer.arrays["effect_1.npz"]["normal_mm"][6:]).all()


def test_answers_state_the_share_of_estimates_and_the_shape_with_most() -> None:
    made = cohort()
    share = (8 * 6 + 10) / (N * V)
    assert abs(made.estimated_share.mean() - share) < 1e-12
    [note] = shape_notes(made)
    assert f"{100 * share:.1f} % of the analysed vertices are estimates" in note
    assert "in 9 of 20 shapes, most in shape 4 (12.5 %)" in note
    stated = shape_settings(made)
    assert stated["estimated_share_largest_shape"] == "shape 4" and stated["vertices_not_analysed"] == 0
    answer = analysis_report(compare(made, "~ group", CompareConfig(permutations=20, maps=False)))
    header, rows = answer.tables["observed.csv"]
    assert header == ("shape", "estimated_share") and len(rows) == 9 and rows[0] == ("shape 4", 0.125)
    assert note in answer.notes and answer.settings["estimated_share"] == stated["estimated_share"]
    whole = Cohort.of_shapes(shapes(), {"group": GROUPS})
    assert shape_notes(whole) == () and shape_settings(whole) == {"shape_source": "surfaces"}


def test_positions_that_are_not_observed_change_nothing() -> None:
    whole, observed, faces = shapes(), mask(), training_meshes(3, vertices=V)[0].faces
    observed[:, 60] = False
    made = [
        Cohort.of_shapes(np.where(observed[:, :, None], whole, junk), {"group": GROUPS}, faces=faces, observed=observed)
        for junk in (np.nan, 0.0, 9999.0)
    ]
    for other in made[1:]:
        for k in range(N):
            np.testing.assert_allclose(other.vertices(k), made[0].vertices(k), atol=1e-8)


def test_the_estimates_do_not_depend_on_the_table() -> None:
    one, other = cohort(), cohort(age=list(range(N)))
    np.testing.assert_array_equal(one.coefficients, other.coefficients)


def test_maps_of_asymmetry_are_grey_where_a_side_is_not_observed() -> None:
    thing = symmetric_object()
    rng = np.random.default_rng(1)
    whole = posed(thing.x + thing.smooth(rng, 12), rng)
    observed = np.ones(whole.shape[:2], np.bool_)
    observed[2, 7] = observed[5:, 9] = False
    made = Cohort.of_shapes(whole, {}, faces=thing.faces, observed=observed)
    found = measure_asymmetry(made, pairs=thing.pairs, permutations=19)
    assert found.observed is not None and found.blank is not None and made.analysed is not None
    pair = sorted((9, int(thing.other[9])))
    np.testing.assert_array_equal(np.flatnonzero(found.blank), pair)
    assert (found.directional_p[pair] == 1).all() and np.abs(found.difference[:, pair]).max() == 0
    grey = np.isnan(analysis_report(found).arrays["asymmetry.npz"]["maps_mm"])
    np.testing.assert_array_equal(np.flatnonzero(grey[2]), sorted({7, int(thing.other[7]), *pair}))
    assert grey[:, 30].sum() == 0


def test_changes_are_grey_where_a_visit_is_not_observed() -> None:
    rng = np.random.default_rng(2)
    first = shapes(8)
    visits = np.stack([first, first + 0.2 * rng.standard_normal(first.shape)], axis=1).reshape(16, V, 3)
    observed = np.ones((16, V), np.bool_)
    observed[3, 20] = False  # the second visit of the second subject
    observed[::2, 30] = observed[1, 30] = False
    table = {"subject": [f"s{k // 2}" for k in range(16)], "time": [k % 2 for k in range(16)]}
    made = Cohort.of_shapes(
        visits, table, faces=training_meshes(3, vertices=V)[0].faces, gauge="form", observed=observed
    )
    found = change(made)
    assert found.blank is not None and found.mean_change is not None
    np.testing.assert_array_equal(np.flatnonzero(found.blank), [30])
    assert found.mean_change.surface.p[30] == 1 and np.isnan(analysis_report(found).arrays["change.npz"]["mean"][30])
    maps = analysis_report(found).arrays["subjects.npz"]["change_mm"]
    np.testing.assert_array_equal(np.argwhere(np.isnan(maps[:, 20])).ravel(), [1])


def test_regression_and_score_take_missing_vertices() -> None:
    made = cohort(age=[float(k) for k in np.random.default_rng(0).permutation(N)])
    found = regress(made, "age", folds=4, permutations=0)
    assert np.isfinite(found.shapes.per_unit_mm).all()
    assert any("estimates" in note for note in analysis_report(found).notes)
    more = np.where(mask(24)[20:, :, None], shapes(24)[20:], np.nan)
    subjects = Cohort.of_shapes(more, {}, names=["x1", "x2", "x3", "x4"], onto=made)
    scores = score(made, subjects)
    np.testing.assert_array_equal(np.isnan(scores.z), np.isnan(more[:, :, 0]))
    assert np.isfinite(scores.beyond_2).all() and any(
        "in 4 of 4 shapes" in note for note in analysis_report(scores).notes
    )


@pytest.mark.parametrize("gauge", ["shape", "form"])
def test_whole_shapes_are_compared_as_before(gauge: str) -> None:
    whole = Cohort.of_shapes(shapes(), {"group": GROUPS}, gauge=gauge)  # type: ignore[arg-type]
    assert whole.observed is None and whole.analysed is None and (whole.observed_share == 1).all()
