"""Rates, their intervals and their comparison, against SciPy and against numbers by hand."""

import numpy as np
import pytest
from scipy.stats import permutation_test, t, ttest_1samp, ttest_rel

from dynmap_rl.evaluation.statistics import (
    exchange_p,
    mean_gap,
    outcome_gap,
    paired_interval,
    shared_interval,
    student_interval,
    summarize,
    summarize_seeds,
    welch_interval,
    wilson,
)


def gap_of(a, b, outcome="success"):
    return outcome_gap([(1, a), (-1, b)], outcome)


def rows(successes, dropped=0, count=10, error=0.02):
    return [
        {"scene_seed": i, "success": i < successes, "dropped": i >= count - dropped, "position_error": error}
        for i in range(count)
    ]


def test_rates_are_percentages_and_the_error_is_in_mm():
    summary = summarize(rows(6, dropped=2))
    assert (summary["SR"], summary["DR"], summary["episodes"]) == (60.0, 20.0, 10)
    assert summary["PE"] == pytest.approx(20.0)


def test_every_entry_of_a_summary_is_that_of_its_own_column():
    made = rows(3, dropped=1, count=4)
    for row, error, cause in zip(made, (0.01, 0.01, 0.01, 0.09), "baac", strict=True):
        row |= {"position_error": error, "touched": row["scene_seed"] < 2, "cause": cause}
        row |= {"localization_error": 0.01}
    found = summarize(made)
    assert found["PE"] == pytest.approx(30.0) and found["touched"] == 50.0
    assert (found["DR_interval"], found["SR_interval"]) == (wilson(1, 4), wilson(3, 4))
    assert found["localization"] == pytest.approx(10.0)
    assert list(found["causes"].items()) == [("a", 2), ("b", 1), ("c", 1)]


def test_students_interval_is_that_of_scipy_within_0_and_100():
    rates = [50.0, 60.0, 70.0]
    expected = ttest_1samp(rates, 0).confidence_interval(0.95)
    assert student_interval(rates) == pytest.approx((expected.low, expected.high))
    assert student_interval([90.0, 100.0]) == (pytest.approx(31.5, abs=0.1), 100.0)
    assert student_interval([90.0]) is None and student_interval([90.0, 90.0, 90.0]) is None


def test_a_mean_over_tasks_is_welchs_with_one_task_and_narrower_with_several():
    a, b = [90.0, 95.0, 97.0], [80.0, 70.0, 60.0]
    assert mean_gap([(a, b)]) == pytest.approx((24, *welch_interval(a, b)))
    gap, low, high = mean_gap([(a, b)] * 3)
    assert gap == pytest.approx(24) and high - low < (mean_gap([(a, b)])[2] - 24) * 2 / 3**0.5
    assert mean_gap([(a, b), (a, [80.0])]) is None and mean_gap([([90.0] * 2, [80.0] * 2)]) is None


def test_welchs_interval_is_the_textbook_one():
    a, b = [90.0, 95.0, 97.0], [80.0, 70.0]
    shares = np.var(a, ddof=1) / 3, np.var(b, ddof=1) / 2
    freedom = sum(shares) ** 2 / (shares[0] ** 2 / 2 + shares[1] ** 2 / 1)
    half = t.ppf(0.975, freedom) * sum(shares) ** 0.5
    assert welch_interval(a, b) == pytest.approx((94 - 75 - half, 94 - 75 + half))
    low, high = welch_interval([100.0] * 3, [99.7, 100.0, 100.0])
    assert low < 0 < high, "one world model alone is worse"
    found = ttest_rel(a, [88.0, 90.0, 96.0]).confidence_interval()
    assert paired_interval(a, [88.0, 90.0, 96.0]) == pytest.approx((found.low, found.high))
    assert paired_interval([90.0], [80.0]) is None and paired_interval([90.0, 80.0], [80.0, 70.0]) is None
    rounded = [0.1 + 0.2, 0.3, 0.3]  # not equal in binary
    assert welch_interval(rounded, [10.0] * 3) is None and student_interval(rounded) is None
    assert welch_interval(a, [80.0]) is None and welch_interval([90.0] * 2, [80.0] * 2) is None


def test_wilson_interval_is_the_textbook_one():
    assert wilson(46, 50) == pytest.approx((81.2, 96.8), abs=0.1)  # 92 % of 50
    low, high = wilson(0, 10)
    assert low == pytest.approx(0.0, abs=1e-9) and 25 < high < 31


def test_seeds_that_agree_say_no_more_than_one():
    one = rows(70, count=100)
    assert shared_interval([one] * 3) == pytest.approx(wilson(70, 100))
    for failures in (0, 1, 3):  # too few to tell how much the seeds agree
        seeds = [rows(100 - failures, count=100), rows(100, count=100), rows(100, count=100)]
        rate = 300 - failures
        assert shared_interval(seeds) == pytest.approx(wilson(rate / 3, 100))


def test_seeds_that_complement_each_other_count_as_independent_at_most():
    even = [dict(row, success=i % 2 == 0) for i, row in enumerate(rows(0, dropped=30, count=100))]
    odd = [dict(row, success=i % 2 == 1 or i == 0) for i, row in enumerate(even)]
    assert shared_interval([even, odd]) == pytest.approx(wilson(101, 200))
    assert shared_interval([even] * 3, "dropped") == pytest.approx(wilson(30, 100))


