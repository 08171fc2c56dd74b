"""Error rates of verification and identification against brute force, and what must not change them."""

import numpy as np
import pytest
from scipy.stats import binomtest, norm

from shapespace.errors import InputError
from shapespace.statistics.identity.identify import Searches, identification_rates, search
from shapespace.statistics.identity.rates import Pairs, Sweep, people_drawn, rate_estimate, resampled
from shapespace.statistics.identity.verify import verification_rates

pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")


def scores(seed, genuine=40, impostor=300, *, digits=None):
    rng = np.random.default_rng(seed)
    score = np.concatenate([rng.normal(1.5, 1.0, genuine), rng.normal(0.0, 1.0, impostor)])
    same = np.arange(genuine + impostor) < genuine
    mixed = rng.permutation(len(score))
    score = score[mixed] if digits is None else np.round(score[mixed], digits)
    return score, same[mixed]


def by_hand(score, same, weights=None):
    """All thresholds one by one: (threshold, far, tar)."""
    w = np.ones(len(score)) if weights is None else weights
    rows = [(np.inf, 0.0, 0.0)]
    for t in sorted(set(score), reverse=True):
        accepted = score >= t
        rows.append((t, w[accepted & ~same].sum() / w[~same].sum(), w[accepted & same].sum() / w[same].sum()))
    return np.array(rows)


@pytest.mark.parametrize("digits", [None, 1, 0])
@pytest.mark.parametrize("seed", range(3))
def test_the_roc_is_that_of_every_threshold_one_by_one(seed, digits):
    score, same = scores(seed, digits=digits)
    weights = np.random.default_rng(seed).integers(0, 4, len(score)).astype(float)
    for w in (None, weights):
        roc = Sweep(score, same).roc(w)
        np.testing.assert_allclose(np.column_stack([roc.threshold, roc.far, roc.tar])[1:], by_hand(score, same, w)[1:])
        assert roc.far[0] == roc.tar[0] == 0 and np.isposinf(roc.threshold[0])


@pytest.mark.parametrize("digits", [None, 0])
def test_the_equal_error_rate_is_where_both_errors_meet(digits):
    score, same = scores(7, digits=digits)
    far, missed = (lambda r: (r[:, 1], 1 - r[:, 2]))(by_hand(score, same))
    place = np.linspace(0, len(far) - 1, 200_001)
    gap = np.abs(np.interp(place, np.arange(len(far)), far) - np.interp(place, np.arange(len(far)), missed))
    expected = np.interp(place[gap.argmin()], np.arange(len(far)), far)
    assert Sweep(score, same).roc().eer == pytest.approx(expected, abs=1e-4)


def test_the_tar_at_a_far_is_the_largest_that_any_threshold_gives():
    score, same = scores(3)
    rows = by_hand(score, same)
    for far in (0.0, 0.001, 0.01, 0.1, 0.5, 1.0):
        assert Sweep(score, same).roc().tar_at(far) == rows[rows[:, 1] <= far + 1e-12, 2].max()


def test_two_normal_distributions_have_the_equal_error_rate_of_their_distance():
    rng = np.random.default_rng(0)
    score = np.concatenate([rng.normal(2, 1, 40_000), rng.normal(0, 1, 40_000)])
    roc = Sweep(score, np.arange(80_000) < 40_000).roc()
    assert roc.eer == pytest.approx(norm.cdf(-1), abs=0.004)


def test_rates_do_not_change_with_a_rising_function_or_the_order_of_pairs():
    score, same = scores(4)
    roc = Sweep(score, same).roc()
    for other, own in ((np.exp(score) - 7, same), (score[::-1], same[::-1])):
        found = Sweep(other, own).roc()
        np.testing.assert_allclose([found.far, found.tar], [roc.far, roc.tar])


def test_perfect_and_reversed_scores_have_no_error_and_nothing_but_errors():
    same = np.arange(30) < 10
    assert Sweep(np.where(same, 1.0, 0.0), same).roc().eer == 0
    assert Sweep(np.where(same, 0.0, 1.0), same).roc().eer == 1
    assert Sweep(np.zeros(30), same).roc().eer == 0.5


@pytest.mark.parametrize("score", [[1.0, np.nan], [1.0, np.inf], [1.0]])
def test_scores_that_cannot_be_ranked_are_refused(score):
    with pytest.raises(InputError, match="finite score"):
        Sweep(np.array(score), np.array([True, False]))


