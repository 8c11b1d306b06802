from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.reporting.statistics import (
    first_crossing,
    gap_closed,
    interquartile_mean,
    p_value,
    probability_of_improvement,
    solved_at,
)

# Few different values, so that ties are common.
samples = st.lists(st.integers(-20, 20).map(float), min_size=2, max_size=12)


@given(samples, samples)
def test_either_group_is_better_or_they_tie(x: list[float], y: list[float]) -> None:
    p, low, high = probability_of_improvement(x, y)
    assert p + probability_of_improvement(y, x)[0] == pytest.approx(1.0)
    assert np.isnan(low) == (min(len(x), len(y)) < 5)
    assert np.isnan(low) or 0.0 <= low <= high <= 1.0
    pairs = [(a > b) + 0.5 * (a == b) for a in x for b in y]
    assert p == pytest.approx(np.mean(pairs))


@given(samples)
def test_group_is_no_better_than_itself(x: list[float]) -> None:
    assert probability_of_improvement(x, x)[0] == pytest.approx(0.5)


@given(samples, st.floats(-3.0, 3.0), st.floats(0.1, 9.0))
def test_part_of_a_gap_has_no_unit(frozen: list[float], part: float, gap: float) -> None:
    oracle, ours = ([value + share * gap for value in frozen] for share in (1.0, part))
    assert gap_closed(ours, frozen, oracle)[0] == pytest.approx(part, abs=1e-6)
    ours, frozen, oracle = ([-5.0 * value for value in group] for group in (ours, frozen, oracle))
    found, low, high = gap_closed(ours, frozen, oracle)
    assert found == pytest.approx(part, abs=1e-6)
    assert np.isnan(low) == (len(frozen) < 5)
    assert np.isnan(low) or low <= found + 1e-6 <= high + 2e-6


def test_without_a_gap_no_part_of_it_is_closed() -> None:
    part, low, high = gap_closed([1.0] * 6, [2.0] * 6, [2.0] * 6)
    assert not np.isfinite(part)
    assert np.isnan([low, high]).all()
    with pytest.raises(ValueError, match="all three groups"):
        gap_closed([], [], [])


def test_interval_of_improvement_narrows_with_more_replicates() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.5, 1.0, 200), rng.normal(0.0, 1.0, 200)
    wide, narrow = (probability_of_improvement(x[:n], y[:n]) for n in (10, 200))
    assert np.ptp(narrow) < np.ptp(wide) / 2
    p, low, high = narrow
    assert low < p < high


@pytest.mark.parametrize("paired", [False, True])
def test_few_replicates_have_no_interval(paired: bool) -> None:
    for p, low, high in (
        probability_of_improvement([1.0, 2.0], [0.0, 0.5], paired),
        interquartile_mean([0.5, 1.5] * 2),
    ):
        assert p == 1.0
        assert np.isnan([low, high]).all()
    with pytest.raises(ValueError, match="need a replicate"):
        probability_of_improvement([], [1.0])


@pytest.mark.parametrize("paired", [False, True])
@pytest.mark.parametrize(("n", "bound"), [(5, 0.478), (10, 0.69)])
def test_replicates_that_all_win_are_no_certainty(n: int, bound: float, paired: bool) -> None:
    x, y = np.arange(n) + 100.0, np.arange(n)
    assert probability_of_improvement(x, y, paired) == pytest.approx((1.0, bound, 1.0), abs=0.005)
    assert probability_of_improvement(y, x, paired) == pytest.approx((0.0, 0.0, 1.0 - bound), abs=0.005)


@given(samples, samples)
def test_p_is_the_same_whichever_group_is_named_first(x: list[float], y: list[float]) -> None:
    assert 0.0 <= p_value(x, y) <= 1.0
    assert p_value(x, y) == pytest.approx(p_value(y, x))
    n = min(len(x), len(y))
    assert p_value(x[:n], y[:n], paired=True) == pytest.approx(p_value(y[:n], x[:n], paired=True))
    assert p_value(x, x, paired=True) == 1.0


def test_p_tells_a_difference_from_none() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(2.0, 1.0, 40), rng.normal(0.0, 1.0, 40)
    assert p_value(x, y) < 1e-3
    assert p_value(x, x[::-1]) > 0.9
    assert p_value(x, x + 0.01, paired=True) < 1e-6


@given(samples)
def test_interquartile_mean_lies_in_its_interval_and_among_the_values(values: list[float]) -> None:
    mean, low, high = np.nan_to_num(interquartile_mean(values), nan=interquartile_mean(values)[0])
    assert min(values) - 1e-9 <= low <= mean + 1e-9
    assert mean - 1e-9 <= high <= max(values) + 1e-9


@pytest.mark.parametrize(
    ("returns", "solved", "crossed"),
    [
        ([10, 31, 31, 31], 100, 100),
        ([31, 10, 31, 31, 31], 150, 50),
        ([31, 31, 30], np.inf, 50),
        ([1, 2, 3], np.inf, np.inf),
    ],
)
def test_solved_needs_three_episodes_in_a_row(returns: list[float], solved: float, crossed: float) -> None:
    lengths = [50] * len(returns)
    assert solved_at(returns, lengths, 30.0) == solved
    assert first_crossing(returns, lengths, 30.0) == crossed


def test_interquartile_mean_ignores_outliers_and_lies_in_its_interval() -> None:
    mean, low, high = interquartile_mean([1.0, 10.0, 10.0, 11.0, 12.0, 1000.0, 9.0, 10.0])
    assert low <= mean <= high
    assert mean == 10.25
    assert interquartile_mean([3.0] * 5) == (3.0, 3.0, 3.0)