def test_shared_interval_holds_the_rate_as_often_as_it_says():
    """Start states are easy or hard for all three policies. One that takes all episodes for independent is too narrow."""
    rng, held, held_by_wilson = np.random.default_rng(0), [], []
    for _ in range(400):
        hard = rng.random(100) < 0.4
        success = rng.random((3, 100)) < np.where(hard, 0.1, 0.9)  # 58 %
        low, high = shared_interval([[{"success": s} for s in seed] for seed in success])
        held.append(low <= 58 <= high)
        low, high = wilson(int(success.sum()), 300)
        held_by_wilson.append(low <= 58 <= high)
    assert 0.92 < np.mean(held) < 0.98
    assert np.mean(held_by_wilson) < 0.85


def test_paper_s_protocol_is_mean_and_standard_deviation_over_seeds():
    mean, std = summarize_seeds([rows(4), rows(6), rows(8)])["SR"]
    assert mean == pytest.approx(60.0)
    assert std == pytest.approx(16.33, abs=0.01)


def test_gap_is_paired_and_has_an_interval():
    result = gap_of([rows(80, count=100)], [rows(60, count=100)])
    assert result["gap"] == pytest.approx(20.0)
    assert result["interval"][0] < 20 < result["interval"][1]
    same = gap_of([rows(5)], [rows(5)])
    assert same == {"gap": 0.0, "interval": None, "p": 1.0}


def test_gap_does_not_depend_on_how_often_a_seed_counts():
    a, b = rows(6), rows(0)
    assert gap_of([a, a], [b])["gap"] == gap_of([a], [b, b, b])["gap"] == pytest.approx(60.0)


def test_p_is_that_of_a_sign_test_where_each_start_state_has_one_outcome():
    """5 starts that only a solves against 1 that only b solves: 2 * (1 + 6) / 2**6 by hand."""
    a = [dict(row, success=i < 5) for i, row in enumerate(rows(10))]
    b = [dict(row, success=i == 5) for i, row in enumerate(rows(10))]
    assert gap_of([a], [b])["p"] == pytest.approx(14 / 64)
    assert gap_of([b], [a])["p"] == pytest.approx(14 / 64)


@pytest.mark.parametrize(("count", "p"), [(1, 1.0), (3, 0.25), (6, 1 / 32)])
def test_p_where_all_start_states_agree(count, p):
    """a always succeeds, b never: 2 / 2**count by hand."""
    result = gap_of([rows(count, count=count)], [rows(0, count=count)])
    assert result == {"gap": 100.0, "interval": None, "p": pytest.approx(p)}


def test_p_does_not_depend_on_rounding():
    """One of three policies fails in three starts of 1,000, where the others always succeed: 2 / 2**3 by hand."""
    a = [rows(1000, count=1000), rows(1000, count=1000), rows(997, count=1000)]
    b = [rows(1000, count=1000)] * 3
    assert gap_of(a, b)["p"] == pytest.approx(0.25)
    assert gap_of(b, a[2:])["p"] == pytest.approx(0.25)


def test_p_is_that_of_scipy_s_permutation_test():
    rng = np.random.default_rng(0)
    for _ in range(5):
        a, b = rng.integers(0, 10, (2, 11))
        expected = permutation_test(
            (a, b), lambda x, y, axis: (x - y).sum(axis), permutation_type="samples", n_resamples=np.inf
        )
        assert exchange_p(a - b) == pytest.approx(expected.pvalue)


def test_gap_of_drops():
    a, b = rows(10), [dict(row, dropped=i < 3) for i, row in enumerate(rows(10))]
    assert gap_of([b], [a], "dropped")["gap"] == pytest.approx(
        30.0 - 100 * np.mean([r["dropped"] for r in a])
    )


def test_gap_refuses_other_start_states():
    other = [dict(row, scene_seed=row["scene_seed"] + 1) for row in rows(5)]
    with pytest.raises(ValueError, match="start states"):
        gap_of([rows(5)], [other])


def test_gap_of_position_errors_is_in_mm_and_of_a_paired_t_test():
    errors = np.random.default_rng(0).normal(0.05, 0.01, (2, 30))
    a, b = (
        [dict(row, position_error=e) for row, e in zip(rows(5, count=30), one, strict=True)] for one in errors
    )
    expected = ttest_rel(*errors)
    found = gap_of([a], [b], "position_error")
    assert found["gap"] == pytest.approx(1000 * (errors[0] - errors[1]).mean())
    assert found["p"] == pytest.approx(expected.pvalue)
    assert found["interval"] == pytest.approx([1000 * end for end in expected.confidence_interval()])
    assert gap_of([a], [a], "position_error") == {"gap": 0.0, "interval": None, "p": 1.0}


def test_gap_of_gaps_is_their_difference():
    a, b, c, d = (rows(count) for count in (9, 4, 6, 5))
    found = outcome_gap([(1, [a, a]), (-1, [b]), (-1, [c]), (1, [d, d, d])])
    assert found["gap"] == pytest.approx(50 - 10)


def test_flags_may_be_those_of_numpy():
    a, b = rows(9), rows(4)
    numpy = [[{**row, "success": np.bool_(row["success"])} for row in part] for part in (a, b)]
    assert gap_of([numpy[0]], [numpy[1]]) == gap_of([a], [b])