def test_pairs_of_one_kind_are_refused():
    with pytest.raises(InputError, match="need both"):
        Sweep(np.zeros(3), np.ones(3, dtype=bool))


def all_pairs(count, scans):
    who = np.repeat(np.arange(count), scans)
    rows = np.array([(i, j) for i in range(len(who)) for j in range(i)])
    return Pairs(who[rows[:, 0]], who[rows[:, 1]], rows)


def test_a_person_drawn_three_times_counts_as_three_who_meet_all_others():
    pairs = all_pairs(4, 2)
    times = np.array([3.0, 0.0, 1.0, 2.0])
    weights = pairs.weights(times)
    # Each has one pair of their own, and four with each other person.
    assert weights[pairs.same].sum() == 3 + 0 + 1 + 2
    assert weights[~pairs.same].sum() == 4 * (3 * 1 + 3 * 2 + 1 * 2)


def test_an_interval_over_people_covers_the_truth():
    """People differ in how alike their own scans are, so that pairs of one person go together."""
    covered = 0
    pairs = all_pairs(30, 3)
    for seed in range(25):
        rng = np.random.default_rng(seed)
        own = rng.normal(0, 1, 30)
        score = np.where(pairs.same, 2 + own[pairs.one], 0) + rng.normal(0, 1, len(pairs))
        sweep = Sweep(score, pairs.same)
        drawn = resampled(
            pairs,
            people_drawn(np.ones(30, dtype=bool), 100, seed),
            lambda w, s=sweep: s.roc(w).tar_at(np.array([0.1])),
            1,
        )
        told = rate_estimate(float(sweep.roc().tar_at(0.1)), drawn[:, 0])
        truth = norm.cdf((2 - norm.ppf(0.9)) / np.sqrt(2))
        covered += told.low <= truth <= told.high
    assert covered >= 20


@pytest.mark.parametrize("n", [1, 12, 300])
def test_no_error_among_people_has_the_interval_of_clopper_and_pearson(n):
    exact = binomtest(0, n).proportion_ci(0.95, method="exact")
    found = rate_estimate(0.0, np.zeros(50), n)
    assert (found.low, found.high) == (0.0, pytest.approx(exact.high, rel=1e-9))
    found = rate_estimate(1.0, np.ones(50), n)
    assert (found.low, found.high) == (pytest.approx(1 - exact.high, rel=1e-9), 1.0)
    assert rate_estimate(0.0, [], n) == rate_estimate(0.0, np.zeros(50), n), "no draw is needed"


def test_few_errors_are_no_better_known_than_none_and_many_keep_their_interval():
    none, few = rate_estimate(0.0, np.zeros(50), 100), rate_estimate(0.001, np.linspace(0, 0.003, 50), 100)
    assert few.low == pytest.approx(0, abs=1e-4) and few.high == none.high
    drawn = np.random.default_rng(0).normal(0.2, 0.02, 500)
    assert rate_estimate(0.2, drawn, 100) == rate_estimate(0.2, drawn)


def test_an_interval_of_rare_errors_covers_the_truth():
    """Few people make nearly all errors, so that most studies of 30 people find none, and no draw of people either."""
    rng, alone, exact = np.random.default_rng(5), 0, 0
    for _ in range(300):
        rates = rng.beta(0.02, 0.98, 30)
        shares = rng.binomial(20, rates) / 20
        drawn = (rng.multinomial(30, np.full(30, 1 / 30), size=100) @ shares) / 30
        for people in (None, 30):
            told = rate_estimate(float(shares.mean()), drawn, people)
            covers = told.low <= 0.02 <= told.high
            alone, exact = alone + (people is None and covers), exact + (people == 30 and covers)
    assert exact >= 0.93 * 300 and alone < 0.7 * 300


def perfect(count=20, scans=3):
    pairs = all_pairs(count, scans)
    return pairs, np.where(pairs.same, 1.0, 0.0)


