from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.reporting.registry import EXPERIMENTS
from benchmarks.reporting.statistics import interquartile_mean, median_steps, p_value, probability_of_improvement
from benchmarks.reporting.study import Study, quartiles_over_steps

# Few different values, so that ties are common.
samples = st.lists(st.integers(-20, 20).map(float), min_size=2, max_size=12)


@given(samples, samples)
def test_either_group_is_better_or_they_tie(x: list[float], y: list[float]) -> None:
    p, interval = probability_of_improvement(x, y)
    assert p + probability_of_improvement(y, x)[0] == pytest.approx(1.0)
    assert (interval is None) == (min(len(x), len(y)) < 5)
    if interval is not None:
        assert 0.0 <= interval[0] <= interval[1] <= 1.0
    pairs = [(a > b) + 0.5 * (a == b) for a in x for b in y]
    assert p == pytest.approx(np.mean(pairs))


@given(samples)
def test_group_is_no_better_than_itself(x: list[float]) -> None:
    assert probability_of_improvement(x, x)[0] == pytest.approx(0.5)


def test_interval_of_improvement_narrows_with_more_replicates() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(0.5, 1.0, 200), rng.normal(0.0, 1.0, 200)
    wide, narrow = (probability_of_improvement(x[:n], y[:n])[1] or () for n in (10, 200))
    assert np.ptp(narrow) < np.ptp(wide) / 2
    p, interval = probability_of_improvement(x, y)
    assert interval is not None
    assert interval[0] < p < interval[1]


@pytest.mark.parametrize("paired", [False, True])
def test_few_replicates_have_no_interval(paired: bool) -> None:
    assert probability_of_improvement([1.0, 2.0], [0.0, 0.5], paired) == (1.0, None)
    assert interquartile_mean([1.0, 2.0, 3.0, 4.0]) == (2.5, None)
    with pytest.raises(ValueError, match="need a replicate"):
        probability_of_improvement([], [1.0])


@pytest.mark.parametrize("paired", [False, True])
@pytest.mark.parametrize(("n", "bound"), [(5, 0.478), (10, 0.69)])
def test_replicates_that_all_win_are_no_certainty(n: int, bound: float, paired: bool) -> None:
    x, y = np.arange(n) + 100.0, np.arange(n)
    p, interval = probability_of_improvement(x, y, paired)
    assert (p, interval) == (1.0, pytest.approx((bound, 1.0), abs=0.005))
    p, interval = probability_of_improvement(y, x, paired)
    assert (p, interval) == (0.0, pytest.approx((0.0, 1.0 - bound), abs=0.005))


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
    mean, interval = interquartile_mean(values)
    low, high = interval or (mean, mean)
    assert min(values) - 1e-9 <= low <= mean + 1e-9
    assert mean - 1e-9 <= high <= max(values) + 1e-9


def test_replicates_that_never_get_there_are_infinite_in_the_median() -> None:
    assert median_steps([50, 100, None]) == 100
    assert median_steps([50, None, None]) == np.inf
    assert median_steps([50, None]) == np.inf
    assert median_steps([50, 100]) == 75


def test_quartiles_follow_each_replicate_s_own_episodes() -> None:
    long = np.array([100.0, 200.0]), np.array([1.0, 3.0])
    short = np.array([50.0, 100.0, 150.0]), np.array([1.0, 1.0, 5.0])
    steps, (_, median, _) = quartiles_over_steps([long, short])
    assert list(steps) == [50.0, 100.0, 150.0]
    assert list(median) == [1.0, 1.0, 4.0]
    steps, (_, median, _) = quartiles_over_steps([long, short], hold=True)
    assert list(steps) == [50.0, 100.0, 150.0, 200.0]
    assert median[-1] == 4.0


def test_mean_return_weights_episodes_by_their_steps_within_the_common_ones() -> None:
    runs = [
        {"returns": [10.0, 20.0], "lengths": [50, 50]},
        {"returns": [10.0, 40.0, 99.0], "lengths": [80, 40, 10]},
    ]
    study = Study(EXPERIMENTS[0], {"a": runs[:1], "b": runs[1:]})
    assert study.steps == 100
    assert list(study.scores("a", study.measures[1])) == [15.0]
    assert list(study.scores("b", study.measures[1])) == [pytest.approx(0.8 * 10.0 + 0.2 * 40.0)]
    assert [float(study.scores(method, study.measures[2])[0]) for method in ("a", "b")] == [15.0, 10.0]