def test_perfect_verification_and_identification_state_an_upper_bound_everywhere():
    pairs, score = perfect()
    people = people_drawn(np.ones(20, dtype=bool), 20, 0)
    chosen = {"all": np.ones(len(pairs), dtype=bool)}
    found = verification_rates("cosine", score, pairs, np.arange(20, dtype=np.int32) % 4, people, chosen=chosen)
    bound = binomtest(0, 20).proportion_ci(0.95, method="exact").high
    for eer, tar in ((found.eer, found.tar), (found.by["all"].eer, found.by["all"].tar)):
        assert (eer.value, eer.low, eer.high) == (0.0, 0.0, pytest.approx(bound))
        known = [one for one in tar.values() if one.value is not None]
        assert known and all((one.low, one.high) == (pytest.approx(1 - bound), 1.0) for one in known)
    assert found.band[0, -1] == pytest.approx(1 - bound) and found.band[1, -1] == 1.0
    searches = search(np.eye(20)[:, np.repeat(np.arange(20), 2)], np.arange(20), np.repeat(np.arange(20), 2))
    ranks = identification_rates("cosine", searches, 20, people)
    assert (ranks.rank_1.low, ranks.rank_1.high) == (pytest.approx(1 - bound), 1.0)
    assert ranks.fnir[0.1].high == pytest.approx(bound) and ranks.band[0, 0] == pytest.approx(1 - bound)


def test_the_same_seed_draws_the_same_people_and_only_those_tested():
    tested = np.array([True, False, True, True])
    one, again, other = (people_drawn(tested, 20, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()
    assert (one[:, 1] == 0).all() and (one.sum(axis=1) == 3).all()


def ranks_by_hand(matrix, gallery, probes):
    out = []
    for column, who in zip(matrix.T, probes, strict=True):
        best = {}
        for value, name in zip(column, gallery, strict=True):
            best[name] = max(best.get(name, -np.inf), value)
        if who not in best:
            out.append(0)
            continue
        out.append(1 + sum(value >= best[who] for name, value in best.items() if name != who))
    return np.array(out)


@pytest.mark.parametrize("digits", [None, 0])
def test_the_cmc_counts_the_people_who_come_before_the_right_one(digits):
    rng = np.random.default_rng(2)
    gallery, probes = rng.integers(0, 8, 20), rng.integers(0, 10, 60)
    matrix = rng.normal(0, 1, (20, 60)) + 1.0 * (gallery[:, None] == probes)
    matrix = matrix if digits is None else np.round(matrix, digits)
    found = search(matrix, gallery, probes)
    expected = ranks_by_hand(matrix, gallery, probes)
    np.testing.assert_array_equal(found.rank, expected)
    known = expected[expected > 0]
    np.testing.assert_allclose(found.cmc(8), [(known <= k).mean() for k in range(1, 9)])
    weights = rng.integers(1, 4, 60).astype(float)
    of_known = weights[expected > 0]
    np.testing.assert_allclose(
        found.cmc(8, weights), [((known <= k) * of_known).sum() / of_known.sum() for k in range(1, 9)]
    )


@pytest.mark.parametrize("strangers", [True, False])
@pytest.mark.parametrize("digits", [None, 0])
def test_the_fnir_is_the_least_over_thresholds_that_hold_the_fpir(strangers, digits):
    rng = np.random.default_rng(9)
    gallery, probes = np.arange(10), rng.integers(0, 15 if strangers else 10, 200)
    matrix = rng.normal(0, 1, (10, 200)) + 2.5 * (gallery[:, None] == probes)
    matrix = matrix if digits is None else np.round(matrix, digits)
    found = search(matrix, gallery, probes)
    enrolled = found.rank > 0
    foreign = found.best_other[~enrolled] if strangers else found.best_other
    for rate in (0.02, 0.1, 0.4, 1.0):
        # A threshold just above each score, and one below all.
        cuts = [*np.nextafter(foreign, np.inf), -np.inf]
        holds = [t for t in cuts if (foreign >= t).mean() <= rate]
        missed = min(1 - ((found.rank == 1) & (found.own >= t))[enrolled].mean() for t in holds)
        assert found.fnir(np.array([rate]))[0] == pytest.approx(missed)


def test_a_gallery_of_one_person_is_refused():
    with pytest.raises(InputError, match="at least two are needed"):
        search(np.zeros((2, 3)), np.array([4, 4]), np.array([4, 5, 6]))


def test_ties_count_against_the_right_person():
    found = search(np.zeros((3, 1)), np.arange(3), np.array([1]))
    assert found.rank[0] == 3
    assert isinstance(found, Searches) and found.cmc(3).tolist() == [0, 0, 1]
